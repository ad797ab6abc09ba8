"""Robust pose from 2D-3D matches: PoseLib's LO-RANSAC, then a Huber refinement that knows its covariance. Where
PoseLib has no wheel (64-bit Arm) OpenCV's USAC stands in.

Paper, section "Initial Camera Calibration / Localization" and appendix "Optimization of Camera Parameters".
Points are in a local metric frame (`tiles.georeference.LocalFrame`), so that float64 loses nothing and lengths
are true metres.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from ortholoc_edge.geometry import covariance as cov
from ortholoc_edge.geometry.arrays import BoolArray, FloatArray
from ortholoc_edge.geometry.camera import Camera
from ortholoc_edge.geometry.rigid import Rigid3
from ortholoc_edge.pose.adjust import linearised, moved

try:
    import poselib
except ImportError:
    poselib = None

# Which robust solver runs; it is reported with every result, since it changes accuracy.
SOLVER = "opencv-usac" if poselib is None else "poselib"

# The paper's inlier threshold belongs to its images of about 1024 px; other sizes scale it.
THRESHOLD_PX = 5.0
THRESHOLD_REFERENCE_PX = 1024.0
# matchers.md section 5: 100 instead of PoseLib's 1000 halves the time and loses nothing.
_MIN_ITERATIONS = 100
_MAX_ITERATIONS = 10_000
_SUCCESS_PROBABILITY = 0.9999
_LM_ITERATIONS = 30
_MINIMUM_POINTS = 6
# Of the inliers in the image, in inlier thresholds.
_MINIMUM_EXTENT = 4.0
# Matches closer than a fifth of the long side share the errors of a patch of the map and of the camera's model.
_CLUSTERS_ACROSS = 5
# Errors that vary slowly over the image are partly absorbed by the pose and so never show in the residuals.
# Without this factor on the variance the normalised error squared averages 8 to 15 on the real flights instead
# of 6 (docs/benchmarks.md, "Covariance").
_ABSORBED_ERROR_FACTOR = 2.5


@dataclass(frozen=True, slots=True, eq=False)
class PoseEstimate:
    """A pose in the local frame.

    Attributes:
        local_from_camera: camera centre in true metres; map axes.
        camera: intrinsics that belong to it (the given ones, or calibrated).
        covariance: (6, 6), see `geometry.covariance`.
        inliers: (N,) bool over the given matches.
        errors_px: (N,) reprojection errors of all given matches; infinite behind the camera.
        rms_px: root mean square over the inliers.
        focal_sigma_px: 1-sigma of the focal length; None if it was given.
        focal_height_correlation: between focal length and distance along the optical axis; None likewise.
    """

    local_from_camera: Rigid3
    camera: Camera
    covariance: FloatArray
    inliers: BoolArray
    errors_px: FloatArray
    rms_px: float
    focal_sigma_px: float | None = None
    focal_height_correlation: float | None = None


def threshold_px(camera: Camera) -> float:
    """The paper's 5 px, scaled to the size of the image."""
    return THRESHOLD_PX * max(camera.width, camera.height) / THRESHOLD_REFERENCE_PX


def solve(
    points_local: FloatArray, query_px: FloatArray, camera: Camera, *, max_error_px: float, seed: int = 0
) -> PoseEstimate | None:
    """Pose of a camera with known intrinsics.

    Args:
        points_local: (N, 3) m.
        query_px: (N, 2) pixels of the image without distortion (`Camera.undistorted_px`).
        camera: its distortion is ignored.
        max_error_px: inlier threshold.
        seed: of the RANSAC; the same matches and seed give the same pose.
    Returns: None where no pose is determined: too few points, none found, or a singular problem.
    """
    if len(points_local) < _MINIMUM_POINTS:
        return None
    start = _ransac(points_local, query_px, camera, max_error_px, seed)
    return None if start is None else refine(points_local, query_px, camera, start, max_error_px=max_error_px)


