"""SuperPoint, SuperGlue, LightGlue and DeDoDe."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final
from unittest import mock

import numpy as np
import torch
import torch.nn.functional as nnf
from torch import Tensor, nn

from ortholoc_edge.errors import ModelError
from ortholoc_edge.export.graphs import MIN_SHARE, Array, TorchGraph, check_pictures, settle, value_differences
from ortholoc_edge.export.sources import without_loading
from ortholoc_edge.export.vit import pin_places, shallow
from ortholoc_edge.export.weights import take
from ortholoc_edge.matching import superpoint as run_superpoint
from ortholoc_edge.matching.dedode import DESCRIPTOR as DEDODE_WIDTH
from ortholoc_edge.matching.lighterglue import mutual_best
from ortholoc_edge.matching.lighterglue_graph import lightglue_onnx

# For the export and the comparison; SuperPoint's graph takes any size, the matchers' any number.
_PICTURE: Final = (160, 128)
_COUNTS: Final = (60, 50)
_SINKHORN_ROUNDS: Final = 20
_PATCH_PX: Final = 14
_SMALL_LAYERS: Final = 2
_PLACE_VARIES: Final = {2: "H", 3: "W"}

Weights = Mapping[str, Mapping[str, Tensor]] | None
Size = tuple[int, int]


class _SuperPoint(nn.Module):
    """The published network up to its maps; what is chosen in them is `matching.superpoint`'s."""

    def __init__(self, model: Any) -> None:
        super().__init__()
        self.model = model

    def forward(self, picture: Tensor) -> tuple[Tensor, Tensor]:
        model, x = self.model, picture
        for number in range(1, 5):
            for letter in "ab":
                x = nnf.relu(getattr(model, f"conv{number}{letter}")(x))
            if number < 4:
                x = nnf.max_pool2d(x, 2, 2)
        heat = model.convPb(nnf.relu(model.convPa(x))).softmax(1)[:, :-1]
        descriptors = model.convDb(nnf.relu(model.convDa(x)))
        return nnf.pixel_shuffle(heat, run_superpoint.CELL_PX), nnf.normalize(descriptors, p=2, dim=1)


def _superpoint(
    model: Any, weights: Weights, min_score: float, published: Callable[[Tensor], Sequence[Any]]
) -> TorchGraph:
    picture = check_pictures(*_PICTURE)[0]
    if weights is not None:
        take(model, weights["superpoint"], "superpoint")

    def outputs() -> list[Array]:
        with torch.no_grad():
            return [np.asarray(values) for values in published(picture)]

    def compare(ours: Sequence[Array], theirs: Sequence[Array]) -> dict[str, float]:
        """Through the choice of keypoints, which is ours."""
        most = len(theirs[0])
        found, scores = run_superpoint.keypoints(ours[0][0, 0], None, min_score, most)
        descriptors = run_superpoint.sampled(ours[1][0], found)
        known = {(round(u), round(v)): number for number, (u, v) in enumerate(found.tolist())}
        pairs = [(known[place], number) for number, place in enumerate(map(_rounded, theirs[0])) if place in known]
        if len(pairs) < MIN_SHARE * most or len(found) != most:
            raise ModelError(f"SuperPoint: of {most} published keypoints the graph gives {len(pairs)}")
        own, other = (np.array(side) for side in zip(*pairs, strict=True))
        return value_differences(("scores", "descriptors"))(
            [scores[own], descriptors[own]], [theirs[1][other], theirs[2][other]]
        )

    return TorchGraph(
        part="superpoint",
        module=_SuperPoint(model),
        inputs={"picture": picture},
        outputs=("heat", "descriptors"),
        published=outputs,
        compare=compare,
        varying={name: _PLACE_VARIES for name in ("picture", "heat", "descriptors")},
    )


def _rounded(place: Any) -> tuple[int, int]:
    return round(float(place[0])), round(float(place[1]))


