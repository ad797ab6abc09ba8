"""The bus between two processes: how long a message is under way, how many are lost, what publishing costs."""

from __future__ import annotations

import json
import logging
import multiprocessing
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing.connection import Connection
from typing import Any, Literal

import msgspec
import numpy as np
from msgspec import Struct

from ortholoc_edge.adapters.bus import Bus, BusOptions
from ortholoc_edge.adapters.messages import (
    MSGPACK,
    NAME_OF_COMMAND,
    Command,
    CommandReply,
    FixMessage,
    PoseMessage,
)
from ortholoc_edge.bench.metrics import Spread
from ortholoc_edge.errors import LinkError

logger = logging.getLogger(__name__)

_VEHICLE = "bench"
_PREFIX = f"ortholoc/{_VEHICLE}"
_PATIENCE_S = 20.0
# What was sent last may still be under way.
_SETTLE_S = 0.5


class BusFigures(Struct, frozen=True, kw_only=True):
    """One rate and encoding.

    Attributes:
        rate_hz: asked for; sent_per_s: reached.
        payload_bytes: of a message.
        sent, lost: messages.
        latency_ms: from before it is encoded to when the other process has it decoded.
        hold_ms: how long publishing held the caller.
    """

    encoding: str
    rate_hz: float
    sent_per_s: float
    payload_bytes: int
    sent: int
    lost: int
    latency_ms: Spread
    hold_ms: Spread


class CommandFigures(Struct, frozen=True, kw_only=True):
    """Commands, one after another: from asked to answered, in the process that asks."""

    count: int
    unanswered: int
    round_trip_ms: Spread


def measure(encoding: Literal["json", "msgpack"], rate_hz: float, seconds: float) -> BusFigures:
    """Publish fixes at a rate to a subscriber in another process on this computer. Raises: LinkError."""
    with _session(encoding) as (bus, listener):
        message = _a_fix()
        _until_heard(bus, listener, message)
        hold_ms: list[float] = []
        period_s = 1.0 / rate_hz
        begun = time.monotonic()
        while (due := begun + len(hold_ms) * period_s) < begun + seconds:
            time.sleep(max(0.0, due - time.monotonic()))
            before_ns = time.monotonic_ns()
            bus.publish(msgspec.structs.replace(message, stamp_ns=before_ns))
            hold_ms.append((time.monotonic_ns() - before_ns) / 1e6)
        took_s = max(seconds, time.monotonic() - begun)
        time.sleep(_SETTLE_S)
        listener.send("latencies")
        if not listener.poll(_PATIENCE_S):
            raise LinkError("the process that listens to the bus does not answer")
        latencies_ms = listener.recv()
    payload = msgspec.json.encode(message) if encoding == "json" else msgspec.msgpack.encode(message)
    return BusFigures(
        encoding=encoding,
        rate_hz=rate_hz,
        sent_per_s=len(hold_ms) / took_s,
        payload_bytes=len(payload),
        sent=len(hold_ms),
        lost=len(hold_ms) - len(latencies_ms),
        latency_ms=Spread.of(latencies_ms),
        hold_ms=Spread.of(hold_ms),
    )


def measure_commands(count: int) -> CommandFigures:
    """Commands to a process that answers at once: what the bus alone takes. Raises: LinkError."""
    with _session("json") as (bus, listener):
        bus.serve({}, _accept)
        _until_heard(bus, listener, _a_fix())
        listener.send(count)
        if not listener.poll(_PATIENCE_S + count * 0.1):
            raise LinkError("the process that asks over the bus does not answer")
        round_trips_ms = listener.recv()
    return CommandFigures(
        count=count, unanswered=count - len(round_trips_ms), round_trip_ms=Spread.of(round_trips_ms)
    )


def _accept(command: Command) -> CommandReply:
    return CommandReply(command=NAME_OF_COMMAND[type(command)], accepted=True)


