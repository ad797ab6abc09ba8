"""``tiles forecast``: where along a route fixes are to be expected, and where not."""

from __future__ import annotations

import argparse
import json
import math
import re
import sys
from pathlib import Path

import cv2
from tqdm import tqdm

from ortholoc_edge.cli.arguments import positive, positive_int
from ortholoc_edge.config import read_intrinsics
from ortholoc_edge.errors import ConfigError, OrtholocError
from ortholoc_edge.geometry.camera import Camera
from ortholoc_edge.tiles.drawing import Reference
from ortholoc_edge.tiles.forecast import forecast, text
from ortholoc_edge.tiles.forecast_picture import picture
from ortholoc_edge.tiles.pack import Pack
from ortholoc_edge.tiles.route import Route
from ortholoc_edge.tiles.store import MapStore

_WORKING_PX = 640
_MAX_HFOV_DEG = 170.0
_MAX_SIDE_PX = 65_536
# A forecast is made on a desk, of packs larger than what flies.
_MEMORY_BYTES = 16 * 2**30


def add_parser(actions: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the subcommand."""
    parser = actions.add_parser(
        "forecast",
        help="say where along a route fixes are to be expected",
        description=(
            "Judge a route on a pack: where a camera that looks straight down can be expected to be localized, where"
            " it is doubtful, and where it is not (outside of the map, water, low texture, too coarse a map for the"
            " height). What it cannot know is the season, the weather and what has been built since the survey."
        ),
    )
    parser.add_argument(
        "route",
        type=Path,
        help=".plan (QGroundControl), .waypoints (Mission Planner), .kml, .kmz or .geojson with a line or waypoints",
    )
    parser.add_argument("--pack", type=Path, required=True, metavar="DIR", help="directory of the pack")
    camera = parser.add_argument_group("camera")
    lens = camera.add_mutually_exclusive_group(required=True)
    lens.add_argument(
        "--intrinsics",
        type=Path,
        metavar="K.json",
        help='width_px, height_px, fx, fy, cx, cy, or {"intrinsics": 3x3} with --size',
    )
    lens.add_argument("--hfov", type=positive, metavar="DEG", help="horizontal field of view, degrees; with --size")
    camera.add_argument("--size", type=_size, metavar="WxH", help="of its pictures, px, as 1280x960")
    camera.add_argument(
        "--working-px",
        type=positive_int,
        default=_WORKING_PX,
        metavar="PX",
        help="long side at which frames are matched (default: %(default)s)",
    )
    heights = parser.add_argument_group("heights")
    heights.add_argument(
        "--agl", type=positive, metavar="M", help="height above the ground all the way (default: the route's altitudes)"
    )
    heights.add_argument(
        "--altitudes",
        choices=[str(one) for one in Reference if one is not Reference.UNKNOWN],
        help="what altitudes count from whose file does not say so; map: the pack's own heights",
    )
    parser.add_argument("--speed", type=positive, metavar="M/S", help="ground speed, to say how long gaps last")
    parser.add_argument("--geojson", type=Path, metavar="FILE", help="write the stretches, for QGIS")
    parser.add_argument("--image", type=Path, metavar="FILE.png", help="write a picture of the route on the map")
    parser.add_argument("--json", action="store_true", help="print figures as JSON (default: a table)")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Make the forecast. Returns: the exit status. Raises: OrtholocError."""
    camera = _camera(args)
    route = Route.read(args.route)
    if args.altitudes is not None:
        route = route.with_reference(Reference(args.altitudes))
    with MapStore(Pack.open(args.pack), memory_bytes=_MEMORY_BYTES) as store:
        with tqdm(file=sys.stderr, unit="place", leave=False) as bar:

            def progress(done: int, of: int) -> None:
                bar.total = of
                bar.update(done - bar.n)

            result = forecast(route, store, camera, agl_m=args.agl, working_px=args.working_px, progress=progress)
        if args.image is not None:
            drawn = cv2.cvtColor(picture(result, store), cv2.COLOR_RGB2BGR)
            _write(args.image, cv2.imencode(".png", drawn)[1].tobytes())
    if args.geojson is not None:
        _write(args.geojson, result.geojson())
    for note in result.notes:
        print(f"Note: {note}.", file=sys.stderr)
    print(json.dumps(result.facts(args.speed), indent=2) if args.json else text(result, args.speed))
    return 0


def _camera(args: argparse.Namespace) -> Camera:
    size: tuple[int, int] | None = args.size
    if args.hfov is not None:
        if size is None:
            raise ConfigError("--hfov needs --size WxH, the pictures' size in px")
        if args.hfov > _MAX_HFOV_DEG:
            raise ConfigError(f"--hfov {args.hfov:g}: beyond {_MAX_HFOV_DEG:g} degrees; no pinhole sees that")
        return Camera.from_focal(*size, 0.5 * size[0] / math.tan(math.radians(0.5 * args.hfov)))
    return read_intrinsics(args.intrinsics, *(size or _stated_size(args.intrinsics)))


def _stated_size(path: Path) -> tuple[int, int]:
    try:
        stated = json.loads(path.read_text(encoding="utf-8"))
        width, height = stated["width_px"], stated["height_px"]
    except (OSError, UnicodeDecodeError, json.JSONDecodeError, RecursionError) as err:
        raise ConfigError(f"{path}: can't be read as JSON ({err}); check the path") from err
    except (KeyError, TypeError) as err:
        raise ConfigError(f"{path}: has no width_px and height_px; add --size WxH") from err
    if not (type(width) is type(height) is int and 0 < width <= _MAX_SIDE_PX and 0 < height <= _MAX_SIDE_PX):
        raise ConfigError(f"{path}: width_px and height_px must be whole numbers above zero; correct them")
    return width, height


def _size(argument: str) -> tuple[int, int]:
    """``1280x960``"""
    match = re.fullmatch(r"(\d{1,5})[xX](\d{1,5})", argument)
    if match is None or not 0 < int(match[1]) <= _MAX_SIDE_PX or not 0 < int(match[2]) <= _MAX_SIDE_PX:
        raise argparse.ArgumentTypeError(f"{argument!r} is not WIDTHxHEIGHT in px, as 1280x960")
    return int(match[1]), int(match[2])


def _write(path: Path, data: bytes) -> None:
    try:
        path.write_bytes(data)
    except OSError as err:
        raise OrtholocError(f"{path}: cannot be written ({err.strerror}); choose another place") from err
