"""ALIKED's keypoints and descriptors: two graphs on ONNX Runtime, the choice of keypoints between them in numpy."""

from __future__ import annotations

import copy
from typing import Final

import cv2
import numpy as np

from ortholoc_edge.geometry.arrays import BoolArray, Float32Array, FloatArray, ImageArray, IntArray
from ortholoc_edge.matching.inference import Inference
from ortholoc_edge.matching.types import Features
from ortholoc_edge.matching.working_image import check_numbers, reduced_size, working_image
from ortholoc_edge.matching.xfeat import MULTIPLE_PX, working_size

DESCRIPTOR: Final = 128
# The published detector's (module DKD): non-maximum suppression over 5 x 5, twice again among what that left out.
_RADIUS: Final = 2
_SUPPRESSION: Final = np.ones((2 * _RADIUS + 1,) * 2, np.uint8)
_MORE_ROUNDS: Final = 2
_TEMPERATURE: Final = 0.1


class AlikedNetwork:
    """The graphs of `models.ALIKED` and `models.ALIKED_DESCRIPTORS` in sessions of their own.

    Args:
        picture, descriptors: each graph and the SHA-256 that it must have.
        threads: of one inference.
    Raises: ModelError if a hash differs or the runtime does not take a graph.
    """

    def __init__(self, picture: tuple[bytes, str], descriptors: tuple[bytes, str], threads: int) -> None:
        self._picture = picture_inference(*picture, threads)
        self._descriptors = descriptor_inference(*descriptors, threads)

    def run(self, grey: ImageArray) -> tuple[Float32Array, Float32Array]:
        """Features (1, 128, H, W) and scores (H, W) of ``grey`` (H, W), sides multiples of 32."""
        features, scores = run_picture(self._picture, grey)
        return features, scores[0, 0]

    def describe(self, features: Float32Array, pixels: FloatArray) -> Float32Array:
        """Descriptors (N, 128) of keypoints (N, 2)."""
        return run_descriptors(self._descriptors, features, pixels)


def picture_inference(graph: bytes, sha256: str, threads: int) -> Inference:
    return Inference(
        graph, sha256, threads, what="ALIKED", model="aliked", inputs=["grey"], outputs=["features", "scores"]
    )


def descriptor_inference(graph: bytes, sha256: str, threads: int) -> Inference:
    return Inference(
        graph,
        sha256,
        threads,
        what="ALIKED descriptor",
        model="aliked-descriptors",
        inputs=["features", "pixels", "cells"],
        outputs=["descriptors"],
    )


def run_picture(inference: Inference, grey: ImageArray) -> list[Float32Array]:
    picture = (grey.astype(np.float32) / np.float32(255.0))[None, None]
    return inference.run({"grey": picture}, f"{grey.shape[1]} x {grey.shape[0]} px")


def run_descriptors(inference: Inference, features: Float32Array, pixels: FloatArray) -> Float32Array:
    _, _, rows, columns = features.shape
    feeds = {
        "features": features,
        "pixels": pixels.astype(np.float32),
        "cells": _cells(pixels, rows, columns).astype(np.float32),
    }
    return inference.run(feeds, f"{len(pixels)} keypoints")[0]


def _cells(pixels: FloatArray, rows: int, columns: int) -> IntArray:
    """The 3 x 3 pixels (N, 9) around keypoints, as ``v columns + u``.

    As the published code has them: around the whole part of the coordinates, and one less than would fit at the right
    and lower rims.
    """
    # Truncated, then as float32: coordinates at a whole pixel must not fall to its neighbour.
    corner = np.trunc(np.trunc(pixels.astype(np.float32)) - 0.5).astype(np.intp)
    corner = np.clip(corner, 0, [columns - 4, rows - 4])
    steps = np.arange(3)
    v, u = corner[:, 1, None, None] + steps[:, None], corner[:, 0, None, None] + steps[None, :]
    return np.asarray((v * columns + u).reshape(len(pixels), 9))


class AlikedExtractor:
    """ALIKED's features, best first.

    Args:
        picture, descriptors: as of `AlikedNetwork`.
        working_px: long side that images are brought to, a multiple of 32; both sides are rounded to such.
        max_keypoints: kept per image.
    Raises: as `AlikedNetwork`; ValueError for an unusable number.
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
        check_numbers("ALIKED", MULTIPLE_PX, 2 * MULTIPLE_PX, working_px, max_keypoints, threads)
        self.working_px = working_px
        self._max_keypoints = max_keypoints
        self._network = AlikedNetwork(picture, descriptors, threads)

    def reduced(self, scale: float) -> AlikedExtractor:
        """See `ReducibleMatcher`."""
        other = copy.copy(self)
        other.working_px, other._max_keypoints = reduced_size(self.working_px, self._max_keypoints, scale, MULTIPLE_PX)
        return other

    def extract(self, image: ImageArray, valid: BoolArray | None = None) -> Features:
        """Features of ``image`` (H, W) uint8 grey; none within 8 working pixels of where ``valid`` is False.

        Raises: ModelError if an inference fails; ValueError if image or mask have another type or shape.
        """
        work = working_image(image, valid, *working_size(image.shape, self.working_px))
        if work is None:
            return Features.none(DESCRIPTOR)
        features, scores = self._network.run(work.image)
        pixels, best = _keypoints(scores, work.usable, self._max_keypoints)
        if len(pixels) == 0:
            return Features.none(DESCRIPTOR)
        return Features(work.original_px(pixels), best, self._network.describe(features, pixels))


def _keypoints(scores: Float32Array, usable: BoolArray | None, limit: int) -> tuple[FloatArray, Float32Array]:
    """The ``limit`` highest local maxima (N, 2), to parts of a pixel, and their scores, best first."""
    peaks = _peaks(scores)
    peaks[:_RADIUS] = peaks[-_RADIUS:] = peaks[:, :_RADIUS] = peaks[:, -_RADIUS:] = False
    if usable is not None:
        peaks &= usable
    v, u = np.nonzero(peaks)
    order = np.argsort(-scores[v, u], kind="stable")[:limit]
    v, u = v[order], u[order]
    steps = np.arange(-_RADIUS, _RADIUS + 1)
    around = scores[v[:, None, None] + steps[:, None], u[:, None, None] + steps[None, :]]
    mass = np.exp((around - around.max(axis=(1, 2), keepdims=True)) / _TEMPERATURE)
    total = mass.sum(axis=(1, 2))
    shift = np.stack([(mass.sum(axis=1) @ steps) / total, (mass.sum(axis=2) @ steps) / total], axis=1)
    return np.asarray(np.stack([u, v], axis=1) + shift, dtype=np.float64), scores[v, u]


def _peaks(scores: Float32Array) -> BoolArray:
    """Which pixels are the greatest around, those around greater ones left out."""
    peaks = scores == cv2.dilate(scores, _SUPPRESSION)
    for _ in range(_MORE_ROUNDS):
        near = cv2.dilate(peaks.astype(np.uint8), _SUPPRESSION) > 0
        rest = np.where(near, np.float32(0.0), scores)
        peaks |= (rest == cv2.dilate(rest, _SUPPRESSION)) & ~near
    return np.asarray(peaks, dtype=np.bool_)
