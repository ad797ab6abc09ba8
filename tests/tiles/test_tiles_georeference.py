import csv
import subprocess
import sys
import textwrap
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import packs
import pyproj
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tile_rasters import SHARED

from ortholoc_edge.errors import ConfigError, MapError
from ortholoc_edge.geometry import rotation
from ortholoc_edge.geometry.frames import ecef_from_geodetic, map_from_ned_rotation, ned_from_ecef_rotation
from ortholoc_edge.geometry.rigid import Rigid3
from ortholoc_edge.tiles.georeference import Georeference, HeightOffsets, LocalFrame, VerticalDatum
from ortholoc_edge.tiles.systems import datum_shift_caveat, require_way_to_wgs84
from ortholoc_edge.tiles.vertical import derive_offsets

ELLIPSOIDAL = VerticalDatum(kind="ellipsoid", ellipsoid_minus_map_m=0.0, amsl_minus_map_m=-47.5)
UNKNOWN = VerticalDatum(kind="unknown")
WGS84 = pyproj.Geod(ellps="WGS84")

# Central meridian, zone edge, beyond it, both hemispheres, high latitude, other projections.
PLACES = [
    ("EPSG:32633", 48.0, 15.0),
    ("EPSG:32633", 48.0, 18.0),
    ("EPSG:32633", 48.0, 11.5),
    ("EPSG:32633", 80.0, 18.5),
    ("EPSG:32633", 80.0, 11.0),
    ("EPSG:32733", -45.0, 17.9),
    ("EPSG:32733", -79.5, 12.0),
    ("EPSG:32617", 41.0, -83.3),
    ("EPSG:2056", 46.2, 6.1),
    ("EPSG:2154", 43.5, 7.2),
    ("EPSG:3413", 75.0, -20.0),
    ("EPSG:25832", 54.5, 8.5),
]


def derive_vertical(kind, epsg, undulation_m, place):
    """The datum at one place."""
    return derive_offsets(kind, epsg, undulation_m, None if place is None else [place])[0]


def georeference(crs, lat, lon, vertical=ELLIPSOIDAL):
    anchor = pyproj.Transformer.from_crs("EPSG:4326", crs, always_xy=True).transform(lon, lat)
    return Georeference(crs, vertical, anchor)


@pytest.mark.parametrize(("crs", "lat", "lon"), PLACES)
def test_convergence_is_the_turn_from_a_geodesic_north_to_grid_north(crs, lat, lon):
    reference = georeference(crs, lat, lon)
    ahead, behind = (WGS84.fwd(lon, lat, azimuth, 50.0)[:2] for azimuth in (0.0, 180.0))
    north = reference.map_from_geodetic(ahead[1], ahead[0], height_ellipsoid_m=0.0)
    south = reference.map_from_geodetic(behind[1], behind[0], height_ellipsoid_m=0.0)
    east, up = (north - south)[:2]
    yaw_grid_of_true_north = np.arctan2(east, up)

    convergence = reference.convergence_rad(reference.anchor)

    # A datum shift (CH1903+) turns the meridian by 2 arc seconds.
    assert np.isclose(yaw_grid_of_true_north, -convergence, atol=1.5e-5)
    # And the rotation that the geometry builds of it.
    turned = map_from_ned_rotation(convergence) @ (1.0, 0.0, 0.0)
    assert np.allclose(turned[:2], (north - south)[:2] / np.hypot(east, up), atol=1.5e-5)


