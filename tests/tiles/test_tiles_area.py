import numpy as np
import pyproj
import pytest
from hypothesis import given
from hypothesis import strategies as st
from route_files import KML, WAYPOINTS, mission, written

from ortholoc_edge.errors import ConfigError, MapError
from ortholoc_edge.geometry.grid import RasterGrid
from ortholoc_edge.tiles.area import DEFAULT_CORRIDOR_M, MapArea, Strip, map_from_lonlat, read_area

UTM32, UTM33 = "EPSG:25832", "EPSG:25833"
GEOD = pyproj.Geod(ellps="WGS84")


def centres(grid):
    px = np.stack(np.meshgrid(np.arange(grid.width), np.arange(grid.height)), axis=-1)
    return grid.map_from_px(px.reshape(-1, 2))


def grid_over(bounds, gsd_m):
    west, south, east, north = bounds
    width, height = int(np.ceil((east - west) / gsd_m)), int(np.ceil((north - south) / gsd_m))
    return RasterGrid(width, height, west, north, gsd_m, -gsd_m)


def geojson(tmp_path, kind, coordinates, **more):
    return str(written(tmp_path / "a.geojson", {"type": kind, "coordinates": coordinates, **more}))


def test_a_box_in_degrees_covers_what_lies_in_it(tmp_path):
    area = read_area("13.70,51.04,13.73,51.06", None).on_map(UTM33)
    grid = grid_over(tuple(np.add(area.bounds, (-200, -200, 200, 200))), 20.0)
    to_degrees = pyproj.Transformer.from_crs(UTM33, "OGC:CRS84", always_xy=True)
    lon, lat = to_degrees.transform(*centres(grid).T)
    inside = (lon > 13.70) & (lon < 13.73) & (lat > 51.04) & (lat < 51.06)
    mask = area.mask(grid)
    assert mask.shape == (grid.height, grid.width)
    assert (mask.ravel() == inside).all()


def test_the_same_box_in_the_neighbouring_zone_leans(tmp_path):
    """Seen from zone 32, Dresden lies 4.7 degrees east of the meridian: the box is turned by 3.7 degrees, and its
    edges bend; pixels within a few centimetres of them apart, the mask is exact."""
    area = read_area("13.60,51.00,13.90,51.15", None).on_map(UTM32)
    grid = grid_over(area.bounds, 97.0)
    to_degrees = pyproj.Transformer.from_crs(UTM32, "OGC:CRS84", always_xy=True)
    lon, lat = to_degrees.transform(*centres(grid).T)
    inside = (lon > 13.60) & (lon < 13.90) & (lat > 51.00) & (lat < 51.15)
    mask = area.mask(grid).ravel()
    assert (mask != inside).sum() <= 2
    assert 0.8 < inside.mean() < 0.95
    # A straight line between the projected corners is off by the sagitta of the parallel.
    assert len(area.polygons[0][0]) > 20


def test_boxes_in_metres_are_the_packs_own():
    assert read_area("410000,5655000,411000,5656500", None).on_map(UTM33).bounds == (410000, 5655000, 411000, 5656500)
    assert read_area("0,0,80,60", None).on_map(None).bounds == (0, 0, 80, 60)
    assert read_area("-1000,-500,1000,500", None).on_map(None).bounds == (-1000, -500, 1000, 500)


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        ("13.7,51.1,13.8,51.0", "south 51.1 is not below north 51"),
        ("13.8,51.0,13.7,51.1", "west 13.8 is not left of east 13.7.*antimeridian"),
        ("179.9,-17,-179.9,-16", "antimeridian"),
        ("500000,0,400000,10", r"west 500000 is not left"),
        ("1,2,3", "3 numbers"),
        ("1,2,3,nan", "NaN"),
        ("1,2,3,x", "nor a file"),
        ("", "cannot be read"),
        ("no/such.kml", "nor a file"),
    ],
)
def test_boxes_that_are_none(spec, message):
    with pytest.raises(ConfigError, match=message):
        read_area(spec, None)


@pytest.mark.parametrize(
    ("spec", "crs", "message"),
    [
        ("51.0,113.7,51.1,113.8", UTM33, "swapped"),
        ("179.5,10,180.5,11", UTM33, "antimeridian"),
        ("11.5,48.1,11.6,48.2", None, "0.1 m x 0.1 m .*degrees for a pack in local metres"),
        ("-10,30,40,60", UTM33, "from 1 m to 2000 km"),
    ],
)
def test_boxes_that_cannot_be_meant(spec, crs, message):
    with pytest.raises((ConfigError, MapError), match=message):
        read_area(spec, None).on_map(crs)


