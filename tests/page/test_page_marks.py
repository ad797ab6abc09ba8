"""What the page is told of outcomes, and what is kept of them."""

from __future__ import annotations

import math
from itertools import pairwise

import cv2
import msgspec
import numpy as np
import pytest
from ortholoc_sim import demo_pack_path

from ortholoc_edge.adapters.page.board import Board
from ortholoc_edge.adapters.page.ground_page import thumbnail
from ortholoc_edge.adapters.page.marks import Drawing, Mark, Pose, ground_of
from ortholoc_edge.adapters.page.orthophoto import TILE_PX, Orthophoto, jpeg
from ortholoc_edge.geometry import frames, rotation
from ortholoc_edge.geometry.arrays import FloatArray
from ortholoc_edge.geometry.camera import Camera
from ortholoc_edge.geometry.rigid import Rigid3
from ortholoc_edge.pipeline.frame import CameraMount, VehicleState
from ortholoc_edge.pipeline.outcome import Fix, Reason, Rejected
from ortholoc_edge.pipeline.prior import PosePrior, footprint, outline
from ortholoc_edge.tiles.pack import Pack
from ortholoc_edge.tiles.store import MapStore

CAMERA = Camera.from_focal(400, 300, 200.0)
ORIGIN = (647000.0, 5407000.0)
NADIR = Rigid3(frames.BODY_FROM_NADIR_CAMERA, np.zeros(3))


def down(yaw_deg: float, height_m: float = 100.0) -> Rigid3:
    """A camera that looks down from 100 m, 20 m east and 30 m north of the origin, the nose at a grid heading."""
    ned_from_body = rotation.from_euler(0.0, 0.0, math.radians(yaw_deg))
    turn = frames.map_from_ned_rotation(0.0) @ ned_from_body @ frames.BODY_FROM_NADIR_CAMERA
    return Rigid3(turn, np.array([ORIGIN[0] + 20.0, ORIGIN[1] + 30.0, height_m]))


def a_fix(pose: Rigid3, covariance: FloatArray | None = None, points: int = 10) -> Fix:
    px = np.stack([np.linspace(10.0, 300.0, points), np.linspace(20.0, 200.0, points)], axis=1)
    rays = CAMERA.unproject(px) @ pose.rotation.T
    on_ground = pose.translation + rays * (pose.translation[2] / -rays[:, 2:])
    return Fix(
        stamp_ns=5_000_000_123, map_from_camera=pose, camera=CAMERA,
        covariance=np.eye(6) * 0.25 if covariance is None else covariance, quality=0.5, matches=200, inliers=100,
        rms_px=1.234567, adhop_accepted=True, query_px=px, points_map=on_ground,
        timings_ms={"match": 12.3456, "total": 20.0},
    )  # fmt: skip


DRAWING = Drawing(ORIGIN, CAMERA, NADIR)


@pytest.mark.parametrize("yaw_deg", [0.0, 90.0, 215.0])
def test_a_fix_is_drawn_where_it_is_and_as_it_heads(yaw_deg: float) -> None:
    fix = a_fix(down(yaw_deg))
    mark = DRAWING.mark(7, fix, ground_of(fix), late_ms=40.06)
    assert mark.fix is not None
    assert mark.fix.at == (20.0, 30.0, 100.0)
    assert mark.fix.heading_deg == pytest.approx(yaw_deg, abs=0.1)
    assert (mark.n, mark.t, mark.late_ms, mark.inliers, mark.rms_px) == (7, 5000.0, 40.1, 100, 1.23)
    assert mark.took_ms == {"match": 12.3, "total": 20.0}
    # 400 x 300 px at f = 200 px from 100 m: 200 m x 150 m, the long side across the nose.
    rim = np.array(mark.fix.rim) - (20.0, 30.0)
    nose = np.array([math.sin(math.radians(yaw_deg)), math.cos(math.radians(yaw_deg))])
    assert np.abs(rim @ nose).max() == pytest.approx(75.0, abs=0.1)
    assert np.abs(rim @ (nose[1], -nose[0])).max() == pytest.approx(100.0, abs=0.1)


