"""Where in a whole map a frame may have been taken, when nothing says where to look but attitude and height.

The frame is rectified north-up at the map's coarse scale, for every heading and height that come into question, and its
edge directions are correlated with the map's everywhere, by the Fourier transform. What comes out are candidates: the
`Localizer` decides about each.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np

from ortholoc_edge.geometry import rotation
from ortholoc_edge.geometry.arrays import BoolArray, Float32Array, FloatArray, ImageArray
from ortholoc_edge.geometry.camera import Camera
from ortholoc_edge.matching.orientation import orientation_field
from ortholoc_edge.pipeline.rectify import rectified
from ortholoc_edge.tiles.coarse import MEAN_PX, CoarseField

# Turn of a frame from one heading tried to the next: what a frame of 60 to 110 px bears to either side of it.
_TURN_RAD: Final = math.radians(4.0)
# And from one height to the next, as a factor.
_ZOOM: Final = 1.09
# Side of the blocks that are transformed. Larger ones waste less on their rims, and more of the cache.
_BLOCK_PX: Final = 1024
_MAX_CANVAS_PX: Final = 256
# A frame with less to see than this is not looked for, px.
_MIN_CANVAS_PX: Final = 24
# Places closer than this are the same, px.
_APART_PX: Final = 8
_PER_BLOCK: Final = 8
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
        score: normalised correlation with the map, at most about 1.
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


def search(
    sighting: Sighting, field: CoarseField, *, count: int = 20, threads: int = 2, block_px: int = _BLOCK_PX
) -> list[Candidate]:
    """The places where a frame fits best, the best first, each apart from the others.

    Args:
        count: of places.
        threads: that share the work.
    Returns: an empty list where the frame shows too little ground for the field's pixels, or has no edges.
    """
    found: list[Candidate] = []
    with ThreadPoolExecutor(threads, thread_name_prefix="search") as pool:
        for above_m, blocks in _heights(sighting, field, block_px):
            templates = [
                template
                for zoom in _zooms(sighting.height_reach)
                for turn_rad in _turns(sighting.heading_reach_rad)
                if (template := _template(sighting, field, above_m * zoom, turn_rad, block_px)) is not None
            ]
            if not templates:
                continue
            for part in pool.map(lambda block, those=templates: _search_block(field, block, those, block_px), blocks):
                found += part
    return distinct(found, _APART_PX * field.grid.gsd_m, count)


def distinct(found: Sequence[Candidate], apart_m: float, count: int) -> list[Candidate]:
    """The best, each apart from all better ones."""
    kept: list[Candidate] = []
    for candidate in sorted(found, key=lambda one: -one.score):
        if all(candidate.distance_m(other) > apart_m for other in kept):
            kept.append(candidate)
        if len(kept) == count:
            break
    return kept


def _turns(reach_rad: float) -> list[float]:
    if reach_rad >= math.pi - _TURN_RAD:
        count = math.ceil(2.0 * math.pi / _TURN_RAD)
        return [2.0 * math.pi * k / count - math.pi for k in range(count)]
    count = max(math.ceil(2.0 * reach_rad / _TURN_RAD), 1)
    # The middles of equal parts.
    return [reach_rad * ((2 * k + 1) / count - 1.0) for k in range(count)]


def _zooms(reach: float) -> list[float]:
    count = max(math.ceil(2.0 * math.log1p(reach) / math.log(_ZOOM)), 1)
    return [math.exp(math.log1p(reach) * ((2 * k + 1) / count - 1.0)) for k in range(count)]


def _template(
    sighting: Sighting, field: CoarseField, above_m: float, turn_rad: float, block_px: int
) -> _Template | None:
    gsd_m = field.grid.gsd_m
    map_from_camera = rotation.exp([0.0, 0.0, turn_rad]) @ sighting.map_from_camera
    # Pixels of a north-up grid whose origin is below the camera, to the frame's.
    ground_from_grid = np.array([[gsd_m, 0.0, 0.0], [0.0, -gsd_m, 0.0], [0.0, 0.0, -above_m]])
    frame_from_grid = sighting.camera.matrix @ map_from_camera.T @ ground_from_grid
    seen = rectified(sighting.grey, sighting.camera, frame_from_grid, _MAX_CANVAS_PX**2)
    if seen is None or min(seen.image.shape) < _MIN_CANVAS_PX or max(seen.image.shape) > _MAX_CANVAS_PX:
        return None
    values = orientation_field(seen.image, seen.valid, MEAN_PX)
    pixels = int(np.count_nonzero(seen.valid))
    energy = float(np.square(values).sum())
    if energy <= 0.0:
        return None
    values /= np.float32(math.sqrt(energy * pixels))
    corner = np.linalg.solve(frame_from_grid, seen.frame_from_canvas)
    low = corner[:2, 2] / corner[2, 2]
    rows = values.shape[1]
    spectra = []
    for part in values:
        padded = np.zeros((block_px, block_px), np.float32)
        padded[:rows, : values.shape[2]] = part
        spectra.append(np.asarray(cv2.dft(padded, nonzeroRows=rows)))
    return _Template(
        (spectra[0], spectra[1]), turn_rad, above_m, (round(-float(low[0])), round(-float(low[1]))), pixels
    )


@dataclass(frozen=True, slots=True)
class _Block:
    """Pixels of the field that a camera may be above: from (column, row) on, ``side`` to each side.

    ``heights``: of the ground that counts there, from and to, m; None: any.
    """

    column: int
    row: int
    side: int
    heights: tuple[float, float] | None = None


def _heights(sighting: Sighting, field: CoarseField, block_px: int) -> Iterator[tuple[float, list[_Block]]]:
    """Heights above ground to look from, and the blocks of the map that each holds in."""
    # A camera of a block needs the ground around it, up to half a canvas and more where it looks aslant.
    side = block_px - 2 * _margin_px(sighting, field)
    if side < block_px // 4:
        return
    blocks = [
        _Block(column, row, side)
        for row in range(0, field.grid.height, side)
        for column in range(0, field.grid.width, side)
    ]
    if math.isfinite(sighting.above_ground_m):
        yield sighting.above_ground_m, blocks
        return
    by_step: dict[int, list[_Block]] = {}
    for block in blocks:
        for step, heights in _steps(sighting, field, block):
            by_step.setdefault(step, []).append(_Block(block.column, block.row, side, heights))
    for step in sorted(by_step):
        yield _ZOOM**step, by_step[step]


def _steps(sighting: Sighting, field: CoarseField, block: _Block) -> Iterator[tuple[int, tuple[float, float]]]:
    """Steps of height above ground that a block's ground asks for, each with the ground that it is right for."""
    place = field.grid.crop(block.column, block.row, block.side, block.side)
    around = np.stack(np.meshgrid(np.arange(0, block.side, 8), np.arange(0, block.side, 8)), axis=-1).reshape(-1, 2)
    ground = field.ground_m(place.map_from_px(around))
    above = sighting.height_m - ground[np.isfinite(ground)]
    steps = np.unique(np.round(np.log(above[above > 1.0]) / math.log(_ZOOM)).astype(int))
    for step in steps.tolist():
        yield step, (sighting.height_m - _ZOOM ** (step + 0.75), sighting.height_m - _ZOOM ** (step - 0.75))


