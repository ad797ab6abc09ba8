"""The autopilot's parameters: read by name, set, and read back; no I/O, no threads, no clock of its own.

MAVLink's parameter protocol carries every value in a 32-bit float field, and the two stacks fill it in two ways:
ArduPilot casts (an integer 6 travels as 6.0), PX4 copies the four bytes of its integer there. Neither answers when it
is asked for a parameter that it does not have, but for the newest ArduPilot, which sends PARAM_ERROR. So absence is
concluded from silence: several requests without an answer while other requests were answered.
"""

from __future__ import annotations

import math
import struct
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from enum import StrEnum

from ortholoc_edge.adapters.mavlink.codec import MavlinkMessage, dialect, payload_of
from ortholoc_edge.adapters.mavlink.estimates import Autopilot

Number = int | float

_MS = 1_000_000
# An answer is 37 bytes: 33 a second are a fifth of a line of 57600 baud, and ArduPilot queues 20 requests.
_REQUEST_INTERVAL_NS = 30 * _MS
_MOST_PER_POLL = 4
# Waits before a question is repeated; the last one ends it.
_PATIENCE_NS = (400 * _MS, 600 * _MS, 800 * _MS, 1000 * _MS, 1200 * _MS)
_WRITE_PATIENCE_NS = (1000 * _MS, 1000 * _MS, 1500 * _MS)
_AUTOPILOT_COMPONENT = 1
_NAME_BYTES = 16

_INTEGERS = {
    dialect.MAV_PARAM_TYPE_UINT8: (0, 2**8 - 1),
    dialect.MAV_PARAM_TYPE_INT8: (-(2**7), 2**7 - 1),
    dialect.MAV_PARAM_TYPE_UINT16: (0, 2**16 - 1),
    dialect.MAV_PARAM_TYPE_INT16: (-(2**15), 2**15 - 1),
    dialect.MAV_PARAM_TYPE_UINT32: (0, 2**32 - 1),
    dialect.MAV_PARAM_TYPE_INT32: (-(2**31), 2**31 - 1),
}
_BYTEWISE = {dialect.MAV_PARAM_TYPE_INT32: "<i", dialect.MAV_PARAM_TYPE_UINT32: "<I"}

_ERRORS = {
    dialect.MAV_PARAM_ERROR_DOES_NOT_EXIST: "it has no such parameter",
    dialect.MAV_PARAM_ERROR_VALUE_OUT_OF_RANGE: "the value is out of its range",
    dialect.MAV_PARAM_ERROR_PERMISSION_DENIED: "it does not permit that",
    dialect.MAV_PARAM_ERROR_READ_ONLY: "it is read-only",
}


class Answer(StrEnum):
    """What came of the question for a parameter."""

    OPEN = "open"
    VALUE = "value"
    ABSENT = "absent"  # this firmware does not have it
    SILENT = "silent"  # nothing was answered at all, so nothing is known of it
    UNREADABLE = "unreadable"  # only values came that can't be meant: not finite, or of an impossible type


@dataclass(frozen=True, slots=True)
class Reading:
    """A parameter as far as it is known; ``value`` and ``kind`` (MAV_PARAM_TYPE) with ``VALUE`` only."""

    answer: Answer
    value: Number | None = None
    kind: int | None = None


@dataclass(frozen=True, slots=True)
class Written:
    """What came of setting a parameter. ``value`` is what the autopilot says it has now, None if it said nothing."""

    name: str
    wanted: Number
    value: Number | None
    accepted: bool
    why: str


class _Question:
    def __init__(self, patience_ns: tuple[int, ...]) -> None:
        self.patience_ns = patience_ns
        self.restart()

    def restart(self) -> None:
        self.attempts = 0
        self.first_ns: int | None = None
        self.due_ns = 0
        self.unreadable = False

    def asked(self, now_ns: int) -> None:
        self.first_ns = now_ns if self.first_ns is None else self.first_ns
        self.due_ns = now_ns + self.patience_ns[self.attempts]
        self.attempts += 1

    def exhausted(self, now_ns: int) -> bool:
        return self.attempts >= len(self.patience_ns) and now_ns >= self.due_ns


class _Write:
    """One change: PARAM_SET until it is echoed, then a read that must say the same."""

    def __init__(self, name: str, wanted: Number, kind: int) -> None:
        self.name, self.wanted, self.kind = name, wanted, kind
        self.question = _Question(_WRITE_PATIENCE_NS)
        self.echoed = False
        self.value: Number | None = None


