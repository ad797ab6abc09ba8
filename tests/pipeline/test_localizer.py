"""One frame to a fix or a rejection, on rendered frames of the demo world: the camera never saw the map's picture."""

from __future__ import annotations

import dataclasses
import shutil
from collections.abc import Callable, Iterator

import numpy as np
import pytest
from replay import rendered

from ortholoc_edge.geometry import homography
from ortholoc_edge.geometry.camera import Camera
from ortholoc_edge.geometry.rigid import Rigid3
from ortholoc_edge.matching.types import Matcher
from ortholoc_edge.matching.xfeat import XFeatMatcher
from ortholoc_edge.pipeline import localizer as module
from ortholoc_edge.pipeline.frame import Frame
from ortholoc_edge.pipeline.gate import GateOptions
from ortholoc_edge.pipeline.localizer import Localizer, LocalizerOptions
from ortholoc_edge.pipeline.outcome import Fix, Outcome, Reason, Rejected
from ortholoc_edge.pipeline.prior import PosePrior, RegionPrior
from ortholoc_edge.pipeline.rounds import Round
from ortholoc_edge.tiles.pack import Pack
from ortholoc_edge.tiles.store import MapStore

NADIR = rendered.pose()
TURNED = rendered.pose(220.0, 180.0, roll_deg=-5.0, pitch_deg=8.0, yaw_deg=200.0)
OBLIQUE = rendered.pose(pitch_deg=35.0, yaw_deg=100.0)
DISTORTED = Camera(480, 360, 405.0, 405.0, 239.5, 179.5, (-0.18, 0.04, 0.001, -0.0008, 0.0))


def localize(
    frame: Frame,
    prior: PosePrior | RegionPrior,
    matcher: Matcher | None = None,
    *,
    camera: Camera = rendered.CAMERA,
    store: MapStore | None = None,
    **options: object,
) -> Outcome:
    localizer = Localizer(camera, store or rendered.store(), matcher or rendered.sift(), LocalizerOptions(**options))
    try:
        return localizer.localize(frame, prior)
    finally:
        localizer.close()


def assert_near(outcome: Outcome, truth: Rigid3, metres: float = 2.0, degrees: float = 1.5) -> Fix:
    assert isinstance(outcome, Fix), outcome
    off_m, off_deg = rendered.errors(outcome.map_from_camera, truth)
    assert off_m < metres
    assert off_deg < degrees
    return outcome


def assert_rejected(outcome: Outcome, reason: Reason) -> Rejected:
    assert isinstance(outcome, Rejected), "a fix"
    assert outcome.reason is reason, outcome
    assert outcome.timings_ms["total"] >= 0
    return outcome


@pytest.fixture(scope="module", params=["sift", "xfeat"])
def matcher(request: pytest.FixtureRequest) -> Matcher:
    if request.param == "sift":
        return rendered.sift()
    model = request.getfixturevalue("xfeat_model")
    return XFeatMatcher(model.graph, model.sha256)


# -- fixes -------------------------------------------------------------------


@pytest.mark.parametrize("truth", [NADIR, TURNED, OBLIQUE], ids=["nadir", "turned", "oblique"])
def test_noisy_prior_becomes_a_fix(matcher: Matcher, truth: Rigid3) -> None:
    frame = rendered.frame(truth)
    prior = rendered.prior(truth)
    fix = assert_near(localize(frame, prior, matcher), truth)
    before_m, before_deg = rendered.errors(prior.map_from_camera, truth)
    after_m, after_deg = rendered.errors(fix.map_from_camera, truth)
    assert after_m < before_m / 2
    assert after_deg < before_deg / 2
    assert fix.stamp_ns == frame.stamp_ns
    assert 30 <= fix.inliers <= fix.matches
    assert len(fix.query_px) == len(fix.points_map) == fix.inliers
    assert rendered.CAMERA.contains(fix.query_px).all()
    assert 0 < fix.quality <= 1
    assert fix.focal_sigma_px is None
    assert np.linalg.eigvalsh(fix.covariance)[0] > 0
    assert {"query_features", "map_window", "view", "map_features", "match", "pose", "adhop", "gate", "total"} == set(
        fix.timings_ms
    )
    # Inliers are what they say: their points project to their pixels. In map units, which the grid's scale bends
    # by 0.02 % only.
    again = fix.camera.project(fix.map_from_camera.inverse().apply(fix.points_map))
    assert np.sqrt(np.mean(np.sum((again - fix.query_px) ** 2, axis=1))) == pytest.approx(fix.rms_px, abs=0.1)


