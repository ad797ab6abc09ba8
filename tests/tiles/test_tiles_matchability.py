"""Matchability: what is and what is not texture that a matcher can use."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from ortholoc_edge.tiles.matchability import (
    MATCHABLE_DOUBTFUL_MIN,
    MATCHABLE_EXPECTED_MIN,
    NO_MAP,
    cells,
)

SIDE = 512
ALL = np.ones((SIDE, SIDE), dtype=bool)
GSD_M = 0.2


def rgb_of(grey):
    return np.repeat(np.clip(grey, 0, 255).astype(np.uint8)[:, :, None], 3, axis=2)


def noise(seed, sigma):
    return np.random.default_rng(seed).normal(0.0, sigma, (SIDE, SIDE))


def patches(seed, size_px=6.0):
    """Two-tone patches of some pixels: sharp-edged, without a period."""
    return np.where(cv2.GaussianBlur(noise(seed, 1.0), (0, 0), size_px) > 0, 150.0, 90.0)


def compressed(rgb, ending, quality):
    key = cv2.IMWRITE_WEBP_QUALITY if ending == ".webp" else cv2.IMWRITE_JPEG_QUALITY
    return cv2.imdecode(cv2.imencode(ending, rgb, [key, quality])[1], cv2.IMREAD_COLOR)


def test_texture_of_corners_is_matchable_and_a_blank_wall_is_not():
    assert cells(rgb_of(patches(0)), ALL, GSD_M).min() > MATCHABLE_EXPECTED_MIN
    blank = cells(rgb_of(np.full((SIDE, SIDE), 120.0)), ALL, GSD_M)
    assert blank.shape == (SIDE // 64, SIDE // 64)
    assert blank.dtype == np.uint8
    assert not blank.any()


@pytest.mark.parametrize("ending, quality", [(".webp", 60), (".webp", 85), (".jpg", 50), (".jpg", 80)])
@pytest.mark.parametrize("sigma", [0.0, 3.0])
def test_lossy_compression_of_a_smooth_surface_is_no_texture(ending, quality, sigma):
    swell = cv2.GaussianBlur(noise(1, 1.0), (0, 0), 50.0)
    surface = rgb_of(90 + 8 * swell / swell.std() + noise(2, sigma))
    assert cells(compressed(surface, ending, quality), ALL, GSD_M).max() < MATCHABLE_DOUBTFUL_MIN


def test_a_lone_straight_edge_is_little_and_a_crossing_is_more():
    rows, columns = np.mgrid[:SIDE, :SIDE]
    edge = cells(rgb_of(np.where(columns + 0.3 * rows > 300, 150.0, 90.0)), ALL, GSD_M)
    crossing = cells(rgb_of(np.where((columns > 300) != (rows > 300), 150.0, 90.0)), ALL, GSD_M)
    assert edge.max() < MATCHABLE_DOUBTFUL_MIN
    assert crossing[4, 4] > edge.max()


@pytest.mark.parametrize("period_px", [10, 16, 24])
def test_strict_repetition_is_taken_off(period_px):
    rows, columns = np.mgrid[:SIDE, :SIDE] * (2 * np.pi / period_px)
    orchard = rgb_of(np.where(np.cos(rows) * np.cos(columns) > 0.3, 150.0, 90.0) + noise(3, 4.0))
    assert cells(orchard, ALL, GSD_M).mean() < MATCHABLE_DOUBTFUL_MIN


def test_what_outlives_blur_and_contrast_ranks_alike():
    strength = np.repeat(np.linspace(0.0, 0.6, 8), 64)
    ground = 110 + (patches(4) - 120) * strength[None, :]
    before = cells(rgb_of(ground), ALL, GSD_M).mean(axis=0)
    year = cv2.GaussianBlur(ground, (0, 0), 1.2) * 0.8 + 30 + noise(5, 5.0)
    after = cells(compressed(rgb_of(year), ".jpg", 75), ALL, GSD_M).mean(axis=0)
    assert (np.diff(before) >= -1).all()
    assert (np.diff(after) >= -8).all()
    assert after[:2].max() < MATCHABLE_DOUBTFUL_MIN
    assert after[-1] > MATCHABLE_EXPECTED_MIN


def test_the_rim_of_a_hole_is_no_texture():
    surface = np.full((SIDE, SIDE), 200.0)
    valid = ALL.copy()
    valid[100:300, 100:400] = False
    surface[~valid] = 0.0
    found = cells(rgb_of(surface), valid, GSD_M)
    gone = np.zeros_like(found, dtype=bool)
    gone[2:4, 2:6] = True
    assert (found[gone] == NO_MAP).all()
    assert (found[~gone] == 0).all()


def test_part_of_a_cell_counts_by_its_area():
    valid = ALL.copy()
    valid[:, 32:] = False
    found = cells(rgb_of(patches(6)), valid, GSD_M)
    whole = cells(rgb_of(patches(6)), ALL, GSD_M)
    assert (found[:, 1:] == NO_MAP).all()
    assert (found[:, 0] < whole[:, 0]).all()
    assert (found[:, 0] > 0).all()


def test_water_is_known_by_near_infrared_and_shadows_by_their_width():
    rgb = rgb_of(patches(7))
    nir = np.full((SIDE, SIDE), 220, dtype=np.uint8)
    nir[:256] = 20
    # 4 m across at 0.2 m.
    nir[400:420, :] = 20
    dry = cells(rgb, ALL, GSD_M)
    found = cells(rgb, ALL, GSD_M, nir)
    assert not found[:4].any()
    np.testing.assert_array_equal(found[4:], dry[4:])


def test_a_high_raster_is_cut_into_bands_without_a_trace():
    tall = np.vstack([rgb_of(patches(seed)) for seed in range(4)])[:, :128]
    valid = np.ones(tall.shape[:2], dtype=bool)
    found = cells(tall, valid, GSD_M)
    # Rows 12 to 20 around the border of two bands, by themselves.
    part = cells(np.ascontiguousarray(tall[12 * 64 : 20 * 64]), valid[12 * 64 : 20 * 64], GSD_M)
    np.testing.assert_array_equal(found[13:19], part[1:-1])
    np.testing.assert_array_equal(found, cells(tall, valid, GSD_M))


def test_unfit_rasters_are_refused():
    grey = np.zeros((64, 128, 3), dtype=np.uint8)
    mask = np.ones((64, 128), dtype=bool)
    with pytest.raises(ValueError, match="do not fit"):
        cells(grey, mask[:, :64], GSD_M)
    with pytest.raises(ValueError, match="whole cells"):
        cells(grey[:, :100], mask[:, :100], GSD_M)
    with pytest.raises(ValueError, match="gsd_m 0"):
        cells(grey, mask, 0)
