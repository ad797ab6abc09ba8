"""What every matcher takes and gives."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np

from ortholoc_edge.geometry.arrays import BoolArray, Float32Array, FloatArray, ImageArray


@dataclass(frozen=True, slots=True, eq=False)
class Features:
    """Local features of one image, in the pixels of the image that was given to ``extract``.

    Attributes:
        keypoints_px: (N, 2) float64, (u, v), pixel centres at integers.
        scores: (N,) float32, higher is better; falls or stays along the array.
        descriptors: (N, D) float32, unit length.
        image_px: (width, height) of the image, for matchers that look at where in it a keypoint is.
        lengths: (N,) float32, of the descriptors before they were made unit, for matchers that take them as they
            were.
        spacing_px: (N, 2) float64, (u, v): pixels of the image per pixel of what the keypoint was found in, for
            matchers that shift keypoints.
    """

    keypoints_px: FloatArray
    scores: Float32Array
    descriptors: Float32Array
    image_px: tuple[int, int] | None = None
    lengths: Float32Array | None = None
    spacing_px: FloatArray | None = None

    @staticmethod
    def none(length: int) -> Features:
        """Of a picture that shows nothing; ``length``: of a descriptor."""
        return Features(np.empty((0, 2)), np.empty(0, np.float32), np.empty((0, length), np.float32))

    def __len__(self) -> int:
        return len(self.keypoints_px)


@dataclass(frozen=True, slots=True, eq=False)
class Matches:
    """N pairs of pixels that show the same place.

    Attributes:
        query_px: (N, 2) float64 in the camera frame's pixels, centres at integers.
        map_px: (N, 2) float64 in the reference image's pixels.
        confidence: (N,) float64 in 0..1, or None where the matcher has no such number.
    """

    query_px: FloatArray
    map_px: FloatArray
    confidence: FloatArray | None = None

    def __post_init__(self) -> None:
        if self.query_px.shape != self.map_px.shape or self.query_px.shape[1:] != (2,):
            raise ValueError(f"matches: shapes {self.query_px.shape} and {self.map_px.shape} do not pair")

    def __len__(self) -> int:
        return len(self.query_px)

    def take(self, kept: np.ndarray) -> Matches:
        """The pairs at indices (or under a mask) ``kept``."""
        return Matches(
            self.query_px[kept],
            self.map_px[kept],
            None if self.confidence is None else self.confidence[kept],
        )


class Matcher(Protocol):
    """A matcher of local features. Extraction and matching are apart, so that AdHoP's second round and
    the four rotations reuse the query's features.

    Attributes:
        name: as in ``--matcher``.
        model_sha256: hash of the graph that runs (of several: see `models.joint_sha256`), None for a matcher
            without weights.
        working_px: the long side, in pixels, that images are brought to inside ``extract``; coordinates come
            back in the pixels of the image that was given.
    """

    name: str
    model_sha256: str | None
    working_px: int

    def extract(self, image: ImageArray, valid: BoolArray | None = None) -> Features:
        """Features of ``image``, (H, W) uint8 grey. ``valid`` (H, W): no feature where it is False."""
        ...

    def match(self, query: Features, reference: Features) -> Matches:
        """Mutual matches between two sets of features."""
        ...


@runtime_checkable
class UnscaledMatcher(Matcher, Protocol):
    """A matcher that also takes pictures at their own scale, whatever their size."""

    def extract_unscaled(self, image: ImageArray, valid: BoolArray | None = None) -> Features:
        """As `extract`, with nothing resized."""
        ...


@runtime_checkable
class ReducibleMatcher(Matcher, Protocol):
    """A matcher whose resolution can be chosen."""

    def reduced(self, scale: float) -> Matcher:
        """The same at so much of its ``working_px``, as near as its network allows, and of its keypoints in proportion
        to the area. Networks are shared: it takes no memory."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class Structural:
    """Not local features, but the edges of the whole picture against the map drawn in the predicted view; needs no
    weights, and a predicted pose (`pipeline.structural`).

    Attributes:
        acquire: for frames that it can't place; None: those give no fix.
    """

    acquire: Matcher | None = None

    @property
    def name(self) -> str:
        return STRUCTURAL if self.acquire is None else f"{STRUCTURAL}+{self.acquire.name}"

    @property
    def model_sha256(self) -> str | None:
        return None if self.acquire is None else self.acquire.model_sha256


STRUCTURAL = "structural"
AnyMatcher = Matcher | Structural
