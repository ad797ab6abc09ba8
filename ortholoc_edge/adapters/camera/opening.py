"""Which source a configuration means."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from ortholoc_edge.adapters.camera.files import FolderSource, VideoSource
from ortholoc_edge.adapters.camera.live import DeviceSource, OpenCamera
from ortholoc_edge.adapters.camera.options import CameraOptions
from ortholoc_edge.adapters.camera.source import FrameSource
from ortholoc_edge.adapters.camera.stream import NETWORK, open_network, prepare_network
from ortholoc_edge.adapters.camera.v4l2 import V4l2Camera, device_path, prepare_devices
from ortholoc_edge.adapters.camera.zenoh_frames import ZenohFrames
from ortholoc_edge.adapters.secret import without_credentials
from ortholoc_edge.clock import Clock
from ortholoc_edge.errors import ConfigError

if TYPE_CHECKING:
    from ortholoc_edge.adapters.bus import Bus


def prepare(options: CameraOptions) -> None:
    """Tell OpenCV, by the environment, what it takes from there alone. Before there are threads: while one sets a
    variable another may not read one, and libraries do at any time. Without it sources work, with longer waits.
    """
    if options.kind == "device":
        prepare_devices()
    elif options.kind in NETWORK:
        prepare_network()


def open_source(options: CameraOptions, clock: Clock, bus: Bus | None = None) -> FrameSource:
    """The source that ``options.source`` names.

    Args:
        bus: what ``zenoh:`` listens on, and nothing else needs; closed by its owner, after the source.
    Raises: ConfigError if the text can't be understood; CameraError if a folder or video can't be read, or a library
        is missing. A live camera that is missing is waited for instead.
    """
    kind, rest = options.kind, options.place
    if kind == "folder" and rest:
        return FolderSource(Path(rest), options.rate_hz, clock)
    if kind == "video" and rest:
        return VideoSource(Path(rest), clock, realtime=options.realtime)
    if kind == "zenoh" and rest:
        if bus is None:
            raise ConfigError(f"camera source {options.source!r} comes over the bus; set [bus] enabled = true")
        return ZenohFrames(bus, rest, options, clock)
    name, opened = _live(options, clock)
    return DeviceSource(name, opened, clock)


def _live(options: CameraOptions, clock: Clock) -> tuple[str, Callable[[], OpenCamera | None]]:
    """The name, and what opens it."""
    kind, rest = options.kind, options.place
    if kind == "device" and rest:
        path = device_path(rest)
        return path, lambda: V4l2Camera.open(path, options, clock)
    if kind in NETWORK and rest.startswith("//"):
        return without_credentials(options.source), lambda: open_network(options.source, options, clock)
    if kind == "gstreamer" and rest:
        # Not at the top: the bindings come with the system, and few have them.
        from ortholoc_edge.adapters.camera.gstreamer import GstreamerCamera, load, low_latency

        pipeline = low_latency(rest)
        load()
        return "gstreamer", lambda: GstreamerCamera.open(pipeline, options, clock)
    if kind == "picamera2" and (not rest or rest.isdecimal()):
        # Not at the top: only a Raspberry Pi has it.
        from ortholoc_edge.adapters.camera.picamera import Picamera, require_picamera2

        require_picamera2()
        number = int(rest or "0")
        return f"picamera2:{number}", lambda: Picamera.open(number, options, clock)
    raise ConfigError(
        f"camera source {without_credentials(options.source)!r} can't be used; write folder:PATH, video:PATH, "
        "device:/dev/video0, picamera2:0, rtsp://..., http://..., gstreamer:PIPELINE or zenoh:KEY"
    )
