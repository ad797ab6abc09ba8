"""Displacement from velocity."""

import numpy as np
import pytest
from hypothesis import given
from strategies import finite

from ortholoc_edge.pipeline.odometry import VelocityOdometry

SECOND = 1_000_000_000


def test_trapezia_are_exact_for_steady_acceleration():
    """v = 3 + 2 t for 4 s is 28 m, however the time is cut."""
    for count in (3, 5, 41):
        odometry = VelocityOdometry()
        for t in np.linspace(0, 4, count):
            assert odometry.add(round(t * SECOND), np.array([3 + 2 * t, -1.0, 0.5]))
        assert np.allclose(odometry.position_ned_m, [28, -4, 2])
        assert odometry.epoch == 1


@given(finite(-30, 30), finite(0.001, 2.9))
def test_steady_velocity(speed, elapsed_s):
    odometry = VelocityOdometry()
    odometry.add(10**15, np.array([speed, 0, 0]))
    odometry.add(10**15 + round(elapsed_s * SECOND), np.array([speed, 0, 0]))
    assert odometry.position_ned_m[0] == pytest.approx(speed * elapsed_s, abs=1e-6)


@pytest.mark.parametrize("gap_s", [3.01, 60.0, -0.1])
def test_a_gap_or_a_step_back_raises_the_epoch_and_moves_nothing(gap_s):
    odometry = VelocityOdometry()
    odometry.add(100 * SECOND, np.array([10.0, 0, 0]))
    assert odometry.epoch == 1
    assert odometry.add(round((100 + gap_s) * SECOND), np.array([10.0, 0, 0]))
    assert odometry.epoch == 2
    assert np.array_equal(odometry.position_ned_m, np.zeros(3))
    odometry.add(round((101 + gap_s) * SECOND), np.array([10.0, 0, 0]))
    assert np.allclose(odometry.position_ned_m, [10, 0, 0])
    assert odometry.epoch == 2


def test_three_seconds_are_no_gap():
    odometry = VelocityOdometry()
    odometry.add(0, np.array([1.0, 0, 0]))
    odometry.add(3 * SECOND, np.array([1.0, 0, 0]))
    assert odometry.epoch == 1
    assert odometry.position_ned_m[0] == pytest.approx(3.0)


@pytest.mark.parametrize("bad", [None, np.array([np.nan, 0, 0]), np.array([0, np.inf, 0])])
def test_without_a_velocity_the_integral_is_broken(bad):
    odometry = VelocityOdometry()
    odometry.add(0, np.array([5.0, 0, 0]))
    odometry.add(SECOND, np.array([5.0, 0, 0]))
    assert not odometry.add(2 * SECOND, bad)
    assert np.allclose(odometry.position_ned_m, [5, 0, 0])
    assert odometry.add(round(2.5 * SECOND), np.array([5.0, 0, 0]))
    assert odometry.epoch == 2
    assert np.allclose(odometry.position_ned_m, [5, 0, 0])


def test_the_same_stamp_twice_moves_nothing():
    odometry = VelocityOdometry()
    odometry.add(0, np.array([5.0, 0, 0]))
    odometry.add(0, np.array([5.0, 0, 0]))
    assert odometry.epoch == 1
    assert np.array_equal(odometry.position_ned_m, np.zeros(3))


def test_a_position_handed_out_does_not_move_later():
    odometry = VelocityOdometry()
    odometry.add(0, np.array([5.0, 0, 0]))
    kept = odometry.position_ned_m
    odometry.add(SECOND, np.array([5.0, 0, 0]))
    assert np.array_equal(kept, np.zeros(3))
