"""The program that flies: threads, hand-overs, supervision, shutdown.

    capture thread ──LatestSlot──▶ worker (the caller's thread): state at exposure → Navigator.step → estimate
    link thread    ◀──────────── estimates, status      recorder and bus: bounded, drop and count

Frames never queue: a position three frames old misleads by an amount that nobody sees.
"""

from __future__ import annotations

import logging
import math
import threading
from collections import Counter
from collections.abc import Callable
from contextlib import ExitStack, closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Generic, TypeVar

from ortholoc_edge.adapters import systemd
from ortholoc_edge.adapters.bus import AutopilotRecord, Bus
from ortholoc_edge.adapters.camera import BadFrameError, EndOfFrames, FrameSource, open_source
from ortholoc_edge.adapters.computer import ComputerReader
from ortholoc_edge.adapters.mavlink import (
    AutopilotLink,
    AutopilotState,
    GnssPosition,
    Severity,
    Statistic,
    SystemStatus,
)
from ortholoc_edge.adapters.mavlink.audit import Level
from ortholoc_edge.adapters.mavlink.checkup import Checkup
from ortholoc_edge.adapters.mavlink.estimates import VisionEstimate
from ortholoc_edge.adapters.mavlink.geodesy import EarthModel, GeodeticOrigin, Place, is_same_origin, ned_from_geodetic
from ortholoc_edge.adapters.mavlink.herald import Herald
from ortholoc_edge.adapters.mavlink.sinks import earth_model
from ortholoc_edge.adapters.mavlink.sources import SourceSwitch, Withheld
from ortholoc_edge.adapters.recorder import Recorder
from ortholoc_edge.clock import Clock, SystemClock
from ortholoc_edge.config import Config
from ortholoc_edge.errors import CameraError, LinkError, MapError, OrtholocError
from ortholoc_edge.geometry import covariance as cov
from ortholoc_edge.geometry import frames
from ortholoc_edge.geometry.arrays import FloatArray
from ortholoc_edge.geometry.rigid import Rigid3
from ortholoc_edge.matching.registry import make_method
from ortholoc_edge.matching.types import STRUCTURAL, AnyMatcher
from ortholoc_edge.pipeline.frame import CameraMount, Frame, VehicleState
from ortholoc_edge.pipeline.localizer import Localizer
from ortholoc_edge.pipeline.navigator import Navigator
from ortholoc_edge.pipeline.outcome import Fix, Outcome, Reason, Rejected
from ortholoc_edge.pipeline.tracker import Tracker, TrackerStatus
from ortholoc_edge.pipeline.witness import Consistency, WitnessReport
from ortholoc_edge.pose import pnp
from ortholoc_edge.tiles.georeference import Georeference
from ortholoc_edge.tiles.pack import Pack
from ortholoc_edge.tiles.store import MapStore

logger = logging.getLogger(__name__)

T = TypeVar("T")

_S = 1_000_000_000

_WAIT_S = 0.2
# The autopilot's attitude for an exposure arrives after it; the frame waits this long for it at most.
_STATE_WAIT_NS = 150_000_000
_MAX_ERRORS_IN_A_ROW = 5
_STATUS_INTERVAL_NS = 1_000_000_000
_FRESH_FIX_NS = 3_000_000_000
_MOST_AUDIT_TEXTS = 3
# A state that lasts is said when it begins, and again this long after.
_TELL_AGAIN_NS = 30 * _S
# A read returns within `_WAIT_S`; a driver that holds it this long is not coming back by itself.
_CAPTURE_HUNG_NS = 5_000_000_000

OutcomeListener = Callable[[Frame | None, Outcome], None]


class LatestSlot(Generic[T]):
    """Holds one item. ``put`` replaces what was not taken, and counts it."""

    def __init__(self) -> None:
        self._condition = threading.Condition()
        self._item: T | None = None
        self.replaced = 0

    def put(self, item: T) -> None:
        with self._condition:
            if self._item is not None:
                self.replaced += 1
            self._item = item
            self._condition.notify()

    def take(self, timeout_s: float) -> T | None:
        """The item, or None if none came in time."""
        with self._condition:
            if self._item is None:
                self._condition.wait(timeout_s)
            item, self._item = self._item, None
            return item


