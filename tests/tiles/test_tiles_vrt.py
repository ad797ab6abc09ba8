"""The mosaics as GIS programs see them: rasterio's GDAL and the distribution's."""

from __future__ import annotations

import json
import shutil
import subprocess

import numpy as np
import pytest
import rasterio
from lattice_tiles import CRS, DSM_LATTICE, write_pack
from rasterio.enums import ColorInterp, MaskFlags

from ortholoc_edge.tiles.encode import dsm_cog
from ortholoc_edge.tiles.manifest import layer_bounds
from ortholoc_edge.tiles.vrt import DOP_VRT, DSM_VRT, mosaic

needs_gdal = pytest.mark.skipif(shutil.which("gdalinfo") is None, reason="GDAL's command-line tools are not installed")


@pytest.fixture(scope="module")
def pack(tmp_path_factory):
    written = write_pack(tmp_path_factory.mktemp("vrt") / "pack")
    (written.folder / DOP_VRT).write_bytes(mosaic(written.manifest.dop, CRS))
    (written.folder / DSM_VRT).write_bytes(mosaic(written.manifest.dsm, CRS))
    return written


def test_the_dop_is_one_raster_with_the_tiles_pixels_and_mask(pack):
    with rasterio.open(pack.folder / DOP_VRT) as dop:
        assert dop.crs == CRS
        assert dop.bounds == pytest.approx(layer_bounds(pack.manifest.dop))
        assert dop.colorinterp == (ColorInterp.red, ColorInterp.green, ColorInterp.blue)
        assert dop.mask_flag_enums == ([MaskFlags.per_dataset],) * 3
        assert dop.overviews(1) == [4, 16]
        # Lossless, so exact; and black where there is no tile.
        pixels = dop.read()
        np.testing.assert_array_equal(pixels[:, pack.valid], pack.rgb[:, pack.valid])
        assert not pixels[:, 192:, 128:].any()
        np.testing.assert_array_equal(dop.dataset_mask() > 0, pack.valid)


@pytest.mark.parametrize("level", [1, 4, 16])
def test_every_overview_is_that_of_the_tiles(pack, level):
    options = {} if level == 1 else {"overview_level": [4, 16].index(level)}
    with rasterio.open(pack.folder / DOP_VRT, **options) as dop:
        assert dop.shape == (256 // level, 320 // level)
        pixels, mask = dop.read(), dop.dataset_mask() > 0
        np.testing.assert_array_equal(mask, pack.valid[::level, ::level])
        np.testing.assert_array_equal(pixels[:, mask], (pack.rgb[:, ::level, ::level])[:, mask])
    with rasterio.open(pack.folder / DSM_VRT, **options) as dsm:
        expected = pack.heights[::level, ::level]
        np.testing.assert_array_equal(dsm.read(1, masked=True).filled(np.nan), expected)


def test_a_decimated_read_uses_the_tiles_overviews_and_not_every_nth_pixel(tmp_path):
    written = write_pack(tmp_path / "pack")
    tile = written.manifest.dsm.tiles[0]
    slope = np.mgrid[0:128, 0:128][0].astype(np.float32)
    (written.folder / tile.file).write_bytes(dsm_cog(slope, DSM_LATTICE.grid(tile.box), CRS, 0.0))
    (written.folder / DSM_VRT).write_bytes(mosaic(written.manifest.dsm, CRS))
    with rasterio.open(written.folder / DSM_VRT) as dsm:
        np.testing.assert_array_equal(dsm.read(1, out_shape=(32, 32)), slope.reshape(32, 4, 32, 4).mean(axis=(1, 3)))


def test_a_mosaic_is_opened_without_opening_its_tiles(pack, tmp_path):
    # Thousands of them would take seconds.
    for layer, crs in ((pack.manifest.dop, CRS), (pack.manifest.dsm, CRS)):
        (tmp_path / "alone.vrt").write_bytes(mosaic(layer, crs))
        with rasterio.open(tmp_path / "alone.vrt") as alone:
            assert alone.bounds == pytest.approx(layer_bounds(layer))


def test_the_dsm_is_one_raster_with_its_holes(pack):
    with rasterio.open(pack.folder / DSM_VRT) as dsm:
        assert dsm.nodata == -9999.0
        assert dsm.dtypes == ("float32",)
        assert dsm.units == ("m",)
        np.testing.assert_array_equal(dsm.read(1, masked=True).filled(np.nan), pack.heights)


@pytest.mark.parametrize("crs", ["EPSG:31468", "EPSG:2193", None])
def test_easting_comes_first_whatever_the_system_says(pack, tmp_path, crs):
    # Of 31468 and 2193 the first axis is northing.
    (tmp_path / DOP_VRT).write_bytes(mosaic(pack.manifest.dop, crs))
    with rasterio.open(tmp_path / DOP_VRT) as dop:
        assert (None if dop.crs is None else dop.crs.to_string()) == crs
        assert (dop.bounds.left, dop.bounds.top) == (691_276.8, 5_334_976.0)


def test_a_system_as_wkt_and_equal_bytes(pack):
    wkt = rasterio.crs.CRS.from_epsg(25832).to_wkt()
    data = mosaic(pack.manifest.dop, wkt)
    assert data == mosaic(pack.manifest.dop, wkt)
    with rasterio.MemoryFile(data, ext=".vrt") as memory, memory.open() as dop:
        assert dop.crs == CRS


@needs_gdal
def test_the_distributions_gdal_reads_the_mosaics(pack, tmp_path):
    def gdal(*arguments):
        return subprocess.run(arguments, check=True, capture_output=True, text=True, timeout=60).stdout

    told = json.loads(gdal("gdalinfo", "-json", "-mm", str(pack.folder / DSM_VRT)))
    assert told["size"] == [128, 128]
    assert [told["bands"][0][key] for key in ("computedMin", "computedMax", "noDataValue")] == [400, 407, -9999]
    told = json.loads(gdal("gdalinfo", "-json", "-checksum", str(pack.folder / DOP_VRT)))
    assert [band["colorInterpretation"] for band in told["bands"]] == ["Red", "Green", "Blue"]
    assert told["bands"][0]["mask"]["flags"] == ["PER_DATASET"]
    assert [one["size"] for one in told["bands"][0]["overviews"]] == [[80, 64], [20, 16]]
    # A quarter of the size: the tiles' overviews, through the mosaic.
    out = tmp_path / "quarter.tif"
    gdal("gdal_translate", "-q", "-outsize", "25%", "25%", str(pack.folder / DSM_VRT), str(out))
    with rasterio.open(out) as dsm:
        np.testing.assert_array_equal(dsm.read(1, masked=True).filled(np.nan), pack.heights[::4, ::4])
