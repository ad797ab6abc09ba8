"""What a link has to live through: routers, devices that go and come, half-open connections, bad lines."""

from __future__ import annotations

import random
import select
import socket
import threading
import time
from dataclasses import replace

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as dialect

from ortholoc_edge.adapters.computer import ComputerStatus
from ortholoc_edge.adapters.mavlink import AutopilotLink, LinkOptions, Severity
from ortholoc_edge.adapters.mavlink import link as link_module
from ortholoc_edge.adapters.mavlink.geodesy import Place
from ortholoc_edge.adapters.mavlink.options import parse_endpoint
from ortholoc_edge.adapters.mavlink.transport import open_transport
from ortholoc_edge.clock import SystemClock

from .fake_autopilot import FakeAutopilot, PtyWire, TcpWire, UdpWire, Wire
from .router import GroundStation, Router
from .test_mavlink import (
    check_attitude,
    estimate,
    flying,
    free_udp_port,
    good_state,
    heartbeat,
    received,
    wait_for,
)

MS = 1_000_000


# -- a router between us and several others --------------------------------------


def test_behind_a_router_with_two_vehicles_and_two_ground_stations():
    router = Router(5)
    ours = FakeAutopilot(UdpWire(("127.0.0.1", router.ports[0])), system_id=7)
    other = FakeAutopilot(UdpWire(("127.0.0.1", router.ports[1])), dialect.MAV_AUTOPILOT_PX4, system_id=9)
    stations = [GroundStation(router.ports[2], 255), GroundStation(router.ports[3], 250)]
    options = LinkOptions(
        endpoint=f"udpout:127.0.0.1:{router.ports[4]}", system_id=7, computer_status_rate_hz=1.0, quality_rate_hz=1.0
    )
    link = AutopilotLink(options, SystemClock())
    try:
        with link:

            def turn(condition):
                for station in stations:
                    station.beat()
                return condition()

            wait_for(lambda: turn(lambda: good_state(link)))
            assert link.vehicle.system_id == 7 and link.vehicle.firmware_version == (4, 5, 7)
            check_attitude(good_state(link), ours)
            link.send_estimate(estimate(time.monotonic_ns()))
            link.send_status_text(Severity.INFO, "here")
            link.report_computer(ComputerStatus((50.0,), 1, 2, (), False, False, False))
            wanted = {"HEARTBEAT", "ODOMETRY", "STATUSTEXT", "ONBOARD_COMPUTER_STATUS", "NAMED_VALUE_FLOAT"}
            for station in stations:
                wait_for(lambda station=station: turn(lambda: station.of(7, 197) >= wanted))
                assert station.of(9, 1) >= {"HEARTBEAT"}, "the router forwards the other vehicle too"
            # What a station asks of us, and we do not answer, disturbs nothing.
            stations[0].send(dialect.MAVLink_param_request_list_message(7, 197))
            wait_for(lambda: turn(lambda: len(ours.timesync_answers) > 3))
            statistics = link.statistics()
        # Requests are for our vehicle, and only its own questions about time are answered.
        assert ours.got_counts["COMMAND_LONG"] > 5 and other.got_counts["COMMAND_LONG"] == 0
        asked = {m.ts1 for sender, m in router.timesync if sender == (7, 1) and m.tc1 == 0}
        answered = [m.ts1 for sender, m in router.timesync if sender == (7, 197) and m.tc1 != 0]
        assert answered and asked >= set(answered)
        # Nothing that the other vehicle or a station said was taken for our autopilot's.
        assert statistics["ignored"] > 10 and statistics.get("restarts", 0) == 0
        assert statistics.get("internal_errors", 0) == 0
    finally:
        for one in (ours, other, *stations, router):
            one.close()


def test_the_first_vehicle_heard_is_kept_behind_a_router():
    """With system_id 0; the other one that the router forwards does not take over while ours lives."""
    router = Router(3)
    ours = FakeAutopilot(UdpWire(("127.0.0.1", router.ports[0])), system_id=7)
    link = AutopilotLink(LinkOptions(endpoint=f"udpout:127.0.0.1:{router.ports[2]}"), SystemClock())
    other = None
    try:
        with link:
            wait_for(lambda: good_state(link))
            other = FakeAutopilot(UdpWire(("127.0.0.1", router.ports[1])), system_id=9)
            wait_for(lambda: link.statistics().get("other_vehicles", 0) > 2)
            assert link.vehicle.system_id == 7 and good_state(link)
    finally:
        for one in (ours, other, router):
            if one is not None:
                one.close()


