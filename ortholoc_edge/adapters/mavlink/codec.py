"""Bytes to messages, by the codec that pymavlink generates; its `mavutil` connections are not used.

Those exchange their `mav` object when the first MAVLink 2 frame arrives, sleep inside reads while they reconnect, and
stamp with the wall clock.
"""

from __future__ import annotations

import os
import re
import struct
from collections.abc import Callable
from typing import Any

# Importing a v20 dialect by name needs no variable; whoever imports mavutil after us gets MAVLink 2 by it too.
os.environ["MAVLINK20"] = "1"

from pymavlink.dialects.v20 import ardupilotmega as dialect

from ortholoc_edge.errors import LinkError

if dialect.WIRE_PROTOCOL_VERSION != "2.0":
    raise LinkError(
        f"pymavlink's dialect speaks MAVLink {dialect.WIRE_PROTOCOL_VERSION}; install pymavlink >= 2.4.49"
    )

__all__ = ["FrameParser", "MavlinkMessage", "dialect", "payload_of"]

# A message object of pymavlink's dialect, which carries no types.
MavlinkMessage = Any

_MS = 1_000_000


def payload_of(message: MavlinkMessage, at_least: int) -> bytes:
    """The payload as it came, with the zeros at its end that MAVLink 2 cuts off restored to ``at_least`` bytes.

    pymavlink's own `get_payload` takes the header of MAVLink 2 for that of MAVLink 1, and is 4 bytes off.
    """
    frame = bytes(message.get_msgbuf())
    header = 6 if frame[0] == 0xFE else 10
    return frame[header : header + frame[1]].ljust(at_least, b"\0")


class FrameParser:
    """Bytes to messages.

    After a frame that fails, the search goes on at its second byte: pymavlink's own parser skips the length
    that the broken header claimed, up to 280 bytes and the good frames among them. An incomplete frame waits,
    but not longer than a real one could take, so that a stray start byte does not hold back what follows.
    """

    _MARKER = re.compile(rb"[\xfd\xfe]")
    # A 280 byte frame takes 49 ms at 57600 baud.
    _INCOMPLETE_LIMIT_NS = 200 * _MS

    def __init__(self, accept: Callable[[MavlinkMessage], bool] = lambda message: True) -> None:
        """``accept``: whether a whole frame counts. One that does not is passed over, with all that it holds."""
        self._accept = accept
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
                elif self._accept(message):
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
