"""What a build decides before it starts."""

import logging
from dataclasses import replace
from pathlib import Path

import pytest

from ortholoc_edge.errors import ConfigError, MapError
from ortholoc_edge.geometry.grid import RasterGrid
from ortholoc_edge.tiles.area import read_area
from ortholoc_edge.tiles.plan import bounds_in, lat_lon_of, make_plan, named_vertical
from ortholoc_edge.tiles.sources import Source

UTM32, UTM33 = "EPSG:25832", "EPSG:25833"
GRID = RasterGrid(5000, 5000, 500_000.0, 5_301_000.0, 0.2, -0.2)
CELLS = RasterGrid(1000, 1000, 500_000.0, 5_301_000.0, 1.0, -1.0)


def source(kind="dop", grid=GRID, crs=UTM32, name="a.tif", gsd_m=None, **changes):
    fields = {
        "path": f"/nowhere/{name}",
        "name": name,
        "kind": kind,
        "file": Path(f"/nowhere/{name}"),
        "member": None,
        "grid": grid,
        "gsd_m": grid.gsd_m if gsd_m is None else gsd_m,
        "crs": crs,
        "vertical": None,
        "date": None,
        "bands": (1, 2, 3) if kind == "dop" else (1,),
        "driver": "GTiff",
        "dtype": "uint8" if kind == "dop" else "float32",
    }
    return Source(**(fields | changes))


def shifted(grid, east, north=0.0):
    return replace(grid, west=grid.west + east, top=grid.top + north)


DSM = source("dsm", CELLS, name="dsm.tif")


def test_one_source_of_each():
    plan = make_plan([source()], [DSM])
    assert plan.crs == UTM32
    assert (plan.dop.lattice.pixel_m, plan.dsm.lattice.pixel_m) == (0.2, 1.0)
    assert (plan.dop.lattice.tile_px, plan.dsm.lattice.tile_px) == (4096, 1024)
    assert not plan.dop.resampled(0, plan.crs)
    west, south, east, north = plan.bounds
    assert west <= 500_000 and south <= 5_300_000 and east >= 501_000 and north >= 5_301_000
    assert max(500_000 - west, east - 501_000) < 64 * 0.2
    assert plan.dop.pixels == sum(t.box.width * t.box.height for t in plan.dop.tiles)


def test_order_is_newest_then_finest_then_by_name():
    fine = replace(GRID, width=10_000, height=10_000, dx=0.1, dy=-0.1)
    sources = [
        source(name="undated.tif"),
        source(name="b.tif", date="2020"),
        source(name="a.tif", date="2020"),
        source(name="z_fine.tif", date="2020", grid=fine),
        source(name="june.tif", date="2021-06"),
        source(name="day.tif", date="2021-06-03"),
        source(name="year.tif", date="2021"),
    ]
    expected = ["day.tif", "june.tif", "year.tif", "z_fine.tif", "a.tif", "b.tif", "undated.tif"]
    for given in (sources, sources[::-1]):
        assert [one.name for one in make_plan(given, [DSM]).dop.sources] == expected


def test_degrees_are_not_taken_for_fine_metres():
    degrees = source(
        grid=RasterGrid(600, 400, 9.0, 47.862, 2e-5, -2e-5), crs="EPSG:4258", name="coarse.tif", gsd_m=1.8
    )
    plan = make_plan([degrees, source(name="fine.tif")], [DSM])
    assert [one.name for one in plan.dop.sources] == ["fine.tif", "coarse.tif"]
    assert plan.dop.lattice.pixel_m == 0.2
    assert plan.dop.resampled(1, plan.crs)


def test_crs_and_pixels_are_of_the_largest_part():
    small = source(name="s.tif", grid=RasterGrid(1000, 1000, 500_000.05, 5_301_000.0, 0.1, -0.1))
    plan = make_plan([small, source()], [DSM])
    assert plan.dop.lattice.pixel_m == 0.2
    assert [plan.dop.resampled(k, plan.crs) for k in range(2)] == [True, False]
    east33 = RasterGrid(2000, 2000, 54_000.0, 5_320_000.0, 0.2, -0.2)
    other = source(name="z33.tif", grid=east33, crs=UTM33)
    assert make_plan([other, source()], [DSM]).crs == UTM32
    asked = make_plan([other, source()], [DSM], pack_crs=UTM33)
    assert asked.crs == UTM33
    assert bounds_in(source(), UTM33) == pytest.approx(asked.dop.bounds[asked.dop.sources.index(source())])


