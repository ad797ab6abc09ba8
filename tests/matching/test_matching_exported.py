"""Matchers whose graphs are exported: the run-time side on graphs with known answers, the catalogue, the store."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import tiny_graphs
from scenes import field
from tiny_graphs import FINE, HEIGHT, SHIFT_PX, WIDTH

from ortholoc_edge.cli import main
from ortholoc_edge.errors import ConfigError, ModelError
from ortholoc_edge.matching import dedode, models, pairs, superpoint
from ortholoc_edge.matching.exported import EXPORTED
from ortholoc_edge.matching.registry import MATCHERS, METHODS, RANDOM, make_matcher, make_method
from ortholoc_edge.matching.types import Features, Matcher, Matches, UnscaledMatcher

GRAPHS = {
    "loftr": tiny_graphs.pairs,
    "gim-dkm": tiny_graphs.warp,
    "dust3r": tiny_graphs.points,
}
# The size of the finest view, in whose pixels the graph's answer is.
SIZES = {"loftr": (WIDTH, HEIGHT), "gim-dkm": FINE, "dust3r": (WIDTH, HEIGHT)}


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv(models.STORE_VARIABLE, str(tmp_path))
    return models.model_directory()


def _make(name: str, max_keypoints: int = 400) -> Matcher:
    return make_matcher(name, working_px=640, max_keypoints=max_keypoints, threads=1)


@pytest.fixture(params=list(GRAPHS))
def matcher(request: pytest.FixtureRequest, folder: Path) -> Matcher:
    tiny_graphs.store(request.param, {"": GRAPHS[request.param]()}, folder)
    return _make(request.param)


def _matches(matcher: Matcher, query: np.ndarray, reference: np.ndarray, valid: np.ndarray | None = None) -> Matches:
    return matcher.match(matcher.extract(query), matcher.extract(reference, valid))


# -- two pictures at once ------------------------------------------------------


@pytest.mark.parametrize("shape", [(HEIGHT, WIDTH), (600, 800), (97, 351)])
def test_pixels_come_back_without_bias(matcher: Matcher, shape: tuple[int, int]) -> None:
    """The graph moves by whole pixels of its own view; a pixel's centre at k is at (k + 0.5) s - 0.5 in the picture."""
    width, height = SIZES[matcher.name]
    rows, columns = shape
    other = field(columns + 40, rows + 20)
    found = _matches(matcher, field(columns, rows), other)
    assert len(found) > 30
    scale = np.array([columns / width, rows / height]), np.array([(columns + 40) / width, (rows + 20) / height])
    query, reference = ((px + 0.5) / s - 0.5 for px, s in zip((found.query_px, found.map_px), scale, strict=True))
    tolerance = 2e-5 if matcher.name == "gim-dkm" else 1e-6  # a warp is float32 of -1..1
    np.testing.assert_allclose(reference - query, np.tile([SHIFT_PX, 0.0], (len(found), 1)), atol=tolerance)
    expected = 0.25 if matcher.name == "loftr" else 0.0
    here = (query if matcher.name != "gim-dkm" else np.minimum(np.abs(query % 1), np.abs(1 - query % 1))) % 1
    np.testing.assert_allclose(np.abs((here - expected + 0.5) % 1 - 0.5), 0.0, atol=tolerance)


def test_nothing_where_a_picture_has_no_data(matcher: Matcher) -> None:
    picture = field(800, 600)
    valid = np.ones(picture.shape, np.bool_)
    valid[:, :400] = False
    found = _matches(matcher, picture, picture, valid)
    assert len(found) > 15
    assert (found.map_px[:, 0] > 400).all()
    assert len(_matches(matcher, picture, picture)) > 1.5 * len(found)


@pytest.mark.parametrize("empty", [np.zeros((600, 800), np.uint8), np.zeros((4, 4), np.uint8)])
def test_empty_pictures_have_no_matches(matcher: Matcher, empty: np.ndarray) -> None:
    picture = field(320, 256)
    assert len(_matches(matcher, empty, picture)) == len(_matches(matcher, picture, empty)) == 0
    assert len(_matches(matcher, picture, picture, np.zeros(picture.shape, np.bool_))) == 0


