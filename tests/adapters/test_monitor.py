"""What the autopilot did with the fixes, as far as what it tells shows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ortholoc_edge.adapters.mavlink.estimates import Autopilot
from ortholoc_edge.adapters.mavlink.geodesy import moved, ned_from_geodetic
from ortholoc_edge.adapters.mavlink.monitor import Fusion, FusionMonitor, FusionReport
from ortholoc_edge.adapters.mavlink.sinks import earth_model
from ortholoc_edge.adapters.mavlink.state import GnssPosition

from .link_scenes import GOOD_FLAGS, MS, ORIGIN, Flight, S


class Filter(Flight):
    """An autopilot whose position starts ``off`` and takes the part ``gain`` of the way to each fix."""

    def __init__(self, gain: float, off=(0.0, 0.0, 0.0), drift=(0.0, 0.0, 0.0)) -> None:
        super().__init__()
        self.gain, self.drift = gain, np.array(drift)
        self.off = np.array(off)
        self.steps: list[tuple[float, np.ndarray]] = [(0.0, self.off)]
        self.position_of = self.believed

    def believed(self, seconds: float) -> np.ndarray:
        off = next(off for at, off in reversed(self.steps) if at <= seconds)
        return self.truth(seconds) + off

    def take(self, estimate, now_ns: int) -> None:
        toward = estimate.position_ned_m - self.believed(estimate.stamp_ns / S)
        self.off = self.off + self.gain * toward + self.drift * 0.5
        self.steps.append((now_ns / S + 0.02, self.off))


def gnss_at(offset_m) -> GnssPosition:
    lat, lon, height = moved(ORIGIN.latitude_deg, ORIGIN.longitude_deg, ORIGIN.height_amsl_m, np.array(offset_m))
    return GnssPosition(lat, lon, height, 1.5, 2.5)


def fly(
    monitor: FusionMonitor, flight: Filter, seconds: float, start_s: float = 0.0, autopilot=Autopilot.ARDUPILOT,
    gnss_off=None, error_m: float = 0.3, hook=lambda t: None,
) -> list[tuple[float, Fusion]]:  # fmt: skip
    """A fix every half second, 100 ms old, and a look at the monitor as often."""
    rng = np.random.default_rng(1)
    states = []
    for i in range(round(seconds * 2)):
        now = round((start_s + 0.5 * (i + 1)) * S)
        hook(now / S)
        if gnss_off is not None:
            flight.gnss = gnss_at(flight.truth((now - 100 * MS) / S) + np.array(gnss_off))
        estimate = flight.fix(now - 100 * MS, error=(*(error_m * rng.standard_normal(2)), 0.0), sigma_m=0.4)
        monitor.sent(estimate, now, flight.look, autopilot)
        flight.take(estimate, now)
        states.append((now / S, monitor.assess(now + 10 * MS, flight.look, autopilot).state))
    return states


def test_silence_ends_what_was_known():
    monitor = FusionMonitor()
    monitor._report = monitor._candidate = FusionReport(Fusion.FUSED, S, "its position follows the fixes")
    report = monitor.silent(9 * S)
    assert report == FusionReport(Fusion.UNKNOWN, 9 * S, "the autopilot is silent")
    assert monitor.silent(10 * S).since_ns == 9 * S


def test_what_was_seen_before_a_silence_is_not_held_against_what_comes_after():
    flight, monitor = Filter(0.0), FusionMonitor()
    monitor.heard("EKF3 IMU0 is using external nav data")
    assert fly(monitor, flight, 8.0, gnss_off=(0.5, 0.0, 0.0))[-1][1] is Fusion.FUSED
    monitor.silent(8 * S)
    assert {s for _, s in fly(monitor, flight, 5.0, 8.5, gnss_off=(0.5, 0.0, 0.0))} == {Fusion.UNKNOWN}


def test_fused_without_gnss():
    monitor = FusionMonitor()
    states = fly(monitor, Filter(0.3), 10.0)
    assert states[0][1] is Fusion.UNKNOWN and states[-1][1] is Fusion.FUSED
    assert len({s for _, s in states}) == 2
    assert 2 * S < monitor.report.since_ns < 6 * S


def test_where_the_fixes_are_is_fused_though_nothing_moves():
    monitor = FusionMonitor()
    assert fly(monitor, Filter(0.0), 10.0, error_m=0.0)[-1][1] is Fusion.FUSED


@pytest.mark.parametrize("missing", ["state", "position", "odometry", "epoch", "origin"])
def test_what_is_not_known_shows_nothing(missing):
    """A position 5 m off, which would be "ignored"; but nobody knows whether it moves."""
    flight, monitor = Filter(0.0, off=(4.0, 3.0, 0.0)), FusionMonitor()
    whole = flight.look

    def look(stamp_ns):
        # Each answer is looked for 0.7 s after its fix: known at the one, not at the other.
        state = whole(stamp_ns)
        if round(stamp_ns / S * 2) % 2 or missing == "position":
            return {
                "state": None,
                "position": replace(state, local_position_ned_m=None),
                "odometry": replace(state, odometry_ned_m=None),
                "epoch": replace(state, odometry_epoch=7),
                "origin": replace(state, origin=None),
            }[missing]
        return state

    flight.look = look
    assert {s for _, s in fly(monitor, flight, 12.0)} == {Fusion.UNKNOWN}


def test_on_the_way_to_the_fixes_is_fused():
    """Slowly: 10 % of the way in each half second."""
    monitor = FusionMonitor()
    states = fly(monitor, Filter(0.1, off=(60.0, 0.0, 0.0)), 9.0)
    assert states[-1][1] is Fusion.FUSED and Fusion.IGNORED not in {s for _, s in states}


def test_position_that_does_not_move_to_the_fixes_is_ignored():
    monitor = FusionMonitor()
    states = fly(monitor, Filter(0.0, off=(4.0, 3.0, 0.0)), 12.0)
    assert states[-1][1] is Fusion.IGNORED
    assert "stays 5." in monitor.report.reason or "stays 4.9" in monitor.report.reason
    assert "EK3_SRCn_POSXY" in monitor.report.reason


def test_dead_reckoning_that_drifts_away_is_ignored():
    monitor = FusionMonitor()
    states = fly(monitor, Filter(0.0, drift=(1.0, 0.0, 0.0)), 20.0)
    assert states[-1][1] is Fusion.IGNORED


@pytest.mark.parametrize("flags", [0x01 | 0x02 | 0x04 | 0x20 | 0x80, 0x01 | 0x02 | 0x04 | 0x20, GOOD_FLAGS | 0x80])
def test_no_absolute_position_though_fixes_are_sent(flags):
    flight = Filter(0.0)
    flight.flags = flags
    monitor = FusionMonitor()
    states = fly(monitor, flight, 8.0)
    assert states[-1][1] is Fusion.IGNORED and "no absolute position" in monitor.report.reason
    px4 = FusionMonitor()
    fly(px4, flight, 8.0, autopilot=Autopilot.PX4)
    assert "EKF2_EV_CTRL" in px4.report.reason


def test_ratio_above_one_is_refused_and_wavering_does_not_flutter():
    flight, monitor = Filter(0.3), FusionMonitor()
    fly(monitor, flight, 10.0)
    assert monitor.report.state is Fusion.FUSED
    flight.ratio = 0.9
    assert {s for _, s in fly(monitor, flight, 3.0, start_s=7.0)} == {Fusion.FUSED}
    flight.ratio = 1.6
    states = fly(monitor, flight, 5.0, start_s=10.0)
    changed = next(t for t, s in states if s is Fusion.REJECTED)
    assert 12.0 <= changed <= 13.0 and "ratio 1.6" in monitor.report.reason
    assert monitor.report.since_ns == pytest.approx(10.5 * S, abs=S)

    def waver(t: float) -> None:
        flight.ratio = 0.9 if round(t * 2) % 2 else 1.1

    states = fly(monitor, flight, 20.0, start_s=15.0, hook=waver)
    assert {s for _, s in states} == {Fusion.REJECTED}
    # Below the limit, but not so far that it is accepted again.
    flight.ratio = 0.9
    assert {s for _, s in fly(monitor, flight, 5.0, start_s=35.0)} == {Fusion.REJECTED}
    flight.ratio = 0.3
    assert fly(monitor, flight, 8.0, start_s=40.0)[-1][1] is Fusion.FUSED


def test_a_single_high_ratio_changes_nothing():
    flight, monitor = Filter(0.3), FusionMonitor()
    fly(monitor, flight, 10.0)

    def once(t: float) -> None:
        flight.ratio = 3.0 if t == 12.0 else 0.2

    assert {s for _, s in fly(monitor, flight, 6.0, start_s=10.0, hook=once)} == {Fusion.FUSED}


@pytest.mark.parametrize(("at", "expected"), [("gnss", Fusion.IGNORED), ("fixes", Fusion.FUSED)])
def test_between_fixes_and_gnss(at, expected):
    """GNSS 6 m beside, a spoofer's or a datum's: whose position is the autopilot's?"""
    beside = (0.0, 6.0, 0.0)
    flight = Filter(0.0, off=beside if at == "gnss" else (0.3, 0.0, 0.0))
    monitor = FusionMonitor()
    assert fly(monitor, flight, 12.0, gnss_off=beside)[-1][1] is expected
    assert "GNSS, 6." in monitor.report.reason or "GNSS, 5.9" in monitor.report.reason
    px4 = FusionMonitor()
    fly(px4, flight, 12.0, gnss_off=beside, autopilot=Autopilot.PX4)
    assert ("relative" in px4.report.reason) == (at == "gnss")


