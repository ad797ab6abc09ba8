"""What a build will do, before it does anything: one CRS, a lattice per layer, tiles and the sources of each."""

from __future__ import annotations

import logging
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pyproj
from rasterio.errors import RasterioError
from rasterio.warp import transform_bounds

from ortholoc_edge.errors import ConfigError, MapError
from ortholoc_edge.geometry.grid import RasterGrid
from ortholoc_edge.tiles.area import Area, MapArea
from ortholoc_edge.tiles.georeference import Georeference, VerticalDatum, VerticalKind
from ortholoc_edge.tiles.lattice import Bounds, Lattice, PixelBox, meeting
from ortholoc_edge.tiles.resample import same_crs
from ortholoc_edge.tiles.sources import Source, is_copied, transform_caveat
from ortholoc_edge.tiles.systems import projected_crs, require_way_to_wgs84

logger = logging.getLogger(__name__)

# Below this a "pixel" is a degree without a CRS, or a slip of the decimal point.
_MIN_GSD_M, _MAX_GSD_M = 0.002, 100.0
# Of a pixel per tile: pixel sizes that differ by less are one size written with other digits.
_SIZE_DIGITS = 6
# Of a pixel's size: what eight digits of a world file leave out. And in pixels over the raster: what is still copied.
_SLIP, _SLACK_PX = 1e-7, 1e-3
# Of the box around the orthophotos: a DSM that covers less is worth a warning.
_SPARSE_COVERAGE = 0.95


@dataclass(frozen=True, slots=True)
class TilePlan:
    """One tile and which sources it may show, as indices into the layer's list, newest first."""

    box: PixelBox
    sources: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class LayerPlan:
    """DOP or DSM.

    Attributes:
        sources: that a tile may show, newest first, which lies uppermost.
        bounds: of each source in the pack's CRS.
    """

    lattice: Lattice
    sources: tuple[Source, ...]
    bounds: tuple[Bounds, ...]
    tiles: tuple[TilePlan, ...]

    @property
    def pixels(self) -> int:
        return sum(tile.box.width * tile.box.height for tile in self.tiles)

    def resampled(self, index: int, crs: str | None) -> bool:
        """Whether a source's pixels are not those of the lattice."""
        return not is_copied(self.sources[index], self.lattice.grid(self.tiles[0].box), crs)


@dataclass(frozen=True, slots=True)
class Plan:
    """See the module. ``area``: what to keep of the map, in its CRS; None: all."""

    crs: str | None
    dop: LayerPlan
    dsm: LayerPlan
    area: MapArea | None

    @property
    def bounds(self) -> Bounds:
        """Of the DOP's tiles, m."""
        boxes = [self.dop.lattice.grid(tile.box).bounds for tile in self.dop.tiles]
        west, south = np.min([box[:2] for box in boxes], axis=0)
        east, north = np.max([box[2:] for box in boxes], axis=0)
        return float(west), float(south), float(east), float(north)


def make_plan(
    dop: Sequence[Source],
    dsm: Sequence[Source],
    *,
    pack_crs: str | None = None,
    dop_gsd_m: float | None = None,
    dsm_gsd_m: float | None = None,
    area: Area | None = None,
) -> Plan:
    """Choose CRS and lattices and cut the tiles.

    The CRS is that of most of the orthophoto; a layer's pixels are those of most of its sources in that CRS, so
    that these need no resampling.

    Args:
        pack_crs: another CRS; None: as above.
        dop_gsd_m, dsm_gsd_m: other pixel sizes; None: as above.
    Raises: MapError for sources that cannot make one pack; ConfigError for a CRS or a GSD that cannot be.
    """
    for name, gsd in (("dop_gsd_m", dop_gsd_m), ("dsm_gsd_m", dsm_gsd_m)):
        if gsd is not None and not _MIN_GSD_M <= gsd <= _MAX_GSD_M:
            raise ConfigError(f"{name} {gsd}: must lie between {_MIN_GSD_M} and {_MAX_GSD_M} m")
    crs = _pack_crs(dop, dsm, pack_crs)
    map_area = None if area is None else area.on_map(crs)
    _warn_of_rough_ways([*dop, *dsm], crs)
    dop_bounds, dsm_bounds = ([bounds_in(source, crs) for source in layer] for layer in (dop, dsm))
    _check_overlap(dop, dop_bounds, dsm, dsm_bounds)
    shared = meeting(_union(dop_bounds), _union(dsm_bounds))
    assert shared is not None, "checked"
    if map_area is not None:
        inside = meeting(shared, map_area.bounds)
        if inside is None:
            raise ConfigError(
                f"--area covers {_rounded(map_area.bounds)} of {crs or 'the map'}, the sources {_rounded(shared)};"
                " they do not meet, choose another area or other sources"
            )
        shared = inside
    asked = _union(dop_bounds) if map_area is None else meeting(_union(dop_bounds), map_area.bounds)
    assert asked is not None, "it holds what is shared"
    share = _area_m2(shared) / _area_m2(asked)
    if share < _SPARSE_COVERAGE:
        logger.warning("the DSM covers only %.0f %% of the orthophoto; the pack ends there", 100 * share)
    layers = []
    for sources, bounds, others, gsd in (
        (dop, dop_bounds, dsm_bounds, dop_gsd_m),
        (dsm, dsm_bounds, dop_bounds, dsm_gsd_m),
    ):
        layers.append(_layer(sources, bounds, others, shared, crs, gsd, map_area))
    return Plan(crs, layers[0], layers[1], map_area)


