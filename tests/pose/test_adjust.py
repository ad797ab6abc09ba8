"""Poses from matches and a prediction, against exact data, numerical derivatives and statistics."""

from __future__ import annotations

import numpy as np
import pytest
from scenes_pose import CAMERA, Scene, looking_down, scene

from ortholoc_edge.geometry import rotation
from ortholoc_edge.geometry.arrays import FloatArray
from ortholoc_edge.geometry.camera import Camera
from ortholoc_edge.geometry.rigid import Rigid3
from ortholoc_edge.pose.adjust import Adjusted, PoseMeasurement, adjust

# Of a loss so wide that it is least squares.
SQUARES = (1e6,)
ODD = Camera(640, 480, 520.0, 555.0, 301.0, 262.0)
NOTHING = np.zeros((6, 6))


def moved(pose: Rigid3, offset_m: FloatArray | list[float], turn_rad: FloatArray | list[float]) -> Rigid3:
    return Rigid3(rotation.exp(turn_rad) @ pose.rotation, pose.translation + np.asarray(offset_m))


def information(count: int, sigma_px: float = 0.5) -> FloatArray:
    return np.repeat(np.eye(2)[None] / sigma_px**2, count, axis=0)


def prior(pose: Rigid3, sigma_m: float = 5.0, sigma_deg: float = 3.0) -> PoseMeasurement:
    return PoseMeasurement(pose, np.diag(1.0 / np.square([sigma_m] * 3 + [np.radians(sigma_deg)] * 3)))


def errors(one: Rigid3, other: Rigid3) -> tuple[float, float]:
    """Metres and degrees."""
    turn = np.degrees(rotation.angle_between(one.rotation, other.rotation))
    return float(np.linalg.norm(one.translation - other.translation)), float(turn)


def solve(
    made: Scene,
    start: Rigid3,
    measured: PoseMeasurement | None = None,
    scales: tuple[float, ...] = (300.0, 50.0, 5.0),
    sigma_px: float = 0.5,
) -> Adjusted:
    found = adjust(
        made.points,
        made.px,
        made.camera,
        start,
        information=information(len(made.px), sigma_px),
        measured=measured or PoseMeasurement(start, NOTHING),
        scales=scales,
    )
    assert found is not None
    return found


# -- the solution ------------------------------------------------------------


@pytest.mark.parametrize("camera", [CAMERA, ODD], ids=["plain", "odd"])
@pytest.mark.parametrize("tilt_deg", [0.0, 35.0, 60.0])
@pytest.mark.parametrize("seed", range(3))
def test_exact_data_give_the_exact_pose(seed: int, tilt_deg: float, camera: Camera) -> None:
    made = scene(seed, noise_px=0.0, tilt_deg=tilt_deg, camera=camera, count=100)
    random = np.random.default_rng(seed)
    offset, turn = (v / np.linalg.norm(v) for v in random.normal(size=(2, 3)))
    start = moved(made.local_from_camera, 3.0 * offset, np.radians(3.0) * turn)
    found = solve(made, start)
    off_m, off_deg = errors(found.local_from_camera, made.local_from_camera)
    assert off_m < 1e-5
    assert off_deg < 1e-5
    assert np.abs(found.residuals_px).max() < 1e-4
    assert found.weights == pytest.approx(np.ones(100), abs=1e-6)


def test_the_world_may_be_anywhere() -> None:
    made = scene(0, noise_px=0.3)
    there = np.array([647_000.0, 5_407_000.0, 400.0])
    start = moved(made.local_from_camera, [2.0, -1.0, 1.0], [0.01, 0.02, -0.02])
    here = solve(made, start)
    far = Scene(
        made.camera, moved(made.local_from_camera, there, [0, 0, 0]), made.points + there, made.px, made.right
    )
    elsewhere = solve(far, moved(start, there, [0, 0, 0]))
    assert elsewhere.local_from_camera.translation - there == pytest.approx(
        here.local_from_camera.translation, abs=1e-5
    )
    assert elsewhere.local_from_camera.rotation == pytest.approx(here.local_from_camera.rotation, abs=1e-7)