def refine(
    points_local: FloatArray,
    query_px: FloatArray,
    camera: Camera,
    local_from_camera: Rigid3,
    *,
    max_error_px: float,
    free_focal: bool = False,
) -> PoseEstimate | None:
    """Levenberg-Marquardt with the Huber loss on the inliers of a pose (and of the focal length if it is free),
    inliers chosen again once the pose has moved.

    Returns: None if the inliers do not determine the parameters.
    """
    pose, focal_scale = local_from_camera, 1.0
    inliers = np.zeros(len(points_local), dtype=bool)
    for _ in range(2):
        inliers = _errors(points_local, query_px, _zoomed(camera, focal_scale), pose) <= max_error_px
        if np.count_nonzero(inliers) < _MINIMUM_POINTS:
            return None
        pose, focal_scale = _levenberg_marquardt(
            points_local[inliers], query_px[inliers], camera, pose, focal_scale, max_error_px, free_focal
        )
    solved = _zoomed(camera, focal_scale)
    errors = _errors(points_local, query_px, solved, pose)
    inliers = errors <= max_error_px
    if np.count_nonzero(inliers) < _MINIMUM_POINTS:
        return None
    if np.ptp(query_px[inliers], axis=0).max() < _MINIMUM_EXTENT * max_error_px:
        # Seen from far enough away any points fall on one spot.
        return None
    residuals, jacobian = _linearised(points_local[inliers], query_px[inliers], solved, pose, free_focal)
    side = max(camera.width, camera.height) / _CLUSTERS_ACROSS
    column, row = np.floor(query_px[inliers] / side).astype(np.intp).T
    weights = _huber_weights(residuals, _huber_scale(residuals, max_error_px))
    try:
        full = _ABSORBED_ERROR_FACTOR * cov.clustered(jacobian, residuals, weights, column * 10_000 + row)
    except np.linalg.LinAlgError:
        return None
    if not np.isfinite(full).all() or np.any(np.diag(full) <= 0):
        return None
    focal_sigma = correlation = None
    if free_focal:
        # The seventh parameter is the logarithm of the focal length.
        focal_sigma = float(solved.focal_px * np.sqrt(full[6, 6]))
        axis = pose.rotation[:, 2]
        along = float(axis @ full[:3, :3] @ axis)
        correlation = float(axis @ full[:3, 6] / np.sqrt(along * full[6, 6]))
    return PoseEstimate(
        pose,
        solved,
        full[:6, :6],
        inliers,
        errors,
        float(np.sqrt(np.mean(errors[inliers] ** 2))),
        focal_sigma,
        correlation,
    )


def _ransac(points: FloatArray, px: FloatArray, camera: Camera, max_error_px: float, seed: int) -> Rigid3 | None:
    origin = points.mean(axis=0)
    find = _ransac_opencv if poselib is None else _ransac_poselib
    camera_from_centred = find(points - origin, px, camera, max_error_px, seed)
    if camera_from_centred is None or not np.isfinite(camera_from_centred).all():
        return None
    turn = camera_from_centred[:, :3]
    return Rigid3(turn.T, origin - turn.T @ camera_from_centred[:, 3])


def _ransac_poselib(
    points: FloatArray, px: FloatArray, camera: Camera, max_error_px: float, seed: int
) -> FloatArray | None:
    pose, info = poselib.estimate_absolute_pose(
        px,
        points,
        {
            "model": "PINHOLE",
            "width": camera.width,
            "height": camera.height,
            "params": [camera.fx, camera.fy, camera.cx, camera.cy],
        },
        {
            "max_reproj_error": max_error_px,
            "min_iterations": _MIN_ITERATIONS,
            "max_iterations": _MAX_ITERATIONS,
            "success_prob": _SUCCESS_PROBABILITY,
            "seed": seed,
        },
    )
    return np.asarray(pose.Rt, dtype=np.float64) if info["num_inliers"] >= _MINIMUM_POINTS else None


def _ransac_opencv(
    points: FloatArray, px: FloatArray, camera: Camera, max_error_px: float, seed: int
) -> FloatArray | None:
    """OpenCV's USAC with MAGSAC scoring: for machines that PoseLib has no wheel for (64-bit Arm)."""
    options = cv2.UsacParams()
    options.score = cv2.SCORE_METHOD_MAGSAC
    options.threshold = max_error_px
    options.confidence = _SUCCESS_PROBABILITY
    options.maxIterations = _MAX_ITERATIONS
    options.randomGeneratorState = seed
    try:
        found, _, turn, shift, inliers = cv2.solvePnPRansac(points, px, camera.matrix, None, params=options)
    except cv2.error:  # how OpenCV says that points are collinear or coincide
        return None
    if not found or inliers is None or len(inliers) < _MINIMUM_POINTS:
        return None
    return np.column_stack([cv2.Rodrigues(turn)[0], shift]).astype(np.float64)


