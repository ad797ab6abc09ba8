"""What is wrong with an autopilot's settings and its link for vision, why, and what mends it; pure rules.

Each rule is a small function; `_RULES` says to whom it applies and which parameters it reads. A parameter that could
not be read makes a rule silent, but for `_unread`, which says so: nothing is guessed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from enum import StrEnum

from ortholoc_edge.adapters.mavlink.census import LinkHealth, Peer
from ortholoc_edge.adapters.mavlink.estimates import Autopilot
from ortholoc_edge.adapters.mavlink.latency import (
    DELAY_SLACK_MS,
    MOST_AGP_DELAY_MS,
    MOST_EV_DELAY_MS,
    MOST_VISO_DELAY_MS,
    Ages,
)
from ortholoc_edge.adapters.mavlink.parameters import Answer, Number, Reading

Version = tuple[int, int, int]

# PX4 discards TIMESYNC answers that took longer.
_PX4_MOST_ROUND_TRIP_MS = 10.0
_LEAST_BAUD = 460_800
# With less than half of the asked rate the attitude at exposure is interpolated over too long.
_LEAST_RATE_RATIO = 0.5
_OLDEST = {Autopilot.ARDUPILOT: (4, 5, 0), Autopilot.PX4: (1, 14, 0)}
# A floor above this makes every fix of the default matcher count for less than it is worth.
_MOST_FLOOR_M = 1.0
_LEAST_GATE_PERCENT = 300
_LEAST_NO_AID_US = 2_000_000

LOCAL = frozenset({"odometry", "vision_position_estimate"})
_GPS = frozenset({"gps_input"})
_SENSOR = frozenset({"global_position_sensor"})
_VISION, _GNSS, _BARO, _COMPASS = 6, 3, 1, 1


class Level(StrEnum):
    """How bad it is: with an ERROR fixes are not used, or are used wrongly; a NOTE is for information only."""

    ERROR = "error"
    WARNING = "warning"
    NOTE = "note"


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing that is wrong.

    Attributes:
        subject: the parameter, or in a word or two what it is about.
        remedy: a command, or what a person must do.
        change: (parameter, value) where setting it mends this.
        reboot: whether it takes effect only after the autopilot was restarted.
    """

    level: Level
    subject: str
    found: str
    wanted: str
    why: str
    remedy: str
    change: tuple[str, Number] | None = None
    reboot: bool = False


@dataclass(frozen=True, slots=True)
class Situation:
    """What the rules look at.

    Attributes:
        autopilot: None while none was found.
        sinks: names of the messages that carry our estimates, as in ``[link] send``.
        sensor_id: ours in GLOBAL_POSITION_SENSOR. gps_id: ours in GPS_INPUT.
        lever_arm_m: ``[mount] lever_arm_m``, which we take off ourselves; None if it isn't known.
        ages: of estimates when they arrive; None if that isn't known.
        baud: of our serial line; None for a network.
        readings: parameters by name.
    """

    autopilot: Autopilot | None
    firmware: Version | None
    sinks: frozenset[str]
    health: LinkHealth
    readings: Mapping[str, Reading]
    sensor_id: int = 1
    gps_id: int = 1
    lever_arm_m: tuple[float, float, float] | None = None
    ages: Ages | None = None
    baud: int | None = None

    def value(self, name: str) -> Number | None:
        """None where it is not known."""
        reading = self.readings.get(name)
        return reading.value if reading is not None else None

    def absent(self, name: str) -> bool:
        """Whether this firmware does not have it."""
        reading = self.readings.get(name)
        return reading is not None and reading.answer is Answer.ABSENT


@dataclass(frozen=True, slots=True)
class _Rule:
    check: Callable[[Situation], Iterator[Finding]]
    names: tuple[str, ...] = ()
    autopilot: Autopilot | None = None
    sinks: frozenset[str] | None = None

    def applies(self, autopilot: Autopilot | None, sinks: Iterable[str]) -> bool:
        return (self.autopilot is None or self.autopilot is autopilot) and (
            self.sinks is None or not self.sinks.isdisjoint(sinks)
        )


def audit(situation: Situation) -> list[Finding]:
    """All that is wrong, the worst first."""
    findings = [
        finding
        for rule in _RULES
        if rule.applies(situation.autopilot, situation.sinks)
        for finding in rule.check(situation)
    ]
    order = list(Level)
    return sorted(findings, key=lambda finding: order.index(finding.level))


def parameters_wanted(autopilot: Autopilot, sinks: Iterable[str]) -> list[str]:
    """The names that the rules read for these."""
    sinks = frozenset(sinks)
    names = (name for rule in _RULES if rule.applies(autopilot, sinks) for name in rule.names)
    return list(dict.fromkeys(names))


# -- making findings -----------------------------------------------------------------------------------


