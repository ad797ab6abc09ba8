"""A camera frame and what the vehicle knew of itself when it was exposed."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from ortholoc_edge.geometry.arrays import FloatArray, ImageArray
from ortholoc_edge.geometry.rigid import Rigid3

# Of `VehicleState.turns_before`: as far back as stamps of cameras are late, and as finely as attitudes come.
TURN_AGES_NS = tuple(20_000_000 * step for step in range(1, 13))


def grey_of(image: ImageArray) -> ImageArray:
    """(H, W) uint8 of a picture (H, W) or (H, W, 3) RGB, uint8."""
    return image if image.ndim == 2 else np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), dtype=np.uint8)


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """One picture.

    Attributes:
        stamp_ns: middle of the exposure, monotonic clock.
        image: (H, W) grey or (H, W, 3) RGB, uint8.
        name: file name or running number, for logs and results.
        exposure_ns: how long each row was exposed; None where that is not known.
    """

    stamp_ns: int
    image: ImageArray
    name: str
    exposure_ns: int | None = None


@dataclass(frozen=True, slots=True, eq=False)
class CameraMount:
    """How the camera sat on the body at an exposure.

    Attributes:
        body_from_camera: with the lever arm.
        sigma_rad: 1-sigma of its rotation beyond what `VehicleState.attitude_sigma_rad` has: tilt, about any level
            axis, and heading. Zero for a fixed mount.
    """

    body_from_camera: Rigid3
    sigma_rad: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True, slots=True, eq=False)
class VehicleState:
    """The autopilot's view of the vehicle at ``stamp_ns`` (in replay: a simulated autopilot's).

    Attributes:
        stamp_ns: monotonic clock; the exposure the values were interpolated to.
        ned_from_body: (3, 3), true north; None where the autopilot sent no usable attitude.
        attitude_sigma_rad: 1-sigma of roll, pitch, yaw.
        odometry_ned_m: (3,) dead-reckoned position, m, true north, from an origin of its own; only differences
            within one ``odometry_epoch`` mean anything. None without odometry.
        odometry_epoch: rises when the odometry jumped or was restarted.
        position_map_m: (3,) easting, northing, height from an absolute source that is trusted now (GNSS before
            it was lost); None otherwise.
        position_sigma_m: 1-sigma of that position, horizontal (per axis) and vertical.
        believed_map_m: (3,) where the autopilot believes to be, whatever that comes from. It holds our own fixes, so it
            confirms nothing; but where nothing else says where to look, it does. None where it has no idea.
        velocity_ned_m_s: (3,), true north; None where that is not known.
        turning_rad_s: (3,) angular velocity of the body about its own axes; None where that is not known.
        no_attitude_because: in words, where that is known; empty otherwise.
        turns_before: (K, 3) how the body was turned `TURN_AGES_NS` before the stamp, against ``ned_from_body``:
            rotation vectors about its axes at the stamp, rad. None where that is not known. `calibrate-flight` tells a
            late stamp by it.
        mount: of a camera in a gimbal, as it was at the stamp; None of a fixed one, which the tracker knows, and
            where nothing is known of the gimbal.
    """

    stamp_ns: int
    ned_from_body: FloatArray | None
    attitude_sigma_rad: tuple[float, float, float]
    odometry_ned_m: FloatArray | None = None
    odometry_epoch: int = 0
    position_map_m: FloatArray | None = None
    position_sigma_m: tuple[float, float] = (0.0, 0.0)
    mount: CameraMount | None = None
    no_attitude_because: str = ""
    believed_map_m: FloatArray | None = None
    velocity_ned_m_s: FloatArray | None = None
    turning_rad_s: FloatArray | None = None
    turns_before: FloatArray | None = None
