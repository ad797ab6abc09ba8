"""Benchmark sets across domains: ``python -m ortholoc_sim.crossdomain OUT --kind xDOP --photos 200 --seed 1``.

A map (DOP, DSM) of a generated place at one time and photos of it with their true poses, written as a folder that
`ortholoc-edge bench-replay` takes (docs/sequences.md). What lies between the map and the photos is the kind, named as
in the OrthoLoC paper:

    same     the photos show the world of the map; only the sensors differ
    xDOP     the DOP shows another season and hour (crops, leaves, grass, cast shadows), other roofs, cars and trees, by
             another camera; the DSM is of the photos' time
    xDOPDSM  both layers of the map are older and coarser than the photos: buildings new or gone, more trees
             felled, the others grown, the DSM smoothed and noisy

Place, map and poses follow from the seed alone, so the kinds of one seed differ in nothing else. How the photos are
flown is a `Flight`: tilt, height, and the light that the camera is made for.
"""

from __future__ import annotations

import argparse
import csv
import sys
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from enum import StrEnum
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

import cv2
import numpy as np
import rasterio
from rasterio.transform import Affine
from tqdm import tqdm

from ortholoc_edge.bench import sequence
from ortholoc_edge.geometry import frames, rotation
from ortholoc_edge.geometry.arrays import BoolArray, Float32Array, FloatArray, ImageArray
from ortholoc_edge.geometry.camera import Camera
from ortholoc_edge.geometry.grid import RasterGrid
from ortholoc_edge.geometry.rigid import Rigid3
from ortholoc_edge.tiles.georeference import Georeference, VerticalDatum
from ortholoc_edge.tiles.window import MapLayers
from ortholoc_sim.camera import Placement, Renderer, Sensor, View
from ortholoc_sim.country import FRAME
from ortholoc_sim.detail import Detail
from ortholoc_sim.epoch import Epoch, near_infrared
from ortholoc_sim.layout import FLAT_COLOURS, ROOF_COLOURS, Building, Layout
from ortholoc_sim.lens import Exposure
from ortholoc_sim.photos import COLUMNS, flight_row
from ortholoc_sim.place import Place, make_place, rotated_crops
from ortholoc_sim.season import Moment, epoch_at, other_time, survey_time
from ortholoc_sim.world import FIRST_TREE, Cover, Scene, WorldSpec, build_scene

DOP_GSD_M, DSM_GSD_M = 0.2, 1.0
WIDTH_PX, HEIGHT_PX = 640, 480
_FOCAL_PX = (500.0, 700.0)
_MAX_TILT_DEG = 45.0
# Of the beta distribution of tilts: 7 % are above 30 degrees, the median is 13.
_TILT_SHAPE = (1.3, 2.9)
_MOST_TILTED_DEG = 80.0
# Of an oblique photo that lies inside the place: what is nearer than so many heights above ground. Beyond, the place
# may end.
_NEAR_HEIGHTS = 4.0
_ROLL_SIGMA_DEG = 2.5
LAP_SPEED_M_S = 15.0
# Half axes of a lap as parts of the place's sides; jitter of roll, pitch and yaw, 1-sigma.
_LAP_PART = 0.25
_LAP_JITTER_DEG = 1.0
# Of a photo's ground width: so far from the border is the middle of what it shows.
_BORDER_FOOTPRINTS = 1.2
_EDGE_M = 15.0
_ATTEMPTS = 10_000
# Shares of what stands: of trees in the map that are felled, of trees in the photos that are new, of buildings gone
# and new, of roofs repainted.
_FELLED, _GROWN_UP = 0.06, 0.04
_OLD_FELLED, _OLD_GROWN_UP, _TREE_GROWTH = 0.15, 0.10, 1.12
_GONE, _NEW = 0.08, 0.08
_REPAINTED = 0.25
_DSM_SIGMA_M, _OLD_DSM_SIGMA_M = 0.05, 0.3
_OLD_DSM_BLUR_M = 1.2
_DOP_JPEG_QUALITY = 90
_LASTING = (Cover.YARD, Cover.GRAVEL, Cover.ASPHALT, Cover.STREET, Cover.SHORE)

_Thing = TypeVar("_Thing")


