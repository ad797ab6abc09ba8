"""Makes OrthoLoC samples of photos with known poses over a map.

Paper, appendix "Data Pairing": what the photo shows is cast onto the surface; around it lies the region of interest,
disturbed at random; the rasters are cut there; all goes to a local frame that tells no place. Everything random follows
from a seed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

import cv2
import numpy as np

from ortholoc_edge.bench.evaluation import localize
from ortholoc_edge.bench.ground_truth import GroundTruthMatcher
from ortholoc_edge.bench.samples import Int32Array, Sample
from ortholoc_edge.errors import DatasetError
from ortholoc_edge.geometry.arrays import BoolArray, Float32Array, FloatArray, ImageArray
from ortholoc_edge.geometry.camera import Camera
from ortholoc_edge.geometry.grid import RasterGrid, bilinear
from ortholoc_edge.geometry.rigid import Rigid3
from ortholoc_edge.matching.sift import SiftMatcher
from ortholoc_edge.pipeline.prior import footprint
from ortholoc_edge.pipeline.render import Terrain, surface_points
from ortholoc_edge.tiles.georeference import LocalFrame
from ortholoc_edge.tiles.lattice import Bounds
from ortholoc_edge.tiles.store import MapStore, WindowTooLargeError
from ortholoc_edge.tiles.window import MapLayers

_DRAWS = 50
# A keypoint between points at depths that differ by more lies on an edge: it is on neither side.
_EDGE_PART = 0.01
# Of the DSM, where only the lowest ground is asked for.
_COARSE_M = 8.0
# A window of the surface may be so much coarser than asked for before a photo is given up.
_COARSEST = 8.0


@dataclass(frozen=True, slots=True)
class MakerOptions:
    """How samples are made; the defaults are the paper's where it tells.

    Attributes:
        raster_px: side of DOP and DSM.
        query_px: long side that larger photos are averaged down to.
        grid_step: the region is found on the photo's grid of every so many pixels.
        perturbation_m: each vertex of the region moves by up to so much east and north,
        perturbation_part: or by this part of the region's side, if that is less: a low flight sees less than 20 m.
        covisibility: least part of what the photo shows that must stay in the region.
        known: least part of the photo that must show the map.
        keypoints: of the photo, at most.
        mesh_side: the surface's mesh has so many vertices a side.
        seed: of everything drawn.
    """

    raster_px: int = 1024
    query_px: int = 1024
    grid_step: int = 8
    perturbation_m: float = 20.0
    perturbation_part: float = 0.3
    covisibility: float = 0.95
    known: float = 0.5
    keypoints: int = 1000
    mesh_side: int = 128
    seed: int = 0


class Scenery(Protocol):
    """A map, and what really stands there when the photos are taken. Map coordinates throughout."""

    def local_frame(self, map_from_camera: Rigid3) -> LocalFrame:
        """Of true metres, around a camera."""
        ...

    def points(self, camera: Camera, map_from_camera: Rigid3) -> FloatArray:
        """(H, W, 3) what each pixel shows; NaN where nothing is known."""
        ...

    def heights(self, xy_map: FloatArray) -> FloatArray:
        """(N,) of what stands at places (N, 2), m; NaN where nothing is known."""
        ...

    def layers(self, bounds_map: Bounds, gsd_m: float) -> MapLayers:
        """The map of at least a region, at pixels of about this size. Raises: DatasetError where there is none."""
        ...


class PackScenery:
    """Of an area pack.

    Args:
        store: the map that samples get.
        truth: what stood there when the photos were taken; None: what is on the map. Another one makes samples across
            domains.
    """

    def __init__(self, store: MapStore, truth: MapStore | None = None) -> None:
        self._store, self._truth = store, truth or store

    def local_frame(self, map_from_camera: Rigid3) -> LocalFrame:
        at = map_from_camera.translation
        return self._truth.pack.georeference.local_frame(at[:2], float(at[2]))

    def points(self, camera: Camera, map_from_camera: Rigid3) -> FloatArray:
        local = self.local_frame(map_from_camera)
        terrain = self._terrain(camera, map_from_camera, local)
        if terrain is None:
            return np.full((camera.height, camera.width, 3), np.nan)
        return local.map_from_local(surface_points(terrain, camera, local.local_from_map_pose(map_from_camera)))

    def heights(self, xy_map: FloatArray) -> FloatArray:
        return self._truth.heights(xy_map)

    def layers(self, bounds_map: Bounds, gsd_m: float) -> MapLayers:
        colour = self._store.read_colour(bounds_map, gsd_m)
        surface = None if colour is None else self._store.read_surface(colour.grid, 0.5 * gsd_m)
        if colour is None or surface is None:
            raise DatasetError(f"{self._store.pack.path}: no map at {bounds_map}; is this the flight's pack?")
        return MapLayers(colour.rgb, colour.grid, surface.dsm, surface.dsm_grid)

    def _terrain(self, camera: Camera, pose: Rigid3, local: LocalFrame) -> Terrain | None:
        """The surface that a camera may see, about as fine as its pixels; None where there is none."""
        ground_m = self._truth.ground_near(pose.translation[:2], _COARSE_M)
        if ground_m is None or ground_m >= pose.translation[2]:
            return None
        gsd_m = (float(pose.translation[2]) - ground_m) / camera.focal_px
        coarse = self._surface(_bounds(footprint(camera, pose, ground_m)), local, _COARSE_M)
        if coarse is None:
            return None
        # What is lower is seen farther off.
        outline = footprint(camera, pose, min(ground_m, coarse.lowest_m))
        return self._surface(_bounds(outline), local, 0.5 * gsd_m)

    def _surface(self, bounds: Bounds, local: LocalFrame, gsd_m: float) -> Terrain | None:
        finest_m = gsd_m
        while True:
            try:
                # The picture is not looked at: the coarsest will do.
                window = self._truth.read(bounds, self._truth.dop_grids[-1].gsd_m, gsd_m)
                return None if window is None else Terrain.of(window, local)
            except WindowTooLargeError as err:
                gsd_m *= 2.0
                if gsd_m > _COARSEST * finest_m:
                    raise DatasetError(f"the view is too wide for its height: {err}") from err


def _bounds(points: FloatArray) -> Bounds:
    (west, south), (east, north) = points.min(axis=0), points.max(axis=0)
    return float(west), float(south), float(east), float(north)


def make_sample(
    name: str,
    image: ImageArray,
    camera: Camera,
    map_from_camera: Rigid3,
    scenery: Scenery,
    options: MakerOptions,
    index: int = 0,
) -> Sample:
    """One sample.

    Args:
        name: of its file, as "L01_R0000".
        image: (H, W, 3) uint8 RGB, undistorted.
        index: of the photo: with the seed it decides what is drawn, whatever other photos there are.
    Raises: DatasetError for a photo that does not show enough of the map.
    """
    rng = np.random.default_rng([options.seed, index])
    image, camera = _query(image, camera, options.query_px)
    local = scenery.local_frame(map_from_camera)
    step = options.grid_step
    small = camera.resized(max(1, round(camera.width / step)), max(1, round(camera.height / step)))
    seen = local.local_from_map(scenery.points(small, map_from_camera))
    known = _known(seen)
    if known.mean() < options.known or np.count_nonzero(known) < 4:
        raise DatasetError(
            f"{name}: {100 * known.mean():.0f} % of the photo shows the map, {100 * options.known:.0f} % must; leave "
            "the photo out, or take a larger pack"
        )
    region = _region(seen[..., :2], known, options, rng)
    points = local.local_from_map(scenery.points(camera, map_from_camera))
    shown = points[_known(points)]
    # Paper, "Data anonymization": the frame's origin is a point of what is seen.
    origin = shown[int(rng.integers(len(shown)))]
    dop, dsm = _cut(scenery, local, region)
    vertices, faces = _mesh(scenery, local, region, options)
    pose = local.local_from_map_pose(map_from_camera)
    sample = Sample(
        name=name,
        image=image,
        camera=camera,
        map_from_camera=Rigid3(pose.rotation, pose.translation - origin),
        dop=dop,
        dsm=(dsm - origin[2]).astype(np.float32),
        grid=replace(region, west=region.west - float(origin[0]), top=region.top - float(origin[1])),
        point_map=(points - origin).astype(np.float32),
        keypoints=_keypoints(image, camera, pose, points, options) - origin,
        vertices=(vertices - origin).astype(np.float32),
        faces=faces,
    )
    refined = localize(sample, GroundTruthMatcher().match(sample))
    fitted = sample.map_from_camera if refined is None else refined.local_from_camera
    return replace(sample, map_from_camera_refined=fitted)


def _known(points: FloatArray) -> BoolArray:
    return np.asarray(np.isfinite(points).all(axis=2), dtype=np.bool_)


def _query(image: ImageArray, camera: Camera, long_px: int) -> tuple[ImageArray, Camera]:
    scale = long_px / max(camera.width, camera.height)
    if scale >= 1.0:
        return image, camera
    smaller = camera.resized(round(camera.width * scale), round(camera.height * scale))
    resized = cv2.resize(image, (smaller.width, smaller.height), interpolation=cv2.INTER_AREA)
    return np.asarray(resized, dtype=np.uint8), smaller


def _region(xy: FloatArray, known: BoolArray, options: MakerOptions, rng: np.random.Generator) -> RasterGrid:
    """The square around the disturbed quadrilateral of what is seen (h, w, 2), local m: the first draw that keeps
    enough of it in view, else the one of `_DRAWS` that keeps most."""
    corners = _quadrilateral(xy, known)
    x, y = corners.T
    side_m = float(np.sqrt(0.5 * abs(x @ np.roll(y, -1) - y @ np.roll(x, -1))))
    most_m = min(options.perturbation_m, options.perturbation_part * side_m)
    best, best_kept = _square(corners, options.raster_px), -1.0
    for _ in range(_DRAWS):
        grid = _square(corners + rng.uniform(-most_m, most_m, corners.shape), options.raster_px)
        px = grid.px_from_map(xy[known])
        kept = float(((px >= 0) & (px <= options.raster_px - 1)).all(axis=1).mean())
        if kept > best_kept:
            best, best_kept = grid, kept
        if kept >= options.covisibility:
            break
    return best


def _quadrilateral(xy: FloatArray, known: BoolArray) -> FloatArray:
    """(4, 2) what is seen nearest the photo's corners, in turn around it."""
    v, u = np.nonzero(known)
    ends = [int(np.argmin(u + v)), int(np.argmax(u - v)), int(np.argmax(u + v)), int(np.argmin(u - v))]
    return np.asarray(xy[v[ends], u[ends]], dtype=np.float64)


