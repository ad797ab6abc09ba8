"""Structural localization on rendered frames of the demo world, which the map's orthophoto was not made of: fixes,
refusals, faults."""

from __future__ import annotations

import dataclasses
import shutil
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np
import pytest
from replay import rendered
from scenes_pipeline import turned_down

from ortholoc_edge.errors import ConfigError, MapError
from ortholoc_edge.geometry.arrays import FloatArray, ImageArray
from ortholoc_edge.geometry.camera import Camera
from ortholoc_edge.geometry.grid import RasterGrid
from ortholoc_edge.geometry.rigid import Rigid3
from ortholoc_edge.matching.types import AnyMatcher, Structural
from ortholoc_edge.pipeline import gate, surface
from ortholoc_edge.pipeline.frame import Frame
from ortholoc_edge.pipeline.gate import GateOptions
from ortholoc_edge.pipeline.localizer import Localizer, LocalizerOptions
from ortholoc_edge.pipeline.outcome import Fix, Outcome, Reason, Rejected
from ortholoc_edge.pipeline.prior import PosePrior, RegionPrior
from ortholoc_edge.pipeline.render import Terrain, render
from ortholoc_edge.pipeline.structural import LADDER, TUNING, QueryMaker, Track, Tracking, Tuning
from ortholoc_edge.pipeline.trace import Trace
from ortholoc_edge.tiles.georeference import LocalFrame
from ortholoc_edge.tiles.pack import Pack
from ortholoc_edge.tiles.store import MapStore, WindowTooLargeError
from ortholoc_edge.tiles.window import MapWindow

NADIR = rendered.pose()
TURNED = rendered.pose(220.0, 180.0, roll_deg=-5.0, pitch_deg=8.0, yaw_deg=200.0)
OBLIQUE = rendered.pose(pitch_deg=35.0, yaw_deg=100.0)
FLAT = rendered.pose(pitch_deg=50.0, yaw_deg=10.0)
PLACES = {"nadir": NADIR, "turned": TURNED, "oblique": OBLIQUE, "flat": FLAT}
DISTORTED = Camera(480, 360, 405.0, 405.0, 239.5, 179.5, (-0.18, 0.04, 0.001, -0.0008, 0.0))
# A right fix is within the first, whose half is the surface's own error at this place (SIFT's poses share it); a wrong
# one beyond the second.
NEAR_M, NEAR_DEG = 1.0, 0.7
FALSE_M, FALSE_DEG = 10.0, 5.0


def localize(
    frame: Frame,
    prior: PosePrior | RegionPrior,
    matcher: AnyMatcher | None = None,
    *,
    camera: Camera = rendered.CAMERA,
    store: MapStore | None = None,
    proceed: Callable[[], bool] = lambda: True,
    **options: object,
) -> Outcome:
    localizer = Localizer(camera, store or rendered.store(), matcher or Structural(), LocalizerOptions(**options))
    try:
        return localizer.localize(frame, prior, proceed)
    finally:
        localizer.close()


def assert_near(outcome: Outcome, truth: Rigid3) -> Fix:
    assert isinstance(outcome, Fix), outcome
    off_m, off_deg = rendered.errors(outcome.map_from_camera, truth)
    assert off_m < NEAR_M
    assert off_deg < NEAR_DEG
    return outcome


def assert_rejected(outcome: Outcome, *reasons: Reason) -> Rejected:
    assert isinstance(outcome, Rejected), "a fix"
    assert outcome.reason in reasons, outcome
    assert outcome.timings_ms["total"] >= 0
    return outcome


def is_wrong(outcome: Outcome, truth: Rigid3) -> bool:
    if not isinstance(outcome, Fix):
        return False
    off_m, off_deg = rendered.errors(outcome.map_from_camera, truth)
    return off_m > FALSE_M or off_deg > FALSE_DEG


def on_ground(pose: Rigid3, ground_m: float) -> FloatArray:
    """Where the optical axis meets the level (2,)."""
    axis = pose.rotation[:, 2]
    return np.asarray((pose.translation + axis * (ground_m - pose.translation[2]) / axis[2])[:2])


