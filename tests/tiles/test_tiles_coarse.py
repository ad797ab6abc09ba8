"""The map's coarse field: the same whatever pieces it is made of, and where it says it is."""

from __future__ import annotations

import numpy as np
import pytest
from replay import rendered

from ortholoc_edge.errors import MapError
from ortholoc_edge.matching.orientation import orientation_field
from ortholoc_edge.tiles import coarse
from ortholoc_edge.tiles.coarse import MEAN_PX, CoarseField

LEVEL = 2


@pytest.fixture(scope="module")
def whole() -> CoarseField:
    return CoarseField.of(rendered.store(), LEVEL)


def test_field_is_that_of_the_level(whole: CoarseField) -> None:
    grid = rendered.store().dop_grids[LEVEL]
    window = rendered.store().read(grid.bounds, grid.gsd_m)
    assert window is not None
    assert whole.grid == grid == window.dop_grid
    expected = orientation_field(window.dop_grey, window.dop_valid, MEAN_PX)
    assert np.abs(whole.block(0, 0, 256) - expected[:, :256, :256]).max() < 0.01
    assert whole.bytes < 2.2 * grid.width * grid.height
    assert whole.known_km2 == pytest.approx(window.dop_valid.sum() * grid.gsd_m**2 * 1e-6, rel=0.1)


def test_pieces_have_no_seams(whole: CoarseField, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(coarse, "_PIECE_PX", 128)
    pieced = CoarseField.of(rendered.store(), LEVEL)
    off = np.abs(pieced.quantised.astype(int) - whole.quantised)
    # The mean's boxes lie elsewhere by a pixel or two.
    assert np.percentile(off, 99.9) <= 6
    assert off.mean() < 0.5


def test_a_part_is_a_crop_of_the_whole(whole: CoarseField) -> None:
    west, _, _, north = whole.grid.bounds
    gsd_m = whole.grid.gsd_m
    within = west + 64 * gsd_m, north - 192 * gsd_m, west + 192 * gsd_m, north - 96 * gsd_m
    part = CoarseField.of(rendered.store(), LEVEL, within)
    assert part.grid == whole.grid.crop(64, 96, 128, 96)
    inner = np.abs(part.quantised[:, 40:-40, 40:-40].astype(int) - whole.quantised[:, 136:152, 104:152])
    assert np.median(inner) <= 3
    place = part.grid.map_from_px([[60.0, 50.0]])
    assert part.ground_m(place) == pytest.approx(whole.ground_m(place), abs=0.01)
    assert part.ground_m(place)[0] == pytest.approx(rendered.store().ground_near(place[0]), abs=15.0)


def test_half_the_scale_lies_where_the_whole_does(whole: CoarseField) -> None:
    half = whole.halved()
    assert half.grid.gsd_m == pytest.approx(2.0 * whole.grid.gsd_m)
    assert half.grid.bounds[0] == whole.grid.bounds[0]
    assert half.grid.bounds[3] == whole.grid.bounds[3]
    mean = whole.block(40, 60, 20).reshape(2, 10, 2, 10, 2).mean(axis=(2, 4))
    assert np.abs(half.block(20, 30, 10) - mean).max() < 0.02


def test_blocks_reach_beyond_the_map(whole: CoarseField) -> None:
    block = whole.block(-10, -20, 64)
    assert not block[:, :20].any()
    assert not block[:, :, :10].any()
    assert np.array_equal(block[:, 20:, 10:], whole.block(0, 0, 64)[:, :44, :54])
    assert not whole.block(100_000, 0, 8).any()


def test_elsewhere_there_is_nothing() -> None:
    with pytest.raises(MapError, match="widen"):
        CoarseField.of(rendered.store(), LEVEL, (0.0, 0.0, 100.0, 100.0))
