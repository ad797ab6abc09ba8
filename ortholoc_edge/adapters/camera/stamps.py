"""When a frame was exposed, from what a driver tells of it."""

from __future__ import annotations

import logging
from enum import StrEnum

from ortholoc_edge.adapters.camera.options import CameraOptions

logger = logging.getLogger(__name__)

_MS, _S = 1_000_000, 1_000_000_000
# By the same clock a stamp can't lie ahead; microseconds are cut off, and nothing else.
_AHEAD_NS = 1_000_000
# A frame that lay about for longer is of no use, and a stamp that is older is more likely of another clock.
_OLDEST_NS = 1 * _S
_GIVE_UP_AFTER = 5
# What a stamp by arrival may be off by: 2 m at 20 m/s. On loopback with a busy encoder one frame in twenty comes
# 36 ms later than the median; where frames come farther apart, as over radio, their stamps are not worth a fix.
_MOST_LATE_NS = 100_000_000
# Servers begin with what they have kept, and FFmpeg with what it looked at: until then what is usual is not known.
_SETTLED_NS = 300_000_000
# The camera's clock against ours: quartz is off by 0.0001 at most, 29.97 Hz that are called 30 by 0.001.
_DRIFT = 0.002
# Without a clock of the camera's: a pause of so many periods may have queued frames, and those that then come faster
# than at twice the usual rate were.
_PAUSE_PERIODS, _QUEUED_PERIODS = 3.0, 0.5
# Of the newest interval in the usual one.
_NEWEST = 0.25


class StampOf(StrEnum):
    """The moment that a driver's stamp is of.

    EXPOSURE_START: the first row begins to be exposed. FRAME_START: it begins to be read out, which is when its
    exposure ends. FRAME_END: the last row was read out, or the frame was handed over.
    """

    EXPOSURE_START = "exposure_start"
    FRAME_START = "frame_start"
    FRAME_END = "frame_end"


def mid_exposure_minus_stamp_ns(stamp_of: StampOf, exposure_ns: int, readout_ns: int, rolling: bool) -> int:
    """What makes a driver's stamp the middle of the middle row's exposure.

    Args:
        exposure_ns: of one row; 0 where it is not known.
        readout_ns: from the first row to the last.
        rolling: rows are exposed one after the other, as they are read. Else all at once, and are read then.
    """
    row_ns = readout_ns // 2 if rolling else 0
    if stamp_of is StampOf.EXPOSURE_START:
        return row_ns + exposure_ns // 2
    if stamp_of is StampOf.FRAME_START:
        return row_ns - exposure_ns // 2
    return row_ns - readout_ns - exposure_ns // 2


class DriverStamps:
    """Judges the stamps of one connection to a device.

    Attributes:
        believed: whether they still are. After five in a row that can't be of our clock they are no more: a mixture
            of two kinds of stamps would be worse than either.
    """

    def __init__(self) -> None:
        self.believed = True
        self._last_ns: int | None = None
        self._bad_in_a_row = 0

    def judge(self, driver_ns: int, arrival_ns: int) -> bool:
        """Whether the driver's stamp is one of the clock that ``arrival_ns`` is of: not ahead of it, a second old at
        most, and later than the one before."""
        age_ns = arrival_ns - driver_ns
        good = -_AHEAD_NS <= age_ns <= _OLDEST_NS and (self._last_ns is None or driver_ns > self._last_ns)
        self._last_ns = driver_ns
        self._bad_in_a_row = 0 if good else self._bad_in_a_row + 1
        if self._bad_in_a_row >= _GIVE_UP_AFTER:
            self.believed = False
        return good


