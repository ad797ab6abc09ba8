"""The link's configuration, and the names that MAVLink has for what a component says of itself."""

from __future__ import annotations

import re
from dataclasses import dataclass
from enum import IntEnum
from typing import Annotated, Literal

import msgspec

from ortholoc_edge.errors import ConfigError


class SystemStatus(IntEnum):
    """What our HEARTBEAT says of us (MAV_STATE)."""

    BOOT = 1
    STANDBY = 3
    ACTIVE = 4


class Severity(IntEnum):
    """MAV_SEVERITY, for :meth:`AutopilotLink.send_status_text`."""

    CRITICAL = 2
    ERROR = 3
    WARNING = 4
    NOTICE = 5
    INFO = 6


class LinkOptions(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The ``[link]`` table.

    Attributes:
        endpoint: ``udp:HOST:PORT`` listens there, ``udpout:HOST:PORT`` and ``tcp:HOST:PORT`` connect,
            ``serial:/dev/ttyX:BAUD``. Below 460800 baud there is little room for ODOMETRY and time
            synchronisation is poor.
        system_id: ours and the vehicle's (a component shares the system id of its vehicle); 0 adopts that of
            the first autopilot heard, for the life of the process: an autopilot with another id, exchanged on the
            bench, is served after a restart.
        component_id: 197 is MAV_COMP_ID_VISUAL_INERTIAL_ODOMETRY.
        send: which messages carry an estimate; "auto" alone takes the best that the autopilot's firmware reads.
        sensor_id: ours in GLOBAL_POSITION_SENSOR; PX4 wants it in EKF2_AGPn_ID.
        gps_id: the receiver that we pretend to be in GPS_INPUT: 0 is ArduPilot's GPS1_TYPE, 1 its GPS2_TYPE, which must
            be 14. Another instance drops the message silently.
        recovery: whether the first fix after an outage also goes as MAV_CMD_EXTERNAL_POSITION_ESTIMATE, by which a
            filter that dead reckons sets its position to ours at once.
        autopilot: overrides what the heartbeat says. A derivative with a MAV_AUTOPILOT of its own is served only with
            it.
        attitude_rate_hz, position_rate_hz: of ATTITUDE_QUATERNION and LOCAL_POSITION_NED, asked of the
            autopilot.
        set_origin: whether `AutopilotLink.offer_origin` may set the EKF origin of an autopilot that has none.
        release: how fixes go out (`release`): carried on to the moment of sending, several times each; each once at
            the same age; or each once as soon as it is there.
        estimate_rate_hz: of "fast-forward", which with 0 is "raw". A serial line must have room for it (`bandwidth`).
            max_repeat_s: how long it goes on without a new fix.
        fixed_latency_ms: the age of "fixed-latency".
        switch_sources: whether we may tell ArduPilot to take another source set (MAV_CMD_SET_EKF_SOURCE_SET) when
            GNSS contradicts vision, and back. vision_source_set, gnss_source_set: n of EK3_SRCn_*. Only where ``send``
            has a message for ExternalNav: to a source set all GPS instances are one source.
        computer_status_rate_hz: of ONBOARD_COMPUTER_STATUS; 0 sends none.
        quality_rate_hz: of the three NAMED_VALUE_FLOAT about the last estimate; 0 sends none.
        signing_key: path of MAVLink 2's signing key, or the name of a systemd credential; None signs nothing and
            checks nothing.
        signing_link_id: the link's number in our signatures.
        signing_state: the file where signing's stamps are kept across restarts; None takes systemd's state folder.
        accept_positions: whether a MAV_CMD_EXTERNAL_POSITION_ESTIMATE addressed to us steers the search, as `set_prior`
            on the bus. Without signing whoever reaches the link may send it.
        require_signed: refuse what is not signed, but for RADIO_STATUS. What is signed by another key is refused
            anyway.
    """

    endpoint: str
    system_id: Annotated[int, msgspec.Meta(ge=0, le=255)] = 0
    component_id: Annotated[int, msgspec.Meta(ge=1, le=255)] = 197
    send: tuple[
        Literal["auto", "odometry", "vision_position_estimate", "global_position_sensor", "gps_input"], ...
    ] = ("auto",)
    sensor_id: Annotated[int, msgspec.Meta(ge=1, le=255)] = 1
    gps_id: Annotated[int, msgspec.Meta(ge=0, le=1)] = 1
    recovery: bool = False
    autopilot: Literal["auto", "ardupilot", "px4"] = "auto"
    attitude_rate_hz: Annotated[float, msgspec.Meta(ge=1, le=400)] = 50.0
    position_rate_hz: Annotated[float, msgspec.Meta(ge=1, le=100)] = 20.0
    set_origin: bool = False
    release: Literal["fast-forward", "fixed-latency", "raw"] = "fast-forward"
    estimate_rate_hz: Annotated[float, msgspec.Meta(ge=0, le=50)] = 10.0
    max_repeat_s: Annotated[float, msgspec.Meta(gt=0, le=5)] = 1.0
    fixed_latency_ms: Annotated[float, msgspec.Meta(gt=0, le=1000)] = 250.0
    switch_sources: bool = False
    vision_source_set: Annotated[int, msgspec.Meta(ge=1, le=3)] = 2
    gnss_source_set: Annotated[int, msgspec.Meta(ge=1, le=3)] = 1
    computer_status_rate_hz: Annotated[float, msgspec.Meta(ge=0, le=1)] = 0.2
    quality_rate_hz: Annotated[float, msgspec.Meta(ge=0, le=1)] = 0.5
    signing_key: Annotated[str, msgspec.Meta(min_length=1)] | None = None
    signing_link_id: Annotated[int, msgspec.Meta(ge=0, le=255)] = 0
    signing_state: Annotated[str, msgspec.Meta(min_length=1)] | None = None
    require_signed: bool = False
    accept_positions: bool = False

    @property
    def way_of_release(self) -> Literal["fast-forward", "fixed-latency", "raw"]:
        """What ``release`` and ``estimate_rate_hz`` come to."""
        return "raw" if self.release == "fast-forward" and self.estimate_rate_hz == 0.0 else self.release

    def __post_init__(self) -> None:
        if self.switch_sources and self.vision_source_set == self.gnss_source_set:
            raise ValueError(
                f"vision_source_set and gnss_source_set are both {self.vision_source_set}; switch_sources needs two"
            )
        if self.switch_sources and set(self.send).isdisjoint(("auto", "odometry", "vision_position_estimate")):
            raise ValueError(
                f"switch_sources commands a source set of ExternalNav, which send = {list(self.send)} does not feed; "
                "add odometry to send, or set switch_sources to false"
            )
        if "auto" in self.send and len(self.send) > 1:
            raise ValueError(f"send = {list(self.send)} mixes auto with names; write either [\"auto\"] or the names")
        if len(set(self.send)) < len(self.send):
            raise ValueError(f"send = {list(self.send)} names a message twice")


@dataclass(frozen=True, slots=True)
class Endpoint:
    """Where the link goes. ``port`` is the baud rate of a serial line."""

    kind: Literal["udp", "udpout", "tcp", "serial"]
    address: str
    port: int


def _is_host(text: str) -> bool:
    """Whether the socket module would take it for a name to look up: it raises UnicodeError for others."""
    try:
        text.strip("[]").encode("idna")
    except UnicodeError:
        return False
    return not any(c.isspace() or c == "\0" for c in text)


def parse_endpoint(text: str) -> Endpoint:
    """Read ``LinkOptions.endpoint``. Raises: ConfigError that names the text and what is accepted."""
    match = re.fullmatch(r"(udp|udpout|tcp|serial):(.+):(\d{1,8})", text)
    number = int(match[3]) if match else 0
    network = match is not None and match[1] != "serial"
    if match is None or number == 0 or (network and (number > 65535 or not _is_host(match[2]))):
        raise ConfigError(
            f"link endpoint {text!r} can't be used; write udp:HOST:PORT (listen), udpout:HOST:PORT, "
            "tcp:HOST:PORT or serial:/dev/ttyX:BAUD"
        )
    kinds: dict[str, Literal["udp", "udpout", "tcp", "serial"]] = {
        "udp": "udp",
        "udpout": "udpout",
        "tcp": "tcp",
        "serial": "serial",
    }
    return Endpoint(kinds[match[1]], match[2], number)
