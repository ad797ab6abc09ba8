"""What the ground station is told, on changes of state only; pure."""

from __future__ import annotations

from ortholoc_edge.adapters.mavlink.monitor import Fusion, FusionReport
from ortholoc_edge.adapters.mavlink.options import Severity
from ortholoc_edge.pipeline.ladder import Cause, Step
from ortholoc_edge.pipeline.witness import Consistency, WitnessReport


class Herald:
    """Remembers what was told last. Used by one thread."""

    def __init__(self) -> None:
        self._fusion = Fusion.UNKNOWN
        self._consistency = Consistency.UNKNOWN
        self._height_told = False
        self._less_told = False

    def tell(self, fusion: FusionReport, witness: WitnessReport) -> list[tuple[Severity, str]]:
        """Lines for STATUSTEXT; each of them is of a change."""
        return [*self._tell_fusion(fusion), *self._tell_gnss(witness)]

    def tell_step(self, step: Step) -> list[tuple[Severity, str]]:
        """Of the ladder: what heat takes, that frames are left out, and when all is well again. What time alone takes
        comes and goes, and the ground page shows it."""
        if step.rung > step.was:
            if step.cause is not Cause.HEAT and step.rate_hz is None:
                return []
            self._less_told = True
            less = "less detail" if step.rate_hz is None else f"{step.rate_hz:g} Hz at most"
            return [(Severity.WARNING, f"OrthoLoC: {less}: {step.why}")]
        if step.rung > 0 or not self._less_told:
            return []
        self._less_told = False
        return [(Severity.INFO, "OrthoLoC: full detail and rate again")]

    def _tell_fusion(self, report: FusionReport) -> list[tuple[Severity, str]]:
        if report.state is self._fusion:
            return []
        self._fusion = report.state
        good = report.state in (Fusion.FUSED, Fusion.UNKNOWN)
        # The line that shows without unfolding is the first 50 characters.
        return [(Severity.INFO if good else Severity.WARNING, f"OrthoLoC: fixes {report.state}: {report.reason}")]

    def _tell_gnss(self, report: WitnessReport) -> list[tuple[Severity, str]]:
        lines = []
        if report.state is not self._consistency:
            before, self._consistency = self._consistency, report.state
            apart = "" if report.apart_m is None else f", {report.apart_m:.0f} m apart"
            if report.state is Consistency.BAD:
                lines.append((Severity.ERROR, f"OrthoLoC: GNSS contradicts camera{apart}"))
            elif report.state is Consistency.SUSPECT:
                lines.append((Severity.WARNING, f"OrthoLoC: GNSS suspect{apart}"))
            elif before in (Consistency.BAD, Consistency.SUSPECT):
                agrees = report.state is Consistency.OK
                lines.append((Severity.INFO, f"OrthoLoC: GNSS {'agrees again' if agrees else 'unknown: no fixes'}"))
        height = report.height_apart_m
        if height is not None and not self._height_told:
            lines.append((Severity.WARNING, f"OrthoLoC: GNSS is {height:+.0f} m off map height: datum?"))
        self._height_told = height is not None
        return lines
