"""Samples made over the demo pack: their parts fit together, the map and the photo, and nothing tells the place."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from made_samples import CAMERA, POSE, SMALL, by_confidence, made, photo
from replay import rendered

from ortholoc_edge.bench import calibration
from ortholoc_edge.bench.evaluation import localize, sample_error
from ortholoc_edge.bench.ground_truth import GroundTruthMatcher, geometric_confidence, true_map_px
from ortholoc_edge.bench.sample_maker import PackScenery
from ortholoc_edge.bench.sample_sheet import sample_sheet
from ortholoc_edge.bench.samples import Sample, read_sample, write_sample
from ortholoc_edge.errors import ConfigError, DatasetError
from ortholoc_edge.geometry import rotation
from ortholoc_edge.geometry.arrays import FloatArray
from ortholoc_edge.geometry.grid import bilinear
from ortholoc_edge.geometry.rigid import Rigid3
from ortholoc_edge.matching.sift import SiftMatcher
from ortholoc_edge.matching.types import Matches
from ortholoc_edge.tiles.lattice import Bounds
from ortholoc_edge.tiles.window import MapLayers


@pytest.fixture(scope="module")
def sample() -> Sample:
    return made()


def truth(sample: Sample) -> tuple[FloatArray, FloatArray]:
    """Points of the photo's pixels (N, 3) and the pixels (N, 2), of those that are known."""
    assert sample.point_map is not None
    known = np.isfinite(sample.point_map).all(axis=2)
    v, u = np.nonzero(known)
    return sample.point_map[known].astype(np.float64), np.column_stack([u, v]).astype(np.float64)


def places(sample: Sample, xyz: FloatArray, pose: Rigid3 = POSE) -> FloatArray:
    """Map coordinates of a sample's points, from where its camera is in both."""
    scale = rendered.georeference().grid_scale(pose.translation[:2], float(pose.translation[2]))
    offset = (xyz - sample.map_from_camera.translation) * (scale, scale, 1.0)
    return np.asarray(pose.translation + offset, dtype=np.float64)


def keypoints(sample: Sample) -> FloatArray:
    assert sample.keypoints is not None
    return sample.keypoints


def test_every_point_is_on_its_pixels_ray_and_on_the_packs_surface(sample: Sample) -> None:
    points, px = truth(sample)
    assert len(points) > 0.99 * CAMERA.width * CAMERA.height
    back = CAMERA.project(sample.map_from_camera.inverse().apply(points))
    assert np.abs(back - px).max() < 1e-3
    at = places(sample, points)
    # True metres: taken for metres of the grid, whose scale there is 0.9998, the points would be 2 cm off.
    assert np.abs(rendered.store().heights(at[:, :2]) - at[:, 2]).max() < 5e-3
    assert rendered.georeference().grid_scale(POSE.translation[:2], 500.0) < 0.9999


def test_the_rasters_are_the_packs(sample: Sample) -> None:
    grid = sample.grid
    assert (grid.width, grid.height) == sample.dop.shape[1::-1] == sample.dsm.shape[::-1] == (400, 400)
    assert grid.dx == -grid.dy
    lot = np.random.default_rng(0)
    px = lot.integers(0, 400, (4000, 2))
    xyz = np.column_stack([grid.map_from_px(px), sample.dsm[px[:, 1], px[:, 0]].astype(np.float64)])
    at = places(sample, xyz)
    known = np.isfinite(at[:, 2])
    assert known.mean() > 0.9
    assert np.abs(rendered.store().heights(at[known, :2]) - at[known, 2]).max() < 5e-3
    window = rendered.store().read_colour((*(at[:, :2].min(axis=0) - 1), *(at[:, :2].max(axis=0) + 1)), grid.dx)
    assert window is not None
    there = window.grid.px_from_map(at[:, :2])
    want = np.stack([bilinear(window.rgb[..., k].astype(np.float32), there) for k in range(3)], axis=1)
    off = np.abs(want - sample.dop[px[:, 1], px[:, 0]])[np.isfinite(want).all(axis=1)]
    assert len(off) > 3000
    assert off.max() <= 1.0


