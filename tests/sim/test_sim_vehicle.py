"""Vehicles fly as bodies do, and sensors err as they say."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from autopilot_rig import QUIET
from ortholoc_sim.autopilot.sensors import Barometer, Compass, Gnss, Imu, SensorOptions, SensorSuite
from ortholoc_sim.fixed_wing import FixedWing, FixedWingOptions
from ortholoc_sim.loop import ClosedLoop, LoopOptions
from ortholoc_sim.site import Site
from ortholoc_sim.vehicle import GRAVITY_M_S2, Craft, Guidance, Truth, Vehicle, VehicleOptions, Wind, wrapped

from ortholoc_edge.geometry import rotation
from ortholoc_edge.geometry.arrays import FloatArray

S = 1_000_000_000
DT = 0.01
STILL = FixedWingOptions(wind_ned_m_s=(0.0, 0.0, 0.0), gust_m_s=0.0)
ROUTE = np.array([[0.0, 0.0, -100.0], [700.0, 0.0, -100.0], [700.0, 500.0, -130.0]])


def wing(options: FixedWingOptions, seed: int = 1) -> FixedWing:
    return FixedWing(options, ROUTE[0], 0.0, seed)


def flown(craft: Craft, guidance: Guidance, seconds: float) -> list[Truth]:
    """By the truth itself."""
    truths = []
    for _ in range(round(seconds / DT)):
        truth = craft.truth
        velocity, heading = guidance.wanted(truth.position_ned_m)
        yaw = rotation.to_euler(truth.ned_from_body)[2]
        craft.step(DT, velocity - truth.velocity_ned_m_s, wrapped(heading - yaw))
        truths.append(craft.truth)
    return truths


def fly_to(craft: FixedWing, velocity: FloatArray, seconds: float) -> None:
    for _ in range(round(seconds / DT)):
        craft.step(DT, velocity - craft.truth.velocity_ned_m_s, 0.0)


def wing_guidance(speed_m_s: float = 18.0) -> Guidance:
    return Guidance(ROUTE, speed_m_s, 3.0, 36.0, loiter_radius_m=70.0)


# -- fixed wing ----------------------------------------------------------------


@pytest.mark.parametrize(("wind_north", "wind_east"), [(0.0, 4.0), (-5.0, -3.0), (4.0, 4.0)])
def test_wind_triangle(wind_north: float, wind_east: float) -> None:
    """On a track to the east at 18 m/s over ground: nose into the wind by its part across over the airspeed."""
    craft = wing(replace(STILL, wind_ned_m_s=(wind_north, wind_east, 0.0)))
    fly_to(craft, np.array([0.0, 18.0, 0.0]), 25.0)
    truth = craft.truth
    assert truth.velocity_ned_m_s == pytest.approx([0.0, 18.0, 0.0], abs=0.05)
    assert craft.airspeed_m_s == pytest.approx(math.hypot(wind_north, 18.0 - wind_east), abs=0.02)
    nose = rotation.to_euler(truth.ned_from_body)[2]
    assert nose == pytest.approx(math.radians(90.0) - math.asin(-wind_north / craft.airspeed_m_s), abs=0.003)


def test_it_never_flies_too_slowly_and_cannot_hover() -> None:
    """Against a wind as fast as itself it stands still over ground, nose into it."""
    craft = wing(replace(STILL, wind_ned_m_s=(-13.0, 0.0, 0.0)))
    fly_to(craft, np.array([0.5, 0.0, 0.0]), 20.0)
    assert craft.airspeed_m_s == pytest.approx(13.5, abs=0.05)
    fly_to(craft, np.array([0.0, 0.0, 0.0]), 20.0)
    assert craft.airspeed_m_s == pytest.approx(13.0, abs=0.05)


def test_a_turn_is_coordinated_and_as_wide_as_its_bank_says() -> None:
    craft = wing(STILL)
    felt, radii, banks = [], [], []
    before = craft.truth
    for n in range(1500):
        # Always wanted: 90 degrees to the right of where it flies.
        v = craft.truth.velocity_ned_m_s
        craft.step(DT, np.array([-v[1], v[0], 0.0]) - v, 0.0)
        truth = craft.truth
        if n > 500:
            acceleration = (truth.velocity_ned_m_s - before.velocity_ned_m_s) / DT
            force = acceleration - np.array([0.0, 0.0, GRAVITY_M_S2])
            # In the axes of the wings, without the incidence of the nose.
            level = rotation.from_euler(craft.bank_rad, 0.0, craft.heading_rad)
            felt.append(level.T @ force)
            turn = math.hypot(*acceleration[:2])
            radii.append(craft.airspeed_m_s**2 / turn)
            banks.append(craft.bank_rad)
        before = truth
    # Forty degrees: lift carries 1.305 of the weight, nothing pulls sideways.
    assert np.rad2deg(banks) == pytest.approx(np.full(len(banks), 40.0), abs=0.1)
    weight = GRAVITY_M_S2 / math.cos(math.radians(40.0))
    assert np.array(felt)[:, 1] == pytest.approx(np.zeros(len(felt)), abs=0.1)
    assert np.array(felt)[:, 2] == pytest.approx(np.full(len(felt), -weight), abs=0.1)
    assert radii == pytest.approx([STILL.least_turn_radius_m] * len(radii), rel=0.01)


def test_position_is_the_integral_of_velocity_and_rates_that_of_attitude() -> None:
    craft = wing(FixedWingOptions(gust_m_s=1.5), seed=4)
    truths = flown(craft, wing_guidance(), 60.0)
    velocity = np.array([t.velocity_ned_m_s for t in truths])
    position = np.array([t.position_ned_m for t in truths])
    assert np.diff(position, axis=0) == pytest.approx(0.5 * (velocity[1:] + velocity[:-1]) * DT, abs=1e-9)
    for a, b in zip(truths[100::500], truths[101::500], strict=True):
        assert a.ned_from_body @ rotation.exp(b.rates_body_rad_s * DT) == pytest.approx(b.ned_from_body, abs=1e-9)
    # A body's: no acceleration beyond lift's and what gusts do to it, no tumbling.
    assert np.linalg.norm(np.diff(velocity, axis=0), axis=1).max() / DT < 1.5 * GRAVITY_M_S2
    assert max(np.linalg.norm(t.rates_body_rad_s) for t in truths) < 3.0


@pytest.mark.parametrize("seed", [1, 2])
def test_it_follows_the_route_and_loiters_at_its_end(seed: int) -> None:
    craft = wing(FixedWingOptions(wind_ned_m_s=(3.0, -4.0, 0.0)), seed)
    guidance = wing_guidance()
    truths = flown(craft, guidance, 120.0)
    end = ROUTE[-1]
    away = np.array([np.hypot(*(t.position_ned_m - end)[:2]) for t in truths])
    arrived = int(np.argmax(away < 80.0))
    assert 50.0 < arrived * DT < 100.0
    assert away[-2000:] == pytest.approx(np.full(2000, 70.0), abs=16.0)
    turned = np.unwrap([math.atan2(*(t.position_ned_m - end)[1::-1]) for t in truths[-2000:]])
    assert turned[-1] - turned[0] > 3.0  # to the right, on and on
    height = np.array([-t.position_ned_m[2] for t in truths])
    assert height[0] == pytest.approx(100.0, abs=1.0) and height[-1] == pytest.approx(130.0, abs=1.0)
    first = np.array([abs(t.position_ned_m[1]) for t in truths if t.position_ned_m[0] < 600.0])
    assert first.max() < 6.0


def test_it_flies_by_its_own_estimate_like_a_multirotor(site: Site) -> None:
    """In the same loop, as a plane to others; its speed stays what a wing can fly."""
    corners = np.array([[-300.0, -250.0], [300.0, -250.0], [300.0, 200.0]])
    route = np.column_stack([corners + site.anchor_map_m[:2], np.full(3, site.anchor_map_m[2] + 100.0)])
    loop = ClosedLoop(site, LoopOptions(route, 18.0, gnss_until_s=1e6, vehicle=FixedWingOptions()), S)
    sent = loop.advance(31 * S)
    heartbeat = next(m for m in sent if m.get_type() == "HEARTBEAT")
    assert (heartbeat.type, heartbeat.custom_mode) == (1, 10)
    flown_m = np.array([s.true_m for s in loop.samples])
    assert np.hypot(*np.diff(flown_m[:, :2], axis=0).T).sum() == pytest.approx(540.0, abs=60.0)
    errors = np.array([np.hypot(*(s.estimate_m - s.true_m)[:2]) for s in loop.samples])
    assert np.median(errors) < 2.5


# -- both ----------------------------------------------------------------------


def craft_of(kind: str, seed: int) -> Craft:
    if kind == "wing":
        return wing(FixedWingOptions(gust_m_s=2.0), seed)
    return Vehicle(VehicleOptions(gust_m_s=2.0), ROUTE[0], np.zeros(3), 0.0, seed)


@pytest.mark.parametrize("kind", ["wing", "multirotor"])
def test_a_seed_is_a_flight(kind: str) -> None:
    def last(seed: int) -> FloatArray:
        return flown(craft_of(kind, seed), Guidance(ROUTE, 15.0), 10.0)[-1].position_ned_m

    assert np.array_equal(last(5), last(5))
    assert not np.array_equal(last(5), last(6))


def test_gusts_are_as_strong_and_as_long_as_told() -> None:
    wind = Wind((3.0, 0.0, 0.0), 2.0, 4.0, 7)
    gusts = np.array([wind.gust(0.1) for _ in range(20_000)])
    assert gusts.std(axis=0) == pytest.approx([2.0, 2.0, 0.8], rel=0.15)
    lagged = [np.corrcoef(gusts[:-40, axis], gusts[40:, axis])[0, 1] for axis in range(2)]
    assert lagged == pytest.approx([math.exp(-1.0)] * 2, abs=0.12)


def test_guidance_goes_round_a_closed_route_whose_legs_are_short() -> None:
    angles = np.linspace(0.0, 2.0 * math.pi, 24, endpoint=False)
    ring = np.column_stack([150.0 * np.cos(angles), 150.0 * np.sin(angles), np.full(24, -100.0)])
    guidance = Guidance(ring, 18.0, 3.0, 36.0, closed=True)  # each leg is 39 m long
    truths = flown(FixedWing(STILL, ring[0], math.pi / 2.0, 1), guidance, 60.0)
    bearings = np.unwrap([math.atan2(t.position_ned_m[1], t.position_ned_m[0]) for t in truths])
    assert bearings[-1] == pytest.approx(18.0 * 60.0 / 150.0, abs=0.8)
    assert [np.hypot(*t.position_ned_m[:2]) for t in truths] == pytest.approx([150.0] * len(truths), abs=14.0)


def test_a_flight_without_end_forgets(site: Site) -> None:
    corners = np.array([[-100.0, 0.0], [100.0, 0.0], [0.0, 100.0]])
    route = np.column_stack([corners + site.anchor_map_m[:2], np.full(3, site.anchor_map_m[2] + 100.0)])
    loop = ClosedLoop(site, LoopOptions(route, closed=True, keep_s=0.5), S)
    for n in range(1, 40):
        loop.advance(S + n * S // 10)
        assert len(loop.samples) <= 100
    assert loop.truth_at(loop.now_ns - S // 4) is not None and loop.truth_at(S + S) is None


# -- sensors -------------------------------------------------------------------


def test_imu_has_a_bias_of_its_size_and_white_noise() -> None:
    options = SensorOptions(accelerometer_bias=0.05, acceleration_noise=0.02, gyro_bias_deg_s=0.5, gyro_noise_deg_s=0.3)
    level, still = np.eye(3), np.zeros(3)
    forces = []
    imu = Imu(options, np.random.default_rng(3))
    for _ in range(4000):
        forces.append(imu.specific_force(still, level, DT))
    mean = np.mean(forces, axis=0)
    assert np.hypot(*mean[:2]) == pytest.approx(0.05, abs=0.012)
    assert mean[2] == pytest.approx(-GRAVITY_M_S2, abs=0.02)
    assert np.std(forces, axis=0) == pytest.approx([0.02 / math.sqrt(DT)] * 3, rel=0.05)
    rates = np.array([imu.rates(still) for _ in range(2000)])
    assert rates.std(axis=0) == pytest.approx([math.radians(0.3)] * 3, rel=0.06)
    biases = [Imu(options, np.random.default_rng(n)).rates(still) for n in range(300)]
    assert np.std(biases) == pytest.approx(math.radians(math.hypot(0.5, 0.3)), rel=0.1)


def test_dead_reckoning_feels_what_the_vehicle_does() -> None:
    """Without errors the integral of the accelerometers is the velocity, through turns and tilt."""
    craft = wing(FixedWingOptions(), seed=2)
    suite = SensorSuite(QUIET, 1, craft.truth)
    guidance = wing_guidance()
    for n in range(4000):
        truth = craft.truth
        velocity, _ = guidance.wanted(truth.position_ned_m)
        craft.step(DT, velocity - truth.velocity_ned_m_s, 0.0)
        readings = suite.step(n * S // 100, craft.truth, craft.truth.position_ned_m, DT)
    assert readings.velocity_ned_m_s == pytest.approx(craft.truth.velocity_ned_m_s, abs=1e-6)


def test_a_heading_error_turns_each_change_of_velocity() -> None:
    craft = wing(STILL)
    suite = SensorSuite(replace(QUIET, yaw_bias_deg=5.0), 1, craft.truth)
    for n in range(2000):
        craft.step(DT, np.array([0.0, 18.0, 0.0]) - craft.truth.velocity_ned_m_s, 0.0)
        readings = suite.step(n * S // 100, craft.truth, craft.truth.position_ned_m, DT)
    error = (readings.velocity_ned_m_s - craft.truth.velocity_ned_m_s)[:2]
    # From north to east at 18 m/s: a change of 25.5 m/s, turned by 5 degrees.
    assert np.hypot(*error) == pytest.approx(18.0 * math.sqrt(2.0) * 2.0 * math.sin(math.radians(2.5)), rel=0.01)


def test_barometer_drifts_as_the_root_of_time_and_compass_keeps_its_bias() -> None:
    options = SensorOptions(baro_walk_m=0.1, baro_noise_m=0.3, yaw_bias_deg=3.0, yaw_deg=0.5)
    drifts = []
    for seed in range(60):
        barometer = Barometer(options, np.random.default_rng(seed))
        for _ in range(400):
            barometer.error(0.25)
        drifts.append(barometer.drift_m)
    assert np.std(drifts) == pytest.approx(0.1 * math.sqrt(100.0), rel=0.3)
    means = []
    for seed in range(20):
        compass = Compass(options, np.random.default_rng(seed))
        means.append(math.degrees(np.mean([compass.error_rad(1.0) for _ in range(600)])))
    assert np.abs(means) == pytest.approx(np.full(20, 3.0), abs=0.6)
    assert {math.copysign(1.0, mean) for mean in means} == {1.0, -1.0}


def test_gnss_errs_slowly_is_silent_without_a_fix_and_believes_a_spoofer() -> None:
    options = SensorOptions(gnss_m=2.0, gnss_time_s=10.0)
    receiver = Gnss(options, np.random.default_rng(2))
    still = np.zeros(3)
    samples = [s for n in range(60_000) if (s := receiver.step(n * S // 5, still, still, 0.2)) is not None]
    errors = np.array([sample.position_ned_m for sample in samples])
    assert errors.std(axis=0) == pytest.approx([2.0] * 3, rel=0.12)
    assert np.corrcoef(errors[:-50, 0], errors[50:, 0])[0, 1] == pytest.approx(math.exp(-1.0), abs=0.08)
    receiver.works = False
    assert receiver.step(60_000 * S // 5, still, still, 0.2) is None
    receiver.works = True
    away = []
    for n in range(60_001, 60_101):
        receiver.offset_ned_m = np.array([0.0, 0.3 * (n - 60_001), 0.0])
        sample = receiver.step(n * S // 5, still, still, 0.2)
        assert sample is not None and sample.sigma_m == 2.0  # it claims to be as good as ever
        away.append((sample.position_ned_m[1], sample.velocity_ned_m_s[1]))
    assert away[-1][0] - away[0][0] == pytest.approx(0.3 * 99, abs=6.0)
    assert np.mean([v for _, v in away[2:]]) == pytest.approx(1.5, abs=0.1)  # its velocity goes along
    receiver.noise = 10.0
    assert receiver.sigma_m == 20.0
