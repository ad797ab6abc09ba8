"""Whether the last few frames together fix what one does not, and by what they are to be judged (window.md).

    python docs/studies/window.py make OUT --seed 3 --lines 30      photos along lines, in the format of a flight
    python docs/studies/window.py statistics OUT --dull 0.3,2,6     what tells right poses from wrong ones
    python docs/studies/window.py chains OUT --dull 0.38,1.7,5      frame after frame, as in flight
    python docs/studies/window.py chains OUT --hostile mirrored     the same where nothing may be found

``--dull CONTRAST,BLUR,NOISE`` makes photos weak: contrast times a factor, a blur in px (1-sigma) at 640 px, noise in
grey levels (1-sigma).
"""

from __future__ import annotations

import argparse
import math
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np
from tqdm import tqdm

from ortholoc_edge.bench import sequence
from ortholoc_edge.geometry import covariance as cov
from ortholoc_edge.geometry import frames, rotation
from ortholoc_edge.geometry.arrays import BoolArray, FloatArray, ImageArray
from ortholoc_edge.geometry.camera import Camera
from ortholoc_edge.geometry.rigid import Rigid3
from ortholoc_edge.matching import structural as correlating
from ortholoc_edge.matching.orientation import orientation_field
from ortholoc_edge.matching.types import Structural
from ortholoc_edge.pipeline import gate, precondition, structural
from ortholoc_edge.pipeline.frame import Frame
from ortholoc_edge.pipeline.localizer import Localizer, LocalizerOptions
from ortholoc_edge.pipeline.outcome import Fix
from ortholoc_edge.pipeline.prior import PosePrior, search_bounds
from ortholoc_edge.pipeline.render import RenderedView, Terrain, render
from ortholoc_edge.pipeline.rounds import RejectedError
from ortholoc_edge.pipeline.trace import Trace
from ortholoc_edge.pose.adjust import PoseMeasurement, _geman_mcclure, linearised, moved, normal_equations
from ortholoc_edge.tiles.build import PackOptions, build_pack
from ortholoc_edge.tiles.georeference import LocalFrame
from ortholoc_edge.tiles.pack import Pack
from ortholoc_edge.tiles.store import MapStore
from ortholoc_sim import crossdomain

PER_LINE = 8
OVERLAP = (0.6, 0.8)
# Errors, 1-sigma: of a whole line (position as parts of the height; tilt, tilt, heading), of each frame's attitude, and
# of a leg as a part of its length per axis. The tracker is told 1.25 times the last, as in `bench.replay`.
LINE_POSITION = np.array([0.06, 0.06, 0.04])
LINE_RAD = np.radians([0.7, 0.7, 3.0])
FRAME_RAD = np.radians([0.7, 0.7, 0.5])
LEG, RESERVE = 0.015, 1.25
# Of the statistic of `contrast`, for a window, and for it without its best frame.
CONTRAST, CONTRAST_OF_OTHERS = 5.5, 3.3
HOSTILE = ("mirrored", "elsewhere", "heading60", "moved")
SEED = 7


# --- photos ---


@dataclass(frozen=True)
class Lines(crossdomain.CrossDomain):
    """Photos along straight lines, `PER_LINE` each, in place of independent ones."""

    def poses(self, count: int) -> list[Rigid3]:
        rng = np.random.default_rng([self.seed, 120])
        found: list[Rigid3] = []
        while len(found) < count:
            line = self._line(rng)
            if all(self._inside(pose) for pose in line):
                found += line
        return found[:count]

    def _line(self, rng: np.random.Generator) -> list[Rigid3]:
        start = rng.uniform((0.0, 0.0), (self.width_m, self.height_m))
        height_m, yaw = rng.uniform(60.0, 150.0), rng.uniform(-np.pi, np.pi)
        mounted_rad = np.radians(30.0) * rng.beta(1.3, 2.9)
        step_m = height_m * self.camera.height / self.camera.fy * (1.0 - rng.uniform(*OVERLAP))
        ahead = np.array([np.sin(yaw), np.cos(yaw)])
        above_m = self._ground(start) + height_m
        line = []
        for k in range(PER_LINE):
            roll, pitch, turn = np.radians(rng.normal(0.0, (2.5, 2.0, 2.0)))
            ned_from_body = rotation.from_euler(roll, mounted_rad + pitch, yaw + turn)
            turned = frames.map_from_ned_rotation(0.0) @ ned_from_body @ frames.BODY_FROM_NADIR_CAMERA
            xy = start + k * step_m * ahead + rng.normal(0.0, 0.5, 2) + (self.place.west_m, self.place.south_m)
            line.append(Rigid3(turned, np.append(xy, above_m + rng.normal(0.0, 1.0))))
        return line