@pytest.mark.parametrize(("crs", "lat", "lon"), PLACES)
def test_scale_convergence_and_position_agree_with_pyproj(crs, lat, lon):
    reference = georeference(crs, lat, lon)
    factors = pyproj.Proj(crs).get_factors(lon, lat)
    # The factors are those on the system's own ellipsoid; a datum shift (CH1903+: 2 arc seconds) is not in them. Beside
    # it there are the differences' rounding and curvature, 1e-9, and a hundred times that is asked.
    shifted = crs == "EPSG:2056"
    convergence = np.deg2rad(factors.meridian_convergence)
    assert reference.convergence_rad(reference.anchor) == pytest.approx(convergence, abs=1.5e-5 if shifted else 1e-7)
    scale = np.sqrt(factors.meridional_scale * factors.parallel_scale)
    assert reference.grid_scale(reference.anchor, 0.0) == pytest.approx(scale, rel=1.5e-5 if shifted else 1e-7)
    lon_lat = pyproj.Transformer.from_crs(crs, "EPSG:4326", always_xy=True).transform(*reference.anchor)
    at = reference.geodetic_from_map((*reference.anchor, 0.0))
    # 1e-8 degrees are a millimetre.
    assert (at.lon_deg, at.lat_deg) == pytest.approx(lon_lat, abs=1e-8)


def test_every_position_without_an_image_is_an_error_and_the_next_one_is_not():
    """GDAL stops reporting after twenty failures of one transformation."""
    reference = georeference("EPSG:32633", 48.0, 15.0)
    for _ in range(30):
        with pytest.raises(MapError, match="outside the domain"):
            reference.geodetic_from_map((1e9, 1e9, 0.0))
        with pytest.raises(MapError, match="outside the domain"):
            reference.map_from_geodetic(91.0, 15.0, height_amsl_m=0.0)
        with pytest.raises(MapError, match="outside the domain"):
            reference.convergence_rad((np.nan, 5e6))
    assert reference.geodetic_from_map((500_000.0, 5_000_000.0, 0.0)).lon_deg == pytest.approx(15.0)


def test_several_threads_get_the_same_positions():
    reference = georeference("EPSG:32633", 48.0, 15.0)
    places = [(400_000.0 + 1000.0 * k, 5_300_000.0 + 500.0 * k) for k in range(100)]
    alone = [(reference.geodetic_from_map((*at, 0.0)), reference.convergence_rad(at)) for at in places]
    with ThreadPoolExecutor(4) as pool:
        many = list(
            pool.map(lambda at: (reference.geodetic_from_map((*at, 0.0)), reference.convergence_rad(at)), places * 4)
        )
    assert many == alone * 4


def test_a_datum_that_nobody_knows_is_refused_by_a_build():
    """GDAL would take it for WGS 84."""
    crs = "+proj=utm +zone=33 +a=6378000 +b=6356000 +units=m +type=crs"
    with pytest.raises(MapError, match=r"no way to WGS 84.*EPSG:32633"):
        require_way_to_wgs84(crs, (45.0, 15.0))
    require_way_to_wgs84("EPSG:31467", (49.6, 9.0))


@pytest.mark.parametrize("name", ["seneca", "caliterra", "copr"])
def test_convergence_agrees_with_the_real_flights(name):
    path = SHARED / name / f"{name}_flight.csv"
    if not path.is_file():
        pytest.skip(f"{path} is not here")
    epsg = {"seneca": 32617, "caliterra": 32614, "copr": 32611}[name]
    with path.open() as file:
        rows = list(csv.DictReader(file))
    for row in rows:
        xy = float(row["utm_e"]), float(row["utm_n"])
        convergence_deg = np.rad2deg(Georeference(f"EPSG:{epsg}", UNKNOWN, xy).convergence_rad(xy))
        yaw_grid_deg = float(row["yaw_true_deg"]) - convergence_deg
        assert abs((yaw_grid_deg - float(row["yaw_grid_deg"]) + 180) % 360 - 180) < 0.002