def test_the_photo_shows_the_orthophoto_at_its_points(sample: Sample) -> None:
    """The photo was drawn from the map, so that a flipped axis or a shift by a pixel would be seen."""
    assert sample.point_map is not None
    at = sample.grid.px_from_map(sample.point_map[..., :2].astype(np.float64)).astype(np.float32)
    seen = cv2.remap(sample.dop, at[..., 0], at[..., 1], cv2.INTER_LINEAR)
    grey = cv2.cvtColor(seen, cv2.COLOR_RGB2GRAY).astype(np.float64)
    assert np.corrcoef(grey.ravel(), photo()[..., 0].ravel())[0, 1] > 0.9


def test_keypoints_lie_on_the_surface_and_in_the_photo(sample: Sample) -> None:
    points = keypoints(sample)
    assert len(points) > 100
    px = CAMERA.project(sample.map_from_camera.inverse().apply(points))
    assert CAMERA.contains(px).all()
    at = places(sample, points)
    off = np.abs(rendered.store().heights(at[:, :2]) - at[:, 2])
    assert np.median(off) < 0.02
    # Between pixels a crest may be cut, a wall may not be jumped.
    assert off.max() < 1.0


def test_the_mesh_is_the_surface_seen_from_above(sample: Sample) -> None:
    vertices, faces = sample.vertices, sample.faces
    assert vertices is not None
    assert faces is not None
    at = places(sample, vertices.astype(np.float64))
    assert np.abs(rendered.store().heights(at[:, :2]) - at[:, 2]).max() < 5e-3
    a, b, c = (vertices[faces[:, k]].astype(np.float64) for k in range(3))
    up = np.cross(b - a, c - a)[:, 2]
    assert (up > 0).all()
    # All of the raster from the first pixel's centre to the last one's.
    west, south, east, north = sample.grid.bounds
    assert up.sum() / 2 == pytest.approx((east - west) * (north - south) * (399 / 400) ** 2, rel=1e-3)
    assert set(np.unique(faces)) == set(range(len(vertices)))


def test_the_ground_truth_localizes_to_the_truth(sample: Sample, tmp_path: Path) -> None:
    """Also what was written and read, and the pose that is called refined."""
    again = read_sample(write_sample(sample, tmp_path))
    for one in (sample, again):
        matches = GroundTruthMatcher().match(one)
        error = sample_error(one, matches, localize(one, matches))
        assert error.me_px < 1e-3
        assert error.te_m < 0.005
        assert error.re_deg < 0.005
        assert error.rpe_px < 0.05
    assert again.map_from_camera_refined is not None
    assert np.linalg.norm(again.map_from_camera_refined.translation - again.map_from_camera.translation) < 0.005


def test_a_seed_gives_the_same_bytes_and_another_one_another_place(sample: Sample, tmp_path: Path) -> None:
    first = write_sample(sample, tmp_path / "a").read_bytes()
    assert write_sample(made(), tmp_path / "b").read_bytes() == first
    for options, index in ((replace(SMALL, seed=4), 0), (SMALL, 1)):
        other = made(options, index)
        assert other.grid.bounds != sample.grid.bounds
        assert np.abs(other.map_from_camera.translation - sample.map_from_camera.translation).min() > 0.01
        # What the camera sees below itself is the same.
        below = [one.point_map[120, 160] - one.map_from_camera.translation for one in (sample, other)]  # type: ignore[index]
        assert np.allclose(below[0], below[1], atol=1e-4)


def test_nothing_tells_the_place(sample: Sample) -> None:
    """The frame's origin is one of the points that are seen."""
    points, _ = truth(sample)
    assert np.linalg.norm(points, axis=1).min() < 1e-6
    assert np.abs(points).max() < 300
    assert np.abs(sample.map_from_camera.translation).max() < 300
    assert np.nanmax(np.abs(sample.dsm)) < 100
    assert np.abs(keypoints(sample)).max() < 300


def test_the_region_moves_by_what_the_options_say(sample: Sample) -> None:
    quick = replace(SMALL, query_px=80, keypoints=10)
    still = made(replace(quick, perturbation_m=0.0))
    moved = [made(replace(quick, seed=seed)) for seed in range(4)]

    def bounds(one: Sample) -> FloatArray:
        """From the camera, so that they compare."""
        return np.array(one.grid.bounds) - np.tile(one.map_from_camera.translation[:2], 2)

    off = np.array([bounds(one) - bounds(still) for one in moved])
    assert np.abs(off).max() > 2.0
    # A vertex moves by 20 m or less; so does the middle, and a square grows on both sides by what its longer one does.
    assert np.abs(off).max() < 40.0
    for one in moved:
        points, _ = truth(one)
        px = one.grid.px_from_map(points[:, :2])
        assert ((px >= 0) & (px <= 399)).all(axis=1).mean() > 0.94
    # A low flight's region moves by a part of its size.
    low = rendered.pose(height_m=20.0)
    small = [made(replace(quick, seed=seed), pose=low).grid.dx for seed in range(4)]
    assert max(small) < 1.7 * made(replace(quick, perturbation_m=0.0), pose=low).grid.dx


