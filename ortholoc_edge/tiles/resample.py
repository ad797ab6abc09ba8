"""A source's pixels on a grid of the pack: copied where they lie on it already, resampled once where not."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import pyproj
from affine import Affine
from pyproj.aoi import AreaOfInterest
from pyproj.exceptions import CRSError, ProjError
from pyproj.transformer import TransformerGroup
from rasterio.crs import CRS
from rasterio.enums import Resampling
from rasterio.warp import reproject
from rasterio.windows import Window

from ortholoc_edge.errors import MapError
from ortholoc_edge.geometry.arrays import BoolArray, Float32Array, ImageArray
from ortholoc_edge.geometry.grid import RasterGrid
from ortholoc_edge.tiles.source import Source, named_errors, opened, read_colours, read_heights, to_byte

# Of a pixel: grids that agree to this over their whole extent are one.
_SLACK_PX = 1e-3
# From this ratio of pixel sizes on the target's pixel is the mean of what it covers.
_AVERAGE_FROM = 1.5
# Ratios this close to one are one: GDAL would widen its kernel, which blurs.
_SAME_SCALE = 0.1
# Share of data below a target pixel's kernel that it needs beside data in its very middle. Four files may meet in
# one pixel, and none may leave it to the others.
_MIN_VALID_SHARE = 0.2
# Heights that differ by more from the nearest cell's are a wall seen as a slope: m, and per metre of the cell, for half
# a cell of 30 m up a mountain's flank is more than a wall.
_MAX_INVENTED_M, _MAX_INVENTED_PER_GSD = 1.0, 1.0
# Target pixels per side of one step, and source pixels that one step may read.
_STEP_PX = 1024
_MAX_STEP_SOURCE_PX = 4 * 2**20
_MARGIN_PX = 3
_ANY_CRS = "EPSG:32632"
# Between systems tied to the continents and those tied to the Earth the plates' motion counts, too: about 1 m.
_GOOD_WAY_M = 1.0
_AREA_DEG = 0.1


@dataclass(frozen=True, slots=True, eq=False)
class DopPixels:
    """``rgb`` (3, H, W) uint8, ``valid`` (H, W) bool, ``nir`` (H, W) uint8 or None; zeros where not valid."""

    rgb: ImageArray
    valid: BoolArray
    nir: ImageArray | None


class _Box(NamedTuple):
    """Rows and columns, half open, of the source's pixels; may reach beyond them."""

    top: int
    bottom: int
    left: int
    right: int


def on_lattice(source: RasterGrid, target: RasterGrid) -> bool:
    """Whether the pixels of two grids coincide wherever both have some."""
    if source.dy * target.dy < 0:
        return False
    reach = max(source.width, source.height, target.width, target.height)
    if max(abs(source.dx - target.dx) / target.dx, abs((source.dy - target.dy) / target.dy)) * reach > _SLACK_PX:
        return False
    column, row = (target.west - source.west) / target.dx, (target.top - source.top) / target.dy
    return abs(column - round(column)) <= _SLACK_PX and abs(row - round(row)) <= _SLACK_PX


@lru_cache(maxsize=256)
def same_crs(one: str | None, other: str | None) -> bool:
    """Whether two horizontal systems are one, whatever their notation. Raises: MapError for an unreadable one."""
    if one == other or one is None or other is None:
        return one == other
    a, b = _crs(one), _crs(other)
    if a.equals(b, ignore_axis_order=True):
        return True
    # PROJ ignores the order of degrees alone. Rasters have the easting first, whatever their system says: Czech and
    # Austrian ones and Gauss-Krueger's, which say northing first, are often written without.
    if not (a.is_projected and b.is_projected):
        return False
    axes = [sorted((axis.direction, axis.unit_conversion_factor) for axis in crs.axis_info) for crs in (a, b)]
    return bool(
        axes[0] == axes[1]
        and a.coordinate_operation == b.coordinate_operation
        and a.geodetic_crs.equals(b.geodetic_crs, ignore_axis_order=True)
    )


def is_copied(source: Source, grid: RasterGrid, crs: str | None) -> bool:
    """Whether pixels are copied as they are, not resampled."""
    return same_crs(source.crs, crs) and on_lattice(source.grid, grid)


