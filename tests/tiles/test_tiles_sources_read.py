"""Pixels of sources on a grid of the pack: copied exactly, or resampled once without inventing any."""

import numpy as np
import pyproj
import pytest
from test_tiles_sources import CRS, GRID, only, picture, raster, relief

from ortholoc_edge.errors import MapError
from ortholoc_edge.geometry.grid import RasterGrid
from ortholoc_edge.tiles.sources import (
    discover,
    is_copied,
    prepare,
    read_dop,
    read_dsm,
    transform_caveat,
    with_common_stretch,
)


def centres(grid):
    u, v = np.meshgrid(np.arange(grid.width), np.arange(grid.height))
    return grid.map_from_px(np.stack([u, v], axis=-1))


def test_pixels_on_the_lattice_are_copied(tmp_path):
    pixels, heights = picture(4), relief()
    mask = np.random.default_rng(5).random(pixels.shape[1:]) > 0.3
    dop = only(raster(tmp_path / "a.tif", pixels, photometric="RGB", alpha="NO", mask=mask))
    dsm = only(raster(tmp_path / "b.tif", heights), "dsm")
    grid = GRID.crop(-7, 30, 80, 20)
    assert is_copied(dop, grid, CRS)
    # Rounding of coordinates in millions of metres is no shift.
    jittered = RasterGrid(80, 20, grid.west + 1e-9, grid.top - 1e-9, grid.dx, grid.dy)
    for target in (grid, jittered):
        got = read_dop(dop, target, CRS)
        expected = np.zeros((4, 20, 80), np.uint8)
        expected[:, :10, 7:67] = (pixels * mask)[:, 30:]
        assert np.array_equal(np.concatenate([got.rgb, got.nir[None]]), expected)
        assert np.array_equal(got.valid[:10, 7:67], mask[30:]) and got.valid.sum() == mask[30:].sum()
        surface = read_dsm(dsm, target, CRS)
        assert np.array_equal(surface[:10, 7:67], heights[0, 30:])
        assert np.isnan(surface).sum() == surface.size - 600


def test_grid_beside_the_source_is_empty(tmp_path):
    dop, dsm = only(raster(tmp_path / "a.tif", picture())), only(raster(tmp_path / "b.tif", relief()), "dsm")
    far = GRID.crop(500, 500, 32, 32)
    off = RasterGrid(32, 32, 9e5, 1e5, 0.3, -0.3)
    for grid, crs in ((far, CRS), (off, CRS), (off, "EPSG:25833"), (RasterGrid(8, 8, 1e9, 1e9, 1, -1), "EPSG:25833")):
        assert not read_dop(dop, grid, crs).valid.any()
        assert np.isnan(read_dsm(dsm, grid, crs)).all()


def test_two_tiles_meet_bit_exactly(tmp_path):
    whole = picture(grid=RasterGrid(120, 40, 0, 0, 1, -1))
    one = only(raster(tmp_path / "a.tif", whole[:, :, :60]))
    other = only(raster(tmp_path / "b.tif", whole[:, :, 60:], grid=GRID.crop(60, 0, 60, 40)))
    grid = GRID.crop(0, 0, 120, 40)
    assert np.array_equal(read_dop(one, grid, CRS).rgb + read_dop(other, grid, CRS).rgb, whole)


WAVE_M = 8.0


def waves(xy):
    """Two waves, along east and along north, whose phases tell shifts of either."""
    phase = 2 * np.pi * xy / WAVE_M
    return np.stack(
        [128 + 100 * np.sin(phase[..., 0]), 128 + 100 * np.sin(phase[..., 1]), np.full(xy.shape[:-1], 90.0)]
    )


def shift_px(got, expected_xy, gsd):
    """Shift along east and north, in pixels, that explains the difference from :func:`waves`."""
    shifts = []
    for axis in range(2):
        phase = 2 * np.pi * expected_xy[..., axis] / WAVE_M
        slope = 100 * np.cos(phase) * 2 * np.pi / WAVE_M
        error = got[axis].astype(float) - (128 + 100 * np.sin(phase))
        shifts.append((error * slope).sum() / (slope**2).sum() / gsd)
    return shifts


