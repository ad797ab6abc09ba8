"""Poses with unknown intrinsics, of one photo or of several by one camera.

Paper, "Initial Camera Calibration / Localization": a guessed focal length, f = max(W, H) where there is no better, and
a robust pose; then focal length and poses refined together. Because a wrong guess may lead astray, there is a second
start from minimal solutions that know the focal length (P4Pf), and what explains the matches better is kept.

Over flat ground seen straight down focal length and height trade off without bound (appendix "Proof of Focal Length
and Translation Ambiguity"). So the uncertainty of all parameters comes with them, and `ill_posed` says which of them a
solution does not tell: such an answer is not a calibration. What breaks the ambiguity is tilt, relief, a height or an
attitude known from elsewhere (`Known`), and photos that have some of these, taken with the same camera.

Relief tells the focal length only as far as the map's heights are right. Their noise looks like relief that the photo
does not show, as if from far away through a long lens: least squares on the pixels alone made 62 % too much of a focal
length that it claimed to know to 4 % (1 m of noise on 1.2 m of relief, straight down). So each point's height is an
unknown of its own, with a sigma that shows in the photos themselves: errors of heights move matches along the image of
the vertical alone, all others across it, too.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from msgspec import Meta, Struct

from ortholoc_edge.geometry import covariance as cov
from ortholoc_edge.geometry import rotation
from ortholoc_edge.geometry.arrays import BoolArray, FloatArray
from ortholoc_edge.geometry.camera import Camera
from ortholoc_edge.geometry.rigid import Rigid3
from ortholoc_edge.pose import pnp
from ortholoc_edge.pose.adjust import PoseMeasurement, linearised, moved
from ortholoc_edge.pose.least_squares import HUBER_BEND, Quadratic, huber, huber_scale, huber_weights, minimise

# A wrong focal length bends the projection, so the first stage must be forgiving (matchers.md section 5 used
# 12 px at 1024 px); the last is as strict as for known intrinsics.
_FIRST_STAGE_FACTOR = 2.4
# In each the matches that agree are chosen anew, until the focal length changes by less than this part of it.
_MOST_ROUNDS = 6
_SMALL_CHANGE = 1e-5
# Of P4Pf's: at 50 % outliers 4 of 4 are right in one draw of 16, at 70 % in one of 123.
_DRAWS = 500
_ENOUGH = 0.999
# Of the focal length over the long side of the image: fields of view from 118 down to 6 degrees. Where it is not
# determined it runs away, and is held there.
_PLAUSIBLE_FOCAL = (0.3, 10.0)
# On the variance, for errors of map and matches that vary slowly: what they don't move in a pose of known intrinsics
# (`pnp.ABSORBED_ERROR_FACTOR`), the focal length takes up, which is told by little. With that factor alone the
# normalised error squared averaged 3.6 instead of 1 (three flights jointly, SIFT and XFeat; docs/benchmarks.md,
# "Calibration").
_ABSORBED_ERROR_FACTOR = 2.5 * pnp.ABSORBED_ERROR_FACTOR
# Of a squared normal variable.
_MEDIAN_CHI_SQUARED = 0.455
# Worse heights than this are no map.
_MAX_HEIGHT_SIGMA_M = 50.0
# A step that changes the focal length by more than this is cut: the linearisation ends before.
_LARGEST_LOG_STEP = 0.5

# Beyond this relative uncertainty the focal length says nothing a data sheet does not say better.
MAX_RELATIVE_FOCAL_SIGMA = 0.05
# Of the long side of the image.
_MAX_PRINCIPAL_POINT_SIGMA = 0.02
# Of the long side of the image: what the distortion may move its corners.
_MAX_CORNER_SIGMA = 0.01


class Unknowns(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What is solved for beside the focal length and the poses; the rest stays as in the camera to begin with.

    ``principal_point_sigma``: 1-sigma of how far from there it is, over the long side of the image; 0: not at all.
    Held in the middle where it is 8 of 1024 px beside it, as with two of our three real cameras, it makes an error of
    2 to 3 % of the focal length that no residual shows.
    ``radial``: Brown's k1, or k1 and k2, of the lens distortion.
    """

    principal_point_sigma: Annotated[float, Meta(ge=0)] = 0.01
    radial: Annotated[int, Meta(ge=0, le=2)] = 0

    @property
    def names(self) -> tuple[str, ...]:
        """Of the intrinsics, in the order in which they stand in the covariance."""
        return ("log_focal", *(("cx", "cy") if self.principal_point_sigma else ()), *("k1", "k2")[: self.radial])


