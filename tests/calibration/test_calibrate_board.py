"""A known camera is found again from rendered boards, within what it claims; and what is no calibration is refused."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from rendered_boards import Studio, poses

from ortholoc_edge.calibration.board import Board, Detector, Seen, parse_board
from ortholoc_edge.calibration.files import read_camera
from ortholoc_edge.calibration.lens import LensCalibration, Refusal, View, calibrate
from ortholoc_edge.calibration.views import MOST_BLUR_PX, farthest, look_for
from ortholoc_edge.cli import main
from ortholoc_edge.errors import CameraError, ConfigError
from ortholoc_edge.geometry import rotation
from ortholoc_edge.geometry.camera import Camera
from ortholoc_edge.pipeline.frame import Frame

CAMERA = Camera(640, 480, 520.0, 523.0, 327.3, 236.1, (-0.28, 0.09, 0.0008, -0.0005, 0.0))
SIZE = (640, 480)
CHESSBOARD = parse_board("chessboard:9x6", 0.025)
SMEARED = ("004.png", "011.png")


@pytest.fixture(scope="module")
def studio():
    return Studio(CAMERA, CHESSBOARD, finer=2)


@pytest.fixture(scope="module")
def folder(tmp_path_factory, studio):
    """A recording: 20 views, two of them smeared, a duplicate, and pictures without a board."""
    folder = tmp_path_factory.mktemp("board")
    rng = np.random.default_rng(4)
    for number, (turn, place) in enumerate(poses(CAMERA, CHESSBOARD, 20, rng)):
        name = f"{number:03d}.png"
        picture = studio.picture(turn, place, rng, smear=(12.0, 2.0) if name in SMEARED else None)
        cv2.imwrite(str(folder / name), picture)
        if number == 6:
            cv2.imwrite(str(folder / "006b.png"), studio.picture(turn, np.add(place, (0.0005, 0.0, 0.0)), rng))
    cv2.imwrite(str(folder / "020.png"), rng.integers(0, 255, (480, 640), dtype=np.uint8))
    return folder


def errors(found: LensCalibration, camera: Camera = CAMERA) -> np.ndarray:
    def values(one: Camera) -> dict[str, float]:
        k1, k2, p1, p2, k3 = one.distortion
        four = {"fx": one.fx, "fy": one.fy, "cx": one.cx, "cy": one.cy}
        return four | {"k1": k1, "k2": k2, "p1": p1, "p2": p2, "k3": k3}

    ours, true = values(found.camera), values(camera)
    return np.array([ours[name] - true[name] for name in found.names])


def test_the_whole_way(folder, tmp_path, capsys):
    """From a folder of pictures to the files, a picture to look at, and figures that are right within their sigmas."""
    toml, yaml, png = (tmp_path / name for name in ("camera.toml", "camera.yaml", "camera.png"))
    command = ["calibrate", str(folder), "--board", "chessboard:9x6", "--square-mm", "25", "--json"]
    assert main([*command, "--out", str(toml), "--opencv", str(yaml), "--picture", str(png)]) == 0
    told = json.loads(capsys.readouterr().out)
    left_out = told["left_out"]
    assert told["pictures"] == 22 and (left_out["no board"], left_out["blurred"]) == (1, 2)
    assert left_out["like others"] >= 1 and len(told["views"]) == 22 - sum(left_out.values())
    assert not set(SMEARED) & {view["name"] for view in told["views"]}
    assert told["model"] == "k1k2p1p2" and told["rms_px"] < 0.08
    for name, true in (("fx", 520.0), ("fy", 523.0), ("cx", 327.3), ("cy", 236.1), ("k1", -0.28), ("k2", 0.09)):
        sigma = told["sigmas"][name]
        assert abs(told[name] - true) < 4.0 * sigma, name
        assert sigma < (0.5 if name in ("fx", "fy", "cx", "cy") else 0.005), name
    camera = read_camera(toml)
    assert camera.fx == pytest.approx(told["fx"]) and camera == read_camera(yaml)
    assert "1-sigma" in toml.read_text()
    picture = cv2.imread(str(png))
    assert picture.shape[0] > 500 and picture.shape[1] > 1300 and (picture < 200).any()


def seen_from(camera: Camera, board: Board, turn, place, noise_px: float, rng) -> Seen:
    px = camera.project(board.points @ rotation.exp(turn).T + place)
    return Seen(np.arange(len(px)), px + noise_px * rng.standard_normal(px.shape), 3.0)


def corners(seed: int, count: int = 18, noise_px: float = 0.1, **others) -> list[View]:
    rng = np.random.default_rng(seed)
    camera = others.pop("camera", CAMERA)
    found = poses(camera, CHESSBOARD, count, rng, **others)
    return [View(str(i), seen_from(camera, CHESSBOARD, *pose, noise_px, rng)) for i, pose in enumerate(found)]


def test_sigmas_are_honest():
    """The normalised error squared, over what was solved for, of five sets of corners: 1, give or take 0.22."""
    nees = []
    for seed in range(5):
        found = calibrate(corners(seed), CHESSBOARD, SIZE, "k1k2p1p2")
        assert isinstance(found, LensCalibration), found
        off = errors(found)
        nees.append(off @ np.linalg.solve(found.covariance, off) / len(off))
    assert 0.4 < np.mean(nees) < 1.6


@pytest.mark.parametrize(
    ("distortion", "model"),
    [((0.0,) * 5, "none"), ((-0.1, 0.0, 0.0, 0.0, 0.0), "k1"), ((-0.28, 0.09, 0.0, 0.0, 0.0), "k1k2")],
)
def test_no_more_terms_than_the_views_bear(distortion, model):
    """A term too many fits the noise, and bends the picture's corners."""
    camera = Camera(640, 480, 520.0, 523.0, 327.3, 236.1, distortion)
    found = calibrate(corners(5, 24, camera=camera), CHESSBOARD, SIZE)
    assert isinstance(found, LensCalibration) and found.model == model


