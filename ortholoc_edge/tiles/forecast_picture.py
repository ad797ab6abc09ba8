"""A forecast drawn over the orthophoto."""

from __future__ import annotations

import math

import cv2
import numpy as np
import numpy.typing as npt

from ortholoc_edge.geometry.arrays import BoolArray, ImageArray
from ortholoc_edge.geometry.grid import RasterGrid
from ortholoc_edge.tiles.forecast import COLOURS, LABELS, Forecast, Verdict
from ortholoc_edge.tiles.store import MapStore

_INK, _PAPER, _NO_MAP = (255, 255, 255), (20, 20, 20), (70, 70, 74)
_FONT = cv2.FONT_HERSHEY_SIMPLEX
_LONG_SIDE_PX = 1600
_MIN_SIDE_PX = 480
# The map is read in blocks of the picture: of a large pack even the coarsest level is too much at once.
_BLOCK_PX = 256
_MARGIN = 0.12
_MIN_MARGIN_M = 20.0
# Of the orthophoto's brightness, for the route to stand out.
_DIMMED = 0.7


def picture(forecast: Forecast, store: MapStore) -> ImageArray:
    """The route coloured by verdict over the orthophoto, grid north up, with legend and scale bar.

    Returns: (H, W, 3) uint8 RGB. Grey is where the pack has no orthophoto.
    """
    canvas_grid = _grid(forecast)
    canvas = _background(store, canvas_grid)
    lines = [(s.verdict, np.round(canvas_grid.px_from_map(s.xy_map)).astype(np.int32)) for s in forecast.stretches]
    for _, px in lines:
        if np.ptp(px, axis=0).any():
            cv2.polylines(canvas, [px], False, _PAPER, 7, cv2.LINE_AA)
        else:
            cv2.circle(canvas, _at(px), 6, _PAPER, -1, cv2.LINE_AA)
    # The worst last, on top of where the route crosses itself.
    for wanted in Verdict:
        for verdict, px in lines:
            if verdict is wanted and np.ptp(px, axis=0).any():
                cv2.polylines(canvas, [px], False, COLOURS[verdict], 4, cv2.LINE_AA)
            elif verdict is wanted:
                cv2.circle(canvas, _at(px), 4, COLOURS[verdict], -1, cv2.LINE_AA)
    start = _at(lines[0][1])
    cv2.circle(canvas, start, 8, _PAPER, -1, cv2.LINE_AA)
    cv2.circle(canvas, start, 6, _INK, -1, cv2.LINE_AA)
    _legend(canvas, forecast)
    _scale_bar(canvas, canvas_grid.gsd_m)
    return canvas


def _grid(forecast: Forecast) -> RasterGrid:
    """Of the picture: the route with a margin."""
    places = np.concatenate([stretch.xy_map for stretch in forecast.stretches])
    low, high = places.min(axis=0), places.max(axis=0)
    margin = _MARGIN * float((high - low).max()) + _MIN_MARGIN_M
    extent = high - low + 2.0 * margin
    gsd_m = float(extent.max()) / _LONG_SIDE_PX
    width, height = (max(_MIN_SIDE_PX, math.ceil(side / gsd_m)) for side in extent)
    west, north = (low[0] + high[0] - width * gsd_m) / 2.0, (low[1] + high[1] + height * gsd_m) / 2.0
    return RasterGrid(width, height, float(west), float(north), gsd_m, -gsd_m)


def _background(store: MapStore, grid: RasterGrid) -> ImageArray:
    canvas: ImageArray = np.full((grid.height, grid.width, 3), _NO_MAP, dtype=np.uint8)
    for row in range(0, grid.height, _BLOCK_PX):
        for column in range(0, grid.width, _BLOCK_PX):
            width, height = min(_BLOCK_PX, grid.width - column), min(_BLOCK_PX, grid.height - row)
            _fill(canvas[row : row + height, column : column + width], grid.crop(column, row, width, height), store)
    return canvas


def _fill(block: ImageArray, grid: RasterGrid, store: MapStore) -> None:
    west, south, east, north = grid.bounds
    aside = 2.0 * grid.gsd_m
    window = store.read_colour((west - aside, south - aside, east + aside, north + aside), grid.gsd_m)
    if window is None:
        return
    dop, valid, source = window.rgb, window.valid, window.grid
    shrink = min(1.0, source.gsd_m / grid.gsd_m)
    if shrink < 1.0:
        size = (max(1, round(source.width * shrink)), max(1, round(source.height * shrink)))
        dop, source = np.asarray(cv2.resize(dop, size, interpolation=cv2.INTER_AREA)), source.resized(*size)
        valid = _resized(valid, size)
    source_from_block = np.linalg.inv(source.map_from_px_matrix()) @ grid.map_from_px_matrix()
    size = (grid.width, grid.height)
    colour = cv2.warpAffine(dop, source_from_block[:2], size, flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
    known = cv2.warpAffine(
        valid.astype(np.uint8), source_from_block[:2], size, flags=cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP
    )
    block[known != 0] = np.rint(_DIMMED * colour[known != 0]).astype(np.uint8)


def _resized(valid: BoolArray, size: tuple[int, int]) -> BoolArray:
    return np.asarray(cv2.resize(valid.astype(np.float32), size, interpolation=cv2.INTER_AREA) >= 0.5)


def _at(px: npt.NDArray[np.int32]) -> tuple[int, int]:
    return int(px[0][0]), int(px[0][1])


def _legend(canvas: ImageArray, forecast: Forecast) -> None:
    rows = [(COLOURS[v], f"{LABELS[v]}  {forecast.length_m(v) / 1e3:.2f} km") for v in Verdict]
    rows.append((_INK, "start"))
    width = max(cv2.getTextSize(text, _FONT, 0.55, 1)[0][0] for _, text in rows)
    cv2.rectangle(canvas, (10, 10), (66 + width, 20 + 26 * len(rows)), _PAPER, -1)
    for k, (colour, text) in enumerate(rows):
        y = 29 + 26 * k
        if colour == _INK:
            cv2.circle(canvas, (34, y), 6, colour, -1, cv2.LINE_AA)
        else:
            cv2.line(canvas, (20, y), (48, y), colour, 5)
        cv2.putText(canvas, text, (58, y + 5), _FONT, 0.55, _INK, 1, cv2.LINE_AA)


def _scale_bar(canvas: ImageArray, gsd_m: float) -> None:
    height, width = canvas.shape[:2]
    longest_m = 0.2 * width * gsd_m
    power = 10.0 ** math.floor(math.log10(longest_m))
    bar_m = max((step * power for step in (1.0, 2.0, 5.0) if step * power <= longest_m), default=power)
    bar_px = round(bar_m / gsd_m)
    label = f"{bar_m / 1e3:g} km" if bar_m >= 1000 else f"{bar_m:g} m"
    cv2.rectangle(canvas, (10, height - 50), (34 + max(bar_px, 60), height - 10), _PAPER, -1)
    cv2.line(canvas, (22, height - 20), (22 + bar_px, height - 20), _INK, 3)
    cv2.putText(canvas, label, (22, height - 29), _FONT, 0.5, _INK, 1, cv2.LINE_AA)