@pytest.mark.parametrize("truth", [OBLIQUE], ids=["oblique"])
def test_adhop_is_taken_only_where_the_mean_error_falls(
    matcher: Matcher, truth: Rigid3, monkeypatch: pytest.MonkeyPatch
) -> None:
    rounds: list[Round] = []
    solved: Callable[..., Round] = Localizer._solved

    def spy(self: Localizer, *args: object) -> Round:
        rounds.append(solved(self, *args))
        return rounds[-1]

    monkeypatch.setattr(Localizer, "_solved", spy)
    frame, prior = rendered.frame(truth), rendered.prior(truth)
    with_adhop = assert_near(localize(frame, prior, matcher), truth)
    assert len(rounds) == 2
    first, second = rounds
    assert with_adhop.adhop_accepted is (second.mean_error_px < first.mean_error_px)
    chosen = second if with_adhop.adhop_accepted else first
    assert chosen.mean_error_px <= first.mean_error_px
    assert with_adhop.inliers == chosen.inliers
    assert with_adhop.matches == len(chosen.matches)

    rounds.clear()
    without = assert_near(localize(frame, prior, matcher, adhop=False), truth)
    assert len(rounds) == 1
    assert without.adhop_accepted is None
    assert without.inliers == first.inliers
    assert "adhop" not in without.timings_ms


def test_adhop_that_does_not_help_is_said_so(monkeypatch: pytest.MonkeyPatch) -> None:
    frame, prior = rendered.frame(NADIR), rendered.prior(NADIR)
    without = assert_near(localize(frame, prior, adhop=False), NADIR)
    # A warp to somewhere else: the second round finds nothing.
    monkeypatch.setattr(module, "fit_homography", lambda *_: (homography_elsewhere(), None))
    refused = assert_near(localize(frame, prior), NADIR)
    assert refused.adhop_accepted is False
    assert np.array_equal(refused.map_from_camera.translation, without.map_from_camera.translation)
    monkeypatch.setattr(module, "fit_homography", lambda *_: None)
    assert assert_near(localize(frame, prior), NADIR).adhop_accepted is False


def homography_elsewhere() -> np.ndarray:
    matrix = np.array([[1.0, 0.0, 5e4], [0.0, 1.0, 5e4], [0.0, 0.0, 1.0]])
    assert np.isfinite(homography.warp_points(matrix, np.zeros((1, 2)))).all()
    return matrix


def test_same_call_same_bits(matcher: Matcher) -> None:
    frame, prior = rendered.frame(OBLIQUE), rendered.prior(OBLIQUE)
    localizer = Localizer(rendered.CAMERA, rendered.store(), matcher, LocalizerOptions())
    try:
        one, two = (localizer.localize(frame, prior) for _ in range(2))
    finally:
        localizer.close()
    three = localize(frame, prior, matcher)
    for other in (two, three):
        assert isinstance(one, Fix)
        assert isinstance(other, Fix)
        for field in dataclasses.fields(Fix):
            a, b = getattr(one, field.name), getattr(other, field.name)
            if field.name == "map_from_camera":
                assert np.array_equal(a.rotation, b.rotation)
                assert np.array_equal(a.translation, b.translation)
            elif isinstance(a, np.ndarray):
                assert np.array_equal(a, b), field.name
            elif field.name != "timings_ms":
                assert a == b, field.name


def test_grey_and_rgb_are_one() -> None:
    """A camera without colour must lose nothing: grey is made as OpenCV makes it from RGB."""
    rgb = rendered.frame(NADIR)
    weights = np.array([0.299, 0.587, 0.114])
    grey = np.rint(rgb.image @ weights).astype(np.uint8)
    same = np.repeat(grey[..., None], 3, axis=2)
    prior = rendered.prior(NADIR)
    one = assert_near(localize(Frame(0, grey, "grey"), prior, adhop=False), NADIR)
    two = assert_near(localize(Frame(0, same, "rgb of grey"), prior, adhop=False), NADIR)
    assert np.array_equal(one.map_from_camera.translation, two.map_from_camera.translation)
    three = assert_near(localize(rgb, prior, adhop=False), NADIR)
    assert np.allclose(one.map_from_camera.translation, three.map_from_camera.translation, atol=0.5)


def test_red_is_the_first_channel() -> None:
    """A picture whose grey is the scene's as RGB and flat as BGR."""
    red = rendered.picture(NADIR) @ np.array([0.299, 0.587, 0.114])
    blue = (30.0 - 0.114 * red) / 0.299
    image = np.rint(np.stack([red, np.zeros_like(red), blue], axis=-1)).astype(np.uint8)
    assert_near(localize(Frame(0, image, "rgb"), rendered.prior(NADIR)), NADIR)
    swapped = np.ascontiguousarray(image[..., ::-1])
    assert isinstance(localize(Frame(0, swapped, "bgr"), rendered.prior(NADIR)), Rejected)


