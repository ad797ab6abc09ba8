"""Whole sources judged, awkward ones made plain: fill, nodata, JPEG 2000, text, clouds."""

import gzip
import logging
import sys
import zipfile

import numpy as np
import pytest
import rasterio
import rasterio.shutil
from test_tiles_sources import CRS, GRID, only, picture, raster, relief, zipped

from ortholoc_edge.errors import ConfigError, MapError
from ortholoc_edge.geometry.grid import RasterGrid
from ortholoc_edge.tiles.sources import discover, prepare, read_dop, read_dsm

LARGE = RasterGrid(320, 240, 350_000.0, 5_650_000.0, 0.5, -0.5)


def smooth(grid=LARGE, seed=0):
    """A picture that lossy formats keep, none of it near black or white."""
    import cv2

    pixels = np.random.default_rng(seed).normal(128, 400, (3, grid.height, grid.width))
    return np.clip([cv2.GaussianBlur(band, (0, 0), 5) for band in pixels], 20, 235).astype(np.uint8)


def test_plain_ones_stay_as_they_are(tmp_path):
    for kind, bands in (("dop", picture()), ("dsm", relief())):
        source = only(raster(tmp_path / f"{kind}.tif", bands, compress="DEFLATE"), kind)
        assert prepare(source, tmp_path / "work") == source
    assert not list((tmp_path / "work").iterdir())


def test_copy_is_made_once_and_again_if_it_is_broken(tmp_path):
    pixels = picture()
    pixels[:, :9] = 0
    path = raster(tmp_path / "dop (1).tif", pixels, tags={"TIFFTAG_DATETIME": "2020:01:02 00:00:00"})
    source, work = only(path), tmp_path / "work"
    seen = []
    copy = prepare(source, work, seen.append)
    (file,) = work.iterdir()
    assert copy.file == file and file.name.startswith("dop_1__") and seen[-1] == 1.0
    assert (copy.name, copy.date, copy.crs, copy.grid) == (source.name, source.date, source.crs, source.grid)
    with rasterio.open(file) as dataset:
        assert dataset.profile["tiled"] and dataset.compression.value == "ZSTD" and dataset.crs.to_epsg() == 25832
    stamp, size = file.stat().st_mtime_ns, file.read_bytes()
    assert prepare(source, work) == copy and file.stat().st_mtime_ns == stamp
    file.write_bytes(b"")
    assert prepare(source, work) == copy and file.read_bytes() == size
    raster(path, picture(seed=4), compress="LZW")
    assert prepare(only(path), work).file == path


