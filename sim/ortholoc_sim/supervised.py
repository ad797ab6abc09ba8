"""The daemon as a process of its own under a supervisor that keeps the rules of the systemd unit, where systemd isn't.

It reads the unit's own file: what is started again after how long, how long the watchdog waits, which exit code ends it
for good. Signals, exit codes, the notify socket and /proc are the real ones.
"""

from __future__ import annotations

import logging
import os
import re
import resource
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType

from ortholoc_edge.errors import ConfigError, OrtholocError

logger = logging.getLogger(__name__)

_PAGE_BYTES = resource.getpagesize()
_TICKS_PER_S = os.sysconf("SC_CLK_TCK")
_POLL_S = 0.1


@dataclass(frozen=True, slots=True)
class Rules:
    """Of a unit: times in s. ``for_good``: exit codes after which it is not started again. ``environment``: what it
    sets, but for paths."""

    watchdog_s: float
    restart_s: float
    start_s: float
    stop_s: float
    for_good: frozenset[int]
    environment: Mapping[str, str]

    @classmethod
    def of_unit(cls, text: str) -> Rules:
        """Of the text of a unit. Raises: ConfigError if it lacks one, or restarts for other reasons than these know."""

        def value(key: str) -> str:
            found = re.search(rf"^{key}=(.+)$", text, re.MULTILINE)
            if found is None:
                raise ConfigError(f"the unit has no {key}")
            return found[1]

        if value("Restart") != "on-failure" or value("StartLimitIntervalSec") != "0":
            raise ConfigError("this supervisor knows Restart=on-failure without a limit only")
        codes = value("RestartPreventExitStatus").split()
        pairs = [pair.partition("=") for line in re.findall(r"^Environment=(.+)$", text, re.M) for pair in line.split()]
        return cls(
            float(value("WatchdogSec")), float(value("RestartSec")), float(value("TimeoutStartSec")),
            float(value("TimeoutStopSec")), frozenset(int(code) for code in codes),
            {name: setting for name, _, setting in pairs if "/" not in setting},
        )  # fmt: skip


@dataclass(frozen=True, slots=True)
class Happening:
    """``what``: started, ready, ended, watchdog, late. ``at_s``: time.monotonic()."""

    at_s: float
    what: str
    detail: str = ""


@dataclass(frozen=True, slots=True)
class Vitals:
    """Of a process: memory in MiB, threads, open descriptors, CPU time in s since its start."""

    rss_mib: float
    threads: int
    descriptors: int
    cpu_s: float


def vitals(pid: int) -> Vitals:
    """Raises: OSError if it is gone."""
    folder = Path("/proc") / str(pid)
    resident = int((folder / "statm").read_text(encoding="ascii").split()[1])
    # The name may hold blanks and brackets.
    after_name = (folder / "stat").read_text(encoding="utf-8", errors="replace").rpartition(")")[2].split()
    return Vitals(
        rss_mib=resident * _PAGE_BYTES / 2**20,
        threads=int(after_name[17]),
        descriptors=len(list((folder / "fd").iterdir())),
        cpu_s=(int(after_name[11]) + int(after_name[12])) / _TICKS_PER_S,
    )


