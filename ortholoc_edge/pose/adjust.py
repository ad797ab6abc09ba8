"""Pose from 2D-3D matches whose errors are known, near a predicted pose: robust least squares with the prediction as
one more measurement.

Where matches were looked for within a few pixels of where a pose says that they are, no minimal solver is needed to
find the right ones; and where they are few, or lie along one line, only the prediction keeps the pose in shape.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ortholoc_edge.geometry import rotation
from ortholoc_edge.geometry.arrays import FloatArray
from ortholoc_edge.geometry.camera import Camera
from ortholoc_edge.geometry.rigid import Rigid3

_ITERATIONS_PER_SCALE = 2
_MAX_FINAL_ITERATIONS = 8
# Of a step, in standard deviations of the parameters: smaller ones change nothing.
_SMALL_STEP = 0.01
_MIN_DEPTH_M = 0.05


@dataclass(frozen=True, slots=True, eq=False)
class PoseMeasurement:
    """A pose that is known from elsewhere.

    Attributes:
        local_from_camera: the pose.
        information: (6, 6) inverse covariance of position (m) and rotation vector (rad) in map axes; 0 for what is
            not known.
    """

    local_from_camera: Rigid3
    information: FloatArray

    def error(self, pose: Rigid3) -> FloatArray:
        """(6,) from the measurement to a pose."""
        turn = rotation.log(pose.rotation @ self.local_from_camera.rotation.T)
        return np.concatenate([pose.translation - self.local_from_camera.translation, turn])


@dataclass(frozen=True, slots=True, eq=False)
class Adjusted:
    """The most probable pose.

    Attributes:
        local_from_camera: camera centre in true metres; map axes.
        residuals_px: (N, 2) reprojection errors; infinite behind the camera.
        weights: (N,) of the robust loss, 0 to 1.
        jacobian: (N, 2, 6) of the residuals by centre and rotation vector.
    """

    local_from_camera: Rigid3
    residuals_px: FloatArray
    weights: FloatArray
    jacobian: FloatArray

    def take(self, count: int) -> Adjusted:
        """With the first ``count`` matches only."""
        return Adjusted(
            self.local_from_camera, self.residuals_px[:count], self.weights[:count], self.jacobian[:count]
        )


def adjust(
    points_local: FloatArray,
    px: FloatArray,
    camera: Camera,
    start: Rigid3,
    *,
    information: FloatArray,
    measured: PoseMeasurement,
    scales: tuple[float, ...],
) -> Adjusted | None:
    """Gauss-Newton with the Geman-McClure loss, whose scale falls (graduated non-convexity: Black and Rangarajan 1996).

    Args:
        points_local: (N, 3) m.
        px: (N, 2) where they are seen, pixels of the camera without distortion.
        information: (N, 2, 2) inverse covariance of ``px``, px^-2.
        measured: what else is known of the pose.
        scales: of the loss, in standard deviations of a match: falling, the last is for good.
    Returns: None if the pose is not determined.
    """
    pose = start
    residuals, jacobian = linearised(points_local, px, camera, pose)
    weights = np.ones(len(px))
    for number, scale in enumerate(scales):
        last = number == len(scales) - 1
        for _ in range(_MAX_FINAL_ITERATIONS if last else _ITERATIONS_PER_SCALE):
            usable = np.asarray(np.isfinite(residuals).all(axis=1))
            safe = np.where(usable[:, None], residuals, 0.0)
            whitened = np.einsum("nij,nj->ni", information, safe)
            weights = np.where(usable, _geman_mcclure(np.einsum("ni,ni->n", safe, whitened), scale), 0.0)
            normal, gradient = normal_equations(jacobian, information * weights[:, None, None], safe)
            normal += measured.information
            gradient += measured.information @ measured.error(pose)
            try:
                step = np.asarray(-np.linalg.solve(normal, gradient), dtype=np.float64)
            except np.linalg.LinAlgError:
                return None
            if not np.isfinite(step).all():
                return None
            pose = moved(pose, step)
            residuals, jacobian = linearised(points_local, px, camera, pose)
            if last and float(step @ normal @ step) < _SMALL_STEP**2:
                break
    return Adjusted(pose, residuals, weights, jacobian)


def normal_equations(
    jacobian: FloatArray, information: FloatArray, residuals: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """``sum J^T W J`` (6, 6) and ``sum J^T W r`` (6,) of (N, 2, 6), (N, 2, 2) and (N, 2)."""
    flat = (information @ jacobian).reshape(-1, 6)
    return flat.T @ jacobian.reshape(-1, 6), flat.T @ residuals.ravel()


def moved(pose: Rigid3, step: FloatArray) -> Rigid3:
    """A pose after a step (6,) of centre and rotation vector."""
    return Rigid3(rotation.exp(step[3:]) @ pose.rotation, pose.translation + step[:3])


def _geman_mcclure(squared: FloatArray, scale: float) -> FloatArray:
    return np.asarray((scale**2 / (scale**2 + squared)) ** 2, dtype=np.float64)


def linearised(points: FloatArray, px: FloatArray, camera: Camera, pose: Rigid3) -> tuple[FloatArray, FloatArray]:
    """Residuals (N, 2) of points (N, 3) seen at ``px`` (N, 2), infinite behind the camera, and their Jacobian
    (N, 2, 6), 0 there, by camera centre and rotation vector (both in map axes, ``R = exp(d) R``)."""
    from_centre = points - pose.translation
    x, y, z = (from_centre @ pose.rotation).T
    ahead = z > _MIN_DEPTH_M
    inverse = np.where(ahead, 1.0 / np.where(ahead, z, 1.0), 0.0)
    u, v = x * inverse, y * inverse
    residuals = np.empty((len(points), 2))
    residuals[:, 0] = camera.fx * u + (camera.cx - px[:, 0])
    residuals[:, 1] = camera.fy * v + (camera.cy - px[:, 1])
    residuals[~ahead] = np.inf
    # Rows of R^T are the camera's axes in the map; d(px) = (axis - ratio * optical axis) f / z.
    right, below, along = pose.rotation.T
    by_point = np.empty((len(points), 2, 3))
    by_point[:, 0] = (camera.fx * inverse)[:, None] * (right - u[:, None] * along)
    by_point[:, 1] = (camera.fy * inverse)[:, None] * (below - v[:, None] * along)
    # d(R^T exp(-d) (P - C)) = R^T skew(P - C) d, and a row r times skew(p) is r x p.
    jacobian = np.empty((len(points), 2, 6))
    jacobian[:, :, :3] = -by_point
    for axis, (one, other) in enumerate(((1, 2), (2, 0), (0, 1))):
        jacobian[:, :, 3 + axis] = (
            by_point[:, :, one] * from_centre[:, None, other] - by_point[:, :, other] * from_centre[:, None, one]
        )
    return residuals, jacobian
