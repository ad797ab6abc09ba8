"""Preloaded packs, read by region.

A store holds the compressed files in memory, decodes on demand and keeps what it decoded last, so that resident memory
is their size plus the cache limit, whatever the area, and no read touches the disk in flight.
"""

from __future__ import annotations

import hashlib
import logging
from math import ceil, floor, isfinite, sqrt
from types import TracebackType

import numpy as np
import numpy.typing as npt

from ortholoc_edge.errors import MapError
from ortholoc_edge.geometry.arrays import FloatArray
from ortholoc_edge.geometry.grid import RasterGrid, bilinear
from ortholoc_edge.tiles.cache import BlockCache
from ortholoc_edge.tiles.cog import BLOCK_PX, Handles, PixelWindow, set_block_cache
from ortholoc_edge.tiles.lattice import Bounds
from ortholoc_edge.tiles.layer import LoadedLayer, read_listed
from ortholoc_edge.tiles.manifest import FeatureTile, FileNote
from ortholoc_edge.tiles.pack import Pack
from ortholoc_edge.tiles.window import ColourWindow, MapWindow, SurfaceWindow

logger = logging.getLogger(__name__)

# What structural matching reads for a view, with its heights, is 4 to 6 MiB of blocks, stored or averaged: with less it
# pushes itself out, and with more a flight decodes no less (measured). Features matched at 640 px take up to 14.
CACHE_BYTES = 8 * 2**20
# GDAL's own cache, of the whole process: a block is read from it once and as a whole, so one is enough.
_GDAL_CACHE_BYTES = 2**20
# Of compressed files: about 190 km2 at 4 MB per km2.
MEMORY_BYTES = 768 * 2**20

# 16 Mpx in colour with a mask are 64 MB; a localizer works on 0.3-1 Mpx in grey.
MAX_PIXELS = 16_000_000

# A level may be a little coarser than asked for: overview pixels can be a trifle larger than 2^k of the full ones.
_LEVEL_SLACK = 1.01

# Of a pixel: bounds that were computed to lie on a pixel's edge should not drag in its neighbour.
_EDGE_SLACK_PX = 1e-6

_GROUND_REACH_M = (20.0, 80.0, 320.0)


class WindowTooLargeError(MapError):
    """A read would give more pixels than a store may return at once."""


