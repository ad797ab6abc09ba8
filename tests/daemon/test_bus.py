"""What is published, asked and commanded over real zenoh sessions on loopback."""

from __future__ import annotations

import datetime
import ipaddress
import json
import queue
import re
import socket
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import jsonschema
import msgspec
import numpy as np
import pytest
import zenoh
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID

from ortholoc_edge.adapters import messages
from ortholoc_edge.adapters.bus import Bus, BusOptions, TlsOptions
from ortholoc_edge.adapters.commands import BusyError, Desk
from ortholoc_edge.adapters.messages import (
    JSON,
    MSGPACK,
    AutopilotMessage,
    Command,
    CommandReply,
    ConfigMessage,
    FixMessage,
    SearchFor,
    SetPrior,
    StatsMessage,
    fix_message,
    rejection_message,
)
from ortholoc_edge.errors import ConfigError, LinkError
from ortholoc_edge.geometry import rotation
from ortholoc_edge.geometry.camera import Camera
from ortholoc_edge.geometry.rigid import Rigid3
from ortholoc_edge.pipeline.frame import CameraMount
from ortholoc_edge.pipeline.outcome import Fix, Reason, Rejected
from ortholoc_edge.tiles.georeference import Georeference, VerticalDatum

GEOREFERENCE = Georeference(
    "EPSG:32632", VerticalDatum(kind="ellipsoid", ellipsoid_minus_map_m=0.0), (649_000.0, 5_318_000.0)
)
PLACE = (649_100.0, 5_318_100.0, 512.0)
# Grid north lies so far east of true north there.
CONVERGENCE_RAD = GEOREFERENCE.convergence_rad(PLACE[:2])


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as server:
        return int(server.getsockname()[1])


def a_fix(stamp_ns: int = 5) -> Fix:
    return Fix(
        stamp_ns=stamp_ns,
        map_from_camera=Rigid3(np.diag([1.0, -1.0, -1.0]), np.array(PLACE)),
        camera=Camera.from_focal(480, 360, 405.0),
        covariance=np.diag([1.0, 4.0, 9.0, 1e-4, 2e-4, 3e-4]),
        quality=0.5,
        matches=200,
        inliers=100,
        rms_px=1.5,
        adhop_accepted=True,
        query_px=np.zeros((100, 2)),
        points_map=np.zeros((100, 3)),
    )


def a_message(stamp_ns: int = 5) -> FixMessage:
    return fix_message(a_fix(stamp_ns), stamp_ns + 1000, GEOREFERENCE, CameraMount(Rigid3.identity()))


def listening(endpoint: str, **settings: Any) -> Any:
    """Another session, connected to the bus."""
    config = zenoh.Config()
    settings = {"mode": "client", "scouting/multicast/enabled": False, "connect/endpoints": [endpoint], **settings}
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    return zenoh.open(config)


def asked(session: Any, key: str, payload: bytes | None = None, encoding: str | None = None) -> list[Any]:
    """Replies as (is_ok, key, encoding, payload)."""
    found = []
    for reply in session.get(key, payload=payload, encoding=encoding, timeout=10.0):
        if reply.ok is not None:
            sample = reply.ok
            found.append((True, str(sample.key_expr), str(sample.encoding), sample.payload.to_bytes()))
        else:
            found.append((False, "", str(reply.err.encoding), reply.err.payload.to_bytes()))
    return found


class Flight:
    """Carries out commands as a daemon would, after what a test says."""

    def __init__(self) -> None:
        self.commands: list[Command] = []
        self.work: Callable[[Command], Any] = lambda command: CommandReply(
            command=messages.NAME_OF_COMMAND[type(command)], accepted=True
        )

    def __call__(self, command: Command) -> Any:
        self.commands.append(command)
        return self.work(command)


@pytest.fixture(scope="module")
def endpoint() -> str:
    return f"tcp/127.0.0.1:{free_port()}"


@pytest.fixture(scope="module")
def flight() -> Flight:
    return Flight()


@pytest.fixture(scope="module")
def bus(endpoint: str, flight: Flight) -> Iterator[Bus]:
    opened = Bus(BusOptions(enabled=True, vehicle="hawk", listen=(endpoint,), commands=True))
    opened.serve(
        {
            "config": lambda: ConfigMessage(config={"link": {"endpoint": "udp:h:1"}}),
            "stats": lambda: StatsMessage(stamp_ns=1, unix_ns=2, statistics={"fixes": 3, "gnss_apart_m": None}),
        },
        flight,
    )
    yield opened
    opened.close()


