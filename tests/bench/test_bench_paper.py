"""The paper's pipeline on one sample, and what is made worse of it."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from made_samples import made

from ortholoc_edge.bench.condition import USUAL, Condition, query_image, with_map
from ortholoc_edge.bench.ground_truth import GroundTruthMatcher, true_map_px
from ortholoc_edge.bench.paper import PaperOptions, Result, Task, Trial
from ortholoc_edge.bench.samples import Sample
from ortholoc_edge.errors import DatasetError
from ortholoc_edge.geometry.arrays import BoolArray, ImageArray
from ortholoc_edge.matching.sift import SiftMatcher
from ortholoc_edge.matching.types import Features, Matches

OPTIONS = PaperOptions()
BOTH = (False, True)


@pytest.fixture(scope="module")
def sample() -> Sample:
    return made()


def sift() -> SiftMatcher:
    return SiftMatcher(working_px=640, max_keypoints=1000)


def covisible(sample: Sample, given: Sample) -> float:
    """Part of the photo's points on the sample's map that are on another one."""
    assert sample.point_map is not None
    xy = sample.point_map[::4, ::4, :2].reshape(-1, 2).astype(float)

    def on(one: Sample) -> BoolArray:
        px = one.grid.px_from_map(xy)
        return np.asarray(((px > -0.5) & (px < (one.grid.width - 0.5, one.grid.height - 0.5))).all(axis=1))

    return float(on(given).sum() / on(sample).sum())


# -- conditions ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("part", [0.75, 0.5, 0.2, 0.05])
@pytest.mark.parametrize("seed", range(4))
def test_a_cut_map_shows_the_part_that_is_asked_for(sample: Sample, part: float, seed: int) -> None:
    given = with_map(sample, Condition(covisibility=part), seed)
    assert covisible(sample, given) == pytest.approx(part, abs=0.02)
    assert given.dop.shape[:2] == given.dsm.shape == (given.grid.height, given.grid.width)
    # What is left is where it was.
    at = given.grid.map_from_px([[0.0, 0.0]])
    ((u, v),) = np.rint(sample.grid.px_from_map(at)).astype(int)
    assert np.array_equal(sample.dop[v : v + given.grid.height, u : u + given.grid.width], given.dop)


def test_seeds_and_samples_are_cut_on_sides_of_their_own(sample: Sample) -> None:
    half = Condition(covisibility=0.5)
    assert len({with_map(sample, half, seed).grid for seed in range(16)}) == 4
    assert len({with_map(replace(sample, name=f"D01_R{k:04d}"), half, 0).grid for k in range(16)}) == 4


@settings(max_examples=20, deadline=None)
@given(scale=st.floats(0.05, 0.99))
def test_a_coarser_map_covers_the_same_and_keeps_its_heights(sample: Sample, scale: float) -> None:
    given = with_map(sample, Condition(raster_scale=scale), 0)
    assert given.grid.bounds == pytest.approx(sample.grid.bounds)
    assert given.dop.shape[0] == pytest.approx(sample.dop.shape[0] * scale, abs=1.0)
    assert float(np.nanmean(given.dsm)) == pytest.approx(float(np.nanmean(sample.dsm)), abs=0.2)


def test_a_hole_does_not_lower_its_neighbours(sample: Sample) -> None:
    dsm = np.full_like(sample.dsm, 500.0)
    dsm[100:200, 100:200] = np.nan
    found = with_map(replace(sample, dsm=dsm), Condition(raster_scale=0.3), 0).dsm
    assert np.isnan(found).any()
    assert found[np.isfinite(found)] == pytest.approx(500.0, abs=1e-3)


def test_the_usual_condition_changes_nothing(sample: Sample) -> None:
    assert with_map(sample, USUAL, 0) is sample
    assert query_image(sample, USUAL).shape == sample.image.shape[:2]
    assert query_image(sample, Condition(query_scale=0.5)).shape == (120, 160)


# -- the pipeline --------------------------------------------------------------------------------------


def results(sample: Sample, condition: Condition = USUAL, **options: int) -> list[Result]:
    trial = Trial(sample, sift(), condition, PaperOptions(**options), adhop=True)
    return list(trial.results(list(Task), BOTH))


def test_a_photo_of_the_map_is_localized_and_calibrated(sample: Sample) -> None:
    found = results(sample)
    assert [(one.task, one.adhop) for one in found] == [(task, adhop) for task in Task for adhop in BOTH]
    for one in found[:2]:
        assert one.error.te_m < 0.5
        assert one.error.re_deg < 0.3
        assert one.error.me_px < 1.5
        assert one.error.rfe is None
        assert one.calibrated is None
    for one in found[2:]:
        assert one.error.rfe is not None
        assert one.error.rfe < 0.02
    assert found[0].adhop_accepted is None
    assert found[1].adhop_accepted is True
    # The second round looks the way the photo does.
    assert found[1].matches > found[0].matches
    assert found[1].cpu_s > found[0].cpu_s > 0.0


@pytest.mark.parametrize(
    "condition", [Condition(raster_scale=0.5), Condition(query_scale=0.5), Condition(covisibility=0.6)]
)
def test_coordinates_come_back_to_the_whole_photo_and_map(sample: Sample, condition: Condition) -> None:
    """A factor forgotten anywhere would be many pixels and metres."""
    for one in results(sample, condition)[:2]:
        assert one.error.me_px < 3.0
        assert one.error.te_m < 1.0


def test_a_reduced_photo_of_uneven_sides_has_a_scale_for_each(sample: Sample) -> None:
    """320 x 240 at 0.14 is 45 x 34 px: one scale for both put the lowest rows 1.8 px off."""
    condition = Condition(query_scale=0.14)
    height, width = query_image(sample, condition).shape
    assert 320 / width != pytest.approx(240 / height, rel=0.005)

    class Small(Turned):
        """The truth, in the reduced picture's pixels."""

        def match(self, query: Features, reference: Features) -> Matches:
            u, v = np.meshgrid(np.arange(2.0, width - 2), np.arange(2.0, height - 2))
            query_px = np.column_stack([u.ravel(), v.ravel()])
            in_photo = (query_px + 0.5) * (320 / width, 240 / height) - 0.5
            at = true_map_px(self._sample, in_photo)
            known = np.isfinite(at).all(axis=1)
            return Matches(query_px[known], at[known])

    trial = Trial(sample, Small(sample), condition, PaperOptions(turns=1), adhop=False)
    (one,) = trial.results([Task.LOCALIZE], [False])
    assert one.error.me_px < 1e-6
    assert one.error.te_m < 0.01


