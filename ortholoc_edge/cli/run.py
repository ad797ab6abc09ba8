"""``run``: the daemon."""

from __future__ import annotations

import argparse
import signal
import sys
import threading
from pathlib import Path

from ortholoc_edge.adapters.mavlink.link import SWITCH_INTERVAL_S
from ortholoc_edge.cli.logs import from_a_thread_of_its_own
from ortholoc_edge.config import read_config
from ortholoc_edge.daemon import Daemon


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    parser = subparsers.add_parser(
        "run",
        help="the daemon: camera to autopilot",
        description="Localizes camera frames and sends vision position estimates to the autopilot until SIGTERM or "
        "SIGINT, or the end of a folder or video. config/example.toml explains every key. With [page] enabled "
        "it serves a page for the ground crew, at http://127.0.0.1:8080 if nothing else is said (docs/page.md).",
    )
    parser.add_argument("--config", type=Path, required=True, metavar="FILE", help="TOML")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    sys.setswitchinterval(SWITCH_INTERVAL_S)
    daemon = Daemon(read_config(args.config))
    stop = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: stop.set())
    with from_a_thread_of_its_own():
        daemon.run(stop)
    return 0
