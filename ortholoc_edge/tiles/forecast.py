"""Where along a route a camera is likely to be localized on a pack's map, and where not, before anybody flies.

The camera is taken to look straight down, image top along the leg. What it would see of the map at each piece of
the route is measured (`View`) and judged by fixed limits (`judge`). The judgement knows the map alone: weather,
season and what was built since the survey make flights worse than their forecast.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, Final

import numpy as np
import rasterio
from rasterio.errors import RasterioError

from ortholoc_edge.errors import ConfigError, MapError
from ortholoc_edge.geometry.arrays import BoolArray, FloatArray, ImageArray
from ortholoc_edge.geometry.camera import Camera
from ortholoc_edge.geometry.grid import RasterGrid
from ortholoc_edge.tiles.area import MapArea, map_from_lonlat
from ortholoc_edge.tiles.drawing import Reference, Vertex
from ortholoc_edge.tiles.matchability import MATCHABLE_DOUBTFUL_MIN, MATCHABLE_EXPECTED_MIN, NO_MAP
from ortholoc_edge.tiles.pack import Pack
from ortholoc_edge.tiles.route import Route, RouteSamples
from ortholoc_edge.tiles.store import MapStore

MATCHABILITY_FILE: Final = "reports/matchability.tif"

# Of the footprint. The matchability's thresholds were calibrated on quarters of frames: a quarter with texture
# does; frames of copr with up to 21 % without map were all localized (sequences.md). Between: our judgement.
_NONE_BELOW_SHARE: Final = 0.25
_DOUBTFUL_BELOW_SHARE: Final = 0.5
# Orthophoto pixel over the pixel of the frame at the matcher's size: matchers tolerate about 2, XFeat perhaps 3
# (field-notes, "Altitude range vs GSD"; the localizer's own limit is 3 as well).
_DOUBTFUL_COARSENING: Final = 2.0
_NONE_COARSENING: Final = 3.0
# Cells of the surface model across the short side of the footprint; with fewer, heights at the matches are mostly
# interpolation. Our judgement.
_DOUBTFUL_BELOW_DSM_CELLS: Final = 8.0
# Water is blank in the matchability layer and level in the surface model; a matched surface has noise instead, and
# then it reads as low texture. Share of blank cells, and half of the heights' spread.
_WATER_BLANK_SHARE: Final = 0.5
_WATER_SCORE: Final = 5.0
_WATER_LEVEL_M: Final = 0.3
# A quarter of the footprint: neighbouring samples then share most of their view.
_STEP_OF_FOOTPRINT: Final = 0.25
_MIN_STEP_M, _MAX_STEP_M = 0.5, 200.0
# Pixels across the footprint's short side that its shares are counted in.
_COUNTED_PX: Final = 48
# Per side, where the matchability is looked up: a footprint may be smaller than a cell.
_LOOKUPS: Final = 16


class Verdict(StrEnum):
    """Whether a fix is to be expected."""

    EXPECTED = "expected"
    DOUBTFUL = "doubtful"
    NONE = "none"


class Cause(StrEnum):
    """Why not."""

    OUTSIDE_MAP = "outside_map"
    NO_SURFACE = "no_surface"
    LOW_TEXTURE = "low_texture"
    WATER = "water"
    TOO_COARSE = "too_coarse"
    BELOW_GROUND = "below_ground"
    UNKNOWN_TEXTURE = "unknown_texture"


@dataclass(frozen=True, slots=True)
class View:
    """What the camera sees of the map from one place.

    Attributes:
        agl_m: height above the ground; None: there is no surface model to tell.
        dop_share, dsm_share: of the footprint, with orthophoto and with surface model.
        coarsening: orthophoto pixel over frame pixel, the frame at the matcher's size.
        dsm_cells: of the surface model across the footprint's short side.
        matchability: mean score over the footprint, 0 to 100; None: not known.
        blank_share: of the footprint's scored part, with next to no texture.
        relief_m: half of what the middle 80 % of the heights span; None: no heights.
    """

    agl_m: float | None
    dop_share: float
    dsm_share: float
    coarsening: float
    dsm_cells: float
    matchability: float | None
    blank_share: float
    relief_m: float | None


def judge(view: View) -> tuple[Verdict, Cause | None]:
    """The worst that a view's measures say, and which of them says it."""
    if view.agl_m is not None and view.agl_m <= 0:
        return Verdict.NONE, Cause.BELOW_GROUND
    doubts: list[Cause] = []
    for share, cause in ((view.dop_share, Cause.OUTSIDE_MAP), (view.dsm_share, Cause.NO_SURFACE)):
        if share < _NONE_BELOW_SHARE:
            return Verdict.NONE, cause
        if share < _DOUBTFUL_BELOW_SHARE:
            doubts.append(cause)
    if view.coarsening > _NONE_COARSENING:
        return Verdict.NONE, Cause.TOO_COARSE
    if view.coarsening > _DOUBTFUL_COARSENING or view.dsm_cells < _DOUBTFUL_BELOW_DSM_CELLS:
        doubts.append(Cause.TOO_COARSE)
    if view.matchability is None:
        doubts.append(Cause.UNKNOWN_TEXTURE)
    elif view.matchability < MATCHABLE_EXPECTED_MIN:
        level = view.relief_m is not None and view.relief_m < _WATER_LEVEL_M
        watery = level and view.blank_share > _WATER_BLANK_SHARE
        doubts.insert(0, Cause.WATER if watery else Cause.LOW_TEXTURE)
        if view.matchability < MATCHABLE_DOUBTFUL_MIN:
            return Verdict.NONE, doubts[0]
    return (Verdict.DOUBTFUL, doubts[0]) if doubts else (Verdict.EXPECTED, None)


