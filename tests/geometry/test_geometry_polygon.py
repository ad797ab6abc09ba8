"""Polygons, against slower ways that say the same."""

from fractions import Fraction
from itertools import combinations

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from ortholoc_edge.geometry import polygon

FAR = np.array([4_300_000.0, 5_200_000.0])
SQUARE = [(0, 0), (10, 0), (10, 10), (0, 10)]

# Small integers: touching corners and sides along each other come up all the time.
corners = st.lists(st.tuples(st.integers(0, 6), st.integers(0, 6)), min_size=3, max_size=7)


def shared(a, b, c, d):
    """Points that the segments ab and cd share, exact: up to two of them, which then are the ends of a stretch."""
    (ux, uy), (vx, vy), (wx, wy) = ((q[0] - p[0], q[1] - p[1]) for p, q in ((a, b), (c, d), (a, c)))
    cross = ux * vy - uy * vx
    if cross:
        s, t = Fraction(wx * vy - wy * vx, cross), Fraction(wx * uy - wy * ux, cross)
        return {(a[0] + s * ux, a[1] + s * uy)} if 0 <= s <= 1 and 0 <= t <= 1 else set()
    if wx * uy - wy * ux:
        return set()
    return {p for p in (a, b) if between(c, p, d)} | {p for p in (c, d) if between(a, p, b)}


def between(a, p, b):
    return min(a[0], b[0]) <= p[0] <= max(a[0], b[0]) and min(a[1], b[1]) <= p[1] <= max(a[1], b[1])


def crosses(ring):
    sides = list(zip(ring, [*ring[1:], ring[0]], strict=True))
    for (i, one), (j, other) in combinations(enumerate(sides), 2):
        allowed = {one[1]} if j == i + 1 else {one[0]} if (i, j) == (0, len(sides) - 1) else set()
        if shared(*one, *other) - allowed:
            return True
    return False


def ring_of(points):
    ring = [tuple(int(v) for v in corner) for corner in polygon.without_repeats(points)]
    assume(len(ring) >= 3)
    return ring


@given(corners)
def test_crossing_is_found_as_by_exact_arithmetic(points):
    ring = ring_of(points)
    assert polygon.crosses_itself(np.array(ring) + FAR) == crosses(ring)


@given(corners)
def test_areas_are_as_counted(points):
    ring = ring_of(points)
    assume(not crosses(ring))
    # No sample lies on a side: of integers to 6, those go through no such places.
    x, y = np.meshgrid(*[np.arange(300) / 50.0 + 0.00931] * 2)
    inside = np.zeros(x.shape, dtype=bool)
    for (ax, ay), (bx, by) in zip(ring, [*ring[1:], ring[0]], strict=True):
        if ay != by:
            inside ^= ((ay > y) != (by > y)) & (x < ax + (y - ay) * (bx - ax) / (by - ay))
    # A side crosses 600 cells at most, of which each is wrong by less than all of it; mostly they cancel.
    assert polygon.area(np.array(ring) + FAR) == pytest.approx(inside.mean() * 36, abs=0.3)
    in_box = inside & (x > 1.5) & (x < 4) & (y > 2) & (y < 5.5)
    clipped = polygon.clipped(np.array(ring) + FAR, (FAR[0] + 1.5, FAR[1] + 2, FAR[0] + 4, FAR[1] + 5.5))
    assert polygon.area(clipped) == pytest.approx(in_box.mean() * 36, abs=0.3)


@pytest.mark.parametrize(
    ("ring", "crosses"),
    [
        (SQUARE, False),
        (SQUARE[::-1], False),
        ([(0, 0), (10, 10), (10, 0), (0, 10)], True),
        ([(0, 0), (10, 0), (5, 0), (5, 5)], True),
        ([(0, 0), (10, 0), (10, 10), (5, 0), (0, 10)], True),
    ],
    ids=["square", "the other way round", "bow-tie", "folded back", "corner on a side"],
)
def test_what_crosses_itself(ring, crosses):
    assert polygon.crosses_itself(np.array(ring) + FAR) is crosses


def test_a_closing_corner_counts_once():
    assert np.array_equal(polygon.without_repeats([*SQUARE, SQUARE[0]]), [*SQUARE[1:], SQUARE[0]])
    assert len(polygon.without_repeats([(1, 1)] * 5)) == 0
