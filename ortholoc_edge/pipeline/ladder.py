"""Less detail when frames take too long, more when there is room again."""

from __future__ import annotations

import logging
from collections import deque
from statistics import median

logger = logging.getLogger(__name__)

# Frames whose median decides for a step down, and of which all but some must leave room for a step up: a search now
# and then must not keep detail out. Slow to rise: a processor that was throttled for heat heats up again.
_FRAMES_DOWN, _FRAMES_UP, _WITHOUT_ROOM = 5, 50, 5
# Of the budget, what these frames may take at most before the next one up is tried, which takes up to 1.6 times
# as long (docs/studies/structural.md).
_ROOM = 0.55


class Ladder:
    """Which rung, 0 the one of full detail, keeps frames within a budget. Used by one thread.

    Args:
        rungs: how many there are.
        budget_ms: wall time that a frame may take; None: any, and the rung stays 0.
    """

    def __init__(self, rungs: int, budget_ms: float | None) -> None:
        self._last, self._budget_ms = rungs - 1, budget_ms
        self._took_ms: deque[float] = deque(maxlen=_FRAMES_UP)
        self._rung = 0

    @property
    def rung(self) -> int:
        return self._rung

    @property
    def rungs(self) -> int:
        """How many there are."""
        return self._last + 1

    def allow(self, budget_ms: float) -> None:
        """Another budget from now on. One that has none, since a replay must be the same everywhere, gets none."""
        if self._budget_ms is not None:
            self._budget_ms = budget_ms

    def note(self, took_ms: float) -> None:
        """A frame on the present rung took so long."""
        if self._budget_ms is None:
            return
        self._took_ms.append(took_ms)
        recent = list(self._took_ms)
        if self._rung < self._last and len(recent) >= _FRAMES_DOWN:
            middle_ms = median(recent[-_FRAMES_DOWN:])
            if middle_ms > self._budget_ms:
                self._step(1, f"frames take {middle_ms:.0f} ms, {self._budget_ms:.0f} are allowed")
                return
        if self._rung > 0 and len(recent) == _FRAMES_UP:
            most_ms = sorted(recent)[-1 - _WITHOUT_ROOM]
            if most_ms < _ROOM * self._budget_ms:
                self._step(-1, f"nine of ten frames took {most_ms:.0f} ms at most")

    def _step(self, change: int, why: str) -> None:
        self._rung += change
        # What the other rung took says nothing about this one.
        self._took_ms.clear()
        logger.warning("%s detail, rung %d of %d: %s", "less" if change > 0 else "more", self._rung, self._last, why)
