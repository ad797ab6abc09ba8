"""Array aliases used in signatures, and the check that constructors share."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
Float32Array = npt.NDArray[np.float32]
IntArray = npt.NDArray[np.intp]
BoolArray = npt.NDArray[np.bool_]
ImageArray = npt.NDArray[np.uint8]


def frozen_floats(values: npt.ArrayLike, shape: tuple[int | None, ...], what: str) -> FloatArray:
    """Copy ``values`` to a read-only float64 array of ``shape`` (None: any length).

    Raises: ValueError naming ``what`` if the shape differs or a value is not finite.
    """
    array = np.array(values, dtype=np.float64)
    if array.ndim != len(shape) or any(
        want is not None and have != want for have, want in zip(array.shape, shape, strict=True)
    ):
        raise ValueError(f"{what}: shape {array.shape}, expected {shape}")
    if not np.isfinite(array).all():
        raise ValueError(f"{what}: contains NaN or infinity")
    array.flags.writeable = False
    return array
