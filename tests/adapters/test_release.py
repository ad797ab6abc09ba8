"""What goes out between fixes: where it says the vehicle is, how sure it claims to be, and when it falls silent."""

from __future__ import annotations

import itertools
import random
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ortholoc_edge.adapters.mavlink.geodesy import Place
from ortholoc_edge.adapters.mavlink.options import LinkOptions
from ortholoc_edge.adapters.mavlink.release import Outgoing, Release, shares
from ortholoc_edge.geometry import rotation

from .link_scenes import MS, ORIGIN, Flight, S


def make(**options) -> Release:
    return Release(LinkOptions(endpoint="udp:x:1", **options))


def fly(
    release: Release, flight: Flight, until_ns: int, fixes: dict[int, object], start_ns: int = 0, step_ns: int = 10 * MS
) -> list[tuple[int, Outgoing]]:
    """(when, what) went out; ``fixes`` by the time at which they are ready."""
    out = []
    for now in range(start_ns, until_ns, step_ns):
        if now in fixes:
            release.take(fixes[now], now, flight.look)
        outgoing = release.due(now, flight.look)
        if outgoing is not None:
            out.append((now, outgoing))
    return out


def regular(flight: Flight, every_ns: int = 500 * MS, latency_ns: int = 300 * MS, count: int = 20, **fix):
    return {S + i * every_ns + latency_ns: flight.fix(S + i * every_ns, **fix) for i in range(count)}


def test_fast_forward_says_where_the_vehicle_is_now():
    flight = Flight()
    out = fly(make(), flight, 6 * S, regular(flight, yaw_error=0.1))
    assert len(out) > 40
    for now, outgoing in out:
        estimate = outgoing.estimate
        assert estimate.stamp_ns == now
        assert estimate.position_ned_m == pytest.approx(flight.truth(now / S), abs=1e-6)
        # The map's heading: what the fix differed by from the autopilot's is kept while it turns.
        expected = rotation.exp([0.0, 0.0, 0.1]) @ flight.attitude(now / S)
        assert estimate.ned_from_body == pytest.approx(expected, abs=1e-9)
        assert (estimate.reset_counter, estimate.quality) == (1, 0.8)


def test_ten_a_second_whatever_the_fixes_do():
    flight = Flight()
    out = fly(make(), flight, 8 * S, regular(flight))
    steps = np.diff([now for now, _ in out])
    assert set(steps) == {100 * MS}
    assert [o.repeat for _, o in out[:10]] == [0, 1, 2, 3, 4] * 2
    release = make(estimate_rate_hz=20.0)
    assert set(np.diff([now for now, _ in fly(release, flight, 8 * S, regular(flight))])) == {50 * MS}
    assert release.counts["carried"] == 14


def test_a_new_fix_goes_at_once_and_the_rate_stays():
    """Fixes at any time: none waits for a raster, none comes too close, and there are ten a second as planned."""
    flight, rng = Flight(), random.Random(0)
    release, at, fixes = make(), S, {}
    while at < 40 * S:
        fixes[at] = flight.fix(at - 150 * MS)
        at += rng.randrange(180, 320) * MS
    out = fly(release, flight, 40 * S, fixes, start_ns=S, step_ns=MS)
    first = {outgoing.capture_ns: now for now, outgoing in reversed(out)}
    waits = [first[fix.stamp_ns] - ready for ready, fix in fixes.items()]
    assert np.median(waits) == 0 and max(waits) <= 25 * MS
    assert min(np.diff([now for now, _ in out])) >= 25 * MS
    assert 9.0 * 39 < len(out) <= 10.0 * 39 + 2
    # Faster fixes than may go out wait their turn.
    fast = {S + i * 30 * MS: flight.fix(S + i * 30 * MS - 10 * MS) for i in range(300)}
    assert len(fly(make(), flight, 10 * S, fast, start_ns=S, step_ns=MS)) <= 93


