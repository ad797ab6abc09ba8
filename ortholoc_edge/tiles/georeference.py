"""From the pack's map coordinates to the world's: geodetic position, true north, true metres, named heights.

Two traps decide the shape of this module. Grid north is not true north (1.5 degrees apart in the middle of a
UTM zone's half, more toward the poles), and a grid metre is not a metre (0.4 per mille on the central
meridian). And PROJ, asked for a vertical transformation whose geoid grid is not installed, answers with the
unchanged height; so PROJ is never asked for heights here: they move only by the offsets that `vertical` derived
once, when the pack was built.

This flies, and asks the PROJ that rasterio brings with GDAL: pyproj, which a build uses (`systems`), has another of
its own, and takes 15 MB (measured).
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
import numpy.typing as npt

# What rasterio.warp.transform raises where PROJ fails; rasterio has no public name for it.
from rasterio._err import CPLE_BaseError
from rasterio.crs import CRS
from rasterio.errors import CRSError
from rasterio.warp import transform

from ortholoc_edge.errors import MapError
from ortholoc_edge.geometry.arrays import FloatArray
from ortholoc_edge.geometry.frames import ecef_from_geodetic, ned_from_ecef_rotation
from ortholoc_edge.geometry.rigid import Rigid3

# Mean Earth radius (IUGG). The local radius differs by up to 0.4 %, which at a height of 5 km moves the scale
# by 3e-6.
_EARTH_RADIUS_M = 6371008.8

# Largest scale of a place over its smallest, less 1, measured over a probe: UTM, Lambert conformal and the oblique
# Mercators stay below 1e-7; equal-area projections and web Mercator's mix of sphere and ellipsoid exceed 1e-3.
_MAX_ANISOTROPY = 1e-4
# Half the length over which directions and scales are measured. Rounding, 1e-9 m, and the curvature of the Earth, the
# square of this over its radius, both stay below 1e-10 of it.
_PROBE_M = 50.0

_WGS84 = CRS.from_epsg(4326)

VerticalKind = Literal["ellipsoid", "orthometric", "unknown"]
# Between a sea level and the ellipsoid, with room for national zeros: more is a mistake or an attack.
HeightOffset = Annotated[float, msgspec.Meta(ge=-150, le=150)]


class VerticalDatum(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What a height in the pack is measured from, and what to add to get the two heights others mean.

    The offsets are those at the pack's anchor. The geoid slopes by some centimetres per kilometre, so that over a
    large pack others hold elsewhere: see `HeightOffsets`.

    Attributes:
        kind: "ellipsoid" (WGS 84 or ETRS89), "orthometric" (a national or global sea level), "unknown".
        name: of the vertical datum, for people.
        epsg: EPSG code of the vertical reference system.
        amsl_minus_map_m: add to a map height to get AMSL as the autopilot means it (EGM96); None: not known.
        ellipsoid_minus_map_m: add to a map height to get the height above the WGS 84 ellipsoid; None: not known.
        derivation: where the offsets come from, one sentence for people.
        amsl_sigma_m: 1 sigma of ``amsl_minus_map_m``, an error common to the whole pack: 0 if it is exact or the
            user stated it, 0.1 through a geoid grid of PROJ's, 1 (NAVD88: 2) where another sea level was taken
            for EGM96's; None: not known (no offset, or a pack built before this was written).
    """

    kind: VerticalKind
    name: str | None = None
    epsg: int | None = None
    amsl_minus_map_m: HeightOffset | None = None
    ellipsoid_minus_map_m: HeightOffset | None = None
    derivation: str | None = None
    amsl_sigma_m: Annotated[float, msgspec.Meta(ge=0, le=1000)] | None = None

    def amsl_from_map(self, height_map_m: float) -> float:
        """Height above mean sea level (EGM96), m. Raises: MapError where the pack does not say."""
        return height_map_m + self._offset(self.amsl_minus_map_m, "above mean sea level")

    def map_from_amsl(self, height_amsl_m: float) -> float:
        """Inverse of :meth:`amsl_from_map`."""
        return height_amsl_m - self._offset(self.amsl_minus_map_m, "above mean sea level")

    def ellipsoid_from_map(self, height_map_m: float) -> float:
        """Height above the WGS 84 ellipsoid, m. Raises: MapError where the pack does not say."""
        return height_map_m + self._offset(self.ellipsoid_minus_map_m, "above the ellipsoid")

    def map_from_ellipsoid(self, height_ellipsoid_m: float) -> float:
        """Inverse of :meth:`ellipsoid_from_map`."""
        return height_ellipsoid_m - self._offset(self.ellipsoid_minus_map_m, "above the ellipsoid")

    def _offset(self, offset_m: float | None, wanted: str) -> float:
        if offset_m is None:
            raise self.unknown(wanted)
        return offset_m

    def unknown(self, wanted: str) -> MapError:
        """The error that heights of a kind ("above the ellipsoid") cannot be told."""
        return MapError(
            f"area pack: heights {wanted} cannot be told from its vertical datum ({self.kind});"
            " rebuild it with --vertical ellipsoid|orthometric and --geoid-undulation-m METRES"
            " (geoid above ellipsoid there)"
        )