class Arrivals:
    """Tells, of one connection, the frames that came at once from those that lay in a queue, whose arrival says nothing
    of their exposure: after a stall of TCP, what was sent meanwhile comes in one go.

    A frame's own time, of whatever clock, must keep pace with arrivals: the smallest difference that there was is how
    late frames are when nothing holds them up. Where frames have no time of their own only the intervals tell, of a
    stall that is over at once.
    """

    def __init__(self) -> None:
        self._first_ns: int | None = None
        self._last_ns = 0
        self._last_own_ns: int | None = None
        self._least_ns: float | None = None
        self._period_ns: float | None = None
        self._paused_ns = 0

    def late_ns(self, own_ns: int | None, arrival_ns: int) -> int | None:
        """By how much a frame came late; None where it came at once. 0 of the first 0.3 s, which can't be told.

        Args:
            own_ns: the frame's time in its stream, by any clock that runs evenly; None without one.
        """
        if self._first_ns is None:
            self._first_ns = self._last_ns = arrival_ns
        interval_ns, self._last_ns = arrival_ns - self._last_ns, arrival_ns
        by_interval_ns = self._by_interval_ns(interval_ns)
        advances = own_ns is not None and (self._last_own_ns is None or own_ns > self._last_own_ns)
        self._last_own_ns = own_ns
        if own_ns is None or not advances:
            self._least_ns = None
            late_ns = by_interval_ns
        else:
            difference_ns = arrival_ns - own_ns
            usual_ns = difference_ns if self._least_ns is None else self._least_ns + _DRIFT * interval_ns
            self._least_ns = min(usual_ns, difference_ns)
            late_ns = round(difference_ns - self._least_ns)
        if arrival_ns - self._first_ns < _SETTLED_NS:
            return 0
        return late_ns if late_ns > _MOST_LATE_NS else None

    def _by_interval_ns(self, interval_ns: int) -> int:
        """By how much at most a frame came late, by the time since the one before."""
        period_ns = self._period_ns
        if not interval_ns or period_ns is None:
            self._period_ns = interval_ns or None
            return 0
        if interval_ns > max(_PAUSE_PERIODS * period_ns, _MOST_LATE_NS):
            self._paused_ns = interval_ns
        elif not self._paused_ns or interval_ns >= _QUEUED_PERIODS * period_ns:
            self._paused_ns = 0
            self._period_ns = (1.0 - _NEWEST) * period_ns + _NEWEST * interval_ns
        return self._paused_ns


class Stamper:
    """Stamps the frames of one connection in the middle of their exposure."""

    def __init__(self, name: str, options: CameraOptions, told: StampOf = StampOf.FRAME_START) -> None:
        """
        Args:
            name: of the camera, for messages.
            told: what its stamps are of, where the options leave that open.
        """
        self._name, self._options = name, options
        self.stamp_of = told if options.stamp_of == "auto" else StampOf(options.stamp_of)
        self._judged = DriverStamps()

    @property
    def believes(self) -> bool:
        """Whether the driver's stamps count, and not arrivals."""
        return self._options.stamps == "driver" and self._judged.believed

    def stamp_ns(self, driver_ns: int, arrival_ns: int, exposure_ns: int | None) -> int | None:
        """Of a frame; None where it is to be left out, because it lay in a queue or its stamp makes no sense. A clock
        that is none of ours is soon given up, which is said.

        Args:
            driver_ns: the driver's stamp; arrival_ns: when it handed the frame over.
            exposure_ns: None where that is not known.
        """
        options = self._options
        by_arrival_ns = arrival_ns - round(options.latency_ms * _MS)
        if not self.believes:
            return by_arrival_ns
        if self._judged.judge(driver_ns, arrival_ns):
            middle_ns = mid_exposure_minus_stamp_ns(
                self.stamp_of, exposure_ns or 0, round(options.readout_ms * _MS), options.shutter == "rolling"
            )
            return driver_ns + middle_ns - round(options.driver_latency_ms * _MS)
        if self._judged.believed:
            return None
        logger.warning(
            "camera %s: its stamps are not of the monotonic clock (the last is %.3f s before its frame arrived); "
            "frames are stamped when they arrive, less [camera] latency_ms = %g",
            self._name, (arrival_ns - driver_ns) / _S, options.latency_ms,
        )  # fmt: skip
        return by_arrival_ns