def _square(points: FloatArray, side_px: int) -> RasterGrid:
    """The square around points (N, 2), as wide as they are along their longer side."""
    low, high = points.min(axis=0), points.max(axis=0)
    side_m = float((high - low).max())
    west, top = 0.5 * (low + high) + 0.5 * side_m * np.array([-1.0, 1.0])
    return RasterGrid(side_px, side_px, float(west), float(top), side_m / side_px, -side_m / side_px)


def _cut(scenery: Scenery, local: LocalFrame, grid: RasterGrid) -> tuple[ImageArray, Float32Array]:
    """DOP and DSM on a grid of local metres; a frame of other metres than the map's is a grid of other pixels there."""
    corner = local.map_from_local([grid.west, grid.top, 0.0])
    scale = local.grid_scale
    there = replace(grid, west=float(corner[0]), top=float(corner[1]), dx=grid.dx * scale, dy=grid.dy * scale)
    # Beyond the edge too: the outermost pixels lie between pixels of the map.
    layers = scenery.layers(there.crop(-2, -2, grid.width + 4, grid.height + 4).bounds, there.gsd_m)
    u, v = np.meshgrid(np.arange(grid.width), np.arange(grid.height))
    xy_map = there.map_from_px(np.stack([u, v], axis=-1))
    at = layers.dop_grid.px_from_map(xy_map).astype(np.float32)
    dop = cv2.remap(layers.dop, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
    heights = bilinear(layers.dsm, layers.dsm_grid.px_from_map(xy_map.reshape(-1, 2)))
    return np.asarray(dop, dtype=np.uint8), heights.reshape(grid.height, grid.width).astype(np.float32)


def _mesh(
    scenery: Scenery, local: LocalFrame, grid: RasterGrid, options: MakerOptions
) -> tuple[FloatArray, Int32Array]:
    """The region's true surface: vertices (M, 3), local m, and faces (L, 3), counter-clockwise from above."""
    side = options.mesh_side
    across = np.linspace(0.0, grid.width - 1.0, side)
    u, v = np.meshgrid(across, across * (grid.height - 1.0) / (grid.width - 1.0))
    xy = grid.map_from_px(np.column_stack([u.ravel(), v.ravel()]))
    places = local.map_from_local(np.column_stack([xy, np.zeros(len(xy))]))
    vertices = np.column_stack([xy, scenery.heights(places[:, :2])])
    corner = (np.arange(side - 1)[:, None] * side + np.arange(side - 1)).ravel()
    right, below = corner + 1, corner + side
    faces = np.concatenate([np.column_stack([corner, below, right]), np.column_stack([right, below, below + 1])])
    known = np.isfinite(vertices[:, 2])
    faces = faces[known[faces].all(axis=1)]
    used = np.unique(faces)
    number = np.full(len(vertices), -1)
    number[used] = np.arange(len(used))
    return vertices[used], number[faces].astype(np.int32)


def _keypoints(
    image: ImageArray, camera: Camera, pose: Rigid3, points: FloatArray, options: MakerOptions
) -> FloatArray:
    """(N, 3) local m: SIFT of the photo, each on its ray at the depth of the surface there."""
    matcher = SiftMatcher(working_px=max(camera.width, camera.height), max_keypoints=options.keypoints)
    known = _known(points)
    px = matcher.extract(np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), dtype=np.uint8), known).keypoints_px
    depth = pose.inverse().apply(points)[..., 2]
    # Of a plane the inverse is linear in the picture.
    nearness = bilinear((1.0 / depth).astype(np.float32), px)
    column, row = np.floor(np.clip(px, 0, (camera.width - 2, camera.height - 2))).astype(np.intp).T
    around = np.stack([depth[row + below, column + right] for below in (0, 1) for right in (0, 1)])
    with np.errstate(invalid="ignore"):
        smooth = np.ptp(around, axis=0) < _EDGE_PART * around.min(axis=0)
    kept = np.flatnonzero(smooth & np.isfinite(nearness))
    return pose.apply(camera.unproject(px[kept]) / nearness[kept, None])
