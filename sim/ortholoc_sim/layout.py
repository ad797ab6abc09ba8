"""Where things stand in a generated world: roads, parcels, buildings, trees, cars. Vectors only, no rasters.

Coordinates are local metres, x to grid east and y to grid north from the south-west corner of the world.
Everything follows from the seed; what differs between two epochs is decided in `epoch.py`.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from ortholoc_edge.geometry.arrays import FloatArray


class Crop(IntEnum):
    """What grows on a parcel. The colour of each depends on the epoch."""

    MEADOW = 0
    WHEAT = 1
    MAIZE = 2
    BEET = 3
    RAPESEED = 4
    ORCHARD = 5


class Roof(IntEnum):
    """Shape of a roof."""

    FLAT = 0
    GABLED = 1


@dataclass(frozen=True, slots=True, eq=False)
class Road:
    """A strip along a polyline.

    Attributes:
        line: (N, 2) m, about one vertex per 2 m.
        width_m: of the paved part.
        marked: has a dashed centre line and edge lines.
        paved: asphalt; a gravel track with two ruts otherwise.
    """

    line: FloatArray
    width_m: float
    marked: bool
    paved: bool


@dataclass(frozen=True, slots=True, eq=False)
class Parcel:
    """A field.

    Attributes:
        outline: (N, 2) m.
        row_angle_rad: direction of the rows from east, counter-clockwise.
        row_spacing_m: between rows of plants.
    """

    outline: FloatArray
    crop: Crop
    row_angle_rad: float
    row_spacing_m: float


@dataclass(frozen=True, slots=True)
class Box:
    """A cuboid on a roof (chimney, vent, lift housing): offsets along and across the ridge, sizes, height above
    the roof, all in m."""

    along_m: float
    across_m: float
    length_m: float
    width_m: float
    height_m: float


@dataclass(frozen=True, slots=True)
class Building:
    """A rectangular house.

    Attributes:
        x_m, y_m: centre.
        angle_rad: of the ridge from east, counter-clockwise.
        length_m, width_m: along and across the ridge.
        eave_m: height of the walls.
        rise_m: ridge above eave; 0 for a flat roof.
        colour: RGB of the roof, sRGB 0..255.
        wall: RGB of the façade.
        boxes: chimneys and vents.
        panel: whether a solar field lies on the side of the roof with positive ``across``.
    """

    x_m: float
    y_m: float
    angle_rad: float
    length_m: float
    width_m: float
    eave_m: float
    rise_m: float
    roof: Roof
    colour: tuple[int, int, int]
    wall: tuple[int, int, int]
    boxes: tuple[Box, ...]
    panel: bool

    @property
    def corners(self) -> FloatArray:
        """(4, 2) m, counter-clockwise from (-length, -width)."""
        half = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * (self.length_m / 2, self.width_m / 2)
        c, s = np.cos(self.angle_rad), np.sin(self.angle_rad)
        return np.asarray(half @ np.array([[c, s], [-s, c]]) + (self.x_m, self.y_m), dtype=np.float64)


@dataclass(frozen=True, slots=True)
class Tree:
    """A crown. ``conifer`` keeps its colour all year. ``lobes`` (phase, rad) makes outlines differ."""

    x_m: float
    y_m: float
    radius_m: float
    height_m: float
    conifer: bool
    lobes: float
    tint: float


@dataclass(frozen=True, slots=True)
class CarSlot:
    """A place where a car may be parked."""

    x_m: float
    y_m: float
    angle_rad: float


@dataclass(frozen=True, slots=True, eq=False)
class Layout:
    """All vectors of a world; ``spare_buildings`` are plots that may be built on later."""

    roads: tuple[Road, ...]
    parcels: tuple[Parcel, ...]
    buildings: tuple[Building, ...]
    spare_buildings: tuple[Building, ...]
    yards: tuple[FloatArray, ...]
    trees: tuple[Tree, ...]
    car_slots: tuple[CarSlot, ...]
    pond: FloatArray
    crossing: FloatArray


ROOF_COLOURS = (
    (150, 78, 58),
    (166, 92, 66),
    (128, 62, 48),
    (112, 74, 64),
    (92, 92, 98),
    (74, 76, 84),
    (138, 104, 84),
)
FLAT_COLOURS = ((168, 166, 160), (140, 142, 144), (186, 182, 172), (112, 116, 118), (150, 140, 124))
WALL_COLOURS = ((214, 206, 190), (196, 178, 150), (224, 220, 212), (178, 160, 140), (168, 120, 96))


def _spline(points: list[tuple[float, float]], step_m: float = 2.0) -> FloatArray:
    """Catmull-Rom curve through ``points``, resampled to about ``step_m``."""
    p = np.asarray(points, dtype=np.float64)
    p = np.vstack([2 * p[0] - p[1], p, 2 * p[-1] - p[-2]])
    t = np.linspace(0.0, 1.0, 40, endpoint=False)[:, None]
    pieces = [
        0.5 * (2 * b + (c - a) * t + (2 * a - 5 * b + 4 * c - d) * t**2 + (3 * b - a - 3 * c + d) * t**3)
        for a, b, c, d in zip(p[:-3], p[1:-2], p[2:-1], p[3:], strict=True)
    ]
    return resampled(np.vstack([*pieces, p[-2:-1]]), step_m)


def resampled(line: FloatArray, step_m: float) -> FloatArray:
    """The polyline with vertices every ``step_m`` of its length."""
    along = arc_length(line)
    at = np.linspace(0.0, along[-1], max(2, round(float(along[-1]) / step_m) + 1))
    return np.stack([np.interp(at, along, line[:, 0]), np.interp(at, along, line[:, 1])], axis=1)


def arc_length(line: FloatArray) -> FloatArray:
    """(N,) distance in m of every vertex from the first along the polyline."""
    steps = np.linalg.norm(np.diff(line, axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)])


def normals(line: FloatArray) -> FloatArray:
    """(N, 2) unit vectors to the left of the polyline."""
    tangent = np.gradient(line, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    return np.stack([-tangent[:, 1], tangent[:, 0]], axis=1)


def _roads(width: float, height: float, rng: np.random.Generator) -> tuple[Road, ...]:
    def at(fx: float, fy: float, jitter: float = 0.02) -> tuple[float, float]:
        dx, dy = rng.uniform(-jitter, jitter, 2)
        return (fx + dx) * width, (fy + dy) * height

    crossing = at(0.47, 0.52)
    main = _spline([(-40.0, 0.46 * height), at(0.22, 0.43), crossing, at(0.74, 0.60), (width + 40, 0.55 * height)])
    cross = _spline([(0.52 * width, -40.0), at(0.50, 0.24), crossing, at(0.42, 0.76), (0.45 * width, height + 40)])
    # Streets start on vertices of the through roads, so that junctions meet.
    north_east = _spline(
        [tuple(cross[int(0.72 * len(cross))]), at(0.60, 0.80), at(0.76, 0.78), tuple(main[int(0.84 * len(main))])]
    )
    south_west = _spline(
        [tuple(main[int(0.16 * len(main))]), at(0.22, 0.24), at(0.36, 0.20), tuple(cross[int(0.26 * len(cross))])]
    )
    south_east = _spline(
        [tuple(cross[int(0.20 * len(cross))]), at(0.66, 0.22), at(0.80, 0.30), tuple(main[int(0.80 * len(main))])]
    )
    tracks = (
        _spline([tuple(main[int(0.10 * len(main))]), at(0.14, 0.66), at(0.22, 0.84), (0.20 * width, height + 30)]),
        _spline([tuple(south_east[len(south_east) // 2]), at(0.86, 0.14), (0.90 * width, -30.0)]),
        _spline([tuple(north_east[len(north_east) // 2]), at(0.78, 0.92), (0.84 * width, height + 30)]),
        _spline([(-30.0, 0.80 * height), at(0.12, 0.76), at(0.30, 0.72), tuple(cross[int(0.66 * len(cross))])]),
    )
    return (
        *(Road(line, 2.6, False, False) for line in tracks),
        Road(north_east, 5.0, False, True),
        Road(south_west, 5.0, False, True),
        Road(south_east, 5.5, False, True),
        Road(cross, 6.5, True, True),
        Road(main, 7.5, True, True),
    )


def _split(polygon: FloatArray, rng: np.random.Generator, out: list[FloatArray], largest_m2: float) -> None:
    """Cut a convex polygon across its longer side until the pieces are of a field's size."""
    x, y = polygon[:, 0], polygon[:, 1]
    area = 0.5 * abs(float(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1))))
    if area < largest_m2 * rng.uniform(0.7, 1.5):
        out.append(polygon)
        return
    centre = polygon.mean(axis=0)
    _, _, axes = np.linalg.svd(polygon - centre)
    tilt = rng.uniform(-0.12, 0.12)
    c, s = np.cos(tilt), np.sin(tilt)
    normal = np.array([[c, -s], [s, c]]) @ axes[0]
    side = (polygon - centre) @ normal - rng.uniform(-0.12, 0.12) * np.sqrt(area)
    for keep in (side, -side):
        piece: list[FloatArray] = []
        for i in range(len(polygon)):
            j = (i + 1) % len(polygon)
            if keep[i] >= 0:
                piece.append(polygon[i])
            if keep[i] * keep[j] < 0:
                piece.append(polygon[i] + keep[i] / (keep[i] - keep[j]) * (polygon[j] - polygon[i]))
        if len(piece) >= 3:
            _split(np.array(piece), rng, out, largest_m2)


