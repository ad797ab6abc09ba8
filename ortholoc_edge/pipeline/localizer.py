"""One frame and where to look for it, to a fix or a rejection. Holds no state from frame to frame."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Annotated, Literal

import numpy as np
from msgspec import Meta, Struct, field, structs

from ortholoc_edge.errors import ConfigError, MapError
from ortholoc_edge.geometry import homography
from ortholoc_edge.geometry.arrays import FloatArray, ImageArray
from ortholoc_edge.geometry.camera import Camera
from ortholoc_edge.geometry.grid import resize_px
from ortholoc_edge.matching.adhop import fit_homography
from ortholoc_edge.matching.types import (
    AnyMatcher,
    Features,
    Matcher,
    Matches,
    ReducibleMatcher,
    Structural,
    UnscaledMatcher,
)
from ortholoc_edge.pipeline import gate, precondition, structural, surface
from ortholoc_edge.pipeline.frame import Frame, grey_of
from ortholoc_edge.pipeline.outcome import Fix, Outcome, Reason, Rejected
from ortholoc_edge.pipeline.precondition import ReferenceView
from ortholoc_edge.pipeline.prior import (
    MAX_HYPOTHESES,
    MAX_RANGE_HEIGHTS,
    PosePrior,
    RegionPrior,
    footprint,
    hypotheses,
    search_bounds,
)
from ortholoc_edge.pipeline.render import Terrain
from ortholoc_edge.pipeline.rounds import RejectedError, Round, Scene, Solved
from ortholoc_edge.pipeline.stored import Attempt, StoredMatching
from ortholoc_edge.pipeline.trace import Trace
from ortholoc_edge.pose import calibrate, pnp
from ortholoc_edge.pose.lift import lift
from ortholoc_edge.tiles.features import FeatureIndex
from ortholoc_edge.tiles.georeference import LocalFrame
from ortholoc_edge.tiles.lattice import Bounds
from ortholoc_edge.tiles.manifest import Manifest
from ortholoc_edge.tiles.store import MapStore, WindowTooLargeError
from ortholoc_edge.tiles.window import MapWindow

logger = logging.getLogger(__name__)

# Paper, "Initial Camera Calibration / Localization": matches below are dropped, where the matcher has one.
MIN_CONFIDENCE = 0.5
_MIN_MATCHES = 12
# Where only the typical height of the ground is asked for: a coarse level spares decoding the finest.
_GROUND_GSD_M = 4.0
# A map picture finer than the frame is no use; a coarser one than this is hard to match (field-notes, scale).
_MAX_COARSENING = 3.0
_UNSTATED_SIGMA_PX = 0.5
# Of the resolution of a matcher of features, on the rungs of its ladder; what XFeat loses by it: docs/profile.md.
FEATURE_SCALES = (1.0, 0.75, 0.5)
# Of one frame the principal point can't be told from the tilt; `calibrate-focal` has many.
_ONLY_FOCAL = calibrate.Unknowns(principal_point_sigma=0.0)
# Part of the gate's least number and ratio of inliers that a round with stored features needs before the last, which
# must have them all; and if the round before had not, so many times their number. Around poses 60 m wrong the last
# found up to 19 that agree, around right ones of 27 to 41 inliers 127 to 233 (seneca).
_BEFORE_LOOKING_AGAIN = 0.67
_AFTER_LOOKING_AGAIN = 2


class LocalizerOptions(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How a frame is localized.

    ``adhop``: match a second time in the orthophoto warped by the first matches' homography.
    ``search_sigmas``: how far around the predicted footprint the map is read.
    ``max_window_mpx``: limit of that part of the map, in million DOP pixels.
    ``homography_threshold_px``: of AdHoP's RANSAC, at 1024 px. 5, 10 and 20 px gave a recall of 98, 96 and 95 % on
    seneca.
    ``calibrate``: solve for the focal length too.
    ``precomputed_features``: match with the pack's, where it has some and there is a predicted pose. "auto": where they
    give no fix, the network looks at the map; "require": it never does; "never": it always does.
    """

    adhop: bool = True
    search_sigmas: Annotated[float, Meta(gt=0, le=10)] = 2.5
    max_window_mpx: Annotated[float, Meta(gt=0, le=64)] = 6.0
    homography_threshold_px: Annotated[float, Meta(gt=0)] = 5.0
    calibrate: bool = False
    precomputed_features: Literal["auto", "never", "require"] = "auto"
    gate: gate.GateOptions = field(default_factory=gate.GateOptions)


@dataclass(frozen=True, slots=True, eq=False)
class _MapScene:
    """A scene with its orthophoto.

    Attributes:
        window: as read.
        views: pictures of it to match against.
    """

    scene: Scene
    window: MapWindow
    views: list[ReferenceView]


