"""The renderer draws things where `Camera.project` says they are."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from ortholoc_sim.camera import Placement, Renderer, Sensor
from ortholoc_sim.world import Scene, base_height

from ortholoc_edge.geometry import rotation
from ortholoc_edge.geometry.camera import Camera
from ortholoc_edge.geometry.frames import BODY_FROM_NADIR_CAMERA, map_from_ned_rotation
from ortholoc_edge.geometry.rigid import Rigid3
from ortholoc_edge.pose import pnp

CLEAN = Sensor(noise=0.0, blur_px=0.0, vignetting=0.0, jpeg_quality=0)
PLACE = Placement(1000.0, 5000.0, 0.9998)
CAMERA = Camera.from_focal(640, 480, 540.0)


def pose(x_m: float, y_m: float, height_m: float, roll: float = 0.0, pitch: float = 0.0, yaw: float = 0.0) -> Rigid3:
    """Local metres and degrees."""
    turn = rotation.from_euler(*np.deg2rad([roll, pitch, yaw]))
    eye = np.array([PLACE.west_m + x_m, PLACE.south_m + y_m, height_m])
    return Rigid3(map_from_ned_rotation(0.0) @ turn @ BODY_FROM_NADIR_CAMERA, eye)


def projected(camera: Camera, map_from_camera: Rigid3, points_map: np.ndarray) -> np.ndarray:
    """Pixels of map points; horizontal map lengths become true ones first."""
    true = points_map - map_from_camera.translation
    true[..., :2] /= PLACE.grid_scale
    return camera.project(true @ map_from_camera.rotation)


@pytest.fixture(scope="module")
def renderer(flight: Scene) -> Renderer:
    return Renderer(flight, PLACE, CLEAN)


POSES = [
    pose(160, 140, 520),
    pose(150, 150, 515, 6, -9, 70),
    pose(120, 160, 525, 0, 28, 200),
    pose(200, 100, 500, -20, 5, 310),
]


@pytest.mark.parametrize("view_pose", POSES)
def test_pixels_show_the_points_that_project_to_them(renderer: Renderer, view_pose: Rigid3) -> None:
    view = renderer.view(CAMERA, view_pose)
    assert np.isfinite(view.points_map).all()
    v, u = np.mgrid[0 : CAMERA.height, 0 : CAMERA.width]
    error = projected(CAMERA, view_pose, view.points_map) - np.stack([u, v], axis=-1)
    assert float(np.abs(error).max()) < 0.05


@pytest.mark.parametrize("view_pose", POSES)
def test_points_lie_on_the_surface_and_nothing_stands_before_them(
    renderer: Renderer, flight: Scene, view_pose: Rigid3
) -> None:
    view = renderer.view(CAMERA, view_pose)
    local = (view.points_map - np.array([PLACE.west_m, PLACE.south_m, 0.0])).reshape(-1, 3)[::97]
    eye = view_pose.translation - np.array([PLACE.west_m, PLACE.south_m, 0.0])
    surface = heights(flight, local[:, :2])
    on_ground = (view.objects.ravel()[::97] == 0) & (local[:, 0] > 1) & (local[:, 1] > 1)
    # Next to a house the interpolated surface is a steep slope; the rest of the ground is met exactly.
    assert np.percentile(np.abs(local[on_ground, 2] - surface[on_ground]), 97) < 0.05
    for t in np.linspace(0.3, 0.99, 150):
        at = eye + t * (local - eye)
        assert (heights(flight, at[:, :2]) - at[:, 2]).max() < 0.8


def heights(scene: Scene, xy: np.ndarray) -> np.ndarray:
    px = scene.spec.grid.px_from_map(xy).astype(np.float32)
    return cv2.remap(scene.surface, px[None, :, 0], px[None, :, 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)[
        0
    ]


def test_roof_outlines_are_where_their_corners_project(renderer: Renderer, flight: Scene) -> None:
    """Corners of flat roofs, known from the layout, against the region that the picture shows as that roof."""
    checked = 0
    for index, house in enumerate(flight.buildings):
        if house.rise_m > 0 or not (50 < house.x_m < 270 and 50 < house.y_m < 230):
            continue
        # From 145 m a pixel is a texel of the small world.
        view_pose = pose(house.x_m + 14, house.y_m - 10, 575, 4, -6, 35)
        view = renderer.view(CAMERA, view_pose)
        top = base_height(flight.spec, flight.terrain, house) + house.eave_m
        corners = np.column_stack([house.corners + np.array([PLACE.west_m, PLACE.south_m]), np.full(4, top)])
        px = projected(CAMERA, view_pose, corners)
        # Chimneys and boxes stand on the roof and hide parts beyond it: compare the outline, filled.
        roof = ((view.objects == index + 1) & ~view.facade).astype(np.uint8)
        expected = np.zeros_like(roof)
        cv2.fillConvexPoly(expected, np.round(px * 16).astype(np.int32), 1, cv2.LINE_8, 4)
        near_tree = view.objects[cv2.dilate(expected, np.ones((5, 5), np.uint8)) > 0] >= 10_000
        if near_tree.any():
            continue
        # Boxes may stick out over the far edge; one pixel at most may be missing along any edge.
        missing = cv2.erode(expected, np.ones((3, 3), np.uint8)) & ~(roof | view.facade.astype(np.uint8))
        assert missing.sum() < 0.006 * expected.sum()  # at the very corners
        centres = [np.argwhere(mask).mean(axis=0) for mask in (roof, expected)]
        assert np.abs(centres[0] - centres[1]).max() < 0.7
        outside = roof & (1 - cv2.dilate(expected, np.ones((3, 3), np.uint8)))
        assert outside.sum() < 0.05 * expected.sum()
        checked += 1
    assert checked >= 2


@pytest.mark.parametrize("view_pose", POSES)
def test_dots_on_the_ground_are_seen_where_they_project(flight: Scene, view_pose: Rigid3) -> None:
    """Painted on the texture at known places, found in the picture as spots of light."""
    grid, spec = flight.spec.grid, flight.spec
    texture = np.zeros_like(flight.texture)
    rng = np.random.default_rng(3)
    at = rng.uniform((20, 20), (spec.width_m - 20, spec.height_m - 20), (1500, 2))
    columns, rows = np.round(grid.px_from_map(at)).astype(int).T
    on_ground = flight.objects[rows, columns] == 0
    columns, rows = columns[on_ground], rows[on_ground]
    for column, row in zip(columns, rows, strict=True):
        # As large as three of the picture's pixels.
        cv2.circle(texture, (int(column), int(row)), 2, (255, 255, 255), -1)
    image = Renderer(replace(flight, texture=texture), PLACE, CLEAN).render(CAMERA, view_pose)[..., 0]
    points = np.column_stack(
        [
            PLACE.west_m + (columns + 0.5) * spec.gsd_m,
            PLACE.south_m + spec.height_m - (rows + 0.5) * spec.gsd_m,
            flight.surface[rows, columns],
        ]
    )
    errors = []
    y, x = np.mgrid[:17, :17]
    for u, v in projected(CAMERA, view_pose, points):
        if not (9 <= u < CAMERA.width - 9 and 9 <= v < CAMERA.height - 9):
            continue
        left, top = round(u) - 8, round(v) - 8
        patch = image[top : top + 17, left : left + 17].astype(float)
        rim = np.concatenate([patch[[0, -1]].ravel(), patch[:, [0, -1]].ravel()])
        if patch.max() < 80 or rim.any() or cv2.connectedComponents((patch > 40).astype(np.uint8))[0] != 2:
            continue  # behind something, or two in one
        seen = np.array([(patch * x).sum() + left * patch.sum(), (patch * y).sum() + top * patch.sum()]) / patch.sum()
        errors.append(seen - (u, v))
    assert len(errors) >= 20
    off = np.linalg.norm(errors, axis=1)
    assert np.median(off) < 0.1
    # A dot at a wall's foot is cut, and where one is hidden its neighbour is taken for it.
    assert (off < 0.5).mean() > 0.8
    errors = [error for error, length in zip(errors, off, strict=True) if length < 0.5]
    assert np.abs(np.mean(errors, axis=0)).max() < 0.1


@pytest.mark.parametrize("view_pose", POSES)
def test_its_own_truth_as_matches_gives_the_pose_to_millimetres(renderer: Renderer, view_pose: Rigid3) -> None:
    view = renderer.view(CAMERA, view_pose)
    u, v = (axis.ravel() for axis in np.meshgrid(np.arange(4, 640, 16), np.arange(4, 480, 16)))
    points = view.points_map[v, u] - view_pose.translation
    points[:, :2] /= PLACE.grid_scale
    found = pnp.solve(points, np.column_stack([u, v]).astype(float), CAMERA, max_error_px=2.0)
    assert found is not None
    assert np.linalg.norm(found.local_from_camera.translation) < 0.005
    assert rotation.angle_between(found.local_from_camera.rotation, view_pose.rotation) < 1e-4


def test_nadir_scale_and_orientation(renderer: Renderer, flight: Scene) -> None:
    """Nose north over the world: the picture's top is north, its right east, a pixel is height over focal length."""
    view_pose = pose(160, 140, 530)
    view = renderer.view(CAMERA, view_pose)
    points = view.points_map
    middle = points[240, 320]
    above_ground = 530 - middle[2]
    assert middle[:2] == pytest.approx([1160, 5140], abs=0.3)
    assert points[100, 320, 1] > middle[1] > points[400, 320, 1]
    assert points[240, 500, 0] > middle[0] > points[240, 100, 0]
    step = points[240, 321, 0] - points[240, 320, 0]
    assert step == pytest.approx(above_ground / 540.0 * PLACE.grid_scale, rel=0.1)
    # The same ground, the same colours: the view is the flight epoch's texture seen through a lens.
    local = points[..., :2] - np.array([PLACE.west_m, PLACE.south_m])
    px = flight.spec.grid.px_from_map(local).astype(np.float32)
    texture = cv2.remap(flight.texture, px[..., 0], px[..., 1], cv2.INTER_LINEAR)
    ground = view.objects == 0
    assert np.abs(texture[ground].astype(int) - view.image[ground]).mean() < 6


