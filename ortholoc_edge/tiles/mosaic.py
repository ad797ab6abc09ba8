"""Several sources on one grid, the first of them uppermost."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np

from ortholoc_edge.geometry.arrays import BoolArray, Float32Array, ImageArray
from ortholoc_edge.geometry.grid import RasterGrid
from ortholoc_edge.tiles.area import MapArea
from ortholoc_edge.tiles.sources import Source, read_dop, read_dsm


class DopMosaic(NamedTuple):
    """Attributes:
    rgb: (3, H, W) uint8.
    valid: (H, W) bool.
    nir: (H, W) uint8, 255 where there is no infrared; None: none anywhere.
    shown: indices of the sources that gave a pixel.
    """

    rgb: ImageArray
    valid: BoolArray
    nir: ImageArray | None
    shown: tuple[int, ...]


class DsmMosaic(NamedTuple):
    """Attributes:
    heights: (H, W) float32, NaN where there are none.
    wanted: (H, W) bool, inside the area or the next cell.
    shown: indices of the sources that gave a height.
    """

    heights: Float32Array
    wanted: BoolArray
    shown: tuple[int, ...]


def dop_mosaic(sources: Sequence[Source], grid: RasterGrid, crs: str | None, area: MapArea | None) -> DopMosaic:
    """The orthophoto on ``grid``, inside ``area``. Raises: MapError naming a source that cannot be read."""
    rgb = np.zeros((3, grid.height, grid.width), np.uint8)
    nir: ImageArray | None = None
    valid = np.zeros((grid.height, grid.width), bool)
    wanted = _wanted(grid, area)
    shown = []
    for index, source in enumerate(sources):
        missing = wanted & ~valid
        if not missing.any():
            break
        pixels = read_dop(source, grid, crs)
        new = missing & pixels.valid
        if not new.any():
            continue
        shown.append(index)
        np.copyto(rgb, pixels.rgb, where=new)
        if pixels.nir is not None:
            # Infrared of 255 says that this is no water.
            nir = np.full(valid.shape, 255, np.uint8) if nir is None else nir
            np.copyto(nir, pixels.nir, where=new)
        valid |= new
    return DopMosaic(rgb, valid, nir, tuple(shown))


def dsm_mosaic(sources: Sequence[Source], grid: RasterGrid, crs: str | None, area: MapArea | None) -> DsmMosaic:
    """The surface model on ``grid``, inside ``area``. Raises: MapError naming a source that cannot be read."""
    heights = np.full((grid.height, grid.width), np.nan, np.float32)
    wanted = _wanted_heights(grid, area)
    shown = []
    for index, source in enumerate(sources):
        missing = wanted & np.isnan(heights)
        if not missing.any():
            break
        found = read_dsm(source, grid, crs)
        new = missing & np.isfinite(found)
        if new.any():
            shown.append(index)
            np.copyto(heights, found, where=new)
    return DsmMosaic(heights, wanted, tuple(shown))


def _wanted_heights(grid: RasterGrid, area: MapArea | None) -> BoolArray:
    """With what it takes to interpolate up to the border: cells may be 30 m large, or the area smaller than one."""
    if area is None:
        return np.ones((grid.height, grid.width), bool)
    # One cell around, as the neighbouring tile sees it.
    inside = area.mask(grid.crop(-1, -1, grid.width + 2, grid.height + 2), touched=True)
    return cv2.dilate(inside.astype(np.uint8), np.ones((3, 3), np.uint8))[1:-1, 1:-1] > 0


def _wanted(grid: RasterGrid, area: MapArea | None) -> BoolArray:
    return np.ones((grid.height, grid.width), bool) if area is None else area.mask(grid)