def test_a_view_that_shows_something_else_is_taken_out():
    views = corners(1)
    bent = views[3].seen.px + 0.01 * (views[3].seen.px - views[3].seen.px.mean(axis=0)) ** 2
    views[3] = View("bent", Seen(views[3].seen.ids, bent, 3.0))
    found = calibrate(views, CHESSBOARD, SIZE, "k1k2p1p2")
    assert isinstance(found, LensCalibration)
    assert list(found.removed) == ["bent"] and "px rms where" in found.removed["bent"]
    assert np.all(np.abs(errors(found)) < 4.0 * np.sqrt(np.diag(found.covariance)))


def test_a_wrong_corner_spoils_no_view():
    views = corners(2)
    px = views[5].seen.px.copy()
    px[7] += (9.0, -4.0)
    views[5] = View("5", Seen(views[5].seen.ids, px, 3.0))
    found = calibrate(views, CHESSBOARD, SIZE, "k1k2p1p2")
    assert isinstance(found, LensCalibration) and not found.removed
    assert 7 not in found.views[5].view.seen.ids and len(found.views[5].view.seen.ids) == 53


def refusal(views: list[View]) -> Refusal:
    found = calibrate(views, CHESSBOARD, SIZE, "k1k2")
    assert isinstance(found, Refusal), found
    return found


def test_what_is_no_calibration_is_refused_with_what_to_film():
    assert "1 usable views" in refusal(corners(3)[:1]).what
    flat = refusal(corners(3, tilt_deg=3.0))
    assert "tilted by 15 degrees and more in 0 views" in flat.what and "20 to 45 degrees" in flat.remedy
    left = [view for view in corners(3, 40) if (view.seen.px[:, 0] < 425).all()]
    assert "right" in refusal(left).what and "film the board there" in refusal(left).remedy
    rng = np.random.default_rng(8)
    nodding = [
        View(str(number), seen_from(CAMERA, CHESSBOARD, (rng.choice([-0.5, 0.4]), 0, 0), place, 0.1, rng))
        for number, (_, place) in enumerate(poses(CAMERA, CHESSBOARD, 24, rng, tilt_deg=1.0))
    ]
    assert "about one axis only" in refusal(nodding).what
    assert "px off their places" in refusal(corners(3, noise_px=1.0)).what


def test_a_refused_recording_says_so(folder, tmp_path, capsys):
    """Exit code 1, nothing written but the picture."""
    few = tmp_path / "few"
    few.mkdir()
    (few / "000.png").write_bytes((folder / "000.png").read_bytes())
    out, png = tmp_path / "camera.toml", tmp_path / "camera.png"
    command = ["calibrate", str(few), "--board", "chessboard:9x6", "--square-mm", "25", "--out", str(out)]
    assert main([*command, "--picture", str(png)]) == 1
    told = capsys.readouterr().out
    assert "not calibrated: 1 usable views of the board, and 10 are the least" in told and "what helps: film" in told
    assert not out.exists() and png.exists()


