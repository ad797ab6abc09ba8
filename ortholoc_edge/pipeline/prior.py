"""Where to look: the predicted pose with its uncertainty, and the part of the map that it can see."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ortholoc_edge.geometry.arrays import FloatArray, frozen_floats
from ortholoc_edge.geometry.camera import Camera
from ortholoc_edge.geometry.rigid import Rigid3

Bounds = tuple[float, float, float, float]

# Rays that meet the ground farther off than this many heights show pixels too coarse to match
# (field-notes "Oblique views": mask what is beyond ten times the ground sampling distance at nadir).
MAX_RANGE_HEIGHTS = 8.0
_SAMPLES_PER_SIDE = 5


@dataclass(frozen=True, slots=True, eq=False)
class PosePrior:
    """A predicted pose.

    Attributes:
        map_from_camera: the prediction, map units.
        covariance: (6, 6) of position (m) and rotation vector (rad), in map axes.
    """

    map_from_camera: Rigid3
    covariance: FloatArray

    def __post_init__(self) -> None:
        object.__setattr__(self, "covariance", frozen_floats(self.covariance, (6, 6), "prior covariance"))

    @property
    def position_sigma_m(self) -> float:
        """Along the worst horizontal direction."""
        return float(np.sqrt(np.linalg.eigvalsh(self.covariance[:2, :2])[-1]))

    @property
    def height_sigma_m(self) -> float:
        return float(np.sqrt(self.covariance[2, 2]))

    @property
    def tilt_sigma_rad(self) -> float:
        return float(np.sqrt(np.linalg.eigvalsh(self.covariance[3:5, 3:5])[-1]))

    @property
    def heading_sigma_rad(self) -> float:
        return float(np.sqrt(self.covariance[5, 5]))


@dataclass(frozen=True, slots=True)
class RegionPrior:
    """A part of the map that the frame shows somewhere, and nothing of the pose: the paper's setting.

    Attributes:
        bounds_map: west, south, east, north in m.
    """

    bounds_map: Bounds


def footprint(camera: Camera, map_from_camera: Rigid3, ground_m: float) -> FloatArray:
    """Where the rim and the middle of the picture meet a level ground.

    Args:
        camera: of any size; its distortion is ignored.
        ground_m: height of the ground; must be below the camera.
    Returns: (K, 2) easting and northing. Rays at or above the horizon, and those that meet the ground beyond
    `MAX_RANGE_HEIGHTS` heights, end there.
    """
    u = np.linspace(-0.5, camera.width - 0.5, _SAMPLES_PER_SIDE)
    v = np.linspace(-0.5, camera.height - 0.5, _SAMPLES_PER_SIDE)
    px = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    rays = camera.pinhole().unproject(px) @ map_from_camera.rotation.T
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    drop = float(map_from_camera.translation[2]) - ground_m
    with np.errstate(divide="ignore"):
        reach = np.where(rays[:, 2] < 0, -drop / rays[:, 2], np.inf)
    reach = np.minimum(reach, MAX_RANGE_HEIGHTS * drop)
    return np.asarray(map_from_camera.translation[:2] + rays[:, :2] * reach[:, None], dtype=np.float64)


def search_bounds(points_map: FloatArray, prior: PosePrior, sigmas: float) -> Bounds:
    """Bounds of a footprint (K, 2), inflated by ``sigmas`` of the prior: its position, and its angles at the
    distance of the footprint's far end."""
    away = float(np.linalg.norm(points_map - prior.map_from_camera.translation[:2], axis=1).max())
    # Over flat ground at height h a tilt error e moves the axis by h (1 + tan^2) e; the reach bounds it.
    height_reach = away * (prior.tilt_sigma_rad + min(prior.heading_sigma_rad, np.pi))
    margin = sigmas * float(np.hypot(prior.position_sigma_m, height_reach))
    west, south = points_map.min(axis=0) - margin
    east, north = points_map.max(axis=0) + margin
    return float(west), float(south), float(east), float(north)
