"""A V4L2 device: frames through OpenCV, and by ioctls what OpenCV does not tell or set.

OpenCV hands on the driver's stamp of a frame, but neither which clock nor which moment it is of, nor what a control
may be set to. A second descriptor of the same device tells; Linux lets any number look and set, and one stream.
"""

from __future__ import annotations

import errno
import fcntl
import logging
import os
import struct
from dataclasses import dataclass
from pathlib import Path

import cv2

from ortholoc_edge.adapters.camera.live import Shot
from ortholoc_edge.adapters.camera.options import CameraOptions
from ortholoc_edge.adapters.camera.pictures import decode, rgb
from ortholoc_edge.adapters.camera.stamps import Stamper, StampOf
from ortholoc_edge.clock import Clock

logger = logging.getLogger(__name__)

_MS = 1_000_000
# Seconds that OpenCV waits for a frame; its default of 10 keeps a camera that went silent for as long.
_SELECT_TIMEOUT = ("OPENCV_VIDEOIO_V4L_SELECT_TIMEOUT", "2")
# One is filled while the other is taken out. With a single one a camera that sends all the time misses every other
# frame; more of them only hold older frames.
_BUFFERS = 2
_COMPRESSED = ("MJPG", "JPEG")


# -- ioctls --------------------------------------------------------------------------------------------


def _request(direction: int, number: int, size: int) -> int:
    return direction << 30 | size << 16 | ord("V") << 8 | number


_READ, _BOTH = 2, 3
_CAPTURE, _MMAP = 1, 1
_QUERYCAP = _request(_READ, 0, 104)
_ENUM_FMT = _request(_BOTH, 2, 64)
_G_FMT = _request(_BOTH, 4, 208)
_REQBUFS = _request(_BOTH, 8, 20)
_QUERYBUF = _request(_BOTH, 9, 88)
_G_PARM = _request(_BOTH, 21, 204)
_G_CTRL = _request(_BOTH, 27, 8)
_S_CTRL = _request(_BOTH, 28, 8)
_QUERYCTRL = _request(_BOTH, 36, 68)

_EXPOSURE_AUTO, _EXPOSURE_ABSOLUTE, _EXPOSURE_AUTO_PRIORITY = 0x9A0901, 0x9A0902, 0x9A0903
_GAIN, _AUTOGAIN = 0x980913, 0x980912
_MANUAL, _APERTURE_PRIORITY, _AUTO = 1, 3, 0
# EXPOSURE_ABSOLUTE counts in these.
_EXPOSURE_UNIT_MS = 0.1
_CLOCK_MASK, _MONOTONIC = 0xE000, 0x2000
_SOURCE_MASK, _START_OF_EXPOSURE = 0x70000, 0x10000
_DISABLED = 0x0001


@dataclass(frozen=True, slots=True)
class Settings:
    """What a device is set to now.

    Attributes:
        card: its name.
        formats: that it has, as four characters each.
        format, width_px, height_px, fps: of its stream; ``fps`` None where it does not tell.
        exposure_ms: None where it is automatic, or there is no such control.
        exposure_range_ms: None without such a control.
        automatic: whether it sets exposure itself; None without such a control.
        gain: in the device's own steps; None without such a control.
        gain_range: None without such a control.
    """

    card: str
    formats: tuple[str, ...]
    format: str
    width_px: int
    height_px: int
    fps: float | None
    exposure_ms: float | None
    exposure_range_ms: tuple[float, float] | None
    automatic: bool | None
    gain: int | None
    gain_range: tuple[int, int] | None


