"""What others are told of the flight: the autopilot, the ground station, the bus, the flight log and systemd."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

from ortholoc_edge.adapters import systemd
from ortholoc_edge.adapters.bus import Bus
from ortholoc_edge.adapters.computer import ComputerReader, ComputerStatus, resident_mib
from ortholoc_edge.adapters.flight_log import FlightLog, LoggedStep
from ortholoc_edge.adapters.mavlink import AutopilotLink, LinkOptions, Severity, Statistic, SystemStatus
from ortholoc_edge.adapters.mavlink.audit import Level
from ortholoc_edge.adapters.mavlink.checkup import Checkup
from ortholoc_edge.adapters.mavlink.herald import Herald
from ortholoc_edge.adapters.mavlink.sources import SourceSwitch, Withheld
from ortholoc_edge.adapters.messages import (
    AutopilotMessage,
    HealthMessage,
    LadderMessage,
    StateMessage,
    StatsMessage,
    fix_message,
    rejection_message,
)
from ortholoc_edge.commander import Commander
from ortholoc_edge.pipeline.finder import Finder
from ortholoc_edge.pipeline.frame import Frame
from ortholoc_edge.pipeline.ladder import Step, Strain
from ortholoc_edge.pipeline.navigator import Navigator
from ortholoc_edge.pipeline.outcome import Fix, Outcome
from ortholoc_edge.pipeline.tracker import TrackerStatus
from ortholoc_edge.pipeline.witness import Consistency, WitnessReport
from ortholoc_edge.tiles.store import MapStore
from ortholoc_edge.vehicle import Vehicle

if TYPE_CHECKING:
    from ortholoc_edge.adapters.page.ground_page import GroundPage, Health

logger = logging.getLogger(__name__)

_S = 1_000_000_000

_INTERVAL_NS = 1 * _S
_FRESH_NS = 3 * _S
_MOST_AUDIT_TEXTS = 3
# A state that lasts is said when it begins, and again this long after.
_TELL_AGAIN_NS = 30 * _S

OutcomeListener = Callable[[Frame | None, Outcome], None]


class Reporter:
    """Tells outcomes as they come, and everything else once a second. Used by one thread, but for `statistics`.

    Whom it tells are told apart from each other: a defect in one, which would be there again after a restart, must end
    neither the flight nor what the others hear. It is counted (``report_errors``), and logged once.
    """

    def __init__(
        self,
        link: AutopilotLink,
        options: LinkOptions,
        lever_arm_m: tuple[float, float, float],
        vehicle: Vehicle,
        navigator: Navigator,
        store: MapStore,
        counts: Counter[str],
        commander: Commander,
        computer: ComputerReader,
        *,
        replaced: Callable[[], int],
        camera: Callable[[], Mapping[str, int]],
        unix_minus_stamp_ns: Callable[[], int],
        finder: Finder | None = None,
        bus: Bus | None = None,
        log: FlightLog | None = None,
        page: GroundPage | None = None,
        on_outcome: OutcomeListener | None = None,
    ) -> None:
        """
        Args:
            options, lever_arm_m: as configured; the autopilot's settings are held against them.
            counts: the daemon's, to which ours are added.
            commander: its `Commander.paused` is told.
            computer: that we run on; the navigator's ladder hears of it, too.
            replaced: how many frames a newer one took the place of.
            camera: what a live camera counts, `DeviceSource.counts`.
            unix_minus_stamp_ns: what makes dates of stamps, now.
            on_outcome: told of every outcome; must return at once.
        """
        self._link, self._vehicle, self._navigator, self._store = link, vehicle, navigator, store
        self._options, self._counts = options, counts
        self._bus, self._log, self._page, self._on_outcome = bus, log, page, on_outcome
        self._finder = finder
        self._commander, self._replaced, self._camera = commander, replaced, camera
        self._unix_minus_stamp_ns = unix_minus_stamp_ns
        self._started_ns: int | None = None
        # For systemd's status line.
        self.remark = ""
        self._fixes_before = (0, 0)
        self._last_outcome: Outcome | None = None
        self._computer = computer
        self._defective: set[str] = set()
        self._checkup: Checkup | None = Checkup(link, options, lever_arm_m=lever_arm_m, ages=link.ages)
        self._findings_told: set[str] = set()
        self._damage_told = 0
        self._herald = Herald()
        self._sources = SourceSwitch(options)
        self._last_ns = 0
        self._last_fix_ns: int | None = None
        self._origin_told_ns: int | None = None

    def statistics(self) -> dict[str, Statistic]:
        """Counters since the start: the daemon's, the log's and the bus's drops, the link's under ``link.`` and a
        live camera's under ``camera.``; the rung that frames are localized on, and whether GNSS agrees with the
        fixes."""
        witness = self._navigator.tracker.witness.report
        return {
            **self._counts,
            "sent": self._link.fixes_sent,
            "rung": self._navigator.ladder.rung,
            "gnss_consistency": witness.state.value,
            "gnss_apart_m": witness.apart_m,
            "map_files_damaged": len(self._store.damaged),
            "frames_replaced": self._replaced(),
            "log_dropped": 0 if self._log is None else self._log.dropped,
            "bus_dropped": 0 if self._bus is None else self._bus.dropped,
            "commands_refused": 0 if self._bus is None else self._bus.refused,
            "page_dropped": 0 if self._page is None else self._page.dropped,
            **{f"camera.{name}": value for name, value in self._camera().items()},
            **{f"link.{name}": value for name, value in self._link.statistics().items()},
        }

    def publish(self, frame: Frame | None, outcome: Outcome, step: LoggedStep | None = None) -> None:
        """What a frame came to. ``step``: see `FlightLog.put`."""
        if isinstance(outcome, Fix):
            self._last_fix_ns = outcome.stamp_ns
        self._counts["fixes" if isinstance(outcome, Fix) else "rejected"] += 1
        self._last_outcome = outcome
        if (log := self._log) is not None:
            self._tell("the flight log", lambda: log.put(frame, outcome, step))
        if (bus := self._bus) is not None:
            self._tell("the bus", lambda: self._publish_on(bus, frame, outcome, step))
        if (page := self._page) is not None:
            _, state, circumstances = step or (None, None, None)
            self._tell("the ground page", lambda: page.put(frame, outcome, state, circumstances))
        if (listener := self._on_outcome) is not None:
            self._tell("the listener", lambda: listener(frame, outcome))

    def _tell(self, whom: str, tell: Callable[[], None]) -> None:
        """See the class."""
        try:
            tell()
        except Exception:
            self._counts["report_errors"] += 1
            if whom not in self._defective:
                self._defective.add(whom)
                logger.exception("reporting to %s", whom)

    def _publish_on(self, bus: Bus, frame: Frame | None, outcome: Outcome, step: LoggedStep | None) -> None:
        unix_ns = outcome.stamp_ns + self._unix_minus_stamp_ns()
        if isinstance(outcome, Fix):
            mount = None if step is None else self._navigator.tracker.mount(step[1])
            bus.publish(fix_message(outcome, unix_ns, self._store.pack.georeference, mount))
        else:
            bus.publish(rejection_message(outcome, unix_ns))
        if frame is not None:
            bus.publish_image(frame.stamp_ns, frame.image)

    def stats(self, now_ns: int) -> StatsMessage:
        """For who asks; in any thread."""
        return StatsMessage(stamp_ns=now_ns, unix_ns=now_ns + self._unix_minus_stamp_ns(), statistics=self.statistics())

    def step(self, now_ns: int) -> None:
        """To be called often; does its work once a second."""
        self._tell("anybody", lambda: self._step(now_ns))

    def _step(self, now_ns: int) -> None:
        for step in self._navigator.ladder.take_steps():
            self._tell_step(step)
        if now_ns - self._last_ns < _INTERVAL_NS:
            return
        self._last_ns = now_ns
        # Others hear of what was sent: a fix that nobody is told of, for want of an origin, say, serves nobody.
        active = self._link.sent_since(now_ns - _FRESH_NS)
        self._link.set_system_status(SystemStatus.ACTIVE if active else SystemStatus.STANDBY)
        self._tell(
            "the source switch",
            lambda: self._switch_sources(self._navigator.tracker.witness.report.state, now_ns),
        )
        computer = self._computer.read()
        strain = Strain(computer.load_percent, computer.processor_c, computer.is_strained)
        self._navigator.ladder.observe(strain, now_ns)
        self._tell("the autopilot", lambda: self._report_autopilot(now_ns))
        self._link.report_computer(computer)
        if self._link.connected():
            self._tell("the pilot of damage", self._report_damage)
            self._tell("the pilot of settings", lambda: self._report_audit(now_ns))
            self._tell("the pilot of the origin", lambda: self._report_origin(now_ns))
        if (bus := self._bus) is not None:
            self._tell("the bus", lambda: self.publish_state(now_ns))
            self._tell("the bus", lambda: bus.publish(self._autopilot(now_ns)))
            self._tell("the bus", lambda: bus.publish(self._health(now_ns, computer)))
        if (page := self._page) is not None:
            self._tell("the ground page", lambda: page.tell(self._page_health(now_ns, computer)))
        if (log := self._log) is not None:
            self._tell("the flight log", lambda: log.note(now_ns, self.statistics()))
        self._tell("systemd", lambda: self._notify_systemd(now_ns))

    def _notify_systemd(self, now_ns: int) -> None:
        counts = self._counts
        status = "paused by command" if self._commander.paused else self._status(now_ns)
        remark = f"; {self.remark}" if self.remark else ""
        systemd.notify(f"STATUS={status}, {counts['fixes']} fixes, {counts['rejected']} rejected{remark}")

    def _tell_step(self, step: Step) -> None:
        ladder = self._navigator.ladder
        message = LadderMessage(
            stamp_ns=step.stamp_ns,
            unix_ns=step.stamp_ns + self._unix_minus_stamp_ns(),
            rung=step.rung,
            was=step.was,
            rungs=ladder.rungs,
            details=ladder.details,
            rate_hz=step.rate_hz,
            cause=step.cause.value,
            why=step.why,
        )
        if (bus := self._bus) is not None:
            self._tell("the bus", lambda: bus.publish(message))
        if (log := self._log) is not None:
            self._tell("the flight log", lambda: log.ladder(message))
        self._tell("the pilot of detail", lambda: self._tell_pilot(step))

    def _tell_pilot(self, step: Step) -> None:
        for severity, text in self._herald.tell_step(step):
            self._link.send_status_text(severity, text)

    def _page_health(self, now_ns: int, computer: ComputerStatus) -> Health:
        from ortholoc_edge.adapters.page.ground_page import Health

        ladder, vehicle = self._navigator.ladder, self._link.vehicle
        last = ladder.last_step
        return Health(
            now_ns=now_ns,
            tracker=self._status(now_ns).value,
            paused=self._commander.paused,
            autopilot=self._autopilot(now_ns),
            vehicle=None if vehicle is None else f"{vehicle.autopilot.value} {vehicle.firmware}",
            trouble=self._link.trouble(),
            computer=computer,
            budget_ms=ladder.budget_ms,
            rung=ladder.rung,
            rungs=ladder.rungs,
            rate_hz=ladder.rate_hz,
            rung_why="" if last is None else last.why,
            statistics=self.statistics(),
        )

    def _status(self, now_ns: int) -> TrackerStatus:
        """By the age of the last fix, not by what the last frame came to: a camera that hangs gives no frame."""
        if self._last_fix_ns is not None and now_ns - self._last_fix_ns < _FRESH_NS:
            return TrackerStatus.TRACK
        status = self._navigator.tracker.status
        return TrackerStatus.COAST if status is TrackerStatus.TRACK else status

    def publish_state(self, now_ns: int) -> None:
        """What the daemon is about, for others: once a second, and when a command changed it."""
        if self._bus is None:
            return
        last, tracker = self._last_outcome, self._navigator.tracker
        self._bus.publish(
            StateMessage(
                stamp_ns=now_ns,
                unix_ns=now_ns + self._unix_minus_stamp_ns(),
                status=self._status(now_ns).value,
                paused=self._commander.paused,
                last_fix_age_s=None if self._last_fix_ns is None else (now_ns - self._last_fix_ns) / _S,
                last_reason=None if last is None or isinstance(last, Fix) else last.reason.value,
                rung=self._navigator.ladder.rung,
                reset_counter=tracker.reset_counter,
                search=None if self._finder is None else self._finder.says,
                gnss=tracker.witness.report.state.value,
                autopilot=self._link.connected(),
                commands=self._bus.accepts_commands,
            )
        )

    def _health(self, now_ns: int, computer: ComputerStatus) -> HealthMessage:
        if self._started_ns is None:
            self._started_ns = now_ns
        fixes, (before_ns, before) = self._counts["fixes"], self._fixes_before
        self._fixes_before = now_ns, fixes
        return HealthMessage(
            stamp_ns=now_ns,
            unix_ns=now_ns + self._unix_minus_stamp_ns(),
            uptime_s=(now_ns - self._started_ns) / _S,
            fixes=fixes,
            rejected=self._counts["rejected"],
            replaced=self._replaced(),
            fixes_per_s=(fixes - before) * _S / (now_ns - before_ns) if before_ns else 0.0,
            sent=self._link.fixes_sent,
            cpu_percent=computer.cpu_percent,
            rss_mib=resident_mib(),
            memory_used_mib=computer.memory_used_mib,
            memory_total_mib=computer.memory_total_mib,
            temperatures_c=computer.temperatures_c,
            under_voltage=computer.is_under_voltage,
            throttled=computer.is_throttled,
            hot=computer.is_hot,
            map_files_damaged=len(self._store.damaged),
            log_dropped=0 if self._log is None else self._log.dropped,
            bus_dropped=0 if self._bus is None else self._bus.dropped,
        )

    def _report_origin(self, now_ns: int) -> None:
        last_ns, told_ns = self._vehicle.no_origin_ns, self._origin_told_ns
        if last_ns is None or now_ns - last_ns >= _FRESH_NS:
            return
        if told_ns is None or now_ns - told_ns >= _TELL_AGAIN_NS:
            self._origin_told_ns = now_ns
            self._link.send_status_text(Severity.WARNING, "OrthoLoC: EKF origin unknown, fixes not sent")

    def _report_autopilot(self, now_ns: int) -> None:
        """Say what the autopilot does with the fixes and whether GNSS agrees with them."""
        fusion, witness = self._link.fusion, self._navigator.tracker.witness.report
        for severity, text in self._herald.tell(fusion, witness):
            logger.log(logging.INFO if severity >= Severity.NOTICE else logging.WARNING, "%s", text)
            self._link.send_status_text(severity, text)

    def _autopilot(self, now_ns: int) -> AutopilotMessage:
        unix_ns, witness = now_ns + self._unix_minus_stamp_ns(), self._navigator.tracker.witness.report
        return autopilot_message(now_ns, unix_ns, self._link, witness, self._sources.on_vision)

    def _switch_sources(self, consistency: Consistency, now_ns: int) -> None:
        """Command the autopilot's source set where that was enabled; announce what it took."""
        outcome = self._link.source_set_outcome()
        if outcome is not None:
            taken = self._sources.settle(outcome, now_ns)
            if taken is not None:
                logger.warning("%s", taken.text)
                self._counts[f"switched_to_{taken.source}"] += 1
                self._link.send_status_text(Severity.WARNING, taken.text)
            elif not outcome.accepted:
                why = "no answer" if outcome.answer is None else f"result {outcome.answer}"
                logger.warning("EKF source set %d was not taken (%s); tried again later", outcome.number, why)
                self._counts["switches_not_taken"] += 1
        vehicle, number = self._link.vehicle, self._options.vision_source_set
        reading = self._link.parameters()[0].get(f"EK3_SRC{number}_POSXY")
        switch = self._sources.decide(
            consistency,
            # Not what we know of where we are, but what the autopilot was told: a set without fixes is no position.
            self._link.sent_since(now_ns - _FRESH_NS, local=True),
            vehicle.autopilot if vehicle else None,
            self._link.restarts,
            now_ns,
            vision_posxy=None if reading is None else reading.value,
        )
        if isinstance(switch, Withheld):
            logger.warning("%s: set it, or [link] vision_source_set; GNSS is bad and stays in use", switch.text)
            self._link.send_status_text(Severity.WARNING, switch.text)
        elif switch is not None:
            logger.warning("commanding EKF source set %d (%s)", switch.number, switch.source)
            self._link.take_source_set(switch.number)

    def _report_audit(self, now_ns: int) -> None:
        """Say once what is wrong with the autopilot's settings; of its delays as soon as our latency is known."""
        if self._checkup is None or not self._checkup.step(now_ns):
            return
        findings = [
            finding
            for finding in self._checkup.findings()
            if finding.level is not Level.NOTE and finding.subject not in self._findings_told
        ]
        if self._link.ages() is not None:
            self._checkup = None
        self._findings_told.update(finding.subject for finding in findings)
        for finding in findings:
            logger.warning(
                "autopilot: %s is %s, wanted %s: %s; %s",
                finding.subject, finding.found, finding.wanted, finding.why, finding.remedy,
            )  # fmt: skip
        errors = [finding for finding in findings if finding.level is Level.ERROR and finding.change is not None]
        for finding in errors[:_MOST_AUDIT_TEXTS]:
            text = f"OrthoLoC: {finding.subject} is {finding.found}, wants {finding.wanted}"
            self._link.send_status_text(Severity.WARNING, text)
        if len(errors) > _MOST_AUDIT_TEXTS:
            self._link.send_status_text(Severity.WARNING, f"OrthoLoC: {len(errors)} settings wrong, see doctor")
        self._counts["audit_findings"] = len(self._findings_told)

    def _report_damage(self) -> None:
        """Say that the map has holes: once the autopilot is there, and again if more are found in flight."""
        damaged = self._store.damaged
        if len(damaged) == self._damage_told:
            return
        self._damage_told = len(damaged)
        logger.warning("holes in the map: %d files are damaged or missing, the last %s", len(damaged), damaged[-1])
        self._link.send_status_text(Severity.WARNING, f"OrthoLoC: {len(damaged)} map files damaged")


def autopilot_message(
    now_ns: int, unix_ns: int, link: AutopilotLink, witness: WitnessReport, on_vision: bool
) -> AutopilotMessage:
    """What is published of the autopilot."""
    fusion, advice = link.fusion, link.delay_advice
    median_ms, p99_ms = link.latency_ms

    def age_s(since_ns: int) -> float | None:
        return (now_ns - since_ns) / _S if since_ns else None

    return AutopilotMessage(
        stamp_ns=now_ns,
        unix_ns=unix_ns,
        connected=link.connected(),
        fusion=fusion.state.value,
        fusion_since_s=age_s(fusion.since_ns),
        fusion_reason=fusion.reason,
        gnss=witness.state.value,
        gnss_since_s=age_s(witness.since_ns),
        gnss_apart_m=witness.apart_m,
        gnss_height_apart_m=witness.height_apart_m,
        latency_median_ms=median_ms,
        latency_p99_ms=p99_ms,
        delay_advice=None if advice is None else str(advice),
        on_vision=on_vision,
    )
