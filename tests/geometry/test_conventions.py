"""Where the centre of a pixel is, by the libraries that this package hands pixels to."""

import cv2
import numpy as np
import poselib
import pytest
import rasterio.transform
from hypothesis import given, settings
from hypothesis import strategies as st
from strategies import rotations

from ortholoc_edge.geometry import rotation
from ortholoc_edge.geometry.camera import Camera
from ortholoc_edge.geometry.grid import RasterGrid, resize_px


def centroid(image):
    weight = image.astype(np.float64)
    v, u = np.mgrid[: image.shape[0], : image.shape[1]]
    return np.array([(u * weight).sum(), (v * weight).sum()]) / weight.sum()


def dot(width, height, at, sigma):
    v, u = np.mgrid[:height, :width]
    return np.exp(-0.5 * ((u - at[0]) ** 2 + (v - at[1]) ** 2) / sigma**2).astype(np.float32)


@pytest.mark.parametrize(
    ("size", "interpolation"),
    [
        ((160, 120), cv2.INTER_AREA),
        ((160, 120), cv2.INTER_LINEAR),
        ((80, 90), cv2.INTER_AREA),
        ((640, 480), cv2.INTER_LINEAR),
        ((500, 300), cv2.INTER_CUBIC),
    ],
)
def test_opencv_resize_moves_a_dot_as_resize_px_says(size, interpolation):
    at = np.array([101.3, 77.8])
    small = cv2.resize(dot(320, 240, at, 6.0), size, interpolation=interpolation)
    want = resize_px(at, (size[0] / 320, size[1] / 240))
    assert np.allclose(centroid(small), want, atol=0.02)
    # Without the half pixels the answer would be off by more than that.
    assert np.abs(at * (size[0] / 320, size[1] / 240) - want).max() > 0.1


def test_resized_camera_agrees_with_the_resized_photo():
    camera = Camera(320, 240, 300.0, 300.0, 155.2, 121.9)
    point = np.array([0.4, -0.7, 5.0])
    photo = cv2.resize(dot(320, 240, camera.project(point), 6.0), (128, 96), interpolation=cv2.INTER_AREA)
    assert np.allclose(centroid(photo), camera.resized(128, 96).project(point), atol=0.02)


def test_opencv_warps_take_integers_for_centres():
    image = np.random.default_rng(0).integers(0, 255, (20, 30), dtype=np.uint8)
    shift = np.array([[1.0, 0, 3], [0, 1, 2], [0, 0, 1]])
    moved = cv2.warpPerspective(image, shift, (30, 20), flags=cv2.INTER_LINEAR)
    assert np.array_equal(moved[2:, 3:], image[:-2, :-3])
    u, v = np.meshgrid(np.arange(30, dtype=np.float32), np.arange(20, dtype=np.float32))
    assert np.array_equal(cv2.remap(image, u, v, cv2.INTER_LINEAR), image)
    # Half a pixel is the mean of two neighbours.
    halfway = cv2.remap(image, u[:, :-1] + 0.5, v[:, :-1], cv2.INTER_LINEAR).astype(float)
    assert np.allclose(halfway, (image[:, :-1].astype(float) + image[:, 1:]) / 2, atol=0.51)


def test_gdal_counts_from_the_corner_and_we_from_the_centre():
    grid = RasterGrid(10, 10, 100.0, 200.0, 2.0, -2.0)
    affine = rasterio.transform.Affine(2.0, 0.0, 100.0, 0.0, -2.0, 200.0)
    assert rasterio.transform.xy(affine, 4.5, 2.5, offset="ul") == pytest.approx((105.0, 191.0))
    assert np.allclose(grid.px_from_map([105.0, 191.0]), [2.0, 4.0])


def poselib_pose(px, points, camera, shift=0.0):
    pose, _ = poselib.estimate_absolute_pose(
        px + shift,
        points,
        {
            "model": "PINHOLE",
            "width": camera.width,
            "height": camera.height,
            "params": [camera.fx, camera.fy, camera.cx + shift, camera.cy + shift],
        },
        {"max_reproj_error": 2.0, "seed": 0},
    )
    return np.asarray(pose.Rt)


@settings(max_examples=20)
@given(st.integers(0, 10_000), rotations())
def test_poselib_takes_any_convention_that_points_and_principal_point_share(seed, turn):
    random = np.random.default_rng(seed)
    camera = Camera.from_focal(1024, 768, 900.0)
    rays = camera.unproject(random.uniform((0, 0), (1023, 767), (60, 2)))
    seen = rays * random.uniform(40, 80, (60, 1))
    points = (seen - [1.0, 2.0, 3.0]) @ turn
    px = camera.project(seen)
    want = np.column_stack([turn, [1.0, 2.0, 3.0]])
    ours, theirs = poselib_pose(px, points, camera), poselib_pose(px, points, camera, 0.5)
    assert np.allclose(ours, want, atol=1e-6)
    assert np.allclose(theirs, want, atol=1e-6)


def test_half_a_pixel_of_principal_point_is_half_a_pixel_of_angle():
    """Depths differ by a hundred, so that no shift explains it: 0.5 px right and down is 0.5 sqrt(2) / f rad."""
    random = np.random.default_rng(5)
    camera = Camera.from_focal(1025, 769, 900.0)
    # A narrow field: across a wide one the turn per pixel varies.
    px = random.uniform((462, 334), (562, 434), (200, 2))
    points = camera.unproject(px) * random.uniform(20, 2000, (200, 1))
    wrong = Camera(1025, 769, 900.0, 900.0, camera.cx + 0.5, camera.cy + 0.5)
    turned = poselib_pose(px, points, wrong)[:, :3]
    assert rotation.angle_between(turned, np.eye(3)) == pytest.approx(0.5 * np.sqrt(2) / 900.0, rel=0.03)
