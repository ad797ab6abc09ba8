"""Whether the surface model lies under the orthophoto: a check of finished packs, since grids off by half a pixel,
a datum or a whole tile look well in every other respect.

What both show are edges: roofs, crowns, banks. Their directions are compared (not their strengths or signs: a roof
may be brighter or darker than its street), patch by patch, over shifts of some cells; the correlations of all
patches are added before the peak is sought, so that many weak patches speak together and a field stays silent.
Shadows and slopes in the light pull by one or two decimetres, which the sigma includes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Final, NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from ortholoc_edge.errors import MapError
from ortholoc_edge.geometry.arrays import BoolArray, Float32Array, FloatArray
from ortholoc_edge.tiles.lattice import Bounds
from ortholoc_edge.tiles.manifest import Alignment, DsmTile
from ortholoc_edge.tiles.store import MapStore
from ortholoc_edge.tiles.window import MapWindow

# Cells: searched to each side, compared per patch, patches per side of a chunk that is read at once.
RADIUS: Final = 12
_CORE: Final = 64
_CHUNK: Final = 4
_MAX_CHUNKS: Final = 24
# Levels of the surface model that are tried. Fine ones of photogrammetry are noise; coarse ones miss little shifts.
_LEVELS: Final = 3
_MIN_VALID: Final = 0.5
# Of the added correlations: peak over their scatter elsewhere. Of what does not fit, the highest reach 3.3.
_MIN_SIGNIFICANCE: Final = 4.5
_MIN_SAMPLES: Final = 6
_MAX_SCATTER_CELLS: Final = 0.6
# Shadows and shading: of the cell, and m.
_FLOOR_CELLS, _FLOOR_M = 0.2, 0.1
_WARN_SIGMAS: Final = 2.0
_WARN_CELLS: Final = 0.4
# Grey levels per pixel from which an orthophoto's edge counts, and heights in m per cell.
_GREY_KNEE, _HEIGHT_KNEE_M = 8.0, 0.02
_GROUPS: Final = 10
# Of a source that lies elsewhere: its fit at its place, and at the other.
_MAX_OWN, _MIN_OTHER = 3.5, 6.0
_SOURCE_SIDES_M: Final = (1000.0, 2000.0)
_MAX_SUSPECTS: Final = 40

_ComplexArray = npt.NDArray[np.complex64]


class Peak(NamedTuple):
    """``east`` and ``south``: where, in cells; ``significance``: of the height over the scatter elsewhere."""

    east: float
    south: float
    significance: float


def measure(store: MapStore) -> Alignment | None:
    """How far the surface model must be moved to lie on the orthophoto; None if too few edges agree.

    Reads chunks spread over the tiles of ``store``. Shifts beyond `RADIUS` cells of a level are not found by it.
    """
    best: Alignment | None = None
    for grid in store.dsm_grids[:_LEVELS]:
        surfaces: list[Float32Array] = []
        for bounds in _chunks(store, grid.gsd_m):
            window = _read(store, bounds, grid.gsd_m)
            if window is not None:
                surfaces += correlations(window)
        found = consensus(surfaces, grid.gsd_m)
        if found is not None and (best is None or found.sigma_m < best.sigma_m):
            best = found
    return best


def warnings(alignment: Alignment | None, dsm_pixel_m: float) -> list[str]:
    """What a person should know of it; empty if it is well or not known."""
    if alignment is None:
        return []
    shift_m = math.hypot(alignment.east_m, alignment.north_m)
    limit_m = max(_WARN_SIGMAS * alignment.sigma_m, _WARN_CELLS * dsm_pixel_m)
    if shift_m <= limit_m:
        return []
    return [
        f"the DSM seems to lie {shift_m:.2f} m ({shift_m / dsm_pixel_m:.1f} of its cells) off the DOP: its edges fit"
        f" best moved by {alignment.east_m:+.2f} m east and {alignment.north_m:+.2f} m north (sigma"
        f" {alignment.sigma_m:.2f} m, {alignment.samples} places); shadows alone pull it north by up to"
        " half a metre; beyond that check the origin of its grid (pixel centre or corner) and the reference systems"
    ]


def misplaced(store: MapStore) -> list[str]:
    """Sources of the surface model that fit the orthophoto a whole tile or kilometre off, and not at their place."""
    manifest = store.pack.manifest
    cell_m = next((g.gsd_m for g in store.dsm_grids if g.gsd_m >= 0.5), store.dsm_grids[-1].gsd_m)
    lattice = manifest.dsm.lattice
    sides_m = sorted({lattice.tile_px * lattice.pixel_m, *_SOURCE_SIDES_M})
    problems, suspects = [], 0
    for index, source in enumerate(manifest.dsm.sources):
        tiles = [tile for tile in manifest.dsm.tiles if tile.sources[:1] == (index,)]
        if not tiles or suspects == _MAX_SUSPECTS:
            continue
        bounds = _middle(store, max(tiles, key=lambda tile: tile.valid_fraction), cell_m)
        window = _read(store, bounds, cell_m)
        own = None if window is None else _fit(correlations(window))
        if window is None or own is None or own >= _MAX_OWN:
            continue
        suspects += 1
        best = (_MIN_OTHER, 0.0, 0.0)
        for side_m in sides_m:
            for east, north in ((e, n) for n in (1, 0, -1) for e in (-1, 0, 1) if e or n):
                offset = (east * side_m, north * side_m)
                other = _fit(correlations(window, _read_dop(store, window, offset)))
                if other is not None and other > best[0]:
                    best = (other, *offset)
        if best[0] > _MIN_OTHER:
            problems.append(
                f"DSM source {source.name}: does not fit the DOP where it lies, but fits {abs(best[1]):.0f} m"
                f" {'east' if best[1] >= 0 else 'west'} and {abs(best[2]):.0f} m {'north' if best[2] >= 0 else 'south'}"
                " of there; check its georeference and whether files were swapped"
            )
    return problems


def correlations(window: MapWindow, dop: tuple[Float32Array, BoolArray] | None = None) -> list[Float32Array]:
    """Of each patch of a window the correlation (2 RADIUS + 1,) x 2 over shifts south and east of the DSM, in cells.

    Args:
        dop: grey and validity on the DSM's grid, instead of the window's own.
    """
    heights, known = window.dsm, np.isfinite(window.dsm)
    if not known.any():
        return []
    grey, seen = _on_dsm_grid(window) if dop is None else dop
    surface = np.where(known, heights, np.median(heights[known])).astype(np.float32)
    side = _CORE + 2 * RADIUS
    found = []
    for row in range(0, heights.shape[0] - side + 1, _CORE):
        for column in range(0, heights.shape[1] - side + 1, _CORE):
            part = np.s_[row : row + side, column : column + side]
            if float((known[part] & seen[part]).mean()) < _MIN_VALID:
                continue
            edges = _directions(surface[part], known[part], _HEIGHT_KNEE_M, relative=True)
            found_here = _correlation(edges, _directions(grey[part], seen[part], _GREY_KNEE, relative=False))
            if found_here is not None:
                found.append(found_here)
    return found


def consensus(surfaces: Sequence[Float32Array], cell_m: float) -> Alignment | None:
    """The shift that patches agree on, from their `correlations`; None if they do not."""
    if len(surfaces) < _MIN_SAMPLES:
        return None
    stack = np.stack(surfaces)
    peak = find_peak(stack.mean(axis=0))
    if peak is None or peak.significance < _MIN_SIGNIFICANCE:
        return None
    # Jackknife over groups of patches from all over the pack.
    total, parts = stack.sum(axis=0, dtype=np.float64), []
    groups = min(_GROUPS, len(stack))
    for group in range(groups):
        without = find_peak(total - stack[group::groups].sum(axis=0, dtype=np.float64))
        if without is None:
            return None
        parts.append(without[:2])
    spread = np.asarray(parts) - np.mean(parts, axis=0)
    scatter = np.sqrt((groups - 1) / groups * np.square(spread).sum(axis=0))
    row, column = RADIUS + round(peak.south), RADIUS + round(peak.east)
    near = stack[:, row - 1 : row + 2, column - 1 : column + 2].max(axis=(1, 2))
    middle = np.median(stack, axis=(1, 2))
    deviation = 1.4826 * np.median(np.abs(stack - middle[:, None, None]), axis=(1, 2))
    samples = int(np.count_nonzero(near - middle > 2.0 * deviation))
    if scatter.max() > _MAX_SCATTER_CELLS or samples < _MIN_SAMPLES:
        return None
    sigma_m = math.hypot(float(scatter.max()) * cell_m, _FLOOR_CELLS * cell_m, _FLOOR_M)
    return Alignment(
        east_m=round(peak.east * cell_m, 3),
        north_m=round(-peak.south * cell_m, 3),
        sigma_m=round(sigma_m, 3),
        samples=samples,
    )


def find_peak(surface: npt.NDArray[np.floating]) -> Peak | None:
    """Highest point of a correlation (2 RADIUS + 1,) x 2, below a cell; None at its border."""
    row, column = (int(k) for k in np.unravel_index(int(np.argmax(surface)), surface.shape))
    if not (0 < row < 2 * RADIUS and 0 < column < 2 * RADIUS):
        return None
    v, u = np.mgrid[: 2 * RADIUS + 1, : 2 * RADIUS + 1]
    elsewhere = surface[np.hypot(v - row, u - column) > 3.0]
    middle = float(np.median(elsewhere))
    scatter = 1.4826 * float(np.median(np.abs(elsewhere - middle)))
    if scatter <= 0.0:
        return None
    near = surface[row - 1 : row + 2, column - 1 : column + 2].astype(np.float64)
    slope = np.array([near[1, 2] - near[1, 0], near[2, 1] - near[0, 1]]) / 2.0
    mixed = (near[2, 2] - near[2, 0] - near[0, 2] + near[0, 0]) / 4.0
    bend = np.array(
        [
            [near[1, 2] - 2.0 * near[1, 1] + near[1, 0], mixed],
            [mixed, near[2, 1] - 2.0 * near[1, 1] + near[0, 1]],
        ]
    )
    if not (bend[0, 0] < 0.0 and np.linalg.det(bend) > 0.0):
        return None
    east, south = np.clip(-np.linalg.solve(bend, slope), -1.0, 1.0)
    return Peak(
        column - RADIUS + float(east),
        row - RADIUS + float(south),
        (float(surface[row, column]) - middle) / scatter,
    )


def _fit(surfaces: Sequence[Float32Array]) -> float | None:
    """Significance of a peak within two cells of no shift; None without patches."""
    if not surfaces:
        return None
    total = np.mean(surfaces, axis=0)
    v, u = np.mgrid[-RADIUS : RADIUS + 1, -RADIUS : RADIUS + 1]
    here = np.hypot(u, v) <= 2.0
    elsewhere = total[np.hypot(u, v) > 5.0]
    middle = float(np.median(elsewhere))
    scatter = 1.4826 * float(np.median(np.abs(elsewhere - middle)))
    return (float(total[here].max()) - middle) / scatter if scatter > 0.0 else None


def _chunks(store: MapStore, cell_m: float) -> list[Bounds]:
    """Squares of `_CHUNK` x `_CHUNK` patches, spread over the tiles of the surface model."""
    side_m = (_CHUNK * _CORE + 2 * RADIUS) * cell_m
    manifest = store.pack.manifest
    places = []
    for tile in manifest.dsm.tiles:
        west, south, east, north = manifest.dsm.lattice.grid(tile.box).bounds
        for y in np.arange(north, south, -side_m):
            places += [
                (float(x), float(y) - side_m, float(x) + side_m, float(y)) for x in np.arange(west, east, side_m)
            ]
    step = -(-len(places) // _MAX_CHUNKS)
    return places[step // 2 :: step] if places else []


def _middle(store: MapStore, tile: DsmTile, cell_m: float) -> Bounds:
    west, south, east, north = store.pack.manifest.dsm.lattice.grid(tile.box).bounds
    half_m = 0.5 * (_CHUNK * _CORE + 2 * RADIUS) * cell_m
    x, y = (west + east) / 2, (south + north) / 2
    return x - half_m, y - half_m, x + half_m, y + half_m


def _read(store: MapStore, bounds: Bounds, cell_m: float) -> MapWindow | None:
    """A window with cells of ``cell_m`` and orthophoto pixels no larger."""
    try:
        return store.read(bounds, cell_m / math.sqrt(2.0), cell_m)
    except MapError:
        # More pixels than a read may give: an orthophoto far finer than the surface model and without overviews.
        return None


def _read_dop(store: MapStore, window: MapWindow, offset_m: tuple[float, float]) -> tuple[Float32Array, BoolArray]:
    """Grey and validity of the orthophoto as it would lie under the window, were that moved by ``offset_m``."""
    grid = window.dsm_grid
    empty = np.zeros(window.dsm.shape, dtype=np.float32), np.zeros(window.dsm.shape, dtype=bool)
    west, south, east, north = grid.bounds
    moved = (west + offset_m[0], south + offset_m[1], east + offset_m[0], north + offset_m[1])
    there = _read(store, moved, grid.gsd_m)
    if there is None:
        return empty
    return _resampled(there, grid.map_from_px([(0.0, 0.0)])[0] + offset_m, grid.gsd_m, window.dsm.shape)


def _on_dsm_grid(window: MapWindow) -> tuple[Float32Array, BoolArray]:
    grid = window.dsm_grid
    return _resampled(window, grid.map_from_px([(0.0, 0.0)])[0], grid.gsd_m, window.dsm.shape)


def _resampled(
    window: MapWindow, first_map: FloatArray, cell_m: float, shape: tuple[int, ...]
) -> tuple[Float32Array, BoolArray]:
    """The window's orthophoto in grey, and where it is, on cells of which the first's centre is at ``first_map``."""
    ratio = cell_m / window.dop_grid.gsd_m
    grey: npt.NDArray[Any] = window.dop_grey.astype(np.float32)
    if ratio > 1.0:
        # Twice this is a pixel of the result: enough against moire, and no shift.
        grey = cv2.GaussianBlur(grey, (0, 0), 0.4 * ratio)
    u, v = window.dop_grid.px_from_map(first_map)
    transform = np.array([[ratio, 0.0, u], [0.0, ratio, v]])
    size = (shape[1], shape[0])
    onto = cv2.warpAffine(grey, transform, size, flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
    seen = cv2.warpAffine(
        window.dop_valid.astype(np.uint8), transform, size, flags=cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP
    )
    return np.asarray(onto, dtype=np.float32), seen.astype(bool)


def _directions(image: Float32Array, valid: BoolArray, knee: float, *, relative: bool) -> _ComplexArray:
    """Edge directions (H, W) as complex numbers of twice their angle, so that opposite signs are equal.

    Their lengths run from 0 to 1, half at ``knee`` (with ``relative``, at the strongest twentieth if that is more).
    0 where filters see what is not valid; the mean is taken off, or overlap alone would correlate.
    """
    smooth = cv2.GaussianBlur(image, (0, 0), 0.7)
    x = cv2.Sobel(smooth, cv2.CV_32F, 1, 0, scale=1 / 8)
    y = cv2.Sobel(smooth, cv2.CV_32F, 0, 1, scale=1 / 8)
    usable = cv2.erode(valid.astype(np.uint8), np.ones((7, 7), np.uint8)).astype(bool)
    directions = np.zeros(image.shape, dtype=np.complex64)
    if not usable.any():
        return directions
    strength = np.hypot(x, y)
    if relative:
        knee = max(knee, float(np.percentile(strength[usable], 95)))
    gradient = (x + 1j * y)[usable]
    weight = np.maximum(strength[usable], 1e-9)
    directions[usable] = gradient**2 / (weight * (weight + knee))
    directions[usable] -= directions[usable].mean()
    return directions


def _correlation(surface: _ComplexArray, photo: _ComplexArray) -> Float32Array | None:
    """Correlation of the surface's middle with the photo over shifts; None where either shows nothing."""
    middle = np.zeros_like(surface)
    inside = np.s_[RADIUS:-RADIUS, RADIUS:-RADIUS]
    middle[inside] = surface[inside]
    norm = float(np.linalg.norm(middle)) * float(np.linalg.norm(photo))
    if norm <= 0.0:
        return None
    product = np.fft.ifft2(np.conj(np.fft.fft2(middle)) * np.fft.fft2(photo)).real
    # Shifts of -RADIUS to RADIUS; what wraps around meets the rim, which is zero.
    wrapped = np.roll(product, (RADIUS, RADIUS), axis=(0, 1))[: 2 * RADIUS + 1, : 2 * RADIUS + 1]
    return (wrapped / norm).astype(np.float32)
