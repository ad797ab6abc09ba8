"""Where the simulated vehicle's NED frame lies in the map and on Earth, and what its autopilot makes of it.

Three horizontal frames meet. The map has grid north and grid metres. The simulation's NED has true north and true
metres; it is tied to the map at an anchor in the middle of the world, by convergence and scale there (over a
kilometre both change by less than 0.1 mm per metre). The autopilot's local position comes from latitude and
longitude by a spherical formula of its own, in which "metres" are up to 0.7 % off; written out here a second time,
so that a mistake in the daemon's copy shows.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import numpy.typing as npt

from ortholoc_edge.errors import MapError
from ortholoc_edge.geometry.arrays import FloatArray
from ortholoc_edge.geometry.frames import map_from_ned_rotation
from ortholoc_edge.geometry.rigid import Rigid3
from ortholoc_edge.tiles.georeference import Georeference

# AP_Common/Location.h: LATLON_TO_M, metres per 1e-7 degree.
_LATLON_TO_M = 0.011131884502145034
# lib/geo/geo.h: CONSTANTS_RADIUS_OF_EARTH.
_PX4_RADIUS_M = 6371000.0

# Whose formula it is: ArduPilot's is equirectangular, PX4's azimuthal equidistant, each on a sphere of its own.
Earth = Literal["ardupilot", "px4"]


@dataclass(frozen=True, slots=True)
class Geopoint:
    """Degrees on WGS 84 and metres above mean sea level."""

    lat_deg: float
    lon_deg: float
    height_amsl_m: float


def local_from_geopoint(earth: Earth, origin: Geopoint, point: Geopoint) -> FloatArray:
    """North, east, down (3,) in an autopilot's own metres; down is the difference of the heights."""
    down = origin.height_amsl_m - point.height_amsl_m
    if earth == "ardupilot":  # Location::get_distance_NE
        dlat, dlon = (point.lat_deg - origin.lat_deg) * 1e7, (point.lon_deg - origin.lon_deg) * 1e7
        scale = math.cos(math.radians((point.lat_deg + origin.lat_deg) / 2.0))
        return np.array([dlat * _LATLON_TO_M, dlon * _LATLON_TO_M * scale, down])
    lat0, lat = math.radians(origin.lat_deg), math.radians(point.lat_deg)
    dlon = math.radians(point.lon_deg - origin.lon_deg)
    half = math.sin((lat - lat0) / 2.0) ** 2 + math.cos(lat0) * math.cos(lat) * math.sin(dlon / 2.0) ** 2
    distance_m = 2.0 * math.asin(math.sqrt(half)) * _PX4_RADIUS_M
    bearing = math.atan2(
        math.sin(dlon) * math.cos(lat), math.cos(lat0) * math.sin(lat) - math.sin(lat0) * math.cos(lat) * math.cos(dlon)
    )
    return np.array([distance_m * math.cos(bearing), distance_m * math.sin(bearing), down])


def geopoint_from_local(earth: Earth, origin: Geopoint, position_ned_m: FloatArray) -> Geopoint:
    """Inverse of :func:`local_from_geopoint`."""
    north, east, down = (float(v) for v in position_ned_m)
    height = origin.height_amsl_m - down
    if earth == "ardupilot":  # Location::offset
        lat = origin.lat_deg + north / _LATLON_TO_M * 1e-7
        scale = math.cos(math.radians((lat + origin.lat_deg) / 2.0))
        return Geopoint(lat, origin.lon_deg + east / _LATLON_TO_M / scale * 1e-7, height)
    angle, bearing = math.hypot(north, east) / _PX4_RADIUS_M, math.atan2(east, north)
    lat0 = math.radians(origin.lat_deg)
    sine = math.sin(lat0) * math.cos(angle) + math.cos(lat0) * math.sin(angle) * math.cos(bearing)
    dlon = math.atan2(math.sin(bearing) * math.sin(angle) * math.cos(lat0), math.cos(angle) - math.sin(lat0) * sine)
    return Geopoint(math.degrees(math.asin(sine)), origin.lon_deg + math.degrees(dlon), height)


