"""What is said of the vehicle, before it takes the form of a message."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from ortholoc_edge.adapters.mavlink.geodesy import GeodeticOrigin, Place
from ortholoc_edge.geometry.arrays import FloatArray, frozen_floats


class Autopilot(StrEnum):
    """The two families of flight stack that the link speaks to."""

    ARDUPILOT = "ardupilot"
    PX4 = "px4"


@dataclass(frozen=True, slots=True, eq=False)
class VisionEstimate:
    """Where the body was at ``stamp_ns``.

    Attributes:
        stamp_ns: middle of the exposure, monotonic clock.
        position_ned_m: (3,) body relative to the autopilot's EKF origin, true north, in the metres that the
            autopilot itself counts (`geodesy.EarthModel`); None while it has no origin.
        ned_from_body: (3, 3).
        covariance: (6, 6) over north, east, down (m), then a small turn about the north, east and down axes
            (rad; ``R_true = exp(d) @ ned_from_body``). MAVLink names the last three roll, pitch and yaw; with
            the nose north and little tilt these are the same, and the filters use the last one only.
        reset_counter: 0..255; another value than before tells the filter to jump to this estimate.
        quality: 0..1.
        place: on WGS 84, for messages that don't depend on the origin; None: those can't be sent. Where there are a
            local position and its origin, too, these count, so that an estimate can be carried on by
            ``position_ned_m`` alone; of the place then only the geoid's height is used.
        origin: that ``position_ned_m`` counts from; None: whichever the autopilot has.
    Raises: ValueError if a value has the wrong shape, is not finite, or is out of its range; or if there is neither
        a position nor a place.
    """

    stamp_ns: int
    position_ned_m: FloatArray | None
    ned_from_body: FloatArray
    covariance: FloatArray
    reset_counter: int = 0
    quality: float = 1.0
    place: Place | None = None
    origin: GeodeticOrigin | None = None

    def __post_init__(self) -> None:
        if self.position_ned_m is not None:
            position = frozen_floats(self.position_ned_m, (3,), "position_ned_m")
            object.__setattr__(self, "position_ned_m", position)
        elif self.place is None:
            raise ValueError("position_ned_m and place are both None: the estimate says nothing")
        attitude = frozen_floats(self.ned_from_body, (3, 3), "ned_from_body")
        error = float(np.abs(attitude @ attitude.T - np.eye(3)).max())
        if error > 1e-5 or np.linalg.det(attitude) < 0:
            raise ValueError(f"ned_from_body: not orthonormal (off by {error:.1e}) or mirrored")
        object.__setattr__(self, "ned_from_body", attitude)
        covariance = frozen_floats(self.covariance, (6, 6), "covariance")
        asymmetry = float(np.abs(covariance - covariance.T).max())
        if (np.diag(covariance) < 0).any() or asymmetry > 1e-6 * max(1.0, float(np.abs(covariance).max())):
            raise ValueError("covariance: not symmetric, or a variance is negative")
        object.__setattr__(self, "covariance", covariance)
        if self.stamp_ns < 0:
            raise ValueError(f"stamp_ns: {self.stamp_ns} is negative")
        if not 0 <= self.reset_counter <= 255:
            raise ValueError(f"reset_counter: {self.reset_counter} does not fit in 0..255")
        if not 0.0 <= self.quality <= 1.0:
            raise ValueError(f"quality: {self.quality} is not in 0..1")


def horizontal_sigma_m(estimate: VisionEstimate) -> float:
    """The one standard deviation that stands for north and east: of the ellipse's longer axis.

    ArduPilot, and PX4 for a global position, know a circle only; the circle around the ellipse never claims more
    than we know.
    """
    return math.sqrt(max(0.0, float(np.linalg.eigvalsh(estimate.covariance[:2, :2])[-1])))


def vertical_sigma_m(estimate: VisionEstimate) -> float:
    """Standard deviation of the height."""
    return math.sqrt(float(estimate.covariance[2, 2]))


def yaw_sigma_rad(estimate: VisionEstimate) -> float:
    """Standard deviation of the turn about the vertical."""
    return math.sqrt(float(estimate.covariance[5, 5]))
