"""The orthophoto brought near to what the camera sees, before anything is matched.

With a prior pose the perspective gap that AdHoP closes after a first match is closed before it: the orthophoto
is warped into the predicted view through the plane that fits the surface model best. Without one the region is
shown in four quarter turns, as the paper does for matchers that are not invariant to rotation.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np

from ortholoc_edge.geometry import homography
from ortholoc_edge.geometry.arrays import BoolArray, FloatArray, ImageArray
from ortholoc_edge.geometry.camera import Camera
from ortholoc_edge.geometry.grid import bilinear
from ortholoc_edge.geometry.rigid import Rigid3
from ortholoc_edge.pipeline.prior import MAX_RANGE_HEIGHTS, PosePrior
from ortholoc_edge.tiles.georeference import LocalFrame
from ortholoc_edge.tiles.window import MapWindow, SurfaceWindow

_PLANE_SAMPLES = 24
# A widened view shrinks in the matcher; XFeat bears a factor of two (matchers.md, "Rotation" and "Scale").
_MAX_WIDENING = 0.5
# Of matching and of the surface model, beyond what the prior explains.
_SHIFT_FLOOR_PX = 8.0


@dataclass(frozen=True, slots=True, eq=False)
class ReferenceView:
    """A picture of the map to match the frame against.

    Attributes:
        image: (H, W) uint8 grey.
        valid: (H, W) bool, False where it shows no map.
        view_from_dop: (3, 3) homography from the window's DOP pixels to this picture's; its third coordinate is
            positive for what lies in front of the camera.
        margin_px: of a predicted view, by which it shows more than the camera on every side.
        max_shift_px: of a predicted view, how far from where it is predicted a thing may lie in the frame, both
            at the working size; infinite where nothing is predicted.
        can_widen: of a predicted view: the prior is uncertain enough for it to show more.
    """

    image: ImageArray
    valid: BoolArray
    view_from_dop: FloatArray
    margin_px: int = 0
    max_shift_px: float = math.inf
    can_widen: bool = False

    @property
    def working_from_dop(self) -> FloatArray:
        """(3, 3) of a predicted view, from DOP pixels to the frame at the working size."""
        shift = np.array([[1.0, 0.0, -self.margin_px], [0.0, 1.0, -self.margin_px], [0.0, 0.0, 1.0]])
        return np.asarray(shift @ self.view_from_dop)

    def dop_px(self, view_px: FloatArray) -> FloatArray:
        """DOP pixels (N, 2) of pixels of this picture; AdHoP's inverse mapping."""
        # The inverse inherits the sign: what is in front stays positive, even where the horizon lies below the
        # middle of the picture.
        return homography.warp_points(np.linalg.inv(self.view_from_dop), view_px)


def warped(
    dop_grey: ImageArray, dop_valid: BoolArray, view_from_dop: FloatArray, width: int, height: int
) -> ReferenceView:
    """The orthophoto through a homography, and where that shows map."""
    size = (width, height)
    image = cv2.warpPerspective(dop_grey, view_from_dop, size, flags=cv2.INTER_LINEAR)
    valid = cv2.warpPerspective(dop_valid.astype(np.uint8), view_from_dop, size, flags=cv2.INTER_NEAREST)
    return ReferenceView(np.asarray(image, dtype=np.uint8), valid.astype(bool), view_from_dop)


@dataclass(frozen=True, slots=True, eq=False)
class GroundPlane:
    """The plane ``z = a + b x + c y`` (local metres) that fits the surface under a footprint best.

    Attributes:
        abc: (3,).
        relief_m: 95th percentile of the surface's distance from it.
    """

    abc: FloatArray
    relief_m: float


def ground_plane(window: MapWindow | SurfaceWindow, local: LocalFrame, outline_map: FloatArray) -> GroundPlane | None:
    """The plane through the surface model under a footprint.

    Twice re-weighted by the median residual, so that roofs and trees bend it little.

    Args:
        outline_map: (K, 2) points that span the footprint.
    Returns: None where the surface model has no data.
    """
    low, high = outline_map.min(axis=0), outline_map.max(axis=0)
    x, y = np.meshgrid(np.linspace(low[0], high[0], _PLANE_SAMPLES), np.linspace(low[1], high[1], _PLANE_SAMPLES))
    xy_map = np.column_stack([x.ravel(), y.ravel()])
    heights = bilinear(window.dsm, window.dsm_grid.px_from_map(xy_map))
    known = np.isfinite(heights)
    if np.count_nonzero(known) < 3:
        return None
    points = local.local_from_map(np.column_stack([xy_map[known], heights[known]]))
    centre = points.mean(axis=0)
    design = np.column_stack([np.ones(len(points)), points[:, :2] - centre[:2]])
    plane = np.array([float(np.median(points[:, 2])), 0.0, 0.0])
    residuals = np.abs(points[:, 2] - plane[0])
    weights = np.ones(len(points))
    # Where little of the surface is known, its slope is not: then the plane stays level.
    for _ in range(3 if len(points) >= _PLANE_SAMPLES else 0):
        root = np.sqrt(weights)
        plane, *_ = np.linalg.lstsq(design * root[:, None], points[:, 2] * root, rcond=None)
        residuals = np.abs(points[:, 2] - design @ plane)
        weights = 1.0 / np.maximum(residuals, max(float(np.median(residuals)), 0.05))
    a = plane[0] - plane[1] * centre[0] - plane[2] * centre[1]
    return GroundPlane(np.array([a, plane[1], plane[2]]), float(np.percentile(residuals, 95)))


