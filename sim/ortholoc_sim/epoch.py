"""A date and an hour at which the world is looked at: light, season, and what was built, felled or parked since."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ortholoc_edge.geometry.arrays import FloatArray
from ortholoc_sim.layout import FLAT_COLOURS, ROOF_COLOURS, Building, CarSlot, Crop, Layout, Roof, Tree

Rgb = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class CropLook:
    """Colour (sRGB 0..255), contrast of the rows, height above ground in m."""

    colour: Rgb
    rows: float
    height_m: float


@dataclass(frozen=True, slots=True)
class Epoch:
    """How the world looks at one time.

    Attributes:
        name: for file names.
        seed: of everything that does not persist (grain, parked cars, changes).
        sun_azimuth_deg: from grid north, clockwise.
        sun_elevation_deg: above the horizon.
        ambient, direct: light in shade and light that the sun adds, per channel, as factors on sRGB values.
        gain: white balance, per channel.
        contrast: about mid grey.
        crops: by crop.
        grass, leaves, needles, water, soil: colours.
        changed: fraction of roofs repainted and of trees felled or grown; None at the time of the survey, to
            which changes are relative.
        tint: 1 sigma of how patches of plants differ in colour, as a share of it.
    """

    name: str
    seed: int
    sun_azimuth_deg: float
    sun_elevation_deg: float
    ambient: Rgb
    direct: Rgb
    gain: Rgb
    contrast: float
    crops: dict[Crop, CropLook]
    grass: Rgb
    leaves: Rgb
    leaves_spread: Rgb
    needles: Rgb
    water: Rgb
    soil: Rgb
    changed: float | None
    tint: float = 0.04

    @property
    def sun(self) -> FloatArray:
        """See `towards_sun`."""
        return towards_sun(self.sun_azimuth_deg, self.sun_elevation_deg)


def towards_sun(azimuth_deg: float, elevation_deg: float) -> FloatArray:
    """(3,) unit vector to the sun: grid east, grid north, up. ``azimuth_deg`` is from grid north, clockwise."""
    azimuth, elevation = np.deg2rad([azimuth_deg, elevation_deg])
    flat = np.cos(elevation)
    return np.array([flat * np.sin(azimuth), flat * np.cos(azimuth), np.sin(elevation)])


# A July survey, late morning.
SURVEY = Epoch(
    name="survey",
    seed=11,
    sun_azimuth_deg=138.0,
    sun_elevation_deg=54.0,
    ambient=(0.46, 0.49, 0.55),
    direct=(0.56, 0.53, 0.47),
    gain=(1.0, 1.0, 1.0),
    contrast=1.0,
    crops={
        Crop.MEADOW: CropLook((112, 140, 78), 0.05, 0.0),
        Crop.WHEAT: CropLook((196, 174, 112), 0.07, 0.6),
        Crop.MAIZE: CropLook((86, 122, 62), 0.16, 1.0),
        Crop.BEET: CropLook((98, 140, 70), 0.14, 0.2),
        Crop.RAPESEED: CropLook((158, 152, 92), 0.06, 0.7),
        Crop.ORCHARD: CropLook((122, 142, 84), 0.10, 0.0),
    },
    grass=(116, 138, 82),
    leaves=(68, 98, 48),
    leaves_spread=(14, 14, 8),
    needles=(48, 76, 50),
    water=(58, 76, 74),
    soil=(150, 122, 92),
    changed=None,
)

# An October afternoon two years later, from another camera.
FLIGHT = Epoch(
    name="flight",
    seed=47,
    sun_azimuth_deg=243.0,
    sun_elevation_deg=33.0,
    ambient=(0.46, 0.48, 0.53),
    direct=(0.56, 0.50, 0.40),
    gain=(1.04, 0.99, 0.93),
    contrast=0.92,
    crops={
        Crop.MEADOW: CropLook((132, 140, 84), 0.04, 0.0),
        Crop.WHEAT: CropLook((150, 126, 98), 0.10, 0.1),
        Crop.MAIZE: CropLook((168, 146, 98), 0.14, 0.3),
        Crop.BEET: CropLook((88, 112, 62), 0.12, 0.2),
        Crop.RAPESEED: CropLook((110, 138, 78), 0.07, 0.1),
        Crop.ORCHARD: CropLook((136, 140, 88), 0.08, 0.0),
    },
    grass=(134, 136, 88),
    leaves=(138, 112, 66),
    leaves_spread=(28, 24, 12),
    needles=(56, 78, 52),
    water=(74, 84, 88),
    soil=(136, 112, 88),
    changed=0.10,
)


@dataclass(frozen=True, slots=True)
class Car:
    """A parked car: place, heading, RGB."""

    slot: CarSlot
    colour: tuple[int, int, int]


@dataclass(frozen=True, slots=True)
class Standing:
    """What stands in the world at an epoch."""

    buildings: tuple[Building, ...]
    trees: tuple[Tree, ...]
    cars: tuple[Car, ...]


CAR_COLOURS = (
    (236, 236, 238),
    (28, 28, 32),
    (160, 162, 168),
    (66, 70, 80),
    (168, 36, 34),
    (36, 62, 130),
    (198, 196, 186),
)


def standing(layout: Layout, epoch: Epoch) -> Standing:
    """Buildings, trees and cars of ``epoch``."""
    rng = np.random.default_rng([epoch.seed, 7])
    cars = tuple(
        Car(slot, CAR_COLOURS[int(rng.integers(len(CAR_COLOURS)))]) for slot in layout.car_slots if rng.random() < 0.42
    )
    if epoch.changed is None:
        return Standing(layout.buildings, layout.trees, cars)
    gone = set(rng.choice(len(layout.buildings), 2, replace=False).tolist())
    buildings = []
    for i, building in enumerate(layout.buildings):
        if i in gone:
            continue
        if rng.random() < epoch.changed:
            colours = FLAT_COLOURS if building.roof is Roof.FLAT else ROOF_COLOURS
            building = replace(building, colour=colours[int(rng.integers(len(colours)))])  # noqa: PLW2901
        buildings.append(building)
    buildings.extend(layout.spare_buildings[:2])
    trees = []
    for tree in layout.trees:
        fate = rng.random()
        if fate < 0.4 * epoch.changed:
            continue
        grown = 1.15 if fate < epoch.changed else 1.03
        trees.append(replace(tree, radius_m=tree.radius_m * grown, height_m=tree.height_m * grown))
    return Standing(tuple(buildings), tuple(trees), cars)


# Red light, times this, is what bare things reflect in the near infrared; plants add to it by how green they are.
_INFRARED_OF_RED, _INFRARED_OF_GREEN = 1.1, 600.0
_INFRARED_WATER = 14.0
# The blue sky that lights the shade has next to no infrared.
_INFRARED_SHADE = 0.6


def near_infrared(epoch: Epoch) -> Epoch:
    """The same time seen in near infrared: plants bright by how green they are ((G - R) / (G + R)), water black. Its
    first channel is the picture; roofs and ways keep their red there."""

    def seen(colour: Rgb) -> Rgb:
        red, green, _ = colour
        value = _INFRARED_OF_RED * red + _INFRARED_OF_GREEN * max(0.0, (green - red) / (green + red))
        return (min(value, 240.0),) * 3

    def dim(light: Rgb) -> Rgb:
        return light[0] * _INFRARED_SHADE, light[1] * _INFRARED_SHADE, light[2] * _INFRARED_SHADE

    shade, sunlit = dim(epoch.ambient), np.add(epoch.ambient, epoch.direct)
    spread = 0.5 * max(epoch.leaves_spread)
    return replace(
        epoch,
        ambient=shade,
        direct=(float(sunlit[0] - shade[0]), float(sunlit[1] - shade[1]), float(sunlit[2] - shade[2])),
        crops={crop: replace(look, colour=seen(look.colour)) for crop, look in epoch.crops.items()},
        grass=seen(epoch.grass),
        leaves=seen(epoch.leaves),
        leaves_spread=(spread,) * 3,
        needles=seen(epoch.needles),
        water=(_INFRARED_WATER,) * 3,
    )
