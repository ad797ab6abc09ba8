"""One picture of a pack: orthophoto, surface model, coverage and matchability, for a look before the flight."""

from __future__ import annotations

import math
from typing import Any, Final

import cv2
import numpy as np
import numpy.typing as npt
import rasterio

from ortholoc_edge.errors import MapError
from ortholoc_edge.geometry.arrays import BoolArray, Float32Array, FloatArray, ImageArray
from ortholoc_edge.geometry.grid import RasterGrid
from ortholoc_edge.tiles.lattice import Bounds
from ortholoc_edge.tiles.manifest import layer_bounds
from ortholoc_edge.tiles.matchability import MATCHABLE_DOUBTFUL_MIN, MATCHABLE_EXPECTED_MIN, NO_MAP
from ortholoc_edge.tiles.pack import Pack
from ortholoc_edge.tiles.store import MapStore

MATCHABILITY_FILE: Final = "reports/matchability.tif"

_PAPER, _INK, _FAINT, _EMPTY = (250, 250, 248), (30, 30, 30), (120, 120, 120), (205, 205, 208)
_COMPLETE, _DOP_ONLY, _DSM_ONLY = (42, 157, 92), (224, 160, 32), (74, 120, 208)
# The sun of the hill shading: from the north-west, as maps have it; from the south, hills look like pits.
_SUN_AZIMUTH_DEG, _SUN_ELEVATION_DEG = 315.0, 40.0
# Of the heights' 2nd to 98th percentile, the slope that a picture of any relief should have.
_EXAGGERATED_SLOPE: Final = 0.35
_READ_PX: Final = 1024
_MIN_SIDE_PX: Final = 600


def preview(pack: Pack, size_px: int = 1600, memory_bytes: int = 4 * 2**30) -> ImageArray:
    """The picture (H, W, 3) uint8 RGB, its long side ``size_px``.

    Args:
        memory_bytes: limit of the pack's files, which are read to memory.
    Raises: MapError for a pack whose tiles cannot be read; ValueError for a picture under 600 px.
    """
    if size_px < _MIN_SIDE_PX:
        raise ValueError(f"size_px {size_px} must be at least {_MIN_SIDE_PX}")
    boxes = [layer_bounds(pack.manifest.dop), layer_bounds(pack.manifest.dsm)]
    bounds = (*(min(box[k] for box in boxes) for k in (0, 1)), *(max(box[k] for box in boxes) for k in (2, 3)))
    page = _Page(size_px, (bounds[2] - bounds[0]) / (bounds[3] - bounds[1]))
    grid = _panel_grid((bounds[0], bounds[1], bounds[2], bounds[3]), *page.panel)
    with MapStore(pack, memory_bytes=memory_bytes) as store:
        dop, dop_valid, heights = _read(store, grid)
    matchable = _matchability(pack, grid)
    dsm_valid = np.isfinite(heights)
    panels = [
        ("Orthophoto (DOP)", np.where(dop_valid[:, :, None], dop, _EMPTY).astype(np.uint8)),
        ("Surface model (DSM), light from north-west", shaded(heights, grid.dx)),
        ("Coverage", _coverage(dop, dop_valid, dsm_valid)),
        ("Matchability of frames", _heat(dop, dop_valid, matchable)),
    ]
    for index, (title, picture) in enumerate(panels):
        page.place(index, title, picture)
    if dsm_valid.any():
        low, high = _range(heights)
        page.ramp(1, f"{low:.1f} m", _tint(np.linspace(0.0, 1.0, 256)), f"{high:.1f} m (2nd to 98th percentile)")
    cell_m2 = grid.dx * abs(grid.dy)
    masks = (dop_valid & dsm_valid, dop_valid & ~dsm_valid, dsm_valid & ~dop_valid)
    names = ("complete", "no DSM", "no DOP")
    areas_m2 = [np.count_nonzero(mask) * cell_m2 for mask in masks]
    page.keys(
        2,
        [
            (f"{name} {_area(area_m2)}", colour)
            for name, area_m2, colour in zip(names, areas_m2, (_COMPLETE, _DOP_ONLY, _DSM_ONLY), strict=True)
            if area_m2
        ],
    )
    if matchable is None:
        page.keys(3, [("not in this pack", _EMPTY)])
    else:
        colours = cv2.applyColorMap(np.arange(256, dtype=np.uint8)[:, None], cv2.COLORMAP_VIRIDIS)[:, 0, ::-1]
        meaning = f"100; below {MATCHABLE_EXPECTED_MIN} doubtful, below {MATCHABLE_DOUBTFUL_MIN} unlikely"
        page.ramp(3, "0", colours.astype(np.float64), meaning)
    page.scale_bar(0, grid.dx)
    page.corners(grid, pack)
    page.footer(_credit(pack))
    return page.image


