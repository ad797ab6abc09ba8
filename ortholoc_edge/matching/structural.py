"""Displacements between two pictures of the same view by correlating their `orientation` fields.

Template matching on a grid: every patch of the one field is looked for within a radius in the other, by normalised
correlation, to a fraction of a pixel. Products are summed over small cells once and patches are sums of cells, so that
overlapping patches cost nothing.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np

from ortholoc_edge.geometry.arrays import Float32Array, FloatArray

_MIN_ENERGY: Final = 1e-9
_DOUBT: Final = 0.01


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


def correlate(
    template: Float32Array, searched: Float32Array, *, radius: int, cell: int, patch_cells: int, origin: tuple[int, int] = (0, 0)
) -> Displacements:
    """Look for every patch of a field in another.

    Args:
        template, searched: (2, H, W) float32, of one shape.
        radius: largest shift along each axis, px. Peaks at the rim count as not found.
        cell: side of a cell, px; ``patch_cells`` of them side by side make a patch.
        origin: (x, y), added to the shifts that are tried.
    Returns: the patches whose peak lies inside and falls to all sides.
    """
    rows, columns = template.shape[1] // cell, template.shape[2] // cell
    side = 2 * radius + 1
    if min(rows, columns) < patch_cells:
        return _nothing()
    height, width = rows * cell, columns * cell
    fixed = template[:, :height, :width]
    around = _shifted_window(searched, radius, origin, height, width)
    volume = np.empty((side, side, rows, columns), np.float32)
    product, second = np.empty((2, height, width), np.float32)
    for dy in range(side):
        for dx in range(side):
            moved = around[:, dy : dy + height, dx : dx + width]
            np.multiply(fixed[0], moved[0], out=product)
            np.multiply(fixed[1], moved[1], out=second)
            product += second
            volume[dy, dx] = cv2.resize(product, (columns, rows), interpolation=cv2.INTER_AREA)
    own = np.square(fixed).sum(axis=0)
    own_cells = cv2.resize(own, (columns, rows), interpolation=cv2.INTER_AREA)
    other = np.square(around).sum(axis=0)
    sums = cv2.boxFilter(other, -1, (cell, cell), anchor=(0, 0), normalize=True, borderType=cv2.BORDER_CONSTANT)
    energy = np.empty_like(volume)
    for dy in range(side):
        for dx in range(side):
            energy[dy, dx] = sums[dy : dy + height : cell, dx : dx + width : cell]
    fixed_energy = _patches(own_cells, patch_cells)
    scores = _patches(volume, patch_cells)
    scores /= np.sqrt(np.maximum(_patches(energy, patch_cells) * fixed_energy, _MIN_ENERGY))
    down, across = scores.shape[2:]
    found = _peaks(scores.reshape(side, side, -1), radius)
    middle = 0.5 * (patch_cells * cell - 1)
    x, y = np.meshgrid(cell * np.arange(across) + middle, cell * np.arange(down) + middle)
    places = np.column_stack([x.ravel(), y.ravel()])
    kept, shift, score, curvature = found
    return Displacements(places[kept], shift + origin, score, curvature)


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


def _patches(cells: Float32Array, count: int) -> Float32Array:
    """Sums over ``count`` x ``count`` neighbours along the last two axes."""
    across = np.cumsum(cells, axis=-1, dtype=np.float64)
    across[..., count:] -= across[..., :-count].copy()
    total = np.cumsum(across[..., count - 1 :], axis=-2)
    total[..., count:, :] -= total[..., :-count, :].copy()
    return np.asarray(total[..., count - 1 :, :], dtype=np.float32)


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


def _nothing() -> Displacements:
    return Displacements(np.empty((0, 2)), np.empty((0, 2)), np.empty(0), np.empty((0, 2, 2)))