def test_a_loop_that_fell_behind_sends_no_burst():
    """ArduPilot drops what comes within 20 ms."""
    flight = Flight()
    release = make()
    release.take(flight.fix(S), S + 300 * MS, flight.look)
    sent = [now for now in [S + 300 * MS, S + 495 * MS, S + 500 * MS, S + 510 * MS, S + 545 * MS, S + 600 * MS]
            if release.due(now, flight.look)]  # fmt: skip
    assert sent == [S + 300 * MS, S + 495 * MS, S + 600 * MS]


@given(st.integers(1, 50), st.integers(1, 400))
def test_all_that_is_made_of_a_fix_tells_no_more_than_the_fix(expected, sent):
    parts = [shares(expected, index) for index in range(sent)]
    assert sum(parts) < 1.0
    assert all(a >= b > 0.0 for a, b in itertools.pairwise(parts))
    # And of the usual number little is lost.
    assert sum(shares(expected, i) for i in range(expected)) == pytest.approx(expected / (expected + 1))


def test_repeats_together_claim_no_more_than_their_fix():
    """Summed up as a filter does, that takes them for independent."""
    flight = Flight()
    out = fly(make(), flight, 12 * S, regular(flight, sigma_m=0.5))
    for capture, group in itertools.groupby(out, key=lambda entry: entry[1].capture_ns):
        information = sum(1.0 / o.estimate.covariance[0, 0] for _, o in group)
        # Before the rhythm is known, the most repeats there may be are reckoned with.
        least = 0.3 if capture < 2 * S else 0.7
        assert least / 0.25 < information < 1.0 / 0.25


def test_displacement_adds_its_error():
    flight = Flight()
    release = make()
    release.take(flight.fix(S), S + 400 * MS, flight.look)
    first = release.due(S + 400 * MS, flight.look).estimate.covariance
    # 0.4 s at 10 m/s: 3 % of 4 m, and 0.2 m/s of drift; eleven times for the ten repeats reckoned with at first.
    assert first[0, 0] == pytest.approx(11 * (0.25 + 0.12**2 + 0.08**2))
    assert np.linalg.eigvalsh(first).min() > 0


def test_silent_after_a_second_without_a_fix():
    flight = Flight()
    release = make()
    out = fly(release, flight, 6 * S, {S + 300 * MS: flight.fix(S)})
    assert out[-1][0] == S + 1300 * MS
    assert release.counts["repeats_ended"] == 1 and release.next_ns() is None
    again = fly(release, flight, 7 * S, {6 * S + 300 * MS: flight.fix(6 * S)}, start_ns=6 * S)
    assert again[0][1].repeat == 0 and again[0][0] == 6 * S + 300 * MS


def test_silent_when_the_odometry_is_another():
    """The autopilot restarted, its clock stepped, or its velocity was not finite: no displacement across it."""
    flight = Flight()
    flight.epoch_from_ns = 2 * S
    release = make()
    fixes = {S + 800 * MS: flight.fix(S + 500 * MS), 2 * S + 300 * MS: flight.fix(S + 900 * MS)}
    out = fly(release, flight, 4 * S, fixes)
    assert [now for now, o in out if o.capture_ns == S + 500 * MS][-1] < 2 * S
    assert release.counts["repeats_broken"] == 1
    # Captured before, ready after: true at its own stamp, so sent as it is, once.
    late = [o for _, o in out if o.capture_ns == S + 900 * MS]
    assert [o.estimate.stamp_ns for o in late] == [S + 900 * MS]
    assert release.counts["raw_instead"] == 1


