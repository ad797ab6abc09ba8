"""A generated piece of country without end: every place has one content, whatever raster asks for it.

Positions are (east, north) in m of `FRAME` (UTM zone 32), continued beyond its zone. What stands at a place follows
from hashes of the cell of a jittered net it lies in, and textures from periodic noise, so tiles that are drawn apart,
at another pixel size or in another zone's grid, fit. Drawn for area packs of any size (`geodata`); the detailed little
world of the simulated flight is `world`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from itertools import pairwise
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
from pyproj import Transformer

from ortholoc_edge.geometry.arrays import BoolArray, Float32Array, FloatArray, ImageArray
from ortholoc_edge.geometry.grid import RasterGrid, bilinear

FRAME = "EPSG:25832"
# Near the border of zones 32 and 33 (12 degrees east) at 50.05 degrees north; whole kilometres of the frame.
CENTRE = (715_000.0, 5_548_000.0)

_SHIFT = 6  # cv2 draws fixed-point coordinates: 1/64 px
_ONE = 1 << _SHIFT
# Rasters are drawn in blocks that fit the caches; a block's border sees what reaches in from this far.
_BLOCK_PX = 1280
_REACH_M = 45.0
_CROWN_M = 7.0
_FOREST_SPREAD, _FOREST_FLOOR = 1.6, 0.7
_NET_M = 260.0
_EDGE_POINTS = 9
_LAKE_CELL_M = 1500.0
_TREE_CELL_M = 4.8

Colour = tuple[int, int, int]

# Forms of land between the net's edges.
FIELDS, VILLAGE, FOREST = range(3)
# Around the centre something of everything, so that the smallest area has it too.
_FIXED_USE = {(0, 0): VILLAGE, (-1, 0): FIELDS, (-1, -1): FOREST, (0, -1): FIELDS}
# Kinds of the net's edges.
HEDGE, TRACK, ROAD, HIGHWAY = range(4)
EDGE_WIDTH_M = {HEDGE: 1.5, TRACK: 3.2, ROAD: 5.5, HIGHWAY: 8.0}

_ROOFS: tuple[Colour, ...] = (
    (152, 82, 62), (138, 70, 54), (166, 98, 72), (120, 66, 56), (92, 90, 92), (108, 106, 106), (84, 76, 74)
)  # fmt: skip
_HALLS: tuple[Colour, ...] = ((176, 178, 178), (150, 152, 156), (196, 194, 186), (128, 134, 138))


@dataclass(frozen=True, slots=True)
class Look:
    """How the country looks at one time, and from which aircraft.

    Attributes:
        name: for file names and people; a year.
        seed: of crops, grain and what was felled or repainted.
        sun_azimuth_deg, sun_elevation_deg: from grid north clockwise; above the horizon.
        crops: (colour, height m) of which every field takes one.
        grass, leaves, needles, water, paved: colours.
        gain: per channel.
        changed: share of trees that are absent and of roofs that have another colour than in the look before.
    """

    name: str
    seed: int
    sun_azimuth_deg: float
    sun_elevation_deg: float
    crops: tuple[tuple[Colour, float], ...]
    grass: Colour
    leaves: Colour
    needles: Colour
    water: Colour = (54, 70, 68)
    paved: Colour = (134, 132, 130)
    gain: tuple[float, float, float] = (1.0, 1.0, 1.0)
    changed: float = 0.0


# Laser light and image matching see into crops: about half their height is left in a surface model.
_SUMMER = (
    ((190, 170, 112), 0.35), ((176, 158, 104), 0.3), ((92, 124, 66), 0.7), ((104, 134, 74), 0.15),
    ((132, 146, 88), 0.1), ((118, 140, 80), 0.05), ((150, 150, 96), 0.4), ((156, 132, 104), 0.0),
)  # fmt: skip
_SPRING = (
    ((104, 132, 70), 0.1), ((150, 122, 94), 0), ((140, 116, 92), 0), ((206, 196, 70), 0.5), ((96, 126, 64), 0.1),
    ((122, 138, 82), 0.05), ((164, 138, 108), 0), ((112, 140, 74), 0.15),
)  # fmt: skip
SURVEYS = {
    year: look
    for year, look in (
        (2019, Look("2019", 19, 205.0, 38.0, _SPRING, (124, 138, 84), (96, 92, 66), (52, 74, 52),
                    gain=(0.93, 0.95, 1.04), changed=0.06)),
        (2021, Look("2021", 21, 128.0, 47.0, _SUMMER, (128, 142, 88), (70, 98, 52), (48, 76, 50),
                    gain=(1.03, 1.0, 0.96), changed=0.03)),
        (2023, Look("2023", 23, 148.0, 56.0, _SUMMER, (116, 138, 80), (66, 96, 48), (46, 74, 48))),
    )
}  # fmt: skip
# What a drone sees a year and a half after the last survey, in low light.
FLIGHT = Look(
    "flight", 91, 238.0, 33.0, _SUMMER, (130, 136, 86), (86, 98, 54), (52, 76, 50), (66, 80, 84), (128, 128, 130),
    (1.05, 0.99, 0.92), 0.05,
)  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class _House:
    """A building: ``corners`` (4, 2) m, the long side first; ``axis`` unit vector along it; ``roof`` index of its
    colour; heights above the ground at its centre."""

    corners: FloatArray
    centre: FloatArray
    axis: FloatArray
    length_m: float
    width_m: float
    eave_m: float
    rise_m: float
    roof: int


@dataclass(frozen=True, slots=True, eq=False)
class _Field:
    outline: FloatArray
    centre: FloatArray
    row_angle_rad: float
    ident: int
    tramlines: tuple[FloatArray, ...] = ()
    garden: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class _Trees:
    """N trees: ``xy`` (N, 2) m, ``radius_m``, ``height_m`` (N,), ``kind`` (N,) 0 leaves, 1 needles, ``chance`` (N,)
    0..1 fixed number that decides their fate."""

    xy: FloatArray
    radius_m: FloatArray
    height_m: FloatArray
    kind: npt.NDArray[np.int64]
    chance: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Plot:
    """What the net's cell (i, j) holds, at all times."""

    outline: FloatArray
    use: int
    fields: tuple[_Field, ...]
    streets: tuple[FloatArray, ...]
    houses: tuple[_House, ...]
    trees: _Trees
    low: FloatArray
    high: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Drawing:
    """A raster of the country.

    Attributes:
        rgb: (H, W, 3) uint8.
        heights: (H, W) float32 m, top of everything.
    """

    rgb: ImageArray
    heights: Float32Array