def _parcels(width: float, height: float, rng: np.random.Generator) -> tuple[Parcel, ...]:
    turn = np.deg2rad(14.0)
    c, s = np.cos(turn), np.sin(turn)
    big = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * (0.75 * width, 0.8 * height)
    pieces: list[FloatArray] = []
    _split(big @ np.array([[c, s], [-s, c]]) + (width / 2, height / 2), rng, pieces, 7000.0)
    spacing = {
        Crop.MEADOW: 5.5,
        Crop.WHEAT: 2.2,
        Crop.MAIZE: 1.5,
        Crop.BEET: 1.1,
        Crop.RAPESEED: 2.6,
        Crop.ORCHARD: 6.0,
    }
    parcels = []
    for outline in pieces:
        crop = Crop(int(rng.choice(6, p=[0.26, 0.22, 0.18, 0.12, 0.14, 0.08])))
        edges = np.roll(outline, -1, axis=0) - outline
        longest = edges[int(np.argmax(np.linalg.norm(edges, axis=1)))]
        parcels.append(Parcel(outline, crop, float(np.arctan2(longest[1], longest[0])), spacing[crop]))
    return tuple(parcels)


def _boxes(roof: Roof, length: float, width: float, rng: np.random.Generator) -> tuple[Box, ...]:
    boxes = []
    for _ in range(int(rng.integers(1, 3)) if roof is Roof.GABLED else int(rng.integers(2, 6))):
        along = rng.uniform(-0.38, 0.38) * length
        across = rng.uniform(-0.2, 0.2) * width if roof is Roof.GABLED else rng.uniform(-0.36, 0.36) * width
        size = rng.uniform(0.6, 0.9, 2) if roof is Roof.GABLED else rng.uniform(0.9, 2.6, 2)
        boxes.append(Box(float(along), float(across), float(size[0]), float(size[1]), float(rng.uniform(0.7, 1.6))))
    return tuple(boxes)