class Supervisor:
    """Keeps one program running. A context manager; a thread of its own.

    Attributes:
        happenings: what happened, in order. Appended by the thread; others may read what is there.
        longest_pause_s: between two signs of life to the watchdog, while it was ready.
        status: the last status line.
    """

    def __init__(self, command: Sequence[str], rules: Rules, folder: Path, environment: Mapping[str, str]) -> None:
        """
        Args:
            folder: for the socket and what the program says (``daemon.log``); its path must be short.
            environment: added to ours.
        """
        self._command, self.rules, self._folder = list(command), rules, folder
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        address = folder / "notify"
        address.unlink(missing_ok=True)
        self._socket.bind(str(address))
        self._socket.settimeout(_POLL_S)
        self._environment = {**os.environ, **rules.environment, **environment, "NOTIFY_SOCKET": str(address)}
        self._said = (folder / "daemon.log").open("ab")
        self.happenings: list[Happening] = []
        self.longest_pause_s = 0.0
        self.status = ""
        self._process: subprocess.Popen[bytes] | None = None
        self._is_ready = False
        self._beat_s = 0.0
        self._again_s: float | None = None
        self._kill_s: float | None = None
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="supervisor", daemon=True)

    def __enter__(self) -> Supervisor:
        self._start()
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    @property
    def pid(self) -> int:
        """Of the program's present life. Raises: OrtholocError if it has none."""
        process = self._process
        if process is None or process.poll() is not None:
            raise OrtholocError(f"the daemon does not run: {self.tail()}")
        return process.pid

    @property
    def is_ready(self) -> bool:
        return self._is_ready

    def count(self, what: str) -> int:
        return sum(happening.what == what for happening in list(self.happenings))

    def send(self, number: signal.Signals) -> None:
        """A signal to the program."""
        os.kill(self.pid, number)

    def said(self) -> str:
        """All that the program said in its present life and those before."""
        return (self._folder / "daemon.log").read_text(encoding="utf-8", errors="replace")

    def tail(self, lines: int = 8) -> str:
        """The last of it."""
        return "\n".join(self.said().splitlines()[-lines:])

    def close(self) -> int | None:
        """SIGTERM, and SIGKILL where that is not obeyed in time; the exit code. Idempotent."""
        code = self._end()
        self._socket.close()
        self._said.close()
        return code

    def _end(self) -> int | None:
        self._over.set()
        if self._thread.is_alive():
            self._thread.join()
        process = self._process
        if process is None:
            return None
        if process.poll() is None:
            process.send_signal(signal.SIGCONT)
            process.terminate()
            try:
                process.wait(self.rules.stop_s)
            except subprocess.TimeoutExpired:
                self._note("late", f"not ended {self.rules.stop_s:g} s after SIGTERM")
                process.kill()
                process.wait()
        return process.returncode

    # -- the thread --------------------------------------------------------------------------------------

    def _note(self, what: str, detail: str = "") -> None:
        self.happenings.append(Happening(time.monotonic(), what, detail))

    def _start(self) -> None:
        self._process = subprocess.Popen(
            self._command, env=self._environment, stdin=subprocess.DEVNULL, stdout=self._said, stderr=self._said,
            start_new_session=True,
        )  # fmt: skip
        self._is_ready, self._again_s, self._kill_s = False, None, None
        self._beat_s = time.monotonic()
        self._note("started", str(self._process.pid))

    def _watch(self) -> None:
        while not self._over.is_set():
            self._listen()
            now_s = time.monotonic()
            assert self._process is not None
            code = self._process.poll()
            if self._again_s is not None:
                if now_s >= self._again_s:
                    self._start()
            elif code is not None:
                self._note("ended", _cause(code))
                self._is_ready = False
                # systemd takes these signals for a clean end.
                clean = (0, -signal.SIGHUP, -signal.SIGINT, -signal.SIGTERM, -signal.SIGPIPE)
                if code in clean or code in self.rules.for_good:
                    return
                self._again_s = now_s + self.rules.restart_s
            elif self._kill_s is not None:
                if now_s >= self._kill_s:
                    self._process.kill()
                    self._kill_s = now_s + self.rules.stop_s
            elif now_s - self._beat_s > (self.rules.watchdog_s if self._is_ready else self.rules.start_s):
                self._note("watchdog" if self._is_ready else "late", f"silent for {now_s - self._beat_s:.1f} s")
                self._process.send_signal(signal.SIGABRT)
                self._kill_s = now_s + self.rules.stop_s

    def _listen(self) -> None:
        try:
            text = self._socket.recv(4096).decode(errors="replace")
        except TimeoutError:
            return
        now_s = time.monotonic()
        for line in text.splitlines():
            name, _, value = line.partition("=")
            if name == "READY" and not self._is_ready:
                self._is_ready, self._beat_s = True, now_s
                self._note("ready")
            elif name == "WATCHDOG" and self._is_ready:
                self.longest_pause_s = max(self.longest_pause_s, now_s - self._beat_s)
                self._beat_s = now_s
            elif name == "STATUS":
                self.status = value


def _cause(code: int) -> str:
    return f"exit code {code}" if code >= 0 else signal.Signals(-code).name


def daemon_command(config: Path) -> list[str]:
    """The daemon of this environment."""
    return [sys.executable, "-m", "ortholoc_edge", "run", "--config", str(config)]

