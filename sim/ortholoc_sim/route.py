"""Routes for a simulated vehicle: around a place on Earth, or from a file that ground stations write."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from rasterio.crs import CRS
from rasterio.warp import transform

from ortholoc_edge.errors import ConfigError
from ortholoc_edge.geometry.arrays import FloatArray
from ortholoc_edge.tiles.georeference import Georeference, VerticalDatum
from ortholoc_sim.site import Earth, Geopoint, Site

_MOST_LATITUDE_DEG = 80.0  # of UTM, with some room
_CIRCLE_POINTS = 24
# Of the waypoint file: MAV_FRAME_GLOBAL and MAV_FRAME_GLOBAL_RELATIVE_ALT; commands that are places.
_ABSOLUTE, _RELATIVE = ("0", "5"), ("3", "6")
_PLACES = ("16", "17", "19", "22", "82")
_COLUMNS = 12


def site_at(home: Geopoint, earth: Earth) -> Site:
    """A site without a map: UTM around ``home``, heights above sea level.

    Raises: ConfigError for a home beyond 80 degrees of latitude.
    """
    if not (abs(home.lat_deg) <= _MOST_LATITUDE_DEG and abs(home.lon_deg) <= 180.0):
        raise ConfigError(
            f"home {home.lat_deg:g}, {home.lon_deg:g} can't be used; take a latitude from -{_MOST_LATITUDE_DEG:g} to "
            f"{_MOST_LATITUDE_DEG:g} and a longitude from -180 to 180 degrees"
        )
    zone = min(60, int((home.lon_deg + 180.0) // 6.0) + 1)
    crs = f"EPSG:{(32600 if home.lat_deg >= 0.0 else 32700) + zone}"
    (east,), (north,) = transform(CRS.from_epsg(4326), CRS.from_string(crs), [home.lon_deg], [home.lat_deg])[:2]
    vertical = VerticalDatum(kind="orthometric", amsl_minus_map_m=0.0, ellipsoid_minus_map_m=0.0)
    return Site(Georeference(crs, vertical, (east, north)), np.array([east, north, home.height_amsl_m]), earth)


def circle(site: Site, radius_m: float, height_m: float) -> FloatArray:
    """(N, 3) map coordinates of a circle around the site's anchor, ``height_m`` above it, clockwise from north."""
    angles = 2.0 * math.pi * np.arange(_CIRCLE_POINTS) / _CIRCLE_POINTS
    ned = np.column_stack([radius_m * np.cos(angles), radius_m * np.sin(angles), np.full(len(angles), -height_m)])
    return site.map_from_ned(ned)


def read_waypoints(path: Path, site: Site) -> FloatArray:
    """(N, 3) map coordinates of a file as Mission Planner, QGroundControl and MAVProxy write it ("QGC WPL 110").

    Items that are no places are passed over; heights above home count from item 0, which is not flown.
    Raises: ConfigError for a file that can't be read or holds fewer than two places.
    """
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"route {path} can't be read: {error}") from error
    if not lines or not lines[0].startswith("QGC WPL"):
        raise ConfigError(f"route {path} is no waypoint file: its first line must be QGC WPL 110")
    home_m: float | None = None
    points = []
    for number, line in enumerate(lines[1:], start=2):
        parts = line.split()
        if not parts:
            continue
        try:
            if len(parts) != _COLUMNS:
                raise ValueError(f"{len(parts)} columns, not {_COLUMNS}")
            frame, command = parts[2], parts[3]
            lat, lon, height = (float(v) for v in parts[8:11])
        except ValueError as error:
            raise ConfigError(f"route {path}, line {number}: {error}") from error
        if home_m is None:
            home_m = height
            continue
        if command not in _PLACES or (lat, lon) == (0.0, 0.0):
            continue
        if frame not in (*_ABSOLUTE, *_RELATIVE):
            raise ConfigError(
                f"route {path}, line {number}: frame {frame}; write 0 (above sea level) or 3 (above home)"
            )
        points.append(Geopoint(lat, lon, height + (home_m if frame in _RELATIVE else 0.0)))
    if len(points) < 2:
        raise ConfigError(f"route {path} has {len(points)} waypoints after home; at least 2 are wanted")
    georeference = site.georeference
    return np.array(
        [georeference.map_from_geodetic(p.lat_deg, p.lon_deg, height_amsl_m=p.height_amsl_m) for p in points]
    )