def _setting(
    situation: Situation, level: Level, name: str, wanted: Number, why: str, *, reboot: bool = False
) -> Iterator[Finding]:
    """A parameter that is known and not as wanted."""
    found = situation.value(name)
    if found is None:
        return
    yield Finding(level, name, f"{found:g}", f"{wanted:g}", why, f"param set {name} {wanted:g}", (name, wanted), reboot)


def _expect(
    situation: Situation, level: Level, name: str, wanted: Number, why: str, *, reboot: bool = False
) -> Iterator[Finding]:
    if situation.value(name) != wanted:
        yield from _setting(situation, level, name, wanted, why, reboot=reboot)


def _delay(situation: Situation, name: str, most_ms: float, latency_ms: float | None) -> Iterator[Finding]:
    """A delay parameter against the age that it stands for, the one that `latency.advise` names."""
    found = situation.value(name)
    if found is None:
        return
    if latency_ms is None:
        yield Finding(
            Level.NOTE, name, f"{found:g}", "the measured latency",
            "a constant delay is known to the filter by this parameter alone, and no measured latency was given",
            "measure it (the daemon reports it) and give it with --latency-ms",
        )  # fmt: skip
    elif latency_ms > most_ms + DELAY_SLACK_MS:
        yield Finding(
            Level.ERROR, name, f"{found:g}", f"{latency_ms:.0f}",
            f"fixes are {latency_ms:.0f} ms old when they are sent, and this parameter ends at {most_ms:g}: what is "
            "older is taken for newer than it is",
            "make the pipeline faster, or have fixes carried forward before they are sent",
        )  # fmt: skip
    elif abs(found - min(latency_ms, most_ms)) > DELAY_SLACK_MS:
        yield from _setting(
            situation, Level.WARNING, name, round(min(latency_ms, most_ms)),
            "a constant delay is known to the filter by this parameter alone: each 10 ms wrong are 0.2 m at 20 m/s",
            reboot=True,
        )  # fmt: skip


def _usual_ms(situation: Situation) -> float | None:
    return None if situation.ages is None else situation.ages.middle_ms


def _lever_arm(situation: Situation, names: tuple[str, str, str]) -> Iterator[Finding]:
    """Estimates are of the body's reference point: what the autopilot takes off besides is taken off twice."""
    ours = situation.lever_arm_m
    if ours is not None and not any(ours):
        return  # then the autopilot may do it, as what we send is the camera's position
    level = Level.WARNING if ours is None else Level.ERROR
    why = (
        "[mount] lever_arm_m is taken off by us already; with this the filter takes it off once more"
        if ours is not None
        else "if [mount] lever_arm_m is set too, the lever arm is taken off twice"
    )
    for name in names:
        yield from _expect(situation, level, name, 0, why)


# -- the link ------------------------------------------------------------------------------------------


def _autopilots(situation: Situation) -> list[Peer]:
    return [
        peer for peer in situation.health.peers
        if peer.component_id == 1 and peer.autopilot is not None and peer.role != "ground station"
    ]  # fmt: skip


def _heartbeat(situation: Situation) -> Iterator[Finding]:
    health = situation.health
    if health.vehicle is not None:
        if not health.connected:
            yield Finding(
                Level.ERROR, "heartbeat", "none for 3 s", "1 a second", "the autopilot was there and fell silent",
                "check power and cable of the link",
            )  # fmt: skip
        return
    others = _autopilots(situation)
    if health.wanted_system_id and any(peer.system_id != health.wanted_system_id for peer in others):
        ids = ", ".join(str(peer.system_id) for peer in others)
        yield Finding(
            Level.ERROR, "system id", ids, str(health.wanted_system_id),
            "the autopilot that is heard has another system id than [link] system_id, so it is not served",
            f"set [link] system_id = {others[0].system_id}, or 0 to take the first autopilot",
        )  # fmt: skip
    elif any(peer.autopilot == "other" for peer in others):
        yield Finding(
            Level.ERROR, "autopilot", "neither ArduPilot nor PX4", "ardupilot or px4",
            "its messages and parameters are not known", "set [link] autopilot to the one that it derives from, if so",
        )  # fmt: skip
    elif health.peers:
        heard = ", ".join(f"{peer.system_id}/{peer.component_id} ({peer.role})" for peer in health.peers)
        yield Finding(
            Level.ERROR, "heartbeat", f"only of {heard}", "an autopilot's",
            "MAVLink arrives, but no autopilot's heartbeat among it",
            "let the router send the autopilot's messages to this endpoint too",
        )  # fmt: skip
    elif health.bad_bytes:
        yield Finding(
            Level.ERROR, "heartbeat", f"none in {health.bad_bytes} bytes", "an autopilot's",
            "bytes arrive, but no MAVLink frame is whole",
            "make the baud rates of both sides equal (ArduPilot SERIALn_BAUD, PX4 SER_..._BAUD), and see that the port "
            "speaks MAVLink (SERIALn_PROTOCOL 2, MAV_n_CONFIG)",
        )  # fmt: skip
    else:
        yield Finding(
            Level.ERROR, "heartbeat", "nothing at all", "an autopilot's", "not one byte arrived",
            "check the endpoint, the cable (TX to RX) and the autopilot's port: ArduPilot SERIALn_PROTOCOL 2, PX4 "
            "MAV_n_CONFIG",
        )  # fmt: skip


