"""The generated world: the same every time, consistent in itself, different between epochs."""

from __future__ import annotations

import hashlib
from dataclasses import replace

import cv2
import numpy as np
import pytest
from ortholoc_sim import demo_pack_path
from ortholoc_sim.epoch import FLIGHT
from ortholoc_sim.make_demo_pack import DEMO_CRS, DEMO_SOUTH_M, DEMO_SPEC, DEMO_UNDULATION_M, DEMO_WEST_M
from ortholoc_sim.world import FIRST_TREE, Scene, World, WorldSpec, base_height, build_scene, generate

from ortholoc_edge.tiles.pack import Pack
from ortholoc_edge.tiles.store import MapStore

TINY = WorldSpec(seed=9, width_m=160.0, height_m=140.0, gsd_m=0.5)


def digest(scene: Scene) -> str:
    sums = hashlib.sha256()
    for raster in (scene.texture, scene.surface, scene.objects):
        sums.update(np.ascontiguousarray(raster).tobytes())
    return sums.hexdigest()


def test_same_seed_same_bytes_other_seed_other_world() -> None:
    first, second, other = (build_scene(generate(spec), FLIGHT) for spec in (TINY, TINY, replace(TINY, seed=10)))
    assert digest(first) == digest(second)
    assert digest(first) != digest(other)


def test_roofs_stand_where_texture_and_layout_say(survey: Scene) -> None:
    """Surface, texture and vectors describe one place: a flat roof's middle has its height and its colour."""
    grid = survey.spec.grid
    seen = 0
    for index, house in enumerate(survey.buildings):
        if house.rise_m > 0:
            continue
        # A spot on the roof away from boxes on it.
        c, s = np.cos(house.angle_rad), np.sin(house.angle_rad)
        for along in np.linspace(-0.4, 0.4, 9) * house.length_m:
            if any(abs(along - box.along_m) < box.length_m for box in house.boxes):
                continue
            u, v = np.round(grid.px_from_map([house.x_m + c * along, house.y_m + s * along])).astype(int)
            if survey.objects[v, u] != 1 + index:
                continue  # under a tree
            height = base_height(survey.spec, survey.terrain, house) + house.eave_m
            assert survey.surface[v, u] == pytest.approx(height, abs=1e-3)
            red, green, blue = survey.texture[v, u].astype(int)
            assert max(red, green, blue) - min(red, green, blue) < 60  # grey or sand, no grass
            seen += 1
    assert seen > 5


def test_edges_of_texture_and_surface_coincide(survey: Scene) -> None:
    """Shifting one against the other by a metre must not fit better than no shift."""
    # Walls only: where the surface jumps at a house.
    house = ((survey.objects > 0) & (survey.objects < FIRST_TREE)).astype(np.uint8)
    outline = cv2.morphologyEx(house, cv2.MORPH_GRADIENT, np.ones((3, 3), np.uint8)).astype(np.float32)
    grey = cv2.cvtColor(survey.texture, cv2.COLOR_RGB2GRAY).astype(np.float32)
    edges = np.hypot(cv2.Sobel(grey, cv2.CV_32F, 1, 0), cv2.Sobel(grey, cv2.CV_32F, 0, 1))
    fits = {
        (dx, dy): float((np.roll(edges, (dy, dx), (0, 1)) * outline).sum()) for dx in (-4, 0, 4) for dy in (-4, 0, 4)
    }
    assert max(fits, key=lambda shift: fits[shift]) == (0, 0)


def test_epochs_share_structure_but_not_the_picture(world: World, survey: Scene, flight: Scene) -> None:
    """The camera's texture is not the map's (field notes, "Test realism")."""
    grey = [cv2.cvtColor(s.texture, cv2.COLOR_RGB2GRAY).astype(np.float32).ravel() for s in (survey, flight)]
    correlation = float(np.corrcoef(*grey)[0, 1])
    assert 0.1 < correlation < 0.7
    assert float(np.abs(survey.texture.astype(int) - flight.texture).mean()) > 15
    higher = np.abs(survey.surface - flight.surface) > 1.0
    assert 0.002 < float(higher.mean()) < 0.15
    assert len(flight.trees) < len(survey.trees)
    assert {c.slot for c in survey.cars} != {c.slot for c in flight.cars}
    assert np.array_equal(survey.terrain, flight.terrain)


def test_shadows_fall_away_from_the_sun(survey: Scene, flight: Scene) -> None:
    """Beside a tall flat roof the ground opposite the sun is darker than the ground toward it."""
    for scene in (survey, flight):
        grid, sun = scene.spec.grid, scene.epoch.sun[:2] / np.hypot(*scene.epoch.sun[:2])
        darker = []
        for house in scene.buildings:
            if house.eave_m < 5:
                continue
            reach = 0.5 * max(house.length_m, house.width_m) + 2.5
            tones = []
            for side in (-1.0, 1.0):
                spot = np.array([house.x_m, house.y_m]) + side * sun * reach
                u, v = np.round(grid.px_from_map(spot)).astype(int)
                if not (8 < u < grid.width - 8 and 8 < v < grid.height - 8):
                    break
                patch = scene.texture[v - 3 : v + 4, u - 3 : u + 4]
                tones.append(float(np.median(patch)))
            if len(tones) == 2:
                darker.append(tones[0] < tones[1])
        assert len(darker) >= 4
        assert np.mean(darker) > 0.6


def test_demo_pack_is_this_world_and_small_enough() -> None:
    pack = Pack.open(demo_pack_path())
    assert pack.verify() == []
    assert pack.manifest.crs == DEMO_CRS
    assert pack.total_bytes < 2.5e6
    assert pack.georeference.vertical.amsl_minus_map_m == pytest.approx(-DEMO_UNDULATION_M)
    convergence = np.rad2deg(pack.georeference.convergence_rad(pack.georeference.anchor))
    assert 1.3 < convergence < 1.7
    terrain = generate(DEMO_SPEC).terrain
    with MapStore(pack) as store:
        west, south, east, north = store.bounds
        # The rim of a pack lies on whole steps of its tiles, 16 m.
        assert 0 <= DEMO_WEST_M - west < 16.0
        assert 0 <= DEMO_SOUTH_M - south < 16.0
        assert 0 <= east - DEMO_WEST_M - DEMO_SPEC.width_m < 16.0
        assert 0 <= north - DEMO_SOUTH_M - DEMO_SPEC.height_m < 16.0
        xy = np.random.default_rng(1).uniform(30, 470, (400, 2))
        heights = store.heights(xy + np.array([DEMO_WEST_M, DEMO_SOUTH_M]))
    u, v = np.round(DEMO_SPEC.grid.px_from_map(xy)).astype(int).T
    above = heights - terrain[v, u]
    # Nothing but crops on most of the ground: the committed pack is this generator's.
    assert 0.0 <= np.median(above) < 1.2
    assert np.percentile(above, 2) > -0.5
