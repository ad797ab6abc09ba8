"""What a review of the builder found wrong, each with the case that shows it."""

from __future__ import annotations

import itertools
import os
import shutil
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyproj
import pytest
from tile_rasters import centres, write_raster, write_scene

from ortholoc_edge.cli import main
from ortholoc_edge.errors import ConfigError, MapError
from ortholoc_edge.geometry.grid import RasterGrid
from ortholoc_edge.tiles import tasks
from ortholoc_edge.tiles.area import read_area
from ortholoc_edge.tiles.build import PackOptions, build_pack, preview_build
from ortholoc_edge.tiles.plan import make_plan
from ortholoc_edge.tiles.resample import same_crs
from ortholoc_edge.tiles.source import Source
from ortholoc_edge.tiles.sources import discover, fingerprint, prepare, read_dop, read_dsm, with_common_stretch
from ortholoc_edge.tiles.store import MapStore


def source(kind, grid, crs="EPSG:25832", name="one.tif"):
    """A source without a file, for plans."""
    return Source(
        path=f"/nowhere/{name}",
        name=name,
        kind=kind,
        file=Path(f"/nowhere/{name}"),
        member=None,
        grid=grid,
        gsd_m=grid.gsd_m,
        crs=crs,
        vertical=None,
        date="2023",
        bands=(1, 2, 3) if kind == "dop" else (1,),
        driver="GTiff",
        dtype="uint8" if kind == "dop" else "float32",
    )


def copied(layer, crs):
    return [not layer.resampled(k, crs) for k in range(len(layer.sources))]


@pytest.mark.parametrize("written", [0.2, 0.19999999, 0.2000000028, 0.19999999999])
def test_pixel_size_of_a_rounded_world_file_copies_all_tiles_of_a_state(written):
    """Counted from the equator in steps of 0.19999999 m, tiles 12 km apart are on different pixels."""
    corners = [(500_000.0, 5_400_000.0), (512_000.0, 5_400_000.0), (540_000.0, 5_460_000.0)]
    dop = [source("dop", RasterGrid(5000, 5000, w, n, written, -written), name=f"{w:.0f}.tif") for w, n in corners]
    dsm = [source("dsm", RasterGrid(5000, 5000, 499_000.0, 5_461_000.0, 20.0, -20.0))]
    plan = make_plan(dop, dsm)
    assert plan.dop.lattice.pixel_m == pytest.approx(0.2, abs=1e-12)
    assert copied(plan.dop, plan.crs) == [True] * 3


def test_pixel_size_that_is_meant_so_is_kept():
    """A US survey foot in metres is no slip of 0.3048 m."""
    foot, grid = 1200 / 3937, RasterGrid(300, 300, 500_000.0, 5_400_000.0, 1200 / 3937, -1200 / 3937)
    far = RasterGrid(300, 300, 500_000.0 + 100_000 * foot, 5_400_000.0, foot, -foot)
    dop = [source("dop", grid, name="a.tif"), source("dop", far, name="b.tif")]
    plan = make_plan(dop, [source("dsm", RasterGrid(5000, 500, 499_000.0, 5_401_000.0, 10.0, -10.0))])
    assert plan.dop.lattice.pixel_m == foot
    assert copied(plan.dop, plan.crs) == [True] * 2


@pytest.mark.parametrize(
    ("code", "east", "north"),
    [(3045, 4e5, 5.3e6), (3044, 4e5, 5.3e6), (31468, 4.4e6, 5.3e6), (31256, 4e3, 3.4e5), (3416, 6e5, 5e5)],
)
def test_pixels_of_the_same_system_in_other_words_are_kept(code, east, north):
    """Where EPSG has northing first, Esri's WKT is no code to PROJ, but the same system."""
    wkt = pyproj.CRS.from_epsg(code).to_wkt("WKT1_ESRI")
    grid = RasterGrid(1000, 1000, east + 0.3, north + 0.3, 1.0, -1.0)
    plan = make_plan(
        [source("dop", grid, wkt)], [source("dsm", replace(grid, west=east + 0.7), wkt)], pack_crs=f"EPSG:{code}"
    )
    assert copied(plan.dop, plan.crs) == copied(plan.dsm, plan.crs) == [True]


