"""Recorded flights and samples through the localizer, start to figures."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path

import numpy as np
import rasterio
from affine import Affine

from ortholoc_edge.bench import metrics, report, sequence
from ortholoc_edge.bench.replay import FrameResult, PriorKind, PriorNoise, replay_flight, replay_sample
from ortholoc_edge.bench.samples import Sample, read_sample
from ortholoc_edge.errors import DatasetError, MapError
from ortholoc_edge.geometry.arrays import FloatArray
from ortholoc_edge.geometry.camera import Camera
from ortholoc_edge.matching.types import AnyMatcher
from ortholoc_edge.pipeline.localizer import Localizer, LocalizerOptions
from ortholoc_edge.pose import pnp
from ortholoc_edge.tiles.build import PackOptions, build_pack
from ortholoc_edge.tiles.pack import Pack
from ortholoc_edge.tiles.store import MapStore

# What a summary names as its pack where each sample brings one.
SAMPLES_PACK = "the samples' own rasters"


def prior_used(kind: PriorKind, samples: bool) -> PriorKind:
    """What a replay really predicts from: a sample has no past, so every prior but NONE is the truth with noise."""
    return PriorKind.TRUTH_NOISE if samples and kind is not PriorKind.NONE else kind


def run_flight(
    recorded: list[sequence.RecordedFrame],
    store: MapStore,
    matcher: AnyMatcher,
    options: LocalizerOptions,
    kind: PriorKind,
    noise: PriorNoise,
    seed: int,
) -> Iterator[FrameResult]:
    """Localize a recorded flight on a pack. See `replay.replay_flight`."""
    with localizers(store, matcher, options) as localizer_for:
        yield from replay_flight(
            recorded,
            localizer_for,
            store.pack.georeference,
            lambda xy: true_ground(store, xy),
            kind=kind,
            noise=noise,
            seed=seed,
        )


@contextmanager
def localizers(
    store: MapStore, matcher: AnyMatcher, options: LocalizerOptions
) -> Iterator[Callable[[Camera], Localizer]]:
    """A localizer for each camera that is asked for, made once and closed at the end."""
    made: dict[Camera, Localizer] = {}

    def localizer_for(camera: Camera) -> Localizer:
        if camera not in made:
            made[camera] = Localizer(camera, store, matcher, options)
        return made[camera]

    try:
        yield localizer_for
    finally:
        for localizer in made.values():
            localizer.close()


def run_samples(
    paths: list[Path],
    matcher: AnyMatcher,
    options: LocalizerOptions,
    kind: PriorKind,
    noise: PriorNoise,
    seed: int,
    pack: MapStore | None = None,
) -> Iterator[FrameResult]:
    """Localize OrthoLoC samples.

    Args:
        pack: a map in the samples' own local frame, of another year or sensor, say; None: each sample's rasters.
    Raises: DatasetError for a sample that can't be read or whose place is not on the pack.
    """
    for index, path in enumerate(paths):
        sample = read_sample(path)
        with sample_store(sample) if pack is None else nullcontext(pack) as store:
            localizer = Localizer(sample.camera, store, matcher, options)
            ground_m = true_ground(store, sample.map_from_camera.translation[:2])
            try:
                yield replay_sample(
                    sample,
                    localizer,
                    kind=kind,
                    noise=noise,
                    height_m=float(sample.map_from_camera.translation[2]) - ground_m,
                    bounds=sample.grid.bounds,
                    seed=seed + index,
                )
            finally:
                localizer.close()


def true_ground(store: MapStore, xy_map: FloatArray) -> float:
    """Typical height of the surface around a frame's true position, m. Raises: DatasetError if there is none."""
    ground_m = store.ground_near(xy_map)
    if ground_m is None:
        raise DatasetError(
            f"{store.pack.path}: no surface model near the true position ({xy_map[0]:.0f}, {xy_map[1]:.0f}); is this "
            "the pack of this sequence, in its frame?"
        )
    return ground_m


@contextmanager
def sample_store(sample: Sample) -> Iterator[MapStore]:
    """A sample's rasters as an area pack without a reference system, for as long as it is needed."""
    with (
        tempfile.TemporaryDirectory(prefix="ortholoc-sample-") as name,
        MapStore(build_sample_pack(sample, Path(name))) as store,
    ):
        yield store


def build_sample_pack(sample: Sample, folder: Path) -> Pack:
    """A sample's rasters as an area pack without a reference system, in ``folder``/pack."""
    grid = sample.grid
    transform = Affine(grid.dx, 0.0, grid.west, 0.0, grid.dy, grid.top)
    # Named after the sample, for the builder's messages name files.
    dop, dsm = folder / f"{sample.name} image_dop.tif", folder / f"{sample.name} dsm.tif"
    for file, bands, dtype in (
        (dop, np.moveaxis(sample.dop, 2, 0), "uint8"),
        (dsm, sample.dsm[None], "float32"),
    ):
        profile = {
            "driver": "GTiff",
            "width": grid.width,
            "height": grid.height,
            "count": len(bands),
            "dtype": dtype,
            "transform": transform,
            "nodata": np.nan if dtype == "float32" else None,
        }
        try:
            with rasterio.open(file, "w", **profile) as target:
                target.write(bands)
        except rasterio.errors.RasterioError as err:
            raise MapError(f"{sample.name}: can't write {file} ({err}); is the disk full?") from err
    return build_pack(dop, dsm, folder / "pack", PackOptions(quality=95, vertical="unknown"))


def summarise(
    results: list[FrameResult],
    *,
    name: str,
    pack: str,
    matcher: AnyMatcher,
    prior: PriorKind,
    adhop: bool,
    seed: int,
    seeds: int = 1,
) -> metrics.Summary:
    """Figures of a replay's results, or of several with ``seeds`` seeds from ``seed`` on."""
    errors = [r.error for r in results if r.error is not None]
    outcomes = [r.outcome for r in results]
    te: FloatArray = np.array([e.te_m for e in errors])
    return metrics.Summary(
        sequence=name,
        frames=len(results),
        fixes=len(errors),
        rejected=metrics.rejections(outcomes),
        te_m=metrics.Spread.of(te),
        re_deg=metrics.Spread.of([e.re_deg for e in errors]),
        recall=metrics.recall(errors, len(results)),
        false_fixes=sum(e.is_false for e in errors),
        nees=metrics.nees(errors),
        latency_ms=metrics.latencies(outcomes),
        cpu_ms_per_frame=float(np.median([r.cpu_ms for r in results])) if results else 0.0,
        rss_mb=report.rss_mb(),
        matcher=matcher.name,
        solver=pnp.SOLVER,
        model_sha256=matcher.model_sha256,
        pack=pack,
        prior=str(prior),
        adhop=adhop,
        adhop_accepted=sum(getattr(o, "adhop_accepted", None) is True for o in outcomes),
        seed=seed,
        seeds=seeds,
    )
