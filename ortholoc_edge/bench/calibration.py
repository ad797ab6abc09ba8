"""Photos of one camera, matched with the map for a calibration: plain ones, recorded flights and samples."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ortholoc_edge.adapters.camera import read_image
from ortholoc_edge.bench import sequence
from ortholoc_edge.bench.replay import paper_region
from ortholoc_edge.bench.runner import sample_store, true_ground
from ortholoc_edge.bench.samples import read_sample
from ortholoc_edge.errors import ConfigError
from ortholoc_edge.geometry.arrays import ImageArray
from ortholoc_edge.geometry.camera import Camera
from ortholoc_edge.geometry.rigid import Rigid3
from ortholoc_edge.matching.types import AnyMatcher
from ortholoc_edge.pipeline.frame import Frame
from ortholoc_edge.pipeline.localizer import Localizer, LocalizerOptions
from ortholoc_edge.pipeline.outcome import Rejected
from ortholoc_edge.pipeline.prior import RegionPrior
from ortholoc_edge.pose.calibrate import Known, View
from ortholoc_edge.tiles.lattice import Bounds
from ortholoc_edge.tiles.store import MapStore

# Relative difference of recorded focal lengths within which photos are of one camera: what autofocus does is less.
_SAME_FOCAL = 0.02


@dataclass(frozen=True, slots=True, eq=False)
class Photo:
    """A photo and the part of the map that it shows.

    Attributes:
        map_from_camera, camera: its recorded pose and intrinsics; None if there are none.
    """

    name: str
    image: ImageArray
    store: MapStore
    bounds: Bounds
    map_from_camera: Rigid3 | None = None
    camera: Camera | None = None


@dataclass(frozen=True, slots=True)
class KnownBeside:
    """1-sigmas of what an autopilot knows of a recorded pose, whose errors are drawn; infinite: nothing."""

    height_m: float = math.inf
    tilt_rad: float = math.inf


@dataclass(frozen=True, slots=True, eq=False)
class MatchedPhoto:
    """What of a photo a calibration needs; ``outcome`` is its matches, or why there are none.

    Attributes:
        size: width and height, px.
        camera: the recorded one.
    """

    name: str
    size: tuple[int, int]
    outcome: View | Rejected
    camera: Camera | None


def plain_photos(paths: Sequence[Path], store: MapStore, bounds: Bounds) -> Iterator[Photo]:
    """Photos that all show some part of a region. Raises: CameraError naming the file."""
    for path in paths:
        yield Photo(str(path), read_image(path), store, bounds)


def flight_photos(recorded: Sequence[sequence.RecordedFrame], store: MapStore, seed: int) -> Iterator[Photo]:
    """Those of a flight, with the paper's region around the footprint of each. Raises: CameraError naming the file."""
    random = np.random.default_rng(seed)
    for one in recorded:
        pose = one.map_from_camera
        bounds = paper_region(one.camera, pose, true_ground(store, pose.translation[:2]), random)
        yield Photo(one.name, one.image(), store, bounds, pose, one.camera)


def sample_photos(paths: Sequence[Path], store: MapStore | None) -> Iterator[Photo]:
    """Those of samples, each with its own map or all with a given one."""
    for path in paths:
        sample = read_sample(path)
        with sample_store(sample) if store is None else nullcontext(store) as own:
            yield Photo(sample.name, sample.image, own, sample.grid.bounds, sample.map_from_camera, sample.camera)


def match(
    photos: Iterator[Photo],
    matcher: AnyMatcher,
    focal_px: float | None,
    adhop: bool,
    known: KnownBeside,
    seed: int,
) -> Iterator[MatchedPhoto]:
    """Each photo's matches with the map, whose focal length need not be near.

    Args:
        focal_px: None: the long side of the image, as in the paper.
        seed: of the errors of what is known beside.
    Raises: ConfigError for a photo of another size than the first, or of another recorded camera: one of them is not
        what the answer would be of.
    """
    random = np.random.default_rng([seed, 1])
    options = LocalizerOptions(adhop=adhop, calibrate=True)
    size: tuple[int, int] | None = None
    recorded: tuple[str, Camera] | None = None
    for photo in photos:
        height, width = photo.image.shape[:2]
        size = size or (width, height)
        if (width, height) != size:
            raise ConfigError(
                f"{photo.name}: {width} x {height} px, the photos before it have {size[0]} x {size[1]}; calibrate one "
                "camera at a time, with photos as it makes them"
            )
        if photo.camera is not None:
            recorded = recorded or (photo.name, photo.camera)
            if abs(photo.camera.focal_px / recorded[1].focal_px - 1.0) > _SAME_FOCAL:
                raise ConfigError(
                    f"{photo.name}: recorded with a focal length of {photo.camera.focal_px:.1f} px, {recorded[0]} with "
                    f"{recorded[1].focal_px:.1f}; calibrate one camera at a time"
                )
        localizer = Localizer(start_camera(size, focal_px), photo.store, matcher, options)
        try:
            found = localizer.matched(Frame(0, photo.image, photo.name), RegionPrior(photo.bounds))
        finally:
            localizer.close()
        beside = None if photo.map_from_camera is None else _known(photo.map_from_camera, known, random)
        view: View | Rejected
        if isinstance(found, Rejected):
            view = found
        else:
            manifest = photo.store.pack.manifest.dsm
            stated_m = 0.0 if manifest.sigma_m is None else math.hypot(manifest.sigma_m, manifest.max_z_error_m)
            view = View(found.local.local_from_map(found.points_map), found.query_px, beside, stated_m)
        yield MatchedPhoto(photo.name, size, view, photo.camera)


def start_camera(size: tuple[int, int], focal_px: float | None) -> Camera:
    """Where a calibration begins: the principal point in the middle."""
    return Camera.from_focal(*size, float(max(size)) if focal_px is None else focal_px)


def _known(pose: Rigid3, sigma: KnownBeside, random: np.random.Generator) -> Known | None:
    """A recorded pose as an autopilot would know it; the same draws whatever is known."""
    height_error, *tilt_error = random.normal(size=3)
    known = Known()
    if math.isfinite(sigma.height_m):
        height_m = float(pose.translation[2]) + height_error * sigma.height_m
        known = replace(known, height_m=height_m, height_sigma_m=sigma.height_m)
    if math.isfinite(sigma.tilt_rad):
        down_map = np.array([*(sigma.tilt_rad * error for error in tilt_error), -1.0])
        known = replace(known, down_camera=pose.rotation.T @ down_map, tilt_sigma_rad=sigma.tilt_rad)
    return known if math.isfinite(min(sigma.height_m, sigma.tilt_rad)) else None
