"""DeDoDe: one graph says where keypoints are, another describes them; their choice and matching in numpy."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import cv2
import numpy as np

from ortholoc_edge.geometry.arrays import BoolArray, Float32Array, FloatArray, ImageArray, IntArray
from ortholoc_edge.matching.exported import StoredGraph
from ortholoc_edge.matching.inference import Inference
from ortholoc_edge.matching.lighterglue import mutual_best
from ortholoc_edge.matching.models import joint_sha256
from ortholoc_edge.matching.types import Features, Matches
from ortholoc_edge.matching.working_image import working_image

DESCRIPTOR: Final = 256
# Of the published code (`sample_keypoints`): probability is divided by the root of its density around, by a Gaussian of
# 51 px, so that keypoints cover the picture.
_WINDOW_PX: Final = 51
_DENSITY_SCALE: Final = 10000.0
# Of its dual-softmax matcher, as the paper sets it.
_INVERSE_TEMPERATURE: Final = 20.0


class DedodeMatcher:
    """Keeps no state between calls, so one object may serve several threads.

    Args:
        name: of the matcher.
        graphs: detector's and descriptor's.
        min_confidence: what the product of both softmaxes of a pair must exceed.
        max_keypoints: kept per image.
        threads: of one inference.
    Raises: ModelError if a graph can't be loaded; ValueError for an unusable number.
    """

    def __init__(
        self, name: str, graphs: Sequence[StoredGraph], *, min_confidence: float, max_keypoints: int, threads: int
    ) -> None:
        if max_keypoints < 1 or threads < 1:
            raise ValueError(f"DeDoDe: max_keypoints {max_keypoints} and threads {threads} must be at least 1")
        detector, descriptor = graphs
        self.name = name
        self.model_sha256: str | None = joint_sha256(detector.sha256, descriptor.sha256)
        self._min_confidence = min_confidence
        self._max_keypoints = max_keypoints
        self._detector = Inference(
            detector.path, detector.sha256, threads, what="DeDoDe detector", model="dedode", inputs=["picture"],
            outputs=["heat"],
        )  # fmt: skip
        self._descriptor = Inference(
            descriptor.path, descriptor.sha256, threads, what="DeDoDe descriptor", model="dedode",
            inputs=["picture", "keypoints"], outputs=["descriptors"],
        )  # fmt: skip
        _, _, rows, columns = self._detector.input_shapes["picture"]
        self._size = int(columns), int(rows)
        self.working_px = max(self._size)

    def extract(self, image: ImageArray, valid: BoolArray | None = None) -> Features:
        """Features of ``image`` (H, W) uint8 grey, best first; none within 8 working pixels of where ``valid`` is
        False.

        Raises: ModelError if an inference fails; ValueError if image or mask have another type or shape.
        """
        work = working_image(image, valid, *self._size)
        if work is not None:
            picture = (work.image.astype(np.float32) / np.float32(255.0))[None, None]
            width, height = self._size
            heat = self._detector.run({"picture": picture}, f"{width} x {height} px")[0]
            found, scores = chosen(heat[0, 0], work.usable, self._max_keypoints)
            if len(found):
                feeds = {"picture": picture, "keypoints": found.astype(np.float32)}
                descriptors = self._descriptor.run(feeds, f"{len(found)} keypoints")[0]
                return Features(work.original_px(found), scores, descriptors)
        return Features.none(DESCRIPTOR)

    def match(self, query: Features, reference: Features) -> Matches:
        """Pairs that are each other's likeliest. ``confidence`` None: the product of softmaxes is small for right
        pairs, too, where the picture repeats itself."""
        if len(query) == 0 or len(reference) == 0:
            return Matches(np.empty((0, 2)), np.empty((0, 2)))
        i, j = dual_softmax(query.descriptors, reference.descriptors, self._min_confidence)
        return Matches(query.keypoints_px[i], reference.keypoints_px[j])


def chosen(heat: Float32Array, usable: BoolArray | None, most: int) -> tuple[FloatArray, Float32Array]:
    """The ``most`` best pixels (N, 2) of a map of logits (H, W), and their scores, best first."""
    share = np.exp(heat - heat.max())
    share /= share.sum()
    window = np.exp(-(np.linspace(-2.0, 2.0, _WINDOW_PX, dtype=np.float32) ** 2))
    density = cv2.sepFilter2D(
        (share + np.float32(1e-6)) * np.float32(_DENSITY_SCALE), cv2.CV_32F, window, window,
        borderType=cv2.BORDER_CONSTANT,
    )  # fmt: skip
    scores = share / np.sqrt(density + np.float32(1e-8))
    if usable is not None:
        scores = np.where(usable, scores, np.float32(0.0))
    v, u = np.nonzero(scores > 0)
    order = np.argsort(-scores[v, u], kind="stable")[:most]
    v, u = v[order], u[order]
    return np.stack([u, v], axis=1).astype(np.float64), scores[v, u]


def dual_softmax(query: Float32Array, reference: Float32Array, min_product: float) -> tuple[IntArray, IntArray]:
    """Pairs of unit rows that are each other's likeliest, by the product of both softmaxes of their cosines."""
    logits = (query @ reference.T) * np.float32(_INVERSE_TEMPERATURE)
    # No cosine exceeds 1, so nothing overflows.
    mass = np.exp(logits - np.float32(_INVERSE_TEMPERATURE))
    product = (mass / mass.sum(axis=1, keepdims=True)) * (mass / mass.sum(axis=0, keepdims=True))
    i, j = mutual_best(product)
    kept = product[i, j] > min_product
    return i[kept], j[kept]
