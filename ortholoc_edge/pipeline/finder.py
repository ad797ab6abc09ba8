"""When to look for the vehicle in the whole map, where, and when to believe what was found.

Two hypotheses run against each other: the tracker's, which each frame confirms or not, and that of a search, which
knows nothing of it. A search takes seconds, so somebody else does it (`Seeker`), with one frame at a time; what it
says is of a frame that has passed, and is carried on by the odometry as everything else is.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Final, Protocol

import cv2
import numpy as np
from msgspec import Meta, Struct

from ortholoc_edge.geometry import covariance as cov
from ortholoc_edge.geometry import frames
from ortholoc_edge.geometry.arrays import FloatArray, ImageArray
from ortholoc_edge.geometry.camera import Camera
from ortholoc_edge.pipeline.frame import CameraMount, Frame, VehicleState, grey_of
from ortholoc_edge.pipeline.outcome import Fix, Outcome, Reason, Rejected
from ortholoc_edge.pipeline.search import Candidate, Former, Sighting, circle
from ortholoc_edge.pipeline.tracker import (
    LOST_DRIFT_M_PER_S,
    Anchor,
    FoundPosition,
    Tracker,
    TrackerOptions,
    anchor_at,
    carried,
    moved_map_m,
)
from ortholoc_edge.tiles.georeference import Georeference

_S = 1_000_000_000
# Of a heading, how many sigmas it may be off, and what it is looked for at least.
_HEADING_SIGMAS: Final = 3.0
_LEAST_HEADING_RAD: Final = math.radians(10.0)
# A found place and a predicted one are the same up to so many sigmas and metres; where the prediction allows more than
# the last, it says nothing.
_SAME_SIGMAS: Final = 3.0
_SAME_M: Final = 3.0
_SAYS_NOTHING_M: Final = 200.0
# What the last known place may be off, beyond how far the vehicle can have come.
_AREA_SIGMAS: Final = 4.0
_AREA_M: Final = 100.0
# The last known place may itself be wrong: every so many searches go everywhere.
_EVERYWHERE: Final = 3
# Of earlier frames, how many help, and how old they may be.
_FORMER: Final = 2
_FORMER_S: Final = 60.0
# A search that could not be made is not tried again at once.
_AFTER_FAILURE_S: Final = 10.0
# Of a frame with one of these there is nothing to be found.
_UNFIT: Final = frozenset(
    {
        Reason.BAD_FRAME,
        Reason.DARK,
        Reason.REPEATED,
        Reason.FROZEN,
        Reason.MOTION_BLUR,
        Reason.BAD_ATTITUDE,
        Reason.GIMBAL_UNKNOWN,
        Reason.PAUSED,
        Reason.INTERNAL,
    }
)


class SearchOptions(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The search of the whole map, in a process of its own at the lowest priority.

    ``enabled``: without it a vehicle that is lost stays so until somebody says where it is.
    ``threads``: of that process.
    ``lost_after_s``: without a fix for so long, and without GNSS, it searches without a break.
    ``duty``: part of the time that it searches otherwise, to hold what it finds against the track; 0: not at all.
    ``agreements``: so many searches in a row, of different frames, must find the same place before a vehicle that is
        lost goes on from there; those that find nothing do not count.
    ``against``: and so many, before a track that still has fixes is dropped for it.
    ``max_speed_m_per_s``: over ground; so far from the last known place a vehicle that is lost is looked for.
    ``max_mb``: of memory for the edges of the map that are looked through; what needs more is not searched.
    """

    enabled: bool = True
    threads: Annotated[int, Meta(ge=1, le=16)] = 1
    lost_after_s: Annotated[float, Meta(gt=0)] = 3.0
    duty: Annotated[float, Meta(ge=0, le=1)] = 0.1
    agreements: Annotated[int, Meta(ge=1, le=10)] = 2
    against: Annotated[int, Meta(ge=2, le=10)] = 3
    max_speed_m_per_s: Annotated[float, Meta(gt=0)] = 30.0
    max_mb: Annotated[int, Meta(ge=1)] = 256


