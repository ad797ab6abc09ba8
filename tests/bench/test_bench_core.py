"""The core's figures on known answers: estimators that lie by known amounts, frames that were planted."""

from __future__ import annotations

import csv
import json
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rasterio.shutil
from replay import rendered

from ortholoc_edge.bench import contact, core, hostile, metrics
from ortholoc_edge.bench.core import Scene, Site, Take
from ortholoc_edge.bench.hostile import HostileBench, Kind, Matching
from ortholoc_edge.bench.sets import find_sets
from ortholoc_edge.cli import EXIT_CONFIG, EXIT_FAILED, main
from ortholoc_edge.errors import DatasetError
from ortholoc_edge.geometry import rotation
from ortholoc_edge.geometry.rigid import Rigid3
from ortholoc_edge.matching.types import Structural
from ortholoc_edge.pipeline.outcome import Fix, Reason, Rejected
from ortholoc_edge.pipeline.prior import PosePrior, RegionPrior

POSES = [
    rendered.pose(),
    rendered.pose(318.0, 262.0, yaw_deg=34.0, roll_deg=4.0),
    rendered.pose(180.0, 170.0, yaw_deg=41.0, pitch_deg=-6.0),
]
PACK = rendered.store().pack.path
TRUE = {f"frame_{index:02d}": pose for index, pose in enumerate(POSES)}


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two sets of the same rendered flight; the second says what lasts, and is told to be another place."""
    folder = tmp_path_factory.mktemp("data")
    rendered.write_flight(folder / "here", POSES)
    for raster in ("dop", "dsm"):
        rasterio.shutil.copy(PACK / f"{raster}.vrt", folder / "here" / f"here_{raster}.tif", driver="GTiff")
    shutil.copytree(folder / "here", folder / "there")
    table = next((folder / "there").glob("*_flight.csv"))
    with table.open(newline="", encoding="utf-8") as lines:
        rows = list(csv.DictReader(lines))
    with table.open("w", newline="", encoding="utf-8") as lines:
        writer = csv.DictWriter(lines, [*rows[0], "lasting_share"])
        writer.writeheader()
        writer.writerows({**row, "lasting_share": share} for row, share in zip(rows, (0.3, 0.01, 0.0), strict=True))
    return folder


@pytest.fixture(scope="module")
def sites(data: Path, tmp_path_factory: pytest.TempPathFactory) -> list[Site]:
    scratch = tmp_path_factory.mktemp("packs")
    return [site for one in find_sets(data) for site in core.build_sites(one, scratch)]


@pytest.fixture
def built(sites: list[Site], monkeypatch: pytest.MonkeyPatch) -> None:
    """The command takes the packs that are there. (That it builds them: `test_the_command_prints_...`.)"""
    monkeypatch.setattr(core, "build_sites", lambda one, scratch: [site for site in sites if site.name == one.name])


@pytest.fixture(scope="module")
def scene(sites: list[Site]) -> Iterator[Scene]:
    with core.opened(sites[0], None) as found:
        yield found


class Estimator:
    """Stands in for a localizer: ``error`` (6,), position in m and rotation vector in rad, on the truth of the frame
    (or of the prior), claiming ``sigma`` of each; ``refused`` frames give none."""

    def __init__(self, error: np.ndarray, sigma: float, refused: tuple[str, ...] = (), of_prior: bool = False) -> None:
        self.error, self.sigma, self.refused, self.of_prior = error, sigma, refused, of_prior
        self.asked: list[PosePrior | RegionPrior] = []

    def localize(self, frame, prior, proceed=None):
        self.asked.append(prior)
        if frame.name in self.refused:
            return Rejected(0, Reason.FEW_MATCHES)
        pose = prior.map_from_camera if self.of_prior else TRUE[frame.name]
        turned = rotation.exp(-self.error[3:]) @ pose.rotation
        return Fix(
            stamp_ns=0, map_from_camera=Rigid3(turned, pose.translation - self.error[:3]), camera=rendered.CAMERA,
            covariance=np.eye(6) * self.sigma**2, quality=1.0, matches=60, inliers=50, rms_px=0.7, adhop_accepted=None,
            query_px=np.full((50, 2), 100.0), points_map=np.tile(pose.translation - (0.0, 0.0, 90.0), (50, 1)),
        )  # fmt: skip


@contextmanager
def instead(estimator: Estimator) -> Iterator[Callable[[object], Estimator]]:
    yield lambda camera: estimator


def takes_by(scene: Scene, estimator: Estimator, monkeypatch: pytest.MonkeyPatch, draws: int = 2) -> list[Take]:
    monkeypatch.setattr(core, "localizers", lambda store, matcher, options: instead(estimator))
    return list(core.random_priors(scene, Structural(), draws, 7))


def test_an_estimator_twice_as_wrong_as_it_says_has_four_times_the_nees(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    honest = core.figures("random", "x", "m", takes_by(scene, Estimator(np.full(6, 0.01), 0.01), monkeypatch))
    liar = core.figures("random", "x", "m", takes_by(scene, Estimator(np.full(6, 0.02), 0.01), monkeypatch))
    assert honest.nees_per_dof == pytest.approx(1.0, rel=1e-4)
    assert liar.nees_per_dof == pytest.approx(4.0, rel=1e-4)
    assert liar.nees.p95 == pytest.approx(24.0, rel=1e-4)
    verdict = {target.what: target.met for target in core.targets(liar)}
    assert verdict["NEES mean / dof"] is False
    assert {t.what: t.met for t in core.targets(honest)}["NEES mean / dof"] is True


def test_figures_count_all_frames_in_recall_and_fixes_in_errors(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    sideways = Estimator(np.array([0.0, 0.7, 0.0, 0.0, 0.0, 0.0]), 0.5, refused=("frame_01",))
    takes = takes_by(scene, sideways, monkeypatch)
    found = core.figures("random", "x", "m", takes)
    assert (found.frames, found.fixes, found.rejected) == (6, 4, {"few_matches": 2})
    assert [take.is_missed for take in takes] == [False, True, False] * 2
    assert [take.draw for take in takes] == [0] * 3 + [1] * 3
    assert found.recall == {"1m_1deg": pytest.approx(2 / 3), "0.5m_0.5deg": 0.0}
    assert found.te_m.median == found.te_m.max == pytest.approx(0.7)
    assert found.query_px == 480
    met = {target.what: target.met for target in core.targets(found)}
    assert met["recall 1m-1°"] is False
    assert met["priors"] is False
    assert met["false fixes"] is True


def test_a_planted_false_fix_is_counted(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    for error, false in (([9.5, 0, 0, 0, 0, 0], 6), ([8.5, 0, 0, 0, 0, 0], 0), ([0, 0, 0, 0, 0, np.radians(5.5)], 6)):
        found = core.figures("random", "x", "m", takes_by(scene, Estimator(np.array(error), 1.0), monkeypatch))
        # From 90 m up, a tenth of the height is less than 10 m.
        assert found.false_fixes == false


def test_the_rule_for_false_fixes_follows_the_height() -> None:
    assert core.false_fix_m(15.0) == pytest.approx(1.5)
    assert core.false_fix_m(400.0) == metrics.FALSE_FIX_M


def test_the_first_frame_of_a_run_is_not_timed(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    takes = takes_by(scene, Estimator(np.zeros(6), 1.0), monkeypatch)
    assert [take.is_first for take in takes] == [True] + [False] * 5
    timed = [
        replace(take, result=replace(take.result, cpu_ms=cpu, wall_ms=2 * cpu))
        for take, cpu in zip(takes, (500.0, 10.0, 10.0, 10.0, 10.0, 30.0), strict=True)
    ]
    found = core.figures("random", "x", "m", timed)
    assert (found.cpu_ms.median, found.cpu_ms.max) == (10.0, 30.0)
    assert found.wall_ms.median == 20.0
    assert found.wall_p99_over_median == pytest.approx(np.percentile([10, 10, 10, 10, 30], 99) / 10)
    late = {t.what: t.met for t in core.targets(found)}["p99 / median of the wall time"]
    assert late is False


def test_random_priors_are_the_same_for_every_estimator_and_as_wide_as_stated(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    one, two = Estimator(np.zeros(6), 1.0), Estimator(np.ones(6), 1.0)
    takes = takes_by(scene, one, monkeypatch, draws=150)
    takes_by(scene, two, monkeypatch, draws=2)
    poses = [prior.map_from_camera.translation for prior in one.asked]
    assert np.array_equal(poses[:6], [prior.map_from_camera.translation for prior in two.asked])
    errors = np.array([p - take.result.truth.translation for p, take in zip(poses, takes, strict=True)])
    heights = np.array([take.view.height_m for take in takes])
    assert np.allclose((errors / heights[:, None]).std(axis=0), (0.06, 0.06, 0.04), rtol=0.15)


def test_frames_are_averaged_down_with_their_camera(sites: list[Site], scene: Scene) -> None:
    with core.opened(sites[0], 240) as small:
        frame, full = small.views[0].frame, scene.views[0].frame
        assert (frame.camera.width, frame.camera.height) == (240, 180)
        assert frame.camera.fx == pytest.approx(full.camera.fx / 2)
        assert frame.camera.cx == pytest.approx((full.camera.cx + 0.5) / 2 - 0.5)
        blocks = full.picture.reshape(180, 2, 240, 2, 3).mean(axis=(1, 3))
        assert np.abs(frame.picture - blocks).max() <= 0.51
        assert small.views[0].height_m == pytest.approx(scene.views[0].height_m)
    with core.opened(sites[0], 4000) as large:
        assert large.views[0].frame.camera == full.camera


def test_what_lasts_comes_from_the_flights_table(sites: list[Site], scene: Scene) -> None:
    with core.opened(sites[1], None) as there:
        takes = list(core.random_priors(there, Structural(), 1, 0))
    assert [take.view.lasting_share for take in takes] == [0.3, 0.01, 0.0]
    assert [take.result.name for take in core.lasting(takes)] == ["frame_00", "frame_01"]
    assert all(view.lasting_share is None for view in scene.views)


def test_a_share_that_is_no_number_is_named(sites: list[Site], tmp_path: Path) -> None:
    folder = shutil.copytree(sites[1].source, tmp_path / "there")
    table = next(folder.glob("*_flight.csv"))
    table.write_text(table.read_text().replace("0.3", "much"), encoding="utf-8")
    with pytest.raises(DatasetError, match="lasting_share"), core.opened(replace(sites[1], source=folder), None):
        pass


def test_the_papers_pipeline_gets_a_region_and_ours_a_pose(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    theirs, ours = Estimator(np.array([0.4, 0, 0, 0, 0, 0]), 1.0, ("frame_01",)), Estimator(np.full(6, 0.01), 1.0)
    given = []

    def localizers(store, matcher, options):
        given.append(options)
        return instead(theirs if options is core.PAPER_OPTIONS else ours)

    monkeypatch.setattr(core, "localizers", localizers)
    pairs = list(core.beside_the_paper(scene, [Structural()], Structural(), 3))
    assert [options.adhop for options in given] == [True, True]
    assert all(isinstance(prior, RegionPrior) for prior in theirs.asked)
    assert all(isinstance(prior, PosePrior) for prior in ours.asked)
    for prior, view in zip(theirs.asked, scene.views, strict=True):
        west, south, east, north = prior.bounds_map
        at = view.frame.map_from_camera.translation
        assert west < at[0] < east
        assert south < at[1] < north
    paper, own = [papers[0] for papers, _ in pairs], [take for _, take in pairs]
    timed = [
        [replace(t, result=replace(t.result, cpu_ms=cpu)) for t in takes] for takes, cpu in ((paper, 60.0), (own, 20.0))
    ]
    found = core.compared(*timed, ("theirs", "ours"))
    assert (found.frames, found.both) == (3, 2)
    assert found.te_ratio == pytest.approx(0.4 / (0.01 * 3**0.5))
    assert found.cpu_ratio == pytest.approx(3.0)


# -- hostile frames --------------------------------------------------------------------------------------


@contextmanager
def bench_with(sites: list[Site], estimator: Estimator, monkeypatch: pytest.MonkeyPatch) -> Iterator[HostileBench]:
    monkeypatch.setattr(hostile, "localizers", lambda store, matcher, options: instead(estimator))
    with HostileBench(sites, sites[1:], Matching(("structural",)), 5, None) as bench:
        yield bench


def test_who_believes_the_prior_gives_a_false_fix_of_every_kind(
    sites: list[Site], monkeypatch: pytest.MonkeyPatch
) -> None:
    with bench_with(sites, Estimator(np.zeros(6), 1.0, of_prior=True), monkeypatch) as bench:
        verdicts = [v for number in range(3 * len(Kind)) for v in bench.trial(number)]
    assert [v.kind for v in verdicts] == 3 * list(Kind)
    # Blurred pictures have a truth and a prior that may happen to be near it.
    assert all(v.outcome == hostile.FALSE for v in verdicts if v.kind is not Kind.BLURRED)
    for v in verdicts:
        has_truth = v.kind in (
            Kind.ELSEWHERE, Kind.HEADING_180, Kind.HEADING_60, Kind.HEIGHT, Kind.STALE, Kind.BLURRED
        )  # fmt: skip
        assert (v.te_m is not None) == has_truth
        assert (v.inliers, v.matches, v.rms_px) == (50, 60, 0.7)
    turns = {k: [v.re_deg for v in verdicts if v.kind is k] for k in (Kind.HEADING_180, Kind.HEADING_60)}
    assert min(turns[Kind.HEADING_180]) > 165
    assert all(45 < turn < 75 for turn in turns[Kind.HEADING_60])
    assert all(35 < v.te_m < 120 for v in verdicts if v.kind is Kind.STALE)
    assert all(25 < v.te_m < 120 for v in verdicts if v.kind is Kind.HEIGHT)


def test_a_fix_near_the_truth_is_right_in_spite_of_the_prior(
    sites: list[Site], monkeypatch: pytest.MonkeyPatch
) -> None:
    with bench_with(sites, Estimator(np.full(6, 0.01), 1.0), monkeypatch) as bench:
        verdicts = [v for number in range(2 * len(Kind)) for v in bench.trial(number)]
    right = {v.kind for v in verdicts if v.outcome == hostile.RIGHT}
    assert right == {Kind.HEADING_180, Kind.HEADING_60, Kind.HEIGHT, Kind.STALE, Kind.BLURRED}
    # This one does not look at the picture: shown another, it names the frame's own place.
    assert all(v.outcome == hostile.FALSE for v in verdicts if v.kind is Kind.ELSEWHERE)


def test_a_trial_is_the_same_alone_and_in_another_process(sites: list[Site]) -> None:
    def verdicts(numbers: list[int], workers: int) -> list[hostile.Verdict]:
        return list(
            hostile.run_trials(numbers, sites[:1], [], Matching(("structural",)), seed=1, query_px=240, workers=workers)
        )

    together = verdicts(list(range(10)), 2)
    assert [v.number for v in together] == list(range(10))
    assert verdicts([7], 1) == [together[7]]
    # One place only: nothing outside, and no stale map.
    assert {v.kind for v in together} == set(Kind) - {Kind.OUTSIDE, Kind.STALE}


def test_made_pictures_are_what_they_say() -> None:
    random = np.random.default_rng(0)
    shape = (120, 160, 3)
    black, even, noise, water = (
        hostile._picture_of(kind, shape, random) for kind in (Kind.BLACK, Kind.EVEN, Kind.NOISE, Kind.WATER)
    )
    assert all(picture.shape == shape and picture.dtype == np.uint8 for picture in (black, even, noise, water))
    assert black.max() == 0
    assert (even == even[0, 0]).all()
    assert noise.std() == pytest.approx(73.9, abs=2)
    # Waves: neighbours are alike, far apart they are not.
    grey = water.mean(axis=2) - water.mean()
    assert 8 < grey.std() < 40
    assert (grey[:, 1:] * grey[:, :-1]).mean() > 0.8 * grey.var()


# -- pictures --------------------------------------------------------------------------------------------


def test_best_median_and_worst_are_of_distinct_frames(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    takes = takes_by(scene, Estimator(np.zeros(6), 1.0, refused=("frame_02",)), monkeypatch)
    errors = {"frame_00": (0.5, 0.1), "frame_01": (0.2, 0.3)}
    takes = [
        t if t.result.error is None
        else replace(t, result=replace(t.result, error=metrics.PoseError(errors[t.result.name][k // 3], 0.0, 6.0)))
        for k, t in enumerate(takes)
    ]  # fmt: skip

    def named(which: str, count: int) -> list[tuple[str, float | None]]:
        chosen = contact.best_median_worst(takes, count)[which]
        return [(t.result.name, t.result.error and t.result.error.te_m) for t in chosen]

    assert named("best", 2) == [("frame_00", 0.1), ("frame_01", 0.2)]
    assert named("worst", 3) == [("frame_02", None), ("frame_00", 0.5), ("frame_01", 0.3)]
    assert named("median", 1) == [("frame_01", 0.3)]


def test_the_map_in_view_shows_each_place_where_the_camera_sees_it(scene: Scene) -> None:
    view = scene.views[1]
    pose, camera = view.frame.map_from_camera, view.frame.camera
    drawn = contact.map_in_view(scene.store, camera, pose, float(pose.translation[2]) - view.height_m)
    assert drawn.shape == view.frame.picture.shape
    x, y = np.meshgrid(np.linspace(-25.0, 25.0, 40), np.linspace(-20.0, 20.0, 40))
    places = pose.translation[:2] + np.column_stack([x.ravel(), y.ravel()])
    (west, south), (east, north) = places.min(axis=0) - 5.0, places.max(axis=0) + 5.0
    window = scene.store.read_colour((west, south, east, north), 0.2)

    def difference(moved_m: float) -> float:
        points = np.column_stack([places, scene.store.heights(places)])
        at = np.round(camera.project(pose.inverse().apply(points))).astype(int)
        there = np.round(window.grid.px_from_map(np.add(places, (moved_m, 0.0)))).astype(int)
        colours = drawn[at[:, 1], at[:, 0]].astype(float) - window.rgb[there[:, 1], there[:, 0]]
        return float(np.median(np.abs(colours).max(axis=1)))

    # The median: what hides behind a house is drawn on it.
    assert difference(0.0) < 12
    assert difference(1.5) > 1.5 * difference(0.0)


def test_a_sheet_shows_three_pictures_of_every_frame(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    takes = takes_by(scene, Estimator(np.full(6, 0.01), 1.0, refused=("frame_01",)), monkeypatch, draws=1)
    sheet = contact.sheet(takes)
    assert sheet.shape[1] == 2 * 3 * 480
    assert sheet.shape[0] > 2 * 360
    assert "no fix: few_matches" in contact.caption(takes[1])
    assert "TE 0.02 m  RE 0.99 deg  50/60 inliers" in contact.caption(takes[0])


# -- the command -----------------------------------------------------------------------------------------


def run(*arguments: object) -> int:
    return main([str(argument) for argument in arguments])


def test_the_command_prints_tables_targets_and_pictures(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code = run(
        "bench-core", data, "--sets", "here", "--parts", "tracking", "random", "crossdomain", "hostile",
        "--crossdomain", data / "there", "--seeds", 1, "--draws", 4, "--hostile", 12, "--out", tmp_path / "out",
    )  # fmt: skip
    assert code == 0
    told = capsys.readouterr().out
    assert [line for line in told.splitlines() if line.startswith("###")] == [
        "### Tracking", "### Random priors", "### Across domains", "### Hostile frames",
    ]  # fmt: skip
    assert "2 of each of 3 frames." in told
    assert told.count("| here | structural | 480 |") == 2
    assert "| there with something lasting in view | structural | 480 | 2 |" in told
    assert "| hostile frames | all structural | ≥ 10000 | 12.00 | **no** |" in told
    tables = [block for block in told.split("\n\n") if block.startswith("|")]
    for table in tables:
        assert len({line.count("|") for line in table.splitlines()}) == 1
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == [
        "structural_best.png", "structural_median.png", "structural_worst.png",
    ]  # fmt: skip


def test_a_false_fix_is_listed_with_its_number_and_can_be_run_alone(
    data: Path, built: None, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    believer = Estimator(np.zeros(6), 1.0, of_prior=True)
    monkeypatch.setattr(hostile, "localizers", lambda store, matcher, options: instead(believer))
    # Of one place, where nothing is outside.
    assert run("bench-core", data, "--sets", "here", "--parts", "hostile", "--trials", 1, 3, "--json") == 0
    rows = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [(r["number"], r["kind"]) for r in rows if r["row"] == "false_fix"] == [(1, "mirrored"), (3, "heading-60")]
    (every,) = (r for r in rows if r["row"] == "hostile" and r["kind"] == "all")
    assert (every["frames"], every["false_fixes"], every["right"]) == (2, 2, 0)
    assert {r["what"]: r["met"] for r in rows if r["row"] == "target"} == {
        "hostile frames": False,
        "false fixes": False,
    }


def test_missed_frames_are_named_with_their_prior(
    data: Path, built: None, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    estimator = Estimator(np.array([2.0, 0, 0, 0, 0, 0]), 1.0, refused=("frame_01",))
    monkeypatch.setattr(core, "localizers", lambda store, matcher, options: instead(estimator))
    asked = ["bench-core", data, "--sets", "here", "--parts", "random", "--draws", 3]
    assert run(*asked) == 0
    assert (
        "Beyond 1m-1° (3): here/frame_00 #0 2.00 m 0.00°, here/frame_01 #0 few_matches, here/frame_02 #0 2.00 m 0.00°."
        in capsys.readouterr().out
    )
    assert run(*asked, "--json") == 0
    rows = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [(r["name"], r["draw"]) for r in rows if r["row"] == "missed"] == [(f"frame_0{k}", 0) for k in range(3)]


def test_what_can_not_be_measured_is_said_first(data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for code, arguments, named in (
        (EXIT_FAILED, [data, "--sets", "nowhere"], "nowhere"),
        (EXIT_CONFIG, [data, "--parts", "crossdomain"], "--crossdomain"),
        (EXIT_CONFIG, [data, "--parts", "hostile", "--out", tmp_path], "random"),
        (EXIT_FAILED, [tmp_path], "no set"),
    ):
        assert run("bench-core", *arguments) == code
        assert named in capsys.readouterr().err
