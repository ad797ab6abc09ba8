"""Undeclared fill around a raster: regions of marked cells that touch its border.

Mosaics and warped rasters are filled with zeros outside the survey. Where the file does not declare that, only
the shape tells: one value, exactly, from the border inward.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import cv2
import numpy as np
from rasterio.windows import Window

from ortholoc_edge.geometry.arrays import BoolArray, IntArray

# Pixels per side of one step, whole blocks of the sources and of the pack.
CHUNK_PX = 2048

Marked = Callable[[Window], BoolArray]


def windows(width: int, height: int) -> Iterator[Window]:
    """A raster in steps of ``CHUNK_PX``, by rows."""
    for row in range(0, height, CHUNK_PX):
        for column in range(0, width, CHUNK_PX):
            yield Window(column, row, min(CHUNK_PX, width - column), min(CHUNK_PX, height - row))


class Collar:
    """The 4-connected regions of marked cells that touch the border of a raster.

    Reads the raster once in steps and keeps only the steps' seams; no marked cell on the border, no reading.

    Attributes:
        cells: how many there are.
    """

    def __init__(self, width: int, height: int, marked: Marked) -> None:
        """``marked`` gives the marked cells (h, w) of a window; it is asked again by :meth:`mask`."""
        self._marked = marked
        self._outside: dict[tuple[int, int], BoolArray] = {}
        self.cells = 0
        edges = (
            Window(0, 0, width, 1),
            Window(0, height - 1, width, 1),
            Window(0, 0, 1, height),
            Window(width - 1, 0, 1, height),
        )
        if any(marked(edge).any() for edge in edges):
            self._find(width, height)

    def mask(self, window: Window) -> BoolArray:
        """Cells of the regions in one of :func:`windows`."""
        outside = self._outside.get((window.row_off, window.col_off))
        if outside is None or not outside.any():
            return np.zeros((window.height, window.width), dtype=bool)
        found: BoolArray = outside[_labels(self._marked(window))[1]]
        return found

    def _find(self, width: int, height: int) -> None:
        # Regions of all steps, numbered on; region 0 stands for what lies beyond the border.
        parents, sizes = [0], [0]

        def root(region: int) -> int:
            while parents[region] != region:
                parents[region] = parents[parents[region]]
                region = parents[region]
            return region

        def join(pairs: IntArray) -> None:
            for one, other in np.unique(pairs, axis=0).tolist():
                if one >= 0 and other >= 0:
                    low, high = sorted((root(one), root(other)))
                    parents[high] = low

        first: dict[tuple[int, int], tuple[int, int]] = {}
        below: dict[int, IntArray] = {}
        right: IntArray = np.empty(0, np.intp)
        for window in windows(width, height):
            row, column = window.row_off, window.col_off
            count, labels = _labels(self._marked(window))
            start = len(parents)
            parents.extend(range(start, start + count - 1))
            sizes.extend(np.bincount(labels.reshape(-1), minlength=count)[1:].tolist())
            first[row, column] = start, count

            def regions(seam: IntArray, start: int = start) -> IntArray:
                """Label 0 is no region: -1."""
                return np.where(seam > 0, seam.astype(np.intp) + start - 1, -1)

            top, left = regions(labels[0]), regions(labels[:, 0])
            join(np.stack([top, np.zeros_like(top) if row == 0 else below[column]], axis=1))
            join(np.stack([left, np.zeros_like(left) if column == 0 else right], axis=1))
            below[column], right = regions(labels[-1]), regions(labels[:, -1])
            if row + window.height == height:
                join(np.stack([below[column], np.zeros_like(below[column])], axis=1))
            if column + window.width == width:
                join(np.stack([right, np.zeros_like(right)], axis=1))
        outside = np.array([root(region) == 0 for region in range(len(parents))])
        self.cells = int(np.array(sizes)[outside].sum())
        for place, (start, count) in first.items():
            self._outside[place] = np.concatenate([[False], outside[start : start + count - 1]])


def _labels(marked: BoolArray) -> tuple[int, IntArray]:
    count, labels = cv2.connectedComponents(marked.astype(np.uint8), connectivity=4)
    return count, np.asarray(labels)
