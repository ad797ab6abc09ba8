"""Files of weights: read without running what is in them, and put into the network that they are of."""

from __future__ import annotations

import argparse
import json
import pickle
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="needs the extra 'export': `.ci/export` installs it")

from ortholoc_edge.cli import main  # noqa: E402
from ortholoc_edge.errors import ConfigError, ModelError  # noqa: E402
from ortholoc_edge.export import graphs, pair_points  # noqa: E402
from ortholoc_edge.export.build import Order, build  # noqa: E402
from ortholoc_edge.export.graphs import TorchGraph, pair_differences, value_differences, write_graph  # noqa: E402
from ortholoc_edge.export.weights import read_weights, take  # noqa: E402
from ortholoc_edge.matching import exported, models  # noqa: E402
from ortholoc_edge.matching.exported import EXPORTED, WeightsFile  # noqa: E402
from ortholoc_edge.matching.registry import make_matcher  # noqa: E402

FILE = WeightsFile("net", "net.pth", "someone/net")


@pytest.mark.parametrize("wrapper", [None, "state_dict", "model"])
def test_tensors_without_what_wraps_them(tmp_path: Path, wrapper: str | None) -> None:
    tensors = {"matcher.a.weight": torch.ones(2, dtype=torch.float16), "b": torch.zeros(1, dtype=torch.int64)}
    # As DUSt3R's checkpoints: the training's arguments beside the tensors.
    entries: Any = tensors if wrapper is None else {wrapper: tensors, "args": argparse.Namespace(model="x"), "epoch": 3}
    torch.save(entries, tmp_path / "net.pth")
    read = read_weights(tmp_path / "net.pth", FILE)
    assert set(read) == {"a.weight", "b"}
    assert read["a.weight"].dtype == torch.float32
    assert read["b"].dtype == torch.int64


def test_safetensors(tmp_path: Path) -> None:
    from safetensors.torch import save_file

    save_file({"model.a": torch.ones(3)}, tmp_path / "net.safetensors")
    assert read_weights(tmp_path / "net.safetensors", FILE)["a"].tolist() == [1, 1, 1]


class _Runs:
    def __reduce__(self) -> tuple[Any, ...]:
        return Path.touch, (Path("ran"),)


@pytest.mark.parametrize("content", ["pickle", "object", "garbage", "number", "nothing", "folder"])
def test_nothing_but_tensors_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, content: str) -> None:
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "net.pth"
    if content == "pickle":
        path.write_bytes(pickle.dumps({"a": _Runs()}))
    elif content == "object":
        torch.save({"a": _Runs()}, path)
    elif content == "garbage":
        path.write_bytes(b"\x80\x02garbage")
    elif content == "number":
        torch.save({"a": 1.0}, path)
    elif content == "nothing":
        torch.save({}, path)
    else:
        path.mkdir()
    with pytest.raises(ModelError, match=r"net\.pth"):
        read_weights(path, FILE)
    assert not Path("ran").exists()


def test_another_networks_file() -> None:
    network = torch.nn.Linear(2, 3)
    take(network, {"weight": torch.ones(3, 2), "bias": torch.ones(3), "more": torch.ones(1)}, "net")
    assert network.weight.sum() == 6
    with pytest.raises(ModelError, match="weights of net: 1 tensors are missing, 'bias' the first"):
        take(network, {"weight": torch.ones(3, 2)}, "net")
    take(network, {"weight": torch.ones(3, 2)}, "net", may_lack=("bias",))
    with pytest.raises(ModelError, match="size mismatch"):
        take(network, {"weight": torch.ones(2, 2), "bias": torch.ones(3)}, "net")


# -- comparison ----------------------------------------------------------------


def test_comparison_sees_differences() -> None:
    one = np.array([1.0, -4.0])
    assert value_differences(("x",))([one], [one + np.array([0.0, 0.004])])["x"] == pytest.approx(0.001, rel=0.01)
    assert value_differences(("x",))([one * np.nan], [one])["x"] == np.inf
    with pytest.raises(ModelError, match="the published code gives"):
        value_differences(("x",))([one], [one[:1]])
    pairs = [np.array([[1.0, 2.0], [3.0, 4.0]]), np.array([[5.0, 6.0], [7.0, 8.0]]), np.array([0.9, 0.8])]
    assert pair_differences([*pairs[:2], np.array([0.9, 0.8])], pairs) == {"lacking": 0.0}
    assert pair_differences([pairs[0] + 0.1, *pairs[1:]], pairs) == {"lacking": 1.0}
    assert pair_differences([*pairs[:2], np.array([0.9, 0.7])], pairs) == {"lacking": 0.5}
    with pytest.raises(ModelError, match="finds no pair"):
        pair_differences(pairs, [np.empty((0, 2)), np.empty((0, 2)), np.empty(0)])


