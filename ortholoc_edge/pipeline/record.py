"""Outcomes as plain values, for JSON: in results, in the log and on the bus alike."""

from __future__ import annotations

from typing import Any

from ortholoc_edge.geometry import rotation
from ortholoc_edge.pipeline.outcome import Fix, Outcome


def outcome_record(outcome: Outcome) -> dict[str, Any]:
    """An outcome as numbers, strings and lists; units and frames are those of `Fix` and `Rejected`."""
    if not isinstance(outcome, Fix):
        return {
            "stamp_ns": outcome.stamp_ns,
            "fix": False,
            "reason": str(outcome.reason),
            "detail": outcome.detail,
            "measured": outcome.measured,
            "limit": outcome.limit,
            "timings_ms": outcome.timings_ms,
        }
    pose = outcome.map_from_camera
    return {
        "stamp_ns": outcome.stamp_ns,
        "fix": True,
        "position_map_m": pose.translation.tolist(),
        "quaternion_map_from_camera_wxyz": rotation.to_quaternion(pose.rotation).tolist(),
        "covariance": outcome.covariance.tolist(),
        "protection_m": list(outcome.protection_m),
        "quality": outcome.quality,
        "matches": outcome.matches,
        "inliers": outcome.inliers,
        "rms_px": outcome.rms_px,
        "adhop_accepted": outcome.adhop_accepted,
        "stored_features": outcome.stored_features,
        "focal_px": outcome.camera.focal_px,
        "focal_sigma_px": outcome.focal_sigma_px,
        "timings_ms": outcome.timings_ms,
    }