@pytest.mark.parametrize(("crs", "lat", "lon"), PLACES)
@pytest.mark.parametrize("height_m", [0.0, 2800.0])
def test_local_frame_measures_true_metres(crs, lat, lon, height_m):
    reference = georeference(crs, lat, lon)
    frame = reference.local_frame(reference.anchor, height_m)
    start = np.array([*reference.anchor, height_m])
    for step in ((200.0, 0.0, 0.0), (0.0, 200.0, 0.0), (120.0, -160.0, 30.0)):
        end = frame.map_from_local(frame.local_from_map(start) + step)
        ecef = []
        for point in (start, end):
            at = reference.geodetic_from_map(point)
            ecef.append(ecef_from_geodetic(np.deg2rad(at.lat_deg), np.deg2rad(at.lon_deg), at.height_ellipsoid_m))
        # 2 mm of 200 m: the scale changes along the line, and the Earth's radius with the place.
        assert np.linalg.norm(ecef[1] - ecef[0]) == pytest.approx(np.linalg.norm(step), abs=2e-3)


@pytest.mark.parametrize(("crs", "lat", "lon"), PLACES)
def test_a_vector_turned_by_convergence_agrees_with_the_tangent_plane(crs, lat, lon):
    reference = georeference(crs, lat, lon)
    start = np.array([*reference.anchor, 100.0])
    frame = reference.local_frame(start[:2], 100.0)
    offset_ned = np.array([60.0, -80.0, -10.0])
    offset_map = map_from_ned_rotation(reference.convergence_rad(start[:2])) @ offset_ned
    end = frame.map_from_local(frame.local_from_map(start) + offset_map)

    a, b = (reference.geodetic_from_map(point) for point in (start, end))
    radians = np.deg2rad([a.lat_deg, a.lon_deg])
    ecef = [ecef_from_geodetic(np.deg2rad(p.lat_deg), np.deg2rad(p.lon_deg), p.height_ellipsoid_m) for p in (a, b)]
    assert np.allclose(ned_from_ecef_rotation(*radians) @ (ecef[1] - ecef[0]), offset_ned, atol=5e-3)


@given(
    easting=st.floats(100_000, 900_000),
    northing=st.floats(0, 9_300_000),
    height=st.floats(-400, 9000),
)
def test_geodetic_round_trip(easting, northing, height):
    reference = Georeference("EPSG:32633", ELLIPSOIDAL, (500_000.0, 5_000_000.0))
    at = reference.geodetic_from_map((easting, northing, height))
    by_ellipsoid = reference.map_from_geodetic(at.lat_deg, at.lon_deg, height_ellipsoid_m=at.height_ellipsoid_m)
    by_amsl = reference.map_from_geodetic(at.lat_deg, at.lon_deg, height_amsl_m=at.height_amsl_m)
    assert np.allclose(by_ellipsoid, (easting, northing, height), rtol=0, atol=1e-5)
    assert np.allclose(by_amsl, by_ellipsoid, rtol=0, atol=1e-9)


@given(
    origin=st.tuples(st.floats(-1e7, 1e7), st.floats(-1e7, 1e7)),
    scale=st.floats(0.99, 1.01),
    offsets=st.lists(st.tuples(*[st.floats(-1e4, 1e4)] * 3), min_size=1, max_size=5),
    angles=st.tuples(*[st.floats(-3, 3)] * 3),
)
def test_local_frame_round_trip(origin, scale, offsets, angles):
    frame = LocalFrame(*origin, scale)
    points = np.add(offsets, (*origin, 0.0))
    there = frame.local_from_map(points)
    assert np.allclose(frame.map_from_local(there), points, rtol=0, atol=1e-6)
    assert np.array_equal(there[:, 2], points[:, 2])

    pose = Rigid3(rotation.from_euler(*angles), points[0])
    local = frame.local_from_map_pose(pose)
    assert np.array_equal(local.rotation, pose.rotation)
    assert np.allclose(frame.map_from_local_pose(local).translation, points[0], rtol=0, atol=1e-6)


def test_local_frame_leaves_its_argument_alone():
    points = np.ones((2, 3))
    LocalFrame(10.0, 20.0, 2.0).local_from_map(points)
    assert np.array_equal(points, np.ones((2, 3)))


