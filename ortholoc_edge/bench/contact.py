"""Contact sheets: the frame with its inliers, beside it the map as it looks from the estimate and from the truth."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np

from ortholoc_edge.bench import draw
from ortholoc_edge.bench.core import Take
from ortholoc_edge.geometry.arrays import Float32Array, ImageArray
from ortholoc_edge.geometry.camera import Camera
from ortholoc_edge.geometry.grid import RasterGrid
from ortholoc_edge.geometry.rigid import Rigid3
from ortholoc_edge.pipeline.outcome import Fix
from ortholoc_edge.pipeline.prior import footprint
from ortholoc_edge.tiles.store import MapStore

_PANE_PX = 480
_COLUMNS = 2
_MARGIN_PART = 0.1
# Looks at the surface for the point of each pixel; slopes below the view's own converge in a few.
_LOOKS = 12
_LEAST_FALL = 0.05


def ranked(takes: Sequence[Take]) -> list[Take]:
    """By position error; those without a fix come last."""
    return sorted(takes, key=lambda take: math.inf if take.result.error is None else take.result.error.te_m)


def best_median_worst(takes: Sequence[Take], count: int) -> dict[str, list[Take]]:
    """``count`` of each, or all if there are fewer, and of each frame one take only; the most extreme come first."""
    order = ranked(takes)
    middle = (len(order) - 1) / 2
    outward = sorted(range(len(order)), key=lambda rank: abs(rank - middle))
    chosen = {"best": order, "median": [order[rank] for rank in outward], "worst": order[::-1]}
    return {which: _first_of_each_frame(those)[:count] for which, those in chosen.items()}


def _first_of_each_frame(takes: Sequence[Take]) -> list[Take]:
    found: dict[int, Take] = {}
    for take in takes:
        found.setdefault(id(take.view), take)
    return list(found.values())


def sheet(takes: Sequence[Take]) -> ImageArray:
    """(H, W, 3) RGB: rows of `_COLUMNS` frames, three pictures of each."""
    cells = [_cell(take) for take in takes]
    height, width = (max(cell.shape[axis] for cell in cells) for axis in (0, 1))
    rows = -(-len(cells) // _COLUMNS)
    canvas = np.zeros((rows * height, min(len(cells), _COLUMNS) * width, 3), np.uint8)
    for k, cell in enumerate(cells):
        top, left = k // _COLUMNS * height, k % _COLUMNS * width
        canvas[top : top + cell.shape[0], left : left + cell.shape[1]] = cell
    return canvas


def _cell(take: Take) -> ImageArray:
    result, frame = take.result, take.view.frame
    scale = _PANE_PX / frame.camera.width
    width, height = _PANE_PX, round(frame.camera.height * scale)
    camera = frame.camera.resized(width, height)
    picture = np.asarray(cv2.resize(frame.picture, (width, height), interpolation=cv2.INTER_AREA), dtype=np.uint8)
    outcome = result.outcome
    seen_from, said = None if result.prior is None else result.prior.map_from_camera, "map from the prior"
    if isinstance(outcome, Fix):
        outcome = replace(outcome, camera=outcome.camera.resized(width, height))
        seen_from, said = outcome.map_from_camera, "map from the estimate"
    ground_m = float(result.truth.translation[2]) - take.view.height_m
    store = take.scene.store
    panes = [draw.overlay(picture, outcome, result.truth, camera, "inliers: truth green, estimate red")]
    panes += [
        draw.captioned(map_in_view(store, camera, pose, ground_m), text)
        for pose, text in ((seen_from, said), (result.truth, "map from the truth"))
        if pose is not None
    ]
    return draw.captioned(np.hstack(panes), caption(take))


def caption(take: Take) -> str:
    """One line about a take."""
    result = take.result
    name = f"{take.scene.site.name}/{result.name}"
    if isinstance(result.outcome, Fix) and result.error is not None:
        return (
            f"{name}  TE {result.error.te_m:.2f} m  RE {result.error.re_deg:.2f} deg  "
            f"{result.outcome.inliers}/{result.outcome.matches} inliers  height {take.view.height_m:.0f} m"
        )
    return f"{name}  no fix: {getattr(result.outcome, 'reason', '')}  height {take.view.height_m:.0f} m"


def map_in_view(store: MapStore, camera: Camera, map_from_camera: Rigid3, ground_m: float) -> ImageArray:
    """The orthophoto in colour as a camera would see it, (H, W, 3); black where there is none.

    For eyes only: each pixel's point is found by looking at the surface again and again, which knows no occlusion, and
    the map's scale is taken as 1.
    """
    black = np.zeros((camera.height, camera.width, 3), np.uint8)
    height_m = float(map_from_camera.translation[2]) - ground_m
    if height_m <= 0:
        return black
    outline = footprint(camera, map_from_camera, ground_m)
    margin = _MARGIN_PART * float(np.ptp(outline, axis=0).max())
    (west, south), (east, north) = outline.min(axis=0) - margin, outline.max(axis=0) + margin
    picture = store.read_colour((west, south, east, north), max(height_m / camera.focal_px, (east - west) / 4096))
    surface = None if picture is None else store.read_surface(picture.grid, 2.0 * picture.grid.gsd_m)
    if picture is None or surface is None or not np.isfinite(surface.dsm).any():
        return black
    heights = np.where(np.isfinite(surface.dsm), surface.dsm, np.float32(np.nanmedian(surface.dsm)))
    u, v = np.meshgrid(np.arange(camera.width, dtype=np.float64), np.arange(camera.height, dtype=np.float64))
    rays = camera.unproject(np.stack([u, v], axis=-1).reshape(-1, 2)) @ map_from_camera.rotation.T
    down = -rays[:, 2] / np.linalg.norm(rays, axis=1)
    # Toward the horizon there is nothing to see, and the division would fail.
    slopes = rays[:, :2] / np.maximum(-rays[:, 2], 1e-6)[:, None]
    fall = np.full(len(rays), height_m)

    def pixels(grid: RasterGrid) -> Float32Array:
        px = grid.px_from_map(map_from_camera.translation[:2] + slopes * fall[:, None])
        px[down < _LEAST_FALL] = -10.0
        return px.astype(np.float32).reshape(camera.height, camera.width, 2)

    for _ in range(_LOOKS):
        at = pixels(surface.dsm_grid)
        met = cv2.remap(heights, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        fall = float(map_from_camera.translation[2]) - np.asarray(met, dtype=np.float64).reshape(-1)
    at = pixels(picture.grid)
    drawn = cv2.remap(picture.rgb, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
    return np.asarray(drawn, dtype=np.uint8)
