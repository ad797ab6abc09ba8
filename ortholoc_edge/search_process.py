"""The search of the whole map in a process of its own: at the lowest priority, so that frames do not wait for it, and
the first to go where memory runs out.

    python -m ortholoc_edge.search_process FD      started by `SearchProcess`; FD: its end of a socket
"""

from __future__ import annotations

import contextlib
import logging
import os
import subprocess
import sys
import threading
import time
from dataclasses import dataclass
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Final

import cv2

from ortholoc_edge.errors import OrtholocError
from ortholoc_edge.geometry.camera import Camera
from ortholoc_edge.matching.types import Structural
from ortholoc_edge.pipeline.finder import Answer, Ask
from ortholoc_edge.pipeline.frame import Frame
from ortholoc_edge.pipeline.localizer import Localizer, LocalizerOptions
from ortholoc_edge.pipeline.locate import Searchers, locate
from ortholoc_edge.pipeline.outcome import Reason, Rejected
from ortholoc_edge.tiles.pack import Pack
from ortholoc_edge.tiles.store import MapStore

logger = logging.getLogger(__name__)

# Of a search with an unknown heading over a large map on a slow computer, many times over.
_PATIENCE_S: Final = 300.0
_POLL_S: Final = 0.5
_END_S: Final = 2.0
# Of 1000, on top of what the daemon has.
_OOM_SCORE: Final = 500
_LEAST_PRIORITY: Final = 19


@dataclass(frozen=True, slots=True)
class SearchSetup:
    """What the process needs to know.

    Attributes:
        camera: of the pictures that it is sent.
        options: of its localizer; precomputed features are of no use to it.
        max_mb: as of `SearchOptions`.
        memory_bytes, cache_bytes: as of `MapStore`.
    """

    pack: Path
    public_key: Path | None
    camera: Camera
    options: LocalizerOptions
    threads: int
    max_mb: int
    memory_bytes: int
    cache_bytes: int = 16 * 2**20


class MapSeeker:
    """Searches in this process; used by one thread."""

    def __init__(self, setup: SearchSetup) -> None:
        """Raises: MapError for a pack that can't be read."""
        self._store = MapStore(
            Pack.open(setup.pack, setup.public_key),
            cache_bytes=setup.cache_bytes,
            memory_bytes=setup.memory_bytes,
            features=False,
        )
        self._localizer = Localizer(setup.camera, self._store, Structural(), setup.options)
        self._searchers = Searchers(self._store, setup.threads, max_mb=setup.max_mb)

    def answer(self, ask: Ask) -> Answer:
        """What the map says."""
        began = time.process_time()
        sighting = ask.sighting
        try:
            searcher = self._searchers.suiting(sighting.camera, sighting.above_ground_m, sighting.height_m)
            frame = Frame(ask.stamp_ns, sighting.grey, "searched")
            found = locate(frame, sighting, searcher, self._localizer, within=ask.within, former=ask.former)
        except OrtholocError as error:
            return _failed(ask, str(error), time.process_time() - began)
        return Answer(found.outcome, found.own, time.process_time() - began)

    def close(self) -> None:
        """Release the map."""
        self._searchers.close()
        self._localizer.close()
        self._store.close()


