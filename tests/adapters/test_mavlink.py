"""The link: its protocol on a scripted clock, its thread against a fake autopilot on real UDP, TCP and
serial."""

from __future__ import annotations

import contextlib
import itertools
import math
import os
import socket
import time
from dataclasses import replace

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as dialect

from ortholoc_edge.adapters.computer import ComputerStatus
from ortholoc_edge.adapters.mavlink import AutopilotLink, LinkOptions, Severity, SystemStatus
from ortholoc_edge.adapters.mavlink import protocol as protocol_module
from ortholoc_edge.adapters.mavlink.codec import FrameParser
from ortholoc_edge.adapters.mavlink.estimates import Autopilot, VisionEstimate
from ortholoc_edge.adapters.mavlink.geodesy import GeodeticOrigin, Place
from ortholoc_edge.adapters.mavlink.history import TimeHistory
from ortholoc_edge.adapters.mavlink.monitor import Fusion, FusionReport
from ortholoc_edge.adapters.mavlink.options import parse_endpoint
from ortholoc_edge.adapters.mavlink.protocol import LinkProtocol
from ortholoc_edge.adapters.mavlink.release import Outgoing
from ortholoc_edge.adapters.mavlink.sources import Outcome
from ortholoc_edge.adapters.mavlink.timesync import TimeSync
from ortholoc_edge.clock import SystemClock
from ortholoc_edge.errors import ConfigError, LinkError
from ortholoc_edge.geometry import rotation

from .fake_autopilot import FakeAutopilot, PtyWire, TcpWire, UdpWire

MS = 1_000_000
S = 1_000_000_000


def estimate(stamp_ns: int = 0, north: float = 1.0) -> VisionEstimate:
    return VisionEstimate(stamp_ns, np.array([north, 2.0, -3.0]), np.eye(3), np.diag([4.0] * 3 + [0.01] * 3), 3, 0.8)


def received(message, system: int = 7, component: int = 1):
    """The message as the other side decodes it."""
    sender, receiver = dialect.MAVLink(None, system, component), dialect.MAVLink(None, 0, 0)
    (decoded,) = receiver.parse_buffer(message.pack(sender))
    return decoded


def heartbeat(autopilot: int = 3, kind: int = 2, armed: bool = False):
    return dialect.MAVLink_heartbeat_message(kind, autopilot, 128 if armed else 0, 0, 4, 3)


# -- frames --------------------------------------------------------------------


def frame(message, system: int = 7) -> bytes:
    return bytes(message.pack(dialect.MAVLink(None, system, 1)))


GOOD = [
    frame(heartbeat()),
    frame(dialect.MAVLink_attitude_quaternion_message(1234, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.25)),
    frame(dialect.MAVLink_statustext_message(4, b"hello")),
    bytes(heartbeat().pack(dialect.MAVLink(None, 7, 1), force_mavlink1=True)),
]


@given(
    parts=st.lists(st.sampled_from(GOOD), min_size=1, max_size=8),
    cuts=st.lists(st.integers(0, 500), max_size=6),
)
def test_frames_survive_any_fragmentation(parts, cuts):
    data = b"".join(parts)
    edges = [0, *sorted(min(c, len(data)) for c in cuts), len(data)]
    parser = FrameParser()
    got = [m for a, b in itertools.pairwise(edges) for m in parser.feed(data[a:b], 0)]
    assert len(got) == len(parts) and parser.bad_bytes == 0


@given(data=st.lists(st.one_of(st.binary(max_size=60), st.sampled_from(GOOD)), max_size=12))
def test_good_frames_come_out_of_garbage(data):
    """Every whole frame is found, whatever lies between; a start byte among the rest delays but swallows
    none."""
    parser = FrameParser()
    got = []
    for i, part in enumerate(data):
        got += parser.feed(part, i * 10 * MS)
    # Enough silence lets go of incomplete frames; 300 of them is more than any stray header can claim.
    for i in range(300):
        got += parser.feed(b"", 10 * S + i * S)
        if not parser._buffer:
            break
    known = [m for m in got if m.get_type() in ("HEARTBEAT", "ATTITUDE_QUATERNION", "STATUSTEXT")]
    assert len(known) >= sum(part in GOOD for part in data)


def test_half_frame_does_not_swallow_the_next():
    parser = FrameParser()
    got = parser.feed(GOOD[1][:20] + GOOD[0] + GOOD[1] + GOOD[2], 0)
    assert [m.get_type() for m in got] == ["HEARTBEAT", "ATTITUDE_QUATERNION", "STATUSTEXT"]
    assert parser.bad_frames >= 1


def test_unknown_messages_are_passed_over():
    unknown = bytearray(GOOD[2])
    unknown[7:10] = (60000).to_bytes(3, "little")
    parser = FrameParser()
    assert len(parser.feed(bytes(unknown) + GOOD[0], 0)) == 1
    assert parser.unknown_frames == 1


# -- time ----------------------------------------------------------------------


@given(
    offset_ns=st.integers(-(10**15), 10**15),
    delays=st.lists(st.tuples(st.integers(0, 40), st.integers(0, 40)), min_size=6, max_size=30),
)
def test_timesync_error_is_within_its_uncertainty(offset_ns, delays):
    sync = TimeSync()
    now = 10**16
    for to_ms, back_ms in delays:
        now += 2 * S
        ts1 = sync.due(now)
        assert ts1 == now
        sync.answered(now + to_ms * MS + offset_ns, ts1, now + (to_ms + back_ms) * MS)
        now += (to_ms + back_ms) * MS
    assert sync.synchronised
    offset, uncertainty = sync.best(now)
    assert abs(offset - offset_ns) <= uncertainty
    assert uncertainty <= (min(sum(d) for d in delays) / 2) * MS + 5e-5 * 100 * S


def test_timesync_ignores_others_and_follows_a_new_clock():
    sync = TimeSync()
    sync.answered(5, 12345, 20000)
    assert sync.best(0) is None
    now = 0
    for offset in [1000 * S] * 8 + [3 * S] * 8:
        now += S
        sync.answered(now + MS + offset, sync.due(now), now + 2 * MS)
    assert sync.best(now)[0] == 3 * S and sync.resets == 1


def test_what_was_known_long_ago_is_known_less():
    """Crystals drift, by 50 millionths here: a fast answer of a minute ago is worth less than a slower one of now."""
    sync = TimeSync()
    sync.answered(S + MS, sync.due(S), S + 2 * MS)
    assert sync.best(S + 2 * MS) == (0, MS) and sync.best(101 * S + 2 * MS) == (0, 6 * MS)
    sync.answered(61 * S + 5 * MS, sync.due(61 * S), 61 * S + 4 * MS)
    assert sync.best(61 * S + 4 * MS) == (3 * MS, 2 * MS)


