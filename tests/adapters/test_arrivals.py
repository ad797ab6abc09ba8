"""Frames that lay in a queue, told by when they come."""

from __future__ import annotations

import numpy as np
import pytest

from ortholoc_edge.adapters.camera.stamps import Arrivals

MS = 1_000_000
PERIOD_MS = 40.0


def stalled(taken_ms: np.ndarray, at_ms: float, until_ms: float, decode_ms: float = 3.0) -> np.ndarray:
    """When frames arrive that were taken at such times: what is sent during the stall comes after it in one go."""
    arrive_ms = taken_ms + 30.0
    held = (arrive_ms > at_ms) & (arrive_ms < until_ms)
    arrive_ms[held] = until_ms
    for number in range(1, len(arrive_ms)):
        arrive_ms[number] = max(arrive_ms[number], arrive_ms[number - 1] + decode_ms)
    return arrive_ms


def judged(own_ms: np.ndarray | None, arrive_ms: np.ndarray) -> list[int | None]:
    arrivals = Arrivals()
    return [
        arrivals.late_ns(None if own_ms is None else round(own_ms[i] * MS), 10**15 + round(arrive_ms[i] * MS))
        for i in range(len(arrive_ms))
    ]


@pytest.mark.parametrize("has_time", [True, False])
def test_frames_of_a_stall_are_late_and_no_others(has_time: bool) -> None:
    taken_ms = np.arange(200) * PERIOD_MS
    arrive_ms = stalled(taken_ms, 3000.0, 5000.0)
    late = judged(taken_ms + 777.0 if has_time else None, arrive_ms)
    assert all(one == 0 for one in late[:7]), "what is usual is not known yet"
    truly_ms = arrive_ms - taken_ms - 30.0
    for number in range(8, 200):
        if truly_ms[number] > 110.0:
            assert late[number] is not None, number
        # By intervals alone the frame that ends the queue is the first that had to be waited for.
        if truly_ms[number] == 0.0 and truly_ms[number - 1] == 0.0:
            assert late[number] is None, number
    if has_time:
        first = int(np.argmax(truly_ms > 110.0))
        assert late[first] == pytest.approx(truly_ms[first] * MS, abs=5 * MS)


@pytest.mark.parametrize("factor", [0.9995, 1.001])
def test_clocks_that_drift_apart_and_jitter(factor: float) -> None:
    """Ten minutes, in which they part by 0.3 and 0.6 s."""
    taken_ms = np.arange(15_000) * PERIOD_MS
    jitter_ms = np.random.default_rng(1).exponential(12.0, len(taken_ms)).clip(0.0, 90.0)
    assert all(one is None for one in judged(taken_ms / factor, taken_ms + jitter_ms)[8:])


def test_a_queue_that_grows_is_seen() -> None:
    """A computer that decodes 5 % less than what comes."""
    taken_ms = np.arange(400) * PERIOD_MS
    late = judged(taken_ms, taken_ms * 1.05)
    assert late[20] is None and all(one is not None for one in late[60:])


def test_a_camera_that_starts_its_time_anew() -> None:
    taken_ms = np.arange(100) * PERIOD_MS
    own_ms = np.where(taken_ms < 2000.0, taken_ms, taken_ms - 2000.0)
    assert all(one is None for one in judged(own_ms, taken_ms)[8:])


def test_slow_and_uneven_cameras_without_a_time() -> None:
    uneven_ms = np.cumsum(np.random.default_rng(2).uniform(300.0, 700.0, 50))
    assert all(one is None for one in judged(None, uneven_ms)[2:])
    pairs_ms = np.repeat(np.arange(100) * 80.0, 2) + np.tile([0.0, 2.0], 100)
    assert all(one is None for one in judged(None, pairs_ms)[10:])
