"""Matchers that look at both pictures at once: extraction keeps the picture, matching runs one graph on the two.

Three kinds, by what the graph gives: pairs of points (LoFTR and its kin), where each pixel lies in the other picture
(DKM, RoMa), or a vector per pixel whose nearest neighbours are sought (DUSt3R, MASt3R). A graph's size is fixed;
pictures are stretched to it, as the published code of DKM and RoMa does.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from ortholoc_edge.geometry.arrays import BoolArray, Float32Array, ImageArray, IntArray
from ortholoc_edge.matching.exported import RANDOM_SUFFIX, StoredGraph
from ortholoc_edge.matching.inference import Inference
from ortholoc_edge.matching.types import Features, Matches
from ortholoc_edge.matching.working_image import WorkingImage, working_image

SIDES: Final = ("query", "reference")

# Of the published sampling (DKM, RoMa): what is more certain than the least counts as sure.
_SURE: Final = 1.0
# Of the published search for reciprocal neighbours (MASt3R, section 3.3): distance of the pixels that it starts from,
# rounds, and the rim within which matches are dropped.
_START_STEP_PX: Final = 8
_ROUNDS: Final = 10
_RIM_PX: Final = 3
# Of a product of descriptors at once: 64 x 196608 float32 are 50 MB.
_BLOCK_ROWS: Final = 64


@dataclass(frozen=True, slots=True, eq=False)
class Picture(Features):
    """A picture that waits for its partner; it has no keypoints of its own.

    Attributes:
        views: at the graph's size and, where the graph looks twice, at the finer one; none: nothing is to be seen.
    """

    views: tuple[WorkingImage, ...] = ()


def _no_matches(confidence: bool = True) -> Matches:
    return Matches(np.empty((0, 2)), np.empty((0, 2)), np.empty(0) if confidence else None)


class PairMatcher:
    """What the three kinds share. Keeps no state between calls, so one object may serve several threads.

    Args:
        name: of the matcher.
        graph: its graph.
        outputs: of the graph.
        max_matches: that `match` gives at most.
        threads: of one inference.
    Raises: ModelError if the graph can't be loaded or is another one; ValueError for an unusable number.
    """

    def __init__(
        self, name: str, graph: StoredGraph, outputs: tuple[str, ...], *, max_matches: int, threads: int
    ) -> None:
        if max_matches < 1 or threads < 1:
            raise ValueError(f"max_keypoints {max_matches} and threads {threads} must be at least 1")
        self.name = name
        self.model_sha256: str | None = graph.sha256
        self.max_matches = max_matches
        model = name.removesuffix(RANDOM_SUFFIX)
        self._inference = Inference(
            graph.path, graph.sha256, threads, what=name, model=model, inputs=None, outputs=outputs
        )
        self._inputs = self._inference.inputs
        # (width, height) of each view; both sides' are alike.
        self._sizes = [(int(shape[3]), int(shape[2])) for shape in list(self._inference.input_shapes.values())[::2]]
        self.working_px = max(self._sizes[0])

    def extract(self, image: ImageArray, valid: BoolArray | None = None) -> Picture:
        """``image`` (H, W) uint8 grey at the graph's size; what of it is valid decides in `match`.

        Raises: ValueError if image or mask have another type or shape.
        """
        views = [working_image(image, valid, *size) for size in self._sizes]
        kept = tuple(view for view in views if view is not None)
        return Picture(
            np.empty((0, 2)),
            np.empty(0, np.float32),
            np.empty((0, 0), np.float32),
            views=kept if len(kept) == len(views) else (),
        )

    def match(self, query: Features, reference: Features) -> Matches:
        """Pairs at whose places both pictures hold data. Raises: ModelError if the inference fails."""
        if not isinstance(query, Picture) or not isinstance(reference, Picture):
            raise ValueError(f"matcher {self.name}: features are another matcher's")
        if not query.views or not reference.views:
            return _no_matches()
        feeds = {}
        for names, views in zip(
            zip(self._inputs[::2], self._inputs[1::2], strict=True),
            zip(query.views, reference.views, strict=True),
            strict=True,
        ):
            for one, view in zip(names, views, strict=True):
                feeds[one] = (view.image.astype(np.float32) / np.float32(255.0))[None, None]
        width, height = self._sizes[-1]
        found = self._found(self._inference.run(feeds, f"two pictures of {width} x {height} px"))
        sides = query.views[-1], reference.views[-1]
        kept = sides[0].holds(found.query_px) & sides[1].holds(found.map_px)
        found = found.take(np.flatnonzero(kept))
        return replace(found, query_px=sides[0].original_px(found.query_px), map_px=sides[1].original_px(found.map_px))

    def _found(self, outputs: list[Float32Array]) -> Matches:
        """Matches in the pixels of the finest view."""
        raise NotImplementedError


class PointPairMatcher(PairMatcher):
    """The graph gives pairs of points: LoFTR, MINIMA-LoFTR, Efficient LoFTR, XoFTR.

    Args: as of `PairMatcher`, and
        min_confidence: what pairs must exceed.
    """

    def __init__(self, name: str, graph: StoredGraph, *, min_confidence: float, max_matches: int, threads: int) -> None:
        outputs = ("query_px", "reference_px", "confidence")
        super().__init__(name, graph, outputs, max_matches=max_matches, threads=threads)
        self._min_confidence = min_confidence

    def _found(self, outputs: list[Float32Array]) -> Matches:
        query_px, reference_px, confidence = outputs
        order = np.argsort(-confidence, kind="stable")[: self.max_matches]
        order = order[confidence[order] > self._min_confidence]
        return Matches(
            query_px[order].astype(np.float64),
            reference_px[order].astype(np.float64),
            np.minimum(confidence[order].astype(np.float64), 1.0),
        )


class WarpMatcher(PairMatcher):
    """The graph gives each pixel's place in the other picture, and how certain that is: DKM, GIM, RoMa.

    The published code draws pairs at random among those more certain than ``min_confidence``, fewer where they are
    dense, and calls all of them sure. Here the pictures are divided into as many cells as there are to be matches, and
    the most certain pixel of each is taken: as even, and the same each time.

    Args: as of `PointPairMatcher`.
    """

    def __init__(self, name: str, graph: StoredGraph, *, min_confidence: float, max_matches: int, threads: int) -> None:
        super().__init__(name, graph, ("warp", "certainty"), max_matches=max_matches, threads=threads)
        self._min_confidence = min_confidence

    def _found(self, outputs: list[Float32Array]) -> Matches:
        warp, certainty = outputs
        directions, rows, columns = certainty.shape
        half = self.max_matches // 2
        size = np.array([columns, rows], dtype=np.float64)
        pairs = []
        for number in range(directions):
            v, u = _most_certain(certainty[number], half if number else self.max_matches - half)
            sure = certainty[number, v, u] > self._min_confidence
            v, u = v[sure], u[sure]
            here = np.stack([u, v], axis=1).astype(np.float64)
            there = (warp[number, v, u].astype(np.float64) + 1.0) * (size / 2.0) - 0.5
            pairs.append((here, there) if number == 0 else (there, here))
        query_px, reference_px = (np.concatenate(side) for side in zip(*pairs, strict=True))
        return Matches(query_px, reference_px, np.full(len(query_px), _SURE))


def _most_certain(certainty: Float32Array, most: int) -> tuple[IntArray, IntArray]:
    """Rows and columns of the greatest value of each of at most ``most`` square cells; of equal ones the first."""
    rows, columns = certainty.shape
    if most < 1:
        return np.empty(0, np.intp), np.empty(0, np.intp)
    side = max(1, math.isqrt(rows * columns // most))
    while -(-rows // side) * -(-columns // side) > most:
        side += 1
    down, across = -(-rows // side), -(-columns // side)
    padded = np.full((down * side, across * side), -np.inf, np.float32)
    padded[:rows, :columns] = certainty
    cells = padded.reshape(down, side, across, side).transpose(0, 2, 1, 3).reshape(down, across, side * side)
    best = cells.argmax(axis=2)
    v = np.arange(down)[:, None] * side + best // side
    u = np.arange(across)[None, :] * side + best % side
    return v.ravel(), u.ravel()


class PointMapMatcher(PairMatcher):
    """The graph gives each pixel of both pictures a vector; pairs are each other's nearest: DUSt3R (points of space),
    MASt3R (descriptors). ``confidence`` None: theirs has no upper end.

    Args: as of `PairMatcher`, and
        min_confidence: of the network's own, which begins at 1, that pixels must exceed; 0: all do.
        euclidean: whether the nearest is that of the least distance, not of the greatest product.
    """

    def __init__(
        self,
        name: str,
        graph: StoredGraph,
        *,
        min_confidence: float,
        euclidean: bool,
        max_matches: int,
        threads: int,
    ) -> None:
        outputs = tuple(f"{side}_{what}" for side in SIDES for what in ("features", "confidence"))
        super().__init__(name, graph, outputs, max_matches=max_matches, threads=threads)
        self._min_confidence = min_confidence
        self._euclidean = euclidean

    def match(self, query: Features, reference: Features) -> Matches:
        """As `PairMatcher.match`."""
        return replace(super().match(query, reference), confidence=None)

    def _found(self, outputs: list[Float32Array]) -> Matches:
        query, query_confidence, reference, reference_confidence = outputs
        rows, columns = query_confidence.shape
        sides = []
        for features, confidence in ((query, query_confidence), (reference, reference_confidence)):
            pixels = np.flatnonzero(confidence.ravel() > self._min_confidence)
            sides.append((pixels, features.reshape(rows * columns, -1)[pixels]))
        (query_pixels, query_rows), (reference_pixels, reference_rows) = sides
        if len(query_pixels) == 0 or len(reference_pixels) == 0:
            return _no_matches()
        step = max(_START_STEP_PX, math.ceil(math.sqrt(rows * columns / self.max_matches)))
        on_grid = (query_pixels // columns % step == step // 2) & (query_pixels % columns % step == step // 2)
        i, j = reciprocal_nearest(query_rows, reference_rows, np.flatnonzero(on_grid), euclidean=self._euclidean)
        query_px, reference_px = (
            np.stack([pixels % columns, pixels // columns], axis=1).astype(np.float64)
            for pixels in (query_pixels[i], reference_pixels[j])
        )
        inside = np.ones(len(query_px), np.bool_)
        for px in (query_px, reference_px):
            inside &= (px >= _RIM_PX).all(axis=1) & (px < [columns - _RIM_PX, rows - _RIM_PX]).all(axis=1)
        return Matches(query_px[inside], reference_px[inside], np.empty(int(inside.sum())))


def reciprocal_nearest(
    query: Float32Array, reference: Float32Array, start: IntArray, *, euclidean: bool
) -> tuple[IntArray, IntArray]:
    """Pairs of rows that are each other's nearest, sought from ``start`` (MASt3R, section 3.3).

    From a row of ``query`` to the nearest of ``reference``, from there to the nearest of ``query``, and so on: where
    that comes to rest is a pair.
    Args:
        query, reference: (N, D) and (M, D) float32.
        start: rows of ``query``.
        euclidean: nearest by distance; otherwise by product.
    Returns: indices into ``query``, rising, and into ``reference``; no pair twice.
    """
    if euclidean:
        # |a - b|^2 is least where a b - |b|^2 / 2 is greatest. From the middle of all, where float32 is finest.
        middle = np.concatenate([query, reference]).mean(axis=0)
        query, reference = query - middle, reference - middle
    current = start.astype(np.intp)
    partner = np.full(len(current), -1, np.intp)
    moving = np.arange(len(current))
    settled = np.zeros(len(current), np.bool_)
    for _ in range(_ROUNDS):
        if len(moving) == 0:
            break
        partner[moving] = _nearest(query[current[moving]], reference, euclidean)
        back = _nearest(reference[partner[moving]], query, euclidean)
        rests = back == current[moving]
        settled[moving[rests]] = True
        current[moving] = back
        moving = moving[~rests]
    pairs = np.unique(np.stack([current[settled], partner[settled]], axis=1), axis=0)
    return pairs[:, 0], pairs[:, 1]


def _nearest(rows: Float32Array, among: Float32Array, euclidean: bool) -> IntArray:
    nearest = np.empty(len(rows), np.intp)
    across = among.T
    offset = np.square(among).sum(axis=1) / np.float32(2.0) if euclidean else None
    for first in range(0, len(rows), _BLOCK_ROWS):
        block = rows[first : first + _BLOCK_ROWS] @ across
        if offset is not None:
            block -= offset
        nearest[first : first + _BLOCK_ROWS] = block.argmax(axis=1)
    return nearest
