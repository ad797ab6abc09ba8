"""One setting of a profile in a process of its own: it flies a sequence step by step, as it is asked, and tells what
each step took.

Imports no more than the daemon would, but for the simulated autopilot's random numbers (3 MB): whatever else is
imported would count as the localizer's memory.
"""

from __future__ import annotations

import itertools
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import msgspec
from msgspec import Struct

from ortholoc_edge.bench import sequence
from ortholoc_edge.bench.metrics import PoseError
from ortholoc_edge.bench.pack_process import ANY_BYTES, MALLOC, memory_mb
from ortholoc_edge.bench.replay import PriorKind, PriorNoise, Timer, replay_flight
from ortholoc_edge.errors import DatasetError, OrtholocError
from ortholoc_edge.geometry.arrays import FloatArray, ImageArray
from ortholoc_edge.geometry.camera import Camera
from ortholoc_edge.matching.registry import make_method
from ortholoc_edge.matching.types import STRUCTURAL, AnyMatcher
from ortholoc_edge.pipeline import structural
from ortholoc_edge.pipeline.frame import Frame
from ortholoc_edge.pipeline.localizer import Localizer, LocalizerOptions
from ortholoc_edge.pipeline.outcome import Fix, Outcome
from ortholoc_edge.tiles.pack import Pack
from ortholoc_edge.tiles.store import MapStore

_END_S = 60.0


class Setting(Struct, frozen=True):
    """What is varied.

    Attributes:
        scale: resolution at which frames are matched, over full detail's.
        threads: of one inference.
        rung: of structural matching's ladder.
        working_px: of the matcher of features; None of structural matching alone, and of one that has its own.
    """

    matcher: str
    scale: float
    threads: int
    provider: str
    rung: int
    working_px: int | None
    max_keypoints: int

    @property
    def name(self) -> str:
        """Of the matcher, with the provider where it is not the usual one."""
        return self.matcher if self.provider == "cpu" else f"{self.matcher} ({self.provider})"

    @property
    def px(self) -> str:
        """Long sides at which frames are matched."""
        tracked = [structural.LADDER[self.rung].levels[-1].long_px] if self.matcher.startswith(STRUCTURAL) else []
        features = [] if self.working_px is None else [self.working_px]
        return " + ".join(map(str, tracked + features)) or "its own"

    @property
    def label(self) -> str:
        threads = f", {self.threads} threads" if self.threads > 1 else ""
        return f"{self.name} at {self.px} px{threads}"


class Source(Struct, frozen=True, kw_only=True):
    """What is flown.

    Attributes:
        flight: a folder of photos with their true poses, or of a flight log; or such a log (.mcap).
        pack: None: the one that the log names.
        prior, seed: of the simulated autopilot of recorded photos; a log has what the real one said.
        adhop, features: as in `LocalizerOptions`; of a log its own count.
    """

    flight: str
    pack: str | None
    prior: str = str(PriorKind.ODOMETER)
    seed: int = 0
    adhop: bool = True
    features: str = "auto"


class Started(Struct, frozen=True, kw_only=True):
    """A process that is ready for the first frame.

    Attributes:
        frames: of one pass. truth: whether their poses are known.
        load_ms, warm_up_ms: wall time for the matcher, and for the localizer's warm-up.
        peak_mb: highest resident memory so far.
    """

    frames: int
    truth: bool
    load_ms: float
    warm_up_ms: float
    peak_mb: float


class Flown(Struct, frozen=True, kw_only=True):
    """One step.

    Attributes:
        timings_ms: `Outcome.timings_ms`. wall_ms, cpu_ms: of the whole step, decoding the picture left out.
        position_m: of the fix; te_m, re_deg: its errors. None without a fix, or without truth.
    """

    timings_ms: dict[str, float]
    wall_ms: float
    cpu_ms: float
    rss_mb: float
    peak_mb: float
    position_m: tuple[float, float, float] | None
    te_m: float | None
    re_deg: float | None


class _Failed(Struct, frozen=True):
    error: str


_Answer = TypeVar("_Answer", Started, Flown)


