"""Dates and hours by lot, and how the world looks then: colours of the season, and the sun where it stands.

Colours are sRGB as a survey camera records them in full light, picked by eye from orthophotos of central Europe.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ortholoc_sim.epoch import CropLook, Epoch, Rgb
from ortholoc_sim.layout import Crop

_LATITUDE_DEG = 50.05
_MIN_ELEVATION_DEG = 14.0
# Between a map and photos of another time: less is not another light.
_MIN_TURN_DEG = 45.0
_OVERCAST_SHARE = 0.15
_TONE_SIGMA = 0.04
# The world's relief and grain make colours richer than they are picked.
_SATURATION = 0.72
_TINT = 0.022
_ATTEMPTS = 1000


@dataclass(frozen=True, slots=True)
class Season:
    """What plants look like at a time of year.

    Attributes:
        day: of the year.
        crops: by crop.
        grass, leaves, leaves_spread, needles, soil: colours.
        bare: whether the trees that shed leaves have none.
    """

    name: str
    day: int
    crops: dict[Crop, CropLook]
    grass: Rgb
    leaves: Rgb
    leaves_spread: Rgb
    needles: Rgb
    soil: Rgb
    bare: bool = False


@dataclass(frozen=True, slots=True)
class Moment:
    """A season, an hour of solar time, and whether clouds hide the sun."""

    season: Season
    hour: float
    overcast: bool = False

    @property
    def sun_deg(self) -> tuple[float, float]:
        """Azimuth clockwise from north and elevation, degrees, at the country's latitude."""
        declination = np.radians(23.44) * np.sin(2 * np.pi * (self.season.day - 81) / 365.25)
        turn, latitude = np.radians(15.0 * (self.hour - 12.0)), np.radians(_LATITUDE_DEG)
        up = np.sin(latitude) * np.sin(declination) + np.cos(latitude) * np.cos(declination) * np.cos(turn)
        north = np.cos(latitude) * np.sin(declination) - np.sin(latitude) * np.cos(declination) * np.cos(turn)
        east = -np.cos(declination) * np.sin(turn)
        return float(np.degrees(np.arctan2(east, north)) % 360.0), float(np.degrees(np.arcsin(up)))


def _crops(*looks: tuple[Rgb, float, float]) -> dict[Crop, CropLook]:
    order = (Crop.MEADOW, Crop.WHEAT, Crop.MAIZE, Crop.BEET, Crop.RAPESEED, Crop.ORCHARD)
    return {crop: CropLook(*look) for crop, look in zip(order, looks, strict=True)}


MARCH = Season(
    "March", 80,
    _crops(((126, 130, 90), 0.05, 0.0), ((100, 126, 76), 0.10, 0.1), ((142, 118, 94), 0.13, 0.0),
           ((152, 127, 101), 0.10, 0.0), ((94, 120, 70), 0.10, 0.25), ((124, 128, 90), 0.08, 0.0)),
    (124, 127, 90), (120, 108, 94), (10, 8, 6), (54, 76, 54), (148, 122, 96), True,
)  # fmt: skip
MAY = Season(
    "May", 130,
    _crops(((106, 142, 72), 0.05, 0.1), ((90, 130, 66), 0.08, 0.5), ((154, 126, 98), 0.12, 0.0),
           ((148, 124, 94), 0.14, 0.05), ((206, 194, 66), 0.04, 0.8), ((110, 142, 78), 0.08, 0.0)),
    (106, 138, 74), (92, 122, 58), (16, 14, 8), (50, 80, 52), (150, 124, 94),
)  # fmt: skip
JULY = Season(
    "July", 190,
    _crops(((116, 140, 80), 0.05, 0.1), ((196, 174, 112), 0.07, 0.6), ((86, 122, 62), 0.16, 1.0),
           ((98, 140, 70), 0.14, 0.2), ((158, 152, 92), 0.06, 0.7), ((122, 142, 84), 0.10, 0.0)),
    (118, 138, 82), (68, 98, 48), (14, 14, 8), (48, 76, 50), (150, 122, 92),
)  # fmt: skip
SEPTEMBER = Season(
    "September", 258,
    _crops(((130, 142, 86), 0.05, 0.0), ((172, 148, 110), 0.08, 0.1), ((128, 134, 72), 0.16, 1.1),
           ((92, 124, 62), 0.14, 0.3), ((112, 136, 78), 0.08, 0.1), ((134, 142, 88), 0.08, 0.0)),
    (132, 138, 88), (92, 102, 54), (22, 14, 8), (50, 76, 50), (146, 118, 90),
)  # fmt: skip
NOVEMBER = Season(
    "November", 308,
    _crops(((122, 132, 82), 0.04, 0.0), ((112, 118, 80), 0.10, 0.05), ((150, 130, 98), 0.14, 0.1),
           ((136, 112, 88), 0.12, 0.0), ((98, 124, 72), 0.07, 0.2), ((124, 130, 84), 0.08, 0.0)),
    (122, 128, 82), (138, 108, 68), (26, 22, 10), (54, 76, 52), (134, 110, 88),
)  # fmt: skip
# Surveys are flown with leaves on the trees or before they come; nobody flies in November.
_SURVEYED = (MARCH, MAY, JULY, SEPTEMBER)
_SEASONS = (MARCH, MAY, JULY, SEPTEMBER, NOVEMBER)


