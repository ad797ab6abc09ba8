"""Fields of the messages, the choice among them, and what is said of estimates that are not sent.

What autopilots make of them is in `tests/oracles`.
"""

from __future__ import annotations

import logging
import math
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as dialect

from ortholoc_edge.adapters.mavlink import LinkOptions
from ortholoc_edge.adapters.mavlink.estimates import Autopilot, VisionEstimate
from ortholoc_edge.adapters.mavlink.geodesy import EarthModel, GeodeticOrigin, Place, ned_from_geodetic
from ortholoc_edge.adapters.mavlink.log import LimitedLog
from ortholoc_edge.adapters.mavlink.outlet import Outlet
from ortholoc_edge.adapters.mavlink.sinks import (
    CovarianceLayout,
    Refusal,
    Sending,
    Sink,
    choose_sinks,
    covariance_layout,
    earth_model,
    encode,
    encode_odometry,
    encode_vision_position_estimate,
    limits,
)
from ortholoc_edge.adapters.mavlink.state import AutopilotIdentity
from ortholoc_edge.geometry import rotation

MS, S = 1_000_000, 1_000_000_000
ORIGIN = GeodeticOrigin(50.7, 7.1, 60.0)
ARDUPILOT = AutopilotIdentity(7, Autopilot.ARDUPILOT, (4, 6, 0))
PX4 = AutopilotIdentity(7, Autopilot.PX4, (1, 18, 0))
# 2026-11-30 07:00:00 UTC.
WALL_NS = 1_796_022_000 * S

angles = st.floats(-math.pi, math.pi)
coordinates = st.floats(-1e5, 1e5)


@st.composite
def covariances(draw: st.DrawFn) -> np.ndarray:
    sigmas = [draw(st.floats(0.01, 50.0)) for _ in range(3)] + [draw(st.floats(1e-3, 1.4)) for _ in range(3)]
    turn = rotation.exp([0.0, 0.0, draw(angles)])
    position = turn @ np.diag(np.square(sigmas[:3])) @ turn.T
    covariance = np.zeros((6, 6))
    covariance[:3, :3] = position
    covariance[3:, 3:] = np.diag(np.square(sigmas[3:]))
    return (covariance + covariance.T) / 2.0


@st.composite
def estimates(draw: st.DrawFn) -> VisionEstimate:
    return VisionEstimate(
        stamp_ns=draw(st.integers(0, 2**62)),
        position_ned_m=np.array([draw(coordinates) for _ in range(3)]),
        ned_from_body=rotation.from_euler(draw(angles), draw(st.floats(-1.5, 1.5)), draw(angles)),
        covariance=draw(covariances()),
        reset_counter=draw(st.integers(0, 255)),
        quality=draw(st.floats(0.0, 1.0)),
    )


def estimate(sigma_m: float = 2.0, **change) -> VisionEstimate:
    place = Place(50.7001, 7.1002, 140.25, 187.5)
    made = VisionEstimate(
        1000 * S,
        ned_from_geodetic(ORIGIN, 50.7001, 7.1002, 140.25, EarthModel.PX4),
        np.eye(3),
        np.diag([sigma_m**2, sigma_m**2, 16.0, 0.01, 0.01, 0.04]),
        3,
        0.8,
        place,
        ORIGIN,
    )
    return replace(made, **change)


def over_the_wire(message):
    sender, receiver = dialect.MAVLink(None, 1, 197), dialect.MAVLink(None, 0, 0)
    (decoded,) = receiver.parse_buffer(message.pack(sender))
    return decoded


def test_the_contracts_figure_for_old_ardupilot():
    # Section 2.11: for E metres send sqrt(E^3 / 3) in each of three entries; in two of them that is sqrt(E^3 / 2).
    field = encode_odometry(estimate(), CovarianceLayout.CUBE_ROOT).pose_covariance
    assert field[0] == pytest.approx(2.0) and field[6] == pytest.approx(2.0) and field[11] == 0.0


@pytest.mark.parametrize("layout", list(CovarianceLayout))
@given(said=estimates())
def test_no_entry_is_nan(said, layout):
    """ArduPilot tests the first only; a NaN elsewhere ends in its internal error."""
    assert all(math.isfinite(v) for v in encode_odometry(said, layout).pose_covariance)
    assert all(math.isfinite(v) for v in encode_vision_position_estimate(said, layout).covariance)


@given(said=estimates())
def test_px4_gets_every_covariance(said):
    odometry = over_the_wire(encode_odometry(said, CovarianceLayout.PER_AXIS))
    c = np.zeros((6, 6))
    c[np.triu_indices(6)] = odometry.pose_covariance
    np.testing.assert_allclose(c, np.triu(said.covariance), rtol=1e-5, atol=1e-6)


