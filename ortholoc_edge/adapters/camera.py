"""Frames from files, videos and cameras, through OpenCV. Images are RGB, uint8, read-only.

A frame that can't be decoded is refused, never repaired: libjpeg fills what is missing with grey and reports
success, and a matcher would then find its matches in half a picture.
"""

from __future__ import annotations

import logging
import re
import threading
import zlib
from pathlib import Path
from typing import Annotated, Any, Protocol

import cv2
import msgspec
import numpy as np

from ortholoc_edge.clock import Clock
from ortholoc_edge.errors import CameraError, ConfigError
from ortholoc_edge.geometry.arrays import ImageArray
from ortholoc_edge.pipeline.frame import Frame

logger = logging.getLogger(__name__)

IMAGE_SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".tif", ".tiff", ".webp", ".bmp"})

_MS = 1_000_000
_S = 1_000_000_000
_BACKOFF_MIN_S, _BACKOFF_MAX_S = 0.5, 10.0
# A stream that fails this often in a row is opened anew.
_MAX_FAILED_GRABS = 5
# Of FFmpeg's network streams; its defaults are 30 s, in which a vehicle flies far.
_NETWORK_TIMEOUT_MS = 5000


class EndOfFrames(Exception):  # noqa: N818 -- the ordinary end of a recording, as StopIteration is
    """The source has no more frames and never will."""


class BadFrameError(CameraError):
    """One frame is unusable; the next may be fine, and `read` goes on with it.

    Attributes:
        stamp_ns: when the frame was due, monotonic clock.
        name: of the frame.
    """

    def __init__(self, message: str, stamp_ns: int, name: str) -> None:
        super().__init__(message)
        self.stamp_ns, self.name = stamp_ns, name


class FrameSource(Protocol):
    """Where frames come from."""

    def read(self, timeout_s: float) -> Frame | None:
        """The next frame, or None if none was due within ``timeout_s`` (0: do not wait).

        Raises: EndOfFrames; BadFrameError for one unusable frame; CameraError if the source is beyond use.
        """
        ...

    def close(self) -> None:
        """Release the device. Idempotent; `read` in another thread returns."""
        ...


class CameraOptions(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The ``[camera]`` table.

    Attributes:
        source: ``folder:PATH`` of pictures, ``video:PATH``, ``device:/dev/video0`` or ``device:0``, a
            ``rtsp://``, ``http://`` or ``https://`` address, or ``gstreamer:PIPELINE`` that ends in
            ``appsink``.
        rate_hz: of a folder; asked of a camera whose ``fps`` is not given.
        latency_ms: from the middle of the exposure until the driver hands the frame over. It is subtracted
            from the stamp of live sources; measure it, since at 20 m/s each 50 ms left out are a metre.
        width_px, height_px, fps: asked of a device; a device that gives other values is used, with a warning.
        realtime: whether a video skips frames that are late, as a camera would; if not, every frame is given.
    """

    source: str
    rate_hz: Annotated[float, msgspec.Meta(gt=0, le=1000)] = 10.0
    latency_ms: Annotated[float, msgspec.Meta(ge=0, le=5000)] = 0.0
    width_px: Annotated[int, msgspec.Meta(ge=16, le=16384)] | None = None
    height_px: Annotated[int, msgspec.Meta(ge=16, le=16384)] | None = None
    fps: Annotated[float, msgspec.Meta(gt=0, le=1000)] | None = None
    realtime: bool = True


def open_source(options: CameraOptions, clock: Clock) -> FrameSource:
    """The source that ``options.source`` names.

    Raises: ConfigError if the text can't be understood; CameraError if a folder or video can't be read. A
        live camera that is missing is waited for instead.
    """
    kind, _, rest = options.source.partition(":")
    latency_ns = round(options.latency_ms * _MS)
    if kind == "folder" and rest:
        return FolderSource(Path(rest), options.rate_hz, clock)
    if kind == "video" and rest:
        return VideoSource(Path(rest), clock, realtime=options.realtime)
    live: str | int
    backend = cv2.CAP_ANY
    if kind == "device" and rest:
        live = int(rest) if rest.isdecimal() else rest
    elif kind in ("rtsp", "http", "https") and rest.startswith("//"):
        live, backend = options.source, cv2.CAP_FFMPEG
    elif kind == "gstreamer" and rest:
        live, backend = rest, cv2.CAP_GSTREAMER
    else:
        raise ConfigError(
            f"camera source {options.source!r} can't be used; write folder:PATH, video:PATH, "
            "device:/dev/video0, rtsp://..., http://... or gstreamer:PIPELINE"
        )
    return DeviceSource(
        live,
        clock,
        latency_ns=latency_ns,
        backend=backend,
        width_px=options.width_px,
        height_px=options.height_px,
        fps=options.fps or (options.rate_hz if kind == "device" else None),
    )


# -- pictures ------------------------------------------------------------------


def read_image(path: Path) -> ImageArray:
    """A picture file as (H, W, 3) RGB uint8, read-only; grey becomes RGB, 16 bits become 8.

    The pixels come as the sensor gave them: an EXIF orientation is not applied, since intrinsics belong to
    the sensor's rows and columns.
    Raises: CameraError naming the file, the defect and the remedy. A JPEG with wrong bytes in the middle and
        a sound end can't be told from a good one: the format has no checksum.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise CameraError(
            f"picture {path} can't be read: {error.strerror}; check the path and its rights"
        ) from error
    defect = _defect(data)
    if defect is None:
        try:
            image = cv2.imdecode(
                np.frombuffer(data, dtype=np.uint8),
                cv2.IMREAD_COLOR_RGB | cv2.IMREAD_IGNORE_ORIENTATION,
            )
        except cv2.error as error:
            defect = f"OpenCV can't decode it ({error.err})"
        else:
            if image is not None and image.size > 0:
                return _frozen(image, f"picture {path}")
            defect = "not a picture that OpenCV can decode"
    raise CameraError(f"picture {path} is unusable: {defect}; copy it again from its source or take it out")


