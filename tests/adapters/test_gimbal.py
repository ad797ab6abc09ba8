"""A camera in a gimbal: from the bytes of its reports to the pose of the body that a fix gives.

What a gimbal reports is made here from where it looks (azimuth, depression, and its own roll about the line of
sight) with a compass and a plumb line, not with the code under test.
"""

from __future__ import annotations

import itertools
import logging
import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ortholoc_sim.site import Site
from pipeline.scenes_pipeline import fix
from pymavlink.dialects.v20 import ardupilotmega as dialect
from replay import rendered

from ortholoc_edge.adapters.mavlink import LinkOptions
from ortholoc_edge.adapters.mavlink.geodesy import EarthModel, GeodeticOrigin
from ortholoc_edge.adapters.mavlink.gimbal import GimbalSelection
from ortholoc_edge.adapters.mavlink.protocol import LinkProtocol
from ortholoc_edge.config import MountOptions
from ortholoc_edge.geometry import frames, rotation
from ortholoc_edge.geometry.arrays import FloatArray
from ortholoc_edge.geometry.rigid import Rigid3
from ortholoc_edge.pipeline import gate
from ortholoc_edge.pipeline.frame import CameraMount, VehicleState
from ortholoc_edge.pipeline.outcome import Reason, Rejected
from ortholoc_edge.pipeline.prior import PosePrior
from ortholoc_edge.pipeline.tracker import Tracker, TrackerOptions
from ortholoc_edge.vehicle import vision_estimate

MS, S = 1_000_000, 1_000_000_000
IN_VEHICLE, IN_EARTH, LOCKED = 32, 64, 16


def looking(azimuth_deg: float, depression_deg: float, roll_deg: float = 0.0) -> FloatArray:
    """Axes (columns forward, right, down) of something that looks along a compass bearing and down by an angle."""
    a, d, r = np.radians([azimuth_deg, depression_deg, roll_deg])
    forward = np.array([math.cos(d) * math.cos(a), math.cos(d) * math.sin(a), math.sin(d)])
    level_right = np.array([-math.sin(a), math.cos(a), 0.0])
    right = math.cos(r) * level_right + math.sin(r) * np.cross(forward, level_right)
    return np.stack([forward, right, np.cross(forward, right)], axis=1)


def status(ms: int, axes: FloatArray, flags: int, **more: Any) -> Any:
    q = [float(v) for v in rotation.to_quaternion(axes)]
    values = {"delta_yaw": math.nan, "delta_yaw_velocity": math.nan, "gimbal_device_id": 1} | more
    failures = values.pop("failure_flags", 0)
    return dialect.MAVLink_gimbal_device_attitude_status_message(
        0, 0, ms, flags, values.pop("q", q), math.nan, math.nan, math.nan, failures, **values
    )


class Link:
    """A LinkProtocol on a scripted clock beside a vehicle whose boot time is ours less 50 s, 5 ms away."""

    def __init__(self, selection: GimbalSelection | None = GimbalSelection()) -> None:  # noqa: B008  frozen
        self.protocol = LinkProtocol(LinkOptions(endpoint="udp:x:1"), selection)
        self.now = 1000 * S
        self.said: list[Any] = []
        self.hear(dialect.MAVLink_heartbeat_message(2, 3, 128, 0, 4, 3))
        for _ in range(12):
            self.go(100)

    @property
    def ms(self) -> int:
        return (self.now - 50 * S) // MS

    def hear(self, message: Any, component: int = 1, system: int = 7, late_ms: int = 5) -> None:
        (decoded,) = dialect.MAVLink(None, 0, 0).parse_buffer(message.pack(dialect.MAVLink(None, system, component)))
        self.protocol.on_message(decoded, self.now + late_ms * MS)

    def go(self, step_ms: int) -> None:
        self.now += step_ms * MS
        if self.now % S < step_ms * MS:
            self.hear(dialect.MAVLink_heartbeat_message(2, 3, 128, 0, 4, 3))
        for message in self.protocol.poll(self.now):
            self.said.append(message)
            if message.get_type() == "TIMESYNC":
                self.hear(dialect.MAVLink_timesync_message(self.now + 5 * MS - 50 * S, message.ts1), late_ms=10)

    def attitude(self, ned_from_body: FloatArray) -> None:
        q = rotation.to_quaternion(ned_from_body)
        self.hear(dialect.MAVLink_attitude_quaternion_message(self.ms, *map(float, q), 0.0, 0.0, 0.0))

    def fly(
        self,
        seconds: float,
        attitude: Callable[[int], FloatArray],
        report: Callable[[Link], None],
        step_ms: int = 50,
    ) -> None:
        """Telemetry every ``step_ms``; ``attitude`` of our clock."""
        for _ in range(round(seconds * 1000 / step_ms)):
            self.go(step_ms)
            self.attitude(attitude(self.now))
            report(self)

    def gimbal(self, ago_ms: int = 120) -> FloatArray | None:
        state = self.protocol.state_at(self.now - ago_ms * MS)
        assert state is not None and state.synchronised
        return state.ned_from_gimbal

    def asked(self) -> list[tuple[int, int, float]]:
        return [
            (m.target_component, int(m.param1), m.param2)
            for m in self.said
            if m.get_type() == "COMMAND_LONG" and m.command == dialect.MAV_CMD_SET_MESSAGE_INTERVAL
        ]


