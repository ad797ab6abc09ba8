"""Errors of poses against truth, and their summary, by the paper's section "Evaluation Metrics"."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from msgspec import Struct

from ortholoc_edge.geometry import rotation
from ortholoc_edge.geometry.arrays import FloatArray
from ortholoc_edge.geometry.camera import Camera
from ortholoc_edge.geometry.covariance import mahalanobis_squared
from ortholoc_edge.geometry.rigid import Rigid3
from ortholoc_edge.pipeline.outcome import Fix, Outcome, Rejected

RECALL_LIMITS: Mapping[str, tuple[float, float]] = {
    "1m_1deg": (1.0, 1.0),
    "3m_3deg": (3.0, 3.0),
    "5m_5deg": (5.0, 5.0),
}
# A fix beyond either of these would lead an autopilot astray.
FALSE_FIX_M, FALSE_FIX_DEG = 10.0, 5.0


class Spread(Struct, frozen=True):
    """Order statistics; None where there was nothing to measure."""

    median: float | None
    p90: float | None
    p99: float | None
    max: float | None

    @staticmethod
    def of(values: npt.ArrayLike) -> Spread:
        """Of errors, which may be infinite. Between a finite one and an infinite one all is infinite."""
        array = np.asarray(values, dtype=np.float64)
        if not array.size:
            return Spread(None, None, None, None)
        ranks = [50, 90, 99]
        # NumPy's interpolation beside infinity is NaN.
        largest = array[np.isfinite(array)].max(initial=0.0)
        found = np.percentile(np.minimum(array, largest), ranks)
        found[np.isinf(np.percentile(array, ranks, method="higher"))] = np.inf
        median, p90, p99 = found
        return Spread(float(median), float(p90), float(p99), float(array.max()))


class Latency(Struct, frozen=True):
    """Wall time of a stage over the frames that reached it, ms."""

    median: float
    p95: float
    p99: float


class Nees(Struct, frozen=True):
    """Normalised estimation error squared of the six pose parameters: its mean is ``dof`` if the covariance is
    honest, more if it is too sure."""

    mean: float | None
    p95: float | None
    dof: int = 6


class Summary(Struct, frozen=True, kw_only=True):
    """What a sequence came to; the object that ``replay --json`` prints.

    ``recall`` is over all frames; ``te_m``, ``re_deg`` and ``nees`` over the fixes.
    ``seeds`` runs are in it, with the seeds from ``seed`` on. ``prior`` is what was used, whatever was asked.
    """

    sequence: str
    frames: int
    fixes: int
    rejected: dict[str, int]
    te_m: Spread
    re_deg: Spread
    recall: dict[str, float]
    false_fixes: int
    nees: Nees
    latency_ms: dict[str, Latency]
    cpu_ms_per_frame: float
    rss_mb: float
    matcher: str
    solver: str
    model_sha256: str | None
    pack: str
    prior: str
    adhop: bool
    adhop_accepted: int
    seed: int
    seeds: int = 1


@dataclass(frozen=True, slots=True)
class PoseError:
    """Distance of the camera centres (m), angle between the rotations (deg), the NEES of both, and whether the
    horizontal or the vertical part of the distance is beyond the fix's protection level."""

    te_m: float
    re_deg: float
    nees: float
    unprotected: bool = False

    @property
    def is_false(self) -> bool:
        return self.te_m > FALSE_FIX_M or self.re_deg > FALSE_FIX_DEG


def pose_error(fix: Fix, truth: Rigid3) -> PoseError:
    """Error of a fix against the true ``map_from_camera``, in map units."""
    step = truth.translation - fix.map_from_camera.translation
    turn = rotation.log(truth.rotation @ fix.map_from_camera.rotation.T)
    horizontal_m, vertical_m = fix.protection_m
    return PoseError(
        float(np.linalg.norm(step)),
        float(np.degrees(np.linalg.norm(turn))),
        mahalanobis_squared(np.concatenate([step, turn]), fix.covariance),
        float(np.hypot(step[0], step[1])) > horizontal_m or abs(float(step[2])) > vertical_m,
    )


@dataclass(frozen=True, slots=True)
class SampleError:
    """The paper's errors of one sample, all infinite where there is nothing to measure them on, so that giving up
    can't raise a score.

    Attributes:
        me_px: median distance of the matches from where they should be, pixels of the orthophoto.
        te_m, re_deg: of the pose.
        rpe_px: median distance of the sample's keypoints, projected, from where the true pose projects them.
        rfe: relative error of the focal length; None where it was given.
    """

    me_px: float
    te_m: float
    re_deg: float
    rpe_px: float
    rfe: float | None = None


