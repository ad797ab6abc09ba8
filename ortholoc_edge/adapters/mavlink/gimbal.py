"""Where a gimbal looks: GIMBAL_DEVICE_ATTITUDE_STATUS and the older MOUNT_ORIENTATION; no I/O, no own clock.

Both give roll and pitch against the horizon, not against the vehicle: a gimbal that looks straight down while the
vehicle banks says "straight down". Only yaw is a matter of convention, and each sample says of which:

- relative to where the nose points (``YAW_IN_VEHICLE_FRAME``, MOUNT_ORIENTATION's ``yaw``): turned by the
  vehicle's heading alone, as the autopilot had it at the exposure, it is the attitude in NED;
- from north (``YAW_IN_EARTH_FRAME``, ``yaw_absolute``): it is that already;
- neither flag: from north if ``YAW_LOCK`` is set, else relative to the nose.

``delta_yaw`` is not used: it relates the two at the time of the sample, the buffered attitude does at the exposure.
"""

from __future__ import annotations

import logging
import math
from collections import Counter
from dataclasses import dataclass, field, replace

import numpy as np

from ortholoc_edge.adapters.mavlink.codec import MavlinkMessage, dialect
from ortholoc_edge.adapters.mavlink.history import TimeHistory, choose
from ortholoc_edge.adapters.mavlink.log import LimitedLog
from ortholoc_edge.adapters.mavlink.streams import Stream
from ortholoc_edge.geometry import rotation
from ortholoc_edge.geometry.arrays import FloatArray, frozen_floats

_MS, _S = 1_000_000, 1_000_000_000

GIMBAL_MESSAGES = ("GIMBAL_DEVICE_ATTITUDE_STATUS", "MOUNT_ORIENTATION")
AUTOPILOT_COMPONENT = 1

# Gimbal device ids up to this are those that the autopilot speaks for; others are component ids.
_LAST_OF_AUTOPILOT = 6
RATE_HZ = 20.0
_HISTORY_NS = 5 * _S
_CAPACITY = 500
# A gimbal quiet for longer than the best one is gone; one of lower rank may take its place.
_GONE_AFTER_NS = 2 * _S
# Whoever speaks on the link can invent gimbals, each with a history.
_MAX_SOURCES = 8
# How well the time of a report is known, beyond the delay that is configured: by a stamp of the autopilot's, which
# itself had it from the gimbal a little before; and by arrival, after a forwarding autopilot and a busy line.
_STAMP_SIGMA_NS, _ARRIVAL_SIGMA_NS = 10 * _MS, 25 * _MS
# With the nose closer to the vertical than about 10 degrees its heading is noise.
_LEAST_LEVEL_NOSE = 0.17
# Failures after which its attitude may be anything; the rest are of motors and limits.
_ATTITUDE_FAILURES = (
    dialect.GIMBAL_DEVICE_ERROR_FLAGS_ENCODER_ERROR
    | dialect.GIMBAL_DEVICE_ERROR_FLAGS_SOFTWARE_ERROR
    | dialect.GIMBAL_DEVICE_ERROR_FLAGS_COMMS_ERROR
    | dialect.GIMBAL_DEVICE_ERROR_FLAGS_CALIBRATION_RUNNING
)


@dataclass(frozen=True, slots=True)
class GimbalSelection:
    """Which gimbal carries the camera, and how its reports are taken.

    Attributes:
        device: MAVLink's gimbal device id: 1 to 6 is one that the autopilot speaks for, more is the component id of
            one with a voice of its own (154 is MAV_COMP_ID_GIMBAL). None: whichever is heard, if it is only one.
        delay_ns: a report stamped t tells the attitude of t - delay_ns.
        max_age_ns: farther than this from a report nothing is known.
    """

    device: int | None = None
    delay_ns: int = 0
    max_age_ns: int = 200 * _MS


@dataclass(frozen=True, slots=True, eq=False)
class GimbalAttitude:
    """Where a gimbal looked at a stamp.

    Attributes:
        ned_from_gimbal: (3, 3), true north, of its axes: forward along the line of sight, right, down.
        interpolated: whether it lies between two reports; if not, asking again a little later gives a better one.
        sigma_rad: what it may have turned in the time that the stamp is away from what is known.
    """

    ned_from_gimbal: FloatArray
    interpolated: bool
    sigma_rad: float


@dataclass(frozen=True, slots=True, eq=False)
class _Report:
    """``level_from_gimbal`` (3, 3): into axes that are level, with x to north, or below the nose; and how fast it
    turned in those since the report before."""

    level_from_gimbal: FloatArray
    from_north: bool
    rate_rad_s: float = 0.0


