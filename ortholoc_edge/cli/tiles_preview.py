"""`ortholoc-edge tiles preview`: one picture of an area pack."""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2

from ortholoc_edge.errors import ConfigError
from ortholoc_edge.tiles.pack import Pack
from ortholoc_edge.tiles.preview import preview

_SIZES_PX = (600, 8000)


def add_parser(actions: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the `preview` subcommand of `tiles`."""
    parser = actions.add_parser(
        "preview",
        help="draw a pack",
        description=(
            "Draw an area pack into one PNG: orthophoto, hill-shaded surface model, coverage and matchability."
        ),
    )
    parser.add_argument("pack", type=Path, help="directory of the pack")
    parser.add_argument("--out", type=Path, metavar="PNG", help="picture (default: PACK.png beside the pack)")
    parser.add_argument(
        "--size", type=_size, default=1600, metavar="PX", help="long side of the picture (default: 1600)"
    )
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Draw and write. Returns: the exit status. Raises: OrtholocError."""
    pack = Pack.open(args.pack)
    folder = args.pack.resolve()
    out: Path = args.out or folder.with_name(f"{folder.name}.png")
    # A file inside the pack would be one that its manifest does not list.
    if out.resolve().is_relative_to(folder):
        raise ConfigError(f"--out {out}: lies inside the pack; name a file outside it")
    image = preview(pack, args.size)
    _, data = cv2.imencode(".png", cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
    try:
        out.write_bytes(data.tobytes())
    except OSError as err:
        raise ConfigError(f"{out}: cannot be written ({err.strerror}); check the folder and its permissions") from err
    print(f"{out}: {image.shape[1]} x {image.shape[0]} px")
    return 0


def _size(text: str) -> int:
    low, high = _SIZES_PX
    if not text.isdigit() or not low <= int(text) <= high:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number of pixels from {low} to {high}")
    return int(text)
