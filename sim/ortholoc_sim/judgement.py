"""What a scenario's flight came to, against the truth and against what its file expects."""

from __future__ import annotations

import csv
import json
import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from msgspec import Struct

from ortholoc_edge.bench.core import is_false_fix
from ortholoc_edge.bench.metrics import Spread, pose_error
from ortholoc_edge.errors import OrtholocError
from ortholoc_edge.geometry import rotation
from ortholoc_edge.geometry.arrays import FloatArray
from ortholoc_edge.geometry.covariance import mahalanobis_squared
from ortholoc_edge.geometry.rigid import Rigid3
from ortholoc_edge.pipeline.outcome import Fix
from ortholoc_sim.autopilot import Verdict
from ortholoc_sim.lockstep import START_NS, Flown, FlownFrame
from ortholoc_sim.recorded import NOTICE

_S = 1_000_000_000
# Of the loop's steps: ten in a second.
_EVERY = 10
_SETTLE_S = 5.0
_BACK_M = 10.0
_NOT_IN_USE = (Verdict.STANDBY, Verdict.TOO_FAST, Verdict.RELATIVE, Verdict.WAITING)
_TAKEN = (Verdict.FUSED, Verdict.RESET, Verdict.TIMEOUT_RESET)
RESULT, FRAMES, TRACK, TIMES = "result.json", "frames.jsonl", "track.csv", "times.json"


class MeanNees(Struct, frozen=True):
    """Mean of the normalised estimation error squared over its degrees of freedom: 1 if covariances are honest, more if
    they are too sure. Of the whole pose, and of its position and attitude by themselves; None without a fix."""

    pose: float | None
    position: float | None
    attitude: float | None


class Result(Struct, frozen=True, kw_only=True):
    """A flight in figures: `RESULT`. Lengths in m, angles in degrees, times in s since the start.

    Attributes:
        notice: what has to be known of the pictures; None for a generated world.
        passed, problems: whether it was as expected, and what was not.
        flown_m: length of the true track. event_s: when GNSS was first disturbed; what is "after" is after this, or
            after 5 s where it never is.
        exposed, replaced: frames of the camera, and those that a newer one replaced; frames: that gave an outcome.
        fixed: share of these with a fix. false_fixes: see `bench.core.is_false_fix`.
        position_m, horizontal_m, height_m, attitude_deg: errors of the fixes.
        latency_ms: from mid-exposure to the outcome.
        route_m: true horizontal distance from the route after. route_p95_m: its 95th percentile.
        back_s: from the end of the last fault until the autopilot knew for good where it is, to 10 m; None where there
            was no fault that ended, or it never did.
        resets: how often the reset counter changed that the autopilot was told.
        autopilot_m: horizontal error of what the autopilot believes, after. dead_reckoning_m: what it would be at the
            end without fixes; None while it has GNSS.
        verdicts: of the autopilot's filter. fused: share taken in of what arrived while vision was in use.
        says: STATUSTEXT of ours.
    """

    scenario: str
    seed: int
    title: str
    notice: str | None
    passed: bool
    problems: tuple[str, ...]
    map_kind: str
    duration_s: float
    flown_m: float
    event_s: float | None
    exposed: int
    replaced: int
    frames: int
    fixes: int
    fixed: float
    false_fixes: int
    rejections: dict[str, int]
    position_m: Spread
    horizontal_m: Spread
    height_m: Spread
    attitude_deg: Spread
    nees: MeanNees
    latency_ms: Spread
    route_m: Spread
    route_p95_m: float | None
    back_s: float | None
    resets: int
    autopilot_m: Spread
    autopilot_end_m: float
    dead_reckoning_m: float | None
    verdicts: dict[str, int]
    fused: float | None
    says: tuple[tuple[float, str], ...]
    line: dict[str, int]
    daemon: dict[str, int | float | str | bool | None]


@dataclass(frozen=True, slots=True, eq=False)
class Errors:
    """Of one fix: camera centre minus truth (3,) m in map axes, rotation in degrees, NEES of pose, position, attitude,
    and whether it is false."""

    step_m: FloatArray
    attitude_deg: float
    nees: tuple[float, float, float]
    is_false: bool


