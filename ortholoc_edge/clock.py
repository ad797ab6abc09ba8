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


def unix_ns() -> int:
    """Nanoseconds of the wall clock since 1970, which may be unset or stepped: for names, logs and MAVLink's signing,
    whose stamps are of the date. Never for what is measured or told to a filter."""
    return time.time_ns()


class SystemClock:
    """CLOCK_MONOTONIC: unaffected by NTP or GNSS steps of the wall clock."""

    def now_ns(self) -> int:
        return time.monotonic_ns()


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
