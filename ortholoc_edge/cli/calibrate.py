"""``calibrate``: the camera's intrinsics, from pictures of a board."""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
from tqdm import tqdm

from ortholoc_edge.calibration.board import Board, parse_board
from ortholoc_edge.calibration.files import opencv_yaml_of, toml_of
from ortholoc_edge.calibration.lens import MODELS, LensCalibration, Refusal, calibrate
from ortholoc_edge.calibration.picture import draw
from ortholoc_edge.calibration.views import Looked, frames_of, look_for
from ortholoc_edge.cli.arguments import positive, positive_int, writable_folder
from ortholoc_edge.errors import CameraError, OrtholocError

_PIXEL_NAMES = ("fx", "fy", "cx", "cy")


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add ``calibrate``."""
    parser = subparsers.add_parser(
        "calibrate",
        help="a camera's intrinsics from pictures of a chessboard or ChArUco board",
        description="Finds a board in a folder of pictures or a video, takes sharp views that differ, and solves for "
        "focal lengths, principal point and as many terms of distortion as the views bear. What they don't tell is "
        "refused, with what to film. docs/calibration.md has the whole way. Exit code 0: calibrated; 1: not.",
    )
    parser.add_argument("source", type=Path, metavar="SOURCE", help="folder of pictures, or a video")
    parser.add_argument("--board", required=True, metavar="BOARD", help="chessboard:9x6, of inner corners, or "
                        "charuco:11x8[:DICT_5X5_1000][:legacy], of squares")  # fmt: skip
    parser.add_argument("--square-mm", type=positive, required=True, metavar="MM", help="side of a square, measured")
    parser.add_argument("--marker-mm", type=positive, metavar="MM", help="side of ChArUco's markers (default: 0.75 of "
                        "the squares)")  # fmt: skip
    parser.add_argument("--every", type=positive_int, default=1, metavar="N", help="look at each N-th picture "
                        "(default: %(default)s)")  # fmt: skip
    parser.add_argument("--most-views", type=positive_int, default=40, metavar="N", help="calibrate with so many at "
                        "most, the most different ones (default: %(default)s)")  # fmt: skip
    parser.add_argument("--model", choices=("auto", *MODELS), default="auto", help="terms of distortion; auto: the "
                        "fewest that do as well as any on views that take no part (default: %(default)s)")  # fmt: skip
    parser.add_argument("--out", type=Path, metavar="camera.toml", help="write [intrinsics] there: [intrinsics] file "
                        "takes it")  # fmt: skip
    parser.add_argument("--opencv", type=Path, metavar="camera.yaml", help="write OpenCV's YAML there")
    parser.add_argument("--picture", type=Path, metavar="camera.png", help="draw corners, residuals and views there")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    marker_m = None if args.marker_mm is None else args.marker_mm / 1000.0
    board = parse_board(args.board, args.square_mm / 1000.0, marker_m)
    for option, path in (("--out", args.out), ("--opencv", args.opencv), ("--picture", args.picture)):
        if path is not None:
            writable_folder(path.parent, option)
    if not args.source.exists():
        raise CameraError(f"{args.source}: no such file or folder")
    frames = tqdm(frames_of(args.source, args.every), desc=str(board), unit="picture", leave=False)
    looked = look_for(frames, board, args.most_views)
    found = calibrate(looked.views, board, looked.size, None if args.model == "auto" else args.model)
    if isinstance(found, LensCalibration):
        head = [_head(found, board, looked), *_sigma_lines(found)]
        _write(args.out, "--out", toml_of(found.camera, head))
        _write(args.opencv, "--opencv", opencv_yaml_of(found.camera))
    if args.picture is not None:
        picture = draw(found if isinstance(found, LensCalibration) else list(looked.views), looked.size)
        if not cv2.imwrite(str(args.picture), picture):
            raise OrtholocError(f"{args.picture}: can't be written; end its name in .png, or choose another --picture")
    print(json.dumps(_record(found, looked)) if args.json else _text(found, board, looked))
    return 0 if isinstance(found, LensCalibration) else 1


def _write(path: Path | None, option: str, text: str) -> None:
    if path is None:
        return
    try:
        path.write_text(text, encoding="utf-8")
    except OSError as err:
        raise OrtholocError(f"{path}: can't be written ({err}); choose another {option}") from err


def _head(found: LensCalibration, board: Board, looked: Looked) -> str:
    return (
        f"ortholoc-edge calibrate, {board}: {len(found.views)} views of {looked.looked_at} pictures, "
        f"{found.rms_px:.3f} px rms, distortion {found.model}."
    )


def _values(found: LensCalibration) -> Mapping[str, float]:
    camera = found.camera
    return dict(
        zip(
            (*_PIXEL_NAMES, "k1", "k2", "p1", "p2", "k3"),
            (camera.fx, camera.fy, camera.cx, camera.cy, *camera.distortion),
            strict=True,
        )
    )


def _sigma_lines(found: LensCalibration) -> list[str]:
    values = _values(found)
    return [
        f"{name} {values[name]:.{3 if name in _PIXEL_NAMES else 6}f}, 1-sigma "
        f"{found.sigma(name):.{3 if name in _PIXEL_NAMES else 6}f}{' px' if name in _PIXEL_NAMES else ''}"
        for name in found.names
    ]


def _text(found: LensCalibration | Refusal, board: Board, looked: Looked) -> str:
    left_out = ", ".join(f"{number} {why}" for why, number in looked.left_out.items()) or "none"
    lines = [f"{board} in {looked.looked_at} pictures: {len(looked.views)} views; left out: {left_out}"]
    if isinstance(found, Refusal):
        return "\n".join([*lines, f"not calibrated: {found.what}", f"what helps: {found.remedy}"])
    lines += [f"  {view.view.name}: {view.rms_px:.3f} px, tilted {view.tilt_deg:.0f} degrees" for view in found.views]
    lines += [f"  {name}: taken out, {why}" for name, why in found.removed.items()]
    tried = ", ".join(f"{model} {error:.3f}" for model, error in found.held_out_px.items())
    return "\n".join(
        [*lines, f"error of views that took no part, px rms, by terms of distortion: {tried}; taken: {found.model}",
         *_sigma_lines(found), f"all corners: {found.rms_px:.3f} px rms", "", toml_of(found.camera).rstrip()]
    )  # fmt: skip


def _record(found: LensCalibration | Refusal, looked: Looked) -> dict[str, Any]:
    record: dict[str, Any] = {
        "calibrated": isinstance(found, LensCalibration),
        "pictures": looked.looked_at,
        "left_out": dict(looked.left_out),
    }
    if isinstance(found, Refusal):
        return record | {"what": found.what, "remedy": found.remedy}
    return record | {
        "width_px": found.camera.width,
        "height_px": found.camera.height,
        **_values(found),
        "sigmas": {name: found.sigma(name) for name in found.names},
        "model": found.model,
        "rms_px": found.rms_px,
        "held_out_px": dict(found.held_out_px),
        "views": [
            {"name": view.view.name, "rms_px": view.rms_px, "tilt_deg": view.tilt_deg}
            for view in found.views
        ],
        "removed": dict(found.removed),
    }