def test_same_pictures_give_the_same_matches(matcher: Matcher) -> None:
    one, two = field(800, 600), field(800, 600, seed=1)
    first, second = _matches(matcher, one, two), _matches(matcher, one.copy(), two.copy())
    np.testing.assert_array_equal(first.query_px, second.query_px)
    np.testing.assert_array_equal(first.map_px, second.map_px)


def test_what_the_protocol_asks(matcher: Matcher) -> None:
    assert matcher.working_px == WIDTH
    assert len(matcher.model_sha256 or "") == 64
    assert not isinstance(matcher, UnscaledMatcher)
    assert len(matcher.extract(field(320, 256))) == 0
    with pytest.raises(ValueError, match="another matcher's"):
        matcher.match(
            Features(np.empty((0, 2)), np.empty(0, np.float32), np.empty((0, 0), np.float32)),
            matcher.extract(field(320, 256)),
        )
    found = _matches(matcher, field(320, 256), field(320, 256))
    assert len(found) <= 400
    if matcher.name == "dust3r":
        assert found.confidence is None
    else:
        assert found.confidence is not None
        assert (found.confidence <= 1).all()
        assert (found.confidence > EXPORTED[matcher.name].min_confidence).all()


def test_fewer_matches_where_fewer_are_asked_for(folder: Path) -> None:
    for name, make in GRAPHS.items():
        tiny_graphs.store(name, {"": make()}, folder)
        assert 5 < len(_matches(_make(name, 20), field(320, 256), field(320, 256))) <= 20
    assert _matches(_make("loftr", 20), field(320, 256), field(320, 256)).confidence.min() > 0.7  # the best ones


def test_points_that_the_network_distrusts_are_left_out(folder: Path) -> None:
    tiny_graphs.store("dust3r", {"": tiny_graphs.points(confidence=2.9)}, folder)
    assert len(_matches(_make("dust3r"), field(320, 256), field(320, 256))) == 0


def test_pixels_of_an_uncertain_warp_are_left_out(folder: Path) -> None:
    tiny_graphs.store("gim-dkm", {"": tiny_graphs.warp()}, folder)
    found = _matches(_make("gim-dkm"), field(*FINE), field(*FINE))
    assert len(found) > 150
    assert found.query_px[:, 1].max() < FINE[1] // 2
    # As the published code has it: what it takes is sure.
    assert found.confidence is not None
    assert set(found.confidence) == {1.0}


def test_most_certain_pixel_of_each_cell() -> None:
    certainty = np.zeros((7, 10), np.float32)
    certainty[1, 2], certainty[3, 3], certainty[6, 9] = 0.5, 0.9, 0.4
    v, u = pairs._most_certain(certainty, 6)
    assert len(v) <= 6
    assert {(1, 2), (3, 3), (6, 9)} & set(zip(v.tolist(), u.tolist(), strict=True)) >= {(3, 3), (6, 9)}
    every, _ = pairs._most_certain(certainty, 70)
    assert len(every) == 70


@pytest.mark.parametrize("euclidean", [True, False])
def test_reciprocal_neighbours_are_those_of_all_pairs(euclidean: bool) -> None:
    source = np.random.default_rng(5)
    query = source.normal(size=(300, 4)).astype(np.float32) + np.float32(100 * euclidean)
    reference = source.normal(size=(280, 4)).astype(np.float32) + np.float32(100 * euclidean)
    likeness = -np.square(query[:, None].astype(np.float64) - reference).sum(-1) if euclidean else query @ reference.T
    mutual = {(i, int(j)) for i, j in enumerate(likeness.argmax(1)) if likeness[:, j].argmax() == i}
    i, j = pairs.reciprocal_nearest(query, reference, np.arange(300), euclidean=euclidean)
    found = set(zip(i.tolist(), j.tolist(), strict=True))
    assert found <= mutual
    assert len(found) == len(mutual)  # each is where it started
    assert len(i) == len(np.unique(i))


