"""A rectangle of the generated country in detail: `country`'s net, fields, houses and trees as a `world`.

The country is drawn for areas of any size; a `world` has relief, façades, parked cars and shadows cast by what stands
there, at pixels finer than any map's. Here the vectors of one become those of the other. Local metres count from the
rectangle's south-west corner, as in `layout`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from ortholoc_edge.geometry.arrays import BoolArray, Float32Array, FloatArray
from ortholoc_sim.country import CENTRE, EDGE_WIDTH_M, FOREST, HIGHWAY, TRACK, VILLAGE, Country, Plot
from ortholoc_sim.layout import (
    FLAT_COLOURS,
    ROOF_COLOURS,
    WALL_COLOURS,
    Box,
    Building,
    CarSlot,
    Crop,
    Layout,
    Parcel,
    Road,
    Roof,
    Tree,
    distance_to,
    normals,
    resampled,
)
from ortholoc_sim.world import FIRST_CAR, FIRST_TREE, MAX_PARCELS, World, WorldSpec, generate

_CROPS = (Crop.MEADOW, Crop.WHEAT, Crop.MAIZE, Crop.BEET, Crop.RAPESEED, Crop.ORCHARD)
_CROP_SHARES = (0.22, 0.24, 0.18, 0.12, 0.16, 0.08)
_ROW_SPACING_M = {
    Crop.MEADOW: 5.5, Crop.WHEAT: 2.2, Crop.MAIZE: 1.5, Crop.BEET: 1.1, Crop.RAPESEED: 2.6, Crop.ORCHARD: 6.0,
}  # fmt: skip
_ORCHARD_SPACING_M = 7.0
# Smaller and lower is a shed: no yard, no cars.
_HOUSE_LENGTH_M = 7.0
_FRONT_M = 48.0
_INSIDE_M = 12.0
# Of a seed; of each form of land.
_COUNTRIES = 32
_MIN_SHARE, _MAX_SHARE = 0.08, 0.33
_HEDGED = 0.4
# Between the crowns of a forest one looks on branches, not on its ground.
_CANOPY_M, _CANOPY_DARK = 8.0, 52
_LOWEST_CROWN_M = 2.5
_SHORE_M = 7.0
_TERRAIN_STEP = 16
_CLEARANCE_PX_M = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class Place:
    """A rectangle of the country.

    Attributes:
        world: what persists; its layout holds everything that stands there at any time.
        west_m, south_m: its corner in `country.FRAME`.
        building_fate, tree_fate: a number 0..1 for each building and tree of the layout, in its order, that decides
            which times see it.
    """

    world: World
    west_m: float
    south_m: float
    building_fate: FloatArray
    tree_fate: FloatArray


def make_place(seed: int, width_m: float = 1200.0, height_m: float = 1000.0, gsd_m: float = 0.125) -> Place:
    """A country around `country.CENTRE`: village, lake, forest and fields, two highways that cross.

    Raises: ValueError if the rectangle holds more than the world's ids can tell apart.
    """
    spec = WorldSpec(seed, width_m, height_m, gsd_m)
    low = np.array(CENTRE) - np.round([width_m / 2, height_m / 2])
    country = _mixed_country(seed, low, low + np.array([width_m, height_m]))
    layout, tree_fate, woods = _layout(country, low, spec)
    canopy, dark = _canopy(woods, spec)
    world = generate(spec, layout, _terrain(country, low, spec) + canopy)
    world.detail[:] = cv2.subtract(world.detail, dark)
    fate = np.random.default_rng([seed, 91]).random(len(layout.buildings))
    return Place(world, float(low[0]), float(low[1]), fate, tree_fate)


def rotated_crops(layout: Layout, seed: int) -> Layout:
    """The same fields with what grows on them in another year: meadows and orchards stay, the rest changes by lot."""
    rng = np.random.default_rng([seed, 92])
    parcels = []
    for parcel in layout.parcels:
        crop = parcel.crop
        drawn = _CROPS[int(rng.integers(1, 5))]
        if crop not in (Crop.MEADOW, Crop.ORCHARD):
            crop = drawn
        parcels.append(Parcel(parcel.outline, crop, parcel.row_angle_rad, _ROW_SPACING_M[crop]))
    return Layout(
        layout.roads, tuple(parcels), layout.buildings, layout.spare_buildings, layout.yards, layout.trees,
        layout.car_slots, layout.pond, layout.crossing,
    )  # fmt: skip


def _mixed_country(seed: int, low: FloatArray, high: FloatArray) -> Country:
    """One of the countries of ``seed`` that is neither all village nor all fields in a box."""
    for k in range(_COUNTRIES):
        country = Country(_COUNTRIES * seed + k)
        uses = [plot.use for plot in country.plots(low, high)]
        village, forest = (uses.count(use) / len(uses) for use in (VILLAGE, FOREST))
        if _MIN_SHARE < village < _MAX_SHARE and _MIN_SHARE < forest < _MAX_SHARE:
            return country
    return Country(_COUNTRIES * seed)


def _terrain(country: Country, low: FloatArray, spec: WorldSpec) -> Float32Array:
    # Smooth by nature: computed every two metres, at the centres of the large pixels that cv2 resizes from.
    rows, columns = (n // _TERRAIN_STEP for n in spec.shape)
    cell = (spec.height_m / rows, spec.width_m / columns)
    x, y = (np.arange(columns) + 0.5) * cell[1], spec.height_m - (np.arange(rows) + 0.5) * cell[0]
    east, north = np.meshgrid(low[0] + x, low[1] + y)
    coarse = country.ground(np.stack([east.ravel(), north.ravel()], axis=1)).reshape(rows, columns)
    full = cv2.resize(coarse.astype(np.float32), spec.shape[::-1], interpolation=cv2.INTER_CUBIC)
    return np.asarray(full, dtype=np.float32)


def _canopy(woods: list[FloatArray], spec: WorldSpec) -> tuple[Float32Array, npt.NDArray[np.uint8]]:
    """(H, W) height m of what one looks on between the crowns of a forest, and how much darker that is (0..255)."""
    size = (round(spec.height_m / _CLEARANCE_PX_M), round(spec.width_m / _CLEARANCE_PX_M))
    closed = np.zeros(size, dtype=np.uint8)
    for x, y in np.concatenate([*woods, np.empty((0, 2))]):
        spot = (round(x / _CLEARANCE_PX_M), round((spec.height_m - y) / _CLEARANCE_PX_M))
        cv2.circle(closed, spot, round(3.4 / _CLEARANCE_PX_M), 255, -1)
    # The edge crowns stand before it.
    closed = np.asarray(cv2.erode(closed, np.ones((7, 7), np.uint8)), dtype=np.uint8)
    full = cv2.resize(cv2.GaussianBlur(closed, (0, 0), 1.5), spec.shape[::-1], interpolation=cv2.INTER_LINEAR)
    height = full.astype(np.float32) * np.float32(_CANOPY_M / 255.0)
    return height, (height * np.float32(_CANOPY_DARK / _CANOPY_M)).astype(np.uint8)


def _layout(country: Country, low: FloatArray, spec: WorldSpec) -> tuple[Layout, FloatArray, list[FloatArray]]:
    """What stands in the rectangle, the fate of each tree, and where the trees of each forest are."""
    rng = np.random.default_rng([country.seed, 90])
    size = np.array([spec.width_m, spec.height_m])
    plots = list(country.plots(low, low + size))
    streets = [street - low for plot in plots for street in plot.streets]
    roads = _roads(country.edges(low, low + size), streets, low)
    pond = min(country.lakes(low, low + size), key=lambda lake: float(np.linalg.norm(lake.centre - CENTRE)))
    shore = pond.outline - low
    parcels: list[Parcel] = []
    gardens: list[Parcel] = []
    buildings: list[Building] = []
    for plot in plots:
        if plot.use == FOREST:
            parcels.append(Parcel(plot.outline - low, Crop.MEADOW, 0.0, _ROW_SPACING_M[Crop.MEADOW]))
        for sown in plot.fields:
            crop = Crop.MEADOW if sown.garden else Crop(int(rng.choice(_CROPS, p=_CROP_SHARES)))
            parcel = Parcel(sown.outline - low, crop, sown.row_angle_rad, _ROW_SPACING_M[crop])
            if (parcel.outline.max(axis=0) > 0).all() and (parcel.outline.min(axis=0) < size).all():
                (gardens if sown.garden else parcels).append(parcel)
        for house in plot.houses:
            where = house.centre - low
            if (where > _INSIDE_M).all() and (where < size - _INSIDE_M).all() and not _wet(where[None], shore, 12.0)[0]:
                buildings.append(_building(house.length_m, house.width_m, house.eave_m, house.rise_m, where,
                                           float(np.arctan2(*house.axis[::-1])), plot.use == VILLAGE, rng))  # fmt: skip
    buildings = _apart(buildings)
    room = MAX_PARCELS - len(parcels)
    parcels += [gardens[i] for i in sorted(rng.permutation(len(gardens))[:room])]
    yards, slots = _yards(buildings, [road for road in roads if road.paved], rng)
    woods = [plot.trees.xy - low for plot in plots if plot.use == FOREST]
    trees, fate = _trees(
        [_planted(plot, low) for plot in plots], parcels, gardens, _clearance(spec, roads, buildings), shore, spec, rng,
    )  # fmt: skip
    main, cross = roads[-1].line, roads[-2].line
    crossing = main[int(np.argmin(distance_to(main, cross)))]
    return Layout(tuple(roads), tuple(parcels), tuple(buildings), (), tuple(yards), tuple(trees), tuple(slots), shore,
                  crossing), fate, woods  # fmt: skip


def _roads(edges: Sequence[tuple[int, FloatArray]], streets: list[FloatArray], low: FloatArray) -> list[Road]:
    """Tracks, then streets and roads, then the highways, of which the two that cross at `CENTRE` come last."""
    tracks = [Road(resampled(line - low, 2.0), EDGE_WIDTH_M[k], False, False) for k, line in edges if k == TRACK]
    paved = [Road(resampled(line - low, 2.0), EDGE_WIDTH_M[k], False, True)
             for k, line in edges if TRACK < k < HIGHWAY]  # fmt: skip
    paved += [Road(resampled(street, 2.0), 5.0, False, True) for street in streets]
    highways: list[Road] = []
    for axis in (0, 1):
        pieces = [line - low for k, line in edges if k == HIGHWAY and _runs(line) == axis]
        # Other highways of the same direction are six cells away.
        rows = {round(float(np.mean(p[:, 1 - axis])) / (6 * 260.0)) for p in pieces}
        for row in sorted(rows, key=lambda r: abs(r * 6 * 260.0 - (np.array(CENTRE) - low)[1 - axis]), reverse=True):
            mine = sorted(
                (p for p in pieces if round(float(np.mean(p[:, 1 - axis])) / (6 * 260.0)) == row),
                key=lambda p: float(p[0, axis]),
            )
            highways.append(Road(_eased(np.concatenate(mine)), EDGE_WIDTH_M[HIGHWAY], True, True))
    return [*tracks, *paved, *highways]


def _runs(line: FloatArray) -> int:
    """0: east, 1: north."""
    return int(abs(line[-1, 1] - line[0, 1]) > abs(line[-1, 0] - line[0, 0]))


def _eased(line: FloatArray) -> FloatArray:
    """A road without the kinks where the net's edges meet: averaged over some 25 m."""
    kept = np.concatenate([[True], np.linalg.norm(np.diff(line, axis=0), axis=1) > 0.01])
    even = resampled(line[kept], 2.0)
    weights = np.exp(-0.5 * (np.arange(-15, 16) / 6.0) ** 2)
    padded = np.pad(even, ((15, 15), (0, 0)), mode="reflect", reflect_type="odd")
    smooth = [np.convolve(padded[:, k], weights / weights.sum(), mode="valid") for k in (0, 1)]
    return np.stack(smooth, axis=1)


