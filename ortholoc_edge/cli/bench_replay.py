"""``bench-replay``: what flies, with each matcher and prior, on recorded flights and samples."""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import replace
from itertools import product
from pathlib import Path

import msgspec
import numpy as np
from tqdm import tqdm

from ortholoc_edge.bench import metrics, sequence
from ortholoc_edge.bench.replay import FrameResult, PriorKind, PriorNoise
from ortholoc_edge.bench.runner import SAMPLES_PACK, prior_used, run_flight, run_samples, summarise
from ortholoc_edge.bench.samples import sample_paths
from ortholoc_edge.bench.sets import RecordedSet, find_sets
from ortholoc_edge.cli.arguments import positive_int
from ortholoc_edge.cli.progress import ProgressBar
from ortholoc_edge.errors import OrtholocError
from ortholoc_edge.matching.registry import METHODS, make_method
from ortholoc_edge.matching.types import AnyMatcher
from ortholoc_edge.pipeline.localizer import LocalizerOptions
from ortholoc_edge.tiles.build import PackOptions, build_pack
from ortholoc_edge.tiles.store import MapStore

_HEADING = (
    "| set | matcher | prior | AdHoP | frames | recall 1m-1° | 3m-3° | 5m-5° | TE median / p90 / max m | RE median ° | "
    "false fixes | NEES mean (6) | CPU ms |\n"
    "|---|---|---|---|---|---|---|---|---|---|---|---|---|"
)


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    parser = subparsers.add_parser(
        "bench-replay",
        help="measure the flying pipeline's matchers and priors on real sequences",
        description="Replays every set below DATA (folders with *_flight.csv, *_dop.tif and *_dsm.tif, or with .npz "
        "samples, or with a subfolder samples of these) with each matcher, prior and AdHoP setting, over several "
        "seeds, and prints a Markdown table. "
        "NEES and errors are over the fixes of all seeds, recall over all frames; CPU is the median of this "
        "process per frame, all threads. Samples have no past: every prior but none is truth-noise. A set that fails "
        "is reported on stderr, the next ones go on, and the exit code is 1.",
    )
    parser.add_argument("data", type=Path, metavar="DATA")
    parser.add_argument(
        "--matchers", nargs="+", choices=METHODS, default=["structural", "xfeat", "sift"],
        help="default: %(default)s",
    )  # fmt: skip
    parser.add_argument(
        "--priors", nargs="+", choices=[str(k) for k in PriorKind], default=["odometer", "none"],
        help="default: %(default)s",
    )  # fmt: skip
    parser.add_argument("--adhop", nargs="+", choices=["on", "off"], default=["on", "off"], help="default: both")
    parser.add_argument("--seeds", type=positive_int, default=5, help="how many, from 0 (default: %(default)s)")
    parser.add_argument(
        "--working-px", type=positive_int, default=640, help="a multiple of 32 for xfeat (default: %(default)s)"
    )  # fmt: skip
    parser.add_argument("--max-keypoints", type=positive_int, default=4096, help="default: %(default)s")
    parser.add_argument("--json", action="store_true", help="print one JSON object per row instead of the table")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    found = find_sets(args.data)
    # Before the sets: what is wrong here is wrong for all of them.
    matchers = {name: _matcher(name, args) for name in args.matchers}
    if not args.json:
        print(_HEADING)
    failed = []
    with tempfile.TemporaryDirectory(prefix="ortholoc-bench-") as scratch:
        for one in found:
            try:
                _measure(one, matchers, Path(scratch), args)
            except OrtholocError as error:
                print(f"ortholoc-edge: {one.name}: {error}", file=sys.stderr)
                failed.append(one.name)
    if failed:
        print(f"ortholoc-edge: {len(failed)} of {len(found)} sets failed: {', '.join(failed)}", file=sys.stderr)
    return 1 if failed else 0


def _matcher(name: str, args: argparse.Namespace) -> AnyMatcher:
    with ProgressBar(f"model {name}") as bar:
        return make_method(
            name, working_px=args.working_px, max_keypoints=args.max_keypoints, threads=1, progress=bar.step
        )


def _measure(one: RecordedSet, matchers: Mapping[str, AnyMatcher], scratch: Path, args: argparse.Namespace) -> None:
    store = _store(one, scratch)
    try:
        for summary in _rows(one, store, matchers, args):
            print(msgspec.json.encode(summary).decode() if args.json else _row(summary), flush=True)
    finally:
        if store is not None:
            store.close()


def _store(one: RecordedSet, scratch: Path) -> MapStore | None:
    if one.dop is None or one.dsm is None:
        return None
    return MapStore(build_pack(one.dop, one.dsm, scratch / one.name, PackOptions(quality=85, vertical="unknown")))


def _rows(
    one: RecordedSet, store: MapStore | None, matchers: Mapping[str, AnyMatcher], args: argparse.Namespace
) -> Iterator[metrics.Summary]:
    # Samples know fewer priors than can be asked for: none is measured twice.
    priors = dict.fromkeys(prior_used(PriorKind(asked), samples=store is None) for asked in args.priors)
    for (name, matcher), prior, adhop in product(matchers.items(), priors, args.adhop):
        options = LocalizerOptions(adhop=adhop == "on")
        results: list[FrameResult] = []
        for seed in tqdm(range(args.seeds), desc=f"{one.name} {name} {prior}", file=sys.stderr, leave=False):
            results += [replace(r, image=None) for r in _frames(one, store, matcher, options, prior, seed)]
        yield summarise(
            results,
            name=one.name,
            pack=SAMPLES_PACK if store is None else "built from the set",
            matcher=matcher,
            prior=prior,
            adhop=options.adhop,
            seed=0,
            seeds=args.seeds,
        )


def _frames(
    one: RecordedSet, store: MapStore | None, matcher: AnyMatcher, options: LocalizerOptions, kind: PriorKind, seed: int
) -> Iterator[FrameResult]:
    noise = PriorNoise()
    if store is None:
        return run_samples(sample_paths(one.folder), matcher, options, kind, noise, seed)
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
