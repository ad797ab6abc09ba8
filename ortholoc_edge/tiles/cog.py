"""A Cloud Optimized GeoTIFF held in memory: its levels, its blocks, and which of them are damaged.

Decoded blocks live in GDAL's block cache. GDAL has one per process, bounded by one figure, with its own least
recently used order; a cache of ours on top would hold the same pixels twice.
"""

from __future__ import annotations

import threading
import warnings
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple

import numpy as np
import rasterio
from rasterio.env import get_gdal_config, set_gdal_config
from rasterio.errors import NotGeoreferencedWarning, RasterioError
from rasterio.io import MemoryFile
from rasterio.windows import Window

from ortholoc_edge.errors import MapError
from ortholoc_edge.geometry.arrays import BoolArray, Float32Array, ImageArray
from ortholoc_edge.geometry.grid import RasterGrid

BLOCK_PX = 512


class MapDamagedError(MapError):
    """The bytes of a tile that was asked for differ from those of the build."""


class Block(NamedTuple):
    """A tile of one level; ``column`` and ``row`` count tiles."""

    level: int
    column: int
    row: int


class PixelWindow(NamedTuple):
    """A block of pixels of one level."""

    column: int
    row: int
    width: int
    height: int


class Cog:
    """Random access to a COG's levels from several threads.

    A rasterio handle serves one thread at a time, hence the lock; decoding one window takes milliseconds.
    """

    def __init__(self, data: bytes, path: Path) -> None:
        """Open a file that was read to memory; ``path`` is for messages.

        Raises: MapError if it is no tiled GeoTIFF of ours.
        """
        self.path = path
        self._data = data
        self._lock = threading.Lock()
        self._damaged: frozenset[Block] = frozenset()
        self._levels: list[Any] = []
        try:
            self._memory = MemoryFile(data)
        except (RasterioError, OSError) as err:
            raise MapError(f"{path}: cannot be opened ({err}); rebuild the pack or copy it again") from err
        try:
            with quiet_georeference():
                full = self._memory.open()
                self._levels.append(full)
                for level in range(len(full.overviews(1))):
                    self._levels.append(self._memory.open(overview_level=level))
            if full.block_shapes[0] != (BLOCK_PX, BLOCK_PX):
                raise MapError(
                    f"{path}: blocks of {full.block_shapes[0]} px, expected {BLOCK_PX}; rebuild the pack"
                )
            # The overviews share the extent of the full resolution; where their size is rounded (DOP down,
            # DSM up), their pixels are a trifle larger or smaller than 2^k of the full ones.
            grid = raster_grid(full, path)
            self.grids = (grid, *(grid.resized(one.width, one.height) for one in self._levels[1:]))
        except (RasterioError, OSError) as err:
            self.close()
            raise MapError(f"{path}: cannot be read ({err}); rebuild the pack or copy it again") from err
        except MapError:
            self.close()
            raise
        self.nodata = full.nodata

    def __enter__(self) -> Cog:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, err: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        with self._lock:
            for level in self._levels:
                level.close()
            self._levels = []
            self._memory.close()

    def read_image(self, level: int, window: PixelWindow) -> tuple[ImageArray, BoolArray]:
        """RGB (H, W, 3) uint8 and validity (H, W) of a window inside the level."""
        bands, mask = self._read(level, window, with_mask=True)
        return np.ascontiguousarray(np.moveaxis(bands, 0, -1)), mask > 0

    def read_heights(self, level: int, window: PixelWindow) -> Float32Array:
        """Heights (H, W) float32 of a window inside the level, NaN where there is no data."""
        heights: Float32Array = self._read(level, window, with_mask=False)[0][0]
        # Exact: nodata is the lowest value of its LERC block, and LERC stores a block's lowest value as it is.
        heights[heights == np.float32(self.nodata)] = np.nan
        return heights

    def blocks(self) -> Iterator[Block]:
        """All tiles of all levels."""
        for level, grid in enumerate(self.grids):
            for row in range(-(-grid.height // BLOCK_PX)):
                for column in range(-(-grid.width // BLOCK_PX)):
                    yield Block(level, column, row)

    def block_window(self, block: Block) -> PixelWindow:
        grid = self.grids[block.level]
        column, row = block.column * BLOCK_PX, block.row * BLOCK_PX
        return PixelWindow(column, row, min(BLOCK_PX, grid.width - column), min(BLOCK_PX, grid.height - row))

    def undecodable(self) -> list[Block]:
        """Tiles that GDAL cannot decode."""
        bad = []
        for block in self.blocks():
            try:
                self._read(block.level, self.block_window(block), with_mask=True)
            except MapError:
                bad.append(block)
        return bad

    def segment_crcs(self) -> list[int]:
        """CRC-32 of the file's head and of each tile's bytes, in the order of the file.

        A tile's segment runs to the start of the next one, so that the mask which a COG interleaves with its
        image is counted in, and every byte of the file belongs to one segment.
        """
        view = memoryview(self._data)
        bounds = [0, *sorted(self._offsets().values()), len(self._data)]
        return [zlib.crc32(view[start:end]) for start, end in pairwise(bounds)]

    def locate_damage(self, crcs: list[int]) -> frozenset[Block]:
        """Tiles whose bytes differ from those of the build; later reads that touch one raise MapDamagedError.

        Raises: MapError if the file's head is damaged, because then nothing in it can be trusted.
        """
        found = self.segment_crcs()
        if len(found) != len(crcs) or found[0] != crcs[0]:
            raise MapError(f"{self.path}: the file's head is damaged; rebuild the pack or copy it again")
        in_order = sorted(self._offsets().items(), key=lambda item: item[1])
        self._damaged = frozenset(
            block for (block, _), was, now in zip(in_order, crcs[1:], found[1:], strict=True) if was != now
        )
        return self._damaged

    def _offsets(self) -> dict[Block, int]:
        offsets = {}
        with self._lock:
            for block in self.blocks():
                item = self._levels[0].get_tag_item(
                    f"BLOCK_OFFSET_{block.column}_{block.row}",
                    "TIFF",
                    bidx=1,
                    ovr=block.level - 1 if block.level else None,
                )
                if item is not None:
                    offsets[block] = int(item)
        return offsets

    def _read(self, level: int, window: PixelWindow, *, with_mask: bool) -> tuple[Any, Any]:
        if self._damaged:
            touched = sorted(self._damaged.intersection(_touched(level, window)))
            if touched:
                raise MapDamagedError(f"{self.path}: {describe(touched[0])} is damaged; copy the pack again")
        area = Window(window.column, window.row, window.width, window.height)
        with self._lock:
            if not self._levels:
                raise MapError(f"{self.path}: already closed; open the pack again")
            dataset = self._levels[level]
            try:
                bands = dataset.read(window=area)
                mask = dataset.read_masks(1, window=area) if with_mask else None
            except (RasterioError, OSError) as err:
                raise MapDamagedError(
                    f"{self.path}: level {level} cannot be decoded at pixel ({window.column}, {window.row}) ({err});"
                    " copy the pack again"
                ) from err
        return bands, mask


def describe(block: Block) -> str:
    return f"tile at column {block.column}, row {block.row} of level {block.level}"


def raster_grid(dataset: Any, path: Path) -> RasterGrid:
    """Grid of a north-up rasterio dataset.

    Raises: MapError for a rotated, mirrored or missing geotransform.
    """
    t = dataset.transform
    if t.b != 0 or t.d != 0:
        raise MapError(
            f"{path}: rotated or sheared (affine terms {t.b:g}, {t.d:g}); straighten it with gdalwarp"
        )
    if t.is_identity and dataset.crs is None:
        raise MapError(
            f"{path}: no georeference; add its world file, or assign it with gdal_translate -a_ullr"
        )
    try:
        return RasterGrid(dataset.width, dataset.height, t.c, t.f, t.a, t.e)
    except ValueError as err:
        raise MapError(f"{path}: {err}; straighten it with gdalwarp") from err


@contextmanager
def quiet_georeference() -> Iterator[None]:
    """Without rasterio's warning about a missing geotransform: :func:`raster_grid` refuses such a file."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        yield


@contextmanager
def block_cache(limit_bytes: int) -> Iterator[None]:
    """Bound GDAL's block cache of the whole process, and set back the old limit."""
    before = get_gdal_config("GDAL_CACHEMAX")
    set_block_cache(limit_bytes)
    try:
        yield
    finally:
        set_gdal_config("GDAL_CACHEMAX", before)


def set_block_cache(limit_bytes: int) -> None:
    """Bound GDAL's block cache of the whole process."""
    with rasterio.Env():
        set_gdal_config("GDAL_CACHEMAX", limit_bytes)


def _touched(level: int, window: PixelWindow) -> Iterator[Block]:
    for row in range(window.row // BLOCK_PX, (window.row + window.height - 1) // BLOCK_PX + 1):
        for column in range(window.column // BLOCK_PX, (window.column + window.width - 1) // BLOCK_PX + 1):
            yield Block(level, column, row)
