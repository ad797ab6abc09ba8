"""The map as a camera would see it: the orthophoto drawn in perspective over the surface model, with occlusion.

A plane homography shows flat ground; this shows relief, and knows for every pixel which point of the map it is. Rays
are marched down through the surface on a coarse net of pixels and end at the first thing they meet; between the net's
nodes the fall is interpolated. What the map does not have stays unseen: walls (a surface model is 2.5D), and what hides
behind an edge by less than a cell.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
import numpy.typing as npt

from ortholoc_edge.geometry.arrays import BoolArray, Float32Array, FloatArray, ImageArray
from ortholoc_edge.geometry.camera import Camera
from ortholoc_edge.geometry.grid import RasterGrid, bilinear
from ortholoc_edge.geometry.rigid import Rigid3
from ortholoc_edge.pipeline.prior import MAX_RANGE_HEIGHTS
from ortholoc_edge.tiles.georeference import LocalFrame
from ortholoc_edge.tiles.window import MapWindow

# Pixels between the nodes of the net that rays are marched on.
_NODE_PX = 4
# A ray may pass this many cells of the surface model from one look at it to the next, and looks so often at most.
_CELLS_PER_STEP = 2.0
_MIN_STEPS, _MAX_STEPS = 3, 32
# Of `surface_points`, which may take its time.
_EXACT_CELLS_PER_STEP = 0.5
_BISECTIONS = 14
_MARGIN_M = 0.5
# Looks at the surface once more where the ray met it, so that even slopes are exact.
_POLISHES = 2
# Picture of the map that is drawn from: the coarsest that has no larger pixels than the view, times this.
_LEVEL_SLACK = 1.42
_MIN_PICTURE_PX = 48
# Of so many cells or more along each axis: what lies below all but this many per cent by half of their depth and some
# metres is an error.
_SAMPLES_PER_SIDE = 100
_LOW_PERCENTILE = 0.2
_LOW_SLACK_M = 5.0
# Rays that start in a crown or below a hilltop start at this part of the height above the lowest ground.
_CLEARANCE = 0.05


@dataclass(frozen=True, slots=True, eq=False)
class _Picture:
    """The window's orthophoto in grey, at one pixel size. ``valid`` (H, W) 0 or 255; None: everywhere."""

    grey: ImageArray
    valid: ImageArray | None
    grid: RasterGrid


