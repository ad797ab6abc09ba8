"""Views of the map against the camera's own projection."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes_pipeline import pose_prior, ramp_window, turned_down
from strategies import finite

from ortholoc_edge.geometry import homography, rotation
from ortholoc_edge.geometry.camera import Camera
from ortholoc_edge.geometry.grid import RasterGrid
from ortholoc_edge.geometry.rigid import Rigid3
from ortholoc_edge.pipeline import precondition
from ortholoc_edge.pipeline.precondition import GroundPlane
from ortholoc_edge.pipeline.prior import MAX_RANGE_HEIGHTS, PosePrior, footprint
from ortholoc_edge.tiles.georeference import LocalFrame

WEST, TOP = 686_000.0, 5_330_000.0
GRID = RasterGrid(800, 640, WEST, TOP, 0.5, -0.5)
LOCAL = LocalFrame(WEST + 200.0, TOP - 160.0, 0.99965)
CAMERA = Camera.from_focal(320, 240, 300.0)


def local_plane(plane):
    """(a, b, c) over local metres of a plane over map metres from the grid's corner."""
    b, c = plane[1] * LOCAL.grid_scale, plane[2] * LOCAL.grid_scale
    corner = LOCAL.local_from_map([WEST, TOP, 0.0])
    return np.array([plane[0] - b * corner[0] - c * corner[1], b, c])


@settings(max_examples=60)
@given(finite(-35, 35), finite(-180, 180), finite(-0.2, 0.2), finite(-0.2, 0.2), finite(60, 150))
def test_homography_is_the_projection_of_the_plane(tilt_deg, heading_deg, slope_east, slope_north, height_m):
    plane = np.array([450.0, slope_east, slope_north])
    at = np.array([WEST + 210.0, TOP - 150.0])
    ground = plane[0] + (at - (WEST, TOP)) @ plane[1:]
    pose = Rigid3(turned_down(tilt_deg, heading_deg), [*at, ground + height_m])
    window = ramp_window(GRID, plane)
    matrix = precondition.view_homography(window, LOCAL, local_plane(plane), CAMERA, LOCAL.local_from_map_pose(pose))
    dop_px = np.random.default_rng(0).uniform((250, 200), (600, 400), (50, 2))
    xy = GRID.map_from_px(dop_px)
    points = np.column_stack([xy, plane[0] + (xy - (WEST, TOP)) @ plane[1:]])
    local_from_camera = LOCAL.local_from_map_pose(pose)
    want = CAMERA.project(local_from_camera.inverse().apply(LOCAL.local_from_map(points)))
    seen = np.isfinite(want).all(axis=1)
    assert seen.sum() > 10
    assert np.allclose(homography.warp_points(matrix, dop_px)[seen], want[seen], rtol=0, atol=1e-4)


@pytest.mark.parametrize(("tilt_deg", "slopes"), [(0, (0, 0)), (25, (0.1, -0.15)), (-30, (-0.2, 0.1))])
def test_predicted_view_shows_a_dot_where_the_camera_would(tilt_deg, slopes):
    """End to end: DSM to fitted plane to picture, at UTM coordinates and off the zone's central meridian."""
    plane = np.array([450.0, *slopes])
    window = ramp_window(GRID, plane)
    at = np.array([WEST + 205.0, TOP - 165.0])
    height = plane[0] + (at - (WEST, TOP)) @ plane[1:] + 110.0
    prior = pose_prior((*at, height), tilt_deg=tilt_deg, heading_deg=35.0)
    outline = footprint(CAMERA, prior.map_from_camera, height - 110.0)
    fitted = precondition.ground_plane(window, LOCAL, outline)
    assert fitted is not None
    assert np.allclose(fitted.abc[1:], local_plane(plane)[1:], atol=1e-5)
    assert fitted.relief_m < 1e-3
    # A dot on the ground that the picture's middle shows, give or take.
    middle = footprint(CAMERA, prior.map_from_camera, height - 110.0)[12]
    dop_px = np.round(GRID.px_from_map(middle + np.array([4.0, 7.0])))
    v, u = np.mgrid[: GRID.height, : GRID.width]
    dop = 255 * np.exp(-0.5 * ((u - dop_px[0]) ** 2 + (v - dop_px[1]) ** 2) / 3.0**2)
    window = replace(window, dop_grey=np.round(dop).astype(np.uint8))
    view = precondition.predicted_view(window, LOCAL, fitted, CAMERA, prior, True)
    xy = GRID.map_from_px(dop_px)
    point = np.array([*xy, plane[0] + (xy - (WEST, TOP)) @ plane[1:]])
    local_from_camera = LOCAL.local_from_map_pose(prior.map_from_camera)
    want = CAMERA.project(local_from_camera.inverse().apply(LOCAL.local_from_map(point))) + view.margin_px
    assert view.image.shape == (240 + 2 * view.margin_px, 320 + 2 * view.margin_px)
    # Where the dot is in the picture: the centroid, which perspective moves a little off a blob's centre.
    weight = np.where(view.image > 40, view.image, 0).astype(float)
    rows, columns = np.mgrid[: view.image.shape[0], : view.image.shape[1]]
    found = np.array([(columns * weight).sum(), (rows * weight).sum()]) / weight.sum()
    assert np.allclose(found, want, atol=0.15)
    # The matrix itself is exact.
    assert np.allclose(homography.warp_points(view.view_from_dop, dop_px[None])[0], want, atol=0.01)
    assert np.allclose(view.dop_px(want[None])[0], dop_px, atol=0.02)


