"""Outcomes on zenoh: ``ortholoc/<vehicle>/fix`` and ``…/rejection`` as JSON, ``…/autopilot`` about what became of the
fixes there, and a liveliness token ``…/alive``."""

from __future__ import annotations

import json
import logging
import re
from typing import TYPE_CHECKING, Annotated

import msgspec
from msgspec import Meta, Struct

from ortholoc_edge.errors import ConfigError, LinkError
from ortholoc_edge.pipeline.outcome import Fix, Outcome
from ortholoc_edge.pipeline.record import outcome_record

if TYPE_CHECKING:
    import zenoh  # 4 MB, so where the bus is off it is not imported

logger = logging.getLogger(__name__)

_PORT_PROTOCOLS = frozenset({"tcp", "udp", "tls", "quic", "ws"})
_OTHER_PROTOCOLS = frozenset({"serial", "unixsock-stream", "unixpipe", "vsock"})
_MAX_PORT = 65535


class BusOptions(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The ``[bus]`` table.

    Attributes:
        vehicle: the middle of the keys.
        listen: zenoh endpoints; loopback unless told otherwise. Multicast scouting stays off: it would tell
            every drone on the field's network of this one.
    """

    enabled: bool = False
    # No wildcards: zenoh would publish to every vehicle's key.
    vehicle: Annotated[str, Meta(pattern="^[A-Za-z0-9_.-]+$")] = "vehicle"
    listen: tuple[str, ...] = ("tcp/127.0.0.1:7447",)


class AutopilotRecord(Struct, frozen=True, kw_only=True):
    """What ``…/autopilot`` holds.

    Attributes:
        stamp_ns: now, monotonic clock. connected: whether its heart beats.
        fusion: "fused", "ignored", "rejected" or "unknown": what its filter does with the fixes. fusion_since_s: for
            how long; None if never otherwise. fusion_reason: probably why.
        gnss: "ok", "suspect", "bad" or "unknown": whether GNSS agrees with the fixes. gnss_since_s: for how long.
            gnss_apart_m: horizontal, at the last fix. gnss_height_apart_m: where heights differ by a constant that
            looks like a datum's, by how much GNSS is higher.
        latency_median_ms, latency_p99_ms: from mid-exposure to sent. delay_advice: parameters to set, for people.
        on_vision: whether we commanded the source set of vision.
    """

    stamp_ns: int
    connected: bool
    fusion: str
    fusion_since_s: float | None
    fusion_reason: str
    gnss: str
    gnss_since_s: float | None
    gnss_apart_m: float | None
    gnss_height_apart_m: float | None
    latency_median_ms: float | None
    latency_p99_ms: float | None
    delay_advice: str | None
    on_vision: bool


class Bus:
    """A zenoh session that publishes; never blocks the caller for a slow subscriber.

    Attributes:
        dropped: outcomes that could not be published.
    Raises on construction: ConfigError if an endpoint is malformed; LinkError if the session can't be opened, which
        may pass (a port still in use, an interface that is not up yet).
    """

    def __init__(self, options: BusOptions) -> None:
        import zenoh

        self.dropped = 0
        self._error = zenoh.ZError
        self._prefix = f"ortholoc/{options.vehicle}"
        config = _session_config(options)
        try:
            self._session = zenoh.open(config)
        except zenoh.ZError as err:
            raise self._not_open(options, err) from err
        try:
            self._token = self._session.liveliness().declare_token(f"{self._prefix}/alive")
            self._publishers = {
                name: self._session.declare_publisher(
                    f"{self._prefix}/{name}",
                    encoding=zenoh.Encoding.APPLICATION_JSON,
                    congestion_control=zenoh.CongestionControl.DROP,
                )
                for name in ("fix", "rejection", "autopilot")
            }
        except zenoh.ZError as err:
            self.close()
            raise self._not_open(options, err) from err

    def _not_open(self, options: BusOptions, err: zenoh.ZError) -> LinkError:
        return LinkError(
            f"zenoh can't listen on {', '.join(options.listen)} as {self._prefix!r} ({err}); free the port, or choose "
            "another in [bus] of the configuration"
        )

    def publish(self, outcome: Outcome) -> None:
        """Send an outcome to whoever listens. A failure is counted and logged, never raised: the flight goes on."""
        self._put("fix" if isinstance(outcome, Fix) else "rejection", outcome_record(outcome))

    def publish_autopilot(self, record: AutopilotRecord) -> None:
        """The same for what is known of the autopilot's use of the fixes."""
        self._put("autopilot", record)

    def _put(self, name: str, record: object) -> None:
        try:
            self._publishers[name].put(msgspec.json.encode(record))
        except self._error:
            self.dropped += 1
            logger.warning("zenoh: %s not published", name, exc_info=True)

    def close(self) -> None:
        self._session.close()  # type: ignore[no-untyped-call]


def _session_config(options: BusOptions) -> zenoh.Config:
    """Raises: ConfigError naming the endpoint that is malformed."""
    import zenoh

    for endpoint in options.listen:
        if not _well_formed(endpoint):
            raise ConfigError(
                f"zenoh endpoint {endpoint!r} can't be used; write tcp/HOST:PORT or udp/HOST:PORT in [bus] of the "
                "configuration"
            )
    config = zenoh.Config()
    try:
        config.insert_json5("mode", '"peer"')
        config.insert_json5("scouting/multicast/enabled", "false")
        config.insert_json5("listen/endpoints", json.dumps(list(options.listen)))
    except zenoh.ZError as err:
        raise ConfigError(
            f"zenoh refuses to listen on {', '.join(options.listen)} ({err}); see [bus] in the configuration"
        ) from err
    return config


def _well_formed(endpoint: str) -> bool:
    """Checked here since zenoh tells of a bad port or protocol only as it tells of a port in use."""
    protocol, _, address = endpoint.partition("/")
    if protocol in _OTHER_PROTOCOLS:
        return bool(address)
    match = re.fullmatch(r"[^?#]+:(\d{1,5})([?#].*)?", address)
    return protocol in _PORT_PROTOCOLS and match is not None and int(match[1]) <= _MAX_PORT