def test_one_wrong_or_late_answer_changes_nothing():
    sync = TimeSync()

    def ask(at, offset_ns=1000 * S, round_trip_ns=2 * MS):
        sync.answered(at + round_trip_ns // 2 + offset_ns, sync.due(at), at + round_trip_ns)

    ask(S, round_trip_ns=3 * S)
    assert sync.best(4 * S) is None, "half of 3 s is no knowledge of the time"
    for i in range(5, 15):
        ask(i * S)
    ask(15 * S, offset_ns=1003 * S)
    ask(16 * S)
    assert sync.best(17 * S)[0] == 1000 * S and sync.resets == 0


def test_history_is_bounded_and_ordered():
    history: TimeHistory[int] = TimeHistory(10 * S, 800)
    for i in range(5000):
        assert history.add(i * 20 * MS, i * 20 * MS, i)
    assert not history.add(4999 * 20 * MS, 5000 * 20 * MS, 0)
    assert len(history) <= 900
    before, after = history.around(4990 * 20 * MS + MS, by_boot=True)
    assert before == (4990 * 20 * MS, 4990) and after == (4991 * 20 * MS, 4991)


# -- protocol on a scripted clock ----------------------------------------------


class Script:
    """Drives a LinkProtocol: an autopilot whose boot time is ours plus an offset, 5 ms away."""

    def __init__(self, autopilot: int = 3, offset_ns: int = -50 * S, **options) -> None:
        self.protocol = LinkProtocol(LinkOptions(endpoint="udp:x:1", **options))
        self.offset_ns = offset_ns
        self.now = 1000 * S
        self.autopilot = autopilot
        self.said: list = []

    def boot_ms(self, at: int | None = None) -> int:
        return ((self.now if at is None else at) + self.offset_ns) // MS

    def hear(self, message, delay_ms: int = 5, **source):
        return self.protocol.on_message(received(message, **source), self.now + delay_ms * MS)

    def run(self, seconds: float, step_ms: int = 20, move=None, answer_timesync: bool = True):
        for _ in range(round(seconds * 1000 / step_ms)):
            self.now += step_ms * MS
            if self.now // S != (self.now - step_ms * MS) // S:
                self.hear(heartbeat(self.autopilot, armed=True))
            for message in self.protocol.poll(self.now):
                self.said.append(message)
                if message.get_type() == "TIMESYNC" and answer_timesync:
                    tc1 = self.now + 5 * MS + self.offset_ns
                    self.hear(dialect.MAVLink_timesync_message(tc1, message.ts1), delay_ms=10)
            if move:
                move()

    def attitude(self, yaw: float, rate: float = 0.0, at: int | None = None, **changes):
        q = rotation.to_quaternion(rotation.from_euler(0.0, 0.0, yaw))
        values = dict(zip(["q1", "q2", "q3", "q4"], map(float, q), strict=True)) | changes
        self.hear(
            dialect.MAVLink_attitude_quaternion_message(
                self.boot_ms(at), **values, rollspeed=0.0, pitchspeed=0.0, yawspeed=rate
            )
        )

    def local(self, p, v=(0.0, 0.0, 0.0)):
        self.hear(dialect.MAVLink_local_position_ned_message(self.boot_ms(), *p, *v))

    def commands(self, number: int) -> list[int]:
        return [int(m.param1) for m in self.said if m.get_type() == "COMMAND_LONG" and m.command == number]


def test_ground_station_and_others_are_not_autopilots():
    script = Script()
    script.hear(heartbeat(8, kind=6), system=255, component=190)
    script.hear(heartbeat(3, kind=6))
    script.hear(heartbeat(8, kind=26), component=154)
    script.hear(heartbeat(3), component=2)
    assert script.protocol.vehicle is None and script.protocol.state_at(script.now) is None
    script.hear(heartbeat(12), system=3)
    assert script.protocol.vehicle.autopilot is Autopilot.PX4
    assert script.protocol.own_system_id == 3
    script.hear(heartbeat(3), system=9)
    assert script.protocol.vehicle.system_id == 3 and script.protocol.counts["other_vehicles"] == 1


def test_a_derivative_is_served_where_it_is_said_what_it_derives_from(caplog):
    script = Script()
    script.hear(heartbeat(0))
    assert script.protocol.vehicle is None
    script = Script(autopilot=0)
    script.protocol = LinkProtocol(LinkOptions(endpoint="udp:x:1", autopilot="px4"))
    script.hear(heartbeat(8))
    script.hear(heartbeat(0, kind=6))
    script.hear(heartbeat(0), component=154)
    assert script.protocol.vehicle is None
    script.run(3.0)
    assert script.protocol.vehicle.autopilot is Autopilot.PX4 and 230 in script.commands(511)
    assert "MAV_AUTOPILOT 0, configured is px4" in caplog.text


def test_other_system_id_than_configured_is_said(caplog):
    script = Script(system_id=5)
    for _ in range(8):
        script.now += S
        script.hear(heartbeat(), system=7)
        script.hear(heartbeat(8, kind=6), system=255, component=190)
    assert script.protocol.vehicle is None
    (line,) = [r.getMessage() for r in caplog.records]
    assert "system id 7" in line and "system_id is 5" in line
    caplog.clear()
    script.hear(heartbeat(), system=5)
    script.now += 20 * S
    script.hear(heartbeat(), system=7)
    assert not [r for r in caplog.records if r.levelname == "WARNING"]


def test_own_heartbeat_and_requests():
    script = Script()
    script.protocol.system_status = SystemStatus.ACTIVE
    script.run(5.0)
    beats = [m for m in script.said if m.get_type() == "HEARTBEAT"]
    assert 5 <= len(beats) <= 6
    assert (beats[0].type, beats[0].autopilot, beats[0].system_status) == (18, 8, 4)
    assert {31, 32, 24, 2, 245, 193} <= set(script.commands(511))
    assert {148, 49, 242} <= set(script.commands(512))
    px4 = Script(autopilot=12)
    px4.run(3.0)
    assert 230 in px4.commands(511) and 193 not in px4.commands(511)


@pytest.mark.parametrize(
    ("endpoint", "system_id", "from_s"),
    [
        ("udp:x:1", 0, None),
        ("udp:x:1", 9, 0),
        ("udpout:x:1", 0, 0),
        ("tcp:x:1", 0, 0),
        ("serial:/dev/x:57600", 0, 5),
    ],
)
def test_who_speaks_before_the_vehicle_is_known(endpoint, system_id, from_s):
    """Ours would carry a system id that nobody has; but a router, or PX4 over USB, must hear us first."""
    protocol = LinkProtocol(LinkOptions(endpoint=endpoint, system_id=system_id))
    start = 1000 * S
    beats = [t for t in range(20) if any(m.get_type() == "HEARTBEAT" for m in protocol.poll(start + t * S))]
    assert beats == ([] if from_s is None else list(range(from_s, 20)))
    protocol.on_message(received(heartbeat(), system=system_id or 7), start + 20 * S)
    assert any(m.get_type() == "HEARTBEAT" for m in protocol.poll(start + 21 * S))


def test_timesync_request_is_answered_at_once():
    script = Script()
    script.hear(heartbeat())
    question = dialect.MAVLink_timesync_message(0, 777)
    answer = script.protocol.answer(received(question), 5 * MS)
    assert (answer.tc1, answer.ts1) == (5 * MS, 777)
    # Nobody else's question, and no answer's.
    assert script.protocol.answer(received(question, system=8), 5 * MS) is None
    assert script.protocol.answer(received(question, component=190), 5 * MS) is None
    assert script.protocol.answer(received(dialect.MAVLink_timesync_message(1, 777)), 5 * MS) is None


@pytest.mark.parametrize("answered", [True, False])
def test_attitude_is_of_the_stamp_not_the_latest(answered):
    script = Script()

    def move():
        script.attitude(0.5 * (script.now % (1000 * S)) / S, rate=0.5)

    script.run(4.0, move=move, answer_timesync=answered)
    lag_s = 0.0 if answered else 0.005  # of arrival, which stands for exposure until synchronised
    for back_ms in (0, 1, 7, 33, 480, 2500):
        stamp = script.now - back_ms * MS
        state = script.protocol.state_at(stamp)
        assert state.synchronised is answered
        truth = rotation.from_euler(0.0, 0.0, 0.5 * ((stamp % (1000 * S)) / S - lag_s))
        # Boot times are whole milliseconds.
        assert rotation.angle_between(state.ned_from_body, truth) < 0.5 * 0.0011
    # Within 0.2 s ahead the rates carry on; beyond, nothing is claimed.
    ahead = script.protocol.state_at(script.now + 150 * MS)
    truth = rotation.from_euler(0.0, 0.0, 0.5 * ((script.now + 150 * MS) % (1000 * S) / S - lag_s))
    assert rotation.angle_between(ahead.ned_from_body, truth) < 0.5 * 0.0011
    assert script.protocol.state_at(script.now + 300 * MS).ned_from_body is None
    assert script.protocol.state_at(script.now - 60 * S).ned_from_body is None


def test_attitude_across_a_gap():
    script = Script()
    script.run(2.0, move=lambda: script.attitude(1.0))
    stop = script.now
    script.run(1.0)
    script.run(0.5, move=lambda: script.attitude(-1.0))
    assert script.protocol.state_at(stop + 500 * MS).ned_from_body is None
    near = script.protocol.state_at(stop + 100 * MS).ned_from_body
    assert rotation.to_euler(near)[2] == pytest.approx(1.0)  # not on the way to what came a second later


@pytest.mark.parametrize(
    "changes",
    [{"q1": math.nan}, {"q2": math.inf}, {"q1": 0.0, "q4": 0.0}, {"q3": 30.0}],
    ids=["nan", "inf", "zero", "long"],
)
def test_garbage_attitude_is_dropped_and_counted(changes):
    script = Script()
    script.run(2.0, move=lambda: script.attitude(0.0))
    good = script.now
    script.run(1.0, move=lambda: script.attitude(0.0, **changes))
    assert script.protocol.counts["garbage.ATTITUDE_QUATERNION"] == 50
    assert script.protocol.state_at(script.now).ned_from_body is None
    assert script.protocol.state_at(good).ned_from_body is not None


def test_plain_attitude_serves_where_there_is_no_quaternion():
    script = Script()

    def move():
        script.hear(dialect.MAVLink_attitude_message(script.boot_ms(), 0.1, -0.2, 3.0, 0.0, math.nan, 0.0))

    script.run(2.0, move=move)
    assert rotation.to_euler(script.protocol.state_at(script.now).ned_from_body) == pytest.approx((0.1, -0.2, 3.0))
    script.hear(dialect.MAVLink_attitude_message(script.boot_ms(), math.nan, 0.0, 0.0, 0.0, 0.0, 0.0))
    assert script.protocol.counts["garbage.ATTITUDE"] == 1


def test_local_position_interpolates_and_jumps_raise_the_epoch():
    script = Script()
    p = np.array([10.0, 0.0, -50.0])
    v = np.array([20.0, -5.0, 0.0])

    def move():
        p[:] += v * 0.02
        script.local(p, v)

    script.run(4.0, move=move)
    state = script.protocol.state_at(script.now - 1010 * MS)
    np.testing.assert_allclose(state.local_position_ned_m, p - v * 1.01, atol=0.03)
    np.testing.assert_allclose(state.velocity_ned, v)
    epoch, before = state.local_epoch, script.now
    p[0] += 3.0
    script.run(1.0, move=move)
    later = script.protocol.state_at(script.now)
    assert later.local_epoch == epoch + 1
    # Between the last sample before and the first after there is no position half-way.
    middle = script.protocol.state_at(before + 4 * MS)
    assert middle.local_epoch == epoch
    assert script.protocol.state_at(before + 16 * MS).local_epoch == epoch + 1
    # A hard but flyable manoeuvre is none, nor a short loss.
    v[:] = [12.0, 0.0, 2.0]
    script.run(1.0, move=move)
    script.now += 300 * MS
    p[:] += v * 0.3
    script.run(0.5, move=move)
    assert script.protocol.state_at(script.now).local_epoch == epoch + 1
    script.local([math.nan, 0.0, 0.0])
    script.local([0.0, 0.0, 1e9])
    assert script.protocol.counts["garbage.LOCAL_POSITION_NED"] == 2


def test_gap_in_local_position_ends_the_epoch():
    script = Script()
    script.run(1.0, move=lambda: script.local([0.0, 0.0, 0.0]))
    epoch = script.protocol.state_at(script.now).local_epoch
    script.run(3.0)
    assert script.protocol.state_at(script.now).local_position_ned_m is None
    script.run(0.1, move=lambda: script.local([0.0, 0.0, 0.0]))
    assert script.protocol.state_at(script.now).local_epoch == epoch + 1


def odometry(script: Script, back_ms: float = 0.0):
    state = script.protocol.state_at(script.now - round(back_ms * MS))
    return state.odometry_ned_m, state.odometry_epoch


@pytest.mark.parametrize("answered", [True, False])
def test_odometry_is_the_integral_of_velocity_not_the_position(answered):
    """10 m/s, a stop, 10 m/s again within 2.5 s: velocities of frames that far apart would say 25 m."""
    script = Script()
    flown = {}
    north, t = 0.0, 0.0

    def speed() -> float:
        return 10.0 * min(1.0, abs(t - 5.25) / 1.25)

    def move():
        nonlocal north, t
        before = speed()
        t += 0.05
        north += 0.05 * 0.5 * (before + speed())
        flown[script.now] = north
        # What it says of its position is pulled about by our own fixes.
        script.local([north + 5.0 * (t % 1.0), 0.0, 0.0], [speed(), 0.0, -1.0])

    script.run(8.0, step_ms=50, move=move, answer_timesync=answered)
    lag_ms = 0 if answered else -5
    a, epoch = odometry(script, 4000 + lag_ms)
    b, same = odometry(script, 1500 + lag_ms)
    assert epoch == same
    truth = flown[script.now - 1500 * MS] - flown[script.now - 4000 * MS]
    assert truth == pytest.approx(12.5, abs=0.05)
    np.testing.assert_allclose(b - a, [truth, 0.0, -2.5], atol=0.02)
    # Between two messages, and a little beyond the last.
    c, d, e = (odometry(script, lag_ms + back_ms)[0] for back_ms in (20, 0, -150))
    np.testing.assert_allclose(d - c, [0.2, 0.0, -0.02], atol=0.02)
    np.testing.assert_allclose(e - d, [1.5, 0.0, -0.15], atol=0.02)
    assert odometry(script, -300)[0] is None


def test_odometry_goes_on_without_anybody_asking():
    script = Script()
    script.run(3.0, step_ms=50, move=lambda: script.local([0.0, 0.0, 0.0], [7.0, 0.0, 0.0]))
    before, epoch = odometry(script)
    script.run(8.0, step_ms=50, move=lambda: script.local([0.0, 0.0, 0.0], [7.0, 0.0, 0.0]))
    after, same = odometry(script)
    np.testing.assert_allclose(after - before, [56.0, 0.0, 0.0], atol=0.02)
    assert same == epoch


def test_broken_odometry_raises_its_epoch():
    script = Script()

    def fly(velocity: float = 5.0):
        script.local([0.0, 0.0, 0.0], [velocity, 0.0, 0.0])

    script.run(3.0, step_ms=50, move=fly)
    before, epoch = odometry(script)
    script.run(0.9)
    fly()
    after, same = odometry(script)
    np.testing.assert_allclose(after - before, [4.5, 0.0, 0.0], atol=0.02)
    assert same == epoch
    # In the middle of a gap that short too.
    np.testing.assert_allclose(odometry(script, 450)[0] - before, [2.25, 0.0, 0.0], atol=0.02)
    script.run(1.1)
    assert odometry(script)[0] is None
    script.run(0.1, move=fly)
    assert odometry(script)[1] == epoch + 1
    for bad in (math.nan, math.inf, 1e6):
        fly(bad)
        fly(bad)
        script.run(0.1, move=fly)
        epoch = odometry(script)[1]
    assert epoch == same + 4
    script.offset_ns = -script.now + 2 * S
    script.run(0.1, move=fly)
    assert script.protocol.counts["restarts"] == 1
    assert odometry(script)[1] == epoch + 1
    script.hear(dialect.MAVLink_local_position_ned_message(script.boot_ms() - 30, 0, 0, 0, 400.0, 0.0, 0.0))
    assert odometry(script)[1] == epoch + 1, "an old message must not break it"


def test_bracketed_attitude_is_told_from_a_carried_on_one():
    script = Script()
    script.run(3.0, move=lambda: script.attitude(0.1))
    assert script.protocol.state_at(script.now - 30 * MS).interpolated
    ahead = script.protocol.state_at(script.now + 30 * MS)
    assert ahead.ned_from_body is not None and not ahead.interpolated
    stamp = script.now + 30 * MS
    script.run(0.06, move=lambda: script.attitude(0.1))
    assert script.protocol.state_at(stamp).interpolated
    assert not script.protocol.state_at(script.now + 2 * S).interpolated


def test_reboot_is_noticed_and_everything_asked_again():
    script = Script()
    script.run(3.0, move=lambda: (script.attitude(0.2), script.local([1.0, 2.0, 3.0])))
    script.hear(dialect.MAVLink_gps_global_origin_message(507000000, 71000000, 60000))
    script.hear(
        dialect.MAVLink_autopilot_version_message(0, 4 << 24 | 8 << 16, 0, 0, 0, [0] * 8, [0] * 8, [0] * 8, 0, 0, 0)
    )
    before = script.protocol.state_at(script.now)
    assert before.origin == GeodeticOrigin(50.7, 7.1, 60.0) and before.armed
    assert script.protocol.vehicle.firmware_version == (4, 8, 0)
    script.said.clear()
    script.offset_ns = -script.now + 2 * S
    script.run(0.1, move=lambda: script.attitude(0.7))
    state = script.protocol.state_at(script.now)
    assert not state.synchronised and state.origin is None
    assert state.local_position_ned_m is None and state.local_epoch > before.local_epoch
    assert rotation.to_euler(state.ned_from_body)[2] == pytest.approx(0.7)
    assert {31, 32, 24} <= set(script.commands(511)) and {148, 49} <= set(script.commands(512))
    assert script.protocol.counts["restarts"] == 1
    script.run(2.0, move=lambda: script.attitude(0.7))
    assert script.protocol.state_at(script.now).synchronised
    assert script.protocol.counts["restarts"] == 1


def test_stamp_from_the_future_is_dropped():
    script = Script()
    script.run(2.0, move=lambda: script.attitude(0.3))
    script.attitude(2.0, at=script.now + 3600 * S)
    script.run(0.1, move=lambda: script.attitude(0.3))
    assert script.protocol.counts["bad_stamps"] == 1 and script.protocol.counts["restarts"] == 0
    assert rotation.to_euler(script.protocol.state_at(script.now).ned_from_body)[2] == pytest.approx(0.3)


def turning(rate: float):
    """A script in which the vehicle turns; what moves it, and by how much an attitude is wrong, None where it is not
    known."""
    script = Script()

    def move() -> None:
        script.attitude(rate * (script.now - 1000 * S) / S, rate=rate)

    def wrong_rad(back_ms: int) -> float | None:
        stamp = script.now - back_ms * MS
        attitude = script.protocol.state_at(stamp).ned_from_body
        truth = rotation.from_euler(0.0, 0.0, rate * (stamp - 1000 * S) / S)
        return None if attitude is None else rotation.angle_between(attitude, truth)

    return script, move, wrong_rad


def test_turns_before_a_stamp_are_those_that_were_flown():
    script, move, _ = turning(0.4)
    script.run(5.0, move=move)
    before = script.protocol.telemetry.turns_before(script.now - 60 * MS, (20 * MS, 100 * MS, 240 * MS))
    assert before == pytest.approx(-0.4 * np.outer([0.02, 0.1, 0.24], [0.0, 0.0, 1.0]), abs=1e-3)
    assert script.protocol.telemetry.turns_before(script.now - 60 * MS, (20 * MS, 60 * S)) is None


def test_one_stamp_of_the_future_keeps_none_of_the_present_out():
    script, move, wrong_rad = turning(0.4)
    script.run(5.0, move=move)
    script.attitude(0.0, at=script.now + 500 * MS)
    script.run(0.3, move=move)
    assert script.protocol.state_at(script.now - 60 * MS).interpolated and wrong_rad(60) < 1e-2
    assert script.protocol.counts["out_of_order"] == 0


def test_a_clock_put_back_in_a_pause_misdates_nothing():
    """No stamp goes back, they only come later than ever: until TIMESYNC has answered it may be either."""
    script, move, wrong_rad = turning(0.4)
    script.run(12.0, move=move)
    script.run(0.4)
    script.offset_ns -= 300 * MS
    errors, unknown = [], 0
    for _ in range(100):
        script.run(0.02, move=move)
        wrong = [wrong_rad(back_ms) for back_ms in (20, 60, 200, 300, 320)]
        errors += [error for error in wrong if error is not None]
        unknown += wrong[1] is None
    assert max(errors) < 0.4 * 0.05 and 0 < unknown < 50


def test_boot_time_comes_round_after_49_days():
    script = Script(offset_ns=2**32 * MS - 1003 * S)

    def move():
        boot = script.boot_ms() % 2**32
        script.hear(dialect.MAVLink_attitude_quaternion_message(boot, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0))

    script.run(6.0, move=move)
    assert script.boot_ms() > 2**32
    assert script.protocol.counts["restarts"] == 0
    assert script.protocol.state_at(script.now).ned_from_body is not None


LAT, LON = 500000000, 71000000
M_PER_DEG_NORTH = 111229.0  # at 50 degrees


def gps(fix=3, h_acc=2000, eph=80, lat=LAT, lon=LON, time_ms=0, v_acc=0, alt=123000):
    return dialect.MAVLink_gps_raw_int_message(
        time_ms * 1000, fix, lat, lon, alt, eph, 150, 0, 0, 12, h_acc=h_acc, v_acc=v_acc
    )


def north_of(script: Script, stamp: int) -> float:
    """Metres north of (LAT, LON) that the state names."""
    return (script.protocol.state_at(stamp).gnss.latitude_deg - LAT / 1e7) * M_PER_DEG_NORTH


def test_gnss_is_what_the_receiver_vouches_for():
    script = Script()
    script.hear(gps())
    assert script.protocol.state_at(script.now) is None

    def move():
        script.local([0.0, 0.0, 0.0], [0.0, 10.0, -2.0])

    script.run(3.0, move=move)
    assert script.protocol.state_at(script.now).gnss is None
    script.hear(gps())
    gnss = script.protocol.state_at(script.now - 100 * MS).gnss
    # A metre west of where it was heard, and 20 cm lower.
    assert (gnss.longitude_deg - LON / 1e7) * 71695.0 == pytest.approx(-1.0, abs=0.1)
    assert gnss.height_amsl_m == pytest.approx(122.8, abs=0.03)
    assert (gnss.sigma_horizontal_m, gnss.sigma_vertical_m) == (2.0, 4.5)
    script.hear(gps(h_acc=0))
    assert script.protocol.state_at(script.now).gnss.sigma_horizontal_m == pytest.approx(2.4)
    for bad in (
        gps(fix=2), gps(h_acc=0, eph=65535), gps(eph=900), gps(h_acc=60000), gps(lat=0, lon=0), gps(lat=2**31 - 1),
    ):  # fmt: skip
        script.hear(bad)
        assert script.protocol.state_at(script.now).gnss is None
    script.hear(gps())
    script.run(1.4, move=move)
    assert script.protocol.state_at(script.now).gnss is not None
    script.run(0.6, move=move)
    assert script.protocol.state_at(script.now).gnss is None, "stale"


def test_gnss_sigma_has_a_floor():
    """A receiver's 1 cm is of its noise; the datum of maps alone is a metre off."""
    script = Script()
    script.run(2.0, move=lambda: script.local([0.0, 0.0, 0.0]))
    script.hear(gps(h_acc=10, v_acc=20))
    gnss = script.protocol.state_at(script.now).gnss
    assert (gnss.sigma_horizontal_m, gnss.sigma_vertical_m) == (1.5, 2.5)


def test_gnss_is_the_receivers_not_the_filters():
    """The filter holds our own fixes; 300 m apart, it is the receiver's that counts."""
    script = Script()

    def move():
        script.local([300.0, 0.0, 0.0])
        script.hear(
            dialect.MAVLink_global_position_int_message(
                script.boot_ms(), LAT + 26970, LON, 123000, 0, 0, 0, 0, 0
            )
        )

    script.run(3.0, move=move)
    script.hear(gps())
    assert north_of(script, script.now) == pytest.approx(0.0, abs=0.01)
    assert 33 not in script.commands(511)


@pytest.mark.parametrize("answered", [True, False])
@pytest.mark.parametrize("clock", ["boot", "unix", "none"])
def test_gnss_is_carried_from_its_own_time(clock, answered):
    """The fix is told 0.4 s late, the vehicle flies at 10 m/s."""
    script = Script()

    def fly():
        script.local([0.0, 0.0, 0.0], [10.0, 0.0, 0.0])

    script.run(3.0, move=fly)
    fixed = script.now
    script.run(0.4, move=fly)
    times = {"boot": script.boot_ms(fixed), "unix": 1_764_000_000_000, "none": 0}
    script.hear(gps(time_ms=times[clock]))
    late_m = 0.0 if clock == "boot" else -4.0
    for age_s in (0.1, 0.4):
        expected = 10.0 * (0.4 - age_s) + late_m
        assert north_of(script, script.now - round(age_s * S)) == pytest.approx(expected, abs=0.15)
    # Across a break of the odometry nothing is carried.
    script.local([0.0, 0.0, 0.0], [math.nan, 0.0, 0.0])
    script.run(0.1, move=fly)
    assert script.protocol.state_at(script.now).gnss is None


def test_gnss_is_of_the_frame_not_the_latest():
    """A frame that waited 3 s has the fix of then."""
    script = Script()
    heard = 0

    def fly():
        nonlocal heard
        script.local([0.0, 0.0, 0.0], [0.0, 0.0, 0.0])
        if script.now - heard >= 500 * MS:
            heard = script.now
            script.hear(gps(lat=LAT + (script.now - 1000 * S) // (100 * MS), time_ms=script.boot_ms()))

    script.run(8.0, move=fly)
    for age_s in (0.3, 1.4, 3.0, 5.0):
        stamp = script.now - round(age_s * S)
        expected = (stamp - 1000 * S) / S * 10 * 1e-7 * M_PER_DEG_NORTH
        assert north_of(script, stamp) == pytest.approx(expected, abs=0.1)


def test_an_origin_that_wavers_is_the_same():
    script = Script()
    script.run(2.0, move=lambda: script.local([0.0, 0.0, 0.0]))
    script.hear(dialect.MAVLink_gps_global_origin_message(507000000, 72000000, 60000))
    before = script.protocol.state_at(script.now)
    for lat, lon, alt in ((1, 0, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1), (-1, 1, 1)):
        script.hear(dialect.MAVLink_gps_global_origin_message(507000000 + lat, 72000000 + lon, 60000 + alt))
        state = script.protocol.state_at(script.now)
        assert state.origin == before.origin and script.protocol.telemetry.local_epoch == before.local_epoch
    script.hear(dialect.MAVLink_gps_global_origin_message(507000000, 72000000, 60200))
    assert script.protocol.telemetry.local_epoch == before.local_epoch + 1


def test_stopped_and_slow_streams_are_asked_for_again():
    script = Script(attitude_rate_hz=50.0)
    script.run(3.0, move=lambda: script.attitude(0.0))
    assert script.commands(511).count(31) == 1
    script.said.clear()
    # After a second of silence, not when the count of some seconds shows it.
    script.run(1.5)
    assert script.commands(511).count(31) == 1
    script.run(3.5)
    assert script.commands(511).count(31) <= 3
    script.said.clear()
    # 5 Hz is not 50 Hz; it asks, but not without end.
    script.run(60.0, step_ms=200, move=lambda: script.attitude(0.0))
    assert 2 <= script.commands(511).count(31) <= 12


def test_a_switch_is_not_said_to_an_autopilot_that_comes_back():
    """It is of the moment."""
    script = Script()
    script.run(1.0)
    script.protocol.source_set.ask(2)
    assert not script.commands(42007)
    script.now += 4 * S
    script.protocol.poll(script.now)
    assert script.protocol.source_set.take_outcome() == Outcome(2, False, None)
    script.run(3.0)
    assert not script.commands(42007)


def test_silent_autopilot_is_left_alone_and_none_takes_its_place():
    script = Script()
    script.run(2.0)
    script.said.clear()
    script.protocol.monitor._report = FusionReport(Fusion.FUSED, script.now, "its position follows the fixes")
    said = [(script.now + i * 20 * MS, message) for i in range(1, 501)
            for message in script.protocol.poll(script.now + i * 20 * MS)]  # fmt: skip
    assert {m.get_type() for at, m in said if at < script.now + 2 * S} > {"HEARTBEAT"}
    assert [m.get_type() for at, m in said if at > script.now + 4 * S] == ["HEARTBEAT"] * 6
    script.now += 10 * S
    assert not script.protocol.connected(script.now)
    statistics = script.protocol.statistics(script.now)
    assert (statistics["fusion"], statistics["fusion_reason"]) == ("unknown", "the autopilot is silent")
    # Its neighbour's attitude would be worse than none; a swap on the bench takes a restart of ours.
    script.now += 2 * S
    script.hear(heartbeat(12), system=4)
    assert script.protocol.vehicle.system_id == 7 and not script.protocol.connected(script.now)
    assert script.protocol.trouble(script.now) == (
        "autopilot (system 7) silent since 11 s; system 4 is heard, but not served: restart us to take it"
    )
    script.hear(heartbeat())
    assert script.protocol.connected(script.now)


def test_origin_is_offered_only_where_there_is_none():
    origin = GeodeticOrigin(50.7, 7.1, 60.0)
    for allowed in (False, True):
        script = Script(set_origin=allowed)
        script.protocol.offer_origin(origin)
        script.run(7.0)
        sent = [m for m in script.said if m.get_type() == "SET_GPS_GLOBAL_ORIGIN"]
        assert bool(sent) is allowed
    assert (sent[0].latitude, sent[0].longitude, sent[0].altitude) == (507000000, 71000000, 60000)
    assert len(sent) >= 3
    script.said.clear()
    # The autopilot's own counts, and a later move of it ends the epoch.
    script.hear(dialect.MAVLink_gps_global_origin_message(507000000, 72000000, 60000))
    script.run(12.0)
    assert not [m for m in script.said if m.get_type() == "SET_GPS_GLOBAL_ORIGIN"]
    assert script.commands(512).count(49) >= 2
    state = script.protocol.state_at(script.now)
    assert state.origin.longitude_deg == 7.2
    script.hear(dialect.MAVLink_gps_global_origin_message(507000000, 72000100, 60000))
    assert script.protocol.state_at(script.now).local_epoch == state.local_epoch + 1
    script.hear(dialect.MAVLink_gps_global_origin_message(2**31 - 1, 0, 0))
    assert script.protocol.state_at(script.now).origin.longitude_deg == 7.20001


def origins_set(script: Script) -> list:
    return [m for m in script.said if m.get_type() == "SET_GPS_GLOBAL_ORIGIN"]


def test_an_origin_is_set_only_after_three_questions_that_an_autopilot_left_open():
    script = Script(set_origin=True)
    script.protocol.offer_origin(GeodeticOrigin(50.0, 8.0, 100.0))
    script.run(10.0)
    named = [m.get_type() if m.get_type() != "COMMAND_LONG" else (m.command, m.param1) for m in script.said]
    first = named.index("SET_GPS_GLOBAL_ORIGIN")
    assert named[:first].count((512, 49.0)) >= 4  # three left open, and the one that it goes along with
    # Heartbeats alone are no answer: the questions may be lost.
    deaf = Script(set_origin=True)
    deaf.protocol.offer_origin(GeodeticOrigin(50.0, 8.0, 100.0))
    deaf.run(20.0, answer_timesync=False)
    assert deaf.commands(512).count(49) >= 15 and not origins_set(deaf)


def test_an_origin_of_before_a_restart_is_not_set():
    script = Script(set_origin=True)
    script.protocol.offer_origin(GeodeticOrigin(50.0, 8.0, 100.0))
    script.run(1.5)
    script.hear(dialect.MAVLink_gps_global_origin_message(507000000, 72000000, 60000))
    script.hear(dialect.MAVLink_system_time_message(0, script.boot_ms()))
    script.offset_ns = -script.now
    script.hear(dialect.MAVLink_system_time_message(0, 0))
    assert script.protocol.state_at(script.now).origin is None
    script.run(12.0)
    assert not origins_set(script)
    script.protocol.offer_origin(GeodeticOrigin(50.1, 8.1, 100.0))
    script.run(12.0)
    assert {(m.latitude, m.longitude) for m in origins_set(script)} == {(501000000, 81000000)}


def version(major: int, minor: int, kind: int = 255):
    return dialect.MAVLink_autopilot_version_message(
        0, major << 24 | minor << 16 | kind, 0, 0, 0, [0] * 8, [0] * 8, [0] * 8, 0, 0, 0
    )


@pytest.mark.parametrize("kind", [0, 64, 128, 192])
def test_the_kind_of_build_is_read_from_the_version(kind, caplog):
    caplog.set_level("INFO")
    script = Script()
    script.run(1.5)
    script.hear(version(4, 8, kind))
    vehicle = script.protocol.vehicle
    assert vehicle.firmware_version == (4, 8, 0) and vehicle.development and vehicle.release is None
    assert "ardupilot 4.8.0 (dev build)" in caplog.text
    assert script.protocol.statistics(script.now)["firmware"] == "4.8.0 (dev build)"
    script.hear(version(4, 8))
    assert script.protocol.vehicle.release == (4, 8, 0)


def test_estimate_takes_the_form_the_firmware_reads():
    script = Script(send=("odometry", "vision_position_estimate"))
    assert script.protocol.encode_estimate(estimate(), 0) == [] and script.protocol.sinks == ()
    script.hear(heartbeat(3))
    odometry, vpe = script.protocol.encode_estimate(estimate(), 0)
    assert odometry.frame_id == 20 and vpe.get_type() == "VISION_POSITION_ESTIMATE"
    assert vpe.covariance[0] == pytest.approx(math.sqrt(2.0**3 / 2))
    script.hear(version(4, 8))
    assert script.protocol.encode_estimate(estimate(), 0)[0].pose_covariance[0] == pytest.approx(2.0)
    px4 = Script(autopilot=12)
    px4.hear(heartbeat(12))
    (odometry,) = px4.protocol.encode_estimate(estimate(), 0)
    assert odometry.frame_id == 1 and odometry.pose_covariance[0] == 4.0
    px4.hear(version(1, 18))
    (sensor,) = px4.protocol.encode_estimate(replace(estimate(), place=Place(50.7, 7.1, 90.0)), 5 * MS)
    assert sensor.get_type() == "GLOBAL_POSITION_SENSOR" and sensor.processing_time == 5000


def test_an_estimate_from_before_the_origin_moved_is_not_sent():
    script = Script()
    script.hear(heartbeat(3))
    script.hear(dialect.MAVLink_gps_global_origin_message(507000000, 72000000, 60000))
    made = replace(estimate(), origin=script.protocol.state_at(script.now).origin)
    assert len(script.protocol.encode_estimate(made, 0)) == 1
    script.hear(dialect.MAVLink_gps_global_origin_message(507000100, 72000000, 60000))
    assert script.protocol.encode_estimate(made, 0) == []
    assert script.protocol.statistics(script.now)["refused.origin_moved"] == 1


ANY_MESSAGE = st.sampled_from(
    [
        dialect.MAVLink_heartbeat_message,
        dialect.MAVLink_attitude_quaternion_message,
        dialect.MAVLink_attitude_message,
        dialect.MAVLink_local_position_ned_message,
        dialect.MAVLink_global_position_int_message,
        dialect.MAVLink_gps_raw_int_message,
        dialect.MAVLink_gps_global_origin_message,
        dialect.MAVLink_system_time_message,
        dialect.MAVLink_ekf_status_report_message,
        dialect.MAVLink_estimator_status_message,
        dialect.MAVLink_autopilot_version_message,
        dialect.MAVLink_statustext_message,
        dialect.MAVLink_timesync_message,
        dialect.MAVLink_command_ack_message,
        dialect.MAVLink_extended_sys_state_message,
    ]
)


@given(items=st.lists(st.tuples(ANY_MESSAGE, st.binary(min_size=80, max_size=80)), max_size=15))
def test_no_content_raises(items):
    """Well-formed messages with arbitrary bits in every field."""
    script = Script()
    script.hear(heartbeat())
    for kind, payload in items:
        sender = dialect.MAVLink(None, 7, 1)
        body = object.__new__(kind)
        dialect.MAVLink_message.__init__(body, kind.id, kind.msgname)
        data = body._pack(sender, kind.crc_extra, payload[: kind.unpacker.size])
        (message,) = FrameParser().feed(bytes(data), 0)
        script.now += 20 * MS
        script.protocol.on_message(message, script.now)
        for out in script.protocol.poll(script.now):
            out.pack(sender)
        state = script.protocol.state_at(script.now)
        if state.ned_from_body is not None:
            assert np.isfinite(state.ned_from_body).all()
        script.protocol.statistics(script.now)


# -- options -------------------------------------------------------------------


@pytest.mark.parametrize(
    "text",
    [
        "", "udp:14550", "udp:0.0.0.0:0", "tcp:h:70000", "/dev/ttyS0", "serial:/dev/ttyS0", "usb:a:1", "udp::5",
        "udp:a..b:14550", f"tcp:{'x' * 70}.local:5760", "udpout:a b:5",
    ],
)  # fmt: skip
def test_unusable_endpoint_is_a_config_error(text):
    with pytest.raises(ConfigError, match="link endpoint"):
        AutopilotLink(LinkOptions(endpoint=text), SystemClock())


def test_endpoints_and_options_are_checked():
    assert parse_endpoint("serial:/dev/serial/by-id/usb-x:921600").port == 921600
    assert parse_endpoint("udp:[::1]:14550").address == "[::1]"
    for bad in (
        {"endpiont": "x"},
        {"endpoint": "udp:a:1", "send": ["hil_gps"]},
        {"endpoint": "udp:a:1", "send": ["auto", "odometry"]},
        {"endpoint": "a", "system_id": 256},
    ):
        with pytest.raises(msgspec.ValidationError):
            msgspec.convert(bad, LinkOptions)


def test_open_now_tells_what_is_wrong(tmp_path):
    link = AutopilotLink(LinkOptions(endpoint=f"serial:{tmp_path}/ttyX:57600"), SystemClock())
    with pytest.raises(LinkError, match=r"ttyX.*can't be opened"):
        link.start(open_now=True)
    link.stop()


# -- real peers ----------------------------------------------------------------


def wait_for(condition, seconds: float = 8.0):
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        value = condition()
        if value:
            return value
        time.sleep(0.01)
    raise AssertionError("did not happen in time")


@contextlib.contextmanager
def flying(link: AutopilotLink, autopilot: FakeAutopilot):
    try:
        with link:
            yield
    finally:
        autopilot.close()
    assert not link.is_alive() and link.failure is None
    assert link.statistics().get("internal_errors", 0) == 0


def good_state(link: AutopilotLink, back_ms: int = 60):
    state = link.state_at(time.monotonic_ns() - back_ms * MS)
    complete = (
        state is not None
        and state.synchronised
        and state.ned_from_body is not None
        and state.local_position_ned_m is not None
        and state.gnss is not None
        and state.origin is not None
        and state.estimator_flags is not None
        and state.landed is False
    )
    return state if complete else None


def check_attitude(state, autopilot: FakeAutopilot):
    error = rotation.angle_between(state.ned_from_body, autopilot.truth_at(state.stamp_ns))
    # Two milliseconds of stamps and synchronisation, at the rate flown; more if this machine is busy.
    assert error < autopilot.yaw_rate * 0.02, math.degrees(error)


def free_udp_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as s:
        s.bind(("127.0.0.1", 0))
        return s.getsockname()[1]


@pytest.fixture(params=["udp", "udpout", "tcp", "serial"])
def pair(request):
    """A link and the autopilot at its other end."""
    if request.param == "udp":
        port = free_udp_port()
        wire, endpoint = UdpWire(("127.0.0.1", port)), f"udp:127.0.0.1:{port}"
    elif request.param == "udpout":
        wire = UdpWire()
        endpoint = f"udpout:127.0.0.1:{wire.port}"
    elif request.param == "tcp":
        wire = TcpWire()
        endpoint = f"tcp:127.0.0.1:{wire.port}"
    else:
        wire = PtyWire()
        endpoint = f"serial:{wire.path}:921600"
    # Each fix once, as it is: what is carried on is tested beside `Release`.
    return AutopilotLink(LinkOptions(endpoint=endpoint, release="raw"), SystemClock()), FakeAutopilot(wire)


def test_flight_over_a_real_wire(pair):
    link, autopilot = pair
    with flying(link, autopilot):
        link.set_system_status(SystemStatus.ACTIVE)
        state = wait_for(lambda: good_state(link))
        check_attitude(state, autopilot)
        assert state.sync_uncertainty_ns < 20 * MS
        assert state.armed and state.origin == GeodeticOrigin(50.7, 7.1, 60.0)
        assert state.gnss.sigma_horizontal_m == 1.5 and state.position_test_ratio == 0.25
        boot_s = (state.stamp_ns - autopilot.boot_ns) / S
        assert state.local_position_ned_m[0] == pytest.approx(5.0 * boot_s, abs=0.1)
        wait_for(lambda: link.vehicle.firmware_version == (4, 5, 7))
        stamp = time.monotonic_ns()
        link.send_estimate(estimate(stamp))
        odometry = wait_for(lambda: next((m for m in autopilot.got if m.get_type() == "ODOMETRY"), None))
        assert odometry.time_usec == stamp // 1000 and odometry.reset_counter == 3
        assert (odometry.get_srcSystem(), odometry.get_srcComponent()) == (7, 197)
        link.send_status_text(Severity.WARNING, "vision: " + "abcdefghij" * 9)
        texts = wait_for(lambda: (t := [m for m in autopilot.got if m.get_type() == "STATUSTEXT"])[1:] and t)
        assert "".join(t.text for t in texts) == "vision: " + "abcdefghij" * 9
        assert texts[0].id == texts[1].id != 0 and [text.chunk_seq for text in texts] == [0, 1]
        # A full part can't show that it is the last.
        link.send_status_text(Severity.INFO, "x" * 100)
        full = wait_for(lambda: (t := [m for m in autopilot.got if getattr(m, "severity", 0) == 6])[2:] and t)
        assert [m.text for m in full] == ["x" * 50, "x" * 50, ""] and len({m.id for m in full}) == 1
        wait_for(lambda: [m for m in autopilot.got if m.get_type() == "HEARTBEAT" and m.system_status == 4])
        # PX4 takes only round trips below 10 ms for its own synchronisation. The fastest shows what the link
        # can do; the rest, what else this machine is busy with.
        assert min(wait_for(lambda: len(autopilot.timesync_answers) > 9 and autopilot.timesync_answers)) < 10 * MS
        statistics = link.statistics()
        assert statistics["sent.ODOMETRY"] == 1 and statistics["reconnects"] == 0
        assert link.fixes_sent == 1
        assert statistics["bad_frames"] == 0 and statistics["synchronised"]


@pytest.mark.parametrize("kind", ["udp", "serial"])
def test_fast_forward_over_a_real_wire(kind):
    """One fix, 0.3 s old: several estimates, each where the vehicle is at its stamp, until the second is over."""
    wire = UdpWire() if kind == "udp" else PtyWire()
    endpoint = f"udpout:127.0.0.1:{wire.port}" if kind == "udp" else f"serial:{wire.path}:921600"
    autopilot = FakeAutopilot(wire)
    link = AutopilotLink(LinkOptions(endpoint=endpoint), SystemClock())
    with flying(link, autopilot):
        wait_for(lambda: good_state(link))

        def at(stamp_ns):
            return 5.0 * (stamp_ns - autopilot.boot_ns) / S

        wait_for(lambda: (state := link.state_at(time.monotonic_ns() - 300 * MS)) and state.odometry_ned_m is not None)
        capture = time.monotonic_ns() - 300 * MS
        link.send_estimate(estimate(capture, north=at(capture)))
        wait_for(lambda: link.statistics().get("release.repeats_ended") == 1, 20.0)
        sent = [m for m in autopilot.got if m.get_type() == "ODOMETRY"]
        assert len(sent) >= 3
        for message in sent:
            assert message.time_usec > capture // 1000
            # Clocks are related to 5 ms, which are 3 cm at 5 m/s; and a stamp of telemetry is of whole ms.
            assert message.x == pytest.approx(at(message.time_usec * 1000), abs=0.1)
            assert (message.y, message.z) == pytest.approx((2.0, -3.0), abs=1e-3)
        assert [m.time_usec for m in sent] == sorted({m.time_usec for m in sent})
        statistics = link.statistics()
        assert statistics["release.carried"] == 1 and statistics["release.repeated"] == len(sent) - 1
        assert statistics["latency_median_ms"] >= 300.0
        assert "VISO_DELAY_MS" in statistics["delay_advice"]


def test_no_text_of_the_autopilot_hides_another(caplog):
    caplog.set_level("INFO")
    script = Script()
    script.hear(heartbeat())
    for _ in range(2):
        for n in range(200):
            script.hear(dialect.MAVLink_statustext_message(6, f"text {n}.".encode()))
    assert all(caplog.text.count(f"text {n}.") == 1 for n in range(200))
    assert script.protocol.counts["texts_repeated"] == 200
    # What goes on is said again, whatever else was said meanwhile.
    script.now += 6 * S
    script.hear(dialect.MAVLink_statustext_message(6, b"another"))
    script.now += 5 * S
    script.hear(dialect.MAVLink_statustext_message(6, b"text 0."))
    assert caplog.text.count("text 0.") == 2
    script.hear(dialect.MAVLink_statustext_message(6, b"\x1b[2Jgone"))
    assert "?[2Jgone" in caplog.text and "\x1b" not in caplog.text, "a radio must not steer a terminal"


def test_each_reading_of_the_computer_is_told_once():
    """Of a worker that hangs, the last one would look alive."""
    script = Script(computer_status_rate_hz=1.0)
    script.hear(heartbeat())
    script.protocol.computer = ComputerStatus((50.0,), 1, 2, (), False, False, False)
    script.run(5.0)
    assert [m.get_type() for m in script.said].count("ONBOARD_COMPUTER_STATUS") == 1


def test_what_a_filter_said_of_itself_expires():
    script = Script()
    script.hear(heartbeat())
    script.hear(dialect.MAVLink_ekf_status_report_message(831, 0.0, 2.5, 0.0, 0.0, 0.0))
    fresh, stale = (script.protocol.state_at(script.now + after) for after in (3 * S, 4 * S))
    assert (fresh.estimator_flags, fresh.position_test_ratio) == (831, 2.5)
    assert (stale.estimator_flags, stale.position_test_ratio) == (None, None)


def sent(*times_ns, **kinds):
    """A conversation that sent an estimate at each of these times."""
    protocol = LinkProtocol(LinkOptions(endpoint="udp:x:1"))
    for now in times_ns:
        protocol.sent(Outgoing(estimate(now), now, 0), now, **{"local": True, **kinds})
    return protocol


def test_an_outage_is_a_second_without_an_estimate_and_not_the_start():
    assert not sent().is_outage(100 * S)
    assert not sent(100 * S).is_outage(101 * S) and sent(100 * S).is_outage(101 * S + 1)
    often = sent(100 * S, 100 * S + 100 * MS)
    assert not often.is_outage(101 * S + 100 * MS) and often.is_outage(101 * S + 100 * MS + 1)
    often.sent(Outgoing(estimate(102 * S), 102 * S, 0), 102 * S, local=True)
    assert not often.is_outage(102 * S), "once"


def test_slow_fixes_are_no_outages():
    """Raw at 0.5 Hz: the command would set the filter's position anew with each of them."""
    protocol = sent(*range(100 * S, 120 * S, 2 * S))
    assert not protocol.is_outage(118 * S + 4 * S) and protocol.is_outage(118 * S + 6 * S)


def test_what_external_nav_gets_is_told_from_the_rest():
    protocol = sent(100 * S)
    protocol.sent(Outgoing(estimate(103 * S), 103 * S, 0), 103 * S, local=False)
    assert protocol.sent_since(101 * S) and not protocol.sent_since(103 * S)
    assert protocol.sent_since(99 * S, local=True) and not protocol.sent_since(101 * S, local=True)
    assert not sent().sent_since(0)


def test_source_set_is_commanded_until_acknowledged(caplog):
    script = Script()
    script.hear(heartbeat())
    script.protocol.source_set.ask(2)
    script.run(2.5)
    assert script.commands(42007) == [2, 2, 2]
    # Of another's commands: a ground station's, and the camera's beside us.
    for others in ((255, 190), (7, 100)):
        script.hear(dialect.MAVLink_command_ack_message(42007, 0, 0, 0, *others))
    assert script.protocol.source_set.take_outcome() is None
    script.run(1.0)
    assert script.commands(42007) == [2, 2, 2, 2]
    script.hear(dialect.MAVLink_command_ack_message(42007, dialect.MAV_RESULT_DENIED, 0, 0, 7, 197))
    script.run(5.0)
    assert script.commands(42007) == [2, 2, 2, 2]
    assert script.protocol.source_set.take_outcome() == Outcome(2, False, dialect.MAV_RESULT_DENIED)
    assert "refuses to take EKF source set 2" in caplog.text


@pytest.mark.parametrize("kind", ["udp", "serial"])
def test_hostile_bytes_and_half_frames(kind):
    if kind == "udp":
        port = free_udp_port()
        wire, endpoint = UdpWire(("127.0.0.1", port)), f"udp:127.0.0.1:{port}"
    else:
        wire = PtyWire()
        endpoint = f"serial:{wire.path}:921600"
    autopilot = FakeAutopilot(wire)
    autopilot.noise_probability, autopilot.halve_probability = 0.3, 0.1
    link = AutopilotLink(LinkOptions(endpoint=endpoint, release="raw"), SystemClock())
    with flying(link, autopilot):
        check_attitude(wait_for(lambda: good_state(link, back_ms=400)), autopilot)
        if kind == "udp":
            # A stranger's datagrams neither disturb nor take over the link.
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
                for i in range(200):
                    stranger.sendto(os.urandom(100), ("127.0.0.1", port))
                    stranger.sendto(frame(heartbeat(8, kind=6), system=255), ("127.0.0.1", port))
                    if i % 50 == 0:
                        time.sleep(0.01)
                # Nor does what we send go there, even while the autopilot pauses; a heartbeat is due in this time.
                autopilot.mute = True
                for _ in range(12):
                    stranger.sendto(frame(heartbeat(8, kind=6), system=255), ("127.0.0.1", port))
                    time.sleep(0.1)
                autopilot.mute = False
                stranger.setblocking(False)
                with pytest.raises(BlockingIOError):
                    stranger.recv(1000)
        count = autopilot.got_counts["HEARTBEAT"]
        wait_for(lambda: autopilot.got_counts["HEARTBEAT"] > count + 1)
        statistics = link.statistics()
        assert statistics["bad_frames"] > 5 and statistics["reconnects"] == 0


def test_nan_attitude_reboot_and_jump_in_flight(monkeypatch):
    monkeypatch.setattr(protocol_module, "_SILENT_AFTER_NS", 1 * S)
    wire = UdpWire()
    autopilot = FakeAutopilot(wire)
    link = AutopilotLink(LinkOptions(endpoint=f"udpout:127.0.0.1:{wire.port}", release="raw"), SystemClock())
    with flying(link, autopilot):
        first = wait_for(lambda: good_state(link))
        autopilot.nan_attitude = True
        wait_for(lambda: link.state_at(time.monotonic_ns()).ned_from_body is None)
        autopilot.nan_attitude = False
        wait_for(lambda: good_state(link))
        autopilot.position_step = 25.0
        wait_for(lambda: (s := good_state(link)) and s.local_epoch == first.local_epoch + 1)
        autopilot.reboot()
        after = wait_for(lambda: (s := good_state(link)) and s.local_epoch > first.local_epoch + 1 and s)
        check_attitude(after, autopilot)
        statistics = link.statistics()
        assert statistics["restarts"] == 1 and statistics["garbage.ATTITUDE_QUATERNION"] > 5
        autopilot.mute = True
        wait_for(lambda: not link.connected())
        link.send_estimate(estimate(time.monotonic_ns()))
        wait_for(lambda: link.statistics()["estimates_dropped"] >= 1)
        assert link.fixes_sent == 0, "only what went out counts"
        autopilot.mute = False
        wait_for(lambda: good_state(link))


def test_tcp_comes_back_after_the_peer_hung_up():
    wire = TcpWire()
    autopilot = FakeAutopilot(wire)
    link = AutopilotLink(LinkOptions(endpoint=f"tcp:127.0.0.1:{wire.port}", release="raw"), SystemClock())
    with flying(link, autopilot):
        wait_for(lambda: good_state(link))
        wire.drop()
        wait_for(lambda: wire.accepted == 2)
        wait_for(lambda: good_state(link))
        assert link.statistics()["reconnects"] == 1


def test_serial_line_pulled_out_and_put_back(tmp_path):
    wire = PtyWire()
    device = tmp_path / "ttyVEHICLE"
    device.symlink_to(wire.path)
    autopilot = FakeAutopilot(wire)
    link = AutopilotLink(LinkOptions(endpoint=f"serial:{device}:921600", release="raw"), SystemClock())
    link.start()
    try:
        wait_for(lambda: good_state(link))
        autopilot.close()
        wait_for(lambda: link.statistics()["reconnects"] == 1)
        device.unlink()
        wait_for(lambda: link.statistics().get("open_failures", 0) >= 1)
        wire = PtyWire()
        device.symlink_to(wire.path)
        autopilot = FakeAutopilot(wire)
        check_attitude(wait_for(lambda: good_state(link)), autopilot)
        assert link.is_alive()
    finally:
        link.stop()
        autopilot.close()


def test_device_missing_at_start_is_waited_for(tmp_path, caplog):
    link = AutopilotLink(LinkOptions(endpoint=f"serial:{tmp_path}/ttyX:57600"), SystemClock())
    with link:
        wait_for(lambda: link.statistics().get("open_failures", 0) >= 2)
        assert link.is_alive() and not link.connected()
        assert link.state_at(0) is None and "ttyX:57600 is not open" in link.trouble()
        link.send_estimate(estimate())
        link.send_estimate(estimate())
        for i in range(30):
            link.send_status_text(Severity.INFO, f"line {i}")
        statistics = link.statistics()
    assert statistics["estimates_dropped"] == 1 and statistics["texts_dropped"] == 14
    assert not link.is_alive()
    link.stop()


def test_latest_estimate_wins_on_a_choked_line():
    """Nobody reads the line: the kernel's buffer fills, then ours, then estimates are replaced in their
    slot."""
    wire = PtyWire()
    autopilot = FakeAutopilot(wire)
    link = AutopilotLink(LinkOptions(endpoint=f"serial:{wire.path}:921600", release="raw"), SystemClock())
    link.start()
    try:
        wait_for(lambda: good_state(link))
        # The autopilot's thread ends; its end of the line stays open and unread but for heartbeats.
        autopilot._stop.set()
        autopilot.thread.join()
        deadline = time.monotonic() + 2.5
        n = 0
        while link.statistics()["estimates_dropped"] < 200 and time.monotonic() < deadline:
            n += 1
            link.send_estimate(estimate(time.monotonic_ns(), north=float(n)))
            time.sleep(0.001)
        assert link.statistics()["estimates_dropped"] >= 200 and link.connected()
        assert link.is_alive()
        assert link._transport.pending()
        last = estimate(time.monotonic_ns(), north=float(n + 1))
        link.send_estimate(last)
        # Long enough for the thread to take it, were it to queue behind what waits.
        time.sleep(0.1)
        parser, stamps = FrameParser(), []

        def drained():
            with contextlib.suppress(BlockingIOError):
                for m in parser.feed(wire.read(), time.monotonic_ns()):
                    if m.get_type() == "ODOMETRY":
                        stamps.append(m.time_usec)
            return stamps and stamps[-1] == last.stamp_ns // 1000

        wait_for(drained, 0.4 + (deadline - time.monotonic() if deadline > time.monotonic() else 0))
        assert stamps == sorted(set(stamps)) and len(stamps) < n
    finally:
        link.stop()
        wire.close()