def test_large_photos_are_averaged_down(sample: Sample) -> None:
    smaller = made(replace(SMALL, query_px=160))
    assert smaller.image.shape == (120, 160, 3)
    assert smaller.camera == CAMERA.resized(160, 120)
    points, px = truth(smaller)
    assert np.abs(smaller.camera.project(smaller.map_from_camera.inverse().apply(points)) - px).max() < 1e-3


@pytest.mark.parametrize("east_m", [-40.0, -9000.0], ids=["beside", "far"])
def test_a_photo_off_the_map_is_refused(east_m: float) -> None:
    away = Rigid3(POSE.rotation, POSE.translation + np.array([east_m - rendered.MIDDLE[0], 0.0, 0.0]))
    with pytest.raises(DatasetError, match=r"D01_R0000: [0-4]?\d % of the photo shows the map, 50 % must"):
        made(pose=away)


class OlderPack(PackScenery):
    """Whose map shows the ground a metre higher than it is now."""

    def layers(self, bounds_map: Bounds, gsd_m: float) -> MapLayers:
        layers = super().layers(bounds_map, gsd_m)
        return replace(layers, dsm=layers.dsm + np.float32(1.0))


class HoledPack(PackScenery):
    """Whose surface is unknown east of the camera."""

    def heights(self, xy_map: FloatArray) -> FloatArray:
        return np.where(xy_map[:, 0] > POSE.translation[0], np.nan, super().heights(xy_map))


def test_the_mesh_ends_where_the_surface_does() -> None:
    holed = made(place=HoledPack(rendered.store()))
    assert holed.vertices is not None
    assert holed.faces is not None
    assert np.isfinite(holed.vertices).all()
    assert holed.vertices[:, 0].max() <= holed.map_from_camera.translation[0] + 1e-3
    assert 100 < len(holed.vertices) < 1500
    assert set(np.unique(holed.faces)) == set(range(len(holed.vertices)))


def test_across_domains_the_truth_is_the_photos_and_the_map_is_the_maps() -> None:
    older = made(place=OlderPack(rendered.store()))
    points, _ = truth(older)
    assert np.nanmedian(geometric_confidence(points, older)) == pytest.approx(np.exp(-1.0), abs=0.01)
    # By that map the camera is a metre higher: what its refined pose says.
    assert older.map_from_camera_refined is not None
    risen = older.map_from_camera_refined.translation - older.map_from_camera.translation
    assert risen == pytest.approx([0.0, 0.0, 1.0], abs=0.05)


# -- ground truth ------------------------------------------------------------------------------------------


def test_confidence_worked_by_hand(sample: Sample) -> None:
    flat = replace(sample, dsm=np.full((400, 400), 5.0, np.float32))
    x, y = flat.grid.map_from_px([200.3, 150.8])
    off_m = np.array([0.0, np.log(2.0), -np.log(2.0), 1.0, np.nan])
    points = np.column_stack([np.full(5, x), np.full(5, y), 5.0 + off_m])
    assert geometric_confidence(points, flat)[:4] == pytest.approx([1.0, 0.5, 0.5, np.exp(-1.0)])
    assert geometric_confidence(points, flat, decay_per_m=2.0)[:4] == pytest.approx([1.0, 0.25, 0.25, np.exp(-2.0)])
    assert np.isnan(geometric_confidence(points, flat)[4])
    west = np.array([[flat.grid.west - 1.0, y, 5.0]])
    assert np.isnan(geometric_confidence(west, flat)).all()