@dataclass(frozen=True, slots=True, eq=False)
class HeightOffsets:
    """The offsets of `VerticalDatum`, tile by tile.

    Between the centres of tiles they are interpolated bilinearly, where a neighbour is missing with the weights of
    those that are there: without steps as long as one lies within a tile's side. Farther off the nearest tile
    counts. A tile at the rim of the pack counts as a whole one: half a tile is 0.4 km, of the geoid some 2 cm.

    Attributes:
        west, top: map coordinates of the north-west corner of tile (0, 0), m.
        side_m: of a tile.
        amsl, ellipsoid: offsets in m by (column, row), counted in tiles eastward and southward; either may be empty.
    """

    west: float
    top: float
    side_m: float
    amsl: Mapping[tuple[int, int], float]
    ellipsoid: Mapping[tuple[int, int], float]

    def amsl_minus_map_m(self, x: float, y: float) -> float | None:
        """What to add to a map height for AMSL (EGM96); None if no tile says."""
        return self._at(self.amsl, x, y)

    def ellipsoid_minus_map_m(self, x: float, y: float) -> float | None:
        """What to add to a map height for the height above the WGS 84 ellipsoid; None if no tile says."""
        return self._at(self.ellipsoid, x, y)

    def _at(self, offsets: Mapping[tuple[int, int], float], x: float, y: float) -> float | None:
        if not offsets:
            return None
        # Centres at integers.
        column, row = (x - self.west) / self.side_m - 0.5, (self.top - y) / self.side_m - 0.5
        left, upper = math.floor(column), math.floor(row)
        total = weights = 0.0
        for key in ((left, upper), (left + 1, upper), (left, upper + 1), (left + 1, upper + 1)):
            offset = offsets.get(key)
            if offset is not None:
                weight = (1.0 - abs(column - key[0])) * (1.0 - abs(row - key[1]))
                total, weights = total + weight * offset, weights + weight
        if weights > 0.0:
            return total / weights
        keys = np.array(list(offsets), dtype=np.float64)
        nearest = int(np.hypot(*(keys - (column, row)).T).argmin())
        return list(offsets.values())[nearest]


@dataclass(frozen=True, slots=True)
class Geodetic:
    """A position on WGS 84. A height is None where the pack's vertical datum does not give it."""

    lat_deg: float
    lon_deg: float
    height_ellipsoid_m: float | None
    height_amsl_m: float | None


