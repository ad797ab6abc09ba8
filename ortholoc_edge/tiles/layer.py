"""One layer of a pack in memory: compressed tiles, read as the one raster that they are cut from.

What a missing or damaged tile, or a damaged block of one, would show is a hole: no reader has to know.
"""

from __future__ import annotations

import copy
import hashlib
import logging
import stat
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from ortholoc_edge.errors import MapError
from ortholoc_edge.geometry.arrays import BoolArray, Float32Array, ImageArray
from ortholoc_edge.tiles.cache import BlockCache, Rasters
from ortholoc_edge.tiles.cog import BLOCK_PX, Block, Cog, Handles, PixelWindow, UndecodableError, touched, within
from ortholoc_edge.tiles.levels import halved_heights, halved_image, next_stored
from ortholoc_edge.tiles.manifest import Dop, Dsm, FileNote, Tile, layer_box

logger = logging.getLogger(__name__)

# Of a block of a COG: its rasters, averaged as many times as the level wanted is coarser.
_Decode = Callable[[Cog, Block, int], Rasters]


@dataclass(slots=True, eq=False)
class _Held:
    """A tile in memory.

    Attributes:
        damaged: blocks that are holes.
        checked: whether it was opened and found to be the raster that the manifest describes.
        told: whether a warning about its blocks was logged.
    """

    note: Tile
    cog: Cog
    damaged: frozenset[Block] = frozenset()
    checked: bool = False
    told: bool = False