@pytest.mark.parametrize(
    ("source_crs", "target_crs", "lon"),
    [("EPSG:25833", CRS, 11.9), (CRS, "EPSG:25833", 12.0), ("EPSG:4326", CRS, 9.0), ("EPSG:2056", CRS, 8.6)],
)
def test_warp_is_exact_to_a_fraction_of_a_pixel(tmp_path, source_crs, target_crs, lon):
    to_source = pyproj.Transformer.from_crs("EPSG:4258", source_crs, always_xy=True)
    to_target = pyproj.Transformer.from_crs(source_crs, target_crs, always_xy=True)
    x, y = to_source.transform(lon, 47.5)
    step = (0.5 / 75_000, 0.5 / 111_000) if source_crs == "EPSG:4326" else (0.5, 0.5)
    grid = RasterGrid(700, 640, x, y, step[0], -step[1])
    xy = np.stack(to_target.transform(*np.moveaxis(centres(grid), -1, 0)), axis=-1)
    path = raster(tmp_path / "a.tif", np.rint(waves(xy)).astype(np.uint8), grid=grid, crs=source_crs)
    heights = (200 + 0.01 * (xy[..., 0] - xy[0, 0, 0]) - 0.02 * (xy[..., 1] - xy[0, 0, 1]))[None].astype(np.float32)
    surface = raster(tmp_path / "b.tif", heights, grid=grid, crs=source_crs)
    centre = xy[320, 350]
    target = RasterGrid(300, 300, round(centre[0]) - 75, round(centre[1]) + 75, 0.5, -0.5)
    source = only(path)
    assert not is_copied(source, target, target_crs)
    got = read_dop(source, target, target_crs)
    assert got.valid.all()
    assert np.abs(shift_px(got.rgb, centres(target), 0.5)).max() < 0.01
    assert np.abs(got.rgb - waves(centres(target))).mean() < 2.5
    heights_got = read_dsm(only(surface, "dsm"), target, target_crs)
    expected = 200 + 0.01 * (centres(target)[..., 0] - xy[0, 0, 0]) - 0.02 * (centres(target)[..., 1] - xy[0, 0, 1])
    assert np.abs(heights_got - expected).max() < 1e-3


def test_pieces_of_the_grid_are_pixels_of_the_whole(tmp_path):
    """Tiles are read on their own, in processes of their own: they must not show their borders."""
    grid = RasterGrid(900, 900, 800_000.0, 5_650_000.0, 0.5, -0.5)
    source = only(raster(tmp_path / "a.tif", picture(grid=grid), grid=grid))
    surface = only(raster(tmp_path / "b.tif", relief(grid=grid), grid=grid), "dsm")
    x, y = pyproj.Transformer.from_crs(CRS, "EPSG:25833", always_xy=True).transform(800_225.0, 5_649_775.0)
    for pixel in (0.5, 0.6, 1.6):
        whole = RasterGrid(256, 256, round(x) - 128 * pixel, round(y) + 128 * pixel, pixel, -pixel)
        dop, dsm = read_dop(source, whole, "EPSG:25833"), read_dsm(surface, whole, "EPSG:25833")
        for row, column in ((0, 0), (0, 128), (128, 0), (128, 128)):
            piece = whole.crop(column, row, 128, 128)
            part = np.s_[row : row + 128, column : column + 128]
            got = read_dop(source, piece, "EPSG:25833")
            assert np.array_equal(got.valid, dop.valid[part])
            assert np.abs(got.rgb.astype(int) - dop.rgb[:, *part]).max() <= 1
            heights = read_dsm(surface, piece, "EPSG:25833")
            same = np.isclose(heights, dsm[part], atol=1e-2, equal_nan=True)
            assert same.mean() > 0.999