USUAL = Unknowns()
_FOCAL_ALONE = Unknowns(principal_point_sigma=0.0)


@dataclass(frozen=True, slots=True, eq=False)
class Known:
    """What is known of a pose beside the photo.

    Attributes:
        height_m: of the camera centre, in the frame of the points; infinite ``height_sigma_m``: unknown.
        down_camera: (3,) where down is in the axes of the camera, of an attitude whose heading need not be known.
        tilt_sigma_rad: 1-sigma of it about either level axis; infinite: unknown.
    """

    height_m: float = 0.0
    height_sigma_m: float = math.inf
    down_camera: FloatArray | None = None
    tilt_sigma_rad: float = math.inf

    def at(self, pose: Rigid3) -> PoseMeasurement:
        """As a measurement of a pose near it; of what is not known it agrees."""
        upright = pose.rotation
        tilt_information = 0.0
        if self.down_camera is not None:
            seen = pose.rotation @ (self.down_camera / np.linalg.norm(self.down_camera))
            axis = np.array([-seen[1], seen[0], 0.0])
            sine = float(np.linalg.norm(axis))
            turn = axis * (math.atan2(sine, -seen[2]) / sine if sine > 1e-12 else 1.0)
            upright = _turned(pose, turn).rotation
            tilt_information = self.tilt_sigma_rad**-2
        position = np.append(pose.translation[:2], self.height_m)
        information = np.diag([0.0, 0.0, self.height_sigma_m**-2, tilt_information, tilt_information, 0.0])
        return PoseMeasurement(Rigid3(upright, position), information)


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """The matches of one photo.

    Attributes:
        points: (N, 3) m, in a local metric frame that may be the photo's own.
        px: (N, 2) where the photo shows them, as the lens made it.
        height_sigma_m: 1-sigma, at least, of the points' heights.
    """

    points: FloatArray
    px: FloatArray
    known: Known | None = None
    height_sigma_m: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """A camera and where it was.

    Attributes:
        camera: the intrinsics.
        unknowns: which of them were solved for.
        covariance: (K + 6 V, K + 6 V) of the K intrinsics (`Unknowns.names`: the logarithm of the focal length, px, and
            the distortion's own units) and of the V poses that are not None: centre, m, and rotation vector, rad.
        views: a pose per view, with its reprojection errors; None where its matches determine none.
        cost_px2: squared errors of all matches, each at most that of the inlier threshold.
        noise_px2: variance of an error, with what a match is worth less since its neighbours share its error.
        surprise: squared errors, in sigmas, of what was known beside the photos.
        height_sigma_m: of the map's heights, as the photos show it.
    """

    camera: Camera
    unknowns: Unknowns
    covariance: FloatArray
    views: tuple[pnp.PoseEstimate | None, ...]
    cost_px2: float
    noise_px2: float
    surprise: float
    height_sigma_m: float

    def sigma(self, name: str) -> float:
        """1-sigma of an intrinsic parameter, one of ``unknowns.names``; of ``log_focal`` it is the relative one of the
        focal length."""
        index = self.unknowns.names.index(name)
        return float(np.sqrt(self.covariance[index, index]))

    @property
    def corner_sigma_px(self) -> float:
        """1-sigma of how far the distortion moves the corners of the image; 0 if it was given."""
        names = self.unknowns.names
        rows = [names.index(name) for name in ("k1", "k2")[: self.unknowns.radial]]
        camera = self.camera
        radius = math.hypot(camera.width, camera.height) / 2.0 / camera.focal_px
        by_term = camera.focal_px * radius ** np.array([3.0, 5.0])[: len(rows)]
        return float(np.sqrt(by_term @ self.covariance[np.ix_(rows, rows)] @ by_term))


