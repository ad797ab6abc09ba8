"""``replay``: a recorded sequence through the pipeline that flies."""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Iterator
from contextlib import nullcontext
from dataclasses import replace
from itertools import chain
from pathlib import Path

import msgspec
from tqdm import tqdm

from ortholoc_edge import __version__
from ortholoc_edge.adapters.flight_log import libraries
from ortholoc_edge.adapters.page.report import FlightRecord
from ortholoc_edge.bench import report, sequence
from ortholoc_edge.bench.draw import write_png
from ortholoc_edge.bench.flight_log import LoggedFrame, compare, log_files, read_frames, read_header, repeat
from ortholoc_edge.bench.replay import FrameResult, Length, PriorKind, PriorNoise
from ortholoc_edge.bench.runner import SAMPLES_PACK, prior_used, run_flight, run_samples, summarise
from ortholoc_edge.bench.samples import sample_paths
from ortholoc_edge.cli import matcher_options
from ortholoc_edge.cli.arguments import length, non_negative, seed, sigma_triple, writable_folder
from ortholoc_edge.config import config_from_text
from ortholoc_edge.daemon import configured_matcher, make_navigator
from ortholoc_edge.errors import ConfigError, DatasetError, OrtholocError
from ortholoc_edge.geometry.camera import Camera
from ortholoc_edge.pipeline.localizer import LocalizerOptions
from ortholoc_edge.pipeline.outcome import Fix
from ortholoc_edge.pipeline.record import outcome_of
from ortholoc_edge.tiles.pack import Pack
from ortholoc_edge.tiles.store import MapStore


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    parser = subparsers.add_parser(
        "replay",
        help="localize a recorded sequence and compare with its true poses, or fly a flight log again",
        description="Feeds a recorded sequence through the pipeline that flies and compares with the true poses. "
        "SEQUENCE is a folder of photos with a *_flight.csv, an OrthoLoC sample (.npz) or a folder of samples. Of a "
        "flight log (.mcap, or a folder of them: what the daemon wrote there since it was last started), which has no "
        "true poses, each outcome is compared with that of the flight; pack and settings are the log's, of the options "
        "only --pack, --json and --out go with it, and the exit code is 1 if anything came out differently.",
    )
    parser.add_argument("sequence", type=Path, metavar="SEQUENCE")
    parser.add_argument(
        "--pack",
        type=Path,
        help="area pack; a sample brings its own map, and with --pack uses another in the same local frame",
    )
    parser.add_argument(
        "--prior",
        choices=[str(k) for k in PriorKind],
        default=str(PriorKind.ODOMETER),
        help="odometer: last fix carried on by dead reckoning; gps: a noisy position per frame; truth-noise: truth "
        "with noise per frame, and what samples get for these three, having no past; none: only a region around the "
        "footprint, as in the paper (default: %(default)s)",
    )
    parser.add_argument(
        "--attitude-sigma-deg",
        type=sigma_triple,
        default=(1.0, 1.0, 3.0),
        metavar="R,P,Y",
        help="1-sigma of roll, pitch, yaw (default: 1,1,3)",
    )
    parser.add_argument(
        "--position-sigma",
        type=length,
        default=Length(metres=2.0),
        metavar="LENGTH",
        help="horizontal 1-sigma per axis, of the first frame and of --prior gps and truth-noise: metres (5, 5m) or "
        "a part of the height above ground (4%%) (default: 2m)",
    )
    parser.add_argument(
        "--height-sigma", type=length, default=Length(metres=2.0), metavar="LENGTH", help="vertical (default: 2m)"
    )
    parser.add_argument(
        "--odometer-error",
        type=non_negative,
        default=2.0,
        metavar="PERCENT",
        help="of the distance (default: %(default)s)",
    )
    parser.add_argument(
        "--odometer-drift", type=non_negative, default=0.05, metavar="M_PER_S", help="over time (default: %(default)s)"
    )
    parser.add_argument("--seed", type=seed, default=0, help="of all noise (default: %(default)s)")
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of the table")
    parser.add_argument(
        "--out",
        type=Path,
        metavar="DIR",
        help="write frames.jsonl, summary.json and report.html (the flight on the map, in one file) there, and of a "
        "sequence overlays/*.png and track.png",
    )
    matcher_options.add(parser)
    matcher_options.add_features(parser)
    parser.set_defaults(run=run, defaults={action.dest: action.default for action in parser._actions})


def run(args: argparse.Namespace) -> int:
    logs = log_files(args.sequence)
    return _fly_again(logs, args) if logs else _replay(args)


