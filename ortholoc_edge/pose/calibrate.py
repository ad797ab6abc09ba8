"""Pose with an unknown focal length: the paper's two stages.

Stage one takes a guess, f = max(W, H) where there is no better, and finds a pose by RANSAC; stage two refines focal
length and pose together (aspect and principal point fixed: appendix "Experiment Setting"). Over flat ground
seen straight down focal length and height trade off without bound (appendix "Proof of Focal Length and
Translation Ambiguity"): such an answer is refused rather than called a calibration.
"""

from __future__ import annotations

from ortholoc_edge.geometry.arrays import FloatArray
from ortholoc_edge.geometry.camera import Camera
from ortholoc_edge.pose import pnp

# A wrong focal length bends the projection, so the first stage must be forgiving (matchers.md section 5 used
# 12 px at 1024 px); the last is as strict as for known intrinsics.
_FIRST_STAGE_FACTOR = 2.4
# Beyond this relative uncertainty the focal length says nothing a data sheet does not say better.
MAX_RELATIVE_FOCAL_SIGMA = 0.05


def solve(points_local: FloatArray, query_px: FloatArray, camera: Camera, *, seed: int = 0) -> pnp.PoseEstimate | None:
    """Pose and focal length of 2D-3D matches (N, 3) m, (N, 2) px.

    Args:
        camera: where to begin; its aspect and principal point stay. The paper begins with
            ``Camera.from_focal(W, H, max(W, H))``.
    Returns: None where they are not determined. The caller judges ``focal_sigma_px`` against
        :data:`MAX_RELATIVE_FOCAL_SIGMA`.
    """
    strict_px = pnp.threshold_px(camera)
    loose_px = strict_px * _FIRST_STAGE_FACTOR
    start = pnp.solve(points_local, query_px, camera, max_error_px=loose_px, seed=seed)
    if start is None:
        return None
    joint = pnp.refine(points_local, query_px, camera, start.local_from_camera, max_error_px=loose_px, free_focal=True)
    if joint is None:
        return None
    # Once the focal length is about right the true inliers can be told with the strict threshold.
    again = pnp.solve(points_local, query_px, joint.camera, max_error_px=strict_px, seed=seed)
    if again is None:
        return None
    return pnp.refine(
        points_local, query_px, joint.camera, again.local_from_camera, max_error_px=strict_px, free_focal=True
    )
