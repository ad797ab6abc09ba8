"""MAVProxy as its users run it: between the autopilot and us, and as a ground station beside us.

It is under the GPL, version 3: it runs as a process and is never imported.
"""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

import pytest
from adapters.fake_autopilot import FakeAutopilot, UdpWire
from adapters.router import Router
from adapters.test_mavlink import check_attitude, good_state
from pymavlink import mavutil
from pymavlink.dialects.v20 import ardupilotmega as dialect

from .companion import (
    COMPUTER,
    OURS,
    PLACE,
    POSITION_M,
    TEXT,
    VEHICLE,
    flown,
    is_served,
    link_to,
    of,
    say,
    say_text,
    texts,
)
from .peer_process import PeerProcess, free_udp_port

pytestmark = pytest.mark.timeout(60)

WHAT_WE_SAY = {"HEARTBEAT", "STATUSTEXT", "ONBOARD_COMPUTER_STATUS", "NAMED_VALUE_FLOAT", "TIMESYNC", "COMMAND_LONG"}


def mavproxy(python: Path, folder: Path, *arguments: str) -> PeerProcess:
    """Its log is ``flight.tlog`` in the folder. No module is asked for or left out."""
    command = [python, python.with_name("mavproxy.py"), "--state-basedir", folder, "--logfile", "flight.tlog"]
    return PeerProcess([*command, *arguments], folder)


def logged(folder: Path) -> list[Any]:
    """Messages of its telemetry log."""
    log = mavutil.mavlink_connection(str(folder / "flight.tlog"))
    messages = []
    try:
        while (message := log.recv_msg()) is not None:
            messages.append(message)
    finally:
        log.close()
    return messages


def counted(folder: Path) -> Counter[str]:
    """Of our messages in the log, by name."""
    return Counter(
        m.get_type() for m in logged(folder) if (m.get_srcSystem(), m.get_srcComponent()) == (VEHICLE, OURS)
    )


@pytest.mark.parametrize(
    ("autopilot", "version", "carrier", "shown"),
    [
        (dialect.MAV_AUTOPILOT_ARDUPILOTMEGA, (4, 5, 7), "ODOMETRY", "x : 12.5, y : -3.25, z : -40.0, "),
        (dialect.MAV_AUTOPILOT_PX4, (1, 18, 0), "GLOBAL_POSITION_SENSOR", "lat : 501000000, lon : 72000000, "),
    ],
    ids=["ardupilot", "px4"],
)
def test_between_autopilot_and_us(peers_python, tmp_path, autopilot, version, carrier, shown):
    """``--master`` is the autopilot, ``--out`` is the daemon: everything that either needs of the other passes."""
    to_vehicle, to_us = free_udp_port(), free_udp_port()
    link = link_to(f"udp:127.0.0.1:{to_us}")
    with (
        link,
        mavproxy(
            peers_python, tmp_path, "--master", f"udpin:127.0.0.1:{to_vehicle}", "--out", f"udp:127.0.0.1:{to_us}",
            "--non-interactive", "--cmd", f"set flushlogs True;watch {carrier} STATUSTEXT",
        ) as proxy,
        flown(to_vehicle, autopilot, version) as fake,
    ):  # fmt: skip
        proxy.wait_for(lambda: is_served(link, fake), "service through MAVProxy")
        check_attitude(good_state(link), fake)
        say_text(link)
        proxy.wait_for(
            lambda: len(of(fake, carrier)) >= 5 and len(of(fake, "STATUSTEXT")) >= 2
            and fake.got_counts["ONBOARD_COMPUTER_STATUS"] and fake.got_counts["NAMED_VALUE_FLOAT"]
            and any(m.get_srcSystem() == 255 for m in list(fake.got)),
            "arrival at the autopilot", lambda: say(link),
        )  # fmt: skip
        proxy.wait_for(
            lambda: any(f"> {carrier} {{" in line and shown in line for line in proxy.lines), f"{carrier} on its screen"
        )
        # All that the autopilot got of us is in the log, too.
        proxy.wait_for(lambda: counted(tmp_path)[carrier] == fake.got_counts[carrier], f"{carrier} in its log")
        # Both came out of the same port, and were kept apart.
        assert {(m.get_srcSystem(), m.get_srcComponent()) for m in fake.got if m.get_type() == "HEARTBEAT"} == {
            (VEHICLE, OURS), (255, 230)
        }  # fmt: skip
        assert texts(fake.got) == [TEXT]
        statistics = link.statistics()
    assert statistics["bad_frames"] == 0 and statistics.get("restarts", 0) == 0
    assert statistics.get("own_echo", 0) == 0 and statistics.get("internal_errors", 0) == 0
    last = of(fake, carrier)[-1]
    if carrier == "ODOMETRY":
        assert (last.x, last.y, last.z) == POSITION_M
    else:
        assert (last.lat, last.lon, last.alt_ellipsoid) == (501000000, 72000000, PLACE.height_ellipsoid_m)
    assert set(counted(tmp_path)) == {*WHAT_WE_SAY, carrier}
    log = logged(tmp_path)
    assert texts(log) == [TEXT]
    assert {m.ram_usage for m in log if m.get_type() == "ONBOARD_COMPUTER_STATUS"} == {COMPUTER.memory_used_mib}


def test_ground_station_beside_us(peers_python, tmp_path):
    """Behind a router, as any ground station: it finds our component and shows what we say.

    Its console takes the texts of one component only, the autopilot's, until it is told to take all.
    """
    router = Router(3)
    fake = FakeAutopilot(UdpWire(("127.0.0.1", router.ports[0])), system_id=VEHICLE)
    try:
        with (
            link_to(f"udpout:127.0.0.1:{router.ports[1]}") as link,
            mavproxy(peers_python, tmp_path, "--master", f"udpout:127.0.0.1:{router.ports[2]}") as proxy,
        ):

            def says(words: str) -> bool:
                return any(words in line for line in proxy.lines)

            proxy.wait_for(lambda: is_served(link, fake), "service through the router")
            proxy.wait_for(
                lambda: says(f"Detected vehicle {VEHICLE}:1 ") and says(f"Detected vehicle {VEHICLE}:{OURS} ")
                and says(f"online system {VEHICLE}"),
                "discovery by MAVProxy", lambda: say(link),
            )  # fmt: skip
            proxy.tell("set target_component 0")

            def ask() -> None:
                say(link)
                say_text(link)
                proxy.tell("status ODOMETRY;status ONBOARD_COMPUTER_STATUS;status NAMED_VALUE_FLOAT")

            proxy.wait_for(
                lambda: says(f"AP: {TEXT}") and says("x : 12.5, y : -3.25, z : -40.0, q : [")
                and says("ONBOARD_COMPUTER_STATUS {") and says("NAMED_VALUE_FLOAT {"),
                "what MAVProxy knows of us", ask,
            )  # fmt: skip
            # And it is to us what it is.
            assert any((p.system_id, p.role) == (255, "ground station") for p in link.health().peers)
            assert link.vehicle.system_id == VEHICLE and link.statistics().get("restarts", 0) == 0
    finally:
        fake.close()
        router.close()