# -- keypoints -----------------------------------------------------------------


def test_superpoint_finds_bright_pixels(folder: Path) -> None:
    matching = tiny_graphs.graph(
        {f"{side}_{what}": (count, *width) for side, count in (("query", "M"), ("reference", "N"))
         for what, width in (("descriptors", (256,)), ("places", (2,)), ("scores", ()))},
        {"log_assignment": np.log([[0.9, 0.05], [0.1, 0.15]])},
    )  # fmt: skip
    graphs = {"superpoint": tiny_graphs.superpoint(), "superglue": matching}
    tiny_graphs.store("superpoint-superglue", graphs, folder)
    matcher = make_matcher("superpoint-superglue", working_px=160, max_keypoints=50, threads=1)
    image = np.zeros((256, 320), np.uint8)
    for u, v in ((100, 60), (200, 160), (300, 30)):
        image[v : v + 2, u : u + 2] = 255 - u // 10
    valid = np.ones(image.shape, np.bool_)
    valid[:, 260:] = False
    features = matcher.extract(image, valid)
    np.testing.assert_allclose(features.keypoints_px, [[100.5, 60.5], [200.5, 160.5]], atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(features.descriptors, axis=1), 1.0, atol=1e-6)
    found = matcher.match(features, features)
    # The second pair is each other's likeliest, too, but at 0.15 no match.
    np.testing.assert_array_equal(found.query_px, features.keypoints_px[:1])
    np.testing.assert_allclose(found.confidence, [0.9], atol=1e-6)
    assert len(matcher.extract(np.zeros((256, 320), np.uint8))) == 0
    assert len(matcher.match(features, matcher.extract(np.zeros((256, 320), np.uint8)))) == 0


def test_descriptors_between_cells() -> None:
    dense = np.zeros((2, 4, 5), np.float32)
    dense[0], dense[1] = np.arange(5.0), 1.0  # grows with u
    at = superpoint.sampled(dense, np.array([[3.5, 3.5], [39.0, 31.0], [21.25, 17.25]]))
    slope = at[:, 0] / at[:, 1]
    # The first cell's middle, the picture's last pixel, and half between.
    np.testing.assert_allclose(slope, [0.0, 4.0, 2.0], atol=1e-5)


def test_suppression_keeps_what_only_a_lesser_peak_hid() -> None:
    heat = np.zeros((9, 30), np.float32)
    heat[4, 5], heat[4, 9], heat[4, 13] = 3.0, 2.0, 1.0  # the middle one falls to the first, so the third may stay
    assert np.argwhere(superpoint.suppressed(heat) & (heat > 0)).tolist() == [[4, 5], [4, 13]]


def test_dedode(folder: Path) -> None:
    heat = np.full((1, 1, 56, 84), -20.0)
    heat[0, 0, 20, 30], heat[0, 0, 40, 60], heat[0, 0, 10, 70] = 5.0, 4.0, 6.0
    described = np.eye(2, 256)
    shape = tiny_graphs.picture(84, 56)
    graphs = {
        "detector": tiny_graphs.graph({"picture": shape}, {"heat": heat}),
        "descriptor": tiny_graphs.graph({"picture": shape, "keypoints": ("N", 2)}, {"descriptors": described}),
    }
    tiny_graphs.store("dedode", graphs, folder)
    matcher = make_matcher("dedode", working_px=640, max_keypoints=2, threads=1)
    assert matcher.working_px == 84
    valid = np.ones((112, 168), np.bool_)
    valid[:60, 100:] = False
    features = matcher.extract(field(168, 112), valid)
    np.testing.assert_allclose(features.keypoints_px, [[60.5, 40.5], [120.5, 80.5]], atol=1e-6)
    found = matcher.match(features, features)
    np.testing.assert_array_equal(found.query_px, found.map_px)
    assert len(found) == 2
    assert found.confidence is None


