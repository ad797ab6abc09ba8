"""The state that a frame waits for, and what an estimate knows less of than the fix that it is made of."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, cast

import msgspec
import numpy as np
import pytest
from adapters.link_scenes import MS, Flight, S
from pipeline.scenes_pipeline import fix
from replay import rendered

from ortholoc_edge.adapters.mavlink.estimates import Autopilot, VisionEstimate
from ortholoc_edge.adapters.mavlink.geodesy import EarthModel, GeodeticOrigin
from ortholoc_edge.adapters.mavlink.state import AutopilotIdentity, AutopilotState
from ortholoc_edge.config import AttitudeOptions, MountOptions
from ortholoc_edge.geometry.rigid import Rigid3
from ortholoc_edge.tiles.georeference import Georeference
from ortholoc_edge.vehicle import Vehicle, vision_estimate


def told(georeference: Georeference, lever_m: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> VisionEstimate:
    """Of a fix that knows each axis to 0.5 m and 0.005 rad; the body is off the camera by a lever in the map's axes."""
    found = fix(rendered.pose().translation)
    body = Rigid3(found.map_from_camera.rotation, found.map_from_camera.translation + np.array(lever_m))
    return vision_estimate(found, body, georeference, None, EarthModel.ARDUPILOT, 0)


def test_height_above_the_sea_knows_no_more_than_its_level() -> None:
    known = rendered.georeference()
    for sigma_m in (0.0, 1.2):
        less = replace(known, vertical=msgspec.structs.replace(known.vertical, amsl_sigma_m=sigma_m))
        assert np.diag(told(less).covariance)[:3] == pytest.approx([0.25, 0.25, 0.25 + sigma_m**2])


def test_the_body_is_known_less_the_farther_it_is_from_the_camera() -> None:
    """20 m below it: 0.005 rad are 0.1 m, northward and eastward."""
    variances = np.diag(told(rendered.georeference(), lever_m=(0.0, 0.0, -20.0)).covariance)[:2]
    assert variances == pytest.approx([0.25 + 0.01] * 2)


class _Link:
    """Telemetry that follows an exposure by ``late_ns``; each look takes 5 ms of its own clock."""

    def __init__(self, late_ns: int) -> None:
        self.now, self.complete_ns = S, S + late_ns

    def now_ns(self) -> int:
        return self.now

    def state_at(self, stamp_ns: int) -> AutopilotState | None:
        self.now += 5 * MS
        state = Flight().look(stamp_ns)
        return state and replace(state, interpolated=self.now >= self.complete_ns)

    def trouble(self) -> str | None:
        return None

    def turns_before(self, stamp_ns: int, ages_ns: Sequence[int]) -> None:
        return None

    vehicle: AutopilotIdentity | None = None


@pytest.mark.parametrize(("late_ms", "waited_ms"), [(0, 5), (100, 100), (9000, 150)])
def test_a_frame_waits_a_little_for_the_attitude_that_follows_it(late_ms: int, waited_ms: int) -> None:
    """One that is carried on by its rates is worse; but of an autopilot that fell silent nothing follows."""
    link: Any = _Link(late_ms * MS)
    vehicle = Vehicle(
        link, cast(Any, None), rendered.georeference(), MountOptions(), AttitudeOptions(), link, Counter()
    )
    state = vehicle.at(S, threading.Event())
    assert state.ned_from_body is not None
    assert (link.now - S) // MS == pytest.approx(waited_ms, abs=5)


@pytest.mark.parametrize(
    ("changed", "known"),
    [
        ({}, True),
        ({"origin": None}, False),
        ({"local_position_ned_m": None}, False),
        ({"local_position_ned_m": np.array([np.nan, 0.0, 0.0])}, False),
        ({"local_position_ned_m": np.array([9e6, 0.0, 0.0])}, False),
    ],
)
def test_where_the_autopilot_believes_to_be_is_told_in_the_map(changed: dict[str, Any], known: bool) -> None:
    georeference = rendered.georeference()
    there = rendered.pose().translation + np.array([3.0, -4.0, 5.0])
    place = georeference.geodetic_from_map(rendered.pose().translation)
    assert place.height_amsl_m is not None
    origin = GeodeticOrigin(place.lat_deg, place.lon_deg, place.height_amsl_m)
    convergence = georeference.convergence_rad(there[:2])
    north, east = (
        -4.0 * np.cos(convergence) + 3.0 * np.sin(convergence), 3.0 * np.cos(convergence) + 4.0 * np.sin(convergence),
    )  # fmt: skip
    link: Any = _Link(0)
    fields = {"origin": origin, "local_position_ned_m": np.array([north, east, -5.0])} | changed
    first = link.state_at
    link.state_at = lambda stamp_ns: replace(first(stamp_ns), **fields)
    link.vehicle = AutopilotIdentity(1, Autopilot.PX4, None)
    vehicle = Vehicle(
        link, cast(Any, None), georeference, MountOptions(), AttitudeOptions(), link, Counter()
    )
    believed = vehicle.at(S, threading.Event()).believed_map_m
    if known:
        assert believed is not None
        assert np.allclose(believed, there, atol=0.02), believed - there
    else:
        assert believed is None
