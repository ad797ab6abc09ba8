"""What the vehicle's sensors say: the truth with their errors, each from a random stream of its own.

Dead reckoning is the integral of the accelerometers, turned by an attitude that errs: in tilt by little and constantly,
which leaks gravity into the horizontal, and in heading as the compass does, which turns each change of velocity. The
tilt that the autopilot shows to others wanders besides (``tilt_deg``) and is not integrated: a filter that has GNSS
learns tilt and accelerometer bias only together, so what counts is what was left of their sum when GNSS went.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ortholoc_edge.geometry import rotation
from ortholoc_edge.geometry.arrays import FloatArray
from ortholoc_sim.noise import wander
from ortholoc_sim.vehicle import GRAVITY_M_S2, Truth

_S = 1_000_000_000
_GRAVITY = np.array([0.0, 0.0, GRAVITY_M_S2])


@dataclass(frozen=True, slots=True)
class SensorOptions:
    """Errors, 1-sigma.

    Attributes:
        tilt_deg, tilt_time_s: of roll and pitch as the autopilot tells them, slowly varying.
        yaw_bias_deg: of the compass, constant, of either sign; yaw_deg varies slowly.
        gyro_bias_deg_s, gyro_noise_deg_s: of the rates, constant and white per sample.
        acceleration_bias: m/s^2 of gravity that the tilt error of dead reckoning leaks, in a random direction that
            stays as it is over ground, since gyroscopes keep it: what ten seconds of GNSS did not teach. 0.1 degrees
            are 0.018 m/s^2, which is 1 m/s and 27 m after 55 s.
        accelerometer_bias: m/s^2, fixed in the body, so that it turns with the vehicle.
        acceleration_noise: m/s per root second of flight.
        climb_m_s, climb_time_s: of the vertical velocity, slowly varying, as of barometer and accelerometer.
        gnss_m: of a GNSS position, correlated over ``gnss_time_s``. gnss_velocity_m_s: of its velocity, white.
        baro_walk_m: drift per root second. baro_noise_m: white, of each reading of the sensor.
    """

    tilt_deg: float = 0.5
    tilt_time_s: float = 15.0
    yaw_bias_deg: float = 2.0
    yaw_deg: float = 0.4
    gyro_bias_deg_s: float = 0.1
    gyro_noise_deg_s: float = 0.2
    acceleration_bias: float = 0.018
    accelerometer_bias: float = 0.01
    acceleration_noise: float = 0.03
    climb_m_s: float = 0.15
    climb_time_s: float = 8.0
    gnss_m: float = 0.6
    gnss_time_s: float = 20.0
    gnss_velocity_m_s: float = 0.15
    baro_walk_m: float = 0.05
    baro_noise_m: float = 0.15


class Imu:
    """Accelerometers and gyroscopes, strapped to the body."""

    def __init__(self, options: SensorOptions, rng: np.random.Generator) -> None:
        self._options, self._rng = options, rng
        towards = rng.uniform(0.0, 2.0 * math.pi)
        self.accelerometer_bias_m_s2 = options.accelerometer_bias * np.array(
            [math.cos(towards), math.sin(towards), 0.0]
        )
        self._gyro_bias = math.radians(options.gyro_bias_deg_s) * rng.standard_normal(3)

    def specific_force(self, acceleration_ned_m_s2: FloatArray, ned_from_body: FloatArray, dt_s: float) -> FloatArray:
        """(3,) m/s^2 in the body, the mean over ``dt_s``."""
        white = self._options.acceleration_noise / math.sqrt(dt_s) * self._rng.standard_normal(3)
        felt: FloatArray = ned_from_body.T @ (acceleration_ned_m_s2 - _GRAVITY)
        return felt + self.accelerometer_bias_m_s2 + white

    def rates(self, rates_body_rad_s: FloatArray) -> FloatArray:
        """(3,) rad/s."""
        white = math.radians(self._options.gyro_noise_deg_s) * self._rng.standard_normal(3)
        return rates_body_rad_s + self._gyro_bias + white


class Barometer:
    """Height by air pressure: drifts, and is noisy; what it says is smoothed over half a second by the autopilot."""

    _SMOOTHING_S = 0.5

    def __init__(self, options: SensorOptions, rng: np.random.Generator) -> None:
        self._options, self._rng = options, rng
        self.drift_m = 0.0
        self._smooth = 0.0

    def error(self, dt_s: float) -> float:
        """m, down, of the smoothed height after one more step."""
        o = self._options
        walk, white = self._rng.standard_normal(2)
        self.drift_m += o.baro_walk_m * math.sqrt(dt_s) * float(walk)
        self._smooth += min(1.0, dt_s / self._SMOOTHING_S) * (o.baro_noise_m * float(white) - self._smooth)
        return self.drift_m + self._smooth


class Compass:
    """The error of heading: a bias of the mounting and the field, and some wandering."""

    _TIME_S = 40.0

    def __init__(self, options: SensorOptions, rng: np.random.Generator) -> None:
        self._options, self._rng = options, rng
        self._bias = math.radians(options.yaw_bias_deg) * (1.0 if rng.random() < 0.5 else -1.0)
        self._wander = np.zeros(1)

    def error_rad(self, dt_s: float) -> float:
        """After one more step."""
        sigma = math.radians(self._options.yaw_deg)
        self._wander = wander(self._wander, sigma, self._TIME_S, dt_s, self._rng.standard_normal(1))
        return self._bias + float(self._wander[0])


@dataclass(frozen=True, slots=True, eq=False)
class GnssSample:
    """(3,) m and m/s in the autopilot's own NED, and the accuracy that the receiver claims of itself."""

    position_ned_m: FloatArray
    velocity_ned_m_s: FloatArray
    sigma_m: float
    sigma_m_s: float


