"""A scenario flown on simulated time: one loop owns the clock, so that the same scenario and seed give the same flight.

    autopilot and vehicle (`loop`) ⇄ bytes on a line (`line`) ⇄ the daemon's link, worker and reports, no threads

The daemon is the real one. What its threads would do at once takes the time that a scenario says: frames are there
``delay_ms`` after the exposure, the worker is busy for a latency drawn by lot, and the latest frame wins meanwhile.
"""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import rasterio

from ortholoc_edge.adapters.camera import CameraOptions
from ortholoc_edge.adapters.flight_log import LogOptions
from ortholoc_edge.adapters.mavlink.codec import FrameParser, dialect
from ortholoc_edge.clock import ManualClock
from ortholoc_edge.config import Config, MapOptions
from ortholoc_edge.daemon import Daemon, Localized
from ortholoc_edge.errors import ConfigError
from ortholoc_edge.geometry.arrays import FloatArray, ImageArray
from ortholoc_edge.geometry.rigid import Rigid3
from ortholoc_edge.pipeline.finder import Answer, Ask
from ortholoc_edge.pipeline.frame import Frame
from ortholoc_edge.pipeline.navigator import TimingOptions
from ortholoc_edge.pipeline.outcome import Fix, Outcome
from ortholoc_edge.search_process import MapSeeker, SearchSetup
from ortholoc_edge.vehicle import STATE_WAIT_NS
from ortholoc_sim.autopilot import Message
from ortholoc_sim.line import End, Line, LineTransport
from ortholoc_sim.loop import STEP_NS, ClosedLoop, LoopOptions, true_camera_pose
from ortholoc_sim.rounded import rounded
from ortholoc_sim.scenario import Fault, FaultKind, LatencyTable, Scenario
from ortholoc_sim.site import Site
from ortholoc_sim.stage import Studio, make_grounds, pack_for
from ortholoc_sim.vehicle import VehicleOptions

logger = logging.getLogger(__name__)

_S = 1_000_000_000
_MS = 1_000_000
START_NS = 5_000 * _S
# The companion finds the autopilot and its time first.
_FIRST_FRAME_NS = 2_500 * _MS
_ONCE = ("clock_steps", "autopilot_reboots")
_NEVER_S = 1_000_000.0
# A frame that is refused before anything is matched.
_REFUSED_MS = 3.0
# The flight ends so long after the route, at the speed that was asked for.
_LEEWAY = 1.2
_ARRIVED_M = 15.0
# z of the 99th percentile of a normal distribution.
_P99 = 2.3263
_SMEARS_FROM_MS = 0.5
# More than any flight has; the disk's owner asked for the log.
_LOG_MB = 16_384
_KEPT_PICTURES, _KEPT_REFUSED = 6, 6


@dataclass(frozen=True, slots=True, eq=False)
class FlownFrame:
    """A frame that was localized or refused.

    Attributes:
        t_s, ready_s: of its exposure and of its outcome, since the start.
        truth: ``map_from_camera`` as it was.
        height_m: above ground, nominal.
        outcome: as published.
        picture: what the camera showed, of some frames.
    """

    t_s: float
    ready_s: float
    truth: Rigid3
    height_m: float
    outcome: Outcome
    picture: ImageArray | None


@dataclass(frozen=True, slots=True, eq=False)
class Flown:
    """A flight.

    Attributes:
        scenario, seed: that were flown.
        loop: for its samples and the autopilot's records.
        site: its frames.
        route_map_m: (N, 3) waypoints.
        pack: of the daemon.
        frames: in the order of their outcomes.
        exposed: frames taken by the camera; replaced: those that a newer one replaced.
        said: STATUSTEXT of the daemon, with the time since the start.
        statistics: the daemon's, at the end; of the last, if there were several.
        wall_s: how long it took: for people, not the same twice.
    """

    scenario: Scenario
    seed: int
    loop: ClosedLoop
    site: Site
    route_map_m: FloatArray
    pack: Path
    frames: tuple[FlownFrame, ...]
    exposed: int
    replaced: int
    said: tuple[tuple[float, str], ...]
    line: dict[str, int]
    statistics: dict[str, int | float | str | bool | None]
    wall_s: float

    @property
    def duration_s(self) -> float:
        return (self.loop.now_ns - START_NS) / _S