@dataclass(frozen=True, slots=True, eq=False)
class Ask:
    """What a search is to do; arguments of `locate.locate`."""

    stamp_ns: int
    sighting: Sighting
    within: FloatArray | None
    former: tuple[Former, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Answer:
    """What came of it.

    Attributes:
        outcome: of the frame.
        own: `locate.Located.own`.
        took_s: of processor time.
        trouble: why it could not be made; empty if it could.
    """

    outcome: Outcome
    own: Sequence[Candidate]
    took_s: float
    trouble: str = ""


class Seeker(Protocol):
    """Searches; one at a time, elsewhere."""

    @property
    def idle(self) -> bool:
        """Whether it may be asked: nothing is under way, and the last answer was taken."""
        ...

    def ask(self, ask: Ask) -> None:
        """Begin, and return at once."""
        ...

    def take(self) -> Answer | None:
        """The answer, once; None while there is none."""
        ...

    def close(self) -> None:
        """End what is under way."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class _Asked:
    """What a search that is under way was asked about."""

    state: VehicleState
    mount: CameraMount


@dataclass(frozen=True, slots=True, eq=False)
class _Hypothesis:
    """Where searches find the vehicle.

    Attributes:
        place: where the last of them did.
        count: how many, in a row, that agree.
    """

    place: Anchor
    count: int


class Finder:
    """Owns the hypothesis of the search; used by the thread of the frame path.

    Counts are added to those of the owner: ``searches``, ``searches_found``, ``searches_failed``, ``found_again``,
    ``tracks_dropped``.
    """

    def __init__(
        self,
        options: SearchOptions,
        seeker: Seeker,
        tracker: Tracker,
        tracker_options: TrackerOptions,
        georeference: Georeference,
        camera: Camera,
        counts: Counter[str],
    ) -> None:
        """
        Args:
            tracker_options: how far the odometry is to be believed.
            camera: of the pictures that the seeker is given; frames are brought to its size.
        """
        self._options, self._seeker, self._tracker = options, seeker, tracker
        self._tracker_options, self._georeference = tracker_options, georeference
        self._camera, self._counts = camera, counts
        self._asked: _Asked | None = None
        # Of the next check of a track; and of any search after one that could not be made.
        self._due_ns = self._retry_ns = 0
        # Since when nothing has said where the vehicle is; None before the first frame.
        self._lost_since_ns: int | None = None
        self._hypothesis: _Hypothesis | None = None
        self._corners: FloatArray | None = None
        self._demanded = False
        self._searches = 0
        self._former: list[tuple[Anchor, Sequence[Candidate]]] = []
        self._notices: list[str] = []
        self._lost_told = self._trouble_told = False
        self.says = ""

    def close(self) -> None:
        """End what is under way."""
        self._seeker.close()

    def retune(self, options: TrackerOptions) -> None:
        """Believe the odometry so far from now on."""
        self._tracker_options = options

    def search_in(self, corners_map: FloatArray | None, now_ns: int) -> None:
        """Search at once, whatever GNSS and the track say, only inside this polygon (N, 2) of map coordinates until it
        is found there; None: everywhere."""
        self._corners, self._hypothesis, self._retry_ns, self._demanded = corners_map, None, now_ns, True
        self._former, self._lost_since_ns = [], 0
        # What is under way looks elsewhere.
        self._asked = None

    def take_notices(self) -> list[str]:
        """What the pilot should hear, once."""
        notices, self._notices = self._notices, []
        return notices

    def is_lost(self, now_ns: int) -> bool:
        """Whether there was no fix for long."""
        since_ns = self._lost_since_ns
        return since_ns is not None and now_ns - since_ns > self._options.lost_after_s * _S

    def step(self, frame: Frame, state: VehicleState, outcome: Outcome, now_ns: int) -> FoundPosition | None:
        """To be called with every frame that was localized or refused, after the tracker has heard of it.

        Args:
            state: of the vehicle at the exposure.
            now_ns: of the clock of the stamps.
        Returns: for the tracker, where the search has won.
        """
        if self._lost_since_ns is None:
            self._lost_since_ns = now_ns
        if isinstance(outcome, Fix):
            self._lost_since_ns, self._lost_told = now_ns, False
        if self._gnss_tells(state) and not self._demanded:
            # It says where the vehicle is: there is nothing to be found, and what was found meanwhile is not needed.
            self._hypothesis, self._lost_since_ns, self.says, self._asked = None, now_ns, "", None
            self._seeker.take()
            return None
        order = self._hear(now_ns)
        if self._seeker.idle and self._asked is None and now_ns >= self._retry_ns:
            unfit = isinstance(outcome, Rejected) and outcome.reason in _UNFIT
            check = self._options.duty > 0.0 and now_ns >= self._due_ns
            if (check or self._demanded or self.is_lost(now_ns)) and not unfit:
                self._ask(frame, state, now_ns)
        return order

    def _gnss_tells(self, state: VehicleState) -> bool:
        position = state.position_map_m
        return position is not None and bool(np.isfinite(position).all()) and self._tracker.witness.trusted

    # -- asking ----------------------------------------------------------------------------------------

    def _ask(self, frame: Frame, state: VehicleState, now_ns: int) -> None:
        mount = self._tracker.mount(state)
        height_m = self._height_m(state)
        if mount is None or height_m is None or state.ned_from_body is None:
            self.says = "nothing says how high the vehicle is" if height_m is None else "no attitude"
            return
        lost = self.is_lost(now_ns)
        turn = frames.map_from_ned_rotation(self._georeference.convergence_rad(self._about()))
        map_from_body = turn @ state.ned_from_body
        lever = map_from_body @ mount.body_from_camera.translation
        sigma_rad = math.hypot(state.attitude_sigma_rad[2], mount.sigma_rad[1])
        sighting = Sighting(
            _of_size(frame.image, self._camera),
            self._camera,
            map_from_body @ mount.body_from_camera.rotation,
            min(max(_HEADING_SIGMAS * sigma_rad, _LEAST_HEADING_RAD), math.pi),
            math.nan,
            height_m + float(lever[2]),
        )
        within = self._within(now_ns) if lost or self._corners is not None else None
        self._searches += 1
        self._counts["searches"] += 1
        self._asked = _Asked(state, mount)
        if lost and not self._lost_told:
            self._lost_told = True
            self._notices.append("OrthoLoC: no fix, searching the map")
        self._seeker.ask(Ask(frame.stamp_ns, sighting, within, self._helpful(state)))

    def _about(self) -> FloatArray:
        """(2,) where convergence and scale of the grid are taken from."""
        anchor = self._tracker.anchor
        return np.array(self._georeference.anchor) if anchor is None else anchor.position_map_m[:2]

    def _height_m(self, state: VehicleState) -> float | None:
        """Of the body: as it was at the last known place, and how much it climbed; else as the autopilot believes."""
        anchor = self._tracker.anchor
        if anchor is not None:
            moved = moved_map_m(anchor, state, self._georeference)
            if moved is not None:
                return float(anchor.position_map_m[2] + moved[2])
        believed = state.believed_map_m
        return None if believed is None or not math.isfinite(believed[2]) else float(believed[2])

    def _within(self, now_ns: int) -> FloatArray | None:
        """Where a vehicle that is lost can be; None: anywhere."""
        if self._corners is not None:
            return self._corners
        anchor = self._tracker.anchor
        if anchor is None or self._searches % _EVERYWHERE == _EVERYWHERE - 1:
            return None
        elapsed_s = max(now_ns - anchor.stamp_ns, 0) / _S
        off_m = _AREA_M + _AREA_SIGMAS * cov.horizontal_sigma(anchor.covariance)
        return circle(anchor.position_map_m[:2], off_m + self._options.max_speed_m_per_s * elapsed_s)

    def _helpful(self, state: VehicleState) -> tuple[Former, ...]:
        """Earlier frames, where it is known how the vehicle has moved since."""
        helpful = []
        for anchor, candidates in self._former:
            moved = moved_map_m(anchor, state, self._georeference)
            if moved is not None and state.stamp_ns - anchor.stamp_ns <= _FORMER_S * _S:
                helpful.append(Former(candidates, moved[:2]))
        return tuple(helpful)

    # -- hearing ---------------------------------------------------------------------------------------

    def _hear(self, now_ns: int) -> FoundPosition | None:
        answer = self._seeker.take()
        if answer is None:
            return None
        asked, self._asked = self._asked, None
        # What was begun before somebody said where to look is of no use any more.
        if asked is None:
            return None
        lost = self.is_lost(now_ns)
        if self._options.duty > 0.0:
            self._due_ns = now_ns + round(answer.took_s * (1.0 / self._options.duty - 1.0) * _S)
        if answer.trouble:
            self._retry_ns = now_ns + round(_AFTER_FAILURE_S * _S)
            self._counts["searches_failed"] += 1
            self.says = answer.trouble
            if not self._trouble_told:
                self._trouble_told = True
                self._notices.append("OrthoLoC: the map can't be searched, see log")
            return None
        unknown = np.zeros((3, 3))
        here = anchor_at(asked.state, np.append(self._about(), 0.0), unknown, unknown, firm=False)
        self._former = [*self._former, (here, answer.own)][-_FORMER:]
        if isinstance(answer.outcome, Rejected):
            self.says = f"not found: {answer.outcome.reason.value}"
            return None
        self._counts["searches_found"] += 1
        return self._weigh(answer.outcome, asked, lost)

    def _weigh(self, fix: Fix, asked: _Asked, lost: bool) -> FoundPosition | None:
        map_from_body = fix.map_from_camera @ asked.mount.body_from_camera.inverse()
        moved = cov.of_moved_point(fix.covariance, map_from_body.translation - fix.map_from_camera.translation)
        state, position, covariance = asked.state, map_from_body.translation, moved[:3, :3]
        place = anchor_at(state, position, covariance, covariance, firm=True, drift_m_per_s=LOST_DRIFT_M_PER_S)
        anchor = self._tracker.anchor
        if not lost and anchor is not None and self._same(anchor, place, state):
            self._hypothesis, self._corners, self._demanded = None, None, False
            self.says = "the search finds the track's place"
            return None
        before = self._hypothesis
        count = before.count + 1 if before is not None and self._same(before.place, place, state) else 1
        needed = self._options.agreements if lost else self._options.against
        away_m = math.nan if anchor is None else self._away_m(anchor, place, state)
        self.says = f"found {_told(away_m)}, {count} of {needed}"
        if count < needed:
            self._hypothesis = _Hypothesis(place, count)
            return None
        self._hypothesis, self._corners, self._former, self._demanded = None, None, [], False
        what = "found again" if lost else "track dropped: the search finds it elsewhere"
        self._counts["found_again" if lost else "tracks_dropped"] += 1
        why = f"{what}, {_told(away_m)}, {count} times in a row"
        self._notices.append(f"OrthoLoC: {'found' if lost else 'track dropped, found'} {_told(away_m)}")
        return _order(place, why)

    def _same(self, anchor: Anchor, place: Anchor, state: VehicleState) -> bool:
        """Whether an anchor, carried to where a frame was found, is there."""
        _, covariance = carried(anchor, state, self._tracker_options, self._georeference)
        limit_m = _SAME_M + _SAME_SIGMAS * cov.horizontal_sigma(covariance + place.covariance)
        return limit_m <= _SAYS_NOTHING_M and self._away_m(anchor, place, state) <= limit_m

    def _away_m(self, anchor: Anchor, place: Anchor, state: VehicleState) -> float:
        position, _ = carried(anchor, state, self._tracker_options, self._georeference)
        return float(np.linalg.norm((position - place.position_map_m)[:2]))


def _order(place: Anchor, why: str) -> FoundPosition:
    x, y, z = place.position_map_m.tolist()
    (a, b, c), (d, e, f), (g, h, i) = place.covariance.tolist()
    odometry = None
    if place.odometry_ned_m is not None:
        north, east, down = place.odometry_ned_m.tolist()
        odometry = (north, east, down)
    return FoundPosition(
        stamp_ns=place.stamp_ns,
        position_map_m=(x, y, z),
        covariance=((a, b, c), (d, e, f), (g, h, i)),
        odometry_ned_m=odometry,
        odometry_epoch=place.odometry_epoch,
        why=why,
    )


def _of_size(image: ImageArray, camera: Camera) -> ImageArray:
    """In grey, as large as the camera's pictures are."""
    grey = grey_of(image)
    if grey.shape == (camera.height, camera.width):
        return grey
    size = camera.width, camera.height
    return np.asarray(cv2.resize(grey, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def _told(away_m: float) -> str:
    return f"{away_m:.0f} m off" if math.isfinite(away_m) else "without a prior"
