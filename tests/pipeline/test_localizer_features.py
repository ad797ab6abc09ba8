"""Rendered frames localized with the demo pack's precomputed features: the network never looks at the map."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest
from ortholoc_sim.make_demo_pack import DEMO_SOUTH_M, DEMO_WEST_M
from replay import rendered

from ortholoc_edge.errors import MapError
from ortholoc_edge.geometry import homography
from ortholoc_edge.geometry.camera import Camera
from ortholoc_edge.geometry.rigid import Rigid3
from ortholoc_edge.matching.types import Features
from ortholoc_edge.matching.xfeat import XFeatMatcher
from ortholoc_edge.pipeline.frame import Frame
from ortholoc_edge.pipeline.gate import GateOptions
from ortholoc_edge.pipeline.localizer import Localizer, LocalizerOptions
from ortholoc_edge.pipeline.outcome import Fix, Outcome, Reason, Rejected
from ortholoc_edge.pipeline.prior import PosePrior, RegionPrior
from ortholoc_edge.pipeline.rectify import rectified
from ortholoc_edge.pipeline.rounds import Round
from ortholoc_edge.pipeline.stored import Attempt, StoredMatching
from ortholoc_edge.pipeline.trace import Trace
from ortholoc_edge.tiles import features
from ortholoc_edge.tiles.manifest import MANIFEST_NAME, FeatureLayer, FeatureTile, write_manifest
from ortholoc_edge.tiles.pack import Pack
from ortholoc_edge.tiles.store import MapStore, WindowTooLargeError

REACH_M = 105.0
# Twice the default: map and frames are of two epochs, and a village offers less than most real ground.
PER_MPX = 2.0 * features.PER_MPX
NADIR = rendered.pose()
CAMERA = Camera.from_focal(640, 480, 540.0)
DISTORTED = Camera(640, 480, 540.0, 540.0, 319.5, 239.5, (-0.18, 0.04, 0.001, -0.0008, 0.0))


class CountingMatcher(XFeatMatcher):
    """Counts pictures: ``extract`` is for frames and views of the map, ``extract_unscaled`` for rectified frames."""

    scaled = unscaled = 0

    def extract(self, image: np.ndarray, valid: np.ndarray | None = None) -> Features:
        self.scaled += 1
        return super().extract(image, valid)

    def extract_unscaled(self, image: np.ndarray, valid: np.ndarray | None = None) -> Features:
        self.unscaled += 1
        return super().extract_unscaled(image, valid)


@dataclass
class Setting:
    store: MapStore
    matcher: CountingMatcher

    def localize(
        self, frame: Frame, prior: PosePrior | RegionPrior, camera: Camera = CAMERA, **options: object
    ) -> Outcome:
        self.matcher.scaled = self.matcher.unscaled = 0
        localizer = Localizer(camera, self.store, self.matcher, LocalizerOptions(**options))
        try:
            return localizer.localize(frame, prior)
        finally:
            localizer.close()


@pytest.fixture(scope="module")
def setting(xfeat_model, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Setting]:
    matcher = CountingMatcher(xfeat_model.graph, xfeat_model.sha256, max_keypoints=features.MAX_KEYPOINTS)
    path = tmp_path_factory.mktemp("features") / "pack"
    shutil.copytree(rendered.store().pack.path, path)
    _add_features(path, matcher)
    with MapStore(Pack.open(path), features=True) as store:
        yield Setting(store, matcher)


def _add_features(path: Path, matcher: XFeatMatcher) -> None:
    """Of the ground around the middle only, for the time it takes."""
    manifest = Pack.open(path).manifest
    middle = np.array([DEMO_WEST_M, DEMO_SOUTH_M]) + rendered.MIDDLE
    entries = []
    for index, tile in enumerate(manifest.dop.tiles):
        levels = []
        for level in range(manifest.dop.lattice.levels):
            grid = manifest.dop.lattice.grid(tile.box, level)
            window = rendered.store().read(grid.bounds, grid.gsd_m * 0.9)
            assert window is not None
            assert window.dop_grid == grid
            valid = window.dop_valid.copy()
            (left, right), (upper, lower) = np.rint(
                grid.px_from_map([middle + np.array([-REACH_M, REACH_M]), middle + np.array([REACH_M, -REACH_M])])
            ).T.astype(int)
            near = np.zeros_like(valid)
            near[max(upper, 0) : max(lower, 0), max(left, 0) : max(right, 0)] = True
            levels.append((window.dop_grey, valid & near))
        data, counts = features.extract_tile(levels, matcher, PER_MPX)
        if not data:
            continue
        name = f"features/{index}.npy"
        (path / "features").mkdir(exist_ok=True)
        (path / name).write_bytes(data)
        sha256 = features.models.sha256_of(data)
        entries.append(
            FeatureTile(
                file=name, bytes=len(data), sha256=sha256, dop=index, dop_sha256=tile.sha256, counts=counts
            )
        )  # fmt: skip
    assert matcher.model_sha256 is not None
    layer = FeatureLayer(
        matcher="xfeat",
        model_sha256=matcher.model_sha256,
        encoding=features.ENCODING,
        per_mpx=PER_MPX,
        tiles=entries,
    )
    write_manifest(msgspec.structs.replace(manifest, features=layer), path / MANIFEST_NAME)


def assert_near(outcome: Outcome, truth: Rigid3, metres: float = 3.0, degrees: float = 2.0) -> Fix:
    assert isinstance(outcome, Fix), outcome
    off_m, off_deg = rendered.errors(outcome.map_from_camera, truth)
    assert off_m < metres
    assert off_deg < degrees
    return outcome


@pytest.mark.parametrize("yaw_deg", [0.0, 45.0, 133.0, 270.0])
def test_frame_of_any_heading_is_found_without_the_network_on_the_map(setting: Setting, yaw_deg: float) -> None:
    truth = rendered.pose(yaw_deg=yaw_deg)
    fix = assert_near(
        setting.localize(rendered.frame(truth, CAMERA), rendered.prior(truth), precomputed_features="require"), truth
    )
    assert fix.stored_features
    assert setting.matcher.scaled == 0
    assert 1 <= setting.matcher.unscaled <= 2
    assert {"map_window", "view", "rectify", "query_features", "match", "pose", "adhop", "gate", "total"} == set(
        fix.timings_ms
    )


def test_looking_again_doubles_the_inliers(setting: Setting) -> None:
    frame, prior = rendered.frame(NADIR, CAMERA), rendered.prior(NADIR)
    once = assert_near(setting.localize(frame, prior, precomputed_features="require", adhop=False), NADIR)
    twice = assert_near(setting.localize(frame, prior, precomputed_features="require"), NADIR)
    assert once.adhop_accepted is None
    assert twice.adhop_accepted is True
    assert twice.inliers > 1.3 * once.inliers
    # Pairs that a pose picked agree with it: their share says nothing of how good the match was.
    assert twice.inliers / twice.matches > 1.1 * once.quality
    assert twice.quality == once.quality


def test_inliers_that_only_looking_again_finds_must_be_many(setting: Setting, monkeypatch: pytest.MonkeyPatch) -> None:
    """Around a wrong pose it finds some that agree, too."""
    frame, prior = rendered.frame(NADIR, CAMERA), rendered.prior(NADIR)
    once = assert_near(setting.localize(frame, prior, precomputed_features="require", adhop=False), NADIR)
    limits = GateOptions(min_inliers=round(1.2 * once.inliers))
    assert_near(setting.localize(frame, prior, precomputed_features="require", gate=limits), NADIR)
    look_again, kept = StoredMatching.looked_again, round(1.5 * limits.min_inliers)

    def fewer(self: StoredMatching, attempt: Attempt, trace: Trace) -> Round:
        found = look_again(self, attempt, trace)
        assert found is not None
        assert found.estimate is not None
        inliers = np.zeros(len(found.kept), bool)
        agreeing = np.flatnonzero(found.estimate.inliers)
        inliers[agreeing[np.linspace(0, len(agreeing) - 1, kept).astype(int)]] = True
        return replace(found, estimate=replace(found.estimate, inliers=inliers))

    monkeypatch.setattr(StoredMatching, "looked_again", fewer)
    refused = setting.localize(frame, prior, precomputed_features="require", gate=limits)
    assert isinstance(refused, Rejected)
    assert (refused.reason, refused.measured, refused.limit) == (Reason.FEW_INLIERS, kept, 2 * limits.min_inliers)
    passed = setting.localize(frame, prior, precomputed_features="require", gate=GateOptions(min_inliers=20))
    assert assert_near(passed, NADIR).inliers == kept


def test_tilt_and_lens_distortion(setting: Setting) -> None:
    truth = rendered.pose(roll_deg=-6.0, pitch_deg=12.0, yaw_deg=200.0)
    frame = rendered.frame(truth, DISTORTED)
    fix = assert_near(setting.localize(frame, rendered.prior(truth), DISTORTED, precomputed_features="require"), truth)
    assert fix.camera == DISTORTED


def test_wide_prior_is_searched(setting: Setting) -> None:
    prior = rendered.prior(NADIR, (1.0, -1.0, 1.0), (0.5, -0.5, 62.0), sigma_deg=(1.0, 1.0, 40.0))
    assert assert_near(setting.localize(rendered.frame(NADIR, CAMERA), prior, precomputed_features="require"), NADIR)
    assert setting.matcher.scaled == 0
    assert setting.matcher.unscaled > 1


def test_prior_too_wide_for_the_map_is_too_wide_for_its_features(
    setting: Setting, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Over a large pack they would be hundreds of thousands to match, for seconds and hundreds of megabytes."""
    asked: list[object] = []
    monkeypatch.setattr(features.FeatureIndex, "read", lambda *args: asked.append(args))
    refused = setting.localize(
        rendered.frame(NADIR, CAMERA), rendered.prior(NADIR, sigma_m=(150.0, 20.0)), max_window_mpx=0.5
    )
    assert isinstance(refused, Rejected)
    assert refused.reason is Reason.PRIOR_TOO_WIDE
    assert not asked


