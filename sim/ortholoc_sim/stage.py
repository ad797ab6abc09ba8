"""What a scenario is flown over: the world as the camera sees it, and the area pack that the daemon has of it.

Both follow from the scenario alone. A pack is kept in a folder under a name that holds all that it is made of; the
world's rasters are made anew by every process, since drawing them is as fast as reading them.
"""

from __future__ import annotations

import hashlib
import logging
import shutil
import tempfile
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import cv2
import msgspec
import numpy as np
import rasterio
from rasterio.transform import Affine
from rasterio.windows import Window

from ortholoc_edge.errors import MapError
from ortholoc_edge.geometry.arrays import Float32Array, FloatArray, ImageArray
from ortholoc_edge.geometry.camera import Camera
from ortholoc_edge.geometry.grid import RasterGrid
from ortholoc_edge.geometry.rigid import Rigid3
from ortholoc_edge.tiles.build import PackOptions, build_pack
from ortholoc_edge.tiles.georeference import Georeference
from ortholoc_edge.tiles.pack import Pack
from ortholoc_edge.tiles.store import MapStore
from ortholoc_edge.tiles.vertical import derive_offsets
from ortholoc_edge.tiles.window import MapLayers
from ortholoc_sim import demo_pack_path
from ortholoc_sim.camera import Placement, Renderer, Sensor
from ortholoc_sim.country import CENTRE, FLIGHT, FRAME, SURVEYS, Country, Look, blocks
from ortholoc_sim.crossdomain import DOP_GSD_M, DSM_GSD_M, CrossDomain, Kind
from ortholoc_sim.lens import smear_kernel
from ortholoc_sim.noise import blobs
from ortholoc_sim.recorded import Light, scene_of_map
from ortholoc_sim.scenario import CameraTable, MapTable, Scenario, WorldTable
from ortholoc_sim.site import Site
from ortholoc_sim.wide import WideRenderer, country_scene
from ortholoc_sim.world import Scene

logger = logging.getLogger(__name__)

# Raise it when worlds or packs come out differently: kept packs are then made anew.
_RECIPE = 1
UNDULATION_M = 47.3
_DSM_SIGMA_M = {Kind.SAME: 0.1, Kind.XDOP: 0.1, Kind.XDOPDSM: 0.4}
_DOP_SIGMA_M = 0.05
_STRIPS = 12
# Of the country: when its DOP and DSM were taken.
_COUNTRY_LOOKS: dict[Kind, tuple[Look, Look]] = {
    Kind.SAME: (FLIGHT, FLIGHT),
    Kind.XDOP: (SURVEYS[2023], FLIGHT),
    Kind.XDOPDSM: (SURVEYS[2021], SURVEYS[2021]),
}
DEMO = "demo"
_SOME_M, _COARSE_M = 600.0, 2.0
# A country's rasters are written in squares of so many pixels.
_BLOCK_PX = 2048
# Of a pack that is flown over: 200 MB of texture.
_MAX_PACK_PX = 64_000_000
# Of a pack's tiles, bytes in the middle of each file are turned over.
_DAMAGE_BYTES = 64


@dataclass(frozen=True, slots=True, eq=False)
class Grounds(ABC):
    """A world at the time of the flight.

    Attributes:
        site: its frames; by the true datum, whatever the pack says.
        low_m, size_m: (2,) its south-west corner in the map, and how far it reaches from there.
        ground_m: typical height of its ground.
    """

    site: Site
    low_m: FloatArray
    size_m: FloatArray
    ground_m: float

    @abstractmethod
    def renderer(self, sensor: Sensor, level_by_pixel: bool) -> Renderer | WideRenderer:
        """For a camera over it."""

    @abstractmethod
    def some(self) -> tuple[Scene, Placement]:
        """A part of it, of which others are made."""


