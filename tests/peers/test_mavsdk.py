"""MAVSDK: another implementation of MAVLink altogether, with its own decoder, discovery and forwarding."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from adapters.test_mavlink import check_attitude, good_state, wait_for
from pymavlink.dialects.v20 import ardupilotmega as dialect

from ortholoc_edge.geometry import rotation

from .companion import (
    ATTITUDE,
    COMPUTER,
    OURS,
    POSITION_M,
    TEXT,
    VEHICLE,
    assert_same_fields,
    flown,
    is_served,
    link_to,
    of,
    say,
    say_text,
)
from .peer_process import PeerProcess, free_udp_port

pytestmark = pytest.mark.timeout(60)

STATION = Path(__file__).with_name("mavsdk_station.py")


def station(python: Path, folder: Path, *arguments: str) -> PeerProcess:
    return PeerProcess([python, STATION, *arguments], folder, stderr_to_stdout=False)


def records(process: PeerProcess, kind: str) -> list[dict[str, Any]]:
    told = [json.loads(line) for line in list(process.lines)]
    return [record for record in told if record["kind"] == kind]


def messages(process: PeerProcess, name: str) -> list[dict[str, Any]]:
    return [record for record in records(process, "message") if record["name"] == name]


@pytest.mark.parametrize(
    ("autopilot", "version", "name", "frame"),
    [
        (dialect.MAV_AUTOPILOT_ARDUPILOTMEGA, (4, 5, 7), "ARDUPILOT", dialect.MAV_FRAME_LOCAL_FRD),
        (dialect.MAV_AUTOPILOT_PX4, (1, 15, 0), "PX4", dialect.MAV_FRAME_LOCAL_NED),
    ],
    ids=["ardupilot", "px4"],
)
def test_between_autopilot_and_us(peers_python, tmp_path, autopilot, version, name, frame):
    """It forwards between two UDP ports, and its own API tells what it saw of us on the way."""
    ports = free_udp_port(), free_udp_port()
    urls = [f"udpin://127.0.0.1:{port}" for port in ports]
    with (
        station(peers_python, tmp_path, "forward", *urls) as sdk,
        flown(ports[0], autopilot, version) as fake,
        link_to(f"udpout:127.0.0.1:{ports[1]}") as link,
    ):
        [vehicle] = sdk.wait_for(lambda: records(sdk, "vehicle"), "discovery by MAVSDK")
        assert (vehicle["system"], vehicle["autopilot"], tuple(vehicle["firmware"])) == (VEHICLE, name, version)
        sdk.wait_for(lambda: is_served(link, fake), "service through MAVSDK")
        check_attitude(wait_for(lambda: good_state(link)), fake)
        say_text(link)
        sdk.wait_for(
            lambda: len(records(sdk, "odometry")) >= 5 and records(sdk, "text")
            and messages(sdk, "ONBOARD_COMPUTER_STATUS") and len(messages(sdk, "NAMED_VALUE_FLOAT")) >= 3
            and any(m["fields"]["system_status"] == dialect.MAV_STATE_ACTIVE for m in messages(sdk, "HEARTBEAT")),
            "what MAVSDK knows of us", lambda: say(link),
        )  # fmt: skip
        sdk.tell("systems")
        [systems] = sdk.wait_for(lambda: records(sdk, "systems"), "list of systems")
        assert systems["systems"] == {str(VEHICLE): [1, OURS]}
        # MAVSDK's own heartbeat: a component of ground stations.
        assert any(p.role == "ground station" and p.system_id == 245 for p in link.health().peers)
        statistics = link.statistics()

    # By its telemetry API.
    [text] = records(sdk, "text")
    assert (text["severity"], text["text"]) == ("WARNING", TEXT)
    odometry = records(sdk, "odometry")[-1]
    assert tuple(odometry["position_m"]) == POSITION_M
    np.testing.assert_allclose(odometry["q"], rotation.to_quaternion(ATTITUDE), atol=1e-6)
    # Message by message, by its own decoder: the same bytes mean the same to it as to the autopilot.
    arrived = {m.time_usec: m for m in of(fake, "ODOMETRY")}
    compared = [m for m in messages(sdk, "ODOMETRY") if m["fields"]["time_usec"] in arrived]
    assert len(compared) >= 5
    for m in compared:
        assert m["system"] == VEHICLE and m["fields"]["frame_id"] == frame
        assert_same_fields(m["fields"], arrived[m["fields"]["time_usec"]])
    heartbeat = messages(sdk, "HEARTBEAT")[-1]["fields"]
    assert heartbeat["type"] == dialect.MAV_TYPE_ONBOARD_CONTROLLER
    assert heartbeat["autopilot"] == dialect.MAV_AUTOPILOT_INVALID
    computer = messages(sdk, "ONBOARD_COMPUTER_STATUS")[0]["fields"]
    assert computer["cpu_cores"][:3] == [25, 75, 255]
    assert (computer["ram_usage"], computer["ram_total"]) == (COMPUTER.memory_used_mib, COMPUTER.memory_total_mib)
    named = {m["fields"]["name"]: m["fields"]["value"] for m in messages(sdk, "NAMED_VALUE_FLOAT")}
    assert named["VisQuality"] == pytest.approx(0.8)
    assert statistics["bad_frames"] == 0 and statistics.get("internal_errors", 0) == 0
    assert statistics.get("own_echo", 0) == 0 and statistics.get("restarts", 0) == 0


def test_every_message_for_the_autopilot_as_its_addressee_reads_it(peers_python, tmp_path):
    """MAVSDK shows nobody what is addressed to another; so here it is the autopilot itself."""
    everything = ("odometry", "vision_position_estimate", "global_position_sensor", "gps_input")
    carriers = [*(name.upper() for name in everything), "COMMAND_INT"]
    port = free_udp_port()
    with (
        link_to(f"udp:127.0.0.1:{port}", send=everything, recovery=True) as link,
        flown(port, dialect.MAV_AUTOPILOT_ARDUPILOTMEGA, (4, 5, 7)) as fake,
    ):
        wait_for(lambda: is_served(link, fake), 25.0)
        say(link)
        wait_for(lambda: bool(of(fake, "ODOMETRY")), 25.0)
        # An outage: the next goes by the command, too.
        began_ns = time.monotonic_ns()
        wait_for(lambda: time.monotonic_ns() - began_ns > 1_200_000_000, 25.0)
        say(link)
        wait_for(lambda: all(of(fake, carrier) for carrier in carriers), 25.0)
        frames = [of(fake, carrier)[0] for carrier in carriers]
        heartbeat = of(fake, "HEARTBEAT")[0]
    with station(peers_python, tmp_path, "addressee", str(VEHICLE)) as sdk:
        sdk.tell(bytes(heartbeat.get_msgbuf()).hex())
        sdk.wait_for(lambda: records(sdk, "listening"), "MAVSDK's knowing us")
        for frame in frames:
            sdk.tell(bytes(frame.get_msgbuf()).hex())
        sdk.wait_for(lambda: all(messages(sdk, carrier) for carrier in carriers), "decoding by MAVSDK")
        for frame in frames:
            [told] = messages(sdk, frame.get_type())
            assert_same_fields(told["fields"], frame)
