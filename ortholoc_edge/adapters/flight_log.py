"""The flight as a file: MCAP, which Foxglove opens and ``ortholoc-edge replay`` flies again.

    /camera              foxglove.CompressedImage   the frame: a thumbnail, or all of it without loss
    /fix                 foxglove.LocationFix       the camera on WGS 84, of each fix that was sent or published
    /pose                foxglove.PoseInFrame       map_from_camera, from the pack's anchor
    /ortholoc/frame      ortholoc.Frame             what the step to the outcome depended on, and the outcome
    /ortholoc/outcome    ortholoc.Outcome           as published: a fix that came too late is a rejection here
    /ortholoc/health     ortholoc.Health            counters, once a second
    /ortholoc/ladder     ortholoc.Ladder            steps to less detail or fewer frames, and back
    /ortholoc/command    ortholoc.Command           what others asked for; what the tracker takes of it is in the frames

A thread of its own writes: the frame path never waits for it. Each file is whole by itself and begins with a metadata
record ``ortholoc`` (`LogHeader`). Chunks are small, each is handed to the system at once and the disk is told once a
second to keep them, so that a power cut costs a second; what was cut off can be read up to there.
"""

from __future__ import annotations

import base64
import contextlib
import datetime
import json
import logging
import os
import platform
import queue
import threading
from collections.abc import Mapping
from dataclasses import dataclass
from io import BufferedWriter
from pathlib import Path
from typing import Annotated, Any, Literal

import cv2
import msgspec
import numpy as np
from msgspec import Meta, Struct

from ortholoc_edge import __version__
from ortholoc_edge.adapters.messages import Command, CommandReply, LadderMessage
from ortholoc_edge.geometry import covariance as cov
from ortholoc_edge.geometry import frames, rotation
from ortholoc_edge.geometry.arrays import ImageArray
from ortholoc_edge.pipeline.frame import Frame, VehicleState, grey_of
from ortholoc_edge.pipeline.navigator import Circumstances
from ortholoc_edge.pipeline.outcome import Fix, Outcome
from ortholoc_edge.pipeline.record import FrameRecord, frame_record, outcome_record
from ortholoc_edge.pose import pnp
from ortholoc_edge.tiles.georeference import Georeference

logger = logging.getLogger(__name__)

HEADER_NAME = "ortholoc"
FRAME_TOPIC, CAMERA_TOPIC = "/ortholoc/frame", "/camera"
_S = 1_000_000_000

# Grey frames are of a megabyte or two, and a disk that hangs must not fill the memory.
_QUEUE_LENGTH = 12
_CLOSE_WAIT_S = 5.0
_SYNC_EVERY_NS = 1 * _S
# Where a file could not be written, the next is tried this long after.
_AGAIN_AFTER_NS = 1 * _S
# A chunk ends with the message that takes it beyond this, which is what can be read after a power cut. The record of a
# frame, its last message, and a second's counters are longer by their names alone.
_CHUNK_BYTES = 256
# A file is no longer than this part of the limit, which is lost at once when the oldest goes; nor than so many bytes,
# since the writer keeps an index of its chunks, half a kilobyte each.
_FILES_OF_LIMIT = 8
_MOST_FILE_BYTES = 16 << 20
_THUMBNAIL_PX, _THUMBNAIL_QUALITY = 320, 70
_FAST_PNG = [cv2.IMWRITE_PNG_COMPRESSION, 1]