def _rgb(image: Any, name: str) -> ImageArray:
    """What OpenCV captured, as RGB. Raises: CameraError naming the source."""
    if image.ndim == 2 or image.shape[2] == 1:
        return _frozen(cv2.cvtColor(image, cv2.COLOR_GRAY2RGB), name)
    return _frozen(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), name)


def _frozen(image: Any, name: str) -> ImageArray:
    # numpy would wrap a 16-bit 300 to 44 without a word.
    if image.dtype != np.uint8:
        raise CameraError(
            f"{name} gives {image.dtype} pixels, not uint8; convert them before, in a GStreamer pipeline by "
            "'videoconvert ! video/x-raw,format=BGR'"
        )
    array: ImageArray = np.ascontiguousarray(image)
    array.flags.writeable = False
    return array


def _defect(data: bytes) -> str | None:
    """What is visibly wrong with an encoded picture, before anything decodes it; None if nothing is."""
    if not data:
        return "the file is empty"
    if data.startswith(b"\xff\xd8"):
        return _jpeg_defect(data)
    if data.startswith(b"\x89PNG\r\n\x1a\n"):
        return _png_defect(data)
    if data[:4] == b"RIFF" and data[8:12] == b"WEBP" and len(data) < int.from_bytes(data[4:8], "little") + 8:
        return f"truncated: {len(data)} bytes of {int.from_bytes(data[4:8], 'little') + 8}"
    return None


# In entropy-coded data FF is followed by 00 (a stuffed byte), by a restart marker or by more FF; else a
# segment begins.
_JPEG_NEXT_MARKER = re.compile(rb"\xff[^\x00\xd0-\xd7\xff]")


def _jpeg_defect(data: bytes) -> str | None:
    """Walk the segments to the end marker.

    Looking at the last two bytes is not enough: some cameras append data, and an EXIF thumbnail has an end
    marker of its own, which a truncated file may well contain.
    """
    truncated = f"truncated after {len(data)} bytes (a JPEG without its end marker)"
    at = 2
    scans = 0
    while True:
        found = _JPEG_NEXT_MARKER.search(data, at)
        if found is None:
            return truncated
        # Between segments, not even one byte may lie; within a scan any number.
        if scans == 0 and data[at : found.start()].strip(b"\xff"):
            return f"damaged: no segment begins at byte {at}"
        marker, at = found[0][1], found.end()
        if marker == 0xD9:
            return None if scans else "damaged: a JPEG without a picture in it"
        if at + 2 > len(data):
            return truncated
        at += int.from_bytes(data[at : at + 2], "big")
        scans += marker == 0xDA