# -- fixes -------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("truth", PLACES.values(), ids=PLACES)
def test_noisy_prior_becomes_a_fix(truth: Rigid3, seed: int) -> None:
    random = np.random.default_rng(seed)
    prior = rendered.prior(truth, tuple(3.0 * random.normal(size=3)), tuple(random.normal(size=3) * (1.0, 1.0, 3.0)))
    frame = rendered.frame(truth)
    fix = assert_near(localize(frame, prior), truth)
    # The pose is unsure across its own tilt; what it says of the ground in the picture's middle is not.
    ground_m = float(np.median(fix.points_map[:, 2]))
    height_m = truth.translation[2] - ground_m
    slant = 1.0 / abs(truth.rotation[2, 2])
    off = np.linalg.norm(on_ground(fix.map_from_camera, ground_m) - on_ground(truth, ground_m))
    assert off < 0.004 * height_m * slant**2
    assert fix.stamp_ns == frame.stamp_ns
    assert 60 <= fix.inliers <= fix.matches
    assert len(fix.query_px) == len(fix.points_map) == fix.inliers
    assert rendered.CAMERA.contains(fix.query_px).all()
    assert 0 < fix.quality <= 1
    assert fix.adhop_accepted is None
    assert fix.focal_sigma_px is None
    assert not fix.stored_features
    assert fix.covariance == pytest.approx(fix.covariance.T, abs=1e-9)
    assert np.linalg.eigvalsh(fix.covariance)[0] > 0
    assert {"query_features", "map_window", "view", "map_features", "match", "pose", "gate", "total"} <= set(
        fix.timings_ms
    )
    again = fix.camera.project(fix.map_from_camera.inverse().apply(fix.points_map))
    assert np.sqrt(np.mean(np.sum((again - fix.query_px) ** 2, axis=1))) == pytest.approx(fix.rms_px, abs=0.1)


def test_points_of_a_fix_lie_on_the_surface() -> None:
    fix = assert_near(localize(rendered.frame(OBLIQUE), rendered.prior(OBLIQUE)), OBLIQUE)
    heights = rendered.store().heights(fix.points_map[:, :2])
    off = np.abs(fix.points_map[:, 2] - heights)
    # Patches at walls and crowns lie between top and foot.
    assert np.median(off) < 0.1
    assert (off < 1.0).mean() > 0.8


def test_lens_distortion_is_taken_out() -> None:
    frame, prior = rendered.frame(TURNED, DISTORTED), rendered.prior(TURNED)
    fix = assert_near(localize(frame, prior, camera=DISTORTED), TURNED)
    assert fix.camera == DISTORTED
    # Its pixels are those of the picture without distortion: projected as by a pinhole they fit.
    seen = fix.camera.pinhole().project(fix.map_from_camera.inverse().apply(fix.points_map))
    assert np.median(np.linalg.norm(seen - fix.query_px, axis=1)) < 1.0
    blind = localize(frame, prior, camera=rendered.CAMERA)
    if isinstance(blind, Fix):
        assert rendered.errors(blind.map_from_camera, TURNED)[0] > rendered.errors(fix.map_from_camera, TURNED)[0]


LIGHT: dict[str, Callable[[ImageArray], ImageArray]] = {
    "grey": lambda image: cv2.cvtColor(image, cv2.COLOR_RGB2GRAY),
    "negative": lambda image: 255 - image,
    "dusk": lambda image: (image * 0.25).astype(np.uint8),
    "gamma": lambda image: np.rint(255.0 * (image / 255.0) ** 2.0).astype(np.uint8),
    "half in shadow": lambda image: np.rint(image * np.where(np.arange(480) < 240, 0.35, 1.0)[None, :, None]).astype(
        np.uint8
    ),
    "noise": lambda image: np.clip(image + np.random.default_rng(0).normal(0, 15, image.shape), 0, 255).astype(
        np.uint8
    ),
}


@pytest.mark.parametrize("light", LIGHT)
def test_light_and_spectrum_do_not_count(light: str) -> None:
    image = LIGHT[light](rendered.picture(TURNED))
    assert_near(localize(Frame(0, image, light), rendered.prior(TURNED)), TURNED)


def test_a_frame_of_another_size() -> None:
    """Portrait, and no multiple of anything."""
    camera = Camera(301, 407, 420.0, 418.0, 155.0, 198.0)
    assert_near(localize(rendered.frame(TURNED, camera), rendered.prior(TURNED), camera=camera), TURNED)


def test_a_heading_within_the_search_is_found() -> None:
    """25 degrees off, where the first look fails."""
    prior = rendered.prior(NADIR, error_deg=(0.5, -0.5, 25.0), sigma_deg=(1.0, 1.0, 15.0))
    assert_near(localize(rendered.frame(NADIR), prior), NADIR)


