"""Arrays of one tile to the bytes of a Cloud Optimized GeoTIFF. Equal arrays give equal bytes."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
import rasterio
import rasterio.shutil
from rasterio.errors import RasterioError
from rasterio.io import MemoryFile
from rasterio.transform import Affine

from ortholoc_edge.errors import MapError
from ortholoc_edge.geometry.arrays import BoolArray, Float32Array, ImageArray
from ortholoc_edge.geometry.grid import RasterGrid
from ortholoc_edge.tiles.cog import BLOCK_PX, quiet_georeference
from ortholoc_edge.tiles.lattice import LEVELS

NODATA = -9999.0

Compression = Literal["webp", "jpeg"]

# Of the four cells below a cell of an overview, by area of data, what must have data for it to have any: GDAL's
# average leaves out nodata, so that one valid cell of four makes a valid average, one of sixteen two levels up, and
# every scattered hole would be closed with the heights around it.
_MIN_VALID_SHARE = 0.75


def dop_cog(
    rgb: ImageArray,
    valid: BoolArray,
    grid: RasterGrid,
    crs: str | None,
    compression: Compression = "webp",
    quality: int = 85,
) -> bytes:
    """Orthophoto (3, H, W) uint8 with its validity (H, W) as an internal mask; sides are multiples of 16.

    What is invalid is set to one colour: what a lossy source has there is noise that costs bytes. Quality 100 of
    WEBP is lossless.
    """
    # GDAL's own averaging leaves out masked pixels, so that their colour does not bleed into an overview.
    options: dict[str, Any] = {
        "compress": compression.upper(),
        "quality": quality,
        "overviews": "IGNORE_EXISTING",
        "overview_count": LEVELS - 1,
        "overview_compress": compression.upper(),
        "overview_quality": quality,
    }
    with quiet_georeference(), rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True), MemoryFile() as work:
        profile = _profile(grid, crs) | {"count": 3, "dtype": "uint8", "photometric": "RGB", "interleave": "pixel"}
        with work.open(**profile) as target:
            target.write(rgb * valid)
            target.write_mask(valid)
        return _cog(work.name, options)


def dsm_cog(heights: Float32Array, grid: RasterGrid, crs: str | None, max_z_error_m: float) -> bytes:
    """Heights (H, W) float32, NaN where there are none; sides are multiples of 16.

    LERC stores a block's lowest value as it is, and nodata lies below all heights: so it survives exactly.
    """
    levels = [heights.astype(np.float32, copy=False)]
    share = np.isfinite(levels[0]).astype(np.float32)
    for _ in range(LEVELS - 1):
        heights, share = _halved(levels[-1], share)
        levels.append(heights)
    options = {"compress": "LERC_ZSTD", "max_z_error": max_z_error_m, "overviews": "AUTO"}
    files: list[MemoryFile] = []
    try:
        for level, values in enumerate(levels):
            files.append(MemoryFile())
            stored = np.where(np.isnan(values), np.float32(NODATA), values)
            profile = _profile(grid.resized(values.shape[1], values.shape[0]), crs if level == 0 else None)
            with quiet_georeference(), files[-1].open(count=1, dtype="float32", nodata=NODATA, **profile) as target:
                target.write(stored, 1)
        with MemoryFile(ext=".vrt") as vrt:
            rasterio.shutil.copy(files[0].name, vrt.name, driver="VRT")
            entries = "".join(
                f'<Overview><SourceFilename relativeToVRT="0">{one.name}</SourceFilename>'
                "<SourceBand>1</SourceBand></Overview>"
                for one in files[1:]
            )
            text = vrt.read().decode().replace("</VRTRasterBand>", entries + "</VRTRasterBand>")
            with MemoryFile(text.encode(), ext=".vrt") as with_levels:
                return _cog(with_levels.name, options)
    finally:
        for one in files:
            one.close()


def _halved(heights: Float32Array, share: Float32Array) -> tuple[Float32Array, Float32Array]:
    """The next level: means of 2 x 2 cells with data, weighted by how much of them had data, and that share."""
    rows, columns = heights.shape
    four = (rows // 2, 2, columns // 2, 2)
    weighted = np.where(np.isnan(heights), 0.0, heights).astype(np.float64) * share
    sums, weights = weighted.reshape(four).sum(axis=(1, 3)), share.reshape(four).sum(axis=(1, 3))
    mean = np.divide(sums, weights, out=np.full_like(sums, np.nan), where=weights / 4 >= _MIN_VALID_SHARE)
    # A cell that was refused keeps its share, but gives no height to the next level.
    carried = np.where(np.isnan(mean), 0.0, weights / 4)
    return mean.astype(np.float32), carried.astype(np.float32)


def _profile(grid: RasterGrid, crs: str | None) -> dict[str, Any]:
    return {
        "driver": "GTiff",
        "width": grid.width,
        "height": grid.height,
        "transform": Affine(grid.dx, 0.0, grid.west, 0.0, grid.dy, grid.top),
        "crs": crs,
        "tiled": True,
        "blockxsize": BLOCK_PX,
        "blockysize": BLOCK_PX,
        "bigtiff": "IF_SAFER",
    }


def _cog(source: str, options: dict[str, Any]) -> bytes:
    with MemoryFile(ext=".tif") as out:
        try:
            rasterio.shutil.copy(
                source,
                out.name,
                driver="COG",
                blocksize=BLOCK_PX,
                overview_resampling="AVERAGE",
                bigtiff="IF_SAFER",
                num_threads=1,
                **options,
            )
        except RasterioError as err:
            raise MapError(f"tile cannot be compressed ({err}); try --dop-compression jpeg") from err
        return bytes(out.read())
