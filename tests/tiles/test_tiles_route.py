import json
import random
import zipfile

import numpy as np
import pyproj
import pytest
from route_files import HOME, KML, WAYPOINTS, mission, plan, simple, survey, written

from ortholoc_edge.errors import ConfigError
from ortholoc_edge.tiles.drawing import MAX_FILE_BYTES, Reference, read_drawing
from ortholoc_edge.tiles.route import Route

GEOD = pyproj.Geod(ellps="WGS84")


def places(line):
    return [(round(v.y, 6), round(v.x, 6)) for v in line]


def test_a_plan_is_flown_from_take_off_through_the_survey_home(tmp_path):
    drawing = read_drawing(written(tmp_path / "m.plan", mission()))
    (line,) = drawing.lines
    grid = [(51.052, 13.702), (51.056, 13.702), (51.056, 13.704), (51.052, 13.704)]
    assert places(line) == [HOME, (51.051, 13.701), *grid, HOME]
    assert [(v.altitude_m, v.reference) for v in line[:3]] == [
        (60.0, Reference.HOME),
        (150.0, Reference.AMSL),
        (80.0, Reference.HOME),
    ]
    # The way home is flown at the height of what was before it.
    assert (line[-1].altitude_m, line[-1].reference) == (80.0, Reference.HOME)
    assert drawing.home == (13.70, 51.05)
    assert drawing.home_amsl_m == 113.0
    assert len(drawing.polygons) == 1


@pytest.mark.parametrize(
    ("calc", "reference"),
    [
        ({"DistanceToSurface": 70, "DistanceToSurfaceRelative": False}, Reference.AMSL),
        ({"DistanceToSurface": 70, "DistanceMode": 1}, Reference.HOME),
        ({"DistanceToSurface": 70, "DistanceMode": 3}, Reference.TERRAIN),
    ],
)
def test_a_survey_without_items_flies_its_transects(tmp_path, calc, reference):
    points = [[51.05, 13.70], [51.06, 13.70], [51.06, 13.71]]
    item = survey(points, points, calc=calc)
    (line,) = read_drawing(written(tmp_path / "m.plan", plan([item]))).lines
    assert places(line) == [tuple(p) for p in points]
    assert {(v.altitude_m, v.reference) for v in line} == {(70.0, reference)}


def test_corridor_structure_and_landing_of_a_plan(tmp_path):
    corridor = {
        "type": "ComplexItem",
        "complexItemType": "CorridorScan",
        "CorridorWidth": 50,
        "polyline": [[51.05, 13.70], [51.06, 13.71]],
        "TransectStyleComplexItem": {"CameraCalc": {"DistanceToSurface": 50, "DistanceMode": 2}},
    }
    structure = {
        "type": "ComplexItem",
        "complexItemType": "StructureScan",
        "EntranceAltitude": 40,
        "polygon": [[51.07, 13.70], [51.07, 13.71], [51.08, 13.71]],
    }
    landing = {
        "type": "ComplexItem",
        "complexItemType": "fwLandingPattern",
        "altitudesAreRelative": True,
        "landingApproachCoordinate": [51.09, 13.70, 45],
        "landCoordinate": [51.10, 13.70, 0],
    }
    drawing = read_drawing(written(tmp_path / "m.plan", plan([corridor, structure, landing])))
    (line,) = drawing.lines
    assert places(line) == [
        (51.05, 13.70),
        (51.06, 13.71),
        (51.07, 13.70),
        (51.07, 13.71),
        (51.08, 13.71),
        (51.07, 13.70),
        (51.09, 13.70),
        (51.10, 13.70),
    ]
    assert [v.altitude_m for v in line] == [50, 50, 40, 40, 40, 40, 45, 45]
    assert len(drawing.polygons) == 1


def test_altitude_frames_of_a_plan(tmp_path):
    items = [simple(16, 51.05 + k / 1000, 13.7, 100, frame) for k, frame in enumerate((0, 3, 5, 6, 10, 11, 1))]
    (line,) = read_drawing(written(tmp_path / "m.plan", plan(items))).lines
    assert [v.reference.value for v in line] == ["amsl", "home", "amsl", "home", "terrain", "terrain", "unknown"]


