"""The simulated link as others meet it: real sockets, a real pseudo-terminal, another program's MAVLink, and ours."""

from __future__ import annotations

import json
import math
import os
import re
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from autopilot_rig import Rig
from ortholoc_sim import link as tool
from ortholoc_sim.autopilot import FilterOptions, Verdict, dialect
from ortholoc_sim.gnss import GnssEvent
from ortholoc_sim.line import LineOptions, Wire
from ortholoc_sim.link import LinkSpec, SimulatedLink
from ortholoc_sim.route import circle, read_waypoints, site_at
from ortholoc_sim.site import Geopoint, Site

os.environ["MAVLINK20"] = "1"

from pymavlink import mavutil

from ortholoc_edge.adapters.mavlink import AutopilotLink, LinkOptions
from ortholoc_edge.adapters.mavlink.audit import Level, Situation, audit, parameters_wanted
from ortholoc_edge.adapters.mavlink.estimates import Autopilot, VisionEstimate
from ortholoc_edge.adapters.mavlink.parameters import Answer, ParameterClient
from ortholoc_edge.adapters.mavlink.protocol import LinkProtocol
from ortholoc_edge.clock import SystemClock
from ortholoc_edge.errors import ConfigError

S = 1_000_000_000
NO_GNSS = (GnssEvent(kind="lost", from_s=0.3),)
CALM = LinkSpec(gnss=NO_GNSS, wind_ned_m_s=(0.0, 0.0, 0.0), gust_m_s=0.0)


@contextmanager
def client(link: SimulatedLink) -> Iterator[Any]:
    """pymavlink's own connection, as any companion program has it."""
    more = {"baud": 921_600} if link.spec.over == "pty" else {}
    peer = mavutil.mavlink_connection(link.device, source_system=1, source_component=197, **more)
    try:
        peer.mav.heartbeat_send(18, 8, 0, 0, 4)
        yield peer
    finally:
        peer.close()


def until(peer: Any, name: str, accept: Callable[[Any], bool] = lambda m: True, seconds: float = 15.0) -> Any:
    """The next message of a name; answers TIMESYNC meanwhile."""
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        message = peer.recv_match(blocking=True, timeout=0.2)
        if message is None:
            continue
        if message.get_type() == "TIMESYNC" and message.tc1 == 0:
            peer.mav.timesync_send(time.monotonic_ns(), message.ts1)
        if message.get_type() == name and accept(message):
            return message
    raise AssertionError(f"no {name} within {seconds:g} s")


def send_truth(peer: Any, link: SimulatedLink, frame: int = dialect.MAV_FRAME_LOCAL_FRD) -> None:
    """ODOMETRY of where the vehicle really is."""
    x, y, z = (float(v) for v in link.true_local_m())
    covariance = [0.0] * 21
    covariance[0] = covariance[6] = 0.5
    nan = math.nan
    peer.mav.odometry_send(
        time.monotonic_ns() // 1000, frame, dialect.MAV_FRAME_BODY_FRD, x, y, z, [1, 0, 0, 0], nan, nan, nan, 0, 0, 0,
        covariance, [nan] * 21, 0, dialect.MAV_ESTIMATOR_TYPE_VISION, 90,
    )  # fmt: skip


def feed(peer: Any, link: SimulatedLink, wanted: Verdict, frame: int = dialect.MAV_FRAME_LOCAL_FRD) -> None:
    """Tell the truth ten times a second until one of it came to what is wanted."""
    deadline = time.monotonic() + 15.0
    while not any(record.verdict is wanted for record in link.records):
        assert time.monotonic() < deadline, [str(record.verdict) for record in link.records[-5:]]
        send_truth(peer, link, frame)
        until(peer, "TIMESYNC")


@pytest.mark.parametrize("over", ["udp", "tcp", "pty"])
def test_any_client_is_served_over_any_port(over: str) -> None:
    with SimulatedLink(replace(CALM, over=over)) as link, client(link) as peer:  # type: ignore[arg-type]
        heartbeat = until(peer, "HEARTBEAT")
        assert (heartbeat.autopilot, heartbeat.get_srcSystem(), heartbeat.get_srcComponent()) == (3, 1, 1)
        peer.mav.command_long_send(1, 1, dialect.MAV_CMD_SET_MESSAGE_INTERVAL, 0, 32, 50_000, 0, 0, 0, 0, 0)
        assert until(peer, "COMMAND_ACK").result == dialect.MAV_RESULT_ACCEPTED
        local = until(peer, "LOCAL_POSITION_NED")
        assert math.hypot(local.x, local.y) == pytest.approx(link.spec.radius_m, abs=15.0)
        feed(peer, link, Verdict.FUSED)
        link.wait_for(lambda: link.error_m < 1.5)
        assert link.counts()["bad_data"] == 0


