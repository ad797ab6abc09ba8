"""What one frame comes to: a fix, or a rejection with its reason. Both are ordinary values."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum

from ortholoc_edge.geometry.arrays import FloatArray
from ortholoc_edge.geometry.camera import Camera
from ortholoc_edge.geometry.covariance import protection_levels
from ortholoc_edge.geometry.rigid import Rigid3


class Reason(StrEnum):
    """Why a frame gave no fix."""

    BAD_FRAME = "bad_frame"  # truncated, empty, or of another size than the camera's
    DARK = "dark"
    REPEATED = "repeated"  # bit for bit the picture of the frame before, under another stamp
    FROZEN = "frozen"  # again and again
    MOTION_BLUR = "motion_blur"  # predicted: the ground moved too far while the shutter was open
    NO_PRIOR = "no_prior"  # nothing says where to look
    BAD_ATTITUDE = "bad_attitude"  # NaN or missing attitude from the autopilot
    GIMBAL_UNKNOWN = "gimbal_unknown"  # nothing says where the gimbal looked at the exposure
    PRIOR_TOO_WIDE = "prior_too_wide"  # the search would cover more map than may be read
    OUTSIDE_MAP = "outside_map"  # the predicted view does not meet the pack
    MAP_NODATA = "map_nodata"  # the pack has no DOP or no DSM there, or lost it by damage
    FEW_MATCHES = "few_matches"
    FEW_INLIERS = "few_inliers"
    LOW_INLIER_RATIO = "low_inlier_ratio"
    LOW_CONTRAST = "low_contrast"  # the map fits hardly better where the pose puts it than beside it
    POOR_SPREAD = "poor_spread"  # inliers huddle in a part of the image
    HIGH_REPROJECTION = "high_reprojection"
    DEGENERATE_GEOMETRY = "degenerate_geometry"  # the pose is not determined by the matches
    GRAVITY_DISAGREES = "gravity_disagrees"  # the horizon differs from the autopilot's
    AMBIGUOUS = "ambiguous"  # another place that the prior allows fits as well: rows of trees, of panels
    PRIOR_DISAGREES = "prior_disagrees"  # heading or position too far from what was predicted
    UNCERTAIN = "uncertain"  # the pose's own covariance is too wide
    LATE = "late"
    PAUSED = "paused"  # by command
    INTERNAL = "internal"


@dataclass(frozen=True, slots=True, eq=False)
class Rejected:
    """No fix. ``measured`` against ``limit`` (where the test is a number) tells by how much."""

    stamp_ns: int
    reason: Reason
    detail: str = ""
    measured: float | None = None
    limit: float | None = None
    timings_ms: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, eq=False)
class Fix:
    """A pose that passed the gate.

    Attributes:
        stamp_ns: of the frame.
        map_from_camera: easting, northing, height in m (map units, not true metres) and grid-north axes.
        camera: the intrinsics of the pose: the configured ones, or calibrated.
        focal_sigma_px: 1-sigma of a calibrated focal length; None if it was given.
        covariance: (6, 6); position in map axes (m), then rotation vector in map axes (rad):
            ``R_true = exp(d) @ R_estimated``. Of structural matching the autopilot's attitude is in it, with its sigma.
        ground_covariance: (6, 6), the part of ``covariance`` that is of ground which the view does not agree with
            (`surface.unsettled_covariance`); None where nothing was added. It is there for whoever uses the fix; what
            judges others by the fix, GNSS above all, must not be led by it to trust them more.
        quality: 0..1, the inlier ratio of a round whose pairs were not picked by a pose; of structural matching the
            part of the patches in view that agree. For displays and for MAVLink's quality field.
        matches, inliers: counts of the round that gave the pose.
        rms_px: root mean square reprojection error of the inliers at the frame's full size.
        adhop_accepted: whether the second round gave the pose; None if it was not run.
        query_px, points_map: (M, 2) and (M, 3), the inliers.
        timings_ms: per stage.
        stored_features: whether the pack's precomputed features gave the pose, and not the network on the map.
    """

    stamp_ns: int
    map_from_camera: Rigid3
    camera: Camera
    covariance: FloatArray
    quality: float
    matches: int
    inliers: int
    rms_px: float
    adhop_accepted: bool | None
    query_px: FloatArray
    points_map: FloatArray
    focal_sigma_px: float | None = None
    timings_ms: dict[str, float] = field(default_factory=dict)
    stored_features: bool = False
    ground_covariance: FloatArray | None = None

    @property
    def protection_m(self) -> tuple[float, float]:
        """Horizontal and vertical protection level: `covariance.protection_levels`."""
        return protection_levels(self.covariance)


Outcome = Fix | Rejected