def _building(x: float, y: float, angle: float, rng: np.random.Generator) -> Building:
    flat = rng.random() < 0.32
    big = rng.random() < 0.25
    length = float(rng.uniform(16, 28) if big else rng.uniform(9, 14))
    width = float(rng.uniform(11, 16) if big else rng.uniform(7, 10))
    roof = Roof.FLAT if flat else Roof.GABLED
    rise = (
        0.0 if flat else float(width / 2 * np.tan(np.deg2rad(rng.uniform(18, 42) if not big else rng.uniform(12, 22))))
    )
    eave = float(rng.choice([3.0, 4.2, 5.8, 6.4, 8.6])) if not flat else float(rng.choice([3.2, 4.5, 6.5, 9.5, 13.0]))
    colours = FLAT_COLOURS if flat else ROOF_COLOURS
    return Building(
        x, y, angle, length, width, eave, rise, roof,
        colours[int(rng.integers(len(colours)))],
        WALL_COLOURS[int(rng.integers(len(WALL_COLOURS)))],
        _boxes(roof, length, width, rng),
        bool(not flat and rng.random() < 0.25),
    )  # fmt: skip


def distance_to(points: FloatArray, line: FloatArray) -> FloatArray:
    """(N,) distance in m of points (N, 2) from the nearest vertex of a polyline."""
    return np.asarray(np.linalg.norm(points[:, None] - line[None], axis=2).min(axis=1), dtype=np.float64)


