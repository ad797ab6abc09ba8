"""The paper's pipeline on one sample: no prior, the whole map, a pose from whatever was found.

What flies (`pipeline.localizer`) knows more and refuses more; this compares matchers as the paper does. Paper, sections
"Initial Camera Calibration / Localization" and "AdHoP Refinement".
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import StrEnum

import cv2
import numpy as np
from msgspec import Struct

from ortholoc_edge.bench.condition import Condition, query_image, with_map
from ortholoc_edge.bench.evaluation import calibrate_focal, localize, sample_error
from ortholoc_edge.bench.ground_truth import GroundTruthMatcher
from ortholoc_edge.bench.metrics import SampleError
from ortholoc_edge.bench.replay import Timer
from ortholoc_edge.bench.samples import Sample
from ortholoc_edge.geometry.arrays import FloatArray
from ortholoc_edge.geometry.grid import resize_px
from ortholoc_edge.matching.adhop import fit_homography
from ortholoc_edge.matching.types import Matcher, Matches
from ortholoc_edge.pipeline import precondition
from ortholoc_edge.pipeline.precondition import ReferenceView
from ortholoc_edge.pose import pnp
from ortholoc_edge.pose.pnp import PoseEstimate
from ortholoc_edge.tiles.window import MapWindow


class Task(StrEnum):
    """What is solved for: the pose with known intrinsics, or the focal length too."""

    LOCALIZE = "localize"
    CALIBRATE = "calibrate"


class PaperOptions(Struct, frozen=True, kw_only=True):
    """
    Attributes:
        turns: the map is shown in so many quarter turns, and the one with the most matches counts.
        homography_threshold_px: of AdHoP's RANSAC, at 1024 px.
        seed: of the pose's RANSAC and of what a condition draws.
    """

    turns: int = 4
    homography_threshold_px: float = 5.0
    seed: int = 0


class Result(Struct, frozen=True, kw_only=True):
    """One sample under one condition, one task, with or without AdHoP.

    Attributes:
        me_px, te_m, re_deg, rpe_px: see `SampleError`; None where infinite.
        rfe: of the focal length; None where there is none, or it was given.
        matches: that were used, of ``found`` whatever their confidence.
        inliers: of the pose; 0 without one.
        adhop_accepted: whether the second round's matches are used; None where there was to be none.
        calibrated: whether `calibrate-focal` would call it so; None where the focal length was given.
        cpu_s, wall_s: of matching and solving; reading is not counted.
    """

    condition: Condition
    task: Task
    adhop: bool
    me_px: float | None
    te_m: float | None
    re_deg: float | None
    rpe_px: float | None
    rfe: float | None
    matches: int
    found: int
    inliers: int
    adhop_accepted: bool | None
    calibrated: bool | None
    cpu_s: float
    wall_s: float

    @property
    def error(self) -> SampleError:
        stored = (self.me_px, self.te_m, self.re_deg, self.rpe_px, self.rfe)
        me_px, te_m, re_deg, rpe_px, rfe = (math.inf if value is None else value for value in stored)
        return SampleError(me_px, te_m, re_deg, rpe_px, None if self.task is Task.LOCALIZE else rfe)


@dataclass(frozen=True, slots=True, eq=False)
class Round:
    """Matches of the photo with pixels of the sample's own map, those of enough confidence, of ``found``.

    Attributes:
        spent_ms: (2,) CPU and wall time.
    """

    matches: Matches
    found: int
    spent_ms: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Attempt:
    """A round and what it gave.

    Attributes:
        mean_error_px: of all its matches' reprojection errors, each cut at the image's diagonal; infinite without a
            pose.
        calibrated: see `Result`.
        spent_ms: (2,) CPU and wall time, of the round too.
    """

    round: Round
    estimate: PoseEstimate | None
    mean_error_px: float
    calibrated: bool | None
    spent_ms: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Answer:
    """What a task came to; ``second`` is AdHoP's, None where there was none."""

    first: Attempt
    second: Attempt | None

    @property
    def accepted(self) -> bool:
        """Whether AdHoP is better by what can be known in flight."""
        return self.second is not None and self.second.mean_error_px < self.first.mean_error_px

    def taken(self, adhop: bool) -> Attempt:
        return self.second if adhop and self.accepted and self.second is not None else self.first

    def spent_ms(self, adhop: bool) -> FloatArray:
        return self.first.spent_ms + (self.second.spent_ms if adhop and self.second is not None else 0.0)


