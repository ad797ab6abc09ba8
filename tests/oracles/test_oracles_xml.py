"""Copies can be wrong: the oracles' numbers against the message definitions."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from functools import cache
from pathlib import Path

import pymavlink.dialects.v20
import pytest

from . import ardupilot, px4

FOLDER = Path(next(iter(pymavlink.dialects.v20.__path__)))


@cache
def definitions() -> tuple[dict[str, int], dict[str, int]]:
    """(messages by name, enumeration entries by name) of ardupilotmega.xml and all that it includes."""
    messages: dict[str, int] = {}
    entries: dict[str, int] = {}
    waiting, seen = ["ardupilotmega.xml"], set()
    while waiting:
        name = waiting.pop()
        if name in seen:
            continue
        seen.add(name)
        root = ET.parse(FOLDER / name).getroot()
        waiting += [include.text or "" for include in root.iter("include")]
        messages |= {m.attrib["name"]: int(m.attrib["id"]) for m in root.iter("message")}
        for entry in root.iter("entry"):
            if "value" in entry.attrib:
                entries[entry.attrib["name"]] = int(entry.attrib["value"], 0)
    return messages, entries


@pytest.mark.parametrize("oracle", [ardupilot, px4], ids=lambda module: module.__name__)
@pytest.mark.parametrize(
    "name", ["ODOMETRY", "VISION_POSITION_ESTIMATE", "GLOBAL_POSITION_SENSOR", "GPS_INPUT", "COMMAND_INT"]
)
def test_messages_are_numbered_so(oracle, name):
    assert getattr(oracle, name) == definitions()[0][name]


@pytest.mark.parametrize(
    ("value", "name"),
    [
        (ardupilot.EXTERNAL_POSITION_ESTIMATE, "MAV_CMD_EXTERNAL_POSITION_ESTIMATE"),
        (ardupilot.MAV_FRAME_LOCAL_FRD, "MAV_FRAME_LOCAL_FRD"),
        (ardupilot.MAV_FRAME_BODY_FRD, "MAV_FRAME_BODY_FRD"),
        (ardupilot.GLOBAL_POSITION_UNHEALTHY, "GLOBAL_POSITION_UNHEALTHY"),
        (ardupilot.IGNORE_ALT, "GPS_INPUT_IGNORE_FLAG_ALT"),
        (ardupilot.IGNORE_HDOP, "GPS_INPUT_IGNORE_FLAG_HDOP"),
        (ardupilot.IGNORE_VEL_HORIZ, "GPS_INPUT_IGNORE_FLAG_VEL_HORIZ"),
        (ardupilot.IGNORE_HORIZONTAL_ACCURACY, "GPS_INPUT_IGNORE_FLAG_HORIZONTAL_ACCURACY"),
        (ardupilot.FIX_3D, "GPS_FIX_TYPE_3D_FIX"),
        (px4.EXTERNAL_POSITION_ESTIMATE, "MAV_CMD_EXTERNAL_POSITION_ESTIMATE"),
        (px4.MAV_FRAME_LOCAL_NED, "MAV_FRAME_LOCAL_NED"),
        (px4.MAV_FRAME_LOCAL_ENU, "MAV_FRAME_LOCAL_ENU"),
        (px4.MAV_FRAME_LOCAL_FRD, "MAV_FRAME_LOCAL_FRD"),
        (px4.MAV_FRAME_LOCAL_FLU, "MAV_FRAME_LOCAL_FLU"),
        (px4.ESTIMATOR_UNKNOWN, "MAV_ESTIMATOR_TYPE_UNKNOWN"),
        (px4.ESTIMATOR_NAIVE, "MAV_ESTIMATOR_TYPE_NAIVE"),
        (px4.ESTIMATOR_VISION, "MAV_ESTIMATOR_TYPE_VISION"),
        (px4.ESTIMATOR_VIO, "MAV_ESTIMATOR_TYPE_VIO"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_values_are_those_of_the_definitions(value, name):
    assert value == definitions()[1][name]
