"""Noise: of values on rasters, and of what wanders with time."""

from __future__ import annotations

import math

import cv2
import numpy as np

from ortholoc_edge.geometry.arrays import Float32Array, FloatArray


def blobs(shape: tuple[int, int], size_px: float, seed: int) -> Float32Array:
    """(H, W) smooth noise of zero mean, about unit variance and features of ``size_px``."""
    height, width = shape
    rows, columns = int(height / size_px) + 4, int(width / size_px) + 4
    rng = np.random.default_rng([seed, rows, columns])
    coarse = rng.standard_normal((rows, columns), dtype=np.float32)
    scale = 1.0 / size_px
    warp = np.array([[scale, 0.0, 1.0], [0.0, scale, 1.0]])
    # Interpolation averages neighbours: bring the variance back to about one.
    smooth = cv2.warpAffine(
        coarse * np.float32(1.35), warp, (width, height), flags=cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_REFLECT,
    )  # fmt: skip
    return np.asarray(smooth, dtype=np.float32)


def octaves(shape: tuple[int, int], sizes_px: tuple[float, ...], weights: tuple[float, ...], seed: int) -> Float32Array:
    """Sum of :func:`blobs` of several sizes, normalised to about unit variance."""
    total = np.zeros(shape, dtype=np.float32)
    norm = float(np.sqrt(np.sum(np.square(weights))))
    for i, (size, weight) in enumerate(zip(sizes_px, weights, strict=True)):
        total += np.float32(weight / norm) * blobs(shape, size, seed * 31 + i)
    return total


def grain(shape: tuple[int, int], seed: int) -> Float32Array:
    """White noise of unit variance, one value per pixel."""
    return np.random.default_rng([seed, 5]).standard_normal(shape, dtype=np.float32)


def wander(value: FloatArray, sigma: float | FloatArray, time_s: float, dt_s: float, white: FloatArray) -> FloatArray:
    """One step of an Ornstein-Uhlenbeck process of standard deviation ``sigma``, given standard normal noise."""
    decay = math.exp(-dt_s / time_s)
    return np.asarray(decay * value + sigma * math.sqrt(1.0 - decay**2) * white, dtype=np.float64)