class Control:
    """A descriptor for questions and settings. Raises: OSError where the device is not there or may not be opened."""

    def __init__(self, path: str) -> None:
        self._fd = os.open(path, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)

    def __enter__(self) -> Control:
        return self

    def __exit__(self, *_: object) -> None:
        os.close(self._fd)

    def _ask(self, request: int, content: bytes) -> bytes | None:
        """The answer; None where the device has no such thing. Raises: OSError where it is gone."""
        buffer = bytearray(content.ljust(request >> 16 & 0x3FFF, b"\0"))
        try:
            fcntl.ioctl(self._fd, request, buffer, True)
        except OSError as error:
            if error.errno in (errno.ENODEV, errno.ENXIO):
                raise
            return None
        return bytes(buffer)

    def settings(self) -> Settings | None:
        """None of a device that does not tell its format so: one of several planes, or none that takes pictures.

        Raises: OSError.
        """
        stream = self._ask(_G_FMT, struct.pack("=I", _CAPTURE))
        if stream is None:
            return None
        capability = self._ask(_QUERYCAP, b"") or bytes(104)
        formats: list[str] = []
        while (found := self._ask(_ENUM_FMT, struct.pack("=2I", len(formats), _CAPTURE))) is not None:
            formats.append(found[44:48].decode("ascii", "replace").rstrip())
        width, height = struct.unpack_from("=2I", stream, 8)
        parameters = self._ask(_G_PARM, struct.pack("=I", _CAPTURE)) or bytes(204)
        numerator, denominator = struct.unpack_from("=2I", parameters, 12)
        exposures, gains = self._range(_EXPOSURE_ABSOLUTE), self._range(_GAIN)
        mode, exposure = self._value(_EXPOSURE_AUTO), self._value(_EXPOSURE_ABSOLUTE)
        automatic = None if mode is None else mode != _MANUAL
        return Settings(
            card=capability[16:48].split(b"\0")[0].decode("utf-8", "replace"),
            formats=tuple(formats),
            format=stream[16:20].decode("ascii", "replace").rstrip("\0 "),
            width_px=width,
            height_px=height,
            fps=denominator / numerator if numerator and denominator else None,
            exposure_ms=None if exposure is None or automatic else exposure * _EXPOSURE_UNIT_MS,
            exposure_range_ms=None
            if exposures is None
            else (exposures[0] * _EXPOSURE_UNIT_MS, exposures[1] * _EXPOSURE_UNIT_MS),
            automatic=automatic,
            gain=self._value(_GAIN),
            gain_range=gains,
        )

    def stamp_of(self) -> StampOf | None:
        """Which moment the driver says that its stamps are of, where it also says that they are of the monotonic
        clock; None otherwise. Takes a buffer for a moment, so before anybody streams."""
        if self._ask(_REQBUFS, struct.pack("=3I", 1, _CAPTURE, _MMAP)) is None:
            return None
        try:
            asked = struct.pack("=2I52xI", 0, _CAPTURE, _MMAP)
            buffer = self._ask(_QUERYBUF, asked)
        finally:
            self._ask(_REQBUFS, struct.pack("=3I", 0, _CAPTURE, _MMAP))
        if buffer is None:
            return None
        (flags,) = struct.unpack_from("=I", buffer, 12)
        if flags & _CLOCK_MASK != _MONOTONIC:
            return None
        return StampOf.EXPOSURE_START if flags & _SOURCE_MASK == _START_OF_EXPOSURE else StampOf.FRAME_END

    def set_exposure(self, exposure_ms: float | None) -> None:
        """Fixed, or by the device itself (None), which then must keep the rate. Raises: OSError."""
        if exposure_ms is None:
            if not self._set(_EXPOSURE_AUTO, _APERTURE_PRIORITY):
                self._set(_EXPOSURE_AUTO, _AUTO)
            self._set(_EXPOSURE_AUTO_PRIORITY, 0)
            return
        self._set(_EXPOSURE_AUTO, _MANUAL)
        limits = self._range(_EXPOSURE_ABSOLUTE)
        wanted = max(round(exposure_ms / _EXPOSURE_UNIT_MS), 1)
        # Some drivers refuse what is out of range where others take the nearest.
        self._set(_EXPOSURE_ABSOLUTE, wanted if limits is None else min(max(wanted, limits[0]), limits[1]))

    def set_gain(self, gain: float) -> None:
        """Fixed. Raises: OSError."""
        self._set(_AUTOGAIN, 0)
        limits = self._range(_GAIN)
        self._set(_GAIN, round(gain) if limits is None else min(max(round(gain), limits[0]), limits[1]))

    def _range(self, control: int) -> tuple[int, int] | None:
        found = self._ask(_QUERYCTRL, struct.pack("=I", control))
        if found is None:
            return None
        low, high = struct.unpack_from("=2i", found, 40)
        (flags,) = struct.unpack_from("=I", found, 56)
        return None if flags & _DISABLED else (low, high)

    def _value(self, control: int) -> int | None:
        found = self._ask(_G_CTRL, struct.pack("=2I", control, 0))
        return None if found is None else struct.unpack("=Ii", found)[1]

    def _set(self, control: int, value: int) -> bool:
        return self._ask(_S_CTRL, struct.pack("=Ii", control, value)) is not None


