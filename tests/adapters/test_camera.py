"""Sources of frames, with real files, a real video and a real network stream."""

from __future__ import annotations

import http.server
import threading
import time
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from ortholoc_edge.adapters.camera import (
    BadFrameError,
    CameraOptions,
    DeviceSource,
    EndOfFrames,
    FolderSource,
    VideoSource,
    open_source,
    read_image,
)
from ortholoc_edge.adapters.camera.live import Late
from ortholoc_edge.adapters.camera.pictures import rgb
from ortholoc_edge.clock import ManualClock, SystemClock
from ortholoc_edge.errors import CameraError, ConfigError

MS = 1_000_000


def picture(shade: int = 0, width: int = 64, height: int = 48) -> np.ndarray:
    """RGB with a red left half, so that swapped channels show."""
    image = np.full((height, width, 3), shade, np.uint8)
    image[:, : width // 2, 0] = 250
    image[::5] //= 2
    return image


def encoded(suffix: str, image: np.ndarray | None = None) -> bytes:
    image = picture() if image is None else image
    ok, data = cv2.imencode(suffix, cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
    assert ok
    return data.tobytes()


# -- read_image ----------------------------------------------------------------


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".webp", ".tiff", ".bmp"])
def test_reads_rgb(tmp_path, suffix):
    path = tmp_path / f"a{suffix}"
    path.write_bytes(encoded(suffix))
    image = read_image(path)
    assert image.shape == (48, 64, 3) and image.dtype == np.uint8 and not image.flags.writeable
    np.testing.assert_allclose(image[20:40, 2:28].mean((0, 1))[0], picture()[20:40, 2:28].mean((0, 1))[0], atol=6)
    assert image[..., 0].mean() > 50 > image[..., 2].mean()


def test_grey_and_16_bit_become_rgb8(tmp_path):
    for name, array in (
        ("g.png", np.full((8, 9), 77, np.uint8)),
        ("d.png", np.full((8, 9), 77 * 257, np.uint16)),
    ):
        cv2.imwrite(str(tmp_path / name), array)
        assert (read_image(tmp_path / name) == 77).all()
        assert read_image(tmp_path / name).shape == (8, 9, 3)


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".webp"])
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=60, deadline=None)
@given(part=st.floats(0.0, 0.999))
def test_every_truncation_is_refused(tmp_path, suffix, part):
    data = encoded(suffix)
    path = tmp_path / f"cut{suffix}"
    path.write_bytes(data[: int(part * len(data))])
    with pytest.raises(CameraError, match=f"cut{suffix}.*copy it again"):
        read_image(path)


def test_progressive_jpeg_with_thumbnail_and_tail(tmp_path):
    """The walk survives several scans, an end marker inside a segment and bytes after the end."""
    ok, data = cv2.imencode(".jpg", picture(), [cv2.IMWRITE_JPEG_PROGRESSIVE, 1, cv2.IMWRITE_JPEG_RST_INTERVAL, 2])
    assert ok
    jpeg = data.tobytes()
    thumbnail = b"\xff\xe1" + (2 + 40).to_bytes(2, "big") + (b"\xff\xd8thumb\xff\xd9".ljust(40, b"x"))
    whole = jpeg[:2] + thumbnail + jpeg[2:]
    (tmp_path / "whole.jpg").write_bytes(whole + b"trailer of the camera maker")
    assert read_image(tmp_path / "whole.jpg").shape == (48, 64, 3)
    (tmp_path / "cut.jpg").write_bytes(whole[:-20])
    with pytest.raises(CameraError, match="truncated"):
        read_image(tmp_path / "cut.jpg")


def test_bytes_between_segments_are_damage(tmp_path):
    jpeg = encoded(".jpg")
    (tmp_path / "shifted.jpg").write_bytes(jpeg[:2] + b"junk" + jpeg[2:])
    with pytest.raises(CameraError, match="no segment begins at byte 2"):
        read_image(tmp_path / "shifted.jpg")