def test_dual_softmax() -> None:
    query = np.array([[1.0, 0.0], [0.0, 1.0], [0.6, 0.8]], np.float32)
    reference = np.array([[0.0, 1.0], [1.0, 0.0], [1.0, 0.0]], np.float32)
    i, j = dedode.dual_softmax(query, reference, 0.1)
    # The first row's two likenesses share its mass: 0.5 of a row, and of a column nearly 1.
    assert list(zip(i.tolist(), j.tolist(), strict=True)) == [(0, 1), (1, 0)]
    assert dedode.dual_softmax(query, reference, 0.6)[0].tolist() == [1]


# -- catalogue and store -------------------------------------------------------


def test_paper_is_complete() -> None:
    assert set(EXPORTED) == {
        "superpoint-superglue", "superpoint-lightglue", "dedode", "loftr", "minima-loftr", "eloftr", "xoftr", "dkm",
        "gim-dkm", "dust3r", "mast3r", "roma", "minima-roma",
    }  # fmt: skip
    assert set(EXPORTED) <= set(MATCHERS)
    assert {entry.name for entry in EXPORTED.values() if entry.non_commercial} == {
        "superpoint-superglue", "superpoint-lightglue", "gim-dkm", "dust3r", "mast3r",
    }  # fmt: skip
    for entry in EXPORTED.values():
        for file in entry.files:
            assert file.sha256 is None or len(bytes.fromhex(file.sha256)) == 32
            assert file.address is None or file.address.startswith("https://")


def test_the_documents_table_says_the_same() -> None:
    text = (Path(__file__).parents[2] / "docs" / "matchers.md").read_text(encoding="utf-8")
    rows = {row.split("`")[1]: row for row in text.splitlines() if row.startswith("| `")}
    for entry in EXPORTED.values():
        row = rows[entry.name]
        assert ("**non-commercial**" in row) == entry.non_commercial
        assert entry.licence.split(";")[0].split(" (")[0] in row
        for file in entry.files:
            assert f"`{file.file}`" in row
        for size in filter(None, (entry.size, entry.fine_size)):
            assert f"{size[0]} x {size[1]}" in row
        pinned = [file.sha256 is not None for file in entry.files]
        assert row.split("|")[3].strip() == ("yes" if all(pinned) else "DINOv2 only" if any(pinned) else "no")


def test_what_is_not_built_says_how(folder: Path) -> None:
    with pytest.raises(ModelError, match=r"from zju3dv/LoFTR.*models build loftr --weights outdoor_ds\.ckpt"):
        _make("loftr")
    with pytest.raises(
        ModelError, match=r"--weights roma=roma_outdoor.pth --weights dinov2=dinov2_vitl14_pretrain.pth"
    ):
        _make("roma")
    with pytest.raises(ModelError, match="--accept-non-commercial"):
        _make("dust3r")


def test_a_non_commercial_licence_takes_the_yes_that_was_recorded(folder: Path) -> None:
    tiny_graphs.store("dust3r", {"": tiny_graphs.points()}, folder, accepted=False)
    with pytest.raises(ModelError, match=r"CC-BY-NC-SA-4.0.*forbids commercial use.*--accept-non-commercial"):
        _make("dust3r")
    # Where the licence asks for no yes, none is needed.
    tiny_graphs.store("loftr", {"": tiny_graphs.pairs()}, folder, accepted=False)
    _make("loftr")


def test_random_weights_are_never_taken_for_a_matcher(folder: Path) -> None:
    tiny_graphs.store("loftr", {"": tiny_graphs.pairs()}, folder, random_weights=True)
    with pytest.raises(ModelError, match="is not built"):
        _make("loftr")
    assert "loftr-random-weights" in RANDOM
    assert not set(RANDOM) & set(METHODS)
    with pytest.raises(ConfigError, match=r"random weights.*name loftr"):
        _make("loftr-random-weights")
    # What the daemon calls.
    with pytest.raises(ConfigError, match="'loftr-random-weights' is not known"):
        make_method("loftr-random-weights", working_px=640, max_keypoints=400, threads=1)
    named = make_method("loftr-random-weights", working_px=640, max_keypoints=400, threads=1, random_weights=True)
    assert named.name == "loftr-random-weights"


