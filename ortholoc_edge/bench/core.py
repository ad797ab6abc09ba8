"""The localization core, measured: tracking, random priors, other domains, and the paper's pipeline beside it.

All parts take decoded frames, so that times are from the decoded picture to the outcome, map reading included, and all
noise from a seed, the frame's place in its set and the draw, so that every matcher meets the same priors.
"""

from __future__ import annotations

import csv
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import cv2
import numpy as np
from msgspec import Struct

from ortholoc_edge.bench import metrics, sequence
from ortholoc_edge.bench.replay import (
    FrameResult,
    Length,
    PriorKind,
    PriorNoise,
    Timer,
    noisy_prior,
    outcome_error,
    paper_region,
)
from ortholoc_edge.bench.runner import build_sample_pack, localizers, run_flight, true_ground
from ortholoc_edge.bench.samples import read_sample, sample_paths
from ortholoc_edge.bench.sets import RecordedSet
from ortholoc_edge.errors import DatasetError
from ortholoc_edge.geometry.arrays import ImageArray
from ortholoc_edge.matching.types import AnyMatcher
from ortholoc_edge.pipeline.frame import Frame
from ortholoc_edge.pipeline.gate import GateOptions
from ortholoc_edge.pipeline.localizer import Localizer, LocalizerOptions
from ortholoc_edge.pipeline.prior import PosePrior, RegionPrior
from ortholoc_edge.tiles.build import PackOptions, build_pack
from ortholoc_edge.tiles.lattice import Bounds
from ortholoc_edge.tiles.pack import Pack
from ortholoc_edge.tiles.store import MapStore

RECALL_LIMITS: Final[Mapping[str, tuple[float, float]]] = {"1m_1deg": (1.0, 1.0), "0.5m_0.5deg": (0.5, 0.5)}
# A false fix is beyond `metrics.FALSE_FIX_M` or this part of the height above ground, whichever is less, or beyond
# `metrics.FALSE_FIX_DEG`: from 15 m up, 10 m are most of what the camera sees.
FALSE_FIX_OF_HEIGHT = 0.10
# What an autopilot without GNSS knows (issue 4): 6 % of the height above ground per horizontal axis, 4 % vertically.
RANDOM_NOISE: Final = PriorNoise((1.0, 1.0, 3.0), (Length(of_height=0.06), Length(of_height=0.04)))
# From this share of a picture on, something in it lasts from the map's epoch to the photo's.
LASTING_SHARE = 0.01
# The paper has no gate: every pose counts.
PAPER_OPTIONS: Final = LocalizerOptions(
    adhop=True,
    gate=GateOptions(
        min_inliers=6,
        min_inlier_ratio=0.0,
        min_spread=0.0,
        max_rms_ratio=1.0,
        max_innovation_sigmas=1e9,
        max_relative_sigma=1e9,
    ),
)


@dataclass(frozen=True, slots=True, eq=False)
class DecodedFrame(sequence.RecordedFrame):
    """A recorded frame whose photo was decoded, and brought to the size to measure at, before."""

    picture: ImageArray

    def image(self) -> ImageArray:
        return self.picture


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """A frame over a map.

    Attributes:
        height_m: of the true position above ground.
        region: that the paper's pipeline is given; None: to be drawn around the footprint.
        lasting_share: of the picture that shows what the map shows too; None where nobody says.
    """

    frame: DecodedFrame
    height_m: float
    region: Bounds | None = None
    lasting_share: float | None = None


@dataclass(frozen=True, slots=True)
class Site:
    """A map with frames over it, on disk: what a process needs to open it.

    Attributes:
        name: of its set.
        place: that it shows; sites of one place show the same ground.
        source: flight folder or sample.
    """

    name: str
    place: str
    source: Path
    pack: Path

    @property
    def is_flight(self) -> bool:
        return self.source.is_dir()


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """A site, opened."""

    site: Site
    store: MapStore
    views: list[View]


@dataclass(frozen=True, slots=True, eq=False)
class Take:
    """One frame, localized once.

    Attributes:
        draw: number of the prior; in tracking the seed.
        is_first: of its run: it paid for what is set up once, and its times don't count.
    """

    scene: Scene
    view: View
    result: FrameResult
    draw: int
    is_first: bool

    @property
    def is_missed(self) -> bool:
        """Without a fix within 1m-1°."""
        error, (metres, degrees) = self.result.error, RECALL_LIMITS["1m_1deg"]
        return error is None or error.te_m > metres or error.re_deg > degrees

    @property
    def is_false(self) -> bool:
        error = self.result.error
        return error is not None and is_false_fix(error, self.view.height_m)


