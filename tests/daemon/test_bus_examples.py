"""The examples for the bus in docs/examples, run and worked by hand; and the published schema."""

from __future__ import annotations

import importlib.util
import json
import math
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest
from test_bus import a_message, free_port

from ortholoc_edge.adapters.bus import Bus, BusOptions
from ortholoc_edge.adapters.messages import Command, CommandReply, Pause, StatsMessage
from ortholoc_edge.cli import main

ROOT = Path(__file__).resolve().parents[2]
CLIENT = ROOT / "docs" / "examples" / "bus_client.py"


def test_the_published_schema_is_the_codes(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bus", "schema"]) == 0
    printed = capsys.readouterr().out
    published = (ROOT / "docs" / "bus.schema.json").read_text(encoding="utf-8")
    assert published == printed, "ortholoc-edge bus schema > docs/bus.schema.json"


# -- the client ----------------------------------------------------------------


@pytest.fixture(scope="module")
def served() -> Iterator[tuple[str, list[Command]]]:
    """An endpoint where fixes are published all the time, and what was commanded there."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    bus = Bus(BusOptions(vehicle="hawk", listen=(endpoint,), commands=True))
    commands: list[Command] = []

    def on_command(command: Command) -> CommandReply:
        commands.append(command)
        if isinstance(command, Pause):
            return CommandReply(command="pause", accepted=True)
        return CommandReply(command="resume", accepted=False, reason="not paused", remedy="nothing")

    bus.serve({"stats": lambda: StatsMessage(stamp_ns=1, unix_ns=2, statistics={"fixes": 3})}, on_command)
    end = threading.Event()

    def publish() -> None:
        while not end.wait(0.02):
            bus.publish(a_message())

    publisher = threading.Thread(target=publish)
    publisher.start()
    yield endpoint, commands
    end.set()
    publisher.join()
    bus.close()


def client(endpoint: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(CLIENT), "--connect", endpoint, "--vehicle", "hawk", *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)


def test_the_client_follows(served: tuple[str, list[Command]]) -> None:
    done = client(served[0], "--seconds", "1")
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert "alive" in lines
    camera = a_message().camera
    assert f"fix {camera.lat_deg:.7f} {camera.lon_deg:.7f} within 2.00 m (1 sigma)" in lines


def test_the_client_asks_and_commands(served: tuple[str, list[Command]]) -> None:
    endpoint, commands = served
    done = client(endpoint, "--ask", "stats")
    assert (done.returncode, json.loads(done.stdout)["statistics"]) == (0, {"fixes": 3}), done.stderr
    done = client(endpoint, "--command", "pause")
    assert done.returncode == 0 and json.loads(done.stdout)["accepted"] is True, done.stderr
    done = client(endpoint, "--command", "resume", '{"vehicle": "hawk"}')
    assert done.returncode == 1 and json.loads(done.stdout)["reason"] == "not paused"
    done = client(endpoint, "--command", "set_prior", '{"lat_deg": 91}')
    assert done.returncode == 1 and json.loads(done.stdout)["remedy"]
    assert [type(command).__name__ for command in commands] == ["Pause", "Resume"]


# -- ROS 2 ---------------------------------------------------------------------


@pytest.fixture(scope="module")
def ros() -> Any:
    spec = importlib.util.spec_from_file_location("ros2_messages", ROOT / "docs" / "examples" / "ros2_messages.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


COVARIANCE = [[float(10 * row + column) for column in range(6)] for row in range(6)]


def a_fix(**body: Any) -> dict[str, Any]:
    """On the equator at longitude 10, level, with its nose to the north: worked by hand below."""
    half = math.sqrt(0.5)
    pose = {
        "lat_deg": 0.0, "lon_deg": 10.0, "height_amsl_m": 80.0, "height_ellipsoid_m": 100.0,
        # Forward, right, down to east, north, up: forward is north, right is east, down is minus up.
        "quaternion_enu_wxyz": (0.0, half, half, 0.0), "covariance_enu": COVARIANCE,
    }  # fmt: skip
    plain = msgspec.to_builtins(a_message())
    return {**plain, "unix_ns": 1_700_000_000_123_456_789, "body": {**pose, **body}}


def test_nav_sat_fix_by_hand(ros: Any) -> None:
    message = ros.nav_sat_fix(a_fix())
    assert message["header"] == {"stamp": {"sec": 1_700_000_000, "nanosec": 123_456_789}, "frame_id": "base_link"}
    assert (message["latitude"], message["longitude"], message["altitude"]) == (0.0, 10.0, 100.0)
    assert message["position_covariance"] == [0.0, 1.0, 2.0, 10.0, 11.0, 12.0, 20.0, 21.0, 22.0]
    assert message["position_covariance_type"] == 3
    assert math.isnan(ros.nav_sat_fix(a_fix(height_ellipsoid_m=None))["altitude"]), "not the height above the sea"
    camera = ros.nav_sat_fix({**a_fix(), "body": None})
    assert camera["header"]["frame_id"] == "camera_optical_frame"


def test_pose_by_hand(ros: Any) -> None:
    """A second of arc of longitude is 30.9226 m on the equator 100 m up, one of latitude 30.7156 m."""
    second = 1.0 / 3600.0
    message = ros.pose_with_covariance(a_fix(), (-second, 10.0 - second, 90.0))
    assert message["header"]["frame_id"] == "map"
    position = message["pose"]["pose"]["position"]
    assert position["x"] == pytest.approx(30.9226, abs=2e-3)
    assert position["y"] == pytest.approx(30.7155, abs=2e-3)
    assert position["z"] == pytest.approx(10.0, abs=1e-3)
    # base_link's x to the north: a quarter turn about up from the east.
    half = math.sqrt(0.5)
    orientation = message["pose"]["pose"]["orientation"]
    sign = math.copysign(1.0, orientation["w"])
    turned = [sign * orientation[axis] for axis in "xyzw"]
    assert turned == pytest.approx([0.0, 0.0, half, half])
    covariance = message["pose"]["covariance"]
    assert len(covariance) == 36
    assert covariance[:6] == COVARIANCE[0] and covariance[7] == COVARIANCE[1][1] and covariance[35] == COVARIANCE[5][5]
    assert ros.pose_with_covariance({**a_fix(), "body": None}, (0.0, 10.0, 0.0)) is None


def test_orientation_of_a_bank_to_the_right(ros: Any) -> None:
    """Nose to the east, right wing 30 degrees down: base_link is turned by +30 degrees about its x, which is east."""
    quarter = math.radians(15.0)
    # Level and eastward it is half a turn about east; then 30 degrees more about forward, which is the same axis.
    frd = (-math.sin(quarter), math.cos(quarter), 0.0, 0.0)
    message = ros.pose_with_covariance(a_fix(quaternion_enu_wxyz=frd), (0.0, 10.0, 0.0))
    orientation = message["pose"]["pose"]["orientation"]
    sign = math.copysign(1.0, orientation["w"])
    assert [sign * orientation[axis] for axis in "xyzw"] == pytest.approx([math.sin(quarter), 0, 0, math.cos(quarter)])


# -- how fast it is ------------------------------------------------------------


def test_bench_bus_measures(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench-bus", "--seconds", "0.3", "--rates", "50", "--commands", "5", "--json"]) == 0
    rows = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [(row["row"], row.get("encoding")) for row in rows] == [
        ("fixes", "json"), ("fixes", "msgpack"), ("commands", None),
    ]  # fmt: skip
    for row in rows[:2]:
        assert row["sent"] >= 10 and row["lost"] == 0
        assert 0.0 < row["latency_ms"]["median"] < 1000.0
    assert rows[0]["payload_bytes"] > 1.5 * rows[1]["payload_bytes"]
    assert rows[2]["unanswered"] == 0 and rows[2]["round_trip_ms"]["median"] > 0.0