@pytest.mark.parametrize("change", ["graph", "data", "record", "unnamed"])
def test_damage_is_found(folder: Path, change: str) -> None:
    tiny_graphs.store("loftr", {"": tiny_graphs.pairs()}, folder)
    graph, record = folder / "loftr.onnx", folder / "loftr.json"
    if change == "graph":
        graph.write_bytes(graph.read_bytes() + b"\0")
    elif change == "data":
        entries = json.loads(record.read_text())
        entries["files"]["loftr.onnx.data"] = hashlib.sha256(b"whole").hexdigest()
        record.write_text(json.dumps(entries))
        (folder / "loftr.onnx.data").write_bytes(b"torn")
    elif change == "record":
        record.write_text("{}")
    else:
        record.write_text('{"files": {}, "accepted_non_commercial": true}')
    with pytest.raises(ModelError, match="build it again with `ortholoc-edge models build loftr"):
        _make("loftr")


def test_a_model_file_stands_for_none_of_them(folder: Path) -> None:
    with pytest.raises(ConfigError, match="taken from the store only"):
        make_matcher("loftr", working_px=640, max_keypoints=9, threads=1, model_path=Path("x.onnx"))


def test_list(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    tiny_graphs.store("loftr", {"": tiny_graphs.pairs()}, folder)
    tiny_graphs.store("xoftr", {"": tiny_graphs.pairs()}, folder, random_weights=True)
    tiny_graphs.store("dkm", {"": tiny_graphs.warp()}, folder)
    (folder / "dkm.onnx").write_bytes(b"")
    assert main(["models", "list", "--json"]) == 0
    states = {entry["name"]: entry for entry in json.loads(capsys.readouterr().out)}
    assert set(states) == {*models.CATALOGUE, *EXPORTED, "xoftr-random-weights"}
    assert states["loftr"]["state"] == "ready"
    assert states["loftr"]["bytes"] == (folder / "loftr.onnx").stat().st_size
    assert states["xoftr-random-weights"]["state"] == "random weights: for tests"
    assert states["xoftr"]["state"].startswith("needs weights_xoftr_640.ckpt from OnderT/XoFTR")
    assert states["dkm"]["state"].startswith("unusable: model dkm")
    assert [name for name, entry in states.items() if entry["non_commercial"]] == [
        "superpoint-superglue", "superpoint-lightglue", "gim-dkm", "dust3r", "mast3r",
    ]  # fmt: skip
    assert main(["models", "list"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 1 + len(states)
    mast3r = next(line for line in lines if line.startswith("mast3r"))
    assert "CC-BY-NC-SA-4.0, non-commercial" in mast3r
    assert "models build mast3r --weights MASt3R_ViTLarge" in mast3r


def test_build_without_torch_names_the_extra(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert main(["models", "build", "loftr", "--weights", "outdoor_ds.ckpt"]) != 0
    said = capsys.readouterr().err
    assert "torch" in said
    assert "ortholoc-edge[export]" in said


def test_options_of_the_others_are_refused_for_a_model_of_a_package(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["models", "build", "xfeat", "--random-weights"]) != 0
    assert "come in a package" in capsys.readouterr().err
    assert not folder.exists()


def test_a_view_of_the_map_is_drawn_at_the_graphs_size(folder: Path) -> None:
    """`cv2` resizes for the graph only where the picture has another size."""
    tiny_graphs.store("loftr", {"": tiny_graphs.pairs()}, folder)
    matcher = _make("loftr")
    picture = field(WIDTH, HEIGHT)
    features = matcher.extract(picture)
    assert isinstance(features, pairs.Picture)
    np.testing.assert_array_equal(features.views[0].image, picture)
    larger = matcher.extract(cv2.resize(picture, (2 * WIDTH, 2 * HEIGHT), interpolation=cv2.INTER_NEAREST))
    assert isinstance(larger, pairs.Picture)
    np.testing.assert_array_equal(larger.views[0].image, picture)
