"""What is said to the autopilot, as MAVLink messages; pure functions, no I/O.

The covariance field of VISION_POSITION_ESTIMATE and ODOMETRY is read in three ways:

- PX4 takes each diagonal entry as the variance of its axis, as the message definition says.
- ArduPilot reduces the three position entries to *one* standard deviation for north and east, and the three
  angle entries to one for yaw. Up to 4.7 that is the cube root of the sum of their squares; since pull
  request 32084 (February 2026, taken here as 4.8) it is the square root of their sum.

So what is encoded is chosen such that the filter ends up with the standard deviation we mean. Off-diagonal
entries are read by neither; PX4 gets them all the same.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as dialect

from ortholoc_edge.geometry import rotation
from ortholoc_edge.geometry.arrays import FloatArray, frozen_floats
from ortholoc_edge.geometry.frames import ecef_from_geodetic, ned_from_ecef_rotation

# A message object of pymavlink's dialect, which carries no types.
MavlinkMessage = Any

# Upper triangle of a 6x6 matrix, row by row.
_TRIANGLE = np.triu_indices(6)

# First version whose ExternalNav handlers take the square root of the sum of the variances.
_SQUARE_ROOT_SINCE = (4, 8, 0)

# Radius behind ArduPilot's LATLON_TO_M (0.011131884502145034 m per 1e-7 degree; AP_Common/Location.h).
_ARDUPILOT_RADIUS_M = math.degrees(0.011131884502145034 * 1e7)
# PX4's CONSTANTS_RADIUS_OF_EARTH (lib/geo/geo.h).
_PX4_RADIUS_M = 6371000.0


class Autopilot(StrEnum):
    """The two families of flight stack that the link speaks to."""

    ARDUPILOT = "ardupilot"
    PX4 = "px4"


class CovarianceLayout(StrEnum):
    """How the receiver turns the covariance field into standard deviations."""

    CUBE_ROOT = "cube_root"  # ArduPilot before 4.8
    SQUARE_ROOT = "square_root"  # ArduPilot from 4.8
    PER_AXIS = "per_axis"  # PX4, and the message definition


class EarthModel(StrEnum):
    """How latitude and longitude become metres north and east of an origin.

    The autopilots compute on a sphere, each on one of its own, so their "metres" are up to 0.7 % off true
    ones along
    the meridian near the equator: 2 m per km east at latitude 50 for ArduPilot. That is invisible inside an
        autopilot,
    which goes to and fro with one formula, and visible to a companion that uses another: its fixes would move
    away from where the autopilot's own GNSS, waypoints and GLOBAL_POSITION_INT are, in proportion to the
    distance from the origin.
    """

    WGS84 = "wgs84"  # true metres of the tangent plane
    ARDUPILOT = "ardupilot"  # Location::get_distance_NE: equirectangular, cosine of the mean latitude
    PX4 = "px4"  # MapProjection: azimuthal equidistant


def covariance_layout(
    autopilot: Autopilot, firmware_version: tuple[int, int, int] | None
) -> CovarianceLayout:
    """The layout that a firmware reads. An ArduPilot of unknown version is taken for an old one, as most
    are."""
    if autopilot is Autopilot.PX4:
        return CovarianceLayout.PER_AXIS
    if firmware_version is not None and firmware_version >= _SQUARE_ROOT_SINCE:
        return CovarianceLayout.SQUARE_ROOT
    return CovarianceLayout.CUBE_ROOT


def earth_model(autopilot: Autopilot) -> EarthModel:
    """The model by which an autopilot itself relates latitude and longitude to its local position."""
    return EarthModel.PX4 if autopilot is Autopilot.PX4 else EarthModel.ARDUPILOT


@dataclass(frozen=True, slots=True, eq=False)
class VisionEstimate:
    """Where the body was at ``stamp_ns``.

    Attributes:
        stamp_ns: middle of the exposure, monotonic clock.
        position_ned_m: (3,) body relative to the autopilot's EKF origin, true north.
        ned_from_body: (3, 3).
        covariance: (6, 6) over north, east, down (m), then a small turn about the north, east and down axes
            (rad; ``R_true = exp(d) @ ned_from_body``). MAVLink names the last three roll, pitch and yaw; with
            the nose north and little tilt these are the same, and the filters use the last one only.
        reset_counter: 0..255; another value than before tells the filter to jump to this estimate.
        quality: 0..1.
    Raises: ValueError if a value has the wrong shape, is not finite, or is out of its range.
    """

    stamp_ns: int
    position_ned_m: FloatArray
    ned_from_body: FloatArray
    covariance: FloatArray
    reset_counter: int = 0
    quality: float = 1.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "position_ned_m", frozen_floats(self.position_ned_m, (3,), "position_ned_m"))
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

    ArduPilot knows a circle only; the circle around the ellipse never claims more than we know.
    """
    return math.sqrt(max(0.0, float(np.linalg.eigvalsh(estimate.covariance[:2, :2])[-1])))


