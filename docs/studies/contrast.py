"""What tells right poses of structural matching from wrong ones: ``python docs/studies/contrast.py ../shared/data/real
[SET ...]``.

Every frame is localized with the gate open, from a random prior (3 deg of heading, 1 deg of tilt, 4 % of the height in
height and 6 % across), as it is and shown where it does not belong: mirrored, upside down, a frame of another place of
the same flight, the heading 60 deg off. SET: folders of `ortholoc_sim.crossdomain`. Prints the table of structural.md.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from tqdm import tqdm

from ortholoc_edge.bench import sequence
from ortholoc_edge.bench.metrics import pose_error
from ortholoc_edge.bench.replay import Length, PriorNoise, noisy_prior
from ortholoc_edge.geometry import rotation
from ortholoc_edge.geometry.rigid import Rigid3
from ortholoc_edge.matching.types import Structural
from ortholoc_edge.pipeline import gate
from ortholoc_edge.pipeline.frame import Frame
from ortholoc_edge.pipeline.localizer import Localizer, LocalizerOptions
from ortholoc_edge.pipeline.outcome import Fix
from ortholoc_edge.pipeline.prior import PosePrior
from ortholoc_edge.tiles.build import PackOptions, build_pack
from ortholoc_edge.tiles.store import MapStore

NOISE = PriorNoise((1.0, 1.0, 3.0), (Length(of_height=0.06), Length(of_height=0.04)))
OPEN = gate.GateOptions(
    min_contrast=0.0, min_sure_contrast=0.0, min_support=0.0, max_rival=1e9, min_spread=0.0, max_rms_ratio=1.0, max_innovation_sigmas=1e9,
    unsure_innovation_sigmas=1e9, max_relative_sigma=1e9,
)  # fmt: skip
# Of a right pose, m and deg; of one that is neither right nor wrong; apart, of frames of another place.
RIGHT, NEAR, APART_M = (1.0, 1.0), (5.0, 3.0), 60.0


@dataclass(frozen=True)
class Judged:
    """A pose and what may be said of it; ``kind`` "true" is a frame where it belongs."""

    kind: str
    te_m: float
    re_deg: float
    support: float
    inliers: int
    contrast: float
    rival: float


def judged(localizer: Localizer, kind: str, image: Any, prior: PosePrior, truth: Rigid3) -> Judged | None:
    seen: dict[str, float] = {}

    def note(name: str) -> Any:
        return lambda value, *others: seen.update({name: value})

    before = gate.with_contrast, gate.without_rival
    gate.with_contrast, gate.without_rival = note("contrast"), note("rival")
    try:
        outcome = localizer.localize(Frame(0, image, kind), prior)
    finally:
        gate.with_contrast, gate.without_rival = before
    if not isinstance(outcome, Fix):
        return None
    error = pose_error(outcome, truth)
    return Judged(kind, error.te_m, error.re_deg, outcome.quality, outcome.inliers, seen["contrast"], seen["rival"])


def shown(folder: Path, store: MapStore, draws: int) -> Iterator[Judged | str]:
    """Of every frame and way of showing it: what came out, or the way where nothing did."""
    records = sequence.read_flight(folder)
    localizers: dict[Any, Localizer] = {}
    for index, record in enumerate(tqdm(records, file=sys.stderr, desc=folder.name)):
        if record.camera not in localizers:
            localizers[record.camera] = Localizer(record.camera, store, Structural(), LocalizerOptions(gate=OPEN))
        localizer, truth, image = localizers[record.camera], record.map_from_camera, record.image()
        ground_m = store.ground_near(truth.translation[:2])
        assert ground_m is not None
        for draw in range(draws):
            rng = np.random.default_rng([11, index, draw])
            prior = noisy_prior(truth, float(truth.translation[2]) - ground_m, NOISE, rng)
            yield judged(localizer, "true", image, prior, truth) or "true"
        turned = rotation.exp([0.0, 0.0, np.radians(60.0)]) @ prior.map_from_camera.rotation
        off = replace(prior, map_from_camera=Rigid3(turned, prior.map_from_camera.translation))
        ways = {"mirrored": image[:, ::-1], "upside down": image[::-1, ::-1]}
        other = records[(index + len(records) // 2) % len(records)]
        if other.camera == record.camera:
            apart = other.map_from_camera.translation - truth.translation
            if np.linalg.norm(apart) > APART_M:
                ways["elsewhere"] = other.image()
        for way, picture in ways.items():
            yield judged(localizer, way, np.ascontiguousarray(picture), prior, truth) or way
        yield judged(localizer, "heading", image, off, truth) or "heading"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("real", type=Path)
    parser.add_argument("sets", type=Path, nargs="*")
    parser.add_argument("--draws", type=int, default=2, help="of the real frames")
    args = parser.parse_args()
    cv2.setNumThreads(1)
    real = [args.real / name for name in ("seneca", "caliterra", "copr")]
    found: list[Judged | str] = []
    with tempfile.TemporaryDirectory() as scratch:
        for folder in [*real, *args.sets]:
            dop, dsm = next(folder.glob("*_dop.tif")), next(folder.glob("*_dsm.tif"))
            pack = build_pack(dop, dsm, Path(scratch) / folder.name, PackOptions(quality=85, vertical="unknown"))
            with MapStore(pack) as store:
                found += list(shown(folder, store, args.draws if folder in real else 1))
    poses = [one for one in found if isinstance(one, Judged)]
    true = sum((one if isinstance(one, str) else one.kind) == "true" for one in found)

    def within(one: Judged, limits: tuple[float, float]) -> bool:
        return one.kind == "true" and one.te_m < limits[0] and one.re_deg < limits[1]

    right = [one for one in poses if within(one, RIGHT)]
    wrong = [one for one in poses if not within(one, NEAR)]
    print(f"{true} frames where they belong: {len(right)} right; {len(found) - true} where they do not; {len(wrong)} wrong")
    print("\n| statistic | wrong: 50, 90, 99 %, highest | right: lowest, 1, 5, 50 % |\n|---|---|---|")
    for name in ("inliers", "support", "contrast"):
        bad, good = ([float(getattr(one, name)) for one in poses_] for poses_ in (wrong, right))
        print(
            f"| {name} | {', '.join(f'{v:.3g}' for v in np.percentile(bad, [50, 90, 99, 100]))} | "
            f"{', '.join(f'{v:.3g}' for v in np.percentile(good, [0, 1, 5, 50]))} |"
        )
    for one in sorted(wrong, key=lambda one: -one.contrast)[:5]:
        print(f"\nwrong: {one}")


if __name__ == "__main__":
    main()
