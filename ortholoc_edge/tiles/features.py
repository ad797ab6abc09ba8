"""Features of the orthophoto, extracted when a pack is built, so that no network has to look at the map in flight.

Of one tile of the DOP: records of a position and 64 bits of descriptor, for pictures of the tile at `SCALES`. The
finest is twice as fine as the orthophoto: interpolated, it holds nothing new, but a camera lower than the orthophoto's
pixels would ask for sees more in its frame than fits them, and matching that on the coarse grid loses half of it.
"""

from __future__ import annotations

import functools
import io
import math
import tokenize
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import resources
from typing import Final

import cv2
import numpy as np
import numpy.typing as npt

from ortholoc_edge.errors import MapError
from ortholoc_edge.geometry.arrays import BoolArray, Float32Array, FloatArray, ImageArray, IntArray
from ortholoc_edge.geometry.grid import RasterGrid
from ortholoc_edge.matching import models
from ortholoc_edge.matching.contrast import even_contrast
from ortholoc_edge.matching.types import Matcher, UnscaledMatcher
from ortholoc_edge.tiles.lattice import LEVELS, Bounds
from ortholoc_edge.tiles.manifest import FeatureTile
from ortholoc_edge.tiles.store import MapStore

MATCHERS: Final = ("xfeat",)
# Names the principal axes of `data/xfeat_basis.npz` (made by tests/tiles/make_xfeat_basis.py), how many bits each has,
# and the scales: raise the last number when one of them changes.
ENCODING: Final = "xfeat-pca64-1"
# What the builder's matcher is made with. Windows have this side, so that nothing is scaled.
WORKING_PX: Final = 640
MAX_KEYPOINTS: Final = 4096
# Kept per million pixels of each scale: at 20 cm 2.0 MB per km2 (docs/benchmarks.md).
PER_MPX: Final = 1250.0
# Pixels of the pictures in pixels of the DOP.
SCALES: Final = (0.5, *(float(2**k) for k in range(LEVELS)))

