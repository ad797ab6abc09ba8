"""`models build` for the matchers of `matching.exported`."""

from __future__ import annotations

import contextlib
import json
import shutil
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import onnx
import torch

from ortholoc_edge.errors import ConfigError
from ortholoc_edge.export import keypoints, pair_points, point_maps, require, warps
from ortholoc_edge.export.graphs import OPSET, TorchGraph, write_graph
from ortholoc_edge.export.order import Order, Size, check_order, checked, fetch
from ortholoc_edge.export.sources import project_code
from ortholoc_edge.export.weights import read_weights
from ortholoc_edge.matching.exported import (
    EXPORTED,
    ExportedMatcher,
    file_sha256,
    graph_file,
    load,
    record_path,
    stored_name,
)
from ortholoc_edge.matching.models import Progress, build_lock, model_directory, replace_file, storage_errors

_SEED: Final = 20240501
_TRAINING: Final = ("loguru", "joblib", "pytorch_lightning", "pytorch_lightning.utilities")

Weights = Mapping[str, Mapping[str, torch.Tensor]] | None


@dataclass(frozen=True, slots=True)
class _Recipe:
    """
    Attributes:
        make: (weights, size, fine size, small) to the graphs.
        multiples: that both sides of the sizes must be of, px.
        project: folder of the wheel with the networks' code; None: it is in an ordinary package.
        unused, moved: as of `sources.project_code`.
    """

    make: Callable[[Weights, Size, Size, bool], list[TorchGraph]]
    multiples: tuple[int, int] = (8, 8)
    project: str | None = None
    unused: tuple[str, ...] = ()
    moved: Mapping[str, str] = field(default_factory=dict)


_RECIPES: Final[dict[str, _Recipe]] = {
    "superpoint-superglue": _Recipe(
        lambda weights, _, __, small: keypoints.superpoint_superglue(weights, small),
        project="imatch-toolbox/third_party/superglue",
    ),
    "superpoint-lightglue": _Recipe(
        lambda weights, _, __, small: keypoints.superpoint_lightglue(weights, small), project="LightGlue"
    ),
    "dedode": _Recipe(lambda weights, size, _, small: keypoints.dedode(weights, size, small), (14, 14)),
    "loftr": _Recipe(lambda weights, size, _, small: pair_points.loftr(weights, size, small, minima=False)),
    "minima-loftr": _Recipe(lambda weights, size, _, small: pair_points.loftr(weights, size, small, minima=True)),
    "eloftr": _Recipe(
        lambda weights, size, _, small: pair_points.eloftr(weights, size, small),
        (32, 32), "EfficientLoFTR", _TRAINING, {"kornia.utils.grid": "kornia.geometry.grid"},
    ),
    "xoftr": _Recipe(
        lambda weights, size, _, small: pair_points.xoftr(weights, size, small), (8, 8), "XoFTR", _TRAINING
    ),
    "dkm": _Recipe(
        lambda weights, size, fine, _: warps.dkm(weights, size, fine, imagenet=True), (4, 32), "gim"
    ),
    "gim-dkm": _Recipe(
        lambda weights, size, fine, _: warps.dkm(weights, size, fine, imagenet=False), (4, 32), "gim"
    ),
    "roma": _Recipe(warps.roma, (14, 8), "RoMa"),
    "minima-roma": _Recipe(warps.roma, (14, 8), "RoMa"),
    "dust3r": _Recipe(lambda weights, size, _, small: point_maps.dust3r(weights, size, small), (16, 16), "duster"),
    "mast3r": _Recipe(lambda weights, size, _, small: point_maps.mast3r(weights, size, small), (16, 16), "mast3r"),
}  # fmt: skip


def build(name: str, order: Order, progress: Progress | None = None) -> dict[str, Any]:
    """Export a matcher, compare it with its published code, and put it into the store.

    Returns: its record.
    Raises: ModelError naming cause and remedy; ConfigError for an order that contradicts itself.
    """
    require(name)
    entry, recipe = EXPORTED[name], _RECIPES[name]
    size, fine_size = _sizes(entry, recipe, order)
    check_order(entry, order)

    def step(done: int, what: str) -> None:
        if progress is not None:
            progress(what, done, 3)

    with storage_errors(name), build_lock(name), contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix=f".{name}-", dir=model_directory())))
        step(0, "reading weights")
        used, weights = ([], None) if order.random_weights else _weights(entry, order)
        source = f"{'random weights, for tests; ' if order.random_weights else ''}{entry.note}; {entry.licence}"
        torch.manual_seed(_SEED)
        if recipe.project is not None:
            code = project_code(
                name, recipe.project, folder / "code", order.wheel, unused=recipe.unused, moved=recipe.moved
            )
            stack.enter_context(code)
        step(1, "making the network")
        graphs = recipe.make(weights, size, fine_size, order.small)
        stored = stored_name(name, random_weights=order.random_weights)
        files: dict[str, str] = {}
        differences: dict[str, dict[str, float]] = {}
        made = folder / "made"
        made.mkdir()
        for graph in graphs:
            file = graph_file(stored, graph.part)
            step(2, f"exporting {file} and comparing it with the published code")
            own = folder / f"graph-{graph.part}"
            own.mkdir()
            differences[graph.part or name] = write_graph(graph, own / file, source)
            for one in own.iterdir():
                files[one.name] = file_sha256(one)
                one.replace(made / one.name)
        record = {
            "name": name,
            "random_weights": order.random_weights,
            "small": order.small,
            "files": files,
            "weights": used,
            "licence": entry.licence,
            "accepted_non_commercial": order.accept_non_commercial,
            "note": entry.note,
            "input_contract": entry.contract,
            "size": None if entry.size is None else size,
            "fine_size": None if entry.fine_size is None else fine_size,
            "differences": differences,
            "exporter": f"torch {torch.__version__}, onnx {onnx.__version__}, opset {OPSET}, code of {entry.package}",
        }
        # Without its record a matcher is not built: none may speak for files that are being replaced.
        record_path(name, random_weights=order.random_weights).unlink(missing_ok=True)
        for file in files:
            shutil.move(made / file, model_directory() / file)
            (model_directory() / file).chmod(0o644)
        replace_file(
            record_path(name, random_weights=order.random_weights), (json.dumps(record, indent=2) + "\n").encode()
        )
        step(3, "done")
    load(name, random_weights=order.random_weights)
    return record


def _weights(entry: ExportedMatcher, order: Order) -> tuple[list[dict[str, Any]], dict[str, dict[str, torch.Tensor]]]:
    used, weights = [], {}
    for file in entry.files:
        path = order.weights.get(file.part) or fetch(file, model_directory() / "weights")
        sha256, known = checked(path, file, order.sha256.get(file.part))
        weights[file.part] = read_weights(path, file)
        used.append({"part": file.part, "file": path.name, "sha256": sha256, "compared": known})
    return used, weights


def _sizes(entry: ExportedMatcher, recipe: _Recipe, order: Order) -> tuple[Size, Size]:
    sizes = []
    for chosen, usual, multiple in zip(
        (order.size, order.fine_size), (entry.size, entry.fine_size), recipe.multiples, strict=True
    ):
        if chosen is not None and usual is None:
            raise ConfigError(f"matcher {entry.name} takes pictures of any size; leave {chosen} away")
        size = chosen or usual or (0, 0)
        if any(side % multiple for side in size):
            raise ConfigError(f"matcher {entry.name}: size {size[0]} x {size[1]} must be multiples of {multiple} px")
        sizes.append(size)
    return sizes[0], sizes[1]
