"""Covariances against Monte Carlo and numerical Jacobians."""

import numpy as np
import pytest
from hypothesis import given
from strategies import poses, rotations, vectors

from ortholoc_edge.geometry import covariance as cov
from ortholoc_edge.geometry import rotation
from ortholoc_edge.geometry.rigid import Rigid3

MEASUREMENTS, PARAMETERS, GROUPS = 300, 6, 25


def fits(shared_sigma, own_sigma, seeds, random_labels=False):
    """Linear least squares with known errors: normalised errors squared, and the traces of the covariances."""
    nees, traces = [], []
    for seed in range(seeds):
        random = np.random.default_rng(seed)
        labels = np.repeat(np.arange(GROUPS), MEASUREMENTS // GROUPS)
        # Like projections, the rows of a group are alike: that is what makes shared errors hurt.
        base = random.normal(size=(GROUPS, 2, PARAMETERS))
        jacobian = base[labels] + 0.3 * random.normal(size=(MEASUREMENTS, 2, PARAMETERS))
        errors = own_sigma * random.normal(size=(MEASUREMENTS, 2))
        errors += shared_sigma * random.normal(size=(GROUPS, 2))[labels]
        flat = jacobian.reshape(-1, PARAMETERS)
        step = np.linalg.lstsq(flat, errors.ravel(), rcond=None)[0]
        residuals = errors - (flat @ step).reshape(-1, 2)
        clusters = random.permutation(labels) if random_labels else labels
        covariance = cov.clustered(jacobian, residuals, np.ones(MEASUREMENTS), clusters)
        nees.append(cov.mahalanobis_squared(step, covariance))
        traces.append(np.trace(covariance))
    return float(np.mean(nees)), float(np.mean(traces))


def test_clustered_is_honest_about_independent_errors():
    nees, _ = fits(0.0, 1.0, 400)
    # Six degrees of freedom; the factor is kept at one or more, so it may only be a little too modest.
    assert 4.8 < nees < 6.4


def test_clustered_grows_with_errors_that_groups_share():
    total = np.sqrt(1.0 + 0.5**2)
    independent_nees, independent = fits(0.0, total, 100)
    shared_nees, shared = fits(1.0, 0.5, 100)
    blind_nees, blind = fits(1.0, 0.5, 100, random_labels=True)
    assert shared > 4 * independent
    # Told the wrong groups it is far too sure; told the right ones it nearly is honest.
    assert blind < 2 * independent
    assert blind_nees > 4 * independent_nees
    assert 4.0 < shared_nees < 10.0


def test_clustered_does_not_depend_on_units_or_labels():
    random = np.random.default_rng(3)
    jacobian, residuals = random.normal(size=(90, 2, 6)), random.normal(size=(90, 2))
    labels, weights = np.arange(90) // 9, random.uniform(0.2, 1, 90)
    units = np.array([1e3, 1e3, 1e3, 1e-4, 1e-4, 1e-4])
    plain = cov.clustered(jacobian, residuals, weights, labels)
    assert np.allclose(plain, plain.T)
    assert np.linalg.eigvalsh(plain)[0] > 0
    scaled = cov.clustered(jacobian / units, residuals, weights, 1000 - 7 * labels)
    assert np.allclose(scaled, plain * np.outer(units, units), rtol=1e-8)


def test_clustered_known_answer():
    # One parameter, the mean of 2 N numbers: variance s^2 / (2 N) when every measurement is its own group.
    random = np.random.default_rng(4)
    residuals = random.normal(size=(5000, 2))
    residuals -= residuals.mean()
    found = cov.clustered(np.ones((5000, 2, 1)), residuals, np.ones(5000), np.arange(5000))
    assert found[0, 0] == pytest.approx(1.0 / 10_000, rel=0.06)


def test_clustered_refuses_what_is_not_determined():
    jacobian = np.random.default_rng(0).normal(size=(30, 2, 6))
    jacobian[:, :, 5] = 2 * jacobian[:, :, 4]
    with pytest.raises(np.linalg.LinAlgError):
        cov.clustered(jacobian, np.ones((30, 2)), np.ones(30), np.arange(30))


@pytest.mark.parametrize("angles_deg", [(0, 0, 0), (5, -8, 130), (20, 15, -60)])
def test_attitude_against_monte_carlo(angles_deg):
    sigma = np.radians([0.5, 1.0, 3.0])
    true = rotation.from_euler(*np.radians(angles_deg))
    # Map axes (east, north, up), as the tracker uses it.
    enu_from_ned = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])
    random = np.random.default_rng(8)
    errors = []
    for _ in range(6000):
        measured = rotation.from_euler(*(np.radians(angles_deg) + random.normal(size=3) * sigma))
        errors.append(rotation.log(enu_from_ned @ measured @ true.T @ enu_from_ned.T))
    found = np.cov(np.array(errors).T)
    claimed = cov.attitude(enu_from_ned @ true, tuple(sigma))
    tilt = np.radians(np.linalg.norm(angles_deg[:2]))
    # "To first order": what the tilt couples is left out.
    assert np.allclose(found, claimed, rtol=0, atol=(0.05 + 1.2 * np.sin(tilt)) * sigma[2] ** 2)
    assert np.allclose(np.diag(found)[:2].sum(), np.diag(claimed)[:2].sum(), rtol=0.08 + 10 * tilt**2)
    assert found[2, 2] == pytest.approx(claimed[2, 2], rel=0.08)