class ProfileProcess:
    """A fresh Python process that flies one setting; it computes only when it is asked for a step."""

    def __init__(self, setting: Setting, source: Source) -> None:
        """Starts it and waits until it is ready. Raises: OrtholocError with what it said."""
        self._label = setting.label
        code = "from ortholoc_edge.bench.profile_process import serve; serve()"
        ask = msgspec.json.encode((setting, source)).decode()
        environment = {**os.environ, **MALLOC, "OPENBLAS_NUM_THREADS": "1"}
        self._process = subprocess.Popen(
            [sys.executable, "-c", code, ask], stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=environment
        )
        try:
            self.started = self._answer(Started)
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> ProfileProcess:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def step(self) -> Flown:
        """Fly the next frame; after the last the flight begins anew. Raises: OrtholocError with what it said."""
        assert self._process.stdin is not None
        with suppress(BrokenPipeError):  # it ended; the answer tells more
            self._process.stdin.write(b"\n")
            self._process.stdin.flush()
        return self._answer(Flown)

    def close(self) -> None:
        assert self._process.stdin is not None and self._process.stdout is not None
        with suppress(BrokenPipeError):
            self._process.stdin.close()
        try:
            # It may be in the middle of a step, whose answer the pipe takes.
            self._process.wait(timeout=_END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._process.stdout.close()

    def _answer(self, kind: type[_Answer]) -> _Answer:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            status = self._process.wait(_END_S)
            raise OrtholocError(f"{self._label}: its process ended with status {status}; out of memory, or see above")
        try:
            return msgspec.json.decode(line, type=kind)
        except msgspec.ValidationError:
            raise OrtholocError(f"{self._label}: {msgspec.json.decode(line, type=_Failed).error}") from None


def serve() -> None:
    """What `ProfileProcess` runs: a line of input, a step."""
    # An interrupt reaches all processes of a terminal; this one ends when its input does.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        _serve(*msgspec.json.decode(sys.argv[1], type=tuple[Setting, Source]))
    except OrtholocError as err:
        _say(_Failed(str(err)))


def _serve(setting: Setting, source: Source) -> None:
    start = time.perf_counter()
    matcher = make_method(
        setting.matcher,
        # Those that have none take no notice of it.
        working_px=setting.working_px or 640,
        max_keypoints=setting.max_keypoints,
        threads=setting.threads,
        provider=setting.provider,
    )
    load_ms = (time.perf_counter() - start) * 1e3
    with ExitStack() as stack:
        flight = _opened(setting, source, matcher, stack)
        start = time.perf_counter()
        flight.localizer.warm_up()
        _say(
            Started(
                frames=flight.frames,
                truth=flight.truth,
                load_ms=load_ms,
                warm_up_ms=(time.perf_counter() - start) * 1e3,
                peak_mb=memory_mb()[1],
            )
        )
        for _, flown in zip(sys.stdin, flight.steps, strict=False):
            _say(flown)


def _say(answer: Started | Flown | _Failed) -> None:
    sys.stdout.buffer.write(msgspec.json.encode(answer) + b"\n")
    sys.stdout.buffer.flush()


@dataclass(frozen=True, slots=True, eq=False)
class _Flight:
    """What is flown, over and over.

    Attributes:
        localizer: that of the first frame, for warming up.
    """

    localizer: Localizer
    frames: int
    truth: bool
    steps: Iterator[Flown]


def _opened(setting: Setting, source: Source, matcher: AnyMatcher, stack: ExitStack) -> _Flight:
    # Late: a recorded flight needs neither what reads logs nor the daemon.
    if Path(source.flight).suffix == ".mcap" or any(Path(source.flight).glob("flight-*.mcap")):
        return _logged(setting, source, matcher, stack)
    return _recorded(setting, source, matcher, stack)


def _ladder(setting: Setting) -> tuple[structural.Tuning]:
    return (structural.LADDER[setting.rung],)


@dataclass(frozen=True, slots=True, eq=False)
class _Decoded(sequence.RecordedFrame):
    """A recorded frame whose picture is there, as the camera hands it over: decoding is no part of a step."""

    picture: ImageArray

    def image(self) -> ImageArray:
        return self.picture


def _recorded(setting: Setting, source: Source, matcher: AnyMatcher, stack: ExitStack) -> _Flight:
    if source.pack is None:
        raise DatasetError(f"{source.flight}: a recorded flight names no pack; give --pack")
    recorded = sequence.read_flight(Path(source.flight))
    store = stack.enter_context(
        MapStore(Pack.open(Path(source.pack)), features=source.features != "never", memory_bytes=ANY_BYTES)
    )
    options = msgspec.convert({"adhop": source.adhop, "precomputed_features": source.features}, LocalizerOptions)
    localizers: dict[Camera, Localizer] = {}

    def localizer_for(camera: Camera) -> Localizer:
        if camera not in localizers:
            localizers[camera] = Localizer(camera, store, matcher, options, _ladder(setting))
            stack.callback(localizers[camera].close)
        return localizers[camera]

    def ground_m(xy_map: FloatArray) -> float:
        found_m = store.ground_near(xy_map)
        if found_m is None:
            raise DatasetError(
                f"{source.pack}: no surface model near ({xy_map[0]:.0f}, {xy_map[1]:.0f}), where {source.flight} was "
                "flown; is this the pack of this flight?"
            )
        return found_m

    def decoded() -> Iterator[sequence.RecordedFrame]:
        for record in recorded:
            yield _Decoded(
                record.name, record.path, record.stamp_ns, record.camera, record.map_from_camera, record.ned_from_body,
                record.image(),
            )  # fmt: skip

    def steps() -> Iterator[Flown]:
        for number in itertools.count():
            for result in replay_flight(
                decoded(),
                localizer_for,
                store.pack.georeference,
                ground_m,
                kind=PriorKind(source.prior),
                noise=PriorNoise(),
                seed=source.seed + number,
            ):
                yield _flown(result.outcome, result.error, result.cpu_ms, result.wall_ms)

    return _Flight(localizer_for(recorded[0].camera), len(recorded), True, steps())


def _logged(setting: Setting, source: Source, matcher: AnyMatcher, stack: ExitStack) -> _Flight:
    from ortholoc_edge.bench.flight_log import log_files, read_frames, read_header
    from ortholoc_edge.config import config_from_text
    from ortholoc_edge.daemon import make_navigator

    logs = log_files(Path(source.flight))
    if not logs:
        raise DatasetError(f"{source.flight}: no flight log in it")
    header = read_header(logs[0])
    try:
        config = config_from_text(header.config)
    except ValueError as err:
        raise DatasetError(
            f"{logs[0]}: its configuration, of version {header.version}, is not understood ({err}); use that version"
        ) from err
    store = stack.enter_context(
        MapStore(Pack.open(Path(source.pack or header.pack)), features=config.reads_features, memory_bytes=ANY_BYTES)
    )
    if store.pack.manifest_sha256 != header.pack_sha256:
        raise DatasetError(f"{store.pack.path}: not the pack that was flown with, its manifest differs; name that one")
    frames = sum(1 for log in logs for one in read_frames(log) if one.image is not None)
    if not frames:
        raise DatasetError(
            f"{source.flight}: no frame with a picture without loss; such logs are written with [log] frames = \"all\""
        )
    first = make_navigator(config, store, matcher, 0, None, _ladder(setting))
    stack.callback(first.localizer.close)

    def steps() -> Iterator[Flown]:
        for _ in itertools.count():
            # What an earlier pass taught the tracker would be from the future.
            navigator = make_navigator(config, store, matcher, 0, None, _ladder(setting))
            try:
                for one in itertools.chain.from_iterable(map(read_frames, logs)):
                    if one.image is None:
                        continue
                    frame, state = Frame(one.record.stamp_ns, one.image, one.record.name), one.record.state()
                    timer = Timer()
                    outcome = navigator.step(frame, state)
                    yield _flown(outcome, None, *timer.spent_ms())
            finally:
                navigator.localizer.close()

    return _Flight(first.localizer, frames, False, steps())


def _flown(outcome: Outcome, error: PoseError | None, cpu_ms: float, wall_ms: float) -> Flown:
    rss_mb, peak_mb = memory_mb()
    position = None
    if isinstance(outcome, Fix):
        x, y, z = (float(v) for v in outcome.map_from_camera.translation)
        position = x, y, z
    return Flown(
        timings_ms=outcome.timings_ms,
        wall_ms=wall_ms,
        cpu_ms=cpu_ms,
        rss_mb=rss_mb,
        peak_mb=peak_mb,
        position_m=position,
        te_m=None if error is None else error.te_m,
        re_deg=None if error is None else error.re_deg,
    )