def test_the_corridor_is_a_full_width_in_true_metres(tmp_path):
    """Against distances on the ellipsoid, 4.7 degrees off the central meridian where a map metre is 0.27 % long."""
    line = [[13.70, 51.05], [13.72, 51.06], [13.75, 51.05]]
    area = read_area(geojson(tmp_path, "LineString", line), 300.0).on_map(UTM32)
    grid = grid_over(area.bounds, 15.0)
    lon, lat = pyproj.Transformer.from_crs(UTM32, "OGC:CRS84", always_xy=True).transform(*centres(grid).T)
    # Tangent plane at the line's middle: good to centimetres over its 4 km.
    azimuth, _, distance = GEOD.inv(np.full(len(lon), 13.72), np.full(len(lon), 51.055), lon, lat)
    points = distance[:, None] * np.stack([np.sin(np.deg2rad(azimuth)), np.cos(np.deg2rad(azimuth))], axis=-1)
    corners = []
    for x, y in line:
        turn, _, reach = GEOD.inv(13.72, 51.055, x, y)
        corners.append((reach * np.sin(np.deg2rad(turn)), reach * np.cos(np.deg2rad(turn))))
    away = np.full(len(points), np.inf)
    for a, b in zip(np.array(corners[:-1]), np.array(corners[1:]), strict=True):
        share = np.clip((points - a) @ (b - a) / ((b - a) @ (b - a)), 0.0, 1.0)
        away = np.minimum(away, np.linalg.norm(a + share[:, None] * (b - a) - points, axis=1))
    mask = area.mask(grid).ravel()
    assert mask[away < 149.0].all()
    assert not mask[away > 151.0].any()


def test_routes_have_a_default_corridor_and_a_plan_covers_its_survey(tmp_path):
    given_files = {"m.plan": mission(), "r.kml": KML, "w.waypoints": WAYPOINTS}
    for name, content in given_files.items():
        area = read_area(str(written(tmp_path / name, content)), None).on_map(UTM33)
        start = map_from_lonlat([(13.70, 51.05)], UTM33, "start")[0]
        for aside, inside in ((0.45 * DEFAULT_CORRIDOR_M, True), (0.55 * DEFAULT_CORRIDOR_M, False)):
            assert area.meets((start[0] - 1, start[1] - aside - 1, start[0] + 1, start[1] - aside)) == inside
    plan_area = read_area(str(tmp_path / "m.plan"), 10.0).on_map(UTM33)
    middle = map_from_lonlat([(13.703, 51.054)], UTM33, "middle")[0]
    assert plan_area.meets((*(middle - 1), *(middle + 1)))


def test_holes_of_polygons_stay_out(tmp_path):
    area = read_area(str(written(tmp_path / "r.kml", KML)), 10.0).on_map(UTM33)
    hole = map_from_lonlat([(13.705, 51.055)], UTM33, "hole")[0]
    field = map_from_lonlat([(13.708, 51.058)], UTM33, "field")[0]
    for place, inside in ((hole, False), (field, True)):
        bounds = (*(place - 5), *(place + 5))
        assert area.meets(bounds) == inside
        assert area.mask(grid_over(bounds, 1.0)).all() == inside
        assert area.mask(grid_over(bounds, 1.0)).any() == inside


def test_parts_on_both_sides_of_a_zone_border_are_one_area(tmp_path):
    west = [[[11.98, 51.0], [12.0, 51.0], [12.0, 51.02], [11.98, 51.02], [11.98, 51.0]]]
    east = [[[12.0, 51.0], [12.02, 51.0], [12.02, 51.02], [12.0, 51.02], [12.0, 51.0]]]
    spec = geojson(tmp_path, "MultiPolygon", [west, east])
    whole = read_area("11.98,51.0,12.02,51.02", None)
    for crs in (UTM32, UTM33):
        area, box = read_area(spec, None).on_map(crs), whole.on_map(crs)
        grid = grid_over(box.bounds, 9.0)
        assert (area.mask(grid) != box.mask(grid)).mean() < 1e-4