def _other_autopilots(situation: Situation) -> Iterator[Finding]:
    vehicle = situation.health.vehicle
    others = [peer for peer in _autopilots(situation) if vehicle is not None and peer.system_id != vehicle.system_id]
    if vehicle is not None and others and situation.health.wanted_system_id == 0:
        ids = ", ".join(str(peer.system_id) for peer in others)
        yield Finding(
            Level.WARNING, "autopilots", f"system {vehicle.system_id}, and also {ids}", "one",
            "with [link] system_id = 0 the first one heard is served, which may be another vehicle's next time",
            f"set [link] system_id = {vehicle.system_id}",
        )  # fmt: skip


def _own_id(situation: Situation) -> Iterator[Finding]:
    if situation.health.own_id_heard:
        yield Finding(
            Level.WARNING, "component id", "our own messages come back", "nobody else under our ids",
            "another program sends under our system and component id, or the link echoes",
            "stop the other program, give it another component id, or mend the router's loop",
        )  # fmt: skip


def _mavlink_version(situation: Situation) -> Iterator[Finding]:
    health = situation.health
    if health.mavlink1 == 0 or health.mavlink2 > 0:
        return
    names = [name for name in (*_SERIAL_PROTOCOLS, "MAV_PROTO_VER") if situation.value(name) == 1]
    any_name = "MAV_PROTO_VER" if situation.autopilot is Autopilot.PX4 else "SERIALn_PROTOCOL"
    name = names[0] if len(names) == 1 else any_name
    yield Finding(
        Level.ERROR, "MAVLink version", "1", "2", "ODOMETRY and other messages that we need do not exist in MAVLink 1",
        f"param set {name} 2", (name, 2) if names == [name] else None, True,
    )  # fmt: skip


def _streams(situation: Situation) -> Iterator[Finding]:
    health = situation.health
    for name, wanted_hz in health.wanted_rates_hz.items():
        rate_hz = health.rates_hz.get(name)
        needed = name == "ATTITUDE_QUATERNION"
        if rate_hz is None and needed and "ATTITUDE" in health.rates_hz:
            continue
        if rate_hz is None:
            yield Finding(
                Level.ERROR if needed else Level.WARNING, name, "does not come", f"{wanted_hz:g} Hz",
                "without attitude no frame can be localized" if needed else "it was asked for and is not sent",
                "check that the autopilot obeys SET_MESSAGE_INTERVAL on this link and that a router passes it",
            )  # fmt: skip
        elif name in ("ATTITUDE_QUATERNION", "LOCAL_POSITION_NED") and rate_hz < _LEAST_RATE_RATIO * wanted_hz:
            yield Finding(
                Level.WARNING, name, f"{rate_hz:g} Hz", f"{wanted_hz:g} Hz",
                "the state at exposure is interpolated from these, and is worse the farther apart they are",
                "raise the baud rate, or ask for fewer messages on this link",
            )  # fmt: skip


def _timesync(situation: Situation) -> Iterator[Finding]:
    health = situation.health
    if health.vehicle is None:
        return
    if not health.synchronised:
        yield Finding(
            Level.WARNING, "TIMESYNC", "too few answers", "answered",
            "the clocks are related by time of arrival, so attitudes are late by the link's delay",
            "check that a router passes TIMESYNC, and the load of the line",
        )  # fmt: skip
        return
    if situation.autopilot is Autopilot.PX4 and _slow_for_px4(health):
        yield Finding(
            Level.ERROR, "TIMESYNC", f"{health.round_trip_ms:.1f} ms", f"below {_PX4_MOST_ROUND_TRIP_MS:g} ms",
            "PX4 discards slower round trips, so it never believes our stamps and takes the time of arrival instead",
            f"use a line of {_LEAST_BAUD} baud or more without a radio in between",
        )  # fmt: skip


def _baud(situation: Situation) -> Iterator[Finding]:
    if situation.baud is not None and situation.baud < _LEAST_BAUD:
        # ArduPilot counts in thousands. More than one port may have our rate; which one we are on is not told.
        baud = situation.baud if situation.autopilot is Autopilot.PX4 else situation.baud // 1000
        ports = " or ".join(name for name in (*_SERIAL_BAUDS, *_PX4_BAUDS) if situation.value(name) == baud)
        fast = 921600 if situation.autopilot is Autopilot.PX4 else 921
        yield Finding(
            Level.WARNING, "baud", str(situation.baud), f"{_LEAST_BAUD} or more",
            "attitude at 50 Hz and ODOMETRY at 10 Hz together fill or exceed a slow line, and everything comes late",
            f"param set {ports or 'the baud rate of our port'} {fast}, and [link] endpoint to 921600 alike",
            reboot=True,
        )  # fmt: skip