def _fly_again(logs: list[Path], args: argparse.Namespace) -> int:
    for name, default in args.defaults.items():
        if name not in ("help", "sequence", "pack", "json", "out") and getattr(args, name) != default:
            raise ConfigError(f"--{name.replace('_', '-')} does not go with a flight log, whose own settings count")
    header = read_header(logs[0])
    try:
        config = config_from_text(header.config)
    except ValueError as err:
        raise DatasetError(
            f"{logs[0]}: its configuration, of version {header.version}, is not understood by {__version__} ({err}); "
            "replay it with the version that wrote it"
        ) from err
    pack = Path(header.pack) if args.pack is None else args.pack
    matcher = configured_matcher(config.matcher)
    if args.out:
        writable_folder(args.out, "--out")
    with MapStore(Pack.open(pack), features=config.reads_features) as store:
        if store.pack.manifest_sha256 != header.pack_sha256:
            raise DatasetError(
                f"{pack}: not the pack that was flown with, its manifest differs; name that one with --pack"
            )
        if matcher.model_sha256 != header.model_sha256:
            raise DatasetError(
                f"{logs[0]}: flown with the model {header.model_sha256}, here is {matcher.model_sha256}; name that one "
                "in the configuration, or build it with the version that flew"
            )
        navigator = make_navigator(config, store, matcher, 0, None)
        camera = config.intrinsics.camera()
        fixed = config.mount.body_from_camera() if config.mount.gimbal_selection() is None else None
        record = FlightRecord.over(store, camera, fixed) if args.out else None
        try:
            steps: Iterable[LoggedFrame] = chain.from_iterable(map(read_frames, logs))
            if record is not None:
                steps = _recorded(steps, record, store, camera)
            found = list(tqdm(repeat(steps, navigator), desc=args.sequence.name, unit="frame"))
        finally:
            navigator.localizer.close()
        others = {name: was for name, was in header.libraries.items() if libraries().get(name) != was}
        comparison = compare(logs, header.version, others, found)
        page = None
        if record is not None:
            notes = [f"{args.sequence.name}, flown by ortholoc-edge {header.version}: the outcomes of the flight"]
            table = report.comparison_table(comparison)
            page = record.page(store, f"Flight log {args.sequence.name}", notes, table)
    if not comparison.pictures:
        raise DatasetError(
            f"{args.sequence}: {len(found)} frames, none with a picture without loss; such logs are written with "
            '[log] frames = "all"'
        )
    encoded = msgspec.json.encode(comparison)
    if args.out:
        taken = [one for one in found if one is not None]
        _write(args.out / "frames.jsonl", b"".join(msgspec.json.encode(one) + b"\n" for one in taken))
        _write(args.out / "summary.json", encoded + b"\n")
        if page is not None:
            _write(args.out / "report.html", page.encode())
    print(encoded.decode() if args.json else report.comparison_table(comparison))
    return 0 if comparison.same == comparison.repeated else 1


def _recorded(
    steps: Iterable[LoggedFrame], record: FlightRecord, store: MapStore, camera: Camera
) -> Iterator[LoggedFrame]:
    """The steps as they come, noted down for the report."""
    for one in steps:
        outcome, state = outcome_of(one.record.outcome, camera), one.record.state()
        ground_m = store.ground_near(outcome.map_from_camera.translation[:2]) if isinstance(outcome, Fix) else None
        prior = one.record.circumstances().prior
        record.add(one.record.name, outcome, prior=prior, image=one.image, state=state, ground_m=ground_m)
        yield one


def _replay(args: argparse.Namespace) -> int:
    noise = PriorNoise(
        args.attitude_sigma_deg,
        (args.position_sigma, args.height_sigma),
        args.odometer_error / 100.0,
        args.odometer_drift,
    )
    options = LocalizerOptions(adhop=not args.no_adhop, precomputed_features=args.features)
    samples = sample_paths(args.sequence)
    kind = prior_used(PriorKind(args.prior), bool(samples))
    if not args.sequence.exists():
        raise DatasetError(f"{args.sequence}: no such file or folder")
    if not samples and args.pack is None:
        raise ConfigError("--pack is missing; build one with: ortholoc-edge tiles build --dop … --dsm … --out PACK")
    if args.out:
        writable_folder(args.out, "--out")
    matcher = matcher_options.matcher(args)
    writer = report.FrameWriter(args.out) if args.out else None
    results: list[FrameResult] = []
    record: FlightRecord | None = None

    def collect(found: Iterable[FrameResult], total: int) -> None:
        for result in tqdm(found, total=total, desc=args.sequence.name, unit="frame"):
            if writer is not None:
                writer.write(result)
            if record is not None:
                error = None if result.error is None else (result.error.te_m, result.error.re_deg)
                record.add(
                    result.name, result.outcome, prior=result.prior, image=result.image, truth=result.truth,
                    error=error,
                )  # fmt: skip
            # The picture is written; a long sequence must not pile up in memory.
            results.append(replace(result, image=None))

    pack_name = SAMPLES_PACK if args.pack is None else str(args.pack)
    try:
        with _store(args) if args.pack is not None else nullcontext() as store:
            if samples:
                collect(run_samples(samples, matcher, options, kind, noise, args.seed, store), len(samples))
            elif store is not None:
                recorded = sequence.read_flight(args.sequence)
                if args.out and recorded:
                    record = FlightRecord.over(store, recorded[0].camera)
                collect(run_flight(recorded, store, matcher, options, kind, noise, args.seed), len(recorded))
            if args.out and store is not None:
                caption = f"{args.sequence.name}: {matcher.name}, prior {kind}"
                write_png(args.out / "track.png", report.track_picture(store, results, caption))
            summary = summarise(
                results,
                name=str(args.sequence),
                pack=pack_name,
                matcher=matcher,
                prior=kind,
                adhop=options.adhop,
                seed=args.seed,
            )
            if record is not None and store is not None:
                notes = [f"{args.sequence.name} on {pack_name}, replayed by ortholoc-edge {__version__}"]
                page = record.page(store, f"Replay of {args.sequence.name}", notes, report.table(summary))
                if page is not None:
                    _write(args.out / "report.html", page.encode())
    finally:
        if writer is not None:
            writer.close()
    encoded = msgspec.json.encode(summary)
    if args.out:
        _write(args.out / "summary.json", encoded + b"\n")
    print(encoded.decode() if args.json else report.table(summary))
    return 0


def _write(path: Path, data: bytes) -> None:
    try:
        path.write_bytes(data)
    except OSError as err:
        raise OrtholocError(f"{path.parent}: can't write {path.name} ({err})") from err


def _store(args: argparse.Namespace) -> MapStore:
    return MapStore(Pack.open(args.pack), features=args.features != "never")
