"""What a process sees of the made-up camera of `v4l2_device.c`, which is loaded into it; prints it as JSON.

``python -m adapters.v4l2_session NAME DEVICE``; NAME is one of the functions below.
"""

from __future__ import annotations

import json
import logging
import sys
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from ortholoc_edge.adapters.camera import BadFrameError, CameraOptions, DeviceSource, open_source, prepare
from ortholoc_edge.adapters.camera.v4l2 import differences, read_settings
from ortholoc_edge.clock import SystemClock
from ortholoc_edge.pipeline.frame import Frame

CLOCK = SystemClock()
WIDTH, HEIGHT = 128, 96


def picture() -> np.ndarray:
    """BGR, its left half red."""
    image = np.full((HEIGHT, WIDTH, 3), 60, np.uint8)
    image[:, : WIDTH // 2] = (40, 40, 230)
    return image


def jpeg() -> bytes:
    ok, data = cv2.imencode(".jpg", picture())
    assert ok
    return data.tobytes()


def yuyv() -> bytes:
    yuv = cv2.cvtColor(picture(), cv2.COLOR_BGR2YUV)
    packed = np.empty((HEIGHT, WIDTH, 2), np.uint8)
    packed[..., 0] = yuv[..., 0]
    packed[:, 0::2, 1], packed[:, 1::2, 1] = yuv[:, 0::2, 1], yuv[:, 0::2, 2]
    return packed.tobytes()


def until(source: DeviceSource, wanted: Callable[[Frame | BadFrameError | None], bool]) -> Frame | BadFrameError | None:
    """What is read, until it is what is wanted, for ten seconds at most."""
    end = time.monotonic() + 10.0
    while time.monotonic() < end:
        found: Frame | BadFrameError | None
        try:
            found = source.read(0.3)
        except BadFrameError as bad:
            found = bad
        if wanted(found):
            return found
    raise AssertionError("not in time")


def is_frame(found: object) -> bool:
    return isinstance(found, Frame)


def told(frame: Frame | BadFrameError | None) -> dict[str, object]:
    assert isinstance(frame, Frame)
    return {
        "shape": frame.image.shape,
        "left": frame.image[5, 5].tolist(),
        "age_ms": (CLOCK.now_ns() - frame.stamp_ns) / 1e6,
        "below_ms": frame.stamp_ns % 1_000_000,
        "exposure_ns": frame.exposure_ns,
    }


def well(device: Path) -> dict[str, object]:
    """Compressed frames, one of them damaged; the camera is pulled out and comes back."""
    frames = device.with_name(f"{device.name}.MJPG")
    frames.write_bytes(jpeg())
    options = CameraOptions(
        source=f"device:{device}", format="MJPG", width_px=WIDTH, height_px=HEIGHT, fps=25.0, exposure_ms=5.0, gain=30.0
    )
    prepare(options)
    source = open_source(options, CLOCK)
    assert isinstance(source, DeviceSource)
    seen: dict[str, object] = {"first": told(until(source, is_frame))}
    stamps = [told_stamp(until(source, is_frame)) for _ in range(6)]
    seen["steps_ms"] = np.diff(stamps).tolist()
    settings = read_settings(str(device))
    assert settings is not None
    seen["settings"] = [settings.card, settings.format, settings.fps, settings.exposure_ms, settings.gain]
    seen["differences"] = len(differences(options, settings))
    frames.write_bytes(jpeg()[:-30])
    seen["damaged"] = str(until(source, lambda found: isinstance(found, BadFrameError)))
    frames.write_bytes(jpeg())
    until(source, is_frame)
    device.unlink()
    until(source, lambda found: found is None)
    before = CLOCK.now_ns()
    device.touch()
    seen["back"] = told(until(source, is_frame))
    seen["back_after_ms"] = (CLOCK.now_ns() - before) / 1e6
    seen["counts"] = source.counts()
    source.close()
    return seen


def told_stamp(frame: Frame | BadFrameError | None) -> float:
    assert isinstance(frame, Frame)
    return frame.stamp_ns / 1e6


def otherwise(device: Path) -> dict[str, object]:
    """A device that gives other values than it was asked for, whose stamps are of the wall clock, and that then goes
    silent."""
    device.with_name(f"{device.name}.YUYV").write_bytes(yuyv())
    options = CameraOptions(
        source=f"device:{device}", format="NV12", width_px=1280, height_px=720, fps=60.0, exposure_ms=100.0,
        gain=500.0, latency_ms=40.0,
    )  # fmt: skip
    prepare(options)
    source = open_source(options, CLOCK)
    assert isinstance(source, DeviceSource)
    seen: dict[str, object] = {"first": told(until(source, is_frame))}
    silent = device.with_name(f"{device.name}.silent")
    silent.touch()
    until(source, lambda _: source.reconnects > 0)
    silent.unlink()
    seen["back"] = told(until(source, is_frame))
    settings = read_settings(str(device))
    assert settings is not None
    seen["differences"] = [(one.what, one.got, one.wanted, one.remedy) for one in differences(options, settings)]
    source.close()
    return seen


def automatic(device: Path) -> dict[str, object]:
    """Exposure is the device's own, stamps are of the end of the frame."""
    device.with_name(f"{device.name}.YUYV").write_bytes(yuyv())
    options = CameraOptions(
        source=f"device:{device}", format="YUYV", width_px=WIDTH, height_px=HEIGHT, fps=30.0, exposure_ms="auto",
        readout_ms=10.0,
    )  # fmt: skip
    prepare(options)
    source = open_source(options, CLOCK)
    assert isinstance(source, DeviceSource)
    seen: dict[str, object] = {"first": told(until(source, is_frame))}
    settings = read_settings(str(device))
    assert settings is not None
    seen["automatic"] = [settings.automatic, settings.exposure_ms, settings.exposure_range_ms]
    source.close()
    return seen


if __name__ == "__main__":
    logging.basicConfig(level=logging.INFO, format="%(levelname)s %(message)s")
    scenario = {"well": well, "otherwise": otherwise, "automatic": automatic}[sys.argv[1]]
    sys.stdout.write(json.dumps(scenario(Path(sys.argv[2]))) + "\n")
