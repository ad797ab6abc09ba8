"""The simulated autopilot: what its filter takes, refuses and is reset by, and what it says over a real socket."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Iterator

import numpy as np
import pytest
from autopilot_rig import BOOT, Rig, S, truth
from ortholoc_sim.autopilot import (
    AutopilotCore,
    AutopilotOptions,
    FilterOptions,
    UdpPort,
    Verdict,
    position_sigma_m,
)
from ortholoc_sim.site import Geopoint, Site

os.environ["MAVLINK20"] = "1"

from pymavlink import mavutil
from pymavlink.dialects.v20 import ardupilotmega as dialect

from ortholoc_edge.adapters.mavlink import LinkOptions
from ortholoc_edge.adapters.mavlink.audit import Level, Situation, audit, parameters_wanted
from ortholoc_edge.adapters.mavlink.estimates import Autopilot
from ortholoc_edge.adapters.mavlink.parameters import ParameterClient
from ortholoc_edge.adapters.mavlink.protocol import LinkProtocol


@pytest.fixture
def rig(site: Site) -> Rig:
    return Rig(site)


def test_site_agrees_with_proj_and_inverts(site: Site) -> None:
    ned = np.array([210.0, -170.0, -95.0])
    assert site.ned_from_map(site.map_from_ned(ned)) == pytest.approx(ned, abs=1e-9)
    mine = site.autopilot_from_ned(ned)
    assert site.ned_from_autopilot(mine) == pytest.approx(ned, abs=1e-5)
    # ArduPilot's sphere makes its metres up to 0.4 % wrong, no more.
    assert mine == pytest.approx(ned, rel=0.005, abs=0.02)
    north = site.map_from_ned([100.0, 0.0, 0.0]) - site.map_from_ned(np.zeros(3))
    assert np.rad2deg(np.arctan2(north[0], north[1])) == pytest.approx(-1.507, abs=0.01)
    assert site.origin.height_amsl_m == pytest.approx(430.0 - 47.3, abs=1e-3)


@pytest.mark.parametrize(("frame", "child"), [(1, 12), (20, 1), (20, 8), (4, 12)])
def test_other_frames_are_dropped(rig: Rig, frame: int, child: int) -> None:
    assert rig.see(3.0, 0.0, frame_id=frame, child_frame_id=child) is Verdict.WRONG_FRAME
    assert np.hypot(*rig.error) < 0.05


def test_failed_quality_and_nan_are_dropped(rig: Rig) -> None:
    assert rig.see(1.0, 0.0, quality=-1) is Verdict.FAILED_QUALITY
    assert rig.see(math.nan, 0.0) is Verdict.NOT_FINITE
    assert np.hypot(*rig.error) < 0.05


def test_gnss_comes_first(site: Site) -> None:
    rig = Rig(site)
    rig.core.gnss = True
    rig.fly(0.02)  # a receiver tells it before anybody switches
    assert rig.see(5.0, 0.0) is Verdict.STANDBY


def test_good_positions_are_fused(rig: Rig) -> None:
    for _ in range(20):
        assert rig.see(rig.at[0] + 0.8, rig.at[1] - 0.4, sigma=0.3) is Verdict.FUSED
        rig.fly(0.5)
    assert rig.error == pytest.approx([0.8, -0.4], abs=0.1)


def test_gate_then_timeout(rig: Rig) -> None:
    """Five sigmas summed over both axes; after 7 s of refusals the position is taken."""
    assert rig.see(rig.at[0], rig.at[1], sigma=0.3) is Verdict.FUSED
    verdicts = []
    for _ in range(40):
        rig.fly(0.25)
        verdicts.append(rig.see(rig.at[0] + 40.0, rig.at[1], sigma=0.3))
        if verdicts[-1] is Verdict.TIMEOUT_RESET:
            break
    assert set(verdicts[:-1]) == {Verdict.GATED}
    assert len(verdicts) * 0.25 == pytest.approx(7.25, abs=0.3)
    assert rig.error[0] == pytest.approx(40.0, abs=0.5)
    rig.fly(0.6)
    report = [m for m in rig.sent if m.get_type() == "EKF_STATUS_REPORT"]
    assert report == []  # not asked for


def test_small_declared_sigma_gates_sooner(rig: Rig) -> None:
    rig.see(rig.at[0], rig.at[1], sigma=0.3)
    rig.fly(0.1)
    assert rig.see(rig.at[0] + 6.0, rig.at[1], sigma=0.3) is Verdict.GATED
    rig.fly(0.1)
    assert rig.see(rig.at[0] + 6.0, rig.at[1], sigma=3.0) is Verdict.FUSED


def test_reset_counter_moves_it_at_once(rig: Rig) -> None:
    rig.see(rig.at[0], rig.at[1])
    rig.fly(0.3)
    assert rig.see(rig.at[0] + 30.0, rig.at[1] - 12.0, reset_counter=1) is Verdict.RESET
    assert rig.error == pytest.approx([30.0, -12.0], abs=0.1)
    rig.fly(0.3)
    assert rig.see(rig.at[0] + 30.0, rig.at[1] - 12.0, reset_counter=1) is Verdict.FUSED


def test_measurements_apply_when_they_were_taken(site: Site) -> None:
    """At 10 m/s a fix of 0.6 s ago is 6 m behind; fused at its time it pulls nothing."""
    rig = Rig(site, speed=10.0)
    for _ in range(20):
        rig.fly(0.5)
        before = rig.at[0] - 10.0 * 0.6 * (rig.at[0] / rig.north)
        assert rig.see(before, rig.at[1], sigma=0.2, age_s=0.6) is Verdict.FUSED
    assert np.hypot(*rig.error) < 0.1
    assert rig.core.vision[-1].capture_ns == pytest.approx(rig.now - 0.6 * S, abs=2e6)


def test_jitter_mode_takes_constant_delay_away_as_ardupilot_does(site: Site) -> None:
    """The stamp carries no constant delay (contract 2.6): 0.6 s at 10 m/s leave the estimate 6 m behind."""
    rig = Rig(site, speed=10.0, filter=FilterOptions(stamps="jitter", viso_delay_ms=0.0))
    for _ in range(60):
        rig.fly(0.5)
        rig.see(rig.at[0] - 6.0, rig.at[1], sigma=0.5, age_s=0.6)
    assert rig.error[0] == pytest.approx(-6.0, abs=0.8)


def test_covariance_is_read_as_each_firmware_reads_it(rig: Rig) -> None:
    new, old = (4, 8, 0), (4, 7, 0)
    field = [0.0] * 21
    field[0], field[6], field[11] = 0.5, 0.5, 3.0
    assert position_sigma_m(field, new) == pytest.approx(2.0)
    assert position_sigma_m(field, old) == pytest.approx(float(np.cbrt(0.25 + 0.25 + 9.0)))
    field[0] = math.nan
    assert position_sigma_m(field, new) == 0.0
    field[0], field[11] = 0.5, math.nan
    assert math.isnan(position_sigma_m(field, new))
    rig.see(rig.at[0], rig.at[1], pose_covariance=field)
    assert rig.core.counts["internal_error"] == 1
    assert rig.core.vision[-1].sigma_m == pytest.approx(50.1)


def test_sigma_is_floored_and_rate_limited(rig: Rig) -> None:
    rig.see(rig.at[0], rig.at[1], sigma=0.01)
    assert rig.core.vision[-1].sigma_m == pytest.approx(0.2)
    assert rig.see(rig.at[0], rig.at[1]) is Verdict.TOO_FAST


def test_dead_reckoning_drifts_without_help(site: Site) -> None:
    """A milliradian of tilt leaks a thousandth of gravity: half of that times the square of the time."""
    rig = Rig(site, speed=9.0)
    rig.core.sensors.leaning_rad[:] = (0.0, 0.001)
    rig.fly(50.0)
    assert rig.error[0] == pytest.approx(-0.5 * 9.80665e-3 * 50.0**2, abs=1.0)
    assert rig.core.dead_reckoned_m is not None


# -- over a socket -----------------------------------------------------------


@pytest.fixture
def port() -> Iterator[UdpPort]:
    opened = UdpPort()
    yield opened
    opened.close()


def test_a_real_peer_gets_what_it_asks_for(site: Site, port: UdpPort) -> None:
    """pymavlink's own connection as the companion, over loopback UDP."""
    core = AutopilotCore(AutopilotOptions(), site, truth())
    peer = mavutil.mavlink_connection(f"udpout:127.0.0.1:{port.port}", source_system=1, source_component=197)
    try:
        peer.mav.heartbeat_send(18, 8, 0, 0, 4)
        for kind, rate in ((31, 30.0), (32, 20.0), (33, 5.0), (24, 2.0), (2, 1.0)):
            peer.mav.command_long_send(1, 1, 511, 0, kind, 1e6 / rate, 0, 0, 0, 0, 0)
        peer.mav.command_long_send(1, 1, 511, 0, 12345, 1e6, 0, 0, 0, 0, 0)
        for kind in (148, 49, 242):
            peer.mav.command_long_send(1, 1, 512, 0, kind, 0, 0, 0, 0, 0, 0)
        peer.mav.timesync_send(0, 777)
        wait_readable(port)
        now, got = BOOT, {}
        for _ in range(200):  # two seconds of its time
            port.send([a for m in port.receive() for a in core.handle(m, now)])
            now += S // 100
            port.send(core.step(now, truth(), 0.01))
            while (message := peer.recv_msg()) is not None:
                got.setdefault(message.get_type(), []).append(message)
    finally:
        peer.close()
    heartbeat = got["HEARTBEAT"][0]
    assert (heartbeat.autopilot, heartbeat.get_srcSystem(), heartbeat.get_srcComponent()) == (3, 1, 1)
    assert heartbeat.base_mode & dialect.MAV_MODE_FLAG_SAFETY_ARMED
    assert got["AUTOPILOT_VERSION"][0].flight_sw_version >> 16 == 0x0408
    assert got["GPS_GLOBAL_ORIGIN"][0].altitude == round(site.origin.height_amsl_m * 1e3)
    answers = [m for m in got["TIMESYNC"] if m.tc1 != 0]
    assert answers[0].ts1 == 777
    assert any(m.tc1 == 0 for m in got["TIMESYNC"])
    assert [m.result for m in got["COMMAND_ACK"]].count(dialect.MAV_RESULT_FAILED) == 1
    counts = {name: len(messages) for name, messages in got.items()}
    assert counts["ATTITUDE_QUATERNION"] == pytest.approx(60, abs=12)
    assert counts["LOCAL_POSITION_NED"] == pytest.approx(40, abs=3)
    assert counts["GLOBAL_POSITION_INT"] == pytest.approx(10, abs=2)
    assert got["GPS_RAW_INT"][0].fix_type == 3


