"""Single cases of a benchmark as pictures: the best, the median and the worst of a matcher, and where AdHoP helped and
harmed most."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np

from ortholoc_edge.bench import metrics
from ortholoc_edge.bench.campaign import Job, Piece, checked_matcher, one_thread
from ortholoc_edge.bench.condition import USUAL
from ortholoc_edge.bench.draw import ESTIMATE, TRUTH, at, captioned
from ortholoc_edge.bench.evaluation import sample_error
from ortholoc_edge.bench.ground_truth import true_map_px
from ortholoc_edge.bench.paper import Attempt, Result, Task, Trial
from ortholoc_edge.bench.samples import Sample, read_sample
from ortholoc_edge.geometry.arrays import FloatArray, ImageArray
from ortholoc_edge.geometry.camera import Camera
from ortholoc_edge.geometry.rigid import Rigid3

_HEIGHT_PX = 480
_GAP_PX = 8
_PAPER = 20
_MOST_LINES, _MOST_DOTS = 80, 400
# Pixels of the orthophoto within which a match counts as right, for its colour.
_RIGHT_PX = 10.0
_RIGHT, _WRONG, _UNKNOWN = (40, 220, 60), (255, 60, 60), (160, 160, 160)


@dataclass(frozen=True, slots=True)
class Case:
    """One to look at.

    Attributes:
        title: what it is an example of.
        adhop: its setting; None: both, the first round above the second.
    """

    title: str
    job: Job
    adhop: bool | None


def choose(pieces: Iterable[Piece], jobs: Iterable[Job], task: Task) -> list[Case]:
    """Of each matcher, under the usual condition, by position error."""
    job_of = {(job.sample, job.matcher.name): job for job in jobs}
    by_matcher: dict[str, list[tuple[Piece, dict[bool, Result]]]] = defaultdict(list)
    for piece in pieces:
        by_setting = {r.adhop: r for r in piece.results if r.task == task and r.condition == USUAL}
        if by_setting:
            by_matcher[piece.matcher].append((piece, by_setting))
    cases: list[Case] = []
    for matcher, found in by_matcher.items():
        adhop = any(True in results for _, results in found)
        ranked = sorted(
            ((p, r[adhop]) for p, r in found if adhop in r), key=lambda one: (one[1].error.te_m, one[0].sample)
        )
        places = {"best": 0, "median": len(ranked) // 2, "worst": len(ranked) - 1}
        chosen = {ranked[at][0].sample: what for what, at in reversed(places.items())}
        for sample, what in reversed(chosen.items()):
            cases.append(Case(f"{matcher}: {what}", job_of[sample, matcher], adhop))
        changed = sorted((_gain(r), p.sample) for p, r in found if len(r) == 2 and r[True].adhop_accepted)
        if changed and changed[-1][0] > 0:
            cases.append(Case(f"{matcher}: AdHoP helps most", job_of[changed[-1][1], matcher], None))
        if changed and changed[0][0] < 0:
            cases.append(Case(f"{matcher}: AdHoP harms most", job_of[changed[0][1], matcher], None))
    return cases


def _gain(by_setting: dict[bool, Result]) -> float:
    """Logarithm of how many times smaller AdHoP makes the position error."""
    before, after = (min(max(by_setting[k].error.te_m, 1e-3), 1e4) for k in (False, True))
    return math.log(before / after)


def drawn(case: Case, task: Task) -> ImageArray:
    """RGB picture of a case, which is matched anew.

    Raises: OrtholocError for a sample that can't be read any more.
    """
    one_thread()
    sample = read_sample(case.job.path_of_sample)
    trial = Trial(sample, checked_matcher(case.job.matcher), USUAL, case.job.options, case.adhop is not False)
    answer = trial.answer(task)
    if case.adhop is None and answer.second is not None:
        rounds = [("first round", answer.first), ("AdHoP's round", answer.second)]
    else:
        rounds = [("", answer.taken(bool(case.adhop)))]
    return np.vstack([match_picture(sample, attempt, f"{case.title} {what}".strip()) for what, attempt in rounds])


def match_picture(sample: Sample, attempt: Attempt, what: str) -> ImageArray:
    """RGB: matches between photo and orthophoto, right ones green, wrong ones red, grey where the truth is unknown; in
    the photo the sample's keypoints as the truth (green) and the estimate (red) show them."""
    matches = attempt.round.matches
    scale_photo, scale_map = _HEIGHT_PX / sample.image.shape[0], _HEIGHT_PX / sample.dop.shape[0]
    photo, dop = _sized(sample.image, scale_photo), _sized(sample.dop, scale_map)
    gap = np.full((_HEIGHT_PX, _GAP_PX, 3), _PAPER, np.uint8)
    canvas = np.ascontiguousarray(np.hstack([photo, gap, dop]))
    error_px = np.linalg.norm(matches.map_px - true_map_px(sample, matches.query_px), axis=1)
    # Spread over all of them: they come in order of strength.
    every = np.unique(np.linspace(0, max(len(matches) - 1, 0), min(len(matches), _MOST_LINES)).astype(int))
    for k in every if len(matches) else ():
        colour = _UNKNOWN if not np.isfinite(error_px[k]) else _RIGHT if error_px[k] <= _RIGHT_PX else _WRONG
        a = matches.query_px[k] * scale_photo
        b = matches.map_px[k] * scale_map + (photo.shape[1] + _GAP_PX, 0)
        cv2.line(canvas, at(a), at(b), colour, 1, cv2.LINE_AA)
        for end in (a, b):
            cv2.circle(canvas, at(end), 3, colour, 1, cv2.LINE_AA)
    error = sample_error(sample, matches, attempt.estimate)
    keypoints = np.zeros((0, 3)) if sample.keypoints is None else sample.keypoints
    keypoints = keypoints[:: max(1, len(keypoints) // _MOST_DOTS)]
    reprojected = photo.copy()
    _dots(reprojected, sample.camera, sample.map_from_camera, keypoints, scale_photo, TRUTH, 3)
    if attempt.estimate is not None:
        pose = attempt.estimate.local_from_camera
        _dots(reprojected, attempt.estimate.camera, pose, keypoints, scale_photo, ESTIMATE, 2)
    known = error_px[np.isfinite(error_px)]
    right = int(np.count_nonzero(known <= _RIGHT_PX))
    return captioned(
        np.hstack([canvas, gap, reprojected]), f"{what}: {sample.name}, {right} of {len(matches)} matches within "
        f"{_RIGHT_PX:g} px, {_told(error)}"
    )  # fmt: skip


def _told(error: metrics.SampleError) -> str:
    if not math.isfinite(error.te_m):
        return "no pose"
    focal = "" if error.rfe is None else f", RFE {100 * error.rfe:.1f} %"
    return f"TE {error.te_m:.2f} m, RE {error.re_deg:.2f} deg{focal}"


def _sized(image: ImageArray, scale: float) -> ImageArray:
    size = round(image.shape[1] * scale), _HEIGHT_PX
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def _dots(
    canvas: ImageArray,
    camera: Camera,
    map_from_camera: Rigid3,
    points: FloatArray,
    scale: float,
    colour: tuple[int, int, int],
    radius: int,
) -> None:
    px = camera.project(map_from_camera.inverse().apply(points)) * scale
    for point in px[np.isfinite(px).all(axis=1)]:
        cv2.circle(canvas, at(point), radius, colour, 1, cv2.LINE_AA)
