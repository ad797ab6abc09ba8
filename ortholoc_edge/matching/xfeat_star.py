"""XFeat*, the semi-dense variant: a descriptor per cell at two scales, matched and then shifted to the pixel.

Potje et al., CVPR 2024, section 3.3: the most reliable cells of the image at 0.6 and 1.3 of its size, mutual nearest
neighbours of their descriptors as the network gives them, and for each pair a small network that sees both
descriptors and says where in the first image's cell the place is.
"""

from __future__ import annotations

import copy
from typing import Final

import numpy as np

from ortholoc_edge.geometry.arrays import BoolArray, Float32Array, FloatArray, ImageArray, IntArray
from ortholoc_edge.matching.inference import Inference
from ortholoc_edge.matching.models import joint_sha256
from ortholoc_edge.matching.nearest import mutual_nearest
from ortholoc_edge.matching.types import Features, Matches
from ortholoc_edge.matching.working_image import WorkingImage, check_numbers, reduced_size, working_image
from ortholoc_edge.matching.xfeat import CELL_PX, DESCRIPTOR, MULTIPLE_PX, normalised, working_size

_INPUT: Final = "normalised"
_OUTPUTS: Final = ("cells", "reliability")

# The published matcher's (modules/xfeat.py): size of the level against the working image, and its share of the
# keypoints; least share of the likeliest of a cell's 64 places; factor on the logits.
_LEVELS: Final = ((0.6, 0.2), (1.3, 0.8))
_MIN_FINE: Final = 0.25
_TEMPERATURE: Final = 3.0
# Place in the cell that stands for no shift. The published matcher has 4, and puts a cell's keypoint into its corner.
# So a made scene and six recorded pictures, cut out twice up to 8 px apart, came out 0.9 to 1.2 px off (in u and in v,
# mean over the pairs, pixels of the level), and a scene seen at two scales 2.1 px. With 3, and the cell's middle, 0.15
# and 0.23 px are left. Half a pixel of that is clear: the network learnt places that were rounded down.
_MIDDLE: Final = 3.0


class DenseNetwork:
    """The graph of `models.XFEAT_STAR` in a session of its own. Args and errors as of `Inference`."""

    def __init__(self, graph: bytes, sha256: str, threads: int) -> None:
        self._inference = Inference(
            graph, sha256, threads, what="XFeat*", model="xfeat-star", inputs=[_INPUT], outputs=_OUTPUTS
        )

    def run(self, grey: ImageArray, usable: BoolArray | None = None) -> tuple[Float32Array, Float32Array]:
        """Descriptors (1, 64, H/8, W/8) of any length and reliability (1, 1, H/8, W/8) of ``grey`` (H, W),
        normalised over ``usable`` (H, W) or all of it.

        Raises: ModelError if the runtime fails.
        """
        cells, reliability = self._inference.run(
            {_INPUT: normalised(grey, usable)[None, None]}, f"{grey.shape[1]} x {grey.shape[0]} px"
        )
        return cells, reliability


class FineNetwork:
    """The graph of `models.XFEAT_STAR_FINE` in a session of its own. Args and errors as of `Inference`."""

    def __init__(self, graph: bytes, sha256: str, threads: int) -> None:
        self._inference = Inference(
            graph, sha256, threads, what="XFeat* fine", model="xfeat-star-fine", inputs=["pairs"], outputs=["logits"]
        )

    def run(self, pairs: Float32Array) -> Float32Array:
        """Logits (N, 64) of a cell's pixels in row order, from two descriptors each, (N, 128).

        Raises: ModelError if the runtime fails.
        """
        return self._inference.run({"pairs": pairs}, f"{len(pairs)} pairs")[0]


