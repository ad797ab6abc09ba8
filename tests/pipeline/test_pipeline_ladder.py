"""Detail and rate against time, load and heat: steps down under strain, up when there is room, and never swings."""

import itertools
import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pipeline.scenes_pipeline import fix
from replay import rendered

from ortholoc_edge.adapters.computer import ComputerStatus
from ortholoc_edge.matching.sift import SiftMatcher
from ortholoc_edge.matching.types import Structural
from ortholoc_edge.pipeline import structural
from ortholoc_edge.pipeline.frame import Frame
from ortholoc_edge.pipeline.ladder import Cause, Ladder, LadderOptions, Strain
from ortholoc_edge.pipeline.localizer import FEATURE_SCALES, Localizer, LocalizerOptions
from ortholoc_edge.pipeline.navigator import Navigator
from ortholoc_edge.pipeline.outcome import Fix, Reason, Rejected

S = 1_000_000_000
FRAME_NS = S // 5
COOL, HOT, WARM = Strain(20.0, 50.0), Strain(20.0, 85.0), Strain(20.0, 75.0)


def climbed(ladder: Ladder, times_ms, first: int = 0) -> list[int]:
    rungs = []
    for number, took_ms in enumerate(times_ms, first):
        ladder.note(took_ms, number * FRAME_NS)
        rungs.append(ladder.rung)
    return rungs


def observed(ladder: Ladder, strain: Strain, seconds: int, first: int = 0) -> list[int]:
    rungs = []
    for second in range(first, first + seconds):
        ladder.observe(strain, second * S)
        rungs.append(ladder.rung)
    return rungs


@pytest.mark.parametrize(
    ("flags", "strained"),
    [
        ((False, True, False), True), ((True, True, False), False), ((True, True, True), True),
        ((True, False, False), False),
    ],
)  # fmt: skip
def test_a_weak_supply_is_no_heat(flags: tuple[bool, bool, bool], strained: bool) -> None:
    """Fewer frames would cost positions and mend nothing."""
    assert ComputerStatus((), 0, 0, (), *flags).is_strained is strained


def test_a_search_by_features_takes_no_detail_from_what_searches(monkeypatch: pytest.MonkeyPatch) -> None:
    """It takes as long as it may on any rung."""

    def noted(structural_ms: float | None, total_ms: float, found: bool) -> int:
        timings = {"match": total_ms / 2, "total": total_ms}
        if structural_ms is not None:
            timings["structural"] = structural_ms
        outcome = fix((0.0, 0.0, 0.0)) if found else Rejected(0, Reason.FEW_INLIERS, "lost")
        navigator = Navigator(SimpleNamespace(rungs=3), SimpleNamespace(), 100.0)  # type: ignore[arg-type]
        monkeypatch.setattr(navigator, "_step", lambda *_: replace(outcome, timings_ms=timings))
        for number in range(10):
            navigator.step(Frame(number * FRAME_NS, np.zeros((4, 4), np.uint8), ""), None)  # type: ignore[arg-type]
        return navigator.ladder.rung

    assert noted(None, 1000.0, found=False) == 0
    assert noted(None, 150.0, found=True) == 2
    assert noted(40.0, 1000.0, found=False) == 0
    assert noted(150.0, 160.0, found=False) == 2


# -- time --------------------------------------------------------------------------------------------------


def test_slow_frames_step_down_in_detail_and_never_to_fewer_frames():
    ladder = Ladder(3, 100.0)
    assert climbed(ladder, [150.0] * 20) == [0] * 4 + [1] * 5 + [2] * 11
    assert (ladder.rungs, ladder.detail, ladder.rate_hz) == (5, 2, None)
    assert [(step.was, step.rung, step.cause) for step in ladder.take_steps()] == [
        (0, 1, Cause.TIME), (1, 2, Cause.TIME),
    ]  # fmt: skip
    assert ladder.take_steps() == []
    assert ladder.last_step is not None and ladder.last_step.why == "frames take 150 ms, 100 are allowed"


def test_one_slow_frame_in_five_changes_nothing():
    assert climbed(Ladder(3, 100.0), [90.0, 90.0, 90.0, 90.0, 2000.0] * 10) == [0] * 50


def test_room_steps_up_only_after_fifty_frames_on_end():
    ladder = Ladder(2, 100.0)
    climbed(ladder, [150.0] * 5)
    assert climbed(ladder, [40.0] * 60, 5) == [1] * 49 + [0] * 11


def test_a_search_now_and_then_does_not_keep_detail_out_but_many_frames_without_room_do():
    for spacing, rungs in ((8, [1] * 196), (12, [1] * 49 + [0] * 147)):
        ladder = Ladder(2, 100.0)
        climbed(ladder, [150.0] * 5)
        assert climbed(ladder, ([40.0] * (spacing - 1) + [70.0]) * 30, 5)[:196] == rungs


