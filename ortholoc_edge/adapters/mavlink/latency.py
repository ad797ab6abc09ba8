"""From capture to sent: what it takes, and what the autopilot must be told of it; pure."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np

from ortholoc_edge.adapters.mavlink.estimates import Autopilot

_MS = 1_000_000

# ArduPilot's range of VISO_DELAY_MS, by which it also sizes its buffer; PX4's of EKF2_EV_DELAY and EKF2_AGPn_DELAY.
MOST_VISO_DELAY_MS, MOST_EV_DELAY_MS, MOST_AGP_DELAY_MS = 250, 300, 1000
# A delay this wrong is 0.4 m at 20 m/s. With 190 ms too little a real ArduPilot in software flew a square to 0.75 m
# instead of 0.07 m.
DELAY_SLACK_MS = 20.0
# PX4 drops TIMESYNC samples with a longer round trip. Without synchronisation it takes the time of arrival.
_PX4_MAX_ROUND_TRIP_MS = 10.0
# A change that is worth a word: beyond what one stalled frame does to the statistics.
_MATERIAL_MS, _MATERIAL_RATIO = 10.0, 0.2


class LatencyMeter:
    """Times from mid-exposure until the first bytes of a fix were handed to the line; of the last 200 fixes."""

    def __init__(self) -> None:
        self._latencies_ms: deque[float] = deque(maxlen=200)

    def __len__(self) -> int:
        return len(self._latencies_ms)

    def add(self, latency_ns: int) -> None:
        self._latencies_ms.append(latency_ns / _MS)

    def percentile_ms(self, percent: float) -> float | None:
        """None before the first fix."""
        return float(np.percentile(self._latencies_ms, percent)) if self._latencies_ms else None


@dataclass(frozen=True, slots=True)
class DelayAdvice:
    """What to set: VISO_DELAY_MS for ArduPilot; EKF2_EV_DELAY, EKF2_AGPn_DELAY and the least EKF2_DELAY_MAX for PX4.

    ``note`` says what no parameter can mend; empty if nothing.
    """

    autopilot: Autopilot
    viso_delay_ms: int
    ev_delay_ms: int
    agp_delay_ms: int
    delay_max_ms: int
    note: str = ""

    def __str__(self) -> str:
        if self.autopilot is Autopilot.ARDUPILOT:
            what = f"VISO_DELAY_MS = {self.viso_delay_ms}"
        else:
            what = (
                f"EKF2_EV_DELAY = {self.ev_delay_ms}, EKF2_AGPn_DELAY = {self.agp_delay_ms}, EKF2_DELAY_MAX at least "
                f"{self.delay_max_ms}"
            )
        return f"{what} (takes effect after a reboot){'; ' + self.note if self.note else ''}"

    def differs(self, other: DelayAdvice) -> bool:
        """Whether the change from ``other`` is worth a word."""
        pairs = (
            (self.viso_delay_ms, other.viso_delay_ms),
            (self.ev_delay_ms, other.ev_delay_ms),
            (self.agp_delay_ms, other.agp_delay_ms),
            (self.delay_max_ms, other.delay_max_ms),
        )
        return (
            self.autopilot is not other.autopilot
            or bool(self.note) != bool(other.note)
            or any(abs(a - b) > max(_MATERIAL_MS, _MATERIAL_RATIO * b) for a, b in pairs)
        )


@dataclass(frozen=True, slots=True)
class Ages:
    """How old estimates are when they arrive, in ms: the least, the usual and the most."""

    low_ms: float
    middle_ms: float
    high_ms: float


def ages_of(mode: str, meter: LatencyMeter, fixed_latency_ms: float, round_trip_ns: int | None) -> Ages | None:
    """For a mode of release; None where it must be measured, and no fix was sent yet.

    To the age at sending comes half a round trip. "fast-forward" has no age at sending, "fixed-latency" the configured
    one (but for fixes that come later), "raw" what is measured.
    """
    way_ms = 0.0 if round_trip_ns is None else round_trip_ns / _MS / 2.0
    if mode == "fast-forward":
        return Ages(way_ms, way_ms, way_ms)
    low, middle, high = (meter.percentile_ms(p) for p in (5.0, 50.0, 99.0))
    if mode == "fixed-latency":
        return Ages(fixed_latency_ms + way_ms, fixed_latency_ms + way_ms, max(fixed_latency_ms, high or 0.0) + way_ms)
    if low is None or middle is None or high is None:
        return None
    return Ages(low + way_ms, middle + way_ms, high + way_ms)


def advise(
    autopilot: Autopilot, mode: str, meter: LatencyMeter, fixed_latency_ms: float, round_trip_ns: int | None
) -> DelayAdvice | None:
    """The delays for a mode of release, measured; None before the first fix.

    - ArduPilot takes a message's stamp plus the least delay of the last hundred for its time, so a constant latency
      vanishes and VISO_DELAY_MS must hold it: the least latency (its 5th percentile) of "raw", the configured one of
      "fixed-latency", none of "fast-forward", where the transport alone is left, half a round trip.
    - PX4 relates our stamps by TIMESYNC, so EKF2_EV_DELAY is 0 in every mode; unless the round trip is 10 ms or more,
      which it does not take: then it is the age at arrival. GLOBAL_POSITION_SENSOR is always stamped on arrival, so
      EKF2_AGPn_DELAY is that age: half a round trip of "fast-forward".
    """
    ages = ages_of(mode, meter, fixed_latency_ms, round_trip_ns)
    if ages is None or not len(meter):
        return None
    way_ms = 0.0 if round_trip_ns is None else round_trip_ns / _MS / 2.0
    viso_ms = round(ages.low_ms)
    synchronised = 2.0 * way_ms < _PX4_MAX_ROUND_TRIP_MS
    ev_ms = 0 if synchronised else round(ages.middle_ms)
    notes = []
    if autopilot is Autopilot.ARDUPILOT and viso_ms > MOST_VISO_DELAY_MS + DELAY_SLACK_MS:
        notes.append(
            f"{viso_ms} ms of latency are more than the {MOST_VISO_DELAY_MS} that VISO_DELAY_MS takes, older fixes are "
            f'taken for newer; {"lower fixed_latency_ms, or " if mode == "fixed-latency" else ""}set [link] release = '
            '"fast-forward"'
        )
    if autopilot is Autopilot.PX4 and not synchronised:
        notes.append(
            f"the round trip of {2.0 * way_ms:.0f} ms is too long for PX4's time synchronisation (10 ms), so that it "
            "stamps by arrival; a faster line helps"
        )
    return DelayAdvice(
        autopilot,
        min(viso_ms, MOST_VISO_DELAY_MS),
        min(ev_ms, MOST_EV_DELAY_MS),
        min(round(ages.middle_ms), MOST_AGP_DELAY_MS),
        max(math.ceil(ages.high_ms / 10.0) * 10, ev_ms),
        "; ".join(notes),
    )
