"""Writes ALIKED as ONNX graphs from its published weights; no torch.

Network: Zhao et al., "ALIKED: A Lighter Keypoint and Descriptor Extraction Network via Deformable Transformation",
IEEE TIM 2023 (code and weights BSD-3-Clause). Two graphs, since what lies between them, the choice of keypoints, is
done in numpy: the picture's features and scores, and the descriptors of chosen places, each of which looks at 16 places
around it that it finds itself. Structure, strides and orders that names and shapes leave open follow the published code
and are proven by stored references (`models.verify`).

What is changed, none of which alters the function for a grey picture: the three equal colour channels become one, the
batch normalisations are folded into the convolutions, and sizes are multiples of 32, so that nothing is padded.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from ortholoc_edge.geometry.arrays import FloatArray
from ortholoc_edge.matching.onnx_writer import BATCH_NORM_EPSILON, OnnxWriter

INPUT: Final = "grey"
FEATURES: Final = "features"
SCORES: Final = "scores"
PIXELS: Final = "pixels"
CELLS: Final = "cells"
DESCRIPTORS: Final = "descriptors"

# Per level: whether its convolutions are deformable, and the pooling before it.
_LEVELS: Final = ((False, 1), (False, 2), (True, 4), (True, 4))
_ENLARGED: Final = (1, 2, 8, 32)
_SCORE_LAYERS: Final = (0, 2, 4, 6)
_TINY: Final = 1e-12  # torch's, in normalising


class _Writer(OnnxWriter):
    def conv(self, x: str, name: str, kernel: FloatArray, bias: FloatArray | None) -> str:
        inputs = [x, self.constant(f"{name}.w", kernel, np.float32)]
        if bias is not None:
            inputs.append(self.constant(f"{name}.b", bias, np.float32))
        pad = kernel.shape[-1] // 2
        return self.node("Conv", inputs, f"{name}.conv", kernel_shape=list(kernel.shape[2:]), pads=[pad] * 4)

    def plain(self, x: str, name: str, bias: bool = False) -> str:
        return self.conv(x, name, self.weight(f"{name}.weight"), self.weight(f"{name}.bias") if bias else None)

    def selu(self, x: str) -> str:
        return self.node("Selu", [x], f"{x}.selu")

    def folded(self, conv: str, norm: str) -> tuple[FloatArray, FloatArray]:
        """Kernel and bias of a convolution without bias, and of the normalisation after it, as one."""
        gain = self.weight(f"{norm}.weight") / np.sqrt(self.weight(f"{norm}.running_var") + BATCH_NORM_EPSILON)
        kernel = self.weight(f"{conv}.weight") * gain[:, None, None, None]
        return kernel, self.weight(f"{norm}.bias") - self.weight(f"{norm}.running_mean") * gain

    def deformable(self, x: str, name: str, kernel: FloatArray, bias: FloatArray) -> str:
        limit = self.quarter(x)
        offset = self.plain(x, f"{name}.offset_conv", bias=True)
        inputs = [
            x,
            self.constant(f"{name}.w", kernel, np.float32),
            self.node("Clip", [offset, self.node("Neg", [limit], f"{name}.least"), limit], f"{name}.offset"),
            self.constant(f"{name}.b", bias, np.float32),
        ]
        return self.node("DeformConv", inputs, f"{name}.conv", kernel_shape=[3, 3], pads=[1] * 4)

    def quarter(self, x: str) -> str:
        """A quarter of the long side of a map, the farthest that anything looks."""
        name = f"{x}.quarter"
        if name in self.made:
            return name
        self.made.add(name)
        size = self.node("Shape", [x], f"{x}.size", start=2, end=4)
        longest = self.node("ReduceMax", [size], f"{x}.longest", keepdims=0)
        longest = self.node("Cast", [longest], f"{x}.longest_float", to=1)
        return self.node("Mul", [longest, self.constant("a_quarter", 0.25, np.float32)], name)

    def level(self, x: str, number: int, deformable: bool) -> str:
        """Two convolutions, from the second level on beside a way around them."""
        block = f"block{number}"
        y = x
        for index in (1, 2):
            conv = f"{block}.conv{index}"
            kernel, bias = self.folded(f"{conv}.regular_conv" if deformable else conv, f"{block}.bn{index}")
            if number == 1 and index == 1:
                kernel = kernel.sum(axis=1, keepdims=True)
            y = self.deformable(y, conv, kernel, bias) if deformable else self.conv(y, conv, kernel, bias)
            if index == 1 or number == 1:
                y = self.selu(y)
        if number == 1:
            return y
        around = self.plain(x, f"{block}.downsample", bias=True)
        return self.selu(self.node("Add", [y, around], f"{block}.sum"))

    def unit(self, x: str, axis: int, output: str) -> str:
        length = self.node("ReduceL2", [x, self.constant("axis", [axis], np.int64)], f"{output}.length", keepdims=1)
        length = self.node("Max", [length, self.constant("tiny", _TINY, np.float32)], f"{output}.length_floor")
        return self.node("Div", [x, length], output)

    def __init__(self, weights: Mapping[str, npt.NDArray[Any]]) -> None:
        super().__init__(weights, "ALIKED")
        self.made: set[str] = set()


def aliked_onnx(weights: Mapping[str, npt.NDArray[Any]], source: str) -> bytes:
    """The picture's graph as ONNX bytes.

    Input ``grey`` (1, 1, H, W) float32 in 0..1, H and W multiples of 32. Outputs ``features`` (1, 128, H, W) of unit
    length and ``scores`` (1, 1, H, W) in 0..1.

    Args:
        weights: the checkpoint's tensors by name.
        source: written into the file, says where the weights are from.
    Raises: ModelError if the weights are not ALIKED's.
    """
    w = _Writer(weights)
    x, maps = INPUT, []
    for number, ((deformable, pool), factor) in enumerate(zip(_LEVELS, _ENLARGED, strict=True), 1):
        if pool > 1:
            x = w.node("AveragePool", [x], f"pool{number}", kernel_shape=[pool] * 2, strides=[pool] * 2)
        x = w.level(x, number, deformable)
        reduced = w.selu(w.plain(x, f"conv{number}"))
        if factor > 1:
            scales = w.constant(f"scales{factor}", [1, 1, factor, factor], np.float32)
            reduced = w.node(
                "Resize", [reduced, "", scales], f"enlarged{number}", mode="linear",
                coordinate_transformation_mode="align_corners",
            )  # fmt: skip
        maps.append(reduced)
    joined = w.node("Concat", maps, "joined", axis=1)
    w.unit(joined, 1, FEATURES)
    score = joined
    for layer in _SCORE_LAYERS:
        score = w.plain(score, f"score_head.{layer}")
        if layer != _SCORE_LAYERS[-1]:
            score = w.selu(score)
    w.node("Sigmoid", [score], SCORES)
    width = sum(w.weight(f"conv{number}.weight").shape[0] for number in range(1, len(_LEVELS) + 1))
    outputs = {FEATURES: (1, width, "H", "W"), SCORES: (1, 1, "H", "W")}
    return w.model("aliked", source, {INPUT: (1, 1, "H", "W")}, outputs)


def aliked_descriptors_onnx(weights: Mapping[str, npt.NDArray[Any]], source: str) -> bytes:
    """The descriptors' graph as ONNX bytes.

    Inputs ``features`` (1, C, H, W) of the picture's graph; ``pixels`` (N, 2), (u, v) of the keypoints; ``cells``
    (N, 9), the 3 x 3 pixels around each, row by row, as whole numbers v W + u. Output ``descriptors`` (N, C) of unit
    length. Args and errors as `aliked_onnx`.
    """
    w = _Writer(weights)
    matrices = w.weight("desc_head.agg_weights")
    places, width, _ = matrices.shape
    size = w.node("Shape", [FEATURES], "size", start=2, end=4)
    # What is around each keypoint tells where to look.
    pixels_last = w.node("Transpose", [FEATURES], "pixels_last", perm=[0, 2, 3, 1])
    rows = w.node("Reshape", [pixels_last, w.constant("rows_shape", [-1, width], np.int64)], "rows")
    index = w.node("Cast", [CELLS], "index", to=7)
    around = w.node("Gather", [rows, index], "around", axis=0)
    around = w.node("Reshape", [around, w.constant("flat", [-1, 9 * width], np.int64)], "around_flat")
    kernel = w.weight("desc_head.offset_conv.0.weight")
    first = [
        around,
        w.constant("offset0.w", kernel.transpose(2, 3, 1, 0).reshape(9 * width, -1), np.float32),
        w.constant("offset0.b", w.weight("desc_head.offset_conv.0.bias"), np.float32),
    ]
    hidden = w.selu(w.node("Gemm", first, "offset0"))
    second = [
        hidden,
        w.constant("offset2.w", w.weight("desc_head.offset_conv.2.weight")[:, :, 0, 0].T, np.float32),
        w.constant("offset2.b", w.weight("desc_head.offset_conv.2.bias"), np.float32),
    ]
    limit = w.quarter(FEATURES)
    offset = w.node("Clip", [w.node("Gemm", second, "offset2"), w.node("Neg", [limit], "least"), limit], "offset")
    # All u before all v.
    offset = w.node("Reshape", [offset, w.constant("pairs", [-1, 2, places], np.int64)], "offset_by_axis")
    offset = w.node("Transpose", [offset], "offset_pairs", perm=[0, 2, 1])
    one = w.constant("middle_axis", [1], np.int64)
    looked = w.node("Add", [w.node("Unsqueeze", [PIXELS, one], "pixels_apart"), offset], "looked_px")
    # To -1..1 between the centres of the first and the last pixel.
    last = w.node("Sub", [size, one], "last")
    last = w.node("Gather", [w.node("Cast", [last], "last_float", to=1), w.constant("uv", [1, 0], np.int64)], "last_uv")
    scaled = w.node("Div", [looked, w.node("Mul", [last, w.constant("half", 0.5, np.float32)], "half_uv")], "scaled")
    grid = w.node("Sub", [scaled, w.constant("whole", 1.0, np.float32)], "normal")
    grid = w.node("Reshape", [grid, w.constant("grid_shape", [1, -1, places, 2], np.int64)], "grid")
    sampled = w.node("GridSample", [FEATURES, grid], "sampled", mode="linear", padding_mode="zeros", align_corners=1)
    # (1, C, N, places) to one row of C numbers per place.
    sampled = w.node("Transpose", [sampled], "sampled_last", perm=[0, 2, 3, 1])
    sampled = w.node("Reshape", [sampled, w.constant("rows_shape", [-1, width], np.int64)], "sampled_rows")
    mixed = w.constant("mix.w", w.weight("desc_head.sf_conv.weight")[:, :, 0, 0].T, np.float32)
    sampled = w.selu(w.node("MatMul", [sampled, mixed], "mixed"))
    sampled = w.node("Reshape", [sampled, w.constant("joined_shape", [-1, places * width], np.int64)], "places_joined")
    joined = w.constant("join.w", matrices.reshape(places * width, -1), np.float32)
    w.unit(w.node("MatMul", [sampled, joined], "raw"), 1, DESCRIPTORS)
    inputs = {FEATURES: (1, width, "H", "W"), PIXELS: ("N", 2), CELLS: ("N", 9)}
    return w.model("aliked-descriptors", source, inputs, {DESCRIPTORS: ("N", matrices.shape[2])})