def test_a_position_in_the_middle_is_nobodys():
    monitor = FusionMonitor()
    assert fly(monitor, Filter(0.0, off=(0.0, 3.0, 0.0)), 12.0, gnss_off=(0.0, 6.0, 0.0))[-1][1] is Fusion.UNKNOWN


def test_agreement_of_all_shows_nothing_unless_it_says_so():
    flight, monitor = Filter(0.0), FusionMonitor()
    assert fly(monitor, flight, 10.0, gnss_off=(0.5, 0.0, 0.0))[-1][1] is Fusion.UNKNOWN
    monitor.heard("EKF3 IMU0 is using external nav data")
    assert fly(monitor, flight, 5.0, 10.0, gnss_off=(0.5, 0.0, 0.0))[-1][1] is Fusion.FUSED
    monitor.heard("PreArm: Compass not calibrated")
    assert fly(monitor, flight, 1.0, 14.0, gnss_off=(0.5, 0.0, 0.0))[-1][1] is Fusion.FUSED
    monitor.heard("EKF3 IMU0 is using GPS")
    assert fly(monitor, flight, 5.0, 15.0, gnss_off=(0.5, 0.0, 0.0))[-1][1] is Fusion.IGNORED
    # What is said of another source set ends what it said before.
    monitor.heard("Using EKF Source Set 2")
    assert fly(monitor, flight, 5.0, 20.0, gnss_off=(0.5, 0.0, 0.0))[-1][1] is Fusion.UNKNOWN


