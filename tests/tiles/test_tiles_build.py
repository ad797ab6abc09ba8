import json
import resource
import shutil
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
import rasterio
from tile_rasters import (
    CRS,
    DOP_GRID,
    DSM_GRID,
    centres,
    contents,
    dsm_heights,
    dsm_of,
    plane,
    write_raster,
    write_scene,
)

from ortholoc_edge.errors import ConfigError, MapError
from ortholoc_edge.geometry.grid import RasterGrid
from ortholoc_edge.tiles import build
from ortholoc_edge.tiles.build import PackOptions, build_pack
from ortholoc_edge.tiles.manifest import layer_bounds
from ortholoc_edge.tiles.pack import Pack
from ortholoc_edge.tiles.resample import on_lattice
from ortholoc_edge.tiles.store import MapStore


def built(dop, dsm, out, *, progress=None, **options):
    return build_pack(dop, dsm, out, PackOptions(**({"vertical": "unknown"} | options)), progress)


@pytest.fixture(scope="module")
def sound_pack(scene, tmp_path_factory):
    """Of the default options; what tests change is a copy."""
    return built(*scene, tmp_path_factory.mktemp("sound") / "pack")


@pytest.fixture(scope="module")
def sound_pack_of_50(scene, tmp_path_factory):
    return built(*scene, tmp_path_factory.mktemp("sound") / "pack", quality=50)


def test_pack_is_cogs_that_rasterio_opens(holed_pack):
    manifest = holed_pack.manifest
    for layer, bands in ((manifest.dop, 3), (manifest.dsm, 1)):
        for tile in layer.tiles:
            path = holed_pack.path / tile.file
            # The ghost area is what a COG reader looks for: image directories first, tiles in their order.
            assert b"LAYOUT=IFDS_BEFORE_DATA" in path.read_bytes()[:300]
            with rasterio.open(path) as dataset:
                assert dataset.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"
                assert dataset.count == bands
                assert dataset.crs.to_epsg() == 32633
                assert dataset.block_shapes[0] == (512, 512)
                assert dataset.overviews(1) == [4, 16]
                first = int(dataset.get_tag_item("BLOCK_OFFSET_0_0", "TIFF", bidx=1, ovr=1))
                last = int(dataset.get_tag_item("BLOCK_OFFSET_0_0", "TIFF", bidx=1))
                assert first < last  # the coarsest level comes first


