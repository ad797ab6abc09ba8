"""Hours of flight of the installed daemon, watched for what grows: memory, threads, descriptors, pauses, logs."""

from __future__ import annotations

import csv
import math
import multiprocessing
import statistics
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from ortholoc_edge.bench.flight_log import log_files, read_frames, read_header
from ortholoc_edge.bench.metrics import Spread
from ortholoc_edge.errors import DatasetError, OrtholocError
from ortholoc_sim.browser import watch
from ortholoc_sim.rig import Rig, RigOptions
from ortholoc_sim.service_faults import WRONG_M
from ortholoc_sim.supervised import vitals

_EVERY_S = 10.0
# What is loaded, allocated and cached first is no growth.
SETTLED_S = 300.0
# Of the beginning, once settled, and of the end; a shorter soak has windows of a quarter of what is left.
_WINDOW_S = 600.0
_LOG_MB = 64
_LEAST_FIXED = 0.9
_MIB = 2**20


@dataclass(frozen=True, slots=True)
class Moment:
    """What was seen at one time.

    Attributes:
        t_s: since the daemon was ready.
        rss_mib, threads, descriptors, cpu_s: of the daemon.
        fixes, rejected: so far, as the bus brought them.
        autopilot_error_m: how far off the autopilot believed itself to be.
        log_mib: of all flight logs in the folder.
    """

    t_s: float
    rss_mib: float
    threads: int
    descriptors: int
    cpu_s: float
    fixes: int
    rejected: int
    autopilot_error_m: float
    log_mib: float


@dataclass(frozen=True, slots=True)
class SoakReport:
    """What hours came to; "first" and "last" are medians of a window once settled and of the last.

    Attributes:
        rss_growth: last over first, less one. rss_slope_mib_per_h: median of slopes over half the time.
        longest_pause_s: between two signs of life to the watchdog, of which ``watchdog_s`` are allowed.
        restarts: lives of the daemon beyond the first. exit_code: after SIGTERM.
        logs, log_steps, log_damaged: files left by the rotation, steps in them, and files that could not be read whole.
        problems: why it has not passed.
    """

    hours: float
    rate_hz: float
    fixes: int
    rejected: int
    fix_error_m: Spread
    autopilot_error_m: Spread
    cpu_percent: float
    rss_first_mib: float
    rss_last_mib: float
    rss_max_mib: float
    rss_growth: float
    rss_slope_mib_per_h: float
    threads_first: float
    threads_last: float
    descriptors_first: float
    descriptors_last: float
    longest_pause_s: float
    watchdog_s: float
    restarts: int
    exit_code: int | None
    logs: int
    log_steps: int
    log_damaged: int
    log_mib: float
    counters: dict[str, Any]
    problems: tuple[str, ...]


def soak(
    out: Path, hours: float, rate_hz: float, on_moment: Callable[[Moment], None] = lambda _: None
) -> SoakReport:
    """Fly for so long, with flight log, bus and a watched ground page.

    Args:
        out: folder for the rig's files and ``soak.csv``, which has each moment as it comes.
    Raises: OrtholocError if the rig can't be set up or the aircraft falls.
    """
    seconds = hours * 3600.0
    options = RigOptions(rate_hz=rate_hz, settings={"log": {"max_mb": _LOG_MB}})
    moments: list[Moment] = []
    counters: dict[str, Any] = {}
    with ExitStack() as resources:
        rig = resources.enter_context(Rig(out / "rig", options))
        rig.wait_for(lambda: rig.supervisor.is_ready, "READY=1")
        begun_s, looks = time.monotonic(), 0
        resources.callback(_watched(rig.page_port))
        file = resources.enter_context((out / "soak.csv").open("w", newline="", encoding="utf-8"))
        table = csv.DictWriter(file, [field.name for field in fields(Moment)])
        table.writeheader()
        while time.monotonic() - begun_s < seconds:
            rig.fly_until(begun_s + looks * _EVERY_S)
            looks += 1
            try:
                moment = _look(rig, time.monotonic() - begun_s)
            except OrtholocError:
                # Between two lives; that it has a second one is counted at the end.
                continue
            moments.append(moment)
            table.writerow(asdict(moment))
            file.flush()
            on_moment(moment)
        counters = rig.ask("stats")["statistics"]
        restarts = rig.supervisor.count("started") - 1
        pause_s, watchdog_s = rig.supervisor.longest_pause_s, rig.supervisor.rules.watchdog_s
        exit_code = rig.stop_daemon()
        # Of one whose time is nowhere near the flight's there is no error to tell.
        errors = [math.inf if fix.error_m is None else fix.error_m for fix in rig.fixes]
        logs = _logs(rig.log_folder)
    return _report(moments, hours, rate_hz, errors, restarts, pause_s, watchdog_s, exit_code, logs, counters)


def _watched(port: int) -> Callable[[], None]:
    """A browser on the page; returns what ends it."""
    context = multiprocessing.get_context("spawn")
    stop = context.Event()
    browser = context.Process(target=watch, args=(port, stop), daemon=True)
    browser.start()

    def end() -> None:
        stop.set()
        browser.join(timeout=5.0)

    return end


