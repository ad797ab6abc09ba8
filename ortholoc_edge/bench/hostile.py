"""Frames that must not give a fix: what a camera sees elsewhere, or nothing at all, and priors that are badly wrong.

A trial is a number: its kind, frame and noise follow from the number and the seed, so that one false fix among ten
thousand frames can be looked at again alone.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass, replace
from enum import StrEnum
from multiprocessing import get_context
from types import TracebackType
from typing import Final

import cv2
import numpy as np
from msgspec import Struct, structs

from ortholoc_edge.bench.core import RANDOM_NOISE, Scene, Site, Target, View, at_least, at_most, is_false_fix, opened
from ortholoc_edge.bench.metrics import PoseError
from ortholoc_edge.bench.replay import noisy_prior, outcome_error
from ortholoc_edge.bench.runner import localizers
from ortholoc_edge.errors import DatasetError
from ortholoc_edge.geometry import rotation
from ortholoc_edge.geometry.arrays import ImageArray
from ortholoc_edge.geometry.camera import Camera
from ortholoc_edge.geometry.rigid import Rigid3
from ortholoc_edge.matching.registry import make_method
from ortholoc_edge.pipeline.frame import Frame
from ortholoc_edge.pipeline.localizer import LocalizerOptions
from ortholoc_edge.pipeline.outcome import Fix, Outcome
from ortholoc_edge.pipeline.prior import PosePrior

_MOVED_M = (50.0, 100.0)
# Of the picture's width: no edge of it is left.
_BLUR = 0.04
_WAVES = 40


class Kind(StrEnum):
    """What is wrong with a frame.

    ELSEWHERE: another place of the same flight. OUTSIDE: a place that the map does not show. MIRRORED: left is right.
    HEADING_180, HEADING_60: the prior's heading is so far off. HEIGHT: the prior's height above ground is half or twice
    the true one. WATER, EVEN, NOISE, BLACK: pictures of no place. BLURRED: the true place, with nothing to be seen in
    it. STALE: the map is of another epoch and the prior 50 to 100 m off.
    In all of them the prior claims the errors of `core.RANDOM_NOISE`.
    """

    ELSEWHERE = "elsewhere"
    OUTSIDE = "outside"
    MIRRORED = "mirrored"
    HEADING_180 = "heading-180"
    HEADING_60 = "heading-60"
    HEIGHT = "height-x2"
    WATER = "water"
    EVEN = "even"
    NOISE = "noise"
    BLURRED = "blurred"
    BLACK = "black"
    STALE = "stale"


class Verdict(Struct, frozen=True, kw_only=True):
    """What one matcher made of one trial.

    Attributes:
        number, kind, name, frame: the trial; ``name`` is the set's whose map was looked at.
        shown: what picture was shown, where it is not the frame.
        outcome: ``false``, ``right`` for a fix that is near the truth all the same, or the reason of a rejection.
        te_m, re_deg: against the truth, where the picture has one and there is a fix.
        inliers, matches, rms_px: of a fix.
    """

    number: int
    kind: Kind
    name: str
    frame: str
    shown: str
    matcher: str
    outcome: str
    te_m: float | None = None
    re_deg: float | None = None
    inliers: int | None = None
    matches: int | None = None
    rms_px: float | None = None


FALSE, RIGHT = "false", "right"
_WRONG_PRIORS: Final = (Kind.HEADING_180, Kind.HEADING_60, Kind.HEIGHT, Kind.STALE)


@dataclass(frozen=True, slots=True, eq=False)
class _Staged:
    """A trial ready to be shown. ``truth``: the view whose pose the picture has, in the map's frame; None: nowhere."""

    scene: Scene
    frame: str
    shown: str
    image: ImageArray
    camera: Camera
    prior: PosePrior
    truth: View | None


@dataclass(frozen=True, slots=True)
class Matching:
    """What `make_method` is asked for in each process."""

    names: tuple[str, ...]
    working_px: int = 640
    max_keypoints: int = 4096