def test_matches_are_where_the_points_are(sample: Sample) -> None:
    matches = GroundTruthMatcher(stride_px=7).match(sample)
    assert matches.confidence is not None
    assert (matches.query_px % 7 == 0).all()
    points, px = truth(sample)
    by_px = {(u, v): point for (u, v), point in zip(px.tolist(), points, strict=True)}
    for k in range(0, len(matches), 97):
        point = by_px[tuple(matches.query_px[k].tolist())]
        assert sample.grid.map_from_px(matches.map_px[k]) == pytest.approx(point[:2], abs=1e-4)
    # Between pixels too.
    half = true_map_px(sample, matches.query_px[:50] + 0.0)
    assert half == pytest.approx(matches.map_px[:50], abs=1e-4)
    with pytest.raises(DatasetError, match="point_map"):
        GroundTruthMatcher().match(replace(sample, point_map=None))


def test_what_the_map_does_not_have_spoils_the_pose_until_its_confidence_leaves_it_out(sample: Sample) -> None:
    """A third of the photo shows things that rise above the map by half a metre: sheds newer than the survey."""
    assert sample.point_map is not None
    risen = sample.point_map.astype(np.float64)
    eye = sample.map_from_camera.translation
    part = risen[:, :110]
    risen[:, :110] = eye + (part - eye) * ((part[..., 2:] + 0.5 - eye[2]) / (part[..., 2:] - eye[2]))
    changed = replace(sample, point_map=risen.astype(np.float32))
    found = by_confidence(changed)
    all_of_them, half, most, nearly = (one.error for one in found)
    assert all_of_them.te_m > 0.05
    assert all_of_them.re_deg > 0.03
    assert half.te_m > 0.05
    assert most.te_m < 0.005
    assert most.re_deg < 0.005
    assert nearly.te_m < 0.005
    assert found[0].matches == found[0].found
    assert 0.5 < found[2].matches / found[2].found < 0.7


def test_too_few_matches_are_no_pose_and_that_counts(sample: Sample) -> None:
    few = GroundTruthMatcher().match(sample).take(np.arange(4))
    error = sample_error(sample, few, localize(sample, few))
    assert (error.te_m, error.re_deg, error.rpe_px) == (np.inf, np.inf, np.inf)
    assert error.me_px < 1e-3
    nothing = Matches(np.empty((0, 2)), np.empty((0, 2)))
    assert sample_error(sample, nothing, None).me_px == np.inf


def test_errors_of_a_pose_that_is_off(sample: Sample) -> None:
    """As the metrics' own tests have it, through a whole sample."""
    matches = GroundTruthMatcher().match(sample)
    found = localize(sample, matches)
    assert found is not None
    pose = found.local_from_camera
    off = replace(
        found,
        local_from_camera=Rigid3(
            rotation.exp([0.0, 0.0, np.radians(2.0)]) @ pose.rotation, pose.translation + np.array([0.0, 0.3, 0.4])
        ),
    )
    shifted = Matches(matches.query_px, matches.map_px + np.array([3.0, 4.0]))
    error = sample_error(sample, shifted, off)
    assert error.me_px == pytest.approx(5.0, abs=1e-3)
    assert error.te_m == pytest.approx(0.5, abs=0.005)
    assert error.re_deg == pytest.approx(2.0, abs=0.005)
    assert 1.0 < error.rpe_px < 10.0


def test_a_sheet_has_six_panels(sample: Sample) -> None:
    sheet = sample_sheet(sample)
    assert sheet.dtype == np.uint8
    rows, columns = sheet.shape[0] // 2, sheet.shape[1] // 3
    for row in range(2):
        for column in range(3):
            panel = sheet[row * rows : (row + 1) * rows, column * columns : (column + 1) * columns]
            assert panel.std() > 15.0
    with pytest.raises(DatasetError, match="keypoints"):
        sample_sheet(replace(sample, keypoints=None))


def test_photos_of_two_cameras_are_not_calibrated_as_one(sample: Sample, tmp_path: Path) -> None:
    """Silently mixed they gave the focal length of neither."""
    longer = replace(sample, name="D01_R0001", camera=replace(CAMERA, fx=300.0, fy=300.0))
    paths = [write_sample(one, tmp_path) for one in (sample, longer)]
    matched = calibration.match(
        calibration.sample_photos(paths, None),
        SiftMatcher(working_px=320, max_keypoints=300),
        None,
        adhop=False,
        known=calibration.KnownBeside(),
        seed=0,
    )
    assert next(matched).camera == CAMERA
    with pytest.raises(ConfigError, match=r"R0001: recorded with .* 300\.0 px, D01_R0000 with 270\.0; .*one camera"):
        next(matched)
