import json
import logging
import resource
from datetime import UTC, datetime

import cv2
import numpy as np
import pytest
import rasterio
from affine import Affine
from rasterio.enums import ColorInterp as Ci
from rasterio.windows import from_bounds
from tile_rasters import (
    CRS,
    DOP_GRID,
    DSM_GRID,
    centres,
    colours,
    dop_pixels,
    dsm_heights,
    plane,
    write_holed_scene,
    write_raster,
    write_scene,
)

from ortholoc_edge.errors import ConfigError, MapError
from ortholoc_edge.geometry.grid import RasterGrid
from ortholoc_edge.tiles import build
from ortholoc_edge.tiles.build import PackOptions, build_pack
from ortholoc_edge.tiles.pack import Pack
from ortholoc_edge.tiles.store import MapStore


def dop_of(pack):
    """Full-resolution RGB and mask by rasterio alone."""
    with rasterio.open(pack.path / "dop.tif") as dataset:
        return np.moveaxis(dataset.read(), 0, -1), dataset.dataset_mask() > 0


def dsm_of(pack):
    with rasterio.open(pack.path / "dsm.tif") as dataset:
        return dataset.read(1)


@pytest.mark.parametrize(("name", "dop_error"), [("seneca", 4.0), ("caliterra", 2.0), ("copr", 2.0), ("demo", 5.0)])
def test_real_maps_survive(real_pack, name, dop_error):
    """The middle half of the map through the store, against the same pixels of the source."""
    pack, (dop_source, dsm_source) = real_pack(name)
    with MapStore(pack) as store:
        west, south, east, north = store.bounds
        width, height = (east - west) / 4, (north - south) / 4
        region = (west + width, south + height, east - width, north - height)
        window = store.read(region, pack.manifest.dop.gsd_m, pack.manifest.dsm.gsd_m)
    with rasterio.open(dop_source) as source:
        place = from_bounds(*window.dop_grid.bounds, source.transform).round_offsets().round_lengths()
        pixels = np.moveaxis(source.read(window=place), 0, -1)
        valid = source.dataset_mask(window=place) > 0
    assert np.array_equal(window.dop_valid, valid)
    difference = np.abs(window.dop.astype(np.int16) - pixels)[valid]
    assert difference.mean() < dop_error

    with rasterio.open(dsm_source) as source:
        place = from_bounds(*window.dsm_grid.bounds, source.transform).round_offsets().round_lengths()
        heights = source.read(1, window=place)
    nodata = heights == -9999.0
    assert np.array_equal(np.isnan(window.dsm), nodata)
    assert np.abs(window.dsm - heights)[~nodata].max() <= pack.manifest.dsm.max_z_error_m + 1e-5


def test_pack_is_two_cogs_that_rasterio_opens(holed_pack):
    for name, bands, levels in (("dop.tif", 3, 3), ("dsm.tif", 1, 2)):
        path = holed_pack.path / name
        # The ghost area is what a COG reader looks for: image directories first, tiles in their order.
        assert b"LAYOUT=IFDS_BEFORE_DATA" in path.read_bytes()[:300]
        with rasterio.open(path) as dataset:
            assert dataset.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"
            assert dataset.count == bands
            assert dataset.crs.to_epsg() == 32633
            assert dataset.block_shapes[0] == (512, 512)
            assert 1 + len(dataset.overviews(1)) == levels
            first = int(dataset.get_tag_item("BLOCK_OFFSET_0_0", "TIFF", bidx=1, ovr=levels - 2))
            last = int(dataset.get_tag_item("BLOCK_OFFSET_0_0", "TIFF", bidx=1))
            assert first < last  # the coarsest level comes first