def degrees_off(a: FloatArray | None, b: FloatArray) -> float:
    assert a is not None
    return math.degrees(rotation.angle_between(a, b))


LEVEL = looking(0.0, 0.0)

# -- conventions: what is reported of a gimbal that looks so, on a vehicle that heads so -------------------------


def by_status(flags: int, from_north: bool) -> Callable[[int, float, tuple[float, float, float]], Any]:
    def make(ms: int, heading_deg: float, look: tuple[float, float, float]) -> Any:
        azimuth, depression, roll = look
        return status(ms, looking(azimuth if from_north else azimuth - heading_deg, depression, roll), flags)

    return make


def by_orientation(absolute: bool) -> Callable[[int, float, tuple[float, float, float]], Any]:
    def make(ms: int, heading_deg: float, look: tuple[float, float, float]) -> Any:
        azimuth, depression, roll = look
        relative = math.nan if absolute else (azimuth - heading_deg + 180.0) % 360.0 - 180.0
        return dialect.MAVLink_mount_orientation_message(ms, roll, -depression, relative, azimuth if absolute else 0.0)

    return make


CONVENTIONS = {
    "vehicle": by_status(IN_VEHICLE, False),
    "vehicle, locked, as ArduPilot": by_status(IN_VEHICLE | LOCKED | 4 | 8, False),
    "earth": by_status(IN_EARTH, True),
    "earth, locked": by_status(IN_EARTH | LOCKED, True),
    "no frame, locked": by_status(LOCKED, True),
    "no frame": by_status(0, False),
    "MOUNT_ORIENTATION": by_orientation(False),
    "MOUNT_ORIENTATION, absolute": by_orientation(True),
}
# Bearing, nose down, bank.
ATTITUDES = [(0.0, 0.0, 0.0), (130.0, 0.0, 30.0), (250.0, 12.0, -30.0), (-75.0, -20.0, 8.0)]
LOOKS = [(40.0, 90.0, 0.0), (200.0, 60.0, 0.0), (310.0, 35.0, 4.0), (130.0, 45.0, -3.0)]

SITE = Site(rendered.georeference(), np.array([*rendered.pose().translation[:2], 430.0]))
ORIGIN = GeodeticOrigin(SITE.origin.lat_deg, SITE.origin.lon_deg, SITE.origin.height_amsl_m)
MOUNT = MountOptions(
    preset="forward", gimbal="auto", lever_arm_m=(0.4, -0.1, 0.15), gimbal_arm_m=(0.05, 0.02, -0.03), roll_deg=90.0
)