# -- devices and connections -----------------------------------------------------


def test_flight_controller_on_usb_reboots(tmp_path):
    """Its device goes and comes with it, and its time begins anew: nothing of before is held against it."""
    device = tmp_path / "ttyVEHICLE"
    wire = PtyWire()
    device.symlink_to(wire.path)
    autopilot = FakeAutopilot(wire)
    link = AutopilotLink(LinkOptions(endpoint=f"serial:{device}:921600"), SystemClock())
    link.start()
    try:
        first = wait_for(lambda: good_state(link))
        autopilot.close()
        device.unlink()
        wait_for(lambda: link.statistics()["reconnects"] == 1)
        wire = PtyWire()
        device.symlink_to(wire.path)
        autopilot = FakeAutopilot(wire)
        autopilot.reboot()
        after = wait_for(lambda: (s := good_state(link)) and s.local_epoch > first.local_epoch and s)
        check_attitude(after, autopilot)
        assert link.statistics()["restarts"] == 1
        # Asked for again: a rebooted autopilot streams nothing by itself.
        assert dialect.MAVLINK_MSG_ID_ATTITUDE_QUATERNION in autopilot.intervals_ns
        link.send_estimate(estimate(time.monotonic_ns()))
        wait_for(lambda: autopilot.got_counts["ODOMETRY"] == 1)
    finally:
        link.stop()
        autopilot.close()


def test_a_line_is_read_by_one_program_only():
    """Of two, each would get half of every frame."""
    wire = PtyWire()
    endpoint = parse_endpoint(f"serial:{wire.path}:921600")
    first = open_transport(endpoint)
    with pytest.raises(OSError, match="lock"):
        open_transport(endpoint)
    first.close()
    wire.close()


