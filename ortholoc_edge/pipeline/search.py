"""Where in a whole map a frame may have been taken, when nothing says where to look but attitude and height.

The frame is rectified north-up at the map's coarse scale, for every heading and height that come into question, and its
edge directions are correlated with the map's everywhere, by the Fourier transform. What comes out are candidates: the
`Localizer` decides about each.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Final

import cv2
import numpy as np

from ortholoc_edge.geometry import rotation
from ortholoc_edge.geometry.arrays import BoolArray, Float32Array, FloatArray, ImageArray
from ortholoc_edge.geometry.camera import Camera
from ortholoc_edge.geometry.grid import RasterGrid
from ortholoc_edge.matching.orientation import orientation_field
from ortholoc_edge.pipeline.rectify import rectified
from ortholoc_edge.tiles.coarse import MEAN_PX, CoarseField

# Turn of a frame from one heading tried to the next: what a frame of 60 to 110 px bears to either side of it.
_TURN_RAD: Final = math.radians(4.0)
# And from one height to the next, as a factor.
_ZOOM: Final = 1.14
# The same where a place is looked at again.
_FINE_ZOOM: Final = 1.02
# Least side of the blocks that are transformed. Of 1024 px less is wasted on the rims, but a third more time is needed,
# since they do not fit the cache, and 100 MB instead of 4.
_BLOCK_PX: Final = 512
_MAX_CANVAS_PX: Final = 256
# A frame with less to see than this is not looked for, px; and from so many on its edges tell it from others.
_MIN_CANVAS_PX: Final = 24
_ENOUGH_PX: Final = 56
# Places closer than this are the same, px.
_APART_PX: Final = 8
_PER_BLOCK: Final = 8
# Places found at half the scale that are looked at again at full scale.
_LOOKED_AT: Final = 150
# Headings for which templates are held in memory at a time: 0.5 MB for each and each height above ground.
_TURNS_AT_A_TIME: Final = 4
# Of the map's mean energy: where there is less, a frame that fits well does so by chance.
_LEAST_ENERGY: Final = 0.3


@dataclass(frozen=True, slots=True, eq=False)
class Sighting:
    """A frame and what is known of its pose: all but the place.

    Attributes:
        grey: (H, W) uint8, as the camera gives it.
        camera: its intrinsics.
        map_from_camera: (3, 3) believed attitude.
        heading_reach_rad: how far the heading may be off; pi: it is unknown.
        above_ground_m: height of the camera over the ground; NaN where ``height_m`` tells it.
        height_m: of the camera, in the map's heights, by a barometer; NaN where ``above_ground_m`` tells it.
        height_reach: how far the height above ground may be off, as a part of it.
    """

    grey: ImageArray
    camera: Camera
    map_from_camera: FloatArray
    heading_reach_rad: float
    above_ground_m: float
    height_m: float = math.nan
    height_reach: float = 0.04


@dataclass(frozen=True, slots=True)
class Candidate:
    """A place where the frame may have been taken.

    Attributes:
        easting_m, northing_m: of the camera.
        above_ground_m: height that it was tried for.
        turn_rad: of the believed attitude about the vertical.
        score: normalised correlation with the map, at most about 1; of a height above ground that is lower than the
            highest in question less in that ratio: the fewer pixels a frame has, the better it fits by chance.
    """

    easting_m: float
    northing_m: float
    above_ground_m: float
    turn_rad: float
    score: float

    def distance_m(self, other: Candidate) -> float:
        return math.hypot(self.easting_m - other.easting_m, self.northing_m - other.northing_m)


@dataclass(frozen=True, slots=True, eq=False)
class _Template:
    """The frame as one heading and height show it.

    Attributes:
        spectra: of real and imaginary part, padded to a block, scaled so that a product with the map's is a sum of
            products over the root of the frame's own energy and its number of pixels.
        turn_rad, above_ground_m: that it is for.
        foot_px: (x, y) of the point below the camera.
        pixels: that show the frame.
    """

    spectra: tuple[np.ndarray, np.ndarray]
    turn_rad: float
    above_ground_m: float
    foot_px: tuple[int, int]
    pixels: int


@dataclass(frozen=True, slots=True, eq=False)
class Former:
    """What an earlier frame of the same flight came to.

    Attributes:
        candidates: of its search.
        moved_m: (2,) east and north, how the vehicle has moved since.
    """

    candidates: Sequence[Candidate]
    moved_m: FloatArray


def agreeing(latest: Sequence[Candidate], former: Sequence[Former], apart_m: float, count: int = 20) -> list[Candidate]:
    """Candidates of several frames put together by how the vehicle moved between them: where a field or a street
    pattern looks like another the sequence decides.

    Args:
        apart_m: what a frame's place and the motion may be off together, up to the latest frame.
    Returns: places of the latest frame, the best first; the score is the mean over the frames, and a frame that has
    nothing near counts with its worst candidate's. With nothing ``former``, ``latest`` as it is.
    """
    if not former:
        return list(latest)
    now = [list(latest)]
    for frame in former:
        x, y = np.asarray(frame.moved_m, dtype=np.float64).tolist()
        now.append(
            [replace(one, easting_m=one.easting_m + x, northing_m=one.northing_m + y) for one in frame.candidates]
        )
    together = np.zeros(sum(map(len, now)))
    places = np.array([(one.easting_m, one.northing_m) for found in now for one in found]).reshape(-1, 2)
    for found in now:
        if not found:
            continue
        scores = np.array([one.score for one in found])
        theirs = np.array([(one.easting_m, one.northing_m) for one in found])
        near = np.linalg.norm(places[:, None] - theirs, axis=2) <= apart_m
        together += np.maximum(np.where(near, scores, -np.inf).max(axis=1), scores.min())
    means = (together / len(now)).tolist()
    # A place of the latest frame stands for what others have near it: its heading and height are this frame's.
    own = [replace(one, score=mean) for one, mean in zip(latest, means, strict=False)]
    others = [
        replace(one, score=mean)
        for one, mean in zip((one for found in now[1:] for one in found), means[len(own) :], strict=True)
    ]
    own = distinct(own, apart_m, count)
    return distinct([*own, *(one for one in others if _apart(one, own, apart_m))], apart_m, count)


def fitting_level(grids: Sequence[RasterGrid], camera: Camera, above_ground_m: float) -> int:
    """Of the levels of an orthophoto, finest first: the coarsest at which a frame taken straight down shows enough; the
    finest if none is."""
    short_m = above_ground_m * min(camera.width / camera.fx, camera.height / camera.fy)
    fine = [level for level, grid in enumerate(grids) if short_m >= _ENOUGH_PX * grid.gsd_m]
    return fine[-1] if fine else 0


class Searcher:
    """A map to look for frames in. Safe to use from several threads.

    Args:
        field: of the map.
        threads: that share the work of one search.
    """

    def __init__(self, field: CoarseField, threads: int = 2) -> None:
        self.field = field
        self._half = field.halved()
        self._pool = ThreadPoolExecutor(threads, thread_name_prefix="search")

    def close(self) -> None:
        self._pool.shutdown()

    def search(self, sighting: Sighting, count: int = 20, within: FloatArray | None = None) -> list[Candidate]:
        """The places where a frame fits best, the best first, each apart from the others by `_APART_PX`.

        Args:
            count: of places.
            within: (N, 2) corners of the area where the camera was, in the map; None: anywhere.
        Returns: an empty list where the frame shows too little ground for the field's pixels, or has no edges.
        """
        # At half the scale, in steps twice as wide, an eighth of the work; whatever is promising there is looked at
        # again.
        rough = self._everywhere(sighting, _scale(sighting, self._half, 2), within)
        apart_m = _APART_PX * self.field.grid.gsd_m
        near = _Near(sighting, self.field, within)
        places = distinct(rough, apart_m, _LOOKED_AT)
        found = [candidate for here in self._pool.map(near.best, places) for candidate in here]
        return distinct(found, apart_m, count)

    def _everywhere(self, sighting: Sighting, scale: _Scale, within: FloatArray | None) -> list[Candidate]:
        found: list[Candidate] = []
        turns = _turns(sighting.heading_reach_rad, scale.halving * _TURN_RAD)
        zooms = _zooms(sighting.height_reach)
        tasks = list(_tasks(sighting, scale, within))
        heights = sorted({above_m for _, tries in tasks for above_m, _ in tries})
        for first in range(0, len(turns), _TURNS_AT_A_TIME):
            some = turns[first : first + _TURNS_AT_A_TIME]
            wanted = [(above_m, above_m * zoom, turn) for above_m in heights for zoom in zooms for turn in some]
            made = self._pool.map(lambda one: _template(sighting, scale, one[1], one[2]), wanted)
            templates: dict[float, list[_Template]] = {above_m: [] for above_m in heights}
            for (above_m, _, _), template in zip(wanted, made, strict=True):
                if template is not None:
                    templates[above_m].append(template)
            for part in self._pool.map(
                lambda task, those=templates: _search_block(
                    scale, task[0], [(those[above_m], band) for above_m, band in task[1]], _PER_BLOCK
                ),
                tasks,
            ):
                found += part
        return found


class _Near:
    """The surroundings of places that were found at half the scale, at full scale."""

    def __init__(self, sighting: Sighting, field: CoarseField, within: FloatArray | None) -> None:
        self._sighting, self._field, self._within = sighting, field, within
        self._highest_m = _highest_m(sighting, field)
        # Many places have the same heading and height. Made twice, where threads want one at once, they are the same.
        self._made: dict[tuple[float, float], _Template | None] = {}

    def best(self, place: Candidate) -> list[Candidate]:
        """The best place around; none outside of the area."""
        field, above_m, side = self._field, place.above_ground_m, 4 * _APART_PX
        column, row = np.round(field.grid.px_from_map((place.easting_m, place.northing_m))).astype(int).tolist()
        if not math.isfinite(self._sighting.above_ground_m):
            # Here it is known better than to a step.
            ground_m = float(field.ground_m(np.array([[place.easting_m, place.northing_m]]))[0])
            if self._sighting.height_m - ground_m > 1.0:
                steps = round(math.log(self._sighting.height_m - ground_m) / math.log(_FINE_ZOOM))
                above_m = _FINE_ZOOM**steps
        needed_px = side + 2 * _margin_px(replace(self._sighting, above_ground_m=above_m), field, 1)
        scale = _Scale(field, 1, 2 * cv2.getOptimalDFTSize(-(-needed_px // 2)), self._highest_m)
        turns = (place.turn_rad - _TURN_RAD, place.turn_rad, place.turn_rad + _TURN_RAD)
        tried = [self._template(scale, above_m, turn_rad) for turn_rad in turns]
        templates = [template for template in tried if template is not None]
        block = _Block(column - side // 2, row - side // 2, side, self._within)
        return _search_block(scale, block, [(templates, None)], 1)

    def _template(self, scale: _Scale, above_m: float, turn_rad: float) -> _Template | None:
        key = above_m, round(turn_rad, 6)
        if key not in self._made:
            self._made[key] = _template(self._sighting, scale, above_m, turn_rad)
        return self._made[key]


@dataclass(frozen=True, slots=True, eq=False)
class _Scale:
    """A pass over the map: its field, by how much coarser than what frames are rectified for, the side of the blocks,
    and the highest that the camera can be above ground."""

    field: CoarseField
    halving: int
    block_px: int
    highest_m: float


def _scale(sighting: Sighting, field: CoarseField, halving: int) -> _Scale:
    """With blocks of which a third or more is their inside."""
    margin_px = _margin_px(sighting, field, halving)
    block_px = max(_BLOCK_PX // halving, 2 * cv2.getOptimalDFTSize(-(-3 * margin_px // 2)))
    return _Scale(field, halving, block_px, _highest_m(sighting, field))


def circle(middle: FloatArray, radius_m: float) -> FloatArray:
    """(32, 2) corners of an area that holds a circle, to search within."""
    angles = np.arange(32) * (2.0 * math.pi / 32)
    reach_m = radius_m / math.cos(math.pi / 32)
    return np.asarray(middle, dtype=np.float64)[:2] + reach_m * np.stack([np.cos(angles), np.sin(angles)], axis=1)


def distinct(found: Sequence[Candidate], apart_m: float, count: int) -> list[Candidate]:
    """The best, each apart from all better ones."""
    kept: list[Candidate] = []
    for candidate in sorted(found, key=lambda one: -one.score):
        if _apart(candidate, kept, apart_m):
            kept.append(candidate)
        if len(kept) == count:
            break
    return kept


def _apart(candidate: Candidate, others: Sequence[Candidate], apart_m: float) -> bool:
    return all(candidate.distance_m(other) > apart_m for other in others)


def _turns(reach_rad: float, step_rad: float) -> list[float]:
    count = max(math.ceil(2.0 * min(reach_rad, math.pi) / step_rad), 1)
    # The middles of equal parts.
    return [min(reach_rad, math.pi) * ((2 * k + 1) / count - 1.0) for k in range(count)]


def _zooms(reach: float) -> list[float]:
    count = max(math.ceil(2.0 * math.log1p(reach) / math.log(_ZOOM)), 1)
    return [math.exp(math.log1p(reach) * ((2 * k + 1) / count - 1.0)) for k in range(count)]


def _template(sighting: Sighting, scale: _Scale, above_m: float, turn_rad: float) -> _Template | None:
    halving, block_px = scale.halving, scale.block_px
    gsd_m = scale.field.grid.gsd_m / halving
    map_from_camera = rotation.exp([0.0, 0.0, turn_rad]) @ sighting.map_from_camera
    # Pixels of a north-up grid whose origin is below the camera, to the frame's.
    ground_from_grid = np.array([[gsd_m, 0.0, 0.0], [0.0, -gsd_m, 0.0], [0.0, 0.0, -above_m]])
    frame_from_grid = sighting.camera.matrix @ map_from_camera.T @ ground_from_grid
    seen = rectified(sighting.grey, sighting.camera, frame_from_grid, _MAX_CANVAS_PX**2)
    if seen is None or min(seen.image.shape) < _MIN_CANVAS_PX or max(seen.image.shape) > _MAX_CANVAS_PX:
        return None
    values = orientation_field(seen.image, seen.valid, MEAN_PX)
    rows, columns = (side // halving for side in values.shape[1:])
    corner = np.linalg.solve(frame_from_grid, seen.frame_from_canvas)
    # A halved pixel's centre lies between those of two.
    x, y = (round((-low - 0.5 * (halving - 1)) / halving) for low in (corner[:2, 2] / corner[2, 2]).tolist())
    pixels = int(np.count_nonzero(seen.valid)) // halving**2
    parts = [
        np.asarray(
            cv2.resize(part[: rows * halving, : columns * halving], (columns, rows), interpolation=cv2.INTER_AREA),
            dtype=np.float32,
        )
        for part in values
    ]
    energy = sum(float(np.square(part).sum()) for part in parts)
    if energy <= 0.0:
        return None
    spectra = []
    for part in parts:
        padded = np.zeros((block_px, block_px), np.float32)
        np.multiply(part, np.float32(1.0 / math.sqrt(energy * pixels)), out=padded[:rows, :columns])
        spectra.append(np.asarray(cv2.dft(padded, nonzeroRows=rows)))
    return _Template((spectra[0], spectra[1]), turn_rad, above_m, (x, y), pixels)


@dataclass(frozen=True, slots=True, eq=False)
class _Block:
    """Pixels of the field that a camera may be above: from (column, row) on, ``side`` to each side.

    Attributes:
        within: as of `Searcher.search`.
    """

    column: int
    row: int
    side: int
    within: FloatArray | None = None


# Heights of the ground from and to, m, that a height above ground is right for; None: any.
_Band = tuple[float, float] | None


def _tasks(
    sighting: Sighting, scale: _Scale, within: FloatArray | None
) -> Iterator[tuple[_Block, list[tuple[float, _Band]]]]:
    """Blocks of the map, and the heights above ground that each is to be searched for."""
    # A camera of a block needs the ground around it, up to half a canvas and more where it looks aslant.
    field, side = scale.field, scale.block_px - 2 * _margin_px(sighting, scale.field, scale.halving)
    left, upper, right, lower = 0, 0, field.grid.width, field.grid.height
    if within is not None:
        px = field.grid.px_from_map(within)
        left, upper = np.maximum(np.floor(px.min(axis=0)).astype(int), 0).tolist()
        right, lower = np.minimum(np.ceil(px.max(axis=0)).astype(int) + 1, (right, lower)).tolist()
    for row in range(upper, lower, side):
        for column in range(left, right, side):
            block = _Block(column, row, side, within)
            if math.isfinite(sighting.above_ground_m):
                yield block, [(sighting.above_ground_m, None)]
            else:
                yield block, list(_steps(sighting, field, block))


def _steps(sighting: Sighting, field: CoarseField, block: _Block) -> Iterator[tuple[float, _Band]]:
    """Heights above ground that a block's ground asks for, each with the ground that it is right for."""
    ground = _lattice(field, block)
    above = sighting.height_m - ground[np.isfinite(ground)]
    steps = np.unique(np.round(np.log(above[above > 1.0]) / math.log(_ZOOM)).astype(int))
    for step in steps.tolist():
        low_m, high_m = (sighting.height_m - _ZOOM ** (step + half) for half in (0.6, -0.6))
        yield _ZOOM**step, (low_m, high_m)


