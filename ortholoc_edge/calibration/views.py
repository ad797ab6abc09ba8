"""Which pictures of a recording are worth calibrating with: sharp, and unlike each other."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ortholoc_edge.adapters.camera import BadFrameError, CameraOptions, EndOfFrames, open_source
from ortholoc_edge.calibration.board import Board, Detector
from ortholoc_edge.calibration.lens import View
from ortholoc_edge.clock import ManualClock
from ortholoc_edge.errors import CameraError
from ortholoc_edge.geometry.arrays import ImageArray
from ortholoc_edge.pipeline.frame import Frame, grey_of

_S = 1_000_000_000
# Edges of a sharp picture are 2 to 3 px wide, with the smoothing that they are measured with.
MOST_BLUR_PX = 6.0
# Mean distance of the same corners in two views, as a part of the picture's diagonal.
_ALIKE = 0.02
# Two ways of counting that people mix up with inner corners, tried to tell them so.
_MISCOUNTED = ((-1, -1), (1, 1), (0, -1), (-1, 0), (0, 1), (1, 0))
_TRIED = 5


@dataclass(frozen=True, slots=True, eq=False)
class Looked:
    """What came of a recording.

    Attributes:
        size: width and height of its pictures, px. looked_at: how many of them.
        views: to calibrate with.
        left_out: how many were for which reason.
    """

    size: tuple[int, int]
    looked_at: int
    views: tuple[View, ...]
    left_out: Counter[str]


def frames_of(source: Path, every: int) -> Iterator[Frame]:
    """Each ``every``-th frame of a folder of pictures or of a video.

    Raises: CameraError for what is neither.
    """
    kind = "folder" if source.is_dir() else "video"
    clock = ManualClock()
    opened = open_source(CameraOptions(source=f"{kind}:{source}", rate_hz=10.0, realtime=False), clock)
    number = 0
    try:
        while True:
            clock.set_ns(clock.now_ns() + _S)
            try:
                frame = opened.read(0.0)
            except BadFrameError:
                continue
            except EndOfFrames:
                return
            if frame is not None:
                if number % every == 0:
                    yield frame
                number += 1
    finally:
        opened.close()


def look_for(frames: Iterable[Frame], board: Board, most: int) -> Looked:
    """The views of a board that are worth calibrating with, at most so many.

    Raises: CameraError where there are none, or the pictures are of several sizes.
    """
    detector = Detector(board)
    found: list[View] = []
    size: tuple[int, int] | None = None
    left_out: Counter[str] = Counter()
    without: list[ImageArray] = []
    looked_at = 0
    for frame in frames:
        grey = grey_of(frame.image)
        here = grey.shape[1], grey.shape[0]
        if size is not None and here != size:
            raise CameraError(
                f"{frame.name}: {here[0]} x {here[1]} px, the pictures before {size[0]} x {size[1]}; calibrate with "
                "those of one size"
            )
        size = here
        looked_at += 1
        seen = detector.find(grey)
        if seen is None:
            left_out["no board"] += 1
            if len(without) < _TRIED:
                without.append(grey)
        elif seen.blur_px > MOST_BLUR_PX:
            left_out["blurred"] += 1
        else:
            found.append(View(frame.name, seen))
    if size is None:
        raise CameraError("there is no picture to look at")
    if not found and left_out["blurred"]:
        raise CameraError(
            f"{board} is blurred in each of the {left_out['blurred']} pictures that it was found in; more light, a "
            "shorter exposure, the right focus, and hold it still"
        )
    if not found:
        raise CameraError(f"{board} was found in none of {looked_at} pictures; {_advice(board, without)}")
    unlike = _unlike(found, size)
    left_out["like others"] = len(found) - len(unlike)
    kept = farthest(unlike, size, most)
    left_out["more than needed"] = len(unlike) - len(kept)
    return Looked(size, looked_at, tuple(kept), +left_out)


def _advice(board: Board, pictures: list[ImageArray]) -> str:
    """Whether another count would have been found."""
    if board.kind == "charuco":
        return "is it that number of squares, and that dictionary? Boards of OpenCV before 4.6 need ':legacy'"
    for columns, rows in _MISCOUNTED:
        other = Board(board.kind, board.columns + columns, board.rows + rows, board.square_m)
        if min(other.columns, other.rows) < 3:
            continue
        detector = Detector(other)
        if any(detector.find(picture) is not None for picture in pictures):
            return f"but {other} was: count the inner corners, where four squares meet"
    return "count its inner corners, where four squares meet, and leave a white margin around it"


def _unlike(views: list[View], size: tuple[int, int]) -> list[View]:
    """The sharper of those that are alike."""
    least_px = _ALIKE * float(np.hypot(*size))
    kept: list[View] = []
    for view in sorted(views, key=lambda one: one.seen.blur_px):
        if all(_apart_px(view, other) > least_px for other in kept):
            kept.append(view)
    order = {id(view): number for number, view in enumerate(views)}
    return sorted(kept, key=lambda one: order[id(one)])


def _apart_px(one: View, other: View) -> float:
    """Mean distance of the corners that both have; infinite without any."""
    _, here, there = np.intersect1d(one.seen.ids, other.seen.ids, assume_unique=True, return_indices=True)
    if not len(here):
        return float("inf")
    return float(np.linalg.norm(one.seen.px[here] - other.seen.px[there], axis=1).mean())


def farthest(views: list[View], size: tuple[int, int], most: int) -> list[View]:
    """So many that are as unlike each other as can be."""
    if len(views) <= most:
        return views
    middle = np.array(size) / 2
    # That nearest the rim first: what lies there is rare.
    chosen = [max(range(len(views)), key=lambda i: float(np.abs(views[i].seen.px - middle).max()))]
    apart = np.array([_apart_px(view, views[chosen[0]]) for view in views])
    while len(chosen) < most:
        far = int(np.where(np.isin(np.arange(len(views)), chosen), -1.0, np.minimum(apart, 1e9)).argmax())
        chosen.append(far)
        apart = np.minimum(apart, [_apart_px(view, views[far]) for view in views])
    return [views[i] for i in sorted(chosen)]