# Positions count 1/8 px of their scale, from the tile's corner: 16 bits reach 8192 px.
_STEPS_PER_PX: Final = 8
_BITS: Final = 64
RECORD: Final = np.dtype([("x", "<u2"), ("y", "<u2"), ("code", "u1", (_BITS // 8,))])
# Records of a scale are sorted by strips of this height, then from west to east.
_STRIP_PX: Final = 64
# Context of a window's features beyond the part that they are taken from. Of 32, 64 and 96 px the widest gives a fifth
# more inliers than the narrowest: the network's view reaches far, and a window's rim shows in it.
_MARGIN_PX: Final = 96
_STEP_PX: Final = WORKING_PX - 2 * _MARGIN_PX
# Beyond the window, for `even_contrast` to have the same neighbourhood in every window: three of its sigmas.
_CONTRAST_PX: Final = 96

# Max (1960): outputs of the best quantisers of a normal variable with 1 to 4 bits, their upper halves, and the
# variance that each leaves.
_QUANTISERS: Final = (
    (0.7979,),
    (0.4528, 1.5104),
    (0.2451, 0.7560, 1.3439, 2.1520),
    (0.1284, 0.3881, 0.6568, 0.9424, 1.2562, 1.6181, 2.0690, 2.7326),
)
_LEFT: Final = (1.0, 0.3634, 0.1175, 0.03454, 0.009497)


def model_of(matcher: str) -> str:
    """SHA-256 of the graph that a matcher of `MATCHERS` runs, built first if it is not there. Raises: ModelError."""
    return models.ensure(matcher).sha256


def bytes_per_mpx(per_mpx: float) -> float:
    """Of features per million pixels of DOP, all scales together."""
    return per_mpx * RECORD.itemsize * sum(scale**-2 for scale in SCALES)


# -- descriptors -----------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class _Codec:
    """Descriptors as bits: turned onto principal axes, each quantised on its own, the wide ones finer.

    Attributes:
        mean: (64,); axes: (A, 64), scaled by their deviations; those without a bit are left out.
        bits: (A,) of each axis.
        outputs: values of all axes' codes, and first: (A,) where each axis' begin.
        weights: (64, A): bits to codes.
    """

    mean: Float32Array
    axes: Float32Array
    deviation: Float32Array
    bits: IntArray
    outputs: Float32Array
    first: IntArray
    weights: Float32Array

    def encode(self, descriptors: Float32Array) -> npt.NDArray[np.uint8]:
        """(N, 8) of unit descriptors (N, 64)."""
        values = (descriptors - self.mean) @ self.axes.T / self.deviation
        bits = np.empty((len(values), _BITS), np.uint8)
        column = 0
        for axis, count in enumerate(self.bits):
            outputs = self.outputs[self.first[axis] : self.first[axis] + 2**count]
            code = np.searchsorted((outputs[1:] + outputs[:-1]) / 2, values[:, axis])
            for bit in range(count):
                bits[:, column] = (code >> bit) & 1
                column += 1
        return np.packbits(bits, axis=1)

    def decode(self, codes: npt.NDArray[np.uint8]) -> Float32Array:
        """Unit descriptors (N, 64)."""
        bits = np.unpackbits(codes, axis=1).astype(np.float32)
        values = self.outputs[(bits @ self.weights).astype(np.intp) + self.first]
        descriptors = (values * self.deviation) @ self.axes + self.mean
        length = np.sqrt(np.einsum("nc,nc->n", descriptors, descriptors))
        descriptors /= np.maximum(length, np.float32(1e-12))[:, None]
        return np.asarray(descriptors, dtype=np.float32)


@functools.cache
def _codec() -> _Codec:
    with resources.files("ortholoc_edge.tiles").joinpath("data/xfeat_basis.npz").open("rb") as file:
        basis = np.load(file, allow_pickle=False)
        mean, axes, deviation = (basis[name] for name in ("mean", "axes", "deviation"))
    # A bit at a time to the axis where it helps most.
    bits = np.zeros(len(deviation), np.intp)
    gain = np.array([(a - b) for a, b in zip(_LEFT, (*_LEFT[1:], 1.0), strict=True)])
    for _ in range(_BITS):
        bits[np.argmax(deviation.astype(np.float64) ** 2 * gain[bits])] += 1
    used = np.flatnonzero(bits)
    bits = bits[used]
    outputs = [np.concatenate([-np.array(_QUANTISERS[b - 1])[::-1], _QUANTISERS[b - 1]]) for b in bits]
    weights = np.zeros((_BITS, len(used)), np.float32)
    weights[np.arange(_BITS), np.repeat(np.arange(len(used)), bits)] = np.concatenate(
        [2.0 ** np.arange(b) for b in bits]
    )
    return _Codec(
        mean,
        axes[used],
        deviation[used],
        bits,
        np.concatenate(outputs).astype(np.float32),
        np.cumsum([0, *(2**b for b in bits[:-1])]).astype(np.intp),
        weights,
    )


# -- building --------------------------------------------------------------------------------------------------


def extract_tile(
    levels: Sequence[tuple[ImageArray, BoolArray]], matcher: UnscaledMatcher, per_mpx: float
) -> tuple[bytes, tuple[int, ...]]:
    """Features of one tile of the DOP.

    They keep 8 px from the tile's rim, since what lies beyond is not known here.

    Args:
        levels: of the tile, from full resolution on: (H, W) uint8 grey and where it is valid.
        matcher: of `WORKING_PX` and `MAX_KEYPOINTS`.
        per_mpx: to keep per million valid pixels of each scale, the best of each neighbourhood.
    Returns: the file's bytes, empty if nothing was found, and the counts by scale.
    Raises: MapError for a tile too large for 16-bit positions; ModelError.
    """
    rows, columns = levels[0][0].shape
    if max(rows, columns) / SCALES[0] * _STEPS_PER_PX > 2**16:
        raise MapError(f"DOP tile of {columns} x {rows} px: features can be stored of at most 4096 px")
    parts = []
    for scale in SCALES[: len(levels) + 1]:
        grey, valid = levels[max(round(math.log2(scale)), 0)]
        parts.append(_records(grey, valid, 2 if scale < 1.0 else 1, matcher, per_mpx))
    counts = tuple(len(part) for part in parts)
    if not sum(counts):
        return b"", counts
    file = io.BytesIO()
    np.lib.format.write_array(file, np.concatenate(parts), version=(1, 0), allow_pickle=False)
    return file.getvalue(), counts


def _records(
    grey: ImageArray, valid: BoolArray, enlarge: int, matcher: UnscaledMatcher, per_mpx: float
) -> npt.NDArray[np.void]:
    """Sorted records of one scale."""
    positions, scores, descriptors = [np.empty((0, 2))], [np.empty(0, np.float32)], [np.empty((0, 64), np.float32)]
    height, width = (side * enlarge for side in grey.shape)
    for row in range(0, height, _STEP_PX):
        for column in range(0, width, _STEP_PX):
            image, seen = _window(grey, valid, enlarge, column - _MARGIN_PX, row - _MARGIN_PX)
            if not seen[_MARGIN_PX:-_MARGIN_PX, _MARGIN_PX:-_MARGIN_PX].any():
                continue
            found = matcher.extract_unscaled(image, seen)
            own = found.keypoints_px - _MARGIN_PX
            kept = ((own >= -0.5) & (own < _STEP_PX - 0.5)).all(axis=1)
            positions.append(own[kept] + (column, row))
            scores.append(found.scores[kept])
            descriptors.append(found.descriptors[kept])
    steps = np.floor((np.concatenate(positions) + 0.5) * _STEPS_PER_PX)
    xy = np.clip(steps, 0, 2**16 - 1).astype(np.uint16)
    limit = round(per_mpx * 1e-6 * np.count_nonzero(valid) * enlarge**2)
    best = _spread(xy, np.concatenate(scores), limit, math.sqrt(1e6 / per_mpx))
    order = best[np.lexsort((xy[best, 1], xy[best, 0], xy[best, 1] // (_STRIP_PX * _STEPS_PER_PX)))]
    records = np.empty(len(order), RECORD)
    records["x"], records["y"] = xy[order].T
    records["code"] = _codec().encode(np.concatenate(descriptors)[order])
    return records


def _window(grey: ImageArray, valid: BoolArray, enlarge: int, column: int, row: int) -> tuple[ImageArray, BoolArray]:
    """The square of `WORKING_PX` at (column, row) of the scale, its contrast evened; invalid beyond the tile."""
    side = (WORKING_PX + 2 * _CONTRAST_PX) // enlarge
    left, top = (column - _CONTRAST_PX) // enlarge, (row - _CONTRAST_PX) // enlarge
    image, seen = np.zeros((side, side), np.uint8), np.zeros((side, side), np.bool_)
    rows = slice(max(top, 0), min(top + side, grey.shape[0]))
    columns = slice(max(left, 0), min(left + side, grey.shape[1]))
    place = slice(rows.start - top, rows.stop - top), slice(columns.start - left, columns.stop - left)
    image[place], seen[place] = grey[rows, columns], valid[rows, columns]
    if enlarge > 1:
        # The nearest valid pixel's grey does not bleed in: the matcher keeps off the rim of what is valid.
        image = np.asarray(cv2.resize(image, None, fx=enlarge, fy=enlarge, interpolation=cv2.INTER_LINEAR), np.uint8)
        seen = np.repeat(np.repeat(seen, enlarge, axis=0), enlarge, axis=1)
    inner = slice(_CONTRAST_PX, _CONTRAST_PX + WORKING_PX)
    even = even_contrast(image, seen)[inner, inner]
    return np.ascontiguousarray(even), np.ascontiguousarray(seen[inner, inner])


def _spread(xy: npt.NDArray[np.uint16], scores: Float32Array, limit: int, cell_px: float) -> IntArray:
    """Indices of at most ``limit`` features: the best of every cell, then every second best, and so on."""
    cell = (xy / (cell_px * _STEPS_PER_PX)).astype(np.int64)
    key = cell[:, 1] << 32 | cell[:, 0]
    order = np.lexsort((xy[:, 0], xy[:, 1], -scores, key))
    _, first, size = np.unique(key[order], return_index=True, return_counts=True)
    rank = np.arange(len(order)) - np.repeat(first, size)
    return order[np.lexsort((-scores[order], rank))[:limit]]


# -- flying ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class StoredFeatures:
    """Features of a region, still packed.

    Attributes:
        px: (N, 2) float64, pixels of the scale's grid, centres at integers.
        codes: (N, 8).
    """

    px: FloatArray
    codes: npt.NDArray[np.uint8]

    def take(self, kept: npt.NDArray[np.bool_] | IntArray) -> StoredFeatures:
        """Those at indices (or under a mask) ``kept``."""
        return StoredFeatures(self.px[kept], self.codes[kept])

    def descriptors(self) -> Float32Array:
        """(N, 64) unit."""
        return _codec().decode(self.codes)


@dataclass(frozen=True, slots=True, eq=False)
class _Loaded:
    """One tile: where it is in pixels of the DOP's box, its records by scale, and where their strips begin."""

    column: int
    row: int
    records: tuple[npt.NDArray[np.void], ...]
    strips: tuple[IntArray, ...]


class FeatureIndex:
    """A pack's precomputed features by region. Unchanging, so any thread may read.

    Attributes:
        grids: of the scales, finest first, over the DOP's bounds.
    """

    def __init__(self, store: MapStore, matcher: Matcher) -> None:
        """
        Args:
            store: that holds the features' bytes.
            matcher: that they are to be matched with.
        Raises: MapError if the pack has none, or of another matcher, model or encoding, or a file is no such.
        """
        layer, path = store.pack.manifest.features, store.pack.path
        if layer is None:
            raise MapError(f"{path}: has no precomputed features; build it with --features {matcher.name}")
        remedy = f"rebuild it with --features {matcher.name}"
        if layer.matcher != matcher.name or layer.model_sha256 != matcher.model_sha256:
            raise MapError(
                f"{path}: its features are of {layer.matcher}, model {layer.model_sha256[:12]}; the matcher is"
                f" {matcher.name}, model {(matcher.model_sha256 or 'none')[:12]}; {remedy}"
            )
        if layer.encoding != ENCODING or not isinstance(matcher, UnscaledMatcher):
            raise MapError(f"{path}: its features are encoded as {layer.encoding}, not {ENCODING}; {remedy}")
        full = store.dop_grids[0]
        lattice, dop = store.pack.manifest.dop.lattice, store.pack.manifest.dop
        self.grids = tuple(
            RasterGrid(
                math.ceil(full.width / scale), math.ceil(full.height / scale), full.west, full.top,
                full.dx * scale, full.dy * scale,
            )
            for scale in SCALES[: lattice.levels + 1]
        )  # fmt: skip
        west, top = min(t.column for t in dop.tiles), min(t.row for t in dop.tiles)
        self._tile_px = lattice.tile_px
        self._corner = west, top
        self._tiles: dict[tuple[int, int], _Loaded] = {}
        for tile in layer.tiles:
            data = store.feature_bytes(tile.dop)
            if data is None:
                continue
            place = dop.tiles[tile.dop]
            if tile.dop_sha256 != place.sha256:
                raise MapError(f"{path / tile.file}: features of another orthophoto than {place.file}; {remedy}")
            records = _unpacked(data, tile, len(self.grids), f"{path / tile.file}", remedy)
            strip = _STRIP_PX * _STEPS_PER_PX
            strips = tuple(
                np.searchsorted(part["y"] // strip, np.arange(2**16 // strip + 1)).astype(np.intp) for part in records
            )
            key = lattice.tile_key(place.column, place.row)
            self._tiles[key] = _Loaded(place.column - west, place.row - top, records, strips)
        # Its file is read here: none is opened in flight.
        _codec()
        if not self._tiles:
            raise MapError(f"{path}: its features are damaged, or the store was not asked to hold them; copy it again")

    def scale_for(self, gsd_m: float) -> int:
        """Index of the coarsest scale that is no coarser than ``gsd_m``; the finest if none is. On a grid coarser than
        the frame much of what it shows is lost."""
        fitting = [k for k, grid in enumerate(self.grids) if grid.gsd_m <= gsd_m]
        return fitting[-1] if fitting else 0

    def read(self, bounds_map: Bounds, scale: int) -> StoredFeatures:
        """The features in a region, at one scale; none where there is no map."""
        west, south, east, north = bounds_map
        low = self.grids[scale].px_from_map((west, north))
        high = self.grids[scale].px_from_map((east, south))
        factor = SCALES[scale]
        # In pixels of the full resolution, to find the tiles.
        first, last = (np.floor(((px + 0.5) * factor + self._corner) / self._tile_px).astype(int) for px in (low, high))
        pixels, codes = [np.empty((0, 2))], [np.empty((0, _BITS // 8), np.uint8)]
        for key in self._near(first, last):
            tile = self._tiles[key]
            corner = np.array([tile.column, tile.row]) / factor
            begin, end = ((px + 0.5 - corner) * _STEPS_PER_PX for px in (low, high))
            strip = _STRIP_PX * _STEPS_PER_PX
            upper, lower = (int(np.clip(v // strip, 0, 2**16 // strip - 1)) for v in (begin[1], end[1]))
            offsets = tile.strips[scale]
            records = tile.records[scale][offsets[upper] : offsets[lower + 1]]
            x, y = records["x"].astype(np.float64), records["y"].astype(np.float64)
            inside = (x >= begin[0] - 1) & (x <= end[0]) & (y >= begin[1] - 1) & (y <= end[1])
            steps = np.stack([x[inside], y[inside]], axis=1)
            pixels.append((steps + 0.5) / _STEPS_PER_PX - 0.5 + corner)
            codes.append(records["code"][inside])
        return StoredFeatures(np.concatenate(pixels), np.concatenate(codes))

    def _near(self, first: IntArray, last: IntArray) -> list[tuple[int, int]]:
        """Keys of the loaded tiles among a range of them, in the order of the range, or of the tiles if they are
        fewer."""
        if np.prod((last - first + 1).astype(np.float64)) > len(self._tiles):
            return [key for key in self._tiles if (first <= key).all() and (key <= last).all()]
        keys = [(c, r) for r in range(first[1], last[1] + 1) for c in range(first[0], last[0] + 1)]
        return [key for key in keys if key in self._tiles]


def _unpacked(data: bytes, tile: FeatureTile, scales: int, name: str, remedy: str) -> tuple[npt.NDArray[np.void], ...]:
    """Records by scale, without a copy. Raises: MapError."""
    file = io.BytesIO(data)
    try:
        version = np.lib.format.read_magic(file)
        shape, _, dtype = np.lib.format.read_array_header_1_0(file)
        records = np.frombuffer(data, RECORD, offset=file.tell())
    except (ValueError, SyntaxError, tokenize.TokenError) as err:  # NumPy reads a header as an expression of Python's
        raise MapError(f"{name}: no features ({err}); {remedy}") from err
    if version != (1, 0) or dtype != RECORD or shape != records.shape:
        raise MapError(f"{name}: {shape} of {dtype}, expected {len(records)} of {RECORD}; {remedy}")
    if len(tile.counts) != scales or sum(tile.counts) != len(records):
        raise MapError(f"{name}: {len(records)} features, the manifest counts {tile.counts}; {remedy}")
    ends = np.cumsum(tile.counts)
    parts = tuple(records[end - count : end] for end, count in zip(ends, tile.counts, strict=True))
    for part in parts:
        strips = part["y"] // (_STRIP_PX * _STEPS_PER_PX)
        if (strips[1:] < strips[:-1]).any():
            raise MapError(f"{name}: not in order; {remedy}")
    return parts
