"""``sim --scenario``: scenarios of simulated flights, flown on simulated time and judged by what their files expect."""

from __future__ import annotations

import argparse
import html
import json
import logging
import sys
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import quote

import msgspec
from tqdm import tqdm

from ortholoc_edge.cli.arguments import positive_int, writable_folder
from ortholoc_edge.cli.measured import provenance
from ortholoc_edge.errors import ConfigError, OrtholocError

if TYPE_CHECKING:
    from ortholoc_sim.judgement import Result
    from ortholoc_sim.scenario import Scenario

ALL = "all"
_COLUMNS = (
    "| scenario | seed | frames | fixed | false | position median / p90 / max m | NEES / dof | off the route, p95 m | "
    "autopilot median / max m | dead reckoning m | wall s | as expected |"
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group(
        "scenarios", "Flown on simulated time: the same scenario and seed give the same results, byte for byte."
    )
    group.add_argument(
        "--scenario",
        action="append",
        metavar="NAME|FILE|all",
        help="fly this one, a shipped one by name, or a file (docs/simulation.md); can be given again. Exit code 1 if "
        "one did not come out as it expects",
    )
    group.add_argument("--list-scenarios", action="store_true", help="tell which are shipped, and end")
    group.add_argument(
        "--seeds",
        type=positive_int,
        default=1,
        metavar="K",
        help="fly with so many seeds from --seed on (default: %(default)s)",
    )
    group.add_argument("--short", action="store_true", help="the short form of each: a small world, some seconds")
    group.add_argument(
        "--without-fixes", action="store_true", help="show what becomes of the flight without us; nothing is expected"
    )
    group.add_argument(
        "--flight-log",
        action="store_true",
        help="keep the daemon's log of each flight in OUT/NAME/seed-N/log, for ortholoc-edge replay: 0.2 MB a frame",
    )
    group.add_argument(
        "--packs", type=Path, metavar="DIR", help="where map packs are kept from run to run (default: OUT/packs)"
    )


def list_scenarios() -> int:
    """Print names and titles."""
    from ortholoc_sim.scenario import read_scenario, shipped

    found = {name: read_scenario(path).title for name, path in shipped().items()}
    width = max(map(len, found))
    print("\n".join(f"{name:<{width}}  {title}" for name, title in found.items()))
    return 0


def fly_scenarios(args: argparse.Namespace) -> int:
    """Fly what ``--scenario`` names, with every seed; write results and reports below ``--out``."""
    if args.verbose:
        return _flown(args)
    # What the daemon warns of is what is being looked at: it is in the results.
    log = logging.getLogger("ortholoc_edge")
    before = log.level
    log.setLevel(logging.ERROR)
    try:
        return _flown(args)
    finally:
        log.setLevel(before)


def _flown(args: argparse.Namespace) -> int:
    from ortholoc_sim.judgement import figures, judge, times, write_files
    from ortholoc_sim.lockstep import fly
    from ortholoc_sim.report_page import write_page

    scenarios = _chosen(args)
    writable_folder(args.out, "--out")
    packs = args.packs or args.out / "packs"
    writable_folder(packs, "--packs")
    if not args.json:
        print(f"{provenance()}\n\n{_COLUMNS}\n|{'---|' * (_COLUMNS.count('|') - 1)}", flush=True)
    flights: list[tuple[Result, Path]] = []
    for scenario in scenarios:
        for seed in range(args.seed, args.seed + args.seeds):
            folder = args.out / scenario.name / f"seed-{seed}"
            with tqdm(desc=f"{scenario.name} {seed}", file=sys.stderr, leave=False, mininterval=0.5) as bar:
                bar.bar_format = "{desc}: {n:.0f} simulated seconds, {elapsed}"

                def tell(now_s: float, bar: tqdm[None] = bar) -> None:
                    bar.update(now_s - bar.n)

                flown = fly(scenario, seed, packs, tell, folder / "log" if args.flight_log else None)
            judged = judge(flown)
            write_files(judged, folder)
            write_page(judged, folder / "report.html")
            flights.append((judged.result, folder))
            # After each: what ends the next one leaves what was flown.
            _write_summary(args.out, flights)
            if not args.json:
                print(_row(judged.result, times(flown)["wall_s"]), flush=True)
    if args.json:
        print(json.dumps([figures(result) for result, _ in flights]))
    else:
        print("\n".join(["", *_totals([result for result, _ in flights], args.out)]))
    return 0 if all(result.passed for result, _ in flights) else 1


def _chosen(args: argparse.Namespace) -> list[Scenario]:
    from ortholoc_sim.scenario import Expectations, find_scenario, read_scenario, shipped

    names: list[str] = []
    for name in args.scenario:
        names += [other for other in (shipped() if name == ALL else [name]) if other not in names]
    scenarios = [read_scenario(find_scenario(name), args.short) for name in names]
    twice = [name for name, count in Counter(one.name for one in scenarios).items() if count > 1]
    if twice:
        raise ConfigError(
            f"several scenarios are named {twice[0]}, and would write to the same folder; rename one of the files"
        )
    if args.without_fixes:
        scenarios = [msgspec.structs.replace(one, fixes=False, expect=Expectations()) for one in scenarios]
    # Those over the same ground together: it is made once.
    return sorted(scenarios, key=lambda one: repr((one.world, one.map.kind)))


def _write_summary(out: Path, flights: Sequence[tuple[Result, Path]]) -> None:
    from ortholoc_sim.judgement import figures

    links = "".join(
        f'<tr><td><a href="./{quote(folder.relative_to(out).as_posix())}/report.html">'
        f"{html.escape(result.scenario)}</a></td><td>{result.seed}</td><td>{html.escape(result.title)}</td>"
        f"<td>{'as expected' if result.passed else html.escape('; '.join(result.problems))}</td></tr>"
        for result, folder in flights
    )
    page = (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8"><title>Simulated flights</title>'
        "<style>body{font:15px system-ui,sans-serif;margin:24px}td{padding:2px 14px 2px 0}</style></head>"
        f"<body><h1>Simulated flights</h1><table>{links}</table></body></html>\n"
    )
    every = [figures(result) for result, _ in flights]
    try:
        (out / "index.html").write_text(page, encoding="utf-8")
        (out / "summary.json").write_text(json.dumps(every, indent=2) + "\n", encoding="utf-8")
    except OSError as err:
        raise OrtholocError(f"{out}: can't write the summary ({err})") from err


def _row(result: Result, wall_s: float) -> str:
    position, autopilot = result.position_m, result.autopilot_m
    cells = (
        result.scenario,
        str(result.seed),
        str(result.frames),
        f"{result.fixed:.0%}",
        str(result.false_fixes),
        f"{_metres(position.median)} / {_metres(position.p90)} / {_metres(position.max)}",
        _metres(result.nees.pose),
        _metres(result.route_p95_m),
        f"{_metres(autopilot.median)} / {_metres(autopilot.max)}",
        _metres(result.dead_reckoning_m),
        f"{wall_s:.0f}",
        "yes" if result.passed else "no: " + "; ".join(result.problems),
    )
    return f"| {' | '.join(cells)} |"


def _totals(results: Sequence[Result], out: Path) -> Iterator[str]:
    frames, fixes = sum(result.frames for result in results), sum(result.fixes for result in results)
    weighed = [(result.nees.pose, result.fixes) for result in results if result.nees.pose is not None]
    mean = sum(nees * count for nees, count in weighed) / fixes if fixes else None
    yield (
        f"{len(results)} flights, {sum(result.passed for result in results)} as expected; {frames} frames, {fixes} "
        f"fixes, {sum(result.false_fixes for result in results)} of them false; NEES over its degrees of freedom "
        f"{_metres(mean)}"
    )
    yield f"reports: {out / 'index.html'}, figures: {out / 'summary.json'}"


def _metres(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"