class ParameterClient:
    """Its owner gives it the autopilot's PARAM_VALUE and PARAM_ERROR, and sends what :meth:`poll` returns."""

    def __init__(self) -> None:
        self._questions: dict[str, _Question] = {}
        self._readings: dict[str, Reading] = {}
        self._write: _Write | None = None
        self._written: list[Written] = []
        self._last_answer_ns: int | None = None
        self._next_ns = 0
        self.counts: Counter[str] = Counter()

    # -- what is wanted --------------------

    def read(self, names: Iterable[str]) -> None:
        """Ask for these, anew where they are known already.

        Raises: ValueError for a name that MAVLink can't carry.
        """
        for name in names:
            if not name or len(name) > _NAME_BYTES or not name.isascii():
                raise ValueError(f"parameter name {name!r} is not 1 to {_NAME_BYTES} ASCII characters")
            self._questions[name] = _Question(_PATIENCE_NS)
            self._readings[name] = Reading(Answer.OPEN)

    def write(self, name: str, value: Number) -> None:
        """Set a parameter that was read before, whose type is therefore known; one at a time.

        Raises: ValueError if it was not read, another is being set, or its type can't hold the value.
        """
        reading = self._readings.get(name)
        if reading is None or reading.kind is None:
            raise ValueError(f"parameter {name} was not read, so its type is not known")
        if self._write is not None:
            raise ValueError(f"parameter {name} can't be set while {self._write.name} is")
        wanted = _fitting(name, value, reading.kind)
        # An answer that is still on its way tells the old value.
        self._questions.pop(name, None)
        self._write = _Write(name, wanted, reading.kind)

    def restart(self) -> None:
        """The autopilot restarted: ask for everything again; a change under way is over, its outcome unknown."""
        if self._write is not None:
            self._finish(self._write, False, "the autopilot restarted meanwhile")
        self._last_answer_ns = None
        self.read(list(self._readings))

    @property
    def readings(self) -> Mapping[str, Reading]:
        """A copy: of each name that was asked for."""
        return dict(self._readings)

    @property
    def busy(self) -> bool:
        """Whether questions are open or a change is under way."""
        return bool(self._questions) or self._write is not None

    def take_written(self) -> list[Written]:
        """Changes that came to an end since the last call."""
        written, self._written = self._written, []
        return written

    # -- in --------------------

    def on_value(self, message: MavlinkMessage, autopilot: Autopilot, now_ns: int) -> None:
        """A PARAM_VALUE of the autopilot. Names that nobody asked for are passed over."""
        name = _name(message)
        if name not in self._readings:
            return
        self._last_answer_ns = now_ns
        value = decode_value(message, autopilot)
        if value is None:
            self.counts["parameters_unreadable"] += 1
            if name in self._questions:
                self._questions[name].unreadable = True
            return
        kind = int(message.param_type)
        self._questions.pop(name, None)
        self._readings[name] = Reading(Answer.VALUE, value, kind)
        write = self._write
        if write is None or write.name != name:
            return
        write.value = value
        if not _same(value, write.wanted):
            return  # refused, or an answer from before; the next repetition tells
        if write.echoed:
            self._finish(write, True, "")
        else:
            write.echoed = True
            write.question = _Question(_WRITE_PATIENCE_NS)

    def on_error(self, message: MavlinkMessage) -> None:
        """A PARAM_ERROR of the autopilot."""
        name = _name(message)
        if self._write is not None and self._write.name == name and not self._write.echoed:
            self._finish(self._write, False, _ERRORS.get(message.error, f"it answers with error {message.error}"))
        elif name in self._questions and message.error == dialect.MAV_PARAM_ERROR_DOES_NOT_EXIST:
            self._end(name, Answer.ABSENT)

    # -- out --------------------

    def poll(self, now_ns: int, system_id: int, autopilot: Autopilot) -> list[MavlinkMessage]:
        """What is due now; to be called at least every 50 ms."""
        out = self._poll_write(now_ns, system_id, autopilot)
        for name in [name for name, question in self._questions.items() if question.exhausted(now_ns)]:
            self._conclude(name, self._questions[name])
        self._next_ns = max(self._next_ns, now_ns - _MOST_PER_POLL * _REQUEST_INTERVAL_NS)
        for name, question in self._questions.items():
            if now_ns < self._next_ns:
                break
            if now_ns >= question.due_ns and question.attempts < len(question.patience_ns):
                question.asked(now_ns)
                self._next_ns += _REQUEST_INTERVAL_NS
                out.append(_request(name, system_id))
        return out

    def _poll_write(self, now_ns: int, system_id: int, autopilot: Autopilot) -> list[MavlinkMessage]:
        write = self._write
        if write is None or now_ns < write.question.due_ns:
            return []
        if write.question.exhausted(now_ns):
            if write.value is None:
                why = "no answer"
            elif write.echoed and _same(write.value, write.wanted):
                why = "it was accepted, but can't be read back"
            else:
                why = f"it keeps {write.value:g}"
            self._finish(write, False, why)
            return []
        write.question.asked(now_ns)
        if write.echoed:
            return [_request(write.name, system_id)]
        return [
            dialect.MAVLink_param_set_message(
                target_system=system_id,
                target_component=_AUTOPILOT_COMPONENT,
                param_id=write.name.encode(),
                param_value=encode_value(write.wanted, write.kind, autopilot),
                param_type=write.kind,
            )
        ]

    def _finish(self, write: _Write, accepted: bool, why: str) -> None:
        self._written.append(Written(write.name, write.wanted, write.value, accepted, why))
        self._write = None

    def _conclude(self, name: str, question: _Question) -> None:
        if question.unreadable:
            self._end(name, Answer.UNREADABLE)
            return
        # Silence means absence only of an autopilot that answers.
        first_ns, last_ns = question.first_ns, self._last_answer_ns
        heard = first_ns is not None and last_ns is not None and last_ns >= first_ns - _PATIENCE_NS[0]
        self._end(name, Answer.ABSENT if heard else Answer.SILENT)

    def _end(self, name: str, answer: Answer) -> None:
        del self._questions[name]
        self._readings[name] = Reading(answer)