@dataclass(frozen=True, slots=True)
class IllPosed:
    """Why a solution is not a calibration: ``measured`` against ``limit``, and what helps."""

    what: str
    measured: float
    limit: float
    remedy: str


def ill_posed(found: Calibration) -> IllPosed | None:
    """What the photos do not tell, the worst ambiguity first; None: they tell all that was solved for."""
    relative = found.sigma("log_focal")
    remedy = "tilt the camera by 20 degrees and more or fly over relief, take more photos, or give a known height"
    if not relative <= MAX_RELATIVE_FOCAL_SIGMA:
        return IllPosed(
            "focal length and distance can't be told apart: relative 1-sigma of the focal length",
            relative,
            MAX_RELATIVE_FOCAL_SIGMA,
            remedy,
        )
    long_px = max(found.camera.width, found.camera.height)
    least, most = _PLAUSIBLE_FOCAL
    in_sides = found.camera.fx / long_px
    if not least * 1.001 < in_sides < most * 0.999:
        limit = least if in_sides < 1.0 else most
        return IllPosed("focal length ran away: over the image's long side", in_sides, limit, remedy)
    if found.unknowns.principal_point_sigma:
        centre = max(found.sigma("cx"), found.sigma("cy")) / long_px
        if not centre <= _MAX_PRINCIPAL_POINT_SIGMA:
            return IllPosed(
                "principal point and place can't be told apart: 1-sigma over the image's long side",
                centre,
                _MAX_PRINCIPAL_POINT_SIGMA,
                "state less doubt of the principal point, or add photos that are tilted or of other headings",
            )
    if found.unknowns.radial:
        corner = found.corner_sigma_px / long_px
        if not corner <= _MAX_CORNER_SIGMA:
            return IllPosed(
                "the matches don't tell the distortion: 1-sigma at the corners over the image's long side",
                corner,
                _MAX_CORNER_SIGMA,
                "solve for k1 alone or for none, or add photos with matches near their corners",
            )
    return None


def solve(views: Sequence[View], camera: Camera, unknowns: Unknowns = USUAL, *, seed: int = 0) -> Calibration | None:
    """Focal length, poses and what else is unknown, from 2D-3D matches.

    Args:
        camera: where to begin; what is not unknown stays. The paper begins with
            ``Camera.from_focal(W, H, max(W, H))``.
        seed: of all drawing; the same matches and seed give the same answer.
    Returns: None where the matches determine no pose. Whether it is a calibration, `ill_posed` says.
    """
    if len(views) > 1:
        # Where each alone tells the focal length, or does not, the median of them leads nearest to that of all.
        alone = [solve([view], camera, unknowns, seed=seed) for view in views]
        told = [(one.camera.fx, one.sigma("log_focal") ** -2) for one in alone if one is not None]
        starts = [_zoomed(camera, _weighted_median(told) / camera.fx)] if told else [camera]
    else:
        minimal = _minimal_focal(views[0], camera, np.random.default_rng(seed)) if views else None
        starts = [camera, *([_zoomed(camera, minimal / camera.fx)] if minimal is not None else [])]
    found = [one for one in (_from(start, views, unknowns, seed) for start in starts) if one is not None]
    noise_px2 = min((one.noise_px2 for one in found), default=1.0)
    return min(found, key=lambda one: one.cost_px2 / noise_px2 + one.surprise, default=None)


# -- starts ------------------------------------------------------------------------------------------------


def _weighted_median(weighted: Sequence[tuple[float, float]]) -> float:
    values, weights = np.array(sorted(weighted)).T
    return float(values[np.searchsorted(np.cumsum(weights), 0.5 * weights.sum())])