@dataclass(frozen=True, slots=True, eq=False)
class Judged:
    """A flight, judged.

    Attributes:
        errors: of each frame of `Flown.frames`; None without a fix.
        t_s: (N,) ten times a second. true_map_m, believed_map_m: (N, 3).
        autopilot_m, dead_reckoning_m, route_m: (N,) horizontal errors and distance; NaN where there is none.
    """

    flown: Flown
    result: Result
    errors: tuple[Errors | None, ...]
    t_s: FloatArray
    true_map_m: FloatArray
    believed_map_m: FloatArray
    autopilot_m: FloatArray
    dead_reckoning_m: FloatArray
    route_m: FloatArray


def judge(flown: Flown) -> Judged:
    """Compare a flight with its truth and with its scenario's expectations."""
    samples = flown.loop.samples[::_EVERY]
    site = flown.site
    t_s = np.array([(sample.stamp_ns - START_NS) / _S for sample in samples])
    true_map = np.array([site.map_from_ned(sample.truth.position_ned_m) for sample in samples])
    believed = np.array([site.map_from_ned(site.ned_from_autopilot(sample.estimate_m)) for sample in samples])
    autopilot = np.array([np.hypot(*(sample.estimate_m - sample.true_m)[:2]) for sample in samples])
    reckoned = np.array(
        [np.nan if s.dead_reckoned_m is None else np.hypot(*(s.dead_reckoned_m - s.true_m[:2])) for s in samples]
    )
    route = _distance_to_route(true_map[:, :2], flown.route_map_m[:, :2]) / site.grid_scale
    errors = tuple(_errors(frame) for frame in flown.frames)
    fixes = [error for error in errors if error is not None]
    event_s = min((event.from_s for event in flown.scenario.gnss), default=None)
    after = t_s >= (_SETTLE_S if event_s is None else event_s)
    verdicts = Counter(str(record.verdict) for record in flown.loop.autopilot.vision)
    wanted = sum(count for verdict, count in verdicts.items() if verdict not in _NOT_IN_USE)
    steps = np.array([error.step_m for error in fixes]).reshape(-1, 3)
    result = Result(
        scenario=flown.scenario.name,
        seed=flown.seed,
        title=flown.scenario.title,
        notice=None if flown.scenario.world.pack is None else NOTICE,
        passed=True,
        problems=(),
        map_kind=str(flown.scenario.map.kind),
        duration_s=flown.duration_s,
        flown_m=float(np.linalg.norm(np.diff(true_map[:, :2], axis=0), axis=1).sum()),
        event_s=event_s,
        exposed=flown.exposed,
        replaced=flown.replaced,
        frames=len(flown.frames),
        fixes=len(fixes),
        fixed=len(fixes) / len(flown.frames) if flown.frames else 0.0,
        false_fixes=sum(error.is_false for error in fixes),
        rejections=dict(
            Counter(str(f.outcome.reason) for f in flown.frames if not isinstance(f.outcome, Fix)).most_common()
        ),
        position_m=Spread.of(np.linalg.norm(steps, axis=1)),
        horizontal_m=Spread.of(np.hypot(steps[:, 0], steps[:, 1])),
        height_m=Spread.of(np.abs(steps[:, 2])),
        attitude_deg=Spread.of([error.attitude_deg for error in fixes]),
        nees=_mean_nees(fixes),
        latency_ms=Spread.of([(frame.ready_s - frame.t_s) * 1e3 for frame in flown.frames]),
        route_m=Spread.of(route[after]),
        route_p95_m=float(np.percentile(route[after], 95)) if after.any() else None,
        back_s=_back_s(flown, t_s, autopilot),
        resets=sum(a.reset_counter != b.reset_counter for a, b in pairwise(flown.loop.autopilot.vision)),
        autopilot_m=Spread.of(autopilot[after]),
        autopilot_end_m=float(autopilot[-1]),
        dead_reckoning_m=float(reckoned[-1]) if np.isfinite(reckoned[-1]) else None,
        verdicts={str(verdict): verdicts[str(verdict)] for verdict in Verdict if verdicts[str(verdict)]},
        fused=sum(verdicts[str(verdict)] for verdict in _TAKEN) / wanted if wanted else None,
        says=flown.said,
        line=flown.line,
        daemon=flown.statistics,
    )
    problems = tuple(_problems(flown, result))
    result = msgspec.structs.replace(result, passed=not problems, problems=problems)
    return Judged(flown, result, errors, t_s, true_map, believed, autopilot, reckoned, route)


