"""Frames from a GStreamer pipeline, through its own Python bindings: OpenCV's wheel is built without GStreamer, and an
OpenCV that has it tells no stamps of the exposure. A frame's time in the pipeline and the pipeline's clock do."""

from __future__ import annotations

import importlib
import logging
import re
from typing import Any

import numpy as np

from ortholoc_edge.adapters.camera.live import Late, Shot
from ortholoc_edge.adapters.camera.options import CameraOptions
from ortholoc_edge.adapters.camera.pictures import frozen_rgb
from ortholoc_edge.adapters.camera.stamps import Arrivals, Stamper
from ortholoc_edge.adapters.secret import without_credentials
from ortholoc_edge.clock import Clock
from ortholoc_edge.errors import CameraError, ConfigError
from ortholoc_edge.geometry.arrays import ImageArray

logger = logging.getLogger(__name__)

_S = 1_000_000_000
_START_NS, _PULL_NS = 5 * _S, 2 * _S
_PROPERTY = re.compile(r"([\w-]+)\s*=\s*(\S+)")
# An appsink of its own accord queues without end, and holds each frame until it is time to show it.
_SINK = {"drop": "true", "max-buffers": "1", "sync": "false"}
_NO_TIME = 2**64 - 1


def low_latency(pipeline: str) -> str:
    """A pipeline whose ``appsink`` gives the newest frame at once, as RGB.

    Raises: ConfigError if it does not end in one, or in one that was told to queue.
    """
    head, mark, sink = pipeline.rpartition("!")
    if not mark or not head.strip() or not sink.split() or sink.split()[0] != "appsink":
        ends = without_credentials(sink.strip()) or "nothing"
        raise ConfigError(f"camera source gstreamer: the pipeline ends in {ends!r}; it must end in '! appsink'")
    given = dict(_PROPERTY.findall(sink))
    for name, values in (("drop", ("true", "1")), ("max-buffers", ("1", "2"))):
        if name in given and given[name].lower() not in values:
            raise ConfigError(
                f"camera source gstreamer: appsink has {name}={given[name]}, and frames that queue are late by what "
                f"no stamp shows; write {name}={_SINK[name]} or leave it out"
            )
    more = " ".join(f"{name}={value}" for name, value in _SINK.items() if name not in given)
    # Passes on untouched what is RGB or grey already.
    return f"{head.strip()} ! videoconvert ! video/x-raw,format=(string){{RGB,GRAY8}} ! {sink.strip()} {more}".strip()


def load() -> Any:
    """GStreamer's bindings, ready. Raises: CameraError with what to install."""
    try:
        gi = importlib.import_module("gi")
        gi.require_version("Gst", "1.0")
        gi.require_version("GstApp", "1.0")
        gi.require_version("GstVideo", "1.0")
        gst: Any = importlib.import_module("gi.repository.Gst")
        # The sink's methods come with the one, how a buffer's rows lie with the other.
        importlib.import_module("gi.repository.GstApp")
        importlib.import_module("gi.repository.GstVideo")
        gst.init(None)
    except (ImportError, ValueError, AttributeError) as error:
        raise CameraError(
            f"camera source gstreamer: this Python has no bindings of GStreamer ({error}); sudo apt install python3-gi "
            "gir1.2-gst-plugins-base-1.0 gstreamer1.0-plugins-base, and make the virtual environment with "
            "--system-site-packages, since they come with the system (docs/cameras.md)"
        ) from error
    return gst


