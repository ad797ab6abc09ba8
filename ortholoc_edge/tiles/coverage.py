"""Where a pack has its map: `reports/coverage.geojson`, from how much of each cell is valid."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Sequence
from typing import Any, Final

import cv2
import numpy as np
import rasterio.features
from rasterio import Affine

from ortholoc_edge.geometry.arrays import BoolArray, Float32Array, FloatArray, ImageArray
from ortholoc_edge.geometry.grid import RasterGrid
from ortholoc_edge.tiles.georeference import Georeference
from ortholoc_edge.tiles.lattice import CROP_PX
from ortholoc_edge.tiles.manifest import Dop, Dsm, Manifest, layer_box

# Percent of a cell; below, it counts as without.
PRESENT_PERCENT: Final = 50.0
COMPLETE, DOP_ONLY, DSM_ONLY = 1, 2, 3

# Polygons are made coarser until the file is below; a GIS opens it either way, but packs travel by radio, too.
_MAX_BYTES: Final = 180_000
_MAX_SIDE: Final = 1024
_MAX_HOLES: Final = 300
_KINDS: Final = {
    COMPLETE: ("complete", "orthophoto and surface model", "#2a9d5c"),
    DOP_ONLY: ("dop_without_dsm", "orthophoto without surface model", "#e0a020"),
    DSM_ONLY: ("dsm_without_dop", "surface model without orthophoto", "#4a78d0"),
}
# Decimals of degrees (0.1 m) and of metres.
_DECIMALS_DEG, _DECIMALS_M = 6, 2

_Ring = list[list[float]]
_Polygon = list[_Ring]
_Place = Callable[[float, float], list[float]]


def cell_share(valid: BoolArray) -> ImageArray:
    """Percent of valid pixels (H / 64, W / 64) uint8 in cells of ``CROP_PX`` x ``CROP_PX`` of a mask (H, W).

    0 and 100 mean none and all: what lies between is rounded to 1 to 99.
    Raises: ValueError if the sides are not whole cells.
    """
    height, width = valid.shape
    if height % CROP_PX or width % CROP_PX:
        raise ValueError(f"coverage: {width} x {height} px are not whole cells of {CROP_PX} px")
    counts = valid.reshape(height // CROP_PX, CROP_PX, width // CROP_PX, CROP_PX).sum(axis=(1, 3), dtype=np.int64)
    share: ImageArray = np.clip(np.rint(100.0 * counts / CROP_PX**2), 1, 99).astype(np.uint8)
    share[counts == 0] = 0
    share[counts == CROP_PX**2] = 100
    return share


def layer_cells(layer: Dop | Dsm, tiles: Sequence[ImageArray], empty: int = 0) -> tuple[ImageArray, RasterGrid]:
    """Per-tile cells put together over the layer's box, ``empty`` where it has no tile, and their grid.

    Args:
        tiles: (height / 64, width / 64) uint8 per tile, in the manifest's order.
    """
    box, side_m = layer_box(layer.tiles), layer.lattice.pixel_m * CROP_PX
    cells = np.full((box.height // CROP_PX, box.width // CROP_PX), empty, dtype=np.uint8)
    for tile, values in zip(layer.tiles, tiles, strict=True):
        row, column = (tile.row - box.row) // CROP_PX, (tile.column - box.column) // CROP_PX
        cells[row : row + tile.height // CROP_PX, column : column + tile.width // CROP_PX] = values
    corner = layer.lattice.grid(box)
    return cells, RasterGrid(cells.shape[1], cells.shape[0], corner.west, corner.top, side_m, -side_m)


def shares_on(shares: ImageArray, grid: RasterGrid, target: RasterGrid) -> Float32Array:
    """Percentages (h, w) of cells on ``grid`` at the centres of the cells of ``target``; 0 outside.

    Inside a full or an empty cell its own; inside any other, bilinear: where its cells are larger than the
    target's, the half-valid one at the rim of a map is taken for valid on its inner half.
    """
    columns = (target.west + target.dx * (np.arange(target.width) + 0.5) - grid.west) / grid.dx - 0.5
    rows = (target.top + target.dy * (np.arange(target.height) + 0.5) - grid.top) / grid.dy - 0.5
    u, v = np.meshgrid(columns.astype(np.float32), rows.astype(np.float32))
    values = shares.astype(np.float32)
    own = cv2.remap(values, u, v, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT)
    mixed = cv2.remap(values, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
    return np.where((own == 0) | (own == 100), own, mixed).astype(np.float32)


def coverage_geojson(
    manifest: Manifest,
    georeference: Georeference,
    dop_shares: Sequence[ImageArray],
    dsm_shares: Sequence[ImageArray],
    filled: Iterable[tuple[float, float, int]] = (),
) -> bytes:
    """The pack's coverage as a GeoJSON FeatureCollection (RFC 7946; WGS 84 longitude and latitude).

    Features, told apart by the property ``kind``: ``complete``, ``dop_without_dsm`` and ``dsm_without_dop`` are
    polygons of what one has; ``filled_hole`` is the centre of a hole of the surface model that was closed;
    ``source`` covers the tiles that show a source. ``km2`` counts valid pixels, whatever the polygons' detail.
    A pack without reference system has its local metres as coordinates, and a member that says so.
    Args:
        dop_shares, dsm_shares: of `cell_share`, one array per tile in the manifest's order.
        filled: (easting, northing, cells) of holes that were closed; the largest 300 are listed.
    Returns: UTF-8 of some 200 kB at most, however large the pack; equal input gives equal bytes.
    """
    place = _place(georeference)
    dop, dsm, grid = _common(manifest, dop_shares, dsm_shares)
    holes = sorted(filled, key=lambda hole: (-hole[2], hole[0], hole[1]))
    head: dict[str, Any] = {"type": "FeatureCollection"}
    if manifest.crs is None:
        head["coordinates_are"] = "local metres (east, north), not longitude and latitude: the pack has no CRS"
    head["filled_holes"] = {"count": len(holes), "cells": sum(cells for *_, cells in holes)}
    km2 = _areas_km2(dop, dsm, grid)
    step = -(-max(dop.shape) // _MAX_SIDE)
    while True:
        detail = {"cell_m": round(grid.dx * step, 3)}
        features = _states(dop, dsm, grid, step, km2, place)
        features += _source_features(manifest, dop, dsm, grid, step, place)
        features += [_hole(hole, manifest.dsm.lattice.pixel_m, place) for hole in holes[:_MAX_HOLES]]
        text = json.dumps({**head, **detail, "features": features}, separators=(",", ":"), ensure_ascii=False)
        data = text.encode() + b"\n"
        if len(data) <= _MAX_BYTES or step >= max(dop.shape):
            return data
        step *= 2


def _common(
    manifest: Manifest, dop_shares: Sequence[ImageArray], dsm_shares: Sequence[ImageArray]
) -> tuple[Float32Array, Float32Array, RasterGrid]:
    """Percentages of both layers on cells of the orthophoto's lattice, over both."""
    dop, dop_grid = layer_cells(manifest.dop, dop_shares)
    dsm, dsm_grid = layer_cells(manifest.dsm, dsm_shares)
    side_m = dop_grid.dx
    bounds = [dop_grid.bounds, dsm_grid.bounds]
    west, south = (min(bound[k] for bound in bounds) for k in (0, 1))
    east, north = (max(bound[k] for bound in bounds) for k in (2, 3))
    # Whole cells beyond the orthophoto's own, so that those stay where they are.
    before = np.ceil([(dop_grid.west - west) / side_m - 1e-6, (north - dop_grid.top) / side_m - 1e-6]).astype(int)
    left, top = dop_grid.west - side_m * before[0], dop_grid.top + side_m * before[1]
    width, height = np.ceil([(east - left) / side_m - 1e-6, (top - south) / side_m - 1e-6]).astype(int)
    grid = RasterGrid(int(width), int(height), float(left), float(top), side_m, -side_m)
    own = np.zeros((grid.height, grid.width), dtype=np.float32)
    own[before[1] : before[1] + dop.shape[0], before[0] : before[0] + dop.shape[1]] = dop
    return own, shares_on(dsm, dsm_grid, grid), grid