@dataclass(frozen=True, slots=True, eq=False)
class Stretch:
    """Neighbouring pieces of a line with the same verdict for the same cause.

    Attributes:
        lonlat: (K, 2), degrees on WGS 84.
        xy_map: (K, 2), m.
        line: which of the route's lines.
        length_m: along it.
        matchability: mean, where it is known.
    """

    verdict: Verdict
    cause: Cause | None
    lonlat: FloatArray
    xy_map: FloatArray
    line: int
    length_m: float
    matchability: float | None


@dataclass(frozen=True, slots=True, eq=False)
class Forecast:
    """A route, judged.

    Attributes:
        route: as read.
        samples: its N pieces.
        views, verdicts, causes: of each.
        stretches: neighbours put together, in the order they are flown.
        notes: what limits the forecast, for people.
    """

    route: Route
    samples: RouteSamples
    views: tuple[View, ...]
    verdicts: tuple[Verdict, ...]
    causes: tuple[Cause | None, ...]
    stretches: tuple[Stretch, ...]
    notes: tuple[str, ...]

    def length_m(self, verdict: Verdict) -> float:
        return float(sum(s.length_m for s in self.stretches if s.verdict is verdict))

    def longest_m(self, *verdicts: Verdict) -> float:
        """The longest way within one line on which nothing else is judged."""
        longest = current = 0.0
        line = -1
        for stretch in self.stretches:
            current = current if stretch.line == line else 0.0
            line = stretch.line
            current = current + stretch.length_m if stretch.verdict in verdicts else 0.0
            longest = max(longest, current)
        return longest

    def geojson(self) -> bytes:
        """A FeatureCollection (RFC 7946) with a LineString per stretch, a Point for one without length."""
        features = []
        for stretch in self.stretches:
            places = [[round(float(x), 7), round(float(y), 7)] for x, y in stretch.lonlat]
            geometry = (
                {"type": "LineString", "coordinates": places}
                if stretch.length_m > 0
                else {"type": "Point", "coordinates": places[0]}
            )
            properties = {
                "verdict": str(stretch.verdict),
                "reason": None if stretch.cause is None else str(stretch.cause),
                "length_m": round(stretch.length_m, 1),
                "matchability": None if stretch.matchability is None else round(stretch.matchability, 1),
                "line": stretch.line,
                # What geojson.io and other viewers draw it with (simplestyle).
                "stroke": "#{:02x}{:02x}{:02x}".format(*COLOURS[stretch.verdict]),
                "stroke-width": 4,
            }
            features.append({"type": "Feature", "properties": properties, "geometry": geometry})
        return (json.dumps({"type": "FeatureCollection", "features": features}, indent=1) + "\n").encode()

    def facts(self, speed_mps: float | None) -> dict[str, Any]:
        """Figures for machines; times of the gaps where a speed is given."""
        gap_m, unsure_m = self.longest_m(Verdict.NONE), self.longest_m(Verdict.NONE, Verdict.DOUBTFUL)
        causes: dict[str, float] = {}
        for stretch in self.stretches:
            if stretch.cause is not None:
                causes[str(stretch.cause)] = causes.get(str(stretch.cause), 0.0) + stretch.length_m
        heights = [view.agl_m for view in self.views if view.agl_m is not None]
        return {
            "route": self.route.name,
            "length_m": round(self.route.length_m, 1),
            "samples": len(self.samples),
            "height_above_ground_m": [round(min(heights), 1), round(max(heights), 1)] if heights else None,
            **{f"{verdict}_m": round(self.length_m(verdict), 1) for verdict in Verdict},
            "reasons_m": {cause: round(length, 1) for cause, length in sorted(causes.items())},
            "longest_gap_m": round(gap_m, 1),
            "longest_without_expected_m": round(unsure_m, 1),
            "longest_gap_s": None if speed_mps is None else round(gap_m / speed_mps, 1),
            "longest_without_expected_s": None if speed_mps is None else round(unsure_m / speed_mps, 1),
            "notes": list(self.notes),
        }


