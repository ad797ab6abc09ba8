"""A torch module as an ONNX file, and the file's answers beside the published code's."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import onnx
import onnxruntime as ort
import torch

from ortholoc_edge.errors import ModelError
from ortholoc_edge.matching.exported import MOST_INLINE_BYTES

OPSET: Final = 18
# Of what a graph gives to what the published code gives, as a part of the greatest value.
# Rounding makes 1e-6 to 1e-4, by depth; a wrong rule for resizing or a forgotten normalisation 1e-2 and more.
TOLERANCE: Final = 1e-3
# Pairs of points: how many of the published code's must be there, how near (px), and how alike their confidences. Two
# candidates whose scores differ by less than rounding may swap.
MIN_SHARE: Final = 0.98
MAX_SHIFT_PX: Final = 0.05
MAX_CONFIDENCE_CHANGE: Final = 1e-3

Array = npt.NDArray[Any]
Comparison = Callable[[Sequence[Array], Sequence[Array]], dict[str, float]]


def value_differences(names: Sequence[str]) -> Comparison:
    """By output: the greatest difference, as a part of the greatest published value."""

    def compare(ours: Sequence[Array], published: Sequence[Array]) -> dict[str, float]:
        differences = {}
        for name, own, theirs in zip(names, ours, published, strict=True):
            if own.shape != theirs.shape:
                raise ModelError(f"output {name}: {own.shape}, the published code gives {theirs.shape}")
            scale = max(1e-6, float(np.abs(theirs).max(initial=0.0)))
            difference = float(np.abs(own.astype(np.float64) - theirs).max(initial=0.0)) / scale
            # A NaN compares as nothing: infinity does.
            differences[name] = difference if difference >= 0 else float("inf")
        return differences

    return compare


def pair_differences(ours: Sequence[Array], published: Sequence[Array]) -> dict[str, float]:
    """Of pairs of points and their confidences: the share of the published code's that ours lack."""
    theirs, their_confidence = np.concatenate(published[:2], axis=1).astype(np.float64), published[2]
    kept = ours[2] > (their_confidence.min() if len(their_confidence) else np.inf) * 0.99
    own, own_confidence = np.concatenate(ours[:2], axis=1).astype(np.float64)[kept], ours[2][kept]
    if len(theirs) == 0:
        raise ModelError("the published code finds no pair in the pictures of the comparison")
    found = 0
    for pair, confidence in zip(theirs, their_confidence, strict=True):
        near = np.abs(own - pair).max(axis=1) <= MAX_SHIFT_PX
        found += bool((near & (np.abs(own_confidence - confidence) <= MAX_CONFIDENCE_CHANGE)).any())
    return {"lacking": 1.0 - found / len(theirs)}


@dataclass(frozen=True, slots=True, eq=False)
class TorchGraph:
    """One graph to be, and how to prove it.

    Attributes:
        part: as in `exported.ExportedMatcher.graphs`.
        module: what is exported; or the graph itself, where we write it without torch.
        inputs: for the export and the comparison, by name.
        outputs: names.
        published: the published code's outputs for these inputs.
        compare: of the graph's with those.
        limits: greatest difference allowed, by name; others: `TOLERANCE`.
        varying: axes of inputs and outputs that may vary, by name and number.
    """

    part: str
    module: torch.nn.Module | bytes
    inputs: Mapping[str, torch.Tensor]
    outputs: tuple[str, ...]
    published: Callable[[], Sequence[Array]]
    compare: Comparison
    limits: Mapping[str, float] = field(default_factory=dict)
    varying: Mapping[str, Mapping[int, str]] = field(default_factory=dict)