def test_local_metres_have_no_geodetic_position():
    reference = Georeference(None, UNKNOWN, (0.0, 0.0))
    assert reference.convergence_rad((5.0, 5.0)) == 0.0
    assert reference.grid_scale((5.0, 5.0), 300.0) == 1.0
    with pytest.raises(MapError, match="a_srs"):
        reference.geodetic_from_map((0.0, 0.0, 0.0))
    with pytest.raises(MapError, match="without a CRS"):
        reference.map_from_geodetic(48.0, 10.0, height_amsl_m=0.0)


@pytest.mark.parametrize(
    ("crs", "anchor", "message"),
    [
        ("EPSG:4326", (11.0, 48.0), "geographic"),
        ("EPSG:2225", (2e6, 5e5), "US survey foot"),
        ("EPSG:4978", (4e6, 1e6), "not a projected"),
        ("EPSG:5070", (-1e6, 1.5e6), "not conformal"),
        ("EPSG:3857", (1e6, 6e6), "not conformal.*EPSG:32631|not conformal.*EPSG:32632"),
        ("EPSG:3035", (4.0e6, 2.5e6), "not conformal"),
        ("EPSG:5513", (6e5, 1.1e6), "westward"),
        ("EPSG:999999", (0.0, 0.0), "not understood"),
        ("EPSG:32633", (1e9, 1e9), "outside the domain"),
    ],
)
def test_unusable_systems_are_refused(crs, anchor, message):
    with pytest.raises(MapError, match=message):
        Georeference(crs, UNKNOWN, anchor)


def test_compound_and_wkt_systems_are_read():
    wkt = pyproj.CRS("EPSG:25832+7837").to_wkt()
    reference = Georeference(wkt, UNKNOWN, (500_000.0, 5_300_000.0))
    at = reference.geodetic_from_map((500_000.0, 5_300_000.0, 10.0))
    assert at.lon_deg == pytest.approx(9.0)
    assert at.height_amsl_m is None
    assert at.height_ellipsoid_m is None


def test_unknown_heights_are_refused_with_the_remedy():
    for convert in (UNKNOWN.amsl_from_map, UNKNOWN.map_from_ellipsoid):
        with pytest.raises(MapError, match="--geoid-undulation-m"):
            convert(100.0)
    with pytest.raises(MapError, match="--vertical"):
        georeference("EPSG:32633", 48.0, 15.0, UNKNOWN).map_from_geodetic(48.0, 15.0, height_amsl_m=5.0)


def test_map_from_geodetic_takes_one_height():
    reference = georeference("EPSG:32633", 48.0, 15.0)
    with pytest.raises(ValueError, match="exactly one"):
        reference.map_from_geodetic(48.0, 15.0)


def test_stated_undulation_moves_heights_the_right_way():
    # Geoid 47 m above the ellipsoid: a point at 500 m above the ellipsoid lies 453 m above the sea.
    ellipsoidal = derive_vertical("ellipsoid", None, 47.0, (48.0, 10.0))
    assert ellipsoidal.amsl_from_map(500.0) == 453.0
    assert ellipsoidal.ellipsoid_from_map(500.0) == 500.0
    orthometric = derive_vertical("orthometric", None, 47.0, (48.0, 10.0))
    assert orthometric.amsl_from_map(453.0) == 453.0
    assert orthometric.ellipsoid_from_map(453.0) == 500.0


def test_missing_geoid_grid_is_no_silent_zero(caplog):
    """PROJ leaves heights alone where the grid is missing; that must be refused then, or said, and not be 0."""
    for place in ((48.0, 10.0), None):
        with pytest.raises(
            ConfigError, match=r"--geoid-undulation-m METRES.*us_nga_egm96_15\.tif.*PROJ_DATA.*projsync"
        ):
            derive_vertical("ellipsoid", None, None, place)
    national = derive_vertical("orthometric", 7837, None, (48.0, 10.0))
    assert national.ellipsoid_minus_map_m is None
    assert national.amsl_minus_map_m == 0.0
    assert "about 1 m" in national.derivation
    assert "DHHN2016 height: PROJ has no geoid grid" in caplog.text
    assert "good to 1 m" in caplog.text
    caplog.clear()
    derive_vertical("orthometric", 5773, None, (48.0, 10.0))
    assert caplog.text == ""  # EGM96's own heights are exact