def test_velocity_is_not_the_truth_itself(site: Site) -> None:
    core = AutopilotCore(AutopilotOptions(), site, truth())
    climb = []
    for i in range(3000):
        core.step(BOOT + i * S // 100, truth(), 0.01)
        climb.append(core.velocity_ned_m_s[2])
    assert 0.03 < np.std(climb) < 0.4


def test_receiver_tells_its_own_position(site: Site) -> None:
    """Of the receiver, with its error, wherever the filter believes itself to be."""
    core = AutopilotCore(AutopilotOptions(streams_by_default=True), site, truth())
    core.filter.offset_m = core.filter.offset_m + 300.0
    sent = core.step(BOOT, truth(), 0.01)
    raw = next(m for m in sent if m.get_type() == "GPS_RAW_INT")
    point = Geopoint(raw.lat / 1e7, raw.lon / 1e7, raw.alt / 1e3)
    off = site.autopilot_from_geopoint(point) - core.true_position_m
    assert 0.05 < np.linalg.norm(off) < 4.0
    assert raw.h_acc >= 300
    assert raw.v_acc > 0
    assert raw.time_usec == BOOT // 1000


def test_no_fix_after_gnss_is_lost(site: Site) -> None:
    core = AutopilotCore(AutopilotOptions(streams_by_default=True), site, truth())
    core.gnss = False
    sent = core.step(BOOT, truth(), 0.01)
    raw = next(m for m in sent if m.get_type() == "GPS_RAW_INT")
    assert (raw.fix_type, raw.lat) == (1, 0)


def wait_readable(port: UdpPort) -> None:
    """Datagrams on loopback arrive at once, but not before they were sent."""
    deadline = time.monotonic() + 2.0
    import select

    while not select.select([port], [], [], 0.05)[0]:
        assert time.monotonic() < deadline


def test_its_parameters_are_those_of_a_set_up_for_vision(site: Site) -> None:
    """Else the daemon would complain of its settings in every simulated flight."""
    core = AutopilotCore(AutopilotOptions(), site, truth())
    client = ParameterClient()
    client.read(parameters_wanted(Autopilot.ARDUPILOT, ("odometry",)))
    protocol = LinkProtocol(LinkOptions(endpoint="udp:127.0.0.1:1"))
    now_ns = 0
    while client.busy:
        for request in client.poll(now_ns, core.options.system_id, Autopilot.ARDUPILOT):
            for answer in core.handle(received(request), now_ns):
                client.on_value(received(answer), Autopilot.ARDUPILOT, now_ns)
        now_ns += 50_000_000
    health = protocol.health(now_ns, 0)  # of the link nothing is known, so only parameters are looked at
    situation = Situation(Autopilot.ARDUPILOT, (4, 5, 7), frozenset({"odometry"}), health, client.readings)
    wrong = [f.subject for f in audit(situation) if f.level is not Level.NOTE and f.subject.isupper()]
    assert wrong == [] and situation.value("VISO_TYPE") == 1


def received(message):  # type: ignore[no-untyped-def]
    (decoded,) = dialect.MAVLink(None, 0, 0).parse_buffer(message.pack(dialect.MAVLink(None, 1, 1)))
    return decoded