def view_of(prior, plane=(0.0, 0.0, 0.0), camera=CAMERA):
    window = ramp_window(RasterGrid(600, 600, -300.0, 300.0, 1.0, -1.0), np.zeros(3))
    local = LocalFrame(0.0, 0.0, 1.0)
    window.dop_grey[:] = 128
    return precondition.predicted_view(window, local, GroundPlane(np.array(plane), 0.0), camera, prior, True)


@given(finite(0, 60), finite(-180, 180), st.integers(0, 1000))
@settings(max_examples=30)
def test_dop_px_inverts_the_view(tilt_deg, heading_deg, seed):
    view = view_of(pose_prior(tilt_deg=tilt_deg, heading_deg=heading_deg))
    rows, columns = np.nonzero(view.valid)
    pick = np.random.default_rng(seed).integers(0, len(rows), 30)
    px = np.column_stack([columns, rows])[pick].astype(float)
    assert np.allclose(homography.warp_points(view.view_from_dop, view.dop_px(px)), px, atol=1e-6)


def test_beyond_the_horizon_nothing_is_valid():
    """Straight ahead: the horizon is the middle row; the ground counts within eight heights of depth."""
    view = view_of(pose_prior(tilt_deg=90.0, sigma_m=(0.1,) * 3, sigma_deg=(0.1,) * 3))
    assert view.margin_px == 0
    rows = (np.arange(240) - CAMERA.cy) / CAMERA.fy
    assert not view.valid[rows * MAX_RANGE_HEIGHTS < 1.0].any()
    # In front, to the range and to the map's edge 300 m off: rows steeper than a third.
    assert view.valid[rows > 0.34][:, 100:220].all()


def test_dop_px_where_the_horizon_lies_below_the_middle_of_the_picture():
    view = view_of(
        pose_prior(tilt_deg=100.0, sigma_m=(0.1,) * 3, sigma_deg=(0.1,) * 3), camera=Camera.from_focal(320, 240, 120.0)
    )
    rows, columns = np.nonzero(view.valid)
    assert len(rows) > 100
    assert rows.min() > 120
    px = np.column_stack([columns, rows]).astype(float)
    back = view.dop_px(px)
    assert np.isfinite(back).all()
    # Ahead of the camera, which heads north from the middle of the raster.
    assert (back[:, 1] < 300).all()
    assert np.isnan(view.dop_px(np.array([[160.0, 20.0]]))).all()


def test_camera_below_the_plane_sees_nothing():
    assert not view_of(pose_prior((0.0, 0.0, -20.0))).valid.any()


def test_nodata_of_the_orthophoto_is_not_valid():
    window = ramp_window(RasterGrid(600, 600, -300.0, 300.0, 1.0, -1.0), np.zeros(3))
    window.dop_valid[:, :300] = False
    window.dop_grey[:] = 9
    prior = pose_prior(sigma_m=(0.1,) * 3, sigma_deg=(0.1,) * 3)
    local, plane = LocalFrame(0.0, 0.0, 1.0), GroundPlane(np.zeros(3), 0.0)
    view = precondition.predicted_view(window, local, plane, CAMERA, prior, True)
    # Heading north, west is on the left.
    assert not view.valid[:, :158].any()
    assert view.valid[:, 162:].all()


