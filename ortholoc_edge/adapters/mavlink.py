"""The link to the autopilot: MAVLink 2 over UDP, TCP or a serial line.

Three layers, from the wire up:

- `FrameParser` turns bytes into messages and finds its way back after garbage without losing a whole frame.
- `LinkProtocol` knows what to say and what was heard. It does no I/O and reads no clock: messages and stamps
  go in, messages come out. So tests drive it without a socket or a sleep.
- `AutopilotLink` owns the one thread that does I/O and the lock around the protocol.

Of pymavlink only the generated codec is used. Its `mavutil` connections exchange their `mav` object when the
first MAVLink 2 frame arrives, sleep inside reads while they reconnect, and stamp with the wall clock.
"""

from __future__ import annotations

import contextlib
import logging
import math
import os
import re
import select
import socket
import struct
import threading
from bisect import bisect_right
from collections import Counter, deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from enum import IntEnum
from types import TracebackType
from typing import Annotated, Any, Generic, Literal, Protocol, TypeVar

import msgspec
import numpy as np
import serial

# Importing a v20 dialect by name needs no variable; whoever imports mavutil after us gets MAVLink 2 by it
# too.
os.environ["MAVLINK20"] = "1"

from pymavlink.dialects.v20 import ardupilotmega as dialect

from ortholoc_edge.adapters.estimates import (
    Autopilot,
    GeodeticOrigin,
    MavlinkMessage,
    VisionEstimate,
    covariance_layout,
    encode_odometry,
    encode_vision_position_estimate,
    moved,
)
from ortholoc_edge.clock import Clock
from ortholoc_edge.errors import ConfigError, LinkError
from ortholoc_edge.geometry import rotation
from ortholoc_edge.geometry.arrays import FloatArray, frozen_floats

if dialect.WIRE_PROTOCOL_VERSION != "2.0":
    raise LinkError(
        f"pymavlink's dialect speaks MAVLink {dialect.WIRE_PROTOCOL_VERSION}; install pymavlink >= 2.4.49"
    )

logger = logging.getLogger(__name__)

T = TypeVar("T")
Statistic = int | float | str | bool | None

_MS = 1_000_000
_S = 1_000_000_000
# time_boot_ms is 32 bits wide: it comes round after 49.7 days.
_BOOT_WRAP_NS = 2**32 * _MS

_AUTOPILOT_COMPONENT = 1
_AUTOPILOTS = {
    dialect.MAV_AUTOPILOT_ARDUPILOTMEGA: Autopilot.ARDUPILOT,
    dialect.MAV_AUTOPILOT_PX4: Autopilot.PX4,
}

# An autopilot sends HEARTBEAT at 1 Hz; three missing is how ground stations judge it too.
_SILENT_AFTER_NS = 3 * _S
# With its own system id gone for this long, another autopilot on the link may take the place.
_REPLACE_AFTER_NS = 10 * _S
# A TCP peer that stays mute this long is taken for half open: its end is gone and nobody told us.
_TCP_SILENCE_NS = 10 * _S
_BACKOFF_MIN_S, _BACKOFF_MAX_S = 0.5, 10.0
_SELECT_TIMEOUT_S = 0.05
# What may wait in a serial line's or TCP socket's buffer: 0.35 s at 57600 baud. Beyond it, messages are
# dropped.
_OUT_LIMIT_BYTES = 2048
_GIVE_UP_AFTER_ERRORS = 10

_HISTORY_NS = 10 * _S
# Nearest attitude or local position that may stand for a stamp, by its rates.
_MAX_EXTRAPOLATION_NS = 200 * _MS
# Samples farther apart than this are not interpolated between: the shortest turn need not be the true one.
_MAX_GAP_NS = 500 * _MS
_GNSS_FRESH_NS = 1500 * _MS
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
_ORIGIN_MOVED_M = 0.1


class SystemStatus(IntEnum):
    """What our HEARTBEAT says of us (MAV_STATE)."""

    BOOT = 1
    STANDBY = 3
    ACTIVE = 4
    CRITICAL = 5


class Severity(IntEnum):
    """MAV_SEVERITY, for :meth:`AutopilotLink.send_status_text`."""

    CRITICAL = 2
    ERROR = 3
    WARNING = 4
    NOTICE = 5
    INFO = 6


