"""Outcomes leave the process as JSON."""

import json

import msgspec
import numpy as np
import pytest
from scenes_pipeline import fix, turned_down

from ortholoc_edge.geometry import rotation
from ortholoc_edge.pipeline.outcome import Reason, Rejected
from ortholoc_edge.pipeline.record import outcome_of, outcome_record
from ortholoc_edge.pipeline.trace import Trace


def both_ways(record):
    """By the encoder that the package uses, and by the standard's; they must agree."""
    decoded = json.loads(msgspec.json.encode(record))
    assert json.loads(json.dumps(record, allow_nan=False)) == decoded
    return decoded


def test_a_fix_survives_json():
    turn = turned_down(12.0, 77.0)
    made = fix((500_000.125, 5_300_000.5, 321.0), stamp_ns=2**53 + 1, rotation_matrix=turn)
    record = both_ways(outcome_record(made))
    assert record["fix"] is True
    assert record["stamp_ns"] == 2**53 + 1
    assert record["position_map_m"] == [500_000.125, 5_300_000.5, 321.0]
    assert np.allclose(rotation.from_quaternion(record["quaternion_map_from_camera_wxyz"]), turn)
    assert np.allclose(record["covariance"], made.covariance)
    assert record["protection_m"] == list(made.protection_m)
    assert (record["matches"], record["inliers"]) == (200, 160)
    assert record["adhop_accepted"] is None
    assert record["focal_px"] == pytest.approx(200.0)
    assert record["focal_sigma_px"] is None


def test_a_record_becomes_an_outcome_again():
    """All but the inliers, which it has not."""
    made = fix((500_000.125, 5_300_000.5, 321.0), stamp_ns=7, rotation_matrix=turned_down(12.0, 77.0))
    record = both_ways(outcome_record(made))
    again = outcome_record(outcome_of(record, made.camera))
    turns = [one.pop("quaternion_map_from_camera_wxyz") for one in (record, again)]
    assert turns[1] == pytest.approx(turns[0]) and again == record
    record["quaternion_map_from_camera_wxyz"] = turns[0]
    calibrated = outcome_of({**record, "focal_px": 2 * made.camera.focal_px, "focal_sigma_px": 3.0}, made.camera)
    assert calibrated.camera.fx == pytest.approx(2 * made.camera.fx)
    refused = both_ways(outcome_record(Rejected(123, Reason.UNCERTAIN, "why", 1.5, 2, {"total": 7.25})))
    assert outcome_record(outcome_of(refused, made.camera)) == refused


@pytest.mark.parametrize("reason", list(Reason))
def test_a_rejection_survives_json(reason):
    made = Rejected(123, reason, "why", 1.5, 2, {"total": 7.25})
    record = both_ways(outcome_record(made))
    assert record == {
        "stamp_ns": 123,
        "fix": False,
        "reason": reason.value,
        "detail": "why",
        "measured": 1.5,
        "limit": 2,
        "timings_ms": {"total": 7.25},
    }


def test_a_rejection_without_numbers():
    record = both_ways(outcome_record(Rejected(1, Reason.NO_PRIOR)))
    assert record["measured"] is None
    assert record["limit"] is None


def test_reasons_are_their_own_names():
    assert all(reason.value == reason.name.lower() for reason in Reason)


def test_trace_adds_up_stages_also_of_those_that_fail():
    trace = Trace()
    with trace.stage("match"):
        pass
    once = trace.timings_ms()["match"]
    with pytest.raises(RuntimeError), trace.stage("match"):
        raise RuntimeError
    with trace.stage("pose"):
        pass
    timings = trace.timings_ms()
    assert list(timings) == ["match", "pose", "total"]
    assert timings["match"] > once >= 0
    assert timings["total"] >= timings["match"] + timings["pose"]
