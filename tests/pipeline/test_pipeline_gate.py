"""One row per reason to refuse."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from scenes_pipeline import WIDE, pose_prior, turned_down
from strategies import finite

from ortholoc_edge.geometry import rotation
from ortholoc_edge.geometry.rigid import Rigid3
from ortholoc_edge.pipeline import gate
from ortholoc_edge.pipeline.gate import GateOptions
from ortholoc_edge.pipeline.outcome import Reason
from ortholoc_edge.pose.pnp import PoseEstimate

OPTIONS = GateOptions(
    min_inliers=20,
    min_inlier_ratio=0.2,
    min_spread=0.1,
    max_rms_ratio=0.6,
    max_innovation_sigmas=5.0,
    max_relative_sigma=0.1,
)
GOOD = Rigid3(turned_down(), (0.0, 0.0, 100.0))
PRIOR = pose_prior()


def estimate(inliers=60, total=100, rms_px=1.0):
    return PoseEstimate(GOOD, WIDE, np.eye(6), np.arange(total) < inliers, np.zeros(total), rms_px)


def spread_px(part, total=100):
    """Points whose convex hull is ``part`` of the image's area, a square in its middle."""
    side = np.sqrt(part * WIDE.width * WIDE.height)
    corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * side
    return np.tile(corners, (total // 4, 1)) + np.array([50.0, 20.0])


def covariance(position_m=1.0, angle_deg=0.1):
    return np.diag(np.square([position_m] * 3 + [np.radians(angle_deg)] * 3))


def case(**changes):
    """Arguments of a pose that passes, with changes."""
    arguments = {
        "estimate": estimate(),
        "query_px": spread_px(0.5),
        "map_from_camera": GOOD,
        "covariance": covariance(),
        "height_above_ground_m": 100.0,
        "prior": PRIOR,
        "max_error_px": 5.0,
        "options": OPTIONS,
    }
    return arguments | changes


def turned(about, degrees, at=(0.0, 0.0, 100.0)):
    return Rigid3(rotation.exp(np.radians(degrees) * np.eye(3)[about]) @ GOOD.rotation, at)


TILT_SIGMA = np.hypot(1.0, 0.1)
HEADING_SIGMA = np.hypot(3.0, 0.1)
PLACE_SIGMA = np.hypot(2.0, 1.0)

TABLE = [
    ("few inliers", {"estimate": estimate(19)}, Reason.FEW_INLIERS, 19, 20),
    ("low ratio", {"estimate": estimate(20, 200), "query_px": spread_px(0.5, 200)}, Reason.LOW_INLIER_RATIO, 0.1, 0.2),
    ("poor spread", {"query_px": spread_px(0.09)}, Reason.POOR_SPREAD, 0.09, 0.1),
    ("on one line", {"query_px": np.column_stack([np.arange(100.0)] * 2)}, Reason.POOR_SPREAD, 0.0, 0.1),
    ("large residual", {"estimate": estimate(rms_px=3.1)}, Reason.HIGH_REPROJECTION, 3.1, 3.0),
    ("below ground", {"height_above_ground_m": -3.0}, Reason.DEGENERATE_GEOMETRY, -3.0, 0.0),
    ("on the ground", {"height_above_ground_m": 0.0}, Reason.DEGENERATE_GEOMETRY, 0.0, 0.0),
    ("height unknown", {"height_above_ground_m": np.nan}, Reason.DEGENERATE_GEOMETRY, np.nan, 0.0),
    ("uncertain", {"covariance": covariance(10.5)}, Reason.UNCERTAIN, 10.5, 10.0),
    ("tilted", {"map_from_camera": turned(0, 6.0)}, Reason.GRAVITY_DISAGREES, 6.0 / TILT_SIGMA, 5.0),
    ("tilted the other way", {"map_from_camera": turned(1, -6.0)}, Reason.GRAVITY_DISAGREES, 6.0 / TILT_SIGMA, 5.0),
    ("heading", {"map_from_camera": turned(2, 20.0)}, Reason.PRIOR_DISAGREES, 20 / HEADING_SIGMA, 5.0),
    (
        "position",
        {"map_from_camera": Rigid3(GOOD.rotation, (12.0, 0.0, 100.0))},
        Reason.PRIOR_DISAGREES,
        12 / PLACE_SIGMA,
        5.0,
    ),
    (
        "height",
        {"map_from_camera": Rigid3(GOOD.rotation, (0.0, 0.0, 88.0))},
        Reason.PRIOR_DISAGREES,
        12 / PLACE_SIGMA,
        5.0,
    ),
]


@pytest.mark.parametrize(
    ("changes", "reason", "measured", "limit"), [row[1:] for row in TABLE], ids=[r[0] for r in TABLE]
)
def test_reasons(changes, reason, measured, limit):
    refusal = gate.check(**case(**changes))
    assert refusal is not None
    assert refusal.reason is reason
    assert refusal.measured == pytest.approx(measured, rel=1e-4, abs=1e-6, nan_ok=True)
    assert refusal.limit == pytest.approx(limit)
    assert refusal.detail


PASSING = [
    {},
    {"prior": None},
    {"prior": None, "map_from_camera": turned(0, 90.0, (900.0, 0.0, 100.0))},
    {"estimate": estimate(20)},
    {"query_px": spread_px(0.101)},
    {"estimate": estimate(rms_px=3.0)},
    {"covariance": covariance(9.9)},
    {"map_from_camera": turned(0, 4.9)},
    {"map_from_camera": turned(2, 14.0)},
    {"map_from_camera": Rigid3(GOOD.rotation, (11.0, 0.0, 100.0))},
]


@pytest.mark.parametrize("changes", PASSING)
def test_what_passes(changes):
    assert gate.check(**case(**changes)) is None


def test_the_first_test_in_order_speaks():
    """Everything is wrong; mend one after the other, from the front."""
    wrong = {
        "estimate": estimate(5, 100, 9.0),
        "query_px": spread_px(0.01),
        "height_above_ground_m": -1.0,
        "covariance": covariance(500.0),
        "map_from_camera": turned(0, 60.0),
    }
    tight = pose_prior(sigma_m=(0.1,) * 3)
    mends = [
        (Reason.FEW_INLIERS, {"estimate": estimate(21, 120, 9.0), "query_px": spread_px(0.01, 120)}),
        (Reason.LOW_INLIER_RATIO, {"estimate": estimate(60, 100, 9.0), "query_px": spread_px(0.01)}),
        (Reason.POOR_SPREAD, {"query_px": spread_px(0.5)}),
        (Reason.HIGH_REPROJECTION, {"estimate": estimate()}),
        (Reason.DEGENERATE_GEOMETRY, {"height_above_ground_m": 100.0}),
        (Reason.UNCERTAIN, {"covariance": covariance(0.1)}),
        (Reason.GRAVITY_DISAGREES, {"map_from_camera": turned(2, 60.0, (50.0, 0.0, 100.0))}),
        (Reason.PRIOR_DISAGREES, {"map_from_camera": GOOD}),
    ]
    for reason, mend in mends:
        refusal = gate.check(**(case(prior=tight) | wrong))
        assert refusal is not None
        assert refusal.reason is reason
        if reason is Reason.LOW_INLIER_RATIO:
            assert refusal.measured == pytest.approx(21 / 120)
        wrong |= mend
    assert gate.check(**(case(prior=tight) | wrong)) is None


@given(finite(-179, 179), finite(0, 25), finite(-180, 180))
def test_tilt_is_told_apart_from_any_turn_of_the_heading(heading_deg, tilt_deg, direction_deg):
    """With no idea of the heading, gravity must still be judged by the tilt alone."""
    blind = pose_prior(sigma_deg=(1.0, 1.0, 180.0))
    about = rotation.exp([0, 0, np.radians(direction_deg)])[:, 0]
    pose = Rigid3(
        rotation.exp([0, 0, np.radians(heading_deg)]) @ rotation.exp(np.radians(tilt_deg) * about) @ GOOD.rotation,
        GOOD.translation,
    )
    refusal = gate.agrees_with(blind, pose, covariance(), OPTIONS)
    if tilt_deg > 5 * TILT_SIGMA * 1.001:
        assert refusal.reason is Reason.GRAVITY_DISAGREES
        assert refusal.measured == pytest.approx(tilt_deg / TILT_SIGMA, rel=1e-6)
        assert f"{tilt_deg:.1f} deg" in refusal.detail
    elif tilt_deg < 5 * TILT_SIGMA * 0.999:
        assert refusal is None


def test_an_uncertain_estimate_is_given_the_benefit_of_its_own_covariance():
    pose = Rigid3(GOOD.rotation, (12.0, 0.0, 100.0))
    assert gate.agrees_with(PRIOR, pose, covariance(1.0), OPTIONS).reason is Reason.PRIOR_DISAGREES
    assert gate.agrees_with(PRIOR, pose, covariance(3.0), OPTIONS) is None


def test_an_infinite_covariance_is_uncertain():
    refusal = gate.certain(np.diag([np.inf, np.inf, 0.01, 1e-4, 1e-4, 1e-4]), 100.0, OPTIONS)
    assert refusal.reason is Reason.UNCERTAIN


def test_refusals_are_plain_numbers():
    for _, changes, *_ in TABLE:
        refusal = gate.check(**case(**changes))
        assert type(refusal.measured) in (int, float)
        assert type(refusal.limit) in (int, float)


def test_only_inliers_count_for_the_spread():
    px = spread_px(0.05)
    px[60:] = np.random.default_rng(0).uniform((0, 0), (399, 299), (40, 2))
    assert gate.check(**case(query_px=px)).reason is Reason.POOR_SPREAD
    everyone = replace(estimate(), inliers=np.ones(100, bool))
    assert gate.check(**case(query_px=px, estimate=everyone)) is None


def test_contrast_and_support_stand_for_counts():
    options = gate.GateOptions()
    for support, least in ((0.14, options.min_contrast), (0.15, options.min_sure_contrast)):
        assert gate.with_contrast(least, support, options) is None
        refused = gate.with_contrast(least - 0.1, support, options)
        assert refused is not None
        assert refused.reason is Reason.LOW_CONTRAST
        assert refused.limit == least
        assert gate.with_contrast(float("nan"), support, options) is not None
    assert gate.with_support(options.min_support, options) is None
    refused = gate.with_support(options.min_support - 0.001, options)
    assert refused is not None
    assert refused.reason is Reason.LOW_INLIER_RATIO
    for test in (gate.with_support, gate.without_rival):
        assert test(float("nan"), options) is not None
    sure, unsure = (gate.for_structure(support, options) for support in (0.15, 0.149))
    assert sure.min_inlier_ratio == unsure.min_inlier_ratio == 0.0
    assert sure.min_spread == 0.5 * options.min_spread
    assert (sure.max_innovation_sigmas, unsure.max_innovation_sigmas) == (5.0, 3.0)
