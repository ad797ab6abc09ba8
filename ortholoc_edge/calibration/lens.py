"""Focal length, principal point and distortion from views of a board.

OpenCV solves; what it can't say is done here: which views don't belong to the others, how many terms of distortion the
views bear (as many as lower the error of views that took no part), how well each parameter is known, and whether that
is a calibration at all.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from ortholoc_edge.calibration.board import Board, Seen
from ortholoc_edge.geometry.arrays import FloatArray, IntArray
from ortholoc_edge.geometry.camera import Camera

# Terms of distortion, few to many: what OpenCV holds at zero, and which columns of its Jacobian (from the focal lengths
# on) are solved for.
_FIX = {"k1": cv2.CALIB_FIX_K1, "k2": cv2.CALIB_FIX_K2, "k3": cv2.CALIB_FIX_K3}
MODELS: dict[str, tuple[str, ...]] = {
    "none": (), "k1": ("k1",), "k1k2": ("k1", "k2"), "k1k2p1p2": ("k1", "k2", "p1", "p2"),
    "k1k2p1p2k3": ("k1", "k2", "p1", "p2", "k3"),
}  # fmt: skip
_TERMS = ("k1", "k2", "p1", "p2", "k3")
_FOLDS = 5
# Of the squared error on held-out views: less than this is no reason for another term.
_NO_GAIN = 0.02
# A view whose error is so many times the usual one, and this many px, shows something else: a bent board, a smear.
_BAD_VIEW, _LEAST_BAD_PX = 2.5, 0.15
# A corner that is so many times as far off as half of its view's are, is no corner of the board; nor are more than so
# many of a view, which is a bad one then.
_BAD_CORNER, _MOST_BAD_CORNERS = 4.0, 0.1
_MOST_BAD_VIEWS = 1 / 3
LEAST_VIEWS = 10
# Tilt of the board that tells the focal length from the distance, and how many views must have it.
_TILTED_DEG, _LEAST_TILTED = 15.0, 4
# Ratio of tilts about two axes: all about one leave the other focal length to it.
_LEAST_OTHER_TILT = 0.1
# Share of the picture within the hull of all corners, and corners that each ninth of it must hold.
_LEAST_HULL, _LEAST_IN_NINTH = 0.6, 6
# Of the long side of the picture: what a good corner is off by at 1280 px is 0.1 to 0.3 px.
_MOST_RMS = 0.8e-3
# Relative, of the focal lengths; of the long side, of the principal point.
_MOST_FOCAL_SIGMA, _MOST_CENTRE_SIGMA = 0.005, 0.005


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """A board in a picture, and the picture's name."""

    name: str
    seen: Seen


@dataclass(frozen=True, slots=True, eq=False)
class SolvedView:
    """A view of a solution.

    Attributes:
        residuals_px: (N, 2) where the corners are seen, less where they should be.
        tilt_deg: of the board against the picture's plane; axis_rad: about which axis in it.
    """

    view: View
    residuals_px: FloatArray
    tilt_deg: float
    axis_rad: float

    @property
    def rms_px(self) -> float:
        return float(np.sqrt(np.mean(np.sum(self.residuals_px**2, axis=1))))


@dataclass(frozen=True, slots=True, eq=False)
class Refusal:
    """Why the views are no calibration, and what to film."""

    what: str
    remedy: str


@dataclass(frozen=True, slots=True, eq=False)
class LensCalibration:
    """A camera as the views tell it.

    Attributes:
        model: of `MODELS`.
        names: of what was solved for; covariance: (K, K) of it, px and the distortion's own units.
        views: that took part. removed: name and reason of those that did not agree with the others.
        held_out_px: of each model that was tried: rms error of views that took no part.
    """

    camera: Camera
    model: str
    names: tuple[str, ...]
    covariance: FloatArray
    views: tuple[SolvedView, ...]
    removed: Mapping[str, str]
    held_out_px: Mapping[str, float]

    def sigma(self, name: str) -> float:
        """1-sigma of a parameter; 0 of one that was not solved for."""
        if name not in self.names:
            return 0.0
        index = self.names.index(name)
        return float(np.sqrt(self.covariance[index, index]))

    @property
    def rms_px(self) -> float:
        """Of all corners, in both directions together."""
        every = np.concatenate([view.residuals_px for view in self.views])
        return float(np.sqrt(np.mean(np.sum(every**2, axis=1))))


