"""Keypoints matched by LightGlue, a transformer that looks at all of both images' at once, or by its smaller kin."""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Mapping, Sequence
from typing import Final, Protocol

import numpy as np

from ortholoc_edge.geometry.arrays import BoolArray, Float32Array, FloatArray, ImageArray, IntArray
from ortholoc_edge.matching.aliked import AlikedExtractor
from ortholoc_edge.matching.disk import DiskExtractor
from ortholoc_edge.matching.inference import Inference
from ortholoc_edge.matching.models import joint_sha256
from ortholoc_edge.matching.types import Features, Matches
from ortholoc_edge.matching.xfeat import XFeatMatcher

_INPUTS: Final = ("query_descriptors", "query_places", "reference_descriptors", "reference_places")

# The network's time grows with the square of the keypoints: 67, 226 and 807 ms of CPU for 512, 1024 and 2048 on both
# sides (2 vCPU EPYC, one thread). On 100 generated photos of another season than the map's, dead reckoning, 1024 put
# 49 % within 1 m and 1 degree at 0.8 s of CPU a frame, 2048 58 % at 2.3 s: too slow to fly with.
MOST_KEYPOINTS: Final = 1024
# Published filter (modules/lighterglue.py).
_MIN_PROBABILITY: Final = 0.1


class GlueNetwork:
    """A graph of `lighterglue_graph`, that of ``model``, in a session of its own. Args and errors as of `Inference`."""

    def __init__(self, graph: bytes, sha256: str, threads: int, model: str) -> None:
        self._inference = Inference(
            graph,
            sha256,
            threads,
            what="LighterGlue" if model == "xfeat-lighterglue" else "LightGlue",
            model=model,
            inputs=_INPUTS,
            outputs=["log_assignment"],
        )

    def run(self, inputs: Mapping[str, Float32Array]) -> Float32Array:
        """Log of the probability (M, N) that two keypoints are a pair; ``inputs`` as `lighterglue_graph` names them.

        Raises: ModelError if the runtime fails.
        """
        counts = [len(inputs[name]) for name in _INPUTS[::2]]
        return self._inference.run(inputs, f"{counts[0]} and {counts[1]} keypoints")[0]


class Extractor(Protocol):
    """Of a matcher's features."""

    working_px: int

    def reduced(self, scale: float) -> Extractor: ...

    def extract(self, image: ImageArray, valid: BoolArray | None = None) -> Features: ...


class GlueMatcher:
    """Keeps no state between calls, so one object may serve several threads.

    Args:
        name: of the matcher and of the network's model.
        extractor: of the features that the network was trained for; it has ``hashes``.
        network: its graph and the SHA-256 that it must have.
        working_px: of the extractor.
        threads: of one inference.
    Raises: ModelError if the graph's hash differs or it can't be loaded.
    """

    def __init__(
        self,
        name: str,
        extractor: Extractor,
        hashes: Sequence[str],
        network: tuple[bytes, str],
        *,
        working_px: int,
        threads: int,
    ) -> None:
        self.name = name
        self.model_sha256: str | None = joint_sha256(*hashes, network[1])
        self.working_px = working_px
        self._extractor = extractor
        self._network = GlueNetwork(*network, threads, name)

    def reduced(self, scale: float) -> GlueMatcher:
        """See `ReducibleMatcher`."""
        other = copy.copy(self)
        other._extractor = self._extractor.reduced(scale)
        other.working_px = other._extractor.working_px
        return other

    def extract(self, image: ImageArray, valid: BoolArray | None = None) -> Features:
        """As the extractor's, with the image's size."""
        features = self._extractor.extract(image, valid)
        rows, columns = image.shape
        return dataclasses.replace(features, image_px=(columns, rows))

    def match(self, query: Features, reference: Features) -> Matches:
        """Pairs that are each other's likeliest; ``confidence`` is the network's probability of the pair.

        Raises: ModelError if the inference fails.
        """
        if len(query) == 0 or len(reference) == 0:
            return Matches(np.empty((0, 2)), np.empty((0, 2)), np.empty(0))
        logs = self._network.run(
            {
                "query_descriptors": query.descriptors,
                "query_places": _places(query),
                "reference_descriptors": reference.descriptors,
                "reference_places": _places(reference),
            }
        )
        i, j = mutual_best(logs)
        # Rounding can put a logarithm above 0.
        probability = np.exp(np.minimum(logs[i, j], 0.0)).astype(np.float64)
        kept = probability > _MIN_PROBABILITY
        return Matches(query.keypoints_px[i[kept]], reference.keypoints_px[j[kept]], probability[kept])


class LighterGlueMatcher(GlueMatcher):
    """XFeat's features.

    Args:
        extractor: XFeat's graph and the SHA-256 that it must have.
        network: LighterGlue's.
        working_px: long side that images are brought to, a multiple of 32.
        max_keypoints: kept per image, best first; no more than ``MOST_KEYPOINTS`` are.
        threads: of one inference.
    Raises: ModelError if a graph's hash differs or it can't be loaded; ValueError for an unusable number.
    """

    def __init__(
        self,
        extractor: tuple[bytes, str],
        network: tuple[bytes, str],
        *,
        working_px: int = 640,
        max_keypoints: int = MOST_KEYPOINTS,
        threads: int = 1,
    ) -> None:
        xfeat = XFeatMatcher(
            *extractor, working_px=working_px, max_keypoints=min(max_keypoints, MOST_KEYPOINTS), threads=threads
        )
        super().__init__(
            "xfeat-lighterglue", xfeat, [extractor[1]], network, working_px=working_px, threads=threads
        )


class LightGlueMatcher(GlueMatcher):
    """ALIKED's or DISK's features, whose ``extractor`` takes two graphs, ``picture`` and ``descriptors``.

    Args and errors as of `LighterGlueMatcher`; working sides are multiples of what the extractor asks for.
    """

    def __init__(
        self,
        name: str,
        extractor: type[AlikedExtractor] | type[DiskExtractor],
        picture: tuple[bytes, str],
        descriptors: tuple[bytes, str],
        network: tuple[bytes, str],
        *,
        working_px: int = 640,
        max_keypoints: int = MOST_KEYPOINTS,
        threads: int = 1,
    ) -> None:
        features = extractor(
            picture,
            descriptors,
            working_px=working_px,
            max_keypoints=min(max_keypoints, MOST_KEYPOINTS),
            threads=threads,
        )
        hashes = [picture[1], descriptors[1]]
        super().__init__(name, features, hashes, network, working_px=working_px, threads=threads)


def _places(features: Features) -> Float32Array:
    """Keypoints (N, 2) from the image's middle, in units of half its long side, as the network was trained.

    Half a pixel more or less is nothing to it: it sees differences of places within one image only.
    """
    if features.image_px is None:
        raise ValueError("LightGlue: features without the image's size are another matcher's")
    size = np.array(features.image_px, dtype=np.float64)
    places: FloatArray = (features.keypoints_px - size / 2) / (size.max() / 2)
    return places.astype(np.float32)


def mutual_best(logs: Float32Array) -> tuple[IntArray, IntArray]:
    """Rows, rising, and columns of entries that are the greatest of both; of equal ones the first."""
    best = logs.argmax(axis=1)
    rows = np.flatnonzero(logs.argmax(axis=0)[best] == np.arange(len(logs)))
    return rows, best[rows]
