"""One layer of a pack in memory: compressed tiles, read as the one raster that they are cut from.

What a missing or damaged tile, or a damaged block of one, would show is a hole: no reader has to know.
"""

from __future__ import annotations

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
from ortholoc_edge.tiles.cog import Block, Cog, Handles, PixelWindow, UndecodableError, touched, within
from ortholoc_edge.tiles.levels import halved_heights, halved_image, next_stored
from ortholoc_edge.tiles.manifest import Dop, Dsm, FileNote, Tile, layer_box

logger = logging.getLogger(__name__)

# Finer pixels that a level which is not stored is averaged from at a time: a window in flight is one strip.
_STRIP_PX = 4_000_000

_Paste = Callable[[Cog, PixelWindow, tuple[slice, slice]], None]


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
        self, layer: Dop | Dsm, folder: Path, handles: Handles, missing: frozenset[str], *, salvage: bool = True
    ) -> None:
        """Read the tiles to memory and check their SHA-256.

        Args:
            handles: that the layers of a store share.
            missing: files that are not there; their tiles are holes and were reported.
            salvage: use the blocks of a damaged tile whose CRC-32 is right. Not where the pack is signed: to a
                forged block a CRC-32 can be made to fit.
        Raises: MapError if not one tile can be used.
        """
        self._layer, self._lattice = layer, layer.lattice
        self._box = layer_box(layer.tiles)
        self.grids = tuple(layer.lattice.grid(self._box, level) for level in range(layer.lattice.levels))
        self.damaged: list[str] = []
        self._handles, self._salvage = handles, salvage
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

    def read_image(self, level: int, window: PixelWindow) -> tuple[ImageArray, BoolArray]:
        """RGB (H, W, 3) uint8 and validity (H, W) of a window inside a level of a DOP."""
        stored = next_stored(self._layer.stored, level)
        if stored == level:
            return self._stored_image(level, window)
        rgb = np.empty((window.height, window.width, 3), dtype=np.uint8)
        valid = np.empty((window.height, window.width), dtype=np.bool_)
        for rows, finer in _strips(window, level - stored):
            part = self._stored_image(stored, finer)
            for _ in range(level - stored):
                part = halved_image(*part)
            rgb[rows], valid[rows] = part
        return rgb, valid

    def read_heights(self, level: int, window: PixelWindow) -> Float32Array:
        """Heights (H, W) float32 of a window inside a level of a DSM, NaN where there is no data."""
        stored = next_stored(self._layer.stored, level)
        if stored == level:
            return self._stored_heights(level, window)
        heights = np.empty((window.height, window.width), dtype=np.float32)
        for rows, finer in _strips(window, level - stored):
            part, share = self._stored_heights(stored, finer), None
            for _ in range(level - stored):
                part, share = halved_heights(part, share)
            heights[rows] = part
        return heights

    # -- reading ---------------------------------------------------------------------------------------

    def _stored_image(self, level: int, window: PixelWindow) -> tuple[ImageArray, BoolArray]:
        rgb = np.zeros((window.height, window.width, 3), dtype=np.uint8)
        valid = np.zeros((window.height, window.width), dtype=np.bool_)

        def paste(cog: Cog, piece: PixelWindow, place: tuple[slice, slice]) -> None:
            bands, mask = cog.read_image(level, piece)
            # Several times as fast as moving the axis.
            rgb[place] = cv2.merge(list(bands))
            valid[place] = mask

        self._assemble(level, window, paste)
        return rgb, valid

    def _stored_heights(self, level: int, window: PixelWindow) -> Float32Array:
        heights = np.full((window.height, window.width), np.nan, dtype=np.float32)

        def paste(cog: Cog, piece: PixelWindow, place: tuple[slice, slice]) -> None:
            heights[place] = cog.read_heights(level, piece)

        self._assemble(level, window, paste)
        return heights

    def _assemble(self, level: int, window: PixelWindow, paste: _Paste) -> None:
        """Paste what each tile has of a window; where none has anything the target stays as it is."""
        if self._closed:
            raise MapError(f"{self._folder}: already closed; open the pack again")
        left, upper = (self._box.column >> level) + window.column, (self._box.row >> level) + window.row
        for held, piece in self._tiles_under(level, PixelWindow(left, upper, window.width, window.height)):
            column, row = (held.note.column >> level) - left, (held.note.row >> level) - upper

            def paste_piece(part: PixelWindow, held: _Held = held, column: int = column, row: int = row) -> None:
                at_row, at_column = row + part.row, column + part.column
                place = slice(at_row, at_row + part.height), slice(at_column, at_column + part.width)
                paste(held.cog, part, place)

            # Under the lock as a whole: what one reader finds damaged, another must not find half marked.
            with self._handles.lock:
                if self._closed:
                    raise MapError(f"{self._folder}: closed while it was read; open the pack again")
                if held.checked or self._found_as_described(held):
                    self._paste_sound(held, level, piece, paste_piece)

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

    def _paste_sound(
        self, held: _Held, level: int, piece: PixelWindow, paste_piece: Callable[[PixelWindow], None]
    ) -> None:
        blocks = list(touched(level, piece))
        sound = [block for block in blocks if block not in held.damaged]
        if len(sound) == len(blocks):
            try:
                paste_piece(piece)
            except UndecodableError as err:
                if len(blocks) == 1:
                    self._mark(held, blocks[0], err)
                    return
            else:
                return
        # Around the bad blocks; those found only now are found one by one.
        for block in sound:
            try:
                paste_piece(within(block, piece))
            except UndecodableError as err:
                self._mark(held, block, err)

    def _mark(self, held: _Held, block: Block, why: MapError) -> None:
        held.damaged |= {block}
        self._tell(held, why)

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


def _strips(window: PixelWindow, steps: int) -> Iterator[tuple[slice, PixelWindow]]:
    """A window in strips, each as its rows and as the window of the level ``steps`` finer that it is averaged from.

    A reader's limit is on what it asks for; of the finer pixels, 4 or 16 times as many, few are held at a time.
    """
    count = max(_STRIP_PX // (window.width << 2 * steps), 1)
    for row in range(0, window.height, count):
        height = min(count, window.height - row)
        yield (
            slice(row, row + height),
            PixelWindow(window.column << steps, (window.row + row) << steps, window.width << steps, height << steps),
        )


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
