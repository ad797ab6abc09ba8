"""DISK with LightGlue: graphs against the published networks, keypoints, and matches of made scenes.

At 320 px, not with the other matchers at 640 (`test_matching_features`): it is the slowest of all.
"""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from scenes import field

from ortholoc_edge.errors import ConfigError, ModelError
from ortholoc_edge.geometry.grid import resize_px
from ortholoc_edge.geometry.homography import warp_points
from ortholoc_edge.matching import disk, models
from ortholoc_edge.matching.disk_graph import disk_descriptors_onnx, disk_onnx
from ortholoc_edge.matching.registry import make_matcher
from ortholoc_edge.matching.types import Features, Matcher
from ortholoc_edge.matching.working_image import WorkingImage

NAMES = ("disk", "disk-descriptors", "disk-lightglue")
Built = dict[str, models.StoredModel]


@pytest.fixture(scope="module")
def built(lightglue_wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Built:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(models.STORE_VARIABLE, str(tmp_path_factory.mktemp("disk")))
        return {name: models.build(name, wheel=lightglue_wheel) for name in NAMES}


@pytest.fixture(scope="module")
def matcher(built: Built) -> Matcher:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(models.STORE_VARIABLE, str(built["disk"].path.parents[1]))
        return make_matcher("disk-lightglue", working_px=320, max_keypoints=256, threads=1)


@pytest.fixture(scope="module")
def seen(matcher: Matcher) -> Features:
    """Of the scene that most tests take."""
    return matcher.extract(field(340, 260, seed=3)[:240, :320])


def test_graphs_equal_the_published_networks(built: Built) -> None:
    for name in NAMES:
        differences = models.verify(name, built[name].graph)
        assert 0 < max(differences.values()) < 1e-4  # rounding; the store's own limit is wider


@pytest.mark.parametrize(
    ("name", "weight"),
    [("disk", "path_up.3.conv.3.taps.w"), ("disk-descriptors", "last.w"), ("disk-lightglue", "frequencies")],
)
def test_a_changed_graph_is_told_from_the_published(built: Built, name: str, weight: str) -> None:
    onnx = pytest.importorskip("onnx")
    model = onnx.load_from_string(built[name].graph)
    (changed,) = (one for one in model.graph.initializer if one.name == weight)
    values = np.frombuffer(changed.raw_data, np.float32).copy()
    # A factor for all would go out of unit descriptors again.
    values[: len(values) // 2] *= np.float32(1.1)
    changed.raw_data = values.tobytes()
    with pytest.raises(ModelError, match=f"differs from the published {name}"):
        models.verify(name, model.SerializeToString())


def test_another_networks_weights_are_refused() -> None:
    for writer in (disk_onnx, disk_descriptors_onnx):
        with pytest.raises(ModelError, match=r"DISK weights: tensor .* is missing"):
            writer({"extractor.unet.other": np.zeros(3)}, "made up")


def test_licences_are_kept_beside_the_graphs(built: Built) -> None:
    for name in NAMES:
        assert "Apache License" in built[name].path.with_suffix(".LICENSE").read_text(encoding="utf-8")
        assert json.loads(built[name].path.with_suffix(".json").read_text())["licence"] == "Apache-2.0"
    # The wheel's text names LightGlue's holder only.
    assert "Eduard Trulls" in json.loads(built["disk"].path.with_suffix(".json").read_text())["note"]


def test_features_are_as_the_contract_says(matcher: Matcher, seen: Features) -> None:
    assert len(seen) == 256
    assert seen.keypoints_px.dtype == np.float64
    assert seen.scores.dtype == seen.descriptors.dtype == np.float32
    assert (np.diff(seen.scores) <= 0).all()
    np.testing.assert_allclose(np.linalg.norm(seen.descriptors, axis=1), 1.0, atol=1e-4)
    assert (seen.keypoints_px >= 1.5).all()
    assert (seen.keypoints_px <= (317.5, 237.5)).all()
    again = matcher.extract(field(340, 260, seed=3)[:240, :320].copy())
    np.testing.assert_array_equal(seen.keypoints_px, again.keypoints_px)
    np.testing.assert_array_equal(seen.descriptors, again.descriptors)


def test_a_shifted_scene_without_bias(matcher: Matcher, seen: Features) -> None:
    # By whole cells of its coarsest level.
    scene = field(340, 260, seed=3)
    matches = matcher.match(seen, matcher.extract(scene[16:256, 16:336]))
    errors = matches.map_px - matches.query_px + (16, 16)
    assert len(errors) > 80
    assert np.median(np.linalg.norm(errors, axis=1)) < 0.2
    assert np.abs(np.median(errors, axis=0)).max() < 0.05
    assert matches.confidence is not None
    assert (matches.confidence > 0.1).all()


def test_a_turned_scene_with_an_empty_part(matcher: Matcher) -> None:
    scene = field(480, 360, seed=3)
    turn = np.vstack([cv2.getRotationMatrix2D((239.5, 179.5), 20.0, 1.05), [0, 0, 1]])
    turned = cv2.warpPerspective(scene, turn, (480, 360))
    valid = cv2.warpPerspective(np.ones_like(scene), turn, (480, 360), flags=cv2.INTER_NEAREST) > 0
    reference = matcher.extract(turned, valid)
    matches = matcher.match(matcher.extract(scene), reference)
    errors = np.linalg.norm(matches.map_px - warp_points(turn, matches.query_px), axis=1)
    assert (errors < 3).sum() > 60
    assert (errors < 3).mean() > 0.8
    assert np.median(errors[errors < 3]) < 1.2  # of pictures half as large again as the working size
    near = cv2.dilate((~valid).astype(np.uint8), np.ones((15, 15), np.uint8)).astype(bool)
    u, v = np.rint(reference.keypoints_px).astype(int).T
    assert not near[v, u].any()


def test_pixels_of_the_original_come_back_exactly(matcher: Matcher) -> None:
    # 320 x 208: a multiple of 16, not of 32.
    scene = field(700, 455)
    whole = matcher.extract(scene)
    small = matcher.extract(cv2.resize(scene, (320, 208), interpolation=cv2.INTER_AREA))
    assert len(whole) > 100
    np.testing.assert_allclose(resize_px(whole.keypoints_px, (320 / 700, 208 / 455)), small.keypoints_px, atol=1e-6)


def test_pictures_without_content_have_no_features(matcher: Matcher, seen: Features) -> None:
    empty = matcher.extract(np.full((200, 300), 90, np.uint8))
    assert len(empty) == 0
    assert empty.descriptors.shape[1] == seen.descriptors.shape[1] == disk.DESCRIPTOR
    assert len(matcher.match(empty, seen)) == len(matcher.match(seen, empty)) == 0


def test_keypoints_by_hand() -> None:
    heat = np.full((12, 16), -1.0, np.float32)
    heat[4, 3], heat[4, 6], heat[8, 9] = 0.5, 0.7, 0.6
    heat[8, 12] = heat[8, 13] = 0.9  # equal: neither is greater than all others
    heat[1, 8], heat[5, 14] = 5.0, 5.0  # at the rim
    heat[9, 4], heat[9, 5] = 0.4, 0.45  # one beside the other
    image = np.zeros(heat.shape, np.uint8)
    pixels, best = disk._keypoints(heat, WorkingImage(image, None, (1.0, 1.0)), 9)
    assert pixels.tolist() == [[6, 4], [9, 8], [3, 4], [5, 9]]
    assert best.tolist() == pytest.approx([0.7, 0.6, 0.5, 0.45])
    usable = np.ones(heat.shape, np.bool_)
    usable[4, 6] = False
    pixels, _ = disk._keypoints(heat, WorkingImage(image, usable, (1.0, 1.0)), 2)
    assert pixels.tolist() == [[9, 8], [3, 4]]
    # None above 0 is wanted but at the rim, where none is taken.
    assert len(disk._keypoints(heat - 1, WorkingImage(image, None, (1.0, 1.0)), 9)[0]) == 0


def test_it_is_made_by_name(built: Built, matcher: Matcher, tmp_path: Path) -> None:
    assert matcher.name == "disk-lightglue"
    assert matcher.model_sha256 == models.joint_sha256(*(built[name].sha256 for name in NAMES))
    with pytest.raises(ConfigError, match="runs several models"):
        make_matcher("disk-lightglue", working_px=320, max_keypoints=9, threads=1, model_path=tmp_path / "x.onnx")
    graphs = [(built[name].graph, built[name].sha256) for name in NAMES[:2]]
    with pytest.raises(ValueError, match="multiple of 16"):
        disk.DiskExtractor(*graphs, working_px=330)
