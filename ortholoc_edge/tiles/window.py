"""DOP and DSM of one region, as the localizer takes them."""

from __future__ import annotations

from dataclasses import dataclass

from ortholoc_edge.geometry.arrays import BoolArray, Float32Array, ImageArray
from ortholoc_edge.geometry.grid import RasterGrid


@dataclass(frozen=True, slots=True, eq=False)
class MapWindow:
    """A region of the map. The two rasters have grids of their own; neither is resampled onto the other.

    Attributes:
        dop: (H, W, 3) uint8 RGB on ``dop_grid``, one of the pack's overview levels.
        dop_valid: (H, W) bool, False where the orthophoto has no data.
        dsm: (h, w) float32 heights in metres on ``dsm_grid``, in the pack's vertical datum; NaN where there is
            no data.
    """

    dop: ImageArray
    dop_valid: BoolArray
    dop_grid: RasterGrid
    dsm: Float32Array
    dsm_grid: RasterGrid


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceWindow:
    """A region's heights without its orthophoto, for what was extracted from that before.

    Attributes:
        dop_grid: whose pixels places on the map are given in.
        dsm, dsm_grid: as of `MapWindow`.
    """

    dop_grid: RasterGrid
    dsm: Float32Array
    dsm_grid: RasterGrid
