"""The map's edge directions at a coarse scale, all in memory: what a frame without a position is looked for in."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
import numpy.typing as npt

from ortholoc_edge.errors import MapError
from ortholoc_edge.geometry.arrays import Float32Array, FloatArray
from ortholoc_edge.geometry.grid import RasterGrid, bilinear
from ortholoc_edge.matching.orientation import orientation_field
from ortholoc_edge.tiles.lattice import Bounds
from ortholoc_edge.tiles.store import MapStore

# Side of the box whose mean is taken off the field, of the map and of every frame that is looked for in it.
MEAN_PX: Final = 32
# Fields are seldom longer than 2; what is, is cut off.
_PER_UNIT: Final = 60.0
_MOST: Final = 127
# Pixels that are made at a time, and so many around them that have a say in their fields.
_PIECE_PX: Final = 1024
_MARGIN_PX: Final = 48


@dataclass(frozen=True, slots=True, eq=False)
class CoarseField:
    """Edge directions of a part of a pack's orthophoto.

    Attributes:
        grid: of the field, that of a level of the orthophoto.
        quantised: (2, H, W) int8, `orientation_field` times a constant; 0 where the map has no data.
        ground: (h, w) float32 heights on ``ground_grid``, the surface model's coarsest level, m; NaN: none.
    """

    grid: RasterGrid
    quantised: npt.NDArray[np.int8]
    ground: Float32Array
    ground_grid: RasterGrid

    @staticmethod
    def of(store: MapStore, level: int, within: Bounds | None = None) -> CoarseField:
        """Computed from a level of the pack's orthophoto.

        Args:
            within: (west, south, east, north), m, of what is wanted; None: all.
        Raises: MapError where there is nothing within, or no surface model.
        """
        grid = _part(store.dop_grids[level], within)
        surface = None if grid is None else store.read_surface(grid, math.inf)
        if grid is None or surface is None:
            raise MapError(f"{store.pack.path}: no map within {within or store.bounds}; widen what is searched")
        quantised = np.zeros((2, grid.height, grid.width), np.int8)
        for column, row, width, height in _pieces(grid):
            left, upper = min(column, _MARGIN_PX), min(row, _MARGIN_PX)
            right = min(column + width + _MARGIN_PX, grid.width)
            lower = min(row + height + _MARGIN_PX, grid.height)
            piece = grid.crop(column - left, row - upper, right - column + left, lower - row + upper)
            window = store.read(piece.bounds, grid.gsd_m, math.inf)
            if window is None or not window.dop_valid.any():
                continue
            field = orientation_field(window.dop_grey, window.dop_valid, MEAN_PX)
            inner = field[:, upper : upper + height, left : left + width]
            quantised[:, row : row + height, column : column + width] = np.clip(
                np.rint(inner * _PER_UNIT), -_MOST, _MOST
            )
        return CoarseField(grid, quantised, surface.dsm, surface.dsm_grid)

    def halved(self) -> CoarseField:
        """The mean of every 2 x 2 pixels; what is left of them at the right and lower rim is left out."""
        width, height = self.grid.width // 2, self.grid.height // 2
        quantised = np.empty((2, height, width), np.int8)
        for whole, half in zip(self.quantised, quantised, strict=True):
            # OpenCV does not average signed bytes.
            moved = np.asarray(whole[: 2 * height, : 2 * width], dtype=np.int16)
            half[:] = np.rint(cv2.resize(moved, (width, height), interpolation=cv2.INTER_AREA))
        return CoarseField(
            self.grid.crop(0, 0, 2 * width, 2 * height).resized(width, height),
            quantised,
            self.ground,
            self.ground_grid,
        )

    @property
    def bytes(self) -> int:
        """That it holds in memory."""
        return self.quantised.nbytes + self.ground.nbytes

    @property
    def known_km2(self) -> float:
        """Area with edges, as far as every fourth pixel tells."""
        every = self.quantised[:, ::4, ::4]
        return float(every.any(axis=0).mean()) * self.grid.width * self.grid.height * self.grid.gsd_m**2 * 1e-6

    def block(self, column: int, row: int, side: int) -> Float32Array:
        """(2, side, side) of the field from a pixel on, which may lie outside; 0 where there is no map."""
        block = np.zeros((2, side, side), np.float32)
        low_x, low_y = max(column, 0), max(row, 0)
        high_x, high_y = min(column + side, self.grid.width), min(row + side, self.grid.height)
        if high_x > low_x and high_y > low_y:
            inside = block[:, low_y - row : high_y - row, low_x - column : high_x - column]
            np.multiply(self.quantised[:, low_y:high_y, low_x:high_x], np.float32(1.0 / _PER_UNIT), out=inside)
        return block

    def ground_m(self, xy_map: FloatArray) -> FloatArray:
        """Heights (N,) of the surface at map positions (N, 2); NaN where it has none."""
        return bilinear(self.ground, self.ground_grid.px_from_map(xy_map))


def _part(grid: RasterGrid, within: Bounds | None) -> RasterGrid | None:
    if within is None:
        return grid
    west, south, east, north = within
    (left, upper), (right, lower) = np.round(grid.px_from_map([(west, north), (east, south)]) + 0.5).astype(int)
    left, upper = max(left, 0), max(upper, 0)
    right, lower = min(right, grid.width), min(lower, grid.height)
    return grid.crop(left, upper, right - left, lower - upper) if right > left and lower > upper else None


def _pieces(grid: RasterGrid) -> Iterator[tuple[int, int, int, int]]:
    """Column, row, width and height of parts that cover a grid."""
    for row in range(0, grid.height, _PIECE_PX):
        for column in range(0, grid.width, _PIECE_PX):
            yield column, row, min(_PIECE_PX, grid.width - column), min(_PIECE_PX, grid.height - row)
