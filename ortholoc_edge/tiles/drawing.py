"""Lines and polygons that people draw: GeoJSON, KML, KMZ, QGroundControl plans and waypoint files.

The files come from many hands and name their points by longitude first (GeoJSON, KML) or latitude first (plans,
waypoint files), and their altitudes from five zeros. Here they become one thing, with every point checked.
What a mission does besides flying (speeds, cameras, regions of interest, jumps, fences, rally points) is left out.
"""

from __future__ import annotations

import io
import math
import re
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from pathlib import Path, PurePosixPath
from typing import Any
from xml.etree import ElementTree
from xml.parsers import expat

import msgspec
import pyproj
from pyproj.exceptions import CRSError

from ortholoc_edge.errors import ConfigError

LONLAT = "OGC:CRS84"
# Routes and areas are kilobytes; a point cloud or a film given by mistake should not fill the memory.
MAX_FILE_BYTES = 64 * 2**20
_MAX_COORDINATE = 1e8
_MAX_ALTITUDE_M = 1e5

_RTL = 20
_TAKEOFFS = (22, 84)
_LANDINGS = (21, 85)
# NAV_WAYPOINT, the loiters, LAND, TAKEOFF, LOITER_TO_ALT, SPLINE_WAYPOINT, VTOL take-off and landing, PAYLOAD_PLACE.
_FLOWN = frozenset((16, 17, 18, 19, 21, 22, 31, 82, 84, 85, 94))
_WPL_COLUMNS = 12
_WPL_HEAD = re.compile(rb"^\s*(\xef\xbb\xbf)?QGC WPL (\d+)")


class Reference(StrEnum):
    """What an altitude is counted from."""

    HOME = "home"
    AMSL = "amsl"
    ELLIPSOID = "ellipsoid"
    TERRAIN = "terrain"
    MAP = "map"
    UNKNOWN = "unknown"


# MAV_FRAME, with and without _INT.
_FRAMES = {
    0: Reference.AMSL,
    3: Reference.HOME,
    5: Reference.AMSL,
    6: Reference.HOME,
    10: Reference.TERRAIN,
    11: Reference.TERRAIN,
}
# QGroundControl's altitude modes, where a plan has no frame to say the same; "calculated above terrain" are
# heights over the ground that it sends as AMSL.
_MODES = {1: Reference.HOME, 2: Reference.AMSL, 3: Reference.TERRAIN, 4: Reference.TERRAIN}


@dataclass(frozen=True, slots=True)
class Vertex:
    """A point of a line.

    Attributes:
        x, y: in the drawing's system: longitude and latitude in degrees, or metres.
        altitude_m: above ``reference``; None: the file has none.
    """

    x: float
    y: float
    altitude_m: float | None = None
    reference: Reference = Reference.UNKNOWN


Line = tuple[Vertex, ...]
Ring = tuple[tuple[float, float], ...]
# Outer ring first, then holes.
Polygon = tuple[Ring, ...]


@dataclass(frozen=True, slots=True)
class Drawing:
    """What a file shows.

    Attributes:
        name: of the file, to start messages with.
        crs: of all coordinates, x first: `LONLAT` or what a GeoJSON's legacy "crs" member names.
        lines: each of one vertex or more.
        polygons: rings closed or not.
        home_amsl_m: altitude of the place that `Reference.HOME` counts from; None: the file does not say.
        home: (longitude, latitude) of that place.
    """

    name: str
    crs: str
    lines: tuple[Line, ...] = ()
    polygons: tuple[Polygon, ...] = ()
    home: tuple[float, float] | None = None
    home_amsl_m: float | None = None


def read_drawing(path: Path) -> Drawing:
    """Read a file by its ending, or a .json or .txt by what it holds.

    Raises: ConfigError naming the file, the item and the remedy.
    """
    name = str(path)
    try:
        if path.stat().st_size > MAX_FILE_BYTES:
            raise ConfigError(f"{name}: larger than {MAX_FILE_BYTES >> 20} MB, no drawing is; check the path")
        data = path.read_bytes()
    except OSError as err:
        raise ConfigError(f"{name}: cannot be read ({err.strerror}); check the path and its permissions") from err
    reader = _reader(path.suffix.lower(), data, name)
    try:
        drawing = reader(data, name)
    except RecursionError as err:
        raise ConfigError(f"{name}: nested too deeply; export it again") from err
    if not drawing.lines and not drawing.polygons:
        raise ConfigError(f"{name}: holds no line, polygon or waypoint; export the route or area again")
    return drawing


