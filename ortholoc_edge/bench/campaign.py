"""Many samples, matchers and conditions through the paper's pipeline, on all cores or a cluster, and taken up again
where it was cut off.

The piece of work is one sample with one matcher. Its results are one line of ``results.jsonl``, so what a killed run
leaves is whole pieces and perhaps half a line, which is cut off.
"""

from __future__ import annotations

import dataclasses
import fcntl
import functools
import hashlib
import importlib.metadata
import os
import traceback
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO

import cv2
import msgspec
import numpy as np
from msgspec import Struct

from ortholoc_edge import __version__, parallel
from ortholoc_edge.bench.condition import Condition
from ortholoc_edge.bench.ground_truth import GroundTruthMatcher
from ortholoc_edge.bench.paper import PaperOptions, Result, Task, Trial
from ortholoc_edge.bench.samples import Sample, SampleFile, SampleKind, Split, read_sample
from ortholoc_edge.errors import ConfigError, DatasetError, OrtholocError
from ortholoc_edge.matching.registry import make_matcher
from ortholoc_edge.matching.types import Matcher
from ortholoc_edge.parallel import Purpose, Workers
from ortholoc_edge.pose import pnp

GROUND_TRUTH = GroundTruthMatcher().name
RESULTS, SETTINGS = "results.jsonl", "settings.json"

_PURPOSE = Purpose("benchmark", DatasetError)


class MatcherSetup(Struct, frozen=True, kw_only=True):
    """A matcher by what makes it; ``model_sha256`` is what it has to be on every machine."""

    name: str
    working_px: int
    max_keypoints: int
    model_sha256: str | None = None


class Settings(Struct, frozen=True, kw_only=True):
    """What all results of a run have in common; those of a run with others can't stand in one table with them.

    ``method``: raised when this program measures another thing than before. ``solver``: of the pose.
    ``opencv``, ``onnxruntime``: their versions, which SIFT and networks depend on.
    """

    method: int = 2
    version: str = __version__
    opencv: str = cv2.__version__
    onnxruntime: str = importlib.metadata.version("onnxruntime")
    solver: str = pnp.SOLVER
    working_px: int
    max_keypoints: int
    options: PaperOptions


class Piece(Struct, frozen=True, kw_only=True):
    """One line: a sample with one matcher, under all conditions that were asked for.

    Attributes:
        sample: path below the folder of the samples, or the file's name.
        mark: size and time of the sample's file.
        model_sha256: of the matcher.
        height_m: of the camera above the typical surface; tilt_deg: of its axis from straight down.
        pixel_m: of the map.
    """

    sample: str
    mark: str
    kind: SampleKind
    split: Split | None
    matcher: str
    model_sha256: str | None
    height_m: float
    tilt_deg: float
    pixel_m: float
    results: tuple[Result, ...]


class Failure(Struct, frozen=True):
    """A sample that could not be used, and why. ``fatal``: nor can others."""

    sample: str
    why: str
    fatal: bool = False


@dataclass(frozen=True, slots=True)
class Job:
    """What a worker gets.

    Attributes:
        conditions: with tasks and AdHoP settings for each.
    """

    path_of_sample: Path
    sample: str
    matcher: MatcherSetup
    conditions: tuple[Condition, ...]
    tasks: tuple[Task, ...]
    adhop: tuple[bool, ...]
    options: PaperOptions

    @property
    def key(self) -> str:
        return hashlib.sha256(repr(self).encode()).hexdigest()[:32]


@dataclass(frozen=True, slots=True)
class Plan:
    """What is asked for.

    Attributes:
        source: folder, or file, of the samples.
        conditions: by matcher: the truth as matches is under others than what looks at pictures.
    """

    source: Path
    files: Sequence[SampleFile]
    matchers: Sequence[MatcherSetup]
    conditions: Mapping[str, Sequence[Condition]]
    tasks: Sequence[Task]
    adhop: Sequence[bool]
    options: PaperOptions

    def jobs(self) -> list[Job]:
        """Sample by sample, so that a run cut off has all matchers of the first ones."""
        return [
            Job(
                file.path,
                self.name_of(file),
                setup,
                tuple(self.conditions[setup.name]),
                tuple(self.tasks),
                (False,) if setup.name == GROUND_TRUTH else tuple(self.adhop),
                self.options,
            )
            for file in self.files
            for setup in self.matchers
        ]

    def name_of(self, file: SampleFile) -> str:
        folder = self.source.absolute()
        return str(file.path.relative_to(folder)) if file.path.is_relative_to(folder) else file.path.name


