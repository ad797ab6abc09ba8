"""ORB and AKAZE: binary descriptors, which need no weights and turn with the image; AKAZE where OpenCV has it."""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Any, Final

import cv2
import numpy as np
import numpy.typing as npt

from ortholoc_edge.geometry.arrays import BoolArray, Float32Array, FloatArray, ImageArray
from ortholoc_edge.matching.nearest import mutual_nearest
from ortholoc_edge.matching.types import Features, Matches
from ortholoc_edge.matching.working_image import MIN_SIDE_PX, reduced_size, shrunk_image

_ANY_COSINE: Final = -1.0
# Grey levels. Right matches (5 px of the truth) on the samples seneca, caliterra, demo, copr at 640 px: 18, 206, 56,
# 152 at OpenCV's default of 20; 81, 488, 56, 474 at 10; 99, 510, 55, 510 at 5; 98, 517, 55, 509 at 2.
_FAST_THRESHOLD: Final = 5
_ORB_STEP: Final = 1.2  # from a level to the next, OpenCV's default
# Likewise: 1, 35, 38, 14 right matches at OpenCV's default of 1e-3; 7, 84, 81, 67 at 3e-4; 28, 207, 130, 178 at 1e-4;
# 140, 429, 128, 327 at 3e-5 (opencv-contrib-python-headless 5.0.0.93).
_AKAZE_THRESHOLD: Final = 3e-5


class BinaryMatcher:
    """ORB or AKAZE with Lowe's ratio test on Hamming distances and mutual nearest neighbours.

    A descriptor of D bits is kept as D numbers of +-1 / sqrt(D): of such the cosine is 1 - 2 Hamming / D, so that
    nearest by cosine is nearest by Hamming, and one search serves all matchers.

    The ratio: 0.8 gave 70, 419, 28 and 449 right matches of 96, 463, 81 and 489 on the samples seneca, caliterra, demo
    and copr with ORB; 0.9 gave 99, 510, 55 and 510 of 291, 733, 390 and 654, and it is right ones that are short.

    Args:
        name: "orb" or "akaze".
        working_px: long side that larger images are brought down to.
        max_keypoints: kept per image, strongest first.
        ratio: Hamming distance to the nearest over that to the second nearest, at most.
    Raises: ValueError for an unusable number, or a name that `unavailable` gives a reason for.
    """

    def __init__(self, name: str, working_px: int = 640, max_keypoints: int = 4096, ratio: float = 0.9) -> None:
        reason = unavailable(name)
        if reason is not None:
            raise ValueError(reason)
        if working_px < MIN_SIDE_PX or max_keypoints < 1 or not 0 < ratio <= 1:
            raise ValueError(
                f"{name}: working_px {working_px} must be {MIN_SIDE_PX} or more, max_keypoints {max_keypoints} at "
                f"least 1, ratio {ratio} in (0, 1]"
            )
        self.name = name
        self.model_sha256: str | None = None
        self.working_px = working_px
        self._detector = _DETECTORS[name]
        self._max_keypoints = max_keypoints
        self._ratio = ratio
        self._bits = 8 * int(self._detector(1).descriptorSize())

    def reduced(self, scale: float) -> BinaryMatcher:
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
            return Features.none(self._bits)
        # Per call: OpenCV does not promise that a detector may serve two threads.
        keypoints, packed = self._detector(self._max_keypoints).detectAndCompute(work.image, None)
        if not keypoints:
            return Features.none(self._bits)
        pixels = self._pixels(keypoints, work.image.shape)
        scores = np.array([keypoint.response for keypoint in keypoints], dtype=np.float32)
        order = work.strongest(pixels, scores, self._max_keypoints)
        return Features(work.original_px(pixels[order]), scores[order], _signs(packed[order]))

    def _pixels(self, keypoints: Any, shape: tuple[int, ...]) -> FloatArray:
        """(N, 2) in an image of ``shape`` (rows, columns), pixel centres at integers.

        ORB multiplies a smaller level's pixels by the nominal step between levels. That takes the corner of the first
        pixel for its centre, and overlooks that the level's sides were rounded: up to a pixel on a side of 640.
        """
        pixels = np.array([keypoint.pt for keypoint in keypoints], dtype=np.float64)
        if self.name != "orb":
            return pixels
        nominal = _ORB_STEP ** np.array([keypoint.octave for keypoint in keypoints])[:, None]
        size = np.array(shape[1::-1])
        return (pixels / nominal + 0.5) * (size / np.rint(size / nominal)) - 0.5

    def match(self, query: Features, reference: Features) -> Matches:
        """Mutual nearest neighbours that pass the ratio test; ``confidence`` None, a ratio is no probability."""
        # Of +-1 descriptors the squared Euclidean distance is in proportion to the Hamming distance.
        i, j = mutual_nearest(query.descriptors, reference.descriptors, _ANY_COSINE, float(np.sqrt(self._ratio)))
        return Matches(query.keypoints_px[i], reference.keypoints_px[j])


def unavailable(name: str) -> str | None:
    """Why a matcher can't run here, and what helps; None if it can."""
    if name == "akaze" and _akaze_maker() is None:
        return (
            f"the installed OpenCV {cv2.__version__} has no AKAZE: since version 5 it is in the contrib modules; "
            "`pip uninstall opencv-python-headless`, then `pip install opencv-contrib-python-headless`"
        )
    return None


def _orb(limit: int) -> Any:
    return cv2.ORB.create(nfeatures=limit, scaleFactor=_ORB_STEP, fastThreshold=_FAST_THRESHOLD)


def _akaze(limit: int) -> Any:
    maker = _akaze_maker()
    assert maker is not None, "`unavailable` was asked"
    return maker(threshold=_AKAZE_THRESHOLD, max_points=limit)


def _akaze_maker() -> Callable[..., Any] | None:
    """In OpenCV 4 a part of the main modules, in 5 of ``xfeatures2d``."""
    for place in (cv2, getattr(cv2, "xfeatures2d", None)):
        maker = getattr(place, "AKAZE_create", None)
        if maker is not None:
            return maker  # type: ignore[no-any-return]
    return None


_DETECTORS: Final[dict[str, Callable[[int], Any]]] = {"orb": _orb, "akaze": _akaze}


def _signs(packed: npt.NDArray[np.uint8]) -> Float32Array:
    """Descriptors (N, D / 8) of bits as (N, D) of unit length."""
    bits = np.unpackbits(packed, axis=1).astype(np.float32)
    return np.asarray((2.0 * bits - 1.0) / np.sqrt(np.float32(bits.shape[1])), dtype=np.float32)
