"""Samples of a generated place: their truth is the picture's own; the kinds differ in the map and the look alone."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from ortholoc_sim.crossdomain import CrossDomain, Kind
from ortholoc_sim.samples import SimulatedScenery, simulated_samples

from ortholoc_edge.bench.condition import Condition
from ortholoc_edge.bench.ground_truth import GroundTruthMatcher, geometric_confidence
from ortholoc_edge.bench.paper import PaperOptions, Result, Task, Trial
from ortholoc_edge.bench.sample_maker import MakerOptions
from ortholoc_edge.bench.samples import Sample, SampleFile, SampleKind

DOMAIN = CrossDomain(Kind.SAME, seed=5, width_m=360.0, height_m=340.0, gsd_m=0.5)
OPTIONS = MakerOptions(raster_px=512, mesh_side=50, seed=2)


@pytest.fixture(scope="module")
def samples() -> dict[SampleKind, Sample]:
    """The same pose in the kinds farthest apart."""
    found = {}
    for kind in (Kind.SAME, Kind.XDOPDSM):
        [sample] = simulated_samples(DOMAIN.of_kind(kind), 1, "S05", OPTIONS)
        assert isinstance(sample, Sample)
        found[SampleFile.of(Path(f"{sample.name}.npz")).kind] = sample
    return found


@pytest.fixture(scope="module")
def errors(samples: dict[SampleKind, Sample]) -> dict[SampleKind, list[Result]]:
    """By true matches above the paper's thresholds."""
    found: dict[SampleKind, list[Result]] = {}
    for kind, sample in samples.items():
        found[kind] = []
        for above in (0.0, 0.5, 0.95, 0.99):
            trial = Trial(sample, GroundTruthMatcher(6), Condition(min_confidence=above), PaperOptions(), adhop=False)
            found[kind] += trial.results([Task.LOCALIZE], [False])
    return found


def confidence(sample: Sample) -> np.ndarray:
    assert sample.point_map is not None
    return geometric_confidence(sample.point_map.reshape(-1, 3).astype(np.float64), sample)


def test_points_are_on_their_pixels_rays(samples: dict[SampleKind, Sample]) -> None:
    for sample in samples.values():
        assert sample.point_map is not None
        v, u = np.mgrid[: sample.camera.height : 9, : sample.camera.width : 9]
        points = sample.point_map[::9, ::9].astype(np.float64)
        px = sample.camera.project(sample.map_from_camera.inverse().apply(points))
        assert np.nanmax(np.abs(px - np.stack([u, v], axis=-1))) < 0.01
        assert np.isfinite(px).mean() > 0.99


def test_points_are_on_the_surface_on_average_too() -> None:
    """The renderer's lie 3 mm below it; a pose by all of them would show that."""
    layers, renderer = DOMAIN.map_and_renderer()
    scenery = SimulatedScenery(DOMAIN, layers, renderer)
    points = scenery.points(DOMAIN.camera.resized(160, 120), DOMAIN.poses(1)[0]).reshape(-1, 3)
    off_m = scenery.heights(points[:, :2]) - points[:, 2]
    near = np.abs(off_m) < 0.02
    assert near.mean() > 0.97
    assert abs(off_m[near].mean()) < 2e-4


def test_kinds_are_of_one_pose_and_differ_in_map_and_look(samples: dict[SampleKind, Sample]) -> None:
    same, older = samples[SampleKind.SAME], samples[SampleKind.XDOPDSM]
    assert np.array_equal(older.map_from_camera.rotation, same.map_from_camera.rotation)
    assert older.camera == same.camera
    assert np.abs(older.image.astype(float) - same.image).mean() > 10.0
    assert float(np.nanmedian(confidence(same))) > 0.9
    assert float(np.nanmedian(confidence(older))) < 0.85


def test_the_papers_table_in_kind(errors: dict[SampleKind, list[Result]]) -> None:
    """Of an older surface model only the confident matches give the pose; of today's the others do little harm."""
    assert all(one.error.te_m < 0.05 for one in errors[SampleKind.SAME])
    for one in errors[SampleKind.SAME][2:]:
        assert one.error.te_m < 0.005
        assert one.error.re_deg < 0.005
    older = errors[SampleKind.XDOPDSM]
    assert older[0].error.te_m > 0.05
    assert older[3].error.te_m < 0.1 * older[0].error.te_m
    assert older[0].matches > older[1].matches > older[2].matches > older[3].matches > 0
