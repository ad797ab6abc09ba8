"""Sets across domains: photos lie where their truth says, and kinds differ in what they should and nothing else."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import rasterio
from ortholoc_sim.camera import Placement, Renderer, Sensor, View
from ortholoc_sim.crossdomain import (
    DSM_GSD_M,
    HEIGHT_PX,
    WIDTH_PX,
    CrossDomain,
    Flight,
    Kind,
    Spectrum,
    contact_sheet,
    flight_layout,
    main,
    survey_layout,
    write_set,
)
from ortholoc_sim.detail import Detail
from ortholoc_sim.epoch import SURVEY, near_infrared
from ortholoc_sim.layout import Building, Crop
from ortholoc_sim.lens import Exposure
from ortholoc_sim.noise import grain
from ortholoc_sim.season import other_time, survey_time
from ortholoc_sim.world import FIRST_PARCEL, FIRST_TREE, Cover, Scene, WorldSpec, base_height

from ortholoc_edge.bench import sequence
from ortholoc_edge.geometry import rotation
from ortholoc_edge.geometry.arrays import FloatArray
from ortholoc_edge.geometry.grid import bilinear
from ortholoc_edge.geometry.rigid import Rigid3
from ortholoc_edge.tiles.build import PackOptions, build_pack
from ortholoc_edge.tiles.store import MapStore

SMALL = CrossDomain(Kind.XDOP, seed=5, width_m=560.0, height_m=520.0, gsd_m=0.25)
# For what holds at any texel: the same place at a quarter of the work.
COARSE = replace(SMALL, gsd_m=0.5)
# For what holds of any place: that of COARSE takes most of its time to lay out.
TINY = replace(COARSE, width_m=360.0, height_m=340.0)
COUNT = 12


def rng(seed: int) -> np.random.Generator:
    return np.random.default_rng(seed)


@pytest.fixture(scope="module")
def flown() -> Scene:
    return SMALL.flight_scene()


@pytest.fixture(scope="module")
def surveyed() -> Scene:
    return SMALL.survey_scene()


@pytest.fixture(scope="module")
def views(flown: Scene) -> list[tuple[Rigid3, View]]:
    renderer = SMALL.renderer(flown)
    return [(pose, renderer.view(SMALL.camera, pose)) for pose in SMALL.poses(COUNT)]


def project(domain: CrossDomain, pose: Rigid3, local: FloatArray) -> FloatArray:
    """Pixels (N, 2) of points (N, 3) in the place's metres: written out here, from the truth's definition."""
    place = domain.placement
    offset = local + np.array([place.west_m, place.south_m, 0.0]) - pose.translation
    offset[:, :2] /= place.grid_scale  # horizontal map metres are grid metres
    camera = offset @ pose.rotation
    focal = domain.camera.fx
    return np.stack(
        [
            focal * camera[:, 0] / camera[:, 2] + (WIDTH_PX - 1) / 2,
            focal * camera[:, 1] / camera[:, 2] + (HEIGHT_PX - 1) / 2,
        ],
        axis=1,
    )


def test_photo_shows_what_a_plain_ray_cast_hits(flown: Scene, views: list[tuple[Rigid3, View]]) -> None:
    """The march in small steps of double precision, without the renderer's grids of maxima."""
    lot = rng(0)
    place, grid = SMALL.placement, flown.spec.grid
    surface = flown.surface
    errors = []
    for pose, view in views:
        px = np.stack([lot.integers(0, WIDTH_PX, 60), lot.integers(0, HEIGHT_PX, 60)], axis=1)
        rays = np.column_stack([(px - ((WIDTH_PX - 1) / 2, (HEIGHT_PX - 1) / 2)) / SMALL.camera.fx, np.ones(60)])
        world = rays @ pose.rotation.T
        world = world / -world[:, 2:] * np.array([place.grid_scale, place.grid_scale, 1.0])
        eye = pose.translation - (place.west_m, place.south_m, 0.0)
        descent = np.arange(0.0, eye[2] - float(surface.min()), 0.02)
        for (u, v), ray in zip(px, world, strict=True):
            points = eye + descent[:, None] * ray
            below = bilinear(surface, grid.px_from_map(points[:, :2])) > points[:, 2]
            hit = points[int(np.argmax(below))] + (place.west_m, place.south_m, 0.0)
            errors.append(float(np.linalg.norm(view.points_map[v, u] - hit)))
    # Where a ray brushes an edge the two may fall on either side of it.
    assert np.quantile(errors, 0.97) < 0.15
    assert np.median(errors) < 0.03


