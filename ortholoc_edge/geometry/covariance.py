"""Covariances of poses: from the Jacobian of a least-squares problem, and under change of frame.

A pose covariance is (6, 6): camera position in map axes (m), then a rotation vector in map axes (rad) such that
``R_true = exp(d) @ R_estimated``.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from ortholoc_edge.geometry.arrays import FloatArray, IntArray
from ortholoc_edge.geometry.rotation import skew


def clustered(jacobian: FloatArray, residuals: FloatArray, weights: FloatArray, clusters: IntArray) -> FloatArray:
    """Covariance of weighted least squares whose errors are alike within clusters.

    The plain ``s^2 (J^T W J)^-1`` takes N residuals for N independent measurements. Matches in one patch of the
    image share the error of one patch of the map, so it is far too sure of itself. The sum of scores per
    cluster (Liang and Zeger 1986, "sandwich", with the usual G/(G-1)) shows how much: the plain covariance is
    multiplied by the mean factor over the directions, the design effect; N over it is the effective sample
    size. One scalar rather than the sandwich itself, which with a few dozen clusters is noisy and may be
    rank-deficient.

    The weights stand in for the curvature of the robust loss, which makes the variances some 20 % too small for
    Gaussian errors; the caller's factor for absorbed errors, fitted on real flights, contains that.

    Args:
        jacobian: (N, 2, P) of the residuals by the parameters.
        residuals: (N, 2) px.
        weights: (N,) of the robust loss.
        clusters: (N,) a label per measurement.
    Returns: (P, P). Raises: numpy.linalg.LinAlgError if the parameters are not determined.
    """
    parameters = jacobian.shape[2]
    weighted = jacobian * weights[:, None, None]
    normal = np.einsum("nip,niq->pq", weighted, jacobian)
    freedom = max(2 * len(residuals) - parameters, 1)
    variance = float((weights[:, None] * residuals**2).sum()) / freedom
    # Parameters of unlike units: scale before inverting, so that rank is judged fairly.
    scale = 1.0 / np.sqrt(np.maximum(np.diag(normal), 1e-300))
    scaled = normal * np.outer(scale, scale)
    if np.linalg.cond(scaled) > 1e12:
        raise np.linalg.LinAlgError("the matches do not determine the pose")
    plain = variance * np.linalg.inv(scaled) * np.outer(scale, scale)
    return np.asarray(plain * design_effect(jacobian, residuals, weights, clusters, variance), dtype=np.float64)


def design_effect(
    jacobian: FloatArray, residuals: FloatArray, weights: FloatArray, clusters: IntArray, variance: float
) -> float:
    """How many times larger than ``variance (J^T W J)^-1`` the covariance is for the errors' being alike within
    clusters, 1 at least: see `clustered`, for the arguments, too.

    Args:
        variance: of the residuals, px^2.
    Raises: numpy.linalg.LinAlgError if the parameters are not determined.
    """
    parameters = jacobian.shape[2]
    weighted = jacobian * weights[:, None, None]
    normal = np.einsum("nip,niq->pq", weighted, jacobian)
    scores = np.einsum("nip,ni->np", weighted, residuals)
    _, label = np.unique(clusters, return_inverse=True)
    groups = int(label.max()) + 1
    sums = np.zeros((groups, parameters))
    np.add.at(sums, label, scores)
    middle = sums.T @ sums * (groups / max(groups - 1, 1))
    # trace(plain^-1 A^-1 B A^-1) / P with plain = s^2 A^-1.
    effect = float(np.trace(np.linalg.solve(normal, middle))) / (parameters * max(variance, 1e-12))
    return float(max(effect, 1.0))


def attitude(rotation_from_body: npt.ArrayLike, sigma_rad: tuple[float, float, float]) -> FloatArray:
    """(3, 3) covariance of the rotation vector, in the frame that body is turned into, of an attitude with
    independent errors of roll, pitch and yaw.

    Roll and pitch errors act about the level axes below forward and right, yaw about the vertical: right to
    first order for a vehicle that is not on its side.
    """
    forward = np.array(rotation_from_body, dtype=np.float64)[:, 0]
    forward[2] = 0.0
    norm = float(np.linalg.norm(forward))
    forward = forward / norm if norm > 1e-6 else np.array([1.0, 0.0, 0.0])
    vertical = np.array([0.0, 0.0, 1.0])
    axes = np.column_stack([forward, np.cross(vertical, forward), vertical])
    return np.asarray(axes @ np.diag(np.square(sigma_rad)) @ axes.T, dtype=np.float64)


def turn(sigma_rad: tuple[float, float]) -> FloatArray:
    """(3, 3) covariance of the rotation vector, in axes whose third is vertical, of a tilt about any level axis and a
    heading with these 1-sigmas."""
    tilt, heading = sigma_rad
    return np.diag(np.square([tilt, tilt, heading]))


def of_moved_point(covariance: FloatArray, lever: npt.ArrayLike) -> FloatArray:
    """Pose covariance (6, 6) of a point of the same body, ``lever`` (3,) away in map axes."""
    jacobian = np.eye(6)
    jacobian[:3, 3:] = -skew(lever)
    return jacobian @ covariance @ jacobian.T


def rotated(covariance: FloatArray, rotation: npt.ArrayLike) -> FloatArray:
    """Pose covariance (6, 6) expressed in axes turned by ``rotation`` (3, 3)."""
    block = np.zeros((6, 6))
    block[:3, :3] = block[3:, 3:] = np.asarray(rotation)
    return block @ covariance @ block.T


def horizontal_sigma(covariance: FloatArray) -> float:
    """1-sigma along the worst horizontal direction, of a covariance (n, n) whose first two are east and north."""
    return float(np.sqrt(np.linalg.eigvalsh(covariance[:2, :2])[-1]))


# Standard deviations to a protection level: RTCA DO-229, appendix J, precision approach.
_HORIZONTAL_SIGMAS, _VERTICAL_SIGMAS = 6.0, 5.33


def protection_levels(covariance: FloatArray) -> tuple[float, float]:
    """Horizontal and vertical bound, m, on the position error of a pose with a covariance (6, 6): what satellite
    navigation calls its protection levels, with the horizontal sigma that of the worst direction.

    They bound the error of a pose at the right place; that it is at the right place is what the gate is for.
    """
    return _HORIZONTAL_SIGMAS * horizontal_sigma(covariance), _VERTICAL_SIGMAS * float(np.sqrt(covariance[2, 2]))


def mahalanobis_squared(difference: npt.ArrayLike, covariance: npt.ArrayLike) -> float:
    """``d^T C^-1 d`` of a difference (n,) under a covariance (n, n)."""
    d = np.asarray(difference, dtype=np.float64)
    return float(d @ np.linalg.solve(np.asarray(covariance, dtype=np.float64), d))
