"""What a flight with GNSS tells of the camera: how it sits, how late its stamps are, how long its lens is.

Each fix says where the camera was and how it was turned, by map and picture, nearly alone. Held against the
autopilot's attitude and the receiver's position at the stamp, what is the same in the body's axes at every heading is
the mount; what goes with the turns of the last moment, and with the speed, is time; what goes with the distance to the
ground is the focal length.

All of that is linear, and so are the errors that vary slowly: of the autopilot's attitude, of the receiver, and of the
map along the way. They are states of a Kalman filter beside the constants (first-order Gauss-Markov), with sigmas and
times that make the flight itself most probable. Without them a minute's drift of a barometer or a gyroscope would pass
for a hundred independent witnesses. What the flight does not tell keeps the sigma it began with, and says so.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from ortholoc_edge.geometry import rotation
from ortholoc_edge.geometry.arrays import FloatArray
from ortholoc_edge.geometry.camera import Camera
from ortholoc_edge.geometry.rigid import Rigid3
from ortholoc_edge.pipeline.frame import TURN_AGES_NS
from ortholoc_edge.pose.adjust import linearised

# The unknown constants, in this order, with the 1-sigma of what is known of them before: next to nothing of the first
# five. ``offset``: of the map against GNSS. ``gnss_late``: of the receiver's positions, which a filter of its own delay
# seldom hits. ``antenna``: of the receiver's from the body's reference point.
_PRIOR: dict[str, float] = {
    "roll": math.radians(20.0), "pitch": math.radians(20.0), "yaw": math.radians(20.0), "late_s": 0.5, "log_focal": 0.3,
    "offset_east_m": 30.0, "offset_north_m": 30.0, "offset_up_m": 60.0, "gnss_late_s": 0.1,
    "antenna_forward_m": 0.3, "antenna_right_m": 0.3, "antenna_down_m": 0.3,
}  # fmt: skip
_MOUNT, _LATE, _FOCAL, _OFFSET, _GNSS_LATE, _ANTENNA = slice(0, 3), 3, 4, slice(5, 8), 8, slice(9, 12)
_CONSTANTS = len(_PRIOR)
# Slow errors: attitude about east, north, up, then GNSS position along these, then the fixes' own of place and turn.
_TURNS, _PLACES, _FIXES, _STATES = slice(12, 15), slice(15, 18), slice(18, 24), 24
# Between the rows of `Sighting.turns`.
TURN_STEP_S = TURN_AGES_NS[0] * 1e-9
# What no flight tells of: 1-sigma of how well TIMESYNC and the autopilot's own stamps relate its attitudes to our
# clock; and by what the focal length's sigma is too small, since a climb is at one place, whose error of the map's
# heights passes for a longer lens (error over sigma was 1.7 rms in five simulated flights over a map of another
# season).
_CLOCKS_S, _FOCAL_FACTOR = 0.002, 2.0
# Of an attitude, rad, and a GNSS position, m, from one frame to the next: interpolation, quantisation.
_ATTITUDE_WHITE, _GNSS_WHITE = math.radians(0.05), 0.05
# Of six squared standard deviations, 0.999; what is beyond counts for less.
_MOST_NIS = {3: 16.3, 6: 22.5}
# Frames beyond these tell little more, and cost time.
_MOST_FRAMES = 300
# Of the noise, in natural logarithms: coarse, then fine, so many times around each.
_STEPS, _ROUNDS = (0.8, 0.3), 2
# Of the solution; the noise is looked for in the first two.
_MOST_STEPS, _NOISE_STEPS = 6, 2
_SMALL_TURN, _SMALL_TIME_S = math.radians(0.005), 1e-4
_MOST_LATE_S = 0.5
# Of the picture that stands for one; steps to where its rays meet the surface; and the part of a ray that must point
# down.
_GRID = (9, 7)
_SURFACE_STEPS = 3
_LEAST_FALL = 0.1


@dataclass(frozen=True, slots=True, eq=False)
class Sighting:
    """A fix and what the autopilot said at its stamp; map axes are true metres here.

    Attributes:
        map_from_camera: of the fix; covariance: (6, 6) of it.
        map_from_body: (3, 3) the autopilot's attitude.
        turns: (K, 3) how the body was turned each `TURN_STEP_S` before, against how it was at the stamp: rotation
            vectors about its axes then. One row says no more than a rate.
        gnss_map_m: (3,) of the receiver; None without. velocity_map_m_s: (3,).
        up_by_log_focal_m: by how much higher the fix is, if the lens is longer than it was told by the factor e.
    """

    stamp_ns: int
    map_from_camera: Rigid3
    covariance: FloatArray
    map_from_body: FloatArray
    turns: FloatArray
    gnss_map_m: FloatArray | None
    velocity_map_m_s: FloatArray
    up_by_log_focal_m: float

    def turn(self, age_s: float) -> FloatArray:
        """(3,) how the body was turned then. Beyond what is known it goes on turning."""
        at = np.vstack([np.zeros(3), self.turns])
        step = min(max(math.floor(age_s / TURN_STEP_S), 0), len(self.turns) - 1)
        return np.asarray(at[step] + (age_s / TURN_STEP_S - step) * (at[step + 1] - at[step]), dtype=np.float64)

    def rates_rad_s(self, age_s: float = 0.0) -> FloatArray:
        """(3,) how fast it turned then, about the body's axes."""
        half = TURN_STEP_S
        return (self.turn(age_s - half) - self.turn(age_s + half)) / (2.0 * half)