@given(said=estimates())
def test_pose_survives_the_wire(said):
    vpe = over_the_wire(encode_vision_position_estimate(said, CovarianceLayout.PER_AXIS))
    odometry = over_the_wire(encode_odometry(said, CovarianceLayout.CUBE_ROOT))
    assert vpe.usec == odometry.time_usec == said.stamp_ns // 1000
    assert vpe.reset_counter == odometry.reset_counter == said.reset_counter
    for message in (vpe, odometry):
        np.testing.assert_allclose([message.x, message.y, message.z], said.position_ned_m, rtol=1e-6, atol=1e-6)
    from_vpe = rotation.from_euler(vpe.roll, vpe.pitch, vpe.yaw)
    assert rotation.angle_between(from_vpe, said.ned_from_body) < 1e-5
    assert rotation.angle_between(rotation.from_quaternion(odometry.q), said.ned_from_body) < 1e-5
    assert math.isnan(odometry.vx) and math.isnan(odometry.vy) and math.isnan(odometry.vz)
    assert math.isnan(odometry.velocity_covariance[0])
    assert odometry.estimator_type == 2
    assert 1 <= odometry.quality <= 100
    assert odometry.quality == pytest.approx(100 * said.quality, abs=1.0)


def test_layout_and_earth_model_follow_autopilot_and_version():
    assert covariance_layout(Autopilot.PX4, (1, 17, 0)) is CovarianceLayout.PER_AXIS
    assert covariance_layout(Autopilot.ARDUPILOT, (4, 7, 3)) is CovarianceLayout.CUBE_ROOT
    assert covariance_layout(Autopilot.ARDUPILOT, None) is CovarianceLayout.EITHER_ROOT
    assert covariance_layout(Autopilot.ARDUPILOT, (4, 8, 0)) is CovarianceLayout.SQUARE_ROOT
    assert earth_model(Autopilot.PX4) is EarthModel.PX4
    assert earth_model(Autopilot.ARDUPILOT) is EarthModel.ARDUPILOT


def test_global_position_sensor_says_when_it_was_captured():
    said = estimate()
    sending = Sending(PX4, said.stamp_ns + 180 * MS, sensor_id=5)
    m = over_the_wire(encode(Sink.GLOBAL_POSITION_SENSOR, said, None, sending))
    assert (m.target_system, m.target_component, m.id) == (7, 1, 5)
    assert (m.source, m.flags) == (dialect.GLOBAL_POSITION_SRC_VISION, 0)
    assert (m.time_usec, m.processing_time) == (1_000_180_000, 180_000)
    assert (m.lat, m.lon) == (507001000, 71002000)
    assert (m.alt, m.alt_ellipsoid, m.eph, m.epv) == pytest.approx((140.25, 187.5, 2.0, 4.0))
    # Carried on by its local position, a quarter of a kilometre north on PX4's sphere and 10 m up, it goes along.
    carried = estimate(position_ned_m=said.position_ned_m + np.array([250.0, 0.0, -10.0]))
    m = over_the_wire(encode(Sink.GLOBAL_POSITION_SENSOR, carried, None, sending))
    assert m.lat == pytest.approx(507001000 + math.degrees(250.0 / 6371000.0) * 1e7, abs=1.5)
    assert (m.lon, m.alt, m.alt_ellipsoid) == pytest.approx((71002000, 150.25, 197.5), abs=1.5)
    unknown = estimate(place=Place(50.7001, 7.1002, 140.25))
    assert math.isnan(over_the_wire(encode(Sink.GLOBAL_POSITION_SENSOR, unknown, None, sending)).alt_ellipsoid)


def test_gps_input_is_a_receiver_without_velocity_and_knows_the_week():
    said = estimate(position_ned_m=None)
    m = over_the_wire(encode(Sink.GPS_INPUT, said, None, Sending(ARDUPILOT, said.stamp_ns + 250 * MS, WALL_NS)))
    # 2026-11-30 is a Monday, week 2447 since 1980-01-06; 07:00:00 UTC is 18 s later by GPS, and 0.25 s have passed.
    assert m.time_week == 2447
    assert m.time_week_ms == ((24 + 7) * 3600 + 18) * 1000 - 250
    assert m.ignore_flags == 8 | 16 | 32
    assert (m.fix_type, m.satellites_visible, m.yaw) == (3, 255, 0)
    assert (m.lat, m.lon, m.alt, m.horiz_accuracy, m.vert_accuracy) == (507001000, 71002000, 140.25, 2.0, 4.0)
    assert (m.hdop, m.vdop) == pytest.approx((2 / 3, 4 / 3))