@dataclass(frozen=True, slots=True, eq=False)
class Terrain:
    """A window of the map made ready for drawing.

    Attributes:
        local: metric frame that poses are given in.
        heights: (h, w) float32 on ``grid``, m; holes at the lowest height.
        known: (h, w) float32, 1 where the surface model has data, else 0; None: it has everywhere.
        lowest_m, typical_m, highest_m: of the heights; the lowest without single low cells, which are errors.
        pictures: of the orthophoto, each half as fine as the one before.
    """

    local: LocalFrame
    grid: RasterGrid
    heights: Float32Array
    known: Float32Array | None
    lowest_m: float
    typical_m: float
    highest_m: float
    pictures: tuple[_Picture, ...]

    @staticmethod
    def of(window: MapWindow, local: LocalFrame) -> Terrain | None:
        """None where the surface model has no data."""
        # NaN spoils a sum but no minimum that leaves it out: one pass where there is none.
        known = None if math.isfinite(float(window.dsm.sum())) else np.isfinite(window.dsm)
        heights = window.dsm
        if known is not None:
            if not known.any():
                return None
            heights = np.where(known, heights, np.float32(heights[known].min()))
        every = max(min(heights.shape) // _SAMPLES_PER_SIDE, 1)
        low, typical = np.percentile(heights[::every, ::every], (_LOW_PERCENTILE, 50.0))
        believable = low - 0.5 * (typical - low) - _LOW_SLACK_M
        return Terrain(
            local,
            window.dsm_grid,
            heights,
            None if known is None else known.astype(np.float32),
            max(float(heights.min()), float(believable)),
            float(typical),
            float(heights.max()),
            _pyramid(window.dop_grey, window.dop_valid, window.dop_grid),
        )


def _pyramid(grey: ImageArray, valid: BoolArray, grid: RasterGrid) -> tuple[_Picture, ...]:
    mask = None if valid.all() else valid.astype(np.uint8) * np.uint8(255)
    pictures = [_Picture(grey, mask, grid)]
    while min(pictures[-1].grey.shape) >= 2 * _MIN_PICTURE_PX:
        finer = pictures[-1]
        size = finer.grid.width // 2, finer.grid.height // 2
        pictures.append(
            _Picture(
                _averaged(finer.grey, size),
                None if finer.valid is None else _averaged(finer.valid, size),
                finer.grid.resized(*size),
            )
        )
    return tuple(pictures)


def _averaged(image: ImageArray, size: tuple[int, int]) -> ImageArray:
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


@dataclass(frozen=True, slots=True, eq=False)
class RenderedView:
    """What a camera should see from a pose.

    Attributes:
        image: (H, W) uint8 grey; 0 where it shows no map.
        valid: (H, W) bool.
        camera, local_from_camera: that it is drawn for.
        fall_m: (h, w) float32, from the camera's height down to what the nodes' rays meet.
    """

    image: ImageArray
    valid: BoolArray
    camera: Camera
    local_from_camera: Rigid3
    fall_m: Float32Array

    def points_local(self, px: FloatArray) -> FloatArray:
        """Points (N, 3) of the map, local m, that pixels (N, 2) of the view show. They lie on the pixels' rays."""
        rays = self.camera.unproject(px) @ self.local_from_camera.rotation.T
        fall = bilinear(self.fall_m, _node_px(px))
        return np.asarray(self.local_from_camera.translation + rays * (fall / -rays[:, 2])[:, None], dtype=np.float64)


def _node_px(px: FloatArray) -> FloatArray:
    # The net begins one node outside, with centres as OpenCV's resizing has them.
    return (px - (0.5 * _NODE_PX - 0.5)) / _NODE_PX + 1.0


def render(terrain: Terrain, camera: Camera, local_from_camera: Rigid3) -> RenderedView:
    """Draw the map.

    Args:
        camera: its distortion is ignored.
    Returns: a view that is invalid above the horizon, beyond `prior.MAX_RANGE_HEIGHTS` heights, off the window and
        where orthophoto or surface have no data.
    """
    grid = terrain.grid
    columns, rows = (-(-side // _NODE_PX) + 2 for side in (camera.width, camera.height))
    first = 0.5 * _NODE_PX - 0.5 - _NODE_PX
    nodes = (first + _NODE_PX * np.arange(count) for count in (columns, rows))
    rays = _rays(terrain, camera, local_from_camera, *nodes)
    fall = _first_hits(terrain, rays)
    x, y = rays.x0 + rays.slope_x * fall, rays.y0 + rays.slope_y * fall
    seen = rays.ahead & _is_known(terrain, x, y)
    picture = _picture_for(terrain, float(np.median(fall)) / camera.focal_px)
    # Half pixels: both grids count from the centres of their first cells.
    to_x, to_y = grid.dx / picture.grid.dx, grid.dy / picture.grid.dy
    at_x = x * np.float32(to_x) + np.float32((grid.west - picture.grid.west) / picture.grid.dx + 0.5 * to_x - 0.5)
    at_y = y * np.float32(to_y) + np.float32((grid.top - picture.grid.top) / picture.grid.dy + 0.5 * to_y - 0.5)
    full_x, full_y = _upsampled(at_x, camera), _upsampled(at_y, camera)
    image = cv2.remap(picture.grey, full_x, full_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
    seen &= (at_x >= 0) & (at_x <= picture.grid.width - 1) & (at_y >= 0) & (at_y <= picture.grid.height - 1)
    if seen.all():
        valid = np.ones((camera.height, camera.width), np.bool_)
    else:
        valid = _upsampled(seen.astype(np.float32), camera) > 0.999
    if picture.valid is not None:
        known = cv2.remap(picture.valid, full_x, full_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
        valid &= np.asarray(known) >= 254
    return RenderedView(np.asarray(image, dtype=np.uint8), valid, camera, local_from_camera, fall)


def surface_points(terrain: Terrain, camera: Camera, local_from_camera: Rigid3) -> FloatArray:
    """Points (H, W, 3) of the surface, local m, that the pixels show, each on its pixel's own ray: slow and exact, to
    make ground truth with.

    Args:
        camera: its distortion is ignored.
    Returns: NaN where a ray meets no known surface: above the horizon, beyond `prior.MAX_RANGE_HEIGHTS` heights, off
        the window, at holes, and where the camera is in the ground.
    """
    rays = _rays(terrain, camera, local_from_camera, np.arange(camera.width), np.arange(camera.height))
    fall = _exact_hits(terrain, rays)
    east, north, falling = rays.directions
    points = np.stack([east / falling * fall, north / falling * fall, -fall], axis=-1) + local_from_camera.translation
    x, y = rays.x0 + rays.slope_x * fall, rays.y0 + rays.slope_y * fall
    seen = rays.ahead & np.isfinite(fall) & _is_known(terrain, x, y)
    return np.where(seen[..., None], points, np.nan)


@dataclass(frozen=True, slots=True, eq=False)
class _Rays:
    """Rays (h, w) of a camera over the surface model's cells.

    Attributes:
        height_m: where they start.
        ahead: (h, w) whether they go down steeply enough to be followed.
        directions: east, north and fall, each (h, w) float64; of rays that are not ahead 0, 0 and 1.
        slope_x, slope_y: (h, w) cells per metre of fall.
        x0, y0: start, cells.
    """

    height_m: float
    ahead: BoolArray
    directions: tuple[FloatArray, FloatArray, FloatArray]
    slope_x: Float32Array
    slope_y: Float32Array
    x0: np.float32
    y0: np.float32

    def above(self, heights: Float32Array, fall: Float32Array | np.float32) -> Float32Array:
        """How far above a surface (cells by cells) rays are that have fallen so far, m."""
        below = cv2.remap(
            heights, self.x0 + self.slope_x * fall, self.y0 + self.slope_y * fall, cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REPLICATE,
        )  # fmt: skip
        return np.asarray(np.float32(self.height_m) - fall - below, dtype=np.float32)


def _rays(
    terrain: Terrain, camera: Camera, local_from_camera: Rigid3, columns: npt.ArrayLike, rows: npt.ArrayLike
) -> _Rays:
    """Through the pixels of some columns (w,) and rows (h,)."""
    grid, local = terrain.grid, terrain.local
    u, v = np.meshgrid(columns, rows)
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)], axis=-1)
    east, north, up = np.moveaxis(rays @ local_from_camera.rotation.T, -1, 0)
    ahead = -up * MAX_RANGE_HEIGHTS >= 1.0
    east, north, falling = np.where(ahead, east, 0.0), np.where(ahead, north, 0.0), np.where(ahead, -up, 1.0)
    centre = local_from_camera.translation
    x0, y0 = (np.float32(value) for value in grid.px_from_map(local.map_from_local(centre)[:2]))
    return _Rays(
        float(centre[2]),
        ahead,
        (east, north, falling),
        (east / falling * (local.grid_scale / grid.dx)).astype(np.float32),
        (north / falling * (local.grid_scale / grid.dy)).astype(np.float32),
        x0,
        y0,
    )


def _is_known(terrain: Terrain, x: Float32Array, y: Float32Array) -> BoolArray:
    """Whether the surface model has data at cells (h, w)."""
    grid = terrain.grid
    seen = (x >= 0) & (x <= grid.width - 1) & (y >= 0) & (y <= grid.height - 1)
    if terrain.known is not None:
        # A surface beside a hole is half invented.
        seen &= cv2.remap(terrain.known, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT) > 0.999
    return np.asarray(seen, dtype=np.bool_)


def _first_hits(terrain: Terrain, rays: _Rays) -> Float32Array:
    """Fall (h, w) at which the rays first meet the surface; those that do not meet it go to the lowest ground."""
    deepest = max(rays.height_m - terrain.lowest_m, 1e-3)
    # A ravine far below must not let rays start in the ground that the camera flies over.
    over_m = rays.height_m - terrain.typical_m if rays.height_m > terrain.typical_m else deepest
    highest = min(max(rays.height_m - terrain.highest_m, _CLEARANCE * over_m), deepest)
    run = np.hypot(rays.slope_x, rays.slope_y)
    cells = (deepest - highest) * float(np.percentile(run[rays.ahead], 90)) if rays.ahead.any() else 0.0
    steps = int(np.clip(math.ceil(cells / _CELLS_PER_STEP), _MIN_STEPS, _MAX_STEPS))
    falls = np.linspace(highest, deepest, steps + 1).astype(np.float32)
    fall = np.full(rays.slope_x.shape, falls[-1], np.float32)
    open_rays = rays.ahead.copy()
    before = rays.above(terrain.heights, falls[0])
    for low, high in pairwise(falls):
        after = rays.above(terrain.heights, high)
        hits = open_rays & (after <= 0)
        # Between two looks the ray and the surface are taken as straight.
        part = np.clip(before / np.maximum(before - after, np.float32(1e-6)), 0, 1)
        np.copyto(fall, low + (high - low) * part, where=hits)
        open_rays &= ~hits
        before = after
        if not open_rays.any():
            break
    reach = np.float32((deepest - highest) / steps)
    for _ in range(_POLISHES):
        moved = rays.above(terrain.heights, fall)
        np.copyto(fall, fall + moved, where=np.abs(moved) < reach)
    return fall


def _exact_hits(terrain: Terrain, rays: _Rays) -> Float32Array:
    """As `_first_hits`, looking at every half cell and then closing in; NaN where no ray comes from above to the
    surface."""
    # From above all there is to below it, so that every hit is a passage.
    highest = max(rays.height_m - terrain.highest_m - _MARGIN_M, 0.0)
    deepest = max(rays.height_m - terrain.lowest_m, 0.0) + _MARGIN_M
    run = np.hypot(rays.slope_x, rays.slope_y)
    cells = (deepest - highest) * float(np.percentile(run[rays.ahead], 99)) if rays.ahead.any() else 0.0
    steps = max(math.ceil(cells / _EXACT_CELLS_PER_STEP), _MIN_STEPS)
    falls = np.linspace(highest, deepest, steps + 1).astype(np.float32)
    open_rays = rays.ahead & (rays.above(terrain.heights, falls[0]) > 0)
    low = np.full(rays.slope_x.shape, np.nan, np.float32)
    for start, end in pairwise(falls):
        hits = open_rays & (rays.above(terrain.heights, end) <= 0)
        low[hits] = start
        open_rays &= ~hits
        if not open_rays.any():
            break
    high = low + np.float32((deepest - highest) / steps)
    for _ in range(_BISECTIONS):
        middle = np.float32(0.5) * (low + high)
        is_above = rays.above(terrain.heights, middle) > 0
        low, high = np.where(is_above, middle, low), np.where(is_above, high, middle)
    return np.asarray(np.float32(0.5) * (low + high), dtype=np.float32)


def _picture_for(terrain: Terrain, gsd_m: float) -> _Picture:
    best = terrain.pictures[0]
    for picture in terrain.pictures:
        if picture.grid.gsd_m <= _LEVEL_SLACK * gsd_m * terrain.local.grid_scale:
            best = picture
    return best


def _upsampled(nodes: Float32Array, camera: Camera) -> Float32Array:
    """Values (H, W) at the pixels, of values at the nodes."""
    size = nodes.shape[1] * _NODE_PX, nodes.shape[0] * _NODE_PX
    full = cv2.resize(nodes, size, interpolation=cv2.INTER_LINEAR)
    return np.asarray(full[_NODE_PX : _NODE_PX + camera.height, _NODE_PX : _NODE_PX + camera.width], dtype=np.float32)