def _building(
    length: float, width: float, eave: float, rise: float, where: FloatArray, angle: float, village: bool,
    rng: np.random.Generator,
) -> Building:  # fmt: skip
    shed, hall = length < _HOUSE_LENGTH_M, not village
    flat = rise < 0.5 or (not hall and rng.random() < 0.18)
    roof = Roof.FLAT if flat else Roof.GABLED
    if flat and not shed:
        eave, rise = eave + 2.5, 0.0
    colours = FLAT_COLOURS if flat or hall else ROOF_COLOURS
    boxes = []
    for _ in range(0 if shed else int(rng.integers(2, 7)) if flat or hall else int(rng.integers(1, 3))):
        size = rng.uniform(0.9, 2.4, 2) if flat or hall else rng.uniform(0.6, 0.9, 2)
        boxes.append(Box(rng.uniform(-0.38, 0.38) * length, rng.uniform(-0.32, 0.32) * width * (1.0 if flat else 0.6),
                         float(size[0]), float(size[1]), rng.uniform(0.6, 1.4)))  # fmt: skip
    return Building(
        float(where[0]), float(where[1]), angle, length, width, eave, rise, roof,
        colours[int(rng.integers(len(colours)))], WALL_COLOURS[int(rng.integers(len(WALL_COLOURS)))], tuple(boxes),
        bool(not flat and not shed and rng.random() < 0.22),
    )  # fmt: skip