def named_vertical(sources: Sequence[Source]) -> tuple[VerticalKind, int | None] | None:
    """What the sources' compound systems say of their heights; None if none says anything.

    Raises: MapError if they disagree: a mosaic of two zero levels has steps.
    """
    said: dict[tuple[VerticalKind, int | None], str] = {}
    for source in sources:
        if source.vertical is not None:
            said.setdefault(source.vertical, source.name)
    if len(said) > 1:
        described = ", ".join(f"{kind} {epsg or ''}".strip() + f" ({name})" for (kind, epsg), name in said.items())
        raise MapError(f"surface models with different heights: {described}; bring them to one vertical system first")
    return next(iter(said), None)


def bounds_in(source: Source, crs: str | None) -> Bounds:
    """A source's (west, south, east, north) in the pack's CRS."""
    if crs is None or source.crs is None or same_crs(source.crs, crs):
        return source.grid.bounds
    try:
        west, south, east, north = transform_bounds(source.crs, crs, *source.grid.bounds, densify_pts=21)
    except RasterioError as err:
        raise MapError(f"{source.name}: cannot be brought to {crs} ({err}); choose another --pack-crs") from err
    if not np.isfinite([west, south, east, north]).all():
        raise MapError(f"{source.name}: lies outside the domain of {crs}; choose another --pack-crs")
    return float(west), float(south), float(east), float(north)


def lat_lon_of(crs: str, points: Sequence[tuple[float, float]]) -> np.ndarray:
    """Latitudes and longitudes (N, 2), degrees, in the CRS's own datum, of map points (N, 2)."""
    proj = pyproj.Proj(projected_crs(crs, crs))
    xy = np.asarray(points, dtype=np.float64)
    lon, lat = proj(xy[:, 0], xy[:, 1], inverse=True)
    return np.column_stack([lat, lon])


def _pack_crs(dop: Sequence[Source], dsm: Sequence[Source], wanted: str | None) -> str | None:
    without = [source for source in (*dop, *dsm) if source.crs is None]
    if without and len(without) < len(dop) + len(dsm):
        raise MapError(
            f"{without[0].name}: no CRS, but other sources have one; name it with --crs EPSG:n"
            f" ({len(without)} sources lack one)"
        )
    if without:
        if wanted is not None:
            raise ConfigError(f"--pack-crs {wanted}: the sources have no CRS to come from; name it with --crs EPSG:n")
        return None
    if wanted is not None:
        parsed = projected_crs(wanted, f"--pack-crs {wanted}")
        crs = f"EPSG:{parsed.to_epsg()}" if parsed.to_epsg() else str(parsed.to_wkt())
    else:
        crs = _majority_crs(dop)
    west, south, east, north = bounds_in(dop[0], crs)
    middle = (west + east) / 2, (south + north) / 2
    # The georeference refuses what cannot carry poses: not conformal, not in metres.
    try:
        Georeference(crs, VerticalDatum(kind="unknown"), middle)
        lat, lon = lat_lon_of(crs, [middle])[0]
        require_way_to_wgs84(crs, (float(lat), float(lon)))
    except MapError as err:
        raise MapError(f"{err}; or let the build warp to another system with --pack-crs EPSG:n") from err
    return crs


