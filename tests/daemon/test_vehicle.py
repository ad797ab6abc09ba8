"""What an estimate knows less of than the fix that it is made of."""

from __future__ import annotations

from dataclasses import replace

import msgspec
import numpy as np
import pytest
from pipeline.scenes_pipeline import fix
from replay import rendered

from ortholoc_edge.adapters.mavlink.estimates import VisionEstimate
from ortholoc_edge.adapters.mavlink.geodesy import EarthModel
from ortholoc_edge.geometry.rigid import Rigid3
from ortholoc_edge.tiles.georeference import Georeference
from ortholoc_edge.vehicle import vision_estimate


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
