"""A Cloud Optimized GeoTIFF held in memory: its levels, its blocks, and which of them are damaged."""

from __future__ import annotations

import threading
import warnings
import zlib
from collections import OrderedDict
from collections.abc import Iterator, Mapping, Sequence
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

# An open level that was read from holds 0.9 MB of a DOP, 1.7 MB of a DSM; opening one takes 0.1 to 0.4 ms (measured).
# The blocks of a tile are read in turn, and what was decoded is kept elsewhere.
MAX_HANDLES = 1

# Of a pixel: what the sums of coordinates of millions of metres may be off.
_PLACE_SLACK_PX = 1e-3


class UndecodableError(MapError):
    """GDAL cannot decode what was asked for."""


class Block(NamedTuple):
    """A block of one level; ``column`` and ``row`` count blocks."""

    level: int
    column: int
    row: int


class PixelWindow(NamedTuple):
    """A rectangle of pixels of one level."""

    column: int
    row: int
    width: int
    height: int


class Handles:
    """Open GDAL datasets of a set of COGs, at most ``limit``: the one used longest ago is closed first.

    A dataset serves one thread at a time and may be closed for another, hence one lock for all; decoding one
    window takes milliseconds.
    """

    def __init__(self, limit: int = MAX_HANDLES) -> None:
        self.lock = threading.RLock()
        self._limit = limit
        # By COG and level; used longest ago first.
        self._open: OrderedDict[tuple[int, int], Any] = OrderedDict()

    def __len__(self) -> int:
        return len(self._open)

    def get(self, cog: Cog, level: int) -> Any:
        """A dataset of one level; to be used under ``lock`` only. Raises: MapError, UndecodableError."""
        key = id(cog), level
        if key not in self._open:
            dataset = cog.open_level(level)
            if len(self._open) >= self._limit:
                self._open.popitem(last=False)[1].close()
            self._open[key] = dataset
        self._open.move_to_end(key)
        return self._open[key]

    def forget(self, cog: Cog) -> None:
        """Close what is open of a COG."""
        with self.lock:
            for key in [key for key in self._open if key[0] == id(cog)]:
                self._open.pop(key).close()


