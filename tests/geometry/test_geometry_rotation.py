"""SO(3) against its own laws and against OpenCV."""

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from strategies import finite, rotation_vectors, rotations, vectors

from ortholoc_edge.geometry import rotation


@given(vectors(100.0), vectors(100.0))
def test_skew_is_the_cross_product(v, w):
    assert np.allclose(rotation.skew(v) @ w, np.cross(v, w), atol=1e-9)


@given(rotation_vectors())
def test_exp_agrees_with_opencv(vector):
    # OpenCV takes angles below DBL_EPSILON for none.
    assert np.allclose(rotation.exp(vector), cv2.Rodrigues(vector)[0], atol=1e-11)


@given(rotation_vectors(2 * np.pi))
def test_exp_is_a_rotation_and_follows_opencv_beyond_half_a_turn(vector):
    turned = rotation.exp(vector)
    assert np.allclose(turned @ turned.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(turned) == pytest.approx(1.0, abs=1e-12)
    assert np.allclose(turned, cv2.Rodrigues(vector)[0], atol=1e-11)


@given(rotation_vectors(np.pi - 1e-6))
def test_log_inverts_exp(vector):
    assert np.allclose(rotation.log(rotation.exp(vector)), vector, atol=1e-9)


@given(rotations())
def test_exp_inverts_log_up_to_half_a_turn(turned):
    vector = rotation.log(turned)
    assert np.linalg.norm(vector) <= np.pi + 1e-12
    assert np.allclose(rotation.exp(vector), turned, atol=1e-9)


def test_exp_quarter_turn_about_up_takes_east_to_north():
    assert np.allclose(rotation.exp([0, 0, np.pi / 2]) @ [1, 0, 0], [0, 1, 0], atol=1e-15)


@pytest.mark.parametrize("axis", [(1, 0, 0), (0, 1, 0), (0, 0, 1), (0.6, -0.8, 0), (1, 1, 1)])
def test_log_of_exactly_half_a_turn(axis):
    axis = np.array(axis) / np.linalg.norm(axis)
    vector = rotation.log(2 * np.outer(axis, axis) - np.eye(3))
    assert np.allclose(np.abs(vector @ axis), np.pi, atol=1e-9)
    assert np.linalg.norm(vector) == pytest.approx(np.pi, abs=1e-9)


@given(rotations(), rotation_vectors())
def test_angle_between_is_the_angle_of_the_turn(turned, vector):
    angle = np.linalg.norm(vector)
    assert rotation.angle_between(turned, turned @ rotation.exp(vector)) == pytest.approx(angle, abs=2e-8)
    assert rotation.angle_between(turned @ rotation.exp(vector), turned) == pytest.approx(angle, abs=2e-8)


@given(rotations())
def test_quaternion_round_trip(turned):
    q = rotation.to_quaternion(turned)
    assert q[0] >= 0
    assert np.linalg.norm(q) == pytest.approx(1.0, abs=1e-12)
    assert np.allclose(rotation.from_quaternion(q), turned, atol=1e-12)


@given(vectors(1.0, 4).filter(lambda q: np.linalg.norm(q) > 1e-2), finite(1e-3, 1e3))
def test_quaternion_length_and_sign_do_not_matter(q, factor):
    unit = q / np.linalg.norm(q)
    turned = rotation.from_quaternion(factor * q)
    assert np.allclose(turned, rotation.from_quaternion(-q), atol=1e-12)
    assert abs(rotation.to_quaternion(turned) @ unit) == pytest.approx(1.0, abs=1e-12)


def test_quaternion_is_hamilton_wxyz():
    # 90 degrees about z: w = z = sqrt(1/2).
    q = rotation.to_quaternion([[0, -1, 0], [1, 0, 0], [0, 0, 1]])
    assert np.allclose(q, [np.sqrt(0.5), 0, 0, np.sqrt(0.5)])


@pytest.mark.parametrize("q", [(0, 0, 0, 0), (np.nan, 0, 0, 1), (np.inf, 0, 0, 1)])
def test_quaternion_without_direction_is_refused(q):
    with pytest.raises(ValueError, match="no direction"):
        rotation.from_quaternion(q)


@given(finite(-np.pi, np.pi), finite(-np.pi / 2 + 1e-4, np.pi / 2 - 1e-4), finite(-np.pi, np.pi))
def test_euler_round_trip_off_the_poles(roll, pitch, yaw):
    again = rotation.to_euler(rotation.from_euler(roll, pitch, yaw))
    for angle, want in zip(again, (roll, pitch, yaw), strict=True):
        assert np.sin((angle - want) / 2) == pytest.approx(0.0, abs=1e-8)


@given(rotations())
def test_euler_angles_give_the_matrix_back_everywhere(turned):
    # arcsin loses half the digits near the poles; within 1e-6 of one, roll and yaw are not told apart.
    if abs(turned[2, 0]) < 1 - 1e-12:
        assert np.allclose(rotation.from_euler(*rotation.to_euler(turned)), turned, atol=1e-6)


@pytest.mark.parametrize(
    ("angles_deg", "body", "ned"),
    [
        ((0, 0, 90), (1, 0, 0), (0, 1, 0)),  # heading east: the nose points east
        ((0, 30, 0), (1, 0, 0), (np.cos(np.pi / 6), 0, -0.5)),  # nose up is toward -down
        ((30, 0, 0), (0, 1, 0), (0, np.cos(np.pi / 6), 0.5)),  # right wing down
        ((0, -90, 0), (1, 0, 0), (0, 0, 1)),  # nose straight down
    ],
)
def test_euler_known_answers(angles_deg, body, ned):
    assert np.allclose(rotation.from_euler(*np.radians(angles_deg)) @ body, ned, atol=1e-15)


@given(finite(-3, 3), finite(-1.5, 1.5), finite(-3, 3))
def test_euler_is_yaw_then_pitch_then_roll(roll, pitch, yaw):
    want = rotation.exp([0, 0, yaw]) @ rotation.exp([0, pitch, 0]) @ rotation.exp([roll, 0, 0])
    assert np.allclose(rotation.from_euler(roll, pitch, yaw), want, atol=1e-12)


@given(rotations(), rotation_vectors(np.pi - 1e-3), st.floats(0, 1))
def test_slerp_goes_the_shortest_way_at_a_steady_rate(a, vector, t):
    b = a @ rotation.exp(vector)
    angle = np.linalg.norm(vector)
    assert np.allclose(rotation.slerp(a, b, 0.0), a, atol=1e-12)
    assert np.allclose(rotation.slerp(a, b, 1.0), b, atol=1e-9)
    between = rotation.slerp(a, b, t)
    assert rotation.angle_between(a, between) == pytest.approx(t * angle, abs=1e-7)
    assert rotation.angle_between(between, b) == pytest.approx((1 - t) * angle, abs=1e-7)


def test_slerp_midpoint_known_answer():
    middle = rotation.slerp(np.eye(3), rotation.from_euler(0, 0, np.radians(170)), 0.5)
    assert np.degrees(rotation.to_euler(middle)) == pytest.approx([0, 0, 85])
    # 350 degrees is -10: the short way passes north.
    middle = rotation.slerp(rotation.from_euler(0, 0, np.radians(350)), rotation.from_euler(0, 0, np.radians(20)), 0.5)
    assert np.degrees(rotation.to_euler(middle)) == pytest.approx([0, 0, 5])