def _png_defect(data: bytes) -> str | None:
    """Walk the chunks, each with its checksum, to the end."""
    at = 8
    while at + 12 <= len(data):
        end = at + 12 + int.from_bytes(data[at : at + 4], "big")
        if end > len(data):
            break
        if zlib.crc32(data[at + 4 : end - 4]) != int.from_bytes(data[end - 4 : end], "big"):
            return f"damaged: checksum error in its chunk at byte {at}"
        if data[at + 4 : at + 8] == b"IEND":
            return None
        at = end
    return f"truncated after {len(data)} bytes (a PNG without its end)"


# -- sources -------------------------------------------------------------------


class FolderSource:
    """The pictures of a folder in the order of their names, one per period.

    Every picture is given. If the reader is late, the schedule moves with it, so that a stamp is never older
    than one period and the gaps between pictures never shrink.
    """

    def __init__(self, folder: Path, rate_hz: float, clock: Clock) -> None:
        """Raises: CameraError if there is no picture."""
        if not rate_hz > 0:
            raise ValueError(f"rate_hz: {rate_hz} is not positive")
        try:
            files = sorted(p for p in folder.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES)
        except OSError as error:
            raise CameraError(f"folder {folder} can't be read: {error.strerror}; check the path") from error
        if not files:
            raise CameraError(
                f"folder {folder} holds no picture ({', '.join(sorted(IMAGE_SUFFIXES))}); check the path"
            )
        self._files, self._at = files, 0
        self._period_ns = round(_S / rate_hz)
        self._clock = clock
        self._due_ns: int | None = None
        self._closed = threading.Event()
        self.bad_frames = 0

    def read(self, timeout_s: float) -> Frame | None:
        """See `FrameSource.read`."""
        if self._closed.is_set() or self._at >= len(self._files):
            raise EndOfFrames
        if self._due_ns is None:
            self._due_ns = self._clock.now_ns()
        if not _wait_until(self._clock, self._due_ns, timeout_s, self._closed):
            return None
        now_ns = self._clock.now_ns()
        stamp_ns = self._due_ns if now_ns - self._due_ns < self._period_ns else now_ns
        self._due_ns = stamp_ns + self._period_ns
        path = self._files[self._at]
        self._at += 1
        try:
            return Frame(stamp_ns, read_image(path), path.name)
        except CameraError as error:
            self.bad_frames += 1
            raise BadFrameError(str(error), stamp_ns, path.name) from error

    def close(self) -> None:
        """See `FrameSource.close`."""
        self._closed.set()