@pytest.mark.parametrize(
    ("kind", "epsg", "undulation_m", "sigma_m"),
    [
        ("ellipsoid", None, 47.0, 0.0),
        ("orthometric", 5773, None, 0.0),
        ("orthometric", None, None, 1.0),
        ("orthometric", 7837, 47.0, 1.0),  # the stated undulation says nothing of its zero against EGM96's
        ("orthometric", 5703, None, 2.0),
        ("unknown", None, None, None),
    ],
)
def test_error_of_the_way_to_sea_level(kind, epsg, undulation_m, sigma_m):
    vertical = derive_vertical(kind, epsg, undulation_m, (48.0, 10.0))
    assert vertical.amsl_sigma_m == sigma_m
    assert (vertical.amsl_sigma_m is None) == (vertical.amsl_minus_map_m is None)
    assert Georeference(None, vertical, (0.0, 0.0)).vertical.amsl_sigma_m == sigma_m


@pytest.mark.parametrize(
    ("arguments", "kind", "message"),
    [
        (("unknown", None, 47.0), ConfigError, "--vertical"),
        (("unknown", 5773, None), ConfigError, "--vertical"),
        (("ellipsoid", 5773, None), ConfigError, "orthometric"),
        (("ellipsoid", None, 470.0), ConfigError, "120"),
        (("ellipsoid", None, float("nan")), ConfigError, "120"),
        (("orthometric", 32633, None), MapError, "no vertical system"),
        (("orthometric", 6360, None), MapError, "foot"),
    ],
)
def test_contradicting_heights_are_refused(arguments, kind, message):
    with pytest.raises(kind, match=message):
        derive_vertical(*arguments, (48.0, 10.0))


def test_geoid_grid_is_used_where_proj_has_it(tmp_path):
    """In a process of its own, since PROJ's data directories are the process's."""
    script = f"""
    import numpy as np, pyproj.datadir, rasterio
    from affine import Affine
    from ortholoc_edge.errors import ConfigError
    from ortholoc_edge.tiles.vertical import derive_offsets

    def derive_vertical(kind, epsg, undulation_m, place):
        return derive_offsets(kind, epsg, undulation_m, [place])[0]

    profile = dict(driver="GTiff", width=13, height=13, count=1, dtype="float32", crs="EPSG:4326",
                   transform=Affine(.25, 0, 8.375, 0, -.25, 49.625))
    with rasterio.open(r"{tmp_path}/us_nga_egm96_15.tif", "w", **profile) as grid:
        # Rises eastward by 0.4 m per cell; 47.5 m at 10 degrees east.
        grid.write(np.tile(47.5 + 0.4 * (np.arange(13) - 6), (13, 1)).astype("float32"), 1)
        grid.update_tags(TYPE="VERTICAL_OFFSET_GEOGRAPHIC_TO_VERTICAL", AREA_OR_POINT="Point")
        grid.set_band_description(1, "geoid_undulation")
        grid.update_tags(1, positive_value="up", target_crs_epsg_code="5773")
    pyproj.datadir.append_data_dir(r"{tmp_path}")
    inside = derive_vertical("ellipsoid", None, None, (48.2, 10.0))
    assert abs(inside.amsl_minus_map_m + 47.5) < 1e-3 and inside.amsl_sigma_m == 0.1, inside
    egm96 = derive_vertical("orthometric", 5773, None, (48.2, 10.0))
    assert egm96.amsl_sigma_m == 0.0, egm96
    assert abs(egm96.ellipsoid_minus_map_m - 47.5) < 1e-3 and abs(egm96.amsl_minus_map_m) < 1e-3, egm96
    places = [(48.2, 10.0), (48.2, 10.25), (48.4, 9.5)]
    datum, amsl, ellipsoid = derive_offsets("ellipsoid", None, None, places)
    assert abs(datum.amsl_minus_map_m + 47.5) < 1e-3, datum
    assert np.allclose(amsl, [-47.5, -47.9, -46.7], atol=1e-3) and (ellipsoid == 0).all(), amsl
    datum, amsl, ellipsoid = derive_offsets("orthometric", 5773, None, places)
    assert np.allclose(ellipsoid, [47.5, 47.9, 46.7], atol=1e-3) and np.allclose(amsl, 0, atol=1e-3), ellipsoid
    # A geoid that covers the area in part would give it a step.
    for out_of_grid in ([(20.0, 10.0)], [(48.2, 10.0), (20.0, 10.0)]):
        try:
            derive_offsets("ellipsoid", None, None, out_of_grid)
        except ConfigError as err:
            assert "--geoid-undulation-m" in str(err)
        else:
            raise AssertionError("an unknown geoid passed")
    try:
        derive_vertical("ellipsoid", None, -47.5, (48.2, 10.0))
    except ConfigError as err:
        assert "+47.50" in str(err)
    else:
        raise AssertionError("a wrong sign passed")
    """
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", textwrap.dedent(script)],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == 0, done.stderr