def _back_s(flown: Flown, t_s: FloatArray, autopilot_m: FloatArray) -> float | None:
    ended = [fault.until_s for fault in flown.scenario.fault if fault.until_s is not None]
    after = t_s >= max(ended, default=math.inf)
    off = np.flatnonzero(after & (autopilot_m > _BACK_M))
    if not after.any() or (len(off) and off[-1] == len(t_s) - 1):
        return None
    return 0.0 if not len(off) else float(t_s[off[-1] + 1] - max(ended))


def _errors(frame: FlownFrame) -> Errors | None:
    if not isinstance(frame.outcome, Fix):
        return None
    error = pose_error(frame.outcome, frame.truth)
    pose = frame.outcome.map_from_camera
    turn = rotation.log(frame.truth.rotation @ pose.rotation.T)
    covariance = frame.outcome.covariance
    step = pose.translation - frame.truth.translation
    return Errors(
        step,
        error.re_deg,
        (error.nees, mahalanobis_squared(step, covariance[:3, :3]), mahalanobis_squared(turn, covariance[3:, 3:])),
        is_false_fix(error, frame.height_m),
    )


def _mean_nees(fixes: Sequence[Errors]) -> MeanNees:
    if not fixes:
        return MeanNees(None, None, None)
    pose, position, attitude = np.mean([error.nees for error in fixes], axis=0) / (6.0, 3.0, 3.0)
    return MeanNees(float(pose), float(position), float(attitude))


def _distance_to_route(xy: FloatArray, route: FloatArray) -> FloatArray:
    """(N,) of points (N, 2) to a polyline (M, 2)."""
    nearest = np.full(len(xy), np.inf)
    for a, b in pairwise(route):
        way = b - a
        along = np.clip((xy - a) @ way / max(float(way @ way), 1e-9), 0.0, 1.0)
        nearest = np.minimum(nearest, np.linalg.norm(xy - a - along[:, None] * way, axis=1))
    return nearest


def _problems(flown: Flown, result: Result) -> Iterator[str]:  # noqa: PLR0912 -- one for each expectation
    expect = flown.scenario.expect
    if expect.route_p95_m is not None and result.route_p95_m is None:
        yield "the flight ended before GNSS was disturbed, so nothing was flown without it"
    elif expect.route_p95_m is not None and result.route_p95_m is not None and result.route_p95_m > expect.route_p95_m:
        yield f"95 % of the flight was within {result.route_p95_m:.1f} m of the route; limit {expect.route_p95_m:g} m"
    most = result.autopilot_m.max
    if expect.lost_m is not None and (most is None or most < expect.lost_m):
        yield f"the autopilot was at most {most or 0.0:.1f} m off; it should be lost by {expect.lost_m:g} m"
    if expect.back_within_s is not None and (result.back_s is None or result.back_s > expect.back_within_s):
        took = "never" if result.back_s is None else f"after {result.back_s:.1f} s"
        yield f"after the last fault the autopilot knew {took} where it is; expected within {expect.back_within_s:g} s"
    if expect.resets is not None and result.resets != expect.resets:
        yield f"the autopilot was told {result.resets} times that estimates start anew; expected {expect.resets}"
    if result.false_fixes > expect.false_fixes:
        yield f"{result.false_fixes} false fixes; at most {expect.false_fixes}"
    least, greatest = expect.fixed
    if not least <= result.fixed <= greatest:
        yield f"{result.fixes} of {result.frames} frames gave a fix; expected {least:.0%} to {greatest:.0%}"
    if expect.nees is not None:
        low, high = expect.nees
        mean = result.nees.pose
        if mean is None or not low <= mean <= high:
            found = "-" if mean is None else f"{mean:.2f}"
            yield f"mean NEES over its degrees of freedom is {found}; expected {low:g} to {high:g}"
    if expect.fused is not None and (result.fused is None or result.fused < expect.fused):
        share = "nothing" if result.fused is None else f"{result.fused:.0%}"
        yield f"the autopilot took in {share} of what it received; at least {expect.fused:.0%}"
    for reason in expect.reasons:
        if str(reason) not in result.rejections:
            yield f"no frame was refused as {reason}"
    for verdict in expect.verdicts:
        if str(verdict) not in result.verdicts:
            yield f"the autopilot's verdict {verdict} never occurred"
    said = [text for _, text in result.says]
    for part in expect.says:
        if not any(part in text for text in said):
            yield f"nothing was said of {part!r}"
    for part in expect.says_not:
        if any(part in text for text in said):
            yield f"{part!r} was said"


