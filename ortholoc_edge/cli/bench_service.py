"""``bench-service``: the daemon as it is installed, for hours and under load; the section in docs/benchmarks.md."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec
from tqdm import tqdm

from ortholoc_edge.bench.metrics import Spread
from ortholoc_edge.cli.arguments import positive, writable_folder
from ortholoc_edge.cli.measured import provenance
from ortholoc_edge.errors import OrtholocError

if TYPE_CHECKING:
    from ortholoc_sim.soak import Moment, SoakReport


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add ``bench-service``."""
    parser = subparsers.add_parser(
        "bench-service",
        help="measure the daemon as a service: hours of flight",
        description="Flies the daemon as it is installed, as a process of its own under a supervisor that keeps the "
        "systemd unit's rules, on a simulated aircraft without GNSS, in real time.",
    )
    kinds = parser.add_subparsers(dest="kind", required=True, metavar="WHAT")
    soak = kinds.add_parser(
        "soak",
        help="whether anything grows: memory, threads, descriptors, pauses of the watchdog, logs",
        description="Flies for hours with flight log, bus and a watched ground page. Exit code 1 if memory grew by "
        "more than 5 %, threads or descriptors rose, the watchdog waited more than half its time, the daemon was "
        "started again, or a log is damaged.",
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
