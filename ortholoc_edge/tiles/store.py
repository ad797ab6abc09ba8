"""Preloaded packs, read by region.

A store holds the compressed files in memory and decodes on demand, so that resident memory is their size plus
the cache limit, whatever the area, and no read touches the disk in flight.
"""

from __future__ import annotations

import logging
from math import ceil, floor, isfinite, sqrt
from types import TracebackType

import numpy as np
import numpy.typing as npt

from ortholoc_edge.errors import MapError
from ortholoc_edge.geometry.arrays import FloatArray
from ortholoc_edge.geometry.grid import RasterGrid, bilinear
from ortholoc_edge.tiles.cog import BLOCK_PX, Cog, PixelWindow, describe, set_block_cache
from ortholoc_edge.tiles.manifest import RasterFile
from ortholoc_edge.tiles.pack import Pack
from ortholoc_edge.tiles.window import MapWindow

logger = logging.getLogger(__name__)

Bounds = tuple[float, float, float, float]

CACHE_BYTES = 64 * 2**20

# 16 Mpx of RGB and mask are 64 MB; a localizer works on 0.3-1 Mpx.
MAX_PIXELS = 16_000_000

# A level may be a little coarser than asked for: overview pixels can be a trifle larger than 2^k of the full ones.
_LEVEL_SLACK = 1.01

# Of a pixel: bounds that were computed to lie on a pixel's edge should not drag in its neighbour.
_EDGE_SLACK_PX = 1e-6

_GROUND_REACH_M = (20.0, 80.0, 320.0)


