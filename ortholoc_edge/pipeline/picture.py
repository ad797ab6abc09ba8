"""What is wrong with a frame before anything is matched: dark, the same as before, smeared. No fix is better than one
from an old picture under a new stamp."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import cv2
import numpy as np
from msgspec import Meta, Struct

from ortholoc_edge.geometry.arrays import FloatArray, ImageArray
from ortholoc_edge.geometry.camera import Camera
from ortholoc_edge.pipeline.frame import CameraMount, Frame, VehicleState
from ortholoc_edge.pipeline.outcome import Reason, Rejected

# Of these rows brightness and sameness are told: an eighth of the work, and no sensor repeats them by chance.
_EVERY_ROW = 8
# Over the picture, where its motion is predicted.
_GRID = 3


class PictureOptions(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What a frame must be to be matched.

    ``min_brightness``: mean grey value, of 255.
    ``max_blur_px``: predicted smear of the frame at the size at which it is matched, where the exposure is known: by
    the vehicle's velocity and turning. Of 34 real photos smeared by 6 px at 640 px structural matching placed all, and
    as well as before; by 9 all, with twice the error; by 12, 18 and 24 px 30, 22 and 16, with three to five times it.
    ``refuse_repeated``: refuse a frame whose picture is bit for bit that of the one before. A sensor's noise never
    gives that, so it is an old picture under a new stamp. Not of a folder or a video, which may hold it twice.
    ``frozen_after``: so many of them in a row are called a frozen camera.
    """

    min_brightness: Annotated[float, Meta(ge=0, le=255)] = 12.0
    max_blur_px: Annotated[float, Meta(gt=0, le=1000)] = 12.0
    refuse_repeated: bool = True
    frozen_after: Annotated[int, Meta(ge=1)] = 5


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """What there is to tell of a picture alone.

    Attributes:
        rows: (N, W) of `grey_rows`.
        repeats: how many frames just before showed the same.
    """

    rows: ImageArray | None
    repeats: int


class Watch:
    """Sees one frame after another; used by one thread."""

    def __init__(self) -> None:
        self._last = Seen(None, 0)

    def see(self, image: ImageArray) -> Seen:
        """The next frame's picture."""
        rows, before = grey_rows(image), self._last.rows
        same = rows is not None and before is not None and np.array_equal(rows, before)
        self._last = Seen(rows, self._last.repeats + 1 if same else 0)
        return self._last


def grey_rows(image: ImageArray) -> ImageArray | None:
    """Every eighth row (N, W) in grey, as the localizer would have it; None of what is no picture."""
    if image.dtype != np.uint8 or not image.size or image.ndim not in (2, 3):
        return None
    rows = np.ascontiguousarray(image[::_EVERY_ROW])
    if rows.ndim == 2:
        return rows
    return None if rows.shape[2] != 3 else np.asarray(cv2.cvtColor(rows, cv2.COLOR_RGB2GRAY), dtype=np.uint8)


def unfit(frame: Frame, seen: Seen, smear_px: float | None, options: PictureOptions) -> Rejected | None:
    """Why a frame is not to be matched, if it is not.

    Args:
        smear_px: predicted; None where it can't be.
    """
    # First: under a lens cap pictures are alike, and nothing is wrong with the camera.
    if seen.rows is not None:
        brightness = float(cv2.mean(seen.rows)[0])
        if brightness < options.min_brightness:
            return Rejected(
                frame.stamp_ns, Reason.DARK, "mean grey value, of 255", brightness, options.min_brightness
            )
    if options.refuse_repeated and seen.repeats >= options.frozen_after:
        return Rejected(
            frame.stamp_ns, Reason.FROZEN, "frames with one and the same picture; unplug the camera and plug it in",
            seen.repeats + 1, options.frozen_after,
        )  # fmt: skip
    if options.refuse_repeated and seen.repeats:
        return Rejected(
            frame.stamp_ns, Reason.REPEATED, "the very picture of the frame before, so the stamp is not its own"
        )
    if smear_px is not None and smear_px > options.max_blur_px:
        assert frame.exposure_ns is not None
        return Rejected(
            frame.stamp_ns, Reason.MOTION_BLUR,
            f"predicted smear in {frame.exposure_ns / 1e6:g} ms, px at the size of matching; expose for a shorter time",
            smear_px, options.max_blur_px,
        )  # fmt: skip
    return None


def motion_px_s(camera: Camera, height_m: float, state: VehicleState, mount: CameraMount) -> float | None:
    """How fast level ground moves through the picture: the median over the picture, px per second.

    Args:
        camera: whose pixels are meant.
        height_m: of the camera above the ground.
        state: its attitude, velocity and turning; None comes of a state that lacks one of them.
    """
    if state.ned_from_body is None or state.velocity_ned_m_s is None or state.turning_rad_s is None:
        return None
    if not (np.isfinite(state.velocity_ned_m_s).all() and np.isfinite(state.turning_rad_s).all() and height_m > 0):
        return None
    camera_from_body = mount.body_from_camera.rotation.T
    camera_from_ned = camera_from_body @ state.ned_from_body.T
    velocity, down = camera_from_ned @ state.velocity_ned_m_s, camera_from_ned[:, 2]
    # A gimbal holds still while the body turns.
    turning = camera_from_body @ state.turning_rad_s if state.mount is None else np.zeros(3)
    return _median_motion_px_s(camera, height_m, velocity, turning, down)


def _median_motion_px_s(
    camera: Camera, height_m: float, velocity: FloatArray, turning: FloatArray, down: FloatArray
) -> float | None:
    """Of vectors (3,) in camera axes."""
    at = np.linspace(1.0, 2.0 * _GRID - 1.0, _GRID) / (2.0 * _GRID)
    px = np.stack(np.meshgrid(at * camera.width, at * camera.height), axis=-1).reshape(-1, 2)
    rays = camera.unproject(px)
    rays = rays[np.isfinite(rays).all(axis=1)]
    # One over the depth; zero for the sky, which a turn moves all the same.
    inverse_depth = np.maximum(rays @ down, 0.0) / height_m
    # A point P of the ground moves by -v - w x P; the depth is P's third coordinate.
    moving = -velocity * inverse_depth[:, None] - np.cross(turning, rays)
    flow = (moving[:, :2] - rays[:, :2] * moving[:, 2:]) * (camera.fx, camera.fy)
    return float(np.median(np.linalg.norm(flow, axis=1))) if len(flow) else None