def view_homography(
    window: MapWindow | SurfaceWindow, local: LocalFrame, plane: FloatArray, camera: Camera, local_from_camera: Rigid3
) -> FloatArray:
    """(3, 3) from DOP pixels to pixels of a pinhole camera, for ground on a plane ``z = a + b x + c y``."""
    grid = window.dop_grid.map_from_px_matrix()
    shrink = 1.0 / local.grid_scale
    xy_local = np.array(
        [
            [shrink, 0.0, -local.origin_easting_m * shrink],
            [0.0, shrink, -local.origin_northing_m * shrink],
            [0.0, 0.0, 1.0],
        ]
    )
    on_plane = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [plane[1], plane[2], plane[0]], [0.0, 0.0, 1.0]])
    inverse = local_from_camera.inverse()
    camera_from_local = np.column_stack([inverse.rotation, inverse.translation])
    return np.asarray(camera.matrix @ camera_from_local @ on_plane @ xy_local @ grid, dtype=np.float64)


def predicted_view(
    window: MapWindow,
    local: LocalFrame,
    plane: GroundPlane,
    camera: Camera,
    prior: PosePrior,
    widen: bool,
) -> ReferenceView:
    """The orthophoto as the camera should see it.

    Args:
        camera: pinhole at the working size.
        widen: show somewhat more where the prediction is uncertain.
    """
    local_from_camera = local.local_from_map_pose(prior.map_from_camera)
    wider = _margin_px(camera, local_from_camera, plane, prior)
    margin = wider if widen else 0
    wide = camera.padded(margin)
    matrix = view_homography(window, local, plane.abc, wide, local_from_camera)
    view = warped(window.dop_grey, window.dop_valid, matrix, wide.width, wide.height)
    ahead = _sees_ground(wide, local_from_camera, plane.abc)
    return replace(
        view,
        valid=view.valid if ahead is None else view.valid & ahead,
        margin_px=margin,
        max_shift_px=max_shift_px(camera, local_from_camera, plane, prior),
        can_widen=wider > 0,
    )


def _margin_px(camera: Camera, local_from_camera: Rigid3, plane: GroundPlane, prior: PosePrior) -> int:
    """By how much more a widened view shows, on every side."""
    # A shift of a tenth of the picture costs overlap that can be spared; beyond it, look wider.
    widening = 0.5 * _predicted_shift(camera, local_from_camera, plane, prior) / camera.width - 0.1
    return round(min(max(widening, 0.0), _MAX_WIDENING) * max(camera.width, camera.height))


def max_shift_px(camera: Camera, local_from_camera: Rigid3, plane: GroundPlane, prior: PosePrior) -> float:
    """How far from where it is predicted a thing may lie in the picture."""
    return _predicted_shift(camera, local_from_camera, plane, prior) + _SHIFT_FLOOR_PX


def _predicted_shift(camera: Camera, local_from_camera: Rigid3, plane: GroundPlane, prior: PosePrior) -> float:
    """Three sigmas of how far in the picture, px, the prior's errors and the relief move things."""
    axis = local_from_camera.rotation[:, 2]
    below_m = float(plane.abc @ np.append(1.0, local_from_camera.translation[:2]))
    height_m = max(float(local_from_camera.translation[2]) - below_m, 1e-3)
    distance_m = height_m / max(-float(axis[2]), 1.0 / MAX_RANGE_HEIGHTS)
    radius_px = 0.5 * math.hypot(camera.width, camera.height)
    sideways = math.hypot(camera.focal_px * prior.position_sigma_m / distance_m, camera.focal_px * prior.tilt_sigma_rad)
    turn = radius_px * prior.heading_sigma_rad
    zoom = radius_px * prior.height_sigma_m / height_m
    return float(3.0 * math.hypot(sideways, turn, zoom) + radius_px * plane.relief_m / height_m)


def _sees_ground(camera: Camera, local_from_camera: Rigid3, plane: FloatArray) -> BoolArray | None:
    """Which pixels see the plane in front of the camera and within range; None if all do.

    Beyond the horizon a homography shows the ground behind the camera, upside down.
    """
    normal = np.array([-plane[1], -plane[2], 1.0])
    drop = float(normal @ local_from_camera.translation - plane[0])
    in_camera = local_from_camera.rotation.T @ normal
    u = (np.arange(camera.width) - camera.cx) / camera.fx
    v = (np.arange(camera.height) - camera.cy) / camera.fy
    falling = -(in_camera[0] * u[None, :] + in_camera[1] * v[:, None] + in_camera[2])
    if falling.min() * MAX_RANGE_HEIGHTS >= 1.0 and drop > 0:
        return None
    return np.asarray((falling * MAX_RANGE_HEIGHTS >= 1.0) & (drop > 0))


def quarter_turns(window: MapWindow) -> list[ReferenceView]:
    """The window as it is and turned by 90, 180 and 270 degrees counter-clockwise (paper: "RI")."""
    bottom, right = window.dop_grid.height - 1.0, window.dop_grid.width - 1.0
    from_dop = (
        np.eye(3),
        np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, right], [0.0, 0.0, 1.0]]),
        np.array([[-1.0, 0.0, right], [0.0, -1.0, bottom], [0.0, 0.0, 1.0]]),
        np.array([[0.0, -1.0, bottom], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]),
    )
    return [
        ReferenceView(
            np.ascontiguousarray(np.rot90(window.dop_grey, turns)),
            np.ascontiguousarray(np.rot90(window.dop_valid, turns)),
            matrix,
        )
        for turns, matrix in enumerate(from_dop)
    ]
