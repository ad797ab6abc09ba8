"""From a whole map to a fix, and no fix where the place is not in it, or more than one fits."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import cv2
import numpy as np
import pytest
from pipeline.scenes_pipeline import fix
from replay import rendered

from ortholoc_edge.geometry import rotation
from ortholoc_edge.geometry.arrays import ImageArray
from ortholoc_edge.matching.types import Structural
from ortholoc_edge.pipeline.frame import Frame
from ortholoc_edge.pipeline.localizer import Localizer, LocalizerOptions
from ortholoc_edge.pipeline.locate import LocateOptions, chance, judged, locate
from ortholoc_edge.pipeline.outcome import Fix, Outcome, Reason, Rejected
from ortholoc_edge.pipeline.search import Candidate, Searcher, Sighting, fitting_level
from ortholoc_edge.tiles.coarse import CoarseField

TRUTH = rendered.pose(roll_deg=2.0, pitch_deg=-3.0)
LEVEL = fitting_level(rendered.store().dop_grids, rendered.CAMERA, rendered.HEIGHT_M)


@pytest.fixture(scope="module")
def localizer() -> Iterator[Localizer]:
    made = Localizer(rendered.CAMERA, rendered.store(), Structural(), LocalizerOptions())
    yield made
    made.close()


@pytest.fixture(scope="module")
def field() -> CoarseField:
    return CoarseField.of(rendered.store(), LEVEL)


@pytest.fixture(scope="module")
def searcher(field: CoarseField) -> Searcher:
    return Searcher(field)


def sighting(image: ImageArray, off_deg: float = 7.0, reach_deg: float = 10.0) -> Sighting:
    """With a barometer that is 2 m off."""
    grey = np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), dtype=np.uint8)
    believed = rotation.exp([0.004, -0.007, math.radians(off_deg)]) @ TRUTH.rotation
    height_m = float(TRUTH.translation[2]) + 2.0
    return Sighting(grey, rendered.CAMERA, believed, math.radians(reach_deg), math.nan, height_m)


@pytest.mark.parametrize(("off_deg", "reach_deg"), [(7.0, 10.0), (-115.0, 180.0)])
def test_found_in_the_whole_map(searcher: Searcher, localizer: Localizer, off_deg: float, reach_deg: float) -> None:
    image = rendered.picture(TRUTH)
    found = locate(Frame(7, image, "x"), sighting(image, off_deg, reach_deg), searcher, localizer)
    assert isinstance(found.outcome, Fix)
    metres, degrees = rendered.errors(found.outcome.map_from_camera, TRUTH)
    assert metres < 1.0
    assert degrees < 1.0
    assert found.lead > 1.2
    assert found.tried[0] is found.outcome


def test_not_in_the_map(field: CoarseField, localizer: Localizer) -> None:
    """Mirrored, and with the ground around the place gone: there is no wrong fix to be had."""
    image = rendered.picture(TRUTH)
    column, row = np.round(field.grid.px_from_map(TRUTH.translation[:2])).astype(int)
    elsewhere = field.quantised.copy()
    elsewhere[:, row - 60 : row + 60, column - 60 : column + 60] = 0
    mirrored = np.ascontiguousarray(image[:, ::-1])
    few = LocateOptions(candidates=2)
    for shown, searched in ((mirrored, field), (image, replace(field, quantised=elsewhere))):
        found = locate(Frame(7, shown, "x"), sighting(shown), Searcher(searched), localizer, few)
        assert isinstance(found.outcome, Rejected)
        assert found.outcome.stamp_ns == 7
        assert found.candidates


def test_frame_without_anything(searcher: Searcher, localizer: Localizer) -> None:
    image = np.full((rendered.CAMERA.height, rendered.CAMERA.width, 3), 90, np.uint8)
    found = locate(Frame(7, image, "x"), sighting(image), searcher, localizer)
    assert isinstance(found.outcome, Rejected)
    assert found.outcome.reason is Reason.FEW_MATCHES
    assert found.tried == []


def test_a_fix_of_little_support_counts_for_nothing(searcher: Searcher, localizer: Localizer) -> None:
    image = rendered.picture(TRUTH)
    strict = LocateOptions(candidates=1, min_support=1.0)
    found = locate(Frame(7, image, "x"), sighting(image), searcher, localizer, strict)
    assert isinstance(found.outcome, Rejected)
    assert found.outcome.reason is Reason.LOW_INLIER_RATIO
    assert found.outcome.limit == 1.0


def test_an_end_to_it(searcher: Searcher, localizer: Localizer) -> None:
    image = rendered.picture(TRUTH)
    found = locate(Frame(7, image, "x"), sighting(image), searcher, localizer, proceed=lambda: False)
    assert isinstance(found.outcome, Rejected)
    assert found.outcome.reason is Reason.LATE


# -- which of several ---------------------------------------------------------

PLACES = [Candidate(1000.0 * k, 0.0, 100.0, 0.0, 0.5 - 0.05 * k) for k in range(4)]
NO = Rejected(7, Reason.LOW_CONTRAST, "looks like nothing", 3.0, 10.5)


def outcome_of(tried: list[Outcome], min_lead: float = 1.05) -> tuple[Outcome, float]:
    return judged(7, PLACES, tried, LocateOptions(min_lead=min_lead))


def test_one_place_that_convinces_both() -> None:
    right = fix((0.0, 0.0, 100.0))
    outcome, lead = outcome_of([right, NO, NO])
    assert outcome is right
    assert lead == pytest.approx(0.5 / 0.45)
    # The same place, found from its neighbour too.
    assert outcome_of([right, fix((4.0, 0.0, 100.0))])[0] is right


def test_the_chance_grows_with_lead_and_score() -> None:
    def of(*scores: float) -> float:
        return chance([Candidate(1000.0 * k, 0.0, 100.0, 0.0, score) for k, score in enumerate(scores)])

    assert of(0.3, 0.2) > of(0.3, 0.29) > of(0.15, 0.145)
    assert 0.99 < of(0.5, 0.2) < 1.0
    assert of(0.12, 0.118) < 0.1
    assert of(0.4) > 0.99
    assert of() == 0.0


def test_two_places_that_fit() -> None:
    outcome, _ = outcome_of([fix((0.0, 0.0, 100.0)), NO, fix((2000.0, 0.0, 100.0))])
    assert isinstance(outcome, Rejected)
    assert outcome.reason is Reason.AMBIGUOUS
    assert outcome.measured == pytest.approx(2000.0)


def test_a_place_that_the_search_did_not_mean() -> None:
    second = fix((1000.0, 0.0, 100.0))
    outcome, lead = outcome_of([NO, second])
    assert isinstance(outcome, Rejected)
    assert outcome.reason is Reason.AMBIGUOUS
    assert lead == pytest.approx(0.9)
    assert outcome_of([NO, second], min_lead=0.85)[0] is second


def test_no_place_at_all() -> None:
    outcome, lead = outcome_of([NO, NO])
    assert isinstance(outcome, Rejected)
    assert outcome.reason is Reason.LOW_CONTRAST
    assert "2 likely places" in outcome.detail
    assert (outcome.measured, outcome.limit, lead) == (3.0, 10.5, 0.0)
