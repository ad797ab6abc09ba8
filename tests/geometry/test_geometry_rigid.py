"""The group laws of rigid motions, at map coordinates."""

import numpy as np
import pytest
from hypothesis import given
from strategies import poses, vectors

from ortholoc_edge.geometry import rotation
from ortholoc_edge.geometry.arrays import frozen_floats
from ortholoc_edge.geometry.rigid import Rigid3

# One float64 step at 1e7 m is 2e-9 m.
TOLERANCE_M = 1e-7


@given(poses(), vectors(1e7))
def test_inverse_takes_points_back(a_from_b, points):
    assert np.allclose(a_from_b.inverse().apply(a_from_b.apply(points)), points, rtol=0, atol=TOLERANCE_M)


@given(poses())
def test_pose_times_inverse_is_identity(a_from_b):
    one = a_from_b @ a_from_b.inverse()
    assert np.allclose(one.rotation, np.eye(3), atol=1e-12)
    assert np.allclose(one.translation, 0, atol=TOLERANCE_M)


@given(poses(), poses(1e3), vectors(1e3))
def test_composition_applies_the_right_one_first(a_from_b, b_from_c, points):
    chained = a_from_b.apply(b_from_c.apply(points))
    assert np.allclose((a_from_b @ b_from_c).apply(points), chained, rtol=0, atol=TOLERANCE_M)


@given(poses(), poses(1e3), poses(1e3))
def test_composition_is_associative(a, b, c):
    left, right = (a @ b) @ c, a @ (b @ c)
    assert np.allclose(left.rotation, right.rotation, atol=1e-12)
    assert np.allclose(left.translation, right.translation, rtol=0, atol=TOLERANCE_M)


def test_apply_known_answer():
    # Turned by 90 degrees about up, then moved: the x axis of b points along y of a.
    a_from_b = Rigid3(rotation.exp([0, 0, np.pi / 2]), [100.0, 200.0, 5.0])
    assert np.allclose(a_from_b.apply([10.0, 0.0, 1.0]), [100.0, 210.0, 6.0])
    assert np.allclose(a_from_b.inverse().apply([100.0, 210.0, 6.0]), [10.0, 0.0, 1.0])
    assert a_from_b.apply(np.zeros((4, 5, 3))).shape == (4, 5, 3)


def test_identity_changes_nothing():
    assert np.array_equal(Rigid3.identity().apply([1.0, 2.0, 3.0]), [1.0, 2.0, 3.0])


@pytest.mark.parametrize(
    ("turn", "move"),
    [
        (np.diag([1.0, 1.0, -1.0]), np.zeros(3)),
        (np.eye(3) * 1.001, np.zeros(3)),
        (np.eye(3), np.array([0.0, np.nan, 0.0])),
        (np.full((3, 3), np.inf), np.zeros(3)),
        (np.eye(4), np.zeros(3)),
        (np.eye(3), np.zeros((3, 1))),
    ],
    ids=["mirrored", "scaled", "nan", "infinite", "4x4", "column"],
)
def test_what_is_no_rigid_motion_is_refused(turn, move):
    with pytest.raises(ValueError, match=r"rotation|translation"):
        Rigid3(turn, move)


def test_a_pose_keeps_its_own_read_only_copy():
    move = np.array([1.0, 2.0, 3.0])
    pose = Rigid3(np.eye(3), move)
    move[0] = 99.0
    assert pose.translation[0] == 1.0
    with pytest.raises(ValueError, match="read-only"):
        pose.translation[0] = 0.0


def test_frozen_floats_names_what_is_wrong():
    with pytest.raises(ValueError, match=r"lever: shape \(2,\), expected \(3,\)"):
        frozen_floats([1, 2], (3,), "lever")
    assert frozen_floats([[1, 2]], (None, 2), "px").dtype == np.float64
