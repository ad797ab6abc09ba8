"""Matches that follow from a sample's true pose and its surface, with the paper's geometry-aware confidence.

Paper, appendix "Utilizing Multi-Modal Data for Ground-Truth Geometry-Aware Correspondences". A matcher of pictures is a
`matching.types.Matcher`; this one needs the truth, which no picture has, so it takes the sample.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from ortholoc_edge.bench.samples import Sample, needed
from ortholoc_edge.geometry.arrays import FloatArray
from ortholoc_edge.geometry.grid import bilinear
from ortholoc_edge.matching.types import Matches


class SampleMatcher(Protocol):
    """What matches a sample's photo with its orthophoto.

    Attributes:
        name: for tables.
    """

    @property
    def name(self) -> str: ...

    def match(self, sample: Sample) -> Matches:
        """``query_px`` in the sample's photo, ``map_px`` on its grid."""
        ...


@dataclass(frozen=True, slots=True)
class GroundTruthMatcher:
    """The truth as matches.

    Attributes:
        stride_px: every so many pixels of the photo, in both directions.
        decay_per_m: the paper's gamma: how fast confidence falls with the distance between what a pixel shows and what
            the surface model has there.
    """

    stride_px: int = 4
    decay_per_m: float = 1.0

    @property
    def name(self) -> str:
        return "ground-truth"

    def match(self, sample: Sample) -> Matches:
        """Of every pixel whose point is known and lies on the map. Raises: DatasetError for a sample without a point
        map."""
        points = needed(sample.point_map, sample, "point_map")[:: self.stride_px, :: self.stride_px].reshape(-1, 3)
        u, v = np.meshgrid(
            np.arange(0, sample.camera.width, self.stride_px), np.arange(0, sample.camera.height, self.stride_px)
        )
        query_px = np.stack([u, v], axis=-1).reshape(-1, 2).astype(np.float64)
        confidence = geometric_confidence(points.astype(np.float64), sample, self.decay_per_m)
        map_px = sample.grid.px_from_map(points[:, :2])
        return Matches(query_px, map_px, confidence).take(np.flatnonzero(np.isfinite(confidence)))


def geometric_confidence(points_map: FloatArray, sample: Sample, decay_per_m: float = 1.0) -> FloatArray:
    """``exp(-gamma d)`` (N,) of points (N, 3), d from each to its image under the map: itself, dropped on the surface
    model. Below a roof's edge or on a wall one place of the map has many points, and all but one are far from their
    image.

    Returns: NaN where a point or the surface is unknown.
    """
    heights = bilinear(sample.dsm, sample.grid.px_from_map(points_map[:, :2]))
    return np.asarray(np.exp(-decay_per_m * np.abs(points_map[:, 2] - heights)), dtype=np.float64)


def true_map_px(sample: Sample, query_px: FloatArray) -> FloatArray:
    """Where on the orthophoto pixels (N, 2) of the photo belong: (N, 2), NaN where the truth is unknown.

    Raises: DatasetError for a sample without a point map.
    """
    points = needed(sample.point_map, sample, "point_map")
    xy = np.column_stack([bilinear(points[..., axis], query_px) for axis in (0, 1)])
    return sample.grid.px_from_map(xy)