def decode_value(message: MavlinkMessage, autopilot: Autopilot) -> Number | None:
    """The number that a PARAM_VALUE carries; None if it can't be meant."""
    kind = message.param_type
    if kind == dialect.MAV_PARAM_TYPE_REAL32:
        value = float(message.param_value)
        return value if math.isfinite(value) else None
    if kind not in _INTEGERS:
        return None
    if autopilot is Autopilot.PX4:
        if kind not in _BYTEWISE:
            return None  # PX4 has integers of 32 bits only
        # From the bytes: as a float, an integer of -1 is not a number.
        return int(struct.unpack_from(_BYTEWISE[kind], payload_of(message, 4))[0])
    value = float(message.param_value)
    low, high = _INTEGERS[kind]
    return int(value) if math.isfinite(value) and value == round(value) and low <= value <= high else None


def encode_value(value: Number, kind: int, autopilot: Autopilot) -> float:
    """What goes into the float field of a PARAM_SET."""
    if autopilot is Autopilot.PX4 and kind in _BYTEWISE:
        return float(struct.unpack("<f", struct.pack(_BYTEWISE[kind], int(value)))[0])
    return float(value)


def _fitting(name: str, value: Number, kind: int) -> Number:
    if not math.isfinite(value):
        raise ValueError(f"parameter {name} can't be set to {value}; give a finite number")
    if kind not in _INTEGERS:
        return float(value)
    low, high = _INTEGERS[kind]
    if value != round(value) or not low <= value <= high:
        raise ValueError(f"parameter {name} is a whole number from {low} to {high}, {value:g} does not fit")
    return int(value)


def _same(a: Number, b: Number) -> bool:
    """Equal as 32-bit floats, which is how reals travel; integers exactly."""
    if isinstance(a, int) and isinstance(b, int):
        return a == b
    return math.isclose(a, b, rel_tol=1e-6, abs_tol=1e-9)


def _name(message: MavlinkMessage) -> str:
    name = message.param_id
    return (name.decode("ascii", "replace") if isinstance(name, bytes) else str(name)).rstrip("\0")


def _request(name: str, system_id: int) -> MavlinkMessage:
    return dialect.MAVLink_param_request_read_message(
        target_system=system_id, target_component=_AUTOPILOT_COMPONENT, param_id=name.encode(), param_index=-1
    )