def yaw_sigma_rad(estimate: VisionEstimate) -> float:
    """Standard deviation of the turn about the vertical."""
    return math.sqrt(float(estimate.covariance[5, 5]))


def covariance_field(estimate: VisionEstimate, layout: CovarianceLayout) -> list[float]:
    """The 21 floats for the message, finite throughout.

    For ArduPilot the vertical entry stays zero, since it would add to the horizontal one, and so do roll and
    pitch beside yaw. No entry may be NaN: ArduPilot tests the first only, and a NaN elsewhere ends in its
    internal error "constraining_nan".
    """
    if layout is CovarianceLayout.PER_AXIS:
        return [float(v) for v in estimate.covariance[_TRIANGLE]]
    sigma, yaw_sigma = horizontal_sigma_m(estimate), yaw_sigma_rad(estimate)
    diagonal = np.zeros(6)
    if layout is CovarianceLayout.SQUARE_ROOT:
        diagonal[:2] = sigma**2 / 2.0
        diagonal[5] = yaw_sigma**2
    else:
        diagonal[:2] = math.sqrt(sigma**3 / 2.0)
        diagonal[5] = math.sqrt(yaw_sigma**3)
    return [float(v) for v in np.diag(diagonal)[_TRIANGLE]]


def encode_vision_position_estimate(estimate: VisionEstimate, layout: CovarianceLayout) -> MavlinkMessage:
    """VISION_POSITION_ESTIMATE. It has no quality field; an estimate that is not good is simply not sent."""
    north, east, down = (float(v) for v in estimate.position_ned_m)
    roll, pitch, yaw = rotation.to_euler(estimate.ned_from_body)
    return dialect.MAVLink_vision_position_estimate_message(
        usec=estimate.stamp_ns // 1000,
        x=north,
        y=east,
        z=down,
        roll=roll,
        pitch=pitch,
        yaw=yaw,
        covariance=covariance_field(estimate, layout),
        reset_counter=estimate.reset_counter,
    )


def encode_odometry(estimate: VisionEstimate, layout: CovarianceLayout) -> MavlinkMessage:
    """ODOMETRY without velocity, which is NaN: zeros would be a measurement of standing still.

    ArduPilot drops it silently in any frame but LOCAL_FRD, by which it means north and east of its origin.
    PX4 takes that frame as having an arbitrary heading and turns it, so there it must be LOCAL_NED.
    """
    nan = math.nan
    px4 = layout is CovarianceLayout.PER_AXIS
    north, east, down = (float(v) for v in estimate.position_ned_m)
    return dialect.MAVLink_odometry_message(
        time_usec=estimate.stamp_ns // 1000,
        frame_id=dialect.MAV_FRAME_LOCAL_NED if px4 else dialect.MAV_FRAME_LOCAL_FRD,
        child_frame_id=dialect.MAV_FRAME_BODY_FRD,
        x=north,
        y=east,
        z=down,
        q=[float(v) for v in rotation.to_quaternion(estimate.ned_from_body)],
        vx=nan,
        vy=nan,
        vz=nan,
        rollspeed=nan,
        pitchspeed=nan,
        yawspeed=nan,
        pose_covariance=covariance_field(estimate, layout),
        velocity_covariance=[nan] + [0.0] * 20,
        reset_counter=estimate.reset_counter,
        estimator_type=dialect.MAV_ESTIMATOR_TYPE_VISION,
        # 0 would mean "unknown", -1 "failed"; the worst estimate that is still one is 1 %.
        quality=max(1, min(100, round(estimate.quality * 100.0))),
    )


