"""The ``[camera]`` table."""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec
from msgspec import Meta

_MS = 1_000_000
# Of keys that not every kind of source has a use for: those that have.
_SET = ("device", "picamera2")
_STAMPED = (*_SET, "gstreamer")
_LIVE = (*_STAMPED, "rtsp", "http", "https", "zenoh")
_USED_BY = {
    "rate_hz": (*_SET, "folder"),
    "latency_ms": _LIVE,
    "stamps": (*_STAMPED, "zenoh"),
    "stamp_of": _STAMPED,
    "driver_latency_ms": (*_STAMPED, "zenoh"),
    "exposure_ms": _LIVE,
    "gain": _SET,
    "format": ("device",),
    "shutter": _STAMPED,
    "readout_ms": _STAMPED,
    "width_px": _SET,
    "height_px": _SET,
    "fps": _SET,
    "realtime": ("video",),
}

PixelFormat = Literal["MJPG", "YUYV", "UYVY", "NV12", "YU12", "GREY", "RGB3", "BGR3"]


class CameraOptions(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The ``[camera]`` table.

    Attributes:
        source: ``folder:PATH`` of pictures, ``video:PATH``, ``device:/dev/video0`` or ``device:0``,
            ``picamera2:0``, a ``rtsp://``, ``http://`` or ``https://`` address, ``gstreamer:PIPELINE`` that ends in
            ``appsink``, or ``zenoh:KEY`` of compressed pictures on the bus.
        rate_hz: of a folder; asked of a camera whose ``fps`` is not given.
        latency_ms: of frames that are stamped when they arrive: from the middle of the exposure until the frame is
            handed over. Measure it, since at 20 m/s each 50 ms left out are a metre.
        stamps: "driver": a device's own where they are of our clock, a publisher's own on the bus; else as "arrival".
        stamp_of: which moment the driver's stamps are of. "auto": as the driver says.
        driver_latency_ms: subtracted from the driver's stamps beyond what exposure and readout explain.
        exposure_ms: asked of a camera; of a stream, which can't be asked, as it was set there. Left out: as it is.
            Where it is known frames are stamped in its middle, and frames that it will have smeared are refused.
        gain: asked of a camera: a V4L2 device counts in steps of its own, picamera2 in multiples.
        format: of pixels, asked of a V4L2 device, as four characters.
        shutter, readout_ms: whether rows are exposed one after the other, and the time from the first to the last.
        width_px, height_px, fps: asked of a camera; one that gives other values is used, with a warning.
        realtime: whether a video skips frames that are late, as a camera would; if not, every frame is given.
    """

    source: str
    rate_hz: Annotated[float, Meta(gt=0, le=1000)] = 10.0
    latency_ms: Annotated[float, Meta(ge=0, le=5000)] = 0.0
    stamps: Literal["driver", "arrival"] = "driver"
    stamp_of: Literal["auto", "exposure_start", "frame_start", "frame_end"] = "auto"
    driver_latency_ms: Annotated[float, Meta(ge=-100, le=1000)] = 0.0
    exposure_ms: Annotated[float, Meta(gt=0, le=1000)] | Literal["auto"] | None = None
    gain: Annotated[float, Meta(ge=0, le=100000)] | None = None
    format: PixelFormat | None = None
    shutter: Literal["rolling", "global"] = "rolling"
    readout_ms: Annotated[float, Meta(ge=0, le=200)] = 0.0
    width_px: Annotated[int, Meta(ge=16, le=16384)] | None = None
    height_px: Annotated[int, Meta(ge=16, le=16384)] | None = None
    fps: Annotated[float, Meta(gt=0, le=1000)] | None = None
    realtime: bool = True

    @property
    def kind(self) -> str:
        """What stands before the colon of ``source``: "device", "rtsp", …; of a text that is none, the text."""
        return self.source.partition(":")[0]

    @property
    def place(self) -> str:
        """What stands behind it."""
        return self.source.partition(":")[2]

    @property
    def is_live(self) -> bool:
        """Whether what it shows happens now: a folder and a video may show the same twice."""
        return self.kind not in ("folder", "video")

    def idle_keys(self) -> list[str]:
        """Keys that were given a value other than their default, and that this kind of source has no use for."""
        return [
            field.name
            for field in msgspec.structs.fields(self)
            if field.name in _USED_BY
            and self.kind not in _USED_BY[field.name]
            and getattr(self, field.name) != field.default
        ]

    @property
    def fixed_exposure_ns(self) -> int | None:
        """``exposure_ms`` where it is a number."""
        return round(self.exposure_ms * _MS) if isinstance(self.exposure_ms, float | int) else None

    @property
    def lateness(self) -> tuple[Literal["driver_latency_ms", "latency_ms"], float]:
        """Which key corrects the stamps of this source, and its value."""
        if self.stamps == "driver" and self.kind in ("device", "picamera2", "gstreamer", "zenoh"):
            return "driver_latency_ms", self.driver_latency_ms
        return "latency_ms", self.latency_ms
