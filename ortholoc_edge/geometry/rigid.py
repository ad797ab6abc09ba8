"""Rigid motions of space. A value named ``a_from_b`` takes coordinates in b to coordinates in a."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ortholoc_edge.geometry.arrays import FloatArray, frozen_floats


@dataclass(frozen=True, slots=True, eq=False)
class Rigid3:
    """``p_a = rotation @ p_b + translation``; of ``map_from_camera`` the translation is the camera centre.

    Attributes:
        rotation: (3, 3) float64, orthonormal with determinant +1.
        translation: (3,) float64, metres.
    Raises: ValueError if a value is not finite or ``rotation`` is not a rotation.
    """

    rotation: FloatArray
    translation: FloatArray

    def __post_init__(self) -> None:
        rotation = frozen_floats(self.rotation, (3, 3), "rotation")
        # By hand: a frame makes dozens of poses, and of nine numbers NumPy's own calls are most of the time.
        (a, b, c), (d, e, f), (g, h, i) = rotation.tolist()
        error = max(
            abs(a * a + b * b + c * c - 1.0),
            abs(d * d + e * e + f * f - 1.0),
            abs(g * g + h * h + i * i - 1.0),
            abs(a * d + b * e + c * f),
            abs(a * g + b * h + c * i),
            abs(d * g + e * h + f * i),
        )
        if error > 1e-5 or a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g) < 0:
            raise ValueError(f"rotation: not orthonormal (off by {error:.1e}) or mirrored")
        object.__setattr__(self, "rotation", rotation)
        object.__setattr__(self, "translation", frozen_floats(self.translation, (3,), "translation"))

    @staticmethod
    def identity() -> Rigid3:
        return Rigid3(np.eye(3), np.zeros(3))

    def inverse(self) -> Rigid3:
        """``b_from_a``."""
        return Rigid3(self.rotation.T, -self.rotation.T @ self.translation)

    def __matmul__(self, other: Rigid3) -> Rigid3:
        """``a_from_b @ b_from_c`` is ``a_from_c``."""
        return Rigid3(self.rotation @ other.rotation, self.rotation @ other.translation + self.translation)

    def apply(self, points: npt.ArrayLike) -> FloatArray:
        """Points (..., 3) in b to points (..., 3) in a."""
        return np.asarray(points, dtype=np.float64) @ self.rotation.T + self.translation
