"""What PX4 1.14 to 1.18 does with our frames: our transcription of the contract, sections 2.4 to 2.6.

Written from the contract and from mavlink_receiver, ev_pos_control, aux_global_position_control and ekf2_main as they
are published; not from our encoders. Literal numbers as in `ardupilot.py`. Simplified: one instance, heading aligned,
no fusion of vision's yaw.
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
MAV_FRAME_LOCAL_NED, MAV_FRAME_LOCAL_ENU, MAV_FRAME_LOCAL_FRD, MAV_FRAME_LOCAL_FLU = 1, 4, 20, 21
ESTIMATOR_UNKNOWN, ESTIMATOR_NAIVE, ESTIMATOR_VISION, ESTIMATOR_VIO = 0, 1, 2, 3
FLT_EPSILON = 1.1920929e-07
RADIUS_M = 6371000.0
# A sample is taken from its buffer when the delayed horizon has passed it by less than this.
LATE_US = 100_000


def reproject(origin: tuple[float, float], north_m: float, east_m: float) -> tuple[float, float]:
    """MapProjection::reproject: azimuthal equidistant on a sphere, degrees."""
    x, y = north_m / RADIUS_M, east_m / RADIUS_M
    c = math.hypot(x, y)
    if c == 0.0:
        return origin
    latitude, longitude = (math.radians(v) for v in origin)
    sine = math.cos(c) * math.sin(latitude) + x * math.sin(c) * math.cos(latitude) / c
    turn = math.atan2(y * math.sin(c), c * math.cos(latitude) * math.cos(c) - x * math.sin(latitude) * math.sin(c))
    return math.degrees(math.asin(sine)), math.degrees(longitude + turn)


@dataclass
class Px4:
    """A firmware that receives frames on one link.

    Parameters bear their own names. ``origin``: of the local frame, degrees. ``offset_us``: autopilot's clock minus
    ours once TIMESYNC has converged; None before. ``gnss``: whether GNSS is being fused.
    """

    version: Version
    origin: tuple[float, float] = (0.0, 0.0)
    system_id: int = 1
    offset_us: int | None = None
    ekf2_ev_ctrl: int = 1
    ekf2_ev_delay_ms: float = 0.0
    ekf2_evp_noise: float = 0.1
    ekf2_eva_noise: float = 0.1
    ekf2_ev_qmin: int = 0
    ekf2_gps_p_noise: float = 0.5
    ekf2_agp0_id: int = 1
    ekf2_agp0_ctrl: int = 1
    ekf2_agp0_delay_ms: float = 0.0
    ekf2_agp0_noise: float = 1.0
    ekf2_delay_max_ms: float = 200.0
    gnss: bool = False
    dead_reckoning: bool = True
    _reset_counter: int | None = None
    _parser: Any = field(default_factory=lambda: ardupilotmega.MAVLink(None, 0, 0))

    def receive(self, data: bytes, local_us: int) -> Used | Dropped:
        """One frame that arrives at ``local_us`` since boot."""
        (m,) = self._parser.parse_buffer(data)
        kind = m.get_msgId()
        if kind == ODOMETRY:
            return self._odometry(m, local_us)
        if kind == VISION_POSITION_ESTIMATE:
            return self._vision(
                m.usec, local_us, MAV_FRAME_LOCAL_NED, (m.x, m.y), m.covariance, m.yaw, m.reset_counter, 0, False
            )
        if kind == GLOBAL_POSITION_SENSOR and self.version >= (1, 18, 0):
            return self._aux_global_position(m, local_us)
        if kind == COMMAND_INT and m.command == EXTERNAL_POSITION_ESTIMATE and self.version >= (1, 15, 0):
            return self._external_position(m, local_us)
        return Dropped("no handler")

    def _sync_us(self, stamp_us: int, local_us: int) -> int:
        return local_us if self.offset_us is None else stamp_us + self.offset_us

    def _odometry(self, m: Any, local_us: int) -> Used | Dropped:
        if m.estimator_type not in (ESTIMATOR_UNKNOWN, ESTIMATOR_NAIVE, ESTIMATOR_VISION, ESTIMATOR_VIO):
            return Dropped(f"estimator type {m.estimator_type}")
        w, x, y, z = m.q
        yaw = math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
        velocity = all(math.isfinite(v) for v in (m.vx, m.vy, m.vz))
        covariance = m.pose_covariance if m.estimator_type != ESTIMATOR_NAIVE else [math.nan] * 21
        position = (m.x, m.y) if m.frame_id != MAV_FRAME_LOCAL_ENU else (m.y, m.x)
        return self._vision(
            m.time_usec, local_us, m.frame_id, position, covariance, yaw, m.reset_counter, m.quality, velocity
        )

    def _vision(
        self,
        stamp_us: int,
        local_us: int,
        frame: int,
        position: tuple[float, float],
        c: list[float],
        yaw: float,
        reset_counter: int,
        quality: int,
        velocity: bool,
    ) -> Used | Dropped:
        capture_us = round(self._sync_us(stamp_us, local_us) - self.ekf2_ev_delay_ms * 1000)
        if not self.ekf2_ev_ctrl & 1:
            return Dropped("EKF2_EV_CTRL lacks bit 0")
        if frame not in (MAV_FRAME_LOCAL_NED, MAV_FRAME_LOCAL_ENU) or not all(math.isfinite(v) for v in position):
            # FRD and FLU are turned by the difference of headings: no absolute position.
            return Dropped(f"frame {frame}")
        if quality < self.ekf2_ev_qmin:
            return Dropped(f"quality {quality} is below EKF2_EV_QMIN")
        if local_us - capture_us > self.ekf2_delay_max_ms * 1000 + LATE_US:
            return Dropped("older than EKF2_DELAY_MAX")
        floor = max(self.ekf2_evp_noise**2, 0.01**2, self.ekf2_gps_p_noise**2 if self.gnss else 0.0)
        north, east = (math.sqrt(max(v, floor)) for v in (c[0], c[6]))
        resets = self._reset_counter is not None and reset_counter != self._reset_counter
        self._reset_counter = reset_counter
        latitude, longitude = reproject(self.origin, *position)
        has_yaw = math.isfinite(yaw)
        yaw_sigma = math.sqrt(max(c[20], self.ekf2_eva_noise**2, 0.01**2)) if has_yaw else None
        return Used(
            "north, east of the EKF origin" + (" less a bias" if self.gnss else ""),
            latitude,
            longitude,
            north,
            east,
            yaw if has_yaw else None,
            yaw_sigma,
            capture_us,
            resets,
            velocity,
        )

    def _aux_global_position(self, m: Any, local_us: int) -> Used | Dropped:
        # Neither the flags nor time_usec and processing_time are read; the stamp is that of arrival.
        if not m.eph > FLT_EPSILON:
            return Dropped(f"eph {m.eph}")
        if self.ekf2_agp0_id == 0 or m.id != self.ekf2_agp0_id:
            return Dropped(f"EKF2_AGP0_ID is {self.ekf2_agp0_id}")
        if not self.ekf2_agp0_ctrl & 1:
            return Dropped("EKF2_AGP0_CTRL lacks bit 0")
        capture_us = round(local_us - self.ekf2_agp0_delay_ms * 1000)
        if local_us - capture_us > self.ekf2_delay_max_ms * 1000 + LATE_US:
            return Dropped("older than EKF2_DELAY_MAX")
        sigma = max(m.eph, self.ekf2_agp0_noise, 0.01)
        return Used("WGS 84", m.lat * 1e-7, m.lon * 1e-7, sigma, sigma, None, None, capture_us)

    def _external_position(self, m: Any, local_us: int) -> Used | Dropped:
        if m.target_system != self.system_id:
            return Dropped(f"for system {m.target_system}")
        if not self.dead_reckoning:
            return Dropped("not dead reckoning")
        if not (math.isfinite(m.param2) and math.isfinite(m.x) and math.isfinite(m.y)):
            return Dropped("not finite")
        delay_us = round(min(max(m.param2, 0.0), 15.0) * 1e6)
        accuracy_m = m.param3 if math.isfinite(m.param3) and m.param3 > FLT_EPSILON else 50.0
        sigma = max(accuracy_m, 0.01)
        return Used("WGS 84", m.x * 1e-7, m.y * 1e-7, sigma, sigma, None, None, local_us - delay_us, resets=True)
