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

    def stamp_ns(self, driver_ns: int, arrival_ns: int, exposure_ns: int | None) -> int | None:
        """Of a frame; None where it is to be left out, because it lay in a queue or its stamp makes no sense. A clock
        that is none of ours is soon given up, which is said.

        Args:
            driver_ns: the driver's stamp; arrival_ns: when it handed the frame over.
            exposure_ns: None where that is not known.
        """
        options = self._options
        by_arrival_ns = arrival_ns - round(options.latency_ms * _MS)
        if options.stamps == "arrival" or not self._judged.believed:
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
