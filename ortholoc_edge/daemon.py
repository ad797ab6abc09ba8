"""The program that flies: threads, hand-overs, supervision, shutdown.

    capture thread ──LatestSlot──▶ worker (the caller's thread): state at exposure → Navigator.step → estimate
    link thread    ◀──────────── estimates, status      flight log and bus: bounded, drop and count

Frames never queue: a position three frames old misleads by an amount that nobody sees.
"""

from __future__ import annotations

import json
import logging
import os
import threading
from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from contextlib import ExitStack, closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Generic, TypeVar

from msgspec import structs

from ortholoc_edge.adapters import systemd
from ortholoc_edge.adapters.bus import Bus, bus_of
from ortholoc_edge.adapters.camera import BadFrameError, Counting, EndOfFrames, FrameSource, open_source
from ortholoc_edge.adapters.commands import Answer, BusyError, Desk
from ortholoc_edge.adapters.computer import ComputerReader
from ortholoc_edge.adapters.flight_log import FlightLog
from ortholoc_edge.adapters.mavlink import AutopilotLink, Severity, Statistic, SystemStatus
from ortholoc_edge.adapters.messages import NAME_OF_COMMAND, Command, CommandReply, ConfigMessage
from ortholoc_edge.clock import Clock, SystemClock, wall_clock_ns
from ortholoc_edge.commander import Commander
from ortholoc_edge.config import Config, MatcherOptions, without_secrets
from ortholoc_edge.errors import CameraError, LinkError, MapError, OrtholocError
from ortholoc_edge.matching.registry import make_method
from ortholoc_edge.matching.types import AnyMatcher
from ortholoc_edge.pipeline import structural
from ortholoc_edge.pipeline.finder import Finder, Seeker
from ortholoc_edge.pipeline.frame import Frame, VehicleState
from ortholoc_edge.pipeline.localizer import Localizer
from ortholoc_edge.pipeline.navigator import Circumstances, Navigator, Tuning
from ortholoc_edge.pipeline.outcome import Fix, Outcome, Reason, Rejected
from ortholoc_edge.pipeline.tracker import Tracker
from ortholoc_edge.pose import pnp
from ortholoc_edge.reload import Plan
from ortholoc_edge.reporting import OutcomeListener, Reporter
from ortholoc_edge.search_process import SearchProcess, SearchSetup
from ortholoc_edge.tiles.georeference import Georeference
from ortholoc_edge.tiles.pack import Pack
from ortholoc_edge.tiles.store import MapStore
from ortholoc_edge.vehicle import Vehicle

if TYPE_CHECKING:
    from ortholoc_edge.adapters.page.ground_page import GroundPage

logger = logging.getLogger(__name__)

T = TypeVar("T")

_S = 1_000_000_000

_WAIT_S = 0.2
_MAX_ERRORS_IN_A_ROW = 5
# A frame that is searched for takes a second at most (`[timing] max_age_ms`).
_COMMAND_WAIT_S = 5.0
# A read returns within `_WAIT_S`; a driver that holds it this long is not coming back by itself.
_CAPTURE_HUNG_NS = 5_000_000_000
# It comes round many times a second, and says when it waits longer.
_LINK_HUNG_NS = 5_000_000_000


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


