"""A localizer in a process of its own, as the daemon has it, so that its memory and CPU time are its own.

Imports no more than that needs: whatever else is imported would count as the localizer's memory.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from msgspec import Struct

from ortholoc_edge.bench import metrics, sequence
from ortholoc_edge.bench.replay import PriorNoise, prior_with_errors
from ortholoc_edge.errors import CameraError, DatasetError, MapError
from ortholoc_edge.geometry.camera import Camera
from ortholoc_edge.matching.registry import make_method
from ortholoc_edge.matching.types import STRUCTURAL
from ortholoc_edge.pipeline.frame import Frame
from ortholoc_edge.pipeline.localizer import Localizer, LocalizerOptions
from ortholoc_edge.pipeline.outcome import Fix
from ortholoc_edge.tiles.pack import Pack
from ortholoc_edge.tiles.store import CACHE_BYTES, MapStore

# A pack to hold in a benchmark's memory: whatever there is.
ANY_BYTES = 2**40
_MB = 1e6
# As the systemd unit has them: without, freed memory stays with the process.
MALLOC = {"MALLOC_ARENA_MAX": "2", "MALLOC_MMAP_THRESHOLD_": "4000000", "MALLOC_TRIM_THRESHOLD_": "16000000"}


def pack_km2(pack: Pack) -> float:
    """Of orthophoto with data."""
    dop = pack.manifest.dop
    return sum(t.width * t.height * t.valid_fraction for t in dop.tiles) * dop.lattice.pixel_m**2 / 1e6


class Step(Struct, frozen=True, kw_only=True):
    """One frame in a worker.

    Attributes:
        cpu_ms: of the process, all threads, without reading the photo.
        rss_mb: after the frame; peak_mb: highest so far.
        te_m: None without a fix.
    """

    cpu_ms: float
    wall_ms: float
    rss_mb: float
    peak_mb: float
    te_m: float | None


class Started(Struct, frozen=True, kw_only=True):
    """Resident memory (MB) on the way to the first frame: after the imports, with the model, with the pack."""

    imported_mb: float
    model_mb: float
    pack_mb: float
    compressed_mb: float
    km2: float
    frames: int


class LocalizerProcess:
    """A fresh Python process with a store, a matcher and a localizer, as the daemon has them, and nothing else."""

    def __init__(
        self,
        pack: Path,
        flight: Path,
        *,
        matcher: str = STRUCTURAL,
        features: bool = False,
        cache_bytes: int = CACHE_BYTES,
    ) -> None:
        """Starts it. Raises: MapError if it can't begin, with what it said."""
        code = "from ortholoc_edge.bench.pack_process import serve; serve()"
        ask = json.dumps(
            {"pack": str(pack), "flight": str(flight), "matcher": matcher, "features": features, "cache": cache_bytes}
        )
        environment = {**os.environ, **MALLOC, "OPENBLAS_NUM_THREADS": "1"}
        self._process = subprocess.Popen(
            [sys.executable, "-c", code, ask], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment
        )
        self.started = Started(**self._answer())

    def __enter__(self) -> LocalizerProcess:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def frame(self, index: int, seed: int) -> Step:
        """Localize a photo from its true pose with the noise of ``seed``."""
        assert self._process.stdin is not None
        # Drawn here: numpy.random would stay in the process's memory, and nothing that flies loads it.
        errors = np.random.default_rng([seed, index]).normal(size=6)
        self._process.stdin.write(json.dumps([index, errors.tolist()]) + "\n")
        self._process.stdin.flush()
        return Step(**self._answer())

    def close(self) -> None:
        assert self._process.stdin is not None and self._process.stdout is not None
        self._process.stdin.close()
        self._process.stdout.close()
        self._process.wait(timeout=60)

    def _answer(self) -> dict[str, Any]:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            raise MapError(f"the benchmark's localizer process ended with status {self._process.wait(60)}; see above")
        answer: dict[str, Any] = json.loads(line)
        return answer


