"""Frames that another program publishes on the bus, compressed: ``source = "zenoh:KEY"``.

Two forms are understood:

- a picture file (JPEG, PNG, WebP) as payload. Its time may stand in the attachment, as JSON: ``stamp_ns``, of this
  computer's monotonic clock, or ``unix_ns``, by its date; and ``exposure_ns``, ``name``;
- ROS 2's ``sensor_msgs/msg/CompressedImage``, as zenoh-plugin-ros2dds and rmw_zenoh carry it (CDR). Its header has the
  date.

The time is that of mid-exposure, less ``driver_latency_ms``. Without one, and where five in a row can't be (in the
future, a second old, not later than the one before: the clock of another computer, or one that was set meanwhile),
frames are stamped as they arrive, less ``latency_ms``.
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
from ortholoc_edge.adapters.camera.pictures import decode_published
from ortholoc_edge.adapters.camera.source import BadFrameError, EndOfFrames
from ortholoc_edge.adapters.camera.stamps import DriverStamps
from ortholoc_edge.clock import Clock, wall_clock_ns
from ortholoc_edge.errors import CameraError
from ortholoc_edge.pipeline.frame import Frame

if TYPE_CHECKING:
    from ortholoc_edge.adapters.bus import Bus

logger = logging.getLogger(__name__)

_MS, _S = 1_000_000, 1_000_000_000
# A camera that is silent for so long is told of; more seldom than it is asked for anything else.
_SILENT_NS = 3 * _S
# A message of ROS begins with its encapsulation, and no picture does so.
_CDR_BIG, _CDR_LITTLE = b"\x00\x00", b"\x00\x01"
_MOST_TEXT_BYTES = 4096
_MOST_ATTACHED_BYTES = 4096
_REMEDY = "look at the program that publishes it"

# What whoever reaches the bus may write must fit into messages and logs.
_Nanoseconds = Annotated[int, Meta(ge=0, le=2**63 - 1)]


class _Attachment(msgspec.Struct, frozen=True):
    stamp_ns: _Nanoseconds | None = None
    unix_ns: _Nanoseconds | None = None
    exposure_ns: Annotated[int, Meta(gt=0, le=10 * _S)] | None = None
    name: Annotated[str, Meta(max_length=128)] | None = None


@dataclass(frozen=True, slots=True)
class CompressedPicture:
    """A picture as it came. ``stamp_ns``: monotonic clock. ``unix_ns``: by the date. None where it does not say."""

    data: bytes
    stamp_ns: int | None = None
    unix_ns: int | None = None
    exposure_ns: int | None = None
    name: str | None = None


@dataclass(frozen=True, slots=True)
class _Arrival:
    """``wall_minus_ns``: what made dates of stamps then, since the date may be set before it is looked at."""

    stamp_ns: int
    wall_minus_ns: int
    payload: bytes
    attachment: bytes


class ZenohFrames:
    """A `FrameSource`: the newest picture that was published, older ones are overwritten and counted.

    Attributes:
        overwritten: pictures that a newer one replaced before they were read.
        damaged: that could not be decoded. disordered: left out for their time.
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
        self._stamps = DriverStamps()
        self._stamps.believed = options.stamps == "driver"
        self._exposure_ns = options.fixed_exposure_ns
        self._condition = threading.Condition()
        self._waiting: _Arrival | None = None
        self._closed = False
        self._number = 0
        self._heard_ns = clock.now_ns()
        self._told: set[str] = set()
        self.overwritten = self.damaged = self.disordered = 0
        self._stop = bus.listen_to(key, self._arrived)

    def _arrived(self, payload: bytes, attachment: bytes) -> None:
        """In a thread of the bus."""
        now_ns = self._clock.now_ns()
        arrival = _Arrival(now_ns, self._wall_ns() - now_ns, payload, attachment)
        with self._condition:
            self.overwritten += self._waiting is not None
            self._waiting = arrival
            self._condition.notify()

    def counts(self) -> dict[str, int]:
        """See `Counting.counts`."""
        return {"overwritten": self.overwritten, "damaged": self.damaged, "disordered": self.disordered}

    def read(self, timeout_s: float) -> Frame | None:
        """See `FrameSource.read`."""
        with self._condition:
            self._condition.wait_for(lambda: self._waiting is not None or self._closed, timeout_s)
            if self._closed:
                raise EndOfFrames
            arrival, self._waiting = self._waiting, None
        if arrival is None:
            if self._clock.now_ns() - self._heard_ns > _SILENT_NS:
                self._tell("silent", "no picture for %g s; check the key and who publishes it", _SILENT_NS / _S)
            return None
        self._heard_ns = arrival.stamp_ns
        self._told.discard("silent")
        self._number += 1
        stamp_ns, name = arrival.stamp_ns - self._latency_ns, str(self._number)
        try:
            picture = unpack(arrival.payload, arrival.attachment)
            name = picture.name or name
            stamp_ns = self._stamp(picture, arrival)
            image = decode_published(picture.data, f"picture {name} of zenoh:{self._key}", _REMEDY)
        except CameraError as error:
            self.damaged += 1
            raise BadFrameError(str(error), stamp_ns, name) from error
        return Frame(stamp_ns, image, name, picture.exposure_ns or self._exposure_ns)

    def _stamp(self, picture: CompressedPicture, arrival: _Arrival) -> int:
        """Raises: CameraError for a time that can't be."""
        by_arrival_ns = arrival.stamp_ns - self._latency_ns
        own_ns = picture.stamp_ns
        if own_ns is None and picture.unix_ns is not None:
            own_ns = picture.unix_ns - arrival.wall_minus_ns
        if own_ns is None or not self._stamps.believed:
            if own_ns is None:
                self._tell("no time", "pictures have no time of their own; they are stamped when they arrive")
            return by_arrival_ns
        if self._stamps.judge(own_ns, arrival.stamp_ns):
            return own_ns - self._own_late_ns
        late_s = (arrival.stamp_ns - own_ns) / _S
        if self._stamps.believed:
            self.disordered += 1
            raise CameraError(
                f"picture of zenoh:{self._key} is stamped {late_s:.3f} s before it arrived, or not after the one "
                "before; set the clock of the computer that publishes it"
            )
        self._tell("no clock", "stamps are not of our clock (%.3f s before arrival); they are not believed", late_s)
        return by_arrival_ns

    def _tell(self, what: str, text: str, *values: float) -> None:
        if what not in self._told:
            self._told.add(what)
            logger.warning(f"camera zenoh:%s: {text}", self._key, *values)

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
    if not attachment or len(attachment) > _MOST_ATTACHED_BYTES:
        return CompressedPicture(payload)
    try:
        said = msgspec.json.decode(attachment, type=_Attachment)
    except (msgspec.DecodeError, msgspec.ValidationError, RecursionError):
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