def calibrate(
    views: Sequence[View], board: Board, size: tuple[int, int], model: str | None = None
) -> LensCalibration | Refusal:
    """The camera that took some views of a board.

    Args:
        size: width and height of the pictures, px.
        model: of `MODELS`; None: the one with the fewest terms that does as well on held-out views as any.
    """
    if len(views) < LEAST_VIEWS:
        return Refusal(
            f"{len(views)} usable views of the board, and {LEAST_VIEWS} are the least",
            f"film {LEAST_VIEWS} to 40 that differ: near and far, in every corner of the picture, tilted",
        )
    if (refusal := _spread(views, size)) is not None:
        return refusal
    kept, removed = _agreeing(list(views), board, size)
    if len(removed) > _MOST_BAD_VIEWS * len(views):
        return Refusal(
            f"{len(removed)} of {len(views)} views don't agree with the others",
            "is the board flat and stiff, the number of its squares right, focus and zoom locked, the picture not "
            "stabilised? Hold it still: a rolling shutter bends what moves",
        )
    held_out = {name: _held_out(kept, board, size, name) for name in (MODELS if model is None else [model])}
    chosen = model or _simplest(held_out)
    solution = _solved(kept, board, size, chosen)
    assert solution is not None, "it was solved with more terms"
    found = _told(solution, kept, board, size, chosen, removed, held_out)
    return _refused(found) or found


# -- solving -------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class _Solution:
    """As OpenCV has it: ``matrix`` (3, 3), ``distortion`` (5,), and the board's poses."""

    matrix: FloatArray
    distortion: FloatArray
    turns: Sequence[FloatArray]
    places: Sequence[FloatArray]


def _solved(views: Sequence[View], board: Board, size: tuple[int, int], model: str) -> _Solution | None:
    points = board.points
    terms = MODELS[model]
    flags = sum(flag for name, flag in _FIX.items() if name not in terms)
    if "p1" not in terms:
        flags |= cv2.CALIB_ZERO_TANGENT_DIST
    try:
        _, matrix, distortion, turns, places = cv2.calibrateCamera(
            [points[view.seen.ids].astype(np.float32) for view in views],
            [view.seen.px.astype(np.float32) for view in views],
            size, np.eye(3), np.zeros(5), flags=flags,
            criteria=(cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 60, 1e-10),
        )  # fmt: skip
    except cv2.error:
        # Of boards that are all parallel to the picture there is no start.
        return None
    return _Solution(
        _floats(matrix), _floats(distortion).ravel()[:5], [_floats(one) for one in turns],
        [_floats(one) for one in places],
    )  # fmt: skip


def _floats(values: object) -> FloatArray:
    return np.asarray(values, dtype=np.float64)


def _residuals(view: View, board: Board, solution: _Solution, number: int) -> FloatArray:
    projected, _ = cv2.projectPoints(
        board.points[view.seen.ids], solution.turns[number], solution.places[number], solution.matrix,
        solution.distortion,
    )  # fmt: skip
    return view.seen.px - np.asarray(projected).reshape(-1, 2)


def _agreeing(views: list[View], board: Board, size: tuple[int, int]) -> tuple[list[View], dict[str, str]]:
    """The views, and corners in them, that agree with each other; and why the others don't."""
    removed: dict[str, str] = {}
    least = {view.name: (1.0 - _MOST_BAD_CORNERS) * len(view.seen.ids) for view in views}
    while True:
        solution = _solved(views, board, size, "k1k2p1p2")
        if solution is None:
            return views, removed
        errors = [_residuals(view, board, solution, number) for number, view in enumerate(views)]
        rms = np.array([np.sqrt(np.mean(np.sum(error**2, axis=1))) for error in errors])
        usual = float(np.median(rms))
        worst = int(rms.argmax())
        if rms[worst] > max(_BAD_VIEW * usual, _LEAST_BAD_PX):
            view, off = views[worst], np.linalg.norm(errors[worst], axis=1)
            seen, corner = view.seen, int(off.argmax())
            if off[corner] > _BAD_CORNER * float(np.median(off)) and len(off) - 1 >= least[view.name]:
                left = np.arange(len(off)) != corner
                views[worst] = View(view.name, Seen(seen.ids[left], seen.px[left], seen.blur_px))
                continue
            removed[view.name] = f"{rms[worst]:.2f} px rms where {usual:.2f} px is usual"
            del views[worst]
            if len(views) >= LEAST_VIEWS:
                continue
        return views, removed