def test_abutting_tiles_leave_no_gap_and_no_overlap_when_warped(tmp_path):
    columns = ((0, 300), (300, 600))
    whole = RasterGrid(600, 600, 790_000.0, 5_650_000.0, 0.5, -0.5)
    pixels = picture(grid=whole)
    tiles = []
    for n, (top, bottom) in enumerate(columns):
        for m, (left, right) in enumerate(columns):
            path = tmp_path / f"{n}{m}.tif"
            grid = whole.crop(left, top, right - left, bottom - top)
            tiles.append(only(raster(path, pixels[:, top:bottom, left:right], grid=grid)))
    x, y = pyproj.Transformer.from_crs(CRS, "EPSG:25833", always_xy=True).transform(790_150.0, 5_649_850.0)
    for pixel in (0.4, 0.5, 1.3):
        target = RasterGrid(100, 100, round(x) - 50 * pixel, round(y) + 50 * pixel, pixel, -pixel)
        counts = sum(read_dop(tile, target, "EPSG:25833").valid.astype(int) for tile in tiles)
        assert (counts == 1).all()


def test_masked_pixels_do_not_bleed(tmp_path):
    pixels = np.full((3, 40, 60), 100, np.uint8)
    mask = np.ones((40, 60), bool)
    mask[:, 30:] = False
    pixels[:, :, 30:] = 255
    source = only(raster(tmp_path / "a.tif", pixels, mask=mask))
    for pixel in (0.45, 0.5, 1.1):
        grid = RasterGrid(40, 30, GRID.west + 0.2, GRID.top - 0.2, pixel, -pixel)
        got = read_dop(source, grid, CRS)
        assert set(np.unique(got.rgb[0][got.valid])) == {100} and not got.rgb[:, ~got.valid].any()
        border = (centres(grid)[..., 0] < GRID.west + 15) & (centres(grid)[..., 1] > GRID.top - 20)
        assert np.array_equal(got.valid, border)


def test_mean_where_the_target_is_coarser(tmp_path):
    pixels = picture(grid=RasterGrid(64, 64, 0, 0, 1, -1))
    source = only(raster(tmp_path / "a.tif", pixels))
    got = read_dop(source, RasterGrid(16, 16, GRID.west, GRID.top, 2.0, -2.0), CRS)
    mean = pixels.reshape(3, 16, 4, 16, 4).mean(axis=(2, 4))
    assert got.valid.all() and np.abs(got.rgb - mean).max() <= 0.51


def test_local_metres_are_resampled_too(tmp_path):
    heights = relief() * 0 + np.arange(60, dtype=np.float32) * 0.1
    source = only(raster(tmp_path / "a.tif", heights, crs=None), "dsm")
    got = read_dsm(source, RasterGrid(20, 20, GRID.west + 5.25, GRID.top - 5, 0.5, -0.5), None)
    assert np.allclose(got, (np.arange(20) + 10.5) * 0.1, atol=1e-4)


def test_heights_are_not_invented_at_walls(tmp_path):
    heights = np.full((1, 40, 60), 100, np.float32)
    heights[:, :, 30:] = 110
    heights[:, 10:12, 10:12] = np.nan
    heights[:, 20, 20] = -9999
    heights[:, 25, 5] = 1e38
    source = only(raster(tmp_path / "a.tif", heights, nodata=float("nan")), "dsm")
    sharp = np.where(np.abs(heights[0]) > 1e3, np.nan, heights[0])
    for pixel in (0.45, 0.5, 1.2):
        grid = RasterGrid(40, 30, GRID.west + 0.2, GRID.top - 0.2, pixel, -pixel)
        u, v = np.moveaxis(np.rint(GRID.px_from_map(centres(grid))).astype(int), -1, 0)
        expected = np.where((u < 60) & (v < 40), sharp[np.minimum(v, 39), np.minimum(u, 59)], np.nan)
        assert np.array_equal(read_dsm(source, grid, CRS), expected, equal_nan=True)


def test_upside_down_rasters_are_read(tmp_path):
    grid = RasterGrid(60, 40, GRID.west, GRID.bounds[1], 0.5, 0.5)
    source = only(raster(tmp_path / "a.tif", picture()[:, ::-1], grid=grid))
    assert np.array_equal(read_dop(source, GRID, CRS).rgb, picture())


