"""``replay``: a recorded sequence through the pipeline that flies."""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import rasterio
from affine import Affine
from tqdm import tqdm

from ortholoc_edge.bench import metrics, report, sequence
from ortholoc_edge.bench.draw import write_png
from ortholoc_edge.bench.replay import (
    FrameResult,
    Length,
    PriorKind,
    PriorNoise,
    replay_flight,
    replay_sample,
)
from ortholoc_edge.cli import matcher_options
from ortholoc_edge.cli.arguments import length, triple
from ortholoc_edge.errors import ConfigError, DatasetError, MapError
from ortholoc_edge.geometry.arrays import FloatArray
from ortholoc_edge.geometry.camera import Camera
from ortholoc_edge.matching.types import Matcher
from ortholoc_edge.pipeline.localizer import Localizer, LocalizerOptions
from ortholoc_edge.tiles.build import PackOptions, build_pack
from ortholoc_edge.tiles.pack import Pack
from ortholoc_edge.tiles.store import MapStore


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    parser = subparsers.add_parser(
        "replay",
        help="localize a recorded sequence and compare with its true poses",
        description="Feeds a recorded sequence through the pipeline that flies and compares with the true poses. "
        "SEQUENCE is a folder of photos with a *_flight.csv, an OrthoLoC sample (.npz) or a folder of samples.",
    )
    parser.add_argument("sequence", type=Path, metavar="SEQUENCE")
    parser.add_argument("--pack", type=Path, help="area pack; a sample brings its own map and needs none")
    parser.add_argument(
        "--prior",
        choices=[str(k) for k in PriorKind],
        default=str(PriorKind.ODOMETER),
        help="odometer: last fix carried on by dead reckoning; gps: a noisy position per frame; truth-noise: truth "
        "with noise per frame; none: only a region around the footprint, as in the paper (default: %(default)s)",
    )
    parser.add_argument(
        "--attitude-sigma-deg",
        type=triple,
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
        "--odometer-error", type=float, default=2.0, metavar="PERCENT", help="of the distance (default: %(default)s)"
    )
    parser.add_argument(
        "--odometer-drift", type=float, default=0.05, metavar="M_PER_S", help="over time (default: %(default)s)"
    )
    parser.add_argument("--seed", type=int, default=0, help="of all noise (default: %(default)s)")
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of the table")
    parser.add_argument(
        "--out", type=Path, metavar="DIR", help="write frames.jsonl, overlays/*.png, track.png and summary.json there"
    )
    matcher_options.add(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    kind = PriorKind(args.prior)
    noise = PriorNoise(
        args.attitude_sigma_deg,
        (args.position_sigma, args.height_sigma),
        args.odometer_error / 100.0,
        args.odometer_drift,
    )
    options = LocalizerOptions(adhop=not args.no_adhop)
    samples = sequence.sample_paths(args.sequence)
    if not args.sequence.exists():
        raise DatasetError(f"{args.sequence}: no such file or folder")
    if samples and args.pack is not None:
        raise ConfigError("an OrthoLoC sample brings its own map in its own local frame; leave --pack away")
    if not samples and args.pack is None:
        raise ConfigError("--pack is missing; build one with: ortholoc-edge tiles build --dop … --dsm … --out PACK")
    matcher = matcher_options.matcher(args)
    writer = report.FrameWriter(args.out) if args.out else None
    results: list[FrameResult] = []

    def collect(found: Iterable[FrameResult], total: int) -> None:
        for result in tqdm(found, total=total, desc=args.sequence.name, unit="frame"):
            if writer is not None:
                writer.write(result)
            # The picture is written; a long sequence must not pile up in memory.
            results.append(replace(result, image=None))

    try:
        if samples:
            collect(_samples(samples, matcher, options, kind, noise, args.seed), len(samples))
            pack_name = "the samples' own rasters"
        else:
            recorded = sequence.read_flight(args.sequence)
            with MapStore(Pack.open(args.pack)) as store:
                collect(_flight(recorded, store, matcher, options, kind, noise, args.seed), len(recorded))
                if args.out:
                    caption = f"{args.sequence.name}: {matcher.name}, prior {kind}"
                    write_png(args.out / "track.png", report.track_picture(store, results, caption))
            pack_name = str(args.pack)
    finally:
        if writer is not None:
            writer.close()
    summary = _summary(results, args, matcher, pack_name, options.adhop)
    encoded = msgspec.json.encode(summary)
    if args.out:
        (args.out / "summary.json").write_bytes(encoded + b"\n")
    print(encoded.decode() if args.json else report.table(summary))
    return 0


def _flight(
    recorded: list[sequence.RecordedFrame],
    store: MapStore,
    matcher: Matcher,
    options: LocalizerOptions,
    kind: PriorKind,
    noise: PriorNoise,
    seed: int,
) -> Iterator[FrameResult]:
    localizers: dict[Camera, Localizer] = {}

    def localizer_for(camera: Camera) -> Localizer:
        if camera not in localizers:
            localizers[camera] = Localizer(camera, store, matcher, options)
        return localizers[camera]

    try:
        yield from replay_flight(
            recorded,
            localizer_for,
            store.pack.georeference,
            lambda xy: float(store.heights(xy[None])[0]),
            kind=kind,
            noise=noise,
            seed=seed,
        )
    finally:
        for localizer in localizers.values():
            localizer.close()


def _samples(
    paths: list[Path],
    matcher: Matcher,
    options: LocalizerOptions,
    kind: PriorKind,
    noise: PriorNoise,
    seed: int,
) -> Iterator[FrameResult]:
    for index, path in enumerate(paths):
        sample = sequence.read_sample(path)
        with sample_store(sample) as store:
            localizer = Localizer(sample.camera, store, matcher, options)
            below = store.heights(sample.map_from_camera.translation[None, :2])[0]
            ground_m = float(below) if np.isfinite(below) else float(np.nanmedian(sample.dsm))
            try:
                yield replay_sample(
                    sample,
                    localizer,
                    kind=kind,
                    noise=noise,
                    height_m=float(sample.map_from_camera.translation[2]) - ground_m,
                    bounds=sample.grid.bounds,
                    seed=seed + index,
                )
            finally:
                localizer.close()


@contextmanager
def sample_store(sample: sequence.Sample) -> Iterator[MapStore]:
    """A sample's rasters as an area pack without a reference system, for as long as it is needed."""
    with tempfile.TemporaryDirectory(prefix="ortholoc-sample-") as name:
        folder = Path(name)
        grid = sample.grid
        transform = Affine(grid.dx, 0.0, grid.west, 0.0, grid.dy, grid.top)
        for file, bands, dtype in (
            ("dop.tif", np.moveaxis(sample.dop, 2, 0), "uint8"),
            ("dsm.tif", sample.dsm[None], "float32"),
        ):
            profile = {
                "driver": "GTiff",
                "width": grid.width,
                "height": grid.height,
                "count": len(bands),
                "dtype": dtype,
                "transform": transform,
                "nodata": np.nan if dtype == "float32" else None,
            }
            try:
                with rasterio.open(folder / file, "w", **profile) as target:
                    target.write(bands)
            except rasterio.errors.RasterioError as err:
                raise MapError(f"{sample.name}: can't write {folder / file} ({err}); is the disk full?") from err
        pack = build_pack(folder / "dop.tif", folder / "dsm.tif", folder / "pack", PackOptions(quality=95))
        with MapStore(pack) as store:
            yield store


def _summary(
    results: list[FrameResult], args: argparse.Namespace, matcher: Matcher, pack: str, adhop: bool
) -> metrics.Summary:
    errors = [r.error for r in results if r.error is not None]
    outcomes = [r.outcome for r in results]
    te: FloatArray = np.array([e.te_m for e in errors])
    return metrics.Summary(
        sequence=str(args.sequence),
        frames=len(results),
        fixes=len(errors),
        rejected=metrics.rejections(outcomes),
        te_m=metrics.Spread.of(te),
        re_deg=metrics.Spread.of([e.re_deg for e in errors]),
        recall=metrics.recall(errors, len(results)),
        false_fixes=sum(e.is_false for e in errors),
        nees=metrics.nees(errors),
        latency_ms=metrics.latencies(outcomes),
        cpu_ms_per_frame=float(np.median([r.cpu_ms for r in results])) if results else 0.0,
        rss_mb=report.rss_mb(),
        matcher=matcher.name,
        model_sha256=matcher.model_sha256,
        pack=pack,
        prior=args.prior,
        adhop=adhop,
        adhop_accepted=sum(getattr(o, "adhop_accepted", None) is True for o in outcomes),
        seed=args.seed,
    )
