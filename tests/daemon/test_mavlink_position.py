"""A ground station says over MAVLink where the vehicle is: what is heard, refused and answered."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import cv2
import pytest
from adapters.fake_autopilot import UdpWire, dialect
from adapters.hovering import PLACE, TRUTH, HoveringAutopilot, config, running, wait_for
from msgspec import structs
from replay import rendered

from ortholoc_edge.adapters.mavlink.options import LinkOptions
from ortholoc_edge.adapters.mavlink.protocol import LinkProtocol
from ortholoc_edge.adapters.mavlink.requests import PositionRequest, position_request
from ortholoc_edge.daemon import Daemon
from ortholoc_edge.pipeline.finder import SearchOptions
from ortholoc_edge.pipeline.outcome import Fix, Outcome

NAN = math.nan
COMMAND = dialect.MAV_CMD_EXTERNAL_POSITION_ESTIMATE
ACCEPTED, DENIED = dialect.MAV_RESULT_ACCEPTED, dialect.MAV_RESULT_DENIED


def command_int(**changes: Any) -> Any:
    fields = {
        "target_system": 7, "target_component": 197, "frame": 0, "command": COMMAND, "current": 0, "autocontinue": 0,
        "param1": 0.0, "param2": 0.0, "param3": 10.0, "param4": NAN, "x": 505_000_000, "y": 72_500_000, "z": NAN,
    }  # fmt: skip
    return sent(dialect.MAVLink_command_int_message(**{**fields, **changes}))


def command_long(**changes: Any) -> Any:
    fields = {
        "target_system": 7, "target_component": 197, "command": COMMAND, "confirmation": 0, "param1": 0.0,
        "param2": 0.0, "param3": 10.0, "param4": NAN, "param5": 50.5, "param6": 7.25, "param7": NAN,
    }  # fmt: skip
    return sent(dialect.MAVLink_command_long_message(**{**fields, **changes}))


def sent(message: Any) -> Any:
    """As it comes off the wire, of a ground station."""
    station = dialect.MAVLink(None, 255, 190)
    [received] = dialect.MAVLink(None, 0, 0).parse_buffer(message.pack(station))
    return received


def test_a_position_that_is_meant_for_us() -> None:
    assert position_request(command_int(), 7, 197) == PositionRequest(50.5, 7.25, 10.0, 255, 190)
    by_long = position_request(command_long(), 7, 197)
    assert by_long is not None
    assert (by_long.lat_deg, by_long.lon_deg) == (50.5, 7.25)
    # Nothing said of how sure it is, and surer than anybody can be.
    assert position_request(command_int(param3=NAN), 7, 197) == PositionRequest(50.5, 7.25, 50.0, 255, 190)
    assert position_request(command_int(param3=0.0), 7, 197) == PositionRequest(50.5, 7.25, 1.0, 255, 190)


@pytest.mark.parametrize(
    "changes",
    [
        {"command": 400}, {"target_system": 8}, {"target_component": 1}, {"target_component": 0}, {"target_system": 0},
    ],
)  # fmt: skip
def test_what_is_not_for_us_is_left_to_others(changes: dict[str, int]) -> None:
    assert position_request(command_int(**changes), 7, 197) is None
    assert position_request(command_long(**changes), 7, 197) is None


def test_before_our_id_is_known_nothing_is_for_us() -> None:
    assert position_request(command_int(target_system=0), 0, 197) is None


@pytest.mark.parametrize(
    "message",
    [
        command_int(x=2**31 - 1), command_int(y=2**31 - 1), command_int(x=900_000_001), command_int(y=-1_800_000_001),
        command_int(param3=-1.0), command_int(param3=math.inf), command_int(param3=1e30), command_long(param5=NAN),
        command_long(param6=NAN), command_long(param5=91.0), command_long(param6=math.inf),
    ],
)  # fmt: skip
def test_what_can_not_be_is_refused(message: Any) -> None:
    with pytest.raises(ValueError, match=r"latitude|longitude|accuracy"):
        position_request(message, 7, 197)


def test_the_daemon_searches_there_and_answers(tmp_path: Path) -> None:
    photo = tmp_path / "photos" / "still.png"
    photo.parent.mkdir()
    cv2.imwrite(str(photo), cv2.cvtColor(rendered.picture(TRUTH), cv2.COLOR_RGB2BGR))
    outcomes: list[Outcome] = []
    autopilot = HoveringAutopilot(UdpWire())
    acks: list[tuple[int, int, int]] = []
    take = autopilot._take

    def heard(message: Any) -> None:
        if message.get_type() == "COMMAND_ACK" and message.command == COMMAND:
            acks.append((message.result, message.target_system, message.target_component))
        take(message)

    autopilot._take = heard  # type: ignore[method-assign]
    station = dialect.MAVLink(None, 255, 190)
    lat, lon = round(PLACE.lat_deg * 1e7), round(PLACE.lon_deg * 1e7)

    def say(**changes: Any) -> None:
        autopilot.wire.write(bytes(command_int(x=lat, y=lon, **changes).pack(station)))

    flying = config(f"folder:{photo.parent}", f"udpout:127.0.0.1:{autopilot.wire.port}", search=SearchOptions())
    flying = structs.replace(flying, link=structs.replace(flying.link, accept_position=True))
    for number in range(1, 120):
        (photo.parent / f"still{number:03}.png").write_bytes(photo.read_bytes())
    daemon = Daemon(flying, on_outcome=lambda _, outcome: outcomes.append(outcome))
    try:
        with running(daemon):
            wait_for(lambda: sum(isinstance(o, Fix) for o in outcomes) >= 3, "three fixes")
            say()
            wait_for(lambda: len(acks) == 1, "an answer")
            # The next fix is a new start at the place that was given, with the autopilot's own height.
            count = len(outcomes)
            wait_for(lambda: any(isinstance(o, Fix) for o in outcomes[count:]), "a fix there")
            # 90 km away; garbage; to somebody else, who does not answer here.
            autopilot.wire.write(bytes(command_int(x=lat + 8_000_000, y=lon).pack(station)))
            wait_for(lambda: len(acks) == 2, "a refusal")
            say(param3=-5.0)
            wait_for(lambda: len(acks) == 3, "another refusal")
            say(target_component=1)
            # Too uncertain for a prior: an area for the search of the map.
            say(param3=200.0)
            wait_for(lambda: len(acks) == 4, "an answer about the area")
            wait_for(lambda: daemon.statistics().get("searches"), "a search")
            statistics = daemon.statistics()
    finally:
        autopilot.close()
    assert acks == [(ACCEPTED, 255, 190), (DENIED, 255, 190), (DENIED, 255, 190), (ACCEPTED, 255, 190)]
    assert statistics["commands"] == 3, "what can't be is no command"
    assert statistics["link.positions_refused"] == 1
    assert not daemon.link.failure


def test_not_enabled_it_is_ignored() -> None:
    heartbeat = dialect.MAVLink_heartbeat_message(2, dialect.MAV_AUTOPILOT_ARDUPILOTMEGA, 128, 0, 4, 3)
    vehicle = dialect.MAVLink(None, 7, 1)
    [heartbeat] = dialect.MAVLink(None, 0, 0).parse_buffer(heartbeat.pack(vehicle))
    for accept in (False, True):
        protocol = LinkProtocol(LinkOptions(endpoint="udp:127.0.0.1:1", accept_position=accept))
        protocol.on_message(heartbeat, 1)
        for _ in range(9):
            protocol.on_message(command_int(), 2)
        requests = []
        while (request := protocol.take_request()) is not None:
            requests.append(request)
        # Who floods us fills a queue of four.
        assert len(requests) == (4 if accept else 0)
        assert not protocol.answers
