"""The rules: each on a set-up that works but for what it is about."""

from __future__ import annotations

from dataclasses import replace

import pytest

from ortholoc_edge.adapters.mavlink.audit import Finding, Level, Situation, audit, parameters_wanted
from ortholoc_edge.adapters.mavlink.census import LinkHealth, Peer
from ortholoc_edge.adapters.mavlink.estimates import Autopilot
from ortholoc_edge.adapters.mavlink.geodesy import GeodeticOrigin
from ortholoc_edge.adapters.mavlink.latency import Ages
from ortholoc_edge.adapters.mavlink.parameters import Answer, Reading
from ortholoc_edge.adapters.mavlink.state import AutopilotIdentity

from .firmware_parameters import ARDUPILOT_READY, ARDUPILOT_STOCK, PX4_STOCK, PX4_WITH_SLOTS

ARDUPILOT, PX4 = Autopilot.ARDUPILOT, Autopilot.PX4
STREAMS = {"ATTITUDE_QUATERNION": 50.0, "LOCAL_POSITION_NED": 20.0, "GPS_RAW_INT": 2.0}
PX4_READY = {**PX4_STOCK, "EKF2_EV_CTRL": 1, "EKF2_HGT_REF": 0, "MAV_0_MODE": 2}


def health(autopilot=ARDUPILOT, version=(4, 5, 7), **changes) -> LinkHealth:
    good = LinkHealth(
        peers=(Peer(7, 1, autopilot.value, "quadrotor"), Peer(255, 190, None, "ground station")),
        vehicle=AutopilotIdentity(7, autopilot, version),
        connected=True,
        wanted_system_id=0,
        own_id_heard=False,
        mavlink1=0,
        mavlink2=1000,
        bad_bytes=0,
        rates_hz=STREAMS,
        wanted_rates_hz=STREAMS,
        round_trip_ms=1.5,
        synchronised=True,
        origin=GeodeticOrigin(50.7, 7.1, 60.0),
        set_origin=False,
    )
    return replace(good, **changes)


def aged(latency_ms: float | None) -> Ages | None:
    return None if latency_ms is None else Ages(latency_ms, latency_ms, latency_ms)


def readings(autopilot, sinks, parameters) -> dict[str, Reading]:
    def reading(name):
        if name not in parameters:
            return Reading(Answer.ABSENT)
        return Reading(Answer.VALUE, parameters[name], 6 if isinstance(parameters[name], int) else 9)

    return {name: reading(name) for name in parameters_wanted(autopilot, sinks)}


def situation(parameters, autopilot=ARDUPILOT, version=(4, 5, 7), sinks=("odometry",), **changes) -> Situation:
    return Situation(
        autopilot=autopilot,
        firmware=version,
        sinks=frozenset(sinks),
        health=changes.pop("health", health(autopilot, version)),
        readings=readings(autopilot, sinks, parameters),
        lever_arm_m=changes.pop("lever_arm_m", (0.1, 0.0, 0.05)),
        **changes,
    )


def px4(parameters, version=(1, 14, 3), **changes) -> Situation:
    return situation(parameters, PX4, version, **changes)


def serious(findings: list[Finding]) -> list[tuple[str, str]]:
    return [(f.level.value, f.subject) for f in findings if f.level is not Level.NOTE]


# -- set-ups that work -----------------------------------------------------------


def test_what_works_has_nothing_wrong():
    ready = {**ARDUPILOT_READY, "VISO_DELAY_MS": 150}
    assert audit(situation(ready, ages=aged(150.0))) == []
    assert serious(audit(px4(PX4_READY, ages=aged(150.0)))) == []
    slots = {**PX4_WITH_SLOTS, "EKF2_HGT_REF": 0, "MAV_0_MODE": 2}
    slots |= {"EKF2_AGP1_ID": 1, "EKF2_AGP1_CTRL": 1, "EKF2_AGP1_DELAY": 150.0}
    assert audit(px4(slots, (1, 18, 0), sinks=("global_position_sensor",), ages=aged(150.0))) == []


def test_stock_firmware_and_the_commands_that_mend_it():
    """What --fix sets on a stock autopilot is just what makes the set-up that works."""
    for parameters, make, wanted in (
        (ARDUPILOT_STOCK, situation, {"VISO_TYPE": 1, "EK3_SRC2_POSXY": 6}),
        (PX4_STOCK, px4, {"EKF2_EV_CTRL": 1, "EKF2_HGT_REF": 0}),
    ):
        findings = audit(make(parameters))
        changes = dict(f.change for f in findings if f.change)
        assert changes == wanted
        assert all(f.remedy == f"param set {f.change[0]} {f.change[1]}" for f in findings if f.change)
        mended = audit(make({**parameters, **changes}))
        assert serious(mended) == []


