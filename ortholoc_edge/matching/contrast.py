"""Local contrast made even, so that a place looks the same to a network whatever else is in the picture."""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np

from ortholoc_edge.geometry.arrays import BoolArray, Float32Array, ImageArray

# Standard deviation of the neighbourhood, px. Of 16, 20, 32, 40, 80 px and none the middle ones are best: small ones
# blur where things are (copr), large ones leave a field's contrast to its neighbours (seneca).
_SIGMA_PX: Final = 32.0
_SHRINK: Final = 4
# Grey levels added to the deviation in quadrature, so that a flat area does not become noise.
_FLOOR: Final = 2.0
_MIDDLE, _GAIN = 128.0, 48.0
_MIN_WEIGHT: Final = 1e-3


def even_contrast(image: ImageArray, valid: BoolArray) -> ImageArray:
    """``image`` (H, W) uint8 with local mean 128 and local deviation 48, both over the valid pixels around.

    XFeat normalises a picture as a whole, and what it finds in a pale field depends on whether a dark wood is in the
    picture, too: of 1059 right matches between a photo and the map under the same outline 84 were left when the map
    reached farther (seneca, IMG_0489). Evened out, 870 are right however far it reaches.
    """
    rows, columns = image.shape
    size = max(columns // _SHRINK, 1), max(rows // _SHRINK, 1)

    def around(values: Float32Array) -> Float32Array:
        small = cv2.resize(values, size, interpolation=cv2.INTER_AREA)
        blurred = cv2.GaussianBlur(small, (0, 0), _SIGMA_PX / _SHRINK, borderType=cv2.BORDER_CONSTANT)
        return np.asarray(blurred, dtype=np.float32).reshape(size[1], size[0])

    def full(small: Float32Array) -> Float32Array:
        return np.asarray(cv2.resize(small, (columns, rows), interpolation=cv2.INTER_LINEAR), dtype=np.float32)

    grey: Float32Array = image.astype(np.float32)
    known: Float32Array = valid.astype(np.float32)
    weight: Float32Array = np.maximum(around(known), _MIN_WEIGHT)
    masked: Float32Array = grey * known
    mean: Float32Array = around(masked) / weight
    variance = np.maximum(around(masked * grey) / weight - mean * mean, 0.0)
    gain: Float32Array = (_GAIN / np.sqrt(variance + _FLOOR**2)).astype(np.float32)
    even = full(gain) * (grey - full(mean)) + _MIDDLE
    return np.asarray(np.clip(np.rint(even), 0.0, 255.0), dtype=np.uint8)
