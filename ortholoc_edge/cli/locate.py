"""``locate``: photos without a position, found in the whole of a map."""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ortholoc_edge.adapters.camera import read_image
from ortholoc_edge.bench import draw
from ortholoc_edge.bench.sequence import read_flight
from ortholoc_edge.cli.arguments import positive, triple, within, writable_folder
from ortholoc_edge.cli.localize import georeferenced, sentence
from ortholoc_edge.config import read_intrinsics
from ortholoc_edge.errors import ConfigError
from ortholoc_edge.geometry import frames, rotation
from ortholoc_edge.geometry.arrays import FloatArray, ImageArray
from ortholoc_edge.geometry.camera import Camera
from ortholoc_edge.geometry.rigid import Rigid3
from ortholoc_edge.matching.types import Structural
from ortholoc_edge.pipeline.frame import Frame, grey_of
from ortholoc_edge.pipeline.localizer import Localizer, LocalizerOptions
from ortholoc_edge.pipeline.locate import Located, Searchers, locate
from ortholoc_edge.pipeline.outcome import Fix
from ortholoc_edge.pipeline.record import outcome_record
from ortholoc_edge.pipeline.search import Searcher, Sighting
from ortholoc_edge.tiles.lattice import Bounds
from ortholoc_edge.tiles.pack import Pack
from ortholoc_edge.tiles.store import MapStore

# Of candidates that are told of in JSON.
_TOLD = 5
_UNKNOWN_HEADING_DEG = 180.0
# A computer on a desk has more than one in the air.
_MAX_FIELD_MB = 1024.0


@dataclass(frozen=True, slots=True, eq=False)
class _Photo:
    """A photo and what is known of it: the body's attitude from true north; camera and truth where a sequence has
    them."""

    path: Path
    image: Callable[[], ImageArray]
    camera: Camera | None
    ned_from_body: FloatArray
    above_ground_m: float
    height_m: float
    truth: Rigid3 | None = None


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    parser = subparsers.add_parser(
        "locate",
        help="find photos in a whole map, without a position",
        description="Finds each photo in the whole map, or the part that --within names, from attitude and height "
        "alone. A folder with a *_flight.csv stands for its photos, with the attitude and height that it has for them; "
        "its positions are only compared with. Exit code 0: all were found; 1: not all.",
    )
    parser.add_argument("photos", type=Path, nargs="+", metavar="IMAGE")
    parser.add_argument("--pack", type=Path, required=True)
    parser.add_argument("--intrinsics", type=Path, metavar="K.json", help="as of localize; a flight folder has its own")
    parser.add_argument(
        "--attitude",
        type=triple,
        metavar="R,P,Y",
        help="roll, pitch and yaw from true north of the body, degrees; the camera looks straight down, image top "
        "toward the nose. Left out: level, heading unknown",
    )
    parser.add_argument(
        "--heading-within",
        type=within("an angle in degrees", float, 0.0, _UNKNOWN_HEADING_DEG),
        metavar="DEG",
        help="how far the yaw may be off; 180: it is unknown (default: 10, and 180 without --attitude)",
    )
    height = parser.add_mutually_exclusive_group()
    height.add_argument("--agl", type=positive, metavar="M", help="height above the ground")
    height.add_argument("--height", type=float, metavar="H", help="height in the pack's vertical datum")
    parser.add_argument(
        "--within",
        type=_area,
        metavar="E,N,RADIUS",
        help="search this circle's square only: map coordinates and metres (default: all of the pack)",
    )
    parser.add_argument("--threads", type=within("a number of threads", int, 1, 64), default=2, help="default: 2")
    parser.add_argument("--json", action="store_true", help="print a JSON object per photo")
    parser.add_argument("--overlay", type=Path, metavar="DIR", help="draw the matched points on the photos, as PNG")
    parser.set_defaults(run=run)


def _area(text: str) -> Bounds:
    easting, northing, radius = triple(text)
    if radius <= 0:
        raise argparse.ArgumentTypeError(f"{text!r}: a radius of {radius:g} m holds nothing")
    return easting - radius, northing - radius, easting + radius, northing + radius


def run(args: argparse.Namespace) -> int:
    if args.overlay is not None:
        writable_folder(args.overlay, "--overlay")
    photos = [photo for path in args.photos for photo in _photos(path, args)]
    reach_deg = args.heading_within
    if reach_deg is None:
        aided = args.attitude is not None or all(photo.truth is not None for photo in photos)
        reach_deg = 10.0 if aided else _UNKNOWN_HEADING_DEG
    missed = 0
    with (
        MapStore(Pack.open(args.pack)) as store,
        closing(Searchers(store, args.threads, args.within, _MAX_FIELD_MB)) as searchers,
    ):
        told: set[Searcher] = set()
        for photo in photos:
            missed += not _answer(photo, math.radians(reach_deg), store, searchers, told, args)
    return 1 if missed else 0