def test_the_end_of_a_stream_is_an_error():
    """Readable for ever without a byte: the thread, which runs before all others, would read and read."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        transport = open_transport(parse_endpoint(f"tcp:127.0.0.1:{server.getsockname()[1]}"))
        server.accept()[0].close()
        select.select([transport], [], [], 5.0)
        with pytest.raises(ConnectionError, match="closed by the other side"):
            transport.receive()
        transport.close()


def test_who_hangs_up_at_once_is_called_more_and_more_seldom():
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(15.0)
        calls = []
        link = AutopilotLink(
            LinkOptions(endpoint=f"tcp:127.0.0.1:{server.getsockname()[1]}"), SystemClock()
        )
        with link:
            for _ in range(3):
                connection, _ = server.accept()
                calls.append(time.monotonic())
                connection.close()
        # A busy machine only makes it longer.
        first, second = np.diff(calls)
        assert first >= 0.45 and second >= 0.95


def test_half_open_tcp_connection_is_given_up(monkeypatch):
    """The other side lost power: nothing comes, nothing is refused, and the kernel goes on taking what we write."""
    monkeypatch.setattr(link_module, "_TCP_SILENCE_NS", 700 * MS)
    wire = TcpWire()
    autopilot = FakeAutopilot(wire)
    link = AutopilotLink(LinkOptions(endpoint=f"tcp:127.0.0.1:{wire.port}"), SystemClock())
    with flying(link, autopilot):
        wait_for(lambda: good_state(link))
        autopilot.mute = True
        wait_for(lambda: link.statistics()["reconnects"] >= 1)
        autopilot.mute = False
        wait_for(lambda: wire.accepted >= 2 and good_state(link))


def test_a_defect_in_one_message_costs_that_message_only(monkeypatch, caplog):
    wire = UdpWire()
    autopilot = FakeAutopilot(wire)
    link = AutopilotLink(LinkOptions(endpoint=f"udpout:127.0.0.1:{wire.port}"), SystemClock())
    monkeypatch.setitem(link._protocol._handlers, "HOME_POSITION", lambda m, arrival_ns: 1 // 0)
    try:
        with link:
            wait_for(link.connected)
            bad = dialect.MAVLink_home_position_message(0, 0, 0, 0, 0, 0, [1, 0, 0, 0], 0, 0, 0)
            good = dialect.MAVLink_statustext_message(6, b"all is well")
            mav = dialect.MAVLink(None, 7, 1)
            for _ in range(3):
                wire.write(bytes(bad.pack(mav)) + bytes(good.pack(mav)))  # in one datagram
            wait_for(lambda: link.statistics().get("received.STATUSTEXT", 0) >= 3)
            assert link.statistics()["internal_errors"] >= 3 and link.is_alive()
    finally:
        autopilot.close()
    assert caplog.text.count("ZeroDivisionError") == 1, "one traceback in ten seconds"


def test_a_flood_of_datagrams_leaves_time_to_speak():
    """Between two chances to speak no more is taken in than some milliseconds of work; what waits is not lost."""
    transport = open_transport(parse_endpoint(f"udp:127.0.0.1:{(port := free_udp_port())}"))
    sender = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    frame = bytes(heartbeat().pack(dialect.MAVLink(None, 7, 1)))
    turns = []
    try:
        for _ in range(2):
            sender.sendto(b"\xfe" * 60_000, ("127.0.0.1", port))
        for _ in range(100):
            sender.sendto(frame, ("127.0.0.1", port))
        while select.select([transport], [], [], 0.2)[0]:
            turns.append(transport.receive())
    finally:
        transport.close()
        sender.close()
    assert max(sum(len(data) for data, _ in turn) for turn in turns) < 2 * 4096
    assert max(map(len, turns)) <= 64 and len(turns) >= 4
    assert sum(data == frame for turn in turns for data, _ in turn) == 100


def test_timesync_is_answered_under_a_flood(caplog):
    wire = UdpWire()
    autopilot = FakeAutopilot(wire, autopilot=dialect.MAV_AUTOPILOT_PX4)
    link = AutopilotLink(LinkOptions(endpoint=f"udpout:127.0.0.1:{wire.port}"), SystemClock())
    with flying(link, autopilot):
        wait_for(lambda: autopilot.timesync_answers)
        before = len(autopilot.timesync_answers)
        for _ in range(20):
            wire.write(b"\xfe" * 60_000)
            time.sleep(0.05)
        wait_for(lambda: len(autopilot.timesync_answers) > before + 5, 20.0)
        assert link.connected() and link.statistics()["reconnects"] == 0
        assert link.statistics()["cut_datagrams"] >= 10
    assert caplog.text.count("more than 4096 bytes is cut") == 1


class _Sent:
    """A transport that keeps what is sent."""

    def __init__(self):
        self.frames = []

    def send(self, frame):
        self.frames.append(frame)
        return True

    def prefer(self, peer):
        pass

    def pending(self):
        return False


@pytest.mark.parametrize(("send", "is_local"), [("gps_input", False), ("odometry", True)])
def test_what_external_nav_hears_is_told_from_what_left_the_link(send, is_local):
    link, line = AutopilotLink(LinkOptions(endpoint="udp:x:1", send=(send,), release="raw"), SystemClock()), _Sent()
    link._take_message(line, received(heartbeat()), None, time.monotonic_ns())
    link.send_estimate(replace(estimate(time.monotonic_ns()), place=Place(50.0, 7.0, 100.0)))
    assert not link.sent_since(0)
    link._say(line)
    assert link.sent_since(0) and link.sent_since(0, local=True) is is_local


def test_many_senders_do_not_fill_the_memory():
    link, line = AutopilotLink(LinkOptions(endpoint="udp:x:1"), SystemClock()), _Sent()
    beat = bytes(heartbeat().pack(dialect.MAVLink(None, 7, 1)))
    for port in range(50):
        link._take(line, beat + b"\xfe", ("127.0.0.1", port), port)
    assert len(link._parsers) == 8 and link.statistics()["messages"] == 50


def test_a_defect_that_stays_ends_the_link_and_says_so(monkeypatch):
    """A daemon without a link serves nobody; systemd starts both afresh."""
    wire = UdpWire()
    autopilot = FakeAutopilot(wire)
    link = AutopilotLink(LinkOptions(endpoint=f"udpout:127.0.0.1:{wire.port}"), SystemClock())
    monkeypatch.setattr(link._protocol, "poll", lambda now_ns: 1 // 0)
    try:
        with link:
            wait_for(lambda: not link.is_alive())
            assert isinstance(link.failure, ZeroDivisionError) and link.statistics()["internal_errors"] == 10
    finally:
        autopilot.close()


def test_timesync_is_answered_while_another_thread_is_asking():
    """It may be of low priority, and not get on for as long as others compute."""
    link, line = AutopilotLink(LinkOptions(endpoint="udp:127.0.0.1:1"), SystemClock()), _Sent()
    link._take_message(line, received(heartbeat()), None, 0)
    question = received(dialect.MAVLink_timesync_message(0, 777))
    taking = threading.Thread(target=link._take_message, args=(line, question, None, 5 * MS))
    with link._lock:
        taking.start()
        wait_for(lambda: line.frames)
    taking.join()


def test_full_write_buffer_on_tcp_drops_and_goes_on():
    """A peer that does not read: what the kernel takes no more is dropped and counted, and hearing goes on."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        # Before the connection is there: a window made smaller afterwards leaves the link's acknowledgements outside
        # it, and then nothing gets through either way until the kernel has tried again for many seconds.
        server.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        link = AutopilotLink(LinkOptions(endpoint=f"tcp:127.0.0.1:{server.getsockname()[1]}"), SystemClock())
        with link:
            connection, _ = server.accept()
            wait_for(lambda: link._transport)._device.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 4096)
            mav = dialect.MAVLink(None, 7, 1)
            beat = bytes(dialect.MAVLink_heartbeat_message(2, 3, 128, 0, 4, 3).pack(mav))
            question = bytes(dialect.MAVLink_timesync_message(0, 5).pack(mav)) * 2000

            def flooded():
                # Each question is answered at once; nobody reads the answers.
                connection.sendall(beat + question)
                return link.statistics().get("unsent", 0) > 100

            wait_for(flooded, 60.0)
            heard = link.statistics()["received.HEARTBEAT"]
            connection.sendall(beat)
            wait_for(lambda: link.statistics()["received.HEARTBEAT"] > heard)
            assert link.is_alive() and link.statistics()["reconnects"] == 0
            connection.close()


