"""Frames from a folder of pictures or a recorded video."""

from __future__ import annotations

import logging
import threading
from pathlib import Path

import cv2

from ortholoc_edge.adapters.camera.pictures import IMAGE_SUFFIXES, read_image, rgb
from ortholoc_edge.adapters.camera.source import BadFrameError, EndOfFrames
from ortholoc_edge.clock import Clock
from ortholoc_edge.errors import CameraError
from ortholoc_edge.geometry.arrays import ImageArray
from ortholoc_edge.pipeline.frame import Frame

logger = logging.getLogger(__name__)

_MS = 1_000_000
_S = 1_000_000_000


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
            raise CameraError(f"folder {folder} holds no picture ({', '.join(sorted(IMAGE_SUFFIXES))}); check the path")
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
            raise CameraError(f"video {path} can't be opened by OpenCV; convert it, for instance to MP4 with H.264")
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
        return rgb(image, f"video {self._path}") if good and image is not None else None

    def _report_end(self) -> None:
        promised = int(self._capture.get(cv2.CAP_PROP_FRAME_COUNT))
        if 0 < self._number < promised - 1:
            logger.warning("video %s ends after %d of %d frames", self._path, self._number, promised)

    def close(self) -> None:
        """See `FrameSource.close`."""
        self._closed.set()
        with self._lock:
            self._capture.release()


def _wait_until(clock: Clock, due_ns: int, timeout_s: float, closed: threading.Event) -> bool:
    """Wait for ``due_ns`` of the clock, at most ``timeout_s``; whether it is reached.

    The wait itself is in real time. With a clock that somebody sets, it is a pause before looking again.
    """
    remaining_s = (due_ns - clock.now_ns()) / _S
    if remaining_s > 0 and timeout_s > 0:
        closed.wait(min(remaining_s, timeout_s))
    return clock.now_ns() >= due_ns