def test_waypoints_of_mission_planner(tmp_path):
    drawing = read_drawing(written(tmp_path / "m.waypoints", WAYPOINTS))
    (line,) = drawing.lines
    assert places(line) == [HOME, (51.052, 13.702), (51.054, 13.704), HOME]
    assert [(v.altitude_m, v.reference.value) for v in line] == [
        (50.0, "home"),
        (100.0, "home"),
        (90.0, "terrain"),
        (90.0, "terrain"),
    ]
    assert drawing.home_amsl_m == 113.0


@pytest.mark.parametrize("packed", [False, True], ids=["kml", "kmz"])
def test_kml_lines_tracks_and_polygons(tmp_path, packed):
    path = tmp_path / "r.kml"
    if packed:
        path = tmp_path / "r.kmz"
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("files/other.kml", "<kml/>")
            archive.writestr("doc.kml", KML)
    else:
        written(path, KML)
    drawing = read_drawing(path)
    way, track = drawing.lines
    assert places(way) == [(51.05, 13.70), (51.052, 13.702), (51.054, 13.704)]
    assert [(v.altitude_m, v.reference.value) for v in way] == [(200, "amsl"), (210, "amsl"), (220, "amsl")]
    assert [(v.altitude_m, v.reference.value) for v in track] == [(90, "terrain"), (95, "terrain")]
    ((outer, hole),) = drawing.polygons
    assert (len(outer), len(hole)) == (4, 4)


def test_kml_points_alone_are_a_route_and_clamped_altitudes_are_none(tmp_path):
    marks = "".join(
        f"<Placemark><Point><coordinates>13.7{k},51.05,99</coordinates></Point></Placemark>" for k in range(3)
    )
    (line,) = read_drawing(written(tmp_path / "r.kml", f"<kml>{marks}</kml>")).lines
    assert [v.x for v in line] == [13.70, 13.71, 13.72]
    assert {v.altitude_m for v in line} == {None}


def test_entities_of_a_kml_are_refused_before_they_grow(tmp_path):
    bomb = '<!DOCTYPE k [<!ENTITY a "x"><!ENTITY b "&a;&a;">]><kml>&b;</kml>'
    for encoding in ("utf-8", "utf-16"):
        path = tmp_path / "bomb.kml"
        path.write_bytes(bomb.encode(encoding))
        with pytest.raises(ConfigError, match="document type"):
            read_drawing(path)


def test_a_kmz_that_unpacks_without_end_is_refused(tmp_path):
    path = tmp_path / "bomb.kmz"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("doc.kml", b" " * (MAX_FILE_BYTES + 1))
    with pytest.raises(ConfigError, match="unpacks to over"):
        read_drawing(path)


def geojson(geometry):
    return {"type": "Feature", "properties": {}, "geometry": geometry}


def test_geojson_collections_keep_their_order_and_heights(tmp_path):
    collection = {
        "type": "FeatureCollection",
        "features": [
            geojson({"type": "Point", "coordinates": [0.0, 0.0]}),
            geojson({"type": "LineString", "coordinates": [[13.7, 51.05, 150], [13.71, 51.05]]}),
            geojson(None),
            geojson(
                {
                    "type": "GeometryCollection",
                    "geometries": [{"type": "MultiLineString", "coordinates": [[[1, 2], [3, 4]], [[5, 6], [7, 8]]]}],
                }
            ),
        ],
    }
    lines = read_drawing(written(tmp_path / "r.geojson", collection)).lines
    assert [line[0].x for line in lines] == [13.7, 1.0, 5.0]
    assert (lines[0][0].altitude_m, lines[0][0].reference) == (150.0, Reference.UNKNOWN)
    route = Route.read(tmp_path / "r.geojson").with_reference(Reference.AMSL)
    assert route.lines[0][0].reference is Reference.AMSL