class XFeatStarMatcher:
    """Semi-dense XFeat. Keeps no state between calls, so one object may serve several threads.

    Args:
        dense, fine: the two ONNX graphs, each with the SHA-256 that it must have.
        working_px: long side of the size that the two levels are 0.6 and 1.3 of, a multiple of 32.
        max_keypoints: kept per image, most reliable first, a fifth of them from the smaller level.
        threads: of one inference.
    Raises: ModelError if a graph's hash differs or it can't be loaded; ValueError for an unusable number.
    """

    def __init__(
        self,
        dense: tuple[bytes, str],
        fine: tuple[bytes, str],
        *,
        working_px: int = 640,
        max_keypoints: int = 4096,
        threads: int = 1,
    ) -> None:
        check_numbers("XFeat*", MULTIPLE_PX, 2 * MULTIPLE_PX, working_px, max_keypoints, threads)
        self.name = "xfeat-star"
        self.model_sha256: str | None = joint_sha256(dense[1], fine[1])
        self.working_px = working_px
        self._max_keypoints = max_keypoints
        self._dense = DenseNetwork(*dense, threads)
        self._fine = FineNetwork(*fine, threads)

    def reduced(self, scale: float) -> XFeatStarMatcher:
        """See `ReducibleMatcher`."""
        other = copy.copy(self)
        other.working_px, other._max_keypoints = reduced_size(self.working_px, self._max_keypoints, scale, MULTIPLE_PX)
        return other

    def extract(self, image: ImageArray, valid: BoolArray | None = None) -> Features:
        """Cells of ``image`` (H, W) uint8 grey; none that lies, or is within 8 pixels of its level, where ``valid``
        is False.

        An image that is tiny, constant or invalid throughout has no features, which is no error.
        Raises: ModelError if the inference fails; ValueError if image or mask have another type or shape.
        """
        levels = []
        for size, share in _LEVELS:
            width, height = working_size(image.shape, round(size * self.working_px))
            work = working_image(image, valid, width, height)
            if work is not None:
                levels.append(self._level(work, round(share * self._max_keypoints)))
        if not levels:
            none = np.empty((0, 2))
            lengths = np.empty(0, np.float32)
            return Features(none, lengths, np.empty((0, DESCRIPTOR), np.float32), lengths=lengths, spacing_px=none)
        pixels, scores, cells, spacing = (np.concatenate(parts) for parts in zip(*levels, strict=True))
        order = np.argsort(-scores, kind="stable")
        lengths = np.sqrt(np.einsum("nc,nc->n", cells, cells))[order]
        unit = cells[order] / np.maximum(lengths, np.float32(1e-12))[:, None]
        return Features(pixels[order], scores[order], unit, lengths=lengths, spacing_px=spacing[order])

    def _level(
        self, work: WorkingImage, limit: int
    ) -> tuple[FloatArray, Float32Array, Float32Array, FloatArray]:
        """Keypoints (N, 2) in the original's pixels, reliability (N,), descriptors (N, 64), spacing (N, 2)."""
        cells, reliability = self._dense.run(work.image, work.usable)
        rows, columns = reliability.shape[2:]
        kept = np.arange(rows * columns)
        if work.usable is not None:
            whole = work.usable.reshape(rows, CELL_PX, columns, CELL_PX).all(axis=(1, 3))
            kept = np.flatnonzero(whole)
        scores = reliability.reshape(-1)[kept]
        # Stable, so that ties keep row order on every machine.
        best = np.argsort(-scores, kind="stable")[:limit]
        index = kept[best]
        spacing = np.broadcast_to(np.array(work.scale), (len(index), 2))
        return (
            work.original_px(_cell_px(index, columns)),
            scores[best],
            np.ascontiguousarray(cells.reshape(DESCRIPTOR, -1)[:, index].T),
            spacing,
        )

    def match(self, query: Features, reference: Features) -> Matches:
        """Mutual nearest neighbours, the query's keypoint of each shifted to where the reference's cell is seen;
        pairs whose shift is uncertain are left out.

        ``confidence`` is None: what the fine network is sure or unsure of is the shift, not the pair.
        Raises: ModelError if the inference fails.
        """
        query_cells, reference_cells = _as_given(query), _as_given(reference)
        # Not unit: the published matcher compares products, which favours descriptors of great length.
        i, j = mutual_nearest(query_cells, reference_cells, -np.inf)
        if len(i) == 0 or query.spacing_px is None:
            return Matches(np.empty((0, 2)), np.empty((0, 2)))
        logits = self._fine.run(np.concatenate([query_cells[i], reference_cells[j]], axis=1))
        shift, share = _shifts(logits)
        kept = share > _MIN_FINE
        i, j = i[kept], j[kept]
        return Matches(query.keypoints_px[i] + shift[kept] * query.spacing_px[i], reference.keypoints_px[j])


def _cell_px(index: IntArray, columns: int) -> FloatArray:
    """Middles (N, 2) of cells in the pixels of their level."""
    cells = np.stack([index % columns, index // columns], axis=1).astype(np.float64)
    return (cells + 0.5) * CELL_PX - 0.5


def _as_given(features: Features) -> Float32Array:
    """Descriptors of the length that the network gave them."""
    if features.lengths is None:
        raise ValueError("XFeat*: features without lengths are another matcher's")
    return features.descriptors * features.lengths[:, None]


def _shifts(logits: Float32Array) -> tuple[FloatArray, Float32Array]:
    """Mean place (N, 2) in the cell, from its middle, in pixels of the level; and the likeliest place's share."""
    shares = np.exp(_TEMPERATURE * (logits - logits.max(axis=1, keepdims=True)))
    shares /= shares.sum(axis=1, keepdims=True)
    v, u = np.divmod(np.arange(CELL_PX * CELL_PX), CELL_PX)
    places = np.stack([u, v], axis=1) - _MIDDLE
    shift: FloatArray = shares.astype(np.float64) @ places.astype(np.float64)
    return shift, shares.max(axis=1)
