"""``bench --study``: studies on OrthoLoC samples."""

from __future__ import annotations

import argparse
import sys
from collections import defaultdict

import msgspec
import numpy as np
from tqdm import tqdm

from ortholoc_edge.bench.confidence import ConfidenceErrors, ConfidenceRow, confidence_errors, confidence_rows
from ortholoc_edge.bench.ground_truth import GroundTruthMatcher
from ortholoc_edge.bench.metrics import Spread
from ortholoc_edge.bench.samples import SampleKind, Split, find_samples, read_sample
from ortholoc_edge.errors import OrtholocError

STUDIES = ("confidence",)
_HEADING = (
    "| kind | samples | confidence | matches | TE median / p90 / max m | RE median / p90 / max ° | RPE median px | "
    "1m-1° | 3m-3° | 5m-5° |\n"
    "|---|---|---|---|---|---|---|---|---|---|"
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("studies", "Of the samples of DATA and all below it; --matchers, --priors, "
                                      "--adhop and --seeds do not go with them.")  # fmt: skip
    group.add_argument(
        "--study", choices=STUDIES, help="confidence: the pose by ground-truth matches above thresholds of the paper's "
        "geometry-aware confidence",
    )  # fmt: skip
    group.add_argument("--kinds", nargs="+", type=SampleKind, choices=list(SampleKind), help="default: all")
    group.add_argument("--splits", nargs="+", type=Split, choices=list(Split), help="default: all, and files in none")


def run(args: argparse.Namespace) -> int:
    files = find_samples(args.data, args.kinds, args.splits)
    found: dict[SampleKind, list[list[ConfidenceErrors]]] = defaultdict(list)
    failed = 0
    for file in tqdm(files, desc=args.study, unit="sample", file=sys.stderr, leave=False):
        try:
            found[file.kind].append(confidence_errors(read_sample(file.path), GroundTruthMatcher()))
        except OrtholocError as error:
            print(f"ortholoc-edge: {error}", file=sys.stderr)
            failed += 1
    if not args.json:
        print(_HEADING)
    for kind in SampleKind:
        for row in confidence_rows(found[kind]):
            if args.json:
                print(msgspec.json.encode({"kind": kind, **msgspec.to_builtins(row)}).decode())
            else:
                print(_row(kind, row))
    if failed:
        print(f"ortholoc-edge: {failed} of {len(files)} samples failed", file=sys.stderr)
    return 1 if failed else 0


def _row(kind: SampleKind, row: ConfidenceRow) -> str:
    errors = row.errors
    recall = " | ".join(f"{100 * part:.1f} %" for part in errors.recall.values())
    return (
        f"| {kind} | {errors.samples} | > {row.above:g} | {100 * row.kept:.1f} % | {_spread(errors.te_m)} | "
        f"{_spread(errors.re_deg)} | {_number(errors.rpe_px.median)} | {recall} |"
    )


def _spread(spread: Spread) -> str:
    return " / ".join(_number(value) for value in (spread.median, spread.p90, spread.max))


def _number(value: float | None) -> str:
    return "-" if value is None or not np.isfinite(value) else f"{value:.4f}"
