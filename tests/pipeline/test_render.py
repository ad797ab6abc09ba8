"""The map in perspective, against rays cast in double precision by this file: where they land, and what they show."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
from scenes_pipeline import turned_down

from ortholoc_edge.geometry.arrays import BoolArray, FloatArray
from ortholoc_edge.geometry.camera import Camera
from ortholoc_edge.geometry.grid import RasterGrid, bilinear
from ortholoc_edge.geometry.rigid import Rigid3
from ortholoc_edge.pipeline.prior import MAX_RANGE_HEIGHTS
from ortholoc_edge.pipeline.render import RenderedView, Terrain, render, surface_points
from ortholoc_edge.tiles.georeference import LocalFrame
from ortholoc_edge.tiles.window import MapWindow

Surface = Callable[[FloatArray, FloatArray], FloatArray]

# Where UTM's coordinates are: float32 has steps of half a metre there.
EAST, NORTH = 647_123.4, 5_407_891.7
GROUND_M = 431.0
CAMERA = Camera.from_focal(320, 240, 270.0)


def level(_east: FloatArray, _north: FloatArray) -> FloatArray:
    return np.full(np.broadcast(_east, _north).shape, GROUND_M)


def ramp(east: FloatArray, north: FloatArray) -> FloatArray:
    return GROUND_M + 0.12 * east - 0.2 * north


def hills(east: FloatArray, north: FloatArray) -> FloatArray:
    """Slopes to 0.3."""
    return GROUND_M + 3.0 * np.sin(east / 14.0) * np.cos(north / 17.0) + 1.5 * np.sin((east + north) / 11.0)


def house(east: FloatArray, north: FloatArray) -> FloatArray:
    """Of 20 by 14 m and 9 m high."""
    return np.where((np.abs(east - 3) <= 10) & (np.abs(north + 4) <= 7), GROUND_M + 9.0, GROUND_M)


def wall(east: FloatArray, north: FloatArray) -> FloatArray:
    """2.5 m thick and 12 m high, across the map."""
    return np.where(np.abs(north - 13.0) <= 1.25, GROUND_M + 12.0, GROUND_M) + 0.0 * east


def paint(east: FloatArray, north: FloatArray) -> FloatArray:
    """Grey levels, of waves no shorter than 5 m."""
    return (
        128.0
        + 40.0 * np.sin(2 * np.pi * (0.9 * east + 0.3 * north) / 7.3)
        + 40.0 * np.sin(2 * np.pi * (-0.4 * east + north) / 6.1 + 1.0)
        + 30.0 * np.sin(2 * np.pi * (east + north) / 19.0 + 2.0)
    )


@dataclass(frozen=True)
class Place:
    """A painted surface around (EAST, NORTH): rasters of 2 ``reach_m`` a side."""

    surface: Surface
    dsm_m: float = 0.5
    dop_m: float = 0.25
    dsm_shift_m: tuple[float, float] = (0.0, 0.0)
    dsm_up: float = -1.0
    dop_up: float = -1.0
    scale: float = 1.0
    reach_m: float = 100.0
    origin: tuple[float, float] = (EAST + 11.0, NORTH - 7.0)

    @property
    def local(self) -> LocalFrame:
        return LocalFrame(*self.origin, self.scale)

    def grid(self, pixel_m: float, up: float, shift: tuple[float, float] = (0.0, 0.0)) -> RasterGrid:
        side = round(2 * self.reach_m / pixel_m)
        top = NORTH + shift[1] - up * self.reach_m
        return RasterGrid(side, side, EAST + shift[0] - self.reach_m, top, pixel_m, up * pixel_m)

    @property
    def window(self) -> MapWindow:
        """A copy of its own."""
        made = _painted(self)
        return MapWindow(made.dop_grey.copy(), made.dop_valid.copy(), made.dop_grid, made.dsm.copy(), made.dsm_grid)

    def pose(
        self,
        height_m: float = 60.0,
        tilt_deg: float = 0.0,
        heading_deg: float = 33.0,
        roll_deg: float = 0.0,
        north_m: float = 0.0,
    ) -> Rigid3:
        """``local_from_camera``, ``north_m`` of (EAST, NORTH)."""
        at = self.local.local_from_map([EAST, NORTH + north_m, GROUND_M + height_m])
        return Rigid3(turned_down(tilt_deg, heading_deg, roll_deg), at)


@functools.lru_cache(maxsize=8)
def _painted(place: Place) -> MapWindow:
    dsm_grid = place.grid(place.dsm_m, place.dsm_up, place.dsm_shift_m)
    dop_grid = place.grid(place.dop_m, place.dop_up)
    dsm = place.surface(*_centres(dsm_grid)).astype(np.float32)
    dop = np.rint(paint(*_centres(dop_grid))).astype(np.uint8)
    return MapWindow(dop, np.ones(dop.shape, np.bool_), dop_grid, dsm, dsm_grid)


def _centres(grid: RasterGrid) -> tuple[FloatArray, FloatArray]:
    u, v = np.meshgrid(np.arange(grid.width), np.arange(grid.height))
    at = grid.map_from_px(np.stack([u, v], axis=-1)) - (EAST, NORTH)
    return at[..., 0], at[..., 1]


def terrain_of(window: MapWindow, local: LocalFrame) -> Terrain:
    made = Terrain.of(window, local)
    assert made is not None
    return made


def drawn(place: Place, pose: Rigid3, camera: Camera = CAMERA, window: MapWindow | None = None) -> RenderedView:
    view = render(terrain_of(window or place.window, place.local), camera, pose)
    assert view.image.shape == view.valid.shape == (camera.height, camera.width)
    assert view.image.dtype == np.uint8
    assert view.valid.dtype == np.bool_
    return view


def every_px(camera: Camera, step: int = 1) -> FloatArray:
    u, v = np.meshgrid(np.arange(0, camera.width, step), np.arange(0, camera.height, step))
    return np.stack([u, v], axis=-1).reshape(-1, 2).astype(np.float64)


def shown(view: RenderedView, step: int = 1) -> FloatArray:
    px = every_px(view.camera, step)
    return px[view.valid[px[:, 1].astype(int), px[:, 0].astype(int)]]


def cast(place: Place, view: RenderedView, px: FloatArray, dsm: np.ndarray, grid: RasterGrid) -> FloatArray:
    """Local points where rays first meet the bilinear surface: by looking every third of a cell, then bisecting. NaN
    where they leave the raster."""
    centre, local = view.local_from_camera.translation, place.local
    rays = view.camera.unproject(px) @ view.local_from_camera.rotation.T

    def above(depth: FloatArray) -> FloatArray:
        points = local.map_from_local(centre + rays * depth[:, None])
        return points[:, 2] - bilinear(dsm, grid.px_from_map(points[:, :2]))

    highest, lowest = float(np.nanmax(dsm)), float(np.nanmin(dsm))
    first = (centre[2] - highest - 0.01) / -rays[:, 2]
    last = (centre[2] - lowest + 0.01) / -rays[:, 2]
    run = np.linalg.norm(rays[:, :2], axis=1) * (last - first)
    steps = max(int(np.ceil(3.0 * run.max() / grid.gsd_m)), 60)
    low, high, found = first.copy(), last.copy(), np.zeros(len(px), np.bool_)
    for part in np.linspace(0.0, 1.0, steps + 1)[1:]:
        depth = first + part * (last - first)
        hits = ~found & (above(depth) <= 0)
        high[hits] = depth[hits]
        found |= hits
        low[~found] = depth[~found]
    for _ in range(40):
        middle = 0.5 * (low + high)
        inside = above(middle) <= 0
        high, low = np.where(inside, middle, high), np.where(inside, low, middle)
    return np.where(found[:, None], centre + rays * high[:, None], np.nan)


def on_plane(view: RenderedView, px: FloatArray, east: float, north: float, at: FloatArray) -> FloatArray:
    """Local points where rays meet the plane through ``at`` with these slopes per local metre."""
    centre = view.local_from_camera.translation
    rays = view.camera.unproject(px) @ view.local_from_camera.rotation.T
    normal = np.array([-east, -north, 1.0])
    return np.asarray(centre + rays * (((at - centre) @ normal) / (rays @ normal))[:, None])


# -- where pixels land -------------------------------------------------------

CAMERAS = {
    "plain": CAMERA,
    "off centre": Camera(320, 240, 270.0, 231.0, 104.2, 171.9),
    "portrait": Camera(181, 333, 290.0, 300.0, 92.3, 160.0),
    "odd": Camera.from_focal(127, 95, 110.0),
}


def nodes_px(view: RenderedView) -> FloatArray:
    """Where rays are marched: every fourth pixel's corner, as the net begins half a node inside."""
    px = every_px(view.camera, 4) + 1.5
    px = px[(px[:, 0] < view.camera.width - 1) & (px[:, 1] < view.camera.height - 1)]
    return px[view.valid[px[:, 1].astype(int), px[:, 0].astype(int)]]