def _origin(situation: Situation) -> Iterator[Finding]:
    health = situation.health
    if health.vehicle is None or health.origin is not None or health.set_origin:
        return
    yield Finding(
        Level.ERROR, "origin", "none", "GPS_GLOBAL_ORIGIN",
        "a local position counts from the EKF origin; while there is none no fix is sent",
        "set [link] set_origin = true, or set the origin in the ground station (EKF origin here)",
    )  # fmt: skip


def _firmware(situation: Situation) -> Iterator[Finding]:
    if situation.autopilot is None:
        return
    oldest = _OLDEST[situation.autopilot]
    text = ".".join(map(str, oldest))
    if situation.firmware is None:
        yield Finding(
            Level.WARNING, "firmware", "unknown", f"{text} or newer",
            "AUTOPILOT_VERSION was not answered, and the meaning of covariances depends on the version",
            "check that a router passes COMMAND_LONG and AUTOPILOT_VERSION",
        )  # fmt: skip
    elif situation.firmware < oldest:
        yield Finding(
            Level.WARNING, "firmware", ".".join(map(str, situation.firmware)), f"{text} or newer",
            "parameters and messages of older versions were not looked at", "update the autopilot",
        )  # fmt: skip
    if situation.health.vehicle is not None and situation.health.vehicle.development:
        yield Finding(
            Level.NOTE, "firmware", situation.health.vehicle.firmware, "a release",
            "a build between two releases may read covariances as either of them does, so ours are encoded for both, "
            "and only what every version reads is sent unless [link] send names it",
            "install a release, or leave it",
        )  # fmt: skip


def _unread(situation: Situation) -> Iterator[Finding]:
    unknown = [n for n, r in situation.readings.items() if r.answer in (Answer.SILENT, Answer.UNREADABLE, Answer.OPEN)]
    if not unknown:
        return
    answered = any(reading.answer is Answer.VALUE for reading in situation.readings.values())
    yield Finding(
        Level.WARNING if answered else Level.ERROR, "parameters", f"{len(unknown)} could not be read",
        "all", f"what they are is not known, so it was not judged: {', '.join(unknown[:6])}"
        + (" and more" if len(unknown) > 6 else ""),
        "run it again; if it stays so, see that a router passes PARAM_REQUEST_READ and PARAM_VALUE",
    )  # fmt: skip


# -- ArduPilot -----------------------------------------------------------------------------------------


def _ekf3(situation: Situation) -> Iterator[Finding]:
    if situation.absent("EK3_ENABLE"):
        yield Finding(
            Level.ERROR, "EK3_ENABLE", "this firmware has none", "1", "it is built without EKF3, which takes our fixes",
            "install a firmware with EKF3",
        )  # fmt: skip
    yield from _expect(
        situation, Level.ERROR, "AHRS_EKF_TYPE", 3, "only EKF3 takes positions of an external navigation system"
    )
    yield from _expect(
        situation, Level.ERROR, "EK3_ENABLE", 1, "EKF3, which takes our fixes, does not run", reboot=True
    )


def _viso_type(situation: Situation) -> Iterator[Finding]:
    if situation.absent("VISO_TYPE"):
        yield Finding(
            Level.ERROR, "VISO_TYPE", "this firmware has none", "1",
            "it is built without visual odometry, as for boards with 1 MB of flash, and drops our messages",
            "install a firmware with it (custom.ardupilot.org: Visual Odometry), or send gps_input",
        )  # fmt: skip
        return
    found = situation.value("VISO_TYPE")
    reasons = {
        0: "without it ODOMETRY and VISION_POSITION_ESTIMATE are dropped",
        2: "as a T265 a second of data is ignored after each reset, and the heading is aligned to the compass once",
        3: "as a VOXL each reset is re-aligned to the old position, so an absolute correction is lost",
    }
    why = reasons.get(int(found) if found is not None else 0, "this type does not take MAVLink's estimates as they are")
    yield from _expect(situation, Level.ERROR, "VISO_TYPE", 1, why, reboot=True)


def _viso_delay(situation: Situation) -> Iterator[Finding]:
    # It takes the least of the last hundred for the transport's.
    low_ms = None if situation.ages is None else situation.ages.low_ms
    yield from _delay(situation, "VISO_DELAY_MS", MOST_VISO_DELAY_MS, low_ms)


def _viso_lever_arm(situation: Situation) -> Iterator[Finding]:
    yield from _lever_arm(situation, ("VISO_POS_X", "VISO_POS_Y", "VISO_POS_Z"))


def _viso_conversion(situation: Situation) -> Iterator[Finding]:
    yield from _expect(situation, Level.ERROR, "VISO_SCALE", 1, "every position is multiplied by it")
    yield from _expect(
        situation, Level.WARNING, "VISO_ORIENT", 0, "our estimates are of the body, so nothing is to be turned"
    )


