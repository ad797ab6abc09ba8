"""Dense features that do not change with light, season or spectrum: the direction of edges, without its sign.

Per pixel the gradient as a complex number, squared and divided by its length: edges that differ only in which side is
brighter are alike. Smoothed, and normalised by how strong edges are around, so that a shadow and a sunlit wall count
the same; and without what is alike all around, so that rows of a field or one long edge do not match everywhere. This
is the trace-free part of the structure tensor (Bigun and Granlund 1987), in the family of dense orientated-gradient
descriptors (HOPC, CFOG) for pictures of unlike sensors, in 2 channels where those have 8.
"""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np

from ortholoc_edge.geometry.arrays import BoolArray, Float32Array, ImageArray

# Sigma of the Gaussian over the field, and side of the box (used twice) that the strength of edges is averaged over.
_SMOOTHING_PX: Final = 1.0
_WINDOW_PX: Final = 7
# Side of the box whose mean is taken off, as a part of the long side; without it a bare field with rows, or two
# parallel roads, match best where the pictures overlap most (docs/studies/structural.md).
_MEAN_PART: Final = 1.0 / 3.0
_MEAN_SHRINK: Final = 4
# Of the mean gradient: grey levels per pixel (times Sobel's gain of 8) that count as noise.
_NOISE: Final = 4.0
# Pixels beside invalid ones whose gradient shows the mask's rim.
_RIM: Final = np.ones((5, 5), np.uint8)


def orientation_field(
    image: ImageArray, valid: BoolArray | None = None, mean_px: float | None = None
) -> Float32Array:
    """Field of edge directions.

    Args:
        image: (H, W) uint8 grey.
        valid: (H, W); None: everywhere. The field is 0 at and beside where it is False.
        mean_px: side of the box whose mean is taken off; None: a third of the long side, as for two pictures of one
            view. Pictures of different sizes are alike only with the same.
    Returns: (2, H, W) float32: real and imaginary part, of about unit length at edges.
    """
    x = cv2.Sobel(image, cv2.CV_32F, 1, 0, ksize=3)
    y = cv2.Sobel(image, cv2.CV_32F, 0, 1, ksize=3)
    field = np.empty((2, *image.shape), np.float32)
    np.multiply(x, y, out=field[1])
    field[1] += field[1]
    np.square(x, out=x)
    np.square(y, out=y)
    np.subtract(x, y, out=field[0])
    # Not cv2.magnitude: it rounds by how its buffers lie in memory, and a replay must give the same bits.
    strength = np.sqrt(np.add(x, y, out=x), out=x)
    field /= np.maximum(strength, np.float32(1e-3), out=y)
    inner: Float32Array | None = None
    if valid is not None and not valid.all():
        inner = np.asarray(
            cv2.erode(valid.astype(np.uint8), _RIM, borderType=cv2.BORDER_REPLICATE), dtype=np.float32
        )
        strength *= inner
        field *= inner
    around = _around(strength)
    for k in range(2):
        cv2.divide(cv2.GaussianBlur(field[k], (7, 7), _SMOOTHING_PX), around, dst=field[k])
    _subtract_local_mean(field, inner, max(image.shape) * _MEAN_PART if mean_px is None else mean_px)
    return field


def _around(strength: Float32Array) -> Float32Array:
    """How strong edges are around each pixel, noise included."""
    rows, columns = strength.shape
    # A smooth thing: half of the pixels tell it.
    small = cv2.resize(strength, (-(-columns // 2), -(-rows // 2)), interpolation=cv2.INTER_AREA)
    window = (_WINDOW_PX // 2, _WINDOW_PX // 2)
    small = cv2.blur(cv2.blur(small, window), window)
    around = np.asarray(cv2.resize(small, (columns, rows), interpolation=cv2.INTER_LINEAR), dtype=np.float32)
    around += _NOISE
    return around


def _subtract_local_mean(field: Float32Array, inner: Float32Array | None, mean_px: float) -> None:
    """In place, and 0 where ``inner`` is."""
    rows, columns = field.shape[1:]
    # The mean is smooth: a fraction of the pixels tells it.
    size = max(columns // _MEAN_SHRINK, 1), max(rows // _MEAN_SHRINK, 1)
    side = max(round(max(size) / max(rows, columns) * mean_px), 1)
    weight = 1.0 if inner is None else np.maximum(_box(inner, size, side), np.float32(1e-3))
    for k in range(2):
        mean = _box(field[k] if inner is None else field[k] * inner, size, side) / weight
        field[k] -= cv2.resize(mean, (columns, rows), interpolation=cv2.INTER_LINEAR)
        if inner is not None:
            field[k] *= inner


def _box(values: Float32Array, size: tuple[int, int], side: int) -> Float32Array:
    small = cv2.resize(values, size, interpolation=cv2.INTER_AREA)
    return np.asarray(cv2.blur(small, (side, side), borderType=cv2.BORDER_REFLECT), dtype=np.float32)
