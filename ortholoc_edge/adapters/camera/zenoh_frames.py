"""Frames that another program publishes on the bus, compressed: ``source = "zenoh:KEY"``.

Two forms are understood:

- a picture file (JPEG, PNG, WebP) as payload. Its time may stand in the attachment, as JSON: ``stamp_ns``, of this
  computer's monotonic clock, or ``unix_ns``, by its date; and ``exposure_ns``, ``name``;
- ROS 2's ``sensor_msgs/msg/CompressedImage``, as zenoh-plugin-ros2dds and rmw_zenoh carry it (CDR). Its header has the
  date.

The time is that of mid-exposure, less ``driver_latency_ms``. Where it is missing, or can't be (in the future, or
seconds old: the clock of another computer, or one that was set meanwhile), the frame is stamped as it arrives, less
``latency_ms``.
"""

from __future__ import annotations

import logging
import struct
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

import msgspec
from msgspec import Meta

from ortholoc_edge.adapters.camera.options import CameraOptions
from ortholoc_edge.adapters.camera.pictures import decode_image
from ortholoc_edge.adapters.camera.source import BadFrameError, EndOfFrames
from ortholoc_edge.clock import Clock, wall_clock_ns
from ortholoc_edge.errors import CameraError
from ortholoc_edge.pipeline.frame import Frame

if TYPE_CHECKING:
    from ortholoc_edge.adapters.bus import Bus

logger = logging.getLogger(__name__)

_MS, _S = 1_000_000, 1_000_000_000
# Of a stamp against its arrival: two computers' clocks agree no better, and nothing is that long under way.
_MOST_AHEAD_NS, _MOST_AGE_NS = 5_000_000, 3 * _S
# The first bytes of the pictures that OpenCV reads; a message of ROS begins with its encapsulation.
_CDR_BIG, _CDR_LITTLE = b"\x00\x00", b"\x00\x01"
_MOST_TEXT_BYTES = 4096
_REMEDY = "look at the program that publishes it"


class _Attachment(msgspec.Struct, frozen=True):
    stamp_ns: int | None = None
    unix_ns: int | None = None
    exposure_ns: Annotated[int, Meta(gt=0)] | None = None
    name: str | None = None


@dataclass(frozen=True, slots=True)
class CompressedPicture:
    """A picture as it came. ``stamp_ns``: monotonic clock. ``unix_ns``: by the date. None where it does not say."""

    data: bytes
    stamp_ns: int | None = None
    unix_ns: int | None = None
    exposure_ns: int | None = None
    name: str | None = None


