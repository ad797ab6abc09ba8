"""The pixels of a pack's layer, cut into tiles: one endless grid per layer, whose tiles and overviews nest."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Annotated, NamedTuple

import msgspec

from ortholoc_edge.geometry.grid import RasterGrid

Bounds = tuple[float, float, float, float]

# Tiles at the rim of a pack are cropped to whole steps of this, so that the pixels of every overview are exactly
# 2^k of the full ones, in every tile.
CROP_PX = 64
# Full resolution and pixels of 2, 4, 8, 16 times its side.
LEVELS = 5
_MIN_TILE_PX, _MAX_TILE_PX = 512, 4096
_TILE_SIDE_M = 800.0
# Of a pixel: what rounding may do to coordinates of millions of metres.
_SLACK_PX = 1e-3


class PixelBox(NamedTuple):
    """A block of full-resolution pixels of a lattice."""

    column: int
    row: int
    width: int
    height: int


class Lattice(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Where the pixels of a layer are, wherever it has tiles.

    Tile borders lie at whole multiples of the tile's side from a corner that depends on the pixel size and its
    phase alone, so that packs of neighbouring areas are cut alike.

    Attributes:
        west, top: map coordinates, m, of the outer corner of pixel (0, 0), the corner of a tile.
        pixel_m: side of a pixel; columns run east, rows run south.
        tile_px: pixels per side of a tile.
        levels: that can be read; level k has pixels of ``pixel_m * 2**k``.
    """

    west: float
    top: float
    pixel_m: Annotated[float, msgspec.Meta(gt=0)]
    tile_px: Annotated[int, msgspec.Meta(ge=CROP_PX, le=2**16, multiple_of=CROP_PX)]
    levels: Annotated[int, msgspec.Meta(ge=1, le=7)]

    @staticmethod
    def over(bounds: Bounds, pixel_m: float, phase: tuple[float, float] = (0.0, 0.0)) -> Lattice:
        """The lattice of pixels of ``pixel_m`` with a pixel corner at ``phase`` (x, y), its first tile at the
        north-west of ``bounds``."""
        tile_px = _MIN_TILE_PX
        while tile_px < _MAX_TILE_PX and tile_px * pixel_m < _TILE_SIDE_M:
            tile_px *= 2
        side = tile_px * pixel_m
        x, y = (value % pixel_m for value in phase)
        # A phase of a whole pixel less rounding is none.
        x, y = (0.0 if pixel_m - value < _SLACK_PX * pixel_m else value for value in (x, y))
        slack = _SLACK_PX * pixel_m
        west = math.floor((bounds[0] + slack - x) / side) * side + x
        top = math.ceil((bounds[3] - slack - y) / side) * side + y
        return Lattice(west=west, top=top, pixel_m=pixel_m, tile_px=tile_px, levels=LEVELS)

    def grid(self, box: PixelBox, level: int = 0) -> RasterGrid:
        """Grid of a box whose sides are multiples of ``2**level``, on that level."""
        step = 2**level
        return RasterGrid(
            box.width // step,
            box.height // step,
            self.west + self.pixel_m * box.column,
            self.top - self.pixel_m * box.row,
            self.pixel_m * step,
            -self.pixel_m * step,
        )

    def box(self, bounds: Bounds) -> PixelBox:
        """The smallest box of whole ``CROP_PX`` steps that holds ``bounds``."""
        west, south, east, north = bounds
        step = self.pixel_m * CROP_PX
        slack = _SLACK_PX / CROP_PX
        column, row = math.floor((west - self.west) / step + slack), math.floor((self.top - north) / step + slack)
        right, bottom = math.ceil((east - self.west) / step - slack), math.ceil((self.top - south) / step - slack)
        return PixelBox(column * CROP_PX, row * CROP_PX, (right - column) * CROP_PX, (bottom - row) * CROP_PX)

    def tiles(self, box: PixelBox) -> Iterator[PixelBox]:
        """The box cut at the tiles' borders, by rows from the north-west."""
        side = self.tile_px
        for row in range(box.row // side, -(-(box.row + box.height) // side)):
            for column in range(box.column // side, -(-(box.column + box.width) // side)):
                left, upper = max(column * side, box.column), max(row * side, box.row)
                right = min((column + 1) * side, box.column + box.width)
                lower = min((row + 1) * side, box.row + box.height)
                yield PixelBox(left, upper, right - left, lower - upper)

    def tile_key(self, column: int, row: int) -> tuple[int, int]:
        """Which tile a full-resolution pixel lies in, counted in tiles."""
        return column // self.tile_px, row // self.tile_px

    def tile_name(self, box: PixelBox) -> str:
        """``E_N``: whole metres of the south-west corner of the tile that a box lies in."""
        column, row = self.tile_key(box.column, box.row)
        side = self.tile_px * self.pixel_m
        east, north = self.west + column * side, self.top - (row + 1) * side
        return f"{math.floor(east + _SLACK_PX)}_{math.floor(north + _SLACK_PX)}"


def meeting(a: Bounds, b: Bounds) -> Bounds | None:
    """What two boxes share; None if they do not overlap, or only touch."""
    box = max(a[0], b[0]), max(a[1], b[1]), min(a[2], b[2]), min(a[3], b[3])
    return box if box[0] < box[2] and box[1] < box[3] else None
