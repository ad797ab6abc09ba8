"""Simple polygons in a plane as their corners (N, 2) float64, in either sense, not closed."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from ortholoc_edge.geometry.arrays import FloatArray


def without_repeats(corners: npt.ArrayLike) -> FloatArray:
    """Corners (M, 2) without those that equal the one before, the first after the last included."""
    points = np.asarray(corners, dtype=np.float64)
    return np.asarray(points[(points != np.roll(points, 1, axis=0)).any(axis=1)])


def area(corners: npt.ArrayLike) -> float:
    """Of a polygon that does not cross itself; 0 for fewer than three corners."""
    points = np.asarray(corners, dtype=np.float64).reshape(-1, 2)
    if len(points) < 3:
        return 0.0
    # From a corner of its own: of coordinates of millions of metres little would be left.
    x, y = (points - points[0]).T
    return 0.5 * abs(float(x @ np.roll(y, -1) - y @ np.roll(x, -1)))


def crosses_itself(corners: npt.ArrayLike) -> bool:
    """Whether two sides share a point other than the corner between neighbours; corners must not repeat."""
    points = np.asarray(corners, dtype=np.float64)
    count = len(points)
    if count < 3:
        return False
    starts = points - points[0]
    ends = np.roll(starts, -1, axis=0)
    first, second = np.triu_indices(count, 1)
    a, b, c, d = starts[first], ends[first], starts[second], ends[second]
    side_c, side_d, side_a, side_b = _side(a, b, c), _side(a, b, d), _side(c, d, a), _side(c, d, b)
    proper = (side_c * side_d < 0) & (side_a * side_b < 0)
    follows = second == first + 1
    precedes = (first == 0) & (second == count - 1)
    touches = (
        ((side_c == 0) & _in_box(a, b, c) & ~follows)
        | ((side_d == 0) & _in_box(a, b, d) & ~precedes)
        | ((side_a == 0) & _in_box(c, d, a) & ~precedes)
        | ((side_b == 0) & _in_box(c, d, b) & ~follows)
    )
    return bool((proper | touches).any())


def clipped(corners: npt.ArrayLike, bounds: tuple[float, float, float, float]) -> FloatArray:
    """The part (M, 2) inside a box (west, south, east, north); where that is several pieces, they hang together by
    sides without area."""
    points = np.asarray(corners, dtype=np.float64).reshape(-1, 2)
    west, south, east, north = bounds
    # One side of the box after the other (Sutherland and Hodgman, 1974).
    for axis, sign, limit in ((0, 1.0, west), (1, 1.0, south), (0, -1.0, east), (1, -1.0, north)):
        depth = sign * (points[:, axis] - limit)
        kept: list[FloatArray] = []
        for i in range(len(points)):
            here, before = depth[i], depth[i - 1]
            if (here >= 0) != (before >= 0):
                crossing = points[i - 1] + (points[i] - points[i - 1]) * before / (before - here)
                crossing[axis] = limit
                kept.append(crossing)
            if here >= 0:
                kept.append(points[i])
        points = np.array(kept).reshape(-1, 2)
    return points


def _side(a: FloatArray, b: FloatArray, p: FloatArray) -> FloatArray:
    """Above zero where ``p`` is left of the way from ``a`` to ``b``."""
    ab, ap = b - a, p - a
    return np.asarray(ab[:, 0] * ap[:, 1] - ab[:, 1] * ap[:, 0])


def _in_box(a: FloatArray, b: FloatArray, p: FloatArray) -> npt.NDArray[np.bool_]:
    return np.asarray(((np.minimum(a, b) <= p) & (p <= np.maximum(a, b))).all(axis=1))
