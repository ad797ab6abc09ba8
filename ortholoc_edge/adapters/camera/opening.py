"""Which source a configuration means."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import cv2

from ortholoc_edge.adapters.camera.files import FolderSource, VideoSource
from ortholoc_edge.adapters.camera.live import DeviceSource
from ortholoc_edge.adapters.camera.options import CameraOptions
from ortholoc_edge.adapters.camera.source import FrameSource
from ortholoc_edge.adapters.camera.zenoh_frames import ZenohFrames
from ortholoc_edge.clock import Clock
from ortholoc_edge.errors import ConfigError

if TYPE_CHECKING:
    from ortholoc_edge.adapters.bus import Bus

_MS = 1_000_000


def open_source(options: CameraOptions, clock: Clock, bus: Bus | None = None) -> FrameSource:
    """The source that ``options.source`` names.

    Args:
        bus: what ``zenoh:`` listens on, and nothing else needs; closed by its owner, after the source.
    Raises: ConfigError if the text can't be understood; CameraError if a folder or video can't be read. A
        live camera that is missing is waited for instead.
    """
    kind, _, rest = options.source.partition(":")
    latency_ns = round(options.latency_ms * _MS)
    if kind == "folder" and rest:
        return FolderSource(Path(rest), options.rate_hz, clock)
    if kind == "video" and rest:
        return VideoSource(Path(rest), clock, realtime=options.realtime)
    if kind == "zenoh" and rest:
        if bus is None:
            raise ConfigError(f"camera source {options.source!r} comes over the bus; set [bus] enabled = true")
        return ZenohFrames(bus, rest, clock, latency_ns)
    live: str | int
    backend = cv2.CAP_ANY
    if kind == "device" and rest:
        live = int(rest) if rest.isdecimal() else rest
    elif kind in ("rtsp", "http", "https") and rest.startswith("//"):
        live, backend = options.source, cv2.CAP_FFMPEG
    elif kind == "gstreamer" and rest:
        live, backend = rest, cv2.CAP_GSTREAMER
    else:
        raise ConfigError(
            f"camera source {options.source!r} can't be used; write folder:PATH, video:PATH, "
            "device:/dev/video0, rtsp://..., http://..., gstreamer:PIPELINE or zenoh:KEY"
        )
    return DeviceSource(
        live,
        clock,
        latency_ns=latency_ns,
        backend=backend,
        width_px=options.width_px,
        height_px=options.height_px,
        fps=options.fps or (options.rate_hz if kind == "device" else None),
    )
