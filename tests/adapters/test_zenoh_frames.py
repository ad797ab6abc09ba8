"""Pictures that another program publishes, over real zenoh sessions on loopback."""

from __future__ import annotations

import json
import socket
import struct
import threading
import time
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import cv2
import numpy as np
import pytest
import zenoh

from ortholoc_edge.adapters.bus import Bus, BusOptions
from ortholoc_edge.adapters.camera import BadFrameError, CameraOptions, EndOfFrames, open_source
from ortholoc_edge.adapters.camera.zenoh_frames import ZenohFrames, unpack
from ortholoc_edge.clock import ManualClock, SystemClock, wall_clock_ns
from ortholoc_edge.errors import CameraError, ConfigError
from ortholoc_edge.pipeline.frame import Frame

MS = 1_000_000
KEY = "field/cam/compressed"
RED = np.zeros((48, 64, 3), np.uint8)
RED[:, :, 0] = 250


def jpeg(image: np.ndarray = RED) -> bytes:
    return cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR))[1].tobytes()


def ros(data: bytes, unix_ns: int, order: str = "<", frame_id: bytes = b"optical\0", form: bytes = b"jpeg\0") -> bytes:
    """As a DDS writes it, padding included."""
    out = (b"\x00\x01" if order == "<" else b"\x00\x00") + b"\x00\x00"
    body = struct.pack(order + "iI", unix_ns // 10**9, unix_ns % 10**9)
    for text in (frame_id, form):
        body += struct.pack(order + "I", len(text)) + text
        body += bytes(-len(body) % 4)
    return out + body + struct.pack(order + "I", len(data)) + data


def bomb() -> bytes:
    """A PNG of a hundred kilobytes and a gigapixel."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    rows = zlib.compress(bytes(32768 * (1 + 32768 // 8)), 9)
    header = struct.pack(">IIBBBBB", 32768, 32768, 1, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", rows) + chunk(b"IEND", b"")


class Camera:
    """The other program, and the source that reads it."""

    def __init__(self) -> None:
        with socket.create_server(("127.0.0.1", 0)) as server:
            endpoint = f"tcp/127.0.0.1:{server.getsockname()[1]}"
        self.bus = Bus(BusOptions(listen=(endpoint,)), takes_pictures=True)
        options = CameraOptions(source=f"zenoh:{KEY}", latency_ms=30.0, exposure_ms=2.0)
        self.source = open_source(options, SystemClock(), self.bus)
        assert isinstance(self.source, ZenohFrames)
        config = zenoh.Config()
        for key, value in {
            "mode": "client", "scouting/multicast/enabled": False, "connect/endpoints": [endpoint],
        }.items():  # fmt: skip
            config.insert_json5(key, json.dumps(value))
        self.session = zenoh.open(config)
        self.publisher = self.session.declare_publisher(KEY, congestion_control=zenoh.CongestionControl.BLOCK)
        wait_for(lambda: self.publisher.matching_status.matching)

    def publish(self, payload: bytes, attachment: Any = None) -> None:
        self.publisher.put(payload, attachment=None if attachment is None else json.dumps(attachment).encode())

    def read(self) -> Frame:
        frame = self.source.read(5.0)
        assert frame is not None, "no frame"
        return frame

    def close(self) -> None:
        self.source.close()
        self.session.close()
        self.bus.close()


def wait_for(condition: Callable[[], bool]) -> None:
    end = time.monotonic() + 10.0
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.005)


@pytest.fixture(scope="module")
def made() -> Iterator[Camera]:
    camera = Camera()
    yield camera
    camera.close()


@pytest.fixture
def camera(made: Camera) -> Camera:
    assert made.source.read(0.0) is None
    return made


def test_pictures_with_the_stamp_of_this_computer(camera: Camera) -> None:
    stamp_ns = time.monotonic_ns() - 80 * MS
    camera.publish(jpeg(), {"stamp_ns": stamp_ns, "exposure_ns": 3 * MS, "name": "IMG_1"})
    frame = camera.read()
    assert (frame.stamp_ns, frame.exposure_ns, frame.name) == (stamp_ns, 3 * MS, "IMG_1")
    # Red stays red.
    assert np.abs(frame.image.astype(int) - RED).max() < 12
    assert not frame.image.flags.writeable


@pytest.mark.parametrize("order", ["<", ">"])
def test_compressed_images_of_ros(camera: Camera, order: str) -> None:
    exposed_ns = time.monotonic_ns() - 60 * MS
    camera.publish(ros(jpeg(), exposed_ns + wall_clock_ns() - time.monotonic_ns(), order))
    frame = camera.read()
    assert abs(frame.stamp_ns - exposed_ns) < 5 * MS
    assert (frame.image.shape, frame.exposure_ns) == (RED.shape, 2 * MS)


@pytest.mark.parametrize(
    "attachment",
    [
        None, b'{"other": 1}', b'{"stamp_ns": "now"}', b'{"stamp_ns": -1}', b"\xff\x00", b"[" * 200_000,
        b'{"stamp_ns": 1' + b"0" * 400 + b"}", b'{"exposure_ns": 1' + b"0" * 30 + b"}",
        b'{"name": "' + b"n" * 200 + b'"}',
    ],
    ids=["none", "other", "text", "negative", "garbage", "deep", "huge", "long exposure", "long name"],
)  # fmt: skip
def test_without_a_time_arrival_counts_less_the_latency(camera: Camera, attachment: bytes | None) -> None:
    """Whatever somebody writes there, it ends nothing, and gets into no log."""
    begun_ns = time.monotonic_ns()
    camera.publisher.put(jpeg(), attachment=attachment)
    frame = camera.read()
    assert begun_ns <= frame.stamp_ns + 30 * MS <= time.monotonic_ns()
    assert frame.exposure_ns == 2 * MS and len(frame.name) < 10


@contextmanager
def source_at(now_ns: int, **options: Any) -> Iterator[tuple[ZenohFrames, ManualClock]]:
    clock = ManualClock(now_ns)
    bus = Bus(BusOptions(listen=()), takes_pictures=True)
    settings = CameraOptions(source=f"zenoh:{KEY}", **options)
    source = ZenohFrames(bus, KEY, settings, clock, lambda: clock.now_ns() + 10**18)
    try:
        yield source, clock
    finally:
        source.close()
        bus.close()


def taken(source: ZenohFrames, attachment: dict[str, int]) -> int | None:
    """The stamp that it gets; None where it is refused."""
    source._arrived(jpeg(), json.dumps(attachment).encode())
    try:
        frame = source.read(0.0)
    except BadFrameError:
        return None
    assert frame is not None
    return frame.stamp_ns


def test_times_that_can_not_be_are_refused_and_soon_not_believed(caplog: pytest.LogCaptureFixture) -> None:
    with source_at(10**10, latency_ms=30.0, driver_latency_ms=7.0) as (source, clock):
        assert taken(source, {"stamp_ns": 10**10 - 20 * MS}) == 10**10 - 27 * MS
        # By the date; then the same again, from a second ahead, and from long ago.
        assert taken(source, {"unix_ns": 10**18 + 10**10 - 10 * MS}) == 10**10 - 17 * MS
        assert taken(source, {"stamp_ns": 10**10 - 10 * MS}) is None
        for stamp_ns in (10**10 + 10**9, 10**10 + 2 * 10**9, 5):
            assert taken(source, {"stamp_ns": stamp_ns}) is None
        assert source.counts()["disordered"] == 4
        # A mixture of both would be worse than either.
        clock.set_ns(10**10 + 10**9)
        assert taken(source, {"stamp_ns": 6}) == clock.now_ns() - 30 * MS
        assert taken(source, {"stamp_ns": clock.now_ns() - MS}) == clock.now_ns() - 30 * MS
    assert caplog.text.count("not of our clock") == 1


def test_the_date_counts_as_it_was_when_the_picture_came() -> None:
    with source_at(10**10) as (source, _):
        source._arrived(jpeg(), json.dumps({"unix_ns": 10**18 + 10**10 - 10 * MS}).encode())
        source._wall_ns = lambda: 5
        frame = source.read(0.0)
        assert frame is not None and frame.stamp_ns == 10**10 - 10 * MS


def test_stamps_need_not_be_believed() -> None:
    with source_at(10**10, latency_ms=30.0, stamps="arrival") as (source, _):
        assert taken(source, {"stamp_ns": 10**10}) == 10**10 - 30 * MS


def test_silence_is_told_once_each_time(caplog: pytest.LogCaptureFixture) -> None:
    with source_at(10**10) as (source, clock):
        for seconds in (2, 4, 6):
            clock.set_ns(10**10 + seconds * 10**9)
            assert source.read(0.0) is None
        assert caplog.text.count("no picture") == 1 and KEY in caplog.text
        assert taken(source, {}) is not None
        clock.set_ns(10**10 + 10 * 10**9)
        assert source.read(0.0) is None
    assert caplog.text.count("no picture") == 2


def test_the_newest_wins(camera: Camera) -> None:
    before, begun_ns = camera.source.overwritten, time.monotonic_ns()
    for number in range(3):
        camera.publish(jpeg(), {"stamp_ns": begun_ns + number, "name": str(number)})
    wait_for(lambda: camera.source.overwritten == before + 2)
    assert camera.read().name == "2"
    assert camera.source.read(0.0) is None


@pytest.mark.parametrize(
    "payload",
    [
        b"", b"hello", jpeg()[:-40], ros(jpeg()[:-40], 0), ros(jpeg(), 0)[:-10], b"\x00\x01\x00\x00\x00",
        cv2.imencode(".tiff", RED)[1].tobytes(), bomb(),
    ],
    ids=["nothing", "text", "cut", "ros cut", "ros shorter", "ros begun", "tiff", "bomb"],
)  # fmt: skip
def test_what_is_no_picture_is_one_bad_frame(camera: Camera, payload: bytes) -> None:
    begun_ns = time.monotonic_ns()
    camera.publish(payload)
    with pytest.raises(BadFrameError, match="the program that publishes it") as caught:
        camera.read()
    assert begun_ns - 30 * MS <= caught.value.stamp_ns <= time.monotonic_ns()
    camera.publish(jpeg(), {"name": "next"})
    assert camera.read().name == "next"


def test_a_picture_of_many_megabytes(camera: Camera) -> None:
    """Twelve megapixels as a camera with little compression gives them; on a bus without a camera that is cut off."""
    noise = np.random.default_rng(1).integers(0, 256, (1500, 1500, 3), np.uint8)
    payload = cv2.imencode(".png", noise)[1].tobytes()
    assert len(payload) > 4 << 20
    camera.publish(payload)
    assert np.array_equal(camera.read().image[:, :, ::-1], noise)


def test_a_text_that_claims_gigabytes_is_refused() -> None:
    hostile = b"\x00\x01\x00\x00" + struct.pack("<iII", 1, 1, 0xFFFFFFF0) + b"x" * 64
    with pytest.raises(CameraError, match="CompressedImage"):
        unpack(hostile)


def test_needs_the_bus_and_a_key() -> None:
    with pytest.raises(ConfigError, match=r"\[bus\] enabled = true"):
        open_source(CameraOptions(source="zenoh:a/b"), SystemClock())
    bus = Bus(BusOptions(listen=()), takes_pictures=True)
    try:
        with pytest.raises(ConfigError, match="a//b"):
            open_source(CameraOptions(source="zenoh:a//b"), SystemClock(), bus)
    finally:
        bus.close()


def test_closing_ends_a_read() -> None:
    bus = Bus(BusOptions(listen=()), takes_pictures=True)
    source = ZenohFrames(bus, KEY, CameraOptions(source=f"zenoh:{KEY}"), SystemClock())
    thread = threading.Timer(0.05, source.close)
    thread.start()
    with pytest.raises(EndOfFrames):
        source.read(10.0)
    thread.join()
    bus.close()
    source.close()