def _some_features(seed: int) -> list[tuple[Tensor, Tensor, Tensor]]:
    """Descriptors (N, 256) of unit length, keypoints (N, 2) in a picture of ``_PICTURE``, scores (N,); those of the
    second side are those of the first, changed a little and in another order."""
    source = np.random.default_rng(seed)
    width, height = _PICTURE
    first = source.normal(size=(_COUNTS[0], 256))
    order = source.permutation(_COUNTS[0])[: _COUNTS[1]]
    second = first[order] + 0.3 * source.normal(size=(_COUNTS[1], 256))
    places = source.uniform((0, 0), (width, height), (_COUNTS[0], 2))
    sides = []
    for rows, at in ((first, places), (second, np.clip(places[order] + [5.0, 3.0], 0, [width, height]))):
        even = rows / np.linalg.norm(rows, axis=1, keepdims=True)
        scores = source.uniform(0.1, 0.9, len(rows))
        sides.append(tuple(torch.from_numpy(values.astype(np.float32)) for values in (even, at, scores)))
    return [(side[0], side[1], side[2]) for side in sides]


def _probabilities(ours: Sequence[Array], theirs: Sequence[Array]) -> dict[str, float]:
    """Of the first side's points to be a pair's, as both published matchers give them."""
    i, j = mutual_best(ours[0])
    own = np.zeros(len(theirs[0]))
    own[i] = np.exp(ours[0][i, j])
    return value_differences(("probability",))([own], theirs)


_SIDES: Final = ("query", "reference")
_GLUE_VARIES: Final = {
    f"{side}_{what}": {0: count}
    for side, count in zip(_SIDES, "MN", strict=True)
    for what in ("descriptors", "places", "scores")
}


class _SuperGlue(nn.Module):
    def __init__(self, model: Any, transport: Callable[..., Tensor]) -> None:
        super().__init__()
        self.model = model
        self.transport = transport

    def forward(
        self, query: Tensor, query_places: Tensor, query_scores: Tensor,
        reference: Tensor, reference_places: Tensor, reference_scores: Tensor,
    ) -> Tensor:  # fmt: skip
        model = self.model
        first = query.T[None] + model.kenc(query_places[None], query_scores[None])
        second = reference.T[None] + model.kenc(reference_places[None], reference_scores[None])
        first, second = model.gnn(first, second)
        first, second = model.final_proj(first), model.final_proj(second)
        scores = torch.einsum("bdn,bdm->bnm", first, second) / model.config["descriptor_dim"] ** 0.5
        scores = self.transport(scores, model.bin_score, iters=_SINKHORN_ROUNDS)
        return scores[0, :-1, :-1]


def superpoint_superglue(weights: Weights, small: bool) -> list[TorchGraph]:
    """Args:
    weights: the files' tensors by part; None: random ones.
    small: a network of the same kind with fewer layers.
    """
    from models import superglue as code
    from models.superpoint import SuperPoint

    layers = ["self", "cross"] * (1 if small else 9)
    with without_loading():
        extractor = SuperPoint({"max_keypoints": -1}).eval()
        matcher = code.SuperGlue(
            {
                "weights": "outdoor",
                "sinkhorn_iterations": _SINKHORN_ROUNDS,
                "GNN_layers": layers,
                "match_threshold": 0.0,
            }
        ).eval()
    if weights is not None:
        take(matcher, weights["superglue"], "superglue")

    def keypoints(picture: Tensor) -> Sequence[Any]:
        # By one character of its version it takes torch 2.10 and later for one before 1.3, and samples otherwise.
        with mock.patch("torch.__version__", "1.9.0"):
            found = extractor({"image": picture})
        return found["keypoints"][0], found["scores"][0], found["descriptors"][0].T

    sides = _some_features(1)
    width, height = _PICTURE
    blank = torch.zeros(1, 1, height, width)

    def published() -> list[Any]:
        given: dict[str, Tensor] = {}
        for number, (descriptors, places, scores) in enumerate(sides):
            given |= {
                f"descriptors{number}": descriptors.T[None], f"keypoints{number}": places[None],
                f"scores{number}": scores[None], f"image{number}": blank,
            }  # fmt: skip
        with torch.no_grad():
            return [np.asarray(matcher(given)["matching_scores0"][0])]

    inputs: dict[str, Tensor] = {}
    for side, (descriptors, places, scores) in zip(_SIDES, sides, strict=True):
        even = code.normalize_keypoints(places[None], blank.shape)[0]
        inputs |= {f"{side}_descriptors": descriptors, f"{side}_places": even, f"{side}_scores": scores}
    return [
        _superpoint(extractor, weights, extractor.config["keypoint_threshold"], keypoints),
        TorchGraph(
            part="superglue",
            module=_SuperGlue(matcher, code.log_optimal_transport),
            inputs=inputs,
            outputs=("log_assignment",),
            published=published,
            compare=_probabilities,
            varying={**_GLUE_VARIES, "log_assignment": {0: "M", 1: "N"}},
        ),
    ]


