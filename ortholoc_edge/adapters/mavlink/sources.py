"""Which of ArduPilot's source sets should be in use, by what the witness says of GNSS; a pure state machine."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from ortholoc_edge.adapters.mavlink.estimates import Autopilot
from ortholoc_edge.adapters.mavlink.options import LinkOptions
from ortholoc_edge.adapters.mavlink.parameters import Number
from ortholoc_edge.pipeline.witness import Consistency

_S = 1_000_000_000

# Between two switches. The witness has its own hysteresis; this bounds what a defect of it could do to a vehicle. Twice
# as long after each one that was not taken.
_DWELL_NS = 15 * _S
_MOST_DOUBLINGS = 4
# EK3_SRCn_POSXY of a set that takes its position from us.
_VISION = 6


class Source(StrEnum):
    GNSS = "gnss"
    VISION = "vision"


@dataclass(frozen=True, slots=True)
class Switch:
    """Command source set ``number`` now; ``text`` tells the ground station, in 50 characters, once it was taken."""

    source: Source
    number: int
    text: str


@dataclass(frozen=True, slots=True)
class Withheld:
    """A switch that must not be commanded; ``text`` says why, in 50 characters."""

    text: str


@dataclass(frozen=True, slots=True)
class Outcome:
    """What became of a commanded set. ``answer`` is a MAV_RESULT; None: there was none."""

    number: int
    accepted: bool
    answer: int | None


class SourceSwitch:
    """Commands vision when GNSS is bad and GNSS when it is good again; nothing unless the operator enabled it.

    Only what it switched itself it switches back: an operator's choice stands. A command that was never answered may
    have been carried out, so it counts as such there, and nowhere else. With no fresh fixes it stays as it is, since a
    bad source is no worse than none. That the command was accepted is no proof (with EK3_OPTIONS bit 3 ArduPilot
    accepts it and goes on): the monitor's state is.
    """

    def __init__(self, options: LinkOptions) -> None:
        self._options = options
        self._next_ns: int | None = None
        self._pending: Switch | None = None
        self._on_vision = False
        self._perhaps_on_vision = False
        self._failures = 0
        self._restarts = 0
        self._withheld_for: tuple[Number | None] | None = None

    @property
    def on_vision(self) -> bool:
        """Whether the last switch that the autopilot accepted was to vision."""
        return self._on_vision

    def decide(
        self,
        consistency: Consistency,
        fixes_fresh: bool,
        autopilot: Autopilot | None,
        restarts: int,
        now_ns: int,
        *,
        vision_posxy: Number | None,
    ) -> Switch | Withheld | None:
        """The switch to command now, if any; its outcome is to be told to :meth:`settle`.

        Args:
            fixes_fresh: whether estimates reach the autopilot.
            restarts: how often the autopilot restarted, after which it uses its first set, or the one that the
                operator's switch says.
            vision_posxy: EK3_SRCn_POSXY of the set for vision; None while it is not known.
        """
        if restarts != self._restarts:
            self._restarts, self._next_ns, self._pending = restarts, None, None
            self._on_vision = self._perhaps_on_vision = False
            self._failures, self._withheld_for = 0, None
        if not self._options.switch_sources or autopilot is not Autopilot.ARDUPILOT:
            return None
        if self._pending is not None or (self._next_ns is not None and now_ns < self._next_ns):
            return None
        if consistency is Consistency.BAD and fixes_fresh and not self._on_vision:
            number = self._options.vision_source_set
            if vision_posxy != _VISION:
                return self._withhold(number, vision_posxy)
            text = f"OrthoLoC: GNSS bad, EKF source set {number} vision"
            return self._ask(Switch(Source.VISION, number, text), now_ns)
        if consistency is Consistency.OK and (self._on_vision or self._perhaps_on_vision):
            number = self._options.gnss_source_set
            return self._ask(Switch(Source.GNSS, number, f"OrthoLoC: GNSS good, EKF source set {number}"), now_ns)
        return None

    def settle(self, outcome: Outcome, now_ns: int) -> Switch | None:
        """What became of the switch; returns it if it was accepted and is to be announced. One that was not is
        decided anew, after a pause that grows."""
        switch, self._pending = self._pending, None
        if switch is None or outcome.number != switch.number:
            return None
        if outcome.accepted:
            self._failures = 0
            self._on_vision = switch.source is Source.VISION
            self._perhaps_on_vision = False
            return switch
        self._failures += 1
        self._next_ns = now_ns + (_DWELL_NS << min(self._failures - 1, _MOST_DOUBLINGS))
        if outcome.answer is None and switch.source is Source.VISION:
            self._perhaps_on_vision = True
        return None

    def _ask(self, switch: Switch, now_ns: int) -> Switch:
        self._pending, self._next_ns = switch, now_ns + _DWELL_NS
        return switch

    def _withhold(self, number: int, posxy: Number | None) -> Withheld | None:
        """Once for each value: that it is unknown may end."""
        if self._withheld_for == (posxy,):
            return None
        self._withheld_for = (posxy,)
        found = "unknown" if posxy is None else f"is {posxy:g}, not {_VISION}"
        return Withheld(f"OrthoLoC: no switch, EK3_SRC{number}_POSXY {found}")


class PendingSwitch:
    """A command on its way: said every second until it is answered, five times at most; then its outcome."""

    _EVERY_NS, _ATTEMPTS = 1 * _S, 5

    def __init__(self) -> None:
        self._number: int | None = None
        self._next_ns = 0
        self._left = 0
        self._outcome: Outcome | None = None

    def ask(self, number: int) -> None:
        self._number, self._next_ns, self._left, self._outcome = number, 0, self._ATTEMPTS, None

    def due(self, now_ns: int) -> int | None:
        """The number to send now, or None."""
        if self._number is None or now_ns < self._next_ns:
            return None
        if self._left == 0:
            self.settle(accepted=False, answer=None)
            return None
        self._left -= 1
        self._next_ns = now_ns + self._EVERY_NS
        return self._number

    def settle(self, *, accepted: bool, answer: int | None) -> Outcome | None:
        """It is not said again; returns what :meth:`take_outcome` will, None if nothing was under way."""
        if self._number is None:
            return None
        self._outcome, self._number = Outcome(self._number, accepted, answer), None
        return self._outcome

    def take_outcome(self) -> Outcome | None:
        """Of the command that ended since the last call, if one did."""
        outcome, self._outcome = self._outcome, None
        return outcome