def test_the_worst_comes_first():
    levels = [f.level for f in audit(px4({**PX4_STOCK, "EKF2_NOAID_TOUT": 500_000}))]
    assert levels == sorted(levels, key=list(Level).index) and len(set(levels)) == 3


# -- one thing wrong -------------------------------------------------------------

ARDUPILOT_WRONG = [
    ("AHRS_EKF_TYPE", 2, Level.ERROR, 3),
    ("EK3_ENABLE", 0, Level.ERROR, 1),
    ("VISO_TYPE", 2, Level.ERROR, 1),
    ("VISO_TYPE", 3, Level.ERROR, 1),
    ("VISO_SCALE", 2.0, Level.ERROR, 1),
    ("VISO_ORIENT", 25, Level.WARNING, 0),
    ("VISO_QUAL_MIN", 50, Level.WARNING, 0),
    ("VISO_POS_M_NSE", 5.0, Level.WARNING, 0.2),
    ("VISO_POS_M_NSE", -1.0, Level.WARNING, 0.2),
    ("VISO_POS_X", 0.2, Level.ERROR, 0),
    ("EK3_POS_I_GATE", 100, Level.WARNING, 500),
    ("EK3_GLITCH_RAD", 5, Level.WARNING, 25),
    ("EK3_SRC2_VELXY", 6, Level.ERROR, 0),
    ("EK3_SRC2_VELXY", 3, Level.ERROR, 0),
    ("EK3_SRC2_VELZ", 3, Level.ERROR, 0),
    ("EK3_SRC2_POSZ", 3, Level.ERROR, 1),
    ("EK3_SRC2_YAW", 6, Level.WARNING, 1),
    ("EK3_SRC2_YAW", 2, Level.WARNING, 1),
]
PX4_WRONG = [
    ("EKF2_EV_CTRL", 2, Level.ERROR, 3),
    ("EKF2_EV_CTRL", 15, Level.WARNING, 3),
    ("EKF2_EV_NOISE_MD", 1, Level.WARNING, 0),
    ("EKF2_EVP_NOISE", 3.0, Level.WARNING, 0.1),
    ("EKF2_EV_QMIN", 40, Level.WARNING, 0),
    ("EKF2_EV_POS_Z", 0.1, Level.ERROR, 0),
    ("EKF2_HGT_REF", 1, Level.WARNING, 0),
    ("EKF2_HGT_REF", 3, Level.WARNING, 0),
    ("EKF2_EV_DELAY", 150.0, Level.WARNING, 0),
    ("EKF2_NOAID_TOUT", 1_000_000, Level.WARNING, 5_000_000),
]


@pytest.mark.parametrize(("name", "found", "level", "wanted"), ARDUPILOT_WRONG)
def test_each_of_ardupilots(name, found, level, wanted):
    findings = audit(situation({**ARDUPILOT_READY, name: found}))
    assert serious(findings) == [(level.value, name)]
    assert findings[0].change == (name, wanted) and findings[0].found == f"{found:g}"


@pytest.mark.parametrize(("name", "found", "level", "wanted"), PX4_WRONG)
def test_each_of_px4s(name, found, level, wanted):
    findings = audit(px4({**PX4_READY, name: found}))
    assert serious(findings) == [(level.value, name)]
    assert findings[0].change == (name, wanted)


def test_every_reason_ends_without_a_dot_and_says_something():
    for parameters, make, wrong in ((ARDUPILOT_READY, situation, ARDUPILOT_WRONG), (PX4_READY, px4, PX4_WRONG)):
        for name, found, _, _ in wrong:
            for finding in audit(make({**parameters, name: found})):
                assert len(finding.why) > 20 and not finding.why.endswith(".") and finding.remedy


def test_source_set_one_serves_as_well():
    parameters = {**ARDUPILOT_STOCK, "VISO_TYPE": 1, "EK3_SRC1_POSXY": 6, "EK3_SRC1_VELXY": 0, "EK3_SRC1_VELZ": 0}
    findings = audit(situation(parameters))
    assert serious(findings) == []
    assert "source switch" not in [f.subject for f in findings]


def test_a_vision_set_that_no_switch_reaches_is_noted():
    findings = audit(situation({**ARDUPILOT_READY, "RC8_OPTION": 0}))
    assert serious(findings) == [] and "source switch" in [f.subject for f in findings]