def body(scene: Scene, house: Building) -> FloatArray:
    """(10, 3) corners at the eave, ends of the ridge, corners at the ground, of a house without what is on its roof."""
    floor_m = base_height(scene.spec, scene.terrain, house)
    eave = np.column_stack([house.corners, np.full(4, floor_m + house.eave_m)])
    a, b, c, d = eave
    ridge = np.stack([(a + d) / 2, (b + c) / 2]) + np.array([0.0, 0.0, house.rise_m])
    ground_m = bilinear(scene.terrain, scene.spec.grid.px_from_map(house.corners))
    return np.concatenate([eave, ridge, np.column_stack([house.corners, ground_m])])


def test_houses_are_seen_where_their_vectors_project(flown: Scene, views: list[tuple[Rigid3, View]]) -> None:
    """From the layout's vectors to the pixel, past every raster but the picture of who is seen where."""
    shifts, overlaps = [], []
    for pose, view in views:
        for index, house in enumerate(flown.buildings):
            if house.length_m < 7.0:
                continue
            px = project(SMALL, pose, body(flown, house))
            if not ((px > 4).all() and (px < (WIDTH_PX - 5, HEIGHT_PX - 5)).all()):
                continue
            seen = (view.objects == 1 + index).astype(np.uint8)
            hull = cv2.convexHull(np.round(px * 16).astype(np.int32))
            meant = cv2.fillConvexPoly(np.zeros_like(seen), hull, 1, cv2.LINE_8, 4)
            if seen.sum() < 0.9 * meant.sum():
                continue  # behind a tree
            moments = [cv2.moments(mask, binaryImage=True) for mask in (seen, meant)]
            centres = np.array([[m["m10"], m["m01"]] for m in moments]) / [[m["m00"]] for m in moments]
            shifts.append(centres[0] - centres[1])
            overlaps.append((seen & meant).sum() / (seen | meant).sum())
    assert len(shifts) >= 8
    assert np.abs(np.median(shifts, axis=0)).max() < 0.4
    assert np.linalg.norm(shifts, axis=1).max() < 3.0
    # A roof ends half a texel early (`camera`): 12 cm at this place's texels, about a pixel all around.
    assert np.median(overlaps) > 0.9


def test_shadows_fall_away_from_the_sun(flown: Scene) -> None:
    east, north, up = flown.epoch.sun
    flat = np.hypot(east, north)
    away = -np.array([east, north]) / flat
    grey = cv2.cvtColor(flown.texture, cv2.COLOR_RGB2GRAY).astype(float)
    ratios = []
    for house in flown.buildings:
        reach_m = house.eave_m * flat / up
        if reach_m < 2.5:
            continue
        half = 0.5 * float(np.hypot(house.length_m, house.width_m))
        centre = np.array([house.x_m, house.y_m])
        # From the middle out: past the wall it lies in shade first, then in the sun.
        steps = np.arange(0.0, half + reach_m, 0.25)
        brightness = []
        for direction in (away, -away):
            column, row = np.round(flown.spec.grid.px_from_map(centre + steps[:, None] * direction)).astype(int).T
            outside = flown.objects[row, column] == 0
            near = np.flatnonzero(outside)[: int(0.6 * reach_m / 0.25)]
            brightness.append(grey[row[near], column[near]].mean() if len(near) >= 4 else np.nan)
        ratios.append(brightness[0] / brightness[1])
    assert len(ratios) > 10
    assert np.nanmedian(ratios) < 0.75