def read_dop(source: Source, grid: RasterGrid, crs: str | None) -> DopPixels:
    """Pixels of an orthophoto on ``grid``, which may reach beyond it.

    Bit exact where the pixels coincide (:func:`is_copied`). Resampled else: bilinear, or the mean of the pixels
    below where the grid's are larger by half; pixels without data take no part. A pixel is valid where the source's
    pixel at its centre is, so that two files that meet leave neither a gap nor an overlap.
    Args:
        grid, crs: of the pack.
    Raises: MapError if the file cannot be read, or the systems have no way from one to the other.
    """
    shape = (grid.height, grid.width)
    count = len(source.bands) + (source.nir is not None)
    pixels, valid = np.zeros((count, *shape), np.uint8), np.zeros(shape, bool)
    with opened(source.path, source.where, (source.driver,)) as dataset:
        if is_copied(source, grid, crs):
            box = _direct(source.grid, grid)
            if (inside := _clipped(box, source.grid)) is not None:
                bands, mask = read_colours(source, dataset, _window(inside))
                part = _place(inside, box)
                valid[part], pixels[:, *part] = mask, to_byte(bands, source)
        else:
            for part, step in _steps(source, grid, crs):
                found = _source_box(source, step, crs)
                inside = None if found is None else _clipped(found, source.grid)
                if found is None or inside is None:
                    continue
                bands, mask = read_colours(source, dataset, _window(inside))
                if not mask.any():
                    continue
                values, share, at_centre = _warped(
                    _framed(bands.astype(np.float32), inside, found),
                    _framed(mask, inside, found),
                    _sub_grid(source.grid, found),
                    source,
                    step,
                    crs,
                )
                valid[part] = (share >= _MIN_VALID_SHARE) & (at_centre > 0)
                pixels[:, *part] = to_byte(values, source)
    pixels *= valid
    return DopPixels(pixels[: len(source.bands)], valid, pixels[-1] if source.nir is not None else None)


def read_dsm(source: Source, grid: RasterGrid, crs: str | None) -> Float32Array:
    """Heights (H, W) float32 in metres on ``grid``, which may reach beyond the source; NaN where there are none.

    As :func:`read_dop`; and where a resampled height differs from the nearest cell's by more than a metre, or than
    the side of a larger cell, the latter is taken: between roof and ground there is a wall, not a slope.
    """
    heights = np.full((grid.height, grid.width), np.nan, np.float32)
    limit_m = max(_MAX_INVENTED_M, _MAX_INVENTED_PER_GSD * source.gsd_m)
    with opened(source.path, source.where, (source.driver,)) as dataset:
        if is_copied(source, grid, crs):
            box = _direct(source.grid, grid)
            if (inside := _clipped(box, source.grid)) is not None:
                found = read_heights(source, dataset, _window(inside))
                heights[_place(inside, box)] = np.where(found.valid, found.metres, np.nan)
            return heights
        for part, step in _steps(source, grid, crs):
            reach = _source_box(source, step, crs)
            inside = None if reach is None else _clipped(reach, source.grid)
            if reach is None or inside is None:
                continue
            metres, valid, _, _ = read_heights(source, dataset, _window(inside))
            if not valid.any():
                continue
            # Near zero, where float32 steps by micrometres.
            base = float(np.floor(metres[valid].min()))
            low = np.where(valid, metres - base, 0.0).astype(np.float32)[None]
            values, share, nearest = _warped(
                _framed(low, inside, reach),
                _framed(valid, inside, reach),
                _sub_grid(source.grid, reach),
                source,
                step,
                crs,
            )
            mixed, sharp = values[0], nearest - 1
            mixed = np.where(np.abs(mixed - sharp) > limit_m, sharp, mixed)
            usable = (share >= _MIN_VALID_SHARE) & (nearest > 0)
            heights[part] = np.where(usable, mixed + base, np.nan)
    return heights