@pytest.mark.filterwarnings("ignore")
def test_a_graph_that_computes_something_else_is_refused(tmp_path: Path) -> None:
    network = torch.nn.Linear(2, 2)
    feeds = {"x": torch.ones(1, 2)}

    def graph(factor: float) -> TorchGraph:
        return TorchGraph(
            "",
            network,
            feeds,
            ("y",),
            lambda: [network(feeds["x"]).detach().numpy() * factor],
            value_differences(("y",)),
        )

    assert write_graph(graph(1.0), tmp_path / "a.onnx", "test")["y"] < 1e-6
    with pytest.raises(ModelError, match="differs from the published code"):
        write_graph(graph(1.01), tmp_path / "b.onnx", "test")


@pytest.mark.filterwarnings("ignore")
def test_a_large_graph_goes_into_two_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(graphs, "MOST_INLINE_BYTES", 100)
    network = torch.nn.Linear(64, 64)
    feeds = {"x": torch.ones(1, 64)}
    graph = TorchGraph(
        "", network, feeds, ("y",), lambda: [network(feeds["x"]).detach().numpy()], value_differences(("y",))
    )
    write_graph(graph, tmp_path / "a.onnx", "test")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.onnx", "a.onnx.data"]


# -- a whole build from a file -------------------------------------------------


@pytest.fixture
def store(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    monkeypatch.setenv(models.STORE_VARIABLE, str(tmp_path))
    torch.set_num_threads(1)
    yield tmp_path / "models"


@pytest.mark.filterwarnings("ignore")
def test_build_from_a_file(store: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """LoFTR's published form, ``matcher.`` before each name under ``state_dict``, with weights of our own."""
    from kornia.feature import LoFTR

    torch.manual_seed(1)
    network = LoFTR(pretrained=None).eval()
    pair_points._unlike(network)
    weights = tmp_path / "outdoor_ds.ckpt"
    torch.save({"state_dict": {f"matcher.{name}": value for name, value in network.state_dict().items()}}, weights)
    size = ["--size", "192x128"]
    assert main(["models", "build", "loftr", "--weights", str(weights), *size]) == 0
    said = capsys.readouterr()
    record = json.loads(said.out)
    assert record["weights"][0]["sha256"] == exported.file_sha256(weights)
    assert record["weights"][0]["compared"] is False
    assert "no hash of it is known" in said.err
    assert exported.file_sha256(weights) in said.err
    assert record["size"] == [192, 128]
    assert not [path for path in store.iterdir() if path.is_dir()]
    make_matcher("loftr", working_px=640, max_keypoints=100, threads=1)
    assert main(["models", "build", "loftr", "--weights", str(weights), "--sha256", "0" * 64, *size]) != 0
    assert "that was given 000" in capsys.readouterr().err
    # What was built before is still there.
    make_matcher("loftr", working_px=640, max_keypoints=100, threads=1)


def test_a_pinned_hash_is_not_talked_away(store: Path, tmp_path: Path) -> None:
    path = tmp_path / "eloftr_outdoor.ckpt"
    torch.save({"a": torch.ones(1)}, path)
    own = exported.file_sha256(path)
    with pytest.raises(ModelError, match=f"SHA-256 is {own}, of eloftr_outdoor.ckpt"):
        build("eloftr", Order(weights={"eloftr": path}, sha256={"eloftr": own}))
    assert exported.read_record("eloftr") is None


@pytest.mark.parametrize(
    ("name", "size", "said"),
    [("eloftr", (640, 490), "multiples of 32"), ("superpoint-lightglue", (640, 480), "any size")],
)
def test_sizes_that_do_not_fit(store: Path, name: str, size: tuple[int, int], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        build(name, Order(random_weights=True, accept_non_commercial=EXPORTED[name].non_commercial, size=size))
