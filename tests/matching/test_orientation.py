"""The field of edge directions: what it must not see (light, contrast, masks) and what it must (directions, places)."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from ortholoc_edge.geometry.arrays import Float32Array, ImageArray
from ortholoc_edge.matching.orientation import orientation_field


def texture(seed: int = 0, height: int = 120, width: int = 160) -> ImageArray:
    """Blobs and edges of all directions, grey levels 40 to 215."""
    noise = np.random.default_rng(seed).normal(size=(height, width)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 3.0)
    steps = np.tanh(6.0 * smooth / smooth.std())
    return np.asarray(np.rint(127.5 + 60.0 * steps + 27.0 * smooth / np.abs(smooth).max()), dtype=np.uint8)


def agreement(one: Float32Array, other: Float32Array) -> float:
    """Normalised correlation."""
    return float((one * other).sum() / np.sqrt(np.square(one).sum() * np.square(other).sum()))


def strength(field: Float32Array) -> float:
    return float(np.sqrt(np.square(field).sum(axis=0).mean()))


@pytest.mark.parametrize("shape", [(120, 160), (160, 120), (95, 127), (16, 16), (5, 40), (2, 3)])
def test_two_planes_of_the_picture_s_shape(shape: tuple[int, int]) -> None:
    field = orientation_field(texture(height=shape[0], width=shape[1]))
    assert field.shape == (2, *shape)
    assert field.dtype == np.float32
    assert np.isfinite(field).all()


@pytest.mark.parametrize("level", [0, 1, 127, 255])
def test_an_even_picture_has_no_edges(level: int) -> None:
    assert not orientation_field(np.full((60, 80), level, np.uint8)).any()


def test_saturation_and_its_opposite() -> None:
    """Steps from black to white everywhere, as large as gradients get."""
    squares = ((np.add.outer(np.arange(60), np.arange(80)) // 2 % 2) * 255).astype(np.uint8)
    noise = np.random.default_rng(0).integers(0, 2, (60, 80), dtype=np.uint8) * np.uint8(255)
    for image in (squares, noise):
        assert np.isfinite(orientation_field(image)).all()
    blown = np.maximum(texture(), 215).astype(np.uint8)
    assert np.isfinite(orientation_field(blown)).all()


def test_the_picture_is_left_as_it_is() -> None:
    image = texture()
    before = image.copy()
    orientation_field(image, np.ones(image.shape, np.bool_))
    assert np.array_equal(image, before)


def test_a_part_of_a_larger_array() -> None:
    """Views of arrays are not contiguous."""
    image = texture()
    part = image[10:90, 20:110]
    assert np.allclose(orientation_field(part), orientation_field(part.copy()), atol=1e-5)


def test_same_picture_same_bits() -> None:
    """Wherever in memory its buffers lie: replays must give what the flight gave."""
    image = texture()
    first = orientation_field(image)
    random = np.random.default_rng(0)
    between: list[np.ndarray] = []
    for _ in range(100):
        between = [*between[-4:], np.empty(random.integers(1, 200_000), np.uint8)]
        assert np.array_equal(orientation_field(image), first)


# -- what it must not see ----------------------------------------------------


def test_which_side_is_brighter_does_not_count() -> None:
    image = texture()
    assert np.allclose(orientation_field(255 - image), orientation_field(image), atol=1e-5)


@pytest.mark.parametrize("gain", [0.4, 0.7, 1.15])
@pytest.mark.parametrize("offset", [-15.0, 0.0, 20.0])
def test_brightness_and_contrast_do_not_count(gain: float, offset: float) -> None:
    image = texture()
    other = np.clip(np.rint(127.5 + gain * (image - 127.5) + offset), 0, 255).astype(np.uint8)
    one, two = orientation_field(image), orientation_field(other)
    assert agreement(one, two) > 0.98
    assert strength(two) == pytest.approx(strength(one), rel=0.12)


@pytest.mark.parametrize("gamma", [0.45, 2.2])
def test_gamma_does_not_count(gamma: float) -> None:
    image = texture()
    other = np.rint(255.0 * (image / 255.0) ** gamma).astype(np.uint8)
    assert agreement(orientation_field(image), orientation_field(other)) > 0.95


def test_light_that_falls_off_across_the_picture_does_not_count() -> None:
    image = texture()
    light = np.linspace(1.0, 0.35, image.shape[1])
    assert agreement(orientation_field(image), orientation_field(np.rint(image * light).astype(np.uint8))) > 0.97


def test_a_shaded_half_counts_like_the_sunny_one() -> None:
    """Normalised by the strength of edges around: contrast of a third, and as long a field."""
    image = texture(height=160, width=240)
    shaded = image.astype(np.float64)
    shaded[:, 120:] = 20.0 + shaded[:, 120:] / 3.0
    field = orientation_field(np.rint(shaded).astype(np.uint8))
    inner = 20
    assert strength(field[:, :, 120 + inner :]) == pytest.approx(strength(field[:, :, : 120 - inner]), rel=0.25)


@pytest.mark.parametrize("angle_deg", [0.0, 30.0, 90.0, 135.0])
def test_parallel_rows_alone_leave_next_to_nothing(angle_deg: float) -> None:
    """A field of crops would match everywhere along its rows."""
    v, u = np.mgrid[:120, :160]
    across = u * np.cos(np.radians(angle_deg)) + v * np.sin(np.radians(angle_deg))
    rows = np.rint(128.0 + 80.0 * np.sin(2 * np.pi * across / 9.0)).astype(np.uint8)
    left = orientation_field(rows)[:, 12:-12, 12:-12]
    assert strength(left) < 0.25 * strength(orientation_field(texture())[:, 12:-12, 12:-12])


# -- what it must ------------------------------------------------------------


def test_directions_around_a_disc() -> None:
    """The gradient at the rim points along the radius: the field turns twice as fast."""
    v, u = np.mgrid[:160, :160] - 79.5
    radius = np.hypot(u, v)
    image = np.rint(40.0 + 170.0 / (1.0 + np.exp((radius - 45.0) / 1.5))).astype(np.uint8)
    field = orientation_field(image)
    rim = np.abs(radius - 45.0) < 1.0
    angle = np.arctan2(v, u)[rim]
    turned = (field[0][rim] + 1j * field[1][rim]) * np.exp(-2j * angle)
    assert np.abs(np.angle(turned)).max() < np.radians(12.0)
    assert np.abs(np.angle(turned.mean())) < np.radians(1.0)


def test_a_quarter_turn_and_a_mirror() -> None:
    image = texture()
    field = orientation_field(image)
    # Twice 90 degrees is a half turn of the complex number; a mirror conjugates it.
    turned = orientation_field(np.ascontiguousarray(np.rot90(image)))
    assert np.allclose(turned, -np.rot90(field, axes=(1, 2)), atol=2e-3)
    mirrored = orientation_field(np.ascontiguousarray(image[:, ::-1]))
    assert np.allclose(mirrored[0], field[0, :, ::-1], atol=2e-3)
    assert np.allclose(mirrored[1], -field[1, :, ::-1], atol=2e-3)


@pytest.mark.parametrize("shift", [(4, 8), (5, 3), (1, 0)])
def test_a_shifted_picture_has_the_shifted_field(shift: tuple[int, int]) -> None:
    wide = texture(height=220, width=260)
    dx, dy = shift
    one = orientation_field(wide[10:210, 10:250])
    two = orientation_field(wide[10 + dy : 210 + dy, 10 + dx : 250 + dx])
    # The mean that is taken off reaches 40 px (a sixth of the long side) across the rim.
    inner = 56
    here = one[:, inner + dy : -inner + dy, inner + dx : -inner + dx]
    there = two[:, inner:-inner, inner:-inner]
    assert agreement(here, there) > 0.999


# -- masks -------------------------------------------------------------------


def mask() -> np.ndarray:
    valid = np.ones((120, 160), np.bool_)
    valid[:, :30] = False
    valid[50:60, 90:120] = False
    return valid


def test_nothing_at_and_beside_invalid_pixels() -> None:
    valid = mask()
    field = orientation_field(texture(), valid)
    beside = cv2.dilate((~valid).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    assert beside.sum() > (~valid).sum()
    assert not field[:, beside].any()
    assert strength(field[:, 70:, 60:]) > 0.1


def test_what_the_mask_hides_does_not_count() -> None:
    """Black, where the map has no data, is a guess as good as any other."""
    valid = mask()
    image, other = texture(), texture(seed=1)
    one = orientation_field(np.where(valid, image, 0).astype(np.uint8), valid)
    two = orientation_field(np.where(valid, image, other).astype(np.uint8), valid)
    assert np.allclose(one, two, atol=1e-5)


def test_a_mask_far_away_changes_little() -> None:
    valid = mask()
    image = texture()
    inside = np.s_[:, 75:, 60:]
    assert agreement(orientation_field(image, valid)[inside], orientation_field(image)[inside]) > 0.98


def test_all_valid_is_as_no_mask() -> None:
    image = texture()
    assert np.allclose(orientation_field(image, np.ones(image.shape, np.bool_)), orientation_field(image), atol=1e-5)


def test_nothing_valid_nothing_there() -> None:
    image = texture()
    assert not orientation_field(image, np.zeros(image.shape, np.bool_)).any()
