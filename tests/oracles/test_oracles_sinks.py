"""Every row of docs/autopilot-sinks.md: the sigma that we mean is the one used, at the place and time that we mean."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pyproj import Geod
from strategies import finite

from ortholoc_edge.adapters.mavlink.estimates import (
    Autopilot,
    VisionEstimate,
    horizontal_sigma_m,
    yaw_sigma_rad,
)
from ortholoc_edge.adapters.mavlink.geodesy import GeodeticOrigin, Place
from ortholoc_edge.adapters.mavlink.sinks import (
    CovarianceLayout,
    Refusal,
    Sink,
    choose_sinks,
    encode_odometry,
    is_known_to_read,
    limits,
)

from . import table
from .ardupilot import ArduPilot, JitterCorrection
from .px4 import Px4
from .rows import BOOT_US, MS, ORIGIN, ROWS, Row, S, estimate, flight, heard, sent, wire
from .used import Dropped, Used

GEOD = Geod(ellps="WGS84")
DOCUMENT = Path(__file__).resolve().parents[2] / "docs" / "autopilot-sinks.md"

READ = [row for row in ROWS if isinstance(heard(row, row.oracle(row.firmwares[0]), estimate(row.autopilot)), Used)]
FIRST = [Autopilot.ARDUPILOT, Autopilot.PX4]


def test_the_document_is_up_to_date(rewrite_docs):
    """``pytest tests/oracles --rewrite-docs`` rewrites it."""
    text = table.document()
    if rewrite_docs:
        DOCUMENT.write_text(text, encoding="utf-8")
    assert DOCUMENT.read_text(encoding="utf-8") == text


@st.composite
def spreads(draw):
    """Arguments of `estimate`: any place up to 20 km from its origin, any ellipse, any heading."""
    latitude, longitude = draw(finite(-75.0, 75.0)), draw(finite(-179.0, 179.0))
    east, north, _ = GEOD.fwd(longitude, latitude, draw(finite(0.0, 360.0)), draw(finite(0.0, 20_000.0)))
    return {
        "origin": GeodeticOrigin(latitude, longitude, draw(finite(-100.0, 3000.0))),
        "place": Place(north, east, draw(finite(-100.0, 5000.0)), draw(st.none() | finite(-100.0, 5000.0))),
        "sigma_m": (draw(finite(0.02, 60.0)), draw(finite(0.02, 60.0))),
        "turn_rad": draw(finite(-3.1, 3.1)),
        "yaw_rad": draw(finite(-3.1, 3.1)),
        "yaw_sigma_rad": draw(finite(0.001, 1.7)),
        "stamp_ns": draw(st.integers(500 * S, 10**6 * S)),
    }


def at(row: Row, firmware, origin: GeodeticOrigin):
    """The oracle with its origin there, as GPS_GLOBAL_ORIGIN tells it."""
    oracle = row.oracle(firmware)
    latitude, longitude = round(origin.latitude_deg * 1e7), round(origin.longitude_deg * 1e7)
    return replace(
        oracle, origin=(latitude, longitude) if isinstance(oracle, ArduPilot) else (latitude / 1e7, longitude / 1e7)
    )


@pytest.mark.parametrize("row", READ, ids=str)
@settings(max_examples=30)
@given(arguments=spreads())
def test_what_is_used_is_what_is_meant(row: Row, arguments):
    """Position to 5 cm; each axis' sigma within 1 %, or raised to the firmware's floor, or the estimate not sent."""
    origin = arguments["origin"]
    # To the 1e-7 degrees in which an autopilot tells it.
    arguments["origin"] = GeodeticOrigin(
        round(origin.latitude_deg, 7), round(origin.longitude_deg, 7), origin.height_amsl_m
    )
    said = estimate(row.autopilot, **arguments)
    bounds = limits(row.sink, row.autopilot, row.version)
    sigma_m, now_ns = horizontal_sigma_m(said), said.stamp_ns + 150 * MS
    message = sent(row, said, now_ns)
    if sigma_m > bounds.most_sigma_m or yaw_sigma_rad(said) > bounds.most_yaw_sigma_rad:
        assert isinstance(message, Refusal) and message.kind in ("sigma", "yaw_sigma")
        return
    for firmware in row.firmwares:
        used = at(row, firmware, arguments["origin"]).receive(wire(message), now_ns // 1000 + 3000 - BOOT_US)
        assert isinstance(used, Used), used
        place = arguments["place"]
        _, _, off_m = GEOD.inv(place.longitude_deg, place.latitude_deg, used.longitude_deg, used.latitude_deg)
        assert off_m < 0.05
        assert not used.velocity
        per_axis = row.autopilot is Autopilot.PX4 and row.sink.local
        meant = np.sqrt(np.diag(said.covariance)[:2]) if per_axis else np.array([sigma_m, sigma_m])
        meant = np.maximum(meant, bounds.least_sigma_m)
        ratio = np.array([used.sigma_north_m, used.sigma_east_m]) / meant
        if row.version is None and row.sink.local:
            assert ratio.min() > 0.999 and ratio.max() < 2.0
        else:
            np.testing.assert_allclose(ratio, 1.0, rtol=0.01)
        if used.yaw_rad is not None:
            assert math.remainder(used.yaw_rad - arguments["yaw_rad"], 2 * math.pi) == pytest.approx(0.0, abs=1e-5)
            assert used.yaw_sigma_rad >= 0.99 * yaw_sigma_rad(said)


@pytest.mark.parametrize("row", [row for row in ROWS if row not in READ], ids=str)
@settings(max_examples=5)
@given(arguments=spreads())
def test_what_has_no_handler_is_dropped(row: Row, arguments):
    said = estimate(row.autopilot, **arguments | {"sigma_m": (1.0, 1.0), "yaw_sigma_rad": 0.3})
    for firmware in row.firmwares:
        assert heard(row, row.oracle(firmware), said, 150 * MS, 3000) == Dropped("no handler")


@pytest.mark.parametrize("row", READ, ids=str)
def test_bounds_are_those_of_the_firmware(row: Row):
    """What `limits` says, the oracle states: floors as they are told, ceilings where we stop sending."""
    bounds = limits(row.sink, row.autopilot, row.version)
    if not (row.version is None and row.sink.local):
        assert table.believed(row, bounds.least_sigma_m / 2).sigma_north_m == pytest.approx(bounds.least_sigma_m)
    for sigma_m in (bounds.least_sigma_m, min(bounds.most_sigma_m, 1e3) * 0.999):
        assert table.believed(row, sigma_m).sigma_north_m >= 0.999 * sigma_m
    if bounds.most_sigma_m < math.inf:
        over = bounds.most_sigma_m * 1.5
        assert table.believed(row, over).sigma_north_m == pytest.approx(bounds.most_sigma_m)
        said = estimate(row.autopilot, sigma_m=(over, over))
        refused = sent(row, said, said.stamp_ns)
        assert isinstance(refused, Refusal) and refused.kind == "sigma"
        assert f"{bounds.most_sigma_m:g} m" in refused.why


@pytest.mark.parametrize("row", READ, ids=str)
def test_capture_time_is_right_with_its_parameter(row: Row):
    _, parameters = table.tuned(row)
    assert table.capture_error_ms(row, parameters) <= 6.0


@pytest.mark.parametrize("row", [row for row in ROWS if row.version is not None], ids=str)
def test_what_is_known_to_be_read_is_read(row: Row):
    known = is_known_to_read(row.sink, row.autopilot, row.version)
    assert known is (row in READ)


@pytest.mark.parametrize("row", ROWS, ids=str)
def test_auto_takes_one_that_is_read(row: Row):
    (sink,) = choose_sinks(("auto",), row.vehicle).sinks
    assert replace(row, sink=sink) in READ


def test_the_estimate_of_which_an_axis_is_longer_counts_by_it_at_ardupilot():
    row = Row(Autopilot.ARDUPILOT, (4, 8, 0), Sink.ODOMETRY)
    used = heard(row, row.oracle((4, 8, 0)), estimate(Autopilot.ARDUPILOT, sigma_m=(1.0, 3.0), turn_rad=0.6))
    assert (used.sigma_north_m, used.sigma_east_m) == pytest.approx((3.0, 3.0))
    row = Row(Autopilot.PX4, (1, 17, 0), Sink.ODOMETRY)
    used = heard(row, row.oracle((1, 17, 0)), estimate(Autopilot.PX4, sigma_m=(1.0, 3.0)))
    assert (used.sigma_north_m, used.sigma_east_m) == pytest.approx((1.0, 3.0))


@pytest.mark.parametrize("version", [(4, 5, 7), (4, 8, 0)])
def test_what_goes_wrong_without_care_at_ardupilot(version):
    """The oracle catches the mistakes that the contract names; else it could not vouch for their absence."""
    row = Row(Autopilot.ARDUPILOT, version, Sink.ODOMETRY)
    said = estimate(Autopilot.ARDUPILOT)
    right = CovarianceLayout.SQUARE_ROOT if version >= (4, 8, 0) else CovarianceLayout.CUBE_ROOT
    other = CovarianceLayout.CUBE_ROOT if version >= (4, 8, 0) else CovarianceLayout.SQUARE_ROOT
    said = estimate(Autopilot.ARDUPILOT, sigma_m=(5.0, 5.0))
    sigmas = {}
    for layout in (right, other):
        used = row.oracle(version).receive(wire(encode_odometry(said, layout)), 10**9)
        sigmas[layout] = used.sigma_north_m
    assert sigmas[right] == pytest.approx(5.0, rel=0.01)
    assert abs(sigmas[other] / 5.0 - 1.0) > 0.15
    ned = encode_odometry(said, CovarianceLayout.PER_AXIS)
    assert isinstance(row.oracle(version).receive(wire(ned), 10**9), Dropped)
    holes = encode_odometry(said, right)
    holes.pose_covariance[11] = math.nan
    oracle = row.oracle(version)
    oracle.receive(wire(holes), 10**9)
    assert oracle.internal_errors == 1
    still = encode_odometry(said, right)
    still.vx = still.vy = still.vz = 0.0
    assert row.oracle(version).receive(wire(still), 10**9).velocity


def test_what_goes_wrong_without_care_at_px4():
    row = Row(Autopilot.PX4, (1, 17, 0), Sink.ODOMETRY)
    frd = encode_odometry(estimate(Autopilot.PX4), CovarianceLayout.SQUARE_ROOT)
    assert isinstance(row.oracle((1, 17, 0)).receive(wire(frd), 10**9), Dropped)
    unsynchronised = replace(row.oracle((1, 17, 0)), offset_us=None)
    errors = [error for error, _ in flight(row, unsynchronised)]
    assert min(errors) > 150.0


def test_old_ardupilot_believes_its_gps_instead():
    said = estimate(Autopilot.ARDUPILOT, sigma_m=(5.0, 5.0))
    for version, sigma_m in (((4, 6, 3), 0.8), ((4, 7, 0), 5.0)):
        row = Row(Autopilot.ARDUPILOT, version, Sink.ODOMETRY)
        used = heard(row, row.oracle(version, gps_accuracy_m=0.8), said)
        assert used.sigma_north_m == pytest.approx(sigma_m, rel=0.01)


def odometry_times(version, other: Sink | None, capture_stamps: bool) -> list[int]:
    """What ArduPilot takes for the capture of ODOMETRY, in us off, if another message goes ahead of the 50th."""
    oracle = ArduPilot(version, (507000000, 71000000), viso_delay_ms=152, pr_31738=True)
    row = Row(Autopilot.ARDUPILOT, version, Sink.ODOMETRY)
    times = []
    for n in range(150):
        stamp_ns = 1000 * S + n * 200 * MS
        said = estimate(Autopilot.ARDUPILOT, stamp_ns=stamp_ns)
        now_ns = stamp_ns + 150 * MS
        arrival_us = now_ns // 1000 + 2000 - BOOT_US
        if other is not None and n == 50:
            message = sent(replace(row, sink=other), said, now_ns, capture_stamps)
            assert isinstance(oracle.receive(wire(message), arrival_us), Used)
        used = oracle.receive(wire(sent(row, said, now_ns)), arrival_us)
        times.append(used.capture_us - (stamp_ns // 1000 - BOOT_US))
    return times


@pytest.mark.parametrize("other", [Sink.EXTERNAL_POSITION_ESTIMATE, Sink.GLOBAL_POSITION_SENSOR])
def test_other_messages_leave_odometrys_clock_alone(other):
    alone = odometry_times((4, 8, 0), None, True)
    assert max(map(abs, alone)) <= 1000
    assert odometry_times((4, 8, 0), other, capture_stamps=True) == alone
    if other is Sink.GLOBAL_POSITION_SENSOR:
        # Stamped at transmission it takes the latency out of the link's offset; VISO_DELAY_MS then counts it twice.
        mixed = odometry_times((4, 8, 0), other, capture_stamps=False)
        assert min(mixed) < -90_000


def test_a_build_with_pull_request_31738_takes_the_sensor():
    row = Row(Autopilot.ARDUPILOT, (4, 8, 0), Sink.GLOBAL_POSITION_SENSOR)
    stream = list(flight(row, row.oracle((4, 8, 0), pr_31738=True)))
    assert max(abs(error) for error, _ in stream) <= 6.0
    for _, used in stream:
        assert (used.sigma_north_m, used.sigma_east_m) == pytest.approx((2.0, 2.0))
    # Beside ODOMETRY, with the stamp of capture, it is as good: the latency is taken off by processing_time.
    oracle = row.oracle((4, 8, 0), pr_31738=True)
    for n in range(20):
        said = estimate(Autopilot.ARDUPILOT, stamp_ns=(1000 + n) * S)
        now_ns = said.stamp_ns + 150 * MS
        for sink in (Sink.ODOMETRY, Sink.GLOBAL_POSITION_SENSOR):
            message = sent(replace(row, sink=sink), said, now_ns, True)
            used = oracle.receive(wire(message), now_ns // 1000 + 2000 - BOOT_US)
        assert abs(used.capture_us - (said.stamp_ns // 1000 - BOOT_US)) <= 6000


@pytest.mark.parametrize("uptime_s", [10, 300, 86_400, 30 * 86_400])
def test_the_commands_coarse_time_is_never_ahead(uptime_s):
    """As a float it is up to 0.25 s coarse after a month; ahead, it would pull the link's offset."""
    for autopilot in FIRST:
        version = (4, 8, 0) if autopilot is Autopilot.ARDUPILOT else (1, 18, 0)
        row = Row(autopilot, version, Sink.EXTERNAL_POSITION_ESTIMATE)
        said = estimate(autopilot, stamp_ns=uptime_s * S + 123_456_789)
        now_ns = said.stamp_ns + 300 * MS
        command = sent(row, said, now_ns)
        expected_s = now_ns / S if autopilot is Autopilot.ARDUPILOT else (now_ns / S) % 250.0
        assert 0.0 <= expected_s - command.param1 <= max(1e-4, expected_s * 2.0**-23)
        assert command.param2 == pytest.approx(0.3)
        assert math.isnan(command.z)