def test_zeroed_tail_and_flipped_bit(tmp_path):
    jpeg = encoded(".jpg", np.random.default_rng(0).integers(0, 255, (64, 64, 3), dtype=np.uint8))
    (tmp_path / "power_cut.jpg").write_bytes(jpeg[: len(jpeg) // 2].ljust(len(jpeg), b"\0"))
    with pytest.raises(CameraError, match="truncated"):
        read_image(tmp_path / "power_cut.jpg")
    png = bytearray(encoded(".png"))
    png[len(png) // 2] ^= 1
    (tmp_path / "bit.png").write_bytes(png)
    with pytest.raises(CameraError, match="checksum"):
        read_image(tmp_path / "bit.png")


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=150, deadline=None)
@given(
    data=st.binary(max_size=200),
    head=st.sampled_from([b"", b"\xff\xd8", b"\x89PNG\r\n\x1a\n", b"RIFF", b"II*\0"]),
)
def test_hostile_bytes_end_in_camera_error(tmp_path, data, head):
    path = tmp_path / "hostile.jpg"
    path.write_bytes(head + data)
    with pytest.raises(CameraError, match=r"hostile\.jpg"):
        read_image(path)


def test_missing_file_is_named(tmp_path):
    with pytest.raises(CameraError, match=r"nowhere\.png can't be read"):
        read_image(tmp_path / "nowhere.png")


# -- folder --------------------------------------------------------------------


@pytest.fixture
def folder(tmp_path) -> Path:
    for i in range(4):
        (tmp_path / f"{i:03}.png").write_bytes(encoded(".png", picture(10 * i)))
    (tmp_path / "notes.txt").write_text("no picture")
    return tmp_path


def test_folder_is_paced_by_the_clock(folder):
    clock = ManualClock(1000)
    source = FolderSource(folder, 10.0, clock)
    first = source.read(0.0)
    assert (first.stamp_ns, first.name) == (1000, "000.png")
    assert source.read(0.0) is None
    clock.set_ns(1000 + 100 * MS)
    assert source.read(0.0).stamp_ns == 1000 + 100 * MS
    # A reader that comes late gets the next one all the same, stamped now.
    clock.set_ns(1000 + 950 * MS)
    late = source.read(0.0)
    assert (late.name, late.stamp_ns) == ("002.png", 1000 + 950 * MS)
    assert source.read(0.0) is None
    clock.set_ns(1000 + 1050 * MS)
    assert source.read(0.0).name == "003.png"
    with pytest.raises(EndOfFrames):
        source.read(0.0)
    source.close()


def test_bad_picture_is_reported_and_passed(folder):
    data = (folder / "001.png").read_bytes()
    (folder / "001.png").write_bytes(data[:-30])
    clock = ManualClock()
    source = FolderSource(folder, 10.0, clock)
    names = []
    with pytest.raises(EndOfFrames):
        while True:
            try:
                names.append(source.read(0.0).name)
            except BadFrameError as error:
                assert error.name == "001.png" and error.stamp_ns == clock.now_ns()
                assert "001.png" in str(error)
                names.append("bad")
            clock.set_ns(clock.now_ns() + 100 * MS)
    assert names == ["000.png", "bad", "002.png", "003.png"]
    assert source.bad_frames == 1


def test_folder_without_pictures_is_refused(tmp_path):
    with pytest.raises(CameraError, match="holds no picture"):
        FolderSource(tmp_path, 10.0, ManualClock())
    with pytest.raises(CameraError, match="can't be read"):
        FolderSource(tmp_path / "missing", 10.0, ManualClock())


def test_read_waits_in_real_time_for_the_system_clock(folder):
    source = FolderSource(folder, 50.0, SystemClock())
    stamps = [source.read(1.0).stamp_ns for _ in range(4)]
    assert (np.diff(stamps) >= 20 * MS).all()


# -- video ---------------------------------------------------------------------


@pytest.fixture(scope="module")
def video(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("video") / "flight.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 10.0, (64, 48))
    for i in range(8):
        writer.write(cv2.cvtColor(picture(20 * i), cv2.COLOR_RGB2BGR))
    writer.release()
    return path


def test_video_stamps_follow_its_own_clock(video):
    clock = ManualClock(5000)
    source = VideoSource(video, clock)
    first = source.read(0.0)
    assert first.stamp_ns == 5000 and first.name == "flight.avi#0"
    assert first.image.shape == (48, 64, 3) and not first.image.flags.writeable
    assert first.image[2, 5, 0] > 200 and first.image[2, 5, 2] < 60
    assert source.read(0.0) is None
    clock.set_ns(5000 + 100 * MS)
    assert source.read(0.0).stamp_ns == pytest.approx(5000 + 100 * MS, abs=1000)
    # 350 ms: numbers 2 and 3 are due, the camera would deliver 3.
    clock.set_ns(5000 + 350 * MS)
    third = source.read(0.0)
    assert third.name == "flight.avi#3" and source.skipped == 1
    assert third.stamp_ns == pytest.approx(5000 + 300 * MS, abs=1000)
    # Far beyond the end there is still the last frame, then the end.
    clock.set_ns(5000 + 60_000 * MS)
    assert source.read(0.0).name == "flight.avi#7"
    with pytest.raises(EndOfFrames):
        source.read(0.0)
    source.close()
    with pytest.raises(EndOfFrames):
        source.read(0.0)


def test_video_in_full_for_replay(video):
    source = VideoSource(video, ManualClock(), realtime=False)
    frames = [source.read(0.0) for _ in range(8)]
    np.testing.assert_allclose([f.stamp_ns / MS for f in frames], np.arange(8) * 100.0, atol=0.01)
    assert [f.image[1, 60, 2] // 10 for f in frames] == sorted(f.image[1, 60, 2] // 10 for f in frames)
    with pytest.raises(EndOfFrames):
        source.read(0.0)


def test_unusable_videos_are_refused(tmp_path, video):
    with pytest.raises(CameraError, match="does not exist"):
        VideoSource(tmp_path / "missing.mp4", ManualClock())
    (tmp_path / "broken.avi").write_bytes(b"not a video" * 100)
    with pytest.raises(CameraError, match="can't be opened"):
        VideoSource(tmp_path / "broken.avi", ManualClock())


def test_truncated_video_ends_early_with_a_warning(tmp_path, video, caplog):
    data = video.read_bytes()
    (tmp_path / "cut.avi").write_bytes(data[: len(data) * 2 // 3])
    source = VideoSource(tmp_path / "cut.avi", ManualClock(), realtime=False)
    count = 0
    with pytest.raises(EndOfFrames):
        while True:
            try:
                source.read(0.0)
            except BadFrameError:
                continue
            count += 1
    assert 2 <= count < 8


# -- live ----------------------------------------------------------------------


class MjpegCamera:
    """A network camera: MJPEG over HTTP, as the cheap ones do it."""

    def __init__(self, port: int = 0, frames_per_connection: int = 10**9) -> None:
        camera = self

        class Handler(http.server.BaseHTTPRequestHandler):
            def do_GET(self):
                self.send_response(200)
                self.send_header("Content-Type", "multipart/x-mixed-replace; boundary=frame")
                self.end_headers()
                for _ in range(frames_per_connection):
                    if camera.stop.wait(0.02):
                        return
                    camera.sent += 1
                    data = encoded(".jpg", picture(camera.sent % 200))
                    head = f"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: {len(data)}\r\n\r\n"
                    try:
                        self.wfile.write(head.encode() + data + b"\r\n")
                    except OSError:
                        return

            def log_message(self, *args):
                pass

        self.sent = 0
        self.stop = threading.Event()
        self.server = http.server.ThreadingHTTPServer(("127.0.0.1", port), Handler)
        self.server.daemon_threads = True
        self.port = self.server.server_port
        self.thread = threading.Thread(target=self.server.serve_forever, kwargs={"poll_interval": 0.05})
        self.thread.start()

    def close(self):
        self.stop.set()
        self.server.shutdown()
        self.server.server_close()
        self.thread.join()


def read_until(source: DeviceSource, condition, seconds: float = 10.0):
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        frame = source.read(0.2)
        if frame is not None and condition(frame):
            return frame
    raise AssertionError("no such frame in time")


def test_network_camera_latest_frame_and_reconnect():
    camera = MjpegCamera()
    options = CameraOptions(source=f"http://127.0.0.1:{camera.port}/stream.mjpg", latency_ms=30.0)
    clock = SystemClock()
    source = open_source(options, clock)
    assert isinstance(source, DeviceSource)
    try:
        frame = read_until(source, lambda f: True)
        assert frame.image.shape == (48, 64, 3) and frame.image[2, 5, 0] > 200
        assert clock.now_ns() - frame.stamp_ns >= 30 * MS
        # Frames that nobody reads are replaced, not queued.
        deadline = time.monotonic() + 5.0
        while source.overwritten < 5 and time.monotonic() < deadline:
            time.sleep(0.02)
        assert source.overwritten >= 5
        newest = source.read(0.5)
        assert int(newest.name) > int(frame.name) + 3
        port = camera.port
        camera.close()
        last = newest.stamp_ns
        camera = MjpegCamera(port)
        read_until(source, lambda f: f.stamp_ns > last + 300 * MS)
        assert source.reconnects >= 1
    finally:
        source.close()
        camera.close()
    with pytest.raises(EndOfFrames):
        source.read(0.1)


def test_missing_device_is_waited_for(tmp_path, caplog):
    source = open_source(CameraOptions(source=f"device:{tmp_path}/video0"), SystemClock())
    try:
        assert source.read(0.1) is None
        deadline = time.monotonic() + 5.0
        while source.reconnects < 2 and time.monotonic() < deadline:
            time.sleep(0.02)
    finally:
        source.close()
    assert sum("can't be opened" in r.message for r in caplog.records) == 1


class Stuck:
    """A camera whose driver keeps the thread in one of its calls."""

    def __init__(self, where: str) -> None:
        self.where, self.entered, self.freed = where, threading.Event(), threading.Event()

    def open(self):
        self._pass("open")
        return self

    def grab(self):
        self._pass("grab")

    def release(self):
        self._pass("release")

    def _pass(self, where):
        if where == self.where:
            self.entered.set()
            self.freed.wait(10.0)


@pytest.mark.parametrize("where", ["open", "grab", "release"])
def test_a_driver_that_never_comes_back_is_an_error(where):
    """The thread can't be ended from outside, and waiting on would fly blind for good."""
    clock, camera = ManualClock(), Stuck(where)
    source = DeviceSource("stuck", camera.open, clock)
    try:
        assert camera.entered.wait(10.0)
        clock.set_ns(15_000 * MS)
        assert source.read(0.0) is None
        clock.set_ns(25_000 * MS)
        with pytest.raises(CameraError, match="camera stuck: its driver has not come back for 25 s; start"):
            source.read(0.0)
    finally:
        camera.freed.set()
        source.close()


class Behind:
    """A stream whose queue does not run dry: every frame comes 0.1 s after the one before, and late."""

    def __init__(self, clock: ManualClock) -> None:
        self.clock, self.released = clock, threading.Event()
        self.grabbed = 0

    def grab(self):
        self.grabbed += 1
        self.clock.set_ns(self.clock.now_ns() + 100 * MS)
        return Late(0 if self.grabbed < 4 else 700 * MS)

    def release(self):
        self.released.set()


def test_a_stream_that_stays_late_is_opened_again(caplog):
    clock = ManualClock(10**9)
    camera = Behind(clock)
    source = DeviceSource("far", lambda: None if camera.released.is_set() else camera, clock)
    try:
        deadline = time.monotonic() + 10.0
        while not source.reconnects and time.monotonic() < deadline:
            time.sleep(0.01)
        assert camera.released.is_set() and source.read(0.0) is None
    finally:
        source.close()
    assert 15 <= camera.grabbed <= 30 and source.counts()["left_out"] == camera.grabbed
    assert caplog.text.count("a frame comes 700 ms later than others") == 1
    assert "camera far late by 700 ms all the time; trying again" in caplog.text


# -- options -------------------------------------------------------------------


def test_options_choose_the_source(folder, video):
    clock = ManualClock()
    assert isinstance(open_source(CameraOptions(source=f"folder:{folder}"), clock), FolderSource)
    assert isinstance(open_source(CameraOptions(source=f"video:{video}"), clock), VideoSource)


def test_a_source_in_its_parts():
    stream = CameraOptions(source="rtsp://10.0.0.2:554/live", exposure_ms=4)
    assert (stream.kind, stream.place, stream.is_live) == ("rtsp", "//10.0.0.2:554/live", True)
    assert stream.fixed_exposure_ns == 4 * MS, "also where it is an integer"
    assert CameraOptions(source="device:0", exposure_ms="auto").fixed_exposure_ns is None
    assert not CameraOptions(source="video:a.mp4").is_live


@pytest.mark.parametrize("text", ["", "folder:", "webcam", "rtsp:host", "ftp://host/a.mjpg", "/dev/video0"])
def test_unknown_source_is_a_config_error(text):
    with pytest.raises(ConfigError, match="can't be used; write folder:PATH"):
        open_source(CameraOptions(source=text), ManualClock())


@pytest.mark.parametrize(
    "document",
    [
        {"source": "device:0", "rate": 3},
        {"source": "device:0", "rate_hz": 0},
        {"source": "device:0", "width_px": 3},
    ],
)
def test_options_are_strict(document):
    with pytest.raises(msgspec.ValidationError):
        msgspec.convert(document, CameraOptions)


def test_pixels_that_are_not_8_bit_are_refused_by_name():
    with pytest.raises(CameraError, match=r"camera x gives uint16"):
        rgb(np.full((4, 4, 3), 300, np.uint16), "camera x")
    with pytest.raises(CameraError, match=r"camera x gives uint16"):
        rgb(np.full((4, 4), 300, np.uint16), "camera x")
    grey = rgb(np.full((4, 4), 30, np.uint8), "camera x")
    assert grey.shape == (4, 4, 3) and (grey == 30).all() and not grey.flags.writeable
