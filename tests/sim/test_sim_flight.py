"""The closed loop: flown by good estimates it stays on its route without GNSS, and without them it does not."""

from __future__ import annotations

import threading
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest
from ortholoc_sim import demo_pack_path
from ortholoc_sim.autopilot import AutopilotOptions, FilterOptions, GimbalOptions, SensorOptions, Verdict, dialect
from ortholoc_sim.flight import Bench, FlightOptions, draw_track, make_report, run_flight
from ortholoc_sim.loop import ClosedLoop, LoopOptions
from ortholoc_sim.site import Site
from ortholoc_sim.vehicle import Vehicle, VehicleOptions, attitude_of
from ortholoc_sim.world import WorldSpec

from ortholoc_edge.adapters.camera import EndOfFrames
from ortholoc_edge.adapters.mavlink import GimbalSelection, LinkOptions
from ortholoc_edge.adapters.mavlink.codec import FrameParser
from ortholoc_edge.adapters.mavlink.estimates import VisionEstimate
from ortholoc_edge.adapters.mavlink.geodesy import Place
from ortholoc_edge.adapters.mavlink.monitor import Fusion
from ortholoc_edge.adapters.mavlink.protocol import LinkProtocol
from ortholoc_edge.geometry import rotation
from ortholoc_edge.geometry.arrays import FloatArray
from ortholoc_edge.pipeline.frame import Frame
from ortholoc_edge.pipeline.outcome import Fix, Outcome, Reason, Rejected
from ortholoc_edge.tiles.pack import Pack

S = 1_000_000_000
START = 5_000 * S


def route(site: Site) -> FloatArray:
    corners = np.array([[-150.0, -120.0], [90.0, -130.0], [170.0, 0.0], [110.0, 130.0], [-140.0, 130.0]])
    return np.column_stack([corners + site.anchor_map_m[:2], np.full(5, site.anchor_map_m[2] + 90.0)])


def flown(
    site: Site, seconds: float, *, estimates: bool, seed: int = 1, noise_m: float = 0.8, latency_s: float = 0.4,
    release: str = "raw", position_filter: FilterOptions | None = None, autopilot: AutopilotOptions | None = None,
) -> tuple[ClosedLoop, LinkProtocol]:  # fmt: skip
    """Fly faster than real time against the daemon's own protocol, every message packed and parsed.

    Fixes are the truth ``latency_s`` ago with noise, at 2 Hz.
    """
    autopilot = autopilot or AutopilotOptions(filter=position_filter or FilterOptions())
    loop = ClosedLoop(site, LoopOptions(route(site), seed=seed, autopilot=autopilot), START)
    protocol = LinkProtocol(LinkOptions(endpoint="udp:127.0.0.1:1", release=release))
    ours, theirs = dialect.MAVLink(None, 1, 197), dialect.MAVLink(None, 1, 1)
    from_autopilot, from_us = FrameParser(), FrameParser()
    rng = np.random.default_rng(seed)
    for tick in range(round(seconds * 50)):
        now = START + tick * S // 50
        out = loop.advance(now)
        replies = []
        for sent in out:
            for message in from_autopilot.feed(sent.pack(theirs), now):
                protocol.on_message(message, now)
                replies += filter(None, [protocol.answer(message, now)])
        replies += protocol.poll(now)
        taken = now - round(latency_s * S)
        truth = loop.truth_at(taken)
        if estimates and tick % 25 == 0 and truth is not None:
            position = site.autopilot_from_ned(truth.position_ned_m) + rng.normal(0.0, noise_m, 3)
            at = site.geopoint_from_autopilot(position)
            fix = VisionEstimate(
                taken, position, truth.ned_from_body, np.diag([noise_m**2] * 3 + [1e-4] * 3),
                place=Place(at.lat_deg, at.lon_deg, at.height_amsl_m), origin=protocol.telemetry.origin,
            )  # fmt: skip
            protocol.release.take(fix, now, protocol.state_at)
        outgoing = protocol.release.due(now, protocol.state_at)
        if outgoing is not None:
            replies += protocol.encode_estimate(outgoing.estimate, now)
            protocol.sent(outgoing, now, local=True)
        for reply in replies:
            for answer in loop.receive(from_us.feed(reply.pack(ours), now), now):
                for message in from_autopilot.feed(answer.pack(theirs), now):
                    protocol.on_message(message, now)
    return loop, protocol