def _held_out(views: Sequence[View], board: Board, size: tuple[int, int], model: str) -> FloatArray:
    """(V,) mean squared error of each view, px^2, with a camera that it took no part in; infinite without one."""
    found = np.full(len(views), np.inf)
    folds = min(_FOLDS, len(views))
    for fold in range(folds):
        solution = _solved([v for i, v in enumerate(views) if i % folds != fold], board, size, model)
        if solution is None:
            continue
        for i in range(fold, len(views), folds):
            points = board.points[views[i].seen.ids]
            good, turn, place = cv2.solvePnP(points, views[i].seen.px, solution.matrix, solution.distortion)
            if good:
                alone = _Solution(solution.matrix, solution.distortion, [_floats(turn)], [_floats(place)])
                found[i] = np.mean(np.sum(_residuals(views[i], board, alone, 0) ** 2, axis=1))
    return found


def _simplest(held_out: Mapping[str, FloatArray]) -> str:
    """The first whose error on held-out views is within one standard error of the best one's, or nearly as small."""
    best = min(held_out, key=lambda name: float(held_out[name].mean()))
    for name, errors in held_out.items():
        if not np.isfinite(errors).all():
            continue
        more = errors - held_out[best]
        chance = float(more.std(ddof=1)) / math.sqrt(len(more))
        if name == best or float(more.mean()) <= max(chance, _NO_GAIN * float(held_out[best].mean())):
            return name
    return best


def _told(
    solution: _Solution, views: Sequence[View], board: Board, size: tuple[int, int], model: str,
    removed: Mapping[str, str], held_out: Mapping[str, FloatArray],
) -> LensCalibration:  # fmt: skip
    """With covariances: of the intrinsics, each view's pose being what fits best.

    With ``S`` the sum over views of ``J^T M J``, where M projects the pose away, it is ``s^2 S^-1`` as long as corners
    err independently. A board that is bent, or corners that are found beside their place in blur, err together within
    a view: the scores' sum per view tells by how much (`covariance.design_effect`).
    """
    columns = [0, 1, 2, 3, *(4 + _TERMS.index(term) for term in MODELS[model])]
    normal = np.zeros((len(columns), len(columns)))
    scores, squares, count = [], 0.0, 0
    solved = []
    for number, view in enumerate(views):
        points = board.points[view.seen.ids]
        projected, jacobian = cv2.projectPoints(
            points, solution.turns[number], solution.places[number], solution.matrix, solution.distortion
        )
        residuals = view.seen.px - np.asarray(projected).reshape(-1, 2)
        by_pose, by_camera = jacobian[:, :6], jacobian[:, 6:][:, columns]
        free = by_camera - by_pose @ np.linalg.lstsq(by_pose, by_camera, rcond=None)[0]
        normal += free.T @ free
        scores.append(free.T @ residuals.ravel())
        squares += float((residuals**2).sum())
        count += residuals.size
        toward = cv2.Rodrigues(solution.turns[number])[0][:, 2]
        tilt_deg = math.degrees(math.acos(min(abs(float(toward[2])), 1.0)))
        solved.append(SolvedView(view, residuals, tilt_deg, math.atan2(float(toward[1]), float(toward[0]))))
    variance = squares / max(count - len(columns) - 6 * len(views), 1)
    scale = 1.0 / np.sqrt(np.diag(normal))
    plain = variance * np.linalg.inv(normal * np.outer(scale, scale)) * np.outer(scale, scale)
    sums = np.array(scores)
    middle = sums.T @ sums * (len(views) / (len(views) - 1))
    effect = float(np.trace(np.linalg.solve(normal, middle))) / (len(columns) * variance)
    (fx, _, cx), (_, fy, cy), _ = solution.matrix.tolist()
    k1, k2, p1, p2, k3 = (value if term in MODELS[model] else 0.0
                          for term, value in zip(_TERMS, solution.distortion.tolist(), strict=True))  # fmt: skip
    return LensCalibration(
        Camera(*size, fx, fy, cx, cy, (k1, k2, p1, p2, k3)), model, ("fx", "fy", "cx", "cy", *MODELS[model]),
        plain * max(effect, 1.0), tuple(solved), removed,
        {name: float(np.sqrt(errors.mean())) for name, errors in held_out.items()},
    )  # fmt: skip