# -- files -------------------------------------------------------------------


def write_files(judged: Judged, out: Path) -> None:
    """Write `RESULT`, `FRAMES` and `TRACK`, the same bytes for the same scenario and seed, and `TIMES`, which is not.
    Raises: OrtholocError if that fails."""
    try:
        out.mkdir(parents=True, exist_ok=True)
        result = figures(judged.result)
        (out / RESULT).write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")
        with (out / FRAMES).open("w", encoding="utf-8") as file:
            for frame, errors in zip(judged.flown.frames, judged.errors, strict=True):
                file.write(json.dumps(_rounded(frame_row(frame, errors))) + "\n")
        with (out / TRACK).open("w", newline="", encoding="utf-8") as file:
            table = csv.writer(file, lineterminator="\n")
            table.writerow(("t_s", "east_m", "north_m", "height_m", "believed_east_m", "believed_north_m",
                            "believed_height_m", "autopilot_error_m", "route_m"))  # fmt: skip
            for k, t_s in enumerate(judged.t_s):
                values = (*judged.true_map_m[k], *judged.believed_map_m[k], judged.autopilot_m[k], judged.route_m[k])
                table.writerow([f"{t_s:.2f}", *(f"{value:.3f}" for value in values)])
        (out / TIMES).write_text(json.dumps(times(judged.flown)) + "\n", encoding="utf-8")
    except OSError as err:
        raise OrtholocError(f"{out}: can't write the results ({err})") from err


def figures(result: Result) -> dict[str, Any]:
    """A result as JSON takes it."""
    found: dict[str, Any] = _rounded(msgspec.to_builtins(result))
    return found


def times(flown: Flown) -> dict[str, Any]:
    """Wall times: of the flight, and of the localizer per stage in ms."""
    stages: dict[str, list[float]] = {}
    for frame in flown.frames:
        for stage, spent_ms in frame.outcome.timings_ms.items():
            stages.setdefault(stage, []).append(spent_ms)
    return {
        "wall_s": round(flown.wall_s, 2),
        "simulated_s": round(flown.duration_s, 2),
        "localizer_ms": {stage: msgspec.to_builtins(Spread.of(spent)) for stage, spent in stages.items()},
    }


def frame_row(frame: FlownFrame, errors: Errors | None) -> dict[str, Any]:
    """A line of `FRAMES`."""
    outcome = frame.outcome
    row: dict[str, Any] = {"t_s": frame.t_s, "ready_s": frame.ready_s, "truth_m": _position(frame.truth)}
    if not isinstance(outcome, Fix) or errors is None:
        refusal = {name: getattr(outcome, name) for name in ("reason", "detail", "measured", "limit")}
        return {**row, **refusal, "reason": str(refusal["reason"])}
    sigma = np.sqrt(np.diag(outcome.covariance))
    return {
        **row,
        "fix_m": _position(outcome.map_from_camera),
        "error_m": [float(v) for v in errors.step_m],
        "error_deg": errors.attitude_deg,
        "sigma_m": [float(v) for v in sigma[:3]],
        "sigma_deg": [float(v) for v in np.degrees(sigma[3:])],
        "nees": list(errors.nees),
        "false": errors.is_false,
        "quality": outcome.quality,
        "inliers": outcome.inliers,
        "rms_px": outcome.rms_px,
    }


def _position(pose: Rigid3) -> list[float]:
    return [float(v) for v in pose.translation]


def _rounded(value: Any) -> Any:
    """Numbers to a millionth: all that anyone reads."""
    if isinstance(value, float):
        return round(value, 6) if math.isfinite(value) else None
    if isinstance(value, dict):
        return {key: _rounded(part) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [_rounded(part) for part in value]
    return value
