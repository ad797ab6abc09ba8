"""Writes LightGlue, and LighterGlue, that of XFeat's authors, as ONNX graphs from their published weights; no torch.

Network: Lindenberger et al., "LightGlue: Local Feature Matching at Light Speed", ICCV 2023, sections 3.1 and 3.2,
with 9 layers of four heads and 256 channels; LighterGlue has 6 layers of one head and 96 channels, trained for XFeat
(weights of all Apache-2.0). Without the paper's early exit and point pruning, which need a graph that decides: all
points go through all layers. What is left open by names and shapes
(order of q, k and v in one matrix, pairs of channels that turn together) follows the published code and is
proven by a stored reference (`models.verify`).

Folded into the weights, computed in float64, none of it altering the function:
- 1 / sqrt(d) of the attentions and of the final similarity;
- the rotary embedding's quarter turn of channel pairs: turned(W x) = (turned W) x;
- each attention's output matrix, into the first linear layer of the network after it, which takes (x, message):
  A x + B (O c + o) = A x + (B O) c + B o.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from ortholoc_edge.geometry.arrays import FloatArray
from ortholoc_edge.matching.onnx_writer import OnnxWriter

SIDES: Final = ("query", "reference")
OUTPUT: Final = "log_assignment"

_LIGHTER_LAYERS: Final = 6
_LAYERS: Final = 9
_HEADS: Final = 4
_LAYER_NORM_EPSILON: Final = 1e-5  # torch's default

# Names of a value for query and reference, in this order.
_Pair = tuple[str, str]


class _Writer(OnnxWriter):
    """
    Args:
        heads: of every attention.
    """

    def __init__(self, weights: Mapping[str, npt.NDArray[Any]], what: str, heads: int) -> None:
        super().__init__(weights, what)
        self.heads = heads

    def linear(self, x: str, name: str, matrix: FloatArray, bias: FloatArray, output: str) -> str:
        """``x`` (N, in) to (N, out); the weights are kept once under ``name`` for both sides."""
        inputs = [x, self.constant(f"{name}.w", matrix.T, np.float32), self.constant(f"{name}.b", bias, np.float32)]
        return self.node("Gemm", inputs, output)

    def published(self, name: str) -> tuple[FloatArray, FloatArray]:
        return self.weight(f"{name}.weight"), self.weight(f"{name}.bias")

    def attend(self, q: str, k: str, v: str, output: str) -> str:
        """softmax(q k^T) v, head by head; the scale is in the weights of ``q`` and ``k``."""
        if self.heads == 1:
            across = self.node("Transpose", [k], f"{output}.k", perm=[1, 0])
            logits = self.node("MatMul", [q, across], f"{output}.logits")
            return self.node("MatMul", [self.node("Softmax", [logits], f"{output}.share", axis=-1), v], output)
        split = self.constant("heads", [0, self.heads, -1], np.int64)
        joined = self.constant("joined", [0, -1], np.int64)

        def per_head(value: str, name: str, perm: list[int]) -> str:
            return self.node("Transpose", [self.node("Reshape", [value, split], f"{name}.split")], name, perm=perm)

        queries, keys = per_head(q, f"{output}.q", [1, 0, 2]), per_head(k, f"{output}.k", [1, 2, 0])
        logits = self.node("MatMul", [queries, keys], f"{output}.logits")
        share = self.node("Softmax", [logits], f"{output}.share", axis=-1)
        mixed = self.node("MatMul", [share, per_head(v, f"{output}.v", [1, 0, 2])], f"{output}.mixed")
        return self.node("Reshape", [self.node("Transpose", [mixed], f"{output}.back", perm=[1, 0, 2]), joined], output)

    def update(self, x: str, context: str, block: str, out: str, side: str) -> str:
        """x + MLP(x, message): linear, LayerNorm, GELU, linear; ``out`` names the attention's output matrix."""
        first, first_bias = self.published(f"{block}.ffn.0")
        message, message_bias = self.published(out)
        width = message.shape[0]
        of_x, of_message = first[:, :width], first[:, width:]
        prefix = f"{block}.{side}"
        hidden = self.linear(
            context, f"{block}.message", of_message @ message, first_bias + of_message @ message_bias,
            f"{prefix}.message",
        )  # fmt: skip
        own = self.constant(f"{block}.own.w", of_x.T, np.float32)
        hidden = self.node("Add", [hidden, self.node("MatMul", [x, own], f"{prefix}.own")], f"{prefix}.hidden")
        scale, shift = self.published(f"{block}.ffn.1")
        norm = [
            hidden,
            self.constant(f"{block}.norm.w", scale, np.float32),
            self.constant(f"{block}.norm.b", shift, np.float32),
        ]
        hidden = self.node("LayerNormalization", norm, f"{prefix}.norm", axis=-1, epsilon=_LAYER_NORM_EPSILON)
        hidden = self.node("Gelu", [hidden], f"{prefix}.gelu")
        change = self.linear(hidden, f"{block}.ffn", *self.published(f"{block}.ffn.3"), f"{prefix}.change")
        return self.node("Add", [x, change], f"{prefix}.out")