@contextmanager
def _session(encoding: Literal["json", "msgpack"]) -> Iterator[tuple[Bus, Connection]]:
    with socket.create_server(("127.0.0.1", 0)) as free:
        endpoint = f"tcp/127.0.0.1:{free.getsockname()[1]}"
    bus = Bus(BusOptions(vehicle=_VEHICLE, listen=(endpoint,), encoding=encoding, commands=True))
    ours, theirs = multiprocessing.Pipe()
    # Another interpreter, as another program would be.
    listener = multiprocessing.get_context("spawn").Process(target=_listen, args=(endpoint, theirs), daemon=True)
    listener.start()
    # So that its end is seen here.
    theirs.close()
    try:
        yield bus, ours
    finally:
        ours.close()
        listener.join(timeout=5.0)
        listener.kill()
        bus.close()


def _until_heard(bus: Bus, listener: Connection, message: FixMessage) -> None:
    """Nothing is sent before the subscription has reached the publisher."""
    deadline = time.monotonic() + _PATIENCE_S
    while time.monotonic() < deadline:
        bus.publish(msgspec.structs.replace(message, stamp_ns=0))
        if listener.poll(0.05):
            listener.recv()
            return
    raise LinkError("no message arrived in the other process")


def _listen(endpoint: str, pipe: Connection) -> None:
    """The other process."""
    import zenoh

    config = zenoh.Config()
    for key, value in (
        ("mode", "client"), ("scouting/multicast/enabled", False), ("connect/endpoints", [endpoint]),
    ):  # fmt: skip
        config.insert_json5(key, json.dumps(value))
    latencies_ms: list[float] = []
    heard = threading.Event()

    def take(sample: Any) -> None:
        decode = msgspec.msgpack.decode if str(sample.encoding) == MSGPACK else msgspec.json.decode
        stamp_ns = decode(sample.payload.to_bytes(), type=FixMessage).stamp_ns
        if stamp_ns:
            # One clock for the whole computer.
            latencies_ms.append((time.monotonic_ns() - stamp_ns) / 1e6)
        else:
            heard.set()

    with zenoh.open(config) as session:
        session.declare_subscriber(f"{_PREFIX}/fix", take)
        heard.wait(_PATIENCE_S)
        pipe.send("heard")
        try:
            while True:
                order = pipe.recv()
                pipe.send(latencies_ms if order == "latencies" else _round_trips_ms(session, order))
        except (EOFError, OSError):
            return


def _round_trips_ms(session: Any, count: int) -> list[float]:
    found = []
    for _ in range(count):
        before = time.monotonic_ns()
        if any(reply.ok for reply in session.get(f"{_PREFIX}/command/pause", payload=b"{}", timeout=2.0)):
            found.append((time.monotonic_ns() - before) / 1e6)
    return found


def _a_fix() -> FixMessage:
    """With figures of as many digits as real ones have."""
    random = np.random.default_rng(0)
    covariance = random.normal(size=(6, 6)).tolist()
    w, x, y, z = random.normal(size=4).tolist()
    pose = PoseMessage(
        lat_deg=48.0 + w,
        lon_deg=11.0 + x,
        height_amsl_m=500.0 + y,
        height_ellipsoid_m=545.0 + y,
        quaternion_enu_wxyz=(w, x, y, z),
        covariance_enu=covariance,
    )
    stages = ("query_features", "map_window", "view", "map_features", "match", "pose", "gate", "structural", "total")
    return FixMessage(
        stamp_ns=0,
        unix_ns=1_800_000_000_000_000_000,
        crs="EPSG:25832",
        position_map_m=(649_000.0 + w, 5_318_000.0 + x, 512.0 + y),
        quaternion_map_from_camera_wxyz=(w, x, y, z),
        covariance=covariance,
        protection_m=(abs(x), abs(y)),
        camera=pose,
        body=pose,
        quality=0.5 + w / 10.0,
        matches=200,
        inliers=100,
        rms_px=1.0 + z / 10.0,
        adhop_accepted=None,
        stored_features=False,
        focal_px=910.0,
        focal_sigma_px=None,
        timings_ms={stage: abs(v) for stage, v in zip(stages, random.normal(size=9).tolist(), strict=True)},
    )