def _minimal_focal(view: View, camera: Camera, random: np.random.Generator) -> float | None:
    """fx, px, of the P4Pf solution that the most matches agree with; None if too few do with any."""
    ideal_px = camera.undistorted_px(view.px)
    usable = np.isfinite(ideal_px).all(axis=1)
    points, px = view.points[usable], ideal_px[usable]
    count = len(points)
    if count < pnp.MINIMUM_POINTS:
        return None
    origin = points.mean(axis=0)
    points = points - origin
    # As seen by square pixels around the principal point.
    centred = (px - (camera.cx, camera.cy)) * (1.0, camera.fx / camera.fy)
    limit = (pnp.threshold_px(camera) * _FIRST_STAGE_FACTOR) ** 2
    least, most = _focal_range(camera)
    best: tuple[float, float, int] | None = None
    needed = float(_DRAWS)
    drawn = 0
    while drawn < min(needed, _DRAWS):
        drawn += 1
        sample = random.choice(count, 4, replace=False)
        for camera_from_points, focal in pnp.minimal_with_focal(points[sample], centred[sample]):
            if not least <= focal <= most:
                continue
            x, y, z = camera_from_points.apply(points).T
            with np.errstate(all="ignore"):
                squared = (focal * x / z - centred[:, 0]) ** 2 + (focal * y / z - centred[:, 1]) ** 2
            squared = np.where((z > 0) & (squared < limit), squared, limit)
            cost = float(squared.sum())
            if best is None or cost < best[0]:
                agreeing = int(np.count_nonzero(squared < limit))
                best = cost, focal, agreeing
                right = min((agreeing / count) ** 4, 1.0 - 1e-9)
                needed = math.log(1.0 - _ENOUGH) / math.log1p(-right) if right > 0 else math.inf
                # What four right ones with noise give is far from what all give.
                needed = max(10.0 * needed, 100.0)
    return None if best is None or best[2] < pnp.MINIMUM_POINTS else best[1]


# -- refinement --------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class _State:
    """``poses``: one per view; None: it takes no part."""

    camera: Camera
    poses: tuple[Rigid3 | None, ...]


@dataclass(frozen=True, slots=True, eq=False)
class _Chosen:
    """The matches of a view that agree with its pose.

    Attributes:
        points, px: they; inliers: (M,) which of the view's.
        along_px: (N,) errors along the image of the vertical.
        px_per_m: (N,) by how much a height moves its match there.
        sigma_px: of the errors across it, which heights don't cause.
    """

    points: FloatArray
    px: FloatArray
    inliers: BoolArray
    known: Known | None
    along_px: FloatArray
    px_per_m: FloatArray
    sigma_px: float


@dataclass(frozen=True, slots=True, eq=False)
class _Taken:
    """A view that takes part in an adjustment.

    Attributes:
        alike: how many matches tell as much as one, since neighbours share their errors.
        variance: of whitened residuals: as much more than 1 as the matches claim too much.
        slots: (K + 6,) where the view's parameters stand among all.
    """

    chosen: _Chosen
    alike: float
    variance: float
    slots: np.ndarray

    @property
    def inflation(self) -> float:
        return self.variance * self.alike * _ABSORBED_ERROR_FACTOR


@dataclass(frozen=True, slots=True, eq=False)
class _Problem:
    """An adjustment of a state.

    Attributes:
        taken: None where the state has no pose.
        centre_px: (2,) where the principal point is expected.
    """

    taken: tuple[_Taken | None, ...]
    unknowns: Unknowns
    height_sigma_m: float
    centre_px: FloatArray


def _from(start: Camera, views: Sequence[View], unknowns: Unknowns, seed: int) -> Calibration | None:
    strict_px = pnp.threshold_px(start)
    loose_px = strict_px * _FIRST_STAGE_FACTOR
    centre_px = np.array([start.cx, start.cy])
    state = _adjusted(_posed(views, start, loose_px, seed), views, _FOCAL_ALONE, loose_px, centre_px)
    # More of them only near the focal length: far from it they would take up its error.
    state = _adjusted(state, views, unknowns, loose_px, centre_px)
    # Once the focal length is about right the true inliers can be told with the strict threshold.
    state = _posed(views, state.camera, strict_px, seed)
    for _ in range(_MOST_ROUNDS):
        before = state.camera.fx
        state = _adjusted(state, views, unknowns, strict_px, centre_px)
        if abs(state.camera.fx - before) < _SMALL_CHANGE * before:
            break
    return _told(state, views, unknowns, strict_px, centre_px)