LABELS: Final = {
    Verdict.EXPECTED: "fixes expected",
    Verdict.DOUBTFUL: "fixes doubtful",
    Verdict.NONE: "no fixes expected",
}
# RGB; told apart with red-green blindness as well.
COLOURS: Final = {Verdict.EXPECTED: (60, 160, 255), Verdict.DOUBTFUL: (255, 215, 60), Verdict.NONE: (255, 60, 50)}


def forecast(
    route: Route,
    store: MapStore,
    camera: Camera,
    *,
    agl_m: float | None = None,
    working_px: int,
    progress: Callable[[int, int], None] = lambda done, of: None,
) -> Forecast:
    """Judge a route on a pack.

    Args:
        camera: of any size; its distortion is ignored.
        agl_m: height above the ground to be held all the way, instead of the route's altitudes.
        working_px: long side that the matcher brings frames to.
        progress: called with the samples done and their number.
    Raises: ConfigError where heights cannot be told from the route; MapError for a pack without a reference system
        or whose vertical datum does not give the heights that the route is in.
    """
    pack = store.pack
    crs = pack.manifest.crs
    if crs is None:
        raise MapError(
            f"{pack.path}: in local metres without a reference system, no route can be placed on it; rebuild the"
            " pack from rasters with a projected CRS"
        )
    geodetic = pack.georeference.geodetic_from_map((*pack.manifest.anchor, 0.0))
    near = (geodetic.lon_deg, geodetic.lat_deg)

    def on_map(lonlat: FloatArray) -> FloatArray:
        return map_from_lonlat(lonlat, crs, route.name, near=near)

    cells, notes = _matchability(pack)
    heights = _Heights(route, store, on_map, agl_m)
    scale = min(1.0, working_px / max(camera.width, camera.height))
    working = camera.pinhole().resized(max(1, round(camera.width * scale)), max(1, round(camera.height * scale)))
    short_per_m = _short_side(working)
    step_m = _STEP_OF_FOOTPRINT * short_per_m * heights.typical_agl_m()
    samples = route.sample(min(max(step_m, _MIN_STEP_M), _MAX_STEP_M))
    middle, start, end = on_map(samples.lonlat), on_map(samples.start), on_map(samples.end)
    views = []
    for k in range(len(samples)):
        agl = heights.agl(int(samples.line[k]), int(samples.leg[k]), float(samples.share[k]), middle[k])
        views.append(_view(store, cells, working, middle[k], end[k] - start[k], agl))
        progress(k + 1, len(samples))
    judged = [judge(view) for view in views]
    verdicts, causes = tuple(verdict for verdict, _ in judged), tuple(cause for _, cause in judged)
    stretches = tuple(_stretches(samples, start, end, views, verdicts, causes))
    return Forecast(route, samples, tuple(views), verdicts, causes, stretches, tuple(notes))


@dataclass(frozen=True, slots=True, eq=False)
class _Cells:
    """The matchability layer: scores (h, w), `NO_MAP` where there is no map, on its grid."""

    scores: ImageArray
    grid: RasterGrid


