"""Values that several tests of the pipeline start from."""

from __future__ import annotations

from typing import Any

import numpy as np

from ortholoc_edge.geometry import frames, rotation
from ortholoc_edge.geometry.arrays import FloatArray
from ortholoc_edge.geometry.camera import Camera
from ortholoc_edge.geometry.grid import RasterGrid
from ortholoc_edge.geometry.rigid import Rigid3
from ortholoc_edge.pipeline.outcome import Fix
from ortholoc_edge.pipeline.prior import PosePrior
from ortholoc_edge.tiles.window import MapWindow

# 90 degrees across: straight down from 100 m it sees 200 m.
WIDE = Camera.from_focal(400, 300, 200.0)


def turned_down(tilt_deg: float = 0.0, heading_deg: float = 0.0, roll_deg: float = 0.0) -> FloatArray:
    """Map axes from a nadir camera under a body with nose up by ``tilt_deg`` on a grid heading."""
    body = rotation.from_euler(*np.radians([roll_deg, tilt_deg, heading_deg]))
    return np.asarray(frames.ENU_FROM_NED @ body @ frames.BODY_FROM_NADIR_CAMERA)


def pose_prior(
    position: Any = (0.0, 0.0, 100.0),
    *,
    tilt_deg: float = 0.0,
    heading_deg: float = 0.0,
    sigma_m: tuple[float, float, float] = (2.0, 2.0, 2.0),
    sigma_deg: tuple[float, float, float] = (1.0, 1.0, 3.0),
) -> PosePrior:
    """Independent errors; the last of ``sigma_deg`` is the heading's."""
    return PosePrior(
        Rigid3(turned_down(tilt_deg, heading_deg), position),
        np.diag(np.square([*sigma_m, *np.radians(sigma_deg)])),
    )


def fix(position: Any, *, stamp_ns: int = 0, rotation_matrix: FloatArray | None = None, sigma_m: float = 0.5) -> Fix:
    return Fix(
        stamp_ns=stamp_ns,
        map_from_camera=Rigid3(turned_down() if rotation_matrix is None else rotation_matrix, position),
        camera=WIDE,
        covariance=np.diag(np.square([sigma_m] * 3 + [0.005] * 3)),
        quality=0.8,
        matches=200,
        inliers=160,
        rms_px=1.2,
        adhop_accepted=None,
        query_px=np.zeros((160, 2)),
        points_map=np.zeros((160, 3)),
    )


def ramp_window(grid: RasterGrid, plane: FloatArray, dsm_step: int = 4) -> MapWindow:
    """A window whose DSM is the plane ``z = a + b (E - E0) + c (N - N0)``, E0, N0 the grid's first corner."""
    dsm_grid = grid.resized(grid.width // dsm_step, grid.height // dsm_step)
    columns, rows = np.meshgrid(np.arange(dsm_grid.width), np.arange(dsm_grid.height))
    centres = dsm_grid.map_from_px(np.stack([columns, rows], axis=-1)) - (grid.west, grid.top)
    dsm = (plane[0] + centres @ plane[1:]).astype(np.float32)
    shape = (grid.height, grid.width)
    return MapWindow(np.zeros(shape, np.uint8), np.ones(shape, bool), grid, dsm, dsm_grid)
