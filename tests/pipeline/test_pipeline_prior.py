"""Where to look."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes_pipeline import WIDE, pose_prior, turned_down
from strategies import finite

from ortholoc_edge.geometry import rotation
from ortholoc_edge.geometry.camera import Camera
from ortholoc_edge.geometry.rigid import Rigid3
from ortholoc_edge.pipeline import prior as priors
from ortholoc_edge.pipeline.prior import PosePrior, footprint, hypotheses, search_bounds

STEP_RAD = np.pi / 6


def test_nadir_footprint_known_answer():
    """f = 200 px, 400 x 300 px from 100 m: 200 m across, 150 m deep; the picture's top is the nose's side."""
    at = (500_000.0, 5_300_000.0, 350.0)
    north = footprint(WIDE, Rigid3(turned_down(), at), 250.0)
    assert np.allclose(north.min(axis=0), (500_000 - 100, 5_300_000 - 75))
    assert np.allclose(north.max(axis=0), (500_000 + 100, 5_300_000 + 75))
    # The first sample is the top left corner.
    assert np.allclose(north[0], (500_000 - 100, 5_300_000 + 75))
    east = footprint(WIDE, Rigid3(turned_down(heading_deg=90), at), 250.0)
    assert np.allclose(np.ptp(east, axis=0), (150, 200))
    assert np.allclose(east[0], (500_000 + 75, 5_300_000 + 100))


def test_tilted_footprint_known_answer():
    # Nose up by 20 degrees, north: the axis meets the ground 100 tan(20) ahead.
    camera = Camera.from_focal(401, 301, 400.0)
    seen = footprint(camera, Rigid3(turned_down(20.0), (0.0, 0.0, 100.0)), 0.0)
    middle = len(seen) // 2
    assert np.allclose(seen[middle], (0.0, 100 * np.tan(np.radians(20))))


def test_oblique_footprint_is_cut_at_the_range():
    """Looking 80 degrees off nadir, the upper half sees the sky: those rays end at eight heights."""
    pose = Rigid3(turned_down(80.0), (10.0, 20.0, 100.0))
    seen = footprint(WIDE, pose, 0.0)
    reach = np.linalg.norm(seen - (10.0, 20.0), axis=1)
    assert np.isfinite(seen).all()
    assert reach.max() <= priors.MAX_RANGE_HEIGHTS * 100.0 + 1e-6
    assert reach.max() > 0.9 * priors.MAX_RANGE_HEIGHTS * 100.0


@settings(max_examples=50)
@given(finite(0, 40), finite(-180, 180), finite(20, 3000))
def test_footprint_points_project_onto_their_pixels(tilt_deg, heading_deg, height_m):
    pose = Rigid3(turned_down(tilt_deg, heading_deg), (3e5, 5e6, 200.0 + height_m))
    camera = Camera.from_focal(640, 480, 800.0)
    seen = footprint(camera, pose, 200.0)
    px = camera.project(pose.inverse().apply(np.column_stack([seen, np.full(len(seen), 200.0)])))
    assert np.allclose(px.min(axis=0), (-0.5, -0.5), atol=1e-3)
    assert np.allclose(px.max(axis=0), (639.5, 479.5), atol=1e-3)


@given(st.integers(0, 5), finite(1.1, 5.0), finite(0.5, 4.0))
def test_search_bounds_never_shrink_with_uncertainty(which, growth, sigmas):
    sure = pose_prior()
    seen = footprint(WIDE, sure.map_from_camera, 0.0)
    factor = np.ones(6)
    factor[which] = growth
    unsure = PosePrior(sure.map_from_camera, sure.covariance * np.outer(factor, factor))
    narrow, wide = search_bounds(seen, sure, 0.0, sigmas), search_bounds(seen, unsure, 0.0, sigmas)
    assert wide[0] <= narrow[0]
    assert wide[1] <= narrow[1]
    assert wide[2] >= narrow[2]
    assert wide[3] >= narrow[3]
    more = search_bounds(seen, sure, 0.0, 2 * sigmas)
    assert more[0] < narrow[0]
    assert more[3] > narrow[3]


def test_search_bounds_known_answer():
    # Nothing but 3 m of position: two sigmas are 6 m on every side of the 200 x 150 m.
    prior = pose_prior(sigma_m=(3.0, 3.0, 0.0), sigma_deg=(0.0, 0.0, 0.0))
    bounds = search_bounds(footprint(WIDE, prior.map_from_camera, 0.0), prior, 0.0, 2.0)
    assert bounds == pytest.approx((-106.0, -81.0, 106.0, 81.0))


def test_sigmas_of_a_prior():
    prior = pose_prior(sigma_m=(2.0, 5.0, 3.0), sigma_deg=(1.0, 2.0, 4.0))
    assert prior.position_sigma_m == pytest.approx(5.0)
    assert prior.height_sigma_m == pytest.approx(3.0)
    assert np.degrees(prior.tilt_sigma_rad) == pytest.approx(2.0)
    assert np.degrees(prior.heading_sigma_rad) == pytest.approx(4.0)
    with pytest.raises(ValueError, match="prior covariance"):
        PosePrior(prior.map_from_camera, np.full((6, 6), np.nan))


def turns_of(found, prior):
    return np.array([rotation.log(h.map_from_camera.rotation @ prior.map_from_camera.rotation.T)[2] for h in found])


def offsets_of(found, prior):
    return np.array([h.map_from_camera.translation - prior.map_from_camera.translation for h in found])


@given(finite(0.1, 15.0), finite(0.1, 29.0))
def test_a_good_prior_is_its_own_only_hypothesis(heading_deg, position_m):
    prior = pose_prior(sigma_m=(position_m, position_m, 2.0), sigma_deg=(1.0, 1.0, heading_deg))
    found = hypotheses(prior, 100.0)
    assert len(found) == 1
    assert found[0] is prior


@given(finite(0.5, 400.0))
def test_headings_within_two_sigmas_are_within_a_step_of_a_hypothesis(sigma_deg):
    prior = pose_prior(sigma_deg=(1.0, 1.0, sigma_deg))
    turns = turns_of(hypotheses(prior, 1000.0), prior)
    for error in np.linspace(-1, 1, 41) * min(np.radians(2 * sigma_deg), np.pi):
        apart = np.abs(np.angle(np.exp(1j * (turns - error))))
        assert apart.min() <= STEP_RAD + 1e-9
    assert abs(turns[0]) < 1e-12
    assert len(turns) <= 12


def test_unknown_heading_is_the_whole_circle_once():
    prior = pose_prior(tilt_deg=10.0, sigma_deg=(1.0, 1.0, 180.0))
    found = hypotheses(prior, 1000.0)
    turns = turns_of(found, prior)
    assert len(found) == 12
    assert np.allclose(np.sort(np.mod(turns, 2 * np.pi)), STEP_RAD * np.arange(12), atol=1e-9)
    assert np.allclose(offsets_of(found, prior), 0)
    # Each knows its heading to half a step, and nothing of the tilt changed.
    for one in found:
        assert one.heading_sigma_rad == pytest.approx(STEP_RAD / 2)
        assert np.allclose(one.covariance[:5, :5], prior.covariance[:5, :5])
        assert np.allclose(one.map_from_camera.rotation[2], prior.map_from_camera.rotation[2])


@settings(max_examples=40)
@given(finite(1.0, 80.0), finite(0.2, 1.0), finite(0, np.pi))
def test_positions_cover_the_two_sigma_ellipse(sigma_m, ratio, direction):
    turn = rotation.exp([0, 0, direction])[:2, :2]
    covariance = np.diag(np.square([1, 1, 2, 0.01, 0.01, 0.02]))
    covariance[:2, :2] = turn @ np.diag([sigma_m**2, (ratio * sigma_m) ** 2]) @ turn.T
    prior = PosePrior(Rigid3(turned_down(), (0.0, 0.0, 100.0)), covariance)
    found = hypotheses(prior, 100.0)
    if found is None:
        assert sigma_m > 30.0, "a prior that one view or a few cover was refused"
        return
    offsets = offsets_of(found, prior)[:, :2]
    root = np.linalg.cholesky(covariance[:2, :2])
    angles = np.linspace(0, 2 * np.pi, 40)
    for radius in (0.5, 1.0, 1.5, 2.0):
        for inside in (radius * np.column_stack([np.cos(angles), np.sin(angles)])) @ root.T:
            # One view covers a shift of 0.6 of the footprint.
            assert np.linalg.norm(offsets - inside, axis=1).min() <= 60.0


def test_hypotheses_come_likeliest_first():
    prior = pose_prior(sigma_m=(45.0, 45.0, 2.0), sigma_deg=(1.0, 1.0, 20.0))
    found = hypotheses(prior, 100.0)
    assert len(found) > 9
    offsets, turns = offsets_of(found, prior), turns_of(found, prior)
    squared = np.sum((offsets[:, :2] / 45.0) ** 2, axis=1) + (turns / np.radians(20.0)) ** 2
    assert squared[0] == pytest.approx(0.0)
    assert (np.diff(squared) > -1e-9).all()


def test_a_hopeless_prior_is_refused():
    assert hypotheses(pose_prior(sigma_m=(900.0, 900.0, 5.0)), 100.0) is None
    assert hypotheses(pose_prior(sigma_m=(1e7, 1e7, 5.0)), 100.0) is None


def test_a_long_and_narrow_prior_is_not_refused():
    found = hypotheses(pose_prior(sigma_m=(160.0, 5.0, 5.0)), 100.0)
    assert found is not None
    assert 5 < len(found) <= priors.MAX_HYPOTHESES


@pytest.mark.parametrize(
    ("focal_px", "tilt_deg", "sigma_deg"), [(1500.0, 0.0, 2.0), (725.0, 0.0, 1.0), (640.0, 45.0, 1.0)]
)
def test_search_bounds_hold_the_true_footprint(focal_px, tilt_deg, sigma_deg):
    camera = Camera.from_focal(640, 480, focal_px)
    prior = pose_prior(tilt_deg=tilt_deg, sigma_m=(2.0, 2.0, 2.0), sigma_deg=(sigma_deg, sigma_deg, 3.0))
    bounds = np.array(search_bounds(footprint(camera, prior.map_from_camera, 0.0), prior, 0.0, 2.5))
    random, held = np.random.default_rng(0), 0
    root = np.linalg.cholesky(prior.covariance)
    for _ in range(400):
        error = root @ random.normal(size=6)
        pose = prior.map_from_camera
        true = Rigid3(rotation.exp(error[3:]) @ pose.rotation, pose.translation + error[:3])
        seen = footprint(camera, true, 0.0)
        held += bool((seen.min(axis=0) >= bounds[:2]).all() and (seen.max(axis=0) <= bounds[2:]).all())
    assert held >= 0.95 * 400


def test_hypotheses_have_covariances_that_are_covariances():
    prior = pose_prior(sigma_m=(60.0, 10.0, 2.0), sigma_deg=(1.0, 1.0, 40.0))
    coupled = prior.covariance.copy()
    coupled[0, 5] = coupled[5, 0] = 0.9 * np.sqrt(coupled[0, 0] * coupled[5, 5])
    for one in hypotheses(PosePrior(prior.map_from_camera, coupled), 100.0):
        assert np.linalg.eigvalsh(one.covariance)[0] > 0