class _Heights:
    """Heights above the ground along a route, by whatever its altitudes count from."""

    def __init__(
        self, route: Route, store: MapStore, on_map: Callable[[FloatArray], FloatArray], agl_m: float | None
    ) -> None:
        self._route, self._store, self._agl_m = route, store, agl_m
        self._on_map = on_map
        self._home_m: float | None = None
        # Map heights of the vertices, None where terrain is followed.
        self._vertices: list[list[float | None]] = []
        if agl_m is None:
            self._vertices = [
                [self._map_height(vertex, f"{route.name}: line {i}, point {k}") for k, vertex in enumerate(line)]
                for i, line in enumerate(route.lines)
            ]

    def typical_agl_m(self) -> float:
        """Median over the vertices whose ground is known; over all, 100 m, where none is."""
        if self._agl_m is not None:
            return self._agl_m
        found = []
        for i, line in enumerate(self._route.lines):
            places = self._on_map(np.array([(v.x, v.y) for v in line]))
            for k, place in enumerate(places):
                agl = self.agl(i, min(k, max(len(line) - 2, 0)), 1.0 if k and k == len(line) - 1 else 0.0, place)
                if agl is not None and agl > 0:
                    found.append(agl)
        return float(np.median(found)) if found else 100.0

    def agl(self, line: int, leg: int, share: float, xy_map: FloatArray) -> float | None:
        """Height above the ground at a place on a leg, m; None where the surface model does not tell."""
        if self._agl_m is not None:
            return self._agl_m
        vertices, heights = self._route.lines[line], self._vertices[line]
        last = min(leg + 1, len(vertices) - 1)
        (a, b), (first, second) = (heights[leg], heights[last]), (vertices[leg], vertices[last])
        if a is None and b is None:
            assert first.altitude_m is not None and second.altitude_m is not None
            return (1 - share) * first.altitude_m + share * second.altitude_m
        a, b = self._over_ground(a, first), self._over_ground(b, second)
        ground = self._store.ground_near(xy_map)
        if a is None or b is None or ground is None:
            return None
        return (1 - share) * a + share * b - ground

    def _over_ground(self, height_m: float | None, vertex: Vertex) -> float | None:
        """Map height of a vertex; one above terrain stands on the ground at its place."""
        if height_m is not None:
            return height_m
        ground = self._store.ground_near(self._on_map(np.array([(vertex.x, vertex.y)]))[0])
        assert vertex.altitude_m is not None
        return None if ground is None else ground + vertex.altitude_m

    def _map_height(self, vertex: Vertex, where: str) -> float | None:
        altitude, reference = vertex.altitude_m, vertex.reference
        if altitude is None:
            raise ConfigError(f"{where}: has no altitude; state the height above ground with --agl METRES")
        if reference is Reference.TERRAIN:
            return None
        if reference is Reference.MAP:
            return altitude
        if reference is Reference.HOME:
            return altitude + self._home(where)
        georeference = self._store.pack.georeference
        try:
            if reference is Reference.AMSL:
                return float(georeference.map_from_geodetic(vertex.y, vertex.x, height_amsl_m=altitude)[2])
            if reference is Reference.ELLIPSOID:
                return float(georeference.map_from_geodetic(vertex.y, vertex.x, height_ellipsoid_m=altitude)[2])
        except MapError as err:
            raise MapError(f"{where}: {err}; or state the height above ground with --agl METRES") from err
        raise ConfigError(
            f"{where}: the file does not say what its altitude of {altitude:g} m counts from; say so with"
            f" --altitudes {'|'.join(r for r in Reference if r is not Reference.UNKNOWN)}, or state the height above"
            " ground with --agl METRES"
        )

    def _home(self, where: str) -> float:
        """Map height of the home position: of the surface there, which needs no datum, else as the file has it."""
        if self._home_m is None:
            route, first = self._route, self._route.lines[0][0]
            lon, lat = route.home or (first.x, first.y)
            ground = self._store.ground_near(self._on_map(np.array([(lon, lat)]))[0])
            if ground is not None:
                self._home_m = ground
            elif route.home_amsl_m is not None:
                georeference = self._store.pack.georeference
                self._home_m = float(georeference.map_from_geodetic(lat, lon, height_amsl_m=route.home_amsl_m)[2])
            else:
                raise ConfigError(
                    f"{where}: counts from home at {lat:.6f}, {lon:.6f}, which is not on the pack and whose altitude"
                    " the file does not say; state the height above ground with --agl METRES"
                )
        return self._home_m


