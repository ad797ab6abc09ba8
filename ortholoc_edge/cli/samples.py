"""``samples``: make OrthoLoC samples, and look at them."""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import nullcontext
from pathlib import Path

from tqdm import tqdm

from ortholoc_edge.bench import sequence
from ortholoc_edge.bench.draw import write_png
from ortholoc_edge.bench.sample_maker import MakerOptions, PackScenery, Scenery, make_sample
from ortholoc_edge.bench.sample_sheet import sample_sheet
from ortholoc_edge.bench.samples import Sample, SampleKind, Split, find_samples, read_sample, write_sample
from ortholoc_edge.cli.arguments import positive, positive_int, seed, writable_folder
from ortholoc_edge.errors import CameraError, ConfigError, DatasetError, OrtholocError
from ortholoc_edge.tiles.pack import Pack
from ortholoc_edge.tiles.store import MapStore

# A region at the pixels of the photo that shows it, and twice as fine.
_MAX_PIXELS = 64_000_000
_LOCATION = re.compile(r"[A-Za-z0-9-]+")


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    samples = subparsers.add_parser("samples", help="make OrthoLoC samples and look at them", description=__doc__)
    actions = samples.add_subparsers(dest="action", required=True, metavar="ACTION")

    make = actions.add_parser(
        "make",
        help="from an area pack and a flight with known poses",
        description="Makes a sample of every photo of a flight (docs/sequences.md) whose poses are in the pack's CRS "
        "and heights. A photo that shows too little of the map is told and left out; exit code 1 if all were.",
    )
    make.add_argument("pack", type=Path, metavar="PACK")
    make.add_argument("flight", type=Path, metavar="FLIGHT", help="folder of photos with one *_flight.csv")
    make.add_argument(
        "--truth",
        type=Path,
        metavar="PACK",
        help="what stood there when the photos were taken, in the same CRS and heights: for samples across domains "
        "(default: PACK)",
    )
    make.add_argument("--location", type=_location, metavar="NAME", help="in the files' names (default: the flight's)")
    make.add_argument(
        "--kind", type=SampleKind, choices=list(SampleKind), default=SampleKind.SAME,
        help="what lies between map and photos, in the files' names (default: %(default)s)",
    )  # fmt: skip
    _add_output(make)
    make.set_defaults(run=_make)

    simulate = actions.add_parser(
        "simulate",
        help="from generated places",
        description="Makes samples of a generated place (ortholoc_sim.crossdomain). Place and poses follow from the "
        "seed: samples of one number differ by their kind alone.",
    )
    simulate.add_argument(
        "--kind", type=SampleKind, nargs="+", choices=[k for k in SampleKind if k is not SampleKind.XDSM],
        default=[SampleKind.SAME, SampleKind.XDOP, SampleKind.XDOPDSM], help="default: all three",
    )  # fmt: skip
    simulate.add_argument("--photos", type=positive_int, default=10, help="of each kind (default: %(default)s)")
    simulate.add_argument(
        "--place", type=positive, nargs=2, default=(1200.0, 1000.0), metavar=("WIDTH", "HEIGHT"),
        help="of the place, whole m (default: 1200 1000)",
    )  # fmt: skip
    simulate.add_argument("--location", type=_location, metavar="NAME", help="in the files' names (default: S01 of 1)")
    _add_output(simulate)
    simulate.set_defaults(run=_simulate)

    draw = actions.add_parser(
        "draw", help="one picture of each sample", description="Draws NAME.png of each sample: photo, map, truth."
    )
    draw.add_argument("samples", type=Path, metavar="SAMPLES", help="a file, or a folder and all below it")
    draw.add_argument("out", type=Path, metavar="OUT", help="folder of the pictures")
    draw.set_defaults(run=_draw)


def _add_output(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("out", type=Path, metavar="OUT", help="folder of the samples")
    parser.add_argument(
        "--split", type=Split, choices=list(Split), help="write to this folder of the data set's layout below OUT"
    )
    parser.add_argument("--seed", type=seed, default=1, help="of all that is drawn (default: %(default)s)")
    parser.add_argument(
        "--raster-px", type=positive_int, default=MakerOptions().raster_px,
        help="side of orthophoto and surface model (default: %(default)s, the paper's)",
    )  # fmt: skip


def _location(text: str) -> str:
    if not _LOCATION.fullmatch(text):
        raise argparse.ArgumentTypeError(f"{text!r} is not a name of letters, digits and hyphens")
    return text


def _make(args: argparse.Namespace) -> int:
    recorded = sequence.read_flight(args.flight)
    location = args.location or re.sub(r"[^A-Za-z0-9-]+", "-", args.flight.resolve().name)
    folder = _folder(args)
    options = MakerOptions(seed=args.seed, raster_px=args.raster_px)
    with (
        MapStore(Pack.open(args.pack), max_pixels=_MAX_PIXELS) as store,
        nullcontext(store)
        if args.truth is None
        else MapStore(Pack.open(args.truth), max_pixels=_MAX_PIXELS) as truth,
    ):
        if truth.pack.manifest.crs != store.pack.manifest.crs:
            raise ConfigError(f"--truth {args.truth}: another CRS than {args.pack}'s; build one of them anew")
        made = _of_flight(recorded, PackScenery(store, truth), f"{location}_{args.kind}", options)
        return _write(made, len(recorded), folder)


def _of_flight(
    recorded: Sequence[sequence.RecordedFrame], scenery: Scenery, prefix: str, options: MakerOptions
) -> Iterator[Sample | OrtholocError]:
    for index, frame in enumerate(recorded):
        name = f"{prefix}{index:04d}"
        try:
            yield make_sample(name, frame.image(), frame.camera, frame.map_from_camera, scenery, options, index)
        except (CameraError, DatasetError) as error:
            yield error


def _simulate(args: argparse.Namespace) -> int:
    # Not at the top: every other command works without the simulation.
    from ortholoc_sim.crossdomain import CrossDomain, Kind
    from ortholoc_sim.samples import KINDS, simulated_samples

    location = args.location or f"S{args.seed:02d}"
    options = MakerOptions(seed=args.seed, raster_px=args.raster_px)
    folder = _folder(args)
    place = CrossDomain(Kind.SAME, args.seed, *(round(side) for side in args.place))
    failed = 0
    for kind in dict.fromkeys(args.kind):
        try:
            made = simulated_samples(place.of_kind(KINDS[kind]), args.photos, location, options)
            failed |= _write(made, args.photos, folder)
        except ValueError as error:
            raise ConfigError(f"--place {args.place[0]:g} {args.place[1]:g}: {error}") from error
    return failed


def _folder(args: argparse.Namespace) -> Path:
    folder: Path = args.out / args.split if args.split else args.out
    writable_folder(folder, "OUT")
    return folder


def _write(made: Iterable[Sample | OrtholocError], count: int, folder: Path) -> int:
    written = 0
    for one in tqdm(made, total=count, unit="photo", file=sys.stderr, leave=False):
        if isinstance(one, OrtholocError):
            print(f"ortholoc-edge: {one}", file=sys.stderr)
        else:
            print(write_sample(one, folder), flush=True)
            written += 1
    return 0 if written else 1


def _draw(args: argparse.Namespace) -> int:
    writable_folder(args.out, "OUT")
    for file in find_samples(args.samples):
        picture = args.out / f"{file.name}.png"
        write_png(picture, sample_sheet(read_sample(file.path)))
        print(picture, flush=True)
    return 0