def setup_of(name: str, working_px: int, max_keypoints: int) -> MatcherSetup:
    """With the model that is here. Raises: ConfigError, ModelError, see `make_matcher`."""
    setup = MatcherSetup(name=name, working_px=working_px, max_keypoints=max_keypoints)
    matcher = _matcher(setup)
    return setup if isinstance(matcher, GroundTruthMatcher) else msgspec.structs.replace(
        setup, model_sha256=matcher.model_sha256
    )


# -- the work --------------------------------------------------------------------------------------------


def run_job(job: Job) -> Piece | Failure:
    """In any process."""
    one_thread()
    try:
        return measured(job, read_sample(job.path_of_sample), checked_matcher(job.matcher))
    except DatasetError as error:
        return Failure(job.sample, str(error))
    except OrtholocError as error:
        return Failure(job.sample, str(error), fatal=True)
    except MemoryError:
        return Failure(job.sample, f"{job.sample}: out of memory; use fewer processes: --jobs 1", fatal=True)
    except Exception:
        return Failure(
            job.sample,
            f"{job.sample}, {job.matcher.name}: failed unexpectedly, please report it:\n{traceback.format_exc()}",
            fatal=True,
        )


def one_thread() -> None:
    """So that CPU times compare and workers don't fight."""
    cv2.setNumThreads(1)


def measured(job: Job, sample: Sample, matcher: Matcher | GroundTruthMatcher) -> Piece:
    """Raises: DatasetError for a sample without what is needed; ModelError if the matcher fails."""
    file = SampleFile.of(job.path_of_sample)
    results: list[Result] = []
    for condition in job.conditions:
        trial = Trial(sample, matcher, condition, job.options, any(job.adhop))
        results += trial.results(job.tasks, job.adhop)
    pose = sample.map_from_camera
    heights = sample.dsm[np.isfinite(sample.dsm)]
    return Piece(
        sample=job.sample,
        mark=mark_of(job.path_of_sample),
        kind=file.kind,
        split=file.split,
        matcher=job.matcher.name,
        model_sha256=job.matcher.model_sha256,
        height_m=float(pose.translation[2]) - (float(np.median(heights)) if len(heights) else 0.0),
        tilt_deg=float(np.degrees(np.arccos(np.clip(-pose.rotation[2, 2], -1.0, 1.0)))),
        pixel_m=sample.grid.gsd_m,
        results=tuple(results),
    )


def mark_of(path: Path) -> str:
    try:
        status = path.stat()
    except OSError as err:
        raise DatasetError(f"{path}: {err.strerror}; has it been moved?") from err
    return f"{status.st_size}-{status.st_mtime_ns}"


@functools.cache
def checked_matcher(setup: MatcherSetup) -> Matcher | GroundTruthMatcher:
    """The matcher of this process. Raises: ConfigError if its model is another than the run's."""
    matcher = _matcher(setup)
    if isinstance(matcher, GroundTruthMatcher) or matcher.model_sha256 == setup.model_sha256:
        return matcher
    raise ConfigError(
        f"matcher {setup.name}: this machine's model has SHA-256 {matcher.model_sha256}, the run's "
        f"{setup.model_sha256}; build it alike everywhere with: ortholoc-edge models build {setup.name}"
    )


def _matcher(setup: MatcherSetup) -> Matcher | GroundTruthMatcher:
    if setup.name == GROUND_TRUTH:
        return GroundTruthMatcher()
    return make_matcher(setup.name, working_px=setup.working_px, max_keypoints=setup.max_keypoints, threads=1)


# -- what was measured -----------------------------------------------------------------------------------


