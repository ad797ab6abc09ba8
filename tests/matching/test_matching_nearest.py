"""Blocked mutual nearest neighbours against the plain definition."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ortholoc_edge.matching.nearest import mutual_nearest


def _unit(seed: int, count: int) -> np.ndarray:
    rows = np.random.default_rng(seed).normal(size=(count, 8)).astype(np.float32)
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


@settings(deadline=None, max_examples=60)
@given(st.integers(0, 300), st.integers(0, 300), st.integers(0, 99), st.sampled_from([None, 0.8, 0.95]))
def test_pairs_are_those_of_the_definition(n: int, m: int, seed: int, ratio: float | None) -> None:
    a, b = _unit(seed, n), _unit(seed + 100, m)
    similarity = a.astype(np.float64) @ b.T.astype(np.float64)
    expected = set()
    if n and m >= (1 if ratio is None else 2):
        for i in range(n):
            j = int(similarity[i].argmax())
            if similarity[:, j].argmax() != i or similarity[i, j] < 0.5:
                continue
            distances = np.sort(np.sqrt(np.maximum(2 - 2 * similarity[i], 0)))
            if ratio is None or distances[0] < ratio * distances[1]:
                expected.add((i, j))
    found = mutual_nearest(a, b, 0.5, ratio)
    assert set(zip(*map(np.ndarray.tolist, found), strict=True)) == expected
    assert (np.diff(found[0]) > 0).all()


@pytest.mark.parametrize("ratio", [None, 0.9])
def test_equal_descriptors_pair_once(ratio: float | None) -> None:
    row = _unit(0, 1)
    i, j = mutual_nearest(np.repeat(row, 300, axis=0), np.concatenate([row, -row]), 0.5, ratio)
    assert i.tolist() == [0]
    assert j.tolist() == [0]


def test_without_descriptors_there_is_no_pair() -> None:
    for n, m in ((0, 5), (5, 0), (0, 0)):
        i, j = mutual_nearest(_unit(1, n), _unit(2, m), 0.0)
        assert len(i) == len(j) == 0
