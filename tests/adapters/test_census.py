"""Who is on the link: counted from what was heard, on a scripted clock."""

from __future__ import annotations

from pymavlink.dialects.v20 import ardupilotmega as dialect

from ortholoc_edge.adapters.mavlink.census import Census, Peer
from ortholoc_edge.adapters.mavlink.options import LinkOptions
from ortholoc_edge.adapters.mavlink.protocol import LinkProtocol

MS = 1_000_000
S = 1_000_000_000


def received(message, system=7, component=1, mavlink1=False):
    frame = message.pack(dialect.MAVLink(None, system, component), force_mavlink1=mavlink1)
    (decoded,) = dialect.MAVLink(None, 0, 0).parse_buffer(frame)
    return decoded


def heartbeat(autopilot=3, kind=2):
    return dialect.MAVLink_heartbeat_message(kind, autopilot, 0, 0, 4, 3)


def test_peers_are_told_apart():
    census = Census()
    for message in (
        received(heartbeat()), received(heartbeat()),
        received(heartbeat(12, 1), system=8),
        received(heartbeat(8, 6), 255, 190),
        received(heartbeat(16, 2), 9),
    ):  # fmt: skip
        census.take(message)
    assert census.peers == (
        Peer(7, 1, "ardupilot", "quadrotor"),
        Peer(8, 1, "px4", "plane"),
        Peer(255, 190, None, "ground station"),
        Peer(9, 1, "other", "quadrotor"),
    )


def test_invented_identities_do_not_fill_the_memory():
    census = Census()
    for system in range(1, 251):
        census.take(received(heartbeat(), system))
    assert len(census.peers) == 64
    for i in range(1000):
        census.take_vehicles(f"MESSAGE_{i}", 0)
    assert len(census.rates_hz(0)) == 256


def test_a_flood_of_identities_hides_neither_the_autopilot_nor_who_came_last():
    census = Census()
    census.take(received(heartbeat(), 7, 1))
    for system in range(1, 101):
        census.take(received(heartbeat(8, 6), system, 190))
        if system == 50:
            census.take(received(heartbeat(8, 6), 1, 190))  # again, and so later than the 48 before
    keys = {(peer.system_id, peer.component_id) for peer in census.peers}
    assert len(keys) == 64 and keys >= {(7, 1), (100, 190), (1, 190)}


def test_mavlink_version_is_the_autopilots():
    census = Census()
    census.take(received(heartbeat(), mavlink1=True))
    census.take(received(heartbeat(8, 6), 255, 190))  # a ground station's does not count
    assert (census.mavlink1, census.mavlink2) == (1, 0)
    census.take(received(heartbeat()))
    assert (census.mavlink1, census.mavlink2) == (1, 1)


def test_rates_are_between_first_and_last_and_end_with_the_stream():
    census = Census()
    for i in range(101):
        census.take_vehicles("ATTITUDE", i * 20 * MS)
    census.take_vehicles("HOME_POSITION", 0)
    assert census.rates_hz(2 * S) == {"ATTITUDE": 50.0, "HOME_POSITION": 0.0}
    assert census.rates_hz(60 * S)["ATTITUDE"] == 0.0


def test_health_is_of_the_protocols_own_ears():
    protocol = LinkProtocol(LinkOptions(endpoint="udp:127.0.0.1:14550", system_id=7))
    assert protocol.health(0, 5).peers == () and protocol.health(0, 5).bad_bytes == 5
    protocol.on_message(received(heartbeat()), 0)
    protocol.on_message(received(heartbeat(8, 18), 7, 197), 0)  # somebody under our ids
    for i in range(11):
        protocol.on_message(received(dialect.MAVLink_system_time_message(0, i * 100)), i * 100 * MS)
    health = protocol.health(1 * S, 0)
    assert health.vehicle is not None and health.connected and health.own_id_heard
    assert health.rates_hz["SYSTEM_TIME"] == 10.0 and health.wanted_rates_hz["SYSTEM_TIME"] == 1.0
    assert (health.round_trip_ms, health.synchronised, health.origin) == (None, False, None)
    assert not protocol.health(10 * S, 0).connected


def test_parameters_are_asked_only_of_the_vehicle_and_again_after_its_restart():
    protocol = LinkProtocol(LinkOptions(endpoint="udp:127.0.0.1:14550"))
    protocol.parameters.read(["VISO_TYPE"])
    value = dialect.MAVLink_param_value_message(b"VISO_TYPE", 1.0, 2, 9, 1)

    def requests(now_ns):
        return [m for m in protocol.poll(now_ns) if m.get_type() == "PARAM_REQUEST_READ"]

    assert requests(0) == []  # of whom?
    protocol.on_message(received(heartbeat()), 0)
    (request,) = requests(1 * MS)
    assert (request.target_system, request.target_component, request.param_index) == (7, 1, -1)
    protocol.on_message(received(value, system=8), 2 * MS)
    protocol.on_message(received(value, component=25), 2 * MS)
    assert protocol.parameters.busy  # neither was the autopilot's
    protocol.on_message(received(value), 3 * MS)
    assert not protocol.parameters.busy and protocol.parameters.readings["VISO_TYPE"].value == 1
    protocol.on_message(received(dialect.MAVLink_system_time_message(0, 60_000)), 4 * MS)
    protocol.on_message(received(dialect.MAVLink_system_time_message(0, 500)), 5 * MS)
    assert len(requests(40 * MS)) == 1
