"""DISK's keypoints and descriptors: two graphs on ONNX Runtime, the choice of keypoints between them in numpy."""

from __future__ import annotations

import copy
from typing import Final

import cv2
import numpy as np

from ortholoc_edge.geometry.arrays import BoolArray, Float32Array, ImageArray, IntArray
from ortholoc_edge.matching.inference import Inference
from ortholoc_edge.matching.types import Features
from ortholoc_edge.matching.working_image import WorkingImage, check_numbers, reduced_size, working_image
from ortholoc_edge.matching.xfeat import parabola_offsets, working_size

DESCRIPTOR: Final = 128
MULTIPLE_PX: Final = 16  # the coarsest level of the network is at 1/16
# The published detector's (`kornia.feature.DISK`, as LightGlue's authors call it): greater than all else in 5 x 5
# pixels, none at the rim, heat above 0.
_RADIUS: Final = 2
_OTHERS: Final = np.ones((2 * _RADIUS + 1,) * 2, np.uint8)
_OTHERS[_RADIUS, _RADIUS] = 0


class DiskNetwork:
    """The graphs of `models.DISK` and `models.DISK_DESCRIPTORS` in sessions of their own.

    Args:
        picture, descriptors: each graph and the SHA-256 that it must have.
        threads: of one inference.
    Raises: ModelError if a hash differs or the runtime does not take a graph.
    """

    def __init__(self, picture: tuple[bytes, str], descriptors: tuple[bytes, str], threads: int) -> None:
        self._picture = picture_inference(*picture, threads)
        self._descriptors = descriptor_inference(*descriptors, threads)

    def run(self, grey: ImageArray) -> tuple[Float32Array, Float32Array]:
        """Features (1, C, H, W) and heat (H, W) of ``grey`` (H, W), sides multiples of 16."""
        features, heat = run_picture(self._picture, grey)
        return features, heat[0, 0]

    def describe(self, features: Float32Array, pixels: IntArray) -> Float32Array:
        """Descriptors (N, 128) of keypoints (N, 2), 2 pixels or more from the rim."""
        return run_descriptors(self._descriptors, features, pixels)


def picture_inference(graph: bytes, sha256: str, threads: int) -> Inference:
    return Inference(graph, sha256, threads, what="DISK", model="disk", inputs=["grey"], outputs=["features", "heat"])


def descriptor_inference(graph: bytes, sha256: str, threads: int) -> Inference:
    return Inference(
        graph,
        sha256,
        threads,
        what="DISK descriptor",
        model="disk-descriptors",
        inputs=["features", "cells"],
        outputs=["descriptors"],
    )


def run_picture(inference: Inference, grey: ImageArray) -> list[Float32Array]:
    picture = (grey.astype(np.float32) / np.float32(255.0))[None, None]
    return inference.run({"grey": picture}, f"{grey.shape[1]} x {grey.shape[0]} px")


def run_descriptors(inference: Inference, features: Float32Array, pixels: IntArray) -> Float32Array:
    steps = np.arange(-_RADIUS, _RADIUS + 1)
    v, u = pixels[:, 1, None, None] + steps[:, None], pixels[:, 0, None, None] + steps[None, :]
    # As float32, which counts whole pixels up to 16 million.
    cells = (v * features.shape[3] + u).reshape(len(pixels), -1).astype(np.float32)
    return inference.run({"features": features, "cells": cells}, f"{len(pixels)} keypoints")[0]


class DiskExtractor:
    """DISK's features, best first.

    Args:
        picture, descriptors: as of `DiskNetwork`.
        working_px: long side that images are brought to, a multiple of 16; both sides are rounded to such.
        max_keypoints: kept per image.
    Raises: as `DiskNetwork`; ValueError for an unusable number.
    """

    def __init__(
        self,
        picture: tuple[bytes, str],
        descriptors: tuple[bytes, str],
        *,
        working_px: int = 640,
        max_keypoints: int = 1024,
        threads: int = 1,
    ) -> None:
        check_numbers("DISK", MULTIPLE_PX, 2 * MULTIPLE_PX, working_px, max_keypoints, threads)
        self.working_px = working_px
        self._max_keypoints = max_keypoints
        self._network = DiskNetwork(picture, descriptors, threads)

    def reduced(self, scale: float) -> DiskExtractor:
        """See `ReducibleMatcher`."""
        other = copy.copy(self)
        other.working_px, other._max_keypoints = reduced_size(self.working_px, self._max_keypoints, scale, MULTIPLE_PX)
        return other

    def extract(self, image: ImageArray, valid: BoolArray | None = None) -> Features:
        """Features of ``image`` (H, W) uint8 grey; none within 8 working pixels of where ``valid`` is False.

        Descriptors are those of whole pixels, as published; keypoints are moved by up to half a pixel, which is not in
        the published detector: on four recorded photos at 640 of 1024 px it takes the median error of right matches
        from 0.97, 1.13, 0.91 and 1.60 to 0.82, 0.97, 0.76 and 1.35 px.
        Raises: ModelError if an inference fails; ValueError if image or mask have another type or shape.
        """
        work = working_image(image, valid, *working_size(image.shape, self.working_px, MULTIPLE_PX))
        if work is None:
            return Features.none(DESCRIPTOR)
        features, heat = self._network.run(work.image)
        pixels, best = _keypoints(heat, work, self._max_keypoints)
        if len(pixels) == 0:
            return Features.none(DESCRIPTOR)
        refined = pixels + parabola_offsets(heat, pixels[:, 1], pixels[:, 0])
        return Features(work.original_px(refined), best, self._network.describe(features, pixels))


def _keypoints(heat: Float32Array, work: WorkingImage, limit: int) -> tuple[IntArray, Float32Array]:
    """The ``limit`` highest local maxima (N, 2) and their heat, best first."""
    peaks = (heat > 0) & (heat > cv2.dilate(heat, _OTHERS))
    peaks[:_RADIUS] = peaks[-_RADIUS:] = peaks[:, :_RADIUS] = peaks[:, -_RADIUS:] = False
    v, u = np.nonzero(peaks)
    kept = work.strongest(np.stack([u, v], axis=1).astype(np.float64), heat[v, u], limit)
    return np.stack([u[kept], v[kept]], axis=1), heat[v[kept], u[kept]]
