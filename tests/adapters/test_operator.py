"""Positions that a ground station gives by MAVLink: what is taken, what is answered, and when."""

from __future__ import annotations

import math
import time
from collections import Counter
from concurrent.futures import Future
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from replay import rendered

from ortholoc_edge.adapters.mavlink.codec import FrameParser, dialect
from ortholoc_edge.adapters.mavlink.operator import GivenPlace, OperatorDesk
from ortholoc_edge.daemon import Daemon

from .fake_autopilot import UdpWire
from .hovering import PLACE, TRUTH, HoveringAutopilot, config, running, wait_for

S = 1_000_000_000
OURS = 7, 197
ESTIMATE = dialect.MAV_CMD_EXTERNAL_POSITION_ESTIMATE
ACCEPTED, REJECTED, DENIED, FAILED = (
    dialect.MAV_RESULT_ACCEPTED, dialect.MAV_RESULT_TEMPORARILY_REJECTED, dialect.MAV_RESULT_DENIED,
    dialect.MAV_RESULT_FAILED,
)  # fmt: skip


def command_int(lat=47.0, lon=8.0, height=math.nan, sigma=20.0, age=0.0, frame=0, to=OURS, command=ESTIMATE):
    return dialect.MAVLink_command_int_message(
        *to, frame, command, 0, 0, 12.0, age, sigma, 0.0, round(lat * 1e7), round(lon * 1e7), height
    )


def command_long(lat=47.0, lon=8.0, height=math.nan, sigma=20.0, age=0.0, to=OURS):
    return dialect.MAVLink_command_long_message(*to, ESTIMATE, 0, 12.0, age, sigma, 0.0, lat, lon, height)


def framed(message, sender=(255, 190)) -> bytes:
    return bytes(message.pack(dialect.MAVLink(None, *sender)))


def heard(message, sender=(255, 190)):
    (found,) = FrameParser().feed(framed(message, sender), 0)
    return found


class Frames:
    """In place of the frame path."""

    def __init__(self) -> None:
        self.left: list[tuple[GivenPlace, Future[bool]]] = []
        self.full = False

    def __call__(self, place: GivenPlace) -> Future[bool] | None:
        if self.full:
            return None
        self.left.append((place, Future()))
        return self.left[-1][1]


@pytest.fixture
def frames() -> Frames:
    return Frames()


@pytest.fixture
def desk(frames: Frames) -> OperatorDesk:
    desk = OperatorDesk(Counter())
    desk.leave = frames
    return desk


def results(desk: OperatorDesk, now_ns: int) -> list[tuple[int, int, int]]:
    acks = desk.poll(now_ns)
    assert all(ack.command == ESTIMATE for ack in acks)
    return [(ack.target_system, ack.target_component, ack.result) for ack in acks]


@pytest.mark.parametrize("answer", [(True, ACCEPTED), (False, DENIED), (ValueError("x"), FAILED)])
def test_the_answer_waits_for_the_frame_path(desk: OperatorDesk, frames: Frames, answer: tuple[Any, int]) -> None:
    desk.take(heard(command_int(47.1, 8.2, age=0.5)), 0)
    assert results(desk, S) == []
    ((place, future),) = frames.left
    assert place == GivenPlace(47.1, 8.2, None, 20.0, 0.5)
    said, result = answer
    _ = future.set_exception(said) if isinstance(said, Exception) else future.set_result(said)
    assert results(desk, 2 * S) == [(255, 190, result)]
    assert results(desk, 3 * S) == [], "once"


def test_what_the_frame_path_does_not_come_to_is_withdrawn(desk: OperatorDesk, frames: Frames) -> None:
    desk.take(heard(command_int()), 0)
    desk.take(heard(command_int()), S)
    assert results(desk, 5 * S) == [], "the second is the first once more"
    assert results(desk, 6 * S) == [(255, 190, REJECTED)]
    assert [future.cancelled() for _, future in frames.left] == [True]


def test_another_place_of_the_same_sender_does_not_get_the_answer_of_the_first(
    desk: OperatorDesk, frames: Frames
) -> None:
    desk.take(heard(command_int(47.0)), 0)
    desk.take(heard(command_int(47.5)), 1)
    assert results(desk, 2) == [(255, 190, REJECTED)]
    frames.left[0][1].set_result(True)
    assert results(desk, 3) == [(255, 190, ACCEPTED)]
    assert [place.lat_deg for place, _ in frames.left] == [47.0]


def test_one_at_a_time_and_none_in_a_flood(desk: OperatorDesk, frames: Frames) -> None:
    desk.take(heard(command_int()), 0)
    desk.take(heard(command_int(), sender=(254, 190)), 1)
    assert results(desk, 2) == [(254, 190, REJECTED)]
    frames.left[0][1].set_result(True)
    assert results(desk, 3) == [(255, 190, ACCEPTED)]
    for number in range(100):
        desk.take(heard(command_int()), 4 + number)
    assert len(frames.left) == 1
    assert len(results(desk, 200)) == 4, "not each of them answered"
    frames.full = True
    desk.take(heard(command_int()), 2 * S)
    assert results(desk, 2 * S) == [(255, 190, REJECTED)]


