"""A camera over the endless country: only what it may see is drawn, and drawn anew when it leaves that.

Every place of the country has one content whatever raster asks for it (`country`), so an area of 100 km2 costs what is
flown over, and the memory of one view.
"""

from __future__ import annotations

import numpy as np

from ortholoc_edge.geometry.arrays import FloatArray, ImageArray
from ortholoc_edge.geometry.camera import Camera
from ortholoc_edge.geometry.grid import RasterGrid
from ortholoc_edge.geometry.rigid import Rigid3
from ortholoc_edge.pipeline.prior import footprint
from ortholoc_edge.tiles.lattice import Bounds
from ortholoc_sim.camera import Placement, Renderer, Sensor
from ortholoc_sim.country import Country, Look
from ortholoc_sim.epoch import FLIGHT as LIGHT
from ortholoc_sim.world import Scene, WorldSpec

# Drawn beyond what is seen: at 12 m/s a new part every 10 s.
_MARGIN_M = 120.0
# Drawn parts begin at multiples of it, so that the textures' coarser levels are of the same texels.
_SNAP_M = 32.0
# What stands at the edge of the view may begin below it.
_BELOW_M = 15.0


def country_scene(
    country: Country, crs: str, look: Look, bounds_map: Bounds, texel_m: float
) -> tuple[Scene, tuple[float, float]]:
    """A part of the country (west, south, east, north in ``crs``) as a scene, and its south-west corner."""
    west, south, east, north = bounds_map
    columns, rows = round((east - west) / texel_m), round((north - south) / texel_m)
    grid = RasterGrid(columns, rows, west, south + rows * texel_m, texel_m, -texel_m)
    drawn = country.draw(grid, crs, look)
    spec = WorldSpec(country.seed, columns * texel_m, rows * texel_m, texel_m, float(np.median(drawn.heights)))
    # Light and shade are in the country's colours; the epoch only lights façades, and no object here has one.
    objects = np.zeros((rows, columns), np.uint16)
    return Scene(spec, LIGHT, drawn.rgb, drawn.heights, drawn.heights, objects, (), (), ()), (west, south)


class WideRenderer:
    """`camera.Renderer` of the part of a country that is in view.

    Args:
        ground_m: typical height, for how far is seen.
    """

    def __init__(
        self, country: Country, crs: str, look: Look, sensor: Sensor, *, ground_m: float, grid_scale: float,
        texel_m: float, level_by_pixel: bool = False,
    ) -> None:  # fmt: skip
        self.sensor = sensor
        self._country, self._crs, self._look = country, crs, look
        self._ground_m, self._grid_scale, self._texel_m = ground_m, grid_scale, texel_m
        self._level_by_pixel = level_by_pixel
        self._drawn: tuple[Bounds, Renderer] | None = None

    def clean(self, camera: Camera, map_from_camera: Rigid3) -> ImageArray:
        """(H, W, 3) RGB, without the sensor's flaws."""
        return self._around(camera, map_from_camera).clean(camera, map_from_camera)

    def _around(self, camera: Camera, map_from_camera: Rigid3) -> Renderer:
        eye = map_from_camera.translation
        seen = footprint(camera, map_from_camera, min(self._ground_m - _BELOW_M, float(eye[2]) - 1.0))
        points = np.vstack([seen, eye[None, :2]])
        (west, south), (east, north) = points.min(axis=0), points.max(axis=0)
        if self._drawn is not None:
            bounds, renderer = self._drawn
            if bounds[0] <= west and bounds[1] <= south and east <= bounds[2] and north <= bounds[3]:
                return renderer
        low, high = _snapped(np.array([west, south]) - _MARGIN_M), _snapped(np.array([east, north]) + _MARGIN_M)
        bounds = (float(low[0]), float(low[1]), float(high[0]) + _SNAP_M, float(high[1]) + _SNAP_M)
        scene, corner = country_scene(self._country, self._crs, self._look, bounds, self._texel_m)
        renderer = Renderer(
            scene, Placement(*corner, self._grid_scale), self.sensor, level_by_pixel=self._level_by_pixel
        )
        self._drawn = bounds, renderer
        return renderer


def _snapped(xy: FloatArray) -> FloatArray:
    return np.asarray(np.floor(xy / _SNAP_M) * _SNAP_M, dtype=np.float64)
