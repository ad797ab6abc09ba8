"""GStreamer pipelines: what is made of their text, and frames through the system's bindings where it has them."""

from __future__ import annotations

import importlib.util
import logging
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ortholoc_edge.adapters.camera import CameraOptions, DeviceSource, open_source
from ortholoc_edge.adapters.camera.gstreamer import low_latency
from ortholoc_edge.clock import ManualClock, SystemClock
from ortholoc_edge.errors import CameraError, ConfigError
from ortholoc_edge.pipeline.frame import Frame

# The bindings' importer is of an older kind.
pytestmark = pytest.mark.filterwarnings("ignore:DynamicImporter:ImportWarning")

MS = 1_000_000
_RGB = "! videoconvert ! video/x-raw,format=(string){RGB,GRAY8}"
# Where Debian and its children keep what comes with the system.
_OF_THE_SYSTEM = Path("/usr/lib/python3/dist-packages")


@pytest.mark.parametrize(
    ("pipeline", "made"),
    [
        ("a ! appsink", f"a {_RGB} ! appsink drop=true max-buffers=1 sync=false"),
        ("a ! b ! appsink name=x sync=true", f"a ! b {_RGB} ! appsink name=x sync=true drop=true max-buffers=1"),
        ("a ! appsink drop=1 max-buffers=2 sync=false", f"a {_RGB} ! appsink drop=1 max-buffers=2 sync=false"),
    ],
)
def test_an_appsink_that_does_not_queue(pipeline: str, made: str) -> None:
    assert low_latency(pipeline) == made


@pytest.mark.parametrize(
    ("pipeline", "words"),
    [
        ("videotestsrc", "ends in 'videotestsrc'; it must end in"),
        ("rtspsrc user-id=pilot user-pw=hunter2", r"ends in 'rtspsrc user-id=\(left out\) user-pw=\(left out\)'"),
        ("videotestsrc ! fakesink", "ends in 'fakesink'"),
        ("videotestsrc !", "ends in 'nothing'"),
        ("! appsink", "ends in 'appsink'"),
        ("videotestsrc ! appsink drop=false", "drop=false, and frames that queue are late"),
        ("videotestsrc ! appsink max-buffers=30", "max-buffers=30"),
    ],
)
def test_pipelines_that_queue_or_end_elsewhere_are_refused(pipeline: str, words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        open_source(CameraOptions(source=f"gstreamer:{pipeline}"), ManualClock())


def test_without_the_bindings_it_is_said_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "gi", None)
    with pytest.raises(CameraError, match=r"sudo apt install python3-gi.*--system-site-packages"):
        open_source(CameraOptions(source="gstreamer:videotestsrc ! appsink"), ManualClock())


# -- real pipelines ------------------------------------------------------------