def _posed(views: Sequence[View], camera: Camera, max_error_px: float, seed: int) -> _State:
    """Each view's pose as if the camera were known."""
    poses = []
    for view in views:
        ideal_px = camera.undistorted_px(view.px)
        usable = np.isfinite(ideal_px).all(axis=1)
        found = pnp.solve(view.points[usable], ideal_px[usable], camera.pinhole(), max_error_px=max_error_px, seed=seed)
        poses.append(None if found is None else found.local_from_camera)
    return _State(camera, tuple(poses))


def _adjusted(
    state: _State, views: Sequence[View], unknowns: Unknowns, max_error_px: float, centre_px: FloatArray
) -> _State:
    """The state that explains the matches best which it explained already."""
    return _minimised(*_problem(state, views, unknowns, max_error_px, centre_px))


def _problem(
    state: _State, views: Sequence[View], unknowns: Unknowns, max_error_px: float, centre_px: FloatArray
) -> tuple[_State, _Problem]:
    """What agrees with a state, which is returned without the poses that too little agrees with."""
    chosen = [
        None if pose is None else _choose(view, state.camera, pose, max_error_px)
        for view, pose in zip(views, state.poses, strict=True)
    ]
    height_m = _height_sigma([one for one in chosen if one is not None], max(v.height_sigma_m for v in views))
    taken: list[_Taken | None] = []
    slot = len(unknowns.names)
    for one, pose in zip(chosen, state.poses, strict=True):
        slots = np.concatenate([np.arange(len(unknowns.names)), np.arange(slot, slot + 6)])
        worth = None if one is None or pose is None else _worth(one, state.camera, pose, unknowns, height_m)
        if one is None or worth is None:
            taken.append(None)
        else:
            taken.append(_Taken(one, *worth, slots))
            slot += 6
    poses = tuple(pose if one is not None else None for pose, one in zip(state.poses, taken, strict=True))
    return _State(state.camera, poses), _Problem(tuple(taken), unknowns, height_m, centre_px)


def _choose(view: View, camera: Camera, pose: Rigid3, max_error_px: float) -> _Chosen | None:
    """None if too few matches agree with the pose."""
    residuals, jacobian = _linearised(view.points, view.px, camera, pose, _FOCAL_ALONE)
    inliers = np.linalg.norm(residuals, axis=1) <= max_error_px
    if np.count_nonzero(inliers) < pnp.MINIMUM_POINTS or pnp.on_one_spot(view.px[inliers], max_error_px):
        return None
    residuals, lift = residuals[inliers], _by_height(jacobian[inliers])
    px_per_m = np.linalg.norm(lift, axis=1)
    unit = lift / np.maximum(px_per_m, 1e-12)[:, None]
    across = residuals[:, :1] * unit[:, 1:] - residuals[:, 1:] * unit[:, :1]
    return _Chosen(
        view.points[inliers],
        view.px[inliers],
        inliers,
        view.known,
        (residuals * unit).sum(axis=1),
        px_per_m,
        huber_scale(across, max_error_px) / HUBER_BEND,
    )


def _by_height(jacobian: FloatArray) -> FloatArray:
    """(N, 2) px per m that a point rises, which is that much that the camera sinks."""
    return -jacobian[:, :, -4]


def _height_sigma(chosen: Sequence[_Chosen], least_m: float) -> float:
    """1-sigma of the map's heights that makes errors along the image of the vertical as likely as those across it."""
    if not chosen:
        return least_m
    squared = np.concatenate([one.along_px**2 for one in chosen])
    across = np.concatenate([np.full(len(one.points), one.sigma_px**2) for one in chosen])
    per_m = np.concatenate([one.px_per_m**2 for one in chosen])

    def too_small(sigma_m: float) -> bool:
        return bool(np.median(squared / (across + per_m * sigma_m**2)) > _MEDIAN_CHI_SQUARED)

    low, high = least_m, max(_MAX_HEIGHT_SIGMA_M, least_m)
    if not too_small(low):
        return low
    for _ in range(40):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if too_small(middle) else (low, middle)
    return high