@dataclass(frozen=True, slots=True, eq=False)
class SceneGrounds(Grounds):
    """Those that are drawn whole."""

    scene: Scene
    placement: Placement

    def renderer(self, sensor: Sensor, level_by_pixel: bool) -> Renderer | WideRenderer:
        return Renderer(self.scene, self.placement, sensor, level_by_pixel=level_by_pixel)

    def some(self) -> tuple[Scene, Placement]:
        return self.scene, self.placement


@dataclass(frozen=True, slots=True, eq=False)
class CountryGrounds(Grounds):
    """A rectangle of the endless country, drawn where it is flown over."""

    country: Country
    texel_m: float

    def renderer(self, sensor: Sensor, level_by_pixel: bool) -> Renderer | WideRenderer:
        return WideRenderer(
            self.country, FRAME, FLIGHT, sensor, ground_m=self.ground_m, grid_scale=self.site.grid_scale,
            texel_m=self.texel_m, level_by_pixel=level_by_pixel,
        )  # fmt: skip

    def some(self) -> tuple[Scene, Placement]:
        low = self.low_m + 0.5 * self.size_m - _SOME_M / 2
        bounds = (float(low[0]), float(low[1]), float(low[0]) + _SOME_M, float(low[1]) + _SOME_M)
        scene, corner = country_scene(self.country, FRAME, FLIGHT, bounds, self.texel_m)
        return scene, Placement(*corner, self.site.grid_scale)


def _domain(world: WorldTable, kind: Kind, seed: int | None = None) -> CrossDomain:
    return CrossDomain(kind, world.seed if seed is None else seed, world.width_m, world.height_m, world.gsd_m)


@lru_cache(maxsize=1)
def make_grounds(world: WorldTable, kind: Kind) -> Grounds:
    """The world of a scenario's ``[world]`` as it is when a map of ``kind`` is flown over.

    Raises: MapError for a pack that can't be flown over.
    """
    if world.pack is not None:
        return _grounds_of_pack(_pack_path(world.pack), world.light)
    if world.kind == "country":
        return _grounds_of_country(world)
    domain = _domain(world, kind)
    place = domain.place
    low = np.array([place.west_m, place.south_m])
    middle = low + 0.5 * np.array([world.width_m, world.height_m])
    ground_m = float(np.median(place.world.terrain))
    site = _site(middle, ground_m)
    return SceneGrounds(
        site, low, np.array([world.width_m, world.height_m]), ground_m, domain.flight_scene(),
        Placement(place.west_m, place.south_m, site.grid_scale),
    )  # fmt: skip


def _site(middle: FloatArray, ground_m: float) -> Site:
    vertical = derive_offsets("ellipsoid", None, UNDULATION_M, None)[0]
    return Site(Georeference(FRAME, vertical, (float(middle[0]), float(middle[1]))), np.append(middle, ground_m))


def _pack_path(pack: str) -> Path:
    return demo_pack_path() if pack == DEMO else Path(pack)


def _grounds_of_pack(path: Path, light: Light) -> Grounds:
    pack = Pack.open(path)
    with MapStore(pack, max_pixels=_MAX_PACK_PX) as store:
        scene, low = scene_of_map(store, None, light)
    middle = np.array(low) + 0.5 * np.array([scene.spec.width_m, scene.spec.height_m])
    site = Site(pack.georeference, np.append(middle, scene.spec.ground_m))
    size = np.array([scene.spec.width_m, scene.spec.height_m])
    return SceneGrounds(
        site, np.array(low), size, scene.spec.ground_m, scene, Placement(*low, site.grid_scale)
    )


def _grounds_of_country(world: WorldTable) -> Grounds:
    country, low, size = Country(world.seed), _country_low(world), np.array([world.width_m, world.height_m])
    reach = np.minimum(size, _SOME_M)
    west, south = low + 0.5 * (size - reach)
    columns, rows = (round(float(side) / _COARSE_M) for side in reach)
    coarse = RasterGrid(columns, rows, float(west), float(south) + rows * _COARSE_M, _COARSE_M, -_COARSE_M)
    ground_m = float(np.median(country.heights(coarse, FRAME, FLIGHT)))
    return CountryGrounds(_site(low + 0.5 * size, ground_m), low, size, ground_m, country, world.gsd_m)


