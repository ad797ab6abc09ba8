"""A flight over a map itself: the geometry is the map's, the light is another."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from ortholoc_sim.camera import Placement, Renderer, Sensor
from ortholoc_sim.recorded import Light, _whole, relit, scene_of_map
from replay import rendered

from ortholoc_edge.errors import MapError
from ortholoc_edge.matching.types import Structural
from ortholoc_edge.pipeline.frame import Frame
from ortholoc_edge.pipeline.localizer import Localizer, LocalizerOptions
from ortholoc_edge.pipeline.outcome import Fix

AS_IT_IS = Light(direct=0.0, gamma=1.0, saturation=1.0, white=(1.0, 1.0, 1.0), tint=0.0, grain=0.0)


def around(x_m: float, y_m: float, half_m: float) -> tuple[float, float, float, float]:
    west, south, _, _ = rendered.store().bounds
    return west + x_m - half_m, south + y_m - half_m, west + x_m + half_m, south + y_m + half_m


def test_texture_and_surface_are_the_map_s() -> None:
    store = rendered.store()
    scene, (west, south) = scene_of_map(store, around(300, 250, 80), AS_IT_IS)
    rng = np.random.default_rng(1)
    local = rng.uniform(10, scene.spec.width_m - 10, (200, 2))
    places = local + np.array([west, south])
    u, v = scene.spec.grid.px_from_map(local).astype(np.float32).T
    surface = cv2.remap(scene.surface, u[None], v[None], cv2.INTER_LINEAR)[0]
    known = store.heights(places, store.pack.manifest.dsm.gsd_m)
    # The store's heights are of the nearest cell or between cells; at walls that is metres.
    assert np.median(np.abs(surface - known)) < 0.05
    window = store.read_colour(around(300, 250, 80), store.pack.manifest.dop.gsd_m)
    assert window is not None
    at = window.grid.px_from_map(places).astype(np.float32)
    photo = cv2.remap(window.rgb, at[:, 0][None], at[:, 1][None], cv2.INTER_LINEAR)[0]
    texture = cv2.remap(scene.texture, u[None], v[None], cv2.INTER_LINEAR)[0]
    assert np.abs(photo.astype(int) - texture).max() <= 2


def test_another_light_leaves_brightness_and_differs_where_the_ground_slopes() -> None:
    store = rendered.store()
    plain, _ = scene_of_map(store, around(300, 250, 80), AS_IT_IS)
    changed, _ = scene_of_map(store, around(300, 250, 80))
    assert changed.texture.mean() == pytest.approx(plain.texture.mean(), rel=0.06)
    assert np.abs(changed.texture.astype(int) - plain.texture).mean() > 12
    east, west = (scene_of_map(store, around(300, 250, 80), Light(sun_azimuth_deg=a))[0] for a in (90.0, 270.0))
    # Roofs and walls: what faces one sun has its back to the other.
    slope = cv2.Sobel(plain.surface, cv2.CV_32F, 1, 0) / 8 / plain.spec.gsd_m
    facing_west = slope > 0.4
    assert facing_west.sum() > 500
    difference = west.texture.astype(int).mean(axis=2) - east.texture.astype(int).mean(axis=2)
    assert difference[facing_west].mean() > 10 > -10 > difference[slope < -0.4].mean()


def test_a_camera_over_it_is_localized_where_it_is() -> None:
    store = rendered.store()
    scene, (west, south) = scene_of_map(store)
    local = store.pack.georeference.local_frame((west + 300.0, south + 250.0), scene.spec.ground_m)
    renderer = Renderer(scene, Placement(west, south, local.grid_scale), Sensor(), level_by_pixel=True)
    localizer = Localizer(rendered.CAMERA, store, Structural(), LocalizerOptions())
    try:
        for seed, truth in enumerate((rendered.pose(), rendered.pose(220.0, 180.0, pitch_deg=20.0, yaw_deg=200.0))):
            frame = Frame(0, renderer.render(rendered.CAMERA, truth, seed), "over the map")
            fix = localizer.localize(frame, rendered.prior(truth))
            assert isinstance(fix, Fix), fix
            off_m, off_deg = rendered.errors(fix.map_from_camera, truth)
            assert off_m < 0.25
            assert off_deg < 0.15
    finally:
        localizer.close()


def test_holes_are_closed_flat_and_not_shaded() -> None:
    dsm = np.full((60, 60), 100.0, np.float32)
    dsm[:, 30:] = 104.0
    dsm[20:30, 10:20] = np.nan
    dsm[45:, :20] = np.nan
    closed = _whole(dsm, 4.0)
    assert np.isfinite(closed).all()
    assert closed[np.isfinite(dsm)] == pytest.approx(dsm[np.isfinite(dsm)])
    assert closed[25, 15] == pytest.approx(100.0, abs=0.5)
    # 60 m from any height: the typical one, and not sea level.
    assert 99.0 <= closed[59, 0] <= 104.0
    bare = relit(np.zeros((60, 60, 3), np.uint8), np.zeros((60, 60), bool), np.ones((60, 60), np.float32), 1.0, Light())
    assert bare.std() < 30
    assert bare.mean() == pytest.approx(118, rel=0.1)


def test_a_place_off_the_map_is_named() -> None:
    west, south, _, _ = rendered.store().bounds
    with pytest.raises(MapError, match="no orthophoto with heights within"):
        scene_of_map(rendered.store(), (west - 900, south - 900, west - 800, south - 800))
