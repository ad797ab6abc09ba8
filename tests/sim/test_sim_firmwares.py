"""What each firmware makes of a position: by cases, and against the transcriptions of tests/oracles."""

from __future__ import annotations

import math
import random
from dataclasses import replace

import numpy as np
import pytest
from autopilot_rig import BOOT, OUR_OFFSET, QUIET, Rig, S, truth
from oracles.ardupilot import ArduPilot as ArduPilotOracle
from oracles.ardupilot import JitterCorrection as OracleClock
from oracles.px4 import Px4 as Px4Oracle
from oracles.used import Dropped, Used
from ortholoc_sim.autopilot import AutopilotCore, AutopilotOptions, FilterOptions, PositionFilter, Verdict, dialect
from ortholoc_sim.autopilot.clocks import JitterCorrection
from ortholoc_sim.site import Geopoint, Site

from ortholoc_edge.geometry import rotation

SYNCHRONISED = FilterOptions(converged_after=0)


@pytest.fixture
def px4_site(site: Site) -> Site:
    return replace(site, earth="px4")


def px4(site: Site, firmware: tuple[int, int, int] = (1, 16, 0), **options: object) -> Rig:
    options.setdefault("filter", SYNCHRONISED)
    return Rig(site, stack="px4", firmware=firmware, **options)  # type: ignore[arg-type]


def without_gnss(rig: Rig) -> Rig:
    """Until PX4 has given GNSS up."""
    rig.fly(7.5)
    return rig


# -- what no companion should send ---------------------------------------------


@pytest.mark.parametrize(("stack", "firmware"), [("ardupilot", (4, 8, 0)), ("px4", (1, 16, 0))])
def test_numbers_that_are_none_end_nothing(site: Site, stack: str, firmware: tuple) -> None:
    rig = Rig(replace(site, earth=stack), stack=stack, firmware=firmware, filter=SYNCHRONISED)
    core, d = rig.core, dialect
    values = (math.nan, math.inf, -math.inf, 3e38, 0.0)
    commands = [*core._commands, *core.estimator.COMMANDS]
    for command in commands:
        for value in values:
            for message in (
                d.MAVLink_command_long_message(1, 1, command, 0, *[value] * 7),
                d.MAVLink_command_int_message(1, 1, 0, command, 0, 0, *[value] * 4, 0, 0, value),
            ):
                if command != d.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN or not math.isfinite(value):
                    core.handle(message, rig.now)
    for group in (0, 1, 6):
        core.handle(d.MAVLink_request_data_stream_message(1, 1, group, 0, 1), rig.now)
    for value in values:
        rig.see(value, value, sigma=1.0, q=[value] * 4, vx=value, vy=value, vz=value)
        gps = d.MAVLink_gps_input_message(
            0, 0, 0, 0, 0, 3, 488_026_000, 110_033_000, *[value] * 9, 10
        )  # fmt: skip
        core.handle(gps, rig.now)
        rig.fly(0.05)
    rig.fly(1.0)
    assert np.isfinite(core.position_ned_m).all()


# -- ArduPilot ----------------------------------------------------------------


@pytest.mark.parametrize(
    ("parameters", "changes", "verdict"),
    [
        ({"VISO_TYPE": 0}, {}, Verdict.DISABLED),
        ({"VISO_QUAL_MIN": 50}, {"quality": 49}, Verdict.FAILED_QUALITY),
        ({"VISO_QUAL_MIN": 50}, {"quality": 0}, Verdict.FAILED_QUALITY),  # unknown counts as nothing
        ({"VISO_QUAL_MIN": -1}, {"quality": -1}, Verdict.FUSED),
        ({"EK3_SRC2_POSXY": 0}, {}, Verdict.STANDBY),
    ],
)
def test_parameters_decide(site: Site, parameters: dict, changes: dict, verdict: Verdict) -> None:
    rig = Rig(site, parameters=parameters)
    assert rig.see(rig.at[0], rig.at[1], **changes) is verdict
    assert (verdict is Verdict.FUSED) == (rig.core.vision[-1].why == "")


