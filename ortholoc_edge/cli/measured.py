"""What every table of docs/benchmarks.md comes with."""

from __future__ import annotations

import os
import platform
import shlex
import sys
from datetime import date
from pathlib import Path


def table_head(columns: str) -> None:
    """Print command, date and machine, and a table's heading."""
    print(f"{provenance()}\n")
    print_heading(columns)


def provenance() -> str:
    """Command, date and machine."""
    command = shlex.join(["ortholoc-edge", *sys.argv[1:]])
    machine = f"{os.cpu_count()} CPUs {_processor()}, {platform.system()}, Python {platform.python_version()}"
    return f"`{command}`, {date.today().isoformat()}, {machine}"


def print_heading(columns: str) -> None:
    """A Markdown table's heading."""
    print(columns)
    print("|" + "---|" * (columns.count("|") - 1), flush=True)


def _processor() -> str:
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.is_file():
        for line in cpuinfo.read_text().splitlines():
            if line.startswith("model name"):
                return f'"{line.split(":", 1)[1].strip()}"'
    return platform.machine()