@pytest.mark.parametrize(
    ("truth", "error_m"),
    [(OBLIQUE, (22.0, 0.0, 0.0)), (OBLIQUE, (15.6, -15.6, 0.0)), (FLAT, (0.0, 22.0, 0.0))],
)
def test_a_place_far_off_the_prediction_is_found_by_looking_again(
    truth: Rigid3, error_m: tuple[float, float, float], monkeypatch: pytest.MonkeyPatch
) -> None:
    """3.5 sigmas: the predicted view has too little in common with the frame to say more than where about."""
    prior = rendered.prior(truth, error_m, (0.0, 0.0, 0.0), sigma_m=(float(np.hypot(*error_m[:2])) / 3.5, 2.0))
    assert_near(localize(rendered.frame(truth), prior), truth)
    monkeypatch.setattr(Tracking, "_looked_at_again", lambda self, starts, proceed: ())
    assert_rejected(localize(rendered.frame(truth), prior), Reason.LOW_CONTRAST, Reason.FEW_MATCHES)


def test_a_sure_prior_is_no_division_by_zero() -> None:
    exact = PosePrior(NADIR, np.zeros((6, 6)))
    outcome = localize(rendered.frame(NADIR), exact)
    assert not is_wrong(outcome, NADIR)


def test_warm_up_needs_no_matcher_of_features() -> None:
    for camera in (rendered.CAMERA, DISTORTED):
        localizer = Localizer(camera, rendered.store(), Structural(), LocalizerOptions())
        try:
            localizer.warm_up()
        finally:
            localizer.close()


# -- the same each time ------------------------------------------------------


def assert_same(one: Outcome, other: Outcome) -> None:
    assert isinstance(one, Fix)
    assert isinstance(other, Fix)
    for field in dataclasses.fields(Fix):
        a, b = getattr(one, field.name), getattr(other, field.name)
        if field.name == "timings_ms":
            continue
        if isinstance(a, Rigid3):
            assert np.array_equal(a.rotation, b.rotation)
            assert np.array_equal(a.translation, b.translation)
        elif isinstance(a, np.ndarray):
            assert np.array_equal(a, b), field.name
        else:
            assert a == b, field.name


def test_same_call_same_bits() -> None:
    """Wherever in memory its pictures lie."""
    random, between = np.random.default_rng(0), []
    frame, prior = rendered.frame(OBLIQUE), rendered.prior(OBLIQUE)
    localizer = Localizer(rendered.CAMERA, rendered.store(), Structural(), LocalizerOptions())
    try:
        first = localizer.localize(frame, prior)
        for _ in range(20):
            between = [*between[-4:], np.empty(random.integers(1, 300_000), np.uint8)]
            assert_same(first, localizer.localize(frame, prior))
    finally:
        localizer.close()
    assert_same(first, localize(frame, prior))


def test_two_localizers_in_two_threads() -> None:
    """On one map: what one sees must not leak into the other."""
    truths = [NADIR, OBLIQUE]
    frames, priors = [rendered.frame(t) for t in truths], [rendered.prior(t) for t in truths]
    localizers = [Localizer(rendered.CAMERA, rendered.store(), Structural(), LocalizerOptions()) for _ in truths]
    try:
        with ThreadPoolExecutor(2) as pool:
            runs = [
                [pool.submit(localizers[k].localize, frames[k], priors[k]) for _ in range(6)] for k in (0, 1)
            ]
            outcomes = [[run.result(60) for run in one] for one in runs]
    finally:
        for localizer in localizers:
            localizer.close()
    for truth, one in zip(truths, outcomes, strict=True):
        for outcome in one:
            assert_near(outcome, truth)


def test_the_next_frame_is_unaffected() -> None:
    localizer = Localizer(rendered.CAMERA, rendered.store(), Structural(), LocalizerOptions())
    prior = rendered.prior(TURNED)
    try:
        before = assert_near(localizer.localize(rendered.frame(TURNED), prior), TURNED)
        for image in (np.zeros((360, 480, 3), np.uint8), np.zeros((3, 3), np.uint8), rendered.picture(NADIR)):
            assert isinstance(localizer.localize(Frame(0, image, "bad"), prior), Rejected)
        after = assert_near(localizer.localize(rendered.frame(TURNED), prior), TURNED)
    finally:
        localizer.close()
    assert after.map_from_camera.translation == pytest.approx(before.map_from_camera.translation, abs=1e-3)


# -- refusals ----------------------------------------------------------------

NOT_THE_MAP: dict[str, Callable[[ImageArray], ImageArray]] = {
    "another place": lambda _: rendered.picture(NADIR),
    "mirrored": lambda image: np.ascontiguousarray(image[:, ::-1]),
    "upside-down mirrored": lambda image: np.ascontiguousarray(image[::-1]),
    "half a turn": lambda image: np.ascontiguousarray(image[::-1, ::-1]),
    "black": np.zeros_like,
    "even": lambda image: np.full_like(image, 120),
    "white": lambda image: np.full_like(image, 255),
    "noise": lambda image: np.random.default_rng(1).integers(0, 256, image.shape, dtype=np.uint8),
    "stripes": lambda image: np.broadcast_to(
        (np.arange(image.shape[1]) % 16 * 16).astype(np.uint8)[None, :, None], image.shape
    ).copy(),
}