@pytest.fixture(scope="module")
def listener(bus: Bus, endpoint: str) -> Iterator[Any]:
    session = listening(endpoint)
    yield session
    session.close()


def published(listener: Any, key: str, publish: Callable[[], None]) -> Any:
    """The first sample of ``key``. Until the declaration has reached the publisher, nothing is sent: repeated, as
    frames are."""
    got: queue.Queue[Any] = queue.Queue()
    subscriber = listener.declare_subscriber(key, got.put)
    try:
        for _ in range(200):
            publish()
            try:
                return got.get(timeout=0.1)
            except queue.Empty:
                continue
        raise AssertionError(f"nothing arrived on {key}")
    finally:
        subscriber.undeclare()


# -- what is published ---------------------------------------------------------


def test_fix_and_rejection_arrive(bus: Bus, listener: Any) -> None:
    sample = published(listener, "ortholoc/hawk/*", lambda: bus.publish(a_message()))
    assert (str(sample.key_expr), str(sample.encoding)) == ("ortholoc/hawk/fix", JSON)
    got = msgspec.json.decode(sample.payload.to_bytes(), type=FixMessage)
    assert got == a_message()
    rejected = rejection_message(Rejected(10**9, Reason.MAP_NODATA, "nothing there", 0.0, 1.0), 7)
    sample = published(listener, "ortholoc/hawk/rejection", lambda: bus.publish(rejected))
    assert json.loads(sample.payload.to_bytes()) == {
        "stamp_ns": 10**9, "unix_ns": 7, "reason": "map_nodata", "detail": "nothing there", "measured": 0.0,
        "limit": 1.0, "timings_ms": {},
    }  # fmt: skip


def test_a_fix_on_the_earth() -> None:
    """Worked by hand: a camera that looks down with its top to grid north, 1.5 degrees east of true north."""
    sent = a_message()
    assert sent.crs == "EPSG:32632"
    camera = sent.camera
    back = GEOREFERENCE.map_from_geodetic(camera.lat_deg, camera.lon_deg, height_ellipsoid_m=512.0)
    assert np.allclose(back, PLACE, atol=1e-3)
    assert (camera.height_ellipsoid_m, camera.height_amsl_m) == (512.0, None)
    turn = rotation.from_quaternion(camera.quaternion_enu_wxyz)
    assert np.degrees(CONVERGENCE_RAD) == pytest.approx(1.49, abs=0.01)
    up_in_the_picture = turn @ [0.0, -1.0, 0.0]
    assert np.allclose(up_in_the_picture, [np.sin(CONVERGENCE_RAD), np.cos(CONVERGENCE_RAD), 0.0], atol=1e-9)
    assert np.allclose(turn @ [0.0, 0.0, 1.0], [0.0, 0.0, -1.0]), "it looks down"
    covariance = np.array(camera.covariance_enu)
    assert np.allclose(np.diag(covariance), [1.0, 4.0, 9.0, 1e-4, 2e-4, 3e-4], rtol=0.05)
    # 4 m² along grid north, which leans to the east.
    assert covariance[0, 1] == pytest.approx(3.0 * CONVERGENCE_RAD, rel=0.01)


def test_the_body_is_told_with_lever_arm_and_gimbal() -> None:
    """A camera two metres above the body's point in its own axes (z down), heading grid north."""
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    mount = CameraMount(Rigid3(turn, np.array([0.0, 0.0, -2.0])), (0.1, 0.2))
    sent = fix_message(a_fix(), 0, GEOREFERENCE, mount)
    assert sent.body is not None
    assert sent.body.height_ellipsoid_m == pytest.approx(510.0)
    forward = rotation.from_quaternion(sent.body.quaternion_enu_wxyz) @ [1.0, 0.0, 0.0]
    assert np.allclose(forward, [np.sin(CONVERGENCE_RAD), np.cos(CONVERGENCE_RAD), 0.0], atol=1e-9)
    covariance = np.array(sent.body.covariance_enu)
    # Two metres of lever times the tilts of the fix; then the gimbal's own errors on top of the attitude.
    assert np.diag(covariance)[:3] == pytest.approx([1.0 + 4 * 2e-4, 4.0 + 4 * 1e-4, 9.0], rel=0.01)
    assert np.diag(covariance)[3:] == pytest.approx([0.01 + 1e-4, 0.01 + 2e-4, 0.04 + 3e-4], rel=0.02)
    assert fix_message(a_fix(), 0, GEOREFERENCE, None).body is None


