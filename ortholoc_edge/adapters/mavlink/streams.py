"""What is said again and again: requests for streams, and questions until they are answered."""

from __future__ import annotations

from ortholoc_edge.adapters.mavlink.estimates import Autopilot
from ortholoc_edge.adapters.mavlink.options import LinkOptions

_S = 1_000_000_000


def wanted_rates_hz(options: LinkOptions, autopilot: Autopilot) -> dict[str, float]:
    """Which messages an autopilot is asked to send, by name."""
    return {
        "ATTITUDE_QUATERNION": options.attitude_rate_hz,
        "LOCAL_POSITION_NED": options.position_rate_hz,
        "GPS_RAW_INT": 2.0,
        "SYSTEM_TIME": 1.0,
        "EXTENDED_SYS_STATE": 1.0,
        "EKF_STATUS_REPORT" if autopilot is Autopilot.ARDUPILOT else "ESTIMATOR_STATUS": 2.0,
    }


class Stream:
    """One message that the autopilot is asked to send, and whether it does."""

    _CHECK_NS = 5 * _S

    def __init__(self, message_id: int, rate_hz: float) -> None:
        self.message_id, self.interval_ns = message_id, int(_S / rate_hz)
        self._patience_ns = max(3 * self.interval_ns, 1 * _S)
        self.restart()

    def restart(self) -> None:
        self._asked_ns: int | None = None
        self._heard_ns: int | None = None
        self._attempts = 0
        self._count = 0
        self._count_since_ns = 0

    @property
    def attempts(self) -> int:
        """How often in a row it was asked for again in vain."""
        return self._attempts

    def heard(self, now_ns: int) -> None:
        self._heard_ns = now_ns
        self._count += 1

    def due(self, now_ns: int) -> bool:
        """Whether to ask (again): at first, when it stopped, or when it comes at less than half the rate."""
        if self._asked_ns is None:
            return self._ask(now_ns)
        if now_ns - self._asked_ns < min(10 * _S, (2 * _S) << min(self._attempts, 3)):
            return False
        if self._heard_ns is None or now_ns - self._heard_ns > self._patience_ns:
            self._attempts += 1
            return self._ask(now_ns)
        elapsed = now_ns - self._count_since_ns
        if elapsed < self._CHECK_NS:
            return False
        slow = self._count < 0.5 * elapsed / self.interval_ns
        self._attempts = self._attempts + 1 if slow else 0
        self._count, self._count_since_ns = 0, now_ns
        return self._ask(now_ns) if slow else False

    def _ask(self, now_ns: int) -> bool:
        self._asked_ns = self._count_since_ns = now_ns
        self._count = 0
        return True


class Repeat:
    """When to say something again: at a fixed pace, or ever more slowly."""

    def __init__(self, first_ns: int, last_ns: int | None = None) -> None:
        self._first_ns, self._last_ns = first_ns, last_ns or first_ns
        self.restart()

    def restart(self) -> None:
        self._interval_ns, self._next_ns = self._first_ns, 0

    def due(self, now_ns: int) -> bool:
        if now_ns < self._next_ns:
            return False
        self._next_ns = now_ns + self._interval_ns
        self._interval_ns = min(2 * self._interval_ns, self._last_ns)
        return True