def test_an_uncertain_prior_gets_a_wider_view_and_a_larger_shift():
    sure, unsure = view_of(pose_prior()), view_of(pose_prior(sigma_m=(15.0, 15.0, 2.0)))
    assert unsure.margin_px > sure.margin_px
    assert unsure.max_shift_px > sure.max_shift_px
    # Three sigmas of 15 m at 100 m and f = 300 are 135 px.
    assert unsure.max_shift_px == pytest.approx(135, rel=0.2)
    hopeless = view_of(pose_prior(sigma_m=(500.0, 500.0, 2.0)))
    assert hopeless.margin_px == 160


@settings(max_examples=40)
@given(st.integers(0, 10_000))
def test_shift_bound_covers_what_the_prior_does(seed):
    """Ground points seen from a pose drawn from the prior lie within the bound: three sigmas in each direction."""
    random = np.random.default_rng(seed)
    prior = pose_prior(tilt_deg=10.0)
    view = view_of(prior)
    root = np.sqrt(np.diag(prior.covariance))
    step = np.clip(random.normal(size=6), -2.0, 2.0) * root
    truth = Rigid3(
        rotation.exp(step[3:]) @ prior.map_from_camera.rotation, prior.map_from_camera.translation + step[:3]
    )
    ground = np.column_stack([footprint(CAMERA, truth, 0.0), np.zeros(25)])
    seen = CAMERA.project(truth.inverse().apply(ground))
    expected = CAMERA.project(prior.map_from_camera.inverse().apply(ground))
    assert np.linalg.norm(seen - expected, axis=1).max() <= view.max_shift_px


def test_ground_plane_bends_little_for_roofs_and_stays_level_where_little_is_known():
    window = ramp_window(RasterGrid(400, 400, 0.0, 400.0, 1.0, -1.0), np.array([50.0, 0.1, 0.0]))
    local, outline = LocalFrame(0.0, 0.0, 1.0), np.array([[0.0, 0.0], [400.0, 400.0]])
    window.dsm[20:30, 20:40] += 15.0
    fitted = precondition.ground_plane(window, local, outline)
    assert np.allclose(fitted.abc, [50.0, 0.1, 0.0], atol=[1.5, 0.01, 0.01])
    window.dsm[:] = np.nan
    assert precondition.ground_plane(window, local, outline) is None
    # Some of the samples, too few to tell a slope from.
    window.dsm[50:60, 50:60] = np.linspace(76.0, 78.0, 10, dtype=np.float32)
    level = precondition.ground_plane(window, local, outline)
    assert level.abc == pytest.approx([77.0, 0.0, 0.0], abs=0.5)
    assert (level.abc[1:] == 0).all()


@pytest.mark.parametrize(("height", "width"), [(5, 9), (9, 5), (1, 4), (6, 6)])
def test_quarter_turns_show_what_their_homographies_say(height, width):
    grey = np.arange(height * width, dtype=np.uint8).reshape(height, width)
    window = ramp_window(RasterGrid(width, height, 0.0, 0.0, 1.0, -1.0), np.zeros(3), dsm_step=1)
    window.dop_valid[0, -1] = False
    views = precondition.quarter_turns(replace(window, dop_grey=grey))
    assert len(views) == 4
    u, v = np.meshgrid(np.arange(width), np.arange(height))
    dop_px = np.column_stack([u.ravel(), v.ravel()]).astype(float)
    for turns, view in enumerate(views):
        assert np.array_equal(view.image, np.rot90(grey, turns))
        px = homography.warp_points(view.view_from_dop, dop_px)
        column, row = np.round(px).astype(int).T
        assert np.array_equal(px, np.round(px))
        assert np.array_equal(view.image[row, column], grey.ravel())
        assert np.array_equal(view.valid[row, column], window.dop_valid.ravel())
        assert np.allclose(view.dop_px(px), dop_px)
        assert view.max_shift_px == np.inf
        # OpenCV's warp through the same matrix draws the same picture.
        size = view.image.shape[::-1]
        assert np.array_equal(cv2.warpPerspective(grey, view.view_from_dop, size), view.image)


def test_prior_of_the_view_is_not_needed_to_be_certain():
    prior = pose_prior()
    certain = PosePrior(prior.map_from_camera, np.zeros((6, 6)))
    assert view_of(certain).margin_px == 0
    assert view_of(certain).max_shift_px == pytest.approx(precondition._SHIFT_FLOOR_PX)
