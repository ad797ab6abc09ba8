"""LoFTR, MINIMA-LoFTR, Efficient LoFTR and XoFTR as graphs of a fixed size that give a fixed number of pairs.

The published code keeps as many coarse matches as pass; a graph of fixed shapes takes the ``MOST_MATCHES`` best and
gives those that do not pass the confidence 0. What follows is the published modules' own.

Coordinates: all four are trained with the pixel's centre at half (COLMAP's), so half a pixel comes off for ours.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Mapping
from typing import Any, Final

import numpy as np
import torch
from torch import Tensor, nn

from ortholoc_edge.export.graphs import MIN_SHARE, TorchGraph, check_pictures, pair_differences, settle
from ortholoc_edge.export.weights import take

MOST_MATCHES: Final = 2048
OUTPUTS: Final = ("query_px", "reference_px", "confidence")
_HALF_PX: Final = 0.5
_CELL_PX: Final = 8
# Of features of random weights.
_SHARPENING: Final = 4.0

Weights = Mapping[str, Mapping[str, Tensor]] | None
Size = tuple[int, int]


def _inside(rows: int, columns: int, border: int) -> Tensor:
    mask = torch.zeros(rows, columns, dtype=torch.bool)
    mask[border:-border, border:-border] = True
    return mask.flatten()


def mutual_pairs(share: Tensor, rows: int, columns: int, border: int) -> tuple[Tensor, Tensor, Tensor]:
    """Cells that are each other's likeliest in ``share`` (L, L), off the border, best first: score, both indices."""
    best, partner = share.max(dim=1)
    inside = _inside(rows, columns, border)
    passes = (share.max(dim=0).values[partner] == best) & inside & inside[partner]
    score, cell = torch.topk(torch.where(passes, best, torch.zeros_like(best)), min(MOST_MATCHES, rows * columns))
    return score, cell, partner[cell]


def either_pairs(
    similarity: Tensor, rows: int, columns: int, border: int, threshold: float
) -> tuple[Tensor, Tensor, Tensor]:
    """As `mutual_pairs`, but cells that are the other's likeliest in one direction, by more than ``threshold``."""
    by_row, by_column = similarity.softmax(1), similarity.softmax(0)
    row_best, row_partner = by_row.max(dim=1)
    column_best, column_partner = by_column.max(dim=0)
    inside = _inside(rows, columns, border)
    number = torch.arange(rows * columns)
    row_passes = (row_best > threshold) & inside & inside[row_partner]
    # What both directions find counts once.
    again = (row_partner[column_partner] == number) & row_passes[column_partner]
    column_passes = (column_best > threshold) & inside & inside[column_partner] & ~again
    zero = torch.zeros_like(row_best)
    scores = torch.cat([torch.where(row_passes, row_best, zero), torch.where(column_passes, column_best, zero)])
    queries, references = torch.cat([number, column_partner]), torch.cat([row_partner, number])
    score, chosen = torch.topk(scores, min(MOST_MATCHES, 2 * rows * columns))
    return score, queries[chosen], references[chosen]


def _size(picture: Tensor) -> tuple[int, int]:
    """Rows and columns as numbers: the exporter's own are tensors."""
    return int(picture.shape[2]), int(picture.shape[3])


def _cells_px(cells: Tensor, columns: int, step: int) -> Tensor:
    return torch.stack([cells % columns, torch.div(cells, columns, rounding_mode="floor")], dim=1).float() * step


