"""Pictures of boards by a known camera: rays through its lens to a plane, several to a pixel; then blur and noise."""

from __future__ import annotations

import cv2
import numpy as np

from ortholoc_edge.calibration.board import Board
from ortholoc_edge.geometry import rotation
from ortholoc_edge.geometry.camera import Camera

_PX_PER_SQUARE = 48
_MARGIN_SQUARES = 1
_PAPER, _TABLE = 235, 120


def texture(board: Board) -> np.ndarray:
    """The printed sheet with a margin; the first inner corner is `_MARGIN_SQUARES` + 1 squares from its corner."""
    squares = np.array([board.columns + 1, board.rows + 1])
    side = _PX_PER_SQUARE
    if board.kind == "charuco":
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, board.dictionary))
        made = cv2.aruco.CharucoBoard(tuple(squares.tolist()), board.square_m, board.marker_m, dictionary)
        made.setLegacyPattern(board.legacy)
        inner = made.generateImage(tuple((squares * side).tolist()))
    else:
        row, column = np.mgrid[0 : squares[1] * side, 0 : squares[0] * side] // side
        inner = np.where((row + column) % 2 == 0, 0, 255).astype(np.uint8)
    inner = np.clip(inner, 20, _PAPER).astype(np.uint8)
    return cv2.copyMakeBorder(inner, *[_MARGIN_SQUARES * side] * 4, cv2.BORDER_CONSTANT, value=_PAPER)


class Studio:
    """One camera and one board."""

    def __init__(self, camera: Camera, board: Board, finer: int = 3):
        self.camera, self.board, self._finer = camera, board, finer
        self._texture = texture(board)
        px = np.stack(np.meshgrid(np.arange(camera.width), np.arange(camera.height)), axis=-1)
        # Between pixels the lens is as good as linear: 0.001 px. OpenCV resizes by (k + 0.5) s - 0.5, as we do.
        self._rays = cv2.resize(camera.unproject(px), None, fx=finer, fy=finer, interpolation=cv2.INTER_LINEAR)

    def picture(self, rvec, tvec, rng=None, blur_px=0.6, noise=2.0, smear=None) -> np.ndarray:
        """Grey, of a board at a pose in camera axes, m.

        Args:
            smear: (2,) px that the picture moves while the shutter is open.
        """
        turn = rotation.exp(rvec)
        normal, place = turn[:, 2], np.asarray(tvec, dtype=np.float64)
        reach = (normal @ place) / (self._rays @ normal)
        on_board = (self._rays * reach[..., None] - place) @ turn[:, :2]
        # Pixel centres at integers: the texture's first corner of squares is at pixel -0.5.
        px = (on_board / self.board.square_m + 1 + _MARGIN_SQUARES) * _PX_PER_SQUARE - 0.5
        px = np.where((reach > 0)[..., None], px, -1e4).astype(np.float32)
        fine = cv2.remap(self._texture, px, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=_TABLE)
        size = self.camera.width, self.camera.height
        grey = cv2.resize(fine, size, interpolation=cv2.INTER_AREA).astype(np.float32)
        grey = cv2.GaussianBlur(grey, (0, 0), blur_px) if blur_px else grey
        if smear is not None:
            length = int(np.ceil(np.abs(smear).max()))
            steps = np.linspace(-0.5, 0.5, 2 * length + 1)
            shifted = [
                cv2.warpAffine(grey, np.float32([[1, 0, t * smear[0]], [0, 1, t * smear[1]]]), grey.shape[::-1])
                for t in steps
            ]
            grey = np.mean(shifted, axis=0)
        if rng is not None:
            grey = grey * rng.uniform(0.8, 1.05) + noise * rng.standard_normal(grey.shape)
        return np.clip(np.round(grey), 0, 255).astype(np.uint8)


def poses(camera: Camera, board: Board, count: int, rng, tilt_deg=35.0, fill=(0.35, 0.75)):
    """(rvec, tvec) of boards all over the picture, tilted every way; whole in view as far as a pinhole can tell."""
    made = []
    middle = np.array([(board.columns - 1) / 2, (board.rows - 1) / 2, 0.0]) * board.square_m
    width = (board.columns + 1) * board.square_m
    outline = board.square_m * np.array(
        [[-1, -1, 0], [board.columns, -1, 0], [board.columns, board.rows, 0], [-1, board.rows, 0]], dtype=float
    )
    while len(made) < count:
        distance = camera.fx * width / (rng.uniform(*fill) * camera.width)
        about = rng.uniform(0, 2 * np.pi)
        turn = rotation.exp([0, 0, rng.choice([0.0, np.pi / 2]) + rng.normal(0, 0.15)]) @ rotation.exp(
            np.radians(rng.uniform(0.2, 1.0) * tilt_deg) * np.array([np.cos(about), np.sin(about), 0])
        )
        # Each ninth of the picture in its turn.
        ninth = np.array([len(made) % 3, len(made) // 3 % 3])
        at = (ninth + rng.uniform(0, 1, 2)) / 3 * (camera.width, camera.height)
        centre = camera.unproject(at) * distance
        if not np.isfinite(centre).all():
            continue
        place = centre - turn @ middle
        px = camera.project(outline @ turn.T + place)
        if np.isfinite(px).all() and (px > 4).all() and (px < np.array([camera.width, camera.height]) - 4).all():
            made.append((rotation.log(turn), place))
    return made
