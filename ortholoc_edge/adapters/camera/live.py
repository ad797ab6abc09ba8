"""Frames from a live camera or stream, through OpenCV."""

from __future__ import annotations

import logging
import threading

import cv2

from ortholoc_edge.adapters.camera.pictures import rgb
from ortholoc_edge.adapters.camera.source import EndOfFrames
from ortholoc_edge.clock import Clock
from ortholoc_edge.errors import CameraError
from ortholoc_edge.pipeline.frame import Frame

logger = logging.getLogger(__name__)

_BACKOFF_MIN_S, _BACKOFF_MAX_S = 0.5, 10.0
# A stream that fails this often in a row is opened anew.
_MAX_FAILED_GRABS = 5
# Of FFmpeg's network streams; its defaults are 30 s, in which a vehicle flies far.
_NETWORK_TIMEOUT_MS = 5000


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
            frame = Frame(stamp_ns, rgb(image, f"camera {self._device}"), str(self._number))
            self._number += 1
            with self._condition:
                self.overwritten += self._latest is not None
                self._latest = frame
                self._condition.notify_all()


def _usable_backends() -> list[int]:
    return [b for b in cv2.videoio_registry.getBackends() if cv2.videoio_registry.hasBackend(b)]
