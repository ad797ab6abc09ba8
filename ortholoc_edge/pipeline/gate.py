"""Reasons to refuse a pose, one function each: no fix is better than a wrong fix.

Each test returns None, or a `Refusal` that says what was measured against which limit.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

import cv2
import numpy as np
from msgspec import Meta, Struct, structs

from ortholoc_edge.geometry import rotation
from ortholoc_edge.geometry.arrays import FloatArray
from ortholoc_edge.geometry.covariance import mahalanobis_squared
from ortholoc_edge.geometry.rigid import Rigid3
from ortholoc_edge.pipeline.outcome import Reason
from ortholoc_edge.pipeline.prior import PosePrior
from ortholoc_edge.pose.pnp import PoseEstimate


class GateOptions(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Limits of the gate. Looser ones (a lower ``min_``, a higher ``max_``) give more fixes and, in the end, a wrong
    one.

    Of 328 poses good to 0.5 m on the real flights (XFeat, gate open) all had 124 inliers or more, a ratio of 0.39
    and a spread of 0.13; the worst wrong one had 22, 0.43 and 0.06. Other maps and seasons give fewer, so the
    limits keep a distance.
    """

    min_inliers: Annotated[int, Meta(ge=6)] = 30
    min_inlier_ratio: Annotated[float, Meta(ge=0, le=1)] = 0.20
    # Of structural matching, in place of the two above: how much better the view fits at the pose than beside it, in
    # sigmas, and the part of the patches in view that agree. Of 10,000 hostile frames the false poses without a rival
    # had a contrast of 8.3 at most and a support of 0.076; of 1031 right ones, most of another season, these limits
    # refuse 19 (docs/studies/structural.md, "Contrast").
    min_contrast: Annotated[float, Meta(ge=0)] = 10.5
    min_support: Annotated[float, Meta(ge=0, le=1)] = 0.03
    # Contrast that is enough with ``sure_support``: oblique views have less of it, for their far parts show little.
    min_sure_contrast: Annotated[float, Meta(ge=0)] = 5.0
    # Inliers of the best pose elsewhere within the prior, as a part of this one's.
    max_rival: Annotated[float, Meta(ge=0)] = 0.6
    # Support below which the pose must be where it was expected, within so many sigmas.
    sure_support: Annotated[float, Meta(ge=0, le=1)] = 0.15
    unsure_innovation_sigmas: Annotated[float, Meta(gt=0)] = 3.0
    # Convex hull of the inliers over the image's area; half of it for structural matching.
    min_spread: Annotated[float, Meta(ge=0, le=1)] = 0.12
    # Root mean square of the inliers over the inlier threshold; uniform outliers give 0.71.
    max_rms_ratio: Annotated[float, Meta(gt=0, le=1)] = 0.65
    # Of tilt, heading and position against the prior, in sigmas of the difference.
    max_innovation_sigmas: Annotated[float, Meta(gt=0)] = 5.0
    # Position uncertainty over height above ground.
    max_relative_sigma: Annotated[float, Meta(gt=0)] = 0.10


@dataclass(frozen=True, slots=True)
class Refusal:
    """Why, and by how much."""

    reason: Reason
    detail: str
    measured: float
    limit: float


def check(
    estimate: PoseEstimate,
    query_px: FloatArray,
    map_from_camera: Rigid3,
    covariance: FloatArray,
    height_above_ground_m: float,
    prior: PosePrior | None,
    max_error_px: float,
    options: GateOptions,
) -> Refusal | None:
    """The first test that a pose fails, in the order of what it costs to be wrong about it.

    Args:
        estimate: of the solver; ``query_px`` (N, 2) are the matches it was given.
        map_from_camera, covariance: the same pose in map coordinates, (6, 6) with the map's own error.
        height_above_ground_m: of the estimated camera.
        prior: None where none was used.
    """
    return (
        enough_inliers(estimate, options)
        or well_spread(estimate, query_px, options)
        or small_residual(estimate, max_error_px, options)
        or above_ground(height_above_ground_m)
        or certain(covariance, height_above_ground_m, options)
        or (prior and agrees_with(prior, map_from_camera, covariance, options))
        or None
    )


def enough_inliers(estimate: PoseEstimate, options: GateOptions) -> Refusal | None:
    """Chance alone gives a handful of inliers to any pose of enough random matches."""
    count, total = int(np.count_nonzero(estimate.inliers)), len(estimate.inliers)
    if count < options.min_inliers:
        return Refusal(Reason.FEW_INLIERS, f"{count} of {total} matches", count, options.min_inliers)
    ratio = count / total
    if ratio < options.min_inlier_ratio:
        return Refusal(Reason.LOW_INLIER_RATIO, f"{count} of {total} matches", ratio, options.min_inlier_ratio)
    return None


def with_contrast(contrast: float, support: float, options: GateOptions) -> Refusal | None:
    """At a wrong pose all cells together fit no better than beside it, even where some agree by chance."""
    limit = options.min_contrast if support < options.sure_support else options.min_sure_contrast
    if not contrast >= limit:
        return Refusal(Reason.LOW_CONTRAST, "fit of the view over that beside it", contrast, limit)
    return None


def with_support(support: float, options: GateOptions) -> Refusal | None:
    """What fits only where a road or two run the right way has contrast, but hardly a patch that finds its place."""
    if not support >= options.min_support:
        return Refusal(Reason.LOW_INLIER_RATIO, "part of the patches in view that agree", support, options.min_support)
    return None


