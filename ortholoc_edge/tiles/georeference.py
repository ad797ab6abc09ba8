"""From the pack's map coordinates to the world's: geodetic position, true north, true metres, named heights.

Two traps decide the shape of this module. Grid north is not true north (1.5 degrees apart in the middle of a
UTM zone's half, more toward the poles), and a grid metre is not a metre (0.4 per mille on the central
meridian). And PROJ, asked for a vertical transformation whose geoid grid is not installed, answers with the
unchanged height; so heights move here only by offsets that were derived once, when the pack was built, from
an operation that demonstrably used a grid, or from a figure that the user stated.
"""

from __future__ import annotations

import logging
import math
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
import numpy.typing as npt
import pyproj
from pyproj import CRS, Transformer
from pyproj.aoi import AreaOfInterest
from pyproj.exceptions import CRSError, ProjError
from pyproj.network import set_network_enabled  # type: ignore[attr-defined]  # documented, not in __all__
from pyproj.transformer import TransformerGroup

from ortholoc_edge.errors import ConfigError, MapError
from ortholoc_edge.geometry.arrays import FloatArray
from ortholoc_edge.geometry.rigid import Rigid3

logger = logging.getLogger(__name__)

# Mean Earth radius (IUGG). The local radius differs by up to 0.4 %, which at a height of 5 km moves the scale
# by 3e-6.
_EARTH_RADIUS_M = 6371008.8

# Meridional against parallel scale, measured over a probe: UTM, Lambert conformal and the oblique Mercators
# stay below 1e-7; equal-area projections and web Mercator's mix of sphere and ellipsoid exceed 1e-3.
_MAX_ANISOTROPY = 1e-4
_PROBE_M = 100.0

# Geoid undulations on Earth lie within -107 to +86 m (EGM96).
_MAX_UNDULATION_M = 120.0

# National zero levels lie within about 2 m of EGM96's; a stated undulation further off than this from PROJ's
# is a wrong sign or a wrong place.
_MAX_UNDULATION_DISAGREEMENT_M = 3.0

_EGM96_EPSG = 5773
_NAVD88_EPSG = 5703

