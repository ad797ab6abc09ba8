"""ALIKED with LightGlue: graphs against the published networks, keypoints, and matches of a turned scene."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from scenes import field

from ortholoc_edge.errors import ConfigError, ModelError
from ortholoc_edge.geometry.homography import warp_points
from ortholoc_edge.matching import aliked, lighterglue_graph, models
from ortholoc_edge.matching.registry import make_matcher
from ortholoc_edge.matching.types import Matcher

NAMES = ("aliked", "aliked-descriptors", "aliked-lightglue")
Built = dict[str, models.StoredModel]


@pytest.fixture(scope="module")
def built(lightglue_wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Built:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(models.STORE_VARIABLE, str(tmp_path_factory.mktemp("aliked")))
        return {name: models.build(name, wheel=lightglue_wheel) for name in NAMES}


@pytest.fixture(scope="module")
def matcher(built: Built) -> Matcher:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(models.STORE_VARIABLE, str(built["aliked"].path.parents[1]))
        return make_matcher("aliked-lightglue", working_px=320, max_keypoints=256, threads=1)


def test_graphs_equal_the_published_networks(built: Built) -> None:
    for name in NAMES:
        differences = models.verify(name, built[name].graph)
        assert 0 < max(differences.values()) < 1e-4  # rounding; the store's own limit is wider


@pytest.mark.parametrize(
    ("name", "weight"),
    [("aliked", "block3.conv2.w"), ("aliked-descriptors", "join.w"), ("aliked-lightglue", "frequencies")],
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


def test_licences_are_kept_beside_the_graphs(built: Built) -> None:
    for name, licence in (("aliked", "BSD 3-Clause License"), ("aliked-lightglue", "Apache License")):
        assert licence in built[name].path.with_suffix(".LICENSE").read_text(encoding="utf-8")
        assert json.loads(built[name].path.with_suffix(".json").read_text())["licence"] == models.known(name).licence


def test_a_shifted_scene_without_bias(matcher: Matcher) -> None:
    scene = field(340, 260, seed=3)
    matches = matcher.match(matcher.extract(scene[:240, :320]), matcher.extract(scene[16:256, 8:328]))
    errors = matches.map_px - matches.query_px + (8, 16)
    assert len(errors) > 80
    assert np.median(np.linalg.norm(errors, axis=1)) < 0.2
    assert np.abs(np.median(errors, axis=0)).max() < 0.05


@pytest.mark.parametrize("turn_deg", [10.0, -30.0])
def test_a_turned_scene(matcher: Matcher, turn_deg: float) -> None:
    scene = field(480, 360, seed=3)
    turn = np.vstack([cv2.getRotationMatrix2D((239.5, 179.5), turn_deg, 1.05), [0, 0, 1]])
    seen = cv2.warpPerspective(scene, turn, (480, 360))
    valid = cv2.warpPerspective(np.ones_like(scene), turn, (480, 360), flags=cv2.INTER_NEAREST) > 0
    reference = matcher.extract(seen, valid)
    matches = matcher.match(matcher.extract(scene), reference)
    errors = np.linalg.norm(matches.map_px - warp_points(turn, matches.query_px), axis=1)
    assert (errors < 3).sum() > 60
    assert (errors < 3).mean() > 0.8
    assert np.median(errors[errors < 3]) < 1.0
    assert matches.confidence is not None
    assert (matches.confidence > 0.1).all()
    u, v = np.rint(reference.keypoints_px).astype(int).T
    assert valid[v, u].all()


def test_pictures_without_content_have_no_features(matcher: Matcher) -> None:
    empty = matcher.extract(np.full((200, 300), 90, np.uint8))
    some = matcher.extract(field(300, 200))
    assert len(empty) == 0
    assert empty.descriptors.shape[1] == some.descriptors.shape[1] == aliked.DESCRIPTOR
    assert len(matcher.match(empty, some)) == len(matcher.match(some, empty)) == 0
    np.testing.assert_allclose(np.linalg.norm(some.descriptors, axis=1), 1.0, atol=1e-4)
    assert (np.diff(some.scores) <= 0).all()


def test_peaks_by_hand() -> None:
    scores = np.zeros((9, 12), np.float32)
    scores[4, 3], scores[4, 5], scores[4, 8] = 0.9, 0.8, 0.7
    peaks = aliked._peaks(scores)
    # 0.8 is near 0.9; with both it left out, 0.7, which was near 0.8 only by chance of order, is one of its own.
    assert peaks[4, 3]
    assert not peaks[4, 5]
    assert peaks[4, 8]
    # The soft maximum leans to the greater neighbour: here to 0.8, by e^-1 of two pixels.
    pixels, best = aliked._keypoints(scores, None, 2)
    assert best.tolist() == pytest.approx([0.9, 0.7])
    others = 23 * np.exp(-9.0)
    expected = 2 * np.exp(-1.0) / (1 + np.exp(-1.0) + others)
    assert pixels[0] == pytest.approx([3 + expected, 4.0], abs=0.01)


def test_cells_are_around_the_whole_part_and_inside() -> None:
    cells = aliked._cells(np.array([[5.7, 3.2], [0.0, 0.0], [39.0, 23.0]]), 24, 40)
    assert cells[0].tolist() == [v * 40 + u for v in (2, 3, 4) for u in (4, 5, 6)]
    assert cells[1].tolist() == [v * 40 + u for v in (0, 1, 2) for u in (0, 1, 2)]
    assert cells[2].tolist() == [v * 40 + u for v in (20, 21, 22) for u in (36, 37, 38)]


def test_older_checkpoints_names_are_todays() -> None:
    assert lighterglue_graph._todays_name("self_attn.3.Wqkv.weight") == "transformers.3.self_attn.Wqkv.weight"
    assert lighterglue_graph._todays_name("cross_attn.0.to_out.bias") == "transformers.0.cross_attn.to_out.bias"
    for name in ("transformers.3.self_attn.Wqkv.weight", "log_assignment.8.final_proj.bias", "posenc.Wr.weight"):
        assert lighterglue_graph._todays_name(name) == name


def test_it_is_made_by_name(built: Built, matcher: Matcher, tmp_path: Path) -> None:
    assert matcher.name == "aliked-lightglue"
    assert matcher.model_sha256 == models.joint_sha256(*(built[name].sha256 for name in NAMES))
    with pytest.raises(ConfigError, match="runs several models"):
        make_matcher("aliked-lightglue", working_px=320, max_keypoints=9, threads=1, model_path=tmp_path / "x.onnx")
    graphs = [(built[name].graph, built[name].sha256) for name in NAMES[:2]]
    with pytest.raises(ValueError, match="multiple of 32"):
        aliked.AlikedExtractor(*graphs, working_px=330)