def _viso_noise(situation: Situation) -> Iterator[Finding]:
    quality, floor_m = situation.value("VISO_QUAL_MIN"), situation.value("VISO_POS_M_NSE")
    if quality is not None and quality > 0:
        yield from _setting(
            situation, Level.WARNING, "VISO_QUAL_MIN", 0,
            f"fixes of less than {quality:g} % are dropped; ours that are not good are not sent at all",
        )  # fmt: skip
    if floor_m is not None and not 0 < floor_m <= _MOST_FLOOR_M:
        yield from _setting(
            situation, Level.WARNING, "VISO_POS_M_NSE", 0.2,
            "a better fix counts as no better than this, so the filter follows it slowly",
        )  # fmt: skip


def _gates(situation: Situation) -> Iterator[Finding]:
    gate, radius = situation.value("EK3_POS_I_GATE"), situation.value("EK3_GLITCH_RAD")
    if gate is not None and gate < _LEAST_GATE_PERCENT:
        yield from _setting(
            situation, Level.WARNING, "EK3_POS_I_GATE", 500,
            f"a gate of {gate / 100:g} sigma refuses honest fixes; refused ones have no effect until a time-out",
        )  # fmt: skip
    if radius is not None and radius <= 0:
        yield Finding(
            Level.NOTE, "EK3_GLITCH_RAD", f"{radius:g}", "25, or as it is on purpose",
            "no fix is refused: a wrong one is only weighed down", "param set EK3_GLITCH_RAD 25",
        )  # fmt: skip
    elif radius is not None and not 10 <= radius <= 100:
        yield from _setting(
            situation, Level.WARNING, "EK3_GLITCH_RAD", 25, "out of the range of 10 to 100 m that it was made for"
        )


def _source(n: int) -> tuple[str, ...]:
    return tuple(f"EK3_SRC{n}_{what}" for what in ("POSXY", "VELXY", "POSZ", "VELZ", "YAW"))


def _vision_sets(situation: Situation) -> list[int]:
    return [n for n in (1, 2, 3) if situation.value(f"EK3_SRC{n}_POSXY") == _VISION]


def _vision_sources(situation: Situation) -> Iterator[Finding]:
    sets = _vision_sets(situation)
    if not sets:
        n = 2 if situation.value("EK3_SRC2_POSXY") is not None else 1
        yield from _setting(
            situation, Level.ERROR, f"EK3_SRC{n}_POSXY", _VISION,
            "no source set takes its position from vision (6, ExternalNav), so the filter never uses a fix",
        )  # fmt: skip
        sets = [n]
    for n in sets:
        _, velxy, posz, velz, yaw = _source(n)
        velocity = {
            _VISION: "we send no velocity, so the filter waits for one that never comes",
            _GNSS: "this source set is for flight without GNSS, of which it takes velocity",
        }
        for name in (velxy, velz):
            found = situation.value(name)
            if found in velocity:
                yield from _setting(situation, Level.ERROR, name, 0, velocity[int(found)])
        if situation.value(posz) in (0, _GNSS):
            yield from _setting(
                situation, Level.ERROR, posz, _BARO, "without GNSS this set has no height; the barometer has"
            )
        elif situation.value(posz) == _VISION:
            yield Finding(
                Level.NOTE, posz, "6", "1", "height follows the map's and stops when fixes stop; the barometer goes on",
                f"param set {posz} 1",
            )  # fmt: skip
        if situation.value(yaw) == _VISION:
            yield from _setting(
                situation, Level.WARNING, yaw, _COMPASS,
                "a wrong vision heading of 25 degrees was flown without a complaint; the compass is independent",
            )  # fmt: skip
        elif situation.value(yaw) in (2, 3, 8):
            yield from _setting(situation, Level.WARNING, yaw, _COMPASS, "this heading needs GNSS")


def _velocities(situation: Situation) -> Iterator[Finding]:
    """EK3_SRC_OPTIONS bit 0, which is on in stock firmware."""
    found = situation.value("EK3_SRC_OPTIONS")
    gnss = [n for n in (1, 2, 3) if situation.value(f"EK3_SRC{n}_VELXY") == _GNSS]
    if found is not None and int(found) & 1 and _vision_sets(situation) and gnss:
        bits = int(found) & ~1
        yield Finding(
            Level.NOTE, "EK3_SRC_OPTIONS", f"{found:g}", f"{bits} where GNSS may be deceived",
            "bit 0 fuses the velocities of all source sets: while a receiver has a fix its velocity also steers the "
            "set for vision",
            f"param set EK3_SRC_OPTIONS {bits}",
        )  # fmt: skip


def _switching(situation: Situation) -> Iterator[Finding]:
    sets = _vision_sets(situation)
    options = [situation.value(name) for name in _RC_OPTIONS]
    if sets and 1 not in sets and any(option is not None for option in options) and 90 not in options:
        yield Finding(
            Level.NOTE, "source switch", "no RCn_OPTION is 90", "a switch, a script or a command",
            f"vision is in source set {sets[0]}, the filter starts in set 1, and no RC switch changes it",
            "param set RC8_OPTION 90 for a spare channel; or MAV_CMD_SET_EKF_SOURCE_SET, or a script",
        )  # fmt: skip