def superpoint_lightglue(weights: Weights, small: bool) -> list[TorchGraph]:
    """Args as of `superpoint_superglue`. LightGlue's graph is that of `lighterglue_graph`, here for descriptors that go
    in as they are."""
    from lightglue import LightGlue, SuperPoint

    layers = 2 if small else 9
    with without_loading():
        extractor = SuperPoint(max_num_keypoints=None).eval()
        matcher = LightGlue(
            features="superpoint", n_layers=layers, depth_confidence=-1, width_confidence=-1, filter_threshold=0.0,
            flash=False,
        ).eval()  # fmt: skip
    if weights is not None:
        take(matcher, _todays_names(weights["lightglue"], layers), "lightglue", ("confidence_thresholds",))

    def keypoints(picture: Tensor) -> Sequence[Any]:
        found = extractor({"image": picture})
        return found["keypoints"][0], found["keypoint_scores"][0], found["descriptors"][0]

    sides = _some_features(2)
    size = torch.tensor([_PICTURE], dtype=torch.float32)

    def published() -> list[Any]:
        given = {
            f"image{number}": {"keypoints": places[None], "descriptors": descriptors[None], "image_size": size}
            for number, (descriptors, places, _) in enumerate(sides)
        }
        with torch.no_grad():
            return [np.asarray(matcher(given)["matching_scores0"][0])]

    inputs: dict[str, Tensor] = {}
    for side, (descriptors, places, _) in zip(_SIDES, sides, strict=True):
        even = (places - size / 2) / (size.max() / 2)
        inputs |= {f"{side}_descriptors": descriptors, f"{side}_places": even}
    arrays = {name: np.asarray(value) for name, value in matcher.state_dict().items()}
    # An identity stands for the layer that narrower or wider descriptors need.
    arrays |= {"input_proj.weight": np.eye(256, dtype=np.float32), "input_proj.bias": np.zeros(256, np.float32)}
    return [
        _superpoint(extractor, weights, extractor.conf.detection_threshold, keypoints),
        TorchGraph(
            part="lightglue",
            module=lightglue_onnx(arrays, "", layers),
            inputs=inputs,
            outputs=("log_assignment",),
            published=published,
            compare=_probabilities,
        ),
    ]


def _todays_names(weights: Mapping[str, Tensor], layers: int) -> dict[str, Tensor]:
    named = dict(weights)
    for layer in range(layers):
        for block in ("self_attn", "cross_attn"):
            old, new = f"{block}.{layer}.", f"transformers.{layer}.{block}."
            named = {
                new + name.removeprefix(old) if name.startswith(old) else name: value for name, value in named.items()
            }
    return named


class _DedodeDetector(nn.Module):
    def __init__(self, model: Any) -> None:
        super().__init__()
        self.model = model

    def forward(self, picture: Tensor) -> Tensor:
        heat: Tensor = self.model.detector(self.model.normalizer(picture.expand(-1, 3, -1, -1)))
        return heat