class Cog:
    """Random access to a COG's levels from several threads. Nothing is opened before it is asked for."""

    def __init__(self, data: bytes, path: Path, handles: Handles | None = None) -> None:
        """
        Args:
            data: the file; not copied.
            path: for messages.
            handles: shared with other COGs.
        """
        self.path = path
        self._data = data
        self._handles = Handles() if handles is None else handles
        self._grids: Mapping[int, RasterGrid] | None = None
        self._nodata: float | None = None
        self._memory: MemoryFile | None = MemoryFile(data)

    def aside(self, handles: Handles) -> Cog:
        """The same bytes with other handles, and so another lock. Checked as this one is."""
        other = Cog(self._data, self.path, handles)
        other._grids, other._nodata = self._grids, self._nodata
        return other

    def __enter__(self) -> Cog:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, err: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        with self._handles.lock:
            self._handles.forget(self)
            if self._memory is not None:
                self._memory.close()
            self._memory = None

    @property
    def grids(self) -> Mapping[int, RasterGrid]:
        """Grids of the levels that the file has, finest first: level k has pixels of 2^k times the side.

        Raises: MapError if it is no tiled GeoTIFF of ours.
        """
        if self._grids is None:
            with self._handles.lock, self._open() as full:
                if full.block_shapes[0] != (BLOCK_PX, BLOCK_PX):
                    raise MapError(f"{self.path}: blocks of {full.block_shapes[0]} px, expected {BLOCK_PX}")
                finest = raster_grid(full, self.path)
                self._grids = {
                    level: finest.resized(finest.width >> level, finest.height >> level)
                    for level in _levels(full, self.path)
                }
        return self._grids

    @property
    def crs(self) -> Any:
        """rasterio's CRS, or None."""
        with self._handles.lock, self._open() as full:
            return full.crs

    def require(self, grids: Mapping[int, RasterGrid], dtypes: Sequence[str], nodata: float | None) -> None:
        """Check that this is the raster it is taken for; of the overviews, that they are there.

        Args:
            grids: by level, finest first.
        Raises: MapError naming what differs.
        """
        with self._handles.lock, self._open() as full:
            if full.dtypes != tuple(dtypes) or full.block_shapes[0] != (BLOCK_PX, BLOCK_PX):
                raise MapError(
                    f"{self.path}: bands of {full.dtypes} in blocks of {full.block_shapes[0]},"
                    f" expected {tuple(dtypes)} of {BLOCK_PX}; rebuild the pack"
                )
            if nodata is not None and full.nodata != nodata:
                raise MapError(f"{self.path}: nodata {full.nodata}, expected {nodata}; rebuild the pack")
            found, levels = raster_grid(full, self.path), _levels(full, self.path)
        if not _same_place(found, grids[0]) or levels != list(grids):
            raise MapError(
                f"{self.path}: levels {levels} of {found}, expected {list(grids)} of {grids[0]}; rebuild the pack"
            )
        # What a level's size is, is seen when it is read.
        self._grids, self._nodata = grids, nodata

    def read_image(self, level: int, window: PixelWindow) -> tuple[ImageArray, BoolArray]:
        """RGB (3, H, W) uint8, black where invalid, and validity (H, W) of a window inside the level."""
        bands, mask = self._read(level, window, with_mask=True)
        valid: BoolArray = mask > 0
        # There the picture was made up, to compress well.
        return bands if valid.all() else bands * valid, valid

    def read_heights(self, level: int, window: PixelWindow) -> Float32Array:
        """Heights (H, W) float32 of a window inside the level, NaN where there is no data."""
        heights: Float32Array = self._read(level, window, with_mask=False)[0][0]
        # Exact: nodata is the lowest value of its LERC block, and LERC stores a block's lowest value as it is.
        heights[heights == self._dsm_nodata()] = np.nan
        return heights

    def blocks(self) -> Iterator[Block]:
        """All blocks of all levels."""
        for level, grid in self.grids.items():
            yield from touched(level, PixelWindow(0, 0, grid.width, grid.height))

    def window_of(self, block: Block) -> PixelWindow:
        """A block's pixels: those at the right and lower edge are cropped."""
        grid = self.grids[block.level]
        return within(block, PixelWindow(0, 0, grid.width, grid.height))

    def undecodable(self) -> list[Block]:
        """Blocks that GDAL cannot decode."""
        bad = []
        for block in self.blocks():
            try:
                self._read(block.level, self.window_of(block), with_mask=True)
            except UndecodableError:
                bad.append(block)
        return bad

    def segment_crcs(self) -> list[int]:
        """CRC-32 of the file's head and of each block's bytes, in the order of the file.

        A block's segment runs to the start of the next one, so that the mask which a COG interleaves with its
        image is counted in, and every byte of the file belongs to one segment.
        """
        view = memoryview(self._data)
        bounds = [0, *sorted(self._offsets().values()), len(self._data)]
        return [zlib.crc32(view[start:end]) for start, end in pairwise(bounds)]

    def locate_damage(self, crcs: list[int]) -> frozenset[Block]:
        """Blocks whose bytes differ from those of the build.

        Raises: MapError if the file's head is damaged, because then nothing in it can be trusted.
        """
        found = self.segment_crcs()
        if len(found) != len(crcs) or found[0] != crcs[0]:
            raise MapError(f"{self.path}: the file's head is damaged; copy the pack again")
        in_order = sorted(self._offsets().items(), key=lambda item: item[1])
        return frozenset(
            block for (block, _), was, now in zip(in_order, crcs[1:], found[1:], strict=True) if was != now
        )

    def open_level(self, level: int) -> Any:
        """A rasterio dataset of one level, without its place on the map, to be closed by the caller.

        Raises: MapError, UndecodableError.
        """
        overview = {} if level == 0 else {"overview_level": self._overview(level)}
        # To look up the CRS takes five times as long as all the rest of opening.
        return self._open(GEOREF_SOURCES="NONE", **overview)

    def _open(self, **options: Any) -> Any:
        """A rasterio dataset; without options of the full resolution, with its place on the map."""
        if self._memory is None:
            raise MapError(f"{self.path}: already closed; open the pack again")
        if not self._data:
            # To rasterio an empty file is one to be written.
            raise UndecodableError(f"{self.path}: empty; copy the pack again")
        # Nothing but a TIFF: other formats of GDAL's lead to other files.
        try:
            with quiet_georeference():
                return self._memory.open(driver="GTiff", **options)
        except (RasterioError, OSError) as err:
            raise UndecodableError(f"{self.path}: cannot be opened ({err}); copy the pack again") from err

    def _dsm_nodata(self) -> np.float32:
        """Raises: MapError without one: then holes could not be told from heights."""
        if self._nodata is None:
            with self._handles.lock:
                self._nodata = self._handles.get(self, 0).nodata
            if self._nodata is None:
                raise MapError(f"{self.path}: names no nodata value; rebuild the pack")
        return np.float32(self._nodata)

    def _overview(self, level: int) -> int | None:
        """GDAL's number of a level; None: the full resolution."""
        return list(self.grids).index(level) - 1 if level else None

    def _offsets(self) -> dict[Block, int]:
        offsets = {}
        with self._handles.lock:
            full = self._handles.get(self, 0)
            for block in self.blocks():
                name = f"BLOCK_OFFSET_{block.column}_{block.row}"
                item = full.get_tag_item(name, "TIFF", bidx=1, ovr=self._overview(block.level))
                if item is not None:
                    offsets[block] = int(item)
        return offsets

    def _read(self, level: int, window: PixelWindow, *, with_mask: bool) -> tuple[Any, Any]:
        area = Window(window.column, window.row, window.width, window.height)
        with self._handles.lock:
            grid = self.grids[level]
            dataset = self._handles.get(self, level)
            if dataset.shape != (grid.height, grid.width):
                raise UndecodableError(
                    f"{self.path}: level {level} has {dataset.shape[1]} x {dataset.shape[0]} px, expected"
                    f" {grid.width} x {grid.height}; rebuild the pack"
                )
            try:
                bands = dataset.read(window=area)
                mask = dataset.read_masks(1, window=area) if with_mask else None
            except (RasterioError, OSError) as err:
                raise UndecodableError(
                    f"{self.path}: level {level} cannot be decoded at pixel ({window.column}, {window.row}) ({err});"
                    " copy the pack again"
                ) from err
        return bands, mask


