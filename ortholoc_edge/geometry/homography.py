"""Plane-to-plane maps as (3, 3) float64 matrices, defined up to scale."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from ortholoc_edge.geometry.arrays import FloatArray


def warp_points(homography: npt.ArrayLike, px: npt.ArrayLike) -> FloatArray:
    """Points (N, 2) through a homography; NaN where they go to or beyond infinity."""
    points = np.asarray(px, dtype=np.float64)
    mapped = np.concatenate([points, np.ones((len(points), 1))], axis=1) @ np.asarray(homography).T
    w = mapped[:, 2:]
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(w > 0, mapped[:, :2] / w, np.nan)


def positive_at(homography: FloatArray, px: npt.ArrayLike) -> FloatArray:
    """The homography with its sign chosen so that the third coordinate is positive at ``px`` (2,)."""
    w = float(homography[2] @ np.append(np.asarray(px, dtype=np.float64), 1.0))
    return -homography if w < 0 else homography