@pytest.mark.parametrize("noise", [1e-10, -1e-10, 3e-8])
def test_noise_of_written_numbers_is_no_other_grid(noise):
    noisy = source(name="noisy.tif", grid=replace(GRID, west=500_000 + noise, dx=0.2 + 1e-13, dy=-0.2))
    plan = make_plan([noisy, source()], [DSM])
    assert not any(plan.dop.resampled(k, plan.crs) for k in range(2))


def test_phase_is_kept():
    """Pixel corners at half pixels, as rasters from point grids have."""
    cells = shifted(CELLS, 0.5, 0.5)
    plan = make_plan([source()], [source("dsm", cells, name="dsm.tif")])
    assert not plan.dsm.resampled(0, plan.crs)
    assert plan.dsm.lattice.west % 1.0 == 0.5


def test_only_what_both_layers_cover_is_planned(caplog):
    dsm = source("dsm", replace(CELLS, width=300, height=1000), name="dsm.tif")
    with caplog.at_level(logging.WARNING):
        plan = make_plan([source()], [dsm])
    assert "covers only 30 % of the orthophoto" in caplog.text
    assert plan.bounds[2] <= 500_300 + 64 * 0.2
    # Two places far apart, with nothing between: no tiles there.
    far = [source(), source(name="b.tif", grid=shifted(GRID, 40_000))]
    heights = [DSM, source("dsm", shifted(CELLS, 40_000), name="e.tif")]
    plan = make_plan(far, heights)
    assert len(plan.dop.tiles) < 12
    assert {k for tile in plan.dop.tiles for k in tile.sources} == {0, 1}
    east_only = make_plan(far, [heights[1]])
    assert {k for tile in east_only.dop.tiles for k in tile.sources} == {0}
    assert [one.name for one in east_only.dop.sources] == ["b.tif"]


def test_area_cuts_the_tiles():
    area = read_area("500100,5300100,500200,5300200", None)
    plan = make_plan([source()], [DSM], area=area)
    west, south, east, north = plan.bounds
    assert 500_100 - 12.8 < west <= 500_100 and 500_200 <= east < 500_200 + 12.8
    assert 5_300_100 - 12.8 < south <= 5_300_100 and 5_300_200 <= north < 5_300_200 + 12.8


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"dsm": [source("dsm", shifted(CELLS, 5000))]}, MapError, "do not overlap"),
        ({"dop": [source(), source(crs=None, name="b.tif")]}, MapError, r"b\.tif: no CRS.*--crs"),
        ({"pack_crs": "EPSG:4326"}, MapError, "geographic|projected"),
        ({"pack_crs": "EPSG:999999"}, MapError, "999999"),
        ({"dop_gsd_m": 0.0}, ConfigError, "dop_gsd_m"),
        ({"dsm_gsd_m": 500.0}, ConfigError, "dsm_gsd_m"),
        ({"dop_gsd_m": float("nan")}, ConfigError, "dop_gsd_m"),
        ({"area": read_area("600000,5300100,600200,5300200", None)}, ConfigError, "do not meet"),
    ],
)
def test_what_cannot_be_one_pack(change, error, message):
    arguments = {"dop": [source()], "dsm": [DSM]} | change
    with pytest.raises(error, match=message):
        make_plan(arguments.pop("dop"), arguments.pop("dsm"), **arguments)


def test_local_metres():
    local = [source(crs=None)], [replace(DSM, crs=None)]
    assert make_plan(*local).crs is None
    with pytest.raises(ConfigError, match="--pack-crs"):
        make_plan(*local, pack_crs=UTM32)


def test_heights_must_agree():
    one, other = replace(DSM, vertical=("orthometric", 7837)), replace(DSM, name="b.tif", vertical=("ellipsoid", None))
    assert named_vertical([DSM, one]) == ("orthometric", 7837)
    assert named_vertical([DSM]) is None
    with pytest.raises(MapError, match=r"different heights: orthometric 7837 \(dsm.tif\), ellipsoid \(b.tif\)"):
        named_vertical([one, other])


def test_places_are_in_degrees():
    [(lat, lon)] = lat_lon_of(UTM32, [(500_000.0, 5_300_000.0)])
    assert (lat, lon) == (pytest.approx(47.85, abs=0.01), pytest.approx(9.0, abs=1e-9))
