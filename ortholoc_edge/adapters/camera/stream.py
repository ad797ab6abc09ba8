"""Streams that OpenCV reads through FFmpeg. They have no stamps of the exposure: frames are stamped when
they arrive."""

from __future__ import annotations

import logging
import os

import cv2

from ortholoc_edge.adapters.camera.live import Late, Shot
from ortholoc_edge.adapters.camera.options import CameraOptions
from ortholoc_edge.adapters.camera.pictures import rgb
from ortholoc_edge.adapters.camera.stamps import Arrivals
from ortholoc_edge.adapters.secret import without_credentials
from ortholoc_edge.clock import Clock

logger = logging.getLogger(__name__)

_MS = 1_000_000
# Kinds of sources that are addresses.
NETWORK = ("rtsp", "http", "https")
# FFmpeg's own are 30 s, in which a vehicle flies far.
_OPEN_TIMEOUT_MS, _READ_TIMEOUT_MS = 5000, 3000
# OpenCV takes FFmpeg's options from the environment alone, each time it opens a stream.
_FFMPEG_OPTIONS = "OPENCV_FFMPEG_CAPTURE_OPTIONS"
# Over UDP packets get lost, and half of a picture is grey; a queue in the demuxer is latency.
_LOW_LATENCY = "rtsp_transport;tcp|fflags;nobuffer|flags;low_delay"


class StreamCamera:
    """See `OpenCamera`."""

    def __init__(
        self, name: str, capture: cv2.VideoCapture, options: CameraOptions, clock: Clock, is_timed: bool
    ) -> None:
        """
        Args:
            name: for messages.
            capture: open.
            is_timed: frames come with the camera's time.
        """
        self._name, self._capture, self._clock = name, capture, clock
        self._latency_ns = round(options.latency_ms * _MS)
        self._is_timed, self._arrivals = is_timed, Arrivals()
        # What it was set to where it stands.
        self._exposure_ns = options.fixed_exposure_ns

    def grab(self) -> Shot | Late | None:
        """See `OpenCamera.grab`."""
        if not self._capture.grab():
            return None
        # Decoded by then, which is part of the delay that the options state; conversion to RGB, which follows, is not.
        arrival_ns = self._clock.now_ns()
        own_ns = round(self._capture.get(cv2.CAP_PROP_POS_MSEC) * _MS) if self._is_timed else None
        late_ns = self._arrivals.late_ns(own_ns, arrival_ns)
        if late_ns is not None:
            return Late(late_ns)
        stamp_ns = arrival_ns - self._latency_ns
        good, image = self._capture.retrieve()
        if not good or image is None:
            return None
        return Shot(rgb(image, f"camera {self._name}"), stamp_ns, self._exposure_ns)

    def release(self) -> None:
        """See `OpenCamera.release`."""
        self._capture.release()


def prepare_network() -> None:
    """What FFmpeg has to know before it opens a stream; see `opening.prepare`. What the user has set stays."""
    os.environ.setdefault(_FFMPEG_OPTIONS, _LOW_LATENCY)


def open_network(address: str, options: CameraOptions, clock: Clock) -> StreamCamera | None:
    """A ``rtsp://``, ``http://`` or ``https://`` address; None while nobody answers there."""
    # One thread: several decode as many frames at a time, and each comes so many frames late.
    capture = cv2.VideoCapture(
        address,
        cv2.CAP_FFMPEG,
        [
            cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, _OPEN_TIMEOUT_MS, cv2.CAP_PROP_READ_TIMEOUT_MSEC, _READ_TIMEOUT_MS,
            cv2.CAP_PROP_N_THREADS, 1,
        ],
    )  # fmt: skip
    if not capture.isOpened():
        capture.release()
        return None
    name = without_credentials(address)
    logger.info("camera %s open", name)
    # Pictures over HTTP have no time of their own: FFmpeg counts them as if there were 25 a second.
    is_timed = address.startswith("rtsp:") or capture.get(cv2.CAP_PROP_FOURCC) != cv2.VideoWriter.fourcc(*"MJPG")
    return StreamCamera(name, capture, options, clock, is_timed)
