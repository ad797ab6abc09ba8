"""Small holes of a surface model: closed where what surrounds them leaves no doubt."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np

from ortholoc_edge.geometry.arrays import BoolArray, Float32Array

# A hole between a roof and the ground has a height on either side; only where the rim is nearly a plane does the
# height inside follow from it. 1-sigma of photogrammetric surface models is 0.1 to 0.3 m.
_MAX_RIM_RESIDUAL_M = 0.5
_RIM = np.ones((3, 3), np.uint8)


class Hole(NamedTuple):
    """A hole that was closed: its centre in pixels of the tile, and its cells."""

    column: float
    row: float
    cells: int


def fill_small_holes(
    heights: Float32Array, wanted: BoolArray, max_cells: int
) -> tuple[Float32Array, list[Hole]]:
    """Heights (H, W) with the holes of at most ``max_cells`` cells closed by the plane through their rims.

    A hole stays if it touches the border of the array (its other half is not seen) or what is not ``wanted``
    (H, W), or if its rim is not a plane to within half a metre.
    """
    hole = np.isnan(heights)
    if max_cells < 1 or not hole.any() or hole.all():
        return heights, []
    count, labels, stats, centres = cv2.connectedComponentsWithStats(hole.astype(np.uint8), connectivity=8)
    rows, columns = heights.shape
    filled = heights.copy()
    closed = []
    for label in range(1, count):
        left, top, width, height, cells = (int(v) for v in stats[label])
        if cells > max_cells or left == 0 or top == 0 or left + width == columns or top + height == rows:
            continue
        box = np.s_[top - 1 : top + height + 1, left - 1 : left + width + 1]
        inside = labels[box] == label
        rim = cv2.dilate(inside.astype(np.uint8), _RIM).astype(bool) & ~inside
        # Diagonal neighbours are of the same hole, so the rim has heights everywhere.
        if not wanted[box][inside].all():
            continue
        v, u = np.nonzero(rim)
        rim_heights = heights[box][rim].astype(np.float64)
        design = np.column_stack([np.ones(len(u)), u, v])
        plane, *_ = np.linalg.lstsq(design, rim_heights, rcond=None)
        if float(np.abs(rim_heights - design @ plane).max()) > _MAX_RIM_RESIDUAL_M:
            continue
        v, u = np.nonzero(inside)
        filled[top - 1 + v, left - 1 + u] = np.column_stack([np.ones(len(u)), u, v]) @ plane
        closed.append(Hole(float(centres[label][0]), float(centres[label][1]), cells))
    return filled, closed