def test_surface_that_is_too_large_to_read_leaves_the_network(
    setting: Setting, monkeypatch: pytest.MonkeyPatch
) -> None:
    def too_large(*_: object) -> None:
        raise WindowTooLargeError("DSM window of 9000 x 9000 px")

    monkeypatch.setattr(setting.store, "read_surface", too_large)
    frame, prior = rendered.frame(NADIR, CAMERA), rendered.prior(NADIR)
    assert not assert_near(setting.localize(frame, prior), NADIR).stored_features
    refused = setting.localize(frame, prior, precomputed_features="require")
    assert isinstance(refused, Rejected)
    assert refused.reason is Reason.PRIOR_TOO_WIDE


def test_without_features_there_the_network_looks_at_the_map(setting: Setting) -> None:
    """West of the ground that has features."""
    truth = rendered.pose(130.0, 250.0)
    frame, prior = rendered.frame(truth, CAMERA), rendered.prior(truth)
    fix = assert_near(setting.localize(frame, prior), truth)
    assert not fix.stored_features
    assert setting.matcher.scaled > 1
    refused = setting.localize(frame, prior, precomputed_features="require")
    assert isinstance(refused, Rejected)
    assert refused.reason is Reason.FEW_MATCHES
    assert setting.matcher.scaled == 0


