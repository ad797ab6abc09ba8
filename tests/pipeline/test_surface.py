"""How far a surface model is believed: rough ground that the view does not agree with makes a fix less certain."""

import numpy as np
import pytest

from ortholoc_edge.geometry import rotation
from ortholoc_edge.geometry.grid import RasterGrid
from ortholoc_edge.pipeline.surface import roughness_m, unsettled_covariance, unsettled_m

GRID = RasterGrid(120, 100, 500_000.0, 5_400_100.0, 1.0, -1.0)


def heights(kind: str) -> np.ndarray:
    east, north = np.meshgrid(np.arange(GRID.width), np.arange(GRID.height))
    if kind == "flat":
        return np.full(east.shape, 300.0, np.float32)
    if kind == "slope":
        return (300.0 + 0.3 * east - 0.2 * north).astype(np.float32)
    # Crowns 6 m apart, 5 m high from valley to top.
    return (315.0 + 2.5 * np.cos(np.pi * east / 3.0) * np.cos(np.pi * north / 3.0)).astype(np.float32)


def points(count: int = 400) -> np.ndarray:
    rng = np.random.default_rng(4)
    return np.column_stack(
        [GRID.west + rng.uniform(25, 95, count), GRID.top - rng.uniform(25, 75, count), np.full(count, 300.0)]
    )


def test_slopes_are_settled_and_crowns_are_not() -> None:
    assert roughness_m(heights("flat"), GRID, points()) < 1e-3
    assert roughness_m(heights("slope"), GRID, points()) < 0.02
    # Of a product of cosines the mean distance from its mean is (2 / pi) ** 2 of the amplitude.
    assert roughness_m(heights("wood"), GRID, points(4000)) == pytest.approx(2.5 * (2 / np.pi) ** 2, rel=0.1)


def test_half_a_wood_counts_half() -> None:
    mixed = heights("flat") + 15.0
    mixed[:, 60:] = heights("wood")[:, 60:]
    both = roughness_m(mixed, GRID, points(4000))
    assert both == pytest.approx(0.5 * roughness_m(heights("wood"), GRID, points(4000)), rel=0.15)


@pytest.mark.parametrize("agreeing", [0.0, 0.5, 1.0])
def test_what_agrees_is_settled(agreeing: float) -> None:
    wood = heights("wood")
    assert unsettled_m(wood, GRID, points(), agreeing) == pytest.approx(
        1.25 * (1.0 - agreeing) * roughness_m(wood, GRID, points())
    )


def test_holes_and_points_beyond_the_rim_count_as_level_ground() -> None:
    holes = heights("flat")
    holes[30:40, 30:50] = np.nan
    assert roughness_m(holes, GRID, points()) < 1e-3
    assert roughness_m(np.full_like(holes, np.nan), GRID, points()) < 1e-3
    assert roughness_m(heights("flat"), GRID, points() + np.array([5000.0, -5000.0, 0.0])) < 1e-3


def test_the_cells_size_does_not_matter() -> None:
    """The same wood in cells half as wide."""
    fine = RasterGrid(240, 200, GRID.west, GRID.top, 0.5, -0.5)
    east, north = np.meshgrid((np.arange(240) - 0.5) / 2.0, (np.arange(200) - 0.5) / 2.0)
    wood = (315.0 + 2.5 * np.cos(np.pi * east / 3.0) * np.cos(np.pi * north / 3.0)).astype(np.float32)
    coarse_m = roughness_m(heights("wood"), GRID, points(4000))
    assert roughness_m(wood, fine, points(4000)) == pytest.approx(coarse_m, rel=0.1)


def test_the_ground_lifted_or_tilted_takes_the_camera_along() -> None:
    """Drawn: a plane of points moved by a height and a tilt about its middle, and the camera with it."""
    rng = np.random.default_rng(5)
    plane = points()
    middle = plane.mean(axis=0)
    camera = middle + np.array([10.0, -5.0, 120.0])
    reach_m = float(np.linalg.norm(camera - middle))
    moved = []
    for up, east, north in rng.normal(size=(20_000, 3)) * [1.5, 1.5 / reach_m, 1.5 / reach_m]:
        turn = rotation.exp([east, north, 0.0])
        moved.append([*(middle + turn @ (camera - middle) + [0.0, 0.0, up] - camera), east, north, 0.0])
    want = np.cov(np.array(moved).T)
    have = unsettled_covariance(1.5, plane, camera)
    scale = np.sqrt(np.diag(have)) + np.eye(6)[5]
    assert np.allclose(have / np.outer(scale, scale), want / np.outer(scale, scale), atol=0.03)
    assert have[0, 4] > 0 > have[1, 3], "leaning the ground to the east about north moves the camera east"