class Gnss:
    """A receiver at 5 Hz.

    Attributes:
        works: whether it has a fix; without one (lost, jammed) it says so.
        noise: its errors, and the accuracy that it claims, times this.
        offset_ned_m: (3,) what a spoofer adds; the receiver believes it and claims its usual accuracy. Its velocity
            follows.
    """

    PERIOD_NS = _S // 5

    def __init__(self, options: SensorOptions, rng: np.random.Generator) -> None:
        self._options, self._rng = options, rng
        self.works = True
        self.noise = 1.0
        self.offset_ned_m: FloatArray = np.zeros(3)
        self._error = options.gnss_m * rng.standard_normal(3)
        self._next_ns = 0
        self._last: tuple[int, FloatArray] | None = None
        self._true_m = np.zeros(3)

    @property
    def sigma_m(self) -> float:
        """Accuracy that it claims; a receiver never says less than a few decimetres."""
        return max(0.3, self._options.gnss_m) * self.noise

    def step(self, now_ns: int, true_ned_m: FloatArray, velocity_ned_m_s: FloatArray, dt_s: float) -> GnssSample | None:
        """Go on; a new sample where one is due and there is a fix."""
        o = self._options
        self._error = wander(self._error, o.gnss_m, o.gnss_time_s, dt_s, self._rng.standard_normal(3))
        self._true_m = true_ned_m
        if now_ns < self._next_ns:
            return None
        self._next_ns = now_ns + self.PERIOD_NS
        sigma_m_s = o.gnss_velocity_m_s * self.noise
        white = sigma_m_s * self._rng.standard_normal(3)
        pulled = np.zeros(3)
        if self._last is not None:
            pulled = (self.offset_ned_m - self._last[1]) / max(1e-9, (now_ns - self._last[0]) / _S)
        self._last = now_ns, np.array(self.offset_ned_m)
        if not self.works:
            return None
        return GnssSample(self.position_ned_m, velocity_ned_m_s + white + pulled, self.sigma_m, sigma_m_s)

    def restart(self) -> None:
        """With the autopilot, whose clock begins anew."""
        self._next_ns, self._last = 0, None

    @property
    def position_ned_m(self) -> FloatArray:
        """(3,) where it believes to be."""
        there: FloatArray = self._true_m + self.noise * self._error + self.offset_ned_m
        return there