@dataclass(frozen=True, slots=True, eq=False)
class LocalFrame:
    """True metres around an origin: ``local = ((E, N) - origin) / grid_scale``, heights unchanged.

    Attributes:
        origin_easting_m, origin_northing_m: map coordinates of the local origin.
        grid_scale: grid metres per true metre there.
    """

    origin_easting_m: float
    origin_northing_m: float
    grid_scale: float

    def __post_init__(self) -> None:
        values = (self.origin_easting_m, self.origin_northing_m, self.grid_scale)
        if not (np.isfinite(values).all() and self.grid_scale > 0):
            raise ValueError(f"local frame: origin or scale {values} unusable")

    def local_from_map(self, points_map: npt.ArrayLike) -> FloatArray:
        """Points (..., 3) float64 from map to local metres."""
        points = np.array(points_map, dtype=np.float64)
        points[..., :2] = (points[..., :2] - (self.origin_easting_m, self.origin_northing_m)) / self.grid_scale
        return points

    def map_from_local(self, points_local: npt.ArrayLike) -> FloatArray:
        """Inverse of :meth:`local_from_map`."""
        points = np.array(points_local, dtype=np.float64)
        points[..., :2] = points[..., :2] * self.grid_scale + (self.origin_easting_m, self.origin_northing_m)
        return points

    def local_from_map_pose(self, map_from_camera: Rigid3) -> Rigid3:
        """``local_from_camera``. The rotation stays: the projections we accept are conformal."""
        return Rigid3(map_from_camera.rotation, self.local_from_map(map_from_camera.translation))

    def map_from_local_pose(self, local_from_camera: Rigid3) -> Rigid3:
        """Inverse of :meth:`local_from_map_pose`."""
        return Rigid3(local_from_camera.rotation, self.map_from_local(local_from_camera.translation))


