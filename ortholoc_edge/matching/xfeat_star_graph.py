"""Writes the two networks of XFeat's semi-dense variant (XFeat*) as ONNX graphs; no torch.

Same paper and weights as `xfeat_graph`. One graph gives a descriptor and a reliability per 8x8 cell and leaves the
keypoint head out, which the variant does not use. The other is the fine matcher: from two descriptors, not of unit
length, to one logit per pixel of a cell, which says where in the first image's cell the second's centre is seen
(section 3.3 of the paper). Its batch normalisations are folded into its linear layers.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from ortholoc_edge.matching.onnx_writer import BATCH_NORM_EPSILON, OnnxWriter
from ortholoc_edge.matching.xfeat_graph import INPUT, XFeatWriter, write_backbone, write_reliability

_PAIRS: Final = "pairs"
_LOGITS: Final = "logits"
# Indices of linear layers in the published sequence; after each but the last come batch normalisation and ReLU.
_LINEAR: Final = (0, 3, 6, 9, 12)


def xfeat_star_onnx(weights: Mapping[str, npt.NDArray[Any]], source: str) -> bytes:
    """The extractor as ONNX bytes.

    Input ``normalised`` (1, 1, H, W) float32 grey of mean 0 and variance 1, H and W multiples of 32.
    Outputs ``cells`` (1, 64, H/8, W/8), not of unit length, and ``reliability`` (1, 1, H/8, W/8) in 0..1.

    Args:
        weights: the checkpoint's tensors by name.
        source: written into the file, says where the weights are from.
    Raises: ModelError if the weights are not XFeat's.
    """
    writer = XFeatWriter(weights)
    fused = write_backbone(writer)
    write_reliability(writer, fused)
    writer.node("Identity", [fused], "cells")
    outputs = {"cells": (1, 64, "H8", "W8"), "reliability": (1, 1, "H8", "W8")}
    return writer.model("xfeat-star", source, {INPUT: (1, 1, "H", "W")}, outputs)


def xfeat_star_fine_onnx(weights: Mapping[str, npt.NDArray[Any]], source: str) -> bytes:
    """The fine matcher as ONNX bytes: ``pairs`` (N, 128) float32, the first image's 64 numbers before the
    second's, to ``logits`` (N, 64), one per pixel of an 8x8 cell in row order.

    Args and errors as `xfeat_star_onnx`.
    """
    writer = OnnxWriter(weights, "XFeat*")
    x = _PAIRS
    for index in _LINEAR:
        name = f"fine_matcher.{index}"
        matrix, bias = writer.weight(f"{name}.weight"), writer.weight(f"{name}.bias")
        last = index == _LINEAR[-1]
        if not last:
            norm = f"fine_matcher.{index + 1}"
            gain = 1.0 / np.sqrt(writer.weight(f"{norm}.running_var") + BATCH_NORM_EPSILON)
            matrix, bias = matrix * gain[:, None], (bias - writer.weight(f"{norm}.running_mean")) * gain
        inputs = [
            x,
            writer.constant(f"{name}.w", matrix.T, np.float32),
            writer.constant(f"{name}.b", bias, np.float32),
        ]
        x = writer.node("Gemm", inputs, _LOGITS if last else name)
        if not last:
            x = writer.node("Relu", [x], f"{name}.relu")
    return writer.model("xfeat-star-fine", source, {_PAIRS: ("N", 128)}, {_LOGITS: ("N", 64)})