def _country_low(world: WorldTable) -> FloatArray:
    """Around the place where the country has something of everything."""
    return np.asarray(np.array(CENTRE) - 0.5 * np.array([world.width_m, world.height_m]), dtype=np.float64)


# -- the pack ----------------------------------------------------------------


def pack_for(scenario: Scenario, folder: Path) -> Path:
    """The scenario's area pack, made below ``folder`` if it is not there.

    Raises: MapError if it can't be built.
    """
    world, table = scenario.world, scenario.map
    if world.pack is not None:
        return _pack_path(world.pack)
    # A damaged pack is a copy of the good one.
    recipe = msgspec.json.encode([_RECIPE, world, msgspec.structs.replace(table, damaged=0.0)])
    name = hashlib.sha256(recipe).hexdigest()[:16]
    whole = folder / name
    damaged = folder / f"{name}-damaged-{table.damaged:g}"
    try:
        if not (whole / "manifest.json").is_file():
            logger.info("making the map pack of %s: %.1f km2", scenario.name, world.width_m * world.height_m / 1e6)
            _build(world, table, whole)
        if table.damaged and not damaged.is_dir():
            _put_whole(damaged, lambda scratch: _damage(whole, scratch, table.damaged))
    except OSError as err:
        raise MapError(f"{folder}: the map pack of {scenario.name} can't be made there ({err}); see --packs") from err
    return damaged if table.damaged else whole


@lru_cache(maxsize=1)
def _layers(world: WorldTable, kind: Kind, seed: int | None) -> MapLayers:
    domain = _domain(world, kind, seed)
    survey = domain.survey_scene()
    return domain.layers(survey, domain.flight_scene().surface if kind is Kind.XDOP else survey.surface)


def _build(world: WorldTable, table: MapTable, out: Path) -> None:
    options = PackOptions(
        quality=80, vertical="ellipsoid", geoid_undulation_m=UNDULATION_M,
        attribution="generated by ortholoc_sim, not a real place", licence="CC0-1.0", true_ortho=True,
        dop_sigma_m=_DOP_SIGMA_M, dsm_sigma_m=_DSM_SIGMA_M[table.kind], max_hole_cells=0,
    )  # fmt: skip
    out.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=out.parent) as scratch:
        dop_path, dsm_path = Path(scratch) / "dop.tif", Path(scratch) / "dsm.tif"
        write = _write_country if world.kind == "country" else _write_place
        write(world, table, dop_path, dsm_path)
        _put_whole(out, lambda target: build_pack(dop_path, dsm_path, target, options))


def _write_place(world: WorldTable, table: MapTable, dop_path: Path, dsm_path: Path) -> None:
    layers = _layers(world, table.kind, table.world_seed)
    dop, dsm = layers.dop, layers.dsm + np.float32(table.height_error_m)
    if table.mirrored:
        dop, dsm = np.ascontiguousarray(dop[:, ::-1]), np.ascontiguousarray(dsm[:, ::-1])
    if table.hole_m is not None:
        west, south, east, north = table.hole_m
        grid = layers.dsm_grid
        rows = slice(max(0, round((world.height_m - north) / -grid.dy)), round((world.height_m - south) / -grid.dy))
        dsm[rows, max(0, round(west / grid.dx)) : round(east / grid.dx)] = np.nan
    _write(dop_path, layers.dop_grid, [(0, 0, np.moveaxis(dop, 2, 0))], photometric="RGB")
    _write(dsm_path, layers.dsm_grid, [(0, 0, dsm[None])], nodata=np.nan)