def test_what_became_of_the_fixes_arrives(bus: Bus, listener: Any) -> None:
    record = AutopilotMessage(
        stamp_ns=5, unix_ns=6, connected=True, fusion="ignored", fusion_since_s=2.5, fusion_reason="why", gnss="bad",
        gnss_since_s=None, gnss_apart_m=12.0, gnss_height_apart_m=None, latency_median_ms=300.0, latency_p99_ms=450.0,
        delay_advice="VISO_DELAY_MS = 4", on_vision=False,
    )  # fmt: skip
    sample = published(listener, "ortholoc/hawk/autopilot", lambda: bus.publish(record))
    assert json.loads(sample.payload.to_bytes()) == msgspec.to_builtins(record)


def test_thumbnails_at_their_rate(endpoint: str, bus: Bus, listener: Any) -> None:
    colour = np.zeros((480, 640, 3), np.uint8)
    colour[..., 0] = 250
    bus.publish_image(1, colour)
    assert asked(listener, "ortholoc/hawk/image") == [], "off by default"
    bus.retune(BusOptions(vehicle="hawk", listen=(endpoint,), commands=True, image_rate_hz=2.0, image_px=160))
    stamps = iter(range(0, 10**12, 100_000_000))
    sample = published(listener, "ortholoc/hawk/image", lambda: bus.publish_image(next(stamps), colour))
    assert str(sample.encoding) == "image/jpeg"
    small = cv2.imdecode(np.frombuffer(sample.payload.to_bytes(), np.uint8), cv2.IMREAD_COLOR)
    assert small.shape == (120, 160, 3)
    assert small[0, 0].argmax() == 2, "red, as OpenCV has it last"
    # Two a second of the frames' own time, and no picture of what is none.
    first = json.loads(sample.attachment.to_bytes())["stamp_ns"]
    bus.publish_image(first + 499_000_000, np.zeros((480, 640), np.uint8))
    bus.publish_image(first + 900_000_000, np.zeros((0, 0), np.uint8))
    ((_, _, _, latest),) = asked(listener, "ortholoc/hawk/image")
    assert latest == sample.payload.to_bytes()
    bus.publish_image(first + 900_000_000, np.zeros((480, 640), np.uint8))
    ((_, _, _, latest),) = asked(listener, "ortholoc/hawk/image")
    assert latest != sample.payload.to_bytes()


def test_msgpack_says_the_same_in_less(listener: Any) -> None:
    port = free_port()
    bus = Bus(BusOptions(vehicle="owl", listen=(f"tcp/127.0.0.1:{port}",), encoding="msgpack"))
    session = listening(f"tcp/127.0.0.1:{port}")
    try:
        sample = published(session, "ortholoc/owl/fix", lambda: bus.publish(a_message()))
    finally:
        session.close()
        bus.close()
    assert str(sample.encoding) == MSGPACK
    payload = sample.payload.to_bytes()
    assert msgspec.msgpack.decode(payload, type=FixMessage) == a_message()
    # Real figures have digits.
    figures = np.random.default_rng(1).normal(size=(6, 6)).tolist()
    pose = msgspec.structs.replace(a_message().camera, covariance_enu=figures)
    real = msgspec.structs.replace(a_message(), covariance=figures, camera=pose, body=pose)
    assert len(msgspec.msgpack.encode(real)) < 0.65 * len(msgspec.json.encode(real))


def test_liveliness_token_comes_and_goes() -> None:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    bus = Bus(BusOptions(vehicle="owl", listen=(endpoint,)))
    session = listening(endpoint)
    got: queue.Queue[tuple[str, bool]] = queue.Queue()
    session.liveliness().declare_subscriber(
        "ortholoc/*/alive",
        lambda sample: got.put((str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT)),
        history=True,
    )
    assert got.get(timeout=10.0) == ("ortholoc/owl/alive", True)
    bus.close()
    assert got.get(timeout=10.0) == ("ortholoc/owl/alive", False)
    session.close()
    # What is said after the end is counted, not raised: the flight goes on.
    bus.publish(rejection_message(Rejected(1, Reason.LATE), 1))
    assert bus.dropped == 1