def _turned(rows: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Each pair of rows (a, b) as (-b, a)."""
    turned = np.empty_like(rows)
    turned[0::2], turned[1::2] = -rows[1::2], rows[0::2]
    return turned


def _self_attention(w: _Writer, x: str, angles: _Pair, block: str, side: str) -> str:
    """``angles``: names of cosine and sine (N, d) of the places."""
    joint, joint_bias = w.published(f"{block}.Wqkv")
    # Row 3 c + i is channel c of q, k or v.
    parts = {name: (joint[i::3], joint_bias[i::3]) for i, name in enumerate("qkv")}
    width = len(parts["q"][1]) // w.heads
    parts["q"] = (parts["q"][0] / np.sqrt(width), parts["q"][1] / np.sqrt(width))
    prefix = f"{block}.{side}"

    def rotated(name: str) -> str:
        plain = w.linear(x, f"{block}.{name}", *parts[name], f"{prefix}.{name}")
        matrix, bias = (_turned(rows) for rows in parts[name])
        turned = w.linear(x, f"{block}.{name}t", matrix, bias, f"{prefix}.{name}t")
        plain = w.node("Mul", [plain, angles[0]], f"{prefix}.{name}cos")
        turned = w.node("Mul", [turned, angles[1]], f"{prefix}.{name}sin")
        return w.node("Add", [plain, turned], f"{prefix}.{name}r")

    v = w.linear(x, f"{block}.v", *parts["v"], f"{prefix}.v")
    context = w.attend(rotated("q"), rotated("k"), v, f"{prefix}.context")
    return w.update(x, context, block, f"{block}.out_proj", side)


def _cross_attention(w: _Writer, x: _Pair, block: str) -> _Pair:
    """Both sides look at each other; queries and keys come from one matrix."""
    matrix, bias = w.published(f"{block}.to_qk")
    scale = (len(bias) / w.heads) ** -0.25
    qk, v = [], []
    for value, side in zip(x, SIDES, strict=True):
        qk.append(w.linear(value, f"{block}.qk", matrix * scale, bias * scale, f"{block}.{side}.qk"))
        v.append(w.linear(value, f"{block}.v", *w.published(f"{block}.to_v"), f"{block}.{side}.v"))
    query = w.attend(qk[0], qk[1], v[1], f"{block}.query.context")
    reference = w.attend(qk[1], qk[0], v[0], f"{block}.reference.context")
    return (
        w.update(x[0], query, block, f"{block}.to_out", SIDES[0]),
        w.update(x[1], reference, block, f"{block}.to_out", SIDES[1]),
    )


def _assignment(w: _Writer, x: _Pair, block: str) -> None:
    """log of: share of the row x share of the column x both being matchable at all (paper, equations 8 and 9)."""
    matrix, bias = w.published(f"{block}.final_proj")
    scale = len(bias) ** -0.25
    projected, matchable = [], []
    for value, side in zip(x, SIDES, strict=True):
        projected.append(w.linear(value, f"{block}.final", matrix * scale, bias * scale, f"{side}.projected"))
        logit = w.linear(value, f"{block}.matchable", *w.published(f"{block}.matchability"), f"{side}.matchable")
        # log sigmoid(z) = -softplus(-z), which does not underflow.
        softplus = w.node("Softplus", [w.node("Neg", [logit], f"{side}.unmatchable")], f"{side}.softplus")
        matchable.append(w.node("Neg", [softplus], f"{side}.log_matchable"))
    across = w.node("Transpose", [projected[1]], "reference.across", perm=[1, 0])
    similarity = w.node("MatMul", [projected[0], across], "similarity")
    rows = w.node("LogSoftmax", [similarity], "log_rows", axis=1)
    columns = w.node("LogSoftmax", [similarity], "log_columns", axis=0)
    both = w.node("Add", [rows, columns], "log_both")
    both = w.node("Add", [both, matchable[0]], "log_with_query")
    last = w.node("Transpose", [matchable[1]], "reference.log_matchable_row", perm=[1, 0])
    w.node("Add", [both, last], OUTPUT)


def lighterglue_onnx(weights: Mapping[str, npt.NDArray[Any]], source: str, layers: int = _LIGHTER_LAYERS) -> bytes:
    """XFeat's. Args as `lightglue_onnx`."""
    return _written(_Writer(weights, "LighterGlue", 1), "xfeat-lighterglue", source, layers)


def lightglue_onnx(weights: Mapping[str, npt.NDArray[Any]], source: str, layers: int = _LAYERS) -> bytes:
    """The graph as ONNX bytes; the same weights and ``onnx`` version give the same bytes.

    Inputs ``query_descriptors`` (M, D) float32 of unit length, ``query_places`` (M, 2), the keypoints from the
    middle of their image in units of half its long side; ``reference_descriptors`` (N, D), ``reference_places``
    (N, 2). Output ``log_assignment`` (M, N): log of the probability that two points are a pair.

    Args:
        weights: the checkpoint's tensors by name; widths are theirs.
        source: written into the file, says where the weights are from.
        layers: that the network has.
    Raises: ModelError if the weights are not LightGlue's.
    """
    named = {f"matcher.{_todays_name(name)}": values for name, values in weights.items()}
    return _written(_Writer(named, "LightGlue", _HEADS), "lightglue", source, layers)


def _todays_name(name: str) -> str:
    """Older checkpoints say ``self_attn.3`` for ``transformers.3.self_attn``."""
    block, _, rest = name.partition(".")
    if block not in ("self_attn", "cross_attn"):
        return name
    layer, _, tensor = rest.partition(".")
    return f"transformers.{layer}.{block}.{tensor}"


def _written(w: _Writer, name: str, source: str, layers: int) -> bytes:
    # Each frequency turns a pair of channels, of every head alike.
    turns = np.tile(np.repeat(w.weight("matcher.posenc.Wr.weight"), 2, axis=0), (w.heads, 1))
    frequencies = w.constant("frequencies", turns.T, np.float32)
    x, angles = [], []
    for side in SIDES:
        x.append(w.linear(f"{side}_descriptors", "input", *w.published("matcher.input_proj"), f"{side}.input"))
        phase = w.node("MatMul", [f"{side}_places", frequencies], f"{side}.phase")
        angles.append((w.node("Cos", [phase], f"{side}.cos"), w.node("Sin", [phase], f"{side}.sin")))
    for layer in range(layers):
        block = f"matcher.transformers.{layer}"
        own = [
            _self_attention(w, value, turns_of_side, f"{block}.self_attn", side)
            for value, turns_of_side, side in zip(x, angles, SIDES, strict=True)
        ]
        x = list(_cross_attention(w, (own[0], own[1]), f"{block}.cross_attn"))
    _assignment(w, (x[0], x[1]), f"matcher.log_assignment.{layers - 1}")
    descriptor = w.weight("matcher.input_proj.weight").shape[1]
    inputs = {
        f"{side}_{what}": (count, width)
        for side, count in zip(SIDES, "MN", strict=True)
        for what, width in (("descriptors", descriptor), ("places", 2))
    }
    return w.model(name, source, inputs, {OUTPUT: ("M", "N")})