def _apart(buildings: list[Building]) -> list[Building]:
    """Without those that stand in another."""
    kept: list[Building] = []
    for one in buildings:
        near = (b for b in kept if np.hypot(one.x_m - b.x_m, one.y_m - b.y_m) < 0.5 * (one.length_m + b.length_m) + 1.0)
        if not any(near):
            kept.append(one)
    return kept


def _yards(
    buildings: list[Building], paved: list[Road], rng: np.random.Generator
) -> tuple[list[FloatArray], list[CarSlot]]:
    """Drives from the street to the houses, aprons around halls, and where cars stand there and on the streets."""
    yards: list[FloatArray] = []
    slots: list[CarSlot] = []
    points = np.concatenate([road.line for road in paved])
    left = np.concatenate([normals(road.line) for road in paved])
    half = np.concatenate([np.full(len(road.line), road.width_m / 2) for road in paved])
    for house in buildings:
        if house.length_m < _HOUSE_LENGTH_M:
            continue
        centre = np.array([house.x_m, house.y_m])
        if house.length_m > 20.0:
            yards.append(centre + (house.corners - centre) * (1.0 + 16.0 / np.array([house.length_m])))
            c, s = np.cos(house.angle_rad), np.sin(house.angle_rad)
            for k in range(int(house.length_m / 3.2)):
                along = -house.length_m / 2 + 1.6 + 3.2 * k
                spot = centre + along * np.array([c, s]) + (house.width_m / 2 + 3.4) * np.array([-s, c])
                slots.append(CarSlot(float(spot[0]), float(spot[1]), house.angle_rad + np.pi / 2))
            continue
        away = np.linalg.norm(points - centre, axis=1)
        nearest = int(np.argmin(away))
        if away[nearest] > _FRONT_M:
            continue
        ahead = (centre - points[nearest]) / away[nearest]
        across = np.array([-ahead[1], ahead[0]])
        front = points[nearest] + ahead * half[nearest]
        back = centre + ahead * 0.3 * house.length_m
        spread = float(rng.uniform(0.3, 0.55)) * house.length_m
        yards.append(np.array([front - 2.2 * across, front + 2.2 * across, back + spread * across,
                               back - spread * across]))  # fmt: skip
        for side in (-1.3, 1.3):
            spot = front + ahead * 3.2 + side * across
            slots.append(CarSlot(float(spot[0]), float(spot[1]), float(np.arctan2(ahead[1], ahead[0]))))
        if rng.random() < 0.6:
            spot = points[nearest] + left[nearest] * (half[nearest] - 1.1)
            slots.append(
                CarSlot(float(spot[0]), float(spot[1]), float(np.arctan2(-left[nearest, 0], left[nearest, 1])))
            )
    for road in paved:
        if road.marked:  # what drives there at the moment
            aside = normals(road.line)
            for i in range(10, len(road.line) - 10, 18):
                side = 1.9 if rng.random() < 0.5 else -1.9
                spot = road.line[i + int(rng.integers(-8, 9))] + side * aside[i]
                slots.append(CarSlot(float(spot[0]), float(spot[1]), float(np.arctan2(-aside[i, 0], aside[i, 1]))))
    return yards, slots


