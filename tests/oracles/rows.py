"""Firmware x version x sink: our frames over the wire into the oracle of each."""

from __future__ import annotations

import math
import random
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega

from ortholoc_edge.adapters.mavlink.estimates import Autopilot, VisionEstimate
from ortholoc_edge.adapters.mavlink.geodesy import GeodeticOrigin, Place, ned_from_geodetic
from ortholoc_edge.adapters.mavlink.sinks import Refusal, Sending, Sink, choose_sinks, earth_model, encode
from ortholoc_edge.adapters.mavlink.state import AutopilotIdentity
from ortholoc_edge.geometry import rotation

from .ardupilot import ArduPilot
from .px4 import Px4
from .used import Dropped, Used

Version = tuple[int, int, int]
Oracle = ArduPilot | Px4

MS, S = 1_000_000, 1_000_000_000
ORIGIN = GeodeticOrigin(50.7, 7.1, 60.0)
PLACE = Place(50.7123456, 7.0891234, 181.5, 228.9)
# Boot of the autopilot, by our clock, and of us, by the calendar.
BOOT_US = 123_456_789
WALL_NS = 1_795_000_000 * S

VERSIONS: dict[Autopilot, tuple[Version | None, ...]] = {
    Autopilot.ARDUPILOT: ((4, 5, 7), (4, 6, 3), (4, 7, 0), (4, 8, 0), None),
    Autopilot.PX4: ((1, 14, 4), (1, 15, 4), (1, 16, 0), (1, 17, 0), (1, 18, 0)),
}


@dataclass(frozen=True, slots=True)
class Row:
    autopilot: Autopilot
    version: Version | None
    sink: Sink

    @property
    def vehicle(self) -> AutopilotIdentity:
        return AutopilotIdentity(1, self.autopilot, self.version)

    @property
    def firmwares(self) -> tuple[Version, ...]:
        """The versions that may be there: both kinds of reader where it does not say."""
        return (self.version,) if self.version is not None else ((4, 6, 3), (4, 8, 0))

    def oracle(self, firmware: Version, **parameters: Any) -> Oracle:
        if self.autopilot is Autopilot.PX4:
            origin = (ORIGIN.latitude_deg, ORIGIN.longitude_deg)
            return Px4(firmware, origin, **{"offset_us": -BOOT_US} | parameters)
        return ArduPilot(firmware, (round(ORIGIN.latitude_deg * 1e7), round(ORIGIN.longitude_deg * 1e7)), **parameters)

    def __str__(self) -> str:
        version = "unknown" if self.version is None else ".".join(map(str, self.version[:2]))
        return f"{self.autopilot.value} {version} {self.sink.value}"


ROWS = [Row(a, version, sink) for a, versions in VERSIONS.items() for version in versions for sink in Sink]


def estimate(
    autopilot: Autopilot,
    *,
    stamp_ns: int = 1000 * S,
    sigma_m: tuple[float, float] = (2.0, 2.0),
    turn_rad: float = 0.0,
    yaw_rad: float = 0.7,
    yaw_sigma_rad: float = 0.3,
    place: Place = PLACE,
    origin: GeodeticOrigin = ORIGIN,
    reset_counter: int = 3,
) -> VisionEstimate:
    """``sigma_m`` along the ellipse's axes, which are turned by ``turn_rad`` from north and east."""
    turn = rotation.exp([0.0, 0.0, turn_rad])
    covariance = np.zeros((6, 6))
    covariance[:3, :3] = turn @ np.diag([sigma_m[0] ** 2, sigma_m[1] ** 2, 9.0]) @ turn.T
    covariance[3:, 3:] = np.diag([0.01, 0.02, yaw_sigma_rad**2])
    position = ned_from_geodetic(
        origin, place.latitude_deg, place.longitude_deg, place.height_amsl_m, earth_model(autopilot)
    )
    attitude = rotation.from_euler(0.05, -0.1, yaw_rad)
    covariance = (covariance + covariance.T) / 2.0
    return VisionEstimate(stamp_ns, position, attitude, covariance, reset_counter, 0.8, place, origin)


def wire(message: Any, system: int = 1) -> bytes:
    return bytes(message.pack(ardupilotmega.MAVLink(None, system, 197)))


def sent(row: Row, said: VisionEstimate, now_ns: int, capture_stamps: bool | None = None) -> Any:
    """The message, or the refusal. Stamps as `Outlet` has them where the sink is alone on the link."""
    alike = row.sink.local if capture_stamps is None else capture_stamps
    return encode(row.sink, said, said.origin, Sending(row.vehicle, now_ns, WALL_NS + now_ns, alike))


def heard(row: Row, oracle: Oracle, said: VisionEstimate, latency_ns: int = 0, transport_us: int = 0) -> Used | Dropped:
    now_ns = said.stamp_ns + latency_ns
    message = sent(row, said, now_ns)
    assert not isinstance(message, Refusal), message
    return oracle.receive(wire(message), now_ns // 1000 + transport_us - BOOT_US)


def flight(
    row: Row, oracle: Oracle, *, rate_hz: float = 5.0, latency_ms: int = 150, count: int = 150
) -> Iterator[tuple[float, Used | Dropped]]:
    """(error of the capture time in ms, outcome) of a stream; transport takes 2 to 4 ms.

    The command is not a stream: it goes ahead of each message of the sink that is chosen for the firmware.
    """
    noise = random.Random(5)
    (stream,) = choose_sinks(("auto",), row.vehicle).sinks
    for n in range(count):
        stamp_ns = 1000 * S + round(n * S / rate_hz)
        said = estimate(row.autopilot, stamp_ns=stamp_ns)
        now_ns = stamp_ns + latency_ms * MS
        arrival_us = now_ns // 1000 + noise.randint(2000, 4000) - BOOT_US
        command = row.sink is Sink.EXTERNAL_POSITION_ESTIMATE
        message = sent(row, said, now_ns, capture_stamps=stream.local if command else None)
        outcome = oracle.receive(wire(message), arrival_us)
        if command:
            oracle.receive(wire(sent(replace(row, sink=stream), said, now_ns)), arrival_us + 100)
        truth_us = stamp_ns // 1000 - BOOT_US
        yield (outcome.capture_us - truth_us) / 1000 if isinstance(outcome, Used) else math.nan, outcome