@pytest.mark.parametrize("name", CONVENTIONS)
@pytest.mark.parametrize("attitude", ATTITUDES)
@pytest.mark.parametrize("look", LOOKS)
def test_a_fix_of_the_camera_gives_the_true_pose_of_the_body(
    name: str, attitude: tuple[float, float, float], look: tuple[float, float, float]
) -> None:
    ned_from_body = looking(*attitude)
    link = Link()
    link.fly(0.5, lambda _: ned_from_body, lambda it: it.hear(CONVENTIONS[name](it.ms, attitude[0], look)))
    state = link.protocol.state_at(link.now - 70 * MS)
    assert state is not None and state.interpolated and state.ned_from_gimbal is not None
    assert degrees_off(state.ned_from_gimbal, looking(*look)) < 1e-3

    # The truth: body, then 0.4 m forward, 0.1 m left, 0.15 m down of it the pivot, then the arm of the gimbal; the
    # camera lies on its right side in it.
    body_ned = np.array([30.0, -20.0, -85.0])
    axes = looking(*look)
    camera_ned = body_ned + ned_from_body @ [0.4, -0.1, 0.15] + axes @ [0.05, 0.02, -0.03]
    forward, right, down = axes.T
    ned_from_camera = np.stack([down, -right, forward], axis=1)
    eye = SITE.map_from_ned(camera_ned)
    map_from_ned = frames.map_from_ned_rotation(SITE.georeference.convergence_rad(eye[:2]))
    found = fix(eye, rotation_matrix=map_from_ned @ ned_from_camera)

    assert state.ned_from_body is not None
    mount = CameraMount(MOUNT.body_from_camera_in(state.ned_from_body.T @ state.ned_from_gimbal), (0.01, 0.02))
    sigma = (0.01, 0.01, 0.05)
    tracker = Tracker(SITE.georeference, None, TrackerOptions())
    now = VehicleState(0, state.ned_from_body, sigma, position_map_m=SITE.map_from_ned(body_ned), mount=mount)
    prior = tracker.predict(now)
    assert isinstance(prior, PosePrior)
    # The lever arm is not scaled to the grid: 0.2 mm.
    assert np.linalg.norm(prior.map_from_camera.translation - eye) < 1e-3
    assert degrees_off(prior.map_from_camera.rotation, found.map_from_camera.rotation) < 2e-3
    tracker.update(found, now)
    again = tracker.predict(VehicleState(0, np.eye(3), sigma, mount=CameraMount(Rigid3.identity())))
    assert isinstance(again, PosePrior)
    assert np.linalg.norm(again.map_from_camera.translation - SITE.map_from_ned(body_ned)) < 1e-3

    sent = vision_estimate(
        found, found.map_from_camera @ mount.body_from_camera.inverse(), SITE.georeference,
        ORIGIN, EarthModel.ARDUPILOT, 0, mount.sigma_rad,
    )  # fmt: skip
    assert np.linalg.norm(sent.position_ned_m - SITE.autopilot_from_ned(body_ned)) < 1e-3
    assert degrees_off(sent.ned_from_body, ned_from_body) < 2e-3
    # The fix knows its rotation to 0.005; the gimbal that it is seen through comes on top.
    assert np.sqrt(np.diag(sent.covariance)[3:]) == pytest.approx(np.hypot(0.005, [0.01, 0.01, 0.02]))


def test_the_example_of_the_docs() -> None:
    text = (Path(__file__).resolve().parents[2] / "docs" / "frames.md").read_text(encoding="utf-8")
    example = text[text.index("Example: a vehicle heads 130") :]
    quoted = re.search(r"q = \(([^)]*)\)", example)
    assert quoted is not None
    q = [float(v) for v in quoted[1].split(",")]
    link = Link()
    body = looking(130.0, 0.0, 30.0)
    link.fly(0.5, lambda _: body, lambda it: it.hear(status(it.ms, LEVEL, IN_VEHICLE, q=q)))
    found = link.gimbal()
    assert found is not None

    def said(axes: FloatArray) -> list[str]:
        forward = axes[:, 0]
        ground = forward / forward[2] * 90.0
        bearing = math.degrees(math.atan2(forward[1], forward[0]))
        return [f"{bearing:.1f}", f"{math.degrees(math.asin(forward[2])):.1f}", f"{-ground[0]:.1f}", f"{ground[1]:.1f}"]

    right, wrong = looking(150.0, 60.0), body @ looking(20.0, 60.0)
    assert degrees_off(found, right) < 0.1  # of the three decimals
    assert said(right)[2:] == ["45.0", "26.0"]
    assert "45.0 m south and 26.0 m east" in " ".join(example.split())
    bearing, down, south, east = said(wrong)
    assert f"a bearing of {bearing}° and {down}° below the horizon, {south} m south and {east} m east" in " ".join(
        example.split()
    )
    in_body = ", ".join(f"{v:.3f}" for v in (body.T @ right)[:, 0])
    assert f"({in_body})" in example