@dataclass(frozen=True, slots=True, eq=False)
class Localized:
    """A frame between the two halves of its way: what it came to, before that is sent.

    Attributes:
        state: of the vehicle at the exposure, as it was known then.
        circumstances: what else the outcome depended on.
    """

    frame: Frame
    outcome: Outcome
    state: VehicleState
    circumstances: Circumstances


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
        computer: ComputerReader | None = None,
        seek_with: Callable[[SearchSetup], Seeker] = SearchProcess,
        on_outcome: OutcomeListener | None = None,
    ) -> None:
        """
        Args:
            frames: instead of ``config.camera``.
            matcher: instead of ``config.matcher``.
            computer: whose load and heat are looked at, instead of this one.
            seek_with: makes what searches the map, where ``config.search`` wants that.
            on_outcome: told of every outcome, in the worker's thread; must return at once.
        """
        self._config = config
        self._clock = clock or SystemClock()
        self._counts: Counter[str] = Counter()
        self._slot: LatestSlot[Frame | _Missed] = LatestSlot()
        self._desk = Desk()
        public_key = None if config.map.public_key is None else Path(config.map.public_key)
        with ExitStack() as resources:
            # Closed in reverse, also where a later part can't be had.
            self._store = resources.enter_context(
                MapStore(
                    Pack.open(Path(config.map.pack), public_key),
                    cache_bytes=config.map.cache_mb * 2**20,
                    memory_bytes=config.map.memory_mb * 2**20,
                    features=config.reads_features,
                    require_intact=config.map.require_intact,
                )
            )
            georeference = self._store.pack.georeference
            require_flyable(georeference, config.map.pack)
            self._matcher = matcher or configured_matcher(config.matcher)
            # In every life of the program another value, or the autopilot would not notice the restart.
            first_reset_counter = self._clock.now_ns() // _S
            self._navigator = make_navigator(
                config, self._store, self._matcher, first_reset_counter, config.timing.budget_ms
            )
            resources.callback(self._navigator.localizer.close)
            gimbal = config.mount.gimbal_selection()
            self._link = AutopilotLink(config.link, self._clock, gimbal, config.timing.max_age_ms)
            tracker = self._navigator.tracker
            self._vehicle = Vehicle(
                self._link, tracker, georeference, config.mount, config.attitude, self._clock, self._counts
            )
            self._finder = (
                resources.enter_context(closing(self._new_finder(config, seek_with))) if config.search.enabled else None
            )
            self._log = resources.enter_context(closing(self._flight_log(config))) if config.log.folder else None
            self._commander = Commander(
                self._navigator,
                self._store,
                self._link,
                self._clock,
                self._counts,
                self.statistics,
                lost_sigma_m=config.tracker.lost_sigma_m,
                log=self._log,
                snapshots=_snapshot_folder(config),
                search_in=None if self._finder is None else self._finder.search_in,
            )
            self._link.take_places(lambda place: self._desk.leave(lambda: self._commander.take_place(place)))
            self._bus = (
                resources.enter_context(closing(bus_of(config.bus, config.camera, os.environ)))
                if config.bus.enabled
                else None
            )
            page = resources.enter_context(closing(self._ground_page(config))) if config.page.enabled else None
            self._reporter = Reporter(
                self._link,
                config.link,
                config.mount.lever_arm_m,
                self._vehicle,
                self._navigator,
                self._store,
                self._counts,
                self._commander,
                computer or ComputerReader(),
                replaced=lambda: self._slot.replaced,
                camera=lambda: self._frames.counts() if isinstance(self._frames, Counting) else {},
                unix_minus_stamp_ns=self._unix_minus_stamp_ns,
                finder=self._finder,
                bus=self._bus,
                log=self._log,
                page=page,
                on_outcome=on_outcome,
            )
            source = frames or open_source(config.camera, self._clock, self._bus)
            self._frames = resources.enter_context(closing(source))
            self._resources = resources.pop_all()
        self._ended = threading.Event()
        self._capture_failure: BaseException | None = None
        self._capture_beat_ns = self._clock.now_ns()

    def _new_finder(self, config: Config, seek_with: Callable[[SearchSetup], Seeker]) -> Finder:
        working = self._navigator.localizer.working_camera
        camera = config.intrinsics.camera().resized(working.width, working.height)
        setup = SearchSetup(
            Path(config.map.pack),
            None if config.map.public_key is None else Path(config.map.public_key),
            camera,
            structs.replace(config.localizer, precomputed_features="never", calibrate=False),
            config.search.threads,
            config.search.max_mb,
            config.map.memory_mb * 2**20,
        )
        tracker, georeference = self._navigator.tracker, self._store.pack.georeference
        seeker = seek_with(setup)
        return Finder(config.search, seeker, tracker, config.tracker, georeference, camera, self._counts)

    def _unix_minus_stamp_ns(self) -> int:
        # A clock that somebody sets, in simulation, is its own date.
        return wall_clock_ns() - self._clock.now_ns() if isinstance(self._clock, SystemClock) else 0

    def _serve_bus(self, bus: Bus) -> None:
        bus.serve(
            {
                "config": lambda: ConfigMessage(config=without_secrets(self._config)),
                "stats": lambda: self._reporter.stats(self._clock.now_ns()),
            },
            self._on_command,
        )

    def _on_command(self, command: Command) -> Answer:
        """In a thread of the bus."""
        try:
            return self._desk.ask(lambda: self._carry_out(command), _COMMAND_WAIT_S)
        except BusyError as error:
            why, remedy = f"the frame path is busy: {error}", "ask again"
        except Exception as error:  # whoever asked is told; the flight goes on
            logger.exception("command %s", NAME_OF_COMMAND[type(command)])
            why, remedy = f"it failed ({error!r})", "see the daemon's messages"
        return CommandReply(command=NAME_OF_COMMAND[type(command)], accepted=False, reason=why, remedy=remedy)

    def _carry_out(self, command: Command) -> Answer:
        answer = self._commander.carry_out(command)
        self._reporter.publish_state(self._clock.now_ns())
        return answer

    def take_over(self, plan: Plan) -> None:
        """Go on with another configuration from the next frame on; in any thread, which waits for it.

        Raises: BusyError where the frame path does not come to it; then nothing has changed.
        """
        self._desk.ask(lambda: self._take_over(plan), _COMMAND_WAIT_S)

    def _take_over(self, plan: Plan) -> None:
        tuning = tuning_of(plan.config)
        if tuning != tuning_of(self._config):
            self._navigator.retune(tuning)
        if self._finder is not None:
            self._finder.retune(plan.config.tracker)
        self._navigator.ladder.allow(plan.config.timing.budget_ms, plan.config.ladder, self._clock.now_ns())
        self._vehicle.retune(plan.config.attitude)
        self._commander.lost_sigma_m = plan.config.tracker.lost_sigma_m
        if self._log is not None:
            self._log.limit(plan.config.log.max_mb)
        if self._bus is not None:
            self._bus.retune(plan.config.bus)
        # Last: until then what is in force is what it was.
        self._config = plan.config
        self._counts["reloads"] += 1
        self._reporter.remark = f"restart needed for {', '.join(plan.refused)}" if plan.refused else ""

    def _flight_log(self, config: Config) -> FlightLog:
        now_ns = self._clock.now_ns()
        return FlightLog(
            config.log,
            self._store.pack.georeference,
            {
                # A log is handed around.
                "config": json.dumps(without_secrets(config)),
                "pack": config.map.pack,
                "pack_sha256": self._store.pack.manifest_sha256,
                "matcher": self._matcher.name,
                "model_sha256": self._matcher.model_sha256,
            },
            started_ns=now_ns,
            unix_minus_stamp_ns=self._unix_minus_stamp_ns(),
        )

    def _ground_page(self, config: Config) -> GroundPage:
        # Not at the top: a vehicle without a page needs none of it.
        from ortholoc_edge.adapters.page.ground_page import GroundPage
        from ortholoc_edge.adapters.page.options import checked

        fixed = config.mount.body_from_camera() if config.mount.gimbal_selection() is None else None
        about = {"matcher": self._matcher.name, "vehicle": config.bus.vehicle}
        listen = checked(config.page, os.environ)

        def leave(command: Command) -> Future[Answer] | None:
            return self._desk.leave(lambda: self._carry_out(command))

        taker = leave if config.page.commands else None
        return GroundPage(listen, self._clock, self._store, config.intrinsics.camera(), fixed, about, taker)

    @property
    def link(self) -> AutopilotLink:
        return self._link

    @property
    def navigator(self) -> Navigator:
        return self._navigator

    def close(self) -> None:
        """Release what a daemon holds that is never run; `run` does that itself. Idempotent."""
        self._resources.close()

    def statistics(self) -> dict[str, Statistic]:
        """See :meth:`Reporter.statistics`."""
        return self._reporter.statistics()

    def run(self, stop: threading.Event, on_ready: Callable[[], None] = lambda: None) -> None:
        """Work until ``stop`` is set or the frames end, then release everything; once only.

        Args:
            on_ready: called once, before the first frame.
        Raises: OrtholocError where a part failed for good; systemd then starts afresh.
        """
        with self._resources as resources:
            resources.callback(self._say_goodbye)
            resources.callback(self._link.stop)
            # First: an autopilot's heart beats once a second, and until it was heard there is no attitude.
            self._link.start()
            self._warm_up()
            self._link.set_system_status(SystemStatus.STANDBY)
            capture = threading.Thread(target=self._capture, args=(stop,), name="capture", daemon=True)
            resources.callback(self._join_capture, capture, stop)
            self._capture_beat_ns = self._clock.now_ns()
            capture.start()
            if self._bus is not None:
                self._serve_bus(self._bus)
            resources.callback(systemd.notify, "STOPPING=1")
            systemd.notify("READY=1")
            on_ready()
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
            self._desk.serve()
            self.report()
            if item is None:
                if ended:
                    return
                continue
            try:
                if isinstance(item, _Missed):
                    self._reporter.publish(None, Rejected(item.stamp_ns, Reason.BAD_FRAME, item.why))
                elif self._commander.paused:
                    self._reporter.publish(item, Rejected(item.stamp_ns, Reason.PAUSED, "by command; send resume"))
                elif self._navigator.ladder.is_due(item.stamp_ns):
                    self._handle(item, stop)
                else:
                    self._counts["frames_skipped"] += 1
                errors = 0
            except Exception as error:  # one spot per thread, around one item (house style)
                errors += 1
                logger.exception("frame at %d ns", item.stamp_ns)
                frame = None if isinstance(item, _Missed) else item
                self._reporter.publish(frame, Rejected(item.stamp_ns, Reason.INTERNAL, repr(error)))
                if errors >= _MAX_ERRORS_IN_A_ROW:
                    raise OrtholocError(f"{errors} frames in a row failed, last with {error!r}") from error

    def report(self) -> None:
        """Tell the autopilot, the ground station and systemd how it goes, where it is time for that."""
        self._reporter.step(self._clock.now_ns())

    def _feed_watchdog(self) -> None:
        """Called by the worker, so while that comes round; and only while the capture thread comes back from its reads
        and the link's from its line: a hung camera is no progress, nor are fixes that nobody is told."""
        now_ns = self._clock.now_ns()
        camera_lives = self._ended.is_set() or now_ns - self._capture_beat_ns <= _CAPTURE_HUNG_NS
        if camera_lives and now_ns - self._link.beat_ns <= _LINK_HUNG_NS:
            systemd.notify("WATCHDOG=1")

    def _warm_up(self) -> None:
        """The first inference allocates and compiles; it must not happen in flight."""
        self._navigator.localizer.warm_up()

    # -- one frame -------------------------------------------------------------------------------------

    def _handle(self, frame: Frame, stop: threading.Event) -> None:
        def proceed() -> bool:
            self._feed_watchdog()
            return self._age_ms(frame.stamp_ns) < self._config.timing.max_age_ms and not stop.is_set()

        self.settle(self.localize(frame, stop, proceed))

    # An owner of simulated time calls these two itself, without threads, and lets time pass between them.

    def localize(self, frame: Frame, stop: threading.Event, proceed: Callable[[], bool]) -> Localized:
        """What a frame comes to.

        Args:
            stop: when it is set, the autopilot's state at the exposure is taken as it is known, and not waited for.
            proceed: see `Localizer.localize`.
        """
        state = self._vehicle.at(frame.stamp_ns, stop)
        outcome = self._navigator.step(frame, state, proceed)
        assert self._navigator.last is not None
        return Localized(frame, outcome, state, self._navigator.last)

    def settle(self, localized: Localized) -> Outcome:
        """Send and publish it; returns the outcome, which is a rejection where a fix came too late to be sent."""
        frame, outcome = localized.frame, localized.outcome
        if isinstance(outcome, Fix):
            age_ms, limit_ms = self._age_ms(frame.stamp_ns), self._config.timing.max_age_ms
            if age_ms > limit_ms:
                # Good for the next prediction, but an autopilot would take it for newer than it is.
                late = Rejected(frame.stamp_ns, Reason.LATE, "a fix, but too old to send, ms", age_ms, limit_ms)
                outcome = replace(late, timings_ms=outcome.timings_ms)
            else:
                self._vehicle.tell(outcome, localized.state)
        step = localized.outcome, localized.state, localized.circumstances
        self._reporter.publish(frame, outcome, step)
        self._commander.note(frame, outcome, step)
        if self._finder is not None:
            self._search(self._finder, localized)
        return outcome

    def _search(self, finder: Finder, localized: Localized) -> None:
        try:
            order = finder.step(localized.frame, localized.state, localized.outcome, self._clock.now_ns())
        except Exception:  # the frame is settled; a defect of the search must not end the flight
            self._counts["search_errors"] += 1
            if self._counts["search_errors"] == 1:
                logger.exception("the search of the map")
            return
        if order is not None:
            logger.warning("the search: %s", order.why)
            self._navigator.give(order)
        for notice in finder.take_notices():
            self._link.send_status_text(Severity.WARNING, notice)

    def _age_ms(self, stamp_ns: int) -> float:
        return (self._clock.now_ns() - stamp_ns) / 1e6