def test_a_projected_geojson_becomes_a_route_on_wgs84(tmp_path):
    east, north = pyproj.Transformer.from_crs("OGC:CRS84", "EPSG:25833", always_xy=True).transform(13.7, 51.05)
    named = {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::25833"}}
    line = {"type": "LineString", "crs": named, "coordinates": [[east, north], [east + 1000.0, north]]}
    route = Route.read(written(tmp_path / "r.json", line))
    assert route.lines[0][0].x == pytest.approx(13.7, abs=1e-8)
    # The point scale factor 80 km west of the central meridian.
    assert route.length_m == pytest.approx(1000.0 / 0.99971, abs=0.1)


def test_samples_are_the_middles_of_equal_pieces_of_each_leg(tmp_path):
    line = {"type": "LineString", "coordinates": [[13.7, 51.05], [13.71, 51.05], [13.71, 51.05], [13.71, 51.06]]}
    route = Route.read(written(tmp_path / "r.geojson", line))
    samples = route.sample(50.0)
    assert samples.length_m.max() <= 50.0
    assert samples.length_m.sum() == pytest.approx(route.length_m, abs=1e-6)
    assert set(samples.leg) == {0, 2}
    assert np.rad2deg(samples.heading_rad[samples.leg == 0]) % 360 == pytest.approx(90.0, abs=0.01)
    assert np.rad2deg(samples.heading_rad[samples.leg == 2]) % 360 == pytest.approx(0.0, abs=0.01)
    # Pieces follow one another, and their middles lie midway.
    assert samples.end[:-1] == pytest.approx(samples.start[1:], abs=1e-9)
    _, _, half = GEOD.inv(*samples.start.T, *samples.lonlat.T)
    assert half == pytest.approx(samples.length_m / 2, abs=1e-4)
    assert samples.share[0] == pytest.approx(0.5 / (samples.leg == 0).sum())


def test_a_route_across_the_antimeridian_goes_the_short_way(tmp_path):
    line = {"type": "LineString", "coordinates": [[179.99, 0.0], [-179.99, 0.0]]}
    assert Route.read(written(tmp_path / "r.geojson", line)).length_m == pytest.approx(2226.4, abs=0.5)


def test_hovering_at_one_place_is_one_sample(tmp_path):
    route = Route.read(written(tmp_path / "m.plan", plan([simple(16, *HOME, 50)])))
    samples = route.sample(10.0)
    assert len(samples) == 1
    assert samples.length_m[0] == 0.0


def test_a_step_too_small_for_the_route_is_refused(tmp_path):
    line = {"type": "LineString", "coordinates": [[0, 0], [90, 0]]}
    with pytest.raises(ConfigError, match="shorten the route"):
        Route.read(written(tmp_path / "r.geojson", line)).sample(1.0)


BAD = [
    ("a.geojson", "", "no sound JSON"),
    ("a.geojson", "[1]", "instead of an object"),
    ("a.geojson", {"type": "FeatureCollection", "features": []}, "holds no line"),
    ("a.geojson", {"type": "Polygon", "coordinates": []}, "without rings"),
    ("a.geojson", {"type": "Polygon", "coordinates": [[[0, 0], [1, 1], [0, 0]]]}, "it needs three"),
    ("a.geojson", {"type": "LineString", "coordinates": [[0, 0]]}, "it needs two"),
    ("a.geojson", {"type": "LineString", "coordinates": [["0", 0], [1, 1]]}, "'0' is not a number"),
    ("a.geojson", '{"type": "LineString", "coordinates": [[NaN, 0], [1, 1]]}', "no sound JSON"),
    ("a.geojson", {"type": "LineString", "coordinates": [[10**400, 0], [1, 1]]}, "not a finite|no sound JSON"),
    ("a.geojson", {"type": "LineString", "coordinates": [[51.0, 113.7], [51.1, 113.8]]}, "swapped"),
    ("a.geojson", {"type": "LineString", "coordinates": [[5e5, 5e6], [5e5, 5.1e6]]}, "not on the Earth"),
    ("a.geojson", {"type": "Circle", "coordinates": []}, "'Circle' is no GeoJSON geometry"),
    ("a.geojson", {"type": "LineString", "crs": {"type": "link"}, "coordinates": []}, "names no reference system"),
    (
        "a.geojson",
        {"type": "Point", "crs": {"properties": {"name": "EPSG:2263"}}, "coordinates": [0, 0]},
        "projected system in metres",
    ),
    ("a.geojson", '{"a":' * 5000, "nested too deeply|no sound JSON"),
    ("a.geojson", '{"type":"GeometryCollection","geometries":[' * 900 + "]}" * 900, "nested too deeply|no line"),
    ("a.plan", {"fileType": "Plan"}, "mission"),
    ("a.plan", plan([]), "holds no line"),
    ("a.plan", plan({}), "instead of a list"),
    ("a.plan", plan([simple(16, 99.0, 13.7, 50)]), r"items\[0\].params: .* not on the Earth"),
    ("a.plan", plan([simple(16, 51.0, 13.7, "50")]), "'50' is not a number"),
    ("a.plan", plan([simple("16", 51.0, 13.7, 50)]), "no MAVLink command"),
    ("a.plan", plan([{"type": "ComplexItem", "complexItemType": "mystery"}]), "mystery"),
    ("a.plan", plan([{"command": 16, "params": [1, 2]}]), "2 values"),
    ("a.waypoints", "nonsense", "QGC WPL 110"),
    ("a.waypoints", "QGC WPL 110\n", "holds no line"),
    ("a.waypoints", "QGC WPL 110\n0 1 2\n", "line 2: 3 columns"),
    ("a.waypoints", WAYPOINTS.replace("51.054000", "north"), "line 6: 'north' is not a number"),
    ("a.kml", "", "no sound XML"),
    ("a.kml", KML[:600], "no sound XML"),
    ("a.kml", "<gpx/>", "<gpx> instead of <kml>"),
    ("a.kml", KML.replace("13.704,51.054,220", "13.704,,220"), "placemark 'way', LineString"),
    ("a.kml", KML.replace("13.704,51.054,220", "nan,51.054"), "not a finite number"),
    ("a.kmz", "no archive", "no sound KMZ"),
    ("a.shp", "x", "unknown kind of file"),
]


@pytest.mark.parametrize(("name", "content", "message"), BAD, ids=range(len(BAD)))
def test_bad_files_are_named_with_the_item(tmp_path, name, content, message):
    path = written(tmp_path / name, content)
    with pytest.raises(ConfigError, match=message) as caught:
        read_drawing(path)
    assert str(path) in str(caught.value)


def test_a_missing_file_and_a_folder_are_named(tmp_path):
    for path in (tmp_path / "none.kml", tmp_path):
        with pytest.raises(ConfigError, match=str(path)):
            read_drawing(path)


def test_polygons_alone_are_no_route(tmp_path):
    polygon = {"type": "Polygon", "coordinates": [[[0, 0], [1, 0], [1, 1], [0, 0]]]}
    with pytest.raises(ConfigError, match="polygons only"):
        Route.read(written(tmp_path / "a.geojson", polygon))


def _mutated(data, rng):
    """Cut short, bytes replaced, or a stretch doubled."""
    data = bytearray(data)
    kind = rng.randrange(3)
    if kind == 0:
        return bytes(data[: rng.randrange(len(data))])
    if kind == 1:
        for _ in range(rng.randrange(1, 6)):
            data[rng.randrange(len(data))] = rng.choice(b'0919-eE.,"[]{}<>&nul\x00\xff ')
        return bytes(data)
    start = rng.randrange(len(data))
    return bytes(data[:start] + data[max(0, start - 200) : start] + data[start:])


def _retyped(value, rng):
    """A JSON value with one of its parts replaced by something else."""
    if isinstance(value, dict) and value and rng.random() < 0.9:
        key = rng.choice(sorted(value))
        return {**value, key: _retyped(value[key], rng)}
    if isinstance(value, list) and value and rng.random() < 0.9:
        k = rng.randrange(len(value))
        return [*value[:k], _retyped(value[k], rng), *value[k + 1 :]]
    return rng.choice([None, True, -1, 10**30, 1e300, "x", [], {}, [[]], [None, None], {"type": "Point"}])


@pytest.mark.parametrize("name", ["m.plan", "r.kml", "r.kmz", "m.waypoints", "r.geojson"])
def test_hostile_bytes_give_named_errors_only(tmp_path, name):
    rng = random.Random(name)
    path = tmp_path / name
    if name == "r.kmz":
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr("doc.kml", KML)
    else:
        line = {"type": "LineString", "coordinates": [[13.7, 51.05, 3], [13.8, 51.05]]}
        written(path, {"m.plan": mission(), "r.kml": KML, "m.waypoints": WAYPOINTS, "r.geojson": line}[name])
    original = path.read_bytes()
    refused = 0
    for _ in range(400):
        data = _mutated(original, rng)
        if path.suffix in (".plan", ".geojson") and rng.random() < 0.7:
            data = json.dumps(_retyped(json.loads(original), rng)).encode()
        path.write_bytes(data)
        try:
            assert len(Route.read(path).sample(1e6)) > 0
        except ConfigError as err:
            assert name in str(err)
            refused += 1
    assert 0 < refused < 400
