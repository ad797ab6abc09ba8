"""When an audit over a running link begins, and when it is done."""

from __future__ import annotations

from typing import Any

from ortholoc_edge.adapters.mavlink.checkup import Checkup
from ortholoc_edge.adapters.mavlink.estimates import Autopilot
from ortholoc_edge.adapters.mavlink.options import LinkOptions
from ortholoc_edge.adapters.mavlink.sinks import Sink
from ortholoc_edge.adapters.mavlink.state import AutopilotIdentity

S = 1_000_000_000


class _Link:
    """What a checkup asks of a link."""

    def __init__(self) -> None:
        self.vehicle: AutopilotIdentity | None = None
        self.sinks = (Sink.ODOMETRY,)
        self.settled = False
        self.asked: list[list[str]] = []

    def read_parameters(self, names: list[str]) -> None:
        self.asked.append(names)

    def parameters(self) -> tuple[dict[str, Any], bool]:
        return {}, self.settled


def test_it_waits_for_the_version_which_decides_what_is_asked_but_not_for_ever() -> None:
    for tells_version in (True, False):
        link: Any = _Link()
        checkup = Checkup(link, LinkOptions(endpoint="udp:x:1"), lever_arm_m=None, ages=lambda: None)
        assert not checkup.step(0)
        link.vehicle = AutopilotIdentity(1, Autopilot.PX4, None)
        assert not checkup.step(1 * S) and not checkup.step(5 * S) and link.asked == []
        if tells_version:
            # From now on another message carries the estimates.
            link.vehicle = AutopilotIdentity(1, Autopilot.PX4, (1, 18, 0))
            link.sinks = (Sink.GLOBAL_POSITION_SENSOR,)
        assert not checkup.step(6 * S)
        assert len(link.asked) == 1 and ("EKF2_AGP0_ID" in link.asked[0]) == tells_version
        assert not checkup.step(7 * S)
        link.settled = True
        assert checkup.step(8 * S) and len(link.asked) == 1
