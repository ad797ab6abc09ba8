"""``bench``: the paper's benchmark on samples."""

from __future__ import annotations

import argparse
import importlib.util
import logging
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from pathlib import Path

import msgspec
from tqdm import tqdm

from ortholoc_edge.bench import bench_page, campaign, cases, studies
from ortholoc_edge.bench.campaign import GROUND_TRUTH, MatcherSetup, Piece, Plan, Settings, Store
from ortholoc_edge.bench.paper import PaperOptions, Task
from ortholoc_edge.bench.plots import study_plot
from ortholoc_edge.bench.samples import SampleKind, Split, find_samples
from ortholoc_edge.bench.studies import STUDIES, Study
from ortholoc_edge.bench.tables import Table
from ortholoc_edge.cli.arguments import positive_int
from ortholoc_edge.cli.progress import ProgressBar
from ortholoc_edge.errors import OrtholocError
from ortholoc_edge.geometry.arrays import ImageArray
from ortholoc_edge.matching import models
from ortholoc_edge.matching.registry import MATCHERS
from ortholoc_edge.parallel import Workers

logger = logging.getLogger(__name__)

_ADHOP = {"on": (True,), "off": (False,), "both": (False, True)}
_REPORT, _TABLES = "report.html", "tables"


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    parser = subparsers.add_parser(
        "bench",
        help="compare matchers as the paper does, on OrthoLoC samples",
        description="Matches the photo of every sample below SAMPLES with its whole map, without any prior, and "
        "solves for the pose, or for the focal length too. Prints Markdown tables of the paper's metrics. With --out "
        "it writes them as Markdown, CSV and LaTeX, plots and a report with pictures, and a run that was cut off goes "
        "on where it was. A sample that can't be used is reported on stderr and the exit code is 1.",
    )
    parser.add_argument("samples", type=Path, metavar="SAMPLES", help="a file, or a folder and all below it")
    parser.add_argument(
        "--matcher", type=_names([*MATCHERS, GROUND_TRUTH]), default=["xfeat", "sift"], metavar="A,B",
        help=f"{', '.join(MATCHERS)}, and {GROUND_TRUTH}: the truth as matches (default: xfeat,sift)",
    )  # fmt: skip
    parser.add_argument("--adhop", choices=list(_ADHOP), default="both", help="default: %(default)s")
    parser.add_argument(
        "--task", type=_names([str(task) for task in Task]), default=[str(Task.LOCALIZE)], metavar="A,B",
        help=f"{', '.join(Task)} (default: localize)",
    )  # fmt: skip
    parser.add_argument(
        "--study", type=_names(list(STUDIES)), default=[], metavar="A,B",
        help=f"{', '.join(STUDIES)}: errors against each, as a table and a plot. confidence is of {GROUND_TRUTH} alone",
    )  # fmt: skip
    parser.add_argument("--kind", type=_names([str(kind) for kind in SampleKind]), metavar="A,B", help="default: all")
    parser.add_argument("--split", type=_names([str(split) for split in Split]), metavar="A,B", help="default: all")
    parser.add_argument("--limit", type=positive_int, metavar="N", help="the first N samples of each kind")
    parser.add_argument(
        "--turns", type=int, choices=(1, 2, 4), default=4,
        help="the map is shown in so many quarter turns and the one with most matches counts (default: %(default)s)",
    )  # fmt: skip
    parser.add_argument(
        "--working-px", type=positive_int, default=640,
        help="long side at which matchers see pictures; a multiple of 32 (default: %(default)s)",
    )  # fmt: skip
    parser.add_argument("--max-keypoints", type=positive_int, default=2048, help="a picture (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="of all that is drawn (default: %(default)s)")
    parser.add_argument("--jobs", type=positive_int, default=1, help="processes (default: %(default)s)")
    parser.add_argument(
        "--dask", metavar="ADDRESS", help="scheduler of a Dask cluster whose workers see SAMPLES, instead of --jobs"
    )
    parser.add_argument("--json", action="store_true", help="one JSON object per sample and matcher instead of tables")
    parser.add_argument("--out", type=Path, metavar="DIR", help="results, tables, plots and report.html")
    parser.set_defaults(run=run)


def _names(known: Sequence[str]) -> Callable[[str], list[str]]:
    def parse(text: str) -> list[str]:
        names = list(dict.fromkeys(text.split(",")))
        for name in names:
            if name not in known:
                raise argparse.ArgumentTypeError(f"{name!r} is not known; known are: {', '.join(known)}")
        return names

    return parse


def run(args: argparse.Namespace) -> int:
    asked = [study for name in args.study for study in STUDIES[name]]
    # Of blunders in the samples' heights, which each of their many readings would tell again.
    logging.getLogger("ortholoc_edge.bench.samples").setLevel(logging.ERROR)
    options = PaperOptions(turns=args.turns, seed=args.seed)
    # First: what is wrong with --out is told before matchers are built.
    settings = Settings(working_px=args.working_px, max_keypoints=args.max_keypoints, options=options)
    with closing(Store(settings, args.out)) as store:
        return _run(args, asked, options, store)


def _run(args: argparse.Namespace, asked: Sequence[Study], options: PaperOptions, store: Store) -> int:
    plan = _plan(args, asked, options)
    jobs = plan.jobs()
    failures = _measure(plan, store, Workers(args.jobs, args.dask))
    pieces = store.pieces(jobs)
    if args.json:
        for piece in pieces:
            print(msgspec.json.encode(piece).decode())
    tables = list(_tables(pieces, asked, plan.tasks))
    if not args.json:
        print("\n".join(f"### {table.title}\n\n{table.markdown()}" for table, _ in tables))
    if args.out is not None and pieces:
        _write(args.out, plan, pieces, tables)
    if failures:
        print(f"ortholoc-edge: {failures} of {len(jobs)} pieces of work failed", file=sys.stderr)
    return 1 if failures else 0


def _plan(args: argparse.Namespace, asked: Sequence[Study], options: PaperOptions) -> Plan:
    names = list(args.matcher)
    if any(study.of_truth for study in asked) and GROUND_TRUTH not in names:
        names.append(GROUND_TRUTH)
    kinds = None if args.kind is None else [SampleKind(kind) for kind in args.kind]
    splits = None if args.split is None else [Split(split) for split in args.split]
    files = find_samples(args.samples, kinds, splits)
    if args.limit is not None:
        files = [one for kind in SampleKind for one in [f for f in files if f.kind is kind][: args.limit]]
    return Plan(
        # Workers of a cluster have folders of their own to be in.
        args.samples.absolute(),
        files,
        [_setup(name, args) for name in names],
        {name: studies.conditions_for(name, asked) for name in names},
        [Task(task) for task in args.task],
        _ADHOP[args.adhop],
        options,
    )


def _setup(name: str, args: argparse.Namespace) -> MatcherSetup:
    # Built here if need be: workers only load it.
    for model in _models_of(name):
        with ProgressBar(f"model {model}") as bar:
            models.ensure(model, bar.step)
    return campaign.setup_of(name, args.working_px, args.max_keypoints)


def _models_of(name: str) -> tuple[str, ...]:
    return (name, *models.known(name).needs) if name in models.CATALOGUE else ()


def _measure(plan: Plan, store: Store, workers: Workers) -> int:
    """How many pieces failed, which are reported."""
    failed = 0
    with tqdm(total=0, unit="piece", file=sys.stderr, leave=False) as bar:
        for done, total, failure in campaign.run(plan, store, workers):
            if bar.total != total:
                # What is there from an earlier run says nothing about how fast this one is.
                bar.reset(total)
                bar.initial = done
            bar.update(done - bar.n)
            if failure is not None:
                failed += 1
                tqdm.write(f"ortholoc-edge: {failure.why}", file=sys.stderr)
    return failed


def _tables(
    pieces: Sequence[Piece], asked: Sequence[Study], tasks: Sequence[Task]
) -> Iterator[tuple[Table, Study | None]]:
    for task in tasks:
        yield studies.main_table(pieces, task), None
        changes = studies.adhop_table(pieces, task)
        if changes.rows:
            yield changes, None
        for study in asked:
            yield studies.study_table(pieces, study, task), study


def _write(
    folder: Path, plan: Plan, pieces: Sequence[Piece], tables: Sequence[tuple[Table, Study | None]]
) -> None:
    can_plot = importlib.util.find_spec("matplotlib") is not None
    if not can_plot and any(study is not None for _, study in tables):
        logger.warning("no plots: install matplotlib with pip install 'ortholoc-edge[report]' and run this again")
    with_plots = [
        (table, study_plot(table, study.headings) if study is not None and can_plot and table.rows else None)
        for table, study in tables
    ]
    models_used = {setup.name: setup.model_sha256 for setup in plan.matchers}
    notes = [
        f"{len({piece.sample for piece in pieces})} samples of {plan.source.absolute().name}; {plan.options.turns} "
        f"quarter turns, {pieces[0].results[0].condition.min_confidence:g} least confidence, no prior",
        "models: " + ", ".join(f"{name} {sha[:12] if sha else 'without weights'}" for name, sha in models_used.items()),
        "A sample without a pose counts as infinitely wrong, in medians too. Times are of one thread beside whatever "
        "else ran.",
    ]
    try:
        (folder / _TABLES).mkdir(exist_ok=True)
        # What an earlier run asked for is of other samples, perhaps.
        for old in (folder / _TABLES).iterdir():
            if old.suffix in (".md", ".csv", ".tex", ".png"):
                old.unlink()
        for table, plot in with_plots:
            stem = folder / _TABLES / table.name
            stem.with_suffix(".md").write_text(table.markdown(), "utf-8")
            stem.with_suffix(".csv").write_text(table.csv(), "utf-8")
            stem.with_suffix(".tex").write_text(table.latex(), "utf-8")
            if plot is not None:
                stem.with_suffix(".png").write_bytes(plot)
        text = bench_page.page("Matchers compared", notes, with_plots, _pictures(plan, pieces))
        (folder / _REPORT).write_text(text, "utf-8")
    except OSError as err:
        raise OrtholocError(f"{folder}: can't write the report ({err}); free space and run again") from err


def _pictures(plan: Plan, pieces: Sequence[Piece]) -> Iterator[tuple[str, ImageArray]]:
    jobs = plan.jobs()
    for task in plan.tasks:
        chosen = cases.choose(pieces, jobs, task)
        for case in tqdm(chosen, unit="picture", file=sys.stderr, leave=False):
            try:
                yield f"{task}, {case.title}: {case.job.sample}", cases.drawn(case, task)
            except OrtholocError as error:
                # The tables are worth having without it.
                logger.warning("no picture of %s: %s", case.title, error)