@pytest.mark.parametrize(
    ("one", "other", "same"),
    [(3044, 25832, True), (3045, 25832, False), (25832, 32632, False), (5652, 25832, False), (2263, 32118, False)],
)
def test_systems_are_one_where_their_pixels_are(one, other, same):
    assert same_crs(f"EPSG:{one}", f"EPSG:{other}") is same


def test_plan_of_a_state_takes_seconds():
    """All sources times all tiles took 12 s for 1600 km2, and would have taken more than an hour for a state."""
    corners = [(400_000.0 + 1000 * i, 5_400_000.0 + 1000 * j) for i in range(60) for j in range(60)]
    dop = [source("dop", RasterGrid(5000, 5000, w, n, 0.2, -0.2), name=f"{w:.0f}_{n:.0f}.tif") for w, n in corners]
    dsm = [source("dsm", RasterGrid(1000, 1000, w, n, 1.0, -1.0), name=f"{w:.0f}_{n:.0f}.tif") for w, n in corners]
    start = time.process_time()
    plan = make_plan(dop, dsm)
    assert time.process_time() - start < 5.0
    for layer in (plan.dop, plan.dsm):
        assert layer.pixels * layer.lattice.pixel_m**2 == pytest.approx(3600e6, rel=0.05)
        for tile in layer.tiles[:: len(layer.tiles) // 40]:
            west, south, east, north = layer.lattice.grid(tile.box).bounds
            meeting = [
                k
                for k, (w, s, e, n) in enumerate(layer.bounds)
                if min(e, east) - max(w, west) > 1e-6 and min(n, north) - max(s, south) > 1e-6
            ]
            assert list(tile.sources) == meeting


@pytest.mark.parametrize(("pixel_m", "size"), [(30.0, 40), (2.0, 500), (25.0, 40)])
def test_coarse_heights_of_a_steep_flank_have_no_steps(tmp_path, pixel_m, size):
    """A limit of 1 m made stairs of a 30 m surface model on every slope: 10 m high on this one."""

    def flank(xy):
        return 1000 + 0.5 * (xy[..., 0] - 400_000) + 0.2 * (xy[..., 1] - 5_300_000)

    grid = RasterGrid(60, 60, 400_000.0, 5_300_000.0, 30.0, -30.0)
    path = write_raster(tmp_path / "dsm.tif", flank(centres(grid)).astype(np.float32)[None], grid, nodata=-9999.0)
    target = RasterGrid(size, size, 400_213.0, 5_299_787.0, pixel_m, -pixel_m)
    heights = read_dsm(discover([path], "dsm")[0], target, "EPSG:32633")
    assert np.isfinite(heights).all()
    assert np.abs(heights - flank(centres(target))).max() < 0.01


def test_folders_behind_links_are_searched(tmp_path):
    """Python's rglob passes them over without a word, and what lies on another disk is a hole in the map."""
    grid = RasterGrid(64, 64, 400_000.0, 5_300_000.0, 1.0, -1.0)
    disk, given = tmp_path / "disk" / "2023", tmp_path / "given"
    disk.mkdir(parents=True)
    (given / ".hidden").mkdir(parents=True)
    path = write_raster(disk / "one.tif", np.full((1, 64, 64), 300, np.float32), grid, nodata=-9999.0)
    shutil.copy(path, given / "two.tif")
    shutil.copy(path, given / ".hidden" / "three.tif")
    (given / "more").symlink_to(disk)
    # A loop ends.
    (disk / "back").symlink_to(given)
    assert sorted(one.name for one in discover([given], "dsm")) == ["one.tif", "two.tif"]


def test_paths_of_sources_hold_in_other_working_directories(tmp_path, monkeypatch):
    """A worker of a Dask cluster was started elsewhere."""
    grid = RasterGrid(64, 64, 400_000.0, 5_300_000.0, 1.0, -1.0)
    write_raster(tmp_path / "dsm.tif", np.full((1, 64, 64), 300, np.float32), grid, nodata=-9999.0)
    monkeypatch.chdir(tmp_path)
    (one,) = discover([Path("dsm.tif")], "dsm")
    monkeypatch.chdir("/")
    assert (read_dsm(one, grid, "EPSG:32633") == 300).all()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"vertical": "ellipsoid"}, "geoid there is not known"),
        ({"vertical": "orthometric", "vertical_epsg": 25832}, "no vertical system"),
        ({"vertical": "unknown", "vertical_epsg": 5773}, "say nothing without the kind"),
        ({"vertical": "ellipsoid", "geoid_undulation_m": 400.0}, "where no geoid is"),
    ],
)
def test_unusable_heights_are_refused_before_the_work(tmp_path, options, message):
    """They were found out when all tiles were done, and not at all by the dry run."""
    dop, dsm = write_scene(tmp_path / "sources")
    for action in (preview_build, build_pack):
        with pytest.raises((ConfigError, MapError), match=message):
            action(dop, dsm, tmp_path / "pack", PackOptions(**options))
        assert [path.name for path in tmp_path.iterdir()] == ["sources"]


