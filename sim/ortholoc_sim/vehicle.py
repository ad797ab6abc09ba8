"""A multirotor as a point with an attitude, and the guidance that flies a route by whatever estimate it is given.

`Craft` is what guidance and loop know of a vehicle; `fixed_wing` has another one.

Frames: NED with true north from the world's anchor, m; body FRD. The vehicle is integrated at a fixed step.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from ortholoc_edge.geometry import rotation
from ortholoc_edge.geometry.arrays import FloatArray
from ortholoc_sim.noise import wander

GRAVITY_M_S2 = 9.80665


@dataclass(frozen=True, slots=True)
class VehicleOptions:
    """How it flies.

    Attributes:
        max_acceleration_m_s2: horizontal; with the drag it sets the tilt.
        drag_per_s: acceleration against the air per speed through it.
        tilt_time_s: of the attitude's first-order response.
        yaw_rate_rad_s: limit.
        wind_ned_m_s: mean wind. gust_m_s, gust_time_s: 1-sigma per axis and correlation time of gusts.
    """

    max_acceleration_m_s2: float = 2.5
    drag_per_s: float = 0.10
    tilt_time_s: float = 0.18
    yaw_rate_rad_s: float = 0.8
    velocity_gain_per_s: float = 1.4
    wind_ned_m_s: tuple[float, float, float] = (1.5, -1.0, 0.0)
    gust_m_s: float = 0.6
    gust_time_s: float = 4.0


@dataclass(frozen=True, slots=True, eq=False)
class Truth:
    """Where the vehicle really is: (3,) m and m/s NED, ``ned_from_body`` (3, 3), body rates rad/s (3,)."""

    position_ned_m: FloatArray
    velocity_ned_m_s: FloatArray
    ned_from_body: FloatArray
    rates_body_rad_s: FloatArray


class Craft(Protocol):
    """A vehicle that can be flown."""

    @property
    def truth(self) -> Truth:
        """A copy of the present state."""
        ...

    def step(self, dt_s: float, velocity_error_ned_m_s: FloatArray, yaw_error_rad: float) -> None:
        """Fly for ``dt_s`` so as to remove an error of velocity and of heading (wanted minus estimated)."""
        ...


class Wind:
    """A mean and gusts, which are a random process of one correlation time; weaker in the vertical."""

    def __init__(self, mean_ned_m_s: Sequence[float], gust_m_s: float, gust_time_s: float, seed: int) -> None:
        self.mean_ned_m_s = np.array(mean_ned_m_s, dtype=np.float64)
        self._spread_m_s, self._time_s = gust_m_s * np.array([1.0, 1.0, 0.4]), gust_time_s
        self._rng = np.random.default_rng([seed, 21])
        self._gust: FloatArray = np.zeros(3)

    def gust(self, dt_s: float) -> FloatArray:
        """(3,) NED m/s after one more step, without the mean."""
        self._gust = wander(self._gust, self._spread_m_s, self._time_s, dt_s, self._rng.standard_normal(3))
        return self._gust


@dataclass(slots=True)
class Vehicle:
    """State of the flight dynamics; `step` moves it on."""

    options: VehicleOptions
    position_ned_m: FloatArray
    velocity_ned_m_s: FloatArray
    yaw_rad: float
    seed: int = 0
    _down: FloatArray = field(init=False)
    _wind: Wind = field(init=False)
    _rates: FloatArray = field(init=False)
    _attitude: FloatArray = field(init=False)

    def __post_init__(self) -> None:
        o = self.options
        self._wind = Wind(o.wind_ned_m_s, o.gust_m_s, o.gust_time_s, self.seed)
        self._down = np.array([0.0, 0.0, 1.0])
        self._rates = np.zeros(3)
        self._attitude = rotation.from_euler(0.0, 0.0, self.yaw_rad)

    @property
    def truth(self) -> Truth:
        """A copy of the present state."""
        return Truth(
            self.position_ned_m.copy(), self.velocity_ned_m_s.copy(), self._attitude.copy(), self._rates.copy()
        )

    def step(self, dt_s: float, velocity_error_ned_m_s: FloatArray, yaw_error_rad: float) -> None:
        """Fly for ``dt_s`` so as to remove an error of velocity and of heading (wanted minus estimated)."""
        o = self.options
        mean = self._wind.mean_ned_m_s
        air = self.velocity_ned_m_s - mean - self._wind.gust(dt_s)
        drag = -o.drag_per_s * air
        wanted = o.velocity_gain_per_s * velocity_error_ned_m_s
        flat = float(np.hypot(wanted[0], wanted[1]))
        if flat > o.max_acceleration_m_s2:
            wanted[:2] *= o.max_acceleration_m_s2 / flat
        wanted[2] = float(np.clip(wanted[2], -2.5, 2.5))
        # The controller counters the mean drag; gusts it meets only through the velocity error.
        thrust = wanted + o.drag_per_s * (self.velocity_ned_m_s - mean)
        thrust[2] -= GRAVITY_M_S2
        direction = -thrust / np.linalg.norm(thrust)
        blend = 1.0 - float(np.exp(-dt_s / o.tilt_time_s))
        self._down = self._down + blend * (direction - self._down)
        self._down /= np.linalg.norm(self._down)
        # Thrust acts along the body's axis as it is now, with the wanted vertical part.
        lift = thrust[2] / -self._down[2]
        acceleration = -self._down * lift + drag
        acceleration[2] += GRAVITY_M_S2
        self.position_ned_m = self.position_ned_m + self.velocity_ned_m_s * dt_s + 0.5 * acceleration * dt_s**2
        self.velocity_ned_m_s = self.velocity_ned_m_s + acceleration * dt_s
        turn = float(np.clip(1.5 * yaw_error_rad, -o.yaw_rate_rad_s, o.yaw_rate_rad_s))
        self.yaw_rad = wrapped(self.yaw_rad + turn * dt_s)
        before = self._attitude
        self._attitude = attitude_of(self._down, self.yaw_rad)
        self._rates = rotation.log(before.T @ self._attitude) / dt_s


def attitude_of(body_down_ned: FloatArray, yaw_rad: float) -> FloatArray:
    """``ned_from_body`` whose z axis is ``body_down_ned`` (unit) and whose nose points to ``yaw_rad``."""
    nose = (math.cos(yaw_rad), math.sin(yaw_rad), 0.0)
    right = _cross(body_down_ned, nose)
    right /= math.sqrt(float(right @ right))
    return np.array([_cross(right, body_down_ned), right, body_down_ned]).T


def _cross(a: Sequence[float] | FloatArray, b: Sequence[float] | FloatArray) -> FloatArray:
    """Of two vectors of three: a fifth of the time that np.cross takes, at every step."""
    return np.array([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def wrapped(angle_rad: float) -> float:
    """To -pi..pi."""
    return float((angle_rad + np.pi) % (2.0 * np.pi) - np.pi)


@dataclass(slots=True)
class Guidance:
    """Flies along waypoints (N, 3) NED in the autopilot's local frame at ``speed_m_s``; hovers over the last, circles
    around it to the right where there is a ``loiter_radius_m``, or goes on to the first where the route is ``closed``.

    Corners are cut by aiming at a point ``lookahead_m`` ahead on the route.
    """

    waypoints_ned_m: FloatArray
    speed_m_s: float
    climb_m_s: float = 2.5
    lookahead_m: float = 12.0
    leg: int = 0
    closed: bool = False
    loiter_radius_m: float = 0.0
    _loiters: bool = False

    def wanted(self, position_ned_m: FloatArray) -> tuple[FloatArray, float]:
        """Velocity (3,) NED m/s and heading (rad, true) for an estimated position."""
        # Each leg once at most, whatever the route.
        for _ in range(len(self.waypoints_ned_m)):
            if self._is_last or self._along(position_ned_m) <= self._length() - self._reach():
                break
            self.leg = (self.leg + 1) % len(self.waypoints_ned_m)
        start, end = self._ends()
        length = self._length()
        if self._is_last and self.loiter_radius_m > 0.0:
            away = float(np.hypot(*(position_ned_m - end)[:2]))
            self._loiters = self._loiters or away < 1.2 * self.loiter_radius_m
            if self._loiters:
                return self._around(end, position_ned_m)
        course = (end - start) / max(length, 1e-6)
        along = self._along(position_ned_m)
        aim = start + course * min(length, max(0.0, along) + self.lookahead_m)
        to_aim = aim - position_ned_m
        flat = float(np.hypot(to_aim[0], to_aim[1]))
        speed = self.speed_m_s
        if self._is_last and self.loiter_radius_m == 0.0:  # brake for the end of the route
            speed = min(speed, 0.4 * float(np.hypot(*(end - position_ned_m)[:2])))
        velocity = np.zeros(3)
        if flat > 1e-3:
            velocity[:2] = to_aim[:2] / flat * speed
        velocity[2] = float(np.clip(0.6 * to_aim[2], -self.climb_m_s, self.climb_m_s))
        return velocity, float(np.arctan2(course[1], course[0]))

    def _around(self, centre: FloatArray, position_ned_m: FloatArray) -> tuple[FloatArray, float]:
        """Along the circle, and back to it the more the farther off."""
        out = position_ned_m - centre
        away = float(np.hypot(out[0], out[1]))
        bearing = math.atan2(out[1], out[0])
        inward = math.atan(2.0 * (away - self.loiter_radius_m) / self.loiter_radius_m)
        course = bearing + 0.5 * math.pi + inward
        climb = float(np.clip(-0.6 * out[2], -self.climb_m_s, self.climb_m_s))
        return np.array([self.speed_m_s * math.cos(course), self.speed_m_s * math.sin(course), climb]), wrapped(course)

    def _reach(self) -> float:
        """So much before its end a leg is done; of a short one not all at once."""
        return min(1.2 * self.lookahead_m, 0.9 * self._length())

    @property
    def _is_last(self) -> bool:
        return not self.closed and self.leg == len(self.waypoints_ned_m) - 2

    def _ends(self) -> tuple[FloatArray, FloatArray]:
        points = self.waypoints_ned_m
        return points[self.leg], points[(self.leg + 1) % len(points)]

    def _length(self) -> float:
        start, end = self._ends()
        return float(np.hypot(*(end - start)[:2]))

    def _along(self, position_ned_m: FloatArray) -> float:
        start, end = self._ends()
        course = (end - start)[:2] / max(self._length(), 1e-6)
        return float((position_ned_m - start)[:2] @ course)