class ZenohFrames:
    """A `FrameSource`: the newest picture that was published, older ones are overwritten and counted.

    Attributes:
        overwritten: pictures that a newer one replaced before they were read.
        restamped: whose own time was missing or can't be.
    """

    def __init__(
        self,
        bus: Bus,
        key: str,
        options: CameraOptions,
        clock: Clock,
        wall_ns: Callable[[], int] = wall_clock_ns,
    ) -> None:
        """
        Args:
            options: its latencies, which stamps to believe, and the exposure of pictures that do not say theirs.
            wall_ns: the date, nanoseconds since 1970.
        Raises: ConfigError if ``key`` is no key expression.
        """
        self._key, self._clock, self._wall_ns = key, clock, wall_ns
        self._latency_ns, self._own_late_ns = round(options.latency_ms * _MS), round(options.driver_latency_ms * _MS)
        self._believes_stamps = options.stamps == "driver"
        self._exposure_ns = round(options.exposure_ms * _MS) if isinstance(options.exposure_ms, float) else None
        self._condition = threading.Condition()
        self._waiting: tuple[int, bytes, bytes] | None = None
        self._closed = False
        self._number = 0
        self._is_told = False
        self.overwritten = self.restamped = 0
        self._stop = bus.listen_to(key, self._arrived)

    def _arrived(self, payload: bytes, attachment: bytes) -> None:
        """In a thread of the bus."""
        arrived_ns = self._clock.now_ns()
        with self._condition:
            self.overwritten += self._waiting is not None
            self._waiting = arrived_ns, payload, attachment
            self._condition.notify()

    def read(self, timeout_s: float) -> Frame | None:
        """See `FrameSource.read`."""
        with self._condition:
            self._condition.wait_for(lambda: self._waiting is not None or self._closed, timeout_s)
            if self._closed:
                raise EndOfFrames
            item, self._waiting = self._waiting, None
        if item is None:
            return None
        arrived_ns, payload, attachment = item
        self._number += 1
        where = f"zenoh:{self._key}"
        stamp_ns, name = arrived_ns - self._latency_ns, str(self._number)
        try:
            picture = unpack(payload, attachment)
            name = picture.name or name
            stamp_ns = self._stamp(picture, arrived_ns)
            image = decode_image(picture.data, f"picture {name} of {where}", _REMEDY)
        except CameraError as error:
            raise BadFrameError(str(error), stamp_ns, name) from error
        return Frame(stamp_ns, image, name, picture.exposure_ns or self._exposure_ns)

    def _stamp(self, picture: CompressedPicture, arrived_ns: int) -> int:
        if not self._believes_stamps:
            return arrived_ns - self._latency_ns
        stamp_ns = picture.stamp_ns
        if stamp_ns is None and picture.unix_ns is not None:
            stamp_ns = picture.unix_ns - (self._wall_ns() - self._clock.now_ns())
        if stamp_ns is not None and -_MOST_AHEAD_NS <= arrived_ns - stamp_ns <= _MOST_AGE_NS:
            return stamp_ns - self._own_late_ns
        self.restamped += 1
        if not self._is_told:
            self._is_told = True
            why = (
                "have no time of their own"
                if stamp_ns is None
                else f"are stamped {(arrived_ns - stamp_ns) / 1e6:.0f} ms before they arrive, which can't be; set the "
                "clock of the computer that publishes them"
            )
            logger.warning("camera zenoh:%s: pictures %s; their arrival counts, less latency_ms", self._key, why)
        return arrived_ns - self._latency_ns

    def close(self) -> None:
        """See `FrameSource.close`."""
        with self._condition:
            self._closed = True
            self._condition.notify_all()
        self._stop()


def unpack(payload: bytes, attachment: bytes = b"") -> CompressedPicture:
    """A message of either form. Raises: CameraError."""
    if payload[:2] in (_CDR_BIG, _CDR_LITTLE):
        return _compressed_image(payload)
    if not attachment:
        return CompressedPicture(payload)
    try:
        said = msgspec.json.decode(attachment, type=_Attachment)
    except (msgspec.DecodeError, msgspec.ValidationError):
        # Of somebody else's making (rmw_zenoh has one, too): the picture is still a picture.
        return CompressedPicture(payload)
    return CompressedPicture(payload, said.stamp_ns, said.unix_ns, said.exposure_ns, said.name)


def _compressed_image(payload: bytes) -> CompressedPicture:
    """sensor_msgs/msg/CompressedImage in plain CDR (OMG DDS-XTypes 1.3, 7.4.1): header.stamp, header.frame_id, format,
    data; numbers are aligned to their size, from behind the encapsulation's four bytes."""
    order = "<" if payload[:2] == _CDR_LITTLE else ">"
    body = payload[4:]

    def number(kind: str, at: int) -> tuple[int, int]:
        at = (at + 3) & ~3
        (value,) = struct.unpack_from(order + kind, body, at)
        return value, at + 4

    try:
        seconds, at = number("i", 0)
        nanoseconds, at = number("I", at)
        for _ in ("frame_id", "format"):
            length, at = number("I", at)
            if length > _MOST_TEXT_BYTES:
                raise CameraError(f"a text of {length} bytes in a CompressedImage can't be; {_REMEDY}")
            at += length
        length, at = number("I", at)
    except struct.error as error:
        raise CameraError(f"a message of ROS of {len(payload)} bytes is no CompressedImage; {_REMEDY}") from error
    data = body[at : at + length]
    if len(data) != length:
        raise CameraError(f"a CompressedImage is cut off: {len(data)} of {length} bytes; {_REMEDY}")
    # Zero is what a driver without a clock writes.
    unix_ns = seconds * _S + nanoseconds or None
    return CompressedPicture(data, unix_ns=unix_ns)