def transform_caveat(source: Source, crs: str | None) -> str | None:
    """What is wrong with the way from a source's system to the pack's, one sentence; None if nothing.

    PROJ takes a rougher way where the best one needs a grid that is not installed, and does not say so.
    """
    if source.crs is None or crs is None or same_crs(source.crs, crs):
        return None
    west, south, east, north = source.grid.bounds
    with named_errors(source.where, "has no place in the pack's system"):
        to_degrees = pyproj.Transformer.from_crs(_crs(source.crs), _crs(source.crs).geodetic_crs, always_xy=True)
        lon, lat = to_degrees.transform((west + east) / 2, (south + north) / 2, errcheck=True)
        area: Any = AreaOfInterest(lon - _AREA_DEG, lat - _AREA_DEG, lon + _AREA_DEG, lat + _AREA_DEG)
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message="Best transformation is not available")
            ways = TransformerGroup(_crs(source.crs), _crs(crs), always_xy=True, area_of_interest=area).transformers
    accuracy = ways[0].accuracy if ways else -1.0
    if 0 <= accuracy <= _GOOD_WAY_M:
        return None
    error = "an error that PROJ does not know" if accuracy < 0 else f"an error of about {accuracy:g} m"
    return (
        f"{source.name}: the way from {_crs(source.crs).name} to {_crs(crs).name} has {error};"
        " install PROJ's grids for it, or fetch the data in the pack's system"
    )


@lru_cache(maxsize=64)
def _crs(crs: str) -> Any:
    try:
        return pyproj.CRS.from_user_input(crs)
    except CRSError as err:
        raise MapError(f"{crs[:60]}: reference system not understood ({err}); name it as EPSG:n") from err


@lru_cache(maxsize=64)
def _way(from_crs: str, to_crs: str) -> Any:
    try:
        return pyproj.Transformer.from_crs(_crs(from_crs), _crs(to_crs), always_xy=True)
    except ProjError as err:
        raise MapError(
            f"{_crs(from_crs).name}: PROJ knows no way to {_crs(to_crs).name} ({err}); reproject with gdalwarp"
        ) from err


@lru_cache(maxsize=64)
def _gdal_crs(crs: str) -> CRS:
    with named_errors(crs[:60], "is not known to GDAL"):
        return CRS.from_user_input(crs)


def _direct(source: RasterGrid, target: RasterGrid) -> _Box:
    left, top = round((target.west - source.west) / source.dx), round((target.top - source.top) / source.dy)
    return _Box(top, top + target.height, left, left + target.width)


def _clipped(box: _Box, grid: RasterGrid) -> _Box | None:
    top, bottom = max(box.top, 0), min(box.bottom, grid.height)
    left, right = max(box.left, 0), min(box.right, grid.width)
    return _Box(top, bottom, left, right) if top < bottom and left < right else None


def _window(box: _Box) -> Window:
    return Window(box.left, box.top, box.right - box.left, box.bottom - box.top)


def _place(inside: _Box, box: _Box) -> tuple[slice, slice]:
    """Where the pixels of ``inside`` are in an array over ``box``."""
    return (
        slice(inside.top - box.top, inside.bottom - box.top),
        slice(inside.left - box.left, inside.right - box.left),
    )


def _framed(values: npt.NDArray[Any], inside: _Box, box: _Box) -> npt.NDArray[Any]:
    """An array (..., H, W) over ``inside`` with zeros around it up to ``box``."""
    rows, columns = _place(inside, box)
    framed = np.zeros((*values.shape[:-2], box.bottom - box.top, box.right - box.left), values.dtype)
    framed[..., rows, columns] = values
    return framed


def _sub_grid(grid: RasterGrid, box: _Box) -> RasterGrid:
    return grid.crop(box.left, box.top, box.right - box.left, box.bottom - box.top)


def _ratio(source: Source, grid: RasterGrid, crs: str | None) -> tuple[float, float]:
    """Source pixels per target pixel, along x and y; of the whole source, so that all steps resample alike."""
    if same_crs(source.crs, crs):
        return grid.dx / source.grid.dx, abs(grid.dy / source.grid.dy)
    square = source.gsd_m
    return grid.dx / square, abs(grid.dy) / square