# -- bad lines -------------------------------------------------------------------


class BadLine(Wire):
    """A wire that loses pieces, flips bits and takes its time, both ways; ordered, as a line is."""

    def __init__(self, wire: Wire, *, loss: float = 0.0, flip: float = 0.0, delay_s: float = 0.0) -> None:
        self._wire = wire
        self._loss, self._flip, self._delay_s = loss, flip, delay_s
        self._rng = random.Random(2)
        self._lock = threading.Lock()
        self._out: list[tuple[float, bytes]] = []
        self._in: list[tuple[float, bytes]] = []

    def fileno(self):
        self._pass_on()
        return self._wire.fileno()

    def _spoilt(self, data: bytes) -> bytes:
        kept = bytearray(b for b in data if self._rng.random() >= self._loss)
        for i in range(len(kept)):
            if self._rng.random() < self._flip:
                kept[i] ^= 1 << self._rng.randrange(8)
        return bytes(kept)

    def _pass_on(self) -> None:
        while self._out and self._out[0][0] <= time.monotonic():
            self._wire.write(self._out.pop(0)[1])

    def read(self):
        data = self._wire.read()
        if self._delay_s > 0:
            time.sleep(self._delay_s)
        return self._spoilt(data)

    def write(self, data):
        self._out.append((time.monotonic() + self._delay_s, self._spoilt(data)))
        self._pass_on()

    def close(self):
        self._wire.close()


def test_line_with_loss_and_flipped_bits():
    wire = PtyWire()
    autopilot = FakeAutopilot(BadLine(wire, loss=0.0005, flip=0.001))
    link = AutopilotLink(LinkOptions(endpoint=f"serial:{wire.path}:921600"), SystemClock())
    with flying(link, autopilot):
        wait_for(lambda: link.statistics()["bad_frames"] >= 10)
        # What passes its checksum is right; what does not is gone, and the rest is found.
        check_attitude(wait_for(lambda: good_state(link, back_ms=400)), autopilot)
        assert link.statistics()["reconnects"] == 0 and link.statistics().get("restarts", 0) == 0


def test_without_the_right_to_real_time_priority_it_serves_all_the_same(monkeypatch, caplog):
    def refuse(*_):
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(link_module.os, "sched_setscheduler", refuse)
    caplog.set_level("INFO")
    wire = UdpWire()
    autopilot = FakeAutopilot(wire)
    link = AutopilotLink(LinkOptions(endpoint=f"udpout:127.0.0.1:{wire.port}"), SystemClock())
    with flying(link, autopilot):
        wait_for(link.connected)
    assert caplog.text.count("no real-time priority (Operation not permitted)") == 1