def test_same_seed_same_photos_other_seed_other_place() -> None:
    again = replace(TINY)  # nothing cached
    flown, scene = TINY.flight_scene(), again.flight_scene()
    np.testing.assert_array_equal(scene.texture, flown.texture)
    pose, other = TINY.poses(1)[0], again.poses(1)[0]
    np.testing.assert_array_equal(pose.translation, other.translation)
    photos = [d.photo(d.renderer(s), pose, 0).image for d, s in ((TINY, flown), (again, scene))]
    np.testing.assert_array_equal(*photos)
    elsewhere = replace(TINY, seed=6).place.world.layout.buildings
    here = TINY.place.world.layout.buildings
    assert {(b.x_m, b.y_m) for b in elsewhere}.isdisjoint({(b.x_m, b.y_m) for b in here})


def test_poses_are_of_a_drone_and_keep_off_the_border() -> None:
    poses = SMALL.poses(60)
    ends = np.array([[0, 0], [WIDTH_PX - 1, 0], [WIDTH_PX - 1, HEIGHT_PX - 1], [0, HEIGHT_PX - 1]], dtype=float)
    tilts = []
    for pose in poses:
        eye = pose.translation - (SMALL.placement.west_m, SMALL.placement.south_m, 0.0)
        u, v = np.round(SMALL.place.world.spec.grid.px_from_map(eye[:2])).astype(int)
        ground_m = float(SMALL.place.world.terrain[v, u])
        assert 59.9 < eye[2] - ground_m < 150.1
        axis = pose.rotation[:, 2]
        tilts.append(np.degrees(np.arccos(-axis[2])))
        rays = SMALL.camera.unproject(ends) @ pose.rotation.T
        ground = eye[:2] + rays[:, :2] / -rays[:, 2:] * (eye[2] - ground_m)
        middle = eye[:2] - axis[:2] / axis[2] * (eye[2] - ground_m)
        size = (SMALL.width_m, SMALL.height_m)
        assert (ground > 0).all() and (ground < size).all()
        footprint_m = (eye[2] - ground_m) / -axis[2] * WIDTH_PX / SMALL.camera.fx
        assert np.minimum(middle, size - middle).min() > 1.2 * footprint_m
    assert max(tilts) < 47.0
    assert np.mean(np.array(tilts) < 30.0) > 0.7
    headings = [np.arctan2(*pose.rotation[:2, 0]) for pose in poses]
    assert np.hypot(np.cos(headings).mean(), np.sin(headings).mean()) < 0.35  # all directions


def test_kinds_share_place_map_and_poses() -> None:
    same, xdop, old = (replace(TINY, kind=kind) for kind in Kind)  # each makes its place itself
    layouts = [survey_layout(domain.place) for domain in (same, xdop, old)]
    for other in layouts[1:]:
        assert [(b.x_m, b.colour) for b in other.buildings] == [(b.x_m, b.colour) for b in layouts[0].buildings]
        assert [(t.x_m, t.radius_m) for t in other.trees] == [(t.x_m, t.radius_m) for t in layouts[0].trees]
    for poses in zip(same.poses(5), xdop.poses(5), old.poses(5), strict=True):
        for pose in poses[1:]:
            np.testing.assert_array_equal(pose.translation, poses[0].translation)
            np.testing.assert_array_equal(pose.rotation, poses[0].rotation)


def test_same_shows_the_world_of_the_map(surveyed: Scene) -> None:
    flight = SMALL.of_kind(Kind.SAME).flight_scene()
    np.testing.assert_array_equal(surveyed.texture, flight.texture)
    np.testing.assert_array_equal(surveyed.surface, flight.surface)


def footprints(buildings: tuple[Building, ...]) -> set[tuple[float, ...]]:
    return {(b.x_m, b.y_m, b.angle_rad, b.length_m, b.width_m, b.eave_m, b.rise_m) for b in buildings}