# Of the points' heights over the surface, half, nine tenths and 99 of 100 of the pixels, m. Between the net's nodes
# (1 m on the ground below, 6 m at the far end of the view at 65 degrees) crests are cut off.
OFF_M = {0.0: (0.01, 0.01, 0.02), 30.0: (0.01, 0.02, 0.08), 50.0: (0.02, 0.12, 0.8), 65.0: (0.05, 0.6, 2.5)}


@pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS)
@pytest.mark.parametrize("tilt_deg", OFF_M)
def test_points_lie_on_their_rays_and_on_the_surface(camera: Camera, tilt_deg: float) -> None:
    place = Place(hills, scale=0.9996, reach_m=220.0, dop_m=1.0)
    window = place.window
    # Pixels of 0.22 m below.
    view = drawn(place, place.pose(0.22 * camera.focal_px, tilt_deg, roll_deg=7.0), camera, window)

    def above(px: FloatArray) -> FloatArray:
        points = view.points_local(px)
        back = camera.project(view.local_from_camera.inverse().apply(points))
        assert np.abs(back - px).max() < 1e-6
        off = points[:, 2] - bilinear(
            window.dsm, window.dsm_grid.px_from_map(place.local.map_from_local(points)[:, :2])
        )
        assert np.isfinite(off).all()
        return np.abs(off)

    px = shown(view, 3) + np.random.default_rng(0).uniform(0.05, 0.4, 2)
    px = px[camera.contains(px + 1)]
    assert len(px) > 0.4 * len(every_px(camera, 3))
    assert (np.quantile(above(px), (0.5, 0.9, 0.99)) < OFF_M[tilt_deg]).all()
    # At the nodes, where every ray is marched, it is exact.
    assert np.quantile(above(nodes_px(view)), 0.99) < 0.02


