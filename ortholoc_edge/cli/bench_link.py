"""``bench-link``: the section about the link to the autopilot in docs/benchmarks.md, measured."""

from __future__ import annotations

import argparse
import itertools
import logging
import os
import sys
import tempfile
from pathlib import Path
from typing import Any, Final

import cv2
import msgspec

from ortholoc_edge.adapters.mavlink.link import SWITCH_INTERVAL_S
from ortholoc_edge.bench import link
from ortholoc_edge.bench.link import Fuzz, Latencies, Soak, Spread
from ortholoc_edge.cli.arguments import positive, positive_int, seed
from ortholoc_edge.cli.measured import print_heading, provenance

_LATENCIES: Final = (
    "| wire | load | release | fix ready to bytes read, median / p99 / max ms "
    "| TIMESYNC question to answer, median / p99 / max ms | estimates / questions | localized per s | peer |"
)
_SOAK: Final = (
    "| wire | minutes | rounds | threads early / late | descriptors early / late | RSS MiB early / late / peak "
    "| longest back after a cut, s |"
)
_FUZZ: Final = (
    "| signing | bytes | s | messages | bad frames | unknown | refused | our errors | heard after | RSS growth MiB |"
)
_LOADS: Final = ("idle", "localizing")


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add ``bench-link``."""
    parser = subparsers.add_parser(
        "bench-link",
        help="measure the link to the autopilot: how fast it is, and whether it lasts",
        description="Over a pseudo-terminal and UDP, against an autopilot in a process of its own: the time from a fix "
        "that is ready to its bytes read at the other end, and from a TIMESYNC question to our answer there, idle and "
        "while threads of this process localize without a pause. With --soak or --fuzz that is done instead.",
    )
    parser.add_argument(
        "--seconds", type=positive, default=30.0, metavar="S", help="of each measurement (default: %(default)s)"
    )
    parser.add_argument("--loads", nargs="+", choices=_LOADS, default=list(_LOADS), help="(default: both)")
    parser.add_argument(
        "--threads", type=positive_int, default=2, metavar="N", help="that localize (default: %(default)s; the daemon "
        "has one)",
    )  # fmt: skip
    parser.add_argument(
        "--pack", type=Path, metavar="DIR", help="area pack that they localize on (default: the demo pack)"
    )
    parser.add_argument(
        "--soak", type=positive, metavar="MINUTES", help="connect and disconnect for so long, half of it over TCP, "
        "half over a pseudo-terminal whose device is exchanged",
    )  # fmt: skip
    parser.add_argument(
        "--fuzz", type=positive_int, metavar="BYTES", help="feed so many random and mutated bytes, without signing and "
        "with it",
    )  # fmt: skip
    parser.add_argument("--seed", type=seed, default=0, help="of all chance (default: %(default)s)")
    parser.add_argument("--json", action="store_true", help="print one JSON object per row instead of the tables")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    # As the daemon's.
    sys.setswitchinterval(SWITCH_INTERVAL_S)
    cv2.setNumThreads(1)
    if not args.json:
        print(f"{provenance()}, load {os.getloadavg()[0]:.1f} when it began\n")
    chatty = logging.getLogger("ortholoc_edge.adapters")
    level = chatty.level
    if not args.verbose:
        # Connections that break are what is tried here, not news.
        chatty.setLevel(logging.ERROR)
    try:
        if args.soak is not None:
            return _soak(args)
        if args.fuzz is not None:
            return _fuzz(args)
        _latencies(args)
        return 0
    finally:
        chatty.setLevel(level)


def _latencies(args: argparse.Namespace) -> None:
    if not args.json:
        print_heading(_LATENCIES)
    kinds: tuple[link.WireKind, ...] = ("pty", "udp")
    if "idle" in args.loads:
        for kind, release in itertools.product(kinds, link.RELEASES):
            _print_latencies(args, link.measure(kind, args.seconds, None, args.seed, release))
    if "localizing" in args.loads:
        with link.LocalizerLoad(args.pack or _demo_pack(), args.threads) as load:
            for kind, release in itertools.product(kinds, link.RELEASES):
                _print_latencies(args, link.measure(kind, args.seconds, load, args.seed, release))


def _demo_pack() -> Path:
    # Not at the top: every other command works without the simulation.
    from ortholoc_sim import demo_pack_path

    return demo_pack_path()


def _print_latencies(args: argparse.Namespace, found: Latencies) -> None:
    peer = "real-time" if found.is_realtime else "normal priority"
    load = found.load if found.load == "idle" else f"{args.threads} threads {found.load}"
    _row(
        args,
        "latencies",
        found,
        f"| {found.wire} | {load} | {found.release} | {_times(found.estimate)} | {_times(found.timesync)} | "
        f"{found.estimate.count} / {found.timesync.count} | {found.load_fps:.1f} | {peer} |",
    )


def _times(spread: Spread) -> str:
    return f"{spread.median_ms:.2f} / {spread.p99_ms:.2f} / {spread.max_ms:.1f}"


def _soak(args: argparse.Namespace) -> int:
    kinds: tuple[link.WireKind, ...] = ("tcp", "pty")
    found = [link.soak(kind, 60.0 * args.soak / len(kinds)) for kind in kinds]
    if not args.json:
        print_heading(_SOAK)
    for one in found:
        _row(args, "soak", one, _soak_row(one))
    return 0 if all(one.holds_nothing_more for one in found) else 1


def _soak_row(s: Soak) -> str:
    return (
        f"| {s.wire} | {s.seconds / 60.0:.1f} | {s.rounds} | {s.early.threads} / {s.late.threads} | "
        f"{s.early.descriptors} / {s.late.descriptors} | {s.early.rss_mib:.1f} / {s.late.rss_mib:.1f} / "
        f"{s.peak_rss_mib:.1f} | {s.longest_back_s:.1f} |"
    )


def _fuzz(args: argparse.Namespace) -> int:
    if not args.json:
        print_heading(_FUZZ)
    is_good = True
    with tempfile.TemporaryDirectory(prefix="ortholoc-fuzz-") as folder:
        key = Path(folder) / "key"
        key.write_bytes(bytes(range(32)))
        key.chmod(0o600)
        signing = {"signing_key": str(key), "signing_state": f"{folder}/stamps", "require_signed": True}
        for name, options in (("no", {}), ("required", signing)):
            found = link.fuzz(args.fuzz, args.seed, options)
            is_good &= found.internal_errors == 0 and found.is_heard_after
            _row(args, "fuzz", found, _fuzz_row(name, found))
    return 0 if is_good else 1


def _fuzz_row(signing: str, f: Fuzz) -> str:
    return (
        f"| {signing} | {f.fed_bytes} | {f.seconds:.1f} | {f.messages} | {f.bad_frames} | {f.unknown_frames} | "
        f"{f.refused_frames} | {f.internal_errors} | {'yes' if f.is_heard_after else '**no**'} | {f.growth_mib:.1f} |"
    )


def _row(args: argparse.Namespace, kind: str, found: Any, line: str) -> None:
    text = msgspec.json.encode({"row": kind, **msgspec.to_builtins(found)}).decode() if args.json else line
    print(text, flush=True)
