"""A generated piece of country on rasters: what the ground is made of, how high its surface is, how it looks.

`generate(spec)` gives what persists; `build_scene(world, epoch)` gives surface and texture of one epoch. The map is
made from one epoch and the camera sees another, so no image is matched against itself (field notes, "Test realism").
Rasters have row 0 in the north; coordinates are local metres from the south-west corner (`layout`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from ortholoc_edge.geometry.arrays import Float32Array, FloatArray, ImageArray
from ortholoc_edge.geometry.grid import RasterGrid
from ortholoc_sim.epoch import Car, Epoch, standing
from ortholoc_sim.layout import Building, Crop, Layout, Tree, arc_length, generate_layout, normals
from ortholoc_sim.noise import blobs, grain, octaves

ByteArray = npt.NDArray[np.uint8]
# Of either precision.
AnyFloats = npt.NDArray[np.floating[Any]]
_SHIFT = 4  # cv2's drawing takes fixed-point coordinates: sixteenths of a pixel

# Ids in `Scene.objects`: 0 is ground.
FIRST_TREE = 10_000
FIRST_CAR = 40_000


class Cover(IntEnum):
    """What the ground is; parcels follow from `FIRST_PARCEL`."""

    GRASS = 0
    YARD = 1
    GRAVEL = 2
    ASPHALT = 3
    STREET = 4
    WATER = 5
    SHORE = 6


FIRST_PARCEL = 8
MAX_PARCELS = 256 - FIRST_PARCEL
_FIXED_COLOURS = {
    Cover.YARD: (164, 158, 148),
    Cover.GRAVEL: (178, 164, 140),
    Cover.ASPHALT: (112, 112, 114),
    Cover.STREET: (128, 126, 124),
    Cover.SHORE: (136, 126, 96),
}


@dataclass(frozen=True, slots=True)
class WorldSpec:
    """Which world. ``gsd_m`` is the pixel of its rasters; the map is coarser."""

    seed: int = 7
    width_m: float = 600.0
    height_m: float = 500.0
    gsd_m: float = 0.125
    ground_m: float = 430.0

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, columns)."""
        return round(self.height_m / self.gsd_m), round(self.width_m / self.gsd_m)

    @property
    def grid(self) -> RasterGrid:
        """Of the rasters, in local metres."""
        rows, columns = self.shape
        return RasterGrid(columns, rows, 0.0, self.height_m, self.gsd_m, -self.gsd_m)


@dataclass(frozen=True, slots=True, eq=False)
class World:
    """What persists between epochs.

    Attributes:
        terrain: (H, W) m, bare earth.
        cover: (H, W) `Cover` or `FIRST_PARCEL` + index into ``layout.parcels``.
        paint: (H, W) 0..255, road markings.
        detail: (H, W) 0..255, small dark (< 128) and bright things: patches of tar, ruts, bushes, paths.
        soil: (H, W) persistent texture of the ground, unit variance.
    """

    spec: WorldSpec
    layout: Layout
    terrain: Float32Array
    cover: ByteArray
    paint: ByteArray
    detail: ByteArray
    soil: Float32Array


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """The world at one epoch.

    Attributes:
        texture: (H, W, 3) RGB, orthographic, with the shadows cast.
        surface: (H, W) m, top of everything.
        terrain: (H, W) m, bare earth.
        objects: (H, W) 0 ground, 1 + index of a building, `FIRST_TREE` + index, `FIRST_CAR` + index.
    """

    spec: WorldSpec
    epoch: Epoch
    texture: ImageArray
    surface: Float32Array
    terrain: Float32Array
    objects: npt.NDArray[np.uint16]
    buildings: tuple[Building, ...]
    trees: tuple[Tree, ...]
    cars: tuple[Car, ...]


def generate(spec: WorldSpec | None = None, layout: Layout | None = None, terrain: Float32Array | None = None) -> World:
    """The world of ``spec``; the same arguments give the same bytes.

    Args:
        layout: what stands where, instead of what follows from the spec; its last two roads are the marked ones.
        terrain: (H, W) m, bare earth, instead of hills made for the layout.
    Raises: ValueError if the layout has more parcels than a cover's byte can tell apart.
    """
    spec = spec or WorldSpec()
    layout = layout or generate_layout(spec.width_m, spec.height_m, spec.seed)
    if len(layout.parcels) > MAX_PARCELS:
        raise ValueError(f"{len(layout.parcels)} parcels, at most {MAX_PARCELS}: make the world smaller")
    pen = _Pen(spec)
    if terrain is None:
        terrain = _terrain(spec, layout)
    cover = _cover(pen, layout)
    paint, detail = _markings(pen, layout), _details(pen, layout, spec.seed)
    g = spec.gsd_m
    soil = octaves(spec.shape, (0.5 / g, 1.6 / g, 5.0 / g, 22.0 / g), (0.55, 0.7, 0.7, 0.6), spec.seed + 100)
    return World(spec, layout, terrain, cover, paint, detail, soil)