def _classes(dop: FloatArray, dsm: FloatArray) -> ImageArray:
    has_dop, has_dsm = dop >= PRESENT_PERCENT, dsm >= PRESENT_PERCENT
    classes = np.zeros(dop.shape, dtype=np.uint8)
    classes[has_dop & has_dsm] = COMPLETE
    classes[has_dop & ~has_dsm] = DOP_ONLY
    classes[has_dsm & ~has_dop] = DSM_ONLY
    return classes


def _areas_km2(dop: Float32Array, dsm: Float32Array, grid: RasterGrid) -> dict[int, float]:
    both = np.minimum(dop, dsm)
    percents = {COMPLETE: both, DOP_ONLY: dop - both, DSM_ONLY: dsm - both}
    cell_km2 = grid.dx * abs(grid.dy) / 1e6
    return {key: float(percent.sum(dtype=np.float64)) / 100.0 * cell_km2 for key, percent in percents.items()}


def _states(
    dop: Float32Array, dsm: Float32Array, grid: RasterGrid, step: int, km2: dict[int, float], place: _Place
) -> list[dict[str, Any]]:
    classes = _classes(_coarser(dop, step), _coarser(dsm, step))
    features = []
    for key, (kind, title, colour) in _KINDS.items():
        polygons = _polygons(classes == key, grid, step, place)
        if polygons:
            properties = {"kind": kind, "title": title, "km2": round(km2[key], 4), "fill": colour}
            features.append(_feature({"type": "MultiPolygon", "coordinates": polygons}, properties))
    return features


