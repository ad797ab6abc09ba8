"""How far the surface model can be believed where a frame was found on it."""

from __future__ import annotations

import cv2
import numpy as np

from ortholoc_edge.geometry.arrays import Float32Array, FloatArray
from ortholoc_edge.geometry.grid import RasterGrid

# Crowns, hedges and walls are rough over this length; slopes and roofs are not.
_ROUGH_OVER_M = 4.0
_CELL_M = 1.0
# Fitted on 9420 fixes over an old generated map with woods (docs/studies/covariance.md).
_OF_ROUGHNESS = 1.25


def unsettled_m(dsm: Float32Array, grid: RasterGrid, points_map: FloatArray, agreeing: float) -> float:
    """1-sigma of a position's common error by what stands on the ground and is not as the map has it, m.

    Crowns grow, lose their leaves and sway; that shifts all patches of a wood alike, so that no residual shows it. Two
    things do: the surface is rough there, and a smaller part of the view agrees.

    Args:
        dsm: (h, w) heights on ``grid``, m; NaN where there are none.
        points_map: (N, 3) where the pose's matches lie.
        agreeing: part of the patches in view that agree with the pose, 0 to 1.
    """
    return _OF_ROUGHNESS * (1.0 - agreeing) * roughness_m(dsm, grid, points_map)


def unsettled_covariance(sigma_m: float, points_map: FloatArray, camera_map: FloatArray) -> FloatArray:
    """(6, 6) of position (m) and rotation vector (rad), map axes: what such an error does to a pose.

    The ground is lifted as a whole, and the camera with it; and it is tilted, by as much from one side of the view to
    the other, and the camera swings with it about the middle of what it sees. The second is what a view from above
    tells worst: position and tilt err together, and together keep the picture.

    Args:
        points_map: (N, 3) where the pose's matches lie. camera_map: (3,) the camera, above them.
    """
    arm = camera_map - points_map.mean(axis=0)
    swing = np.zeros((6, 3))
    swing[2, 0] = 1.0
    for column, axis in enumerate(np.eye(3)[:2], start=1):
        swing[:3, column] = np.cross(axis, arm)
        swing[3:, column] = axis
    tilt_rad = sigma_m / float(np.linalg.norm(arm))
    return np.asarray(swing @ np.diag(np.square([sigma_m, tilt_rad, tilt_rad])) @ swing.T, dtype=np.float64)


def roughness_m(dsm: Float32Array, grid: RasterGrid, points_map: FloatArray) -> float:
    """Mean distance of the surface at points (N, 2 or more) from its own mean around them, m."""
    at = np.round(grid.px_from_map(points_map[:, :2])).astype(np.intp)
    at = np.clip(at, 0, (grid.width - 1, grid.height - 1))
    margin = int(np.ceil(3.0 * _ROUGH_OVER_M / grid.dx))
    left, top = np.maximum(at.min(axis=0) - margin, 0)
    right, bottom = at.max(axis=0) + margin + 1
    heights = dsm[top:bottom, left:right]
    known = np.isfinite(heights)
    if not known.all():
        heights = np.where(known, heights, np.float32(np.median(heights[known])) if known.any() else np.float32(0.0))
    # Finer cells make it no better, and take long to blur.
    thinned = max(1, min(round(_CELL_M / grid.dx), *heights.shape))
    rows, columns = (side // thinned for side in heights.shape)
    coarse = cv2.resize(heights[: rows * thinned, : columns * thinned], (columns, rows), interpolation=cv2.INTER_AREA)
    around = cv2.GaussianBlur(coarse, (0, 0), _ROUGH_OVER_M / (thinned * grid.dx), borderType=cv2.BORDER_REFLECT)
    x, y = (np.minimum((at - (left, top)) // thinned, (columns - 1, rows - 1))).T
    return float(np.abs(coarse - around)[y, x].mean())