def test_no_pixels_no_points() -> None:
    place = Place(level, reach_m=40.0)
    view = drawn(place, place.pose())
    assert view.points_local(np.empty((0, 2))).shape == (0, 3)


@pytest.mark.parametrize("tilt_deg", [0.0, 40.0, 65.0])
@pytest.mark.parametrize("scale", [0.9996, 1.0, 1.0004])
@pytest.mark.parametrize("surface", [level, ramp])
def test_planes_are_exact(surface: Surface, scale: float, tilt_deg: float) -> None:
    place = Place(surface, scale=scale, reach_m=250.0, dsm_m=1.0, dop_m=1.0)
    view = drawn(place, place.pose(tilt_deg=tilt_deg, heading_deg=-75.0))
    px = shown(view, 5)
    assert len(px) > 1000
    at = place.local.local_from_map([EAST, NORTH, GROUND_M])
    east, north = (0.0, 0.0) if surface is level else (0.12 * scale, -0.2 * scale)
    truth = on_plane(view, px, east, north, at)
    distance = np.linalg.norm(truth - view.local_from_camera.translation, axis=1)
    off = np.linalg.norm(view.points_local(px) - truth, axis=1)
    # OpenCV interpolates at 1/32 of a node: of a slope of 0.23 centimetres of way at a glancing angle.
    assert (off / distance).max() < 1e-3
    assert np.median(off) < 0.01


@pytest.mark.parametrize("origin", [(0.0, 0.0), (EAST, NORTH)], ids=["far", "near"])
def test_an_origin_in_the_distance_moves_nothing(origin: tuple[float, float]) -> None:
    here, there = Place(hills, reach_m=60.0), Place(hills, reach_m=60.0, origin=origin)
    one, two = (drawn(place, place.pose(tilt_deg=20.0)) for place in (here, there))
    assert np.array_equal(one.valid, two.valid)
    px = shown(one, 7)
    apart = here.local.map_from_local(one.points_local(px)) - there.local.map_from_local(two.points_local(px))
    assert np.abs(apart).max() < 1e-3


