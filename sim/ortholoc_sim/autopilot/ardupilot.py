"""ArduPilot 4.5 to 4.8: EKF3 and what its receivers make of external positions (autopilot-contract.md, 2.3, 2.6, 2.7).

Simplified: one core that is always aligned; 24 states are an offset and a drift of dead reckoning per axis; a
measurement is applied at its capture time at once instead of when a delayed horizon reaches it. EKF3 holds its position
still once it has had no aiding for 15 s; this one goes on dead reckoning and says the same. Height and heading of a
source other than barometer and compass are weighed, not gated. VISO_ORIENT is not simulated.
"""

from __future__ import annotations

import math

import numpy as np

from ortholoc_edge.geometry import rotation
from ortholoc_edge.geometry.arrays import FloatArray
from ortholoc_sim.autopilot.clocks import JitterCorrection, LeastRoundTrip
from ortholoc_sim.autopilot.dialect import Message, dialect
from ortholoc_sim.autopilot.estimator import INFO, Estimator, finite
from ortholoc_sim.autopilot.frame import LocalFrame
from ortholoc_sim.autopilot.options import AutopilotOptions, Version
from ortholoc_sim.autopilot.parameters import Parameters
from ortholoc_sim.autopilot.position_filter import Innovation
from ortholoc_sim.autopilot.records import Verdict
from ortholoc_sim.autopilot.sensors import GnssSample
from ortholoc_sim.site import Geopoint

_MS, _S = 1_000_000, 1_000_000_000
# EK3_SRCn_POSXY, VELXY, POSZ and YAW.
_GNSS, _VISION = 3, 6
_LEAST_YAW_SIGMA, _MOST_YAW_SIGMA = math.radians(5.0), 1.5
_VISO_MAVLINK, _VISO_T265, _VISO_VOXL = 1, 2, 3
_GPS_MAVLINK = 14
_EXT_NAV_INTERVAL_NS = 20 * _MS
_BUFFER_NS = 250 * _MS
_HEALTHY_NS = 300 * _MS
_T265_IGNORED_NS = 1 * _S
# After this long without aiding of any kind EKF3 gives position up; it has to begin anew then.
_STOPS_AIDING_S = 15.0
_DEAD_RECKONS_S = 1.0
_OLDEST_PLACE_NS = 5 * _S
# Before the filter has started it takes no origin.
_FILTER_STARTS_NS = 8 * _S
_WEEK_MS = 604_800_000

_ATTITUDE, _VELOCITIES, _HEIGHT = 0x01, 0x02 | 0x04, 0x20
_POSITION = 0x08 | 0x10 | 0x200  # relative, absolute, predicted absolute
_CONSTANT_POSITION, _UNINITIALISED = 0x80, 0x400

SQUARE_ROOT_SINCE: Version = (4, 8, 0)  # pull request 32084
OWN_SIGMA_SINCE: Version = (4, 7, 0)  # pull request 29420: no longer that of a GPS that is there


def position_sigma_m(covariance: list[float], firmware: Version) -> float:
    """The one standard deviation that AP_VisualOdom makes of the 21 floats; 0 where it is told "unknown"."""
    c = [covariance[0], covariance[6], covariance[11]]
    if math.isnan(c[0]):
        return 0.0
    if firmware >= SQUARE_ROOT_SINCE:
        total = sum(c)
        return math.sqrt(max(total, 0.0)) if not math.isnan(total) else math.nan
    return float(np.cbrt(sum(v * v for v in c)))


def yaw_sigma_rad(covariance: list[float], firmware: Version) -> float:
    """The one standard deviation that it makes of the three angles; NaN where one is told none."""
    c = [covariance[15], covariance[18], covariance[20]]
    if math.isnan(covariance[0]):
        return 0.0
    return math.sqrt(max(sum(c), 0.0)) if firmware >= SQUARE_ROOT_SINCE else float(np.cbrt(sum(v * v for v in c)))


