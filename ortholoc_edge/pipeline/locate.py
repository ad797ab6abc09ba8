"""A frame of which nothing is known but attitude and height, to a fix or a rejection: search, then look closely.

The search says where the frame may be; the localizer, with each of these places as a tight prior, whether it is there.
A fix goes out only where one place alone convinces both.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Final

import numpy as np
from msgspec import Meta, Struct

from ortholoc_edge.errors import MapError
from ortholoc_edge.geometry import rotation
from ortholoc_edge.geometry.arrays import FloatArray
from ortholoc_edge.geometry.camera import Camera
from ortholoc_edge.geometry.rigid import Rigid3
from ortholoc_edge.pipeline.frame import Frame
from ortholoc_edge.pipeline.localizer import Localizer
from ortholoc_edge.pipeline.outcome import Fix, Outcome, Reason, Rejected
from ortholoc_edge.pipeline.prior import PosePrior
from ortholoc_edge.pipeline.search import Candidate, Former, Searcher, Sighting, agreeing, fitting_level
from ortholoc_edge.tiles.coarse import CoarseField
from ortholoc_edge.tiles.lattice import Bounds
from ortholoc_edge.tiles.store import MapStore

# Of a candidate's place, in pixels of the field, of its heading and of its height above ground: half a step of what was
# tried, and what relief adds.
_PLACE_SIGMA_PX: Final = 2.0
_TURN_SIGMA_RAD: Final = math.radians(2.0)
_HEIGHT_SIGMA: Final = 0.04
# Of an attitude that nothing else is said of.
_TILT_SIGMA_RAD: Final = math.radians(1.0)
_KEPT_LEVELS: Final = 2
_LOW_PERCENT: Final = 10.0
# Of a frame, that later ones of the flight can make something of.
_KEPT: Final = 60
# What candidates of two frames may be apart for the same place: pixels of the field, and a part of how far the vehicle
# has come.
_AGREE_PX: Final = 5.0
_AGREE_RATIO: Final = 0.05
# Logistic regression, for whether the best place is right: of the logarithm of its score over the next place's, of its
# score, and a constant (docs/studies/search.md).
_CHANCE: Final = (28.3, 18.4, -6.2)
_MOST_LOG_LEAD: Final = 1.0
# Fixes closer than this part of the height above ground are of one place.
_SAME_PLACE: Final = 0.1


class LocateOptions(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How sure a place must be.

    ``candidates``: of the search, that are looked at closely.
    ``near_best``: part of the best one's score, below which a candidate is not.
    ``min_support``: `Fix.quality`, below which a fix counts for nothing. The gate's own limit is for the one place that
        a prior means; of many places in which the search found likeness some pass it. Of 150 hostile frames five did,
        with 0.127 at most; the least of 384 right ones is 0.21 (docs/studies/search.md).
    ``min_lead``: score of the place that is right over that of the best other one, at least.
    ``sure_lead``: where the best one has that much over the next and is right, no other is looked at.
    """

    candidates: Annotated[int, Meta(ge=1, le=100)] = 5
    near_best: Annotated[float, Meta(ge=0, le=1)] = 0.6
    min_support: Annotated[float, Meta(ge=0, le=1)] = 0.2
    min_lead: Annotated[float, Meta(ge=0)] = 1.05
    sure_lead: Annotated[float, Meta(ge=1)] = 1.3


@dataclass(frozen=True, slots=True, eq=False)
class Located:
    """What a frame came to.

    Attributes:
        outcome: the fix, or why there is none.
        candidates: of the search, the best first; with what earlier frames say of them, where they decided.
        own: of the frame alone: what a later one wants to know of it.
        tried: what the localizer said of the first of them, as many as it was asked about.
        lead: score of the place that is meant, over that of the best other one; 0 where there is none.
        chance: that the best candidate is right, before the localizer was asked, see `chance`.
    """

    outcome: Outcome
    candidates: list[Candidate]
    tried: list[Outcome]
    lead: float
    own: list[Candidate]

    @property
    def chance(self) -> float:
        return chance(self.candidates)


