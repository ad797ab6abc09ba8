"""A simulated ArduPilot: its sensors, its position filter, and what it says and hears in MAVLink 2.

`AutopilotCore` is a step function: boot time and truth go in, messages come out; it does no I/O and reads no clock.
`UdpPort` carries its messages. What the filter copies from EKF3 is in autopilot-contract.md, 2.3. Simplified:

- Dead reckoning is a velocity with a scale error, a turn and a wandering bias instead of IMU, drag and airspeed. The
  filter estimates an offset and a drift of that dead reckoning per axis, where EKF3 has 24 states.
- With GNSS it uses GNSS, without it vision, as a source-switching script does; real firmware needs that script.
- A measurement is applied at its capture time, known by TIMESYNC, for delays up to 5 s. EKF3 itself takes the
  stamp plus the least delay seen lately, less VISO_DELAY_MS, and no more than 250 ms: ``stamps="jitter"`` does that.
"""

from __future__ import annotations

import math
import os
import socket
from bisect import bisect_right
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any, Literal

import numpy as np

os.environ["MAVLINK20"] = "1"

from pymavlink.dialects.v20 import ardupilotmega as dialect

from ortholoc_edge.geometry import rotation
from ortholoc_edge.geometry.arrays import FloatArray
from ortholoc_sim.site import Site
from ortholoc_sim.vehicle import Truth

# A message of pymavlink's dialect, which carries no types.
Message = Any

_MS = 1_000_000
_S = 1_000_000_000
# MAV_MODE_FLAG: armed, stabilised, guided, own modes. Copter's GUIDED is custom mode 4.
_BASE_MODE, _GUIDED = 217, 4
_EKF_GOOD = 0x01 | 0x02 | 0x04 | 0x08 | 0x10 | 0x20 | 0x200  # attitude, velocities, positions, prediction
_EKF_DEAD_RECKONING = 0x01 | 0x02 | 0x04 | 0x20 | 0x80  # no absolute horizontal position; constant position mode

# Of an ArduPilot that is set up for vision in its second source set, so that the daemon's audit finds nothing wrong.
_PARAMETERS: dict[str, int | float] = {
    "AHRS_EKF_TYPE": 3,
    "EK3_ENABLE": 1,
    "EK3_GLITCH_RAD": 25,
    "EK3_POS_I_GATE": 500,
    **{f"EK3_SRC{n}_POSXY": source for n, source in ((1, 3), (2, 6), (3, 0))},
    **{f"EK3_SRC{n}_VELXY": source for n, source in ((1, 3), (2, 0), (3, 0))},
    **{f"EK3_SRC{n}_VELZ": source for n, source in ((1, 3), (2, 0), (3, 0))},
    **{f"EK3_SRC{n}_{what}": 1 for n in (1, 2, 3) for what in ("POSZ", "YAW")},
    "VISO_TYPE": 1,
    "VISO_DELAY_MS": 100,
    "VISO_ORIENT": 0,
    "VISO_SCALE": 1.0,
    "VISO_POS_X": 0.0,
    "VISO_POS_Y": 0.0,
    "VISO_POS_Z": 0.0,
    "VISO_POS_M_NSE": 0.2,
    "VISO_QUAL_MIN": 0,
}


@dataclass(frozen=True, slots=True)
class SensorOptions:
    """Errors, 1-sigma.

    Attributes:
        tilt_deg, tilt_time_s: of roll and pitch, slowly varying. yaw_bias_deg: constant; yaw_deg varies.
        velocity_scale: of dead reckoning. velocity_turn_deg: of its direction. velocity_walk: m/s per root
            second of its wandering bias.
        acceleration_bias: m/s^2, horizontal, constant, in a random direction. An autopilot without velocity aiding
            integrates accelerometers levelled by its attitude: 0.1 degrees of tilt or 1.8 mg that ten seconds of GNSS
            do not teach it are 0.018 m/s^2, which is 1 m/s and 27 m after 55 s.
        climb_m_s, climb_time_s: of the vertical velocity, slowly varying, as of barometer and accelerometer.
        gnss_m: of a GNSS position, correlated over ``gnss_time_s``.
        baro_walk_m: per root second.
    """

    tilt_deg: float = 0.5
    tilt_time_s: float = 15.0
    yaw_bias_deg: float = 2.0
    yaw_deg: float = 0.4
    velocity_scale: float = 0.02
    velocity_turn_deg: float = 1.0
    velocity_walk: float = 0.03
    acceleration_bias: float = 0.018
    climb_m_s: float = 0.15
    climb_time_s: float = 8.0
    gnss_m: float = 0.6
    gnss_time_s: float = 20.0
    baro_walk_m: float = 0.05


