"""One picture of a sample, that shows at a glance whether its parts fit together."""

from __future__ import annotations

import cv2
import numpy as np

from ortholoc_edge.bench.draw import TRUTH, Colour, captioned
from ortholoc_edge.bench.ground_truth import geometric_confidence
from ortholoc_edge.bench.samples import Sample, needed
from ortholoc_edge.geometry.arrays import BoolArray, Float32Array, FloatArray, ImageArray

_PANEL_PX = 640
_OUTLINE: Colour = (255, 200, 40)
_NOTHING = 40


def sample_sheet(sample: Sample) -> ImageArray:
    """RGB picture of six panels: the photo with its keypoints projected by the true pose; the orthophoto as the photo
    should see it; the confidence of the true matches; the orthophoto with keypoints and the photo's outline; the
    surface model; the distance of what the photo shows.

    Raises: DatasetError for a sample without point map or keypoints.
    """
    points = needed(sample.point_map, sample, "point_map").astype(np.float64)
    keypoints = needed(sample.keypoints, sample, "keypoints")
    camera_from_map = sample.map_from_camera.inverse()
    flat = points.reshape(-1, 3)
    shape = points.shape[:2]
    at = sample.grid.px_from_map(points[..., :2]).astype(np.float32)
    seen = np.asarray(cv2.remap(sample.dop, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT))
    confidence = geometric_confidence(flat, sample).reshape(shape)
    depth = camera_from_map.apply(flat)[:, 2].reshape(shape)
    photo, dop = _fitted(sample.image), _fitted(sample.dop)
    _dots(photo, sample.camera.project(camera_from_map.apply(keypoints)), sample.image)
    _dots(dop, sample.grid.px_from_map(keypoints[:, :2]), sample.dop)
    _outline(dop, at, sample.dop)
    panels = [
        (photo, "photo, keypoints by the true pose"),
        (_fitted(seen.astype(np.uint8)), "orthophoto as the photo sees it"),
        (_fitted(_coloured(confidence, (0.0, 1.0))), "confidence of true matches, 0 to 1"),
        (dop, "orthophoto, keypoints, outline of the photo"),
        (_fitted(_coloured(sample.dsm)), _span("surface", sample.dsm)),
        (_fitted(_coloured(depth)), _span("distance", depth)),
    ]
    drawn = [captioned(_padded(panel), f"{sample.name}: {what}") for panel, what in panels]
    return np.vstack([np.hstack(drawn[:3]), np.hstack(drawn[3:])])


def _fitted(image: ImageArray) -> ImageArray:
    scale = _PANEL_PX / max(image.shape[:2])
    size = round(image.shape[1] * scale), round(image.shape[0] * scale)
    return np.ascontiguousarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def _padded(image: ImageArray) -> ImageArray:
    full = np.full((_PANEL_PX, _PANEL_PX, 3), _NOTHING, np.uint8)
    full[: image.shape[0], : image.shape[1]] = image
    return full


def _dots(panel: ImageArray, px: FloatArray, of: ImageArray) -> None:
    scale = max(panel.shape[:2]) / max(of.shape[:2])
    for u, v in (px[np.isfinite(px).all(axis=1)] + 0.5) * scale - 0.5:
        cv2.circle(panel, (round(float(u)), round(float(v))), 2, TRUTH, 1, cv2.LINE_AA)


def _outline(panel: ImageArray, at: Float32Array, of: ImageArray) -> None:
    rim = np.concatenate([at[0], at[:, -1], at[-1, ::-1], at[::-1, 0]])
    scale = max(panel.shape[:2]) / max(of.shape[:2])
    px = (rim[np.isfinite(rim).all(axis=1)] + 0.5) * scale - 0.5
    if len(px):
        cv2.polylines(panel, [np.round(px).astype(np.int32)], True, _OUTLINE, 2, cv2.LINE_AA)


def _coloured(values: FloatArray | Float32Array, span: tuple[float, float] | None = None) -> ImageArray:
    known: BoolArray = np.isfinite(values)
    low, high = span or _usual(values)
    grey = np.clip((np.where(known, values, low) - low) / max(high - low, 1e-9) * 255.0, 0, 255).astype(np.uint8)
    colours = cv2.cvtColor(cv2.applyColorMap(grey, cv2.COLORMAP_VIRIDIS), cv2.COLOR_BGR2RGB)
    colours[~known] = _NOTHING
    return np.asarray(colours, dtype=np.uint8)


def _usual(values: FloatArray | Float32Array) -> tuple[float, float]:
    finite = values[np.isfinite(values)]
    if not finite.size:
        return 0.0, 0.0
    low, high = np.percentile(finite, [1.0, 99.0])
    return float(low), float(high)


def _span(what: str, values: FloatArray | Float32Array) -> str:
    low, high = _usual(values)
    return f"{what} {low:.1f} to {high:.1f} m"
