"""Which of ArduPilot's source sets should be in use, by what the witness says of GNSS; a pure state machine."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from ortholoc_edge.adapters.mavlink.estimates import Autopilot
from ortholoc_edge.adapters.mavlink.options import LinkOptions
from ortholoc_edge.pipeline.witness import Consistency

_S = 1_000_000_000

# Between two switches. The witness has its own hysteresis; this bounds what a defect of it could do to a vehicle.
_DWELL_NS = 15 * _S


class Source(StrEnum):
    GNSS = "gnss"
    VISION = "vision"


@dataclass(frozen=True, slots=True)
class Switch:
    """Command source set ``number`` now; ``text`` tells the ground station, in 50 characters."""

    source: Source
    number: int
    text: str


class SourceSwitch:
    """Commands vision when GNSS is bad and GNSS when it is good again; nothing unless the operator enabled it.

    Only what it switched itself it switches back: an operator's choice stands. With no fresh fixes it stays as it
    is, since a bad source is no worse than none. That the command was accepted is no proof (with EK3_OPTIONS bit 3
    ArduPilot accepts it and goes on): the monitor's state is.
    """

    def __init__(self, options: LinkOptions) -> None:
        self._options = options
        self._switched_ns: int | None = None
        self._commanded = False
        self._restarts = 0

    @property
    def on_vision(self) -> bool:
        """Whether the last switch was to vision."""
        return self._commanded

    def decide(
        self, consistency: Consistency, fixes_fresh: bool, autopilot: Autopilot | None, restarts: int, now_ns: int
    ) -> Switch | None:
        """The switch to command now, if any. ``restarts``: how often the autopilot restarted, after which it uses its
        first set, or the one that the operator's switch says."""
        if restarts != self._restarts:
            self._restarts, self._commanded, self._switched_ns = restarts, False, None
        if not self._options.switch_sources or autopilot is not Autopilot.ARDUPILOT:
            return None
        if self._switched_ns is not None and now_ns - self._switched_ns < _DWELL_NS:
            return None
        if consistency is Consistency.BAD and fixes_fresh and not self._commanded:
            self._commanded, self._switched_ns = True, now_ns
            number = self._options.vision_source_set
            return Switch(Source.VISION, number, f"OrthoLoC: GNSS bad, EKF source set {number} vision")
        if consistency is Consistency.OK and self._commanded:
            self._commanded, self._switched_ns = False, now_ns
            number = self._options.gnss_source_set
            return Switch(Source.GNSS, number, f"OrthoLoC: GNSS good, EKF source set {number}")
        return None


class PendingSwitch:
    """A command on its way: said every second until it is answered, five times at most."""

    _EVERY_NS, _ATTEMPTS = 1 * _S, 5

    def __init__(self) -> None:
        self._number: int | None = None
        self._next_ns = 0
        self._left = 0

    def ask(self, number: int) -> None:
        self._number, self._next_ns, self._left = number, 0, self._ATTEMPTS

    def due(self, now_ns: int) -> int | None:
        """The number to send now, or None."""
        if self._number is None or now_ns < self._next_ns:
            return None
        if self._left == 0:
            self._number = None
            return None
        self._left -= 1
        self._next_ns = now_ns + self._EVERY_NS
        return self._number

    def answered(self) -> int | None:
        """The number that was asked for, which is not said again; None if there was none."""
        number, self._number = self._number, None
        return number