def _write_country(world: WorldTable, table: MapTable, dop_path: Path, dsm_path: Path) -> None:
    """Square by square: of 100 km2 there is never more than one in memory."""
    country, low = Country(world.seed), _country_low(world)
    dop_look, dsm_look = _COUNTRY_LOOKS[table.kind]

    def grid(gsd_m: float) -> RasterGrid:
        columns, rows = round(world.width_m / gsd_m), round(world.height_m / gsd_m)
        return RasterGrid(columns, rows, float(low[0]), float(low[1]) + rows * gsd_m, gsd_m, -gsd_m)

    dop, dsm = grid(DOP_GSD_M), grid(DSM_GSD_M)
    pictures = (
        (row, column, np.moveaxis(country.rgb(block, FRAME, dop_look), 2, 0))
        for row, column, block in blocks(dop, side_px=_BLOCK_PX)
    )
    _write(dop_path, dop, pictures, photometric="RGB")
    heights = (
        (row, column, country.heights(block, FRAME, dsm_look)[None])
        for row, column, block in blocks(dsm, side_px=_BLOCK_PX)
    )
    _write(dsm_path, dsm, heights, nodata=np.nan)


def _write(
    path: Path,
    grid: RasterGrid,
    parts: Iterable[tuple[int, int, ImageArray | Float32Array]],
    **options: object,
) -> None:
    """``parts``: row, column and (bands, h, w) of what is written there."""
    target = None
    try:
        for row, column, bands in parts:
            if target is None:
                target = rasterio.open(
                    path, "w", driver="GTiff", count=len(bands), dtype=bands.dtype.name, width=grid.width,
                    height=grid.height, crs=FRAME, transform=Affine(grid.dx, 0.0, grid.west, 0.0, grid.dy, grid.top),
                    tiled=True, **options,
                )  # fmt: skip
            target.write(bands, window=Window(column, row, bands.shape[2], bands.shape[1]))
    finally:
        if target is not None:
            target.close()


def _put_whole(out: Path, make: Callable[[Path], object]) -> None:
    """Make a folder under another name and rename it, so that what is there is whole."""
    scratch = Path(tempfile.mkdtemp(dir=out.parent))
    try:
        make(scratch / "pack")
        (scratch / "pack").replace(out)
    except OSError:
        # Another process may have been faster; its pack is as good.
        if not (out / "manifest.json").is_file():
            raise
    finally:
        shutil.rmtree(scratch, ignore_errors=True)


def _damage(whole: Path, out: Path, share: float) -> None:
    shutil.copytree(whole, out)
    # Of both layers, and those in the middle, where the route is.
    for layer in ("dop", "dsm"):
        tiles = sorted((out / layer).rglob("*.tif"))
        count = max(1, round(share * len(tiles)))
        first = (len(tiles) - count) // 2
        for path in tiles[first : first + count]:
            data = bytearray(path.read_bytes())
            middle = len(data) // 2
            for k in range(middle, min(middle + _DAMAGE_BYTES, len(data))):
                data[k] ^= 0xFF
            path.write_bytes(data)


# -- the camera --------------------------------------------------------------


