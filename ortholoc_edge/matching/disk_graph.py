"""Writes DISK as ONNX graphs from its published weights; no torch.

Network: Tyszkiewicz, Fua, Trulls, "DISK: Learning local features with policy gradient", NeurIPS 2020, the weights that
were trained with depth (code and weights Apache-2.0). A U-Net of five levels; before every convolution but the first
each channel is brought to mean 0 and variance 1 over the picture and its negative part multiplied by a number. Order
and rules that names and shapes leave open follow the published code and are proven by stored references
(`models.verify`).

Its last convolution gives each pixel a descriptor and a score. Four fifths of the network's arithmetic would go into
descriptors that nobody looks at, so there are two graphs: the picture's features and scores, and the descriptors of
chosen pixels, each from the 5 x 5 features around it. The one channel of scores is computed tap by tap, since the
runtime computes convolutions of 16 channels or 1 in the same time. Besides, the three equal colour channels of a grey
picture become one. None of it alters the function.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from ortholoc_edge.geometry.arrays import FloatArray
from ortholoc_edge.matching.onnx_writer import OnnxWriter

INPUT: Final = "grey"
FEATURES: Final = "features"
HEAT: Final = "heat"
CELLS: Final = "cells"
DESCRIPTORS: Final = "descriptors"
DESCRIPTOR: Final = 128

_DOWN: Final = 5
_UP: Final = 4
_EPSILON: Final = 1e-5  # torch's, in the instance normalisation
_TINY: Final = 1e-12  # torch's, in normalising
_LAST: Final = f"path_up.{_UP - 1}.conv.3"


class _Writer(OnnxWriter):
    def __init__(self, weights: Mapping[str, npt.NDArray[Any]]) -> None:
        own = {name.removeprefix("extractor.unet."): values for name, values in weights.items()}
        super().__init__(own, "DISK")

    def conv(self, x: str, name: str, kernel: FloatArray, bias: FloatArray, output: str) -> str:
        inputs = [x, self.constant(f"{name}.w", kernel, np.float32), self.constant(f"{name}.b", bias, np.float32)]
        pad = kernel.shape[-1] // 2
        return self.node("Conv", inputs, output, kernel_shape=list(kernel.shape[2:]), pads=[pad] * 4)

    def one_channel(self, x: str, name: str, kernel: FloatArray, bias: FloatArray, output: str) -> str:
        """`conv` to a single channel: what each tap of the kernel (1, C, h, w) gives everywhere, then the sum of these
        shifted by their taps."""
        _, channels, rows, columns = kernel.shape
        taps = kernel.reshape(channels, rows * columns).T[..., None, None]
        each = self.conv(x, f"{name}.taps", taps, np.zeros(len(taps)), f"{output}.taps")
        shifts = np.eye(len(taps)).reshape(len(taps), 1, rows, columns)
        pads = [rows // 2, columns // 2] * 2
        inputs = [each, self.constant(f"{name}.shifts", shifts, np.float32)]
        size = [rows, columns]
        shifted = self.node("Conv", inputs, f"{output}.shifted", group=len(taps), kernel_shape=size, pads=pads)
        return self.conv(shifted, f"{name}.sum", np.ones((1, len(taps), 1, 1)), bias, output)

    def levelled(self, x: str, name: str, output: str) -> str:
        """Each channel with mean 0 and variance 1 over the picture, then PReLU; ``name`` is that of its slopes."""
        slopes = self.weight(f"{name}.weight")
        one = self.constant(f"one{len(slopes)}", np.ones(len(slopes)), np.float32)
        none = self.constant(f"none{len(slopes)}", np.zeros(len(slopes)), np.float32)
        level = self.node("InstanceNormalization", [x, one, none], f"{name}.norm", epsilon=_EPSILON)
        slope = self.constant(f"{name}.slope", slopes[:, None, None], np.float32)
        return self.node("PRelu", [level, slope], output)


def disk_onnx(weights: Mapping[str, npt.NDArray[Any]], source: str) -> bytes:
    """The picture's graph as ONNX bytes.

    Input ``grey`` (1, 1, H, W) float32 in 0..1, H and W multiples of 16. Outputs ``features`` (1, C, H, W) and
    ``heat`` (1, 1, H, W), higher where a keypoint is better.

    Args:
        weights: the checkpoint's tensors by name.
        source: written into the file, says where the weights are from.
    Raises: ModelError if the weights are not DISK's.
    """
    w = _Writer(weights)
    first = "path_down.0.1.3"
    kernel = w.weight(f"{first}.weight").sum(axis=1, keepdims=True)
    maps = [w.conv(INPUT, first, kernel, w.weight(f"{first}.bias"), f"{first}.conv")]
    for number in range(1, _DOWN):
        block = f"path_down.{number}.1"
        x = w.node("AveragePool", [maps[-1]], f"{block}.half", kernel_shape=[2, 2], strides=[2, 2])
        x = w.levelled(x, f"{block}.1", f"{block}.levelled")
        maps.append(
            w.conv(x, f"{block}.3", w.weight(f"{block}.3.weight"), w.weight(f"{block}.3.bias"), f"{block}.conv")
        )
    x = maps.pop()
    scales = w.constant("scales", [1, 1, 2, 2], np.float32)
    for number in range(_UP):
        block = f"path_up.{number}.conv"
        x = w.node(
            "Resize", [x, "", scales], f"{block}.twice", mode="linear", coordinate_transformation_mode="half_pixel"
        )
        beside = w.node("Concat", [x, maps.pop()], f"{block}.beside", axis=1)
        kernel, bias = w.weight(f"{block}.3.weight"), w.weight(f"{block}.3.bias")
        if number < _UP - 1:
            level = w.levelled(beside, f"{block}.1", f"{block}.levelled")
            x = w.conv(level, f"{block}.3", kernel, bias, f"{block}.conv")
        else:
            w.levelled(beside, f"{block}.1", FEATURES)
            w.one_channel(FEATURES, f"{block}.3", kernel[DESCRIPTOR:], bias[DESCRIPTOR:], HEAT)
    width = w.weight(f"{_LAST}.weight").shape[1]
    return w.model(
        "disk", source, {INPUT: (1, 1, "H", "W")}, {FEATURES: (1, width, "H", "W"), HEAT: (1, 1, "H", "W")}
    )


def disk_descriptors_onnx(weights: Mapping[str, npt.NDArray[Any]], source: str) -> bytes:
    """The descriptors' graph as ONNX bytes.

    Inputs ``features`` (1, C, H, W) of the picture's graph; ``cells`` (N, 25), the 5 x 5 pixels around each keypoint,
    row by row, as whole numbers v W + u. Output ``descriptors`` (N, 128) of unit length. Args and errors as
    `disk_onnx`.
    """
    w = _Writer(weights)
    kernel = w.weight(f"{_LAST}.weight")[:DESCRIPTOR]
    _, width, rows, columns = kernel.shape
    pixels = w.node("Reshape", [FEATURES, w.constant("pixels_shape", [width, -1], np.int64)], "pixels")
    around = w.node("Gather", [pixels, w.node("Cast", [CELLS], "index", to=7)], "around", axis=1)
    around = w.node("Transpose", [around], "around_apart", perm=[1, 0, 2])
    around = w.node("Reshape", [around, w.constant("flat", [-1, width * rows * columns], np.int64)], "around_flat")
    matrix = w.constant("last.w", kernel.reshape(DESCRIPTOR, -1).T, np.float32)
    bias = w.constant("last.b", w.weight(f"{_LAST}.bias")[:DESCRIPTOR], np.float32)
    raw = w.node("Gemm", [around, matrix, bias], "raw")
    length = w.node("ReduceL2", [raw, w.constant("axis", [1], np.int64)], "length", keepdims=1)
    length = w.node("Max", [length, w.constant("tiny", _TINY, np.float32)], "length_floor")
    w.node("Div", [raw, length], DESCRIPTORS)
    inputs = {FEATURES: (1, width, "H", "W"), CELLS: ("N", rows * columns)}
    return w.model("disk-descriptors", source, inputs, {DESCRIPTORS: ("N", DESCRIPTOR)})