def _majority_crs(sources: Sequence[Source]) -> str:
    areas: dict[str, float] = defaultdict(float)
    for source in sources:
        assert source.crs is not None, "checked"
        parsed = pyproj.CRS.from_user_input(source.crs)
        west, south, east, north = source.grid.bounds
        if parsed.is_geographic:
            lon, lat = (west + east) / 2, (south + north) / 2
            zone = int((lon + 180.0) // 6.0) % 60 + 1
            crs = f"EPSG:{(32600 if lat >= 0 else 32700) + zone}"
        else:
            crs = source.crs
        areas[crs] += _area_m2(bounds_in(source, crs))
    # Sorted, so that of two halves the same one wins on every machine.
    return max(sorted(areas), key=lambda crs: round(areas[crs]))


def _warn_of_rough_ways(sources: Sequence[Source], crs: str | None) -> None:
    """Once per system, where PROJ lacks the grids for the good way to the pack's."""
    first = {source.crs: source for source in reversed(sources)}
    for source in first.values():
        caveat = transform_caveat(source, crs)
        if caveat is not None:
            logger.warning("%s", caveat)


def _area_m2(bounds: Bounds) -> float:
    return (bounds[2] - bounds[0]) * (bounds[3] - bounds[1])


def _layer(
    sources: Sequence[Source],
    bounds: Sequence[Bounds],
    others: Sequence[Bounds],
    shared: Bounds,
    crs: str | None,
    gsd_m: float | None,
    area: MapArea | None,
) -> LayerPlan:
    # Newest first (2023-06 before 2023, which may mean any month of it; no date last), then finest, then by name.
    order = sorted(range(len(sources)), key=lambda k: (sources[k].gsd_m, sources[k].name))
    order.sort(key=lambda k: sources[k].date or "", reverse=True)
    sources, bounds = [sources[k] for k in order], [bounds[k] for k in order]
    pixel_m, phase = _pixels(sources, bounds, crs)
    if gsd_m is not None:
        pixel_m = gsd_m
    lattice = Lattice.over(shared, pixel_m, phase)
    whole = lattice.box(shared)
    frame = lattice.grid(whole).bounds
    own, paired = _under(bounds, lattice, frame), _under(others, lattice, frame)
    tiles = []
    for box in lattice.tiles(whole):
        key = lattice.tile_key(box.column, box.row)
        # An orthophoto without heights, or heights without an orthophoto, give no fix.
        if key in own and key in paired and (area is None or area.meets(lattice.grid(box).bounds)):
            tiles.append(TilePlan(box, tuple(own[key])))
    if not tiles:
        raise MapError(
            f"{sources[0].name} and others: nothing left of {sources[0].kind.upper()} inside the area and the other"
            " layer; check that orthophotos and surface models are of one place"
        )
    return _without_unused(LayerPlan(lattice, tuple(sources), tuple(bounds), tuple(tiles)))


def _under(boxes: Sequence[Bounds], lattice: Lattice, frame: Bounds) -> dict[tuple[int, int], list[int]]:
    """Tiles that boxes meet inside ``frame``, by `Lattice.tile_key`, each with the boxes' indices. The cost is that of
    what meets, not of all boxes times all tiles: a state has 50,000 of each."""
    met: dict[tuple[int, int], list[int]] = defaultdict(list)
    for index, bounds in enumerate(boxes):
        inside = meeting(bounds, frame)
        if inside is not None:
            for part in lattice.tiles(lattice.box(inside)):
                met[lattice.tile_key(part.column, part.row)].append(index)
    return met


def _pixels(sources: Sequence[Source], bounds: Sequence[Bounds], crs: str | None) -> tuple[float, tuple[float, float]]:
    """Pixel size and the phase of the pixels: those of the largest area that need no warping."""
    areas: dict[tuple[float, float, float], float] = defaultdict(float)
    exact: dict[tuple[float, float, float], tuple[float, tuple[float, float]]] = {}
    for source, box in zip(sources, bounds, strict=True):
        grid = source.grid
        square = abs(grid.dx + grid.dy) * max(grid.width, grid.height) < 0.01 * grid.dx
        if not same_crs(source.crs, crs) or not square:
            continue
        pixel_m = _round_size(grid)
        phase = grid.west % pixel_m, grid.top % pixel_m
        x, y = (round(value / pixel_m, 2) % 1.0 for value in phase)
        key = round(pixel_m, _SIZE_DIGITS), x, y
        areas[key] += _area_m2(box)
        exact.setdefault(key, (pixel_m, phase))
    if areas:
        return exact[max(sorted(areas), key=lambda key: round(areas[key]))]
    # Every source is warped: the finest of their pixels, in round millimetres.
    return max(round(min(source.gsd_m for source in sources), 3), _MIN_GSD_M), (0.0, 0.0)


def _round_size(grid: RasterGrid) -> float:
    """A pixel's size as it was meant, if over the raster that makes no difference: 0.19999999 of a world file would,
    counted from the equator, put each tile of a state onto pixels of its own."""
    size = round(grid.dx, _SIZE_DIGITS)
    error = abs(size / grid.dx - 1.0)
    return size if error < _SLIP and error * max(grid.width, grid.height) < _SLACK_PX else grid.dx


def _check_overlap(
    dop: Sequence[Source], dop_bounds: Sequence[Bounds], dsm: Sequence[Source], dsm_bounds: Sequence[Bounds]
) -> None:
    if any(meeting(a, b) is not None for a in dop_bounds for b in dsm_bounds):
        return
    raise MapError(
        f"{dsm[0].name}{' and others' if len(dsm) > 1 else ''}: covers west, south, east, north"
        f" {_rounded(_union(dsm_bounds))}, {dop[0].name} covers {_rounded(_union(dop_bounds))};"
        " they do not overlap, choose rasters of one area"
    )


def _union(boxes: Sequence[Bounds]) -> Bounds:
    west, south, east, north = zip(*boxes, strict=True)
    return min(west), min(south), max(east), max(north)


def _rounded(bounds: Bounds) -> tuple[float, ...]:
    return tuple(round(v, 1) for v in bounds)


def _without_unused(layer: LayerPlan) -> LayerPlan:
    """Without the sources outside the area: of a state's folder a mission needs ten."""
    used = sorted({k for tile in layer.tiles for k in tile.sources})
    number = {k: new for new, k in enumerate(used)}
    tiles = tuple(replace(tile, sources=tuple(number[k] for k in tile.sources)) for tile in layer.tiles)
    return replace(
        layer,
        sources=tuple(layer.sources[k] for k in used),
        bounds=tuple(layer.bounds[k] for k in used),
        tiles=tiles,
    )
