"""``bench-core``: the section about the localization core in docs/benchmarks.md, measured."""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Iterable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Final, TypeVar

import cv2
from tqdm import tqdm

from ortholoc_edge.bench import contact, core, draw, hostile
from ortholoc_edge.bench.sets import find_sets
from ortholoc_edge.cli.arguments import positive_int, seed, writable_folder
from ortholoc_edge.cli.core_report import FIGURES, HOSTILE, Report
from ortholoc_edge.cli.progress import ProgressBar
from ortholoc_edge.errors import ConfigError, DatasetError
from ortholoc_edge.matching.registry import METHODS, make_method
from ortholoc_edge.matching.types import STRUCTURAL, AnyMatcher

_PARTS: Final = ("tracking", "random", "crossdomain", "hostile", "paper")
_PAPER_MATCHERS: Final = ("xfeat", "xfeat-lighterglue")
_SHOWN = 10
_T = TypeVar("_T")


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add ``bench-core``."""
    parser = subparsers.add_parser(
        "bench-core",
        help="measure the localization core: accuracy, time, honesty, hostile frames, beside the paper's pipeline",
        description="Prints the section about the localization core of docs/benchmarks.md. Parts: tracking (flights by "
        "odometer prior), random (random priors: 3° yaw, 1° tilt, 6 % of the height above ground horizontally, 4 % "
        "vertically), crossdomain (the same on sets of ortholoc_sim.crossdomain), hostile (frames that must not give a "
        "fix), paper (the paper's own pipeline on the same frames). CPU and wall are from the decoded frame to the "
        "outcome; the first frame of a run does not count in them. A false fix is worse than 10 m, or 10 % of the "
        "height above ground if that is less, or 5°.",
    )
    parser.add_argument("data", type=Path, metavar="DATA", help="folder with the sets, as for bench")
    parser.add_argument("--parts", nargs="+", choices=_PARTS, default=list(_PARTS), help="(default: all)")
    parser.add_argument("--sets", nargs="+", help="of those below DATA (default: all)")
    parser.add_argument(
        "--matchers", nargs="+", choices=METHODS, default=[STRUCTURAL],
        help="measured; beside the paper's pipeline goes the first (default: %(default)s)",
    )  # fmt: skip
    parser.add_argument("--seeds", type=positive_int, default=5, help="runs of tracking (default: %(default)s)")
    parser.add_argument(
        "--draws", type=positive_int, default=500, metavar="N", help="random priors at least, over all frames "
        "(default: %(default)s)",
    )  # fmt: skip
    parser.add_argument(
        "--crossdomain", nargs="+", type=Path, default=[], metavar="FOLDER", help="sets of ortholoc_sim.crossdomain; "
        "they are the stale maps of the hostile part, too",
    )  # fmt: skip
    parser.add_argument(
        "--crossdomain-draws", type=positive_int, default=1, metavar="N", help="priors of each photo "
        "(default: %(default)s)",
    )  # fmt: skip
    parser.add_argument(
        "--hostile", type=positive_int, default=600, metavar="N", help="hostile frames (default: %(default)s)"
    )  # fmt: skip
    parser.add_argument(
        "--trials", nargs="+", type=seed, metavar="K", help="these hostile frames only, by their numbers"
    )  # fmt: skip
    parser.add_argument(
        "--workers", type=positive_int, default=1, help="processes of the hostile part (default: %(default)s)"
    )  # fmt: skip
    parser.add_argument("--seed", type=seed, default=0, help="of all noise (default: %(default)s)")
    parser.add_argument(
        "--query-px", type=positive_int, metavar="PX", help="long side that frames are averaged down to first "
        "(default: as they are)",
    )  # fmt: skip
    parser.add_argument(
        "--working-px", type=positive_int, default=640, help="of matchers of features (default: %(default)s)"
    )  # fmt: skip
    parser.add_argument("--max-keypoints", type=positive_int, default=4096, help="default: %(default)s")
    parser.add_argument(
        "--out", type=Path, metavar="FOLDER", help="write contact sheets of the ten best, median and worst frames of "
        "the random part there",
    )  # fmt: skip
    parser.add_argument("--json", action="store_true", help="print one JSON object per row instead of the tables")
    parser.set_defaults(run=run)


@dataclass(frozen=True, slots=True, eq=False)
class _Bench:
    """What the parts share."""

    args: argparse.Namespace
    report: Report
    sites: list[core.Site]
    scenes: list[core.Scene]
    others: list[core.Site]
    other_scenes: list[core.Scene]
    methods: list[AnyMatcher]


def run(args: argparse.Namespace) -> int:
    # As the localizer's threads are: OpenCV's own would fight them for two cores.
    cv2.setNumThreads(1)
    parts = [part for part in _PARTS if part in args.parts and (part != "crossdomain" or args.crossdomain)]
    if not parts:
        raise ConfigError("part crossdomain needs --crossdomain with its sets")
    if args.out is not None:
        if "random" not in parts:
            raise ConfigError("--out draws the frames of part random; add it to --parts")
        writable_folder(args.out, "--out")
    # Before the sets: what is wrong here is wrong for all of them.
    methods = [_method(name, args) for name in args.matchers]
    with tempfile.TemporaryDirectory(prefix="ortholoc-bench-") as scratch, ExitStack() as stack:
        sites, others = _sites(args, Path(scratch))
        bench = _Bench(
            args,
            Report(args.json),
            sites,
            [stack.enter_context(core.opened(site, args.query_px)) for site in sites],
            others,
            [stack.enter_context(core.opened(site, args.query_px)) for site in others],
            methods,
        )
        for part in parts:
            _MEASURES[part](bench)
    return 0


def _method(name: str, args: argparse.Namespace) -> AnyMatcher:
    with ProgressBar(f"model {name}") as bar:
        return make_method(
            name, working_px=args.working_px, max_keypoints=args.max_keypoints, threads=1, progress=bar.step
        )


def _sites(args: argparse.Namespace, scratch: Path) -> tuple[list[core.Site], list[core.Site]]:
    """Of DATA, and of the sets across domains."""
    found = find_sets(args.data)
    missing = set(args.sets or []) - {one.name for one in found}
    if missing:
        raise DatasetError(
            f"{args.data}: no set {', '.join(sorted(missing))} there; there are {', '.join(one.name for one in found)}"
        )
    wanted = [one for one in found if args.sets is None or one.name in args.sets]
    across = [one for folder in args.crossdomain for one in find_sets(folder)]
    (scratch / "data").mkdir()
    (scratch / "across").mkdir()
    return (
        [site for one in wanted for site in core.build_sites(one, scratch / "data")],
        [site for one in across for site in core.build_sites(one, scratch / "across")],
    )


# --- parts ---


def _tracking(bench: _Bench) -> None:
    bench.report.section("Tracking", f"Flights by odometer prior, {bench.args.seeds} seeds.", FIGURES)
    measured: list[core.Take] = []
    flights = [scene for scene in bench.scenes if scene.site.is_flight]
    for method in bench.methods:
        every: list[core.Take] = []
        for scene in flights:
            takes = list(_bar(core.track(scene, method, bench.args.seeds), f"{scene.site.name} {method.name}"))
            every += takes
            bench.report.figures(core.figures("tracking", scene.site.name, method.name, takes))
        bench.report.figures(core.figures("tracking", "all", method.name, every), is_judged=True)
        measured += every
    bench.report.missed(measured)
    bench.report.targets()


def _random(bench: _Bench) -> None:
    frames = sum(len(scene.views) for scene in bench.scenes)
    draws = -(-bench.args.draws // frames)
    bench.report.section("Random priors", f"{draws} of each of {frames} frames.", FIGURES)
    measured: list[core.Take] = []
    for method in bench.methods:
        found = _by_set(bench.scenes, method, draws, bench.args.seed)
        every = [take for takes in found.values() for take in takes]
        for name, takes in found.items():
            bench.report.figures(core.figures("random", name, method.name, takes))
        bench.report.figures(core.figures("random", "all", method.name, every), is_judged=True)
        measured += every
        if bench.args.out is not None:
            for which, chosen in contact.best_median_worst(every, _SHOWN).items():
                draw.write_png(bench.args.out / f"{method.name}_{which}.png", contact.sheet(chosen))
    bench.report.missed(measured)
    bench.report.targets()


def _crossdomain(bench: _Bench) -> None:
    draws = bench.args.crossdomain_draws
    measured: list[core.Take] = []
    bench.report.section("Across domains", f"Random priors, {draws} of each photo.", FIGURES)
    for method in bench.methods:
        for name, takes in _by_set(bench.other_scenes, method, draws, bench.args.seed).items():
            bench.report.figures(core.figures("crossdomain", name, method.name, takes), is_judged=True)
            measured += takes
            lasting = core.lasting(takes)
            if lasting:
                bench.report.figures(
                    core.figures("crossdomain", f"{name} with something lasting in view", method.name, lasting),
                    is_judged=True,
                )
    bench.report.missed(measured)
    bench.report.targets()


def _by_set(scenes: Iterable[core.Scene], method: AnyMatcher, draws: int, seed: int) -> dict[str, list[core.Take]]:
    found: dict[str, list[core.Take]] = {}
    for scene in scenes:
        takes = core.random_priors(scene, method, draws, seed)
        found.setdefault(scene.site.name, []).extend(_bar(takes, f"{scene.site.name} {method.name}"))
    return found


def _hostile(bench: _Bench) -> None:
    args = bench.args
    numbers = list(range(args.hostile)) if args.trials is None else args.trials
    matching = hostile.Matching(tuple(args.matchers), args.working_px, args.max_keypoints)
    verdicts = list(
        _bar(
            hostile.run_trials(
                numbers, bench.sites, bench.others, matching,
                seed=args.seed, query_px=args.query_px, workers=args.workers,
            ),
            "hostile frames",
        )
    )  # fmt: skip
    bench.report.section(
        "Hostile frames",
        f"{len(numbers)} frames with each matcher, seed {args.seed}."
        + ("" if bench.others else " Stale maps were left out: they need --crossdomain."),
        HOSTILE,
    )
    for method in bench.methods:
        for kind in hostile.Kind:
            of_kind = [v for v in verdicts if v.kind is kind and v.matcher == method.name]
            bench.report.counts(str(kind), method.name, of_kind)
        of_all = [v for v in verdicts if v.matcher == method.name]
        bench.report.counts("all", method.name, of_all, is_judged=True)
    bench.report.targets()
    bench.report.false_fixes([v for v in verdicts if v.outcome == hostile.FALSE])


def _paper(bench: _Bench) -> None:
    theirs = [_method(name, bench.args) for name in _PAPER_MATCHERS]
    ours = bench.methods[0]
    names = [f"paper {name}" for name in _PAPER_MATCHERS]
    found: dict[str, list[core.Take]] = {name: [] for name in (*names, ours.name)}
    for scene in bench.scenes:
        for papers, own in _bar(core.beside_the_paper(scene, theirs, ours, bench.args.seed), scene.site.name):
            for name, take in zip(found, (*papers, own), strict=True):
                found[name].append(take)
    bench.report.section(
        "Beside the paper's pipeline",
        "The paper's: a region, four rotations, AdHoP, RANSAC-PnP, no gate. Ours: a random prior. Frame by frame in "
        "turn.",
        FIGURES,
    )
    for name, takes in found.items():
        bench.report.figures(core.figures("paper", "all", name, takes))
    bench.report.comparisons([core.compared(found[name], found[ours.name], (name, ours.name)) for name in names])
    bench.report.targets()


_MEASURES: Final = {
    "tracking": _tracking,
    "random": _random,
    "crossdomain": _crossdomain,
    "hostile": _hostile,
    "paper": _paper,
}


def _bar(items: Iterable[_T], description: str) -> Iterable[_T]:
    bar: Iterable[_T] = tqdm(items, desc=description, file=sys.stderr, leave=False)
    return bar