def _photos(path: Path, args: argparse.Namespace) -> Iterator[_Photo]:
    if path.is_dir():
        for record in read_flight(path):
            height_m = float(record.map_from_camera.translation[2])
            yield _Photo(
                record.path, record.image, record.camera, record.ned_from_body, math.nan, height_m,
                record.map_from_camera,
            )  # fmt: skip
        return
    if args.intrinsics is None:
        raise ConfigError(f"{path}: --intrinsics is missing; give the camera's, calibrate-focal finds them")
    if args.agl is None and args.height is None:
        raise ConfigError(f"{path}: its height is missing; give --agl or --height")
    yield _Photo(
        path,
        lambda: read_image(path),
        None,
        rotation.from_euler(*np.radians(args.attitude or (0.0, 0.0, 0.0))),
        math.nan if args.agl is None else args.agl,
        math.nan if args.height is None else args.height,
    )


def _answer(
    photo: _Photo,
    reach_rad: float,
    store: MapStore,
    searchers: Searchers,
    told: set[Searcher],
    args: argparse.Namespace,
) -> bool:
    """Print what a photo comes to; whether that is a fix. ``told``: the searchers that were told of."""
    image = photo.image()
    camera = photo.camera or read_intrinsics(args.intrinsics, image.shape[1], image.shape[0])
    searcher = searchers.suiting(camera, photo.above_ground_m, photo.height_m)
    if searcher not in told:
        told.add(searcher)
        field = searcher.field
        said = f"{field.known_km2:.1f} km2 at {field.grid.gsd_m:g} m per pixel, {field.bytes / 1e6:.1f} MB"
        print(said, file=sys.stderr)
    georeference = store.pack.georeference
    west, south, east, north = searcher.field.grid.bounds
    turn = georeference.convergence_rad(np.array([(west + east) / 2, (south + north) / 2]))
    sighting = Sighting(
        grey_of(image),
        camera,
        frames.map_from_ned_rotation(turn) @ photo.ned_from_body @ frames.BODY_FROM_NADIR_CAMERA,
        reach_rad,
        photo.above_ground_m,
        photo.height_m,
    )
    localizer = Localizer(camera, store, Structural(), LocalizerOptions())
    start = time.monotonic()
    try:
        located = locate(Frame(0, image, photo.path.name), sighting, searcher, localizer)
    finally:
        localizer.close()
    took_s = time.monotonic() - start
    if args.json:
        print(json.dumps(_record(photo, located, store, took_s)), flush=True)
    else:
        print("\n".join(_lines(photo, located, store, took_s)), flush=True)
    if args.overlay is not None:
        caption = f"{photo.path.name}: " + sentence(located.outcome, georeference)[0]
        picture = draw.overlay(image, located.outcome, photo.truth, camera, caption)
        draw.write_png(args.overlay / f"{photo.path.stem}.png", picture)
    return isinstance(located.outcome, Fix)


def _lines(photo: _Photo, located: Located, store: MapStore, took_s: float) -> list[str]:
    first, *others = sentence(located.outcome, store.pack.georeference)
    lines = [f"{photo.path.name}: {first}", *others]
    if isinstance(located.outcome, Fix):
        lines.append(f"fits {located.lead:.2f} times as well as the next place")
    if photo.truth is not None and isinstance(located.outcome, Fix):
        lines.append(f"{_error_m(located.outcome, photo.truth):.2f} m from where the sequence has it")
    lines.append(f"the best place is right with a probability of {located.chance:.2f}, before it was looked at closely")
    lines.append(f"{took_s:.1f} s, {len(located.tried)} of {len(located.candidates)} candidates looked at closely")
    return lines


def _record(photo: _Photo, located: Located, store: MapStore, took_s: float) -> dict[str, Any]:
    record: dict[str, Any] = {"image": photo.path.name, **outcome_record(located.outcome)}
    if isinstance(located.outcome, Fix):
        record |= georeferenced(located.outcome, store.pack.georeference)
    places = located.candidates[:_TOLD]
    record |= {
        "lead": located.lead if math.isfinite(located.lead) else None,
        "chance": located.chance,
        "candidates": [[one.easting_m, one.northing_m, one.score] for one in places],
        "seconds": took_s,
    }
    if photo.truth is not None:
        true = photo.truth.translation
        away = [math.hypot(one.easting_m - true[0], one.northing_m - true[1]) for one in located.candidates]
        record["candidates_away_m"] = away
        if isinstance(located.outcome, Fix):
            record["error_m"] = _error_m(located.outcome, photo.truth)
    return record


def _error_m(fix: Fix, truth: Rigid3) -> float:
    return float(np.linalg.norm(fix.map_from_camera.translation - truth.translation))
