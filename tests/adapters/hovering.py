"""An autopilot that stands still where rendered pictures were taken, and the real daemon beside it."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from ortholoc_sim.site import Site
from replay import rendered

from ortholoc_edge.adapters.camera import CameraOptions
from ortholoc_edge.adapters.mavlink import LinkOptions
from ortholoc_edge.config import Config, Intrinsics, MapOptions, MatcherOptions
from ortholoc_edge.daemon import Daemon
from ortholoc_edge.pipeline.finder import SearchOptions
from ortholoc_edge.pipeline.navigator import TimingOptions

from .fake_autopilot import FakeAutopilot, Wire, dialect

ROLL, PITCH, YAW = 3.0, -4.0, 30.0
TRUTH = rendered.pose(roll_deg=ROLL, pitch_deg=PITCH, yaw_deg=YAW)
# The EKF origin, 65 m from the vehicle: errors of axes and signs would be plain.
SITE = Site(rendered.georeference(), TRUTH.translation - np.array([40.0, -50.0, 88.0]))
TRUE_NED = SITE.autopilot_from_ned(SITE.ned_from_map(TRUTH.translation))
PLACE = SITE.geopoint(SITE.ned_from_map(TRUTH.translation))


def wait_for(condition: Callable[[], Any], what: str, seconds: float = 20.0) -> Any:
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        value = condition()
        if value:
            return value
        time.sleep(0.01)
    raise AssertionError(f"{what}: did not happen in {seconds:g} s")


class HoveringAutopilot(FakeAutopilot):
    """Stands still at the pose of the pictures; its GNSS is good to 1.5 m."""

    def __init__(self, wire: Wire, with_origin: bool = True) -> None:
        super().__init__(wire)
        origin = SITE.origin
        self.yaw_rate = 0.0
        self.origin = None
        if with_origin:
            self.origin = (
                round(origin.lat_deg * 1e7), round(origin.lon_deg * 1e7), round(origin.height_amsl_m * 1e3),
            )  # fmt: skip

    def truth_at(self, now_ns: int) -> np.ndarray:
        return rendered.attitude(ROLL, PITCH, YAW)

    def _stream(self, message_id: int, now_ns: int) -> Any:
        ms = (now_ns - self.boot_ns) // 1_000_000
        lat, lon = round(PLACE.lat_deg * 1e7), round(PLACE.lon_deg * 1e7)
        alt_mm = round(PLACE.height_amsl_m * 1e3)
        if message_id == dialect.MAVLINK_MSG_ID_LOCAL_POSITION_NED:
            return dialect.MAVLink_local_position_ned_message(ms, *map(float, TRUE_NED), 0.0, 0.0, 0.0)
        if message_id == dialect.MAVLINK_MSG_ID_GLOBAL_POSITION_INT:
            return dialect.MAVLink_global_position_int_message(ms, lat, lon, alt_mm, 88_000, 0, 0, 0, 0)
        if message_id == dialect.MAVLINK_MSG_ID_GPS_RAW_INT:
            return dialect.MAVLink_gps_raw_int_message(
                0, 3, lat, lon, alt_mm, 80, 120, 0, 0, 14, h_acc=1500, v_acc=2500
            )
        return super()._stream(message_id, now_ns)

    def messages(self, kind: str) -> list[Any]:
        return [message for message in list(self.got) if message.get_type() == kind]


def config(source: str, endpoint: str, **more: Any) -> Config:
    camera = rendered.CAMERA
    # A busy test machine is not what is tested here.
    more.setdefault("timing", TimingOptions(max_age_ms=20_000.0))
    # Nor is the search of the map, but in its own tests.
    more.setdefault("search", SearchOptions(enabled=False))
    return Config(
        camera=CameraOptions(source=source, rate_hz=8.0),
        intrinsics=Intrinsics(
            width_px=camera.width, height_px=camera.height, fx=camera.fx, fy=camera.fy, cx=camera.cx, cy=camera.cy
        ),
        map=MapOptions(pack=str(rendered.store().pack.path)),
        link=LinkOptions(endpoint=endpoint, send=("odometry", "vision_position_estimate"), release="raw"),
        matcher=MatcherOptions(name="structural"),
        **more,
    )


@contextlib.contextmanager
def running(daemon: Daemon) -> Iterator[threading.Event]:
    """The daemon in a thread; what it raised is raised here."""
    stop, failures = threading.Event(), []

    def work() -> None:
        try:
            daemon.run(stop)
        except BaseException as error:
            failures.append(error)

    thread = threading.Thread(target=work, name="daemon-under-test")
    thread.start()
    try:
        yield stop
    finally:
        stop.set()
        thread.join(timeout=15.0)
    assert not thread.is_alive()
    if failures:
        raise failures[0]
