"""From 2D-2D to 2D-3D: every matched orthophoto pixel gets its height from the surface model."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ortholoc_edge.geometry.arrays import Float32Array, FloatArray, IntArray
from ortholoc_edge.tiles.window import MapWindow


@dataclass(frozen=True, slots=True, eq=False)
class Lifted:
    """Points with a height.

    Attributes:
        points_map: (M, 3) float64 easting, northing, height, m.
        kept: (M,) indices of the pixels that have one.
    """

    points_map: FloatArray
    kept: IntArray


def bilinear(raster: Float32Array, px: npt.ArrayLike) -> FloatArray:
    """Values (N,) of a raster (h, w) at pixels (N, 2), centres at integers.

    NaN off the raster, and wherever a cell that takes part is NaN: beside a hole a height would be half
    invented. The outermost half pixel is off: it has a neighbour on one side only.
    """
    height, width = raster.shape
    u, v = np.asarray(px, dtype=np.float64).T
    with np.errstate(invalid="ignore"):
        inside = (u >= 0) & (u <= width - 1) & (v >= 0) & (v <= height - 1)
    u, v = np.where(inside, u, 0.0), np.where(inside, v, 0.0)
    column = np.minimum(u.astype(np.intp), max(width - 2, 0))
    row = np.minimum(v.astype(np.intp), max(height - 2, 0))
    right, below = np.minimum(column + 1, width - 1), np.minimum(row + 1, height - 1)
    a, b = u - column, v - row
    values = np.zeros(len(u))
    for weight, rows, columns in (
        ((1 - a) * (1 - b), row, column),
        (a * (1 - b), row, right),
        ((1 - a) * b, below, column),
        (a * b, below, right),
    ):
        # A cell of no weight takes no part, so that a NaN there does no harm.
        values += np.where(weight > 0, weight * raster[rows, columns], 0.0)
    return np.where(inside, values, np.nan)


def lift(dop_px: npt.ArrayLike, window: MapWindow) -> Lifted:
    """3D points of orthophoto pixels (N, 2), by the paper's appendix "Lifting 2D Coordinates in DOP to 3D".

    DOP and DSM may have grids of their own: the linear map between them goes through map coordinates. A pixel
    off the DSM or next to nodata is dropped, not filled: an invented height biases the pose and the residual
    need not show it.
    """
    xy_map = window.dop_grid.map_from_px(dop_px)
    heights = bilinear(window.dsm, window.dsm_grid.px_from_map(xy_map))
    kept = np.flatnonzero(np.isfinite(heights))
    return Lifted(np.column_stack([xy_map[kept], heights[kept]]), kept)
