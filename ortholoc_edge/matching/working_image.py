"""An image brought to a matcher's working size, with what is invalid in it made harmless."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
import numpy.typing as npt

from ortholoc_edge.geometry.arrays import BoolArray, Float32Array, FloatArray, ImageArray, IntArray
from ortholoc_edge.geometry.grid import resize_px

# No detector finds anything of use in less, and rounding would distort it beyond recognition.
MIN_SIDE_PX: Final = 16
# Standard deviation, in grey levels of 0..255, below which an image counts as constant: rounding a flat
# area to whole levels alone leaves 0.29 (a uniform error's 1 / sqrt(12)).
MIN_CONTRAST: Final = 0.5
# Distance that keypoints keep from invalid pixels, in pixels at working size: one cell of XFeat's
# descriptor map. The receptive field is wider, but the fill is the mean grey, and a wider margin would
# empty maps with scattered holes.
INVALID_MARGIN_PX: Final = 8
# Long side that no matcher is reduced below: the smallest that can be configured.
LEAST_REDUCED_PX: Final = 128


@dataclass(frozen=True, slots=True, eq=False)
class WorkingImage:
    """What a detector gets to see.

    Attributes:
        image: (h, w) uint8; where the original was invalid it has the mean of the rest.
        usable: (h, w), True where keypoints may be; None: everywhere.
        scale: original pixels per working pixel, (u, v). They differ where sides were rounded.
    """

    image: ImageArray
    usable: BoolArray | None
    scale: tuple[float, float]

    def original_px(self, px: npt.ArrayLike) -> FloatArray:
        """Working pixels (N, 2) in the pixels of the original image."""
        return resize_px(px, self.scale)

    def holds(self, px: npt.ArrayLike) -> BoolArray:
        """Which working pixels (N, 2) lie inside the picture and where it has data."""
        points = np.asarray(px, dtype=np.float64)
        rows, columns = self.image.shape
        inside = np.asarray(
            ((points >= -0.5) & (points <= [columns - 0.5, rows - 0.5])).all(axis=1), dtype=np.bool_
        )
        if self.usable is not None:
            nearest = np.rint(np.where(inside[:, None], points, 0.0)).astype(np.intp)
            u, v = np.clip(nearest.T, 0, [[columns - 1], [rows - 1]])
            inside &= self.usable[v, u]
        return inside

    def strongest(self, px: FloatArray, scores: Float32Array, most: int) -> IntArray:
        """Which of some keypoints (N, 2), with scores (N,), to keep: the best ``most`` usable ones, best first."""
        order = np.argsort(-scores, kind="stable")
        if self.usable is not None:
            rows, columns = self.usable.shape
            u, v = np.clip(np.rint(px).astype(np.intp).T, 0, [[columns - 1], [rows - 1]])
            order = order[self.usable[v, u][order]]
        return order[:most]


def shrunk_image(image: ImageArray, valid: BoolArray | None, working_px: int) -> WorkingImage | None:
    """`working_image` with a long side of ``working_px``; a smaller image stays as it is."""
    rows, columns = image.shape[:2]
    shrink = min(1.0, working_px / max(rows, columns, 1))
    return working_image(image, valid, max(1, round(columns * shrink)), max(1, round(rows * shrink)))


def check_numbers(
    what: str, multiple_px: int, least_px: int, working_px: int, max_keypoints: int, threads: int
) -> None:
    """What every extractor with a network is made with. Raises: ValueError naming the numbers and their limits."""
    if working_px < least_px or working_px % multiple_px or max_keypoints < 1 or threads < 1:
        raise ValueError(
            f"{what}: working_px {working_px} must be a multiple of {multiple_px} from {least_px} on, "
            f"max_keypoints {max_keypoints} and threads {threads} at least 1"
        )


def reduced_size(working_px: int, max_keypoints: int, scale: float, multiple_px: int = 1) -> tuple[int, int]:
    """Both at a part of the resolution; the long side a multiple of ``multiple_px``, not below `LEAST_REDUCED_PX`."""
    px = max(min(working_px, LEAST_REDUCED_PX), round(working_px * scale / multiple_px) * multiple_px)
    return px, max(1, round(max_keypoints * scale**2))


def working_image(image: ImageArray, valid: BoolArray | None, width: int, height: int) -> WorkingImage | None:
    """``image`` (H, W) uint8 in ``width`` x ``height`` pixels; None where there is nothing to find in it.

    Holes are filled before anything is resampled: black ones would make corners along their rims and bleed
    into valid pixels when averaged.
    Args:
        valid: (H, W), False where the image holds no data; None: all valid.
    Raises: ValueError if image or mask have another type or shape.
    """
    if image.ndim != 2 or image.dtype != np.uint8:
        raise ValueError(f"matcher image: {image.dtype} of shape {image.shape}, expected uint8 (H, W)")
    if valid is not None and (valid.shape != image.shape or valid.dtype != np.bool_):
        raise ValueError(f"valid mask: {valid.dtype} of shape {valid.shape}, expected bool {image.shape}")
    if min(image.shape) < MIN_SIDE_PX:
        return None
    if valid is not None and valid.all():
        valid = None
    rows, columns = image.shape
    if valid is not None:
        if not valid.any():
            return None
        image = np.where(valid, image, np.uint8(round(float(image[valid].mean()))))
    resized = _resized(image, width, height)
    usable = None
    if valid is not None:
        # A working pixel counts as valid if all that was averaged into it is.
        whole = (_resized(valid.astype(np.uint8) * np.uint8(255), width, height) == 255).astype(np.uint8)
        margin = np.ones((2 * INVALID_MARGIN_PX + 1,) * 2, np.uint8)
        usable = cv2.erode(whole, margin).astype(np.bool_)
    seen = resized if usable is None else resized[usable]
    if seen.size == 0 or float(seen.std(dtype=np.float64)) < MIN_CONTRAST:
        return None
    return WorkingImage(resized, usable, (columns / width, rows / height))


def _resized(image: ImageArray, width: int, height: int) -> ImageArray:
    rows, columns = image.shape
    if (columns, rows) == (width, height):
        return image
    # INTER_AREA averages only when it shrinks; enlarging, it is a blocky relative of linear.
    shrinks = width <= columns and height <= rows
    resized: ImageArray = cv2.resize(  # type: ignore[assignment]
        image, (width, height), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
    )
    return resized