def is_false_fix(error: metrics.PoseError, height_m: float) -> bool:
    """Whether a fix is worse than no fix; see `FALSE_FIX_OF_HEIGHT`."""
    return error.te_m > false_fix_m(height_m) or error.re_deg > metrics.FALSE_FIX_DEG


def false_fix_m(height_m: float) -> float:
    return min(metrics.FALSE_FIX_M, FALSE_FIX_OF_HEIGHT * height_m)


# -- what is measured on ---------------------------------------------------------------------------------


def build_sites(one: RecordedSet, scratch: Path) -> list[Site]:
    """A set's maps built into packs below ``scratch``: one of a flight, one of each sample."""
    if one.dop is not None and one.dsm is not None:
        pack = build_pack(one.dop, one.dsm, scratch / one.name, PackOptions(quality=85, vertical="unknown"))
        return [Site(one.name, one.place, one.folder, pack.path)]
    sites = []
    for path in sample_paths(one.folder):
        folder = scratch / f"{one.name} {path.stem}"
        folder.mkdir()
        sites.append(Site(one.name, one.place, path, build_sample_pack(read_sample(path), folder).path))
    return sites


@contextmanager
def opened(site: Site, query_px: int | None) -> Iterator[Scene]:
    """A site with its frames decoded.

    Args:
        query_px: long side that larger frames are averaged down to; None: as they are.
    Raises: DatasetError, CameraError or MapError.
    """
    with MapStore(Pack.open(site.pack)) as store:
        views = _flight_views(site, store, query_px) if site.is_flight else [_sample_view(site, store, query_px)]
        yield Scene(site, store, views)


def _flight_views(site: Site, store: MapStore, query_px: int | None) -> list[View]:
    lasting = _lasting_shares(site.source)
    views = []
    for record in sequence.read_flight(site.source):
        frame = _decoded(record, record.image(), query_px)
        views.append(View(frame, _height(store, frame), lasting_share=lasting.get(record.name)))
    return views


def _sample_view(site: Site, store: MapStore, query_px: int | None) -> View:
    sample = read_sample(site.source)
    pose = sample.map_from_camera
    record = sequence.RecordedFrame(
        sample.name, site.source, 0, sample.camera, pose, sequence.attitude_of(pose, convergence_rad=0.0)
    )
    frame = _decoded(record, sample.image, query_px)
    return View(frame, _height(store, frame), region=sample.grid.bounds)


