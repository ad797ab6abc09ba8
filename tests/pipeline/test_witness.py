"""GNSS against the camera: what raises an alarm, what does not, how long it takes, and how it is called off."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ortholoc_edge.pipeline.witness import Consistency, Witness, WitnessOptions

S = 1_000_000_000
# As telemetry's floor for GNSS and a fix of 0.5 m have it.
BOTH = np.eye(2) * (1.5**2 + 0.5**2)


class Watch:
    """A witness fed at a fixed rate."""

    def __init__(self, rate_hz: float = 2.0, seed: int = 1, **options) -> None:
        self.witness = Witness(WitnessOptions(**options))
        self.rate_hz, self.t = rate_hz, 0.0
        self.rng = np.random.default_rng(seed)
        self.states: list[tuple[float, Consistency]] = []

    def run(self, seconds: float, apart=lambda t: (0.0, 0.0, 0.0), noise_m: float = 0.7) -> Consistency:
        start = self.t
        while self.t < start + seconds:
            self.t += 1.0 / self.rate_hz
            difference = np.array(apart(self.t - start)) + noise_m * np.append(self.rng.standard_normal(2), 0.0)
            self.witness.compare(round(self.t * S), difference, BOTH)
            self.states.append((self.t, self.witness.report.state))
        return self.state

    @property
    def state(self) -> Consistency:
        return self.witness.report.state

    def first(self, state: Consistency, after: float = 0.0) -> float:
        return next((t - after for t, s in self.states if s is state and t >= after), math.inf)


def test_ok_only_after_enough_was_compared():
    watch = Watch()
    assert watch.state is Consistency.UNKNOWN and watch.witness.trusted
    assert watch.run(3.0) is Consistency.UNKNOWN
    assert watch.run(4.0) is Consistency.OK and watch.witness.trusted


@pytest.mark.parametrize(("speed_m_s", "limit_s"), [(0.5, 30.0), (1.0, 16.0), (2.0, 10.0)])
@pytest.mark.parametrize("rate_hz", [1.0, 2.0, 5.0])
def test_spoof_ramp_is_noticed_in_time(speed_m_s, limit_s, rate_hz):
    """Each step of it is within every gate: 2 m/s at five a second are 0.4 m."""
    for seed in range(10):
        watch = Watch(rate_hz, seed)
        watch.run(30.0)
        watch.run(60.0, lambda t: (0.6 * speed_m_s * t, 0.8 * speed_m_s * t, 0.0))
        suspect, bad = (watch.first(state, 30.0) for state in (Consistency.SUSPECT, Consistency.BAD))
        assert suspect < bad < limit_s
        assert not watch.witness.trusted and watch.state is Consistency.BAD


@pytest.mark.parametrize("bias_m", [0.0, 2.0, 4.0])
def test_a_constant_bias_is_no_alarm(bias_m):
    """ETRS89 against WGS 84, a receiver's bias, a map that lies a little beside."""
    watch = Watch()
    watch.run(3600.0, lambda t: (bias_m, 0.0, 0.0))
    assert {state for _, state in watch.states} == {Consistency.UNKNOWN, Consistency.OK}


def test_wild_fixes_are_no_alarm_each_alone():
    watch = Watch()
    watch.run(10.0)
    watch.run(600.0, lambda t: (80.0, 0.0, 0.0) if round(t * 2) % 8 == 0 else (0.0, 0.0, 0.0))
    assert Consistency.SUSPECT not in {state for _, state in watch.states}


def test_called_off_only_after_long_agreement_and_told_apart_from_a_pause():
    watch = Watch()
    watch.run(20.0)
    assert watch.run(30.0, lambda t: (20.0, 0.0, 0.0)) is Consistency.BAD
    # A spoofer who lets go for some seconds, again and again.
    for _ in range(5):
        assert watch.run(12.0) is Consistency.BAD
        assert watch.run(3.0, lambda t: (20.0, 0.0, 0.0)) is Consistency.BAD
    end = watch.t
    assert watch.run(60.0) is Consistency.OK
    assert 20.0 < watch.first(Consistency.OK, end) < 45.0


