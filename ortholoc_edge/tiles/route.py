"""A route that a vehicle will fly, as drawn or planned: legs on WGS 84 with altitudes and what they count from."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pyproj
from pyproj.exceptions import ProjError

from ortholoc_edge.errors import ConfigError
from ortholoc_edge.geometry.arrays import FloatArray, IntArray
from ortholoc_edge.tiles.drawing import LONLAT, Drawing, Line, Reference, read_drawing

_GEOD = pyproj.Geod(ellps="WGS84")
# Of one forecast: 5000 km at 25 m.
_MAX_SAMPLES = 200_000
# Shorter legs are a waypoint given twice.
_MIN_LEG_M = 1e-3


@dataclass(frozen=True, slots=True, eq=False)
class RouteSamples:
    """Pieces of a route, each seen as its middle.

    Attributes:
        lonlat: (N, 2) of the middles, degrees on WGS 84.
        start, end: (N, 2) of the pieces' ends, likewise.
        heading_rad: (N,) along the leg, clockwise from true north.
        length_m: (N,) of the pieces; 0 for the only point of a line without length.
        line: (N,) which of the route's lines.
        leg: (N,) which leg of it, from vertex ``leg`` to ``leg + 1``.
        share: (N,) of the leg's length that lies behind, 0 to 1.
    """

    lonlat: FloatArray
    start: FloatArray
    end: FloatArray
    heading_rad: FloatArray
    length_m: FloatArray
    line: IntArray
    leg: IntArray
    share: FloatArray

    def __len__(self) -> int:
        return len(self.lonlat)


@dataclass(frozen=True, slots=True)
class Route:
    """Lines in the order they are flown; between lines there is nothing.

    Attributes:
        name: of the file.
        lines: longitudes and latitudes, degrees on WGS 84.
        home: (longitude, latitude) of the place that altitudes relative to home count from; None: the first point.
        home_amsl_m: its altitude; None: not stated.
    """

    name: str
    lines: tuple[Line, ...]
    home: tuple[float, float] | None = None
    home_amsl_m: float | None = None

    @staticmethod
    def read(path: Path) -> Route:
        """Read a route. Raises: ConfigError naming the file, the item and the remedy."""
        return Route.of(read_drawing(path))

    @staticmethod
    def of(drawing: Drawing) -> Route:
        """The lines of a drawing. Raises: ConfigError if it has none."""
        if not drawing.lines:
            raise ConfigError(f"{drawing.name}: polygons only, a route needs a line or waypoints; draw one")
        lines = tuple(_on_wgs84(line, drawing) for line in drawing.lines)
        return Route(drawing.name, lines, drawing.home, drawing.home_amsl_m)

    def with_reference(self, reference: Reference) -> Route:
        """The route with a reference for those altitudes whose file does not state one."""
        return replace(
            self,
            lines=tuple(
                tuple(replace(v, reference=reference) if v.reference is Reference.UNKNOWN else v for v in line)
                for line in self.lines
            ),
        )

    @property
    def length_m(self) -> float:
        return float(sum(leg[2].sum() for leg in map(_legs, self.lines)))

    def sample(self, step_m: float) -> RouteSamples:
        """Cut every leg into equal pieces of at most ``step_m``; legs are geodesics.

        Raises: ConfigError for a step that would make too many pieces.
        """
        if not (math.isfinite(step_m) and step_m > 0):
            raise ValueError(f"step_m {step_m} must be positive")
        parts: list[tuple[FloatArray, ...]] = []
        total = 0
        for number, line in enumerate(self.lines):
            starts, azimuth_deg, length_m, which = _legs(line)
            if not len(which):
                parts.append(_point(line, number))
                continue
            counts = np.ceil(np.maximum(length_m / step_m, 1.0))
            total += int(min(counts.sum(), 2 * _MAX_SAMPLES))
            if total > _MAX_SAMPLES:
                raise ConfigError(
                    f"{self.name}: {self.length_m / 1e3:.0f} km in steps of {step_m:.1f} m are more than"
                    f" {_MAX_SAMPLES} places; shorten the route or look at it from higher up (--agl)"
                )
            count = counts.astype(np.intp)
            leg = np.repeat(np.arange(len(count)), count)
            order = np.arange(len(leg)) - np.repeat(np.cumsum(count) - count, count)
            piece_m = (length_m / counts)[leg]
            at = [_ahead(starts[leg], azimuth_deg[leg], (order + shift) * piece_m) for shift in (0.0, 0.5, 1.0)]
            parts.append(
                (
                    at[1][:, :2],
                    at[0][:, :2],
                    at[2][:, :2],
                    np.asarray(np.deg2rad(at[1][:, 2])),
                    piece_m,
                    np.full(len(leg), float(number)),
                    which[leg].astype(np.float64),
                    (order + 0.5) / counts[leg],
                )
            )
        joined = [np.concatenate(columns) for columns in zip(*parts, strict=True)]
        lonlat, start, end, heading, length, number_of, leg_of, share = joined
        return RouteSamples(
            lonlat, start, end, heading, length, number_of.astype(np.intp), leg_of.astype(np.intp), share
        )


def _on_wgs84(line: Line, drawing: Drawing) -> Line:
    if drawing.crs == LONLAT:
        return line
    try:
        transformer = pyproj.Transformer.from_crs(drawing.crs, LONLAT, always_xy=True, allow_ballpark=False)
        lon, lat = transformer.transform([v.x for v in line], [v.y for v in line], errcheck=True)
    except ProjError as err:
        raise ConfigError(
            f"{drawing.name}: its coordinates cannot be converted to WGS 84 ({err}); check its crs member"
        ) from err
    if not np.isfinite([lon, lat]).all():
        raise ConfigError(f"{drawing.name}: coordinates outside the domain of {drawing.crs}; check its crs member")
    return tuple(replace(v, x=float(a), y=float(b)) for v, a, b in zip(line, lon, lat, strict=True))


def _legs(line: Line) -> tuple[FloatArray, FloatArray, FloatArray, IntArray]:
    """Starts (L, 2), azimuths (L,) degrees, lengths (L,) m and numbers (L,) of the legs that have a length."""
    points = np.array([(v.x, v.y) for v in line])
    azimuth, _, length = _GEOD.inv(points[:-1, 0], points[:-1, 1], points[1:, 0], points[1:, 1])
    which = np.flatnonzero(np.asarray(length) > _MIN_LEG_M)
    return points[which], np.asarray(azimuth)[which], np.asarray(length)[which], which


def _ahead(starts: FloatArray, azimuth_deg: FloatArray, distance_m: FloatArray) -> FloatArray:
    """(N, 3): longitude, latitude and heading, degrees, after a distance along geodesics."""
    lon, lat, back = _GEOD.fwd(starts[:, 0], starts[:, 1], azimuth_deg, distance_m)
    return np.stack([lon, lat, np.asarray(back) + 180.0], axis=-1)


def _point(line: Line, number: int) -> tuple[FloatArray, ...]:
    place = np.array([[line[0].x, line[0].y]])
    zero = np.zeros(1)
    return place, place, place, zero, zero, np.full(1, float(number)), zero, zero