@pytest.mark.parametrize("seed", range(5))
def test_outliers_are_left_out(seed: int) -> None:
    """40 % anywhere within 6 px, as patches that found something else nearby are."""
    made = scene(seed, noise_px=0.4)
    random = np.random.default_rng(seed)
    wrong = random.permutation(len(made.px)) < 0.4 * len(made.px)
    made.px[wrong] += random.uniform(-6.0, 6.0, (int(wrong.sum()), 2))
    truth = made.local_from_camera
    start = moved(truth, [0.15, -0.2, 0.1], np.radians([0.1, -0.15, 0.2]))
    found = solve(made, start, prior(start, 1.0, 1.0), (15.0, 6.0, 3.0), 0.4)
    without = solve(
        Scene(made.camera, truth, made.points[~wrong], made.px[~wrong], made.right[~wrong]), start, scales=SQUARES
    )
    blind = solve(made, start, scales=SQUARES)
    off_m, off_deg = errors(found.local_from_camera, truth)
    assert off_m < 0.15
    assert off_deg < 0.1
    # Nearly as good as if they had been known, and better than if they had been believed.
    assert errors(found.local_from_camera, without.local_from_camera)[0] < 0.1
    assert errors(blind.local_from_camera, without.local_from_camera)[0] > errors(
        found.local_from_camera, without.local_from_camera
    )[0]
    assert np.median(found.weights[~wrong]) > 0.6
    far = wrong & (np.linalg.norm(found.residuals_px, axis=1) > 4.0)
    assert far.sum() > 20
    assert found.weights[far].max() < 0.1


def test_sure_places_count_more() -> None:
    """Two halves that disagree by 2 px: the pose is the surer half's."""
    made = scene(1, noise_px=0.0, count=200)
    made.px[:100, 0] += 2.0
    start = made.local_from_camera
    sure = information(200)
    sure[:100] /= 1e4
    found = adjust(
        made.points, made.px, CAMERA, start, information=sure, measured=PoseMeasurement(start, NOTHING), scales=SQUARES
    )
    assert found is not None
    assert np.abs(found.residuals_px[100:]).max() < 0.01
    assert found.residuals_px[:100, 0] == pytest.approx(np.full(100, -2.0), abs=0.02)


def test_a_place_that_is_sure_along_one_direction_only() -> None:
    """Edges: every match is right across its line and wrong by pixels along it."""
    made = scene(2, noise_px=0.0, count=200)
    random = np.random.default_rng(0)
    angle = random.uniform(0, np.pi, 200)
    along = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    made.px[:] += along * random.uniform(-3.0, 3.0, 200)[:, None]
    across = np.stack([-along[:, 1], along[:, 0]], axis=1)
    sure = 25.0 * across[:, :, None] * across[:, None, :]
    start = moved(made.local_from_camera, [0.5, 0.3, -0.4], [0.005, -0.004, 0.01])
    found = adjust(
        made.points, made.px, CAMERA, start, information=sure, measured=PoseMeasurement(start, NOTHING), scales=SQUARES
    )
    assert found is not None
    off_m, off_deg = errors(found.local_from_camera, made.local_from_camera)
    assert off_m < 1e-4
    assert off_deg < 1e-4


# -- what comes with it ------------------------------------------------------


def residuals(made: Scene, pose: Rigid3) -> FloatArray:
    """By the camera's own projection."""
    return made.camera.project(pose.inverse().apply(made.points)) - made.px