def shaded(heights: Float32Array, cell_m: float) -> ImageArray:
    """Hill shading with a height tint (H, W, 3) RGB; row 0 is north.

    Gentle relief is exaggerated, so that a plain shows its ditches.
    """
    known = np.isfinite(heights)
    picture = np.empty((*heights.shape, 3), dtype=np.uint8)
    picture[:] = _EMPTY
    if not known.any():
        return picture
    low, high = _range(heights)
    filled = np.where(known, heights, np.median(heights[known])).astype(np.float32)
    east = cv2.Sobel(filled, cv2.CV_32F, 1, 0, scale=1 / 8) / cell_m
    # Rows run south.
    north = -cv2.Sobel(filled, cv2.CV_32F, 0, 1, scale=1 / 8) / cell_m
    inner = cv2.erode(known.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)
    east[~inner] = north[~inner] = 0.0
    slope = np.hypot(east, north)[inner]
    typical = float(np.percentile(slope, 90)) if slope.size else 0.0
    lift = float(np.clip(_EXAGGERATED_SLOPE / typical, 0.3, 8.0)) if typical > 1e-6 else 1.0
    azimuth, elevation = math.radians(_SUN_AZIMUTH_DEG), math.radians(_SUN_ELEVATION_DEG)
    toward = math.cos(elevation) * math.sin(azimuth), math.cos(elevation) * math.cos(azimuth), math.sin(elevation)
    # The surface's normal is (-dz/dx, -dz/dy, 1).
    light = (toward[2] - lift * (east * toward[0] + north * toward[1])) / np.sqrt(1.0 + lift**2 * (east**2 + north**2))
    shade = 0.25 + 0.75 * np.clip(light, 0.0, 1.0) / math.sin(elevation)
    level = np.clip((filled - low) / max(high - low, 1e-6), 0.0, 1.0)
    coloured = _tint(level) * np.clip(shade, 0.0, 1.35)[:, :, None]
    picture[known] = np.clip(coloured[known], 0, 255).astype(np.uint8)
    return picture


def _tint(level: npt.NDArray[np.floating[Any]]) -> FloatArray:
    """Colours (..., 3) of heights from 0 to 1: green lowlands, ochre, brown, pale tops."""
    stops = np.array([0.0, 0.35, 0.6, 0.85, 1.0])
    colours = np.array([[96, 150, 110], [190, 196, 130], [206, 166, 108], [160, 118, 92], [238, 232, 226]])
    return np.stack([np.interp(level, stops, colours[:, k]) for k in range(3)], axis=-1)


def _range(heights: Float32Array) -> tuple[float, float]:
    low, high = np.percentile(heights[np.isfinite(heights)], [2, 98])
    return float(low), float(high)


def _area(area_m2: float) -> str:
    return f"{area_m2 / 1e6:.3g} km2" if area_m2 >= 1e5 else f"{area_m2:.0f} m2"