def _gps_types(situation: Situation) -> Iterator[Finding]:
    names = _GPS_TYPES[situation.gps_id]
    if all(situation.absent(name) for name in names):
        yield Finding(
            Level.ERROR, names[-1], "this firmware has none", "14",
            f"it has no GPS instance {situation.gps_id}, to which our GPS_INPUT is addressed",
            "install a firmware with two GPS instances, or set [link] gps_id to one that there is",
        )  # fmt: skip
    for name in names:
        yield from _expect(
            situation, Level.ERROR, name, 14,
            f"GPS_INPUT is taken by type 14 (MAV) only, and [link] gps_id = {situation.gps_id} addresses this instance",
            reboot=True,
        )  # fmt: skip


def _gps_sources(situation: Situation) -> Iterator[Finding]:
    sets = [n for n in (1, 2, 3) if situation.value(f"EK3_SRC{n}_POSXY") == _GNSS]
    if not sets:
        yield from _setting(
            situation, Level.ERROR, "EK3_SRC1_POSXY", _GNSS, "GPS_INPUT reaches the filter as GNSS only"
        )
    yield from _expect(
        situation, Level.WARNING, f"EK3_SRC{sets[0] if sets else 1}_VELXY", 0,
        "our GPS_INPUT has no velocity, without which a filter that wants one does not start to use it",
    )  # fmt: skip


# -- PX4 -----------------------------------------------------------------------------------------------


def _ev_ctrl(situation: Situation) -> Iterator[Finding]:
    found = situation.value("EKF2_EV_CTRL")
    if found is None:
        if situation.absent("EKF2_EV_CTRL"):
            yield Finding(
                Level.ERROR, "EKF2_EV_CTRL", "this firmware has none", "1",
                "EKF2 is built without external vision, or the firmware is older than 1.14",
                "install a firmware with CONFIG_EKF2_EXTERNAL_VISION",
            )  # fmt: skip
        return
    bits = int(found)
    if not bits & 1:
        yield from _setting(
            situation, Level.ERROR, "EKF2_EV_CTRL", bits & ~0b1100 | 1,
            "bit 0 is off, so horizontal positions of vision are not used",
        )  # fmt: skip
    elif bits & 0b1100:
        yield from _setting(
            situation, Level.WARNING, "EKF2_EV_CTRL", bits & ~0b1100,
            "velocity (bit 2) is never sent, and a heading of vision (bit 3) would replace the magnetometer's",
        )  # fmt: skip


def _slow_for_px4(health: LinkHealth) -> bool:
    return health.round_trip_ms is not None and health.round_trip_ms >= _PX4_MOST_ROUND_TRIP_MS


def _ev_delay(situation: Situation) -> Iterator[Finding]:
    """PX4 takes our stamps of exposure as soon as its TIMESYNC has converged; if it can't, the time of arrival."""
    found = situation.value("EKF2_EV_DELAY")
    if _slow_for_px4(situation.health):
        yield from _delay(situation, "EKF2_EV_DELAY", MOST_EV_DELAY_MS, _usual_ms(situation))
    elif found is not None and found > DELAY_SLACK_MS:
        yield from _setting(
            situation, Level.WARNING, "EKF2_EV_DELAY", 0,
            "our stamps are those of the exposure, so a latency that is set here too is taken off twice", reboot=True,
        )  # fmt: skip


def _ev_noise(situation: Situation) -> Iterator[Finding]:
    yield from _expect(
        situation, Level.WARNING, "EKF2_EV_NOISE_MD", 0, "the covariance that we send with each fix is ignored"
    )
    floor_m, quality = situation.value("EKF2_EVP_NOISE"), situation.value("EKF2_EV_QMIN")
    if floor_m is not None and floor_m > _MOST_FLOOR_M:
        yield from _setting(
            situation, Level.WARNING, "EKF2_EVP_NOISE", 0.1, "a better fix counts as no better than this"
        )
    if quality is not None and quality > 0:
        silent = "vision_position_estimate" in situation.sinks
        yield from _setting(
            situation, Level.ERROR if silent else Level.WARNING, "EKF2_EV_QMIN", 0,
            "VISION_POSITION_ESTIMATE has no quality, so it counts as 0 and is never used" if silent
            else f"fixes of less than {quality:g} % are dropped; ours that are not good are not sent at all",
        )  # fmt: skip


def _ev_lever_arm(situation: Situation) -> Iterator[Finding]:
    yield from _lever_arm(situation, ("EKF2_EV_POS_X", "EKF2_EV_POS_Y", "EKF2_EV_POS_Z"))