class MapStore:
    """DOP and DSM of a pack, in memory. Safe to read from several threads.

    The cache limit is the process's: GDAL has one block cache, and the store opened last sets its size.
    """

    def __init__(
        self,
        pack: Pack,
        *,
        cache_bytes: int = CACHE_BYTES,
        max_pixels: int = MAX_PIXELS,
        tolerate_damage: bool = False,
    ) -> None:
        """Read the files to memory and check their SHA-256.

        Args:
            cache_bytes: limit of decoded blocks.
            max_pixels: largest raster that one read may return.
            tolerate_damage: open a pack with damaged tiles; a read that touches one raises MapDamagedError.
                The pack's tile checksums tell which they are.
        Raises: MapError naming the damaged or missing file.
        """
        self.pack = pack
        self.max_pixels = max_pixels
        set_block_cache(cache_bytes)
        self._dop = _load(pack, pack.manifest.dop, tolerate_damage)
        try:
            self._dsm = _load(pack, pack.manifest.dsm, tolerate_damage)
        except MapError:
            self._dop.close()
            raise

    def __enter__(self) -> MapStore:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, err: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Free the memory; later reads raise MapError."""
        self._dop.close()
        self._dsm.close()

    @property
    def bounds(self) -> Bounds:
        """(west, south, east, north) of the DOP, m."""
        return self._dop.grids[0].bounds

    @property
    def compressed_bytes(self) -> int:
        """Bytes of the preloaded files."""
        return sum(entry.bytes for entry in self.pack.rasters)

    @property
    def dop_grids(self) -> tuple[RasterGrid, ...]:
        """Grids of the DOP's levels, finest first."""
        return self._dop.grids

    @property
    def dsm_grids(self) -> tuple[RasterGrid, ...]:
        """Grids of the DSM's levels, finest first."""
        return self._dsm.grids

    def read(self, bounds_map: Bounds, gsd_m: float, dsm_gsd_m: float | None = None) -> MapWindow | None:
        """The map in a region, on the grids of the levels that fit; nothing is resampled.

        The DOP comes from the coarsest level that is no coarser than ``gsd_m * sqrt(2)``, the DSM from the
        coarsest that is no coarser than ``dsm_gsd_m``; the finest if none is. Both are cropped to the map;
        the DSM reaches one cell beyond the DOP's window, for bilinear look-ups.
        Args:
            bounds_map: (west, south, east, north), m.
            gsd_m: wanted ground sampling distance of the DOP.
            dsm_gsd_m: of the DSM; by default twice that of the DOP's chosen level.
        Returns: None where the region holds no pixel of the DOP or none of the DSM.
        Raises: MapError for a window over ``max_pixels``; MapDamagedError for one that touches a damaged
            tile; ValueError for bounds or a GSD that are no such.
        """
        west, south, east, north = bounds_map
        if not (all(map(isfinite, bounds_map)) and west < east and south < north):
            raise ValueError(f"bounds (west, south, east, north) {bounds_map} unusable")
        if not (isfinite(gsd_m) and gsd_m > 0) or not (dsm_gsd_m is None or dsm_gsd_m > 0):
            raise ValueError(f"gsd_m {gsd_m}, dsm_gsd_m {dsm_gsd_m} must be positive")
        level = _coarsest(self._dop.grids, gsd_m * sqrt(2.0))
        window = _pixels(self._dop.grids[level], bounds_map, margin=0)
        if window is None:
            return None
        dop_grid = self._dop.grids[level].crop(*window)
        dsm_level = _coarsest(self._dsm.grids, 2.0 * dop_grid.gsd_m if dsm_gsd_m is None else dsm_gsd_m)
        dsm_window = _pixels(self._dsm.grids[dsm_level], dop_grid.bounds, margin=1)
        if dsm_window is None:
            return None
        for name, size in (("DOP", window), ("DSM", dsm_window)):
            if size.width * size.height > self.max_pixels:
                raise MapError(
                    f"{name} window of {size.width} x {size.height} px exceeds {self.max_pixels} px;"
                    " ask for a smaller region or a larger gsd_m"
                )
        dop, valid = self._dop.read_image(level, window)
        dsm = self._dsm.read_heights(dsm_level, dsm_window)
        for array in (dop, valid, dsm):
            array.flags.writeable = False
        return MapWindow(dop, valid, dop_grid, dsm, self._dsm.grids[dsm_level].crop(*dsm_window))

    def ground_near(self, xy_map: npt.ArrayLike) -> float | None:
        """Typical height of the surface around a map position (2,), m: the median over 20 m to each side, over
        80 or 320 m where there is no data nearer; None where there is none at all."""
        for reach_m in _GROUND_REACH_M:
            offsets = np.linspace(-reach_m, reach_m, 7)
            around = np.stack(np.meshgrid(offsets, offsets), axis=-1).reshape(-1, 2)
            heights = self.heights(around + np.asarray(xy_map, dtype=np.float64))
            if np.isfinite(heights).any():
                return float(np.nanmedian(heights))
        return None

    def heights(self, xy_map: npt.ArrayLike) -> FloatArray:
        """Heights (N,) at map positions (N, 2), bilinear on the full resolution.

        NaN outside, within half a cell of the edge, and wherever a cell that carries weight has no data.
        """
        xy = np.asarray(xy_map, dtype=np.float64).reshape(-1, 2)
        grid = self._dsm.grids[0]
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
            raster = self._dsm.read_heights(0, window)
            heights[rows[own]] = bilinear(raster, px[rows[own]] - (column, row))
        return heights


def _load(pack: Pack, entry: RasterFile, tolerate_damage: bool) -> Cog:
    cog, intact = pack.load(entry)
    if intact:
        return cog
    try:
        if not tolerate_damage:
            raise MapError(
                f"{cog.path}: SHA-256 differs from the manifest; rebuild the pack or copy it again"
            )
        damaged = sorted(cog.locate_damage(entry.crcs()))
    except MapError:
        cog.close()
        raise
    first = describe(damaged[0]) if damaged else "none that a read would touch"
    logger.warning("%s: damaged, %d tiles cannot be used (first: %s)", cog.path, len(damaged), first)
    return cog


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
