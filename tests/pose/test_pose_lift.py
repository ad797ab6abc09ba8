"""Heights from the surface model."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from strategies import finite

from ortholoc_edge.geometry.grid import RasterGrid, bilinear
from ortholoc_edge.pose.lift import lift
from ortholoc_edge.tiles.window import MapWindow


def plane_raster(width, height, a, b, c):
    v, u = np.mgrid[:height, :width]
    return (a + b * u + c * v).astype(np.float32)


@given(finite(0, 19), finite(0, 9), st.integers(-64, 64), st.integers(-64, 64))
def test_bilinear_is_exact_on_a_plane_up_to_its_edges(u, v, b, c):
    raster = plane_raster(20, 10, 100.0, b / 64, c / 64)
    assert bilinear(raster, [[u, v]])[0] == pytest.approx(100 + b / 64 * u + c / 64 * v, abs=1e-9)


def test_bilinear_known_answer():
    raster = np.array([[1, 2], [3, 8]], dtype=np.float32)
    assert bilinear(raster, [[0.5, 0.5], [0, 0], [1, 1], [1, 0.25], [0.25, 0]]) == pytest.approx([3.5, 1, 8, 3.5, 1.25])


def test_bilinear_off_the_raster_is_nan():
    raster = plane_raster(20, 10, 5.0, 0, 0)
    px = [[-0.01, 5], [19.01, 5], [5, -0.01], [5, 9.01], [np.nan, 5], [5, np.nan], [np.inf, 5], [-0.5, -0.5]]
    assert np.isnan(bilinear(raster, px)).all()
    assert np.isfinite(bilinear(raster, [[0, 0], [19, 9], [19, 0], [0, 9]])).all()
    assert bilinear(raster, np.empty((0, 2))).shape == (0,)


def test_bilinear_beside_a_hole_is_nan_unless_the_hole_takes_no_part():
    raster = plane_raster(20, 10, 0.0, 1.0, 0)
    raster[4, 7] = np.nan
    for px in [(7, 4), (6.5, 4), (7.5, 4), (7, 3.5), (7, 4.5), (6.01, 3.01), (7.99, 4.99)]:
        assert np.isnan(bilinear(raster, [px])[0]), px
    for px in [(6, 4), (8, 4), (7, 3), (7, 5), (6, 3.5), (6.5, 3), (8, 4.5), (6.5, 5)]:
        assert bilinear(raster, [px])[0] == pytest.approx(px[0]), px


@pytest.mark.parametrize("shape", [(1, 1), (1, 5), (5, 1)])
def test_bilinear_on_a_raster_of_one_row_or_column(shape):
    raster = np.arange(shape[0] * shape[1], dtype=np.float32).reshape(shape)
    last = [shape[1] - 1, shape[0] - 1]
    assert bilinear(raster, [[0, 0], last]) == pytest.approx([0, shape[0] * shape[1] - 1])


def window(dop_grid, dsm_grid, dsm):
    shape = (dop_grid.height, dop_grid.width)
    return MapWindow(np.zeros(shape, np.uint8), np.ones(shape, bool), dop_grid, dsm, dsm_grid)


def test_lift_between_grids_of_different_pixel_origin_and_direction():
    """z = 300 + 0.25 (E - E0) - 0.5 (N - N0), sampled on a DSM that is coarser, shifted, and runs north."""
    dop_grid = RasterGrid(200, 100, 500_000.0, 5_300_000.0, 0.5, -0.5)
    dsm_grid = RasterGrid(70, 60, 499_993.25, 5_299_943.5, 1.75, 1.25)
    centres = dsm_grid.map_from_px(np.stack(np.meshgrid(np.arange(70), np.arange(60)), axis=-1))
    dsm = (300 + 0.25 * (centres[..., 0] - 500_000) - 0.5 * (centres[..., 1] - 5_300_000)).astype(np.float32)
    px = np.random.default_rng(0).uniform((0, 0), (199, 99), (500, 2))
    lifted = lift(px, window(dop_grid, dsm_grid, dsm))
    assert len(lifted.kept) == 500
    east, north = 500_000 + 0.5 * (px[:, 0] + 0.5), 5_300_000 - 0.5 * (px[:, 1] + 0.5)
    assert np.allclose(lifted.points_map[:, 0], east, rtol=0, atol=1e-8)
    assert np.allclose(lifted.points_map[:, 1], north, rtol=0, atol=1e-8)
    want = 300 + 0.25 * (east - 500_000) - 0.5 * (north - 5_300_000)
    assert np.allclose(lifted.points_map[:, 2], want, rtol=0, atol=1e-4)


def test_lift_keeps_indices_and_drops_what_has_no_height():
    grid = RasterGrid(10, 10, 0.0, 10.0, 1.0, -1.0)
    dsm = np.full((10, 10), 7.0, dtype=np.float32)
    dsm[2, 3] = np.nan
    px = np.array([[5.0, 5.0], [3.0, 2.0], [20.0, 5.0], [3.4, 2.4], [8.0, 8.0]])
    lifted = lift(px, window(grid, grid, dsm))
    assert lifted.kept.tolist() == [0, 4]
    assert np.allclose(lifted.points_map, [[5.5, 4.5, 7.0], [8.5, 1.5, 7.0]])
    nothing = lift(np.empty((0, 2)), window(grid, grid, dsm))
    assert nothing.points_map.shape == (0, 3)
