"""Plane-to-plane maps."""

import cv2
import numpy as np
from hypothesis import given
from strategies import vectors

from ortholoc_edge.geometry import homography

TILTED = np.array([[1.1, 0.1, 5.0], [-0.2, 0.9, 30.0], [1e-4, 2e-4, 1.0]])


def test_warp_agrees_with_opencv():
    px = np.random.default_rng(1).uniform(0, 1000, (200, 2))
    want = cv2.perspectiveTransform(px[:, None], TILTED)[:, 0]
    assert np.allclose(homography.warp_points(TILTED, px), want, atol=1e-9)
    assert homography.warp_points(TILTED, np.empty((0, 2))).shape == (0, 2)


@given(vectors(800.0, 2))
def test_inverse_takes_points_back(px):
    mapped = homography.warp_points(TILTED, px[None])
    inverse = homography.positive_at(-np.linalg.inv(TILTED), mapped[0])
    assert np.allclose(homography.warp_points(inverse, mapped)[0], px, atol=1e-6)


def test_points_on_and_beyond_the_horizon_are_nan():
    # w = 1 - v / 100: the horizon is the row 100.
    matrix = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, -0.01, 1.0]])
    mapped = homography.warp_points(matrix, [[3.0, 50.0], [3.0, 100.0], [3.0, 150.0]])
    assert np.allclose(mapped[0], [6.0, 100.0])
    assert np.isnan(mapped[1:]).all()


def test_positive_at_turns_only_the_sign():
    at = [10.0, 20.0]
    for sign in (1.0, -1.0):
        assert np.array_equal(homography.positive_at(sign * TILTED, at), TILTED)