@dataclass(slots=True)
class Store:
    """Pieces by sample and matcher, on disk too where there is a folder. Owned by the process that plans; no other may
    have the same folder at the same time.

    Raises: ConfigError for a folder with a run of other settings, or that another run uses; OrtholocError where it
        can't be written.
    """

    settings: Settings
    folder: Path | None = None
    _pieces: dict[tuple[str, str], Piece] = field(default_factory=dict)
    _lock: IO[bytes] | None = None

    def __post_init__(self) -> None:
        if self.folder is None:
            return
        try:
            self._open(self.folder)
        except OSError as err:
            self.close()
            raise OrtholocError(f"{self.folder}: can't be used ({err}); choose another --out") from err
        except BaseException:
            self.close()
            raise

    def _open(self, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        # Until it is closed, or this process ends.
        self._lock = (folder / ".lock").open("ab")
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise ConfigError(f"{folder}: another run uses it; wait for it, or choose another --out") from None
        self._check_settings(folder / SETTINGS)
        self._read(folder / RESULTS)

    def close(self) -> None:
        """Let others use the folder."""
        if self._lock is not None:
            self._lock.close()

    def _check_settings(self, path: Path) -> None:
        try:
            before = msgspec.json.decode(path.read_bytes(), type=Settings)
        except FileNotFoundError:
            part = path.with_suffix(".part")
            part.write_bytes(msgspec.json.format(msgspec.json.encode(self.settings)) + b"\n")
            part.replace(path)
            return
        except msgspec.MsgspecError as err:
            raise ConfigError(f"{path}: not a benchmark's settings ({err}); choose another --out") from err
        ours, theirs = (msgspec.to_builtins(one) for one in (self.settings, before))
        other = [f"{key} {theirs[key]} instead of {ours[key]}" for key in ours if ours[key] != theirs[key]]
        if other:
            raise ConfigError(
                f"{self.folder}: holds a run with {'; '.join(other)}; go on with the same settings, or choose another "
                "--out"
            )

    def _read(self, path: Path) -> None:
        if not path.exists():
            return
        data = path.read_bytes()
        whole = data.rfind(b"\n") + 1
        if whole < len(data):
            # The end of a run that was cut off while it wrote.
            with path.open("r+b") as file:
                file.truncate(whole)
        for number, line in enumerate(data[:whole].splitlines(), 1):
            try:
                self._add(msgspec.json.decode(line, type=Piece))
            except msgspec.MsgspecError as err:
                raise DatasetError(f"{path}, line {number}: damaged ({err}); delete that line") from err

    def _add(self, piece: Piece) -> None:
        key = piece.sample, piece.matcher
        before = self._pieces.get(key)
        if before is not None and (before.mark, before.model_sha256) == (piece.mark, piece.model_sha256):
            # Later runs ask for other conditions.
            measured_again = {_case(result) for result in piece.results}
            kept = tuple(result for result in before.results if _case(result) not in measured_again)
            piece = msgspec.structs.replace(piece, results=kept + piece.results)
        self._pieces[key] = piece

    def write(self, piece: Piece) -> None:
        self._add(piece)
        if self.folder is None:
            return
        try:
            with (self.folder / RESULTS).open("ab") as file:
                file.write(msgspec.json.encode(piece) + b"\n")
                file.flush()
                os.fsync(file.fileno())
        except OSError as err:
            raise OrtholocError(f"{self.folder}: can't write results ({err}); free space and run again") from err

    def missing(self, job: Job) -> Job | None:
        """What of a job is not there yet; None if all is."""
        piece = self._current(job)
        if piece is None:
            return job
        there = {_case(result) for result in piece.results}
        conditions = tuple(
            condition
            for condition in job.conditions
            if any((condition, task, adhop) not in there for task in job.tasks for adhop in job.adhop)
        )
        if not conditions:
            return None
        return dataclasses.replace(job, conditions=conditions)

    def pieces(self, jobs: Sequence[Job]) -> list[Piece]:
        """Of these jobs, in their order, with the results that they ask for and no others."""
        found = []
        for job in jobs:
            piece = self._current(job)
            if piece is None:
                continue
            wanted = {(c, task, adhop) for c in job.conditions for task in job.tasks for adhop in job.adhop}
            results = tuple(result for result in piece.results if _case(result) in wanted)
            if results:
                found.append(msgspec.structs.replace(piece, results=results))
        return found

    def _current(self, job: Job) -> Piece | None:
        piece = self._pieces.get((job.sample, job.matcher.name))
        if piece is None or piece.model_sha256 != job.matcher.model_sha256:
            return None
        try:
            return piece if piece.mark == mark_of(job.path_of_sample) else None
        except DatasetError:
            return None


def _case(result: Result) -> tuple[Condition, Task, bool]:
    return result.condition, result.task, result.adhop


def run(plan: Plan, store: Store, workers: Workers) -> Iterator[tuple[int, int, Failure | None]]:
    """Measure what is not measured yet and write it to the store.

    Yields: pieces done, pieces in all (those of earlier runs are in both), and what went wrong with the last one.
    Raises: OrtholocError for what is wrong with more than one sample.
    """
    jobs = plan.jobs()
    waiting = [job for job in map(store.missing, jobs) if job is not None]
    done = len(jobs) - len(waiting)
    yield done, len(jobs), None
    for _, found in parallel.run_all(waiting, run_job, workers, _PURPOSE, name=lambda job: job.key, seen=plan.source):
        done += 1
        if isinstance(found, Failure):
            if found.fatal:
                raise OrtholocError(found.why)
            yield done, len(jobs), found
        else:
            store.write(found)
            yield done, len(jobs), None