def fly(
    scenario: Scenario,
    seed: int,
    folder: Path,
    progress: Callable[[float], None] = lambda _: None,
    log: Path | None = None,
) -> Flown:
    """Fly ``scenario`` once.

    Args:
        seed: of sensor errors, gusts, noise, latencies and losses. The world's is the scenario's.
        folder: where packs are kept.
        progress: told the simulated seconds so far.
        log: folder for the daemon's flight log, which can be replayed.
    Raises: OrtholocError for what the daemon can't work with.
    """
    return _Flight(scenario, seed, folder, log).run(progress)


class _Camera:
    """Exposes frames on time and hands them over when they are there, with the scenario's faults."""

    def __init__(self, flight: _Flight, studio: Studio) -> None:
        self._flight, self._studio = flight, studio
        self._table = flight.scenario.camera
        self._period_ns = round(_S / self._table.rate_hz)
        self._due_ns = START_NS + _FIRST_FRAME_NS
        # (when it is there, order) of frames that are under way, and those that wait for their poses.
        self._way: list[tuple[int, int, Frame, Rigid3]] = []
        self._held: tuple[Frame, Rigid3] | None = None
        self._frozen: ImageArray | None = None
        self._order = 0
        self.exposed = 0

    def step(self, now_ns: int) -> None:
        """Take the pictures that are due. One is drawn when its last row has been read."""
        margin_ns = round((self._table.readout_ms / 2 + self._table.exposure_ms / 2) * _MS) + STEP_NS
        while self._due_ns + margin_ns <= now_ns:
            stamp_ns, self._due_ns = self._due_ns, self._due_ns + self._period_ns
            if not self._flight.fault("camera_stalls", stamp_ns):
                self._expose(stamp_ns)

    def arrived(self, now_ns: int) -> Iterator[tuple[Frame, Rigid3]]:
        """Frames that are there by now, with their true poses."""
        self._way.sort(key=lambda entry: entry[:2])
        while self._way and self._way[0][0] <= now_ns:
            _, _, frame, truth = self._way.pop(0)
            yield frame, truth

    def _expose(self, stamp_ns: int) -> None:
        number = self.exposed
        self.exposed += 1
        truth = self._flight.true_pose(stamp_ns)
        image = self._image(stamp_ns, number)
        image.flags.writeable = False
        late_ns = round(self._flight.scenario.miscalibration.stamp_late_ms * _MS)
        frame = Frame(stamp_ns + late_ns, image, f"{number:05d}", round(self._table.exposure_ms * _MS))
        there_ns = stamp_ns + round(self._table.delay_ms * _MS)
        late = self._flight.fault("frames_late", stamp_ns)
        if late is not None and late.amount is not None:
            there_ns += round(late.amount * _MS)
        if self._flight.fault("frames_out_of_order", stamp_ns) and number % 2 == 0:
            there_ns += round(1.1 * self._period_ns)
        self._put(there_ns, frame, truth)
        if self._flight.fault("frames_duplicated", stamp_ns):
            self._put(there_ns + round(0.45 * self._period_ns), frame, truth)

    def _put(self, there_ns: int, frame: Frame, truth: Rigid3) -> None:
        self._order += 1
        self._way.append((there_ns, self._order, frame, truth))

    def _image(self, stamp_ns: int, number: int) -> ImageArray:
        flight, seed = self._flight, self._flight.seed * 100_000 + number
        if flight.fault("frames_black", stamp_ns):
            return self._studio.black(seed)
        poses = [flight.true_pose(stamp_ns + round(t_ms * _MS)) for t_ms in self._studio.row_times_ms()]
        if flight.fault("frames_of_water", stamp_ns):
            return self._studio.of_water(poses, seed)
        if flight.fault("frames_frozen", stamp_ns) and self._frozen is not None:
            return self._frozen.copy()
        smear = None
        if self._table.exposure_ms > _SMEARS_FROM_MS:
            half_ns = round(self._table.exposure_ms / 2 * _MS)
            smear = flight.true_pose(stamp_ns - half_ns), flight.true_pose(stamp_ns + half_ns)
        self._frozen = self._studio.picture(poses, smear, seed)
        return self._frozen.copy()


@dataclass(slots=True, eq=False)
class _Work:
    """The frame that the worker is at."""

    frame: Frame
    truth: Rigid3
    taken_ns: int
    localized: Localized | None = None
    ready_ns: int = 0


