"""A small autopilot for tests: speaks MAVLink over a real UDP socket, TCP connection or pseudo-terminal.

It answers as ArduPilot does where it matters to the link: streams only what was asked for, answers and asks
TIMESYNC, tells its version and origin on request, and counts time from its own boot. It has parameters in the
encoding of either stack.
"""

from __future__ import annotations

import contextlib
import math
import os
import random
import select
import socket
import struct
import threading
import time
import tty
from collections import Counter
from collections.abc import Callable
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as dialect

from ortholoc_edge.adapters.mavlink.codec import payload_of
from ortholoc_edge.geometry import rotation


class Wire:
    """Non-blocking bytes to the link under test."""

    def fileno(self) -> int:
        raise NotImplementedError

    def read(self) -> bytes:
        raise NotImplementedError

    def write(self, data: bytes) -> None:
        raise NotImplementedError

    def close(self) -> None:
        raise NotImplementedError


class UdpWire(Wire):
    """Sends to a link that listens, or waits for one that connects out."""

    def __init__(self, peer: tuple[str, int] | None = None) -> None:
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", 0))
        self.socket.setblocking(False)
        self.port = self.socket.getsockname()[1]
        self.peer = peer

    def fileno(self):
        return self.socket.fileno()

    def read(self):
        data, self.peer = self.socket.recvfrom(65535)
        return data

    def write(self, data):
        if self.peer is not None:
            self.socket.sendto(data, self.peer)

    def close(self):
        self.socket.close()


class TcpWire(Wire):
    """A server for one connection after the other."""

    def __init__(self, port: int = 0) -> None:
        self.server = socket.create_server(("127.0.0.1", port))
        self.server.setblocking(False)
        self.port = self.server.getsockname()[1]
        self.connection: socket.socket | None = None
        self.accepted = 0

    def fileno(self):
        return (self.connection or self.server).fileno()

    def read(self):
        if self.connection is None:
            self.connection, _ = self.server.accept()
            self.connection.setblocking(False)
            self.accepted += 1
            return b""
        data = self.connection.recv(65536)
        if not data:
            self.drop()
        return data

    def write(self, data):
        if self.connection is not None:
            self.connection.send(data)

    def drop(self):
        if self.connection is not None:
            self.connection.close()
            self.connection = None

    def close(self):
        self.drop()
        self.server.close()


class PtyWire(Wire):
    """The master's end of a pseudo-terminal; ``path`` is the serial device."""

    def __init__(self) -> None:
        self.master, self.slave = os.openpty()
        tty.setraw(self.slave)
        os.set_blocking(self.master, False)
        self.path = os.ttyname(self.slave)

    def fileno(self):
        return self.master

    def read(self):
        return os.read(self.master, 65536)

    def write(self, data):
        os.write(self.master, data)

    def close(self):
        os.close(self.master)
        os.close(self.slave)