def test_covariance_is_that_of_the_map_axes() -> None:
    covariance = np.eye(6)
    covariance[:2, :2] = [[4.0, 1.5], [1.5, 1.0]]
    covariance[2, 2] = 9.0
    fix = DRAWING.mark(0, a_fix(down(0.0), covariance), None).fix
    assert fix is not None
    assert fix.cov == (4.0, 1.5, 1.0)
    assert fix.sigma_h == 3.0


def test_a_rejection_has_reason_and_prediction() -> None:
    rejected = Rejected(2_000_000, Reason.LOW_CONTRAST, "hardly better", 4.5, float("nan"))
    prior = PosePrior(down(90.0), np.eye(6) * 16.0)
    state = VehicleState(
        2_000_000, np.eye(3), (0.1, 0.1, 0.1), position_map_m=np.array([ORIGIN[0] + 1.0, ORIGIN[1] - 2.0, 0.0]),
        believed_map_m=np.array([math.nan, 0.0, 0.0]),
    )  # fmt: skip
    mark = DRAWING.mark(1, rejected, 0.0, prior=prior, state=state)
    assert mark.fix is None and mark.prior is not None
    assert mark.prior.at[:2] == (20.0, 30.0) and mark.prior.cov == (16.0, 0.0, 16.0) and len(mark.prior.rim) == 16
    assert (mark.reason, mark.gnss, mark.believed) == ("low_contrast", (1.0, -2.0), None)
    text = msgspec.json.encode(mark)
    assert b"NaN" not in text and msgspec.json.decode(text)["limit"] is None
    assert b"inliers" not in text, "what it has not costs nothing"


def test_in_a_gimbal_the_nose_is_known_by_its_state_alone() -> None:
    drawing = Drawing(ORIGIN, CAMERA, None)
    assert drawing.mark(0, a_fix(down(90.0)), None).fix.heading_deg is None  # type: ignore[union-attr]
    state = VehicleState(0, np.eye(3), (0.1, 0.1, 0.1), mount=CameraMount(NADIR))
    assert drawing.mark(0, a_fix(down(90.0)), None, state=state).fix.heading_deg == 90.0  # type: ignore[union-attr]


def test_below_the_ground_nothing_is_seen() -> None:
    mark = DRAWING.mark(0, Rejected(0, Reason.LATE), 150.0, prior=PosePrior(down(0.0), np.eye(6)))
    assert mark.prior is not None and mark.prior.rim == []


def test_inliers_are_where_they_were_seen_and_few() -> None:
    fix = a_fix(down(40.0), points=700)
    rows = np.array(DRAWING.inliers(fix, 0.5))
    assert 100 < len(rows) <= 150
    # The centre of the first pixel of the frame is half a pixel from its corner, in the small picture a quarter.
    assert rows[0, :2] == pytest.approx((fix.query_px[0] + 0.5) * 0.5, abs=0.06)
    assert np.abs(rows[:, :2] - rows[:, 2:4]).max() < 0.11, "the pose puts them there, too"
    assert rows[0, 4:] == pytest.approx(fix.points_map[0, :2] - ORIGIN, abs=0.006)
    assert DRAWING.inliers(a_fix(down(0.0), points=0), 0.5) == []
    assert ground_of(a_fix(down(0.0), points=0)) is None
    assert ground_of(fix) == pytest.approx(0.0, abs=1e-6)


def test_the_outline_is_the_rim_of_the_footprint_once_around() -> None:
    pose = Rigid3(down(30.0).rotation @ rotation.from_euler(0.4, 0.2, 0.0), down(30.0).translation)
    # Near zero: OpenCV's hull is of single precision.
    rim, everything = (of(CAMERA, pose, 10.0) - ORIGIN for of in (outline, footprint))
    hull = cv2.convexHull(everything.astype(np.float32)).reshape(-1, 2)
    assert cv2.contourArea(rim.astype(np.float32)) == pytest.approx(cv2.contourArea(hull), rel=1e-3)
    steps = [float(np.linalg.norm(b - a)) for a, b in pairwise([*rim, rim[0]])]
    assert max(steps) < 0.5 * float(np.ptp(rim, axis=0).max()), "no step leads across"


# -- the board -----------------------------------------------------------------------------------------


def marks(count: int) -> Board:
    board = Board()
    for n in range(count):
        pose = Pose(at=(float(n), 0.0, 0.0), cov=(1.0, 0.0, 1.0), sigma_h=1.0, rim=[(0.0, 0.0)])
        board.add(Mark(n=n, t=float(n), fix=pose if n % 4 else None, prior=pose))
    return board