def test_overviews_keep_the_holes_of_the_surface(scene, tmp_path):
    """An overview cell has data exactly where 3 in 4 of the full cells below it have, by its own levels."""
    grid = RasterGrid(1280, 1024, DSM_GRID.west, DSM_GRID.top, 0.1, -0.1)
    heights = dsm_heights(grid)[0]
    rng = np.random.default_rng(1)
    invalid = np.zeros(heights.shape, dtype=bool)
    invalid[:, :640] = rng.random((1024, 640)) < 0.3
    for row, column, side in ((100, 800, 2), (300, 901, 5), (601, 803, 64), (700, 1000, 150)):
        invalid[row : row + side, column : column + side] = True
    dsm = write_raster(tmp_path / "dsm.tif", np.where(invalid, np.nan, heights)[None], grid, nodata=float("nan"))
    pack = built(scene[0], dsm, tmp_path / "pack", max_hole_cells=0)
    assert np.array_equal(np.isnan(dsm_of(pack, grid)), invalid)
    with MapStore(pack) as store:
        for factor in (2, 4, 8, 16):
            level = next(one for one in store.dsm_grids if one.gsd_m == pytest.approx(0.1 * factor))
            window = store.read(grid.bounds, 0.1, level.gsd_m)
            assert window.dsm_grid.west == pytest.approx(grid.west)
            assert window.dsm_grid.width * factor == grid.width
            below = (window.dsm_grid.height, factor, window.dsm_grid.width, factor)
            share = 1.0 - invalid.reshape(below).mean(axis=(1, 3))
            there = np.isfinite(window.dsm)
            if factor == 2:
                assert np.array_equal(there, share >= 0.75)
            assert share[there].min() >= 0.75**2
            assert there[share == 1.0].all()
            # Scattered holes leave fewer cells than at full resolution, not more.
            assert there[:, : 600 // factor].mean() < 0.75
            error = np.abs(window.dsm - plane(centres(window.dsm_grid)))[there]
            assert error.max() < 0.5 * level.gsd_m


def test_manifest_tells_what_was_stated(scene, tmp_path):
    options = PackOptions(
        dop_date="2023-06-04",
        dsm_date="2021",
        attribution="© Someone",
        licence="dl-de/by-2-0",
        true_ortho=False,
        dop_sigma_m=0.2,
        dsm_sigma_m=0.3,
        vertical="ellipsoid",
        geoid_undulation_m=46.0,
        max_z_error_m=0.05,
        dop_compression="jpeg",
        created=datetime(2024, 5, 6, 7, 8, 9, tzinfo=UTC),
    )
    manifest = build_pack(*scene, tmp_path / "pack", options).manifest
    assert manifest.created == "2024-05-06T07:08:09Z"
    assert manifest.crs == CRS
    assert manifest.anchor == (400_080.0, 5_299_930.0)
    assert (manifest.dop.date, manifest.dsm.date) == ("2023-06-04", "2021")
    assert (manifest.dop.attribution, manifest.dsm.licence) == ("© Someone", "dl-de/by-2-0")
    assert (manifest.dop.true_ortho, manifest.dop.sigma_m, manifest.dsm.sigma_m) == (False, 0.2, 0.3)
    assert manifest.dop.compression == "JPEG quality 85"
    assert (manifest.dsm.max_z_error_m, manifest.dsm.nodata) == (0.05, -9999.0)
    assert manifest.vertical.amsl_minus_map_m == -46.0
    assert (manifest.dop.gsd_m, manifest.dsm.gsd_m) == (0.1, 0.2)
    for layer, grid, name in ((manifest.dop, DOP_GRID, "dop_source.tif"), (manifest.dsm, DSM_GRID, "dsm_source.tif")):
        assert on_lattice(grid, layer.lattice.grid(layer.tiles[0].box))
        assert [(one.name, one.crs, one.gsd_m, one.resampled) for one in layer.sources] == [
            (name, CRS, layer.gsd_m, False)
        ]
        # The tiles hold the source, and 63 pixels more at most on a side.
        west, south, east, north = layer_bounds(layer)
        slack = 1e-6
        assert west <= grid.bounds[0] + slack and south <= grid.bounds[1] + slack
        assert east >= grid.bounds[2] - slack and north >= grid.bounds[3] - slack
        assert (east - west) / layer.gsd_m - grid.width < 128 + slack


def test_same_input_gives_the_same_bytes(scene, tmp_path):
    one, two = (built(*scene, tmp_path / name, created=datetime(2024, 1, 1, tzinfo=UTC)).path for name in "ab")
    assert contents(one) == contents(two)


def test_progress_rises_to_one(scene, tmp_path):
    steps = []
    built(*scene, tmp_path / "pack", progress=lambda *step: steps.append(step))
    fractions = [fraction for fraction, _ in steps]
    assert fractions == sorted(fractions)
    assert (fractions[0], fractions[-1]) == (0.0, 1.0)
    assert all(message for _, message in steps)


def test_auto_height_error_follows_the_gsd(sound_pack):
    assert sound_pack.manifest.dsm.max_z_error_m == 0.01


@pytest.mark.parametrize(
    "options",
    [
        {"quality": 0},
        {"max_z_error_m": -1.0},
        {"max_z_error_m": float("nan")},
        {"dop_date": "June"},
        {"dsm_sigma_m": float("inf")},
    ],
)
def test_options_out_of_range(options):
    with pytest.raises(ConfigError, match=next(iter(options))):
        PackOptions(**options)


def test_existing_pack_needs_force(scene, sound_pack, tmp_path):
    out = shutil.copytree(sound_pack.path, tmp_path / "pack")
    before = contents(out)
    with pytest.raises(MapError, match="--force"):
        built(*scene, out)
    assert contents(out) == before
    built(*scene, out, force=True, quality=50)
    assert Pack.open(out).manifest.dop.compression == "WEBP quality 50"
    assert [path.name for path in tmp_path.iterdir()] == ["pack"]


def test_force_spares_what_is_no_pack(scene, tmp_path):
    photos = tmp_path / "photos"
    photos.mkdir()
    (photos / "holiday.jpg").write_text("dear")
    with pytest.raises(MapError, match="no area pack"):
        built(*scene, photos, force=True)
    assert (photos / "holiday.jpg").read_text() == "dear"
    sources = write_scene(tmp_path / "inside")
    with pytest.raises(MapError, match="contains the source"):
        built(*sources, tmp_path / "inside", force=True)


@pytest.mark.parametrize("at", [0.15, 0.3, 0.9, 0.98])
def test_interrupted_build_leaves_the_old_pack_and_its_work(scene, sound_pack, sound_pack_of_50, tmp_path, at):
    out = shutil.copytree(sound_pack.path, tmp_path / "pack")
    before = contents(out)

    def interrupt(fraction, message):
        if fraction >= at:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        built(*scene, out, progress=interrupt, force=True, quality=50)
    assert contents(out) == before
    left = [path.name for path in tmp_path.iterdir() if path != out]
    # There is nothing to keep before the first tile.
    assert left == ([".pack.building"] if at > 0.2 else [])
    built(*scene, out, force=True, quality=50)
    assert contents(out) == contents(sound_pack_of_50.path)
    assert [path.name for path in tmp_path.iterdir()] == ["pack"]


@pytest.mark.parametrize(("limit_bytes", "kept"), [(1_000, []), (30_000, [".pack.building"])])
def test_full_disk_is_a_map_error(scene, sound_pack, tmp_path, limit_bytes, kept):
    """RLIMIT_FSIZE makes the kernel refuse real writes, as a full disk does: of the DOP's tile, of the DSM's."""
    out = shutil.copytree(sound_pack.path, tmp_path / "pack")
    before = contents(out)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit_bytes, limits[1]))
    try:
        with pytest.raises(MapError, match=r"cannot be written \(File too large\); check free space"):
            built(*scene, out, quality=75, force=True)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert contents(out) == before
    assert Pack.open(out).verify() == []
    assert [path.name for path in tmp_path.iterdir() if path != out] == kept