def test_between_suspect_and_ok_it_does_not_flutter():
    """A difference around the limit that comes and goes."""
    watch = Watch()
    watch.run(20.0)
    watch.run(600.0, lambda t: (4.5 * 1.58 if t % 20.0 < 10.0 else 0.0, 0.0, 0.0), noise_m=0.3)
    changes = sum(a is not b for (_, a), (_, b) in itertools.pairwise(watch.states))
    assert changes <= 4


def test_nothing_to_compare_is_nothing_known():
    watch = Watch()
    watch.run(20.0)
    watch.run(30.0, lambda t: (20.0, 0.0, 0.0))
    watch.witness.tick(round((watch.t + 59.0) * S))
    assert watch.state is Consistency.BAD
    watch.witness.tick(round((watch.t + 61.0) * S))
    assert watch.state is Consistency.UNKNOWN and watch.witness.trusted and watch.witness.report.apart_m is None
    watch.t += 61.0
    assert watch.run(3.0) is Consistency.UNKNOWN


def test_a_long_silence_is_no_evidence():
    """One difference after ten seconds counts for one second: 48, of the 100 that are bad."""
    watch = Watch(rate_hz=0.1)
    watch.run(20.0, lambda t: (50.0, 0.0, 0.0))
    assert watch.state is Consistency.SUSPECT


def test_datum_50_m_off_is_told_as_such_and_not_as_spoofing():
    watch = Watch()
    assert watch.run(60.0, lambda t: (0.0, 0.0, 48.0)) is Consistency.OK
    assert watch.witness.report.height_apart_m == pytest.approx(48.0)
    assert watch.run(60.0, lambda t: (0.0, 0.0, 3.0)) is Consistency.OK
    assert watch.witness.report.height_apart_m is None


@pytest.mark.parametrize(
    ("difference", "covariance"),
    [
        ((math.nan, 0.0, 0.0), BOTH),
        ((0.0, 0.0, math.inf), BOTH),
        ((90.0, 0.0, 0.0), np.zeros((2, 2))),
        ((90.0, 0.0, 0.0), np.full((2, 2), math.nan)),
        ((90.0, 0.0, 0.0), -BOTH),
    ],
)
def test_garbage_is_left_out(difference, covariance):
    watch = Watch()
    watch.run(20.0)
    for i in range(100):
        watch.witness.compare(round((watch.t + i) * S), np.array(difference), covariance)
    assert watch.state is Consistency.OK


def test_stamps_that_step_back_count_nothing():
    watch = Watch()
    watch.run(20.0)
    for _ in range(100):
        watch.witness.compare(round(10.0 * S), np.array([90.0, 0.0, 0.0]), BOTH)
    assert watch.state is Consistency.OK


@given(
    st.floats(-50, 50), st.floats(-50, 50), st.floats(0.3, 5.0), st.floats(0.3, 5.0), st.floats(-0.9, 0.9),
)  # fmt: skip
def test_the_statistic_is_the_mahalanobis_distance(east, north, a, b, correlation):
    covariance = np.array([[a * a, correlation * a * b], [correlation * a * b, b * b]])
    difference = np.array([east, north, 0.0])
    squared = float(difference[:2] @ np.linalg.solve(covariance, difference[:2]))
    lower = Watch(most=1e9, reference=max(2.01, squared * 1.001), suspect_score=1e-3, bad_score=1e9)
    upper = Watch(most=1e9, reference=max(2.01, squared * 0.999), suspect_score=1e-6, bad_score=1e9)
    for i in range(20):
        lower.witness.compare(i * S, difference, covariance)
        upper.witness.compare(i * S, difference, covariance)
    assert lower.state is Consistency.OK
    assert upper.state is (Consistency.SUSPECT if squared * 0.999 > 2.01 else Consistency.OK)


@pytest.mark.parametrize("bad", [{"suspect_score": 100.0, "bad_score": 100.0}, {"reference": 64.0, "most": 64.0}])
def test_options_that_contradict_each_other(bad):
    with pytest.raises(ValueError, match="is not below"):
        WitnessOptions(**bad)