def test_px4_behaves_as_px4() -> None:
    """Vision beside GNSS is relative; LOCAL_NED; ESTIMATOR_STATUS instead of EKF_STATUS_REPORT."""
    spec = replace(CALM, firmware="px4-1.16", gnss=(), stamps="ideal")
    with SimulatedLink(spec) as link, client(link) as peer:
        assert until(peer, "HEARTBEAT").autopilot == dialect.MAV_AUTOPILOT_PX4
        for kind, result in ((193, dialect.MAV_RESULT_FAILED), (230, dialect.MAV_RESULT_ACCEPTED)):
            peer.mav.command_long_send(1, 1, dialect.MAV_CMD_REQUEST_MESSAGE, 0, kind, 0, 0, 0, 0, 0, 0)
            assert until(peer, "COMMAND_ACK").result == result
        assert until(peer, "ESTIMATOR_STATUS").flags & dialect.ESTIMATOR_POS_HORIZ_ABS
        feed(peer, link, Verdict.RELATIVE, dialect.MAV_FRAME_LOCAL_NED)


def test_a_mission_is_read_replaced_and_flown() -> None:
    with SimulatedLink(replace(CALM, over="tcp", gnss=())) as link, client(link) as peer:
        until(peer, "HEARTBEAT")
        peer.mav.mission_request_list_send(1, 1)
        count = until(peer, "MISSION_COUNT").count
        assert count == 25  # home, and the circle
        peer.mav.mission_request_int_send(1, 1, 1)
        first = until(peer, "MISSION_ITEM_INT", lambda m: m.seq == 1)
        # The circle begins 150 m north of home: 1.349e-3 degrees.
        assert first.x == pytest.approx(488_026_000 + 13_490, abs=100)
        # Home, then two places: 300 m east of home, 40 m above it, and back.
        home = link.spec.home
        there = (round(home.lat_deg * 1e7), round(home.lon_deg * 1e7 + 41_000))
        items = [(0, round(home.lat_deg * 1e7), round(home.lon_deg * 1e7), home.height_amsl_m)]
        items += [(3, *there, 140.0), (3, round(home.lat_deg * 1e7), round(home.lon_deg * 1e7), 140.0)]
        peer.mav.mission_count_send(1, 1, len(items))
        for _ in items:
            seq = until(peer, "MISSION_REQUEST_INT").seq
            frame, x, y, z = items[seq]
            peer.mav.mission_item_int_send(1, 1, seq, frame, 16, 0, 1, 0, 0, 0, math.nan, x, y, z)
        assert until(peer, "MISSION_ACK").type == dialect.MAV_MISSION_ACCEPTED
        peer.mav.command_long_send(1, 1, dialect.MAV_CMD_SET_MESSAGE_INTERVAL, 0, 42, 100_000, 0, 0, 0, 0, 0)
        assert until(peer, "MISSION_CURRENT").seq == 1
        before = link.true_local_m()
        target = link.loop.autopilot.route()[1]
        link.wait_for(lambda: np.hypot(*(link.true_local_m() - target)[:2]) < np.hypot(*(before - target)[:2]) - 4.0)


@pytest.mark.parametrize("firmware", ["ardupilot-4.7", "px4-1.15"])
def test_our_own_link_over_a_serial_line(firmware: str) -> None:
    """The daemon's link, a pseudo-terminal at 460800 baud with delay: served both ways, and its fix is used."""
    line = LineOptions(baud=460_800, delay_ms=2.0, jitter_ms=1.0)
    spec = replace(CALM, firmware=firmware, over="pty", line=line, stamps="ideal")
    with (
        SimulatedLink(spec) as link,
        AutopilotLink(LinkOptions(endpoint=link.endpoint, release="raw"), SystemClock()) as ours,
    ):

        def served(with_origin: bool = True) -> bool:
            vehicle, state = ours.vehicle, ours.state_at(time.monotonic_ns() - 50_000_000)
            known = vehicle is not None and vehicle.firmware_version is not None
            there = state is not None and state.ned_from_body is not None and state.synchronised
            return known and there and (state is not None and (state.origin is not None) == with_origin)

        link.wait_for(served)
        for _ in range(60):
            covariance = np.diag([0.5**2] * 3 + [0.01] * 3)
            fix = VisionEstimate(time.monotonic_ns(), link.true_local_m(), np.eye(3), covariance, 0, 0.8)
            ours.send_estimate(fix)
            time.sleep(0.1)
            if any(r.verdict in (Verdict.FUSED, Verdict.RELATIVE) for r in link.records):
                break
        used = [r for r in link.records if r.verdict in (Verdict.FUSED, Verdict.RELATIVE)]
        assert used, [str(record.verdict) for record in link.records]
        assert used[0].sigma_m == pytest.approx(0.5, rel=0.01)
        # Its clock begins anew, and ours notices. Without GNSS it does not know where it counts from any more.
        link.reboot()
        link.wait_for(lambda: ours.statistics().get("restarts", 0) == 1 and served(with_origin=False))


