"""``bench-packs``: the tables about area packs in docs/benchmarks.md, measured."""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from tqdm import tqdm

from ortholoc_edge.bench import pack_process, packs
from ortholoc_edge.bench.replay import PriorKind
from ortholoc_edge.cli.arguments import positive_int
from ortholoc_edge.cli.measured import table_head
from ortholoc_edge.cli.progress import ProgressBar
from ortholoc_edge.errors import ConfigError, DatasetError
from ortholoc_edge.matching.registry import MATCHERS, METHODS, make_method
from ortholoc_edge.matching.types import STRUCTURAL
from ortholoc_edge.parallel import Workers
from ortholoc_edge.tiles.build import PackOptions, build_pack
from ortholoc_edge.tiles.features import MATCHERS as FEATURE_MATCHERS
from ortholoc_edge.tiles.pack import Pack
from ortholoc_edge.tiles.store import CACHE_BYTES


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add ``bench-packs``."""
    parser = subparsers.add_parser(
        "bench-packs",
        help="measure area packs: quality against size, memory, reads, building",
        description="Measures area packs and prints Markdown tables for docs/benchmarks.md.",
    )
    actions = parser.add_subparsers(dest="action", required=True, metavar="ACTION")
    _add_size(actions)
    _add_memory(actions)
    _add_reads(actions)
    _add_build(actions)


def _add_size(actions: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    size = actions.add_parser(
        "size",
        help="localization error against size",
        description="Averages the rasters of real flights to the pixels of public geodata, builds packs of several "
        "qualities and localizes the flights on each. Errors are compared with those on a lossless pack, frame by "
        "frame with the same noise; intervals are 95 % by bootstrap over the photos.",
    )
    size.add_argument("data", type=Path, metavar="DATA", help="folder with the sets")
    size.add_argument("--sets", nargs="+", default=["seneca", "caliterra"], help="(default: %(default)s)")
    size.add_argument("--dop-gsd", type=float, default=0.2, metavar="M", help="(default: %(default)s)")
    size.add_argument("--dsm-gsd", type=float, default=1.0, metavar="M", help="(default: %(default)s)")
    size.add_argument(
        "--webp", nargs="*", type=int, default=[90, 80, 75, 70, 60, 50, 40], help="qualities (default: %(default)s)"
    )
    size.add_argument("--jpeg", nargs="*", type=int, default=[90, 75, 60], help="qualities (default: %(default)s)")
    size.add_argument(
        "--z-error", nargs="*", type=float, default=[0.01, 0.02, 0.1, 0.2], metavar="M", help="(default: %(default)s)"
    )
    size.add_argument(
        "--features",
        nargs="*",
        type=float,
        metavar="N",
        help=f"precomputed per million pixels (default: {PackOptions().features_per_mpx:g} for a matcher that packs "
        "have features for, else none)",
    )
    size.add_argument(
        "--quality",
        type=int,
        default=PackOptions().quality,
        help="WEBP of the rows that vary DSM error and features (default: %(default)s)",
    )
    size.add_argument("--matcher", choices=METHODS, default=STRUCTURAL, help="(default: %(default)s)")
    size.add_argument(
        "--prior", choices=[str(k) for k in PriorKind], default=str(PriorKind.ODOMETER), help="(default: %(default)s)"
    )
    size.add_argument("--seeds", type=positive_int, default=5, help="how many, from 0 (default: %(default)s)")
    size.add_argument("--jobs", type=positive_int, default=1, help="processes of a build (default: %(default)s)")
    size.set_defaults(run=_size)


def _add_memory(actions: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    memory = actions.add_parser(
        "memory",
        help="resident memory and cost per frame, against the pack's area",
        description="Runs the localizer over a flight in a process of its own and reads its resident memory from the "
        "kernel. With --small, the same frames are localized on a small pack and on PACK in turn, by one process "
        "each, and their CPU time is compared.",
    )
    memory.add_argument("pack", type=Path, metavar="PACK")
    memory.add_argument("flight", type=Path, metavar="FLIGHT", help="recorded flight (docs/sequences.md) on PACK")
    memory.add_argument("--small", type=Path, metavar="PACK", help="a pack of a part of the same area")
    memory.add_argument("--small-flight", type=Path, metavar="FLIGHT", help="a flight on both packs (default: FLIGHT)")
    memory.add_argument("--frames", type=positive_int, default=200, help="(default: %(default)s)")
    memory.add_argument("--matcher", choices=METHODS, default=STRUCTURAL, help="(default: %(default)s)")
    memory.add_argument("--features", action="store_true", help="use the pack's precomputed features")
    memory.add_argument(
        "--cache-mb", type=positive_int, default=CACHE_BYTES // 2**20, help="of decoded blocks (default: %(default)s)"
    )  # fmt: skip
    memory.set_defaults(run=_memory)


def _add_reads(actions: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    reads = actions.add_parser(
        "reads",
        help="latency of reading a window",
        description="Reads windows of 640 x 480 px with their surface model at random places, per level: cold (nothing "
        "decoded is cached) and again.",
    )
    reads.add_argument("pack", type=Path, metavar="PACK")
    reads.add_argument("--windows", type=positive_int, default=300, help="per level (default: %(default)s)")
    reads.add_argument("--seed", type=int, default=0, help="of the places (default: %(default)s)")
    reads.set_defaults(run=_reads)


def _add_build(actions: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    build = actions.add_parser(
        "build",
        help="build speed over processes and a Dask cluster",
        description="Builds the same pack by one process, by several, and on a local Dask cluster of worker "
        "processes. Beforehand one build is thrown away, so that all find the sources in the page cache.",
    )
    build.add_argument("--dop", type=Path, nargs="+", required=True, metavar="PATH")
    build.add_argument("--dsm", type=Path, nargs="+", required=True, metavar="PATH")
    build.add_argument("--crs", metavar="EPSG:N", help="of sources that do not name theirs")
    build.add_argument("--quality", type=int, default=PackOptions().quality, help="(default: %(default)s)")
    build.add_argument("--features", choices=MATCHERS, help="precompute this matcher's features")
    build.add_argument("--jobs", type=positive_int, nargs="+", default=[1, 2], help="(default: %(default)s)")
    build.add_argument("--dask", type=positive_int, nargs="*", default=[2], metavar="N", help="workers (default: 2)")
    build.add_argument("--repeats", type=positive_int, default=1, help="of each, in turn (default: %(default)s)")
    build.add_argument("--no-warm-up", action="store_true", help="do not throw a build away first")
    build.add_argument(
        "--scratch", type=Path, metavar="DIR", help="where packs are built (default: a temporary folder)"
    )
    build.set_defaults(run=_build)


# --- size ---


def _size(args: argparse.Namespace) -> int:
    features, features_of = _features(args.features, args.matcher)
    chosen = packs.variants(args.webp, args.jpeg, args.z_error, features, features_of, args.quality)
    with ProgressBar(f"model {args.matcher}") as bar:
        matcher = make_method(args.matcher, working_px=640, max_keypoints=4096, threads=1, progress=bar.step)
    found: dict[str, list[packs.Measured]] = {}
    table_head(
        "| set | pack | MB/km² | of it DOP / DSM / features | beside MB | frames | recall 1m-1° | TE median m "
        "| RE median ° | TE against lossless | per frame |"
    )
    with tempfile.TemporaryDirectory(prefix="ortholoc-bench-") as scratch:
        for name in args.sets:
            flight, dop, dsm = _flight(args.data / name)
            folder = Path(scratch) / name
            folder.mkdir()
            rasters = packs.coarsened(folder, dop, dsm, args.dop_gsd, args.dsm_gsd)
            for k, variant in enumerate(tqdm(chosen, desc=name, file=sys.stderr, leave=False)):
                pack = build_pack(*rasters, folder / str(k), variant.options, None, Workers(args.jobs))
                done = packs.measure_variant(flight, pack, matcher, variant.features, PriorKind(args.prior), args.seeds)
                found.setdefault(variant.name, []).append(done)
                _print_size(name, packs.size_row(variant.name, [done], [found[chosen[0].name][-1]]))
    if len(args.sets) > 1:
        for variant in chosen:
            _print_size("all", packs.size_row(variant.name, found[variant.name], found[chosen[0].name]))
    return 0


def _features(asked: list[float] | None, method: str) -> tuple[list[float], str]:
    """Features per million pixels to measure, and the matcher that they are extracted for."""
    name = method.removeprefix(f"{STRUCTURAL}+")
    if name in FEATURE_MATCHERS:
        return [PackOptions().features_per_mpx] if asked is None else asked, name
    if asked:
        raise ConfigError(f"packs have no features for {method}, only for {', '.join(FEATURE_MATCHERS)}; see --matcher")
    return [], name


def _flight(folder: Path) -> tuple[Path, Path, Path]:
    dop, dsm = sorted(folder.glob("*_dop.tif")), sorted(folder.glob("*_dsm.tif"))
    if not dop or not dsm:
        raise DatasetError(f"{folder}: no *_dop.tif and *_dsm.tif there; see docs/sequences.md")
    return folder, dop[0], dsm[0]


def _print_size(name: str, row: packs.SizeRow) -> None:
    print(
        f"| {name} | {row.variant} | {row.mb_per_km2:.2f} | {row.dop_mb_per_km2:.2f} / {row.dsm_mb_per_km2:.2f} / "
        f"{row.features_mb_per_km2:.2f} | {row.beside_mb:.3f} | {row.frames} | {100 * row.recall:.1f} % | "
        f"{row.te_median_m:.3f} | {row.re_median_deg:.3f} | {_change(row.te_ratio)} "
        f"({_change(row.te_ratio_low)} to {_change(row.te_ratio_high)}) | {_change(row.frame_ratio)} "
        f"({_change(row.frame_ratio_low)} to {_change(row.frame_ratio_high)}) |",
        flush=True,
    )


def _change(ratio: float) -> str:
    return f"{100 * (ratio - 1):+.1f} %"


# --- memory ---


def _memory(args: argparse.Namespace) -> int:
    table_head(
        "| pack | km² | compressed MB | imports / + model / + pack MB | RSS median / peak MB | peak - compressed MB "
        "| frames, fixed | CPU ms median |"
    )

    def process(pack: Path, flight: Path) -> pack_process.LocalizerProcess:
        return pack_process.LocalizerProcess(
            pack, flight, matcher=args.matcher, features=args.features, cache_bytes=args.cache_mb * 2**20
        )

    with process(args.pack, args.flight) as alone:
        _print_memory(args.pack.name, pack_process.run_alone(alone, args.frames))
    if args.small is None:
        return 0
    flight = args.small_flight or args.flight
    with process(args.small, flight) as small, process(args.pack, flight) as large:
        # The first frames pay for what is set up once.
        pack_process.run_paired(small, large, 2)
        runs = pack_process.run_paired(small, large, args.frames)
    _print_memory(f"{args.small.name}, in turn", runs[0])
    _print_memory(f"{args.pack.name}, in turn", runs[1])
    cpu = np.array([[s.cpu_ms for s in run.steps] for run in runs])
    low, high = _ratio_interval(cpu)
    print(
        f"\nCPU per frame, {runs[1].started.km2:.1f} against {runs[0].started.km2:.1f} km²: ratio of medians "
        f"{np.median(cpu[1]) / np.median(cpu[0]):.3f} (95 % {low:.3f} to {high:.3f}), "
        f"median of the frames' ratios {np.median(cpu[1] / cpu[0]):.3f}."
    )
    return 0


def _ratio_interval(cpu: np.ndarray) -> tuple[float, float]:
    rng = np.random.default_rng(0)
    drawn = rng.integers(0, cpu.shape[1], (2000, cpu.shape[1]))
    ratios = np.median(cpu[1][drawn], axis=1) / np.median(cpu[0][drawn], axis=1)
    low, high = np.percentile(ratios, [2.5, 97.5])
    return float(low), float(high)


def _print_memory(name: str, run: pack_process.MemoryRun) -> None:
    begun, steps = run.started, run.steps
    print(
        f"| {name} | {begun.km2:.1f} | {begun.compressed_mb:.1f} | {begun.imported_mb:.0f} / {begun.model_mb:.0f} / "
        f"{begun.pack_mb:.0f} | {median(s.rss_mb for s in steps):.0f} / {max(s.peak_mb for s in steps):.0f} | "
        f"{run.above_pack_mb:.0f} | {len(steps)}, {100 * run.fixed_share:.0f} % | "
        f"{median(s.cpu_ms for s in steps):.0f} |",
        flush=True,
    )


# --- reads ---


def _reads(args: argparse.Namespace) -> int:
    table_head("| level | GSD m | windows | cold median / p99 ms | warm median / p99 ms |")
    for row in packs.measure_reads(Pack.open(args.pack), windows=args.windows, seed=args.seed):
        print(
            f"| {row.level} | {row.gsd_m:.2f} | {row.windows} | {row.cold_median_ms:.1f} / {row.cold_p99_ms:.1f} | "
            f"{row.warm_median_ms:.1f} / {row.warm_p99_ms:.1f} |",
            flush=True,
        )
    return 0


# --- build ---


def _build(args: argparse.Namespace) -> int:
    options = PackOptions(vertical="unknown", source_crs=args.crs, quality=args.quality, features=args.features)
    table_head("| workers | km² | wall s | km²/min | km²/min per core | against one process | pack MB |")
    first: float | None = None
    with tempfile.TemporaryDirectory(prefix="ortholoc-bench-", dir=args.scratch) as scratch:
        if not args.no_warm_up:
            packs.measure_build(args.dop, args.dsm, Path(scratch) / "warm-up", options, max(args.jobs))
        plans = [(count, False) for count in args.jobs] + [(count, True) for count in args.dask]
        for repeat in range(args.repeats):
            for k, (count, dask) in enumerate(plans):
                out = Path(scratch) / f"{repeat}-{k}"
                with _cluster(count if dask else 0) as address:
                    row = packs.measure_build(args.dop, args.dsm, out, options, count, address)
                if first is None or (count == 1 and not dask):
                    first = row.km2_per_minute
                print(
                    f"| {row.workers} {row.where} | {row.km2:.2f} | {row.wall_s:.1f} | {row.km2_per_minute:.1f} | "
                    f"{row.km2_per_minute_per_core:.1f} | {row.km2_per_minute / first:.2f} | {row.megabytes:.1f} |",
                    flush=True,
                )
    return 0


@contextmanager
def _cluster(workers: int) -> Iterator[str | None]:
    """Address of a local Dask cluster of worker processes; None for no workers."""
    if workers == 0:
        yield None
        return
    try:
        from dask import distributed
    except ImportError as err:
        raise ConfigError(
            "building on Dask needs it; install it with: pip install 'ortholoc-edge[dask]', or give an empty --dask"
        ) from err
    start_cluster: Any = distributed.LocalCluster
    with start_cluster(
        n_workers=workers, threads_per_worker=1, processes=True, host="127.0.0.1", dashboard_address=None
    ) as cluster:
        yield str(cluster.scheduler_address)
