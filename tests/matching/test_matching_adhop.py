"""Homographies that are found and homographies that are refused."""

import cv2
import numpy as np
import pytest

from ortholoc_edge.geometry.homography import warp_points
from ortholoc_edge.matching.adhop import fit_homography

SHAPE = (768, 1024)
TILTED = np.array([[0.9, 0.2, 30.0], [-0.15, 1.1, 12.0], [2e-4, -1e-4, 1.0]])


def _points(count: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform((0, 0), (SHAPE[1], SHAPE[0]), (count, 2))


@pytest.mark.parametrize("outliers", [0, 150, 350])
def test_known_homography_is_recovered_among_outliers(outliers: int) -> None:
    rng = np.random.default_rng(1)
    src = _points(500)
    dst = warp_points(TILTED, src) + rng.normal(scale=0.3, size=src.shape)
    dst[:outliers] = _points(outliers, seed=2)
    fitted = fit_homography(src, dst, 3.0, src_shape=SHAPE)
    assert fitted is not None
    homography, inliers = fitted
    assert inliers[outliers:].all()
    assert inliers[:outliers].sum() <= 3
    assert np.linalg.norm(homography) == pytest.approx(1.0)
    corners = np.array([[0.0, 0.0], [1023.0, 0.0], [0.0, 767.0], [1023.0, 767.0]])
    np.testing.assert_allclose(warp_points(homography, corners), warp_points(TILTED, corners), atol=1.0)


def test_equal_input_gives_equal_output_whatever_the_generator() -> None:
    src = _points(300)
    dst = warp_points(TILTED, src)
    dst[:200] = _points(200, seed=3)
    first = fit_homography(src, dst, 3.0)
    cv2.setRNGSeed(1234)
    second = fit_homography(src, dst, 3.0)
    assert first is not None
    assert second is not None
    np.testing.assert_array_equal(first[0], second[0])
    np.testing.assert_array_equal(first[1], second[1])


def test_points_far_from_the_origin_do_as_well() -> None:
    """Normalisation inside: map coordinates of a UTM zone instead of pixels."""
    offset = np.array([5e5, 5.3e6])
    src = _points(200)
    fitted = fit_homography(src + offset, src * 2.0, 1.0)
    assert fitted is not None
    assert fitted[1].all()


def test_chance_is_no_homography() -> None:
    for seed in range(20):
        assert fit_homography(_points(200, seed), _points(200, seed + 100), 5.0) is None


def _line(count: int) -> np.ndarray:
    along = np.linspace(0, 1000, count)
    return np.stack([along, 0.5 * along + np.random.default_rng(0).normal(size=count)], axis=1)


MIRRORING = np.array([[-1.0, 0, 1024], [0, 1, 0], [0, 0, 1]])
REFUSED = {
    "too few": (_points(9), _points(9)),
    "none": (np.empty((0, 2)), np.empty((0, 2))),
    "mirrored": (_points(200), warp_points(MIRRORING, _points(200))),
    "one line": (_line(200), _line(200) + 4.0),
    "one point": (np.full((50, 2), 7.0), np.full((50, 2), 9.0)),
    "to one point": (_points(100), np.full((100, 2), 400.0) + _points(100) * 1e-4),
    "to a line": (_points(100), _points(100) * (1.0, 1e-3)),
    "nan": (_points(50), np.full((50, 2), np.nan)),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_is_no_view_of_a_plane_is_refused(case: str) -> None:
    src, dst = REFUSED[case]
    assert fit_homography(src, dst, 3.0) is None


def test_a_horizon_in_the_frame_is_refused_on_request() -> None:
    # Third coordinate falls to zero at u = 900, right of all points but inside the frame.
    beyond = np.array([[1.0, 0, 0], [0, 1, 0], [-1 / 900, 0, 1]])
    src = _points(300) * (0.6, 1.0)
    dst = warp_points(beyond, src)
    assert fit_homography(src, dst, 3.0) is not None
    assert fit_homography(src, dst, 3.0, src_shape=SHAPE) is None


def test_input_is_checked() -> None:
    with pytest.raises(ValueError, match="do not pair"):
        fit_homography(np.zeros((5, 2)), np.zeros((6, 2)), 1.0)
    with pytest.raises(ValueError, match="must be positive"):
        fit_homography(_points(20), _points(20), 0.0)