class _Loftr(nn.Module):
    def __init__(self, model: Any) -> None:
        super().__init__()
        self.model = model

    def forward(self, query: Tensor, reference: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        model = self.model
        both = model.extract_features(torch.cat([query, reference]))
        coarse, fine = both["coarse"], both["fine"]
        rows, columns = _size(coarse)
        coarse = coarse.flatten(2).transpose(1, 2)
        first, second = model.loftr_coarse(coarse[:1], coarse[1:], None, None)
        width = first.shape[-1]
        similarity = (first[0] / width**0.5) @ (second[0] / width**0.5).T / model.coarse_matching.temperature
        share = similarity.softmax(0) * similarity.softmax(1)
        score, i, j = mutual_pairs(share, rows, columns, model.coarse_matching.border_rm)
        stride, fine_stride = model.config["resolution"]
        data: dict[str, Any] = {
            "b_ids": torch.zeros_like(i), "i_ids": i, "j_ids": j, "mconf": score,
            "stride_c": stride, "stride_f": fine_stride,
            "mkpts0_c": _cells_px(i, columns, stride), "mkpts1_c": _cells_px(j, columns, stride),
        }  # fmt: skip
        windows = model.fine_preprocess(fine[:1], fine[1:], first, second, data)
        model.fine_matching(*model.loftr_fine(*windows), data)
        return data["mkpts0_f"] - _HALF_PX, data["mkpts1_f"] - _HALF_PX, score


def loftr(weights: Weights, size: Size, small: bool, *, minima: bool) -> list[TorchGraph]:
    """Args:
    weights: the file's tensors by part; None: random ones.
    size: (width, height) px.
    small: a network of the same kind with fewer layers.
    minima: whether it is MINIMA's, trained with the corrected position encoding.
    """
    from kornia.feature.loftr.loftr import LoFTR, default_cfg

    config = copy.deepcopy(default_cfg)
    config["coarse"]["temp_bug_fix"] = minima
    if small:
        config["coarse"]["layer_names"] = ["self", "cross"]
    model = LoFTR(pretrained=None, config=config).eval()
    if weights is None:
        _unlike(model)
        model.coarse_matching.thr = 0.0
    else:
        take(model, weights["loftr"], "loftr")

    def published(query: Tensor, reference: Tensor) -> list[Any]:
        found = model({"image0": query, "image1": reference})
        return [found["keypoints0"], found["keypoints1"], found["confidence"]]

    return [_graph(_Loftr(model), size, published, MOST_MATCHES)]


def _unlike(model: Any) -> None:
    """Makes features of random weights unlike enough for matches to be found."""
    settle(model.backbone, lambda: model.backbone(torch.cat(check_pictures(160, 128))))
    with torch.no_grad():
        model.loftr_coarse.layers[-1].norm2.weight.mul_(_SHARPENING)


def _graph(module: nn.Module, size: Size, published: Callable[[Tensor, Tensor], list[Any]], most: int) -> TorchGraph:
    query, reference = check_pictures(*size)

    def outputs() -> list[Any]:
        with torch.no_grad():
            query_px, reference_px, confidence = (
                np.asarray(values.float()) for values in published(query.clone(), reference.clone())
            )
        order = np.argsort(-confidence, kind="stable")[:most]
        return [query_px[order] - _HALF_PX, reference_px[order] - _HALF_PX, confidence[order]]

    return TorchGraph(
        part="",
        module=module,
        inputs={"query": query, "reference": reference},
        outputs=OUTPUTS,
        published=outputs,
        compare=pair_differences,
        limits={"lacking": 1.0 - MIN_SHARE},
    )


class _Eloftr(nn.Module):
    def __init__(self, model: Any) -> None:
        super().__init__()
        self.model = model

    def forward(self, query: Tensor, reference: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        model = self.model
        seen = model.backbone(torch.cat([query, reference]))
        coarse = seen["feats_c"]
        rows, columns = _size(coarse)
        first, second = model.loftr_coarse(coarse[:1], coarse[1:], None, None)
        first, second = first.flatten(2).transpose(1, 2), second.flatten(2).transpose(1, 2)
        root = first.shape[-1] ** 0.5
        similarity = (first[0] / root) @ (second[0] / root).T / model.coarse_matching.temperature
        share = similarity.softmax(0) * similarity.softmax(1)
        score, i, j = mutual_pairs(share, rows, columns, model.coarse_matching.border_rm)
        whole, cells = _size(query), (rows, columns)
        data: dict[str, Any] = {
            "bs": 1, "b_ids": torch.zeros_like(i), "i_ids": i, "j_ids": j, "mconf": score,
            "hw0_i": whole, "hw1_i": whole, "hw0_c": cells, "hw1_c": cells, "hw0_f": whole, "hw1_f": whole,
            "feats_x2": seen["feats_x2"], "feats_x1": seen["feats_x1"],
            "mkpts0_c": _cells_px(i, columns, _CELL_PX), "mkpts1_c": _cells_px(j, columns, _CELL_PX),
        }  # fmt: skip
        shifts = self._fine(*model.fine_preprocess(first / root, second / root, data))
        points = [
            _cells_px(cell, columns, _CELL_PX) + shift - _HALF_PX for cell, shift in zip((i, j), shifts, strict=True)
        ]
        return points[0], points[1], score

    def _fine(self, query: Tensor, reference: Tensor) -> tuple[Tensor, Tensor]:
        """The published `FineMatching`: the best pair of two windows, then its second half to parts of a pixel among
        3 x 3. Written out, because that looks those up by indices of which some are -1, which mean the last row and
        column to torch and nothing to ONNX."""
        fine = self.model.fine_matching
        part, width = fine.local_regress_slicedim, query.shape[-1]
        side = math.isqrt(int(query.shape[1]))
        ring = side + 2
        similarity = (query[..., :-part] / width**0.5) @ (reference[..., :-part] / width**0.5).transpose(1, 2)
        share = similarity.softmax(1) * similarity.softmax(2)
        share = share.unflatten(2, (ring, ring))[..., 1:-1, 1:-1].flatten(1)
        best = share.argmax(dim=1)
        left, right = torch.div(best, side * side, rounding_mode="floor"), best % (side * side)
        finer = (query[..., -part:] @ (reference[..., -part:] / part**0.5).transpose(1, 2)).flatten(1)
        steps = torch.from_numpy(np.array([-1, 0, 1]))
        down = (torch.div(right, side, rounding_mode="floor")[:, None] + steps) % ring
        across = (right[:, None] % side + steps) % ring
        places = left[:, None, None] * ring * ring + down[:, :, None] * ring + across[:, None, :]
        heat = (finer.gather(1, places.flatten(1)) / fine.local_regress_temperature).softmax(1).unflatten(1, (3, 3))
        weights = steps.float()
        shift = torch.stack([(heat.sum(1) * weights).sum(1), (heat.sum(2) * weights).sum(1)], dim=1)
        middle = side // 2 - 0.5
        return _cells_px(left, side, 1) - middle, _cells_px(right, side, 1) - middle + shift


def eloftr(weights: Weights, size: Size, small: bool) -> list[TorchGraph]:
    """The full model, its branches merged as its authors do. Args as of `loftr`; its code must be importable."""
    from src.loftr import LoFTR, full_default_cfg, reparameter

    config = copy.deepcopy(full_default_cfg)
    # Traced attention must be spelt out: the fused one is the same function.
    config["coarse"]["no_flash"] = True
    config["coarse"]["npe"] = [832, 832, max(832, *size), max(832, *size)]
    if small:
        config["coarse"]["layer_names"] = ["self", "cross"]
    model = LoFTR(config=config).eval()
    if weights is None:
        _unlike(model)
        model.coarse_matching.thr = 0.0
    else:
        take(model, weights["eloftr"], "eloftr")
    model = reparameter(model).eval()

    def published(query: Tensor, reference: Tensor) -> list[Any]:
        data = {"image0": query, "image1": reference}
        model(data)
        return [data["mkpts0_f"], data["mkpts1_f"], data["mconf"]]

    return [_graph(_Eloftr(model), size, published, MOST_MATCHES)]


class _Xoftr(nn.Module):
    def __init__(self, model: Any) -> None:
        super().__init__()
        self.model = model

    def forward(self, query: Tensor, reference: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        model = self.model
        even = [
            (picture - picture.mean(dim=(2, 3), keepdim=True)) / (_spread(picture) + 1e-6)
            for picture in (query, reference)
        ]
        coarse, middle, fine = model.backbone(torch.cat(even))
        rows, columns = _size(coarse)
        placed = model.pos_encoding(coarse).flatten(2).transpose(1, 2)
        first, second = model.loftr_coarse(placed[:1], placed[1:], None, None)
        matching = model.coarse_matching
        root = first.shape[-1] ** 0.5
        similarity = (matching.final_proj(first)[0] / root) @ (matching.final_proj(second)[0] / root).T
        similarity = similarity / matching.temperature
        score, i, j = either_pairs(similarity, rows, columns, matching.border_rm, matching.thr)
        whole, cells = _size(query), (rows, columns)
        data: dict[str, Any] = {
            "bs": 1, "b_ids": torch.zeros_like(i), "i_ids": i, "j_ids": j,
            "hw0_i": whole, "hw1_i": whole, "hw0_c": cells, "hw1_c": cells,
            "hw0_m": _size(middle), "hw1_m": _size(middle), "hw0_f": _size(fine), "hw1_f": _size(fine),
        }  # fmt: skip
        own, other = model.fine_process(
            fine[:1], fine[1:], middle[:1], middle[1:], first, second, coarse[:1], coarse[1:], data
        )
        return self._fine(own, other, i, j, columns, whole[0] // _size(fine)[0], score > 0)

    def _fine(
        self, query: Tensor, reference: Tensor, i: Tensor, j: Tensor, columns: int, step: int, passes: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """The published `FineSubMatching` for one best pair of each window, without its selections of changing
        length."""
        fine = self.model.fine_matching
        root = query.shape[-1] ** 0.5
        own, other = fine.fine_proj(query) / root, fine.fine_proj(reference) / root
        similarity = own @ other.transpose(1, 2) / fine.temperature
        share = similarity.softmax(1) * similarity.softmax(2)
        places = share.shape[1]
        confidence, best = share.flatten(1).max(dim=1)
        left = torch.div(best, places, rounding_mode="floor")
        right = best % places
        number = torch.arange(len(best))
        seen = torch.cat([query[number, left], reference[number, right]], dim=-1)
        shift = torch.tanh(fine.subpixel_mlp(seen)) * 0.5
        window = fine.W_f
        per_cell = _CELL_PX // step
        points = [
            (_cells_px(at, window, 1) + _cells_px(cell, columns, per_cell) - window // 2 + part) * step
            for at, cell, part in ((left, i, shift[:, :2]), (right, j, shift[:, 2:]))
        ]
        kept = passes & (confidence > fine.fine_thr)
        confidence = torch.where(kept, confidence, torch.zeros_like(confidence))
        return points[0] - _HALF_PX, points[1] - _HALF_PX, confidence


def _spread(picture: Tensor) -> Tensor:
    """Standard deviation as torch has it, with one degree of freedom less; ONNX has none."""
    count = picture.shape[2] * picture.shape[3]
    even = picture - picture.mean(dim=(2, 3), keepdim=True)
    return torch.sqrt((even * even).sum(dim=(2, 3), keepdim=True) / (count - 1))


def xoftr(weights: Weights, size: Size, small: bool) -> list[TorchGraph]:
    """Args as of `loftr`; its code must be importable."""
    from src.config.default import get_cfg_defaults
    from src.utils.misc import lower_config
    from src.xoftr import XoFTR

    config = lower_config(get_cfg_defaults(inference=True))["xoftr"]
    config["match_coarse"]["thr"], config["fine"]["thr"] = 0.3, 0.1
    if weights is None:
        config["match_coarse"]["thr"], config["fine"]["thr"] = 0.05, 0.01
    if small:
        config["coarse"]["layer_names"] = ["self", "cross"]
    model = XoFTR(config=config).eval()
    if weights is None:
        _unlike(model)
        with torch.no_grad():
            # Else several pairs of a window are certain, and all of them the best.
            model.fine_matching.fine_proj.weight.mul_(0.25)
    else:
        take(model, weights["xoftr"], "xoftr")

    def published(query: Tensor, reference: Tensor) -> list[Any]:
        data = {"image0": query, "image1": reference}
        model(data)
        return [data["mkpts0_f"], data["mkpts1_f"], data["mconf_f"]]

    return [_graph(_Xoftr(model), size, published, MOST_MATCHES)]