def chance(candidates: Sequence[Candidate]) -> float:
    """Probability that the best of the candidates of one frame is right, if the place is in the map at all.

    Fitted to a barometer's heights; where the height above ground is known, scores are higher and it is too sure.
    """
    if not candidates:
        return 0.0
    first = candidates[0].score
    next_ = candidates[1].score if len(candidates) > 1 else 0.0
    log_lead = min(math.log(first / next_), _MOST_LOG_LEAD) if next_ > 0.0 else _MOST_LOG_LEAD
    by_lead, by_score, constant = _CHANCE
    return 1.0 / (1.0 + math.exp(-(by_lead * log_lead + by_score * first + constant)))


class Searchers:
    """Those of a map, one for each scale of flight, made when it is needed first; the last two are kept. Used by one
    thread."""

    def __init__(self, store: MapStore, threads: int, within: Bounds | None = None, max_mb: float = 256.0) -> None:
        """
        Args:
            within: (west, south, east, north), m, of the map to look in at all; None: all of it.
            max_mb: of memory for one.
        """
        self._store, self._threads, self._within, self._max_mb = store, threads, within, max_mb
        self._made: dict[int, Searcher] = {}

    def suiting(self, camera: Camera, above_ground_m: float, height_m: float) -> Searcher:
        """Over the level of the orthophoto that suits the height of a frame.

        Args:
            above_ground_m, height_m: as of `Sighting`.
        Raises: MapError where that level is too large for the memory that is allowed, or there is no map.
        """
        store, above_m = self._store, above_ground_m
        if not math.isfinite(above_m):
            # Over low ground, where a frame shows most: a level finer takes four times the time and memory, and over
            # high ground less of the frame's detail will do.
            low_m = float(np.percentile([tile.min_m for tile in store.pack.manifest.dsm.tiles], _LOW_PERCENT))
            above_m = max(height_m - low_m, 1.0)
        level = fitting_level(store.dop_grids, camera, above_m)
        if level in self._made:
            return self._made[level]
        gsd_m = store.dop_grids[level].gsd_m
        west, south, east, north = self._within or store.bounds
        # The field and its half.
        needed_mb = 2.5 * (east - west) * (north - south) / gsd_m**2 / 1e6
        if needed_mb > self._max_mb:
            raise MapError(
                f"{store.pack.path}: from {above_m:.0f} m it must be searched at {gsd_m:g} m per pixel, which takes "
                f"{needed_mb:.0f} MB, and {self._max_mb:.0f} are allowed; search a part, fly higher, or allow more"
            )
        if len(self._made) == _KEPT_LEVELS:
            self._made.pop(next(iter(self._made))).close()
        made = self._made[level] = Searcher(CoarseField.of(store, level, self._within), self._threads)
        return made

    def close(self) -> None:
        """End their threads."""
        for searcher in self._made.values():
            searcher.close()


def locate(
    frame: Frame,
    sighting: Sighting,
    searcher: Searcher,
    localizer: Localizer,
    options: LocateOptions | None = None,
    proceed: Callable[[], bool] = lambda: True,
    within: FloatArray | None = None,
    former: Sequence[Former] = (),
) -> Located:
    """Where a frame was taken.

    Args:
        sighting: the same frame in grey, and what is known of its pose.
        within: see `Searcher.search`.
        former: what earlier frames of the flight came to, of which the same was known.
        proceed: asked before each candidate; False ends it as LATE.
    Raises: ModelError if a matcher itself fails.
    """
    options = options or LocateOptions()
    own = searcher.search(sighting, _KEPT, within)
    if not own:
        why = "the frame shows too little ground, or nothing on it, for the map's coarse scale"
        return Located(Rejected(frame.stamp_ns, Reason.FEW_MATCHES, why), own, [], 0.0, own)
    seen: dict[Candidate, Outcome] = {}

    def look(candidate: Candidate) -> Outcome:
        # The same place, whatever the sequence makes of its score.
        key = replace(candidate, score=0.0)
        if key not in seen:
            prior = _prior(candidate, sighting, searcher)
            if prior is None:
                why = "the surface model has no data there"
                seen[key] = Rejected(frame.stamp_ns, Reason.MAP_NODATA, why)
            else:
                seen[key] = localizer.localize(frame, prior)
        return seen[key]

    alone = _looked_at(frame.stamp_ns, own, own, look, options, proceed)
    if not former or isinstance(alone.outcome, Fix) or not proceed():
        return alone
    # What is known of the motion may be wrong: a frame that tells by itself needs none of it.
    moved_m = max(float(np.linalg.norm(one.moved_m)) for one in former)
    together = agreeing(own, former, _AGREE_PX * searcher.field.grid.gsd_m + _AGREE_RATIO * moved_m)
    sequence = _looked_at(frame.stamp_ns, together, own, look, options, proceed)
    return sequence if isinstance(sequence.outcome, Fix) else alone