# -- time ------------------------------------------------------------------------------------------------------


def sweeping(now_ns: int) -> tuple[float, float]:
    """Azimuth relative to the nose, depression: 40 and 20 degrees in a second."""
    seconds = now_ns / S - 1000.0
    return 40.0 * seconds, 30.0 + 20.0 * seconds


def turning(now_ns: int) -> FloatArray:
    """A banked turn of 25 degrees in a second."""
    return looking(25.0 * (now_ns / S - 1000.0), 0.0, 30.0)


def where(now_ns: int) -> FloatArray:
    azimuth, depression = sweeping(now_ns)
    return looking(azimuth + 25.0 * (now_ns / S - 1000.0), depression)


@pytest.mark.parametrize("delay_ms", [0, 40])
@pytest.mark.parametrize("component", [1, 154])
def test_the_attitude_is_that_of_the_exposure(delay_ms: int, component: int) -> None:
    """Reports late by a known delay, by the autopilot's clock or by one of the gimbal's own that is hours off."""
    transport_ms = 5
    told = delay_ms + (transport_ms if component != 1 else 0)
    link = Link(GimbalSelection(delay_ns=told * MS))

    def report(it: Link) -> None:
        then = it.now - delay_ms * MS
        ms = it.ms if component == 1 else it.ms + 7_200_000
        it.hear(status(ms, looking(*sweeping(then)), IN_VEHICLE), component, late_ms=transport_ms)

    link.fly(2.0, turning, report)
    for ago_ms in (110, 135, 160):
        stamp = link.now - ago_ms * MS
        # Chords of 50 ms over a curve.
        assert degrees_off(link.gimbal(ago_ms), where(stamp)) < 0.05
    late = Link()
    late.fly(2.0, turning, report)
    if told:
        assert degrees_off(late.gimbal(110), where(late.now - 110 * MS)) > 0.2


def test_nothing_is_known_far_from_the_reports() -> None:
    link = Link(GimbalSelection(max_age_ns=150 * MS))
    looks = looking(90.0, 70.0)
    link.fly(1.0, lambda _: LEVEL, lambda it: it.hear(status(it.ms, looks, IN_EARTH)))
    link.fly(0.4, lambda _: LEVEL, lambda it: None)
    state = link.protocol.state_at(link.now - 280 * MS)
    assert state is not None and state.ned_from_gimbal is not None
    assert not state.interpolated, "a report that may still come would be better than holding the last one"
    state = link.protocol.state_at(link.now - 240 * MS)
    assert state is not None and state.ned_from_gimbal is None and state.ned_from_body is not None
    assert state.interpolated, "waiting for a gimbal that is gone would only make the rejection late"
    now = VehicleState(0, state.ned_from_body, (0.02, 0.02, 0.05), position_map_m=np.zeros(3))
    refused = Tracker(SITE.georeference, None, TrackerOptions()).predict(now)
    assert isinstance(refused, Rejected)
    assert refused.reason is Reason.GIMBAL_UNKNOWN
    assert "gimbal" in refused.detail