@pytest.mark.parametrize(
    "message",
    [
        command_int(lat=90.1), command_int(lon=180.1), command_int(lat=214.7483647), command_int(sigma=-1.0),
        command_int(sigma=0.0), command_int(sigma=math.inf), command_int(age=math.nan), command_int(age=-1.0),
        command_int(age=1e9), command_int(frame=dialect.MAV_FRAME_LOCAL_NED), command_long(lat=math.nan),
        command_long(lon=math.nan), command_long(lat=math.inf), command_long(lon=-181.0),
    ],
)  # fmt: skip
def test_what_cannot_be_meant_is_denied(desk: OperatorDesk, frames: Frames, message: Any) -> None:
    desk.take(heard(message), 0)
    assert results(desk, 1) == [(255, 190, DENIED)]
    assert frames.left == []


@pytest.mark.parametrize(
    ("message", "height_m", "sigma_m"),
    [
        (command_int(height=500.0), 500.0, 20.0),
        (command_int(height=0.0), None, 20.0),
        (command_int(height=50.0, frame=dialect.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT), None, 20.0),
        (command_int(height=math.inf, sigma=math.nan), None, None),
        (command_long(height=500.0), 500.0, 20.0),
    ],
)
def test_height_and_sigma_may_be_missing(
    desk: OperatorDesk, frames: Frames, message: Any, height_m: float | None, sigma_m: float | None
) -> None:
    desk.take(heard(message), 0)
    ((place, _),) = frames.left
    assert (place.height_amsl_m, place.sigma_m) == (height_m, sigma_m)
    assert (place.lat_deg, place.lon_deg) == (47.0, 8.0)


# -- the daemon ----------------------------------------------------------------


@pytest.mark.parametrize("enabled", [True, False])
def test_a_ground_station_says_where_the_vehicle_is(tmp_path: Path, enabled: bool) -> None:
    """Through the autopilot, which hands on what is addressed to us."""
    photo = rendered.write_picture(tmp_path / "photo_000.jpg", rendered.picture(TRUTH))
    for number in range(1, 200):
        photo.with_name(f"photo_{number:03d}.jpg").hardlink_to(photo)
    autopilot = HoveringAutopilot(UdpWire())
    made = config(f"folder:{tmp_path}", f"udpout:127.0.0.1:{autopilot.wire.port}")
    made = msgspec.structs.replace(made, link=msgspec.structs.replace(made.link, accept_positions=enabled))
    daemon = Daemon(made)
    given: list[Any] = []
    give = daemon.navigator.give
    daemon.navigator.give = lambda order: (given.append(order), give(order))[1]

    def acks() -> list[tuple[int, int, int]]:
        found = [m for m in autopilot.messages("COMMAND_ACK") if m.command == ESTIMATE]
        return [(m.target_system, m.target_component, m.result) for m in found]

    def send(message: Any, count: int) -> list[tuple[int, int, int]]:
        autopilot.wire.write(framed(message))
        if not enabled:
            time.sleep(0.5)
            return acks()
        return list(wait_for(lambda: len(acks()) >= count and acks(), "an answer"))

    here = PLACE.lat_deg, PLACE.lon_deg
    try:
        with running(daemon):
            wait_for(lambda: daemon.link.connected() and daemon.link.state_at(time.monotonic_ns()).origin, "an origin")
            wait_for(lambda: daemon.statistics().get("fixes"), "a fix")
            for to in ((0, 0), (7, 0), (0, 197), (8, 197), (7, 198), (7, 1)):
                autopilot.wire.write(framed(command_int(*here, to=to)))
            autopilot.wire.write(framed(command_int(*here, command=dialect.MAV_CMD_DO_SET_HOME)))
            first = send(command_int(*here, sigma=math.nan), 1)
            time.sleep(1.1)
            both = send(command_int(here[0] + 1.0, here[1]), 2)
            texts = [str(m.text) for m in autopilot.messages("STATUSTEXT")]
    finally:
        autopilot.close()
    if not enabled:
        assert (both, given) == ([], [])
        return
    assert first == [(255, 190, ACCEPTED)]
    assert both == [(255, 190, ACCEPTED), (255, 190, DENIED)]
    (order,) = given
    assert np.linalg.norm(np.subtract(order.position_map_m, TRUTH.translation)) < 3.0, "and the autopilot's height"
    assert order.sigma_m == (made.tracker.lost_sigma_m, 30.0)
    assert any(text.startswith("OrthoLoC: position refused: the position is") for text in texts)