def test_unwritable_place_is_a_map_error(scene, tmp_path):
    blocker = tmp_path / "file"
    blocker.write_text("")
    with pytest.raises(MapError, match=r"cannot be made \(Not a directory\)"):
        built(*scene, blocker / "pack")


def test_pack_that_was_not_written_whole_is_not_installed(scene, tmp_path, monkeypatch):
    """Where tiles cannot be linked they are copied, and a copy can fall short."""

    def short(source, target):
        Path(target).write_bytes(Path(source).read_bytes()[:-10])

    def refused(source, target):
        raise OSError(1, "Operation not permitted")

    monkeypatch.setattr(build.os, "link", refused)
    monkeypatch.setattr(build.shutil, "copyfile", short)
    with pytest.raises(MapError, match=r"was not written as it should|can be used"):
        built(*scene, tmp_path / "pack")
    assert not (tmp_path / "pack").exists()


def test_pack_is_copied_where_it_cannot_be_linked(scene, sound_pack, tmp_path, monkeypatch):
    def refused(source, target):
        raise OSError(1, "Operation not permitted")

    monkeypatch.setattr(build.os, "link", refused)
    assert contents(built(*scene, tmp_path / "copied").path) == contents(sound_pack.path)


def test_finish_comes_before_the_name(scene, tmp_path):
    """What makes the pack's signature sees the whole pack, and a pack without it never has the name."""
    out = tmp_path / "pack"
    seen = []

    def finish(folder):
        assert not out.exists()
        assert Pack.open(folder).verify() == []
        seen.append(folder)
        (folder / "manifest.sig").write_bytes(bytes(64))

    build_pack(*scene, out, PackOptions(vertical="unknown"), finish=finish)
    assert len(seen) == 1
    assert (out / "manifest.sig").read_bytes() == bytes(64)

    def refuse(folder):
        raise ConfigError("no such key")

    with pytest.raises(ConfigError, match="no such key"):
        build_pack(*scene, tmp_path / "other", PackOptions(vertical="unknown"), finish=refuse)
    assert not (tmp_path / "other").exists()


def test_pack_can_be_read_by_another_user(plane_pack):
    assert plane_pack.path.stat().st_mode & 0o055 == 0o055
    assert json.loads((plane_pack.path / "manifest.json").read_text())["format"] == "ortholoc-pack"
