"""What each part of structural matching buys: ``python docs/studies/structural.py ../shared/data/real [SET ...]``.

Every variant sees the same frames and the same random priors (3 deg of heading, 1 deg of tilt, 4 % of the height in
height and 6 % across), through the localizer as it flies, gate included. SET: folders of `ortholoc_sim.crossdomain`.
Prints the table of structural.md.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from tqdm import tqdm

from ortholoc_edge.bench import sequence
from ortholoc_edge.bench.metrics import PoseError, pose_error
from ortholoc_edge.bench.replay import Length, PriorNoise, noisy_prior
from ortholoc_edge.geometry.camera import Camera
from ortholoc_edge.geometry.grid import bilinear
from ortholoc_edge.geometry.rigid import Rigid3
from ortholoc_edge.matching import orientation
from ortholoc_edge.matching.types import Structural
from ortholoc_edge.pipeline import structural
from ortholoc_edge.pipeline.frame import Frame
from ortholoc_edge.pipeline.localizer import Localizer, LocalizerOptions
from ortholoc_edge.pipeline.outcome import Fix
from ortholoc_edge.pipeline.render import RenderedView, Terrain, render
from ortholoc_edge.pipeline.structural import LADDER, TUNING, Level, Tuning
from ortholoc_edge.pose.adjust import PoseMeasurement
from ortholoc_edge.tiles.build import PackOptions, build_pack
from ortholoc_edge.tiles.store import MapStore

NOISE = PriorNoise((1.0, 1.0, 3.0), (Length(of_height=0.06), Length(of_height=0.04)))


@dataclass(frozen=True)
class Variant:
    """Attributes: ``name``; ``tuning``; ``patches`` of module constants and functions, as (module, name, value)."""

    name: str
    tuning: Tuning = TUNING
    patches: tuple[tuple[Any, str, Any], ...] = ()


def render_plane(terrain: Terrain, camera: Camera, pose: Rigid3) -> RenderedView:
    """The view through the plane homography, its points lifted with the surface model afterwards, as in the paper."""
    level = np.full_like(terrain.heights, np.float32(np.median(terrain.heights)))
    flat = render(replace(terrain, heights=level, lowest_m=float(level[0, 0]), typical_m=float(level[0, 0]), highest_m=float(level[0, 0])), camera, pose)

    class Plane(RenderedView):
        def points_local(self, px: np.ndarray) -> np.ndarray:
            points = RenderedView.points_local(flat, px)
            if len(points):
                at = terrain.grid.px_from_map(terrain.local.map_from_local(points)[:, :2])
                heights = bilinear(terrain.heights, at)
                points[:, 2] = np.where(np.isfinite(heights), heights, points[:, 2])
            return points

    return Plane(flat.image, flat.valid, camera, pose, flat.fall_m)


def level_drawn_once(
    self: Any, number: int, pose: Rigid3, known: PoseMeasurement, look_wide: bool = False
) -> Any:
    """`Tracking._level` with the view drawn where a descent began, its matches looked for around where the pose so far
    puts the view's middle."""
    if number == 0:
        self.drawn_at = pose
    level, camera, field = self._tuning.levels[number], self._query.cameras[number], self._query.fields[number]
    view = structural.render(self._terrain, camera, self.drawn_at)
    if view.valid.mean() < 0.1:
        return None
    template = structural.orientation_field(view.image, view.valid)
    middle = structural._middle_px(template)
    seen = camera.project(pose.inverse().apply(view.points_local(middle)))
    origin = tuple(int(x) for x in np.round(np.nan_to_num(seen - middle))[0])
    whole = self._likely_shift(view, template, field) if look_wide else None
    products = structural.structural.multiply(
        template, field, radius=level.radius_px, cell=level.cell_px, origin=whole or origin
    )
    found = products.patches(level.patch_cells, level.stride)
    step = self._adjusted(number, view, found, template, known, pose, whole)
    last = len(self._tuning.levels) - 1
    if step is None or number < last:
        return step
    cells = products.patches(1)
    seen = view.points_local(cells.template_px), structural._shown(view, cells.template_px)
    step = self._polished(view, cells, *seen, known, step, (level.cell_px / structural._CORRELATED_PX) ** 2)
    return replace(step, contrast=structural._contrast(view, cells, *seen, step.pose))