def _source_features(
    manifest: Manifest, dop: Float32Array, dsm: Float32Array, grid: RasterGrid, step: int, place: _Place
) -> list[dict[str, Any]]:
    features = []
    for name, layer, percent in (("dop", manifest.dop, dop), ("dsm", manifest.dsm, dsm)):
        valid = percent >= PRESENT_PERCENT
        for index, source in enumerate(layer.sources):
            shown = np.zeros(valid.shape, dtype=bool)
            for tile in layer.tiles:
                if index in tile.sources:
                    shown[_block(layer.lattice.grid(tile.box).bounds, grid)] = True
            shown &= valid
            polygons = _polygons(_coarser(100.0 * shown, step) >= PRESENT_PERCENT, grid, step, place)
            if not polygons:
                continue
            properties = {
                "kind": "source",
                "layer": name,
                "name": source.name,
                "date": source.date,
                "precision": "tiles that show it",
                "km2": round(np.count_nonzero(shown) * grid.dx**2 / 1e6, 4),
            }
            features.append(_feature({"type": "MultiPolygon", "coordinates": polygons}, properties))
    return features


def _hole(hole: tuple[float, float, int], pixel_m: float, place: _Place) -> dict[str, Any]:
    east, north, cells = hole
    properties = {"kind": "filled_hole", "cells": cells, "m2": round(cells * pixel_m**2, 2)}
    return _feature({"type": "Point", "coordinates": place(east, north)}, properties)


def _feature(geometry: dict[str, Any], properties: dict[str, Any]) -> dict[str, Any]:
    return {"type": "Feature", "geometry": geometry, "properties": properties}


def _block(bounds: tuple[float, float, float, float], grid: RasterGrid) -> tuple[slice, slice]:
    """The cells whose centres lie in bounds."""
    west, south, east, north = bounds
    columns = [max(round((x - grid.west) / grid.dx), 0) for x in (west, east)]
    rows = [max(round((grid.top - y) / grid.dx), 0) for y in (north, south)]
    return slice(*rows), slice(*columns)


def _coarser(percent: FloatArray | Float32Array, step: int) -> FloatArray:
    """Means over ``step`` x ``step`` cells; beyond the array there is nothing."""
    rows, columns = (-(-side // step) for side in percent.shape)
    padded = np.zeros((rows * step, columns * step))
    padded[: percent.shape[0], : percent.shape[1]] = percent
    return np.asarray(padded.reshape(rows, step, columns, step).mean(axis=(1, 3)), dtype=np.float64)


def _polygons(mask: BoolArray, grid: RasterGrid, step: int, place: _Place) -> list[_Polygon]:
    """Outlines of a mask's regions: outer rings counter-clockwise, holes clockwise, as the RFC wants them."""
    transform = Affine(grid.dx * step, 0.0, grid.west, 0.0, -grid.dx * step, grid.top)
    found = rasterio.features.shapes(mask.astype(np.uint8), mask=mask, connectivity=4, transform=transform)
    polygons: list[_Polygon] = []
    for shape, _ in found:
        rings: _Polygon = []
        for ring in shape["coordinates"]:
            points = np.asarray(ring, dtype=np.float64)
            if (_signed_area(points) > 0) != (not rings):
                points = points[::-1]
            rings.append([place(float(x), float(y)) for x, y in points])
        polygons.append(rings)
    return polygons


def _signed_area(ring: FloatArray) -> float:
    # From the first point: products of eastings and northings of millions of metres would lose the digits.
    x, y = (ring[:, :2] - ring[0, :2]).T
    return float(np.sum(x[:-1] * y[1:] - x[1:] * y[:-1]))


def _place(georeference: Georeference) -> _Place:
    """From map coordinates to the file's."""
    known: dict[tuple[float, float], list[float]] = {}

    def local(x: float, y: float) -> list[float]:
        return [round(x, _DECIMALS_M), round(y, _DECIMALS_M)]

    def geodetic(x: float, y: float) -> list[float]:
        if (x, y) not in known:
            position = georeference.geodetic_from_map((x, y, 0.0))
            known[x, y] = [round(position.lon_deg, _DECIMALS_DEG), round(position.lat_deg, _DECIMALS_DEG)]
        return known[x, y]

    return local if georeference.crs is None else geodetic
