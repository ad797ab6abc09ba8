"""When a search is asked for, where it looks, and when it is believed."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, field, replace

import numpy as np
import pytest
from pipeline.scenes_pipeline import WIDE, fix, turned_down

from ortholoc_edge.geometry import frames
from ortholoc_edge.geometry.arrays import FloatArray
from ortholoc_edge.geometry.rigid import Rigid3
from ortholoc_edge.pipeline.finder import Answer, Ask, Finder, SearchOptions
from ortholoc_edge.pipeline.frame import Frame, VehicleState
from ortholoc_edge.pipeline.outcome import Fix, Outcome, Reason, Rejected
from ortholoc_edge.pipeline.prior import PosePrior
from ortholoc_edge.pipeline.search import Candidate
from ortholoc_edge.pipeline.tracker import FoundPosition, GivenPosition, Tracker, TrackerOptions, TrackerStatus
from ortholoc_edge.tiles.georeference import Georeference, VerticalDatum

LOCAL = Georeference(None, VerticalDatum(kind="ellipsoid", ellipsoid_minus_map_m=0.0), (0.0, 0.0))
NADIR = Rigid3(frames.BODY_FROM_NADIR_CAMERA, np.zeros(3))
SIGMA = (math.radians(1.0), math.radians(1.0), math.radians(3.0))
S = 1_000_000_000
NOTHING = Rejected(0, Reason.FEW_MATCHES)


@dataclass
class FakeSeeker:
    """Answers when the test says so."""

    asked: list[Ask] = field(default_factory=list)
    answer: Answer | None = None
    busy: bool = False

    @property
    def idle(self) -> bool:
        return not self.busy and self.answer is None

    def ask(self, ask: Ask) -> None:
        assert self.idle
        self.busy = True
        self.asked.append(ask)

    def take(self) -> Answer | None:
        answer, self.answer = self.answer, None
        return answer

    def close(self) -> None:
        pass

    def say(self, outcome: Outcome, took_s: float = 2.0, trouble: str = "") -> None:
        self.busy = False
        self.answer = Answer(outcome, [Candidate(1.0, 2.0, 100.0, 0.0, 0.5)], took_s, trouble)


@dataclass
class Flight:
    """A vehicle that flies east with 10 m/s by its odometry, from (0, 0, 100); frames once a second."""

    options: SearchOptions = field(default_factory=SearchOptions)
    believed: FloatArray | None = field(default_factory=lambda: np.array([0.0, 0.0, 120.0]))
    odometry: bool = True

    def __post_init__(self) -> None:
        self.tracker = Tracker(LOCAL, NADIR, TrackerOptions())
        self.seeker = FakeSeeker()
        self.counts: Counter[str] = Counter()
        self.finder = Finder(self.options, self.seeker, self.tracker, TrackerOptions(), LOCAL, WIDE, self.counts)
        self.second = 0

    def place(self, second: float, off: tuple[float, float] = (0.0, 0.0)) -> FloatArray:
        return np.array([10.0 * second + off[0], off[1], 100.0])

    def state(self, position: FloatArray | None = None) -> VehicleState:
        odometry = np.array([0.0, 10.0 * self.second, 0.0]) if self.odometry else None
        return VehicleState(
            self.second * S, np.eye(3), SIGMA, odometry, 1, position, (2.0, 3.0), believed_map_m=self.believed
        )

    def frame(
        self, outcome: Outcome | None = None, gnss: FloatArray | None = None, image: np.ndarray | None = None
    ) -> FoundPosition | None:
        """A second goes by; ``outcome``: of its frame, None: nothing was found."""
        self.second += 1
        state = self.state(gnss)
        self.tracker.predict(state)
        outcome = outcome or replace(NOTHING, stamp_ns=state.stamp_ns)
        self.tracker.update(outcome, state)
        picture = np.zeros((WIDE.height, WIDE.width), np.uint8) if image is None else image
        return self.finder.step(Frame(state.stamp_ns, picture, "x"), state, outcome, state.stamp_ns)

    def tracked(self, off: tuple[float, float] = (0.0, 0.0)) -> FoundPosition | None:
        """A frame with a fix."""
        return self.frame(fix(self.place(self.second + 1, off), stamp_ns=(self.second + 1) * S))

    def until_asked(self) -> Ask:
        before = len(self.seeker.asked)
        for _ in range(60):
            self.frame()
            if len(self.seeker.asked) > before:
                return self.seeker.asked[-1]
        raise AssertionError("no search within a minute")

    def found(self, off: tuple[float, float]) -> Fix:
        """What a search of the frame that was sent last says, if the vehicle is that far from its odometry."""
        stamp_ns = self.seeker.asked[-1].stamp_ns
        return fix(self.place(stamp_ns / S, off), stamp_ns=stamp_ns)


def test_a_vehicle_with_gnss_is_not_searched_for() -> None:
    flight = Flight(SearchOptions(duty=1.0))
    for second in range(1, 11):
        assert flight.frame(gnss=flight.place(second)) is None
    assert flight.seeker.asked == []


def test_what_was_found_while_gnss_came_back_is_not_heard() -> None:
    flight = Flight(SearchOptions(agreements=1))
    flight.until_asked()
    flight.seeker.say(flight.found((900.0, 0.0)))
    assert flight.frame(gnss=flight.place(flight.second + 1)) is None
    assert flight.frame() is None
    assert flight.counts["searches_found"] == 0


def test_lost_it_is_searched_for_and_believed_the_second_time() -> None:
    flight = Flight()
    flight.tracked()
    flight.seeker.say(NOTHING)
    ask = flight.until_asked()
    assert flight.finder.take_notices() == ["OrthoLoC: no fix, searching the map"]
    # Level over ground, the camera straight down; 3 sigmas of heading are less than what is looked for at least.
    assert np.allclose(ask.sighting.map_from_camera, turned_down(), atol=1e-9)
    assert ask.sighting.heading_reach_rad == pytest.approx(math.radians(10.0))
    # From the last fix on, by the odometry, not by what the autopilot believes.
    assert (ask.sighting.height_m, math.isnan(ask.sighting.above_ground_m)) == (100.0, True)
    flight.seeker.say(flight.found((300.0, 40.0)))
    assert flight.frame() is None
    flight.seeker.say(flight.found((310.0, 45.0)))
    order = flight.frame()
    assert order is not None
    stamp_ns = flight.seeker.asked[-2].stamp_ns
    assert order.stamp_ns == stamp_ns
    assert order.position_map_m == pytest.approx(tuple(flight.place(stamp_ns / S, (310.0, 45.0))))
    assert order.odometry_ned_m == pytest.approx((0.0, 10.0 * stamp_ns / S, 0.0))
    assert flight.finder.take_notices() == ["OrthoLoC: found 313 m off"]
    assert flight.counts["found_again"] == 1
    assert flight.counts["tracks_dropped"] == 0
    # Given to the tracker, it predicts there, and the fix is one new start.
    resets = flight.tracker.reset_counter
    flight.tracker.take(order)
    flight.second += 1
    prior = flight.tracker.predict(flight.state())
    assert isinstance(prior, PosePrior)
    assert prior.map_from_camera.translation == pytest.approx(flight.place(flight.second, (310.0, 45.0)))
    # The odometry that carried it away is not believed.
    assert math.sqrt(prior.covariance[0, 0]) > 4.0 * (flight.second - stamp_ns / S)
    there = fix(flight.place(flight.second, (311.0, 45.0)), stamp_ns=flight.second * S)
    flight.tracker.update(there, flight.state())
    assert (flight.tracker.reset_counter, flight.tracker.status) == (resets + 1, TrackerStatus.TRACK)
    flight.tracked((311.0, 45.0))
    assert flight.tracker.reset_counter == resets + 1


def test_two_places_that_do_not_agree_are_no_agreement() -> None:
    flight = Flight()
    flight.tracked()
    flight.seeker.say(NOTHING)
    flight.until_asked()
    for off in ((300.0, 0.0), (-800.0, 500.0), (2000.0, 0.0), (300.0, 5000.0)):
        flight.seeker.say(flight.found(off))
        assert flight.frame() is None
    # Nor are two with what is not found between them another one's.
    flight.seeker.say(NOTHING)
    assert flight.frame() is None
    flight.seeker.say(flight.found((302.0, 5001.0)))
    assert flight.frame() is not None


def test_the_odometry_may_have_failed_between_two_finds() -> None:
    flight = Flight()
    flight.tracked()
    flight.seeker.say(NOTHING)
    flight.until_asked()
    flight.seeker.say(flight.found((300.0, 0.0)))
    flight.frame()
    # One second later, 12 m farther.
    flight.seeker.say(flight.found((312.0, 0.0)))
    assert flight.frame() is not None


def test_an_area_grows_with_the_time_and_is_left_now_and_then() -> None:
    flight = Flight()
    flight.tracked()
    flight.seeker.say(NOTHING)
    areas = []
    for _ in range(9):
        areas.append(flight.until_asked().within)
        flight.seeker.say(NOTHING)
    assert sum(area is None for area in areas) == 3
    widths = [float(np.ptp(area[:, 0])) for area in areas if area is not None]
    assert widths == sorted(widths)
    # Around the last fix, 30 m/s to either side, and 100 m.
    fourth = next(area for area in areas if area is not None)
    assert fourth.mean(axis=0) == pytest.approx((10.0, 0.0), abs=1e-6)
    assert widths[0] > 2 * (100.0 + 30.0 * 3)


def test_without_any_known_place_it_is_everywhere_from_the_barometers_height() -> None:
    flight = Flight()
    ask = flight.until_asked()
    assert ask.within is None
    assert ask.sighting.height_m == 120.0


def test_nothing_is_asked_where_the_height_is_not_known() -> None:
    flight = Flight(believed=None)
    for _ in range(10):
        flight.frame()
    assert flight.seeker.asked == []
    assert "how high" in flight.finder.says


def test_a_track_is_checked_at_the_duty_and_kept() -> None:
    flight = Flight(SearchOptions(duty=0.1))
    asked_at = []
    for _ in range(60):
        before = len(flight.seeker.asked)
        assert flight.tracked() is None
        if len(flight.seeker.asked) > before:
            asked_at.append(flight.second)
            assert flight.seeker.asked[-1].within is None
            flight.seeker.say(flight.found((0.0, 0.0)), took_s=1.0)
    # A second of searching, nine without.
    assert np.diff(asked_at).tolist() == [10] * (len(asked_at) - 1)
    assert len(asked_at) >= 5
    assert flight.finder.says == "the search finds the track's place"


def test_without_duty_a_track_is_not_checked() -> None:
    flight = Flight(SearchOptions(duty=0.0))
    for _ in range(20):
        flight.tracked()
    assert flight.seeker.asked == []


def test_a_track_with_fixes_is_dropped_for_what_was_found_thrice() -> None:
    flight = Flight(SearchOptions(duty=1.0))
    flight.tracked()
    orders = []
    for _ in range(3):
        flight.seeker.say(flight.found((500.0, 0.0)))
        orders.append(flight.tracked())
    assert [order is None for order in orders] == [True, True, False]
    assert orders[2] is not None
    assert "track dropped" in orders[2].why
    assert flight.counts["tracks_dropped"] == 1
    [notice] = flight.finder.take_notices()
    assert notice == "OrthoLoC: track dropped, found 500 m off"


def test_one_agreement_with_the_track_is_worth_all_against_it() -> None:
    flight = Flight(SearchOptions(duty=1.0))
    flight.tracked()
    for off in ((500.0, 0.0), (500.0, 0.0), (0.0, 0.0), (500.0, 0.0), (500.0, 0.0)):
        flight.seeker.say(flight.found(off))
        assert flight.tracked() is None


def test_an_operators_area_is_searched_at_once_and_only_there() -> None:
    flight = Flight(SearchOptions(duty=0.01))
    flight.tracked()
    flight.seeker.say(flight.found((0.0, 0.0)), took_s=5.0)
    flight.tracked()
    flight.tracked()
    assert len(flight.seeker.asked) == 1
    corners = np.array([[0.0, 0.0], [500.0, 0.0], [500.0, 500.0]])
    flight.finder.search_in(corners, flight.second * S)
    flight.tracked()
    assert flight.seeker.asked[-1].within is corners
    for _ in range(6):
        flight.seeker.say(NOTHING)
        flight.tracked()
        assert flight.seeker.asked[-1].within is corners
    flight.finder.search_in(None, flight.second * S)
    flight.seeker.say(NOTHING)
    for _ in range(5):
        flight.frame()
        flight.seeker.say(NOTHING)
    assert any(ask.within is None for ask in flight.seeker.asked[-4:])


def test_what_was_under_way_when_an_area_was_given_is_not_heard() -> None:
    flight = Flight(SearchOptions(agreements=1))
    flight.until_asked()
    flight.finder.search_in(np.array([[0.0, 0.0], [500.0, 0.0], [500.0, 500.0]]), flight.second * S)
    flight.seeker.say(flight.found((300.0, 0.0)))
    assert flight.frame() is None
    assert flight.counts["searches_found"] == 0


@pytest.mark.parametrize("reason", [Reason.DARK, Reason.FROZEN, Reason.BAD_FRAME, Reason.MOTION_BLUR])
def test_an_unfit_frame_is_not_searched_with(reason: Reason) -> None:
    flight = Flight()
    for _ in range(10):
        flight.frame(replace(NOTHING, reason=reason))
    assert flight.seeker.asked == []


def test_trouble_is_told_once_and_waited_after() -> None:
    flight = Flight()
    flight.until_asked()
    for _ in range(2):
        at = flight.second
        flight.seeker.say(NOTHING, trouble="takes 900 MB, and 256 are allowed")
        flight.until_asked()
        assert flight.second - at >= 10
    assert flight.finder.take_notices().count("OrthoLoC: the map can't be searched, see log") == 1
    assert flight.counts["searches_failed"] == 2


def test_earlier_frames_help_where_the_motion_since_is_known() -> None:
    flight = Flight()
    first = flight.until_asked()
    assert first.former == ()
    flight.seeker.say(NOTHING)
    [former] = flight.until_asked().former
    apart_s = (flight.seeker.asked[-1].stamp_ns - first.stamp_ns) / S
    assert former.moved_m == pytest.approx((10.0 * apart_s, 0.0))
    blind = Flight(odometry=False)
    blind.until_asked()
    blind.seeker.say(NOTHING)
    assert blind.until_asked().former == ()


def test_pictures_are_brought_to_the_seekers_size_in_grey() -> None:
    flight = Flight()
    for _ in range(5):
        flight.frame(image=np.full((600, 800, 3), 90, np.uint8))
    assert flight.seeker.asked[0].sighting.grey.shape == (WIDE.height, WIDE.width)
    assert int(flight.seeker.asked[0].sighting.grey[0, 0]) == 90


def test_the_odometry_is_believed_again_when_fixes_agree_with_it() -> None:
    flight = Flight()
    flight.tracker.take(
        FoundPosition(
            stamp_ns=0, position_map_m=(0.0, 0.0, 100.0), covariance=((1, 0, 0), (0, 1, 0), (0, 0, 1)),
            odometry_ned_m=(0.0, 0.0, 0.0), odometry_epoch=1, why="found",
        )
    )  # fmt: skip
    sigmas = []
    for second in range(1, 9):
        flight.second = second
        prior = flight.tracker.predict(flight.state())
        assert isinstance(prior, PosePrior)
        sigmas.append(math.sqrt(prior.covariance[0, 0]))
        # For three seconds it still runs 4 m/s too fast.
        off = 4.0 * min(second, 3)
        flight.tracker.update(fix(flight.place(second, (off, 0.0)), stamp_ns=second * S), flight.state())
    assert min(sigmas[:3]) > 3.0
    assert sigmas[-1] < 1.0


def test_an_order_of_somebody_else_forgets_the_found_place() -> None:
    flight = Flight()
    flight.tracker.take(
        FoundPosition(
            stamp_ns=0, position_map_m=(500.0, 0.0, 100.0), covariance=((1, 0, 0), (0, 1, 0), (0, 0, 1)),
            odometry_ned_m=None, odometry_epoch=1, why="found",
        )
    )  # fmt: skip
    flight.tracker.take(GivenPosition(stamp_ns=0, position_map_m=(0.0, 0.0, 100.0), sigma_m=(5.0, 5.0)))
    prior = flight.tracker.predict(flight.state())
    assert isinstance(prior, PosePrior)
    assert prior.map_from_camera.translation[0] == pytest.approx(0.0)