def footprint(camera: Camera, xy_map: FloatArray, heading_map: FloatArray, agl_m: float) -> FloatArray:
    """Ground (4, 2) that a camera looking straight down sees: the image's corners, clockwise from its top left.

    Map and true metres are taken for the same: they differ by per mille.
    Args:
        heading_map: (2,) direction of the image's top; of no length: north.
    """
    u, v = (-0.5, camera.width - 0.5), (-0.5, camera.height - 0.5)
    corners = np.array([(u[0], v[0]), (u[1], v[0]), (u[1], v[1]), (u[0], v[1])])
    right, down = (agl_m * camera.pinhole().unproject(corners)[:, :2]).T
    length = float(np.linalg.norm(heading_map))
    east, north = heading_map / length if length > 0 else (0.0, 1.0)
    return np.asarray(
        xy_map + right[:, None] * np.array([north, -east]) - down[:, None] * np.array([east, north]), dtype=np.float64
    )


def _short_side(camera: Camera) -> float:
    """Of the footprint from 1 m up."""
    return min(camera.width / camera.fx, camera.height / camera.fy)


def _view(
    store: MapStore,
    cells: _Cells | None,
    camera: Camera,
    xy_map: FloatArray,
    heading_map: FloatArray,
    agl: float | None,
) -> View:
    height = agl if agl is not None and agl > 0 else 1.0
    ring = footprint(camera, xy_map, heading_map, height)
    short_m = height * _short_side(camera)
    dop_gsd, dsm_gsd = store.dop_grids[0].gsd_m, store.dsm_grids[0].gsd_m
    dop_share, dsm_share, relief = _shares(store, ring, short_m / _COUNTED_PX)
    score, blank = _scores(cells, ring)
    return View(
        agl_m=agl,
        dop_share=dop_share,
        dsm_share=dsm_share,
        coarsening=dop_gsd * camera.focal_px / height,
        dsm_cells=short_m / dsm_gsd,
        matchability=score,
        blank_share=blank,
        relief_m=relief,
    )


def _shares(store: MapStore, ring: FloatArray, gsd_m: float) -> tuple[float, float, float | None]:
    """Share of a footprint with orthophoto and with surface model, and the relief of the latter."""
    (west, south), (east, north) = ring.min(axis=0), ring.max(axis=0)
    window = store.read((float(west), float(south), float(east), float(north)), gsd_m, gsd_m)
    if window is None:
        return 0.0, 0.0, None
    area = MapArea(((ring,),), ())
    x, y = (ring - ring[0]).T
    true_m2 = 0.5 * abs(float(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1))))
    inside = area.mask(window.dop_grid), area.mask(window.dsm_grid)
    heights = window.dsm[inside[1]]
    heights = heights[np.isfinite(heights)]
    shares = (
        _share(window.dop_valid, inside[0], window.dop_grid, ring, true_m2),
        _share(np.isfinite(window.dsm), inside[1], window.dsm_grid, ring, true_m2),
    )
    low, high = np.percentile(heights, (10, 90)) if len(heights) else (0.0, 0.0)
    return (*shares, 0.5 * float(high - low) if len(heights) else None)


def _share(valid: BoolArray, inside: BoolArray, grid: RasterGrid, ring: FloatArray, true_m2: float) -> float:
    count = int(inside.sum())
    if count * grid.gsd_m**2 < 0.5 * true_m2 and true_m2 < 4.0 * grid.gsd_m**2:
        # A footprint of a few pixels: the one under its middle speaks for it.
        u, v = np.rint(grid.px_from_map(ring.mean(axis=0))).astype(int)
        return float(valid[v, u]) if 0 <= u < grid.width and 0 <= v < grid.height else 0.0
    return min(1.0, float((valid & inside).sum()) * grid.gsd_m**2 / true_m2)