class LoadedLayer:
    """DOP or DSM of a pack, preloaded. Safe to read from several threads.

    Attributes:
        grids: of the levels, stored or not, over the box that holds all tiles, finest first.
        damaged: files that are holes or have some, in the order in which that was found.
    """

    def __init__(
        self,
        layer: Dop | Dsm,
        folder: Path,
        handles: Handles,
        cache: BlockCache,
        missing: frozenset[str],
        *,
        salvage: bool = True,
    ) -> None:
        """Read the tiles to memory and check their SHA-256.

        Args:
            handles, cache: that the layers of a store share.
            missing: files that are not there; their tiles are holes and were reported.
            salvage: use the blocks of a damaged tile whose CRC-32 is right. Not where the pack is signed: to a
                forged block a CRC-32 can be made to fit.
        Raises: MapError if not one tile can be used.
        """
        self._layer, self._lattice = layer, layer.lattice
        self._box = layer_box(layer.tiles)
        self.grids = tuple(layer.lattice.grid(self._box, level) for level in range(layer.lattice.levels))
        self.damaged: list[str] = []
        self._handles, self._cache, self._salvage = handles, cache, salvage
        self._nodata = layer.nodata if isinstance(layer, Dsm) else None
        self._dtypes = ("float32",) if isinstance(layer, Dsm) else ("uint8",) * 3
        self._held: dict[tuple[int, int], _Held] = {}
        self._folder, self._closed = folder, False
        try:
            for note in layer.tiles:
                held = None if note.file in missing else self._load(note, folder)
                if held is not None:
                    self._held[layer.lattice.tile_key(note.column, note.row)] = held
                if held is None or held.damaged:
                    self.damaged.append(note.file)
            if not self._held:
                raise MapError(
                    f"{folder}: none of the {len(layer.tiles)} tiles of the {type(layer).__name__.upper()} can be"
                    f" used, from {layer.tiles[0].file} on; copy the pack again"
                )
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Free the memory; later reads raise MapError."""
        with self._handles.lock:
            self._closed = True
            for held in self._held.values():
                held.cog.close()
            self._held = {}
            self._cache.clear()

    def aside(self) -> LoadedLayer:
        """The same bytes, not copied, for a reader that must not hold up those of this one: it has a lock, and open
        datasets, of its own. What it finds damaged it tells nobody. To be closed by itself."""
        other = copy.copy(self)
        other._handles, other._cache, other.damaged = Handles(), BlockCache(0), list(self.damaged)
        with self._handles.lock:
            other._held = {
                key: _Held(held.note, held.cog.aside(other._handles), held.damaged, told=True)
                for key, held in self._held.items()
            }
        return other

    def read_grey(self, level: int, window: PixelWindow) -> tuple[ImageArray, BoolArray]:
        """Grey (H, W) uint8, black where invalid, and validity (H, W) of a window inside a level of a DOP."""
        grey = np.zeros((window.height, window.width), dtype=np.uint8)
        valid = np.zeros(grey.shape, dtype=np.bool_)
        self._assemble(level, window, _grey, (grey, valid), keep=True)
        return grey, valid

    def read_rgb(self, level: int, window: PixelWindow) -> tuple[ImageArray, BoolArray]:
        """RGB (H, W, 3) uint8, black where invalid, and validity (H, W) of a window inside a level of a DOP.

        Its blocks are decoded anew: nothing in flight asks for colours.
        """
        rgb = np.zeros((window.height, window.width, 3), dtype=np.uint8)
        valid = np.zeros(rgb.shape[:2], dtype=np.bool_)
        self._assemble(level, window, _rgb, (rgb, valid), keep=False)
        return rgb, valid

    def read_heights(self, level: int, window: PixelWindow) -> Float32Array:
        """Heights (H, W) float32 of a window inside a level of a DSM, NaN where there is no data."""
        heights = np.full((window.height, window.width), np.nan, dtype=np.float32)
        self._assemble(level, window, _heights, (heights,), keep=True)
        return heights

    # -- reading ---------------------------------------------------------------------------------------

    def _assemble(self, level: int, window: PixelWindow, decode: _Decode, targets: Rasters, *, keep: bool) -> None:
        """Paste what each block has of a window; where none has anything the targets stay as they are."""
        left, upper = (self._box.column >> level) + window.column, (self._box.row >> level) + window.row
        stored = next_stored(self._layer.stored, level)
        # A block of a level that is not stored is what one stored block becomes.
        side = BLOCK_PX >> (level - stored)
        # Under the lock as a whole: what one reader finds damaged, another must not find half marked.
        with self._handles.lock:
            if self._closed:
                raise MapError(f"{self._folder}: already closed; open the pack again")
            for held, piece in self._tiles_under(level, PixelWindow(left, upper, window.width, window.height)):
                if not (held.checked or self._found_as_described(held)):
                    continue
                column, row = (held.note.column >> level) - left, (held.note.row >> level) - upper
                for block in touched(stored, piece, side):
                    rasters = self._block(held, level, block, decode, keep=keep)
                    if rasters is None:
                        continue
                    part = within(block, piece, side)
                    source = _slices(part, -block.column * side, -block.row * side)
                    place = _slices(part, column, row)
                    for target, raster in zip(targets, rasters, strict=True):
                        target[place] = raster[source]

    def _block(self, held: _Held, level: int, block: Block, decode: _Decode, *, keep: bool) -> Rasters | None:
        """What a stored block shows at a level; None: it is damaged."""
        if block in held.damaged:
            return None
        key = held.note.file, level, block
        rasters = self._cache.get(key) if keep else None
        if rasters is None:
            try:
                rasters = decode(held.cog, block, level - block.level)
            except UndecodableError as err:
                held.damaged |= {block}
                self._tell(held, err)
                return None
            if keep:
                self._cache.put(key, rasters)
        return rasters

    def _tiles_under(self, level: int, window: PixelWindow) -> Iterator[tuple[_Held, PixelWindow]]:
        """Tiles that a window of the lattice's level meets, each with the part of it that is met, in the tile's own
        pixels. The cost is the window's, whatever the number of tiles."""
        side = self._lattice.tile_px >> level
        right, lower = window.column + window.width, window.row + window.height
        for tile_row in range(window.row // side, (lower - 1) // side + 1):
            for tile_column in range(window.column // side, (right - 1) // side + 1):
                held = self._held.get((tile_column, tile_row))
                if held is None:
                    continue
                column, row, width, height = (value >> level for value in held.note.box)
                west, east = max(column, window.column), min(column + width, right)
                north, south = max(row, window.row), min(row + height, lower)
                if west < east and north < south:
                    yield held, PixelWindow(west - column, north - row, east - west, south - north)

    def _found_as_described(self, held: _Held) -> bool:
        """Whether a tile is the raster that the manifest describes; if not, it is a hole from now on."""
        try:
            self._require(held)
        except MapError as err:
            self._held.pop(self._lattice.tile_key(held.note.column, held.note.row), None)
            held.cog.close()
            self._tell(held, err)
            return False
        held.checked = True
        return True

    def _tell(self, held: _Held, why: MapError) -> None:
        if not held.told:
            logger.warning("%s; it is a hole in the map", why)
        held.told = True
        if held.note.file not in self.damaged:
            self.damaged.append(held.note.file)

    def _require(self, held: _Held) -> None:
        held.cog.require(self._layer.tile_grids(held.note), self._dtypes, self._nodata)

    # -- loading ---------------------------------------------------------------------------------------

    def _load(self, note: Tile, folder: Path) -> _Held | None:
        """A tile with its damaged blocks, or None, with a warning, if it cannot be used."""
        path = folder / note.file
        try:
            data = read_listed(path, note)
        except MapError as err:
            logger.warning("%s; the tile is a hole in the map", err)
            return None
        held = _Held(note, Cog(data, path, self._handles))
        if hashlib.sha256(data).hexdigest() == note.sha256:
            return held
        try:
            if not self._salvage:
                raise MapError(f"{path}: SHA-256 differs from the signed manifest; copy the pack again")
            self._require(held)
            held.damaged = held.cog.locate_damage(note.crcs())
            if not held.damaged:
                raise MapError(f"{path}: SHA-256 differs from the manifest; copy the pack again")
        except MapError as err:
            held.cog.close()
            logger.warning("%s; the tile is a hole in the map", err)
            return None
        held.checked = held.told = True
        logger.warning(
            "%s: SHA-256 differs from the manifest, %d blocks are holes in the map; copy the pack again",
            path, len(held.damaged),
        )  # fmt: skip
        return held


def _rgb(cog: Cog, block: Block, steps: int) -> tuple[ImageArray, BoolArray]:
    bands, valid = cog.read_image(block.level, cog.window_of(block))
    # Several times as fast as moving the axis.
    rgb = np.asarray(cv2.merge(list(bands)), dtype=np.uint8)
    for _ in range(steps):
        rgb, valid = halved_image(rgb, valid)
    return rgb, valid


def _grey(cog: Cog, block: Block, steps: int) -> tuple[ImageArray, BoolArray]:
    rgb, valid = _rgb(cog, block, steps)
    grey = np.asarray(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), dtype=np.uint8)
    # Most blocks are valid all over: one value stands for that.
    return grey, np.broadcast_to(np.True_, valid.shape) if valid.all() else valid


def _heights(cog: Cog, block: Block, steps: int) -> tuple[Float32Array]:
    heights, share = cog.read_heights(block.level, cog.window_of(block)), None
    for _ in range(steps):
        heights, share = halved_heights(heights, share)
    return (heights,)


def _slices(window: PixelWindow, columns: int, rows: int) -> tuple[slice, slice]:
    """A window, moved."""
    row, column = window.row + rows, window.column + columns
    return slice(row, row + window.height), slice(column, column + window.width)


def read_listed(path: Path, note: FileNote) -> bytes:
    """A file that the manifest lists, of the size that it has there: no more is read.

    Raises: MapError naming the file.
    """
    check_listed(path, note)
    try:
        with path.open("rb") as file:
            data = file.read(note.bytes + 1)
    except OSError as err:
        raise MapError(f"{path}: cannot be read ({err.strerror}); copy the pack again") from err
    if len(data) != note.bytes:
        raise MapError(f"{path}: not the {note.bytes} bytes of the manifest; copy the pack again")
    return data


def check_listed(path: Path, note: FileNote) -> None:
    """Raises: MapError unless a file that the manifest lists is there and has the size that it has there."""
    try:
        found = path.stat()
    except OSError as err:
        raise MapError(f"{path}: {err.strerror}; copy the pack again") from err
    if not stat.S_ISREG(found.st_mode):
        raise MapError(f"{path}: no plain file; copy the pack again")
    if found.st_size != note.bytes:
        raise MapError(f"{path}: {found.st_size} bytes, the manifest says {note.bytes}; copy the pack again")
