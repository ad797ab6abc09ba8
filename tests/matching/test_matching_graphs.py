"""The graphs of XFeat* and LighterGlue against the networks written down in numpy, as published, in float64.

With random weights, so that these need none; LighterGlue's are narrow and few, its numpy form folds nothing.
"""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import onnx
import onnxruntime as ort
import pytest

from ortholoc_edge.errors import ModelError
from ortholoc_edge.matching.lighterglue_graph import lighterglue_onnx
from ortholoc_edge.matching.xfeat_graph import xfeat_onnx
from ortholoc_edge.matching.xfeat_star_graph import xfeat_star_fine_onnx, xfeat_star_onnx

Weights = dict[str, np.ndarray]


def _run(graph: bytes, feeds: Weights) -> list[np.ndarray]:
    session = ort.InferenceSession(graph, providers=["CPUExecutionProvider"])
    return session.run(None, {name: values.astype(np.float32) for name, values in feeds.items()})


# -- XFeat's convolutions --------------------------------------------------------------------------------------

# Block -> (channels in, then per convolution: channels out, kernel, stride), as in the paper's figure 3.
BLOCKS = {
    "block1": (1, (4, 3, 1), (8, 3, 2), (8, 3, 1), (24, 3, 2)),
    "block2": (24, (24, 3, 1), (24, 3, 1)),
    "block3": (24, (64, 3, 2), (64, 3, 1), (64, 1, 1)),
    "block4": (64, (64, 3, 2), (64, 3, 1), (64, 3, 1)),
    "block5": (64, (128, 3, 2), (128, 3, 1), (128, 3, 1), (64, 1, 1)),
    "block_fusion": (64, (64, 3, 1), (64, 3, 1)),
    "heatmap_head": (64, (64, 1, 1), (64, 1, 1)),
    "keypoint_head": (64, (64, 1, 1), (64, 1, 1), (64, 1, 1)),
}
PLAIN = {"skip1.1": (1, 24), "block_fusion.2": (64, 64), "heatmap_head.2": (64, 1), "keypoint_head.3": (64, 65)}


def _xfeat_weights(rng: np.random.Generator) -> Weights:
    weights = {}
    for block, (first, *layers) in BLOCKS.items():
        widths = [first, *(out for out, _, _ in layers)]
        for index, (channels, (out, kernel, _)) in enumerate(zip(widths, layers, strict=False)):
            name, fan = f"{block}.{index}.layer", channels * kernel * kernel
            weights[f"{name}.0.weight"] = rng.normal(size=(out, channels, kernel, kernel)) * math.sqrt(2 / fan)
            weights[f"{name}.1.running_mean"] = rng.normal(size=out) * 0.2
            weights[f"{name}.1.running_var"] = rng.uniform(0.5, 2, size=out)
    for name, (channels, out) in PLAIN.items():
        weights[f"{name}.weight"] = rng.normal(size=(out, channels, 1, 1)) / math.sqrt(channels)
        weights[f"{name}.bias"] = rng.normal(size=out) * 0.3
    return weights


def _conv(x: np.ndarray, kernel: np.ndarray, stride: int) -> np.ndarray:
    side = kernel.shape[-1]
    pad = side // 2
    padded = np.pad(x, ((0, 0), (pad, pad), (pad, pad)))
    windows = np.lib.stride_tricks.sliding_window_view(padded, (side, side), axis=(1, 2))[:, ::stride, ::stride]
    return np.einsum("chwij,ocij->ohw", windows, kernel)


def _block(weights: Weights, x: np.ndarray, block: str) -> np.ndarray:
    for index, (_, _, stride) in enumerate(BLOCKS[block][1:]):
        name = f"{block}.{index}.layer"
        x = _conv(x, weights[f"{name}.0.weight"], stride)
        mean, variance = weights[f"{name}.1.running_mean"], weights[f"{name}.1.running_var"]
        x = np.maximum((x - mean[:, None, None]) / np.sqrt(variance + 1e-5)[:, None, None], 0)
    return x


def _plain(weights: Weights, x: np.ndarray, name: str) -> np.ndarray:
    return _conv(x, weights[f"{name}.weight"], 1) + weights[f"{name}.bias"][:, None, None]


