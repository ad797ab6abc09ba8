"""``bench-bus``: the section about the bus in docs/benchmarks.md, measured."""

from __future__ import annotations

import argparse
import os
import sys
from typing import Any, Final

import msgspec

from ortholoc_edge.adapters.mavlink.link import SWITCH_INTERVAL_S
from ortholoc_edge.bench import bus
from ortholoc_edge.bench.metrics import Spread
from ortholoc_edge.cli.arguments import positive, positive_int
from ortholoc_edge.cli.measured import print_heading, provenance

_FIXES: Final = (
    "| encoding | asked per s | sent per s | bytes | sent | lost | under way, median / p99 / max ms "
    "| publishing holds, median / p99 / max ms |"
)
_COMMANDS: Final = "| commands | unanswered | asked to answered, median / p99 / max ms |"


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add ``bench-bus``."""
    parser = subparsers.add_parser(
        "bench-bus",
        help="measure the bus between two processes: latency and loss",
        description="Publishes fixes over zenoh (TCP on loopback) to a subscriber in a process of its own, at several "
        "rates, as JSON and as MessagePack: how long each is under way, from before it is encoded until it is decoded "
        "there, how many are lost, and how long publishing holds the frame path. Then commands, asked one after "
        "another.",
    )
    parser.add_argument(
        "--seconds", type=positive, default=10.0, metavar="S", help="of each measurement (default: %(default)s)"
    )
    parser.add_argument(
        "--rates", type=positive, nargs="+", default=[10.0, 100.0, 1000.0], metavar="HZ", help="(default: 10 100 1000)"
    )
    parser.add_argument(
        "--commands", type=positive_int, default=200, metavar="N", help="how many are asked (default: %(default)s)"
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object per row instead of the tables")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    # As the daemon's.
    sys.setswitchinterval(SWITCH_INTERVAL_S)
    if not args.json:
        print(f"{provenance()}, load {os.getloadavg()[0]:.1f} when it began\n")
        print_heading(_FIXES)
    for rate_hz in args.rates:
        for encoding in ("json", "msgpack"):
            found = bus.measure(encoding, rate_hz, args.seconds)
            _row(
                args,
                "fixes",
                found,
                f"| {found.encoding} | {found.rate_hz:g} | {found.sent_per_s:.1f} | {found.payload_bytes} | "
                f"{found.sent} | {found.lost} | {_times(found.latency_ms)} | {_times(found.hold_ms)} |",
            )
    commands = bus.measure_commands(args.commands)
    if not args.json:
        print()
        print_heading(_COMMANDS)
    _row(
        args,
        "commands",
        commands,
        f"| {commands.count} | {commands.unanswered} | {_times(commands.round_trip_ms)} |",
    )
    return 0


def _times(spread: Spread) -> str:
    if spread.median is None or spread.p99 is None or spread.max is None:
        return "none"
    return f"{spread.median:.2f} / {spread.p99:.2f} / {spread.max:.1f}"


def _row(args: argparse.Namespace, kind: str, found: Any, line: str) -> None:
    text = msgspec.json.encode({"row": kind, **msgspec.to_builtins(found)}).decode() if args.json else line
    print(text, flush=True)
