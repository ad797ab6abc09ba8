"""The frame brought onto the map's grid, north up, to be matched with features of the map that look this way."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from ortholoc_edge.geometry import homography
from ortholoc_edge.geometry.arrays import BoolArray, FloatArray, ImageArray
from ortholoc_edge.geometry.camera import Camera
from ortholoc_edge.geometry.grid import resize_px

# Lengths in the frame over lengths on the grid, as a part of what they are in the middle of the picture. Ground that
# is seen flatter than this is stretched until it no longer looks like the map.
_MIN_DENSITY = 0.4
_OUTLINE_SAMPLES = 17
# The mapping is computed for every eighth pixel and is linear between: 0.02 px off at 45 degrees of tilt.
_MAP_STEP = 8
_NOWHERE_PX = -1e4


@dataclass(frozen=True, slots=True, eq=False)
class RectifiedFrame:
    """A frame on a canvas of the map's grid.

    Attributes:
        image, valid: (H, W) uint8 grey, and where it shows the frame.
        frame_from_canvas: (3, 3) homography to the pixels of the camera without distortion.
    """

    image: ImageArray
    valid: BoolArray
    frame_from_canvas: FloatArray


def rectified(grey: ImageArray, camera: Camera, frame_from_grid: FloatArray, max_pixels: int) -> RectifiedFrame | None:
    """A frame through the inverse of a homography, without its lens distortion.

    Args:
        grey: (H, W) as the camera gives it.
        frame_from_grid: (3, 3) from the map's grid to undistorted pixels, its third coordinate positive for what lies
            in front.
    Returns: None if the canvas would have more than ``max_pixels``, or the camera does not look at the ground.
    """
    grid_from_frame = np.linalg.inv(frame_from_grid)
    u = np.linspace(-0.5, camera.width - 0.5, _OUTLINE_SAMPLES)
    v = np.linspace(-0.5, camera.height - 0.5, _OUTLINE_SAMPLES)
    px = camera.undistorted_px(np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2))
    px = px[np.isfinite(px).all(axis=1)]
    # The third coordinate w of the inverse is 1 / w of the homography, and an area grows by |det| / w^3.
    weight = np.column_stack([px, np.ones(len(px))]) @ grid_from_frame[2]
    middle = float(grid_from_frame[2] @ (camera.cx, camera.cy, 1.0))
    if middle <= 0:
        return None
    least = middle * _MIN_DENSITY ** (2.0 / 3.0)
    outline = homography.warp_points(grid_from_frame, px[weight >= least])
    low = np.floor(outline.min(axis=0))
    width, height = (int(side) for side in np.ceil(outline.max(axis=0)) - low + 1)
    if width * height > max_pixels:
        return None
    frame_from_canvas = frame_from_grid @ np.array([[1.0, 0.0, low[0]], [0.0, 1.0, low[1]], [0.0, 0.0, 1.0]])
    # Averaged first, so that no frame pixel is skipped.
    shrink = 1.0 / np.sqrt(abs(np.linalg.det(frame_from_grid)) * middle**3)
    if shrink < 1.0:
        size = max(1, round(camera.width * shrink)), max(1, round(camera.height * shrink))
        grey = np.asarray(cv2.resize(grey, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    rows, columns = grey.shape
    x, y = _source_px(camera, frame_from_canvas, 1.0 / least, (width, height), (columns, rows))
    image = cv2.remap(grey, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
    valid = (x >= 0) & (x <= columns - 1) & (y >= 0) & (y <= rows - 1)
    return RectifiedFrame(np.asarray(image, dtype=np.uint8), np.asarray(valid), frame_from_canvas)


def _source_px(
    camera: Camera, frame_from_canvas: FloatArray, max_weight: float, canvas: tuple[int, int], source: tuple[int, int]
) -> list[np.ndarray]:
    """Columns and rows of the source, each (H, W) float32, that the canvas' pixels come from.

    Args:
        max_weight: of the third coordinate; what lies beyond comes from nowhere.
        canvas, source: (width, height); the source is the camera's picture, resized.
    """
    columns, rows = (side // _MAP_STEP + 3 for side in canvas)
    # Centres of the cells that OpenCV's linear resizing takes coarse pixels for, and one cell more on each side.
    offset = -0.5 * _MAP_STEP - 0.5
    x, y = np.meshgrid(offset + _MAP_STEP * np.arange(columns), offset + _MAP_STEP * np.arange(rows))
    a, b, weight = frame_from_canvas @ np.stack([x.ravel(), y.ravel(), np.ones(x.size)])
    ahead = (weight > 0) & (weight <= max_weight)
    px = np.stack([a, b], axis=1) / np.where(ahead, weight, 1.0)[:, None]
    if not camera.is_pinhole:
        px = camera.project(camera.pinhole().unproject(px))
    px = resize_px(px, (source[0] / camera.width, source[1] / camera.height))
    px[~ahead] = _NOWHERE_PX
    width, height = canvas
    inner = slice(_MAP_STEP, _MAP_STEP + height), slice(_MAP_STEP, _MAP_STEP + width)
    size = columns * _MAP_STEP, rows * _MAP_STEP
    return [
        np.ascontiguousarray(
            cv2.resize(px[:, axis].reshape(rows, columns).astype(np.float32), size, interpolation=cv2.INTER_LINEAR)[
                inner
            ]
        )
        for axis in range(2)
    ]
