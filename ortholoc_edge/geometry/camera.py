"""Pinhole camera with the Brown-Conrady distortion of OpenCV. Axes: x right, y down, z forward.

Pixel centres are at integers, as OpenCV has them; COLMAP's are at integers + 0.5. PoseLib has no opinion: it
returns the pose for whatever convention points and principal point share (tests/geometry/test_conventions.py).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from ortholoc_edge.geometry.arrays import BoolArray, FloatArray
from ortholoc_edge.geometry.grid import resize_px

_UNDISTORT_ITERATIONS = 20
# In units of the focal length: a millionth of a pixel.
_UNDISTORT_TOLERANCE = 1e-9


@dataclass(frozen=True, slots=True)
class Camera:
    """Intrinsics of one image size.

    Attributes:
        width, height: px.
        fx, fy, cx, cy: px; the centre of the first pixel is (0, 0).
        distortion: OpenCV's (k1, k2, p1, p2, k3).
    Raises: ValueError if a size or focal length is not positive or a value is not finite.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        if self.width < 1 or self.height < 1 or not (self.fx > 0 and self.fy > 0):
            raise ValueError(
                f"camera {self.width} x {self.height} px with focal length ({self.fx}, {self.fy}) px: "
                "all four must be positive"
            )
        if not np.isfinite([self.fx, self.fy, self.cx, self.cy, *self.distortion]).all():
            raise ValueError("camera: an intrinsic parameter is NaN or infinite")

    @staticmethod
    def from_focal(width: int, height: int, focal_px: float) -> Camera:
        """Square pixels and the principal point in the middle of the image."""
        return Camera(width, height, focal_px, focal_px, (width - 1) / 2, (height - 1) / 2)

    @property
    def matrix(self) -> FloatArray:
        """K, (3, 3)."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def is_pinhole(self) -> bool:
        return not any(self.distortion)

    @property
    def focal_px(self) -> float:
        """Geometric mean of the two focal lengths."""
        return float(np.sqrt(self.fx * self.fy))

    def resized(self, width: int, height: int) -> Camera:
        """The camera of the image brought to another size; the field of view stays."""
        sx, sy = width / self.width, height / self.height
        cx, cy = resize_px((self.cx, self.cy), (sx, sy))
        return replace(self, width=width, height=height, fx=self.fx * sx, fy=self.fy * sy, cx=float(cx), cy=float(cy))

    def pinhole(self) -> Camera:
        """The same camera without distortion, for undistorted pixels."""
        return replace(self, distortion=(0.0, 0.0, 0.0, 0.0, 0.0))

    def padded(self, margin_px: int) -> Camera:
        """The camera of a picture that shows ``margin_px`` more on every side."""
        return replace(
            self,
            width=self.width + 2 * margin_px,
            height=self.height + 2 * margin_px,
            cx=self.cx + margin_px,
            cy=self.cy + margin_px,
        )

    def project(self, points_camera: npt.ArrayLike) -> FloatArray:
        """Points (..., 3) in the camera frame, m, to pixels (..., 2); NaN for points not in front."""
        points = np.asarray(points_camera, dtype=np.float64)
        depth = points[..., 2:]
        with np.errstate(divide="ignore", invalid="ignore"):
            xy = np.where(depth > 0, points[..., :2] / depth, np.nan)
        if not self.is_pinhole:
            xy = self.distort(xy)
        return xy * (self.fx, self.fy) + (self.cx, self.cy)

    def unproject(self, px: npt.ArrayLike) -> FloatArray:
        """Pixels (..., 2) to rays (..., 3) in the camera frame with z = 1.

        NaN in x and y where the distortion gives no ray: a polynomial fitted to the middle of a picture may fold
        back before its corners.
        """
        xy = (np.asarray(px, dtype=np.float64) - (self.cx, self.cy)) / (self.fx, self.fy)
        if not self.is_pinhole:
            xy = self._undistorted(xy)
        return np.concatenate([xy, np.ones_like(xy[..., :1])], axis=-1)

    def undistorted_px(self, px: npt.ArrayLike) -> FloatArray:
        """Where the pixels (..., 2) would lie in the image of :meth:`pinhole`."""
        if self.is_pinhole:
            return np.asarray(px, dtype=np.float64)
        return self.pinhole().project(self.unproject(px))

    def contains(self, px: npt.ArrayLike) -> BoolArray:
        """Which pixels (..., 2) lie on the sensor (its outer edges included); NaN does not."""
        px = np.asarray(px, dtype=np.float64)
        return np.asarray(
            (px[..., 0] >= -0.5)
            & (px[..., 0] <= self.width - 0.5)
            & (px[..., 1] >= -0.5)
            & (px[..., 1] <= self.height - 0.5)
        )

    def _undistorted(self, distorted: FloatArray) -> FloatArray:
        """Newton's method: the usual fixed point is a pixel off in the corners of a pincushion (k1 = 0.3)."""
        xy = distorted.copy()
        with np.errstate(all="ignore"):
            for _ in range(_UNDISTORT_ITERATIONS):
                xx, mixed, yy = self._distortion_slopes(xy)
                determinant = xx * yy - mixed * mixed
                missing = distorted - self.distort(xy)
                step = np.stack(
                    [
                        yy * missing[..., 0] - mixed * missing[..., 1],
                        xx * missing[..., 1] - mixed * missing[..., 0],
                    ],
                    axis=-1,
                )
                xy = xy + step / determinant[..., None]
            # Of a folded polynomial the branch around the axis is the lens; beyond the fold the determinant falls.
            solved = (np.abs(distorted - self.distort(xy)).max(axis=-1) < _UNDISTORT_TOLERANCE) & (determinant > 0)
        return np.where(solved[..., None], xy, np.nan)

    def distortion_jacobian(self, xy: FloatArray) -> FloatArray:
        """(..., 2, 2): of `distort` by its argument."""
        xx, mixed, yy = self._distortion_slopes(xy)
        return np.stack([np.stack([xx, mixed], axis=-1), np.stack([mixed, yy], axis=-1)], axis=-2)

    def _distortion_slopes(self, xy: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """dx'/dx, dx'/dy = dy'/dx and dy'/dy."""
        k1, k2, p1, p2, k3 = self.distortion
        x, y = xy[..., 0], xy[..., 1]
        r2 = x * x + y * y
        radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        slope = 2.0 * (k1 + r2 * (2.0 * k2 + 3.0 * r2 * k3))
        xx = radial + slope * x * x + 2.0 * p1 * y + 6.0 * p2 * x
        yy = radial + slope * y * y + 6.0 * p1 * y + 2.0 * p2 * x
        return xx, slope * x * y + 2.0 * (p1 * x + p2 * y), yy

    def distort(self, xy: FloatArray) -> FloatArray:
        """Where the lens puts ideal image coordinates (..., 2), x / z and y / z."""
        k1, k2, p1, p2, k3 = self.distortion
        x, y = xy[..., 0], xy[..., 1]
        r2 = x * x + y * y
        radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        return np.stack(
            [
                x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
                y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
            ],
            axis=-1,
        )
