"""Metrics worked by hand: they must say what is so, and giving up must not pay."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from strategies import poses, rotation_vectors, vectors

from ortholoc_edge.bench import metrics
from ortholoc_edge.bench.metrics import PoseError, SampleError, SampleSummary, Spread
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


def test_spread_of_infinite_errors():
    inf = math.inf
    # Of four, the median lies between the second and the third.
    assert Spread.of([1.0, 2.0, inf, inf]).median == inf
    assert Spread.of([2.0, inf, 1.0]) == Spread(2.0, inf, inf, inf)
    assert Spread.of([inf, inf]) == Spread(inf, inf, inf, inf)
    assert Spread.of([*range(100), inf]) == Spread(50.0, 90.0, 99.0, inf)
    assert Spread.of([*range(99), inf, inf]) == Spread(50.0, 90.0, inf, inf)


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


# -- the paper's errors of a sample ----------------------------------------------------------------------

# Ten metres above the origin, looking straight down, image top to the north: east is right, north is up.
NADIR = Rigid3(np.diag([1.0, -1.0, -1.0]), (0.0, 0.0, 10.0))
CAMERA = Camera(200, 200, 100.0, 100.0, 99.5, 99.5)


def nudged(shift=(0.0, 0.0, 0.0), turn_deg=0.0, axis=(0.0, 0.0, 1.0)):
    turn = rotation.exp(np.radians(turn_deg) * np.array(axis))
    return Rigid3(turn @ NADIR.rotation, NADIR.translation + np.array(shift))


@pytest.mark.parametrize(
    ("estimate", "point", "error_px"),
    [
        # The camera 0.5 m too far east draws everything 0.5 m / 10 m * 100 px too far left.
        (nudged((0.5, 0.0, 0.0)), (3.0, -2.0, 0.0), 5.0),
        (nudged((0.5, 0.0, 0.0)), (3.0, -2.0, 5.0), 10.0),
        (nudged((0.3, 0.4, 0.0)), (0.0, 0.0, 0.0), 5.0),
        # 2.5 m too high, 4 m off the axis: 40 px are drawn at 4 / 12.5 * 100 = 32.
        (nudged((0.0, 0.0, 2.5)), (4.0, 0.0, 0.0), 8.0),
        # Turned by 60 degrees about the axis, what lies 30 px off it goes along a chord of as much.
        (nudged(turn_deg=60.0), (0.0, 3.0, 0.0), 30.0),
        # Tilted by atan(0.1): what was in the middle is drawn 10 px off.
        (nudged(turn_deg=math.degrees(math.atan(0.1)), axis=(1.0, 0.0, 0.0)), (0.0, 0.0, 0.0), 10.0),
        # Behind the estimated camera, which is too low.
        (nudged((0.0, 0.0, -8.0)), (0.0, 0.0, 5.0), math.inf),
    ],
)
def test_reprojection_error_worked_by_hand(estimate, point, error_px):
    [error] = metrics.reprojection_errors_px(np.array([point]), estimate, NADIR, CAMERA)
    assert error == pytest.approx(error_px, abs=1e-9)


def test_reprojection_error_is_of_poses_and_not_of_their_inverses():
    """The slip of the paper's code projects with map_from_camera as if it were camera_from_map: with that, this turn
    about the camera's own axis, 1 km from the origin, would move a point in the middle."""
    truth = Rigid3(NADIR.rotation, (1000.0, 0.0, 10.0))
    estimate = Rigid3(rotation.exp([0.0, 0.0, 0.5]) @ truth.rotation, truth.translation)
    assert metrics.reprojection_errors_px(np.array([[1000.0, 0.0, 0.0]]), estimate, truth, CAMERA) == pytest.approx(0.0)


def test_points_that_the_photo_does_not_show_do_not_count():
    points = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 20.0], [1.0, 0.0, 0.0]])
    errors = metrics.reprojection_errors_px(points, nudged((1.0, 0.0, 0.0)), NADIR, CAMERA)
    assert errors == pytest.approx([10.0, 10.0])


def test_reprojection_error_has_the_estimated_focal_length_in_it():
    longer = Camera(200, 200, 110.0, 110.0, 99.5, 99.5)
    [error] = metrics.reprojection_errors_px(np.array([[4.0, 3.0, 0.0]]), NADIR, NADIR, CAMERA, longer)
    assert error == pytest.approx(5.0)


