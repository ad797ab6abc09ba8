"""A fixed-wing aircraft as a point with an attitude: it banks to turn, and must not fly slowly.

It is flown by the same commands as the multirotor. What guidance wants is a velocity over ground; the aircraft makes of
it an airspeed between its limits and the heading that, by the triangle of wind, leads along that track.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ortholoc_edge.geometry import rotation
from ortholoc_edge.geometry.arrays import FloatArray
from ortholoc_sim.vehicle import GRAVITY_M_S2, Truth, Wind, wrapped


@dataclass(frozen=True, slots=True)
class FixedWingOptions:
    """How it flies.

    Attributes:
        airspeed_m_s: it starts with. least_airspeed_m_s, most_airspeed_m_s: it never leaves these.
        max_bank_deg: with the airspeed it sets the least radius of a turn. roll_time_s: of the bank's response.
        speed_time_s, climb_time_s: of airspeed and climb. max_climb_m_s: limit, up and down.
        turn_gain_per_s: turn rate for an error of heading.
        incidence_deg: nose above the flight path at ``airspeed_m_s`` with level wings.
        gust_lag_s: in which a gust takes the aircraft along.
        wind_ned_m_s, gust_m_s, gust_time_s: as of `VehicleOptions`. The mean wind is known to the autopilot.
    """

    airspeed_m_s: float = 18.0
    least_airspeed_m_s: float = 13.0
    most_airspeed_m_s: float = 26.0
    max_bank_deg: float = 40.0
    roll_time_s: float = 0.35
    speed_time_s: float = 2.0
    climb_time_s: float = 1.0
    max_climb_m_s: float = 3.0
    turn_gain_per_s: float = 0.9
    incidence_deg: float = 3.0
    gust_lag_s: float = 1.5
    wind_ned_m_s: tuple[float, float, float] = (1.5, -1.0, 0.0)
    gust_m_s: float = 0.6
    gust_time_s: float = 4.0

    @property
    def least_turn_radius_m(self) -> float:
        """In still air at ``airspeed_m_s``."""
        return self.airspeed_m_s**2 / (GRAVITY_M_S2 * math.tan(math.radians(self.max_bank_deg)))


class FixedWing:
    """State of the flight dynamics; `step` moves it on.

    Attributes:
        airspeed_m_s, heading_rad, bank_rad: of the aircraft in the air.
    """

    def __init__(self, options: FixedWingOptions, position_ned_m: FloatArray, heading_rad: float, seed: int) -> None:
        self.options = options
        self.airspeed_m_s, self.heading_rad, self.bank_rad = options.airspeed_m_s, heading_rad, 0.0
        self._climb_m_s = 0.0
        self._wind = Wind(options.wind_ned_m_s, options.gust_m_s, options.gust_time_s, seed)
        self._carried: FloatArray = np.zeros(3)  # what gusts have made of its velocity
        self._position = np.array(position_ned_m, dtype=np.float64)
        self._velocity = self._over_ground()
        self._attitude = self._attitude_now()
        self._rates: FloatArray = np.zeros(3)

    @property
    def truth(self) -> Truth:
        """A copy of the present state."""
        return Truth(self._position.copy(), self._velocity.copy(), self._attitude.copy(), self._rates.copy())

    def step(self, dt_s: float, velocity_error_ned_m_s: FloatArray, yaw_error_rad: float) -> None:
        """Fly for ``dt_s`` so as to remove an error of velocity (wanted minus estimated). Its nose goes where it flies,
        so that an error of yaw means nothing to it."""
        o = self.options
        wanted = self._velocity + velocity_error_ned_m_s
        airspeed, heading = self._triangle(wanted)
        self.airspeed_m_s += (1.0 - math.exp(-dt_s / o.speed_time_s)) * (airspeed - self.airspeed_m_s)
        climb = float(np.clip(-wanted[2], -o.max_climb_m_s, o.max_climb_m_s))
        self._climb_m_s += (1.0 - math.exp(-dt_s / o.climb_time_s)) * (climb - self._climb_m_s)
        turn = o.turn_gain_per_s * wrapped(heading - self.heading_rad)
        limit = math.radians(o.max_bank_deg)
        bank = min(max(math.atan(self.airspeed_m_s * turn / GRAVITY_M_S2), -limit), limit)
        self.bank_rad += (1.0 - math.exp(-dt_s / o.roll_time_s)) * (bank - self.bank_rad)
        self.heading_rad = wrapped(self.heading_rad + GRAVITY_M_S2 * math.tan(self.bank_rad) / self.airspeed_m_s * dt_s)
        gust = self._wind.gust(dt_s)
        self._carried = self._carried + (1.0 - math.exp(-dt_s / o.gust_lag_s)) * (gust - self._carried)
        before_velocity, before_attitude = self._velocity, self._attitude
        self._velocity = self._over_ground()
        self._position = self._position + 0.5 * (before_velocity + self._velocity) * dt_s
        self._attitude = self._attitude_now()
        self._rates = rotation.log(before_attitude.T @ self._attitude) / dt_s

    def _triangle(self, wanted: FloatArray) -> tuple[float, float]:
        """Airspeed and heading by which the mean wind leaves a track along ``wanted``; where none does, into the
        wind."""
        o, wind = self.options, self._wind.mean_ned_m_s
        needed = math.hypot(wanted[0] - wind[0], wanted[1] - wind[1])
        airspeed = min(max(needed, o.least_airspeed_m_s), o.most_airspeed_m_s)
        speed = math.hypot(wanted[0], wanted[1])
        if speed < 1e-6:
            return airspeed, self.heading_rad
        track = math.atan2(wanted[1], wanted[0])
        across = (-wanted[1] * wind[0] + wanted[0] * wind[1]) / speed  # wind to the right of the track
        return airspeed, track - math.asin(min(max(across / airspeed, -1.0), 1.0))

    def _over_ground(self) -> FloatArray:
        climb = min(max(self._climb_m_s, -0.9 * self.airspeed_m_s), 0.9 * self.airspeed_m_s)
        flat = math.sqrt(self.airspeed_m_s**2 - climb**2)
        air = np.array([flat * math.cos(self.heading_rad), flat * math.sin(self.heading_rad), -climb])
        velocity: FloatArray = air + self._wind.mean_ned_m_s + self._carried
        return velocity

    def _attitude_now(self) -> FloatArray:
        o = self.options
        # Lift goes with incidence and the square of airspeed, and carries 1 / cos(bank) of the weight.
        incidence = math.radians(o.incidence_deg) * (o.airspeed_m_s / self.airspeed_m_s) ** 2 / math.cos(self.bank_rad)
        return rotation.from_euler(
            self.bank_rad, math.asin(self._climb_m_s / self.airspeed_m_s) + incidence, self.heading_rad
        )