def test_stated_undulation_holds_everywhere():
    places = [(48.0, 10.0), (48.5, 10.5)]
    datum, amsl, ellipsoid = derive_offsets("ellipsoid", None, 47.0, places)
    assert (datum.amsl_minus_map_m, datum.ellipsoid_minus_map_m) == (-47.0, 0.0)
    assert (amsl.tolist(), ellipsoid.tolist()) == ([-47.0, -47.0], [0.0, 0.0])
    datum, amsl, ellipsoid = derive_offsets("orthometric", 5773, 47.0, places)
    assert (amsl.tolist(), ellipsoid.tolist()) == ([0.0, 0.0], [47.0, 47.0])
    assert derive_offsets("orthometric", 5773, None, places)[2] is None
    assert derive_offsets("orthometric", 5773, 47.0, None)[1:] == (None, None)
    assert derive_offsets("unknown", None, None, places)[1:] == (None, None)


# -- offsets by place ----------------------------------------------------------------------------------

SIDE_M = 800.0


def offsets_of(amsl, ellipsoid=None):
    return HeightOffsets(400_000.0, 5_400_000.0, SIDE_M, amsl, ellipsoid or {})


def slope(column, row):
    return -47.0 + 0.03 * column - 0.02 * row


def test_offsets_are_bilinear_between_the_centres_of_tiles():
    offsets = offsets_of({(c, r): slope(c, r) for c in range(5) for r in range(4)})
    rng = np.random.default_rng(0)
    for column, row in rng.uniform((0, 0), (4, 3), (50, 2)):
        x, y = 400_000.0 + (column + 0.5) * SIDE_M, 5_400_000.0 - (row + 0.5) * SIDE_M
        assert offsets.amsl_minus_map_m(x, y) == pytest.approx(slope(column, row), abs=1e-9)
        assert offsets.ellipsoid_minus_map_m(x, y) is None


@settings(max_examples=100, deadline=None)
@given(
    start=st.tuples(st.floats(-0.9, 5.9), st.floats(-0.9, 5.9)),
    heading=st.floats(0, 6.28),
    keys=st.sets(st.tuples(st.integers(0, 4), st.integers(0, 4)), min_size=1),
)
def test_offsets_have_no_steps_over_the_tiles(start, heading, keys):
    """Along any line, as long as it is over a tile: with holes in the pack, and at its rim."""
    offsets = offsets_of({key: float(np.sin(3.0 * key[0] + 7.0 * key[1])) for key in keys})
    along = np.arange(0.0, 3.0, 1e-3)
    columns, rows = start[0] + along * np.cos(heading), start[1] + along * np.sin(heading)
    over = np.array([(int(np.floor(c)), int(np.floor(r))) in keys for c, r in zip(columns, rows, strict=True)])
    values = np.array(
        [
            offsets.amsl_minus_map_m(400_000.0 + c * SIDE_M, 5_400_000.0 - r * SIDE_M)
            for c, r in zip(columns, rows, strict=True)
        ]
    )
    assert ((values >= -1.0) & (values <= 1.0)).all()
    steps = np.abs(np.diff(values))[over[1:] & over[:-1]]
    # 0.8 m of way between offsets that differ by 2 m over 800 m, by a quarter of the weight at worst.
    assert steps.max(initial=0.0) < 0.02