def errors_after(loop: ClosedLoop) -> FloatArray:
    after = [s for s in loop.samples if s.stamp_ns > loop.gnss_lost_ns]
    return np.array([np.hypot(*(s.estimate_m - s.true_m)[:2]) for s in after])


def off_route(loop: ClosedLoop, site: Site) -> FloatArray:
    """Horizontal distance in m from the route's polyline after GNSS was lost."""
    corners = site.ned_from_map(route(site))[:, :2]
    dense = np.vstack([a + np.linspace(0, 1, 200)[:, None] * (b - a) for a, b in pairwise(corners)])
    points = np.array([s.truth.position_ned_m[:2] for s in loop.samples if s.stamp_ns > loop.gnss_lost_ns])[::20]
    return np.asarray(np.linalg.norm(points[:, None] - dense[None], axis=2).min(axis=1))


def test_estimates_keep_it_on_its_route(site: Site) -> None:
    loop, _ = flown(site, 65.0, estimates=True)
    assert errors_after(loop).max() < 3.0
    # Corners are cut; that is flying, not drifting.
    assert np.percentile(off_route(loop, site), 85) < 5.0
    assert {record.verdict.value for record in loop.autopilot.vision} == {"standby", "fused"}
    flown_m = np.linalg.norm(loop.samples[-1].truth.position_ned_m - loop.samples[0].truth.position_ned_m)
    assert flown_m > 250


def test_as_ardupilot_stamps_only_fast_forward_holds_it(site: Site) -> None:
    """By the least delay seen lately, less VISO_DELAY_MS of at most 250: half a second of latency is beyond it."""

    def error_m(release: str, viso_delay_ms: float) -> tuple[float, LinkProtocol]:
        stamps = FilterOptions(stamps="jitter", viso_delay_ms=viso_delay_ms)
        loop, protocol = flown(site, 50.0, estimates=True, latency_s=0.5, release=release, position_filter=stamps)
        return float(np.median(errors_after(loop))), protocol

    carried_m, protocol = error_m("fast-forward", 0.0)
    raw_m, _ = error_m("raw", 250.0)
    assert carried_m < 0.9
    assert raw_m > 2.0 * carried_m
    assert protocol.release.displacement_trusted
    assert protocol.monitor.report.state is Fusion.FUSED
    advice = protocol.delay_advice()
    assert advice is not None and advice.viso_delay_ms == 0


@pytest.mark.parametrize(("firmware", "carrier"), [((1, 16, 0), "ODOMETRY"), ((1, 18, 0), "GLOBAL_POSITION_SENSOR")])
def test_px4_is_held_by_either_message_once_it_gave_gnss_up(site: Site, firmware: tuple, carrier: str) -> None:
    """Lost at 10 s, given up 7 s later; ODOMETRY is relative until then."""
    there = replace(site, earth="px4")
    options = AutopilotOptions(stack="px4", firmware=firmware, filter=FilterOptions(converged_after=0))
    loop, protocol = flown(there, 32.0, estimates=True, release="fast-forward", autopilot=options)
    late = [r for r in loop.autopilot.vision if r.arrival_ns > loop.boot_ns(START + 18 * S)]
    assert {r.message for r in late} == {carrier} and {str(r.verdict) for r in late} == {"fused"}
    assert errors_after(loop)[-1000:].max() < 2.0
    assert protocol.monitor.report.state is Fusion.FUSED


def test_px4_takes_no_stream_of_two_a_second(site: Site) -> None:
    """It wants two less than 200 ms apart to start: fixes sent once each never count."""
    options = AutopilotOptions(stack="px4", firmware=(1, 16, 0), filter=FilterOptions(converged_after=0))
    loop, _ = flown(replace(site, earth="px4"), 14.0, estimates=True, latency_s=0.1, autopilot=options)
    assert {str(record.verdict) for record in loop.autopilot.vision} == {"waiting"}


def test_the_monitor_tells_standby_from_fused(site: Site) -> None:
    """While GNSS is in use nothing shows whose the position is; after it, the position is at the fixes."""
    _, protocol = flown(site, 9.5, estimates=True, release="fast-forward")
    assert protocol.monitor.report.state is Fusion.UNKNOWN
    _, protocol = flown(site, 25.0, estimates=True, release="fast-forward")
    assert protocol.monitor.report.state is Fusion.FUSED