# 1 sigma of the way from a map height to EGM96's: by a grid (interpolation, slope of the geoid over the area), or
# by taking another sea level for it.
_GRID_SIGMA_M = 0.1
_ZERO_LEVEL_SIGMA_M = 1.0
_NAVD88_SIGMA_M = 2.0
_AREA_MARGIN_DEG = 0.5

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

    Safe to call from several threads. The way to WGS 84 is PROJ's: for ETRS89 and NAD83 (2011) systems the null
    transformation, which leaves out the plates' motion (0.8 m in Europe, about 1.2 m in the USA by now).

    Attributes:
        crs: "EPSG:n" or WKT of a projected, conformal system in metres; None: local metres, where convergence
            is 0, scale is 1, and geodetic conversions raise MapError.
        vertical: datum of the pack's heights.
        anchor: (easting, northing) in the area, m; picks the datum transformation that is valid there.
        offsets: of heights, by place; where they say nothing those of ``vertical`` hold everywhere.
    Raises: MapError for a system that cannot carry poses: geographic, not in metres, not conformal, unreadable.
    """

    crs: str | None
    vertical: VerticalDatum
    anchor: tuple[float, float]
    offsets: HeightOffsets | None = None
    _proj: Any = field(init=False, repr=False)
    _geodetic_from_map: Any = field(init=False, repr=False)

    def __post_init__(self) -> None:
        proj = transformer = None
        if self.crs is not None:
            crs = projected_crs(self.crs, f"area pack in {_shortened(self.crs)}")
            proj = pyproj.Proj(crs)
            _factors(proj, self.anchor, crs)
            ratio = _north_over_east_scale(crs, proj, self.anchor)
            if not abs(ratio - 1.0) <= _MAX_ANISOTROPY:
                raise MapError(
                    f"{crs.name}: not conformal, a metre north is {ratio:.4f} of a metre east at {self.anchor};"
                    f" reproject with: gdalwarp -t_srs {_utm_code(*proj(*self.anchor, inverse=True))}"
                )
            transformer = _wgs84_transformer(crs, proj, self.anchor)
        object.__setattr__(self, "_proj", proj)
        object.__setattr__(self, "_geodetic_from_map", transformer)

    def geodetic_from_map(self, points_map: npt.ArrayLike) -> Geodetic:
        """Position on WGS 84 of a map point (3,): easting, northing, height in m."""
        x, y, z = np.asarray(points_map, dtype=np.float64)
        lon_deg, lat_deg = self._transform(float(x), float(y), "FORWARD")
        height_m = float(z)
        ellipsoid, amsl = self.ellipsoid_minus_map_m((x, y)), self.amsl_minus_map_m((x, y))
        return Geodetic(
            lat_deg,
            lon_deg,
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
        x, y = self._transform(lon_deg, lat_deg, "INVERSE")
        if height_amsl_m is not None:
            height_m, offset_m, wanted = height_amsl_m, self.amsl_minus_map_m((x, y)), "above mean sea level"
        else:
            assert height_ellipsoid_m is not None
            height_m, offset_m = height_ellipsoid_m, self.ellipsoid_minus_map_m((x, y))
            wanted = "above the ellipsoid"
        if offset_m is None:
            raise self.vertical.unknown(wanted)
        return np.array([x, y, height_m - offset_m])

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
        if self._proj is None:
            return 0.0
        return float(np.deg2rad(_factors(self._proj, xy_map, self._proj.crs).meridian_convergence))

    def grid_scale(self, xy_map: npt.ArrayLike, height_m: float) -> float:
        """Grid metres per true metre at a map position and height: point scale factor times R / (R + h).

        The height should be ellipsoidal; without the offset a map height serves (50 m are 8e-6).
        """
        if self._proj is None:
            return 1.0
        factors = _factors(self._proj, xy_map, self._proj.crs)
        k = np.sqrt(factors.meridional_scale * factors.parallel_scale)
        height_ellipsoid_m = height_m + (self.vertical.ellipsoid_minus_map_m or 0.0)
        return float(k * _EARTH_RADIUS_M / (_EARTH_RADIUS_M + height_ellipsoid_m))

    def local_frame(self, xy_map: npt.ArrayLike, height_m: float) -> LocalFrame:
        """Frame of true metres with its origin at a map position; the scale is right at ``height_m``."""
        x, y = np.asarray(xy_map, dtype=np.float64)
        return LocalFrame(float(x), float(y), self.grid_scale((x, y), height_m))

    def _transform(self, a: float, b: float, direction: Literal["FORWARD", "INVERSE"]) -> tuple[float, float]:
        if self._geodetic_from_map is None:
            raise MapError(
                "area pack without a CRS: it has local metres only, no latitude and longitude;"
                " rebuild it from rasters with a projected CRS (gdal_translate -a_srs EPSG:n assigns one)"
            )
        try:
            first, second = self._geodetic_from_map.transform(a, b, errcheck=True, direction=direction)
        except ProjError as err:
            raise MapError(f"position ({a}, {b}) cannot be converted by {self.crs}: {err}") from err
        if not np.isfinite([first, second]).all():
            raise MapError(f"position ({a}, {b}) lies outside the domain of {self.crs}; check it")
        return float(first), float(second)


def datum_shift_caveat(crs: str, lat_lon_deg: tuple[float, float]) -> str | None:
    """What PROJ lacks for the best way from ``crs`` to WGS 84 at a place; None if nothing.

    Without its grid an old national datum (DHDN, NAD27) is shifted by a few parameters, metres off.
    """
    lat, lon = lat_lon_deg
    group = _group(projected_crs(crs, crs), "EPSG:4326", lon, lat)
    if group.best_available or not group.unavailable_operations:
        return None
    grids = [grid.short_name for grid in group.unavailable_operations[0].grids if not grid.available]
    accuracies = [one.accuracy for one in group.transformers if one.accuracy >= 0]
    good_to = f"to about {min(accuracies):g} m" if accuracies else "to nobody knows what"
    return f"PROJ lacks {', '.join(grids)}: latitudes and longitudes are good {good_to}"


def projected_crs(crs: str, what: str) -> CRS:
    """The horizontal part of a projected reference system in metres.

    Args:
        crs: anything PROJ reads; the height axis of a compound system is dropped (see :func:`vertical_of`).
        what: what has this system, to start the message with.
    Raises: MapError with the remedy if it is unreadable, geographic, not projected or not in metres.
    """
    parsed = _parsed(crs, what)
    parsed = parsed.sub_crs_list[0] if parsed.is_compound else parsed
    parsed = parsed.source_crs if parsed.is_bound and parsed.source_crs is not None else parsed
    if parsed.is_geographic:
        raise MapError(
            f"{what}: {parsed.name} is geographic (degrees), poses need metres;"
            " reproject with: gdalwarp -t_srs EPSG:326ZZ (north) or EPSG:327ZZ (south), ZZ the UTM zone"
        )
    if not parsed.is_projected:
        raise MapError(
            f"{what}: {parsed.name} is {parsed.type_name}, not a projected system; assign the right one with"
            " gdal_translate -a_srs EPSG:n, or remove it with gdal_edit.py -a_srs none for local metres"
        )
    # A 3D projected CRS has a vertical axis whose unit is checked with the vertical datum.
    for axis in parsed.axis_info[:2]:
        if axis.direction == "west":
            raise MapError(
                f"{what}: {parsed.name} counts westward, a map needs eastings and northings;"
                " reproject with: gdalwarp -t_srs EPSG:326ZZ (UTM) or its east-north sibling"
            )
        if abs(axis.unit_conversion_factor - 1.0) > 1e-12:
            raise MapError(
                f"{what}: {parsed.name} counts in {axis.unit_name}, poses need metres;"
                " reproject with: gdalwarp -t_srs EPSG:326ZZ (UTM) or the metric sibling of this system"
            )
    return parsed.to_2d()


def vertical_of(crs: str, what: str) -> tuple[VerticalKind, int | None] | None:
    """Kind and EPSG code of the heights that a compound or 3D system names; None if it names none."""
    parsed = _parsed(crs, what)
    if parsed.is_compound and len(parsed.sub_crs_list) > 1:
        vertical = parsed.sub_crs_list[1]
        _require_metre_heights(vertical.axis_info[0], vertical.name, what)
        ellipsoidal = "ellipsoid" in vertical.axis_info[0].name.lower()
        return ("ellipsoid", None) if ellipsoidal else ("orthometric", vertical.to_epsg())
    if len(parsed.axis_info) == 3:
        _require_metre_heights(parsed.axis_info[2], parsed.name, what)
        return ("ellipsoid", None)
    return None


def derive_offsets(
    kind: VerticalKind,
    epsg: int | None,
    geoid_undulation_m: float | None,
    lat_lon_deg: npt.ArrayLike | None,
    *,
    quiet: bool = False,
) -> tuple[VerticalDatum, FloatArray | None, FloatArray | None]:
    """Vertical datum with its two offsets, over an area.

    Offsets come from PROJ where it has the geoid grid for all of the area, else from the undulation that the user
    stated. Heights above a sea level whose grid is missing are taken as AMSL, with a warning: the national zeros
    lie within 0.2-1 m of EGM96's (NAVD88: 1-2 m); the derivation says so and ``amsl_sigma_m`` has the figure.
    Args:
        geoid_undulation_m: height of the geoid above the ellipsoid in the area, m.
        lat_lon_deg: (N, 2) places, the anchor first; None for a local frame, where PROJ cannot help.
        quiet: without the warning, where it was given before.
    Returns: the datum with the offsets at the first place; (N,) ``amsl_minus_map_m`` at the places; (N,)
        ``ellipsoid_minus_map_m``. The arrays are None where the datum's value is, and for a local frame.
    Raises: ConfigError for values that contradict each other, and for heights above the ellipsoid whose geoid
        neither PROJ nor the user knows; MapError for an EPSG code that is no vertical system in metres.
    """
    if kind == "unknown":
        if geoid_undulation_m is not None or epsg is not None:
            raise ConfigError(
                "--geoid-undulation-m and --vertical-epsg say nothing without the kind of heights; add"
                " --vertical ellipsoid or --vertical orthometric"
            )
        return VerticalDatum(kind="unknown", derivation="stated as unknown when the pack was built"), None, None
    if geoid_undulation_m is not None and not abs(geoid_undulation_m) <= _MAX_UNDULATION_M:
        raise ConfigError(
            f"--geoid-undulation-m {geoid_undulation_m}: beyond +-{_MAX_UNDULATION_M:.0f} m, where no geoid is;"
            " state the height of the geoid above the ellipsoid in metres"
        )
    places = None if lat_lon_deg is None else np.asarray(lat_lon_deg, dtype=np.float64).reshape(-1, 2)
    amsl_minus_ellipsoid = _grid_offsets("EPSG:4979", f"EPSG:4326+{_EGM96_EPSG}", places)
    if kind == "ellipsoid":
        return _of_ellipsoid(epsg, geoid_undulation_m, amsl_minus_ellipsoid, places)
    found = _of_sea_level(epsg, geoid_undulation_m, amsl_minus_ellipsoid, places)
    datum = found[0]
    if not quiet and datum.amsl_sigma_m is not None and datum.amsl_sigma_m >= _ZERO_LEVEL_SIGMA_M:
        logger.warning(
            "%s: PROJ has no geoid grid that leads to EGM96, so heights are taken as AMSL, good to %g m (1 sigma)",
            datum.name or "heights above a sea level that is not named", datum.amsl_sigma_m,
        )  # fmt: skip
    return found


def _of_ellipsoid(
    epsg: int | None, stated_m: float | None, amsl_minus_ellipsoid: FloatArray | None, places: FloatArray | None
) -> tuple[VerticalDatum, FloatArray | None, FloatArray | None]:
    if epsg is not None:
        raise ConfigError("--vertical-epsg names a sea level; it goes with --vertical orthometric")
    _check_undulation(stated_m, amsl_minus_ellipsoid)
    if amsl_minus_ellipsoid is not None:
        amsl_m, sigma_m, derivation = float(amsl_minus_ellipsoid[0]), _GRID_SIGMA_M, "geoid EGM96 through PROJ"
    elif stated_m is not None:
        amsl_m, sigma_m = -stated_m, 0.0
        derivation = f"geoid {stated_m:+.2f} m above the ellipsoid, as stated"
        amsl_minus_ellipsoid = _everywhere(amsl_m, places)
    else:
        raise ConfigError(
            "heights are above the ellipsoid, and the geoid there is not known: state it with --geoid-undulation-m"
            " METRES (geoid above ellipsoid), or give PROJ its grid: us_nga_egm96_15.tif in the folder PROJ_DATA,"
            " or projsync --file us_nga_egm96_15.tif"
        )
    datum = VerticalDatum(
        kind="ellipsoid",
        name="WGS 84 ellipsoid",
        amsl_minus_map_m=amsl_m,
        ellipsoid_minus_map_m=0.0,
        derivation=derivation,
        amsl_sigma_m=sigma_m,
    )
    return datum, amsl_minus_ellipsoid, _everywhere(0.0, places)


def _of_sea_level(
    epsg: int | None, stated_m: float | None, amsl_minus_ellipsoid: FloatArray | None, places: FloatArray | None
) -> tuple[VerticalDatum, FloatArray | None, FloatArray | None]:
    name = None if epsg is None else _vertical_name(epsg)
    ellipsoid = None if epsg is None else _grid_offsets(f"EPSG:4326+{epsg}", "EPSG:4979", places)
    amsl: FloatArray | None
    if ellipsoid is not None:
        _check_undulation(stated_m, -ellipsoid)
    if ellipsoid is not None and amsl_minus_ellipsoid is not None:
        amsl, derivation = ellipsoid + amsl_minus_ellipsoid, f"{name} and EGM96 through PROJ"
        sigma_m = 0.0 if epsg == _EGM96_EPSG else _GRID_SIGMA_M
    elif epsg == _EGM96_EPSG:
        amsl, sigma_m, derivation = _everywhere(0.0, places), 0.0, "heights are EGM96's own"
    else:
        amsl = _everywhere(0.0, places)
        derivation = "its zero taken as EGM96's, which is true to about 1 m (NAVD88: 2 m)"
        sigma_m = _NAVD88_SIGMA_M if epsg == _NAVD88_EPSG else _ZERO_LEVEL_SIGMA_M
    ellipsoid_m = None if ellipsoid is None else float(ellipsoid[0])
    if ellipsoid is None and stated_m is not None:
        ellipsoid_m, ellipsoid = stated_m, _everywhere(stated_m, places)
        derivation += f"; geoid {stated_m:+.2f} m above the ellipsoid, as stated"
    datum = VerticalDatum(
        kind="orthometric",
        name=name,
        epsg=epsg,
        amsl_minus_map_m=0.0 if amsl is None else float(amsl[0]),
        ellipsoid_minus_map_m=ellipsoid_m,
        derivation=derivation,
        amsl_sigma_m=sigma_m,
    )
    return datum, amsl, ellipsoid


def _everywhere(offset_m: float, places: FloatArray | None) -> FloatArray | None:
    return None if places is None else np.full(len(places), offset_m)


def _grid_offsets(source: str, target: str, places: FloatArray | None) -> FloatArray | None:
    """Target height minus source height, m, at places (N, 2) as latitude and longitude, by one operation that uses a
    grid; None if PROJ has none that covers them all.

    PROJ falls back to leaving the height alone, and tells only in the operation's metadata; hence the choice
    by grids here instead of taking what `Transformer.from_crs` gives.
    """
    if places is None:
        return None
    lat, lon = places.T
    group = _group(source, target, lon, lat)
    for transformer in group.transformers:
        operations = transformer.operations or ()
        grids = [grid for operation in operations for grid in operation.grids]
        if not grids or not all(grid.available for grid in grids):
            continue
        heights = np.asarray(transformer.transform(lon, lat, np.zeros(len(lon)))[2], dtype=np.float64)
        if np.isfinite(heights).all():
            return heights
    return None


def _group(source: CRS | str, target: str, lon: npt.ArrayLike, lat: npt.ArrayLike) -> TransformerGroup:
    """PROJ's ways between two systems over some places, best first, without those that pretend."""
    # A grid fetched from the network today would be missing on the next build; the pack would differ.
    set_network_enabled(active=False)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Best transformation is not available")
        return TransformerGroup(source, target, always_xy=True, area_of_interest=_area(lon, lat), allow_ballpark=False)


