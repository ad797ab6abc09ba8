"""The simulated autopilot as a step function: boot time and truth go in, messages come out."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ortholoc_edge.geometry import rotation
from ortholoc_edge.geometry.arrays import FloatArray
from ortholoc_sim.autopilot.ardupilot import ArduPilot
from ortholoc_sim.autopilot.dialect import Message, dialect
from ortholoc_sim.autopilot.estimator import Estimator, finite, is_origin
from ortholoc_sim.autopilot.frame import LocalFrame
from ortholoc_sim.autopilot.mission import Mission
from ortholoc_sim.autopilot.options import Airframe, AutopilotOptions
from ortholoc_sim.autopilot.parameters import Parameters, ParameterServer
from ortholoc_sim.autopilot.position_filter import PositionFilter
from ortholoc_sim.autopilot.px4 import Px4
from ortholoc_sim.autopilot.records import VisionRecord
from ortholoc_sim.autopilot.sensors import SensorSuite
from ortholoc_sim.site import Geopoint, Site
from ortholoc_sim.vehicle import Truth

_MS, _S = 1_000_000, 1_000_000_000
# MAV_MODE_FLAG: armed, stabilised, guided, own modes; PX4 adds the one for automatic flight.
_BASE_MODE = {"ardupilot": 217, "px4": 221}
# Flying a mission: Copter's mode 3, Plane's 10; PX4's main mode 4 with sub mode 4.
_MISSION_MODE = {("ardupilot", "multirotor"): 3, ("ardupilot", "fixed-wing"): 10}
_PX4_MISSION_MODE = 4 << 16 | 4 << 24
# ArduPilot serves no stream faster; PX4 does.
_LEAST_INTERVAL_NS = {"ardupilot": _S // 50, "px4": _S // 250}
# param6 of MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN by which ArduPilot restarts in flight.
_FORCED_REBOOT = 20190226

_ID = {name: getattr(dialect, f"MAVLINK_MSG_ID_{name}") for name in (
    "SYS_STATUS", "SYSTEM_TIME", "GPS_RAW_INT", "ATTITUDE", "ATTITUDE_QUATERNION", "LOCAL_POSITION_NED",
    "GLOBAL_POSITION_INT", "MISSION_CURRENT", "GPS_GLOBAL_ORIGIN", "VFR_HUD", "AUTOPILOT_VERSION",
    "EKF_STATUS_REPORT", "ESTIMATOR_STATUS", "HOME_POSITION", "EXTENDED_SYS_STATE", "HEARTBEAT",
    "GIMBAL_DEVICE_ATTITUDE_STATUS",
)}  # fmt: skip

# Unasked, with ``streams_by_default``: an ArduPilot whose SRn_ parameters are set; PX4's mode "onboard", of which this
# is the part that there is here. Hz.
_DEFAULT_RATES = {
    "ardupilot": {
        "ATTITUDE_QUATERNION": 30.0, "LOCAL_POSITION_NED": 20.0, "GLOBAL_POSITION_INT": 5.0, "GPS_RAW_INT": 2.0,
        "SYSTEM_TIME": 1.0, "GPS_GLOBAL_ORIGIN": 0.2,
    },
    "px4": {
        "ATTITUDE": 100.0, "ATTITUDE_QUATERNION": 50.0, "LOCAL_POSITION_NED": 30.0, "GLOBAL_POSITION_INT": 50.0,
        "GPS_RAW_INT": 5.0, "SYSTEM_TIME": 1.0, "GPS_GLOBAL_ORIGIN": 1.0, "ESTIMATOR_STATUS": 1.0,
        "EXTENDED_SYS_STATE": 5.0, "HOME_POSITION": 0.5, "SYS_STATUS": 5.0, "VFR_HUD": 10.0,
    },
}  # fmt: skip

# REQUEST_DATA_STREAM, which ArduPilot still obeys: message groups by MAV_DATA_STREAM.
_GROUPS = {
    dialect.MAV_DATA_STREAM_EXTENDED_STATUS: ("SYS_STATUS", "MISSION_CURRENT", "GPS_RAW_INT"),
    dialect.MAV_DATA_STREAM_POSITION: ("LOCAL_POSITION_NED", "GLOBAL_POSITION_INT"),
    dialect.MAV_DATA_STREAM_EXTRA1: ("ATTITUDE",),
    dialect.MAV_DATA_STREAM_EXTRA2: ("VFR_HUD",),
    dialect.MAV_DATA_STREAM_EXTRA3: ("SYSTEM_TIME", "EKF_STATUS_REPORT"),
}
_PARAMETER_MESSAGES = frozenset({"PARAM_REQUEST_READ", "PARAM_REQUEST_LIST", "PARAM_SET"})


# MAV_RESULT, and a message that goes with it.
_Answer = tuple[int, Message | None]


class AutopilotCore:
    """Sensors, filter and protocol; the owner steps it and carries its messages.

    Attributes:
        sensors: for the owner to let GNSS fail (see `gnss`, `gnss_offset_m`, `gnss_noise`).
        estimator: the firmware's filter.
        mission: the route as others see it; the owner flies it.
        parameters: the table.
        counts: of messages received (by name), and of ``zero_velocity``, ``internal_error`` and the like.
    """

    def __init__(self, options: AutopilotOptions, site: Site, truth: Truth, airframe: Airframe = "multirotor") -> None:
        """Raises: ValueError if ``site`` has another autopilot's formula, or a parameter that is given is not there."""
        if site.earth != options.stack:
            raise ValueError(
                f"site's local frame is that of {site.earth}, the autopilot is {options.stack}; "
                f"make it with Site(..., earth={options.stack!r})"
            )
        self.options, self._site, self._airframe = options, site, airframe
        self.parameters = Parameters(options)
        self._frame = LocalFrame(site, options.origin == "gnss")
        self._parameter_server = ParameterServer(self.parameters, options.stack)
        self.mission = Mission(options.stack, self._frame)
        self.sensors = SensorSuite(options.sensors, options.seed, truth)
        self._home = self._frame.origin
        self._true_m = site.autopilot_from_ned(truth.position_ned_m)
        self._truth = truth
        self._rates = truth.rates_body_rad_s
        self._shadow: FloatArray | None = None
        self._shadow_drift = np.zeros(2)
        self._boot_ns = 0
        self._rebooted_ns = 0
        self._start()
        self.estimator.filter.reckoned_m = self._true_m[:2].copy()
        self.estimator.ned_from_body = truth.ned_from_body
        self.estimator.velocity_ned_m_s = truth.velocity_ned_m_s.copy()
        self.estimator.down_m = float(self._true_m[2])

    def _start(self) -> None:
        """What begins anew when the autopilot does."""
        self.estimator: Estimator = (Px4 if self.options.stack == "px4" else ArduPilot)(
            self.options, self.parameters, self._frame
        )
        self.counts = self.estimator.counts
        self._due: dict[int, int] = {}
        rates = _DEFAULT_RATES[self.options.stack] if self.options.streams_by_default else {}
        self._interval = {_ID[name]: round(_S / rate) for name, rate in rates.items()}
        self._next_heartbeat_ns = self._next_timesync_ns = 0
        self._builders: dict[int, Callable[[], Message | None]] = {
            _ID["SYS_STATUS"]: self._sys_status,
            _ID["SYSTEM_TIME"]: self._system_time,
            _ID["ATTITUDE"]: self._attitude,
            _ID["ATTITUDE_QUATERNION"]: self._attitude_quaternion,
            _ID["LOCAL_POSITION_NED"]: self._local_position,
            _ID["GLOBAL_POSITION_INT"]: self._global_position,
            _ID["GPS_RAW_INT"]: self._gps_raw,
            _ID["GPS_GLOBAL_ORIGIN"]: self._global_origin,
            _ID["HOME_POSITION"]: self._home_position,
            _ID["EXTENDED_SYS_STATE"]: self._extended_state,
            _ID["MISSION_CURRENT"]: self.mission.current_message,
            _ID["VFR_HUD"]: self._hud,
            _ID["AUTOPILOT_VERSION"]: self._version,
            _ID["HEARTBEAT"]: self._heartbeat,
        }
        self._commands: dict[int, Callable[[Message], _Answer]] = {
            dialect.MAV_CMD_SET_MESSAGE_INTERVAL: self._on_set_interval,
            dialect.MAV_CMD_GET_MESSAGE_INTERVAL: self._on_get_interval,
            dialect.MAV_CMD_REQUEST_MESSAGE: self._on_request,
            dialect.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES: self._on_request,
            dialect.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN: self._on_reboot,
            dialect.MAV_CMD_DO_SET_MODE: self._on_mode,
            dialect.MAV_CMD_MISSION_START: self._on_mode,
            dialect.MAV_CMD_COMPONENT_ARM_DISARM: self._on_arm,
        }
        report = "ESTIMATOR_STATUS" if self.options.stack == "px4" else "EKF_STATUS_REPORT"
        self._builders[_ID[report]] = lambda: self.estimator.status(self._boot_ns)
        gimbal = self.options.gimbal
        if gimbal is not None:
            self._builders[_ID["GIMBAL_DEVICE_ATTITUDE_STATUS"]] = lambda: gimbal.report(self._boot_ns)

    # -- what it believes --------------------

    @property
    def gnss(self) -> bool:
        """Whether GNSS has a fix; the owner sets it."""
        return self.sensors.gnss.works

    @gnss.setter
    def gnss(self, works: bool) -> None:
        self.sensors.gnss.works = works

    @property
    def gnss_offset_m(self) -> FloatArray:
        """(3,) NED m by which a spoofer leads the receiver away; the owner sets it."""
        return self.sensors.gnss.offset_ned_m

    @gnss_offset_m.setter
    def gnss_offset_m(self, offset: FloatArray) -> None:
        self.sensors.gnss.offset_ned_m = offset

    @property
    def gnss_noise(self) -> float:
        """The receiver's errors times this; the owner sets it."""
        return self.sensors.gnss.noise

    @gnss_noise.setter
    def gnss_noise(self, times: float) -> None:
        self.sensors.gnss.noise = times

    @property
    def filter(self) -> PositionFilter:
        """The estimator's."""
        return self.estimator.filter

    @property
    def vision(self) -> list[VisionRecord]:
        """Every measurement from outside, with what became of it."""
        return self.estimator.vision

    @property
    def position_ned_m(self) -> FloatArray:
        """(3,) its estimate, from the site's origin, by its own earth model."""
        return np.append(self.filter.position_m, self.estimator.down_m)

    @property
    def velocity_ned_m_s(self) -> FloatArray:
        """(3,) its estimate."""
        return self.estimator.velocity_ned_m_s

    @property
    def ned_from_body(self) -> FloatArray:
        """(3, 3) its estimate."""
        return self.estimator.ned_from_body

    @property
    def true_position_m(self) -> FloatArray:
        """(3,) where it really is, in its own frame."""
        return self._true_m

    def public_from_inner(self, position_ned_m: FloatArray) -> FloatArray:
        """(3,) a position of the site's frame as others see it: from the EKF origin."""
        return self._frame.public_from_inner(position_ned_m)

    def route(self) -> FloatArray:
        """(N, 3) its mission from where it believes to be, in its own frame; for the owner to fly."""
        home = self._home or self._site.origin
        return self.mission.route(home, self.position_ned_m)

    @property
    def dead_reckoned_m(self) -> FloatArray | None:
        """(2,) what it would believe had it got no vision since GNSS was lost; None while there is GNSS."""
        return None if self._shadow is None else self._shadow.copy()

    @property
    def synchronised(self) -> bool:
        """Whether it relates the companion's stamps to its own time."""
        return self.estimator.timesync.synchronised

    # -- time --------------------

    @property
    def rebooted_ns(self) -> int:
        """Boot time of the owner's when it restarted last; 0 if it never did."""
        return self._rebooted_ns

    def step(self, boot_ns: int, truth: Truth, dt_s: float) -> list[Message]:
        """Move sensors and filter to ``boot_ns``; returns what it sends.

        Args:
            boot_ns: since the autopilot was switched on first; its own clock begins anew when it restarts.
            truth: of the simulation's NED.
        """
        self._boot_ns = boot_ns = boot_ns - self._rebooted_ns
        self._truth = truth
        self._true_m = self._site.autopilot_from_ned(truth.position_ned_m)
        readings = self.sensors.step(boot_ns, truth, self._true_m, dt_s, self.estimator.heading_offset_rad)
        self._rates = readings.rates_rad_s
        self.estimator.step(readings, boot_ns, dt_s)
        if self.gnss:
            self._shadow = None
        elif self._shadow is None:
            self._shadow, self._shadow_drift = self.filter.position_m.copy(), self.filter.drift_m_s.copy()
        else:
            self._shadow = self._shadow + (readings.velocity_ned_m_s[:2] + self._shadow_drift) * dt_s
        if self._home is None:
            self._home = self._frame.origin
        return self._due_messages(boot_ns)

    def reboot(self) -> None:
        """Restart: its clock, streams and filter begin anew, parameters that wait for it take effect. The mission
        stays. The vehicle is taken to stay in the air meanwhile, and where it believed to be."""
        self._rebooted_ns += self._boot_ns
        self._boot_ns = 0
        self._frame.origin = None
        self.parameters.reboot()
        before, records = self.estimator, self.estimator.vision
        self._start()
        self.estimator.vision.extend(records)
        self.counts.update(before.counts)
        self.estimator.filter.reckoned_m = before.filter.position_m
        self.estimator.ned_from_body = before.ned_from_body
        self.estimator.velocity_ned_m_s, self.estimator.down_m = before.velocity_ned_m_s, before.down_m
        self.sensors.gnss.restart()
        self.counts["reboots"] += 1

    def _due_messages(self, boot_ns: int) -> list[Message]:
        out: list[Message] = []
        if boot_ns >= self._next_heartbeat_ns:
            self._next_heartbeat_ns = boot_ns + _S
            out.append(self._heartbeat())
        if boot_ns >= self._next_timesync_ns:
            # PX4 goes on at 10 Hz, ArduPilot slows down.
            fast = self.options.stack == "px4" or not self.synchronised
            self._next_timesync_ns = boot_ns + (_S // 10 if fast else _S)
            out.append(self.estimator.timesync.ask(boot_ns))
        for kind, interval in self._interval.items():
            due = self._due.get(kind, 0)
            if boot_ns >= due:
                # Kept on its raster, unless it has fallen behind.
                self._due[kind] = due + interval if boot_ns - due < interval else boot_ns + interval
                message = self._builders[kind]()
                if message is not None:
                    out.append(message)
        out += self._parameter_server.step(boot_ns)
        out += self.mission.step(boot_ns)
        out += [
            dialect.MAVLink_statustext_message(severity=severity, text=text.encode("ascii", "replace")[:50])
            for severity, text in self.estimator.texts
        ]
        self.estimator.texts.clear()
        return out

    # -- what it hears --------------------

    def handle(self, message: Message, boot_ns: int) -> list[Message]:
        """Take in a message that arrived at ``boot_ns``; returns the answers."""
        boot_ns = boot_ns - self._rebooted_ns
        name = message.get_type()
        self.counts[name] += 1
        if not self._is_for_us(message):
            return []
        answers: list[Message] = []
        if name == "TIMESYNC":
            if message.tc1 == 0:
                answers = [dialect.MAVLink_timesync_message(tc1=boot_ns, ts1=message.ts1)]
            else:
                self.estimator.timesync.answered(message, boot_ns)
        elif name == "PING":
            if message.target_system == 0 and message.target_component == 0:
                answers = [self._pong(message)]
        elif name in ("COMMAND_LONG", "COMMAND_INT"):
            answers = self._command(message, boot_ns)
        elif name in self.estimator.MESSAGES:
            self.estimator.hear(message, boot_ns)
        elif name in _PARAMETER_MESSAGES:
            answers = self._parameter_server.handle(message)
        elif name in Mission.MESSAGES:
            answers = self.mission.handle(message, boot_ns)
        elif name == "SET_GPS_GLOBAL_ORIGIN":
            answers = self._set_origin(message, boot_ns)
        elif name == "REQUEST_DATA_STREAM" and self.options.stack == "ardupilot":
            self._request_streams(message)
        return answers

    def _is_for_us(self, message: Message) -> bool:
        """Whether it is addressed to this autopilot, or to all."""
        system, component = getattr(message, "target_system", 0), getattr(message, "target_component", 0)
        return system in (0, self.options.system_id) and component in (0, dialect.MAV_COMP_ID_AUTOPILOT1)

    @staticmethod
    def _pong(message: Message) -> Message:
        return dialect.MAVLink_ping_message(
            time_usec=message.time_usec, seq=message.seq, target_system=message.get_srcSystem(),
            target_component=message.get_srcComponent(),
        )  # fmt: skip

    def _set_origin(self, message: Message, boot_ns: int) -> list[Message]:
        origin = Geopoint(message.latitude / 1e7, message.longitude / 1e7, message.altitude / 1e3)
        if not is_origin(message) or not self.estimator.set_origin(origin, boot_ns):
            self.counts["origin_refused"] += 1
            return []
        return [m for m in (self._global_origin(),) if m is not None]

    def _request_streams(self, message: Message) -> None:
        wanted = _GROUPS if message.req_stream_id == dialect.MAV_DATA_STREAM_ALL else (message.req_stream_id,)
        for group in wanted:
            for name in _GROUPS.get(group, ()):
                runs = message.start_stop and message.req_message_rate
                self._set_interval(_ID[name], 1e6 / message.req_message_rate if runs else -1.0)

    def _set_interval(self, kind: int, interval_us: float) -> None:
        if interval_us <= 0:
            self._interval.pop(kind, None)
        else:
            self._interval[kind] = max(_LEAST_INTERVAL_NS[self.options.stack], round(interval_us * 1000))

    def _command(self, message: Message, boot_ns: int) -> list[Message]:
        number = message.command
        answer: Message | None = None
        if number in self.estimator.COMMANDS:
            result = self.estimator.hear(message, boot_ns)
        elif number in self._commands and not finite(message.param1):
            result = dialect.MAV_RESULT_DENIED
        elif number in self._commands:
            result, answer = self._commands[number](message)
        else:
            result = dialect.MAV_RESULT_UNSUPPORTED
        ack = dialect.MAVLink_command_ack_message(
            command=number, result=result, target_system=message.get_srcSystem(),
            target_component=message.get_srcComponent(),
        )  # fmt: skip
        return [ack] if answer is None else [ack, answer]

    def _on_set_interval(self, m: Message) -> _Answer:
        kind = round(m.param1)
        if kind not in self._builders or not finite(m.param2):
            return dialect.MAV_RESULT_FAILED, None
        self._set_interval(kind, m.param2)
        return dialect.MAV_RESULT_ACCEPTED, None

    def _on_get_interval(self, m: Message) -> _Answer:
        kind = round(m.param1)
        interval_us = self._interval[kind] // 1000 if kind in self._interval else -1 if kind in self._builders else 0
        answer = dialect.MAVLink_message_interval_message(message_id=kind, interval_us=interval_us)
        return dialect.MAV_RESULT_ACCEPTED, answer

    def _on_request(self, m: Message) -> _Answer:
        asked = m.command == dialect.MAV_CMD_REQUEST_MESSAGE
        build = self._builders.get(round(m.param1) if asked else _ID["AUTOPILOT_VERSION"])
        answer = build() if build is not None else None
        return (dialect.MAV_RESULT_FAILED if answer is None else dialect.MAV_RESULT_ACCEPTED), answer

    def _on_reboot(self, m: Message) -> _Answer:
        forced = m.get_type() == "COMMAND_LONG" and m.param6 == _FORCED_REBOOT
        if round(m.param1) != 1 or not forced:
            return dialect.MAV_RESULT_DENIED, None  # it flies
        self.reboot()
        return dialect.MAV_RESULT_ACCEPTED, None

    @staticmethod
    def _on_mode(m: Message) -> _Answer:
        """It flies its mission, and no other mode."""
        return dialect.MAV_RESULT_ACCEPTED, None

    @staticmethod
    def _on_arm(m: Message) -> _Answer:
        return (dialect.MAV_RESULT_ACCEPTED if round(m.param1) == 1 else dialect.MAV_RESULT_DENIED), None

    # -- what it says --------------------

    @property
    def _boot_ms(self) -> int:
        return self._boot_ns // _MS % 2**32

    def _heartbeat(self) -> Message:
        d = dialect
        px4 = self.options.stack == "px4"
        fixed_wing = self._airframe == "fixed-wing"
        return d.MAVLink_heartbeat_message(
            type=d.MAV_TYPE_FIXED_WING if fixed_wing else d.MAV_TYPE_QUADROTOR,
            autopilot=d.MAV_AUTOPILOT_PX4 if px4 else d.MAV_AUTOPILOT_ARDUPILOTMEGA,
            base_mode=_BASE_MODE[self.options.stack],
            custom_mode=_PX4_MISSION_MODE if px4 else _MISSION_MODE["ardupilot", self._airframe],
            system_status=d.MAV_STATE_ACTIVE,
            mavlink_version=3,
        )

    def _sys_status(self) -> Message:
        d = dialect
        flying = (
            d.MAV_SYS_STATUS_SENSOR_3D_GYRO | d.MAV_SYS_STATUS_SENSOR_3D_ACCEL | d.MAV_SYS_STATUS_SENSOR_3D_MAG
            | d.MAV_SYS_STATUS_SENSOR_ABSOLUTE_PRESSURE | d.MAV_SYS_STATUS_AHRS
        )  # fmt: skip
        # A fence that there is not is not breached.
        present, health = flying | d.MAV_SYS_STATUS_SENSOR_GPS, flying | d.MAV_SYS_STATUS_GEOFENCE
        health |= d.MAV_SYS_STATUS_SENSOR_GPS if self.estimator.has_gnss else 0
        shown, healthy = self.estimator.vision_health(self._boot_ns)
        present |= d.MAV_SYS_STATUS_SENSOR_VISION_POSITION if shown else 0
        health |= d.MAV_SYS_STATUS_SENSOR_VISION_POSITION if healthy else 0
        return d.MAVLink_sys_status_message(
            onboard_control_sensors_present=present, onboard_control_sensors_enabled=present,
            onboard_control_sensors_health=health, load=250, voltage_battery=15800, current_battery=1200,
            battery_remaining=80, drop_rate_comm=0, errors_comm=0, errors_count1=0, errors_count2=0, errors_count3=0,
            errors_count4=0,
        )  # fmt: skip

    def _attitude_quaternion(self) -> Message:
        q = rotation.to_quaternion(self.ned_from_body)
        p, q_rate, r = (float(v) for v in self._rates)
        return dialect.MAVLink_attitude_quaternion_message(
            time_boot_ms=self._boot_ms, q1=q[0], q2=q[1], q3=q[2], q4=q[3], rollspeed=p, pitchspeed=q_rate, yawspeed=r
        )

    def _attitude(self) -> Message:
        roll, pitch, yaw = rotation.to_euler(self.ned_from_body)
        p, q_rate, r = (float(v) for v in self._rates)
        return dialect.MAVLink_attitude_message(
            time_boot_ms=self._boot_ms, roll=roll, pitch=pitch, yaw=yaw, rollspeed=p, pitchspeed=q_rate, yawspeed=r
        )

    def _local_position(self) -> Message | None:
        if self._frame.origin is None and self.options.stack == "ardupilot":
            return None  # not before it has somewhere to count from
        x, y, z = (float(v) for v in self._frame.public_from_inner(self.position_ned_m))
        vx, vy, vz = (float(v) for v in self.velocity_ned_m_s)
        return dialect.MAVLink_local_position_ned_message(
            time_boot_ms=self._boot_ms, x=x, y=y, z=z, vx=vx, vy=vy, vz=vz
        )

    def _global_position(self) -> Message | None:
        if self._frame.origin is None:
            return None
        point = self._frame.geopoint(self.position_ned_m)
        home_m = self._home.height_amsl_m if self._home is not None else 0.0
        vx, vy, vz = (round(float(v) * 100) for v in self.velocity_ned_m_s)
        return dialect.MAVLink_global_position_int_message(
            time_boot_ms=self._boot_ms, lat=round(point.lat_deg * 1e7), lon=round(point.lon_deg * 1e7),
            alt=round(point.height_amsl_m * 1e3), relative_alt=round((point.height_amsl_m - home_m) * 1e3), vx=vx,
            vy=vy, vz=vz, hdg=round(self._heading_deg() * 100) % 36000,
        )  # fmt: skip

    def _heading_deg(self) -> float:
        return float(np.rad2deg(rotation.to_euler(self.ned_from_body)[2]) % 360.0)

    def _gps_raw(self) -> Message:
        receiver = self.sensors.gnss
        point = self._site.geopoint_from_autopilot(receiver.position_ned_m)
        sigma_mm = round(1e3 * receiver.sigma_m)
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

    def _global_origin(self) -> Message | None:
        origin = self._frame.origin
        if origin is None:
            return None
        return dialect.MAVLink_gps_global_origin_message(
            latitude=round(origin.lat_deg * 1e7), longitude=round(origin.lon_deg * 1e7),
            altitude=round(origin.height_amsl_m * 1e3), time_usec=self._boot_ns // 1000,
        )  # fmt: skip

    def _home_position(self) -> Message | None:
        home = self._home
        if home is None:
            return None
        x, y, z = (float(v) for v in self._frame.public_from_inner(self._frame.inner(home)))
        return dialect.MAVLink_home_position_message(
            latitude=round(home.lat_deg * 1e7), longitude=round(home.lon_deg * 1e7),
            altitude=round(home.height_amsl_m * 1e3), x=x, y=y, z=z, q=[1.0, 0.0, 0.0, 0.0],
            approach_x=0.0, approach_y=0.0, approach_z=0.0,
        )  # fmt: skip

    def _hud(self) -> Message:
        vx, vy, vz = (float(v) for v in self.velocity_ned_m_s)
        flat = float(np.hypot(vx, vy))
        return dialect.MAVLink_vfr_hud_message(
            airspeed=flat, groundspeed=flat, heading=round(self._heading_deg()) % 360, throttle=50,
            alt=self._frame.geopoint(self.position_ned_m).height_amsl_m, climb=-vz,
        )  # fmt: skip

    def _extended_state(self) -> Message:
        return dialect.MAVLink_extended_sys_state_message(
            vtol_state=dialect.MAV_VTOL_STATE_UNDEFINED, landed_state=dialect.MAV_LANDED_STATE_IN_AIR
        )

    def _version(self) -> Message:
        d = dialect
        major, minor, patch = self.options.firmware
        capabilities = (
            d.MAV_PROTOCOL_CAPABILITY_MAVLINK2 | d.MAV_PROTOCOL_CAPABILITY_MISSION_INT
            | d.MAV_PROTOCOL_CAPABILITY_COMMAND_INT
        )  # fmt: skip
        px4 = self.options.stack == "px4"
        capabilities |= (
            d.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_BYTEWISE if px4 else d.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_C_CAST
        )
        return d.MAVLink_autopilot_version_message(
            capabilities=capabilities, flight_sw_version=major << 24 | minor << 16 | patch << 8 | 255,  # a release
            middleware_sw_version=0, os_sw_version=0, board_version=0, flight_custom_version=[0] * 8,
            middleware_custom_version=[0] * 8, os_custom_version=[0] * 8, vendor_id=0, product_id=0, uid=0,
        )  # fmt: skip
