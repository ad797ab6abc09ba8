"""Offsets from the autopilot's origin against PROJ's geodesics and against the autopilots' own formulas."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pyproj import Geod
from strategies import finite

from ortholoc_edge.adapters.mavlink.geodesy import (
    EarthModel,
    GeodeticOrigin,
    Place,
    geodetic_from_ned,
    moved,
    ned_from_geodetic,
)

GEOD = Geod(ellps="WGS84")


@given(
    latitude=finite(-80.0, 80.0),
    longitude=finite(-180.0, 180.0),
    azimuth=finite(0.0, 360.0),
    distance_m=finite(0.0, 20_000.0),
)
def test_offsets_are_true_metres(latitude, longitude, azimuth, distance_m):
    """By the geodesic's length and azimuth, on the autopilots' spheres within 0.7 %.

    Apart from their axes the meridians' convergence turns an equirectangular offset: d^2 tan(latitude) / 2R across.
    """
    lon, lat, _ = GEOD.fwd(longitude, latitude, azimuth, distance_m)
    true_m = distance_m * np.array([math.cos(math.radians(azimuth)), math.sin(math.radians(azimuth))])
    origin = GeodeticOrigin(latitude, longitude, 100.0)
    offsets = {model: ned_from_geodetic(origin, lat, lon, 250.0, model) for model in EarthModel}
    np.testing.assert_allclose(offsets[EarthModel.PX4][:2], true_m, atol=0.0071 * distance_m + 0.01)
    bent_m = distance_m**2 * math.tan(math.radians(abs(latitude) + 0.2)) / (2 * 6_335_000.0)
    np.testing.assert_allclose(offsets[EarthModel.ARDUPILOT][:2], true_m, atol=0.0071 * distance_m + bent_m + 0.01)
    assert {ned[2] for ned in offsets.values()} == {-150.0}


@pytest.mark.parametrize("model", list(EarthModel))
@given(
    latitude=finite(-80.0, 80.0),
    longitude=finite(-180.0, 180.0),
    position=st.tuples(finite(-20_000.0, 20_000.0), finite(-20_000.0, 20_000.0), finite(-5000.0, 500.0)),
)
def test_there_and_back(model, latitude, longitude, position):
    origin = GeodeticOrigin(latitude, longitude, 250.0)
    place = geodetic_from_ned(origin, np.array(position), model)
    np.testing.assert_allclose(ned_from_geodetic(origin, *place, model), position, atol=1e-3)


@given(
    latitude=st.floats(-85.0, 85.0),
    longitude=st.floats(-180.0, 180.0),
    offset=st.tuples(st.floats(-70.0, 70.0), st.floats(-70.0, 70.0), st.floats(-20.0, 20.0)),
)
def test_moved_is_true_metres(latitude, longitude, offset):
    lat, lon, height = moved(latitude, longitude, 0.0, np.array(offset))
    assert abs(lon) <= 180.0
    azimuth_deg, _, distance_m = GEOD.inv(longitude, latitude, lon, lat)
    azimuth = math.radians(azimuth_deg)
    way_m = [distance_m * math.cos(azimuth), distance_m * math.sin(azimuth), -height]
    np.testing.assert_allclose(way_m, offset, atol=0.02)


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


@pytest.mark.parametrize("values", [(91.0, 0.0, 0.0), (0.0, -181.0, 0.0), (0, 0, math.nan), (0, 0, 0, math.inf)])
def test_unusable_place_is_refused(values):
    with pytest.raises(ValueError, match="place"):
        Place(*values)