@pytest.mark.parametrize("camera", [CAMERA, ODD], ids=["plain", "odd"])
@pytest.mark.parametrize("tilt_deg", [0.0, 50.0])
def test_residuals_and_their_jacobian(tilt_deg: float, camera: Camera) -> None:
    made = scene(3, noise_px=1.0, tilt_deg=tilt_deg, camera=camera, count=40)
    found = solve(made, made.local_from_camera)
    pose = found.local_from_camera
    assert found.residuals_px == pytest.approx(residuals(made, pose), abs=1e-9)
    assert found.jacobian.shape == (40, 2, 6)
    for k in range(6):
        step = 1e-4 if k < 3 else 1e-6
        change = np.zeros(6)
        change[k] = step
        ahead, behind = (residuals(made, moved(pose, s * change[:3], s * change[3:])) for s in (1, -1))
        assert found.jacobian[:, :, k] == pytest.approx((ahead - behind) / (2 * step), rel=1e-5, abs=1e-3), k


def test_taking_the_first() -> None:
    made = scene(0, count=30)
    found = solve(made, made.local_from_camera)
    some = found.take(12)
    assert len(some.residuals_px) == len(some.weights) == len(some.jacobian) == 12
    assert some.local_from_camera is found.local_from_camera
    assert np.array_equal(some.jacobian, found.jacobian[:12])


def test_same_call_same_bits() -> None:
    made = scene(4, outliers=0.3)
    start = moved(made.local_from_camera, [1.0, 0.0, 1.0], [0.01, 0.0, 0.02])
    one, two = (solve(made, start, prior(start)) for _ in range(2))
    assert np.array_equal(one.local_from_camera.translation, two.local_from_camera.translation)
    assert np.array_equal(one.local_from_camera.rotation, two.local_from_camera.rotation)
    assert np.array_equal(one.weights, two.weights)


# -- with a prediction -------------------------------------------------------


@pytest.mark.parametrize("count", [0, 50])
def test_without_matches_the_prediction_stays(count: int) -> None:
    made = scene(5, count=max(count, 1))
    predicted = moved(made.local_from_camera, [4.0, -3.0, 2.0], np.radians([2.0, -1.0, 4.0]))
    start = moved(predicted, [1.0, 1.0, -2.0], np.radians([-2.0, 1.0, 3.0]))
    found = adjust(
        made.points[:count], made.px[:count], CAMERA, start,
        information=np.zeros((count, 2, 2)), measured=prior(predicted), scales=(5.0, 2.0),
    )  # fmt: skip
    assert found is not None
    off_m, off_deg = errors(found.local_from_camera, predicted)
    assert off_m < 1e-6
    assert off_deg < 1e-4
    assert found.residuals_px.shape == (count, 2)


def test_a_sure_prediction_wins() -> None:
    made = scene(6, noise_px=0.2)
    predicted = moved(made.local_from_camera, [0.5, 0.4, -0.3], np.radians([0.3, -0.2, 0.5]))
    found = solve(made, made.local_from_camera, prior(predicted, 1e-5, 1e-5), SQUARES)
    off_m, off_deg = errors(found.local_from_camera, predicted)
    assert off_m < 1e-3
    assert off_deg < 1e-3


def test_an_unsure_prediction_changes_nothing() -> None:
    made = scene(6, noise_px=0.2)
    predicted = moved(made.local_from_camera, [5.0, 4.0, -3.0], np.radians([3.0, -2.0, 5.0]))
    free = solve(made, made.local_from_camera, scales=SQUARES)
    found = solve(made, made.local_from_camera, prior(predicted, 1e4, 1e4), SQUARES)
    assert errors(found.local_from_camera, free.local_from_camera)[0] < 1e-4


