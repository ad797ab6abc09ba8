"""Detail against time: steps down under load, up when there is room, and never for one slow frame."""

import pytest
from replay import rendered

from ortholoc_edge.matching.types import Structural
from ortholoc_edge.pipeline import structural
from ortholoc_edge.pipeline.ladder import Ladder
from ortholoc_edge.pipeline.localizer import Localizer, LocalizerOptions
from ortholoc_edge.pipeline.outcome import Fix


def climbed(ladder: Ladder, times_ms) -> list[int]:
    rungs = []
    for took_ms in times_ms:
        ladder.note(took_ms)
        rungs.append(ladder.rung)
    return rungs


def test_load_steps_down_rung_by_rung_and_no_further_than_the_last():
    assert climbed(Ladder(3, 100.0), [150.0] * 20) == [0] * 4 + [1] * 5 + [2] * 11


def test_one_slow_frame_in_five_changes_nothing():
    assert climbed(Ladder(3, 100.0), [90.0, 90.0, 90.0, 90.0, 2000.0] * 10) == [0] * 50


def test_room_steps_up_only_after_fifty_frames_on_end():
    ladder = Ladder(2, 100.0)
    climbed(ladder, [150.0] * 5)
    assert climbed(ladder, [40.0] * 60) == [1] * 49 + [0] * 11


def test_a_search_now_and_then_does_not_keep_detail_out_but_many_frames_without_room_do():
    for spacing, rungs in ((8, [1] * 196), (12, [1] * 49 + [0] * 147)):
        ladder = Ladder(2, 100.0)
        climbed(ladder, [150.0] * 5)
        assert climbed(ladder, ([40.0] * (spacing - 1) + [70.0]) * 30)[:196] == rungs


def test_what_a_rung_saves_is_no_reason_to_go_back_and_forth():
    """1.6 times the time one rung up: within the budget on the lower one, but no room for the upper."""
    ladder = Ladder(2, 100.0)
    took = {0: 120.0, 1: 75.0}
    rungs = []
    for _ in range(500):
        ladder.note(took[ladder.rung])
        rungs.append(ladder.rung)
    assert rungs == [0] * 4 + [1] * 496


def test_without_a_budget_nothing_is_left_out():
    assert climbed(Ladder(3, None), [1e6] * 100) == [0] * 100


@pytest.mark.parametrize("rung", range(len(structural.LADDER)))
def test_every_rung_finds_the_frame(rung):
    localizer = Localizer(rendered.CAMERA, rendered.store(), Structural(), LocalizerOptions())
    try:
        assert localizer.rungs == len(structural.LADDER)
        pose = rendered.pose()
        outcome = localizer.localize(rendered.frame(pose), rendered.prior(pose), rung=rung)
    finally:
        localizer.close()
    assert isinstance(outcome, Fix)
    error_m = float(((outcome.map_from_camera.translation - pose.translation) ** 2).sum() ** 0.5)
    # The pack is not the world that the frames show: at full detail it is a metre off, too.
    assert error_m < 1.5