@dataclass(frozen=True, slots=True)
class FilterOptions:
    """Parameters of the position filter, by ArduPilot's names where it has them.

    Attributes:
        pos_m_nse: VISO_POS_M_NSE, the least sigma believed of a vision position, m.
        gate: EK3_POS_I_GATE / 100, sigmas.
        timeout_s: after which a position that keeps being refused is taken. glitch_radius_m: EK3_GLITCH_RAD.
        viso_delay_ms: VISO_DELAY_MS; used with ``stamps="jitter"``.
        quality_min: VISO_QUAL_MIN, per cent; -1 takes all.
        stamps: how a measurement's capture time is had. "timesync", the default, is not what ArduPilot does: it
            answers TIMESYNC but stamps external navigation by the least delay seen lately (contract 2.6), which is
            "jitter". So "timesync" judges the fixes and our protocol, "jitter" what an untuned vehicle would make of
            them. Measured in one flight each, horizontal error of the autopilot after GNSS was lost: timesync 0.52 m
            median, 1.18 m at most; jitter with VISO_DELAY_MS 250 (the most there is) at a latency of 474 ms 2.35 m
            and 3.90 m. Those were with less drift than the default has now.
    """

    pos_m_nse: float = 0.2
    gate: float = 5.0
    timeout_s: float = 7.0
    glitch_radius_m: float = 25.0
    viso_delay_ms: float = 10.0
    quality_min: int = 0
    stamps: Literal["timesync", "jitter"] = "timesync"
    drift_noise: float = 0.06
    offset_noise: float = 0.10


@dataclass(frozen=True, slots=True)
class GimbalOptions:
    """A stabilised gimbal: level in roll, held against the horizon in pitch and against the nose in yaw.

    Attributes:
        pitch_deg: its middle, -90 is straight down. sweep_deg, sweep_s: it nods about that by so much, in such a time.
        yaw_deg: from the nose, clockwise.
        delay_ms: its reports tell where it looked so long before their stamps.
        error_deg: constant, of the roll and the pitch that it reports.
    """

    pitch_deg: float = -50.0
    sweep_deg: float = 10.0
    sweep_s: float = 12.0
    yaw_deg: float = 0.0
    delay_ms: float = 30.0
    error_deg: tuple[float, float] = (0.3, -0.4)

    def ned_from_gimbal(self, ned_from_body: FloatArray, boot_ns: int) -> FloatArray:
        """(3, 3), true, at a boot time."""
        heading_rad = rotation.to_euler(ned_from_body)[2] + math.radians(self.yaw_deg)
        return rotation.from_euler(0.0, self._pitch_rad(boot_ns), heading_rad)

    def report(self, boot_ns: int) -> Message:
        """As ArduPilot sends it: roll and pitch against the horizon, yaw against the nose."""
        roll_deg, pitch_deg = self.error_deg
        pitch_rad = self._pitch_rad(boot_ns - round(self.delay_ms * _MS)) + math.radians(pitch_deg)
        q = rotation.to_quaternion(rotation.from_euler(math.radians(roll_deg), pitch_rad, math.radians(self.yaw_deg)))
        nan = math.nan
        return dialect.MAVLink_gimbal_device_attitude_status_message(
            target_system=0, target_component=0, time_boot_ms=boot_ns // _MS % 2**32,
            flags=dialect.GIMBAL_DEVICE_FLAGS_YAW_IN_VEHICLE_FRAME, q=[float(v) for v in q], angular_velocity_x=nan,
            angular_velocity_y=nan, angular_velocity_z=nan, failure_flags=0, delta_yaw=nan, delta_yaw_velocity=nan,
            gimbal_device_id=1,
        )  # fmt: skip

    def _pitch_rad(self, boot_ns: int) -> float:
        phase = 2.0 * math.pi * (boot_ns / _S / self.sweep_s)
        return math.radians(self.pitch_deg + self.sweep_deg * math.sin(phase))


@dataclass(frozen=True, slots=True)
class AutopilotOptions:
    """Who it is and how it errs. ``firmware`` decides how covariances are read (2.3: since 4.8 another way).
    ``gimbal``: the one that it speaks for, if any."""

    seed: int = 3
    system_id: int = 1
    firmware: tuple[int, int, int] = (4, 8, 0)
    sensors: SensorOptions = field(default_factory=SensorOptions)
    filter: FilterOptions = field(default_factory=FilterOptions)
    # Boot long before the companion's clock began, so that nobody gets by without relating the two.
    boot_offset_ns: int = 86_400 * _S + 123_456_789
    streams_by_default: bool = False
    gimbal: GimbalOptions | None = None