@pytest.mark.parametrize("tilt_deg", [0.0, 35.0, 55.0, 65.0])
@pytest.mark.parametrize("surface", [house, wall, hills], ids=["house", "wall", "hills"])
def test_rays_end_at_the_first_thing_they_meet(surface: Surface, tilt_deg: float) -> None:
    """Away from edges, where a pixel's neighbours look at another thing."""
    place = Place(surface, reach_m=200.0, dop_m=1.0)
    window = place.window
    # Looking north, so that the wall stands across.
    view = drawn(place, place.pose(50.0, tilt_deg, heading_deg=8.0), window=window)
    px = shown(view, 6)
    truth = cast(place, view, px, window.dsm, window.dsm_grid)
    off = np.linalg.norm(view.points_local(px) - truth, axis=1)
    distance = np.linalg.norm(truth - view.local_from_camera.translation, axis=1)
    far = (off / distance)[~at_edge(truth, view, px)]
    assert len(far) > 0.4 * len(px)
    assert (far > 0.003).mean() < 0.005, np.quantile(far, [0.9, 0.99, 0.999, 1.0])


def at_edge(truth: FloatArray, view: RenderedView, px: FloatArray) -> BoolArray:
    """Pixels on a net whose true points jump beside them, by more than twice what the ground there would."""
    depth = (truth - view.local_from_camera.translation) @ view.local_from_camera.rotation[:, 2]
    image = np.full((view.camera.height, view.camera.width), np.nan)
    image[px[:, 1].astype(int), px[:, 0].astype(int)] = depth
    net = image[::6, ::6]
    jump = np.zeros(net.shape, np.bool_)
    for axis in (0, 1):
        # The second difference: a plane's is small, however it tilts.
        second = np.abs(np.diff(net, n=2, axis=axis)) > 0.5
        for k in range(3):
            part = [slice(None), slice(None)]
            part[axis] = slice(k, k + second.shape[axis])
            jump[tuple(part)] |= second
    jump = grown(jump, 1)
    return jump[px[:, 1].astype(int) // 6, px[:, 0].astype(int) // 6]


def test_roof_is_shown_and_what_is_behind_the_house_is_not() -> None:
    place = Place(house, reach_m=120.0)
    view = drawn(place, place.pose(30.0, 50.0, heading_deg=0.0, north_m=-40.0))
    inverse = view.local_from_camera.inverse()

    def seen_px(east: float, north: float, up: float) -> FloatArray:
        point = place.local.local_from_map([EAST + east, NORTH + north, GROUND_M + up])
        return view.camera.project(inverse.apply(point))[None]

    roof = seen_px(3.0, -1.0, 9.0)
    point = place.local.map_from_local(view.points_local(roof))[0] - (EAST, NORTH, GROUND_M)
    assert point == pytest.approx([3.0, -1.0, 9.0], abs=0.1)
    # 2 m behind the house: the ray there meets the roof before.
    hidden = seen_px(3.0, 5.0, 0.0)
    point = place.local.map_from_local(view.points_local(hidden))[0] - (EAST, NORTH, GROUND_M)
    assert point[2] == pytest.approx(9.0, abs=0.1)
    assert point[1] < 3.0
    # The shadow of 9 m of height ends before this.
    free = seen_px(3.0, 30.0, 0.0)
    point = place.local.map_from_local(view.points_local(free))[0] - (EAST, NORTH, GROUND_M)
    assert point == pytest.approx([3.0, 30.0, 0.0], abs=0.2)


# -- what pixels show --------------------------------------------------------

GRIDS = {
    "alike": Place(level),
    "coarse surface": Place(level, dsm_m=2.0, dop_m=0.2),
    "fine surface": Place(level, dsm_m=0.2, dop_m=0.6),
    "offset surface": Place(level, dsm_m=1.0, dsm_shift_m=(0.37, -0.61)),
    "south up": Place(level, dsm_up=1.0, dop_up=1.0),
    "one south up": Place(level, dsm_up=1.0),
    "other south up": Place(level, dop_up=1.0, dsm_m=1.0),
    "scaled down": Place(level, scale=0.9996),
    "scaled up": Place(level, scale=1.0004),
}


def block_shifts(view: RenderedView, truth: FloatArray, side: int = 40) -> FloatArray:
    """Shift (K, 2) in px of each fully valid block of a view against the true grey levels (H, W), by least squares
    over their slopes, with brightness and contrast free."""
    down, across = np.gradient(truth)
    shifts = []
    for top in range(0, view.camera.height - side + 1, side):
        for left in range(0, view.camera.width - side + 1, side):
            at = np.s_[top : top + side, left : left + side]
            if not view.valid[at].all():
                continue
            columns = [across[at].ravel(), down[at].ravel(), truth[at].ravel(), np.ones(side * side)]
            solved = np.linalg.lstsq(np.stack(columns, axis=1), view.image[at].ravel().astype(np.float64), rcond=None)
            # I(x) = T(x - d) = T - d T'.
            shifts.append(-solved[0][:2] / solved[0][2])
    return np.array(shifts)


def painted_truth(place: Place, view: RenderedView) -> FloatArray:
    at = place.local.local_from_map([EAST, NORTH, GROUND_M])
    points = place.local.map_from_local(on_plane(view, every_px(view.camera), 0.0, 0.0, at))
    grey = paint(points[:, 0] - EAST, points[:, 1] - NORTH)
    return np.asarray(grey.reshape(view.camera.height, view.camera.width))


@pytest.mark.parametrize("tilt_deg", [0.0, 35.0])
@pytest.mark.parametrize("place", GRIDS.values(), ids=GRIDS)
def test_the_picture_is_where_it_belongs(place: Place, tilt_deg: float) -> None:
    view = drawn(place, place.pose(40.0, tilt_deg))
    shifts = block_shifts(view, painted_truth(place, view))
    assert len(shifts) >= 30
    assert np.abs(shifts).max() < 0.1
    assert np.abs(shifts.mean(axis=0)).max() < 0.03


@pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS)
def test_the_picture_is_where_it_belongs_in_every_camera(camera: Camera) -> None:
    place = Place(level)
    view = drawn(place, place.pose(camera.focal_px * 0.15, 20.0, 120.0, -9.0), camera)
    shifts = block_shifts(view, painted_truth(place, view), 30)
    assert len(shifts) >= 12
    assert np.abs(shifts).max() < 0.1