def test_an_area_cut_at_the_antimeridian_lies_together(tmp_path):
    west = [[[179.9, -17.1], [180.0, -17.1], [180.0, -17.0], [179.9, -17.0]]]
    east = [[[-180.0, -17.1], [-179.9, -17.1], [-179.9, -17.0], [-180.0, -17.0]]]
    for coordinates in ([west, east], [[[[179.9, -17.1], [-179.9, -17.1], [-179.9, -17.0], [179.9, -17.0]]]]):
        west_m, _, east_m, _ = (
            read_area(geojson(tmp_path, "MultiPolygon", coordinates), None).on_map("EPSG:32760").bounds
        )
        assert east_m - west_m == pytest.approx(21_300, abs=400)


def test_a_geojson_in_metres_of_another_system_is_honoured(tmp_path):
    named = {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::25833"}}
    square = [[[410000, 5655000], [411000, 5655000], [411000, 5656000], [410000, 5656000]]]
    spec = geojson(tmp_path, "Polygon", square, crs=named)
    assert read_area(spec, None).on_map(UTM33).bounds == (410000, 5655000, 411000, 5656000)
    back = pyproj.Transformer.from_crs(UTM33, UTM32, always_xy=True).transform(410000, 5655000)
    assert min(np.linalg.norm(read_area(spec, None).on_map(UTM32).polygons[0][0] - back, axis=1)) < 1e-6
    with pytest.raises(ConfigError, match="local metres"):
        read_area(spec, None).on_map(None)


def test_a_corridor_without_a_line_is_refused(tmp_path):
    square = [[[13.7, 51.0], [13.8, 51.0], [13.8, 51.1]]]
    for spec in ("13.7,51.0,13.8,51.1", geojson(tmp_path, "Polygon", square)):
        with pytest.raises(ConfigError, match="no line to go along"):
            read_area(spec, 100.0)
    for width in (0.0, -5.0, float("nan"), 1e9):
        with pytest.raises(ConfigError, match="full width in metres"):
            read_area(geojson(tmp_path, "LineString", [[13.7, 51.0], [13.8, 51.0]]), width)


def test_places_the_map_cannot_show_are_named(tmp_path):
    spec = geojson(tmp_path, "LineString", [[-60.0, 0.0], [-60.0, 0.01]])
    with pytest.raises(MapError, match=r"a\.geojson: around \(-60\.00, 0\.01\), cannot be shown in ETRF2000-PL"):
        read_area(spec, None).on_map("EPSG:2180")


coordinate = st.floats(-50, 50).map(lambda v: round(v, 2))
point = st.tuples(coordinate, coordinate)


@given(st.lists(point, min_size=1, max_size=5), st.floats(0.5, 30), point, st.floats(0.5, 30))
def test_meets_and_mask_agree_for_strips(line, half_width, corner, side):
    area = MapArea((), (Strip(np.array(line), half_width),))
    _agree(area, corner, side)


@given(st.lists(point, min_size=3, max_size=6, unique=True), point, st.floats(0.5, 30))
def test_meets_and_mask_agree_for_polygons(ring, corner, side):
    hole = np.array(ring).mean(axis=0) + np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])
    _agree(MapArea(((np.array(ring), hole),), ()), corner, side)


def _agree(area, corner, side):
    """A box met by the mask is met; one that is not met holds no pixel of the mask."""
    bounds = (corner[0], corner[1], corner[0] + side, corner[1] + side)
    mask = area.mask(RasterGrid(64, 64, corner[0], corner[1] + side, side / 64, -side / 64))
    if mask.any():
        assert area.meets(bounds)
    if not area.meets(bounds):
        assert not mask.any()
    whole = area.bounds
    assert area.meets(whole)


@given(st.lists(point, min_size=1, max_size=4), st.floats(1, 20))
def test_a_strip_is_what_lies_within_its_half_width(line, half_width):
    strip = Strip(np.array(line), half_width)
    grid = RasterGrid(80, 80, -60, 60, 1.5, -1.5)
    points = centres(grid)
    away = np.full(len(points), np.inf)
    for a, b in strip.segments:
        length = max(float((b - a) @ (b - a)), 1e-12)
        share = np.clip((points - a) @ (b - a) / length, 0.0, 1.0)
        away = np.minimum(away, np.linalg.norm(a + share[:, None] * (b - a) - points, axis=1))
    mask = MapArea((), (strip,)).mask(grid).ravel()
    assert mask[away < half_width - 0.1].all()
    assert not mask[away > half_width + 0.01].any()