class VideoSource:
    """A recorded video, stamped by its own time stamps from the moment of the first `read`."""

    def __init__(self, path: Path, clock: Clock, realtime: bool = True) -> None:
        """Open the file.

        Args:
            realtime: give each frame when it is due, and skip those that a later one has overtaken, as a
                camera would. Otherwise every frame at once; its stamp may then lie ahead of the clock.
        Raises: CameraError if it can't be opened.
        """
        if not path.is_file():
            raise CameraError(f"video {path} does not exist; check the path")
        self._path, self._clock, self._realtime = path, clock, realtime
        self._capture = cv2.VideoCapture(str(path))
        if not self._capture.isOpened():
            raise CameraError(
                f"video {path} can't be opened by OpenCV; convert it, for instance to MP4 with H.264"
            )
        self._closed = threading.Event()
        self._lock = threading.Lock()
        self._start_ns: int | None = None
        self._next_ns: int | None = None
        self._first_pts_ns = 0
        self._last_ns = -1
        self._number = 0
        self.skipped = 0

    def read(self, timeout_s: float) -> Frame | None:
        """See `FrameSource.read`."""
        if self._start_ns is None:
            self._start_ns = self._clock.now_ns()
            self._next_ns = self._grab(self._start_ns)
        if self._next_ns is None or self._closed.is_set():
            raise EndOfFrames
        if self._realtime and not _wait_until(self._clock, self._next_ns, timeout_s, self._closed):
            return None
        now_ns = self._clock.now_ns()
        while True:
            # The next one is grabbed already, since only its stamp tells whether this one is overtaken.
            stamp_ns, number, image = self._next_ns, self._number - 1, self._retrieve()
            self._next_ns = self._grab(self._start_ns)
            if not self._realtime or self._next_ns is None or self._next_ns > now_ns:
                break
            self.skipped += 1
        name = f"{self._path.name}#{number}"
        if image is None:
            if self._closed.is_set():
                raise EndOfFrames
            raise BadFrameError(
                f"video {self._path}: frame {number} can't be decoded; convert the file again", stamp_ns, name
            )
        return Frame(stamp_ns, image, name)

    def _grab(self, start_ns: int) -> int | None:
        """Advance by one frame; its stamp, or None at the end."""
        with self._lock:
            if self._closed.is_set():
                return None
            if not self._capture.grab():
                self._report_end()
                return None
            pts_ns = round(self._capture.get(cv2.CAP_PROP_POS_MSEC) * _MS)
        if self._number == 0:
            self._first_pts_ns = pts_ns
        self._number += 1
        # A container without proper stamps gives zeros or repeats; time must still advance.
        self._last_ns = max(start_ns + pts_ns - self._first_pts_ns, self._last_ns + 1)
        return self._last_ns

    def _retrieve(self) -> ImageArray | None:
        with self._lock:
            good, image = (False, None) if self._closed.is_set() else self._capture.retrieve()
        return _rgb(image, f"video {self._path}") if good and image is not None else None

    def _report_end(self) -> None:
        promised = int(self._capture.get(cv2.CAP_PROP_FRAME_COUNT))
        if 0 < self._number < promised - 1:
            logger.warning("video %s ends after %d of %d frames", self._path, self._number, promised)

    def close(self) -> None:
        """See `FrameSource.close`."""
        self._closed.set()
        with self._lock:
            self._capture.release()


