"""Arrays of one tile to the bytes of a Cloud Optimized GeoTIFF. Equal arrays give equal bytes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal
from xml.etree import ElementTree as ET

import cv2
import numpy as np
import numpy.typing as npt
import rasterio
import rasterio.shutil
from rasterio.errors import RasterioError
from rasterio.io import MemoryFile
from rasterio.transform import Affine

from ortholoc_edge.errors import MapError
from ortholoc_edge.geometry.arrays import BoolArray, Float32Array, ImageArray
from ortholoc_edge.geometry.grid import RasterGrid
from ortholoc_edge.tiles.cog import BLOCK_PX, quiet_georeference
from ortholoc_edge.tiles.levels import STORED_LEVELS, filled, halved_heights, halved_image

NODATA = -9999.0

Compression = Literal["webp", "jpeg"]

# Of ZSTD: the strongest. 4 to 5 % less than the usual 9, for 0.1 s per tile.
_DSM_LEVEL = 22


def dop_cog(
    rgb: ImageArray,
    valid: BoolArray,
    grid: RasterGrid,
    crs: str | None,
    compression: Compression = "webp",
    quality: int = 85,
    stored: Sequence[int] = STORED_LEVELS,
) -> bytes:
    """Orthophoto (3, H, W) uint8 with its validity (H, W) as an internal mask, none if all is valid; sides are
    multiples of 16.

    What is invalid is filled smoothly: what a lossy source has there is noise, and an edge at the rim of the data
    costs bytes, too. Quality 100 of WEBP is lossless.
    Args:
        stored: levels of `tiles.levels` that the file holds, 0 first.
    """
    picture = np.asarray(cv2.merge(list(rgb * valid)), dtype=np.uint8), valid
    levels: list[tuple[ImageArray, BoolArray | None]] = []
    for level in range(max(stored) + 1):
        picture = picture if level == 0 else halved_image(*picture)
        if level in stored:
            levels.append((np.moveaxis(filled(*picture), -1, 0), None if valid.all() else picture[1]))
    profile = {"count": 3, "dtype": "uint8", "photometric": "RGB", "interleave": "pixel"}
    options = {
        "compress": compression.upper(),
        "quality": quality,
        "overview_compress": compression.upper(),
        "overview_quality": quality,
    }
    return _cog(levels, grid, crs, profile, options)


def dsm_cog(
    heights: Float32Array,
    grid: RasterGrid,
    crs: str | None,
    max_z_error_m: float,
    stored: Sequence[int] = STORED_LEVELS,
) -> bytes:
    """Heights (H, W) float32, NaN where there are none; sides are multiples of 16.

    LERC stores a block's lowest value as it is, and nodata lies below all heights: so it survives exactly.
    Args:
        stored: as in `dop_cog`.
    """
    heights = heights.astype(np.float32, copy=False)
    share = np.isfinite(heights).astype(np.float32)
    levels: list[tuple[Float32Array, None]] = []
    for level in range(max(stored) + 1):
        if level > 0:
            heights, share = halved_heights(heights, share)
        if level in stored:
            levels.append((np.where(np.isnan(heights), np.float32(NODATA), heights)[None], None))
    profile = {"count": 1, "dtype": "float32", "nodata": NODATA}
    options = {"compress": "LERC_ZSTD", "level": _DSM_LEVEL, "max_z_error": max_z_error_m}
    return _cog(levels, grid, crs, profile, options)


def _cog(
    levels: Sequence[tuple[npt.NDArray[Any], BoolArray | None]],
    grid: RasterGrid,
    crs: str | None,
    profile: dict[str, Any],
    options: dict[str, Any],
) -> bytes:
    """A file of the given levels (K, H, W), each with its mask (H, W) or all without.

    GDAL takes overviews that are there from its source; a VRT makes one source of a raster per level.
    """
    files: list[MemoryFile] = []
    try:
        for level, (bands, valid) in enumerate(levels):
            files.append(MemoryFile())
            # Of the finest the grid itself: the division and back may cost its last digit.
            place = grid if level == 0 else grid.resized(bands.shape[2], bands.shape[1])
            profile = profile | _profile(place, crs if level == 0 else None)
            with (
                quiet_georeference(),
                rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True),
                files[-1].open(**profile) as target,
            ):
                target.write(bands)
                if valid is not None:
                    target.write_mask(valid)
        with MemoryFile(ext=".vrt") as vrt:
            rasterio.shutil.copy(files[0].name, vrt.name, driver="VRT")
            text = _with_overviews(vrt.read().decode(), [one.name for one in files[1:]])
        with MemoryFile(text.encode(), ext=".vrt") as source:
            return _compressed(source.name, options)
    finally:
        for one in files:
            one.close()


def _with_overviews(vrt: str, files: Sequence[str]) -> str:
    """The text of a VRT whose bands and mask have the same bands and masks of ``files`` as overviews."""
    root = ET.fromstring(vrt)
    for band in root.iter("VRTRasterBand"):
        for file in files:
            overview = ET.SubElement(band, "Overview")
            ET.SubElement(overview, "SourceFilename", relativeToVRT="0").text = file
            # The band of a mask has no number.
            ET.SubElement(overview, "SourceBand").text = band.get("band", "mask,1")
    return ET.tostring(root, encoding="unicode")


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


def _compressed(source: str, options: dict[str, Any]) -> bytes:
    with MemoryFile(ext=".tif") as out:
        try:
            rasterio.shutil.copy(
                source,
                out.name,
                driver="COG",
                blocksize=BLOCK_PX,
                overviews="FORCE_USE_EXISTING",
                bigtiff="IF_SAFER",
                num_threads=1,
                **options,
            )
        except RasterioError as err:
            raise MapError(f"tile cannot be compressed ({err}); try --dop-compression jpeg") from err
        return bytes(out.read())
