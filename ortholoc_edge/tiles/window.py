"""DOP and DSM of one region: in grey as the localizer takes them, in colour for people."""

from __future__ import annotations

from dataclasses import dataclass

from ortholoc_edge.geometry.arrays import BoolArray, Float32Array, ImageArray
from ortholoc_edge.geometry.grid import RasterGrid


@dataclass(frozen=True, slots=True, eq=False)
class MapWindow:
    """A region of the map. The two rasters have grids of their own; neither is resampled onto the other.

    Attributes:
        dop_grey: (H, W) uint8 on ``dop_grid``, one of the pack's levels; black where the orthophoto has no data.
        dop_valid: (H, W) bool, False where the orthophoto has no data.
        dsm: (h, w) float32 heights in metres on ``dsm_grid``, in the pack's vertical datum; NaN where there is
            no data.
    """

    dop_grey: ImageArray
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


@dataclass(frozen=True, slots=True, eq=False)
class ColourWindow:
    """A region's orthophoto in colour, for pictures.

    Attributes:
        rgb: (H, W, 3) uint8 on ``grid``; black where ``valid`` (H, W) is False.
    """

    rgb: ImageArray
    valid: BoolArray
    grid: RasterGrid


@dataclass(frozen=True, slots=True, eq=False)
class MapLayers:
    """A map as a survey delivers it: orthophoto in colour and surface model, on grids of their own.

    Attributes:
        dop: (H, W, 3) uint8 RGB on ``dop_grid``; black where there is none.
        dsm: (h, w) float32 heights on ``dsm_grid``, m; NaN where there is none.
    """

    dop: ImageArray
    dop_grid: RasterGrid
    dsm: Float32Array
    dsm_grid: RasterGrid