@pytest.mark.parametrize("picture", NOT_THE_MAP)
def test_what_does_not_show_the_map_is_refused(picture: str) -> None:
    image = NOT_THE_MAP[picture](rendered.picture(TURNED))
    refused = assert_rejected(
        localize(Frame(9, image, picture), rendered.prior(TURNED)),
        Reason.FEW_MATCHES, Reason.FEW_INLIERS, Reason.LOW_CONTRAST, Reason.DEGENERATE_GEOMETRY,
    )  # fmt: skip
    assert refused.stamp_ns == 9
    assert refused.detail
    assert {"query_features", "match"} <= set(refused.timings_ms)


FAR = Rigid3(NADIR.rotation, NADIR.translation + np.array([5000.0, 0.0, 0.0]))


def test_a_region_is_no_prediction() -> None:
    east, north = NADIR.translation[:2]
    region = RegionPrior((east - 55, north - 55, east + 55, north + 55))
    refused = assert_rejected(localize(rendered.frame(NADIR), region), Reason.NO_PRIOR)
    assert "predicted pose" in refused.detail


@pytest.mark.parametrize(
    ("prior", "options", "reason"),
    [
        (rendered.prior(FAR), {}, Reason.OUTSIDE_MAP),
        (rendered.prior(NADIR, (0, 0, -150.0)), {}, Reason.PRIOR_DISAGREES),
        (rendered.prior(NADIR, sigma_m=(16.0, 60.0)), {"max_window_mpx": 0.001}, Reason.PRIOR_TOO_WIDE),
        (rendered.prior(NADIR), {"gate": GateOptions(min_sure_contrast=500.0)}, Reason.LOW_CONTRAST),
        (rendered.prior(NADIR), {"gate": GateOptions(max_relative_sigma=1e-5)}, Reason.UNCERTAIN),
    ],
)
def test_reasons(prior: PosePrior, options: dict[str, object], reason: Reason) -> None:
    refused = assert_rejected(localize(rendered.frame(NADIR), prior, **options), reason)
    assert refused.detail


@pytest.mark.parametrize(
    "image",
    [np.zeros((480, 360), np.uint8), np.zeros((0, 0, 3), np.uint8), np.zeros((360, 480), np.float32)],
    ids=["turned", "empty", "float"],
)
def test_frames_of_another_kind_are_refused(image: np.ndarray) -> None:
    refused = assert_rejected(localize(Frame(5, image, "one.jpg"), rendered.prior(NADIR)), Reason.BAD_FRAME)
    assert "one.jpg" in refused.detail


@pytest.mark.parametrize("truth", [NADIR, OBLIQUE], ids=["nadir", "oblique"])
@pytest.mark.parametrize("off_m", [50.0, -50.0])
def test_datum_error_of_fifty_metres(truth: Rigid3, off_m: float) -> None:
    assert not is_wrong(localize(rendered.frame(truth), rendered.prior(truth, (0.0, 0.0, off_m))), truth)


def test_unsettled_ground_makes_a_fix_less_certain_but_not_easier_to_pass(monkeypatch: pytest.MonkeyPatch) -> None:
    """3 m: said in covariance and apart from it; the gate judges by the rest."""
    frame, prior = rendered.frame(NADIR), rendered.prior(NADIR)
    settled = assert_near(localize(frame, prior), NADIR)
    judged: list[np.ndarray] = []
    check = gate.check
    monkeypatch.setattr(surface, "unsettled_m", lambda *_: 3.0)
    monkeypatch.setattr(gate, "check", lambda *given: judged.append(given[3]) or check(*given))
    fix = assert_near(localize(frame, prior), NADIR)
    ground = surface.unsettled_covariance(3.0, fix.points_map, fix.map_from_camera.translation)
    assert fix.ground_covariance is not None and settled.ground_covariance is not None
    assert np.allclose(fix.ground_covariance, ground)
    assert np.allclose(fix.covariance - ground, settled.covariance - settled.ground_covariance)
    assert np.allclose(judged[-1], fix.covariance - ground)
    assert fix.covariance[2, 2] > 9.0


def test_prior_sigmas_that_lie_do_not_make_a_wrong_fix() -> None:
    off = rendered.prior(NADIR, (18.0, -17.0, 0.0), sigma_m=(1.0, 1.0))
    assert not is_wrong(localize(rendered.frame(NADIR), off), NADIR)


# -- with a matcher of features for what structure can't place ---------------

TURNED_AWAY = rendered.prior(NADIR, error_deg=(0.5, -0.5, 60.0), sigma_deg=(1.0, 1.0, 40.0))


