"""The mission: kept, uploaded and read by MAVLink's mission protocol. Which item is flown is the owner's to say."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ortholoc_edge.geometry.arrays import FloatArray
from ortholoc_sim.autopilot.dialect import Message, dialect
from ortholoc_sim.autopilot.frame import LocalFrame
from ortholoc_sim.autopilot.options import Stack
from ortholoc_sim.site import Geopoint

_FLOWN = (
    dialect.MAV_CMD_NAV_WAYPOINT, dialect.MAV_CMD_NAV_LOITER_UNLIM, dialect.MAV_CMD_NAV_LOITER_TIME,
    dialect.MAV_CMD_NAV_TAKEOFF, dialect.MAV_CMD_NAV_SPLINE_WAYPOINT,
)  # fmt: skip
_HOME = (dialect.MAV_CMD_NAV_RETURN_TO_LAUNCH,)
_ABSOLUTE = (dialect.MAV_FRAME_GLOBAL, dialect.MAV_FRAME_GLOBAL_INT)
_RELATIVE = (dialect.MAV_FRAME_GLOBAL_RELATIVE_ALT, dialect.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT)
_MOST_ITEMS = 500
# Both stacks ask again for an item that does not come, and give an upload up after some of that.
_AGAIN_NS, _ATTEMPTS = 1_000_000_000, 5


@dataclass(frozen=True, slots=True)
class Item:
    """One item as MISSION_ITEM_INT carries it; heights of ``frame``."""

    command: int
    frame: int
    lat_e7: int
    lon_e7: int
    alt_m: float
    params: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    autocontinue: int = 1


class Mission:
    """State machine of one mission; uploads by one partner at a time.

    Attributes:
        MESSAGES: names of those that `handle` knows.
        items: as uploaded. ArduPilot's item 0 is home and not flown.
        current: the item that is flown; set by the owner.
        revision: rises with each mission that came whole.
    """

    MESSAGES = frozenset({
        "MISSION_REQUEST_LIST", "MISSION_REQUEST_INT", "MISSION_REQUEST", "MISSION_COUNT", "MISSION_ITEM_INT",
        "MISSION_CLEAR_ALL", "MISSION_SET_CURRENT",
    })  # fmt: skip

    def __init__(self, stack: Stack, frame: LocalFrame) -> None:
        self._stack, self._frame = stack, frame
        self.items: list[Item] = []
        self.current = self._first_target = 0
        self.revision = 0
        self._upload: list[Item] | None = None
        self._count = self._attempts = self._due_ns = 0
        self._partner = (0, 0)
        self._handlers: dict[str, Callable[[Message, int], Message]] = {
            "MISSION_REQUEST_LIST": self._on_list,
            "MISSION_REQUEST_INT": self._on_request,
            "MISSION_REQUEST": self._on_request,
            "MISSION_CLEAR_ALL": self._on_clear,
            # Which item is flown follows from where the vehicle is; told, not obeyed.
            "MISSION_SET_CURRENT": lambda m, now_ns: self.current_message(),
            "MISSION_COUNT": self._on_count,
            "MISSION_ITEM_INT": self._on_item,
        }

    @property
    def first(self) -> int:
        """Index of the first item that is flown."""
        return 1 if self._stack == "ardupilot" else 0

    def target(self, leg: int) -> int:
        """Index of the item to which a leg of the route leads."""
        count = len(self.items) - self.first
        return self.first + (self._first_target - self.first + leg) % count if count > 0 else 0

    def set_route(self, waypoints_ned_m: FloatArray) -> None:
        """Take (N, 3) positions of the filter's frame, N >= 2, as the mission."""
        points = [self._frame.geopoint(np.asarray(p, dtype=np.float64)) for p in waypoints_ned_m]
        items = [
            Item(
                dialect.MAV_CMD_NAV_WAYPOINT, dialect.MAV_FRAME_GLOBAL, round(p.lat_deg * 1e7), round(p.lon_deg * 1e7),
                p.height_amsl_m,
            )
            for p in points
        ]  # fmt: skip
        self.items = [items[0], *items] if self._stack == "ardupilot" else items
        # The flight begins at the first waypoint and goes to the second.
        self.current = self._first_target = self.first + 1

    def route(self, home: Geopoint, start_ned_m: FloatArray) -> FloatArray:
        """(N, 3) positions of the filter's frame: where it is now, then each item that is a place."""
        points = [np.asarray(start_ned_m, dtype=np.float64)]
        for item in self.items[self.first :]:
            if item.command in _HOME:
                at = self._frame.inner(home)
                points.append(np.array([at[0], at[1], points[-1][2]]))
            else:
                above = home.height_amsl_m if item.frame in _RELATIVE else 0.0
                points.append(self._frame.inner(Geopoint(item.lat_e7 / 1e7, item.lon_e7 / 1e7, item.alt_m + above)))
        if len(points) == 1:
            points.append(points[0] + np.array([1.0, 0.0, 0.0]))
        return np.array(points)

    # -- the protocol --------------------

    def handle(self, message: Message, now_ns: int) -> list[Message]:
        """A message of the protocol, addressed to us."""
        self._partner = (message.get_srcSystem(), message.get_srcComponent())
        if getattr(message, "mission_type", 0) != dialect.MAV_MISSION_TYPE_MISSION:
            return [self._ack(dialect.MAV_MISSION_UNSUPPORTED, message.mission_type)]
        return [self._handlers[message.get_type()](message, now_ns)]

    def _on_list(self, m: Message, now_ns: int) -> Message:
        return dialect.MAVLink_mission_count_message(
            target_system=self._partner[0], target_component=self._partner[1], count=len(self.items)
        )

    def _on_request(self, m: Message, now_ns: int) -> Message:
        return self._tell(m.seq) if m.seq < len(self.items) else self._ack(dialect.MAV_MISSION_INVALID_SEQUENCE)

    def _on_clear(self, m: Message, now_ns: int) -> Message:
        self.items, self.current, self._first_target = [], 0, 0
        self.revision += 1
        return self._ack(dialect.MAV_MISSION_ACCEPTED)

    def step(self, now_ns: int) -> list[Message]:
        """Ask again for an item that did not come."""
        if self._upload is None or now_ns < self._due_ns:
            return []
        self._attempts += 1
        if self._attempts > _ATTEMPTS:
            self._upload = None
            return [self._ack(dialect.MAV_MISSION_OPERATION_CANCELLED)]
        return [self._ask(now_ns)]

    def current_message(self) -> Message:
        """MISSION_CURRENT."""
        return dialect.MAVLink_mission_current_message(seq=self.current, total=len(self.items))

    def _on_count(self, m: Message, now_ns: int) -> Message:
        if m.count > _MOST_ITEMS:
            return self._ack(dialect.MAV_MISSION_NO_SPACE)
        if m.count == 0:
            return self._on_clear(m, now_ns)
        self._upload, self._count, self._attempts = [], m.count, 0
        return self._ask(now_ns)

    def _ask(self, now_ns: int) -> Message:
        assert self._upload is not None
        self._due_ns = now_ns + _AGAIN_NS
        return dialect.MAVLink_mission_request_int_message(
            target_system=self._partner[0], target_component=self._partner[1], seq=len(self._upload)
        )

    def _on_item(self, m: Message, now_ns: int) -> Message:
        upload = self._upload
        if upload is None or m.seq > len(upload):
            return self._ack(dialect.MAV_MISSION_INVALID_SEQUENCE)
        if m.seq < len(upload):
            return self._ask(now_ns)  # a repetition of what was lost on the way
        placed = m.command in _FLOWN
        if not (m.command in _HOME or (placed and m.frame in (*_ABSOLUTE, *_RELATIVE))):
            self._upload = None
            wrong = dialect.MAV_MISSION_UNSUPPORTED_FRAME if placed else dialect.MAV_MISSION_UNSUPPORTED
            return self._ack(wrong)
        params = (float(m.param1), float(m.param2), float(m.param3), float(m.param4))
        upload.append(Item(m.command, m.frame, m.x, m.y, float(m.z), params, m.autocontinue))
        self._attempts = 0
        if len(upload) < self._count:
            return self._ask(now_ns)
        self.items, self._upload = upload, None
        self.current = self._first_target = self.first
        self.revision += 1
        return self._ack(dialect.MAV_MISSION_ACCEPTED)

    def _tell(self, seq: int) -> Message:
        item = self.items[seq]
        p1, p2, p3, p4 = item.params
        return dialect.MAVLink_mission_item_int_message(
            target_system=self._partner[0], target_component=self._partner[1], seq=seq, frame=item.frame,
            command=item.command, current=int(seq == self.current), autocontinue=item.autocontinue, param1=p1,
            param2=p2, param3=p3, param4=p4, x=item.lat_e7, y=item.lon_e7, z=item.alt_m,
        )  # fmt: skip

    def _ack(self, result: int, mission_type: int = 0) -> Message:
        return dialect.MAVLink_mission_ack_message(
            target_system=self._partner[0], target_component=self._partner[1], type=result, mission_type=mission_type
        )