@dataclass(frozen=True, slots=True, eq=False)
class Site:
    """The frames around an anchor.

    Attributes:
        georeference: of the map.
        anchor_map_m: (3,) easting, northing, height where NED is zero.
        earth: the autopilot's formula.
    """

    georeference: Georeference
    anchor_map_m: FloatArray
    earth: Earth = "ardupilot"
    _turn: FloatArray = field(init=False)
    grid_scale: float = field(init=False)
    origin: Geopoint = field(init=False)

    def __post_init__(self) -> None:
        anchor = np.array(self.anchor_map_m, dtype=np.float64)
        scale = self.georeference.grid_scale(anchor[:2], float(anchor[2]))
        object.__setattr__(self, "_turn", map_from_ned_rotation(self.georeference.convergence_rad(anchor[:2])))
        object.__setattr__(self, "grid_scale", scale)
        here = self.geopoint(np.zeros(3))
        # As GPS_GLOBAL_ORIGIN carries it.
        rounded = Geopoint(round(here.lat_deg, 7), round(here.lon_deg, 7), round(here.height_amsl_m, 3))
        object.__setattr__(self, "origin", rounded)

    def map_from_ned(self, position_ned_m: npt.ArrayLike) -> FloatArray:
        """(3,) or (N, 3) NED of the simulation to map coordinates."""
        offset = np.asarray(position_ned_m, dtype=np.float64) @ self._turn.T
        return np.asarray(self.anchor_map_m + offset * (self.grid_scale, self.grid_scale, 1.0), dtype=np.float64)

    def ned_from_map(self, points_map: npt.ArrayLike) -> FloatArray:
        """Inverse of :meth:`map_from_ned`."""
        offset = np.asarray(points_map, dtype=np.float64) - self.anchor_map_m
        return np.asarray(offset / (self.grid_scale, self.grid_scale, 1.0) @ self._turn, dtype=np.float64)

    def camera_pose(self, position_ned_m: FloatArray, ned_from_body: FloatArray, body_from_camera: Rigid3) -> Rigid3:
        """``map_from_camera`` of a vehicle at a true position with a true attitude."""
        eye = self.map_from_ned(position_ned_m + ned_from_body @ body_from_camera.translation)
        map_from_ned = map_from_ned_rotation(self.georeference.convergence_rad(eye[:2]))
        return Rigid3(map_from_ned @ ned_from_body @ body_from_camera.rotation, eye)

    def geopoint(self, position_ned_m: FloatArray) -> Geopoint:
        """Latitude, longitude and height of an NED position of the simulation. Raises: MapError if the map's
        vertical datum does not give a height above sea level."""
        place = self.georeference.geodetic_from_map(self.map_from_ned(position_ned_m))
        if place.height_amsl_m is None:
            raise MapError(
                "demo world: its pack gives no height above sea level; build it with --geoid-undulation-m METRES"
            )
        return Geopoint(place.lat_deg, place.lon_deg, place.height_amsl_m)

    def autopilot_from_ned(self, position_ned_m: FloatArray) -> FloatArray:
        """NED (3,) as the autopilot would have it for the vehicle at an NED position of the simulation."""
        return self.autopilot_from_geopoint(self.geopoint(position_ned_m))

    def autopilot_from_geopoint(self, point: Geopoint) -> FloatArray:
        """NED (3,) from the origin, by the autopilot's formula."""
        return local_from_geopoint(self.earth, self.origin, point)

    def geopoint_from_autopilot(self, position_ned_m: FloatArray) -> Geopoint:
        """Inverse of :meth:`autopilot_from_geopoint`."""
        return geopoint_from_local(self.earth, self.origin, position_ned_m)

    def ned_from_autopilot(self, position_ned_m: FloatArray) -> FloatArray:
        """True NED (3,) of the simulation for the autopilot's."""
        point = self.geopoint_from_autopilot(position_ned_m)
        return self.ned_from_map(
            self.georeference.map_from_geodetic(point.lat_deg, point.lon_deg, height_amsl_m=point.height_amsl_m)
        )