def survey_time(seed: int) -> Moment:
    """When a map was flown: a clear late morning or noon."""
    rng = np.random.default_rng([seed, 120])
    return Moment(_SURVEYED[int(rng.integers(len(_SURVEYED)))], float(rng.uniform(10.2, 13.0)))


def other_time(seed: int) -> Moment:
    """When a photo was taken: another season, the sun elsewhere or behind clouds."""
    before = survey_time(seed)
    rng = np.random.default_rng([seed, 121])
    seasons = [season for season in _SEASONS if season is not before.season]
    for _ in range(_ATTEMPTS):
        season = seasons[int(rng.integers(len(seasons)))]
        found = Moment(season, float(rng.uniform(7.5, 17.5)), bool(rng.random() < _OVERCAST_SHARE))
        azimuth, elevation = found.sun_deg
        turn = abs((azimuth - before.sun_deg[0] + 180.0) % 360.0 - 180.0)
        if elevation > _MIN_ELEVATION_DEG and turn > _MIN_TURN_DEG:
            return found
    raise AssertionError("every season has hours with the sun in the east and in the west")


def epoch_at(moment: Moment, name: str, seed: int) -> Epoch:
    """The world's look at a moment; ``seed`` varies the year's tones, and is that of grain and cars."""
    season = moment.season
    rng = np.random.default_rng([seed, 122])

    def tone(colour: Rgb) -> Rgb:
        bright, warm = rng.normal(0.0, _TONE_SIGMA, 2)
        grey = float(np.mean(colour))
        red, green, blue = (grey + _SATURATION * (c - grey) for c in colour)
        return red * (1 + bright + 0.5 * warm), green * (1 + bright), blue * (1 + bright - 0.5 * warm)

    azimuth, elevation = moment.sun_deg
    # A low sun is warm and weak against the sky's light.
    low = float(np.clip((40.0 - elevation) / 30.0, 0.0, 1.0))
    if moment.overcast:
        ambient, direct = (0.86, 0.88, 0.92), (0.12, 0.11, 0.10)
    else:
        ambient = (0.44 + 0.05 * low, 0.48 + 0.05 * low, 0.55 + 0.06 * low)
        direct = (0.58 - 0.04 * low, 0.54 - 0.08 * low, 0.48 - 0.13 * low)
    return Epoch(
        name=name,
        seed=seed,
        sun_azimuth_deg=azimuth,
        sun_elevation_deg=elevation,
        ambient=ambient,
        direct=direct,
        gain=(1.0, 1.0, 1.0),
        contrast=1.0,
        crops={crop: CropLook(tone(look.colour), look.rows, look.height_m) for crop, look in season.crops.items()},
        grass=tone(season.grass),
        leaves=tone(season.leaves),
        leaves_spread=season.leaves_spread,
        needles=tone(season.needles),
        water=tone((58.0, 76.0, 74.0)),
        soil=season.soil,
        # What changed is decided by whoever asks for the layout of the time.
        changed=None,
        tint=_TINT,
    )