class GstreamerCamera:
    """See `OpenCamera`."""

    def __init__(self, gst: Any, pipeline: Any, sink: Any, options: CameraOptions, clock: Clock) -> None:
        """
        Args:
            gst: of :func:`load`.
            pipeline: that plays. sink: its appsink.
        """
        self._video: Any = importlib.import_module("gi.repository.GstVideo")
        self._gst, self._pipeline, self._sink, self._options, self._clock = gst, pipeline, sink, options, clock
        self._stamper, self._arrivals = Stamper("gstreamer", options), Arrivals()
        # What the pipeline sets it to.
        self._exposure_ns = options.fixed_exposure_ns

    @staticmethod
    def open(pipeline: str, options: CameraOptions, clock: Clock) -> GstreamerCamera | None:
        """A pipeline of :func:`low_latency`; None while it does not play.

        Raises: CameraError where it is no pipeline, or an element is not installed.
        """
        gst = load()
        try:
            made = gst.parse_launch(pipeline)
        except Exception as error:  # GLib.Error, which is not there before the bindings are
            why = without_credentials(str(error))
            raise CameraError(f"camera source gstreamer: {why}; try it with gst-launch-1.0") from error
        camera = GstreamerCamera(gst, made, _appsink(gst, made), options, clock)
        made.set_state(gst.State.PLAYING)
        result, _, _ = made.get_state(_START_NS)
        if result in (gst.StateChangeReturn.FAILURE, gst.StateChangeReturn.ASYNC):
            camera.drain_messages()
            camera.release()
            return None
        logger.info("camera gstreamer open: %s", pipeline.split(maxsplit=1)[0])
        return camera

    def grab(self) -> Shot | Late | None:
        """See `OpenCamera.grab`."""
        stamp_ns = None
        while stamp_ns is None:
            sample = self._sink.try_pull_sample(_PULL_NS)
            arrival_ns = self._clock.now_ns()
            self.drain_messages()
            if sample is None:
                return None
            buffer = sample.get_buffer()
            own_ns = None if buffer.pts == _NO_TIME else int(buffer.pts)
            if not self._stamper.believes:
                late_ns = self._arrivals.late_ns(own_ns, arrival_ns)
                if late_ns is not None:
                    return Late(late_ns)
            captured_ns = 0 if own_ns is None else self._pipeline.get_base_time() + own_ns
            stamp_ns = self._stamper.stamp_ns(captured_ns, arrival_ns, self._exposure_ns)
        image = self._picture(sample)
        return None if image is None else Shot(frozen_rgb(image, "camera gstreamer"), stamp_ns, self._exposure_ns)

    def _picture(self, sample: Any) -> ImageArray | None:
        """(H, W, 3) or (H, W) uint8, a copy; None where its memory can't be had.

        Raises: CameraError of a buffer that is shorter than its picture.
        """
        buffer, structure = sample.get_buffer(), sample.get_caps().get_structure(0)
        width, height = structure.get_value("width"), structure.get_value("height")
        channels = 1 if structure.get_value("format") == "GRAY8" else 3
        meta = self._video.buffer_get_video_meta(buffer)
        # Without the element's own word rows begin at multiples of four bytes.
        begin, stride = (0, (width * channels + 3) // 4 * 4) if meta is None else (meta.offset[0], meta.stride[0])
        mapped, info = buffer.map(self._gst.MapFlags.READ)
        if not mapped:
            return None
        try:
            end = begin + (height - 1) * stride + width * channels
            if info.size < end:
                raise CameraError(
                    f"camera gstreamer: a frame of {info.size} bytes, and {width} x {height} px at {stride} bytes a "
                    f"row are {end}; see which element writes it with gst-launch-1.0 -v"
                )
            # A copy, and before it is unmapped: then the memory is the element's again.
            rows = np.ndarray((height, width * channels), np.uint8, info.data, begin, (stride, 1)).copy()
        finally:
            buffer.unmap(info)
        return rows.reshape(height, width, channels) if channels == 3 else rows

    def drain_messages(self) -> None:
        """Tell what an element said went wrong, and drop the rest: a bus that nobody empties grows all flight."""
        bus = self._pipeline.get_bus()
        while (message := bus.pop()) is not None:
            if message.type == self._gst.MessageType.ERROR:
                error, _ = message.parse_error()
                why = without_credentials(error.message)
                logger.warning("camera gstreamer: %s: %s", message.src.get_name(), why)

    def release(self) -> None:
        """See `OpenCamera.release`."""
        self._pipeline.set_state(self._gst.State.NULL)


def _appsink(gst: Any, pipeline: Any) -> Any:
    """The pipeline's; `low_latency` has seen to it that there is one."""
    sinks = pipeline.iterate_sinks()
    while True:
        result, sink = sinks.next()
        if result == gst.IteratorResult.OK and sink.get_factory().get_name() == "appsink":
            return sink
        if result != gst.IteratorResult.OK:
            raise CameraError("camera source gstreamer: the pipeline has no appsink; end it in '! appsink'")