class HostileBench:
    """Trials on sites, in this process. A context manager.

    Args:
        sites: what the map shows is what the photos show.
        stale: sites whose photos are of another epoch than their map, for Kind.STALE alone.
    Raises: DatasetError without a frame in ``sites``.
    """

    def __init__(
        self, sites: Sequence[Site], stale: Sequence[Site], matching: Matching, seed: int, query_px: int | None
    ) -> None:
        self._seed = seed
        self._stack = ExitStack()
        try:
            self._scenes = [self._stack.enter_context(opened(site, query_px)) for site in sites]
            self._stale = [self._stack.enter_context(opened(site, query_px)) for site in stale]
            if not any(scene.views for scene in self._scenes):
                raise DatasetError("no frame to make hostile ones of")
            self._methods = [
                make_method(name, working_px=matching.working_px, max_keypoints=matching.max_keypoints, threads=1)
                for name in matching.names
            ]
            self._localizers = {
                (method.name, scene.site): self._stack.enter_context(
                    localizers(scene.store, method, LocalizerOptions())
                )
                for method in self._methods
                for scene in (*self._scenes, *self._stale)
            }
        except BaseException:
            self._stack.close()
            raise
        self._frames = _kinds(self._scenes, self._stale)

    def __enter__(self) -> HostileBench:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.close()

    def trial(self, number: int) -> list[Verdict]:
        """The verdict of each matcher on one trial."""
        kinds = list(self._frames)
        kind = kinds[number % len(kinds)]
        random = np.random.default_rng([self._seed, number])
        candidates = self._frames[kind]
        scene, view = candidates[random.integers(len(candidates))]
        staged = self._staged(kind, scene, view, random)
        return [self._judged(number, kind, staged, method.name) for method in self._methods]

    def _judged(self, number: int, kind: Kind, staged: _Staged, matcher: str) -> Verdict:
        localizer = self._localizers[matcher, staged.scene.site](staged.camera)
        outcome = localizer.localize(Frame(0, staged.image, staged.frame), staged.prior)
        truth = staged.truth
        error = None if truth is None else outcome_error(outcome, truth.frame.map_from_camera)
        verdict = Verdict(
            number=number,
            kind=kind,
            name=staged.scene.site.name,
            frame=staged.frame,
            shown=staged.shown,
            matcher=matcher,
            outcome=_verdict(outcome, error, truth),
        )
        if not isinstance(outcome, Fix):
            return verdict
        return structs.replace(
            verdict,
            te_m=None if error is None else error.te_m,
            re_deg=None if error is None else error.re_deg,
            inliers=outcome.inliers,
            matches=outcome.matches,
            rms_px=outcome.rms_px,
        )

    def _staged(self, kind: Kind, scene: Scene, view: View, random: np.random.Generator) -> _Staged:
        frame = view.frame
        prior = noisy_prior(frame.map_from_camera, view.height_m, RANDOM_NOISE, random)
        staged = _Staged(scene, frame.name, "", frame.picture, frame.camera, prior, view)
        if kind is Kind.ELSEWHERE:
            return _showing(staged, scene, _other(scene.views, view, random))
        if kind is Kind.OUTSIDE:
            others = [s for s in self._scenes if s.site.place != scene.site.place]
            pairs = [(other, shown) for other in others for shown in other.views]
            return replace(_showing(staged, *pairs[random.integers(len(pairs))]), truth=None)
        if kind in _WRONG_PRIORS:
            return replace(staged, prior=_wrong_prior(kind, prior, view.height_m, random))
        if kind is Kind.BLURRED:
            return replace(staged, image=_blurred(frame.picture))
        if kind is Kind.MIRRORED:
            camera = replace(frame.camera, cx=frame.camera.width - 1 - frame.camera.cx)
            return replace(staged, image=np.ascontiguousarray(frame.picture[:, ::-1]), camera=camera, truth=None)
        return replace(staged, image=_picture_of(kind, frame.picture.shape, random), truth=None)


def targets(frames: int, false: int) -> list[Target]:
    """Those of issue 4."""
    return [at_least("hostile frames", frames, 10_000), at_most("false fixes", false, 0)]


def run_trials(
    numbers: Sequence[int],
    sites: Sequence[Site],
    stale: Sequence[Site],
    matching: Matching,
    *,
    seed: int,
    query_px: int | None,
    workers: int,
) -> Iterator[Verdict]:
    """The verdicts on trials, in their order, whatever the number of processes."""
    if workers == 1:
        with HostileBench(sites, stale, matching, seed, query_px) as bench:
            for number in numbers:
                yield from bench.trial(number)
        return
    # Spawned: the parent has threads of GDAL and the inference runtime, which don't survive a fork.
    with ProcessPoolExecutor(
        workers, get_context("spawn"), _start_worker, (sites, stale, matching, seed, query_px)
    ) as pool:
        for verdicts in pool.map(_in_worker, numbers, chunksize=8):
            yield from verdicts


_bench: HostileBench | None = None


def _start_worker(
    sites: Sequence[Site], stale: Sequence[Site], matching: Matching, seed: int, query_px: int | None
) -> None:
    global _bench  # noqa: PLW0603 - a pool's worker has no other place for what its tasks share
    cv2.setNumThreads(1)
    _bench = HostileBench(sites, stale, matching, seed, query_px)


def _in_worker(number: int) -> list[Verdict]:
    assert _bench is not None, "the pool's initializer makes it"
    return _bench.trial(number)


def _verdict(outcome: Outcome, error: PoseError | None, truth: View | None) -> str:
    if not isinstance(outcome, Fix):
        return str(outcome.reason)
    if error is None or truth is None:
        return FALSE
    return FALSE if is_false_fix(error, truth.height_m) else RIGHT


