"""The part of the world a pack is for: a box, drawn polygons, or a corridor along routes.

``W,S,E,N``: degrees of longitude and latitude on WGS 84 if they can be such, else metres in the pack's reference
system; for a pack without one always metres. Numbers that fit neither (a latitude of 110) are refused, as are
boxes across the antimeridian, which a GeoJSON says better: as a MultiPolygon cut there (RFC 7946, 3.1.9).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pyproj
import rasterio.features
from pyproj.aoi import AreaOfInterest
from pyproj.exceptions import ProjError
from pyproj.network import set_network_enabled  # type: ignore[attr-defined]  # documented, not in __all__

from ortholoc_edge.errors import ConfigError, MapError
from ortholoc_edge.geometry.arrays import BoolArray, FloatArray
from ortholoc_edge.geometry.grid import RasterGrid
from ortholoc_edge.tiles.drawing import LONLAT, Drawing, read_drawing
from ortholoc_edge.tiles.lattice import Bounds
from ortholoc_edge.tiles.systems import projected_crs

# Full width of the strip along a line: a nadir camera of 70 degrees sees 170 m from 120 m up, and navigation
# without fixes drifts by some tens of metres before the next.
DEFAULT_CORRIDOR_M = 500.0
_MAX_CORRIDOR_M = 100_000.0
# Coordinates that nobody would write in degrees, so that they are metres.
_SURELY_METRES = 360.0
# A box of less is degrees taken for metres, one of more the whole Earth or feet.
_MIN_SIDE_M, _MAX_SIDE_M = 1.0, 2e6
# How far a straight line in the map may leave the true, curved one.
_BEND_TOLERANCE_M = 0.05
_MAX_PIECES = 4096
# Of a pixel: how far the polygons that stand for discs stay inside them.
_DISC_TOLERANCE_PX = 0.05
_PROBE_M = 100.0
# As `systems` has it, so that both take the same way through PROJ.
_INTEREST_MARGIN_DEG = 0.5


@dataclass(frozen=True, slots=True)
class Area:
    """An area as given, before it is known which reference system the pack will have.

    Attributes:
        name: as given, to start messages with.
        box: W, S, E, N as given; None: ``drawing`` holds the area.
        corridor_m: full width of the strip along the drawing's lines, half of it to each side.
    """

    name: str
    box: Bounds | None
    drawing: Drawing | None
    corridor_m: float

    @property
    def in_degrees(self) -> bool:
        """Whether a box can be degrees."""
        if self.box is None:
            return False
        west, south, east, north = self.box
        return max(abs(west), abs(east)) <= 180 and max(abs(south), abs(north)) <= 90

    def on_map(self, crs: str | None) -> MapArea:
        """The area in a pack's reference system; None: local metres, in which only boxes can be given.

        Raises: ConfigError for an area that cannot be meant; MapError for one that the system cannot show.
        """
        if self.box is not None:
            area = self._box_on_map(self.box, crs)
        else:
            assert self.drawing is not None
            area = self._drawing_on_map(self.drawing, crs)
        west, south, east, north = area.bounds
        width, height = east - west, north - south
        if min(width, height) < _MIN_SIDE_M or max(width, height) > _MAX_SIDE_M:
            raise ConfigError(
                f"{self.name}: {width:.4g} m x {height:.4g} m on the map; an area is from {_MIN_SIDE_M:g} m to"
                f" {_MAX_SIDE_M / 1e3:.0f} km, check it"
                + (" (degrees for a pack in local metres?)" if crs is None and self.in_degrees else "")
            )
        return area

    def _box_on_map(self, box: Bounds, crs: str | None) -> MapArea:
        west, south, east, north = box
        corners = np.array([(west, south), (east, south), (east, north), (west, north)])
        if crs is None:
            return MapArea(((corners,),), ())
        if self.in_degrees:
            return MapArea(((_ring_on_map(corners, LONLAT, crs, self.name),),), ())
        if max(map(abs, box)) <= _SURELY_METRES:
            raise ConfigError(
                f"{self.name}: neither longitudes and latitudes (west, south, east, north) nor plausible metres in"
                " the pack's reference system; are latitude and longitude swapped, or does it cross the"
                " antimeridian (give a GeoJSON MultiPolygon cut there)?"
            )
        return MapArea(((corners,),), ())

    def _drawing_on_map(self, drawing: Drawing, crs: str | None) -> MapArea:
        if crs is None:
            raise ConfigError(
                f"{self.name}: lies on the Earth, the pack's rasters are in local metres without a reference"
                " system; give the area as W,S,E,N in these metres"
            )
        polygons = tuple(
            tuple(_ring_on_map(np.array(ring), drawing.crs, crs, self.name) for ring in polygon)
            for polygon in drawing.polygons
        )
        strips = []
        for line in drawing.lines:
            points = _line_on_map(np.array([(v.x, v.y) for v in line]), drawing.crs, crs, self.name)
            # True metres to the map's, once per line: a scale changes by some per mille over 100 km.
            scale = _scale_at(points[len(points) // 2], crs)
            strips.append(Strip(points, 0.5 * self.corridor_m * scale))
        return MapArea(polygons, tuple(strips))


def read_area(spec: str, corridor_m: float | None) -> Area:
    """What ``--area`` and ``--corridor`` say.

    Args:
        spec: ``W,S,E,N`` or the path of a GeoJSON, KML, KMZ, .plan or .waypoints file.
        corridor_m: full width along lines; None: `DEFAULT_CORRIDOR_M`.
    Raises: ConfigError naming what is wrong and the remedy.
    """
    if corridor_m is not None and not 0 < corridor_m <= _MAX_CORRIDOR_M:
        raise ConfigError(
            f"--corridor {corridor_m:g}: give the full width in metres, above 0 and up to {_MAX_CORRIDOR_M:g}"
        )
    width_m = DEFAULT_CORRIDOR_M if corridor_m is None else corridor_m
    numbers = _numbers(spec)
    if numbers is not None:
        if corridor_m is not None:
            raise ConfigError(f"--corridor {corridor_m:g}: a box has no line to go along; leave it out")
        return Area(f"--area {spec}", _checked_box(numbers, spec), None, width_m)
    path = Path(spec)
    if not path.exists():
        raise ConfigError(
            f"--area {spec}: neither W,S,E,N (four numbers with commas) nor a file that is there; correct it"
        )
    drawing = read_drawing(path)
    if corridor_m is not None and not drawing.lines:
        raise ConfigError(f"--corridor {corridor_m:g}: {spec} has no line to go along; leave it out")
    return Area(drawing.name, None, drawing, width_m)


@dataclass(frozen=True, slots=True, eq=False)
class Strip:
    """Everything within ``half_width_m`` of a line (N, 2) of the map; N >= 1."""

    line: FloatArray
    half_width_m: float

    @property
    def segments(self) -> FloatArray:
        """(S, 2, 2); of a single point one without length."""
        line = self.line if len(self.line) > 1 else np.repeat(self.line, 2, axis=0)
        return np.stack([line[:-1], line[1:]], axis=1)


@dataclass(frozen=True, slots=True, eq=False)
class MapArea:
    """An area in map metres: the union of polygons and strips.

    Attributes:
        polygons: each an outer ring (K, 2) and holes.
        strips: along lines.
    """

    polygons: tuple[tuple[FloatArray, ...], ...]
    strips: tuple[Strip, ...]

    @property
    def bounds(self) -> Bounds:
        """(west, south, east, north), m."""
        low = [polygon[0].min(axis=0) for polygon in self.polygons]
        low += [strip.line.min(axis=0) - strip.half_width_m for strip in self.strips]
        high = [polygon[0].max(axis=0) for polygon in self.polygons]
        high += [strip.line.max(axis=0) + strip.half_width_m for strip in self.strips]
        (west, south), (east, north) = np.min(low, axis=0), np.max(high, axis=0)
        return float(west), float(south), float(east), float(north)

    def mask(self, grid: RasterGrid, *, touched: bool = False) -> BoolArray:
        """(H, W) True for pixels whose centres lie in the area, or that it touches anywhere.

        Strips are as wide as they should be but for `_DISC_TOLERANCE_PX` at bends and ends.
        """
        shapes = [
            _shape([_corner_px(ring, grid) for ring in polygon])
            for polygon in self.polygons
            if _overlap(_box_of(polygon[0]), grid.bounds)
        ]
        for strip in self.strips:
            radius_px = strip.half_width_m / abs(grid.dy)
            slack = max(1e-9, min(_DISC_TOLERANCE_PX / radius_px, 0.5))
            corners = math.ceil(math.pi / (2.0 * math.acos(1.0 - slack))) + 1
            for segment in strip.segments[_near(strip, grid.bounds)]:
                outline = _stadium(segment[0], segment[1], strip.half_width_m, corners)
                shapes.append(_shape([_corner_px(outline, grid)]))
        if not shapes:
            return np.zeros((grid.height, grid.width), dtype=np.bool_)
        burnt = rasterio.features.rasterize(
            shapes, out_shape=(grid.height, grid.width), dtype=np.uint8, all_touched=touched
        )
        return np.asarray(burnt != 0, dtype=np.bool_)

    def meets(self, bounds: Bounds) -> bool:
        """Whether a box (west, south, east, north), m, and the area share a point; exact."""
        if any(_polygon_meets(polygon, bounds) for polygon in self.polygons):
            return True
        return any(_strip_meets(strip, bounds) for strip in self.strips)


def map_from_lonlat(
    lonlat: npt.ArrayLike,
    crs: str,
    what: str,
    source_crs: str = LONLAT,
    near: tuple[float, float] | None = None,
) -> FloatArray:
    """Points (N, 2), longitude and latitude in degrees (or ``source_crs``, x first), to the map (N, 2), m.

    The way PROJ holds best at that place, without the network, as `Georeference` takes it.
    Args:
        near: (longitude, latitude) of that place; None: the middle of the points.
    Raises: MapError naming ``what`` for points without an image, or a system that cannot carry a map.
    """
    points = np.asarray(lonlat, dtype=np.float64).reshape(-1, 2)
    target = projected_crs(crs, what)
    if source_crs != LONLAT and target == pyproj.CRS.from_user_input(source_crs):
        return points.copy()
    place = (points.min(axis=0) + points.max(axis=0)) / 2 if near is None else np.array(near)
    interest = _interest(*place) if source_crs == LONLAT or near is not None else None
    set_network_enabled(active=False)
    try:
        transformer = pyproj.Transformer.from_crs(
            source_crs,
            target,
            always_xy=True,
            area_of_interest=interest,
            allow_ballpark=False,
        )
        x, y = transformer.transform(points[:, 0], points[:, 1], errcheck=True)
    except ProjError as err:
        raise MapError(
            f"{what}: around ({place[0]:.2f}, {place[1]:.2f}), cannot be shown in {target.name} ({err}); check it and"
            " the map's system"
        ) from err
    result = np.stack([x, y], axis=-1)
    if not np.isfinite(result).all():
        raise MapError(f"{what}: outside the domain of {target.name}; check it and the map's system")
    return result


def _numbers(spec: str) -> list[float] | None:
    """The numbers of a box; None if it is something else. Raises: ConfigError if it is half a box."""
    parts = [part.strip() for part in spec.split(",")]
    numbers = []
    for part in parts:
        try:
            numbers.append(float(part))
        except ValueError:
            break
    if len(numbers) == len(parts) == 4:
        return numbers
    if len(numbers) == len(parts) and not Path(spec).exists():
        raise ConfigError(f"--area {spec}: {len(parts)} numbers, a box has four: W,S,E,N")
    return None


def _checked_box(numbers: list[float], spec: str) -> Bounds:
    west, south, east, north = numbers
    if not all(map(math.isfinite, numbers)):
        raise ConfigError(f"--area {spec}: contains NaN or infinity; give W,S,E,N")
    if south >= north:
        raise ConfigError(f"--area {spec}: south {south:g} is not below north {north:g}; the order is W,S,E,N")
    if west >= east:
        degrees = max(abs(west), abs(east)) <= 180
        raise ConfigError(
            f"--area {spec}: west {west:g} is not left of east {east:g}; the order is W,S,E,N"
            + (" (across the antimeridian: give a GeoJSON MultiPolygon cut there)" if degrees else "")
        )
    return west, south, east, north


def _ring_on_map(ring: FloatArray, source_crs: str, crs: str, what: str) -> FloatArray:
    closed = np.concatenate([ring, ring[:1]])
    return _line_on_map(closed, source_crs, crs, what)[:-1]


def _line_on_map(line: FloatArray, source_crs: str, crs: str, what: str) -> FloatArray:
    """A polyline (N, 2) with as many points more as it takes for straight pieces to follow its images.

    The bend of a piece falls with the square of its length, so one look at quarters tells how many are needed.
    A step of more than 180 degrees is one across the antimeridian, the short way.
    """
    if source_crs == LONLAT:
        line = np.stack([np.unwrap(line[:, 0], period=360.0), line[:, 1]], axis=-1)
    ends = map_from_lonlat(line, crs, what, source_crs)
    if len(line) < 2:
        return ends
    step, straight = np.diff(line, axis=0), np.diff(ends, axis=0)
    bend = np.zeros(len(step))
    for share in (0.25, 0.5, 0.75):
        true = map_from_lonlat(line[:-1] + share * step, crs, what, source_crs)
        bend = np.maximum(bend, np.linalg.norm(true - (ends[:-1] + share * straight), axis=1))
    pieces = np.ceil(np.sqrt(np.maximum(bend / _BEND_TOLERANCE_M, 1.0)))
    if pieces.max() > _MAX_PIECES:
        raise ConfigError(f"{what}: an edge bends by {bend.max() / 1e3:.0f} km on the map; is it that long?")
    count = pieces.astype(np.intp)
    if count.max() == 1:
        return ends
    leg = np.repeat(np.arange(len(count)), count)
    order = np.arange(len(leg)) - np.repeat(np.cumsum(count) - count, count)
    dense = line[leg] + (order / pieces[leg])[:, None] * step[leg]
    return map_from_lonlat(np.concatenate([dense, line[-1:]]), crs, what, source_crs)


def _scale_at(xy_map: FloatArray, crs: str) -> float:
    """Map metres per true metre at a place. The projections that carry packs are conformal: one direction does."""
    system = projected_crs(crs, crs)
    proj: Any = pyproj.Proj(system)
    geod = system.get_geod()
    assert geod is not None, "a projected system has an ellipsoid"
    lon, lat = proj(*xy_map, inverse=True)
    ends = [proj(*geod.fwd(lon, lat, azimuth_deg, _PROBE_M)[:2]) for azimuth_deg in (90.0, 270.0)]
    return math.dist(*ends) / (2.0 * _PROBE_M)


def _interest(lon: float, lat: float) -> Any:
    lon = (lon + 180.0) % 360.0 - 180.0
    margin = _INTEREST_MARGIN_DEG
    return AreaOfInterest(
        max(lon - margin, -180.0), max(lat - margin, -90.0), min(lon + margin, 180.0), min(lat + margin, 90.0)
    )


def _corner_px(points: FloatArray, grid: RasterGrid) -> FloatArray:
    """Map points in pixels counted from the outer corner of the first, as GDAL rasterizes."""
    return grid.px_from_map(points) + 0.5


def _shape(rings: list[FloatArray]) -> dict[str, object]:
    return {"type": "Polygon", "coordinates": [np.concatenate([ring, ring[:1]]).tolist() for ring in rings]}


def _stadium(a: FloatArray, b: FloatArray, radius: float, corners: int) -> FloatArray:
    """Outline (2 * corners, 2) of what lies within ``radius`` of a segment, counter-clockwise."""
    along = math.atan2(b[1] - a[1], b[0] - a[0])
    turn = np.linspace(-np.pi / 2, np.pi / 2, corners)
    cap = radius * np.stack([np.cos(along + turn), np.sin(along + turn)], axis=-1)
    return np.concatenate([b + cap, a - cap])


def _box_of(points: FloatArray) -> Bounds:
    (west, south), (east, north) = points.min(axis=0), points.max(axis=0)
    return float(west), float(south), float(east), float(north)


def _overlap(a: Bounds, b: Bounds) -> bool:
    return a[0] <= b[2] and b[0] <= a[2] and a[1] <= b[3] and b[1] <= a[3]


def _near(strip: Strip, bounds: Bounds) -> BoolArray:
    """(S,) whether the box around a segment's strip meets ``bounds``."""
    low = strip.segments.min(axis=1) - strip.half_width_m
    high = strip.segments.max(axis=1) + strip.half_width_m
    return np.asarray(
        (low[:, 0] <= bounds[2]) & (high[:, 0] >= bounds[0]) & (low[:, 1] <= bounds[3]) & (high[:, 1] >= bounds[1])
    )


