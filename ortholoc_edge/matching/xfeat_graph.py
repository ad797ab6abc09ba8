"""Writes the XFeat network as an ONNX graph from its published weights; no torch.

Network: Potje et al., "XFeat: Accelerated Features for Lightweight Image Matching", CVPR 2024 (weights
Apache-2.0). The structure is read off the weights' names and shapes; what these leave open (strides, where the
skip joins, the 8x8 cell order) follows the published model and is proven by a stored reference (`models.verify`).

What is changed against the published network, none of which alters its function: the image is normalised
by mean and variance before it comes in (so that invalid pixels can be left out of both), the batch
normalisations are folded into the convolutions, the descriptor map is L2-normalised in the graph, and the
keypoint logits become a full-resolution heat map. The semi-dense variant's graphs are apart: `xfeat_star_graph`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from ortholoc_edge.geometry.arrays import Float32Array
from ortholoc_edge.matching.onnx_writer import BATCH_NORM_EPSILON, OnnxWriter, Shape

INPUT: Final = "normalised"

_CELL: Final = 8
# exp(80) summed 65 times still fits float32. Logits on photos stay under 30, so the limit changes nothing
# there; one white pixel on black reaches 94, which would give NaN.
_MAX_LOGIT: Final = 80.0

# Block -> stride of its first convolution and of each next one.
_STRIDES: Final[dict[str, tuple[int, ...]]] = {
    "block1": (1, 2, 1, 2),
    "block2": (1, 1),
    "block3": (2, 1, 1),
    "block4": (2, 1, 1),
    "block5": (2, 1, 1, 1),
    "block_fusion": (1, 1),
    "heatmap_head": (1, 1),
    "keypoint_head": (1, 1, 1),
}


class XFeatWriter(OnnxWriter):
    """With the steps that XFeat is made of."""

    def __init__(self, weights: Mapping[str, npt.NDArray[Any]]) -> None:
        super().__init__(weights, "XFeat")

    def conv(
        self,
        x: str,
        name: str,
        kernel: Float32Array,
        bias: npt.NDArray[np.float64],
        *,
        stride: int,
        relu: bool,
    ) -> str:
        pad = kernel.shape[-1] // 2
        inputs = [
            x,
            self.constant(f"{name}.w", kernel, np.float32),
            self.constant(f"{name}.b", bias, np.float32),
        ]
        y = self.node(
            "Conv",
            inputs,
            name,
            kernel_shape=list(kernel.shape[2:]),
            strides=[stride, stride],
            pads=[pad] * 4,
        )
        return self.node("Relu", [y], f"{name}.relu") if relu else y

    def block(self, x: str, name: str) -> str:
        """Convolution, batch normalisation without own scale and shift, ReLU; as many as the block has."""
        for index, stride in enumerate(_STRIDES[name]):
            layer = f"{name}.{index}.layer"
            gain = 1.0 / np.sqrt(self.weight(f"{layer}.1.running_var") + BATCH_NORM_EPSILON)
            kernel = self.weight(f"{layer}.0.weight") * gain[:, None, None, None]
            bias = -self.weight(f"{layer}.1.running_mean") * gain
            x = self.conv(x, f"{name}.{index}", kernel.astype(np.float32), bias, stride=stride, relu=True)
        return x

    def plain_conv(self, x: str, name: str) -> str:
        kernel = self.weight(f"{name}.weight").astype(np.float32)
        return self.conv(x, name, kernel, self.weight(f"{name}.bias"), stride=1, relu=False)

    def enlarge(self, x: str, factor: int) -> str:
        """Bilinear with corners kept; a fixed factor does because H and W are multiples of 32."""
        scales = self.constant(f"scales{factor}", [1, 1, factor, factor], np.float32)
        return self.node(
            "Resize",
            [x, "", scales],
            f"{x}.x{factor}",
            mode="linear",
            coordinate_transformation_mode="half_pixel",
        )


def write_backbone(w: XFeatWriter) -> str:
    """From the normalised image to the map of 64 numbers per cell, not yet of unit length."""
    pooled = w.node("AveragePool", [INPUT], "skip1.0", kernel_shape=[4, 4], strides=[4, 4])
    skip = w.plain_conv(pooled, "skip1.1")
    quarter = w.block(w.node("Add", [w.block(INPUT, "block1"), skip], "skip_joined"), "block2")
    eighth = w.block(quarter, "block3")
    sixteenth = w.block(eighth, "block4")
    thirtysecond = w.block(sixteenth, "block5")
    pyramid = w.node("Add", [eighth, w.enlarge(sixteenth, 2)], "pyramid16")
    pyramid = w.node("Add", [pyramid, w.enlarge(thirtysecond, 4)], "pyramid32")
    return w.plain_conv(w.block(pyramid, "block_fusion"), "block_fusion.2")


def write_reliability(w: XFeatWriter, fused: str) -> None:
    """The output ``reliability`` of the map that `write_backbone` gives."""
    logit = w.plain_conv(w.block(fused, "heatmap_head"), "heatmap_head.2")
    w.node("Sigmoid", [logit], "reliability")


def _write_sparse(w: XFeatWriter) -> None:
    fused = write_backbone(w)
    axis = w.constant("channel_axis", [1], np.int64)
    length = w.node("ReduceL2", [fused, axis], "length", keepdims=1)
    length = w.node("Max", [length, w.constant("tiny", 1e-12, np.float32)], "length_floor")
    w.node("Div", [fused, length], "features")
    write_reliability(w, fused)

    # 65 logits per 8x8 cell: 64 pixels in row order and "no keypoint here". Softmax over them, last one
    # dropped. Written out because the runtime's Softmax over axis 1 transposes: 2 ms slower at 640 (shared notes).
    cells = w.node("SpaceToDepth", [INPUT], "cells", blocksize=_CELL)
    logits = w.plain_conv(w.block(cells, "keypoint_head"), "keypoint_head.3")
    limited = w.node("Min", [logits, w.constant("max_logit", _MAX_LOGIT, np.float32)], "logits_limited")
    mass = w.node("Exp", [limited], "mass")
    total = w.node("ReduceSum", [mass, axis], "mass_total", keepdims=1)
    begin, end = w.constant("first", [0], np.int64), w.constant("pixels", [_CELL * _CELL], np.int64)
    share = w.node("Div", [w.node("Slice", [mass, begin, end, axis], "mass_pixels"), total], "share")
    w.node("DepthToSpace", [share], "heat", blocksize=_CELL, mode="DCR")


def xfeat_onnx(weights: Mapping[str, npt.NDArray[Any]], source: str) -> bytes:
    """The graph as ONNX bytes; the same weights and ``onnx`` version give the same bytes.

    Input ``normalised`` (1, 1, H, W) float32 grey of mean 0 and variance 1, H and W multiples of 32.
    Outputs ``features`` (1, 64, H/8, W/8) unit length per cell, ``heat`` (1, 1, H, W) keypoint probability,
    ``reliability`` (1, 1, H/8, W/8) in 0..1.

    Args:
        weights: the checkpoint's tensors by name.
        source: written into the file, says where the weights are from.
    Raises: ModelError if the weights are not XFeat's.
    """
    writer = XFeatWriter(weights)
    _write_sparse(writer)
    outputs: dict[str, Shape] = {
        "features": [1, 64, "H8", "W8"],
        "heat": [1, 1, "H", "W"],
        "reliability": [1, 1, "H8", "W8"],
    }
    return writer.model("xfeat", source, {INPUT: [1, 1, "H", "W"]}, outputs)