def _kinds(scenes: Sequence[Scene], stale: Sequence[Scene]) -> Mapping[Kind, list[tuple[Scene, View]]]:
    """Frames that each kind can be made of; kinds that can be made of none are left out."""
    every = [(scene, view) for scene in scenes for view in scene.views]
    found: dict[Kind, list[tuple[Scene, View]]] = dict.fromkeys(Kind, every)
    found[Kind.ELSEWHERE] = [(scene, view) for scene, view in every if len(scene.views) > 1]
    found[Kind.OUTSIDE] = every if len({scene.site.place for scene in scenes}) > 1 else []
    found[Kind.STALE] = [(scene, view) for scene in stale for view in scene.views]
    return {kind: frames for kind, frames in found.items() if frames}


def _showing(staged: _Staged, scene: Scene, shown: View) -> _Staged:
    frame = shown.frame
    name = f"{scene.site.name}/{frame.name}"
    return replace(staged, shown=name, image=frame.picture, camera=frame.camera, truth=shown)


def _wrong_prior(kind: Kind, prior: PosePrior, height_m: float, random: np.random.Generator) -> PosePrior:
    if kind is Kind.HEADING_180:
        return _turned(prior, 180.0)
    if kind is Kind.HEADING_60:
        return _turned(prior, 60.0 * random.choice([-1.0, 1.0]))
    if kind is Kind.HEIGHT:
        return _moved(prior, (0.0, 0.0, height_m * (random.choice([0.5, 2.0]) - 1.0)))
    away_m, bearing = random.uniform(*_MOVED_M), random.uniform(0.0, 2.0 * np.pi)
    return _moved(prior, (away_m * np.cos(bearing), away_m * np.sin(bearing), 0.0))


def _other(views: Sequence[View], view: View, random: np.random.Generator) -> View:
    """Another view, of those half as far away as the farthest, so that it shows little or nothing of the same."""
    here = view.frame.map_from_camera.translation[:2]
    away = np.array([np.linalg.norm(v.frame.map_from_camera.translation[:2] - here) for v in views])
    return views[int(random.choice(np.flatnonzero(away >= 0.5 * away.max())))]


def _turned(prior: PosePrior, turn_deg: float) -> PosePrior:
    pose = prior.map_from_camera
    turn = rotation.exp([0.0, 0.0, np.radians(turn_deg)])
    covariance = prior.covariance.copy()
    # What is said of the axes below nose and wing turns with them.
    covariance[3:, 3:] = turn @ covariance[3:, 3:] @ turn.T
    return PosePrior(Rigid3(turn @ pose.rotation, pose.translation), covariance)


def _moved(prior: PosePrior, step_m: tuple[float, float, float]) -> PosePrior:
    pose = prior.map_from_camera
    return replace(prior, map_from_camera=Rigid3(pose.rotation, pose.translation + step_m))


def _blurred(picture: ImageArray) -> ImageArray:
    return np.asarray(cv2.GaussianBlur(picture, (0, 0), _BLUR * picture.shape[1]), dtype=np.uint8)


_SEA: Final = (52, 84, 92)


def _picture_of(kind: Kind, shape: tuple[int, ...], random: np.random.Generator) -> ImageArray:
    """(H, W, 3) RGB of water, one tone, noise or nothing."""
    height, width = shape[:2]
    if kind is Kind.BLACK:
        return np.zeros((height, width, 3), np.uint8)
    if kind is Kind.EVEN:
        return np.full((height, width, 3), random.integers(20, 236, 3), np.uint8)
    if kind is Kind.NOISE:
        return random.integers(0, 256, (height, width, 3), dtype=np.uint8)
    return _water(height, width, random)


def _water(height: int, width: int, random: np.random.Generator) -> ImageArray:
    """Waves about one wind, the longer the higher, under an uneven sky, and the camera's noise."""
    v, u = np.mgrid[:height, :width].astype(np.float32)
    wind = random.uniform(0.0, 2.0 * np.pi)
    surface = np.zeros((height, width), np.float32)
    for _ in range(_WAVES):
        long_px = np.exp(random.uniform(np.log(8.0), np.log(0.25 * width)))
        bearing = wind + random.normal(scale=0.5)
        phase = (np.cos(bearing) * u + np.sin(bearing) * v) * (2.0 * np.pi / long_px) + random.uniform(0.0, 2.0 * np.pi)
        surface += np.float32(long_px**0.5) * np.sin(phase.astype(np.float32))
    surface *= 14.0 / float(surface.std())
    sky = 25.0 * (np.cos(wind) * u + np.sin(wind) * v) / max(height, width)
    noise = random.normal(scale=2.0, size=(height, width, 3))
    picture = np.asarray(_SEA) + (surface + sky)[..., None] + noise
    return np.asarray(np.clip(picture, 0, 255), dtype=np.uint8)