@dataclass(frozen=True, slots=True)
class Noise:
    """How errors vary, 1-sigma and time of correlation.

    Attributes:
        fixes: part of the fixes' own covariance that varies from frame to frame; fixes_slow: that varies slowly, as the
            map's errors do along the way.
        tilt, heading: of the autopilot's attitude, rad. level, height: of GNSS against the map, m.
    """

    fixes: float = 0.1
    fixes_slow: float = 0.3
    fixes_s: float = 5.0
    tilt: float = math.radians(0.3)
    tilt_s: float = 15.0
    heading: float = math.radians(0.5)
    heading_s: float = 30.0
    level: float = 0.7
    level_s: float = 20.0
    height: float = 1.0
    height_s: float = 30.0


_EXPECTED = Noise()
# How far from these it may well be, in natural logarithms. Of an error that changes its sign five times in a flight the
# flight tells little: with twice the doubt a heading came out 3.7 of its sigmas off.
_DOUBT = {name: 0.5 for name in Noise.__slots__} | {"fixes": 2.0, "fixes_slow": 2.0}


@dataclass(frozen=True, slots=True, eq=False)
class FlightCalibration:
    """The constants of `_PRIOR` as the flight tells them.

    Attributes:
        body_from_camera: the mount that agrees with it.
        values, covariance: (12,) and (12, 12), by `index`; of the first three against ``body_from_camera``: rad about
            the body's axes.
        noise: that made the flight most probable.
        frames: that took part; outlying: of these, that counted for less.
    """

    body_from_camera: Rigid3
    values: FloatArray
    covariance: FloatArray
    noise: Noise
    frames: int
    outlying: int

    @staticmethod
    def index(name: str) -> int:
        return list(_PRIOR).index(name)

    def value(self, name: str) -> float:
        return float(self.values[self.index(name)])

    def sigma(self, name: str) -> float:
        i = self.index(name)
        return float(np.sqrt(self.covariance[i, i]))


def focal_response_m(pose: Rigid3, camera: Camera, heights: Callable[[FloatArray], FloatArray]) -> float | None:
    """`Sighting.up_by_log_focal_m` of a picture of the ground: of the pose that fits best when the lens is longer than
    the solver believes. None where the ground is not in view.

    Straight down that pose is a step along the optical axis; obliquely perspective holds the height, and the attitude
    gives way, too. Of the whole step only the height is used: sideways it goes with the tilt, and with all else that
    goes with an acceleration. Taken in, five simulated flights had 0.5 % too little of the focal length, and a sigma
    of 0.24 %.

    Args:
        heights: of the surface at (N, 2); NaN where it has none. The ground is the level of their median in view: that
            of one place is a roof or a yard, which says nothing of how far the picture is away, and which roofs a fix
            was told by is not known.
    """
    columns, rows = _GRID
    px = np.stack(
        np.meshgrid(np.linspace(0, camera.width - 1, columns), np.linspace(0, camera.height - 1, rows)), axis=-1
    ).reshape(-1, 2)
    rays = camera.unproject(px) @ pose.rotation.T
    rays = rays[np.isfinite(rays).all(axis=1) & (rays[:, 2] < -_LEAST_FALL)]
    if len(rays) < len(px) // 4:
        return None
    surface = heights(pose.translation[None, :2])
    for _ in range(_SURFACE_STEPS):
        if not np.isfinite(surface).any():
            return None
        fall_m = float(pose.translation[2]) - float(np.nanmedian(surface))
        if fall_m <= 0:
            return None
        points = rays * (fall_m / -rays[:, 2])[:, None]
        surface = heights(pose.translation[:2] + points[:, :2])
    ideal = camera.pinhole()
    centred = Rigid3(pose.rotation, np.zeros(3))
    residuals, jacobian = linearised(points, np.zeros((len(points), 2)), ideal, centred)
    by_focal = residuals - (camera.cx, camera.cy)
    flat = jacobian.reshape(-1, 6)
    # Seen larger by the longer lens; the pose gives way so that its own projections grow alike.
    try:
        return float(np.linalg.solve(flat.T @ flat, flat.T @ by_focal.ravel())[2])
    except np.linalg.LinAlgError:
        return None


