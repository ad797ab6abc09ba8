"""SIFT with RootSIFT descriptors: needs no weights, turns with the image, and serves where XFeat can't be built."""

from __future__ import annotations

import copy
from typing import Final

import cv2
import numpy as np

from ortholoc_edge.geometry.arrays import BoolArray, ImageArray
from ortholoc_edge.matching.nearest import mutual_nearest
from ortholoc_edge.matching.types import Features, Matches
from ortholoc_edge.matching.working_image import MIN_SIDE_PX, reduced_size, shrunk_image

_DESCRIPTOR: Final = 128
_ANY_COSINE: Final = -1.0
# OpenCV's default, 0.04, is absolute, and a soft orthophoto brought down to 640 px keeps 199 keypoints of
# it. Right matches (5 px of the truth) on the samples seneca, caliterra, demo, copr at 640 px: 3, 103, 43,
# 75 at 0.04; 85, 369, 58, 350 at 0.02; 85, 954, 58, 562 at 0.01; 83, 970, 58, 657 at 0.005.
_CONTRAST: Final = 0.01


class SiftMatcher:
    """SIFT, RootSIFT (Arandjelovic and Zisserman 2012), Lowe's ratio test and mutual nearest neighbours.

    Args:
        working_px: long side that larger images are brought down to. Smaller ones stay: SIFT has a scale
            space of its own and gains nothing from enlarged pixels.
        max_keypoints: kept per image, strongest first.
        ratio: nearest to second nearest distance at most; 0.8 is Lowe's (2004).
    Raises: ValueError for an unusable number.
    """

    def __init__(self, working_px: int = 640, max_keypoints: int = 4096, ratio: float = 0.8) -> None:
        if working_px < MIN_SIDE_PX or max_keypoints < 1 or not 0 < ratio <= 1:
            raise ValueError(
                f"SIFT: working_px {working_px} must be {MIN_SIDE_PX} or more, "
                f"max_keypoints {max_keypoints} at least 1, ratio {ratio} in (0, 1]"
            )
        self.name = "sift"
        self.model_sha256: str | None = None
        self.working_px = working_px
        self._max_keypoints = max_keypoints
        self._ratio = ratio

    def reduced(self, scale: float) -> SiftMatcher:
        """See `ReducibleMatcher`."""
        other = copy.copy(self)
        other.working_px, other._max_keypoints = reduced_size(self.working_px, self._max_keypoints, scale)
        return other

    def extract(self, image: ImageArray, valid: BoolArray | None = None) -> Features:
        """Features of ``image`` (H, W) uint8 grey; none within 8 working pixels of where ``valid`` is False.

        An image that is tiny, constant or invalid throughout has no features, which is no error.
        Raises: ValueError if image or mask have another type or shape.
        """
        work = shrunk_image(image, valid, self.working_px)
        if work is None:
            return Features.none(_DESCRIPTOR)
        # Without enable_precise_upscale keypoints are a quarter pixel off (seen on the recorded samples). A
        # detector per call: OpenCV does not promise that one may serve two threads.
        detector = cv2.SIFT.create(
            nfeatures=self._max_keypoints, contrastThreshold=_CONTRAST, enable_precise_upscale=True
        )
        keypoints, raw = detector.detectAndCompute(work.image, None)
        if not keypoints:
            return Features.none(_DESCRIPTOR)
        pixels = np.array([keypoint.pt for keypoint in keypoints], dtype=np.float64)
        scores = np.array([keypoint.response for keypoint in keypoints], dtype=np.float32)
        # OpenCV keeps more than asked for where the last ones tie.
        order = work.strongest(pixels, scores, self._max_keypoints)
        # RootSIFT: the root of the L1-normalised histogram is of unit length.
        histograms = raw[order]
        sums = np.maximum(histograms.sum(axis=1, keepdims=True), np.float32(1e-12))
        return Features(work.original_px(pixels[order]), scores[order], np.sqrt(histograms / sums))

    def match(self, query: Features, reference: Features) -> Matches:
        """Mutual nearest neighbours that pass the ratio test; ``confidence`` None, a ratio is no probability."""
        i, j = mutual_nearest(query.descriptors, reference.descriptors, _ANY_COSINE, self._ratio)
        return Matches(query.keypoints_px[i], reference.keypoints_px[j])