def _clearance(spec: WorldSpec, roads: list[Road], buildings: list[Building]) -> Float32Array:
    """(h, w) m to the nearest road or wall, at pixels of half a metre, row 0 in the north."""
    size = (round(spec.height_m / _CLEARANCE_PX_M), round(spec.width_m / _CLEARANCE_PX_M))
    free = np.full(size, 255, dtype=np.uint8)

    def px(points: FloatArray) -> FloatArray:
        return np.round(np.stack([points[:, 0], spec.height_m - points[:, 1]], axis=1) / _CLEARANCE_PX_M).astype(
            np.int32
        )

    for road in roads:
        cv2.polylines(free, [px(road.line)], False, 0, max(1, round(road.width_m / _CLEARANCE_PX_M)))
    for house in buildings:
        cv2.fillPoly(free, [px(house.corners)], 0)
    away = cv2.distanceTransform(free, cv2.DIST_L2, 3)
    return np.asarray(away * np.float32(_CLEARANCE_PX_M), dtype=np.float32)


def _planted(plot: Plot, low: FloatArray) -> tuple[FloatArray, ...]:
    """Of a plot's trees: position (N, 2), radius, height above the ground or a forest's canopy, whether conifers, and
    fate, (N,) each."""
    trees = plot.trees
    conifer = (trees.kind == 1).astype(np.float64)
    if plot.use != FOREST:
        return trees.xy - low, trees.radius_m, trees.height_m, conifer, trees.chance
    # In a closed canopy crowns meet.
    height = np.maximum(trees.height_m - _CANOPY_M, _LOWEST_CROWN_M)
    return trees.xy - low, trees.radius_m * (1.2 + 0.25 * conifer), height, conifer, trees.chance