# -- what is asked -------------------------------------------------------------


def test_the_latest_is_told_to_who_asks(bus: Bus, listener: Any) -> None:
    for stamp_ns in (7, 8):
        bus.publish(a_message(stamp_ns))
    ((is_ok, key, encoding, payload),) = asked(listener, "ortholoc/hawk/fix")
    assert (is_ok, key, encoding) == (True, "ortholoc/hawk/fix", JSON)
    assert msgspec.json.decode(payload, type=FixMessage).stamp_ns == 8
    assert asked(listener, "ortholoc/dove/fix") == []
    assert asked(listener, "ortholoc/hawk/health") == [], "none was published yet"
    answers = {key: json.loads(payload) for _, key, form, payload in asked(listener, "ortholoc/hawk/*") if form == JSON}
    assert answers["ortholoc/hawk/config"] == {"config": {"link": {"endpoint": "udp:h:1"}}}
    assert answers["ortholoc/hawk/stats"]["statistics"] == {"fixes": 3, "gnss_apart_m": None}
    assert "ortholoc/hawk/fix" in answers


# -- commands ------------------------------------------------------------------

PRIOR = {
    "lat_deg": 47.0, "lon_deg": 8.0, "height_amsl_m": 500.0, "sigma_horizontal_m": 30.0, "sigma_vertical_m": 5.0,
}  # fmt: skip


def reply_of(found: list[Any]) -> tuple[bool, CommandReply]:
    ((is_ok, _, encoding, payload),) = found
    decode = msgspec.msgpack.decode if encoding == MSGPACK else msgspec.json.decode
    return is_ok, decode(payload, type=CommandReply)


@pytest.mark.parametrize("encoding", [None, JSON, MSGPACK])
def test_a_command_is_carried_out_and_answered(
    bus: Bus, listener: Any, flight: Flight, encoding: str | None
) -> None:
    flight.commands.clear()
    encode = msgspec.msgpack.encode if encoding == MSGPACK else msgspec.json.encode
    found = asked(listener, "ortholoc/hawk/command/set_prior", encode({**PRIOR, "vehicle": "hawk"}), encoding)
    assert found[0][2] == (encoding or JSON), "answered as it was asked"
    assert reply_of(found) == (True, CommandReply(command="set_prior", accepted=True))
    assert flight.commands == [SetPrior(**PRIOR, vehicle="hawk")]
    assert reply_of(asked(listener, "ortholoc/hawk/command/pause"))[1].accepted, "needs no payload"


def test_a_polygon_of_most_corners_with_all_digits_is_taken(bus: Bus, listener: Any, flight: Flight) -> None:
    flight.commands.clear()
    ring = tuple((-47.123456789012345 - 1e-5 * i, -117.12345678901234 - 1e-5 * i) for i in range(100))
    found = asked(listener, "ortholoc/hawk/command/search", json.dumps({"polygon": ring}, indent=4).encode())
    assert reply_of(found) == (True, CommandReply(command="search", accepted=True))
    assert flight.commands == [SearchFor(polygon=ring)]
    asked(listener, "ortholoc/hawk/command/search")
    assert flight.commands[1:] == [SearchFor(polygon=None)]


def test_what_takes_long_is_done_away_from_the_frame_path(bus: Bus, listener: Any, flight: Flight) -> None:
    done_by: list[str] = []

    def write() -> CommandReply:
        done_by.append(threading.current_thread().name)
        return CommandReply(command="snapshot", accepted=True, path="/x.png")

    before, flight.work = flight.work, lambda command: write
    try:
        assert reply_of(asked(listener, "ortholoc/hawk/command/snapshot"))[1].path == "/x.png"
    finally:
        flight.work = before
    assert done_by == ["bus-commands"]


