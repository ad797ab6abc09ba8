"""What became of each measurement that came from outside."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from ortholoc_edge.geometry.arrays import FloatArray


class Verdict(StrEnum):
    """What became of a vision measurement."""

    FUSED = "fused"
    STANDBY = "standby"  # another source is in use
    GATED = "gated"
    RESET = "reset"  # the position was set to it: the reset counter changed, or PX4 starts with it
    TIMEOUT_RESET = "timeout_reset"  # the position was set to it: refused for too long
    WRONG_FRAME = "wrong_frame"
    FAILED_QUALITY = "failed_quality"
    NOT_FINITE = "not_finite"
    TOO_OLD = "too_old"
    TOO_FAST = "too_fast"
    DISABLED = "disabled"  # by a parameter
    UNHEARD = "unheard"  # this firmware has no handler for the message, or none for one of its kind
    IGNORED = "ignored"  # T265: for a second after a reset
    REALIGNED = "realigned"  # VOXL: taken for where the vehicle was believed before the reset
    RELATIVE = "relative"  # PX4 beside GNSS: its bias against GNSS was estimated away
    WAITING = "waiting"  # PX4: its conditions to start are not met
    STOPPED = "stopped"  # PX4: refused for too long and too often, the source is given up


@dataclass(frozen=True, slots=True, eq=False)
class VisionRecord:
    """A measurement as it was received.

    Attributes:
        arrival_ns, capture_ns: boot times.
        position_ned_m: (3,) m, in the autopilot's frame.
        sigma_m: taken from its covariance; the larger one of both axes.
        innovation_m: horizontal, where it was tested.
        message: its name. why: of what was not fused, for people.
    """

    arrival_ns: int
    capture_ns: int
    position_ned_m: FloatArray
    sigma_m: float
    reset_counter: int
    verdict: Verdict
    innovation_m: float | None
    message: str = ""
    why: str = ""
