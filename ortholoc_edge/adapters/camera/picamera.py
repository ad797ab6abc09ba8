"""A Raspberry Pi's CSI camera through Picamera2, which stands on libcamera and comes with the system, not from PyPI."""

from __future__ import annotations

import importlib
import importlib.util
import logging
import time
from typing import Any

from ortholoc_edge.adapters.camera.live import Shot
from ortholoc_edge.adapters.camera.options import CameraOptions
from ortholoc_edge.adapters.camera.pictures import frozen_rgb
from ortholoc_edge.adapters.camera.stamps import Stamper, StampOf
from ortholoc_edge.clock import Clock
from ortholoc_edge.errors import CameraError

logger = logging.getLogger(__name__)

_US, _MS = 1_000, 1_000_000
_WAIT_S = 2.0
# In memory red comes first, whatever the name says: libcamera names formats by the bytes of a little-endian number.
_RGB = "BGR888"


def require_picamera2() -> None:
    """Raises: CameraError if it is not installed for this Python."""
    if importlib.util.find_spec("picamera2") is None:
        raise CameraError(
            "camera source picamera2: this Python has no Picamera2; sudo apt install python3-picamera2, and make the "
            "virtual environment with --system-site-packages, since it comes with the system (docs/cameras.md)"
        )


class Picamera:
    """See `OpenCamera`."""

    def __init__(self, name: str, device: Any, options: CameraOptions, clock: Clock) -> None:
        """
        Args:
            name: for messages.
            device: a ``picamera2.Picamera2`` that runs.
        """
        self._name, self._device, self._options, self._clock = name, device, options, clock
        # Of the first row's readout, as a Raspberry Pi's kernel takes it, whatever libcamera says.
        self._stamper = Stamper(name, options, StampOf.FRAME_START)
        self._told = False

    @staticmethod
    def open(number: int, options: CameraOptions, clock: Clock) -> Picamera | None:
        """The camera of that number; None while there is none, or another program has it.

        Raises: CameraError if the module can't be loaded.
        """
        name = f"picamera2:{number}"
        try:
            module = importlib.import_module("picamera2")
        except ImportError as error:
            raise CameraError(
                f"camera {name}: Picamera2 is there but can't be loaded ({error}); sudo apt install --reinstall "
                "python3-picamera2 python3-libcamera"
            ) from error
        device = None
        try:
            device = module.Picamera2(number)
            main: dict[str, Any] = {"format": _RGB}
            if options.width_px is not None and options.height_px is not None:
                main["size"] = (options.width_px, options.height_px)
            device.configure(device.create_video_configuration(main=main, controls=_controls(options)))
            device.start()
        # What it raises is not documented: RuntimeError, IndexError for a camera that is not there.
        except Exception as error:
            logger.debug("camera %s: %s", name, error)
            if device is not None:
                device.close()
            return None
        size = tuple(device.camera_configuration()["main"]["size"])
        if main.get("size", size) != size:
            logger.warning("camera %s gives %d x %d px, not %d x %d", name, *size, *main["size"])
        logger.info("camera %s open: %s", name, device.camera_properties.get("Model", "unknown"))
        return Picamera(name, device, options, clock)

    def grab(self) -> Shot | None:
        """See `OpenCamera.grab`."""
        try:
            request = self._device.capture_request(wait=_WAIT_S)
        except TimeoutError:
            # The capture waits on at the head of Picamera2's list, and a stop behind it would wait for ever.
            self._device.cancel_all_and_flush()
            return None
        arrival_ns = self._clock.now_ns()
        try:
            metadata: dict[str, Any] = request.get_metadata()
            image = request.make_array("main")
        finally:
            # There are few buffers, and while we have one the camera does not.
            request.release()
        exposure = metadata.get("ExposureTime")
        exposure_ns = round(exposure * _US) if exposure else None
        if not self._told and exposure_ns is not None:
            self._told = True
            self._compare(exposure_ns, metadata.get("AnalogueGain"))
        sensor_ns = metadata.get("SensorTimestamp", 0)
        if sensor_ns > arrival_ns:
            # libcamera documents CLOCK_BOOTTIME, which is ahead by as long as the computer slept, and hands on the
            # kernel's CLOCK_MONOTONIC on a Raspberry Pi.
            sensor_ns -= max(time.clock_gettime_ns(time.CLOCK_BOOTTIME) - time.monotonic_ns(), 0)
        stamp_ns = self._stamper.stamp_ns(sensor_ns, arrival_ns, exposure_ns)
        return None if stamp_ns is None else Shot(frozen_rgb(image, f"camera {self._name}"), stamp_ns, exposure_ns)

    def _compare(self, exposure_ns: int, gain: float | None) -> None:
        wanted_ns = self._options.fixed_exposure_ns
        if wanted_ns is not None and abs(exposure_ns - wanted_ns) > max(0.1 * _MS, 0.1 * wanted_ns):
            logger.warning(
                "camera %s: exposure is %g ms, not %g ms; a frame has no longer one than its period",
                self._name, exposure_ns / _MS, wanted_ns / _MS,
            )  # fmt: skip
        asked = self._options.gain
        if asked is not None and gain is not None and abs(gain - asked) > max(0.1, 0.1 * asked):
            logger.warning("camera %s: gain is %g, not %g", self._name, gain, asked)

    def release(self) -> None:
        """See `OpenCamera.release`."""
        self._device.stop()
        self._device.close()


def _controls(options: CameraOptions) -> dict[str, Any]:
    period_us = round(1e6 / (options.fps or options.rate_hz))
    controls: dict[str, Any] = {"FrameDurationLimits": (period_us, period_us)}
    if options.exposure_ms == "auto":
        controls["AeEnable"] = True
    elif options.exposure_ms is not None:
        controls["ExposureTime"] = round(options.exposure_ms * 1000)
    if options.gain is not None:
        controls["AnalogueGain"] = float(options.gain)
    return controls