HOSTILE: dict[str, tuple[str, bytes, str | None, str]] = {
    "garbage": ("set_prior", bytes(range(256)), None, "payload is no SetPrior"),
    "garbage as MessagePack": ("set_prior", b"\xc1\xff\x00garbage", MSGPACK, "payload is no SetPrior"),
    "no UTF-8": ("relocalize", b'{"vehicle": "\xff\xfe"}', None, "payload is no Relocalize"),
    "empty": ("set_prior", b"", None, "required field `lat_deg`"),
    "huge": ("set_prior", b" " * 200_000, None, "200000 bytes, 16384 are allowed"),
    "deep": ("pause", b"[" * 4000, None, "payload is no Pause"),
    "NaN in JSON": ("set_prior", json.dumps({**PRIOR, "lat_deg": float("nan")}).encode(), None, "no SetPrior"),
    "NaN": ("set_prior", msgspec.msgpack.encode({**PRIOR, "lat_deg": float("nan")}), MSGPACK, "`float` >= -90.0"),
    "infinite": (
        "set_prior", msgspec.msgpack.encode({**PRIOR, "sigma_vertical_m": float("inf")}), MSGPACK, "sigma_vertical_m",
    ),
    "out of range": ("set_prior", json.dumps({**PRIOR, "lat_deg": 91.0}).encode(), None, r"<= 90.*lat_deg"),
    "of no width": ("set_prior", json.dumps({**PRIOR, "sigma_horizontal_m": 0}).encode(), None, "sigma_horizontal_m"),
    "wrong type": ("set_prior", json.dumps({**PRIOR, "lat_deg": "47"}).encode(), None, r"got `str`.*lat_deg"),
    "no object": ("resume", b"[1, 2]", None, "got `array`"),
    "unknown field": ("relocalize", b'{"speed": 3}', None, "unknown field `speed`"),
    "another encoding": ("pause", b"{}", "application/xml", "'application/xml' is not understood"),
    "another vehicle": ("pause", b'{"vehicle": "dove"}', None, "meant for 'dove', this is 'hawk'"),
    "two corners": ("search", b'{"polygon": [[47, 8], [47, 8.1]]}', None, "length >= 3.*polygon"),
    "101 corners": ("search", json.dumps({"polygon": [[47, 8]] * 101}).encode(), None, "length <= 100.*polygon"),
    "NaN in a corner": (
        "search", msgspec.msgpack.encode({"polygon": [(47.0, 8.0), (float("nan"), 8.1), (47.1, 8.1)]}), MSGPACK,
        "`float` >= -90.0",
    ),
    "a corner of three": ("search", b'{"polygon": [[47, 8, 500], [47, 8.1, 500], [47.1, 8.1, 500]]}', None, "length 2"),
    "no command": ("explode", b"{}", None, "'explode' is no command"),
}  # fmt: skip


@pytest.mark.parametrize("case", HOSTILE)
def test_hostile_payloads_get_an_error(bus: Bus, listener: Any, flight: Flight, case: str) -> None:
    name, payload, encoding, words = HOSTILE[case]
    flight.commands.clear()
    refused = bus.refused
    is_ok, reply = reply_of(asked(listener, f"ortholoc/hawk/command/{name}", payload, encoding))
    assert not is_ok
    assert (reply.command, reply.accepted) == (name, False)
    assert reply.remedy
    assert re.search(words, reply.reason), reply.reason
    assert flight.commands == []
    assert bus.refused == refused + 1


@pytest.mark.parametrize("key", ["ortholoc/*/command/pause", "ortholoc/hawk/command/*", "ortholoc/**"])
def test_a_command_to_many_is_refused(bus: Bus, listener: Any, flight: Flight, key: str) -> None:
    """Whoever pauses one vehicle must not pause a squadron by a slip of the key."""
    flight.commands.clear()
    errors = [payload for is_ok, _, _, payload in asked(listener, key, b"{}") if not is_ok]
    assert "may be several vehicles" in json.loads(errors[0])["reason"]
    assert flight.commands == []


def test_a_defect_is_no_end_of_the_service(bus: Bus, listener: Any, flight: Flight) -> None:
    before, flight.work = flight.work, lambda command: 1 // 0
    try:
        assert [payload for is_ok, _, _, payload in asked(listener, "ortholoc/hawk/command/pause") if is_ok] == []
    finally:
        flight.work = before
    assert reply_of(asked(listener, "ortholoc/hawk/command/pause"))[1].accepted


