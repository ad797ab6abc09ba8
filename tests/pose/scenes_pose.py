"""Synthetic 2D-3D matches whose pose is known."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ortholoc_edge.geometry import frames, rotation
from ortholoc_edge.geometry.arrays import FloatArray
from ortholoc_edge.geometry.camera import Camera
from ortholoc_edge.geometry.rigid import Rigid3

CAMERA = Camera(1024, 768, 800.0, 800.0, 511.5, 383.5)


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    camera: Camera
    local_from_camera: Rigid3
    points: FloatArray
    px: FloatArray
    right: np.ndarray


def looking_down(tilt_deg: float = 0.0, heading_deg: float = 0.0) -> FloatArray:
    """Map axes from a camera under a body that is pitched up by ``tilt_deg``."""
    body = rotation.from_euler(0.0, np.radians(tilt_deg), np.radians(heading_deg))
    return frames.ENU_FROM_NED @ body @ frames.BODY_FROM_NADIR_CAMERA


def scene(
    seed: int,
    *,
    count: int = 300,
    tilt_deg: float = 20.0,
    relief_m: float = 8.0,
    height_m: float = 100.0,
    noise_px: float = 0.5,
    outliers: float = 0.0,
    camera: Camera = CAMERA,
    random: np.random.Generator | None = None,
) -> Scene:
    """Ground of random heights around 0, seen from ``height_m`` with a random heading; pixels over all the image."""
    random = np.random.default_rng(seed) if random is None else random
    pose = Rigid3(
        looking_down(tilt_deg, float(random.uniform(-180, 180))), np.append(random.uniform(-50, 50, 2), height_m)
    )
    px = random.uniform((0, 0), (camera.width - 1, camera.height - 1), (count, 2))
    rays = camera.unproject(px) @ pose.rotation.T
    heights = random.uniform(-relief_m, relief_m, count)
    points = pose.translation + rays * ((heights - height_m) / rays[:, 2])[:, None]
    seen = px + random.normal(size=px.shape) * noise_px
    right = np.ones(count, dtype=bool)
    right[: round(outliers * count)] = False
    seen[~right] = random.uniform((0, 0), (camera.width - 1, camera.height - 1), (int((~right).sum()), 2))
    return Scene(camera, pose, points, seen, right)