def test_walls_are_seen_from_the_side_they_face(renderer: Renderer) -> None:
    oblique = renderer.view(CAMERA, pose(160, 60, 500, 0, 35, 0))
    straight = renderer.view(CAMERA, pose(160, 140, 520))
    assert oblique.facade.mean() > 1.3 * straight.facade.mean() > 0


def test_horizon_is_sky_and_sensor_is_repeatable(flight: Scene) -> None:
    renderer = Renderer(flight, PLACE)
    level = pose(20, 140, 480, 0, 75, 90)
    view = renderer.view(CAMERA, level, seed=4)
    assert np.isnan(view.points_map[:60, 320]).all()
    assert np.isfinite(view.points_map[450, 320]).all()
    assert np.array_equal(view.image, renderer.render(CAMERA, level, seed=4))
    assert not np.array_equal(view.image, renderer.render(CAMERA, level, seed=5))


def test_lens_distortion_bends_the_picture_as_the_camera_model_says(renderer: Renderer) -> None:
    camera = Camera(640, 480, 540.0, 540.0, 319.5, 239.5, (-0.12, 0.03, 0.001, -0.001, 0.0))
    view_pose = pose(150, 150, 515, 6, -9, 70)
    view = renderer.view(camera, view_pose)
    v, u = np.mgrid[0:480, 0:640]
    error = projected(camera, view_pose, view.points_map) - np.stack([u, v], axis=-1)
    assert float(np.abs(error).max()) < 0.05
