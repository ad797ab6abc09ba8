"""DKM (also GIM's) and RoMa as graphs of fixed sizes that give both pictures' warps and how certain they are.

The two looks at the pictures, coarse and fine, in both directions, are the published `match` without its choice of
samples (`matching.pairs.WarpMatcher`).
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
import torch.nn.functional as nnf
from torch import Tensor, nn

from ortholoc_edge.export.graphs import TorchGraph, check_pictures, settle, value_differences
from ortholoc_edge.export.sources import without_loading
from ortholoc_edge.export.vit import pin_places, shallow
from ortholoc_edge.export.weights import take

OUTPUTS: Final = ("warp", "certainty")
# Rounding grows, since each refinement samples where the last one pointed: with random weights a millionth more light
# moves the published DKM's own warp by 7e-4 and its certainty by 4e-2. A warp is -1..1: 1e-3 are a quarter of a pixel
# in 512.
_LIMITS: Final = {"warp": 2e-3, "certainty": 2e-2}
_PATCH_PX: Final = 14
_SMALL_LAYERS: Final = 2

Weights = Mapping[str, Mapping[str, Tensor]] | None
Size = tuple[int, int]


def _coloured(grey: Tensor, *, imagenet: bool) -> Tensor:
    """The three channels that the networks were trained on, of a grey picture in 0..1."""
    colour = grey.expand(-1, 3, -1, -1)
    if not imagenet:
        return colour
    mean, spread = (torch.tensor(values).view(1, 3, 1, 1) for values in ((0.485, 0.456, 0.406), (0.229, 0.224, 0.225)))
    return (colour - mean) / spread


class _Warp(nn.Module):
    """
    Args:
        model: the published matcher.
        look: (model, pictures, corresponding, scale factor) to the corresponding things by scale; corresponding None:
            the first look.
        names: of flow and certainty in those.
    """

    def __init__(
        self, model: Any, look: Callable[..., Any], names: tuple[str, str], *, imagenet: bool, attenuate: bool
    ) -> None:
        super().__init__()
        self.model = model
        self.look = look
        self.names = names
        self.imagenet = imagenet
        self.attenuate = attenuate

    def forward(
        self, query: Tensor, reference: Tensor, query_fine: Tensor, reference_fine: Tensor
    ) -> tuple[Tensor, Tensor]:
        flow_name, certainty_name = self.names
        first, second, first_fine, second_fine = (
            _coloured(grey, imagenet=self.imagenet) for grey in (query, reference, query_fine, reference_fine)
        )
        coarse = self.look(self.model, first, second, None, 1.0)
        rows, columns = int(query_fine.shape[2]), int(query_fine.shape[3])
        scale = (rows * columns / (int(query.shape[2]) * int(query.shape[3]))) ** 0.5
        fine = self.look(self.model, first_fine, second_fine, coarse[1], scale)
        certainty = fine[1][certainty_name]
        if self.attenuate:
            low = nnf.interpolate(coarse[16][certainty_name], (rows, columns), mode="bilinear", align_corners=False)
            certainty = certainty - 0.5 * low * (low < 0)
        flow = fine[1][flow_name].permute(0, 2, 3, 1)
        outside = (flow.abs() > 1).any(dim=3)
        certainty = torch.where(outside, torch.zeros_like(certainty[:, 0]), certainty[:, 0].sigmoid())
        return flow.clamp(-1, 1), certainty


def _graph(module: _Warp, size: Size, fine_size: Size, published: Callable[[], tuple[Any, Any]],
           pictures: Sequence[Tensor]) -> TorchGraph:  # fmt: skip
    def outputs() -> list[Any]:
        with torch.no_grad():
            warp, certainty = published()
        # Side by side: of the query its own places and those in the reference, of the reference the other way round.
        half = warp.shape[1] // 2
        both = torch.stack([warp[:, :half, 2:], warp[:, half:, :2]])
        return [np.asarray(both), np.asarray(torch.stack([certainty[:, :half], certainty[:, half:]]))]

    names = ("query", "reference", "query_fine", "reference_fine")
    return TorchGraph(
        part="",
        module=module,
        inputs=dict(zip(names, pictures, strict=True)),
        outputs=OUTPUTS,
        published=outputs,
        compare=value_differences(OUTPUTS),
        limits=_LIMITS,
    )


def _dkm_look(model: Any, query: Tensor, reference: Tensor, known: Any, _: float) -> Any:
    batch = {"query": query, "support": reference}
    if known is not None:
        batch["corresps"] = known
    return model.forward_symmetric(batch, upsample=known is not None, batched=True)


def dkm(weights: Weights, size: Size, fine_size: Size, *, imagenet: bool) -> list[TorchGraph]:
    """Args:
    weights: the file's tensors by part; None: random ones.
    size, fine_size: (width, height) px of the two looks.
    imagenet: whether pictures are normalised as DKM's authors do; GIM's do not.
    """
    from dkm.models.model_zoo.DKMv3 import DKMv3

    model = DKMv3(None, size[1], size[0], upsample_preds=True).eval()
    model.upsample_res = (fine_size[1], fine_size[0])
    fine = check_pictures(*fine_size)
    coarse = [nnf.interpolate(grey, (size[1], size[0]), mode="bilinear", align_corners=False) for grey in fine]
    if weights is None:
        seen = [_coloured(grey, imagenet=imagenet) for grey in coarse]
        settle(model, lambda: _dkm_look(model, seen[0], seen[1], None, 1.0))
    else:
        take(model, weights["dkm"], "dkm")

    def published() -> tuple[Any, Any]:
        found = model.match(*(_coloured(grey, imagenet=imagenet) for grey in fine), device="cpu")
        return found[0], found[1]

    names = ("dense_flow", "dense_certainty")
    module = _Warp(model, _dkm_look, names, imagenet=imagenet, attenuate=True)
    return [_graph(module, size, fine_size, published, [*coarse, *fine])]


def _roma_look(model: Any, query: Tensor, reference: Tensor, known: Any, scale: float) -> Any:
    batch = {"im_A": query, "im_B": reference}
    if known is not None:
        batch["corresps"] = known
    return model.forward_symmetric(batch, upsample=known is not None, batched=True, scale_factor=scale)


def roma(weights: Weights, size: Size, fine_size: Size, small: bool) -> list[TorchGraph]:
    """Args as of `dkm`; ``small``: with fewer layers of the transformer."""
    import romatch.models.matcher as matcher_module
    from romatch.models.model_zoo import roma_models
    from romatch.models.transformer import dinov2
    from romatch.utils import get_tuple_transform_ops

    resolution = (size[1], size[0])
    with without_loading(), shallow(dinov2, _SMALL_LAYERS if small else None):
        model = roma_models.roma_model(
            resolution=resolution, upsample_preds=True, device="cpu", weights={}, dinov2_weights={},
            amp_dtype=torch.float32,
        )  # fmt: skip
    model.upsample_res = (fine_size[1], fine_size[0])
    if small:
        layers = model.decoder.embedding_decoder
        layers.blocks = layers.blocks[:1]
    vit = model.encoder.dinov2_vitl14[0].eval()
    with tempfile.TemporaryDirectory(prefix="ortholoc-edge-") as folder:
        paths, pictures = [], []
        for number, grey in enumerate(check_pictures(*fine_size)):
            paths.append(str(Path(folder) / f"{number}.png"))
            _save_grey(grey, paths[-1])
        for width, height in (size, fine_size):
            even = get_tuple_transform_ops(resize=(height, width), normalize=False)
            pictures += [picture[None, :1].clone() for picture in even(tuple(_open_rgb(path) for path in paths))]
        if weights is None:
            coloured = [_coloured(grey, imagenet=True) for grey in pictures]
            settle(model, lambda: _roma_look(model, coloured[0], coloured[1], None, 1.0))
        else:
            take(vit, weights["dinov2"], "dinov2")
            take(model, weights["roma"], "roma")
        with torch.no_grad():
            warp, certainty = model.match(*paths, device="cpu")
    matcher_module.local_correlation = _local_correlation
    matcher_module.cls_to_flow_refine = _flow_of_classes
    pin_places(vit, size[1] // _PATCH_PX, size[0] // _PATCH_PX, _PATCH_PX)
    # The transformer is hidden from `parameters` in a list.
    module = _Warp(model, _roma_look, ("flow", "certainty"), imagenet=True, attenuate=True)
    return [_graph(module, size, fine_size, lambda: (warp, certainty), pictures)]


def _flow_of_classes(classes: Tensor) -> Tensor:
    """The published `cls_to_flow_refine`, its grid a constant: the exporter makes it of another type."""
    count = int(classes.shape[1])
    side = math.isqrt(count)
    steps = np.linspace(-1.0 + 1.0 / side, 1.0 - 1.0 / side, side)
    grid = torch.from_numpy(np.stack(np.meshgrid(steps, steps), axis=-1).reshape(count, 2).astype(np.float32))
    share = classes.softmax(dim=1)
    best = share.argmax(dim=1)
    around = torch.stack([best - 1, best, best + 1, best - side, best + side], dim=1).clamp(0, count - 1)
    weights = share.gather(1, around)[..., None]
    return (weights * grid[around]).sum(dim=1) / weights.sum(dim=1)


def _local_correlation(
    feature0: Tensor, feature1: Tensor, local_radius: int, padding_mode: str = "zeros", flow: Tensor | None = None,
    sample_mode: str = "bilinear",
) -> Tensor:  # fmt: skip
    """The published one without writing into a tensor, which the exporter loses."""
    assert flow is not None, "RoMa always gives a flow"
    batch, width, rows, columns = (int(side) for side in feature0.shape)
    side = 2 * local_radius + 1
    steps = np.linspace(-2.0 * local_radius, 2.0 * local_radius, side)
    window = np.stack(np.meshgrid(steps / columns, steps / rows), axis=-1).reshape(1, 1, 1, side * side, 2)
    places = flow.permute(0, 2, 3, 1)[:, :, :, None] + torch.from_numpy(window.astype(np.float32))
    seen = nnf.grid_sample(
        feature1, places.reshape(batch, rows, columns * side * side, 2), padding_mode=padding_mode,
        align_corners=False, mode=sample_mode,
    )  # fmt: skip
    seen = seen.reshape(batch, width, rows, columns, side * side)
    return (feature0[..., None] / width**0.5 * seen).sum(dim=1).permute(0, 3, 1, 2)


def _save_grey(grey: Tensor, path: str) -> None:
    import cv2

    cv2.imwrite(path, np.rint(np.asarray(grey[0, 0]) * 255.0).astype(np.uint8))


def _open_rgb(path: str) -> Any:
    from PIL import Image

    return Image.open(path).convert("RGB")