def test_a_gimbal_on_a_moving_vehicle_is_known_at_the_exposure(site: Site) -> None:
    """It nods, the vehicle banks, turns and shakes; only the errors that its reports have are left."""
    gimbal = GimbalOptions(error_deg=(0.3, -0.4), delay_ms=30.0)
    exact = SensorOptions(tilt_deg=0.0, yaw_bias_deg=0.0, yaw_deg=0.0)
    options = LoopOptions(route(site), autopilot=AutopilotOptions(sensors=exact, gimbal=gimbal))
    loop = ClosedLoop(site, options, START)
    protocol = LinkProtocol(LinkOptions(endpoint="udp:127.0.0.1:1"), GimbalSelection(delay_ns=30_000_000))
    ours, theirs = dialect.MAVLink(None, 1, 197), dialect.MAVLink(None, 1, 1)
    from_autopilot, from_us = FrameParser(), FrameParser()
    off_deg, bank_deg = [], []
    for tick in range(30 * 50):
        now = START + tick * S // 50
        replies = []
        for sent in loop.advance(now):
            for message in from_autopilot.feed(sent.pack(theirs), now):
                protocol.on_message(message, now)
                replies += filter(None, [protocol.answer(message, now)])
        for reply in replies + protocol.poll(now):
            for answer in loop.receive(from_us.feed(reply.pack(ours), now), now):
                for message in from_autopilot.feed(answer.pack(theirs), now):
                    protocol.on_message(message, now)
        taken = now - round(0.13 * S)
        truth = loop.truth_at(taken)
        if tick % 7 == 0 and tick > 150 and truth is not None:
            state = protocol.state_at(taken)
            assert state is not None
            assert state.interpolated
            assert state.ned_from_gimbal is not None
            true = gimbal.ned_from_gimbal(truth.ned_from_body, loop.boot_ns(taken))
            off_deg.append(np.rad2deg(rotation.angle_between(state.ned_from_gimbal, true)))
            bank_deg.append(np.rad2deg(np.arccos(truth.ned_from_body[2, 2])))
    assert max(bank_deg) > 8.0
    assert off_deg == pytest.approx([np.hypot(0.3, 0.4)] * len(off_deg), abs=0.1)


def test_same_seed_same_flight(site: Site) -> None:
    first, second = (flown(site, 8.0, estimates=True)[0] for _ in range(2))
    assert np.array_equal(first.samples[-1].truth.position_ned_m, second.samples[-1].truth.position_ned_m)
    assert np.array_equal(first.samples[-1].estimate_m, second.samples[-1].estimate_m)


def test_vehicle_tilts_into_its_acceleration() -> None:
    calm = VehicleOptions(wind_ned_m_s=(0.0, 0.0, 0.0), gust_m_s=0.0)
    vehicle = Vehicle(calm, np.array([0.0, 0.0, -80.0]), np.zeros(3), 0.0)
    for _ in range(60):
        vehicle.step(0.01, np.array([9.0, 0.0, 0.0]) - vehicle.velocity_ned_m_s, 0.0)
    _, pitch, _ = rotation.to_euler(vehicle.truth.ned_from_body)
    assert np.rad2deg(pitch) == pytest.approx(-14.0, abs=3.0)  # nose down, atan(2.5 / 9.8)
    for _ in range(2000):
        vehicle.step(0.01, np.array([9.0, 0.0, 0.0]) - vehicle.velocity_ned_m_s, 0.0)
    assert vehicle.velocity_ned_m_s == pytest.approx([9.0, 0.0, 0.0], abs=0.1)
    _, pitch, _ = rotation.to_euler(vehicle.truth.ned_from_body)
    assert np.rad2deg(pitch) == pytest.approx(-5.2, abs=0.5)  # against the drag: atan(0.9 / 9.8)
    assert vehicle.position_ned_m[2] == pytest.approx(-80.0, abs=0.5)


def test_attitude_has_its_nose_where_yaw_says() -> None:
    attitude = attitude_of(np.array([0.0, 0.0, 1.0]), 0.7)
    assert rotation.to_euler(attitude) == pytest.approx((0.0, 0.0, 0.7))
    assert np.linalg.det(attitude) == pytest.approx(1.0)


# -- report ------------------------------------------------------------------


