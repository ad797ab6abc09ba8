"""Every outcome as a line of JSON on disk, written by a thread of its own: the frame path never waits for it."""

from __future__ import annotations

import contextlib
import logging
import queue
import threading
from pathlib import Path

import msgspec

from ortholoc_edge.errors import OrtholocError
from ortholoc_edge.pipeline.outcome import Outcome
from ortholoc_edge.pipeline.record import outcome_record

logger = logging.getLogger(__name__)

FILE_NAME = "outcomes.jsonl"
_QUEUE_LENGTH = 256
# Half the limit each, so that what was just rotated away is still there.
_KEPT_FILES = 2
_CLOSE_WAIT_S = 5.0


class Recorder:
    """Appends to ``FOLDER/outcomes.jsonl``; full, it becomes ``outcomes.1.jsonl`` and a new one begins.

    What can't be written (a full disk, a slow card) is dropped and counted: recording must not end a flight.

    Attributes:
        dropped: outcomes not written.
    Raises on construction: OrtholocError if the folder can't be written to.
    """

    def __init__(self, folder: Path, max_mb: int) -> None:
        self._path = folder / FILE_NAME
        self._limit_bytes = max_mb * 2**20 // _KEPT_FILES
        try:
            folder.mkdir(parents=True, exist_ok=True)
            self._file = self._path.open("ab")
        except OSError as err:
            raise OrtholocError(f"{folder}: can't write the log there ({err}); see log.folder") from err
        self.dropped = 0
        self._failing = False
        self._queue: queue.Queue[dict[str, object] | None] = queue.Queue(_QUEUE_LENGTH)
        self._thread = threading.Thread(target=self._run, name="recorder", daemon=True)
        self._thread.start()

    def put(self, name: str | None, outcome: Outcome) -> None:
        """Hand over; returns at once."""
        try:
            self._queue.put_nowait({"name": name, **outcome_record(outcome)})
        except queue.Full:
            self.dropped += 1

    def close(self) -> None:
        """Write what waits and end the thread; a disk that is full or hangs ends neither in an error nor in a wait
        without end."""
        with contextlib.suppress(queue.Full):
            self._queue.put(None, timeout=_CLOSE_WAIT_S)
        self._thread.join(timeout=_CLOSE_WAIT_S)
        if self._thread.is_alive():
            # It holds the file's lock; closing would wait for it.
            logger.warning("%s: the disk hangs; the last outcomes are not written", self._path)
            return
        try:
            # What a full disk did not take is still in the file's buffer.
            self._file.close()
        except OSError as err:
            logger.warning("%s: can't write the last outcomes (%s)", self._path, err)

    def _run(self) -> None:
        while (record := self._queue.get()) is not None:
            try:
                if self._file.closed:
                    # A rotation failed half-way.
                    self._file = self._path.open("ab")
                self._file.write(msgspec.json.encode(record) + b"\n")
                self._file.flush()
                if self._file.tell() >= self._limit_bytes:
                    self._rotate()
                self._failing = False
            except OSError as err:
                self.dropped += 1
                if not self._failing:
                    logger.warning("%s: can't write the log (%s); outcomes are dropped until it works", self._path, err)
                self._failing = True

    def _rotate(self) -> None:
        self._file.close()
        self._path.replace(self._path.with_name("outcomes.1.jsonl"))
        self._file = self._path.open("ab")