def _coverage(dop: ImageArray, dop_valid: BoolArray, dsm_valid: BoolArray) -> ImageArray:
    picture = np.empty((*dop_valid.shape, 3), dtype=np.uint8)
    picture[:] = _EMPTY
    grey = cv2.cvtColor(dop, cv2.COLOR_RGB2GRAY)[:, :, None] / 255.0
    for mask, colour in (
        (dop_valid & dsm_valid, _COMPLETE),
        (dop_valid & ~dsm_valid, _DOP_ONLY),
        (~dop_valid & dsm_valid, _DSM_ONLY),
    ):
        # A hint of the photo, to see what it is that lacks.
        relief = np.where(dop_valid[:, :, None], 0.75 + 0.5 * (grey - 0.5), 1.0)
        picture[mask] = np.clip(relief * np.array(colour), 0, 255).astype(np.uint8)[mask]
    return picture


def _heat(dop: ImageArray, dop_valid: BoolArray, scores: Float32Array | None) -> ImageArray:
    picture = np.empty((*dop_valid.shape, 3), dtype=np.uint8)
    picture[:] = _EMPTY
    if scores is None:
        return picture
    known = np.isfinite(scores)
    values = np.where(known, np.clip(scores, 0, 100) * 2.55, 0).astype(np.uint8)
    colours = cv2.applyColorMap(values, cv2.COLORMAP_VIRIDIS)[:, :, ::-1]
    grey = cv2.cvtColor(dop, cv2.COLOR_RGB2GRAY)[:, :, None] / 255.0
    mixed = colours * np.where(dop_valid[:, :, None], 0.8 + 0.4 * (grey - 0.5), 1.0)
    picture[known] = np.clip(mixed, 0, 255).astype(np.uint8)[known]
    return picture


def _panel_grid(bounds: Bounds, width: int, height: int) -> RasterGrid:
    """Square pixels in which the bounds fit into a panel, in its middle."""
    west, south, east, north = bounds
    pixel_m = max((east - west) / width, (north - south) / height)
    left = (west + east) / 2 - pixel_m * width / 2
    top = (south + north) / 2 + pixel_m * height / 2
    return RasterGrid(width, height, left, top, pixel_m, -pixel_m)


def _read(store: MapStore, grid: RasterGrid) -> tuple[ImageArray, BoolArray, Float32Array]:
    """Orthophoto, its validity and heights on a panel's grid, read in pieces: a large pack exceeds one read."""
    dop = np.zeros((grid.height, grid.width, 3), dtype=np.uint8)
    valid = np.zeros((grid.height, grid.width), dtype=bool)
    heights = np.full((grid.height, grid.width), np.nan, dtype=np.float32)
    coarsest = min(store.dop_grids[-1].gsd_m, store.dsm_grids[-1].gsd_m)
    # A piece whose pixels on the coarsest level are a read's worth.
    step = max(int(min(_READ_PX, _READ_PX * coarsest / grid.dx)), 16)
    for row in range(0, grid.height, step):
        for column in range(0, grid.width, step):
            piece = grid.crop(column, row, min(step, grid.width - column), min(step, grid.height - row))
            picture = store.read_colour(piece.bounds, grid.dx / math.sqrt(2.0))
            surface = None if picture is None else store.read_surface(picture.grid, grid.dx)
            if picture is None or surface is None:
                continue
            place = np.s_[row : row + piece.height, column : column + piece.width]
            dop[place] = _sampled(picture.rgb, picture.grid, piece)
            valid[place] = _sampled(picture.valid.astype(np.uint8), picture.grid, piece, nearest=True) > 0
            heights[place] = _sampled(surface.dsm, surface.dsm_grid, piece, nearest=True, outside=np.nan)
    return dop, valid, heights