def _px4_height(situation: Situation) -> Iterator[Finding]:
    reasons = {
        1: "the height reference is GNSS, which is what is going to be lost",
        2: "the height reference is the range sensor, which is right over flat ground only",
        3: "the height reference is vision, and ends with the fixes",
    }
    found = situation.value("EKF2_HGT_REF")
    if found in reasons:
        yield from _setting(
            situation, Level.WARNING, "EKF2_HGT_REF", 0, f"{reasons[int(found)]}; 0 is the barometer", reboot=True
        )


def _px4_horizon(situation: Situation) -> Iterator[Finding]:
    """EKF2_DELAY_MAX against the delays that are used."""
    most_ms, names = situation.value("EKF2_DELAY_MAX"), [f"EKF2_AGP{n}_DELAY" for n in _own_slots(situation)]
    if not LOCAL.isdisjoint(situation.sinks):
        names.append("EKF2_EV_DELAY")
    delays = [value for name in names if (value := situation.value(name)) is not None]
    needed_ms = max([*delays, 0.0 if situation.ages is None else situation.ages.high_ms])
    if most_ms is not None and needed_ms > most_ms:
        yield from _setting(
            situation, Level.ERROR, "EKF2_DELAY_MAX", round(needed_ms + 50.0),
            f"the filter looks back {most_ms:g} ms only, and fixes are {needed_ms:.0f} ms old", reboot=True,
        )  # fmt: skip


def _px4_no_aid(situation: Situation) -> Iterator[Finding]:
    found = situation.value("EKF2_NOAID_TOUT")
    if found is not None and found < _LEAST_NO_AID_US:
        yield from _setting(
            situation, Level.WARNING, "EKF2_NOAID_TOUT", 5_000_000,
            f"{found / 1e6:g} s without a fix end the horizontal position; some frames in a row give none",
        )  # fmt: skip


def _ev_beside_gnss(situation: Situation) -> Iterator[Finding]:
    found = situation.value("EKF2_GPS_CTRL")
    if found is not None and int(found) & 1:
        yield Finding(
            Level.NOTE, "EKF2_GPS_CTRL", f"{found:g}", "as it is, knowingly",
            "while GNSS is used its offset to vision is estimated away: external vision can't correct a drifting or "
            "spoofed GNSS, and takes over when GNSS stops",
            "from PX4 1.18 send global_position_sensor instead, which is absolute",
        )  # fmt: skip


def _own_slots(situation: Situation) -> list[int]:
    if _SENSOR.isdisjoint(situation.sinks):
        return []
    return [n for n in range(4) if situation.value(f"EKF2_AGP{n}_ID") == situation.sensor_id]


def _agp(situation: Situation) -> Iterator[Finding]:
    if all(situation.absent(f"EKF2_AGP{n}_ID") for n in range(4)):
        older = situation.value("EKF2_AGP_CTRL") is not None
        yield Finding(
            Level.ERROR, "EKF2_AGP0_ID", "this firmware has none", str(situation.sensor_id),
            "it takes an auxiliary global position from ROS 2 only, not from MAVLink" if older
            else "it has no auxiliary global position, and GLOBAL_POSITION_SENSOR is not heard",
            'set [link] send = ["odometry"], or update to PX4 1.18',
        )  # fmt: skip
        return
    slots = _own_slots(situation)
    if not slots:
        free = [n for n in range(4) if situation.value(f"EKF2_AGP{n}_ID") == 0]
        slots = free[:1]
        for n in slots:
            yield from _setting(
                situation, Level.ERROR, f"EKF2_AGP{n}_ID", situation.sensor_id,
                f"no slot takes the sensor {situation.sensor_id}, which is [link] sensor_id", reboot=True,
            )  # fmt: skip
        if not slots and situation.value("EKF2_AGP0_ID") is not None:
            yield Finding(
                Level.ERROR, "EKF2_AGPn_ID", "all four are taken by others", str(situation.sensor_id),
                "no slot takes our sensor", f"param set EKF2_AGP3_ID {situation.sensor_id}, if it may go", reboot=True,
            )  # fmt: skip
    for n in slots:
        bits = situation.value(f"EKF2_AGP{n}_CTRL")
        if bits is not None and not int(bits) & 1:
            yield from _setting(
                situation, Level.ERROR, f"EKF2_AGP{n}_CTRL", int(bits) | 1,
                "bit 0 is off, so horizontal positions of this sensor are not used",
            )  # fmt: skip
        floor_m = situation.value(f"EKF2_AGP{n}_NOISE")
        if floor_m is not None and floor_m > 2 * _MOST_FLOOR_M:
            yield from _setting(
                situation, Level.WARNING, f"EKF2_AGP{n}_NOISE", 1.0, "a better fix counts as no better than this"
            )
        yield from _delay(situation, f"EKF2_AGP{n}_DELAY", MOST_AGP_DELAY_MS, _usual_ms(situation))
        if situation.value(f"EKF2_AGP{n}_MODE") == 1:
            yield Finding(
                Level.NOTE, f"EKF2_AGP{n}_MODE", "1", "0 or 1, knowingly",
                "the position is set to ours only while there is no source of velocity either",
                f"param set EKF2_AGP{n}_MODE 0 to let it be set whenever no other position is used",
            )  # fmt: skip


