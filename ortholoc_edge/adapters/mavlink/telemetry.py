"""What was heard of the vehicle: attitude, position, velocity, GNSS, each with its time; no I/O, no own clock."""

from __future__ import annotations

import logging
import math
from collections import Counter, deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from ortholoc_edge.adapters.mavlink.clockwatch import ClockWatch, Stamp
from ortholoc_edge.adapters.mavlink.codec import MavlinkMessage, dialect
from ortholoc_edge.adapters.mavlink.geodesy import GeodeticOrigin, is_same_origin, moved
from ortholoc_edge.adapters.mavlink.gimbal import GIMBAL_MESSAGES, Gimbal, GimbalSelection
from ortholoc_edge.adapters.mavlink.history import TimeHistory, choose
from ortholoc_edge.adapters.mavlink.log import LimitedLog
from ortholoc_edge.adapters.mavlink.state import AutopilotState, GnssPosition
from ortholoc_edge.adapters.mavlink.timesync import TimeSync
from ortholoc_edge.geometry import rotation
from ortholoc_edge.geometry.arrays import FloatArray, frozen_floats

logger = logging.getLogger(__name__)

_MS = 1_000_000
_S = 1_000_000_000
# time_boot_ms is 32 bits wide: it comes round after 49.7 days.
_BOOT_WRAP_NS = 2**32 * _MS

_HISTORY_NS = 10 * _S

_MAX_EXTRAPOLATION_NS = 200 * _MS
_GNSS_FRESH_NS = 1500 * _MS
# Its reports come at 1 Hz or more.
_ESTIMATOR_FRESH_NS = 3 * _S
_GNSS_MAX_HDOP = 4.0
_GNSS_MAX_SIGMA_M = 25.0
# A receiver's h_acc and v_acc are of its noise. What they leave out does not average away: ETRS89, which maps are
# in, against the WGS 84 of GNSS is 0.8 to 1.5 m (docs/frames.md), a receiver's bias in the open is
# of the order of a metre, its time of arrival is 0.1 to 0.2 s late, and its geoid model differs from the map's.
_GNSS_LEAST_SIGMA_M, _GNSS_LEAST_SIGMA_VERTICAL_M = 1.5, 2.5
# 1-sigma per unit of dilution for a single-frequency receiver, where it gives no accuracy in metres.
_GNSS_RANGE_ERROR_M = 3.0
# Local position: a step beyond constant velocity that no vehicle flies is a reset of the filter.
_JUMP_M = 2.0
_JUMP_ACCELERATION_M_S2 = 10.0
_LOCAL_GAP_NS = 2 * _S
# Velocity is not integrated across a longer gap: at 10 m/s^2 it may hide 1.25 m already.
_ODOMETRY_GAP_NS = 1 * _S
_MAX_LOCAL_M = 1e6
_MAX_SPEED_M_S = 500.0
# Later than the newest sample by this much, time_boot_ms has gone back: the autopilot restarted.
_BOOT_BACK_NS = 1 * _S
_STAMP_AHEAD_NS = 1 * _S
# Ten a second for as long as frames are asked about.
_GPS_CAPACITY = 100