def _scores(cells: _Cells | None, ring: FloatArray) -> tuple[float | None, float]:
    """Mean score over a footprint's part that has one, and the share of it that is blank."""
    if cells is None:
        return None, 0.0
    at = (np.arange(_LOOKUPS) + 0.5) / _LOOKUPS
    a, b = (part.reshape(-1, 1) for part in np.meshgrid(at, at))
    points = ring[0] + a * (ring[1] - ring[0]) + b * (ring[3] - ring[0])
    column, row = np.rint(cells.grid.px_from_map(points)).astype(np.intp).T
    on = (column >= 0) & (column < cells.grid.width) & (row >= 0) & (row < cells.grid.height)
    scores = cells.scores[row[on], column[on]]
    scores = scores[scores != NO_MAP]
    if not len(scores):
        return None, 0.0
    return float(scores.mean()), float((scores <= _WATER_SCORE).mean())


def _matchability(pack: Pack) -> tuple[_Cells | None, list[str]]:
    path = pack.path / MATCHABILITY_FILE
    listed = any(note.file == MATCHABILITY_FILE for note in pack.manifest.files)
    if not listed or MATCHABILITY_FILE in pack.missing:
        return None, [
            f"{pack.path} has no {MATCHABILITY_FILE}: texture and water are not judged, so nothing is better than"
            " doubtful; rebuild the pack for the full forecast"
        ]
    try:
        with rasterio.open(path) as raster:
            transform, scores = raster.transform, raster.read(1)
    except RasterioError as err:
        raise MapError(f"{path}: cannot be read ({err}); rebuild the pack or copy it again") from err
    if scores.dtype != np.uint8 or transform.b != 0 or transform.d != 0:
        raise MapError(f"{path}: no north-up raster of 8 bits; rebuild the pack or copy it again")
    grid = RasterGrid(scores.shape[1], scores.shape[0], transform.c, transform.f, transform.a, transform.e)
    return _Cells(scores, grid), []


def _stretches(
    samples: RouteSamples,
    start: FloatArray,
    end: FloatArray,
    views: list[View],
    verdicts: tuple[Verdict, ...],
    causes: tuple[Cause | None, ...],
) -> Iterator[Stretch]:
    first = 0
    for k in range(1, len(samples) + 1):
        same = k < len(samples) and (samples.line[k], verdicts[k], causes[k]) == (
            samples.line[first],
            verdicts[first],
            causes[first],
        )
        if same:
            continue
        part = slice(first, k)
        # Corners stay, points along a leg go: a leg's pieces lie on one line.
        turns = [i for i in range(first + 1, k) if samples.leg[i] != samples.leg[i - 1]]
        keep = [first, *turns]
        scores = [view.matchability for view in views[part] if view.matchability is not None]
        yield Stretch(
            verdicts[first],
            causes[first],
            np.concatenate([samples.start[keep], samples.end[k - 1 : k]]),
            np.concatenate([start[keep], end[k - 1 : k]]),
            int(samples.line[first]),
            float(samples.length_m[part].sum()),
            float(np.mean(scores)) if scores else None,
        )
        first = k


def text(result: Forecast, speed_mps: float | None) -> str:
    """The forecast in a few lines for people."""
    facts = result.facts(speed_mps)
    total = max(facts["length_m"], 1e-9)
    heights = facts["height_above_ground_m"]

    def way(length_m: float, time_s: float | None) -> str:
        return f"{_length(length_m)}" + ("" if time_s is None else f", {time_s:.0f} s at {speed_mps:g} m/s")

    rows = [
        ("route", f"{facts['route']}, {_length(facts['length_m'])}"),
        ("height", "not known" if heights is None else f"{heights[0]:.0f} to {heights[1]:.0f} m above the ground"),
    ]
    for verdict in Verdict:
        length = facts[f"{verdict}_m"]
        rows.append((LABELS[verdict], f"{_length(length)} ({100 * length / total:.0f} %)"))
    rows += [(f"  {cause}", _length(length)) for cause, length in facts["reasons_m"].items()]
    rows.append(("longest gap", way(facts["longest_gap_m"], facts["longest_gap_s"])))
    rows.append(("  with doubtful", way(facts["longest_without_expected_m"], facts["longest_without_expected_s"])))
    return "\n".join(f"{label:<20}{value}" for label, value in rows)


def _length(metres: float) -> str:
    return f"{metres / 1e3:.2f} km" if metres >= 1000 else f"{math.floor(metres + 0.5)} m"
