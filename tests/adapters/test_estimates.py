"""What an estimate refuses, and the single figures that stand for its covariance."""

from __future__ import annotations

import math

import numpy as np
import pytest

from ortholoc_edge.adapters.mavlink.estimates import (
    VisionEstimate,
    horizontal_sigma_m,
    vertical_sigma_m,
    yaw_sigma_rad,
)
from ortholoc_edge.adapters.mavlink.geodesy import Place


def test_horizontal_sigma_is_of_the_longer_axis():
    covariance = np.diag([1.0, 1.0, 49.0, 1.0, 1.0, 0.09])
    covariance[:2, :2] = [[5.0, 4.0], [4.0, 5.0]]  # 3 m along north-east, 1 m across
    estimate = VisionEstimate(0, np.zeros(3), np.eye(3), covariance)
    assert horizontal_sigma_m(estimate) == pytest.approx(3.0)
    assert vertical_sigma_m(estimate) == pytest.approx(7.0)
    assert yaw_sigma_rad(estimate) == pytest.approx(0.3)


@pytest.mark.parametrize(
    "change",
    [
        {"position_ned_m": np.array([0.0, math.nan, 0.0])},
        {"position_ned_m": np.zeros(2)},
        {"position_ned_m": None},
        {"ned_from_body": np.diag([1.0, 1.0, -1.0])},
        {"ned_from_body": 2.0 * np.eye(3)},
        {"covariance": -np.eye(6)},
        {"covariance": np.triu(np.ones((6, 6)))},
        {"covariance": np.full((6, 6), math.inf)},
        {"reset_counter": 256},
        {"reset_counter": -1},
        {"quality": 1.5},
        {"quality": math.nan},
        {"stamp_ns": -1},
    ],
    ids=lambda change: next(iter(change)),
)
def test_unusable_estimate_is_refused(change):
    values = {"stamp_ns": 0, "position_ned_m": np.zeros(3), "ned_from_body": np.eye(3), "covariance": np.eye(6)}
    with pytest.raises(ValueError, match=next(iter(change))):
        VisionEstimate(**(values | change))


def test_a_place_is_enough():
    estimate = VisionEstimate(0, None, np.eye(3), np.eye(6), place=Place(50.0, 7.0, 100.0))
    assert estimate.position_ned_m is None