class SampleSummary(Struct, frozen=True, kw_only=True):
    """The paper's columns over samples. Medians and percentiles are over all of them, those without a pose counting as
    infinite (which JSON tells as null, like what was not measured); ``recall`` likewise. (The paper's code leaves those
    out of its medians, but not out of recall.)"""

    samples: int
    without_pose: int
    me_px: Spread
    te_m: Spread
    re_deg: Spread
    rpe_px: Spread
    rfe: Spread
    recall: dict[str, float]

    @staticmethod
    def of(errors: Sequence[SampleError]) -> SampleSummary:
        return SampleSummary(
            samples=len(errors),
            without_pose=sum(not np.isfinite(e.te_m) for e in errors),
            me_px=Spread.of([e.me_px for e in errors]),
            te_m=Spread.of([e.te_m for e in errors]),
            re_deg=Spread.of([e.re_deg for e in errors]),
            rpe_px=Spread.of([e.rpe_px for e in errors]),
            rfe=Spread.of([e.rfe for e in errors if e.rfe is not None]),
            recall=recall(errors, len(errors)),
        )


def translation_error_m(estimate: Rigid3, truth: Rigid3) -> float:
    """Between the camera centres of two ``map_from_camera``, in map units."""
    return float(np.linalg.norm(estimate.translation - truth.translation))


def rotation_error_deg(estimate: Rigid3, truth: Rigid3) -> float:
    """Angle of the turn between two ``map_from_camera``."""
    return float(np.degrees(rotation.angle_between(estimate.rotation, truth.rotation)))


def reprojection_errors_px(
    points_map: FloatArray, estimate: Rigid3, truth: Rigid3, camera: Camera, estimated_camera: Camera | None = None
) -> FloatArray:
    """How far from its place in the photo each point (N, 3) would be drawn, px.

    Args:
        estimate, truth: ``map_from_camera``. (The paper's code projects with this as if it were its inverse.)
        camera: true intrinsics. estimated_camera: those that belong to the estimate; None: the true ones.
    Returns: (M,) for the points that are in front of the true camera; infinite behind the estimated one.
    """
    true_px = camera.project(truth.inverse().apply(points_map))
    in_front = np.isfinite(true_px).all(axis=1)
    drawn_px = (estimated_camera or camera).project(estimate.inverse().apply(points_map[in_front]))
    errors = np.linalg.norm(drawn_px - true_px[in_front], axis=1)
    return np.asarray(np.nan_to_num(errors, nan=np.inf), dtype=np.float64)


def matching_errors_px(map_px: FloatArray, true_map_px: FloatArray) -> FloatArray:
    """Distances of matched pixels (N, 2) of the orthophoto from the true ones, px: (M,), of those whose truth is known
    (not NaN)."""
    errors = np.linalg.norm(map_px - true_map_px, axis=1)
    return np.asarray(errors[np.isfinite(errors)], dtype=np.float64)


def relative_focal_error(estimate: Camera, truth: Camera) -> float:
    """The paper's RFE, as a part of 1: the mean of both axes'."""
    return 0.5 * (abs(estimate.fx - truth.fx) / truth.fx + abs(estimate.fy - truth.fy) / truth.fy)


def median_error(errors: FloatArray) -> float:
    """Infinite of none."""
    return float(np.median(errors)) if len(errors) else float("inf")


def recall(
    errors: Sequence[PoseError | SampleError], frames: int, limits: Mapping[str, tuple[float, float]] = RECALL_LIMITS
) -> dict[str, float]:
    """Part of all frames with a fix within each pair of limits (m, deg)."""
    return {
        name: sum(e.te_m <= metres and e.re_deg <= degrees for e in errors) / frames if frames else 0.0
        for name, (metres, degrees) in limits.items()
    }


def rejections(outcomes: Sequence[Outcome]) -> dict[str, int]:
    """How many frames were rejected for each reason, most frequent first."""
    return dict(Counter(str(o.reason) for o in outcomes if isinstance(o, Rejected)).most_common())


def latencies(outcomes: Sequence[Outcome]) -> dict[str, Latency]:
    """Per stage; ``total`` first."""
    stages: dict[str, list[float]] = {"total": []}
    for outcome in outcomes:
        for stage, spent_ms in outcome.timings_ms.items():
            stages.setdefault(stage, []).append(spent_ms)
    return {
        stage: Latency(*(float(v) for v in np.percentile(spent, [50, 95, 99])))
        for stage, spent in stages.items()
        if spent
    }


def nees(errors: Sequence[PoseError]) -> Nees:
    values: FloatArray = np.array([e.nees for e in errors])
    if not values.size:
        return Nees(None, None)
    return Nees(float(values.mean()), float(np.percentile(values, 95)))