class Kind(StrEnum):
    """What lies between the map and the photos."""

    SAME = "same"
    XDOP = "xDOP"
    XDOPDSM = "xDOPDSM"


class Spectrum(StrEnum):
    """Light that the photos' camera sees. The map is of visible light always."""

    VISIBLE = "visible"
    NIR = "nir"


@dataclass(frozen=True, slots=True)
class Flight:
    """How photos are taken.

    Attributes:
        height_m: least and most above ground.
        tilt_deg: least and most from straight down, all alike likely; None: up to 45 degrees, mostly little. From
            some 60 degrees on there is sky in the photos.
        spectrum: near infrared is one channel, written as grey.
        spacing_m: from photo to photo along a lap round the place, at the middle of the heights and tilts, at
            `LAP_SPEED_M_S`; None: every photo stands for itself.
    Raises: ValueError if least is more than most, or a photo may lie on the ground or show nothing but sky.
    """

    height_m: tuple[float, float] = (60.0, 150.0)
    tilt_deg: tuple[float, float] | None = None
    spectrum: Spectrum = Spectrum.VISIBLE
    spacing_m: float | None = None

    def __post_init__(self) -> None:
        if self.spacing_m is not None and not 0 < self.spacing_m < np.inf:
            raise ValueError(f"{self.spacing_m:g} m from photo to photo")
        if not 0 < self.height_m[0] <= self.height_m[1]:
            raise ValueError(f"height above ground from {self.height_m[0]:g} to {self.height_m[1]:g} m")
        if self.tilt_deg is not None and not 0 <= self.tilt_deg[0] <= self.tilt_deg[1] <= _MOST_TILTED_DEG:
            raise ValueError(
                f"tilt from {self.tilt_deg[0]:g} to {self.tilt_deg[1]:g} degrees, of at most {_MOST_TILTED_DEG:g}"
            )


@dataclass(frozen=True, slots=True, eq=False)
class Photo:
    """A photo of a flight.

    Attributes:
        image: (480, 640, 3) uint8 RGB.
        lasting_share: of its pixels, those that show what looks alike at all times: houses, ways, yards, shores. In a
            photo with next to none of them the plants alone would have to match.
    """

    image: ImageArray
    lasting_share: float