class DeviceSource:
    """A live camera or stream. A thread grabs all the time, so that `read` gives the newest frame, never a
    queued one.

    A device that is missing, pulled out or silent is opened again with a growing pause; meanwhile `read`
    returns None.
    """

    def __init__(
        self,
        device: int | str,
        clock: Clock,
        *,
        latency_ns: int = 0,
        backend: int = cv2.CAP_ANY,
        width_px: int | None = None,
        height_px: int | None = None,
        fps: float | None = None,
    ) -> None:
        """Start grabbing.

        Args:
            device: index, path, address or GStreamer pipeline.
            latency_ns: subtracted from the time at which the driver hands a frame over.
        Raises: CameraError if this OpenCV was built without ``backend``.
        """
        if backend == cv2.CAP_GSTREAMER and backend not in _usable_backends():
            raise CameraError(
                "camera source gstreamer: this OpenCV was built without GStreamer (as the wheels of PyPI "
                "are); use the distribution's python3-opencv, or an rtsp:// or device: source"
            )
        self._device, self._backend, self._clock, self._latency_ns = device, backend, clock, latency_ns
        self._wanted = {
            cv2.CAP_PROP_FRAME_WIDTH: width_px,
            cv2.CAP_PROP_FRAME_HEIGHT: height_px,
            cv2.CAP_PROP_FPS: fps,
        }
        self._condition = threading.Condition()
        self._latest: Frame | None = None
        self._failure: BaseException | None = None
        self._stop = threading.Event()
        self.overwritten = 0
        self.reconnects = 0
        self.failed_grabs = 0
        self._number = 0
        self._thread = threading.Thread(target=self._run, name="camera", daemon=True)
        self._thread.start()

    def read(self, timeout_s: float) -> Frame | None:
        """See `FrameSource.read`. The newest frame that was not read yet."""
        with self._condition:
            self._condition.wait_for(
                lambda: self._latest is not None or self._failure is not None or self._stop.is_set(),
                timeout_s,
            )
            if self._stop.is_set():
                raise EndOfFrames
            if isinstance(self._failure, CameraError):
                raise CameraError(str(self._failure)) from self._failure
            if self._failure is not None:
                raise CameraError(f"camera {self._device}: its thread ended; see the log") from self._failure
            frame, self._latest = self._latest, None
            return frame

    def close(self) -> None:
        """See `FrameSource.close`."""
        self._stop.set()
        with self._condition:
            self._condition.notify_all()
        # The driver may sit in a wait of its own; the thread owns the device and releases it when it comes
        # back.
        self._thread.join(timeout=2.0)
        if self._thread.is_alive():
            logger.warning("camera %s: the driver still waits; it is left to end by itself", self._device)

    def _run(self) -> None:
        try:
            self._connect_and_grab()
        except BaseException as error:
            logger.exception("camera %s: the grabbing thread ends", self._device)
            with self._condition:
                self._failure = error
                self._condition.notify_all()

    def _connect_and_grab(self) -> None:
        backoff_s = _BACKOFF_MIN_S
        failures = 0
        while not self._stop.is_set():
            capture = self._open()
            if capture.isOpened():
                before = self._number
                try:
                    self._check(capture)
                    self._grab_until_broken(capture)
                finally:
                    capture.release()
                if self._number > before:
                    backoff_s, failures = _BACKOFF_MIN_S, 0
                what = "lost"
            else:
                capture.release()
                what = "can't be opened"
            if self._stop.is_set():
                return
            # Once per outage and then every tenth time: a camera that stays away must not fill the log.
            if failures % 10 == 0:
                logger.warning("camera %s %s; trying again", self._device, what)
            failures += 1
            self.reconnects += 1
            self._stop.wait(backoff_s)
            backoff_s = min(2.0 * backoff_s, _BACKOFF_MAX_S)

    def _open(self) -> cv2.VideoCapture:
        if isinstance(self._device, str) and "://" in self._device:
            timeouts = [
                cv2.CAP_PROP_OPEN_TIMEOUT_MSEC,
                _NETWORK_TIMEOUT_MS,
                cv2.CAP_PROP_READ_TIMEOUT_MSEC,
                _NETWORK_TIMEOUT_MS,
            ]
            return cv2.VideoCapture(self._device, self._backend, timeouts)
        capture = cv2.VideoCapture(self._device, self._backend)
        if capture.isOpened():
            # A longer queue in the driver is latency that no stamp shows.
            capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)
            for name, value in self._wanted.items():
                if value is not None:
                    capture.set(name, value)
        return capture

    def _check(self, capture: cv2.VideoCapture) -> None:
        for name, label in ((cv2.CAP_PROP_FRAME_WIDTH, "width"), (cv2.CAP_PROP_FRAME_HEIGHT, "height")):
            value = self._wanted[name]
            if value is not None and round(capture.get(name)) != value:
                logger.warning("camera %s gives %s %d, not %d", self._device, label, capture.get(name), value)
        logger.info("camera %s open (%s)", self._device, capture.getBackendName())

    def _grab_until_broken(self, capture: cv2.VideoCapture) -> None:
        failed = 0
        while not self._stop.is_set() and failed < _MAX_FAILED_GRABS:
            grabbed = capture.grab()
            # At once: decoding takes its time and is no part of the delay that the options state.
            stamp_ns = self._clock.now_ns() - self._latency_ns
            good, image = capture.retrieve() if grabbed else (False, None)
            if not good or image is None:
                failed += 1
                self.failed_grabs += 1
                continue
            failed = 0
            frame = Frame(stamp_ns, _rgb(image, f"camera {self._device}"), str(self._number))
            self._number += 1
            with self._condition:
                self.overwritten += self._latest is not None
                self._latest = frame
                self._condition.notify_all()


def _usable_backends() -> list[int]:
    return [b for b in cv2.videoio_registry.getBackends() if cv2.videoio_registry.hasBackend(b)]


def _wait_until(clock: Clock, due_ns: int, timeout_s: float, closed: threading.Event) -> bool:
    """Wait for ``due_ns`` of the clock, at most ``timeout_s``; whether it is reached.

    The wait itself is in real time. With a clock that somebody sets, it is a pause before looking again.
    """
    remaining_s = (due_ns - clock.now_ns()) / _S
    if remaining_s > 0 and timeout_s > 0:
        closed.wait(min(remaining_s, timeout_s))
    return clock.now_ns() >= due_ns