class Trial:
    """A sample under a condition, matched once for all tasks."""

    def __init__(
        self,
        sample: Sample,
        matcher: Matcher | GroundTruthMatcher,
        condition: Condition,
        options: PaperOptions,
        adhop: bool,
    ) -> None:
        """
        Args:
            adhop: match a second time; the truth, which needs no pictures, never is.
        Raises: DatasetError for a sample without the truth that a condition or a matcher needs; ModelError if the
            matcher itself fails.
        """
        self._sample, self._condition, self._options = sample, condition, options
        self._given = with_map(sample, condition, options.seed)
        self._second: Round | None = None
        if isinstance(matcher, GroundTruthMatcher):
            timer = Timer()
            self._first = self._round(matcher.match(self._given), (1.0, 1.0), timer)
        else:
            self._match(matcher, adhop)

    def _match(self, matcher: Matcher, adhop: bool) -> None:
        grey, window = query_image(self._sample, self._condition), _window(self._given)
        height, width = grey.shape
        # Each side was rounded on its own.
        to_photo = self._sample.camera.width / width, self._sample.camera.height / height
        timer = Timer()
        query = matcher.extract(grey)

        def matched(view: ReferenceView) -> Matches:
            return _on_map(matcher.match(query, matcher.extract(view.image, view.valid)), view)

        # Paper: "selecting the output with the largest correspondence set".
        first = max(
            (matched(view) for view in precondition.quarter_turns(window)[: self._options.turns]),
            key=lambda matches: len(self._confident(matches)),
        )
        self._first = self._round(first, to_photo, timer)
        if not adhop:
            return
        timer = Timer()
        used = self._confident(first)
        threshold_px = self._options.homography_threshold_px * max(width, height) / pnp.THRESHOLD_REFERENCE_PX
        fitted = fit_homography(used.map_px, used.query_px, threshold_px)
        if fitted is not None:
            view = precondition.warped(window.dop_grey, window.dop_valid, fitted[0], width, height)
            self._second = self._round(matched(view), to_photo, timer)

    def _confident(self, matches: Matches) -> Matches:
        if matches.confidence is None:
            return matches
        return matches.take(np.flatnonzero(matches.confidence > self._condition.min_confidence))

    def _round(self, matches: Matches, to_photo: tuple[float, float], timer: Timer) -> Round:
        """Of matches of the picture that the matcher got with pixels of the map that it got."""
        used = self._confident(matches)
        on_sample = self._sample.grid.px_from_map(self._given.grid.map_from_px(used.map_px))
        used = Matches(resize_px(used.query_px, to_photo), on_sample, used.confidence)
        return Round(used, len(matches), np.array(timer.spent_ms()))

    def answer(self, task: Task) -> Answer:
        return Answer(
            self._attempt(self._first, task), None if self._second is None else self._attempt(self._second, task)
        )

    def _attempt(self, found: Round, task: Task) -> Attempt:
        timer = Timer()
        sample, seed = self._sample, self._options.seed
        calibrated: bool | None = None
        if task is Task.LOCALIZE:
            estimate = localize(sample, found.matches, seed, self._given)
        else:
            estimate, calibrated = calibrate_focal(sample, found.matches, seed, self._given)
        mean_error_px = math.inf
        if estimate is not None:
            # What is behind the camera has no error in pixels; the image's diagonal stands for it.
            diagonal = math.hypot(sample.camera.width, sample.camera.height)
            mean_error_px = float(np.minimum(estimate.errors_px, diagonal).mean())
        return Attempt(found, estimate, mean_error_px, calibrated, found.spent_ms + np.array(timer.spent_ms()))

    def results(self, tasks: Sequence[Task], adhop: Sequence[bool]) -> Iterator[Result]:
        """Of each task, with and without AdHoP as asked.

        Raises: DatasetError for a sample without point map or keypoints.
        """
        for task in tasks:
            answer = self.answer(task)
            for refined in adhop:
                yield self._result(task, answer, refined)

    def _result(self, task: Task, answer: Answer, adhop: bool) -> Result:
        taken = answer.taken(adhop)
        error = sample_error(self._sample, taken.round.matches, taken.estimate)
        cpu_ms, wall_ms = answer.spent_ms(adhop)
        return Result(
            condition=self._condition,
            task=task,
            adhop=adhop,
            me_px=_finite(error.me_px),
            te_m=_finite(error.te_m),
            re_deg=_finite(error.re_deg),
            rpe_px=_finite(error.rpe_px),
            rfe=None if error.rfe is None else _finite(error.rfe),
            matches=len(taken.round.matches),
            found=taken.round.found,
            inliers=0 if taken.estimate is None else int(np.count_nonzero(taken.estimate.inliers)),
            adhop_accepted=answer.accepted if adhop else None,
            calibrated=taken.calibrated,
            cpu_s=float(cpu_ms) / 1e3,
            wall_s=float(wall_ms) / 1e3,
        )


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _window(sample: Sample) -> MapWindow:
    grey = np.asarray(cv2.cvtColor(np.ascontiguousarray(sample.dop), cv2.COLOR_RGB2GRAY), dtype=np.uint8)
    return MapWindow(grey, np.ones(grey.shape, dtype=bool), sample.grid, sample.dsm, sample.grid)


def _on_map(matches: Matches, view: ReferenceView) -> Matches:
    """Matches with a picture of the map as matches with the map; without those at its horizon."""
    at = view.dop_px(matches.map_px)
    return Matches(matches.query_px, at, matches.confidence).take(np.flatnonzero(np.isfinite(at).all(axis=1)))
