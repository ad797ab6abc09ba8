"""``convert-calibration``: what a calibration file says, as the daemon takes it."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from ortholoc_edge.calibration.files import describe, fit, opencv_yaml_of, read_camera, toml_of
from ortholoc_edge.cli.arguments import positive_int
from ortholoc_edge.errors import OrtholocError

# A lens that is off by so much at the rim costs less than the map's own errors.
_GOOD_FIT_PX = 0.25


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add ``convert-calibration``."""
    parser = subparsers.add_parser(
        "convert-calibration",
        help="a calibration of OpenCV, Kalibr or ROS as [intrinsics]",
        description="Reads a calibration file as [intrinsics] file does and prints it as [intrinsics], to be pasted "
        "into a vehicle's file, or as OpenCV's YAML. Lenses with more than k1, k2, p1, p2, k3 are refused; with --fit "
        f"they are approached, and refused where that is more than {_GOOD_FIT_PX} px off.",
    )
    parser.add_argument("file", type=Path, metavar="FILE", help="YAML of OpenCV, Kalibr or ROS, JSON, or our TOML")
    parser.add_argument("--camera", metavar="cam0", help="which of a file of Kalibr's with several")
    parser.add_argument("--width", type=positive_int, metavar="PX", help="of the pictures, where the file has no size")
    parser.add_argument("--height", type=positive_int, metavar="PX")
    parser.add_argument("--fit", action="store_true", help="approach a rational or fisheye lens")
    parser.add_argument("--to", choices=("toml", "opencv"), default="toml", help="form (default: %(default)s)")
    parser.add_argument("--out", type=Path, metavar="FILE", help="write it there (default: print it)")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    size = (args.width, args.height)
    head = [f"From {args.file.name}."]
    if args.fit:
        found = describe(args.file, args.camera, size)
        fitted = fit(args.file, found)
        told = f"{found.model} lens approached: at most {fitted.worst_px:.3f} px off, rms {fitted.rms_px:.3f} px"
        if fitted.worst_px > _GOOD_FIT_PX:
            raise OrtholocError(
                f"{args.file}: {told}, and {_GOOD_FIT_PX} px is the most; calibrate with k1, k2, p1, p2, k3 "
                "(`ortholoc-edge calibrate`), or crop the picture"
            )
        print(told, file=sys.stderr)
        head.append(told[0].upper() + told[1:] + ".")
        camera = fitted.camera
    else:
        camera = read_camera(args.file, args.camera, size)
    text = toml_of(camera, head) if args.to == "toml" else opencv_yaml_of(camera)
    if args.out is None:
        print(text, end="")
    else:
        try:
            args.out.write_text(text, encoding="utf-8")
        except OSError as err:
            raise OrtholocError(f"{args.out}: can't be written ({err}); choose another --out") from err
    return 0