def test_who_comes_first_gets_the_last_in_full_and_the_way_before() -> None:
    board = marks(300)
    shown, way = board.since(-1), board.track()
    assert [mark.n for mark in shown] == list(range(180, 300))
    assert [place[3] for place in way] == list(range(180))
    assert {place[2] for place in way if place[3] % 4} == {1} and {place[2] for place in way if not place[3] % 4} == {0}
    assert [bool(mark.prior.rim) for mark in shown if mark.prior] == [False] * 119 + [True]


def test_who_follows_gets_what_is_new() -> None:
    board = marks(10)
    assert [mark.n for mark in board.since(7)] == [8, 9]
    assert board.since(9) == []
    assert board.since(-1)[0].n == 0
    assert Board().since(-1) == [] and Board().track() == []


def test_a_long_flight_is_thinned_but_kept_whole() -> None:
    board = marks(20_000)
    way = board.track()
    assert len(way) <= 4000
    assert way[0][3] < 200 and way[-1][3] > 19_800
    assert max(b[3] - a[3] for a, b in pairwise(way)) <= 8, "as evenly as it was flown"


# -- pictures ------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def photo() -> Orthophoto:
    return Orthophoto(MapStore(Pack.open(demo_pack_path())))


def decoded(tile: bytes | None) -> np.ndarray:
    assert tile is not None
    image = cv2.imdecode(np.frombuffer(tile, np.uint8), cv2.IMREAD_COLOR)
    assert image is not None
    return image[..., ::-1].astype(float)


def test_tiles_show_the_pack_where_it_is(photo: Orthophoto) -> None:
    store = photo._store
    west, _, _, north = store.bounds
    side_m = TILE_PX * 0.25
    window = store.read_colour((west + side_m, north - side_m, west + 2 * side_m, north), 0.25)
    assert window is not None and window.rgb.shape == (TILE_PX, TILE_PX, 3)
    tile = decoded(photo.tile(0, 1, 0))
    assert 0.2 < window.valid.mean() < 0.95
    assert np.abs(tile - window.rgb)[window.valid].mean() < 8.0
    assert np.abs(tile - 226.0)[~window.valid].mean() < 3.0, "paper where there is none"
    assert photo.tile(0, 1, 0) is photo.tile(0, 1, 0), "drawn once"


def test_a_coarser_tile_is_the_same_place_in_less_detail(photo: Orthophoto) -> None:
    coarse = decoded(photo.tile(1, 0, 0))
    fine = np.hstack([decoded(photo.tile(0, column, 0)) for column in (0, 1)])
    shrunk = cv2.resize(fine, (TILE_PX, TILE_PX // 2), interpolation=cv2.INTER_AREA)
    assert np.abs(coarse[: TILE_PX // 2] - shrunk).mean() < 6.0


def test_beyond_the_packs_levels_and_edges(photo: Orthophoto) -> None:
    coarsest = decoded(photo.tile(photo.levels - 1, 0, 0))
    # 608 m x 512 m at 8 m/px in the upper left corner, and grey paper.
    assert coarsest[:64, :76].std() > 10.0
    assert np.abs(coarsest[80:, 90:] - 226.0).max() < 12.0
    for none in ((photo.levels, 0, 0), (-1, 0, 0), (0, 5, 0), (0, 0, 4), (0, -1, 0)):
        assert photo.tile(*none) is None


def test_what_was_drawn_is_kept_within_a_limit(photo: Orthophoto, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ortholoc_edge.adapters.page.orthophoto._CACHE_BYTES", 60_000)
    for column in range(4):
        photo.tile(0, column, 1)
    assert sum(map(len, photo._drawn.values())) == photo._bytes <= 60_000


def test_frames_become_small() -> None:
    small = thumbnail(np.zeros((960, 1280, 3), np.uint8))
    assert small is not None and small[0].shape == (360, 480, 3) and small[1] == 0.375
    grey = thumbnail(np.zeros((100, 200), np.uint8))
    assert grey is not None and grey[0].shape == (100, 200)
    assert jpeg(grey[0], 65)[:2] == b"\xff\xd8"
    assert thumbnail(np.zeros((0, 0), np.uint8)) is None
    assert thumbnail(np.zeros((4, 4), np.float32)) is None