@dataclass(frozen=True)
class Country:
    """The endless country of a seed. Cheap to make; what it draws first costs a second for its noise."""

    seed: int = 5
    _affines: dict[str, Transformer] = field(default_factory=dict, init=False, repr=False, compare=False)

    def rgb(self, grid: RasterGrid, crs: str, look: Look) -> ImageArray:
        """(H, W, 3) uint8 orthophoto on a grid of ``crs`` at pixels up to about 2 m."""
        out = np.empty((grid.height, grid.width, 3), dtype=np.uint8)
        for row, column, block in blocks(grid, 4):
            view = self.view(block, crs)
            drawn = _Painter(self, view, look).picture()
            height, width = drawn.shape[0] - 8, drawn.shape[1] - 8
            out[row : row + height, column : column + width] = drawn[4:-4, 4:-4]
        return out

    def heights(self, grid: RasterGrid, crs: str, look: Look) -> Float32Array:
        """(H, W) float32 m: the surface at the pixels' centres."""
        out = np.empty((grid.height, grid.width), dtype=np.float32)
        for row, column, block in blocks(grid):
            drawn = _Painter(self, self.view(block, crs), look).surface()
            out[row : row + drawn.shape[0], column : column + drawn.shape[1]] = drawn
        return out

    def draw(self, grid: RasterGrid, crs: str, look: Look) -> Drawing:
        """Orthophoto and surface on one grid."""
        return Drawing(self.rgb(grid, crs, look), self.heights(grid, crs, look))

    def colour(self, east_m: FloatArray, north_m: FloatArray, look: Look, gsd_m: float = 0.2) -> FloatArray:
        """(N, 3) colours 0..255 at points of `FRAME`, as a survey of ``gsd_m`` records them."""
        return self._sampled(east_m, north_m, look, gsd_m, 3)

    def height(self, east_m: FloatArray, north_m: FloatArray, look: Look) -> FloatArray:
        """(N,) heights m at points of `FRAME`, off edges to a centimetre."""
        return self._sampled(east_m, north_m, look, 0.1, 1)[:, 0]

    def _sampled(self, east_m: FloatArray, north_m: FloatArray, look: Look, gsd_m: float, bands: int) -> FloatArray:
        east, north = np.asarray(east_m, dtype=np.float64).ravel(), np.asarray(north_m, dtype=np.float64).ravel()
        out = np.empty((len(east), bands))
        cell = 256 * gsd_m
        keys = np.stack([np.floor(east / cell), np.floor(north / cell)], axis=1)
        for key in np.unique(keys, axis=0):
            mine = np.flatnonzero((keys == key).all(axis=1))
            left, lower = key * cell
            grid = RasterGrid(260, 260, left - 2 * gsd_m, lower + cell + 2 * gsd_m, gsd_m, -gsd_m)
            if bands == 3:
                raster = self.rgb(grid, FRAME, look).astype(np.float32)
            else:
                raster = self.heights(grid, FRAME, look)[..., None]
            px = grid.px_from_map(np.stack([east[mine], north[mine]], axis=1))
            for k in range(bands):
                out[mine, k] = bilinear(raster[..., k], px)
        return out

    def frame_from(self, xy: FloatArray, crs: str) -> FloatArray:
        """Points (N, 2) of ``crs`` in `FRAME`."""
        if crs == FRAME:
            return np.asarray(xy, dtype=np.float64)
        if crs not in self._affines:
            self._affines[crs] = Transformer.from_crs(crs, FRAME, always_xy=True)
        return np.stack(self._affines[crs].transform(xy[:, 0], xy[:, 1]), axis=1)

    def view(self, grid: RasterGrid, crs: str) -> View:
        """Where a grid's pixels lie in `FRAME`."""
        # The grids of two zones differ by a turn and a scale; what is left of curvature in a block is below a
        # millimetre.
        ends = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0]]) * (grid.width - 1, grid.height - 1)
        world = self.frame_from(grid.map_from_px(ends), crs)
        design = np.column_stack([ends, np.ones(4)])
        solved = np.linalg.lstsq(design, world, rcond=None)[0]
        return View(grid.width, grid.height, np.asarray(solved.T, dtype=np.float64))

    def plots(self, low: FloatArray, high: FloatArray) -> Iterator[Plot]:
        """Plots that may touch a box, in an order that does not depend on it."""
        first = np.floor((low - CENTRE) / _NET_M).astype(int) - 1
        last = np.floor((high - CENTRE) / _NET_M).astype(int) + 1
        for j in range(last[1], first[1] - 1, -1):
            for i in range(first[0], last[0] + 1):
                plot = _plot(self.seed, i, j)
                if (plot.high > low).all() and (plot.low < high).all():
                    yield plot

    def edges(self, low: FloatArray, high: FloatArray) -> list[tuple[int, FloatArray]]:
        """Kind (`HEDGE` to `HIGHWAY`) and line (9, 2) of the net's edges that may touch a box, the important last."""
        first = np.floor((low - CENTRE) / _NET_M).astype(int) - 1
        last = np.floor((high - CENTRE) / _NET_M).astype(int) + 1
        found = [
            _edge(self.seed, int(i), int(j), north)
            for j in range(first[1], last[1] + 1)
            for i in range(first[0], last[0] + 1)
            for north in (False, True)
        ]
        return sorted(found, key=lambda one: one[0])

    def lakes(self, low: FloatArray, high: FloatArray) -> list[_Lake]:
        """Lakes that may touch a box."""
        return list(_lakes(self.seed, low, high))

    def ground(self, xy: FloatArray) -> FloatArray:
        """(N,) heights m of the bare ground at points (N, 2) of `FRAME`."""
        return _terrain(self.seed, xy, self.lakes(xy.min(axis=0), xy.max(axis=0)))


def hole_mask(country: Country, grid: RasterGrid, crs: str) -> BoolArray:
    """(H, W) where a surface model lacks heights: in most cells of 250 m a small spot, in some a big one, and part of
    every lake (laser light does not come back from water)."""
    view = country.view(grid, crs)
    mask = np.zeros((grid.height, grid.width), dtype=np.uint8)
    low, high = view.box(_REACH_M)
    first, last = np.floor((low - CENTRE) / 250.0).astype(int), np.floor((high - CENTRE) / 250.0).astype(int)
    spots = []
    for j in range(first[1], last[1] + 1):
        for i in range(first[0], last[0] + 1):
            rng = _random(country.seed, i, j, 50)
            big = rng.random() < 0.06
            radius = rng.uniform(12.0, 30.0) if big else rng.uniform(0.6, 3.0)
            spots.append((CENTRE + (np.array([i, j]) + rng.random(2)) * 250.0, radius))
    spots += [(lake.centre, 0.35 * lake.radius_m) for lake in _lakes(country.seed, low, high)]
    for xy, radius in spots:
        centre = np.round(view.px(np.asarray(xy)[None])[0] * _ONE).astype(int).tolist()
        cv2.circle(mask, centre, int(radius * view.px_per_m * _ONE), 255, -1, cv2.LINE_8, _SHIFT)
    return np.asarray(mask > 0, dtype=bool)


