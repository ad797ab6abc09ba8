"""OrthoLoC samples of the generated places of `crossdomain`, in all three kinds, with a truth that is exact: the points
that the pixels show, façades too, are those that the picture was drawn from."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ortholoc_edge.bench.sample_maker import MakerOptions, make_sample
from ortholoc_edge.bench.samples import Sample, SampleKind
from ortholoc_edge.errors import DatasetError
from ortholoc_edge.geometry.arrays import FloatArray
from ortholoc_edge.geometry.camera import Camera
from ortholoc_edge.geometry.grid import bilinear
from ortholoc_edge.geometry.rigid import Rigid3
from ortholoc_edge.tiles.georeference import LocalFrame
from ortholoc_edge.tiles.lattice import Bounds
from ortholoc_edge.tiles.window import MapLayers
from ortholoc_sim.camera import Renderer
from ortholoc_sim.crossdomain import CrossDomain, Kind

# Parts of what a point is off that it is moved by, one after the other: the whole overshoots on steep crowns.
_SETTLINGS = (1.0, 0.5, 0.25, 0.12, 0.5, 0.25, 0.12)

KINDS = {SampleKind.SAME: Kind.SAME, SampleKind.XDOP: Kind.XDOP, SampleKind.XDOPDSM: Kind.XDOPDSM}


class SimulatedScenery:
    """A `sample_maker.Scenery` of a generated place: the map as it was surveyed, the surface as it is flown over."""

    def __init__(self, domain: CrossDomain, layers: MapLayers, renderer: Renderer) -> None:
        self._domain, self._layers, self._renderer = domain, layers, renderer

    def local_frame(self, map_from_camera: Rigid3) -> LocalFrame:
        # The scale that the photos are drawn with: one for all of the place.
        at = map_from_camera.translation
        return LocalFrame(float(at[0]), float(at[1]), self._domain.placement.grid_scale)

    def points(self, camera: Camera, map_from_camera: Rigid3) -> FloatArray:
        points = self._renderer.view(camera, map_from_camera).points_map
        self._settle(points, map_from_camera.translation)
        west, south, east, north = self._layers.dop_grid.bounds
        with np.errstate(invalid="ignore"):
            # The renderer goes on beyond the place with what is at its edge.
            points[~((points[..., :2] > (west, south)) & (points[..., :2] < (east, north))).all(axis=2)] = np.nan
        return points

    def heights(self, xy_map: FloatArray) -> FloatArray:
        scene, place = self._renderer.scene, self._domain.placement
        return bilinear(scene.surface, scene.spec.grid.px_from_map(xy_map - (place.west_m, place.south_m)))

    def _settle(self, points: FloatArray, eye: FloatArray) -> None:
        """Move points (H, W, 3) along their rays onto the surface: the renderer's end a few millimetres below it, which
        no picture shows but poses by thousands of points do."""
        off_m = self._above(points)
        for share in _SETTLINGS:
            part = share * off_m / (points[..., 2] - eye[2])
            moved = points + (points - eye) * part[..., None]
            moved_off_m = self._above(moved)
            # Up a wall may be away from it.
            better = np.abs(moved_off_m) < np.abs(off_m)
            points[better], off_m[better] = moved[better], moved_off_m[better]

    def _above(self, points: FloatArray) -> FloatArray:
        """(H, W) how far the surface is above points (H, W, 3), m."""
        heights = self.heights(points[..., :2].reshape(-1, 2)).reshape(points.shape[:2])
        return np.asarray(heights - points[..., 2], dtype=np.float64)

    def layers(self, bounds_map: Bounds, gsd_m: float) -> MapLayers:
        return self._layers


def simulated_samples(
    domain: CrossDomain, count: int, location: str, options: MakerOptions
) -> Iterator[Sample | DatasetError]:
    """Samples of the first ``count`` photos of a place, or why there is none of one. Place and poses follow from the
    domain's seed, so the kinds of one seed differ in the map and the look alone.

    Raises: ValueError for a place too small for its photos.
    """
    (kind,) = (kind for kind, sims in KINDS.items() if sims is domain.kind)
    poses = domain.poses(count)
    layers, renderer = domain.map_and_renderer()
    scenery = SimulatedScenery(domain, layers, renderer)
    for index, pose in enumerate(poses):
        image = domain.photo(renderer, pose, index).image
        try:
            yield make_sample(f"{location}_{kind}{index:04d}", image, domain.camera, pose, scenery, options, index)
        except DatasetError as error:
            yield error