def _worth(
    one: _Chosen, camera: Camera, pose: Rigid3, unknowns: Unknowns, height_m: float
) -> tuple[float, float] | None:
    """Matches that tell as much as one, and the variance of whitened residuals; None if they don't determine a pose."""
    residuals, jacobian = _whitened(one, camera, pose, unknowns, height_m)
    weights = huber_weights(residuals, HUBER_BEND)
    freedom = max(2 * len(residuals) - jacobian.shape[2], 1)
    variance = max(float((weights[:, None] * residuals**2).sum()) / freedom, 1e-12)
    try:
        alike = cov.design_effect(jacobian[:, :, -6:], residuals, weights, pnp.clusters(one.px, camera), variance)
    except np.linalg.LinAlgError:
        return None
    return alike, variance


def _minimised(state: _State, problem: _Problem) -> _State:
    if not any(problem.taken):
        return state
    return minimise(state, lambda at: _quadratic(at, problem), lambda at, step: _moved(at, step, problem.unknowns))


def _quadratic(state: _State, problem: _Problem) -> Quadratic:
    size = len(problem.unknowns.names) + 6 * sum(one is not None for one in problem.taken)
    cost, normal, gradient = 0.0, np.zeros((size, size)), np.zeros(size)
    for one, pose in zip(problem.taken, state.poses, strict=True):
        if one is None or pose is None:
            continue
        whitened = _whitened(one.chosen, state.camera, pose, problem.unknowns, problem.height_sigma_m)
        part = huber(*whitened, HUBER_BEND)
        if not np.isfinite(part.cost):
            return part
        cost += part.cost / one.inflation
        normal[np.ix_(one.slots, one.slots)] += part.normal / one.inflation
        gradient[one.slots] += part.gradient / one.inflation
    for where, error, information in _beside(state, problem):
        cost += 0.5 * float(error @ information @ error)
        normal[np.ix_(where, where)] += information
        gradient[where] += information @ error
    return Quadratic(cost, normal, gradient)


def _beside(state: _State, problem: _Problem) -> Iterator[tuple[np.ndarray, FloatArray, FloatArray]]:
    """What is known beside the photos: which parameters, their error and its inverse covariance."""
    for one, pose in zip(problem.taken, state.poses, strict=True):
        if one is not None and pose is not None and one.chosen.known is not None:
            measured = one.chosen.known.at(pose)
            yield one.slots[-6:], measured.error(pose), measured.information
    if problem.unknowns.principal_point_sigma:
        sigma_px = problem.unknowns.principal_point_sigma * max(state.camera.width, state.camera.height)
        off_px = np.array([state.camera.cx, state.camera.cy]) - problem.centre_px
        yield np.array([1, 2]), off_px, np.eye(2) / sigma_px**2


def _whitened(
    one: _Chosen, camera: Camera, pose: Rigid3, unknowns: Unknowns, height_sigma_m: float
) -> tuple[FloatArray, FloatArray]:
    """Residuals (N, 2) and Jacobian (N, 2, K + 6) in standard deviations, each point's height being what fits best.

    With ``r`` the residual, ``l`` the pixels per metre of height and ``dz`` the best change of it, ``r + l dz`` over
    the pixels' sigma and ``dz`` over the heights' have the same squared sum as ``r`` in the metric of
    ``s^2 1 + sz^2 l l^T``. The Jacobian is that at the changed height: taken at the map's, noise in it would again
    pass for relief.
    """
    residuals, jacobian = _linearised(one.points, one.px, camera, pose, unknowns)
    if height_sigma_m == 0.0 or not np.isfinite(residuals).all():
        return residuals / one.sigma_px, jacobian / one.sigma_px
    lift = _by_height(jacobian)
    ratio = (height_sigma_m / one.sigma_px) ** 2
    change = -ratio * (lift * residuals).sum(axis=1) / (1.0 + ratio * (lift**2).sum(axis=1))
    raised = one.points.copy()
    raised[:, 2] += change
    residuals, jacobian = _linearised(raised, one.px, camera, pose, unknowns)
    lift = _by_height(jacobian)
    squared = (lift**2).sum(axis=1)
    shrink = (1.0 - 1.0 / np.sqrt(1.0 + ratio * squared)) / np.maximum(squared, 1e-300)
    whiten = (np.eye(2) - shrink[:, None, None] * lift[:, :, None] * lift[:, None, :]) / one.sigma_px
    return np.einsum("nij,nj->ni", whiten, residuals - lift * change[:, None]), whiten @ jacobian


