"""Hypothesis strategies that several folders share: values over the ranges that occur on Earth and in cameras.

Importing this also makes hypothesis deterministic: the same examples in every run, and no time limit per example,
which a busy machine would miss.
"""

from __future__ import annotations

import numpy as np
from hypothesis import settings
from hypothesis import strategies as st

from ortholoc_edge.geometry import rotation
from ortholoc_edge.geometry.arrays import FloatArray
from ortholoc_edge.geometry.camera import Camera
from ortholoc_edge.geometry.grid import RasterGrid
from ortholoc_edge.geometry.rigid import Rigid3

settings.register_profile("deterministic", derandomize=True, deadline=None)
settings.load_profile("deterministic")

# UTM northings reach 1e7 m.
MAP_EXTENT_M = 1e7


def finite(low: float, high: float) -> st.SearchStrategy[float]:
    return st.floats(low, high, allow_nan=False, allow_infinity=False)


def vectors(limit: float, size: int = 3) -> st.SearchStrategy[FloatArray]:
    """(size,) with every component within ±limit."""
    return st.tuples(*[finite(-limit, limit)] * size).map(np.array)


@st.composite
def rotation_vectors(draw: st.DrawFn, max_angle_rad: float = np.pi) -> FloatArray:
    """Axis times angle: every axis, angles from nothing to ``max_angle_rad``, tiny ones and the limit included."""
    axis = draw(vectors(1.0).filter(lambda v: float(np.linalg.norm(v)) > 1e-3))
    angle = draw(st.one_of(finite(0.0, max_angle_rad), st.sampled_from([0.0, 1e-12, 1e-9, 1e-5, max_angle_rad - 1e-9])))
    return np.asarray(axis / np.linalg.norm(axis) * angle, dtype=np.float64)


def rotations(max_angle_rad: float = np.pi) -> st.SearchStrategy[FloatArray]:
    """(3, 3)."""
    return rotation_vectors(max_angle_rad).map(rotation.exp)


def poses(limit_m: float = MAP_EXTENT_M) -> st.SearchStrategy[Rigid3]:
    return st.builds(Rigid3, rotations(), vectors(limit_m))


@st.composite
def cameras(draw: st.DrawFn, *, distorted: bool | None = None) -> Camera:
    """Lenses of 40 to 105 degrees across; the distortion of ordinary ones, which stays invertible."""
    width, height = draw(st.integers(64, 5000)), draw(st.integers(64, 5000))
    focal = max(width, height) * draw(finite(0.6, 1.6))
    aspect = draw(finite(0.95, 1.05))
    cx = (width - 1) / 2 + draw(finite(-0.03, 0.03)) * width
    cy = (height - 1) / 2 + draw(finite(-0.03, 0.03)) * height
    if draw(st.booleans()) if distorted is None else distorted:
        k1, k2, k3 = draw(finite(-0.12, 0.12)), draw(finite(-0.03, 0.03)), draw(finite(-0.005, 0.005))
        p1, p2 = draw(finite(-2e-3, 2e-3)), draw(finite(-2e-3, 2e-3))
        return Camera(width, height, focal, focal * aspect, cx, cy, (k1, k2, p1, p2, k3))
    return Camera(width, height, focal, focal * aspect, cx, cy)


@st.composite
def grids(draw: st.DrawFn) -> RasterGrid:
    """Rasters anywhere on a projected map, pixels of a centimetre to 10 m, rows running south or north."""
    return RasterGrid(
        draw(st.integers(1, 20_000)),
        draw(st.integers(1, 20_000)),
        draw(finite(-MAP_EXTENT_M, MAP_EXTENT_M)),
        draw(finite(-MAP_EXTENT_M, MAP_EXTENT_M)),
        draw(finite(0.01, 10.0)),
        draw(finite(0.01, 10.0)) * draw(st.sampled_from([-1.0, 1.0])),
    )