def check_pictures(width: int, height: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Two grey pictures (1, 1, H, W) float32 in 0..1, the second moved by 8 and 16 px and with other contrast.

    Integer arithmetic only, so that every machine makes the same.
    """
    v, u = np.indices((height, width), dtype=np.int64)
    pictures = []
    for du, dv, gain, base in ((0, 0, 255, 0), (16, 8, 200, 30)):
        x, y = u + du, v + dv
        chirp = (x * x // 17 + y * y // 11 + x * y // 7) % 199
        blocks = (((x // 13) * 7919 + (y // 9) * 104729) % 61) * 2
        grey = (chirp + blocks) % 256 * gain // 255 + base
        pictures.append(torch.from_numpy(np.ascontiguousarray(grey[None, None] / 255.0).astype(np.float32)))
    return pictures[0], pictures[1]


def settle(model: torch.nn.Module, run: Callable[[], object]) -> None:
    """Gives the batch normalisations of random weights the statistics of one ``run``: without them features of all
    places are alike, and there is nothing to compare."""
    norms = [one for one in model.modules() if isinstance(one, torch.nn.modules.batchnorm._BatchNorm)]
    for norm in norms:
        norm.training, norm.momentum = True, 1.0
    with torch.no_grad():
        run()
    for norm in norms:
        norm.training = False


def write_graph(graph: TorchGraph, path: Path, source: str) -> dict[str, float]:
    """Export ``graph`` to ``path`` and compare.

    Args:
        source: written into the file, says where the weights are from.
    Returns: the differences to the published code, by output.
    Raises: ModelError if it can't be exported or run, or computes something else.
    """
    published = [np.asarray(values) for values in graph.published()]
    if isinstance(graph.module, bytes):
        path.write_bytes(graph.module)
    else:
        _export(graph, graph.module, path)
    _sealed(path, source)
    options = ort.SessionOptions()
    options.log_severity_level = 4
    session = ort.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    names = {entry.name for entry in session.get_inputs()}
    feeds = {name: value.numpy() for name, value in graph.inputs.items() if name in names}
    differences = graph.compare(session.run(list(graph.outputs), feeds), published)
    limits = {name: graph.limits.get(name, TOLERANCE) for name in differences}
    if not all(differences[name] <= limits[name] for name in differences):
        raise ModelError(
            f"the graph differs from the published code by {differences}, limits {limits}; the installed torch, onnx "
            "or onnxruntime computes wrongly, try the tested versions"
        )
    return differences


def _export(graph: TorchGraph, module: torch.nn.Module, path: Path) -> None:
    for name, symbolic in _MISSING.items():
        torch.onnx.register_custom_op_symbolic(name, symbolic, OPSET)
    try:
        with warnings.catch_warnings(), torch.no_grad():
            # What is traced depends on sizes that are fixed here; each such place warns.
            warnings.simplefilter("ignore")
            torch.onnx.export(
                # The exporter restores `training` from the outermost module.
                module.eval(),
                tuple(graph.inputs.values()),
                str(path),
                input_names=list(graph.inputs),
                output_names=list(graph.outputs),
                dynamic_axes={name: dict(axes) for name, axes in graph.varying.items()},
                opset_version=OPSET,
                dynamo=False,
            )
    except (RuntimeError, torch.onnx.errors.OnnxExporterError) as err:
        raise ModelError(f"torch {torch.__version__} can't export the network ({err}); try the tested version") from err
    finally:
        for name in _MISSING:
            torch.onnx.unregister_custom_op_symbolic(name, OPSET)


def _inverse(g: Any, value: Any) -> Any:
    # ONNX itself has no inverse; ONNX Runtime does.
    return g.op("com.microsoft::Inverse", value).setType(value.type())


def _expm1(g: Any, value: Any) -> Any:
    one = g.op("Constant", value_t=torch.tensor(1.0))
    return g.op("Sub", g.op("Exp", value), one)


# What the exporter lacks.
_MISSING: Final = {"aten::linalg_inv": _inverse, "aten::expm1": _expm1}


def _sealed(path: Path, source: str) -> None:
    """The file with its source, in one piece where protobuf allows it, else with one file of data beside it."""
    model = onnx.load(str(path))
    model.doc_string = source
    model.producer_name = "ortholoc-edge"
    for scattered in path.parent.iterdir():
        if scattered != path:
            scattered.unlink()
    large = sum(len(tensor.raw_data) for tensor in model.graph.initializer) > MOST_INLINE_BYTES
    onnx.save_model(
        model, str(path), save_as_external_data=large, location=f"{path.name}.data" if large else None,
        all_tensors_to_one_file=True,
    )  # fmt: skip
