"""Pixels on the map, against rasterio's reading of GDAL's affine."""

import numpy as np
import pytest
import rasterio.transform
from hypothesis import given
from hypothesis import strategies as st
from strategies import finite, grids

from ortholoc_edge.geometry.grid import RasterGrid, resize_px


def affine(grid):
    return rasterio.transform.Affine(grid.dx, 0.0, grid.west, 0.0, grid.dy, grid.top)


@given(grids(), finite(-3e4, 3e4), finite(-3e4, 3e4))
def test_pixel_to_map_and_back(grid, u, v):
    # 1e7 m in float64 is exact to 2e-9 m, so to 4e-7 px of 1 cm.
    assert np.allclose(grid.px_from_map(grid.map_from_px([u, v])), [u, v], rtol=0, atol=1e-6)


@given(grids(), finite(-1e7, 1e7), finite(-1e7, 1e7))
def test_map_to_pixel_and_back(grid, x, y):
    assert np.allclose(grid.map_from_px(grid.px_from_map([x, y])), [x, y], rtol=0, atol=1e-7)


@given(grids(), st.integers(0, 19_999), st.integers(0, 19_999))
def test_pixel_centres_agree_with_rasterio(grid, column, row):
    want = rasterio.transform.xy(affine(grid), row, column, offset="center")
    assert np.allclose(grid.map_from_px([column, row]), want, rtol=0, atol=1e-7)


@given(grids(), finite(-3e4, 3e4), finite(-3e4, 3e4))
def test_matrix_says_the_same(grid, u, v):
    assert np.allclose((grid.map_from_px_matrix() @ [u, v, 1.0])[:2], grid.map_from_px([u, v]), rtol=0, atol=1e-7)


def test_known_answers():
    grid = RasterGrid(100, 50, 500_000.0, 5_300_000.0, 0.2, -0.2)
    # The corner of the raster is half a pixel before the centre of its first pixel.
    assert np.allclose(grid.map_from_px([-0.5, -0.5]), [500_000.0, 5_300_000.0])
    assert np.allclose(grid.map_from_px([0, 0]), [500_000.1, 5_299_999.9])
    assert grid.bounds == pytest.approx((500_000.0, 5_299_990.0, 500_020.0, 5_300_000.0))
    assert grid.gsd_m == pytest.approx(0.2)
    assert RasterGrid(2, 3, 0.0, 10.0, 1.0, 4.0).bounds == (0.0, 10.0, 2.0, 22.0)
    assert RasterGrid(2, 3, 0.0, 10.0, 1.0, -4.0).gsd_m == pytest.approx(2.0)


@given(grids())
def test_bounds_are_the_outer_corners(grid):
    west, south, east, north = grid.bounds
    corners = grid.map_from_px([[-0.5, -0.5], [grid.width - 0.5, grid.height - 0.5]])
    assert np.allclose(sorted(corners[:, 0]), [west, east], rtol=0, atol=1e-7)
    assert np.allclose(sorted(corners[:, 1]), [south, north], rtol=0, atol=1e-7)


@given(grids(), st.integers(-500, 500), st.integers(-500, 500), finite(0, 99), finite(0, 99))
def test_crop_keeps_pixels_in_place(grid, column, row, u, v):
    part = grid.crop(column, row, 100, 70)
    assert (part.width, part.height) == (100, 70)
    assert np.allclose(part.map_from_px([u, v]), grid.map_from_px([u + column, v + row]), rtol=0, atol=1e-6)


@given(grids(), st.integers(1, 5000), st.integers(1, 5000), finite(0, 1000), finite(0, 1000))
def test_resized_keeps_places_and_extent(grid, width, height, u, v):
    other = grid.resized(width, height)
    px = resize_px([u, v], (width / grid.width, height / grid.height))
    assert np.allclose(other.map_from_px(px), grid.map_from_px([u, v]), rtol=0, atol=1e-6)
    assert np.allclose(other.bounds, grid.bounds, rtol=0, atol=1e-6)


@given(finite(-1e4, 1e4), finite(0.01, 100))
def test_resize_px_inverts(u, scale):
    assert resize_px(resize_px(u, scale), 1 / scale) == pytest.approx(u, abs=1e-6 / scale + 1e-8)


@pytest.mark.parametrize(
    "values",
    [
        (0, 1, 0.0, 0.0, 1.0, -1.0),
        (1, 0, 0.0, 0.0, 1.0, -1.0),
        (1, 1, 0.0, 0.0, -1.0, -1.0),
        (1, 1, 0.0, 0.0, 1.0, 0.0),
        (1, 1, np.nan, 0.0, 1.0, -1.0),
        (1, 1, 0.0, np.inf, 1.0, -1.0),
    ],
)
def test_unusable_grids_are_refused(values):
    with pytest.raises(ValueError, match="raster"):
        RasterGrid(*values)