def test_a_peer_that_sends_megabytes_is_cut_off(bus: Bus, endpoint: str, listener: Any) -> None:
    """It must not fill the memory of the one that flies; others are still served."""
    rude = listening(endpoint)
    try:
        asked_at = time.monotonic()
        replies = list(rude.get("ortholoc/hawk/command/pause", payload=b"x" * (4 << 20), timeout=1.0))
        assert not any(reply.ok for reply in replies)
        assert time.monotonic() - asked_at < 10.0
    finally:
        rude.close()
    assert reply_of(asked(listener, "ortholoc/hawk/command/pause"))[1].accepted


def test_commands_are_refused_unless_enabled(bus: Bus, endpoint: str, listener: Any, flight: Flight) -> None:
    flight.commands.clear()
    bus.retune(BusOptions(vehicle="hawk", listen=(endpoint,)))
    try:
        is_ok, reply = reply_of(asked(listener, "ortholoc/hawk/command/pause"))
    finally:
        bus.retune(BusOptions(vehicle="hawk", listen=(endpoint,), commands=True))
    assert is_ok and not reply.accepted
    assert "not enabled" in reply.reason and "[bus] commands = true" in reply.remedy
    assert flight.commands == []


# -- from thread to thread -----------------------------------------------------


def test_the_desk_hands_over_and_gives_back() -> None:
    desk, served_by = Desk(), []

    def work() -> str:
        served_by.append(threading.current_thread().name)
        return "done"

    answers: list[Any] = []
    asker = threading.Thread(target=lambda: answers.append(desk.ask(work, 10.0)), name="asker")
    asker.start()
    while not answers and asker.is_alive():
        desk.serve()
    asker.join()
    assert answers == ["done"]
    assert served_by == [threading.current_thread().name]


def test_what_was_not_begun_in_time_is_never_done() -> None:
    """Who was told that it is refused must not see it happen later."""
    desk, done = Desk(), []
    with pytest.raises(BusyError, match="not begun within"):
        desk.ask(lambda: done.append(1), 0.01)
    desk.serve()
    assert done == []
    for _ in range(3):
        with pytest.raises(BusyError):
            desk.ask(lambda: done.append(1), 0.001)
    with pytest.raises(BusyError):
        desk.ask(lambda: done.append(1), 0.001)
    with pytest.raises(BusyError, match="wait already"):
        desk.ask(lambda: done.append(1), 10.0)
    desk.serve()
    assert done == []