class LogOptions(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The ``[log]`` table.

    Attributes:
        folder: for flight logs; none are written if it is left out.
        max_mb: of all logs in the folder; the oldest go.
        level: of the program's messages on stderr, which systemd's journal keeps: "debug", "info", "warning", "error".
        frames: "thumbnails", "all" (without loss, in grey, as they were localized: what a replay needs; 0.2 MB and 4 ms
            of another core's time each at 640x480) or "none".
    """

    folder: Annotated[str, Meta(min_length=1)] | None = None
    max_mb: Annotated[int, Meta(ge=1)] = 256
    frames: Literal["thumbnails", "all", "none"] = "thumbnails"
    level: Literal["debug", "info", "warning", "error"] = "info"


class LogHeader(Struct, frozen=True, kw_only=True):
    """The metadata record: whose flight this is, and all that does not change in it.

    Attributes:
        version: of this program. libraries: that poses depend on.
        session: the same in all files of one life of the daemon, "NUMBER-DATE": numbers rise in a folder, while the
            date is wrong where the clock was never set. part: the number of the file, from 0.
        config: the daemon's `Config` as JSON, where Infinity is allowed.
        pack, pack_sha256: folder, and hash of the manifest, which has those of all files.
        matcher, model_sha256: that were used.
        unix_minus_stamp_ns: what makes dates of stamps; log times are dates.
    """

    version: str
    libraries: dict[str, str]
    session: str
    part: int
    config: str
    pack: str
    pack_sha256: str
    matcher: str
    model_sha256: str | None
    unix_minus_stamp_ns: int


# What a frame came to before its age was looked at, the vehicle's state at its exposure, and what else it depended on.
LoggedStep = tuple[Outcome, VehicleState, Circumstances]


@dataclass(frozen=True, slots=True, eq=False)
class _Entry:
    """A frame on its way to the disk; ``picture`` is what is kept of it: grey, or small, or nothing."""

    name: str
    exposure_ns: int | None
    picture: ImageArray | None
    outcome: Outcome
    step: LoggedStep | None


@dataclass(frozen=True, slots=True)
class _Note:
    """A message that is ready, on its way to the disk."""

    channel: str
    stamp_ns: int
    message: bytes


class FlightLog:
    """Writes ``FOLDER/flight-NUMBER-DATE-PART.mcap``.

    What can't be written (a full disk, a slow card) is dropped and counted: logging must not end a flight.

    A folder that can't be written to is tried again, each second.

    Attributes:
        dropped: frames not written.
    """

    def __init__(
        self,
        options: LogOptions,
        georeference: Georeference,
        header: Mapping[str, Any],
        started_ns: int,
        unix_minus_stamp_ns: int,
    ) -> None:
        """
        Args:
            options: with a folder.
            header: of `LogHeader`, ``config``, ``pack``, ``pack_sha256``, ``matcher`` and ``model_sha256``.
            started_ns: a stamp; its date is in the files' names.
        """
        assert options.folder is not None
        self._folder, self._frames = Path(options.folder), options.frames
        self.limit(options.max_mb)
        self._georeference = georeference
        self._offset_ns = unix_minus_stamp_ns
        self._header = header
        self.dropped = 0
        self._part = 0
        self._failing = False
        self._failed_ns = 0
        self._started_unix_ns = started_ns + unix_minus_stamp_ns
        self._session: str | None = None
        self._file: _File | None = None
        try:
            self._file = self._open()
        except OSError as err:
            # A restart in flight must not end here: the vehicle needs its position more than its log.
            logger.warning("%s: can't write the log there (%s); see log.folder. Flying without", self._folder, err)
            self._failing, self._failed_ns = True, started_ns
        self._queue: queue.Queue[_Entry | _Note | None] = queue.Queue(_QUEUE_LENGTH)
        self._thread = threading.Thread(target=self._run, name="flight-log", daemon=True)
        self._thread.start()

    def limit(self, max_mb: int) -> None:
        """Keep to another limit, from the next file on."""
        self._limit_bytes = max_mb * 2**20
        self._file_bytes = min(self._limit_bytes // _FILES_OF_LIMIT, _MOST_FILE_BYTES)

    def put(
        self,
        frame: Frame | None,
        outcome: Outcome,
        step: LoggedStep | None = None,
    ) -> None:
        """Hand over what a frame came to; returns at once.

        Args:
            frame: its image must not change any more.
            outcome: as published.
            step: None where it was not localized.
        """
        name, exposure_ns, picture = (
            ("", None, None) if frame is None else (frame.name, frame.exposure_ns, self._kept(frame.image))
        )
        self._hand_over(_Entry(name, exposure_ns, picture, outcome, step))

    def note(self, stamp_ns: int, statistics: Mapping[str, Any]) -> None:
        """Hand over the counters; returns at once."""
        content = {"stamp_ns": stamp_ns, "statistics": statistics}
        self._hand_over(_Note("health", stamp_ns, msgspec.json.encode(content)))

    def ladder(self, message: LadderMessage) -> None:
        """Hand over a step; returns at once. For people: a replay has the rung of each frame."""
        self._hand_over(_Note("ladder", message.stamp_ns, msgspec.json.encode(message)))

    def command(self, stamp_ns: int, command: Command, reply: CommandReply) -> None:
        """Hand over what somebody asked for; returns at once. For people: a replay has it from the frames."""
        content = {"stamp_ns": stamp_ns, "request": command, "reply": reply}
        self._hand_over(_Note("command", stamp_ns, msgspec.json.encode(content)))

    def _hand_over(self, entry: _Entry | _Note) -> None:
        try:
            self._queue.put_nowait(entry)
        except queue.Full:
            self.dropped += isinstance(entry, _Entry)

    def _kept(self, image: ImageArray) -> ImageArray | None:
        """What is kept of a frame; None where nothing is wanted, or it is no picture: then it was refused, too."""
        if self._frames == "none" or image.dtype != np.uint8 or image.ndim not in (2, 3) or not image.size:
            return None
        try:
            if self._frames == "all":
                # Every matcher begins so; the rest of a colour image tells a replay nothing.
                return grey_of(image)
            scale = min(1.0, _THUMBNAIL_PX / max(image.shape[:2]))
            return np.asarray(cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), np.uint8)
        except cv2.error:
            return None

    def close(self) -> None:
        """Write what waits and end the thread; a disk that is full or hangs ends neither in an error nor in a wait
        without end."""
        with contextlib.suppress(queue.Full):
            self._queue.put(None, timeout=_CLOSE_WAIT_S)
        self._thread.join(timeout=_CLOSE_WAIT_S)
        if self._thread.is_alive():
            # It holds the file's lock; closing would wait for it.
            logger.warning("%s: the disk hangs; the last frames are not written", self._folder)

    # -- the thread ------------------------------------------------------------------------------------

    def _run(self) -> None:
        while (entry := self._queue.get()) is not None:
            try:
                self._failing = not self._write(entry) and self._failing
            except OSError as err:
                self._give_up(entry, err)
            except Exception:  # a defect of logging must end neither the thread nor the flight
                self.dropped += 1
                if not self._failing:
                    logger.exception("flight log")
                self._failing = True
        if self._file is not None:
            try:
                self._file.finish()
            except OSError as err:
                logger.warning("%s: can't write the end of the log (%s); it can be read without", self._folder, err)

    def _give_up(self, entry: _Entry | _Note, err: OSError) -> None:
        """A file that broke off is left as it is: up to there it can be read."""
        self.dropped += isinstance(entry, _Entry)
        if self._file is not None:
            self._file.abandon()
            self._file = None
            self._failed_ns = _stamp_ns(entry)
        if not self._failing:
            logger.warning("%s: can't write the log (%s); frames are dropped until it works", self._folder, err)
        self._failing = True

    def _write(self, entry: _Entry | _Note) -> bool:
        """Whether it was; not while the last failure is fresh."""
        if self._file is None:
            if abs(_stamp_ns(entry) - self._failed_ns) < _AGAIN_AFTER_NS:
                self.dropped += isinstance(entry, _Entry)
                return False
            self._failed_ns = _stamp_ns(entry)
            self._file = self._open()
        if isinstance(entry, _Entry):
            self._write_frame(self._file, entry)
        else:
            self._file.add(entry.channel, entry.stamp_ns + self._offset_ns, entry.message)
        self._file.flush(_stamp_ns(entry))
        if self._file.size() >= self._file_bytes:
            whole, self._file = self._file, None
            whole.finish()
            self._file = self._open()
        return True

    def _write_frame(self, file: _File, entry: _Entry) -> None:
        outcome = entry.outcome
        unix_ns = outcome.stamp_ns + self._offset_ns
        file.add("outcome", unix_ns, msgspec.json.encode(outcome_record(outcome)))
        if isinstance(outcome, Fix):
            file.add("fix", unix_ns, self._location(outcome, unix_ns))
            file.add("pose", unix_ns, self._pose(outcome, unix_ns))
        whole = self._frames == "all" and entry.picture is not None
        if entry.picture is not None:
            file.add("camera", unix_ns, _image_message(entry.picture, whole, unix_ns))
        if entry.step is not None:
            record = frame_record(entry.name, entry.exposure_ns, whole, *entry.step)
            file.add("frame", unix_ns, msgspec.json.encode(record))

    def _location(self, fix: Fix, unix_ns: int) -> bytes:
        place = self._georeference.geodetic_from_map(fix.map_from_camera.translation)
        ned_from_map = frames.map_from_ned_rotation(
            self._georeference.convergence_rad(fix.map_from_camera.translation[:2])
        ).T
        # Foxglove wants true east, north, up.
        enu = cov.rotated(fix.covariance, frames.ENU_FROM_NED @ ned_from_map)[:3, :3]
        return msgspec.json.encode(
            {
                "timestamp": _time(unix_ns),
                "frame_id": "camera",
                "latitude": place.lat_deg,
                "longitude": place.lon_deg,
                "altitude": place.height_amsl_m if place.height_ellipsoid_m is None else place.height_ellipsoid_m,
                "position_covariance": enu.ravel().tolist(),
                "position_covariance_type": 3,
            }
        )

    def _pose(self, fix: Fix, unix_ns: int) -> bytes:
        x, y, z = (fix.map_from_camera.translation - [*self._georeference.anchor, 0.0]).tolist()
        qw, qx, qy, qz = rotation.to_quaternion(fix.map_from_camera.rotation).tolist()
        return msgspec.json.encode(
            {
                "timestamp": _time(unix_ns),
                "frame_id": "map",
                "pose": {
                    "position": {"x": x, "y": y, "z": z},
                    "orientation": {"x": qx, "y": qy, "z": qz, "w": qw},
                },
            }
        )

    # -- files -----------------------------------------------------------------------------------------

    def _next_session(self) -> str:
        numbers = [int(path.name.split("-")[1]) for path in self._folder.glob("flight-[0-9]*-*.mcap")]
        date = datetime.datetime.fromtimestamp(self._started_unix_ns // _S, datetime.UTC).strftime("%Y%m%dT%H%M%SZ")
        return f"{max(numbers, default=0) + 1:05d}-{date}"

    def _open(self) -> _File:
        self._folder.mkdir(parents=True, exist_ok=True)
        if self._session is None:
            self._session = self._next_session()
        self._make_room()
        header = LogHeader(
            version=__version__,
            libraries=libraries(),
            session=self._session,
            part=self._part,
            unix_minus_stamp_ns=self._offset_ns,
            **self._header,
        )
        file = _File(self._folder / f"flight-{self._session}-{self._part:03d}.mcap", header)
        self._part += 1
        return file

    def _make_room(self) -> None:
        """Remove the oldest logs, so that with one more file the limit is kept."""
        logs = []
        for path in self._folder.glob("flight-*.mcap"):
            with contextlib.suppress(OSError):
                logs.append((path.name, path.stat().st_size, path))
        allowed = self._limit_bytes - self._file_bytes
        total = sum(size for _, size, _ in logs)
        # By name, and so by number: the parts of this life last.
        for _, size, path in sorted(logs):
            if total <= allowed:
                return
            with contextlib.suppress(OSError):
                path.unlink()
                total -= size


class _File:
    """One file, begun."""

    def __init__(self, path: Path, header: LogHeader) -> None:
        # Only where a log is kept: it reads its own version through importlib.metadata, and that brings email.
        from mcap.writer import Writer

        self._stream: BufferedWriter = path.open("xb")
        self._synced_ns = 0
        try:
            self._writer = Writer(self._stream, chunk_size=_CHUNK_BYTES)
            self._writer.start("", f"ortholoc-edge {__version__}")
            self._writer.add_metadata(HEADER_NAME, _as_strings(header))
            self._channels = {}
            for name, (topic, schema, definition) in _CHANNELS.items():
                number = self._writer.register_schema(schema, "jsonschema", json.dumps(definition).encode())
                self._channels[name] = self._writer.register_channel(topic, "json", number)
            # A full disk is told here, and leaves no file behind for each try. What a power cut leaves has its header.
            self._stream.flush()
            os.fsync(self._stream.fileno())
        except OSError:
            self.abandon()
            path.unlink(missing_ok=True)
            raise

    def add(self, channel: str, unix_ns: int, message: bytes) -> None:
        self._writer.add_message(self._channels[channel], unix_ns, message, unix_ns)

    def flush(self, stamp_ns: int) -> None:
        self._stream.flush()
        if abs(stamp_ns - self._synced_ns) >= _SYNC_EVERY_NS:
            self._synced_ns = stamp_ns
            os.fsync(self._stream.fileno())

    def size(self) -> int:
        return self._stream.tell()

    def finish(self) -> None:
        try:
            self._writer.finish()  # type: ignore[no-untyped-call]
            self._stream.flush()
            os.fsync(self._stream.fileno())
        finally:
            self.abandon()

    def abandon(self) -> None:
        """Close it as it is."""
        with contextlib.suppress(OSError):
            # What a full disk did not take is still in the buffer.
            self._stream.close()


def libraries() -> dict[str, str]:
    """Versions that poses depend on in their last bits."""
    return {"numpy": np.__version__, "opencv": cv2.__version__, "solver": pnp.SOLVER, "processor": platform.machine()}


def header_of(metadata: Mapping[str, str]) -> LogHeader:
    """Raises: msgspec.ValidationError, msgspec.DecodeError."""
    return msgspec.convert({key: msgspec.json.decode(value) for key, value in metadata.items()}, LogHeader)


def _as_strings(header: LogHeader) -> dict[str, str]:
    return {key: json.dumps(value) for key, value in msgspec.to_builtins(header).items()}


def _stamp_ns(entry: _Entry | _Note) -> int:
    return entry.outcome.stamp_ns if isinstance(entry, _Entry) else entry.stamp_ns


def _time(unix_ns: int) -> dict[str, int]:
    return {"sec": unix_ns // _S, "nsec": unix_ns % _S}


def _image_message(picture: ImageArray, whole: bool, unix_ns: int) -> bytes:
    if whole:
        form, data = "png", cv2.imencode(".png", picture, _FAST_PNG)[1]
    else:
        drawn = picture if picture.ndim == 2 else cv2.cvtColor(picture, cv2.COLOR_RGB2BGR)
        form, data = "jpeg", cv2.imencode(".jpg", drawn, [cv2.IMWRITE_JPEG_QUALITY, _THUMBNAIL_QUALITY])[1]
    return msgspec.json.encode(
        {
            "timestamp": _time(unix_ns),
            "frame_id": "camera",
            "data": base64.b64encode(data.tobytes()).decode(),
            "format": form,
        }
    )


def _object(**properties: dict[str, Any]) -> dict[str, Any]:
    return {"type": "object", "properties": properties}


_NUMBER, _INTEGER, _TEXT = {"type": "number"}, {"type": "integer"}, {"type": "string"}
_STAMP = _object(sec=_INTEGER, nsec=_INTEGER)
# Foxglove knows its own by name; the fields are those of its published JSON schemas that are filled here.
_CHANNELS: dict[str, tuple[str, str, dict[str, Any]]] = {
    "camera": (
        CAMERA_TOPIC,
        "foxglove.CompressedImage",
        _object(
            timestamp=_STAMP, frame_id=_TEXT, data={"type": "string", "contentEncoding": "base64"}, format=_TEXT
        ),
    ),
    "fix": (
        "/fix",
        "foxglove.LocationFix",
        _object(
            timestamp=_STAMP,
            frame_id=_TEXT,
            latitude=_NUMBER,
            longitude=_NUMBER,
            altitude=_NUMBER,
            position_covariance={"type": "array", "items": _NUMBER},
            position_covariance_type=_INTEGER,
        ),
    ),
    "pose": (
        "/pose",
        "foxglove.PoseInFrame",
        _object(
            timestamp=_STAMP,
            frame_id=_TEXT,
            pose=_object(
                position=_object(x=_NUMBER, y=_NUMBER, z=_NUMBER),
                orientation=_object(x=_NUMBER, y=_NUMBER, z=_NUMBER, w=_NUMBER),
            ),
        ),
    ),
    "frame": (FRAME_TOPIC, "ortholoc.Frame", msgspec.json.schema(FrameRecord)),
    "outcome": (
        "/ortholoc/outcome",
        "ortholoc.Outcome",
        _object(
            stamp_ns=_INTEGER,
            fix={"type": "boolean"},
            reason=_TEXT,
            detail=_TEXT,
            position_map_m={"type": "array", "items": _NUMBER},
            quaternion_map_from_camera_wxyz={"type": "array", "items": _NUMBER},
            protection_m={"type": "array", "items": _NUMBER},
            inliers=_INTEGER,
            quality=_NUMBER,
        ),
    ),
    "health": ("/ortholoc/health", "ortholoc.Health", _object(stamp_ns=_INTEGER, statistics={"type": "object"})),
    "ladder": ("/ortholoc/ladder", "ortholoc.Ladder", msgspec.json.schema(LadderMessage)),
    "command": (
        "/ortholoc/command",
        "ortholoc.Command",
        _object(stamp_ns=_INTEGER, request={"type": "object"}, reply={"type": "object"}),
    ),
}