def make(options: argparse.Namespace) -> None:
    crossdomain.write_set(options.out, Lines(options.kind, options.seed), PER_LINE * options.lines, progress=True)


# --- a line as the autopilot knows it ---


@dataclass
class Line:
    """Frames in a row, their fields and what dead reckoning says of their poses."""

    number: int
    truths: list[Rigid3]
    shown: list[sequence.RecordedFrame]
    predicted: list[Rigid3]
    height_m: float
    localizer: Localizer
    hostile: str
    dull: str
    _fields: dict[int, structural.QueryFields] = field(default_factory=dict)

    def fields(self, k: int) -> structural.QueryFields:
        if k not in self._fields:
            grey = cv2.cvtColor(self.shown[k].image(), cv2.COLOR_RGB2GRAY)
            if self.hostile == "mirrored":
                grey = np.ascontiguousarray(grey[:, ::-1])
            if self.dull:
                grey = dulled(grey, self.dull, self.number, k)
            self._fields[k] = _maker(self.localizer).fields(grey)
        return self._fields[k]

    def leg_variance(self, j: int, k: int) -> float:
        """Of the way from frame j to k, per axis, m^2."""
        at = [pose.translation for pose in self.predicted[j : k + 1]]
        return (RESERVE * LEG) ** 2 * float(np.square(np.diff(at, axis=0)).sum()) if k > j else 0.0

    def prior(self, k: int, anchor: FloatArray, covariance: FloatArray, of: int) -> PosePrior:
        """Of frame k, dead reckoned from a position of frame ``of``."""
        step = self.predicted[k].translation - self.predicted[of].translation
        full = np.zeros((6, 6))
        full[:3, :3] = covariance + np.eye(3) * (RESERVE * LEG) ** 2 * float(step @ step)
        full[3:, 3:] = self._common_attitude + _attitude(self.predicted[k], FRAME_RAD)
        return PosePrior(Rigid3(self.predicted[k].rotation, anchor + step), 0.5 * (full + full.T))

    def window(self, numbers: list[int], prior: PosePrior) -> tuple[list[PosePrior], FloatArray]:
        """Priors of frames, the present one (``prior``) last, and their joint covariance (6N, 6N): the way back from
        the present frame is a random walk, and of the attitude's error a part is common."""
        count, k = len(numbers), numbers[-1]
        full = np.zeros((6 * count, 6 * count))
        variance = [self.leg_variance(j, k) for j in numbers]
        for a in range(count):
            for b in range(count):
                block = full[6 * a : 6 * a + 6, 6 * b : 6 * b + 6]
                block[:3, :3] = prior.covariance[:3, :3] + np.eye(3) * min(variance[a], variance[b])
                block[3:, 3:] = self._common_attitude
            full[6 * a + 3 : 6 * a + 6, 6 * a + 3 : 6 * a + 6] += _attitude(self.predicted[numbers[a]], FRAME_RAD)
        full = 0.5 * (full + full.T)
        here = prior.map_from_camera.translation - self.predicted[k].translation
        priors = [
            PosePrior(
                Rigid3(self.predicted[j].rotation, self.predicted[j].translation + here),
                full[6 * a : 6 * a + 6, 6 * a : 6 * a + 6],
            )
            for a, j in enumerate(numbers)
        ]
        return priors, full

    @property
    def _common_attitude(self) -> FloatArray:
        return _attitude(self.predicted[0], LINE_RAD)

    @property
    def first_covariance(self) -> FloatArray:
        return np.diag(np.square(LINE_POSITION * self.height_m))


def _attitude(pose: Rigid3, sigma_rad: FloatArray) -> FloatArray:
    return cov.attitude(pose.rotation @ frames.BODY_FROM_NADIR_CAMERA.T, tuple(sigma_rad))


def _level_axes(pose: Rigid3) -> FloatArray:
    ahead = (pose.rotation @ frames.BODY_FROM_NADIR_CAMERA.T)[:, 0] * (1.0, 1.0, 0.0)
    ahead /= np.linalg.norm(ahead)
    up = np.array([0.0, 0.0, 1.0])
    return np.column_stack([ahead, np.cross(up, ahead), up])


def dulled(grey: ImageArray, how: str, line: int, k: int) -> ImageArray:
    contrast, blur_px, noise = (float(part) for part in how.split(","))
    soft = cv2.GaussianBlur(grey.astype(np.float32), (0, 0), blur_px * grey.shape[1] / 640)
    noisy = 170 + contrast * (soft - soft.mean()) + np.random.default_rng([9, line, k]).normal(0.0, noise, soft.shape)
    return np.asarray(np.clip(noisy, 0, 255), dtype=np.uint8)