def _reader(suffix: str, data: bytes, name: str) -> Callable[[bytes, str], Drawing]:
    if suffix in (".geojson", ".json", ".plan"):
        return _from_json
    if suffix == ".kml":
        return _from_kml
    if suffix == ".kmz":
        return _from_kmz
    if suffix in (".waypoints", ".txt", ".mission") or _WPL_HEAD.match(data):
        return _from_waypoints
    raise ConfigError(
        f"{name}: unknown kind of file {suffix!r}; give .geojson, .kml, .kmz, .plan (QGroundControl) or"
        " .waypoints (Mission Planner)"
    )


# --- coordinates ---------------------------------------------------------------------------------------------


def _number(value: object, where: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ConfigError(f"{where}: {_short(value)} is not a number; export the file again")
    try:
        number = float(value)
    except OverflowError:
        number = math.inf
    if not math.isfinite(number):
        raise ConfigError(f"{where}: {_short(value)} is not a finite number; export the file again")
    return number


def _altitude(value: object, where: str) -> float:
    number = _number(value, where)
    if abs(number) > _MAX_ALTITUDE_M:
        raise ConfigError(f"{where}: an altitude of {number:g} m; state altitudes in metres")
    return number


def _lonlat(lon: float, lat: float, where: str) -> tuple[float, float]:
    # RFC 7946 cuts shapes at the antimeridian; other writers count on to 360.
    if abs(lat) > 90 or abs(lon) > 360:
        swapped = " (longitude and latitude swapped?)" if abs(lon) <= 90 and abs(lat) <= 180 else ""
        raise ConfigError(
            f"{where}: longitude {lon:g}, latitude {lat:g} is not on the Earth{swapped}; state degrees on WGS 84"
        )
    return lon, lat


def _text_number(text: str, where: str) -> float:
    try:
        number = float(text)
    except ValueError as err:
        raise ConfigError(f"{where}: {_short(text)} is not a number; export the file again") from err
    return _number(number, where)


def _short(value: object) -> str:
    # Not of the whole of a value: its text may be as long as the file, and an integer's too long to write.
    text = repr(value[:40]) if isinstance(value, str | bytes) else type(value).__name__
    return repr(value) if isinstance(value, float | bool | None) else text


def _mapping(value: object, where: str) -> Mapping[str, Any]:
    if not isinstance(value, dict):
        raise ConfigError(f"{where}: {_short(value)} instead of an object {{...}}; export the file again")
    return value


def _list(value: object, where: str) -> list[Any]:
    if not isinstance(value, list):
        raise ConfigError(f"{where}: {_short(value)} instead of a list [...]; export the file again")
    return value


# --- JSON ----------------------------------------------------------------------------------------------------


def _from_json(data: bytes, name: str) -> Drawing:
    try:
        root = msgspec.json.decode(data.removeprefix(b"\xef\xbb\xbf"))
    except (msgspec.DecodeError, UnicodeDecodeError) as err:
        raise ConfigError(f"{name}: no sound JSON ({err}); export it again") from err
    root = _mapping(root, name)
    if root.get("fileType") == "Plan" or "mission" in root:
        return _from_plan(root, name)
    return _GeoJson(name).read(root)


class _GeoJson:
    """Collects the geometries of a GeoJSON object, in their order."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._crs = LONLAT
        self._lines: list[Line] = []
        self._polygons: list[Polygon] = []
        self._points: list[Vertex] = []

    def read(self, root: Mapping[str, Any]) -> Drawing:
        self._crs = _geojson_crs(root.get("crs"), f"{self._name}: $.crs")
        self._take(root, "$")
        # Points beside lines or polygons are labels; alone they are a route in their order.
        if not self._lines and not self._polygons and self._points:
            self._lines.append(tuple(self._points))
        return Drawing(self._name, self._crs, tuple(self._lines), tuple(self._polygons))

    def _take(self, value: object, key: str) -> None:
        where = f"{self._name}: {key}"
        item = _mapping(value, where)
        kind = item.get("type")
        if kind == "FeatureCollection":
            for k, feature in enumerate(_list(item.get("features"), f"{where}.features")):
                self._take(feature, f"{key}.features[{k}]")
        elif kind == "Feature":
            if item.get("geometry") is not None:
                self._take(item["geometry"], f"{key}.geometry")
        elif kind == "GeometryCollection":
            for k, geometry in enumerate(_list(item.get("geometries"), f"{where}.geometries")):
                self._take(geometry, f"{key}.geometries[{k}]")
        else:
            self._take_geometry(kind, item.get("coordinates"), f"{where}.coordinates", where)

    def _take_geometry(self, kind: object, raw: object, at: str, where: str) -> None:
        if kind == "Point":
            self._points.append(self._vertex(raw, at))
        elif kind == "MultiPoint":
            self._points += [self._vertex(one, f"{at}[{k}]") for k, one in enumerate(_list(raw, at))]
        elif kind == "LineString":
            self._lines.append(self._line(raw, at))
        elif kind == "MultiLineString":
            self._lines += [self._line(one, f"{at}[{k}]") for k, one in enumerate(_list(raw, at))]
        elif kind == "Polygon":
            self._polygons.append(self._polygon(raw, at))
        elif kind == "MultiPolygon":
            self._polygons += [self._polygon(one, f"{at}[{k}]") for k, one in enumerate(_list(raw, at))]
        else:
            raise ConfigError(
                f"{where}.type: {_short(kind)} is no GeoJSON geometry; give Polygon, LineString, their Multi kinds,"
                " a collection or features of these"
            )

    def _vertex(self, raw: object, where: str) -> Vertex:
        values = _list(raw, where)
        if len(values) < 2:
            raise ConfigError(f"{where}: {len(values)} numbers, a position has two or three; export it again")
        x, y = _number(values[0], where), _number(values[1], where)
        if self._crs == LONLAT:
            x, y = _lonlat(x, y, where)
        elif max(abs(x), abs(y)) > _MAX_COORDINATE:
            raise ConfigError(f"{where}: ({x:g}, {y:g}) is not on the Earth; check the crs member")
        # RFC 7946 means the ellipsoid; what programs write there is anybody's guess.
        altitude = _altitude(values[2], where) if len(values) > 2 and values[2] is not None else None
        return Vertex(x, y, altitude)

    def _line(self, raw: object, where: str) -> Line:
        line = tuple(self._vertex(one, f"{where}[{k}]") for k, one in enumerate(_list(raw, where)))
        if len(line) < 2:
            raise ConfigError(f"{where}: a line of {len(line)} positions; it needs two")
        return line

    def _polygon(self, raw: object, where: str) -> Polygon:
        rings = _list(raw, where)
        if not rings:
            raise ConfigError(f"{where}: a polygon without rings; draw it again")
        polygon = []
        for k, one in enumerate(rings):
            vertices = [self._vertex(v, f"{where}[{k}][{i}]") for i, v in enumerate(_list(one, f"{where}[{k}]"))]
            polygon.append(_ring([(v.x, v.y) for v in vertices], f"{where}[{k}]"))
        return tuple(polygon)


def _geojson_crs(member: object, where: str) -> str:
    """System of a GeoJSON: RFC 7946 knows longitude and latitude only, its forerunner of 2008 a "crs" member."""
    if member is None:
        return LONLAT
    properties = _mapping(member, where).get("properties")
    crs_name = properties.get("name") if isinstance(properties, dict) else None
    if not isinstance(crs_name, str):
        raise ConfigError(
            f"{where}: names no reference system; write the file in longitude and latitude (ogr2ogr -t_srs"
            " EPSG:4326 -lco RFC7946=YES)"
        )
    try:
        crs = pyproj.CRS.from_user_input(crs_name)
    except CRSError as err:
        raise ConfigError(
            f"{where}: reference system {_short(crs_name)} not understood; write the file in longitude and"
            " latitude (ogr2ogr -t_srs EPSG:4326 -lco RFC7946=YES)"
        ) from err
    if crs.is_geographic and crs.to_epsg() in (None, 4326):
        return LONLAT
    if crs.is_geographic or not crs.is_projected or abs(crs.axis_info[0].unit_conversion_factor - 1) > 1e-12:
        raise ConfigError(
            f"{where}: {crs.name} is neither WGS 84 nor a projected system in metres; write the file in longitude"
            " and latitude (ogr2ogr -t_srs EPSG:4326 -lco RFC7946=YES)"
        )
    return str(crs.to_2d().to_string())


def _ring(points: Sequence[tuple[float, float]], where: str) -> Ring:
    ring = tuple(points[:-1]) if len(points) > 1 and points[0] == points[-1] else tuple(points)
    if len(set(ring)) < 3:
        raise ConfigError(f"{where}: a ring of {len(set(ring))} corners; it needs three")
    return ring


# --- QGroundControl plans ------------------------------------------------------------------------------------


def _from_plan(root: Mapping[str, Any], name: str) -> Drawing:
    mission = _mapping(root.get("mission"), f"{name}: $.mission")
    home, home_amsl = _plan_home(mission.get("plannedHomePosition"), f"{name}: $.mission.plannedHomePosition")
    flight = _Flight(home)
    polygons: list[Polygon] = []
    for k, raw in enumerate(_list(mission.get("items"), f"{name}: $.mission.items")):
        where = f"{name}: $.mission.items[{k}]"
        item = _mapping(raw, where)
        if item.get("type") == "ComplexItem":
            polygons += _fly_complex(flight, item, where)
        else:
            _fly_simple(flight, item, where)
    line = flight.line()
    return Drawing(name, LONLAT, (line,) if line else (), tuple(polygons), home, home_amsl)


def _plan_home(raw: object, where: str) -> tuple[tuple[float, float] | None, float | None]:
    if raw is None:
        return None, None
    values = _list(raw, where)
    if len(values) < 2:
        raise ConfigError(f"{where}: {len(values)} numbers instead of latitude, longitude, altitude")
    if values[0] is None or values[1] is None:
        return None, None
    lon, lat = _lonlat(_number(values[1], where), _number(values[0], where), where)
    if lon == 0 and lat == 0:
        return None, None
    amsl = _altitude(values[2], where) if len(values) > 2 and values[2] is not None else None
    return (lon, lat), amsl


class _Flight:
    """The line that a mission's items fly, one after another.

    Take-off and landing are upright: at their place, at the height before or after. For a fixed wing that is too
    high by its glide, where there is little to see anyway.
    """

    def __init__(self, home: tuple[float, float] | None) -> None:
        self._home = home
        self._vertices: list[Vertex] = []

    def line(self) -> Line:
        return tuple(self._vertices)

    def fly(self, command: int, place: tuple[float, float] | None, altitude_m: float | None, to: Reference) -> None:
        """``place`` is (longitude, latitude); None: where the vehicle is."""
        last = self._vertices[-1] if self._vertices else None
        if command == _RTL:
            if self._home is not None and last is not None:
                self._vertices.append(replace(last, x=self._home[0], y=self._home[1]))
            return
        if command in _TAKEOFFS and last is None and self._home is not None:
            self._vertices.append(Vertex(*self._home, altitude_m, to))
        if place is None:
            return
        if command in _LANDINGS and last is not None:
            altitude_m, to = last.altitude_m, last.reference
        vertex = Vertex(*place, altitude_m, to)
        if not self._vertices or vertex != self._vertices[-1]:
            self._vertices.append(vertex)


def _fly_simple(flight: _Flight, item: Mapping[str, Any], where: str) -> None:
    command = item.get("command")
    if not isinstance(command, int) or isinstance(command, bool):
        raise ConfigError(f"{where}.command: {_short(command)} is no MAVLink command; save the plan again")
    if command == _RTL:
        flight.fly(command, None, None, Reference.UNKNOWN)
    if command not in _FLOWN:
        return
    values = item.get("params")
    if values is None:
        # Plans of QGroundControl 3.2 and before.
        values = [None] * 4 + _list(item.get("coordinate"), f"{where}.params")
    values = _list(values, f"{where}.params")
    if len(values) != 7:
        raise ConfigError(f"{where}.params: {len(values)} values, a mission item has 7; save the plan again")
    frame = item.get("frame")
    reference = _FRAMES.get(frame) if isinstance(frame, int) else None
    altitude = None if values[6] is None else _altitude(values[6], f"{where}.params[6]")
    flight.fly(command, _place(values[4], values[5], f"{where}.params"), altitude, reference or Reference.UNKNOWN)


def _place(lat: object, lon: object, where: str) -> tuple[float, float] | None:
    """(longitude, latitude); None for MAVLink's ways to say "here": 0, 0 and NaN, which JSON has as null."""
    if lat is None or lon is None:
        return None
    latitude, longitude = _number(lat, where), _number(lon, where)
    if latitude == 0 and longitude == 0:
        return None
    return _lonlat(longitude, latitude, where)


def _fly_complex(flight: _Flight, item: Mapping[str, Any], where: str) -> list[Polygon]:
    """Fly a survey, corridor scan, structure scan or landing pattern. Returns: the areas it works on."""
    if "landCoordinate" in item:
        relative = item.get("altitudesAreRelative", True)
        reference = Reference.HOME if relative else Reference.AMSL
        for key, command in (
            ("loiterCoordinate", 31),
            ("landingApproachCoordinate", 31),
            ("finalApproachCoordinate", 31),
            ("landCoordinate", 21),
        ):
            if item.get(key) is not None:
                _fly_position(flight, command, item[key], reference, f"{where}.{key}")
        return []
    transects = item.get("TransectStyleComplexItem")
    if transects is not None:
        _fly_transects(flight, _mapping(transects, f"{where}.TransectStyleComplexItem"), item, where)
    elif item.get("polygon") is not None:
        corners = _positions(item["polygon"], f"{where}.polygon")
        altitude, reference = _structure_altitude(item, where)
        for place in (*corners, *corners[:1]):
            flight.fly(16, place, altitude, reference)
    else:
        kind = item.get("complexItemType")
        raise ConfigError(f"{where}: a {_short(kind)} without transects or polygon; open and save the plan again")
    if item.get("polygon") is None:
        return []
    return [(_ring(_positions(item["polygon"], f"{where}.polygon"), f"{where}.polygon"),)]


def _fly_transects(flight: _Flight, transects: Mapping[str, Any], item: Mapping[str, Any], where: str) -> None:
    where = f"{where}.TransectStyleComplexItem"
    inner = _list(transects.get("Items") or [], f"{where}.Items")
    before = len(flight.line())
    for k, raw in enumerate(inner):
        _fly_simple(flight, _mapping(raw, f"{where}.Items[{k}]"), f"{where}.Items[{k}]")
    if len(flight.line()) > before:
        return
    # Plans written by other programs leave the items to QGroundControl.
    points = transects.get("VisualTransectPoints") or item.get("polyline") or item.get("polygon")
    altitude, reference = _calc_altitude(transects.get("CameraCalc"), f"{where}.CameraCalc")
    for place in _positions(points, f"{where}.VisualTransectPoints"):
        flight.fly(16, place, altitude, reference)


def _calc_altitude(calc: object, where: str) -> tuple[float | None, Reference]:
    if not isinstance(calc, dict) or calc.get("DistanceToSurface") is None:
        return None, Reference.UNKNOWN
    altitude = _altitude(calc["DistanceToSurface"], f"{where}.DistanceToSurface")
    if "DistanceToSurfaceRelative" in calc:
        return altitude, Reference.HOME if calc["DistanceToSurfaceRelative"] else Reference.AMSL
    mode = calc.get("DistanceMode")
    return altitude, _MODES.get(mode, Reference.UNKNOWN) if isinstance(mode, int) else Reference.UNKNOWN


def _structure_altitude(item: Mapping[str, Any], where: str) -> tuple[float | None, Reference]:
    if item.get("EntranceAltitude") is not None:
        return _altitude(item["EntranceAltitude"], f"{where}.EntranceAltitude"), Reference.HOME
    if item.get("Altitude") is not None:
        relative = item.get("altitudeRelative", True)
        return _altitude(item["Altitude"], f"{where}.Altitude"), Reference.HOME if relative else Reference.AMSL
    return None, Reference.UNKNOWN


def _positions(raw: object, where: str) -> list[tuple[float, float]]:
    """[[latitude, longitude], ...] as (longitude, latitude)."""
    places = []
    for k, one in enumerate(_list(raw, where)):
        pair = _list(one, f"{where}[{k}]")
        if len(pair) < 2:
            raise ConfigError(f"{where}[{k}]: {len(pair)} numbers instead of latitude, longitude")
        lat, lon = _number(pair[0], f"{where}[{k}]"), _number(pair[1], f"{where}[{k}]")
        places.append(_lonlat(lon, lat, f"{where}[{k}]"))
    return places


def _fly_position(flight: _Flight, command: int, raw: object, reference: Reference, where: str) -> None:
    values = _list(raw, where)
    if len(values) < 2:
        raise ConfigError(f"{where}: {len(values)} numbers instead of latitude, longitude, altitude")
    altitude = _altitude(values[2], where) if len(values) > 2 and values[2] is not None else None
    flight.fly(command, _place(values[0], values[1], where), altitude, reference)


# --- waypoint files ------------------------------------------------------------------------------------------


def _from_waypoints(data: bytes, name: str) -> Drawing:
    head = _WPL_HEAD.match(data)
    if head is None or head[2] not in (b"110", b"120"):
        raise ConfigError(f"{name}: does not start with 'QGC WPL 110'; save the waypoints again (Mission Planner)")
    home: tuple[float, float] | None = None
    home_amsl: float | None = None
    flight = _Flight(None)
    for number, text in enumerate(data.decode("utf-8", "replace").splitlines()[1:], start=2):
        fields = text.split()
        if not fields or fields[0].startswith("#"):
            continue
        where = f"{name}: line {number}"
        if len(fields) != _WPL_COLUMNS:
            raise ConfigError(f"{where}: {len(fields)} columns, a waypoint has {_WPL_COLUMNS}; save the file again")
        try:
            index, frame, command = int(fields[0]), int(fields[2]), int(float(fields[3]))
        except (ValueError, OverflowError) as err:
            raise ConfigError(f"{where}: index, frame or command is no whole number; save the file again") from err
        if command not in _FLOWN and command != _RTL:
            continue
        lat, lon, altitude = (_field(fields[k], where) for k in (8, 9, 10))
        place = None if lat is None or lon is None else _place(lat, lon, where)
        altitude = None if altitude is None else _altitude(altitude, where)
        # Line 0 is ArduPilot's home; PX4's missions have none and start with what is flown.
        if index == 0 and command == 16 and frame == 0:
            if place is not None:
                home, home_amsl = place, altitude
                flight = _Flight(home)
            continue
        flight.fly(command, place, altitude, _FRAMES.get(frame, Reference.UNKNOWN))
    line = flight.line()
    return Drawing(name, LONLAT, (line,) if line else (), (), home, home_amsl)


def _field(text: str, where: str) -> float | None:
    return None if text.lower() == "nan" else _text_number(text, where)


# --- KML -----------------------------------------------------------------------------------------------------


def _from_kmz(data: bytes, name: str) -> Drawing:
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            kmls = [info for info in archive.infolist() if PurePosixPath(info.filename).suffix.lower() == ".kml"]
            if not kmls:
                raise ConfigError(f"{name}: no .kml in the archive; export the route again")
            # The first in the root, by the format's rules.
            first = min(kmls, key=lambda info: info.filename.count("/"))
            with archive.open(first) as file:
                kml = file.read(MAX_FILE_BYTES + 1)
    except (zipfile.BadZipFile, zlib.error, NotImplementedError, RuntimeError, EOFError, OSError, ValueError) as err:
        raise ConfigError(f"{name}: no sound KMZ archive ({err}); export it again") from err
    if len(kml) > MAX_FILE_BYTES:
        raise ConfigError(f"{name}: {first.filename} unpacks to over {MAX_FILE_BYTES >> 20} MB; no drawing does")
    return _from_kml(kml, f"{name}/{first.filename}")


def _from_kml(data: bytes, name: str) -> Drawing:
    _refuse_dtd(data, name)
    try:
        root = ElementTree.fromstring(data)
    except (ElementTree.ParseError, ValueError, LookupError) as err:
        raise ConfigError(f"{name}: no sound XML ({err}); export it again") from err
    if _tag(root) not in ("kml", "Document", "Folder", "Placemark"):
        raise ConfigError(f"{name}: <{_tag(root)[:40]}> instead of <kml>; export the route as KML")
    lines: list[Line] = []
    polygons: list[Polygon] = []
    points: list[Vertex] = []
    for where, item in _kml_geometries(root, name):
        kind = _tag(item)
        if kind == "Point":
            points += _kml_vertices(item, where)
        elif kind in ("LineString", "LinearRing"):
            lines.append(_at_least_two(_kml_vertices(item, where), where))
        elif kind == "Track":
            lines.append(_at_least_two(_kml_track(item, where), where))
        else:
            polygons.append(_kml_polygon(item, where))
    if not lines and not polygons and points:
        lines.append(tuple(points))
    return Drawing(name, LONLAT, tuple(lines), tuple(polygons))


def _refuse_dtd(data: bytes, name: str) -> None:
    """Entities that a document defines can grow without bound; KML needs none."""

    def refuse(*_: object) -> None:
        raise ConfigError(f"{name}: defines a document type (DTD), which KML does not need; export it again")

    parser = expat.ParserCreate()
    parser.StartDoctypeDeclHandler = refuse
    try:
        parser.Parse(data, True)
    except (expat.ExpatError, ValueError, LookupError) as err:
        raise ConfigError(f"{name}: no sound XML ({err}); export it again") from err


def _kml_geometries(root: ElementTree.Element, name: str) -> Iterator[tuple[str, ElementTree.Element]]:
    """Geometries in the order of the document, with the placemark they stand in. What lies in a polygon is not
    visited by itself."""
    stack = [(root, name)]
    while stack:
        item, where = stack.pop()
        kind = _tag(item)
        if kind in ("Point", "LineString", "LinearRing", "Polygon", "Track"):
            yield f"{where}, {kind}", item
            continue
        if kind == "Placemark":
            title = next((child.text for child in item if _tag(child) == "name" and child.text), None)
            where = f"{name}: placemark {_short(title.strip()) if title else 'without name'}"
        stack += [(child, where) for child in reversed(item)]


def _tag(item: ElementTree.Element) -> str:
    # Comments and processing instructions have a function for a tag.
    return item.tag.rpartition("}")[2] if isinstance(item.tag, str) else ""


def _child(item: ElementTree.Element, *tags: str) -> str:
    return next((child.text or "" for child in item if _tag(child) in tags), "")


def _kml_vertices(item: ElementTree.Element, where: str) -> Line:
    reference = _kml_reference(item)
    # Blanks after the commas are against the format and common.
    text = re.sub(r"\s*,\s*", ",", _child(item, "coordinates"))
    return tuple(_kml_vertex(one.split(","), reference, where) for one in text.split())


def _kml_track(item: ElementTree.Element, where: str) -> Line:
    reference = _kml_reference(item)
    texts = [child.text or "" for child in item if _tag(child) == "coord"]
    return tuple(_kml_vertex(text.split(), reference, where) for text in texts if text.strip())


def _kml_vertex(fields: Sequence[str], reference: Reference | None, where: str) -> Vertex:
    if len(fields) not in (2, 3):
        raise ConfigError(f"{where}: {_short(','.join(fields))} is not longitude,latitude[,altitude]; export it again")
    lon, lat = _lonlat(_text_number(fields[0], where), _text_number(fields[1], where), where)
    if len(fields) == 2 or not fields[2] or reference is None:
        return Vertex(lon, lat)
    return Vertex(lon, lat, _altitude(_text_number(fields[2], where), where), reference)


def _kml_reference(item: ElementTree.Element) -> Reference | None:
    """None where the altitude is to be ignored, KML's default."""
    mode = _child(item, "altitudeMode").strip()
    return {
        "absolute": Reference.AMSL,
        "relativeToGround": Reference.TERRAIN,
        "relativeToSeaFloor": Reference.UNKNOWN,
    }.get(mode)


def _kml_polygon(item: ElementTree.Element, where: str) -> Polygon:
    outer: list[Ring] = []
    holes: list[Ring] = []
    for boundary in item:
        rings = outer if _tag(boundary) == "outerBoundaryIs" else holes
        if _tag(boundary) in ("outerBoundaryIs", "innerBoundaryIs"):
            rings += [
                _ring([(v.x, v.y) for v in _kml_vertices(ring, where)], where)
                for ring in boundary
                if _tag(ring) == "LinearRing"
            ]
    if len(outer) != 1:
        raise ConfigError(f"{where}: {len(outer)} outer boundaries; a polygon has one")
    return (*outer, *holes)


def _at_least_two(line: Line, where: str) -> Line:
    if len(line) < 2:
        raise ConfigError(f"{where}: a line of {len(line)} positions; it needs two")
    return line