def test_a_position_parameter_is_obeyed_at_once_and_a_type_after_a_reboot(site: Site) -> None:
    rig = Rig(site)
    for name in ("VISO_POS_M_NSE", "VISO_TYPE"):
        value = {"VISO_POS_M_NSE": 3.0, "VISO_TYPE": 0}[name]
        answers = rig.core.handle(dialect.MAVLink_param_set_message(1, 1, name.encode(), value, 9), rig.now)
        assert answers[0].param_value == value
    assert rig.see(rig.at[0], rig.at[1]) is Verdict.FUSED
    assert rig.core.vision[-1].sigma_m == 3.0
    assert rig.command(dialect.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN, 1) == dialect.MAV_RESULT_DENIED
    assert rig.command(dialect.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN, 1, 0, 0, 0, 0, 20190226) == 0
    rig.fly(0.1)
    assert rig.see(rig.at[0], rig.at[1]) is Verdict.DISABLED
    # It has yet to begin, and without GNSS does not know where it is.
    rig.command(dialect.MAV_CMD_REQUEST_MESSAGE, dialect.MAVLINK_MSG_ID_EKF_STATUS_REPORT)
    assert rig.said("EKF_STATUS_REPORT")[-1].flags == 0x400
    rig.fly(8.0)
    rig.command(dialect.MAV_CMD_REQUEST_MESSAGE, dialect.MAVLINK_MSG_ID_EKF_STATUS_REPORT)
    assert rig.said("EKF_STATUS_REPORT")[-1].flags & 0x90 == 0x80


def test_t265_and_voxl_take_a_reset_in_their_ways(site: Site) -> None:
    t265 = Rig(site, parameters={"VISO_TYPE": 2})
    assert t265.see(t265.at[0], t265.at[1]) is Verdict.FUSED
    t265.fly(0.1)
    assert t265.see(t265.at[0] + 9.0, t265.at[1], reset_counter=1) is Verdict.IGNORED
    t265.fly(1.1)
    assert t265.see(t265.at[0], t265.at[1], reset_counter=1) is Verdict.FUSED
    voxl = Rig(site, parameters={"VISO_TYPE": 3})
    voxl.see(voxl.at[0], voxl.at[1])
    voxl.fly(0.1)
    assert voxl.see(voxl.at[0] + 9.0, voxl.at[1], reset_counter=1) is Verdict.REALIGNED
    voxl.fly(0.1)
    # What is 9 m off now counts as where it was.
    assert voxl.see(voxl.at[0] + 9.0, voxl.at[1], reset_counter=1) is Verdict.FUSED
    assert np.hypot(*voxl.error) < 0.1


def test_glitch_radius_zero_weighs_down_instead_of_refusing(site: Site) -> None:
    rig = Rig(site, filter=FilterOptions(glitch_radius_m=0.0))
    rig.see(rig.at[0], rig.at[1], sigma=0.3)
    rig.fly(0.1)
    assert rig.see(rig.at[0] + 40.0, rig.at[1], sigma=0.3) is Verdict.FUSED
    assert 0.0 < rig.error[0] < 8.0


def test_source_sets_by_command_and_by_script(site: Site) -> None:
    rig = Rig(site, switching="command")
    assert rig.see(rig.at[0], rig.at[1]) is Verdict.STANDBY
    assert rig.command(dialect.MAV_CMD_SET_EKF_SOURCE_SET, 4) == dialect.MAV_RESULT_DENIED
    assert rig.command(dialect.MAV_CMD_SET_EKF_SOURCE_SET, 2) == dialect.MAV_RESULT_ACCEPTED
    rig.fly(0.1)
    assert rig.see(rig.at[0], rig.at[1]) is Verdict.FUSED
    rig.core.gnss = True
    rig.fly(0.5)
    # A script would have gone back to GNSS.
    assert rig.see(rig.at[0], rig.at[1]) is Verdict.FUSED


def test_aiding_that_stopped_begins_with_a_reset_and_says_so(site: Site) -> None:
    rig = Rig(site)
    rig.fly(15.5)
    assert "EKF3 IMU0 stopped aiding" in [message.text for message in rig.said("STATUSTEXT")]
    rig.command(dialect.MAV_CMD_REQUEST_MESSAGE, dialect.MAVLINK_MSG_ID_EKF_STATUS_REPORT)
    assert rig.said("EKF_STATUS_REPORT")[-1].flags & 0x90 == 0x80  # no absolute position: constant position mode
    assert rig.see(rig.at[0] + 60.0, rig.at[1]) is Verdict.RESET
    assert rig.error[0] == pytest.approx(60.0, abs=0.1)
    rig.fly(0.1)
    assert rig.said("STATUSTEXT")[-1].text == "EKF3 IMU0 is using external nav data"


