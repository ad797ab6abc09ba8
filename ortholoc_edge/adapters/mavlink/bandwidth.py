"""What the configured messages take of a serial line, each way, told before anything is sent."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from ortholoc_edge.adapters.mavlink import gimbal
from ortholoc_edge.adapters.mavlink.codec import dialect
from ortholoc_edge.adapters.mavlink.estimates import Autopilot
from ortholoc_edge.adapters.mavlink.options import Endpoint, LinkOptions
from ortholoc_edge.adapters.mavlink.streams import wanted_rates_hz
from ortholoc_edge.errors import ConfigError

# A start bit and a stop bit go with each byte (8N1).
_BITS_PER_BYTE = 10
# Of the line, what may be planned. The rest is for what comes unasked or seldom (status texts, parameters, requests
# until they are answered), and for waiting: frames that come at random times wait for twice their own length on
# average at this load, and without bound beyond it.
_MAX_LOAD = 0.8
_HEADER_AND_CHECKSUM_BYTES = 12
_SIGNATURE_BYTES = 13
# PX4's Timesync ignores longer round trips, so its clock and ours never meet; half of them is for the two computers.
_PX4_ROUND_TRIP_LIMIT_MS = 10.0
# How often an autopilot asks for our time by itself (GCS_Common.cpp; mavlink_main.cpp, onboard mode).
_TIMESYNC_ASKED_HZ = {Autopilot.ARDUPILOT: 0.1, Autopilot.PX4: 10.0}
_TIMESYNC_OWN_HZ = 1.0
_HEARTBEAT_HZ = 1.0
# Questions and requests: one per second where an answer is awaited.
_COMMAND_HZ = 1.0
_QUALITY_VALUES = 3

_LOWERED_BY = {
    "ATTITUDE_QUATERNION": "lower attitude_rate_hz",
    "LOCAL_POSITION_NED": "lower position_rate_hz",
    "ONBOARD_COMPUTER_STATUS": "lower computer_status_rate_hz",
    "NAMED_VALUE_FLOAT": "lower quality_rate_hz",
}


def frame_bytes(message: str, *, is_signed: bool) -> int:
    """Length on the wire of a message with nothing truncated, by the codec's own table."""
    payload = getattr(dialect, f"MAVLink_{message.lower()}_message").unpacker.size
    return int(payload) + _HEADER_AND_CHECKSUM_BYTES + (_SIGNATURE_BYTES if is_signed else 0)


@dataclass(frozen=True, slots=True)
class Share:
    """What one message takes. ``remedy`` is empty where no option lowers it."""

    message: str
    rate_hz: float
    frame_bytes: int
    remedy: str = ""

    @property
    def bytes_per_s(self) -> float:
        return self.rate_hz * self.frame_bytes

    def __str__(self) -> str:
        return f"{self.message} {self.rate_hz:g} Hz x {self.frame_bytes} B = {self.bytes_per_s:.0f}"