def test_xdop_keeps_buildings_and_repaints_them() -> None:
    before, after = survey_layout(SMALL.place), flight_layout(SMALL.place, Kind.XDOP, SMALL.flight)
    assert footprints(before.buildings) == footprints(after.buildings)
    repainted = np.mean([a.colour != b.colour for a, b in zip(before.buildings, after.buildings, strict=True)])
    assert 0.1 < repainted < 0.45
    old, new = ({(t.x_m, t.y_m) for t in layout.trees} for layout in (before, after))
    assert 0.02 < len(old - new) / len(old) < 0.12
    assert 0.01 < len(new - old) / len(old) < 0.09
    assert {p.crop for p in before.parcels} == {p.crop for p in after.parcels}
    assert any(a.crop is not b.crop for a, b in zip(before.parcels, after.parcels, strict=True))


def test_xdopdsm_builds_tears_down_and_grows() -> None:
    before, after = survey_layout(SMALL.place), flight_layout(SMALL.place, Kind.XDOPDSM, SMALL.flight)
    old, new = footprints(before.buildings), footprints(after.buildings)
    assert 0.01 < len(old - new) / len(old) < 0.25
    assert 0.01 < len(new - old) / len(old) < 0.25
    standing = {(t.x_m, t.y_m): t.height_m for t in before.trees}
    later = {(t.x_m, t.y_m): t.height_m for t in after.trees}
    assert 0.08 < len(standing.keys() - later.keys()) / len(standing) < 0.22
    assert all(later[spot] > standing[spot] for spot in standing.keys() & later.keys())
    # A house that stands in both has the same new colour as in the kind without changes to buildings.
    xdop = {(b.x_m, b.y_m): b.colour for b in flight_layout(SMALL.place, Kind.XDOP, SMALL.flight).buildings}
    kept = [b for b in after.buildings if (b.x_m, b.y_m) in xdop]
    assert kept and all(b.colour == xdop[b.x_m, b.y_m] for b in kept)


def test_old_dsm_is_smooth_and_noisy_and_the_others_are_not(surveyed: Scene) -> None:
    scene = surveyed
    layers = {kind: SMALL.of_kind(kind).layers(scene, scene.surface) for kind in Kind}
    np.testing.assert_array_equal(layers[Kind.SAME].dsm, layers[Kind.XDOP].dsm)
    for kind in (Kind.XDOP, Kind.XDOPDSM):
        np.testing.assert_array_equal(layers[kind].dop, layers[Kind.SAME].dop)
    # Where nothing stands: the meadow's own relief over some metres is centimetres.
    size = (round(SMALL.width_m / DSM_GSD_M), round(SMALL.height_m / DSM_GSD_M))
    things = cv2.resize((scene.objects > 0).astype(np.float32), size, interpolation=cv2.INTER_AREA)
    clear = cv2.dilate(things, np.ones((11, 11), np.uint8)) == 0
    terrain = cv2.resize(scene.terrain, size, interpolation=cv2.INTER_AREA)
    spread = {kind: float(np.std((layer.dsm - terrain)[clear])) for kind, layer in layers.items()}
    assert spread[Kind.XDOPDSM] > spread[Kind.SAME] + 0.03
    difference = (layers[Kind.XDOPDSM].dsm - layers[Kind.SAME].dsm)[clear]
    assert 0.2 < float(difference.std()) < 0.45


@pytest.mark.parametrize("gsd_m", [0.2, 0.125, 0.3])
def test_renderer_hits_the_surface_at_any_texel(gsd_m: float) -> None:
    """Cells of the grids of maxima are whole texels: at 0.2 m they were taken for larger than they are, and rays
    passed under the surface."""
    spec = WorldSpec(0, 120.0, 120.0, gsd_m)
    surface = cv2.GaussianBlur(rng(1).normal(0.0, 60.0, spec.shape).astype(np.float32), (0, 0), 3.0 / gsd_m)
    ids = np.zeros(spec.shape, np.uint16)
    scene = Scene(spec, SMALL.survey, np.zeros((*spec.shape, 3), np.uint8), surface, surface, ids, (), (), ())
    pose = SMALL.poses(1)[0]
    pose = Rigid3(pose.rotation, np.array([60.0, 60.0, 45.0 + float(surface.max())]))
    view = Renderer(scene, Placement(0.0, 0.0), Sensor()).view(SMALL.camera, pose)
    points = view.points_map.reshape(-1, 3)
    inside = ((points[:, :2] > 1.0) & (points[:, :2] < 119.0)).all(axis=1)
    assert inside.mean() > 0.5
    off = points[inside, 2] - bilinear(surface, spec.grid.px_from_map(points[inside, :2]))
    assert np.quantile(np.abs(off), 0.999) < 0.1


