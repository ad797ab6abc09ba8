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
        array = np.asarray(values, dtype=np.float64)
        if not array.size:
            return Spread(None, None, None, None)
        median, p90, p99 = np.percentile(array, [50, 90, 99])
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


def recall(
    errors: Sequence[PoseError], frames: int, limits: Mapping[str, tuple[float, float]] = RECALL_LIMITS
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