def read_settings(path: str) -> Settings | None:
    """What a device is set to, also while another descriptor streams; None where it can't be asked."""
    try:
        with Control(path) as control:
            return control.settings()
    except OSError:
        return None


@dataclass(frozen=True, slots=True)
class Difference:
    """A device did not take what it was asked for."""

    what: str
    got: str
    wanted: str
    remedy: str


def differences(options: CameraOptions, now: Settings) -> list[Difference]:
    """Where a device gives another value than was asked of it."""
    found = []
    if options.format is not None and now.format != options.format:
        found.append(
            Difference(
                "format", now.format, options.format, f"write [camera] format as one that it has: {_list(now.formats)}"
            )
        )
    for what, got, wanted in (
        ("width", now.width_px, options.width_px),
        ("height", now.height_px, options.height_px),
    ):
        if wanted is not None and got != wanted:
            found.append(
                Difference(
                    what, f"{got} px", f"{wanted} px", "ask for a size that it has (v4l2-ctl --list-formats-ext), and "
                    "calibrate for that",
                )
            )  # fmt: skip
    fps = options.fps or options.rate_hz
    if now.fps is not None and abs(now.fps - fps) > 0.1 * fps:
        found.append(
            Difference(
                "rate", f"{now.fps:g} frames per second", f"{fps:g}",
                "write [camera] fps as one that it has at this size and format (v4l2-ctl --list-formats-ext)",
            )
        )  # fmt: skip
    return [*found, *_exposure_differences(options, now), *_gain_differences(options, now)]


def _exposure_differences(options: CameraOptions, now: Settings) -> list[Difference]:
    wanted = options.exposure_ms
    if wanted is None or (wanted == "auto" and now.automatic):
        return []
    if now.exposure_range_ms is None:
        got, remedy = "no control of it", "leave [camera] exposure_ms out; set it with the camera's own tool"
    elif now.automatic:
        got, remedy = "automatic", "its driver does not let go of it: another camera, or leave exposure_ms out"
    elif wanted == "auto":
        got, remedy = f"fixed at {now.exposure_ms:g} ms", "it can't; write the exposure in ms"
    elif now.exposure_ms is not None and abs(now.exposure_ms - wanted) <= max(_EXPOSURE_UNIT_MS, 0.1 * wanted):
        return []
    else:
        low, high = now.exposure_range_ms
        got, remedy = f"{now.exposure_ms:g} ms", f"it has {low:g} to {high:g} ms"
    return [Difference("exposure", got, wanted if wanted == "auto" else f"{wanted:g} ms", remedy)]


def _gain_differences(options: CameraOptions, now: Settings) -> list[Difference]:
    if options.gain is None or (now.gain is not None and abs(now.gain - options.gain) <= 1):
        return []
    if now.gain_range is None:
        return [Difference("gain", "no control of it", f"{options.gain:g}", "leave [camera] gain out")]
    low, high = now.gain_range
    return [Difference("gain", f"{now.gain}", f"{options.gain:g}", f"it has {low} to {high}")]


def _list(formats: tuple[str, ...]) -> str:
    return ", ".join(formats) or "it tells none"


# -- frames --------------------------------------------------------------------------------------------


def prepare_devices() -> None:
    """What OpenCV has to know before it opens the first device; see `opening.prepare`."""
    os.environ.setdefault(*_SELECT_TIMEOUT)


def device_path(text: str) -> str:
    """``0`` or ``/dev/video0`` as a path."""
    return f"/dev/video{text}" if text.isdecimal() else text


