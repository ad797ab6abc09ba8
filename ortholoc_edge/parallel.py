"""Pieces of work in this process, in others on this machine, or on a Dask cluster."""

from __future__ import annotations

import importlib
import os
import queue
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from itertools import islice
from multiprocessing import get_context
from pathlib import Path
from typing import Any, TypeVar

from ortholoc_edge.errors import ConfigError, OrtholocError

_PR_SET_PDEATHSIG = 1
_DASK_PATIENCE_S = 30.0
# Pieces that a thread of a cluster has before it.
_AHEAD = 4

_J = TypeVar("_J")
_R = TypeVar("_R")


@dataclass(frozen=True, slots=True)
class Workers:
    """Where pieces of work run.

    Attributes:
        processes: on this machine; 1 works in this process.
        dask: address of a Dask scheduler, instead of processes here.
    """

    processes: int = 1
    dask: str | None = None


@dataclass(frozen=True, slots=True)
class Purpose:
    """What the work is for, for messages.

    Attributes:
        name: "build", say.
        error: what is raised where workers fail.
    """

    name: str
    error: type[OrtholocError]


def run_all(
    jobs: Sequence[_J],
    work: Callable[[_J], _R],
    workers: Workers,
    purpose: Purpose,
    *,
    name: Callable[[_J], str],
    seen: Path,
) -> Iterator[tuple[_J, _R]]:
    """Do pieces of work and give each with its result, in any order.

    Args:
        jobs: unlike each other.
        work: what any process can import, and which gives its errors as values: those of libraries may not survive the
            way through a pipe. On a cluster a piece whose worker dies is done again elsewhere.
        name: of a piece, alike for the same piece and for no other.
        seen: a path that all Dask workers must see.
    Raises: ``purpose.error`` if a process dies, or all workers of a cluster; ConfigError without Dask.
    """
    if not jobs:
        return
    if workers.dask is not None:
        yield from _on_dask(jobs, work, workers.dask, purpose, name, seen)
    elif workers.processes <= 1 or len(jobs) == 1:
        for job in jobs:
            yield job, work(job)
    else:
        yield from _in_processes(jobs, work, min(workers.processes, len(jobs)), purpose)


def _in_processes(
    jobs: Sequence[_J], work: Callable[[_J], _R], processes: int, purpose: Purpose
) -> Iterator[tuple[_J, _R]]:
    # Spawned: a fork would copy GDAL's and OpenCV's locks in whatever state they are.
    pool = ProcessPoolExecutor(processes, get_context("spawn"), initializer=_start_worker, initargs=(os.getpid(),))
    try:
        running: dict[Future[_R], _J] = {}
        for job in jobs:
            running[pool.submit(work, job)] = job
            if len(running) < 2 * processes:
                continue
            yield from _collected(running)
        while running:
            yield from _collected(running)
    except BrokenProcessPool as err:
        raise purpose.error(
            f"a process of the {purpose.name} died, perhaps for lack of memory; use fewer: --jobs 1"
        ) from err
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def _collected(running: dict[Future[_R], _J]) -> Iterator[tuple[_J, _R]]:
    for future in wait(running, return_when=FIRST_COMPLETED).done:
        yield running.pop(future), future.result()


def _on_dask(
    jobs: Sequence[_J],
    work: Callable[[_J], _R],
    address: str,
    purpose: Purpose,
    name: Callable[[_J], str],
    seen: Path,
) -> Iterator[tuple[_J, _R]]:
    try:
        distributed: Any = importlib.import_module("dask.distributed")
    except ImportError as err:
        raise ConfigError("--dask needs Dask; install it with: pip install 'ortholoc-edge[dask]'") from err
    try:
        client = distributed.Client(address, timeout="5s", set_as_default=False)
    except (OSError, ValueError) as err:
        raise ConfigError(f"--dask {address}: no scheduler answers ({err}); start one with: dask scheduler") from err
    with client:
        check_seen(client, seen, address)
        futures: dict[Any, _J] = {}
        done: queue.Queue[Any] = queue.Queue()
        waiting = iter(jobs)

        def submit(most: int) -> None:
            # Some for each worker, not all at once: a hundred thousand would keep the first result waiting for minutes.
            for job in islice(waiting, most):
                future = client.submit(work, job, key=name(job), pure=False)
                futures[future] = job
                future.add_done_callback(done.put)

        submit(_AHEAD * max(1, sum(client.nthreads().values())))
        try:
            while futures:
                try:
                    future = done.get(timeout=_DASK_PATIENCE_S)
                except queue.Empty as err:
                    # A scheduler whose workers have all gone waits for new ones, for ever.
                    if not client.scheduler_info()["workers"]:
                        raise purpose.error(
                            f"--dask {address}: all workers have gone; start some and begin the {purpose.name} again"
                        ) from err
                    continue
                if future.status != "finished":
                    raise purpose.error(
                        f"--dask {address}: a task failed ({future.exception()}); see the workers' logs"
                    )
                job, result = futures.pop(future), future.result()
                submit(1)
                yield job, result
        finally:
            client.cancel(list(futures))


def check_seen(client: Any, path: Path, address: str) -> None:
    """Raises: ConfigError if a cluster has no workers, or one that does not see a path."""
    try:
        seen = client.run(Path.exists, path)
    except (ImportError, AttributeError, ValueError) as err:
        raise ConfigError(f"--dask {address}: workers do not answer ({err})") from err
    if not seen:
        raise ConfigError(f"--dask {address}: the scheduler has no workers; start some with: dask worker {address}")
    blind = sorted(worker for worker, there in seen.items() if not there)
    if blind:
        raise ConfigError(
            f"--dask {address}: worker {blind[0]} does not see {path}; sources and output must lie on a file system"
            " that all workers share, under one path"
        )


def _start_worker(parent: int) -> None:
    if sys.platform == "linux":
        # A worker must not live on when the build is killed.
        import ctypes

        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
        if os.getppid() != parent:
            os._exit(1)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
