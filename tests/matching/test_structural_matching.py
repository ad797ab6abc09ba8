"""Displacements between fields: analytic ones, whose shift is known to the last digit."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from ortholoc_edge.geometry.arrays import Float32Array, FloatArray
from ortholoc_edge.matching.orientation import orientation_field
from ortholoc_edge.matching.structural import Correlation, Displacements, multiply, whole_shift

HEIGHT, WIDTH = 96, 128
CELL, PATCH_CELLS, RADIUS = 8, 4, 4


def waves(
    seed: int, shift: tuple[float, float] = (0.0, 0.0), *, height: int = HEIGHT, width: int = WIDTH
) -> FloatArray:
    """(height, width) of 60 waves in all directions, 8 to 25 px long, moved right and down by ``shift``."""
    random = np.random.default_rng(seed)
    direction, phase = random.uniform(0, 2 * np.pi, (2, 60))
    number = 2 * np.pi / random.uniform(8.0, 25.0, 60)
    v, u = np.mgrid[:height, :width].astype(np.float64)
    u, v = u - shift[0], v - shift[1]
    total = np.zeros((height, width))
    for d, k, p in zip(direction, number, phase, strict=True):
        total += np.cos(k * (u * np.cos(d) + v * np.sin(d)) + p)
    return total / np.sqrt(30.0)


def field(seed: int, shift: tuple[float, float] = (0.0, 0.0), **size: int) -> Float32Array:
    return np.stack([waves(2 * seed, shift, **size), waves(2 * seed + 1, shift, **size)]).astype(np.float32)


def found(template: Float32Array, searched: Float32Array, **changed: Any) -> Displacements:
    options: dict[str, Any] = {"radius": RADIUS, "cell": CELL, "patch_cells": PATCH_CELLS}
    options |= changed
    patch = options.pop("patch_cells"), options.pop("stride", 1)
    return multiply(template, searched, **options).patches(*patch).peaks()


def patches(height: int = HEIGHT, width: int = WIDTH) -> int:
    return (height // CELL - PATCH_CELLS + 1) * (width // CELL - PATCH_CELLS + 1)


def off_rim(one: Displacements, shift: tuple[float, float]) -> Displacements:
    """Those whose content is in the searched field as well."""
    half = 0.5 * CELL * PATCH_CELLS
    at = one.template_px + shift
    inside = ((at >= half) & (at <= np.array([WIDTH, HEIGHT]) - half - 1)).all(axis=1)
    return one.take(np.flatnonzero(inside))


# -- patches -----------------------------------------------------------------


@pytest.mark.parametrize("shift", [(0.0, 0.0), (0.5, -0.5), (1.3, 2.6), (-2.25, 0.8), (-0.1, -2.9), (2.75, -1.4)])
@pytest.mark.parametrize("seed", [0, 1])
def test_shifts_are_found_to_a_tenth(shift: tuple[float, float], seed: int) -> None:
    """What lies at x in the template lies at x + shift in the searched field."""
    one = off_rim(found(field(seed), field(seed, shift)), shift)
    assert len(one) >= 70
    assert np.abs(one.shift_px - shift).max() < 0.1
    assert one.score.min() > 0.85
    assert one.score.max() <= 1.0 + 1e-5


def test_a_field_fits_itself() -> None:
    one = found(field(0), field(0))
    assert len(one) == patches()
    # At the picture's rim a shift has less to compare with to one side than to the other.
    assert np.abs(one.shift_px).max() < 0.15
    assert np.abs(off_rim(one, (0.0, 0.0)).shift_px).max() < 0.02
    assert one.score == pytest.approx(np.ones(len(one)), abs=1e-5)


@pytest.mark.parametrize("shift", [(0.4, -0.7), (2.2, 1.6)])
def test_shifts_of_pictures_are_found_to_a_tenth(shift: tuple[float, float]) -> None:
    """By their edges, and the second negative of the first."""
    one, two = (np.rint(127.5 + 40.0 * waves(7, moved)).clip(0, 255).astype(np.uint8) for moved in ((0, 0), shift))
    seen = off_rim(found(orientation_field(one), orientation_field(255 - two)), shift)
    assert len(seen) >= 80
    assert np.abs(seen.shift_px - shift).max() < 0.1


def test_middles_of_patches() -> None:
    """Of 4 cells of 8 px the middle is between pixels 15 and 16."""
    one = found(field(0), field(0))
    assert one.template_px.min(axis=0).tolist() == [15.5, 15.5]
    assert one.template_px.max(axis=0).tolist() == [WIDTH - 16.5, HEIGHT - 16.5]
    assert np.unique(np.diff(np.unique(one.template_px[:, 0]))).tolist() == [CELL]


def test_each_patch_has_its_own_shift() -> None:
    """A field stretched by 3 %: shifts grow with the place."""
    v, u = np.mgrid[:HEIGHT, :WIDTH].astype(np.float64)
    stretch = 1.03
    one = np.stack([stretched(k, u, v) for k in (0, 1)]).astype(np.float32)
    two = np.stack([stretched(k, 60 + (u - 60) / stretch, 50 + (v - 50) / stretch) for k in (0, 1)])
    seen = off_rim(found(one, two.astype(np.float32)), (0.0, 0.0))
    expected = (seen.template_px - (60, 50)) * (stretch - 1.0)
    assert len(seen) >= 70
    off = np.abs(seen.shift_px - expected)
    # A patch is where most of its texture is, which need not be its middle.
    assert np.median(off) < 0.06
    assert np.quantile(off, 0.95) < 0.25


def stretched(seed: int, u: FloatArray, v: FloatArray) -> FloatArray:
    random = np.random.default_rng(seed)
    total = np.zeros(u.shape)
    for _ in range(40):
        direction, phase, length = random.uniform(0, 2 * np.pi), random.uniform(0, 2 * np.pi), random.uniform(8, 25)
        total += np.cos(2 * np.pi * (u * np.cos(direction) + v * np.sin(direction)) / length + phase)
    return total


@pytest.mark.parametrize("origin", [(9, -8), (-11, 6), (0, 12)])
def test_origin_is_where_the_search_begins(origin: tuple[int, int]) -> None:
    shift = origin[0] + 0.3, origin[1] - 1.6
    one = off_rim(found(field(3), field(3, shift), origin=origin), shift)
    assert len(one) >= 50
    assert np.abs(one.shift_px - shift).max() < 0.1


def test_an_origin_beyond_the_field_finds_nothing() -> None:
    assert len(found(field(0), field(0), origin=(3 * WIDTH, 0))) == 0


@pytest.mark.parametrize("shift", [(RADIUS, 0.0), (0.0, -RADIUS), (-RADIUS - 2.0, 1.0)])
def test_peaks_at_the_rim_are_refused(shift: tuple[float, float]) -> None:
    one = found(field(0), field(0, shift))
    assert len(one) < 0.35 * patches(), "chance peaks inside"
    assert (np.abs(one.shift_px) < RADIUS).all()
    assert np.median(one.score) < 0.7 if len(one) else True


def test_cells_beyond_the_last_whole_one_are_left_out() -> None:
    one = found(field(0, height=HEIGHT + 5, width=WIDTH + 7), field(0, height=HEIGHT + 5, width=WIDTH + 7))
    assert len(one) == patches()
    assert np.array_equal(one.template_px, found(field(0), field(0)).template_px)
    assert np.abs(off_rim(one, (0.0, 0.0)).shift_px).max() < 0.02


@pytest.mark.parametrize(("height", "width"), [(CELL * PATCH_CELLS - 1, 100), (100, 7), (1, 1)])
def test_fewer_cells_than_a_patch(height: int, width: int) -> None:
    nothing = found(field(0, height=height, width=width), field(0, height=height, width=width))
    assert len(nothing) == 0
    assert nothing.template_px.shape == nothing.shift_px.shape == (0, 2)
    assert nothing.curvature.shape == (0, 2, 2)


def test_one_patch_is_enough() -> None:
    side = CELL * PATCH_CELLS
    one = found(field(0, height=side, width=side), field(0, height=side, width=side))
    assert one.template_px.tolist() == [[15.5, 15.5]]


def test_other_textures_score_low() -> None:
    chance = np.concatenate([found(field(seed), field(seed + 50)).score for seed in range(6)])
    assert np.median(chance) < 0.45
    assert np.quantile(chance, 0.99) < 0.75
    noise = np.random.default_rng(0).normal(size=(4, HEIGHT, WIDTH)).astype(np.float32)
    assert np.median(found(noise[:2], noise[2:]).score) < 0.2


def test_strength_does_not_count() -> None:
    template, searched = field(0), field(0, (1.2, -0.7))
    one, two = found(template, searched), found(template * np.float32(0.01), searched * np.float32(30.0))
    assert np.allclose(one.shift_px, two.shift_px, atol=1e-3)
    assert np.allclose(one.score, two.score, atol=1e-4)


def test_noise_lowers_the_score_and_not_the_place() -> None:
    shift = 1.4, -0.6
    noise = np.random.default_rng(0).normal(size=(2, HEIGHT, WIDTH)).astype(np.float32)
    clean = off_rim(found(field(0), field(0, shift)), shift)
    noisy = off_rim(found(field(0), field(0, shift) + 0.7 * noise), shift)
    assert np.median(noisy.score) < 0.95 * np.median(clean.score)
    assert np.median(np.abs(noisy.shift_px - shift)) < 0.1


def test_empty_parts_of_a_template_are_not_found_and_spoil_no_others() -> None:
    """0 is what an `orientation_field` has where the map has no data."""
    shift = 0.7, -1.2
    template = field(0)
    template[:, :, :52] = 0.0
    one = off_rim(found(template, field(0, shift)), shift)
    half = 0.5 * CELL * PATCH_CELLS
    assert (one.template_px[:, 0] + half > 52).all()
    partly = one.template_px[:, 0] - half < 52
    assert partly.sum() >= 10
    # A quarter of a patch is left at least.
    assert np.abs(one.shift_px[~partly] - shift).max() < 0.1
    assert np.median(np.abs(one.shift_px[partly] - shift)) < 0.1
    assert len(found(np.zeros_like(template), field(0))) == 0
    assert len(found(field(0), np.zeros_like(template))) == 0


def test_curvature_is_that_of_a_peak() -> None:
    """Positive definite, and the second derivative of the correlation of these waves: half their mean square number."""
    one = found(field(0), field(0))
    values = np.linalg.eigvalsh(one.curvature)
    assert values.min() > 0
    assert np.allclose(one.curvature, one.curvature.transpose(0, 2, 1))
    number = 2 * np.pi / np.concatenate([_lengths(seed) for seed in (0, 1)])
    assert np.mean(one.curvature[:, [0, 1], [0, 1]]) == pytest.approx(np.mean(number**2) / 2.0, rel=0.15)


def _lengths(seed: int) -> FloatArray:
    random = np.random.default_rng(seed)
    random.uniform(0, 2 * np.pi, (2, 60))
    return random.uniform(8.0, 25.0, 60)


@pytest.mark.parametrize("angle_deg", [0.0, 40.0, 90.0, 155.0])
def test_along_a_line_the_place_is_unsure(angle_deg: float) -> None:
    """The aperture problem: a long edge, with a little texture along it so that there is a peak at all."""
    direction = np.array([np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))])
    v, u = np.mgrid[:HEIGHT, :WIDTH].astype(np.float64)
    across = -(u - 64) * direction[1] + (v - 48) * direction[0]
    line = np.exp(-((across / 3.0) ** 2))
    made = (np.stack([line, 0.5 * line]) + 0.05 * field(0)).astype(np.float32)
    one = found(made, made)
    middle = one.take(np.flatnonzero(np.linalg.norm(one.template_px - (64, 48), axis=1) < 14))
    assert len(middle) >= 2
    values, vectors = np.linalg.eigh(middle.curvature)
    assert (values[:, 1] > 8.0 * values[:, 0]).all()
    # The flattest way is along the line, as is the longest axis of the place's covariance.
    assert np.abs(vectors[:, :, 0] @ direction).min() > 0.97
    spread, axes = np.linalg.eigh(middle.covariance)
    assert spread.min() > 0
    assert np.abs(axes[:, :, 1] @ direction).min() > 0.97


def test_better_peaks_are_surer() -> None:
    noise = np.random.default_rng(0).normal(size=(2, HEIGHT, WIDTH)).astype(np.float32)
    clean, noisy = (found(field(0), field(0) + s * noise).covariance.trace(axis1=1, axis2=2) for s in (0.1, 1.0))
    assert np.median(noisy) > 3.0 * np.median(clean)


def test_taking_some() -> None:
    one = found(field(0), field(0))
    some = one.take(np.array([5, 2]))
    assert len(some) == 2
    assert np.array_equal(some.template_px, one.template_px[[5, 2]])
    assert np.array_equal(some.curvature, one.curvature[[5, 2]])
    assert len(one.take(one.score > 2.0)) == 0


def test_every_second_patch() -> None:
    all_of_them, some = found(field(0), field(0, (1.3, -0.4))), found(field(0), field(0, (1.3, -0.4)), stride=2)
    assert np.unique(np.diff(np.unique(some.template_px[:, 0]))).tolist() == [2 * CELL]
    for place, shift in zip(some.template_px, some.shift_px, strict=True):
        (same,) = np.flatnonzero((all_of_them.template_px == place).all(axis=1))
        assert shift == pytest.approx(all_of_them.shift_px[same], abs=1e-4)


# -- scores between the shifts that were tried -------------------------------


def correlation(shift: tuple[float, float], origin: tuple[int, int] = (0, 0)) -> Correlation:
    return multiply(field(0), field(0, shift), radius=RADIUS, cell=CELL, origin=origin).patches(PATCH_CELLS)


def test_at_the_peak_the_score_is_highest_and_level() -> None:
    shift = 1.3, -0.6
    made = correlation(shift)
    peaks = made.peaks()
    index = [int(np.flatnonzero((made.template_px == place).all(axis=1))[0]) for place in peaks.template_px]
    asked = np.zeros((len(made.template_px), 2))
    asked[index] = peaks.shift_px
    score, slope, inside = (values[index] for values in made.at(asked))
    assert inside.all()
    assert (score >= peaks.score - 1e-6).all()
    assert np.abs(slope).max() < 0.01


@pytest.mark.parametrize("place", [(0.0, 0.0), (0.3, -0.2), (-1.4, 2.1), (2.6, 0.45)])
def test_slopes_are_those_of_the_scores(place: tuple[float, float]) -> None:
    made = correlation((0.7, 0.4), (1, -1))
    asked = np.tile(np.add(place, (1, -1)), (len(made.template_px), 1))
    score, slope, inside = made.at(asked)
    assert inside.all()
    for axis in (0, 1):
        step = np.zeros(2)
        step[axis] = 0.02
        ahead, behind = made.at(asked + step)[0], made.at(asked - step)[0]
        assert slope[:, axis] == pytest.approx((ahead - behind) / 0.04, abs=1e-4)
    if place == (0.0, 0.0):
        assert score == pytest.approx(made.scores[RADIUS, RADIUS], abs=1e-6)


@pytest.mark.parametrize("place", [(RADIUS, 0.0), (0.0, -50.0), (np.inf, 0.0), (np.nan, np.nan), (1e9, 1e9)])
def test_beyond_what_was_tried_is_nothing(place: tuple[float, float]) -> None:
    made = correlation((0.0, 0.0))
    score, slope, inside = made.at(np.tile(place, (len(made.template_px), 1)))
    assert not inside.any()
    assert not score.any()
    assert not slope.any()


def test_sharpness_is_the_template_s_own_curvature() -> None:
    made = correlation((0.8, 0.3))
    assert np.linalg.eigvalsh(made.sharpness).min() > 0
    itself = found(field(0), field(0))
    inner = off_rim(itself, (0.0, 0.0))
    index = [int(np.flatnonzero((made.template_px == place).all(axis=1))[0]) for place in inner.template_px]
    # Not normalised by the shifted patch's strength, hence the room.
    assert np.median(made.sharpness[index][:, [0, 1], [0, 1]]) == pytest.approx(
        np.median(inner.curvature[:, [0, 1], [0, 1]]), rel=0.2
    )


# -- the whole field ---------------------------------------------------------


def cut(seed: int, x: float, y: float, height: int = HEIGHT, width: int = WIDTH) -> Float32Array:
    """The window of endless waves that shows their origin at (x, y)."""
    return field(seed, (x, y), height=height, width=width)


@pytest.mark.parametrize("shift", [(0, 0), (40, 0), (-40, 0), (0, 38), (0, -38), (25, -31), (-33, 40), (-12, -40)])
def test_whole_shifts_of_any_sign(shift: tuple[int, int]) -> None:
    (x, y, height), *_ = whole_shift(cut(4, 0, 0), cut(4, *shift), 40)
    assert (x, y) == pytest.approx(shift, abs=1)
    assert height > 4.0


@pytest.mark.parametrize(("height", "width"), [(36, 128), (128, 48), (97, 31)])
def test_whole_shifts_longer_than_a_side(height: int, width: int) -> None:
    """Of a narrow picture, by nearly half the long side."""
    long = max(height, width)
    shift = (round(0.3 * width), 4) if width > height else (-4, round(0.3 * height))
    (x, y, _), *_ = whole_shift(cut(5, 0, 0, height, width), cut(5, *shift, height, width), round(0.45 * long))
    assert (x, y) == pytest.approx(shift, abs=1)


def test_peaks_fall_and_keep_apart() -> None:
    """Twice the same thing, the second time weaker."""
    searched = cut(4, 20, -10) + np.float32(0.6) * cut(4, -25, 15)
    peaks = whole_shift(cut(4, 0, 0), searched, 40, 5)
    assert len(peaks) == 5
    assert peaks[0][:2] == pytest.approx((20, -10), abs=1)
    assert peaks[1][:2] == pytest.approx((-25, 15), abs=1)
    heights = [height for *_, height in peaks]
    assert heights == sorted(heights, reverse=True)
    places = np.array([peak[:2] for peak in peaks])
    assert np.abs(places).max() <= 40
    for number, place in enumerate(places):
        others = np.delete(places, number, axis=0)
        assert (np.abs(others - place).max(axis=1) > 4).all()


def test_beyond_the_largest_shift_nothing_is_looked_for() -> None:
    for x, y, _ in whole_shift(cut(4, 0, 0), cut(4, 35, 0), 15, 3):
        assert max(abs(x), abs(y)) <= 15


def test_whole_shift_of_nothing() -> None:
    blank = np.zeros((2, HEIGHT, WIDTH), np.float32)
    for template, searched in ((blank, field(0)), (field(0), blank), (blank, blank)):
        peaks = whole_shift(template, searched, 20, 2)
        assert len(peaks) == 2
        assert np.isfinite(peaks).all()
        assert np.abs(np.array(peaks)[:, :2]).max() <= 20


# -- contrast ----------------------------------------------------------------


def contrast_of(template: Float32Array, searched: Float32Array, shift: tuple[float, float]) -> float:
    made = multiply(template, searched, radius=2, cell=16).patches(1)
    count = len(made.template_px)
    return made.contrast(np.tile(shift, (count, 1)), np.ones(count, bool))


def test_contrast_tells_the_right_shift_from_others_and_from_other_pictures() -> None:
    """Under noise that leaves few patches a peak of their own."""
    rng = np.random.default_rng(0)
    scene = field(0)
    noisy = np.roll(scene, (1, -1), axis=(1, 2)) + 1.5 * rng.standard_normal(scene.shape).astype(np.float32)
    right = contrast_of(scene, noisy, (-1.0, 1.0))
    assert right > 8.0
    assert contrast_of(scene, noisy, (1.0, -1.0)) < 0.5 * right
    assert contrast_of(scene, -noisy, (-1.0, 1.0)) < -8.0
    others = [contrast_of(field(0), field(seed), (0.0, 0.0)) for seed in range(1, 30)]
    assert abs(float(np.mean(others))) < 1.0
    assert max(others) < 4.5


def test_contrast_needs_patches_and_shifts_that_were_tried() -> None:
    made = multiply(field(0), field(0), radius=2, cell=16).patches(1)
    count = len(made.template_px)
    still = np.zeros((count, 2))
    few = np.arange(count) < 19
    assert made.contrast(still, few) == 0.0
    assert made.contrast(np.full((count, 2), np.inf), np.ones(count, bool)) == 0.0
    assert made.contrast(np.full((count, 2), 2.4), np.ones(count, bool)) == 0.0