def test_beyond_all_tiles_the_nearest_counts():
    offsets = offsets_of({(0, 0): 1.0, (3, 0): 4.0})
    assert offsets.amsl_minus_map_m(400_000.0 - 50_000.0, 5_400_000.0) == 1.0
    assert offsets.amsl_minus_map_m(400_000.0 + 50_000.0, 5_500_000.0) == 4.0
    assert offsets.amsl_minus_map_m(400_000.0 + 1.4 * SIDE_M, 5_300_000.0) == 1.0


def test_heights_use_the_offset_of_the_place():
    x, y = 400_000.0 + 0.5 * SIDE_M, 5_400_000.0 - 0.5 * SIDE_M
    offsets = offsets_of({(0, 0): -47.0, (1, 0): -48.0}, {(0, 0): 0.25, (1, 0): 0.25})
    reference = Georeference("EPSG:32633", ELLIPSOIDAL, (x, y), offsets)
    for east, offset in ((0.0, -47.0), (SIDE_M, -48.0), (SIDE_M / 2, -47.5), (9e4, -48.0)):
        place = reference.geodetic_from_map((x + east, y, 500.0))
        assert place.height_amsl_m == pytest.approx(500.0 + offset)
        assert place.height_ellipsoid_m == pytest.approx(500.25)
        for heights in ({"height_amsl_m": place.height_amsl_m}, {"height_ellipsoid_m": place.height_ellipsoid_m}):
            back = reference.map_from_geodetic(place.lat_deg, place.lon_deg, **heights)
            assert np.allclose(back, (x + east, y, 500.0), rtol=0, atol=1e-5)
    # Where no tile says anything, what holds for the pack as a whole does.
    plain = Georeference("EPSG:32633", ELLIPSOIDAL, (x, y), offsets_of({}))
    assert plain.geodetic_from_map((x, y, 500.0)).height_amsl_m == 500.0 - 47.5
    assert plain.amsl_minus_map_m((x, y)) == -47.5


def test_a_pack_carries_its_offsets(tmp_path):
    """Through the manifest: the tile's own, and between two tiles the mean."""
    rgb, heights = np.zeros((3, 512, 512), dtype=np.uint8), np.zeros((128, 256), dtype=np.float32)
    by_tile = {(0, 0): (-0.5, 46.0), (1, 0): (-0.25, 47.0)}
    pack = packs.write_pack(
        tmp_path, rgb, heights, dop_corner=(0, 0), dsm_corner=(0, 0), offsets=by_tile,
        vertical=VerticalDatum(kind="orthometric", amsl_minus_map_m=9.0),
    )  # fmt: skip
    reference = pack.georeference
    first, second = (400_064.0, 5_299_936.0), (400_192.0, 5_299_936.0)
    assert [reference.amsl_minus_map_m(at) for at in (first, second)] == [-0.5, -0.25]
    assert reference.ellipsoid_minus_map_m((400_128.0, 5_299_930.0)) == 46.5
    assert reference.geodetic_from_map((*first, 100.0)).height_amsl_m == 99.5


def test_missing_datum_grid_is_told():
    caveat = datum_shift_caveat("EPSG:31467", (49.6, 9.0))
    assert caveat is not None
    assert "BETA2007" in caveat
    assert datum_shift_caveat("EPSG:32632", (49.6, 9.0)) is None
    assert datum_shift_caveat("EPSG:25832", (49.6, 9.0)) is None
