"""What ArduPilot 4.5 to 4.8 does with our frames: our transcription of the contract, sections 2.3, 2.6 and 2.7.

Written from the contract, from pull requests 31738 and 23903, and from AP_GPS_MAV, JitterCorrection and EKF3's
`setLatLng` as they are published; not from our encoders. Numbers of messages and enumerations are literal here, and
`test_oracles_xml.py` checks them against the XML. Simplified: one EKF core, initialised, with VISO_SCALE 1, VISO_ORIENT
0 and VISO_TYPE 1.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega

from .used import Dropped, Used

Version = tuple[int, int, int]

ODOMETRY, VISION_POSITION_ESTIMATE, GLOBAL_POSITION_SENSOR, GPS_INPUT, COMMAND_INT = 331, 102, 296, 232, 75
EXTERNAL_POSITION_ESTIMATE = 43003
MAV_FRAME_LOCAL_FRD, MAV_FRAME_BODY_FRD = 20, 12
GLOBAL_POSITION_UNHEALTHY = 1
IGNORE_ALT, IGNORE_HDOP, IGNORE_VEL_HORIZ, IGNORE_HORIZONTAL_ACCURACY = 1, 2, 8, 64
FIX_3D = 3

EXT_NAV_INTERVAL_MIN_MS = 20
IMU_BUFFER_MS = 250
WEEK_MS = 604_800_000
LATLON_TO_M = 0.011131884502145034
U32 = 2**32


class JitterCorrection:
    """One offset per link: the least difference of arrival and stamp lately; no lag is believed beyond 500 ms."""

    MAX_LAG_US, LOOPS = 500_000, 100

    def __init__(self) -> None:
        self.offset_us: int | None = None
        self.minimum_us = 0
        self.count = 0

    def correct_us(self, stamp_us: int, local_us: int) -> int:
        difference = local_us - stamp_us
        if self.offset_us is None or difference < self.offset_us:
            self.offset_us = difference
        estimate = stamp_us + self.offset_us
        if estimate + self.MAX_LAG_US < local_us:
            estimate = local_us - self.MAX_LAG_US
            self.offset_us = estimate - stamp_us
        self.minimum_us = difference if self.count == 0 else min(self.minimum_us, difference)
        self.count += 1
        if self.count == self.LOOPS:
            self.offset_us = self.minimum_us
            self.count = 0
        return estimate


def constrain(value: float, low: float, high: float) -> float:
    """constrain_float: NaN raises an internal error and becomes the middle of the range."""
    return (low + high) / 2 if math.isnan(value) else min(max(value, low), high)


def offset_place(origin: tuple[int, int], north_m: float, east_m: float) -> tuple[float, float]:
    """Location::offset: degrees of a point so many of its metres from an origin in 1e-7 degrees."""
    dlat = north_m / LATLON_TO_M
    scale = max(math.cos(math.radians((origin[0] + dlat / 2) * 1e-7)), 0.01)
    return (origin[0] + dlat) * 1e-7, (origin[1] + east_m / (LATLON_TO_M * scale)) * 1e-7


@dataclass
class ArduPilot:
    """A firmware that receives frames on one link.

    Parameters bear their own names. ``origin`` is the public EKF origin in 1e-7 degrees. ``gps_accuracy_m``: of a
    connected, healthy GPS. ``gps_type`` is that of the instance ``gps_instance``, from 0; the other is a receiver.
    ``pr_31738``: a build with that pull request. ``dead_reckoning``: no position was fused
    for a second.
    """

    version: Version
    origin: tuple[int, int] = (0, 0)
    viso_type: int = 1
    viso_pos_m_nse: float = 0.2
    viso_yaw_m_nse: float = 0.2
    viso_delay_ms: int = 10
    viso_qual_min: int = 0
    ek3_posne_m_nse: float = 0.5
    gps_type: int = 14
    gps_instance: int = 1
    gps_delay_ms: int = 0
    gps_accuracy_m: float | None = None
    pr_31738: bool = False
    dead_reckoning: bool = True
    internal_errors: int = 0
    jitter: JitterCorrection = field(default_factory=JitterCorrection)
    gps_jitter: JitterCorrection = field(default_factory=JitterCorrection)
    _last_ms: int = -1000
    _reset_counter: int | None = None
    _first_week: int = 0
    _parser: Any = field(default_factory=lambda: ardupilotmega.MAVLink(None, 0, 0))

    def receive(self, data: bytes, local_us: int) -> Used | Dropped:
        """One frame that arrives at ``local_us`` since boot."""
        (m,) = self._parser.parse_buffer(data)
        kind = m.get_msgId()
        if kind == ODOMETRY:
            return self._odometry(m, local_us)
        if kind == VISION_POSITION_ESTIMATE:
            q = (m.roll, m.pitch, m.yaw)
            return self._pose(m.usec, local_us, (m.x, m.y), m.covariance, q[2], m.reset_counter, 0, False)
        if kind == GLOBAL_POSITION_SENSOR:
            return self._global_position_sensor(m, local_us)
        if kind == GPS_INPUT:
            return self._gps_input(m, local_us)
        if kind == COMMAND_INT and m.command == EXTERNAL_POSITION_ESTIMATE:
            return self._external_position(m, local_us)
        return Dropped(f"message {kind} has no handler")

    def _odometry(self, m: Any, local_us: int) -> Used | Dropped:
        if m.frame_id != MAV_FRAME_LOCAL_FRD or m.child_frame_id != MAV_FRAME_BODY_FRD:
            return Dropped(f"frames {m.frame_id}, {m.child_frame_id}")
        w, x, y, z = m.q
        yaw = math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
        velocity = not any(math.isnan(v) for v in (m.vx, m.vy, m.vz))
        return self._pose(
            m.time_usec, local_us, (m.x, m.y), m.pose_covariance, yaw, m.reset_counter, m.quality, velocity
        )

    def _pose(
        self,
        stamp_us: int,
        local_us: int,
        position: tuple[float, float],
        c: list[float],
        yaw: float,
        reset_counter: int,
        quality: int,
        velocity: bool,
    ) -> Used | Dropped:
        time_ms = self.jitter.correct_us(stamp_us, local_us) // 1000
        if self.viso_type == 0:
            return Dropped("VISO_TYPE is 0")
        position_error, angle_error = 0.0, 0.0
        if not math.isnan(c[0]):
            if self.version >= (4, 8, 0):  # pull request 32084
                position_error = _root(c[0] + c[6] + c[11])
                angle_error = _root(c[15] + c[18] + c[20])
            else:
                position_error = (c[0] ** 2 + c[6] ** 2 + c[11] ** 2) ** (1 / 3)
                angle_error = (c[15] ** 2 + c[18] ** 2 + c[20] ** 2) ** (1 / 3)
        self.internal_errors += math.isnan(position_error) + math.isnan(angle_error)
        position_error = constrain(position_error, self.viso_pos_m_nse, 100.0)
        angle_error = constrain(angle_error, self.viso_yaw_m_nse, 1.5)
        if quality < self.viso_qual_min:
            return Dropped(f"quality {quality} is below VISO_QUAL_MIN")
        if any(math.isnan(v) for v in position):
            return Dropped("position is NaN")
        if (time_ms - self._last_ms) % U32 < EXT_NAV_INTERVAL_MIN_MS:
            return Dropped(f"less than {EXT_NAV_INTERVAL_MIN_MS} ms after the one before")
        self._last_ms = time_ms
        resets = self._reset_counter is not None and reset_counter != self._reset_counter
        self._reset_counter = reset_counter
        capture_ms = max(time_ms - self.viso_delay_ms, local_us // 1000 - IMU_BUFFER_MS)
        sigma = constrain(position_error, 0.01, 100.0 if self.version >= (4, 7, 0) else 10.0)  # pull request 29420
        if self.version < (4, 7, 0) and self.gps_accuracy_m is not None:
            sigma = constrain(self.gps_accuracy_m, self.ek3_posne_m_nse, 100.0)  # issue 24020
        latitude, longitude = offset_place(self.origin, *position)
        has_yaw = not math.isnan(yaw)
        return Used(
            "north, east of the EKF origin",
            latitude,
            longitude,
            sigma,
            sigma,
            yaw if has_yaw else None,
            max(angle_error, math.radians(5.0)) if has_yaw else None,
            capture_ms * 1000,
            resets,
            velocity,
        )

    def _global_position_sensor(self, m: Any, local_us: int) -> Used | Dropped:
        if not self.pr_31738:
            return Dropped("no handler")
        if m.flags & GLOBAL_POSITION_UNHEALTHY:
            return Dropped("flagged unhealthy")
        time_ms = self.jitter.correct_us(m.time_usec, local_us) // 1000 - m.processing_time // 1000
        return self._set_lat_lng(m.lat, m.lon, m.eph, time_ms, local_us, resets=False)

    def _external_position(self, m: Any, local_us: int) -> Used | Dropped:
        time_ms = self.jitter.correct_us(int(m.param1 * 1e6), local_us) // 1000
        processing_ms = int(m.param2 * 1e3)
        if time_ms > processing_ms:
            time_ms -= processing_ms
        if not self.dead_reckoning:
            return Dropped("a position was fused within the last second")
        return self._set_lat_lng(m.x, m.y, m.param3, time_ms, local_us, resets=True)

    def _set_lat_lng(
        self, lat: int, lon: int, accuracy_m: float, time_ms: int, local_us: int, resets: bool
    ) -> Used | Dropped:
        now_ms = local_us // 1000
        sigma = max(0.0 if math.isnan(accuracy_m) else accuracy_m, self.ek3_posne_m_nse)
        capture_ms = max(min(time_ms, now_ms), now_ms - 5000)
        return Used("WGS 84", lat * 1e-7, lon * 1e-7, sigma, sigma, None, None, capture_ms * 1000, resets)

    def _gps_input(self, m: Any, local_us: int) -> Used | Dropped:
        if self.gps_type != 14:
            return Dropped("GPSn_TYPE is not 14")
        if m.gps_id != self.gps_instance:
            return Dropped(f"gps_id {m.gps_id} is not this instance")
        if m.fix_type < FIX_3D:
            return Dropped(f"fix type {m.fix_type}")
        accuracy_m = 0.0 if m.ignore_flags & IGNORE_HORIZONTAL_ACCURACY else m.horiz_accuracy
        now_ms = local_us // 1000
        if m.time_week > 0:
            self._first_week = self._first_week or m.time_week
            stamp_ms = (m.time_week - self._first_week) * WEEK_MS + m.time_week_ms
            now_ms = self.gps_jitter.correct_us(stamp_ms * 1000, now_ms * 1000) // 1000
        # A decaying maximum of what came; of one value that is the value.
        sigma = max(min(accuracy_m, 100.0), self.ek3_posne_m_nse)
        capture_us = (now_ms - self.gps_delay_ms) * 1000
        velocity = not m.ignore_flags & IGNORE_VEL_HORIZ
        return Used("WGS 84", m.lat * 1e-7, m.lon * 1e-7, sigma, sigma, None, None, capture_us, velocity=velocity)


def _root(value: float) -> float:
    return math.sqrt(value) if value >= 0 else math.nan
