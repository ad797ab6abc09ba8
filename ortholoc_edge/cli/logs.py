"""A log that keeps nobody waiting: who reads it may stop reading, and the link must go on answering."""

from __future__ import annotations

import contextlib
import logging
import queue
from collections.abc import Iterator
from logging.handlers import QueueHandler, QueueListener

_MOST_RECORDS = 1000
# For what waits to be written at the end; a writer that hangs in a full pipe does not come back.
_END_WITHIN_S = 1.0


class _Dropping(QueueHandler):
    """Drops what finds the queue full, and says how many were dropped as soon as there is room."""

    def __init__(self, records: queue.Queue[logging.LogRecord]) -> None:
        super().__init__(records)
        self.dropped = 0

    def enqueue(self, record: logging.LogRecord) -> None:
        try:
            if self.dropped:
                lost = logging.LogRecord(
                    __name__, logging.WARNING, __file__, 0, "%d log lines were lost: who reads the log is too slow",
                    (self.dropped,), None,
                )  # fmt: skip
                self.queue.put_nowait(self.prepare(lost))
                self.dropped = 0
            self.queue.put_nowait(record)
        except queue.Full:
            self.dropped += 1


class _Listener(QueueListener):
    def stop(self) -> None:
        """Write what waits, if that is possible within a second."""
        with contextlib.suppress(queue.Full):
            self.enqueue_sentinel()
        thread, self._thread = self._thread, None
        if thread is not None:
            thread.join(_END_WITHIN_S)


@contextlib.contextmanager
def from_a_thread_of_its_own(root: logging.Logger | None = None) -> Iterator[None]:
    """Within it, a thread of its own writes what is logged; whoever logs never waits for that."""
    root = root or logging.getLogger()
    handlers = list(root.handlers)
    records: queue.Queue[logging.LogRecord] = queue.Queue(_MOST_RECORDS)
    listener = _Listener(records, *handlers, respect_handler_level=True)
    listener.start()
    root.handlers[:] = [_Dropping(records)]
    try:
        yield
    finally:
        root.handlers[:] = handlers
        listener.stop()
