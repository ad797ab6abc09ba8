"""What both firmwares' position estimators have in common: dead reckoning, records, and how they are spoken to."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections import Counter

import numpy as np

from ortholoc_edge.geometry import rotation
from ortholoc_edge.geometry.arrays import FloatArray
from ortholoc_sim.autopilot.clocks import Timesync
from ortholoc_sim.autopilot.dialect import Message, dialect
from ortholoc_sim.autopilot.frame import LocalFrame
from ortholoc_sim.autopilot.options import AutopilotOptions
from ortholoc_sim.autopilot.parameters import Parameters
from ortholoc_sim.autopilot.position_filter import PositionFilter
from ortholoc_sim.autopilot.records import Verdict, VisionRecord
from ortholoc_sim.autopilot.sensors import GnssSample, Readings
from ortholoc_sim.site import Geopoint
from ortholoc_sim.vehicle import wrapped

_S = 1_000_000_000
# Of the barometer, m, and of gyroscopes without a compass, rad, per root second.
_HEIGHT_NOISE, _HEADING_NOISE = 0.05, 0.003


class _Offset:
    """What is added to a sensor of its own so that it agrees with another source; a filter of one state.

    Attributes:
        value: the offset. moved: by the last correction.
    """

    def __init__(self, noise: float) -> None:
        """Args: of its drift, per root second."""
        self._noise, self._variance = noise**2, 1.0
        self.value = self.moved = 0.0

    def predict(self, dt_s: float) -> None:
        self._variance += self._noise * dt_s

    def correct(self, difference: float, sigma: float) -> None:
        gain = self._variance / (self._variance + sigma**2)
        self.moved = gain * difference
        self.value += self.moved
        self._variance *= 1.0 - gain


class Estimator(ABC):
    """A firmware's filter of horizontal position, and its handlers of all that may correct it.

    Attributes:
        filter: of the site's frame, see `LocalFrame`.
        vision: every measurement from outside, with what became of it.
        counts: of what is worth counting besides.
        timesync: how it has the time of a stamp.
        has_gnss: whether the receiver has a fix.
        velocity_ned_m_s: (3,) as believed. ned_from_body, down_m: likewise.
        heading_offset_rad: what it has added to the compass's heading; the owner gives it to the sensors.
        texts: what it says aloud (MAV_SEVERITY, text); the owner takes them.
    """

    # Names of the messages and numbers of the commands that :meth:`hear` knows.
    MESSAGES: frozenset[str]
    COMMANDS: frozenset[int]

    def __init__(self, options: AutopilotOptions, parameters: Parameters, frame: LocalFrame, timesync: Timesync):
        self.options, self._parameters, self._frame = options, parameters, frame
        self.timesync = timesync
        self.filter = PositionFilter(options.filter.offset_noise, options.filter.drift_noise)
        self.vision: list[VisionRecord] = []
        self.counts: Counter[str] = Counter()
        self.texts: list[tuple[int, str]] = []
        self.velocity_ned_m_s: FloatArray = np.zeros(3)
        self.ned_from_body: FloatArray = np.eye(3)
        self.down_m = 0.0
        self.heading_offset_rad = 0.0
        self._height, self._heading = _Offset(_HEIGHT_NOISE), _Offset(_HEADING_NOISE)
        self._yaw_rate = 0.0
        self._dead_reckoned: FloatArray | None = None
        self.has_gnss = False
        self.last_fused_ns: int | None = None
        # In the air for a while, it is in use; after a restart it has yet to begin.
        self._under_way = frame.origin is not None

    def step(self, readings: Readings, boot_ns: int, dt_s: float) -> None:
        """Go on with the sensors, and fuse what is due."""
        before = readings.velocity_ned_m_s if self._dead_reckoned is None else self._dead_reckoned
        self._dead_reckoned = readings.velocity_ned_m_s
        self.filter.predict(boot_ns, 0.5 * (before + readings.velocity_ned_m_s)[:2] * dt_s, dt_s)
        self.ned_from_body = readings.ned_from_body
        self._yaw_rate = float(readings.rates_rad_s[2])
        self._height.predict(dt_s)
        self._heading.predict(dt_s)
        self.down_m = readings.down_m + self._height.value
        self.has_gnss = readings.has_fix
        if self.last_fused_ns is None and self._under_way:
            self.last_fused_ns = boot_ns
        self._aid(readings.gnss, boot_ns)
        self.down_m = readings.down_m + self._height.value
        self.heading_offset_rad = self._heading.value
        drift = self.filter.drift_m_s
        self.velocity_ned_m_s = readings.velocity_ned_m_s + np.array([drift[0], drift[1], 0.0])

    @abstractmethod
    def _aid(self, gnss: GnssSample | None, boot_ns: int) -> None:
        """Fuse what is due."""

    @abstractmethod
    def hear(self, message: Message, boot_ns: int) -> int | None:
        """Take in one of ``MESSAGES``, or a COMMAND_LONG or COMMAND_INT of ``COMMANDS``, whose MAV_RESULT is
        returned."""

    @abstractmethod
    def set_origin(self, origin: Geopoint, boot_ns: int) -> bool:
        """SET_GPS_GLOBAL_ORIGIN; whether it was obeyed."""

    @abstractmethod
    def vision_health(self, boot_ns: int) -> tuple[bool, bool]:
        """Whether SYS_STATUS shows vision among the sensors, and whether it calls it healthy."""

    @abstractmethod
    def status(self, boot_ns: int) -> Message:
        """EKF_STATUS_REPORT or ESTIMATOR_STATUS."""

    # -- for the handlers --------------------

    def _fused_within(self, boot_ns: int, seconds: float) -> bool:
        return self.last_fused_ns is not None and boot_ns - self.last_fused_ns <= seconds * _S

    def _fuse_height(self, down_m: float, sigma_m: float, age_s: float = 0.0) -> None:
        """Of a source that is set for height instead of the barometer; not gated."""
        if math.isfinite(down_m):
            then = self.down_m - float(self.velocity_ned_m_s[2]) * age_s
            self._height.correct(down_m - then, sigma_m)
            self.down_m += self._height.moved

    def _fuse_heading(self, yaw_rad: float, sigma_rad: float, age_s: float) -> None:
        """Of a source that is set for heading instead of the compass; not gated."""
        if math.isfinite(yaw_rad):
            then = rotation.to_euler(self.ned_from_body)[2] - self._yaw_rate * age_s
            self._heading.correct(wrapped(yaw_rad - then), sigma_rad)

    def _lever_arm(self, *names: str) -> FloatArray:
        """(3,) NED m, from the body's reference point to where the position was measured."""
        arm: FloatArray = self.ned_from_body @ np.array([self._parameters.active(name) for name in names])
        return arm

    def _record(
        self, message: str, arrival_ns: int, position: FloatArray, verdict: Verdict, why: str = "", *,
        capture_ns: int | None = None, sigma_m: float = 0.0, counter: int = 0, innovation_m: float | None = None,
    ) -> None:  # fmt: skip
        capture_ns = arrival_ns if capture_ns is None else capture_ns
        self.counts[f"vision.{verdict}"] += 1
        self.vision.append(
            VisionRecord(arrival_ns, capture_ns, position, sigma_m, counter, verdict, innovation_m, message, why)
        )

    def _place(self, lat_e7: int, lon_e7: int) -> FloatArray:
        """(3,) the filter's position of a place; down is zero."""
        return self._frame.inner(Geopoint(lat_e7 / 1e7, lon_e7 / 1e7, 0.0)) * (1.0, 1.0, 0.0)


def finite(*values: float) -> bool:
    return all(math.isfinite(v) for v in values)


def is_origin(message: Message) -> bool:
    """Whether a SET_GPS_GLOBAL_ORIGIN names a place on Earth."""
    place = (message.latitude, message.longitude)
    return place != (0, 0) and abs(place[0]) <= 900_000_000 and abs(place[1]) <= 1_800_000_000


INFO = dialect.MAV_SEVERITY_INFO