def touched(level: int, window: PixelWindow, side: int = BLOCK_PX) -> Iterator[Block]:
    """Blocks, of ``side`` pixels, that a window of a level has pixels of."""
    for row in range(window.row // side, (window.row + window.height - 1) // side + 1):
        for column in range(window.column // side, (window.column + window.width - 1) // side + 1):
            yield Block(level, column, row)


def within(block: Block, window: PixelWindow, side: int = BLOCK_PX) -> PixelWindow:
    """The part of a window that lies in a block, of ``side`` pixels, that it touches."""
    column, row = max(block.column * side, window.column), max(block.row * side, window.row)
    right = min((block.column + 1) * side, window.column + window.width)
    lower = min((block.row + 1) * side, window.row + window.height)
    return PixelWindow(column, row, right - column, lower - row)


def describe(block: Block) -> str:
    return f"block at column {block.column}, row {block.row} of level {block.level}"


def raster_grid(dataset: Any, path: Path) -> RasterGrid:
    """Grid of a north-up rasterio dataset.

    Raises: MapError for a rotated, mirrored or missing geotransform.
    """
    t = dataset.transform
    if t.b != 0 or t.d != 0:
        raise MapError(f"{path}: rotated or sheared (affine terms {t.b:g}, {t.d:g}); straighten it with gdalwarp")
    if t.is_identity and dataset.crs is None:
        raise MapError(f"{path}: no georeference; add its world file, or assign it with gdal_translate -a_ullr")
    try:
        return RasterGrid(dataset.width, dataset.height, t.c, t.f, t.a, t.e)
    except ValueError as err:
        raise MapError(f"{path}: {err}; straighten it with gdalwarp") from err


def _levels(dataset: Any, path: Path) -> list[int]:
    """Levels of a rasterio dataset: 0 and its overviews. Raises: MapError for other than powers of two."""
    factors: list[int] = [1, *dataset.overviews(1)]
    levels = [factor.bit_length() - 1 for factor in factors]
    if factors != [2**level for level in levels]:
        raise MapError(f"{path}: overviews of {factors[1:]} pixels, expected powers of 2; rebuild the pack")
    return levels


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


def _same_place(found: RasterGrid, wanted: RasterGrid) -> bool:
    if (found.width, found.height) != (wanted.width, wanted.height):
        return False
    slack = _PLACE_SLACK_PX * wanted.dx
    off = (
        found.west - wanted.west,
        found.top - wanted.top,
        (found.dx - wanted.dx) * wanted.width,
        (found.dy - wanted.dy) * wanted.height,
    )
    return max(map(abs, off)) <= slack