def without_rival(rival: float, options: GateOptions) -> Refusal | None:
    """Where a pattern repeats a pose one period further fits as well; nothing in the picture tells which is right."""
    if not rival <= options.max_rival:
        return Refusal(Reason.AMBIGUOUS, "inliers of a pose elsewhere, part of this one's", rival, options.max_rival)
    return None


def lenient(options: GateOptions, part: float) -> GateOptions:
    """The limits with only a part of the least number and ratio of inliers."""
    return structs.replace(
        options,
        min_inliers=max(6, round(part * options.min_inliers)),
        min_inlier_ratio=part * options.min_inlier_ratio,
    )


def for_structure(support: float, options: GateOptions) -> GateOptions:
    """The limits for a pose of structural matching with so much support: its contrast stands for counts, and the
    prior's attitude, which is in it, for half of the spread."""
    sigmas = options.max_innovation_sigmas
    if support < options.sure_support:
        sigmas = min(sigmas, options.unsure_innovation_sigmas)
    return structs.replace(
        options,
        min_inliers=6,
        min_inlier_ratio=0.0,
        min_spread=0.5 * options.min_spread,
        max_innovation_sigmas=sigmas,
    )


def well_spread(estimate: PoseEstimate, query_px: FloatArray, options: GateOptions) -> Refusal | None:
    """Inliers in one corner fix the pose there and let it swing elsewhere."""
    hull = cv2.convexHull(query_px[estimate.inliers].astype(np.float32))
    spread = float(cv2.contourArea(hull)) / (estimate.camera.width * estimate.camera.height)
    if spread < options.min_spread:
        return Refusal(Reason.POOR_SPREAD, "inliers over the image's area", spread, options.min_spread)
    return None


def small_residual(estimate: PoseEstimate, max_error_px: float, options: GateOptions) -> Refusal | None:
    """Wrong inliers fill the threshold evenly; right ones huddle at its centre."""
    limit = options.max_rms_ratio * max_error_px
    if estimate.rms_px > limit:
        return Refusal(Reason.HIGH_REPROJECTION, "root mean square, px", estimate.rms_px, limit)
    return None


def above_ground(height_above_ground_m: float) -> Refusal | None:
    """A flat scene has a mirror solution below the ground."""
    if not height_above_ground_m > 0:
        return Refusal(Reason.DEGENERATE_GEOMETRY, "camera below the surface, m", height_above_ground_m, 0.0)
    return None


def certain(covariance: FloatArray, height_above_ground_m: float, options: GateOptions) -> Refusal | None:
    """A pose that says of itself that it may be anywhere is no help to a filter."""
    # A map whose stated sigma is absurd makes it infinite, which has no eigenvalues.
    known = bool(np.isfinite(covariance).all())
    sigma = float(np.sqrt(np.linalg.eigvalsh(covariance[:3, :3])[-1])) if known else math.inf
    limit = options.max_relative_sigma * height_above_ground_m
    if sigma > limit:
        return Refusal(Reason.UNCERTAIN, "1-sigma of position along its worst axis, m", sigma, limit)
    return None


def agrees_with(
    prior: PosePrior, map_from_camera: Rigid3, covariance: FloatArray, options: GateOptions
) -> Refusal | None:
    """Tilt against gravity, then heading, then position against what was predicted."""
    limit = options.max_innovation_sigmas
    turn = _tilt_and_heading(map_from_camera.rotation @ prior.map_from_camera.rotation.T)
    spread = prior.covariance + covariance
    tilt = float(np.sqrt(mahalanobis_squared(turn[:2], spread[3:5, 3:5])))
    if tilt > limit:
        degrees = float(np.degrees(np.linalg.norm(turn[:2])))
        return Refusal(Reason.GRAVITY_DISAGREES, f"{degrees:.1f} deg from the autopilot's, in sigmas", tilt, limit)
    heading = abs(float(turn[2])) / float(np.sqrt(spread[5, 5]))
    if heading > limit:
        degrees = float(np.degrees(abs(turn[2])))
        return Refusal(Reason.PRIOR_DISAGREES, f"heading {degrees:.1f} deg off, in sigmas", heading, limit)
    step = map_from_camera.translation - prior.map_from_camera.translation
    moved = float(np.sqrt(mahalanobis_squared(step, spread[:3, :3])))
    if moved > limit:
        return Refusal(
            Reason.PRIOR_DISAGREES,
            f"position {float(np.linalg.norm(step)):.1f} m off, in sigmas",
            moved,
            limit,
        )
    return None


def _tilt_and_heading(turn: FloatArray) -> FloatArray:
    """(3,) rad: a turn (3, 3) as a tilt about level axes, followed by a turn about the vertical.

    For small turns that is the rotation vector; but under a large turn of the heading, as with a prior that does
    not know it, the rotation vector makes up to pi / 2 times the tilt of a tilt. The axes are the prior's.
    """
    x, y, z = turn[2]
    sine = math.hypot(x, y)
    tilt = np.array([y, -x, 0.0]) * (math.atan2(sine, z) / sine if sine > 1e-12 else 1.0)
    level = turn @ rotation.exp(-tilt)
    return np.array([tilt[0], tilt[1], math.atan2(level[1, 0], level[0, 0])])