def _looked_at(
    stamp_ns: int,
    candidates: list[Candidate],
    own: list[Candidate],
    look: Callable[[Candidate], Outcome],
    options: LocateOptions,
    proceed: Callable[[], bool],
) -> Located:
    """What the best candidates come to, at least one of them, when the localizer looks."""
    tried: list[Outcome] = []
    for candidate in candidates[: options.candidates]:
        if candidate.score < options.near_best * candidates[0].score:
            break
        if not proceed():
            late = Rejected(stamp_ns, Reason.LATE, f"{len(tried)} of {len(candidates)} places were looked at")
            return Located(late, candidates, tried, 0.0, own)
        tried.append(look(candidate))
        alone = len(candidates) == 1 or candidates[0].score >= options.sure_lead * candidates[1].score
        if alone and isinstance(_enough(tried[0], options), Fix):
            break
    outcome, lead = judged(stamp_ns, candidates, tried, options)
    return Located(outcome, candidates, tried, lead, own)


def _enough(outcome: Outcome, options: LocateOptions) -> Outcome:
    if isinstance(outcome, Rejected) or outcome.quality >= options.min_support:
        return outcome
    detail, least = "part of the view that agrees, of a place that was searched for", options.min_support
    return Rejected(outcome.stamp_ns, Reason.LOW_INLIER_RATIO, detail, outcome.quality, least, outcome.timings_ms)


def judged(
    stamp_ns: int, candidates: list[Candidate], tried: list[Outcome], options: LocateOptions
) -> tuple[Outcome, float]:
    """What the localizer said of the first candidates, at least of one, put together; and `Located.lead`."""
    enough = [_enough(outcome, options) for outcome in tried]
    fixes = [(place, outcome) for place, outcome in zip(candidates, enough, strict=False) if isinstance(outcome, Fix)]
    if not fixes:
        first = enough[0]
        assert isinstance(first, Rejected), "there are no fixes"
        why = replace(first, detail=f"none of {len(tried)} likely places; at the likeliest: {first.detail}")
        return why, 0.0
    meant, fix = fixes[0]
    apart_m = _SAME_PLACE * meant.above_ground_m
    for _, other in fixes[1:]:
        if _apart_m(fix, other) > apart_m:
            why = Rejected(stamp_ns, Reason.AMBIGUOUS, "another place fits too, m away", _apart_m(fix, other), apart_m)
            return why, 0.0
    others = [place.score for place in candidates if place.distance_m(meant) > 2.0 * apart_m]
    lead = meant.score / max(others) if others else math.inf
    if lead < options.min_lead:
        why = Rejected(
            stamp_ns, Reason.AMBIGUOUS, "fit of the place over that of the best other", lead, options.min_lead
        )
        return why, lead
    return fix, lead


def _apart_m(fix: Fix, other: Fix) -> float:
    return float(np.linalg.norm(fix.map_from_camera.translation[:2] - other.map_from_camera.translation[:2]))


def _prior(candidate: Candidate, sighting: Sighting, searcher: Searcher) -> PosePrior | None:
    """None where the ground's height is not known."""
    above_m, place = candidate.above_ground_m, np.array([candidate.easting_m, candidate.northing_m])
    height_m = sighting.height_m
    if not math.isfinite(height_m):
        height_m = float(searcher.field.ground_m(place[None])[0]) + above_m
    if not math.isfinite(height_m):
        return None
    turned = rotation.exp([0.0, 0.0, candidate.turn_rad]) @ sighting.map_from_camera
    place_m = math.hypot(_PLACE_SIGMA_PX * searcher.field.grid.gsd_m, _TILT_SIGMA_RAD * above_m)
    height_sigma_m = _HEIGHT_SIGMA * above_m
    sigmas = [place_m, place_m, height_sigma_m, _TILT_SIGMA_RAD, _TILT_SIGMA_RAD, _TURN_SIGMA_RAD]
    return PosePrior(Rigid3(turned, np.append(place, height_m)), np.diag(np.square(sigmas)))
