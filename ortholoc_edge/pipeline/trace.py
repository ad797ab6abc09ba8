"""Where a frame's time went."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager


class Trace:
    """Wall time per stage of one frame, in ms; a stage that runs twice adds up."""

    def __init__(self) -> None:
        self._start = time.perf_counter()
        self._stages_ms: dict[str, float] = {}

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        start = time.perf_counter()
        try:
            yield
        finally:
            spent_ms = (time.perf_counter() - start) * 1e3
            self._stages_ms[name] = self._stages_ms.get(name, 0.0) + spent_ms

    def timings_ms(self) -> dict[str, float]:
        """The stages so far and ``total`` since the start."""
        return {**self._stages_ms, "total": (time.perf_counter() - self._start) * 1e3}