def test_velocities_of_all_sets_are_noted_where_there_are_some():
    stock = {**ARDUPILOT_READY, "EK3_SRC_OPTIONS": 3}
    (finding,) = audit(situation(stock, ages=aged(10.0)))
    assert (finding.level, finding.subject, finding.change) == (Level.NOTE, "EK3_SRC_OPTIONS", None)
    assert finding.remedy == "param set EK3_SRC_OPTIONS 2"
    without = {**stock, "EK3_SRC1_VELXY": 0}
    assert audit(situation(without, ages=aged(10.0))) == []
    assert audit(situation({**stock, "EK3_SRC_OPTIONS": 2}, ages=aged(10.0))) == []


def test_gates_that_refuse_nothing_are_noted_not_changed():
    (finding,) = (f for f in audit(situation({**ARDUPILOT_READY, "EK3_GLITCH_RAD": 0})) if "GLITCH" in f.subject)
    assert finding.level is Level.NOTE and finding.change is None


# -- latency and lever arm ---------------------------------------------------------


def test_delay_follows_the_measured_latency():
    def at(latency_ms, delay):
        return audit(situation({**ARDUPILOT_READY, "VISO_DELAY_MS": delay}, ages=aged(latency_ms)))

    assert at(165.0, 150) == []
    (wrong,) = at(200.0, 10)
    assert wrong.change == ("VISO_DELAY_MS", 200) and wrong.reboot
    (late,) = at(400.0, 250)
    assert late.level is Level.ERROR and late.change is None and "250" in late.why
    (unknown,) = at(None, 10)
    assert unknown.level is Level.NOTE


def test_half_a_round_trip_above_the_range_is_no_error():
    """fixed_latency_ms is 250 unless set, which is also the end of the parameter's range."""
    (finding,) = audit(situation(ARDUPILOT_READY, ages=aged(251.0)))
    assert finding.change == ("VISO_DELAY_MS", 250)
    assert audit(situation({**ARDUPILOT_READY, "VISO_DELAY_MS": 250}, ages=aged(251.0))) == []


def test_px4_looks_back_as_far_as_the_latency():
    findings = audit(px4(PX4_READY, ages=aged(260.0)))
    assert [f.change for f in findings if f.change] == [("EKF2_DELAY_MAX", 310)]
    slots = {**PX4_WITH_SLOTS, "EKF2_HGT_REF": 0, "EKF2_AGP0_ID": 1, "EKF2_AGP0_CTRL": 1}
    findings = audit(px4(slots, (1, 18, 0), sinks=("global_position_sensor",), ages=aged(400.0)))
    assert {f.change for f in findings if f.change} == {("EKF2_DELAY_MAX", 450), ("EKF2_AGP0_DELAY", 400)}


def test_px4s_delay_is_the_latency_only_where_its_timesync_cannot_converge():
    slow = health(PX4, (1, 14, 3), round_trip_ms=15.0)
    findings = audit(px4(PX4_READY, health=slow, ages=aged(150.0)))
    assert [f.change for f in findings if f.change] == [("EKF2_EV_DELAY", 150)]


@pytest.mark.parametrize(
    ("ours", "theirs", "level"),
    [((0.1, 0, 0), 0.2, Level.ERROR), ((0.0, 0, 0), 0.2, None), (None, 0.2, Level.WARNING), ((0.1, 0, 0), 0.0, None)],
)
def test_lever_arm_once(ours, theirs, level):
    findings = [f for f in audit(situation({**ARDUPILOT_READY, "VISO_POS_X": theirs}, lever_arm_m=ours))
                if f.subject == "VISO_POS_X"]  # fmt: skip
    assert [f.level for f in findings] == ([] if level is None else [level])


# -- other messages ----------------------------------------------------------------


def test_gps_input_needs_an_instance_and_no_velocity():
    findings = audit(situation(ARDUPILOT_STOCK, sinks=("gps_input",)))
    assert {f.change for f in findings if f.change} == {("GPS_TYPE2", 14), ("EK3_SRC1_VELXY", 0)}
    newer = {k: v for k, v in ARDUPILOT_STOCK.items() if not k.startswith("GPS_")} | {"GPS1_TYPE": 1, "GPS2_TYPE": 0}
    findings = audit(situation(newer, sinks=("gps_input",), version=(4, 6, 0)))
    assert ("GPS2_TYPE", 14) in {f.change for f in findings}
    good = {**ARDUPILOT_STOCK, "GPS_TYPE2": 14, "EK3_SRC1_VELXY": 0}
    assert audit(situation(good, sinks=("gps_input",))) == []