def test_a_heading_far_off_is_found_by_narrower_priors() -> None:
    assert_near(localize(rendered.frame(NADIR), TURNED_AWAY), NADIR)


def test_features_take_over_where_structure_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Tracking, "run", lambda *_, **__: None)
    frame = rendered.frame(NADIR)
    assert_rejected(localize(frame, TURNED_AWAY), Reason.FEW_MATCHES)
    fix = assert_near(localize(frame, TURNED_AWAY, Structural(acquire=rendered.sift())), NADIR)
    # It was SIFT: only there is AdHoP.
    assert fix.adhop_accepted is not None
    assert "adhop" in fix.timings_ms


def test_what_features_found_is_refined_by_structure(monkeypatch: pytest.MonkeyPatch) -> None:
    """The prediction alone leads nowhere; SIFT's pose does, and the outcome is structure's, without AdHoP."""
    monkeypatch.setattr(Tracking, "_best", lambda *_: None)
    frame, both = rendered.frame(NADIR), Structural(acquire=rendered.sift())
    fix = assert_near(localize(frame, TURNED_AWAY, both), NADIR)
    assert fix.adhop_accepted is None
    assert "refine" in fix.timings_ms
    assert "adhop" not in fix.timings_ms
    exact = assert_near(localize(frame, rendered.prior(NADIR), both), NADIR)
    off = fix.map_from_camera.translation - exact.map_from_camera.translation
    assert np.linalg.norm(off) < 0.1
    # Judged by the prediction: with one that excludes where features found it, it is no fix.
    elsewhere = rendered.prior(NADIR, (0.0, 0.0, 30.0), sigma_m=(4.0, 1.0))
    assert_rejected(localize(frame, elsewhere, both), Reason.PRIOR_DISAGREES, Reason.FEW_MATCHES, Reason.FEW_INLIERS)


def test_a_refinement_that_fails_leaves_what_features_found(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Tracking, "_best", lambda *_: None)
    monkeypatch.setattr(Tracking, "_from", lambda *_: None)
    fix = assert_near(localize(rendered.frame(NADIR), TURNED_AWAY, Structural(acquire=rendered.sift())), NADIR)
    assert fix.adhop_accepted is not None
    assert {"refine", "adhop"} <= set(fix.timings_ms)


def test_a_map_window_too_large_to_refine_leaves_what_features_found(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Tracking, "_best", lambda *_: None)

    def too_large(*_: object) -> None:
        raise WindowTooLargeError("larger than a read may be")

    monkeypatch.setattr(Tracking, "_from", too_large)
    fix = assert_near(localize(rendered.frame(NADIR), TURNED_AWAY, Structural(acquire=rendered.sift())), NADIR)
    assert fix.adhop_accepted is not None


def test_features_are_not_asked_where_structure_is_enough() -> None:
    both = assert_near(
        localize(rendered.frame(NADIR), rendered.prior(NADIR), Structural(acquire=rendered.sift())), NADIR
    )
    assert both.adhop_accepted is None
    alone = assert_near(localize(rendered.frame(NADIR), rendered.prior(NADIR)), NADIR)
    assert both.map_from_camera.translation == pytest.approx(alone.map_from_camera.translation, abs=0.02)


def test_a_region_goes_to_the_features() -> None:
    truth = rendered.pose(yaw_deg=86.0)
    east, north = truth.translation[:2]
    region = RegionPrior((east - 55, north - 55, east + 55, north + 55))
    outcome = localize(rendered.frame(truth), region, Structural(acquire=rendered.sift()))
    assert isinstance(outcome, Fix), outcome
    assert rendered.errors(outcome.map_from_camera, truth)[0] < 3.0


def test_no_time_left_no_second_way() -> None:
    asked = []

    def proceed() -> bool:
        asked.append(1)
        return False

    outcome = localize(rendered.frame(NADIR), TURNED_AWAY, Structural(acquire=rendered.sift()), proceed=proceed)
    refused = assert_rejected(outcome, Reason.LATE)
    assert asked
    assert "adhop" not in refused.timings_ms


def test_stored_features_are_no_use_to_structure_alone() -> None:
    with pytest.raises(MapError, match="structural matching has no use for stored features"):
        localize(rendered.frame(NADIR), rendered.prior(NADIR), precomputed_features="require")


# -- faults of the map -------------------------------------------------------


@pytest.fixture
def copied(tmp_path: Path) -> Path:
    return shutil.copytree(rendered.store().pack.path, tmp_path / "pack")