@dataclass(frozen=True)
class CrossDomain:
    """The map and the photos of a seed and a kind; the same arguments give the same pixels.

    Args:
        width_m, height_m, gsd_m: of the place and its rasters; both sides a whole number of metres.
    """

    kind: Kind
    seed: int = 1
    width_m: float = 1200.0
    height_m: float = 1000.0
    gsd_m: float = 0.125
    flown_as: Flight = Flight()

    @cached_property
    def place(self) -> Place:
        return make_place(self.seed, self.width_m, self.height_m, self.gsd_m)

    @cached_property
    def survey(self) -> Epoch:
        """How the place looked when the map was flown."""
        return epoch_at(survey_time(self.seed), "survey", self.seed * 2)

    @cached_property
    def flown(self) -> Moment:
        """When the photos were taken."""
        return survey_time(self.seed) if self.kind is Kind.SAME else other_time(self.seed)

    @cached_property
    def flight(self) -> Epoch:
        """How the place looks when the photos are taken."""
        return self.survey if self.kind is Kind.SAME else epoch_at(self.flown, "flight", self.seed * 2 + 1)

    @cached_property
    def placement(self) -> Placement:
        place = self.place
        middle = np.array([place.west_m + self.width_m / 2, place.south_m + self.height_m / 2])
        ground_m = float(np.median(place.world.terrain))
        return Placement(place.west_m, place.south_m, self.georeference.grid_scale(middle, ground_m))

    @cached_property
    def georeference(self) -> Georeference:
        place = self.place
        return Georeference(FRAME, VerticalDatum(kind="unknown"), (place.west_m, place.south_m))

    @cached_property
    def _detail(self) -> Detail:
        return Detail(self.seed, self.flown.season.bare)

    @cached_property
    def camera(self) -> Camera:
        focal_px = float(np.random.default_rng([self.seed, 110]).uniform(*_FOCAL_PX))
        return Camera.from_focal(WIDTH_PX, HEIGHT_PX, round(focal_px, 1))

    def of_kind(self, kind: Kind) -> CrossDomain:
        """The same place in another kind, not made anew."""
        other = replace(self, kind=kind)
        vars(other)["place"] = self.place
        return other

    def survey_scene(self) -> Scene:
        """The place when the map was flown."""
        return build_scene(replace(self.place.world, layout=survey_layout(self.place)), self.survey)

    def flight_scene(self) -> Scene:
        """The place when the photos were taken, in the light that they show."""
        if self.kind is Kind.SAME:
            layout = survey_layout(self.place)
        else:
            layout = flight_layout(self.place, self.kind, self.flight)
        epoch = near_infrared(self.flight) if self._is_infrared else self.flight
        return build_scene(replace(self.place.world, layout=layout), epoch)

    @property
    def looks_surveyed(self) -> bool:
        """Whether the photos show the map's own picture: `flight_scene` is `survey_scene`."""
        return self.kind is Kind.SAME and not self._is_infrared

    @property
    def _is_infrared(self) -> bool:
        return self.flown_as.spectrum is Spectrum.NIR

    def layers(self, scene: Scene, surface: Float32Array) -> MapLayers:
        """The map: its DOP of the scene of ``survey``, its DSM of the ``surface`` of a scene: the flight's for xDOP,
        where a crop that is a metre lower would move the photos, else the survey's."""
        west, north = self.place.west_m, self.place.south_m + self.height_m
        columns, rows = round(self.width_m / DOP_GSD_M), round(self.height_m / DOP_GSD_M)
        # A survey's orthophoto is resampled from pictures: it has no detail at its own pixel.
        soft = cv2.GaussianBlur(scene.texture, (0, 0), 0.45 * DOP_GSD_M / self.gsd_m)
        dop = cv2.resize(soft, (columns, rows), interpolation=cv2.INTER_AREA)
        dop_grid = RasterGrid(columns, rows, west, north, DOP_GSD_M, -DOP_GSD_M)
        columns, rows = round(self.width_m / DSM_GSD_M), round(self.height_m / DSM_GSD_M)
        dsm = np.asarray(cv2.resize(surface, (columns, rows), interpolation=cv2.INTER_AREA), dtype=np.float32)
        dsm_grid = RasterGrid(columns, rows, west, north, DSM_GSD_M, -DSM_GSD_M)
        rng = np.random.default_rng([self.seed, 111])
        white = rng.standard_normal(dsm.shape, dtype=np.float32)
        if self.kind is Kind.XDOPDSM:
            dsm = np.asarray(cv2.GaussianBlur(dsm, (0, 0), _OLD_DSM_BLUR_M / DSM_GSD_M), dtype=np.float32)
            # Errors of image matching hang together over some metres.
            smooth = cv2.GaussianBlur(rng.standard_normal(dsm.shape, dtype=np.float32), (0, 0), 2.5)
            noise = white * np.float32(0.6) + smooth / smooth.std() * np.float32(0.8)
            dsm = dsm + np.float32(_OLD_DSM_SIGMA_M) * noise
        else:
            dsm = dsm + np.float32(_DSM_SIGMA_M) * white
        return MapLayers(np.asarray(dop, dtype=np.uint8), dop_grid, np.asarray(dsm, dtype=np.float32), dsm_grid)

    def map_and_renderer(self) -> tuple[MapLayers, Renderer]:
        """The map, and what draws the photos."""
        scene = self.survey_scene()
        flown = scene if self.looks_surveyed else self.flight_scene()
        # The survey's half gigabyte is done with afterwards.
        return self.layers(scene, (flown if self.kind is Kind.XDOP else scene).surface), self.renderer(flown)

    def poses(self, count: int) -> list[Rigid3]:
        """``map_from_camera`` of independent views: position, height above ground, heading and tilt by lot, such that
        the photo lies inside and its middle 1.2 footprints from the border. Or of a lap.

        Raises: ValueError if the place is too small for them.
        """
        if self.flown_as.spacing_m is not None:
            return self._lap(self.flown_as.spacing_m, count)
        rng = np.random.default_rng([self.seed, 112])
        found: list[Rigid3] = []
        for _ in range(_ATTEMPTS + 50 * count):
            if len(found) == count:
                break
            pose = self._drawn(rng)
            if self._inside(pose):
                found.append(pose)
        if len(found) < count:
            raise ValueError(f"{self.width_m:.0f} x {self.height_m:.0f} m have no room for photos; take a larger place")
        return found

    def renderer(self, scene: Scene) -> Renderer:
        """Of clean pictures: the sensor's flaws are `Exposure`'s."""
        return Renderer(
            scene, self.placement, Sensor(1.0, 0.0, 0.0, 0.0, 0), level_by_pixel=self.flown_as.tilt_deg is not None
        )

    def photo(self, renderer: Renderer, map_from_camera: Rigid3, index: int) -> Photo:
        """Photo ``index`` of the flight, before JPEG."""
        view = renderer.view(self.camera, map_from_camera)
        eye, axis = map_from_camera.translation, map_from_camera.rotation[:, 2]
        distance_m = (eye[2] - float(np.nanmedian(view.points_map[..., 2]))) / -axis[2]
        clean = self._detail.added(view, np.array([self.place.west_m, self.place.south_m]), distance_m / self.camera.fx)
        if self._is_infrared:
            clean = np.repeat(clean[..., :1], 3, axis=2)
        image = self.exposure(index).expose(clean, self.camera, np.random.default_rng([self.seed, 113, index]))
        return Photo(image, self._lasting_share(view))

    def _lasting_share(self, view: View) -> float:
        world = self.place.world
        ground = np.isfinite(view.points_map[..., 2])
        local = np.nan_to_num(view.points_map[..., :2]) - (self.place.west_m, self.place.south_m)
        u, v = np.round(world.spec.grid.px_from_map(local)).astype(int).transpose(2, 0, 1)
        cover = world.cover[np.clip(v, 0, world.cover.shape[0] - 1), np.clip(u, 0, world.cover.shape[1] - 1)]
        house = (view.objects > 0) & (view.objects < FIRST_TREE)
        return float((house | (ground & (view.objects == 0) & np.isin(cover, _LASTING))).mean())

    def exposure(self, index: int) -> Exposure:
        """The camera of the flight with the settings of one photo."""
        camera = np.random.default_rng([self.seed, 114])
        return Exposure.drawn(camera, np.random.default_rng([self.seed, 115, index]), mild=self.kind is Kind.SAME)

    def _drawn(self, rng: np.random.Generator) -> Rigid3:
        xy = rng.uniform((0.0, 0.0), (self.width_m, self.height_m))
        height_m = rng.uniform(*self.flown_as.height_m)
        if self.flown_as.tilt_deg is None:
            tilt_deg = _MAX_TILT_DEG * rng.beta(*_TILT_SHAPE)
        else:
            tilt_deg = rng.uniform(*self.flown_as.tilt_deg)
        roll, yaw = np.radians(rng.normal(0.0, _ROLL_SIGMA_DEG)), rng.uniform(-np.pi, np.pi)
        return self._posed(xy, self._ground(xy) + height_m, (float(roll), float(np.radians(tilt_deg)), float(yaw)))

    def _posed(self, xy: FloatArray, above_m: float, angles_rad: tuple[float, float, float]) -> Rigid3:
        """Of the camera below a vehicle at a place (2,) and height of the map, with its roll, pitch and yaw."""
        # From grid north: the map's axes stand in for north, east, down.
        ned_from_body = rotation.from_euler(*angles_rad)
        map_from_camera = frames.map_from_ned_rotation(0.0) @ ned_from_body @ frames.BODY_FROM_NADIR_CAMERA
        return Rigid3(map_from_camera, np.array([xy[0] + self.place.west_m, xy[1] + self.place.south_m, above_m]))

    def _lap(self, spacing_m: float, count: int) -> list[Rigid3]:
        """Along an ellipse in the middle of the place, banked as its curvature needs."""
        axes = _LAP_PART * np.array([self.width_m, self.height_m])
        turns = np.linspace(0.0, 2.0 * np.pi, 10_000)
        around = axes * np.column_stack([np.cos(turns), np.sin(turns)])
        flown_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(around, axis=0), axis=1))])
        at = np.interp(spacing_m * np.arange(count) % flown_m[-1], flown_m, turns)
        rng = np.random.default_rng([self.seed, 117])
        above_m = float(np.median(self.place.world.terrain)) + float(np.mean(self.flown_as.height_m))
        tilt = np.radians(0.0 if self.flown_as.tilt_deg is None else np.mean(self.flown_as.tilt_deg))
        poses = []
        for turn in at:
            xy = 0.5 * np.array([self.width_m, self.height_m]) + axes * (np.cos(turn), np.sin(turn))
            ahead = axes * (-np.sin(turn), np.cos(turn))
            radius_m = float(np.linalg.norm(ahead)) ** 3 / float(axes[0] * axes[1])
            bank = -np.arctan2(LAP_SPEED_M_S**2, 9.81 * radius_m)  # to the left, the lap's inside
            roll, pitch, yaw = np.radians(rng.normal(0.0, _LAP_JITTER_DEG, 3))
            heading = float(np.arctan2(ahead[0], ahead[1]) + yaw)
            poses.append(self._posed(xy, above_m, (float(bank + roll), float(tilt + pitch), heading)))
        if not all(self._inside(pose) for pose in poses):
            raise ValueError(f"{self.width_m:.0f} x {self.height_m:.0f} m have no room for a lap; take a larger place")
        return poses

    def _ground(self, local: FloatArray) -> float:
        spec = self.place.world.spec
        u, v = np.clip(np.round(spec.grid.px_from_map(local)).astype(int), 0, np.array(spec.shape[::-1]) - 1)
        return float(self.place.world.terrain[v, u])

    def _inside(self, pose: Rigid3) -> bool:
        camera, place = self.camera, self.place
        ends = np.array([[0, 0], [WIDTH_PX - 1, 0], [WIDTH_PX - 1, HEIGHT_PX - 1], [0, HEIGHT_PX - 1]])
        px = np.concatenate([ends, [[camera.cx, camera.cy]]])
        rays = camera.unproject(px) @ pose.rotation.T
        if self.flown_as.tilt_deg is not None:
            return self._near_part_inside(pose, rays)
        if (rays[:, 2] > -0.1 * np.linalg.norm(rays, axis=1)).any():
            return False
        eye = pose.translation - (place.west_m, place.south_m, 0.0)
        # A little below the ground under the camera: the land slopes.
        depth_m = eye[2] - self._ground(eye[:2]) + 6.0
        ground = eye[:2] + rays[:, :2] / -rays[:, 2:] * depth_m
        footprint_m = depth_m / -rays[4, 2] * np.linalg.norm(rays[4]) * WIDTH_PX / camera.fx
        size = np.array([self.width_m, self.height_m])
        room = np.minimum(ground, size - ground).min(axis=1)
        return bool((room[:4] > _EDGE_M).all() and room[4] > _BORDER_FOOTPRINTS * footprint_m)

    def _near_part_inside(self, pose: Rigid3, rays: FloatArray) -> bool:
        """Whether an oblique view's rays (N, 3) end inside the place, or have gone `_NEAR_HEIGHTS` heights inside."""
        eye = pose.translation - (self.place.west_m, self.place.south_m, 0.0)
        depth_m = eye[2] - self._ground(eye[:2])
        reach = depth_m / np.maximum(-rays[:, 2], np.linalg.norm(rays[:, :2], axis=1) / _NEAR_HEIGHTS)
        ground = np.vstack([eye[:2], eye[:2] + rays[:, :2] * reach[:, None]])
        room = np.minimum(ground, np.array([self.width_m, self.height_m]) - ground)
        return bool((room > _EDGE_M).all())