def test_between_matches_and_prediction_the_weighted_mean() -> None:
    """Least squares in one step, where the problem is as good as linear: by the normal equations."""
    made = scene(7, noise_px=0.3, count=25)
    free = solve(made, made.local_from_camera, scales=SQUARES)
    j = free.jacobian.reshape(-1, 6)
    normal = j.T @ j / 0.5**2
    offset = np.array([0.2, -0.1, 0.15, 1e-3, -2e-3, 1.5e-3])
    predicted = moved(free.local_from_camera, offset[:3], offset[3:])
    # As sure as the matches, with errors that hang together.
    known = 0.8 * normal
    found = solve(made, free.local_from_camera, PoseMeasurement(predicted, known), SQUARES)
    expected = np.linalg.solve(normal + known, known @ offset)
    turn = rotation.log(found.local_from_camera.rotation @ free.local_from_camera.rotation.T)
    assert found.local_from_camera.translation - free.local_from_camera.translation == pytest.approx(
        expected[:3], abs=2e-3
    )
    assert turn == pytest.approx(expected[3:], abs=2e-5)


def test_attitude_alone_may_be_known() -> None:
    """A prediction without a position: 0 is for what is not known."""
    made = scene(8, noise_px=0.3)
    upright = np.diag([0.0] * 3 + [1e12] * 3)
    predicted = moved(made.local_from_camera, [500.0, 0.0, 0.0], [0.0, 0.0, 0.0])
    found = solve(made, moved(made.local_from_camera, [3.0, 0.0, 0.0], [0, 0, 0]), PoseMeasurement(predicted, upright))
    off_m, off_deg = errors(found.local_from_camera, made.local_from_camera)
    assert off_m < 0.1
    assert off_deg < 1e-4


def test_the_measurement_s_error() -> None:
    pose = Rigid3(looking_down(20.0, 50.0), [1.0, 2.0, 30.0])
    turn = np.array([0.02, -0.03, 0.5])
    other = moved(pose, [0.5, -1.0, 2.0], turn)
    assert prior(pose).error(pose) == pytest.approx(np.zeros(6), abs=1e-12)
    assert prior(pose).error(other) == pytest.approx([0.5, -1.0, 2.0, *turn], abs=1e-9)


def on_a_line(count: int = 40, noise_px: float = 0.3) -> tuple[Scene, FloatArray]:
    """Points along a road on level ground, and its direction."""
    made = scene(9, count=count, tilt_deg=0.0, noise_px=0.0)
    direction = np.array([np.cos(0.5), np.sin(0.5), 0.0])
    centre = np.append(made.local_from_camera.translation[:2], 0.0)
    points = centre + np.linspace(-35.0, 35.0, count)[:, None] * direction
    px = made.camera.project(made.local_from_camera.inverse().apply(points))
    px += np.random.default_rng(0).normal(size=px.shape) * noise_px
    return Scene(made.camera, made.local_from_camera, points, px, made.right), direction


def test_along_what_the_matches_do_not_tell_the_prediction_stays() -> None:
    """Around a line of points the camera could swing: the pose does, by no more than the prediction allows."""
    made, direction = on_a_line()
    truth = made.local_from_camera
    swing = np.radians(2.0)
    about = rotation.exp(swing * direction)
    centre = np.append(truth.translation[:2], 0.0)
    predicted = Rigid3(about @ truth.rotation, centre + about @ (truth.translation - centre))
    # All the points are seen from there as from the truth.
    px = made.camera.project(predicted.inverse().apply(made.points))
    assert np.abs(px - made.px).max() < 1.5
    found = solve(made, predicted, prior(predicted, 3.0, 3.0), (10.0, 4.0))
    turn = rotation.log(found.local_from_camera.rotation @ predicted.rotation.T)
    assert abs(turn @ direction) < np.radians(0.3)
    assert errors(found.local_from_camera, predicted)[0] < 1.0
    # From a prediction that is off across, what the line does tell is put right.
    off = moved(truth, [2.0, -1.0, 1.5], np.radians([0.0, 0.0, 2.0]))
    found = solve(made, off, prior(off, 3.0, 3.0), (40.0, 10.0, 4.0))
    assert np.linalg.norm(found.residuals_px, axis=1).mean() < 0.6


