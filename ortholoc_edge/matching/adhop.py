"""The homography of the paper's AdHoP, as a pure function.

OrthoLoC, section "AdHoP Refinement": a homography from the 2D-2D matches by normalised DLT and RANSAC, the
orthophoto warped with it, matched again, matches taken back by its inverse. The loop is `pipeline`'s.
"""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np
import numpy.typing as npt

from ortholoc_edge.geometry.arrays import BoolArray, FloatArray
from ortholoc_edge.geometry.homography import positive_at, warp_points

# Four pairs fit any homography exactly, so agreement begins with the fifth. Ours: 50 to 1000 wrong pairs in a
# 1000 px frame agreed on 7 at most at 5 px, in 684 draws.
MIN_INLIERS: Final = 10
# Ratio of largest to smallest singular value of the homography between normalised coordinates (centroid 0,
# mean distance sqrt 2). Ours: a plane seen at tilts of 0 to 80 degrees gave 1.0 to 4.9 (90 degree lens,
# ground near the horizon left out); a fit that squeezes one side to a line or a point goes to thousands.
MAX_CONDITION: Final = 30.0
# Smallest spread (standard deviation) of the inliers across their main direction, in units of the threshold
# and on both sides. Pairs along one road fit within the threshold whatever happens across it.
MIN_SPREAD: Final = 2.0

# RANSAC: 0.999 and 5000 draws suffice down to about one right pair in five (log 0.001 / log(1 - 0.2^4) = 4314).
_CONFIDENCE: Final = 0.999
_MAX_DRAWS: Final = 5000


def fit_homography(
    src_px: npt.ArrayLike,
    dst_px: npt.ArrayLike,
    threshold_px: float,
    *,
    src_shape: tuple[int, int] | None = None,
) -> tuple[FloatArray, BoolArray] | None:
    """The homography that takes most of ``src_px`` to ``dst_px``; None if that would be no view of a plane.

    Normalised DLT inside RANSAC by OpenCV, which centres and scales both sides before each DLT, fits again
    to all inliers and refines by Levenberg-Marquardt; its generator starts from a fixed state on each call,
    so equal input gives equal output.

    Refused: fewer than ``MIN_INLIERS``; inliers about a line or a point; an ill-conditioned result; a
    mirroring one (a photo of the ground from above never is); one whose horizon crosses the inliers or
    their bounding box.

    Args:
        src_px, dst_px: (N, 2) pixels, pairs by index.
        threshold_px: largest distance of an inlier, in pixels of ``dst``.
        src_shape: (rows, columns) of the source image, if its whole frame must stay in front of the horizon
            and convex. None where the source reaches farther than the view, as an orthophoto under a tilted
            camera.
    Returns: (3, 3) with a positive third coordinate at the inliers and unit norm, and the inliers (N,).
    Raises: ValueError if the points do not pair or the threshold is not positive.
    """
    src, dst = np.asarray(src_px, dtype=np.float64), np.asarray(dst_px, dtype=np.float64)
    if src.ndim != 2 or src.shape != dst.shape or src.shape[1] != 2:
        raise ValueError(f"homography: points of shapes {src.shape} and {dst.shape} do not pair")
    if not threshold_px > 0:
        raise ValueError(f"homography: threshold {threshold_px} px must be positive")
    if len(src) < MIN_INLIERS or not (np.isfinite(src).all() and np.isfinite(dst).all()):
        return None
    fitted, _ = cv2.findHomography(
        src, dst, cv2.RANSAC, threshold_px, maxIters=_MAX_DRAWS, confidence=_CONFIDENCE
    )
    if fitted is None or not np.isfinite(fitted).all():
        return None
    homography = np.asarray(fitted, dtype=np.float64)
    # OpenCV's mask belongs to the best draw, not to the refined result.
    homography = positive_at(homography, np.median(src, axis=0))
    inliers = _within(homography, src, dst, threshold_px)
    if inliers.sum() < MIN_INLIERS:
        return None
    homography = positive_at(homography, src[inliers].mean(axis=0))
    inliers = _within(homography, src, dst, threshold_px)
    if inliers.sum() < MIN_INLIERS or not _is_view(
        homography, src[inliers], dst[inliers], threshold_px, src_shape
    ):
        return None
    return homography / np.linalg.norm(homography), inliers


def _within(homography: FloatArray, src: FloatArray, dst: FloatArray, threshold_px: float) -> BoolArray:
    # NaN, a point beyond the horizon, compares as False.
    distance = np.linalg.norm(warp_points(homography, src) - dst, axis=1)
    return np.asarray(distance <= threshold_px, dtype=np.bool_)


def _is_view(
    homography: FloatArray,
    src: FloatArray,
    dst: FloatArray,
    threshold_px: float,
    src_shape: tuple[int, int] | None,
) -> bool:
    spread = min(float(np.linalg.eigvalsh(np.cov(points.T))[0]) for points in (src, dst))
    if spread < (MIN_SPREAD * threshold_px) ** 2:
        return False
    # Where all third coordinates are positive, the determinant's sign is the Jacobian's: negative is mirrored.
    if np.linalg.det(homography) <= 0:
        return False
    normalised = _normaliser(dst) @ homography @ np.linalg.inv(_normaliser(src))
    singular = np.linalg.svd(normalised, compute_uv=False)
    if singular[-1] <= 0 or singular[0] > MAX_CONDITION * singular[-1]:
        return False
    # A rectangle maps to a convex quadrangle exactly when its corners are on one side of the horizon.
    frames = [(*src.min(axis=0), *src.max(axis=0))]
    if src_shape is not None:
        frames.append((-0.5, -0.5, src_shape[1] - 0.5, src_shape[0] - 0.5))
    corners = np.array(
        [[u, v] for left, top, right, low in frames for u in (left, right) for v in (top, low)]
    )
    return bool(np.isfinite(warp_points(homography, corners)).all())


def _normaliser(points: FloatArray) -> FloatArray:
    """Hartley's similarity (1997): centroid to 0, mean distance to sqrt 2."""
    centre = points.mean(axis=0)
    scale = np.sqrt(2.0) / np.linalg.norm(points - centre, axis=1).mean()
    return np.array([[scale, 0.0, -scale * centre[0]], [0.0, scale, -scale * centre[1]], [0.0, 0.0, 1.0]])
