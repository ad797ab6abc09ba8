"""How long frames take at reduced resolutions, and what that costs: settings side by side over the same frames.

Each setting has a process of its own (`bench.profile_process`), which flies the sequence as the daemon would. They take
every frame in turn, one computing while the others wait, and another begins each time, so that what else the machine
does falls on all alike.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Final

import numpy as np
from msgspec import Struct

from ortholoc_edge.bench.metrics import FALSE_FIX_DEG, FALSE_FIX_M, RECALL_LIMITS, Latency, PoseError, Spread, recall
from ortholoc_edge.bench.profile_process import Flown, ProfileProcess, Setting, Source, Started
from ortholoc_edge.errors import ConfigError, OrtholocError
from ortholoc_edge.matching.registry import runs_network, takes_working_px
from ortholoc_edge.matching.types import STRUCTURAL
from ortholoc_edge.pipeline import structural

# Of XFeat's and ALIKED's networks; DISK's is half of it.
_MULTIPLE_PX: Final = 32
# As `config.MatcherOptions` has it.
_LEAST_PX: Final = 128
# More processes than this are likelier a mistake than a machine that holds them.
MOST_SETTINGS: Final = 24
# Left for the rest of the machine, MB, while processes are started.
_SPARE_MB: Final = 64.0
_STRICT: Final = "1m_1deg"
# Part of a frame's stages run beside each other, so that alone a frame takes less wall time than processor time.
BUSY: Final = 1.5


class Accuracy(Struct, frozen=True, kw_only=True):
    """Against the truth. Errors are over the fixes, ``recall`` over all frames; a fix is false beyond 10 m or 5
    degrees."""

    te_m: Spread
    re_deg: Spread
    recall: dict[str, float]
    false_fixes: int


class Agreement(Struct, frozen=True, kw_only=True):
    """Where there is no truth: with the most detailed setting of the same matcher.

    Attributes:
        same_verdict: part of the frames on which both have a fix, or both none.
        apart_m: between their fixes.
    """

    same_verdict: float
    apart_m: Spread


class Row(Struct, frozen=True, kw_only=True):
    """What a setting came to.

    Attributes:
        frames: flown, and of these ``timed`` without the first ones of the process.
        load_ms: of the matcher, its models with it. warm_up_ms: of the localizer, as the daemon does it at its start.
        first_ms: wall time of the first frame after it, which is not among the timed.
        frame_ms: wall time of a step of the navigator, from picture and state to outcome.
        stages_ms: `Outcome.timings_ms`; a stage may be within another.
        cpu_ms: of the process, all threads, per step.
        rss_mb: median after a frame; peak_mb: highest ever, loading included. In MB of 10^6.
        accuracy: None without truth. agreement: None with truth, or of the setting that the others are held against.
    """

    setting: Setting
    frames: int
    timed: int
    fixes: int
    load_ms: float
    warm_up_ms: float
    first_ms: float
    frame_ms: Latency
    stages_ms: dict[str, Latency]
    cpu_ms: Latency
    rss_mb: float
    peak_mb: float
    accuracy: Accuracy | None
    agreement: Agreement | None


class Bounds(Struct, frozen=True, kw_only=True):
    """What a recommended setting must keep.

    Attributes:
        rate_hz: the slowest of a hundred frames takes less than its inverse.
        recall_loss: recall within 1 m and 1 degree below the best setting's, at most; without truth: part of the frames
            on which the verdict may differ from full detail's.
        error_m: nine of ten fixes are nearer to the truth; without truth: to full detail's fixes.
    """

    rate_hz: float
    recall_loss: float = 0.02
    error_m: float = 1.0

    @property
    def limit_ms(self) -> float:
        return 1000.0 / self.rate_hz


class Recommendation(Struct, frozen=True, kw_only=True):
    """
    Attributes:
        row: index of the setting; None if none keeps the bounds.
        why: in words.
        config: lines of the daemon's configuration; empty without a row.
    """

    bounds: Bounds
    row: int | None
    why: str
    config: str


class Profile(Struct, frozen=True, kw_only=True):
    """The object that ``profile --json`` prints.

    Attributes:
        measured: command, date and machine.
        load: the machine's load averages (1 minute) at the beginning and the end.
        waited: wall time of a frame over its processor time, least of the settings that only the processor computes:
            about 1 on an idle machine, and wall times beyond ``BUSY`` are others' load. None if there are none.
        passes: over ``source``, each with noise of its own. warm_up_frames: of each setting, not timed.
        merged: what was asked for and is measured as another.
    """

    measured: str
    load: tuple[float, float]
    waited: float | None
    source: str
    pack: str
    prior: str
    seed: int
    passes: int
    warm_up_frames: int
    merged: list[str]
    rows: list[Row]
    recommendation: Recommendation | None


def settings(
    *,
    matchers: Sequence[str],
    scales: Sequence[float],
    threads: Sequence[int],
    working_px: int,
    max_keypoints: int,
    provider: str,
) -> tuple[list[Setting], list[str]]:
    """What is to be measured, the most detailed of each matcher first; and what of it is the same and measured once.

    A scale is of the resolution at which frames are matched: of ``working_px`` for a matcher of features, in steps that
    its network takes (none, of a network that has a size of its own); of structural matching the rung of its ladder
    that has that detail or more.
    Raises: ConfigError for a scale that leaves too little.
    """
    found: dict[tuple[str, int, int, int | None], Setting] = {}
    merged: dict[str, None] = {}
    for name in matchers:
        network = runs_network(name)
        for count in threads if network else [1]:
            for scale in sorted(set(scales), reverse=True):
                setting = _setting(name, scale, count, working_px, max_keypoints, provider if network else "cpu")
                key = name, count, setting.rung, setting.working_px
                if key in found:
                    merged[f"{name} has no detail of {scale:g}; it is measured as {setting.scale:g}"] = None
                found.setdefault(key, setting)
    if len(found) > MOST_SETTINGS:
        raise ConfigError(
            f"{len(found)} settings at once, each a process; {MOST_SETTINGS} are allowed: give fewer scales, matchers "
            "or threads"
        )
    return list(found.values()), list(merged)


def _setting(name: str, scale: float, threads: int, working_px: int, max_keypoints: int, provider: str) -> Setting:
    full_px = structural.LADDER[0].levels[-1].long_px
    rung, reached = 0, 1.0
    if name.startswith(STRUCTURAL):
        for number, tuning in enumerate(structural.LADDER):
            detail = tuning.levels[-1].long_px / full_px
            # Scales are written with few digits.
            if detail > scale - 1e-3:
                rung, reached = number, detail
    if not takes_working_px(name):
        return Setting(name, reached, threads, provider, rung, None, max_keypoints)
    step = _MULTIPLE_PX if runs_network(name) else 1
    px = round(scale * working_px / step) * step
    if px < _LEAST_PX:
        raise ConfigError(
            f"scale {scale:g} of --working-px {working_px} is {px} px; a matcher of features needs {_LEAST_PX} at least"
        )
    return Setting(name, px / working_px, threads, provider, rung, px, max_keypoints)


def measure(
    asked: Sequence[Setting],
    source: Source,
    *,
    passes: int,
    warm_up_frames: int,
    progress: Callable[[int, int], None],
) -> list[Row]:
    """Fly them, interleaved.

    Args:
        progress: told how many steps of how many are done.
    Raises: OrtholocError of a process that can't begin or fails, or if memory does not suffice for all.
    """
    with ExitStack() as stack:
        processes: list[ProfileProcess] = []
        for setting in asked:
            processes.append(stack.enter_context(ProfileProcess(setting, source)))
            _require_memory(processes, len(asked))
        frames = processes[0].started.frames
        if warm_up_frames >= passes * frames:
            raise ConfigError(
                f"{passes} passes over {frames} frames, and the first {warm_up_frames} are not timed: nothing is left; "
                "give more --passes"
            )
        flown: list[list[Flown]] = [[] for _ in processes]
        done, steps = 0, passes * frames * len(processes)
        for step in range(passes * frames):
            for number in _turn(step, len(processes)):
                flown[number].append(processes[number].step())
                done += 1
                progress(done, steps)
        return rows(asked, [one.started for one in processes], flown, warm_up_frames)


def waited(measured: Sequence[Row]) -> float | None:
    """See `Profile.waited`."""
    ratios = [row.frame_ms.median / row.cpu_ms.median for row in measured if row.setting.provider == "cpu"]
    return min(ratios, default=None)


def _turn(step: int, count: int) -> list[int]:
    """Who comes after whom; at each step another begins."""
    return [(step + k) % count for k in range(count)]


def _require_memory(processes: Sequence[ProfileProcess], wanted: int) -> None:
    left = available_mb()
    largest = max(one.started.peak_mb for one in processes)
    if len(processes) < wanted and left is not None and left < largest + _SPARE_MB:
        raise OrtholocError(
            f"{len(processes)} of {wanted} settings leave {left:.0f} MB of memory, and one takes up to {largest:.0f}; "
            "give fewer scales, matchers or threads at a time"
        )


def available_mb() -> float | None:
    """Memory that new processes can have, as Linux estimates; None elsewhere."""
    meminfo = Path("/proc/meminfo")
    lines = meminfo.read_text(encoding="ascii").splitlines() if meminfo.is_file() else []
    return next((int(line.split()[1]) * 1024 / 1e6 for line in lines if line.startswith("MemAvailable:")), None)


def rows(
    asked: Sequence[Setting], started: Sequence[Started], flown: Sequence[Sequence[Flown]], warm_up_frames: int
) -> list[Row]:
    """Sum up: ``flown`` holds the steps of each setting, of equal number."""
    # The most detailed comes first.
    full: dict[str, Sequence[Flown]] = {}
    found = []
    for setting, begun, steps in zip(asked, started, flown, strict=True):
        found.append(_row(setting, begun, steps, warm_up_frames, full.get(setting.matcher)))
        full.setdefault(setting.matcher, steps)
    return found


def _row(
    setting: Setting,
    started: Started,
    steps: Sequence[Flown],
    warm_up_frames: int,
    full: Sequence[Flown] | None,
) -> Row:
    timed = steps[warm_up_frames:]
    stages: dict[str, list[float]] = {}
    for step in timed:
        for stage, spent_ms in step.timings_ms.items():
            stages.setdefault(stage, []).append(spent_ms)
    return Row(
        setting=setting,
        frames=len(steps),
        timed=len(timed),
        fixes=sum(step.position_m is not None for step in steps),
        load_ms=started.load_ms,
        warm_up_ms=started.warm_up_ms,
        first_ms=steps[0].wall_ms,
        frame_ms=_latency([step.wall_ms for step in timed]),
        stages_ms={stage: _latency(spent) for stage, spent in stages.items()},
        cpu_ms=_latency([step.cpu_ms for step in timed]),
        rss_mb=float(np.median([step.rss_mb for step in timed])),
        peak_mb=max(started.peak_mb, *(step.peak_mb for step in steps)),
        accuracy=_accuracy(steps) if started.truth else None,
        agreement=None if started.truth or full is None else _agreement(steps, full),
    )


def _latency(spent_ms: Sequence[float]) -> Latency:
    median, p95, p99 = np.percentile(spent_ms, [50, 95, 99])
    return Latency(float(median), float(p95), float(p99))


def _accuracy(steps: Sequence[Flown]) -> Accuracy:
    errors = [
        PoseError(step.te_m, step.re_deg, nees=0.0)
        for step in steps
        if step.te_m is not None and step.re_deg is not None
    ]
    return Accuracy(
        te_m=Spread.of([error.te_m for error in errors]),
        re_deg=Spread.of([error.re_deg for error in errors]),
        recall=recall(errors, len(steps)),
        false_fixes=sum(error.is_false for error in errors),
    )


def _agreement(steps: Sequence[Flown], full: Sequence[Flown]) -> Agreement:
    pairs = [(one.position_m, other.position_m) for one, other in zip(steps, full, strict=True)]
    return Agreement(
        same_verdict=sum((one is None) == (other is None) for one, other in pairs) / len(pairs),
        apart_m=Spread.of([math.dist(one, other) for one, other in pairs if one is not None and other is not None]),
    )


def recommend(measured: Sequence[Row], bounds: Bounds) -> Recommendation:
    """Of the settings that keep the bounds the one of most detail, since other frames may be harder than these; of
    those alike the one that takes the least processor time."""
    refused = [_refusals(row, measured, bounds) for row in measured]
    kept = [number for number, reasons in enumerate(refused) if not reasons]
    if not kept:
        nearest = min(range(len(measured)), key=lambda number: measured[number].frame_ms.p99)
        row = measured[nearest]
        return Recommendation(
            bounds=bounds,
            row=None,
            why=f"none keeps {bounds.rate_hz:g} Hz and the accuracy; the fastest, {row.setting.label}: "
            f"{'; '.join(refused[nearest])}",
            config="",
        )
    best = min(kept, key=lambda number: (-measured[number].setting.scale, measured[number].cpu_ms.median))
    row = measured[best]
    return Recommendation(
        bounds=bounds,
        row=best,
        why=f"{row.setting.label}: 99 of 100 frames take {row.frame_ms.p99:.0f} ms at most, {bounds.limit_ms:.0f} are "
        f"allowed, with {row.cpu_ms.median:.0f} ms of processor time; the most detailed of {len(kept)} that keep the "
        "bounds",
        config=_config(row, measured, bounds),
    )


def _refusals(row: Row, measured: Sequence[Row], bounds: Bounds) -> list[str]:
    reasons = []
    if not row.frame_ms.p99 < bounds.limit_ms:
        reasons.append(f"99 of 100 frames take {row.frame_ms.p99:.0f} ms, {bounds.limit_ms:.0f} are allowed")
    if row.accuracy is not None:
        every = [one.accuracy for one in measured if one.accuracy is not None]
        best = max(one.recall[_STRICT] for one in every)
        if row.accuracy.recall[_STRICT] < best - bounds.recall_loss:
            reasons.append(f"recall is {100 * row.accuracy.recall[_STRICT]:.1f} %, the best {100 * best:.1f} %")
        p90 = row.accuracy.te_m.p90
        if p90 is None:
            reasons.append("it has no fix")
        elif p90 > bounds.error_m:
            reasons.append(f"a tenth of the fixes is {p90:.2f} m and more off, {bounds.error_m:g} are allowed")
        fewest = min(one.false_fixes for one in every)
        if row.accuracy.false_fixes > fewest:
            reasons.append(f"{row.accuracy.false_fixes} false fixes, the fewest are {fewest}")
    elif row.agreement is not None:
        if row.agreement.same_verdict < 1.0 - bounds.recall_loss:
            reasons.append(f"the verdict is full detail's on {100 * row.agreement.same_verdict:.1f} % of the frames")
        if row.agreement.apart_m.p90 is not None and row.agreement.apart_m.p90 > bounds.error_m:
            reasons.append(f"a tenth of the fixes is {row.agreement.apart_m.p90:.2f} m and more from full detail's")
    elif not row.fixes:
        reasons.append("it has no fix")
    return reasons


def _config(row: Row, measured: Sequence[Row], bounds: Bounds) -> str:
    setting = row.setting
    lines = ["[matcher]", f'name = "{setting.matcher}"']
    if setting.working_px is not None:
        lines += [f"working_px = {setting.working_px}", f"max_keypoints = {setting.max_keypoints}"]
    if runs_network(setting.matcher):
        lines += [f"threads = {setting.threads}", f'provider = "{setting.provider}"']
    lines += ["", "[timing]"]
    budget_ms = bounds.limit_ms
    if setting.rung:
        # The daemon takes a rung when the one above is over the budget, and leaves it when there is room again.
        above = [
            other.frame_ms.median for other in measured
            if other.setting.matcher == setting.matcher and other.setting.rung == setting.rung - 1
        ]  # fmt: skip
        if above and min(above) > row.frame_ms.median:
            budget_ms = min(budget_ms, math.sqrt(min(above) * row.frame_ms.median))
        lines.append(f"# at which the daemon leaves out detail until rung {setting.rung}")
    lines.append(f"budget_ms = {budget_ms:.1f}")
    return "\n".join(lines) + "\n"


# -- for people -----------------------------------------------------------------------------------------------------


def markdown(profile: Profile) -> str:
    """The tables, the recommendation, and what they come from."""
    begun, ended = profile.load
    timed = profile.rows[0].timed
    lines = [
        f"{profile.measured}, load {begun:.1f} to {ended:.1f}",
        "",
        f"{profile.source} on {profile.pack}, prior {profile.prior}, {profile.passes} passes, seed {profile.seed}: "
        f"{profile.rows[0].frames} frames with each setting, in turn; the first {profile.warm_up_frames} of each are "
        f"not timed, {timed} are." + ("" if timed >= 100 else " Of fewer than 100 the p99 is all but the largest."),
        *(f"{one}." for one in profile.merged),
        *_busy(profile.waited),
        "",
        *_table(profile),
        "",
        *_stage_table(profile.rows),
        "",
        *_start_table(profile.rows),
    ]
    if profile.recommendation is not None:
        lines += ["", f"For {profile.recommendation.bounds.rate_hz:g} Hz: {profile.recommendation.why}."]
        if profile.recommendation.config:
            lines += ["", "```toml", profile.recommendation.config.rstrip(), "```"]
    return "\n".join(lines) + "\n"


def _busy(ratio: float | None) -> Iterable[str]:
    if ratio is not None and ratio > BUSY:
        yield (
            f"The machine was busy: frames took {ratio:.1f} times their processor time, on an idle one about once. "
            "Measure wall times again when it is idle; processor times, memory and accuracy hold."
        )


def _table(profile: Profile) -> Iterable[str]:
    truth = profile.rows[0].accuracy is not None
    strict, wide = (name.replace("_", "-").replace("deg", "°") for name in list(RECALL_LIMITS)[:2])
    false = f"false fixes (> {FALSE_FIX_M:g} m, {FALSE_FIX_DEG:g}°)"
    last = (
        f"TE median / p90 m | RE median ° | recall {strict} | {wide} | {false} |"
        if truth
        else "fixes | verdict as full detail's | apart median / p90 m |"
    )
    heading = f"| matcher | scale | px | threads | frame ms median / p95 / p99 | CPU ms | RSS MB | {last}"
    yield heading
    yield "|" + "---|" * (heading.count("|") - 1)
    for row in profile.rows:
        setting = row.setting
        yield (
            f"| {setting.name} | {setting.scale:.2g} | {setting.px} | "
            f"{setting.threads if runs_network(setting.matcher) else '-'} | {_spent(row.frame_ms)} | "
            f"{row.cpu_ms.median:.0f} | {row.rss_mb:.0f} | {_judged(row)} |"
        )


def _spent(latency: Latency) -> str:
    return f"{latency.median:.0f} / {latency.p95:.0f} / {latency.p99:.0f}"


def _number(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def _judged(row: Row) -> str:
    if row.accuracy is not None:
        a = row.accuracy
        parts = [f"{100 * a.recall[name]:.1f} %" for name in list(RECALL_LIMITS)[:2]]
        return (
            f"{_number(a.te_m.median, 2)} / {_number(a.te_m.p90, 2)} | {_number(a.re_deg.median, 2)} | "
            f"{' | '.join(parts)} | {a.false_fixes}"
        )
    if row.agreement is None:
        return f"{row.fixes} of {row.frames} | itself | -"
    g = row.agreement
    return (
        f"{row.fixes} of {row.frames} | {100 * g.same_verdict:.1f} % | "
        f"{_number(g.apart_m.median, 2)} / {_number(g.apart_m.p90, 2)}"
    )


def _stage_table(measured: Sequence[Row]) -> Iterable[str]:
    stages = list(dict.fromkeys(stage for row in measured for stage in row.stages_ms))
    heading = "| ms, median / p95 / p99 | " + " | ".join(stages) + " |"
    yield heading
    yield "|" + "---|" * (heading.count("|") - 1)
    for row in measured:
        cells = [_spent(row.stages_ms[stage]) if stage in row.stages_ms else "-" for stage in stages]
        yield f"| {row.setting.label} | {' | '.join(cells)} |"


def _start_table(measured: Sequence[Row]) -> Iterable[str]:
    yield "| start | matcher loaded ms | warm-up ms | first frame ms | peak MB |"
    yield "|---|---|---|---|---|"
    for row in measured:
        yield (
            f"| {row.setting.label} | {row.load_ms:.0f} | {row.warm_up_ms:.0f} | {row.first_ms:.0f} | "
            f"{row.peak_mb:.0f} |"
        )


def load_average() -> float:
    return os.getloadavg()[0]
