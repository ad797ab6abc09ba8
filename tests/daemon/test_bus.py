"""Outcomes over real zenoh sessions on loopback."""

from __future__ import annotations

import json
import queue
import socket
from collections.abc import Iterator
from typing import Any

import msgspec
import numpy as np
import pytest
import zenoh

from ortholoc_edge.adapters.bus import AutopilotRecord, Bus, BusOptions
from ortholoc_edge.errors import ConfigError, LinkError
from ortholoc_edge.geometry.camera import Camera
from ortholoc_edge.geometry.rigid import Rigid3
from ortholoc_edge.pipeline.outcome import Fix, Reason, Rejected


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as server:
        return int(server.getsockname()[1])


def a_fix(stamp_ns: int) -> Fix:
    return Fix(
        stamp_ns=stamp_ns,
        map_from_camera=Rigid3(np.diag([1.0, -1.0, -1.0]), np.array([647000.25, 5407300.5, 512.125])),
        camera=Camera.from_focal(480, 360, 405.0),
        covariance=np.eye(6) * 0.25,
        quality=0.5,
        matches=200,
        inliers=100,
        rms_px=1.5,
        adhop_accepted=True,
        query_px=np.zeros((100, 2)),
        points_map=np.zeros((100, 3)),
    )


@pytest.fixture
def endpoint() -> str:
    return f"tcp/127.0.0.1:{free_port()}"


@pytest.fixture
def bus(endpoint: str) -> Iterator[Bus]:
    opened = Bus(BusOptions(enabled=True, vehicle="hawk", listen=(endpoint,)))
    yield opened
    opened.close()


@pytest.fixture
def listener(bus: Bus, endpoint: str) -> Iterator[Any]:
    """Another session, connected to the bus."""
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("connect/endpoints", json.dumps([endpoint]))
    session = zenoh.open(config)
    yield session
    session.close()


def test_fix_and_rejection_arrive(bus: Bus, listener: Any) -> None:
    got: queue.Queue[tuple[str, dict[str, Any], str]] = queue.Queue()
    subscriber = listener.declare_subscriber(
        "ortholoc/hawk/*",
        lambda sample: got.put((str(sample.key_expr), json.loads(sample.payload.to_bytes()), str(sample.encoding))),
    )
    # Until the declaration has reached the publisher, nothing is sent: repeat, as frames do.
    for stamp_ns in range(1, 200):
        bus.publish(a_fix(stamp_ns))
        try:
            key, record, encoding = got.get(timeout=0.1)
            break
        except queue.Empty:
            continue
    else:
        raise AssertionError("no fix arrived")
    assert key == "ortholoc/hawk/fix"
    assert encoding == "application/json"
    assert record["fix"] is True
    assert record["position_map_m"] == [647000.25, 5407300.5, 512.125]
    assert np.shape(record["covariance"]) == (6, 6)
    assert record["adhop_accepted"] is True
    bus.publish(Rejected(10**9, Reason.MAP_NODATA, "nothing there", 0.0, 1.0))
    while record["fix"]:
        key, record, _ = got.get(timeout=10.0)
    assert key == "ortholoc/hawk/rejection"
    assert record["stamp_ns"] == 10**9
    assert (record["reason"], record["detail"]) == ("map_nodata", "nothing there")
    assert (record["measured"], record["limit"]) == (0.0, 1.0)
    subscriber.undeclare()


def test_what_became_of_the_fixes_arrives(bus: Bus, listener: Any) -> None:
    got: queue.Queue[dict[str, Any]] = queue.Queue()
    subscriber = listener.declare_subscriber(
        "ortholoc/hawk/autopilot", lambda sample: got.put(json.loads(sample.payload.to_bytes()))
    )
    record = AutopilotRecord(
        stamp_ns=5, connected=True, fusion="ignored", fusion_since_s=2.5, fusion_reason="why", gnss="bad",
        gnss_since_s=None, gnss_apart_m=12.0, gnss_height_apart_m=None, latency_median_ms=300.0, latency_p99_ms=450.0,
        delay_advice="VISO_DELAY_MS = 4", on_vision=False,
    )  # fmt: skip
    for _ in range(200):
        bus.publish_autopilot(record)
        try:
            assert got.get(timeout=0.1) == msgspec.to_builtins(record)
            break
        except queue.Empty:
            continue
    else:
        raise AssertionError("nothing arrived")
    subscriber.undeclare()


def test_liveliness_token_comes_and_goes(bus: Bus, listener: Any) -> None:
    got: queue.Queue[tuple[str, bool]] = queue.Queue()
    subscriber = listener.liveliness().declare_subscriber(
        "ortholoc/*/alive",
        lambda sample: got.put((str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT)),
        history=True,
    )
    assert got.get(timeout=10.0) == ("ortholoc/hawk/alive", True)
    bus.close()
    assert got.get(timeout=10.0) == ("ortholoc/hawk/alive", False)
    subscriber.undeclare()


def test_publishing_after_the_session_ended_does_not_raise(bus: Bus) -> None:
    bus.close()
    bus.publish(Rejected(1, Reason.LATE))


def test_endpoint_that_is_taken_is_named(bus: Bus, endpoint: str) -> None:
    with pytest.raises(LinkError, match=r"127\.0\.0\.1.*\[bus\]"):
        Bus(BusOptions(enabled=True, listen=(endpoint,)))


def test_listen_that_is_no_endpoint() -> None:
    with pytest.raises(ConfigError, match=r"nonsense.*\[bus\]"):
        Bus(BusOptions(enabled=True, listen=("nonsense",)))


@pytest.mark.parametrize("vehicle", ["", "a/b", "*", "a b", "$*", "a?"])
def test_vehicle_is_one_plain_word(vehicle: str) -> None:
    with pytest.raises(msgspec.ValidationError, match=r"\$\.vehicle"):
        msgspec.convert({"vehicle": vehicle}, BusOptions)