@dataclass(frozen=True, slots=True, eq=False)
class Georeference:
    """A projected reference system, or none (a local metric frame), with its vertical datum.

    Safe to call from several threads. The way to WGS 84 is PROJ's best at each place: for ETRS89 and NAD83 (2011)
    systems the null transformation, which leaves out the plates' motion (0.8 m in Europe, about 1.2 m in the USA by
    now). A datum that PROJ knows nothing of is taken for WGS 84: a build refuses it, see `systems`.

    Attributes:
        crs: "EPSG:n" or WKT of a projected, conformal system in metres; None: local metres, where convergence
            is 0, scale is 1, and geodetic conversions raise MapError.
        vertical: datum of the pack's heights.
        anchor: (easting, northing) in the area, m, where the system must be valid.
        offsets: of heights, by place; where they say nothing those of ``vertical`` hold everywhere.
    Raises: MapError for a system that cannot carry poses: geographic, not in metres, not conformal, unreadable.
    """

    crs: str | None
    vertical: VerticalDatum
    anchor: tuple[float, float]
    offsets: HeightOffsets | None = None
    _system: Any = field(init=False, repr=False)
    _name: str = field(init=False, repr=False)

    def __post_init__(self) -> None:
        system, name = (None, "") if self.crs is None else _map_system(self.crs)
        object.__setattr__(self, "_system", system)
        object.__setattr__(self, "_name", name)
        if system is None:
            return
        most, least = np.linalg.svd(self._true_from_grid(self.anchor), compute_uv=False)
        if not least > 0.0:
            raise MapError(f"{name}: {self.anchor} lies outside its domain; rebuild the pack or copy it again")
        if not most / least - 1.0 <= _MAX_ANISOTROPY:
            lon, lat = self._lon_lat([self.anchor[0]], [self.anchor[1]])[0]
            raise MapError(
                f"{name}: not conformal, a metre one way is {most / least:.4f} of one across it at {self.anchor};"
                f" reproject with: gdalwarp -t_srs {utm_code(lat, lon)}"
            )

    def geodetic_from_map(self, points_map: npt.ArrayLike) -> Geodetic:
        """Position on WGS 84 of a map point (3,): easting, northing, height in m."""
        x, y, z = np.asarray(points_map, dtype=np.float64)
        lon_deg, lat_deg = self._lon_lat([float(x)], [float(y)])[0]
        height_m = float(z)
        ellipsoid, amsl = self.ellipsoid_minus_map_m((x, y)), self.amsl_minus_map_m((x, y))
        return Geodetic(
            float(lat_deg),
            float(lon_deg),
            None if ellipsoid is None else height_m + ellipsoid,
            None if amsl is None else height_m + amsl,
        )

    def map_from_geodetic(
        self,
        lat_deg: float,
        lon_deg: float,
        *,
        height_amsl_m: float | None = None,
        height_ellipsoid_m: float | None = None,
    ) -> FloatArray:
        """Map point (3,) of a WGS 84 position with one of the two heights.

        Raises: MapError where the pack has no CRS, its vertical datum does not give that height, or the
            position has no image in the projection; ValueError unless exactly one height is given.
        """
        if (height_amsl_m is None) == (height_ellipsoid_m is None):
            raise ValueError("map_from_geodetic takes exactly one of height_amsl_m and height_ellipsoid_m")
        x, y = self._transformed(_WGS84, self._projected(), [float(lon_deg)], [float(lat_deg)])[0]
        if height_amsl_m is not None:
            height_m, offset_m, wanted = height_amsl_m, self.amsl_minus_map_m((x, y)), "above mean sea level"
        else:
            assert height_ellipsoid_m is not None
            height_m, offset_m = height_ellipsoid_m, self.ellipsoid_minus_map_m((x, y))
            wanted = "above the ellipsoid"
        if offset_m is None:
            raise self.vertical.unknown(wanted)
        return np.array([x, y, height_m - offset_m])

    def map_from_lat_lon(self, lat_lon_deg: npt.ArrayLike) -> FloatArray:
        """Map positions (N, 2) of WGS 84 latitudes and longitudes (N, 2), without heights.

        Raises: MapError where the pack has no CRS, or one of them has no image in the projection.
        """
        lat, lon = np.asarray(lat_lon_deg, dtype=np.float64).reshape(-1, 2).T.tolist()
        return self._transformed(_WGS84, self._projected(), lon, lat)

    def amsl_minus_map_m(self, xy_map: npt.ArrayLike) -> float | None:
        """What to add to a map height at a map position (2,) for AMSL (EGM96), m; None: not known."""
        x, y = np.asarray(xy_map, dtype=np.float64)
        offset = None if self.offsets is None else self.offsets.amsl_minus_map_m(float(x), float(y))
        return self.vertical.amsl_minus_map_m if offset is None else offset

    def ellipsoid_minus_map_m(self, xy_map: npt.ArrayLike) -> float | None:
        """What to add to a map height at a map position (2,) for the height above WGS 84, m; None: not known."""
        x, y = np.asarray(xy_map, dtype=np.float64)
        offset = None if self.offsets is None else self.offsets.ellipsoid_minus_map_m(float(x), float(y))
        return self.vertical.ellipsoid_minus_map_m if offset is None else offset

    def convergence_rad(self, xy_map: npt.ArrayLike) -> float:
        """Angle from true north to grid north at a map position, clockwise positive.

        ``yaw_grid = yaw_true - convergence``; east of a UTM zone's central meridian in the north it is positive.
        """
        if self._system is None:
            return 0.0
        east, north = self._true_from_grid(xy_map)[:, 1]
        return math.atan2(east, north)

    def grid_scale(self, xy_map: npt.ArrayLike, height_m: float) -> float:
        """Grid metres per true metre at a map position and height: point scale factor times R / (R + h).

        The height should be ellipsoidal; without the offset a map height serves (50 m are 8e-6).
        """
        if self._system is None:
            return 1.0
        k = 1.0 / math.sqrt(abs(np.linalg.det(self._true_from_grid(xy_map))))
        height_ellipsoid_m = height_m + (self.vertical.ellipsoid_minus_map_m or 0.0)
        return k * _EARTH_RADIUS_M / (_EARTH_RADIUS_M + height_ellipsoid_m)

    def local_frame(self, xy_map: npt.ArrayLike, height_m: float) -> LocalFrame:
        """Frame of true metres with its origin at a map position; the scale is right at ``height_m``."""
        x, y = np.asarray(xy_map, dtype=np.float64)
        return LocalFrame(float(x), float(y), self.grid_scale((x, y), height_m))

    def _true_from_grid(self, xy_map: npt.ArrayLike) -> FloatArray:
        """(2, 2): metres on the ellipsoid, east and north, of a grid metre eastward and of one northward."""
        x, y = (float(value) for value in np.asarray(xy_map, dtype=np.float64))
        d = _PROBE_M
        lon_lat = np.deg2rad(self._lon_lat([x, x + d, x - d, x, x], [y, y, y, y + d, y - d]))
        east, west, north, south = (ecef_from_geodetic(lat, lon, 0.0) for lon, lat in lon_lat[1:])
        ned_from_ecef = ned_from_ecef_rotation(lon_lat[0, 1], lon_lat[0, 0])
        steps = ned_from_ecef[[1, 0]] @ np.column_stack([east - west, north - south])
        return np.asarray(steps / (2.0 * d), dtype=np.float64)

    def _lon_lat(self, x: Sequence[float], y: Sequence[float]) -> FloatArray:
        """Longitudes and latitudes (N, 2) on WGS 84, degrees, of map positions."""
        return self._transformed(self._projected(), _WGS84, x, y)

    def _projected(self) -> Any:
        if self._system is None:
            raise MapError(
                "area pack without a CRS: it has local metres only, no latitude and longitude;"
                " rebuild it from rasters with a projected CRS (gdal_translate -a_srs EPSG:n assigns one)"
            )
        return self._system

    def _transformed(self, source: Any, target: Any, x: Sequence[float], y: Sequence[float]) -> FloatArray:
        """Positions (N, 2), x first: rasterio counts longitude or easting as x, whatever the system's own order."""
        # Where some of several points have no image, PROJ may either raise or give infinities.
        try:
            moved = np.column_stack(transform(source, target, x, y))
        except CPLE_BaseError as err:
            raise MapError(
                f"position ({x[0]}, {y[0]}) lies outside the domain of {self._name} ({err}); check it"
            ) from err
        if not np.isfinite(moved).all():
            raise MapError(f"position ({x[0]}, {y[0]}) lies outside the domain of {self._name}; check it")
        return moved


