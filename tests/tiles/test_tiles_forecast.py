"""A pack of 256 m x 128 m: textured fields in the west, a blank level lake in the east, ground rising northward."""

import argparse
import json
import shutil
import subprocess
from dataclasses import replace

import cv2
import numpy as np
import pyproj
import pytest
import rasterio
from packs import CRS, DOP_LATTICE, VERTICAL, write_pack
from route_files import plan, simple, written

from ortholoc_edge.cli import tiles_forecast
from ortholoc_edge.errors import ConfigError, MapError
from ortholoc_edge.geometry.camera import Camera
from ortholoc_edge.tiles.drawing import Reference
from ortholoc_edge.tiles.forecast import MATCHABILITY_FILE, Cause, Verdict, View, footprint, forecast, judge, text
from ortholoc_edge.tiles.forecast_picture import picture
from ortholoc_edge.tiles.georeference import VerticalDatum
from ortholoc_edge.tiles.lattice import CROP_PX, PixelBox
from ortholoc_edge.tiles.matchability import cells
from ortholoc_edge.tiles.route import Route
from ortholoc_edge.tiles.store import MapStore

WIDTH_PX, HEIGHT_PX = 1024, 512
GROUND_M = 100.0
# Both layers start at the same place: 64 m from the corner of the lattices, in pixels of 0.25 and 1 m.
CORNERS = {"dop_corner": (256, 256), "dsm_corner": (64, 64)}
BOX = PixelBox(*CORNERS["dop_corner"], WIDTH_PX, HEIGHT_PX)
WEST, SOUTH, EAST, NORTH = DOP_LATTICE.grid(BOX).bounds
MIDDLE = (SOUTH + NORTH) / 2
CAMERA = Camera.from_focal(640, 480, 400.0)
LONLAT = pyproj.Transformer.from_crs(CRS, "OGC:CRS84", always_xy=True)


