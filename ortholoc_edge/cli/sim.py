"""``sim``: simulated flights without GNSS, with the real daemon and real MAVLink; no hardware, no other data."""

from __future__ import annotations

import argparse
import json
import sys
import threading
from pathlib import Path
from typing import TYPE_CHECKING

from tqdm import tqdm

from ortholoc_edge.bench.metrics import Spread
from ortholoc_edge.cli import matcher_options, sim_scenarios
from ortholoc_edge.cli.arguments import non_negative, positive, seed, writable_folder
from ortholoc_edge.errors import ConfigError, OrtholocError
from ortholoc_edge.pipeline.localizer import LocalizerOptions
from ortholoc_edge.tiles.pack import Pack

if TYPE_CHECKING:
    from ortholoc_sim.flight import FlightReport


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    parser = subparsers.add_parser(
        "sim",
        help="fly a simulated minute without GNSS, or scenarios",
        description="Flies a simulated vehicle over a generated world in real time. GNSS is cut off after takeoff; "
        "the real daemon localizes rendered camera frames on the committed demo pack and sends MAVLink over a "
        "loopback UDP socket to a simulated autopilot that steers by it. Exit code 1 if it failed to localize. With "
        "--scenario, flies what a file describes, on simulated time; only --out, --seed and --json go with that.",
    )
    parser.add_argument("--out", type=Path, default=Path("out"), metavar="DIR", help="for the results (default: out)")
    parser.add_argument("--seed", type=seed, default=1, help="of sensor errors, wind and noise (default: %(default)s)")
    parser.add_argument(
        "--duration", type=positive, default=65.0, metavar="S", help="of the flight, at least 30 (default: %(default)s)"
    )
    parser.add_argument(
        "--release",
        choices=("fast-forward", "fixed-latency", "raw"),
        default="fast-forward",
        help="how fixes are sent, as [link] release (default: %(default)s)",
    )
    parser.add_argument(
        "--viso-delay-ms",
        type=non_negative,
        default=10.0,
        metavar="MS",
        help="VISO_DELAY_MS of the autopilot, which has the time of a fix as ArduPilot has it: by the least delay seen "
        "lately, less this; at most 250 (default: %(default)s, the stock value)",
    )
    parser.add_argument(
        "--timesync-stamps",
        action="store_true",
        help="have the autopilot believe a fix's stamp instead, as PX4 does; --viso-delay-ms then counts for nothing",
    )
    parser.add_argument("--json", action="store_true", help="print the summary as JSON")
    sim_scenarios.add_arguments(parser)
    matcher_options.add(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    if args.list_scenarios:
        return sim_scenarios.list_scenarios()
    if args.scenario:
        return sim_scenarios.fly_scenarios(args)
    for option, given in (("--short", args.short), ("--without-fixes", args.without_fixes), ("--seeds", args.seeds > 1),
                          ("--packs", args.packs is not None), ("--flight-log", args.flight_log)):  # fmt: skip
        if given:
            raise ConfigError(f"{option} is of scenarios; name one with --scenario, or leave it out")
    # Not at the top: every other command works without the simulation.
    from ortholoc_sim import demo_pack_path
    from ortholoc_sim.autopilot import AutopilotOptions, FilterOptions
    from ortholoc_sim.flight import FlightOptions, draw_track, run_flight

    if args.duration < 30.0:
        raise ConfigError("a flight of less than 30 s leaves too little after GNSS is lost")
    writable_folder(args.out, "--out")
    # Build the model now, with its progress bar; the daemon then finds it.
    matcher_options.matcher(args)
    options = FlightOptions(
        seed=args.seed,
        duration_s=args.duration,
        localizer=LocalizerOptions(adhop=not args.no_adhop),
        matcher=matcher_options.settings(args),
        release=args.release,
        autopilot=AutopilotOptions(
            filter=FilterOptions(
                stamps="timesync" if args.timesync_stamps else "jitter", viso_delay_ms=args.viso_delay_ms
            )
        ),
    )
    done = threading.Event()
    ticker = threading.Thread(target=_show_time, args=(args.duration, done), daemon=True)
    ticker.start()
    try:
        report = run_flight(options)
    finally:
        done.set()
        ticker.join()
    draw_track(report, Pack.open(demo_pack_path()), args.out / "track.png")
    summary = report.summary()
    try:
        (args.out / "summary.json").write_text(json.dumps(summary, indent=2) + "\n", encoding="utf-8")
    except OSError as err:
        raise OrtholocError(f"{args.out}: can't write summary.json ({err})") from err
    print(json.dumps(summary) if args.json else _table(report, args))
    return 0 if report.passed else 1


def _show_time(duration_s: float, done: threading.Event) -> None:
    """A bar of the seconds flown; making the world takes some before."""
    with tqdm(total=round(duration_s), desc="flight", unit="s", file=sys.stderr, leave=False) as bar:
        # The world is made first, which takes a few seconds that the bar does not know of.
        while not done.wait(1.0):
            bar.update(min(1, bar.total - bar.n))


def _table(report: FlightReport, args: argparse.Namespace) -> str:
    def spread(s: Spread, unit: str) -> str:
        if s.median is None or s.p90 is None or s.max is None:
            return "-"
        return f"median {s.median:.2f}  p90 {s.p90:.2f}  max {s.max:.2f} {unit}"

    end = report.final_dead_reckoning_error_m
    rejected = ", ".join(f"{reason} {count}" for reason, count in report.rejections.items())
    rows = [
        ("flight", f"{report.duration_s:.0f} s, GNSS lost at {report.gnss_lost_s:.0f} s, matcher {args.matcher}"),
        ("frames", f"{report.frames}; after GNSS was lost {report.fixes_after} of {report.frames_after} gave a fix"),
        ("rejected", rejected or "none"),
        ("fix error", spread(report.position_m, "m")),
        ("fix rotation error", spread(report.attitude_deg, "deg")),
        ("latency from exposure", spread(report.latency_ms, "ms")),
        ("autopilot error", spread(report.autopilot_error_m, "m, horizontal, after GNSS was lost")),
        ("dead reckoning alone", "-" if end is None else f"{end:.1f} m off at the end"),
        ("sent as", args.release),
        ("time of a fix", f"{report.autopilot_stamps} (see ortholoc_sim.autopilot.FilterOptions)"),
        ("autopilot's filter", ", ".join(f"{verdict} {count}" for verdict, count in report.vision.items() if count)),
        ("pictures", f"{args.out / 'track.png'}, figures in {args.out / 'summary.json'}"),
        ("result", "localized without GNSS" if report.passed else "FAILED: " + "; ".join(report.problems)),
    ]
    width = max(len(name) for name, _ in rows)
    return "\n".join(f"{name:<{width}}  {value}" for name, value in rows)
