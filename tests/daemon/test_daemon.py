"""The real daemon between a folder or a video of rendered pictures and an autopilot on a real UDP socket or pty.

The vehicle hovers where the pictures were taken, so that every frame has the same true pose.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
import os
import signal
import socket
import subprocess
import sys
import threading
import time
import urllib.request
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

import cv2
import msgspec
import numpy as np
import pytest
from adapters.fake_autopilot import PtyWire, UdpWire, Wire, dialect
from adapters.firmware_parameters import ARDUPILOT_READY, ARDUPILOT_STOCK
from adapters.hovering import PITCH, PLACE, ROLL, TRUE_NED, TRUTH, YAW, HoveringAutopilot, config, running, wait_for
from mcap.reader import make_reader
from replay import rendered

from ortholoc_edge.adapters import systemd
from ortholoc_edge.adapters.camera import CameraOptions, EndOfFrames, FrameSource, open_source
from ortholoc_edge.adapters.flight_log import LogOptions
from ortholoc_edge.adapters.mavlink import SystemStatus
from ortholoc_edge.adapters.messages import AutopilotMessage
from ortholoc_edge.adapters.page.options import PageOptions
from ortholoc_edge.clock import SystemClock
from ortholoc_edge.config import Config, MountOptions
from ortholoc_edge.daemon import Daemon, LatestSlot
from ortholoc_edge.errors import CameraError, ConfigError, LinkError, MapError, OrtholocError
from ortholoc_edge.geometry import frames, rotation
from ortholoc_edge.geometry.rigid import Rigid3
from ortholoc_edge.pipeline.frame import Frame
from ortholoc_edge.pipeline.navigator import TimingOptions
from ortholoc_edge.pipeline.outcome import Fix, Outcome, Reason, Rejected
from ortholoc_edge.pipeline.witness import WitnessOptions
from ortholoc_edge.tiles.georeference import Georeference
from ortholoc_edge.tiles.pack import Pack


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One photo again and again, for half a minute; every third time cut short."""
    path = tmp_path_factory.mktemp("frames")
    photo = rendered.write_picture(path / "photo_000.jpg", rendered.picture(TRUTH))
    cut = path / "photo_002.jpg"
    cut.write_bytes((data := photo.read_bytes())[: len(data) // 2])
    for number in (1, *range(3, 240)):
        (path / f"photo_{number:03d}.jpg").hardlink_to(cut if number % 3 == 2 else photo)
    return path


@pytest.fixture(scope="module")
def video(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("video") / "flight.avi"
    size = rendered.CAMERA.width, rendered.CAMERA.height
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 4.0, size)
    assert writer.isOpened()
    for _ in range(60):
        writer.write(np.ascontiguousarray(rendered.picture(TRUTH)[..., ::-1]))
    writer.release()
    return path


@pytest.fixture(params=["udp", "serial"])
def peer(request: pytest.FixtureRequest) -> Iterator[tuple[HoveringAutopilot, str]]:
    """The autopilot and the link's endpoint to it."""
    wire: Any = UdpWire() if request.param == "udp" else PtyWire()
    autopilot = HoveringAutopilot(wire)
    endpoint = f"udpout:127.0.0.1:{wire.port}" if request.param == "udp" else f"serial:{wire.path}:921600"
    yield autopilot, endpoint
    autopilot.close()


def check_estimates(autopilot: HoveringAutopilot, outcomes: list[tuple[Frame | None, Outcome]]) -> None:
    captured = {outcome.stamp_ns // 1000 for _, outcome in outcomes if isinstance(outcome, Fix)}
    odometry = autopilot.messages("ODOMETRY")
    vision = autopilot.messages("VISION_POSITION_ESTIMATE")
    for message in odometry:
        # ArduPilot takes LOCAL_FRD, and by it means north and east (autopilot contract).
        assert message.frame_id == dialect.MAV_FRAME_LOCAL_FRD
        assert message.child_frame_id == dialect.MAV_FRAME_BODY_FRD
        assert message.time_usec in captured
        turn = rotation.from_quaternion(message.q)
        assert math.degrees(rotation.angle_between(turn, rendered.attitude(ROLL, PITCH, YAW))) < 1.5
        assert np.isfinite(message.pose_covariance).all()
        assert message.pose_covariance[0] > 0
    for message in vision:
        assert message.usec in captured
        assert np.degrees([message.roll, message.pitch, message.yaw]) == pytest.approx([ROLL, PITCH, YAW], abs=1.5)
        assert np.isfinite(message.covariance).all()
        assert message.covariance[0] > 0
    for message in odometry + vision:
        assert np.linalg.norm(np.array([message.x, message.y, message.z]) - TRUE_NED) < 3.0
        assert message.get_srcComponent() == dialect.MAV_COMP_ID_VISUAL_INERTIAL_ODOMETRY
        assert message.get_srcSystem() == autopilot.system_id


def test_folder_to_autopilot(folder: Path, peer: tuple[HoveringAutopilot, str], tmp_path: Path) -> None:
    """Photos cut short are told, and the daemon goes on."""
    autopilot, endpoint = peer
    outcomes: list[tuple[Frame | None, Outcome]] = []
    daemon = Daemon(
        config(f"folder:{folder}", endpoint, log=LogOptions(folder=str(tmp_path))),
        on_outcome=lambda frame, outcome: outcomes.append((frame, outcome)),
    )
    with running(daemon):
        wait_for(lambda: len(autopilot.messages("ODOMETRY")) >= 4, "four ODOMETRY")
        wait_for(lambda: len(autopilot.messages("VISION_POSITION_ESTIMATE")) >= 4, "four VISION_POSITION_ESTIMATE")
        wait_for(
            lambda: any(m.system_status == SystemStatus.ACTIVE for m in autopilot.messages("HEARTBEAT")),
            "a heartbeat that says active",
        )
        wait_for(lambda: any(getattr(o, "reason", None) is Reason.BAD_FRAME for _, o in list(outcomes)), "a bad frame")
    check_estimates(autopilot, outcomes)
    rejected = [outcome for _, outcome in outcomes if isinstance(outcome, Rejected)]
    bad = [outcome for outcome in rejected if outcome.reason is Reason.BAD_FRAME]
    # Not always every one: a later frame may take its place in the slot before the worker comes to it.
    assert bad
    assert all("truncated" in outcome.detail and "photo_" in outcome.detail for outcome in bad)
    # Before the autopilot was found there is no attitude; else nothing is refused.
    assert {outcome.reason for outcome in rejected} <= {Reason.BAD_FRAME, Reason.BAD_ATTITUDE, Reason.NO_PRIOR}
    stamps = [outcome.stamp_ns for _, outcome in outcomes]
    assert stamps == sorted(stamps)
    counts = daemon.statistics()
    assert counts["fixes"] + counts["rejected"] == len(outcomes)
    (log,) = tmp_path.glob("flight-*.mcap")
    with log.open("rb") as file:
        logged = [
            msgspec.json.decode(message.data)
            for _, _, message in make_reader(file).iter_messages(topics=["/ortholoc/outcome"])
        ]
    assert [line["stamp_ns"] for line in logged] == stamps
    assert [line["fix"] for line in logged] == [isinstance(outcome, Fix) for _, outcome in outcomes]


def test_video_to_autopilot(video: Path, peer: tuple[HoveringAutopilot, str]) -> None:
    autopilot, endpoint = peer
    outcomes: list[tuple[Frame | None, Outcome]] = []
    daemon = Daemon(
        config(f"video:{video}", endpoint), on_outcome=lambda frame, outcome: outcomes.append((frame, outcome))
    )
    with running(daemon):
        wait_for(lambda: len(autopilot.messages("ODOMETRY")) >= 3, "three ODOMETRY")
        wait_for(lambda: len(autopilot.messages("VISION_POSITION_ESTIMATE")) >= 3, "three VISION_POSITION_ESTIMATE")
    check_estimates(autopilot, outcomes)
    assert all(frame is not None for frame, _ in outcomes)


def test_the_ground_page_shows_the_flight_and_a_taken_port_does_not_end_it(folder: Path) -> None:
    """The port is taken at first: the flight begins all the same, and the page comes when it is free."""
    taken = socket.create_server(("127.0.0.1", 0))
    port = taken.getsockname()[1]
    wire = UdpWire()
    autopilot = HoveringAutopilot(wire)
    page = PageOptions(enabled=True, listen=f"127.0.0.1:{port}")
    daemon = Daemon(config(f"folder:{folder}", f"udpout:127.0.0.1:{wire.port}", page=page))

    def state() -> dict[str, Any]:
        try:
            with urllib.request.urlopen(f"http://127.0.0.1:{port}/state.json", timeout=5.0) as answer:
                return dict(msgspec.json.decode(answer.read()))
        except OSError:
            return {}

    try:
        with running(daemon):
            wait_for(lambda: int(daemon.statistics().get("fixes", 0)) >= 1, "a fix without the page")
            taken.close()
            shown = wait_for(
                lambda: (found := state()) and any("fix" in m for m in found["marks"]) and found["health"] and found,
                "a fix on the page",
            )
            kinds = {mark.get("reason", "fix") for mark in shown["marks"]}
    finally:
        taken.close()
        autopilot.close()
    assert kinds <= {"fix", "bad_frame", "bad_attitude", "no_prior"}
    mark = next(mark for mark in reversed(shown["marks"]) if "fix" in mark)
    at = np.array(mark["fix"]["at"][:2]) + shown["scene"]["origin"]
    assert np.linalg.norm(at - TRUTH.translation[:2]) < 3.0
    assert mark["fix"]["heading_deg"] == pytest.approx(YAW - math.degrees(shown["scene"]["convergence_rad"]), abs=2.0)
    assert shown["health"]["autopilot"]["connected"] and shown["health"]["vehicle"].startswith("ardupilot")
    assert mark["took_ms"]["total"] > 0 and shown["health"]["statistics"]["page_dropped"] == 0
    assert state() == {}, "it ended with the daemon"


def test_a_page_for_all_without_a_token_is_refused(folder: Path) -> None:
    page = PageOptions(enabled=True, listen="0.0.0.0:8080")
    with pytest.raises(ConfigError, match=r"\[page\] listen: 0\.0\.0\.0:8080"):
        Daemon(config(f"folder:{folder}", "udpout:127.0.0.1:9", page=page))


def test_without_an_origin_nothing_is_sent(folder: Path) -> None:
    """Where the autopilot's zero is, is not ours to guess: it hears why, and no estimate."""
    wire = UdpWire()
    autopilot = HoveringAutopilot(wire, with_origin=False)
    outcomes: list[Outcome] = []
    daemon = Daemon(
        config(f"folder:{folder}", f"udpout:127.0.0.1:{wire.port}"),
        on_outcome=lambda _, outcome: outcomes.append(outcome),
    )
    try:
        with running(daemon):
            wait_for(lambda: sum(isinstance(o, Fix) for o in list(outcomes)) >= 3, "three fixes")
            texts = wait_for(
                lambda: [m.text for m in autopilot.messages("STATUSTEXT") if "origin" in m.text], "the warning"
            )
            told = len(autopilot.messages("HEARTBEAT"))
            wait_for(lambda: len(autopilot.messages("HEARTBEAT")) >= told + 2, "two seconds more")
            texts = [m.text for m in autopilot.messages("STATUSTEXT") if "origin" in m.text]
    finally:
        autopilot.close()
    assert autopilot.messages("ODOMETRY") == []
    assert autopilot.messages("VISION_POSITION_ESTIMATE") == []
    # The first may come before it is warm.
    states = {m.system_status for m in autopilot.messages("HEARTBEAT")}
    assert SystemStatus.STANDBY in states and states <= {SystemStatus.BOOT, SystemStatus.STANDBY}, "nobody is served"
    assert autopilot.got_counts["SET_GPS_GLOBAL_ORIGIN"] == 0
    assert len(texts) == 1 and "not sent" in texts[0]


def test_wrong_settings_are_told_once(
    folder: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The ground station sees which parameter is wrong; the log has the command that mends it."""
    monkeypatch.setattr("ortholoc_edge.adapters.mavlink.parameters._REQUEST_INTERVAL_NS", 5_000_000)
    wire = UdpWire()
    autopilot = HoveringAutopilot(wire)
    autopilot.parameters = dict(ARDUPILOT_STOCK)
    options = config(f"folder:{folder}", f"udpout:127.0.0.1:{wire.port}")
    camera = _Covered(open_source(options.camera, SystemClock()))
    camera.is_covered = True
    daemon = Daemon(options, frames=camera)
    try:
        with running(daemon):
            wait_for(lambda: len(settings(autopilot)) == 2 and "audit_findings" in daemon.statistics(), "the audit")
            camera.is_covered = False
            # Sent raw, a fix has the latency that was measured, of which the parameter's default knows nothing.
            wait_for(lambda: "VISO_DELAY_MS is 10, wanted" in caplog.text, "a word about the delay")
            asked, told = autopilot.got_counts["PARAM_REQUEST_READ"], len(autopilot.messages("HEARTBEAT"))
            wait_for(lambda: len(autopilot.messages("HEARTBEAT")) >= told + 2, "two seconds more")
    finally:
        autopilot.close()
    assert settings(autopilot) == [
        "OrthoLoC: VISO_TYPE is 0, wants 1",
        "OrthoLoC: EK3_SRC2_POSXY is 0, wants 6",
    ]
    assert caplog.text.count("param set VISO_TYPE 1") == 1
    assert autopilot.got_counts["PARAM_REQUEST_READ"] == asked and autopilot.got_counts["PARAM_SET"] == 0


def settings(autopilot: HoveringAutopilot) -> list[str]:
    return [message.text for message in autopilot.messages("STATUSTEXT") if "wants" in message.text]


def test_origin_is_offered_where_that_is_allowed(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # How many are waited for is tested beside the protocol.
    monkeypatch.setattr("ortholoc_edge.adapters.mavlink.protocol._ORIGIN_QUESTIONS", 1)
    wire = UdpWire()
    autopilot = HoveringAutopilot(wire, with_origin=False)
    base = config(f"folder:{folder}", f"udpout:127.0.0.1:{wire.port}")
    daemon = Daemon(msgspec.structs.replace(base, link=msgspec.structs.replace(base.link, set_origin=True)))
    try:
        with running(daemon):
            wait_for(lambda: autopilot.messages("ODOMETRY"), "an estimate")
    finally:
        autopilot.close()
    (offered, *_) = autopilot.messages("SET_GPS_GLOBAL_ORIGIN")
    assert offered.latitude == pytest.approx(PLACE.lat_deg * 1e7, abs=500)
    assert offered.longitude == pytest.approx(PLACE.lon_deg * 1e7, abs=500)
    assert offered.altitude == pytest.approx(PLACE.height_amsl_m * 1e3, abs=3000)
    first = autopilot.messages("ODOMETRY")[0]
    assert np.linalg.norm([first.x, first.y, first.z]) < 3.0


def test_a_fix_that_is_too_old_is_not_sent(folder: Path) -> None:
    wire = UdpWire()
    autopilot = HoveringAutopilot(wire)
    outcomes: list[Outcome] = []
    options = config(f"folder:{folder}", f"udpout:127.0.0.1:{wire.port}", timing=TimingOptions(max_age_ms=1.0))
    daemon = Daemon(options, on_outcome=lambda _, outcome: outcomes.append(outcome))
    try:
        with running(daemon):
            late = wait_for(
                lambda: [o for o in list(outcomes) if isinstance(o, Rejected) and o.reason is Reason.LATE], "a late fix"
            )
    finally:
        autopilot.close()
    assert late[0].measured is not None
    assert late[0].measured > 1.0
    assert autopilot.messages("ODOMETRY") == []
    assert not any(isinstance(outcome, Fix) for outcome in outcomes)


def test_gnss_on_another_continent_is_survived(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A spoofed or cold receiver may claim what the pack's projection can't take."""
    wire = UdpWire()
    autopilot = HoveringAutopilot(wire)
    outcomes: list[Outcome] = []
    daemon = Daemon(
        config(f"folder:{folder}", f"udpout:127.0.0.1:{wire.port}"),
        on_outcome=lambda _, outcome: outcomes.append(outcome),
    )

    def off_the_earth(*_: Any, **__: Any) -> Any:
        raise MapError("outside of the projection's domain")

    try:
        with running(daemon):
            wait_for(lambda: autopilot.messages("ODOMETRY"), "an estimate")
            monkeypatch.setattr(Georeference, "map_from_geodetic", off_the_earth)
            seen = len(outcomes)
            wait_for(lambda: len(outcomes) >= seen + 7 or None, "seven more frames")
            assert any(isinstance(o, Fix) for o in outcomes[seen:]), "the chain of fixes must go on without GNSS"
            assert daemon.statistics()["gnss_unusable"]
    finally:
        autopilot.close()


class _SpoofedAutopilot(HoveringAutopilot):
    """Its GNSS is ``beside_m`` to the north; keeps commands for the EKF's source set."""

    def __init__(self, wire: Wire, with_origin: bool = True) -> None:
        self.beside_m = 0.0
        self.source_sets: list[int] = []
        super().__init__(wire, with_origin)
        self.parameters = {**ARDUPILOT_READY, "EK3_SRC3_POSXY": 6}

    def _stream(self, message_id: int, now_ns: int) -> Any:
        message = super()._stream(message_id, now_ns)
        if message_id == dialect.MAVLINK_MSG_ID_GPS_RAW_INT:
            message.lat += round(self.beside_m / 111_320.0 * 1e7)
        return message

    def _take(self, message: Any) -> None:
        if message.get_type() == "COMMAND_LONG" and message.command == dialect.MAV_CMD_SET_EKF_SOURCE_SET:
            self.source_sets.append(round(message.param1))
        super()._take(message)


def switching(folder: Path, wire: UdpWire) -> Daemon:
    base = config(
        f"folder:{folder}", f"udpout:127.0.0.1:{wire.port}",
        # Fewer frames than in flight: it is the same with its own limits (tests/pipeline/test_witness.py).
        witness=WitnessOptions(suspect_score=2.0, bad_score=10.0),
    )  # fmt: skip
    enabled = msgspec.structs.replace(
        base,
        camera=CameraOptions(source=f"folder:{folder}", rate_hz=2.0),
        link=msgspec.structs.replace(base.link, switch_sources=True, vision_source_set=3),
    )
    return Daemon(enabled)


def test_no_switch_to_vision_while_no_estimate_goes_out(folder: Path) -> None:
    """Fixes there are, and GNSS is bad; but without an origin the filter gets none of them."""
    wire = UdpWire()
    autopilot = _SpoofedAutopilot(wire, with_origin=False)
    daemon = switching(folder, wire)
    try:
        with running(daemon):
            wait_for(lambda: cast(int, daemon.statistics().get("fixes", 0)) >= 2, "two fixes")
            autopilot.beside_m = 40.0
            wait_for(lambda: daemon.statistics()["gnss_consistency"] == "bad", "GNSS found bad", 40.0)
            wait_for(lambda: any("GNSS contradicts camera" in str(m.text) for m in autopilot.messages("STATUSTEXT")),
                     "a word about it")  # fmt: skip
            beats = len(autopilot.messages("HEARTBEAT"))
            wait_for(lambda: len(autopilot.messages("HEARTBEAT")) > beats, "a second more")
    finally:
        autopilot.close()
    assert autopilot.source_sets == []


def test_spoofed_gnss_is_told_and_the_source_switched_where_enabled(folder: Path) -> None:
    wire = UdpWire()
    autopilot = _SpoofedAutopilot(wire)
    daemon = switching(folder, wire)
    try:
        with running(daemon):
            wait_for(lambda: autopilot.messages("ODOMETRY"), "an estimate")
            assert daemon.statistics()["gnss_consistency"] in ("unknown", "ok")
            autopilot.beside_m = 40.0
            wait_for(lambda: daemon.statistics()["gnss_consistency"] == "bad", "GNSS found bad", 40.0)
            wait_for(lambda: autopilot.source_sets, "a command")
            texts = [str(message.text) for message in autopilot.messages("STATUSTEXT")]
            wait_for(lambda: any("GNSS contradicts camera" in str(m.text) for m in autopilot.messages("STATUSTEXT")),
                     f"a word about it, not {texts}")  # fmt: skip
            assert daemon.statistics()["fixes"] > 0
            assert set(autopilot.source_sets) == {3}
    finally:
        autopilot.close()


class _Bus:
    """Keeps what is published of the autopilot."""

    dropped = refused = 0
    accepts_commands = False

    def __init__(self) -> None:
        self.records: list[AutopilotMessage] = []

    def publish(self, message: Any) -> None:
        if isinstance(message, AutopilotMessage):
            self.records.append(message)

    def publish_image(self, stamp_ns: int, image: Any) -> None:
        pass


def test_a_lost_link_is_published(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ortholoc_edge.adapters.mavlink.protocol._SILENT_AFTER_NS", 1_000_000_000)
    wire = UdpWire()
    autopilot = HoveringAutopilot(wire)
    daemon = Daemon(config(f"folder:{folder}", f"udpout:127.0.0.1:{wire.port}"))
    bus = daemon._reporter._bus = _Bus()  # type: ignore[assignment]
    try:
        with running(daemon):
            wait_for(lambda: any(record.connected for record in bus.records), "a record of the autopilot")
            autopilot.mute = True
            wait_for(lambda: bus.records and not bus.records[-1].connected, "a record that it is lost")
            assert bus.records[-1].fusion == "unknown"
    finally:
        autopilot.close()


def automatic(folder: Path, wire: UdpWire, **link: Any) -> Config:
    base = config(f"folder:{folder}", f"udpout:127.0.0.1:{wire.port}")
    return msgspec.structs.replace(base, link=msgspec.structs.replace(base.link, send=("auto",), **link))


def test_a_place_needs_no_origin_and_does_not_jump_with_it(folder: Path) -> None:
    """PX4 1.18 takes WGS 84: nothing waits for an origin, and one that moves is no news."""
    wire = UdpWire()
    autopilot = HoveringAutopilot(wire, with_origin=False)
    autopilot.autopilot, autopilot.version = dialect.MAV_AUTOPILOT_PX4, (1, 18, 0)
    daemon = Daemon(automatic(folder, wire, sensor_id=9))

    def sensor() -> list[Any]:
        return autopilot.messages("GLOBAL_POSITION_SENSOR")

    def told_latitude() -> int | None:
        state = daemon.link.state_at(0)
        return None if state is None or state.origin is None else round(state.origin.latitude_deg * 1e7)

    try:
        with running(daemon):
            wait_for(lambda: len(sensor()) >= 2, "two GLOBAL_POSITION_SENSOR")
            counter = daemon._navigator.tracker.reset_counter
            for latitude in (507000000, 508000000):
                autopilot.origin = (latitude, 71000000, 60000)
                autopilot._send(dialect.MAVLink_gps_global_origin_message(*autopilot.origin))
                wait_for(lambda latitude=latitude: told_latitude() == latitude or None, "the origin")
                seen = len(sensor())
                wait_for(lambda seen=seen: len(sensor()) >= seen + 2, "two more")
            assert daemon._navigator.tracker.reset_counter == counter
    finally:
        autopilot.close()
    for message in sensor():
        # 1e-5 degrees are a metre.
        assert message.lat == pytest.approx(PLACE.lat_deg * 1e7, abs=300)
        assert message.lon == pytest.approx(PLACE.lon_deg * 1e7, abs=500)
        assert message.alt == pytest.approx(PLACE.height_amsl_m, abs=3.0)
        assert message.id == 9
        assert 0 < message.processing_time < 20_000_000
        assert message.time_usec >= message.processing_time
    assert not any("origin" in m.text for m in autopilot.messages("STATUSTEXT"))
    # The version may not have been told before the first estimates; with no origin they were not sent.
    assert autopilot.messages("ODOMETRY") == []


class _Covered:
    """The folder's camera, with a lid."""

    def __init__(self, frames: FrameSource) -> None:
        self._frames = frames
        self.is_covered = False

    def read(self, timeout_s: float) -> Frame | None:
        frame = self._frames.read(timeout_s)
        return None if self.is_covered else frame

    def close(self) -> None:
        self._frames.close()


def test_recovery_is_told_once_for_each_outage_and_not_at_the_start(folder: Path) -> None:
    wire = UdpWire()
    autopilot = HoveringAutopilot(wire)
    settings = automatic(folder, wire, recovery=True)
    camera = _Covered(open_source(settings.camera, SystemClock()))
    daemon = Daemon(settings, frames=camera)
    try:
        with running(daemon):
            wait_for(lambda: len(autopilot.messages("ODOMETRY")) >= 2, "two ODOMETRY")
            camera.is_covered = True
            wait_for(lambda: daemon.link._protocol.is_outage(time.monotonic_ns()), "an outage")
            before = len(autopilot.messages("ODOMETRY"))
            camera.is_covered = False
            wait_for(lambda: len(autopilot.messages("ODOMETRY")) >= before + 2, "two more")
    finally:
        autopilot.close()
    kinds = [m.get_type() for m in autopilot.got if m.get_type() in ("COMMAND_INT", "ODOMETRY")]
    commands = [place for place, kind in enumerate(kinds) if kind == "COMMAND_INT"]
    # Besides ours, whatever pause this machine made of its own is one.
    assert before in commands and kinds[0] == "ODOMETRY" and kinds[before + 1] == "ODOMETRY"
    command = autopilot.messages("COMMAND_INT")[-1]
    assert command.command == dialect.MAV_CMD_EXTERNAL_POSITION_ESTIMATE
    assert command.x == pytest.approx(PLACE.lat_deg * 1e7, abs=300)


def test_watchdog_starves_when_the_camera_hangs(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    said: list[str] = []
    monkeypatch.setattr(systemd, "notify", said.append)
    monkeypatch.setattr("ortholoc_edge.daemon._CAPTURE_HUNG_NS", 300_000_000)
    wire = UdpWire()
    autopilot = HoveringAutopilot(wire)
    hung = threading.Event()

    class HangingCamera:
        def read(self, timeout_s: float) -> Frame | None:
            hung.wait(20.0)
            raise EndOfFrames

        def close(self) -> None:
            hung.set()

    daemon = Daemon(config(f"folder:{folder}", f"udpout:127.0.0.1:{wire.port}"), frames=HangingCamera())
    try:
        with running(daemon):
            wait_for(lambda: "WATCHDOG=1" in said or None, "the watchdog")
            wait_for(lambda: any(line.startswith("STATUS=search") for line in said), "a status")
            time.sleep(0.5)
            fed = said.count("WATCHDOG=1")
            time.sleep(0.7)
            assert said.count("WATCHDOG=1") == fed
    finally:
        autopilot.close()


def test_watchdog_starves_when_the_link_hangs(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Frames go on, and nobody is told what they come to."""
    said: list[str] = []
    monkeypatch.setattr(systemd, "notify", said.append)
    monkeypatch.setattr("ortholoc_edge.daemon._LINK_HUNG_NS", 300_000_000)
    wire = UdpWire()
    autopilot = HoveringAutopilot(wire)
    daemon = Daemon(config(f"folder:{folder}", f"udpout:127.0.0.1:{wire.port}"))
    released = threading.Event()
    try:
        with running(daemon):
            wait_for(lambda: autopilot.messages("ODOMETRY"), "an estimate")
            monkeypatch.setattr(daemon.link, "_receive", lambda *_: [released.wait(20.0)][:0])
            wait_for(lambda: time.monotonic_ns() - daemon.link.beat_ns > 400_000_000, "a link that hangs")

            def more_frames() -> int:
                """What the watchdog had been fed when the worker had come round again."""
                refused = cast(int, daemon.statistics().get("rejected", 0))
                wait_for(lambda: cast(int, daemon.statistics()["rejected"]) > refused + 1, "frames without an attitude")
                return said.count("WATCHDOG=1")

            # On a busy machine the worker may have looked before, and say so only now.
            fed = more_frames()
            assert more_frames() == fed
            released.set()
            wait_for(lambda: said.count("WATCHDOG=1") > fed, "the watchdog fed again")
    finally:
        released.set()
        autopilot.close()


def test_end_of_the_frames_ends_the_daemon(tmp_path: Path) -> None:
    for number in range(2):
        rendered.write_picture(tmp_path / f"{number}.jpg", rendered.picture(TRUTH))
    outcomes: list[Outcome] = []
    wire = UdpWire()
    try:
        daemon = Daemon(
            config(f"folder:{tmp_path}", f"udpout:127.0.0.1:{wire.port}"),
            on_outcome=lambda _, outcome: outcomes.append(outcome),
        )
        daemon.run(threading.Event())
    finally:
        wire.close()
    # Nobody answers, so there is no attitude.
    assert [o.reason for o in outcomes if isinstance(o, Rejected)] == [Reason.BAD_ATTITUDE] * len(outcomes)
    assert outcomes
    assert not [t for t in threading.enumerate() if t.name in ("capture", "flight-log", "mavlink")]


class BankedAutopilot(HoveringAutopilot):
    """In a bank of 30 degrees under the same place, with a gimbal that holds its camera on a bearing of 55 degrees,
    20 degrees off the plumb line."""

    ATTITUDE = rendered.attitude(30.0, PITCH, YAW)
    GIMBAL = rendered.attitude(0.0, -70.0, 55.0)

    def __init__(self, wire: Wire) -> None:
        super().__init__(wire)
        self.gimbal = self.report

    def truth_at(self, now_ns: int) -> np.ndarray:
        return self.ATTITUDE

    def report(self, boot_ms: int) -> Any:
        q = [float(v) for v in rotation.to_quaternion(rendered.attitude(0.0, -70.0, 55.0 - YAW))]
        flags = dialect.GIMBAL_DEVICE_FLAGS_YAW_IN_VEHICLE_FRAME | dialect.GIMBAL_DEVICE_FLAGS_YAW_LOCK
        return dialect.MAVLink_gimbal_device_attitude_status_message(
            0, 0, boot_ms, flags, q, math.nan, math.nan, math.nan, 0, math.nan, math.nan, 1
        )


def test_a_camera_in_a_gimbal(tmp_path: Path) -> None:
    """What is sent is the body's pose, not the camera's; and nothing once the gimbal is silent."""
    mount = MountOptions(preset="forward", gimbal="auto", lever_arm_m=(1.5, -0.5, 0.8))
    map_from_ned = frames.map_from_ned_rotation(rendered.georeference().convergence_rad(TRUTH.translation[:2]))
    camera = Rigid3(
        map_from_ned @ BankedAutopilot.GIMBAL @ frames.BODY_FROM_FORWARD_CAMERA,
        TRUTH.translation + map_from_ned @ BankedAutopilot.ATTITUDE @ mount.lever_arm_m,
    )
    data = rendered.write_picture(tmp_path / "photo_000.jpg", rendered.picture(camera)).read_bytes()
    for number in range(1, 100):
        (tmp_path / f"photo_{number:03d}.jpg").write_bytes(data)
    autopilot = BankedAutopilot(UdpWire())
    outcomes: list[Outcome] = []
    try:
        daemon = Daemon(
            config(f"folder:{tmp_path}", f"udpout:127.0.0.1:{autopilot.wire.port}", mount=mount),
            on_outcome=lambda _, outcome: outcomes.append(outcome),
        )
        with running(daemon):
            wait_for(lambda: len(autopilot.messages("ODOMETRY")) >= 4, "four ODOMETRY")
            autopilot.gimbal = None
            wait_for(lambda: getattr(outcomes[-1], "reason", None) is Reason.GIMBAL_UNKNOWN, "a frame without gimbal")
            frames_so_far = len(outcomes)
            # The last estimate may still be under way.
            wait_for(lambda: len(outcomes) >= frames_so_far + 2, "two more frames")
            sent = len(autopilot.messages("ODOMETRY"))
            wait_for(lambda: len(outcomes) >= frames_so_far + 6, "four more frames")
            later = outcomes[frames_so_far:]
            assert {getattr(outcome, "reason", None) for outcome in later} == {Reason.GIMBAL_UNKNOWN}
            assert len(autopilot.messages("ODOMETRY")) == sent
    finally:
        autopilot.close()
    assert autopilot.intervals_ns[dialect.MAVLINK_MSG_ID_GIMBAL_DEVICE_ATTITUDE_STATUS] == 50_000_000
    for message in autopilot.messages("ODOMETRY"):
        turn = rotation.from_quaternion(message.q)
        assert math.degrees(rotation.angle_between(turn, BankedAutopilot.ATTITUDE)) < 1.5
        # The camera is 1.7 m from the body.
        assert np.linalg.norm(np.array([message.x, message.y, message.z]) - TRUE_NED) < 1.0


class _BrokenCamera:
    def read(self, timeout_s: float) -> Frame | None:
        raise ZeroDivisionError("a driver's")

    def close(self) -> None:
        pass


def test_a_camera_or_a_link_that_ended_for_good_ends_the_daemon(folder: Path) -> None:
    """For systemd to start it afresh: without either there is nothing left to do."""
    options = config(f"folder:{folder}", "udpout:127.0.0.1:9")
    with pytest.raises(CameraError, match="a driver's"):
        Daemon(options, frames=_BrokenCamera()).run(threading.Event())
    daemon = Daemon(options)
    daemon.link.failure = ZeroDivisionError("ours")
    with pytest.raises(LinkError, match="ours"):
        daemon.run(threading.Event())


class _BrokenMatcher:
    """Fails on every frame after the warm-up."""

    name, model_sha256, working_px = "broken", None, 640

    def __init__(self) -> None:
        self.calls = itertools.count()

    def extract(self, image: np.ndarray, valid: np.ndarray | None = None) -> Any:
        if next(self.calls):
            raise ZeroDivisionError("a bug of ours")
        return None

    def match(self, query: Any, reference: Any) -> Any:
        assert query is None, "only the warm-up comes so far"


def test_bug_is_counted_and_then_ends_the_process(tmp_path: Path) -> None:
    for number in range(40):
        # Grey and small files: this is not about pictures.
        rendered.write_picture(tmp_path / f"{number:02d}.jpg", np.full((360, 480, 3), 90, np.uint8))
    wire = UdpWire()
    autopilot = HoveringAutopilot(wire)
    outcomes: list[Outcome] = []
    base = config(f"folder:{tmp_path}", f"udpout:127.0.0.1:{wire.port}")
    fast = msgspec.structs.replace(base, camera=CameraOptions(source=f"folder:{tmp_path}", rate_hz=8.0))
    daemon = Daemon(fast, matcher=_BrokenMatcher(), on_outcome=lambda _, outcome: outcomes.append(outcome))
    try:
        with pytest.raises(OrtholocError, match=r"5 frames in a row failed.*a bug of ours"):
            daemon.run(threading.Event())
    finally:
        autopilot.close()
    assert [o.reason for o in outcomes if isinstance(o, Rejected)].count(Reason.INTERNAL) == 5


# -- as a process ------------------------------------------------------------


def toml(folder: Path, endpoint: str) -> str:
    camera = rendered.CAMERA
    return f"""
[camera]
source = "folder:{folder}"
rate_hz = 2.0
[intrinsics]
width_px = {camera.width}
height_px = {camera.height}
fx = {camera.fx}
fy = {camera.fy}
cx = {camera.cx}
cy = {camera.cy}
[map]
pack = "{rendered.store().pack.path}"
[link]
endpoint = "{endpoint}"
[matcher]
name = "structural"
[timing]
max_age_ms = 20000.0
"""


def test_process_tells_systemd_and_ends_on_sigterm(folder: Path, tmp_path: Path) -> None:
    wire = UdpWire()
    autopilot = HoveringAutopilot(wire)
    path = tmp_path / "config.toml"
    path.write_text(toml(folder, f"udpout:127.0.0.1:{wire.port}"), encoding="utf-8")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as supervisor:
        supervisor.bind(str(tmp_path / "notify"))
        supervisor.settimeout(20.0)
        process = subprocess.Popen(
            [sys.executable, "-m", "ortholoc_edge", "run", "--config", str(path)],
            env={**os.environ, "NOTIFY_SOCKET": str(tmp_path / "notify")},
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
        told: list[str] = []
        try:
            while "WATCHDOG=1" not in told:
                told.append(supervisor.recv(4096).decode())
            assert told[0] == "READY=1"
            wait_for(lambda: autopilot.messages("ODOMETRY"), "an estimate")
            started = time.monotonic()
            process.send_signal(signal.SIGTERM)
            out, err = process.communicate(timeout=5.0)
            assert time.monotonic() - started < 5.0
            while told[-1] != "STOPPING=1":
                told.append(supervisor.recv(4096).decode())
        finally:
            process.kill()
            process.communicate()
            autopilot.close()
    assert process.returncode == 0, err
    assert out == ""
    assert "Traceback" not in err
    assert {told_line.split("=")[0] for told_line in told} <= {"READY", "WATCHDOG", "STATUS", "STOPPING"}


def test_silent_without_systemd(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    for address in (None, "", "relative", str(tmp_path / "nobody")):
        if address is None:
            monkeypatch.delenv("NOTIFY_SOCKET", raising=False)
        else:
            monkeypatch.setenv("NOTIFY_SOCKET", address)
        systemd.notify("READY=1")
    name = f"ortholoc-test-{os.getpid()}"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as abstract:
        abstract.bind(f"\0{name}")
        abstract.settimeout(5.0)
        monkeypatch.setenv("NOTIFY_SOCKET", f"@{name}")
        systemd.notify("STATUS=flying")
        assert abstract.recv(100) == b"STATUS=flying"


# -- the slot ----------------------------------------------------------------


def test_latest_wins_and_the_others_are_counted() -> None:
    slot: LatestSlot[int] = LatestSlot()
    assert slot.take(0.0) is None
    for item in (1, 2, 3):
        slot.put(item)
    assert slot.replaced == 2
    assert slot.take(0.0) == 3
    assert slot.take(0.0) is None
    slot.put(4)
    assert (slot.take(0.0), slot.replaced) == (4, 2)


def test_slot_wakes_its_taker() -> None:
    slot: LatestSlot[str] = LatestSlot()
    got: list[str | None] = []
    taker = threading.Thread(target=lambda: got.append(slot.take(10.0)))
    started = time.monotonic()
    taker.start()
    slot.put("frame")
    taker.join(timeout=5.0)
    assert got == ["frame"]
    assert time.monotonic() - started < 5.0


@pytest.mark.parametrize("part", ["_herald", "_computer"])
def test_a_defect_of_the_reports_ends_no_flight(
    folder: Path, monkeypatch: pytest.MonkeyPatch, caplog: Any, part: str
) -> None:
    """It would be there again after the restart, and after each."""
    wire = UdpWire()
    autopilot = HoveringAutopilot(wire)
    daemon = Daemon(config(f"folder:{folder}", f"udpout:127.0.0.1:{wire.port}"))
    monkeypatch.setattr(daemon._reporter, part, None)
    try:
        with running(daemon):
            wait_for(lambda: daemon.statistics().get("report_errors", 0) >= 2, "two reports")
            wait_for(lambda: autopilot.messages("ODOMETRY"), "an estimate")
    finally:
        autopilot.close()
    assert caplog.text.count("AttributeError") == 1


class _Defective:
    """In place of whoever is told."""

    dropped = refused = 0
    accepts_commands = False

    def __getattr__(self, name: str) -> Any:
        raise ZeroDivisionError(f"{name} has a defect")


@pytest.mark.parametrize("whom", ["log", "bus", "page", "listener"])
def test_a_defect_of_one_who_is_told_keeps_no_other_from_it(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: Any, whom: str
) -> None:
    told: Counter[str] = Counter()
    daemon = Daemon(
        config(
            f"folder:{folder}", "udpout:127.0.0.1:9", log=LogOptions(folder=str(tmp_path)),
            page=PageOptions(enabled=True, listen="127.0.0.1:0"),
        ),
        on_outcome=lambda *_: _Defective().told if whom == "listener" else told.update(["listener"]),
    )  # fmt: skip
    reporter = daemon._reporter

    class Hearing:
        dropped = refused = 0
        accepts_commands = False

        def __init__(self, name: str) -> None:
            self._name = name

        def __getattr__(self, name: str) -> Any:
            return lambda *_: told.update([f"{self._name}.{name}"])

    try:
        with monkeypatch.context() as patch:
            for name in ("log", "bus", "page"):
                patch.setattr(reporter, f"_{name}", _Defective() if whom == name else Hearing(name))
            for number in range(3):
                reporter.publish(None, Rejected(number, Reason.BAD_FRAME, "cut short"))
            reporter.step(time.monotonic_ns())
    finally:
        daemon.close()
    expected = Counter(
        {"listener": 3, "log.put": 3, "bus.publish": 3 + 3, "page.put": 3, "page.tell": 1, "log.note": 1}
    )
    assert told == Counter({name: n for name, n in expected.items() if name.split(".")[0] != whom})
    statistics = daemon.statistics()
    assert statistics["rejected"] == 3 and int(statistics["report_errors"]) >= 3
    assert caplog.text.count("Traceback") == 1 and caplog.text.count("reporting to the") == 1


@pytest.mark.parametrize(("changes", "words"), [({"crs": None}, "no reference system"), ({"offsets": None}, "geoid")])
def test_a_pack_whose_positions_or_heights_mean_nothing_is_refused(
    changes: dict[str, None], words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Heights above the ellipsoid, taken for such above the sea, are 30 to 50 m wrong."""
    pack = rendered.store().pack
    silent = msgspec.structs.replace(pack.georeference.vertical, amsl_minus_map_m=None)
    georeference = dataclasses.replace(pack.georeference, vertical=silent, **changes)
    monkeypatch.setattr(Pack, "open", lambda *_: dataclasses.replace(pack, georeference=georeference))
    with pytest.raises(MapError, match=words):
        Daemon(config("folder:nowhere", "udpout:127.0.0.1:9"))


def test_each_life_begins_with_another_reset_counter(folder: Path) -> None:
    """Else the autopilot would take the first fix after a restart for a jump of the old chain."""

    class Later(SystemClock):
        def now_ns(self) -> int:
            return super().now_ns() + 3_000_000_000

    counters = []
    for clock in (SystemClock(), Later()):
        daemon = Daemon(config(f"folder:{folder}", "udpout:127.0.0.1:9"), clock=clock)
        counters.append(daemon._navigator.tracker.reset_counter)
        daemon._resources.close()
    assert 2 <= (counters[1] - counters[0]) % 256 <= 5
