"""Which messages an estimate becomes, and what is told of those it does not become; no I/O, no clock."""

from __future__ import annotations

import logging
import math
from collections import Counter

from ortholoc_edge.adapters.mavlink.codec import MavlinkMessage
from ortholoc_edge.adapters.mavlink.estimates import VisionEstimate, horizontal_sigma_m
from ortholoc_edge.adapters.mavlink.geodesy import GeodeticOrigin
from ortholoc_edge.adapters.mavlink.log import LimitedLog
from ortholoc_edge.adapters.mavlink.options import LinkOptions
from ortholoc_edge.adapters.mavlink.sinks import (
    Refusal,
    Sending,
    Sink,
    choose_sinks,
    encode,
    is_known_to_read,
    limits,
)
from ortholoc_edge.adapters.mavlink.state import AutopilotIdentity

logger = logging.getLogger(__name__)


class Outlet:
    """Chooses the sinks for the autopilot at hand and encodes estimates for them.

    Counts are added to those of the owner: ``refused.KIND``, ``floored`` (a sigma below what the filter believes).
    """

    def __init__(self, options: LinkOptions, counts: Counter[str], log: LimitedLog) -> None:
        self._options = options
        self._counts = counts
        self._log = log
        self._chosen_for: AutopilotIdentity | None = None
        self._sinks: tuple[Sink, ...] = ()
        self._floor_told: set[Sink] = set()

    def sinks(self, vehicle: AutopilotIdentity) -> tuple[Sink, ...]:
        """Those that carry the estimates for an autopilot. Says so in the log when it is another one than before."""
        if vehicle != self._chosen_for:
            choice = choose_sinks(self._options.send, vehicle)
            self._chosen_for, self._sinks = vehicle, choice.sinks
            self._floor_told.clear()
            said = ", ".join(_said(sink, vehicle) for sink in choice.sinks)
            logger.info("estimates go out as %s: %s", said, choice.why)
            for doubt in choice.doubts:
                logger.warning("%s", doubt)
            if self._options.recovery and not self._recovers(vehicle):
                logger.warning("[link] recovery is on, but this autopilot knows no such command; none is sent")
        return self._sinks

    def believed(self, vehicle: AutopilotIdentity) -> tuple[float, float]:
        """The most that every chosen sink believes of a sigma of position, m, and of yaw, rad."""
        bounds = [limits(sink, vehicle.autopilot, vehicle.release) for sink in self.sinks(vehicle)]
        return (
            min((bound.most_sigma_m for bound in bounds), default=math.inf),
            min((bound.most_yaw_sigma_rad for bound in bounds), default=math.inf),
        )

    def encode(
        self,
        estimate: VisionEstimate,
        vehicle: AutopilotIdentity,
        origin: GeodeticOrigin | None,
        now_ns: int,
        wall_ns: int,
        recovery: bool,
    ) -> list[MavlinkMessage]:
        """The messages for an estimate, in the order to send them.

        Args:
            origin: the autopilot's EKF origin, None while it has none.
            wall_ns: UNIX time, for GPS_INPUT.
            recovery: whether this is the first estimate after an outage. If that may be told, it goes first: a filter
                that has fused the estimate already does not take the command.
        """
        sinks = self.sinks(vehicle)
        # A stream that counts from the capture makes the command do so, too.
        capture_stamps = any(sink.local for sink in sinks)
        options = self._options
        sending = Sending(vehicle, now_ns, wall_ns, capture_stamps, options.sensor_id, options.gps_id)
        if recovery and options.recovery and self._recovers(vehicle):
            sinks = (Sink.EXTERNAL_POSITION_ESTIMATE, *sinks)
        messages = []
        for sink in sinks:
            encoded = encode(sink, estimate, origin, sending)
            if isinstance(encoded, Refusal):
                self._counts[f"refused.{encoded.kind}"] += 1
                self._log(
                    now_ns, logging.WARNING, f"refused.{encoded.kind}", f"{sink.value.upper()} not sent: {encoded.why}"
                )
                continue
            self._tell_floor(sink, estimate, vehicle)
            messages.append(encoded)
        return messages

    @staticmethod
    def _recovers(vehicle: AutopilotIdentity) -> bool:
        return is_known_to_read(Sink.EXTERNAL_POSITION_ESTIMATE, vehicle.autopilot, vehicle.release)

    def _tell_floor(self, sink: Sink, estimate: VisionEstimate, vehicle: AutopilotIdentity) -> None:
        bounds = limits(sink, vehicle.autopilot, vehicle.release)
        sigma_m = horizontal_sigma_m(estimate)
        if sigma_m >= bounds.least_sigma_m:
            return
        self._counts["floored"] += 1
        if sink not in self._floor_told:
            self._floor_told.add(sink)
            logger.info(
                "%s: a position sigma of %.2f m counts as %g m there, by %s if that is at its default",
                sink.value.upper(), sigma_m, bounds.least_sigma_m, bounds.least_by,
            )  # fmt: skip


def _said(sink: Sink, vehicle: AutopilotIdentity) -> str:
    bounds = limits(sink, vehicle.autopilot, vehicle.release)
    rates = []
    if bounds.least_rate_hz:
        rates.append(f"wanted at {bounds.least_rate_hz:g} Hz or more")
    if bounds.most_rate_hz < math.inf:
        rates.append(f"more than {bounds.most_rate_hz:g} Hz is discarded")
    return sink.value.upper() + (f" ({', '.join(rates)})" if rates else "")