def _sampled(
    raster: npt.NDArray[Any], source: RasterGrid, target: RasterGrid, *, nearest: bool = False, outside: float = 0.0
) -> npt.NDArray[Any]:
    """A raster at the pixel centres of another grid; of pixels finer than those, what lies under the centre."""
    origin = source.px_from_map(target.map_from_px([(0.0, 0.0)]))[0]
    transform = np.array([[target.dx / source.dx, 0.0, origin[0]], [0.0, target.dy / source.dy, origin[1]]])
    if not nearest and transform[0, 0] > 1.0:
        raster = cv2.GaussianBlur(raster, (0, 0), 0.4 * transform[0, 0])
    flags = (cv2.INTER_NEAREST if nearest else cv2.INTER_LINEAR) | cv2.WARP_INVERSE_MAP
    border = cv2.BORDER_CONSTANT if nearest else cv2.BORDER_REPLICATE
    size = (target.width, target.height)
    return np.asarray(cv2.warpAffine(raster, transform, size, flags=flags, borderMode=border, borderValue=outside))


def _matchability(pack: Pack, grid: RasterGrid) -> Float32Array | None:
    """Scores on a panel's grid, NaN where there is none; None for a pack without the report."""
    path = pack.path / MATCHABILITY_FILE
    if not path.is_file():
        return None
    try:
        with rasterio.open(path) as raster:
            cells, transform = raster.read(1), raster.transform
    except rasterio.errors.RasterioIOError as err:
        raise MapError(f"{path}: cannot be read ({err}); rebuild the pack or copy it again") from err
    source = RasterGrid(cells.shape[1], cells.shape[0], transform.c, transform.f, transform.a, transform.e)
    values = np.where(cells == NO_MAP, np.nan, cells).astype(np.float32)
    return np.asarray(_sampled(values, source, grid, nearest=True, outside=np.nan), dtype=np.float32)


def _credit(pack: Pack) -> str:
    parts = []
    for name, layer in (("DOP", pack.manifest.dop), ("DSM", pack.manifest.dsm)):
        words = [layer.attribution or "source not stated", layer.licence, layer.date]
        parts.append(f"{name} {layer.gsd_m:g} m: {', '.join(word for word in words if word)}")
    return " | ".join(parts)


