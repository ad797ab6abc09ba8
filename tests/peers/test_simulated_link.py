"""The simulated link as the autopilot of other people's programs."""

from __future__ import annotations

import pytest
from ortholoc_sim.gnss import GnssEvent
from ortholoc_sim.link import LinkSpec, SimulatedLink

from .peer_process import free_udp_port
from .test_mavproxy import mavproxy
from .test_mavsdk import records, station

pytestmark = pytest.mark.timeout(60)


@pytest.mark.parametrize(
    ("firmware", "name", "parameter", "items"),
    [("ardupilot-4.6.1", "ARDUPILOT", "EK3_GLITCH_RAD", 25), ("px4-1.16.2", "PX4", "EKF2_EV_QMIN", 24)],
)
def test_mavsdk_flies_it(peers_python, tmp_path, firmware, name, parameter, items):
    """Version, mission both ways, parameters as each stack has them, and its vision positions are used."""
    port = free_udp_port()
    spec = LinkSpec(
        firmware, peer=("127.0.0.1", port), streams=True, gnss=(GnssEvent(kind="lost", from_s=0.2),), stamps="ideal"
    )
    with (
        SimulatedLink(spec) as link,
        station(peers_python, tmp_path, "companion", f"udpin://127.0.0.1:{port}", parameter) as sdk,
    ):
        [vehicle] = sdk.wait_for(lambda: records(sdk, "vehicle"), "MAVSDK's questions")
        version = [int(part) for part in firmware.split("-")[1].split(".")]
        assert (vehicle["autopilot"], vehicle["firmware"]) == (name, version)
        assert vehicle["items"] == [items, items - 1]
        before = {"ARDUPILOT": 25, "PX4": 0}[name]
        assert vehicle["parameter"] == [before, 2] and link.loop.autopilot.parameters[parameter] == 2
        assert vehicle["parameters"] == len(link.loop.autopilot.parameters)
        sdk.wait_for(lambda: any(mode["name"] == "MISSION" for mode in records(sdk, "mode")), "the flight mode")
        assert records(sdk, "position")[-1]["lat_deg"] == pytest.approx(link.true_place().lat_deg, abs=1e-3)
        link.set_parameter(parameter, before)

        def see() -> None:
            sdk.tell(" ".join(str(float(v)) for v in link.true_local_m()))

        used = {"ARDUPILOT": "fused", "PX4": "relative"}[name]
        sdk.wait_for(
            lambda: any(str(record.verdict) == used for record in link.records), "a position that is used", see
        )
        assert {record.message for record in link.records} == {"VISION_POSITION_ESTIMATE"}


def test_mavproxy_shows_it(peers_python, tmp_path):
    """A ground station: it fetches every parameter and the mission, and shows what the autopilot says."""
    with (
        SimulatedLink(LinkSpec("ardupilot-4.6", over="tcp")) as link,
        mavproxy(peers_python, tmp_path, "--master", link.endpoint) as proxy,
    ):
        count = len(link.loop.autopilot.parameters)
        proxy.wait_for(lambda: any(f"Received {count} parameters" in line for line in proxy.lines), "the parameters")
        proxy.tell("wp list")
        proxy.wait_for(lambda: any("Saved 25 waypoints" in line for line in proxy.lines), "the mission")
        proxy.tell("param set VISO_DELAY_MS 77")
        proxy.wait_for(lambda: link.loop.autopilot.parameters["VISO_DELAY_MS"] == 77, "a parameter that was set")
        # By the streams that it asks for in the old way.
        proxy.wait_for(lambda: any("GPS lock" in line for line in proxy.lines), "the state of GNSS")
        assert any("AUTO>" in line for line in proxy.lines)
        assert not any("breach" in line for line in proxy.lines)
