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
from ortholoc_edge.geometry.arrays import BoolArray, FloatArray, IntArray
from ortholoc_edge.geometry.camera import Camera
from ortholoc_edge.geometry.rigid import Rigid3
from ortholoc_edge.pose.adjust import linearised, moved
from ortholoc_edge.pose.least_squares import huber, huber_scale, huber_weights, minimise

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
MINIMUM_POINTS = 6
# Of the inliers in the image, in inlier thresholds.
_MINIMUM_EXTENT = 4.0
# Matches closer than a fifth of the long side share the errors of a patch of the map and of the camera's model.
_CLUSTERS_ACROSS = 5
# Errors that vary slowly over the image are partly absorbed by the pose and so never show in the residuals.
# Without this factor on the variance the normalised error squared averages 8 to 15 on the real flights instead
# of 6 (docs/benchmarks.md, "Covariance").
ABSORBED_ERROR_FACTOR = 2.5


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
    if len(points_local) < MINIMUM_POINTS:
        return None
    start = _ransac(points_local, query_px, camera, max_error_px, seed)
    return None if start is None else refine(points_local, query_px, camera, start, max_error_px=max_error_px)


def refine(
    points_local: FloatArray, query_px: FloatArray, camera: Camera, local_from_camera: Rigid3, *, max_error_px: float
) -> PoseEstimate | None:
    """Levenberg-Marquardt with the Huber loss on the inliers of a pose, chosen again once the pose has moved.

    Returns: None if the inliers do not determine the pose.
    """
    pose = local_from_camera
    for _ in range(2):
        inliers = _errors(points_local, query_px, camera, pose) <= max_error_px
        if np.count_nonzero(inliers) < MINIMUM_POINTS:
            return None
        pose = _refined(points_local[inliers], query_px[inliers], camera, pose, max_error_px)
    errors = _errors(points_local, query_px, camera, pose)
    inliers = errors <= max_error_px
    if np.count_nonzero(inliers) < MINIMUM_POINTS or on_one_spot(query_px[inliers], max_error_px):
        return None
    residuals, jacobian = linearised(points_local[inliers], query_px[inliers], camera, pose)
    weights = huber_weights(residuals, huber_scale(residuals, max_error_px))
    try:
        plain = cov.clustered(jacobian, residuals, weights, clusters(query_px[inliers], camera))
    except np.linalg.LinAlgError:
        return None
    covariance = ABSORBED_ERROR_FACTOR * plain
    if not np.isfinite(covariance).all() or np.any(np.diag(covariance) <= 0):
        return None
    return PoseEstimate(pose, camera, covariance, inliers, errors, float(np.sqrt(np.mean(errors[inliers] ** 2))))


def on_one_spot(px: FloatArray, max_error_px: float) -> bool:
    """Seen from far enough away any points fall on one spot."""
    return bool(np.ptp(px, axis=0).max() < _MINIMUM_EXTENT * max_error_px)


def clusters(px: FloatArray, camera: Camera) -> IntArray:
    """Labels (N,) of the parts of the picture within which matches (N, 2) share their errors."""
    side = max(camera.width, camera.height) / _CLUSTERS_ACROSS
    column, row = np.floor(px / side).astype(np.intp).T
    return np.asarray(column * 10_000 + row)


def minimal_with_focal(points: FloatArray, centred_px: FloatArray) -> list[tuple[Rigid3, float]]:
    """Poses ``camera_from_points`` with their focal lengths, px, that explain four matches; none without PoseLib.

    Args:
        points: (4, 3); centred_px: (4, 2) from the principal point, of square pixels.
    """
    if poselib is None:
        return []
    found = []
    for pose, focal in zip(*poselib.p4pf(centred_px, points, True), strict=True):
        try:
            found.append((Rigid3(pose.R, pose.t), float(focal)))
        except ValueError:  # of four points on a line, say, it makes what is no rotation
            continue
    return found


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
    return np.asarray(pose.Rt, dtype=np.float64) if info["num_inliers"] >= MINIMUM_POINTS else None


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
    if not found or inliers is None or len(inliers) < MINIMUM_POINTS:
        return None
    return np.column_stack([cv2.Rodrigues(turn)[0], shift]).astype(np.float64)


def _errors(points: FloatArray, px: FloatArray, camera: Camera, pose: Rigid3) -> FloatArray:
    projected = camera.pinhole().project(pose.inverse().apply(points))
    return np.asarray(np.nan_to_num(np.linalg.norm(projected - px, axis=1), nan=np.inf), dtype=np.float64)


def _refined(points: FloatArray, px: FloatArray, camera: Camera, pose: Rigid3, max_error_px: float) -> Rigid3:
    scale = huber_scale(linearised(points, px, camera, pose)[0], max_error_px)
    return minimise(pose, lambda at: huber(*linearised(points, px, camera, at), scale), moved)