def _trees(
    planted: list[tuple[FloatArray, ...]],
    parcels: list[Parcel],
    gardens: list[Parcel],
    clearance: Float32Array,
    shore: FloatArray,
    spec: WorldSpec,
    rng: np.random.Generator,
) -> tuple[list[Tree], FloatArray]:
    xy, radius, height, kind, fate = (np.concatenate(column) for column in zip(*planted, strict=True))
    # The country plants its forests in cells, which a finer picture would show as rows.
    xy = xy + rng.normal(0.0, 0.9, xy.shape)
    fruit, bushes = (np.concatenate([*rows, np.empty((0, 2))]) for rows in (_orchards(parcels), _hedges(gardens, rng)))
    size = np.concatenate([rng.uniform(1.3, 2.1, len(fruit)), rng.uniform(0.7, 1.1, len(bushes))])
    xy = np.concatenate([xy, fruit, bushes])
    radius = np.concatenate([radius, size])
    height = np.concatenate([height, 2.0 + 1.4 * size[: len(fruit)], rng.uniform(1.2, 2.4, len(bushes))])
    kind = np.concatenate([kind, np.zeros(len(fruit)), rng.random(len(bushes)) < 0.3])
    fate = np.concatenate([fate, rng.random(len(fruit)), np.full(len(bushes), 0.5)])
    inside = ((xy > 3.0) & (xy < np.array([spec.width_m, spec.height_m]) - 3.0)).all(axis=1)
    at = np.flatnonzero(inside)
    column = (xy[at, 0] / _CLEARANCE_PX_M).astype(int)
    row = ((spec.height_m - xy[at, 1]) / _CLEARANCE_PX_M).astype(int)
    at = at[clearance[row, column] > 0.75 * radius[at]]
    at = at[~_wet(xy[at], shore, _SHORE_M)]
    if len(at) > FIRST_CAR - FIRST_TREE:
        raise ValueError(f"{len(at)} trees, at most {FIRST_CAR - FIRST_TREE}: make the place smaller")
    lobes, tint = rng.uniform(0, 2 * np.pi, len(xy)), rng.uniform(-1, 1, len(xy))
    return [
        Tree(float(xy[k, 0]), float(xy[k, 1]), float(radius[k]), float(height[k]), bool(kind[k]), float(lobes[k]),
             float(tint[k]))
        for k in at
    ], fate[at]  # fmt: skip