def test_gps_input_for_another_instance_is_dropped():
    row = Row(Autopilot.ARDUPILOT, (4, 6, 3), Sink.GPS_INPUT)
    assert heard(row, row.oracle((4, 6, 3), gps_instance=0), estimate(Autopilot.ARDUPILOT)) == Dropped(
        "gps_id 1 is not this instance"
    )


def test_jitter_correction_forgets_after_a_hundred():
    jitter = JitterCorrection()
    assert jitter.correct_us(1_000_000, 1_050_000) == 1_050_000
    assert jitter.correct_us(2_000_000, 2_010_000) == 2_010_000
    assert jitter.correct_us(3_000_000, 3_100_000) == 3_010_000
    assert jitter.correct_us(0, 4_000_000) == 3_500_000
    for n in range(200):
        last = jitter.correct_us(10_000_000 + n, 10_080_000 + n)
    assert last == 10_080_199


def test_px4_with_gnss_takes_vision_for_relative():
    row = Row(Autopilot.PX4, (1, 17, 0), Sink.ODOMETRY)
    used = heard(row, replace(row.oracle((1, 17, 0)), gnss=True), estimate(Autopilot.PX4, sigma_m=(0.2, 0.2)))
    assert "bias" in used.frame and used.sigma_north_m == 0.5


