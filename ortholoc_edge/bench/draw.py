"""Pictures of results: keypoints reprojected on a frame, and a track over the orthophoto."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from ortholoc_edge.errors import OrtholocError
from ortholoc_edge.geometry.arrays import FloatArray, ImageArray
from ortholoc_edge.geometry.camera import Camera
from ortholoc_edge.geometry.grid import RasterGrid
from ortholoc_edge.geometry.rigid import Rigid3
from ortholoc_edge.pipeline.outcome import Fix, Outcome
from ortholoc_edge.tiles.store import MapStore

Colour = tuple[int, int, int]

# RGB. The paper's figures: truth green, estimate red, blue between them.
TRUTH: Colour = (40, 220, 60)
ESTIMATE: Colour = (255, 50, 50)
DIFFERENCE: Colour = (60, 160, 255)
PRIOR: Colour = (255, 200, 40)
_INK: Colour = (255, 255, 255)
_PAPER: Colour = (20, 20, 20)
_MAX_POINTS = 400
_FONT = cv2.FONT_HERSHEY_SIMPLEX
_MAX_TRACK_PX = 1600


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """Positions to draw.

    Attributes:
        label: for the legend.
        xy_map: (N, 2) easting, northing.
        joined: a line through them; else a dot at each.
    """

    label: str
    xy_map: FloatArray
    colour: Colour
    joined: bool = True


def overlay(image: ImageArray, outcome: Outcome, truth: Rigid3 | None, camera: Camera, caption: str) -> ImageArray:
    """The frame with the inliers' 3D points projected by the estimate and, where it is known, by the truth.

    Args:
        image: (H, W, 3) RGB or (H, W) grey.
        camera: the true intrinsics; the estimate brings its own.
    """
    canvas = np.ascontiguousarray(
        image if image.ndim == 3 else cv2.cvtColor(image, cv2.COLOR_GRAY2RGB), dtype=np.uint8
    ).copy()
    if isinstance(outcome, Fix):
        every = max(1, len(outcome.points_map) // _MAX_POINTS)
        points = outcome.points_map[::every]
        estimated = outcome.camera.project(outcome.map_from_camera.inverse().apply(points))
        if truth is not None:
            true = camera.project(truth.inverse().apply(points))
            for a, b in zip(true, estimated, strict=True):
                if np.isfinite([a, b]).all():
                    cv2.line(canvas, at(a), at(b), DIFFERENCE, 1, cv2.LINE_AA)
            _dots(canvas, true, TRUTH, 3)
        _dots(canvas, estimated, ESTIMATE, 2)
    return captioned(canvas, caption)


def track(store: MapStore, tracks: Sequence[Track], caption: str) -> ImageArray:
    """Tracks over the part of the orthophoto around them, with a scale bar, north arrow and legend."""
    everything = np.concatenate([t.xy_map for t in tracks if len(t.xy_map)] or [np.empty((0, 2))])
    west, south, east, north = store.bounds
    if len(everything):
        margin = 0.15 * float(np.ptp(everything, axis=0).max()) + 20.0
        low, high = everything.min(axis=0) - margin, everything.max(axis=0) + margin
        west, south = max(west, float(low[0])), max(south, float(low[1]))
        east, north = min(east, float(high[0])), min(north, float(high[1]))
    if not (east > west and north > south):
        raise OrtholocError("the track does not lie on the pack; nothing to draw")
    gsd_m = max(east - west, north - south) / _MAX_TRACK_PX
    window = store.read_colour((west, south, east, north), gsd_m)
    if window is None:
        raise OrtholocError("the track does not lie on the pack; nothing to draw")
    scale = min(1.0, _MAX_TRACK_PX / max(window.rgb.shape[:2]))
    size = (round(window.grid.width * scale), round(window.grid.height * scale))
    canvas = np.asarray(cv2.resize(window.rgb, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    grid = window.grid.resized(*size)
    for one in tracks:
        px = grid.px_from_map(one.xy_map)
        if one.joined and len(px) > 1:
            cv2.polylines(canvas, [np.round(px).astype(np.int32)], False, _PAPER, 4, cv2.LINE_AA)
            cv2.polylines(canvas, [np.round(px).astype(np.int32)], False, one.colour, 2, cv2.LINE_AA)
        if not one.joined:
            _dots(canvas, px, one.colour, 4)
    georeference = store.pack.georeference
    _furniture(canvas, grid, georeference.convergence_rad(georeference.anchor), tracks)
    return captioned(canvas, caption)


def write_png(path: Path, image: ImageArray) -> None:
    """Write RGB as PNG. Raises: OrtholocError if it can't be written."""
    encoded, data = cv2.imencode(".png", cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
    try:
        if not encoded:
            raise OSError("encoding failed")
        path.write_bytes(data.tobytes())
    except OSError as err:
        raise OrtholocError(f"{path}: can't write the picture ({err})") from err


def at(px: FloatArray) -> tuple[int, int]:
    """A pixel as OpenCV draws there."""
    # Far off the picture, coordinates would overflow OpenCV's integers.
    u, v = np.clip(px, -20_000, 20_000)
    return round(float(u)), round(float(v))


def _dots(canvas: ImageArray, px: FloatArray, colour: Colour, radius: int) -> None:
    for point in px[np.isfinite(px).all(axis=1)]:
        cv2.circle(canvas, at(point), radius + 1, _PAPER, -1, cv2.LINE_AA)
        cv2.circle(canvas, at(point), radius, colour, -1, cv2.LINE_AA)


def captioned(canvas: ImageArray, caption: str) -> ImageArray:
    """A picture with a line of text above it."""
    scale = max(canvas.shape[1] / 1600, 0.45)
    strip = np.full((round(40 * scale), canvas.shape[1], 3), _PAPER, dtype=np.uint8)
    # OpenCV's fonts know ASCII only.
    text = caption.encode("ascii", "replace").decode()
    cv2.putText(strip, text, (10, round(27 * scale)), _FONT, 0.75 * scale, _INK, 1, cv2.LINE_AA)
    return np.vstack([strip, canvas])


def _furniture(canvas: ImageArray, grid: RasterGrid, convergence_rad: float, tracks: Sequence[Track]) -> None:
    """Scale bar, arrow to true north (up is grid north) and legend."""
    height, width = canvas.shape[:2]
    bar_m = _round_length(0.2 * width * grid.dx)
    bar_px = round(bar_m / grid.dx)
    cv2.rectangle(canvas, (15, height - 45), (bar_px + 35, height - 8), _PAPER, -1)
    cv2.line(canvas, (25, height - 18), (25 + bar_px, height - 18), _INK, 3)
    cv2.putText(canvas, f"{bar_m:g} m", (25, height - 26), _FONT, 0.5, _INK, 1, cv2.LINE_AA)
    foot = np.array([width - 40.0, 74.0])
    tip = foot + 48.0 * np.array([-math.sin(convergence_rad), -math.cos(convergence_rad)])
    cv2.rectangle(canvas, (width - 62, 14), (width - 18, 98), _PAPER, -1)
    cv2.arrowedLine(canvas, at(foot), at(tip), _INK, 3, cv2.LINE_AA, tipLength=0.35)
    cv2.putText(canvas, "N", (width - 46, 92), _FONT, 0.6, _INK, 1, cv2.LINE_AA)
    widest = max((len(t.label) for t in tracks), default=0)
    cv2.rectangle(canvas, (10, 10), (50 + 10 * widest, 18 + 22 * len(tracks)), _PAPER, -1)
    for row, one in enumerate(tracks):
        y = 28 + 22 * row
        if one.joined:
            cv2.line(canvas, (18, y - 4), (38, y - 4), one.colour, 3)
        else:
            cv2.circle(canvas, (28, y - 4), 4, one.colour, -1, cv2.LINE_AA)
        cv2.putText(canvas, one.label, (46, y), _FONT, 0.5, _INK, 1, cv2.LINE_AA)


def _round_length(metres: float) -> float:
    """The largest 1, 2 or 5 times a power of ten that is not longer."""
    power = 10.0 ** math.floor(math.log10(max(metres, 1e-6)))
    # Rounding can put the power just above the length.
    return max((step * power for step in (1.0, 2.0, 5.0) if step * power <= metres), default=power)