def test_overviews_keep_the_holes_of_the_surface(scene, tmp_path):
    """An overview cell has data exactly where 3 in 4 of the full cells below it have."""
    grid = RasterGrid(2048, 1536, DSM_GRID.west, DSM_GRID.top, 0.072, -0.072)
    heights = dsm_heights(grid)[0]
    rng = np.random.default_rng(1)
    invalid = np.zeros(heights.shape, dtype=bool)
    invalid[:, :1024] = rng.random((1536, 1024)) < 0.3
    for row, column, side in ((100, 1300, 2), (300, 1501, 5), (701, 1403, 64), (900, 1700, 150)):
        invalid[row : row + side, column : column + side] = True
    dsm = write_raster(tmp_path / "dsm.tif", np.where(invalid, np.nan, heights)[None], grid, nodata=float("nan"))
    pack = build_pack(scene[0], dsm, tmp_path / "pack")
    assert sorted(path.name for path in pack.path.iterdir()) == ["dop.tif", "dsm.tif", "manifest.json"]
    assert np.array_equal(dsm_of(pack) == -9999.0, invalid)
    with MapStore(pack) as store:
        assert [one.width for one in store.dsm_grids] == [2048, 1024, 512]
        for factor, level in ((2, store.dsm_grids[1]), (4, store.dsm_grids[2])):
            window = store.read(store.bounds, 0.1, level.gsd_m)
            below = (window.dsm_grid.height, factor, window.dsm_grid.width, factor)
            covered = invalid[: below[0] * factor, : below[2] * factor].reshape(below)
            share = 1.0 - covered.mean(axis=(1, 3))
            assert np.array_equal(np.isnan(window.dsm), share < 0.75)
            # Scattered holes leave fewer cells than at full resolution, not more.
            assert np.isnan(window.dsm[:, : 1000 // factor]).mean() > 0.3
            error = np.abs(window.dsm - plane(centres(window.dsm_grid)))[share >= 0.75]
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
    assert manifest.anchor == (400_070.0, 5_299_930.0)
    assert (manifest.dop.date, manifest.dsm.date) == ("2023-06-04", "2021")
    assert (manifest.dop.attribution, manifest.dsm.licence) == ("© Someone", "dl-de/by-2-0")
    assert (manifest.dop.true_ortho, manifest.dop.sigma_m, manifest.dsm.sigma_m) == (False, 0.2, 0.3)
    assert manifest.dop.compression == "JPEG quality 85"
    assert (manifest.dsm.max_z_error_m, manifest.dsm.nodata) == (0.05, -9999.0)
    assert manifest.vertical.amsl_minus_map_m == -46.0
    assert manifest.dop.grid.raster_grid() == DOP_GRID
    assert manifest.dsm.grid.raster_grid() == DSM_GRID
    assert (manifest.dop.source, manifest.dsm.source) == ("dop_source.tif", "dsm_source.tif")


def test_same_input_gives_the_same_bytes(scene, tmp_path):
    options = PackOptions(created=datetime(2024, 1, 1, tzinfo=UTC))
    one, two = (build_pack(*scene, tmp_path / name, options).path for name in "ab")
    for file in one.iterdir():
        assert file.read_bytes() == (two / file.name).read_bytes()


def test_progress_rises_to_one(scene, tmp_path):
    steps = []
    build_pack(*scene, tmp_path / "pack", progress=lambda *step: steps.append(step))
    fractions = [fraction for fraction, _ in steps]
    assert fractions == sorted(fractions)
    assert (fractions[0], fractions[-1]) == (0.0, 1.0)
    assert all(message for _, message in steps)


def test_auto_height_error_follows_the_gsd(scene, tmp_path):
    assert build_pack(*scene, tmp_path / "pack").manifest.dsm.max_z_error_m == 0.01


@pytest.mark.parametrize("compression", ["webp", "jpeg"])
def test_orthophoto_without_mask_is_valid_everywhere(scene, tmp_path, compression):
    pack = build_pack(*scene, tmp_path / "pack", PackOptions(dop_compression=compression))
    pixels, valid = dop_of(pack)
    assert valid.all()
    assert np.abs(pixels - colours(centres(DOP_GRID))).mean() < 2.0


def test_band_layouts(scene, tmp_path):
    rgb = dop_pixels()
    outside = np.zeros(rgb.shape[1:], dtype=bool)
    outside[:, :300] = True
    alpha = np.where(outside, 0, 255).astype(np.uint8)
    infrared = np.full(rgb.shape[1:], 7, dtype=np.uint8)
    rgb_alpha = (Ci.red, Ci.green, Ci.blue, Ci.alpha)
    black = np.where(outside, 0, rgb)
    for name, bands, profile, is_grey, holed in (
        ("grey", rgb[:1], {}, True, False),
        ("grey_alpha", np.stack([rgb[0], alpha]), {"colorinterp": (Ci.gray, Ci.alpha)}, True, True),
        ("rgba", np.stack([*rgb, alpha]), {"colorinterp": rgb_alpha}, False, True),
        (
            "rgbi",
            np.stack([*rgb, infrared]),
            {"colorinterp": (Ci.red, Ci.green, Ci.blue, Ci.undefined)},
            False,
            False,
        ),
        ("nodata", black, {"nodata": 0}, False, True),
    ):
        dop = write_raster(tmp_path / f"{name}.tif", bands, DOP_GRID, **profile)
        pixels, valid = dop_of(build_pack(dop, scene[1], tmp_path / name))
        assert np.array_equal(~valid, outside & holed), name
        expected = np.repeat(rgb[:1], 3, axis=0) if is_grey else rgb
        assert np.abs(pixels - np.moveaxis(expected, 0, -1).astype(int))[valid].mean() < 2.0, name


@pytest.mark.parametrize("sentinel", [-9999.0, -32767.0, 3.4e38, -3.4028234663852886e38, np.inf])
def test_undeclared_nodata_is_taken_for_it_and_said_so(scene, tmp_path, caplog, sentinel):
    heights = dsm_heights()
    heights[0, 50:80, 60:90] = sentinel
    dsm = write_raster(tmp_path / "dsm.tif", heights, DSM_GRID)
    with caplog.at_level(logging.WARNING):
        found = dsm_of(build_pack(scene[0], dsm, tmp_path / "pack"))
    hole = np.zeros(found.shape, dtype=bool)
    hole[50:80, 60:90] = True
    assert np.array_equal(found == -9999.0, hole)
    assert np.isinf(sentinel) or "taken for nodata" in caplog.text


def test_undeclared_zeros_around_the_surface_are_nodata_and_said_so(scene, tmp_path, caplog):
    heights = dsm_heights()
    collar = np.zeros(heights.shape[1:], dtype=bool)
    collar[:, :300] = collar[600:, :] = True
    lake = np.zeros_like(collar)
    lake[100:120, 400:430] = True  # away from the border: the file says so, let it stand
    heights[0, collar | lake] = 0.0
    dsm = write_raster(tmp_path / "dsm.tif", heights, DSM_GRID)
    with caplog.at_level(logging.WARNING):
        pack = build_pack(scene[0], dsm, tmp_path / "pack")
    assert np.array_equal(dsm_of(pack) == -9999.0, collar)
    assert pack.manifest.dsm.valid_fraction == pytest.approx(1 - collar.mean())
    assert f"{dsm}: heights of exactly 0 from the border inward, {100 * collar.mean():.1f} %" in caplog.text


def test_zeros_beside_low_ground_are_sea(scene, tmp_path, caplog):
    heights = dsm_heights() - 300.0  # -26 to 44 m
    heights[0, :, :300] = 0.0
    dsm = write_raster(tmp_path / "dsm.tif", heights, DSM_GRID)
    pack = build_pack(scene[0], dsm, tmp_path / "pack")
    assert pack.manifest.dsm.valid_fraction == 1.0
    flat = write_raster(tmp_path / "flat.tif", np.zeros_like(heights), DSM_GRID)
    assert build_pack(scene[0], flat, tmp_path / "flat").manifest.dsm.valid_fraction == 1.0
    assert "nodata" not in caplog.text


def test_undeclared_black_around_the_orthophoto_is_no_data_and_said_so(scene, tmp_path, caplog):
    pixels = dop_pixels()
    collar = np.zeros(pixels.shape[1:], dtype=bool)
    collar[:40], collar[:, -200:] = True, True
    roof = np.zeros_like(collar)
    roof[500:700, 500:700] = True
    pixels[:, collar | roof] = 0
    dop = write_raster(tmp_path / "dop.tif", pixels, DOP_GRID)
    with caplog.at_level(logging.WARNING):
        pack = build_pack(dop, scene[1], tmp_path / "pack")
    assert np.array_equal(~dop_of(pack)[1], collar)
    assert f"{dop}: black from the border inward" in caplog.text
    pixels = dop_pixels()
    pixels[:, :60, :60] = 0  # 0.2 % of it: a shadow
    dop = write_raster(tmp_path / "shadow.tif", pixels, DOP_GRID)
    assert build_pack(dop, scene[1], tmp_path / "shadow").manifest.dop.valid_fraction == 1.0


def test_few_absurd_heights_are_nodata_and_said_so(scene, tmp_path, caplog):
    heights = dsm_heights()
    heights[0, 50:52, 60:80] = -719.3
    heights[0, 300, 300:310] = 12_000.0
    dsm = write_raster(tmp_path / "dsm.tif", heights, DSM_GRID)
    with caplog.at_level(logging.WARNING):
        pack = build_pack(scene[0], dsm, tmp_path / "pack")
    spikes = (heights[0] < 0) | (heights[0] > 9000)
    assert np.array_equal(dsm_of(pack) == -9999.0, spikes)
    assert f"{dsm}: 50 heights (0.01 %) beyond -500 to 9000 m (-719.3 to 12000 m) taken for nodata" in caplog.text
    heights[0, :20] = -719.3
    dsm = write_raster(tmp_path / "other.tif", heights, DSM_GRID)
    with pytest.raises(MapError, match=r"other.tif: 3\.\d % of the heights lie beyond"):
        build_pack(scene[0], dsm, tmp_path / "other")


def test_scaled_integer_heights_are_scaled(scene, tmp_path):
    path = tmp_path / "dsm.tif"
    stored = np.rint(dsm_heights() * 100 - 30000).astype(np.int16)
    stored[0, :10, :10] = -32768
    write_raster(path, stored, DSM_GRID, nodata=-32768)
    with rasterio.open(path, "r+") as target:
        target.scales, target.offsets = (0.01,), (300.0,)
    found = dsm_of(build_pack(scene[0], path, tmp_path / "pack"))
    assert np.all(found[:10, :10] == -9999.0)
    assert np.abs(found - dsm_heights()[0])[10:].max() < 0.016


def test_source_with_rows_running_north(tmp_path):
    """Legal GeoTIFF, written by some simulators."""
    south_up = [RasterGrid(g.width, g.height, g.west, g.top, g.dx, -g.dy) for g in (DOP_GRID, DSM_GRID)]
    transforms = [Affine(g.dx, 0, g.west, 0, g.dy, g.top) for g in south_up]
    dop = write_raster(tmp_path / "dop.tif", dop_pixels(), south_up[0], transform=transforms[0])
    dsm = write_raster(tmp_path / "dsm.tif", dsm_heights(south_up[1]), south_up[1], transform=transforms[1])
    pack = build_pack(dop, dsm, tmp_path / "pack")
    with MapStore(pack) as store:
        xy = np.array([[DSM_GRID.west + 30.0, DSM_GRID.top + 40.0]])
        assert store.heights(xy)[0] == pytest.approx(300.0 + 9.0 - 8.0, abs=0.02)


def test_vertical_system_of_a_compound_crs_is_taken(scene, tmp_path):
    dsm = write_raster(tmp_path / "dsm.tif", dsm_heights(), DSM_GRID, crs="EPSG:32633+5773")
    pack = build_pack(scene[0], dsm, tmp_path / "pack")
    assert pack.manifest.crs == CRS
    assert (pack.manifest.vertical.kind, pack.manifest.vertical.epsg) == ("orthometric", 5773)
    assert pack.manifest.vertical.amsl_minus_map_m == 0.0


def other_grid(grid, **changes):
    fields = {name: getattr(grid, name) for name in ("width", "height", "west", "top", "dx", "dy")}
    return RasterGrid(**(fields | changes))


def _rotated(folder):
    turned = Affine(0.098, 0.017, 4e5, 0.017, -0.098, 5.3e6)
    _, dsm = write_scene(folder)
    return write_raster(folder / "turned.tif", dop_pixels(), DOP_GRID, transform=turned), dsm


def _with_dop(crs=CRS, pixels=None, grid=DOP_GRID, **profile):
    def make(folder):
        pixels_here = dop_pixels() if pixels is None else pixels
        path = write_raster(folder / "other.tif", pixels_here, grid, crs, **profile)
        return path, write_scene(folder)[1]

    return make


def _with_dsm(crs=CRS, heights=None, grid=DSM_GRID, **profile):
    def make(folder):
        heights_here = dsm_heights() if heights is None else heights
        path = write_raster(folder / "other.tif", heights_here, grid, crs, **profile)
        return write_scene(folder)[0], path

    return make


def _feet(folder):
    return write_scene(folder, "EPSG:2225")


def _garbage(folder):
    dop, dsm = write_scene(folder)
    dop.write_bytes(b"II*\0" + b"\xff" * 100)
    return dop, dsm


def _truncated(folder):
    dop, dsm = write_scene(folder)
    dsm.write_bytes(dsm.read_bytes()[: dsm.stat().st_size // 2])
    return dop, dsm


def _missing(folder):
    return folder / "nowhere.tif", write_scene(folder)[1]


DEGREES = {"grid": other_grid(DOP_GRID, west=15.0, top=48.0, dx=1e-6, dy=-1e-6)}


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (_missing, "nowhere.tif: cannot be opened"),
        (_garbage, "dop_source.tif: cannot be opened"),
        (_truncated, "dsm_source.tif: cannot be decoded"),
        (_rotated, "turned.tif: rotated or sheared.*gdalwarp"),
        (_with_dsm(crs="EPSG:32632"), "other.tif: CRS is .*32N.*gdalwarp -t_srs EPSG:32633"),
        (_with_dsm(crs=None), "other.tif: no CRS.*a_srs"),
        (_with_dop(crs=None), "other.tif: no CRS.*a_srs"),
        (_with_dop(crs="EPSG:4326", **DEGREES), "other.tif: WGS 84 is geographic"),
        (_with_dop(crs=None, **DEGREES), "looks like degrees"),
        (_feet, "US survey foot"),
        (_with_dsm(crs="EPSG:32633+6360"), "US survey foot|foot"),
        (_with_dsm(grid=other_grid(DSM_GRID, west=410_000.0)), "do not overlap"),
        (_with_dsm(heights=np.full_like(dsm_heights(), -9999.0), nodata=-9999.0), "no valid height"),
        (_with_dsm(heights=np.full_like(dsm_heights(), np.nan)), "no valid height"),
        (_with_dsm(heights=dsm_heights() - 20_000.0), "nodata"),
        (_with_dsm(heights=np.repeat(dsm_heights(), 3, axis=0)), "3 bands"),
        (_with_dop(pixels=dop_pixels().astype(np.uint16)), "uint16.*-ot Byte"),
        (_with_dop(pixels=dop_pixels()[:2]), "two bands"),
        (_with_dop(pixels=np.zeros_like(dop_pixels()), nodata=0), "no valid pixel"),
        (
            _with_dop(pixels=dop_pixels()[:1], photometric="palette", colorinterp=(Ci.palette,)),
            "palette.*-expand rgb",
        ),
    ],
)
def test_unusable_rasters_are_refused_and_leave_nothing(tmp_path, make, message):
    sources, target = tmp_path / "sources", tmp_path / "target"
    sources.mkdir()
    target.mkdir()
    with pytest.raises(MapError, match=message):
        build_pack(*make(sources), target / "pack")
    assert list(target.iterdir()) == []


def test_raster_without_georeference_is_refused(scene, tmp_path):
    cv2.imwrite(str(tmp_path / "dop.png"), np.full((64, 64, 3), 9, dtype=np.uint8))
    with pytest.raises(MapError, match=r"no georeference.*world file"):
        build_pack(tmp_path / "dop.png", scene[1], tmp_path / "pack")


def test_missing_coverage_of_the_surface_model_is_said(scene, tmp_path, caplog):
    heights = dsm_heights()[:, :100, :100]
    dsm = write_raster(tmp_path / "dsm.tif", heights, other_grid(DSM_GRID, width=100, height=100))
    with caplog.at_level(logging.WARNING):
        build_pack(scene[0], dsm, tmp_path / "pack")
    assert "covers only" in caplog.text


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


def snapshot(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_existing_pack_needs_force(scene, tmp_path):
    out = tmp_path / "pack"
    build_pack(*scene, out)
    before = snapshot(out)
    with pytest.raises(MapError, match="--force"):
        build_pack(*scene, out)
    assert snapshot(out) == before
    build_pack(*scene, out, PackOptions(force=True, quality=50))
    assert Pack.open(out).manifest.dop.compression == "WEBP quality 50"
    assert [path.name for path in tmp_path.iterdir()] == ["pack"]


def test_force_spares_what_is_no_pack(scene, tmp_path):
    photos = tmp_path / "photos"
    photos.mkdir()
    (photos / "holiday.jpg").write_text("dear")
    with pytest.raises(MapError, match="no area pack"):
        build_pack(*scene, photos, PackOptions(force=True))
    assert (photos / "holiday.jpg").read_text() == "dear"
    sources = write_scene(tmp_path / "inside")
    with pytest.raises(MapError, match="contains the source"):
        build_pack(*sources, tmp_path / "inside", PackOptions(force=True))


@pytest.mark.parametrize("at", [0.3, 0.75, 0.9])
def test_interrupted_build_leaves_the_old_pack(scene, tmp_path, at):
    out = tmp_path / "pack"
    build_pack(*scene, out)
    before = snapshot(out)

    def interrupt(fraction, message):
        if fraction >= at:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        build_pack(*scene, out, PackOptions(force=True, quality=50), interrupt)
    assert snapshot(out) == before
    assert [path.name for path in tmp_path.iterdir()] == ["pack"]


def test_failed_swap_puts_the_old_pack_back(scene, tmp_path, monkeypatch):
    out = tmp_path / "pack"
    build_pack(*scene, out)
    before = snapshot(out)
    rename = build.Path.rename

    def failing(self, target):
        if self.name.endswith(".partial"):
            raise OSError(5, "Input/output error")
        return rename(self, target)

    monkeypatch.setattr(build.Path, "rename", failing)
    with pytest.raises(MapError, match="Input/output error"):
        build_pack(*scene, out, PackOptions(force=True))
    assert snapshot(out) == before
    assert [path.name for path in tmp_path.iterdir()] == ["pack"]


@pytest.mark.parametrize("limit_bytes", [5_000, 60_000])
def test_full_disk_is_a_map_error_and_leaves_nothing(tmp_path, limit_bytes):
    """RLIMIT_FSIZE makes the kernel refuse real writes of GDAL's, as a full disk does."""
    sources = write_holed_scene(tmp_path / "sources")
    target = tmp_path / "target"
    target.mkdir()
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit_bytes, before[1]))
    try:
        with pytest.raises(MapError, match=r"pack: .*(free space|check the disk)"):
            build_pack(*sources, target / "pack")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert list(target.iterdir()) == []


def test_unwritable_place_is_a_map_error(scene, tmp_path):
    blocker = tmp_path / "file"
    blocker.write_text("")
    with pytest.raises(MapError, match="cannot be written"):
        build_pack(*scene, blocker / "pack")


def test_written_pack_that_does_not_read_back_is_not_installed(scene, tmp_path, monkeypatch):
    monkeypatch.setattr(Pack, "verify", lambda self: ["dop.tif: tile lost"])
    with pytest.raises(MapError, match="tile lost"):
        build_pack(*scene, tmp_path / "pack")
    assert list(tmp_path.iterdir()) == []


def test_pack_can_be_read_by_another_user(plane_pack):
    assert plane_pack.path.stat().st_mode & 0o055 == 0o055
    assert json.loads((plane_pack.path / "manifest.json").read_text())["format"] == "ortholoc-pack"
