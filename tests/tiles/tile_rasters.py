"""Rasters to build packs from: a tilted plane with a hole, so that every pixel's value tells where it is."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import rasterio
from affine import Affine

from ortholoc_edge.geometry.grid import RasterGrid

CRS = "EPSG:32633"
# Odd sizes: the overviews' pixels are then no multiple of the full ones.
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