class ArduPilot(Estimator):
    """EKF3."""

    MESSAGES = frozenset({
        "ODOMETRY", "VISION_POSITION_ESTIMATE", "GLOBAL_VISION_POSITION_ESTIMATE", "GLOBAL_POSITION_SENSOR",
        "GPS_INPUT",
    })  # fmt: skip
    COMMANDS = frozenset({dialect.MAV_CMD_SET_EKF_SOURCE_SET, dialect.MAV_CMD_EXTERNAL_POSITION_ESTIMATE})

    def __init__(self, options: AutopilotOptions, parameters: Parameters, frame: LocalFrame) -> None:
        super().__init__(options, parameters, frame, LeastRoundTrip())
        self._jitter, self._gps_jitter = JitterCorrection(), JitterCorrection()
        self.source_set = 1
        self._commanded = options.switching == "command"
        self._test_ratio = 0.0
        self._aiding: str | None = "GPS" if self._under_way else None
        self._counter: int | None = None
        self._last_stamp_ns: int | None = None
        self._heard_ns: int | None = None
        self._ignored_until_ns = 0
        self._shift_m = np.zeros(2)
        self._gps_week: int | None = None
        self._gps_input_ns: int | None = None

    # -- sources --------------------

    def _source(self, what: str) -> int:
        return int(self._parameters.active(f"EK3_SRC{self.source_set}_{what}"))

    def _receiver_works(self, boot_ns: int) -> bool:
        """Any receiver, our own in the guise of one included."""
        fed = self._gps_input_ns is not None and boot_ns - self._gps_input_ns < _S
        return self.has_gnss or fed

    def _switch(self, boot_ns: int) -> None:
        """What a script that switches sources does."""
        wanted = _GNSS if self._receiver_works(boot_ns) else _VISION
        sets = [n for n in (1, 2, 3) if self._parameters.active(f"EK3_SRC{n}_POSXY") == wanted]
        if sets and self.source_set != sets[0]:
            self.source_set = sets[0]
            self.texts.append((INFO, f"Using EKF Source Set {self.source_set}"))

    def _aid(self, gnss: GnssSample | None, boot_ns: int) -> None:
        if not self._commanded:
            self._switch(boot_ns)
        if gnss is not None:
            if self._frame.origin is None and boot_ns >= _FILTER_STARTS_NS and self._source("POSXY") == _GNSS:
                self._frame.origin = self._frame.geopoint(gnss.position_ned_m)
                self.texts.append((INFO, "EKF3 IMU0 origin set"))
            self._gnss(gnss.position_ned_m[:2], gnss.sigma_m, boot_ns, boot_ns)
            if self._source("POSZ") == _GNSS:
                self._fuse_height(float(gnss.position_ned_m[2]), 1.5 * gnss.sigma_m)
            if self._source("VELXY") == _GNSS:
                sigma = max(gnss.sigma_m_s, self._parameters.active("EK3_VELNE_M_NSE"))
                believed = self._dead_reckoned[:2] + self.filter.drift_m_s if self._dead_reckoned is not None else 0.0
                self.filter.correct_velocity(gnss.velocity_ned_m_s[:2] - believed, sigma**2)
        if self._aiding is not None and not self._fused_within(boot_ns, _STOPS_AIDING_S):
            self._aiding = None
            self.texts.append((INFO, "EKF3 IMU0 stopped aiding"))

    def _gnss(
        self, position: FloatArray, sigma_m: float, capture_ns: int, boot_ns: int
    ) -> tuple[Verdict, float | None]:
        if self._source("POSXY") != _GNSS:
            return Verdict.STANDBY, None
        sigma_m = max(sigma_m, self._parameters.active("EK3_POSNE_M_NSE"))
        return self._fuse(position, sigma_m, capture_ns, boot_ns, "GPS")

    def _fuse(
        self, position: FloatArray, sigma_m: float, capture_ns: int, boot_ns: int, source: str, reset: bool = False
    ) -> tuple[Verdict, float | None]:
        """Gate, fuse or reset; position (2,) at its capture."""
        found = self.filter.innovation(position, capture_ns, boot_ns)
        if found is None:
            return Verdict.TOO_OLD, None
        length = found.length_m
        begins = self._aiding is None
        if begins:
            self._aiding = source
            name = "GPS" if source == "GPS" else "external nav data"
            self.texts.append((INFO, f"EKF3 IMU0 is using {name}"))
        if begins or reset:
            self._reset(found, sigma_m**2, boot_ns)
            return Verdict.RESET, length
        gate = max(1.0, self._parameters.active("EK3_POS_I_GATE") / 100.0)
        variance = sigma_m**2
        # EKF3 sums over both axes: |innovation|^2 against gate^2 (varN + varE).
        limit = gate**2 * float(np.sum(found.variance_m2 + variance))
        self._test_ratio = length**2 / limit
        radius = self._parameters.active("EK3_GLITCH_RAD")
        if self._test_ratio > 1.0 and radius <= 0.0:
            # Nothing is refused, but weighed down until it passes.
            variance += (length**2 / gate**2 - limit / gate**2) / 2.0
            self._test_ratio = 1.0
        if self._test_ratio > 1.0:
            timeout_s = self.options.filter.timeout_s + (3.0 if self._source("VELXY") != 0 else 0.0)
            if self.last_fused_ns is None:
                self.last_fused_ns = boot_ns
            if boot_ns - self.last_fused_ns <= timeout_s * _S:
                return Verdict.GATED, length
            self._reset(found, (0.5 * radius) ** 2, boot_ns)
            return Verdict.TIMEOUT_RESET, length
        self.filter.correct(found, variance)
        self.last_fused_ns = boot_ns
        return Verdict.FUSED, length

    def _reset(self, innovation: Innovation, variance_m2: float, boot_ns: int) -> None:
        """ResetPositionNE."""
        self.filter.reset(innovation.difference_m, variance_m2)
        self.last_fused_ns = boot_ns
        self._test_ratio = 0.0

    # -- what it hears --------------------

    def hear(self, message: Message, boot_ns: int) -> int | None:
        kind = message.get_type()
        if kind == "ODOMETRY":
            self._odometry(message, boot_ns)
        elif kind in ("VISION_POSITION_ESTIMATE", "GLOBAL_VISION_POSITION_ESTIMATE"):
            position = np.array([message.x, message.y, message.z])
            self._vision(
                kind, message.usec, position, message.covariance, message.reset_counter, 0, boot_ns, message.yaw
            )
        elif kind == "GLOBAL_POSITION_SENSOR":
            why = "no release of ArduPilot has a handler for it"
            self._record(kind, boot_ns, self._place(message.lat, message.lon), Verdict.UNHEARD, why)
        elif kind == "GPS_INPUT":
            self._gps_input(message, boot_ns)
        elif message.command == dialect.MAV_CMD_SET_EKF_SOURCE_SET:
            return self._set_source_set(round(message.param1) if finite(message.param1) else 0)
        elif kind == "COMMAND_INT":
            return self._external_position(message, boot_ns)
        else:
            return int(dialect.MAV_RESULT_COMMAND_INT_ONLY)
        return None

    def set_origin(self, origin: Geopoint, boot_ns: int) -> bool:
        if self._frame.origin is not None or boot_ns < _FILTER_STARTS_NS:
            return False
        self._frame.origin = origin
        self.texts.append((INFO, "EKF3 IMU0 origin set"))
        return True

    def _set_source_set(self, number: int) -> int:
        if number not in (1, 2, 3):
            return int(dialect.MAV_RESULT_DENIED)
        self.source_set, self._commanded = number, True
        return int(dialect.MAV_RESULT_ACCEPTED)

    def _odometry(self, m: Message, boot_ns: int) -> None:
        position = np.array([m.x, m.y, m.z])
        if m.frame_id != dialect.MAV_FRAME_LOCAL_FRD or m.child_frame_id != dialect.MAV_FRAME_BODY_FRD:
            why = f"frame_id is {m.frame_id} and child_frame_id {m.child_frame_id}; only 20 and 12 are taken"
            self._record("ODOMETRY", boot_ns, position, Verdict.WRONG_FRAME, why, counter=m.reset_counter)
            return
        if m.vx == 0.0 and m.vy == 0.0 and m.vz == 0.0:
            self.counts["zero_velocity"] += 1  # says that it stands still, where it means that it does not know
        yaw = rotation.to_euler(rotation.from_quaternion(m.q))[2] if finite(*m.q) and any(m.q) else math.nan
        taken = self._vision(
            "ODOMETRY", m.time_usec, position, m.pose_covariance, m.reset_counter, m.quality, boot_ns, yaw
        )
        velocity = np.array([m.vx, m.vy, m.vz])
        if taken and self._source("VELXY") == _VISION and np.isfinite(velocity).all():
            assert self._dead_reckoned is not None
            error = (self.ned_from_body @ velocity - self._dead_reckoned)[:2] - self.filter.drift_m_s
            self.filter.correct_velocity(error, self._parameters.active("VISO_VEL_M_NSE") ** 2)

    def _capture_ns(self, stamp_us: int, boot_ns: int) -> int:
        """When a stamp was, as far as this knows; see `FilterOptions.stamps`."""
        if self.options.filter.stamps == "timesync":
            return self.timesync.correct_ns(stamp_us * 1000, boot_ns)
        delayed = self._jitter.correct_ns(stamp_us * 1000, boot_ns) - round(
            self._parameters.active("VISO_DELAY_MS") * _MS
        )
        return min(boot_ns, max(delayed, boot_ns - _BUFFER_NS))

    def _sigma_m(self, covariance: list[float]) -> float:
        """Of one axis, as AP_VisualOdom and then EKF3 bound it."""
        sigma = position_sigma_m(covariance, self.options.firmware)
        if math.isnan(sigma):
            # AP_InternalError constraining_nan: constrain_float gives the middle of the range.
            self.counts["internal_error"] += 1
            sigma = 50.1
        sigma = min(max(sigma, self._parameters.active("VISO_POS_M_NSE")), 100.0)
        if self.options.firmware >= OWN_SIGMA_SINCE:
            return sigma
        if self.has_gnss:
            # Issue 24020: that of a GPS that is connected and well.
            return min(max(self.options.sensors.gnss_m, self._parameters.active("EK3_POSNE_M_NSE")), 100.0)
        return min(sigma, 10.0)

    def _vision(
        self, message: str, stamp_us: int, public: FloatArray, covariance: list[float], counter: int, quality: int,
        boot_ns: int, yaw_rad: float,
    ) -> bool:  # fmt: skip
        """AP_VisualOdom and writeExtNavData. True if it came as far as the filter's buffer."""
        capture_ns = self._capture_ns(stamp_us, boot_ns)  # even what is not taken teaches the relation of the clocks
        position = self._frame.inner_from_public(public)
        kind = int(self._parameters.active("VISO_TYPE"))
        known, sigma, innovation = self._counter, 0.0, None
        changed = known is not None and counter != known
        if kind in (_VISO_MAVLINK, _VISO_T265, _VISO_VOXL):
            self._heard_ns, self._counter = boot_ns, counter
            sigma = self._sigma_m(covariance)
            if changed and kind == _VISO_T265:
                self._ignored_until_ns = boot_ns + _T265_IGNORED_NS
        refused = self._refusal(kind, quality, position, capture_ns, boot_ns)
        if refused is not None:
            verdict, why = refused
        else:
            self._last_stamp_ns = capture_ns
            scale = self._parameters.active("VISO_SCALE")
            measured = (position * scale - self._lever_arm("VISO_POS_X", "VISO_POS_Y", "VISO_POS_Z"))[:2]
            if changed and kind == _VISO_VOXL:
                self._shift_m = self.filter.position_m - measured
                verdict, why = Verdict.REALIGNED, "VISO_TYPE 3 goes on from where the vehicle was"
            elif self._source("POSXY") != _VISION:
                verdict, why = Verdict.STANDBY, f"EK3_SRC{self.source_set}_POSXY is {self._source('POSXY')}"
            else:
                verdict, innovation = self._fuse(
                    measured + self._shift_m, sigma, capture_ns, boot_ns, "vision", changed
                )
                why = "" if verdict is not Verdict.GATED else f"test ratio {self._test_ratio:.2f}"
            arm = self._lever_arm("VISO_POS_X", "VISO_POS_Y", "VISO_POS_Z")
            self._vision_besides(float(position[2] * scale - arm[2]), yaw_rad, covariance, sigma, capture_ns, boot_ns)
        self._record(
            message, boot_ns, position, verdict, why, capture_ns=capture_ns, sigma_m=sigma, counter=counter,
            innovation_m=innovation,
        )  # fmt: skip
        return refused is None

    def _vision_besides(
        self, down_m: float, yaw_rad: float, covariance: list[float], sigma_m: float, capture_ns: int, boot_ns: int
    ) -> None:
        """Height, with the sigma of the position, and heading, of a vision that was not refused."""
        age_s = (boot_ns - capture_ns) / _S
        if self._source("POSZ") == _VISION:
            self._fuse_height(down_m, sigma_m, age_s)
        if self._source("YAW") == _VISION:
            sigma = yaw_sigma_rad(covariance, self.options.firmware)
            sigma = _MOST_YAW_SIGMA / 2.0 if math.isnan(sigma) else sigma
            least = max(self._parameters.active("VISO_YAW_M_NSE"), _LEAST_YAW_SIGMA)
            self._fuse_heading(yaw_rad, min(max(sigma, least), _MOST_YAW_SIGMA), age_s)

    def _refusal(
        self, kind: int, quality: int, position: FloatArray, capture_ns: int, boot_ns: int
    ) -> tuple[Verdict, str] | None:
        """Why a measurement does not come as far as the filter."""
        least = int(self._parameters.active("VISO_QUAL_MIN"))
        last = self._last_stamp_ns
        refused: tuple[Verdict, str] | None = None
        if kind not in (_VISO_MAVLINK, _VISO_T265, _VISO_VOXL):
            refused = Verdict.DISABLED, f"VISO_TYPE is {kind}"
        elif quality < least:
            refused = Verdict.FAILED_QUALITY, f"quality {quality} is below VISO_QUAL_MIN {least}"
        elif not np.isfinite(position).all():
            refused = Verdict.NOT_FINITE, "the position is not a number"
        elif boot_ns < self._ignored_until_ns:
            refused = Verdict.IGNORED, "VISO_TYPE 2 takes nothing for a second after a reset"
        elif last is not None and 0 <= capture_ns - last < _EXT_NAV_INTERVAL_NS:
            refused = Verdict.TOO_FAST, "less than 20 ms after the one before"
        return refused

    def _gps_input(self, m: Message, boot_ns: int) -> None:
        """AP_GPS_MAV, without the receiver's own delay before it is believed."""
        position = self._place(m.lat, m.lon)
        name = f"GPS{m.gps_id + 1}_TYPE"
        if name not in self._parameters:
            name = "GPS_TYPE" if m.gps_id == 0 else "GPS_TYPE2"

        def record(verdict: Verdict, why: str = "", **more: float | int | None) -> None:
            self._record("GPS_INPUT", boot_ns, position, verdict, why, **more)  # type: ignore[arg-type]

        if m.gps_id not in (0, 1) or self._parameters.active(name) != _GPS_MAVLINK:
            record(Verdict.DISABLED, f"{name} is not {_GPS_MAVLINK}")
            return
        if m.fix_type < dialect.GPS_FIX_TYPE_3D_FIX:
            record(Verdict.FAILED_QUALITY, f"fix type {m.fix_type}")
            return
        capture_ns = boot_ns
        if m.time_week > 0:
            self._gps_week = m.time_week if self._gps_week is None else self._gps_week
            stamp_ms = (m.time_week - self._gps_week) * _WEEK_MS + m.time_week_ms
            capture_ns = self._gps_jitter.correct_ns(stamp_ms * _MS, boot_ns)
        delay = f"GPS{m.gps_id + 1}_DELAY_MS"
        if delay not in self._parameters:
            delay = "GPS_DELAY_MS" if m.gps_id == 0 else "GPS_DELAY_MS2"
        capture_ns -= round(self._parameters.active(delay) * _MS)
        without = m.ignore_flags & dialect.GPS_INPUT_IGNORE_FLAG_HORIZONTAL_ACCURACY
        sigma = min(float(m.horiz_accuracy) if finite(m.horiz_accuracy) and not without else 0.0, 100.0)
        if self.has_gnss:
            record(Verdict.STANDBY, "another receiver has a fix", capture_ns=capture_ns, sigma_m=sigma)
            return
        self._gps_input_ns = boot_ns
        verdict, innovation = self._gnss(position[:2], sigma, capture_ns, boot_ns)
        record(verdict, capture_ns=capture_ns, sigma_m=sigma, innovation_m=innovation)

    def _external_position(self, m: Message, boot_ns: int) -> int:
        """MAV_CMD_EXTERNAL_POSITION_ESTIMATE: EKF3's setLatLng."""
        if not finite(m.param1, m.param2):
            return int(dialect.MAV_RESULT_DENIED)
        position = self._place(m.x, m.y)
        stamp_ns = self._jitter.correct_ns(round(m.param1 * _S), boot_ns)
        capture_ns = max(min(stamp_ns - round(m.param2 * _S), boot_ns), boot_ns - _OLDEST_PLACE_NS)
        sigma = max(m.param3 if finite(m.param3) else 0.0, self._parameters.active("EK3_POSNE_M_NSE"))
        name = "EXTERNAL_POSITION_ESTIMATE"
        if self._fused_within(boot_ns, _DEAD_RECKONS_S):
            self._record(name, boot_ns, position, Verdict.STANDBY, "a position was fused within a second")
            return int(dialect.MAV_RESULT_FAILED)
        found = self.filter.innovation(position[:2], capture_ns, boot_ns)
        if found is None:
            self._record(name, boot_ns, position, Verdict.TOO_OLD, capture_ns=capture_ns)
            return int(dialect.MAV_RESULT_FAILED)
        # It is no aiding: the time since the last position goes on.
        self.filter.reset(found.difference_m, sigma**2)
        self._record(
            name, boot_ns, position, Verdict.RESET, capture_ns=capture_ns, sigma_m=sigma, innovation_m=found.length_m
        )
        return int(dialect.MAV_RESULT_ACCEPTED)

    # -- what it says --------------------

    def vision_health(self, boot_ns: int) -> tuple[bool, bool]:
        """Whether SYS_STATUS shows visual odometry, and whether it calls it healthy."""
        present = self._parameters.active("VISO_TYPE") != 0
        return present, present and self._heard_ns is not None and boot_ns - self._heard_ns < _HEALTHY_NS

    def status(self, boot_ns: int) -> Message:
        if boot_ns < _FILTER_STARTS_NS:
            flags = _UNINITIALISED
        else:
            aided = self._aiding is not None and self._fused_within(boot_ns, self.options.filter.timeout_s)
            flags = _ATTITUDE | _VELOCITIES | _HEIGHT
            flags |= _POSITION if aided and self._frame.origin is not None else 0
            flags |= 0 if self._aiding is not None else _CONSTANT_POSITION
        return dialect.MAVLink_ekf_status_report_message(
            flags=flags, velocity_variance=0.1, pos_horiz_variance=math.sqrt(self._test_ratio), pos_vert_variance=0.1,
            compass_variance=0.1, terrain_alt_variance=0.0,
        )  # fmt: skip