class SearchProcess:
    """`finder.Seeker` in another process, which is started when it is first asked, and again where it has died."""

    def __init__(self, setup: SearchSetup) -> None:
        self._setup = setup
        self._condition = threading.Condition()
        self._asked: Ask | None = None
        self._answer: Answer | None = None
        self._busy = self._closed = False
        self._child: subprocess.Popen[bytes] | None = None
        self._line: Connection | None = None
        # Pictures are larger than what a socket holds: whoever sends them waits for the other to read.
        self._thread = threading.Thread(target=self._serve, name="search", daemon=True)
        self._thread.start()

    @property
    def pid(self) -> int | None:
        """Of the process; None while there is none."""
        child = self._child
        return None if child is None or child.poll() is not None else child.pid

    @property
    def idle(self) -> bool:
        """See `finder.Seeker`."""
        with self._condition:
            return not self._busy and self._answer is None and not self._closed

    def ask(self, ask: Ask) -> None:
        """See `finder.Seeker`."""
        with self._condition:
            assert not self._busy, "one at a time"
            self._asked, self._busy = ask, True
            self._condition.notify()

    def take(self) -> Answer | None:
        """See `finder.Seeker`."""
        with self._condition:
            answer, self._answer = self._answer, None
            return answer

    def close(self) -> None:
        """End the process, whatever it is at. Idempotent."""
        with self._condition:
            self._closed = True
            self._condition.notify()
        self._thread.join(_END_S + 2.0 * _POLL_S)
        self._end_child()

    def _serve(self) -> None:
        while True:
            with self._condition:
                self._condition.wait_for(lambda: self._closed or self._asked is not None)
                if self._closed:
                    return
                ask, self._asked = self._asked, None
            assert ask is not None
            answer = self._answered(ask)
            with self._condition:
                self._answer, self._busy = answer, False

    def _answered(self, ask: Ask) -> Answer:
        try:
            line = self._started()
            line.send(ask)
            deadline = time.monotonic() + _PATIENCE_S
            while not line.poll(_POLL_S):
                if self._closed:
                    return _failed(ask, "the daemon stops")
                if time.monotonic() > deadline:
                    raise TimeoutError(f"no answer within {_PATIENCE_S:.0f} s")
            answer = line.recv()
            assert isinstance(answer, Answer), "it sends nothing else"
        except Exception as error:  # whatever it is, the thread goes on: killed for memory, say
            code = self._end_child()
            why = f"the search's process ended (exit code {code}: {error or type(error).__name__})"
            logger.warning("%s; it is started again for the next search", why)
            return _failed(ask, why)
        if answer.trouble:
            logger.warning("the map can't be searched: %s", answer.trouble)
        return answer

    def _started(self) -> Connection:
        if self._line is not None and self.pid is not None:
            return self._line
        self._end_child()
        ours, theirs = Pipe()
        with theirs:
            command = [sys.executable, "-m", "ortholoc_edge.search_process", str(theirs.fileno())]
            self._child = subprocess.Popen(command, pass_fds=[theirs.fileno()], stdin=subprocess.DEVNULL)
        self._line = ours
        ours.send(self._setup)
        return ours

    def _end_child(self) -> int | None:
        """Its exit code."""
        child, line = self._child, self._line
        self._child = self._line = None
        if line is not None:
            line.close()
        if child is None:
            return None
        # Nothing is lost with it.
        child.kill()
        with contextlib.suppress(subprocess.TimeoutExpired):
            return child.wait(_END_S)
        return None


def _failed(ask: Ask, why: str, took_s: float = 0.0) -> Answer:
    return Answer(Rejected(ask.stamp_ns, Reason.INTERNAL, why), (), took_s, why)


def _step_back() -> None:
    """Below everything else on this computer; where the system forbids it, it goes on as it is."""
    with contextlib.suppress(OSError):
        os.nice(_LEAST_PRIORITY)
    with contextlib.suppress(OSError, AttributeError):
        # Gives way at once to whatever wakes up, where the least priority alone may finish its slice.
        os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
    with contextlib.suppress(OSError, ValueError):
        path = Path("/proc/self/oom_score_adj")
        path.write_text(str(min(int(path.read_text()) + _OOM_SCORE, 1000)))


def main() -> None:
    """Answer until the other end is gone."""
    _step_back()
    line = Connection(int(sys.argv[1]))
    # Its threads are the searcher's.
    cv2.setNumThreads(1)
    seeker: MapSeeker | None = None
    with contextlib.suppress(EOFError, OSError, KeyboardInterrupt):
        setup = line.recv()
        while True:
            ask = line.recv()
            try:
                seeker = seeker or MapSeeker(setup)
            except OrtholocError as error:
                line.send(_failed(ask, str(error)))
                continue
            line.send(seeker.answer(ask))


if __name__ == "__main__":
    main()