def test_folder_that_cannot_be_written(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(MapError, match="cannot be written"):
        prepare(only(raster(tmp_path / "a.tif", picture())), tmp_path / "file" / "work")


# Fill


@pytest.mark.parametrize("value", [0, 255])
def test_undeclared_fill_of_an_orthophoto(tmp_path, caplog, value):
    pixels = picture()
    pixels[:, :, :4] = value
    pixels[:, 20:22, 30:33] = value
    source = prepare(only(raster(tmp_path / "a.tif", pixels)), tmp_path / "work")
    got = read_dop(source, GRID, CRS)
    assert not got.valid[:, :4].any() and got.valid[:, 4:].all()
    assert np.array_equal(got.rgb[:, :, 4:], pixels[:, :, 4:])
    assert ("black" if value == 0 else "white") + " from the border inward, 6.7 %" in caplog.text


def test_little_black_at_the_border_is_a_shadow(tmp_path, caplog):
    pixels = picture()
    pixels[:, :1, :11] = 0
    source = only(raster(tmp_path / "a.tif", pixels))
    assert prepare(source, tmp_path / "work") == source and not caplog.records


@pytest.mark.parametrize("quality", [75, 90])
@pytest.mark.parametrize("driver", ["GTiff", "JP2OpenJPEG"])
def test_fill_that_was_compressed_with_loss(tmp_path, quality, driver):
    """How much of the fill is found behind a slanting border, and how much of the picture goes with it."""
    pixels = smooth()
    v, u = np.mgrid[:240, :320]
    outside = u < 60 + 0.3 * v
    pixels[:, outside] = 0
    path = raster(tmp_path / "in.tif", pixels)
    if driver == "GTiff":
        path = raster(tmp_path / "a.tif", pixels, compress="JPEG", photometric="YCBCR", jpeg_quality=quality)
    else:
        rasterio.shutil.copy(path, tmp_path / "a.jp2", driver=driver, QUALITY=str(quality / 10), REVERSIBLE="NO")
        path = tmp_path / "a.jp2"
    got = read_dop(prepare(only(path), tmp_path / "work"), LARGE, CRS)
    assert (got.valid & outside).sum() / outside.sum() < 0.01
    assert (~got.valid & ~outside).sum() / (~outside).sum() < 0.005


def test_zeros_around_a_surface_model(tmp_path, caplog):
    heights = relief()
    heights[:, :6] = 0
    heights[:, 30, 30] = 0
    source = prepare(only(raster(tmp_path / "a.tif", heights), "dsm"), tmp_path / "work")
    got = read_dsm(source, GRID, CRS)
    assert np.isnan(got[:6]).all() and np.array_equal(got[6:], heights[0, 6:])
    assert "heights of exactly 0 from the border inward, 15.0 %" in caplog.text


def test_sea_beside_low_land_stays(tmp_path):
    heights = relief() / 50
    heights[:, :6] = 0
    source = only(raster(tmp_path / "a.tif", heights), "dsm")
    assert prepare(source, tmp_path / "work") == source
    assert (read_dsm(source, GRID, CRS)[:6] == 0).all()


@pytest.mark.parametrize("value", [-9999.0, -32767.0, -32768.0, 3.4e38, -3.4e38, np.nan])
def test_undeclared_nodata(tmp_path, caplog, value):
    heights = relief()
    heights[:, 10:14, 10:20] = value
    source = prepare(only(raster(tmp_path / "a.tif", heights), "dsm"), tmp_path / "work")
    got = read_dsm(source, GRID, CRS)
    assert np.isnan(got[10:14, 10:20]).all() and np.isnan(got).sum() == 40
    assert ("taken for nodata" in caplog.text) == bool(np.isfinite(value))


def test_few_spikes_are_holes_and_many_an_error(tmp_path, caplog):
    heights = relief()
    heights[0, 3, 3], heights[0, 9, 9] = 20_000.0, -600.0
    source = prepare(only(raster(tmp_path / "a.tif", heights), "dsm"), tmp_path / "work")
    assert "2 heights (0.083 %) beyond -500 to 9000 m (-600 to 20000 m)" in caplog.text
    assert np.isnan(read_dsm(source, GRID, CRS)).sum() == 2
    heights[:, :3] = 65535
    with pytest.raises(MapError, match=r"b\.tif: 7\.6 % of the heights .* gdal_edit"):
        prepare(only(raster(tmp_path / "b.tif", heights), "dsm"), tmp_path / "work")


# Formats that are decoded once


def test_jpeg_2000(tmp_path):
    inner = raster(tmp_path / "in.tif", picture(4), photometric="RGB", alpha="NO")
    path = tmp_path / "dop10rgbi_32_350_5649_1_nw_2023.jp2"
    rasterio.shutil.copy(inner, path, driver="JP2OpenJPEG", QUALITY="100", REVERSIBLE="YES")
    source = only(path)
    assert source.slow and source.nir == 4 and source.date == "2023"
    plain = prepare(source, tmp_path / "work")
    assert not plain.slow and plain.name == path.name
    for one in (source, plain):
        got = read_dop(one, GRID, CRS)
        assert np.array_equal(np.concatenate([got.rgb, got.nir[None]]), picture(4))


def test_masks_of_slow_formats_survive(tmp_path):
    pixels = picture(4)
    pixels[3] = np.where(np.arange(60) < 20, 0, 255)
    inner = raster(tmp_path / "in.tif", pixels, photometric="RGB", alpha="YES")
    archive = zipped(tmp_path / "a.zip", inner, compression=zipfile.ZIP_DEFLATED)
    got = read_dop(prepare(only(archive), tmp_path / "work"), GRID, CRS)
    assert np.array_equal(got.valid, pixels[3] > 0) and got.nir is None


def test_ascii_grid(tmp_path):
    heights = np.rint(relief() * 100) / 100
    heights[0, 2, 3] = -9999
    head = "ncols 60\nnrows 40\nxllcorner 350000\nyllcorner 5649980\ncellsize 0.5\nNODATA_value -9999\n"
    path = tmp_path / "dom.asc"
    path.write_text(head + "\n".join(" ".join(f"{h:.2f}" for h in row) for row in heights[0]) + "\n")
    with pytest.raises(MapError, match="--crs"):
        discover([path], "dsm")
    got = read_dsm(prepare(only(path, "dsm", assign_crs=CRS), tmp_path / "work"), GRID, CRS)
    expected = np.where(heights[0] > 0, heights[0], np.nan)
    assert np.allclose(got, expected, atol=1e-4, equal_nan=True)


# Text


def listed(heights, grid, order="rows"):
    """x, y, z of each finite cell's centre."""
    v, u = np.mgrid[: grid.height, : grid.width]
    xy = grid.map_from_px(np.stack([u, v], axis=-1))
    table = np.concatenate([xy, heights[0][..., None]], axis=-1)
    if order == "columns":
        table = np.swapaxes(table, 0, 1)
    table = table.reshape(-1, 3)
    if order == "south":
        table = table[::-1]
    elif order == "any":
        table = np.random.default_rng(0).permutation(table)
    return table[np.isfinite(table[:, 2])]


def text(table, line="{:.2f} {:.2f} {:.3f}", header=""):
    return header + "".join(line.format(*row) + "\n" for row in table)


FORMS = {
    "space": ("{:.2f} {:.2f} {:.3f}", ""),
    "wide": ("   {:.2f}\t{:.2f}    {:.3f}  ", ""),
    "comma": ("{:.2f},{:.2f},{:.3f}", "x,y,z\n"),
    "comma and space": ("{:.2f}, {:.2f}, {:.3f}", "X, Y, Z\n"),
    "semicolon": ("{:.2f};{:.2f};{:.3f};17;0", "# DOM1\n\neast;north;height;a;b\n"),
    "tab": ("{:.2f}\t{:.2f}\t{:.3f}", ""),
    "exponent": ("{:.9e} {:.9e} {:.6e}", ""),
    "north first": ("{1:.2f};{0:.2f};{2:.3f}", "Hochwert;Rechtswert;Hoehe\n"),
}


@pytest.mark.parametrize("form", FORMS)
def test_text_forms(tmp_path, form):
    heights = relief()
    path = tmp_path / "dom1_32_350_5649_1_th_2020-2025.xyz"
    path.write_text(text(listed(heights, GRID), *FORMS[form]))
    source = only(path, "dsm", assign_crs="EPSG:25832+7837")
    assert (source.grid, source.date, source.vertical) == (GRID, "2025", ("orthometric", 7837))
    got = read_dsm(prepare(source, tmp_path / "work"), GRID, CRS)
    assert np.allclose(got, heights[0], atol=1e-3)


def test_text_with_decimal_commas(tmp_path):
    heights = relief()
    for n, line in enumerate(("{:.2f};{:.2f};{:.3f}", "{:.2f} {:.2f} {:.3f}", "{:.2f}\t{:.2f}\t{:.3f}")):
        path = tmp_path / f"{n}.xyz"
        path.write_text(text(listed(heights, GRID), line).replace(".", ","))
        got = read_dsm(prepare(only(path, "dsm", assign_crs=CRS), tmp_path / "work"), GRID, CRS)
        assert np.allclose(got, heights[0], atol=1e-3)


@pytest.mark.parametrize("order", ["rows", "columns", "south", "any"])
@pytest.mark.parametrize("step", [0.2, 0.25, 1.0, 1 / 3])
def test_text_in_any_order_with_gaps(tmp_path, order, step):
    grid = RasterGrid(61, 43, 350_000.0, 5_650_000.0, step, -step)
    heights = relief(grid=grid)
    heights[np.random.default_rng(2).random(heights.shape) < 0.4] = np.nan
    heights[0, 20:25] = heights[0, :, 30:33] = np.nan
    heights[0, 0, 0] = heights[0, -1, -1] = 230
    path = tmp_path / "a.xyz.gz"
    path.write_bytes(gzip.compress(text(listed(heights, grid, order)).encode()))
    source = only(path, "dsm", assign_crs=CRS)
    assert np.allclose(source.grid.bounds, grid.bounds, atol=0.02 * step)
    assert (source.grid.width, source.grid.height) == (61, 43)
    if step != 1 / 3:
        assert source.grid == grid
    got = read_dsm(prepare(source, tmp_path / "work"), source.grid, CRS)
    assert np.allclose(got, heights[0], atol=1e-3, equal_nan=True)


def test_text_in_a_zip_and_a_folder(tmp_path):
    path = tmp_path / "in" / "dom1.xyz"
    path.parent.mkdir()
    path.write_text(text(listed(relief(), GRID)))
    (tmp_path / "in" / "info.txt").write_text("Datenquelle 2020 12 3\n")
    archive = zipped(tmp_path / "dom1_th_2020-2025.zip", path, compression=zipfile.ZIP_DEFLATED, folder="x/")
    source = only(archive, "dsm", assign_crs=CRS)
    assert source.date == "2025"
    assert np.allclose(read_dsm(prepare(source, tmp_path / "work"), GRID, CRS), relief()[0], atol=1e-3)
    assert [s.name for s in discover([tmp_path / "in"], "dsm", assign_crs=CRS)] == ["dom1.xyz"]


def test_text_nodata(tmp_path):
    heights = relief()
    heights[0, 3:5] = -9999
    path = tmp_path / "a.txt"
    path.write_text(text(listed(heights, GRID)))
    got = read_dsm(prepare(only(path, "dsm", assign_crs=CRS), tmp_path / "work"), GRID, CRS)
    assert np.isnan(got[3:5]).all() and np.isfinite(got).sum() == 38 * 60


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("1 2 3\n2 2 3\n1 3 3\nfoo bar\n", "is no regular grid"),
        ("1 2 3\n", "1 points"),
        ("0 0 5\n1 0 5\n2.5 0 5\n0 1 5\n1 1 5\n", "no even steps"),
        ("hello\nworld\n", "no table of x, y and z"),
        ("", "no table of x, y and z"),
        ("1 1 2\n1 2 2\n1 3 nan\n2 1\n", "is no regular grid"),
        ("0 0 1\n1 1 1\n1000000 1000000 1\n", "3 points on 1000001 x 1000001 cells"),
        ("inf 0 1\n1 1 1\n", "no regular grid"),
    ],
)
def test_text_that_is_no_grid(tmp_path, content, message):
    path = tmp_path / "a.xyz"
    path.write_text(content)
    with pytest.raises(MapError, match=rf"a\.xyz: .*{message}"):
        discover([path], "dsm", assign_crs=CRS)