def variants() -> Iterator[Variant]:
    yield Variant("as it flies")
    yield Variant("plane homography instead of rendering", patches=((structural, "render", render_plane),))
    yield Variant("drawn once, not again at each level", patches=((structural.Tracking, "_level", level_drawn_once),))
    yield Variant("no second pass of the middle level", replace(TUNING, repeat_below=0.0))
    yield Variant("attitude takes no part in the last pose", replace(TUNING, attitude=False))
    yield Variant("all patches count alike", replace(TUNING, match_covariance=False, sigma_px=0.3))
    yield Variant("peaks only, no joint likelihood", replace(TUNING, polish=False))
    yield Variant("no look at rivals", patches=((structural.Tracking, "_elsewhere", lambda self, best: None),))
    yield Variant("local mean not taken off", patches=((orientation, "_subtract_local_mean", lambda field, inner: None),))
    yield Variant("no search where the first try does not convince", patches=((structural.Tracking, "_search", lambda self: []),))
    again = ((structural.Tracking, "_looked_at_again", lambda self, starts, proceed: ()),)
    yield Variant("what the search finds is not drawn anew", patches=again)
    a, b, c = TUNING.levels
    yield Variant("two levels, 128 and 256 px", replace(TUNING, levels=(a, b)))
    yield Variant("last level's patches 80 px", replace(TUNING, levels=(a, b, Level(512, 2, 16, 5))))
    yield Variant("last level 384 px", LADDER[1])
    yield Variant("last level 256 px", LADDER[2])
    yield Variant("fourth level, 1024 px", replace(TUNING, levels=(a, b, c, Level(1024, 2, 16, 3))))
    yield Variant("field smoothed by 2 px", patches=((orientation, "_SMOOTHING_PX", 2.0),))


@contextmanager
def patched(patches: tuple[tuple[Any, str, Any], ...]) -> Iterator[None]:
    before = [(module, name, getattr(module, name)) for module, name, _ in patches]
    for module, name, value in patches:
        setattr(module, name, value)
    try:
        yield
    finally:
        for module, name, value in before:
            setattr(module, name, value)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("real", type=Path)
    parser.add_argument("sets", type=Path, nargs="*")
    parser.add_argument("--draws", type=int, default=3)
    parser.add_argument("--every", type=int, default=1, help="of the generated photos")
    args = parser.parse_args()
    cv2.setNumThreads(1)
    with tempfile.TemporaryDirectory() as scratch:
        sets: dict[str, list[tuple[MapStore, sequence.RecordedFrame]]] = {"real": []}
        real = [args.real / name for name in ("seneca", "caliterra", "copr")]
        for folder in [*real, *args.sets]:
            store = MapStore(
                build_pack(
                    next(folder.glob("*_dop.tif")),
                    next(folder.glob("*_dsm.tif")),
                    Path(scratch) / folder.name,
                    PackOptions(quality=85, vertical="unknown"),
                )
            )
            frames = [(store, frame) for frame in sequence.read_flight(folder)]
            if folder in real:
                sets["real"] += frames
            else:
                sets.setdefault(folder.name.rstrip("0123456789"), []).extend(frames[:: args.every])
        print("| variant | " + " | ".join(f"{name}: recall 1m-1°, TE median m, NEES / 6" for name in sets) + " | CPU ms |")
        print("|---|" + "---|" * (len(sets) + 1))
        for variant in variants():
            cells, spent = [], []
            with patched(variant.patches):
                for name, frames in sets.items():
                    draws = args.draws if name == "real" else 1
                    measured = [measure(*f, k, d, variant.tuning) for k, f in enumerate(tqdm(frames, file=sys.stderr)) for d in range(draws)]
                    cells.append(cell([error for error, _ in measured]))
                    spent += [ms for _, ms in measured] if name == "real" else []
            print(f"| {variant.name} | " + " | ".join(cells) + f" | {np.median(spent):.0f} |", flush=True)


def measure(
    store: MapStore, record: sequence.RecordedFrame, index: int, draw: int, tuning: Tuning
) -> tuple[PoseError | None, float]:
    truth = record.map_from_camera
    ground_m = store.ground_near(truth.translation[:2])
    assert ground_m is not None, record.name
    prior = noisy_prior(truth, float(truth.translation[2]) - ground_m, NOISE, np.random.default_rng([index, draw]))
    localizer = Localizer(record.camera, store, Structural(), LocalizerOptions(), [tuning])
    frame = Frame(0, record.image(), record.name)
    localizer.localize(frame, prior)  # once, so that the map is decoded: what is compared is the matching
    start = time.process_time()
    outcome = localizer.localize(frame, prior)
    spent_ms = (time.process_time() - start) * 1e3
    localizer.close()
    return (pose_error(outcome, truth) if isinstance(outcome, Fix) else None), spent_ms


def cell(errors: list[PoseError | None]) -> str:
    found = [e for e in errors if e is not None]
    recall = sum(e.te_m <= 1 and e.re_deg <= 1 for e in found) / len(errors)
    false = sum(e.is_false for e in found)
    wrong = f", {false} false" if false else ""
    if not found:
        return f"{100 * recall:.1f} %"
    nees = np.mean([e.nees for e in found]) / 6
    return f"{100 * recall:.1f} %, {np.median([e.te_m for e in found]):.3f}, {nees:.1f}{wrong}"


if __name__ == "__main__":
    main()