def _check_undulation(stated_m: float | None, amsl_minus_ellipsoid: FloatArray | None) -> None:
    """At the first place: over a large area the geoid itself may move by more than the tolerance."""
    if stated_m is None or amsl_minus_ellipsoid is None:
        return
    found_m = -float(amsl_minus_ellipsoid[0])
    if abs(stated_m - found_m) > _MAX_UNDULATION_DISAGREEMENT_M:
        raise ConfigError(
            f"--geoid-undulation-m {stated_m:+.2f}: PROJ's geoid lies {found_m:+.2f} m above"
            " the ellipsoid here; correct the value (the sign is geoid above ellipsoid) or leave it out"
        )


def _vertical_name(epsg: int) -> str:
    crs = _parsed(f"EPSG:{epsg}", f"--vertical-epsg {epsg}")
    if not crs.is_vertical:
        raise MapError(f"--vertical-epsg {epsg}: {crs.name} is no vertical system; name one such as 5773 or 7837")
    _require_metre_heights(crs.axis_info[0], crs.name, f"--vertical-epsg {epsg}")
    return str(crs.name)


def _require_metre_heights(axis: Any, name: str, what: str) -> None:
    if abs(axis.unit_conversion_factor - 1.0) > 1e-12 or axis.direction != "up":
        raise MapError(
            f"{what}: heights of {name} are in {axis.unit_name}, {axis.direction}; convert them to metres, up"
            " (gdal_calc.py) and name the metric vertical system"
        )