def test_scattered_text_is_no_grid(tmp_path):
    path = tmp_path / "a.xyz"
    points = np.random.default_rng(0).uniform(0, 100, (4000, 3))
    path.write_text(text(points))
    with pytest.raises(MapError, match="is no regular grid"):
        discover([path], "dsm", assign_crs=CRS)


def test_points_are_no_orthophoto(tmp_path):
    path = tmp_path / "a.xyz"
    path.write_text(text(listed(relief(), GRID)))
    with pytest.raises(MapError, match="give it as --dsm"):
        discover([path], "dop", assign_crs=CRS)


# Clouds


def cloud(path, xyz, *, classes=None, returns=None, crs=CRS):
    laspy = pytest.importorskip("laspy")
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.offsets, header.scales = np.floor(xyz.min(axis=0)), [0.001, 0.001, 0.001]
    if crs is not None:
        import pyproj

        header.add_crs(pyproj.CRS.from_user_input(crs))
    las = laspy.LasData(header)
    las.x, las.y, las.z = xyz.T
    las.classification = np.full(len(xyz), 2) if classes is None else classes
    las.return_number = np.ones(len(xyz), int) if returns is None else returns
    las.number_of_returns = np.full(len(xyz), 2)
    las.write(str(path))
    return path


@pytest.mark.parametrize("suffix", ["laz", "las"])
def test_cloud_on_a_grid_keeps_it(tmp_path, suffix):
    """Matched clouds have one point per cell, at its centre."""
    heights = relief()
    heights[0, 5:8, 5:8] = np.nan
    path = cloud(tmp_path / f"bdom50_32_350_5649_1_nw_2022.{suffix}", listed(heights, GRID), crs="EPSG:25832+7837")
    source = only(path, "dsm")
    assert (source.grid, source.crs, source.vertical, source.date) == (GRID, CRS, ("orthometric", 7837), "2022")
    got = read_dsm(prepare(source, tmp_path / "work"), GRID, CRS)
    assert np.allclose(got, heights[0], atol=2e-3, equal_nan=True)
    archive = zipped(tmp_path / "c.zip", path, compression=zipfile.ZIP_DEFLATED)
    assert np.array_equal(read_dsm(prepare(only(archive, "dsm"), tmp_path / "work"), GRID, CRS), got, equal_nan=True)