class MapStore:
    """DOP and DSM of a pack, in memory. Safe to read from several threads.

    A tile that is missing, or damaged, is a hole: no data, as where the survey had none; a damaged tile of which
    only some blocks are bad has holes there. Sets GDAL's block cache, of which a process has one, to a block's size.
    """

    def __init__(
        self,
        pack: Pack,
        *,
        cache_bytes: int = CACHE_BYTES,
        memory_bytes: int = MEMORY_BYTES,
        max_pixels: int = MAX_PIXELS,
        features: bool = False,
        require_intact: bool = False,
    ) -> None:
        """Read the files to memory and check their SHA-256; each that is damaged gives one warning.

        Args:
            cache_bytes: limit of decoded blocks, in grey or heights, of the levels that are read.
            memory_bytes: limit of the compressed files, which all are held.
            max_pixels: largest raster that one read may return.
            features: hold the precomputed features too, if the pack has any.
            require_intact: refuse a pack with holes by damage.
        Raises: MapError for a pack over ``memory_bytes``, before anything is read; for one without any usable tile
            of DOP or DSM; for one that was replaced meanwhile; for a damaged one if it must be intact.
        """
        self.pack = pack
        self.max_pixels = max_pixels
        manifest = pack.manifest
        feature_tiles = manifest.features.tiles if features and manifest.features is not None else []
        notes: list[FileNote] = [*manifest.dop.tiles, *manifest.dsm.tiles, *feature_tiles]
        self._compressed_bytes = sum(note.bytes for note in notes)
        if self._compressed_bytes > memory_bytes:
            raise MapError(
                f"{pack.path}: {self._compressed_bytes / 2**20:.0f} MiB to be held in memory,"
                f" {memory_bytes / 2**20:.0f} MiB are allowed; rebuild the pack with a smaller --area or with"
                f" --max-size, or raise map.memory_mb"
            )
        set_block_cache(_GDAL_CACHE_BYTES)
        self._cache = BlockCache(cache_bytes)
        self._handles = Handles()
        shared = pack.path, self._handles, self._cache, pack.missing
        self._dop = LoadedLayer(manifest.dop, *shared, salvage=not pack.signed)
        try:
            self._dsm = LoadedLayer(manifest.dsm, *shared, salvage=not pack.signed)
        except BaseException:
            self._dop.close()
            raise
        self._pictures: LoadedLayer | None = None
        self._features: dict[int, bytes] = {}
        self._damaged_features: list[str] = []
        for tile in feature_tiles:
            self._load_features(tile)
        if self.damaged and pack.replaced():
            self.close()
            raise MapError(f"{pack.path}: another pack took its place while it was read; start again")
        if require_intact and self.damaged:
            self.close()
            raise MapError(
                f"{pack.path}: {len(self.damaged)} damaged or missing files, the first {self.damaged[0]}; copy the"
                " pack again, or allow holes with map.require_intact = false"
            )

    def __enter__(self) -> MapStore:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, err: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Free the memory; later reads raise MapError."""
        self._dop.close()
        with self._handles.lock:
            if self._pictures is not None:
                self._pictures.close()
        self._dsm.close()
        self._features = {}

    @property
    def damaged(self) -> list[str]:
        """Files of the pack that are holes or have some, because they are missing or damaged."""
        return [*self._dop.damaged, *self._dsm.damaged, *self._damaged_features]

    @property
    def bounds(self) -> Bounds:
        """(west, south, east, north) of the box that holds the DOP's tiles, m."""
        return self._dop.grids[0].bounds

    @property
    def compressed_bytes(self) -> int:
        """Bytes of the preloaded files."""
        return self._compressed_bytes

    @property
    def dop_grids(self) -> tuple[RasterGrid, ...]:
        """Grids of the DOP's levels over its bounds, finest first."""
        return self._dop.grids

    @property
    def dsm_grids(self) -> tuple[RasterGrid, ...]:
        """Grids of the DSM's levels over the box that holds its tiles, finest first."""
        return self._dsm.grids

    def read(self, bounds_map: Bounds, gsd_m: float, dsm_gsd_m: float | None = None) -> MapWindow | None:
        """The map in a region, on the grids of the levels that fit; nothing is resampled.

        The DOP comes from the coarsest level that is no coarser than ``gsd_m * sqrt(2)``, the DSM from the
        coarsest that is no coarser than ``dsm_gsd_m``; the finest if none is. Both are cropped to the layers' boxes;
        the DSM reaches one cell beyond the DOP's window, for bilinear look-ups. Pixels without a tile are invalid
        or NaN, as those for which a tile has no data.
        Args:
            bounds_map: (west, south, east, north), m.
            gsd_m: wanted ground sampling distance of the DOP.
            dsm_gsd_m: of the DSM; by default twice that of the DOP's chosen level.
        Returns: None where the region holds no pixel of the DOP or none of the DSM.
        Raises: WindowTooLargeError for a window over ``max_pixels``; MapError after `close`; ValueError for bounds
            or a GSD that are no such.
        """
        found = self._dop_window(bounds_map, gsd_m)
        if found is None:
            return None
        level, window, dop_grid = found
        dsm_level, dsm_window = self._dsm_window(dop_grid, 2.0 * dop_grid.gsd_m if dsm_gsd_m is None else dsm_gsd_m)
        if dsm_window is None:
            return None
        grey, valid = self._dop.read_grey(level, window)
        dsm = self._dsm.read_heights(dsm_level, dsm_window)
        for array in (grey, valid, dsm):
            array.flags.writeable = False
        return MapWindow(grey, valid, dop_grid, dsm, self._dsm.grids[dsm_level].crop(*dsm_window))

    def read_colour(self, bounds_map: Bounds, gsd_m: float) -> ColourWindow | None:
        """The orthophoto that `read` gives in grey, in colour. For pictures: it decodes anew each time, and
        who localizes meanwhile does not wait for it.

        Returns: None where the region holds no pixel of it. Raises: as `read`.
        """
        found = self._dop_window(bounds_map, gsd_m)
        if found is None:
            return None
        level, window, grid = found
        with self._handles.lock:
            if self._pictures is None:
                self._pictures = self._dop.aside()
        rgb, valid = self._pictures.read_rgb(level, window)
        for array in (rgb, valid):
            array.flags.writeable = False
        return ColourWindow(rgb, valid, grid)

    def read_surface(self, grid: RasterGrid, dsm_gsd_m: float) -> SurfaceWindow | None:
        """Heights under a grid, as `read` gives them with an orthophoto of that grid.

        Returns: None where the DSM has no pixel there.
        Raises: WindowTooLargeError, MapError after `close`.
        """
        level, window = self._dsm_window(grid, dsm_gsd_m)
        if window is None:
            return None
        dsm = self._dsm.read_heights(level, window)
        dsm.flags.writeable = False
        return SurfaceWindow(grid, dsm, self._dsm.grids[level].crop(*window))

    def feature_bytes(self, dop_index: int) -> bytes | None:
        """File with the features of a tile of the DOP, by its index in the manifest; its SHA-256 was checked. None
        if the tile has none, they were not asked for, or the file is damaged."""
        return self._features.get(dop_index)

    def ground_near(self, xy_map: npt.ArrayLike, gsd_m: float = 0.0) -> float | None:
        """Typical height of the surface around a map position (2,), m: the median over 20 m to each side, over
        80 or 320 m where there is no data nearer; None where there is none at all. ``gsd_m``: as of `heights`."""
        for reach_m in _GROUND_REACH_M:
            offsets = np.linspace(-reach_m, reach_m, 7)
            around = np.stack(np.meshgrid(offsets, offsets), axis=-1).reshape(-1, 2)
            heights = self.heights(around + np.asarray(xy_map, dtype=np.float64), gsd_m)
            if np.isfinite(heights).any():
                return float(np.nanmedian(heights))
        return None

    def heights(self, xy_map: npt.ArrayLike, gsd_m: float = 0.0) -> FloatArray:
        """Heights (N,) at map positions (N, 2), bilinear on the coarsest level that is no coarser than ``gsd_m``; on
        the full resolution if none is.

        NaN outside, within half a cell of the edge, and wherever a cell that carries weight has no data.
        """
        xy = np.asarray(xy_map, dtype=np.float64).reshape(-1, 2)
        level = _coarsest(self._dsm.grids, gsd_m)
        grid = self._dsm.grids[level]
        px = grid.px_from_map(xy)
        heights = np.full(len(xy), np.nan)
        inside = ((px >= 0) & (px <= (grid.width - 1, grid.height - 1))).all(axis=1)
        rows = np.flatnonzero(inside)
        base = np.floor(px[rows]).astype(np.intp)
        blocks, which = np.unique(base // BLOCK_PX, axis=0, return_inverse=True)
        for k in range(len(blocks)):
            own = which.reshape(-1) == k
            column, row = base[own].min(axis=0)
            # One cell beyond the last base cell, its bilinear neighbour, unless the raster ends there.
            width, height = np.minimum(base[own].max(axis=0) + 2, (grid.width, grid.height)) - (column, row)
            window = PixelWindow(int(column), int(row), int(width), int(height))
            raster = self._dsm.read_heights(level, window)
            heights[rows[own]] = bilinear(raster, px[rows[own]] - (column, row))
        return heights

    def forget_decoded(self) -> None:
        """Empty the cache of decoded blocks, to time reads without."""
        with self._handles.lock:
            self._cache.clear()

    def _dop_window(self, bounds: Bounds, gsd_m: float) -> tuple[int, PixelWindow, RasterGrid] | None:
        """Level, pixels and grid of a region of the DOP; None where it has no pixel."""
        west, south, east, north = bounds
        if not (all(map(isfinite, bounds)) and west < east and south < north):
            raise ValueError(f"bounds (west, south, east, north) {bounds} unusable")
        if not (isfinite(gsd_m) and gsd_m > 0):
            raise ValueError(f"gsd_m {gsd_m} must be positive")
        level = _coarsest(self._dop.grids, gsd_m * sqrt(2.0))
        window = _pixels(self._dop.grids[level], bounds, margin=0)
        if window is None:
            return None
        self._check_size("DOP", window)
        return level, window, self._dop.grids[level].crop(*window)

    def _dsm_window(self, grid: RasterGrid, gsd_m: float) -> tuple[int, PixelWindow | None]:
        """Level and pixels of the DSM under a grid, and one more on each side."""
        if not gsd_m > 0:
            raise ValueError(f"dsm_gsd_m {gsd_m} must be positive")
        level = _coarsest(self._dsm.grids, gsd_m)
        window = _pixels(self._dsm.grids[level], grid.bounds, margin=1)
        if window is not None:
            self._check_size("DSM", window)
        return level, window

    def _check_size(self, name: str, window: PixelWindow) -> None:
        if window.width * window.height > self.max_pixels:
            raise WindowTooLargeError(
                f"{name} window of {window.width} x {window.height} px exceeds {self.max_pixels} px;"
                " ask for a smaller region or a larger gsd_m"
            )

    def _load_features(self, tile: FeatureTile) -> None:
        try:
            if tile.file in self.pack.missing:
                raise MapError(f"{self.pack.path / tile.file}: missing; copy the pack again")
            if tile.dop_sha256 != self.pack.manifest.dop.tiles[tile.dop].sha256:
                raise MapError(
                    f"{self.pack.path / tile.file}: features of another orthophoto than the pack's; rebuild the pack"
                )
            data = read_listed(self.pack.path / tile.file, tile)
            if hashlib.sha256(data).hexdigest() != tile.sha256:
                raise MapError(f"{self.pack.path / tile.file}: SHA-256 differs from the manifest; copy the pack again")
        except MapError as err:
            logger.warning("%s; its tile is flown without precomputed features", err)
            self._damaged_features.append(tile.file)
            return
        self._features[tile.dop] = data


def _coarsest(grids: tuple[RasterGrid, ...], limit_m: float) -> int:
    fitting = [k for k, grid in enumerate(grids) if grid.gsd_m <= limit_m * _LEVEL_SLACK]
    return fitting[-1] if fitting else 0


def _pixels(grid: RasterGrid, bounds: Bounds, margin: int) -> PixelWindow | None:
    """Pixels that a region touches, and ``margin`` more on each side, inside the grid; None if it is outside."""
    west, south, east, north = bounds
    rows = sorted(((south - grid.top) / grid.dy, (north - grid.top) / grid.dy))
    spans = []
    for (low, high), count in (
        (((west - grid.west) / grid.dx, (east - grid.west) / grid.dx), grid.width),
        (rows, grid.height),
    ):
        if high - _EDGE_SLACK_PX <= 0 or low + _EDGE_SLACK_PX >= count:
            return None
        start = max(floor(max(low, 0.0) + _EDGE_SLACK_PX) - margin, 0)
        stop = min(ceil(min(high, count) - _EDGE_SLACK_PX) + margin, count)
        spans.append((start, max(stop, start + 1)))
    (column, column_end), (row, row_end) = spans
    return PixelWindow(column, row, column_end - column, row_end - row)