@pytest.mark.parametrize("factor", [1.0, 1.5, 2.0, 3.1, 4.5])
def test_the_picture_stays_in_place_from_whichever_level_it_is_drawn(factor: float) -> None:
    """Higher up, from a coarser picture of the map: a level that is off by half a pixel would show."""
    place = Place(level, dop_m=0.1, dsm_m=1.0, reach_m=90.0)
    camera = CAMERA
    view = drawn(place, place.pose(27.0 * factor), camera)
    shifts = block_shifts(view, painted_truth(place, view))
    assert len(shifts) >= 20
    assert np.abs(shifts).max() < 0.1


def test_grazing_view_shows_the_map_in_place() -> None:
    """At 65 degrees, where the net's nodes are far apart on the ground."""
    place = Place(level, reach_m=120.0)
    view = drawn(place, place.pose(30.0, 65.0))
    # Waves of 6 m are too fine in the distance: only the near half.
    truth = painted_truth(place, view)
    near = dataclasses.replace(view, valid=view.valid & (np.arange(240) >= 120)[:, None])
    shifts = block_shifts(near, truth)
    assert len(shifts) >= 16
    assert np.abs(shifts).max() < 0.1


# -- what is not shown -------------------------------------------------------


def test_sky_and_distance_are_invalid() -> None:
    place = Place(level, reach_m=400.0, dsm_m=1.0, dop_m=1.0)
    view = drawn(place, place.pose(40.0, 80.0, roll_deg=12.0))
    rays = CAMERA.unproject(every_px(CAMERA)) @ view.local_from_camera.rotation.T
    heights_away = np.where(rays[:, 2] < 0, -1.0 / np.minimum(rays[:, 2], -1e-9), np.inf)
    valid = view.valid.ravel()
    assert not valid[heights_away > MAX_RANGE_HEIGHTS].any()
    assert (heights_away > MAX_RANGE_HEIGHTS).mean() > 0.2
    # Two nodes of the net is all that the rim may cost.
    falling = -rays[:, 2].reshape(240, 320)
    beside = np.full_like(falling, np.inf)
    for dx in (-8, 0, 8):
        for dy in (-8, 0, 8):
            beside = np.minimum(beside, np.roll(falling, (dy, dx), axis=(0, 1)))
    inner = np.zeros_like(view.valid)
    inner[8:-8, 8:-8] = True
    assert view.valid[inner & (beside * MAX_RANGE_HEIGHTS > 1.0)].all()
    assert np.isfinite(view.points_local(shown(view, 2))).all()


