"""The pack's orthophoto as square pictures, drawn when somebody looks, at scales each twice the last."""

from __future__ import annotations

import math
from collections import OrderedDict

import cv2
import numpy as np

from ortholoc_edge.geometry.arrays import ImageArray
from ortholoc_edge.tiles.lattice import Bounds
from ortholoc_edge.tiles.store import MapStore

TILE_PX = 512
_QUALITY = 72
_CACHE_BYTES = 4 << 20
# Beyond the pack's coarsest level by so many: a tile of these reads at most 2 Mpx.
_LEVELS_BEYOND = 1
# Where the orthophoto has nothing.
_PAPER = 226


class Orthophoto:
    """Draws tiles. Used by one thread; see `MapStore.read_colour` for why it holds up nobody.

    Attributes:
        gsd_m: of level 0, the finest; each level's is twice that of the one before.
        levels: how many there are.
    """

    def __init__(self, store: MapStore) -> None:
        self._store = store
        self._bounds = store.bounds
        self.gsd_m = store.dop_grids[0].gsd_m
        self.levels = len(store.dop_grids) + _LEVELS_BEYOND
        self._drawn: OrderedDict[tuple[int, int, int], bytes] = OrderedDict()
        self._bytes = 0

    def tile(self, level: int, column: int, row: int) -> bytes | None:
        """A JPEG of 512 x 512 px, counted from the bounds' north-west corner; None where there is no such tile.

        Raises: MapError after the store was closed.
        """
        key = level, column, row
        if key in self._drawn:
            self._drawn.move_to_end(key)
            return self._drawn[key]
        bounds = self._tile_bounds(level, column, row)
        if bounds is None:
            return None
        encoded = jpeg(self.draw(bounds, TILE_PX, TILE_PX), _QUALITY)
        self._drawn[key] = encoded
        self._bytes += len(encoded)
        while self._bytes > _CACHE_BYTES:
            self._bytes -= len(self._drawn.popitem(last=False)[1])
        return encoded

    def draw(self, bounds: Bounds, width: int, height: int) -> ImageArray:
        """The orthophoto in a region (west, south, east, north), RGB (height, width, 3); grey where there is none.

        Raises: MapError, as `MapStore.read_colour`.
        """
        canvas = np.full((height, width, 3), _PAPER, dtype=np.uint8)
        west, _, east, north = bounds
        gsd_m = (east - west) / width
        window = self._store.read_colour(bounds, gsd_m)
        if window is None:
            return canvas
        shown = np.where(window.valid[..., None], window.rgb, np.uint8(_PAPER))
        size = (max(1, round(window.grid.width * window.grid.dx / gsd_m)),
                max(1, round(window.grid.height * abs(window.grid.dy) / gsd_m)))  # fmt: skip
        if size != (window.grid.width, window.grid.height):
            shown = np.asarray(cv2.resize(shown, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
        left, upper = round((window.grid.west - west) / gsd_m), round((north - window.grid.top) / gsd_m)
        part = shown[max(0, -upper) : height - upper, max(0, -left) : width - left]
        top, start = max(0, upper), max(0, left)
        canvas[top : top + part.shape[0], start : start + part.shape[1]] = part
        return canvas

    def _tile_bounds(self, level: int, column: int, row: int) -> Bounds | None:
        if not 0 <= level < self.levels:
            return None
        west, south, east, north = self._bounds
        side_m = TILE_PX * self.gsd_m * 2.0**level
        columns, rows = math.ceil((east - west) / side_m), math.ceil((north - south) / side_m)
        if not (0 <= column < columns and 0 <= row < rows):
            return None
        left, top = west + column * side_m, north - row * side_m
        return left, top - side_m, left + side_m, top


def jpeg(image: ImageArray, quality: int) -> bytes:
    """RGB (H, W, 3) or grey (H, W) as JPEG."""
    shown = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
    _, data = cv2.imencode(".jpg", shown, [cv2.IMWRITE_JPEG_QUALITY, quality])
    return data.tobytes()
