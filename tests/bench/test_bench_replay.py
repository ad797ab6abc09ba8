"""The simulated autopilot errs as it says it does."""

import numpy as np
import pytest
from hypothesis import given
from strategies import finite

from ortholoc_edge.bench import replay
from ortholoc_edge.bench.replay import Length, PriorKind, PriorNoise, SimulatedAutopilot
from ortholoc_edge.errors import ConfigError
from ortholoc_edge.geometry import frames, rotation
from ortholoc_edge.geometry.camera import Camera
from ortholoc_edge.geometry.covariance import mahalanobis_squared
from ortholoc_edge.geometry.rigid import Rigid3

SECOND = 1_000_000_000
ATTITUDE = rotation.from_euler(*np.radians([4.0, -6.0, 130.0]))
CONVERGENCE, SCALE = np.radians(1.4), 0.9996
NOISE = PriorNoise((0.8, 1.2, 4.0), (Length(metres=3.0), Length(of_height=0.05)), 0.03, 0.1)


def pose_at(*xyz):
    turn = frames.map_from_ned_rotation(CONVERGENCE) @ ATTITUDE @ frames.BODY_FROM_NADIR_CAMERA
    return Rigid3(turn, np.array(xyz, dtype=float))


def states(kind, seed, positions, noise=NOISE, every_s=5):
    autopilot = SimulatedAutopilot(kind, noise, seed)
    return [
        autopilot.state(k * every_s * SECOND, pose_at(*at), ATTITUDE, 100.0, CONVERGENCE, SCALE)
        for k, at in enumerate(positions)
    ]


PATH = [(40.0 * k, -30.0 * k, 200.0 + k) for k in range(6)]


def values(made):
    return [
        np.concatenate(
            [
                s.ned_from_body.ravel(),
                [] if s.odometry_ned_m is None else s.odometry_ned_m,
                [] if s.position_map_m is None else s.position_map_m,
            ]
        )
        for s in made
    ]


@pytest.mark.parametrize("kind", [PriorKind.ODOMETER, PriorKind.GPS])
def test_same_seed_same_values(kind):
    one, two = (values(states(kind, 7, PATH)) for _ in range(2))
    assert all(np.array_equal(a, b) for a, b in zip(one, two, strict=True))
    assert not np.array_equal(one[0], values(states(kind, 8, PATH))[0])


def test_who_gets_what():
    odometer, gps = states(PriorKind.ODOMETER, 0, PATH), states(PriorKind.GPS, 0, PATH)
    assert [s.position_map_m is not None for s in odometer] == [True] + [False] * 5
    assert all(s.odometry_ned_m is not None for s in odometer)
    assert all(s.position_map_m is not None and s.odometry_ned_m is None for s in gps)
    assert odometer[0].position_sigma_m == pytest.approx((3.0, 5.0))
    assert odometer[0].attitude_sigma_rad == pytest.approx(tuple(np.radians([0.8, 1.2, 4.0])))
    assert [s.stamp_ns for s in odometer] == [5 * SECOND * k for k in range(6)]


def test_without_noise_it_tells_the_truth():
    silent = PriorNoise((0, 0, 0), (Length(), Length()), 0.0, 0.0)
    made = states(PriorKind.ODOMETER, 0, PATH, silent)
    for state, at in zip(made, PATH, strict=True):
        assert np.allclose(state.ned_from_body, ATTITUDE)
        true_m = np.array(at) - PATH[0]
        true_m[:2] /= SCALE
        ned = frames.map_from_ned_rotation(CONVERGENCE).T @ true_m
        assert np.allclose(state.odometry_ned_m - made[0].odometry_ned_m, ned, atol=1e-9)
    assert np.allclose(made[0].position_map_m, PATH[0])


def test_error_statistics_are_the_stated_sigmas():
    attitude, position, odometry = [], [], []
    for seed in range(800):
        first, second = states(PriorKind.ODOMETER, seed, [PATH[0], PATH[1]])
        error = rotation.log(first.ned_from_body @ ATTITUDE.T)
        nose = ATTITUDE[:2, 0] / np.linalg.norm(ATTITUDE[:2, 0])
        attitude.append([error[:2] @ nose, error[:2] @ (-nose[1], nose[0]), error[2]])
        position.append(first.position_map_m - PATH[0])
        true = np.subtract(PATH[1], PATH[0]) / (SCALE, SCALE, 1.0)
        odometry.append(
            second.odometry_ned_m - first.odometry_ned_m - frames.map_from_ned_rotation(CONVERGENCE).T @ true
        )
    assert np.allclose(np.degrees(np.std(attitude, axis=0)), (0.8, 1.2, 4.0), rtol=0.08)
    assert np.allclose(np.std(position, axis=0), (3.0, 3.0, 5.0), rtol=0.08)
    # 50 m in 5 s and a climb of 1 m: 3 % of these, and 0.1 m/s.
    assert np.allclose(np.std(odometry, axis=0), np.hypot([1.5, 1.5, 0.03], 0.5), rtol=0.08)
    for errors in (attitude, position, odometry):
        assert (np.abs(np.mean(errors, axis=0)) < 4 * np.std(errors, axis=0) / np.sqrt(800)).all()


def test_noisy_prior_is_honest():
    truth = pose_at(5.0, 6.0, 200.0)
    random = np.random.default_rng(3)
    nees = []
    for _ in range(600):
        prior = replay.noisy_prior(truth, 100.0, NOISE, random)
        step = truth.translation - prior.map_from_camera.translation
        turn = rotation.log(truth.rotation @ prior.map_from_camera.rotation.T)
        nees.append(mahalanobis_squared(np.concatenate([step, turn]), prior.covariance))
    assert np.mean(nees) == pytest.approx(6.0, abs=0.6)


def test_paper_region_contains_the_footprint_and_little_more():
    camera = Camera.from_focal(400, 300, 200.0)
    truth = Rigid3(np.diag([1.0, -1.0, -1.0]), (1000.0, 2000.0, 150.0))
    for seed in range(30):
        west, south, east, north = replay.paper_region(camera, truth, 50.0, np.random.default_rng(seed))
        # 200 x 150 m; up to 20 m on every side.
        assert 880 <= west <= 900
        assert 1100 <= east <= 1120
        assert 1905 <= south <= 1925
        assert 2075 <= north <= 2095


@pytest.mark.parametrize(
    ("text", "want", "at_100_m"),
    [
        ("5", Length(metres=5.0), 5.0),
        ("5m", Length(metres=5.0), 5.0),
        (" 2.5 m ", Length(metres=2.5), 2.5),
        (".5m", Length(metres=0.5), 0.5),
        ("4%", Length(of_height=0.04), 4.0),
        ("0", Length(), 0.0),
    ],
)
def test_lengths(text, want, at_100_m):
    assert Length.parse(text) == want
    assert Length.parse(text).at(100.0) == pytest.approx(at_100_m)


@pytest.mark.parametrize("text", ["", "m", "-5", "5km", "5 5", "nan", "inf", "1e3", "%", "5m%", "٥x"])
def test_what_is_no_length_is_refused(text):
    with pytest.raises(ConfigError, match="no length"):
        Length.parse(text)


@pytest.mark.parametrize("relative", [False, True])
@given(value=finite(0.01, 99_999.0))
def test_lengths_print_as_they_are_read(relative, value):
    length = Length(of_height=value / 100) if relative else Length(metres=value)
    again = Length.parse(str(length))
    assert again.metres == pytest.approx(length.metres, rel=1e-5)
    assert again.of_height == pytest.approx(length.of_height, rel=1e-5)