@dataclass(frozen=True, slots=True, eq=False)
class _Detail:
    """With what frames are localized on one rung.

    Attributes:
        tracking: structural matching's part; None: not wanted.
        acquire: matcher of features; None: structural matching alone.
        working: pinhole camera of the size at which the matcher sees the frame; views of the map are drawn at the same
            size.
        stored: with the pack's features, where it has some that fit the matcher and they are wanted.
    """

    tracking: structural.QueryMaker | None
    acquire: Matcher | None
    working: Camera
    stored: StoredMatching | None


@dataclass(frozen=True, slots=True, eq=False)
class Matched:
    """A frame's matches with the map.

    Attributes:
        query_px: (M, 2) pixels of the frame as it is; points_map: (M, 3).
        local: metric frame around them.
        adhop_accepted: whether they are those of AdHoP's round.
    """

    query_px: FloatArray
    points_map: FloatArray
    local: LocalFrame
    adhop_accepted: bool


class Localizer:
    """Camera, map and matcher, put to work on one frame at a time by one thread."""

    def __init__(
        self,
        camera: Camera,
        store: MapStore,
        matcher: AnyMatcher,
        options: LocalizerOptions,
        ladder: Sequence[structural.Tuning] = structural.LADDER,
    ) -> None:
        """
        Args:
            ladder: of structural matching: what `localize` may be told to do with, full detail first. A matcher of
                features has `FEATURE_SCALES`, unless its network has a size of its own.
        """
        self.camera = camera
        acquire = matcher.acquire if isinstance(matcher, Structural) else matcher
        if options.calibrate and acquire is None:
            raise ConfigError(
                "structural matching takes the focal length as it is; to calibrate name a matcher of features, say "
                "xfeat"
            )
        self._store = store
        self._options = options
        self._max_error_px = pnp.threshold_px(camera)
        self._map_covariance = _map_covariance(store.pack.manifest)
        # The frame's features are extracted while the map's part is read, warped and extracted.
        self._worker = ThreadPoolExecutor(1, thread_name_prefix="query-features")
        tracks = isinstance(matcher, Structural) and not options.calibrate
        tracking = [structural.QueryMaker(camera, tuning) for tuning in ladder] if tracks else []
        self._details = self._made_details(tracking, ladder[0].levels[-1].long_px, acquire)
        # That of the frame at hand.
        self._detail = self._details[0]

    def _made_details(
        self, tracking: list[structural.QueryMaker], structural_px: int, acquire: Matcher | None
    ) -> list[_Detail]:
        """Raises: MapError if stored features are required and there are none."""
        index = self._feature_index(acquire)
        scales = FEATURE_SCALES if isinstance(acquire, ReducibleMatcher) else (1.0,)
        details = []
        for rung in range(len(tracking) or len(scales)):
            scale = scales[min(rung, len(scales) - 1)]
            matcher = acquire.reduced(scale) if scale < 1.0 and isinstance(acquire, ReducibleMatcher) else acquire
            working = self._working_camera(structural_px if matcher is None else matcher.working_px)
            stored = None
            if index is not None:
                assert isinstance(matcher, UnscaledMatcher), "the index checks it"
                stored = StoredMatching(self.camera, working, matcher, self._store, index, self._judged)
            details.append(_Detail(tracking[rung] if tracking else None, matcher, working, stored))
        return details

    def _working_camera(self, working_px: int) -> Camera:
        scale = min(1.0, working_px / max(self.camera.width, self.camera.height))
        return self.camera.pinhole().resized(
            max(1, round(self.camera.width * scale)), max(1, round(self.camera.height * scale))
        )

    def _feature_index(self, acquire: Matcher | None) -> FeatureIndex | None:
        """Of the pack's features, where it has some that fit the matcher and they are wanted.

        Raises: MapError if they are required and there are none.
        """
        wanted = self._options.precomputed_features
        if wanted == "never" or (wanted == "auto" and self._store.pack.manifest.features is None):
            return None
        if acquire is None:
            if wanted == "require":
                raise MapError("structural matching has no use for stored features; name a matcher of features, too")
            return None
        try:
            return FeatureIndex(self._store, acquire)
        except MapError as error:
            if wanted == "require":
                raise
            logger.warning("%s; the network looks at the map instead", error)
            return None

    def close(self) -> None:
        self._worker.shutdown()

    def retune(self, limits: gate.GateOptions) -> None:
        """Judge the next frames by other limits."""
        self._options = structs.replace(self._options, gate=limits)

    def warm_up(self) -> None:
        """Extract from a picture and match it with itself: what is allocated and compiled at first use is ready then.

        Raises: ModelError if the matcher itself fails.
        """
        # Something like noise, because of an even picture no matcher asks its network; not numpy.random's, which would
        # stay in memory (3 MB) for this alone. The factor is 2^32 over the golden ratio: a multiplicative hash.
        pixels = np.arange(self.camera.height * self.camera.width, dtype=np.uint32) ** 2 * np.uint32(2654435769)
        picture = (pixels >> np.uint32(24)).astype(np.uint8).reshape(self.camera.height, self.camera.width)
        for detail in self._details:
            if detail.tracking is not None:
                detail.tracking.fields(picture)
            if detail.acquire is not None:
                features = detail.acquire.extract(picture)
                detail.acquire.match(features, features)

    @property
    def matcher(self) -> Matcher:
        """Of features; structural matching alone never asks for it."""
        assert self._detail.acquire is not None, "a localizer without a matcher of features needs none"
        return self._detail.acquire

    @property
    def _working(self) -> Camera:
        return self._detail.working

    @property
    def rungs(self) -> int:
        """In how many ways, of less and less detail, a frame can be localized."""
        return len(self._details)

    @property
    def working_camera(self) -> Camera:
        """Of the size at which frames are matched in full detail, without distortion."""
        return self._details[0].working

    def height_above_ground_m(self, prior: PosePrior) -> float | None:
        """Of the predicted camera over the surface around it; None where the map has none."""
        position = prior.map_from_camera.translation
        ground_m = self._store.ground_near(position[:2], _GROUND_GSD_M)
        return None if ground_m is None else float(position[2]) - ground_m

    def localize(
        self,
        frame: Frame,
        prior: PosePrior | RegionPrior,
        proceed: Callable[[], bool] = lambda: True,
        rung: int = 0,
    ) -> Outcome:
        """The frame's pose, or why there is none.

        Args:
            proceed: asked before each further hypothesis of a wide prior; False ends the search as LATE.
            rung: of the ladder, 0 to ``rungs - 1``; 0 is full detail.
        Raises: ModelError if the matcher itself fails.
        """
        trace = Trace()
        self._detail = self._details[rung]
        try:
            return self._localize(frame, prior, proceed, trace)
        except RejectedError as stop:
            return Rejected(frame.stamp_ns, stop.reason, stop.detail, stop.measured, stop.limit, trace.timings_ms())
        except WindowTooLargeError as error:
            return Rejected(frame.stamp_ns, Reason.PRIOR_TOO_WIDE, str(error), timings_ms=trace.timings_ms())

    def matched(self, frame: Frame, prior: PosePrior | RegionPrior) -> Matched | Rejected:
        """The matches of features with a height, right and wrong ones, that no gate has judged: for a calibration,
        which may tell more from many photos than from one.

        Raises: ModelError if the matcher itself fails.
        """
        trace = Trace()
        self._detail = self._details[0]
        try:
            query = self._worker.submit(self._query_features, self.matcher, self._checked_grey(frame), trace)
            try:
                scene, first = self._first_round(query, prior, lambda: True, trace)
                second = self._second_round(first, query, scene, trace)
            finally:
                query.cancel()
        except RejectedError as stop:
            return Rejected(frame.stamp_ns, stop.reason, stop.detail, stop.measured, stop.limit, trace.timings_ms())
        except WindowTooLargeError as error:
            return Rejected(frame.stamp_ns, Reason.PRIOR_TOO_WIDE, str(error), timings_ms=trace.timings_ms())
        solved = (second or first).solved
        return Matched(
            self.camera.project(self.camera.pinhole().unproject(solved.query_px)),
            solved.points_map,
            scene.scene.local,
            second is not None,
        )

    def _localize(
        self, frame: Frame, prior: PosePrior | RegionPrior, proceed: Callable[[], bool], trace: Trace
    ) -> Fix:
        detail = self._detail
        grey = self._checked_grey(frame)
        only_stored = self._options.precomputed_features == "require"
        if detail.tracking is not None and not only_stored:
            if not isinstance(prior, PosePrior):
                refused = RejectedError(Reason.NO_PRIOR, "structural matching needs a predicted pose")
            else:
                try:
                    with trace.stage("structural"):
                        fix = self._by_structure(detail.tracking, frame, grey, prior, proceed, trace)
                    return replace(fix, timings_ms=trace.timings_ms())
                except RejectedError as error:
                    refused = error
            if detail.acquire is None or not proceed():
                raise refused
        if detail.stored is not None and isinstance(prior, PosePrior):
            try:
                return self._by_stored_features(detail.stored, frame, grey, prior, proceed, trace)
            except RejectedError as error:
                if only_stored or error.reason is Reason.LATE or not proceed():
                    raise
        elif only_stored:
            raise RejectedError(Reason.NO_PRIOR, "stored features need a predicted pose")
        return self._by_network(frame, grey, prior, proceed, trace, detail.tracking)

    def _by_structure(
        self,
        tracking: structural.QueryMaker,
        frame: Frame,
        grey: ImageArray,
        prior: PosePrior,
        proceed: Callable[[], bool],
        trace: Trace,
    ) -> Fix:
        """The fix without local features."""
        query = self._worker.submit(self._query_fields, tracking, grey, trace)
        try:
            scene, terrain, outline = self._terrain(tracking, prior, trace)
            found = self._track(query.result(), tracking.tuning, terrain, prior, outline, proceed, trace)
        finally:
            query.cancel()
        if (found is None or not found.plausible) and not proceed():
            raise RejectedError(Reason.LATE, "the search ended before anything convinced")
        return self._structural_fix(frame, found, scene, prior, trace)

    def _terrain(
        self, tracking: structural.QueryMaker, prior: PosePrior, trace: Trace
    ) -> tuple[Scene, Terrain, FloatArray]:
        """The part of the map around a pose, ready for drawing, and the view's footprint (K, 2)."""
        with trace.stage("map_window"):
            ground_m, outline = self._predicted_ground(prior)
            gsd_m = self._distance_to_ground(prior, ground_m) / tracking.finest.focal_px
            window = self._read(search_bounds(outline, prior, ground_m, self._options.search_sigmas), gsd_m)
            local = self._local_frame(window, ground_m)
            terrain = Terrain.of(window, local)
        if terrain is None:
            raise RejectedError(Reason.MAP_NODATA, "the surface model has no data under the predicted view")
        return Scene(window, local, ground_m), terrain, outline

    def _structural_fix(
        self, frame: Frame, found: structural.Track | None, scene: Scene, prior: PosePrior, trace: Trace
    ) -> Fix:
        """What a track is worth, judged by the gate."""
        if found is None:
            raise RejectedError(Reason.FEW_MATCHES, "the map in the predicted view looks nothing like the frame")
        with trace.stage("gate"):
            refusal = (
                gate.with_contrast(found.contrast, found.support, self._options.gate)
                or gate.with_support(found.support, self._options.gate)
                or gate.without_rival(found.rival, self._options.gate)
            )
            if refusal is not None:
                raise RejectedError(refusal.reason, refusal.detail, refusal.measured, refusal.limit)
            solved = Solved(
                found.query_px, scene.local.map_from_local(found.points_local), found.estimate, len(found.query_px)
            )
            limits = gate.for_structure(found.support, self._options.gate)
            fix = self._fix(frame, solved, scene, prior, limits)
            # After the gate: what is less certain must not pass the more easily.
            unsettled_m = surface.unsettled_m(
                scene.window.dsm, scene.window.dsm_grid, fix.points_map, found.support
            )
            ground = surface.unsettled_covariance(unsettled_m, fix.points_map, fix.map_from_camera.translation)
        return replace(
            fix, quality=found.support, covariance=fix.covariance + ground, ground_covariance=ground
        )

    def _refined(
        self,
        tracking: structural.QueryMaker,
        frame: Frame,
        grey: ImageArray,
        acquired: Round,
        scene: Scene,
        prior: PosePrior,
        trace: Trace,
    ) -> Fix | None:
        """A pose that features gave, followed by structural matching: AdHoP's second look in three dimensions. None
        where it finds nothing or fails the gate.

        The outcome is judged by the prediction, and not by the pose that it came from: that is of the same picture.
        """
        estimate = acquired.estimate
        if estimate is None or not acquired.is_convincing:
            return None
        start = scene.local.map_from_local_pose(estimate.local_from_camera)
        try:
            near, terrain, _ = self._terrain(tracking, PosePrior(start, estimate.covariance), trace)
            query = self._query_fields(tracking, grey, trace)
            track = structural.Tracking(query, terrain, prior, self.camera, trace, tracking.tuning).run(start=start)
            return self._structural_fix(frame, track, near, prior, trace)
        except (RejectedError, WindowTooLargeError):
            return None

    def _track(
        self,
        query: structural.QueryFields,
        tuning: structural.Tuning,
        terrain: Terrain,
        prior: PosePrior,
        outline: FloatArray,
        proceed: Callable[[], bool],
        trace: Trace,
    ) -> structural.Track | None:
        """From the prior, and if that does not convince from narrower ones that cover it."""
        best = structural.Tracking(query, terrain, prior, self.camera, trace, tuning).run(proceed)
        if best is not None and best.convincing:
            return best
        for hypothesis in hypotheses(prior, float(np.ptp(outline, axis=0).min())) or []:
            if hypothesis is prior or not proceed():
                break
            found = structural.Tracking(query, terrain, hypothesis, self.camera, trace, tuning).run(proceed)
            if found is not None and (best is None or found.inliers > best.inliers):
                best = found
            if best is not None and best.convincing:
                break
        return best

    def _query_fields(self, tracking: structural.QueryMaker, grey: ImageArray, trace: Trace) -> structural.QueryFields:
        with trace.stage("query_features"):
            return tracking.fields(grey)

    def _by_network(
        self,
        frame: Frame,
        grey: ImageArray,
        prior: PosePrior | RegionPrior,
        proceed: Callable[[], bool],
        trace: Trace,
        tracking: structural.QueryMaker | None,
    ) -> Fix:
        """The fix from local features of frame and map.

        Args:
            tracking: to refine it by structural matching where that can be, in place of AdHoP.
        """
        query = self._worker.submit(self._query_features, self.matcher, grey, trace)
        try:
            scene, first = self._first_round(query, prior, proceed, trace)
            if tracking is not None and isinstance(prior, PosePrior):
                with trace.stage("refine"):
                    refined = self._refined(tracking, frame, grey, first, scene.scene, prior, trace)
                if refined is not None:
                    return replace(refined, timings_ms=trace.timings_ms())
            second = self._second_round(first, query, scene, trace)
        finally:
            query.cancel()
        with trace.stage("gate"):
            fix = self._fix(frame, (second or first).solved, scene.scene, prior)
        return replace(
            fix,
            adhop_accepted=second is not None if self._options.adhop else None,
            timings_ms=trace.timings_ms(),
        )

    def _checked_grey(self, frame: Frame) -> ImageArray:
        shape, camera = frame.image.shape, self.camera
        size = camera.height, camera.width
        if frame.image.dtype != np.uint8 or shape not in (size, (*size, 3)):
            raise RejectedError(
                Reason.BAD_FRAME,
                f"{frame.name}: {shape[:2]} {frame.image.dtype}, but the camera's intrinsics are for "
                f"{camera.width} x {camera.height} px of 8 bit",
            )
        return grey_of(frame.image)

    def _query_features(self, matcher: Matcher, grey: ImageArray, trace: Trace) -> Features:
        with trace.stage("query_features"):
            return matcher.extract(grey)

    def _by_stored_features(
        self,
        stored: StoredMatching,
        frame: Frame,
        grey: ImageArray,
        prior: PosePrior,
        proceed: Callable[[], bool],
        trace: Trace,
    ) -> Fix:
        """The fix without the network on the map. A round must pass the gate before pairs are looked for around its
        pose, since those will agree with it."""
        limits = self._options.gate
        lenient = gate.lenient(limits, _BEFORE_LOOKING_AGAIN)
        first = self._first_attempt(stored, grey, prior, proceed, trace)
        again = before = None
        if self._options.adhop:
            try:
                before = self._fix(frame, first.found.solved, first.scene, prior, lenient)
            except RejectedError:
                first = stored.rectified_again(grey, first, self._homography_threshold_px, trace)
                before = self._fix(frame, first.found.solved, first.scene, prior, lenient)
            again = stored.looked_again(first, trace)
        with trace.stage("gate"):
            fix = self._fix(frame, (again or first.found).solved, first.scene, prior)
            if before is not None and (before.inliers < limits.min_inliers or before.quality < limits.min_inlier_ratio):
                needed = _AFTER_LOOKING_AGAIN * limits.min_inliers
                if fix.inliers < needed:
                    raise RejectedError(Reason.FEW_INLIERS, "after looking again", fix.inliers, needed)
        return replace(
            fix,
            # Of pairs that were looked for around a pose most agree with it.
            quality=fix.quality if before is None else before.quality,
            stored_features=True,
            adhop_accepted=again is not None if self._options.adhop else None,
            timings_ms=trace.timings_ms(),
        )

    def _first_attempt(
        self, stored: StoredMatching, grey: ImageArray, prior: PosePrior, proceed: Callable[[], bool], trace: Trace
    ) -> Attempt:
        """As `_first_round`; every stored feature that the prior allows takes part, so no view is widened."""
        with trace.stage("map_window"):
            ground = self._predicted_ground(prior)
        best: Attempt | None = None
        refused: RejectedError | None = None
        for number, (hypothesis, widen) in enumerate(self._attempts(prior, ground[1])):
            if widen and hypothesis is prior:
                continue
            if number > 0 and not proceed():
                raise RejectedError(Reason.LATE, f"{number} hypotheses were tried without one that convinces")
            try:
                ground_m, outline = ground if hypothesis is prior else self._predicted_ground(hypothesis)
                bounds = search_bounds(outline, hypothesis, ground_m, self._options.search_sigmas)
                gsd_m = self._distance_to_ground(hypothesis, ground_m) / self._working.focal_px
                self._coarsest_m(bounds, gsd_m)
                attempt = stored.attempt(grey, hypothesis, bounds, outline, ground_m, gsd_m, trace)
            except RejectedError as error:
                refused = refused or error
                continue
            if best is None or attempt.found.inliers > best.found.inliers:
                best = attempt
            if attempt.found.is_convincing:
                break
        if best is None:
            raise refused or RejectedError(Reason.PRIOR_TOO_WIDE, "there is nothing to look at")
        return best

    # -- where to look ---------------------------------------------------------------------------------

    def _hypotheses(self, prior: PosePrior, outline: FloatArray) -> list[PosePrior]:
        footprint_m = float(np.ptp(outline, axis=0).min())
        found = hypotheses(prior, footprint_m)
        if found is None:
            raise RejectedError(
                Reason.PRIOR_TOO_WIDE,
                f"heading within {math.degrees(prior.heading_sigma_rad):.0f} deg (1 sigma), views {footprint_m:.0f} m "
                f"wide: more than {MAX_HYPOTHESES} to try; horizontal 1-sigma, m",
                prior.position_sigma_m,
            )
        return found

    def _scene_of_pose(
        self, prior: PosePrior, ground: tuple[float, FloatArray] | None, widen: bool, trace: Trace
    ) -> _MapScene:
        with trace.stage("map_window"):
            ground_m, outline = ground or self._predicted_ground(prior)
            gsd_m = self._distance_to_ground(prior, ground_m) / self._working.focal_px
            window = self._read(search_bounds(outline, prior, ground_m, self._options.search_sigmas), gsd_m)
        with trace.stage("view"):
            local = self._local_frame(window, ground_m)
            plane = precondition.ground_plane(window, local, outline)
            if plane is None:
                raise RejectedError(Reason.MAP_NODATA, "the surface model has no data under the predicted view")
            view = precondition.predicted_view(window, local, plane, self._working, prior, widen)
            if not view.valid.any():
                raise RejectedError(Reason.MAP_NODATA, "the orthophoto has no data in the predicted view")
        scene = Scene(window, local, ground_m, view.working_from_dop, view.max_shift_px)
        return _MapScene(scene, window, [view])

    def _scene_of_region(self, prior: RegionPrior, trace: Trace) -> _MapScene:
        with trace.stage("map_window"):
            west, south, east, north = prior.bounds_map
            window = self._read(prior.bounds_map, max(east - west, north - south) / self.matcher.working_px)
            known = window.dsm[np.isfinite(window.dsm)]
            if not len(known):
                raise RejectedError(Reason.MAP_NODATA, "the surface model has no data in the region")
            ground_m = float(np.median(known))
        with trace.stage("view"):
            views = precondition.quarter_turns(window)
        return _MapScene(Scene(window, self._local_frame(window, ground_m), ground_m), window, views)

    def _predicted_ground(self, prior: PosePrior) -> tuple[float, FloatArray]:
        """Typical height of the surface in the predicted view, and the view's footprint (K, 2) on it."""
        pose = prior.map_from_camera
        ground_m = self._store.ground_near(pose.translation[:2], _GROUND_GSD_M)
        if ground_m is None:
            raise RejectedError(
                Reason.OUTSIDE_MAP,
                f"no surface model near the predicted position ({pose.translation[0]:.0f}, {pose.translation[1]:.0f})",
            )
        outline = np.empty((0, 2))
        for _ in range(2):
            height_m = float(pose.translation[2]) - ground_m
            if height_m <= 0:
                raise RejectedError(
                    Reason.PRIOR_DISAGREES,
                    "the predicted camera lies below the surface model; check the vertical datum of pack and autopilot",
                    height_m,
                    0.0,
                )
            outline = footprint(self.camera, pose, ground_m)
            heights = self._store.heights(outline, _GROUND_GSD_M)
            if np.isfinite(heights).any():
                ground_m = min(float(np.nanmedian(heights)), float(pose.translation[2]) - 0.2 * height_m)
        return ground_m, outline

    def _distance_to_ground(self, prior: PosePrior, ground_m: float) -> float:
        """Along the optical axis, at most `MAX_RANGE_HEIGHTS` heights."""
        height_m = float(prior.map_from_camera.translation[2]) - ground_m
        falling = -float(prior.map_from_camera.rotation[2, 2])
        return height_m / max(falling, 1.0 / MAX_RANGE_HEIGHTS)

    def _coarsest_m(self, bounds: Bounds, gsd_m: float) -> float:
        """Pixel of the map at which a region is within `max_window_mpx`.

        Raises: RejectedError if that is too coarse for a frame of ``gsd_m``. Stored features are as many as pixels
            were: without this limit a prior of 150 m asks for hundreds of thousands.
        """
        west, south, east, north = bounds
        limit = self._options.max_window_mpx * 1e6
        # The store may give a level finer by a factor of two than was asked for.
        coarsest_m = math.sqrt((east - west) * (north - south) / limit) * 2.0
        if coarsest_m > _MAX_COARSENING * gsd_m:
            raise RejectedError(
                Reason.PRIOR_TOO_WIDE,
                f"the search would cover {east - west:.0f} x {north - south:.0f} m; pixel for the matcher, m",
                coarsest_m,
                _MAX_COARSENING * gsd_m,
            )
        return coarsest_m

    def _read(self, bounds: Bounds, gsd_m: float) -> MapWindow:
        west, south, east, north = bounds
        window = self._store.read(bounds, max(gsd_m, self._coarsest_m(bounds, gsd_m)))
        if window is None:
            raise RejectedError(
                Reason.OUTSIDE_MAP,
                f"({west:.0f}, {south:.0f}) to ({east:.0f}, {north:.0f}) does not meet the pack",
            )
        if not window.dop_valid.any():
            raise RejectedError(Reason.MAP_NODATA, "the orthophoto has no data in the region")
        return window

    def _local_frame(self, window: MapWindow, ground_m: float) -> LocalFrame:
        west, south, east, north = window.dop_grid.bounds
        return self._store.pack.georeference.local_frame(((west + east) / 2, (south + north) / 2), ground_m)

    # -- matching and pose -----------------------------------------------------------------------------

    def _first_round(
        self, query: Future[Features], prior: PosePrior | RegionPrior, proceed: Callable[[], bool], trace: Trace
    ) -> tuple[_MapScene, Round]:
        """The best of what there is to try; the first that convinces ends the search."""
        if isinstance(prior, RegionPrior):
            scene = self._scene_of_region(prior, trace)
            return scene, self._round(query, scene, trace)
        with trace.stage("map_window"):
            ground = self._predicted_ground(prior)
        best: tuple[_MapScene, Round] | None = None
        refused: RejectedError | None = None
        is_wide = True
        for number, (hypothesis, widen) in enumerate(self._attempts(prior, ground[1])):
            if number > 0 and hypothesis is prior and not is_wide:
                # Not wide enough to be widened: it would be the first attempt again.
                continue
            if number > 0 and not proceed():
                raise RejectedError(Reason.LATE, f"{number} hypotheses were tried without one that convinces")
            try:
                scene = self._scene_of_pose(hypothesis, ground if hypothesis is prior else None, widen, trace)
            except RejectedError as error:
                refused = refused or error
                continue
            is_wide = is_wide and scene.views[0].can_widen
            found = self._round(query, scene, trace)
            if best is None or found.inliers > best[1].inliers:
                best = scene, found
            if found.is_convincing:
                break
        if best is None:
            raise refused or RejectedError(Reason.PRIOR_TOO_WIDE, "there is nothing to look at")
        return best

    def _attempts(self, prior: PosePrior, outline: FloatArray) -> Iterator[tuple[PosePrior, bool]]:
        """Priors to look from, and whether the view is to show more than the camera. The plain predicted view
        comes first, whatever the prior says: a wider picture is a smaller one, and matches less."""
        yield prior, False
        for hypothesis in self._hypotheses(prior, outline):
            yield hypothesis, True

    def _second_round(
        self, first: Round, query: Future[Features], scene: _MapScene, trace: Trace
    ) -> Round | None:
        """AdHoP's, if it is wanted and better."""
        if not self._options.adhop:
            return None
        with trace.stage("adhop"):
            return self._adhop(first, query.result(), scene)

    def _round(self, query: Future[Features], scene: _MapScene, trace: Trace) -> Round:
        """Match all pictures of a scene and solve the one with the most matches (paper: "selecting the one
        with most correspondences")."""
        best: tuple[Matches, ReferenceView] | None = None
        for view in scene.views:
            with trace.stage("map_features"):
                features = self.matcher.extract(view.image, view.valid)
            query_features = query.result()
            with trace.stage("match"):
                matches = self.matcher.match(query_features, features)
            if best is None or len(matches) > len(best[0]):
                best = matches, view
        assert best is not None, "a scene has at least one view"
        with trace.stage("pose"):
            return self._solved(*best, scene.scene)

    def _near_prediction(self, matches: Matches, scene: Scene) -> Matches:
        """Without the matches (frame and grid pixels) that the prior rules out: they would only outvote others.

        After matching and not inside it: among only the allowed pairs, mutual neighbours by chance lie close
        enough together to agree on a wrong pose (measured on seneca: one error of 5 m that passed the gate).
        """
        if scene.working_from_dop is None:
            return matches
        scale = self._working.width / self.camera.width, self._working.height / self.camera.height
        expected = homography.warp_points(scene.working_from_dop, matches.map_px)
        shift = np.linalg.norm(resize_px(matches.query_px, scale) - expected, axis=1)
        return matches.take(np.flatnonzero(shift <= scene.max_shift_px))

    def _adhop(self, first: Round, query: Features, scene: _MapScene) -> Round | None:
        """The paper's refinement: None unless the second round's mean reprojection error is smaller."""
        fitted = fit_homography(first.matches.map_px, first.matches.query_px, self._homography_threshold_px)
        if fitted is None:
            return None
        working = self._working
        scale = working.width / self.camera.width, working.height / self.camera.height
        # Pixels of the frame to pixels of the matcher's size: (k + 0.5) s - 0.5.
        shrink = np.array(
            [
                [scale[0], 0.0, 0.5 * scale[0] - 0.5],
                [0.0, scale[1], 0.5 * scale[1] - 0.5],
                [0.0, 0.0, 1.0],
            ]
        )
        view = precondition.warped(
            scene.window.dop_grey, scene.window.dop_valid, shrink @ fitted[0], working.width, working.height
        )
        matches = self.matcher.match(query, self.matcher.extract(view.image, view.valid))
        second = self._solved(matches, view, scene.scene)
        return second if second.mean_error_px < first.mean_error_px else None

    def _solved(self, matches: Matches, view: ReferenceView, scene: Scene) -> Round:
        """A round's matches back on the orthophoto, filtered, lifted and solved."""
        matches = matches.take(np.flatnonzero(self.camera.contains(matches.query_px)))
        matches = Matches(self.camera.undistorted_px(matches.query_px), view.dop_px(matches.map_px), matches.confidence)
        return self._judged(matches, scene)

    def _judged(self, matches: Matches, scene: Scene) -> Round:
        """Matches of undistorted frame pixels with pixels of the scene's grid, filtered, lifted and solved."""
        # A pixel off the horizon, or in a corner where the lens model ends, has no counterpart.
        paired = np.isfinite(matches.map_px).all(axis=1) & np.isfinite(matches.query_px).all(axis=1)
        if matches.confidence is not None:
            paired &= matches.confidence >= MIN_CONFIDENCE
        matches = matches.take(np.flatnonzero(paired))
        matches = self._near_prediction(matches, scene)
        lifted = lift(matches.map_px, scene.window)
        estimate = None
        if len(lifted.kept) >= _MIN_MATCHES:
            points = scene.local.local_from_map(lifted.points_map)
            estimate = self._pose(points, matches.query_px[lifted.kept])
        mean_px = math.inf
        if estimate is not None:
            # A match behind the camera has no error in pixels; the image's diagonal stands for it.
            diagonal = math.hypot(self.camera.width, self.camera.height)
            mean_px = float(np.minimum(estimate.errors_px, diagonal).mean())
        return Round(matches, lifted.kept, lifted.points_map, estimate, mean_px)

    @property
    def _homography_threshold_px(self) -> float:
        return self._options.homography_threshold_px * self._max_error_px / pnp.THRESHOLD_PX

    def _pose(self, points_local: FloatArray, query_px: FloatArray) -> pnp.PoseEstimate | None:
        if self._options.calibrate:
            found = calibrate.solve([calibrate.View(points_local, query_px)], self.camera.pinhole(), _ONLY_FOCAL)
            estimate = None if found is None else found.views[0]
            # The pixels are those without distortion, which stays as it was configured.
            return estimate and replace(estimate, camera=replace(estimate.camera, distortion=self.camera.distortion))
        return pnp.solve(points_local, query_px, self.camera, max_error_px=self._max_error_px)

    # -- judgement -------------------------------------------------------------------------------------

    def _fix(
        self,
        frame: Frame,
        chosen: Solved,
        scene: Scene,
        prior: PosePrior | RegionPrior,
        limits: gate.GateOptions | None = None,
    ) -> Fix:
        """
        Args:
            limits: of the gate; None: as configured.
        """
        estimate = chosen.estimate
        if len(chosen.query_px) < _MIN_MATCHES:
            raise RejectedError(
                Reason.FEW_MATCHES,
                f"{chosen.matches} matches, of which with a height",
                len(chosen.query_px),
                _MIN_MATCHES,
            )
        if estimate is None:
            raise RejectedError(Reason.DEGENERATE_GEOMETRY, "the matches do not determine a pose")
        if estimate.focal_sigma_px is not None:
            relative = estimate.focal_sigma_px / estimate.camera.focal_px
            if relative > calibrate.MAX_RELATIVE_FOCAL_SIGMA:
                raise RejectedError(
                    Reason.DEGENERATE_GEOMETRY,
                    "focal length and height can't be told apart; relative 1-sigma of the focal length",
                    relative,
                    calibrate.MAX_RELATIVE_FOCAL_SIGMA,
                )
        pose = scene.local.map_from_local_pose(estimate.local_from_camera)
        covariance = estimate.covariance + self._map_covariance
        below = float(self._store.heights(pose.translation[None, :2], _GROUND_GSD_M)[0])
        height_m = float(pose.translation[2]) - (below if math.isfinite(below) else scene.ground_m)
        refusal = gate.check(
            estimate,
            chosen.query_px,
            pose,
            covariance,
            height_m,
            prior if isinstance(prior, PosePrior) else None,
            self._max_error_px,
            limits or self._options.gate,
        )
        if refusal is not None:
            raise RejectedError(refusal.reason, refusal.detail, refusal.measured, refusal.limit)
        inliers = estimate.inliers
        return Fix(
            stamp_ns=frame.stamp_ns,
            map_from_camera=pose,
            camera=estimate.camera,
            focal_sigma_px=estimate.focal_sigma_px,
            covariance=covariance,
            quality=float(inliers.mean()),
            matches=chosen.matches,
            inliers=int(np.count_nonzero(inliers)),
            rms_px=estimate.rms_px,
            adhop_accepted=None,
            query_px=chosen.query_px[inliers],
            points_map=chosen.points_map[inliers],
        )


def _map_covariance(manifest: Manifest) -> FloatArray:
    """(6, 6): what is wrong with the map alike everywhere, which no number of matches averages out.

    Half a pixel of either raster where the manifest does not state a sigma: how well the publisher's grids can
    be trusted at all.
    """
    planimetric_m = _UNSTATED_SIGMA_PX * manifest.dop.gsd_m if manifest.dop.sigma_m is None else manifest.dop.sigma_m
    vertical_m = _UNSTATED_SIGMA_PX * manifest.dsm.gsd_m if manifest.dsm.sigma_m is None else manifest.dsm.sigma_m
    vertical_m = math.hypot(vertical_m, manifest.dsm.max_z_error_m)
    return np.diag(np.square([planimetric_m, planimetric_m, vertical_m, 0.0, 0.0, 0.0]))