def _orchards(parcels: list[Parcel]) -> Iterator[FloatArray]:
    """(N, 2) fruit trees in rows, for each orchard."""
    for parcel in parcels:
        if parcel.crop is not Crop.ORCHARD:
            continue
        c, s = np.cos(parcel.row_angle_rad), np.sin(parcel.row_angle_rad)
        turn = np.array([[c, s], [-s, c]])
        centre = parcel.outline.mean(axis=0)
        reach = (parcel.outline - centre) @ turn.T
        axes = [np.arange(reach[:, k].min() + 4.0, reach[:, k].max() - 3.0, _ORCHARD_SPACING_M) for k in (0, 1)]
        along, across = np.meshgrid(*axes)
        spots = np.stack([along.ravel(), across.ravel()], axis=1) @ turn + centre
        yield spots[_within(spots, parcel.outline, 3.0)]


def _hedges(gardens: list[Parcel], rng: np.random.Generator) -> Iterator[FloatArray]:
    """(N, 2) bushes along some of the gardens' borders."""
    for garden in gardens:
        # Five points a side (`country`): which side, or two that meet.
        first, sides = int(rng.integers(4)), int(rng.integers(1, 3))
        if rng.random() < _HEDGED:
            border = np.roll(garden.outline, -5 * first, axis=0)[: 5 * sides + 1]
            row = resampled(border, 1.5)
            yield row + rng.normal(0.0, 0.12, row.shape)


def _within(xy: FloatArray, outline: FloatArray, margin_m: float) -> BoolArray:
    """Whether points (N, 2) lie in a polygon, further than ``margin_m`` from its edge (outside, if negative)."""
    origin = outline.mean(axis=0)
    polygon = (outline - origin).astype(np.float32)
    return np.array(
        [cv2.pointPolygonTest(polygon, (float(x), float(y)), True) > margin_m for x, y in xy - origin], dtype=bool
    )


def _wet(xy: FloatArray, shore: FloatArray, margin_m: float) -> BoolArray:
    """Whether points (N, 2) lie in the lake or nearer to it than ``margin_m``."""
    reach = float(np.linalg.norm(shore - shore.mean(axis=0), axis=1).max()) + margin_m
    near = np.linalg.norm(xy - shore.mean(axis=0), axis=1) < reach
    wet = np.zeros(len(xy), dtype=bool)
    wet[near] = _within(xy[near], shore, -margin_m)
    return wet