def lines(folder: Path, scratch: Path, options: argparse.Namespace, hostile: str) -> Iterator[Line]:
    pack = build_pack(
        next(folder.glob("*_dop.tif")), next(folder.glob("*_dsm.tif")), scratch / f"{folder.name}-{hostile}",
        PackOptions(quality=85, vertical="unknown"),
    )  # fmt: skip
    store = MapStore(pack) if isinstance(pack, Pack) else MapStore(Pack.open(pack))
    recorded = sequence.read_flight(folder)
    count = len(recorded) // PER_LINE
    for number in tqdm(range(min(count, options.lines)), file=sys.stderr):
        line = recorded[number * PER_LINE :][:PER_LINE]
        truths = [record.map_from_camera for record in line]
        ground_m = store.ground_near(truths[0].translation[:2])
        assert ground_m is not None
        height_m = float(truths[0].translation[2]) - ground_m
        rng = np.random.default_rng([SEED, number, options.draw])
        predicted = _predicted(truths, height_m, rng)
        if hostile == "heading60":
            turn = rotation.exp([0.0, 0.0, np.radians(60.0) * rng.choice([-1, 1])])
            predicted = [Rigid3(turn @ pose.rotation, pose.translation) for pose in predicted]
        if hostile == "moved":
            bearing = rng.uniform(0.0, 2.0 * np.pi)
            away = rng.uniform(0.5, 1.0) * height_m * np.array([np.cos(bearing), np.sin(bearing), 0.0])
            predicted = [Rigid3(pose.rotation, pose.translation + away) for pose in predicted]
        shown = line
        if hostile == "elsewhere":
            shown = recorded[(number + count // 2) % count * PER_LINE :][:PER_LINE]
        localizer = Localizer(line[0].camera, store, Structural(), LocalizerOptions())
        yield Line(number, truths, shown, predicted, height_m, localizer, hostile, options.dull)
        localizer.close()


def _predicted(truths: list[Rigid3], height_m: float, rng: np.random.Generator) -> list[Rigid3]:
    position = rng.normal(size=3) * LINE_POSITION * height_m
    attitude = _level_axes(truths[0]) @ (rng.normal(size=3) * LINE_RAD)
    poses: list[Rigid3] = []
    for k, truth in enumerate(truths):
        if k:
            leg_m = float(np.linalg.norm(truth.translation - truths[k - 1].translation))
            position = position + rng.normal(size=3) * LEG * leg_m
        own = _level_axes(truth) @ (rng.normal(size=3) * FRAME_RAD)
        poses.append(Rigid3(rotation.exp(attitude + own) @ truth.rotation, truth.translation + position))
    return poses


def _maker(localizer: Localizer) -> structural.QueryMaker:
    tracking = localizer._details[0].tracking
    assert tracking is not None
    return tracking


def terrain_of(localizer: Localizer, priors: list[PosePrior]) -> tuple[LocalFrame, Terrain]:
    """Of all the views. Raises: RejectedError."""
    grounds = [localizer._predicted_ground(prior) for prior in priors]
    bounds = np.array([search_bounds(o, p, g, 2.5) for p, (g, o) in zip(priors, grounds, strict=True)])
    west, south, east, north = *bounds[:, :2].min(axis=0), *bounds[:, 2:].max(axis=0)
    ground_m = grounds[-1][0]
    gsd_m = localizer._distance_to_ground(priors[-1], ground_m) / _maker(localizer).finest.focal_px
    window = localizer._read((float(west), float(south), float(east), float(north)), gsd_m)
    local = localizer._local_frame(window, ground_m)
    terrain = Terrain.of(window, precondition.grey_map(window), local)
    assert terrain is not None
    return local, terrain


# --- frames together ---


@dataclass
class Seen:
    """A frame's matches at a level, and how they agree with the pose."""

    view: RenderedView
    found: correlating.Correlation
    px: FloatArray
    points: FloatArray
    information: FloatArray
    scores: FloatArray
    shown: BoolArray
    every_point: FloatArray
    residuals: FloatArray = field(default_factory=lambda: np.empty((0, 2)))
    jacobian: FloatArray = field(default_factory=lambda: np.empty((0, 2, 6)))
    weights: FloatArray = field(default_factory=lambda: np.empty(0))
    inliers: BoolArray = field(default_factory=lambda: np.empty(0, bool))


@dataclass
class Found:
    """What the levels came to: the frames' matches and poses, the present one's last."""

    seen: list[Seen | None]
    poses: list[Rigid3]

    @property
    def inliers(self) -> FloatArray:
        return np.array([0 if one is None else np.count_nonzero(one.inliers) for one in self.seen], dtype=np.float64)

    @property
    def contrasts(self) -> FloatArray:
        return np.array([0 if s is None else contrast(s, p) for s, p in zip(self.seen, self.poses, strict=True)])


def contrast(seen: Seen, pose: Rigid3) -> float:
    """How much better the patches fit at a pose than a pixel and a half beside it, in standard deviations of the mean.

    Of all patches in view, with a peak or not; nine of them share their pixels.
    """
    shift, _ = linearised(seen.every_point, seen.found.template_px, seen.view.camera, pose)
    shift = np.where(np.isfinite(shift), shift, np.inf)
    here, _, inside = seen.found.at(shift)
    around, tried = np.zeros(len(shift)), np.zeros(len(shift))
    for x in (-1.5, 0.0, 1.5):
        for y in (-1.5, 0.0, 1.5):
            if x or y:
                score, _, known = seen.found.at(shift + (x, y))
                around += np.where(known, score, 0.0)
                tried += known
    usable = inside & seen.shown & (tried >= 3)
    if np.count_nonzero(usable) < 20:
        return 0.0
    rise = here[usable] - around[usable] / tried[usable]
    return float(rise.mean() / (rise.std() / math.sqrt(len(rise) / 9.0)))


class Together:
    """The levels of `structural.Tracking` for frames whose relative poses are known with a joint covariance."""

    def __init__(
        self,
        queries: list[structural.QueryFields],
        terrain: Terrain,
        priors: list[PosePrior],
        covariance: FloatArray,
        camera: Camera,
    ) -> None:
        self.tracks = [
            structural.Tracking(q, terrain, p, camera, Trace()) for q, p in zip(queries, priors, strict=True)
        ]
        self.predicted = [track._predicted.local_from_camera for track in self.tracks]
        self.terrain, self.tuning = terrain, structural.TUNING
        count = len(queries)
        covariance = covariance + np.kron(np.eye(count), structural._EXACT)
        self.information = np.linalg.inv(covariance)
        # The last pose does not know the predicted position; what the frames know of each other it does.
        anywhere = np.kron(np.ones((count, count)), np.diag([1e6] * 3 + [0.0] * 3))
        self.last_information = np.linalg.inv(covariance + anywhere)

    def run(self) -> Found | None:
        """From the common shift of all views that fits best, through the levels."""
        poses = self._likely_start()
        if poses is None:
            return None
        last = len(self.tuning.levels) - 1
        for number in range(last + 1):
            information = self.last_information if number == last else self.information
            passes = 2 if 0 < number < last else 1
            while True:
                seen = [self._match(track, number, pose) for track, pose in zip(self.tracks, poses, strict=True)]
                if seen[-1] is None:
                    return None
                try:
                    poses = self._adjusted(number, seen, poses, information)
                except np.linalg.LinAlgError:
                    return None
                limit = structural._LAST_INLIER_PX if number == last else structural._INLIER_PX
                agreeing = _judge(seen, poses, limit)
                passes -= 1
                if not passes or agreeing >= self.tuning.repeat_below:
                    break
            if number > 0 and agreeing < structural._HOPELESS:
                return None
        try:
            poses = self._polished(seen, poses)
        except np.linalg.LinAlgError:
            return None
        _judge(seen, poses, structural._LAST_INLIER_PX)
        return Found(seen, poses)

    def covariance(self, found: Found) -> FloatArray:
        """(6, 6) of the present pose."""
        full = self.last_information.copy()
        for k, seen in enumerate(found.seen):
            if seen is None or np.count_nonzero(seen.inliers) < structural._MIN_MATCHES:
                continue
            side = max(seen.view.camera.width, seen.view.camera.height) / structural._CLUSTERS_ACROSS
            column, row = np.floor(seen.px[seen.inliers] / side).astype(np.intp).T
            whitener = np.linalg.cholesky(seen.information[seen.inliers]).transpose(0, 2, 1)
            try:
                alone = structural._absorbed_error_factor(seen.scores[seen.inliers]) * cov.clustered(
                    whitener @ seen.jacobian[seen.inliers],
                    np.einsum("nij,nj->ni", whitener, seen.residuals[seen.inliers]),
                    seen.weights[seen.inliers],
                    column * 10_000 + row,
                )
                full[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] += np.linalg.inv(alone)
            except np.linalg.LinAlgError:
                continue
        return np.asarray(np.linalg.inv(full)[-6:, -6:], dtype=np.float64)

    def _likely_start(self) -> list[Rigid3] | None:
        """The first level's surfaces of the whole views' correlation, as functions of the present view's shift, summed:
        those of earlier frames are dilated by what tilt may differ between them."""
        present = self.tracks[-1]
        camera = present._query.cameras[0]
        base = render(self.terrain, camera, self.predicted[-1])
        if base.valid.mean() < structural._MIN_VALID:
            return None
        reach = present._reach_px(base)
        surface = self._surface(present, self.predicted[-1], reach)
        assert surface is not None
        total, depth_m = surface
        across = self.predicted[-1].rotation[:, :2]
        for track, pose in zip(self.tracks[:-1], self.predicted[:-1], strict=True):
            earlier = self._surface(track, pose, reach)
            if earlier is None:
                continue
            radius = max(1, round(math.sqrt(2.0) * FRAME_RAD[0] * camera.focal_px))
            kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
            turned = (pose.rotation.T @ across)[:2] * depth_m / earlier[1]
            middle = np.array([reach, reach])
            warp = np.column_stack([turned, middle - turned @ middle])
            warped = cv2.warpAffine(
                cv2.dilate(earlier[0], kernel), warp, total.shape[::-1],
                flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP, borderMode=cv2.BORDER_REPLICATE,
            )  # fmt: skip
            total = total + warped - warped.mean()
        total = total / max(float(total.std()), 1e-12)
        starts = []
        apart = max(reach // 10, 2)
        for _ in range(structural._PEAKS_PER_TURN):
            y, x = (int(k) for k in np.unravel_index(int(total.argmax()), total.shape))
            step = -across @ (np.array([x - reach, y - reach]) / (camera.fx, camera.fy)) * depth_m
            poses = [Rigid3(pose.rotation, pose.translation + step) for pose in self.predicted]
            starts.append((present._merit(float(total[y, x]), poses[-1]), poses))
            total[max(y - apart, 0) : y + apart + 1, max(x - apart, 0) : x + apart + 1] = total.mean()
        return max(starts, key=lambda start: start[0])[1]

    def _surface(self, track: structural.Tracking, pose: Rigid3, reach: int) -> tuple[ImageArray, float] | None:
        """Correlation of a whole view by shift, in standard deviations, and its depth in m."""
        camera, searched = track._query.cameras[0], track._query.fields[0]
        view = render(self.terrain, camera, pose)
        if view.valid.mean() < structural._MIN_VALID:
            return None
        template = orientation_field(view.image, view.valid)
        _, rows, columns = template.shape
        size = cv2.getOptimalDFTSize(rows + reach), cv2.getOptimalDFTSize(columns + reach)

        def spectrum(of: np.ndarray) -> np.ndarray:
            padded = np.zeros((*size, 2), np.float32)
            padded[:rows, :columns, 0], padded[:rows, :columns, 1] = of
            return cv2.dft(padded, nonzeroRows=rows)

        product = cv2.mulSpectrums(spectrum(searched), spectrum(template), 0, conjB=True)
        whole = cv2.dft(product, flags=cv2.DFT_INVERSE)[..., 0]
        near = np.roll(whole, (reach, reach), axis=(0, 1))[: 2 * reach + 1, : 2 * reach + 1]
        near = cv2.GaussianBlur(np.ascontiguousarray(near), (0, 0), 1.0)
        middle = structural._middle_px(template)
        depth_m = float((view.points_local(middle)[0] - pose.translation) @ pose.rotation[:, 2])
        return (near - near.mean()) / max(float(near.std()), 1e-12), depth_m

    def _match(self, track: structural.Tracking, number: int, pose: Rigid3) -> Seen | None:
        level, camera, searched = self.tuning.levels[number], track._query.cameras[number], track._query.fields[number]
        view = render(self.terrain, camera, pose)
        if view.valid.mean() < structural._MIN_VALID:
            return None
        field = orientation_field(view.image, view.valid)
        products = correlating.multiply(field, searched, radius=level.radius_px, cell=level.cell_px)
        found = products.patches(level.patch_cells, level.stride)
        peaks = found.peaks()
        good = structural._shown(view, peaks.template_px) & (peaks.score >= structural._MIN_SCORE)
        kept = peaks.take(np.flatnonzero(good))
        return Seen(
            view, found, kept.template_px + kept.shift_px, view.points_local(kept.template_px),
            track._information(kept) / _shared(level), kept.score, structural._shown(view, found.template_px),
            view.points_local(found.template_px),
        )  # fmt: skip

    def _error(self, poses: list[Rigid3]) -> FloatArray:
        known = [PoseMeasurement(pose, np.eye(6)) for pose in self.predicted]
        return np.concatenate([one.error(pose) for one, pose in zip(known, poses, strict=True)])

    def _adjusted(
        self, number: int, seen: list[Seen | None], poses: list[Rigid3], information: FloatArray
    ) -> list[Rigid3]:
        """As `pose.adjust.adjust`, with all poses unknown."""
        sigma_px = self.tuning.sigma_px * math.sqrt(_shared(self.tuning.levels[number]))
        scales = structural._FIRST_SCALES_PX if number == 0 else structural._LATER_SCALES_PX
        for scale in scales:
            last = scale == scales[-1]
            for _ in range(8 if last else 2):
                normal, gradient = information.copy(), information @ self._error(poses)
                for k, one in enumerate(seen):
                    if one is None or not len(one.px):
                        continue
                    residuals, jacobian = linearised(one.points, one.px, one.view.camera, poses[k])
                    ahead = np.isfinite(residuals).all(axis=1)
                    safe = np.where(ahead[:, None], residuals, 0.0)
                    squared = np.einsum("ni,nij,nj->n", safe, one.information, safe)
                    one.weights = np.where(ahead, _geman_mcclure(squared, scale / sigma_px), 0.0)
                    own, pull = normal_equations(jacobian, one.information * one.weights[:, None, None], safe)
                    normal[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] += own
                    gradient[6 * k : 6 * k + 6] += pull
                step = -np.linalg.solve(normal, gradient)
                poses = [moved(pose, step[6 * k : 6 * k + 6]) for k, pose in enumerate(poses)]
                if last and float(step @ normal @ step) < 1e-4:
                    break
        return poses

    def _polished(self, seen: list[Seen | None], poses: list[Rigid3]) -> list[Rigid3]:
        """As `structural.Tracking._polished`."""
        for _ in range(structural._POLISHES):
            normal = self.last_information.copy()
            rise = -self.last_information @ self._error(poses)
            for k, one in enumerate(seen):
                if one is None:
                    continue
                shift, jacobian = linearised(one.every_point, one.found.template_px, one.view.camera, poses[k])
                score, slope, inside = one.found.at(np.where(np.isfinite(shift), shift, np.inf))
                score = np.where(inside & one.shown, np.clip(score, 0.0, structural._MAX_SCORE), 0.0)
                strength = structural._SAMPLES * score / (1.0 - score**2)
                stiffness = (strength * score)[:, None, None] * one.found.sharpness
                normal[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] += normal_equations(
                    jacobian, stiffness, np.zeros_like(shift)
                )[0]
                rise[6 * k : 6 * k + 6] += (strength[:, None] * slope).ravel() @ jacobian.reshape(-1, 6)
            step = np.linalg.solve(normal, rise)
            poses = [moved(pose, step[6 * k : 6 * k + 6]) for k, pose in enumerate(poses)]
            if float(step @ normal @ step) < structural._SMALL_CHANGE**2:
                break
        return poses


def _shared(level: structural.Level) -> float:
    return max((level.patch_cells / level.stride) ** 2 / 4.0, 1.0)


def _judge(seen: list[Seen | None], poses: list[Rigid3], limit_px: float) -> float:
    """Which matches agree, and their part."""
    agreeing = total = 0
    for one, pose in zip(seen, poses, strict=True):
        if one is None:
            continue
        one.residuals, one.jacobian = linearised(one.points, one.px, one.view.camera, pose)
        one.inliers = np.asarray(np.linalg.norm(one.residuals, axis=1) <= limit_px)
        agreeing += int(np.count_nonzero(one.inliers))
        total += len(one.inliers)
    return agreeing / max(total, 1)


def together(line: Line, numbers: list[int], prior: PosePrior) -> tuple[Found | None, Rigid3, FloatArray, float]:
    """Of a window: what was found, the present pose in map coordinates, its covariance and the CPU ms.

    Raises: RejectedError where there is no map.
    """
    priors, covariance = line.window(numbers, prior)
    local, terrain = terrain_of(line.localizer, priors)
    queries = [line.fields(j) for j in numbers]
    start = time.process_time()
    window = Together(queries, terrain, priors, covariance, line.localizer.camera)
    found = window.run()
    spent_ms = (time.process_time() - start) * 1e3
    if found is None:
        return None, prior.map_from_camera, prior.covariance, spent_ms
    pose = local.map_from_local_pose(found.poses[-1])
    return found, pose, window.covariance(found) + line.localizer._map_covariance, spent_ms


def convinces(contrasts: FloatArray, pose: Rigid3, covariance: FloatArray, prior: PosePrior, height_m: float) -> bool:
    """The gate of a window: contrast, that of all but its best frame, certainty, and three sigmas of the prior."""
    limits = gate.GateOptions()
    count = len(contrasts)
    if contrasts.sum() < CONTRAST * math.sqrt(count):
        return False
    if count > 1 and contrasts.sum() - contrasts.max() < CONTRAST_OF_OTHERS * math.sqrt(count - 1):
        return False
    return (
        gate.certain(covariance, height_m, limits)
        or gate.agrees_with(prior, pose, covariance, gate.for_structure(0.0, limits))
    ) is None


# --- measurements ---


@dataclass
class Step:
    """One frame of a chain. ``error``: m and deg; None without a fix; ``nees`` likewise."""

    single: bool
    error: tuple[float, float] | None
    nees: float
    window_ms: float


def _error(pose: Rigid3, truth: Rigid3) -> tuple[float, float]:
    turn = rotation.log(pose.rotation @ truth.rotation.T)
    return float(np.linalg.norm(pose.translation - truth.translation)), float(np.degrees(np.linalg.norm(turn)))


def _nees(pose: Rigid3, covariance: FloatArray, truth: Rigid3) -> float:
    turn = rotation.log(truth.rotation @ pose.rotation.T)
    return cov.mahalanobis_squared(np.concatenate([truth.translation - pose.translation, turn]), covariance)


class Chain:
    """Frames of a line one after the other; a fix is where the next frame is reckoned from.

    A window holds frames that gave no fix since the last one: a frame that gave one has had its say.
    """

    def __init__(self, line: Line) -> None:
        self._line = line
        self._tried: dict[tuple[int, bytes], tuple[PosePrior, Fix | None]] = {}

    def steps(self, most: int, alone: bool) -> Iterator[Step]:
        """
        Args:
            most: frames of a window; 0: none is tried.
            alone: a refused frame is tried as a window of its own, too.
        """
        line = self._line
        anchor, covariance, of = line.predicted[0].translation, line.first_covariance, 0
        waiting: list[int] = []
        for k, truth in enumerate(line.truths):
            prior, fix = self._single(k, anchor, covariance, of)
            pose: Rigid3 | None = None
            spent_ms = 0.0
            if fix is not None:
                pose, covariance_of = fix.map_from_camera, fix.covariance
            elif most and (waiting or alone):
                try:
                    found, at, covariance_of, spent_ms = together(line, [*waiting, k][-most:], prior)
                except RejectedError:
                    found = None
                if found is not None:
                    fall = found.seen[-1]
                    assert fall is not None
                    height_m = float(np.median(fall.view.fall_m))
                    pose = at if convinces(found.contrasts, at, covariance_of, prior, height_m) else None
            if pose is None:
                waiting.append(k)
                yield Step(False, None, 0.0, spent_ms)
                continue
            yield Step(fix is not None, _error(pose, truth), _nees(pose, covariance_of, truth), spent_ms)
            anchor, covariance, of = pose.translation, covariance_of[:3, :3], k
            waiting = []

    def _single(self, k: int, anchor: FloatArray, covariance: FloatArray, of: int) -> tuple[PosePrior, Fix | None]:
        key = k, anchor.tobytes()
        if key not in self._tried:
            line = self._line
            prior = line.prior(k, anchor, covariance, of)
            outcome = _localized(line, k, prior)
            self._tried[key] = prior, outcome if isinstance(outcome, Fix) else None
        return self._tried[key]


def _localized(line: Line, k: int, prior: PosePrior) -> object:
    """Of the localizer as it flies; the picture's fields are those of the line."""
    localizer = line.localizer
    details, maker = localizer._details, _maker(localizer)
    ready = line.fields(k)

    class Ready:
        finest, tuning = maker.finest, maker.tuning

        def fields(self, grey: ImageArray) -> structural.QueryFields:
            return ready

    localizer._details = [replace(details[0], tracking=Ready())]  # type: ignore[arg-type]
    try:
        empty = np.zeros((localizer.camera.height, localizer.camera.width), np.uint8)
        return localizer.localize(Frame(0, empty, str(k)), prior)
    finally:
        localizer._details = details


VARIANTS = {
    "single frames": (0, False),
    "refused frames judged by contrast": (1, True),
    "windows up to 3 of refused frames": (3, False),
    "windows up to 5 of refused frames": (5, False),
    "contrast, windows up to 2": (2, True),
    "contrast, windows up to 3": (3, True),
    "contrast, windows up to 5": (5, True),
}


def chains(options: argparse.Namespace) -> None:
    steps: dict[str, list[Step]] = {name: [] for name in VARIANTS}
    with tempfile.TemporaryDirectory() as scratch:
        for line in lines(options.folder, Path(scratch), options, options.hostile):
            chain = Chain(line)
            for name, (most, alone) in VARIANTS.items():
                steps[name] += chain.steps(most, alone)
    print("| variant | refused | recall 1m-1° | TE median, p90 m | false | NEES / 6 | second looks: fixes, TE median, max m,"
          " NEES / 6, CPU ms |\n|---|---|---|---|---|---|---|")  # fmt: skip
    for name, taken in steps.items():
        found = [s for s in taken if s.error is not None]
        te = np.array([s.error[0] for s in found if s.error is not None])
        right = sum(s.error is not None and s.error[0] <= 1 and s.error[1] <= 1 for s in taken)
        by_window = [s for s in found if not s.single and s.error is not None]
        cells = [name, f"{len(taken) - len(found)} of {len(taken)}", f"{100 * right / len(taken):.1f} %"]
        false = sum(s.error is not None and (s.error[0] > 10 or s.error[1] > 5) for s in found)
        if found:
            median, p90 = np.percentile(te, [50, 90])
            cells += [f"{median:.2f}, {p90:.2f}", str(false), f"{np.mean([s.nees for s in found]) / 6:.1f}"]
        else:
            cells += ["", "0", ""]
        spent = [s.window_ms for s in taken if s.window_ms]
        part = f"{len(by_window)}"
        if by_window:
            metres = [s.error[0] for s in by_window if s.error is not None]
            part += f", {np.median(metres):.2f}, {max(metres):.2f}, {np.mean([s.nees for s in by_window]) / 6:.1f}"
        cells.append(part + (f", {np.median(spent):.0f}" if spent else ""))
        print("| " + " | ".join(cells) + " |")


def statistics(options: argparse.Namespace) -> None:
    """Every second window of the last four frames of each line, all frames reckoned from one prior and none fixed."""
    right: dict[int, list[Found]] = {n: [] for n in (1, 2, 3, 5)}
    wrong: dict[int, list[Found]] = {n: [] for n in right}
    tried = 0
    with tempfile.TemporaryDirectory() as scratch:
        for hostile in ("", *HOSTILE):
            kind = argparse.Namespace(**{**vars(options), "dull": "" if hostile else options.dull})
            for line in lines(options.folder, Path(scratch), kind, hostile):
                for k in (4, 6):
                    tried += not hostile
                    prior = line.prior(k, line.predicted[0].translation, line.first_covariance, 0)
                    for count in right:
                        try:
                            found, pose, _, _ = together(line, list(range(k - count + 1, k + 1)), prior)
                        except RejectedError:
                            continue
                        if found is None:
                            continue
                        away_m = _error(pose, line.truths[k])[0]
                        if not hostile and away_m < 1.5:
                            right[count].append(found)
                        elif hostile or away_m > 5.0:
                            wrong[count].append(found)
    print(f"{tried} honest windows of each size")
    print("| frames | statistic | highest of wrong poses | 10, 50, 90 % of right ones | right ones above 1.3 x that |")
    print("|---|---|---|---|---|")
    for count in right:
        for name in ("agreeing patches", "of all but the best frame", "contrast", "contrast of all but the best frame"):
            if count == 1 and "but" in name:
                continue
            good, bad = (np.array([_statistic(name, f) for f in of[count]]) for of in (right, wrong))
            low, middle, high = np.percentile(good, [10, 50, 90])
            above = int((good > 1.3 * bad.max()).sum())
            digits = 1 if "contrast" in name else 0
            print(f"| {count} | {name} | {bad.max():.{digits}f} of {len(bad)} | {low:.{digits}f}, {middle:.{digits}f}, "
                  f"{high:.{digits}f} of {len(good)} | {above} |")  # fmt: skip


def _statistic(name: str, found: Found) -> float:
    values = found.contrasts if name.startswith("contrast") else found.inliers
    count = len(values)
    if "but" in name:
        values, count = np.sort(values)[:-1], count - 1
    return float(values.sum() / (math.sqrt(count) if name.startswith("contrast") else 1.0))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(required=True)
    making = commands.add_parser("make")
    making.add_argument("out", type=Path)
    making.add_argument("--kind", type=crossdomain.Kind, default=crossdomain.Kind.XDOP)
    making.add_argument("--lines", type=int, default=30)
    making.add_argument("--seed", type=int, default=1)
    making.set_defaults(run=make)
    for name, run in (("chains", chains), ("statistics", statistics)):
        measuring = commands.add_parser(name)
        measuring.add_argument("folder", type=Path)
        measuring.add_argument("--lines", type=int, default=1000)
        measuring.add_argument("--draw", type=int, default=0)
        measuring.add_argument("--dull", default="")
        if run is chains:
            measuring.add_argument("--hostile", default="", choices=["", *HOSTILE])
        measuring.set_defaults(run=run)
    options = parser.parse_args()
    cv2.setNumThreads(1)
    options.run(options)


if __name__ == "__main__":
    main()