def _margin_px(sighting: Sighting, field: CoarseField) -> int:
    """Pixels around a camera that its frame may show."""
    camera, gsd_m = sighting.camera, field.grid.gsd_m
    above_m = sighting.above_ground_m
    if not math.isfinite(above_m):
        lowest = float(np.nanmin(field.ground)) if np.isfinite(field.ground).any() else 0.0
        above_m = max(sighting.height_m - lowest, 1.0)
    corners = np.array([[0, 0], [camera.width, 0], [0, camera.height], [camera.width, camera.height]], np.float64)
    rays = camera.unproject(corners) @ sighting.map_from_camera.T
    slope = np.hypot(rays[:, 0], rays[:, 1]) / np.maximum(-rays[:, 2], 0.25)
    reach = (1.0 + sighting.height_reach) * above_m * float(np.nan_to_num(slope, nan=4.0).max()) / gsd_m
    return min(math.ceil(reach) + 2, _MAX_CANVAS_PX)


def _search_block(
    field: CoarseField, block: _Block, templates: Sequence[_Template], block_px: int
) -> list[Candidate]:
    margin = (block_px - block.side) // 2
    values = field.block(block.column - margin, block.row - margin, block_px)
    squares = np.square(values[0]) + np.square(values[1])
    inner = slice(margin, margin + block.side)
    if not squares.any():
        return []
    spectra = [np.asarray(cv2.dft(part)) for part in values]
    best = np.full((block.side, block.side), -np.inf, np.float32)
    which = np.zeros(best.shape, np.int16)
    for number, template in enumerate(templates):
        product = cv2.mulSpectrums(spectra[0], template.spectra[0], 0, conjB=True)
        product += cv2.mulSpectrums(spectra[1], template.spectra[1], 0, conjB=True)
        correlation = cv2.dft(product, flags=cv2.DFT_INVERSE | cv2.DFT_REAL_OUTPUT | cv2.DFT_SCALE)
        x, y = template.foot_px
        # The correlation is for the canvas' corner: the camera is at its foot.
        here = correlation[margin - y : margin - y + block.side, margin - x : margin - x + block.side]
        better = here > best
        np.copyto(best, here, where=better)
        which[better] = number
    # The frame's shape is a turned one of many: a square of its size is near enough.
    side = round(math.sqrt(float(np.mean([template.pixels for template in templates]))))
    energy = cv2.boxFilter(squares, -1, (side, side), borderType=cv2.BORDER_CONSTANT)[inner, inner]
    score = best / np.sqrt(np.maximum(energy, _LEAST_ENERGY * float(squares[squares > 0].mean())))
    if block.heights is not None:
        score[~_in_band(field, block)] = -np.inf
    return list(_peaks(score, which, templates, field, block))


def _in_band(field: CoarseField, block: _Block) -> BoolArray:
    assert block.heights is not None
    place = field.grid.crop(block.column, block.row, block.side, block.side)
    coarse = np.arange(0.0, block.side + 8.0, 8.0)
    ground = field.ground_m(place.map_from_px(np.stack(np.meshgrid(coarse, coarse), axis=-1).reshape(-1, 2)))
    low, high = block.heights
    with np.errstate(invalid="ignore"):
        inside = (ground >= low) & (ground <= high)
    wide = np.repeat(np.repeat(inside.reshape(len(coarse), -1), 8, axis=0), 8, axis=1)
    return np.asarray(wide[: block.side, : block.side])


def _peaks(
    score: Float32Array, which: np.ndarray, templates: Sequence[_Template], field: CoarseField, block: _Block
) -> Iterator[Candidate]:
    for _ in range(_PER_BLOCK):
        row, column = divmod(int(score.argmax()), block.side)
        value = float(score[row, column])
        if not value > 0.0:
            return
        template = templates[int(which[row, column])]
        easting, northing = field.grid.map_from_px((block.column + column, block.row + row)).tolist()
        yield Candidate(easting, northing, template.above_ground_m, template.turn_rad, value)
        score[max(row - _APART_PX, 0) : row + _APART_PX + 1, max(column - _APART_PX, 0) : column + _APART_PX + 1] = -1.0
