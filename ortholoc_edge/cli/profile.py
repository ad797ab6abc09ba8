"""``profile``: how long frames take at reduced resolutions on this machine, and what that costs."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import msgspec
from tqdm import tqdm

from ortholoc_edge.bench import profile
from ortholoc_edge.bench.flight_log import log_files
from ortholoc_edge.bench.profile_plot import profile_svg
from ortholoc_edge.bench.profile_process import Source
from ortholoc_edge.bench.replay import PriorKind
from ortholoc_edge.cli import matcher_options
from ortholoc_edge.cli.arguments import non_negative, positive, positive_int, seed, within, writable_folder
from ortholoc_edge.cli.measured import provenance
from ortholoc_edge.cli.progress import ProgressBar
from ortholoc_edge.errors import ConfigError, DatasetError, OrtholocError
from ortholoc_edge.matching import models, providers
from ortholoc_edge.matching.registry import METHODS, make_method, runs_network
from ortholoc_edge.matching.types import STRUCTURAL

T = TypeVar("T")


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    parser = subparsers.add_parser(
        "profile",
        help="how long frames take at reduced resolutions here, what that costs in accuracy, and what to set",
        description="Flies a recorded sequence with each setting (scale, matcher, threads) in a fresh process of its "
        "own, through the steps that the daemon takes, all settings frame by frame in turn, so that a busy machine "
        "hits them alike. Prints wall time of frames and stages, processor time, memory and, beside them, accuracy: "
        "against the true poses of a flight folder, against full detail where a flight log has none. With --rate it "
        "recommends a setting. See docs/profile.md.",
    )
    parser.add_argument(
        "--frames",
        type=Path,
        required=True,
        metavar="FLIGHT",
        help="folder of photos with a *_flight.csv, or a flight log of the daemon (.mcap or a folder of them, written "
        'with frames = "all")',
    )
    parser.add_argument("--pack", type=Path, metavar="DIR", help="area pack (default: a flight log's own)")
    parser.add_argument(
        "--scales",
        type=_listed(within("a scale", float, 0.05, 1.0)),
        default=[1.0, 0.75, 0.5, 0.3],
        metavar="S,S",
        help="resolutions at which frames are matched, of --working-px; structural matching takes the rung of its "
        "ladder that has so much detail (default: 1,0.75,0.5,0.3)",
    )
    parser.add_argument(
        "--matcher",
        type=_listed(_method),
        default=[STRUCTURAL],
        metavar="NAME,NAME",
        help=f"{', '.join(METHODS)} (default: {STRUCTURAL})",
    )
    parser.add_argument(
        "--threads",
        type=_listed(positive_int),
        default=[1],
        metavar="N,N",
        help="threads of one inference, for matchers with a network (default: 1)",
    )
    matcher_options.add_provider(parser)
    parser.add_argument(
        "--working-px",
        type=positive_int,
        default=640,
        help="of a matcher of features at scale 1 (default: %(default)s)",
    )
    parser.add_argument("--max-keypoints", type=positive_int, default=4096, help="per image (default: %(default)s)")
    parser.add_argument("--no-adhop", action="store_true", help="one matching round only; a flight log's own counts")
    matcher_options.add_features(parser)
    parser.add_argument(
        "--prior",
        choices=[str(kind) for kind in PriorKind],
        default=str(PriorKind.ODOMETER),
        help="of a flight folder, as in replay (default: %(default)s)",
    )
    parser.add_argument("--seed", type=seed, default=0, help="of the first pass's noise (default: %(default)s)")
    parser.add_argument(
        "--passes", type=positive_int, default=5, help="times that the flight is flown, with other noise (default: 5)"
    )
    parser.add_argument(
        "--warm-up",
        type=seed,
        default=3,
        metavar="FRAMES",
        help="that each setting flies first and that are not timed (default: %(default)s)",
    )
    rate = parser.add_argument_group("recommendation")
    rate.add_argument(
        "--rate", type=positive, metavar="HZ", help="recommend a setting whose slowest of 100 frames keeps this rate"
    )
    rate.add_argument(
        "--max-recall-loss",
        type=non_negative,
        default=2.0,
        metavar="PERCENT",
        help="of frames within 1 m and 1 degree, below the best setting (default: %(default)s)",
    )
    rate.add_argument(
        "--max-error",
        type=positive,
        default=1.0,
        metavar="METRES",
        help="nine of ten fixes are nearer to the truth; without true poses: to full detail's (default: %(default)s)",
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of the tables")
    parser.add_argument("--out", type=Path, metavar="DIR", help="write profile.md, profile.json and profile.svg there")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    if not args.frames.exists():
        raise DatasetError(f"{args.frames}: no such file or folder")
    logs = log_files(args.frames)
    if args.pack is None and not logs:
        raise ConfigError("--pack is missing; build one with: ortholoc-edge tiles build --dop … --dsm … --out PACK")
    if args.provider != providers.CPU:
        providers.require(args.provider)
        if not any(map(runs_network, args.matcher)):
            raise ConfigError(f"--provider {args.provider}: none of {', '.join(args.matcher)} runs a network")
    asked, merged = profile.settings(
        matchers=args.matcher,
        scales=args.scales,
        threads=args.threads,
        working_px=args.working_px,
        max_keypoints=args.max_keypoints,
        provider=args.provider,
    )
    if args.out:
        writable_folder(args.out, "--out")
    _build_models(args.matcher)
    source = Source(
        flight=str(args.frames),
        pack=None if args.pack is None else str(args.pack),
        prior=args.prior,
        seed=args.seed,
        adhop=not args.no_adhop,
        features=args.features,
    )
    began = profile.load_average()
    with tqdm(total=len(asked), desc="starting", unit="step", leave=False) as bar:

        def progress(done: int, steps: int) -> None:
            bar.total = steps
            bar.set_description(f"{args.frames.name}, {len(asked)} settings", refresh=False)
            bar.update(done - bar.n)

        rows = profile.measure(asked, source, passes=args.passes, warm_up_frames=args.warm_up, progress=progress)
    bounds = None
    if args.rate is not None:
        bounds = profile.Bounds(
            rate_hz=args.rate,
            recall_loss=args.max_recall_loss / 100.0,
            error_m=args.max_error,
        )
    measured = profile.Profile(
        measured=provenance(),
        load=(began, profile.load_average()),
        waited=profile.waited(rows),
        source=str(args.frames),
        pack="its own pack" if args.pack is None else str(args.pack),
        prior="as flown" if logs else args.prior,
        seed=args.seed,
        passes=args.passes,
        warm_up_frames=args.warm_up,
        merged=merged,
        rows=rows,
        recommendation=None if bounds is None else profile.recommend(rows, bounds),
    )
    text, encoded = profile.markdown(measured), msgspec.json.encode(measured).decode()
    if args.out:
        for name, content in (("md", text), ("json", encoded + "\n"), ("svg", profile_svg(measured))):
            try:
                (args.out / f"profile.{name}").write_text(content, encoding="utf-8")
            except OSError as err:
                raise OrtholocError(f"{args.out}: can't write profile.{name} ({err})") from err
    print(encoded if args.json else text, end="\n" if args.json else "")
    return 0


def _build_models(matchers: list[str]) -> None:
    """So that no process that is measured builds one."""
    for name in matchers:
        own = name.removeprefix(f"{STRUCTURAL}+")
        if own in models.CATALOGUE and not all(map(models.is_stored, (own, *models.known(own).needs))):
            with ProgressBar(f"model {own}") as bar:
                make_method(own, working_px=640, max_keypoints=1024, threads=1, progress=bar.step)


def _method(text: str) -> str:
    if text not in METHODS:
        raise argparse.ArgumentTypeError(f"{text!r} is not one of {', '.join(METHODS)}")
    return text


def _listed(kind: Callable[[str], T]) -> Callable[[str], list[T]]:
    """An argument type: values of a ``kind`` with commas between; each once."""

    def parse(text: str) -> list[T]:
        return list(dict.fromkeys(kind(part) for part in text.split(",")))

    return parse