def test_a_task_that_fails_fails_where_it_was_asked_for() -> None:
    desk, failures = Desk(), []

    def ask() -> None:
        try:
            desk.ask(lambda: 1 // 0, 10.0)
        except ZeroDivisionError as error:
            failures.append(error)

    asker = threading.Thread(target=ask)
    asker.start()
    while asker.is_alive():
        desk.serve()
    assert len(failures) == 1


# -- the schema ----------------------------------------------------------------


def test_messages_are_as_the_schema_says() -> None:
    """And a foreign JSON Schema implementation understands it."""
    schema = messages.schema()
    jsonschema.Draft202012Validator.check_schema(schema)

    def check(reference: dict[str, str], content: Any) -> None:
        jsonschema.validate(content, {"$defs": schema["$defs"], **reference})

    check(schema["x-published"]["fix"], json.loads(msgspec.json.encode(a_message())))
    check(schema["x-commands"]["command/set_prior"]["request"], PRIOR)
    check(schema["x-commands"]["command/set_prior"]["reply"], {"command": "set_prior", "accepted": True})
    check(schema["x-commands"]["command/search"]["request"], {"polygon": [[47, 8], [47, 8.1], [47.1, 8.1]]})
    check(schema["x-commands"]["command/search"]["request"], {})
    with pytest.raises(jsonschema.ValidationError):
        check(schema["x-commands"]["command/search"]["request"], {"polygon": [[47, 8], [47, 8.1], [97.1, 8.1]]})
    with pytest.raises(jsonschema.ValidationError):
        check(schema["x-commands"]["command/set_prior"]["request"], {**PRIOR, "lat_deg": 91})
    with pytest.raises(jsonschema.ValidationError):
        check(schema["x-published"]["fix"], {"stamp_ns": 1})


# -- endpoints, TLS and access control -----------------------------------------


def test_a_port_that_is_taken_is_named_and_waited_for(caplog: pytest.LogCaptureFixture) -> None:
    """What died a second ago may still hold it, and a restart in flight must not end there."""
    holder = socket.create_server(("127.0.0.1", 0))
    endpoint = f"tcp/127.0.0.1:{holder.getsockname()[1]}"
    bus = Bus(BusOptions(enabled=True, vehicle="owl", listen=(endpoint,)))
    try:
        assert re.search(r"127\.0\.0\.1.*\[bus\].*again and again", caplog.text)
        bus.publish(a_message())
        holder.close()
        settings = {"connect/timeout_ms": 20_000, "connect/exit_on_failure": True}
        session = listening(endpoint, **settings)
        try:
            assert published(session, "ortholoc/owl/fix", lambda: bus.publish(a_message()))
        finally:
            session.close()
    finally:
        bus.close()


@pytest.mark.parametrize("options", [{"listen": ("nonsense",)}, {"listen": (), "connect": ("nonsense",)}])
def test_what_is_no_endpoint(options: dict[str, Any]) -> None:
    with pytest.raises(ConfigError, match=r"nonsense.*\[bus\]"):
        Bus(BusOptions(enabled=True, **options))


@pytest.mark.parametrize("vehicle", ["", "a/b", "*", "a b", "$*", "a?"])
def test_vehicle_is_one_plain_word(vehicle: str) -> None:
    with pytest.raises(msgspec.ValidationError, match=r"\$\.vehicle"):
        msgspec.convert({"vehicle": vehicle}, BusOptions)


def test_a_router_that_is_not_there_is_waited_for() -> None:
    """The flight begins without it, and it is served when it comes."""
    port = free_port()
    begun = time.monotonic()
    bus = Bus(BusOptions(vehicle="owl", listen=(), connect=(f"tcp/127.0.0.1:{port}",)))
    assert time.monotonic() - begun < 5.0
    router = zenoh.Config()
    for key, value in {
        "mode": "router", "scouting/multicast/enabled": False, "listen/endpoints": [f"tcp/127.0.0.1:{port}"],
    }.items():  # fmt: skip
        router.insert_json5(key, json.dumps(value))
    session = zenoh.open(router)
    try:
        assert published(session, "ortholoc/owl/fix", lambda: bus.publish(a_message()))
    finally:
        session.close()
        bus.close()


@pytest.fixture(scope="module")
def certificates(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An authority, and certificates of it for 127.0.0.1: the vehicle's, a ground station's and a guest's."""
    folder = tmp_path_factory.mktemp("tls")
    now = datetime.datetime.now(datetime.UTC)
    keys = {name: ec.generate_private_key(ec.SECP256R1()) for name in ("ca", "vehicle", "station", "guest")}
    names = {name: x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)]) for name in keys}
    for name, key in keys.items():
        builder = (
            x509.CertificateBuilder()
            .subject_name(names[name])
            .issuer_name(names["ca"])
            .public_key(key.public_key())
            .serial_number(x509.random_serial_number())
            .not_valid_before(now - datetime.timedelta(days=1))
            .not_valid_after(now + datetime.timedelta(days=1))
            .add_extension(x509.BasicConstraints(ca=name == "ca", path_length=None), critical=True)
            .add_extension(
                x509.SubjectAlternativeName([x509.IPAddress(ipaddress.ip_address("127.0.0.1"))]), critical=False
            )
        )
        certificate = builder.sign(keys["ca"], hashes.SHA256())
        (folder / f"{name}.pem").write_bytes(certificate.public_bytes(serialization.Encoding.PEM))
        (folder / f"{name}.key").write_bytes(
            key.private_bytes(
                serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
            )
        )
    return folder


READ = {
    "id": "read", "permission": "allow", "flows": ["ingress", "egress"], "key_exprs": ["ortholoc/*/*"],
    "messages": ["put", "reply", "query", "declare_subscriber", "declare_queryable"],
}  # fmt: skip
COMMAND = {
    "id": "command", "permission": "allow", "flows": ["ingress", "egress"], "key_exprs": ["ortholoc/*/command/*"],
    "messages": ["query", "reply", "declare_queryable"],
}  # fmt: skip