def _parsed(crs: str, what: str) -> CRS:
    try:
        return CRS.from_user_input(crs)
    except CRSError as err:
        raise MapError(f"{what}: reference system not understood ({err}); name it as EPSG:n or WKT") from err


def _factors(proj: Any, xy_map: npt.ArrayLike, crs: CRS) -> Any:
    x, y = np.asarray(xy_map, dtype=np.float64)
    try:
        lon, lat = proj(float(x), float(y), inverse=True, errcheck=True)
        return proj.get_factors(lon, lat, errcheck=True)
    except ProjError as err:
        raise MapError(f"position ({x:.1f}, {y:.1f}) lies outside the domain of {crs.name}: {err}") from err


def _north_over_east_scale(crs: CRS, proj: Any, xy_map: tuple[float, float]) -> float:
    """Grid metres per true metre going north, over the same going east.

    Measured with geodesics, because PROJ's own factors call web Mercator conformal: it is, on a sphere.
    """
    geod, (lon, lat) = crs.get_geod(), proj(*xy_map, inverse=True)
    assert geod is not None, "a projected system has an ellipsoid"
    lengths = []
    for azimuth_deg in (0.0, 90.0):
        ends = [geod.fwd(lon, lat, azimuth_deg + turn, _PROBE_M)[:2] for turn in (0.0, 180.0)]
        (x0, y0), (x1, y1) = (proj(*end) for end in ends)
        lengths.append(np.hypot(x1 - x0, y1 - y0))
    return float(lengths[0] / lengths[1])


