"""Where somebody at a ground station says the vehicle is: MAV_CMD_EXTERNAL_POSITION_ESTIMATE addressed to us.

What comes of it is decided by the thread that owns the flight, and the link's must not wait for that: a command is left
with it, and answered by a COMMAND_ACK of a later exchange.
"""

from __future__ import annotations

import logging
import math
from collections import Counter
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass

from ortholoc_edge.adapters.mavlink.codec import MavlinkMessage, dialect

logger = logging.getLogger(__name__)

_S = 1_000_000_000
# After that it is withdrawn; as for commands from the bus.
_WAIT_NS = 5 * _S
# One that was answered later than it was sent again is not carried out twice.
_PAUSE_NS = 1 * _S
_MOST_SIGMA_M, _MOST_PROCESSING_S = 1e5, 60.0
# Frames of places on the earth, and those whose height is above mean sea level.
_AMSL = (dialect.MAV_FRAME_GLOBAL, dialect.MAV_FRAME_GLOBAL_INT)
_FRAMES = (
    *_AMSL, dialect.MAV_FRAME_GLOBAL_RELATIVE_ALT, dialect.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT,
    dialect.MAV_FRAME_GLOBAL_TERRAIN_ALT, dialect.MAV_FRAME_GLOBAL_TERRAIN_ALT_INT,
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class GivenPlace:
    """Of the vehicle, as somebody gave it.

    Attributes:
        lat_deg, lon_deg: WGS 84.
        height_amsl_m: None: not given.
        sigma_m: horizontal 1-sigma; None: not known.
        age_s: how old it was when it was sent.
    """

    lat_deg: float
    lon_deg: float
    height_amsl_m: float | None
    sigma_m: float | None
    age_s: float


# Leaves it for the thread that owns the flight: whether it is taken. None: too much waits there already.
LeavePlace = Callable[[GivenPlace], "Future[bool] | None"]


def place_of(m: MavlinkMessage) -> GivenPlace | None:
    """What a COMMAND_INT or COMMAND_LONG says; None for what can't be meant."""
    if m.get_type() == "COMMAND_INT":
        if m.frame not in _FRAMES:
            return None
        lat, lon, height = m.x / 1e7, m.y / 1e7, m.z if m.frame in _AMSL else math.nan
    else:
        lat, lon, height = m.param5, m.param6, m.param7
    age_s, sigma_m = m.param2, m.param3
    # Comparisons that NaN fails.
    plausible = abs(lat) <= 90.0 and abs(lon) <= 180.0 and 0.0 <= age_s <= _MOST_PROCESSING_S
    if not plausible or not (math.isnan(sigma_m) or 0.0 < sigma_m <= _MOST_SIGMA_M):
        return None
    # By the command's definition the altitude is not used, and senders write 0 for that as well as NaN.
    given = math.isfinite(height) and height != 0.0
    return GivenPlace(lat, lon, height if given else None, None if math.isnan(sigma_m) else sigma_m, age_s)


@dataclass(frozen=True, slots=True)
class _Waiting:
    sender: tuple[int, int]
    place: GivenPlace
    since_ns: int
    taken: Future[bool]


class OperatorDesk:
    """At most one command waits at a time."""

    def __init__(self, counts: Counter[str]) -> None:
        """``counts``: of the owner, to which ``places.RESULT`` are added."""
        self._counts = counts
        self._waiting: _Waiting | None = None
        self._last_ns: int | None = None
        self._acks: list[MavlinkMessage] = []
        self.leave: LeavePlace | None = None

    def take(self, m: MavlinkMessage, now_ns: int) -> None:
        """Take in a command that is addressed to us."""
        sender, place = (m.get_srcSystem(), m.get_srcComponent()), place_of(m)
        if self._waiting is not None and (self._waiting.sender, self._waiting.place) == (sender, place):
            # Sent again because the answer took too long; one is enough. Another place must not take that answer for
            # its own.
            return
        paused = self._last_ns is not None and now_ns - self._last_ns < _PAUSE_NS
        if self.leave is None or self._waiting is not None or paused:
            self._answer(sender, dialect.MAV_RESULT_TEMPORARILY_REJECTED)
            return
        if place is None:
            self._answer(sender, dialect.MAV_RESULT_DENIED)
            return
        taken = self.leave(place)
        if taken is None:
            self._answer(sender, dialect.MAV_RESULT_TEMPORARILY_REJECTED)
            return
        self._last_ns, self._waiting = now_ns, _Waiting(sender, place, now_ns, taken)

    def poll(self, now_ns: int) -> list[MavlinkMessage]:
        """The answers that are due."""
        waiting = self._waiting
        if waiting is not None:
            if waiting.taken.done():
                error = waiting.taken.exception()
                if error is not None:
                    logger.error("a position by MAVLink", exc_info=error)
                    result = dialect.MAV_RESULT_FAILED
                else:
                    result = dialect.MAV_RESULT_ACCEPTED if waiting.taken.result() else dialect.MAV_RESULT_DENIED
                self._answer(waiting.sender, result)
                self._waiting = None
            elif now_ns - waiting.since_ns > _WAIT_NS and waiting.taken.cancel():
                self._answer(waiting.sender, dialect.MAV_RESULT_TEMPORARILY_REJECTED)
                self._waiting = None
        acks, self._acks = self._acks, []
        return acks

    def _answer(self, sender: tuple[int, int], result: int) -> None:
        self._counts[f"places.{dialect.enums['MAV_RESULT'][result].name.removeprefix('MAV_RESULT_').lower()}"] += 1
        # Of a flood not each needs to be told.
        if len(self._acks) < 4:
            self._acks.append(
                dialect.MAVLink_command_ack_message(
                    command=dialect.MAV_CMD_EXTERNAL_POSITION_ESTIMATE,
                    result=result,
                    progress=0,
                    result_param2=0,
                    target_system=sender[0],
                    target_component=sender[1],
                )
            )
