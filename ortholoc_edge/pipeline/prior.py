"""Where to look: the predicted pose with its uncertainty, and the part of the map that it can see."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ortholoc_edge.geometry import rotation
from ortholoc_edge.geometry.arrays import FloatArray, frozen_floats
from ortholoc_edge.geometry.camera import Camera
from ortholoc_edge.geometry.covariance import horizontal_sigma, mahalanobis_squared
from ortholoc_edge.geometry.rigid import Rigid3
from ortholoc_edge.tiles.lattice import Bounds

# Rays that meet the ground farther off than this many heights show pixels too coarse to match
# (field-notes "Oblique views": mask what is beyond ten times the ground sampling distance at nadir).
MAX_RANGE_HEIGHTS = 8.0
_SAMPLES_PER_SIDE = 5
_CLEAR_RANGE_HEIGHTS = 3.0
# XFeat bears about 30 degrees of turn (matchers.md, "Rotation").
_HEADING_STEP_RAD = np.pi / 6
_WHOLE_CIRCLE = 12
# Two sigmas of the position, as a part of the footprint, that one widened view covers; and the grid beyond.
_SHIFT_OF_FOOTPRINT = 0.6
_STEP_OF_FOOTPRINT = 0.6
# Each costs a network pass; more is area search, not tracking.
MAX_HYPOTHESES = 40
_MAX_LISTED = 100_000
_ASYMMETRY = 1e-6


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
        scale = np.sqrt(np.maximum(np.diag(self.covariance), 1e-300))
        correlation = self.covariance / np.outer(scale, scale)
        if np.any(np.diag(self.covariance) < 0) or np.abs(correlation - correlation.T).max() > _ASYMMETRY:
            raise ValueError("prior covariance: not symmetric, or a variance is negative")

    @property
    def position_sigma_m(self) -> float:
        """Along the worst horizontal direction."""
        return horizontal_sigma(self.covariance)

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
    return _on_the_ground(px, camera, map_from_camera, ground_m)


def outline(camera: Camera, map_from_camera: Rigid3, ground_m: float) -> FloatArray:
    """As `footprint`, of the rim alone, once around: a polygon to draw (K, 2)."""
    along = np.linspace(0.0, 1.0, _SAMPLES_PER_SIDE)[:-1]
    zero, one = np.zeros_like(along), np.ones_like(along)
    sides = [(along, zero), (one, along), (1.0 - along, one), (zero, 1.0 - along)]
    rim = np.concatenate([np.stack(side, axis=1) for side in sides])
    return _on_the_ground(rim * (camera.width, camera.height) - 0.5, camera, map_from_camera, ground_m)


def _on_the_ground(px: FloatArray, camera: Camera, map_from_camera: Rigid3, ground_m: float) -> FloatArray:
    rays = camera.pinhole().unproject(px) @ map_from_camera.rotation.T
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    drop = float(map_from_camera.translation[2]) - ground_m
    with np.errstate(divide="ignore"):
        reach = np.where(rays[:, 2] < 0, -drop / rays[:, 2], np.inf)
    reach = np.minimum(reach, MAX_RANGE_HEIGHTS * drop)
    return np.asarray(map_from_camera.translation[:2] + rays[:, :2] * reach[:, None], dtype=np.float64)


def search_bounds(points_map: FloatArray, prior: PosePrior, ground_m: float, sigmas: float) -> Bounds:
    """Bounds of a footprint (K, 2) on a level ground, inflated by ``sigmas`` of what the prior may be off.

    A tilt error moves the far end, a distance r away from a height h, by ``(h^2 + r^2) / h``, a heading error by
    r and a height error by ``r / h``. Beyond three heights the ground is seen so flat that a part of it may miss.
    """
    height = float(prior.map_from_camera.translation[2]) - ground_m
    away = float(np.linalg.norm(points_map - prior.map_from_camera.translation[:2], axis=1).max())
    clear = min(away, _CLEAR_RANGE_HEIGHTS * height)
    margin = sigmas * float(
        np.linalg.norm(
            [
                prior.position_sigma_m,
                prior.tilt_sigma_rad * (height**2 + clear**2) / height,
                # A turn moves nothing by more than the circle is wide.
                min(prior.heading_sigma_rad, 2.0 / sigmas) * away,
                prior.height_sigma_m * clear / height,
            ]
        )
    )
    west, south = points_map.min(axis=0) - margin
    east, north = points_map.max(axis=0) + margin
    return float(west), float(south), float(east), float(north)


def hypotheses(prior: PosePrior, footprint_m: float) -> list[PosePrior] | None:
    """Narrower priors that together cover a wide one, the likeliest first; None if there are more than
    `MAX_HYPOTHESES`.

    A matcher bears a shift of about half the picture and a turn of about 30 degrees; a prior within that is its
    own single hypothesis.

    Args:
        footprint_m: the short side of what the camera sees.
    """
    headings = _heading_steps(prior.heading_sigma_rad)
    offsets = _position_steps(prior, footprint_m)
    if offsets is None or len(offsets) * len(headings) > MAX_HYPOTHESES:
        return None
    if len(headings) == 1 and len(offsets) == 1:
        return [prior]
    covariance = prior.covariance.copy()
    if len(offsets) > 1:
        covariance[:2, :2] = np.eye(2) * (_STEP_OF_FOOTPRINT * footprint_m / 2.0) ** 2
        covariance[:2, 2:] = covariance[2:, :2] = 0.0
    if len(headings) > 1:
        covariance[5, :5] = covariance[:5, 5] = 0.0
        covariance[5, 5] = (_HEADING_STEP_RAD / 2.0) ** 2
    pose = prior.map_from_camera
    # Both lists are sorted and sorting is stable: ties keep the nearer position first.
    pairs = sorted(
        ((offset, turn) for offset in offsets for turn in headings),
        key=lambda pair: (
            mahalanobis_squared(pair[0], prior.covariance[:2, :2]) + (pair[1] / prior.heading_sigma_rad) ** 2
        ),
    )
    return [
        PosePrior(
            Rigid3(rotation.exp([0.0, 0.0, turn]) @ pose.rotation, pose.translation + np.append(offset, 0.0)),
            covariance,
        )
        for offset, turn in pairs
    ]


def _heading_steps(sigma_rad: float) -> list[float]:
    """Turns about the vertical that cover two sigmas, or the whole circle; the smallest first."""
    count = round(2.0 * sigma_rad / _HEADING_STEP_RAD - 0.5)
    if count >= _WHOLE_CIRCLE // 2:
        return sorted((_HEADING_STEP_RAD * k for k in range(1 - _WHOLE_CIRCLE // 2, _WHOLE_CIRCLE // 2 + 1)), key=abs)
    return sorted((_HEADING_STEP_RAD * k for k in range(-count, count + 1)), key=abs)


def _position_steps(prior: PosePrior, footprint_m: float) -> FloatArray | None:
    """Horizontal offsets (N, 2) on a grid over the prior's two-sigma ellipse; None if they are too many to list."""
    if 2.0 * prior.position_sigma_m <= _SHIFT_OF_FOOTPRINT * footprint_m:
        return np.zeros((1, 2))
    step = _STEP_OF_FOOTPRINT * footprint_m
    # The ellipse's own box: a long and narrow one needs few cells.
    reach = np.ceil(2.0 * np.sqrt(np.diag(prior.covariance)[:2]) / step)
    if np.prod(2 * reach + 1) > _MAX_LISTED:
        return None
    east, north = (step * np.arange(-r, r + 1) for r in reach)
    grid = np.stack(np.meshgrid(east, north, indexing="ij"), axis=-1).reshape(-1, 2)
    # A cell counts if it comes within two sigmas.
    length = np.linalg.norm(grid, axis=1, keepdims=True)
    near = grid * np.maximum(0.0, 1.0 - 0.5 * step / np.maximum(length, 1e-9))
    squared = np.einsum("ni,ij,nj->n", near, np.linalg.inv(prior.covariance[:2, :2]), near)
    return np.asarray(grid[squared <= 4.0], dtype=np.float64)
