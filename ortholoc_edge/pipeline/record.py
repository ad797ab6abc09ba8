"""Outcomes and steps as plain values, for JSON: in results, in the log and on the bus alike."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from msgspec import Struct

from ortholoc_edge.geometry import rotation
from ortholoc_edge.geometry.arrays import FloatArray
from ortholoc_edge.geometry.camera import Camera
from ortholoc_edge.geometry.rigid import Rigid3
from ortholoc_edge.pipeline.frame import CameraMount, VehicleState
from ortholoc_edge.pipeline.navigator import Circumstances, Tuning
from ortholoc_edge.pipeline.outcome import Fix, Outcome, Reason, Rejected
from ortholoc_edge.pipeline.prior import PosePrior
from ortholoc_edge.pipeline.tracker import Order


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


def outcome_of(record: Mapping[str, Any], camera: Camera) -> Outcome:
    """The outcome of an `outcome_record`, but for the inliers themselves, which it has not.

    Args:
        camera: of the flight; a calibrated focal length is taken from the record.
    """
    if not record["fix"]:
        return Rejected(
            record["stamp_ns"], Reason(record["reason"]), record["detail"], record["measured"], record["limit"],
            record["timings_ms"],
        )  # fmt: skip
    turn = rotation.from_quaternion(record["quaternion_map_from_camera_wxyz"])
    scale = record["focal_px"] / camera.focal_px
    return Fix(
        stamp_ns=record["stamp_ns"],
        map_from_camera=Rigid3(turn, _floats(record["position_map_m"])),
        camera=replace(camera, fx=camera.fx * scale, fy=camera.fy * scale),
        covariance=_floats(record["covariance"]),
        quality=record["quality"],
        matches=record["matches"],
        inliers=record["inliers"],
        rms_px=record["rms_px"],
        adhop_accepted=record["adhop_accepted"],
        query_px=np.empty((0, 2)),
        points_map=np.empty((0, 3)),
        focal_sigma_px=record["focal_sigma_px"],
        timings_ms=record["timings_ms"],
        stored_features=record["stored_features"],
    )


class FrameRecord(Struct, frozen=True, kw_only=True):
    """A step as it was taken: all that it depended on but the picture, and what it came to.

    Frames and units are those of `VehicleState`, `PosePrior` and `Circumstances`; null stands for a number that was
    not finite.

    Attributes:
        number, repeats: as of `Circumstances`.
        exposure_ns: as of `Frame`.
        whole: whether the picture beside it is without loss.
        mount: the gimbal's ``body_from_camera`` as (3, 4) and its sigmas; None of a fixed one.
        outcome: `outcome_record`, before its age was looked at.
        orders, tuning: `Circumstances.orders` and ``tuning``; logs of older versions have none, nor have they
            velocity, turning, exposure, repeats and ``turns_before``.
    """

    number: int
    name: str
    stamp_ns: int
    whole: bool
    ned_from_body: list[list[float | None]] | None
    attitude_sigma_rad: list[float | None]
    odometry_ned_m: list[float | None] | None
    odometry_epoch: int
    position_map_m: list[float | None] | None
    position_sigma_m: list[float | None]
    mount: tuple[list[list[float]], list[float]] | None
    no_attitude_because: str
    believed_map_m: list[float | None] | None
    prior_map_from_camera: list[list[float]] | None
    prior_covariance: list[list[float]] | None
    rung: int
    proceeded: int
    reset_counter: int
    outcome: dict[str, Any]
    orders: tuple[Order, ...] = ()
    tuning: Tuning | None = None
    velocity_ned_m_s: list[float | None] | None = None
    turning_rad_s: list[float | None] | None = None
    exposure_ns: int | None = None
    repeats: int = 0
    turns_before: list[list[float]] | None = None

    def state(self) -> VehicleState:
        return VehicleState(
            self.stamp_ns,
            None if self.ned_from_body is None else _floats(self.ned_from_body),
            tuple(_floats(self.attitude_sigma_rad).tolist()),
            None if self.odometry_ned_m is None else _floats(self.odometry_ned_m),
            self.odometry_epoch,
            None if self.position_map_m is None else _floats(self.position_map_m),
            tuple(_floats(self.position_sigma_m).tolist()),
            None if self.mount is None else CameraMount(_rigid(self.mount[0]), (self.mount[1][0], self.mount[1][1])),
            self.no_attitude_because,
            None if self.believed_map_m is None else _floats(self.believed_map_m),
            None if self.velocity_ned_m_s is None else _floats(self.velocity_ned_m_s),
            None if self.turning_rad_s is None else _floats(self.turning_rad_s),
            None if self.turns_before is None else _floats(self.turns_before),
        )

    def circumstances(self) -> Circumstances:
        prior = None
        if self.prior_map_from_camera is not None and self.prior_covariance is not None:
            prior = PosePrior(_rigid(self.prior_map_from_camera), _floats(self.prior_covariance))
        return Circumstances(
            self.number, prior, self.rung, self.proceeded, self.reset_counter, self.orders, self.tuning, self.repeats
        )


def frame_record(
    name: str,
    exposure_ns: int | None,
    whole: bool,
    outcome: Outcome,
    state: VehicleState,
    circumstances: Circumstances,
) -> FrameRecord:
    """What `Navigator.step_again` needs. ``name`` and ``exposure_ns`` are the frame's."""
    prior, mount = circumstances.prior, state.mount
    return FrameRecord(
        number=circumstances.number,
        name=name,
        stamp_ns=state.stamp_ns,
        whole=whole,
        ned_from_body=None if state.ned_from_body is None else state.ned_from_body.tolist(),
        attitude_sigma_rad=list(state.attitude_sigma_rad),
        odometry_ned_m=None if state.odometry_ned_m is None else state.odometry_ned_m.tolist(),
        odometry_epoch=state.odometry_epoch,
        position_map_m=None if state.position_map_m is None else state.position_map_m.tolist(),
        position_sigma_m=list(state.position_sigma_m),
        mount=None if mount is None else (_matrix(mount.body_from_camera), list(mount.sigma_rad)),
        no_attitude_because=state.no_attitude_because,
        believed_map_m=None if state.believed_map_m is None else state.believed_map_m.tolist(),
        prior_map_from_camera=None if prior is None else _matrix(prior.map_from_camera),
        prior_covariance=None if prior is None else prior.covariance.tolist(),
        rung=circumstances.rung,
        proceeded=circumstances.proceeded,
        reset_counter=circumstances.reset_counter,
        outcome=outcome_record(outcome),
        orders=circumstances.orders,
        tuning=circumstances.tuning,
        velocity_ned_m_s=None if state.velocity_ned_m_s is None else state.velocity_ned_m_s.tolist(),
        turning_rad_s=None if state.turning_rad_s is None else state.turning_rad_s.tolist(),
        exposure_ns=exposure_ns,
        repeats=circumstances.repeats,
        turns_before=None if state.turns_before is None else state.turns_before.tolist(),
    )


def _matrix(pose: Rigid3) -> list[list[float]]:
    return [[*row, shift] for row, shift in zip(pose.rotation.tolist(), pose.translation.tolist(), strict=True)]


def _rigid(rows: list[list[float]]) -> Rigid3:
    matrix = np.array(rows, dtype=np.float64)
    return Rigid3(matrix[:, :3], matrix[:, 3])


def _floats(values: Any) -> FloatArray:
    """Null becomes NaN."""
    return np.array(values, dtype=np.float64)