def test_attitude_known_answers():
    # Heading east, level: roll is about east, pitch about north or south, yaw about up.
    facing_east = np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]])
    assert np.allclose(cov.attitude(facing_east, (1.0, 2.0, 3.0)), np.diag([1.0, 4.0, 9.0]))
    facing_north = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])
    assert np.allclose(cov.attitude(facing_north, (1.0, 2.0, 3.0)), np.diag([4.0, 1.0, 9.0]))
    # On its tail there is no level forward; still a covariance with the yaw about up.
    on_tail = rotation.from_euler(0.0, np.pi / 2, 0.0)
    assert cov.attitude(on_tail, (1.0, 1.0, 3.0))[2, 2] == pytest.approx(9.0)


def spd(seed, size=6):
    root = np.random.default_rng(seed).normal(size=(size, size)) * ([1.0] * 3 + [0.01] * 3)[:size]
    return root.T @ root


@given(poses(100.0), vectors(5.0))
def test_moved_point_against_a_numerical_jacobian(pose, lever_body):
    lever = pose.rotation @ lever_body

    def moved(d):
        turned = Rigid3(rotation.exp(d[3:]) @ pose.rotation, pose.translation + d[:3])
        error = rotation.log(turned.rotation @ pose.rotation.T)
        return np.concatenate([turned.apply(lever_body), error])

    step = 1e-5
    jacobian = np.column_stack([(moved(step * e) - moved(-step * e)) / (2 * step) for e in np.eye(6)])
    covariance = spd(1)
    want = jacobian @ covariance @ jacobian.T
    assert np.allclose(cov.of_moved_point(covariance, lever), want, rtol=1e-4, atol=1e-6)


def test_moved_point_known_answer():
    # 1 m to the east of a body whose yaw has a sigma of 0.1 rad: 0.1 m to the north.
    covariance = np.diag([0.0, 0, 0, 0, 0, 0.01])
    moved = cov.of_moved_point(covariance, [1.0, 0.0, 0.0])
    assert np.allclose(np.diag(moved), [0, 0.01, 0, 0, 0, 0.01])
    assert moved[1, 5] == pytest.approx(0.01)
    back = cov.of_moved_point(moved, [-1.0, 0.0, 0.0])
    assert np.allclose(back, covariance)


@given(rotations(), vectors(3.0, 6))
def test_rotated_keeps_the_normalised_error(turn, difference):
    covariance = spd(2)
    turned = np.concatenate([turn @ difference[:3], turn @ difference[3:]])
    before = cov.mahalanobis_squared(difference, covariance)
    assert cov.mahalanobis_squared(turned, cov.rotated(covariance, turn)) == pytest.approx(before, rel=1e-6, abs=1e-9)


def test_rotated_known_answer():
    quarter = rotation.exp([0, 0, np.pi / 2])
    assert np.allclose(cov.rotated(np.diag([1.0, 2, 3, 4, 5, 6]), quarter), np.diag([2.0, 1, 3, 5, 4, 6]))


def test_mahalanobis_known_answer():
    assert cov.mahalanobis_squared([2.0, 3.0], np.diag([4.0, 1.0])) == pytest.approx(10.0)


def test_protection_levels_take_the_worst_horizontal_direction():
    """Turned by 30 degrees, so that neither axis shows it."""
    turn = rotation.from_euler(0.0, 0.0, np.radians(30.0))
    covariance = np.eye(6)
    covariance[:3, :3] = turn @ np.diag([4.0, 0.25, 9.0]) @ turn.T
    horizontal_m, vertical_m = cov.protection_levels(covariance)
    assert horizontal_m == pytest.approx(6.0 * 2.0)
    assert vertical_m == pytest.approx(5.33 * 3.0)