@pytest.mark.parametrize(("options", "gps_id"), [({}, 1), ({"gps_id": 0}, 0)])
def test_gps_input_addresses_the_second_receiver_unless_told_otherwise(options, gps_id):
    made, _ = outlet(send=("gps_input",), **options)
    said = estimate()
    (message,) = made.encode(said, ARDUPILOT, ORIGIN, said.stamp_ns, WALL_NS, recovery=False)
    assert over_the_wire(message).gps_id == gps_id


@pytest.mark.parametrize("unix_s", [0, 86_400, 1_700_000_000, 4_000_000_000])
def test_gps_input_without_a_date_is_refused(unix_s):
    said = estimate()
    refused = encode(Sink.GPS_INPUT, said, None, Sending(ARDUPILOT, said.stamp_ns, unix_s * S))
    assert isinstance(refused, Refusal) and refused.kind == "wall_clock"
    assert str(unix_s) in refused.why and "set the clock" in refused.why


@pytest.mark.parametrize("sink", [sink for sink in Sink if sink is not Sink.GPS_INPUT])
def test_no_other_sink_reads_the_date(sink):
    said = estimate()
    mav = dialect.MAVLink(None, 1, 197)
    early, late = (encode(sink, said, ORIGIN, Sending(ARDUPILOT, said.stamp_ns, wall)) for wall in (0, WALL_NS))
    assert early.pack(mav) == late.pack(mav)