def test_warnings_about_heights_come_once_and_with_the_dry_run(tmp_path, caplog):
    dop, dsm = write_scene(tmp_path / "sources", crs="EPSG:32633+5773")
    options = PackOptions(vertical="orthometric", vertical_epsg=7837)
    preview_build(dop, dsm, tmp_path / "pack", options)
    told = [record.getMessage() for record in caplog.records if record.levelname == "WARNING"]
    assert sum("its CRS says EPSG:5773, --vertical-epsg 7837 is taken" in text for text in told) == 1
    assert sum("heights are taken as AMSL" in text for text in told) == 1
    caplog.clear()
    build_pack(dop, dsm, tmp_path / "pack", options)
    assert [record.getMessage() for record in caplog.records if record.levelname == "WARNING"] == told


@pytest.mark.parametrize("date", ["2023-13", "2023-02-30", "0000", "2023-6"])
def test_dates_that_are_none_are_refused_at_once(date):
    with pytest.raises(ConfigError, match="dsm_date"):
        PackOptions(dsm_date=date)


def test_an_unusable_key_is_refused_before_the_work(tmp_path, capsys):
    dop, dsm = write_scene(tmp_path / "sources")
    arguments = ["tiles", "build", "--dop", dop, "--dsm", dsm, "--out", tmp_path / "pack", "--vertical", "unknown"]
    assert main([*map(str, arguments), "--sign", str(tmp_path / "none.pem")]) == 78
    assert "none.pem: private key cannot be read" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["sources"]


def test_force_does_not_delete_the_folder_of_another_program(tmp_path):
    """Extensions of browsers and web applications have a manifest.json, too."""
    dop, dsm = write_scene(tmp_path / "sources")
    folder = tmp_path / "extension"
    folder.mkdir()
    (folder / "manifest.json").write_text('{"manifest_version": 3}')
    (folder / "precious.js").write_text("work of a year")
    with pytest.raises(MapError, match="is no area pack"):
        build_pack(dop, dsm, folder, PackOptions(vertical="unknown", force=True))
    assert (folder / "precious.js").read_text() == "work of a year"


def test_a_mount_point_is_refused_before_the_work(tmp_path, monkeypatch):
    """An empty volume at --out: nothing can take its name, which was found out when all tiles were done."""
    dop, dsm = write_scene(tmp_path / "sources")
    volume = tmp_path / "volume"
    volume.mkdir()
    monkeypatch.setattr(Path, "is_mount", lambda self: self == volume)
    with pytest.raises(MapError, match="name a folder in it"):
        build_pack(dop, dsm, volume, PackOptions(vertical="unknown", force=True))


def test_heights_of_a_coarse_model_reach_to_the_border_of_a_small_area(tmp_path):
    """Cells of 30 m whose centres lie outside were left out, and with them what lies between."""
    dop_grid = RasterGrid(640, 640, 400_000.0, 5_300_000.0, 0.6, -0.6)
    dsm_grid = RasterGrid(40, 40, 399_600.0, 5_300_400.0, 30.0, -30.0)
    rgb = np.random.default_rng(0).integers(0, 255, (3, 640, 640), np.uint8)
    dop = write_raster(tmp_path / "dop.tif", rgb, dop_grid)
    dsm = write_raster(tmp_path / "dsm.tif", np.full((1, 40, 40), 300, np.float32), dsm_grid, nodata=-9999.0)
    for number, side in enumerate((200, 20)):
        west, north = 400_061.0, 5_299_943.0
        area = read_area(f"{west},{north - side},{west + side},{north}", None)
        pack = build_pack(dop, dsm, tmp_path / f"pack{number}", PackOptions(vertical="unknown", area=area))
        with MapStore(pack) as store:
            across = np.linspace(1.0, side - 1.0, 9)
            xy = np.stack(np.meshgrid(west + across, north - across), axis=-1).reshape(-1, 2)
            assert np.abs(store.heights(xy) - 300.0).max() < 0.05
        assert pack.manifest.dsm.tiles[0].valid_fraction < 0.2