def test_a_view_of_nothing_but_sky() -> None:
    place = Place(level, reach_m=40.0)
    view = drawn(place, place.pose(40.0, 150.0))
    assert not view.valid.any()


def test_beside_the_window_is_invalid() -> None:
    place = Place(level, reach_m=20.0)
    view = drawn(place, place.pose(60.0))
    assert 0.05 < view.valid.mean() < 0.9
    px = every_px(CAMERA, 2)
    points = place.local.map_from_local(view.points_local(px))[:, :2] - (EAST, NORTH)
    away = np.abs(points).max(axis=1)
    valid = view.valid[::2, ::2].ravel()
    assert not valid[away > 20.0].any()
    assert valid[away < 20.0 - 3.0].all()


def hole_in(grid: RasterGrid) -> BoolArray:
    """A pond of 12 by 9 m."""
    east, north = _centres(grid)
    return (np.abs(east - 4.0) < 6.0) & (np.abs(north + 2.0) < 4.5)


@pytest.mark.parametrize("tilt_deg", [0.0, 40.0])
def test_holes_of_the_surface_are_invalid(tilt_deg: float) -> None:
    place = Place(level, reach_m=100.0)
    window = place.window
    holed = hole_in(window.dsm_grid)
    window.dsm[holed] = np.nan
    view = drawn(place, place.pose(50.0, tilt_deg), window=window)
    # The ground's true points: where those lie in the pond nothing is known.
    at = place.local.local_from_map([EAST, NORTH, GROUND_M])
    px = every_px(CAMERA)
    ground = place.local.map_from_local(on_plane(view, px, 0.0, 0.0, at))[:, :2]
    unknown = np.isnan(bilinear(window.dsm, window.dsm_grid.px_from_map(ground))).reshape(240, 320)
    around = grown(unknown, 5)
    assert unknown.sum() > 500
    inner = ~grown(~unknown, 5)
    assert inner.sum() > 100
    assert not view.valid[inner].any()
    # On the pond's rim the surface is drawn down to nothing; two nodes and a cell are lost.
    assert view.valid[~grown(around, 9)].all()


def grown(mask: BoolArray, px: int) -> BoolArray:
    out = mask.copy()
    for axis in (0, 1):
        spread = out.copy()
        for k in range(1, px + 1):
            for sign in (-1, 1):
                moved = np.roll(out, sign * k, axis=axis)
                # Nothing comes around the other side.
                edge = [slice(None), slice(None)]
                edge[axis] = slice(0, k) if sign > 0 else slice(-k, None)
                moved[tuple(edge)] = False
                spread |= moved
        out = spread
    return out


@pytest.mark.parametrize("height_m", [50.0, 200.0], ids=["fine picture", "coarse picture"])
def test_holes_of_the_orthophoto_are_invalid(height_m: float) -> None:
    place = Place(level, reach_m=200.0, dsm_m=1.0)
    window = place.window
    window.dop_valid[hole_in(window.dop_grid)] = False
    window.dop_grey[~window.dop_valid] = 0
    view = drawn(place, place.pose(height_m, 20.0), window=window)
    at = place.local.local_from_map([EAST, NORTH, GROUND_M])
    ground = place.local.map_from_local(on_plane(view, every_px(CAMERA), 0.0, 0.0, at))[:, :2]
    known = np.where(window.dop_valid, np.float32(1), np.float32(np.nan))
    unknown = np.isnan(bilinear(known, window.dop_grid.px_from_map(ground))).reshape(240, 320)
    assert unknown.sum() > 50
    # To the pixel, but for the 1/32 px that OpenCV rounds to.
    assert view.valid[unknown].mean() < 0.02
    assert not view.valid[~grown(~unknown, 1)].any()
    assert view.valid[~grown(unknown, 3)].mean() > 0.999