def test_lens_distortion_is_taken_out(matcher: Matcher) -> None:
    frame, prior = rendered.frame(TURNED, DISTORTED), rendered.prior(TURNED)
    fix = assert_near(localize(frame, prior, matcher, camera=DISTORTED), TURNED)
    assert fix.camera == DISTORTED
    # Taken for a pinhole, it is much farther off, if it comes through at all.
    blind = localize(frame, prior, matcher, camera=rendered.CAMERA)
    if isinstance(blind, Fix):
        assert rendered.errors(blind.map_from_camera, TURNED)[0] > rendered.errors(fix.map_from_camera, TURNED)[0]


# -- priors ------------------------------------------------------------------


def test_wide_position_prior_is_searched() -> None:
    """Farther off than the picture is wide: only another hypothesis than the first sees the place."""
    prior = rendered.prior(NADIR, (70.0, -50.0, 3.0), sigma_m=(50.0, 4.0))
    fix = assert_near(localize(rendered.frame(NADIR), prior), NADIR)
    assert np.linalg.norm(prior.map_from_camera.translation - fix.map_from_camera.translation) > 80


def test_unknown_heading_is_searched() -> None:
    prior = rendered.prior(NADIR, error_deg=(0.5, -0.5, 152.0), sigma_deg=(1.0, 1.0, 180.0))
    assert_near(localize(rendered.frame(NADIR), prior), NADIR)


@pytest.mark.parametrize("yaw_deg", [86.0, -175.0])
def test_region_is_searched_in_four_rotations(matcher: Matcher, yaw_deg: float) -> None:
    truth = rendered.pose(yaw_deg=yaw_deg)
    east, north = truth.translation[:2]
    region = RegionPrior((east - 55, north - 55, east + 55, north + 55))
    # From the nadir picture alone, without a prior to gate with.
    assert_near(localize(rendered.frame(truth), region, matcher), truth, 3.0, 2.0)


# -- calibration -------------------------------------------------------------


def test_calibration_finds_the_focal_length_of_an_oblique_view() -> None:
    """Given a focal length a sixth too long, as a newcomer's guess of max(W, H) is."""
    guess = Camera.from_focal(480, 360, 480.0)
    outcome = localize(
        rendered.frame(OBLIQUE), rendered.prior(OBLIQUE), camera=guess, calibrate=True, search_sigmas=4.0
    )
    fix = assert_near(outcome, OBLIQUE, 4.0, 2.0)
    assert fix.focal_sigma_px is not None
    assert fix.camera.focal_px == pytest.approx(rendered.CAMERA.focal_px, rel=0.04)
    assert abs(fix.camera.focal_px - rendered.CAMERA.focal_px) < 5 * fix.focal_sigma_px


def test_calibration_straight_down_is_refused_or_right() -> None:
    """Seen straight down, a longer lens from higher up makes the same picture but for the relief."""
    outcome = localize(rendered.frame(NADIR), rendered.prior(NADIR), calibrate=True)
    if isinstance(outcome, Rejected):
        assert outcome.reason in (Reason.DEGENERATE_GEOMETRY, Reason.UNCERTAIN)
    else:
        assert outcome.focal_sigma_px is not None
        assert abs(outcome.camera.focal_px - rendered.CAMERA.focal_px) < 4 * outcome.focal_sigma_px


# -- rejections --------------------------------------------------------------

FAR = Rigid3(NADIR.rotation, NADIR.translation + np.array([5000.0, 0.0, 0.0]))


@pytest.mark.parametrize(
    "image",
    [
        np.zeros((360, 481, 3), np.uint8),
        np.zeros((480, 360), np.uint8),
        np.zeros((0, 0, 3), np.uint8),
        np.zeros((360, 480, 3), np.uint16),
        np.zeros((360, 480), np.float32),
    ],
    ids=["wide", "turned", "empty", "16 bit", "float"],
)
def test_frames_of_another_kind_are_refused(image: np.ndarray) -> None:
    refused = assert_rejected(localize(Frame(5, image, "one.jpg"), rendered.prior(NADIR)), Reason.BAD_FRAME)
    assert refused.stamp_ns == 5
    assert "one.jpg" in refused.detail
    assert "480 x 360" in refused.detail


@pytest.mark.parametrize("channels", [1, 2, 4])
def test_channels_that_are_not_rgb_are_refused(channels: int) -> None:
    image = np.zeros((360, 480, channels), np.uint8)
    assert_rejected(localize(Frame(5, image, "one.jpg"), rendered.prior(NADIR)), Reason.BAD_FRAME)