def blocks(grid: RasterGrid, margin: int = 0, side_px: int = _BLOCK_PX) -> Iterator[tuple[int, int, RasterGrid]]:
    """Row and column of the squares that a raster is drawn in, and their grids, larger by ``margin`` px all around."""
    for row in range(0, grid.height, side_px):
        for column in range(0, grid.width, side_px):
            width, height = min(side_px, grid.width - column), min(side_px, grid.height - row)
            yield row, column, grid.crop(column - margin, row - margin, width + 2 * margin, height + 2 * margin)


@dataclass(frozen=True)
class View:
    """A raster's place in the frame: ``world_from_px`` (2, 3), pixel centres at integers."""

    width: int
    height: int
    world_from_px: FloatArray

    @cached_property
    def px_from_world(self) -> FloatArray:
        linear = np.linalg.inv(self.world_from_px[:, :2])
        return np.column_stack([linear, -linear @ self.world_from_px[:, 2]])

    @cached_property
    def px_per_m(self) -> float:
        return float(np.sqrt(abs(np.linalg.det(self.px_from_world[:, :2]))))

    @cached_property
    def corners(self) -> FloatArray:
        ends = np.array([[0, 0, 1], [self.width, 0, 1], [0, self.height, 1], [self.width, self.height, 1]])
        return np.asarray(ends @ self.world_from_px.T, dtype=np.float64)

    def px(self, xy: FloatArray) -> FloatArray:
        """Frame (N, 2) to pixels."""
        return np.asarray(xy @ self.px_from_world[:, :2].T + self.px_from_world[:, 2], dtype=np.float64)

    def direction(self, vector: FloatArray) -> FloatArray:
        """Frame metres to pixels, for differences."""
        return np.asarray(self.px_from_world[:, :2] @ vector, dtype=np.float64)

    def box(self, reach_m: float) -> tuple[FloatArray, FloatArray]:
        return self.corners.min(axis=0) - reach_m, self.corners.max(axis=0) + reach_m


# --- numbers from cells ---


def _hash(seed: int, i: npt.NDArray[np.int64], j: npt.NDArray[np.int64], salt: int) -> FloatArray:
    """Uniform numbers 0..1 of cells (N,), each by itself (the finaliser of SplitMix64)."""
    start = (seed * 7_919 + salt * 104_729) & 0xFFFF_FFFF
    with np.errstate(over="ignore"):
        x = i.astype(np.uint64) * np.uint64(0x9E3779B97F4A7C15) ^ j.astype(np.uint64) * np.uint64(0xC2B2AE3D27D4EB4F)
        x = x + np.uint64(start) * np.uint64(0x165667B19E3779F9)
        x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        x ^= x >> np.uint64(31)
    return np.asarray((x >> np.uint64(11)).astype(np.float64) * 2.0**-53)


def _cell(seed: int, i: int, j: int, salt: int) -> float:
    return float(_hash(seed, np.array([i]), np.array([j]), salt)[0])


def _random(seed: int, i: int, j: int, salt: int) -> np.random.Generator:
    return np.random.default_rng([seed, i + 2**24, j + 2**24, salt])


def _smooth(seed: int, xy: FloatArray, size_m: float, salt: int) -> FloatArray:
    """(N,) smooth noise of zero mean and about unit variance, with features of ``size_m``: a cubic B-spline."""
    at = (xy - CENTRE) / size_m
    base = np.floor(at).astype(np.int64)
    t = at - base
    weights = np.stack([(1 - t) ** 3, 3 * t**3 - 6 * t**2 + 4, -3 * t**3 + 3 * t**2 + 3 * t + 1, t**3]) / 6
    total = np.zeros(len(at))
    for a in range(4):
        for b in range(4):
            value = _hash(seed, base[:, 0] + a - 1, base[:, 1] + b - 1, salt) - 0.5
            total += weights[a, :, 0] * weights[b, :, 1] * value
    # Of uniform numbers 1/12, times the mean square of the spline's weights in two dimensions (0.48**2).
    return np.asarray(total / (np.sqrt(1 / 12) * 0.479))


@lru_cache(maxsize=8)
def _noise_bank(seed: int, size: int, steepness: float, longest_px: float) -> npt.NDArray[np.uint8]:
    """(size, size) periodic noise about 128, 1 sigma 40, its amplitude falling as frequency ** -steepness."""
    rng = np.random.default_rng([seed, size])
    spectrum = np.fft.rfft2(rng.standard_normal((size, size), dtype=np.float32))
    frequency = np.hypot(np.fft.fftfreq(size)[:, None], np.fft.rfftfreq(size)[None])
    gain = np.maximum(frequency, 1.0 / longest_px) ** -steepness
    gain[frequency < 0.5 / longest_px] = 0.0
    values = np.fft.irfft2(spectrum * gain, (size, size))
    return np.asarray(np.clip(128.5 + 40.0 * values / values.std(), 0, 255), dtype=np.uint8)