@dataclass(frozen=True, slots=True, eq=False)
class Readings:
    """All that the autopilot knows without anybody's help, at one step.

    Attributes:
        ned_from_body: attitude that it believes. rates_rad_s: (3,).
        velocity_ned_m_s: (3,) dead reckoned.
        down_m: by the barometer, in the autopilot's frame.
        gnss: a new sample, if there is one. has_fix: what the receiver says of itself.
    """

    ned_from_body: FloatArray
    rates_rad_s: FloatArray
    velocity_ned_m_s: FloatArray
    down_m: float
    gnss: GnssSample | None
    has_fix: bool


class SensorSuite:
    """All sensors of a vehicle; `step` moves them on with the truth.

    Attributes:
        leaning_rad: (2,) tilt error of dead reckoning about north and east.
    """

    def __init__(self, options: SensorOptions, seed: int, truth: Truth) -> None:
        self.options = options

        def stream(which: int) -> np.random.Generator:
            return np.random.default_rng([seed, 31, which])

        self._rng = stream(0)
        self.imu = Imu(options, stream(1))
        self.compass = Compass(options, stream(2))
        self.barometer = Barometer(options, stream(3))
        self.gnss = Gnss(options, stream(4))
        self._tilt = np.deg2rad(options.tilt_deg) * self._rng.standard_normal(2)
        towards = self._rng.uniform(0.0, 2.0 * math.pi)
        # About north and east, such that gravity leaks by so much.
        self.leaning_rad = options.acceleration_bias / GRAVITY_M_S2 * np.array([math.cos(towards), math.sin(towards)])
        self._climb = np.zeros(1)
        self._velocity = truth.velocity_ned_m_s.copy()
        self._true_velocity = truth.velocity_ned_m_s.copy()

    def step(
        self, now_ns: int, truth: Truth, true_ned_m: FloatArray, dt_s: float, heading_offset_rad: float = 0.0
    ) -> Readings:
        """
        Args:
            true_ned_m: (3,) the true position in the autopilot's own frame.
            heading_offset_rad: what the autopilot has added to the compass's heading.
        """
        o = self.options
        self._tilt = wander(self._tilt, np.deg2rad(o.tilt_deg), o.tilt_time_s, dt_s, self._rng.standard_normal(2))
        self._climb = wander(self._climb, o.climb_m_s, o.climb_time_s, dt_s, self._rng.standard_normal(1))
        heading_error = self.compass.error_rad(dt_s) + heading_offset_rad
        acceleration = (truth.velocity_ned_m_s - self._true_velocity) / dt_s
        self._true_velocity = truth.velocity_ned_m_s
        force = self.imu.specific_force(acceleration, truth.ned_from_body, dt_s)
        believed = rotation.exp([*self.leaning_rad, heading_error]) @ truth.ned_from_body
        self._velocity = self._velocity + (believed @ force + _GRAVITY) * dt_s
        # Vertically the barometer holds it, so that only what wanders is left.
        self._velocity[2] = truth.velocity_ned_m_s[2] + float(self._climb[0])
        return Readings(
            ned_from_body=rotation.exp([*self._tilt, heading_error]) @ truth.ned_from_body,
            rates_rad_s=self.imu.rates(truth.rates_body_rad_s),
            velocity_ned_m_s=self._velocity,
            down_m=float(true_ned_m[2]) + self.barometer.error(dt_s),
            gnss=self.gnss.step(now_ns, true_ned_m, truth.velocity_ned_m_s, dt_s),
            has_fix=self.gnss.works,
        )
