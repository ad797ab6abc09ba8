"""From 2D-2D to 2D-3D: every matched orthophoto pixel gets its height from the surface model."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ortholoc_edge.geometry.arrays import FloatArray, IntArray
from ortholoc_edge.geometry.grid import bilinear
from ortholoc_edge.tiles.window import MapWindow, SurfaceWindow


@dataclass(frozen=True, slots=True, eq=False)
class Lifted:
    """Points with a height.

    Attributes:
        points_map: (M, 3) float64 easting, northing, height, m.
        kept: (M,) indices of the pixels that have one.
    """

    points_map: FloatArray
    kept: IntArray


def lift(dop_px: npt.ArrayLike, window: MapWindow | SurfaceWindow) -> Lifted:
    """3D points of pixels (N, 2) of ``window.dop_grid``, by the paper's appendix "Lifting 2D Coordinates in DOP to 3D".

    DOP and DSM may have grids of their own: the linear map between them goes through map coordinates. A pixel
    off the DSM or next to nodata is dropped, not filled: an invented height biases the pose and the residual
    need not show it.
    """
    xy_map = window.dop_grid.map_from_px(dop_px)
    heights = bilinear(window.dsm, window.dsm_grid.px_from_map(xy_map))
    kept = np.flatnonzero(np.isfinite(heights))
    return Lifted(np.column_stack([xy_map[kept], heights[kept]]), kept)
