"""A small sample made over the demo pack, whose photo is drawn from the map."""

from __future__ import annotations

import functools

import cv2
import numpy as np
from replay import rendered

from ortholoc_edge.bench.condition import Condition
from ortholoc_edge.bench.ground_truth import GroundTruthMatcher
from ortholoc_edge.bench.paper import PaperOptions, Result, Task, Trial
from ortholoc_edge.bench.sample_maker import MakerOptions, PackScenery, make_sample
from ortholoc_edge.bench.samples import Sample
from ortholoc_edge.geometry.arrays import ImageArray
from ortholoc_edge.geometry.camera import Camera
from ortholoc_edge.geometry.rigid import Rigid3
from ortholoc_edge.pipeline.render import Terrain, render

CAMERA = Camera.from_focal(320, 240, 270.0)
# Tilted by 25 degrees, over houses.
POSE = rendered.pose(roll_deg=8.0, pitch_deg=24.0)
SMALL = MakerOptions(raster_px=400, mesh_side=40, seed=3)
# The paper's thresholds on the geometry-aware confidence.
THRESHOLDS = (0.0, 0.5, 0.95, 0.99)


@functools.cache
def scenery() -> PackScenery:
    return PackScenery(rendered.store())


@functools.cache
def photo() -> ImageArray:
    """What the map shows from ``POSE``: every pixel of it has its place on the map."""
    local = scenery().local_frame(POSE)
    terrain = Terrain.of(rendered.map_window(220.0, 0.25), local)
    assert terrain is not None
    view = render(terrain, CAMERA, local.local_from_map_pose(POSE))
    assert view.valid.all()
    return np.asarray(cv2.cvtColor(view.image, cv2.COLOR_GRAY2RGB), dtype=np.uint8)


def made(
    options: MakerOptions = SMALL, index: int = 0, pose: Rigid3 = POSE, place: PackScenery | None = None
) -> Sample:
    return make_sample("D01_R0000", photo(), CAMERA, pose, place or scenery(), options, index)


def by_confidence(sample: Sample, matcher: GroundTruthMatcher | None = None) -> list[Result]:
    """The pose by true matches above each of the paper's thresholds."""
    return [
        result
        for above in THRESHOLDS
        for result in Trial(
            sample, matcher or GroundTruthMatcher(), Condition(min_confidence=above), PaperOptions(), adhop=False
        ).results([Task.LOCALIZE], [False])
    ]
