"""How each firmware relates the stamps of a companion to its own clock."""

from __future__ import annotations

import math
from collections import deque

from ortholoc_sim.autopilot.dialect import Message, dialect

_MS, _S = 1_000_000, 1_000_000_000
# Stamps this near to its own time were written by its own clock, as some companions do.
_OWN_CLOCK_NS = 10 * _S


class JitterCorrection:
    """ArduPilot's, one per link (contract 2.6): a stamp plus the least delay seen lately, over a hundred messages."""

    MAX_LAG_NS, LOOPS = 500 * _MS, 100

    def __init__(self) -> None:
        self._offset_ns: int | None = None
        self._least_ns = 0
        self._count = 0

    def correct_ns(self, stamp_ns: int, arrival_ns: int) -> int:
        """Boot time of a stamp."""
        lag = arrival_ns - stamp_ns
        if self._offset_ns is None or lag < self._offset_ns:
            self._offset_ns = lag
        estimate = stamp_ns + self._offset_ns
        if estimate < arrival_ns - self.MAX_LAG_NS:
            estimate = arrival_ns - self.MAX_LAG_NS
            self._offset_ns = estimate - stamp_ns
        self._least_ns = lag if self._count == 0 else min(self._least_ns, lag)
        self._count += 1
        if self._count == self.LOOPS:
            self._offset_ns, self._count = self._least_ns, 0
        return estimate


class _Questions:
    """TIMESYNC requests that are open."""

    def __init__(self) -> None:
        self._asked: deque[int] = deque(maxlen=16)

    def ask(self, boot_ns: int) -> Message:
        self._asked.append(boot_ns)
        return dialect.MAVLink_timesync_message(tc1=0, ts1=boot_ns)

    def is_ours(self, message: Message) -> bool:
        return message.ts1 in self._asked


class LeastRoundTrip:
    """The offset of the shortest of the last round trips: better than either firmware, for judging fixes alone."""

    def __init__(self) -> None:
        self._questions = _Questions()
        self._samples: deque[tuple[int, int]] = deque(maxlen=20)

    @property
    def synchronised(self) -> bool:
        return bool(self._samples)

    def ask(self, boot_ns: int) -> Message:
        return self._questions.ask(boot_ns)

    def answered(self, message: Message, boot_ns: int) -> None:
        if self._questions.is_ours(message):
            self._samples.append((boot_ns - message.ts1, message.tc1 - (message.ts1 + boot_ns) // 2))

    def correct_ns(self, stamp_ns: int, arrival_ns: int) -> int:
        """Boot time of a stamp; that of arrival while nothing is known."""
        if abs(stamp_ns - arrival_ns) < _OWN_CLOCK_NS:
            return min(stamp_ns, arrival_ns)
        if not self._samples:
            return arrival_ns
        return min(stamp_ns - min(self._samples)[1], arrival_ns)


class Px4Timesync:
    """PX4's `Timesync`: a double exponential filter that counts only after ``window`` good round trips (500)."""

    MAX_ROUND_TRIP_NS, MAX_DEVIATION_NS, MAX_DEVIATIONS = 10 * _MS, 100 * _MS, 5
    _FIRST_GAIN, _LAST_GAIN = 0.05, 0.003

    def __init__(self, window: int) -> None:
        self._window = max(1, window)
        self._questions = _Questions()
        self._restart()

    def _restart(self) -> None:
        self._count = self._deviations = 0
        # The offset is the whole number that was heard first, plus a small part that is filtered.
        self._base_ns = 0
        self._part_ns = self._skew_ns = 0.0

    @property
    def synchronised(self) -> bool:
        return self._count >= self._window

    def ask(self, boot_ns: int) -> Message:
        return self._questions.ask(boot_ns)

    def answered(self, message: Message, boot_ns: int) -> None:
        if message.tc1 <= 0 or not self._questions.is_ours(message):
            return
        offset_ns = (message.ts1 + boot_ns - 2 * message.tc1) // 2
        if not 0 <= boot_ns - message.ts1 < self.MAX_ROUND_TRIP_NS:
            return
        if self.synchronised and abs(offset_ns - self._base_ns - self._part_ns) > self.MAX_DEVIATION_NS:
            self._deviations += 1
            if self._deviations > self.MAX_DEVIATIONS:
                self._restart()
            return
        gain = self._gain()
        if self._count == 0:
            self._base_ns = offset_ns
        else:
            before = self._part_ns
            self._part_ns = gain * (offset_ns - self._base_ns) + (1.0 - gain) * (before + self._skew_ns)
            self._skew_ns = gain * (self._part_ns - before) + (1.0 - gain) * self._skew_ns
        self._count += 1
        self._deviations = 0

    def _gain(self) -> float:
        if self.synchronised:
            return self._LAST_GAIN
        p = 1.0 - math.exp(0.5 * (1.0 - 1.0 / (1.0 - self._count / self._window)))
        return p * self._LAST_GAIN + (1.0 - p) * self._FIRST_GAIN

    def correct_ns(self, stamp_ns: int, arrival_ns: int) -> int:
        """Boot time of a stamp; that of arrival until synchronised."""
        return stamp_ns + self._base_ns + round(self._part_ns) if self.synchronised else arrival_ns


Timesync = LeastRoundTrip | Px4Timesync
