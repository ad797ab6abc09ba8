"""``bench``: the table of docs/benchmarks.md, measured."""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import msgspec
import numpy as np
from tqdm import tqdm

from ortholoc_edge.bench import metrics, sequence
from ortholoc_edge.bench.replay import FrameResult, PriorKind, PriorNoise
from ortholoc_edge.bench.runner import run_flight, run_samples, summarise
from ortholoc_edge.cli.progress import ProgressBar
from ortholoc_edge.errors import DatasetError
from ortholoc_edge.matching.registry import MATCHERS, make_matcher
from ortholoc_edge.matching.types import Matcher
from ortholoc_edge.pipeline.localizer import LocalizerOptions
from ortholoc_edge.tiles.build import PackOptions, build_pack
from ortholoc_edge.tiles.store import MapStore

_HEADING = (
    "| set | matcher | prior | AdHoP | frames | recall 1m-1° | 3m-3° | 5m-5° | TE median / p90 / max m | RE median ° | "
    "false fixes | NEES mean (6) | CPU ms |\n"
    "|---|---|---|---|---|---|---|---|---|---|---|---|---|"
)


@dataclass(frozen=True, slots=True)
class _Set:
    """A flight with its two rasters, or a folder of samples."""

    name: str
    folder: Path
    dop: Path | None
    dsm: Path | None


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    parser = subparsers.add_parser(
        "bench",
        help="measure matchers, priors and AdHoP on real sequences",
        description="Replays every set below DATA (folders with *_flight.csv, *_dop.tif and *_dsm.tif, or with .npz "
        "samples) with each matcher, prior and AdHoP setting, over several seeds, and prints a Markdown table. "
        "NEES and errors are over the fixes of all seeds, recall over all frames; CPU is the median of this "
        "process per frame, all threads.",
    )
    parser.add_argument("data", type=Path, metavar="DATA")
    parser.add_argument("--matchers", nargs="+", choices=MATCHERS, default=list(MATCHERS), help="default: all")
    parser.add_argument(
        "--priors", nargs="+", choices=[str(k) for k in PriorKind], default=["odometer", "none"],
        help="default: %(default)s",
    )  # fmt: skip
    parser.add_argument("--adhop", nargs="+", choices=["on", "off"], default=["on", "off"], help="default: both")
    parser.add_argument("--seeds", type=int, default=5, help="how many, from 0 (default: %(default)s)")
    parser.add_argument("--working-px", type=int, default=640, help="default: %(default)s")
    parser.add_argument("--max-keypoints", type=int, default=4096, help="default: %(default)s")
    parser.add_argument("--json", action="store_true", help="print one JSON object per row instead of the table")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    found = _sets(args.data)
    if not args.json:
        print(_HEADING)
    with tempfile.TemporaryDirectory(prefix="ortholoc-bench-") as scratch:
        for one in found:
            store = _store(one, Path(scratch))
            try:
                for summary in _rows(one, store, args):
                    print(msgspec.json.encode(summary).decode() if args.json else _row(summary), flush=True)
            finally:
                if store is not None:
                    store.close()
    return 0


def _sets(data: Path) -> list[_Set]:
    found = []
    for folder in sorted(path for path in [data, *data.glob("*")] if path.is_dir()):
        dop, dsm = sorted(folder.glob("*_dop.tif")), sorted(folder.glob("*_dsm.tif"))
        if list(folder.glob("*_flight.csv")) and dop and dsm:
            found.append(_Set(folder.name, folder, dop[0], dsm[0]))
        elif sequence.sample_paths(folder):
            found.append(_Set(folder.name, folder, None, None))
    if not found:
        raise DatasetError(f"{data}: no set there; see docs/sequences.md")
    return found


def _store(one: _Set, scratch: Path) -> MapStore | None:
    if one.dop is None or one.dsm is None:
        return None
    return MapStore(build_pack(one.dop, one.dsm, scratch / one.name, PackOptions()))


def _rows(one: _Set, store: MapStore | None, args: argparse.Namespace) -> Iterator[metrics.Summary]:
    for name in args.matchers:
        with ProgressBar(f"model {name}") as bar:
            matcher = make_matcher(
                name, working_px=args.working_px, max_keypoints=args.max_keypoints, threads=1, progress=bar.step
            )
        for prior in args.priors:
            for adhop in args.adhop:
                options = LocalizerOptions(adhop=adhop == "on")
                results: list[FrameResult] = []
                for seed in tqdm(range(args.seeds), desc=f"{one.name} {name} {prior}", file=sys.stderr, leave=False):
                    found = _frames(one, store, matcher, options, PriorKind(prior), seed)
                    results += [replace(result, image=None) for result in found]
                yield summarise(
                    results,
                    name=one.name,
                    pack="its own",
                    matcher=matcher,
                    prior=PriorKind(prior),
                    adhop=options.adhop,
                    seed=args.seeds,
                )


def _frames(
    one: _Set, store: MapStore | None, matcher: Matcher, options: LocalizerOptions, kind: PriorKind, seed: int
) -> Iterator[FrameResult]:
    noise = PriorNoise()
    if store is None:
        return run_samples(sequence.sample_paths(one.folder), matcher, options, kind, noise, seed)
    return run_flight(sequence.read_flight(one.folder), store, matcher, options, kind, noise, seed)


def _row(s: metrics.Summary) -> str:
    def number(value: float | None, digits: int) -> str:
        return "-" if value is None or not np.isfinite(value) else f"{value:.{digits}f}"

    te = " / ".join(number(v, 2) for v in (s.te_m.median, s.te_m.p90, s.te_m.max))
    recall = " | ".join(f"{100 * part:.1f} %" for part in s.recall.values())
    return (
        f"| {s.sequence} | {s.matcher} | {s.prior} | {'on' if s.adhop else 'off'} | {s.frames} | {recall} | {te} | "
        f"{number(s.re_deg.median, 2)} | {s.false_fixes} | {number(s.nees.mean, 1)} | {s.cpu_ms_per_frame:.0f} |"
    )