def test_clock_step_of_the_autopilot_leaves_no_wrong_estimate():
    """Every estimate is either carried within one odometry or has its capture's stamp; each is where it says."""
    flight = Flight()
    flight.known_from_ns = 0
    release = make()
    out = []
    fixes = regular(flight)
    for now in range(0, 8 * S, 10 * MS):
        if now == 4 * S:  # histories are empty after it
            flight.known_from_ns, flight.epoch_from_ns = 4 * S, 4 * S
        if now in fixes:
            release.take(fixes[now], now, flight.look)
        outgoing = release.due(now, flight.look)
        if outgoing is not None:
            out.append(outgoing.estimate)
    assert len(out) > 50 and release.counts["repeats_broken"] + release.counts["raw_instead"] >= 1
    for estimate in out:
        assert estimate.position_ned_m == pytest.approx(flight.truth(estimate.stamp_ns / S), abs=1e-6)


def test_origin_that_moves_ends_it():
    flight = Flight()
    release = make()
    release.take(flight.fix(S), S + 300 * MS, flight.look)
    assert release.due(S + 300 * MS, flight.look) is not None
    flight.origin = type(ORIGIN)(50.001, 7.0, 100.0)
    assert release.due(S + 400 * MS, flight.look) is None
    assert release.due(S + 500 * MS, flight.look) is None
    assert release.counts["repeats_broken"] == 1


def test_yaw_wrong_by_180_is_noticed_by_the_second_fix():
    """Then the velocity points the other way, and what is carried on by it is 20 m/s off."""
    flight = Flight()
    flight.reported_velocity = -flight.velocity
    release = make()
    fixes = regular(flight, count=30)
    out = fly(release, flight, 10 * S, fixes)
    assert not release.displacement_trusted
    doubted = S + 2 * 500 * MS + 300 * MS
    for now, outgoing in out:
        if now >= doubted:
            # Each once, as it is, with its own stamp.
            assert outgoing.repeat == 0 and outgoing.estimate.stamp_ns == outgoing.capture_ns
            assert outgoing.estimate.position_ned_m == pytest.approx(flight.truth(outgoing.capture_ns / S))
            # An ArduPilot may take it for now: 10 m/s for 0.3 s.
            assert outgoing.estimate.covariance[0, 0] == pytest.approx(0.25 + 3.0**2)
    # Right again, it is believed again.
    flight.reported_velocity = flight.velocity
    later = {k + 20 * S: flight.fix(v.stamp_ns + 20 * S) for k, v in fixes.items()}
    again = fly(release, flight, 30 * S, later, start_ns=20 * S)
    assert release.displacement_trusted and again[-1][1].estimate.stamp_ns == again[-1][0]


def test_one_wild_fix_raises_no_lasting_doubt():
    """It contradicts the one before it and the one after; five that agree end the doubt."""
    flight = Flight()
    release = make()
    trusted = []
    for i in range(15):
        error = (0.0, 30.0 * (i == 5), 0.0)
        release.take(flight.fix(S + i * 500 * MS, error=error), S + i * 500 * MS + 300 * MS, flight.look)
        trusted.append(release.displacement_trusted)
    assert release.counts["contradicted"] == 2
    assert trusted == [True] * 6 + [False] * 5 + [True] * 4


@pytest.mark.parametrize(("counter", "apart_s"), [(2, 0.5), (1, 6.0)])
def test_fixes_that_say_nothing_of_the_displacement_are_not_compared(counter, apart_s):
    """A jump was announced between them; or they are so far apart that odometry may have drifted as much."""
    flight = Flight()
    release = make()
    release.take(flight.fix(S), S + 300 * MS, flight.look)
    stamp = S + round(apart_s * S)
    release.take(flight.fix(stamp, error=(0.0, 30.0, 0.0), counter=counter), stamp + 300 * MS, flight.look)
    assert release.counts["contradicted"] == 0
    release.take(flight.fix(stamp + S, counter=counter), stamp + S + 300 * MS, flight.look)
    assert release.counts["contradicted"] == 1, "it can find something"


def test_capture_stamps_that_step_are_refused():
    flight = Flight()
    release = make()
    assert release.take(flight.fix(3 * S), 2 * S, flight.look) == 1
    assert release.take(flight.fix(S), 2 * S, flight.look) == 0
    assert release.take(flight.fix(S), 2 * S + 100 * MS, flight.look) == 1
    assert release.counts["bad_capture_stamps"] == 2
    (outgoing,) = [release.due(2 * S, flight.look)]
    assert outgoing.capture_ns == S