def survey_layout(place: Place) -> Layout:
    """What the map shows: without what came later."""
    layout = place.world.layout
    buildings = _kept(layout.buildings, place.building_fate < 1.0 - _NEW)
    return replace(layout, buildings=buildings, trees=_kept(layout.trees, place.tree_fate < 1.0 - _OLD_GROWN_UP))


def flight_layout(place: Place, kind: Kind, epoch: Epoch) -> Layout:
    """What stands there when the photos of a kind other than "same" are taken."""
    layout, planted = place.world.layout, place.tree_fate
    born = 1.0 - _OLD_GROWN_UP
    buildings, built = layout.buildings, place.building_fate
    if kind is Kind.XDOPDSM:
        trees = tuple(
            replace(tree, radius_m=tree.radius_m * _TREE_GROWTH, height_m=tree.height_m * _TREE_GROWTH)
            for tree in _kept(layout.trees, planted >= _OLD_FELLED)
        )
        buildings, built = _kept(buildings, built >= _GONE), built[built >= _GONE]
    else:
        trees = _kept(layout.trees, (planted >= _FELLED) & (planted < born + _GROWN_UP))
        buildings, built = _kept(buildings, built < 1.0 - _NEW), built[built < 1.0 - _NEW]
    # By its fate, not in turn: a house has the same new colour whichever others are gone.
    painted = tuple(
        _repainted(house, np.random.default_rng([epoch.seed, 116, int(fate * 2**40)]))
        for house, fate in zip(buildings, built, strict=True)
    )
    return replace(rotated_crops(layout, epoch.seed), buildings=painted, trees=trees)


