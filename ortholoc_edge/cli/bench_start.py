"""``bench-start``: how long the daemon takes to be ready, and to its first fix."""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import time
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Any

import cv2
import msgspec

from ortholoc_edge.bench.start import Start, find_place, forget, program_files, time_start, view_from
from ortholoc_edge.cli.arguments import positive, positive_int
from ortholoc_edge.cli.measured import print_heading, provenance
from ortholoc_edge.errors import OrtholocError
from ortholoc_edge.geometry import frames
from ortholoc_edge.geometry.camera import Camera
from ortholoc_edge.geometry.rigid import Rigid3
from ortholoc_edge.matching.registry import METHODS
from ortholoc_edge.tiles.pack import Pack
from ortholoc_edge.tiles.store import MapStore

if TYPE_CHECKING:
    from ortholoc_sim.link import SimulatedLink

_CAMERA = Camera.from_focal(640, 480, 540.0)
_FRAMES = 1200
_SETTLE_S = 2.0
# Further off it is no fix of what the camera sees.
_MOST_OFF_M = 5.0
_COLUMNS = (
    "| pack | matcher | files | ready, s: median (least to most) | CPU s | first estimate at the autopilot, s | CPU s "
    "| starts |"
)


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    parser = subparsers.add_parser(
        "bench-start",
        help="measure how long the daemon takes from its start to ready, and to its first fix",
        description="Starts the daemon again and again in a process of its own, beside a simulated autopilot that "
        "stands in the air over the pack, with frames drawn from the pack itself at once: a camera's own time comes on "
        "top, and how good the fixes are says nothing. Times are from before the process is made to READY=1, and to "
        "the first estimate that the autopilot heard.",
    )
    parser.add_argument("--pack", type=Path, metavar="DIR", help="area pack (default: the demo pack)")
    parser.add_argument(
        "--matcher", choices=METHODS, default="structural", metavar="NAME", help="(default: %(default)s)"
    )
    parser.add_argument("--firmware", default="ardupilot-4.6", help="of the autopilot (default: %(default)s)")
    parser.add_argument(
        "--height", type=positive, default=100.0, metavar="M", help="above ground (default: %(default)s)"
    )
    parser.add_argument(
        "--cold", action="store_true", help="have the system forget pack and program before each start, as after a "
        "restart of the computer",
    )  # fmt: skip
    parser.add_argument("--runs", type=positive_int, default=10, metavar="N", help="starts (default: %(default)s)")
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of the table")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    from ortholoc_sim import demo_pack_path

    pack = args.pack or demo_pack_path()
    load = os.getloadavg()[0]
    if not args.json:
        print(f"{provenance()}, load {load:.1f} when it began\n")
    starts = _starts(args, pack)
    if args.json:
        record = {"pack": str(pack), "cold": args.cold, "load": round(load, 1), "starts": starts}
        print(msgspec.json.encode(record).decode())
        return 0
    print_heading(_COLUMNS)
    print(
        f"| {pack.name}, {sum(_sizes(pack)) / 1e6:.0f} MB | {args.matcher} | {'cold' if args.cold else 'warm'} "
        f"| {_spread([one.ready_s for one in starts])} | {median(one.ready_cpu_s for one in starts):.2f} "
        f"| {_spread([one.first_s for one in starts])} | {median(one.first_cpu_s for one in starts):.2f} "
        f"| {len(starts)} |"
    )
    return 0


def _spread(values: list[float]) -> str:
    return f"{median(values):.2f} ({min(values):.2f} to {max(values):.2f})"


def _sizes(pack: Path) -> list[int]:
    return [path.stat().st_size for path in pack.rglob("*") if path.is_file()]


def _starts(args: argparse.Namespace, pack: Path) -> list[Start]:
    from ortholoc_sim.link import LinkSpec, SimulatedLink
    from ortholoc_sim.site import Geopoint

    with MapStore(Pack.open(pack)) as store, tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        georeference = store.pack.georeference
        place = find_place(store, _CAMERA, args.height)
        below = georeference.geodetic_from_map(place - [0.0, 0.0, args.height])
        if below.height_amsl_m is None:
            raise OrtholocError(f"{pack}: its heights above mean sea level are not known, so no daemon flies with it")
        spec = LinkSpec(
            firmware=args.firmware, home=Geopoint(below.lat_deg, below.lon_deg, below.height_amsl_m),
            radius_m=3.0, height_m=args.height, speed_m_s=0.01, wind_ned_m_s=(0.0, 0.0, 0.0), gust_m_s=0.0,
        )  # fmt: skip
        first = _First()
        with SimulatedLink(spec, first.heard) as link:
            time.sleep(_SETTLE_S)
            config = folder / "config.toml"
            config.write_text(_config(args, pack, folder / "frames", link.endpoint), encoding="utf-8")
            starts = []
            for number in range(args.runs):
                _write_frames(folder / "frames", store, link)
                if args.cold:
                    forget([*program_files(), *(path for path in pack.rglob("*") if path.is_file())])
                first.forget()
                starts.append(time_start(config, first.came_ns))
                if first.off_m is None or first.off_m > _MOST_OFF_M:
                    raise OrtholocError(f"the first estimate was {first.off_m} m off: no fix of what the camera sees")
                if not args.json:
                    print(f"{number + 1} of {args.runs}: {starts[-1]}", file=sys.stderr)
            return starts


class _First:
    """The first estimate that the autopilot heard; told by its thread."""

    def __init__(self) -> None:
        self._came: tuple[int, float | None] | None = None

    def forget(self) -> None:
        self._came = None

    def heard(self, event: dict[str, Any]) -> None:
        if event["kind"] == "vision" and self._came is None:
            self._came = time.monotonic_ns(), event["off_m"]

    def came_ns(self) -> int | None:
        return None if self._came is None else self._came[0]

    @property
    def off_m(self) -> float | None:
        """From the truth."""
        return None if self._came is None else self._came[1]


def _write_frames(folder: Path, store: MapStore, link: SimulatedLink) -> None:
    """What a camera that looks down sees now, again and again."""
    truth, place, georeference = link.loop.samples[-1].truth, link.true_place(), store.pack.georeference
    at = georeference.map_from_geodetic(place.lat_deg, place.lon_deg, height_amsl_m=place.height_amsl_m)
    turn = frames.map_from_ned_rotation(georeference.convergence_rad(at[:2])) @ truth.ned_from_body
    image = view_from(store, _CAMERA, Rigid3(turn @ frames.BODY_FROM_NADIR_CAMERA, at))
    if image is None:
        raise OrtholocError(f"{store.pack.path}: the map ends under the vehicle")
    folder.mkdir(exist_ok=True)
    frame = folder / "frame_0000.png"
    cv2.imwrite(str(frame), image)
    for number in range(1, _FRAMES):
        other = folder / f"frame_{number:04d}.png"
        other.unlink(missing_ok=True)
        other.hardlink_to(frame)


def _config(args: argparse.Namespace, pack: Path, folder: Path, endpoint: str) -> str:
    camera = _CAMERA
    # A JSON string is one of TOML.
    source, pack_path, link = (json.dumps(str(value)) for value in (f"folder:{folder}", pack.resolve(), endpoint))
    return f"""[camera]
source = {source}
rate_hz = 10.0
[intrinsics]
width_px = {camera.width}
height_px = {camera.height}
fx = {camera.fx}
fy = {camera.fy}
cx = {camera.cx}
cy = {camera.cy}
[map]
pack = {pack_path}
[link]
endpoint = {link}
[matcher]
name = "{args.matcher}"
"""
