"""Whether the stamps of the autopilot's messages still are of the clock that TIMESYNC relates to ours; pure."""

from __future__ import annotations

from collections import deque
from enum import Enum, auto

from ortholoc_edge.adapters.mavlink.timesync import TimeSync

_MS, _S = 1_000_000, 1_000_000_000

# A message can't come before it was stamped. What is allowed beyond TIMESYNC's own uncertainty is for stamps of whole
# milliseconds and for filters that stamp for the end of their step.
_AHEAD_NS = 20 * _MS
# Within one kind of message stamps rise; datagrams that overtake each other are apart by less.
_BACK_NS = 50 * _MS
# What a message may be later than any of the last seconds without a doubt: hosts pause and lines stall.
_LATE_NS = 250 * _MS
# And to end a doubt: no later than usual, but for the jitter of one message.
_USUAL_NS = 20 * _MS
_REMEMBERED_NS = 10 * _S


class Stamp(Enum):
    """What a stamp is good for."""

    GOOD = auto()
    UNCONFIRMED = auto()  # perhaps of a clock that was put back, perhaps of a message that was held up
    FALSE = auto()  # of no clock that we know of


class ClockWatch:
    """Judges each stamp by when its message came.

    Jitter and bursts only ever make messages late, and their stamps stay true. So one from the future, or from before
    the last of its kind, means another clock, and one that is much later than usual may: TIMESYNC is asked fast then
    and settles it in some 0.2 s, if it does not settle itself because messages come as they used to again.
    """

    def __init__(self, timesync: TimeSync) -> None:
        self._timesync = timesync
        self._newest: dict[str, int] = {}
        self._delays: deque[tuple[int, int]] = deque()
        self._in_doubt = False

    def forget(self) -> None:
        """The clock is another one, and known to be."""
        self._newest.clear()
        self._delays.clear()
        self._in_doubt = False

    def judge(self, name: str, boot_ns: int, arrival_ns: int) -> Stamp:
        """Of a message of the kind ``name``. Without synchronisation every stamp is good: time goes by arrival."""
        best = self._timesync.best(arrival_ns) if self._timesync.synchronised else None
        if best is None:
            self.forget()
            return Stamp.GOOD
        offset_ns, uncertainty_ns = best
        delay_ns = arrival_ns + offset_ns - boot_ns
        newest_ns = self._newest.get(name)
        if delay_ns < -uncertainty_ns - _AHEAD_NS or (newest_ns is not None and boot_ns < newest_ns - _BACK_NS):
            self._doubt(arrival_ns)
            return Stamp.FALSE
        self._newest[name] = max(boot_ns, newest_ns or boot_ns)
        while self._delays and arrival_ns - self._delays[0][0] > _REMEMBERED_NS:
            self._delays.popleft()
        usual_ns = self._delays[0][1] if self._delays else delay_ns
        if self._in_doubt and (delay_ns <= usual_ns + _USUAL_NS or not self._timesync.hurried):
            self._in_doubt = False
            self._timesync.calm()
        elif delay_ns > usual_ns + _LATE_NS:
            self._doubt(arrival_ns)
        if self._in_doubt:
            return Stamp.UNCONFIRMED
        # Falling from the first to the last, so that the first is the most of the last seconds.
        while self._delays and self._delays[-1][1] <= delay_ns:
            self._delays.pop()
        self._delays.append((arrival_ns, delay_ns))
        return Stamp.GOOD

    def _doubt(self, now_ns: int) -> None:
        self._in_doubt = True
        self._timesync.hurry(now_ns)