class _DedodeDescriptor(nn.Module):
    def __init__(self, model: Any) -> None:
        super().__init__()
        self.model = model

    def forward(self, picture: Tensor, keypoints: Tensor) -> Tensor:
        # What inference mode gives can't be traced.
        with mock.patch("torch.inference_mode", torch.no_grad):
            dense = self.model.descriptor(self.model.normalizer(picture.expand(-1, 3, -1, -1)))
        rows, columns = int(picture.shape[2]), int(picture.shape[3])
        places = (keypoints + 0.5) * torch.tensor([2.0 / columns, 2.0 / rows]) - 1.0
        found = nnf.grid_sample(dense, places[None, None], mode="bilinear", align_corners=False)[0, :, 0].T
        return nnf.normalize(found, p=2.0, dim=1)


def dedode(weights: Weights, size: Size, small: bool) -> list[TorchGraph]:
    """Args as of `superpoint_superglue`, and
    size: (width, height) px, multiples of 14.
    """
    from kornia.feature import DeDoDe
    from kornia.feature.dedode import encoder
    from kornia.feature.dedode.transformer import dinov2

    with (
        without_loading(),
        mock.patch.object(encoder, "load_state_dict_from_url", lambda *_, **__: {}),
        shallow(dinov2, _SMALL_LAYERS if small else None),
    ):
        model = DeDoDe(detector_model="L", descriptor_model="G", amp_dtype=torch.float32).eval()
    vit = model.descriptor.encoder.frozen_dinov2.dinov2_vitl14[0].eval()
    picture = check_pictures(*size)[0]
    colour = picture.expand(-1, 3, -1, -1)
    if weights is None:
        settle(model.detector, lambda: model.detector(model.normalizer(colour)))
        settle(model.descriptor, lambda: model.descriptor(model.normalizer(colour)))
    else:
        take(model.detector, weights["detector"], "detector")
        take(model.descriptor, weights["descriptor"], "descriptor")
        take(vit, weights["dinov2"], "dinov2")
    with torch.no_grad(), mock.patch("torch.inference_mode", torch.no_grad):
        chosen, scores = model.detect(colour, n=200)
        described = nnf.normalize(model.describe(colour, chosen)[0], p=2.0, dim=1)
    pin_places(vit, size[1] // _PATCH_PX, size[0] // _PATCH_PX, _PATCH_PX)
    keypoints_px = (chosen[0] + 1.0) * torch.tensor(size) / 2.0 - 0.5

    def compare(ours: Sequence[Array], theirs: Sequence[Array]) -> dict[str, float]:
        from ortholoc_edge.matching.dedode import chosen as best

        found, own = best(ours[0][0, 0], None, len(theirs[0]))
        known = {_rounded(place): number for number, place in enumerate(found)}
        pairs = [(known[place], number) for number, place in enumerate(map(_rounded, theirs[0])) if place in known]
        if len(pairs) < MIN_SHARE * len(theirs[0]):
            raise ModelError(f"DeDoDe: of {len(theirs[0])} published keypoints the graph gives {len(pairs)}")
        rows, columns = (np.array(side) for side in zip(*pairs, strict=True))
        ratio = own[rows] / theirs[1][columns]
        return {"scores": float(np.abs(ratio - 1.0).max())}

    assert described.shape[1] == DEDODE_WIDTH
    return [
        TorchGraph(
            part="detector",
            module=_DedodeDetector(model),
            inputs={"picture": picture},
            outputs=("heat",),
            published=lambda: [np.asarray(keypoints_px), np.asarray(scores[0])],
            compare=compare,
        ),
        TorchGraph(
            part="descriptor",
            module=_DedodeDescriptor(model),
            inputs={"picture": picture, "keypoints": keypoints_px},
            outputs=("descriptors",),
            published=lambda: [np.asarray(described)],
            compare=value_differences(("descriptors",)),
            varying={"keypoints": {0: "N"}, "descriptors": {0: "N"}},
        ),
    ]
