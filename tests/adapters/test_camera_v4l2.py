"""V4L2 devices: a made-up one, compiled and loaded into a process of its own, through OpenCV's real V4L2 code."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from ortholoc_edge.adapters.camera import CameraOptions
from ortholoc_edge.adapters.camera.stamps import DriverStamps, StampOf, mid_exposure_minus_stamp_ns
from ortholoc_edge.adapters.camera.v4l2 import Settings, differences

MS = 1_000_000
S = 1_000_000_000
TESTS = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def shim(tmp_path_factory: pytest.TempPathFactory) -> Path:
    compiler = shutil.which("gcc") or shutil.which("cc")
    if compiler is None or sys.platform != "linux" or sys.maxsize < 2**32:
        pytest.skip("a made-up V4L2 device needs gcc and 64-bit Linux")
    library = tmp_path_factory.mktemp("v4l2") / "device.so"
    source = Path(__file__).with_name("v4l2_device.c")
    built = subprocess.run(
        [compiler, "-shared", "-fPIC", "-O1", "-o", library, source], capture_output=True, text=True, check=False
    )
    if built.returncode != 0:
        pytest.skip(f"a made-up V4L2 device can't be compiled here: {built.stderr.splitlines()[0]}")
    return library


def session(name: str, shim: Path, folder: Path, **environment: str) -> tuple[dict[str, Any], str]:
    """What the session saw, and what it logged."""
    device = folder / "video0"
    device.touch()
    done = subprocess.run(
        [sys.executable, "-m", "adapters.v4l2_session", name, str(device)],
        env={
            **os.environ, "LD_PRELOAD": str(shim), "V4L2_DEVICE": str(device), **environment,
            "PYTHONPATH": os.pathsep.join([str(TESTS), *sys.path]),
        },
        capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    seen: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return seen, done.stderr


def test_a_device_that_does_as_it_is_told(shim: Path, tmp_path: Path) -> None:
    seen, log = session("well", shim, tmp_path, V4L2_SOURCE="soe")
    first = seen["first"]
    assert first["shape"] == [96, 128, 3]
    assert first["left"][0] > 140 > first["left"][2], "red, so RGB"
    # Its stamps are whole milliseconds: what is below is our half of the exposure, of 5 ms.
    assert first["exposure_ns"] == 5 * MS and first["below_ms"] == MS // 2
    # 20 ms after the stamp, which is of the start of the exposure.
    assert first["age_ms"] >= 20 - 1 - 2.5
    assert all(step % 40 == 0.0 < step for step in seen["steps_ms"]), "the driver's own, at 25 Hz"
    assert seen["settings"] == ["Made-up camera", "MJPG", 25.0, 5.0, 30]
    assert seen["differences"] == 0
    assert "truncated after" in seen["damaged"] and "end marker" in seen["damaged"]
    assert seen["back"]["shape"] == [96, 128, 3] and seen["counts"]["reconnects"] >= 1
    assert seen["counts"]["damaged"] >= 1 and seen["counts"]["frames"] > 8
    assert "stamps of exposure_start (as the driver says)" in log
    assert log.count("lost; trying again") == 1


def test_a_device_that_does_something_else(shim: Path, tmp_path: Path) -> None:
    seen, log = session("otherwise", shim, tmp_path, V4L2_CLOCK="realtime")
    assert seen["first"]["shape"] == [96, 128, 3]
    assert seen["first"]["left"][0] > 140 > seen["first"]["left"][2]
    assert seen["first"]["age_ms"] >= 40, "stamped on arrival, less latency_ms"
    assert seen["back"]["age_ms"] >= 40
    assert log.count("stamps are not of the monotonic clock") == 2, "said once a connection"
    found = {what: (got, wanted, remedy) for what, got, wanted, remedy in seen["differences"]}
    assert set(found) == {"format", "width", "height", "rate", "exposure", "gain"}
    assert found["format"] == ("YUYV", "NV12", "write [camera] format as one that it has: MJPG, YUYV")
    assert found["exposure"] == ("33 ms", "100 ms", "it has 0.1 to 33 ms")
    assert found["rate"][0] == "30 frames per second"
    assert found["gain"] == ("100", "500", "it has 0 to 100")
    assert "exposure is 33 ms, not 100 ms; it has 0.1 to 33 ms" in log
    assert log.count("lost; trying again") == 1


def test_a_device_that_exposes_by_itself(shim: Path, tmp_path: Path) -> None:
    seen, log = session("automatic", shim, tmp_path, V4L2_SOURCE="eof")
    assert seen["automatic"] == [True, None, [0.1, 33.0]]
    assert seen["first"]["exposure_ns"] is None
    # Half of the readout before the frame's end, and nothing is known of the exposure.
    assert seen["first"]["below_ms"] == 0 and seen["first"]["age_ms"] >= 20 - 1 + 5
    assert "exposure unknown, stamps of frame_end (as the driver says)" in log


# -- stamps --------------------------------------------------------------------


@pytest.mark.parametrize(
    ("stamp_of", "rolling", "ms"),
    [
        # Exposure 4, readout 10: the middle row of a rolling shutter is 5 after the first.
        (StampOf.EXPOSURE_START, True, 5 + 2),
        (StampOf.FRAME_START, True, 5 - 2),
        (StampOf.FRAME_END, True, -5 - 2),
        (StampOf.EXPOSURE_START, False, 2),
        (StampOf.FRAME_START, False, -2),
        (StampOf.FRAME_END, False, -10 - 2),
    ],
)
def test_middle_of_the_exposure(stamp_of: StampOf, rolling: bool, ms: int) -> None:
    assert mid_exposure_minus_stamp_ns(stamp_of, 4 * MS, 10 * MS, rolling) == ms * MS


def test_stamps_of_another_clock_are_given_up_and_a_late_frame_is_not() -> None:
    stamps = DriverStamps()
    assert stamps.judge(10 * S, 10 * S + 20 * MS)
    assert not stamps.judge(10 * S + 40 * MS, 13 * S), "it lay in a queue"
    assert not stamps.judge(10 * S + 40 * MS, 10 * S + 60 * MS), "the same again"
    assert not stamps.judge(14 * S, 13 * S), "ahead"
    assert stamps.believed
    assert stamps.judge(15 * S, 15 * S)
    for number in range(5):
        assert stamps.believed
        assert not stamps.judge(1_700_000_000 * S + number, 16 * S + number)
    assert not stamps.believed


# -- settings ------------------------------------------------------------------


def settings(**changed: Any) -> Settings:
    plain: dict[str, Any] = {
        "card": "x", "formats": ("MJPG",), "format": "MJPG", "width_px": 640, "height_px": 480, "fps": 10.0,
        "exposure_ms": 5.0, "exposure_range_ms": (0.1, 33.0), "automatic": False, "gain": 3, "gain_range": (0, 9),
    }  # fmt: skip
    return Settings(**plain | changed)


@pytest.mark.parametrize(
    ("asked", "now", "words"),
    [
        ({}, {}, []),
        ({"exposure_ms": 5.2, "gain": 3.4}, {}, []),
        ({"exposure_ms": 5.0}, {"automatic": True, "exposure_ms": None}, ["exposure automatic 5 ms"]),
        ({"exposure_ms": "auto"}, {"automatic": True, "exposure_ms": None}, []),
        ({"exposure_ms": "auto"}, {}, ["exposure fixed at 5 ms auto"]),
        ({"exposure_ms": 5.0}, {"exposure_range_ms": None, "exposure_ms": None}, ["exposure no control of it 5 ms"]),
        ({"gain": 2.0}, {"gain": None, "gain_range": None}, ["gain no control of it 2"]),
        ({"fps": 30.0}, {"fps": 15.0}, ["rate 15 frames per second 30"]),
        ({"fps": 30.0}, {"fps": None}, []),
    ],
)
def test_differences(asked: dict[str, Any], now: dict[str, Any], words: list[str]) -> None:
    found = differences(CameraOptions(source="device:0", **asked), settings(**now))
    assert [f"{one.what} {one.got} {one.wanted}" for one in found] == words
    assert all(one.remedy for one in found)
