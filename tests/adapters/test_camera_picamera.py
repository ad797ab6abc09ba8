"""Picamera2, as a stand-in with the shape of the real module: there was no Raspberry Pi to try it on."""

from __future__ import annotations

import importlib.machinery
import logging
import sys
import threading
import time
import types
from collections.abc import Iterator
from typing import Any, ClassVar

import numpy as np
import pytest

from ortholoc_edge.adapters.camera import CameraOptions, DeviceSource, open_source
from ortholoc_edge.adapters.camera.picamera import Picamera
from ortholoc_edge.clock import ManualClock, SystemClock
from ortholoc_edge.errors import CameraError, ConfigError
from ortholoc_edge.pipeline.frame import Frame

MS = 1_000_000
S = 1_000_000_000


class Request:
    """``CompletedRequest``: has to be given back."""

    def __init__(self, image: np.ndarray, metadata: dict[str, Any]) -> None:
        self._image, self._metadata = image, metadata
        self.released = 0

    def make_array(self, name: str) -> np.ndarray:
        assert name == "main" and not self.released
        return self._image.copy()

    def get_metadata(self) -> dict[str, Any]:
        return self._metadata

    def release(self) -> None:
        self.released += 1


class Device:
    """``Picamera2``, of what is used of it."""

    made: ClassVar[list[Device]] = []
    absent = False
    age_ns = 30 * MS
    exposure_us = 4000
    # Of every one: no frame comes.
    silent = False

    def __init__(self, camera_num: int = 0) -> None:
        if self.absent:
            raise RuntimeError("Camera __init__ sequence did not complete.")
        if camera_num > 1:
            raise IndexError("list index out of range")
        Device.made.append(self)
        self.camera_properties = {"Model": "imx296"}
        self.requests: list[Request] = []
        self.started = self.closed = False
        # Jobs are done in their order, a capture when a frame comes.
        self.captures_waiting = 0

    def create_video_configuration(self, main: dict[str, Any], controls: dict[str, Any]) -> dict[str, Any]:
        return {"main": {"size": (1280, 720), **main}, "controls": controls}

    def configure(self, configuration: dict[str, Any]) -> None:
        self.configuration = configuration
        width, height = configuration["main"]["size"]
        # As libcamera does with a size that the hardware can't give.
        configuration["main"]["size"] = (width - width % 2, height - height % 2)

    def camera_configuration(self) -> dict[str, Any]:
        return self.configuration

    def start(self) -> None:
        self.started = True

    def capture_request(self, wait: float) -> Request:
        assert self.started and 0 < wait <= 5
        if self.silent:
            self.captures_waiting += 1
            raise TimeoutError
        time.sleep(0.01)
        width, height = self.configuration["main"]["size"]
        image = np.zeros((height, width, 3), np.uint8)
        image[..., 0] = 200
        metadata = {
            "SensorTimestamp": time.monotonic_ns() - self.age_ns, "ExposureTime": self.exposure_us, "AnalogueGain": 2.0,
        }  # fmt: skip
        self.requests.append(Request(image, metadata))
        return self.requests[-1]

    def cancel_all_and_flush(self) -> None:
        self.captures_waiting = 0

    def stop(self) -> None:
        if self.captures_waiting:
            threading.Event().wait()
        self.started = False

    def close(self) -> None:
        self.closed = True


@pytest.fixture
def device(monkeypatch: pytest.MonkeyPatch) -> type[Device]:
    module = types.ModuleType("picamera2")
    module.Picamera2 = Device  # type: ignore[attr-defined]
    module.__spec__ = importlib.machinery.ModuleSpec("picamera2", None)
    monkeypatch.setitem(sys.modules, "picamera2", module)
    monkeypatch.setattr(Device, "made", [])
    return Device


@pytest.fixture
def source(device: type[Device]) -> Iterator[DeviceSource]:
    options = CameraOptions(
        source="picamera2:0", width_px=641, height_px=480, fps=20.0, exposure_ms=4.0, gain=2.0, readout_ms=8.0
    )
    made = open_source(options, SystemClock())
    assert isinstance(made, DeviceSource)
    yield made
    made.close()


def frame_from(source: DeviceSource) -> Frame:
    end = time.monotonic() + 10.0
    while time.monotonic() < end:
        frame = source.read(0.2)
        if frame is not None:
            return frame
    raise AssertionError("no frame in time")


