"""Metrics worked by hand: they must say what is so, and giving up must not pay."""

import numpy as np
import pytest
from hypothesis import given
from strategies import poses, rotation_vectors, vectors

from ortholoc_edge.bench import metrics
from ortholoc_edge.bench.metrics import PoseError, Spread
from ortholoc_edge.geometry import rotation
from ortholoc_edge.geometry.camera import Camera
from ortholoc_edge.geometry.rigid import Rigid3
from ortholoc_edge.pipeline.outcome import Fix, Reason, Rejected

SIGMA = np.array([1.0, 1.0, 2.0, 0.01, 0.01, 0.02])


def fix_at(pose, timings=None):
    return Fix(
        stamp_ns=0,
        map_from_camera=pose,
        camera=Camera.from_focal(100, 100, 100.0),
        covariance=np.diag(SIGMA**2),
        quality=1.0,
        matches=10,
        inliers=10,
        rms_px=1.0,
        adhop_accepted=False,
        query_px=np.zeros((0, 2)),
        points_map=np.zeros((0, 3)),
        timings_ms=timings or {},
    )


def away(pose, metres, degrees, axis=(0.0, 0.0, 1.0)):
    turn = rotation.exp(np.radians(degrees) * np.array(axis))
    return Rigid3(turn @ pose.rotation, pose.translation + np.array([0.6, 0.0, 0.8]) * metres)


@given(poses())
def test_one_metre_off_reads_one_metre(truth):
    error = metrics.pose_error(fix_at(away(truth, 1.0, 0.0)), truth)
    assert error.te_m == pytest.approx(1.0, abs=1e-6)
    assert error.re_deg == pytest.approx(0.0, abs=1e-5)


@given(poses(100.0), rotation_vectors().filter(lambda v: np.linalg.norm(v) > 0.1))
def test_two_degrees_off_read_two_degrees_about_any_axis(truth, axis):
    error = metrics.pose_error(fix_at(away(truth, 0.0, 2.0, axis / np.linalg.norm(axis))), truth)
    assert error.re_deg == pytest.approx(2.0, abs=1e-6)
    assert error.te_m == 0.0


def test_position_error_is_between_centres_whatever_the_rotation():
    """The slip of the reference code: with camera_from_map a turn about the centre would read as metres."""
    truth = Rigid3(np.eye(3), (1000.0, 2000.0, 100.0))
    assert metrics.pose_error(fix_at(away(truth, 0.0, 30.0)), truth).te_m == 0.0


@pytest.mark.parametrize(
    ("step", "unprotected"),
    [((5.9, 0, 0), False), ((4.3, 4.3, 0), True), ((0, 0, -10.6), False), ((0, 0, -10.7), True)],
)
def test_an_error_beyond_the_protection_level_counts(step, unprotected):
    """Six sigma horizontally, 5.33 vertically, of 1 and 2 m."""
    truth = Rigid3(np.eye(3), (10.0, 20.0, 30.0))
    error = metrics.pose_error(fix_at(Rigid3(np.eye(3), truth.translation + np.array(step))), truth)
    assert error.unprotected is unprotected


@given(vectors(3.0), vectors(0.02))
def test_nees_is_of_the_stated_error(step, turn):
    estimate = Rigid3(rotation.exp([0.1, 0.2, 0.3]), (5.0, 6.0, 7.0))
    truth = Rigid3(rotation.exp(turn) @ estimate.rotation, estimate.translation + step)
    want = float(np.sum((np.concatenate([step, turn]) / SIGMA) ** 2))
    assert metrics.pose_error(fix_at(estimate), truth).nees == pytest.approx(want, rel=1e-6, abs=1e-9)


def test_recall_counts_frames_without_a_fix():
    errors = [PoseError(0.9, 0.9, 6), PoseError(2.9, 0.1, 6), PoseError(0.1, 4.0, 6), PoseError(50.0, 0.1, 6)]
    assert metrics.recall(errors, 8) == {"1m_1deg": 1 / 8, "3m_3deg": 2 / 8, "5m_5deg": 3 / 8}
    assert metrics.recall(errors, 4)["5m_5deg"] == 0.75
    assert metrics.recall([], 10) == {"1m_1deg": 0, "3m_3deg": 0, "5m_5deg": 0}
    assert metrics.recall([], 0)["1m_1deg"] == 0.0


def test_recall_limits_are_included():
    assert metrics.recall([PoseError(1.0, 1.0, 6)], 1)["1m_1deg"] == 1.0
    assert metrics.recall([PoseError(1.0, 1.0001, 6)], 1)["1m_1deg"] == 0.0


@pytest.mark.parametrize(
    ("te_m", "re_deg", "false"), [(10.0, 5.0, False), (10.1, 0.0, True), (0.0, 5.1, True), (0.0, 0.0, False)]
)
def test_false_fix(te_m, re_deg, false):
    assert PoseError(te_m, re_deg, 0.0).is_false is false


def test_spread_known_answers():
    assert Spread.of(np.arange(101)) == Spread(50.0, 90.0, 99.0, 100.0)
    assert Spread.of([7.0]) == Spread(7.0, 7.0, 7.0, 7.0)
    assert Spread.of([]) == Spread(None, None, None, None)


def test_nees_summary():
    found = metrics.nees([PoseError(0, 0, float(v)) for v in range(101)])
    assert (found.mean, found.p95, found.dof) == (50.0, 95.0, 6)
    assert metrics.nees([]) == metrics.Nees(None, None)


def test_rejections_most_frequent_first():
    outcomes = [
        Rejected(0, Reason.LATE),
        Rejected(1, Reason.FEW_MATCHES),
        fix_at(Rigid3.identity()),
        Rejected(2, Reason.FEW_MATCHES),
    ]
    found = metrics.rejections(outcomes)
    assert list(found.items()) == [("few_matches", 2), ("late", 1)]


def test_latencies_are_over_the_frames_that_reached_a_stage():
    outcomes = [fix_at(Rigid3.identity(), {"match": 10.0, "total": float(v)}) for v in range(100)]
    outcomes.append(Rejected(0, Reason.LATE, timings_ms={"total": 100.0}))
    found = metrics.latencies(outcomes)
    assert list(found) == ["total", "match"]
    assert (found["total"].median, found["total"].p95, found["total"].p99) == (50.0, 95.0, 99.0)
    assert found["match"].p99 == 10.0
    assert metrics.latencies([]) == {}
