"""What happens to the satellites' signals in a simulated flight: they are lost, jammed, or pulled away by a spoofer."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Annotated, Literal

import numpy as np
from msgspec import Meta, Struct

from ortholoc_edge.geometry.arrays import FloatArray

# A jammed receiver measures so much worse before it loses the signal for good.
_JAM_NOISE = 12.0
_JAM_ONSET_S = 5.0


class GnssEvent(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One disturbance.

    Attributes:
        kind: "lost": no signal. "jammed": noise grows for 5 s, then there is none. "spoofed": the measured position
            moves away from the true one.
        from_s, until_s: since the start of the flight; without an end it lasts.
        rate_m_s, towards_deg: of "spoofed": how fast, and where to from north, clockwise.
    """

    kind: Literal["lost", "jammed", "spoofed"]
    from_s: Annotated[float, Meta(ge=0)]
    until_s: Annotated[float, Meta(gt=0)] | None = None
    rate_m_s: Annotated[float, Meta(gt=0)] = 1.0
    towards_deg: float = 90.0

    def __post_init__(self) -> None:
        if self.until_s is not None and self.until_s <= self.from_s:
            raise ValueError(f"until_s = {self.until_s:g} is not after from_s = {self.from_s:g}")

    def holds(self, t_s: float) -> bool:
        """Whether it is on at a time since the start."""
        return self.from_s <= t_s and (self.until_s is None or t_s < self.until_s)


@dataclass(frozen=True, slots=True, eq=False)
class GnssState:
    """What a receiver has: a signal or none, (3,) NED m by which it is led away, and its noise times this."""

    available: bool = True
    offset_ned_m: FloatArray = field(default_factory=lambda: np.zeros(3))
    noise: float = 1.0


def gnss_at(events: Sequence[GnssEvent], t_s: float) -> GnssState:
    """The state at a time since the start."""
    available, noise, offset = True, 1.0, np.zeros(3)
    for event in events:
        if not event.holds(t_s):
            continue
        since_s = t_s - event.from_s
        if event.kind == "spoofed":
            towards = math.radians(event.towards_deg)
            offset = offset + event.rate_m_s * since_s * np.array([math.cos(towards), math.sin(towards), 0.0])
        elif event.kind == "jammed" and since_s < _JAM_ONSET_S:
            noise = max(noise, 1.0 + (_JAM_NOISE - 1.0) * since_s / _JAM_ONSET_S)
        else:
            available = False
    return GnssState(available, offset, noise)
