"""The camera against OpenCV, and against itself at another size."""

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from strategies import cameras, finite

from ortholoc_edge.geometry.camera import Camera
from ortholoc_edge.geometry.grid import resize_px

LENS = Camera(1024, 768, 725.0, 731.0, 515.3, 379.8, (-0.21, 0.05, 1e-3, -7e-4, -0.003))


def pixels_of(camera, part_u, part_v):
    return np.array([part_u * camera.width - 0.5, part_v * camera.height - 0.5])


@given(cameras(), finite(0, 1), finite(0, 1), finite(0.1, 5000.0))
def test_unproject_then_project(camera, part_u, part_v, depth):
    px = pixels_of(camera, part_u, part_v)
    assert np.allclose(camera.project(camera.unproject(px) * depth), px, rtol=0, atol=1e-5)


@pytest.mark.parametrize("k1", [-0.25, 0.1, 0.3, 0.6])
def test_corners_of_strong_lenses(k1):
    camera = Camera(1280, 960, 700.0, 700.0, 639.5, 479.5, (k1, 0.05 if k1 < 0 else 0.0, 1e-3, -1e-3, 0.0))
    corners = np.array([[-0.5, -0.5], [1279.5, -0.5], [1279.5, 959.5], [640.0, 100.0]])
    assert np.allclose(camera.project(camera.unproject(corners)), corners, rtol=0, atol=1e-5)


def test_pixels_that_no_ray_reaches_are_nan():
    """r (1 - 0.4 r^2) never exceeds 0.61 focal lengths: the corners of this picture show nothing."""
    camera = Camera(1280, 960, 700.0, 700.0, 639.5, 479.5, (-0.4, 0.0, 0.0, 0.0, 0.0))
    rays = camera.unproject([[0.0, 0.0], [639.5, 479.5], [639.5 + 350.0, 479.5]])
    assert np.isnan(rays[0, :2]).all()
    assert np.allclose(rays[1], [0, 0, 1])
    assert camera.project(rays[2]) == pytest.approx([989.5, 479.5], abs=1e-5)
    assert not camera.contains(camera.undistorted_px([[0.0, 0.0]])).any()


@given(cameras(distorted=False), finite(-2, 2), finite(-2, 2), finite(0.1, 5000.0))
def test_project_then_unproject(camera, x, y, depth):
    ray = camera.unproject(camera.project(np.array([x, y, 1.0]) * depth))
    assert np.allclose(ray, [x, y, 1.0], atol=1e-9)


@given(cameras(), finite(-0.6, 0.6), finite(-0.6, 0.6), finite(0.5, 3000.0))
def test_project_agrees_with_opencv(camera, x, y, depth):
    point = np.array([x, y, 1.0]) * depth
    want, _ = cv2.projectPoints(point[None], np.zeros(3), np.zeros(3), camera.matrix, np.array(camera.distortion))
    assert np.allclose(camera.project(point), want.ravel(), rtol=0, atol=1e-6)


def test_undistorted_px_agrees_with_opencv():
    px = np.stack(np.meshgrid(np.linspace(0, 1023, 9), np.linspace(0, 767, 7)), axis=-1).reshape(-1, 2)
    criteria = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 100, 1e-12)
    want = cv2.undistortPoints(
        px[:, None], LENS.matrix, np.array(LENS.distortion), R=np.eye(3), P=LENS.matrix, criteria=criteria
    )
    assert np.allclose(LENS.undistorted_px(px), want[:, 0], rtol=0, atol=1e-4)
    assert np.allclose(LENS.pinhole().undistorted_px(px), px)


def test_known_answers():
    # f = 500: a point 1 m right and 2 m below at 10 m distance lies 50 px right, 100 px down of the middle.
    camera = Camera.from_focal(641, 481, 500.0)
    assert (camera.cx, camera.cy) == (320.0, 240.0)
    assert np.allclose(camera.project([1.0, 2.0, 10.0]), [370.0, 340.0])
    assert np.allclose(camera.matrix, [[500, 0, 320], [0, 500, 240], [0, 0, 1]])
    assert Camera(10, 10, 100.0, 400.0, 5.0, 5.0).focal_px == pytest.approx(200.0)


def test_points_not_in_front_have_no_pixel():
    px = LENS.project([[0.0, 0.0, 0.0], [1.0, 1.0, -5.0], [1.0, 1.0, np.nan], [0.1, 0.1, 5.0]])
    assert np.isnan(px[:3]).all()
    assert np.isfinite(px[3]).all()


@given(cameras(), st.integers(32, 6000), st.integers(32, 6000), finite(-0.5, 0.5), finite(-0.5, 0.5))
def test_resized_camera_sees_where_the_resized_image_shows(camera, width, height, x, y):
    point = np.array([x, y, 1.0]) * 40.0
    small = camera.resized(width, height)
    scale = (width / camera.width, height / camera.height)
    assert (small.width, small.height) == (width, height)
    assert np.allclose(small.project(point), resize_px(camera.project(point), scale), rtol=0, atol=1e-6)


@given(cameras(), st.integers(32, 6000), st.integers(32, 6000))
def test_resizing_there_and_back_is_the_same_camera(camera, width, height):
    again = camera.resized(width, height).resized(camera.width, camera.height)
    assert np.allclose(again.matrix, camera.matrix, rtol=1e-12, atol=1e-9)
    assert again.distortion == camera.distortion


@given(cameras(), st.integers(0, 500), finite(-0.5, 0.5), finite(-0.5, 0.5))
def test_padded_camera_moves_every_pixel_by_the_margin(camera, margin, x, y):
    point = [x, y, 1.0]
    wide = camera.padded(margin)
    assert (wide.width, wide.height) == (camera.width + 2 * margin, camera.height + 2 * margin)
    assert np.allclose(wide.project(point), camera.project(point) + margin, rtol=0, atol=1e-6)


def test_contains_is_the_sensor_with_its_outer_edges():
    inside = [(-0.5, -0.5), (1023.5, 767.5), (0, 0), (500, 300)]
    outside = [(-0.51, 0), (0, -0.51), (1023.51, 0), (0, 767.51), (np.nan, 1), (1, np.nan), (np.inf, 1)]
    assert LENS.contains(inside).all()
    assert not LENS.contains(outside).any()


@pytest.mark.parametrize(
    "values",
    [
        (0, 10, 1.0, 1.0, 0.0, 0.0),
        (10, 0, 1.0, 1.0, 0.0, 0.0),
        (10, 10, 0.0, 1.0, 0.0, 0.0),
        (10, 10, 1.0, -1.0, 0.0, 0.0),
        (10, 10, np.nan, 1.0, 0.0, 0.0),
        (10, 10, 1.0, 1.0, np.inf, 0.0),
        (10, 10, 1.0, 1.0, 0.0, 0.0, (np.nan, 0, 0, 0, 0)),
    ],
)
def test_a_camera_that_cannot_be_is_refused(values):
    with pytest.raises(ValueError, match="camera"):
        Camera(*values)