def horizontal_part(system: Mapping[str, Any], what: str) -> Mapping[str, Any]:
    """The horizontal part of a reference system that a map can have: projected, in metres, counted eastward.

    Args:
        system: as PROJJSON.
        what: what has this system, to start the message with.
    Raises: MapError with the remedy.
    """
    while system["type"] in ("CompoundCRS", "BoundCRS"):
        system = system["components"][0] if system["type"] == "CompoundCRS" else system["source_crs"]
    name = system["name"]
    if "Geographic" in system["type"]:
        raise MapError(
            f"{what}: {name} is geographic (degrees), poses need metres;"
            " reproject with: gdalwarp -t_srs EPSG:326ZZ (north) or EPSG:327ZZ (south), ZZ the UTM zone"
        )
    if "Projected" not in system["type"]:
        raise MapError(
            f"{what}: {name} is a {system['type']}, not a projected system; assign the right one with"
            " gdal_translate -a_srs EPSG:n, or remove it with gdal_edit.py -a_srs none for local metres"
        )
    # A 3D projected CRS has a vertical axis whose unit is checked with the vertical datum.
    for axis in system["coordinate_system"]["axis"][:2]:
        if axis["direction"] == "west":
            raise MapError(
                f"{what}: {name} counts westward, a map needs eastings and northings;"
                " reproject with: gdalwarp -t_srs EPSG:326ZZ (UTM) or its east-north sibling"
            )
        unit = axis["unit"]
        if unit != "metre" and not (isinstance(unit, Mapping) and abs(unit["conversion_factor"] - 1.0) <= 1e-12):
            raise MapError(
                f"{what}: {name} counts in {unit['name'] if isinstance(unit, Mapping) else unit}, poses need metres;"
                " reproject with: gdalwarp -t_srs EPSG:326ZZ (UTM) or the metric sibling of this system"
            )
    return system


def _map_system(crs: str) -> tuple[Any, str]:
    """rasterio's CRS of the horizontal part of a system, and its name."""
    what = f"area pack in {_shortened(crs)}"
    try:
        whole = CRS.from_user_input(crs).to_dict(projjson=True)
        flat = horizontal_part(whole, what)
        return CRS.from_user_input(crs if flat is whole else json.dumps(flat)), str(flat["name"])
    except CRSError as err:
        raise MapError(f"{what}: reference system not understood ({err}); name it as EPSG:n or WKT") from err


def utm_code(lat: float, lon: float) -> str:
    """EPSG code of the UTM zone of a place, degrees."""
    zone = int((lon + 180.0) // 6.0) % 60 + 1
    return f"EPSG:{(32600 if lat >= 0 else 32700) + zone}"


def _shortened(crs: str) -> str:
    return crs if len(crs) <= 40 else crs[:37] + "..."
