"""A frame in a map of made-up ground: where the search says it was taken, and what it makes of what is not there."""

from __future__ import annotations

import functools
import math

import cv2
import numpy as np
import pytest
from pipeline.scenes_pipeline import turned_down

from ortholoc_edge.geometry import rotation
from ortholoc_edge.geometry.arrays import FloatArray, ImageArray
from ortholoc_edge.geometry.camera import Camera
from ortholoc_edge.geometry.grid import RasterGrid
from ortholoc_edge.matching.orientation import orientation_field
from ortholoc_edge.pipeline.search import (
    Candidate,
    Former,
    Searcher,
    Sighting,
    agreeing,
    circle,
    distinct,
    fitting_level,
)
from ortholoc_edge.tiles.coarse import MEAN_PX, CoarseField

CAMERA = Camera.from_focal(320, 240, 270.0)
ABOVE_M = 100.0
GSD_M = 1.6
# 1.3 x 1.0 km.
GRID = RasterGrid(800, 640, 400_000.0, 5_000_000.0, GSD_M, -GSD_M)
LOW_M, HIGH_M = 200.0, 250.0


@functools.cache
def ground(seed: int = 1) -> ImageArray:
    """Four pixels to one of the field: fields, roads and houses, at random."""
    rng = np.random.default_rng(seed)
    image = np.full((GRID.height * 4, GRID.width * 4), 120, np.uint8)
    for _ in range(160):
        middle = rng.uniform((0, 0), image.shape[::-1])
        box = cv2.boxPoints((middle.tolist(), rng.uniform(60, 500, 2).tolist(), rng.uniform(0, 180)))
        cv2.fillPoly(image, [box.astype(np.int32)], int(rng.integers(60, 200)))
    for _ in range(900):
        middle = rng.uniform((0, 0), image.shape[::-1])
        box = cv2.boxPoints((middle.tolist(), rng.uniform(12, 50, 2).tolist(), rng.uniform(0, 180)))
        cv2.fillPoly(image, [box.astype(np.int32)], int(rng.integers(20, 250)))
    return image


