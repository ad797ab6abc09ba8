"""When a fix goes out, and as what: once as it is, held to a constant age, or carried on to now several times a second.

Times a fix was measured at and sent at are far apart, by 0.1 to 0.5 s, and ArduPilot can't be told: it takes the least
delay seen lately for the transport's and only believes what a message is late beyond it (contract 2.6). So the default
is to carry the fix on to the moment it is sent:

    position(now) = fix + odometry(now) - odometry(capture)

- The odometry is the integral of the autopilot's velocity (`state.AutopilotState.odometry_ned_m`), not the difference
  of two of its positions. Its position takes in our own fixes: what an earlier one corrected between this capture and
  now would be in the difference, though this fix knows of it already, and be counted twice. With a filter that corrects
  by half each time, 0.5 s of latency and 10 Hz that is an oscillation. A reset of position is no motion either, while
  velocity goes on.
- Attitude goes along: the fix's, turned by what the autopilot turned since (both on the sphere, at the two times), so
  heading stays the map's.
- Repeats of a fix are the fix, not new measurements, and both filters take whatever comes for independent. So all
  estimates made of one fix share its information: see `shares`. With a usual number N of them each has N + 1 times
  the variance, whose sum of information is that of one fix, or a little less, however long the repeating goes on. To
  it belongs the error of the displacement, which is multiplied as well: the filter made the velocity it came from, so
  each repeat is correlated with its state.
- A filter takes a sigma beyond its bound (10 m in ArduPilot before 4.7) for the bound. So where the parts of a fix
  would be as small as that, fewer are made, each with more of it, and then none.
- It ends when no new fix came for ``max_repeat_s``, the odometry's epoch or the origin changes.
- A fix that can't be carried on goes once, as it was at its capture, with that stamp. An ArduPilot that was told of no
  latency takes it for new, so what the vehicle may have flown since is added to its sigma. Without this an autopilot
  that has no position yet, and hence tells no velocity, would never get its first.

What this costs: the filter's own gate is wider by the square root of that number, so that it catches less of what our
gate let through. Floors of the receiver (VISO_POS_M_NSE, EKF2_EVP_NOISE, EKF2_AGPn_NOISE) only ever add.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from statistics import median

import numpy as np

from ortholoc_edge.adapters.mavlink.estimates import VisionEstimate, horizontal_sigma_m, yaw_sigma_rad
from ortholoc_edge.adapters.mavlink.geodesy import Place, moved
from ortholoc_edge.adapters.mavlink.options import LinkOptions
from ortholoc_edge.adapters.mavlink.state import AutopilotState
from ortholoc_edge.geometry.arrays import FloatArray

_MS, _S = 1_000_000, 1_000_000_000

# Error of the displacement: the tracker's defaults of the horizontal, for the same odometry. Here it spans no more than
# the time of a fix, in which a barometer tells the vertical no better.
_ODOMETRY_RATIO = 0.03
_ODOMETRY_DRIFT_M_PER_S = 0.2
# The tracker's, too: where the autopilot tells no velocity, a vehicle in the air may fly as fast.
_UNKNOWN_SPEED_M_PER_S = 15.0
# Of the autopilot's attitude relative to a moment before: its gyroscopes' noise, and what it corrects by the compass.
_ATTITUDE_DRIFT_RAD_PER_S = math.radians(0.3)
# Two fixes that the displacement between them contradicts, in a row, and it is not used until five agree: a heading
# that is 180 degrees off carries each fix the wrong way.
_CONTRADICTION_SIGMAS = 5.0
_CONTRADICTIONS, _AGREEMENTS = 2, 5
_COMPARE_NS = 5 * _S
# The age beyond which a fix is not sent where the owner names none, as `[timing] max_age_ms`; and how late one may be
# that is held to an age.
MAX_AGE_MS = 1000.0
_HELD_LATE_NS = 250 * _MS
# ArduPilot drops what comes within 20 ms of the one before.
_LEAST_GAP_NS = 25 * _MS
# Held fixes: more than these are never under way, unless time stands still.
_HELD = 16

Look = Callable[[int], AutopilotState | None]


@dataclass(frozen=True, slots=True, eq=False)
class Outgoing:
    """An estimate to send now, the capture time of the fix it was made of, and how many were made of it before."""

    estimate: VisionEstimate
    capture_ns: int
    repeat: int


@dataclass(slots=True, eq=False)
class _Taken:
    estimate: VisionEstimate
    arrival_ns: int
    origin: object
    released: int = 0
    share: float | None = None  # of each estimate, where it must be more than usual


@dataclass(frozen=True, slots=True)
class _Spent:
    """What a fix knows was all told."""


def shares(expected: int, index: int) -> float:
    """The part of a fix's information for the estimate ``index`` (from 0) made of it, where ``expected`` are usual.

    The usual ones get equal parts, 1 / (expected + 1); those beyond share the part that is left as 1/2, 1/6, 1/12 ...
    of it, which add up to 1 only after infinitely many: the sum is below 1 whenever it ends.
    """
    part = 1.0 / (expected + 1)
    beyond = index - expected + 1
    return part if beyond <= 0 else part / (beyond * (beyond + 1))


class Release:
    """What goes out between fixes. Pure: the owner (the link's thread, under its lock) tells the time and looks up.

    Attributes:
        believed: the largest sigmas that the autopilot believes, of position, m, and of yaw, rad (`Outlet.believed`).
        counts: ``carried`` and ``repeated`` (estimates carried on: of new fixes, and again), ``raw_instead`` (fixes
            sent as they are because they could not be carried on), ``repeats_broken`` (ended by an epoch, an origin),
            ``repeats_ended`` (no new fix), ``repeats_fewer`` (more would have had sigmas beyond what is believed),
            ``contradicted`` (displacements that two fixes contradict),
            ``bad_capture_stamps``, ``late_for_release``, ``too_old`` (dropped: a line that was choked or away).
    """

    def __init__(self, options: LinkOptions, max_age_ms: float = MAX_AGE_MS) -> None:
        """
        Args:
            max_age_ms: a fix goes out for the first time no older than this; where it is held to an age, no older
                than that and a little.
        """
        self.believed = (math.inf, math.inf)
        self.mode = options.way_of_release
        self.counts: Counter[str] = Counter()
        self._period_ns = round(_S / options.estimate_rate_hz) if options.estimate_rate_hz > 0.0 else 0
        self._max_repeat_ns = round(options.max_repeat_s * _S)
        self._latency_ns = round(options.fixed_latency_ms * _MS)
        self._max_age_ns = round(max_age_ms * _MS)
        if self.mode == "fixed-latency":
            self._max_age_ns = max(self._max_age_ns, self._latency_ns + _HELD_LATE_NS)
        self._held: deque[_Taken] = deque(maxlen=_HELD)
        self._fix: _Taken | None = None
        self._next_ns = self._sent_ns = 0
        self._intervals_ns: deque[int] = deque(maxlen=5)
        self._newest: _Taken | None = None
        self._in_doubt = False
        self._streak = 0

    @property
    def displacement_trusted(self) -> bool:
        """Whether the autopilot's displacement agrees with the fixes."""
        return not self._in_doubt

    def take(self, estimate: VisionEstimate, now_ns: int, look: Look) -> int:
        """Hand a new fix over. Returns how many before it were dropped and never sent."""
        newest = self._newest
        if estimate.stamp_ns > now_ns or (newest is not None and estimate.stamp_ns <= newest.estimate.stamp_ns):
            # A camera's clock that stepped; the wall clock does not matter here.
            self.counts["bad_capture_stamps"] += 1
            return 1
        state = look(estimate.stamp_ns)
        taken = _Taken(estimate, now_ns, estimate.origin or (None if state is None else state.origin))
        if newest is not None:
            self._intervals_ns.append(min(now_ns - newest.arrival_ns, self._max_repeat_ns))
            self._compare(newest.estimate, estimate, look)
        self._newest = taken
        if self.mode == "fixed-latency":
            dropped = int(len(self._held) == _HELD)
            self._held.append(taken)
            if now_ns - estimate.stamp_ns > self._latency_ns:
                self.counts["late_for_release"] += 1
            return dropped
        dropped = int(self._fix is not None and self._fix.released == 0)
        self._fix = taken
        return dropped

    def next_ns(self) -> int | None:
        """When `due` will have something, as far as is known now; None: not before the next fix."""
        if self.mode == "fixed-latency":
            return self._held[0].estimate.stamp_ns + self._latency_ns if self._held else None
        if self._fix is None:
            return None
        return 0 if self.mode == "raw" else self._turn_ns(self._fix)

    def due(self, now_ns: int, look: Look) -> Outgoing | None:
        """What is to be sent now, if anything."""
        if self.mode == "fixed-latency":
            while self._held and self._is_too_old(self._held[0], now_ns):
                self._held.popleft()
            ripe = self._held and now_ns >= self._held[0].estimate.stamp_ns + self._latency_ns
            return _as_it_is(self._held.popleft()) if ripe else None
        fix = self._fix
        if fix is None:
            return None
        if fix.released == 0 and self._is_too_old(fix, now_ns):
            self._fix = None
            return None
        if self.mode == "raw":
            self._fix = None
            return _as_it_is(fix)
        return self._due_carried(fix, now_ns, look)

    def _turn_ns(self, fix: _Taken) -> int:
        """When the next estimate of a fix may go. A new fix goes at once and takes the turn that comes next, so that as
        many go in a second as without it; but no two turns ahead, and not so close that ArduPilot drops it."""
        if fix.released > 0:
            return self._next_ns
        return max(self._next_ns - self._period_ns, self._sent_ns + min(self._period_ns, _LEAST_GAP_NS))

    def _is_too_old(self, fix: _Taken, now_ns: int) -> bool:
        is_old = now_ns - fix.estimate.stamp_ns > self._max_age_ns
        self.counts["too_old"] += is_old
        return is_old

    def _due_carried(self, fix: _Taken, now_ns: int, look: Look) -> Outgoing | None:
        if now_ns < self._turn_ns(fix):
            return None
        if now_ns - fix.arrival_ns > self._max_repeat_ns and fix.released > 0:
            self.counts["repeats_ended"] += 1
            self._fix = None
            return None
        # On its raster, but not two at once where the loop fell behind: ArduPilot drops what comes within 20 ms.
        if now_ns - self._next_ns >= self._period_ns:
            self._next_ns = now_ns
        self._sent_ns = now_ns
        self._next_ns += self._period_ns
        if self._next_ns - now_ns < self._period_ns // 2:
            self._next_ns += self._period_ns
        carried = self._carried(fix, now_ns, look)
        if isinstance(carried, _Spent):
            self.counts["repeats_fewer"] += 1
            self._fix = None
            return None
        if carried is None:
            self._fix = None
            if fix.released > 0:
                self.counts["repeats_broken"] += 1
                return None
            self.counts["raw_instead"] += 1
            return Outgoing(_late(fix.estimate, now_ns, look(now_ns)), fix.estimate.stamp_ns, 0)
        self.counts["repeated" if fix.released else "carried"] += 1
        fix.released += 1
        return Outgoing(carried, fix.estimate.stamp_ns, fix.released - 1)

    def _expected(self) -> int:
        """How many estimates one fix usually gives; before that is known, the most there may be."""
        typical_ns = median(self._intervals_ns) if self._intervals_ns else self._max_repeat_ns
        return max(1, math.ceil(typical_ns / self._period_ns - 1e-9))

    def _share(self, fix: _Taken, estimate: VisionEstimate) -> float | _Spent:
        """The part of the fix's information for the next estimate of it, ``estimate`` before it is divided.

        A filter that bounds sigmas would take a larger one for the bound, and believe more than we say. So no part is
        so small: fewer estimates are made, the first of them even of the whole fix.
        """
        most_m, most_rad = self.believed
        needed = max((horizontal_sigma_m(estimate) / most_m) ** 2, (yaw_sigma_rad(estimate) / most_rad) ** 2)
        needed *= 1.0 + 1e-9  # so that rounding does not lift a sigma over its bound
        if fix.released == 0 and shares(self._expected(), 0) < needed:
            fix.share = 1.0 / max(1, math.floor(1.0 / needed))
        if fix.share is None:
            share = shares(self._expected(), fix.released)
            return share if share >= needed else _Spent()
        spent = fix.released and (fix.share < needed or (fix.released + 1) * fix.share > 1.0 + 1e-9)
        return _Spent() if spent else fix.share

    def _carried(self, fix: _Taken, now_ns: int, look: Look) -> VisionEstimate | _Spent | None:
        # Both looked up now, so that both are related to our clock in the same way.
        then, now = look(fix.estimate.stamp_ns), look(now_ns)
        if self._in_doubt or then is None or now is None or now.origin != fix.origin:
            return None
        step = displacement(then, now)
        if step is None or then.ned_from_body is None or now.ned_from_body is None:
            return None
        elapsed_s = (now_ns - fix.estimate.stamp_ns) / _S
        whole = replace(fix.estimate, covariance=fix.estimate.covariance + _noise(step, elapsed_s))
        share = self._share(fix, whole)
        if isinstance(share, _Spent):
            return share
        return replace(
            fix.estimate,
            stamp_ns=now_ns,
            # The displacement is in true metres, the position in the autopilot's, which differ by up to 0.7 %: 7 cm
            # in 10 m. The place follows the position, where there are both.
            position_ned_m=None if fix.estimate.position_ned_m is None else fix.estimate.position_ned_m + step,
            place=None if fix.estimate.place is None else _moved(fix.estimate.place, step),
            ned_from_body=_turned(fix.estimate.ned_from_body, then.ned_from_body, now.ned_from_body),
            covariance=whole.covariance / share,
        )

    def _compare(self, old: VisionEstimate, new: VisionEstimate, look: Look) -> None:
        """Whether the displacement between two fixes is the autopilot's."""
        elapsed_ns = new.stamp_ns - old.stamp_ns
        then, now = look(old.stamp_ns), look(new.stamp_ns)
        if then is None or now is None or elapsed_ns > _COMPARE_NS or old.reset_counter != new.reset_counter:
            return
        step = displacement(then, now)
        if step is None or then.origin != now.origin or old.position_ned_m is None or new.position_ned_m is None:
            return
        covariance = (old.covariance + new.covariance + _noise(step, elapsed_ns / _S))[:2, :2]
        error = (new.position_ned_m - old.position_ned_m - step)[:2]
        agrees = float(error @ np.linalg.solve(covariance, error)) <= _CONTRADICTION_SIGMAS**2
        self.counts["contradicted"] += not agrees
        # Counted against what is believed now: a streak that is long enough turns it over.
        self._streak = self._streak + 1 if agrees is self._in_doubt else 0
        if self._streak >= (_AGREEMENTS if self._in_doubt else _CONTRADICTIONS):
            self._in_doubt = not self._in_doubt
            self._streak = 0


def displacement(then: AutopilotState, now: AutopilotState) -> FloatArray | None:
    """(3,) NED m from one state to another by the autopilot's velocity; None where it is not known throughout."""
    if then.odometry_ned_m is None or now.odometry_ned_m is None or then.odometry_epoch != now.odometry_epoch:
        return None
    step: FloatArray = now.odometry_ned_m - then.odometry_ned_m
    return step


def _turned(fix: FloatArray, then: FloatArray, now: FloatArray) -> FloatArray:
    """The fix's attitude now, (3, 3): where it differs from the autopilot's, it does so by the same turn about the
    axes of NED, as an error of heading does."""
    turned: FloatArray = fix @ then.T @ now
    return turned


def _moved(place: Place, step: FloatArray) -> Place:
    latitude_deg, longitude_deg, height_amsl_m = moved(
        place.latitude_deg, place.longitude_deg, place.height_amsl_m, step
    )
    ellipsoid_m = None if place.height_ellipsoid_m is None else place.height_ellipsoid_m - float(step[2])
    return Place(latitude_deg, longitude_deg, height_amsl_m, ellipsoid_m)


def _noise(step: FloatArray, elapsed_s: float) -> FloatArray:
    """(6, 6): what a displacement adds. Drift grows with time, an error of scale or heading with distance."""
    variance = (_ODOMETRY_RATIO * float(np.linalg.norm(step))) ** 2 + (_ODOMETRY_DRIFT_M_PER_S * elapsed_s) ** 2
    return np.diag([variance] * 3 + [(_ATTITUDE_DRIFT_RAD_PER_S * elapsed_s) ** 2] * 3)


def _late(estimate: VisionEstimate, now_ns: int, state: AutopilotState | None) -> VisionEstimate:
    """A fix as it was at its capture, for a filter that may take it for where the vehicle is now."""
    if state is None:
        return estimate
    if state.velocity_ned is not None:
        speed_m_s = float(np.linalg.norm(state.velocity_ned))
    else:
        speed_m_s = _UNKNOWN_SPEED_M_PER_S if state.armed and not state.landed else 0.0
    flown_m = speed_m_s * (now_ns - estimate.stamp_ns) / _S
    return replace(estimate, covariance=estimate.covariance + np.diag([flown_m**2] * 3 + [0.0] * 3))


def _as_it_is(taken: _Taken) -> Outgoing:
    return Outgoing(taken.estimate, taken.estimate.stamp_ns, 0)
