"""``run``: the daemon."""

from __future__ import annotations

import argparse
import faulthandler
import logging
import queue
import signal
import sys
import threading
from pathlib import Path

from ortholoc_edge.adapters.camera import prepare
from ortholoc_edge.adapters.mavlink.link import SWITCH_INTERVAL_S
from ortholoc_edge.cli.logs import from_a_thread_of_its_own
from ortholoc_edge.config import Config, read_config
from ortholoc_edge.daemon import Daemon
from ortholoc_edge.reload import RELOADABLE, Plan, Reloader


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    parser = subparsers.add_parser(
        "run",
        help="the daemon: camera to autopilot",
        description="Localizes camera frames and sends vision position estimates to the autopilot until SIGTERM or "
        "SIGINT, or the end of a folder or video. config/example.toml explains every key. SIGHUP reads the file again: "
        f"{', '.join(RELOADABLE)} take effect at once, other keys are named and need a restart."
        " With [page] enabled it serves a page for the ground crew, at http://127.0.0.1:8080 if nothing else is said "
        "(docs/page.md).",
    )
    parser.add_argument("--config", type=Path, required=True, metavar="FILE", help="TOML")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    sys.setswitchinterval(SWITCH_INTERVAL_S)
    # systemd's watchdog ends a process that hangs by SIGABRT: where each thread was is then in the journal.
    if sys.__stderr__ is not None:
        faulthandler.enable(sys.__stderr__)

    def set_level(config: Config) -> None:
        logging.getLogger().setLevel(logging.DEBUG if args.verbose else config.log.level.upper())

    def take_over(plan: Plan) -> None:
        daemon.take_over(plan)
        set_level(plan.config)

    config = read_config(args.config)
    set_level(config)
    prepare(config.camera)
    daemon = Daemon(config)
    stop = threading.Event()
    reloader = Reloader(config, lambda: read_config(args.config), take_over)
    _obey_signals(stop, reloader)
    with from_a_thread_of_its_own():
        daemon.run(stop, on_ready=lambda: reloader.start(stop))
    return 0


def _obey_signals(stop: threading.Event, reloader: Reloader) -> None:
    """SIGTERM and SIGINT set ``stop``, SIGHUP reads the configuration again.

    By a thread: a handler runs in the main thread, which waits for ``stop`` itself, and would wait for ever for the
    event's lock where it was interrupted holding it. Putting into a `SimpleQueue` takes none.
    """
    caught: queue.SimpleQueue[int] = queue.SimpleQueue()

    def obey() -> None:
        while True:
            if caught.get() == signal.SIGHUP:
                reloader.ask()
            else:
                stop.set()

    threading.Thread(target=obey, name="signals", daemon=True).start()
    for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
        signal.signal(number, lambda number, _: caught.put(number))
