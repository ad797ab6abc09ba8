"""The ``[camera]`` table."""

from __future__ import annotations

from typing import Annotated

import msgspec


class CameraOptions(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The ``[camera]`` table.

    Attributes:
        source: ``folder:PATH`` of pictures, ``video:PATH``, ``device:/dev/video0`` or ``device:0``, a
            ``rtsp://``, ``http://`` or ``https://`` address, ``gstreamer:PIPELINE`` that ends in
            ``appsink``, or ``zenoh:KEY`` of compressed pictures on the bus.
        rate_hz: of a folder; asked of a camera whose ``fps`` is not given.
        latency_ms: from the middle of the exposure until the driver hands the frame over. It is subtracted
            from the stamp of live sources; measure it, since at 20 m/s each 50 ms left out are a metre.
        width_px, height_px, fps: asked of a device; a device that gives other values is used, with a warning.
        realtime: whether a video skips frames that are late, as a camera would; if not, every frame is given.
    """

    source: str
    rate_hz: Annotated[float, msgspec.Meta(gt=0, le=1000)] = 10.0
    latency_ms: Annotated[float, msgspec.Meta(ge=0, le=5000)] = 0.0
    width_px: Annotated[int, msgspec.Meta(ge=16, le=16384)] | None = None
    height_px: Annotated[int, msgspec.Meta(ge=16, le=16384)] | None = None
    fps: Annotated[float, msgspec.Meta(gt=0, le=1000)] | None = None
    realtime: bool = True