@dataclass(frozen=True, slots=True)
class _Source:
    """Who reports, and how. ``rank``: the lower, the better; ``stamped``: by the autopilot's clock."""

    rank: int
    component: int
    device: int
    stamped: bool

    def __str__(self) -> str:
        kind = GIMBAL_MESSAGES[self.rank // 2]
        return f"{kind} of component {self.component}, device {self.device}"


@dataclass(slots=True, eq=False)
class _Heard:
    history: TimeHistory[_Report] = field(default_factory=lambda: TimeHistory(_HISTORY_NS, _CAPACITY))
    arrival_ns: int = 0


class Gimbal:
    """Takes in what gimbals report and tells where the camera's one looked at a stamp."""

    def __init__(self, selection: GimbalSelection, counts: Counter[str]) -> None:
        """
        Args:
            counts: where what is dropped is counted.
        """
        self._selection, self._counts = selection, counts
        self._log = LimitedLog()
        self._sources: dict[_Source, _Heard] = {}
        self._status_stream = Stream(dialect.MAVLINK_MSG_ID_GIMBAL_DEVICE_ATTITUDE_STATUS, RATE_HZ)
        self._orientation_stream = Stream(dialect.MAVLINK_MSG_ID_MOUNT_ORIENTATION, RATE_HZ)

    def forget(self) -> None:
        """Drop all that does not survive a restart of the autopilot, and ask again."""
        self._sources.clear()
        self._status_stream.restart()
        self._orientation_stream.restart()

    def requests(self, now_ns: int) -> list[tuple[int, int, int]]:
        """(component, message id, interval in ns) of the streams to ask for now."""
        asked = []
        if self._status_stream.due(now_ns):
            asked.append(self._status_stream)
        # Deprecated, and refused by many: only where the newer one does not come, and so from the second round on.
        elif not any(source.rank < 2 for source in self._alive()) and self._status_stream.attempts:
            asked += [self._orientation_stream] if self._orientation_stream.due(now_ns) else []
        return [(self._speaker(), stream.message_id, stream.interval_ns) for stream in asked]

    def _speaker(self) -> int:
        """The component to ask."""
        device = self._selection.device
        if device is not None:
            return device if device > _LAST_OF_AUTOPILOT else AUTOPILOT_COMPONENT
        best = self._best()
        return best[0].component if best else AUTOPILOT_COMPONENT

    # -- in --------------------

    def take(self, message: MavlinkMessage, boot_ns: int | None, arrival_ns: int) -> None:
        """Take in one of `GIMBAL_MESSAGES`.

        Args:
            boot_ns: its stamp by the autopilot's clock; None where the sender is another component, which counts
                from its own start, or left the stamp out. It is then placed by its arrival.
        """
        component, kind = message.get_srcComponent(), message.get_type()
        if kind == "MOUNT_ORIENTATION":
            device, rank, report = 1, 2, _orientation(message)
        else:
            # Firmware older than the field has one gimbal.
            device = message.gimbal_device_id or 1
            rank, report = int(component != AUTOPILOT_COMPONENT), _status(message)
        wanted = self._selection.device
        if wanted is not None and wanted != (device if component == AUTOPILOT_COMPONENT else component):
            self._counts["other_gimbals"] += 1
            return
        (self._orientation_stream if rank == 2 else self._status_stream).heard(arrival_ns)
        if isinstance(report, str):
            self._counts["garbage.gimbal"] += 1
            self._log(arrival_ns, logging.WARNING, "garbage", f"the gimbal reported {report}; dropped")
            return
        source = _Source(rank, component, device, boot_ns is not None)
        if source not in self._sources and len(self._sources) >= _MAX_SOURCES:
            del self._sources[min(self._sources, key=lambda known: self._sources[known].arrival_ns)]
        if source not in self._sources:
            self._log(arrival_ns, logging.INFO, "heard", f"a gimbal reports: {source}")
        heard = self._sources.setdefault(source, _Heard())
        heard.arrival_ns = arrival_ns
        time_ns = arrival_ns if boot_ns is None else boot_ns
        before, _ = heard.history.around(time_ns, by_boot=True)
        if before is not None and before[0] < time_ns and before[1].from_north is report.from_north:
            turn_rad = rotation.angle_between(before[1].level_from_gimbal, report.level_from_gimbal)
            report = replace(report, rate_rad_s=turn_rad / ((time_ns - before[0]) / _S))
        if not heard.history.add(time_ns, arrival_ns, report):
            self._counts["out_of_order"] += 1

    # -- at a stamp --------------------

    def _alive(self) -> list[_Source]:
        newest = max((heard.arrival_ns for heard in self._sources.values()), default=0)
        return [source for source, heard in self._sources.items() if newest - heard.arrival_ns <= _GONE_AFTER_NS]

    def _best(self) -> list[_Source]:
        alive = self._alive()
        return [source for source in alive if source.rank == min(other.rank for other in alive)]

    def __str__(self) -> str:
        """Who reports: one, or more that nothing tells apart, or nobody."""
        return "; ".join(sorted(map(str, self._best()))) or "none heard"

    def at(
        self, stamp_ns: int, boot_offset_ns: int | None, ned_from_body: FloatArray | None
    ) -> GimbalAttitude | None:
        """Where it looked at a stamp of our clock; None if that is not known.

        Args:
            boot_offset_ns: the autopilot's clock minus ours; None while not synchronised.
            ned_from_body: (3, 3) of the vehicle at the stamp, for its heading.
        """
        best = self._best()
        if not best:
            return None
        if len(best) > 1:
            self._log(
                stamp_ns,
                logging.WARNING,
                "ambiguous",
                f"{len(best)} gimbals report ({'; '.join(sorted(map(str, best)))}) and nothing tells which one "
                'carries the camera; set [mount] gimbal = "device" and gimbal_device',
            )
            return None
        (source,) = best
        by_boot = source.stamped and boot_offset_ns is not None
        time_ns = stamp_ns + self._selection.delay_ns + (boot_offset_ns or 0 if by_boot else 0)
        chosen = choose(
            self._sources[source].history.around(time_ns, by_boot),
            time_ns,
            self._selection.max_age_ns,
            lambda a, b: a.from_north is b.from_north,
        )
        if chosen is None:
            return None
        first, second, fraction = chosen
        turned, rate_rad_s = first.level_from_gimbal, first.rate_rad_s
        away_s = (_STAMP_SIGMA_NS if source.stamped else _ARRIVAL_SIGMA_NS) / _S
        if second is None:
            away_s = math.hypot(away_s, fraction)
        else:
            turned, rate_rad_s = rotation.slerp(turned, second.level_from_gimbal, fraction), second.rate_rad_s
        if not first.from_north:
            if ned_from_body is None or math.hypot(*ned_from_body[:2, 0]) < _LEAST_LEVEL_NOSE:
                return None
            turned = rotation.from_euler(0.0, 0.0, rotation.to_euler(ned_from_body)[2]) @ turned
        known = frozen_floats(turned, (3, 3), "ned_from_gimbal")
        return GimbalAttitude(known, second is not None, rate_rad_s * away_s)


def _status(m: MavlinkMessage) -> _Report | str:
    """What a GIMBAL_DEVICE_ATTITUDE_STATUS says, or why it can't be used."""
    vehicle = bool(m.flags & dialect.GIMBAL_DEVICE_FLAGS_YAW_IN_VEHICLE_FRAME)
    earth = bool(m.flags & dialect.GIMBAL_DEVICE_FLAGS_YAW_IN_EARTH_FRAME)
    q = np.array(m.q, dtype=np.float64)
    if m.failure_flags & _ATTITUDE_FAILURES:
        return f"failure flags {m.failure_flags}"
    if not 0.9 < float(np.linalg.norm(q)) < 1.1:
        return f"quaternion {q.tolist()}"
    if vehicle and earth:
        return f"flags {m.flags}, yaw both in the vehicle's and in the earth's frame"
    if not vehicle and not earth:
        earth = bool(m.flags & dialect.GIMBAL_DEVICE_FLAGS_YAW_LOCK)
    return _Report(rotation.from_quaternion(q), earth)


def _orientation(m: MavlinkMessage) -> _Report | str:
    """What a MOUNT_ORIENTATION says, or why it can't be used."""
    yaw, from_north = m.yaw, False
    # An extension: zero may mean that it was left out.
    if not math.isfinite(yaw) and m.yaw_absolute != 0.0:
        yaw, from_north = m.yaw_absolute, True
    angles = [m.roll, m.pitch, yaw]
    if not all(math.isfinite(angle) and abs(angle) <= 360.0 for angle in angles):
        return f"angles {angles} deg"
    return _Report(rotation.from_euler(*(math.radians(angle) for angle in angles)), from_north)
