"""How likely a camera frame over a piece of the map can be matched, judged from the orthophoto alone.

A matcher needs corners that are still corners after a year, in another light and at another sharpness. So the
measure is the smaller eigenvalue of the structure tensor, and what counts is what it has at two neighbouring
scales: noise, compression and blades of grass are gone at the coarser, and a blurred blob has nothing at the
finer. The strongest response in each sixteenth of a cell counts, by its logarithm, so that one house in a field
does not speak for the whole cell. Strict repetition (rows of crops, solar panels) and water are taken off.

Frames of the real flights were matched against their maps with XFeat, unchanged and with another spectral mix,
gamma, blur and noise; ``_CALIBRATION`` turns the measure into how often a cell yielded correct matches.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import Final

import cv2
import numpy as np
from rasterio import Affine
from rasterio.io import MemoryFile

from ortholoc_edge.geometry.arrays import BoolArray, Float32Array, FloatArray, ImageArray
from ortholoc_edge.tiles.coverage import PRESENT_PERCENT, layer_cells, shares_on
from ortholoc_edge.tiles.lattice import CROP_PX
from ortholoc_edge.tiles.manifest import Manifest

# Of the mean score over a frame's footprint: from the first on a match is expected, from the second it is doubtful,
# below it is not to be counted on. Of 343 quarters of real frames with another spectral mix, gamma, blur and noise
# laid on them, at least a quarter of the matches was right in 94 %, 69 % and 28 % (as they are: 99 %, 94 %, 86 %).
# That is the data the limits were chosen on; a real change of season was not at hand.
MATCHABLE_EXPECTED_MIN: Final = 40
MATCHABLE_DOUBTFUL_MIN: Final = 20
NO_MAP: Final = 255

# Pixels of the orthophoto per pixel of each scale.
_SCALES: Final = (2, 4, 8)
_BLOCKS: Final = 4
_DERIVATIVE_BLUR, _WINDOW_BLUR = 0.8, 1.5
# Pixels of a scale that its filters reach: nearer to a hole its rim is what they see.
_REACH: Final = 5
# Rows of cells that are worked on at once: memory, and the processor's cache.
_BAND_CELLS: Final = 16
# Measure -> score. The score of a measure is the share of frames, half of them altered, that had two correct pairs in
# such a cell (9600 cells, 44 frames), over that share on the best ground, 72 %. Below the first measure is what
# compression and a noise of 8 grey levels make of a blank wall.
_CALIBRATION: Final = (
    (0.12, 0.0),
    (0.17, 14.0),
    (0.25, 17.0),
    (0.35, 25.0),
    (0.45, 35.0),
    (0.55, 40.0),
    (0.7, 53.0),
    (0.9, 68.0),
    (1.1, 80.0),
    (1.4, 90.0),
    (1.8, 100.0),
)
# Of the autocorrelation: how far a period stands out above the half of it; beyond the second nothing is left.
_PERIODIC: Final = (0.6, 1.0)
# Periods, in pixels at half size.
_PERIOD_PX: Final = (4, 16)
# NDWI of water; shadows and roofs reach it as well, but are narrower.
_WATER_INDEX: Final = 0.05
_WATER_WIDTH_M: Final = 8.0


def cells(rgb: ImageArray, valid: BoolArray, gsd_m: float, nir: ImageArray | None = None) -> ImageArray:
    """Matchability of each ``CROP_PX`` x ``CROP_PX`` pixels of an orthophoto.

    Args:
        rgb: (H, W, 3) uint8, sides multiples of ``CROP_PX``.
        valid: (H, W), False where there is no orthophoto.
        gsd_m: of the pixels; tells water from shadows by its width.
        nir: (H, W) uint8 near infrared, where the orthophoto has it.
    Returns: (H / 64, W / 64) uint8, 0 to 100; 255 where no pixel is valid. A part of a cell without
        orthophoto counts as without texture.
    Raises: ValueError for other shapes or a GSD that is none.
    """
    height, width = valid.shape
    if rgb.shape != (height, width, 3) or (nir is not None and nir.shape != valid.shape):
        raise ValueError(f"matchability: shapes {rgb.shape} and {valid.shape} do not fit")
    if not height or not width or height % CROP_PX or width % CROP_PX:
        raise ValueError(f"matchability: {width} x {height} px are not whole cells of {CROP_PX} px")
    if not (math.isfinite(gsd_m) and gsd_m > 0):
        raise ValueError(f"matchability: gsd_m {gsd_m} must be positive")
    grey = np.asarray(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), dtype=np.uint8)
    measures = []
    for first in range(0, height, _BAND_CELLS * CROP_PX):
        last = min(first + _BAND_CELLS * CROP_PX, height)
        # One cell more on either side: bands must not show in the result.
        above, below = (CROP_PX if first else 0), (CROP_PX if last < height else 0)
        rows = slice(first - above, last + below)
        band = _measure(grey[rows], valid[rows])
        measures.append(band[above // CROP_PX : len(band) - below // CROP_PX])
    scores = np.interp(np.concatenate(measures), *np.transpose(_CALIBRATION))
    if nir is not None:
        scores *= 1.0 - _water_share(rgb, nir, valid, gsd_m)
    result: ImageArray = np.rint(scores).astype(np.uint8)
    result[_cell_means(valid.astype(np.float32)) == 0] = NO_MAP
    return result


def matchability_tif(manifest: Manifest, dop_cells: Sequence[ImageArray], dsm_shares: Sequence[ImageArray]) -> bytes:
    """The cells of a pack as a GeoTIFF, one pixel per cell on the orthophoto's lattice.

    Args:
        dop_cells: of `cells`, one array per DOP tile in the manifest's order.
        dsm_shares: of `coverage.cell_share`, one array per DSM tile.
    Returns: uint8, DEFLATE, nodata 255, which is also where a cell's centre has no surface model. Equal input
        gives equal bytes.
    """
    values, grid = layer_cells(manifest.dop, dop_cells, empty=NO_MAP)
    shares, dsm_grid = layer_cells(manifest.dsm, dsm_shares)
    values[shares_on(shares, dsm_grid, grid) < PRESENT_PERCENT] = NO_MAP
    profile = {
        "driver": "GTiff",
        "width": grid.width,
        "height": grid.height,
        "count": 1,
        "dtype": "uint8",
        "crs": manifest.crs,
        "transform": Affine(grid.dx, 0.0, grid.west, 0.0, grid.dy, grid.top),
        "nodata": NO_MAP,
        "compress": "deflate",
        "tiled": True,
        "blockxsize": 256,
        "blockysize": 256,
    }
    with MemoryFile() as memory:
        with memory.open(**profile) as raster:
            raster.write(values, 1)
            raster.set_band_description(1, "matchability, 0 to 100")
        return bytes(memory.read())


def _measure(grey: ImageArray, valid: BoolArray) -> FloatArray:
    """Corners that two neighbouring scales have, per cell."""
    responses, half = [], None
    for scale in _SCALES:
        image, usable = _shrunk(grey, valid, scale)
        half = image if half is None else half
        responses.append(_corners(image, usable, CROP_PX // scale // _BLOCKS))
    persistent = [np.minimum(fine, coarse) for fine, coarse in itertools.pairwise(responses)]
    measure = _cell_means(np.mean(persistent, axis=0), _BLOCKS)
    assert half is not None
    return measure * (1.0 - _repetition(half))


def _shrunk(grey: ImageArray, valid: BoolArray, scale: int) -> tuple[Float32Array, BoolArray]:
    """The image at ``1 / scale``, and where filters on it see nothing but map."""
    size = (grey.shape[1] // scale, grey.shape[0] // scale)
    image = cv2.resize(grey, size, interpolation=cv2.INTER_AREA).astype(np.float32)
    if valid.all():
        return image, np.ones(image.shape, dtype=bool)
    whole = (cv2.resize(valid.astype(np.uint8) * 255, size, interpolation=cv2.INTER_AREA) == 255).astype(np.uint8)
    reach = np.ones((2 * _REACH + 1, 2 * _REACH + 1), np.uint8)
    # Outside the array counts as map: its border is a tile's, not a hole's.
    return image, cv2.erode(whole, reach).astype(bool)


def _corners(image: Float32Array, usable: BoolArray, block: int) -> Float32Array:
    """Strongest corner of each ``block`` x ``block`` pixels: log(1 + smaller eigenvalue in grey levels squared)."""
    smooth = cv2.GaussianBlur(image, (5, 5), _DERIVATIVE_BLUR)
    x = cv2.Sobel(smooth, cv2.CV_32F, 1, 0, scale=1 / 8)
    y = cv2.Sobel(smooth, cv2.CV_32F, 0, 1, scale=1 / 8)
    xx, yy, xy = (cv2.GaussianBlur(product, (7, 7), _WINDOW_BLUR) for product in (x * x, y * y, x * y))
    smaller = 0.5 * (xx + yy - cv2.sqrt((xx - yy) ** 2 + 4.0 * xy * xy))
    smaller[~usable] = 0.0
    rows, columns = (side // block for side in image.shape)
    strongest = smaller.reshape(rows, block, columns, block).max(axis=(1, 3))
    return np.asarray(np.log1p(np.maximum(strongest, 0.0)), dtype=np.float32)


def _repetition(half: Float32Array) -> FloatArray:
    """0 to 1 per cell: how strictly its pattern repeats, from the image at half size.

    A step of a whole period looks alike and one of half a period does not; along a lone road's edge both do.
    """
    side = CROP_PX // 2
    rough = half - cv2.blur(half, (15, 15))
    rows, columns = (length // side for length in half.shape)
    tiles = rough.reshape(rows, side, columns, side).swapaxes(1, 2)
    window = np.hanning(side + 2)[1:-1].astype(np.float32)
    taper = np.outer(window, window)
    power = np.abs(np.fft.rfft2((tiles - tiles.mean(axis=(2, 3), keepdims=True)) * taper)) ** 2
    alike = np.fft.irfft2(power, (side, side))
    expected = np.fft.irfft2(np.abs(np.fft.rfft2(taper)) ** 2, (side, side))
    # At least one grey level of variance, or the noise of a blank wall would be searched for periods.
    alike *= (expected[0, 0] / expected) / np.maximum(alike[..., :1, :1], expected[0, 0])
    low, high = _PERIOD_PX
    excess = np.zeros((rows, columns))
    for v in range(high + 1):
        for u in range(-high, high + 1):
            if not low <= math.hypot(u, v) <= high or (v == 0 and u < 0):
                continue
            # Of an odd step the pixels on either side of its middle.
            between = np.minimum(alike[..., v // 2, u // 2], alike[..., (v + 1) // 2, (u + 1) // 2])
            period = alike[..., v, u]
            excess = np.maximum(excess, np.minimum(period, period - between))
    return np.clip((excess - _PERIODIC[0]) / (_PERIODIC[1] - _PERIODIC[0]), 0.0, 1.0)


def _water_share(rgb: ImageArray, nir: ImageArray, valid: BoolArray, gsd_m: float) -> FloatArray:
    """Share of each cell that is water by the normalised difference of green and near infrared."""
    scale = _SCALES[1]
    size = (nir.shape[1] // scale, nir.shape[0] // scale)
    green = cv2.resize(np.ascontiguousarray(rgb[:, :, 1]), size, interpolation=cv2.INTER_AREA).astype(np.float32)
    infrared = cv2.resize(nir, size, interpolation=cv2.INTER_AREA).astype(np.float32)
    here = cv2.resize(valid.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
    water = (here & (green - infrared > _WATER_INDEX * (green + infrared))).astype(np.uint8)
    # An opening, by an odd width so that it stays in place, and about a cell at most: a pond is not a shadow.
    width = min(round(_WATER_WIDTH_M / (gsd_m * scale)), CROP_PX // scale) | 1
    opened = cv2.morphologyEx(water, cv2.MORPH_OPEN, np.ones((width, width), np.uint8))
    return _cell_means(opened.astype(np.float32), CROP_PX // scale)


def _cell_means(values: Float32Array, cell: int = CROP_PX) -> FloatArray:
    """Means over ``cell`` x ``cell`` values."""
    rows, columns = (side // cell for side in values.shape)
    means = values.reshape(rows, cell, columns, cell).mean(axis=(1, 3), dtype=np.float64)
    return np.asarray(means, dtype=np.float64)
