"""Encoding against our own transcription of what the firmwares do with the fields, and the origin against
PROJ."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as dialect
from pyproj import Geod

from ortholoc_edge.adapters.mavlink.estimates import (
    Autopilot,
    CovarianceLayout,
    EarthModel,
    GeodeticOrigin,
    VisionEstimate,
    covariance_layout,
    earth_model,
    encode_odometry,
    encode_vision_position_estimate,
    horizontal_sigma_m,
    moved,
    ned_from_geodetic,
    yaw_sigma_rad,
)
from ortholoc_edge.geometry import rotation

GEOD = Geod(ellps="WGS84")

angles = st.floats(-math.pi, math.pi)
pitches = st.floats(-1.5, 1.5)
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
        ned_from_body=rotation.from_euler(draw(angles), draw(pitches), draw(angles)),
        covariance=draw(covariances()),
        reset_counter=draw(st.integers(0, 255)),
        quality=draw(st.floats(0.0, 1.0)),
    )


def over_the_wire(message):
    sender, receiver = dialect.MAVLink(None, 1, 197), dialect.MAVLink(None, 0, 0)
    (decoded,) = receiver.parse_buffer(message.pack(sender))
    return decoded


# Transcribed from ArduPilot's GCS_Common handle_odometry / handle_vision_position_estimate and from PX4's
# mavlink_receiver, as in section 2.3 and 2.4 of the contract; not from our encoder.
def ardupilot_old(c: list[float]) -> tuple[float, float]:
    if math.isnan(c[0]):
        return 0.0, 0.0
    return (
        np.cbrt(c[0] ** 2 + c[6] ** 2 + c[11] ** 2),
        np.cbrt(c[15] ** 2 + c[18] ** 2 + c[20] ** 2),
    )


def ardupilot_new(c: list[float]) -> tuple[float, float]:
    if math.isnan(c[0]):
        return 0.0, 0.0
    return math.sqrt(c[0] + c[6] + c[11]), math.sqrt(c[15] + c[18] + c[20])


def ardupilot_accepts_odometry(m) -> bool:
    return m.frame_id == 20 and m.child_frame_id == 12


def px4_odometry_position(m) -> tuple[str, np.ndarray, np.ndarray] | None:
    frames = {1: "ned", 4: "enu", 20: "frd", 21: "flu"}
    if m.frame_id not in frames or m.estimator_type not in (0, 1, 2, 3):
        return None
    c = m.pose_covariance
    return frames[m.frame_id], np.array([m.x, m.y, m.z]), np.array([c[0], c[6], c[11], c[15], c[18], c[20]])


@pytest.mark.parametrize(
    ("layout", "decode"),
    [(CovarianceLayout.CUBE_ROOT, ardupilot_old), (CovarianceLayout.SQUARE_ROOT, ardupilot_new)],
)
@given(estimate=estimates())
def test_ardupilot_uses_the_sigma_we_mean(estimate, layout, decode):
    vpe = over_the_wire(encode_vision_position_estimate(estimate, layout))
    odometry = over_the_wire(encode_odometry(estimate, layout))
    for field in (vpe.covariance, odometry.pose_covariance):
        assert all(math.isfinite(v) for v in field)
        position_sigma, angle_sigma = decode(field)
        assert position_sigma == pytest.approx(horizontal_sigma_m(estimate), rel=1e-5)
        assert angle_sigma == pytest.approx(yaw_sigma_rad(estimate), rel=1e-5)
    assert ardupilot_accepts_odometry(odometry)


def test_horizontal_sigma_is_of_the_longer_axis():
    covariance = np.eye(6)
    covariance[:2, :2] = [[5.0, 4.0], [4.0, 5.0]]  # 3 m along north-east, 1 m across
    assert horizontal_sigma_m(VisionEstimate(0, np.zeros(3), np.eye(3), covariance)) == pytest.approx(3.0)


def test_the_contracts_figure_for_old_ardupilot():
    # Section 2.11: for E metres send sqrt(E^3 / 3) in each of three entries; in two of them that is sqrt(E^3
    # / 2).
    estimate = VisionEstimate(0, np.zeros(3), np.eye(3), np.diag([4.0, 4.0, 9.0, 0.01, 0.01, 0.04]))
    field = encode_odometry(estimate, CovarianceLayout.CUBE_ROOT).pose_covariance
    assert field[0] == pytest.approx(2.0) and field[6] == pytest.approx(2.0) and field[11] == 0.0
    assert ardupilot_old(field) == pytest.approx((2.0, 0.2))


@given(estimate=estimates())
def test_px4_gets_every_variance(estimate):
    odometry = over_the_wire(encode_odometry(estimate, CovarianceLayout.PER_AXIS))
    frame, position, variances = px4_odometry_position(odometry)
    assert frame == "ned"
    np.testing.assert_allclose(position, estimate.position_ned_m, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(variances, np.diag(estimate.covariance), rtol=1e-5)
    c = np.zeros((6, 6))
    c[np.triu_indices(6)] = odometry.pose_covariance
    np.testing.assert_allclose(c, np.triu(estimate.covariance), rtol=1e-5, atol=1e-6)


@given(estimate=estimates())
def test_pose_survives_the_wire(estimate):
    vpe = over_the_wire(encode_vision_position_estimate(estimate, CovarianceLayout.PER_AXIS))
    odometry = over_the_wire(encode_odometry(estimate, CovarianceLayout.CUBE_ROOT))
    assert vpe.usec == odometry.time_usec == estimate.stamp_ns // 1000
    assert vpe.reset_counter == odometry.reset_counter == estimate.reset_counter
    for message in (vpe, odometry):
        np.testing.assert_allclose([message.x, message.y, message.z], estimate.position_ned_m, rtol=1e-6, atol=1e-6)
    from_vpe = rotation.from_euler(vpe.roll, vpe.pitch, vpe.yaw)
    assert rotation.angle_between(from_vpe, estimate.ned_from_body) < 1e-5
    assert rotation.angle_between(rotation.from_quaternion(odometry.q), estimate.ned_from_body) < 1e-5
    assert math.isnan(odometry.vx) and math.isnan(odometry.vy) and math.isnan(odometry.vz)
    assert math.isnan(odometry.velocity_covariance[0])
    assert odometry.estimator_type == 2
    assert 1 <= odometry.quality <= 100
    assert odometry.quality == pytest.approx(100 * estimate.quality, abs=1.0)


def test_layout_follows_autopilot_and_version():
    assert covariance_layout(Autopilot.PX4, (1, 17, 0)) is CovarianceLayout.PER_AXIS
    assert covariance_layout(Autopilot.ARDUPILOT, (4, 7, 3)) is CovarianceLayout.CUBE_ROOT
    assert covariance_layout(Autopilot.ARDUPILOT, None) is CovarianceLayout.CUBE_ROOT
    assert covariance_layout(Autopilot.ARDUPILOT, (4, 8, 0)) is CovarianceLayout.SQUARE_ROOT
    assert earth_model(Autopilot.PX4) is EarthModel.PX4
    assert earth_model(Autopilot.ARDUPILOT) is EarthModel.ARDUPILOT


@pytest.mark.parametrize(
    "change",
    [
        {"position_ned_m": np.array([0.0, math.nan, 0.0])},
        {"position_ned_m": np.zeros(2)},
        {"ned_from_body": np.diag([1.0, 1.0, -1.0])},
        {"ned_from_body": 2.0 * np.eye(3)},
        {"covariance": -np.eye(6)},
        {"covariance": np.triu(np.ones((6, 6)))},
        {"covariance": np.full((6, 6), math.inf)},
        {"reset_counter": 256},
        {"reset_counter": -1},
        {"quality": 1.5},
        {"quality": math.nan},
        {"stamp_ns": -1},
    ],
    ids=lambda change: next(iter(change)),
)
def test_unusable_estimate_is_refused(change):
    values = {
        "stamp_ns": 0,
        "position_ned_m": np.zeros(3),
        "ned_from_body": np.eye(3),
        "covariance": np.eye(6),
    }
    with pytest.raises(ValueError, match=next(iter(change))):
        VisionEstimate(**(values | change))


@pytest.mark.parametrize("latitude", [-72.0, -33.9, 0.0, 8.5, 50.7, 69.6, 82.0])
@pytest.mark.parametrize("azimuth", range(0, 360, 45))
def test_wgs84_agrees_with_geodesics(latitude, azimuth):
    """Under 1 cm in 1 km; the tangent plane itself is 4 micrometres shorter than the geodesic there."""
    origin = GeodeticOrigin(latitude, 7.1, 0.0)
    lon, lat, _ = GEOD.fwd(7.1, latitude, azimuth, 1000.0)
    ned = ned_from_geodetic(origin, lat, lon, 12.0, EarthModel.WGS84)
    expected = 1000.0 * np.array([math.cos(math.radians(azimuth)), math.sin(math.radians(azimuth))])
    np.testing.assert_allclose(ned[:2], expected, atol=0.01)
    assert ned[2] == -12.0


def test_wgs84_lengths_are_those_at_the_origins_height():
    origin = GeodeticOrigin(46.5, 8.0, 3000.0)
    lon, lat, _ = GEOD.fwd(8.0, 46.5, 90.0, 1000.0)
    east = ned_from_geodetic(origin, lat, lon, 3000.0, EarthModel.WGS84)[1]
    assert east == pytest.approx(1000.0 * (1.0 + 3000.0 / 6388e3), abs=0.01)


@given(
    latitude=st.floats(-85.0, 85.0),
    longitude=st.floats(-180.0, 180.0),
    offset=st.tuples(st.floats(-70.0, 70.0), st.floats(-70.0, 70.0), st.floats(-20.0, 20.0)),
)
def test_moved_is_true_metres(latitude, longitude, offset):
    lat, lon, height = moved(latitude, longitude, 0.0, np.array(offset))
    assert abs(lon) <= 180.0
    np.testing.assert_allclose(
        ned_from_geodetic(GeodeticOrigin(latitude, longitude, 0.0), lat, lon, height, EarthModel.WGS84),
        offset,
        atol=0.02,
    )


def test_moved_at_the_pole_and_across_the_date_line():
    assert moved(90.0, 5.0, 10.0, np.array([3.0, 4.0, 5.0])) == (90.0, 5.0, 5.0)
    assert moved(0.0, 179.9999, 0.0, np.array([0.0, 100.0, 0.0]))[1] == pytest.approx(-179.9992, abs=1e-4)


def ardupilot_get_distance_ne(lat0: int, lon0: int, lat: int, lon: int) -> tuple[float, float]:
    """Location::get_distance_NE on 1e-7 degree integers, transcribed."""
    scaling = 0.011131884502145034
    scale = max(math.cos((lat + lat0) / 2 * 1e-7 * math.pi / 180.0), 0.01)
    return (lat - lat0) * scaling, (lon - lon0) * scaling * scale


@given(
    lat0=st.integers(-800000000, 800000000),
    dlat=st.integers(-900000, 900000),
    dlon=st.integers(-900000, 900000),
)
def test_ardupilot_model_is_ardupilots(lat0, dlat, dlon):
    lon0 = 71000000
    ned = ned_from_geodetic(
        GeodeticOrigin(lat0 / 1e7, lon0 / 1e7, 0.0),
        (lat0 + dlat) / 1e7,
        (lon0 + dlon) / 1e7,
        0.0,
        EarthModel.ARDUPILOT,
    )
    np.testing.assert_allclose(ned[:2], ardupilot_get_distance_ne(lat0, lon0, lat0 + dlat, lon0 + dlon), atol=1e-4)


@pytest.mark.parametrize("latitude", [-50.0, 0.0, 50.0])
@pytest.mark.parametrize("azimuth", [10.0, 130.0, 275.0])
def test_px4_model_is_a_sphere_of_6371_km(latitude, azimuth):
    sphere = Geod(a=6371000.0, b=6371000.0)
    lon, lat, _ = sphere.fwd(7.0, latitude, azimuth, 15000.0)
    ned = ned_from_geodetic(GeodeticOrigin(latitude, 7.0, 0.0), lat, lon, 0.0, EarthModel.PX4)
    expected = 15000.0 * np.array([math.cos(math.radians(azimuth)), math.sin(math.radians(azimuth))])
    np.testing.assert_allclose(ned[:2], expected, atol=1e-3)


def test_date_line_is_no_jump():
    origin = GeodeticOrigin(-17.0, 179.999, 0.0)
    for model in EarthModel:
        east = ned_from_geodetic(origin, -17.0, -179.999, 0.0, model)[1]
        assert east == pytest.approx(0.002 * 111320 * math.cos(math.radians(17.0)), rel=0.01)


@pytest.mark.parametrize("values", [(91.0, 0.0, 0.0), (0.0, 181.0, 0.0), (math.nan, 0, 0), (0, 0, math.inf)])
def test_unusable_origin_is_refused(values):
    with pytest.raises(ValueError, match="origin"):
        GeodeticOrigin(*values)