def test_what_it_does_counts_more_than_what_it_said():
    monitor = FusionMonitor()
    monitor.heard("EKF3 IMU0 is using external nav data")
    beside = (8.0, 0.0, 0.0)
    assert fly(monitor, Filter(0.0, off=beside), 12.0, gnss_off=beside)[-1][1] is Fusion.IGNORED


def test_no_fixes_no_verdict():
    flight, monitor = Filter(0.3), FusionMonitor()
    fly(monitor, flight, 10.0)
    for i in range(20):
        report = monitor.assess(10 * S + i * S // 2, flight.look, Autopilot.ARDUPILOT)
    assert report.state is Fusion.UNKNOWN and "lately" in report.reason


@pytest.mark.parametrize(
    ("flags", "reason"), [(None, "tells nothing"), (GOOD_FLAGS | 1024, "not started")]
)
def test_a_filter_that_says_nothing_yet(flags, reason):
    flight, monitor = Filter(0.3), FusionMonitor()
    flight.flags = flags
    assert fly(monitor, flight, 10.0)[-1][1] is Fusion.UNKNOWN
    assert reason in monitor.report.reason


def test_the_bit_of_a_filter_that_has_not_started_is_another_one_of_px4s():
    flight, monitor = Filter(0.3), FusionMonitor()
    flight.flags = GOOD_FLAGS | 1024
    assert fly(monitor, flight, 10.0, autopilot=Autopilot.PX4)[-1][1] is Fusion.FUSED


def test_gnss_of_the_scene_is_where_it_is_put():
    """Else the tests above would compare with another place."""
    place = gnss_at((30.0, -40.0, 0.0))
    ned = ned_from_geodetic(
        ORIGIN, place.latitude_deg, place.longitude_deg, place.height_amsl_m, earth_model(Autopilot.ARDUPILOT)
    )
    assert ned == pytest.approx([30.0, -40.0, 0.0], abs=0.3)
