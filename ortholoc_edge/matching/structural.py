"""Displacements between two pictures of the same view by correlating their `orientation` fields.

Template matching on a grid: every patch of the one field is looked for within a radius in the other, by normalised
correlation, to a fraction of a pixel. Products are summed over small cells once and patches are sums of cells, so that
overlapping patches cost nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np

from ortholoc_edge.geometry.arrays import Float32Array, FloatArray

_MIN_ENERGY: Final = 1e-9
_DOUBT: Final = 0.01
# Of `Correlation.contrast`: how far from a shift is beside it.
_BESIDE_PX: Final = 2
_MIN_FOR_CONTRAST: Final = 20
# Pixels that are multiplied at a time.
_BAND_PX: Final = 49152
# Shifts by one pixel, counted from (-1, -1), at which a patch is compared with itself: none, right, below, and along
# either diagonal. Left and above are the same again, but for the patch's rim.
_OWN_SHIFTS: Final = ((1, 1), (2, 1), (1, 2), (2, 2), (2, 0))


@dataclass(frozen=True, slots=True, eq=False)
class Displacements:
    """Patches of a template found in another field, in pixels of the fields, centres at integers.

    Attributes:
        template_px: (N, 2) middles of the patches.
        shift_px: (N, 2) from there to where they were found.
        score: (N,) normalised correlation, at most 1.
        curvature: (N, 2, 2) how fast it falls around its peak, per px^2; positive definite.
    """

    template_px: FloatArray
    shift_px: FloatArray
    score: FloatArray
    curvature: FloatArray

    def __len__(self) -> int:
        return len(self.score)

    @property
    def covariance(self) -> FloatArray:
        """(N, 2, 2) of the places, px^2, up to a common factor: a sharp and high peak is a sure one."""
        doubt = np.maximum(1.0 - self.score, 0.02) / np.maximum(self.score, 0.02)
        return np.asarray(np.linalg.inv(self.curvature) * (_DOUBT * doubt)[:, None, None], dtype=np.float64)

    def take(self, kept: np.ndarray) -> Displacements:
        """The patches at indices (or under a mask) ``kept``."""
        return Displacements(
            self.template_px[kept], self.shift_px[kept], self.score[kept], self.curvature[kept]
        )


@dataclass(frozen=True, slots=True, eq=False)
class Correlation:
    """How well every patch of a template fits at every shift tried.

    Attributes:
        template_px: (N, 2) middles of the patches, px.
        scores: (D, D, N) normalised correlation by shift in y and x, from -radius to radius around ``origin``.
        origin: (x, y) px.
        own: (5, N) normalised correlation of the patches with themselves at `_OWN_SHIFTS`.
    """

    template_px: FloatArray
    scores: Float32Array
    origin: tuple[int, int]
    own: Float32Array

    @property
    def sharpness(self) -> FloatArray:
        """(N, 2, 2) how fast a patch stops fitting itself, per px^2."""
        return _sharpness(self.own)

    @property
    def radius(self) -> int:
        return len(self.scores) // 2

    def peaks(self) -> Displacements:
        """The patches whose best shift lies inside, and whose score falls to all sides of it."""
        kept, shift, score, curvature = _peaks(self.scores, self.radius)
        return Displacements(self.template_px[kept], shift + self.origin, score, curvature)

    def at(self, shift_px: FloatArray) -> tuple[FloatArray, FloatArray, np.ndarray]:
        """Scores (N,) and their slopes (N, 2) per px at one shift (N, 2) of each patch, by the paraboloid through the
        nearest shifts that were tried; and which (N,) lie inside what was tried. Elsewhere both are 0."""
        place = shift_px - self.origin + self.radius
        nearest = np.round(place)
        inside = np.asarray(((nearest >= 1) & (nearest <= 2 * self.radius - 1)).all(axis=1))
        column, row = np.where(inside[:, None], nearest, self.radius).astype(np.intp).T
        patch = np.arange(len(place))

        def value(dy: int, dx: int) -> FloatArray:
            return np.asarray(self.scores[row + dy, column + dx, patch], dtype=np.float64)

        centre, left, right, above, below = value(0, 0), value(0, -1), value(0, 1), value(-1, 0), value(1, 0)
        slope = 0.5 * np.stack([right - left, below - above], axis=1)
        xx, yy = left + right - 2.0 * centre, above + below - 2.0 * centre
        xy = 0.25 * (value(1, 1) + value(-1, -1) - value(1, -1) - value(-1, 1))
        bend = np.stack([np.stack([xx, xy], axis=1), np.stack([xy, yy], axis=1)], axis=1)
        off = np.where(inside[:, None], place - np.where(inside[:, None], nearest, 0.0), 0.0)
        turned = np.einsum("nij,nj->ni", bend, off)
        score = centre + np.einsum("ni,ni->n", off, slope + 0.5 * turned)
        return np.where(inside, score, 0.0), np.where(inside[:, None], slope + turned, 0.0), inside

    def contrast(self, shift_px: FloatArray, kept: np.ndarray) -> float:
        """How much better patches fit at one shift (N, 2) of each than two pixels and more beside it, in standard
        deviations of the mean: 0 on average where the shifts have nothing to do with the pictures.

        Patches without a peak of their own still know. Their own best shifts tell less: rows and roads give dozens of
        patches a peak that agrees with a wrong pose.

        Args:
            kept: (N,) which patches count; they should share no pixel.
        Returns: 0 for fewer than 20, or where nothing beside was tried (a radius of 1).
        """
        score, _, inside = self.at(shift_px)
        chosen = np.flatnonzero(inside & kept)
        if len(chosen) < _MIN_FOR_CONTRAST or self.radius < _BESIDE_PX:
            return 0.0
        column, row = np.round(shift_px[chosen] - self.origin + self.radius).astype(np.intp).T
        tried = np.arange(2 * self.radius + 1)[:, None]
        beside = (np.abs(tried - row) >= _BESIDE_PX)[:, None] | (np.abs(tried - column) >= _BESIDE_PX)[None]
        around = np.einsum("yxn,yxn->n", self.scores[:, :, chosen], beside) / beside.sum(axis=(0, 1))
        rise = score[chosen] - around
        return float(rise.mean() / (max(float(rise.std()), 1e-6) / np.sqrt(len(rise))))


@dataclass(frozen=True, slots=True, eq=False)
class Products:
    """How two fields go together cell by cell, at every shift tried: what patches of any size are sums of.

    Attributes:
        volume, energy: (S, rows, columns) mean product of template and searched field, and mean square of the latter.
        own: (5, rows, columns) mean products of the template with itself at `_OWN_SHIFTS`.
        cell: side of a cell, px. radius: largest shift along each axis, px; ``origin`` (x, y) is added to all.
    """

    volume: Float32Array
    energy: Float32Array
    own: Float32Array
    cell: int
    radius: int
    origin: tuple[int, int]

    def patches(self, count: int, stride: int = 1) -> Correlation:
        """The correlation of patches of ``count`` x ``count`` cells that begin at every ``stride``-th of them."""
        side = 2 * self.radius + 1
        if min(self.volume.shape[1:]) < count:
            empty = np.empty((side, side, 0), np.float32)
            return Correlation(np.empty((0, 2)), empty, self.origin, np.empty((len(_OWN_SHIFTS), 0), np.float32))
        scores = _patches(self.volume, count, stride)
        self_scores = _patches(self.own, count, stride)
        fixed_energy = np.maximum(self_scores[0], _MIN_ENERGY)
        scores /= np.sqrt(np.maximum(_patches(self.energy, count, stride) * fixed_energy, _MIN_ENERGY))
        down, across = scores.shape[1:]
        middle, step = 0.5 * (count * self.cell - 1), stride * self.cell
        x, y = np.meshgrid(step * np.arange(across) + middle, step * np.arange(down) + middle)
        return Correlation(
            np.column_stack([x.ravel(), y.ravel()]),
            scores.reshape(side, side, -1),
            self.origin,
            (self_scores / fixed_energy).reshape(len(_OWN_SHIFTS), -1),
        )


def multiply(
    template: Float32Array, searched: Float32Array, *, radius: int, cell: int, origin: tuple[int, int] = (0, 0)
) -> Products:
    """Compare every cell of a field with another field around where it is expected.

    Args:
        template, searched: (2, H, W) float32, of one shape.
        radius: largest shift along each axis, px.
        cell: side of a cell, px; what is left of a cell at the right and lower rim does not count.
        origin: (x, y), added to the shifts that are tried.
    """
    rows, columns = template.shape[1] // cell, template.shape[2] // cell
    height, width = rows * cell, columns * cell
    fixed = template[:, :height, :width]
    every = [(dx, dy) for dy in range(2 * radius + 1) for dx in range(2 * radius + 1)]
    around = _shifted_window(searched, radius, origin, height, width)
    volume = _products(fixed, around, every, cell)
    energy = _energies(around, radius, cell, height, width)
    # As large as a field: not to be held beside the next.
    del around
    own = _products(fixed, _shifted_window(template, 1, (0, 0), height, width), _OWN_SHIFTS, cell)
    return Products(volume, energy, own, cell, radius, origin)


def _products(
    fixed: Float32Array, around: Float32Array, shifts: Sequence[tuple[int, int]], cell: int
) -> Float32Array:
    """(S, rows, columns): mean product over each cell with what lies (x, y) px from the corner of ``around``."""
    _, height, width = fixed.shape
    volume = np.empty((len(shifts), height // cell, width // cell), np.float32)
    if not volume.size:
        return volume
    # Some rows of cells at a time, so that all that is multiplied stays in the processor's cache.
    band = max(_BAND_PX // (width * cell), 1) * cell
    for top in range(0, height, band):
        rows = slice(top, min(top + band, height))
        count = rows.stop - rows.start
        product = np.empty((count, width), np.float32)
        size = width // cell, count // cell
        part = volume[:, top // cell : top // cell + count // cell]
        for cells, (dx, dy) in zip(part, shifts, strict=True):
            moved = around[:, top + dy : top + dy + count, dx : dx + width]
            cv2.multiply(fixed[0, rows], moved[0], dst=product)
            cv2.accumulateProduct(fixed[1, rows], moved[1], product)
            cv2.resize(product, size, dst=cells, interpolation=cv2.INTER_AREA)
    return volume


def _energies(around: Float32Array, radius: int, cell: int, height: int, width: int) -> Float32Array:
    """(S, rows, columns): mean square over each cell, for every shift."""
    side = 2 * radius + 1
    squares = cv2.multiply(around[0], around[0])
    cv2.accumulateProduct(around[1], around[1], squares)
    means = cv2.boxFilter(squares, -1, (cell, cell), anchor=(0, 0), normalize=True, borderType=cv2.BORDER_CONSTANT)
    return np.stack(
        [means[dy : dy + height : cell, dx : dx + width : cell] for dy in range(side) for dx in range(side)]
    )


def _sharpness(own: Float32Array) -> FloatArray:
    """(N, 2, 2) of how fast patches stop fitting themselves, from (S, N) scores with themselves at `_OWN_SHIFTS`."""
    _, right, below, along, against = own.astype(np.float64)
    xx, yy, xy = 2.0 - 2.0 * right, 2.0 - 2.0 * below, 0.5 * (against - along)
    # A patch along one edge fits as well anywhere along it: rounding must not make that negative.
    xx, yy = np.maximum(xx, 1e-6), np.maximum(yy, 1e-6)
    limit = 0.999 * np.sqrt(xx * yy)
    xy = np.clip(xy, -limit, limit)
    return np.stack([np.stack([xx, xy], axis=1), np.stack([xy, yy], axis=1)], axis=1)


def whole_shift(
    template: Float32Array, searched: Float32Array, max_shift: int, peaks: int = 1
) -> list[tuple[int, int, float]]:
    """The shifts of a whole field that correlate best, by the Fourier transform.

    Returns: x and y in px, each within ``max_shift``, and the peak's height in standard deviations of the correlation;
    the highest first, ``peaks`` of them, apart by a tenth of ``max_shift`` at least.
    """
    _, rows, columns = template.shape
    size = cv2.getOptimalDFTSize(rows + max_shift), cv2.getOptimalDFTSize(columns + max_shift)

    def spectrum(field: Float32Array) -> np.ndarray:
        padded = np.zeros((*size, 2), np.float32)
        padded[:rows, :columns, 0], padded[:rows, :columns, 1] = field
        return np.asarray(cv2.dft(padded, nonzeroRows=rows))

    product = cv2.mulSpectrums(spectrum(searched), spectrum(template), 0, conjB=True)
    correlation = cv2.dft(product, flags=cv2.DFT_INVERSE)[..., 0]
    near = np.roll(correlation, (max_shift, max_shift), axis=(0, 1))[: 2 * max_shift + 1, : 2 * max_shift + 1]
    # One pixel is less than the fields' own sharpness: a peak is broader than noise.
    near = cv2.GaussianBlur(np.ascontiguousarray(near), (0, 0), 1.0)
    mean, spread = float(near.mean()), max(float(near.std()), 1e-12)
    apart = max(max_shift // 10, 2)
    found = []
    for _ in range(peaks):
        y, x = (int(k) for k in np.unravel_index(int(near.argmax()), near.shape))
        found.append((x - max_shift, y - max_shift, (float(near[y, x]) - mean) / spread))
        near[max(y - apart, 0) : y + apart + 1, max(x - apart, 0) : x + apart + 1] = mean
    return found


def _shifted_window(
    field: Float32Array, radius: int, origin: tuple[int, int], height: int, width: int
) -> Float32Array:
    """(2, height + 2 radius, width + 2 radius) of a field, moved by ``origin`` and 0 outside it."""
    window = np.zeros((2, height + 2 * radius, width + 2 * radius), np.float32)
    left, top = origin[0] - radius, origin[1] - radius
    low_x, low_y = max(left, 0), max(top, 0)
    high_x = min(left + window.shape[2], field.shape[2])
    high_y = min(top + window.shape[1], field.shape[1])
    if high_x > low_x and high_y > low_y:
        window[:, low_y - top : high_y - top, low_x - left : high_x - left] = field[:, low_y:high_y, low_x:high_x]
    return window


def _patches(cells: Float32Array, count: int, stride: int) -> Float32Array:
    """Sums over ``count`` x ``count`` neighbours along the last two axes, at every ``stride``-th of them."""
    rows, columns = (size - count + 1 for size in cells.shape[-2:])
    across = cells[..., :columns:stride].copy()
    for k in range(1, count):
        across += cells[..., k : columns + k : stride]
    total = across[..., :rows:stride, :].copy()
    for k in range(1, count):
        total += across[..., k : rows + k : stride, :]
    return total


def _peaks(
    scores: Float32Array, radius: int
) -> tuple[np.ndarray, FloatArray, FloatArray, FloatArray]:
    """Highest of (D, D, N) scores per patch, by the paraboloid through its neighbours: which patches have one, its
    shift, score and curvature."""
    side, _, count = scores.shape
    patch = np.arange(count)
    best = scores.reshape(side * side, count).argmax(axis=0)
    row, column = np.divmod(best, side)
    inside = (row > 0) & (row < side - 1) & (column > 0) & (column < side - 1)
    row, column, patch = row[inside], column[inside], patch[inside]

    def at(dy: int, dx: int) -> FloatArray:
        return np.asarray(scores[row + dy, column + dx, patch], dtype=np.float64)

    centre, left, right, above, below = at(0, 0), at(0, -1), at(0, 1), at(-1, 0), at(1, 0)
    xx, yy = 2.0 * centre - left - right, 2.0 * centre - above - below
    xy = -0.25 * (at(1, 1) + at(-1, -1) - at(1, -1) - at(-1, 1))
    slope_x, slope_y = 0.5 * (right - left), 0.5 * (below - above)
    determinant = xx * yy - xy * xy
    falls = (xx > 0) & (yy > 0) & (determinant > 1e-3 * xx * yy) & (centre > 0)
    divisor = np.where(falls, determinant, 1.0)
    x = (yy * slope_x - xy * slope_y) / divisor
    y = (xx * slope_y - xy * slope_x) / divisor
    kept = np.flatnonzero(falls & (np.abs(x) < 1) & (np.abs(y) < 1))
    shift = np.column_stack([column[kept] - radius + x[kept], row[kept] - radius + y[kept]])
    curvature = np.empty((len(kept), 2, 2))
    curvature[:, 0, 0], curvature[:, 1, 1] = xx[kept], yy[kept]
    curvature[:, 0, 1] = curvature[:, 1, 0] = xy[kept]
    return patch[kept], shift, centre[kept], curvature
