"""Graphs whose right answer is known, put into a store as `models build` would: no network, no torch."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from onnx import TensorProto, helper, numpy_helper

from ortholoc_edge.matching import exported

WIDTH, HEIGHT = 160, 128
FINE = 320, 256
SHIFT_PX = 3


def graph(
    inputs: Mapping[str, Sequence[Any]], outputs: Mapping[str, np.ndarray | str], nodes: Sequence[Any] = ()
) -> bytes:
    """Of constant outputs, and of those whose value is the name of a node's output."""
    made = list(nodes)
    constants = []
    for name, value in outputs.items():
        if isinstance(value, str):
            made.append(helper.make_node("Identity", [value], [name]))
        else:
            constants.append(numpy_helper.from_array(value.astype(np.float32), f"{name}.value"))
            made.append(helper.make_node("Identity", [f"{name}.value"], [name]))
    described = [helper.make_tensor_value_info(name, TensorProto.FLOAT, list(shape)) for name, shape in inputs.items()]
    found = [helper.make_tensor_value_info(name, TensorProto.FLOAT, None) for name in outputs]
    whole = helper.make_graph(made, "tiny", described, found, constants)
    model = helper.make_model(whole, ir_version=10, opset_imports=[helper.make_opsetid("", 20)])
    return bytes(model.SerializeToString())


def picture(width: int = WIDTH, height: int = HEIGHT) -> tuple[int, int, int, int]:
    return 1, 1, height, width


def store(
    name: str, graphs: Mapping[str, bytes], folder: Path, *, random_weights: bool = False, accepted: bool = True
) -> None:
    """Graphs by part, and their record, in ``folder``, which `models.model_directory` must name."""
    folder.mkdir(parents=True, exist_ok=True)
    stored = exported.stored_name(name, random_weights=random_weights)
    files = {}
    for part, data in graphs.items():
        path = folder / exported.graph_file(stored, part)
        path.write_bytes(data)
        files[path.name] = exported.file_sha256(path)
    record = {"name": name, "files": files, "accepted_non_commercial": accepted}
    (folder / f"{stored}.json").write_text(json.dumps(record))


def pairs() -> bytes:
    """Pairs on a lattice of 16 px, the reference's moved by `SHIFT_PX` to the right; confidences fall from 1 to 0."""
    v, u = np.mgrid[8:HEIGHT:16, 8:WIDTH:16]
    query = np.stack([u.ravel(), v.ravel()], axis=1) + 0.25
    confidence = np.linspace(1.0, 0.0, len(query))
    outputs = {"query_px": query, "reference_px": query + np.array([SHIFT_PX, 0]), "confidence": confidence}
    return graph({"query": picture(), "reference": picture()}, outputs)


def warp() -> bytes:
    """All of the query moved by `SHIFT_PX` of the fine view; certain where that is inside, but for the lower half: that
    is less than the published limit."""
    width, height = FINE
    u, v = np.meshgrid(np.arange(width), np.arange(height))

    def places(shift: int) -> np.ndarray:
        return np.stack([(u + shift + 0.5) * 2 / width - 1, (v + 0.5) * 2 / height - 1], axis=-1)

    both = np.stack([places(SHIFT_PX), places(-SHIFT_PX)])
    certainty = (np.abs(both) <= 1).all(axis=-1) * np.where(v < height // 2, 0.06, 0.04)
    inputs = {
        "query": picture(),
        "reference": picture(),
        "query_fine": picture(*FINE),
        "reference_fine": picture(*FINE),
    }
    return graph(inputs, {"warp": both, "certainty": certainty})


def points(confidence: float = 4.0) -> bytes:
    """Each pixel's vector is its place in the scene, of which the reference shows what lies `SHIFT_PX` further left."""
    u, v = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    own = np.stack([u, v, np.ones_like(u)], axis=-1)
    outputs = {
        "query_features": own,
        "query_confidence": np.full(u.shape, confidence),
        "reference_features": own - [SHIFT_PX, 0, 0],
        "reference_confidence": np.full(u.shape, confidence),
    }
    return graph({"query": picture(), "reference": picture()}, outputs)


def superpoint() -> bytes:
    """Heat is the picture itself; every place has the same descriptor."""

    def constant(name: str, values: np.ndarray) -> Any:
        return helper.make_node("Constant", [], [name], value=numpy_helper.from_array(values.astype(np.float32)))

    nodes = [
        constant("nothing", np.zeros((1, 1, 1, 1))),
        constant("channels", np.linspace(0.1, 1.0, 256).reshape(1, 256, 1, 1)),
        helper.make_node("AveragePool", ["picture"], ["cells"], kernel_shape=[8, 8], strides=[8, 8]),
        helper.make_node("Mul", ["cells", "nothing"], ["flat"]),
        helper.make_node("Add", ["flat", "channels"], ["dense"]),
    ]
    return graph({"picture": (1, 1, "H", "W")}, {"heat": "picture", "descriptors": "dense"}, nodes)