def true_fix(loop: ClosedLoop, site: Site, options: FlightOptions, stamp_ns: int, east_m: float = 0.0) -> Fix:
    """A fix at the truth, ``east_m`` true metres off."""
    truth = loop.truth_at(stamp_ns)
    assert truth is not None
    pose = site.camera_pose(truth.position_ned_m, truth.ned_from_body, options.mount.body_from_camera())
    moved = type(pose)(pose.rotation, pose.translation + np.array([east_m * site.grid_scale, 0.0, 0.0]))
    return Fix(
        stamp_ns=stamp_ns,
        map_from_camera=moved,
        camera=options.camera,
        covariance=np.eye(6),
        quality=0.9,
        matches=100,
        inliers=80,
        rms_px=1.0,
        adhop_accepted=None,
        query_px=np.zeros((0, 2)),
        points_map=np.zeros((0, 3)),
    )


def test_report_reads_errors_as_they_are(site: Site, tmp_path: Path) -> None:
    options = FlightOptions()
    loop, _ = flown(site, 35.0, estimates=True)
    stamps = range(START + 3 * S, START + 34 * S, S // 2)
    outcomes: list[tuple[int, Outcome]] = [
        (stamp + S // 4, true_fix(loop, site, options, stamp, 1.0)) for stamp in stamps
    ]
    outcomes.append((START + 34 * S, Rejected(START + 33 * S, Reason.FEW_MATCHES)))
    report = make_report(loop, site, options, outcomes, frames=50)
    assert report.passed, report.problems
    assert report.horizontal_m.median == pytest.approx(1.0, abs=1e-6)
    assert report.attitude_deg.max == pytest.approx(0.0, abs=1e-6)
    assert report.latency_ms.median == pytest.approx(250.0)
    assert report.rejections == {"few_matches": 1}
    assert report.frames_after == 49
    assert report.summary()["passed"] is True
    assert report.summary()["autopilot_stamps"] == "timesync"
    draw_track(report, Pack.open(demo_pack_path()), tmp_path / "track.png")
    picture = cv2.imread(str(tmp_path / "track.png"))
    assert picture is not None
    assert picture.shape[1] >= 600
    wrong = [*outcomes, (START + 20 * S, true_fix(loop, site, options, START + 20 * S, 12.0))]
    assert any("12.0 m off" in problem for problem in make_report(loop, site, options, wrong, 50).problems)
    assert not make_report(loop, site, options, [], 50).passed


def test_a_flight_that_the_fixes_did_not_hold_fails(site: Site) -> None:
    """All fixes true, and the autopilot none the better."""
    options = FlightOptions()
    stamps = range(START + 3 * S, START + 34 * S, S // 2)

    def problems(loop: ClosedLoop) -> str:
        outcomes: list[tuple[int, Outcome]] = [(t + S // 4, true_fix(loop, site, options, t)) for t in stamps]
        return " | ".join(make_report(loop, site, options, outcomes, 60).problems)

    mute = problems(flown(site, 35.0, estimates=False)[0])
    assert "took in 0 of" in mute
    assert "none arrived" in mute
    assert "dead reckoning alone" in mute
    held, _ = flown(site, 35.0, estimates=True)
    assert problems(held) == ""
    refused = [replace(r, verdict=Verdict.GATED) if i % 2 else r for i, r in enumerate(held.autopilot.vision)]
    held.autopilot.vision[:] = refused
    assert "gated" in problems(held)


def test_a_real_flight_shows_the_camera_what_the_vehicle_sees(tmp_path: Path) -> None:
    """Some seconds of everything: process, threads, sockets; what is under test only looks, till it has seen enough."""
    frames: list[Frame] = []

    def look(bench: Bench):  # type: ignore[no-untyped-def]
        def run() -> None:
            while not bench.stop.is_set():
                try:
                    frame = bench.frames.read(0.2)
                except EndOfFrames:
                    return
                if frame is not None:
                    frames.append(frame)
                    bench.on_outcome(Rejected(frame.stamp_ns, Reason.FEW_MATCHES))
                if len(frames) == 6:
                    bench.stop.set()

        return run

    # The demo's own extent at a coarse texel: the world is made in a second.
    options = FlightOptions(spec=WorldSpec(gsd_m=0.5), duration_s=60.0, gnss_until_s=1.0)
    report = run_flight(options, look)
    assert len(frames) >= 3
    assert frames[0].image.shape == (480, 640, 3)
    assert frames[0].image.std() > 15
    stamps = np.diff([frame.stamp_ns for frame in frames])
    assert (stamps % (S // 2) == 0).all()
    assert report.rejections == {"few_matches": len(frames)}
    assert not report.passed
    assert "gave a fix" in report.problems[0]
    assert threading.active_count() < 20