def _polygon_meets(polygon: tuple[FloatArray, ...], bounds: Bounds) -> bool:
    if not _overlap(_box_of(polygon[0]), bounds):
        return False
    edges = np.concatenate([np.stack([ring, np.roll(ring, -1, axis=0)], axis=1) for ring in polygon])
    if _cross_box(edges, bounds).any():
        return True
    # No edge touches the box: all of it is inside or all of it outside.
    return _inside(np.array(bounds[:2]), edges)


def _strip_meets(strip: Strip, bounds: Bounds) -> bool:
    segments = strip.segments[_near(strip, bounds)]
    if not len(segments):
        return False
    if _cross_box(segments, bounds).any():
        return True
    west, south, east, north = bounds
    ends = segments.reshape(-1, 2)
    away = np.maximum(np.maximum((west, south) - ends, ends - (east, north)), 0.0)
    nearest = float(np.linalg.norm(away, axis=1).min())
    for corner in ((west, south), (east, south), (east, north), (west, north)):
        nearest = min(nearest, float(_distances(np.array(corner), segments).min()))
    return nearest <= strip.half_width_m


def _cross_box(segments: FloatArray, bounds: Bounds) -> BoolArray:
    """(S,) whether segments (S, 2, 2) and a box share a point (Liang and Barsky's clipping)."""
    start, step = segments[:, 0], segments[:, 1] - segments[:, 0]
    low, high = np.array(bounds[:2]), np.array(bounds[2:])
    with np.errstate(divide="ignore", invalid="ignore"):
        first, second = (low - start) / step, (high - start) / step
    still = step == 0
    inside = (start >= low) & (start <= high)
    enter = np.where(still, np.where(inside, -np.inf, np.inf), np.minimum(first, second)).max(axis=1)
    leave = np.where(still, np.where(inside, np.inf, -np.inf), np.maximum(first, second)).min(axis=1)
    return np.asarray(np.maximum(enter, 0.0) <= np.minimum(leave, 1.0))


def _inside(point: FloatArray, edges: FloatArray) -> bool:
    """Even-odd rule over the edges (E, 2, 2) of all rings, so that holes count."""
    (x0, y0), (x1, y1) = edges[:, 0].T, edges[:, 1].T
    spans = (y0 > point[1]) != (y1 > point[1])
    with np.errstate(divide="ignore", invalid="ignore"):
        x = x0 + (point[1] - y0) / (y1 - y0) * (x1 - x0)
    return bool(np.count_nonzero(spans & (x > point[0])) % 2)


def _distances(point: FloatArray, segments: FloatArray) -> FloatArray:
    """(S,) from a point to segments (S, 2, 2)."""
    start, step = segments[:, 0], segments[:, 1] - segments[:, 0]
    squared = np.einsum("ij,ij->i", step, step)
    share = np.einsum("ij,ij->i", point - start, step) / np.where(squared > 0, squared, 1.0)
    return np.asarray(np.linalg.norm(start + np.clip(share, 0.0, 1.0)[:, None] * step - point, axis=1))