def scene():
    rng = np.random.default_rng(5)
    rgb = np.full((HEIGHT_PX, WIDTH_PX, 3), (30, 60, 80), dtype=np.uint8)
    for _ in range(1500):
        u, v = int(rng.integers(0, WIDTH_PX // 2 - 20)), int(rng.integers(0, HEIGHT_PX))
        size = rng.integers(4, 18, 2)
        shade = rng.integers(30, 255, 3).tolist()
        cv2.rectangle(rgb, (u, v), (u + int(size[0]), v + int(size[1])), shade, -1)
    heights = np.full((HEIGHT_PX // 4, WIDTH_PX // 4), GROUND_M, dtype=np.float32)
    heights[:, : WIDTH_PX // 8] += rng.uniform(0, 3, heights[:, : WIDTH_PX // 8].shape).astype(np.float32)
    return rgb, heights


def matchability_file(values):
    grid = DOP_LATTICE.grid(BOX)
    side = CROP_PX * grid.dx
    profile = {"driver": "GTiff", "count": 1, "dtype": "uint8", "crs": CRS, "nodata": 255}
    with rasterio.MemoryFile() as memory:
        transform = rasterio.Affine(side, 0, grid.west, 0, -side, grid.top)
        with memory.open(width=values.shape[1], height=values.shape[0], transform=transform, **profile) as raster:
            raster.write(values, 1)
        return memory.read()


def make(folder, *, matchability=True, **changes):
    rgb, heights = scene()
    files = {}
    if matchability:
        files[MATCHABILITY_FILE] = matchability_file(cells(rgb, np.ones(rgb.shape[:2], dtype=bool), 0.25))
    return write_pack(folder, rgb.transpose(2, 0, 1).copy(), heights, files=files, **CORNERS, **changes)


@pytest.fixture(scope="module")
def pack(tmp_path_factory):
    return make(tmp_path_factory.mktemp("lake") / "pack")


@pytest.fixture
def store(pack):
    with MapStore(pack) as opened:
        yield opened


def line_file(path, points, *altitude):
    places = [[*LONLAT.transform(x, y), *altitude] for x, y in points]
    return written(path, {"type": "LineString", "coordinates": places})


def route_of(tmp_path, points, *altitude):
    return Route.read(line_file(tmp_path / "r.geojson", points, *altitude))


def good(**changes):
    view = View(
        agl_m=60.0,
        dop_share=1.0,
        dsm_share=1.0,
        coarsening=1.0,
        dsm_cells=50.0,
        matchability=70.0,
        blank_share=0.0,
        relief_m=2.0,
    )
    return replace(view, **changes)


@pytest.mark.parametrize(
    ("changes", "verdict", "cause"),
    [
        ({}, Verdict.EXPECTED, None),
        ({"agl_m": -1.0}, Verdict.NONE, Cause.BELOW_GROUND),
        ({"dop_share": 0.0, "dsm_share": 0.0}, Verdict.NONE, Cause.OUTSIDE_MAP),
        ({"dop_share": 0.4}, Verdict.DOUBTFUL, Cause.OUTSIDE_MAP),
        ({"dsm_share": 0.1}, Verdict.NONE, Cause.NO_SURFACE),
        ({"coarsening": 3.5}, Verdict.NONE, Cause.TOO_COARSE),
        ({"coarsening": 2.5}, Verdict.DOUBTFUL, Cause.TOO_COARSE),
        ({"dsm_cells": 3.0}, Verdict.DOUBTFUL, Cause.TOO_COARSE),
        ({"matchability": 30.0}, Verdict.DOUBTFUL, Cause.LOW_TEXTURE),
        ({"matchability": 10.0}, Verdict.NONE, Cause.LOW_TEXTURE),
        ({"matchability": 10.0, "blank_share": 0.9}, Verdict.NONE, Cause.LOW_TEXTURE),
        ({"matchability": 2.0, "blank_share": 0.9, "relief_m": 0.02}, Verdict.NONE, Cause.WATER),
        ({"matchability": None}, Verdict.DOUBTFUL, Cause.UNKNOWN_TEXTURE),
        # Too little of the map weighs more than too little texture on it, and both less than none at all.
        ({"matchability": 30.0, "dop_share": 0.1}, Verdict.NONE, Cause.OUTSIDE_MAP),
        ({"matchability": 30.0, "dop_share": 0.4}, Verdict.DOUBTFUL, Cause.LOW_TEXTURE),
    ],
)
def test_judgements(changes, verdict, cause):
    assert judge(good(**changes)) == (verdict, cause)


def test_the_footprint_turns_with_the_leg_and_grows_with_the_height():
    ring = footprint(CAMERA, np.array([10.0, 20.0]), np.array([0.0, 3.0]), 100.0)
    # 640 x 480 px at 400 px: 160 m x 120 m from 100 m; the image's top left is in the north-west.
    assert ring - (10, 20) == pytest.approx(np.array([(-80, 60), (80, 60), (80, -60), (-80, -60)]))
    ring = footprint(CAMERA, np.array([10.0, 20.0]), np.array([5.0, 0.0]), 50.0)
    # Eastward, the top of the picture is in the east and its left in the north.
    assert ring - (10, 20) == pytest.approx(np.array([(30, 40), (30, -40), (-30, -40), (-30, 40)]))


def test_fixes_are_expected_over_fields_and_not_over_the_lake(tmp_path, store):
    route = route_of(tmp_path, [(WEST - 150, MIDDLE), (EAST, MIDDLE)])
    result = forecast(route, store, CAMERA, agl_m=60.0, working_px=640)
    assert result.notes == ()
    east = pyproj.Transformer.from_crs("OGC:CRS84", CRS, always_xy=True).transform(*result.samples.lonlat.T)[0]
    shore = (WEST + EAST) / 2
    judged = dict(zip(np.round(east, 3), zip(result.verdicts, result.causes, strict=True), strict=True))
    for place, (verdict, cause) in judged.items():
        if place < WEST - 40:
            assert (verdict, cause) == (Verdict.NONE, Cause.OUTSIDE_MAP)
        elif WEST + 40 < place < shore - 40:
            assert (verdict, cause) == (Verdict.EXPECTED, None)
        elif shore + 30 < place < EAST - 40:
            assert (verdict, cause) == (Verdict.NONE, Cause.WATER)
    assert {Verdict.EXPECTED, Verdict.NONE} <= set(result.verdicts)
    assert sum(s.length_m for s in result.stretches) == pytest.approx(route.length_m, abs=1e-6)
    # Stretches follow one another without gaps.
    for a, b in zip(result.stretches, result.stretches[1:], strict=False):
        assert a.lonlat[-1] == pytest.approx(b.lonlat[0], abs=1e-9)
    facts = result.facts(10.0)
    assert facts["none_m"] + facts["doubtful_m"] + facts["expected_m"] == pytest.approx(facts["length_m"], abs=0.3)
    assert 100 < facts["longest_gap_m"] < 160
    assert facts["longest_gap_s"] == pytest.approx(facts["longest_gap_m"] / 10, abs=0.1)
    assert facts["longest_without_expected_m"] >= facts["longest_gap_m"]
    assert "10 m/s" in text(result, 10.0)
    assert "water" in text(result, None)


def test_a_pack_without_matchability_expects_nothing_and_says_why(tmp_path):
    with MapStore(make(tmp_path / "pack", matchability=False)) as store:
        route = route_of(tmp_path, [(WEST + 50, MIDDLE), (WEST + 90, MIDDLE)])
        result = forecast(route, store, CAMERA, agl_m=60.0, working_px=640)
    assert set(result.causes) == {Cause.UNKNOWN_TEXTURE}
    assert "matchability" in result.notes[0]
    assert result.facts(None)["expected_m"] == 0


def test_low_flight_is_too_coarse_unless_the_working_size_is_small(tmp_path, store):
    route = route_of(tmp_path, [(WEST + 50, MIDDLE), (WEST + 90, MIDDLE)])
    low = forecast(route, store, CAMERA, agl_m=30.0, working_px=640)
    # 0.25 m over 30 m / 400 px.
    assert low.views[0].coarsening == pytest.approx(0.25 * 400 / 30)
    assert set(low.causes) == {Cause.TOO_COARSE}
    assert set(low.verdicts) == {Verdict.NONE}
    small = forecast(route, store, CAMERA, agl_m=30.0, working_px=320)
    assert small.views[0].coarsening == pytest.approx(0.25 * 200 / 30)


@pytest.mark.parametrize(
    ("reference", "altitude", "agl"),
    [
        (Reference.AMSL, 160.0, 60.0),
        (Reference.ELLIPSOID, 206.0, 60.0),
        (Reference.MAP, 160.0, 60.0),
        (Reference.TERRAIN, 60.0, 60.0),
        (Reference.HOME, 60.0, 60.0),
        (Reference.AMSL, 90.0, -10.0),
    ],
)
def test_heights_over_the_lake_by_what_they_count_from(tmp_path, store, reference, altitude, agl):
    """The lake lies at 100 m in the map, which is AMSL; the ellipsoid 46 m below."""
    east = EAST - 50
    route = route_of(tmp_path, [(east, MIDDLE - 10), (east, MIDDLE + 10)], altitude).with_reference(reference)
    result = forecast(route, store, CAMERA, working_px=640)
    assert [view.agl_m for view in result.views] == pytest.approx([agl] * len(result.views), abs=0.05)
    assert (result.causes[0] is Cause.BELOW_GROUND) == (agl < 0)


def test_mixed_references_are_joined_in_map_heights(tmp_path, store):
    lon, (lat_a, lat_b) = LONLAT.transform(EAST - 50, MIDDLE)[0], (MIDDLE - 30, MIDDLE + 30)
    lats = [LONLAT.transform(EAST - 50, y)[1] for y in (lat_a, lat_b)]
    items = [simple(16, lats[0], lon, 50, frame=10), simple(16, lats[1], lon, 170, frame=0)]
    home = (*LONLAT.transform(EAST - 50, MIDDLE)[::-1], 100.0)
    route = Route.read(written(tmp_path / "m.plan", plan(items, home)))
    heights = [view.agl_m for view in forecast(route, store, CAMERA, working_px=640).views]
    assert heights == sorted(heights)
    assert 50 < heights[0] < 57
    assert 63 < heights[-1] < 70


def test_home_off_the_pack_needs_its_altitude(tmp_path, store):
    lon, lat = LONLAT.transform(EAST - 50, MIDDLE)
    far = LONLAT.transform(EAST + 5000, MIDDLE)[::-1]
    items = [simple(16, lat, lon, 40), simple(16, lat + 1e-4, lon, 40)]
    route = Route.read(written(tmp_path / "m.plan", plan(items, (*far, 110.0))))
    # Home at 110 m, the lake at 100 m.
    assert forecast(route, store, CAMERA, working_px=640).views[0].agl_m == pytest.approx(50.0, abs=0.05)
    for home in (far, (*far, None)):
        route = Route.read(written(tmp_path / "m.plan", plan(items, home)))
        with pytest.raises(ConfigError, match=r"counts from home .*--agl"):
            forecast(route, store, CAMERA, working_px=640)


def test_heights_that_cannot_be_told_are_refused_with_the_remedy(tmp_path, store):
    points = [(WEST + 50, MIDDLE), (WEST + 90, MIDDLE)]
    with pytest.raises(ConfigError, match=r"r\.geojson: line 0, point 0: has no altitude.*--agl"):
        forecast(route_of(tmp_path, points), store, CAMERA, working_px=640)
    with pytest.raises(ConfigError, match=r"--altitudes home\|amsl\|ellipsoid\|terrain\|map"):
        forecast(route_of(tmp_path, points, 160.0), store, CAMERA, working_px=640)
    unknown = make(tmp_path / "unknown", vertical=VerticalDatum(kind="unknown"))
    route = route_of(tmp_path, points, 160.0).with_reference(Reference.AMSL)
    with MapStore(unknown) as other, pytest.raises(MapError, match="--agl METRES"):
        forecast(route, other, CAMERA, working_px=640)
    local = make(tmp_path / "local", crs=None, vertical=VERTICAL)
    with MapStore(local) as other, pytest.raises(MapError, match="local metres"):
        forecast(route, other, CAMERA, agl_m=60.0, working_px=640)


def test_the_picture_shows_the_verdicts_where_they_are(tmp_path, store):
    route = route_of(tmp_path, [(WEST - 100, MIDDLE), (EAST, MIDDLE)])
    result = forecast(route, store, CAMERA, agl_m=60.0, working_px=640)
    drawn = picture(result, store)
    assert drawn.dtype == np.uint8
    assert max(drawn.shape) == 1600
    places = np.flatnonzero((drawn == (60, 160, 255)).all(axis=-1).any(axis=0)[100:]) + 100
    red = np.flatnonzero((drawn[100:] == (255, 60, 50)).all(axis=-1).any(axis=0))
    # Blue in the fields, red on both sides of it.
    fields = places[places > 300]
    assert red.min() < fields.min() < fields.max() < red.max()
    # No map around the pack.
    assert (drawn[drawn.shape[0] // 2 - 40, 30] == (70, 70, 74)).all()


def run(pack, *arguments):
    parser = argparse.ArgumentParser()
    tiles_forecast.add_parser(parser.add_subparsers())
    args = parser.parse_args(["forecast", *map(str, arguments), "--pack", str(pack.path)])
    return args.run(args)


def test_the_command_writes_figures_stretches_and_picture(tmp_path, pack, capsys):
    path = line_file(tmp_path / "r.geojson", [(WEST - 100, MIDDLE), (EAST, MIDDLE)])
    made, drawn = tmp_path / "forecast.geojson", tmp_path / "forecast.png"
    lens = ["--hfov", "77.32", "--size", "640x480", "--agl", "60", "--speed", "12"]
    assert run(pack, path, *lens, "--geojson", made, "--image", drawn, "--json") == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["expected_m"] > 50
    assert facts["reasons_m"]["water"] > 50
    features = json.loads(made.read_text())["features"]
    assert sum(f["properties"]["length_m"] for f in features) == pytest.approx(facts["length_m"], abs=0.5)
    assert {f["properties"]["verdict"] for f in features} >= {"expected", "none"}
    assert features[0]["properties"]["reason"] == "outside_map"
    if shutil.which("ogrinfo") is not None:
        shown = subprocess.run(["ogrinfo", "-ro", "-so", "-al", str(made)], capture_output=True, text=True, check=False)
        assert f"Feature Count: {len(features)}" in shown.stdout
    assert cv2.imread(str(drawn)).shape[1] == 1600
    assert run(pack, path, *lens) == 0
    assert "longest gap" in capsys.readouterr().out


def test_the_camera_comes_from_its_file(tmp_path, pack, capsys):
    path = line_file(tmp_path / "r.geojson", [(WEST + 50, MIDDLE), (WEST + 90, MIDDLE)])
    own = {"width_px": 640, "height_px": 480, "fx": 500.0, "fy": 500.0, "cx": 319.5, "cy": 239.5}
    matrix = {"intrinsics": [[500.0, 0, 319.5], [0, 500.0, 239.5], [0, 0, 1]]}
    results = []
    for content, more in ((own, ()), (matrix, ("--size", "640x480"))):
        lens = written(tmp_path / "K.json", content)
        run(pack, path, "--intrinsics", lens, *more, "--agl", "60", "--json")
        results.append(json.loads(capsys.readouterr().out))
    assert results[0] == results[1]


@pytest.mark.parametrize(
    ("lens", "message"),
    [
        (["--hfov", "60"], "--size"),
        (["--hfov", "175", "--size", "640x480"], "no pinhole"),
        (["--intrinsics", "K.json"], "no width_px"),
        (["--intrinsics", "none.json"], "can't be read"),
    ],
)
def test_cameras_that_cannot_be_told(tmp_path, pack, monkeypatch, lens, message):
    monkeypatch.chdir(tmp_path)
    written(tmp_path / "K.json", {"intrinsics": []})
    path = line_file(tmp_path / "r.geojson", [(WEST + 50, MIDDLE), (WEST + 90, MIDDLE)])
    with pytest.raises(ConfigError, match=message):
        run(pack, path, *lens, "--agl", "60")


def test_a_damaged_matchability_layer_is_named(tmp_path):
    broken = make(tmp_path / "pack")
    (broken.path / MATCHABILITY_FILE).write_bytes(b"x" * (broken.path / MATCHABILITY_FILE).stat().st_size)
    route = route_of(tmp_path, [(WEST + 50, MIDDLE), (WEST + 90, MIDDLE)])
    with MapStore(broken) as store, pytest.raises(MapError, match=r"matchability\.tif: cannot be read"):
        forecast(route, store, CAMERA, agl_m=60.0, working_px=640)
