"""A calibration to look at: where the board was seen, and what is left of the errors."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from ortholoc_edge.calibration.lens import LensCalibration, View
from ortholoc_edge.geometry.arrays import FloatArray, ImageArray

# BGR, as OpenCV writes.
_INK, _FAINT, _PAPER = (40, 40, 40), (205, 205, 205), (255, 255, 255)
_GOOD, _BAD, _MARK = (150, 120, 30), (60, 60, 220), (200, 110, 30)
_FONT = cv2.FONT_HERSHEY_SIMPLEX
_WIDE, _SIDE, _MARGIN = 900, 460, 46
# Pixels of the drawing per pixel of residual: so that the usual one is seen.
_USUAL_LONG = 14.0
_RINGS = 12


def draw(found: LensCalibration | Sequence[View], size: tuple[int, int]) -> ImageArray:
    """BGR: on the left the picture with all corners and their residuals, enlarged; on the right the residuals along the
    radius, which a lens that is not the model's bends, and the views' errors.

    Of views that are no calibration, only where the corners are.
    """
    scale = _WIDE / size[0]
    tall = round(size[1] * scale)
    high = max(tall + 2 * _MARGIN, 520)
    canvas = np.full((high, _WIDE + _SIDE + 3 * _MARGIN, 3), _PAPER, np.uint8)
    _frame(canvas, size, scale)
    if not isinstance(found, LensCalibration):
        _text(canvas, "corners of all views", (_MARGIN, _MARGIN - 14))
        for view in found:
            for at in _drawn(view.seen.px, scale):
                cv2.circle(canvas, at, 2, _MARK, -1, cv2.LINE_AA)
        return canvas
    usual = max(float(np.median([view.rms_px for view in found.views])), 1e-6)
    enlarged = _USUAL_LONG / usual
    _text(canvas, f"corners of {len(found.views)} views, residuals {enlarged / scale:.0f} times as long",
          (_MARGIN, _MARGIN - 14))  # fmt: skip
    for solved in found.views:
        starts = _drawn(solved.view.seen.px, scale)
        for at, residual in zip(starts, solved.residuals_px, strict=True):
            size_px = float(np.linalg.norm(residual))
            end = round(at[0] + enlarged * residual[0]), round(at[1] + enlarged * residual[1])
            cv2.line(canvas, at, end, _BAD if size_px > 3.0 * usual else _GOOD, 1, cv2.LINE_AA)
            cv2.circle(canvas, at, 1, _INK, -1, cv2.LINE_AA)
    left = _WIDE + 2 * _MARGIN
    _radial(canvas, found, left, _MARGIN, high // 2 - 2 * _MARGIN)
    _bars(canvas, found, left, high // 2 + _MARGIN // 2, high // 2 - 2 * _MARGIN)
    return canvas


def _drawn(px: FloatArray, scale: float) -> list[tuple[int, int]]:
    return [(round(_MARGIN + scale * x), round(_MARGIN + scale * y)) for x, y in px.tolist()]


def _frame(canvas: ImageArray, size: tuple[int, int], scale: float) -> None:
    right, below = round(_MARGIN + scale * size[0]), round(_MARGIN + scale * size[1])
    for third in (1, 2):
        x, y = round(_MARGIN + scale * size[0] * third / 3), round(_MARGIN + scale * size[1] * third / 3)
        cv2.line(canvas, (x, _MARGIN), (x, below), _FAINT, 1)
        cv2.line(canvas, (_MARGIN, y), (right, y), _FAINT, 1)
    cv2.rectangle(canvas, (_MARGIN, _MARGIN), (right, below), _INK, 1)


def _radial(canvas: ImageArray, found: LensCalibration, left: int, top: int, high: int) -> None:
    """Residuals away from the principal point, over the distance from it: their means and 1-sigma of these."""
    camera = found.camera
    away = np.concatenate([view.view.seen.px for view in found.views]) - (camera.cx, camera.cy)
    residuals = np.concatenate([view.residuals_px for view in found.views])
    radius = np.linalg.norm(away, axis=1)
    outward = (residuals * away).sum(axis=1) / np.maximum(radius, 1e-9)
    most = float(radius.max())
    ring = np.minimum((radius / most * _RINGS).astype(np.intp), _RINGS - 1)
    # On a scale that the usual residual fills, so that a systematic part of it shows.
    reach = 3.0 * float(np.std(outward))
    _text(canvas, f"residual away from the principal point, +-{reach:.2f} px, over the distance, 0 to {most:.0f} px",
          (left, top - 14), 0.42)  # fmt: skip
    cv2.rectangle(canvas, (left, top), (left + _SIDE, top + high), _INK, 1)
    middle = top + high // 2
    cv2.line(canvas, (left, middle), (left + _SIDE, middle), _FAINT, 1)
    for r, out in zip(radius.tolist(), np.clip(outward / reach, -1.0, 1.0).tolist(), strict=True):
        at = round(left + _SIDE * r / most), round(middle - 0.5 * high * out)
        cv2.circle(canvas, at, 1, _FAINT, -1)
    for number in range(_RINGS):
        inside = outward[ring == number]
        if len(inside) < 4:
            continue
        x = round(left + _SIDE * (number + 0.5) / _RINGS)
        mean, sigma = float(inside.mean()), float(inside.std(ddof=1)) / len(inside) ** 0.5
        ends = [round(middle - 0.5 * high * max(-1.0, min(1.0, (mean + s * sigma) / reach))) for s in (-1, 0, 1)]
        cv2.line(canvas, (x, ends[0]), (x, ends[2]), _BAD, 2, cv2.LINE_AA)
        cv2.circle(canvas, (x, ends[1]), 4, _BAD, -1, cv2.LINE_AA)


def _bars(canvas: ImageArray, found: LensCalibration, left: int, top: int, high: int) -> None:
    """The views' errors in their order."""
    errors = [view.rms_px for view in found.views]
    most = max(errors)
    _text(canvas, f"views: rms error, {found.rms_px:.3f} px in all, {most:.3f} px the worst; tilt in degrees below",
          (left, top - 14), 0.42)  # fmt: skip
    step = _SIDE / len(errors)
    for number, view in enumerate(found.views):
        x0, x1 = round(left + step * number + 1), round(left + step * (number + 1) - 1)
        tall = round(high * view.rms_px / most)
        cv2.rectangle(canvas, (x0, top + high - tall), (x1, top + high), _MARK, -1)
        if step >= 9.0:
            _text(canvas, f"{view.tilt_deg:.0f}", (x0, top + high + 14), 0.3)
    cv2.rectangle(canvas, (left, top), (left + _SIDE, top + high), _INK, 1)


def _text(canvas: ImageArray, words: str, at: tuple[int, int], size: float = 0.5) -> None:
    cv2.putText(canvas, words, at, _FONT, size, _INK, 1, cv2.LINE_AA)