def test_never_and_regions_are_the_networks(setting: Setting) -> None:
    frame, prior = rendered.frame(NADIR, CAMERA), rendered.prior(NADIR)
    fix = assert_near(setting.localize(frame, prior, precomputed_features="never"), NADIR)
    assert not fix.stored_features
    assert setting.matcher.unscaled == 0
    east, north = NADIR.translation[:2]
    region = RegionPrior((east - 55, north - 55, east + 55, north + 55))
    refused = setting.localize(frame, region, precomputed_features="require")
    assert isinstance(refused, Rejected)
    assert refused.reason is Reason.NO_PRIOR
    assert setting.localize(frame, region).stamp_ns == frame.stamp_ns
    assert setting.matcher.unscaled == 0
    assert setting.matcher.scaled > 1


def test_features_of_another_matcher_are_refused_or_passed_over(
    setting: Setting, caplog: pytest.LogCaptureFixture
) -> None:
    with pytest.raises(MapError, match="rebuild it with --features sift"):
        Localizer(CAMERA, setting.store, rendered.sift(), LocalizerOptions(precomputed_features="require"))
    localizer = Localizer(CAMERA, setting.store, rendered.sift(), LocalizerOptions())
    try:
        fix = assert_near(localizer.localize(rendered.frame(NADIR, CAMERA), rendered.prior(NADIR)), NADIR)
    finally:
        localizer.close()
    assert not fix.stored_features
    assert "the network looks at the map instead" in caplog.text