def test_fixed_latency_holds_each_fix_to_its_age():
    flight = Flight()
    release = make(release="fixed-latency", fixed_latency_ms=600.0)
    ready = [100, 480, 350, 700, 590, 590]
    fixes = {S + (i * 250 + ms) * MS: flight.fix(S + i * 250 * MS) for i, ms in enumerate(ready)}
    out = fly(release, flight, 5 * S, fixes)
    ages = {o.capture_ns: (now - o.estimate.stamp_ns) // MS for now, o in out}
    # More than one is under way at a time; one was ready too late, which no holding back mends.
    assert ages == {S + i * 250 * MS: 700 if ms == 700 else 600 for i, ms in enumerate(ready)}
    assert +release.counts == {"late_for_release": 1}


def test_fixed_latency_has_no_rate():
    assert make(release="fixed-latency", estimate_rate_hz=0.0).mode == "fixed-latency"


@pytest.mark.parametrize("options", [{"release": "raw"}, {"estimate_rate_hz": 0.0}])
def test_raw_is_each_fix_once_as_it_is(options):
    flight = Flight()
    release = make(**options)
    out = fly(release, flight, 6 * S, regular(flight))
    assert [(now, o.estimate.stamp_ns) for now, o in out] == [
        (S + i * 500 * MS + 300 * MS, S + i * 500 * MS) for i in range(10)
    ]
    assert {o.estimate.covariance[0, 0] for _, o in out} == {0.25}


@pytest.mark.parametrize("mode", ["raw", "fixed-latency", "fast-forward"])
def test_what_waited_for_the_line_too_long_is_dropped(mode):
    flight = Flight()
    release = make(release=mode)
    release.take(flight.fix(S), S + 100 * MS, flight.look)
    assert release.due(9 * S, flight.look) is None and release.counts["too_old"] == 1
    assert release.next_ns() is None
    release.take(flight.fix(9 * S), 9 * S + 100 * MS, flight.look)
    assert release.due(9 * S + 990 * MS, flight.look) is not None


def test_how_old_a_fix_may_be_is_the_owners_to_say():
    flight = Flight()
    for mode, is_sent in (("raw", False), ("fast-forward", False), ("fixed-latency", True)):
        # Held to an age, it may have that age and a little more.
        release = Release(LinkOptions(endpoint="udp:x:1", release=mode), max_age_ms=100.0)
        release.take(flight.fix(S), S + 50 * MS, flight.look)
        assert (release.due(S + 260 * MS, flight.look) is not None) is is_sent


def test_the_owner_is_told_when_to_ask():
    flight = Flight()
    for mode, ready, then in (
        ("raw", 0, None), ("fixed-latency", S + 250 * MS, None), ("fast-forward", 25 * MS, S + 360 * MS),
    ):  # fmt: skip
        release = make(release=mode)
        assert release.next_ns() is None
        release.take(flight.fix(S), S + 100 * MS, flight.look)
        assert release.next_ns() == ready
        assert release.due(S + 260 * MS, flight.look) is not None
        assert release.next_ns() == then


def test_a_fix_before_anything_was_heard_is_as_it_is():
    release = make()
    fix = Flight().fix(S)
    release.take(fix, S + 300 * MS, lambda stamp_ns: None)
    assert release.due(S + 300 * MS, lambda stamp_ns: None).estimate is fix


def test_a_fix_held_to_the_longest_age_is_not_too_old():
    flight = Flight()
    release = make(release="fixed-latency", fixed_latency_ms=1000.0)
    release.take(flight.fix(3 * S), 3 * S + 300 * MS, flight.look)
    assert release.due(4 * S + 60 * MS, flight.look) is not None


def test_newer_replaces_what_was_not_sent():
    flight = Flight()
    release = make(release="raw")
    assert release.take(flight.fix(S), 2 * S, flight.look) == 0
    assert release.take(flight.fix(S + 1), 2 * S, flight.look) == 1
    assert release.due(2 * S, flight.look).capture_ns == S + 1
    assert release.due(2 * S, flight.look) is None


def test_never_carried_by_an_attitude_that_is_not_known():
    flight = Flight()
    flight.known_until_ns = S + 200 * MS
    release = make()
    release.take(flight.fix(S), S + 300 * MS, flight.look)
    outgoing = release.due(S + 300 * MS, flight.look)
    assert outgoing.estimate.stamp_ns == S and release.counts["raw_instead"] == 1


@pytest.mark.parametrize(("armed", "landed", "speed_m_s"), [(False, None, 0), (True, True, 0), (True, False, 15)])
def test_the_first_fix_of_an_autopilot_without_a_position(armed, landed, speed_m_s):
    """It tells no velocity until it has one, so there is nothing to carry a fix on by."""
    flight = Flight()

    def look(stamp_ns):
        return replace(
            flight.look(stamp_ns), velocity_ned=None, odometry_ned_m=None, local_position_ned_m=None, armed=armed,
            landed=landed,
        )  # fmt: skip

    release = make()
    release.take(flight.fix(S), S + 400 * MS, look)
    estimate = release.due(S + 400 * MS, look).estimate
    assert estimate.stamp_ns == S
    assert estimate.covariance[0, 0] == pytest.approx(0.25 + (0.4 * speed_m_s) ** 2)
    assert release.due(S + 500 * MS, look) is None


def test_a_place_is_carried_on_as_a_local_position_is():
    """An autopilot without an origin is told of places on WGS 84 only; with one, both are told."""
    flight = Flight()
    flight.origin = None
    local = flight.fix(S)
    start = Place(50.0, 7.0, 100.0, 147.0)
    for fix in (replace(local, position_ned_m=None, place=start), replace(local, place=start)):
        release = make()
        release.take(fix, S + 500 * MS, flight.look)
        estimate = release.due(S + 500 * MS, flight.look).estimate
        assert estimate.stamp_ns == S + 500 * MS
        # Five metres north, of which a degree has 111.2 km.
        assert (estimate.place.latitude_deg - 50.0) * 111_229.0 == pytest.approx(5.0, abs=0.01)
        assert (estimate.place.longitude_deg, estimate.place.height_ellipsoid_m) == pytest.approx((7.0, 147.0))
        assert (estimate.position_ned_m is None) == (fix.position_ned_m is None)


@pytest.mark.parametrize("most_m", [10.0, 100.0])
@pytest.mark.parametrize("sigma_m", [0.5, 3.5, 5.0, 6.5, 9.0])
def test_no_repeat_is_beyond_what_the_filter_believes(sigma_m, most_m):
    """ArduPilot before 4.7 takes 30 m for 10; the sink refuses that, so that a fix of 5 m would never arrive."""
    flight = Flight()
    flight.reported_velocity = flight.velocity = np.zeros(3)
    release = make()
    release.believed = (most_m, 1.5)
    out = fly(release, flight, 8 * S, regular(flight, sigma_m=sigma_m, count=12))
    for capture, group in itertools.groupby(out, key=lambda entry: entry[1].capture_ns):
        sigmas = [float(np.sqrt(o.estimate.covariance[0, 0])) for _, o in group]
        assert max(sigmas) <= most_m
        assert sum(sigma**-2 for sigma in sigmas) <= sigma_m**-2 * (1.0 + 1e-9), "no more than the fix tells"
        assert len(sigmas) == 1 if sigma_m == 9.0 and most_m == 10.0 else len(sigmas) >= 2, capture
    if most_m == 10.0 and sigma_m > 3.5:
        assert release.counts["repeats_fewer"] >= 10
    else:
        assert release.counts["repeats_fewer"] <= 1, "of the last fix only, which nothing follows"