TABLE = {
    # name: (frame's pose, prior, options, reason)
    "position unknown": (NADIR, rendered.prior(NADIR, sigma_m=(400.0, 5.0)), {}, Reason.PRIOR_TOO_WIDE),
    "window too large": (
        NADIR, rendered.prior(NADIR, sigma_m=(16.0, 60.0)), {"max_window_mpx": 0.001}, Reason.PRIOR_TOO_WIDE,
    ),
    "pose outside": (NADIR, rendered.prior(FAR), {}, Reason.OUTSIDE_MAP),
    "region outside": (NADIR, RegionPrior((1000.0, 1000.0, 1100.0, 1100.0)), {}, Reason.OUTSIDE_MAP),
    "below the ground": (NADIR, rendered.prior(NADIR, (0, 0, -150.0)), {}, Reason.PRIOR_DISAGREES),
    "tilt": (
        NADIR, rendered.prior(NADIR, error_deg=(6.0, -5.0, 0.0), sigma_deg=(0.5, 0.5, 3.0)),
        {"search_sigmas": 10.0}, Reason.GRAVITY_DISAGREES,
    ),
    "heading": (
        NADIR, rendered.prior(NADIR, error_deg=(0.0, 0.0, 12.0), sigma_deg=(1.0, 1.0, 1.0)),
        {"search_sigmas": 8.0}, Reason.PRIOR_DISAGREES,
    ),
    "position": (
        NADIR, rendered.prior(NADIR, (7.0, -6.0, 0.0), sigma_m=(0.5, 1.0)), {"search_sigmas": 9.0},
        Reason.PRIOR_DISAGREES,
    ),
    "few inliers": (NADIR, rendered.prior(NADIR), {"gate": GateOptions(min_inliers=5000)}, Reason.FEW_INLIERS),
    "inlier ratio": (
        NADIR, rendered.prior(NADIR), {"gate": GateOptions(min_inlier_ratio=1.0)}, Reason.LOW_INLIER_RATIO,
    ),
    "spread": (NADIR, rendered.prior(NADIR), {"gate": GateOptions(min_spread=1.0)}, Reason.POOR_SPREAD),
    "residual": (
        NADIR, rendered.prior(NADIR), {"gate": GateOptions(max_rms_ratio=0.01)}, Reason.HIGH_REPROJECTION,
    ),
    "uncertain": (
        NADIR, rendered.prior(NADIR), {"gate": GateOptions(max_relative_sigma=1e-5)}, Reason.UNCERTAIN,
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", TABLE)
def test_reasons(case: str) -> None:
    truth, prior, options, reason = TABLE[case]
    refused = assert_rejected(localize(rendered.frame(truth), prior, adhop=False, **options), reason)
    assert refused.detail
    if reason not in (Reason.OUTSIDE_MAP, Reason.BAD_FRAME):
        assert refused.measured is not None
        assert (refused.limit is None) == (case == "position unknown"), "that limit is a count, in the detail"


def test_a_picture_of_nothing_has_few_matches(matcher: Matcher) -> None:
    flat = np.full((360, 480, 3), 120, np.uint8)
    refused = localize(Frame(0, flat, "fog"), rendered.prior(NADIR), matcher)
    assert isinstance(refused, Rejected)
    assert refused.reason in (Reason.FEW_MATCHES, Reason.FEW_INLIERS, Reason.DEGENERATE_GEOMETRY)


def test_texture_in_one_corner_is_refused() -> None:
    image = np.full_like(rendered.picture(TURNED), 120)
    image[:120, :140] = rendered.picture(TURNED)[:120, :140]
    outcome = localize(
        Frame(0, image, "corner"), rendered.prior(TURNED), gate=GateOptions(min_inliers=6, min_inlier_ratio=0.05)
    )
    assert isinstance(outcome, Rejected)
    assert outcome.reason in (Reason.POOR_SPREAD, Reason.FEW_MATCHES, Reason.DEGENERATE_GEOMETRY)


@pytest.fixture
def damaged_store(tmp_path: object) -> Iterator[MapStore]:
    path = shutil.copytree(rendered.store().pack.path, tmp_path / "pack")
    for tile in sorted((path / "dop").iterdir()):
        data = bytearray(tile.read_bytes())
        # Every block, but not the head, without which the tile is not even opened.
        for at in range(len(data) // 20, len(data), len(data) // 1000):
            data[at] ^= 0xFF
        tile.write_bytes(data)
    with MapStore(Pack.open(path)) as store:
        yield store


def test_damaged_tile_under_the_view(damaged_store: MapStore) -> None:
    assert len(damaged_store.damaged) == len(damaged_store.pack.manifest.dop.tiles)
    assert_rejected(localize(rendered.frame(NADIR), rendered.prior(NADIR), store=damaged_store), Reason.MAP_NODATA)
