"""Our side: a link that says everything that it has to say, each time the same."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import numpy as np
from adapters.fake_autopilot import FakeAutopilot, UdpWire
from adapters.test_mavlink import good_state

from ortholoc_edge.adapters.computer import ComputerStatus
from ortholoc_edge.adapters.mavlink import AutopilotLink, LinkOptions, Severity, SystemStatus
from ortholoc_edge.adapters.mavlink.estimates import VisionEstimate
from ortholoc_edge.adapters.mavlink.geodesy import Place
from ortholoc_edge.clock import SystemClock
from ortholoc_edge.geometry import rotation

VEHICLE, OURS = 7, 197
# Floats of 32 bits hold these exactly.
POSITION_M = (12.5, -3.25, -40.0)
ATTITUDE = rotation.from_euler(0.02, -0.04, 1.2)
COVARIANCE = np.diag([0.8**2, 0.8**2, 1.2**2, 0.01**2, 0.01**2, 0.03**2])
PLACE = Place(50.1, 7.2, 120.0, 167.5)
# More than the 50 characters of one STATUSTEXT.
TEXT = "vision: the filter ignores our fixes since 12 s: no source set names ExternalNav"
COMPUTER = ComputerStatus((25.0, 75.0), 1234, 4096, (51.0,), False, True, False)


def link_to(endpoint: str, **options: Any) -> AutopilotLink:
    """Each fix goes out once and as it is ("raw"), so that what a peer gets can be compared to the digit."""
    return AutopilotLink(
        LinkOptions(
            endpoint=endpoint,
            system_id=VEHICLE,
            release="raw",
            computer_status_rate_hz=1.0,
            quality_rate_hz=1.0,
            **options,
        ),
        SystemClock(),
    )


@contextmanager
def flown(port: int, autopilot: int, version: tuple[int, int, int]) -> Iterator[FakeAutopilot]:
    """A vehicle that speaks to a port of this machine."""
    fake = FakeAutopilot(UdpWire(("127.0.0.1", port)), autopilot, VEHICLE, version)
    try:
        yield fake
    finally:
        fake.close()


def is_served(link: AutopilotLink, fake: FakeAutopilot) -> bool:
    """Whether each has what it needs of the other: discovery, streams, time both ways."""
    vehicle = link.vehicle
    return (
        vehicle is not None
        and vehicle.firmware_version == fake.version
        and good_state(link) is not None
        and len(fake.timesync_answers) > 3
    )


def say(link: AutopilotLink) -> None:
    """One fix of 40 ms ago, and what is said of us."""
    link.send_estimate(
        VisionEstimate(time.monotonic_ns() - 40_000_000, np.array(POSITION_M), ATTITUDE, COVARIANCE, 7, 0.8, PLACE)
    )
    link.report_computer(COMPUTER)
    link.set_system_status(SystemStatus.ACTIVE)


def say_text(link: AutopilotLink) -> None:
    link.send_status_text(Severity.WARNING, TEXT)


def texts(messages: list[Any]) -> list[str]:
    """Whole ones, of their parts in the order of arrival; id 0 says that a part is the whole."""
    parts: dict[tuple[int, int, int], list[str]] = {}
    whole = []
    for m in messages:
        if m.get_type() == "STATUSTEXT" and m.id == 0:
            whole.append(m.text)
        elif m.get_type() == "STATUSTEXT":
            parts.setdefault((m.get_srcSystem(), m.get_srcComponent(), m.id), []).append(m.text)
    return [*whole, *("".join(some) for some in parts.values())]


def of(fake: FakeAutopilot, name: str) -> list[Any]:
    """What the autopilot got of us."""
    return [m for m in list(fake.got) if m.get_type() == name and m.get_srcComponent() == OURS]


def assert_same_fields(fields: Mapping[str, Any], message: Any) -> None:
    """A peer's JSON of a message is what the autopilot got; JSON has null for NaN."""

    def same(peer: Any, ours: Any) -> bool:
        if isinstance(ours, (list, tuple)):
            return len(peer) == len(ours) and all(same(a, b) for a, b in zip(peer, ours, strict=True))
        if isinstance(ours, float) and math.isnan(ours):
            return peer is None
        return bool(peer == ours)

    expected = message.to_dict()
    del expected["mavpackettype"]
    different = {name: (fields[name], value) for name, value in expected.items() if not same(fields[name], value)}
    assert not different, f"{message.get_type()}: (peer, autopilot) {different}"
    assert set(fields) - set(expected) == {"message_id", "message_name"}
