"""Rotations as (3, 3) float64 matrices; quaternions are Hamilton, wxyz, unit, w >= 0.

Sources: exp and log after Rodrigues; Euler angles are aerospace ZYX (yaw, then pitch, then roll),
as MAVLink's ATTITUDE has them.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from ortholoc_edge.geometry.arrays import FloatArray


def skew(v: npt.ArrayLike) -> FloatArray:
    """The (3, 3) matrix with ``skew(v) @ w == cross(v, w)``."""
    x, y, z = np.asarray(v, dtype=np.float64)
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def exp(rotation_vector_rad: npt.ArrayLike) -> FloatArray:
    """Rotation matrix of a rotation vector (axis times angle, rad)."""
    # By hand, as `to_quaternion`: of so few numbers NumPy's own calls are most of the time.
    x, y, z = np.asarray(rotation_vector_rad, dtype=np.float64).tolist()
    angle = math.sqrt(x * x + y * y + z * z)
    if angle < 1e-8:
        a, b = 1.0, 0.5
    else:
        a, b = math.sin(angle) / angle, (1.0 - math.cos(angle)) / angle**2
    return np.array(
        [
            [1.0 - b * (y * y + z * z), b * x * y - a * z, b * x * z + a * y],
            [b * x * y + a * z, 1.0 - b * (x * x + z * z), b * y * z - a * x],
            [b * x * z - a * y, b * y * z + a * x, 1.0 - b * (x * x + y * y)],
        ]
    )


def log(rotation: npt.ArrayLike) -> FloatArray:
    """Rotation vector (rad, norm at most pi) of a rotation matrix; inverse of :func:`exp`."""
    w, x, y, z = to_quaternion(rotation)
    v = np.array([x, y, z])
    sin_half = float(np.linalg.norm(v))
    if sin_half < 1e-12:
        return 2.0 * v
    return np.asarray(2.0 * np.arctan2(sin_half, w) / sin_half * v, dtype=np.float64)


def angle_between(a: npt.ArrayLike, b: npt.ArrayLike) -> float:
    """Geodesic angle in radians between two rotations."""
    return float(np.linalg.norm(log(np.asarray(a).T @ np.asarray(b))))


def to_quaternion(rotation: npt.ArrayLike) -> FloatArray:
    """Quaternion wxyz of a rotation matrix (Shepperd's method: the largest component first)."""
    r = np.asarray(rotation, dtype=np.float64).tolist()
    diagonal = r[0][0], r[1][1], r[2][2]
    trace = sum(diagonal)
    if trace >= max(diagonal):
        q = [1.0 + trace, r[2][1] - r[1][2], r[0][2] - r[2][0], r[1][0] - r[0][1]]
    else:
        i = diagonal.index(max(diagonal))
        j, k = (i + 1) % 3, (i + 2) % 3
        q = [r[k][j] - r[j][k], 0.0, 0.0, 0.0]
        q[1 + i] = 1.0 + r[i][i] - r[j][j] - r[k][k]
        q[1 + j] = r[j][i] + r[i][j]
        q[1 + k] = r[k][i] + r[i][k]
    norm = math.copysign(math.sqrt(sum(v * v for v in q)), q[0])
    return np.array(q) / norm


def from_quaternion(q_wxyz: npt.ArrayLike) -> FloatArray:
    """Rotation matrix of a quaternion wxyz, which need not be of unit length.

    Raises: ValueError if the quaternion is not finite or of zero length.
    """
    q = np.asarray(q_wxyz, dtype=np.float64)
    norm = float(np.linalg.norm(q))
    if not np.isfinite(norm) or norm < 1e-12:
        raise ValueError(f"quaternion {q.tolist()} has no direction")
    w, x, y, z = q / norm
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def from_euler(roll_rad: float, pitch_rad: float, yaw_rad: float) -> FloatArray:
    """``ned_from_body`` of ZYX Euler angles."""
    cr, sr = np.cos(roll_rad), np.sin(roll_rad)
    cp, sp = np.cos(pitch_rad), np.sin(pitch_rad)
    cy, sy = np.cos(yaw_rad), np.sin(yaw_rad)
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def to_euler(ned_from_body: npt.ArrayLike) -> tuple[float, float, float]:
    """(roll, pitch, yaw) in rad of ``ned_from_body``; inverse of :func:`from_euler` off the poles."""
    r = np.asarray(ned_from_body, dtype=np.float64)
    pitch = float(np.arcsin(np.clip(-r[2, 0], -1.0, 1.0)))
    return float(np.arctan2(r[2, 1], r[2, 2])), pitch, float(np.arctan2(r[1, 0], r[0, 0]))


def slerp(a: npt.ArrayLike, b: npt.ArrayLike, t: float) -> FloatArray:
    """Rotation at fraction ``t`` of the shortest way from ``a`` (0) to ``b`` (1)."""
    a_matrix = np.asarray(a, dtype=np.float64)
    return np.asarray(a_matrix @ exp(t * log(a_matrix.T @ np.asarray(b, dtype=np.float64))), dtype=np.float64)