def _look(rig: Rig, t_s: float) -> Moment:
    rig.fused()
    seen = vitals(rig.supervisor.pid)
    size = 0
    for path in rig.log_folder.glob("*.mcap"):
        try:
            size += path.stat().st_size
        except FileNotFoundError:
            # The rotation was faster.
            continue
    return Moment(
        t_s, seen.rss_mib, seen.threads, seen.descriptors, seen.cpu_s, len(rig.fixes), len(rig.rejections),
        rig.autopilot_error_m(), size / _MIB,
    )  # fmt: skip


@dataclass(frozen=True, slots=True)
class _Logs:
    files: int
    steps: int
    damaged: int
    mib: float


def _logs(folder: Path) -> _Logs:
    """Every log that the rotation left, read to its end."""
    files, steps, damaged, size = 0, 0, 0, 0
    for path in sorted(folder.glob("flight-*.mcap")):
        files += 1
        size += path.stat().st_size
        try:
            read_header(path)
            found = sum(1 for _ in read_frames(path))
        except DatasetError:
            found = 0
        steps += found
        damaged += not found or not _is_whole(path)
    assert files == 0 or log_files(folder)
    return _Logs(files, steps, damaged, size / _MIB)


def _is_whole(path: Path) -> bool:
    """Whether it has MCAP's end, which is written when a file is finished."""
    with path.open("rb") as file:
        file.seek(-8, 2)
        return file.read() == b"\x89MCAP0\r\n"


def _report(
    moments: Sequence[Moment], hours: float, rate_hz: float, errors: list[float], restarts: int, pause_s: float,
    watchdog_s: float, exit_code: int | None, logs: _Logs, counters: dict[str, Any],
) -> SoakReport:  # fmt: skip
    settled = [m for m in moments if m.t_s >= min(SETTLED_S, 0.1 * hours * 3600.0)]
    window = max(1, min(round(_WINDOW_S / _EVERY_S), len(settled) // 4))
    first, last = settled[:window], settled[-window:]

    def median(of: Sequence[Moment], name: str) -> float:
        return float(statistics.median(getattr(moment, name) for moment in of))

    rss_first, rss_last = median(first, "rss_mib"), median(last, "rss_mib")
    growth = rss_last / rss_first - 1.0
    threads = median(first, "threads"), median(last, "threads")
    descriptors = median(first, "descriptors"), median(last, "descriptors")
    problems = []
    if not errors or moments[-1].fixes < _LEAST_FIXED * (moments[-1].fixes + moments[-1].rejected):
        problems.append(f"{moments[-1].fixes} fixes, {moments[-1].rejected} frames without one")
    if errors and max(errors) > WRONG_M:
        problems.append(f"a fix was {max(errors):.1f} m off")
    if counters.get("report_errors"):
        problems.append(f"{counters['report_errors']} errors of reporting")
    if growth > 0.05:
        problems.append(f"memory grew by {growth:.1%}")
    if threads[1] > threads[0]:
        problems.append(f"threads rose from {threads[0]:g} to {threads[1]:g}")
    if descriptors[1] > descriptors[0]:
        problems.append(f"descriptors rose from {descriptors[0]:g} to {descriptors[1]:g}")
    if pause_s > watchdog_s / 2:
        problems.append(f"the watchdog waited {pause_s:.1f} s; systemd wants to hear twice in {watchdog_s:g} s")
    if restarts or exit_code != 0:
        problems.append(f"{restarts} restarts, exit code {exit_code}")
    if logs.damaged or not logs.files:
        problems.append(f"{logs.damaged} of {logs.files} logs are damaged")
    if logs.mib > _LOG_MB:
        problems.append(f"logs of {logs.mib:.1f} MiB, limit {_LOG_MB}")
    return SoakReport(
        hours=hours, rate_hz=rate_hz, fixes=moments[-1].fixes, rejected=moments[-1].rejected,
        fix_error_m=Spread.of(errors), autopilot_error_m=Spread.of([m.autopilot_error_m for m in settled]),
        cpu_percent=100.0 * (moments[-1].cpu_s - moments[0].cpu_s) / max(moments[-1].t_s - moments[0].t_s, 1e-9),
        rss_first_mib=rss_first, rss_last_mib=rss_last, rss_max_mib=max(m.rss_mib for m in moments),
        rss_growth=growth, rss_slope_mib_per_h=_slope(settled),
        threads_first=threads[0], threads_last=threads[1],
        descriptors_first=descriptors[0], descriptors_last=descriptors[1],
        longest_pause_s=pause_s, watchdog_s=watchdog_s, restarts=restarts, exit_code=exit_code,
        logs=logs.files, log_steps=logs.steps, log_damaged=logs.damaged, log_mib=logs.mib, counters=counters,
        problems=tuple(problems),
    )  # fmt: skip


def _slope(moments: Sequence[Moment]) -> float:
    """MiB per hour, by the median of slopes between moments half the time apart."""
    half = len(moments) // 2
    pairs = zip(moments[:half], moments[-half:], strict=True)
    slopes = [(b.rss_mib - a.rss_mib) / (b.t_s - a.t_s) * 3600.0 for a, b in pairs if b.t_s > a.t_s]
    return statistics.median(slopes) if slopes else 0.0