def test_the_recovery_command():
    said = estimate()
    command = over_the_wire(encode(Sink.EXTERNAL_POSITION_ESTIMATE, said, None, Sending(PX4, said.stamp_ns + S // 2)))
    assert command.get_type() == "COMMAND_INT" and command.command == 43003
    assert (command.target_system, command.target_component) == (7, 1)
    assert (command.x, command.y) == (507001000, 71002000)
    assert (command.param1, command.param2, command.param3) == pytest.approx((0.5, 0.5, 2.0))  # 1000.5 s wraps at 250
    assert math.isnan(command.z) and math.isnan(command.param4)


@pytest.mark.parametrize(
    ("autopilot", "version", "sink"),
    [
        (Autopilot.PX4, (1, 18, 0), Sink.GLOBAL_POSITION_SENSOR),
        (Autopilot.PX4, (1, 17, 3), Sink.ODOMETRY),
        (Autopilot.PX4, None, Sink.ODOMETRY),
        (Autopilot.ARDUPILOT, (4, 5, 0), Sink.ODOMETRY),
        (Autopilot.ARDUPILOT, (4, 9, 0), Sink.ODOMETRY),
        (Autopilot.ARDUPILOT, None, Sink.ODOMETRY),
    ],
)
def test_automatic_choice(autopilot, version, sink):
    choice = choose_sinks(("auto",), AutopilotIdentity(7, autopilot, version))
    assert choice.sinks == (sink,) and not choice.doubts and choice.why


@pytest.mark.parametrize(
    ("autopilot", "version"),
    [(Autopilot.PX4, (1, 18, 0)), (Autopilot.ARDUPILOT, (4, 7, 0)), (Autopilot.ARDUPILOT, (4, 8, 0))],
)
def test_a_development_build_gets_what_either_of_its_neighbours_reads(autopilot, version):
    vehicle = AutopilotIdentity(7, autopilot, version, development=True)
    choice = choose_sinks(("auto",), vehicle)
    assert choice.sinks == (Sink.ODOMETRY,) and "(dev build)" in choice.why
    said = estimate(sigma_m=0.5)
    sent = encode(Sink.ODOMETRY, said, ORIGIN, Sending(vehicle, said.stamp_ns))
    unknown = encode(Sink.ODOMETRY, said, ORIGIN, Sending(replace(vehicle, firmware_version=None), said.stamp_ns))
    assert sent.pose_covariance == unknown.pose_covariance
    wide = encode(Sink.ODOMETRY, estimate(sigma_m=20.0), ORIGIN, Sending(vehicle, said.stamp_ns))
    assert isinstance(wide, Refusal) is (autopilot is Autopilot.ARDUPILOT)


def test_named_sinks_are_sent_with_their_doubts():
    choice = choose_sinks(("gps_input", "odometry"), AutopilotIdentity(7, Autopilot.PX4, (1, 16, 0)))
    assert choice.sinks == (Sink.GPS_INPUT, Sink.ODOMETRY)
    unread, twice = choice.doubts
    assert "px4 1.16.0" in unread and "GPS_INPUT" in unread
    assert "fuse only one" in twice
    (unread,) = choose_sinks(("global_position_sensor",), AutopilotIdentity(7, Autopilot.ARDUPILOT, (4, 8, 0))).doubts
    assert "GLOBAL_POSITION_SENSOR" in unread


def outlet(**options) -> tuple[Outlet, Counter[str]]:
    counts: Counter[str] = Counter()
    return Outlet(LinkOptions(endpoint="udp:x:1", **options), counts, LimitedLog()), counts


def names(messages) -> list[str]:
    return [message.get_type() for message in messages]


def test_choice_is_made_anew_when_the_version_is_told(caplog):
    caplog.set_level(logging.INFO)
    made, _ = outlet()
    assert made.sinks(replace(PX4, firmware_version=None)) == (Sink.ODOMETRY,)
    assert made.sinks(PX4) == made.sinks(PX4) == (Sink.GLOBAL_POSITION_SENSOR,)
    said = [record.getMessage() for record in caplog.records]
    assert len(said) == 2
    assert "ODOMETRY" in said[0] and "unknown version" in said[0]
    assert "GLOBAL_POSITION_SENSOR" in said[1]


def test_a_sigma_beyond_what_the_filter_believes_is_not_sent_but_told(caplog):
    made, counts = outlet()
    wide = estimate(sigma_m=14.0)
    assert made.encode(wide, ARDUPILOT, ORIGIN, wide.stamp_ns, WALL_NS, False) == []
    assert counts["refused.sigma"] == 1
    assert "14.0 m" in caplog.text and "ardupilot 4.6.0 believes 10 m" in caplog.text
    newer = replace(ARDUPILOT, firmware_version=(4, 7, 0))
    assert names(made.encode(wide, newer, ORIGIN, wide.stamp_ns, WALL_NS, False)) == ["ODOMETRY"]


def test_a_sigma_below_what_the_filter_believes_is_told_once(caplog):
    caplog.set_level(logging.INFO)
    made, counts = outlet()
    for _ in range(3):
        assert made.encode(estimate(sigma_m=0.1), ARDUPILOT, ORIGIN, 1000 * S, WALL_NS, False)
    assert counts["floored"] == 3
    told = [r.getMessage() for r in caplog.records if "VISO_POS_M_NSE" in r.getMessage()]
    assert len(told) == 1 and "0.10 m counts as 0.2 m" in told[0]
    assert limits(Sink.ODOMETRY, Autopilot.ARDUPILOT, (4, 6, 0)).least_sigma_m == 0.2


def test_a_position_from_another_origin_is_not_sent(caplog):
    made, counts = outlet()
    elsewhere = GeodeticOrigin(50.7, 7.2, 60.0)
    assert made.encode(estimate(), ARDUPILOT, elsewhere, 1000 * S, WALL_NS, False) == []
    assert counts["refused.origin_moved"] == 1 and "origin moved" in caplog.text
    assert made.encode(estimate(origin=elsewhere), ARDUPILOT, elsewhere, 1000 * S, WALL_NS, False)
    # Whoever does not say what it counts from means the present one.
    assert made.encode(estimate(origin=None), ARDUPILOT, elsewhere, 1000 * S, WALL_NS, False)
    # A place on WGS 84 is where it was.
    assert names(made.encode(estimate(), PX4, elsewhere, 1000 * S, WALL_NS, False)) == ["GLOBAL_POSITION_SENSOR"]


def test_recovery_goes_first_and_only_where_it_may():
    said = estimate()
    made, _ = outlet(recovery=True)
    assert names(made.encode(said, ARDUPILOT, ORIGIN, said.stamp_ns, WALL_NS, True)) == ["COMMAND_INT", "ODOMETRY"]
    assert names(made.encode(said, ARDUPILOT, ORIGIN, said.stamp_ns, WALL_NS, False)) == ["ODOMETRY"]
    older = replace(PX4, firmware_version=(1, 14, 0))
    assert names(made.encode(said, older, ORIGIN, said.stamp_ns, WALL_NS, True)) == ["ODOMETRY"]
    made, _ = outlet()
    assert names(made.encode(said, ARDUPILOT, ORIGIN, said.stamp_ns, WALL_NS, True)) == ["ODOMETRY"]


def test_recovery_bears_the_stamp_of_capture_beside_odometry():
    said = estimate()
    now_ns = said.stamp_ns + 200 * MS
    made, _ = outlet(recovery=True)
    command, _ = made.encode(said, ARDUPILOT, ORIGIN, now_ns, WALL_NS, True)
    assert command.param1 == pytest.approx(1000.0, abs=1e-4)
    made, _ = outlet(recovery=True, send=("gps_input",))
    command, _ = made.encode(said, ARDUPILOT, ORIGIN, now_ns, WALL_NS, True)
    assert command.param1 == pytest.approx(1000.2, abs=1e-4)


def test_one_that_is_refused_leaves_the_others():
    made, counts = outlet(send=("gps_input", "odometry"))
    assert names(made.encode(estimate(), ARDUPILOT, ORIGIN, 1000 * S, 0, False)) == ["ODOMETRY"]
    assert counts["refused.wall_clock"] == 1