def tiles_under(at: Rigid3, kind: str) -> list[str]:
    layer = getattr(rendered.store().pack.manifest, kind)
    return [
        str(tile.file)
        for tile in layer.tiles
        for west, south, east, north in [layer.lattice.grid(tile.box).bounds]
        if west <= at.translation[0] < east and south <= at.translation[1] < north
    ]


@pytest.mark.parametrize("kind", ["dop", "dsm"])
def test_missing_tile_gives_no_wrong_fix_over_it(copied: Path, kind: str) -> None:
    (lost,) = tiles_under(TURNED, kind)
    (copied / lost).unlink()
    far = rendered.pose(500.0, 250.0)
    assert tiles_under(far, kind) != [lost]
    with MapStore(Pack.open(copied)) as store:
        over = localize(rendered.frame(TURNED), rendered.prior(TURNED), store=store)
        assert isinstance(over, Rejected)
        assert over.reason in (Reason.MAP_NODATA, Reason.OUTSIDE_MAP, Reason.FEW_MATCHES)
        beside = localize(rendered.frame(far), rendered.prior(far), store=store)
        assert isinstance(beside, Fix)
        assert rendered.errors(beside.map_from_camera, far)[0] < NEAR_M


@pytest.fixture
def damaged(copied: Path) -> Iterator[MapStore]:
    for tile in sorted((copied / "dop").iterdir()):
        data = bytearray(tile.read_bytes())
        for at in range(len(data) // 20, len(data), len(data) // 1000):
            data[at] ^= 0xFF
        tile.write_bytes(data)
    with MapStore(Pack.open(copied)) as store:
        yield store


def test_damaged_tiles_under_the_view(damaged: MapStore) -> None:
    assert damaged.damaged
    assert_rejected(
        localize(rendered.frame(NADIR), rendered.prior(NADIR), store=damaged), Reason.MAP_NODATA, Reason.FEW_MATCHES
    )


# -- tracks on terrain of one's own ------------------------------------------

CAMERA = Camera.from_focal(320, 240, 270.0)
EAST, NORTH, GROUND_M = 647_000.0, 5_407_000.0, 400.0


def painted(side_m: float = 240.0, holes: Callable[[MapWindow], None] | None = None, even: bool = False) -> Terrain:
    """Hills of 4 m under blots of all sizes."""
    random = np.random.default_rng(0)
    dop_side, dsm_side = round(side_m / 0.4), round(side_m / 1.0)
    blots = sum(
        cv2.GaussianBlur(random.normal(size=(dop_side, dop_side)), (0, 0), sigma) * sigma for sigma in (2.0, 5.0, 12.0)
    )
    grey = np.rint(127.5 + 90.0 * np.tanh(2.0 * blots / blots.std())).astype(np.uint8)
    if even:
        grey[:] = 120
    west, top = EAST - side_m / 2, NORTH + side_m / 2
    v, u = np.mgrid[:dsm_side, :dsm_side]
    heights = (GROUND_M + 2.0 * np.sin(u / 13.0) + 2.0 * np.cos(v / 17.0)).astype(np.float32)
    window = MapWindow(
        grey, np.ones(grey.shape, np.bool_),
        RasterGrid(dop_side, dop_side, west, top, 0.4, -0.4), heights,
        RasterGrid(dsm_side, dsm_side, west, top, 1.0, -1.0),
    )  # fmt: skip
    if holes is not None:
        holes(window)
    terrain = Terrain.of(window, LocalFrame(EAST, NORTH, 0.9997))
    assert terrain is not None
    return terrain


def camera_at(height_m: float = 60.0, tilt_deg: float = 0.0, heading_deg: float = 20.0) -> Rigid3:
    """``local_from_camera``."""
    return Rigid3(turned_down(tilt_deg, heading_deg), [3.0, -5.0, GROUND_M + height_m])


def predicted(terrain: Terrain, truth: Rigid3, scale: float = 1.0) -> PosePrior:
    covariance = np.diag(np.square([3.0, 3.0, 3.0, 0.02, 0.02, 0.05])) * scale**2
    off = Rigid3(truth.rotation, truth.translation + scale * np.array([2.0, -1.5, 1.0]))
    return PosePrior(terrain.local.map_from_local_pose(off), covariance)


def track(
    terrain: Terrain, grey: ImageArray, prior: PosePrior, camera: Camera = CAMERA, tuning: Tuning = TUNING
) -> Track | None:
    return Tracking(QueryMaker(camera, tuning).fields(grey), terrain, prior, camera, Trace(), tuning).run()


@pytest.mark.parametrize("tilt_deg", [0.0, 30.0, 55.0])
@pytest.mark.parametrize("camera", [CAMERA, Camera(210, 333, 290.0, 300.0, 97.0, 160.0)], ids=["plain", "odd"])
def test_its_own_view_is_tracked_to_centimetres(camera: Camera, tilt_deg: float) -> None:
    terrain, truth = painted(), camera_at(tilt_deg=tilt_deg)
    grey = render(terrain, camera, truth).image
    found = track(terrain, grey, predicted(terrain, truth), camera)
    assert found is not None
    assert found.convincing
    off_m, off_deg = rendered.errors(found.estimate.local_from_camera, truth)
    assert off_m < 0.15
    assert off_deg < 0.15
    assert found.inliers == found.estimate.inliers.sum()
    assert len(found.query_px) == len(found.points_local) == len(found.estimate.inliers)


@pytest.mark.parametrize("height_m", [12.0, 20.0])
def test_a_frame_much_finer_than_the_map_is_tracked(height_m: float) -> None:
    """Pixels of the map are 0.4 m, the frame's 2 to 4 cm: sand between them that the map does not show."""
    terrain, truth = painted(), camera_at(height_m=height_m)
    camera = Camera.from_focal(640, 480, 540.0)
    view = render(terrain, camera, truth)
    sand = cv2.GaussianBlur(np.random.default_rng(1).normal(size=view.image.shape), (0, 0), 1.5)
    grey = np.clip(view.image + 25.0 * sand / sand.std(), 0, 255).astype(np.uint8)
    found = track(terrain, grey, predicted(terrain, truth, scale=height_m / 60.0), camera)
    assert found is not None
    assert found.support > 0.3
    off_m, off_deg = rendered.errors(found.estimate.local_from_camera, truth)
    assert off_m < 0.05 * height_m
    assert off_deg < 2.0


def test_a_map_as_fine_as_the_frame_leaves_it_as_it_is() -> None:
    fields = QueryMaker(CAMERA).fields(render(painted(), CAMERA, camera_at()).image)
    assert fields.as_sharp_as_a_map([0.3, 0.7, 1.4]) is fields
    softened = fields.as_sharp_as_a_map([0.7, 1.4, 2.8])
    assert softened.fields[1] is fields.fields[1]
    assert not np.array_equal(softened.fields[2], fields.fields[2])
    for coarse in ([1.2, 2.4, 4.8], [50.0, 100.0, 200.0]):
        assert len(fields.as_sharp_as_a_map(coarse).fields) == 2


def test_matches_are_in_pixels_of_the_full_frame() -> None:
    """Three times as large as the last level: half a pixel of that would be more than one."""
    camera = Camera.from_focal(1620, 1080, 1400.0)
    terrain, truth = painted(), camera_at(tilt_deg=15.0)
    found = track(terrain, render(terrain, camera, truth).image, predicted(terrain, truth), camera)
    assert found is not None
    assert found.estimate.camera == camera
    seen = camera.project(truth.inverse().apply(found.points_local))
    off = (seen - found.query_px)[found.estimate.inliers]
    assert np.abs(np.median(off, axis=0)).max() < 0.25


def orchard(window: MapWindow) -> None:
    """Trees 8 m apart, all alike."""
    v, u = np.mgrid[: window.dop_grey.shape[0], : window.dop_grey.shape[1]] * 0.4
    near = np.hypot((u % 8.0) - 4.0, (v % 8.0) - 4.0)
    window.dop_grey[:] = np.where(near < 1.6, 60, 160)
    window.dsm[:] = GROUND_M


@pytest.mark.parametrize("tuning", LADDER, ids=["512", "384", "256"])
def test_a_pattern_that_repeats_has_a_rival(tuning: Tuning) -> None:
    """Whatever place it is given, one row further fits as well."""
    trees, truth = painted(holes=orchard), camera_at()
    found = track(trees, render(trees, CAMERA, truth).image, predicted(trees, truth), tuning=tuning)
    assert found is not None
    assert found.convincing
    assert found.rival > GateOptions().max_rival
    blots = painted()
    alone = track(blots, render(blots, CAMERA, truth).image, predicted(blots, truth), tuning=tuning)
    assert alone is not None
    assert alone.rival < 0.5 * GateOptions().max_rival


def test_calibration_needs_features() -> None:
    with pytest.raises(ConfigError, match="focal length"):
        Localizer(rendered.CAMERA, rendered.store(), Structural(), LocalizerOptions(calibrate=True))


def no_heights_east(window: MapWindow) -> None:
    window.dsm[:, window.dsm.shape[1] // 2 :] = np.nan


def no_picture_north(window: MapWindow) -> None:
    window.dop_valid[: window.dop_grey.shape[0] // 2] = False
    window.dop_grey[~window.dop_valid] = 0


def moth_eaten(window: MapWindow) -> None:
    """Ponds of 6 m without heights."""
    for row, column in np.random.default_rng(3).integers(0, window.dsm.shape[0] - 6, (40, 2)):
        window.dsm[row : row + 6, column : column + 6] = np.nan


@pytest.mark.parametrize("holes", [no_heights_east, no_picture_north, moth_eaten])
def test_what_is_left_of_a_map_gives_a_right_track_or_none_that_convinces(
    holes: Callable[[MapWindow], None],
) -> None:
    whole, truth = painted(), camera_at()
    grey = render(whole, CAMERA, truth).image
    left = painted(holes=holes)
    found = track(left, grey, predicted(left, truth))
    assert found is not None
    off_m, _ = rendered.errors(found.estimate.local_from_camera, truth)
    assert off_m < 0.3 or not found.convincing
    # Nothing is matched where there is no map.
    assert np.isfinite(found.points_local).all()
    if holes is no_heights_east:
        assert (found.points_local[:, 0] < 1.0).all()


@pytest.mark.parametrize("tilt_deg", [0.0, 60.0, 80.0, 140.0])
@pytest.mark.parametrize("even", [False, True], ids=["painted", "even"])
def test_nothing_to_see_is_no_track(even: bool, tilt_deg: float) -> None:
    """An even frame, a noisy one, and one of the map, on a map with and without a picture, to beyond the horizon."""
    terrain, truth = painted(even=even), camera_at(tilt_deg=tilt_deg)
    noise = np.random.default_rng(0).integers(0, 256, (240, 320), dtype=np.uint8)
    frames = [np.full((240, 320), 90, np.uint8), noise]
    if even:
        frames.append(render(painted(), CAMERA, truth).image)
    for grey in frames:
        found = track(terrain, grey, predicted(terrain, truth))
        assert found is None or not found.convincing


def test_level_pictures() -> None:
    """Of the sizes that are asked for, and of the camera's field of view."""
    for camera in (CAMERA, Camera(181, 333, 290.0, 300.0, 92.3, 160.0), DISTORTED):
        query = QueryMaker(camera).fields(np.zeros((camera.height, camera.width), np.uint8))
        assert len(query.cameras) == len(query.fields) == len(TUNING.levels)
        for level, small, field in zip(TUNING.levels, query.cameras, query.fields, strict=True):
            assert max(small.width, small.height) == level.long_px
            assert field.shape == (2, small.height, small.width)
            assert small.is_pinhole
            corner = (-0.5, camera.height - 0.5)
            small_corner = (-0.5, small.height - 0.5)
            assert small.unproject(small_corner) == pytest.approx(camera.pinhole().unproject(corner), abs=1e-9)


def test_fields_of_a_distorted_frame_are_the_pinhole_s() -> None:
    """The same view through both lenses."""
    one = QueryMaker(DISTORTED).fields(cv2.cvtColor(rendered.picture(TURNED, DISTORTED), cv2.COLOR_RGB2GRAY))
    two = QueryMaker(rendered.CAMERA).fields(cv2.cvtColor(rendered.picture(TURNED), cv2.COLOR_RGB2GRAY))
    for level, (a, b) in enumerate(zip(one.fields, two.fields, strict=True)):
        inner = np.s_[:, a.shape[1] // 8 : -a.shape[1] // 8, a.shape[2] // 8 : -a.shape[2] // 8]
        x, y = a[inner], b[inner]
        assert (x * y).sum() / np.sqrt(np.square(x).sum() * np.square(y).sum()) > (0.9, 0.85, 0.75)[level], level


@pytest.mark.parametrize("seed", range(4))
def test_no_picture_map_or_prior_raises(seed: int) -> None:
    """Cameras in and just above the ground, views of the sky, maps in rags, priors of any width."""
    random = np.random.default_rng(seed)
    for _ in range(12):
        holes = [None, no_heights_east, no_picture_north, moth_eaten][random.integers(4)]
        terrain = painted(float(random.choice([40.0, 120.0])), holes, even=bool(random.random() < 0.2))
        truth = camera_at(random.uniform(-5, 120), random.uniform(0, 100), random.uniform(-180, 180))
        grey = render(terrain, CAMERA, truth).image
        if random.random() < 0.5:
            grey = random.integers(0, 256, grey.shape, dtype=np.uint8)
        sigmas = 10.0 ** random.uniform(-6.0, 2.5, 6) * (1.0, 1.0, 1.0, 0.02, 0.02, 0.05)
        prior = PosePrior(terrain.local.map_from_local_pose(truth), np.diag(np.square(sigmas)))
        found = track(terrain, grey, prior)
        if found is not None:
            assert np.linalg.eigvalsh(found.estimate.covariance)[0] > 0
            assert np.isfinite(found.points_local).all()
