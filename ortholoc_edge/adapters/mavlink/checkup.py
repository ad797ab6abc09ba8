"""An audit over a running link: reads the parameters that the rules want, then applies them."""

from __future__ import annotations

from collections.abc import Callable

from ortholoc_edge.adapters.mavlink.audit import Finding, Situation, audit, parameters_wanted
from ortholoc_edge.adapters.mavlink.latency import Ages
from ortholoc_edge.adapters.mavlink.link import AutopilotLink
from ortholoc_edge.adapters.mavlink.options import LinkOptions, parse_endpoint
from ortholoc_edge.adapters.mavlink.state import AutopilotIdentity

_S = 1_000_000_000
# A firmware that does not tell its version in this time is audited without.
_VERSION_PATIENCE_NS = 5 * _S


class Checkup:
    """Call :meth:`step` now and then until it says that the parameters are known; then :meth:`findings`."""

    def __init__(
        self,
        link: AutopilotLink,
        options: LinkOptions,
        *,
        lever_arm_m: tuple[float, float, float] | None,
        ages: Callable[[], Ages | None],
    ) -> None:
        """
        Args:
            lever_arm_m: as of :class:`Situation`.
            ages: tells how old estimates are when they arrive, as soon as that is known.
        """
        self._link, self._options = link, options
        self._lever_arm_m, self._ages = lever_arm_m, ages
        endpoint = parse_endpoint(options.endpoint)
        self._baud = endpoint.port if endpoint.kind == "serial" else None
        self._found_ns: int | None = None
        self._asked_of: AutopilotIdentity | None = None

    def step(self, now_ns: int) -> bool:
        """Go on; True once every parameter was answered or given up."""
        vehicle = self._link.vehicle
        if vehicle is None:
            return False
        if self._found_ns is None:
            self._found_ns = now_ns
        if self._asked_of is None:
            if vehicle.firmware_version is None and now_ns - self._found_ns < _VERSION_PATIENCE_NS:
                return False
            self.read()
            return False
        return self._link.parameters()[1]

    def read(self) -> None:
        """Ask for the parameters, anew if they were asked for before."""
        self._asked_of = vehicle = self._link.vehicle
        if vehicle is not None:
            self._link.read_parameters(parameters_wanted(vehicle.autopilot, self._sinks()))

    def situation(self) -> Situation:
        """As it is now."""
        vehicle = self._link.vehicle
        return Situation(
            autopilot=None if vehicle is None else vehicle.autopilot,
            firmware=None if vehicle is None else vehicle.firmware_version,
            sinks=self._sinks(),
            health=self._link.health(),
            readings=self._link.parameters()[0],
            lever_arm_m=self._lever_arm_m,
            ages=self._ages(),
            baud=self._baud,
            sensor_id=self._options.sensor_id,
            gps_id=self._options.gps_id,
        )

    def findings(self) -> list[Finding]:
        """What is wrong now, the worst first."""
        return audit(self.situation())

    def _sinks(self) -> frozenset[str]:
        return frozenset(sink.value for sink in self._link.sinks)
