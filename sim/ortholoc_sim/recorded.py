"""A real place to fly over: the orthophoto and surface model of an area pack as a scene, in another light.

The pack that the daemon has is the one that the camera sees, and a picture must not be matched against itself (field
notes, "Test realism"). So `Light` changes what it looks like: a sun from elsewhere shades the surface and casts
shadows over those that the photo has, and tones, colours and patches of the ground are others. What stands there, and
where, is the map's own: a flight over it tests the loop, the geometry and the terrain of a real place, and says
nothing of what changed on the ground since the map was made. Results have to say so: `NOTICE`.
"""

from __future__ import annotations

import cv2
import numpy as np
from msgspec import Struct
from rasterio.fill import fillnodata

from ortholoc_edge.errors import MapError
from ortholoc_edge.geometry.arrays import BoolArray, Float32Array, ImageArray
from ortholoc_edge.geometry.grid import RasterGrid
from ortholoc_edge.tiles.lattice import Bounds
from ortholoc_edge.tiles.store import MapStore
from ortholoc_sim.epoch import SURVEY, towards_sun
from ortholoc_sim.lens import LUMA
from ortholoc_sim.noise import blobs, grain
from ortholoc_sim.world import Scene, WorldSpec, sunlight

NOTICE = "synthetic: the camera sees the map's own orthophoto, changed in light and tone only"
# Where the orthophoto has no data the ground is of one tone.
_BARE = 118
# Holes of the surface model are closed from so far; what is left has the typical height.
_FILL_M = 30.0
_TINT_M = 14.0


class Light(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What is other than in the orthophoto.

    Attributes:
        sun_azimuth_deg, sun_elevation_deg: from grid north clockwise; above the horizon. Its light comes on top of what
            the photo has.
        direct: how much of the light it is.
        gamma, saturation: of the tones; 1 leaves them.
        white: factors of red, green, blue.
        tint: 1-sigma of how patches of the ground differ from the photo, as a share.
        grain: 1-sigma of the same from pixel to pixel.
        seed: of both.
    """

    sun_azimuth_deg: float = 255.0
    sun_elevation_deg: float = 32.0
    direct: float = 0.45
    gamma: float = 1.2
    saturation: float = 0.8
    white: tuple[float, float, float] = (1.06, 1.0, 0.92)
    tint: float = 0.06
    grain: float = 0.03
    seed: int = 1


def scene_of_map(
    store: MapStore, bounds_map: Bounds | None = None, light: Light | None = None, gsd_m: float | None = None
) -> tuple[Scene, tuple[float, float]]:
    """A part of a map as a scene, and its south-west corner in the map.

    Args:
        bounds_map: west, south, east, north; None: all of it.
        gsd_m: of the scene's rasters; None: the orthophoto's.
    Raises: MapError if the map has nothing there; WindowTooLargeError for more than the store gives at once.
    """
    light = light or Light()
    wanted = bounds_map or store.bounds
    window = store.read_colour(wanted, gsd_m or store.pack.manifest.dop.gsd_m)
    heights = None if window is None else store.read_surface(window.grid, store.pack.manifest.dsm.gsd_m)
    if window is None or heights is None or not np.isfinite(heights.dsm).any():
        raise MapError(
            f"{store.pack.path}: no orthophoto with heights within {', '.join(f'{v:.0f}' for v in wanted)} to fly over"
        )
    grid = window.grid
    spec = WorldSpec(
        light.seed, grid.width * grid.gsd_m, grid.height * grid.gsd_m, grid.gsd_m, float(np.nanmedian(heights.dsm))
    )
    whole = _whole(heights.dsm, heights.dsm_grid.gsd_m)
    surface = _resampled(whole, heights.dsm_grid, grid)
    # On the surface model's own grid: it has nothing finer to shade.
    lit = sunlight(whole, heights.dsm_grid.gsd_m, towards_sun(light.sun_azimuth_deg, light.sun_elevation_deg))
    lit[~np.isfinite(heights.dsm)] = 1.0
    texture = relit(window.rgb, window.valid, _resampled(lit, heights.dsm_grid, grid), grid.gsd_m, light)
    scene = Scene(
        spec, SURVEY, texture, surface, surface, np.zeros(surface.shape, dtype=np.uint16), (), (), ()
    )  # fmt: skip
    west, south, _, _ = grid.bounds
    return scene, (west, south)


def relit(rgb: ImageArray, valid: BoolArray, lit: Float32Array, gsd_m: float, light: Light) -> ImageArray:
    """An orthophoto (H, W, 3) in another light, of the same brightness on the whole.

    Args:
        lit: (H, W) share of the sun's light that arrives, 1 on open flat ground.
    """
    shape = lit.shape
    share = np.float32(1.0 - light.direct) + np.float32(light.direct) * lit
    share *= np.float32(1.0) + np.float32(light.tint) * blobs(shape, _TINT_M / gsd_m, light.seed)
    share += np.float32(light.grain) * grain(shape, light.seed)
    image = rgb.astype(np.float32)
    image[~valid] = _BARE
    before = float(image.mean())
    image *= np.float32(1 / 255)
    image = np.asarray(cv2.pow(image, light.gamma), dtype=np.float32)
    grey = (image @ LUMA)[..., None]
    image = np.asarray(grey + (image - grey) * np.float32(light.saturation), dtype=np.float32)
    image *= share[..., None] * np.array(light.white, dtype=np.float32)
    image *= np.float32(before / max(float(image.mean()), 1e-6))
    return np.clip(np.round(image), 0, 255).astype(np.uint8)


def _whole(dsm: Float32Array, gsd_m: float) -> Float32Array:
    """Without holes: a ray would fall through them."""
    known = np.isfinite(dsm)
    if known.all():
        return dsm
    filled = fillnodata(
        np.where(known, dsm, 0.0).astype(np.float32), known.astype(np.uint8), max_search_distance=_FILL_M / gsd_m
    )
    # What is too far from any height stays 0 there.
    far = ~known & (cv2.distanceTransform((~known).astype(np.uint8), cv2.DIST_L2, 3) * gsd_m > _FILL_M)
    filled[far] = np.median(dsm[known])
    return np.asarray(filled, dtype=np.float32)


def _resampled(heights: Float32Array, source: RasterGrid, target: RasterGrid) -> Float32Array:
    """Heights at the centres of another grid's pixels; beyond the raster its rim goes on."""
    u = (target.west + (np.arange(target.width) + 0.5) * target.dx - source.west) / source.dx - 0.5
    v = (target.top + (np.arange(target.height) + 0.5) * target.dy - source.top) / source.dy - 0.5
    across, down = np.meshgrid(u.astype(np.float32), v.astype(np.float32))
    return np.asarray(
        cv2.remap(heights, across, down, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), dtype=np.float32
    )
