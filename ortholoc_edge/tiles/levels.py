"""The levels of a tile: which are stored, how a coarser one is averaged, what goes where there is no data.

A level that is not stored is averaged when it is read, from the next finer one that is. That saves a quarter of a
pack, and the mean of four lossy pixels is nearer to the truth than a lossy mean: by 4 to 8 dB (docs/benchmarks.md).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from ortholoc_edge.geometry.arrays import BoolArray, Float32Array, ImageArray

# Of the five: level 1 has three quarters of the bytes of all overviews. With level 2 left out too, its reads would
# decode 16 times the pixels; without level 4 a GIS that shows all of a mosaic would.
STORED_LEVELS = (0, 2, 4)

# Of the four cells below a cell of a coarser level, by area of data, what must have data for it to have any: with
# one valid cell of four making a valid mean, one of sixteen two levels up, every scattered hole would be closed
# with the heights around it.
_MIN_VALID_SHARE = 0.75

_SMOOTHING_PX = 5


def next_stored(stored: Sequence[int], level: int) -> int:
    """The coarsest stored level that is no coarser than ``level``."""
    return max(one for one in stored if one <= level)


def halved_image(rgb: ImageArray, valid: BoolArray) -> tuple[ImageArray, BoolArray]:
    """The next level of a picture (H, W, 3) uint8 with its validity (H, W); sides are even.

    Means over the valid ones of 2 x 2 pixels, rounded half up; valid where any is, else 0: what GDAL makes of a
    masked raster with AVERAGE.
    """
    size = rgb.shape[1] // 2, rgb.shape[0] // 2
    # OpenCV rounds half up as well, in integers; what it makes of cells with invalid pixels is replaced.
    mean = np.asarray(cv2.resize(rgb, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    if valid.all():
        return mean, np.ones(mean.shape[:2], dtype=np.bool_)
    count = _four(valid.astype(np.uint8))
    mean[count == 0] = 0
    rows, columns = np.nonzero((count > 0) & (count < 4))
    sums = np.zeros((len(rows), 3), dtype=np.uint16)
    for down, right in ((0, 0), (0, 1), (1, 0), (1, 1)):
        at = 2 * rows + down, 2 * columns + right
        sums += rgb[at] * valid[at][:, None]
    counts = count[rows, columns][:, None]
    mean[rows, columns] = (sums + counts // 2) // counts
    return mean, count > 0


def halved_heights(heights: Float32Array, share: Float32Array | None = None) -> tuple[Float32Array, Float32Array]:
    """The next level of heights (H, W), NaN where there are none; sides are even.

    Args:
        share: (H, W) how much of each cell had data at full resolution; None: all of each that has a height.
    Returns: means of 2 x 2 cells with data, weighted by their share, where three quarters of the cell have data,
        else NaN; and the shares of these cells.
    """
    if share is None:
        return _halved_plain(heights)
    weighted = np.where(np.isnan(heights), 0.0, heights).astype(np.float64) * share
    sums, weights = _four(weighted), _four(share)
    found = np.divide(sums, weights, out=np.full_like(sums, np.nan), where=weights / 4 >= _MIN_VALID_SHARE)
    # A cell that was refused gives nothing to the next level.
    carried = np.where(np.isnan(found), 0.0, weights / 4)
    return found.astype(np.float32), carried.astype(np.float32)


def _halved_plain(heights: Float32Array) -> tuple[Float32Array, Float32Array]:
    """`halved_heights` of cells that had all of their data: what is done in flight."""
    size = heights.shape[0] // 2, heights.shape[1] // 2
    if not math.isnan(float(heights.sum())):
        # A sum is not a number where any is not: nothing is missing, which is what most blocks are like.
        upper, lower = heights[0::2], heights[1::2]
        total = np.add(upper[:, 0::2], upper[:, 1::2], dtype=np.float64) + lower[:, 0::2] + lower[:, 1::2]
        return (total / 4).astype(np.float32), np.ones(size, dtype=np.float32)
    sums, count = np.zeros(size), np.zeros(size, dtype=np.uint8)
    for one in (heights[0::2, 0::2], heights[0::2, 1::2], heights[1::2, 0::2], heights[1::2, 1::2]):
        known = ~np.isnan(one)
        count += known
        np.add(sums, one, out=sums, where=known)
    enough = count >= 4 * _MIN_VALID_SHARE
    mean = np.full(size, np.nan, dtype=np.float32)
    np.divide(sums, count, out=mean, where=enough, casting="same_kind")
    return mean, np.where(enough, count / np.float32(4), np.float32(0)).astype(np.float32)


def filled(rgb: ImageArray, valid: BoolArray) -> ImageArray:
    """A picture (H, W, 3) whose invalid pixels continue the valid ones smoothly, so that they cost few bytes.

    Push and pull (Gortler et al., The Lumigraph, 1996): each invalid pixel gets what the next coarser level, filled
    likewise, has there. In integers only, so that all machines make the same bytes of it.
    """
    if valid.all() or not valid.any():
        return rgb if valid.any() else np.zeros_like(rgb)
    rows, columns = valid.shape
    if rows % 2 or columns % 2:
        pad = (0, rows % 2), (0, columns % 2)
        return filled(np.pad(rgb, (*pad, (0, 0))), np.pad(valid, pad))[:rows, :columns]
    smooth = cv2.resize(filled(*halved_image(rgb, valid)), (columns, rows), interpolation=cv2.INTER_LINEAR_EXACT)
    own = valid.astype(np.uint8)
    smooth = cv2.copyTo(rgb, own, smooth)
    # Without it 0.3 to 0.6 % more bytes on ragged maps. Of uint8 OpenCV's is in fixed-point numbers, too.
    smooth = cv2.GaussianBlur(smooth, (_SMOOTHING_PX, _SMOOTHING_PX), 0)
    return np.asarray(cv2.copyTo(rgb, own, smooth), dtype=np.uint8)


def _four(values: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Sums of 2 x 2 cells of (H, W), in the cells' own type."""
    total: npt.NDArray[Any] = values[0::2, 0::2] + values[0::2, 1::2] + values[1::2, 0::2] + values[1::2, 1::2]
    return total