def test_before_4_7_a_healthy_gps_decides_how_good_vision_is(site: Site) -> None:
    noisy = replace(QUIET, gnss_m=2.0)
    for firmware, sigma_m in (((4, 6, 3), 2.0), ((4, 7, 0), 0.5)):
        rig = Rig(site, firmware=firmware, sensors=noisy, switching="command")
        rig.core.gnss = True
        rig.command(dialect.MAV_CMD_SET_EKF_SOURCE_SET, 2)
        rig.fly(0.1)
        cube = [0.0] * 21
        cube[0] = cube[6] = math.sqrt(0.5**3 / 2)
        rig.see(rig.at[0], rig.at[1], pose_covariance=cube)
        assert rig.core.vision[-1].sigma_m == pytest.approx(sigma_m, rel=1e-3)


# -- PX4 ----------------------------------------------------------------------


def test_beside_gnss_vision_is_relative(px4_site: Site) -> None:
    """40 m off: its bias is estimated away, whatever it says, until GNSS is given up; then it is absolute."""
    rig = px4(px4_site, gnss_s=0.0)
    rig.core.gnss = True
    rig.fly(1.0)
    verdicts = [rig.see_ned(rig.at[0] + 40.0, rig.at[1], age_s=0.1) for _ in range(20)]
    assert verdicts[0] is Verdict.WAITING and set(verdicts[1:]) == {Verdict.RELATIVE}
    assert np.hypot(*rig.error) < 0.5
    rig.core.gnss = False
    until = [rig.see_ned(rig.at[0] + 40.0, rig.at[1], age_s=0.1) for _ in range(60)]
    assert next(v for v in until if v is not Verdict.RELATIVE) is Verdict.RESET
    assert until.index(Verdict.RESET) * 0.15 == pytest.approx(7.0, abs=0.4)  # GNSS is believed 7 s longer
    assert rig.error[0] == pytest.approx(40.0, abs=0.5)


def test_starts_with_two_close_together_and_stops_when_they_stop(px4_site: Site) -> None:
    rig = without_gnss(px4(px4_site))
    assert [rig.see_ned(rig.at[0], rig.at[1]) for _ in range(4)] == [Verdict.WAITING] * 4  # every 250 ms
    assert rig.see_ned(rig.at[0] + 5.0, rig.at[1], age_s=0.1) is Verdict.RESET  # 150 ms after the one before
    assert rig.error[0] == pytest.approx(5.0, abs=0.1)
    assert rig.see_ned(rig.at[0] + 5.0, rig.at[1], age_s=0.1) is Verdict.FUSED
    rig.fly(0.6)
    assert rig.see_ned(rig.at[0], rig.at[1]) is Verdict.WAITING


def running(site: Site, **options: object) -> Rig:
    """Vision is what holds it."""
    rig = without_gnss(px4(site, **options))
    for _ in range(4):
        rig.see_ned(rig.at[0], rig.at[1], age_s=0.1)
    assert rig.verdict is Verdict.FUSED
    return rig


def test_refused_for_a_second_five_resets_then_given_up(px4_site: Site) -> None:
    rig = running(px4_site)
    verdicts, sign = [], 1.0
    for n in range(80):
        # Each time it has been taken it is elsewhere again.
        sign = -sign if verdicts and verdicts[-1] is Verdict.TIMEOUT_RESET else sign
        verdicts.append(rig.see_ned(rig.at[0] + 60.0 * sign, rig.at[1], 0.2, age_s=0.1))
        if n == 0:
            assert rig.verdict is Verdict.GATED
    assert verdicts.count(Verdict.TIMEOUT_RESET) == 5
    assert Verdict.STOPPED in verdicts
    first = verdicts.index(Verdict.TIMEOUT_RESET)
    assert first * 0.15 == pytest.approx(1.0, abs=0.2)


def test_reset_counter_resets_px4_too(px4_site: Site) -> None:
    rig = running(px4_site)
    assert rig.see_ned(rig.at[0] - 25.0, rig.at[1], age_s=0.1, reset_counter=9) is Verdict.RESET
    assert rig.error[0] == pytest.approx(-25.0, abs=0.2)