def frames(*pictures) -> list[Frame]:
    return [Frame(number, picture, f"{number}.png") for number, picture in enumerate(pictures)]


def test_a_miscounted_board_is_told(studio):
    """Squares counted for corners, say."""
    picture = studio.picture((0.2, 0.1, 0.0), (-0.1, -0.06, 0.35))
    for wrong in ("chessboard:10x7", "chessboard:8x6"):
        board = parse_board(wrong, 0.025)
        if Detector(board).find(picture) is not None:
            continue
        with pytest.raises(CameraError, match="found in none of 1 pictures; but chessboard:9x6 was: count the inner"):
            look_for(frames(picture), board, 40)
    with pytest.raises(CameraError, match="white margin around it"):
        look_for(frames(np.full((480, 640), 99, np.uint8)), CHESSBOARD, 40)


def test_blur_is_told_from_sharpness_in_any_direction(studio):
    detector = Detector(CHESSBOARD)
    pose = (0.2, 0.1, 0.3), (-0.1, -0.06, 0.35)
    sharp = detector.find(studio.picture(*pose))
    assert sharp is not None and sharp.blur_px < 0.75 * MOST_BLUR_PX
    for smear in ((11.0, 0.0), (0.0, 11.0), (8.0, 8.0)):
        smeared = detector.find(studio.picture(*pose, smear=smear))
        assert smeared is None or smeared.blur_px > 1.2 * MOST_BLUR_PX, smear
    with pytest.raises(CameraError, match="blurred in each of the 1 pictures"):
        look_for(frames(studio.picture(*pose, blur_px=3.5)), CHESSBOARD, 40)


def test_pictures_of_two_sizes_are_refused(studio):
    picture = studio.picture((0.2, 0.1, 0.0), (-0.1, -0.06, 0.35))
    with pytest.raises(CameraError, match=r"1.png: 320 x 240 px, the pictures before 640 x 480"):
        look_for(frames(picture, picture[::2, ::2].copy()), CHESSBOARD, 40)


@pytest.mark.parametrize("spec", ["charuco:9x7", "charuco:8x6:DICT_4X4_100:legacy"])
def test_charuco_corners_lie_where_they_are(spec):
    """Also of a board that is partly out of the picture."""
    board = parse_board(spec, 0.03, 0.02)
    studio = Studio(CAMERA, board, finer=2)
    for turn, place in (((0.3, -0.2, 0.1), (-0.1, -0.08, 0.4)), ((0.1, 0.3, 0.0), (-0.28, -0.1, 0.4))):
        seen = Detector(board).find(studio.picture(turn, place, np.random.default_rng(1)))
        assert seen is not None
        true = CAMERA.project(board.points[seen.ids] @ rotation.exp(turn).T + place)
        assert np.sqrt(np.mean(np.sum((seen.px - true) ** 2, axis=1))) < 0.15


def test_of_many_views_the_most_different_are_taken():
    views = corners(0, 30)
    kept = farthest(views, SIZE, 12)
    assert len(kept) == 12 and isinstance(calibrate(kept, CHESSBOARD, SIZE, "k1k2p1p2"), LensCalibration)


@pytest.mark.parametrize(
    ("text", "marker", "why"),
    [
        ("chess:9x6", None, "write chessboard:COLUMNSxROWS"), ("chessboard:2x6", None, "from 3 to 60"),
        ("chessboard:9x6:DICT_4X4_50", None, "neither a dictionary nor markers"),
        ("charuco:9x6:DICT_9X9_9", None, "no dictionary DICT_9X9_9; there are"),
        ("charuco:9x6", 0.03, "they are smaller"),
    ],
)  # fmt: skip
def test_a_board_that_can_not_be_is_refused(text, marker, why):
    with pytest.raises(ConfigError, match=why):
        parse_board(text, 0.025, marker)


def test_a_video_is_a_source_too(folder, tmp_path, capsys):
    path = str(tmp_path / "board.avi")
    writer = cv2.VideoWriter(path, cv2.VideoWriter.fourcc(*"MJPG"), 10.0, SIZE)
    if not writer.isOpened():
        pytest.skip("this OpenCV writes no MJPG")
    for file in sorted(Path(folder).glob("0*.png"))[:3]:
        writer.write(cv2.imread(str(file)))
    writer.release()
    assert main(["calibrate", path, "--board", "chessboard:9x6", "--square-mm", "25"]) == 1
    assert "in 3 pictures: 3 views" in capsys.readouterr().out

