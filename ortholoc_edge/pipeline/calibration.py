"""The camera of some photos, from their matches with the map: which photos take part, and whether the answer is one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from ortholoc_edge.geometry.camera import Camera
from ortholoc_edge.pipeline import gate
from ortholoc_edge.pipeline.outcome import Reason
from ortholoc_edge.pose import calibrate, pnp
from ortholoc_edge.pose.calibrate import Calibration, Unknowns, View


@dataclass(frozen=True, slots=True, eq=False)
class Calibrated:
    """A camera that the photos tell.

    Attributes:
        found: with a view for each photo in ``names``, all of them with a pose.
        names: of the photos that took part.
        dropped: why the others did not.
    """

    found: Calibration
    names: tuple[str, ...]
    dropped: Mapping[str, gate.Refusal]


@dataclass(frozen=True, slots=True, eq=False)
class NotCalibrated:
    """No camera: ``measured`` against ``limit``, and what helps.

    Attributes:
        dropped: the photos that did not take part, and why.
        found: what came out all the same, of ``names``; its focal length goes with its own height and is no one else's.
            None if nothing did.
    """

    reason: Reason
    detail: str
    measured: float
    limit: float
    remedy: str
    dropped: Mapping[str, gate.Refusal] = field(default_factory=dict)
    found: Calibration | None = None
    names: tuple[str, ...] = ()


def calibrate_photos(
    views: Mapping[str, View],
    camera: Camera,
    unknowns: Unknowns = calibrate.USUAL,
    limits: gate.GateOptions = gate.GateOptions(),  # noqa: B008
    seed: int = 0,
) -> Calibrated | NotCalibrated:
    """Intrinsics of the camera that took some photos, and their poses.

    Args:
        views: by the names of the photos.
        camera: where to begin.
        limits: for each photo; those of the inliers count.
    """
    dropped: dict[str, gate.Refusal] = {}
    names: Sequence[str] = tuple(views)
    # Leaving a photo out changes what the others agree on; another may have to go. Each takes one at least.
    while True:
        found = calibrate.solve([views[name] for name in names], camera, unknowns, seed=seed) if names else None
        if found is None:
            dropped |= {name: _no_pose(views[name], limits) for name in names}
            break
        refused = {
            name: why
            for name, estimate in zip(names, found.views, strict=True)
            if (why := refusal(views[name], estimate, camera, limits)) is not None
        }
        if not refused:
            ill = calibrate.ill_posed(found)
            if ill is None:
                return Calibrated(found, tuple(names), dropped)
            return NotCalibrated(
                Reason.DEGENERATE_GEOMETRY, ill.what, ill.measured, ill.limit, ill.remedy, dropped, found, tuple(names)
            )
        dropped |= refused
        names = tuple(name for name in names if name not in refused)
    return NotCalibrated(
        Reason.FEW_MATCHES,
        f"no photo of {len(views)} has matches that agree on a pose",
        0,
        1,
        "use photos of the pack's area, sharp and of the same season, or another matcher",
        dropped,
    )


def refusal(
    view: View, estimate: pnp.PoseEstimate | None, camera: Camera, limits: gate.GateOptions
) -> gate.Refusal | None:
    """Why a photo takes no part: what the gate would say of its pose."""
    if estimate is None:
        return _no_pose(view, limits)
    ground_m = float(np.median(view.points[estimate.inliers, 2]))
    return (
        gate.enough_inliers(estimate, limits)
        or gate.well_spread(estimate, view.px, limits)
        or gate.small_residual(estimate, pnp.threshold_px(camera), limits)
        or gate.above_ground(float(estimate.local_from_camera.translation[2]) - ground_m)
    )


def _no_pose(view: View, limits: gate.GateOptions) -> gate.Refusal:
    return gate.Refusal(
        Reason.FEW_INLIERS, f"no pose has the agreement of {len(view.points)} matches", 0, limits.min_inliers
    )