def _wgs84_transformer(crs: CRS, proj: Any, anchor: tuple[float, float]) -> Transformer:
    lon, lat = proj(*anchor, inverse=True)
    try:
        return Transformer.from_crs(
            crs, "EPSG:4326", always_xy=True, area_of_interest=_area(lon, lat), allow_ballpark=False
        )
    except ProjError as err:
        raise MapError(
            f"{crs.name}: PROJ knows no way to WGS 84 at {lat:.3f}, {lon:.3f} ({err});"
            f" reproject the rasters with: gdalwarp -t_srs {_utm_code(lon, lat)}"
        ) from err


def _area(lon: npt.ArrayLike, lat: npt.ArrayLike) -> Any:
    lon, lat = np.asarray(lon), np.asarray(lat)
    return AreaOfInterest(
        max(float(lon.min()) - _AREA_MARGIN_DEG, -180.0),
        max(float(lat.min()) - _AREA_MARGIN_DEG, -90.0),
        min(float(lon.max()) + _AREA_MARGIN_DEG, 180.0),
        min(float(lat.max()) + _AREA_MARGIN_DEG, 90.0),
    )


def _utm_code(lon: float, lat: float) -> str:
    zone = int((lon + 180.0) // 6.0) % 60 + 1
    return f"EPSG:{(32600 if lat >= 0 else 32700) + zone}"


def _shortened(crs: str) -> str:
    return crs if len(crs) <= 40 else crs[:37] + "..."