def solve(flights: Sequence[Sequence[Sighting]], body_from_camera: Rigid3) -> FlightCalibration:
    """The constants, from the sightings of one or more flights with the same camera and settings.

    Args:
        body_from_camera: the mount as it was configured.
    """
    thinned = _thinned(flights)
    mount, noise = body_from_camera, _EXPECTED
    late_s = 0.0
    # In steps: within the time that stamps are late the vehicle turns now faster, now slower.
    for number in range(_MOST_STEPS):
        rows = [[_Row.of(one, mount, late_s) for one in flight] for flight in thinned]
        if number < _NOISE_STEPS:
            noise = _most_probable(rows, noise, _STEPS[number:])
        found = _filtered(rows, noise)
        turned, later_s = found.mean[_MOUNT], float(found.mean[_LATE])
        mount = Rigid3(rotation.exp(turned) @ mount.rotation, mount.translation)
        late_s = min(max(late_s + later_s, -_MOST_LATE_S), _MOST_LATE_S)
        if float(np.linalg.norm(turned)) < _SMALL_TURN and abs(later_s) < _SMALL_TIME_S:
            break
    values = found.mean[:_CONSTANTS].copy()
    values[_MOUNT], values[_LATE] = 0.0, late_s
    covariance = found.covariance[:_CONSTANTS, :_CONSTANTS].copy()
    covariance[_LATE, _LATE] += _CLOCKS_S**2
    covariance[_FOCAL, :] *= _FOCAL_FACTOR
    covariance[:, _FOCAL] *= _FOCAL_FACTOR
    return FlightCalibration(
        mount, values, covariance, noise, sum(map(len, thinned)), found.outlying
    )


def _thinned(flights: Sequence[Sequence[Sighting]]) -> list[list[Sighting]]:
    every = max(1, math.ceil(sum(map(len, flights)) / _MOST_FRAMES))
    return [list(flight[::every]) for flight in flights]


# -- the filter ----------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class _Row:
    """A sighting as a linear measurement of the state.

    Attributes:
        measured: (6,) of place, m, and turn, rad, in map axes; (3,) of the turn alone without GNSS.
        by_state: (6 or 3, 24). covariance: of the fix alone.
    """

    stamp_ns: int
    measured: FloatArray
    by_state: FloatArray
    covariance: FloatArray

    @staticmethod
    def of(one: Sighting, mount: Rigid3, late_s: float) -> _Row:
        """Against the mount and the lateness that are known so far."""
        fix, body = one.map_from_camera, one.map_from_body @ rotation.exp(one.turn(late_s))
        predicted = body @ mount.rotation
        measured = np.zeros(6)
        measured[3:] = rotation.log(fix.rotation @ predicted.T)
        by_state = np.zeros((6, _STATES))
        by_state[3:, _MOUNT] = body
        # At the exposure it had not turned, and flown, so far yet.
        by_state[3:, _LATE] = -body @ one.rates_rad_s(late_s)
        by_state[:3, _LATE] = -one.velocity_map_m_s
        by_state[2, _FOCAL] = one.up_by_log_focal_m
        by_state[3:, _TURNS] = -np.eye(3)
        # The fix's errors of place and turn go together, and its covariance tells how.
        by_state[:, _FIXES] = np.linalg.cholesky(one.covariance)
        if one.gnss_map_m is None:
            return _Row(one.stamp_ns, measured[3:], by_state[3:], one.covariance[3:, 3:])
        reference = fix.translation - fix.rotation @ mount.rotation.T @ mount.translation
        measured[:3] = reference - (one.gnss_map_m - one.velocity_map_m_s * late_s)
        by_state[:3, _OFFSET] = np.eye(3)
        by_state[:3, _GNSS_LATE] = one.velocity_map_m_s
        by_state[:3, _ANTENNA] = -body
        by_state[:3, _PLACES] = -np.eye(3)
        return _Row(one.stamp_ns, measured, by_state, one.covariance)