def _repainted(house: Building, rng: np.random.Generator) -> Building:
    if rng.random() >= _REPAINTED:
        return house
    colours = [c for c in ROOF_COLOURS + FLAT_COLOURS if c != house.colour]
    return replace(house, colour=colours[int(rng.integers(len(colours)))])


def _kept(things: tuple[_Thing, ...], mask: BoolArray) -> tuple[_Thing, ...]:
    return tuple(thing for thing, kept in zip(things, mask, strict=True) if kept)


# --- files ---


def write_set(out: Path, domain: CrossDomain, count: int, progress: bool = False) -> None:
    """Write map, photos and flight table to ``out``; the files are named after the folder.

    The table has a column of its own, ``lasting_share`` (`Photo`), to tell photos with little to match apart.

    Raises: ValueError as `CrossDomain.poses`.
    """
    poses = domain.poses(count)
    (out / "queries").mkdir(parents=True, exist_ok=True)
    name = out.resolve().name
    layers, renderer = domain.map_and_renderer()
    _write_layers(out, name, layers)
    start = datetime(2024, 1, 1) + timedelta(days=domain.flown.season.day - 1, hours=9)
    spacing_m = domain.flown_as.spacing_m
    # Minutes apart where every photo stands for itself.
    step = timedelta(minutes=1) if spacing_m is None else timedelta(seconds=spacing_m / LAP_SPEED_M_S)
    with (out / f"{name}_flight.csv").open("w", newline="", encoding="utf-8") as file:
        table = csv.writer(file)
        table.writerow((*COLUMNS, "lasting_share"))
        for k, pose in enumerate(tqdm(poses, disable=not progress, unit="photo")):
            filename = f"queries/{name}_{k:04d}.jpg"
            quality = domain.exposure(k).jpeg_quality
            photo = domain.photo(renderer, pose, k)
            cv2.imwrite(str(out / filename), photo.image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])
            when = start + k * step
            row = flight_row(filename, when, pose, domain.camera, domain.georeference)
            table.writerow([*row, f"{photo.lasting_share:.4f}"])