@pytest.mark.parametrize(("per_m2", "cell"), [(12, 0.5), (4, 1.0), (0.6, 2.0)])
def test_scanned_cloud_gets_cells_by_its_density(tmp_path, per_m2, cell):
    rng = np.random.default_rng(0)
    xyz = rng.uniform((350_000, 5_649_900, 100), (350_100, 5_650_000, 110), (int(per_m2 * 10_000), 3))
    source = only(cloud(tmp_path / "a.laz", xyz), "dsm")
    assert source.grid == RasterGrid(round(100 / cell), round(100 / cell), 350_000.0, 5_650_000.0, cell, -cell)
    got = read_dsm(prepare(source, tmp_path / "work"), source.grid, CRS)
    assert np.isfinite(got).mean() > 0.85
    column, row = ((xyz[:, 0] - 350_000) // cell).astype(int), ((5_650_000 - xyz[:, 1]) // cell).astype(int)
    for k in rng.integers(0, len(xyz), 50):
        same = (column == column[k]) & (row == row[k])
        assert got[row[k], column[k]] == pytest.approx(xyz[same, 2].max(), abs=2e-3)


def test_highest_first_return_without_noise(tmp_path):
    xyz = np.array(
        [
            *[(350_000.5 + x, 5_650_000.5 + y, 100.0) for x in range(4) for y in range(4)],
            *[(350_001.4, 5_650_001.4, z) for z in (104.0, 107.0, 300.0, 400.0)],
        ]
    )
    classes, returns = np.full(20, 2), np.ones(20, int)
    returns[17], classes[18], classes[19] = 2, 7, 18
    source = only(cloud(tmp_path / "a.las", xyz, classes=classes, returns=returns), "dsm", point_cell_m=1.0)
    got = read_dsm(prepare(source, tmp_path / "work"), source.grid, CRS)
    assert source.grid == RasterGrid(4, 4, 350_000.0, 5_650_004.0, 1.0, -1.0)
    assert got[2, 1] == pytest.approx(104.0) and (got == 100).sum() == 15


def test_cloud_without_a_system_needs_one(tmp_path):
    path = cloud(tmp_path / "a.laz", listed(relief(), GRID), crs=None)
    with pytest.raises(MapError, match="--crs"):
        discover([path], "dsm")
    assert only(path, "dsm", assign_crs=CRS).crs == CRS


def test_cloud_without_the_extra(tmp_path, monkeypatch):
    path = cloud(tmp_path / "a.laz", listed(relief(), GRID))
    monkeypatch.setitem(sys.modules, "laspy", None)
    with pytest.raises(ConfigError, match=r"a\.laz.*pip install 'ortholoc-edge\[laz\]'"):
        discover([path], "dsm")


def test_messages_do_not_repeat_for_a_copy(tmp_path, caplog):
    pixels = picture()
    pixels[:, :9] = 0
    source = only(raster(tmp_path / "a.tif", pixels))
    with caplog.at_level(logging.WARNING):
        prepare(source, tmp_path / "work")
        prepare(source, tmp_path / "work")
    assert len(caplog.records) == 1