def test_a_sensor_of_another_id_is_not_ours():
    oracle = Px4((1, 18, 0), (ORIGIN.latitude_deg, ORIGIN.longitude_deg), ekf2_agp0_id=7)
    row = Row(Autopilot.PX4, (1, 18, 0), Sink.GLOBAL_POSITION_SENSOR)
    assert heard(row, oracle, estimate(Autopilot.PX4)) == Dropped("EKF2_AGP0_ID is 7")


def test_estimates_without_what_a_sink_needs_are_refused():
    row = Row(Autopilot.ARDUPILOT, (4, 8, 0), Sink.ODOMETRY)
    said = estimate(Autopilot.ARDUPILOT)

    def made(**change) -> VisionEstimate:
        return replace(said, **change)

    assert sent(row, made(position_ned_m=None), said.stamp_ns).kind == "no_origin"
    place_less = made(place=None)
    for sink in (Sink.GLOBAL_POSITION_SENSOR, Sink.GPS_INPUT, Sink.EXTERNAL_POSITION_ESTIMATE):
        assert sent(replace(row, sink=sink), place_less, said.stamp_ns).kind == "no_place"
        assert sent(replace(row, sink=sink), said, said.stamp_ns + 6 * S).kind == "age"
        assert sent(replace(row, sink=sink), said, said.stamp_ns - 1).kind == "age"
        # A local origin is nothing to them.
        assert not isinstance(sent(replace(row, sink=sink), made(position_ned_m=None), said.stamp_ns), Refusal)