def _zoomed(camera: Camera, focal_scale: float) -> Camera:
    """The camera with both focal lengths scaled: the aspect and the principal point stay, as in the paper."""
    if focal_scale == 1.0:
        return camera
    return Camera(
        camera.width,
        camera.height,
        camera.fx * focal_scale,
        camera.fy * focal_scale,
        camera.cx,
        camera.cy,
        camera.distortion,
    )


def _errors(points: FloatArray, px: FloatArray, camera: Camera, pose: Rigid3) -> FloatArray:
    projected = camera.pinhole().project(pose.inverse().apply(points))
    return np.asarray(np.nan_to_num(np.linalg.norm(projected - px, axis=1), nan=np.inf), dtype=np.float64)


def _linearised(
    points: FloatArray, px: FloatArray, camera: Camera, pose: Rigid3, free_focal: bool
) -> tuple[FloatArray, FloatArray]:
    """Residuals (N, 2) and their Jacobian (N, 2, 6 or 7) by camera centre, rotation vector (both in map axes,
    ``R = exp(d) R``) and log focal length."""
    residuals, jacobian = linearised(points, px, camera, pose)
    if free_focal:
        from_axis = residuals + px - (camera.cx, camera.cy)
        jacobian = np.concatenate([jacobian, from_axis[:, :, None]], axis=2)
    return residuals, jacobian


def _huber_scale(residuals: FloatArray, max_error_px: float) -> float:
    """Where the loss turns linear: 1.345 robust sigmas, within bounds. For Gaussian errors in two dimensions it
    keeps 93 % of the efficiency."""
    sigma = 1.4826 * float(np.median(np.abs(residuals)))
    return float(np.clip(1.345 * sigma, 0.05 * max_error_px, max_error_px))


def _huber_weights(residuals: FloatArray, scale: float) -> FloatArray:
    norms = np.linalg.norm(residuals, axis=1)
    return np.asarray(np.minimum(1.0, scale / np.maximum(norms, 1e-12)), dtype=np.float64)


def _huber_cost(residuals: FloatArray, scale: float) -> float:
    norms = np.linalg.norm(residuals, axis=1)
    return float(np.where(norms <= scale, 0.5 * norms**2, scale * (norms - 0.5 * scale)).sum())


def _levenberg_marquardt(
    points: FloatArray,
    px: FloatArray,
    camera: Camera,
    pose: Rigid3,
    focal_scale: float,
    max_error_px: float,
    free_focal: bool,
) -> tuple[Rigid3, float]:
    residuals, jacobian = _linearised(points, px, _zoomed(camera, focal_scale), pose, free_focal)
    scale = _huber_scale(residuals, max_error_px)
    cost = _huber_cost(residuals, scale)
    damping = 1e-4
    for _ in range(_LM_ITERATIONS):
        weighted = jacobian * _huber_weights(residuals, scale)[:, None, None]
        normal = np.einsum("nip,niq->pq", weighted, jacobian)
        gradient = np.einsum("nip,ni->p", weighted, residuals)
        try:
            step = np.linalg.solve(normal + damping * np.diag(np.diag(normal) + 1e-12), -gradient)
        except np.linalg.LinAlgError:
            break
        stepped = moved(pose, step[:6])
        zoom = focal_scale * float(np.exp(np.clip(step[6], -0.5, 0.5))) if free_focal else focal_scale
        new_residuals, new_jacobian = _linearised(points, px, _zoomed(camera, zoom), stepped, free_focal)
        new_cost = _huber_cost(new_residuals, scale)
        if np.isfinite(new_cost) and new_cost <= cost:
            done = cost - new_cost <= 1e-10 * cost
            pose, focal_scale, cost = stepped, zoom, new_cost
            residuals, jacobian = new_residuals, new_jacobian
            damping = max(damping * 0.1, 1e-10)
            if done:
                break
        else:
            damping *= 10.0
            if damping > 1e8:
                break
    return pose, focal_scale
