"""The one place that reads time for stamps, which are integer nanoseconds of a monotonic clock; `pipeline.trace`
only measures durations."""

from __future__ import annotations

import time
from typing import Protocol


class Clock(Protocol):
    """Monotonic time, injected so that replay and tests decide what time it is."""

    def now_ns(self) -> int:
        """Nanoseconds since an arbitrary, fixed epoch; never falls."""
        ...


class SystemClock:
    """CLOCK_MONOTONIC: unaffected by NTP or GNSS steps of the wall clock."""

    def now_ns(self) -> int:
        return time.monotonic_ns()


def wall_clock_ns() -> int:
    """Nanoseconds since 1970, as the system believes. Steps, and is wrong where it was never set: for messages that
    must bear a date, never for stamps."""
    return time.time_ns()


class ManualClock:
    """A clock that the owner sets: recorded stamps in replay, scripted time in tests."""

    def __init__(self, start_ns: int = 0) -> None:
        self._now_ns = start_ns

    def now_ns(self) -> int:
        return self._now_ns

    def set_ns(self, now_ns: int) -> None:
        """Move to ``now_ns``. Raises ValueError if that is in the past."""
        if now_ns < self._now_ns:
            raise ValueError(f"clock can't go back from {self._now_ns} to {now_ns} ns")
        self._now_ns = now_ns
