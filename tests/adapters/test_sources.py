"""When the EKF's source set is switched, what the ground station hears, and which delays the measurements ask for."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest

from ortholoc_edge.adapters.mavlink.audit import audit
from ortholoc_edge.adapters.mavlink.estimates import Autopilot
from ortholoc_edge.adapters.mavlink.herald import Herald
from ortholoc_edge.adapters.mavlink.latency import LatencyMeter, advise, ages_of
from ortholoc_edge.adapters.mavlink.monitor import Fusion, FusionReport
from ortholoc_edge.adapters.mavlink.options import LinkOptions, Severity
from ortholoc_edge.adapters.mavlink.parameters import Answer, Reading
from ortholoc_edge.adapters.mavlink.sources import Outcome, PendingSwitch, Source, SourceSwitch, Switch, Withheld
from ortholoc_edge.pipeline.witness import Consistency, WitnessReport

from .test_audit import health, situation

MS, S = 1_000_000, 1_000_000_000
OK, BAD, SUSPECT, UNKNOWN = Consistency.OK, Consistency.BAD, Consistency.SUSPECT, Consistency.UNKNOWN


def make(**options) -> SourceSwitch:
    return SourceSwitch(LinkOptions(endpoint="udp:x:1", **options))


def decide(switch, consistency, at_s, fresh=True, autopilot=Autopilot.ARDUPILOT, restarts=0, posxy=6, result=0):
    """``result``: what a command is answered at once; None: it is not, in the end."""
    now_ns = round(at_s * S)
    decided = switch.decide(consistency, fresh, autopilot, restarts, now_ns, vision_posxy=posxy)
    if isinstance(decided, Switch):
        taken = switch.settle(Outcome(decided.number, result == 0, result), now_ns)
        assert taken is (decided if result == 0 else None), "announced only if it was accepted"
    return decided


def test_not_unless_enabled_and_of_ardupilot():
    assert decide(make(), BAD, 1) is None
    assert decide(make(switch_sources=True), BAD, 1, autopilot=Autopilot.PX4) is None
    assert decide(make(switch_sources=True), BAD, 1, autopilot=None) is None


def test_to_vision_and_back():
    switch = make(switch_sources=True, vision_source_set=3, gnss_source_set=1)
    assert [decide(switch, c, t) for t, c in enumerate([UNKNOWN, OK, SUSPECT])] == [None] * 3
    there = decide(switch, BAD, 4)
    assert (there.source, there.number) == (Source.VISION, 3) and len(there.text) <= 50
    # Once; and not back before GNSS is good again, nor at once.
    assert [decide(switch, c, 5 + t) for t, c in enumerate([BAD, SUSPECT, UNKNOWN, OK])] == [None] * 4
    back = decide(switch, OK, 20)
    assert (back.source, back.number) == (Source.GNSS, 1) and len(back.text) <= 50
    assert decide(switch, OK, 50) is None


def test_without_fixes_it_stays():
    switch = make(switch_sources=True)
    assert decide(switch, BAD, 1, fresh=False) is None
    assert decide(switch, BAD, 2) is not None


def test_the_operators_choice_stands():
    """GNSS good is no reason to switch to GNSS, unless it was us who left it."""
    assert decide(make(switch_sources=True), OK, 100) is None


def test_a_restarted_autopilot_is_told_again():
    switch = make(switch_sources=True)
    assert decide(switch, BAD, 1) is not None
    assert decide(switch, BAD, 30) is None
    assert decide(switch, BAD, 31, restarts=1).source is Source.VISION


def test_flapping_is_bounded():
    switch = make(switch_sources=True)
    commands = [t for t in range(600) if decide(switch, BAD if t % 2 else OK, t) is not None]
    assert min(b - a for a, b in itertools.pairwise(commands)) >= 15


def test_two_sets_are_needed():
    with pytest.raises(ValueError, match="needs two"):
        make(switch_sources=True, vision_source_set=1)


@pytest.mark.parametrize("send", [("gps_input",), ("global_position_sensor", "gps_input")])
def test_no_switch_to_a_set_that_nothing_feeds(send):
    """To a source set all GPS instances are one source, and ExternalNav hears neither of these messages."""
    with pytest.raises(ValueError, match="add odometry"):
        make(switch_sources=True, send=send)
    assert make(switch_sources=True, send=(*send, "odometry")) and make(send=send)


def test_command_is_said_until_answered():
    pending = PendingSwitch()
    assert pending.due(0) is None and pending.settle(accepted=True, answer=0) is None
    pending.ask(2)
    assert [pending.due(t * 500 * MS) for t in range(4)] == [2, None, 2, None]
    assert pending.take_outcome() is None
    pending.settle(accepted=True, answer=0)
    assert pending.due(100 * S) is None
    assert pending.take_outcome() == Outcome(2, True, 0) and pending.take_outcome() is None
    pending.ask(1)
    assert [pending.due(t * S) for t in range(200, 208)] == [1] * 5 + [None] * 3
    assert pending.take_outcome() == Outcome(1, False, None), "no answer is no consent"


@pytest.mark.parametrize("result", [4, None], ids=["refused", "unanswered"])
def test_a_switch_that_was_not_taken_is_tried_again_more_and_more_seldom(result):
    switch = make(switch_sources=True)
    tries = [t for t in range(1000) if decide(switch, BAD, t, result=result) is not None]
    assert np.diff(tries).tolist()[:6] == [15, 30, 60, 120, 240, 240]
    assert not switch.on_vision
    assert decide(switch, BAD, 2000) is not None and switch.on_vision


def test_a_refused_switch_is_not_switched_back_and_an_unanswered_one_is():
    """The command may have arrived and its answer been lost."""
    refused, unanswered = make(switch_sources=True), make(switch_sources=True)
    decide(refused, BAD, 1, result=4)
    decide(unanswered, BAD, 1, result=None)
    assert decide(refused, OK, 100) is None
    assert decide(unanswered, OK, 100).source is Source.GNSS
    assert decide(unanswered, OK, 200) is None


def test_nothing_is_commanded_while_an_answer_is_awaited():
    switch = make(switch_sources=True)
    assert switch.decide(BAD, True, Autopilot.ARDUPILOT, 0, S, vision_posxy=6) is not None
    assert switch.decide(BAD, True, Autopilot.ARDUPILOT, 0, 100 * S, vision_posxy=6) is None and not switch.on_vision


def test_an_answer_that_belongs_to_no_command_of_ours_changes_nothing():
    switch = make(switch_sources=True)
    assert switch.settle(Outcome(2, True, 0), 0) is None and not switch.on_vision
    commanded = switch.decide(BAD, True, Autopilot.ARDUPILOT, 0, S, vision_posxy=6)
    assert switch.settle(Outcome(commanded.number + 1, True, 0), S) is None and not switch.on_vision


@pytest.mark.parametrize("posxy", [None, 0, 3])
def test_no_switch_to_a_set_that_is_not_known_to_be_of_vision(posxy):
    switch = make(switch_sources=True)
    withheld = decide(switch, BAD, 1, posxy=posxy)
    assert isinstance(withheld, Withheld) and "EK3_SRC2_POSXY" in withheld.text and len(withheld.text) <= 50
    assert [decide(switch, BAD, t, posxy=posxy) for t in range(2, 100)] == [None] * 98, "said once"
    assert isinstance(decide(switch, BAD, 100, posxy=6), Switch)


def report(state: Fusion, reason: str = "why") -> FusionReport:
    return FusionReport(state, 0, reason)


def gnss(state: Consistency, height: float | None = None) -> WitnessReport:
    return WitnessReport(state, 0, 12.3, height)


def test_changes_are_told_once():
    herald = Herald()
    assert herald.tell(report(Fusion.UNKNOWN), gnss(UNKNOWN)) == []
    assert herald.tell(report(Fusion.FUSED), gnss(OK)) == [(Severity.INFO, "OrthoLoC: fixes fused: why")]
    assert herald.tell(report(Fusion.FUSED, "another"), gnss(OK)) == []
    lines = herald.tell(report(Fusion.REJECTED), gnss(SUSPECT))
    assert [severity for severity, _ in lines] == [Severity.WARNING, Severity.WARNING]
    assert herald.tell(report(Fusion.REJECTED), gnss(BAD)) == [
        (Severity.ERROR, "OrthoLoC: GNSS contradicts camera, 12 m apart")
    ]
    assert herald.tell(report(Fusion.REJECTED), gnss(OK)) == [(Severity.INFO, "OrthoLoC: GNSS agrees again")]
    datum = herald.tell(report(Fusion.REJECTED), gnss(OK, 47.6))
    assert datum == [(Severity.WARNING, "OrthoLoC: GNSS is +48 m off map height: datum?")]
    assert herald.tell(report(Fusion.REJECTED), gnss(OK, 47.9)) == []


# -- delays --------------------


def meter(*latencies_ms: float) -> LatencyMeter:
    made = LatencyMeter()
    for latency in latencies_ms:
        made.add(round(latency * MS))
    return made


def test_nothing_measured_nothing_advised():
    assert advise(Autopilot.ARDUPILOT, "raw", meter(), 250.0, 4 * MS) is None


# Of a hundred: 5th percentile 124.95, median 169.5 ms.
SPREAD = [120.0 + i for i in range(100)]


@pytest.mark.parametrize(
    ("mode", "viso"),
    [
        # All that is left is the way, half a round trip of 8 ms.
        ("fast-forward", 4),
        ("fixed-latency", 204),
        # ArduPilot knows of the least delay nothing, and of what is beyond it all.
        ("raw", 129),
    ],
)
def test_viso_delay(mode, viso):
    advice = advise(Autopilot.ARDUPILOT, mode, meter(*SPREAD), 200.0, 8 * MS)
    assert advice.viso_delay_ms == viso and not advice.note
    assert f"VISO_DELAY_MS = {viso}" in str(advice)


def test_without_an_answer_about_time_the_way_counts_for_nothing():
    assert advise(Autopilot.ARDUPILOT, "fixed-latency", meter(100.0), 200.0, None).viso_delay_ms == 200


def test_viso_delay_has_a_limit_that_is_told():
    advice = advise(Autopilot.ARDUPILOT, "raw", meter(400.0, 420.0), 250.0, 8 * MS)
    assert advice.viso_delay_ms == 250 and "fast-forward" in advice.note


def test_the_default_fixed_latency_is_within_the_limit():
    """Half a round trip beyond 250 ms is no latency that anybody could lower; 30 ms are."""
    options = LinkOptions(endpoint="udp:x:1")
    assert not advise(Autopilot.ARDUPILOT, "fixed-latency", meter(*SPREAD), options.fixed_latency_ms, 8 * MS).note
    note = advise(Autopilot.ARDUPILOT, "fixed-latency", meter(*SPREAD), 280.0, 8 * MS).note
    assert "284 ms" in note and "lower fixed_latency_ms" in note


@pytest.mark.parametrize("mode", ["fast-forward", "fixed-latency", "raw"])
def test_px4_needs_no_delay_where_it_synchronises(mode):
    advice = advise(Autopilot.PX4, mode, meter(*SPREAD), 250.0, 8 * MS)
    assert advice.ev_delay_ms == 0 and "EKF2_EV_DELAY = 0" in str(advice) and "VISO" not in str(advice)
    # But it stamps GLOBAL_POSITION_SENSOR on arrival.
    assert advice.agp_delay_ms == {"fast-forward": 4, "fixed-latency": 254, "raw": 174}[mode]
    assert advice.delay_max_ms == {"fast-forward": 10, "fixed-latency": 260, "raw": 230}[mode]


def test_the_filter_must_look_back_to_the_fix_that_came_late():
    assert advise(Autopilot.PX4, "fixed-latency", meter(*SPREAD, 400.0, 400.0), 250.0, 8 * MS).delay_max_ms >= 400


@pytest.mark.parametrize(("mode", "delay"), [("fast-forward", 10), ("fixed-latency", 260), ("raw", 180)])
def test_px4_stamps_by_arrival_on_a_slow_line(mode, delay):
    advice = advise(Autopilot.PX4, mode, meter(*SPREAD), 250.0, 20 * MS)
    assert advice.ev_delay_ms == delay and "round trip of 20 ms" in advice.note


def test_only_a_material_change_is_told():
    first = advise(Autopilot.ARDUPILOT, "raw", meter(*SPREAD), 250.0, 8 * MS)
    near = advise(Autopilot.ARDUPILOT, "raw", meter(*[v + 9 for v in SPREAD]), 250.0, 8 * MS)
    far = advise(Autopilot.ARDUPILOT, "raw", meter(*[v + 60 for v in SPREAD]), 250.0, 8 * MS)
    assert not near.differs(first) and far.differs(first)


@pytest.mark.parametrize("round_trip_ms", [4, 20])
@pytest.mark.parametrize("mode", ["raw", "fixed-latency", "fast-forward"])
def test_the_audit_wants_what_the_daemon_advises(mode, round_trip_ms):
    """Set as advised, a PX4 and an ArduPilot have nothing wrong about delays."""
    ages = ages_of(mode, meter(*SPREAD), 200.0, round_trip_ms * MS)
    for autopilot, sinks in ((Autopilot.ARDUPILOT, "odometry"), (Autopilot.PX4, "odometry"),
                             (Autopilot.PX4, "global_position_sensor")):  # fmt: skip
        advice = advise(autopilot, mode, meter(*SPREAD), 200.0, round_trip_ms * MS)
        values = {
            "VISO_DELAY_MS": advice.viso_delay_ms, "EKF2_EV_DELAY": advice.ev_delay_ms, "EKF2_AGP0_ID": 1,
            "EKF2_AGP0_DELAY": advice.agp_delay_ms, "EKF2_DELAY_MAX": advice.delay_max_ms,
        }  # fmt: skip

        def about_delays(values, autopilot=autopilot, sinks=sinks):
            looked_at = replace(
                situation({}, autopilot, sinks=(sinks,), health=health(autopilot, round_trip_ms=float(round_trip_ms))),
                readings={name: Reading(Answer.VALUE, value, 6) for name, value in values.items()}, ages=ages,
            )  # fmt: skip
            return {finding.subject for finding in audit(looked_at) if "DELAY" in finding.subject}

        assert about_delays(values) == set()
        wrong = {name: value + 100 if name.endswith(("DELAY", "_MS")) else value for name, value in values.items()}
        assert about_delays(wrong), "it can find something"
