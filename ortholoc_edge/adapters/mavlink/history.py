"""Samples by time, and how to have a value between or beyond them."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable
from typing import Generic, TypeVar

T = TypeVar("T")

_MS, _S = 1_000_000, 1_000_000_000
# Samples farther apart than this are not interpolated between: the shortest turn need not be the true one.
_MAX_GAP_NS = 500 * _MS


class TimeHistory(Generic[T]):
    """Samples of the last seconds, found by the autopilot's boot time or by our time of arrival.

    Both stamps are kept so that synchronisation may come, improve or go without touching what is stored.
    """

    def __init__(self, span_ns: int, capacity: int) -> None:
        self._span_ns, self._capacity = span_ns, capacity
        self._boot: list[int] = []
        self._arrival: list[int] = []
        self._values: list[T] = []

    def __len__(self) -> int:
        return len(self._values)

    def clear(self) -> None:
        self._boot.clear()
        self._arrival.clear()
        self._values.clear()

    def add(self, boot_ns: int, arrival_ns: int, value: T) -> bool:
        """Append; False if the sample is not newer than the last one."""
        if self._boot and boot_ns <= self._boot[-1]:
            return False
        self._boot.append(boot_ns)
        self._arrival.append(arrival_ns)
        self._values.append(value)
        too_old = bisect_right(self._arrival, arrival_ns - self._span_ns)
        drop = max(len(self._values) - self._capacity, too_old)
        # In chunks: deleting at the front moves the rest.
        if drop >= self._capacity // 8:
            del self._boot[:drop], self._arrival[:drop], self._values[:drop]
        return True

    def around(self, time_ns: int, by_boot: bool) -> tuple[tuple[int, T] | None, tuple[int, T] | None]:
        """The samples at or before and after ``time_ns``, each with its stamp."""
        keys = self._boot if by_boot else self._arrival
        i = bisect_right(keys, time_ns)
        before = (keys[i - 1], self._values[i - 1]) if i > 0 else None
        after = (keys[i], self._values[i]) if i < len(keys) else None
        return before, after


def choose(
    around: tuple[tuple[int, T] | None, tuple[int, T] | None],
    time_ns: int,
    max_distance_ns: int,
    together: Callable[[T, T], bool] = lambda a, b: True,
) -> tuple[T, T | None, float] | None:
    """How to obtain a value at ``time_ns``: (a, b, fraction) to interpolate, (a, None, seconds) to
    extrapolate."""
    near = [sample for sample in around if sample is not None]
    if not near:
        return None
    stamp, value = min(near, key=lambda sample: abs(time_ns - sample[0]))
    if abs(time_ns - stamp) > max_distance_ns:
        return None
    if len(near) == 2:
        (t0, a), (t1, b) = near
        if 0 < t1 - t0 <= max(_MAX_GAP_NS, max_distance_ns) and together(a, b):
            return a, b, (time_ns - t0) / (t1 - t0)
    return value, None, (time_ns - stamp) / _S