@pytest.mark.parametrize("component", [1, 154])
def test_what_it_turned_since_the_last_report_is_not_taken_for_known(component: int) -> None:
    link = Link()

    def report(it: Link) -> None:
        it.hear(status(it.ms, looking(*sweeping(it.now)), IN_VEHICLE), component, late_ms=0)

    link.fly(1.0, turning, report)
    rate = rotation.angle_between(looking(*sweeping(link.now - 50 * MS)), looking(*sweeping(link.now))) / 0.05
    time_s = 0.010 if component == 1 else 0.025
    known = link.protocol.state_at(link.now - 70 * MS)
    assert known is not None and known.gimbal_sigma_rad == pytest.approx(rate * time_s, rel=0.1)
    for ahead_ms in (20, 100, 180):
        held = link.protocol.state_at(link.now + ahead_ms * MS)
        assert held is not None and held.ned_from_gimbal is not None and not held.interpolated
        assert held.gimbal_sigma_rad == pytest.approx(rate * math.hypot(time_s, ahead_ms / 1000.0), rel=0.1)
        # The vehicle's heading is carried on without rates here: 25 degrees in a second.
        off = degrees_off(held.ned_from_gimbal, where(link.now + ahead_ms * MS)) - 25.0 * ahead_ms / 1000.0
        assert off < 1.2 * math.degrees(held.gimbal_sigma_rad)
    still = Link()
    still.fly(1.0, turning, lambda it: it.hear(status(it.ms, HERE, IN_VEHICLE), component))
    state = still.protocol.state_at(still.now + 100 * MS)
    assert state is not None and state.gimbal_sigma_rad < 1e-6