@pytest.fixture(scope="module")
def bindings(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """The system's, of which this environment sees nothing else: its numpy is another."""
    if importlib.util.find_spec("gi") is None:
        if not (_OF_THE_SYSTEM / "gi").is_dir():
            pytest.skip("GStreamer's Python bindings are not on this computer (python3-gi)")
        folder = tmp_path_factory.mktemp("system")
        (folder / "gi").symlink_to(_OF_THE_SYSTEM / "gi")
        sys.path.append(str(folder))
    try:
        from ortholoc_edge.adapters.camera.gstreamer import load

        gst: Any = load()
    except CameraError as error:
        pytest.skip(f"GStreamer's Python bindings can't be loaded here: {error}")
    for element in ("videotestsrc", "videoconvert", "appsink"):
        if gst.ElementFactory.find(element) is None:
            pytest.skip(f"GStreamer has no {element} here (gstreamer1.0-plugins-base)")
    yield


@pytest.fixture
def opened(bindings: None) -> Iterator[Callable[..., DeviceSource]]:
    sources: list[DeviceSource] = []

    def make(pipeline: str, **options: Any) -> DeviceSource:
        source = open_source(CameraOptions(source=f"gstreamer:{pipeline}", **options), SystemClock())
        assert isinstance(source, DeviceSource)
        sources.append(source)
        return source

    yield make
    for source in sources:
        source.close()


def frame_from(source: DeviceSource) -> Frame:
    end = time.monotonic() + 15.0
    while time.monotonic() < end:
        frame = source.read(0.3)
        if frame is not None:
            return frame
    raise AssertionError("no frame in time")


_RED = "videotestsrc is-live=true pattern=red ! video/x-raw,width=66,height=48,framerate=50/1"


@pytest.mark.parametrize(
    "form", ["", " ! videoconvert ! video/x-raw,format=BGR", " ! videoconvert ! video/x-raw,format=I420"]
)
def test_frames_and_the_stamps_of_their_source(opened: Callable[..., DeviceSource], form: str) -> None:
    """66 px are 198 bytes, so that rows are padded."""
    source = opened(f"{_RED}{form} ! appsink", exposure_ms=4.0)
    frames = [frame_from(source) for _ in range(6)]
    for frame in frames:
        assert frame.image.shape == (48, 66, 3) and not frame.image.flags.writeable
        assert (frame.image[..., 0] > 230).all() and (frame.image[..., 1:] < 25).all(), "red, so RGB"
        assert frame.exposure_ns == 4 * MS
    # The pipeline's, which is exact: by arrival no two steps would be alike.
    steps = np.diff([frame.stamp_ns for frame in frames]) / MS
    np.testing.assert_allclose(steps / 20.0, np.round(steps / 20.0), atol=1e-3)
    assert SystemClock().now_ns() - frames[-1].stamp_ns >= 2 * MS, "half of the exposure"


def test_grey_stays_grey(opened: Callable[..., DeviceSource]) -> None:
    source = opened("videotestsrc is-live=true pattern=white ! video/x-raw,format=GRAY8,width=66,height=48 ! appsink")
    frame = frame_from(source)
    assert frame.image.shape == (48, 66) and (frame.image > 230).all()


def test_arrival_is_taken_where_it_is_asked_for(opened: Callable[..., DeviceSource]) -> None:
    source = opened(f"{_RED} ! appsink", stamps="arrival", latency_ms=70.0)
    frame = frame_from(source)
    assert SystemClock().now_ns() - frame.stamp_ns >= 70 * MS


def test_a_pipeline_that_ends_is_started_again(
    opened: Callable[..., DeviceSource], caplog: pytest.LogCaptureFixture
) -> None:
    source = opened(f"{_RED.replace('pattern', 'num-buffers=2 pattern')} ! appsink")
    frame_from(source)
    end = time.monotonic() + 15.0
    while source.reconnects < 1 and time.monotonic() < end:
        time.sleep(0.02)
    frame_from(source)
    assert caplog.text.count("lost; trying again") == 1


def test_no_pipeline_and_one_that_fails(
    opened: Callable[..., DeviceSource], caplog: pytest.LogCaptureFixture, tmp_path: Path
) -> None:
    caplog.set_level(logging.WARNING)
    with pytest.raises(CameraError, match=r"no element .*gst-launch"):
        frame_from(opened("nosuchelement ! appsink"))
    source = opened(f"filesrc location={tmp_path}/missing ! decodebin ! appsink")
    end = time.monotonic() + 15.0
    while source.reconnects < 1 and time.monotonic() < end:
        time.sleep(0.02)
    assert "camera gstreamer: filesrc0: Resource not found" in caplog.text
    assert "can't be opened; trying again" in caplog.text


# -- buffers of our own making -------------------------------------------------

WIDTH, HEIGHT = 22, 6


class Pushed:
    """A pipeline whose buffers the test makes, stamped by arrival; the clock stands where it is told to."""

    def __init__(self, form: str = "RGB") -> None:
        from ortholoc_edge.adapters.camera.gstreamer import GstreamerCamera, load

        self.gst: Any = load()
        caps = f"video/x-raw,format={form},width={WIDTH},height={HEIGHT},framerate=0/1"
        self.pipeline = self.gst.parse_launch(f"appsrc name=from format=time caps={caps} ! appsink name=to sync=false")
        self.source = self.pipeline.get_by_name("from")
        self.clock = ManualClock(10**12)
        self.camera = GstreamerCamera(
            self.gst, self.pipeline, self.pipeline.get_by_name("to"),
            CameraOptions(source="gstreamer:x", stamps="arrival"), self.clock,
        )  # fmt: skip
        self.pipeline.set_state(self.gst.State.PLAYING)

    def push(self, data: bytes, pts_ns: int = 0, begin: int = 0, stride: int = 0) -> Any:
        """And what comes out of it. With a ``stride`` the buffer says how its rows lie."""
        video: Any = importlib.import_module("gi.repository.GstVideo")
        buffer = self.gst.Buffer.new_wrapped(data)
        buffer.pts = pts_ns
        if stride:
            video.buffer_add_video_meta_full(
                buffer, video.VideoFrameFlags.NONE, video.VideoFormat.RGB, WIDTH, HEIGHT, 1, [begin, 0, 0, 0],
                [stride, 0, 0, 0],
            )  # fmt: skip
        self.source.push_buffer(buffer)
        return self.camera.grab()

    def shot_of(self, data: bytes, begin: int = 0, stride: int = 0) -> Any:
        """Of the second frame: the first ones are left out until it is known how late frames are."""
        self.push(data, 0, begin, stride)
        self.clock.set_ns(self.clock.now_ns() + 1000 * MS)
        return self.push(data, 1000 * MS, begin, stride)


@pytest.fixture
def pushed(bindings: None) -> Iterator[Callable[..., Pushed]]:
    made: list[Pushed] = []

    def make(form: str = "RGB") -> Pushed:
        made.append(Pushed(form))
        return made[-1]

    yield make
    for one in made:
        one.camera.release()


@pytest.mark.parametrize(
    ("form", "begin", "stride", "more"),
    [
        ("RGB", 0, 0, 0),
        # Longer than its rows: alignment of the allocator's, a hardware decoder's height in blocks of 16.
        ("RGB", 0, 0, 300),
        ("GRAY8", 0, 0, 100),
        ("RGB", 0, 128, 64),
        ("RGB", 40, 96, 1000),
    ],
)
def test_rows_lie_as_the_buffer_says(
    pushed: Callable[..., Pushed], form: str, begin: int, stride: int, more: int
) -> None:
    channels = 3 if form == "RGB" else 1
    image = np.random.default_rng(3).integers(0, 255, (HEIGHT, WIDTH * channels), dtype=np.uint8)
    lies = np.zeros((HEIGHT, stride or (WIDTH * channels + 3) // 4 * 4), np.uint8)
    lies[:, : WIDTH * channels] = image
    shot = pushed(form).shot_of(bytes(begin) + lies.tobytes() + bytes(more), begin, stride)
    np.testing.assert_array_equal(shot.image.reshape(HEIGHT, -1), image)


def test_a_buffer_that_is_too_short_is_an_error(pushed: Callable[..., Pushed]) -> None:
    with pytest.raises(CameraError, match=r"a frame of 300 bytes, and 22 x 6 px at 68 bytes a row are 406"):
        pushed().shot_of(bytes(300))


def test_nobody_else_empties_the_bus(pushed: Callable[..., Pushed]) -> None:
    one = pushed()
    bus = one.pipeline.get_bus()
    for _ in range(50):
        bus.post(one.gst.Message.new_application(one.pipeline, one.gst.Structure.new_empty("told")))
    one.push(bytes(68 * HEIGHT))
    assert not bus.have_pending()


def test_by_arrival_what_was_queued_is_left_out(pushed: Callable[..., Pushed]) -> None:
    from ortholoc_edge.adapters.camera.live import Late

    one, data = pushed(), bytes(68 * HEIGHT)
    late = {}
    for number in range(40):
        pts_ns = number * 40 * MS
        # From 800 to 1400 ms nothing arrives.
        one.clock.set_ns(10**12 + (1400 * MS if 800 * MS <= pts_ns < 1400 * MS else pts_ns))
        shot = one.push(data, pts_ns)
        late[number] = shot.late_ns // MS if isinstance(shot, Late) else None
    assert late[19] is None and late[20] == 600 - 2 and late[39] is None
    assert all(late[number] is not None for number in range(20, 32))