@dataclass(frozen=True, slots=True, eq=False)
class _Filtered:
    """The state after all rows; ``score``: logarithm of how probable they are."""

    mean: FloatArray
    covariance: FloatArray
    score: float
    outlying: int


def _filtered(flights: Sequence[Sequence[_Row]], noise: Noise) -> _Filtered:
    sigma = np.array(
        [noise.tilt, noise.tilt, noise.heading, noise.level, noise.level, noise.height]
        + [math.sqrt(noise.fixes_slow)] * 6
    )
    times_s = np.array(
        [noise.tilt_s, noise.tilt_s, noise.heading_s, noise.level_s, noise.level_s, noise.height_s]
        + [noise.fixes_s] * 6
    )
    slow = slice(_CONSTANTS, _STATES)
    mean = np.zeros(_STATES)
    covariance = np.zeros((_STATES, _STATES))
    covariance[:_CONSTANTS, :_CONSTANTS] = np.diag(np.square(list(_PRIOR.values())))
    white = np.diag(np.square([_GNSS_WHITE] * 3 + [_ATTITUDE_WHITE] * 3))
    kept = np.ones(_STATES)
    growing = np.arange(_CONSTANTS, _STATES)
    score, outlying = 0.0, 0
    for flight in flights:
        # Another flight: the slow errors have nothing to do with those of the last.
        mean[slow] = 0.0
        covariance[slow, :] = covariance[:, slow] = 0.0
        covariance[slow, slow] = np.diag(sigma**2)
        last_ns: int | None = None
        for row in flight:
            if last_ns is not None:
                kept[slow] = np.exp(-max(row.stamp_ns - last_ns, 0) * 1e-9 / times_s)
                mean = mean * kept
                covariance = covariance * (kept[:, None] * kept)
                covariance[growing, growing] += sigma**2 * (1.0 - kept[slow] ** 2)
            last_ns = row.stamp_ns
            count = len(row.measured)
            own = noise.fixes * row.covariance + white[-count:, -count:]
            off = row.measured - row.by_state @ mean
            across = covariance @ row.by_state.T
            spread = row.by_state @ across + own
            inverse = np.linalg.inv(spread)
            nis = float(off @ inverse @ off)
            if nis > _MOST_NIS[count]:
                outlying += 1
                spread = spread + own * (nis / _MOST_NIS[count] - 1.0)
                inverse = np.linalg.inv(spread)
                nis = float(off @ inverse @ off)
            gain = across @ inverse
            mean = mean + gain @ off
            covariance = covariance - gain @ across.T
            covariance = 0.5 * (covariance + covariance.T)
            score -= 0.5 * (nis + math.log(np.linalg.det(spread)))
    return _Filtered(mean, covariance, score, outlying)


def _most_probable(flights: Sequence[Sequence[_Row]], start: Noise, steps: Sequence[float]) -> Noise:
    """The noise of which the measurements, and what is known of it, are most probable: one figure after another, in
    steps that get smaller."""
    best, best_score = start, _filtered(flights, start).score + _expected_score(start)
    for step, _ in product(steps, range(_ROUNDS)):
        before = best_score
        for name in Noise.__slots__:
            for sign in (1.0, -1.0):
                candidate = replace(best, **{name: getattr(best, name) * math.exp(sign * step)})
                score = _filtered(flights, candidate).score + _expected_score(candidate)
                if score > best_score:
                    best, best_score = candidate, score
                    break
        if best_score - before < 0.5:
            break
    return best


def _expected_score(noise: Noise) -> float:
    return -0.5 * sum(
        (math.log(getattr(noise, name) / getattr(_EXPECTED, name)) / _DOUBT[name]) ** 2 for name in Noise.__slots__
    )
