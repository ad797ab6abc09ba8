"""Frames from something that can go away: a thread that grabs, keeps the newest, and opens it again."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from ortholoc_edge.adapters.camera.source import BadFrameError, EndOfFrames
from ortholoc_edge.clock import Clock
from ortholoc_edge.errors import CameraError
from ortholoc_edge.geometry.arrays import ImageArray
from ortholoc_edge.pipeline.frame import Frame

logger = logging.getLogger(__name__)

_S = 1_000_000_000
# A vehicle flies blind for as long as it is not looked for.
_BACKOFF_MIN_S, _BACKOFF_MAX_S = 0.5, 2.0
# A camera that fails this often in a row, or gives nothing for so long, is opened anew.
_MAX_FAILED_GRABS = 5
_SILENT_NS = 2 * _S
# No driver waits for so long that lets go at all: opening takes 5 s, a frame 3; a name that nobody resolves up to 20.
_HUNG_NS = 20 * _S


@dataclass(frozen=True, slots=True, eq=False)
class Shot:
    """What one grab brought.

    Attributes:
        image: (H, W, 3) RGB uint8, read-only; None of a frame that is unusable.
        stamp_ns: middle of the exposure.
        exposure_ns: how long, where that is known.
        defect: why there is no image.
    """

    image: ImageArray | None
    stamp_ns: int
    exposure_ns: int | None = None
    defect: str = ""


@dataclass(frozen=True, slots=True)
class Late:
    """A frame that lay in a queue, so that its arrival tells nothing; 0 where that can't be told yet."""

    late_ns: int


class OpenCamera(Protocol):
    """A camera that is open; used by one thread."""

    def grab(self) -> Shot | Late | None:
        """Wait for the next frame, some seconds at most; None if none came.

        Raises: CameraError if the camera can never be used.
        """
        ...

    def release(self) -> None:
        """Close it."""
        ...


class DeviceSource:
    """A live camera or stream. A thread grabs all the time, so that `read` gives the newest frame, never a
    queued one.

    A device that is missing, pulled out or silent is opened again with a growing pause; meanwhile `read`
    returns None. Where its driver keeps the thread, `read` raises CameraError: nothing but another process helps.
    """

    def __init__(self, name: str, opened: Callable[[], OpenCamera | None], clock: Clock) -> None:
        """Start grabbing.

        Args:
            name: for messages; without credentials.
            opened: opens it, and returns None while it is not there. Raises CameraError if it can never be used.
        """
        self._name, self._opened, self._clock = name, opened, clock
        self._condition = threading.Condition()
        self._latest: Frame | BadFrameError | None = None
        self._failure: BaseException | None = None
        self._stop = threading.Event()
        self.overwritten = 0
        self.reconnects = 0
        self.failed_grabs = 0
        self.damaged = 0
        self.left_out = 0
        self._is_late_told = False
        self._number = 0
        self._beat_ns = clock.now_ns()
        self._thread = threading.Thread(target=self._run, name="camera", daemon=True)
        self._thread.start()

    def counts(self) -> dict[str, int]:
        """Since the start: frames that came, that were damaged, and that a newer one replaced unread; those that
        were left out since they lay in a queue; grabs that failed; how often it was opened again."""
        return {
            "frames": self._number,
            "damaged": self.damaged,
            "overwritten": self.overwritten,
            "left_out": self.left_out,
            "failed_grabs": self.failed_grabs,
            "reconnects": self.reconnects,
        }

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
                raise CameraError(f"camera {self._name}: its thread ended; see the log") from self._failure
            latest, self._latest = self._latest, None
        hung_ns = self._clock.now_ns() - self._beat_ns
        if latest is None and hung_ns > _HUNG_NS:
            raise CameraError(
                f"camera {self._name}: its driver has not come back for {hung_ns / _S:.0f} s; start the program "
                "afresh, as systemd does, and look at cable and supply if that does not help"
            )
        if isinstance(latest, BadFrameError):
            raise latest
        return latest

    def close(self) -> None:
        """See `FrameSource.close`."""
        self._stop.set()
        with self._condition:
            self._condition.notify_all()
        # The driver may sit in a wait of its own; the thread owns the device and releases it when it comes
        # back.
        self._thread.join(timeout=2.0)
        if self._thread.is_alive():
            logger.warning("camera %s: the driver still waits; it is left to end by itself", self._name)

    def _run(self) -> None:
        try:
            self._connect_and_grab()
        except BaseException as error:
            logger.exception("camera %s: the grabbing thread ends", self._name)
            with self._condition:
                self._failure = error
                self._condition.notify_all()

    def _connect_and_grab(self) -> None:
        backoff_s = _BACKOFF_MIN_S
        failures = 0
        while not self._stop.is_set():
            self._beat_ns = self._clock.now_ns()
            camera = self._opened()
            if camera is not None:
                before = self._number
                try:
                    what = self._grab_until_broken(camera)
                finally:
                    self._beat_ns = self._clock.now_ns()
                    camera.release()
                if self._number > before:
                    backoff_s, failures = _BACKOFF_MIN_S, 0
            else:
                what = "can't be opened"
            if self._stop.is_set():
                return
            # Once per outage and then ever more rarely: a camera that stays away must not fill the log.
            failures += 1
            if failures & (failures - 1) == 0 and failures not in (2, 4, 8):
                logger.warning("camera %s %s; trying again", self._name, what)
            self.reconnects += 1
            self._stop.wait(backoff_s)
            backoff_s = min(2.0 * backoff_s, _BACKOFF_MAX_S)

    def _grab_until_broken(self, camera: OpenCamera) -> str:
        """Why it is to be opened anew."""
        failed, last_ns = 0, self._clock.now_ns()
        late_since_ns: int | None = None
        while not self._stop.is_set():
            self._beat_ns = self._clock.now_ns()
            shot = camera.grab()
            if shot is None:
                failed += 1
                self.failed_grabs += 1
                if failed >= _MAX_FAILED_GRABS or self._clock.now_ns() - last_ns >= _SILENT_NS:
                    return "lost"
                continue
            if isinstance(shot, Late):
                self._leave_out(shot)
                now_ns = self._clock.now_ns()
                late_since_ns = late_since_ns or now_ns
                # A queue that does not run dry; a new connection has none.
                if now_ns - late_since_ns >= _SILENT_NS:
                    return f"late by {shot.late_ns / 1e6:.0f} ms all the time"
                continue
            late_since_ns = None
            failed, last_ns = 0, self._clock.now_ns()
            name = str(self._number)
            self._number += 1
            latest: Frame | BadFrameError
            if shot.image is None:
                self.damaged += 1
                latest = BadFrameError(f"camera {self._name}: frame {name} is {shot.defect}", shot.stamp_ns, name)
            else:
                latest = Frame(shot.stamp_ns, shot.image, name, shot.exposure_ns)
            with self._condition:
                self.overwritten += self._latest is not None
                self._latest = latest
                self._condition.notify_all()
        return "closed"

    def _leave_out(self, late: Late) -> None:
        self.left_out += 1
        if late.late_ns and not self._is_late_told:
            self._is_late_told = True
            logger.warning(
                "camera %s: a frame comes %.0f ms later than others; such frames are left out, since they are stamped "
                "by their arrival, and counted (left_out); look at what lies between it and this computer",
                self._name, late.late_ns / 1e6,
            )  # fmt: skip
