import logging

import cv2
import numpy as np
import pytest
import rasterio
from affine import Affine
from rasterio.enums import ColorInterp as Ci
from tile_rasters import (
    CRS,
    DOP_GRID,
    DSM_GRID,
    centres,
    colours,
    dop_of,
    dop_pixels,
    dsm_heights,
    dsm_of,
    write_raster,
    write_scene,
)

from ortholoc_edge.errors import ConfigError, MapError
from ortholoc_edge.geometry.grid import RasterGrid
from ortholoc_edge.tiles.build import PackOptions, build_pack
from ortholoc_edge.tiles.store import MapStore


def built(dop, dsm, out, *, progress=None, **options):
    # JPEG is the faster one.
    options = {"vertical": "unknown", "dop_compression": "jpeg"} | options
    return build_pack(dop, dsm, out, PackOptions(**options), progress)


@pytest.mark.parametrize("compression", ["webp", "jpeg"])
def test_orthophoto_without_mask_is_valid_everywhere(scene, tmp_path, compression):
    pack = built(*scene, tmp_path / "pack", dop_compression=compression)
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
        pixels, valid = dop_of(built(dop, scene[1], tmp_path / name))
        assert np.array_equal(~valid, outside & holed), name
        expected = np.repeat(rgb[:1], 3, axis=0) if is_grey else rgb
        assert np.abs(pixels - np.moveaxis(expected, 0, -1).astype(int))[valid].mean() < 2.0, name


@pytest.mark.parametrize("sentinel", [-9999.0, -32767.0, 3.4e38, -3.4028234663852886e38, np.inf])
def test_undeclared_nodata_is_taken_for_it_and_said_so(scene, tmp_path, caplog, sentinel):
    heights = dsm_heights()
    heights[0, 50:80, 60:90] = sentinel
    dsm = write_raster(tmp_path / "dsm.tif", heights, DSM_GRID)
    with caplog.at_level(logging.WARNING):
        found = dsm_of(built(scene[0], dsm, tmp_path / "pack"))
    hole = np.zeros(found.shape, dtype=bool)
    hole[50:80, 60:90] = True
    assert np.array_equal(np.isnan(found), hole)
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
        pack = built(scene[0], dsm, tmp_path / "pack")
    assert np.array_equal(np.isnan(dsm_of(pack)), collar)
    assert f"{dsm}: heights of exactly 0 from the border inward, {100 * collar.mean():.1f} %" in caplog.text


def test_zeros_beside_low_ground_are_sea(scene, tmp_path, caplog):
    heights = dsm_heights() - 300.0  # -26 to 44 m
    heights[0, :, :300] = 0.0
    dsm = write_raster(tmp_path / "dsm.tif", heights, DSM_GRID)
    pack = built(scene[0], dsm, tmp_path / "pack")
    assert np.isfinite(dsm_of(pack)).all()
    flat = write_raster(tmp_path / "flat.tif", np.zeros_like(heights), DSM_GRID)
    assert np.isfinite(dsm_of(built(scene[0], flat, tmp_path / "flat"))).all()
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
        pack = built(dop, scene[1], tmp_path / "pack")
    assert np.array_equal(~dop_of(pack)[1], collar)
    assert f"{dop}: black from the border inward" in caplog.text
    pixels = dop_pixels()
    pixels[:, :60, :60] = 0  # 0.2 % of it: a shadow
    dop = write_raster(tmp_path / "shadow.tif", pixels, DOP_GRID)
    assert dop_of(built(dop, scene[1], tmp_path / "shadow"))[1].all()


def test_few_absurd_heights_are_nodata_and_said_so(scene, tmp_path, caplog):
    heights = dsm_heights()
    heights[0, 50:52, 60:80] = -719.3
    heights[0, 300, 300:310] = 12_000.0
    dsm = write_raster(tmp_path / "dsm.tif", heights, DSM_GRID)
    with caplog.at_level(logging.WARNING):
        pack = built(scene[0], dsm, tmp_path / "pack", max_hole_cells=0)
    spikes = (heights[0] < 0) | (heights[0] > 9000)
    assert np.array_equal(np.isnan(dsm_of(pack)), spikes)
    assert f"{dsm}: 50 heights (0.01 %) beyond -500 to 9000 m (-719.3 to 12000 m) taken for nodata" in caplog.text
    heights[0, :20] = -719.3
    dsm = write_raster(tmp_path / "other.tif", heights, DSM_GRID)
    with pytest.raises(MapError, match=r"other.tif: 3\.\d % of the heights lie beyond"):
        built(scene[0], dsm, tmp_path / "other")