class LinkOptions(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The ``[link]`` table.

    Attributes:
        endpoint: ``udp:HOST:PORT`` listens there, ``udpout:HOST:PORT`` and ``tcp:HOST:PORT`` connect,
            ``serial:/dev/ttyX:BAUD``. Below 460800 baud there is little room for ODOMETRY and time
            synchronisation is poor.
        system_id: ours and the vehicle's (a component shares the system id of its vehicle); 0 adopts that of
            the first autopilot heard.
        component_id: 197 is MAV_COMP_ID_VISUAL_INERTIAL_ODOMETRY.
        send: which messages carry an estimate.
        autopilot: overrides what the heartbeat says.
        attitude_rate_hz, position_rate_hz: of ATTITUDE_QUATERNION and LOCAL_POSITION_NED, asked of the
            autopilot.
        set_origin: whether `AutopilotLink.offer_origin` may set the EKF origin of an autopilot that has none.
    """

    endpoint: str
    system_id: Annotated[int, msgspec.Meta(ge=0, le=255)] = 0
    component_id: Annotated[int, msgspec.Meta(ge=1, le=255)] = 197
    send: tuple[Literal["vision_position_estimate", "odometry"], ...] = ("odometry",)
    autopilot: Literal["auto", "ardupilot", "px4"] = "auto"
    attitude_rate_hz: Annotated[float, msgspec.Meta(ge=1, le=400)] = 50.0
    position_rate_hz: Annotated[float, msgspec.Meta(ge=1, le=100)] = 20.0
    set_origin: bool = False


@dataclass(frozen=True, slots=True)
class Endpoint:
    """Where the link goes. ``port`` is the baud rate of a serial line."""

    kind: Literal["udp", "udpout", "tcp", "serial"]
    address: str
    port: int


def _is_host(text: str) -> bool:
    """Whether the socket module would take it for a name to look up: it raises UnicodeError for others."""
    try:
        text.strip("[]").encode("idna")
    except UnicodeError:
        return False
    return not any(c.isspace() or c == "\0" for c in text)


def parse_endpoint(text: str) -> Endpoint:
    """Read ``LinkOptions.endpoint``. Raises: ConfigError that names the text and what is accepted."""
    match = re.fullmatch(r"(udp|udpout|tcp|serial):(.+):(\d{1,8})", text)
    number = int(match[3]) if match else 0
    network = match is not None and match[1] != "serial"
    if match is None or number == 0 or (network and (number > 65535 or not _is_host(match[2]))):
        raise ConfigError(
            f"link endpoint {text!r} can't be used; write udp:HOST:PORT (listen), udpout:HOST:PORT, "
            "tcp:HOST:PORT or serial:/dev/ttyX:BAUD"
        )
    kinds: dict[str, Literal["udp", "udpout", "tcp", "serial"]] = {
        "udp": "udp",
        "udpout": "udpout",
        "tcp": "tcp",
        "serial": "serial",
    }
    return Endpoint(kinds[match[1]], match[2], number)


@dataclass(frozen=True, slots=True)
class AutopilotIdentity:
    """Who answers on the link. ``firmware_version`` is None until AUTOPILOT_VERSION came."""

    system_id: int
    autopilot: Autopilot
    firmware_version: tuple[int, int, int] | None


@dataclass(frozen=True, slots=True)
class GnssPosition:
    """What the GNSS receiver itself measured, carried to the stamp by odometry; 1-sigma, the horizontal one per
    axis. Not the autopilot's own position: that one holds our fixes too, and would confirm their errors."""

    latitude_deg: float
    longitude_deg: float
    height_amsl_m: float
    sigma_horizontal_m: float
    sigma_vertical_m: float


@dataclass(frozen=True, slots=True, eq=False)
class AutopilotState:
    """What the autopilot knew of the vehicle at ``stamp_ns`` (our monotonic clock).

    Attributes:
        ned_from_body: (3, 3); None without an attitude within 0.2 s of the stamp.
        interpolated: whether ``ned_from_body`` lies between two samples received; if not it was carried on by
            the rates, and asking again a little later gives a better one.
        velocity_ned, local_position_ned_m: (3,) of LOCAL_POSITION_NED, relative to the EKF origin.
        local_epoch: rises when the local position jumped, its stream had a gap, the origin moved or the
            autopilot restarted. Positions of two epochs must not be subtracted.
        odometry_ned_m: (3,) the integral of the autopilot's velocity since an arbitrary point; for
            displacements. Not its position, because that takes in our own fixes: the way from one frame to
            the next would hold the correction by the last fix once more. None without a sample near the stamp.
        odometry_epoch: rises when the integral is broken: the velocity was missing for more than a second or
            not finite, or the autopilot restarted.
        gnss: where GNSS is healthy: a fix, fresh, of stated and sufficient accuracy; None otherwise.
        origin: the EKF origin, once the autopilot has told it.
        armed: of the last HEARTBEAT. landed: of EXTENDED_SYS_STATE, None while unknown.
        synchronised: whether stamps were related by TIMESYNC; if not, by time of arrival, which is late by
            the link's delay. sync_uncertainty_ns: half the round trip plus drift; None if not synchronised.
        estimator_flags, position_test_ratio: of EKF_STATUS_REPORT (ArduPilot) or ESTIMATOR_STATUS (PX4); a
            ratio above 1 means that the filter refuses position measurements.
    """

    stamp_ns: int
    ned_from_body: FloatArray | None
    interpolated: bool
    velocity_ned: FloatArray | None
    local_position_ned_m: FloatArray | None
    local_epoch: int
    odometry_ned_m: FloatArray | None
    odometry_epoch: int
    gnss: GnssPosition | None
    origin: GeodeticOrigin | None
    armed: bool
    landed: bool | None
    synchronised: bool
    sync_uncertainty_ns: int | None
    estimator_flags: int | None
    position_test_ratio: float | None


class LimitedLog:
    """Logs one kind of line at most once per interval, then with the count of those left out."""

    def __init__(self, interval_ns: int = 10 * _S) -> None:
        self._interval_ns = interval_ns
        self._last: dict[str, tuple[int, int]] = {}

    def __call__(self, now_ns: int, level: int, key: str, message: str) -> None:
        """``key`` is the kind; it must come from a fixed set."""
        last_ns, left_out = self._last.get(key, (None, 0))
        if last_ns is not None and now_ns - last_ns < self._interval_ns:
            self._last[key] = (last_ns, left_out + 1)
            return
        self._last[key] = (now_ns, 0)
        logger.log(level, "%s%s", message, f" ({left_out} more like it before)" if left_out else "")


class FrameParser:
    """Bytes to messages.

    After a frame that fails, the search goes on at its second byte: pymavlink's own parser skips the length
    that the broken header claimed, up to 280 bytes and the good frames among them. An incomplete frame waits,
    but not longer than a real one could take, so that a stray start byte does not hold back what follows.
    """

    _MARKER = re.compile(rb"[\xfd\xfe]")
    # A 280 byte frame takes 49 ms at 57600 baud.
    _INCOMPLETE_LIMIT_NS = 200 * _MS

    def __init__(self) -> None:
        self._mav = dialect.MAVLink(None, 0, 0)
        self._buffer = bytearray()
        self._since_ns = 0
        self.bad_bytes = 0
        self.bad_frames = 0
        self.unknown_frames = 0

    def feed(self, data: bytes, now_ns: int) -> list[MavlinkMessage]:
        """The messages that ``data`` completes."""
        buffer = self._buffer
        stale = bool(buffer) and now_ns - self._since_ns > self._INCOMPLETE_LIMIT_NS
        buffer += data
        messages: list[MavlinkMessage] = []
        at = 0
        while True:
            marker = self._MARKER.search(buffer, at)
            start = marker.start() if marker else len(buffer)
            self.bad_bytes += start - at
            at = start
            end = self._frame_end(at)
            if end is None or end > len(buffer):
                if at == 0 and stale:
                    at, stale = 1, False
                    self.bad_bytes += 1
                    continue
                break
            message = self._decode(at, end)
            if message is None:
                self.bad_frames += 1
                self.bad_bytes += 1
                at += 1
            else:
                if isinstance(message, dialect.MAVLink_unknown):
                    self.unknown_frames += 1
                else:
                    messages.append(message)
                at = end
        if at > 0 or len(buffer) == len(data):
            self._since_ns = now_ns
        del buffer[:at]
        return messages

    def _frame_end(self, at: int) -> int | None:
        buffer = self._buffer
        if len(buffer) - at < 3:
            return None
        if buffer[at] == 0xFE:
            return at + buffer[at + 1] + 8
        signature = 13 if buffer[at + 2] & 1 else 0
        return at + buffer[at + 1] + 12 + signature

    def _decode(self, at: int, end: int) -> MavlinkMessage | None:
        buffer = self._buffer
        if buffer[at] == 0xFD and buffer[at + 2] & ~1:
            return None
        try:
            message = self._mav.decode(buffer[at:end])
        except (dialect.MAVError, struct.error, ValueError, IndexError):
            return None
        # The checksum of a message that this dialect lacks can't be tested. It is believed if it ends where a
        # frame may end.
        unknown = isinstance(message, dialect.MAVLink_unknown)
        return None if unknown and end < len(buffer) and buffer[end] not in (0xFD, 0xFE) else message


def _is_position(latitude_e7: int, longitude_e7: int) -> bool:
    """Both stacks send zeros while they have no position."""
    return (
        (latitude_e7, longitude_e7) != (0, 0)
        and abs(latitude_e7) <= 900000000
        and abs(longitude_e7) <= 1800000000
    )


class TimeSync:
    """Relates the autopilot's boot time to our clock by TIMESYNC round trips.

    Of the last samples the one with the least uncertainty counts: half its round trip (the answer may have
    been stamped anywhere in it) plus drift since it was taken. Queues only ever lengthen a round trip, so
    this is the usual minimum filter with a way to forget.
    """

    _DRIFT = 50e-6  # of two crystals, relative; a bad pair
    _FAST_NS, _SLOW_NS = 100 * _MS, 1 * _S
    _SAMPLES_FAST = 10
    _SAMPLES_NEEDED = 5
    _MAX_ROUND_TRIP_NS = 1 * _S
    _JUMP_SLACK_NS = 2 * _MS
    _JUMPS_TO_RESET = 3

    def __init__(self) -> None:
        self._samples: deque[tuple[int, int, int]] = deque(maxlen=64)
        self._asked: deque[int] = deque(maxlen=8)
        self._next_ns = 0
        self._disagreeing = 0
        self.last_round_trip_ns: int | None = None
        self.resets = 0

    def reset(self) -> None:
        """Forget everything; ask fast again."""
        self._samples.clear()
        self._asked.clear()
        self._disagreeing = 0
        self._next_ns = 0

    @property
    def synchronised(self) -> bool:
        return len(self._samples) >= self._SAMPLES_NEEDED

    def due(self, now_ns: int) -> int | None:
        """The ts1 of a request to send now, or None."""
        if now_ns < self._next_ns:
            return None
        self._next_ns = now_ns + (self._FAST_NS if len(self._samples) < self._SAMPLES_FAST else self._SLOW_NS)
        self._asked.append(now_ns)
        return now_ns

    def answered(self, tc1_ns: int, ts1_ns: int, arrival_ns: int) -> None:
        """An answer came: the autopilot read ``tc1_ns`` between our ``ts1_ns`` and ``arrival_ns``."""
        if ts1_ns not in self._asked:
            return  # an answer to somebody else on the link, or a duplicate
        self._asked.remove(ts1_ns)
        round_trip = arrival_ns - ts1_ns
        if not 0 <= round_trip <= self._MAX_ROUND_TRIP_NS:
            return
        self.last_round_trip_ns = round_trip
        offset = tc1_ns - (ts1_ns + arrival_ns) // 2
        best = self.best(arrival_ns)
        if best is not None and abs(offset - best[0]) > best[1] + round_trip // 2 + self._JUMP_SLACK_NS:
            # One may be a broken stamp. Several in a row: the autopilot's clock is another one than before.
            self._disagreeing += 1
            if self._disagreeing < self._JUMPS_TO_RESET:
                return
            self.reset()
            self.resets += 1
        self._disagreeing = 0
        self._samples.append((offset, round_trip, arrival_ns))

    def best(self, now_ns: int) -> tuple[int, int] | None:
        """(offset, uncertainty) in ns with ``boot = ours + offset``; None without a sample."""
        if not self._samples:
            return None
        uncertainty, offset = min(
            (round_trip // 2 + int(self._DRIFT * max(0, now_ns - at)), offset)
            for offset, round_trip, at in self._samples
        )
        return offset, uncertainty


class TimeHistory(Generic[T]):
    """Samples of the last seconds, found by the autopilot's boot time or by our time of arrival.

    Both stamps are kept so that synchronisation may come, improve or go without touching what is stored.
    """

    def __init__(self, span_ns: int, capacity: int) -> None:
        self._span_ns, self._capacity = span_ns, capacity
        self._boot: list[int] = []
        self._arrival: list[int] = []
        self._values: list[T] = []

    def __len__(self) -> int:
        return len(self._values)

    def clear(self) -> None:
        self._boot.clear()
        self._arrival.clear()
        self._values.clear()

    def add(self, boot_ns: int, arrival_ns: int, value: T) -> bool:
        """Append; False if the sample is not newer than the last one."""
        if self._boot and boot_ns <= self._boot[-1]:
            return False
        self._boot.append(boot_ns)
        self._arrival.append(arrival_ns)
        self._values.append(value)
        too_old = bisect_right(self._arrival, arrival_ns - self._span_ns)
        drop = max(len(self._values) - self._capacity, too_old)
        # In chunks: deleting at the front moves the rest.
        if drop >= self._capacity // 8:
            del self._boot[:drop], self._arrival[:drop], self._values[:drop]
        return True

    def around(self, time_ns: int, by_boot: bool) -> tuple[tuple[int, T] | None, tuple[int, T] | None]:
        """The samples at or before and after ``time_ns``, each with its stamp."""
        keys = self._boot if by_boot else self._arrival
        i = bisect_right(keys, time_ns)
        before = (keys[i - 1], self._values[i - 1]) if i > 0 else None
        after = (keys[i], self._values[i]) if i < len(keys) else None
        return before, after


def _choose(
    around: tuple[tuple[int, T] | None, tuple[int, T] | None],
    time_ns: int,
    max_distance_ns: int,
    together: Callable[[T, T], bool] = lambda a, b: True,
) -> tuple[T, T | None, float] | None:
    """How to obtain a value at ``time_ns``: (a, b, fraction) to interpolate, (a, None, seconds) to
    extrapolate."""
    near = [sample for sample in around if sample is not None]
    if not near:
        return None
    stamp, value = min(near, key=lambda sample: abs(time_ns - sample[0]))
    if abs(time_ns - stamp) > max_distance_ns:
        return None
    if len(near) == 2:
        (t0, a), (t1, b) = near
        if 0 < t1 - t0 <= max(_MAX_GAP_NS, max_distance_ns) and together(a, b):
            return a, b, (time_ns - t0) / (t1 - t0)
    return value, None, (time_ns - stamp) / _S


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


class _Stream:
    """One message that the autopilot is asked to send, and whether it does."""

    _CHECK_NS = 5 * _S

    def __init__(self, message_id: int, rate_hz: float) -> None:
        self.message_id, self.interval_ns = message_id, int(_S / rate_hz)
        self._patience_ns = max(3 * self.interval_ns, 1 * _S)
        self.restart()

    def restart(self) -> None:
        self._asked_ns: int | None = None
        self._heard_ns: int | None = None
        self._attempts = 0
        self._count = 0
        self._count_since_ns = 0

    def heard(self, now_ns: int) -> None:
        self._heard_ns = now_ns
        self._count += 1

    def due(self, now_ns: int) -> bool:
        """Whether to ask (again): at first, when it stopped, or when it comes at less than half the rate."""
        if self._asked_ns is None:
            return self._ask(now_ns)
        if now_ns - self._asked_ns < min(10 * _S, (2 * _S) << min(self._attempts, 3)):
            return False
        if self._heard_ns is None or now_ns - self._heard_ns > self._patience_ns:
            self._attempts += 1
            return self._ask(now_ns)
        elapsed = now_ns - self._count_since_ns
        if elapsed < self._CHECK_NS:
            return False
        slow = self._count < 0.5 * elapsed / self.interval_ns
        self._attempts = self._attempts + 1 if slow else 0
        self._count, self._count_since_ns = 0, now_ns
        return self._ask(now_ns) if slow else False

    def _ask(self, now_ns: int) -> bool:
        self._asked_ns = self._count_since_ns = now_ns
        self._count = 0
        return True


class _Repeat:
    """When to say something again: at a fixed pace, or ever more slowly."""

    def __init__(self, first_ns: int, last_ns: int | None = None) -> None:
        self._first_ns, self._last_ns = first_ns, last_ns or first_ns
        self.restart()

    def restart(self) -> None:
        self._interval_ns, self._next_ns = self._first_ns, 0

    def due(self, now_ns: int) -> bool:
        if now_ns < self._next_ns:
            return False
        self._next_ns = now_ns + self._interval_ns
        self._interval_ns = min(2 * self._interval_ns, self._last_ns)
        return True


class LinkProtocol:
    """What is said and what was heard; no I/O, no threads, no clock of its own.

    Its owner calls :meth:`on_message` for each message that arrives and :meth:`poll` at least every 50 ms,
    and sends what both return, in order.
    """

    def __init__(self, options: LinkOptions) -> None:
        self._options = options
        self._log = LimitedLog()
        self.system_status = SystemStatus.BOOT
        self.timesync = TimeSync()
        self._vehicle: AutopilotIdentity | None = None
        self._armed = False
        self._landed: bool | None = None
        self._heartbeat_ns = 0
        self._silent = False
        self._origin: GeodeticOrigin | None = None
        self._offered_origin: GeodeticOrigin | None = None
        self._home_known = False
        self._gps_raw: _GpsRaw | None = None
        self._estimator: tuple[int, float] | None = None
        self._epoch = 0
        self._newest_boot_ns: int | None = None
        self._ahead_in_a_row = 0
        self._quaternion_ns: int | None = None
        # Twice what was asked for, as some stacks send more; and no less than 20 Hz.
        capacity = 2 * int(_HISTORY_NS / _S * max(20.0, options.attitude_rate_hz, options.position_rate_hz))
        self._attitudes: TimeHistory[_Attitude] = TimeHistory(_HISTORY_NS, capacity)
        self._locals: TimeHistory[_Local] = TimeHistory(_HISTORY_NS, capacity)
        self._odometry: TimeHistory[_Odometry] = TimeHistory(_HISTORY_NS, capacity)
        self._last_local: tuple[int, _Local] | None = None
        self._last_odometry: tuple[int, _Odometry] | None = None
        self._odometry_epoch = 0
        self._streams: dict[str, _Stream] = {}
        self._heartbeat_timer = _Repeat(1 * _S)
        self._version_timer = _Repeat(1 * _S, 10 * _S)
        self._origin_timer = _Repeat(1 * _S)
        self._origin_watch_timer = _Repeat(5 * _S)
        self._home_timer = _Repeat(2 * _S, 10 * _S)
        self.counts: Counter[str] = Counter()
        self._handlers: dict[str, Callable[[MavlinkMessage, int], None]] = {
            "ATTITUDE_QUATERNION": self._on_attitude_quaternion,
            "ATTITUDE": self._on_attitude,
            "LOCAL_POSITION_NED": self._on_local_position,
            "GPS_RAW_INT": self._on_gps_raw,
            "GPS_GLOBAL_ORIGIN": self._on_origin,
            "HOME_POSITION": self._on_home,
            "SYSTEM_TIME": self._on_system_time,
            "EXTENDED_SYS_STATE": self._on_extended_state,
            "EKF_STATUS_REPORT": self._on_ekf_status,
            "ESTIMATOR_STATUS": self._on_estimator_status,
            "AUTOPILOT_VERSION": self._on_version,
            "STATUSTEXT": self._on_status_text,
            "COMMAND_ACK": self._on_command_ack,
            "TIMESYNC": lambda m, arrival_ns: self.timesync.answered(m.tc1, m.ts1, arrival_ns),
        }

    # -- who we are and who they are --------------------

    @property
    def vehicle(self) -> AutopilotIdentity | None:
        return self._vehicle

    @property
    def own_system_id(self) -> int:
        """Ours: configured, else the vehicle's, else 1, the id that a vehicle has unless someone changed
        it."""
        if self._options.system_id:
            return self._options.system_id
        return self._vehicle.system_id if self._vehicle else 1

    def connected(self, now_ns: int) -> bool:
        """Whether the autopilot's heart beats."""
        return self._vehicle is not None and now_ns - self._heartbeat_ns <= _SILENT_AFTER_NS

    # -- in --------------------

    def on_message(self, message: MavlinkMessage, arrival_ns: int) -> list[MavlinkMessage]:
        """Take in one message; returns what must be answered at once."""
        system, component = message.get_srcSystem(), message.get_srcComponent()
        name = message.get_type()
        if system == self.own_system_id and component == self._options.component_id:
            self.counts["own_echo"] += 1
            return []
        if name == "HEARTBEAT" and component == _AUTOPILOT_COMPONENT:
            self._on_heartbeat(message, system, arrival_ns)
            return []
        if self._vehicle is None or (system, component) != (self._vehicle.system_id, _AUTOPILOT_COMPONENT):
            self.counts["ignored"] += 1
            return []
        self.counts[f"received.{name}"] += 1
        if name in self._streams:
            self._streams[name].heard(arrival_ns)
        if name == "TIMESYNC" and message.tc1 == 0:
            return [dialect.MAVLink_timesync_message(tc1=arrival_ns, ts1=message.ts1)]
        handler = self._handlers.get(name)
        if handler is not None:
            handler(message, arrival_ns)
        return []

    def is_vehicle_heartbeat(self, message: MavlinkMessage) -> bool:
        """Whether this is the heartbeat of an autopilot that we may serve, not of a ground station or a
        gimbal."""
        return (
            message.get_type() == "HEARTBEAT"
            and message.get_srcComponent() == _AUTOPILOT_COMPONENT
            and message.autopilot in _AUTOPILOTS
            and message.type != dialect.MAV_TYPE_GCS
            and self._options.system_id in (0, message.get_srcSystem())
        )

    def _is_another_autopilot(self, message: MavlinkMessage) -> bool:
        return (
            message.autopilot in _AUTOPILOTS
            and message.type != dialect.MAV_TYPE_GCS
            and self._options.system_id not in (0, message.get_srcSystem())
        )

    def _on_heartbeat(self, message: MavlinkMessage, system: int, arrival_ns: int) -> None:
        if not self.is_vehicle_heartbeat(message):
            self.counts["ignored"] += 1
            if self._vehicle is None and self._is_another_autopilot(message):
                self._log(
                    arrival_ns,
                    logging.WARNING,
                    "other_system",
                    f"an autopilot with system id {system} is heard, but [link] system_id is "
                    f"{self._options.system_id}, of which nothing came; set it to {system}, or to 0 to take the first",
                )
            return
        self.counts["received.HEARTBEAT"] += 1
        said = _AUTOPILOTS[message.autopilot]
        autopilot = said if self._options.autopilot == "auto" else Autopilot(self._options.autopilot)
        known = self._vehicle
        if known is not None and system != known.system_id:
            if arrival_ns - self._heartbeat_ns < _REPLACE_AFTER_NS:
                self.counts["other_vehicles"] += 1
                return
            known = None
        if known is None or known.autopilot is not autopilot:
            if self._vehicle is not None:
                self._forget("another autopilot answers", arrival_ns)
            self._vehicle = AutopilotIdentity(system, autopilot, None)
            self._streams = self._wanted_streams(autopilot)
            logger.info("autopilot found: %s, system %d", autopilot.value, system)
            if autopilot is not said:
                logger.warning("autopilot says it is %s, configured is %s", said.value, autopilot.value)
        elif self._silent:
            logger.info("autopilot is back")
        self._silent = False
        self._heartbeat_ns = arrival_ns
        self._armed = bool(message.base_mode & dialect.MAV_MODE_FLAG_SAFETY_ARMED)

    def _wanted_streams(self, autopilot: Autopilot) -> dict[str, _Stream]:
        rates = {
            "ATTITUDE_QUATERNION": self._options.attitude_rate_hz,
            "LOCAL_POSITION_NED": self._options.position_rate_hz,
            "GPS_RAW_INT": 2.0,
            "SYSTEM_TIME": 1.0,
            "EXTENDED_SYS_STATE": 1.0,
            "EKF_STATUS_REPORT" if autopilot is Autopilot.ARDUPILOT else "ESTIMATOR_STATUS": 2.0,
        }
        return {
            name: _Stream(getattr(dialect, f"MAVLINK_MSG_ID_{name}"), rate_hz)
            for name, rate_hz in rates.items()
        }

    def _forget(self, why: str, now_ns: int) -> None:
        """Drop all that does not survive a restart of the autopilot, and ask for everything again."""
        self.counts["restarts"] += 1
        self._log(now_ns, logging.WARNING, "restart", f"autopilot: {why}; asking for its streams again")
        self._epoch += 1
        self.timesync.reset()
        for history in (self._attitudes, self._locals, self._odometry):
            history.clear()
        self._break_odometry()
        self._last_local = None
        self._newest_boot_ns = None
        self._ahead_in_a_row = 0
        self._origin = None
        self._home_known = False
        self._gps_raw = None
        self._estimator = None
        self._landed = None
        self._quaternion_ns = None
        if self._vehicle is not None:
            self._vehicle = AutopilotIdentity(self._vehicle.system_id, self._vehicle.autopilot, None)
        for stream in self._streams.values():
            stream.restart()
        for timer in (self._version_timer, self._origin_timer, self._home_timer):
            timer.restart()

    def _boot_ns(self, time_boot_ms: int, arrival_ns: int) -> int | None:
        """Boot time of a sample; notices restarts. None if the stamp can't be true."""
        boot_ns = time_boot_ms * _MS
        best = self.timesync.best(arrival_ns) if self.timesync.synchronised else None
        if best is not None:
            expected = arrival_ns + best[0]
            boot_ns += max(0, round((expected - boot_ns) / _BOOT_WRAP_NS)) * _BOOT_WRAP_NS
            if boot_ns > expected + _STAMP_AHEAD_NS:
                self.counts["bad_stamps"] += 1
                self._ahead_in_a_row += 1
                if self._ahead_in_a_row >= 5:
                    self._forget("its clock jumped ahead", arrival_ns)
                return None
            self._ahead_in_a_row = 0
        if self._newest_boot_ns is not None and boot_ns < self._newest_boot_ns - _BOOT_BACK_NS:
            self._forget("restarted (its boot time went back)", arrival_ns)
        self._newest_boot_ns = max(boot_ns, self._newest_boot_ns or 0)
        return boot_ns

    def _garbage(self, name: str, now_ns: int, what: str) -> None:
        self.counts["garbage"] += 1
        self.counts[f"garbage.{name}"] += 1
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
        boot_ns = self._boot_ns(boot_ms, arrival_ns)
        if boot_ns is None:
            return
        sample = _Attitude((w / norm, x / norm, y / norm, z / norm), (p, q_rate, r))
        if not self._attitudes.add(boot_ns, arrival_ns, sample):
            self.counts["out_of_order"] += 1

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
        boot_ns = self._boot_ns(m.time_boot_ms, arrival_ns)
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
                self.counts["local_jumps"] += 1
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
            self.counts["out_of_order"] += 1

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
            self.counts["empty.GPS_RAW_INT"] += 1
        self._gps_raw = _GpsRaw(
            arrival_ns,
            self._fix_boot_ns(m.time_usec * 1000),
            m.fix_type if _is_position(m.lat, m.lon) else dialect.GPS_FIX_TYPE_NO_FIX,
            m.lat / 1e7,
            m.lon / 1e7,
            m.alt / 1e3,
            horizontal,
            vertical,
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
            self.counts["empty.GPS_GLOBAL_ORIGIN"] += 1
            return
        origin = GeodeticOrigin(m.latitude / 1e7, m.longitude / 1e7, m.altitude / 1e3)
        old = self._origin
        self._origin = origin
        if old is None:
            logger.info(
                "autopilot's origin: %.7f, %.7f, %.2f m AMSL",
                origin.latitude_deg,
                origin.longitude_deg,
                origin.height_amsl_m,
            )
            return
        moved_m = 111e3 * max(
            abs(origin.latitude_deg - old.latitude_deg), abs(origin.longitude_deg - old.longitude_deg)
        )
        if max(moved_m, abs(origin.height_amsl_m - old.height_amsl_m)) > _ORIGIN_MOVED_M:
            # Positions before and after refer to different zeros, even if no jump shows.
            self._epoch += 1
            self.counts["origin_moves"] += 1
            self._log(arrival_ns, logging.WARNING, "origin", "autopilot's origin moved")

    def _on_home(self, m: MavlinkMessage, arrival_ns: int) -> None:
        self._home_known = True

    def _on_system_time(self, m: MavlinkMessage, arrival_ns: int) -> None:
        self._boot_ns(m.time_boot_ms, arrival_ns)

    def _on_extended_state(self, m: MavlinkMessage, arrival_ns: int) -> None:
        on_ground = dialect.MAV_LANDED_STATE_ON_GROUND
        undefined = dialect.MAV_LANDED_STATE_UNDEFINED
        self._landed = None if m.landed_state == undefined else m.landed_state == on_ground

    def _on_ekf_status(self, m: MavlinkMessage, arrival_ns: int) -> None:
        self._estimator = (m.flags, float(m.pos_horiz_variance))

    def _on_estimator_status(self, m: MavlinkMessage, arrival_ns: int) -> None:
        self._estimator = (m.flags, float(m.pos_horiz_ratio))

    def _on_version(self, m: MavlinkMessage, arrival_ns: int) -> None:
        v = m.flight_sw_version
        if v == 0 or self._vehicle is None:
            return
        version = (v >> 24 & 255, v >> 16 & 255, v >> 8 & 255)
        if self._vehicle.firmware_version != version:
            self._vehicle = AutopilotIdentity(self._vehicle.system_id, self._vehicle.autopilot, version)
            logger.info("autopilot's firmware: %s %d.%d.%d", self._vehicle.autopilot.value, *version)

    def _on_status_text(self, m: MavlinkMessage, arrival_ns: int) -> None:
        level = logging.WARNING if m.severity <= Severity.ERROR else logging.INFO
        # Printable only: what comes over a radio must not steer a terminal.
        text = "".join(c if c.isprintable() else "?" for c in str(m.text))
        self._log(arrival_ns, level, f"text.{hash(text) % 64}", f"autopilot says: {text}")

    def _on_command_ack(self, m: MavlinkMessage, arrival_ns: int) -> None:
        if m.result not in (dialect.MAV_RESULT_ACCEPTED, dialect.MAV_RESULT_IN_PROGRESS):
            self.counts["commands_refused"] += 1

    # -- out --------------------

    def poll(self, now_ns: int) -> list[MavlinkMessage]:
        """What is due now."""
        out: list[MavlinkMessage] = []
        if self._heartbeat_timer.due(now_ns):
            out.append(
                dialect.MAVLink_heartbeat_message(
                    type=dialect.MAV_TYPE_ONBOARD_CONTROLLER,
                    autopilot=dialect.MAV_AUTOPILOT_INVALID,
                    base_mode=0,
                    custom_mode=0,
                    system_status=int(self.system_status),
                    mavlink_version=3,
                )
            )
        vehicle = self._vehicle
        if vehicle is None:
            return out
        if now_ns - self._heartbeat_ns > _SILENT_AFTER_NS:
            if not self._silent:
                self._silent = True
                self.counts["silences"] += 1
                logger.warning("autopilot silent: no heartbeat for %d s", _SILENT_AFTER_NS // _S)
            # Nothing is asked of a mute peer; its answers to a backlog of requests would come in one burst.
            return out
        ts1 = self.timesync.due(now_ns)
        if ts1 is not None:
            out.append(dialect.MAVLink_timesync_message(tc1=0, ts1=ts1))
        if vehicle.firmware_version is None and self._version_timer.due(now_ns):
            out.append(self._request(dialect.MAVLINK_MSG_ID_AUTOPILOT_VERSION))
        if (self._origin_timer if self._origin is None else self._origin_watch_timer).due(now_ns):
            out.append(self._request(dialect.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN))
            if self._origin is None and self._offered_origin is not None and self._options.set_origin:
                # Lost before the filter has started, so it goes along with the question until answered.
                out.append(self._set_origin(vehicle.system_id, self._offered_origin))
        if not self._home_known and self._home_timer.due(now_ns):
            out.append(self._request(dialect.MAVLINK_MSG_ID_HOME_POSITION))
        out += [
            self._command(dialect.MAV_CMD_SET_MESSAGE_INTERVAL, stream.message_id, stream.interval_ns / 1e3)
            for stream in self._streams.values()
            if stream.due(now_ns)
        ]
        return out

    def encode_estimate(self, estimate: VisionEstimate) -> list[MavlinkMessage]:
        """The messages for an estimate, in the form that the autopilot found reads; none before it was
        found."""
        if self._vehicle is None:
            return []
        layout = covariance_layout(self._vehicle.autopilot, self._vehicle.firmware_version)
        encoders = {
            "vision_position_estimate": encode_vision_position_estimate,
            "odometry": encode_odometry,
        }
        return [encoders[name](estimate, layout) for name in self._options.send]

    def offer_origin(self, origin: GeodeticOrigin) -> None:
        """See :meth:`AutopilotLink.offer_origin`."""
        self._offered_origin = origin

    def _request(self, message_id: int) -> MavlinkMessage:
        return self._command(dialect.MAV_CMD_REQUEST_MESSAGE, message_id)

    def _command(self, command: int, param1: float, param2: float = 0.0) -> MavlinkMessage:
        return dialect.MAVLink_command_long_message(
            target_system=self._vehicle.system_id if self._vehicle else 0,
            target_component=_AUTOPILOT_COMPONENT,
            command=command,
            confirmation=0,
            param1=float(param1),
            param2=float(param2),
            param3=0.0,
            param4=0.0,
            param5=0.0,
            param6=0.0,
            param7=0.0,
        )

    @staticmethod
    def _set_origin(system_id: int, origin: GeodeticOrigin) -> MavlinkMessage:
        return dialect.MAVLink_set_gps_global_origin_message(
            target_system=system_id,
            latitude=round(origin.latitude_deg * 1e7),
            longitude=round(origin.longitude_deg * 1e7),
            altitude=round(origin.height_amsl_m * 1e3),
        )

    # -- state --------------------

    def state_at(self, stamp_ns: int) -> AutopilotState | None:
        """See :meth:`AutopilotLink.state_at`."""
        if self._vehicle is None:
            return None
        best = self.timesync.best(stamp_ns) if self.timesync.synchronised else None
        by_boot = best is not None
        time_ns = stamp_ns + best[0] if best is not None else stamp_ns
        attitude, interpolated = self._attitude_at(time_ns, by_boot)
        position, velocity, epoch = self._local_at(time_ns, by_boot)
        odometry, odometry_epoch = self._odometry_at(time_ns, by_boot)
        return AutopilotState(
            stamp_ns=stamp_ns,
            ned_from_body=attitude,
            interpolated=interpolated,
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
            estimator_flags=self._estimator[0] if self._estimator else None,
            position_test_ratio=self._estimator[1] if self._estimator else None,
        )

    def _attitude_at(self, time_ns: int, by_boot: bool) -> tuple[FloatArray | None, bool]:
        chosen = _choose(self._attitudes.around(time_ns, by_boot), time_ns, _MAX_EXTRAPOLATION_NS)
        if chosen is None:
            return None, False
        a, b, t = chosen
        first = rotation.from_quaternion(a.quaternion)
        if b is None:
            turned = first @ rotation.exp(np.array(a.rates_rad_s) * t)
        else:
            turned = rotation.slerp(first, rotation.from_quaternion(b.quaternion), t)
        return frozen_floats(turned, (3, 3), "ned_from_body"), b is not None

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
        chosen = _choose(
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
        raw = self._gps_raw
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

    def statistics(self, now_ns: int) -> dict[str, Statistic]:
        """Counters and the state of synchronisation."""
        best = self.timesync.best(now_ns)
        round_trip = self.timesync.last_round_trip_ns
        vehicle = self._vehicle
        version = vehicle.firmware_version if vehicle else None
        return {
            **self.counts,
            "connected": self.connected(now_ns),
            "autopilot": vehicle.autopilot.value if vehicle else None,
            "vehicle_system_id": vehicle.system_id if vehicle else None,
            "firmware": ".".join(map(str, version)) if version else None,
            "origin_known": self._origin is not None,
            "local_epoch": self._epoch,
            "synchronised": self.timesync.synchronised,
            "sync_uncertainty_ms": best[1] / _MS if best else None,
            "sync_resets": self.timesync.resets,
            "round_trip_ms": round_trip / _MS if round_trip is not None else None,
        }


# -- transports --------------------


class _Transport(Protocol):
    """Non-blocking bytes. Every method may raise OSError, after which the transport is closed and opened
    anew."""

    def fileno(self) -> int: ...

    def receive(self) -> list[tuple[bytes, Any]]:
        """What has arrived, with whom it came from."""
        ...

    def send(self, frame: bytes) -> bool:
        """Send or queue a whole frame; False if there is no room or nobody to send to."""
        ...

    def pending(self) -> bool:
        """Whether a part of a frame waits to be written."""
        ...

    def flush(self) -> None: ...

    def prefer(self, peer: Any) -> None:
        """Send to this peer from now on."""
        ...

    def close(self) -> None: ...


class _Udp:
    def __init__(self, endpoint: Endpoint) -> None:
        self._listen = endpoint.kind == "udp"
        host = endpoint.address.strip("[]")
        family, _, _, _, address = socket.getaddrinfo(host, endpoint.port, type=socket.SOCK_DGRAM)[0]
        self._socket = socket.socket(family, socket.SOCK_DGRAM)
        self._peer: Any = None
        try:
            self._socket.setblocking(False)
            if self._listen:
                self._socket.bind(address)
            else:
                self._socket.connect(address)
        except OSError:
            self._socket.close()
            raise

    def fileno(self) -> int:
        return self._socket.fileno()

    def receive(self) -> list[tuple[bytes, Any]]:
        got: list[tuple[bytes, Any]] = []
        # Bounded, so that a flood leaves time to send.
        for _ in range(64):
            try:
                got.append(self._socket.recvfrom(65535))
            except (BlockingIOError, InterruptedError):
                break
            except ConnectionRefusedError:
                continue  # an answer to an earlier datagram: nobody listens there yet
        return got

    def send(self, frame: bytes) -> bool:
        try:
            if not self._listen:
                self._socket.send(frame)
            elif self._peer is None:
                return False
            else:
                self._socket.sendto(frame, self._peer)
        except (BlockingIOError, ConnectionRefusedError):
            return False
        return True

    def pending(self) -> bool:
        return False

    def flush(self) -> None:
        pass

    def prefer(self, peer: Any) -> None:
        self._peer = peer

    def close(self) -> None:
        self._socket.close()


class _Device(Protocol):
    """A socket or a serial port."""

    def fileno(self) -> int: ...

    def close(self) -> None: ...


class _ByteStream:
    """TCP and serial: read and written by file descriptor, with one bounded buffer for what did not go
    out."""

    def __init__(self, device: _Device, name: str) -> None:
        self._device, self._name = device, name
        self._out = bytearray()

    def fileno(self) -> int:
        return self._device.fileno()

    def receive(self) -> list[tuple[bytes, Any]]:
        try:
            data = os.read(self._device.fileno(), 65536)
        except (BlockingIOError, InterruptedError):
            return []
        if not data:
            # Readable without data: the peer closed, or the adapter was pulled out.
            raise ConnectionError(f"{self._name} was closed by the other side")
        return [(data, None)]

    def send(self, frame: bytes) -> bool:
        if len(self._out) + len(frame) > _OUT_LIMIT_BYTES:
            return False
        self._out += frame
        self.flush()
        return True

    def pending(self) -> bool:
        return bool(self._out)

    def flush(self) -> None:
        with contextlib.suppress(BlockingIOError, InterruptedError):
            while self._out:
                del self._out[: os.write(self._device.fileno(), self._out)]

    def prefer(self, peer: Any) -> None:
        pass

    def close(self) -> None:
        with contextlib.suppress(OSError):
            self._device.close()


def _open(endpoint: Endpoint) -> _Transport:
    """Raises: OSError (pyserial's exceptions are such)."""
    if endpoint.kind in ("udp", "udpout"):
        return _Udp(endpoint)
    if endpoint.kind == "tcp":
        connection = socket.create_connection((endpoint.address.strip("[]"), endpoint.port), timeout=1.0)
        connection.setblocking(False)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        return _ByteStream(connection, f"tcp {endpoint.address}:{endpoint.port}")
    try:
        # exclusive: two processes that read one line each get half of every frame.
        port = serial.Serial(endpoint.address, endpoint.port, timeout=0, write_timeout=0, exclusive=True)
    except ValueError as error:  # a baud rate that the driver refuses
        raise OSError(str(error)) from error
    return _ByteStream(port, endpoint.address)


# -- the thread --------------------


class AutopilotLink:
    """The daemon's side of the link; every method may be called from any thread.

    Nothing is raised once started: a link that is down shows in :meth:`statistics`, in ``state_at(...)`` and
    in the log, and is opened again with a growing pause. If the thread meets a defect of our own again and
    again it ends, and :attr:`failure` says why; the daemon should then end too.
    """

    def __init__(self, options: LinkOptions, clock: Clock) -> None:
        """Raises: ConfigError if the endpoint can't be understood."""
        self._endpoint = parse_endpoint(options.endpoint)
        self._options, self._clock = options, clock
        self._protocol = LinkProtocol(options)
        self._mav = dialect.MAVLink(None, 0, options.component_id)
        self._lock = threading.Lock()
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self._transport: _Transport | None = None
        self._wake_pair: tuple[socket.socket, socket.socket] | None = None
        self._estimate: VisionEstimate | None = None
        self._texts: deque[MavlinkMessage] = deque(maxlen=16)
        self._text_id = 0
        self._log = LimitedLog()
        self._counts: Counter[str] = Counter()
        self._parsers: dict[Any, FrameParser] = {}
        self._retired = Counter[str]()
        self._open_ok = False
        self._peer_is_vehicle = False
        self.failure: BaseException | None = None

    def __enter__(self) -> AutopilotLink:
        self.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()

    def start(self, open_now: bool = False) -> None:
        """Start the thread. A device that is not there yet is waited for.

        Args:
            open_now: open the device here and now instead.
        Raises: LinkError if ``open_now`` and it can't be opened.
        """
        if self._thread is not None:
            raise RuntimeError("this link was started before; make a new one")
        if open_now:
            try:
                self._transport = _open(self._endpoint)
            except OSError as error:
                raise LinkError(
                    f"link endpoint {self._options.endpoint} can't be opened: {error}; check that the device "
                    "exists, is not in use, and that the user may open it"
                ) from error
        receiver, sender = self._wake_pair = socket.socketpair()
        receiver.setblocking(False)
        sender.setblocking(False)
        self._thread = threading.Thread(
            target=self._run, args=(receiver,), name="autopilot-link", daemon=True
        )
        self._thread.start()

    def stop(self) -> None:
        """End the thread and close the device. Idempotent."""
        self._stop.set()
        self._wake()
        if self._thread is not None:
            self._thread.join(timeout=5.0)
            if self._thread.is_alive():
                logger.error("the autopilot link's thread did not end within 5 s; its device stays open")
                return
        if self._transport is not None:
            self._transport.close()
            self._transport = None
        for end in self._wake_pair or ():
            end.close()

    def is_alive(self) -> bool:
        """Whether the thread runs."""
        return self._thread is not None and self._thread.is_alive()

    @property
    def vehicle(self) -> AutopilotIdentity | None:
        """The autopilot found, or None so far."""
        with self._lock:
            return self._protocol.vehicle

    def connected(self) -> bool:
        """Whether the autopilot's heartbeat came within 3 s."""
        with self._lock:
            return self._protocol.connected(self._clock.now_ns())

    def state_at(self, stamp_ns: int) -> AutopilotState | None:
        """What the autopilot knew at a stamp of our clock; None before an autopilot was found.

        Attitude is interpolated on the sphere, or carried on by its rates up to 0.2 s beyond the history; it
        is never merely the latest. Parts that are not known at that stamp are None.
        """
        with self._lock:
            return self._protocol.state_at(stamp_ns)

    def send_estimate(self, estimate: VisionEstimate) -> None:
        """Hand an estimate over. One that was not sent yet is replaced and counted: newer is better."""
        with self._lock:
            if self._estimate is not None:
                self._counts["estimates_dropped"] += 1
            self._estimate = estimate
        self._wake()

    def send_status_text(self, severity: Severity, text: str) -> None:
        """Show a line at the ground station. Cut at 200 characters; of more than 16 waiting parts the oldest
        go."""
        data = text.encode("ascii", "replace")[:200]
        parts = [data[i : i + 50] for i in range(0, len(data), 50)] or [b""]
        with self._lock:
            # Id 0 says that a text is whole; others tie its parts together.
            self._text_id = self._text_id % 65535 + 1
            for i, part in enumerate(parts):
                if len(self._texts) == self._texts.maxlen:
                    self._counts["texts_dropped"] += 1
                self._texts.append(
                    dialect.MAVLink_statustext_message(
                        severity=int(severity),
                        text=part,
                        id=self._text_id if len(parts) > 1 else 0,
                        chunk_seq=i,
                    )
                )
        self._wake()

    def set_system_status(self, status: SystemStatus) -> None:
        """What the next HEARTBEAT says."""
        with self._lock:
            self._protocol.system_status = status

    def offer_origin(self, origin: GeodeticOrigin) -> None:
        """Set the EKF origin if the autopilot turns out to have none and ``options.set_origin`` allows it.

        Repeated until the autopilot tells an origin. That one counts, whether it is ours or not.
        """
        with self._lock:
            self._protocol.offer_origin(origin)

    def statistics(self) -> dict[str, Statistic]:
        """Counters since the start, flat: ``sent.NAME``, ``received.NAME``, ``bad_frames``, ``reconnects``
        ..."""
        with self._lock:
            parsers = list(self._parsers.values())
            return {
                "open": self._open_ok,
                "reconnects": self._counts["reconnects"],
                "estimates_dropped": self._counts["estimates_dropped"],
                **self._counts,
                "bad_frames": self._retired["bad_frames"] + sum(p.bad_frames for p in parsers),
                "bad_bytes": self._retired["bad_bytes"] + sum(p.bad_bytes for p in parsers),
                "unknown_frames": self._retired["unknown_frames"] + sum(p.unknown_frames for p in parsers),
                **self._protocol.statistics(self._clock.now_ns()),
            }

    # -- in the thread --------------------

    def _wake(self) -> None:
        # Full: it is about to wake anyway. Closed: there is nothing to wake.
        if self._wake_pair is not None:
            with contextlib.suppress(OSError):
                self._wake_pair[1].send(b"\0")

    def _run(self, wake_receiver: socket.socket) -> None:
        try:
            self._connect_and_serve(wake_receiver)
        except BaseException as error:
            self.failure = error
            logger.exception("the autopilot link ends")

    def _connect_and_serve(self, wake_receiver: socket.socket) -> None:
        backoff_s = _BACKOFF_MIN_S
        while not self._stop.is_set():
            try:
                if self._transport is None:
                    self._transport = _open(self._endpoint)
            except OSError as error:
                self._counts["open_failures"] += 1
                self._log(
                    self._clock.now_ns(),
                    logging.WARNING,
                    "open",
                    f"link endpoint {self._options.endpoint} can't be opened: {error}; trying again",
                )
                self._stop.wait(backoff_s)
                backoff_s = min(2.0 * backoff_s, _BACKOFF_MAX_S)
                continue
            logger.info("link open: %s", self._options.endpoint)
            self._open_ok = True
            before = self._counts["messages"]
            try:
                self._serve(self._transport, wake_receiver)
            except OSError as error:
                self._counts["reconnects"] += 1
                self._log(
                    self._clock.now_ns(),
                    logging.WARNING,
                    "lost",
                    f"link {self._options.endpoint} lost: {error}; opening again",
                )
            self._open_ok = False
            with self._lock:
                for parser in self._parsers.values():
                    self._retire(parser)
                self._parsers.clear()
                self._peer_is_vehicle = False
            self._transport.close()
            self._transport = None
            if not self._stop.is_set():
                # A peer that accepts and hangs up at once must not be called upon without end.
                if self._counts["messages"] > before:
                    backoff_s = _BACKOFF_MIN_S
                self._stop.wait(backoff_s)
                backoff_s = min(2.0 * backoff_s, _BACKOFF_MAX_S)

    def _serve(self, transport: _Transport, wake_receiver: socket.socket) -> None:
        errors_in_a_row = 0
        last_heard_ns: int | None = None
        while not self._stop.is_set():
            writers = [transport] if transport.pending() else []
            readers: list[_Transport | socket.socket] = [transport, wake_receiver]
            readable, writable, _ = select.select(readers, writers, [], _SELECT_TIMEOUT_S)
            if wake_receiver in readable:
                with contextlib.suppress(BlockingIOError):
                    wake_receiver.recv(4096)
            if writable:
                transport.flush()
            now_ns = self._clock.now_ns()
            arrived = transport.receive() if transport in readable else []
            if arrived:
                last_heard_ns = now_ns
            elif (
                self._endpoint.kind == "tcp"
                and last_heard_ns is not None
                and now_ns - last_heard_ns > _TCP_SILENCE_NS
            ):
                raise ConnectionError(f"nothing came for {_TCP_SILENCE_NS // _S} s")
            try:
                for data, peer in arrived:
                    self._take(transport, data, peer, now_ns)
                self._say(transport)
                errors_in_a_row = 0
            except OSError:
                raise
            except Exception:
                # A defect of ours must not take attitude and estimates from the vehicle; unless it stays.
                self._counts["internal_errors"] += 1
                errors_in_a_row += 1
                if errors_in_a_row >= _GIVE_UP_AFTER_ERRORS:
                    raise
                logger.exception("autopilot link: one item was left out")

    def _take(self, transport: _Transport, data: bytes, peer: Any, now_ns: int) -> None:
        with self._lock:
            parser = self._parsers.get(peer)
            if parser is None:
                # Any host can send us datagrams, each with a parser of its own; the oldest goes.
                if len(self._parsers) >= 8:
                    self._retire(self._parsers.pop(next(iter(self._parsers))))
                parser = self._parsers[peer] = FrameParser()
        for message in parser.feed(data, now_ns):
            self._counts["messages"] += 1
            with self._lock:
                answers = self._protocol.on_message(message, now_ns)
                vehicle = self._protocol.vehicle
            # Replies go where our autopilot is. Until it was heard, to whoever speaks MAVLink.
            ours = vehicle is not None and message.get_srcSystem() == vehicle.system_id
            if ours and self._protocol.is_vehicle_heartbeat(message):
                transport.prefer(peer)
                self._peer_is_vehicle = True
            elif not self._peer_is_vehicle:
                transport.prefer(peer)
            for answer in answers:
                self._send(transport, answer)

    def _retire(self, parser: FrameParser) -> None:
        for name in ("bad_frames", "bad_bytes", "unknown_frames"):
            self._retired[name] += getattr(parser, name)

    def _say(self, transport: _Transport) -> None:
        now_ns = self._clock.now_ns()
        with self._lock:
            messages = self._protocol.poll(now_ns)
            # While bytes wait, an estimate stays in its slot, where a newer one can still replace it.
            if self._estimate is not None and not transport.pending():
                estimate, self._estimate = self._estimate, None
                encoded = self._protocol.encode_estimate(estimate) if self._protocol.connected(now_ns) else []
                if not encoded:
                    self._counts["estimates_dropped"] += 1
                messages = encoded + messages
            while self._texts:
                messages.append(self._texts.popleft())
        for message in messages:
            self._send(transport, message)

    def _send(self, transport: _Transport, message: MavlinkMessage) -> None:
        self._mav.srcSystem = self._protocol.own_system_id
        frame = bytes(message.pack(self._mav))
        if transport.send(frame):
            self._mav.seq = (self._mav.seq + 1) % 256
            self._counts[f"sent.{message.get_type()}"] += 1
        else:
            self._counts["unsent"] += 1
            if message.get_type() in ("ODOMETRY", "VISION_POSITION_ESTIMATE"):
                self._counts["estimates_dropped"] += 1