def test_what_a_rung_saves_is_no_reason_to_go_back_and_forth():
    """1.6 times the time one rung up: within the budget on the lower one, but no room for the upper."""
    ladder = Ladder(2, 100.0)
    took = {0: 120.0, 1: 75.0}
    rungs = []
    for number in range(500):
        ladder.note(took[ladder.rung], number * FRAME_NS)
        rungs.append(ladder.rung)
    assert rungs == [0] * 4 + [1] * 496


# -- heat and load -----------------------------------------------------------------------------------------


def test_heat_steps_down_to_the_last_rung_and_back_when_it_is_cool():
    ladder = Ladder(2, 100.0)
    # Three readings, then a rung every ten seconds.
    assert observed(ladder, HOT, 40) == [0, 0] + [1] * 10 + [2] * 10 + [3] * 18
    assert (ladder.detail, ladder.rate_hz) == (1, 2.0)
    assert {step.cause for step in ladder.take_steps()} == {Cause.HEAT}
    # Between the two limits it stays.
    assert set(observed(ladder, WARM, 60, 40)) == {3}
    assert observed(ladder, COOL, 25, 100) == [2] * 10 + [1] * 15
    assert ladder.rate_hz is None
    # What a rung of detail costs in time is asked, too.
    assert climbed(ladder, [40.0] * 50, 800)[-1] == 0


def test_two_hot_readings_are_none():
    assert set(observed(Ladder(2, 100.0), HOT, 2)) == {0}
    ladder = Ladder(2, 100.0)
    for second in range(30):
        ladder.observe(COOL if second % 3 == 2 else HOT, second * S)
    assert ladder.rung == 0


def test_throttling_is_heat_whatever_the_sensor_says():
    ladder = Ladder(2, 100.0)
    observed(ladder, Strain(None, None, throttled=True), 3)
    step = ladder.last_step
    assert step is not None and (step.cause, step.why) == (Cause.HEAT, "processor throttled")


def test_load_steps_down_in_detail_only_and_holds_a_step_up():
    ladder = Ladder(3, 100.0)
    assert observed(ladder, Strain(99.0), 40) == [0] * 4 + [1] * 5 + [2] * 31
    assert set(observed(Ladder(3, 100.0, LadderOptions(max_load_percent=100.0)), Strain(100.0), 40)) == {0}
    ladder = Ladder(2, 100.0)
    climbed(ladder, [150.0] * 5)
    for number in range(5, 200):
        ladder.observe(Strain(90.0), number * FRAME_NS)
        ladder.note(40.0, number * FRAME_NS)
    assert ladder.rung == 1
    for number in range(200, 300):
        ladder.observe(Strain(70.0), number * FRAME_NS)
        ladder.note(40.0, number * FRAME_NS)
    assert ladder.rung == 0


def test_without_a_budget_nothing_is_left_out():
    """A replay must be the same on every computer, and so must a simulation."""
    for budget_ms in (None, math.inf):
        ladder = Ladder(3, budget_ms)
        assert climbed(ladder, [1e6] * 100) == [0] * 100
        assert observed(ladder, Strain(100.0, 120.0, True), 100) == [0] * 100
        ladder.allow(50.0, LadderOptions(), 0)
        assert climbed(ladder, [1e6] * 100) == [0] * 100


def test_other_limits_in_flight():
    ladder = Ladder(2, 100.0)
    observed(ladder, HOT, 40)
    ladder.allow(100.0, LadderOptions(rates_hz=()), 40 * S)
    assert (ladder.rung, ladder.rungs, ladder.rate_hz) == (1, 2, None)
    assert ladder.last_step is not None and ladder.last_step.cause is Cause.RELOAD
    ladder.allow(100.0, LadderOptions(hot_c=90.0, cool_c=88.0), 40 * S)
    climbed(ladder, [40.0] * 60, 250)
    assert ladder.rung == 0
    with pytest.raises(ValueError, match=r"cool_c = 80.0 must be below hot_c"):
        LadderOptions(cool_c=80.0)
    with pytest.raises(ValueError, match="must fall"):
        LadderOptions(rates_hz=(2.0, 5.0))