def _steps(source: Source, grid: RasterGrid, crs: str | None) -> list[tuple[tuple[slice, slice], RasterGrid]]:
    """The target cut into pieces whose source pixels fit into memory: slices of it, and their grids."""
    across, down = _ratio(source, grid, crs)
    side = int(min(_STEP_PX, max(1.0, np.sqrt(_MAX_STEP_SOURCE_PX / max(across * down, 1e-6)))))
    steps = []
    for row in range(0, grid.height, side):
        for column in range(0, grid.width, side):
            step = grid.crop(column, row, min(side, grid.width - column), min(side, grid.height - row))
            steps.append(((slice(row, row + step.height), slice(column, column + step.width)), step))
    return steps


def _source_box(source: Source, grid: RasterGrid, crs: str | None) -> _Box | None:
    """The source's pixels that take part in ``grid``'s, with a margin; None if they lie elsewhere."""
    u, v = np.linspace(-1.0, grid.width, 9), np.linspace(-1.0, grid.height, 9)
    xy = grid.map_from_px(np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2))
    if crs is not None and source.crs is not None and not same_crs(source.crs, crs):
        xy = np.stack(_way(crs, source.crs).transform(xy[:, 0], xy[:, 1]), axis=-1)
        xy = xy[np.isfinite(xy).all(axis=1)]
        if len(xy) == 0:
            return None
    px = source.grid.px_from_map(xy)
    low, high = px.min(axis=0), px.max(axis=0)
    # Between the points of the lattice the border may bulge: by far less than a hundredth of the whole.
    margin = _MARGIN_PX + 0.01 * (high - low) + 2 * np.array(_ratio(source, grid, crs))
    low, high = np.floor(low - margin), np.ceil(high + margin) + 1
    size = source.grid.width, source.grid.height
    if high[0] <= 0 or high[1] <= 0 or low[0] >= size[0] or low[1] >= size[1]:
        return None
    # A frame of pixels without data beyond the rim, so that the rim fades like any other.
    pad = margin + 1
    low, high = np.maximum(low, -pad), np.minimum(high, np.array(size) + pad)
    return _Box(int(np.floor(low[1])), int(np.ceil(high[1])), int(np.floor(low[0])), int(np.ceil(high[0])))


def _warped(
    values: Float32Array, valid: BoolArray, source_grid: RasterGrid, source: Source, grid: RasterGrid, crs: str | None
) -> tuple[Float32Array, Float32Array, Float32Array]:
    """Bands (K, h, w) with their validity (h, w) to ``grid``.

    Values are weighted by validity before, and divided by what is left of the weights after: no data takes no part.
    Returns: bands (K, H, W), the share (H, W) of valid pixels in each kernel, and (H, W) of the source's pixel at
    each centre its first band plus one, 0 where that is not valid.
    """
    across, down = _ratio(source, grid, crs)
    method = Resampling.average if max(across, down) > _AVERAGE_FROM else Resampling.bilinear
    scales = [1.0 if abs(ratio - 1.0) <= _SAME_SCALE or ratio < 1.0 else 1.0 / ratio for ratio in (across, down)]
    # With one system for both nothing moves, whichever it is; local metres have none.
    target_crs = source.crs if same_crs(source.crs, crs) else crs
    transforms = {
        "src_transform": _affine(source_grid),
        "dst_transform": _affine(grid),
        "src_crs": _gdal_crs(source.crs or _ANY_CRS),
        "dst_crs": _gdal_crs(target_crs or _ANY_CRS),
    }
    weights = valid.astype(np.float32)[None]
    weighted = np.concatenate([np.where(valid, values, np.float32(0)), weights])
    out = np.zeros((len(weighted), grid.height, grid.width), np.float32)
    # GDAL derives the kernel's width anew for each piece, which shows as seams between them.
    reproject(weighted, out, resampling=method, XSCALE=scales[0], YSCALE=scales[1], **transforms)
    centre = np.zeros((1, grid.height, grid.width), np.float32)
    reproject((values[:1] + 1) * weights, centre, resampling=Resampling.nearest, XSCALE=1, YSCALE=1, **transforms)
    share = out[-1]
    with np.errstate(divide="ignore", invalid="ignore"):
        bands = np.where(share > 1e-6, out[:-1] / share, np.float32(0))
    return bands.astype(np.float32), share, centre[0]


def _affine(grid: RasterGrid) -> Affine:
    return Affine(grid.dx, 0.0, grid.west, 0.0, grid.dy, grid.top)