def _write_layers(out: Path, name: str, layers: MapLayers) -> None:
    jpeg = {"compress": "JPEG", "jpeg_quality": _DOP_JPEG_QUALITY, "photometric": "YCBCR", "interleave": "pixel"}
    _write_tif(out / f"{name}_dop.tif", np.moveaxis(layers.dop, 2, 0), layers.dop_grid, **jpeg)
    _write_tif(out / f"{name}_dsm.tif", layers.dsm[None], layers.dsm_grid, compress="DEFLATE", predictor=3)


def _write_tif(path: Path, bands: ImageArray | Float32Array, grid: RasterGrid, **options: Any) -> None:
    with rasterio.open(
        path, "w", driver="GTiff", count=len(bands), dtype=bands.dtype.name, width=grid.width, height=grid.height,
        crs=FRAME, transform=Affine(grid.dx, 0.0, grid.west, 0.0, grid.dy, grid.top), tiled=True, **options,
    ) as target:  # fmt: skip
        target.write(bands)


# --- for people ---


def contact_sheet(folder: Path, photos: Iterable[int], grid_scale: float) -> Iterator[ImageArray]:
    """Of a written set's photos, each beside its map as seen from the true pose, and the difference of the two.

    Made of the files alone, with the map's own rasters: what does not fit is seen.
    Args:
        photos: rows of the flight's table.
        grid_scale: metres of the map per true metre there.
    Returns: (480, 3 * 640, 3) RGB, one per photo.
    """
    dop_path, dsm_path = next(folder.glob("*_dop.tif")), next(folder.glob("*_dsm.tif"))
    with rasterio.open(dop_path) as source:
        dop = np.ascontiguousarray(np.moveaxis(source.read(), 0, 2))
        bounds, gsd_m = source.bounds, float(source.res[0])
    with rasterio.open(dsm_path) as source:
        dsm = source.read(1)
    surface = np.asarray(cv2.resize(dsm, dop.shape[1::-1], interpolation=cv2.INTER_LINEAR), dtype=np.float32)
    spec = WorldSpec(0, dop.shape[1] * gsd_m, dop.shape[0] * gsd_m, gsd_m)
    light = epoch_at(survey_time(0), "map", 0)  # lights façades, of which a map has none
    none = np.zeros(surface.shape, dtype=np.uint16)
    scene = Scene(spec, light, dop, surface, surface, none, (), (), ())
    renderer = Renderer(scene, Placement(bounds.left, bounds.bottom, grid_scale), Sensor(1.0, 0.0, 0.0, 0.5, 0))
    recorded = sequence.read_flight(folder)
    for index in photos:
        frame = recorded[index]
        photo = frame.image()
        seen = renderer.render(frame.camera, frame.map_from_camera)
        grey = [cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32) for image in (photo, seen)]
        levelled = [(g - g.mean()) / max(1.0, float(g.std())) for g in grey]
        difference = np.clip(128.0 + 40.0 * (levelled[0] - levelled[1]), 0, 255).astype(np.uint8)
        yield np.concatenate([photo, seen, cv2.merge([difference] * 3)], axis=1)


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description="Make a map and photos of another time over it, with true poses.")
    parser.add_argument("out", type=Path, metavar="OUT", help="folder of the set; its name is that of the files")
    parser.add_argument(
        "--kind", type=Kind, choices=list(Kind), default=Kind.XDOP, help="what lies between (default: %(default)s)"
    )
    parser.add_argument("--height", type=float, nargs=2, default=Flight().height_m, metavar=("MIN", "MAX"), help="of "
                        "the photos above ground, m (default: 60 150)")  # fmt: skip
    parser.add_argument("--tilt", type=float, nargs=2, metavar=("MIN", "MAX"), help="of the camera from straight down, "
                        "degrees; far ground and sky may be in view (default: mostly little, at most 45)")  # fmt: skip
    parser.add_argument("--spectrum", type=Spectrum, choices=list(Spectrum), default=Spectrum.VISIBLE, help="of the "
                        "photos; the map's is visible light (default: %(default)s)")  # fmt: skip
    parser.add_argument("--spacing", type=float, metavar="M", help="from photo to photo of a lap at 15 m/s (default: "
                        "photos that have nothing to do with each other)")  # fmt: skip
    parser.add_argument("--photos", type=int, default=100, help="how many (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=1, help="of place, looks and poses (default: %(default)s)")
    parser.add_argument("--sheets", type=int, default=0, metavar="N", help="write PNGs of the first N photos beside "
                        "their map to OUT/sheets (default: %(default)s)")  # fmt: skip
    options = parser.parse_args(arguments)
    try:
        flight = Flight(tuple(options.height), options.tilt and tuple(options.tilt), options.spectrum, options.spacing)
    except ValueError as err:
        parser.error(str(err))
    domain = CrossDomain(options.kind, options.seed, flown_as=flight)
    write_set(options.out, domain, options.photos, progress=True)
    if options.sheets:
        (options.out / "sheets").mkdir(exist_ok=True)
        count = range(min(options.sheets, options.photos))
        for k, sheet in zip(count, contact_sheet(options.out, count, domain.placement.grid_scale), strict=True):
            cv2.imwrite(str(options.out / "sheets" / f"{k:04d}.png"), sheet[..., ::-1])
    return 0


if __name__ == "__main__":
    sys.exit(main())