@pytest.mark.parametrize(
    ("parameters", "changes", "verdict"),
    [
        ({"EKF2_EV_CTRL": 0}, {}, Verdict.DISABLED),
        ({"EKF2_EV_CTRL": 14}, {}, Verdict.DISABLED),
        ({}, {"estimator_type": 5}, Verdict.UNHEARD),
        ({"EKF2_EV_QMIN": 90}, {}, Verdict.FAILED_QUALITY),
        ({}, {"x": math.nan}, Verdict.NOT_FINITE),
        ({}, {"time_usec": (BOOT + OUR_OFFSET - 10 * S) // 1000}, Verdict.TOO_OLD),
    ],
)
def test_what_px4_drops(px4_site: Site, parameters: dict, changes: dict, verdict: Verdict) -> None:
    rig = px4(px4_site, parameters=parameters)
    assert rig.see_ned(rig.at[0], rig.at[1], **changes) is verdict
    assert rig.core.vision[-1].why


def test_a_frame_without_heading_is_turned_by_the_attitudes(px4_site: Site) -> None:
    """LOCAL_FRD, which ArduPilot wants: with an identity for attitude, 20 m north of a vehicle that heads east."""
    rig = running(px4_site)
    rig.see(20.0, 0.0, frame_id=dialect.MAV_FRAME_LOCAL_FRD, q=[math.sqrt(0.5), 0.0, 0.0, -math.sqrt(0.5)], age_s=0.1)
    rig.fly(0.15)
    # Attitude of the vehicle is level north; that of the estimate is 90 degrees left of it.
    innovation = rig.core.vision[-1].innovation_m
    assert innovation is not None and innovation == pytest.approx(20.0, abs=0.3)
    rig = running(px4_site)
    rig.see(20.0, 0.0, frame_id=1, q=[math.sqrt(0.5), 0.0, 0.0, -math.sqrt(0.5)], age_s=0.1, reset_counter=3)
    rig.fly(0.15)
    assert rig.error == pytest.approx([20.0, 0.0], abs=0.2)


def test_stamps_count_only_after_timesync_has_converged(px4_site: Site) -> None:
    """500 round trips at 10 Hz; before, a fix of 150 ms ago counts as of now."""
    rig = without_gnss(px4(px4_site, filter=FilterOptions(converged_after=100)))
    assert not rig.core.synchronised
    rig.see_ned(rig.at[0], rig.at[1], age_s=0.15)
    rig.fly(0.2)
    record = rig.core.vision[-1]
    assert record.arrival_ns == record.capture_ns
    rig.fly(3.0)
    assert rig.core.synchronised
    rig.see_ned(rig.at[0], rig.at[1], age_s=0.15)
    record = rig.core.vision[-1]
    assert record.arrival_ns - record.capture_ns == pytest.approx(0.15 * S, abs=2e6)


def test_timesync_answers_that_took_10_ms_teach_nothing(px4_site: Site) -> None:
    core = AutopilotCore(AutopilotOptions(stack="px4", firmware=(1, 16, 0)), px4_site, truth())
    now = BOOT
    for round_trip_ms, learnt in ((10.0, False), (9.0, True)):
        for _ in range(600):
            now += S // 10
            asked = [m for m in core.step(now, truth(), 0.1) if m.get_type() == "TIMESYNC"]
            arrival = now + round(round_trip_ms * 1e6)
            core.handle(dialect.MAVLink_timesync_message(now + OUR_OFFSET, asked[0].ts1), arrival)
        assert core.synchronised is learnt


def sensor(rig: Rig, north: float, east: float, eph: float = 1.0, number: int = 1) -> Verdict:
    """A GLOBAL_POSITION_SENSOR of a place so far from the origin."""
    point = rig.site.geopoint_from_autopilot(np.array([north, east, -90.0]))
    message = dialect.MAVLink_global_position_sensor_message(
        0, 0, number, 0, 0, 2, 0, round(point.lat_deg * 1e7), round(point.lon_deg * 1e7), math.nan,
        point.height_amsl_m, eph, 1.0,
    )  # fmt: skip
    seen = len(rig.core.vision)
    rig.core.handle(message, rig.now)
    if len(rig.core.vision) == seen:
        rig.fly(0.25)
    return rig.verdict


def test_auxiliary_position_is_absolute_from_1_18_on(px4_site: Site) -> None:
    assert sensor(px4(px4_site, (1, 17, 0)), 0.0, 0.0) is Verdict.UNHEARD
    rig = px4(px4_site, (1, 18, 0))
    assert sensor(rig, rig.at[0], rig.at[1], number=2) is Verdict.DISABLED
    assert sensor(rig, rig.at[0], rig.at[1], eph=0.0) is Verdict.NOT_FINITE
    assert sensor(rig, rig.at[0] + 0.5, rig.at[1]) is Verdict.FUSED
    # GNSS is still believed, so that what it refuses is not taken.
    assert sensor(rig, rig.at[0] + 50.0, rig.at[1]) is Verdict.GATED
    without_gnss(rig)
    verdicts = [sensor(rig, rig.at[0] + 50.0, rig.at[1]) for _ in range(40)]
    assert Verdict.TIMEOUT_RESET in verdicts or Verdict.RESET in verdicts
    assert rig.error[0] == pytest.approx(50.0, abs=1.0)


def test_auxiliary_position_gives_an_origin_where_there_is_none(px4_site: Site) -> None:
    rig = px4(px4_site, (1, 18, 0), origin="none", gnss_s=0.0)
    assert rig.command(dialect.MAV_CMD_REQUEST_MESSAGE, 49) == dialect.MAV_RESULT_FAILED
    assert sensor(rig, 30.0, -20.0) is Verdict.RESET
    assert rig.command(dialect.MAV_CMD_REQUEST_MESSAGE, 49) == dialect.MAV_RESULT_ACCEPTED
    origin = rig.said("GPS_GLOBAL_ORIGIN")[-1]
    place = px4_site.geopoint_from_autopilot(np.array([30.0, -20.0, 0.0]))
    assert origin.latitude == pytest.approx(place.lat_deg * 1e7, abs=2)
    # Counted from there it is where it is.
    rig.command(dialect.MAV_CMD_SET_MESSAGE_INTERVAL, 32, 50_000)
    rig.fly(0.1)
    local = rig.said("LOCAL_POSITION_NED")[-1]
    assert (local.x, local.y) == pytest.approx((0.0, 0.0), abs=0.05)


@pytest.mark.parametrize(("stack", "firmware"), [("ardupilot", (4, 6, 0)), ("px4", (1, 16, 0))])
def test_external_position_by_command_while_dead_reckoning(site: Site, stack: str, firmware: tuple) -> None:
    there = replace(site, earth=stack)  # type: ignore[arg-type]
    rig = Rig(there, stack=stack, firmware=firmware, filter=SYNCHRONISED if stack == "px4" else FilterOptions())
    point = there.geopoint_from_autopilot(np.array([80.0, 10.0, 0.0]))
    fields = (1, 1, 0, dialect.MAV_CMD_EXTERNAL_POSITION_ESTIMATE, 0, 0, (rig.now + OUR_OFFSET) / S, 0.1, 5.0, 0.0)
    message = dialect.MAVLink_command_int_message(
        *fields, round(point.lat_deg * 1e7), round(point.lon_deg * 1e7), math.nan
    )
    assert rig.core.handle(message, rig.now)[0].result != dialect.MAV_RESULT_ACCEPTED  # GNSS a moment ago
    rig.fly(1.5)
    assert rig.core.handle(message, rig.now)[0].result == dialect.MAV_RESULT_ACCEPTED
    assert (rig.at + np.append(rig.error, 0.0))[:2] == pytest.approx([80.0, 10.0], abs=0.1)


@pytest.mark.parametrize("stack", ["ardupilot", "px4"])
def test_a_spoofed_gnss_takes_it_along(site: Site, stack: str) -> None:
    """Slowly enough, no gate notices; the receiver claims its usual accuracy."""
    there = replace(site, earth=stack)  # type: ignore[arg-type]
    firmware = (4, 6, 0) if stack == "ardupilot" else (1, 16, 0)
    core = AutopilotCore(AutopilotOptions(stack=stack, firmware=firmware, sensors=QUIET), there, truth())
    for n in range(3000):
        core.gnss_offset_m = np.array([0.0, 0.005 * n, 0.0])
        core.step(BOOT + n * S // 100, truth(), 0.01)
    assert (core.position_ned_m - core.true_position_m)[1] == pytest.approx(15.0, abs=1.0)


@pytest.mark.parametrize(
    ("stack", "firmware", "parameters"),
    [
        ("ardupilot", (4, 8, 0), {"EK3_SRC2_POSZ": 6, "EK3_SRC2_YAW": 6}),
        ("px4", (1, 16, 0), {"EKF2_EV_CTRL": 11, "EKF2_HGT_REF": 3}),
    ],
)
def test_height_and_heading_follow_vision_where_parameters_say_so(
    site: Site, stack: str, firmware: tuple, parameters: dict
) -> None:
    """The barometer is 4 m off, the compass 10 degrees."""
    there = replace(site, earth=stack)  # type: ignore[arg-type]
    filters = SYNCHRONISED if stack == "px4" else FilterOptions()

    def seen(parameters: dict) -> tuple[float, float]:
        sensors = replace(QUIET, yaw_bias_deg=10.0)
        rig = Rig(there, stack=stack, firmware=firmware, parameters=parameters, filter=filters, sensors=sensors)
        rig.core.sensors.barometer.drift_m = 4.0
        rig.fly(0.1)
        see = rig.see_ned if stack == "px4" else rig.see
        for _ in range(60):
            see(rig.at[0], rig.at[1], z=rig.at[2], q=[1.0, 0.0, 0.0, 0.0])
            rig.fly(0.1)
        yaw_deg = np.rad2deg(rotation.to_euler(rig.core.ned_from_body)[2])
        return float(rig.core.position_ned_m[2] - rig.at[2]), abs(float(yaw_deg))

    assert seen(parameters) == pytest.approx((0.0, 0.0), abs=0.6)
    assert seen({}) == pytest.approx((4.0, 10.0), abs=0.1)


# -- both, against other transcriptions ----------------------------------------


def odometry(rng: random.Random, stamp_us: int, frames: tuple[int, ...]) -> object:
    """Any of what companions send, right or wrong."""
    sigma = 10.0 ** rng.uniform(-2, 2.3)
    covariance = [0.0] * 21
    for index in (0, 6, 11, 15, 18, 20):
        covariance[index] = sigma**2 * rng.uniform(0.3, 3.0)
    if rng.random() < 0.1:
        covariance[0] = math.nan
    if rng.random() < 0.05:
        covariance[11] = math.nan
    position = [rng.uniform(-30, 30), rng.uniform(-30, 30), -90.0]
    if rng.random() < 0.05:
        position[0] = math.nan
    return dialect.MAVLink_odometry_message(
        time_usec=stamp_us, frame_id=rng.choice(frames), child_frame_id=rng.choice((12, 12, 12, 8)), x=position[0],
        y=position[1], z=position[2], q=[1.0, 0.0, 0.0, 0.0], vx=math.nan, vy=math.nan, vz=math.nan, rollspeed=0.0,
        pitchspeed=0.0, yawspeed=0.0, pose_covariance=covariance, velocity_covariance=[math.nan] * 21,
        reset_counter=0, estimator_type=rng.choice((2, 2, 3, 0)), quality=rng.choice((-1, 0, 1, 50, 100)),
    )  # fmt: skip


REACHED = {Verdict.FUSED, Verdict.GATED, Verdict.RESET, Verdict.TIMEOUT_RESET, Verdict.STANDBY, Verdict.WAITING}


@pytest.mark.parametrize("firmware", [(4, 5, 7), (4, 6, 3), (4, 7, 0), (4, 8, 0)])
def test_ardupilot_reads_as_the_oracle_does(site: Site, firmware: tuple[int, int, int]) -> None:
    """Two transcriptions of one contract: what is dropped, with what sigma, of what time."""
    rng = random.Random(firmware[1])
    delays = FilterOptions(stamps="jitter", viso_delay_ms=80.0, quality_min=1)
    rig = Rig(site, firmware=firmware, filter=delays, gnss_s=0.0)
    rig.fly(0.4)  # as far back as a measurement may reach
    oracle = ArduPilotOracle(firmware, viso_delay_ms=80, viso_qual_min=1)
    ours = dialect.MAVLink(None, 1, 197)
    reached = 0
    for _ in range(150):
        rig.fly(0.01 * rng.choice((1, 2, 3, 10)))
        stamp_us = (rig.now + OUR_OFFSET) // 1000 - rng.choice((30_000, 45_000, 200_000))
        data = bytes(odometry(rng, stamp_us, (20, 20, 20, 1)).pack(ours))  # type: ignore[attr-defined]
        used = oracle.receive(data, rig.now // 1000)
        (message,) = dialect.MAVLink(None, 0, 0).parse_buffer(data)
        rig.core.handle(message, rig.now)
        record = rig.core.vision[-1]
        assert isinstance(used, Used) == (record.verdict in REACHED), (used, record)
        if isinstance(used, Used):
            reached += 1
            assert record.sigma_m == pytest.approx(used.sigma_north_m, rel=1e-6)
            assert record.capture_ns / 1000 == pytest.approx(used.capture_us, abs=1001)  # it counts milliseconds
    assert reached > 40
    assert rig.core.counts["internal_error"] == oracle.internal_errors > 0


@pytest.mark.parametrize("firmware", [(1, 14, 4), (1, 18, 0)])
def test_px4_reads_as_the_oracle_does(px4_site: Site, firmware: tuple[int, int, int]) -> None:
    rng = random.Random(firmware[1])
    rig = without_gnss(px4(px4_site, firmware, parameters={"EKF2_EV_QMIN": 1}))
    oracle = Px4Oracle(firmware, ekf2_ev_qmin=1, offset_us=-OUR_OFFSET // 1000)
    ours = dialect.MAVLink(None, 1, 197)
    reached = 0
    for _ in range(120):
        rig.fly(0.01 * rng.choice((3, 5, 10)))
        stamp_us = (rig.now + OUR_OFFSET) // 1000 - rng.choice((30_000, 100_000))
        data = bytes(odometry(rng, stamp_us, (1, 1, 1, 2)).pack(ours))  # type: ignore[attr-defined]
        (message,) = dialect.MAVLink(None, 0, 0).parse_buffer(data)
        used = oracle.receive(data, rig.now // 1000)
        seen = len(rig.core.vision)
        rig.core.handle(message, rig.now)
        if len(rig.core.vision) == seen:
            rig.fly(0.25)
        record = rig.core.vision[-1]
        if record.verdict is Verdict.TOO_FAST:
            continue  # its order of samples, which the oracle does not keep
        assert isinstance(used, Dropped) == (record.verdict not in REACHED), (used, record)
        if isinstance(used, Used):
            reached += 1
            sigma = [v for v in (used.sigma_north_m, used.sigma_east_m) if math.isfinite(v)]
            assert record.sigma_m == pytest.approx(max(sigma), rel=1e-6)
            assert record.capture_ns / 1000 == pytest.approx(used.capture_us, abs=2)
    assert reached > 30


@pytest.mark.parametrize("earth", ["ardupilot", "px4"])
def test_the_sites_formulas_are_those_of_the_daemon(site: Site, earth: str) -> None:
    """Written twice, from the firmwares; here they meet."""
    from ortholoc_edge.adapters.mavlink.geodesy import EarthModel, GeodeticOrigin, ned_from_geodetic

    there = replace(site, earth=earth)  # type: ignore[arg-type]
    origin = GeodeticOrigin(there.origin.lat_deg, there.origin.lon_deg, there.origin.height_amsl_m)
    rng = np.random.default_rng(4)
    for ned in rng.uniform(-3000.0, 3000.0, (50, 3)):
        point = there.geopoint(ned)
        ours = ned_from_geodetic(origin, point.lat_deg, point.lon_deg, point.height_amsl_m, EarthModel(earth))
        assert there.autopilot_from_geopoint(point) == pytest.approx(ours, abs=1e-5)
        back = there.geopoint_from_autopilot(ours)
        assert there.autopilot_from_geopoint(back) == pytest.approx(ours, abs=1e-5)


def test_a_site_of_the_other_stack_is_refused(site: Site) -> None:
    with pytest.raises(ValueError, match="earth='px4'"):
        AutopilotCore(AutopilotOptions(stack="px4", firmware=(1, 16, 0)), site, truth())
    with pytest.raises(ValueError, match=r"ardupilot is not simulated.*4\.5 to 4\.8"):
        AutopilotOptions(firmware=(4, 9, 0))
    with pytest.raises(ValueError, match="EKF2_EV_CTRL is not one"):
        AutopilotCore(AutopilotOptions(parameters={"EKF2_EV_CTRL": 1}), site, truth())
    assert Geopoint(1.0, 2.0, 3.0).lat_deg == 1.0


# -- ArduPilot, against what was measured of a real one (autopilot-contract.md, 2.11) ----------------------------------

MEASURED = {"firmware": (4, 7, 0), "filter": FilterOptions(stamps="jitter")}


def held(site: Site, **options: object) -> Rig:
    """Vision alone has held it for some seconds."""
    rig = Rig(site, **{**MEASURED, **options})
    stream(rig, 5.0)
    return rig


def stream(rig: Rig, seconds: float, offset_m: float = 0.0, sigma_m: float = 0.2, **changes: object) -> list[Verdict]:
    """Ten a second, ``offset_m`` north of the truth."""
    cube = [0.0] * 21
    cube[0] = cube[6] = math.sqrt(sigma_m**3 / 2.0)
    verdicts = []
    for _ in range(round(seconds * 10)):
        rig.fly(0.1)
        verdicts.append(rig.see(rig.at[0] + offset_m, rig.at[1], pose_covariance=cube, **changes))
    return verdicts


def test_measured_a_jump_of_5_m_is_refused_for_about_4_5_s_then_taken(site: Site) -> None:
    rig = held(site)
    verdicts = stream(rig, 9.0, offset_m=5.0)
    assert verdicts[0] is Verdict.GATED
    taken = next(n for n, verdict in enumerate(verdicts) if verdict is not Verdict.GATED)
    assert verdicts[taken] is Verdict.FUSED  # its own doubt has grown that far; no time-out
    assert taken / 10 == pytest.approx(4.5, abs=1.5)


def test_measured_with_a_new_reset_counter_it_is_taken_at_once(site: Site) -> None:
    rig = held(site)
    assert stream(rig, 0.1, offset_m=5.0, reset_counter=1) == [Verdict.RESET]
    assert rig.error[0] == pytest.approx(5.0, abs=0.1)


def test_measured_the_gate_is_about_seven_declared_sigmas(site: Site) -> None:
    """For a filter that is much surer than the measurement."""
    for times, verdict in ((6.0, Verdict.FUSED), (8.5, Verdict.GATED)):
        assert stream(held(site), 0.1, offset_m=times * 2.0, sigma_m=2.0) == [verdict]


def test_measured_half_of_the_fixes_may_be_wild(site: Site) -> None:
    rig = held(site)
    for n in range(60):
        stream(rig, 0.1, offset_m=30.0 if n % 2 else 0.0)
    assert np.hypot(*rig.error) < 0.1


@pytest.mark.parametrize(("parameter_ms", "off_m"), [(10.0, 0.95), (200.0, 0.0)])
def test_measured_a_constant_delay_is_known_by_the_parameter_alone(
    site: Site, parameter_ms: float, off_m: float
) -> None:
    """At 5 m/s and 200 ms: by 190 ms of flight behind, or not at all."""
    rig = Rig(site, speed=5.0, firmware=(4, 7, 0), filter=FilterOptions(stamps="jitter", viso_delay_ms=parameter_ms))
    for _ in range(200):
        rig.fly(0.1)
        rig.see(rig.at[0] - 5.0 * 0.2, rig.at[1], sigma=0.3, age_s=0.2)
    assert -rig.error[0] == pytest.approx(off_m, abs=0.08)


def test_ardupilots_clock_is_that_of_the_oracle_over_hundreds_of_messages() -> None:
    """The least delay is forgotten after a hundred; a late burst is cut to half a second."""
    rng = random.Random(8)
    ours, theirs = JitterCorrection(), OracleClock()
    now_us = 5_000_000
    for n in range(700):
        now_us += rng.randint(5_000, 120_000)
        least_us = 20_000 if n < 250 else 90_000
        lag_us = rng.choice((least_us, least_us + 3_000, 700_000 if n % 50 == 0 and n < 200 else least_us + 40_000))
        stamp_us = now_us - lag_us
        assert ours.correct_ns(stamp_us * 1000, now_us * 1000) == theirs.correct_us(stamp_us, now_us) * 1000


def test_the_filter_knows_how_far_off_it_is() -> None:
    """Measurements a second old, a drift that walks as it is told: the error is what the variance says."""
    rng = np.random.default_rng(11)
    offset_noise, drift_noise, sigma, age = 0.05, 0.15, 0.3, 20
    ratios = []
    for _ in range(40):
        position_filter = PositionFilter(offset_noise, drift_noise)
        # What dead reckoning is off by, which the filter must find: its first guess has the variance it begins with.
        offset, drift = rng.normal(0.0, 2.0, 2), rng.normal(0.0, 0.2, 2)
        offsets = []
        for step in range(400):
            offset = offset + drift * 0.05 + offset_noise * math.sqrt(0.05) * rng.standard_normal(2)
            drift = drift + drift_noise * math.sqrt(0.05) * rng.standard_normal(2)
            offsets.append(offset)
            position_filter.predict(step * S // 20, np.zeros(2), 0.05)
            if step % 10 == 9 and step > age:
                seen = offsets[step - age] + sigma * rng.standard_normal(2)
                found = position_filter.innovation(seen, (step - age) * S // 20, step * S // 20)
                assert found is not None
                position_filter.correct(found, sigma**2)
        ratios.append((position_filter.position_m - offset) ** 2 / position_filter.variance_m2)
    assert 0.6 < np.mean(ratios) < 1.5
