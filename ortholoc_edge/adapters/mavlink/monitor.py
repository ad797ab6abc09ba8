"""What the autopilot's filter did with our fixes: a state machine over what it tells; pure.

Neither filter says so. ArduPilot's EKF_STATUS_REPORT and PX4's ESTIMATOR_STATUS know one test ratio for all position
sources and whether there is an absolute position, not whose. So three things are looked at together: ratio and flags;
where the autopilot's position lies between our fixes and GNSS, where these differ; and without GNSS, whether a
position that is off moves toward the fixes by more than the velocity accounts for. What the filter says in STATUSTEXT
("EKF3 IMU0 is using external nav data") decides where none of these can.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from ortholoc_edge.adapters.mavlink.codec import dialect
from ortholoc_edge.adapters.mavlink.estimates import Autopilot, VisionEstimate, horizontal_sigma_m
from ortholoc_edge.adapters.mavlink.geodesy import ned_from_geodetic
from ortholoc_edge.adapters.mavlink.sinks import earth_model
from ortholoc_edge.adapters.mavlink.state import AutopilotState
from ortholoc_edge.geometry.arrays import FloatArray

_MS, _S = 1_000_000, 1_000_000_000

# A verdict must last this long before it is the state; and a state is kept where nothing is known for less.
_HOLD_NS = 2 * _S
# Without an estimate sent for so long there is nothing to judge.
_SENT_FRESH_NS = 3 * _S
# The filter's answer to a fix is looked for between these times after it was sent. ArduPilot fuses what is
# VISO_DELAY_MS old at once, PX4 after EKF2_DELAY_MAX (200 ms).
_ANSWER_NS = 700 * _MS
_PROBE_EVERY_NS = 300 * _MS
_PROBES_NS = 10 * _S
_PROBES_NEEDED = 5
# Refused above 1. Once refused, accepted below the second: a ratio that wavers is a filter about to refuse.
_REFUSED_RATIO, _ACCEPTED_RATIO = 1.0, 0.8
# Less apart than this, or than two sigmas of a fix, the position is where the fixes are.
_APART_M, _APART_SIGMAS = 1.0, 2.0
# Part of the distance to the fixes that a filter goes in `_ANSWER_NS` if it takes them. One that takes none goes as its
# velocity says, so that what is left is the error of integrating it, centimetres.
_ANSWERS = 0.08
# Between fixes (0) and GNSS (1): nearer to which.
_AT_FIXES, _AT_GNSS = 0.35, 0.65
_POSITION_FLAG = dialect.ESTIMATOR_POS_HORIZ_ABS  # bit 4 with both
_CONSTANT_FLAG = dialect.ESTIMATOR_CONST_POS_MODE  # bit 7 with both
_UNINITIALISED_FLAG = dialect.EKF_UNINITIALIZED  # ArduPilot's bit 10, PX4's GPS_GLITCH

_SILENT = "the autopilot is silent"

Look = Callable[[int], AutopilotState | None]


class Fusion(StrEnum):
    """FUSED: its position follows the fixes. IGNORED: it goes on without them. REJECTED: its gate refuses them."""

    UNKNOWN = "unknown"
    FUSED = "fused"
    IGNORED = "ignored"
    REJECTED = "rejected"


@dataclass(frozen=True, slots=True)
class FusionReport:
    """The state, since when (our clock, when it first showed), and the probable reason."""

    state: Fusion
    since_ns: int
    reason: str


_Verdict = tuple[Fusion, str]


@dataclass(slots=True, eq=False)
class _Probe:
    """One fix and what the autopilot's horizontal position did: (2,) NED m, all relative to the fix."""

    sent_ns: int
    sigma_m: float
    toward_m: FloatArray  # from the position to the fix
    gnss_m: FloatArray | None  # from the fix to GNSS
    moved_m: FloatArray | None = None  # by the filter, beyond its velocity, within `_ANSWER_NS`
    answered: bool = False