def test_frames_with_the_sensors_stamp_and_exposure(
    source: DeviceSource, device: type[Device], caplog: pytest.LogCaptureFixture
) -> None:
    frame = frame_from(source)
    assert frame.image.shape == (480, 640, 3) and (frame.image[0, 0] == (200, 0, 0)).all()
    assert not frame.image.flags.writeable
    assert frame.exposure_ns == 4 * MS
    camera = device.made[0]
    assert camera.configuration["controls"] == {
        "FrameDurationLimits": (50_000, 50_000), "ExposureTime": 4000, "AnalogueGain": 2.0
    }  # fmt: skip
    assert camera.configuration["main"]["format"] == "BGR888", "which is red first in memory"
    said = [record.getMessage() for when in ("setup", "call") for record in caplog.get_records(when)]  # type: ignore[arg-type]
    assert "camera picamera2:0 gives 640 x 480 px, not 641 x 480" in said
    source.close()
    assert camera.closed and all(request.released == 1 for request in camera.requests)


@pytest.mark.parametrize("ahead_ns", [0, 3600 * S])
def test_the_middle_of_the_exposure(device: type[Device], monkeypatch: pytest.MonkeyPatch, ahead_ns: int) -> None:
    """Stamps are of the start of the readout; by CLOCK_BOOTTIME they are ahead by as long as the computer slept."""
    clock = ManualClock(10 * S)
    monkeypatch.setattr(time, "monotonic_ns", clock.now_ns)
    monkeypatch.setattr(time, "clock_gettime_ns", lambda _: clock.now_ns() + ahead_ns)
    monkeypatch.setattr(Device, "age_ns", 30 * MS - ahead_ns)
    options = CameraOptions(source="picamera2:0", readout_ms=8.0, driver_latency_ms=1.0)
    camera = Picamera.open(0, options, clock)
    assert camera is not None
    shot = camera.grab()
    # Of the middle row, 4 ms after the first, of which half of the exposure of 4 ms is over by then.
    assert shot is not None and shot.stamp_ns == 10 * S + (-30 + 4 - 2 - 1) * MS
    camera.release()


def test_a_camera_that_is_not_there_or_silent_is_waited_for(
    device: type[Device], monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = SystemClock()
    assert Picamera.open(7, CameraOptions(source="picamera2:7"), clock) is None
    monkeypatch.setattr(Device, "absent", True)
    assert Picamera.open(0, CameraOptions(source="picamera2:0"), clock) is None
    monkeypatch.setattr(Device, "absent", False)
    camera = Picamera.open(0, CameraOptions(source="picamera2:0"), clock)
    assert camera is not None
    device.made[-1].silent = True
    assert camera.grab() is None


def test_a_camera_that_falls_silent_is_opened_again(
    source: DeviceSource, device: type[Device], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its stop waits behind a capture that was given up, unless that is taken back."""
    frame_from(source)
    monkeypatch.setattr(Device, "silent", True)
    end = time.monotonic() + 10.0
    while not source.reconnects and time.monotonic() < end:
        time.sleep(0.02)
    assert source.reconnects and device.made[0].closed
    monkeypatch.setattr(Device, "silent", False)
    frame_from(source)


def test_other_values_than_asked_for_are_said(
    device: type[Device], monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(Device, "exposure_us", 33_000)
    camera = Picamera.open(0, CameraOptions(source="picamera2:0", exposure_ms=60.0, gain=8.0), SystemClock())
    assert camera is not None
    for _ in range(3):
        camera.grab()
    assert caplog.text.count("exposure is 33 ms, not 60 ms") == 1 and caplog.text.count("gain is 2, not 8") == 1


def test_automatic_exposure(device: type[Device]) -> None:
    camera = Picamera.open(0, CameraOptions(source="picamera2:0", exposure_ms="auto"), SystemClock())
    assert camera is not None
    assert device.made[0].configuration["controls"] == {"FrameDurationLimits": (100_000, 100_000), "AeEnable": True}


def test_without_the_module_it_is_said_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(CameraError, match=r"sudo apt install python3-picamera2.*--system-site-packages"):
        open_source(CameraOptions(source="picamera2:0"), ManualClock())
    with pytest.raises(ConfigError, match="picamera2:0"):
        open_source(CameraOptions(source="picamera2:front"), ManualClock())
    assert all(thread.name != "camera" for thread in threading.enumerate())


def test_a_module_that_cant_be_loaded(monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    monkeypatch.setitem(sys.modules, "picamera2", None)
    caplog.set_level(logging.DEBUG)
    with pytest.raises(CameraError, match="can't be loaded"):
        Picamera.open(0, CameraOptions(source="picamera2:0"), SystemClock())