@pytest.mark.parametrize("up", [-1.0, 1.0])
def test_a_window_of_two_by_two_cells(up: float) -> None:
    # Its centres are 100 m apart, around a view of 70 by 53 m.
    place = Place(ramp, dsm_m=100.0, dop_m=0.5, reach_m=100.0, dsm_up=up)
    window = place.window
    assert window.dsm.shape == (2, 2)
    view = drawn(place, place.pose(55.0), window=window)
    px = shown(view, 11)
    assert len(px) > 300
    truth = cast(place, view, px, window.dsm, window.dsm_grid)
    assert np.nanmax(np.linalg.norm(view.points_local(px) - truth, axis=1)) < 0.3


def test_one_low_cell_is_no_ground() -> None:
    """An undeclared nodata value must not put the rays' steps kilometres apart."""
    place = Place(ramp, reach_m=60.0)
    window = place.window
    pose = place.pose(40.0)
    sound = drawn(place, pose)
    window.dsm[3, 4] = -9999.0
    spoilt = drawn(place, pose, window=window)
    px = shown(sound, 11)
    np.testing.assert_allclose(spoilt.points_local(px), sound.points_local(px), atol=0.02)


def test_no_height_at_all_is_no_terrain() -> None:
    place = Place(level, reach_m=20.0)
    window = place.window
    window.dsm[:] = np.nan
    assert Terrain.of(window, place.local) is None


def test_infinite_heights_are_holes() -> None:
    place = Place(level, reach_m=60.0)
    window = place.window
    window.dsm[:40] = np.inf
    terrain = terrain_of(window, place.local)
    assert terrain.lowest_m == terrain.highest_m == pytest.approx(GROUND_M)
    view = render(terrain, CAMERA, place.pose(30.0))
    assert view.valid.any()
    assert np.isfinite(view.points_local(shown(view, 2))).all()


def test_what_is_drawn_does_not_change_the_window() -> None:
    place = Place(hills, reach_m=40.0)
    window = place.window
    window.dsm[3, 3] = np.nan
    before = window.dsm.copy(), window.dop_grey.copy()
    drawn(place, place.pose(40.0), window=window)
    assert np.array_equal(window.dsm, before[0], equal_nan=True)
    assert np.array_equal(window.dop_grey, before[1])


def test_as_many_points_as_pixels() -> None:
    place = Place(level, reach_m=60.0)
    view = drawn(place, place.pose(40.0))
    assert view.points_local(every_px(CAMERA)).shape == (320 * 240, 3)


# -- cameras among hills, and in them ----------------------------------------


def test_a_camera_below_a_mountain_top() -> None:
    """A mountain of 80 m beside a camera 50 m up: over the plain all is as if it were not there."""

    def mountain(east: FloatArray, north: FloatArray) -> FloatArray:
        return GROUND_M + np.maximum(0.0, 80.0 - 0.8 * np.hypot(east - 180.0, north))

    place = Place(mountain, reach_m=250.0, dsm_m=1.0, dop_m=1.0)
    view = drawn(place, place.pose(50.0, 10.0, heading_deg=-90.0))
    at = place.local.local_from_map([EAST, NORTH, GROUND_M])
    px = shown(view, 7)
    assert len(px) > 1000
    assert np.linalg.norm(view.points_local(px) - on_plane(view, px, 0.0, 0.0, at), axis=1).max() < 0.05
    # Towards the mountain its flank is met.
    view = drawn(place, place.pose(50.0, 60.0, heading_deg=90.0))
    points = view.points_local(shown(view, 7))
    assert points[:, 2].max() > GROUND_M + 20.0


@pytest.mark.parametrize("height_m", [0.0, -3.0, -500.0])
@pytest.mark.parametrize("surface", [level, hills])
def test_a_camera_in_the_ground_draws_something_finite(surface: Surface, height_m: float) -> None:
    place = Place(surface, reach_m=30.0)
    for tilt_deg in (0.0, 60.0):
        view = drawn(place, place.pose(height_m, tilt_deg))
        assert np.isfinite(view.fall_m).all()
        px = shown(view, 9)
        if len(px):
            assert np.isfinite(view.points_local(px)).all()


def test_same_call_same_bits() -> None:
    place = Place(house, reach_m=60.0)
    terrain = terrain_of(place.window, place.local)
    one, two = (render(terrain, CAMERA, place.pose(40.0, 30.0)) for _ in range(2))
    assert np.array_equal(one.image, two.image)
    assert np.array_equal(one.fall_m, two.fall_m)
    assert np.array_equal(one.valid, two.valid)