def test_the_webs_mercator_map_is_measured_on_the_ground(tmp_path):
    """Its metres are 0.64 of one at 50 degrees; and the remedy is an option of the build."""
    x, y = pyproj.Transformer.from_crs(4326, 3857, always_xy=True).transform(9.0, 50.0)
    grid = RasterGrid(500, 500, x, y, 0.3, -0.3)
    (one,) = discover(
        [write_raster(tmp_path / "web.tif", np.full((3, 500, 500), 9, np.uint8), grid, "EPSG:3857")], "dop"
    )
    assert one.gsd_m == pytest.approx(0.3 * np.cos(np.deg2rad(50.0)), rel=0.005)
    east, north = pyproj.Transformer.from_crs(4326, 32632, always_xy=True).transform(9.0, 50.0)
    dsm = [source("dsm", RasterGrid(400, 400, east - 100, north + 100, 1.0, -1.0), "EPSG:32632")]
    with pytest.raises(MapError, match=r"not conformal.*--pack-crs"):
        make_plan([one], dsm)
    assert make_plan([one], dsm, pack_crs="EPSG:32632").dop.lattice.pixel_m == pytest.approx(0.193, abs=0.0015)


def test_a_source_that_is_written_while_it_is_read_is_named(tmp_path):
    """A download that still runs: it ended in a KeyError."""
    dop, dsm = write_scene(tmp_path / "sources")
    moments, real = itertools.count(2_000_000_000), tasks.run_job

    def beside_a_download(job, folder):
        made = real(job, folder)
        os.utime(dop, (next(moments),) * 2)
        return made

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tasks, "run_job", beside_a_download)
        with pytest.raises(MapError, match=r"dop_source\.tif: was written while the build read it"):
            build_pack(dop, dsm, tmp_path / "pack", PackOptions(vertical="unknown"))
    assert not (tmp_path / "pack").exists()
    assert build_pack(dop, dsm, tmp_path / "pack", PackOptions(vertical="unknown")).verify() == []


def test_what_lies_beside_a_source_counts(tmp_path):
    """A mask, or a nodata value for a format that cannot hold one: work done without it is not taken up again."""
    dop, _ = write_scene(tmp_path)
    (one,) = discover([dop], "dop")
    marks = [fingerprint(one)]
    for suffix in (".msk", ".aux.xml"):
        Path(f"{dop}{suffix}").write_bytes(b"anything")
        marks.append(fingerprint(one))
    assert len(set(marks)) == 3


def test_plan_lists_only_the_sources_of_the_area():
    """The dry run counted the state's."""
    corners = [400_000.0 + 1000 * k for k in range(5)]
    dop = [source("dop", RasterGrid(5000, 5000, w, 5.4e6, 0.2, -0.2), name=f"{w:.0f}.tif") for w in corners]
    dsm = [source("dsm", RasterGrid(1000, 1000, w, 5.4e6, 1.0, -1.0), name=f"{w:.0f}.tif") for w in corners]
    area = read_area("402100,5399100,402300,5399300", None)
    plan = make_plan(dop, dsm, area=area)
    for layer in (plan.dop, plan.dsm):
        assert [one.name for one in layer.sources] == ["402000.tif"]
        assert len(layer.bounds) == 1
        assert all(tile.sources == (0,) for tile in layer.tiles)


def test_white_fill_of_16_bits_neither_darkens_the_map_nor_shows(tmp_path):
    """As brightest pixels of the stretch it made the picture black."""
    grid = RasterGrid(600, 600, 400_000.0, 5_300_000.0, 0.2, -0.2)
    bands = np.random.default_rng(0).integers(200, 2000, (3, 600, 600)).astype(np.uint16)
    bands[:, :, :60] = 2**16 - 1
    found = with_common_stretch(discover([write_raster(tmp_path / "deep.tif", bands, grid)], "dop"))
    pixels = read_dop(prepare(found[0], tmp_path / "work"), grid, "EPSG:32633")
    assert not pixels.valid[:, :60].any()
    assert pixels.valid[:, 60:].all()
    assert 120 < pixels.rgb[:, :, 60:].mean() < 135