def serve() -> None:
    """What `LocalizerProcess` runs: answers a line of a photo and its prior's errors by the figures of that frame."""
    ask = json.loads(sys.argv[1])
    imported = memory_mb()[0]
    matcher = make_method(ask["matcher"], working_px=640, max_keypoints=4096, threads=1)
    recorded = sequence.read_flight(Path(ask["flight"]))
    with_model = memory_mb()[0]
    pack = Pack.open(Path(ask["pack"]))
    localizers: dict[Camera, Localizer] = {}
    with MapStore(pack, features=ask["features"], cache_bytes=ask["cache"], memory_bytes=ANY_BYTES) as store:
        _say(imported_mb=imported, model_mb=with_model, pack_mb=memory_mb()[0],
             compressed_mb=store.compressed_bytes / _MB, km2=pack_km2(pack), frames=len(recorded))  # fmt: skip
        for line in sys.stdin:
            index, errors = json.loads(line)
            record = recorded[index]
            if record.camera not in localizers:
                localizers[record.camera] = Localizer(record.camera, store, matcher, LocalizerOptions())
            _say(**_stepped(record, store, localizers[record.camera], errors))
        for localizer in localizers.values():
            localizer.close()


def _stepped(
    record: sequence.RecordedFrame, store: MapStore, localizer: Localizer, errors: list[float]
) -> dict[str, Any]:
    truth = record.map_from_camera
    ground_m = store.ground_near(truth.translation[:2])
    height_m = float(truth.translation[2]) - (ground_m or 0.0)
    prior = prior_with_errors(truth, height_m, PriorNoise(), errors)
    try:
        frame = Frame(record.stamp_ns, record.image(), record.name)
    except CameraError as err:
        raise DatasetError(str(err)) from err
    wall, cpu = time.perf_counter(), time.process_time()
    outcome = localizer.localize(frame, prior)
    cpu_ms, wall_ms = (time.process_time() - cpu) * 1e3, (time.perf_counter() - wall) * 1e3
    rss, peak = memory_mb()
    te_m = metrics.pose_error(outcome, truth).te_m if isinstance(outcome, Fix) else None
    return {"cpu_ms": cpu_ms, "wall_ms": wall_ms, "rss_mb": rss, "peak_mb": peak, "te_m": te_m}


def _say(**facts: Any) -> None:
    sys.stdout.write(json.dumps(facts) + "\n")
    sys.stdout.flush()


def memory_mb() -> tuple[float, float]:
    """Resident memory of this process and the highest it was (MB of 10^6), as the kernel counts."""
    found = {}
    for line in Path("/proc/self/status").read_text().splitlines():
        key, _, rest = line.partition(":")
        if key in ("VmRSS", "VmHWM"):
            found[key] = int(rest.split()[0]) * 1024 / _MB
    return found["VmRSS"], found["VmHWM"]


@dataclass(slots=True)
class MemoryRun:
    """A worker's way: how it started, and its frames."""

    started: Started
    steps: list[Step] = field(default_factory=list)

    @property
    def above_pack_mb(self) -> float:
        """Highest resident memory less the compressed pack."""
        return max(s.peak_mb for s in self.steps) - self.started.compressed_mb

    @property
    def fixed_share(self) -> float:
        return float(np.mean([s.te_m is not None for s in self.steps]))


def run_alone(process: LocalizerProcess, frames: int) -> MemoryRun:
    """``frames`` frames, the flight over and over with other noise."""
    run = MemoryRun(process.started)
    for k in range(frames):
        run.steps.append(process.frame(k % process.started.frames, k // process.started.frames))
    return run


def run_paired(first: LocalizerProcess, second: LocalizerProcess, frames: int) -> tuple[MemoryRun, MemoryRun]:
    """The same frames in turn, so that what else the machine does falls on both; who begins changes."""
    runs = MemoryRun(first.started), MemoryRun(second.started)
    pairs = list(zip((first, second), runs, strict=True))
    for k in range(frames):
        for process, run in pairs if k % 2 == 0 else reversed(pairs):
            run.steps.append(process.frame(k % first.started.frames, k // first.started.frames))
    return runs