def test_gps_inputs_type_is_that_of_the_instance_addressed():
    first = {**ARDUPILOT_STOCK, "GPS_TYPE": 14, "EK3_SRC1_VELXY": 0}
    assert audit(situation(first, sinks=("gps_input",), gps_id=0)) == []
    (finding,) = audit(situation(first, sinks=("gps_input",)))
    assert finding.change == ("GPS_TYPE2", 14) and "gps_id = 1" in finding.why
    alone = {k: v for k, v in first.items() if k != "GPS_TYPE2"}
    (finding,) = audit(situation(alone, sinks=("gps_input",)))
    assert finding.level is Level.ERROR and finding.change is None and "[link] gps_id" in finding.remedy


def test_auxiliary_position_needs_a_slot_with_our_id():
    sinks = ("global_position_sensor",)
    base = {**PX4_WITH_SLOTS, "EKF2_HGT_REF": 0, "EKF2_AGP0_ID": 9}
    findings = audit(px4(base, (1, 18, 0), sinks=sinks, sensor_id=3))
    assert {f.change for f in findings if f.change} == {("EKF2_AGP1_ID", 3), ("EKF2_AGP1_CTRL", 1)}
    full = base | {f"EKF2_AGP{n}_ID": 9 for n in range(4)}
    (finding,) = (f for f in audit(px4(full, (1, 18, 0), sinks=sinks)) if f.level is Level.ERROR)
    assert finding.change is None and "four" in finding.found


@pytest.mark.parametrize(("older", "text"), [({"EKF2_AGP_CTRL": 1}, "ROS 2 only"), ({}, "not heard")])
def test_firmware_without_auxiliary_position_over_mavlink(older, text):
    findings = audit(px4({**PX4_READY, **older}, sinks=("global_position_sensor",)))
    assert [f.subject for f in findings if f.level is Level.ERROR] == ["EKF2_AGP0_ID"]
    assert text in findings[0].why


def test_quality_of_a_message_that_has_none():
    found = audit(px4({**PX4_READY, "EKF2_EV_QMIN": 1}, sinks=("vision_position_estimate",)))
    assert serious(found) == [("error", "EKF2_EV_QMIN")]


# -- what is missing -----------------------------------------------------------------


def test_firmware_without_what_is_needed():
    bare = {k: v for k, v in ARDUPILOT_READY.items() if not k.startswith("VISO_")}
    assert serious(audit(situation(bare))) == [("error", "VISO_TYPE")]
    bare = {k: v for k, v in PX4_READY.items() if k != "EKF2_EV_CTRL"}
    assert serious(audit(px4(bare))) == [("error", "EKF2_EV_CTRL")]
    bare = {k: v for k, v in ARDUPILOT_READY.items() if k != "EK3_ENABLE"}
    assert serious(audit(situation(bare))) == [("error", "EK3_ENABLE")]


def test_what_was_not_read_is_not_judged():
    now = situation(ARDUPILOT_STOCK)
    for answer in (Answer.SILENT, Answer.UNREADABLE, Answer.OPEN):
        silent = replace(now, readings={name: Reading(answer) for name in now.readings})
        assert serious(audit(silent)) == [("error", "parameters")]
        one = replace(situation(ARDUPILOT_READY), readings=now.readings | {"VISO_TYPE": Reading(answer)})
        assert ("warning", "parameters") in serious(audit(one))
        assert "VISO_TYPE" not in [f.subject for f in audit(one)]


def test_firmware_of_unknown_or_old_version():
    assert serious(audit(situation(ARDUPILOT_READY, version=None))) == [("warning", "firmware")]
    assert serious(audit(situation(ARDUPILOT_READY, version=(4, 4, 4)))) == [("warning", "firmware")]
    assert serious(audit(px4(PX4_READY, version=(1, 13, 3)))) == [("warning", "firmware")]


# -- the link ------------------------------------------------------------------------

NOBODY = {"vehicle": None, "connected": False, "rates_hz": {}, "wanted_rates_hz": {}, "round_trip_ms": None,
          "synchronised": False, "origin": None}  # fmt: skip


def silent(**changes) -> Situation:
    now = health(**{**NOBODY, "mavlink2": 0, **changes})
    return Situation(None, None, frozenset({"odometry"}), now, {})


