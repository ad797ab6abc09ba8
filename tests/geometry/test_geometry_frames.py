"""Frames in words, and against PROJ."""

import numpy as np
import pyproj
import pytest
from hypothesis import given
from strategies import finite

from ortholoc_edge.geometry import frames, rotation

CAMERA_RIGHT, CAMERA_DOWN, CAMERA_FORWARD = np.eye(3)
BODY_FORWARD, BODY_RIGHT, BODY_DOWN = np.eye(3)
EAST, NORTH, UP = np.eye(3)


def test_constants_are_rotations_or_their_own_inverse_and_read_only():
    for turn in (frames.ENU_FROM_NED, *frames.MOUNTS.values()):
        assert np.array_equal(turn @ turn.T, np.eye(3))
        assert np.linalg.det(turn) == pytest.approx(1.0)
        assert not turn.flags.writeable
    assert np.array_equal(frames.ENU_FROM_NED @ frames.ENU_FROM_NED, np.eye(3))


def test_nadir_camera_in_words():
    turn = frames.BODY_FROM_NADIR_CAMERA
    assert np.array_equal(turn @ CAMERA_FORWARD, BODY_DOWN)  # looks down
    assert np.array_equal(turn @ -CAMERA_DOWN, BODY_FORWARD)  # top of the image toward the nose
    assert np.array_equal(turn @ CAMERA_RIGHT, BODY_RIGHT)


@pytest.mark.parametrize(
    ("name", "top"),
    [
        ("nadir-nose-up", BODY_FORWARD),
        ("nadir-right-up", BODY_RIGHT),
        ("nadir-tail-up", -BODY_FORWARD),
        ("nadir-left-up", -BODY_RIGHT),
    ],
)
def test_nadir_mounts_have_the_image_s_top_where_they_say(name, top):
    turn = frames.MOUNTS[name]
    assert np.array_equal(turn @ CAMERA_FORWARD, BODY_DOWN)
    assert np.array_equal(turn @ -CAMERA_DOWN, top)


def test_forward_camera_in_words():
    turn = frames.BODY_FROM_FORWARD_CAMERA
    assert np.array_equal(turn @ CAMERA_FORWARD, BODY_FORWARD)
    assert np.array_equal(turn @ -CAMERA_DOWN, -BODY_DOWN)  # top of the image up
    assert np.array_equal(turn @ CAMERA_RIGHT, BODY_RIGHT)


def test_enu_from_ned_in_words():
    assert np.array_equal(frames.ENU_FROM_NED @ [1, 0, 0], NORTH)
    assert np.array_equal(frames.ENU_FROM_NED @ [0, 1, 0], EAST)
    assert np.array_equal(frames.ENU_FROM_NED @ [0, 0, 1], -UP)


def test_convergence_sign():
    # Grid north lies clockwise of true north: true north points west of grid north.
    turn = frames.map_from_ned_rotation(np.radians(2.0))
    true_north = turn @ [1, 0, 0]
    assert np.allclose(true_north, [-np.sin(np.radians(2)), np.cos(np.radians(2)), 0])
    assert np.allclose(frames.map_from_ned_rotation(0.0), frames.ENU_FROM_NED)
    assert np.allclose(turn @ [0, 0, 1], -UP)


@given(finite(-0.1, 0.1), finite(-3.1, 3.1))
def test_yaw_on_the_grid_is_true_yaw_less_convergence(convergence, yaw):
    nose = frames.map_from_ned_rotation(convergence) @ rotation.from_euler(0, 0, yaw) @ BODY_FORWARD
    grid_yaw = np.arctan2(nose[0], nose[1])
    assert np.sin((grid_yaw - (yaw - convergence)) / 2) == pytest.approx(0, abs=1e-9)


@pytest.mark.parametrize(("lon", "lat"), [(11.0, 48.0), (7.0, 48.0), (11.9, 70.0), (6.1, 60.0), (11.0, 5.0)])
def test_convergence_against_proj(lon, lat):
    """A step along the true meridian, measured in the grid, is where the rotation puts north."""
    proj = pyproj.Proj("EPSG:32632")
    convergence = np.radians(proj.get_factors(lon, lat).meridian_convergence)
    step = np.subtract(proj(lon, lat + 1e-4), proj(lon, lat - 1e-4))
    true_north = frames.map_from_ned_rotation(convergence) @ [1, 0, 0]
    assert np.allclose(true_north[:2], step / np.linalg.norm(step), atol=1e-6)


@given(finite(-89.9, 89.9), finite(-180, 180), finite(-100, 9000))
def test_ecef_against_pyproj(lat, lon, height):
    to_ecef = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)
    want = to_ecef.transform(lon, lat, height)
    assert np.allclose(frames.ecef_from_geodetic(np.radians(lat), np.radians(lon), height), want, rtol=0, atol=1e-6)


@given(finite(-85, 85), finite(-180, 180), finite(-100, 9000))
def test_ned_axes_are_the_directions_of_growing_latitude_longitude_and_falling_height(lat, lon, height):
    at = np.radians([lat, lon])
    turn = frames.ned_from_ecef_rotation(*at)
    assert np.allclose(turn @ turn.T, np.eye(3), atol=1e-12)
    step = 1e-6
    north = frames.ecef_from_geodetic(at[0] + step, at[1], height) - frames.ecef_from_geodetic(*at, height)
    east = frames.ecef_from_geodetic(at[0], at[1] + step, height) - frames.ecef_from_geodetic(*at, height)
    down = frames.ecef_from_geodetic(*at, height - 1.0) - frames.ecef_from_geodetic(*at, height)
    for axis, moved in enumerate((north, east, down)):
        assert np.allclose(turn @ moved / np.linalg.norm(moved), np.eye(3)[axis], atol=1e-5)