def test_scaled_integer_heights_are_scaled(scene, tmp_path):
    path = tmp_path / "dsm.tif"
    stored = np.rint(dsm_heights() * 100 - 30000).astype(np.int16)
    stored[0, :10, :10] = -32768
    write_raster(path, stored, DSM_GRID, nodata=-32768)
    with rasterio.open(path, "r+") as target:
        target.scales, target.offsets = (0.01,), (300.0,)
    found = dsm_of(built(scene[0], path, tmp_path / "pack"))
    assert np.isnan(found[:10, :10]).all()
    assert np.abs(found - dsm_heights()[0])[10:].max() < 0.016


def test_source_with_rows_running_north(tmp_path):
    """Legal GeoTIFF, written by some simulators."""
    south_up = [RasterGrid(g.width, g.height, g.west, g.top, g.dx, -g.dy) for g in (DOP_GRID, DSM_GRID)]
    transforms = [Affine(g.dx, 0, g.west, 0, g.dy, g.top) for g in south_up]
    dop = write_raster(tmp_path / "dop.tif", dop_pixels(), south_up[0], transform=transforms[0])
    dsm = write_raster(tmp_path / "dsm.tif", dsm_heights(south_up[1]), south_up[1], transform=transforms[1])
    pack = built(dop, dsm, tmp_path / "pack")
    with MapStore(pack) as store:
        xy = np.array([[DSM_GRID.west + 30.0, DSM_GRID.top + 40.0]])
        assert store.heights(xy)[0] == pytest.approx(300.0 + 9.0 - 8.0, abs=0.02)


def test_heights_without_a_datum_are_refused(scene, tmp_path):
    with pytest.raises(ConfigError, match=r"dsm_source.tif: .*--vertical orthometric"):
        build_pack(*scene, tmp_path / "pack")
    assert list(tmp_path.iterdir()) == []


def test_vertical_system_of_a_compound_crs_is_taken(scene, tmp_path):
    dsm = write_raster(tmp_path / "dsm.tif", dsm_heights(), DSM_GRID, crs="EPSG:32633+5773")
    pack = built(scene[0], dsm, tmp_path / "pack", vertical=None)
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
        (_missing, "nowhere.tif: there is no such file"),
        (_garbage, "dop_source.tif: cannot be read .*TIFF"),
        (_truncated, "dsm_source.tif: cannot be read .*TIFF"),
        (_rotated, "turned.tif: rotated or sheared.*gdalwarp"),
        (_with_dsm(crs="EPSG:32632"), "other.tif: covers .*do not overlap"),
        (_with_dsm(crs=None), "other.tif: no CRS, but other sources have one.*--crs"),
        (_with_dop(crs=None), "other.tif: no CRS, but other sources have one.*--crs"),
        (_with_dop(crs="EPSG:4326", **DEGREES), "do not overlap"),
        (_with_dop(crs=None, **DEGREES), "looks like degrees"),
        (_feet, "US survey foot"),
        (_with_dsm(crs="EPSG:32633+6360"), "US survey foot|foot"),
        (_with_dsm(grid=other_grid(DSM_GRID, west=410_000.0)), "do not overlap"),
        (_with_dsm(heights=np.full_like(dsm_heights(), -9999.0), nodata=-9999.0), "no valid pixel of the surface"),
        (_with_dsm(heights=np.full_like(dsm_heights(), np.nan)), "no valid pixel of the surface model"),
        (_with_dsm(heights=dsm_heights() - 20_000.0), "nodata"),
        (_with_dsm(heights=np.repeat(dsm_heights(), 3, axis=0)), "3 bands"),
        (_with_dop(pixels=dop_pixels().astype(np.float32)), "float32.*-ot UInt16"),
        (_with_dop(pixels=dop_pixels()[:2]), "2 bands.*gdal_translate -b RED"),
        (_with_dop(pixels=np.zeros_like(dop_pixels()), nodata=0), "no valid pixel of the orthophoto"),
    ],
)
def test_unusable_rasters_are_refused_and_leave_nothing(tmp_path, make, message):
    sources, target = tmp_path / "sources", tmp_path / "target"
    sources.mkdir()
    target.mkdir()
    with pytest.raises(MapError, match=message):
        built(*make(sources), target / "pack")
    # Where the other layer's tiles were finished already, they are kept for the next try.
    assert [path.name for path in target.iterdir()] in ([], [".pack.building"])


def test_raster_without_georeference_is_refused(scene, tmp_path):
    cv2.imwrite(str(tmp_path / "dop.png"), np.full((64, 64, 3), 9, dtype=np.uint8))
    with pytest.raises(MapError, match=r"no georeference.*world file"):
        built(tmp_path / "dop.png", scene[1], tmp_path / "pack")


def test_missing_coverage_of_the_surface_model_is_said(scene, tmp_path, caplog):
    heights = dsm_heights()[:, :100, :100]
    dsm = write_raster(tmp_path / "dsm.tif", heights, other_grid(DSM_GRID, width=100, height=100))
    with caplog.at_level(logging.WARNING):
        built(scene[0], dsm, tmp_path / "pack")
    assert "covers only" in caplog.text