class Studio:
    """Takes the pictures of a scenario's camera over its grounds."""

    def __init__(self, grounds: Grounds, table: CameraTable) -> None:
        self.camera = table.intrinsics().camera()
        self._table, self._grounds = table, grounds
        sensor = Sensor(table.gain, table.vignetting, table.noise, table.blur_px, table.jpeg_quality)
        self._sensor = sensor
        self._renderer = grounds.renderer(sensor, level_by_pixel=table.readout_ms > 0)
        self._water: Renderer | None = None

    def row_times_ms(self) -> list[float]:
        """Times at which poses are wanted for a picture, ms from mid-exposure: one of a global shutter, one for each
        strip of rows of a rolling one."""
        if not self._table.readout_ms:
            return [0.0]
        return [self._table.readout_ms * ((k + 0.5) / _STRIPS - 0.5) for k in range(_STRIPS)]

    def picture(self, poses: Sequence[Rigid3], smear: tuple[Rigid3, Rigid3] | None, seed: int) -> ImageArray:
        """(H, W, 3) RGB.

        Args:
            poses: ``map_from_camera`` at `row_times_ms`.
            smear: poses at the exposure's begin and end, where it is long enough to smear.
            seed: of the noise.
        """
        return self._taken(self._renderer, poses, smear, seed)

    def of_water(self, poses: Sequence[Rigid3], seed: int) -> ImageArray:
        """The same with nothing but water below: waves, that are elsewhere in every picture."""
        if self._water is None:
            scene, placement = self._grounds.some()
            self._water = Renderer(flooded(scene), placement, self._sensor)
        middle = poses[len(poses) // 2]
        drift = np.random.default_rng([seed, 62]).uniform(-40.0, 40.0, 2)
        moved = Rigid3(middle.rotation, middle.translation + np.append(drift, 0.0))
        return self._water.render(self.camera, moved, seed)

    def black(self, seed: int) -> ImageArray:
        """What a covered lens shows: the sensor's noise."""
        rng = np.random.default_rng([seed, 63])
        noise = self._table.noise * rng.standard_normal((self.camera.height, self.camera.width, 3))
        return np.clip(2.0 + noise, 0, 255).astype(np.uint8)

    def _taken(
        self, renderer: Renderer | WideRenderer, poses: Sequence[Rigid3], smear: tuple[Rigid3, Rigid3] | None, seed: int
    ) -> ImageArray:
        if len(poses) == 1:
            clean = renderer.clean(self.camera, poses[0])
        else:
            edges = np.round(np.linspace(0, self.camera.height, len(poses) + 1)).astype(int)
            strips = [
                renderer.clean(_rows(self.camera, int(top), int(end)), pose)
                for top, end, pose in zip(edges[:-1], edges[1:], poses, strict=True)
            ]
            clean = np.concatenate(strips)
        if smear is not None:
            clean = self._smeared(clean, *smear)
        return self._sensor.expose(clean, self.camera, seed)

    def _smeared(self, clean: ImageArray, begin: Rigid3, end: Rigid3) -> ImageArray:
        """Along the way that the picture's middle goes during the exposure."""
        camera = self.camera
        axis = begin.rotation[:, 2]
        depth_m = (begin.translation[2] - self._grounds.ground_m) / max(-float(axis[2]), 0.1)
        point = begin.translation + axis * depth_m
        px = camera.project((end.inverse() @ Rigid3(np.eye(3), point)).translation[None])[0]
        way = np.asarray(px, dtype=np.float64) - (camera.cx, camera.cy)
        length_px = float(np.hypot(*way))
        if length_px < 0.3:
            return clean
        offsets = np.linspace(-0.5, 0.5, int(np.ceil(2 * length_px)) + 1)[:, None] * way
        return np.asarray(cv2.filter2D(clean, -1, smear_kernel(offsets)), dtype=np.uint8)


def _rows(camera: Camera, top: int, end: int) -> Camera:
    """The part of a camera that sees rows ``top`` to ``end``."""
    return replace(camera, height=end - top, cy=camera.cy - top)


def flooded(scene: Scene) -> Scene:
    """A scene under water."""
    shape, gsd = scene.surface.shape, scene.spec.gsd_m
    waves = blobs(shape, 1.5 / gsd, scene.spec.seed + 300) + 0.6 * blobs(shape, 6.0 / gsd, scene.spec.seed + 301)
    tone = np.array(scene.epoch.water, dtype=np.float32)
    texture = np.clip(tone * (1.0 + 0.08 * waves[..., None]), 0, 255).astype(np.uint8)
    level = np.full(shape, float(np.median(scene.terrain)), dtype=np.float32)
    return replace(
        scene, texture=texture, surface=level, objects=np.zeros_like(scene.objects), buildings=(), trees=(), cars=()
    )