class Verdict(StrEnum):
    """What became of a vision measurement."""

    FUSED = "fused"
    STANDBY = "standby"  # GNSS is the source in use
    GATED = "gated"
    RESET = "reset"  # taken as it is: the reset counter changed
    TIMEOUT_RESET = "timeout_reset"  # taken as it is: refused for too long
    WRONG_FRAME = "wrong_frame"
    FAILED_QUALITY = "failed_quality"
    NOT_FINITE = "not_finite"
    TOO_OLD = "too_old"
    TOO_FAST = "too_fast"


@dataclass(frozen=True, slots=True, eq=False)
class VisionRecord:
    """A vision measurement as it was received: boot times in ns, (3,) NED m, the sigma taken from its covariance,
    its horizontal innovation in m where it was tested."""

    arrival_ns: int
    capture_ns: int
    position_ned_m: FloatArray
    sigma_m: float
    reset_counter: int
    verdict: Verdict
    innovation_m: float | None


def position_sigma_m(covariance: list[float], firmware: tuple[int, int, int]) -> float:
    """The one standard deviation that AP_VisualOdom makes of the 21 floats; 0 where it is told "unknown"."""
    c = [covariance[0], covariance[6], covariance[11]]
    if math.isnan(c[0]):
        return 0.0
    if firmware >= (4, 8, 0):
        total = sum(c)
        return math.sqrt(max(total, 0.0)) if not math.isnan(total) else math.nan
    return float(np.cbrt(sum(v * v for v in c)))


class PositionFilter:
    """Horizontal position: dead reckoning plus an estimated offset, which drifts.

    Per axis the state is (offset m, drift m/s). Both axes have the same covariance, since each measurement has one
    sigma for both. A measurement of the past corrects the offset as it was then.
    """

    def __init__(self, options: FilterOptions) -> None:
        self.options = options
        self.reckoned_m = np.zeros(2)
        self.offset_m = np.zeros(2)
        self.drift_m_s = np.zeros(2)
        self.covariance = np.diag([4.0, 0.04])
        self.test_ratio = 0.0
        self.last_fused_ns: int | None = None
        self._history: deque[tuple[int, FloatArray]] = deque(maxlen=600)

    @property
    def position_m(self) -> FloatArray:
        """(2,) north, east now."""
        return self.reckoned_m + self.offset_m

    def predict(self, now_ns: int, velocity_m_s: FloatArray, dt_s: float) -> None:
        """Go on by a dead-reckoned velocity (2,)."""
        self.reckoned_m = self.reckoned_m + velocity_m_s * dt_s
        self.offset_m = self.offset_m + self.drift_m_s * dt_s
        f = np.array([[1.0, dt_s], [0.0, 1.0]])
        noise = np.diag([self.options.offset_noise**2, self.options.drift_noise**2]) * dt_s
        self.covariance = f @ self.covariance @ f.T + noise
        self._history.append((now_ns, self.reckoned_m))

    def innovation(self, position_m: FloatArray, capture_ns: int, now_ns: int) -> tuple[FloatArray, FloatArray] | None:
        """(difference (2,), row of the measurement (2,)) for a position at ``capture_ns``; None if too old."""
        # The nearest step: half a step at 10 m/s is 5 cm.
        after = bisect_right(self._history, capture_ns, key=lambda entry: entry[0])
        if after == 0:
            return None
        near = [i for i in (after - 1, after) if i < len(self._history)]
        index = min(near, key=lambda i: abs(self._history[i][0] - capture_ns))
        age_s = max(0.0, (now_ns - capture_ns) / _S)
        past = self._history[index][1] + self.offset_m - self.drift_m_s * age_s
        return position_m - past, np.array([1.0, -age_s])

    def fuse(
        self, position_m: FloatArray, sigma_m: float, capture_ns: int, now_ns: int
    ) -> tuple[Verdict, float | None]:
        """Take in a position (2,); says what became of it and the innovation's length."""
        found = self.innovation(position_m, capture_ns, now_ns)
        if found is None:
            return Verdict.TOO_OLD, None
        difference, row = found
        length = float(np.hypot(*difference))
        variance = sigma_m**2 + self.options.offset_noise**2 * float(-row[1])
        total = float(row @ self.covariance @ row) + variance
        # EKF3 sums over both axes: |innovation|^2 against gate^2 (varN + varE).
        self.test_ratio = length**2 / (self.options.gate**2 * 2.0 * total)
        if self.test_ratio > 1.0:
            if self.last_fused_ns is not None and now_ns - self.last_fused_ns > self.options.timeout_s * _S:
                self.reset(difference, (0.5 * self.options.glitch_radius_m) ** 2, now_ns)
                return Verdict.TIMEOUT_RESET, length
            if self.last_fused_ns is None:
                self.last_fused_ns = now_ns
            return Verdict.GATED, length
        gain = self.covariance @ row / total
        self.offset_m = self.offset_m + gain[0] * difference
        self.drift_m_s = self.drift_m_s + gain[1] * difference
        left = np.eye(2) - np.outer(gain, row)
        self.covariance = left @ self.covariance @ left.T + variance * np.outer(gain, gain)
        self.last_fused_ns = now_ns
        return Verdict.FUSED, length

    def reset(self, difference_m: FloatArray, variance_m2: float, now_ns: int) -> None:
        """Move the position by ``difference_m`` (2,) at once (ResetPositionNE)."""
        self.offset_m = self.offset_m + difference_m
        self.covariance = np.diag([variance_m2, max(0.04, float(self.covariance[1, 1]))])
        self.last_fused_ns = now_ns
        self.test_ratio = 0.0


