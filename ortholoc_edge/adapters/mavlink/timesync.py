"""The autopilot's clock against ours."""

from __future__ import annotations

from collections import deque

_MS, _S = 1_000_000, 1_000_000_000


class TimeSync:
    """Relates the autopilot's boot time to our clock by TIMESYNC round trips.

    Of the last samples the one with the least uncertainty counts: half its round trip (the answer may have
    been stamped anywhere in it) plus drift since it was taken. Queues only ever lengthen a round trip, so
    this is the usual minimum filter with a way to forget.
    """

    _DRIFT = 50e-6  # of two crystals, relative; a bad pair
    _HURRIED_NS, _FAST_NS, _SLOW_NS = 50 * _MS, 100 * _MS, 1 * _S
    _SAMPLES_FAST = 10
    _SAMPLES_NEEDED = 5
    _MAX_ROUND_TRIP_NS = 1 * _S
    _JUMP_SLACK_NS = 2 * _MS
    _JUMPS_TO_RESET = 3
    _AGREEMENTS_TO_CALM = 2

    def __init__(self) -> None:
        self._samples: deque[tuple[int, int, int]] = deque(maxlen=64)
        self._asked: deque[int] = deque(maxlen=32)
        self._next_ns = 0
        self._disagreeing = self._agreeing = 0
        self._hurried_since_ns: int | None = None
        self.last_round_trip_ns: int | None = None
        self.resets = 0

    def reset(self) -> None:
        """Forget everything; ask fast again."""
        self._samples.clear()
        self._asked.clear()
        self._disagreeing = self._agreeing = 0
        self._hurried_since_ns = None
        self._next_ns = 0

    def hurry(self, now_ns: int) -> None:
        """The autopilot's clock is in doubt: ask fast until the answers agree with those before, or all do not."""
        if self._hurried_since_ns is None:
            self._hurried_since_ns, self._agreeing, self._next_ns = now_ns, 0, 0

    @property
    def hurried(self) -> bool:
        """Whether the doubt is not yet settled."""
        return self._hurried_since_ns is not None

    def calm(self) -> None:
        """The doubt is settled otherwise."""
        self._hurried_since_ns = None

    @property
    def synchronised(self) -> bool:
        return len(self._samples) >= self._SAMPLES_NEEDED

    @property
    def median_round_trip_ns(self) -> int | None:
        """Of the samples kept; None without one."""
        round_trips = sorted(round_trip for _, round_trip, _ in self._samples)
        return round_trips[len(round_trips) // 2] if round_trips else None

    def due(self, now_ns: int) -> int | None:
        """The ts1 of a request to send now, or None."""
        if now_ns < self._next_ns:
            return None
        if self._hurried_since_ns is not None:
            pause_ns = self._HURRIED_NS
        else:
            pause_ns = self._FAST_NS if len(self._samples) < self._SAMPLES_FAST else self._SLOW_NS
        self._next_ns = now_ns + pause_ns
        self._asked.append(now_ns)
        return now_ns

    def answered(self, tc1_ns: int, ts1_ns: int, arrival_ns: int) -> None:
        """An answer came: the autopilot read ``tc1_ns`` between our ``ts1_ns`` and ``arrival_ns``."""
        if ts1_ns not in self._asked:
            return  # an answer to somebody else on the link, or a duplicate
        self._asked.remove(ts1_ns)
        round_trip = arrival_ns - ts1_ns
        if not 0 <= round_trip <= self._MAX_ROUND_TRIP_NS:
            return
        self.last_round_trip_ns = round_trip
        offset = tc1_ns - (ts1_ns + arrival_ns) // 2
        best = self.best(arrival_ns)
        if best is not None and abs(offset - best[0]) > best[1] + round_trip // 2 + self._JUMP_SLACK_NS:
            # One may be a broken stamp. Several in a row: the autopilot's clock is another one than before.
            self._disagreeing += 1
            self._agreeing = 0
            if self._disagreeing < self._JUMPS_TO_RESET:
                self.hurry(arrival_ns)
                return
            self.reset()
            self.resets += 1
        self._disagreeing = 0
        if self._hurried_since_ns is not None and ts1_ns >= self._hurried_since_ns:
            self._agreeing += 1
            if self._agreeing >= self._AGREEMENTS_TO_CALM:
                self.calm()
        self._samples.append((offset, round_trip, arrival_ns))

    def best(self, now_ns: int) -> tuple[int, int] | None:
        """(offset, uncertainty) in ns with ``boot = ours + offset``; None without a sample."""
        if not self._samples:
            return None
        uncertainty, offset = min(
            (round_trip // 2 + int(self._DRIFT * max(0, now_ns - at)), offset)
            for offset, round_trip, at in self._samples
        )
        return offset, uncertainty