def test_with_mutual_tls_certificates_say_who_may_what(certificates: Path, tmp_path: Path) -> None:
    """As docs/bus.md has it: without one nobody is served, a guest reads, the ground station commands."""
    access = tmp_path / "access.json5"
    access.write_text(
        json.dumps(
            {
                "access_control": {
                    "enabled": True,
                    "default_permission": "deny",
                    "rules": [READ, COMMAND],
                    "subjects": [{"id": "everybody"}, {"id": "station", "cert_common_names": ["station"]}],
                    "policies": [
                        {"rules": ["read"], "subjects": ["everybody"]},
                        {"rules": ["command"], "subjects": ["station"]},
                    ],
                }
            }
        ),
        encoding="utf-8",
    )
    endpoint = f"tls/127.0.0.1:{free_port()}"
    tls = TlsOptions(
        certificate=str(certificates / "vehicle.pem"), private_key="vehicle.key", root_ca="ca.pem", mutual=True,
    )  # fmt: skip
    options = BusOptions(vehicle="owl", listen=(endpoint,), tls=tls, commands=True, config=str(access))
    bus = Bus(options, credentials=certificates)
    flight = Flight()
    bus.serve({}, flight)
    settings: dict[str, Any] = {"transport/link/tls/root_ca_certificate": str(certificates / "ca.pem")}
    try:
        with pytest.raises(zenoh.ZError):
            listening(endpoint, **settings, **{"connect/timeout_ms": 500})
        for name in ("guest", "station"):
            known = listening(
                endpoint,
                **settings,
                **{
                    "transport/link/tls/enable_mtls": True,
                    "transport/link/tls/connect_certificate": str(certificates / f"{name}.pem"),
                    "transport/link/tls/connect_private_key": str(certificates / f"{name}.key"),
                },
            )
            try:
                assert published(known, "ortholoc/owl/fix", lambda: bus.publish(a_message()))
                answers = asked(known, "ortholoc/owl/command/pause")
            finally:
                known.close()
            assert [is_ok for is_ok, *_ in answers] == ([True] if name == "station" else [])
        assert len(flight.commands) == 1
    finally:
        bus.close()


@pytest.mark.parametrize(
    ("tls", "words"),
    [
        ({"certificate": "a", "private_key": "b"}, r"\[bus.tls\] certificate: 'a' names a systemd credential"),
        ({"root_ca": "/no/such.pem"}, r"\[bus.tls\] root_ca: /no/such.pem is no file"),
    ],
)
def test_certificates_that_are_not_there(tls: dict[str, Any], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        Bus(BusOptions(listen=(f"tls/127.0.0.1:{free_port()}",), tls=TlsOptions(**tls)))


def test_a_key_that_is_none_is_not_taken_for_a_port_in_use(certificates: Path, tmp_path: Path) -> None:
    """No waiting mends it."""
    (tmp_path / "wrong.key").write_text("no key", encoding="utf-8")
    tls = TlsOptions(certificate=str(certificates / "vehicle.pem"), private_key=str(tmp_path / "wrong.key"))
    with pytest.raises(LinkError, match="look at its certificates"):
        Bus(BusOptions(enabled=True, listen=(f"tls/127.0.0.1:{free_port()}",), tls=tls)).close()


@pytest.mark.parametrize("tls", [{"certificate": "a"}, {"private_key": "a"}, {"mutual": True}, {"roots": "a"}])
def test_tls_that_is_half_set(tls: dict[str, Any]) -> None:
    with pytest.raises(msgspec.ValidationError, match=r"\$\.tls"):
        msgspec.convert({"tls": tls}, BusOptions)


def test_the_documented_access_control_lets_read_and_not_command(tmp_path: Path) -> None:
    """config/zenoh-access.json5, as docs/bus.md has it."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    source = Path(__file__).resolve().parents[2] / "config" / "zenoh-access.json5"
    bus = Bus(BusOptions(vehicle="owl", listen=(endpoint,), commands=True, config=str(source)))
    flight = Flight()
    bus.serve({}, flight)
    session = listening(endpoint)
    try:
        assert published(session, "ortholoc/owl/fix", lambda: bus.publish(a_message()))
        assert [key for _, key, _, _ in asked(session, "ortholoc/owl/fix")] == ["ortholoc/owl/fix"]
        assert asked(session, "ortholoc/owl/command/pause") == []
        assert flight.commands == []
    finally:
        session.close()
        bus.close()
    broken = tmp_path / "broken.json5"
    broken.write_text("{ nonsense", encoding="utf-8")
    with pytest.raises(ConfigError, match=r"broken\.json5 can't be used"):
        Bus(BusOptions(listen=(), config=str(broken)))