def _linearised(
    points: FloatArray, px: FloatArray, camera: Camera, pose: Rigid3, unknowns: Unknowns
) -> tuple[FloatArray, FloatArray]:
    """Residuals (N, 2), infinite behind the camera, and their Jacobian (N, 2, K + 6) by the intrinsics that are
    unknown and by camera centre and rotation vector."""
    lens_free = camera.pinhole()
    focal, centre = np.array([camera.fx, camera.fy]), np.array([camera.cx, camera.cy])
    ideal, by_pose = linearised(points, np.zeros_like(px), lens_free, pose)
    ahead = np.asarray(np.isfinite(ideal).all(axis=1))
    xy = (np.where(ahead[:, None], ideal, centre) - centre) / focal
    from_axis = camera.distort(xy) * focal
    residuals = np.where(ahead[:, None], from_axis + centre - px, np.inf)
    if not camera.is_pinhole:
        by_pose = (camera.distortion_jacobian(xy) * (focal[:, None] / focal)) @ by_pose
    columns = [from_axis]
    if unknowns.principal_point_sigma:
        columns += [np.broadcast_to([1.0, 0.0], px.shape), np.broadcast_to([0.0, 1.0], px.shape)]
    squared = (xy**2).sum(axis=1, keepdims=True)
    columns += [focal * xy * squared ** (term + 1) for term in range(unknowns.radial)]
    by_intrinsics = np.where(ahead[:, None, None], np.stack(columns, axis=2), 0.0)
    return residuals, np.concatenate([by_intrinsics, by_pose], axis=2)


def _moved(state: _State, step: FloatArray, unknowns: Unknowns) -> _State:
    count = len(unknowns.names)
    by_name = dict(zip(unknowns.names, step[:count], strict=True))
    log_step = float(np.clip(by_name["log_focal"], -_LARGEST_LOG_STEP, _LARGEST_LOG_STEP))
    least, most = _focal_range(state.camera)
    focal = min(max(state.camera.fx * math.exp(log_step), least), most)
    camera = _zoomed(state.camera, focal / state.camera.fx)
    k1, k2, *rest = camera.distortion
    camera = replace(
        camera,
        cx=camera.cx + by_name.get("cx", 0.0),
        cy=camera.cy + by_name.get("cy", 0.0),
        distortion=(k1 + by_name.get("k1", 0.0), k2 + by_name.get("k2", 0.0), *rest),
    )
    steps = iter(step[count:].reshape(-1, 6))
    return _State(camera, tuple(None if pose is None else moved(pose, next(steps)) for pose in state.poses))


# -- what it is worth --------------------------------------------------------------------------------------