def _margin_px(sighting: Sighting, field: CoarseField, halving: int) -> int:
    """Pixels around a camera that its frame may show."""
    camera, gsd_m, above_m = sighting.camera, field.grid.gsd_m, _highest_m(sighting, field)
    corners = np.array([[0, 0], [camera.width, 0], [0, camera.height], [camera.width, camera.height]], np.float64)
    rays = camera.unproject(corners) @ sighting.map_from_camera.T
    slope = np.hypot(rays[:, 0], rays[:, 1]) / np.maximum(-rays[:, 2], 0.25)
    reach = (1.0 + sighting.height_reach) * above_m * float(np.nan_to_num(slope, nan=4.0).max()) / gsd_m
    return min(math.ceil(reach) + 3, _MAX_CANVAS_PX // halving)


def _highest_m(sighting: Sighting, field: CoarseField) -> float:
    """That the camera can be above ground."""
    if math.isfinite(sighting.above_ground_m):
        return sighting.above_ground_m
    lowest = float(np.nanmin(field.ground)) if np.isfinite(field.ground).any() else 0.0
    return max(sighting.height_m - lowest, 1.0)


def _search_block(
    scale: _Scale, block: _Block, tries: Sequence[tuple[Sequence[_Template], _Band]], count: int
) -> list[Candidate]:
    """The ``count`` best places of a block for each of the ``tries``, with the template that fits best at each."""
    field, block_px = scale.field, scale.block_px
    margin = (block_px - block.side) // 2
    values = field.block(block.column - margin, block.row - margin, block_px)
    squares = np.square(values[0]) + np.square(values[1])
    inner = slice(margin, margin + block.side)
    if not squares.any():
        return []
    spectra = [np.asarray(cv2.dft(part)) for part in values]
    least = _LEAST_ENERGY * float(squares[squares > 0].mean())
    inside = None if block.within is None else _inside(field, block)
    ground = _ground(field, block) if any(band is not None for _, band in tries) else np.empty(0)
    found: list[Candidate] = []
    for templates, band in tries:
        if not templates:
            continue
        fits = [_fit(spectra, template, margin, block.side) for template in templates]
        score = fits[0].copy()
        for fit in fits[1:]:
            np.maximum(score, fit, out=score)
        # The frame's shape is a turned one of many: a square of its size is near enough.
        side = round(math.sqrt(float(np.mean([template.pixels for template in templates]))))
        energy = cv2.boxFilter(squares, -1, (side, side), borderType=cv2.BORDER_CONSTANT)[inner, inner]
        # By chance a frame of a quarter of the pixels fits twice as well.
        score *= min(templates[0].above_ground_m / scale.highest_m, 1.0)
        score /= np.sqrt(np.maximum(energy, least))
        if band is not None:
            low, high = band
            score[~((ground >= low) & (ground <= high))] = -np.inf
        if inside is not None:
            score[~inside] = -np.inf
        found += _peaks(score, fits, templates, field, block, count)
    return found


def _fit(spectra: Sequence[np.ndarray], template: _Template, margin: int, side: int) -> Float32Array:
    """(side, side) correlation of a template with a block, for the camera above each of its pixels."""
    product = cv2.mulSpectrums(spectra[0], template.spectra[0], 0, conjB=True)
    cv2.add(product, cv2.mulSpectrums(spectra[1], template.spectra[1], 0, conjB=True), dst=product)
    correlation = cv2.dft(product, flags=cv2.DFT_INVERSE | cv2.DFT_REAL_OUTPUT | cv2.DFT_SCALE)
    x, y = template.foot_px
    # The correlation is for the canvas' corner: the camera is at its foot.
    return np.asarray(correlation[margin - y : margin - y + side, margin - x : margin - x + side], dtype=np.float32)


def _ground(field: CoarseField, block: _Block) -> FloatArray:
    """(side, side) heights of the ground below, every eighth pixel's for those after it."""
    wide = np.repeat(np.repeat(_lattice(field, block), 8, axis=0), 8, axis=1)
    return np.asarray(wide[: block.side, : block.side])


def _lattice(field: CoarseField, block: _Block) -> FloatArray:
    """(k, k) heights of the ground below every eighth pixel."""
    place = field.grid.crop(block.column, block.row, block.side, block.side)
    coarse = np.arange(0.0, block.side, 8.0)
    ground = field.ground_m(place.map_from_px(np.stack(np.meshgrid(coarse, coarse), axis=-1).reshape(-1, 2)))
    return np.asarray(ground.reshape(len(coarse), -1))


def _inside(field: CoarseField, block: _Block) -> BoolArray:
    assert block.within is not None
    corners = np.round(field.grid.px_from_map(block.within) - (block.column, block.row)).astype(np.int32)
    mask = np.zeros((block.side, block.side), np.uint8)
    cv2.fillPoly(mask, [corners], 1)
    return mask.astype(bool)


def _peaks(
    score: Float32Array,
    fits: Sequence[Float32Array],
    templates: Sequence[_Template],
    field: CoarseField,
    block: _Block,
    count: int,
) -> Iterator[Candidate]:
    for _ in range(count):
        row, column = divmod(int(score.argmax()), block.side)
        value = float(score[row, column])
        if not value > 0.0:
            return
        template = templates[int(np.argmax([fit[row, column] for fit in fits]))]
        easting, northing = field.grid.map_from_px((block.column + column, block.row + row)).tolist()
        yield Candidate(easting, northing, template.above_ground_m, template.turn_rad, value)
        score[max(row - _APART_PX, 0) : row + _APART_PX + 1, max(column - _APART_PX, 0) : column + _APART_PX + 1] = -1.0