def _bank_on(
    view: View, bank: npt.NDArray[np.uint8], pixel_m: float, turn_rad: float = 0.0, stretch: float = 1.0
) -> npt.NDArray[np.uint8]:
    """The endless repetition of ``bank`` with pixels of ``pixel_m`` on a view; turned, its rows stretched."""
    c, s = np.cos(turn_rad), np.sin(turn_rad)
    bank_from_world = np.array([[c / stretch, s / stretch], [-s, c]]) / pixel_m
    matrix = bank_from_world @ view.world_from_px[:, :2]
    shift = bank_from_world @ (view.world_from_px[:, 2] - CENTRE)
    ends = np.array([[0, 0], [view.width, 0], [0, view.height], [view.width, view.height]]) @ matrix.T + shift
    first = np.floor(ends.min(axis=0)).astype(int) - 2
    last = np.ceil(ends.max(axis=0)).astype(int) + 3
    size = len(bank)
    columns, rows = np.arange(first[0], last[0]) % size, np.arange(first[1], last[1]) % size
    crop = bank[rows[:, None], columns[None]]
    warp = np.column_stack([matrix, shift - first])
    warped = cv2.warpAffine(crop, warp, (view.width, view.height), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
    return np.asarray(warped, dtype=np.uint8)


# --- the net and its plots ---


@lru_cache(maxsize=4096)
def _node(seed: int, i: int, j: int) -> FloatArray:
    jitter = np.array([_cell(seed, i, j, 1), _cell(seed, i, j, 2)]) - 0.5
    return np.asarray(CENTRE + (np.array([i, j]) + 0.4 * jitter) * _NET_M, dtype=np.float64)


@lru_cache(maxsize=4096)
def _edge(seed: int, i: int, j: int, north: bool) -> tuple[int, FloatArray]:
    """Kind and line (9, 2) of the edge from node (i, j) to the north or the east."""
    a, b = _node(seed, i, j), _node(seed, i + (not north), j + north)
    salt = 3 if north else 4
    along = b - a
    bend = (_cell(seed, i, j, salt) - 0.5) * 0.22
    t = np.linspace(0.0, 1.0, _EDGE_POINTS)[:, None]
    line = a + along * t + bend * 4 * t * (1 - t) * np.array([-along[1], along[0]])
    chance = _cell(seed, i, j, salt + 4)
    if (i if north else j) % 6 == 0:
        return HIGHWAY, line
    return (ROAD if chance < 0.30 else TRACK if chance < 0.72 else HEDGE), line


@lru_cache(maxsize=1024)
def _plot(seed: int, i: int, j: int) -> Plot:
    south, north = _edge(seed, i, j, False)[1], _edge(seed, i, j + 1, False)[1]
    west, east = _edge(seed, i, j, True)[1], _edge(seed, i + 1, j, True)[1]
    patch = _Patch(south, north, west, east)
    outline = np.concatenate([south[:-1], east[:-1], north[:0:-1], west[:0:-1]])
    land = float(_smooth(seed, outline.mean(axis=0)[None], 2.2 * _NET_M, 9)[0])
    use = _FIXED_USE.get((i, j), FOREST if land < -0.85 else VILLAGE if land > 1.15 else FIELDS)
    rng = _random(seed, i, j, 10)
    fields: list[_Field] = []
    streets: list[FloatArray] = []
    houses: list[_House] = []
    if use == FIELDS:
        fields = _sown(patch, rng, (i * 4096 + j) * 64)
    elif use == VILLAGE:
        fields, streets, houses = _village(patch, rng, (i * 4096 + j) * 64)
    if use == FIELDS and rng.random() < 0.35:
        houses = [_hall(patch, rng)]
    trees = _planted(seed, i, j, use, patch, outline, houses, rng)
    low, high = outline.min(axis=0) - 12.0, outline.max(axis=0) + 12.0
    return Plot(outline, use, tuple(fields), tuple(streets), tuple(houses), trees, low, high)


@dataclass(frozen=True, slots=True, eq=False)
class _Patch:
    """The Coons patch of four edges: (s, t) from 0 to 1 east and north."""

    south: FloatArray
    north: FloatArray
    west: FloatArray
    east: FloatArray

    def at(self, s: npt.ArrayLike, t: npt.ArrayLike) -> FloatArray:
        s, t = np.broadcast_arrays(np.asarray(s, dtype=np.float64), np.asarray(t, dtype=np.float64))
        u, v = s[..., None], t[..., None]
        sides = (1 - v) * _along(self.south, s) + v * _along(self.north, s)
        sides = sides + (1 - u) * _along(self.west, t) + u * _along(self.east, t)
        corners = (1 - u) * ((1 - v) * self.south[0] + v * self.north[0])
        corners = corners + u * ((1 - v) * self.south[-1] + v * self.north[-1])
        return np.asarray(sides - corners, dtype=np.float64)

    def quad(self, s0: float, s1: float, t0: float, t1: float) -> FloatArray:
        """Outline of a part."""
        n = np.linspace(0.0, 1.0, 6)[:-1]
        s = np.concatenate([s0 + (s1 - s0) * n, np.full(5, s1), s1 - (s1 - s0) * n, np.full(5, s0)])
        t = np.concatenate([np.full(5, t0), t0 + (t1 - t0) * n, np.full(5, t1), t1 - (t1 - t0) * n])
        return self.at(s, t)


def _along(line: FloatArray, t: FloatArray) -> FloatArray:
    knots = np.linspace(0.0, 1.0, len(line))
    return np.stack([np.interp(t, knots, line[:, k]) for k in (0, 1)], axis=-1)


def _cuts(rng: np.random.Generator, count: int) -> FloatArray:
    widths = rng.uniform(0.55, 1.45, count)
    return np.concatenate([[0.0], np.cumsum(widths) / widths.sum()])


def _sown(patch: _Patch, rng: np.random.Generator, first: int) -> list[_Field]:
    along = bool(rng.random() < 0.5)
    cuts = _cuts(rng, int(rng.integers(1, 6)))
    fields: list[_Field] = []
    for a, b in pairwise(cuts):
        across = _cuts(rng, 1 if rng.random() < 0.6 else 2)
        for c, d in pairwise(across):
            gap = 0.004 + 0.004 * rng.random()
            box = (a + gap, b - gap, c + gap, d - gap) if along else (c + gap, d - gap, a + gap, b - gap)
            outline = patch.quad(*box)
            # Tractors drive along the strip, every 21 m.
            n = np.linspace(0.02, 0.98, 9)
            lines = []
            width_m = (b - a) * _NET_M
            for k in range(int(width_m / 21)):
                at = a + gap + ((k + 0.5) * 21 + 3 * rng.random()) / _NET_M
                if at < b - gap:
                    run = c + (d - c) * n
                    lines.append(patch.at(np.full(9, at), run) if along else patch.at(run, np.full(9, at)))
            centre = outline.mean(axis=0)
            ends = patch.at([0.5, 0.5], [0.0, 1.0]) if along else patch.at([0.0, 1.0], [0.5, 0.5])
            angle = float(np.arctan2(*(ends[1] - ends[0])[::-1]))
            fields.append(_Field(outline, centre, angle, first + len(fields), tuple(lines)))
    return fields


def _village(
    patch: _Patch, rng: np.random.Generator, first: int
) -> tuple[list[_Field], list[FloatArray], list[_House]]:
    fields: list[_Field] = []
    streets, houses = [], []
    cuts = _cuts(rng, 3)
    n = np.linspace(0.0, 1.0, 9)
    for k, (a, b) in enumerate(pairwise(cuts)):
        if k > 0:
            streets.append(patch.at(np.full(9, a), n))
        lots = _cuts(rng, int(rng.integers(9, 13)))
        middle = (a + b) / 2
        for c, d in pairwise(lots):
            for low, high, front in ((a, middle, 0.36), (middle, b, 0.64)):
                outline = patch.quad(low + 0.012, high - 0.002, c + 0.003, d - 0.003)
                centre = outline.mean(axis=0)
                fields.append(_Field(outline, centre, 0.0, first + len(fields), (), True))
                if rng.random() < 0.9:
                    place = patch.at(low + front * (high - low), (c + d) / 2) + rng.normal(0, 0.8, 2)
                    along = patch.at(low + front * (high - low), d) - patch.at(low + front * (high - low), c)
                    turn = float(np.arctan2(along[1], along[0])) + rng.normal(0, 0.04)
                    turn += np.pi / 2 if rng.random() < 0.4 else 0.0
                    size = min(float(np.linalg.norm(along)) - 3.0, 15.0)
                    length = max(7.0, size * rng.uniform(0.75, 1.0))
                    houses.append(
                        _house(place, turn, length, length * rng.uniform(0.6, 0.85), rng.uniform(3.0, 6.2),
                               rng.uniform(2.0, 4.2), int(rng.integers(len(_ROOFS))))
                    )  # fmt: skip
                if rng.random() < 0.55:
                    s = low + (1.0 - front) * (high - low)
                    place = patch.at(s, c + (d - c) * rng.uniform(0.3, 0.7))
                    houses.append(_house(place, rng.uniform(0, np.pi), rng.uniform(3, 7), rng.uniform(2.5, 4.5),
                                         2.4, 0.0, len(_ROOFS) + int(rng.integers(len(_HALLS)))))  # fmt: skip
    return fields, streets, houses


def _hall(patch: _Patch, rng: np.random.Generator) -> _House:
    s, t = rng.uniform(0.12, 0.88, 2)
    along = patch.at(s, t + 0.05) - patch.at(s, t)
    return _house(patch.at(s, t), float(np.arctan2(along[1], along[0])), rng.uniform(22, 48), rng.uniform(12, 24),
                  rng.uniform(4.5, 8.0), 1.5, len(_ROOFS) + int(rng.integers(len(_HALLS))))  # fmt: skip


def _house(centre: FloatArray, turn: float, length: float, width: float, eave: float, rise: float, roof: int) -> _House:
    axis = np.array([np.cos(turn), np.sin(turn)])
    side = np.array([-axis[1], axis[0]])
    signs = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    corners = centre + signs[:, :1] * axis * length / 2 + signs[:, 1:] * side * width / 2
    return _House(corners, centre, axis, length, width, eave, rise, roof)


def _planted(
    seed: int,
    i: int,
    j: int,
    use: int,
    patch: _Patch,
    outline: FloatArray,
    houses: list[_House],
    rng: np.random.Generator,
) -> _Trees:
    spots: list[FloatArray] = []
    if use == FOREST:
        low = np.floor((outline.min(axis=0) - CENTRE) / _TREE_CELL_M).astype(int)
        high = np.ceil((outline.max(axis=0) - CENTRE) / _TREE_CELL_M).astype(int)
        rows, columns = np.meshgrid(np.arange(high[1], low[1], -1), np.arange(low[0], high[0]), indexing="ij")
        at = np.stack([columns.ravel(), rows.ravel()], axis=1)
        jitter = np.stack([_hash(seed, at[:, 0], at[:, 1], salt) for salt in (11, 12)], axis=1)
        xy = CENTRE + (at + 0.85 * jitter) * _TREE_CELL_M
        clearing = _smooth(seed, xy, 55.0, 13) > 1.5
        spots.append(xy[_inside(xy, outline, 3.5) & ~clearing])
    else:
        count = int(rng.integers(90, 160)) if use == VILLAGE else int(rng.integers(0, 7))
        xy = patch.at(rng.uniform(0.02, 0.98, count), rng.uniform(0.02, 0.98, count))
        for house in houses:
            xy = xy[np.linalg.norm(xy - house.centre, axis=1) > 0.62 * house.length_m]
        spots.append(xy)
    for north in (False, True):  # the edges to the south and to the west are this plot's
        kind, line = _edge(seed, i, j, north)
        if kind == HEDGE or (kind == HIGHWAY and _cell(seed, i, j, 14) < 0.4):
            length = float(np.linalg.norm(np.diff(line, axis=0), axis=1).sum())
            t = np.arange(0.04, 0.96, (3.4 if kind == HEDGE else 11.0) / length)
            offset = np.where(rng.random(len(t)) < 0.5, 1.0, -1.0) * (6.5 if kind == HIGHWAY else 0.0)
            normal = np.array([-(line[-1] - line[0])[1], (line[-1] - line[0])[0]]) / length
            row = _along(line, t) + rng.normal(0, 0.9, (len(t), 2)) + offset[:, None] * normal
            spots.append(row[rng.random(len(t)) < 0.75])
    xy = np.concatenate(spots)
    count = len(xy)
    if use == FOREST:
        needles = (_smooth(seed, xy, 120.0, 15) + rng.normal(0, 0.35, count) > 0.1).astype(np.int64)
        radius = np.where(needles == 1, rng.uniform(1.8, 2.8, count), rng.uniform(2.1, 3.9, count))
        height = rng.uniform(13, 22, count) + 3.0 * _smooth(seed, xy, 70.0, 16)
    else:
        needles = (rng.random(count) < 0.2).astype(np.int64)
        radius = rng.uniform(1.0, 3.4, count)
        height = 2.2 + radius * rng.uniform(1.6, 2.6, count)
    return _Trees(xy, radius, np.maximum(height, 2.0), needles, rng.random(count))


def _inside(xy: FloatArray, outline: FloatArray, margin_m: float) -> BoolArray:
    """Whether points (N, 2) lie in a polygon, further than ``margin_m`` from its edge (to 0.5 m)."""
    low = outline.min(axis=0) - 1.0
    size = np.ceil((outline.max(axis=0) + 1.0 - low) * 2).astype(int)
    mask = np.zeros((size[1], size[0]), dtype=np.uint8)
    cv2.fillPoly(mask, [np.round((outline - low) * 2).astype(np.int32)], 255)
    step = round(margin_m * 4) | 1
    mask = np.asarray(cv2.erode(mask, np.ones((step, step), np.uint8)), dtype=np.uint8)
    at = np.round((xy - low) * 2).astype(int)
    known = (at >= 0).all(axis=1) & (at < size).all(axis=1)
    inside = np.zeros(len(xy), dtype=bool)
    inside[known] = mask[at[known, 1], at[known, 0]] > 0
    return inside


@dataclass(frozen=True, slots=True, eq=False)
class _Lake:
    centre: FloatArray
    outline: FloatArray
    radius_m: float


@lru_cache(maxsize=1024)
def _lake(seed: int, i: int, j: int) -> _Lake | None:
    rng = _random(seed, i, j, 20)
    if (i, j) == (0, 0):
        centre, radius = np.add(CENTRE, (115.0, -105.0)), 62.0
    elif rng.random() < 0.45:
        centre = CENTRE + (np.array([i, j]) + rng.uniform(0.25, 0.75, 2)) * _LAKE_CELL_M
        radius = float(rng.uniform(60.0, 210.0))
    else:
        return None
    turn = np.linspace(0, 2 * np.pi, 73)[:-1]
    wave = sum(rng.uniform(0.0, 0.3 / k) * np.cos(k * turn + rng.uniform(0, 6.3)) for k in range(2, 8))
    edge = radius * (1.0 + np.clip(wave, -0.4, 0.5))
    return _Lake(centre, centre + np.stack([np.cos(turn), np.sin(turn)], axis=1) * edge[:, None], radius)


def _lakes(seed: int, low: FloatArray, high: FloatArray) -> Iterator[_Lake]:
    first = np.floor((low - CENTRE - 700.0) / _LAKE_CELL_M).astype(int)
    last = np.floor((high - CENTRE + 700.0) / _LAKE_CELL_M).astype(int)
    for j in range(first[1], last[1] + 1):
        for i in range(first[0], last[0] + 1):
            lake = _lake(seed, i, j)
            if lake is not None:
                yield lake


def _hills(seed: int, xy: FloatArray) -> FloatArray:
    return (
        410.0 + 14.0 * _smooth(seed, xy, 900.0, 30) + 4.0 * _smooth(seed, xy, 260.0, 31)
        + 0.8 * _smooth(seed, xy, 70.0, 32)
    )  # fmt: skip


def _terrain(seed: int, xy: FloatArray, lakes: list[_Lake]) -> FloatArray:
    """(N,) heights of the bare ground; it sinks to a lake's level in its surroundings."""
    ground = _hills(seed, xy)
    for lake in lakes:
        level = float(_hills(seed, lake.centre[None])[0]) - 2.0
        away = np.linalg.norm(xy - lake.centre, axis=1) / lake.radius_m
        share = np.clip((2.4 - away) / 0.8, 0.0, 1.0)
        share = share * share * (3 - 2 * share)
        ground = level + (ground - level) * (1 - share)
    return ground


# --- drawing ---


class _Painter:
    """Draws one block."""

    def __init__(self, country: Country, view: View, look: Look) -> None:
        self.seed, self.view, self.look = country.seed, view, look
        low, high = view.box(_REACH_M)
        self.plots = list(country.plots(low, high))
        self.lakes = country.lakes(low, high)
        self.edges = country.edges(low, high)
        self.scale = view.px_per_m
        azimuth, elevation = np.radians([look.sun_azimuth_deg, look.sun_elevation_deg])
        # Metres a shadow reaches, per metre of height.
        self.away = -np.array([np.sin(azimuth), np.cos(azimuth)]) / np.tan(elevation)

    # -- rasters --

    def picture(self) -> ImageArray:
        """(H, W, 3) uint8."""
        view, look = self.view, self.look
        shape = (view.height, view.width)
        canvas = np.empty((*shape, 3), dtype=np.uint8)
        canvas[:] = look.grass
        # How strongly noise shows, 0..255; how much light falls, 255 = full sun.
        rough = np.full(shape, 120, dtype=np.uint8)
        light = np.full(shape, 255, dtype=np.uint8)
        self._fields(canvas, rough)
        self._ways(canvas, rough)
        for lake in self.lakes:
            outline = self._fixed(lake.centre + (lake.outline - lake.centre) * (1 + 4.0 / lake.radius_m))
            cv2.fillPoly(canvas, [outline], (126, 118, 92), cv2.LINE_AA, _SHIFT)
            cv2.fillPoly(canvas, [self._fixed(lake.outline)], look.water, cv2.LINE_AA, _SHIFT)
            cv2.fillPoly(rough, [self._fixed(lake.outline)], 12, cv2.LINE_8, _SHIFT)
        self._houses(canvas, rough, light)
        self._trees(canvas, rough, light)
        return self._exposed(canvas, rough, light)

    def surface(self) -> Float32Array:
        """(H, W) float32 m."""
        view = self.view
        ground = self._ground()
        above = np.zeros((view.height, view.width), dtype=np.float32)
        for plot in self.plots:
            for sown in plot.fields:
                if not sown.garden:
                    cv2.fillPoly(above, [self._fixed(sown.outline)], self._crop(sown)[1], cv2.LINE_8, _SHIFT)
        for kind, line in self.edges:
            self._line(above, line, EDGE_WIDTH_M[kind], 0.0)
        for lake in self.lakes:
            cv2.fillPoly(above, [self._fixed(lake.outline)], 0.0, cv2.LINE_8, _SHIFT)
        self._tree_tops(above)
        out = ground + above
        for plot in self.plots:
            for house in plot.houses:
                if not self._drowned(house.centre[None])[0]:
                    self._roof_heights(out, house)
        return out

    # -- parts --

    def _fields(self, canvas: ImageArray, rough: npt.NDArray[np.uint8]) -> None:
        view = self.view
        bank = _noise_bank(self.seed + 3, 1024, 0.7, 40.0)
        for plot in self.plots:
            if plot.use == FOREST:
                cv2.fillPoly(canvas, [self._fixed(plot.outline)], (58, 66, 44), cv2.LINE_AA, _SHIFT)
            for sown in plot.fields:
                px = self._fixed(sown.outline)
                low, high = self._window(px, 2)
                if (high <= low).any():
                    continue
                colour = self._crop(sown)[0]
                cv2.fillPoly(canvas, [px], colour, cv2.LINE_AA, _SHIFT)
                if sown.garden:
                    cv2.fillPoly(rough, [px], 150, cv2.LINE_8, _SHIFT)
                    continue
                tracks = _toned(colour, 0.86)
                for tram in sown.tramlines:
                    for side in (-0.9, 0.9):
                        along = tram[-1] - tram[0]
                        normal = np.array([-along[1], along[0]]) / np.linalg.norm(along)
                        self._line(canvas, tram + side * normal, 0.35, tracks)
                # Streaks along the rows: the noise stretched in their direction.
                width, height = (high - low).tolist()
                part = View(
                    width, height, np.column_stack([view.world_from_px[:, :2], view.world_from_px @ (*low, 1.0)])
                )
                streaks = _bank_on(part, bank, 0.45, sown.row_angle_rad, 9.0)
                mask = np.zeros((height, width), dtype=np.uint8)
                cv2.fillPoly(mask, [px - (low * _ONE).astype(np.int32)], 255, cv2.LINE_8, _SHIFT)
                window = (slice(low[1], high[1]), slice(low[0], high[0]))
                block = canvas[window]
                # 1 sigma of 40 becomes 10 % of the colour.
                factor = cv2.addWeighted(streaks, 0.32, streaks, 0.0, 128.0 * (1 - 0.32))
                textured = cv2.multiply(block, cv2.merge([factor] * 3), scale=1 / 128.0)
                cv2.copyTo(textured, mask, block)
                cv2.fillPoly(rough, [px], 84, cv2.LINE_8, _SHIFT)

    def _crop(self, sown: _Field) -> tuple[Colour, float]:
        look = self.look
        if sown.garden:
            tone = 0.8 + 0.45 * _cell(self.seed, sown.ident, 0, 40)
            bare = _cell(self.seed, sown.ident, 0, 41) < 0.22
            base = (166, 158, 148) if bare else look.grass
            return _toned(base, tone), 0.0
        chance = _cell(look.seed, sown.ident, 1, 42)
        colour, height = look.crops[int(chance * len(look.crops))]
        return _toned(colour, 0.9 + 0.2 * _cell(look.seed, sown.ident, 2, 43)), height

    def _ways(self, canvas: ImageArray, rough: npt.NDArray[np.uint8]) -> None:
        look = self.look
        for plot in self.plots:
            for street in plot.streets:
                self._line(canvas, street, 5.0, look.paved)
                self._line(rough, street, 5.0, 40)
        for kind, line in self.edges:
            self._line(canvas, line, EDGE_WIDTH_M[kind] + (4.5 if kind >= ROAD else 1.6), _toned(look.grass, 0.94))
        for kind, line in self.edges:
            if kind == HEDGE:
                continue
            width = EDGE_WIDTH_M[kind]
            colour = {TRACK: (178, 162, 136), ROAD: look.paved, HIGHWAY: (116, 116, 118)}[kind]
            self._line(canvas, line, width, colour)
            self._line(rough, line, width, 70 if kind == TRACK else 34)
            if kind == TRACK:
                self._line(canvas, line, 0.9, _toned(look.grass, 0.95))
            if kind == HIGHWAY:
                along = line[-1] - line[0]
                normal = np.array([-along[1], along[0]]) / np.linalg.norm(along)
                for side in (-0.43, 0.43):
                    self._line(canvas, line + side * width * normal, 0.22, (226, 226, 224))
                for k in np.arange(0.02, 0.98, 12.0 / np.linalg.norm(along)):
                    dash = _along(line, np.array([k, k + 4.0 / np.linalg.norm(along)]))
                    self._line(canvas, dash, 0.22, (226, 226, 224))

    def _houses(self, canvas: ImageArray, rough: npt.NDArray[np.uint8], light: npt.NDArray[np.uint8]) -> None:
        look = self.look
        seen: list[_House] = []
        for plot in self.plots:
            seen += [h for h in plot.houses if self._visible(h.corners) and not self._drowned(h.centre[None])[0]]
        for house in seen:
            tip = house.corners + self.away * house.eave_m
            ridge = house.centre + self.away * (house.eave_m + house.rise_m)
            ends = ridge + np.array([[-0.5], [0.5]]) * house.axis * house.length_m
            cv2.fillConvexPoly(light, self._hull(np.concatenate([house.corners, tip, ends])), 118, cv2.LINE_AA, _SHIFT)
        for house in seen:
            cv2.fillPoly(light, [self._fixed(house.corners)], 255, cv2.LINE_AA, _SHIFT)
            cv2.fillPoly(rough, [self._fixed(house.corners)], 46, cv2.LINE_8, _SHIFT)
            colours = _ROOFS + _HALLS
            roof = house.roof
            if _cell(look.seed, round(house.centre[0]), round(house.centre[1]), 44) < look.changed:
                roof = (roof + 1) % len(colours)
            colour = colours[roof]
            a, b, c, d = house.corners
            if house.rise_m < 0.5:
                cv2.fillPoly(canvas, [self._fixed(house.corners)], colour, cv2.LINE_AA, _SHIFT)
                continue
            start, end = (a + d) / 2, (b + c) / 2
            side = np.array([-house.axis[1], house.axis[0]])
            # The slope that faces the sun is brighter.
            facing = float(np.clip(-(side @ self.away), -1.2, 1.2)) * min(1.0, 2 * house.rise_m / house.width_m)
            cv2.fillPoly(canvas, [self._fixed(np.array([a, b, end, start]))], _toned(colour, 1 - 0.26 * facing),
                         cv2.LINE_AA, _SHIFT)  # fmt: skip
            cv2.fillPoly(canvas, [self._fixed(np.array([start, end, c, d]))], _toned(colour, 1 + 0.26 * facing),
                         cv2.LINE_AA, _SHIFT)  # fmt: skip
            self._line(canvas, np.array([start, end]), 0.35, _toned(colour, 1.2))
            spot = self._fixed((start * 0.7 + end * 0.3)[None])[0]
            cv2.circle(canvas, spot.tolist(), int(0.5 * self.scale * _ONE), (96, 74, 66), -1, cv2.LINE_8, _SHIFT)

    def _trees(self, canvas: ImageArray, rough: npt.NDArray[np.uint8], light: npt.NDArray[np.uint8]) -> None:
        look, scale = self.look, self.scale
        shadow = self.view.direction(self.away)
        glint = self.view.direction(-self.away / np.linalg.norm(self.away))
        for plot in self.plots:
            trees, at = self._standing(plot, _REACH_M)
            if not len(at):
                continue
            radius = np.maximum((trees.radius_m[at] * scale * _ONE).astype(int), 1).tolist()
            px = self.view.px(trees.xy[at])
            centre = np.round(px * _ONE).astype(int).tolist()
            # Crowns shade the ground beyond them, the more the higher they are; in a forest, one another.
            far = 0.55 * trees.height_m[at, None] * shadow
            shade = np.round((px + far) * _ONE).astype(int).tolist()
            # The lit side of a crown.
            top = np.round((px + 0.3 * trees.radius_m[at, None] * glint) * _ONE).astype(int).tolist()
            tones = 0.72 + 0.5 * ((trees.chance[at] * 97.0) % 1.0)
            base = np.array([look.leaves, look.needles])[trees.kind[at]] * tones[:, None]
            dark = (base * 0.74).astype(int).tolist()
            bright = np.minimum(base * 1.18, 255).astype(int).tolist()
            if plot.use != FOREST:
                for spot, r in zip(shade, radius, strict=True):
                    cv2.circle(light, spot, r, 128, -1, cv2.LINE_8, _SHIFT)
            for spot, r in zip(centre, radius, strict=True):
                cv2.circle(light, spot, r, 255, -1, cv2.LINE_8, _SHIFT)
            for k, r in enumerate(radius):
                cv2.circle(canvas, centre[k], r, dark[k], -1, cv2.LINE_8, _SHIFT)
                cv2.circle(canvas, top[k], int(0.66 * r), bright[k], -1, cv2.LINE_8, _SHIFT)
                cv2.circle(rough, centre[k], r, 225, -1, cv2.LINE_8, _SHIFT)

    def _exposed(self, canvas: ImageArray, rough: npt.NDArray[np.uint8], light: npt.NDArray[np.uint8]) -> ImageArray:
        view, look = self.view, self.look
        fine = _bank_on(view, _noise_bank(self.seed, 2048, 0.75, 24.0), 0.4)
        coarse = _bank_on(view, _noise_bank(self.seed + 1, 1024, 1.1, 64.0), 1.9)
        season = _bank_on(view, _noise_bank(self.seed + 50 + look.seed, 512, 1.0, 64.0), 2.3, 0.6)
        mixed = cv2.addWeighted(fine, 0.68, coarse, 0.42, -128.0 * 0.10)
        mixed = cv2.addWeighted(mixed, 0.9, season, 0.28, -128.0 * 0.18)
        # 128 + rough / 255 * (mixed - 128), 1 sigma of 33 at full roughness is 26 %.
        swing = cv2.multiply(rough, mixed, scale=1 / 255.0, dtype=cv2.CV_16S)
        swing = cv2.subtract(swing, cv2.multiply(rough, np.full_like(rough, 128), scale=1 / 255.0, dtype=cv2.CV_16S))
        factor = cv2.multiply(swing + np.int16(128), light.astype(np.int16), scale=1 / 255.0, dtype=cv2.CV_8U)
        gains = look.gain
        lit = cv2.merge([cv2.multiply(canvas[..., k], factor, scale=gains[k] / 128.0) for k in range(3)])
        sigma = max(0.35, 0.13 * self.scale)
        return np.asarray(cv2.GaussianBlur(lit, (5, 5), sigma), dtype=np.uint8)

    def _ground(self) -> Float32Array:
        view = self.view
        # Smooth by nature: computed every few metres, brought to size by cubic interpolation.
        step = max(1, round(4.0 * self.scale))
        columns, rows = view.width // step + 5, view.height // step + 5
        u, v = np.meshgrid((np.arange(columns) - 2) * step, (np.arange(rows) - 2) * step)
        px = np.stack([u.ravel(), v.ravel(), np.ones(u.size)], axis=1)
        xy = np.asarray(px @ view.world_from_px.T, dtype=np.float64)
        coarse = _terrain(self.seed, xy, self.lakes).reshape(rows, columns)
        level = float(coarse.mean())
        # float64: a float32 position in a block is good to 1e-4 of a cell only.
        tall = _cubic(np.asarray(coarse - level, dtype=np.float32), np.arange(view.height) / step + 2.0)
        full = _cubic(np.ascontiguousarray(tall.T), np.arange(view.width) / step + 2.0).T
        return np.asarray(full + np.float32(level), dtype=np.float32)

    def _tree_tops(self, above: Float32Array) -> None:
        view, scale = self.view, self.scale
        for plot in self.plots:
            trees, at = self._standing(plot, _CROWN_M)
            if not len(at):
                continue
            px, radius, height = view.px(trees.xy[at]), trees.radius_m[at], trees.height_m[at]
            base = np.round(px).astype(int)
            # Between the crowns of a forest one looks on branches, not on its ground.
            spread = _FOREST_SPREAD if plot.use == FOREST else 1.0
            reach = int(np.ceil(spread * radius.max() * scale)) + 1
            for dv in range(-reach, reach + 1):
                for du in range(-reach, reach + 1):
                    near = np.hypot(*(base + np.array([du, dv]) - px).T) / scale / radius
                    u, v = base[:, 0] + du, base[:, 1] + dv
                    hit = (near < spread) & (u >= 0) & (v >= 0) & (u < view.width) & (v < view.height)
                    if hit.any():
                        dome = np.where(near < 1, height - 0.9 * radius * near**2, _FOREST_FLOOR * height)[hit]
                        np.maximum.at(above, (v[hit], u[hit]), dome.astype(np.float32))

    def _roof_heights(self, out: Float32Array, house: _House) -> None:
        px = self._fixed(house.corners)
        low, high = self._window(px, 1)
        if (high <= low).any():
            return
        view = self.view
        u, v = np.meshgrid(np.arange(low[0], high[0]), np.arange(low[1], high[1]))
        centre = view.px(house.centre[None])[0]
        offset = np.stack([u - centre[0], v - centre[1]], axis=-1) @ view.world_from_px[:, :2].T
        along = offset @ house.axis
        across = offset @ np.array([-house.axis[1], house.axis[0]])
        inside = (np.abs(along) <= house.length_m / 2) & (np.abs(across) <= house.width_m / 2)
        base = float(_terrain(self.seed, house.centre[None], self.lakes)[0])
        roof = base + house.eave_m + house.rise_m * (1 - np.abs(across) / (house.width_m / 2))
        block = out[low[1] : high[1], low[0] : high[0]]
        np.copyto(block, roof.astype(np.float32), where=inside)

    # -- tools --

    def _standing(self, plot: Plot, reach_m: float) -> tuple[_Trees, npt.NDArray[np.intp]]:
        """Trees of a plot that this look has and that may reach the block."""
        trees, view = plot.trees, self.view
        px = view.px(trees.xy)
        reach = reach_m * self.scale
        near = (px > -reach).all(axis=1) & (px < np.array([view.width, view.height]) + reach).all(axis=1)
        fate = (trees.chance * 31.0 + self.look.seed * 0.37) % 1.0
        at = np.flatnonzero(near & (fate >= self.look.changed))
        return trees, at[~self._drowned(trees.xy[at])]

    def _drowned(self, xy: FloatArray) -> BoolArray:
        wet = np.zeros(len(xy), dtype=bool)
        for lake in self.lakes:
            close = np.linalg.norm(xy - lake.centre, axis=1) < 1.55 * lake.radius_m
            for k in np.flatnonzero(close):
                local = (lake.outline - lake.centre).astype(np.float32)
                spot = xy[k] - lake.centre
                wet[k] |= cv2.pointPolygonTest(local, (float(spot[0]), float(spot[1])), True) > -7.0
        return wet

    def _fixed(self, xy: FloatArray) -> npt.NDArray[np.int32]:
        return np.round(self.view.px(xy) * _ONE).astype(np.int32)

    def _hull(self, xy: FloatArray) -> npt.NDArray[np.int32]:
        return np.asarray(cv2.convexHull(self._fixed(xy)), dtype=np.int32)

    def _visible(self, xy: FloatArray) -> bool:
        px = self.view.px(xy)
        reach = _REACH_M * self.scale
        size = np.array([self.view.width, self.view.height])
        return bool((px.max(axis=0) > -reach).all() and (px.min(axis=0) < size + reach).all())

    def _window(self, px: npt.NDArray[np.int32], margin: int) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
        """First and last + 1 (column, row) of the pixels around fixed-point points, inside the block."""
        low = np.maximum(px.min(axis=0) // _ONE - margin, 0).astype(np.int64)
        high = np.minimum(px.max(axis=0) // _ONE + margin + 1, (self.view.width, self.view.height)).astype(np.int64)
        return low, high

    def _line(self, canvas: npt.NDArray[Any], line: FloatArray, width_m: float, value: Colour | float) -> None:
        """A band of a true width: cv2's own thickness is whole pixels."""
        if not self._visible(line):
            return
        step = np.gradient(line, axis=0)
        normal = np.stack([-step[:, 1], step[:, 0]], axis=1) / np.linalg.norm(step, axis=1)[:, None]
        band = np.concatenate([line + normal * width_m / 2, (line - normal * width_m / 2)[::-1]])
        kind = cv2.LINE_AA if canvas.dtype == np.uint8 else cv2.LINE_8
        cv2.fillPoly(canvas, [self._fixed(band)], value, kind, _SHIFT)


def _toned(colour: Colour, tone: float) -> Colour:
    red, green, blue = (int(min(255.0, max(0.0, c * tone))) for c in colour)
    return red, green, blue


def _cubic(rows: Float32Array, at: FloatArray) -> Float32Array:
    """Rows of (H, W) interpolated at positions (N,): Catmull-Rom, exact where cv2 rounds to 1/32 of a cell."""
    base = np.floor(at).astype(int)
    t = (at - base).astype(np.float32)[:, None]
    a, b, c, d = (rows[base + k] for k in (-1, 0, 1, 2))
    bent = 2 * a - 5 * b + 4 * c - d + t * (3 * (b - c) + d - a)
    return np.asarray(b + 0.5 * t * (c - a + t * bent), dtype=np.float32)
