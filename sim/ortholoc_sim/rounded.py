"""A route whose corners are arcs."""

from __future__ import annotations

import math

import numpy as np

from ortholoc_edge.geometry.arrays import FloatArray

_ARC_STEP_RAD = math.radians(7.5)
# A turn that is hardly one needs no arc.
_STRAIGHT_RAD = math.radians(1.0)


def rounded(waypoints: FloatArray, radius_m: float) -> FloatArray:
    """(M, 2) waypoints of a polyline (N, 2) with arcs of ``radius_m`` at its corners; of less where the legs beside a
    corner are too short for it."""
    points = np.asarray(waypoints, dtype=np.float64)
    out = [points[0]]
    for before, corner, after in zip(points[:-2], points[1:-1], points[2:], strict=True):
        back, ahead = before - corner, after - corner
        room_m = 0.5 * min(float(np.linalg.norm(back)), float(np.linalg.norm(ahead)))
        back, ahead = back / np.linalg.norm(back), ahead / np.linalg.norm(ahead)
        half = 0.5 * math.acos(float(np.clip(back @ ahead, -1.0, 1.0)))  # of the angle between the legs
        turn = math.pi - 2.0 * half
        cut_m = min(radius_m / math.tan(half), room_m) if half > 1e-6 else 0.0
        if turn < _STRAIGHT_RAD or cut_m < 1e-6:
            out.append(corner)
            continue
        centre = corner + (back + ahead) / np.linalg.norm(back + ahead) * cut_m / math.cos(half)
        start = corner + back * cut_m - centre
        side = math.copysign(1.0, float(back[0] * ahead[1] - back[1] * ahead[0]))
        for angle in np.linspace(0.0, -side * turn, max(2, math.ceil(turn / _ARC_STEP_RAD) + 1)):
            c, s = math.cos(angle), math.sin(angle)
            out.append(centre + np.array([c * start[0] - s * start[1], s * start[0] + c * start[1]]))
    return np.array([*out, points[-1]])
