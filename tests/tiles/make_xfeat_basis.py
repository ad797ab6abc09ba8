"""Makes ``ortholoc_edge/tiles/data/xfeat_basis.npz``: mean and principal axes of XFeat descriptors of orthophotos.

Run by hand, on packs of as many kinds of land as there are. The basis in the repository came from 8000 descriptors each
of seneca and caliterra averaged to 20 cm (as they are and enlarged twice), and of copr, caliterra and seneca at their
second level, all by WEBP-85 packs; this script takes the finest. Another basis is another `features.ENCODING`.

    PYTHONPATH=. python tests/tiles/make_xfeat_basis.py OUT.npz PACK[:ENLARGE] ...
"""

import sys
from pathlib import Path

import numpy as np

from ortholoc_edge.matching.registry import make_matcher
from ortholoc_edge.tiles import features
from ortholoc_edge.tiles.pack import Pack
from ortholoc_edge.tiles.store import MapStore

_DESCRIPTORS = 8000


def descriptors(pack, enlarge, matcher, rng):
    """(N, 64) of the whole orthophoto, at most `_DESCRIPTORS` of them drawn at random."""
    found = []
    with MapStore(Pack.open(pack), max_pixels=2**31) as store:
        window = store.read(store.bounds, store.dop_grids[0].gsd_m)
    grey = window.dop_grey
    for row in range(0, grey.shape[0] * enlarge, features.WORKING_PX):
        for column in range(0, grey.shape[1] * enlarge, features.WORKING_PX):
            image, seen = features._window(grey, window.dop_valid, enlarge, column, row)
            if seen.any():
                found.append(matcher.extract_unscaled(image, seen).descriptors)
    every = np.concatenate(found)
    return every[rng.permutation(len(every))[:_DESCRIPTORS]]


def main():
    rng = np.random.default_rng(0)
    size = {"working_px": features.WORKING_PX, "max_keypoints": features.MAX_KEYPOINTS}
    matcher = make_matcher("xfeat", threads=1, **size)
    parts = []
    for text in sys.argv[2:]:
        pack, _, enlarge = text.partition(":")
        parts.append(descriptors(Path(pack), int(enlarge or 1), matcher, rng))
    every = np.concatenate(parts).astype(np.float64)
    mean = every.mean(axis=0)
    variance, axes = np.linalg.eigh(np.cov((every - mean).T))
    order = np.argsort(-variance)
    np.savez(
        sys.argv[1],
        mean=mean.astype(np.float32),
        axes=axes[:, order].T.astype(np.float32),
        deviation=np.sqrt(variance[order]).astype(np.float32),
    )


if __name__ == "__main__":
    main()