# 16 bits


def deep(seed=0, dtype="uint16"):
    pixels = picture(4, dtype=dtype, seed=seed)
    pixels[3] = pixels[3] // 4 + 1000
    return pixels


def test_one_stretch_for_all(tmp_path):
    first = deep()
    paths = [raster(tmp_path / "a.tif", first, photometric="RGB", alpha="NO")]
    paths.append(raster(tmp_path / "b.tif", deep(1) // 2, photometric="RGB", alpha="NO", grid=GRID.crop(60, 0, 60, 40)))
    paths.append(raster(tmp_path / "c.tif", picture(), grid=GRID.crop(0, 40, 60, 40)))
    sources = discover(paths, "dop")
    with pytest.raises(MapError, match="no common stretch"):
        read_dop(sources[0], GRID, CRS)
    stretched = with_common_stretch(sources)
    assert stretched[2] == sources[2] and stretched[0].stretch == stretched[1].stretch
    low, high = stretched[0].stretch.rgb
    both = np.concatenate([first[:3].ravel(), (deep(1) // 2)[:3].ravel()])
    assert (low, high) == pytest.approx(np.quantile(both, [0.005, 0.995]), abs=40)
    got = read_dop(stretched[0], GRID, CRS)
    expected = np.clip(np.rint((first[:3].astype(float) - low) * 255 / (high - low)), 0, 255)
    assert np.abs(got.rgb - expected).max() <= 1
    assert got.nir.max() > 240 and got.nir.min() > 15
    # Resampled pixels are stretched alike.
    moved = read_dop(stretched[0], RasterGrid(60, 40, GRID.west + 0.01, GRID.top, 0.5, -0.5), CRS)
    assert np.abs(moved.rgb.astype(int) - got.rgb)[:, :, 1:-1].mean() < 4
    # A copy keeps its depth, for the stretch to come.
    assert prepare(sources[0], tmp_path / "work") == sources[0]


def test_signed_reflectance(tmp_path):
    pixels = picture(3, dtype="int16")
    pixels[:, :, :3] = -20
    (source,) = with_common_stretch([only(raster(tmp_path / "a.tif", pixels, photometric="RGB"))])
    got = read_dop(source, GRID, CRS)
    assert got.valid.all() and not got.rgb[:, :, :3].any() and got.rgb.max() == 255
    moved = read_dop(source, RasterGrid(60, 40, GRID.west + 0.1, GRID.top, 0.5, -0.5), CRS)
    assert moved.valid.all() and not moved.rgb[:, :, 1:2].any()


def test_deep_collar_is_left_out_but_zeros_inside_are_not(tmp_path, caplog):
    pixels = deep()
    pixels[:, :, :5] = 0
    pixels[:3, 20, 30] = 0
    path = raster(tmp_path / "a.tif", pixels, photometric="RGB", alpha="NO")
    source = prepare(only(path), tmp_path / "work")
    assert "black from the border inward" in caplog.text and source.dtype == "uint16" and source.nir == 4
    got = read_dop(with_common_stretch([source])[0], GRID, CRS)
    assert not got.valid[:, :5].any() and got.valid[:, 5:].all()


def test_rough_ways_between_systems_are_told(tmp_path):
    # No grid exists for the European datum of 1950, and none is in PROJ's wheel for the British one.
    old = only(raster(tmp_path / "a.tif", picture(), crs="EPSG:23032"))
    assert "has an error of about 2 m" in transform_caveat(old, CRS) and transform_caveat(old, "EPSG:23032") is None
    grid = RasterGrid(60, 40, 450_000.0, 200_000.0, 0.5, -0.5)
    british = only(raster(tmp_path / "c.tif", picture(grid=grid), grid=grid, crs="EPSG:27700"))
    assert "error" in transform_caveat(british, "EPSG:25830")
    new = only(raster(tmp_path / "b.tif", picture()))
    assert transform_caveat(new, "EPSG:25833") is None and transform_caveat(new, None) is None