@dataclass(frozen=True, slots=True)
class GeodeticOrigin:
    """Zero of the autopilot's local position.

    Raises: ValueError if a value is not finite or out of range.
    """

    latitude_deg: float
    longitude_deg: float
    height_amsl_m: float

    def __post_init__(self) -> None:
        if not (abs(self.latitude_deg) <= 90.0 and abs(self.longitude_deg) <= 180.0):
            raise ValueError(f"origin {self.latitude_deg}, {self.longitude_deg} is not a position in degrees")
        if not math.isfinite(self.height_amsl_m):
            raise ValueError(f"origin height {self.height_amsl_m} is not finite")


def ned_from_geodetic(
    origin: GeodeticOrigin,
    latitude_deg: float,
    longitude_deg: float,
    height_amsl_m: float,
    model: EarthModel,
) -> FloatArray:
    """North, east, down (3,) in m of a position relative to ``origin``.

    Down is the difference of the two heights above sea level: the autopilots' "down" follows the curved sea
    level, not the tangent plane (which falls away by 8 cm in 1 km). North and east are, in ``WGS84``, offsets
    in the tangent plane at the origin of the point brought to the origin's height; the undulation of the
    geoid, at most 110 m, is neglected in that height and changes them by less than 2 cm per km.
    """
    if model is EarthModel.WGS84:
        lat0, lon0 = math.radians(origin.latitude_deg), math.radians(origin.longitude_deg)
        height = origin.height_amsl_m
        offset = ecef_from_geodetic(
            math.radians(latitude_deg), math.radians(longitude_deg), height
        ) - ecef_from_geodetic(lat0, lon0, height)
        north, east, _ = ned_from_ecef_rotation(lat0, lon0) @ offset
    elif model is EarthModel.ARDUPILOT:
        north = _ARDUPILOT_RADIUS_M * math.radians(latitude_deg - origin.latitude_deg)
        east = (
            _ARDUPILOT_RADIUS_M
            * math.radians(_wrap_deg(longitude_deg - origin.longitude_deg))
            * _ardupilot_longitude_scale((latitude_deg + origin.latitude_deg) / 2.0)
        )
    else:
        lat0, lat = math.radians(origin.latitude_deg), math.radians(latitude_deg)
        dlon = math.radians(longitude_deg - origin.longitude_deg)
        # Same projection as PX4's, by atan2 instead of acos, which loses the last 0.1 m near the origin.
        x = math.cos(lat0) * math.sin(lat) - math.sin(lat0) * math.cos(lat) * math.cos(dlon)
        y = math.cos(lat) * math.sin(dlon)
        sine = math.hypot(x, y)
        angle = math.atan2(
            sine, math.sin(lat0) * math.sin(lat) + math.cos(lat0) * math.cos(lat) * math.cos(dlon)
        )
        scale = _PX4_RADIUS_M * (angle / sine if sine > 0.0 else 1.0)
        north, east = scale * x, scale * y
    return np.array([north, east, origin.height_amsl_m - height_amsl_m])


def moved(
    latitude_deg: float, longitude_deg: float, height_amsl_m: float, offset_ned_m: FloatArray
) -> tuple[float, float, float]:
    """(latitude_deg, longitude_deg, height_amsl_m) of a WGS 84 position moved by true metres (3,).

    By the radii of curvature there: 1 mm off after 100 m at latitude 50, 1 cm at 85. At a pole only the
    height is moved.
    """
    lat, lon = math.radians(latitude_deg), math.radians(longitude_deg)
    north, east, down = (float(v) for v in offset_ned_m)
    step = 1e-6
    here = ecef_from_geodetic(lat, lon, height_amsl_m)
    metres_north = float(np.linalg.norm(ecef_from_geodetic(lat + step, lon, height_amsl_m) - here)) / step
    metres_east = float(np.hypot(here[0], here[1]))
    if metres_east < 1e3:
        return latitude_deg, longitude_deg, height_amsl_m - down
    return (
        latitude_deg + math.degrees(north / metres_north),
        _wrap_deg(longitude_deg + math.degrees(east / metres_east)),
        height_amsl_m - down,
    )


def _ardupilot_longitude_scale(latitude_deg: float) -> float:
    return max(0.01, math.cos(math.radians(latitude_deg)))


def _wrap_deg(angle_deg: float) -> float:
    """To -180..180; values already there pass unchanged, so that no digit is lost."""
    return angle_deg if -180.0 <= angle_deg <= 180.0 else (angle_deg + 180.0) % 360.0 - 180.0
