"""Where the pixels of a north-up raster are. Ours: the centre of the first pixel is (0, 0); GDAL's affine
counts from its outer corner. That half pixel is added here and nowhere else."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ortholoc_edge.geometry.arrays import Float32Array, FloatArray


@dataclass(frozen=True, slots=True)
class RasterGrid:
    """Shape and place of a raster whose rows run east and whose columns run south (or north, dy > 0).

    The paper's nadir orthographic camera (appendix, "Nadir orthographic projection") with a pixel-centre
    origin: ``X = dx * (u + 0.5) + west``, ``Y = dy * (v + 0.5) + top``.

    Attributes:
        width, height: pixels.
        west, top: map coordinates of the outer corner of pixel (0, 0), m (GDAL's affine c and f).
        dx, dy: pixel size in m; dx > 0, dy usually < 0.
    Raises: ValueError for an empty shape or a pixel of no size.
    """

    width: int
    height: int
    west: float
    top: float
    dx: float
    dy: float

    def __post_init__(self) -> None:
        if self.width < 1 or self.height < 1:
            raise ValueError(f"raster of {self.width} x {self.height} pixels is empty")
        if not (np.isfinite([self.west, self.top, self.dx, self.dy]).all() and self.dx > 0 and self.dy != 0):
            raise ValueError(f"raster origin ({self.west}, {self.top}) or pixel ({self.dx}, {self.dy}) unusable")

    @property
    def gsd_m(self) -> float:
        """Ground sampling distance: the geometric mean of the pixel's sides, m."""
        return float(np.sqrt(abs(self.dx * self.dy)))

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """(west, south, east, north) of the outer edges, m."""
        other = self.top + self.dy * self.height
        return (
            self.west,
            min(self.top, other),
            self.west + self.dx * self.width,
            max(self.top, other),
        )

    def map_from_px(self, px: npt.ArrayLike) -> FloatArray:
        """Pixels (..., 2) as (u, v), centres at integers, to map (..., 2) easting, northing in m."""
        px = np.asarray(px, dtype=np.float64)
        return (px + 0.5) * (self.dx, self.dy) + (self.west, self.top)

    def px_from_map(self, xy_map: npt.ArrayLike) -> FloatArray:
        """Inverse of :meth:`map_from_px`; points off the raster give pixels off the raster."""
        xy = np.asarray(xy_map, dtype=np.float64)
        return (xy - (self.west, self.top)) / (self.dx, self.dy) - 0.5

    def map_from_px_matrix(self) -> FloatArray:
        """(3, 3) matrix of :meth:`map_from_px` on homogeneous pixels."""
        return np.array(
            [
                [self.dx, 0.0, 0.5 * self.dx + self.west],
                [0.0, self.dy, 0.5 * self.dy + self.top],
                [0.0, 0.0, 1.0],
            ]
        )

    def crop(self, column: int, row: int, width: int, height: int) -> RasterGrid:
        """Grid of the block of ``width`` x ``height`` pixels whose first pixel is (column, row) here."""
        return RasterGrid(width, height, self.west + self.dx * column, self.top + self.dy * row, self.dx, self.dy)

    def resized(self, width: int, height: int) -> RasterGrid:
        """The same extent in another number of pixels."""
        return RasterGrid(
            width,
            height,
            self.west,
            self.top,
            self.dx * self.width / width,
            self.dy * self.height / height,
        )


def resize_px(px: npt.ArrayLike, scale: npt.ArrayLike) -> FloatArray:
    """Pixel coordinates (..., 2) after an image was resized by ``scale`` (one factor or (u, v)).

    ``(k + 0.5) * s - 0.5``, as OpenCV's and GDAL's resampling have it: the outer corners stay.
    """
    return (np.asarray(px, dtype=np.float64) + 0.5) * np.asarray(scale, dtype=np.float64) - 0.5


def bilinear(raster: Float32Array, px: npt.ArrayLike) -> FloatArray:
    """Values (N,) of a raster (h, w) at pixels (N, 2), centres at integers.

    NaN off the raster, and wherever a cell that takes part is NaN: beside a hole a height would be half
    invented. The outermost half pixel is off: it has a neighbour on one side only.
    """
    height, width = raster.shape
    u, v = np.asarray(px, dtype=np.float64).T
    with np.errstate(invalid="ignore"):
        inside = (u >= 0) & (u <= width - 1) & (v >= 0) & (v <= height - 1)
    u, v = np.where(inside, u, 0.0), np.where(inside, v, 0.0)
    column = np.minimum(u.astype(np.intp), max(width - 2, 0))
    row = np.minimum(v.astype(np.intp), max(height - 2, 0))
    right, below = np.minimum(column + 1, width - 1), np.minimum(row + 1, height - 1)
    a, b = u - column, v - row
    values = np.zeros(len(u))
    for weight, rows, columns in (
        ((1 - a) * (1 - b), row, column),
        (a * (1 - b), row, right),
        ((1 - a) * b, below, column),
        (a * b, below, right),
    ):
        # A cell of no weight takes no part, so that a NaN there does no harm.
        values += np.where(weight > 0, weight * raster[rows, columns], 0.0)
    return np.where(inside, values, np.nan)