def test_pack_without_features_is_only_refused_where_they_are_required(xfeat_model) -> None:
    matcher = XFeatMatcher(xfeat_model.graph, xfeat_model.sha256)
    with pytest.raises(MapError, match="no precomputed features"):
        Localizer(CAMERA, rendered.store(), matcher, LocalizerOptions(precomputed_features="require"))
    Localizer(CAMERA, rendered.store(), matcher, LocalizerOptions()).close()


# -- the frame on the map's grid ----------------------------------------------


@pytest.mark.parametrize("camera", [CAMERA, DISTORTED], ids=["pinhole", "distorted"])
def test_rectified_frame_shows_each_place_where_the_grid_has_it(camera: Camera) -> None:
    turn = np.array([[1.1, 0.9, -300.0], [-0.8, 1.2, 100.0], [2e-4, -1e-4, 1.0]])
    spots = np.stack(np.meshgrid(np.linspace(120, 520, 6), np.linspace(90, 390, 5)), axis=-1).reshape(-1, 2)
    image = np.zeros((camera.height, camera.width), np.uint8)
    for u, v in np.rint(spots).astype(int):
        cv2.circle(image, (int(u), int(v)), 4, 255, -1)
    canvas = rectified(image, camera, turn, 4_000_000)
    assert canvas is not None
    assert canvas.image.shape == canvas.valid.shape
    flat = camera.undistorted_px(np.rint(spots))
    expected = homography.warp_points(np.linalg.inv(canvas.frame_from_canvas), flat)
    _, _, _, centres = cv2.connectedComponentsWithStats((canvas.image > 90).astype(np.uint8))
    away = np.linalg.norm(expected[:, None] - centres[None, 1:], axis=2).min(axis=1)
    assert away.max() < 0.6
    # Canvas pixels are grid pixels, moved by whole ones.
    moved = np.linalg.inv(turn) @ canvas.frame_from_canvas
    moved /= moved[2, 2]
    assert np.allclose(moved[:2, :2], np.eye(2))
    assert np.allclose(moved[:2, 2], np.rint(moved[:2, 2]), atol=1e-6)


def test_rectified_leaves_out_what_is_seen_too_flat_and_what_is_behind() -> None:
    camera = CAMERA
    image = np.full((camera.height, camera.width), 120, np.uint8)
    # The horizon runs through the upper part of the picture.
    to_frame = np.linalg.inv(np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.004, -0.2]]))
    canvas = rectified(image, camera, to_frame, 40_000_000)
    assert canvas is not None
    shown = np.argwhere(canvas.valid)[:, ::-1]
    in_frame = homography.warp_points(canvas.frame_from_canvas, shown)
    assert camera.contains(in_frame).all()
    assert in_frame[:, 1].min() > 50
    assert in_frame[:, 1].max() > camera.height - 20
    assert rectified(image, camera, to_frame, 1000) is None
    assert rectified(image, camera, -to_frame, 40_000_000) is None
