"""Mutual nearest neighbours among unit descriptors, in blocks that stay in the processor's cache.

The whole 2048 x 2048 similarity matrix is 16 MiB; by blocks of 128 rows each is used while it is near. Measured
on 2 vCPU EPYC: 12 ms of CPU against 36 for one large product (shared notes on matchers).
"""

from __future__ import annotations

from typing import Final

import numpy as np

from ortholoc_edge.geometry.arrays import Float32Array, IntArray

_BLOCK_ROWS: Final = 128


def mutual_nearest(
    query: Float32Array, reference: Float32Array, min_cosine: float, max_ratio: float | None = None
) -> tuple[IntArray, IntArray]:
    """Pairs that are each other's nearest.

    Args:
        query, reference: (N, D) and (M, D) float32, unit rows.
        min_cosine: pairs of lower cosine are left out.
        max_ratio: Lowe's test on the query's side: the distance to the nearest must be below this share of
            the distance to the second nearest. None: no test.
    Returns: indices into ``query``, rising, and into ``reference``; no index twice.
    """
    if len(query) == 0 or len(reference) < (1 if max_ratio is None else 2):
        none = np.empty(0, np.intp)
        return none, none
    nearest = np.empty(len(query), np.intp)
    cosine = np.empty(len(query), np.float32)
    second = np.empty(len(query), np.float32)
    best_of_reference = np.full(len(reference), -np.inf, np.float32)
    across = reference.T
    for start in range(0, len(query), _BLOCK_ROWS):
        rows = slice(start, start + _BLOCK_ROWS)
        block = query[rows] @ across
        np.maximum(best_of_reference, block.max(axis=0), out=best_of_reference)
        # The column's arg max is not needed: a pair is mutual if its value is the column's greatest.
        index = block.argmax(axis=1)
        counter = np.arange(len(block))
        nearest[rows] = index
        cosine[rows] = block[counter, index]
        if max_ratio is not None:
            block[counter, index] = -np.inf
            second[rows] = block.max(axis=1)
    kept = (cosine >= best_of_reference[nearest]) & (cosine >= min_cosine)
    if max_ratio is not None:
        # Unit rows: squared distance is 2 - 2 cos. Rounding can put a cosine above 1.
        kept &= np.maximum(1.0 - cosine, 0.0) < max_ratio**2 * (1.0 - second)
    query_index = np.flatnonzero(kept)
    # Equal descriptors tie; the first of them keeps the pair.
    _, first = np.unique(nearest[query_index], return_index=True)
    query_index = query_index[np.sort(first)]
    return query_index, nearest[query_index]