def _enlarged(x: np.ndarray, factor: int) -> np.ndarray:
    """Bilinear, pixels as areas, the outermost repeated."""
    for axis in (1, 2):
        size = x.shape[axis]
        place = np.clip((np.arange(size * factor) + 0.5) / factor - 0.5, 0, size - 1)
        low = np.floor(place).astype(int)
        share = (place - low)[:, None] if axis == 1 else place - low
        high = np.minimum(low + 1, size - 1)
        x = x.take(low, axis) * (1 - share) + x.take(high, axis) * share
    return x


def _fused(weights: Weights, image: np.ndarray) -> np.ndarray:
    rows, columns = image.shape
    pooled = image.reshape(1, rows // 4, 4, columns // 4, 4).mean(axis=(2, 4))
    x = _block(weights, image[None], "block1") + _plain(weights, pooled, "skip1.1")
    eighth = _block(weights, _block(weights, x, "block2"), "block3")
    sixteenth = _block(weights, eighth, "block4")
    pyramid = eighth + _enlarged(sixteenth, 2) + _enlarged(_block(weights, sixteenth, "block5"), 4)
    return _plain(weights, _block(weights, pyramid, "block_fusion"), "block_fusion.2")


def _sigmoid(x: np.ndarray) -> np.ndarray:
    return 1 / (1 + np.exp(-x))


def test_xfeat_graphs_are_the_published_network() -> None:
    rng = np.random.default_rng(0)
    weights, image = _xfeat_weights(rng), rng.normal(size=(64, 96))
    fused = _fused(weights, image)
    reliability = _sigmoid(_plain(weights, _block(weights, fused, "heatmap_head"), "heatmap_head.2"))
    feeds = {"normalised": image[None, None]}

    cells, dense_reliability = _run(xfeat_star_onnx(weights, ""), feeds)
    assert np.abs(fused).max() > 1
    np.testing.assert_allclose(cells[0], fused, atol=1e-4)
    np.testing.assert_allclose(dense_reliability[0], reliability, atol=1e-5)

    features, heat, sparse_reliability = _run(xfeat_onnx(weights, ""), feeds)
    np.testing.assert_allclose(features[0], fused / np.linalg.norm(fused, axis=0), atol=1e-5)
    np.testing.assert_array_equal(sparse_reliability, dense_reliability)
    patches = image.reshape(8, 8, 12, 8).transpose(1, 3, 0, 2).reshape(64, 8, 12)
    logits = _plain(weights, _block(weights, patches, "keypoint_head"), "keypoint_head.3")
    shares = (np.exp(logits) / np.exp(logits).sum(axis=0))[:64]
    expected = shares.reshape(8, 8, 8, 12).transpose(2, 0, 3, 1).reshape(64, 96)
    np.testing.assert_allclose(heat[0, 0], expected, atol=1e-5)


# -- the fine matcher ------------------------------------------------------------------------------------------


def _fine_weights(rng: np.random.Generator, width: int = 24) -> Weights:
    weights, channels = {}, 128
    for index in (0, 3, 6, 9, 12):
        out = 64 if index == 12 else width
        weights[f"fine_matcher.{index}.weight"] = rng.normal(size=(out, channels)) * math.sqrt(2 / channels)
        weights[f"fine_matcher.{index}.bias"] = rng.normal(size=out)
        if index < 12:
            weights[f"fine_matcher.{index + 1}.running_mean"] = rng.normal(size=out)
            weights[f"fine_matcher.{index + 1}.running_var"] = rng.uniform(0.5, 2, size=out)
        channels = out
    return weights


def test_the_fine_matcher_is_the_published_network() -> None:
    rng = np.random.default_rng(1)
    weights, pairs = _fine_weights(rng), rng.normal(size=(7, 128))
    x = pairs
    for index in (0, 3, 6, 9, 12):
        x = x @ weights[f"fine_matcher.{index}.weight"].T + weights[f"fine_matcher.{index}.bias"]
        if index < 12:
            mean, variance = (weights[f"fine_matcher.{index + 1}.running_{what}"] for what in ("mean", "var"))
            x = np.maximum((x - mean) / np.sqrt(variance + 1e-5), 0)
    (logits,) = _run(xfeat_star_fine_onnx(weights, ""), {"pairs": pairs})
    assert np.ptp(x) > 1
    np.testing.assert_allclose(logits, x, atol=1e-4)


# -- LighterGlue -----------------------------------------------------------------------------------------------

WIDTH, LAYERS = 8, 2
_erf = np.vectorize(math.erf)


def _lighterglue_weights(rng: np.random.Generator) -> Weights:
    weights: Weights = {"matcher.posenc.Wr.weight": rng.normal(size=(WIDTH // 2, 2)) * 2}

    def linear(name: str, out: int, channels: int) -> None:
        weights[f"{name}.weight"] = rng.normal(size=(out, channels)) / math.sqrt(channels)
        weights[f"{name}.bias"] = rng.normal(size=out) * 0.5

    linear("matcher.input_proj", WIDTH, 64)
    for layer in range(LAYERS):
        block = f"matcher.transformers.{layer}"
        linear(f"{block}.self_attn.Wqkv", 3 * WIDTH, WIDTH)
        linear(f"{block}.self_attn.out_proj", WIDTH, WIDTH)
        for name in ("to_qk", "to_v", "to_out"):
            linear(f"{block}.cross_attn.{name}", WIDTH, WIDTH)
        for kind in ("self_attn", "cross_attn"):
            linear(f"{block}.{kind}.ffn.0", 2 * WIDTH, 2 * WIDTH)
            weights[f"{block}.{kind}.ffn.1.weight"] = rng.uniform(0.5, 2, size=2 * WIDTH)
            weights[f"{block}.{kind}.ffn.1.bias"] = rng.normal(size=2 * WIDTH)
            linear(f"{block}.{kind}.ffn.3", WIDTH, 2 * WIDTH)
        linear(f"matcher.log_assignment.{layer}.final_proj", WIDTH, WIDTH)
        linear(f"matcher.log_assignment.{layer}.matchability", 1, WIDTH)
    return weights


class _Published:
    """LightGlue of one head, step by step as in the paper."""

    def __init__(self, weights: Weights) -> None:
        self._weights = weights

    def _linear(self, x: np.ndarray, name: str) -> np.ndarray:
        return x @ self._weights[f"{name}.weight"].T + self._weights[f"{name}.bias"]

    def _rotated(self, x: np.ndarray, places: np.ndarray) -> np.ndarray:
        """Channels 2k and 2k + 1 as a complex number, turned by the k-th frequency (paper, equation 4)."""
        turn = np.exp(1j * (places @ self._weights["matcher.posenc.Wr.weight"].T))
        turned = (x[:, 0::2] + 1j * x[:, 1::2]) * turn
        return np.stack([turned.real, turned.imag], axis=-1).reshape(x.shape)

    @staticmethod
    def _attended(q: np.ndarray, k: np.ndarray, v: np.ndarray) -> np.ndarray:
        logits = q @ k.T / math.sqrt(q.shape[1])
        shares = np.exp(logits - logits.max(axis=1, keepdims=True))
        return shares / shares.sum(axis=1, keepdims=True) @ v

    def _updated(self, x: np.ndarray, message: np.ndarray, block: str) -> np.ndarray:
        hidden = self._linear(np.concatenate([x, message], axis=1), f"{block}.ffn.0")
        centred = hidden - hidden.mean(axis=1, keepdims=True)
        normed = centred / np.sqrt((centred**2).mean(axis=1, keepdims=True) + 1e-5)
        normed = normed * self._weights[f"{block}.ffn.1.weight"] + self._weights[f"{block}.ffn.1.bias"]
        return x + self._linear(normed * 0.5 * (1 + _erf(normed / math.sqrt(2))), f"{block}.ffn.3")

    def _self(self, x: np.ndarray, places: np.ndarray, block: str) -> np.ndarray:
        q, k, v = np.moveaxis(self._linear(x, f"{block}.Wqkv").reshape(len(x), WIDTH, 3), 2, 0)
        context = self._attended(self._rotated(q, places), self._rotated(k, places), v)
        return self._updated(x, self._linear(context, f"{block}.out_proj"), block)

    def _cross(self, x: np.ndarray, other: np.ndarray, block: str) -> np.ndarray:
        values = self._linear(other, f"{block}.to_v")
        context = self._attended(self._linear(x, f"{block}.to_qk"), self._linear(other, f"{block}.to_qk"), values)
        return self._updated(x, self._linear(context, f"{block}.to_out"), block)

    def assignment(self, feeds: Weights) -> np.ndarray:
        x, y = (self._linear(feeds[f"{side}_descriptors"], "matcher.input_proj") for side in ("query", "reference"))
        for layer in range(LAYERS):
            block = f"matcher.transformers.{layer}"
            x = self._self(x, feeds["query_places"], f"{block}.self_attn")
            y = self._self(y, feeds["reference_places"], f"{block}.self_attn")
            x, y = self._cross(x, y, f"{block}.cross_attn"), self._cross(y, x, f"{block}.cross_attn")
        last = f"matcher.log_assignment.{LAYERS - 1}"
        similar = self._linear(x, f"{last}.final_proj") @ self._linear(y, f"{last}.final_proj").T / math.sqrt(WIDTH)
        shares = np.exp(similar)
        shares = shares / shares.sum(axis=1, keepdims=True) * shares / shares.sum(axis=0)
        matchable = [_sigmoid(self._linear(one, f"{last}.matchability")) for one in (x, y)]
        return np.log(matchable[0] * matchable[1].T * shares)


@pytest.mark.parametrize(("m", "n"), [(9, 13), (13, 9), (1, 5), (1, 1)])
def test_lighterglue_is_the_published_network(m: int, n: int) -> None:
    rng = np.random.default_rng(2)
    weights = _lighterglue_weights(rng)
    feeds = {
        "query_descriptors": rng.normal(size=(m, 64)),
        "query_places": rng.uniform(-1, 1, size=(m, 2)),
        "reference_descriptors": rng.normal(size=(n, 64)),
        "reference_places": rng.uniform(-1, 1, size=(n, 2)),
    }
    graph = lighterglue_onnx(weights, "", layers=LAYERS)
    (logs,) = _run(graph, feeds)
    expected = _Published(weights).assignment(feeds)
    np.testing.assert_allclose(logs, expected, atol=2e-4)
    if m > 1:
        # Places and the order of sides matter to the network, so they must to this comparison.
        moved = feeds | {"query_places": feeds["query_places"][::-1]}
        assert np.abs(_run(graph, moved)[0] - logs).max() > 0.01


def test_lighterglue_sees_differences_of_places_only() -> None:
    """So half a pixel in what counts as the image's middle is nothing to it."""
    rng = np.random.default_rng(3)
    graph = lighterglue_onnx(_lighterglue_weights(rng), "", layers=LAYERS)
    feeds = {
        f"{side}_{what}": rng.normal(size=(6, width))
        for side in ("query", "reference")
        for what, width in (("descriptors", 64), ("places", 2))
    }
    moved = feeds | {"query_places": feeds["query_places"] + (0.3, -0.7)}
    np.testing.assert_allclose(_run(graph, moved)[0], _run(graph, feeds)[0], atol=1e-4)


def test_shared_weights_are_stored_once() -> None:
    graph = onnx.load_from_string(lighterglue_onnx(_lighterglue_weights(np.random.default_rng(4)), "", layers=LAYERS))
    values = [one.raw_data for one in graph.graph.initializer]
    assert len(set(values)) == len(values) > 20 * LAYERS


# -- other checkpoints -----------------------------------------------------------------------------------------

Writer = Callable[[Weights, str], bytes]
WRITERS: list[tuple[Writer, Callable[[np.random.Generator], Weights], str, Any]] = [
    (xfeat_star_onnx, _xfeat_weights, "skip1.1.weight", np.s_[:-1]),
    (xfeat_star_fine_onnx, _fine_weights, "fine_matcher.6.weight", np.s_[:, :-1]),
    (
        lambda weights, source: lighterglue_onnx(weights, source, LAYERS),
        _lighterglue_weights,
        "matcher.transformers.1.cross_attn.to_v.weight",
        np.s_[:, :-1],
    ),
]


@pytest.mark.parametrize(("write", "make", "name", "cut"), WRITERS)
def test_another_networks_weights_are_refused(write: Writer, make, name: str, cut: Any) -> None:
    weights = make(np.random.default_rng(5))
    missing = {key: value for key, value in weights.items() if key != name}
    with pytest.raises(ModelError, match=f"tensor '{name}' is missing"):
        write(missing, "")
    with pytest.raises(ModelError, match="do not form the network"):
        write(weights | {name: weights[name][cut]}, "")


@pytest.mark.parametrize(("write", "make", "name", "cut"), WRITERS)
def test_the_same_weights_give_the_same_bytes(write: Writer, make, name: str, cut: Any) -> None:
    weights = make(np.random.default_rng(6))
    assert write(weights, "of nobody") == write(dict(reversed(weights.items())), "of nobody")
    assert write(weights, "of nobody") != write(weights | {name: weights[name] + 1}, "of nobody")