# -- judgement -----------------------------------------------------------------------------------------

_NINTHS = (
    "upper left", "top", "upper right", "left", "middle", "right", "lower left", "bottom", "lower right",
)  # fmt: skip


def _spread(views: Sequence[View], size: tuple[int, int]) -> Refusal | None:
    """Whether the corners cover the picture: distortion is what it is near its rim, and nowhere else does it show."""
    every = np.concatenate([view.seen.px for view in views])
    ninth: IntArray = np.clip((every / size * 3).astype(np.intp), 0, 2)
    counts = np.bincount(ninth[:, 1] * 3 + ninth[:, 0], minlength=9)
    empty = [name for name, number in zip(_NINTHS, counts, strict=True) if number < _LEAST_IN_NINTH]
    if empty:
        return Refusal(
            f"too few corners of the board in these parts of the picture: {', '.join(empty)}",
            "film the board there, too, partly near enough to fill a third of the picture",
        )
    hull = cv2.contourArea(cv2.convexHull(every.astype(np.float32))) / (size[0] * size[1])
    if hull < _LEAST_HULL:
        return Refusal(
            f"the board was seen in {hull:.0%} of the picture, {_LEAST_HULL:.0%} is the least",
            "film it up to the picture's rim, on all four sides",
        )
    return None


def _refused(found: LensCalibration) -> Refusal | None:
    camera, long_px = found.camera, max(found.camera.width, found.camera.height)
    tilted = [view for view in found.views if view.tilt_deg >= _TILTED_DEG]
    if len(tilted) < _LEAST_TILTED:
        return Refusal(
            f"the board is tilted by {_TILTED_DEG:g} degrees and more in {len(tilted)} views, {_LEAST_TILTED} are the "
            "least: straight on, a longer lens from farther away makes the same picture",
            "tilt it by 20 to 45 degrees, to the left, right, up and down",
        )
    axes = sum(np.outer(axis, axis) for axis in
               (np.array([math.cos(v.axis_rad), math.sin(v.axis_rad)]) for v in tilted))  # fmt: skip
    least, most = np.linalg.eigvalsh(np.asarray(axes))
    if least < _LEAST_OTHER_TILT * most:
        return Refusal(
            "the board is tilted about one axis only", "tilt it about the other, too: left and right, up and down"
        )
    if found.rms_px > _MOST_RMS * long_px:
        return Refusal(
            f"corners are {found.rms_px:.2f} px off their places (rms), {_MOST_RMS * long_px:.2f} px is the most",
            "is the board flat, printed without scaling in one direction, and held still? A lens of more than 120 "
            "degrees is no pinhole",
        )
    for name, focal in (("fx", camera.fx), ("fy", camera.fy)):
        if not found.sigma(name) <= _MOST_FOCAL_SIGMA * focal:
            return Refusal(
                f"{name} is {focal:.1f} px with a 1-sigma of {found.sigma(name):.1f} px, {_MOST_FOCAL_SIGMA:.1%} is "
                "the most",
                "film more views, tilted by 20 to 45 degrees, and near enough to fill the picture",
            )
    for name in ("cx", "cy"):
        if not found.sigma(name) <= _MOST_CENTRE_SIGMA * long_px:
            return Refusal(
                f"the principal point's {name} has a 1-sigma of {found.sigma(name):.1f} px, "
                f"{_MOST_CENTRE_SIGMA * long_px:.1f} px is the most",
                "film more views in which the board is tilted, upright and on its side",
            )
    return None
