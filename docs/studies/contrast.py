"""What tells right poses of structural matching from wrong ones: ``python docs/studies/contrast.py ../shared/data/real
--sets SET ... [--hostile 10000] [--workers 2] [--save FILE]``.

The gate is left open for contrast, support and rivals, and closed as ever for the rest. Shown are frames where they
belong, each from random priors (3 deg of heading, 1 deg of tilt, 4 % of the height in height and 6 % across), and the
hostile trials of ``bench-core``. SET: folders of `ortholoc_sim.crossdomain`. Prints the tables of structural.md:
distributions, and what each choice of limits would let through.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from tqdm import tqdm

from ortholoc_edge.bench import core, hostile
from ortholoc_edge.bench.replay import noisy_prior, outcome_error
from ortholoc_edge.bench.runner import localizers
from ortholoc_edge.bench.sets import find_sets
from ortholoc_edge.matching.registry import make_method
from ortholoc_edge.matching.types import STRUCTURAL
from ortholoc_edge.pipeline import gate
from ortholoc_edge.pipeline.frame import Frame
from ortholoc_edge.pipeline.localizer import LocalizerOptions
from ortholoc_edge.pipeline.outcome import Fix

RIGHT = 1.0, 1.0  # m and deg
_noted: dict[str, float] = {}


@dataclass(frozen=True)
class Judged:
    """One frame: ``verdict`` "right" (within 1 m and 1 deg), "near", "false", or the reason it was refused by the rest
    of the gate; what was measured is NaN where no pose came that far."""

    kind: str
    frame: str
    verdict: str
    contrast: float = np.nan
    support: float = np.nan
    rival: float = np.nan


def open_gate() -> None:
    """Contrast, support and rivals are noted and not judged."""

    def note(name: str) -> Any:
        return lambda value, *others: _noted.update({name: value})

    gate.with_contrast, gate.with_support, gate.without_rival = note("contrast"), note("support"), note("rival")


def true_frames(sites: list[core.Site], draws: int) -> Iterator[Judged]:
    method = make_method(STRUCTURAL, working_px=640, max_keypoints=4096, threads=1)
    for site in sites:
        with core.opened(site, None) as scene, localizers(scene.store, method, LocalizerOptions()) as by:
            for index, view in enumerate(tqdm(scene.views, file=sys.stderr, desc=site.name)):
                for draw in range(draws):
                    truth = view.frame.map_from_camera
                    prior = noisy_prior(truth, view.height_m, core.RANDOM_NOISE, np.random.default_rng([11, index, draw]))
                    _noted.clear()
                    outcome = by(view.frame.camera).localize(Frame(0, view.frame.picture, view.frame.name), prior)
                    error = outcome_error(outcome, truth)
                    verdict = str(outcome.reason) if not isinstance(outcome, Fix) else (
                        "right" if error.te_m <= RIGHT[0] and error.re_deg <= RIGHT[1]
                        else "false" if core.is_false_fix(error, view.height_m) else "near"
                    )  # fmt: skip
                    yield Judged(f"true {site.name}", view.frame.name, verdict, **_noted)


_bench: hostile.HostileBench | None = None


def _start(sites: list[core.Site], stale: list[core.Site], seed: int) -> None:
    global _bench
    cv2.setNumThreads(1)
    open_gate()
    _bench = hostile.HostileBench(sites, stale, hostile.Matching((STRUCTURAL,)), seed, None)


def _trial(number: int) -> Judged:
    assert _bench is not None
    _noted.clear()
    (verdict,) = _bench.trial(number)
    return Judged(str(verdict.kind), f"{verdict.name}/{verdict.frame}", verdict.outcome, **_noted)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("real", type=Path)
    parser.add_argument("--sets", type=Path, nargs="*", default=[])
    parser.add_argument("--draws", type=int, default=1, help="priors of each frame that belongs")
    parser.add_argument("--hostile", type=int, default=10_000)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--save", type=Path, help="a line of JSON per frame")
    args = parser.parse_args()
    cv2.setNumThreads(1)
    found: list[Judged] = []
    with tempfile.TemporaryDirectory() as scratch:
        real, sets = Path(scratch) / "real", Path(scratch) / "sets"
        real.mkdir()
        sets.mkdir()
        sites = [site for one in find_sets(args.real) for site in core.build_sites(one, real)]
        stale = [site for folder in args.sets for one in find_sets(folder) for site in core.build_sites(one, sets)]
        with ProcessPoolExecutor(args.workers, get_context("spawn"), _start, (sites, stale, args.seed)) as pool:
            numbers = range(args.hostile)
            found += tqdm(pool.map(_trial, numbers, chunksize=8), total=len(numbers), file=sys.stderr, desc="hostile")
        open_gate()
        found += true_frames([*sites, *stale], args.draws)
    if args.save is not None:
        args.save.write_text("".join(json.dumps(asdict(one)) + "\n" for one in found), encoding="utf-8")
    report(found)


def report(found: list[Judged]) -> None:
    """Print the tables."""
    wrong = [one for one in found if one.verdict == "false"]
    right = [one for one in found if one.verdict == "right"]
    true = sum(one.kind.startswith("true") for one in found)
    print(f"{true} frames where they belong: {len(right)} right; {len(found) - true} hostile; {len(wrong)} false poses")
    print("\n| statistic | false: 50, 90, 99 %, highest | right: lowest, 1, 5, 50 % |\n|---|---|---|")
    for name in ("support", "contrast", "rival"):
        bad, good = ([float(getattr(one, name)) for one in poses] for poses in (wrong, right))
        print(
            f"| {name} | {', '.join(f'{v:.3g}' for v in np.percentile(bad, [50, 90, 99, 100]))} | "
            f"{', '.join(f'{v:.3g}' for v in np.percentile(good, [0, 1, 5, 50]))} |"
        )
    print("\n| contrast | support | rival at most | false let through | right refused |\n|---|---|---|---|---|")
    for least in (3.5, 4.0, 4.5, 5.0, 5.5, 6.0, 6.5, 7.0, 8.0):
        for support in (0.02, 0.03, 0.04, 0.05):
            def passes(one: Judged, least: float = least, support: float = support) -> bool:
                return one.contrast >= least and one.support >= support and one.rival <= 0.6

            through, refused = sum(map(passes, wrong)), sum(not passes(one) for one in right)
            print(f"| {least} | {support} | 0.6 | {through} | {refused} of {len(right)} |")
    for one in sorted(wrong, key=lambda one: -one.contrast)[:12]:
        print(f"\nfalse: {one}")


if __name__ == "__main__":
    main()
