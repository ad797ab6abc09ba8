"""What goes wrong between the autopilot and us, as one table: scenario, script, behaviour, what stays unaffected.

`SCENARIOS` is the table, and `docs/link.md` has it in words. Each script asserts its own behaviour: end to end, with
the real daemon over UDP, where that is what counts; on the protocol and a scripted clock where time would be long.
"""

from __future__ import annotations

import dataclasses
import math
import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from adapters.fake_autopilot import FakeAutopilot, PtyWire, UdpWire, Wire, dialect
from adapters.hovering import TRUE_NED, TRUTH, YAW, HoveringAutopilot, config, running, wait_for
from adapters.link_scenes import Flight
from adapters.test_mavlink import Script, check_attitude, estimate, good_state
from adapters.test_survival import BadLine
from replay import rendered

from ortholoc_edge.adapters.mavlink import AutopilotLink, LinkOptions
from ortholoc_edge.adapters.mavlink import link as link_module
from ortholoc_edge.adapters.mavlink import protocol as protocol_module
from ortholoc_edge.adapters.mavlink.estimates import Autopilot
from ortholoc_edge.adapters.mavlink.release import Release
from ortholoc_edge.adapters.mavlink.sources import SourceSwitch, Switch
from ortholoc_edge.clock import SystemClock
from ortholoc_edge.daemon import Daemon
from ortholoc_edge.geometry import rotation
from ortholoc_edge.geometry.rigid import Rigid3
from ortholoc_edge.pipeline.frame import VehicleState
from ortholoc_edge.pipeline.outcome import Fix, Outcome, Reason, Rejected
from ortholoc_edge.pipeline.tracker import Tracker, TrackerOptions
from ortholoc_edge.pipeline.witness import Consistency

MS, S = 1_000_000, 1_000_000_000


@pytest.fixture(scope="module")
def photos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("photos")
    photo = rendered.write_picture(folder / "photo_000.jpg", rendered.picture(TRUTH))
    for number in range(1, 480):
        (folder / f"photo_{number:03d}.jpg").hardlink_to(photo)
    return folder


@dataclasses.dataclass
class Stage:
    """The daemon on its way, the autopilot that it talks to, and what it made of the frames."""

    daemon: Daemon
    autopilot: HoveringAutopilot
    outcomes: list[Outcome]

    def odometry(self) -> list[Any]:
        return self.autopilot.messages("ODOMETRY")

    def fixes(self) -> int:
        return sum(isinstance(outcome, Fix) for outcome in list(self.outcomes))

    def refusal(self, words: str) -> Rejected:
        return wait_for(
            lambda: next((o for o in list(self.outcomes) if isinstance(o, Rejected) and words in o.detail), None), words
        )


Staged = Callable[..., Stage]


@pytest.fixture
def staged(photos: Path) -> Iterator[Staged]:
    stages: list[tuple[Stage, Any]] = []

    def make(autopilot: HoveringAutopilot | None = None, mute: bool = False, **link: Any) -> Stage:
        peer = autopilot or HoveringAutopilot(UdpWire())
        peer.mute = mute
        base = config(f"folder:{photos}", f"udpout:127.0.0.1:{peer.wire.port}")
        outcomes: list[Outcome] = []
        daemon = Daemon(
            msgspec.structs.replace(base, link=msgspec.structs.replace(base.link, send=("odometry",), **link)),
            on_outcome=lambda _, outcome: outcomes.append(outcome),
        )
        run = running(daemon)
        run.__enter__()
        stages.append((Stage(daemon, peer, outcomes), run))
        return stages[-1][0]

    yield make
    for stage, run in stages:
        run.__exit__(None, None, None)
        stage.autopilot.close()


def places_are_right(messages: list[Any]) -> bool:
    return all(np.linalg.norm(np.array([m.x, m.y, m.z]) - TRUE_NED) < 3.0 for m in messages)


# -- end to end, with the daemon ---------------------------------------------------------------