@pytest.mark.parametrize("seed", range(1, 12))
def test_other_time_is_another_season_and_another_light(seed: int) -> None:
    before, after = survey_time(seed), other_time(seed)
    assert before.season is not after.season
    turn = abs((before.sun_deg[0] - after.sun_deg[0] + 180) % 360 - 180)
    assert turn > 40
    assert after.sun_deg[1] > 10


def test_sun_stands_where_the_almanac_has_it() -> None:
    """Solstice noon at 50 degrees north: 63.4 degrees high in the south; rises in the north-east."""
    june = replace(survey_time(1), season=replace(survey_time(1).season, day=172), hour=12.0)
    azimuth, elevation = june.sun_deg
    assert azimuth == pytest.approx(180.0, abs=0.1)
    assert elevation == pytest.approx(63.4, abs=0.2)
    morning = replace(june, hour=6.0).sun_deg
    assert morning[0] == pytest.approx(74.7, abs=1.0)
    assert morning[1] == pytest.approx(17.8, abs=0.5)


def test_lasting_share_counts_houses_and_ways(flown: Scene, views: list[tuple[Rigid3, View]]) -> None:
    renderer = SMALL.renderer(flown)
    some = views[: COUNT // 2]
    shares = [SMALL.photo(renderer, pose, k).lasting_share for k, (pose, _) in enumerate(some)]
    assert 0.0 <= min(shares) < max(shares) < 0.7
    for share, (_, view) in zip(shares, some, strict=True):
        assert share >= ((view.objects > 0) & (view.objects < FIRST_TREE)).mean()
    # A place with nothing but plants has nothing that lasts.
    bare = replace(SMALL)
    world = replace(SMALL.place.world, cover=np.full_like(SMALL.place.world.cover, FIRST_PARCEL))
    vars(bare)["place"] = replace(SMALL.place, world=world)
    empty = replace(flown, objects=np.zeros_like(flown.objects))
    assert bare.photo(bare.renderer(empty), views[0][0], 0).lasting_share == 0.0


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("sets") / "town"
    write_set(folder, COARSE, 4)
    return folder


def test_xdop_has_the_surface_of_the_photos_and_the_picture_of_the_survey(written: Path) -> None:
    flown, surveyed = COARSE.flight_scene(), COARSE.survey_scene()
    expected = COARSE.layers(surveyed, flown.surface)
    with rasterio.open(written / "town_dsm.tif") as source:
        np.testing.assert_array_equal(source.read(1), expected.dsm)
    with rasterio.open(written / "town_dop.tif") as source:
        # But for JPEG.
        assert np.abs(np.moveaxis(source.read(), 0, 2) - expected.dop.astype(float)).mean() < 5.0
    assert np.abs(expected.dsm - COARSE.layers(surveyed, surveyed.surface).dsm).max() > 0.5


def test_written_set_is_read_as_a_flight_with_its_map(written: Path, tmp_path: Path) -> None:
    recorded = sequence.read_flight(written)
    for frame, pose in zip(recorded, COARSE.poses(4), strict=True):
        np.testing.assert_allclose(frame.map_from_camera.translation, pose.translation, atol=1e-4)
        np.testing.assert_allclose(frame.map_from_camera.rotation, pose.rotation, atol=1e-8)
        convergence = COARSE.georeference.convergence_rad(pose.translation[:2])
        np.testing.assert_allclose(frame.ned_from_body, sequence.attitude_of(pose, convergence), atol=1e-7)
        assert frame.image().shape == (HEIGHT_PX, WIDTH_PX, 3)
        assert frame.camera == COARSE.camera
    with (written / "town_flight.csv").open(encoding="utf-8", newline="") as table:
        assert all(0.0 <= float(row["lasting_share"]) < 1.0 for row in csv.DictReader(table))
    options = PackOptions(quality=85, vertical="unknown")
    store = MapStore(build_pack(written / "town_dop.tif", written / "town_dsm.tif", tmp_path / "pack", options))
    assert store.dop_grids[0].gsd_m == pytest.approx(0.2)
    assert store.dsm_grids[0].gsd_m == pytest.approx(1.0)


def test_photo_of_the_map_s_own_time_fits_the_map_to_the_pixel(tmp_path: Path) -> None:
    """End to end through the files: the map drawn from the true pose against the photo, quarter by quarter."""
    same = SMALL.of_kind(Kind.SAME)
    write_set(tmp_path, same, 6)
    shifts = []
    window = cv2.createHanningWindow((WIDTH_PX // 2, HEIGHT_PX // 2), cv2.CV_32F)
    for sheet in contact_sheet(tmp_path, range(6), same.placement.grid_scale):
        grey = cv2.cvtColor(sheet, cv2.COLOR_RGB2GRAY).astype(np.float32)
        fine = [g - cv2.GaussianBlur(g, (0, 0), 5) for g in np.split(grey, 3, axis=1)[:2]]
        for top, left in ((0, 0), (0, WIDTH_PX // 2), (HEIGHT_PX // 2, 0), (HEIGHT_PX // 2, WIDTH_PX // 2)):
            photo, seen = (g[top : top + HEIGHT_PX // 2, left : left + WIDTH_PX // 2].copy() for g in fine)
            shift, peak = cv2.phaseCorrelate(photo, seen, window)
            if peak > 0.8:  # façades and the sides of trees are not in the map
                shifts.append(shift)
    assert len(shifts) >= 8
    assert np.abs(np.median(shifts, axis=0)).max() < 0.15
    assert np.median(np.linalg.norm(shifts, axis=1)) < 0.4


def exposures(count: int, mild: bool) -> list[Exposure]:
    return [Exposure.drawn(np.random.default_rng(1), np.random.default_rng(k), mild) for k in range(count)]


def test_lens_smears_a_point_but_leaves_it_in_its_place() -> None:
    dark = replace(exposures(1, True)[0], noise=0.0, shot=0.0, gain=1.0)
    clean = np.zeros((HEIGHT_PX, WIDTH_PX, 3), np.uint8)
    clean[198:203, 298:303] = 255
    for motion_rad in (0.0, 0.7, 2.4):
        smeared = replace(dark, motion_px=3.0, motion_rad=motion_rad).expose(clean, SMALL.camera, rng(0))
        moments = cv2.moments(smeared[..., 1])
        assert moments["m10"] / moments["m00"] == pytest.approx(300.0, abs=0.05)
        assert moments["m01"] / moments["m00"] == pytest.approx(200.0, abs=0.05)
        assert smeared.max() < 255


def test_camera_of_the_map_s_time_is_milder_than_another() -> None:
    """Photos of one clean picture, after the settings that vary from photo to photo."""
    clean = np.tile(np.array([150, 90, 60], np.uint8), (HEIGHT_PX, WIDTH_PX, 1))
    for mild in (True, False):
        seen = np.array([e.expose(clean, SMALL.camera, rng(k)).mean(axis=(0, 1)) for k, e in
                         enumerate(exposures(12, mild))])  # fmt: skip
        hue = seen[:, 0] / seen[:, 2] / (150 / 60)
        assert (np.abs(hue - 1.0).max() < 0.02) == mild
    noise = exposures(1, True)[0].expose(clean, SMALL.camera, rng(0))[..., 1].astype(float)
    assert 0.8 < (noise - cv2.GaussianBlur(noise, (0, 0), 8)).std() < 8.0


def test_detail_is_tied_to_places_and_gone_from_high_up() -> None:
    detail, flat = Detail(1, False), np.full((HEIGHT_PX, WIDTH_PX, 3), 128, np.uint8)
    u, v = np.meshgrid(np.arange(WIDTH_PX), np.arange(HEIGHT_PX))
    none = np.zeros(u.shape)

    def seen(gsd_m: float, shift_px: int) -> FloatArray:
        points = np.stack([(u + shift_px) * gsd_m, v * -gsd_m, none], axis=-1)
        view = View(flat, points, none.astype(np.uint16), none > 0)
        return detail.added(view, np.zeros(2), gsd_m).astype(float) - 128.0

    low = seen(0.08, 0)
    assert 2.0 < low.std() < 20.0
    assert abs(low.mean()) < 1.0
    assert np.abs(low[:, 10:] - seen(0.08, 10)[:, :-10]).max() <= 1.0
    assert not seen(0.5, 0).any()


def test_too_small_a_place_is_refused() -> None:
    with pytest.raises(ValueError, match="no room for photos"):
        replace(SMALL, width_m=160.0, height_m=160.0).poses(3)


def test_a_lap_goes_forward_by_its_spacing_and_looks_ahead() -> None:
    domain = replace(SMALL, width_m=1200.0, height_m=1000.0, flown_as=Flight((80.0, 80.0), spacing_m=4.0))
    poses = domain.poses(30)
    steps = np.diff([pose.translation for pose in poses], axis=0)
    assert np.linalg.norm(steps, axis=1) == pytest.approx(4.0, rel=1e-3)
    for pose, step in zip(poses, steps, strict=False):
        top = -pose.rotation[:2, 1] / np.linalg.norm(pose.rotation[:2, 1])
        assert top @ step[:2] / 4.0 > np.cos(np.radians(6.0))
        # The bank of a turn of some 300 m at 15 m/s is 4 degrees.
        assert np.degrees(np.arccos(-pose.rotation[2, 2])) < 12.0
    # The lap turns left, so the vehicle leans left: its right wing, the picture's right, is up.
    assert np.mean([pose.rotation[2, 0] for pose in poses]) > 0.0
    assert np.cross(steps[0], steps[-1])[2] > 0.0


def test_a_lap_needs_room() -> None:
    with pytest.raises(ValueError, match="no room for a lap"):
        replace(SMALL, flown_as=Flight((400.0, 400.0), spacing_m=4.0)).poses(60)


def test_oblique_flight_is_tilted_as_asked_and_shows_sky_and_the_place(flown: Scene) -> None:
    domain = replace(SMALL, flown_as=Flight((20.0, 40.0), (60.0, 70.0)))
    renderer, skies = domain.renderer(flown), []
    for k, pose in enumerate(domain.poses(4)):
        # The roll tilts it, too.
        assert 60.0 <= np.degrees(np.arccos(-pose.rotation[2, 2])) <= 71.0
        local = pose.translation - (domain.place.west_m, domain.place.south_m, 0.0)
        ground_m = bilinear(flown.terrain, flown.spec.grid.px_from_map(local[None, :2]))[0]
        assert 19.5 <= local[2] - ground_m <= 40.5
        photo, view = domain.photo(renderer, pose, k), renderer.view(domain.camera, pose)
        sky = np.isnan(view.points_map[..., 2])
        skies.append(sky.mean())
        near = view.points_map[-1, :, :2] - (domain.place.west_m, domain.place.south_m)
        assert not sky[-1].any() and ((near > 0) & (near < (domain.width_m, domain.height_m))).all()
        assert 0.0 <= photo.lasting_share < 1.0
        if sky.any():  # without detail of the ground
            assert photo.image[sky].std(axis=0).max() < 15.0
    assert 0.0 < max(skies) < 0.6


def test_far_ground_is_averaged_and_near_ground_is_sharp() -> None:
    spec = WorldSpec(0, 240.0, 240.0, 0.1)
    noise = np.clip(128.0 + 40.0 * grain(spec.shape, 1), 0, 255).astype(np.uint8)
    flat, ids = np.zeros(spec.shape, np.float32), np.zeros(spec.shape, np.uint16)
    scene = Scene(spec, SMALL.survey, cv2.merge([noise] * 3), flat, flat, ids, (), (), ())
    pose = Rigid3(rotation.exp([np.radians(180.0 + 68.0), 0.0, 0.0]), np.array([120.0, 5.0, 40.0]))
    camera, sensor = SMALL.camera, Sensor(1.0, 0.0, 0.0, 0.0, 0)
    plain, fitted = (
        Renderer(scene, Placement(0.0, 0.0), sensor, level_by_pixel=by_pixel).render(camera, pose).astype(float)
        for by_pixel in (False, True)
    )
    far, near = slice(130, 150), slice(HEIGHT_PX - 20, HEIGHT_PX)
    assert fitted[far].std() < 0.8 * plain[far].std()
    assert fitted[near].std() >= plain[near].std()


def test_near_infrared_shows_plants_bright_and_water_black() -> None:
    seen = near_infrared(SURVEY)
    assert len(set(seen.leaves)) == len(set(seen.water)) == 1
    for visible, infrared in ((SURVEY.leaves, seen.leaves), (SURVEY.needles, seen.needles), (SURVEY.grass, seen.grass)):
        assert infrared[0] > 1.4 * visible[0]
    ripe, bare = SURVEY.crops[Crop.WHEAT].colour, seen.crops[Crop.WHEAT].colour
    assert bare[0] == pytest.approx(1.1 * ripe[0])  # nothing green
    assert seen.water[0] < 0.3 * SURVEY.water[0]
    # As bright in the sun, darker in the shade.
    assert np.add(seen.ambient, seen.direct) == pytest.approx(np.add(SURVEY.ambient, SURVEY.direct))
    assert seen.ambient[0] < 0.7 * SURVEY.ambient[0]


def test_a_flight_in_near_infrared_is_the_same_but_for_its_colours(flown: Scene) -> None:
    domain = replace(SMALL, flown_as=Flight(spectrum=Spectrum.NIR))
    assert not replace(domain, kind=Kind.SAME).looks_surveyed
    seen = domain.flight_scene()
    np.testing.assert_array_equal(seen.surface, flown.surface)
    np.testing.assert_array_equal(seen.objects, flown.objects)
    house = (flown.objects > 0) & (flown.objects < FIRST_TREE)
    water = domain.place.world.cover == Cover.WATER
    assert np.median(seen.texture[water, 0]) < 25 < np.median(flown.texture[water, 0])
    lit = house & (flown.texture[..., 0] > 100)
    assert np.abs(seen.texture[lit, 0].astype(int) - flown.texture[lit, 0]).mean() < 15.0
    photo = domain.photo(domain.renderer(seen), domain.poses(1)[0], 0).image.astype(int)
    hue = photo - photo.mean(axis=2, keepdims=True)
    assert np.abs(hue - hue.mean(axis=(0, 1))).mean() < 4.0  # the sensor's noise and white balance


def test_a_flight_by_default_is_what_it_was() -> None:
    """Sets that figures were measured on stay as they are."""
    eye = SMALL.poses(2)[1].translation
    np.testing.assert_allclose(eye, [715032.178516, 5547975.611068, 495.153685], atol=1e-5)


@pytest.mark.parametrize("flight", [((0.0, 10.0), None), ((30.0, 10.0), None), ((10.0, 30.0), (20.0, 85.0))])
def test_a_flight_that_can_not_be_is_refused(flight: tuple[tuple[float, float], tuple[float, float] | None]) -> None:
    with pytest.raises(ValueError, match=r"height|tilt"):
        Flight(*flight)


def test_command_refuses_a_kind_that_is_none(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    with pytest.raises(SystemExit) as stopped:
        main([str(tmp_path), "--kind", "yDOP"])
    assert stopped.value.code == 2
    assert "xDOPDSM" in capsys.readouterr().err