def _settlement(
    roads: tuple[Road, ...], width: float, height: float, pond: FloatArray, rng: np.random.Generator
) -> tuple[list[Building], list[FloatArray], list[CarSlot]]:
    """Houses along the paved roads, their yards and the places where cars stand."""
    houses: list[Building] = []
    yards: list[FloatArray] = []
    slots: list[CarSlot] = []
    paved = [road for road in roads if road.paved]
    for road in paved:
        line, left = road.line, normals(road.line)
        along = arc_length(line)
        for side in (-1.0, 1.0):
            at = float(rng.uniform(5, 20))
            while at < along[-1] - 10:
                i = int(np.searchsorted(along, at))
                at += float(rng.uniform(17, 30))
                inside = 0.05 * width < line[i, 0] < 0.95 * width and 0.05 * height < line[i, 1] < 0.95 * height
                if not inside or rng.random() < 0.30:
                    continue
                angle = float(np.arctan2(-left[i, 0], left[i, 1])) + float(rng.normal(0.0, 0.04))
                house = _building(0.0, 0.0, angle + (np.pi / 2 if rng.random() < 0.3 else 0.0), rng)
                reach = float(np.hypot(house.length_m, house.width_m)) / 2
                depth = road.width_m / 2 + reach + float(rng.uniform(2, 9))
                x, y = line[i] + side * depth * left[i]
                here = np.array([[x, y]])
                if any(distance_to(here, r.line)[0] < r.width_m / 2 + reach + 1.0 for r in roads):
                    continue
                if any(np.hypot(x - b.x_m, y - b.y_m) < reach + 0.55 * b.length_m + 2.0 for b in houses):
                    continue
                if distance_to(here, pond)[0] < reach + 8 or not (12 < x < width - 12 and 12 < y < height - 12):
                    continue
                houses.append(
                    Building(
                        float(x),
                        float(y),
                        house.angle_rad,
                        house.length_m,
                        house.width_m,
                        house.eave_m,
                        house.rise_m,
                        house.roof,
                        house.colour,
                        house.wall,
                        house.boxes,
                        house.panel,
                    )
                )
                # The yard reaches from the road to the house and a little behind it.
                t = np.array([left[i, 1], -left[i, 0]])
                half = reach * 0.9 + 1.5
                front, back = side * left[i] * (road.width_m / 2), side * left[i] * (depth + reach * 0.7)
                yards.append(
                    np.array(
                        [
                            line[i] + front - t * 2.2,
                            line[i] + front + t * 2.2,
                            line[i] + back + t * half * 0.6,
                            line[i] + back - t * half,
                        ]
                    )
                )
                for offset in (-1.4, 1.4):
                    spot = line[i] + side * left[i] * (road.width_m / 2 + 3.4) + t * offset
                    slots.append(CarSlot(float(spot[0]), float(spot[1]), float(np.arctan2(left[i, 1], left[i, 0]))))
        for i in range(6, len(line) - 6, 7):
            spot = line[i] + left[i] * (road.width_m / 2 - 1.1) * (1 if rng.random() < 0.5 else -1)
            slots.append(CarSlot(float(spot[0]), float(spot[1]), float(np.arctan2(-left[i, 0], left[i, 1]))))
    return houses, yards, slots