class FusionMonitor:
    """Used by one thread, or under its owner's lock. The owner calls `sent` for every estimate, `heard` for every
    STATUSTEXT of the autopilot, and `assess` about twice a second."""

    def __init__(self) -> None:
        self._probes: deque[_Probe] = deque(maxlen=64)
        self._last_sent_ns: int | None = None
        self._first_sent_ns: int | None = None
        self._said: str | None = None
        self._report = FusionReport(Fusion.UNKNOWN, 0, "no fix was sent yet")
        self._candidate = self._report

    @property
    def report(self) -> FusionReport:
        return self._report

    def sent(self, estimate: VisionEstimate, now_ns: int, look: Look, autopilot: Autopilot) -> None:
        """An estimate was sent. ``look``: the autopilot's state at a stamp of our clock."""
        if self._last_sent_ns is None or now_ns - self._last_sent_ns > _SENT_FRESH_NS:
            self._first_sent_ns = now_ns
            self._probes.clear()
        self._last_sent_ns = now_ns
        if self._probes and now_ns - self._probes[-1].sent_ns < _PROBE_EVERY_NS:
            return
        state = look(estimate.stamp_ns)
        if state is None or state.local_position_ned_m is None or estimate.position_ned_m is None:
            return
        gnss = None
        if state.gnss is not None and state.origin is not None:
            place = state.gnss
            gnss = ned_from_geodetic(
                state.origin, place.latitude_deg, place.longitude_deg, place.height_amsl_m, earth_model(autopilot)
            )
            gnss = (gnss - estimate.position_ned_m)[:2]
        toward = (estimate.position_ned_m - state.local_position_ned_m)[:2]
        self._probes.append(_Probe(now_ns, horizontal_sigma_m(estimate), toward, gnss))

    def heard(self, text: str) -> None:
        """A STATUSTEXT of the autopilot."""
        lowered = text.lower()
        if "is using external nav" in lowered:
            self._said = "vision"
        elif "is using gps" in lowered:
            self._said = "gnss"
        elif "stopped aiding" in lowered or "source set" in lowered:
            self._said = None

    def silent(self, now_ns: int) -> FusionReport:
        """The autopilot is not heard: nothing that was seen before is known of now."""
        self._probes.clear()
        self._said = None
        if self._report.state is not Fusion.UNKNOWN or self._report.reason != _SILENT:
            self._report = self._candidate = FusionReport(Fusion.UNKNOWN, now_ns, _SILENT)
        return self._report

    def assess(self, now_ns: int, look: Look, autopilot: Autopilot) -> FusionReport:
        """The state now."""
        for probe in self._probes:
            if not probe.answered and now_ns - probe.sent_ns >= _ANSWER_NS + 100 * _MS:
                probe.answered = True
                probe.moved_m = _moved(look(probe.sent_ns), look(probe.sent_ns + _ANSWER_NS))
        while self._probes and now_ns - self._probes[0].sent_ns > _PROBES_NS:
            self._probes.popleft()
        state, reason = self._judge(now_ns, look(now_ns), autopilot)
        if state is not self._candidate.state:
            self._candidate = FusionReport(state, now_ns, reason)
        else:
            self._candidate = FusionReport(state, self._candidate.since_ns, reason)
        # A first verdict at once would be of a filter that is still moving to the first fix.
        if state is self._report.state or now_ns - self._candidate.since_ns >= _HOLD_NS:
            since_ns = self._report.since_ns if state is self._report.state else self._candidate.since_ns
            self._report = FusionReport(state, since_ns, reason)
        return self._report

    def _judge(self, now_ns: int, state: AutopilotState | None, autopilot: Autopilot) -> _Verdict:
        return (
            self._nothing_to_judge(now_ns, state)
            or self._by_filter(now_ns, state, autopilot)
            or self._by_position(state, autopilot)
        )

    def _nothing_to_judge(self, now_ns: int, state: AutopilotState | None) -> _Verdict | None:
        if self._last_sent_ns is None:
            return Fusion.UNKNOWN, "no fix was sent yet"
        if now_ns - self._last_sent_ns > _SENT_FRESH_NS:
            return Fusion.UNKNOWN, "no fix was sent lately"
        if state is None or state.estimator_flags is None:
            return Fusion.UNKNOWN, "the autopilot tells nothing of its filter"
        return None

    def _by_filter(self, now_ns: int, state: AutopilotState | None, autopilot: Autopilot) -> _Verdict | None:
        """By what the filter says of itself."""
        if state is None or state.estimator_flags is None or self._first_sent_ns is None:
            return None
        flags, ratio = state.estimator_flags, state.position_test_ratio
        if autopilot is Autopilot.ARDUPILOT and flags & _UNINITIALISED_FLAG:
            return Fusion.UNKNOWN, "its filter has not started"
        limit = _ACCEPTED_RATIO if self._report.state is Fusion.REJECTED else _REFUSED_RATIO
        if ratio is not None and ratio > limit:
            whose = "fixes" if state.gnss is None else "fixes, or GNSS if that is its source"
            return Fusion.REJECTED, f"its gate refuses {whose}: test ratio {ratio:.1f}"
        if (not flags & _POSITION_FLAG or flags & _CONSTANT_FLAG) and now_ns - self._first_sent_ns >= _HOLD_NS:
            return Fusion.IGNORED, f"it has no absolute position though fixes are sent: {_source_hint(autopilot)}"
        return None

    def _by_position(self, state: AutopilotState | None, autopilot: Autopilot) -> _Verdict:
        answered = [probe for probe in self._probes if probe.answered]
        if len(answered) < _PROBES_NEEDED:
            return Fusion.UNKNOWN, "too few fixes were sent to tell"
        limit_m = max(_APART_M, _APART_SIGMAS * float(np.median([probe.sigma_m for probe in answered])))
        if state is not None and state.gnss is not None:
            return _between_fixes_and_gnss(answered, limit_m, autopilot) or self._by_what_it_said(autopilot)
        return _by_answers(answered, limit_m, autopilot)

    def _by_what_it_said(self, autopilot: Autopilot) -> _Verdict:
        if self._said == "vision":
            return Fusion.FUSED, "it said that it uses external navigation"
        if self._said == "gnss":
            return Fusion.IGNORED, f"it said that it uses GNSS: {_source_hint(autopilot)}"
        return Fusion.UNKNOWN, "GNSS and fixes agree, so that it does not show which it uses"


