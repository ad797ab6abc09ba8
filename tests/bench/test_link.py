"""The link's benchmark in short: real bytes through real wires, a loop of connect and disconnect, hostile bytes."""

from __future__ import annotations

import itertools
import json
import random

import pytest

from ortholoc_edge.adapters.mavlink import link as link_module
from ortholoc_edge.adapters.mavlink.codec import FrameParser
from ortholoc_edge.adapters.mavlink.options import LinkOptions
from ortholoc_edge.adapters.mavlink.protocol import LinkProtocol
from ortholoc_edge.bench import link
from ortholoc_edge.cli import main


def test_spread_by_hand():
    found = link.spread([1_000_000 * n for n in range(1, 102)])
    assert (found.count, found.median_ms, found.p99_ms, found.max_ms) == (101, 51.0, 100.0, 101.0)
    with pytest.raises(link.LinkError, match="nothing came"):
        link.spread([])


@pytest.mark.parametrize("kind", ["pty", "udp"])
def test_both_times_are_measured(kind):
    found = link.measure(kind, 1.0, None, 0)
    assert found.estimate.count >= 8 and found.timesync.count >= 20
    # Nothing arrives before it was sent, nor takes longer than the measurement.
    assert 0.0 < found.estimate.median_ms < 1000.0 and 0.0 < found.timesync.median_ms < 1000.0


def test_fixes_that_are_carried_on_are_measured_by_their_first_estimate():
    found = link.measure("udp", 2.0, None, 0, "fast-forward")
    assert found.release == "fast-forward" and found.estimate.count >= 4
    assert 0.0 < found.estimate.median_ms < 1000.0


@pytest.mark.parametrize("kind", ["tcp", "pty"])
def test_connecting_and_disconnecting_holds_nothing_back(kind, monkeypatch):
    monkeypatch.setattr(link, "_WARM_ROUNDS", 2)
    monkeypatch.setattr(link_module, "_BACKOFF_MIN_S", 0.1)
    found = link.soak(kind, 0.0)
    assert found.rounds == 4
    assert found.late.threads == found.early.threads and found.late.descriptors == found.early.descriptors
    assert found.late.rss_mib - found.early.rss_mib < 4.0
    assert found.holds_nothing_more


def test_hostile_bytes_reach_the_handlers_and_do_no_harm():
    found = link.fuzz(60_000, 3)
    assert found.fed_bytes >= 60_000 and found.internal_errors == 0 and found.is_heard_after
    assert found.messages > 100 and found.bad_frames > 50


def test_hostile_bytes_in_any_pieces():
    """Straight into parser and protocol, cut anywhere: nothing raises, the buffer stays that of one frame."""
    parser, protocol = FrameParser(), LinkProtocol(LinkOptions(endpoint="udp:127.0.0.1:1"))
    rng = random.Random(5)
    now = 10**12
    got = 0
    for piece in itertools.islice(link.hostile_bytes(rng), 1500):
        cuts = sorted(rng.randrange(len(piece) + 1) for _ in range(3))
        for start, end in itertools.pairwise([0, *cuts, len(piece)]):
            now += rng.randrange(50_000_000)
            for message in parser.feed(piece[start:end], now):
                got += 1
                protocol.on_message(message, now)
            protocol.poll(now)
            protocol.state_at(now)
            assert len(parser._buffer) <= 300
    assert got > 300


def test_command_prints_a_table_or_json(capsys, monkeypatch):
    some = link.Spread(count=9, median_ms=0.5, p99_ms=1.5, max_ms=2.0)

    def measure(kind, seconds, load, seed, release):
        assert (seconds, load, seed) == (0.3, None, 0)
        return link.Latencies(
            wire=kind, load="idle", release=release, estimate=some, timesync=some, is_realtime=True, load_fps=0.0
        )

    monkeypatch.setattr(link, "measure", measure)
    assert main(["bench-link", "--loads", "idle", "--seconds", "0.3"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[2].startswith("| wire |")
    # Each wire by both ways of release.
    assert sorted(line[:6] for line in lines[4:]) == ["| pty "] * 2 + ["| udp "] * 2
    assert len({line.count("|") for line in lines[2:]}) == 1
    assert main(["bench-link", "--fuzz", "20000", "--json"]) == 0
    rows = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [row["row"] for row in rows] == ["fuzz", "fuzz"]
    # With a signature required, what is signed by nobody we know is refused.
    assert rows[0]["refused_frames"] == 0 and rows[1]["refused_frames"] > 20
