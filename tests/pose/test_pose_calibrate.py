"""Unknown focal lengths: found where they can be, refused where not."""

import numpy as np
import pytest
from scenes_pose import scene

from ortholoc_edge.geometry.camera import Camera
from ortholoc_edge.pose import calibrate, pnp


@pytest.mark.parametrize("focal_px", [650.0, 800.0, 1300.0])
def test_focal_length_is_found_where_the_view_is_tilted_over_relief(focal_px):
    camera = Camera.from_focal(1024, 768, focal_px)
    made = scene(1, tilt_deg=25.0, relief_m=15.0, camera=camera, count=500, noise_px=0.4)
    found = calibrate.solve(made.points, made.px, Camera.from_focal(1024, 768, 1024.0))
    assert found is not None
    assert found.camera.focal_px == pytest.approx(focal_px, rel=0.01)
    assert abs(found.camera.focal_px - focal_px) < 4 * found.focal_sigma_px
    assert found.focal_sigma_px < 0.01 * focal_px
    assert (found.camera.cx, found.camera.cy) == (511.5, 383.5)
    assert np.linalg.norm(found.local_from_camera.translation - made.local_from_camera.translation) < 2.0
    assert found.covariance.shape == (6, 6)


def test_focal_length_is_found_among_outliers():
    camera = Camera.from_focal(1024, 768, 820.0)
    made = scene(2, tilt_deg=25.0, relief_m=15.0, camera=camera, count=500, outliers=0.4)
    found = calibrate.solve(made.points, made.px, Camera.from_focal(1024, 768, 1024.0))
    assert found.camera.focal_px == pytest.approx(820.0, rel=0.02)


def test_flat_ground_from_straight_above_does_not_tell_the_focal_length():
    """The paper's ambiguity: twice the focal length from twice the height is the same picture."""
    camera = Camera.from_focal(1024, 768, 800.0)
    for seed in range(4):
        made = scene(seed, tilt_deg=0.0, relief_m=0.0, camera=camera, count=400)
        found = calibrate.solve(made.points, made.px, Camera.from_focal(1024, 768, 1024.0))
        if found is None:
            continue
        assert found.focal_sigma_px > calibrate.MAX_RELATIVE_FOCAL_SIGMA * found.camera.focal_px
        assert abs(found.focal_height_correlation) > 0.99


def test_longer_lens_from_farther_off_is_a_negative_movement_along_the_axis():
    """The optical axis points down: a larger focal length goes with a centre farther back."""
    camera = Camera.from_focal(1024, 768, 800.0)
    made = scene(1, tilt_deg=5.0, relief_m=3.0, camera=camera, count=500, noise_px=0.2)
    found = pnp.refine(made.points, made.px, camera, made.local_from_camera, max_error_px=5.0, free_focal=True)
    assert found.focal_height_correlation < -0.9


def test_a_first_guess_is_taken():
    camera = Camera.from_focal(1024, 768, 2500.0)
    made = scene(3, tilt_deg=30.0, relief_m=20.0, camera=camera, count=500)
    found = calibrate.solve(made.points, made.px, Camera.from_focal(1024, 768, 2300.0))
    assert found.camera.focal_px == pytest.approx(2500.0, rel=0.03)


def test_too_few_points_give_nothing():
    made = scene(0, count=5)
    assert calibrate.solve(made.points, made.px, Camera.from_focal(1024, 768, 1024.0)) is None
