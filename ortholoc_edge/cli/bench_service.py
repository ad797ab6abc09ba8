"""``bench-service``: the daemon as it is installed, for hours and under load; the section in docs/benchmarks.md."""

from __future__ import annotations

import argparse
import json
import os
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec
from tqdm import tqdm

from ortholoc_edge.bench.metrics import Spread
from ortholoc_edge.cli.arguments import positive, positive_int, writable_folder
from ortholoc_edge.cli.measured import print_heading, provenance
from ortholoc_edge.errors import ConfigError, OrtholocError

if TYPE_CHECKING:
    from ortholoc_sim.soak import Moment, SoakReport

_LEAST_FRAMES = 60


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add ``bench-service``."""
    parser = subparsers.add_parser(
        "bench-service",
        help="measure the daemon as a service: hours of flight, faults, jitter",
        description="Flies the daemon as it is installed, as a process of its own under a supervisor that keeps the "
        "systemd unit's rules, on a simulated aircraft without GNSS, in real time.",
    )
    kinds = parser.add_subparsers(dest="kind", required=True, metavar="WHAT")
    soak = kinds.add_parser(
        "soak",
        help="whether anything grows: memory, threads, descriptors, pauses of the watchdog, logs",
        description="Flies for hours with flight log, bus and a watched ground page. Exit code 1 if memory grew by "
        "more than 5 %, threads or descriptors rose, the watchdog waited more than half its time, the daemon was "
        "started again, a log is damaged, a fix was 10 m off or fewer than 90 % of frames gave one.",
    )
    soak.add_argument("--hours", type=positive, default=2.0, metavar="H", help="(default: %(default)s)")
    soak.add_argument(
        "--rate", type=positive, default=5.0, metavar="HZ", help="of the camera; drawing may be slower (default: 5)"
    )
    soak.add_argument(
        "--out", type=Path, default=Path("out"), metavar="DIR", help="for figures and logs (default: out)"
    )
    soak.add_argument("--json", action="store_true", help="print the report as JSON")
    soak.set_defaults(run=_soak)
    faults = kinds.add_parser(
        "faults",
        help="what happens when the camera, the disk, the bus, the clock or the daemon itself fails",
        description="Makes faults one after another in one flight and tells what happened: whether fixes went on, how "
        "long until they came back, whether any was wrong. Exit code 1 if one went otherwise than it must. A small "
        "disk is mounted, which root may; the clock is stepped for the daemon alone where libfaketime is installed "
        "(pip install libfaketime); what can't be had is said.",
    )
    faults.add_argument("names", nargs="*", metavar="FAULT", help="of these alone (default: all; --list shows them)")
    faults.add_argument("--list", action="store_true", help="print their names, and end")
    faults.add_argument("--out", type=Path, default=Path("out"), metavar="DIR", help="for the logs (default: out)")
    faults.add_argument("--json", action="store_true", help="print one JSON object per fault instead of the table")
    faults.set_defaults(run=_faults)
    jitter = kinds.add_parser(
        "jitter",
        help="what flight log, bus and ground page cost the frame path, or the search of the map",
        description="Rounds with flight log (all frames), bus and page with a listener each, and telemetry, against "
        "rounds with none of them: the time from a frame's stamp until its fix is at the simulated autopilot.",
    )
    jitter.add_argument("--search", action="store_true", help="with a search that does not end, against none")
    jitter.add_argument("--rounds", type=positive_int, default=10, metavar="N", help="(default: %(default)s)")
    jitter.add_argument(
        "--frames", type=positive_int, default=150, metavar="N", help="of each, at 10 Hz (default: %(default)s)"
    )
    jitter.add_argument("--out", type=Path, default=Path("out"), metavar="DIR", help="for its files (default: out)")
    jitter.add_argument("--json", action="store_true", help="print the figures as JSON")
    jitter.set_defaults(run=_jitter)


def _soak(args: argparse.Namespace) -> int:
    # Not at the top: every other command works without the simulation.
    from ortholoc_sim.soak import soak

    writable_folder(args.out, "--out")
    with tqdm(total=round(args.hours * 3600.0), desc="soak", unit="s", leave=False) as bar:

        def show(moment: Moment) -> None:
            bar.update(round(moment.t_s) - bar.n)

        report = soak(args.out, args.hours, args.rate, show)
    text = msgspec.json.encode(report).decode()
    try:
        (args.out / "soak.json").write_text(json.dumps(json.loads(text), indent=2) + "\n", encoding="utf-8")
    except OSError as error:
        raise OrtholocError(f"{args.out}: can't write soak.json ({error})") from error
    print(text if args.json else _soak_table(report))
    return 1 if report.problems else 0


def _faults(args: argparse.Namespace) -> int:
    from ortholoc_sim.service_faults import FAULTS, Row, run

    known = [fault.name for fault in FAULTS]
    if args.list:
        print("\n".join(known))
        return 0
    for name in args.names:
        if name not in known:
            raise ConfigError(f"no fault {name!r}; there are: {', '.join(known)}")
    writable_folder(args.out, "--out")
    if not args.json:
        print(f"{provenance()}, load {os.getloadavg()[0]:.1f} when it began\n")
        print_heading("| fault | what was done | what happened | as it must be |")

    def show(row: Row) -> None:
        verdict = {True: "yes", False: "NO", None: "-"}[row.passed]
        line = f"| {row.fault} | {row.done} | {row.happened} | {verdict} |"
        print(msgspec.json.encode(row).decode() if args.json else line, flush=True)

    rows = run(args.out / "rig", args.names, show)
    return 1 if any(row.passed is False for row in rows) else 0


def _jitter(args: argparse.Namespace) -> int:
    from ortholoc_sim.jitter import measure

    if args.frames < _LEAST_FRAMES:
        raise ConfigError(f"--frames {args.frames}: at least {_LEAST_FRAMES}, of which the first are left out")
    writable_folder(args.out, "--out")
    load = os.getloadavg()[0]
    with tqdm(total=args.rounds, desc="rounds", leave=False) as bar:
        found = measure(args.out, args.rounds, args.frames, lambda done: bar.update(done - bar.n), search=args.search)
    if args.json:
        print(msgspec.json.encode(found).decode())
        return 0
    print(f"{provenance()}, load {load:.1f} when it began\n")
    print_heading("| | median ms | p95 ms | p99 ms | max ms | frames without a fix |")
    for name, spread, p95, lost in (
        ("off", found.off, found.off_p95, found.lost[0]), ("on", found.on, found.on_p95, found.lost[1]),
    ):  # fmt: skip
        assert spread.median is not None and spread.p99 is not None and spread.max is not None
        print(f"| {name} | {spread.median:.1f} | {p95:.1f} | {spread.p99:.1f} | {spread.max:.1f} | {lost} |")
    print(
        f"\nOn over off: median {found.median_ratio:.3f}, p99 {found.p99_ratio:.3f}; p99 of each round by itself "
        f"{', '.join(f'{ratio:.2f}' for ratio in sorted(found.round_p99_ratios))}."
    )
    return 0


def _soak_table(report: SoakReport) -> str:
    def spread(found: Spread) -> str:
        if found.median is None or found.p99 is None or found.max is None:
            return "none"
        return f"{found.median:.2f} / {found.p99:.2f} / {found.max:.2f}"

    rows = [
        ("flown, h, camera Hz", f"{report.hours:g}, {report.rate_hz:g}"),
        ("fixes, rejected frames", f"{report.fixes}, {report.rejected}"),
        ("fix error, median / p99 / max m", spread(report.fix_error_m)),
        ("autopilot off, median / p99 / max m", spread(report.autopilot_error_m)),
        ("CPU, % of a core", f"{report.cpu_percent:.0f}"),
        (
            "memory, first / last / most MiB",
            f"{report.rss_first_mib:.1f} / {report.rss_last_mib:.1f} / {report.rss_max_mib:.1f}",
        ),
        ("growth, and slope in MiB per h", f"{report.rss_growth:+.1%}, {report.rss_slope_mib_per_h:+.2f}"),
        ("threads, first / last", f"{report.threads_first:g} / {report.threads_last:g}"),
        ("descriptors, first / last", f"{report.descriptors_first:g} / {report.descriptors_last:g}"),
        ("longest pause of the watchdog, s", f"{report.longest_pause_s:.2f} of {report.watchdog_s:g}"),
        ("restarts, exit code", f"{report.restarts}, {report.exit_code}"),
        (
            "logs left, steps in them, damaged",
            f"{report.logs} ({report.log_mib:.1f} MiB), {report.log_steps}, {report.log_damaged}",
        ),
        ("result", "passed" if not report.problems else "FAILED: " + "; ".join(report.problems)),
    ]
    return "\n".join([f"{provenance()}\n", "| | |", "|---|---|", *(f"| {name} | {value} |" for name, value in rows)])