@dataclass(frozen=True, slots=True)
class LinePlan:
    """What goes each way; ``baud`` is None where the line sets no limit (UDP, TCP)."""

    endpoint: str
    baud: int | None
    to_autopilot: tuple[Share, ...]
    from_autopilot: tuple[Share, ...]
    may_be_px4: bool

    @property
    def capacity_bytes_per_s(self) -> float | None:
        return None if self.baud is None else self.baud / _BITS_PER_BYTE

    @property
    def timesync_wire_ms(self) -> float | None:
        """How long the two frames of a TIMESYNC round trip are on the wire, with nothing else in their way."""
        if self.baud is None:
            return None
        size = next(share.frame_bytes for share in self.to_autopilot if share.message == "TIMESYNC")
        return 2e3 * size * _BITS_PER_BYTE / self.baud

    def require_fit(self) -> None:
        """Raises: ConfigError with each message's share and what to lower, if a way carries more than 80 % of the
        line."""
        capacity = self.capacity_bytes_per_s
        if capacity is None:
            return
        limit = _MAX_LOAD * capacity
        ways = {"to the autopilot": self.to_autopilot, "from the autopilot": self.from_autopilot}
        for way, shares in ways.items():
            load = total_bytes_per_s(shares)
            if load > limit:
                largest = sorted(shares, key=lambda share: -share.bytes_per_s)
                listed = "; ".join(f"{share} ({share.remedy})" if share.remedy else str(share) for share in largest)
                enough = next((str(b) for b in _USUAL_BAUDS if _MAX_LOAD * b / _BITS_PER_BYTE >= load), "a network")
                raise ConfigError(
                    f"link endpoint {self.endpoint} carries {capacity:.0f} bytes/s each way, of which {limit:.0f} may "
                    f"be planned, but {way} {load:.0f} are asked for: {listed}. Raise the baud rate on both sides "
                    f"({enough} is enough), or lower what is named"
                )

    def lines(self) -> list[str]:
        """For the log at the start."""
        capacity = self.capacity_bytes_per_s
        told = []
        for way, shares in (("to", self.to_autopilot), ("from", self.from_autopilot)):
            load = total_bytes_per_s(shares)
            part = "" if capacity is None else f", {100.0 * load / capacity:.0f} % of the line"
            told.append(f"link {way} the autopilot: {load:.0f} bytes/s{part} ({'; '.join(map(str, shares))})")
        return told

    def timesync_warning(self) -> str | None:
        """Why PX4's clock will not be synchronised to ours over this line, if so."""
        wire_ms = self.timesync_wire_ms
        if wire_ms is None or not self.may_be_px4 or wire_ms <= _PX4_ROUND_TRIP_LIMIT_MS / 2.0:
            return None
        return (
            f"a TIMESYNC round trip takes {wire_ms:.1f} ms of {self.endpoint} alone, and PX4 ignores those of "
            f"{_PX4_ROUND_TRIP_LIMIT_MS:.0f} ms and more: it will hardly synchronise and take the time of arrival for "
            "that of exposure; raise the baud rate on both sides, 460800 or more"
        )


# Where each fix goes out once: more than two cores of the computers we know localize.
_MOST_FIXES_HZ = 10.0
_USUAL_BAUDS = (57600, 115200, 230400, 460800, 921600, 1500000, 3000000)


def total_bytes_per_s(shares: Iterable[Share]) -> float:
    return sum(share.bytes_per_s for share in shares)


def plan_line(options: LinkOptions, endpoint: Endpoint, *, has_gimbal: bool = False) -> LinePlan:
    """What ``options`` make of the line, if all goes at its full rate and length.

    While the autopilot is not known ("auto") it is taken for a PX4, which says more. What an autopilot sends unasked
    can't be known and is not counted.
    """
    autopilot = Autopilot.ARDUPILOT if options.autopilot == "ardupilot" else Autopilot.PX4
    is_signed = options.signing_key is not None

    def share(message: str, rate_hz: float, remedy: str = "") -> Share:
        return Share(
            message, rate_hz, frame_bytes(message, is_signed=is_signed), remedy or _LOWERED_BY.get(message, "")
        )

    # Each side asks and answers: requests of both go both ways.
    timesync = share("TIMESYNC", _TIMESYNC_OWN_HZ + _TIMESYNC_ASKED_HZ[autopilot])
    estimates_hz = options.estimate_rate_hz if options.way_of_release == "fast-forward" else _MOST_FIXES_HZ
    estimates = [
        share(name.upper(), estimates_hz, "lower estimate_rate_hz or name fewer messages in send")
        # What "auto" will choose is not known yet; ODOMETRY is the longest of them.
        for name in (("odometry",) if options.send == ("auto",) else options.send)
    ]
    own = [
        share("ONBOARD_COMPUTER_STATUS", options.computer_status_rate_hz),
        share("NAMED_VALUE_FLOAT", _QUALITY_VALUES * options.quality_rate_hz),
    ]
    return LinePlan(
        options.endpoint,
        endpoint.port if endpoint.kind == "serial" else None,
        (
            *estimates,
            share("HEARTBEAT", _HEARTBEAT_HZ),
            timesync,
            share("COMMAND_LONG", _COMMAND_HZ),
            *(one for one in own if one.rate_hz > 0),
        ),
        (
            *(share(name, rate_hz) for name, rate_hz in wanted_rates_hz(options, autopilot).items()),
            *([share("GIMBAL_DEVICE_ATTITUDE_STATUS", gimbal.RATE_HZ)] if has_gimbal else []),
            share("HEARTBEAT", _HEARTBEAT_HZ),
            timesync,
            share("COMMAND_ACK", _COMMAND_HZ),
        ),
        autopilot is Autopilot.PX4,
    )
