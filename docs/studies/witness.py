"""The GNSS witness in simulation: false alarms per hour, and seconds until a spoofer's ramp is noticed.

    python docs/studies/witness.py [--hours 200] [--ramps 200]

Every figure of docs/studies/witness.md comes from here. Errors are simulated per axis: GNSS as a constant bias, a slow
Gauss-Markov process and multipath; the camera as white noise and a slow part (the map's); both with the sigmas that
they would declare. The witness is the one that flies.
"""

from __future__ import annotations

import argparse
import math
from dataclasses import dataclass

import numpy as np

from ortholoc_edge.pipeline.witness import Consistency, Witness, WitnessOptions

_S = 1_000_000_000
# Telemetry's floor under what a receiver says of itself.
_LEAST_GNSS_SIGMA_M = 1.5


@dataclass(frozen=True, slots=True)
class Scene:
    """How both err. Lengths in m, per axis, 1-sigma; times in s.

    ``says_m``: the accuracy that the receiver claims. ``wild``: part of fixes that are wrong by 5 to 40 m, each alone.
    """

    name: str
    bias_m: float = 0.9
    slow_m: float = 0.7
    slow_s: float = 120.0
    says_m: float = 0.8
    fix_m: float = 0.5
    map_m: float = 0.4
    wild: float = 0.0
    rate_hz: float = 2.0


SCENES = (
    Scene("open sky"),
    Scene("open sky, 5 fixes a second", rate_hz=5.0),
    Scene("map and WGS 84 1.5 m apart, poor sky", bias_m=1.5, slow_m=1.5, slow_s=60.0, says_m=1.2),
    Scene("receiver says 4 m, and errs by it", slow_m=4.0, slow_s=60.0, says_m=4.0),
    Scene("1 % of fixes wild", wild=0.01),
    Scene("5 % of fixes wild", wild=0.05),
    Scene("multipath of 3 m, told as 1.2 m", slow_m=3.0, slow_s=30.0, says_m=1.2),
)


def differences(scene: Scene, seconds: float, rng: np.random.Generator) -> np.ndarray:
    """(N, 2) GNSS minus fix."""
    count = round(seconds * scene.rate_hz)
    decay = math.exp(-1.0 / (scene.rate_hz * scene.slow_s))
    map_decay = math.exp(-1.0 / (scene.rate_hz * 10.0))
    towards = rng.uniform(0.0, 2.0 * math.pi)
    out = scene.bias_m * np.array([[math.cos(towards), math.sin(towards)]]) + np.zeros((count, 2))
    out += _slow(count, scene.slow_m, decay, rng) - _slow(count, scene.map_m, map_decay, rng)
    white = math.sqrt(max(scene.fix_m**2 - scene.map_m**2, 0.0))
    out += white * rng.standard_normal((count, 2))
    wild = rng.random(count) < scene.wild
    angle, length = rng.uniform(0.0, 2.0 * math.pi, count), rng.uniform(5.0, 40.0, count)
    out[wild] += (length[:, None] * np.column_stack([np.cos(angle), np.sin(angle)]))[wild]
    return out


def _slow(count: int, sigma: float, decay: float, rng: np.random.Generator) -> np.ndarray:
    out = np.empty((count, 2))
    value = sigma * rng.standard_normal(2)
    noise = sigma * math.sqrt(1.0 - decay**2) * rng.standard_normal((count, 2))
    for i in range(count):
        value = decay * value + noise[i]
        out[i] = value
    return out


def covariance(scene: Scene) -> np.ndarray:
    return np.eye(2) * (max(scene.says_m, _LEAST_GNSS_SIGMA_M) ** 2 + scene.fix_m**2)


def run(scene: Scene, apart: np.ndarray, witness: Witness) -> list[tuple[float, Consistency]]:
    """(seconds, state) at each change."""
    both, step_ns = covariance(scene), round(_S / scene.rate_hz)
    changes, last = [], Consistency.UNKNOWN
    for i, (east, north) in enumerate(apart):
        witness.compare(i * step_ns, (east, north, 0.0), both)
        state = witness.report.state
        if state is not last:
            changes.append((i / scene.rate_hz, state))
            last = state
    return changes


def false_alarms(scene: Scene, hours: float, rng: np.random.Generator) -> tuple[int, int, float]:
    """(times suspect, times bad, part of the time not ok) in flights of half an hour each."""
    suspect = bad = 0
    not_ok_s = 0.0
    for _ in range(round(hours * 2)):
        changes = run(scene, differences(scene, 1800.0, rng), Witness(WitnessOptions()))
        suspect += sum(state is Consistency.SUSPECT for _, state in changes)
        bad += sum(state is Consistency.BAD for _, state in changes)
        ends = [at for at, _ in changes[1:]] + [1800.0]
        not_ok_s += sum(
            end - at for (at, state), end in zip(changes, ends, strict=True)
            if state in (Consistency.SUSPECT, Consistency.BAD)
        )  # fmt: skip
    return suspect, bad, not_ok_s / (hours * 3600.0)


def detection(scene: Scene, speed_m_s: float, ramps: int, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Seconds from the ramp's start until suspect and bad, and from its end (GNSS true again) until ok."""
    before_s, ramp_s, after_s = 60.0, 60.0, 180.0
    out: dict[str, list[float]] = {"suspect": [], "bad": [], "ok again": []}
    for _ in range(ramps):
        apart = differences(scene, before_s + ramp_s + after_s, rng)
        t = np.arange(len(apart)) / scene.rate_hz - before_s
        towards = rng.uniform(0.0, 2.0 * math.pi)
        pulled = np.where((t > 0.0) & (t < ramp_s), speed_m_s * t, 0.0)
        apart += pulled[:, None] * np.array([math.cos(towards), math.sin(towards)])
        changes = run(scene, apart, Witness(WitnessOptions()))
        for name, state, since in (
            ("suspect", Consistency.SUSPECT, 0.0), ("bad", Consistency.BAD, 0.0), ("ok again", Consistency.OK, ramp_s)
        ):  # fmt: skip
            at = next((at - before_s for at, s in changes if s is state and at - before_s >= since), math.inf)
            out[name].append(at - since)
    return {name: np.array(values) for name, values in out.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--hours", type=float, default=200.0, help="simulated per scene (default: %(default)s)")
    parser.add_argument("--ramps", type=int, default=200, help="simulated per speed (default: %(default)s)")
    args = parser.parse_args()
    rng = np.random.default_rng(20261130)
    print("| errors | hours | suspect | bad | time not ok |\n|---|---|---|---|---|")
    for scene in SCENES:
        suspect, bad, part = false_alarms(scene, args.hours, rng)
        print(f"| {scene.name} | {args.hours:g} | {suspect} | {bad} | {part:.2%} |", flush=True)
    print("\n| errors | ramp m/s | suspect s | bad s | apart at bad m | ok again s |\n|---|---|---|---|---|---|")
    for scene in (SCENES[0], SCENES[3]):
        for speed in (0.25, 0.5, 1.0, 2.0):
            found = detection(scene, speed, args.ramps, rng)
            cells = [f"{np.median(v):.0f}, {np.percentile(v, 95, method="nearest"):.0f}, {v.max():.0f}" for v in found.values()]
            apart = f"{speed * float(np.median(found['bad'])):.0f}"
            print(f"| {scene.name} | {speed} | {cells[0]} | {cells[1]} | {apart} | {cells[2]} |", flush=True)
    print("\nmedian, 95 %, longest of the ramps; inf: not within its 60 s")


if __name__ == "__main__":
    main()