def test_two_frames_of_yaw_are_not_mixed() -> None:
    """The gimbal goes from following the nose to holding a bearing: between the two there is no rotation to follow."""
    link = Link()
    body = looking(120.0, 0.0)
    link.fly(0.5, lambda _: body, lambda it: it.hear(status(it.ms, looking(0.0, 45.0), IN_VEHICLE)))
    switched = link.now
    link.fly(0.3, lambda _: body, lambda it: it.hear(status(it.ms, looking(120.0, 45.0), IN_EARTH | LOCKED)))
    for stamp in range(switched - 100 * MS, switched + 150 * MS, 10 * MS):
        assert degrees_off(link.gimbal((link.now - stamp) // MS), looking(120.0, 45.0)) < 1e-3


def test_a_restart_of_the_autopilot_forgets_and_asks_again() -> None:
    link = Link()
    link.fly(1.0, lambda _: LEVEL, lambda it: it.hear(status(it.ms, LEVEL, IN_EARTH)))
    before = len([a for a in link.asked() if a[1] == 285])
    link.hear(dialect.MAVLink_system_time_message(0, 100))
    state = link.protocol.state_at(link.now)
    assert state is not None and state.ned_from_gimbal is None
    link.go(20)
    assert len([a for a in link.asked() if a[1] == 285]) == before + 1


def test_stamps_left_out_are_placed_by_arrival() -> None:
    link = Link(GimbalSelection(delay_ns=5 * MS))

    def report(it: Link) -> None:
        azimuth, depression = sweeping(it.now)
        it.hear(dialect.MAVLink_mount_orientation_message(0, 0.0, -depression, azimuth))

    link.fly(1.0, turning, report)
    assert link.protocol.counts["restarts"] == 0
    assert degrees_off(link.gimbal(120), where(link.now - 120 * MS)) < 0.05


# -- which gimbal ----------------------------------------------------------------------------------------------

HERE, THERE = looking(10.0, 80.0), looking(200.0, 20.0)


def both(it: Link, first: tuple[int, int], second: tuple[int, int]) -> None:
    """Reports of two gimbals, each (component, device id): the first looks HERE, the second THERE."""
    for (component, device), looks in ((first, HERE), (second, THERE)):
        it.hear(status(it.ms, looks, IN_EARTH, gimbal_device_id=device), component)


@pytest.mark.parametrize(
    ("device", "first", "second"),
    [
        (1, (1, 1), (1, 2)),
        (2, (1, 2), (1, 1)),
        (1, (1, 0), (154, 0)),
        (154, (154, 0), (1, 1)),
        (171, (171, 0), (154, 0)),
        # The autopilot reports a gimbal with a voice of its own once more; its stamps are of its own clock.
        (None, (1, 1), (154, 0)),
    ],
)
def test_the_camera_s_gimbal_is_the_one_configured(
    device: int | None, first: tuple[int, int], second: tuple[int, int]
) -> None:
    link = Link(GimbalSelection(device))
    assert link.protocol.statistics(link.now)["gimbal"] == "none heard"
    link.fly(0.5, lambda _: LEVEL, lambda it: both(it, first, second))
    assert degrees_off(link.gimbal(), HERE) < 1e-3
    told = f"GIMBAL_DEVICE_ATTITUDE_STATUS of component {first[0]}, device {first[1] or 1}"
    assert link.protocol.statistics(link.now)["gimbal"] == told


@pytest.mark.parametrize(("first", "second"), [((1, 1), (1, 2)), ((154, 0), (171, 0))])
def test_two_of_a_kind_are_not_guessed_between(
    first: tuple[int, int], second: tuple[int, int], caplog: pytest.LogCaptureFixture
) -> None:
    link = Link()
    link.fly(0.5, lambda _: LEVEL, lambda it: both(it, first, second))
    assert link.gimbal() is None
    assert str(link.protocol.statistics(link.now)["gimbal"]).count("component") == 2
    (line,) = [r.getMessage() for r in caplog.records if "gimbals report" in r.getMessage()]
    assert "gimbal_device" in line
    # One of them ends: what is left is plain again.
    component, device = first
    link.fly(
        3.0, lambda _: LEVEL, lambda it: it.hear(status(it.ms, HERE, IN_EARTH, gimbal_device_id=device), component)
    )
    assert degrees_off(link.gimbal(), HERE) < 1e-3


def test_another_source_takes_over_when_the_better_one_ends() -> None:
    link = Link()
    link.fly(0.5, lambda _: LEVEL, lambda it: both(it, (1, 1), (154, 0)))
    link.fly(3.0, lambda _: LEVEL, lambda it: it.hear(status(it.ms, THERE, IN_EARTH, gimbal_device_id=0), 154))
    assert degrees_off(link.gimbal(), THERE) < 1e-3


def test_gimbals_of_other_vehicles_and_invented_ones() -> None:
    link = Link()
    link.fly(0.5, lambda _: LEVEL, lambda it: it.hear(status(it.ms, HERE, IN_EARTH), 154, system=9))
    assert link.gimbal() is None
    for component, device in itertools.product(range(100, 180), range(7)):
        link.hear(status(link.ms, THERE, IN_EARTH, gimbal_device_id=device), component)
    assert link.protocol.telemetry.gimbal is not None
    assert len(link.protocol.telemetry.gimbal._sources) <= 8


def test_without_a_gimbal_nothing_is_asked_or_taken() -> None:
    link = Link(None)
    link.fly(4.0, lambda _: LEVEL, lambda it: both(it, (1, 1), (154, 0)))
    assert link.gimbal() is None
    assert link.protocol.statistics(link.now)["gimbal"] is None
    assert not {285, 265} & {message for _, message, _ in link.asked()}
    assert link.protocol.counts["ignored"] > 0


@pytest.mark.parametrize(("device", "component"), [(None, 1), (2, 1), (154, 154)])
def test_reports_are_asked_for_at_20_hz_of_whoever_has_them(device: int | None, component: int) -> None:
    link = Link(GimbalSelection(device))
    link.fly(4.0, lambda _: LEVEL, lambda it: None)
    asked = [a for a in link.asked() if a[1] in (285, 265)]
    assert asked[0] == (component, 285, 50_000.0)
    # What nearly every gimbal of today refuses is asked for only where the other does not come.
    assert (component, 265, 50_000.0) in asked[1:]
    other = Link(GimbalSelection(device))
    other.fly(
        6.0, lambda _: LEVEL, lambda it: it.hear(status(it.ms, HERE, IN_EARTH, gimbal_device_id=device or 1), component)
    )
    assert [a for a in other.asked() if a[1] in (285, 265)] == [(component, 285, 50_000.0)]


# -- what can't be true ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "message",
    [
        lambda ms: status(ms, HERE, IN_EARTH, q=[math.nan] * 4),
        lambda ms: status(ms, HERE, IN_EARTH, q=[0.0] * 4),
        lambda ms: status(ms, HERE, IN_EARTH, q=[3.0, 0.0, 0.0, 0.0]),
        lambda ms: status(ms, HERE, IN_EARTH | IN_VEHICLE),
        lambda ms: status(ms, HERE, IN_EARTH, failure_flags=8),
        lambda ms: status(ms, HERE, IN_EARTH, failure_flags=256),
        lambda ms: dialect.MAVLink_mount_orientation_message(ms, math.nan, 0.0, 0.0),
        lambda ms: dialect.MAVLink_mount_orientation_message(ms, 0.0, -9000.0, 0.0),
        lambda ms: dialect.MAVLink_mount_orientation_message(ms, 0.0, -90.0, math.nan, 0.0),
    ],
)
def test_reports_that_say_nothing_are_dropped(message: Callable[[int], Any], caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.WARNING)
    link = Link()
    link.fly(0.5, lambda _: LEVEL, lambda it: it.hear(message(it.ms)))
    assert link.gimbal() is None
    assert link.protocol.counts["garbage.gimbal"] == 10
    assert sum("gimbal reported" in r.getMessage() for r in caplog.records) == 1


def test_a_motor_at_its_limit_still_knows_where_it_looks() -> None:
    link = Link()
    link.fly(0.5, lambda _: LEVEL, lambda it: it.hear(status(it.ms, HERE, IN_EARTH, failure_flags=2)))
    assert degrees_off(link.gimbal(), HERE) < 1e-3


@pytest.mark.parametrize(("flags", "known"), [(IN_VEHICLE, False), (IN_EARTH, True)])
def test_a_nose_that_points_up_has_no_heading(flags: int, known: bool) -> None:
    link = Link()
    link.fly(0.5, lambda _: looking(30.0, -88.0), lambda it: it.hear(status(it.ms, HERE, flags)))
    assert (link.gimbal() is not None) is known


# -- how much it may be off ------------------------------------------------------------------------------------


def test_the_gate_allows_for_autopilot_and_gimbal_together() -> None:
    """PnP against telemetry: the sigmas of both, in tilt and in heading."""
    looks = MOUNT.body_from_camera_in(looking(0.0, 60.0))
    sigma = (math.radians(1.0), math.radians(1.0), math.radians(3.0))
    position = np.array([*SITE.anchor_map_m[:2], 520.0])

    def prior(mount_sigma_deg: tuple[float, float]) -> PosePrior:
        tilt, heading = (math.radians(s) for s in mount_sigma_deg)
        state = VehicleState(
            0, looking(70.0, 0.0, 30.0), sigma, position_map_m=position, position_sigma_m=(2.0, 3.0),
            mount=CameraMount(looks, (tilt, heading)),
        )  # fmt: skip
        made = Tracker(SITE.georeference, None, TrackerOptions()).predict(state)
        assert isinstance(made, PosePrior)
        return made

    both_known = prior((2.0, 4.0))
    assert math.degrees(both_known.tilt_sigma_rad) == pytest.approx(math.hypot(1.0, 2.0))
    assert math.degrees(both_known.heading_sigma_rad) == pytest.approx(5.0)
    covariance = np.diag(np.square([0.5] * 3 + [math.radians(0.3)] * 3))

    def refused(off_deg: list[float], against: PosePrior) -> Reason | None:
        pose = against.map_from_camera
        off = Rigid3(rotation.exp(np.radians(off_deg)) @ pose.rotation, pose.translation)
        verdict = gate.agrees_with(against, off, covariance, gate.GateOptions())
        return None if verdict is None else verdict.reason

    limit = 5.0 * math.sqrt(1.0 + 2.0**2 + 0.3**2)
    for axis in ([1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.6, -0.8, 0.0]):
        assert refused([0.97 * limit * v for v in axis], both_known) is None
        assert refused([1.03 * limit * v for v in axis], both_known) is Reason.GRAVITY_DISAGREES
    assert refused([0.0, 0.0, 24.0], both_known) is None
    assert refused([0.0, 0.0, 26.0], both_known) is Reason.PRIOR_DISAGREES
    # Without the gimbal's part right poses would be refused.
    assert refused([0.8 * limit, 0.0, 0.0], prior((1e-6, 1e-6))) is Reason.GRAVITY_DISAGREES