def _decoded(record: sequence.RecordedFrame, image: ImageArray, query_px: int | None) -> DecodedFrame:
    camera, long_px = record.camera, max(record.camera.width, record.camera.height)
    if query_px is not None and query_px < long_px:
        camera = camera.resized(round(camera.width * query_px / long_px), round(camera.height * query_px / long_px))
        resized = cv2.resize(image, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
        image = np.asarray(resized, dtype=np.uint8)
    return DecodedFrame(
        record.name, record.path, record.stamp_ns, camera, record.map_from_camera, record.ned_from_body, image
    )


def _height(store: MapStore, frame: DecodedFrame) -> float:
    position = frame.map_from_camera.translation
    return float(position[2]) - true_ground(store, position[:2])


def _lasting_shares(folder: Path) -> dict[str, float]:
    """By frame's name, of flights whose table has a column ``lasting_share``."""
    (table,) = folder.glob("*_flight.csv")
    with table.open(newline="", encoding="utf-8") as lines:
        rows = [row for row in csv.DictReader(lines) if row.get("filename") and row.get("lasting_share")]
    try:
        return {Path(row["filename"]).stem: float(row["lasting_share"]) for row in rows}
    except ValueError as err:
        raise DatasetError(f"{table}: column lasting_share holds what is no number ({err})") from err


# -- measuring -------------------------------------------------------------------------------------------


def track(scene: Scene, matcher: AnyMatcher, seeds: int) -> Iterator[Take]:
    """The flight by odometer prior, once per seed from 0 on."""
    frames: list[sequence.RecordedFrame] = [view.frame for view in scene.views]
    for seed in range(seeds):
        flown = run_flight(frames, scene.store, matcher, LocalizerOptions(), PriorKind.ODOMETER, PriorNoise(), seed)
        for index, (view, result) in enumerate(zip(scene.views, flown, strict=True)):
            yield Take(scene, view, result, seed, is_first=index == 0)


def random_priors(scene: Scene, matcher: AnyMatcher, draws: int, seed: int) -> Iterator[Take]:
    """Every frame with ``draws`` priors of `RANDOM_NOISE`, draw after draw in the flight's order."""
    with localizers(scene.store, matcher, LocalizerOptions()) as localizer_for:
        for draw in range(draws):
            for index, view in enumerate(scene.views):
                prior = drawn_prior(scene, index, draw, seed)
                yield localized(scene, view, localizer_for(view.frame.camera), prior, draw, is_first=draw == index == 0)


def beside_the_paper(
    scene: Scene, theirs: Sequence[AnyMatcher], ours: AnyMatcher, seed: int
) -> Iterator[tuple[list[Take], Take]]:
    """Every frame by the paper's pipeline (a region, four rotations, AdHoP, PnP, no gate) with each of ``theirs``, and
    by ``ours`` with a random prior, in turn."""
    with ExitStack() as stack:
        papers = [stack.enter_context(localizers(scene.store, matcher, PAPER_OPTIONS)) for matcher in theirs]
        localizer_for = stack.enter_context(localizers(scene.store, ours, LocalizerOptions()))
        for index, view in enumerate(scene.views):
            region = RegionPrior(view.region or _region(scene, index, seed))
            camera, first = view.frame.camera, index == 0
            yield (
                [localized(scene, view, paper_for(camera), region, 0, is_first=first) for paper_for in papers],
                localized(scene, view, localizer_for(camera), drawn_prior(scene, index, 0, seed), 0, is_first=first),
            )


def drawn_prior(scene: Scene, index: int, draw: int, seed: int) -> PosePrior:
    """The truth of a scene's frame with `RANDOM_NOISE`."""
    view = scene.views[index]
    random = generator(scene.site, index, draw, seed)
    return noisy_prior(view.frame.map_from_camera, view.height_m, RANDOM_NOISE, random)


def generator(site: Site, *numbers: int) -> np.random.Generator:
    """Depends on the site's name and the numbers, not on what else is measured."""
    return np.random.default_rng([zlib.crc32(f"{site.name} {site.source.name}".encode()), *numbers])


def localized(
    scene: Scene, view: View, localizer: Localizer, prior: PosePrior | RegionPrior, draw: int, *, is_first: bool
) -> Take:
    """One frame from one prior, timed."""
    frame, truth = view.frame, view.frame.map_from_camera
    timer = Timer()
    outcome = localizer.localize(Frame(frame.stamp_ns, frame.picture, frame.name), prior)
    spent_ms = timer.spent_ms()
    predicted = prior if isinstance(prior, PosePrior) else None
    error = outcome_error(outcome, truth)
    return Take(
        scene,
        view,
        FrameResult(
            frame.name, frame.stamp_ns, frame.picture, frame.camera, truth, predicted, outcome, error, *spent_ms
        ),
        draw,
        is_first,
    )


def _region(scene: Scene, index: int, seed: int) -> Bounds:
    view = scene.views[index]
    truth = view.frame.map_from_camera
    ground_m = float(truth.translation[2]) - view.height_m
    return paper_region(view.frame.camera, truth, ground_m, generator(scene.site, index, seed))


# -- figures ---------------------------------------------------------------------------------------------


class Figures(Struct, frozen=True, kw_only=True):
    """What a part came to on a set.

    ``recall`` and ``false_fixes`` are over all frames, errors and NEES over the fixes, times over all frames but the
    first of each run, which pays for what is set up once. ``nees_per_dof`` is 1 if the covariance is honest;
    ``unprotected`` counts the fixes beyond their own protection level.
    """

    part: str
    name: str
    matcher: str
    query_px: int
    frames: int
    fixes: int
    rejected: dict[str, int]
    recall: dict[str, float]
    te_m: metrics.Spread
    re_deg: metrics.Spread
    false_fixes: int
    nees: metrics.Nees
    nees_per_dof: float | None
    unprotected: int
    cpu_ms: metrics.Spread
    wall_ms: metrics.Spread
    wall_p99_over_median: float | None


class Target(Struct, frozen=True, kw_only=True):
    """A limit of issue 4. ``measured`` is None where nothing was."""

    what: str
    limit: str
    measured: float | None
    met: bool


def figures(part: str, name: str, matcher: str, takes: Sequence[Take]) -> Figures:
    """Of one or several runs."""
    results = [take.result for take in takes]
    errors = [r.error for r in results if r.error is not None]
    timed = [take.result for take in takes if not take.is_first]
    nees, wall = metrics.nees(errors), metrics.Spread.of([r.wall_ms for r in timed])
    return Figures(
        part=part,
        name=name,
        matcher=matcher,
        query_px=max((max(r.camera.width, r.camera.height) for r in results), default=0),
        frames=len(results),
        fixes=len(errors),
        rejected=metrics.rejections([r.outcome for r in results]),
        recall=metrics.recall(errors, len(results), RECALL_LIMITS),
        te_m=metrics.Spread.of([e.te_m for e in errors]),
        re_deg=metrics.Spread.of([e.re_deg for e in errors]),
        false_fixes=sum(take.is_false for take in takes),
        nees=nees,
        nees_per_dof=None if nees.mean is None else nees.mean / nees.dof,
        unprotected=sum(e.unprotected for e in errors),
        cpu_ms=metrics.Spread.of([r.cpu_ms for r in timed]),
        wall_ms=wall,
        wall_p99_over_median=wall.p99 / wall.median if wall.p99 is not None and wall.median else None,
    )


def lasting(takes: Sequence[Take]) -> list[Take]:
    """Those of frames that show something lasting."""
    return [take for take in takes if (take.view.lasting_share or 0.0) >= LASTING_SHARE]


class Comparison(Struct, frozen=True, kw_only=True):
    """The paper's pipeline with a matcher, and ours, on the same frames.

    Attributes:
        frames, both: all, and those to which both gave a pose.
        te_ratio: of their median error to ours, over ``both``.
        cpu_ratio: of their median CPU time to ours, over all but the first of each run.
    """

    theirs: str
    ours: str
    frames: int
    both: int
    te_ratio: float | None
    cpu_ratio: float | None


def compared(theirs: Sequence[Take], ours: Sequence[Take], matchers: tuple[str, str]) -> Comparison:
    """Frame by frame."""
    both = [
        (a.result.error.te_m, b.result.error.te_m)
        for a, b in zip(theirs, ours, strict=True)
        if a.result.error is not None and b.result.error is not None
    ]
    te = np.median(both, axis=0) if both else None
    times = [(a.result.cpu_ms, b.result.cpu_ms) for a, b in zip(theirs, ours, strict=True) if not b.is_first]
    cpu = np.median(times, axis=0) if times else None
    return Comparison(
        theirs=matchers[0],
        ours=matchers[1],
        frames=len(ours),
        both=len(both),
        te_ratio=None if te is None else float(te[0] / te[1]),
        cpu_ratio=None if cpu is None else float(cpu[0] / cpu[1]),
    )


# -- the limits of issue 4 -------------------------------------------------------------------------------

# Recall 1m-1° by the kind of ``ortholoc_sim.crossdomain``, which its folder is named after.
_CROSSDOMAIN_RECALL: Final = {"xdop": 0.90, "xdopdsm": 0.75}
_QUERY_PX = 512


def targets(found: Figures) -> list[Target]:
    """Those that a part's figures have to meet."""
    recall, is_small = found.recall["1m_1deg"], found.query_px == _QUERY_PX
    wanted: list[Target] = []
    if found.part in ("tracking", "random"):
        wanted += [
            _recall("recall 1m-1°", recall, 1.0),
            Target(
                what="NEES mean / dof",
                limit="0.7 to 1.5",
                measured=found.nees_per_dof,
                met=found.nees_per_dof is not None and 0.7 <= found.nees_per_dof <= 1.5,
            ),
            at_most("p99 / median of the wall time", found.wall_p99_over_median, 2.0),
        ]
    if found.part == "tracking" and is_small:
        wanted.append(at_most("CPU per tracked frame, median ms", found.cpu_ms.median, 45.0))
        wanted.append(at_most("wall per tracked frame, median ms", found.wall_ms.median, 35.0))
    if found.part == "random":
        wanted.append(at_least("priors", found.frames, 500))
        wanted.append(_recall("recall 0.5m-0.5°", found.recall["0.5m_0.5deg"], 0.97))
        wanted.append(at_most("median TE, m", found.te_m.median, 0.12))
        if is_small and found.matcher == "xfeat":
            wanted.append(at_most("CPU per acquisition frame, median ms", found.cpu_ms.median, 110.0))
    if found.part == "crossdomain" and found.name.split()[0] in _CROSSDOMAIN_RECALL:
        least = _CROSSDOMAIN_RECALL[found.name.split()[0]]
        wanted.append(_recall("recall 1m-1°", recall, least))
    wanted.append(at_most("false fixes", found.false_fixes, 0))
    return wanted


def at_least(what: str, measured: float, limit: float) -> Target:
    return Target(what=what, limit=f"≥ {limit:g}", measured=measured, met=measured >= limit)


def _recall(what: str, measured: float, least: float) -> Target:
    return Target(what=what, limit=f"≥ {100 * least:g} %", measured=100 * measured, met=measured >= least)


def at_most(what: str, measured: float | None, limit: float) -> Target:
    return Target(what=what, limit=f"≤ {limit:g}", measured=measured, met=measured is not None and measured <= limit)