def test_distortion_is_ignored() -> None:
    """The frame is undistorted instead."""
    place = Place(level, reach_m=60.0)
    lens = Camera(320, 240, 270.0, 270.0, 159.5, 119.5, (-0.2, 0.05, 0.0, 0.0, 0.0))
    one = drawn(place, place.pose(40.0, 15.0), lens)
    two = drawn(place, place.pose(40.0, 15.0), lens.pinhole())
    assert np.array_equal(one.image, two.image)
    assert math.isclose(float(one.fall_m.sum()), float(two.fall_m.sum()))


# -- ground truth --------------------------------------------------------------


@pytest.mark.parametrize("tilt_deg", [0.0, 35.0, 60.0])
@pytest.mark.parametrize("surface", [house, wall, hills], ids=["house", "wall", "hills"])
def test_surface_points_are_the_first_on_their_rays(surface: Surface, tilt_deg: float) -> None:
    place = Place(surface, scale=0.9996, reach_m=220.0, dop_m=1.0)
    window = place.window
    view = drawn(place, place.pose(tilt_deg=tilt_deg, roll_deg=5.0), CAMERA, window)
    every = surface_points(terrain_of(window, place.local), CAMERA, view.local_from_camera)
    px = every_px(CAMERA, 5)
    found = every[px[:, 1].astype(int), px[:, 0].astype(int)]
    known = np.isfinite(found).all(axis=1)
    # All but what is beyond eight heights; and nothing that is not seen.
    assert known[view.valid[px[:, 1].astype(int), px[:, 0].astype(int)]].mean() > 0.99
    back = CAMERA.project(view.local_from_camera.inverse().apply(found[known]))
    assert np.abs(back - px[known]).max() < 1e-9
    truth = cast(place, view, px[known], window.dsm, window.dsm_grid)
    off = np.linalg.norm(found[known] - truth, axis=1)
    # A ray that grazes an edge or a crest by less than half a cell may go on to what is behind.
    assert np.quantile(off, 0.98) < 1e-3
    at = place.local.map_from_local(found[known])
    assert np.abs(bilinear(window.dsm, window.dsm_grid.px_from_map(at[:, :2])) - at[:, 2]).max() < 1e-3


def test_surface_points_do_not_miss_a_fence() -> None:
    """One cell thick, 5 m high, and seen at a slant: rays pass it within a fraction of the way to the ground."""

    def fence(east: FloatArray, north: FloatArray) -> FloatArray:
        return np.where(np.abs(north - 13.0) <= 0.4, GROUND_M + 5.0, GROUND_M) + 0.0 * east

    place = Place(fence, reach_m=150.0, dop_m=1.0)
    window = place.window
    view = drawn(place, place.pose(tilt_deg=55.0, heading_deg=0.0, north_m=-30.0), CAMERA, window)
    px = every_px(CAMERA, 2)
    truth = cast(place, view, px, window.dsm, window.dsm_grid)
    on_it = truth[:, 2] > GROUND_M + 0.5
    assert on_it.sum() > 500
    every = surface_points(terrain_of(window, place.local), CAMERA, view.local_from_camera)
    found = every[px[:, 1].astype(int), px[:, 0].astype(int)]
    assert (np.linalg.norm(found[on_it] - truth[on_it], axis=1) < 0.05).mean() > 0.98


def test_surface_points_are_none_where_nothing_is_known() -> None:
    place = Place(level, reach_m=60.0)
    window = place.window
    window.dsm[100:140, 100:140] = np.nan
    pose = place.pose(height_m=60.0, tilt_deg=50.0)
    points = surface_points(terrain_of(window, place.local), CAMERA, pose)
    known = np.isfinite(points).all(axis=2)
    assert 0.05 < known.mean() < 0.9
    at = place.local.map_from_local(points[known])[:, :2]
    assert np.isfinite(bilinear(window.dsm, window.dsm_grid.px_from_map(at))).all()
    for height_m in (-3.0, -500.0):
        below = surface_points(terrain_of(place.window, place.local), CAMERA, place.pose(height_m=height_m))
        assert np.isnan(below).all()
