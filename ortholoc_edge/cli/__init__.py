"""The command line. One module per subcommand; only here are log handlers installed."""

from __future__ import annotations

import argparse
import importlib
import logging
import os
import sys
from collections.abc import Sequence

from ortholoc_edge import __version__
from ortholoc_edge.errors import ConfigError, OrtholocError

EXIT_FAILED = 1
EXIT_CONFIG = 78  # EX_CONFIG: systemd's RestartPreventExitStatus, a restart can't mend a typo

# Each in the module of its name.
_COMMANDS = (
    "sim", "run", "doctor", "bus", "check-config", "install-service", "replay", "localize", "locate",
    "calibrate", "calibrate-flight", "calibrate-focal", "convert-calibration", "tiles", "models", "samples", "bench",
    "bench-replay", "bench-core", "bench-link", "bench-bus", "bench-packs", "bench-service", "bench-start", "profile",
)  # fmt: skip


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point of ``ortholoc-edge``. Returns the exit code."""
    # OpenBLAS threads fight the pipeline's own for two cores; nearest-neighbour search took four times the
    # CPU with them (matchers.md). It reads this once, when numpy is first imported.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # ONNX Runtime's wheels tell Microsoft of models and machines, from 1.29 on also those for Linux, unless told not to
    # before they are loaded. A vehicle talks to nobody that its operator did not name.
    os.environ["ORT_DISABLE_TELEMETRY"] = "1"
    given = sys.argv[1:] if argv is None else argv
    # What the others import, for building packs above all, would stay in the daemon's memory: 25 MB.
    command = next((word for word in given if not word.startswith("-")), None)
    args = _parser((command,) if command in _COMMANDS else _COMMANDS).parse_args(given)
    logging.basicConfig(
        stream=sys.stderr,
        level=logging.DEBUG if args.verbose else logging.INFO,
        format="%(levelname)s %(name)s: %(message)s",
    )
    # It repeats as a log line every error that it raises, also those of trying one file format after another.
    logging.getLogger("rasterio").setLevel(logging.DEBUG if args.verbose else logging.ERROR)
    try:
        return int(args.run(args))
    except ConfigError as error:
        print(f"ortholoc-edge: {error}", file=sys.stderr)
        return EXIT_CONFIG
    except OrtholocError as error:
        print(f"ortholoc-edge: {error}", file=sys.stderr)
        return EXIT_FAILED
    except KeyboardInterrupt:
        print("ortholoc-edge: interrupted", file=sys.stderr)
        return 130
    except BrokenPipeError:
        # The reader of our output went away (`| head`); nothing is wrong here.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0


def _parser(commands: Sequence[str] = _COMMANDS) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="ortholoc-edge",
        description="Tells a drone without GNSS where it is, from its camera, an orthophoto and a surface model.",
    )
    parser.add_argument("--version", action="version", version=f"%(prog)s {__version__}")
    parser.add_argument("-v", "--verbose", action="store_true", help="log debugging details to stderr")
    subparsers = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for command in commands:
        # Only after OPENBLAS_NUM_THREADS is set: it imports numpy.
        importlib.import_module(f"{__name__}.{command.replace('-', '_')}").add_parser(subparsers)
    return parser