@given(poses(), poses())
def test_pose_errors_agree_with_an_independent_implementation(estimate, truth):
    """Of quaternions worked out here, one component after the other, and of distances as sums of squares."""
    step = [a - b for a, b in zip(estimate.translation, truth.translation, strict=True)]
    assert metrics.translation_error_m(estimate, truth) == pytest.approx(math.sqrt(sum(d * d for d in step)), abs=1e-6)
    assert metrics.rotation_error_deg(estimate, truth) == pytest.approx(turn_deg(estimate, truth), abs=1e-6)


@given(poses(10.0), vectors(2.0), vectors(0.3), st.floats(50.0, 2000.0))
def test_reprojection_errors_agree_with_an_independent_implementation(truth, shift, turn, focal_px):
    estimate = Rigid3(rotation.exp(turn) @ truth.rotation, truth.translation + shift)
    camera = Camera(640, 480, focal_px, 1.01 * focal_px, 321.0, 238.5)
    points = truth.apply(np.random.default_rng(3).uniform((-20, -20, 30), (20, 20, 60), (20, 3)))
    want = [
        math.dist(drawn(camera, estimate, point), drawn(camera, truth, point))
        for point in points
    ]  # fmt: skip
    errors = metrics.reprojection_errors_px(points, estimate, truth, camera)
    assert errors == pytest.approx(want, abs=1e-6, rel=1e-9)


def drawn(camera, map_from_camera, point):
    """By the definition of the pinhole, from where the camera is and which way its axes point."""
    offset = [point[k] - map_from_camera.translation[k] for k in range(3)]
    right, down, ahead = (sum(offset[k] * map_from_camera.rotation[k, axis] for k in range(3)) for axis in range(3))
    return camera.fx * right / ahead + camera.cx, camera.fy * down / ahead + camera.cy


def turn_deg(a, b):
    """Angle of ``a b^-1`` by its sine and cosine: the skew part and the trace of the matrix."""
    turn = [[sum(a.rotation[i, k] * b.rotation[j, k] for k in range(3)) for j in range(3)] for i in range(3)]
    twice_sine = math.sqrt(sum((turn[i][j] - turn[j][i]) ** 2 for i, j in ((0, 1), (0, 2), (1, 2))))
    return math.degrees(math.atan2(twice_sine, turn[0][0] + turn[1][1] + turn[2][2] - 1.0))


def test_matching_error_is_of_the_matches_with_a_truth():
    true_px = np.array([[10.0, 10.0], [np.nan, np.nan], [0.0, 0.0], [5.0, 5.0]])
    matched = np.array([[13.0, 14.0], [1.0, 1.0], [0.0, 1.0], [5.0, 5.0]])
    errors = metrics.matching_errors_px(matched, true_px)
    assert errors.tolist() == [5.0, 1.0, 0.0]
    assert metrics.median_error(errors) == 1.0
    assert metrics.median_error(np.empty(0)) == math.inf


def test_relative_focal_error_is_the_mean_of_both_axes():
    estimate, truth = Camera(10, 10, 102.0, 196.0, 5, 5), Camera(10, 10, 100.0, 200.0, 5, 5)
    assert metrics.relative_focal_error(estimate, truth) == pytest.approx(0.02)
    assert metrics.relative_focal_error(truth, truth) == 0.0


def test_a_sample_without_a_pose_counts_as_infinitely_wrong():
    lost = SampleError(400.0, math.inf, math.inf, math.inf)
    found = SampleSummary.of([SampleError(1.0, 0.5, 0.2, 3.0, 0.01), SampleError(2.0, 2.0, 0.4, 9.0, 0.03), lost])
    assert (found.samples, found.without_pose) == (3, 1)
    assert (found.te_m.median, found.te_m.max) == (2.0, math.inf)
    assert found.re_deg.median == 0.4
    assert (found.rpe_px.median, found.rpe_px.p90) == (9.0, math.inf)
    assert found.me_px.median == 2.0
    assert found.rfe.median == 0.02
    assert found.recall == {"1m_1deg": 1 / 3, "3m_3deg": 2 / 3, "5m_5deg": 2 / 3}
    # Giving up on the worse one makes nothing better.
    assert SampleSummary.of([SampleError(1.0, 0.5, 0.2, 3.0), lost, lost]).te_m.median == math.inf
    nothing = SampleSummary.of([])
    assert (nothing.samples, nothing.te_m.median, nothing.recall["1m_1deg"]) == (0, None, 0.0)