def _px4_port(situation: Situation) -> Iterator[Finding]:
    ports = [n for n in range(3) if situation.value(f"MAV_{n}_CONFIG")]
    modes = {f"MAV_{n}_MODE": mode for n in ports if (mode := situation.value(f"MAV_{n}_MODE")) is not None}
    if modes and 2 not in modes.values():
        yield Finding(
            Level.NOTE, "MAV_n_MODE", ", ".join(f"{name} {mode:g}" for name, mode in modes.items()),
            "2 on our port", "mode Onboard is made for companion computers: more messages, at higher rates",
            "param set MAV_n_MODE 2 for the port that we are on", reboot=True,
        )  # fmt: skip


# -- the table -----------------------------------------------------------------------------------------

_A, _P = Autopilot.ARDUPILOT, Autopilot.PX4
_RC_OPTIONS = tuple(f"RC{n}_OPTION" for n in range(5, 17))
# By instance, two names each: up to 4.5, and from 4.6.
_GPS_TYPES = (("GPS_TYPE", "GPS1_TYPE"), ("GPS_TYPE2", "GPS2_TYPE"))
_SERIAL_PROTOCOLS = tuple(f"SERIAL{n}_PROTOCOL" for n in range(1, 8))
_SERIAL_BAUDS = tuple(f"SERIAL{n}_BAUD" for n in range(1, 8))
_PX4_BAUDS = ("SER_TEL1_BAUD", "SER_TEL2_BAUD", "SER_TEL3_BAUD")
_SOURCES = tuple(name for n in (1, 2, 3) for name in _source(n))
_AGP_NAMES = tuple(f"EKF2_AGP{n}_{what}" for n in range(4) for what in ("ID", "CTRL", "MODE", "DELAY", "NOISE"))

_RULES = (
    _Rule(_heartbeat),
    _Rule(_other_autopilots),
    _Rule(_own_id),
    _Rule(_mavlink_version, _SERIAL_PROTOCOLS, _A),
    _Rule(_mavlink_version, ("MAV_PROTO_VER",), _P),
    _Rule(_firmware),
    _Rule(_unread),
    _Rule(_streams),
    _Rule(_timesync),
    _Rule(_baud, _SERIAL_BAUDS, _A),
    _Rule(_baud, _PX4_BAUDS, _P),
    _Rule(_origin, sinks=LOCAL),
    _Rule(_ekf3, ("AHRS_EKF_TYPE", "EK3_ENABLE"), _A),
    _Rule(_viso_type, ("VISO_TYPE",), _A, LOCAL),
    _Rule(_vision_sources, _SOURCES, _A, LOCAL),
    _Rule(_velocities, ("EK3_SRC_OPTIONS",), _A, LOCAL),
    _Rule(_viso_delay, ("VISO_DELAY_MS",), _A, LOCAL),
    _Rule(_viso_lever_arm, ("VISO_POS_X", "VISO_POS_Y", "VISO_POS_Z"), _A, LOCAL),
    _Rule(_viso_conversion, ("VISO_SCALE", "VISO_ORIENT"), _A, LOCAL),
    _Rule(_viso_noise, ("VISO_QUAL_MIN", "VISO_POS_M_NSE"), _A, LOCAL),
    _Rule(_gates, ("EK3_POS_I_GATE", "EK3_GLITCH_RAD"), _A),
    _Rule(_switching, _RC_OPTIONS, _A, LOCAL),
    _Rule(_gps_types, (*_GPS_TYPES[0], *_GPS_TYPES[1]), _A, _GPS),
    _Rule(_gps_sources, _SOURCES, _A, _GPS),
    _Rule(_ev_ctrl, ("EKF2_EV_CTRL",), _P, LOCAL),
    _Rule(_ev_delay, ("EKF2_EV_DELAY",), _P, LOCAL),
    _Rule(_ev_noise, ("EKF2_EV_NOISE_MD", "EKF2_EVP_NOISE", "EKF2_EV_QMIN"), _P, LOCAL),
    _Rule(_ev_lever_arm, ("EKF2_EV_POS_X", "EKF2_EV_POS_Y", "EKF2_EV_POS_Z"), _P, LOCAL),
    _Rule(_ev_beside_gnss, ("EKF2_GPS_CTRL",), _P, LOCAL),
    _Rule(_agp, (*_AGP_NAMES, "EKF2_AGP_CTRL"), _P, _SENSOR),
    _Rule(_px4_horizon, ("EKF2_DELAY_MAX",), _P),
    _Rule(_px4_height, ("EKF2_HGT_REF",), _P),
    _Rule(_px4_no_aid, ("EKF2_NOAID_TOUT",), _P),
    _Rule(_px4_port, tuple(f"MAV_{n}_{what}" for n in range(3) for what in ("CONFIG", "MODE")), _P),
)  # fmt: skip
