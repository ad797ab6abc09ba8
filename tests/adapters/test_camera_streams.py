"""RTSP from a server on loopback, through OpenCV's real FFmpeg."""

from __future__ import annotations

import logging
import os
import socket
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import msgspec
import numpy as np
import pytest

from adapters.rtsp_server import RtspCamera
from ortholoc_edge.adapters.camera import CameraOptions, DeviceSource, open_source, prepare, stream
from ortholoc_edge.adapters.secret import without_credentials
from ortholoc_edge.clock import SystemClock
from ortholoc_edge.config import read_config, without_secrets
from ortholoc_edge.pipeline.frame import Frame

MS = 1_000_000
BLOCK = 8
CONFIG = Path(__file__).resolve().parents[2] / "config" / "simulation.toml"
LOGIN = ("pilot", "hunter2")


def numbered(number: int) -> np.ndarray:
    """BGR, its left half red, with its number as a row of white and black blocks below."""
    image = np.full((96, 128, 3), 60, np.uint8)
    image[:, :64] = (40, 40, 230)
    for bit in range(128 // BLOCK):
        image[-2 * BLOCK :, bit * BLOCK : (bit + 1) * BLOCK] = 255 * (number >> bit & 1)
    return image


def number_of(frame: Frame) -> int:
    row = frame.image[-BLOCK, BLOCK // 2 :: BLOCK, 1] > 128
    return int(sum(1 << bit for bit, white in enumerate(row) if white))


@pytest.fixture
def opened(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., DeviceSource]]:
    """Opens sources, and closes them."""
    sources: list[DeviceSource] = []
    # Put back after the test: FFmpeg reads files by it, too.
    monkeypatch.setenv("OPENCV_FFMPEG_CAPTURE_OPTIONS", "")
    monkeypatch.delenv("OPENCV_FFMPEG_CAPTURE_OPTIONS")

    def make(address: str, **given: float) -> DeviceSource:
        options = CameraOptions(source=address, **given)
        prepare(options)
        source = open_source(options, SystemClock())
        assert isinstance(source, DeviceSource)
        sources.append(source)
        return source

    yield make
    for source in sources:
        source.close()


@pytest.fixture
def camera() -> Iterator[RtspCamera]:
    server = RtspCamera(numbered, login=LOGIN)
    yield server
    server.close()


def frame_from(source: DeviceSource, wanted: Callable[[Frame], bool] = lambda _: True) -> Frame:
    end = time.monotonic() + 15.0
    while time.monotonic() < end:
        frame = source.read(0.3)
        if frame is not None and wanted(frame):
            return frame
    raise AssertionError("no such frame in time")


def test_rtsp_gives_the_newest_frame_and_comes_back(
    camera: RtspCamera, opened: Callable[..., DeviceSource], caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.DEBUG)
    source = opened(f"rtsp://pilot:hunter2@127.0.0.1:{camera.port}/live", latency_ms=30.0, exposure_ms=4.0)
    first = frame_from(source)
    assert first.image.shape == (96, 128, 3) and not first.image.flags.writeable
    assert first.image[10, 10, 0] > 140 > first.image[10, 10, 2], "red, so RGB"
    assert SystemClock().now_ns() - first.stamp_ns >= 30 * MS
    assert first.exposure_ns == 4 * MS, "as it was set there"
    # While nobody reads frames are replaced, and what is read then is the newest of them.
    before = source.overwritten
    while source.overwritten < before + 5:
        time.sleep(0.02)
    assert number_of(frame_from(source)) >= number_of(first) + 5
    port = camera.port
    camera.close()
    back = RtspCamera(numbered, port, login=LOGIN)
    try:
        # It counts from the start.
        frame_from(source, lambda frame: number_of(frame) < number_of(first) + 5)
        assert source.reconnects >= 1
    finally:
        back.close()
    assert "lost; trying again" in caplog.text
    assert "hunter2" not in caplog.text and "rtsp://(left out)@127.0.0.1" in caplog.text


def test_a_camera_that_goes_silent_is_opened_again(
    camera: RtspCamera, opened: Callable[..., DeviceSource], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stream, "_READ_TIMEOUT_MS", 200)
    source = opened(f"rtsp://pilot:hunter2@127.0.0.1:{camera.port}/live")
    frame_from(source)
    camera.silent.set()
    end = time.monotonic() + 15.0
    while not source.reconnects and time.monotonic() < end:
        time.sleep(0.02)
    assert source.reconnects
    camera.silent.clear()
    frame_from(source)


def test_what_a_stall_kept_back_is_not_stamped_as_new(
    camera: RtspCamera, opened: Callable[..., DeviceSource], caplog: pytest.LogCaptureFixture
) -> None:
    """The backlog comes within some ten ms, each frame of it up to 2 s after it was taken."""
    source = opened(f"rtsp://pilot:hunter2@127.0.0.1:{camera.port}/live")
    frame_from(source)
    camera.held.set()
    time.sleep(2.0)
    before = camera.sent
    camera.held.clear()
    number, ages_ms = 0, []
    while number < before + 10:
        frame = frame_from(source)
        number = number_of(frame)
        ages_ms.append((frame.stamp_ns - camera.taken_ns[number]) / MS)
    assert max(ages_ms) < 150.0 and not source.reconnects
    assert source.counts()["left_out"] > 40
    assert caplog.text.count("later than others; such frames are left out") == 1


def test_a_wrong_password_and_who_never_answers(
    camera: RtspCamera,
    opened: Callable[..., DeviceSource],
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    capfd: pytest.CaptureFixture[str],
) -> None:
    """Both are waited for; neither what we log nor what FFmpeg prints tells the password."""
    monkeypatch.setattr(stream, "_OPEN_TIMEOUT_MS", 400)
    with socket.create_server(("127.0.0.1", 0)) as mute:
        addresses = [
            f"rtsp://pilot:wr0ng@127.0.0.1:{camera.port}/live?token=s3cret",
            f"rtsp://pilot:wr0ng@127.0.0.1:{mute.getsockname()[1]}/live?token=s3cret",
            f"http://pilot:wr0ng@127.0.0.1:{camera.port}/live?token=s3cret",
        ]
        sources = [opened(address) for address in addresses]
        end = time.monotonic() + 15.0
        while not all(source.reconnects for source in sources) and time.monotonic() < end:
            time.sleep(0.02)
        assert all(source.reconnects for source in sources)
        assert all(source.read(0.0) is None for source in sources)
    assert camera.refused > 0
    told = capfd.readouterr()
    for words in (caplog.text, told.err, told.out):
        assert "wr0ng" not in words and "s3cret" not in words
    assert caplog.text.count("can't be opened; trying again") == 3


def test_what_the_user_told_ffmpeg_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    live = CameraOptions(source="rtsp://10.0.0.2/live")
    monkeypatch.setenv("OPENCV_FFMPEG_CAPTURE_OPTIONS", "rtsp_transport;udp")
    prepare(live)
    assert os.environ["OPENCV_FFMPEG_CAPTURE_OPTIONS"] == "rtsp_transport;udp"
    monkeypatch.delenv("OPENCV_FFMPEG_CAPTURE_OPTIONS")
    prepare(CameraOptions(source="video:flight.mp4"))
    assert "OPENCV_FFMPEG_CAPTURE_OPTIONS" not in os.environ, "a file's first frames would be lost"
    prepare(live)
    assert "nobuffer" in os.environ["OPENCV_FFMPEG_CAPTURE_OPTIONS"]
    assert "rtsp_transport;tcp" in os.environ["OPENCV_FFMPEG_CAPTURE_OPTIONS"]


@pytest.mark.parametrize(
    ("address", "shown"),
    [
        ("rtsp://host/live", "rtsp://host/live"),
        ("rtsp://a:b@host:554/live", "rtsp://(left out)@host:554/live"),
        ("rtsp://a:b@c@host/live", "rtsp://(left out)@host/live"),
        ("http://host/cam?usr=a&pwd=b", "http://host/cam?(left out)"),
        (
            'gstreamer:souphttpsrc location="http://a:b@host/cam?usr=a&pwd=b" user-pw=\'b c\' ! appsink',
            'gstreamer:souphttpsrc location="http://(left out)@host/cam?(left out)" user-pw=(left out) ! appsink',
        ),
    ],
)
def test_addresses_are_shown_without_credentials(address: str, shown: str) -> None:
    assert without_credentials(address) == shown


@pytest.mark.parametrize(
    ("source", "shown"),
    [
        ("rtsp://pilot:hun@ter2@10.0.0.2/live", "rtsp://(left out)@10.0.0.2/live"),
        ("http://10.0.0.2/mjpg?user=admin&pwd=hunter2", "http://10.0.0.2/mjpg?(left out)"),
    ],
)
def test_what_the_bus_and_logs_tell_of_the_configuration_has_no_password(source: str, shown: str) -> None:
    config = read_config(CONFIG)
    camera = msgspec.structs.replace(config.camera, source=source)
    told = without_secrets(msgspec.structs.replace(config, camera=camera))
    assert told["camera"]["source"] == shown