@functools.cache
def field(seed: int = 1) -> CoarseField:
    small = np.asarray(cv2.resize(ground(seed), (GRID.width, GRID.height), interpolation=cv2.INTER_AREA), np.uint8)
    quantised = np.clip(np.rint(orientation_field(small, None, MEAN_PX) * 60.0), -127, 127).astype(np.int8)
    heights = np.full((GRID.height // 10, GRID.width // 10), LOW_M, np.float32)
    # The east is a terrace.
    heights[:, GRID.width // 20 :] = HIGH_M
    return CoarseField(GRID, quantised, heights, GRID.resized(GRID.width // 10, GRID.height // 10))


@pytest.fixture(scope="module")
def searcher() -> Searcher:
    return Searcher(field(), threads=1)


def seen(place: FloatArray, turn: FloatArray, above_m: float, seed: int = 1) -> ImageArray:
    """What the camera sees of the level ground from a place (E, N)."""
    fine = GRID.resized(GRID.width * 4, GRID.height * 4)
    foot = fine.px_from_map(place)
    gsd_m = fine.gsd_m
    # From pixels of the ground to metres from the camera, to pixels of the frame.
    metres = np.array([[gsd_m, 0, -gsd_m * foot[0]], [0, -gsd_m, gsd_m * foot[1]], [0, 0, -above_m]])
    matrix = CAMERA.matrix @ turn.T @ metres
    size = CAMERA.width, CAMERA.height
    return np.asarray(cv2.warpPerspective(ground(seed), matrix, size, flags=cv2.INTER_LINEAR), np.uint8)


def away_m(candidate: Candidate, place: FloatArray) -> float:
    return math.hypot(candidate.easting_m - place[0], candidate.northing_m - place[1])


PLACE = np.array([400_300.0, 4_999_400.0])


@pytest.mark.parametrize(
    ("tilt_deg", "heading_deg", "off_deg", "reach_deg"),
    [(0.0, 0.0, 0.0, 10.0), (4.0, 77.0, 8.5, 10.0), (-9.0, -140.0, -6.0, 10.0), (5.0, 30.0, 163.0, 180.0)],
)
def test_the_right_place_comes_first(
    searcher: Searcher, tilt_deg: float, heading_deg: float, off_deg: float, reach_deg: float
) -> None:
    true = turned_down(tilt_deg, heading_deg)
    believed = rotation.exp([0.0, 0.0, math.radians(off_deg)]) @ true
    frame = seen(PLACE, true, ABOVE_M)
    found = searcher.search(Sighting(frame, CAMERA, believed, math.radians(reach_deg), 0.98 * ABOVE_M))
    assert away_m(found[0], PLACE) < 2.5 * GSD_M
    assert found[0].score > 1.4 * found[1].score
    assert found[0].turn_rad == pytest.approx(-math.radians(off_deg), abs=math.radians(3.0))
    # Apart from each other, and in order.
    assert all(one.distance_m(other) > 8 * GSD_M for i, one in enumerate(found) for other in found[:i])
    assert [one.score for one in found] == sorted((one.score for one in found), reverse=True)


def test_a_barometer_counts_from_the_ground_below(searcher: Searcher) -> None:
    """On the terrace the same height above the sea is half of that above the ground."""
    for place, above_m in ((PLACE, 100.0), (PLACE + np.array([700.0, 0.0]), 50.0)):
        turn = turned_down(0.0, 20.0)
        known = Sighting(seen(place, turn, above_m), CAMERA, turn, math.radians(5.0), math.nan, 300.0)
        found = searcher.search(known)
        assert away_m(found[0], place) < 2.5 * GSD_M
        assert found[0].above_ground_m == pytest.approx(above_m, rel=0.01)


def test_at_the_maps_rim(searcher: Searcher) -> None:
    place = np.array([400_000.0 + 20.0, 5_000_000.0 - 30.0])
    turn = turned_down(0.0, 10.0)
    found = searcher.search(Sighting(seen(place, turn, ABOVE_M), CAMERA, turn, math.radians(10.0), ABOVE_M))
    assert away_m(found[0], place) < 2.5 * GSD_M


def test_blocks_hide_nothing_at_their_seams(monkeypatch: pytest.MonkeyPatch) -> None:
    """The same places, whatever the blocks."""
    turn = turned_down(0.0, 10.0)
    sighting = Sighting(seen(PLACE, turn, ABOVE_M), CAMERA, turn, math.radians(3.0), ABOVE_M)
    places = []
    for side in (700, 256):
        monkeypatch.setattr("ortholoc_edge.pipeline.search._BLOCK_PX", side)
        places.append(Searcher(field(), threads=2).search(sighting, 3))
    assert all(one.distance_m(other) == 0.0 for one, other in zip(*places, strict=True))
    # A block's mean energy is the floor of what a score is divided by.
    assert [one.score for one in places[0]] == pytest.approx([one.score for one in places[1]], rel=0.05)


def test_what_is_not_there_stands_out_by_little(searcher: Searcher) -> None:
    turn = turned_down(3.0, 50.0)
    for frame in (seen(PLACE, turn, ABOVE_M, seed=2), seen(PLACE, turn, ABOVE_M)[:, ::-1].copy()):
        found = searcher.search(Sighting(frame, CAMERA, turn, math.radians(10.0), ABOVE_M))
        assert found[0].score < 1.3 * found[1].score


def test_frames_that_show_nothing(searcher: Searcher) -> None:
    turn = turned_down()
    even = np.full((240, 320), 100, np.uint8)
    assert searcher.search(Sighting(even, CAMERA, turn, 0.1, ABOVE_M)) == []
    # From 10 m up the frame is 7 x 6 px of the field.
    assert searcher.search(Sighting(seen(PLACE, turn, 10.0), CAMERA, turn, 0.1, 10.0)) == []


def test_distinct_keeps_the_best_of_each_place() -> None:
    places = [Candidate(x, 0.0, 100.0, 0.0, score) for x, score in ((0.0, 0.5), (3.0, 0.6), (40.0, 0.4), (44.0, 0.3))]
    assert [(one.easting_m, one.score) for one in distinct(places, 10.0, 5)] == [(3.0, 0.6), (40.0, 0.4)]
    assert len(distinct(places, 10.0, 1)) == 1


def test_a_sequence_decides_what_a_frame_can_not() -> None:
    """Each frame likes a wrong place best; but only the right ones lie as the vehicle moved."""

    def places(*known: tuple[float, float, float]) -> list[Candidate]:
        return [Candidate(x, y, 100.0, 0.0, score) for x, y, score in (*known, (-7000.0, 300.0 * known[0][0], 0.2))]

    first = places((0.0, 0.0, 0.31), (500.0, 80.0, 0.29))
    second = places((900.0, 900.0, 0.30), (540.0, 52.0, 0.28))
    moved = np.array([42.0, -30.0])
    found = agreeing(second, [Former(first, moved)], 8.0)
    assert (found[0].easting_m, found[0].northing_m) == pytest.approx((540.0, 52.0), abs=3.0)
    assert found[0].score == pytest.approx((0.29 + 0.28) / 2)
    # A place of one frame alone has the other's worst for company.
    assert found[1].score == pytest.approx((0.31 + 0.2) / 2)
    # Moved the other way, nothing agrees.
    assert agreeing(second, [Former(first, -moved)], 8.0)[0].score == pytest.approx((0.31 + 0.2) / 2)
    assert agreeing(second, [], 8.0) == second
    # Three frames, the middle one blind.
    third = places((545.0, 100.0, 0.3))
    last = np.array([5.0, 48.0])
    [best, *_] = agreeing(third, [Former(first, moved + last), Former([], last)], 8.0)
    assert best.northing_m == pytest.approx(100.0, abs=3.0)
    assert best.score == pytest.approx((0.29 + 0.3) / 3)


def test_a_place_that_only_an_earlier_frame_had() -> None:
    seen_before = [Candidate(10.0, 0.0, 100.0, 0.1, 0.5)]
    [best] = agreeing([], [Former(seen_before, np.array([0.0, 30.0]))], 8.0)
    assert (best.easting_m, best.northing_m, best.score) == (10.0, 30.0, 0.25)


@pytest.mark.parametrize("reach_deg", [10.0, 60.0])
def test_only_inside_an_area(searcher: Searcher, reach_deg: float) -> None:
    """The right place is the best of all, and is not found where it is left out; nor is what is beyond."""
    turn = turned_down()
    sighting = Sighting(seen(PLACE, turn, ABOVE_M), CAMERA, turn, math.radians(reach_deg), ABOVE_M)
    there = circle(PLACE + np.array([60.0, 0.0]), 80.0)
    inside = searcher.search(sighting, within=there)
    assert away_m(inside[0], PLACE) < 4.0
    assert inside[0].score == pytest.approx(searcher.search(sighting)[0].score, abs=0.02)
    elsewhere = np.array([[400_500.0, 4_999_200.0], [401_200.0, 4_999_200.0], [401_200.0, 4_999_900.0]])
    found = searcher.search(sighting, within=elsewhere)
    assert found
    for one in found:
        assert cv2.pointPolygonTest(
            elsewhere.astype(np.float32) - np.float32([400_000.0, 5_000_000.0]),
            (one.easting_m - 400_000.0, one.northing_m - 5_000_000.0),
            True,
        ) > -GSD_M
    assert searcher.search(sighting, within=circle(np.array([390_000.0, 5_000_000.0]), 100.0)) == []


def test_a_circle_holds_what_it_should() -> None:
    corners = circle(np.array([5.0, -3.0, 99.0]), 100.0)
    middles = (corners + np.roll(corners, 1, axis=0)) / 2
    assert np.linalg.norm(middles - (5.0, -3.0), axis=1) == pytest.approx(100.0)


def test_level_that_suits_a_height() -> None:
    grids = [GRID.resized(GRID.width * 2**k, GRID.height * 2**k) for k in (2, 1, 0)]
    assert [grid.gsd_m for grid in grids] == pytest.approx([0.4, 0.8, 1.6])
    # 89 m are 55 px of 1.6 m, 90.7 m are 56.7.
    assert [fitting_level(grids, CAMERA, above_m) for above_m in (10.0, 60.0, 100.0, 102.0, 500.0)] == [0, 1, 1, 2, 2]