class _Pen:
    """Draws vectors in local metres on rasters of the world."""

    def __init__(self, spec: WorldSpec) -> None:
        self.spec = spec

    def px(self, points_m: FloatArray) -> npt.NDArray[np.int32]:
        """Local metres (N, 2) to cv2's fixed-point pixels."""
        px = self.spec.grid.px_from_map(points_m)
        return np.round(px * (1 << _SHIFT)).astype(np.int32)

    def thickness(self, width_m: float) -> int:
        return max(1, round(width_m / self.spec.gsd_m))

    def fill(self, raster: ByteArray, outline_m: FloatArray, value: int) -> None:
        cv2.fillPoly(raster, [self.px(outline_m)], value, cv2.LINE_8, _SHIFT)

    def stroke(self, raster: ByteArray, line_m: FloatArray, width_m: float, value: int, smooth: bool = False) -> None:
        kind = cv2.LINE_AA if smooth else cv2.LINE_8
        cv2.polylines(raster, [self.px(line_m)], False, value, self.thickness(width_m), kind, _SHIFT)


def _terrain(spec: WorldSpec, layout: Layout) -> Float32Array:
    # Smooth by nature: computed coarsely, brought to size once.
    rows, columns = spec.shape
    step = 8
    shape = (rows // step, columns // step)
    g = spec.gsd_m * step
    hills = 5.0 * blobs(shape, 170 / g, spec.seed + 1) + 1.4 * blobs(shape, 60 / g, spec.seed + 2)
    hills = cv2.GaussianBlur(hills + 0.12 * blobs(shape, 9 / g, spec.seed + 3), (0, 0), 3.0)
    x = np.linspace(-1.0, 1.0, shape[1], dtype=np.float32)
    coarse = np.float32(spec.ground_m) + hills + 3.0 * x[None, :]
    terrain = cv2.resize(coarse.astype(np.float32), (columns, rows), interpolation=cv2.INTER_CUBIC)
    basin = np.zeros(spec.shape, dtype=np.uint8)
    _Pen(spec).fill(basin, layout.pond, 255)
    inside = basin > 0
    level = float(terrain[inside].min()) - 0.4
    bank = cv2.blur(basin, (41, 41)).astype(np.float32) * np.float32(1 / 255)
    terrain += (np.float32(level) - terrain) * bank
    terrain[inside] = level
    return np.asarray(terrain, dtype=np.float32)


def _cover(pen: _Pen, layout: Layout) -> ByteArray:
    cover = np.full(pen.spec.shape, Cover.GRASS, dtype=np.uint8)
    for i, parcel in enumerate(layout.parcels):
        pen.fill(cover, parcel.outline, FIRST_PARCEL + i)
    for i, parcel in enumerate(layout.parcels):  # strips of grass between fields, of several widths
        pen.stroke(cover, np.vstack([parcel.outline, parcel.outline[:1]]), 0.9 + 0.5 * (i % 3), Cover.GRASS)
    for road in layout.roads:
        pen.stroke(cover, road.line, road.width_m + (5.0 if road.paved else 1.6), Cover.GRASS)
    for house in layout.buildings:
        centre = house.corners.mean(axis=0)
        pen.fill(cover, centre + (house.corners - centre) * (1.0 + 14.0 / house.length_m), Cover.GRASS)
    for yard in layout.yards:
        pen.fill(cover, yard, Cover.YARD)
    for road in layout.roads:
        kind = Cover.ASPHALT if road.marked else Cover.STREET if road.paved else Cover.GRAVEL
        pen.stroke(cover, road.line, road.width_m, kind)
        if not road.paved:
            pen.stroke(cover, road.line, 0.7, Cover.GRASS)
    centre = layout.pond.mean(axis=0)
    pen.fill(cover, centre + (layout.pond - centre) * 1.10, Cover.SHORE)
    pen.fill(cover, layout.pond, Cover.WATER)
    return cover


def _markings(pen: _Pen, layout: Layout) -> ByteArray:
    paint = np.zeros(pen.spec.shape, dtype=np.uint8)
    for road in layout.roads:
        if not road.marked:
            continue
        left, along = normals(road.line), arc_length(road.line)
        for side in (-1.0, 1.0):
            pen.stroke(paint, road.line + side * left * (road.width_m / 2 - 0.35), 0.2, 235, True)
        for start in np.arange(0.0, along[-1] - 4.0, 9.0):
            ends = np.array([start, start + 2.0, start + 4.0])
            dash = np.stack([np.interp(ends, along, road.line[:, k]) for k in (0, 1)], axis=1)
            pen.stroke(paint, dash, 0.22, 245, True)
    gap = np.zeros_like(paint)
    for road in layout.roads:  # no lines across the mouths of side roads and the crossing
        if not road.marked and road.paved:
            pen.stroke(gap, np.vstack([road.line[:3]]), road.width_m + 2.0, 255)
            pen.stroke(gap, np.vstack([road.line[-3:]]), road.width_m + 2.0, 255)
    cv2.circle(
        gap,
        (pen.px(layout.crossing[None])[0]).tolist(),
        int(8.0 / pen.spec.gsd_m) << _SHIFT,
        255,
        -1,
        cv2.LINE_8,
        _SHIFT,
    )
    paint[gap > 0] = 0
    for road in layout.roads[-2:]:  # zebra crossings and stop lines before the junction
        left, along = normals(road.line), arc_length(road.line)
        nearest = int(np.argmin(np.linalg.norm(road.line - layout.crossing, axis=1)))
        for offset in (-12.0, 12.0):
            at = along[nearest] + offset
            spot = np.array([np.interp(at, along, road.line[:, k]) for k in (0, 1)])
            n = left[int(np.searchsorted(along, at))]
            t = np.array([n[1], -n[0]])
            for k in np.arange(-road.width_m / 2 + 0.6, road.width_m / 2 - 0.3, 1.0):
                bar = spot + n * k
                pen.stroke(paint, np.array([bar - t * 1.6, bar + t * 1.6]), 0.5, 240)
            stop = spot + t * 3.4 * np.sign(offset)
            pen.stroke(paint, np.array([stop, stop + n * np.sign(offset) * (road.width_m / 2 - 0.5)]), 0.45, 240)
    return paint


def _details(pen: _Pen, layout: Layout, seed: int) -> ByteArray:  # noqa: PLR0912 -- a list of things
    """Small lasting things: what matchers live on between the houses."""
    rng = np.random.default_rng([seed, 3])
    spec = pen.spec
    detail = np.full(spec.shape, 128, dtype=np.uint8)
    for parcel in layout.parcels:  # bushes, molehills, wet spots, stacks; a trodden path now and then
        centre, spread = parcel.outline.mean(axis=0), parcel.outline.std(axis=0)
        for _ in range(int(rng.integers(4, 26))):
            spot = pen.px((centre + rng.uniform(-1.3, 1.3, 2) * spread)[None])[0]
            axes = rng.uniform(0.25, 0.95, 2) / spec.gsd_m * (1 << _SHIFT)
            value = int(rng.choice([62, 78, 92, 160, 176]))
            for k in range(4):  # four overlapping discs have no shape of their own
                lobe = spot + rng.normal(0.0, 0.8 * axes[0], 2).astype(np.int32)
                cv2.circle(detail, lobe.tolist(), int(axes[0] * (1.0 - 0.18 * k)), value, -1, cv2.LINE_AA, _SHIFT)
        if parcel.crop is Crop.MEADOW:
            ends = centre + rng.uniform(-1.4, 1.4, (3, 2)) * spread
            t = np.linspace(0, 1, 24)[:, None]
            bend = (1 - t) ** 2 * ends[0] + 2 * t * (1 - t) * ends[1] + t**2 * ends[2]
            pen.stroke(detail, bend, 0.6, 172, True)
    for road in layout.roads:
        left, count = normals(road.line), len(road.line)
        if not road.paved:
            for side in (-0.8, 0.8):
                pen.stroke(detail, road.line + side * left, 0.5, 150, True)
        for _ in range(count // 7):  # mended patches and bar joints
            i = int(rng.integers(2, count - 3))
            t = np.array([left[i, 1], -left[i, 0]])
            a, b = rng.uniform(0.6, 4.5), rng.uniform(0.4, 1.5)
            spot = road.line[i] + left[i] * rng.uniform(-0.35, 0.35) * road.width_m
            quad = np.array(
                [
                    spot - t * a - left[i] * b,
                    spot + t * a - left[i] * b,
                    spot + t * a + left[i] * b,
                    spot - t * a + left[i] * b,
                ]
            )
            pen.fill(detail, quad, int(rng.choice([88, 98, 106, 150])))
        if road.paved:
            for _ in range(count // 5):  # cracks, sealed with tar
                i = int(rng.integers(2, count - 6))
                spot = road.line[i : i + 4] + left[i : i + 4] * rng.uniform(-0.45, 0.45) * road.width_m
                pen.stroke(detail, spot + rng.normal(0, 0.25, spot.shape), 0.15, 70, True)
            for _ in range(count // 14):  # manholes
                i = int(rng.integers(2, count - 3))
                spot = pen.px((road.line[i] + left[i] * rng.uniform(-0.3, 0.3) * road.width_m)[None])[0]
                cv2.circle(detail, spot.tolist(), int(0.4 / spec.gsd_m * (1 << _SHIFT)), 66, -1, cv2.LINE_AA, _SHIFT)
    for yard in layout.yards:  # flags, beds, bins
        centre = yard.mean(axis=0)
        for _ in range(5):
            spot = pen.px((centre + rng.normal(0, 3.5, 2))[None])[0]
            size = int(rng.uniform(0.3, 0.9) / spec.gsd_m * (1 << _SHIFT))
            cv2.circle(detail, spot.tolist(), size, int(rng.choice([70, 90, 165, 185])), -1, cv2.LINE_AA, _SHIFT)
    return detail


class _Builder:
    """Rasters of one epoch while they are being made. Colour planes stay apart: one plane fits the caches better."""

    def __init__(self, world: World, epoch: Epoch) -> None:
        self.world, self.epoch, self.spec = world, epoch, world.spec
        self.planes = [self._lookup(channel) for channel in range(3)]
        self.surface = world.terrain.copy()
        self.objects = np.zeros(self.spec.shape, dtype=np.uint16)
        self.leaves = blobs(self.spec.shape, 0.7 / self.spec.gsd_m, world.spec.seed + 40)

    def _lookup(self, channel: int) -> ByteArray:
        table = np.zeros(256, dtype=np.uint8)
        for kind, colour in _FIXED_COLOURS.items():
            table[kind] = colour[channel]
        table[Cover.GRASS] = self.epoch.grass[channel]
        table[Cover.WATER] = self.epoch.water[channel]
        rng = np.random.default_rng([self.epoch.seed, 2])
        for i, parcel in enumerate(self.world.layout.parcels):
            lot = rng.uniform(0.92, 1.08) * self.epoch.crops[parcel.crop].colour[channel]
            table[FIRST_PARCEL + i] = np.clip(lot, 0, 255)
        return np.asarray(cv2.LUT(self.world.cover, table), dtype=np.uint8)

    def per_cover(self, values: Mapping[int, float], default: float) -> Float32Array:
        """(H, W) float32 by cover."""
        table = np.full(256, default, dtype=np.float32)
        for kind, value in values.items():
            table[kind] = value
        return np.asarray(cv2.LUT(self.world.cover, table[None]), dtype=np.float32)

    def window(self, x: float, y: float, reach: float) -> tuple[slice, slice, AnyFloats, AnyFloats] | None:
        """Rows and columns around (x, y) and the offsets (east, north) in m of their pixel centres."""
        g = self.spec.gsd_m
        rows, columns = self.spec.shape
        left, right = max(0, int((x - reach) / g)), min(columns, int((x + reach) / g) + 2)
        top, bottom = (
            max(0, int((self.spec.height_m - y - reach) / g)),
            min(rows, int((self.spec.height_m - y + reach) / g) + 2),
        )
        if left >= right or top >= bottom:
            return None
        east = (np.arange(left, right) + 0.5) * g - x
        north = self.spec.height_m - (np.arange(top, bottom) + 0.5) * g - y
        return slice(top, bottom), slice(left, right), east[None, :], north[:, None]

    def colour(
        self,
        where: tuple[slice, slice],
        mask: npt.NDArray[np.bool_],
        rgb: tuple[float, ...],
        shade: AnyFloats | float = 1.0,
    ) -> None:
        for plane, value in zip(self.planes, rgb, strict=True):
            block = plane[where]
            tone = np.clip(np.broadcast_to(np.asarray(shade) * value, mask.shape), 0, 255).astype(np.uint8)
            np.copyto(block, tone, where=mask)

    def crops(self) -> None:
        heights = {
            FIRST_PARCEL + i: self.epoch.crops[parcel.crop].height_m
            for i, parcel in enumerate(self.world.layout.parcels)
        }
        # Crops end within half a metre, not as a wall.
        self.surface += cv2.blur(self.per_cover(heights, 0.0), (5, 5))

    def building(self, index: int, house: Building) -> None:
        reach = float(np.hypot(house.length_m, house.width_m)) / 2 + 0.3
        spot = self.window(house.x_m, house.y_m, reach)
        if spot is None:
            return
        rows, columns, east, north = spot
        c, s = np.cos(house.angle_rad), np.sin(house.angle_rad)
        along, across = c * east + s * north, -s * east + c * north
        inside = (np.abs(along) <= house.length_m / 2) & (np.abs(across) <= house.width_m / 2)
        base = self.base_height(house)
        height = house.eave_m + house.rise_m * (1.0 - np.abs(across) / (house.width_m / 2))
        if house.rise_m > 0:
            # Courses of tiles and their seams, the two sides weathered differently, a bright ridge.
            shade = (
                1.0 + 0.05 * np.sign(np.sin(2 * np.pi * across / 0.9)) + 0.03 * np.sign(np.sin(2 * np.pi * along / 1.7))
            )
            shade = shade * np.where(across > 0, 1.03, 0.97) * np.where(np.abs(across) < 0.2, 1.22, 1.0)
        else:
            shade = 1.0 + 0.05 * np.sign(np.sin(2 * np.pi * along / 4.0)) + 0.0 * across
            rim = (np.abs(along) > house.length_m / 2 - 0.35) | (np.abs(across) > house.width_m / 2 - 0.35)
            shade = np.where(rim, 1.22, shade)
        self.colour((rows, columns), inside, house.colour, shade)
        if house.panel:
            field = (
                (across > 0.18 * house.width_m)
                & (across < 0.42 * house.width_m)
                & (np.abs(along) < 0.32 * house.length_m)
            )
            grid = np.where((np.mod(along, 1.7) < 0.18) | (np.mod(across, 1.0) < 0.14), 2.2, 1.0)
            self.colour((rows, columns), field & inside, (38, 46, 72), grid)
        for box in house.boxes:
            part = (np.abs(along - box.along_m) <= box.length_m / 2) & (
                np.abs(across - box.across_m) <= box.width_m / 2
            )
            height = np.where(part, height + box.height_m, height)
            self.colour((rows, columns), part & inside, (92, 84, 80) if house.rise_m > 0 else (206, 206, 204))
        self.surface[rows, columns][inside] = (base + height)[inside]
        self.objects[rows, columns][inside] = 1 + index

    def base_height(self, house: Building) -> float:
        return base_height(self.world.spec, self.world.terrain, house)

    def tree(self, index: int, tree: Tree) -> None:
        spot = self.window(tree.x_m, tree.y_m, tree.radius_m * 1.25)
        if spot is None:
            return
        rows, columns, east, north = spot
        angle = np.arctan2(north, east)
        outline = 1.0 + 0.12 * np.sin(3 * angle + tree.lobes) + 0.08 * np.sin(5 * angle + 2 * tree.lobes)
        bumps = self.leaves[rows, columns]
        r = np.hypot(east, north) / (tree.radius_m * (0.65 if tree.conifer else 1.0) * (outline + 0.07 * bumps))
        inside = r < 1.0
        dome = 0.15 + 0.85 * (1.0 - r) if tree.conifer else 0.42 + 0.58 * np.sqrt(np.clip(1.0 - r * r, 0.0, 1.0))
        ground = self.world.terrain[(rows.start + rows.stop) // 2, (columns.start + columns.stop) // 2]
        top = ground + tree.height_m * dome + (0.25 if tree.conifer else 0.45) * bumps
        higher = inside & (top > self.surface[rows, columns])
        self.surface[rows, columns][higher] = top[higher]
        self.objects[rows, columns][higher] = FIRST_TREE + index
        look = self.epoch
        rgb = look.needles if tree.conifer else tuple(
            a + tree.tint * b for a, b in zip(look.leaves, look.leaves_spread, strict=True)
        )  # fmt: skip
        self.colour((rows, columns), higher, rgb, 1.0 + 0.10 * bumps)

    def car(self, index: int, car: Car) -> None:
        spot = self.window(car.slot.x_m, car.slot.y_m, 2.6)
        if spot is None:
            return
        rows, columns, east, north = spot
        c, s = np.cos(car.slot.angle_rad), np.sin(car.slot.angle_rad)
        along, across = c * east + s * north, -s * east + c * north
        body = (np.abs(along) <= 2.2) & (np.abs(across) <= 0.9) & (self.objects[rows, columns] == 0)
        cabin = (np.abs(along + 0.2) <= 1.3) & (np.abs(across) <= 0.8)
        glass = cabin & (np.abs(along + 0.2) > 0.75)
        self.surface[rows, columns][body] += np.where(cabin, 1.45, 0.9)[body].astype(np.float32)
        self.objects[rows, columns][body] = FIRST_CAR + index
        self.colour((rows, columns), body, car.colour)
        self.colour((rows, columns), body & glass, (34, 38, 44))

    def shade(self) -> Float32Array:
        """(H, W) factor on all channels: soil, rows, wheel tracks, grain."""
        world, epoch, spec, g = self.world, self.epoch, self.spec, self.spec.gsd_m
        parcels = world.layout.parcels
        ground: dict[int, float] = {
            Cover.GRASS: 0.07, Cover.YARD: 0.06, Cover.GRAVEL: 0.07, Cover.ASPHALT: 0.04, Cover.STREET: 0.05,
            Cover.WATER: 0.0, Cover.SHORE: 0.08,
        }  # fmt: skip
        shade = self.per_cover(ground, 0.085)
        shade *= world.soil
        own = octaves(spec.shape, (0.4 / g, 2.5 / g), (1.0, 0.7), epoch.seed + 60)
        own *= self.per_cover({Cover.WATER: 0.02, Cover.ASPHALT: 0.02, Cover.STREET: 0.02, Cover.YARD: 0.03}, 0.05)
        shade += own
        shade += np.float32(0.02) * grain(spec.shape, epoch.seed)
        across_x, across_y, rows_amplitude, tracked = {}, {}, {}, {}
        for i, parcel in enumerate(parcels):
            kind = FIRST_PARCEL + i
            across_x[kind] = -np.sin(parcel.row_angle_rad)
            across_y[kind] = np.cos(parcel.row_angle_rad)
            rows_amplitude[kind] = epoch.crops[parcel.crop].rows
            tracked[kind] = 0.0 if parcel.crop in (Crop.MEADOW, Crop.ORCHARD) else -0.16
        x = ((np.arange(spec.shape[1], dtype=np.float32) + 0.5) * g)[None, :]
        y = (spec.height_m - (np.arange(spec.shape[0], dtype=np.float32) + 0.5) * g)[:, None]
        across = self.per_cover(across_x, 0.0) * x
        across += self.per_cover(across_y, 0.0) * y
        pairs = np.abs(np.mod(across, np.float32(18.0)) - np.float32(9.0))
        np.abs(pairs - np.float32(0.9), out=pairs)
        shade += np.where(pairs < 0.3, self.per_cover(tracked, 0.0), np.float32(0.0))
        spacing = {FIRST_PARCEL + i: 2 * np.pi / parcel.row_spacing_m for i, parcel in enumerate(parcels)}
        across *= self.per_cover(spacing, 0.0)
        # cv2.polarToCart is the fastest sine at hand.
        _, wave = cv2.polarToCart(self.per_cover(rows_amplitude, 0.0), across)
        shade += wave
        shade += (world.detail.astype(np.float32) - 128.0) * np.float32(1 / 190)
        shade[self.objects > 0] *= 0.45
        shade += 1.0
        return shade

    def texture(self) -> ImageArray:
        epoch, g = self.epoch, self.spec.gsd_m
        paint = self.world.paint.astype(np.float32) * np.float32(0.8 / 255)
        paint[self.objects > 0] = 0.0
        shade, lit = self.shade(), sunlight(self.surface, g, epoch.sun)
        tint = octaves(self.spec.shape, (12.0 / g, 45.0 / g), (0.6, 1.0), self.spec.seed + 70)
        tint += np.float32(0.6) * blobs(self.spec.shape, 30.0 / g, epoch.seed + 71)
        tint *= self.per_cover({**dict.fromkeys(_FIXED_COLOURS, 0.0), Cover.WATER: 0.0}, epoch.tint)
        tint[self.objects > 0] = 0.0
        out = np.empty((*self.spec.shape, 3), dtype=np.uint8)
        for channel, plane in enumerate(self.planes):
            value = plane * shade
            value += (np.float32(232.0) - value) * paint
            value *= np.float32(epoch.ambient[channel]) + np.float32(epoch.direct[channel]) * lit
            if channel != 2:
                value *= 1.0 + tint if channel == 0 else 1.0 - np.float32(0.5) * tint
            value -= 128.0
            value *= np.float32(epoch.contrast)
            value += 128.0
            value *= np.float32(epoch.gain[channel])
            out[..., channel] = np.clip(value, 0, 255, out=value)
        return out


def sunlight(surface: Float32Array, gsd_m: float, sun: FloatArray) -> Float32Array:
    """(H, W) share of the sun's light that arrives, 1 on open flat ground."""
    g = gsd_m
    east, north, up = sun
    gx: AnyFloats = cv2.Sobel(surface, cv2.CV_32F, 1, 0, ksize=1, scale=0.5 / g).astype(np.float32, copy=False)
    gy: AnyFloats = cv2.Sobel(surface, cv2.CV_32F, 0, 1, ksize=1, scale=-0.5 / g).astype(np.float32, copy=False)
    lit = np.float32(up) - gx * np.float32(east) - gy * np.float32(north)
    gx *= gx
    gy *= gy
    gx += gy
    gx += 1.0
    lit /= np.sqrt(gx)
    lit *= np.float32(1.0 / up)
    np.clip(lit, 0.0, 1.35, out=lit)
    lit *= 1.0 - cast_shadow(surface, g, sun)
    return np.asarray(lit, dtype=np.float32)


def cast_shadow(surface: Float32Array, gsd_m: float, sun: FloatArray) -> Float32Array:
    """(H, W) 0 in the sun, 1 in shade cast by something between the pixel and the sun.

    The highest obstacle along the ray, max over t of (height(p + t) - t * slope), is found by doubling the
    length seen: seven shifts for 64 m.
    """
    g = gsd_m
    east, north, up = sun
    flat = float(np.hypot(east, north))
    slope = up / flat
    seen = surface.copy()
    step = 1
    while step * g < 40.0:
        dx, dy = step * east / flat, -step * north / flat
        ix, iy = round(dx), round(dy)
        drop = np.float32(np.hypot(ix, iy) * g * slope)
        rows, columns = seen.shape
        to = seen[max(0, -iy) : rows - max(0, iy), max(0, -ix) : columns - max(0, ix)]
        source = seen[max(0, iy) : rows - max(0, -iy), max(0, ix) : columns - max(0, -ix)] - drop
        seen_next = seen.copy()
        np.maximum(to, source, out=seen_next[max(0, -iy) : rows - max(0, iy), max(0, -ix) : columns - max(0, ix)])
        seen = seen_next
        step *= 2
    seen -= surface
    seen -= 0.05
    seen *= 4.0  # the penumbra: a quarter of a metre
    np.clip(seen, 0.0, 1.0, out=seen)
    return np.asarray(cv2.blur(seen, (3, 3)), dtype=np.float32)


def base_height(spec: WorldSpec, terrain: Float32Array, house: Building) -> float:
    """Height in m of the ground floor: the terrain under the middle of the house."""
    u, v = spec.grid.px_from_map([house.x_m, house.y_m])
    return float(terrain[round(float(v)), round(float(u))])


def build_scene(world: World, epoch: Epoch) -> Scene:
    """Surface and texture of the world at ``epoch``."""
    stand = standing(world.layout, epoch)
    builder = _Builder(world, epoch)
    builder.crops()
    for i, house in enumerate(stand.buildings):
        builder.building(i, house)
    for i, car in enumerate(stand.cars):
        builder.car(i, car)
    for i, tree in enumerate(stand.trees):
        builder.tree(i, tree)
    return Scene(
        world.spec, epoch, builder.texture(), builder.surface, world.terrain, builder.objects,
        stand.buildings, stand.trees, stand.cars,
    )  # fmt: skip
