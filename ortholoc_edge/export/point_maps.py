"""DUSt3R and MASt3R as graphs of a fixed size that give each pixel of two pictures a vector and a confidence."""

from __future__ import annotations

from collections.abc import Mapping
from math import inf
from typing import Any, Final

import numpy as np
import torch
from torch import Tensor, nn

from ortholoc_edge.export.graphs import TorchGraph, check_pictures, value_differences
from ortholoc_edge.export.weights import take

OUTPUTS: Final = ("query_features", "query_confidence", "reference_features", "reference_confidence")

Weights = Mapping[str, Mapping[str, Tensor]] | None
Size = tuple[int, int]

# As the published checkpoints say; patches as their loader asks for pictures of one shape.
_DUST3R: Final[dict[str, Any]] = {
    "pos_embed": "RoPE100",
    "patch_embed_cls": "PatchEmbedDust3R",
    "head_type": "dpt",
    "output_mode": "pts3d",
    "depth_mode": ("exp", -inf, inf),
    "conf_mode": ("exp", 1, inf),
    "enc_embed_dim": 1024,
    "enc_depth": 24,
    "enc_num_heads": 16,
    "dec_embed_dim": 768,
    "dec_depth": 12,
    "dec_num_heads": 12,
    "landscape_only": False,
}
_MAST3R: Final[dict[str, Any]] = _DUST3R | {
    "head_type": "catmlp+dpt",
    "output_mode": "pts3d+desc24",
    "two_confs": True,
    "desc_conf_mode": ("exp", 0, inf),
}
# Of CroCo, the network's ancestor; only its training used it.
_UNUSED: Final = ("mask_token",)
_PATCH_PX: Final = 16
# The head takes decoders of ten layers or more.
_SMALL: Final = {"enc_embed_dim": 64, "enc_depth": 2, "enc_num_heads": 4, "dec_embed_dim": 64, "dec_num_heads": 4}


class _PointMaps(nn.Module):
    """
    Args:
        keys: of the vectors and of the confidence in each head's answer.
    """

    def __init__(self, model: Any, keys: tuple[str, str]) -> None:
        super().__init__()
        self.model = model
        self.keys = keys

    def forward(self, query: Tensor, reference: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        model = self.model
        shape = int(query.shape[2]), int(query.shape[3])
        pictures = [grey.expand(-1, 3, -1, -1) * 2.0 - 1.0 for grey in (query, reference)]
        sizes = torch.tensor([shape])
        seen = [model._encode_image(picture, sizes)[:2] for picture in pictures]
        (first, first_places), (second, second_places) = seen
        decoded = model._decoder(first, first_places, second, second_places)
        answers: list[Tensor] = []
        for head, tokens in zip((model.downstream_head1, model.downstream_head2), decoded, strict=True):
            answer = head(list(tokens), shape)
            answers += [answer[key][0] for key in self.keys]
        return answers[0], answers[1], answers[2], answers[3]


def _graph(model: Any, size: Size, keys: tuple[str, str]) -> list[TorchGraph]:
    query, reference = check_pictures(*size)
    rows, columns = size[1] // _PATCH_PX, size[0] // _PATCH_PX
    places = torch.from_numpy(np.indices((rows, columns)).reshape(2, rows * columns).T[None].copy())
    # As a constant: ONNX has no product of sets.
    model.patch_embed.position_getter = lambda batch, *_: places.expand(batch, -1, -1).clone()

    def published() -> list[Any]:
        sizes = torch.tensor([[size[1], size[0]]])
        views = [
            {"img": grey.expand(-1, 3, -1, -1) * 2.0 - 1.0, "true_shape": sizes, "instance": [str(number)]}
            for number, grey in enumerate((query, reference))
        ]
        with torch.no_grad():
            answers = model(*views)
        outputs = []
        for answer in answers:
            for key in keys:
                name = "pts3d_in_other_view" if key == "pts3d" and key not in answer else key
                outputs.append(np.asarray(answer[name][0]))
        return outputs

    return [
        TorchGraph(
            part="",
            module=_PointMaps(model, keys),
            inputs={"query": query, "reference": reference},
            outputs=OUTPUTS,
            published=published,
            compare=value_differences(OUTPUTS),
        )
    ]


def _settings(known: Mapping[str, Any], size: Size, small: bool) -> dict[str, Any]:
    side = max(size)
    return {**known, **(_SMALL if small else {}), "img_size": (side, side)}


def dust3r(weights: Weights, size: Size, small: bool) -> list[TorchGraph]:
    """Args:
    weights: the file's tensors by part; None: random ones.
    size: (width, height) px, multiples of 16.
    small: a network of the same kind with fewer layers and channels.
    """
    from dust3r.model import AsymmetricCroCo3DStereo

    model = AsymmetricCroCo3DStereo(**_settings(_DUST3R, size, small)).eval()
    if weights is not None:
        take(model, weights["dust3r"], "dust3r", _UNUSED)
    return _graph(model, size, ("pts3d", "conf"))


def mast3r(weights: Weights, size: Size, small: bool) -> list[TorchGraph]:
    """Args as of `dust3r`."""
    from mast3r.model import AsymmetricMASt3R

    model = AsymmetricMASt3R(**_settings(_MAST3R, size, small)).eval()
    if weights is not None:
        take(model, weights["mast3r"], "mast3r", _UNUSED)
    return _graph(model, size, ("desc", "desc_conf"))