@dataclass(frozen=True, slots=True)
class _Missed:
    """A frame that could not be read."""

    stamp_ns: int
    why: str


class Daemon:
    """Camera, map, matcher and autopilot, wired up.

    Raises on construction: OrtholocError for what can't work (map, model, endpoint), before anything starts.
    """

    def __init__(
        self,
        config: Config,
        *,
        frames: FrameSource | None = None,
        matcher: AnyMatcher | None = None,
        clock: Clock | None = None,
        on_outcome: OutcomeListener | None = None,
    ) -> None:
        """
        Args:
            frames: instead of ``config.camera``.
            matcher: instead of ``config.matcher``.
            on_outcome: told of every outcome, in the worker's thread; must return at once.
        """
        self._config = config
        self._clock = clock or SystemClock()
        self._on_outcome = on_outcome
        public_key = None if config.map.public_key is None else Path(config.map.public_key)
        with ExitStack() as resources:
            # Closed in reverse, also where a later part can't be had.
            self._store = resources.enter_context(
                MapStore(
                    Pack.open(Path(config.map.pack), public_key),
                    cache_bytes=config.map.cache_mb * 2**20,
                    memory_bytes=config.map.memory_mb * 2**20,
                    features=config.localizer.precomputed_features != "never" and config.matcher.name != STRUCTURAL,
                    require_intact=config.map.require_intact,
                )
            )
            self._georeference = self._store.pack.georeference
            _require_flyable(self._georeference, config.map.pack)
            options = config.matcher
            self._matcher = matcher or make_method(
                options.name,
                working_px=options.working_px,
                max_keypoints=options.max_keypoints,
                threads=options.threads,
                model_path=None if options.model is None else Path(options.model),
                model_sha256=options.model_sha256,
            )
            localizer = Localizer(config.intrinsics.camera(), self._store, self._matcher, config.localizer)
            resources.callback(localizer.close)
            # In every life of the program another value, or the autopilot would not notice the restart.
            first_reset_counter = self._clock.now_ns() // _S
            gimbal = config.mount.gimbal_selection()
            fixed = config.mount.body_from_camera() if gimbal is None else None
            tracker = Tracker(self._georeference, fixed, config.tracker, first_reset_counter, config.witness)
            self._navigator = Navigator(localizer, tracker, config.timing.budget_ms)
            self._link = AutopilotLink(config.link, self._clock, gimbal, config.timing.max_age_ms)
            self._bus = resources.enter_context(closing(Bus(config.bus))) if config.bus.enabled else None
            self._recorder = (
                resources.enter_context(closing(Recorder(Path(config.log.folder), config.log.max_mb)))
                if config.log.folder
                else None
            )
            self._frames = resources.enter_context(closing(frames or open_source(config.camera, self._clock)))
            self._resources = resources.pop_all()
        self._slot: LatestSlot[Frame | _Missed] = LatestSlot()
        self._computer = ComputerReader()
        self._ended = threading.Event()
        self._capture_failure: BaseException | None = None
        self._capture_beat_ns = self._clock.now_ns()
        self._last_fix_ns: int | None = None
        self._counts: Counter[str] = Counter()
        self._origin_missing = False
        self._origin_told_ns: int | None = None
        self._checkup: Checkup | None = Checkup(
            self._link, config.link, lever_arm_m=config.mount.lever_arm_m, ages=self._link.ages
        )
        self._findings_told: set[str] = set()
        self._damage_reported = 0
        self._origin: GeodeticOrigin | None = None
        self._restarts = 0
        self._last_status_ns = 0
        self._herald = Herald()
        self._sources = SourceSwitch(config.link)

    @property
    def link(self) -> AutopilotLink:
        return self._link

    def statistics(self) -> dict[str, Statistic]:
        """Counters since the start: ours, the recorder's and the bus's drops, and the link's under ``link.``; the
        rung of detail that frames are localized at, and whether GNSS agrees with the fixes."""
        witness = self._navigator.tracker.witness.report
        return {
            **self._counts,
            "sent": self._link.fixes_sent,
            "frames_replaced": self._slot.replaced,
            "rung": self._navigator.ladder.rung,
            "gnss_consistency": witness.state.value,
            "gnss_apart_m": witness.apart_m,
            "map_files_damaged": len(self._store.damaged),
            "log_dropped": 0 if self._recorder is None else self._recorder.dropped,
            "bus_dropped": 0 if self._bus is None else self._bus.dropped,
            **{f"link.{name}": value for name, value in self._link.statistics().items()},
        }

    def run(self, stop: threading.Event) -> None:
        """Work until ``stop`` is set or the frames end, then release everything; once only.

        Raises: OrtholocError where a part failed for good; systemd then starts afresh.
        """
        with self._resources as resources:
            self._warm_up()
            self._link.set_system_status(SystemStatus.STANDBY)
            resources.callback(self._say_goodbye)
            resources.callback(self._link.stop)
            self._link.start()
            capture = threading.Thread(target=self._capture, args=(stop,), name="capture", daemon=True)
            resources.callback(self._join_capture, capture, stop)
            self._capture_beat_ns = self._clock.now_ns()
            capture.start()
            resources.callback(systemd.notify, "STOPPING=1")
            systemd.notify("READY=1")
            logger.info(
                "running: pack %s (%.0f MB in memory), matcher %s, solver %s",
                self._config.map.pack, self._store.compressed_bytes / 1e6, self._matcher.name, pnp.SOLVER,
            )  # fmt: skip
            self._work(stop)
        if self._capture_failure is not None:
            raise CameraError(f"the camera thread ended: {self._capture_failure}") from self._capture_failure

    def _say_goodbye(self) -> None:
        logger.info("stopped: %s", self.statistics())
        advice = self._link.delay_advice
        if advice is not None:
            logger.info("measured latency asks for %s", advice)

    def _join_capture(self, capture: threading.Thread, stop: threading.Event) -> None:
        stop.set()
        # Closing the source is what ends a read that waits for a device.
        self._frames.close()
        capture.join(timeout=5.0)

    # -- threads ---------------------------------------------------------------------------------------

    def _capture(self, stop: threading.Event) -> None:
        try:
            while not stop.is_set():
                self._capture_beat_ns = self._clock.now_ns()
                try:
                    frame = self._frames.read(_WAIT_S)
                except BadFrameError as bad:
                    self._slot.put(_Missed(bad.stamp_ns, str(bad)))
                    continue
                if frame is not None:
                    self._slot.put(frame)
        except EndOfFrames:
            logger.info("no more frames")
        except Exception as error:  # the thread's one loop: whatever ends it must end the daemon, not hide
            if not stop.is_set():
                logger.exception("camera thread")
                self._capture_failure = error
        finally:
            self._ended.set()

    def _work(self, stop: threading.Event) -> None:
        errors = 0
        while not stop.is_set():
            self._feed_watchdog()
            if self._link.failure is not None:
                raise LinkError(f"the link's thread ended: {self._link.failure}") from self._link.failure
            # Before the slot is looked at: what came before the end must still be taken.
            ended = self._ended.is_set()
            item = self._slot.take(_WAIT_S)
            self._report_status()
            if item is None:
                if ended:
                    return
                continue
            if isinstance(item, _Missed):
                self._publish(None, Rejected(item.stamp_ns, Reason.BAD_FRAME, item.why))
                continue
            try:
                self._handle(item, stop)
                errors = 0
            except Exception as error:  # one spot per thread, around one item (house style)
                errors += 1
                logger.exception("frame at %d ns", item.stamp_ns)
                self._publish(item, Rejected(item.stamp_ns, Reason.INTERNAL, repr(error)))
                if errors >= _MAX_ERRORS_IN_A_ROW:
                    raise OrtholocError(f"{errors} frames in a row failed, last with {error!r}") from error

    def _feed_watchdog(self) -> None:
        """Only while the capture thread comes back from its reads: a hung camera is no progress."""
        if self._ended.is_set() or self._clock.now_ns() - self._capture_beat_ns <= _CAPTURE_HUNG_NS:
            systemd.notify("WATCHDOG=1")

    def _warm_up(self) -> None:
        """The first inference allocates and compiles; it must not happen in flight."""
        self._navigator.localizer.warm_up()

    # -- one frame -------------------------------------------------------------------------------------

    def _handle(self, frame: Frame, stop: threading.Event) -> None:
        known = self._state_at(frame.stamp_ns, stop)
        state = self._vehicle_state(frame.stamp_ns, known)

        def proceed() -> bool:
            self._feed_watchdog()
            return self._age_ms(frame.stamp_ns) < self._config.timing.max_age_ms and not stop.is_set()

        outcome = self._navigator.step(frame, state, proceed)
        if isinstance(outcome, Fix):
            self._last_fix_ns = frame.stamp_ns
            age_ms, limit_ms = self._age_ms(frame.stamp_ns), self._config.timing.max_age_ms
            if age_ms > limit_ms:
                # Good for the next prediction, but an autopilot would take it for newer than it is.
                late = Rejected(frame.stamp_ns, Reason.LATE, "a fix, but too old to send, ms", age_ms, limit_ms)
                self._publish(frame, replace(late, timings_ms=outcome.timings_ms))
                return
            self._send(outcome, known, state)
        self._publish(frame, outcome)

    def _age_ms(self, stamp_ns: int) -> float:
        return (self._clock.now_ns() - stamp_ns) / 1e6

    def _state_at(self, stamp_ns: int, stop: threading.Event) -> AutopilotState | None:
        """The autopilot's state at an exposure, waiting a little for the telemetry that follows it."""
        deadline_ns = self._clock.now_ns() + _STATE_WAIT_NS
        while True:
            known = self._link.state_at(stamp_ns)
            if known is not None and known.interpolated:
                return known
            if self._clock.now_ns() >= deadline_ns or stop.wait(0.005):
                return known

    def _vehicle_state(self, stamp_ns: int, known: AutopilotState | None) -> VehicleState:
        roll, pitch, yaw = (math.radians(sigma) for sigma in self._config.attitude.sigma_deg)
        trouble = self._link.trouble() if known is None or known.ned_from_body is None else None
        if known is None:
            return VehicleState(stamp_ns, None, (roll, pitch, yaw), no_attitude_because=trouble or "")
        position = None if known.gnss is None else self._map_position(known.gnss)
        return VehicleState(
            stamp_ns,
            known.ned_from_body,
            (roll, pitch, yaw),
            known.odometry_ned_m,
            known.odometry_epoch,
            position,
            (0.0, 0.0) if known.gnss is None else (known.gnss.sigma_horizontal_m, known.gnss.sigma_vertical_m),
            self._gimbal_mount(known),
            trouble or "",
        )

    def _gimbal_mount(self, known: AutopilotState) -> CameraMount | None:
        if known.ned_from_gimbal is None or known.ned_from_body is None:
            return None
        options = self._config.mount
        tilt, heading = (
            math.hypot(math.radians(sigma_deg), known.gimbal_sigma_rad) for sigma_deg in options.gimbal_sigma_deg
        )
        return CameraMount(
            options.body_from_camera_in(known.ned_from_body.T @ known.ned_from_gimbal), (tilt, heading)
        )

    def _map_position(self, gnss: GnssPosition) -> FloatArray | None:
        """None for a place that the pack's projection can't take, a spoofed one on another continent, say."""
        try:
            return self._georeference.map_from_geodetic(
                gnss.latitude_deg, gnss.longitude_deg, height_amsl_m=gnss.height_amsl_m
            )
        except MapError as error:
            if not self._counts["gnss_unusable"]:
                logger.warning("the autopilot's GNSS position can't be used: %s", error)
            self._counts["gnss_unusable"] += 1
            return None

    def _send(self, fix: Fix, known: AutopilotState | None, state: VehicleState) -> None:
        vehicle, now = self._link.vehicle, self._link.state_at(fix.stamp_ns)
        mount = self._navigator.tracker.mount(state)
        if known is None or now is None or vehicle is None or mount is None:
            self._counts["no_autopilot"] += 1
            return
        map_from_body = fix.map_from_camera @ mount.body_from_camera.inverse()
        local = [sink.local for sink in self._link.sinks]
        if now.origin is None and any(local):
            self._counts["no_origin"] += 1
            self._origin_missing = True
            self._offer_origin(map_from_body.translation)
            if all(local):
                return
        if now.origin is not None:
            self._origin_told_ns = None
        moved = any(local) and not (
            self._origin is None or now.origin is None or is_same_origin(now.origin, self._origin)
        )
        restarts = self._link.restarts
        if moved or restarts != self._restarts:
            # What was sent before meant other places, or is forgotten; without notice the filter would take this for
            # a jump.
            why = "moved its origin" if moved else "restarted"
            logger.warning("the autopilot %s; its filter is told to start anew", why)
            self._navigator.tracker.announce_jump()
        self._restarts = restarts
        self._origin = now.origin or self._origin
        estimate = vision_estimate(
            fix,
            map_from_body,
            self._georeference,
            now.origin,
            earth_model(vehicle.autopilot),
            self._navigator.tracker.reset_counter,
            mount.sigma_rad,
        )
        self._link.send_estimate(estimate)

    def _offer_origin(self, position_map: FloatArray) -> None:
        place = self._georeference.geodetic_from_map(position_map)
        if place.height_amsl_m is not None:
            self._link.offer_origin(GeodeticOrigin(place.lat_deg, place.lon_deg, place.height_amsl_m))

    def _publish(self, frame: Frame | None, outcome: Outcome) -> None:
        self._counts["fixes" if isinstance(outcome, Fix) else "rejected"] += 1
        if self._recorder is not None:
            self._recorder.put(frame.name if frame is not None else None, outcome)
        if self._bus is not None:
            self._bus.publish(outcome)
        if self._on_outcome is not None:
            self._on_outcome(frame, outcome)

    def _report_status(self) -> None:
        now_ns = self._clock.now_ns()
        if now_ns - self._last_status_ns < _STATUS_INTERVAL_NS:
            return
        self._last_status_ns = now_ns
        # By the age of the last fix, not by what the last frame came to: a camera that hangs gives no frame.
        fresh = self._last_fix_ns is not None and now_ns - self._last_fix_ns < _FRESH_FIX_NS
        status = TrackerStatus.TRACK if fresh else self._navigator.tracker.status
        if not fresh and status is TrackerStatus.TRACK:
            status = TrackerStatus.COAST
        # Others hear of what was sent: a fix that nobody is told of, for want of an origin, say, serves nobody.
        active = self._link.sent_since(now_ns - _FRESH_FIX_NS)
        self._link.set_system_status(SystemStatus.ACTIVE if active else SystemStatus.STANDBY)
        self._link.report_computer(self._computer.read())
        systemd.notify(f"STATUS={status}, {self._counts['fixes']} fixes, {self._counts['rejected']} rejected")
        if self._link.connected():
            self._report_damage()
            self._report_audit(now_ns)
        self._report_autopilot(now_ns)
        if self._origin_missing and self._link.connected():
            self._origin_missing = False
            if self._origin_told_ns is None or now_ns - self._origin_told_ns >= _TELL_AGAIN_NS:
                self._origin_told_ns = now_ns
                self._link.send_status_text(Severity.WARNING, "OrthoLoC: EKF origin unknown, fixes not sent")

    def _report_autopilot(self, now_ns: int) -> None:
        """Say and publish what the autopilot does with the fixes and whether GNSS agrees with them; switch its source
        if that was enabled."""
        fusion, witness = self._link.fusion, self._navigator.tracker.witness.report
        for severity, text in self._herald.tell(fusion, witness):
            logger.log(logging.INFO if severity >= Severity.NOTICE else logging.WARNING, "%s", text)
            self._link.send_status_text(severity, text)
        self._switch_sources(witness.state, now_ns)
        if self._bus is not None:
            self._bus.publish_autopilot(autopilot_record(now_ns, self._link, witness, self._sources.on_vision))

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
        vehicle, number = self._link.vehicle, self._config.link.vision_source_set
        reading = self._link.parameters()[0].get(f"EK3_SRC{number}_POSXY")
        switch = self._sources.decide(
            consistency,
            # Not what we know of where we are, but what the autopilot was told: a set without fixes is no position.
            self._link.sent_since(now_ns - _FRESH_FIX_NS, local=True),
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
        if len(damaged) == self._damage_reported:
            return
        self._damage_reported = len(damaged)
        logger.warning("holes in the map: %d files are damaged or missing, the last %s", len(damaged), damaged[-1])
        self._link.send_status_text(Severity.WARNING, f"OrthoLoC: {len(damaged)} map files damaged")


def autopilot_record(now_ns: int, link: AutopilotLink, witness: WitnessReport, on_vision: bool) -> AutopilotRecord:
    """What is published of the autopilot."""
    fusion, advice = link.fusion, link.delay_advice
    median_ms, p99_ms = link.latency_ms

    def age_s(since_ns: int) -> float | None:
        return (now_ns - since_ns) / _S if since_ns else None

    return AutopilotRecord(
        stamp_ns=now_ns,
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


def vision_estimate(
    fix: Fix,
    map_from_body: Rigid3,
    georeference: Georeference,
    origin: GeodeticOrigin | None,
    model: EarthModel,
    reset_counter: int,
    mount_sigma_rad: tuple[float, float] = (0.0, 0.0),
) -> VisionEstimate:
    """A fix as the autopilot wants it: the body on WGS 84 and in the autopilot's local NED, true north.

    Args:
        map_from_body: of the fix.
        origin: the autopilot's; without one the estimate has no local position.
        model: by which the autopilot itself relates its local frame to latitude and longitude.
        mount_sigma_rad: `CameraMount.sigma_rad`: the fix is of the camera, and the body is seen through the gimbal.
    Raises: MapError if the pack does not say how its heights relate to AMSL.
    """
    place = georeference.geodetic_from_map(map_from_body.translation)
    if place.height_amsl_m is None:
        raise MapError("the pack's heights can't be turned into AMSL; rebuild it with --geoid-undulation-m")
    ned_from_map = frames.map_from_ned_rotation(georeference.convergence_rad(map_from_body.translation[:2])).T
    lever = map_from_body.translation - fix.map_from_camera.translation
    covariance = cov.rotated(cov.of_moved_point(fix.covariance, lever), ned_from_map)
    covariance[3:, 3:] += cov.turn(mount_sigma_rad)
    # Common to the whole pack: no match tells of it, so it joins only where the height leaves the pack's datum.
    covariance[2, 2] += (georeference.vertical.amsl_sigma_m or 0.0) ** 2
    position = None
    if origin is not None:
        position = ned_from_geodetic(origin, place.lat_deg, place.lon_deg, place.height_amsl_m, model)
    return VisionEstimate(
        fix.stamp_ns,
        position,
        ned_from_map @ map_from_body.rotation,
        covariance,
        reset_counter,
        min(fix.quality, 1.0),
        Place(place.lat_deg, place.lon_deg, place.height_amsl_m, place.height_ellipsoid_m),
        origin,
    )


def _require_flyable(georeference: Georeference, pack: str) -> None:
    if georeference.crs is None:
        raise MapError(
            f"{pack}: has no reference system, so its positions mean nothing to an autopilot; rebuild it from rasters "
            "in a projected system"
        )
    if georeference.amsl_minus_map_m(georeference.anchor) is None:
        raise MapError(
            f"{pack}: {georeference.vertical.unknown('above mean sea level')} Until then a fix could be wrong by the"
            " height of the geoid, 30 to 50 m."
        )
