"""Outcomes as what a map can show: plain numbers, in metres from the page's origin. Pure.

A fix's place is the camera's. Positions have centimetres and covariances three digits: they go over a radio.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from msgspec import Struct

from ortholoc_edge.geometry.arrays import FloatArray
from ortholoc_edge.geometry.camera import Camera
from ortholoc_edge.geometry.rigid import Rigid3
from ortholoc_edge.pipeline.frame import VehicleState
from ortholoc_edge.pipeline.outcome import Fix, Outcome
from ortholoc_edge.pipeline.prior import PosePrior, outline

_MS = 1_000_000
_MOST_POINTS = 150

Point = tuple[float, float]


class Pose(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """A camera on the map.

    Attributes:
        at: east, north, height, m.
        cov: east-east, east-north, north-north, m2; sigma_h: 1-sigma of the height, m.
        heading_deg: of the body's nose, clockwise from grid north; None where it is not known how the camera sits.
        rim: of what it sees, on a level ground; empty where that is not known.
    """

    at: tuple[float, float, float]
    cov: tuple[float, float, float]
    sigma_h: float
    heading_deg: float | None = None
    rim: list[Point] = []


class Mark(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """What a frame came to.

    Attributes:
        n: the number, rising. t: exposure, ms of the daemon's clock. late_ms: from then until the outcome was there.
        fix: the pose, of a fix; prior: that was predicted.
        believed, gnss: where the autopilot, and its GNSS, put the vehicle.
        reason, detail, measured, limit: of a rejection.
        inliers, matches, quality, rms_px: of a fix. took_ms: per stage.
    """

    n: int
    t: float
    late_ms: float | None = None
    fix: Pose | None = None
    prior: Pose | None = None
    believed: Point | None = None
    gnss: Point | None = None
    reason: str | None = None
    detail: str = ""
    measured: float | None = None
    limit: float | None = None
    inliers: int | None = None
    matches: int | None = None
    quality: float | None = None
    rms_px: float | None = None
    took_ms: dict[str, float] = {}


@dataclass(frozen=True, slots=True, eq=False)
class Drawing:
    """What outcomes are drawn with.

    Attributes:
        origin: map coordinates of the page's (0, 0).
        camera: of predictions; fixes bring their own.
        body_from_camera: of a fixed mount; None where only the state knows.
    """

    origin: tuple[float, float]
    camera: Camera
    body_from_camera: Rigid3 | None

    def mark(
        self, n: int, outcome: Outcome, ground_m: float | None, *, prior: PosePrior | None = None,
        state: VehicleState | None = None, late_ms: float | None = None,
    ) -> Mark:  # fmt: skip
        """
        Args:
            ground_m: height of the ground that the camera looks at; None: what it sees is left out, which is most of
                the work.
        """
        mount = self.body_from_camera if state is None or state.mount is None else state.mount.body_from_camera
        predicted = None
        if prior is not None:
            predicted = self._pose(prior.map_from_camera, prior.covariance, self.camera, mount, ground_m)
        believed = None if state is None else self._point(state.believed_map_m)
        gnss = None if state is None else self._point(state.position_map_m)
        stamp_ms = round(outcome.stamp_ns / _MS, 1)
        took = {stage: round(spent_ms, 1) for stage, spent_ms in outcome.timings_ms.items()}
        late_ms = None if late_ms is None else round(late_ms, 1)
        if not isinstance(outcome, Fix):
            return Mark(
                n=n, t=stamp_ms, late_ms=late_ms, prior=predicted, believed=believed, gnss=gnss,
                reason=str(outcome.reason), detail=outcome.detail, measured=outcome.measured, limit=outcome.limit,
                took_ms=took,
            )  # fmt: skip
        pose = self._pose(outcome.map_from_camera, outcome.covariance, outcome.camera, mount, ground_m)
        return Mark(
            n=n, t=stamp_ms, late_ms=late_ms, fix=pose, prior=predicted, believed=believed, gnss=gnss,
            inliers=outcome.inliers, matches=outcome.matches, quality=round(outcome.quality, 3),
            rms_px=round(outcome.rms_px, 2), took_ms=took,
        )  # fmt: skip

    def _pose(
        self, pose: Rigid3, covariance: FloatArray, camera: Camera, body_from_camera: Rigid3 | None,
        ground_m: float | None,
    ) -> Pose:  # fmt: skip
        east, north, height = pose.translation.tolist()
        heading_deg = None
        if body_from_camera is not None:
            nose = (pose.rotation @ body_from_camera.rotation.T)[:, 0]
            heading_deg = round(math.degrees(math.atan2(nose[0], nose[1])) % 360.0, 1)
        rim: list[Point] = []
        if ground_m is not None and height > ground_m:
            rim = self._points(outline(camera, pose, ground_m))
        return Pose(
            at=(round(east - self.origin[0], 2), round(north - self.origin[1], 2), round(height, 2)),
            cov=(_short(covariance[0, 0]), _short(covariance[0, 1]), _short(covariance[1, 1])),
            sigma_h=_short(math.sqrt(max(0.0, covariance[2, 2]))),
            heading_deg=heading_deg,
            rim=rim,
        )

    def _point(self, position_map: FloatArray | None) -> Point | None:
        if position_map is None or not np.isfinite(position_map[:2]).all():
            return None
        return self._points(position_map[None, :2])[0]

    def _points(self, xy_map: FloatArray) -> list[Point]:
        return [(round(e, 2), round(n, 2)) for e, n in (xy_map - self.origin).tolist()]

    def inliers(self, fix: Fix, scale: float) -> list[tuple[float, float, float, float, float, float]]:
        """Of a fix, at most 150: where each was seen in a picture resized by ``scale`` (u, v), where the pose puts it
        there (u, v), and where it is on the map (east, north)."""
        every = max(1, math.ceil(len(fix.query_px) / _MOST_POINTS))
        seen, points = fix.query_px[::every], fix.points_map[::every]
        if not len(seen):
            return []
        put = fix.camera.project(fix.map_from_camera.inverse().apply(points))
        picture = (np.hstack([seen, put]) + 0.5) * scale
        rows = np.hstack([picture.round(1), (points[:, :2] - self.origin).round(2)])
        return [tuple(row) for row in rows[np.isfinite(rows).all(axis=1)].tolist()]


def ground_of(fix: Fix) -> float | None:
    """The typical height of what a fix was matched with."""
    return float(np.median(fix.points_map[:, 2])) if len(fix.points_map) else None


def _short(value: float) -> float:
    return float(f"{value:.3g}")
