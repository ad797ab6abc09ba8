"""A stamp that can't be of the clock that TIMESYNC knows; and jitter, bursts and reordering, which are no reason."""

from __future__ import annotations

import random

import pytest

from ortholoc_edge.adapters.mavlink.clockwatch import ClockWatch, Stamp
from ortholoc_edge.adapters.mavlink.timesync import TimeSync

MS, S = 1_000_000, 1_000_000_000


def synchronised(offset_ns: int = 0) -> TimeSync:
    sync = TimeSync()
    for i in range(12):
        ts1 = sync.due(i * S)
        sync.answered(ts1 + 2 * MS + offset_ns, ts1, ts1 + 4 * MS)
    assert sync.synchronised and not sync.hurried
    return sync


def test_timesync_asks_at_its_pace():
    """Fast until enough is known, then once a second; in doubt faster than ever, until two answers have settled it."""
    sync = TimeSync()
    assert sync.median_round_trip_ns is None

    def asked(start_ns, seconds):
        times = []
        for now in range(start_ns, start_ns + round(seconds * S), 10 * MS):
            ts1 = sync.due(now)
            if ts1 is not None:
                times.append(now - start_ns)
                sync.answered(ts1 + 2 * MS, ts1, ts1 + 4 * MS)
        return [t // MS for t in times]

    assert asked(S, 4.0) == [*range(0, 1100, 100), 2000, 3000]
    sync.hurry(5 * S)
    # The third was due before the second had settled it.
    assert asked(5 * S, 1.0) == [0, 50, 100] and not sync.hurried


def watch(steps, sync=None, start_ns: int = 12 * S):
    """``steps``: (stamp, delay) in ms after the start, of one kind of message each 20 ms."""
    made = ClockWatch(sync or synchronised())
    return [made.judge("ATTITUDE", start_ns + at * MS, start_ns + (at + delay) * MS) for at, delay in steps]


def test_jitter_bursts_and_reordering_are_good():
    rng = random.Random(1)
    jitter = [(20 * i, rng.uniform(3, 60)) for i in range(500)]
    assert set(watch([(a, round(d)) for a, d in jitter])) == {Stamp.GOOD}
    overtaken = [(20 * i, 5) for i in range(50)]
    overtaken[30], overtaken[31] = overtaken[31], overtaken[30]
    assert set(watch(overtaken)) == {Stamp.GOOD}


def test_a_stall_is_doubted_until_messages_come_as_usual():
    """0.9 s of silence, then all of it at once: what came late is confirmed by what is not."""
    sync = synchronised()
    burst = [(1000 + 20 * i, 905 - 20 * i) for i in range(46)]
    verdicts = watch([(20 * i, 5) for i in range(50)] + burst, sync)
    assert verdicts[50] is Stamp.UNCONFIRMED and verdicts[-1] is Stamp.GOOD
    assert Stamp.FALSE not in verdicts and not sync.hurried


@pytest.mark.parametrize("step_ms", [30, 60, 900])
def test_a_stamp_of_the_future_is_false(step_ms):
    sync = synchronised()
    assert watch([(20 * i, 5) for i in range(50)] + [(1000 + step_ms, 5 - step_ms)], sync)[-1] is Stamp.FALSE
    assert sync.hurried


@pytest.mark.parametrize("step_ms", [100, 200, 900])
def test_a_clock_put_back_is_never_good(step_ms):
    sync = synchronised()
    after = [(1000 + 20 * i - step_ms, 5 + step_ms) for i in range(100)]
    verdicts = watch([(20 * i, 5) for i in range(50)] + after, sync)[50:]
    assert Stamp.GOOD not in verdicts and sync.hurried


def test_timesync_settles_the_doubt_of_a_slower_line():
    """A queue that stays: the answers agree with the old clock, so what comes late is taken for late."""
    sync = synchronised()
    made = ClockWatch(sync)
    start = 12 * S
    for i in range(50):
        made.judge("ATTITUDE", start + 20 * i * MS, start + (20 * i + 5) * MS)
    for i in range(50, 60):
        assert made.judge("ATTITUDE", start + 20 * i * MS, start + (20 * i + 400) * MS) is Stamp.UNCONFIRMED
    now = start + 1600 * MS
    for _ in range(2):
        ts1 = sync.due(now)
        assert ts1 is not None, "asked fast"
        sync.answered(ts1 + 200 * MS, ts1, ts1 + 400 * MS)
        now += 50 * MS
    assert not sync.hurried
    assert made.judge("ATTITUDE", start + 1700 * MS, start + 2100 * MS) is Stamp.GOOD
    assert made.judge("ATTITUDE", start + 1720 * MS, start + 2120 * MS) is Stamp.GOOD
