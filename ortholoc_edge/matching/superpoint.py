"""SuperPoint's keypoints and descriptors: one graph on ONNX Runtime, the choice of keypoints in numpy; SuperGlue, which
matches them."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import Final

import cv2
import numpy as np

from ortholoc_edge.geometry.arrays import BoolArray, Float32Array, FloatArray, ImageArray
from ortholoc_edge.matching.exported import ExportedMatcher, StoredGraph
from ortholoc_edge.matching.inference import Inference
from ortholoc_edge.matching.lighterglue import GlueMatcher, mutual_best
from ortholoc_edge.matching.models import joint_sha256
from ortholoc_edge.matching.types import Features, Matcher, Matches
from ortholoc_edge.matching.working_image import check_numbers, reduced_size, working_image

DESCRIPTOR: Final = 256
CELL_PX: Final = 8
# Of the published code: non-maximum suppression over 9 x 9, twice again among what that left out; the rim without
# keypoints.
_SUPPRESSION: Final = np.ones((9, 9), np.uint8)
_MORE_ROUNDS: Final = 2
_RIM_PX: Final = 4
# Least score of a keypoint, and most keypoints, as SuperGlue's and LightGlue's authors have them.
_MIN_SCORE: Final = {"superpoint-superglue": 0.005, "superpoint-lightglue": 0.0005}
_MOST_KEYPOINTS: Final = 2048
# SuperGlue's normalisation: places in 0.7 of the long side.
_PLACES_SCALE: Final = 0.7


class SuperPointExtractor:
    """SuperPoint's features, best first.

    Args:
        graph: its graph.
        model: name of the matcher that it is built for.
        min_score: of a keypoint.
        working_px: long side that images are brought to, a multiple of 8; both sides are rounded to such.
        max_keypoints: kept per image.
        threads: of one inference.
    Raises: ModelError if the graph can't be loaded; ValueError for an unusable number.
    """

    def __init__(
        self,
        graph: StoredGraph,
        *,
        model: str,
        min_score: float,
        working_px: int = 640,
        max_keypoints: int = 2048,
        threads: int = 1,
    ) -> None:
        check_numbers("SuperPoint", CELL_PX, 4 * CELL_PX, working_px, max_keypoints, threads)
        self._min_score = min_score
        self.working_px = working_px
        self._max_keypoints = max_keypoints
        self._inference = Inference(
            graph.path, graph.sha256, threads, what="SuperPoint", model=model, inputs=["picture"],
            outputs=["heat", "descriptors"],
        )  # fmt: skip

    def reduced(self, scale: float) -> SuperPointExtractor:
        """See `ReducibleMatcher`."""
        other = copy.copy(self)
        other.working_px, other._max_keypoints = reduced_size(self.working_px, self._max_keypoints, scale, CELL_PX)
        return other

    def extract(self, image: ImageArray, valid: BoolArray | None = None) -> Features:
        """Features of ``image`` (H, W) uint8 grey, with its size; none within 8 working pixels of where ``valid`` is
        False.

        Raises: ModelError if the inference fails; ValueError if image or mask have another type or shape.
        """
        rows, columns = image.shape[:2]
        scale = self.working_px / max(rows, columns, 1)
        width, height = (max(1, round(side * scale / CELL_PX)) * CELL_PX for side in (columns, rows))
        work = working_image(image, valid, width, height)
        pixels, scores = np.empty((0, 2)), np.empty(0, np.float32)
        descriptors = np.empty((0, DESCRIPTOR), np.float32)
        if work is not None:
            feeds = {"picture": (work.image.astype(np.float32) / np.float32(255.0))[None, None]}
            heat, dense = self._inference.run(feeds, f"{width} x {height} px")
            found, scores = keypoints(heat[0, 0], work.usable, self._min_score, self._max_keypoints)
            descriptors = sampled(dense[0], found)
            pixels = work.original_px(found)
        return Features(pixels, scores, descriptors, image_px=(columns, rows))


def keypoints(
    heat: Float32Array, usable: BoolArray | None, min_score: float, most: int
) -> tuple[FloatArray, Float32Array]:
    """The ``most`` best local maxima (N, 2) of a heat map (H, W) above ``min_score``, and their scores, best first."""
    peaks = suppressed(heat)
    peaks[:_RIM_PX] = peaks[-_RIM_PX:] = peaks[:, :_RIM_PX] = peaks[:, -_RIM_PX:] = False
    peaks &= heat > min_score
    if usable is not None:
        peaks &= usable
    v, u = np.nonzero(peaks)
    order = np.argsort(-heat[v, u], kind="stable")[:most]
    v, u = v[order], u[order]
    return np.stack([u, v], axis=1).astype(np.float64), heat[v, u]


def suppressed(heat: Float32Array) -> BoolArray:
    """Which pixels are the greatest around, those around greater ones left out."""
    peaks = heat == cv2.dilate(heat, _SUPPRESSION)
    for _ in range(_MORE_ROUNDS):
        near = cv2.dilate(peaks.astype(np.uint8), _SUPPRESSION) > 0
        rest = np.where(near, np.float32(0.0), heat)
        peaks |= (rest == cv2.dilate(rest, _SUPPRESSION)) & ~near
    return np.asarray(peaks, dtype=np.bool_)


def sampled(dense: Float32Array, pixels: FloatArray) -> Float32Array:
    """Descriptors (N, C) of unit length at ``pixels`` (N, 2) of a map (C, H/8, W/8), bilinear.

    As published: the map's first values lie at 3.5 px and its last at W - 1, not at W - 4.5; zero beyond.
    """
    _, rows, columns = dense.shape
    cells = np.array([columns, rows], dtype=np.float64)
    places = (pixels - (CELL_PX / 2 - 0.5)) / (cells * CELL_PX - CELL_PX / 2 - 0.5) * (cells - 1)
    corner = np.floor(places).astype(np.intp)
    part = (places - corner).astype(np.float32)
    values = np.zeros((len(pixels), len(dense)), np.float32)
    for step_v in (0, 1):
        for step_u in (0, 1):
            u, v = corner[:, 0] + step_u, corner[:, 1] + step_v
            inside = (u >= 0) & (u < columns) & (v >= 0) & (v < rows)
            weight = np.abs(1 - step_u - part[:, 0]) * np.abs(1 - step_v - part[:, 1]) * inside
            at = dense[:, np.clip(v, 0, rows - 1), np.clip(u, 0, columns - 1)].T
            values += weight[:, None] * at
    values /= np.maximum(np.linalg.norm(values, axis=1, keepdims=True), np.float32(1e-12))
    return values


class SuperGlueMatcher:
    """Keeps no state between calls, so one object may serve several threads.

    Args:
        name: of the matcher.
        extractor: of SuperPoint's features.
        extractor_sha256: of its graph.
        graph: SuperGlue's.
        min_confidence: what matches must exceed.
        working_px: of the extractor.
        threads: of one inference.
    Raises: ModelError if the graph can't be loaded.
    """

    def __init__(
        self,
        name: str,
        extractor: SuperPointExtractor,
        extractor_sha256: str,
        graph: StoredGraph,
        *,
        min_confidence: float,
        working_px: int,
        threads: int,
    ) -> None:
        self.name = name
        self.model_sha256: str | None = joint_sha256(extractor_sha256, graph.sha256)
        self.working_px = working_px
        self._min_confidence = min_confidence
        self._extractor = extractor
        self._inputs = [
            f"{side}_{what}" for side in ("query", "reference") for what in ("descriptors", "places", "scores")
        ]
        self._inference = Inference(
            graph.path, graph.sha256, threads, what="SuperGlue", model="superpoint-superglue", inputs=self._inputs,
            outputs=["log_assignment"],
        )  # fmt: skip

    def reduced(self, scale: float) -> SuperGlueMatcher:
        """See `ReducibleMatcher`."""
        other = copy.copy(self)
        other._extractor = self._extractor.reduced(scale)
        other.working_px = other._extractor.working_px
        return other

    def extract(self, image: ImageArray, valid: BoolArray | None = None) -> Features:
        return self._extractor.extract(image, valid)

    def match(self, query: Features, reference: Features) -> Matches:
        """Pairs that are each other's likeliest; ``confidence`` is the network's probability of the pair.

        Raises: ModelError if the inference fails.
        """
        if len(query) == 0 or len(reference) == 0:
            return Matches(np.empty((0, 2)), np.empty((0, 2)), np.empty(0))
        values = [
            value
            for features in (query, reference)
            for value in (features.descriptors, places(features), features.scores)
        ]
        subject = f"{len(query)} and {len(reference)} keypoints"
        logs = self._inference.run(dict(zip(self._inputs, values, strict=True)), subject)[0]
        i, j = mutual_best(logs)
        probability = np.exp(np.minimum(logs[i, j], 0.0)).astype(np.float64)
        kept = probability > self._min_confidence
        return Matches(query.keypoints_px[i[kept]], reference.keypoints_px[j[kept]], probability[kept])


def make_superpoint_matcher(
    name: str, entry: ExportedMatcher, graphs: Sequence[StoredGraph], working_px: int, max_keypoints: int, threads: int
) -> Matcher:
    """With SuperGlue or with LightGlue. Raises: as `SuperPointExtractor`."""
    extraction, matching = graphs
    extractor = SuperPointExtractor(
        extraction, model=entry.name, min_score=_MIN_SCORE[entry.name], working_px=working_px,
        max_keypoints=min(max_keypoints, _MOST_KEYPOINTS), threads=threads,
    )  # fmt: skip
    if entry.name == "superpoint-superglue":
        return SuperGlueMatcher(
            name, extractor, extraction.sha256, matching, min_confidence=entry.min_confidence, working_px=working_px,
            threads=threads,
        )  # fmt: skip
    network = matching.path.read_bytes(), matching.sha256
    return GlueMatcher(name, extractor, [extraction.sha256], network, working_px=working_px, threads=threads)


def places(features: Features) -> Float32Array:
    """Keypoints (N, 2) from the image's middle, in units of 0.7 of its long side, as SuperGlue was trained."""
    if features.image_px is None:
        raise ValueError("SuperGlue: features without the image's size are another matcher's")
    size = np.array(features.image_px, dtype=np.float64)
    around: FloatArray = (features.keypoints_px - size / 2) / (size.max() * _PLACES_SCALE)
    return around.astype(np.float32)