class FakeAutopilot:
    """Runs in a thread until `close`. Fields may be set from the test while it runs."""

    def __init__(
        self,
        wire: Wire,
        autopilot: int = dialect.MAV_AUTOPILOT_ARDUPILOTMEGA,
        system_id: int = 7,
        version: tuple[int, int, int] = (4, 5, 7),
    ) -> None:
        self.wire = wire
        self.autopilot, self.system_id, self.version = autopilot, system_id, version
        self.mav = dialect.MAVLink(None, system_id, 1)
        self.parser = dialect.MAVLink(None, 0, 0)
        self.parser.robust_parsing = True
        self.boot_ns = time.monotonic_ns() - 100_000_000_000
        self.intervals_ns: dict[int, int] = {}
        self.next_ns: dict[int, int] = {}
        self.got: list[Any] = []
        self.got_counts: Counter[str] = Counter()
        self.noise = random.Random(1)
        self.noise_probability = 0.0
        self.halve_probability = 0.0
        self.nan_attitude = False
        self.mute = False
        self.yaw_rate = 0.4
        self.version_type = 255  # FIRMWARE_VERSION_TYPE_OFFICIAL
        self.origin: tuple[int, int, int] | None = (507000000, 71000000, 60000)
        self.position_step = 0.0
        # Makes GIMBAL_DEVICE_ATTITUDE_STATUS of a boot time in ms; None: there is no gimbal.
        self.gimbal: Callable[[int], Any] | None = None
        self.timesync_answers: list[int] = []
        self.base_mode = dialect.MAV_MODE_FLAG_SAFETY_ARMED | dialect.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
        self.mavlink1 = False
        # By name: an int is an integer parameter, a float a real one. Others are not there.
        self.parameters: dict[str, int | float] = {}
        self.read_only: set[str] = set()  # keeps its value and tells it
        self.slow: dict[str, int] = {}  # this many requests go unanswered
        self.tells_errors = False  # PARAM_ERROR, as the newest ArduPilot
        self.parameters_set: list[tuple[str, int | float]] = []
        self._asked_ts1 = 0
        self._stop = threading.Event()
        self.thread = threading.Thread(target=self._run, name="fake-autopilot")
        self.thread.start()

    def close(self):
        self._stop.set()
        self.thread.join()
        self.wire.close()

    def reboot(self):
        self.boot_ns = time.monotonic_ns()
        self.intervals_ns.clear()

    def truth_at(self, now_ns: int):
        return rotation.from_euler(0.1, -0.05, self.yaw_rate * (now_ns / 1e9 % 1000.0))

    def _run(self):
        heartbeat_ns = timesync_ns = 0
        while not self._stop.is_set():
            # A TCP server that lost its peer, or a pty whose other side is closed, is simply quiet for a
            # while.
            with contextlib.suppress(OSError):
                readable, _, _ = select.select([self.wire], [], [], 0.004)
                if readable:
                    for message in self.parser.parse_buffer(self.wire.read()) or []:
                        self._take(message)
                now_ns = time.monotonic_ns()
                if self.mute:
                    continue
                if now_ns >= heartbeat_ns:
                    heartbeat_ns = now_ns + 200_000_000
                    self._send(dialect.MAVLink_heartbeat_message(2, self.autopilot, self.base_mode, 0, 4, 3))
                if now_ns >= timesync_ns:
                    timesync_ns = now_ns + 100_000_000
                    self._asked_ts1 = now_ns - self.boot_ns
                    self._send(dialect.MAVLink_timesync_message(0, self._asked_ts1))
                for message_id, interval_ns in list(self.intervals_ns.items()):
                    if now_ns >= self.next_ns.get(message_id, 0):
                        self.next_ns[message_id] = now_ns + interval_ns
                        message = self._stream(message_id, time.monotonic_ns())
                        if message is not None:
                            self._send(message)

    def _send(self, message):
        frame = bytes(message.pack(self.mav, force_mavlink1=self.mavlink1))
        self.mav.seq = (self.mav.seq + 1) % 256
        if self.noise.random() < self.noise_probability:
            frame = self.noise.randbytes(self.noise.randint(1, 30)) + b"\xfd" + frame
        if self.noise.random() < self.halve_probability:
            frame = frame[: self.noise.randint(1, len(frame) - 1)]
        self.wire.write(frame)

    def _take(self, message):
        kind = message.get_type()
        self.got_counts[kind] += 1
        if kind in (
            "ODOMETRY",
            "VISION_POSITION_ESTIMATE",
            "GLOBAL_POSITION_SENSOR",
            "GPS_INPUT",
            "COMMAND_INT",
            "COMMAND_ACK",
            "STATUSTEXT",
            "HEARTBEAT",
            "SET_GPS_GLOBAL_ORIGIN",
        ):
            self.got.append(message)
        if kind == "TIMESYNC":
            now = time.monotonic_ns() - self.boot_ns
            if message.tc1 == 0:
                self._send(dialect.MAVLink_timesync_message(now, message.ts1))
            elif message.ts1 == self._asked_ts1:
                self.timesync_answers.append(now - message.ts1)
        elif kind == "SET_GPS_GLOBAL_ORIGIN" and self.origin is None:
            self.origin = (message.latitude, message.longitude, message.altitude)
        elif kind in ("PARAM_REQUEST_READ", "PARAM_SET") and message.target_system == self.system_id:
            self._parameter(message, message if kind == "PARAM_SET" else None)
        elif kind == "COMMAND_LONG" and message.target_system == self.system_id:
            if message.command == 511:
                self.intervals_ns[int(message.param1)] = int(message.param2 * 1000)
            elif message.command == 512:
                wanted = self._stream(int(message.param1), time.monotonic_ns())
                if wanted is not None:
                    self._send(wanted)
            self._send(dialect.MAVLink_command_ack_message(message.command, 0))

    def _parameter(self, message, setting):
        """As either stack does it: silent for a name that is not there, an echo after setting."""
        name = message.param_id
        if self.slow.get(name, 0) > 0:
            self.slow[name] -= 1
            return
        if name not in self.parameters:
            if self.tells_errors:
                self._send(dialect.MAVLink_param_error_message(0, 0, name.encode(), -1, 1))
            return
        old = self.parameters[name]
        px4 = self.autopilot == dialect.MAV_AUTOPILOT_PX4
        if setting is not None:
            value = self._value_set(setting, isinstance(old, int), px4)
            if value is None:
                return
            self.parameters_set.append((name, value))
            if name not in self.read_only:
                self.parameters[name] = value
        value = self.parameters[name]
        if isinstance(value, float):
            kind = dialect.MAV_PARAM_TYPE_REAL32
        else:
            small = dialect.MAV_PARAM_TYPE_INT8 if abs(value) < 128 else dialect.MAV_PARAM_TYPE_INT16
            kind = dialect.MAV_PARAM_TYPE_INT32 if px4 else small
        wire = struct.unpack("<f", struct.pack("<i", value))[0] if px4 and isinstance(value, int) else float(value)
        self._send(dialect.MAVLink_param_value_message(name.encode(), wire, kind, 999, 65535))

    @staticmethod
    def _value_set(message, integer: bool, px4: bool):
        """The number that the firmware would store; None where it refuses."""
        if px4:
            kind = dialect.MAV_PARAM_TYPE_INT32 if integer else dialect.MAV_PARAM_TYPE_REAL32
            if message.param_type != kind:
                return None  # "param types mismatch"
            raw = payload_of(message, 4)[:4]
            return struct.unpack("<i" if integer else "<f", raw)[0]
        if not math.isfinite(message.param_value):
            return None
        return round(message.param_value) if integer else message.param_value

    def _stream(self, message_id: int, now_ns: int):
        boot_ms = (now_ns - self.boot_ns) // 1_000_000
        d = dialect
        makers = {
            d.MAVLINK_MSG_ID_ATTITUDE_QUATERNION: self._attitude,
            d.MAVLINK_MSG_ID_LOCAL_POSITION_NED: lambda ms: d.MAVLink_local_position_ned_message(
                ms, 5.0 * ms / 1000.0 + self.position_step, 2.0, -80.0, 5.0, 0.0, 0.0
            ),
            d.MAVLINK_MSG_ID_GPS_RAW_INT: lambda ms: d.MAVLink_gps_raw_int_message(
                0, 3, 507000000, 71000000, 140000, 80, 120, 500, 0, 14, h_acc=1500, v_acc=2500
            ),
            d.MAVLINK_MSG_ID_SYSTEM_TIME: lambda ms: d.MAVLink_system_time_message(0, ms),
            d.MAVLINK_MSG_ID_EXTENDED_SYS_STATE: lambda ms: d.MAVLink_extended_sys_state_message(
                0, d.MAV_LANDED_STATE_IN_AIR
            ),
            d.MAVLINK_MSG_ID_EKF_STATUS_REPORT: lambda ms: d.MAVLink_ekf_status_report_message(
                831, 0.1, 0.25, 0.1, 0.1, 0.0
            ),
            d.MAVLINK_MSG_ID_ESTIMATOR_STATUS: lambda ms: d.MAVLink_estimator_status_message(
                0, 831, 0.1, 0.25, 0.1, 0.1, 0.0, 0.0, 1.0, 1.0
            ),
            d.MAVLINK_MSG_ID_AUTOPILOT_VERSION: self._version_message,
        }
        if self.origin is not None:
            origin = self.origin
            makers[d.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN] = lambda ms: d.MAVLink_gps_global_origin_message(*origin)
        if self.gimbal is not None:
            makers[d.MAVLINK_MSG_ID_GIMBAL_DEVICE_ATTITUDE_STATUS] = self.gimbal
        make = makers.get(message_id)
        return make(boot_ms) if make else None

    def _attitude(self, boot_ms: int):
        # Of the millisecond that the stamp names, not of now.
        q = rotation.to_quaternion(self.truth_at(self.boot_ns + boot_ms * 1_000_000))
        if self.nan_attitude:
            q = [math.nan] * 4
        return dialect.MAVLink_attitude_quaternion_message(boot_ms, *map(float, q), 0.0, 0.0, self.yaw_rate)

    def _version_message(self, boot_ms: int):
        major, minor, patch = self.version
        word = major << 24 | minor << 16 | patch << 8 | self.version_type
        return dialect.MAVLink_autopilot_version_message(0, word, 0, 0, 0, [0] * 8, [0] * 8, [0] * 8, 0, 0, 0)
