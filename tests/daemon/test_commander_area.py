"""Which polygons are an area to search in."""

from __future__ import annotations

import numpy as np
import pytest

from ortholoc_edge.commander import unusable_area

BOUNDS = (1000.0, 2000.0, 3000.0, 4000.0)
# A star with its corners in the order of drawing one without lifting the pen.
STAR = [(2000 + 500 * np.sin(k * 4 * np.pi / 5), 3000 + 500 * np.cos(k * 4 * np.pi / 5)) for k in range(5)]


@pytest.mark.parametrize(
    ("corners", "why"),
    [
        ([(1500, 2500), (2500, 2500), (2500, 3500), (1500, 3500)], None),
        # The other way round, not convex, larger than the map, over its rim.
        ([(1500, 3500), (2500, 3500), (2500, 2500), (1500, 2500)], None),
        ([(1500, 2500), (2500, 2500), (2500, 3500), (2400, 2600)], None),
        ([(-9e5, -9e5), (9e5, -9e5), (0, 9e5)], None),
        ([(900, 1900), (1100, 1900), (1100, 2100)], None),
        ([(1500, 2500), (2500, 3500), (2500, 2500), (1500, 3500)], "sides 1 and 3 cross"),
        (STAR, "cross"),
        ([(0, 0), (900, 0), (900, 1900)], "outside of the pack"),
        ([(3100, 2500), (3200, 2500), (3200, 2900)], "outside of the pack"),
        ([(1500, 2500), (2000, 2500), (2500, 2500)], "area of 0 m2"),
        ([(1500, 2500)] * 3, "area of 0 m2"),
        ([(1500, 2500), (1530, 2500), (1530, 2530)], "area of 450 m2"),
    ],
)
def test_areas(corners: list[tuple[float, float]], why: str | None) -> None:
    for first in range(len(corners)):
        found = unusable_area(np.array([*corners[first:], *corners[:first]], dtype=np.float64), BOUNDS)
        if why is None:
            assert found is None
        else:
            assert found is not None
            # Which sides cross depends on where one begins to count.
            assert first > 0 or why in found
