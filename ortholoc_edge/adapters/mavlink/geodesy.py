"""Latitude and longitude against metres from an origin, the autopilots' way and the true one."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from ortholoc_edge.geometry.arrays import FloatArray
from ortholoc_edge.geometry.frames import ecef_from_geodetic

# Radius behind ArduPilot's LATLON_TO_M (0.011131884502145034 m per 1e-7 degree; AP_Common/Location.h).
_ARDUPILOT_RADIUS_M = math.degrees(0.011131884502145034 * 1e7)
# PX4's CONSTANTS_RADIUS_OF_EARTH (lib/geo/geo.h).
_PX4_RADIUS_M = 6371000.0
# Origins this close are one: ten digits of the message's latitude, and far below what a fix can tell.
_SAME_M = 0.1


class EarthModel(StrEnum):
    """How latitude and longitude become metres north and east of an origin.

    The autopilots compute on a sphere, each on one of its own, so their "metres" are up to 0.7 % off true ones along
    the meridian near the equator: 2 m per km east at latitude 50 for ArduPilot. That is invisible inside an autopilot,
    which goes to and fro with one formula, and visible to a companion that uses another: its fixes would move
    away from where the autopilot's own GNSS, waypoints and GLOBAL_POSITION_INT are, in proportion to the
    distance from the origin.
    """

    ARDUPILOT = "ardupilot"  # Location::get_distance_NE: equirectangular, cosine of the mean latitude
    PX4 = "px4"  # MapProjection: azimuthal equidistant


def _check_position(what: str, latitude_deg: float, longitude_deg: float) -> None:
    if not (abs(latitude_deg) <= 90.0 and abs(longitude_deg) <= 180.0):
        raise ValueError(f"{what} {latitude_deg}, {longitude_deg} is not a position in degrees")


@dataclass(frozen=True, slots=True)
class Place:
    """A position on WGS 84. ``height_ellipsoid_m`` is None where only the height above sea level is known.

    Raises: ValueError if a value is not finite or out of range.
    """

    latitude_deg: float
    longitude_deg: float
    height_amsl_m: float
    height_ellipsoid_m: float | None = None

    def __post_init__(self) -> None:
        _check_position("place", self.latitude_deg, self.longitude_deg)
        if not math.isfinite(self.height_amsl_m) or not math.isfinite(self.height_ellipsoid_m or 0.0):
            raise ValueError(f"place heights {self.height_amsl_m}, {self.height_ellipsoid_m} are not finite")


@dataclass(frozen=True, slots=True)
class GeodeticOrigin:
    """Zero of the autopilot's local position.

    Raises: ValueError if a value is not finite or out of range.
    """

    latitude_deg: float
    longitude_deg: float
    height_amsl_m: float

    def __post_init__(self) -> None:
        _check_position("origin", self.latitude_deg, self.longitude_deg)
        if not math.isfinite(self.height_amsl_m):
            raise ValueError(f"origin height {self.height_amsl_m} is not finite")


def is_same_origin(a: GeodeticOrigin, b: GeodeticOrigin) -> bool:
    """Whether two origins are one but for rounding, which wavers by a digit of 1e-7 degrees (1 cm) or of 1 mm."""
    north_m = math.radians(a.latitude_deg - b.latitude_deg) * _PX4_RADIUS_M
    turn_deg = _wrap_deg(a.longitude_deg - b.longitude_deg)
    east_m = math.radians(turn_deg) * _PX4_RADIUS_M * math.cos(math.radians(a.latitude_deg))
    return math.hypot(north_m, east_m) <= _SAME_M and abs(a.height_amsl_m - b.height_amsl_m) <= _SAME_M


def ned_from_geodetic(
    origin: GeodeticOrigin,
    latitude_deg: float,
    longitude_deg: float,
    height_amsl_m: float,
    model: EarthModel,
) -> FloatArray:
    """North, east, down (3,) in m of a position relative to ``origin``.

    Down is the difference of the two heights above sea level: the autopilots' "down" follows the curved sea
    level, not the tangent plane (which falls away by 8 cm in 1 km).
    """
    if model is EarthModel.ARDUPILOT:
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


def geodetic_from_ned(
    origin: GeodeticOrigin, position_ned_m: FloatArray, model: EarthModel
) -> tuple[float, float, float]:
    """(latitude_deg, longitude_deg, height_amsl_m) of a position (3,): the inverse of `ned_from_geodetic`.

    By steps in true metres: each leaves less than 1 % of what was missing, so that 20 km are right to a millimetre
    after five.
    """
    latitude_deg, longitude_deg, height_amsl_m = origin.latitude_deg, origin.longitude_deg, origin.height_amsl_m
    for _ in range(5):
        reached = ned_from_geodetic(origin, latitude_deg, longitude_deg, height_amsl_m, model)
        latitude_deg, longitude_deg, height_amsl_m = moved(
            latitude_deg, longitude_deg, height_amsl_m, position_ned_m - reached
        )
    return latitude_deg, longitude_deg, height_amsl_m


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