class Turned:
    """Finds the true place of four corners' neighbourhoods, in the second quarter turn alone."""

    name, model_sha256, working_px = "turned", None, 640

    def __init__(self, sample: Sample) -> None:
        self._sample, self._turn = sample, -1

    def extract(self, image: ImageArray, valid: BoolArray | None = None) -> Features:
        self._turn += valid is not None
        return Features(np.empty((0, 2)), np.empty(0, np.float32), np.empty((0, 1), np.float32))

    def match(self, query: Features, reference: Features) -> Matches:
        u, v = np.meshgrid(np.arange(20.0, 300.0, 9.0), np.arange(20.0, 220.0, 9.0))
        query_px = np.column_stack([u.ravel(), v.ravel()])
        at = true_map_px(self._sample, query_px)
        known = np.isfinite(at).all(axis=1)
        query_px, at = query_px[known], at[known]
        if self._turn != 1:
            some = np.random.default_rng(1).permutation(len(at))[:30]
            return Matches(query_px[some], at[some[::-1]], np.full(30, 0.9))
        # By numpy's own rule: what is at (row, column) goes to (width - 1 - column, row).
        turned = np.column_stack([at[:, 1], self._sample.grid.width - 1 - at[:, 0]])
        return Matches(query_px, turned, np.linspace(0.4, 1.0, len(turned)))


def test_the_quarter_turn_with_the_most_matches_counts(sample: Sample) -> None:
    (one,) = Trial(sample, Turned(sample), USUAL, OPTIONS, adhop=False).results([Task.LOCALIZE], [False])
    assert one.error.te_m < 0.01
    assert one.error.me_px < 1e-6
    # A sixth of them has a confidence of one half at most.
    assert one.matches == pytest.approx(one.found * 5 / 6, abs=2)
    (one,) = Trial(sample, Turned(sample), USUAL, PaperOptions(turns=1), adhop=False).results([Task.LOCALIZE], [False])
    assert one.te_m is None or one.te_m > 1.0


def test_nothing_seen_is_infinitely_wrong_and_no_error(sample: Sample) -> None:
    grey = replace(sample, image=np.full_like(sample.image, 90))
    for one in results(grey):
        assert (one.te_m, one.matches, one.inliers) == (None, 0, 0)
        assert one.error.te_m == one.error.me_px == np.inf
        assert one.error.rfe == (None if one.task is Task.LOCALIZE else np.inf)
        assert not one.calibrated


def test_the_truth_is_never_matched_again(sample: Sample) -> None:
    (with_adhop,) = Trial(sample, GroundTruthMatcher(), USUAL, OPTIONS, adhop=True).results([Task.LOCALIZE], [True])
    assert with_adhop.adhop_accepted is False
    assert with_adhop.error.te_m < 0.005


def test_a_sample_without_truth_is_named(sample: Sample) -> None:
    with pytest.raises(DatasetError, match="D01_R0000: key point_map"):
        with_map(replace(sample, point_map=None), Condition(covisibility=0.5), 0)
    trial = Trial(replace(sample, keypoints=None), sift(), USUAL, OPTIONS, adhop=False)
    with pytest.raises(DatasetError, match="D01_R0000: key keypoints"):
        list(trial.results([Task.LOCALIZE], [False]))


def test_the_same_answer_twice(sample: Sample) -> None:
    def bare(one: Result) -> tuple[object, ...]:
        return one.te_m, one.re_deg, one.rpe_px, one.me_px, one.rfe, one.matches, one.inliers

    noisy = replace(sample, image=cv2.GaussianBlur(sample.image, (0, 0), 1.0).astype(np.uint8))
    assert [bare(one) for one in results(noisy)] == [bare(one) for one in results(noisy)]