def _snapshot_folder(config: Config) -> Path | None:
    if config.log.folder is not None:
        return Path(config.log.folder) / "snapshots"
    # systemd separates several by colons.
    state = os.environ.get("STATE_DIRECTORY", "").split(":")[0]
    return Path(state) / "snapshots" if state else None


def configured_matcher(options: MatcherOptions) -> AnyMatcher:
    """Raises: ModelError, ConfigError."""
    return make_method(
        options.name,
        working_px=options.working_px,
        max_keypoints=options.max_keypoints,
        threads=options.threads,
        model_path=None if options.model is None else Path(options.model),
        model_sha256=options.model_sha256,
        provider=options.provider,
    )


def tuning_of(config: Config) -> Tuning:
    """The options that a replay has to know of when they change."""
    return Tuning(gate=config.localizer.gate, tracker=config.tracker, witness=config.witness)


def make_navigator(
    config: Config,
    store: MapStore,
    matcher: AnyMatcher,
    first_reset_counter: int,
    budget_ms: float | None,
    ladder: Sequence[structural.Tuning] = structural.LADDER,
) -> Navigator:
    """Localizer and tracker as configured; the caller closes the localizer."""
    fixed = config.mount.body_from_camera() if config.mount.gimbal_selection() is None else None
    # A folder may hold a picture twice, and a video that was made for another rate does.
    alive = config.camera.is_live
    return Navigator(
        Localizer(config.intrinsics.camera(), store, matcher, config.localizer, ladder),
        Tracker(store.pack.georeference, fixed, config.tracker, first_reset_counter, config.witness),
        budget_ms,
        structs.replace(config.picture, refuse_repeated=config.picture.refuse_repeated and alive),
        config.ladder,
    )


def require_flyable(georeference: Georeference, pack: str) -> None:
    """Raises: MapError for a pack whose positions or heights mean nothing to an autopilot."""
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