class V4l2Camera:
    """See `OpenCamera`."""

    def __init__(self, path: str, capture: cv2.VideoCapture, options: CameraOptions, clock: Clock) -> None:
        """
        Args:
            capture: open, and not yet asked for a frame.
        """
        self._path, self._capture, self._options, self._clock = path, capture, options, clock
        self._stamper = Stamper(path, options)
        self._exposure_ns: int | None = None
        # Of compressed frames the bytes are wanted: OpenCV would decode also what is cut off.
        self._raw = _fourcc(capture) in _COMPRESSED and capture.set(cv2.CAP_PROP_CONVERT_RGB, 0)

    @staticmethod
    def open(path: str, options: CameraOptions, clock: Clock) -> V4l2Camera | None:
        """None where the device is not there or can't be used now."""
        stamp_of = _told_stamp_of(path)
        # A device that is not there makes OpenCV complain on stderr, each time.
        if not Path(path).exists():
            return None
        capture = cv2.VideoCapture(path, cv2.CAP_V4L2)
        if not capture.isOpened():
            capture.release()
            return None
        # Before the size: which sizes there are depends on it. Each of these three starts the stream anew.
        if options.format is not None:
            capture.set(cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*options.format.ljust(4)))
        capture.set(cv2.CAP_PROP_BUFFERSIZE, _BUFFERS)
        for name, value in (
            (cv2.CAP_PROP_FRAME_WIDTH, options.width_px),
            (cv2.CAP_PROP_FRAME_HEIGHT, options.height_px),
            (cv2.CAP_PROP_FPS, options.fps or options.rate_hz),
        ):
            if value is not None:
                capture.set(name, value)
        camera = V4l2Camera(path, capture, options, clock)
        camera._set_up(stamp_of)
        return camera

    def _set_up(self, told: StampOf | None) -> None:
        options = self._options
        settings = _apply(self._path, options)
        if settings is not None:
            for one in differences(options, settings):
                logger.warning("camera %s: %s is %s, not %s; %s", self._path, one.what, one.got, one.wanted, one.remedy)
            if settings.exposure_ms is not None:
                self._exposure_ns = round(settings.exposure_ms * _MS)
        self._stamper = Stamper(self._path, options, told or StampOf.FRAME_START)
        card = "unknown" if settings is None else settings.card
        exposure = "unknown" if self._exposure_ns is None else f"{self._exposure_ns / _MS:g} ms"
        logger.info(
            "camera %s open: %s, %s, exposure %s, stamps of %s (%s)",
            self._path, card, _fourcc(self._capture), exposure, self._stamper.stamp_of,
            "as configured" if options.stamp_of != "auto" else "as the driver says" if told else "assumed",
        )  # fmt: skip

    def grab(self) -> Shot | None:
        """See `OpenCamera.grab`."""
        stamp_ns = None
        while stamp_ns is None:
            if not self._capture.grab():
                return None
            # At once: decoding takes its time.
            arrival_ns = self._clock.now_ns()
            driver_ns = round(self._capture.get(cv2.CAP_PROP_POS_MSEC) * _MS)
            stamp_ns = self._stamper.stamp_ns(driver_ns, arrival_ns, self._exposure_ns)
        good, image = self._capture.retrieve()
        if not good or image is None:
            return None
        if self._raw:
            decoded = decode(image.tobytes())
            if isinstance(decoded, str):
                return Shot(None, stamp_ns, self._exposure_ns, decoded)
            return Shot(decoded, stamp_ns, self._exposure_ns)
        return Shot(rgb(image, f"camera {self._path}"), stamp_ns, self._exposure_ns)

    def release(self) -> None:
        """See `OpenCamera.release`."""
        self._capture.release()


def _told_stamp_of(path: str) -> StampOf | None:
    try:
        with Control(path) as control:
            return control.stamp_of()
    except OSError:
        return None


def _apply(path: str, options: CameraOptions) -> Settings | None:
    """Exposure and gain, and what came of it."""
    try:
        with Control(path) as control:
            if options.exposure_ms is not None:
                control.set_exposure(None if options.exposure_ms == "auto" else options.exposure_ms)
            if options.gain is not None:
                control.set_gain(options.gain)
            return control.settings()
    except OSError as error:
        logger.warning("camera %s: can't be asked for its settings (%s)", path, error.strerror)
        return None


def _fourcc(capture: cv2.VideoCapture) -> str:
    return int(capture.get(cv2.CAP_PROP_FOURCC)).to_bytes(4, "little").decode("ascii", "replace").rstrip()
