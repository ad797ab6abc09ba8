"""Rasters to build packs from: a tilted plane with a hole, so that every pixel's value tells where it is."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import rasterio
from affine import Affine

from ortholoc_edge.geometry.grid import RasterGrid

CRS = "EPSG:32633"
# Odd sizes: the pack's tiles reach beyond them.
DOP_GRID = RasterGrid(1475, 1307, 400_000.0, 5_300_000.0, 0.1, -0.1)
DSM_GRID = RasterGrid(739, 655, 400_000.0, 5_300_000.0, 0.2, -0.2)
SHARED = Path(__file__).parents[2].parent / "shared" / "data" / "real"


def plane(xy):
    """Height of the test surface at map positions (..., 2), m."""
    return 300.0 + 0.3 * (xy[..., 0] - DSM_GRID.west) - 0.2 * (xy[..., 1] - DSM_GRID.top)


def centres(grid):
    u, v = np.meshgrid(np.arange(grid.width), np.arange(grid.height))
    return grid.map_from_px(np.stack([u, v], axis=-1))


def colours(xy):
    """RGB (..., 3) float of the test orthophoto: red rises eastward, green southward, blue falls."""
    east, south = xy[..., 0] - DOP_GRID.west, DOP_GRID.top - xy[..., 1]
    return np.stack([20 + 1.4 * east, 20 + 1.5 * south, 235 - 0.7 * east - 0.75 * south], axis=-1)


def write_raster(path, bands, grid, crs=CRS, *, mask=None, transform=None, **profile):
    """Bands (K, H, W) to a GeoTIFF."""
    bands = np.asarray(bands)
    profile = {
        "driver": "GTiff",
        "width": grid.width,
        "height": grid.height,
        "count": len(bands),
        "dtype": bands.dtype.name,
        "crs": crs,
        "transform": transform or Affine(grid.dx, 0, grid.west, 0, grid.dy, grid.top),
        **profile,
    }
    colorinterp = profile.pop("colorinterp", None)
    with rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True), rasterio.open(path, "w", **profile) as target:
        if colorinterp is not None:
            target.colorinterp = colorinterp
        target.write(bands)
        if mask is not None:
            target.write_mask(mask)
    return path


def dop_pixels(grid=DOP_GRID):
    return np.moveaxis(np.rint(colours(centres(grid))), -1, 0).astype(np.uint8)


def dsm_heights(grid=DSM_GRID):
    return plane(centres(grid)).astype(np.float32)[None]


def write_scene(folder, crs=CRS):
    """A DOP and a DSM without holes. Returns their paths."""
    folder.mkdir(parents=True, exist_ok=True)
    return (
        write_raster(folder / "dop_source.tif", dop_pixels(), DOP_GRID, crs),
        write_raster(folder / "dsm_source.tif", dsm_heights(), DSM_GRID, crs, nodata=-9999.0),
    )


def write_holed_scene(folder, crs=CRS):
    """The same with a hole in the middle of both, the orthophoto's declared by a mask."""
    folder.mkdir(parents=True, exist_ok=True)
    heights = dsm_heights()
    heights[0, 200:330, 300:437] = np.nan
    mask = np.ones((DOP_GRID.height, DOP_GRID.width), dtype=bool)
    mask[400:660, 600:874] = False
    return (
        write_raster(folder / "dop_source.tif", dop_pixels(), DOP_GRID, crs, mask=mask),
        write_raster(folder / "dsm_source.tif", heights, DSM_GRID, crs, nodata=float("nan")),
    )


def real_sources(name):
    """Paths of a real set's DOP and DSM, or None where the data is not at hand."""
    if name == "demo":
        folder = SHARED / "ortholoc_demo"
        paths = folder / "demo_urban_dop.tif", folder / "demo_urban_dsm_orthostereo.tif"
    else:
        paths = SHARED / name / f"{name}_dop.tif", SHARED / name / f"{name}_dsm.tif"
    return paths if all(path.is_file() for path in paths) else None


def dop_of(pack, grid=DOP_GRID):
    """RGB (H, W, 3) and validity of a pack's orthophoto on a grid of its pixels, by rasterio alone."""
    pixels, valid = np.zeros((grid.height, grid.width, 3), np.uint8), np.zeros((grid.height, grid.width), bool)
    for tile in pack.manifest.dop.tiles:
        with rasterio.open(pack.path / tile.file) as dataset:
            here, there = _common(pack.manifest.dop.lattice, tile.box, grid)
            pixels[here] = np.moveaxis(dataset.read(), 0, -1)[there]
            valid[here] = dataset.dataset_mask()[there] > 0
    return pixels, valid


def dsm_of(pack, grid=DSM_GRID):
    """Heights (H, W) of a pack on a grid of its pixels, NaN where there are none, by rasterio alone."""
    heights = np.full((grid.height, grid.width), np.nan, np.float32)
    for tile in pack.manifest.dsm.tiles:
        with rasterio.open(pack.path / tile.file) as dataset:
            here, there = _common(pack.manifest.dsm.lattice, tile.box, grid)
            heights[here] = np.where(dataset.read(1) == -9999.0, np.nan, dataset.read(1))[there]
    return heights


def _common(lattice, box, grid):
    """Slices (rows, columns) of the grid, and of a tile, where both have pixels."""
    left, top = (
        round((grid.west - lattice.west) / lattice.pixel_m) - box.column,
        round((lattice.top - grid.top) / lattice.pixel_m) - box.row,
    )
    first_row, first_column = max(top, 0), max(left, 0)
    last_row, last_column = min(top + grid.height, box.height), min(left + grid.width, box.width)
    rows, columns = (first_row, max(last_row, first_row)), (first_column, max(last_column, first_column))
    return (
        (slice(*(r - top for r in rows)), slice(*(c - left for c in columns))),
        (slice(*rows), slice(*columns)),
    )


def contents(folder):
    """Every file below a folder: bytes by relative name."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def textured(grid, seed=0):
    """RGB (3, H, W) uint8 whose every pixel is told by its place on the map, whatever grid it is asked for."""
    u, v = np.meshgrid(np.arange(grid.width), np.arange(grid.height))
    xy = np.rint(grid.map_from_px(np.stack([u, v], axis=-1)) / (grid.dx / 2)).astype(np.int64)
    mixed = (xy[..., 0] * 73_856_093) ^ (xy[..., 1] * 19_349_663) ^ (seed * 83_492_791)
    return np.stack([(mixed >> shift) % 200 + 30 for shift in (3, 9, 15)]).astype(np.uint8)


# A scene of several tiles that is compressed in tenths of a second: 2 x 2 tiles of DOP, 2 x 1 of DSM.
WIDE_DOP = RasterGrid(704, 448, 400_900.0, 5_299_900.0, 2.0, -2.0)
WIDE_DSM = RasterGrid(352, 224, 400_900.0, 5_299_900.0, 4.0, -4.0)


def write_wide_scene(folder, crs=CRS):
    """A textured DOP and a DSM of several tiles. Returns their paths."""
    folder.mkdir(parents=True, exist_ok=True)
    return (
        write_raster(folder / "wide_dop.tif", textured(WIDE_DOP), WIDE_DOP, crs),
        write_raster(folder / "wide_dsm.tif", dsm_heights(WIDE_DSM), WIDE_DSM, crs),
    )