class _Worker:
    """The daemon's worker and its slot, without their threads: the latest frame wins, one at a time."""

    def __init__(self, flight: _Flight, daemon: Daemon, latency: LatencyTable) -> None:
        self._flight, self._latency = flight, latency
        self._daemon: Daemon | None = daemon
        self._rng = np.random.default_rng([flight.seed, 64])
        # Whether the autopilot's state is there is seen here; the daemon must not wait while time stands still.
        self._at_once = threading.Event()
        self._at_once.set()
        self._slot: tuple[Frame, Rigid3] | None = None
        self._work: _Work | None = None
        self.replaced = 0
        self.done: list[FlownFrame] = []
        self._kept_reasons: set[str] = set()
        self._kept_at_s = -math.inf

    def restart(self, daemon: Daemon | None) -> None:
        """What the one before was at is gone with it. None: there is none."""
        self._daemon, self._slot, self._work = daemon, None, None

    def put(self, frame: Frame, truth: Rigid3) -> None:
        if self._daemon is None:
            return
        self.replaced += self._slot is not None
        self._slot = frame, truth

    def step(self, now_ns: int) -> None:
        if self._work is None and self._slot is not None:
            self._work, self._slot = _Work(*self._slot, now_ns), None
        work, daemon = self._work, self._daemon
        if work is None or daemon is None:
            return
        if work.localized is None:
            known = daemon.link.state_at(work.frame.stamp_ns)
            waited = now_ns - work.taken_ns >= STATE_WAIT_NS
            if waited or (known is not None and known.interpolated):
                self._localize(daemon, work, now_ns)
        elif now_ns >= work.ready_ns:
            outcome = daemon.settle(work.localized)
            self.done.append(self._flown(work, outcome, now_ns))
            self._work = None

    def _localize(self, daemon: Daemon, work: _Work, now_ns: int) -> None:
        stamp_ns = work.frame.stamp_ns
        # The same numbers are drawn whatever becomes of the frame.
        log_sigma = math.log(self._latency.p99_ms / self._latency.median_ms) / _P99
        took_ms = self._latency.median_ms * math.exp(log_sigma * float(self._rng.standard_normal()))
        slow = self._flight.fault("computer_slow", stamp_ns)
        factor = 1.0 if slow is None or slow.amount is None else slow.amount
        searched_ms = 0.0

        def proceed() -> bool:
            nonlocal searched_ms
            searched_ms += factor * self._latency.hypothesis_ms
            return (now_ns - stamp_ns) / _MS + searched_ms < self._flight.scenario.timing.max_age_ms

        work.localized = daemon.localize(work.frame, self._at_once, proceed)
        outcome = work.localized.outcome
        spent_ms = took_ms * factor + searched_ms if "match" in outcome.timings_ms else _REFUSED_MS
        work.ready_ns = now_ns + round(spent_ms * _MS)

    def _flown(self, work: _Work, outcome: Outcome, now_ns: int) -> FlownFrame:
        t_s = (work.frame.stamp_ns - START_NS) / _S
        return FlownFrame(
            t_s, (now_ns - START_NS) / _S, work.truth, self._flight.scenario.route.height_agl_m, outcome,
            work.frame.image if self._is_kept(t_s, outcome) else None,
        )  # fmt: skip

    def _is_kept(self, t_s: float, outcome: Outcome) -> bool:
        """Some fixes over the flight, and the first refusal of each reason."""
        if isinstance(outcome, Fix):
            if t_s - self._kept_at_s < self._flight.duration_s / _KEPT_PICTURES:
                return False
            self._kept_at_s = t_s
            return True
        new = outcome.reason not in self._kept_reasons and len(self._kept_reasons) < _KEPT_REFUSED
        self._kept_reasons.add(outcome.reason)
        return new