class _Page:
    """Four panels in two rows, with room for their titles and legends.

    Attributes:
        image: (H, W, 3) uint8 RGB.
        panel: (width, height) of a panel, px.
    """

    def __init__(self, size_px: int, aspect: float) -> None:
        unit = size_px / 1600.0
        self._font, self._thick = 0.62 * unit, max(round(1.3 * unit), 1)
        self._gap, self._head, self._foot = round(20 * unit), round(62 * unit), round(62 * unit)
        self._credit = round(44 * unit)
        aspect = float(np.clip(aspect, 0.5, 2.0))
        width = (size_px - 3 * self._gap) // 2
        height = round(width / aspect)
        high = 2 * (height + self._head + self._foot) + self._credit
        if high > size_px:
            height = (size_px - self._credit) // 2 - self._head - self._foot
            width = round(height * aspect)
        self.panel = (width, height)
        self.image: ImageArray = np.empty(
            (2 * (height + self._head + self._foot) + self._credit, 2 * width + 3 * self._gap, 3), dtype=np.uint8
        )
        self.image[:] = _PAPER

    def place(self, index: int, title: str, picture: ImageArray) -> None:
        x, y = self._corner(index)
        width, height = self.panel
        self.image[y : y + height, x : x + width] = picture
        cv2.rectangle(self.image, (x - 1, y - 1), (x + width, y + height), _FAINT, 1)
        self._text(title, x, y - round(0.62 * self._head), _INK, 1.15)

    def keys(self, index: int, entries: list[tuple[str, tuple[int, int, int]]]) -> None:
        """Coloured squares with their names, under a panel."""
        x, y = self._below(index)
        side = round(0.26 * self._foot)
        for name, colour in entries:
            cv2.rectangle(self.image, (x, y - side), (x + side, y), colour, -1)
            cv2.rectangle(self.image, (x, y - side), (x + side, y), _FAINT, 1)
            x = self._text(name, x + round(1.4 * side), y, _INK) + 2 * side

    def ramp(self, index: int, low: str, colours: FloatArray, high: str) -> None:
        """A bar of colours (256, 3) with what its ends mean, under a panel."""
        x, y = self._below(index)
        width, side = round(0.25 * self.panel[0]), round(0.26 * self._foot)
        x = self._text(low, x, y, _INK) + side
        steps = np.linspace(0, len(colours) - 1, width).astype(np.intp)
        self.image[y - side : y, x : x + width] = colours[steps].astype(np.uint8)[None]
        cv2.rectangle(self.image, (x - 1, y - side - 1), (x + width, y), _FAINT, 1)
        self._text(high, x + width + side, y, _INK)

    def scale_bar(self, index: int, pixel_m: float) -> None:
        """A round length of about a third of the panel."""
        limit_m = 0.35 * self.panel[0] * pixel_m
        power = 10.0 ** math.floor(math.log10(limit_m))
        length_m = max(factor * power for factor in (1.0, 2.0, 5.0) if factor * power <= limit_m)
        x, y = self._below(index)
        end, tick = x + round(length_m / pixel_m), round(0.16 * self._foot)
        cv2.line(self.image, (x, y), (end, y), _INK, 2 * self._thick)
        for at in (x, end):
            cv2.line(self.image, (at, y - tick), (at, y), _INK, self._thick)
        name = f"{length_m / 1000:g} km" if length_m >= 1000 else f"{length_m:g} m"
        self._text(f"{name}, north is up", end + tick, y, _INK)

    def corners(self, grid: RasterGrid, pack: Pack) -> None:
        """Coordinates of every panel's north-west and south-east corner."""
        west, south, east, north = grid.bounds
        for index in range(4):
            x, y = self._corner(index)
            self._text(_position(pack, west, north), x, y - round(0.14 * self._head), _FAINT, 0.8)
            label = _position(pack, east, south)
            width = self._width(label, 0.8)
            bottom = y + self.panel[1] + round(0.3 * self._foot)
            self._text(label, x + self.panel[0] - width, bottom, _FAINT, 0.8)

    def footer(self, text: str) -> None:
        scale = min(0.85, 0.85 * (self.image.shape[1] - 2 * self._gap) / max(self._width(text, 0.85), 1))
        self._text(text, self._gap, self.image.shape[0] - round(0.35 * self._credit), _FAINT, scale)

    def _corner(self, index: int) -> tuple[int, int]:
        row, column = divmod(index, 2)
        x = self._gap + column * (self.panel[0] + self._gap)
        return x, self._head + row * (self.panel[1] + self._head + self._foot)

    def _below(self, index: int) -> tuple[int, int]:
        x, y = self._corner(index)
        return x, y + self.panel[1] + round(0.75 * self._foot)

    def _width(self, text: str, scale: float) -> int:
        return int(cv2.getTextSize(_ascii(text), cv2.FONT_HERSHEY_SIMPLEX, scale * self._font, self._thick)[0][0])

    def _text(self, text: str, x: int, y: int, colour: tuple[int, int, int], scale: float = 1.0) -> int:
        """Returns: where it ends."""
        font = cv2.FONT_HERSHEY_SIMPLEX
        cv2.putText(self.image, _ascii(text), (x, y), font, scale * self._font, colour, self._thick, cv2.LINE_AA)
        return x + self._width(text, scale)


def _position(pack: Pack, east: float, north: float) -> str:
    if pack.manifest.crs is None:
        return f"x {east:.1f}, y {north:.1f} m (local)"
    position = pack.georeference.geodetic_from_map((east, north, 0.0))
    return f"{position.lat_deg:.5f}, {position.lon_deg:.5f}"


def _ascii(text: str) -> str:
    """OpenCV's letters are English ones; others get their plain form, as people write them abroad."""
    plain = text
    for letter, stands in (
        ("ä", "ae"), ("ö", "oe"), ("ü", "ue"), ("Ä", "Ae"), ("Ö", "Oe"), ("Ü", "Ue"), ("ß", "ss"), ("©", "(c)"),
        ("–", "-"), ("é", "e"), ("è", "e"),
    ):  # fmt: skip
        plain = plain.replace(letter, stands)
    return plain.encode("ascii", "replace").decode()