def test_the_command_tells_events_as_json(tmp_path: Path) -> None:
    """Another process, as others would use it: a pseudo-terminal, a bad line, a restart, an end."""
    arguments = [
        "--firmware", "ardupilot-4.5", "--pty", "--json", "--duration", "1.5", "--reboot-at", "0.5", "--no-origin",
        "--param", "VISO_DELAY_MS=200", "--loss", "0.1",
    ]  # fmt: skip
    done = subprocess.run(
        [sys.executable, "-m", "ortholoc_sim.link", *arguments], capture_output=True, text=True, timeout=60,
        check=False, env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    events = [json.loads(line) for line in done.stdout.splitlines()]
    assert events[0]["kind"] == "open" and events[0]["endpoint"].startswith("serial:/dev/")
    assert {event["kind"] for event in events} == {"open", "text", "state", "end"}
    assert next(e["text"] for e in events if e["kind"] == "text") == "Using EKF Source Set 2"
    assert not any(event["gnss"] for event in events if event["kind"] == "state")
    assert events[-1]["counts"]["reboots"] == 1


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--firmware", "ardupilot-5.0"], "rules are known from 4.5 to 4.8"),
        (["--firmware", "betaflight"], "write ardupilot-4.6 or px4-1.16"),
        (["--param", "EKF2_EV_CTRL=1"], "EKF2_EV_CTRL is not one"),
        (["--route", "/nowhere.waypoints"], "can't be read"),
        (["--udp", "localhost"], "has no port"),
        (["--spoof", "fast"], "--spoof 'fast' is not 1 to 2 numbers"),
        (["--home", "89,0,0"], "latitude from -80 to 80"),
        (["--gnss-back-at", "9"], "--gnss-back-at goes with --gnss-loss-at"),
        (["--spoof-at", "9"], "--spoof-at goes with --spoof"),
    ],
)
def test_what_cannot_be_is_said(arguments: list[str], says: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert tool.main([*arguments, "--duration", "0.1"]) == 1
    assert says in capsys.readouterr().err


@pytest.mark.parametrize(
    ("option", "value", "says"),
    [
        ("--delay-ms", "nan", "--delay-ms"),
        ("--loss", "5", "'5' is not a probability from 0 to 1"),
        ("--baud", "-9600", "not a whole number from 0"),
        ("--system-id", "300", "not a system id from 1 to 255"),
        ("--speed", "0", "--speed"),
        ("--gnss-loss-at", "-5", "--gnss-loss-at"),
    ],
)
def test_values_out_of_range_are_said(option: str, value: str, says: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        tool.main([f"{option}={value}"])
    assert says in capsys.readouterr().err


def test_the_documents_example_runs() -> None:
    document = Path(__file__).parents[2] / "docs" / "simulated-link.md"
    [example] = re.findall(r"```python\n(.*?)```", document.read_text(encoding="utf-8"), re.DOTALL)
    exec(compile(example, str(document), "exec"), {})


def test_the_documents_commands_are_understood() -> None:
    document = (Path(__file__).parents[2] / "docs" / "simulated-link.md").read_text(encoding="utf-8")
    commands = re.findall(r"^python -m ortholoc_sim\.link (.*)$", document, re.MULTILINE)
    assert len(commands) >= 7
    for command in commands:
        spec = tool.spec_of(tool._arguments().parse_args(command.split()))
        assert spec.autopilot().stack in ("ardupilot", "px4")
    every = set(Verdict)
    told = set(re.findall(r"`(\w+)`", document.split("| `verdict` |")[1].split("## From")[0]))
    assert {str(verdict) for verdict in every} <= told


# -- without sockets -----------------------------------------------------------


def test_a_line_is_as_slow_as_its_baud_rate_and_keeps_order() -> None:
    wire = Wire(LineOptions(baud=57_600, delay_ms=5.0, jitter_ms=20.0), np.random.default_rng(3))
    for n in range(10):
        wire.send(bytes([n]) * 28, 0)
    arrivals = []
    while (due := wire.next_ns()) is not None:
        arrivals += [(due, chunk[0]) for chunk in wire.arrived(due)]
    assert [n for _, n in arrivals] == list(range(10))
    assert arrivals[0][0] > 28 * 10 / 57_600 * S
    assert arrivals[-1][0] > 10 * 28 * 10 / 57_600 * S  # one after the other
    for _ in range(400):
        wire.send(b"x" * 28, S)
    assert wire.counts["refused"] > 300  # what a real one would have no buffer for


def test_a_bad_line_loses_and_damages_the_same_each_time() -> None:
    def sent(seed: int) -> list[bytes]:
        wire = Wire(LineOptions(loss=0.2, corruption=0.01), np.random.default_rng(seed))
        for n in range(500):
            wire.send(bytes([n % 256]) * 20, n)
        return wire.arrived(S)

    first = sent(1)
    assert sent(1) == first and sent(2) != first
    assert len(first) == pytest.approx(400, abs=40)
    damaged = sum(len(set(chunk)) > 1 for chunk in first)
    assert damaged == pytest.approx(len(first) * (1 - 0.99**20), abs=30)


def test_a_waypoint_file_and_a_circle_are_routes(tmp_path: Path) -> None:
    home = Geopoint(-33.9, 18.4, 50.0)
    site = site_at(home, "px4")
    assert site.origin.lat_deg == pytest.approx(home.lat_deg, abs=1e-6)
    assert site.origin.height_amsl_m == pytest.approx(50.0)
    ring = site.ned_from_map(circle(site, 200.0, 80.0))
    assert np.hypot(ring[:, 0], ring[:, 1]) == pytest.approx(np.full(24, 200.0))
    assert ring[:, 2] == pytest.approx(np.full(24, -80.0))
    path = tmp_path / "route.waypoints"
    rows = [
        (0, 16, -33.9, 18.4, 50.0),
        (3, 22, -33.899, 18.4, 60.0),
        (3, 178, 0.0, 0.0, 0.0),
        (0, 16, -33.899, 18.402, 120.0),
    ]
    body = [
        f"{n}\t0\t{frame}\t{command}\t0\t0\t0\t0\t{lat}\t{lon}\t{alt}\t1"
        for n, (frame, command, lat, lon, alt) in enumerate(rows)
    ]
    path.write_text("\n".join(["QGC WPL 110", *body]) + "\n", encoding="utf-8")
    ned = site.ned_from_map(read_waypoints(path, site))
    # The item that is no place (a change of speed) is left out; heights above home and above the sea.
    assert ned[:, 2] == pytest.approx([-60.0, -70.0], abs=0.1)
    assert ned[0, :2] == pytest.approx([110.9, 0.0], abs=0.5)
    path.write_text("QGC WPL 110\n1\t2\n", encoding="utf-8")
    with pytest.raises(ConfigError, match="line 2: 2 columns"):
        read_waypoints(path, site)


FIRMWARES = [("ardupilot", (4, 5, 7)), ("ardupilot", (4, 8, 0)), ("px4", (1, 14, 0)), ("px4", (1, 18, 0))]


def rig(site: Site, stack: str, firmware: tuple[int, int, int], **options: object) -> Rig:
    filters = FilterOptions(converged_after=0) if stack == "px4" else FilterOptions()
    there = replace(site, earth=stack)  # type: ignore[arg-type]
    return Rig(there, stack=stack, firmware=firmware, filter=filters, **options)  # type: ignore[arg-type]


def exchanged(core: Any, client: ParameterClient, autopilot: Autopilot) -> None:
    """The daemon's own client against the simulated server, each message packed and parsed."""
    ours, theirs = dialect.MAVLink(None, 1, 197), dialect.MAVLink(None, 1, 1)
    now_ns = 0
    while client.busy:
        for request in client.poll(now_ns, 1, autopilot):
            (asked,) = ours.parse_buffer(request.pack(ours))
            for answer in core.handle(asked, core.rebooted_ns):
                (told,) = theirs.parse_buffer(answer.pack(theirs))
                client.on_value(told, autopilot, now_ns)
        now_ns += 50_000_000


@pytest.mark.parametrize(("stack", "firmware"), FIRMWARES)
def test_the_daemons_audit_finds_nothing_or_the_right_thing(site: Site, stack: str, firmware: tuple) -> None:
    autopilot = Autopilot(stack)
    aux = stack == "px4" and firmware >= (1, 18, 0)
    sinks = ("global_position_sensor",) if aux else ("odometry",)

    def findings(set_up: str) -> set[str]:
        core = rig(site, stack, firmware, set_up=set_up, gnss_s=0.0).core
        client = ParameterClient()
        client.read(parameters_wanted(autopilot, sinks))
        exchanged(core, client, autopilot)
        # Of the link nothing is known, so only parameters are looked at.
        health = LinkProtocol(LinkOptions(endpoint="udp:127.0.0.1:1")).health(0, 0)
        found = audit(Situation(autopilot, firmware, frozenset(sinks), health, client.readings))
        return {f.subject for f in found if f.level is not Level.NOTE and "_" in f.subject}

    assert findings("vision") == set()
    expected = {
        "ardupilot": {"VISO_TYPE", "EK3_SRC2_POSXY"},
        "px4": {"EKF2_HGT_REF", *(("EKF2_AGP0_ID", "EKF2_AGP0_CTRL") if aux else ("EKF2_EV_CTRL",))},
    }[stack]
    assert findings("stock") == expected


@pytest.mark.parametrize(("stack", "name", "value"), [("ardupilot", "VISO_QUAL_MIN", -1), ("px4", "EKF2_EV_QMIN", -1)])
def test_parameters_are_listed_and_set_as_each_stack_does(site: Site, stack: str, name: str, value: int) -> None:
    """-1 in PX4's bytes is no number as a float."""
    autopilot = Autopilot(stack)
    flown = rig(site, stack, (4, 6, 0) if stack == "ardupilot" else (1, 16, 0), gnss_s=0.0)
    client = ParameterClient()
    client.read([name, "NO_SUCH_NAME"])
    exchanged(flown.core, client, autopilot)
    assert client.readings["NO_SUCH_NAME"].answer is Answer.ABSENT
    client.write(name, value)
    exchanged(flown.core, client, autopilot)
    assert client.take_written()[0].accepted and flown.core.parameters[name] == value
    flown.core.handle(dialect.MAVLink_param_request_list_message(1, 1), flown.now)
    flown.sent.clear()
    flown.fly(0.01 * len(flown.core.parameters) + 0.05)
    listed = flown.said("PARAM_VALUE")
    assert [m.param_index for m in listed] == list(range(len(flown.core.parameters)))
    assert {m.param_count for m in listed} == {len(flown.core.parameters)}


def test_an_origin_is_told_once_to_ardupilot_and_moves_px4(site: Site) -> None:
    def told(at: Rig) -> Any:
        at.command(dialect.MAV_CMD_REQUEST_MESSAGE, dialect.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN)
        return at.said("GPS_GLOBAL_ORIGIN")[-1] if at.said("GPS_GLOBAL_ORIGIN") else None

    ardupilot = rig(site, "ardupilot", (4, 6, 0), gnss_s=0.0, origin="none")
    assert told(ardupilot) is None
    lat, lon = round(site.origin.lat_deg * 1e7) + 1000, round(site.origin.lon_deg * 1e7)
    setting = dialect.MAVLink_set_gps_global_origin_message(1, lat, lon, 380_000)
    ardupilot.core.handle(setting, ardupilot.now)
    assert told(ardupilot).latitude == lat
    ardupilot.core.handle(dialect.MAVLink_set_gps_global_origin_message(1, lat + 5, lon, 0), ardupilot.now)
    assert told(ardupilot).latitude == lat and ardupilot.core.counts["origin_refused"] == 1
    # What it is told counts from there, 11.1 m north of where the flight's own begins.
    assert ardupilot.see(ardupilot.at[0] - 11.13, ardupilot.at[1]) is Verdict.RESET
    assert np.hypot(*ardupilot.error) < 0.05
    ardupilot.core.reboot()
    ardupilot.fly(0.1)
    ardupilot.sent.clear()
    assert told(ardupilot) is None
    ardupilot.core.handle(setting, ardupilot.now)
    assert told(ardupilot) is None  # its filter has not started: lost, as on a real one
    ardupilot.fly(8.5)
    ardupilot.core.handle(setting, ardupilot.now)
    assert told(ardupilot).latitude == lat
    px4 = rig(site, "px4", (1, 16, 0), gnss_s=0.0)
    px4.core.handle(setting, px4.now)
    assert told(px4).latitude == lat