class _Flight:
    def __init__(self, scenario: Scenario, seed: int, folder: Path, log: Path | None) -> None:
        self.scenario, self.seed = scenario, seed
        self._mount = scenario.miscalibration.true_mount(scenario.mount)
        self._log = LogOptions(folder=None if log is None else str(log), max_mb=_LOG_MB, frames="all")
        self._pack = pack_for(scenario, folder)
        self._grounds = make_grounds(scenario.world, scenario.map.kind)
        site = self._grounds.site
        # The ground is the same for all; its local frame is the autopilot's own.
        self._site = Site(site.georeference, site.anchor_map_m, scenario.autopilot.stack)
        self._clock = ManualClock(START_NS)
        self._route = self._route_map()
        length_m = float(np.linalg.norm(np.diff(self._route[:, :2], axis=0), axis=1).sum())
        table = scenario.route
        self._until_arrival = table.duration_s is None
        # Where it never gets to the end of its route, it is not waited for.
        self.duration_s = table.duration_s or _LEEWAY * length_m / table.speed_m_s + 20.0
        self._line = Line(scenario.line, seed)
        self._transport = LineTransport(self._line, self._clock)
        self._loop = ClosedLoop(self._site, self._loop_options(), START_NS)
        self._said: list[tuple[float, str]] = []
        self._text_parts: dict[int, str] = {}
        self._ours, self._theirs = FrameParser(), dialect.MAVLink(None, scenario.autopilot.system_id, 1)

    def fault(self, kind: FaultKind, now_ns: int) -> Fault | None:
        """The fault of a kind that is on at a time of our clock."""
        t_s = (now_ns - START_NS) / _S
        return next((fault for fault in self.scenario.fault if fault.kind == kind and fault.holds(t_s)), None)

    def true_pose(self, stamp_ns: int) -> Rigid3:
        """``map_from_camera`` at a time that was flown."""
        pose = true_camera_pose(self._loop, self._site, self._mount, stamp_ns)
        assert pose is not None, "frames are drawn when their time has passed"
        return pose

    def run(self, progress: Callable[[float], None]) -> Flown:
        # One environment of rasterio's for all steps: see `ClosedLoop.advance`.
        with rasterio.Env():
            return self._run(progress)

    def _run(self, progress: Callable[[float], None]) -> Flown:
        began = time.monotonic()
        first = self._new_daemon()
        daemon: Daemon | None = first
        try:
            camera = _Camera(self, Studio(self._grounds, self.scenario.camera))
            worker = _Worker(self, first, self.scenario.latency)
            end_ns = START_NS + round(self.duration_s * _S)
            happened: set[int] = set()
            while self._loop.now_ns < end_ns and not self._arrived():
                now_ns = self._loop.now_ns + STEP_NS
                self._apply_faults(now_ns, happened)
                killed = self.fault("daemon_killed", now_ns) is not None
                if killed and daemon is not None:
                    # What it holds is released, but nobody is told: it had no time for that.
                    daemon.close()
                    daemon = None
                    worker.restart(daemon)
                elif not killed and daemon is None:
                    daemon = self._new_daemon()
                    worker.restart(daemon)
                # What arrives meanwhile first: the line keeps the order in which it is handed frames.
                self._carry(daemon, now_ns)
                for message in self._loop.advance(now_ns):
                    self._send_as_autopilot(message, now_ns)
                if self.scenario.fixes:
                    camera.step(now_ns)
                    for frame, truth in camera.arrived(now_ns):
                        worker.put(frame, truth)
                    worker.step(now_ns)
                if daemon is not None:
                    daemon.report()
                    daemon.link.exchange(self._transport)
                progress((now_ns - START_NS) / _S)
            statistics = {} if daemon is None else daemon.statistics()
        finally:
            if daemon is not None:
                daemon.close()
        return Flown(
            self.scenario, self.seed, self._loop, self._site, self._route, self._pack, tuple(worker.done),
            camera.exposed, worker.replaced, tuple(self._said), dict(self._line.counts), statistics,
            time.monotonic() - began,
        )  # fmt: skip

    def _new_daemon(self) -> Daemon:
        daemon = Daemon(self._config(), frames=_NoFrames(), clock=self._clock, seek_with=self._seeker)
        daemon.navigator.localizer.warm_up()
        return daemon

    def _seeker(self, setup: SearchSetup) -> _Seeker:
        return _Seeker(setup, self._clock, round(self.scenario.latency.search_ms * _MS))

    def _arrived(self) -> bool:
        if not self._until_arrival or not self._loop.on_last_leg:
            return False
        # By what it believes: a vehicle that is lost ends where it thinks that the route ends.
        site = self._site
        believed = site.map_from_ned(site.ned_from_autopilot(self._loop.samples[-1].estimate_m))
        return float(np.hypot(*(believed - self._route[-1])[:2])) < _ARRIVED_M

    def _carry(self, daemon: Daemon | None, until_ns: int) -> None:
        """Let what is on the line arrive, each frame at its time."""
        while (next_ns := self._line.next_ns()) is not None and next_ns <= until_ns:
            self._clock.set_ns(max(next_ns, self._clock.now_ns()))
            end, data = self._line.take()
            if end is End.COMPANION:
                if daemon is not None:
                    self._transport.arrive(data)
                    daemon.link.exchange(self._transport)
                continue
            messages = self._ours.feed(data, next_ns)
            for message in messages:
                self._hear(message, next_ns)
            for answer in self._loop.receive(messages, next_ns):
                self._send_as_autopilot(answer, next_ns)
        self._clock.set_ns(until_ns)

    def _send_as_autopilot(self, message: Message, now_ns: int) -> None:
        data = bytes(message.pack(self._theirs))
        self._theirs.seq = (self._theirs.seq + 1) % 256
        self._line.wires[End.COMPANION].send(data, now_ns)

    def _hear(self, message: Message, now_ns: int) -> None:
        """Keep what the ground station would show; long texts come in parts."""
        if message.get_type() != "STATUSTEXT":
            return
        text = self._text_parts.pop(message.id, "") + message.text if message.id else message.text
        if message.id and len(message.text) == 50:
            self._text_parts[message.id] = text
        else:
            self._said.append(((now_ns - START_NS) / _S, text))

    def _apply_faults(self, now_ns: int, happened: set[int]) -> None:
        down = self.fault("line_down", now_ns) is not None
        self._line.wires[End.AUTOPILOT].down = down
        self._line.wires[End.COMPANION].down = down or self.fault("autopilot_mute", now_ns) is not None
        # Two of a kind may follow each other, and may be alike.
        for number, once in enumerate(self.scenario.fault):
            if once.kind not in _ONCE or number in happened or not once.holds((now_ns - START_NS) / _S):
                continue
            happened.add(number)
            if once.amount is not None:
                self._loop.step_clock(round(once.amount * _MS))
            else:
                self._loop.autopilot.reboot()

    # -- what it is made of ----------

    def _route_map(self) -> FloatArray:
        table = self.scenario.route
        width_m, height_m = self._grounds.size_m
        for east, north in table.waypoints_m:
            if not (0 <= east <= width_m and 0 <= north <= height_m):
                raise ConfigError(
                    f"scenario {self.scenario.name}: waypoint ({east:g}, {north:g}) lies outside the ground of "
                    f"{width_m:.0f} x {height_m:.0f} m"
                )
        xy = rounded(np.array(table.waypoints_m), table.corner_radius_m) + self._grounds.low_m
        return np.column_stack([xy, np.full(len(xy), self._grounds.ground_m + table.height_agl_m)])

    def _loop_options(self) -> LoopOptions:
        scenario = self.scenario
        towards = math.radians(scenario.wind.from_deg + 180.0)
        speed = scenario.wind.speed_m_s
        wind = (speed * math.cos(towards), speed * math.sin(towards), 0.0)
        return LoopOptions(
            self._route, scenario.route.speed_m_s, scenario.route.climb_m, _NEVER_S, scenario.gnss,
            VehicleOptions(wind_ned_m_s=wind, gust_m_s=scenario.wind.gust_m_s),
            scenario.autopilot.options(self.seed + 3, None if scenario.gimbal is None else scenario.gimbal.options()),
            self.seed,
        )  # fmt: skip

    def _config(self) -> Config:
        scenario = self.scenario
        return Config(
            camera=CameraOptions(source="device:unused"),
            intrinsics=scenario.miscalibration.told(scenario.camera.intrinsics()),
            map=MapOptions(pack=str(self._pack)),
            link=scenario.link,
            mount=scenario.mount,
            matcher=scenario.matcher,
            tracker=scenario.tracker,
            witness=scenario.witness,
            attitude=scenario.attitude,
            search=scenario.search,
            # No budget: the ladder of detail goes by wall time, which is not the same twice.
            timing=TimingOptions(max_age_ms=scenario.timing.max_age_ms, budget_ms=math.inf),
            log=self._log,
        )


class _Seeker:
    """Searches at once, and has the answer when the scenario's time for it has passed."""

    def __init__(self, setup: SearchSetup, clock: ManualClock, took_ns: int) -> None:
        self._seeker, self._clock, self._took_ns = MapSeeker(setup), clock, took_ns
        self._answer: tuple[int, Answer] | None = None

    @property
    def idle(self) -> bool:
        return self._answer is None

    def ask(self, ask: Ask) -> None:
        answer = replace(self._seeker.answer(ask), took_s=self._took_ns / _S)
        self._answer = self._clock.now_ns() + self._took_ns, answer

    def take(self) -> Answer | None:
        if self._answer is None or self._clock.now_ns() < self._answer[0]:
            return None
        answer, self._answer = self._answer[1], None
        return answer

    def close(self) -> None:
        self._seeker.close()


class _NoFrames:
    """In place of a camera: frames are handed over by the owner of time."""

    def read(self, timeout_s: float) -> Frame | None:
        return None

    def close(self) -> None:
        pass