def _between_fixes_and_gnss(probes: list[_Probe], limit_m: float, autopilot: Autopilot) -> _Verdict | None:
    """Whose the position is, where fixes and GNSS differ."""
    beside = [(-probe.toward_m, probe.gnss_m) for probe in probes if probe.gnss_m is not None]
    if len(beside) < _PROBES_NEEDED:
        return None
    position = np.median([position for position, _ in beside], axis=0)
    gnss = np.median([gnss for _, gnss in beside], axis=0)
    apart_m = float(np.linalg.norm(gnss))
    if apart_m <= limit_m:
        return None
    part = float(position @ gnss) / apart_m**2
    if part < _AT_FIXES:
        return Fusion.FUSED, f"its position follows the fixes, not GNSS, {apart_m:.1f} m away"
    if part <= _AT_GNSS:
        return None
    px4 = autopilot is Autopilot.PX4
    why = "PX4 takes vision for relative while it fuses GNSS" if px4 else _source_hint(autopilot)
    return Fusion.IGNORED, f"its position follows GNSS, {apart_m:.1f} m from the fixes: {why}"


def _by_answers(probes: list[_Probe], limit_m: float, autopilot: Autopilot) -> _Verdict:
    """Whether the position is where the fixes are, or goes there."""
    apart_m = float(np.linalg.norm(np.median([probe.toward_m for probe in probes], axis=0)))
    if apart_m <= limit_m:
        return Fusion.FUSED, "its position is where the fixes are, without GNSS"
    moved = [(probe.toward_m, probe.moved_m) for probe in probes if probe.moved_m is not None]
    if len(moved) < _PROBES_NEEDED:
        return Fusion.UNKNOWN, "too little of its position is known to tell"
    # By least squares, the part of the way to the fixes that it goes after each.
    part = sum(float(d @ m) for d, m in moved) / sum(float(d @ d) for d, _ in moved)
    if part >= _ANSWERS:
        return Fusion.FUSED, f"its position moves to the fixes, {apart_m:.1f} m away"
    return (
        Fusion.IGNORED,
        f"its position stays {apart_m:.1f} m from the fixes and does not move to them: {_source_hint(autopilot)}",
    )


def _moved(before: AutopilotState | None, after: AutopilotState | None) -> FloatArray | None:
    """(2,) what the filter moved its position by, beyond the velocity; None where that is not known.

    Over a jump too, which may be the answer (epochs of position are not looked at), but not from one origin to another.
    """
    if before is None or after is None or before.origin != after.origin:
        return None
    if before.local_position_ned_m is None or after.local_position_ned_m is None:
        return None
    if before.odometry_ned_m is None or after.odometry_ned_m is None or before.odometry_epoch != after.odometry_epoch:
        return None
    moved = after.local_position_ned_m - before.local_position_ned_m
    beyond: FloatArray = (moved - (after.odometry_ned_m - before.odometry_ned_m))[:2]
    return beyond


def _source_hint(autopilot: Autopilot) -> str:
    if autopilot is Autopilot.PX4:
        return "see EKF2_EV_CTRL bit 0, or EKF2_AGPn_ID and _CTRL"
    return "the source set in use has no EK3_SRCn_POSXY = 6, or VISO_TYPE is not 1"