def test_too_few_matches_and_a_prediction() -> None:
    made = scene(10, count=2, noise_px=0.0)
    predicted = moved(made.local_from_camera, [2.0, -1.0, 0.5], np.radians([0.5, 0.5, 1.0]))
    found = solve(made, predicted, prior(predicted, 3.0, 1.0), SQUARES)
    assert np.abs(found.residuals_px).max() < 0.5
    assert errors(found.local_from_camera, made.local_from_camera)[0] < 3.0


def test_nothing_known_is_no_pose() -> None:
    start = Rigid3(looking_down(), [0.0, 0.0, 50.0])
    found = adjust(
        np.empty((0, 3)), np.empty((0, 2)), CAMERA, start,
        information=np.empty((0, 2, 2)), measured=PoseMeasurement(start, NOTHING), scales=(5.0,),
    )  # fmt: skip
    assert found is None


def test_a_line_alone_is_no_pose_or_one_that_fits() -> None:
    """Rounding may make it solvable: then by no wild step."""
    made, _ = on_a_line(noise_px=0.0)
    found = adjust(
        made.points, made.px, made.camera, made.local_from_camera,
        information=information(len(made.px)), measured=PoseMeasurement(made.local_from_camera, NOTHING),
        scales=SQUARES,
    )  # fmt: skip
    if found is not None:
        assert np.abs(found.residuals_px).max() < 1e-3


def test_points_behind_the_camera_take_no_part() -> None:
    made = scene(11, noise_px=0.2, count=80)
    truth = made.local_from_camera
    points = np.vstack([made.points, truth.apply([[3.0, 1.0, -20.0], [0.0, 0.0, 0.0], [0.0, 0.0, -5.0]])])
    px = np.vstack([made.px, np.full((3, 2), 400.0)])
    start = moved(truth, [0.3, -0.2, 0.2], [0.002, 0.003, -0.002])
    found = solve(Scene(CAMERA, truth, points, px, made.right), start, prior(start))
    alone = solve(made, start, prior(start))
    assert np.isinf(found.residuals_px[80:]).all()
    assert not found.weights[80:].any()
    assert not found.jacobian[80:].any()
    assert found.local_from_camera.translation == pytest.approx(alone.local_from_camera.translation, abs=1e-9)
    assert found.local_from_camera.rotation == pytest.approx(alone.local_from_camera.rotation, abs=1e-12)


def test_all_behind_the_camera_the_prediction_stays() -> None:
    made = scene(11, count=20)
    up = Rigid3(made.local_from_camera.rotation @ np.diag([1.0, -1.0, -1.0]), made.local_from_camera.translation)
    found = solve(made, up, prior(up))
    assert errors(found.local_from_camera, up)[0] < 1e-9
    assert np.isinf(found.residuals_px).all()


# -- how sure ----------------------------------------------------------------


@pytest.mark.parametrize("tilt_deg", [0.0, 45.0])
def test_errors_are_as_large_as_the_information_says(tilt_deg: float) -> None:
    """Normalised error squared of 200 draws of matches and prediction: 6 on average, give or take 0.25."""
    random = np.random.default_rng(0)
    sigma_px = 0.5
    spread = np.array([0.5, 0.4, 0.6, 0.01, 0.008, 0.02])
    squared = []
    for _ in range(200):
        made = scene(0, count=12, noise_px=sigma_px, tilt_deg=tilt_deg, random=random)
        truth = made.local_from_camera
        off = random.normal(size=6) * spread
        # What is known is the truth as seen from the prediction: R_true = exp(d) R.
        predicted = moved(truth, off[:3], off[3:])
        known = PoseMeasurement(predicted, np.diag(1.0 / spread**2))
        found = solve(made, predicted, known, SQUARES, sigma_px)
        j = found.jacobian.reshape(-1, 6)
        normal = j.T @ j / sigma_px**2 + known.information
        error = PoseMeasurement(truth, NOTHING).error(found.local_from_camera)
        squared.append(float(error @ normal @ error))
    assert 0.8 < np.mean(squared) / 6.0 < 1.25
