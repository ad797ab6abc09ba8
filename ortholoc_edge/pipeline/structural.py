"""Tracking without weights: the frame against the map drawn in the predicted view, coarse to fine.

At each level the map is drawn over its surface model at the pose so far, the two pictures' edge directions are
correlated patch by patch, and the pose is adjusted to what was found, with the prediction as one more measurement. So
AdHoP's second look is taken in three dimensions, once per level. Where that does not convince, the view is searched for
among turns, scales and shifts that the prior allows.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product

import cv2
import numpy as np

from ortholoc_edge.geometry import covariance as cov
from ortholoc_edge.geometry import rotation
from ortholoc_edge.geometry.arrays import BoolArray, Float32Array, FloatArray, ImageArray
from ortholoc_edge.geometry.camera import Camera
from ortholoc_edge.geometry.grid import resize_px
from ortholoc_edge.geometry.rigid import Rigid3
from ortholoc_edge.matching import structural
from ortholoc_edge.matching.orientation import orientation_field
from ortholoc_edge.pipeline.prior import MAX_RANGE_HEIGHTS, PosePrior
from ortholoc_edge.pipeline.render import RenderedView, Terrain, render
from ortholoc_edge.pipeline.trace import Trace
from ortholoc_edge.pose.adjust import Adjusted, PoseMeasurement, adjust, linearised, moved, normal_equations
from ortholoc_edge.pose.pnp import PoseEstimate


@dataclass(frozen=True, slots=True)
class Level:
    """Long side of the picture; radius and cell of `structural.multiply`; cells per patch and stride of its patches."""

    long_px: int
    radius_px: int
    cell_px: int
    patch_cells: int
    stride: int = 1


@dataclass(frozen=True, slots=True)
class Tuning:
    """What docs/studies/structural.md settled, to be varied there.

    ``repeat_below``: part of a middle level's matches that agree, below which it is gone through again.
    ``attitude``: the prior's attitude takes part in the pose that goes out.
    ``match_covariance``: a patch counts by how sharp its peak is, and not as all others.
    ``sigma_px``: standard deviation of a patch's place, px of the level, before that of its peak.
    ``polish``: the last level's pose is where all cells together fit best.
    """

    levels: tuple[Level, ...] = (Level(128, 6, 8, 6), Level(256, 3, 8, 6, 2), Level(512, 2, 16, 3))
    repeat_below: float = 0.9
    attitude: bool = True
    match_covariance: bool = True
    sigma_px: float = 0.2
    polish: bool = True


TUNING = Tuning()
# From full detail to what a throttled processor can still do (docs/studies/structural.md: "Ladder").
LADDER = (
    TUNING,
    replace(TUNING, levels=(*TUNING.levels[:2], Level(384, 2, 12, 3))),
    replace(TUNING, levels=(TUNING.levels[0], Level(256, 3, 8, 3))),
)
# Of a patch, below which its peak is chance.
_MIN_SCORE = 0.2
# Side of the map's pixels in a level's: up to the first the map is sharp enough. What a coarser map lacks is taken
# from the frame by a blur (1-sigma, part of that side), and levels beyond the last are left out, but for so many: their
# patches would be a dozen of the map's pixels wide and less.
_AS_SHARP, _MAP_BLUR, _MAX_MAP_PX = 1.5, 0.6, 4.0
_COARSEST_PX = 16.0
_MIN_LEVELS = 2
# Standard deviation of the whole picture's shift, px of the level.
_WHOLE_SIGMA_PX = 2.0
# Scales of the robust loss in px: wide first, where the whole picture may still be turned by some degrees.
_FIRST_SCALES_PX = (6.0, 2.5, 1.2)
_LATER_SCALES_PX = (2.5, 1.0)
# Part of a view that must show map.
_MIN_VALID = 0.1
_MIN_MATCHES = 5
# Of matches that agree with the pose, px of the level. Chance spreads them over the radius.
_INLIER_PX = 1.0
_LAST_INLIER_PX = 0.8
# Shift of the whole view that is looked for, in sigmas of the prior, and its limits as parts of the long side.
_REACH_SIGMAS = 3.5
_MIN_REACH, _MAX_REACH = 0.08, 0.45
# Matches that agree at the last level (with a patch at every cell), and their part of the patches in view: from the
# lower part on a search around the same prior finds nothing better (676 frames, docs/studies/structural.md, "Support");
# from the higher, if so many of the matches agreed at each level, other priors need not be tried either.
_CONVINCING_MATCHES = 60
_PLAUSIBLE_SUPPORT, _CONVINCING_SUPPORT = 0.15, 0.35
_CONVINCING_BEFORE = 0.5
# Share of a level's matches, below which going on is a waste: chance alone gives the second level a tenth.
_HOPELESS = 0.2
# A search turns the view by steps of so many sigmas, within so many sigmas of the heading, and follows so many of the
# best peaks. What the prior makes improbable costs a peak so many of its standard deviations per squared sigma.
_SEARCH_SIGMAS = 2.5
_TURN_SIGMAS = 1.7
_MIN_TURN_RAD, _MAX_TURN_RAD = math.radians(3.0), math.radians(7.0)
_MAX_TURNS = 9
# Heights are tried in steps of this factor: half of it is what the first level's radius bears at the rim.
_ZOOM = 1.2
_MAX_ZOOMS = 7
_PEAKS_PER_TURN = 5
_IMPROBABLE = 0.2
_CANDIDATES = 6
# If they lead nowhere, so many are drawn anew, and so many of these followed to the second level.
_STARTS, _LOOKED_AT_AGAIN = 16, 2
# Poses that the second level makes the same of: apart by these parts of the height, and by this turn.
_ALIKE_HEIGHTS, _ALIKE_RAD = 0.015, math.radians(1.0)
# Support at the level before the last that leaves the other starts untried.
_PROMISING = 0.3
# A rival: one of so many peaks of the whole view's correlation at the second level, of so much of the height of the
# track's own, hardly less probable (squared sigmas), that ends elsewhere.
_RIVAL_PEAKS = 5
_RIVAL_PEAK = 0.6
_RIVAL_LESS_PROBABLE = 16.0
_OWN_PEAK_PX = 4.0
# Part of the track's support at the second level, below which a rival is not followed to the last.
_RIVAL_SUPPORT = 0.4
# Pixels of a field closer than this tell the same; and the highest correlation that counts.
_CORRELATED_PX = 3.0
_MAX_SCORE = 0.98
_POLISHES = 4
# In standard deviations: what moves the pose by less changes nothing.
_SMALL_CHANGE = 0.02
# Matches closer than a fifth of the long side share the errors of a patch of the map and of the camera's model.
_CLUSTERS_ACROSS = 5
# On the variance: errors that vary slowly are absorbed by the pose. With 2.5, as in `pose.pnp`, the real flights'
# normalised error averages 0.65 of what it should. The worse the patches fit, the more of them are another season's
# shadows and crowns, which err alike.
_ABSORBED_ERROR_FACTOR = 1.7
_DOUBTFUL_SCORE, _DOUBT_POWER = 0.38, 8
# Also where a prior claims to be exact there is something to divide by: 1 mm, 1e-5 rad.
_EXACT = np.diag([1e-6] * 3 + [1e-10] * 3)


@dataclass(frozen=True, slots=True, eq=False)
class QueryFields:
    """A frame as the levels see it: pinhole cameras, pictures (h, w) and fields (2, h, w) by level."""

    cameras: tuple[Camera, ...]
    pictures: tuple[ImageArray, ...]
    fields: tuple[Float32Array, ...]

    def as_sharp_as_a_map(self, map_px: Sequence[float]) -> QueryFields:
        """Without what is finer than a map: edges that the frame alone can have would drown the others. Levels where
        a patch is but a few pixels of the map go, fine ones that stay are blurred.

        Args:
            map_px: side of the map's pixels in each level's.
        """
        count = max(sum(side <= _MAX_MAP_PX for side in map_px), _MIN_LEVELS)
        if count >= len(self.cameras) and max(map_px) <= _AS_SHARP:
            return self
        fields = [
            orientation_field(_blurred(picture, side)) if side > _AS_SHARP else field
            for picture, field, side in zip(self.pictures[:count], self.fields, map_px, strict=False)
        ]
        return QueryFields(self.cameras[:count], self.pictures[:count], tuple(fields))


class QueryMaker:
    """Brings frames of one camera to the levels."""

    def __init__(self, camera: Camera, tuning: Tuning = TUNING) -> None:
        self.tuning = tuning
        pinhole = camera.pinhole()
        self._cameras = tuple(pinhole.resized(*_size(camera, level.long_px)) for level in tuning.levels)
        self._undistortion: tuple[np.ndarray, np.ndarray] | None = None
        if not camera.is_pinhole:
            last = self._cameras[-1]
            u, v = np.meshgrid(np.arange(last.width), np.arange(last.height))
            rays = last.unproject(np.stack([u, v], axis=-1))
            distorted = camera.resized(last.width, last.height).project(rays).astype(np.float32)
            self._undistortion = distorted[..., 0], distorted[..., 1]

    @property
    def finest(self) -> Camera:
        """Of the last level."""
        return self._cameras[-1]

    def fields(self, grey: ImageArray) -> QueryFields:
        """Of a frame (H, W)."""
        last = self._cameras[-1]
        image = np.asarray(cv2.resize(grey, (last.width, last.height), interpolation=cv2.INTER_AREA), dtype=np.uint8)
        if self._undistortion is not None:
            image = np.asarray(
                cv2.remap(image, *self._undistortion, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE),
                dtype=np.uint8,
            )
        pictures = [image]
        for camera in reversed(self._cameras[:-1]):
            image = np.asarray(
                cv2.resize(image, (camera.width, camera.height), interpolation=cv2.INTER_AREA), dtype=np.uint8
            )
            pictures.append(image)
        pictures.reverse()
        return QueryFields(self._cameras, tuple(pictures), tuple(orientation_field(picture) for picture in pictures))


def _blurred(image: ImageArray, map_px: float) -> ImageArray:
    # Under a camera that is thought to stand on the ground the map's pixels have no end.
    sigma_px = _MAP_BLUR * math.sqrt(min(map_px, _COARSEST_PX) ** 2 - 1.0)
    return np.asarray(cv2.GaussianBlur(image, (0, 0), sigma_px), dtype=np.uint8)


def _size(camera: Camera, long_px: int) -> tuple[int, int]:
    scale = long_px / max(camera.width, camera.height)
    return max(1, round(camera.width * scale)), max(1, round(camera.height * scale))


@dataclass(frozen=True, slots=True, eq=False)
class _Step:
    """One level's outcome: the view that was drawn and its field; matches (N) of level px and local points, how well
    they fit, how sure their places are, and which agree with the pose; how many patches were in view; and of the last
    level their contrast."""

    view: RenderedView
    template: Float32Array
    adjusted: Adjusted
    px: FloatArray
    points: FloatArray
    scores: FloatArray
    information: FloatArray
    inliers: BoolArray
    looked_for: int
    contrast: float = 0.0

    @property
    def pose(self) -> Rigid3:
        return self.adjusted.local_from_camera

    @property
    def agree(self) -> int:
        """How many matches agree with the pose."""
        return int(np.count_nonzero(self.inliers))

    @property
    def agreeing(self) -> float:
        """Their part of the matches."""
        return self.agree / max(len(self.inliers), 1)

    @property
    def support(self) -> float:
        """Their part of the patches in view."""
        return self.agree / max(self.looked_for, 1)


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """What the levels came to.

    Attributes:
        estimate: at the frame's full size.
        query_px: (M, 2) px of the frame without distortion; points_local: (M, 3).
        support: part of the patches in view that agree with the pose.
        contrast: how much better all cells in view fit there than beside it: `structural.Correlation.contrast`.
        plausible: whether other ways need not be tried around the same prior.
        convincing: whether they need not be tried anywhere.
        second: the second level's outcome.
        rival: inliers of the best track elsewhere, as a part of this one's.
    """

    estimate: PoseEstimate
    query_px: FloatArray
    points_local: FloatArray
    support: float
    contrast: float
    plausible: bool
    convincing: bool
    second: _Step
    rival: float = 0.0

    @property
    def inliers(self) -> int:
        return int(np.count_nonzero(self.estimate.inliers))


class Tracking:
    """A frame and where it is expected on a terrain.

    Args:
        camera: of the frame, at full size.
        prior: in map coordinates; its covariance bounds the search.
    """

    def __init__(
        self,
        query: QueryFields,
        terrain: Terrain,
        prior: PosePrior,
        camera: Camera,
        trace: Trace,
        tuning: Tuning = TUNING,
    ) -> None:
        self._terrain, self._prior, self._camera, self._trace = terrain, prior, camera, trace
        predicted = terrain.local.local_from_map_pose(prior.map_from_camera)
        with trace.stage("query_features"):
            self._query = query.as_sharp_as_a_map(_map_px(terrain, query, predicted))
        self._tuning = replace(tuning, levels=tuning.levels[: len(self._query.cameras)])
        covariance = prior.covariance + _EXACT
        self._predicted = PoseMeasurement(predicted, np.asarray(np.linalg.inv(covariance), dtype=np.float64))
        # The last word on the position has what was seen; the prediction only keeps the camera upright.
        upright = np.zeros((6, 6))
        if tuning.attitude:
            upright[3:, 3:] = np.linalg.inv(covariance[3:, 3:])
        self._upright = PoseMeasurement(predicted, upright)

    def run(self, proceed: Callable[[], bool] = lambda: True, start: Rigid3 | None = None) -> Track | None:
        """The track from the prediction if it is plausible, else that with the most inliers of it and the best start of
        a search; None if there is none.

        Args:
            proceed: asked before the search, each of its starts and the second look at them; False ends it.
            start: the frame's pose as something else has found it, in the map's coordinates: only that is followed. The
                prediction stays what the outcome is measured by.
        """
        if start is not None:
            return self._from(self._terrain.local.local_from_map_pose(start))
        return self._against_rivals(self._best(proceed))

    def _from(self, start: Rigid3) -> Track | None:
        approach = self._approach(start, [])
        return self._against_rivals(None if approach is None else self._arrive(approach))

    def _against_rivals(self, best: Track | None) -> Track | None:
        other = None if best is None else self._elsewhere(best)
        if best is None or other is None:
            return best
        if other.inliers > best.inliers:
            best, other = other, best
        return replace(best, rival=other.inliers / best.inliers)

    def _best(self, proceed: Callable[[], bool]) -> Track | None:
        approach = self._approach(self._predicted.local_from_camera, [], look_wide=True)
        best = None if approach is None else self._arrive(approach)
        if best is not None and best.plausible:
            return best
        starts = self._search() if proceed() else []
        for look in (self._likeliest, self._looked_at_again):
            # The last level costs as much as all before it: only the best of the starts gets there.
            approach = _most_promising(look(starts, proceed))
            found = None if approach is None else self._arrive(approach)
            if found is not None and (best is None or found.inliers > best.inliers):
                best = found
            if best is not None and best.plausible:
                break
        return best

    def _likeliest(self, starts: Sequence[Rigid3], proceed: Callable[[], bool]) -> Iterator[list[_Step] | None]:
        """The approaches from the first starts."""
        seen: list[Rigid3] = []
        for start in starts[:_CANDIDATES]:
            if not proceed():
                return
            yield self._approach(start, seen)

    def _looked_at_again(self, starts: Sequence[Rigid3], proceed: Callable[[], bool]) -> Iterator[list[_Step] | None]:
        """From all starts, each drawn anew before its shift is looked for: a peak far from the prediction is of a view
        that had little in common with the frame, and its place is but roughly right. Only those that fit best at the
        first level get to the second."""
        if not starts or not proceed():
            return
        drawn = (self._level(0, start, self._predicted, look_wide=True) for start in starts)
        firsts = sorted(
            (step for step in drawn if step is not None), key=lambda step: -float(step.scores[step.inliers].sum())
        )
        seen: list[Rigid3] = []
        for step in firsts:
            # Not asked again: to draw them all and then to follow none would be time for nothing.
            if len(seen) == _LOOKED_AT_AGAIN:
                return
            if not any(self._alike(step.pose, other) for other in seen):
                seen.append(step.pose)
                yield self._onward(step)

    def _elsewhere(self, best: Track) -> Track | None:
        """The best track that ends elsewhere: rows of trees or of panels fit one row further, too."""
        found_pose, second = best.estimate.local_from_camera, best.second
        peaks = self._shifted(second.view, second.template, self._query.fields[1], _RIVAL_PEAKS)
        own = max((peak for (x, y), peak, _ in peaks if math.hypot(x, y) <= _OWN_PEAK_PX), default=peaks[0][1])
        limit = self._improbability(found_pose) + _RIVAL_LESS_PROBABLE
        found: Track | None = None
        seen = [found_pose]
        for (x, y), peak, start in peaks:
            if math.hypot(x, y) <= _OWN_PEAK_PX or peak < _RIVAL_PEAK * own or self._improbability(start) > limit:
                continue
            approach = self._approach(start, seen)
            if approach is None or approach[-1].support < _RIVAL_SUPPORT * second.support:
                continue
            rival = self._arrive(approach)
            if rival is None or self._alike(rival.estimate.local_from_camera, found_pose):
                continue
            found = rival if found is None or rival.inliers > found.inliers else found
        return found

    def _improbability(self, pose: Rigid3) -> float:
        """Squared sigmas of a pose from the predicted one."""
        error = self._predicted.error(pose)
        return float(error @ self._predicted.information @ error)

    def _approach(self, pose: Rigid3, seen: list[Rigid3], look_wide: bool = False) -> list[_Step] | None:
        """Through all levels but the last; None where that leads nowhere, or where the first leads to a place seen.

        Args:
            seen: where the first level led others; its place is added.
            look_wide: whether the shift of the whole view is looked for before.
        """
        step = self._level(0, pose, self._predicted, look_wide)
        if step is None or any(self._alike(step.pose, other) for other in seen):
            return None
        seen.append(step.pose)
        return self._onward(step)

    def _onward(self, step: _Step) -> list[_Step] | None:
        """From the first level's outcome to the last level but one."""
        steps = [step]
        for number in range(1, len(self._tuning.levels) - 1):
            found = self._level(number, steps[-1].pose, self._predicted)
            if found is not None and found.agreeing < self._tuning.repeat_below:
                found = self._level(number, found.pose, self._predicted)
            if found is None or found.agreeing < _HOPELESS:
                return None
            steps.append(found)
        return steps

    def _alike(self, one: Rigid3, other: Rigid3) -> bool:
        """Whether poses are so near that the second level makes the same of them."""
        height_m = max(float(one.translation[2]) - self._terrain.lowest_m, 1e-3)
        turn_rad = float(np.linalg.norm(rotation.log(one.rotation @ other.rotation.T)))
        away_m = float(np.linalg.norm(one.translation - other.translation))
        return turn_rad < _ALIKE_RAD and away_m < _ALIKE_HEIGHTS * height_m

    def _arrive(self, approach: list[_Step]) -> Track | None:
        """The last level."""
        step = self._level(len(approach), approach[-1].pose, self._upright)
        if step is None or step.agreeing < _HOPELESS:
            return None
        return self._track([*approach, step])

    def _level(self, number: int, pose: Rigid3, known: PoseMeasurement, look_wide: bool = False) -> _Step | None:
        """Matches of one level with the map drawn at a pose, and the pose adjusted to them."""
        level, camera, field = self._tuning.levels[number], self._query.cameras[number], self._query.fields[number]
        with self._trace.stage("view"):
            view = render(self._terrain, camera, pose)
        if view.valid.mean() < _MIN_VALID:
            return None
        with self._trace.stage("map_features"):
            template = orientation_field(view.image, view.valid)
        whole: tuple[int, int] | None = None
        with self._trace.stage("match"):
            if look_wide:
                whole = self._likely_shift(view, template, field)
            products = structural.multiply(
                template, field, radius=level.radius_px, cell=level.cell_px, origin=whole or (0, 0)
            )
            found = products.patches(level.patch_cells, level.stride)
        with self._trace.stage("pose"):
            step = self._adjusted(number, view, found, template, known, pose, whole)
            if step is None or number < len(self._tuning.levels) - 1:
                return step
            cells = products.patches(1)
            points, shown = view.points_local(cells.template_px), _shown(view, cells.template_px)
            if self._tuning.polish:
                samples = (level.cell_px / _CORRELATED_PX) ** 2
                step = self._polished(view, cells, points, shown, known, step, samples)
            return replace(step, contrast=_contrast(view, cells, points, shown, step.pose))

    def _polished(
        self,
        view: RenderedView,
        found: structural.Correlation,
        points: FloatArray,
        shown: BoolArray,
        known: PoseMeasurement,
        step: _Step,
        samples: float,
    ) -> _Step:
        """The pose at which all cells together fit best, and not only the patches with a peak of their own.

        The likelihood of a cell of n independent samples at correlation r is ``(1 - r^2)^(-n/2)``; its slope and its
        expected curvature, of the cell's own sharpness, give Newton's step for the pose.

        Args:
            found: of single cells: they share no pixel, and one that shows what has changed spoils no neighbour.
            points, shown: (N, 3) local m and (N,) of the cells, and whether they show map.
            samples: independent ones of a cell.
        """
        pose, sharpness = step.pose, found.sharpness
        for _ in range(_POLISHES):
            shift, jacobian = linearised(points, found.template_px, view.camera, pose)
            score, slope, inside = found.at(np.where(np.isfinite(shift), shift, np.inf))
            score = np.where(inside & shown, np.clip(score, 0.0, _MAX_SCORE), 0.0)
            strength = samples * score / (1.0 - score**2)
            stiffness = (strength * score)[:, None, None] * sharpness
            normal, _ = normal_equations(jacobian, stiffness, np.zeros_like(shift))
            rise = (strength[:, None] * slope).ravel() @ jacobian.reshape(-1, 6)
            normal += known.information
            try:
                change = np.asarray(np.linalg.solve(normal, rise - known.information @ known.error(pose)), np.float64)
            except np.linalg.LinAlgError:
                return step
            if not np.isfinite(change).all():
                return step
            pose = moved(pose, change)
            if float(change @ normal @ change) < _SMALL_CHANGE**2:
                break
        residuals, jacobian = linearised(step.points, step.px, view.camera, pose)
        return replace(
            step,
            adjusted=replace(step.adjusted, local_from_camera=pose, residuals_px=residuals, jacobian=jacobian),
            inliers=np.asarray(np.linalg.norm(residuals, axis=1) <= _LAST_INLIER_PX),
        )

    def _likely_shift(self, view: RenderedView, template: Float32Array, field: Float32Array) -> tuple[int, int]:
        """Of the whole view: the highest peak, less what makes it improbable."""
        peaks = self._shifted(view, template, field, _PEAKS_PER_TURN)
        return max(peaks, key=lambda found: self._merit(found[1], found[2]))[0]

    def _shifted(
        self, view: RenderedView, template: Float32Array, field: Float32Array, count: int
    ) -> list[tuple[tuple[int, int], float, Rigid3]]:
        """Shifts of the whole view that correlate best, how well, and the poses that they mean."""
        middle = _middle_px(template)
        return [
            ((x, y), peak, _moved_sideways(view, middle, np.array([x, y], dtype=np.float64)))
            for x, y, peak in structural.whole_shift(template, field, self._reach_px(view), count)
        ]

    def _merit(self, peak: float, pose: Rigid3) -> float:
        """Of a peak: its height, less what makes its pose improbable."""
        return peak - _IMPROBABLE * self._improbability(pose)

    def _reach_px(self, view: RenderedView) -> int:
        """How far the whole view may be shifted by what the prior does not know, px."""
        camera = view.camera
        falling = max(-float(view.local_from_camera.rotation[2, 2]), 1.0 / MAX_RANGE_HEIGHTS)
        distance_m = max(float(np.median(view.fall_m)) / falling, 1e-3)
        sigma_px = camera.focal_px * math.hypot(
            self._prior.position_sigma_m / distance_m, self._prior.tilt_sigma_rad
        )
        long_px = max(camera.width, camera.height)
        return round(min(max(_REACH_SIGMAS * sigma_px, _MIN_REACH * long_px), _MAX_REACH * long_px))

    def _adjusted(
        self,
        number: int,
        view: RenderedView,
        found: structural.Correlation,
        template: Float32Array,
        known: PoseMeasurement,
        pose: Rigid3,
        whole: tuple[int, int] | None,
    ) -> _Step | None:
        level = self._tuning.levels[number]
        peaks = found.peaks()
        found_well = peaks.take(np.flatnonzero(_shown(view, peaks.template_px) & (peaks.score >= _MIN_SCORE)))
        px, seen_px = found_well.template_px, found_well.template_px + found_well.shift_px
        # Patches overlap: so many share their pixels.
        shared = max((level.patch_cells / level.stride) ** 2 / 4.0, 1.0)
        information = self._information(found_well) / shared
        if whole is not None:
            middle = _middle_px(template)
            px, seen_px = np.vstack([px, middle]), np.vstack([seen_px, middle + whole])
            information = np.concatenate([information, np.eye(2)[None] / _WHOLE_SIGMA_PX**2])
            pose = _moved_sideways(view, middle, np.asarray(whole, dtype=np.float64))
        points = view.points_local(px)
        scales = _FIRST_SCALES_PX if whole is not None else _LATER_SCALES_PX
        adjusted = adjust(
            points,
            seen_px,
            view.camera,
            pose,
            information=information,
            measured=known,
            scales=tuple(scale / (self._tuning.sigma_px * math.sqrt(shared)) for scale in scales),
        )
        if adjusted is None:
            return None
        # The whole view's shift was a help on the way, and is no match.
        adjusted = adjusted.take(len(found_well))
        limit = _LAST_INLIER_PX if number == len(self._tuning.levels) - 1 else _INLIER_PX
        inliers = np.linalg.norm(adjusted.residuals_px, axis=1) <= limit
        return _Step(
            view,
            template,
            adjusted,
            seen_px[: len(found_well)],
            points[: len(found_well)],
            found_well.score,
            information[: len(found_well)],
            np.asarray(inliers),
            int(np.count_nonzero(_shown(view, found.template_px))),
        )

    def _information(self, found: structural.Displacements) -> FloatArray:
        """(N, 2, 2) of the patches' places, px^-2, as if they shared no pixel."""
        covariance = np.broadcast_to(np.eye(2) * self._tuning.sigma_px**2, (len(found), 2, 2))
        if self._tuning.match_covariance:
            covariance = covariance + found.covariance
        return np.asarray(np.linalg.inv(covariance), dtype=np.float64)

    def _track(self, steps: list[_Step]) -> Track | None:
        last, camera = steps[-1], self._query.cameras[-1]
        covariance = self._covariance(last, camera)
        if covariance is None:
            return None
        scale = self._camera.width / camera.width, self._camera.height / camera.height
        errors = np.nan_to_num(np.linalg.norm(last.adjusted.residuals_px * scale, axis=1), nan=np.inf)
        estimate = PoseEstimate(
            last.pose,
            self._camera,
            covariance,
            last.inliers,
            errors,
            float(np.sqrt(np.mean(errors[last.inliers] ** 2))),
        )
        support = last.support
        enough = last.agree >= _CONVINCING_MATCHES / self._tuning.levels[-1].stride ** 2
        plausible = enough and support >= _PLAUSIBLE_SUPPORT
        convincing = (
            enough and support >= _CONVINCING_SUPPORT and all(step.agreeing >= _CONVINCING_BEFORE for step in steps)
        )
        query_px = resize_px(last.px, scale)
        return Track(estimate, query_px, last.points, support, last.contrast, plausible, convincing, steps[1])

    def _covariance(self, step: _Step, camera: Camera) -> FloatArray | None:
        """(6, 6): of what was seen, together with the attitude that was known; None if that determines no pose."""
        inliers = step.inliers
        if step.agree < _MIN_MATCHES:
            return None
        side = max(camera.width, camera.height) / _CLUSTERS_ACROSS
        column, row = np.floor(step.px[inliers] / side).astype(np.intp).T
        try:
            # Whitened, so that a patch along an edge counts across it.
            whitener = np.linalg.cholesky(step.information[inliers]).transpose(0, 2, 1)
            seen = _absorbed_error_factor(step.scores[inliers]) * cov.clustered(
                whitener @ step.adjusted.jacobian[inliers],
                np.einsum("nij,nj->ni", whitener, step.adjusted.residuals_px[inliers]),
                step.adjusted.weights[inliers],
                column * 10_000 + row,
            )
            full = np.linalg.inv(np.linalg.inv(seen) + self._upright.information)
        except np.linalg.LinAlgError:
            return None
        if not (np.isfinite(full).all() and np.all(np.diag(full) > 0)):
            return None
        return np.asarray(full, dtype=np.float64)

    def _search(self) -> list[Rigid3]:
        """Poses to start from, the most promising first: peaks of the whole view's correlation at the first level,
        over turns of the heading and heights, less what makes them improbable."""
        camera, field = self._query.cameras[0], self._query.fields[0]
        predicted = self._predicted.local_from_camera
        candidates: list[tuple[float, Rigid3]] = []
        with self._trace.stage("search"):
            for turn_rad, climb_m in product(_turns(self._prior.heading_sigma_rad), self._climbs(predicted)):
                turned = rotation.exp([0.0, 0.0, turn_rad]) @ predicted.rotation
                raised = predicted.translation + np.array([0.0, 0.0, climb_m])
                view = render(self._terrain, camera, Rigid3(turned, raised))
                if view.valid.mean() < _MIN_VALID:
                    continue
                template = orientation_field(view.image, view.valid)
                for _, peak, pose in self._shifted(view, template, field, _PEAKS_PER_TURN):
                    candidates.append((self._merit(peak, pose), pose))
        candidates.sort(key=lambda pair: -pair[0])
        return [pose for _, pose in candidates[:_STARTS]]

    def _climbs(self, predicted: Rigid3) -> list[float]:
        """Changes of height that cover what the prior allows, m."""
        height_m = max(float(predicted.translation[2]) - self._terrain.lowest_m, 1e-3)
        sigma = self._prior.height_sigma_m / height_m
        count = min(math.ceil(_SEARCH_SIGMAS * math.log1p(sigma) / math.log(_ZOOM) - 0.5), _MAX_ZOOMS // 2)
        return [height_m * (_ZOOM**k - 1.0) for k in range(-count, count + 1)]


def _most_promising(approaches: Iterable[list[_Step] | None]) -> list[_Step] | None:
    """That with the most matches that agree; the first with enough support ends the search."""
    best: list[_Step] | None = None
    for approach in approaches:
        if approach is not None and (best is None or approach[-1].agree > best[-1].agree):
            best = approach
        if best is not None and best[-1].support >= _PROMISING:
            break
    return best


def _map_px(terrain: Terrain, query: QueryFields, pose: Rigid3) -> list[float]:
    """Side of the map's pixels in each level's, in the middle of the view from a pose."""
    falling = max(-float(pose.rotation[2, 2]), 1.0 / MAX_RANGE_HEIGHTS)
    distance_m = max((float(pose.translation[2]) - terrain.typical_m) / falling, 1e-3)
    side_m = terrain.pictures[0].grid.gsd_m / terrain.local.grid_scale
    return [side_m * camera.focal_px / distance_m for camera in query.cameras]


def _turns(sigma_rad: float) -> list[float]:
    """Turns of the heading that cover what a prior allows, rad."""
    step = min(max(_TURN_SIGMAS * sigma_rad, _MIN_TURN_RAD), _MAX_TURN_RAD)
    count = min(math.ceil(_SEARCH_SIGMAS * sigma_rad / step - 0.5), _MAX_TURNS // 2)
    return [step * k for k in range(-count, count + 1)]


def _contrast(
    view: RenderedView, cells: structural.Correlation, points: FloatArray, shown: BoolArray, pose: Rigid3
) -> float:
    """Of all cells that show map, at a pose."""
    shift, _ = linearised(points, cells.template_px, view.camera, pose)
    shift = np.where(np.isfinite(shift), shift, np.inf)
    return cells.contrast(shift, shown)


def _absorbed_error_factor(scores: FloatArray) -> float:
    return _ABSORBED_ERROR_FACTOR * (1.0 + (_DOUBTFUL_SCORE / float(np.median(scores))) ** _DOUBT_POWER)


def _shown(view: RenderedView, px: FloatArray) -> BoolArray:
    """Which pixels (N, 2) of a view show map."""
    column, row = np.round(px).astype(np.intp).T
    return np.asarray(view.valid[row, column])


def _middle_px(field: Float32Array) -> FloatArray:
    """(1, 2): centre of what there is to see in a field."""
    energy = np.square(field).sum(axis=0)
    total = max(float(energy.sum()), 1e-9)
    x = float(energy.sum(axis=0) @ np.arange(energy.shape[1])) / total
    y = float(energy.sum(axis=1) @ np.arange(energy.shape[0])) / total
    return np.array([[x, y]])


def _moved_sideways(view: RenderedView, px: FloatArray, shift_px: FloatArray) -> Rigid3:
    """The view's pose, moved across its optical axis so that what it shows at ``px`` (1, 2) is shown shifted."""
    pose, camera = view.local_from_camera, view.camera
    depth_m = float((view.points_local(px)[0] - pose.translation) @ pose.rotation[:, 2])
    across = np.append(shift_px / (camera.fx, camera.fy), 0.0) * depth_m
    return Rigid3(pose.rotation, pose.translation - pose.rotation @ across)
