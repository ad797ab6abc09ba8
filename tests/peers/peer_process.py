"""Other people's programs as processes: where their Python is, and how they are started and ended."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[2]
REQUIREMENTS = Path(__file__).with_name("requirements.txt")
VARIABLE = "ORTHOLOC_EDGE_PEERS_PYTHON"
DEFAULT = ROOT / ".venv-peers" / "bin" / "python"
INSTALL = f"python3 -m venv .venv-peers && .venv-peers/bin/pip install --no-deps -r {REQUIREMENTS.relative_to(ROOT)}"


def pinned() -> dict[str, str]:
    """Versions by package."""
    lines = REQUIREMENTS.read_text(encoding="utf-8").splitlines()
    return dict(line.split("==") for line in lines if "==" in line)


def find_python() -> Path:
    """The Python that has them. Skips the test where there is none; fails it where one is named but is no good."""
    named = os.environ.get(VARIABLE)
    python = Path(named) if named else DEFAULT
    if not named and not python.exists():
        pytest.skip(f"MAVProxy and MAVSDK are not here; {INSTALL}, or name a Python that has them in ${VARIABLE}")
    program = "import importlib.metadata as m, sys; print(*(m.version(name) for name in sys.argv[1:]))"
    try:
        asked = subprocess.run(
            [python, "-c", program, *pinned()], capture_output=True, text=True, check=False, timeout=60
        )
    except OSError as error:
        pytest.fail(f"{python} can't be run: {error}; {INSTALL}")
    if asked.stdout.split() != list(pinned().values()):
        pytest.fail(f"{python} does not have {pinned()}: {asked.stdout}{asked.stderr}; {INSTALL}")
    return python


def free_udp_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as s:
        s.bind(("127.0.0.1", 0))
        return s.getsockname()[1]


class PeerProcess:
    """A program whose lines on stdout are kept; a context manager that ends it."""

    def __init__(self, command: Sequence[str | Path], folder: Path, stderr_to_stdout: bool = True) -> None:
        """Starts it in ``folder``, which is its home, too: nobody's settings are read or written."""
        environment = {
            **{name: value for name, value in os.environ.items() if not name.startswith(("MAVLINK", "PYTHON"))},
            "HOME": str(folder),
            "PYTHONUNBUFFERED": "1",
        }
        self.log = folder / "stderr.txt"
        with self.log.open("wb") as log:
            self._process = subprocess.Popen(
                [str(part) for part in command],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT if stderr_to_stdout else log,
                text=True,
                errors="replace",
                cwd=folder,
                env=environment,
                start_new_session=True,
            )
        self.lines: list[str] = []
        self._reader = threading.Thread(target=self._read, name="peer-reader")
        self._reader.start()

    def __enter__(self) -> PeerProcess:
        return self

    def __exit__(self, *error: object) -> None:
        process = self._process
        assert process.stdin is not None and process.stdout is not None
        # An interactive MAVProxy ends with its stdin, and notices a signal only with the next line.
        with contextlib.suppress(BrokenPipeError):
            process.stdin.close()
        process.terminate()
        try:
            process.wait(5.0)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait(5.0)
        self._reader.join()
        process.stdout.close()

    def tell(self, line: str) -> None:
        """Give it a line on stdin."""
        assert self._process.stdin is not None
        self._process.stdin.write(line + "\n")
        self._process.stdin.flush()

    def wait_for(self, condition: Callable[[], Any], what: str, turn: Callable[[], None] = lambda: None) -> Any:
        """What ``condition`` returns once it is true; ``turn`` is called ten times a second meanwhile."""
        # Long beside the second or two that it takes alone: the machine may be busy.
        deadline = time.monotonic() + 25.0
        while time.monotonic() < deadline:
            turn()
            if value := condition():
                return value
            assert self._process.poll() is None, f"it ended with {self._process.poll()}: {self._tail()}"
            time.sleep(0.1)
        raise AssertionError(f"{what} did not happen in time; it said {self._tail()}")

    def _tail(self) -> str:
        return "\n".join([*self.lines[-30:], self.log.read_text(errors="replace")[-2000:]])

    def _read(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            self.lines.append(line.rstrip("\n"))