def _tree_spots(  # noqa: PLR0912 -- one branch per kind of place
    width: float,
    height: float,
    roads: tuple[Road, ...],
    parcels: tuple[Parcel, ...],
    houses: list[Building],
    rng: np.random.Generator,
) -> list[tuple[float, float, float]]:
    """(x, y, radius) in m where trees might stand: avenues, hedges, orchards, gardens, woods."""
    spots: list[tuple[float, float, float]] = []  # x, y, likely radius
    for road in roads:
        line, left = road.line, normals(road.line)
        for i in range(0, len(line), 6):
            if rng.random() < (0.32 if road.paved else 0.22):
                side = (1 if rng.random() < 0.5 else -1) * (road.width_m / 2 + rng.uniform(3.0, 4.5))
                spots.append((*(line[i] + left[i] * side), rng.uniform(1.6, 3.2)))
    for parcel in parcels:
        if rng.random() < 0.40:  # a hedge along one border
            a, b = parcel.outline[0], parcel.outline[1]
            for t in np.arange(0.0, 1.0, 4.0 / max(8.0, float(np.linalg.norm(b - a)))):
                if rng.random() < 0.8:
                    spots.append((*(a + t * (b - a) + rng.normal(0, 0.5, 2)), rng.uniform(1.2, 2.4)))
        if parcel.crop is Crop.ORCHARD:
            centre = parcel.outline.mean(axis=0)
            c, s = np.cos(parcel.row_angle_rad), np.sin(parcel.row_angle_rad)
            for u in np.arange(-24, 25, 6.0):
                for v in np.arange(-18, 19, 6.0):
                    spots.append((centre[0] + c * u - s * v, centre[1] + s * u + c * v, rng.uniform(1.2, 1.8)))
    for house in houses:
        for _ in range(int(rng.integers(0, 4))):
            a, r = rng.uniform(0, 2 * np.pi), rng.uniform(11, 17)
            spots.append((house.x_m + r * np.cos(a), house.y_m + r * np.sin(a), rng.uniform(1.4, 2.8)))
    for centre, count, spread in (((0.10, 0.12), 110, 26.0), ((0.90, 0.82), 90, 22.0), ((0.62, 0.40), 30, 11.0)):
        for x, y in rng.normal(0.0, spread, (count, 2)) + np.array(centre) * (width, height):
            spots.append((x, y, rng.uniform(2.2, 4.2)))
    return spots


def _trees(
    width: float,
    height: float,
    roads: tuple[Road, ...],
    parcels: tuple[Parcel, ...],
    houses: list[Building],
    pond: FloatArray,
    rng: np.random.Generator,
) -> tuple[Tree, ...]:
    """Trees on the spots where nothing is in their way."""
    spots = _tree_spots(width, height, roads, parcels, houses, rng)
    trees = []
    points = np.array([s[:2] for s in spots])
    clear = np.min([distance_to(points, road.line) - road.width_m / 2 for road in roads], axis=0)
    for (x, y, radius), room in zip(spots, clear, strict=True):
        conifer = bool(rng.random() < 0.3)
        lobes, tint, slender = rng.uniform(0, 2 * np.pi), rng.uniform(-1, 1), rng.uniform(1.7, 2.6)
        near_house = any(
            abs(x - b.x_m) < 25 and np.hypot(x - b.x_m, y - b.y_m) < radius + 0.5 * b.length_m for b in houses
        )
        in_pond = distance_to(np.array([[x, y]]), pond)[0] < radius + 1.0
        if room < 0.6 * radius + 0.6 or near_house or in_pond:
            continue
        if not (3 < x < width - 3 and 3 < y < height - 3):
            continue
        trees.append(
            Tree(
                float(x),
                float(y),
                float(radius),
                float(min(radius * slender + 2.0, 14.0)),
                conifer,
                float(lobes),
                float(tint),
            )
        )
    return tuple(trees)


def generate_layout(width_m: float, height_m: float, seed: int) -> Layout:
    """The vectors of a world of ``width_m`` (east) by ``height_m`` (north)."""
    rng = np.random.default_rng([seed, 1])
    roads = _roads(width_m, height_m, rng)
    parcels = _parcels(width_m, height_m, rng)
    a = np.linspace(0, 2 * np.pi, 90, endpoint=False)
    r = 1.0 + 0.18 * np.sin(2 * a + 0.4) + 0.10 * np.sin(3 * a + 1.9) + 0.05 * np.sin(5 * a)
    pond = np.stack([0.34 * width_m + 24 * r * np.cos(a), 0.335 * height_m + 15 * r * np.sin(a)], axis=1)
    houses, yards, slots = _settlement(roads, width_m, height_m, pond, rng)
    # Every twelfth plot is still empty when the map is flown.
    spare = [house for i, house in enumerate(houses) if i % 12 == 5]
    built = [house for i, house in enumerate(houses) if i % 12 != 5]
    trees = _trees(width_m, height_m, roads, parcels, houses, pond, rng)
    main, cross = roads[-1].line, roads[-2].line
    crossing = main[int(np.argmin(distance_to(main, cross)))]
    return Layout(roads, parcels, tuple(built), tuple(spare), tuple(yards), trees, tuple(slots), pond, crossing)