@pytest.mark.parametrize(
    ("changes", "subject", "text"),
    [
        ({"peers": ()}, "heartbeat", "not one byte"),
        ({"peers": (), "bad_bytes": 900}, "heartbeat", "baud rates"),
        ({"peers": (Peer(255, 190, None, "ground station"),)}, "heartbeat", "router"),
        ({"peers": (Peer(3, 1, "ardupilot", "plane"),), "wanted_system_id": 7}, "system id", "system_id = 3"),
        ({"peers": (Peer(3, 1, "other", "plane"),)}, "autopilot", "derives from"),
    ],
)
def test_why_there_is_no_autopilot(changes, subject, text):
    (finding,) = audit(silent(**changes))
    assert (finding.level, finding.subject) == (Level.ERROR, subject)
    assert text in finding.why + finding.remedy


@pytest.mark.parametrize(
    ("changes", "level", "subject"),
    [
        ({"connected": False}, "error", "heartbeat"),
        ({"own_id_heard": True}, "warning", "component id"),
        ({"mavlink1": 500, "mavlink2": 0}, "error", "MAVLink version"),
        ({"origin": None}, "error", "origin"),
        ({"synchronised": False, "round_trip_ms": None}, "warning", "TIMESYNC"),
        ({"rates_hz": {"LOCAL_POSITION_NED": 20.0, "GPS_RAW_INT": 2.0}}, "error", "ATTITUDE_QUATERNION"),
        ({"rates_hz": {**STREAMS, "ATTITUDE_QUATERNION": 10.0}}, "warning", "ATTITUDE_QUATERNION"),
        ({"rates_hz": {**STREAMS, "LOCAL_POSITION_NED": 4.0}}, "warning", "LOCAL_POSITION_NED"),
        ({"peers": (Peer(7, 1, "ardupilot", "plane"), Peer(8, 1, "px4", "plane"))}, "warning", "autopilots"),
    ],
)  # fmt: skip
def test_each_thing_wrong_with_the_link(changes, level, subject):
    assert serious(audit(situation(ARDUPILOT_READY, health=health(**changes)))) == [(level, subject)]


def test_a_ground_station_and_a_chosen_system_are_fine():
    other = (Peer(7, 1, "ardupilot", "plane"), Peer(8, 1, "px4", "plane"))
    assert serious(audit(situation(ARDUPILOT_READY, health=health(peers=other, wanted_system_id=7)))) == []
    plain = {**STREAMS, "ATTITUDE": 50.0}
    del plain["ATTITUDE_QUATERNION"]
    assert serious(audit(situation(ARDUPILOT_READY, health=health(rates_hz=plain)))) == []


def test_slow_round_trips_are_px4s_trouble_only():
    slow = {"round_trip_ms": 12.0}
    assert serious(audit(px4(PX4_READY, health=health(PX4, (1, 14, 3), **slow)))) == [("error", "TIMESYNC")]
    assert serious(audit(situation(ARDUPILOT_READY, health=health(**slow)))) == []


def test_slow_line_names_the_port_where_it_can():
    one = situation({**ARDUPILOT_READY, "SERIAL1_BAUD": 115}, baud=115200)
    (finding,) = (f for f in audit(one) if f.subject == "baud")
    assert "SERIAL1_BAUD 921" in finding.remedy and finding.change is None
    (finding,) = (f for f in audit(px4(PX4_READY, baud=57600)) if f.subject == "baud")
    assert "SER_TEL1_BAUD 921600" in finding.remedy
    assert "baud" not in [f.subject for f in audit(px4(PX4_READY, baud=921600))]


def test_mavlink_1_names_the_port_where_there_is_one():
    old = health(mavlink1=500, mavlink2=0)
    (finding,) = (f for f in audit(situation({**ARDUPILOT_READY, "SERIAL2_PROTOCOL": 1}, health=old))
                  if f.level is Level.ERROR)  # fmt: skip
    assert finding.change == ("SERIAL2_PROTOCOL", 2)
    both = {**ARDUPILOT_READY, "SERIAL1_PROTOCOL": 1, "SERIAL2_PROTOCOL": 1}
    (finding,) = (f for f in audit(situation(both, health=old)) if f.level is Level.ERROR)
    assert finding.change is None


# -- the table -------------------------------------------------------------------------


def test_names_fit_mavlink_and_none_is_read_twice():
    for autopilot in Autopilot:
        for sinks in (("odometry",), ("vision_position_estimate", "gps_input"), ("global_position_sensor",)):
            names = parameters_wanted(autopilot, sinks)
            assert len(names) == len(set(names)) and all(len(name) <= 16 for name in names)
            assert len(names) < 64