def no_heartbeat(staged: Staged, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(protocol_module, "_SILENT_AFTER_NS", 1 * S)
    stage = staged(mute=True)
    refused = stage.refusal("no autopilot heard on udpout:")
    assert refused.reason is Reason.BAD_ATTITUDE
    assert stage.daemon.statistics()["sent"] == 0 and stage.odometry() == []
    # Nothing of it stays once the heart beats.
    stage.autopilot.mute = False
    wait_for(stage.odometry, "an estimate")
    assert places_are_right(stage.odometry())
    # And falling silent is told with its age; the count is of what went out.
    stage.autopilot.mute = True
    stage.refusal("silent since")
    sent, arrived = stage.daemon.statistics()["sent"], len(stage.odometry())
    assert sent == arrived


def wrong_system_id(staged: Staged) -> None:
    stage = staged(system_id=5)
    refused = stage.refusal("system id 7")
    assert "system_id is 5" in refused.detail and refused.reason is Reason.BAD_ATTITUDE
    assert stage.daemon.statistics()["sent"] == 0
    # The stranger is neither asked nor told anything.
    assert stage.autopilot.got_counts["COMMAND_LONG"] == 0 and stage.odometry() == []
    assert stage.autopilot.got_counts["HEARTBEAT"] > 0


def reboot_in_flight(staged: Staged) -> None:
    stage = staged()
    before = wait_for(stage.odometry, "an estimate")[-1]
    stage.autopilot.reboot()
    wait_for(lambda: stage.daemon.link.restarts == 1, "the reboot noticed")
    seen = len(stage.odometry())
    after = wait_for(lambda: stage.odometry()[seen + 1 :], "estimates after it")
    assert {m.reset_counter for m in after} == {(before.reset_counter + 1) % 256}, "once, and it stays"
    assert dialect.MAVLINK_MSG_ID_ATTITUDE_QUATERNION in stage.autopilot.intervals_ns, "asked for again"
    assert places_are_right(stage.odometry())


def origin_changed(staged: Staged) -> None:
    stage = staged()
    before = wait_for(stage.odometry, "an estimate")[-1]
    home = stage.autopilot.origin
    # A last digit that wavers is no move.
    stage.autopilot.origin = (home[0] + 1, home[1], home[2] + 1)
    stage.autopilot._send(dialect.MAVLink_gps_global_origin_message(*stage.autopilot.origin))
    seen = len(stage.odometry())
    wavering = wait_for(lambda: stage.odometry()[seen + 2 :], "estimates", 20.0)
    assert {m.reset_counter for m in wavering} == {before.reset_counter}
    # A thousandth of a degree to the north.
    stage.autopilot.origin = (home[0] + 10_000, *home[1:])
    stage.autopilot._send(dialect.MAVLink_gps_global_origin_message(*stage.autopilot.origin))
    after = wait_for(
        lambda: [m for m in stage.odometry() if abs(m.x - before.x) > 50.0], "an estimate from the new origin"
    )[0]
    assert before.x - after.x == pytest.approx(111.2, abs=3.0)
    assert after.reset_counter == (before.reset_counter + 1) % 256


class Turned(HoveringAutopilot):
    """Its compass is half a turn wrong."""

    wrong = True

    def truth_at(self, now_ns: int) -> np.ndarray:
        if not self.wrong:
            return super().truth_at(now_ns)
        return rotation.from_euler(0.0, 0.0, math.pi) @ rendered.attitude(3.0, -4.0, YAW)


class Raised(HoveringAutopilot):
    """Its GNSS heights are of another datum, 50 m above ours."""

    wrong = True

    def _stream(self, message_id: int, now_ns: int) -> Any:
        message = super()._stream(message_id, now_ns)
        if message_id == dialect.MAVLINK_MSG_ID_GPS_RAW_INT and self.wrong:
            message.alt += 50_000
        return message


def _nothing_wrong_is_sent(stage: Stage, frames: int) -> None:
    wait_for(lambda: stage.daemon.link.statistics()["synchronised"], "synchronised")
    seen = len(stage.outcomes)
    wait_for(lambda: len(stage.outcomes) >= seen + frames, f"{frames} frames", 40.0)
    assert places_are_right(stage.odometry())
    # And nothing of it stays.
    stage.autopilot.wrong = False
    seen = len(stage.odometry())
    wait_for(lambda: stage.odometry()[seen:], "an estimate once it is right", 30.0)
    assert places_are_right(stage.odometry()) and stage.daemon.link.failure is None


def yaw_half_a_turn_wrong(staged: Staged) -> None:
    _nothing_wrong_is_sent(staged(Turned(UdpWire())), 6)
    # In flight, where its velocity goes the wrong way: no fix is carried on by it, each goes once as it is.
    flight = Flight()
    flight.reported_velocity = -flight.velocity
    release = Release(LinkOptions(endpoint="udp:x:1"))
    last = None
    for now in range(S, 8 * S, 10 * MS):
        if now % (500 * MS) == 0:
            release.take(flight.fix(now - 300 * MS), now, flight.look)
        last = release.due(now, flight.look) or last
    assert not release.displacement_trusted and release.counts["raw_instead"] >= 8
    assert last is not None and last.estimate.stamp_ns == last.capture_ns


def datum_50_m_wrong(staged: Staged) -> None:
    stage = staged(Raised(UdpWire()))
    _nothing_wrong_is_sent(stage, 6)
    assert stage.daemon.statistics()["gnss_consistency"] != Consistency.BAD, "horizontally it is right"


# -- over a real wire, without the daemon ------------------------------------------------------


def our_wall_clock_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    """1970, then tomorrow: stamps are of the monotonic clock."""
    wall = {"ns": 0}
    monkeypatch.setattr(link_module, "wall_clock_ns", lambda: wall["ns"])
    autopilot = FakeAutopilot(UdpWire())
    options = LinkOptions(endpoint=f"udpout:127.0.0.1:{autopilot.wire.port}", release="raw")
    with AutopilotLink(options, SystemClock()) as link:
        try:
            for wall_ns in (0, 1_800_000_000 * S, 1_700_000_000 * S):
                wall["ns"] = wall_ns
                check_attitude(wait_for(lambda: good_state(link), "a state"), autopilot)
                stamp = time.monotonic_ns()
                link.send_estimate(estimate(stamp))
                wait_for(
                    lambda stamp=stamp: any(
                        m.get_type() == "ODOMETRY" and m.time_usec == stamp // 1000 for m in list(autopilot.got)
                    ),
                    "the estimate with its own stamp",
                )
            assert link.statistics().get("restarts", 0) == 0
        finally:
            autopilot.close()


def round_trip_of_50_ms() -> None:
    """Both ways alike the offset would be right; what we say of it allows for the worst all the same."""
    autopilot = FakeAutopilot(BadLine(UdpWire(), delay_s=0.025))
    autopilot.yaw_rate = 0.1
    options = LinkOptions(endpoint=f"udpout:127.0.0.1:{autopilot.wire._wire.port}")
    with AutopilotLink(options, SystemClock()) as link:
        try:
            state = wait_for(lambda: good_state(link, back_ms=400), "a state")
            assert state.sync_uncertainty_ns >= 25 * MS
            error = rotation.angle_between(state.ned_from_body, autopilot.truth_at(state.stamp_ns))
            assert error < 0.1 * (state.sync_uncertainty_ns / 1e9 + 0.002), math.degrees(error)
            statistics = link.statistics()
            assert statistics["round_trip_ms"] >= 50 and statistics.get("restarts", 0) == 0
        finally:
            autopilot.close()


class SlowLine(Wire):
    """57600 baud: 5760 bytes/s each way, with a modest queue towards us and the kernel's from us; the autopilot's
    queue drops whole frames when it is full, as firmware does."""

    RATE = 5760.0

    def __init__(self, wire: PtyWire) -> None:
        self._wire = wire
        self._queue = bytearray()
        self._out_at = self._in_at = time.monotonic()
        self.dropped = 0

    def _allowance(self, since: float) -> int:
        return int((time.monotonic() - since) * self.RATE)

    def fileno(self) -> int:
        budget = self._allowance(self._out_at)
        if budget >= 16:
            self._out_at = time.monotonic()
            piece = bytes(self._queue[: min(budget, 512)])
            del self._queue[: len(piece)]
            if piece:
                self._wire.write(piece)
        return self._wire.fileno()

    def read(self) -> bytes:
        budget = min(self._allowance(self._in_at), 512)
        if budget < 16:
            time.sleep(0.003)
            return b""
        self._in_at = time.monotonic()
        return self._wire.read_some(budget)

    def write(self, data: bytes) -> None:
        if len(self._queue) + len(data) > 1200:
            self.dropped += 1
        else:
            self._queue += data

    def close(self) -> None:
        self._wire.close()


class ReadablePty(PtyWire):
    def read_some(self, count: int) -> bytes:
        return os.read(self.master, count)


def saturated_line() -> None:
    """The autopilot sends three times what fits, unasked; we offer 200 estimates a second."""
    wire = ReadablePty()
    line = SlowLine(wire)
    autopilot = FakeAutopilot(line)
    link = AutopilotLink(LinkOptions(endpoint=f"serial:{wire.path}:57600", release="raw"), SystemClock())
    with link:
        try:
            wait_for(lambda: link.statistics()["synchronised"] and link.vehicle is not None, "synchronised")
            for message_id, hz in ((31, 150), (32, 100), (24, 50)):
                autopilot.intervals_ns[message_id] = S // hz
            deadline = time.monotonic() + 2.0
            errors, offered = [], 0
            while time.monotonic() < deadline:
                offered += 1
                link.send_estimate(estimate(time.monotonic_ns()))
                state = link.state_at(time.monotonic_ns() - 600 * MS)
                if state is not None and state.ned_from_body is not None:
                    errors.append(rotation.angle_between(state.ned_from_body, autopilot.truth_at(state.stamp_ns)))
                time.sleep(0.005)
            assert line.dropped > 20, "it was saturated"
            statistics = link.statistics()
            assert statistics["estimates_dropped"] > offered / 4, "the newest replaced the others, none queued"
            # By arrival it would be the 0.2 s that the queue holds.
            assert errors and max(errors) < autopilot.yaw_rate * 0.08, "late, but of the right time"
            assert statistics.get("unsent", 0) <= 5, "estimates wait where a newer one takes their place"
            assert link.connected() and link.failure is None
            assert statistics.get("restarts", 0) == 0 and statistics["reconnects"] == 0
            arrived = [m.time_usec for m in list(autopilot.got) if m.get_type() == "ODOMETRY"]
            assert arrived == sorted(set(arrived)) and len(arrived) > 5
        finally:
            autopilot.close()


# -- on a scripted clock -----------------------------------------------------------------------


def autopilots_clock_steps(step_ms: int) -> None:
    """A turn at 20 deg/s: what is said of the attitude is right or nothing, and something again within a second."""
    script, rate, step = Script(), math.radians(20.0), 0

    def turn() -> None:
        script.attitude(rate * (script.now - 1000 * S) / S, rate=rate)
        script.local([0.0, 0.0, 0.0])

    def wrong_rad(stamp: int) -> float | None:
        known = script.protocol.state_at(stamp)
        if known is None or known.ned_from_body is None:
            return None
        return rotation.angle_between(
            known.ned_from_body, rotation.from_euler(0.0, 0.0, rate * (stamp - 1000 * S) / S)
        )

    script.run(15.0, move=turn)
    assert script.protocol.timesync.synchronised
    stepped = script.now
    script.offset_ns += step_ms * MS
    errors, unknown, step = [], 0, 20
    for _ in range(200):
        script.run(step / 1e3, move=turn)
        for back_ms in (0, 60, 100, 300, 900, 1500):
            stamp = script.now - back_ms * MS
            wrong = wrong_rad(stamp)
            if wrong is not None:
                errors.append(wrong)
            elif back_ms == 60:
                unknown += 1
    # 10 ms of the way, by arrival, are 0.2 degrees, and the watch lets pass what is wrong by 20 ms.
    assert max(errors) < math.radians(1.0), math.degrees(max(errors))
    assert unknown * step <= 1000, f"{unknown * step} ms without attitude"
    assert script.protocol.state_at(script.now).synchronised and script.now - stepped == 4 * S
    assert script.protocol.counts["restarts"] == 1, "and all is asked for again"


def spoof_ramp() -> None:
    """1 m/s away from where the camera sees us: the witness finds it, commands the source, and keeps our prior."""
    script = Script(switch_sources=True)
    georeference = rendered.georeference()
    tracker = Tracker(georeference, Rigid3(np.diag([1.0, -1.0, -1.0]), np.zeros(3)), TrackerOptions())
    switch = SourceSwitch(script.protocol._options)
    centre = TRUTH.translation
    place = georeference.geodetic_from_map(centre)
    sigma = tuple(np.radians([1.0, 1.0, 3.0]))
    found_after_m, drawn_m = None, 0.0
    script.run(2.0, move=lambda: (script.attitude(0.0), script.local([0.0, 0.0, 0.0])))
    for tick in range(4 * 60):
        away_m = max(0.0, tick / 4.0 - 20.0)
        script.run(0.25, move=lambda: (script.attitude(0.0), script.local([0.0, 0.0, 0.0])))
        lat = round((place.lat_deg + away_m / 111_230.0) * 1e7)
        script.hear(
            dialect.MAVLink_gps_raw_int_message(
                script.boot_ms() * 1000, 3, lat, round(place.lon_deg * 1e7), round(place.height_amsl_m * 1e3), 80, 120,
                0, 0, 14, h_acc=1500, v_acc=2500,
            )
        )  # fmt: skip
        known = script.protocol.state_at(script.now)
        assert known is not None and known.gnss is not None and known.ned_from_body is not None
        position = georeference.map_from_geodetic(
            known.gnss.latitude_deg, known.gnss.longitude_deg, height_amsl_m=known.gnss.height_amsl_m
        )
        state = VehicleState(
            script.now, known.ned_from_body, sigma, known.odometry_ned_m, known.odometry_epoch, position, (1.5, 2.5)
        )
        prior = tracker.predict(state)
        assert not isinstance(prior, Rejected), "the chain of fixes goes on"
        drawn_m = max(drawn_m, float(np.linalg.norm((prior.map_from_camera.translation - centre)[:2])))
        tracker.update(fix_at(centre, script.now), state)
        consistency = tracker.witness.report.state
        command = switch.decide(consistency, True, Autopilot.ARDUPILOT, 0, script.now, vision_posxy=6)
        if isinstance(command, Switch):
            script.protocol.source_set.ask(command.number)
        if consistency is Consistency.BAD and found_after_m is None:
            found_after_m = away_m
        assert away_m > 0.0 or consistency is not Consistency.BAD, "no false alarm"
    assert found_after_m is not None and found_after_m < 20.0, found_after_m
    assert script.commands(42007) and set(script.commands(42007)) == {2}
    assert drawn_m < 3.0, "GNSS never moved the prior"
    assert tracker.reset_counter == 1, "the first fix, and nothing since"


def fix_at(position: np.ndarray, stamp_ns: int) -> Fix:
    return Fix(
        stamp_ns=stamp_ns,
        map_from_camera=Rigid3(np.diag([1.0, -1.0, -1.0]), position),
        camera=rendered.CAMERA,
        covariance=np.diag(np.square([0.5] * 3 + [0.005] * 3)),
        quality=0.8,
        matches=200,
        inliers=160,
        rms_px=1.2,
        adhop_accepted=None,
        query_px=np.zeros((160, 2)),
        points_map=np.zeros((160, 3)),
    )


# Scenario: (script, behaviour, what stays unaffected); the words are those of docs/link.md.
SCENARIOS: dict[str, tuple[Callable[..., None], tuple[Any, ...], str, str]] = {
    "no heartbeat": (
        no_heartbeat, (), "frames are refused, naming the endpoint or the seconds of silence; nothing is sent",
        "frames go on; fixes flow as soon as the heart beats",
    ),
    "wrong system id": (
        wrong_system_id, (), "frames are refused, naming both ids; that autopilot is neither asked nor told anything",
        "our heartbeat",
    ),
    "autopilot reboots in flight": (
        reboot_in_flight, (), "all streams are asked for again; the next estimate has the reset counter + 1",
        "the chain of fixes",
    ),
    "origin changed": (
        origin_changed, (), "estimates count from the new one, reset counter + 1; less than 0.1 m is no change",
        "the chain of fixes",
    ),
    "autopilot's clock + 0.9 s": (
        autopilots_clock_steps, (900,), "attitude is right or not known, and known within 1 s, as after a restart",
        "what was sent before",
    ),
    "autopilot's clock - 0.9 s": (
        autopilots_clock_steps, (-900,), "the same", "the same",
    ),
    "our wall clock steps": (
        our_wall_clock_steps, (), "nothing: stamps are of the monotonic clock (`GPS_INPUT` alone needs the date)",
        "all",
    ),
    "round trip of 50 ms": (
        round_trip_of_50_ms, (), "the stated uncertainty of the clocks is half of it, and holds",
        "attitude at the stamp",
    ),
    "57600 baud, saturated": (
        saturated_line, (), "the newest estimate replaces those that wait; attitudes come late, of the right time",
        "the link: no reconnect, no restart",
    ),
    "GNSS spoofed, 1 m/s": (
        spoof_ramp, (), "found before 20 m; vision is commanded where enabled; GNSS never moves the prior",
        "the chain of fixes",
    ),
    "yaw half a turn wrong": (
        yaw_half_a_turn_wrong, (), "no wrong fix is sent; no fix is carried on by its velocity",
        "fixes flow as soon as it is right",
    ),
    "heights 50 m wrong": (
        datum_50_m_wrong, (), "no wrong fix is sent", "GNSS's horizontal verdict; fixes flow as soon as it is right",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", SCENARIOS)
def test_scenario(name: str, request: pytest.FixtureRequest) -> None:
    script, arguments, _, _ = SCENARIOS[name]
    wanted = [request.getfixturevalue(fixture) for fixture in ("staged", "monkeypatch")
              if fixture in script.__code__.co_varnames[: script.__code__.co_argcount]]  # fmt: skip
    script(*wanted, *arguments)


def test_the_table_of_the_documentation_is_this_one() -> None:
    text = (Path(__file__).parents[2] / "docs" / "link.md").read_text(encoding="utf-8")
    for name, (_, _, behaviour, unaffected) in SCENARIOS.items():
        assert f"| {name} | {behaviour} | {unaffected} |" in text, name
