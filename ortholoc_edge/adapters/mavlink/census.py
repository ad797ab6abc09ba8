"""Who speaks on the link, in which version of MAVLink, and how often the vehicle's messages come."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import dataclass

from ortholoc_edge.adapters.mavlink.codec import MavlinkMessage, dialect
from ortholoc_edge.adapters.mavlink.estimates import Autopilot
from ortholoc_edge.adapters.mavlink.geodesy import GeodeticOrigin
from ortholoc_edge.adapters.mavlink.state import AutopilotIdentity

_S = 1_000_000_000
# Whatever invents identities must not fill the memory.
_MOST_PEERS = 64
_MOST_STREAMS = 256
_MAVLINK1_MARKER = 0xFE
_AUTOPILOT_COMPONENT = 1
_AUTOPILOTS = {
    dialect.MAV_AUTOPILOT_ARDUPILOTMEGA: Autopilot.ARDUPILOT.value,
    dialect.MAV_AUTOPILOT_PX4: Autopilot.PX4.value,
    dialect.MAV_AUTOPILOT_INVALID: None,
}


@dataclass(frozen=True, slots=True)
class Peer:
    """Somebody whose HEARTBEAT was heard.

    Attributes:
        autopilot: "ardupilot", "px4", "other", or None where it is not an autopilot.
        role: in words.
    """

    system_id: int
    component_id: int
    autopilot: str | None
    role: str


@dataclass(frozen=True, slots=True)
class LinkHealth:
    """The link as it is now.

    Attributes:
        wanted_system_id: ``[link] system_id``; 0 takes the first autopilot.
        own_id_heard: whether somebody else sends under our own system and component id (or the link echoes).
        mavlink1, mavlink2: frames of autopilots heard in each version.
        rates_hz, wanted_rates_hz: of the vehicle's messages since the census began, and of those asked for.
        round_trip_ms: of TIMESYNC, median; None without an answer.
        synchronised: whether enough answers came.
    """

    peers: tuple[Peer, ...]
    vehicle: AutopilotIdentity | None
    connected: bool
    wanted_system_id: int
    own_id_heard: bool
    mavlink1: int
    mavlink2: int
    bad_bytes: int
    rates_hz: Mapping[str, float]
    wanted_rates_hz: Mapping[str, float]
    round_trip_ms: float | None
    synchronised: bool
    origin: GeodeticOrigin | None
    set_origin: bool


class _Rate:
    """A message's rate between its first and its last arrival."""

    __slots__ = ("_count", "_first_ns", "_last_ns")

    def __init__(self, now_ns: int) -> None:
        self._first_ns = self._last_ns = now_ns
        self._count = 0

    def heard(self, now_ns: int) -> None:
        self._count += 1
        self._last_ns = now_ns

    def hz(self, now_ns: int) -> float:
        # A stream that ended long ago has no rate: its silence counts once it is longer than the way to here.
        span_ns = self._last_ns - self._first_ns
        silence_ns = now_ns - self._last_ns
        if self._count and silence_ns > max(3 * span_ns // self._count, 3 * _S):
            return 0.0
        return self._count * _S / span_ns if span_ns > 0 else 0.0


class Census:
    """Counts everything that arrives, before anything is refused."""

    def __init__(self) -> None:
        self._peers: OrderedDict[tuple[int, int], Peer] = OrderedDict()
        self._rates: dict[str, _Rate] = {}
        self.mavlink1 = 0
        self.mavlink2 = 0

    def take(self, message: MavlinkMessage) -> None:
        """Any message."""
        if message.get_srcComponent() == _AUTOPILOT_COMPONENT:
            if message.get_msgbuf()[0] == _MAVLINK1_MARKER:
                self.mavlink1 += 1
            else:
                self.mavlink2 += 1
        if message.get_type() != "HEARTBEAT":
            return
        key = message.get_srcSystem(), message.get_srcComponent()
        self._peers[key] = Peer(*key, _AUTOPILOTS.get(message.autopilot, "other"), _role(message))
        self._peers.move_to_end(key)
        if len(self._peers) > _MOST_PEERS:
            # The one that was not heard for longest, and no autopilot while there are others: a flood of invented
            # ones must not hide it.
            others = (key for key, peer in self._peers.items() if peer.autopilot in (None, "other"))
            del self._peers[next(others, next(iter(self._peers)))]

    def take_vehicles(self, name: str, now_ns: int) -> None:
        """A message of the vehicle that we serve."""
        rate = self._rates.get(name)
        if rate is not None:
            rate.heard(now_ns)
        elif len(self._rates) < _MOST_STREAMS:
            self._rates[name] = _Rate(now_ns)

    def restart(self) -> None:
        """Count rates anew."""
        self._rates.clear()

    @property
    def peers(self) -> tuple[Peer, ...]:
        return tuple(self._peers.values())

    def rates_hz(self, now_ns: int) -> dict[str, float]:
        """Of each of the vehicle's messages, rounded to 0.1; one that came once has 0."""
        return {name: round(rate.hz(now_ns), 1) for name, rate in sorted(self._rates.items())}


def _role(message: MavlinkMessage) -> str:
    kinds = {
        dialect.MAV_TYPE_GCS: "ground station",
        dialect.MAV_TYPE_ONBOARD_CONTROLLER: "companion computer",
        dialect.MAV_TYPE_GIMBAL: "gimbal",
        dialect.MAV_TYPE_CAMERA: "camera",
        dialect.MAV_TYPE_ADSB: "ADS-B receiver",
        dialect.MAV_TYPE_ANTENNA_TRACKER: "antenna tracker",
        dialect.MAV_TYPE_FIXED_WING: "plane",
        dialect.MAV_TYPE_QUADROTOR: "quadrotor",
        dialect.MAV_TYPE_HEXAROTOR: "hexarotor",
        dialect.MAV_TYPE_OCTOROTOR: "octorotor",
        dialect.MAV_TYPE_HELICOPTER: "helicopter",
        dialect.MAV_TYPE_GROUND_ROVER: "rover",
    }
    return kinds.get(message.type, f"type {message.type}")
