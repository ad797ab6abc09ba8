"""Outcomes on zenoh: ``ortholoc/<vehicle>/fix`` and ``…/rejection`` as JSON, and a liveliness token ``…/alive``."""

from __future__ import annotations

import json
import logging
from typing import Annotated

import msgspec
import zenoh
from msgspec import Meta, Struct

from ortholoc_edge.errors import ConfigError
from ortholoc_edge.pipeline.outcome import Fix, Outcome
from ortholoc_edge.pipeline.record import outcome_record

logger = logging.getLogger(__name__)


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


class Bus:
    """A zenoh session that publishes; never blocks the caller for a slow subscriber.

    Raises on construction: ConfigError if the session can't be opened with these options.
    """

    def __init__(self, options: BusOptions) -> None:
        config = zenoh.Config()
        prefix = f"ortholoc/{options.vehicle}"
        try:
            config.insert_json5("mode", '"peer"')
            config.insert_json5("scouting/multicast/enabled", "false")
            config.insert_json5("listen/endpoints", json.dumps(list(options.listen)))
            self._session = zenoh.open(config)
            self._token = self._session.liveliness().declare_token(f"{prefix}/alive")
            self._publishers = {
                name: self._session.declare_publisher(
                    f"{prefix}/{name}",
                    encoding=zenoh.Encoding.APPLICATION_JSON,
                    congestion_control=zenoh.CongestionControl.DROP,
                )
                for name in ("fix", "rejection")
            }
        except zenoh.ZError as err:
            raise ConfigError(
                f"zenoh can't listen on {', '.join(options.listen)} as {prefix!r} ({err}); see [bus] in the "
                "configuration"
            ) from err

    def publish(self, outcome: Outcome) -> None:
        """Send an outcome to whoever listens. A failure is logged, never raised: the flight goes on."""
        name = "fix" if isinstance(outcome, Fix) else "rejection"
        try:
            self._publishers[name].put(msgspec.json.encode(outcome_record(outcome)))
        except zenoh.ZError:
            logger.warning("zenoh: %s not published", name, exc_info=True)

    def close(self) -> None:
        self._session.close()  # type: ignore[no-untyped-call]