def _is_position(latitude_e7: int, longitude_e7: int) -> bool:
    """Both stacks send zeros while they have no position."""
    return (
        (latitude_e7, longitude_e7) != (0, 0)
        and abs(latitude_e7) <= 900000000
        and abs(longitude_e7) <= 1800000000
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Attitude:
    quaternion: tuple[float, float, float, float]
    rates_rad_s: tuple[float, float, float]


@dataclass(frozen=True, slots=True, eq=False)
class _Local:
    position: FloatArray
    velocity: FloatArray
    epoch: int


@dataclass(frozen=True, slots=True, eq=False)
class _Odometry:
    position: FloatArray
    velocity: FloatArray
    epoch: int

    def after(self, seconds: float, acceleration: FloatArray | float = 0.0) -> FloatArray:
        """(3,) position so much later (or earlier)."""
        there: FloatArray = self.position + self.velocity * seconds + 0.5 * acceleration * seconds**2
        return there


@dataclass(frozen=True, slots=True)
class _GpsRaw:
    arrival_ns: int
    boot_ns: int | None  # of the fix, by the autopilot's clock
    fix_type: int
    latitude_deg: float
    longitude_deg: float
    height_amsl_m: float
    sigma_horizontal_m: float | None
    sigma_vertical_m: float | None


class Telemetry:
    """Takes in what the one autopilot sends and tells what it knew at a stamp.

    :meth:`take` gets every message of the autopilot and of nobody else; it also notices that the autopilot
    restarted, whose samples of before are then forgotten, since they are of another clock.
    """

    def __init__(
        self,
        timesync: TimeSync,
        counts: Counter[str],
        attitude_rate_hz: float,
        position_rate_hz: float,
        gimbal: GimbalSelection | None = None,
    ) -> None:
        """
        Args:
            timesync: relates the autopilot's stamps to ours; kept by the owner, which also resets it.
            counts: where what is dropped is counted.
            attitude_rate_hz, position_rate_hz: at which samples are expected, for the memory they take.
            gimbal: the one that carries the camera; None: nothing of gimbals is taken in.
        """
        self._timesync, self._counts = timesync, counts
        self.gimbal = None if gimbal is None else Gimbal(gimbal, counts)
        self._log = LimitedLog()
        self._restart: str | None = None
        self._armed = False
        self._landed: bool | None = None
        self._origin: GeodeticOrigin | None = None
        self._gps_raws: deque[_GpsRaw] = deque(maxlen=_GPS_CAPACITY)
        # When it was heard, flags and test ratio.
        self._estimator: tuple[int, int, float] | None = None
        self._epoch = 0
        self._newest_boot_ns: int | None = None
        self._watch = ClockWatch(timesync)
        self._unconfirmed_after_ns: int | None = None
        self._ahead_in_a_row = 0
        self._quaternion_ns: int | None = None
        # Twice what was asked for, as some stacks send more; and no less than 20 Hz.
        capacity = 2 * int(_HISTORY_NS / _S * max(20.0, attitude_rate_hz, position_rate_hz))
        self._attitudes: TimeHistory[_Attitude] = TimeHistory(_HISTORY_NS, capacity)
        self._locals: TimeHistory[_Local] = TimeHistory(_HISTORY_NS, capacity)
        self._odometry: TimeHistory[_Odometry] = TimeHistory(_HISTORY_NS, capacity)
        self._last_local: tuple[int, _Local] | None = None
        self._last_odometry: tuple[int, _Odometry] | None = None
        self._odometry_epoch = 0
        self._handlers: dict[str, Callable[[MavlinkMessage, int], None]] = {
            "HEARTBEAT": self._on_heartbeat,
            "ATTITUDE_QUATERNION": self._on_attitude_quaternion,
            "ATTITUDE": self._on_attitude,
            "LOCAL_POSITION_NED": self._on_local_position,
            "GPS_RAW_INT": self._on_gps_raw,
            "GPS_GLOBAL_ORIGIN": self._on_origin,
            "SYSTEM_TIME": self._on_system_time,
            "EXTENDED_SYS_STATE": self._on_extended_state,
            "EKF_STATUS_REPORT": self._on_ekf_status,
            "ESTIMATOR_STATUS": self._on_estimator_status,
        }
        if self.gimbal is not None:
            self._handlers |= dict.fromkeys(GIMBAL_MESSAGES, self._on_gimbal)

    @property
    def origin(self) -> GeodeticOrigin | None:
        """The EKF origin, once the autopilot has told it."""
        return self._origin

    @property
    def local_epoch(self) -> int:
        """See :class:`AutopilotState`."""
        return self._epoch

    def take(self, message: MavlinkMessage, arrival_ns: int) -> str | None:
        """Take in one message. Returns why the autopilot must have restarted since the one before, if it has."""
        self._restart = None
        handler = self._handlers.get(message.get_type())
        if handler is not None:
            handler(message, arrival_ns)
        return self._restart

    def forget(self) -> None:
        """Drop all that does not survive a restart of the autopilot."""
        self._epoch += 1
        for history in (self._attitudes, self._locals, self._odometry):
            history.clear()
        self._break_odometry()
        self._last_local = None
        self._newest_boot_ns = None
        self._watch.forget()
        self._unconfirmed_after_ns = None
        self._ahead_in_a_row = 0
        self._origin = None
        self._gps_raws.clear()
        self._estimator = None
        self._landed = None
        self._quaternion_ns = None
        if self.gimbal is not None:
            self.gimbal.forget()

    def take_of_component(self, message: MavlinkMessage, arrival_ns: int) -> bool:
        """Take in a message of another component of the vehicle; False if it is of no use. Such a component counts
        time from its own start."""
        if self.gimbal is None or message.get_type() not in GIMBAL_MESSAGES:
            return False
        self.gimbal.take(message, None, arrival_ns)
        return True

    def state_at(self, stamp_ns: int) -> AutopilotState:
        """What the autopilot knew at a stamp of our clock; parts that are not known there are None."""
        best = self._timesync.best(stamp_ns) if self._timesync.synchronised else None
        by_boot = best is not None
        time_ns = stamp_ns + best[0] if best is not None else stamp_ns
        if by_boot and self._unconfirmed_after_ns is not None and time_ns > self._unconfirmed_after_ns:
            return self._unknown(stamp_ns)
        flags, ratio = self._estimator_at(stamp_ns)
        attitude, turning, interpolated = self._attitude_at(time_ns, by_boot)
        position, velocity, epoch = self._local_at(time_ns, by_boot)
        odometry, odometry_epoch = self._odometry_at(time_ns, by_boot)
        gimbal = None if self.gimbal is None else self.gimbal.at(stamp_ns, best[0] if best else None, attitude)
        return AutopilotState(
            stamp_ns=stamp_ns,
            ned_from_body=attitude,
            interpolated=interpolated and (gimbal is None or gimbal.interpolated),
            velocity_ned=velocity,
            local_position_ned_m=position,
            local_epoch=epoch,
            odometry_ned_m=odometry,
            odometry_epoch=odometry_epoch,
            gnss=self._gnss_at(stamp_ns, time_ns, by_boot),
            origin=self._origin,
            armed=self._armed,
            landed=self._landed,
            synchronised=by_boot,
            sync_uncertainty_ns=best[1] if best is not None else None,
            estimator_flags=flags,
            position_test_ratio=ratio,
            ned_from_gimbal=None if gimbal is None else gimbal.ned_from_gimbal,
            gimbal_sigma_rad=0.0 if gimbal is None else gimbal.sigma_rad,
            turning_rad_s=turning,
        )

    def _unknown(self, stamp_ns: int) -> AutopilotState:
        """While it is open what time the autopilot's stamps mean."""
        flags, ratio = self._estimator_at(stamp_ns)
        return AutopilotState(
            stamp_ns=stamp_ns,
            ned_from_body=None,
            interpolated=False,
            velocity_ned=None,
            local_position_ned_m=None,
            local_epoch=self._epoch,
            odometry_ned_m=None,
            odometry_epoch=self._odometry_epoch,
            gnss=None,
            origin=self._origin,
            armed=self._armed,
            landed=self._landed,
            synchronised=False,
            sync_uncertainty_ns=None,
            estimator_flags=flags,
            position_test_ratio=ratio,
        )

    def _estimator_at(self, stamp_ns: int) -> tuple[int, float] | tuple[None, None]:
        """Flags and test ratio of the last report, while it is fresh."""
        if self._estimator is None or stamp_ns - self._estimator[0] > _ESTIMATOR_FRESH_NS:
            return None, None
        return self._estimator[1:]

    # -- in --------------------

    def _on_heartbeat(self, m: MavlinkMessage, arrival_ns: int) -> None:
        self._armed = bool(m.base_mode & dialect.MAV_MODE_FLAG_SAFETY_ARMED)

    def _restarted(self, why: str) -> None:
        self._restart = why
        self.forget()

    def _boot_ns(self, name: str, time_boot_ms: int, arrival_ns: int) -> int | None:
        """Boot time of a sample; notices restarts. None if the stamp can't be true."""
        boot_ns = time_boot_ms * _MS
        best = self._timesync.best(arrival_ns) if self._timesync.synchronised else None
        if best is not None:
            expected = arrival_ns + best[0]
            boot_ns += max(0, round((expected - boot_ns) / _BOOT_WRAP_NS)) * _BOOT_WRAP_NS
            if boot_ns > expected + _STAMP_AHEAD_NS:
                self._counts["bad_stamps"] += 1
                self._ahead_in_a_row += 1
                if self._ahead_in_a_row >= 5:
                    self._restarted("its clock jumped ahead")
                return None
            self._ahead_in_a_row = 0
        if self._newest_boot_ns is not None and boot_ns < self._newest_boot_ns - _BOOT_BACK_NS:
            self._restarted("restarted (its boot time went back)")
        else:
            stamp = self._watch.judge(name, boot_ns, arrival_ns)
            if stamp is Stamp.FALSE:
                self._counts["bad_stamps"] += 1
                self._log(
                    arrival_ns, logging.WARNING, "stamp",
                    f"autopilot sent {name} with a stamp of no time that it may have; dropped, and its clock asked for",
                )  # fmt: skip
                return None
            if stamp is Stamp.GOOD:
                self._unconfirmed_after_ns = None
            elif self._unconfirmed_after_ns is None:
                self._counts["clock_doubts"] += 1
                self._unconfirmed_after_ns = self._newest_boot_ns or 0
        self._newest_boot_ns = max(boot_ns, self._newest_boot_ns or 0)
        return boot_ns

    def _garbage(self, name: str, now_ns: int, what: str) -> None:
        self._counts["garbage"] += 1
        self._counts[f"garbage.{name}"] += 1
        self._log(now_ns, logging.WARNING, f"garbage.{name}", f"autopilot sent {name} with {what}; dropped")

    def _add_attitude(
        self, name: str, boot_ms: int, arrival_ns: int, q: Iterable[float], rates: Iterable[float]
    ) -> None:
        w, x, y, z = (float(v) for v in q)
        norm = math.sqrt(w * w + x * x + y * y + z * z)
        # Not merely unnormalised: a quaternion this far from unit length was never computed by a filter.
        if not 0.9 < norm < 1.1:
            self._garbage(name, arrival_ns, f"quaternion {[w, x, y, z]}")
            return
        p, q_rate, r = (float(v) if math.isfinite(v) else 0.0 for v in rates)
        boot_ns = self._boot_ns(name, boot_ms, arrival_ns)
        if boot_ns is None:
            return
        sample = _Attitude((w / norm, x / norm, y / norm, z / norm), (p, q_rate, r))
        if not self._attitudes.add(boot_ns, arrival_ns, sample):
            self._counts["out_of_order"] += 1

    def _on_attitude_quaternion(self, m: MavlinkMessage, arrival_ns: int) -> None:
        self._quaternion_ns = arrival_ns
        self._add_attitude(
            "ATTITUDE_QUATERNION",
            m.time_boot_ms,
            arrival_ns,
            (m.q1, m.q2, m.q3, m.q4),
            (m.rollspeed, m.pitchspeed, m.yawspeed),
        )

    def _on_attitude(self, m: MavlinkMessage, arrival_ns: int) -> None:
        if self._quaternion_ns is not None and arrival_ns - self._quaternion_ns < 1 * _S:
            return  # the same estimate, in the better form, comes too
        if not all(math.isfinite(v) and abs(v) < 10.0 for v in (m.roll, m.pitch, m.yaw)):
            self._garbage("ATTITUDE", arrival_ns, f"angles {[m.roll, m.pitch, m.yaw]}")
            return
        q = rotation.to_quaternion(rotation.from_euler(m.roll, m.pitch, m.yaw))
        self._add_attitude(
            "ATTITUDE", m.time_boot_ms, arrival_ns, q.tolist(), (m.rollspeed, m.pitchspeed, m.yawspeed)
        )

    def _on_local_position(self, m: MavlinkMessage, arrival_ns: int) -> None:
        values = np.array([m.x, m.y, m.z, m.vx, m.vy, m.vz], dtype=np.float64)
        if (
            not np.isfinite(values).all()
            or np.abs(values[:3]).max() > _MAX_LOCAL_M
            or np.abs(values[3:]).max() > _MAX_SPEED_M_S
        ):
            self._garbage("LOCAL_POSITION_NED", arrival_ns, f"values {values.tolist()}")
            if not (np.abs(values[3:]) <= _MAX_SPEED_M_S).all():
                self._break_odometry()
            return
        boot_ns = self._boot_ns("LOCAL_POSITION_NED", m.time_boot_ms, arrival_ns)
        if boot_ns is None:
            return
        position, velocity = values[:3], values[3:]
        self._add_velocity(boot_ns, arrival_ns, velocity)
        if self._last_local is not None and boot_ns > self._last_local[0]:
            last_ns, last = self._last_local
            dt = (boot_ns - last_ns) / _S
            step = float(np.linalg.norm(position - last.position - 0.5 * (last.velocity + velocity) * dt))
            # Beyond constant velocity a vehicle gets half its acceleration times dt squared. After a long gap
            # no such test can tell, so the gap itself ends the epoch.
            limit = max(_JUMP_M, 0.5 * _JUMP_ACCELERATION_M_S2 * dt * dt)
            if boot_ns - last_ns > _LOCAL_GAP_NS or step > limit:
                self._epoch += 1
                self._counts["local_jumps"] += 1
                self._log(
                    arrival_ns,
                    logging.WARNING,
                    "jump",
                    f"autopilot's local position jumped by {step:.1f} m in {dt:.2f} s; epoch {self._epoch}",
                )
        sample = _Local(position, velocity, self._epoch)
        if self._locals.add(boot_ns, arrival_ns, sample):
            self._last_local = (boot_ns, sample)
        else:
            self._counts["out_of_order"] += 1

    def _break_odometry(self) -> None:
        if self._last_odometry is not None:
            self._last_odometry = None
            self._odometry_epoch += 1

    def _add_velocity(self, boot_ns: int, arrival_ns: int, velocity: FloatArray) -> None:
        """Carry the odometry on, by trapezia."""
        position = np.zeros(3)
        if self._last_odometry is not None:
            last_ns, last = self._last_odometry
            if boot_ns <= last_ns:
                return
            if boot_ns - last_ns > _ODOMETRY_GAP_NS:
                self._break_odometry()
            else:
                position = last.position + 0.5 * (last.velocity + velocity) * ((boot_ns - last_ns) / _S)
        sample = _Odometry(position, velocity, self._odometry_epoch)
        if self._odometry.add(boot_ns, arrival_ns, sample):
            self._last_odometry = boot_ns, sample

    def _on_gps_raw(self, m: MavlinkMessage, arrival_ns: int) -> None:
        def sigma(accuracy_mm: int, dilution_hundredths: int) -> float | None:
            # Accuracies are extensions: absent they read 0. Dilution: 65535 is unknown.
            if accuracy_mm > 0:
                return accuracy_mm / 1e3
            if 0 < dilution_hundredths < 65535:
                return dilution_hundredths / 100.0 * _GNSS_RANGE_ERROR_M
            return None

        horizontal = sigma(m.h_acc, m.eph)
        if m.eph != 65535 and m.eph > _GNSS_MAX_HDOP * 100:
            horizontal = None
        vertical = sigma(m.v_acc, m.epv)
        if vertical is None and horizontal is not None:
            vertical = 2.0 * horizontal  # the geometry of satellites above the horizon
        if not _is_position(m.lat, m.lon):
            self._counts["empty.GPS_RAW_INT"] += 1
        self._gps_raws.append(
            _GpsRaw(
                arrival_ns,
                self._fix_boot_ns(m.time_usec * 1000),
                m.fix_type if _is_position(m.lat, m.lon) else dialect.GPS_FIX_TYPE_NO_FIX,
                m.lat / 1e7,
                m.lon / 1e7,
                m.alt / 1e3,
                horizontal,
                vertical,
            )
        )

    def _fix_boot_ns(self, time_ns: int) -> int | None:
        """Boot time of a fix. Its own stamp may be of another clock, or zero; then it is as old as the newest
        message."""
        newest_ns = self._newest_boot_ns
        if newest_ns is None:
            return None
        if 0 < time_ns < newest_ns:
            time_ns += (newest_ns - time_ns) // _BOOT_WRAP_NS * _BOOT_WRAP_NS
        fresh = -_GNSS_FRESH_NS <= time_ns - newest_ns <= _MAX_EXTRAPOLATION_NS
        return time_ns if fresh else newest_ns

    def _on_origin(self, m: MavlinkMessage, arrival_ns: int) -> None:
        if not _is_position(m.latitude, m.longitude):
            self._counts["empty.GPS_GLOBAL_ORIGIN"] += 1
            return
        origin = GeodeticOrigin(m.latitude / 1e7, m.longitude / 1e7, m.altitude / 1e3)
        old = self._origin
        if old is not None and is_same_origin(old, origin):
            return  # what was told first stands, so that a last digit that wavers is no news to anybody
        self._origin = origin
        if old is None:
            logger.info(
                "autopilot's origin: %.7f, %.7f, %.2f m AMSL",
                origin.latitude_deg,
                origin.longitude_deg,
                origin.height_amsl_m,
            )
            return
        # Positions before and after refer to different zeros, even if no jump shows.
        self._epoch += 1
        self._counts["origin_moves"] += 1
        self._log(arrival_ns, logging.WARNING, "origin", "autopilot's origin moved")

    def _on_system_time(self, m: MavlinkMessage, arrival_ns: int) -> None:
        self._boot_ns("SYSTEM_TIME", m.time_boot_ms, arrival_ns)

    def _on_extended_state(self, m: MavlinkMessage, arrival_ns: int) -> None:
        on_ground = dialect.MAV_LANDED_STATE_ON_GROUND
        undefined = dialect.MAV_LANDED_STATE_UNDEFINED
        self._landed = None if m.landed_state == undefined else m.landed_state == on_ground

    def _on_ekf_status(self, m: MavlinkMessage, arrival_ns: int) -> None:
        self._estimator = (arrival_ns, m.flags, float(m.pos_horiz_variance))

    def _on_estimator_status(self, m: MavlinkMessage, arrival_ns: int) -> None:
        self._estimator = (arrival_ns, m.flags, float(m.pos_horiz_ratio))

    def _on_gimbal(self, m: MavlinkMessage, arrival_ns: int) -> None:
        assert self.gimbal is not None
        # Some firmware leaves the stamp of MOUNT_ORIENTATION out.
        boot_ns = self._boot_ns(m.get_type(), m.time_boot_ms, arrival_ns) if m.time_boot_ms else None
        if boot_ns is not None or not m.time_boot_ms:
            self.gimbal.take(m, boot_ns, arrival_ns)

    # -- at a stamp --------------------

    def _attitude_at(self, time_ns: int, by_boot: bool) -> tuple[FloatArray | None, FloatArray | None, bool]:
        chosen = choose(self._attitudes.around(time_ns, by_boot), time_ns, _MAX_EXTRAPOLATION_NS)
        if chosen is None:
            return None, None, False
        a, b, t = chosen
        first = rotation.from_quaternion(a.quaternion)
        rates = np.array(a.rates_rad_s)
        if b is None:
            turned = first @ rotation.exp(rates * t)
        else:
            turned = rotation.slerp(first, rotation.from_quaternion(b.quaternion), t)
            rates = (1.0 - t) * rates + t * np.array(b.rates_rad_s)
        return frozen_floats(turned, (3, 3), "ned_from_body"), frozen_floats(rates, (3,), "rates"), b is not None

    def turns_before(self, stamp_ns: int, ages_ns: Sequence[int]) -> FloatArray | None:
        """See :meth:`AutopilotLink.turns_before`."""
        best = self._timesync.best(stamp_ns) if self._timesync.synchronised else None
        time_ns = stamp_ns + best[0] if best is not None else stamp_ns
        unconfirmed_ns = self._unconfirmed_after_ns
        if best is not None and unconfirmed_ns is not None and time_ns > unconfirmed_ns:
            return None
        now, *_ = self._attitude_at(time_ns, best is not None)
        if now is None:
            return None
        turns = np.empty((len(ages_ns), 3))
        for row, age_ns in zip(turns, ages_ns, strict=True):
            then, *_ = self._attitude_at(time_ns - age_ns, best is not None)
            if then is None:
                return None
            row[:] = rotation.log(now.T @ then)
        return turns

    def _odometry_at(self, time_ns: int, by_boot: bool) -> tuple[FloatArray | None, int]:
        before, after = self._odometry.around(time_ns, by_boot)
        if before is not None and after is not None and before[1].epoch == after[1].epoch:
            # Of one epoch, so the gap is short. Velocity is linear in it, as the trapezium has it.
            (t0, a), (t1, b) = before, after
            acceleration = (b.velocity - a.velocity) / ((t1 - t0) / _S)
            position, epoch = a.after((time_ns - t0) / _S, acceleration), a.epoch
        else:
            near = [sample for sample in (before, after) if sample is not None]
            stamp, sample = min(near, key=lambda s: abs(time_ns - s[0]), default=(0, None))
            if sample is None or abs(time_ns - stamp) > _MAX_EXTRAPOLATION_NS:
                return None, self._odometry_epoch
            position, epoch = sample.after((time_ns - stamp) / _S), sample.epoch
        return frozen_floats(position, (3,), "odometry"), epoch

    def _local_at(self, time_ns: int, by_boot: bool) -> tuple[FloatArray | None, FloatArray | None, int]:
        chosen = choose(
            self._locals.around(time_ns, by_boot),
            time_ns,
            _MAX_EXTRAPOLATION_NS,
            lambda a, b: a.epoch == b.epoch,
        )
        if chosen is None:
            return None, None, self._epoch
        a, b, t = chosen
        if b is None:
            position, velocity = a.position + a.velocity * t, a.velocity
        else:
            position = (1.0 - t) * a.position + t * b.position
            velocity = (1.0 - t) * a.velocity + t * b.velocity
        return frozen_floats(position, (3,), "position"), frozen_floats(velocity, (3,), "velocity"), a.epoch

    def _gnss_at(self, stamp_ns: int, time_ns: int, by_boot: bool) -> GnssPosition | None:
        # Of the stamp, not the latest: a frame that waited is older than it. The later of two that fit alike.
        raw = min(reversed(self._gps_raws), key=lambda raw: abs(stamp_ns - raw.arrival_ns), default=None)
        if (
            raw is None
            or abs(stamp_ns - raw.arrival_ns) > _GNSS_FRESH_NS
            or raw.boot_ns is None
            or raw.fix_type < dialect.GPS_FIX_TYPE_3D_FIX
            or raw.sigma_horizontal_m is None
            or raw.sigma_vertical_m is None
            or raw.sigma_horizontal_m > _GNSS_MAX_SIGMA_M
        ):
            return None
        then, epoch = self._odometry_at(raw.boot_ns, True)
        now, same = self._odometry_at(time_ns, by_boot)
        if then is None or now is None or epoch != same:
            return None
        latitude_deg, longitude_deg, height_amsl_m = moved(
            raw.latitude_deg, raw.longitude_deg, raw.height_amsl_m, now - then
        )
        return GnssPosition(
            latitude_deg,
            longitude_deg,
            height_amsl_m,
            max(raw.sigma_horizontal_m, _GNSS_LEAST_SIGMA_M),
            max(raw.sigma_vertical_m, _GNSS_LEAST_SIGMA_VERTICAL_M),
        )