class _Companion:
    """The autopilot's own side of TIMESYNC, and AP_RTC's JitterCorrection for stamps."""

    def __init__(self) -> None:
        self.offset_ns: int | None = None  # companion's clock minus boot time
        self._samples: deque[tuple[int, int]] = deque(maxlen=20)
        self._asked: deque[int] = deque(maxlen=16)
        self._lags: deque[int] = deque(maxlen=100)

    def ask(self, boot_ns: int) -> Message:
        self._asked.append(boot_ns)
        return dialect.MAVLink_timesync_message(tc1=0, ts1=boot_ns)

    def answered(self, message: Message, boot_ns: int) -> None:
        if message.ts1 not in self._asked:
            return
        round_trip = boot_ns - message.ts1
        self._samples.append((round_trip, message.tc1 - (message.ts1 + boot_ns) // 2))
        self.offset_ns = min(self._samples)[1]

    def capture_ns(self, stamp_us: int, arrival_ns: int, options: FilterOptions) -> int:
        """Boot time of a stamp that the companion wrote by its own clock (or by ours, as some do)."""
        stamp_ns = stamp_us * 1000
        if options.stamps == "timesync":
            if abs(stamp_ns - arrival_ns) < 10 * _S:
                return min(stamp_ns, arrival_ns)
            if self.offset_ns is not None:
                return min(stamp_ns - self.offset_ns, arrival_ns)
        self._lags.append(arrival_ns - stamp_ns)
        corrected = max(stamp_ns + min(self._lags), arrival_ns - 500 * _MS)
        delayed = corrected - round(options.viso_delay_ms * _MS)
        return min(arrival_ns, max(delayed, arrival_ns - 250 * _MS))


class AutopilotCore:
    """Sensors, filter and protocol; the owner steps it and carries its messages.

    Attributes:
        gnss: whether GNSS works; the flight sets it.
        vision: every vision measurement received, with what became of it.
        counts: of messages received (by name), and of ``wrong_frame``, ``zero_velocity``, ``internal_error`` and
            the like.
    """

    def __init__(self, options: AutopilotOptions, site: Site, truth: Truth) -> None:
        self.options, self._site = options, site
        self.gnss = True
        self.filter = PositionFilter(options.filter)
        self.vision: list[VisionRecord] = []
        self.counts: Counter[str] = Counter()
        self._companion = _Companion()
        self._rng = np.random.default_rng([options.seed, 31])
        s, rng = options.sensors, self._rng
        self._tilt = np.deg2rad(s.tilt_deg) * rng.standard_normal(2)
        self._yaw = 0.0
        self._yaw_bias = np.deg2rad(s.yaw_bias_deg) * (1.0 if rng.random() < 0.5 else -1.0)
        turn = np.deg2rad(s.velocity_turn_deg) * rng.standard_normal()
        scale = 1.0 + s.velocity_scale * (1.0 if rng.random() < 0.5 else -1.0)
        self._distortion = scale * np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
        self._walk = np.zeros(2)
        towards = rng.uniform(0.0, 2.0 * np.pi)
        self._acceleration = s.acceleration_bias * np.array([np.cos(towards), np.sin(towards)])
        self._climb = np.zeros(1)
        self._gnss_error = s.gnss_m * rng.standard_normal(3)
        self._baro = 0.0
        self._truth = truth
        self._true_m = site.autopilot_from_ned(truth.position_ned_m)
        self._velocity = truth.velocity_ned_m_s.copy()
        self._attitude = truth.ned_from_body
        self._rates = truth.rates_body_rad_s
        self.filter.reckoned_m = self._true_m[:2].copy()
        self._shadow: FloatArray | None = None
        self._shadow_drift = np.zeros(2)
        self._counter: int | None = None
        self._last_vision_ns = -_S
        self._boot_ns = 0
        self._due: dict[int, int] = {}
        self._interval: dict[int, int] = {}
        self._default_intervals()
        self._next_heartbeat_ns = 0
        self._next_timesync_ns = 0
        self._next_gnss_ns = 0
        self._builders: dict[int, Callable[[], Message]] = {
            dialect.MAVLINK_MSG_ID_ATTITUDE_QUATERNION: self._attitude_quaternion,
            dialect.MAVLINK_MSG_ID_LOCAL_POSITION_NED: self._local_position,
            dialect.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: self._global_position,
            dialect.MAVLINK_MSG_ID_GPS_RAW_INT: self._gps_raw,
            dialect.MAVLINK_MSG_ID_SYSTEM_TIME: self._system_time,
            dialect.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN: self._global_origin,
            dialect.MAVLINK_MSG_ID_HOME_POSITION: self._home,
            dialect.MAVLINK_MSG_ID_EXTENDED_SYS_STATE: self._extended_state,
            dialect.MAVLINK_MSG_ID_EKF_STATUS_REPORT: self._ekf_status,
            dialect.MAVLINK_MSG_ID_AUTOPILOT_VERSION: self._version,
        }
        gimbal = options.gimbal
        if gimbal is not None:
            self._builders[dialect.MAVLINK_MSG_ID_GIMBAL_DEVICE_ATTITUDE_STATUS] = lambda: gimbal.report(self._boot_ns)

    def _default_intervals(self) -> None:
        if self.options.streams_by_default:
            rates = {
                dialect.MAVLINK_MSG_ID_ATTITUDE_QUATERNION: 30.0,
                dialect.MAVLINK_MSG_ID_LOCAL_POSITION_NED: 20.0,
                dialect.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: 5.0,
                dialect.MAVLINK_MSG_ID_GPS_RAW_INT: 2.0,
                dialect.MAVLINK_MSG_ID_SYSTEM_TIME: 1.0,
                dialect.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN: 0.2,
            }
            self._interval = {kind: round(_S / rate) for kind, rate in rates.items()}

    # -- what it believes --------------------

    @property
    def position_ned_m(self) -> FloatArray:
        """(3,) its estimate, relative to its origin, by its own earth model."""
        return np.append(self.filter.position_m, self._true_m[2] + self._baro)

    @property
    def velocity_ned_m_s(self) -> FloatArray:
        """(3,) its estimate."""
        return self._velocity

    @property
    def ned_from_body(self) -> FloatArray:
        """(3, 3) its estimate."""
        return self._attitude

    @property
    def dead_reckoned_m(self) -> FloatArray | None:
        """(2,) north, east that it would believe had it got nothing since GNSS was lost; None before."""
        return self._shadow

    @property
    def true_position_m(self) -> FloatArray:
        """(3,) the true position in the autopilot's frame."""
        return self._true_m

    @property
    def synchronised(self) -> bool:
        """Whether the companion answered TIMESYNC."""
        return self._companion.offset_ns is not None

    # -- time goes on --------------------

    def step(self, boot_ns: int, truth: Truth, dt_s: float) -> list[Message]:
        """Advance to ``boot_ns``; returns what is due to be sent."""
        self._boot_ns, self._truth = boot_ns, truth
        before, self._true_m = self._true_m, self._site.autopilot_from_ned(truth.position_ned_m)
        s, rng = self.options.sensors, self._rng
        self._tilt = _wander(self._tilt, np.deg2rad(s.tilt_deg), s.tilt_time_s, dt_s, rng.standard_normal(2))
        self._yaw = float(
            _wander(np.array([self._yaw]), np.deg2rad(s.yaw_deg), s.tilt_time_s, dt_s, rng.standard_normal(1))[0]
        )
        self._gnss_error = _wander(self._gnss_error, s.gnss_m, s.gnss_time_s, dt_s, rng.standard_normal(3))
        self._walk = self._walk + s.velocity_walk * math.sqrt(dt_s) * rng.standard_normal(2)
        self._walk = self._walk + self._acceleration * dt_s
        self._climb = _wander(self._climb, s.climb_m_s, s.climb_time_s, dt_s, rng.standard_normal(1))
        self._baro += s.baro_walk_m * math.sqrt(dt_s) * float(rng.standard_normal())
        self._attitude = rotation.exp([*self._tilt, self._yaw + self._yaw_bias]) @ truth.ned_from_body
        self._rates = truth.rates_body_rad_s
        measured = self._distortion @ ((self._true_m - before)[:2] / dt_s) + self._walk
        self.filter.predict(boot_ns, measured, dt_s)
        self._velocity = np.append(measured + self.filter.drift_m_s, truth.velocity_ned_m_s[2] + self._climb)
        if not self.gnss:
            if self._shadow is None:
                self._shadow, self._shadow_drift = self.filter.position_m.copy(), self.filter.drift_m_s.copy()
            else:
                self._shadow = self._shadow + (measured + self._shadow_drift) * dt_s
        elif boot_ns >= self._next_gnss_ns:
            self._next_gnss_ns = boot_ns + _S // 5
            self.filter.fuse((self._true_m + self._gnss_error)[:2], s.gnss_m, boot_ns, boot_ns)
        return self._due_messages(boot_ns)

    def _due_messages(self, boot_ns: int) -> list[Message]:
        out: list[Message] = []
        if boot_ns >= self._next_heartbeat_ns:
            self._next_heartbeat_ns = boot_ns + _S
            out.append(
                dialect.MAVLink_heartbeat_message(
                    type=dialect.MAV_TYPE_QUADROTOR,
                    autopilot=dialect.MAV_AUTOPILOT_ARDUPILOTMEGA,
                    base_mode=_BASE_MODE,
                    custom_mode=_GUIDED,
                    system_status=dialect.MAV_STATE_ACTIVE,
                    mavlink_version=3,
                )
            )
        if boot_ns >= self._next_timesync_ns:
            self._next_timesync_ns = boot_ns + (_S if self.synchronised else _S // 10)
            out.append(self._companion.ask(boot_ns))
        for kind, interval in self._interval.items():
            due = self._due.get(kind, 0)
            if boot_ns >= due:
                # Kept on its raster, unless it has fallen behind.
                self._due[kind] = due + interval if boot_ns - due < interval else boot_ns + interval
                out.append(self._builders[kind]())
        return out

    # -- what it hears --------------------

    def handle(self, message: Message, boot_ns: int) -> list[Message]:
        """Take in a message that arrived at ``boot_ns``; returns the answers."""
        name = message.get_type()
        self.counts[name] += 1
        if name == "TIMESYNC":
            if message.tc1 == 0:
                return [dialect.MAVLink_timesync_message(tc1=boot_ns, ts1=message.ts1)]
            self._companion.answered(message, boot_ns)
        elif name == "COMMAND_LONG":
            return self._command(message)
        elif name == "ODOMETRY":
            self._odometry(message, boot_ns)
        elif name == "VISION_POSITION_ESTIMATE":
            position = np.array([message.x, message.y, message.z])
            self._vision(message.usec, position, message.covariance, message.reset_counter, 0, boot_ns)
        elif name == "PARAM_REQUEST_READ" and message.target_system == self.options.system_id:
            return self._parameter(message.param_id)
        elif name == "SET_GPS_GLOBAL_ORIGIN":
            self.counts["origin_refused"] += 1  # it has one, from GNSS
        return []

    @staticmethod
    def _parameter(name: str) -> list[Message]:
        """As ArduPilot: numbers of any type as a float, and silence for a name that it does not have."""
        if name not in _PARAMETERS:
            return []
        value = _PARAMETERS[name]
        kind = dialect.MAV_PARAM_TYPE_REAL32 if isinstance(value, float) else dialect.MAV_PARAM_TYPE_INT16
        return [
            dialect.MAVLink_param_value_message(
                param_id=name.encode(),
                param_value=float(value),
                param_type=kind,
                param_count=len(_PARAMETERS),
                param_index=65535,
            )
        ]

    def _command(self, message: Message) -> list[Message]:
        def ack(result: int) -> Message:
            return dialect.MAVLink_command_ack_message(command=message.command, result=result)

        if message.target_system not in (0, self.options.system_id):
            return []
        kind = round(message.param1)
        if message.command == dialect.MAV_CMD_SET_MESSAGE_INTERVAL:
            if kind not in self._builders:
                return [ack(dialect.MAV_RESULT_FAILED)]
            if message.param2 <= 0:
                self._interval.pop(kind, None)
            else:
                self._interval[kind] = max(_S // 50, round(message.param2 * 1000))
            return [ack(dialect.MAV_RESULT_ACCEPTED)]
        if message.command == dialect.MAV_CMD_REQUEST_MESSAGE:
            if kind not in self._builders:
                return [ack(dialect.MAV_RESULT_FAILED)]
            return [ack(dialect.MAV_RESULT_ACCEPTED), self._builders[kind]()]
        return [ack(dialect.MAV_RESULT_UNSUPPORTED)]

    def _odometry(self, m: Message, boot_ns: int) -> None:
        position = np.array([m.x, m.y, m.z])
        if m.frame_id != dialect.MAV_FRAME_LOCAL_FRD or m.child_frame_id != dialect.MAV_FRAME_BODY_FRD:
            self._record(boot_ns, boot_ns, position, 0.0, m.reset_counter, Verdict.WRONG_FRAME, None)
            return
        if m.vx == 0.0 and m.vy == 0.0 and m.vz == 0.0:
            self.counts["zero_velocity"] += 1  # says that it stands still, where it means that it does not know
        self._vision(m.time_usec, position, m.pose_covariance, m.reset_counter, m.quality, boot_ns)

    def _vision(
        self, stamp_us: int, position: FloatArray, covariance: list[float], counter: int, quality: int, boot_ns: int
    ) -> None:
        def record(
            verdict: Verdict, capture_ns: int = boot_ns, sigma_m: float = 0.0, innovation_m: float | None = None
        ) -> None:
            self._record(boot_ns, capture_ns, position, sigma_m, counter, verdict, innovation_m)

        options = self.options.filter
        # Even what is not taken teaches the relation of the clocks.
        capture_ns = self._companion.capture_ns(stamp_us, boot_ns, options)
        if quality == -1 or (options.quality_min > 0 and 0 < quality < options.quality_min):
            record(Verdict.FAILED_QUALITY)
            return
        if not np.isfinite(position).all():
            record(Verdict.NOT_FINITE)
            return
        sigma = position_sigma_m(covariance, self.options.firmware)
        if math.isnan(sigma):
            # AP_InternalError constraining_nan: constrain_float gives the middle of the range.
            self.counts["internal_error"] += 1
            sigma = 50.1
        sigma = min(max(sigma, options.pos_m_nse), 100.0)
        if boot_ns - self._last_vision_ns < 20 * _MS:
            record(Verdict.TOO_FAST, capture_ns, sigma)
            return
        self._last_vision_ns = boot_ns
        known, self._counter = self._counter, counter
        if self.gnss:
            record(Verdict.STANDBY, capture_ns, sigma)
            return
        if known is not None and counter != known:
            found = self.filter.innovation(position[:2], capture_ns, boot_ns)
            if found is None:
                record(Verdict.TOO_OLD, capture_ns, sigma)
                return
            self.filter.reset(found[0], sigma**2, boot_ns)
            record(Verdict.RESET, capture_ns, sigma, float(np.hypot(*found[0])))
            return
        verdict, innovation = self.filter.fuse(position[:2], sigma, capture_ns, boot_ns)
        record(verdict, capture_ns, sigma, innovation)

    def _record(
        self, arrival_ns: int, capture_ns: int, position: FloatArray, sigma_m: float, counter: int, verdict: Verdict,
        innovation_m: float | None,
    ) -> None:  # fmt: skip
        self.counts[f"vision.{verdict}"] += 1
        self.vision.append(VisionRecord(arrival_ns, capture_ns, position, sigma_m, counter, verdict, innovation_m))

    # -- what it says --------------------

    @property
    def _boot_ms(self) -> int:
        return self._boot_ns // _MS % 2**32

    def _attitude_quaternion(self) -> Message:
        q = rotation.to_quaternion(self._attitude)
        p, q_rate, r = (float(v) for v in self._rates)
        return dialect.MAVLink_attitude_quaternion_message(
            time_boot_ms=self._boot_ms, q1=q[0], q2=q[1], q3=q[2], q4=q[3], rollspeed=p, pitchspeed=q_rate, yawspeed=r
        )

    def _local_position(self) -> Message:
        x, y, z = self.position_ned_m
        vx, vy, vz = self._velocity
        return dialect.MAVLink_local_position_ned_message(
            time_boot_ms=self._boot_ms, x=x, y=y, z=z, vx=vx, vy=vy, vz=vz
        )

    def _global_position(self) -> Message:
        position = self.position_ned_m
        point = self._site.geopoint_from_autopilot(position)
        yaw_deg = np.rad2deg(rotation.to_euler(self._attitude)[2]) % 360.0
        vx, vy, vz = (round(float(v) * 100) for v in self._velocity)
        return dialect.MAVLink_global_position_int_message(
            time_boot_ms=self._boot_ms, lat=round(point.lat_deg * 1e7), lon=round(point.lon_deg * 1e7),
            alt=round(point.height_amsl_m * 1e3), relative_alt=round(-float(position[2]) * 1e3), vx=vx, vy=vy, vz=vz,
            hdg=round(yaw_deg * 100) % 36000,
        )  # fmt: skip

    def _gps_raw(self) -> Message:
        measured = self._true_m + self._gnss_error
        point = self._site.geopoint_from_autopilot(measured)
        sigma_mm = round(1e3 * max(0.3, self.options.sensors.gnss_m))
        good = self.gnss
        return dialect.MAVLink_gps_raw_int_message(
            time_usec=self._boot_ns // 1000,
            fix_type=dialect.GPS_FIX_TYPE_3D_FIX if good else dialect.GPS_FIX_TYPE_NO_FIX,
            lat=round(point.lat_deg * 1e7) if good else 0, lon=round(point.lon_deg * 1e7) if good else 0,
            alt=round(point.height_amsl_m * 1e3) if good else 0, eph=90 if good else 65535, epv=150 if good else 65535,
            vel=65535, cog=65535, satellites_visible=14 if good else 0, h_acc=sigma_mm if good else 0,
            v_acc=round(1.5 * sigma_mm) if good else 0,
        )  # fmt: skip

    def _system_time(self) -> Message:
        return dialect.MAVLink_system_time_message(time_unix_usec=0, time_boot_ms=self._boot_ms)

    def _global_origin(self) -> Message:
        origin = self._site.origin
        return dialect.MAVLink_gps_global_origin_message(
            latitude=round(origin.lat_deg * 1e7), longitude=round(origin.lon_deg * 1e7),
            altitude=round(origin.height_amsl_m * 1e3), time_usec=self._boot_ns // 1000,
        )  # fmt: skip

    def _home(self) -> Message:
        origin = self._site.origin
        return dialect.MAVLink_home_position_message(
            latitude=round(origin.lat_deg * 1e7), longitude=round(origin.lon_deg * 1e7),
            altitude=round(origin.height_amsl_m * 1e3), x=0.0, y=0.0, z=0.0, q=[1.0, 0.0, 0.0, 0.0],
            approach_x=0.0, approach_y=0.0, approach_z=0.0,
        )  # fmt: skip

    def _extended_state(self) -> Message:
        return dialect.MAVLink_extended_sys_state_message(
            vtol_state=dialect.MAV_VTOL_STATE_UNDEFINED, landed_state=dialect.MAV_LANDED_STATE_IN_AIR
        )

    def _ekf_status(self) -> Message:
        fused = self.filter.last_fused_ns
        aided = self.gnss or (fused is not None and self._boot_ns - fused < 7 * _S)
        return dialect.MAVLink_ekf_status_report_message(
            flags=_EKF_GOOD if aided else _EKF_DEAD_RECKONING, velocity_variance=0.1,
            pos_horiz_variance=math.sqrt(self.filter.test_ratio), pos_vert_variance=0.1, compass_variance=0.1,
            terrain_alt_variance=0.0,
        )  # fmt: skip

    def _version(self) -> Message:
        major, minor, patch = self.options.firmware
        version = major << 24 | minor << 16 | patch << 8 | 255  # 255: an official release
        return dialect.MAVLink_autopilot_version_message(
            capabilities=dialect.MAV_PROTOCOL_CAPABILITY_MAVLINK2, flight_sw_version=version,
            middleware_sw_version=0, os_sw_version=0, board_version=0, flight_custom_version=[0] * 8,
            middleware_custom_version=[0] * 8, os_custom_version=[0] * 8, vendor_id=0, product_id=0, uid=0,
        )  # fmt: skip


def _wander(value: FloatArray, sigma: float, time_s: float, dt_s: float, white: FloatArray) -> FloatArray:
    """One step of an Ornstein-Uhlenbeck process of standard deviation ``sigma``."""
    decay = math.exp(-dt_s / time_s)
    return np.asarray(decay * value + sigma * math.sqrt(1.0 - decay**2) * white, dtype=np.float64)


class UdpPort:
    """MAVLink 2 over a loopback UDP socket. Sends to ``peer``, or to whoever spoke last if none is given."""

    def __init__(
        self,
        system_id: int = 1,
        address: tuple[str, int] = ("127.0.0.1", 0),
        peer: tuple[str, int] | None = None,
    ) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(address)
        self._socket.setblocking(False)
        self._fixed, self._peer = peer is not None, peer
        self._mav = dialect.MAVLink(None, system_id, dialect.MAV_COMP_ID_AUTOPILOT1)
        self._mav.robust_parsing = True
        self.bad_data = 0

    @property
    def port(self) -> int:
        """UDP port it is bound to."""
        return int(self._socket.getsockname()[1])

    def fileno(self) -> int:
        """For select."""
        return self._socket.fileno()

    def receive(self) -> list[Message]:
        """What arrived since the last call."""
        messages: list[Message] = []
        while True:
            try:
                data, peer = self._socket.recvfrom(2048)
            except (BlockingIOError, ConnectionRefusedError):
                return messages
            if not self._fixed:
                self._peer = peer
            for message in self._mav.parse_buffer(data) or []:
                if message.get_type() == "BAD_DATA":
                    self.bad_data += 1
                else:
                    messages.append(message)

    def send(self, messages: list[Message]) -> None:
        """Send; without a peer, and while the other end is not there yet, messages are lost, as on a real line."""
        for message in messages:
            data = message.pack(self._mav)
            self._mav.seq = (self._mav.seq + 1) % 256
            if self._peer is not None:
                try:
                    self._socket.sendto(data, self._peer)
                except (ConnectionRefusedError, BlockingIOError):
                    continue

    def close(self) -> None:
        self._socket.close()