def _told(
    state: _State, views: Sequence[View], unknowns: Unknowns, max_error_px: float, centre_px: FloatArray
) -> Calibration | None:
    """None if the matches don't determine the parameters at all."""
    state, problem = _problem(state, views, unknowns, max_error_px, centre_px)
    if not any(problem.taken):
        return None
    normal = _quadratic(state, problem).normal
    # Within what range it is is known, which keeps the inverse in bounds where the photos tell nothing.
    normal[0, 0] += 12.0 / math.log(_PLAUSIBLE_FOCAL[1] / _PLAUSIBLE_FOCAL[0]) ** 2
    scale = 1.0 / np.sqrt(np.maximum(np.diag(normal), 1e-300))
    scaled = normal * np.outer(scale, scale)
    if not np.isfinite(scaled).all() or np.linalg.cond(scaled) > 1e12:
        return None
    by_heights = _by_height_sigma(state, problem)
    covariance = np.linalg.inv(scaled) * np.outer(scale, scale) + np.outer(by_heights, by_heights)
    if np.any(np.diag(covariance) <= 0):
        return None
    estimates: list[pnp.PoseEstimate | None] = []
    cost = 0.0
    for one, view, pose in zip(problem.taken, views, state.poses, strict=True):
        if one is None or pose is None:
            estimates.append(None)
            cost += max_error_px**2 * len(view.points)
            continue
        residuals, _ = _linearised(view.points, view.px, state.camera, pose, _FOCAL_ALONE)
        errors = np.linalg.norm(residuals, axis=1)
        cost += float((np.minimum(errors, max_error_px) ** 2).sum())
        estimates.append(_estimate(state.camera, pose, covariance, one, errors))
    taken = [one for one in problem.taken if one is not None]
    return Calibration(
        state.camera,
        unknowns,
        covariance,
        tuple(estimates),
        cost,
        float(np.mean([one.chosen.sigma_px**2 * one.inflation for one in taken])),
        sum(float(error @ information @ error) for _, error, information in _beside(state, problem)),
        problem.height_sigma_m,
    )


def _by_height_sigma(state: _State, problem: _Problem) -> FloatArray:
    """(K + 6 V,) by how much the parameters change with the heights' variance by its own standard deviation."""
    taken = [one for one in problem.taken if one is not None]
    independent = sum(len(one.chosen.points) / one.alike for one in taken)
    px2 = np.concatenate(
        [one.chosen.sigma_px**2 + (one.chosen.px_per_m * problem.height_sigma_m) ** 2 for one in taken]
    )
    per_m2 = np.concatenate([one.chosen.px_per_m**2 for one in taken])
    # A variance told by a median: its relative error is 1.64 times that of the mean square, the root of 2 / N.
    off_m2 = 1.64 * math.sqrt(2.0 / independent) * float(np.median(px2) / np.median(per_m2))
    other = replace(problem, height_sigma_m=math.sqrt(problem.height_sigma_m**2 + off_m2))
    there = _minimised(state, other)
    here = _minimised(state, problem)
    by_name = {
        "log_focal": math.log(there.camera.fx / here.camera.fx),
        "cx": there.camera.cx - here.camera.cx,
        "cy": there.camera.cy - here.camera.cy,
        "k1": there.camera.distortion[0] - here.camera.distortion[0],
        "k2": there.camera.distortion[1] - here.camera.distortion[1],
    }
    change = [np.array([by_name[name] for name in problem.unknowns.names])]
    for one, other_one in zip(here.poses, there.poses, strict=True):
        if one is not None and other_one is not None:
            change += [other_one.translation - one.translation, rotation.log(other_one.rotation @ one.rotation.T)]
    return np.concatenate(change)


def _estimate(
    camera: Camera, pose: Rigid3, covariance: FloatArray, one: _Taken, errors: FloatArray
) -> pnp.PoseEstimate:
    own = covariance[np.ix_(one.slots[-6:], one.slots[-6:])]
    axis = pose.rotation[:, 2]
    with_focal = float(axis @ covariance[one.slots[-6:-3], 0])
    inliers = one.chosen.inliers
    return pnp.PoseEstimate(
        pose,
        camera,
        own,
        inliers,
        errors,
        float(np.sqrt(np.mean(errors[inliers] ** 2))),
        camera.focal_px * float(np.sqrt(covariance[0, 0])),
        with_focal / float(np.sqrt(axis @ own[:3, :3] @ axis * covariance[0, 0])),
    )


def _zoomed(camera: Camera, factor: float) -> Camera:
    """The camera with both focal lengths scaled: the aspect and the principal point stay, as in the paper."""
    return replace(camera, fx=camera.fx * factor, fy=camera.fy * factor)


def _focal_range(camera: Camera) -> tuple[float, float]:
    """Of fx, px."""
    least, most = (part * max(camera.width, camera.height) for part in _PLAUSIBLE_FOCAL)
    return least, most


def _turned(pose: Rigid3, turn: FloatArray) -> Rigid3:
    return moved(pose, np.concatenate([np.zeros(3), turn]))