def test_a_rung_that_lasted_is_tried_again_as_soon_as_ever():
    ladder = Ladder(2, 100.0, LadderOptions(rates_hz=()))

    def waited(start_s: int) -> int:
        """Seconds on the lower rung, of frames that leave room, before the upper is tried."""
        for second in range(start_s, start_s + 2000):
            climbed(ladder, [40.0] * 5, second * 5)
            if ladder.rung == 0:
                return second - start_s
        raise AssertionError("it never is")

    climbed(ladder, [150.0] * 5, 0)
    assert waited(1) in (9, 10)
    for start_s, wait_s in ((20, 20), (50, 40), (100, 80)):
        climbed(ladder, [150.0] * 5, start_s * 5)
        assert waited(start_s + 1) in (wait_s - 1, wait_s), "it had lasted for seconds only"
    climbed(ladder, [150.0] * 5, 2000 * 5)
    assert waited(2001) in (9, 10)


# -- rate ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("camera_hz", [3.0, 7.0, 10.0, 30.0])
def test_at_most_so_many_frames_a_second_are_due(camera_hz):
    ladder = Ladder(1, 100.0, LadderOptions(rates_hz=(2.0,)))
    stamps = [round(number / camera_hz * S) for number in range(round(60 * camera_hz))]
    assert all(ladder.is_due(stamp_ns) for stamp_ns in stamps)
    observed(ladder, HOT, 3)
    due = [stamp_ns for stamp_ns in stamps if ladder.is_due(stamp_ns)]
    assert len(due) == pytest.approx(120, abs=1)
    # After a pause of the camera it does not make up for it.
    assert [ladder.is_due(70 * S + number * S // 10) for number in range(6)] == [True, *[False] * 4, True]


# -- over hours ----------------------------------------------------------------------------------------------


class Computer:
    """A place with constant conditions: what a rung costs in time and heat, and how fast that shows."""

    def __init__(self, times_ms, heats_c, tau_s, foreign_load):
        self.times_ms, self.heats_c, self.tau_s, self.foreign_load = times_ms, heats_c, tau_s, foreign_load
        self.celsius = 40.0

    def hour(self, ladder: Ladder, start_s: int, hours: float = 1.0) -> list[int]:
        rungs = []
        for second in range(start_s, start_s + round(3600 * hours)):
            target = self.heats_c[min(ladder.rung, len(self.heats_c) - 1)]
            self.celsius += (target - self.celsius) / self.tau_s
            took_ms = self.times_ms[ladder.detail]
            rate = min(5.0, 1000.0 / took_ms, ladder.rate_hz or math.inf)
            load = min(100.0, self.foreign_load + took_ms * rate / 20.0)
            ladder.observe(Strain(load, self.celsius), second * S)
            for part in range(max(1, int(rate))):
                ladder.note(took_ms, second * S + part * S // 8)
            rungs.append(ladder.rung)
        return rungs


@st.composite
def computers(draw):
    times_ms = sorted(draw(st.lists(st.floats(5.0, 400.0), min_size=3, max_size=3)), reverse=True)
    heats_c = sorted(draw(st.lists(st.floats(40.0, 110.0), min_size=5, max_size=5)), reverse=True)
    return Computer(times_ms, heats_c, draw(st.floats(1.0, 300.0)), draw(st.floats(0.0, 100.0)))


@settings(max_examples=25, deadline=None)
@given(computers())
def test_constant_conditions_make_no_swinging_and_relief_brings_everything_back(computer):
    ladder = Ladder(3, 100.0)
    computer.hour(ladder, 0)
    rungs = computer.hour(ladder, 3600, 2.0)
    ups = sum(after < before for before, after in itertools.pairwise(rungs))
    # A rung that does not last is tried ever more rarely, from 10 s to 640 s: of four that is the most in two hours.
    assert ups <= 4 * 7200 / 640
    # Whatever it was: well again, all of it comes back.
    relieved = Computer([20.0] * 3, [45.0], 60.0, 10.0)
    relieved.celsius = computer.celsius
    assert relieved.hour(ladder, 3 * 3600, 1.0)[-1] == 0


# -- what a rung is --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("rung", range(len(structural.LADDER)))
def test_every_rung_finds_the_frame(rung):
    check_rung(Structural(), len(structural.LADDER), rung)


@pytest.mark.parametrize("rung", range(len(FEATURE_SCALES)))
def test_every_rung_of_features_finds_the_frame(rung):
    check_rung(SiftMatcher(), len(FEATURE_SCALES), rung)


def check_rung(matcher, rungs, rung):
    localizer = Localizer(rendered.CAMERA, rendered.store(), matcher, LocalizerOptions())
    try:
        assert localizer.rungs == rungs
        pose = rendered.pose()
        outcome = localizer.localize(rendered.frame(pose), rendered.prior(pose), rung=rung)
    finally:
        localizer.close()
    assert isinstance(outcome, Fix), outcome
    error_m = float(((outcome.map_from_camera.translation - pose.translation) ** 2).sum() ** 0.5)
    # The pack is not the world that the frames show: at full detail it is a metre off, too.
    assert error_m < 1.5
