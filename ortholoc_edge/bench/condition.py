"""What is made worse of a sample, to see what a matcher bears.

Paper, appendix "Resolution Analysis" and "Covisibility Analysis".
"""

from __future__ import annotations

import zlib
from dataclasses import replace

import cv2
import numpy as np
from msgspec import Struct

from ortholoc_edge.bench.samples import Sample, needed
from ortholoc_edge.geometry.arrays import Float32Array, ImageArray

# The paper's threshold of matches that have a confidence.
MIN_CONFIDENCE = 0.5
# What the photo shows is looked at on its grid of every so many pixels.
_GRID_STEP = 8
_LEAST_SIDE_PX = 16


class Condition(Struct, frozen=True):
    """
    Attributes:
        raster_scale: of DOP and DSM, 0 to 1.
        query_scale: of the photo as the matcher gets it, 0 to 1.
        covisibility: part of what the photo shows that is left on the map, 0 to 1.
        min_confidence: matches at or below are not used, where the matcher has a confidence.
    """

    raster_scale: float = 1.0
    query_scale: float = 1.0
    covisibility: float = 1.0
    min_confidence: float = MIN_CONFIDENCE


USUAL = Condition()


def with_map(sample: Sample, condition: Condition, seed: int) -> Sample:
    """The sample with its map cut and coarsened; the photo, and what it shows, as they were.

    Args:
        seed: with the sample's name, of the side that is cut off.
    Raises: DatasetError for a sample without a point map where something is to be cut off.
    """
    if condition.covisibility < 1.0:
        random = np.random.default_rng([seed, zlib.crc32(sample.name.encode())])
        sample = _cut(sample, condition.covisibility, random)
    if condition.raster_scale < 1.0:
        sample = _coarsened(sample, condition.raster_scale)
    return sample


def query_image(sample: Sample, condition: Condition) -> ImageArray:
    """The photo in grey, (H, W) uint8, as the matcher gets it."""
    grey = np.asarray(cv2.cvtColor(np.ascontiguousarray(sample.image), cv2.COLOR_RGB2GRAY), dtype=np.uint8)
    return _smaller(grey, condition.query_scale)


def _cut(sample: Sample, part: float, random: np.random.Generator) -> Sample:
    """One side of the map gone, along a row or a column of pixels."""
    points = needed(sample.point_map, sample, "point_map")[::_GRID_STEP, ::_GRID_STEP, :2].reshape(-1, 2)
    px = sample.grid.px_from_map(points[np.isfinite(points).all(axis=1)])
    width, height = sample.grid.width, sample.grid.height
    on_map = px[((px > -0.5) & (px < (width - 0.5, height - 0.5))).all(axis=1)]
    axis, far = int(random.integers(2)), bool(random.integers(2))
    if not len(on_map):
        return sample
    # Of what is seen at all: a sample's own map may lack some.
    edge = float(np.quantile(on_map[:, axis], 1.0 - part if far else part)) + 0.5
    column, row, right, low = 0, 0, width, height
    at = round(min(max(edge, _LEAST_SIDE_PX), (width, height)[axis] - _LEAST_SIDE_PX))
    if axis == 0:
        column, right = (at, width) if far else (0, at)
    else:
        row, low = (at, height) if far else (0, at)
    return replace(
        sample,
        dop=np.ascontiguousarray(sample.dop[row:low, column:right]),
        dsm=np.ascontiguousarray(sample.dsm[row:low, column:right]),
        grid=sample.grid.crop(column, row, right - column, low - row),
    )


def _coarsened(sample: Sample, scale: float) -> Sample:
    dop = _smaller(sample.dop, scale)
    return replace(
        sample,
        dop=dop,
        dsm=_mean_heights(sample.dsm, dop.shape[1], dop.shape[0]),
        grid=sample.grid.resized(dop.shape[1], dop.shape[0]),
    )


def _mean_heights(dsm: Float32Array, width: int, height: int) -> Float32Array:
    """Of the cells that have one, NaN where none has."""
    known = np.isfinite(dsm)
    size = (width, height)
    weight = cv2.resize(known.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    total = cv2.resize(np.where(known, dsm, 0.0).astype(np.float64), size, interpolation=cv2.INTER_AREA)
    # Below this, rounding made it.
    mean = np.divide(total, weight, out=np.full(total.shape, np.nan), where=weight > 1e-4)
    return np.asarray(mean, dtype=np.float32)


def _smaller(image: ImageArray, scale: float) -> ImageArray:
    if scale >= 1.0:
        return image
    height, width = image.shape[:2]
    size = max(_LEAST_SIDE_PX, round(width * scale)), max(_LEAST_SIDE_PX, round(height * scale))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
