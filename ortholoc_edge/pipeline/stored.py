"""Matching with the map's precomputed features: the frame is brought to the map, not the map to the frame.

XFeat bears a turn of about 30 degrees, and stored features look north. So the frame is rectified onto the map's grid
by the predicted homography, and the network runs on that alone; no orthophoto is decoded. What AdHoP gains by warping
the orthophoto again is gained here in two ways: where the first round does not convince, the frame is rectified again
by its homography; and then every stored feature is looked for once more, close to where the pose says that it is.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ortholoc_edge.geometry import homography
from ortholoc_edge.geometry.arrays import BoolArray, Float32Array, FloatArray, ImageArray, IntArray
from ortholoc_edge.geometry.camera import Camera
from ortholoc_edge.matching.adhop import fit_homography
from ortholoc_edge.matching.contrast import even_contrast
from ortholoc_edge.matching.nearest import mutual_nearest
from ortholoc_edge.matching.types import Matches, UnscaledMatcher
from ortholoc_edge.pipeline import precondition
from ortholoc_edge.pipeline.outcome import Reason
from ortholoc_edge.pipeline.prior import PosePrior
from ortholoc_edge.pipeline.rectify import RectifiedFrame, rectified
from ortholoc_edge.pipeline.rounds import RejectedError, Round, Scene
from ortholoc_edge.pipeline.trace import Trace
from ortholoc_edge.pose.lift import lift
from ortholoc_edge.tiles.features import FeatureIndex, StoredFeatures
from ortholoc_edge.tiles.lattice import Bounds
from ortholoc_edge.tiles.store import MapStore, WindowTooLargeError
from ortholoc_edge.tiles.window import SurfaceWindow

# Of a canvas, over the square of the matcher's working size; where more is needed, the next coarser scale is used. A
# frame of 640 x 480 px at 45 degrees takes 1.5 on a grid as fine as itself. On seneca at 20 cm frames of 14 cm take 1.9
# to 4.1 on the grid of 10 cm: a limit of 3 sends a third to that of 20 cm, and the median error rises from 0.25 to
# 0.45 m.
_MAX_CANVAS = 4.1
# Of a stored descriptor and a full one to match; 0.82 of two full ones, of which quantising takes 5 %.
_MIN_COSINE = 0.76
# Of looking again: distance at the working size, and cosine, which is lower than where all pairs compete.
_NEAR_PX = 4.0
_NEAR_COSINE = 0.7
_NEAR_ROUNDS = 2
_MIN_INLIERS = 20
# Fewer can't pass the gate.
_MIN_STORED = 30
_SCALES_TRIED = 3


@dataclass(frozen=True, slots=True, eq=False)
class Attempt:
    """A scene with its best round so far, and what looking again needs.

    Attributes:
        stored: features of the map that the prior allows in the frame.
        frame_px: (N, 2) the frame's keypoints without distortion, and descriptors: (N, D) theirs.
    """

    scene: Scene
    found: Round
    stored: StoredFeatures
    frame_px: FloatArray
    descriptors: Float32Array


class StoredMatching:
    """Camera, matcher and a pack's features.

    Args:
        working: pinhole camera of the size that the matcher sees frames at.
        judge: lifts and solves matches (undistorted frame pixels, grid pixels) in a scene.
    """

    def __init__(
        self,
        camera: Camera,
        working: Camera,
        matcher: UnscaledMatcher,
        store: MapStore,
        index: FeatureIndex,
        judge: Callable[[Matches, Scene], Round],
    ) -> None:
        self._camera, self._working = camera, working
        self._matcher, self._store, self._index, self._judge = matcher, store, index, judge
        self._max_pixels = round(_MAX_CANVAS * matcher.working_px**2)
        self._frame_px_per_working = camera.width / working.width

    def attempt(
        self,
        grey: ImageArray,
        prior: PosePrior,
        bounds: Bounds,
        outline: FloatArray,
        ground_m: float,
        gsd_m: float,
        trace: Trace,
    ) -> Attempt:
        """Match a frame where a prior says that it is.

        Args:
            grey: (H, W) as the camera gives it.
            bounds, outline: where to search, and the predicted footprint (K, 2).
            gsd_m: of the frame at the working size.
        Raises: RejectedError if there is nothing to match with.
        """
        finest = self._index.scale_for(gsd_m)
        for scale in range(finest, min(finest + _SCALES_TRIED, len(self._index.grids))):
            with trace.stage("map_window"):
                surface, low = self._surface(bounds, scale)
            with trace.stage("view"):
                west, south, east, north = bounds
                centre = ((west + east) / 2, (south + north) / 2)
                local = self._store.pack.georeference.local_frame(centre, ground_m)
                plane = precondition.ground_plane(surface, local, outline)
                if plane is None:
                    raise RejectedError(Reason.MAP_NODATA, "the surface model has no data under the predicted view")
                pose = local.local_from_map_pose(prior.map_from_camera)
                frame_from_grid, working_from_grid = (
                    precondition.view_homography(surface, local, plane.abc, camera, pose)
                    for camera in (self._camera.pinhole(), self._working)
                )
            with trace.stage("rectify"):
                canvas = rectified(grey, self._camera, frame_from_grid, self._max_pixels)
            if canvas is None:
                continue
            with trace.stage("map_window"):
                stored = self._index.read(bounds, scale)
                stored = StoredFeatures(stored.px - low, stored.codes)
                shift_px = precondition.max_shift_px(self._working, pose, plane, prior)
                stored = self._in_frame(stored, frame_from_grid, shift_px * self._frame_px_per_working)
            return self._matched(canvas, stored, Scene(surface, local, ground_m, working_from_grid, shift_px), trace)
        raise RejectedError(Reason.PRIOR_TOO_WIDE, "the predicted view is too oblique for stored features")

    def _surface(self, bounds: Bounds, scale: int) -> tuple[SurfaceWindow, IntArray]:
        """Heights in a region, and the pixel (2,) of the scale's grid that is (0, 0) of the window's: small numbers
        make a homography that is well conditioned."""
        grid = self._index.grids[scale]
        west, south, east, north = bounds
        low = np.floor(grid.px_from_map((west, north))).astype(np.intp)
        width, height = np.ceil(grid.px_from_map((east, south))).astype(np.intp) - low + 1
        near = grid.crop(int(low[0]), int(low[1]), int(width), int(height))
        try:
            surface = self._store.read_surface(near, 2.0 * grid.gsd_m)
        except WindowTooLargeError as error:
            # Of one hypothesis; narrower ones, or the network, may do.
            raise RejectedError(Reason.PRIOR_TOO_WIDE, str(error)) from error
        if surface is None:
            raise RejectedError(
                Reason.OUTSIDE_MAP,
                f"({west:.0f}, {south:.0f}) to ({east:.0f}, {north:.0f}) does not meet the surface model",
            )
        return surface, low

    def rectified_again(self, grey: ImageArray, first: Attempt, threshold_px: float, trace: Trace) -> Attempt:
        """The paper's AdHoP with the roles changed: the first attempt unless the second's mean error is smaller."""
        matches = first.found.matches
        fitted = fit_homography(matches.map_px, matches.query_px, threshold_px)
        if fitted is None:
            return first
        stored = self._in_frame(first.stored, fitted[0], _NEAR_PX * self._frame_px_per_working)
        canvas = rectified(grey, self._camera, fitted[0], self._max_pixels)
        if canvas is None or len(stored.px) < _MIN_STORED:
            return first
        second = self._matched(canvas, stored, first.scene, trace)
        return second if second.found.mean_error_px < first.found.mean_error_px else first

    def looked_again(self, attempt: Attempt, trace: Trace) -> Round | None:
        """Each stored feature's most similar keypoint close to where the pose puts it: twice the inliers.

        Near a wrong pose this finds pairs that agree with it, so the round before must have passed the gate.
        Returns: None unless there are more inliers.
        """
        with trace.stage("adhop"):
            best = attempt.found
            lifted = lift(attempt.stored.px, attempt.scene.window)
            points = attempt.scene.local.local_from_map(lifted.points_map)
            stored = attempt.stored.take(lifted.kept)
            descriptors = stored.descriptors()
            for _ in range(_NEAR_ROUNDS):
                if best.estimate is None or best.inliers < _MIN_INLIERS:
                    break
                in_camera = best.estimate.local_from_camera.inverse().apply(points)
                expected = best.estimate.camera.pinhole().project(in_camera)
                i, j = _nearest_close(
                    expected, descriptors, attempt.frame_px, attempt.descriptors,
                    _NEAR_PX * self._frame_px_per_working,
                )  # fmt: skip
                found = self._judge(Matches(attempt.frame_px[j], stored.px[i]), attempt.scene)
                if found.inliers <= best.inliers:
                    break
                best = found
        return None if best is attempt.found else best

    def _in_frame(self, stored: StoredFeatures, frame_from_grid: FloatArray, margin_px: float) -> StoredFeatures:
        px = homography.warp_points(frame_from_grid, stored.px)
        limit = self._camera.width - 0.5 + margin_px, self._camera.height - 0.5 + margin_px
        # NaN, a point beyond the horizon, compares as False.
        inside: BoolArray = np.all((px >= -0.5 - margin_px) & (px <= limit), axis=1)
        return stored.take(inside)

    def _matched(self, canvas: RectifiedFrame, stored: StoredFeatures, scene: Scene, trace: Trace) -> Attempt:
        if len(stored.px) < _MIN_STORED:
            raise RejectedError(
                Reason.FEW_MATCHES, "stored features in the predicted view", len(stored.px), _MIN_STORED
            )
        with trace.stage("rectify"):
            even = even_contrast(canvas.image, canvas.valid)
        with trace.stage("query_features"):
            found = self._matcher.extract_unscaled(even, canvas.valid)
        with trace.stage("match"):
            i, j = mutual_nearest(found.descriptors, stored.descriptors(), _MIN_COSINE)
            frame_px = homography.warp_points(canvas.frame_from_canvas, found.keypoints_px)
            pairs = Matches(frame_px[i], stored.px[j])
        with trace.stage("pose"):
            return Attempt(scene, self._judge(pairs, scene), stored, frame_px, found.descriptors)


def _nearest_close(
    expected_px: FloatArray, stored: Float32Array, frame_px: FloatArray, descriptors: Float32Array, radius_px: float
) -> tuple[IntArray, IntArray]:
    """Pairs (stored, frame) that are each other's most similar within a distance of where they are expected."""
    # Cells of the radius' side: a pair is in the same one or in neighbours.
    cells: dict[tuple[int, int], list[int]] = {}
    for index, (x, y) in enumerate(np.floor(frame_px / radius_px).astype(int).tolist()):
        cells.setdefault((x, y), []).append(index)
    pairs: list[tuple[int, int]] = []
    visible = np.flatnonzero(np.isfinite(expected_px).all(axis=1))
    for index, (x, y) in zip(
        visible.tolist(), np.floor(expected_px[visible] / radius_px).astype(int).tolist(), strict=True
    ):
        for column in (x - 1, x, x + 1):
            for row in (y - 1, y, y + 1):
                pairs.extend((index, other) for other in cells.get((column, row), ()))
    i, j = np.array(pairs, dtype=np.intp).reshape(-1, 2).T
    close = np.linalg.norm(expected_px[i] - frame_px[j], axis=1) <= radius_px
    i, j = i[close], j[close]
    cosine = np.einsum("nc,nc->n", stored[i], descriptors[j])
    best_stored, best_frame = np.full(len(stored), -1.0, np.float32), np.full(len(descriptors), -1.0, np.float32)
    np.maximum.at(best_stored, i, cosine)
    np.maximum.at(best_frame, j, cosine)
    kept = (cosine >= _NEAR_COSINE) & (cosine >= best_stored[i]) & (cosine >= best_frame[j])
    return i[kept], j[kept]
