"""Estimates as the messages that autopilots read; pure functions, no I/O.

ODOMETRY and VISION_POSITION_ESTIMATE carry a local position and 21 covariances, which are read in three ways:

- PX4 takes each diagonal entry as the variance of its axis, as the message definition says.
- ArduPilot reduces the three position entries to *one* standard deviation for north and east, and the three
  angle entries to one for yaw. Up to 4.7 that is the cube root of the sum of their squares; since pull
  request 32084 (February 2026, taken here as 4.8) it is the square root of their sum.

So what is encoded is chosen such that the filter ends up with the standard deviation we mean. Off-diagonal
entries are read by neither; PX4 gets them all the same. GLOBAL_POSITION_SENSOR, GPS_INPUT and the command
MAV_CMD_EXTERNAL_POSITION_ESTIMATE carry a place on WGS 84 and standard deviations as such.

A filter also bounds what it is told. Where it would believe *less* uncertainty than we mean, nothing is sent
(`Refusal`); where it believes more, that is said once and does no harm. `docs/autopilot-sinks.md` tabulates all
of it, from the oracles in `tests/oracles`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from ortholoc_edge.adapters.mavlink.codec import MavlinkMessage, dialect
from ortholoc_edge.adapters.mavlink.estimates import (
    Autopilot,
    VisionEstimate,
    horizontal_sigma_m,
    vertical_sigma_m,
    yaw_sigma_rad,
)
from ortholoc_edge.adapters.mavlink.geodesy import EarthModel, GeodeticOrigin, Place, geodetic_from_ned
from ortholoc_edge.adapters.mavlink.state import AutopilotIdentity
from ortholoc_edge.geometry import rotation
from ortholoc_edge.geometry.arrays import FloatArray

Version = tuple[int, int, int]

_S = 1_000_000_000

# ArduPilot's covariance by the square root: pull request 32084, merged in February 2026 when 4.7 had branched.
SQUARE_ROOT_SINCE: Version = (4, 8, 0)
# ArduPilot believes position sigmas up to 100 m instead of 10 m: pull request 29420, March 2025, after 4.6 had
# branched. If a 4.6 got it, 10 m is on the safe side.
WIDE_SIGMA_SINCE: Version = (4, 7, 0)
# PX4 receives GLOBAL_POSITION_SENSOR: pull request 26307, merged in 2026, in the release notes of 1.18.
# ArduPilot: pull request 31738 was open in August 2026, a month after the release of 4.7.0, so no version is known
# to receive it and it goes there only by name.
PX4_GLOBAL_POSITION_SENSOR_SINCE: Version = (1, 18, 0)
# MAV_CMD_EXTERNAL_POSITION_ESTIMATE: ArduPilot pull request 23903 (June 2023), PX4 22444 (November 2023, after 1.14).
EXTERNAL_POSITION_SINCE: dict[Autopilot, Version] = {Autopilot.ARDUPILOT: (4, 5, 0), Autopilot.PX4: (1, 15, 0)}

# Upper triangle of a 6x6 matrix, row by row.
_TRIANGLE = np.triu_indices(6)
_AUTOPILOT_COMPONENT = 1
# GPS time began on 1980-01-06 and does not know the leap seconds since; 18 of them, the last one of 2016.
_GPS_EPOCH_UNIX_S, _LEAP_S, _WEEK_MS = 315_964_800, 18, 604_800_000
# A wall clock outside of these was never set: the first is before this code, the second beyond any vehicle of today.
_WALL_CLOCK_FROM_NS = 1_767_225_600 * _S  # 2026-01-01
_WALL_CLOCK_UNTIL_NS = 3_345_062_400 * _S  # 2076-01-01
# Metres of error per unit of dilution: what a receiver would have to be like to have our sigma at this dilution.
_RANGE_ERROR_M = 3.0
# What GISNav sends, too: no receiver sees so many, so a log tells our fixes from a receiver's.
_SATELLITES_MARK = 255
# To this age ArduPilot moves a position forward by its velocity (EKF3 setLatLng); PX4 does so to 15 s.
_MOST_AGE_NS = 5 * _S
# The wrap that the command's definition asks for, so that a float holds the time to 15 microseconds.
_COMMAND_WRAP_NS = 250 * _S


class Sink(StrEnum):
    """A message that carries an estimate."""

    ODOMETRY = "odometry"
    VISION_POSITION_ESTIMATE = "vision_position_estimate"
    GLOBAL_POSITION_SENSOR = "global_position_sensor"
    GPS_INPUT = "gps_input"
    EXTERNAL_POSITION_ESTIMATE = "external_position_estimate"  # the command; for recovery, not a stream

    @property
    def local(self) -> bool:
        """Whether its position counts from the EKF origin."""
        return self in (Sink.ODOMETRY, Sink.VISION_POSITION_ESTIMATE)


class CovarianceLayout(StrEnum):
    """How the receiver turns the covariance field into standard deviations."""

    CUBE_ROOT = "cube_root"  # ArduPilot before 4.8
    SQUARE_ROOT = "square_root"  # ArduPilot from 4.8
    EITHER_ROOT = "either_root"  # ArduPilot of unknown version, or a build between two releases
    PER_AXIS = "per_axis"  # PX4, and the message definition


@dataclass(frozen=True, slots=True)
class Limits:
    """What a firmware makes of a sink's figures with its parameters at their defaults.

    Attributes:
        least_sigma_m: a smaller horizontal sigma counts as this one. least_by: the parameter that sets it.
        most_sigma_m: a larger one counts as this one, which is less than was meant.
        most_yaw_sigma_rad: the same for yaw.
        least_rate_hz: slower, and the firmware complains or stops using it.
        most_rate_hz: what comes faster is discarded.
    """

    least_sigma_m: float
    least_by: str
    most_sigma_m: float = math.inf
    most_yaw_sigma_rad: float = math.inf
    least_rate_hz: float = 0.0
    most_rate_hz: float = math.inf


@dataclass(frozen=True, slots=True)
class Refusal:
    """Why a sink does not carry an estimate. ``kind`` is of a fixed set, ``why`` for people."""

    sink: Sink
    kind: str
    why: str


@dataclass(frozen=True, slots=True)
class Sending:
    """The circumstances of a message.

    Attributes:
        vehicle: whom it goes to.
        now_ns: when, monotonic clock.
        wall_ns: when, nanoseconds of UNIX time; read by GPS_INPUT only.
        capture_stamps: whether other messages on the link bear the stamp of their capture. ArduPilot relates all
            stamps of a link to its clock by one offset, the least delay seen lately (contract 2.6): a single
            message stamped at transmission would take the constant latency out of that offset, and
            VISO_DELAY_MS would count it twice for the next hundred messages.
        sensor_id: ``id`` of GLOBAL_POSITION_SENSOR.
        gps_id: of GPS_INPUT: which of ArduPilot's GPS instances takes it, from 0.
    """

    vehicle: AutopilotIdentity
    now_ns: int
    wall_ns: int = 0
    capture_stamps: bool = False
    sensor_id: int = 1
    gps_id: int = 1


@dataclass(frozen=True, slots=True)
class Choice:
    """The sinks for an autopilot, and sentences for the log: why these, and what is doubtful about them."""

    sinks: tuple[Sink, ...]
    why: str
    doubts: tuple[str, ...] = ()


def covariance_layout(autopilot: Autopilot, version: Version | None) -> CovarianceLayout:
    """The layout that a firmware reads."""
    if autopilot is Autopilot.PX4:
        return CovarianceLayout.PER_AXIS
    if version is None:
        return CovarianceLayout.EITHER_ROOT
    return CovarianceLayout.SQUARE_ROOT if version >= SQUARE_ROOT_SINCE else CovarianceLayout.CUBE_ROOT


def earth_model(autopilot: Autopilot) -> EarthModel:
    """The model by which an autopilot itself relates latitude and longitude to its local position."""
    return EarthModel.PX4 if autopilot is Autopilot.PX4 else EarthModel.ARDUPILOT


def is_known_to_read(sink: Sink, autopilot: Autopilot, version: Version | None) -> bool:
    """Whether some source says that this firmware takes the sink in."""
    if sink is Sink.GLOBAL_POSITION_SENSOR:
        return autopilot is Autopilot.PX4 and version is not None and version >= PX4_GLOBAL_POSITION_SENSOR_SINCE
    if sink is Sink.GPS_INPUT:
        return autopilot is Autopilot.ARDUPILOT
    if sink is Sink.EXTERNAL_POSITION_ESTIMATE:
        return version is None or version >= EXTERNAL_POSITION_SINCE[autopilot]
    return True


def choose_sinks(send: tuple[str, ...], vehicle: AutopilotIdentity) -> Choice:
    """The sinks for an autopilot: those named in ``send``, or the best one for ``("auto",)``.

    "auto" takes one, never two: both would bring the same error to the filter as if they were independent. A sink
    that is named is sent even where the firmware is not known to read it; that is told among the doubts.
    """
    autopilot, version = vehicle.autopilot, vehicle.release
    who = f"{autopilot.value} {vehicle.firmware}"
    if send == ("auto",):
        if is_known_to_read(Sink.GLOBAL_POSITION_SENSOR, autopilot, version):
            return Choice(
                (Sink.GLOBAL_POSITION_SENSOR,), f"{who} takes a position on WGS 84, independent of its origin"
            )
        if version is None and vehicle.development and autopilot is Autopilot.PX4:
            why = f"{who}: every version reads it; what more such a build reads its number does not tell"
        elif version is None:
            why = f"{who}: every version reads it, and its position sigma is encoded so that none is too small"
        elif autopilot is Autopilot.PX4:
            since = ".".join(map(str, PX4_GLOBAL_POSITION_SENSOR_SINCE))
            why = f"{who} reads GLOBAL_POSITION_SENSOR only since {since}"
        else:
            why = f"{who} reads it with position, attitude, covariance, quality and reset counter"
        return Choice((Sink.ODOMETRY,), why)
    sinks = tuple(Sink(name) for name in send)
    doubts = [
        f"{who} is not known to read {sink.value.upper()}, which [link] send names; it will take no estimate from it"
        for sink in sinks
        if not is_known_to_read(sink, autopilot, version)
    ]
    if len(sinks) > 1:
        named = ", ".join(sink.value.upper() for sink in sinks)
        doubts.append(f"{named} carry the same estimate; let the autopilot fuse only one of them")
    return Choice(sinks, "[link] send names them", tuple(doubts))


def limits(sink: Sink, autopilot: Autopilot, version: Version | None) -> Limits:
    """Bounds of a sink at a firmware; of an unknown version the narrower ones."""
    if autopilot is Autopilot.PX4:
        if sink is Sink.GLOBAL_POSITION_SENSOR:
            return Limits(1.0, "EKF2_AGPn_NOISE", least_rate_hz=0.2)
        if sink is Sink.EXTERNAL_POSITION_ESTIMATE:
            return Limits(0.01, "a constant")
        return Limits(0.1, "EKF2_EVP_NOISE", least_rate_hz=5.0)
    if sink.local:
        most_m = 100.0 if version is not None and version >= WIDE_SIGMA_SINCE else 10.0
        return Limits(0.2, "VISO_POS_M_NSE", most_m, 1.5, least_rate_hz=4.0, most_rate_hz=50.0)
    if sink is Sink.GPS_INPUT:
        return Limits(0.5, "EK3_POSNE_M_NSE", 100.0, least_rate_hz=5.0)
    return Limits(0.5, "EK3_POSNE_M_NSE")


def encode(
    sink: Sink, estimate: VisionEstimate, origin: GeodeticOrigin | None, sending: Sending
) -> MavlinkMessage | Refusal:
    """The message by which ``sink`` tells an estimate to an autopilot, or why it can't.

    Args:
        origin: the autopilot's now; local positions that count from another one are refused.
    """
    vehicle = sending.vehicle
    refusal = _beyond_bounds(sink, estimate, vehicle)
    if refusal is not None:
        return refusal
    if sink.local:
        refusal = _without_position(sink, estimate, origin)
        if refusal is not None:
            return refusal
        layout = covariance_layout(vehicle.autopilot, vehicle.release)
        local = encode_odometry if sink is Sink.ODOMETRY else encode_vision_position_estimate
        return local(estimate, layout)
    place = _place(estimate, vehicle.autopilot)
    if place is None:
        return Refusal(sink, "no_place", "the estimate has no position on WGS 84")
    refusal = _outside_time(sink, estimate, sending)
    if refusal is not None:
        return refusal
    encoders = {
        Sink.GLOBAL_POSITION_SENSOR: encode_global_position_sensor,
        Sink.GPS_INPUT: encode_gps_input,
        Sink.EXTERNAL_POSITION_ESTIMATE: encode_external_position_estimate,
    }
    return encoders[sink](estimate, place, sending)


def _place(estimate: VisionEstimate, autopilot: Autopilot) -> Place | None:
    """Where the local position is on WGS 84, by the formula that it was made with; else the place that is stated."""
    stated, origin, position = estimate.place, estimate.origin, estimate.position_ned_m
    if stated is None or origin is None or position is None:
        return stated
    latitude_deg, longitude_deg, height_amsl_m = geodetic_from_ned(origin, position, earth_model(autopilot))
    if stated.height_ellipsoid_m is None:
        return Place(latitude_deg, longitude_deg, height_amsl_m)
    undulation_m = stated.height_ellipsoid_m - stated.height_amsl_m
    return Place(latitude_deg, longitude_deg, height_amsl_m, height_amsl_m + undulation_m)


def _beyond_bounds(sink: Sink, estimate: VisionEstimate, vehicle: AutopilotIdentity) -> Refusal | None:
    """Where the filter would trust the estimate more than we do."""
    bounds = limits(sink, vehicle.autopilot, vehicle.release)
    who = f"{vehicle.autopilot.value} {vehicle.firmware}"
    sigma_m, yaw_sigma = horizontal_sigma_m(estimate), yaw_sigma_rad(estimate)
    if sigma_m > bounds.most_sigma_m:
        why = f"position sigma {sigma_m:.1f} m, but {who} believes {bounds.most_sigma_m:g} m at most"
        return Refusal(sink, "sigma", why)
    if yaw_sigma > bounds.most_yaw_sigma_rad:
        why = f"yaw sigma {yaw_sigma:.2f} rad, but {who} believes {bounds.most_yaw_sigma_rad:g} rad at most"
        return Refusal(sink, "yaw_sigma", why)
    return None


def _without_position(sink: Sink, estimate: VisionEstimate, origin: GeodeticOrigin | None) -> Refusal | None:
    if estimate.position_ned_m is None:
        return Refusal(sink, "no_origin", "the autopilot has no EKF origin to count a local position from")
    if estimate.origin is not None and estimate.origin != origin:
        return Refusal(sink, "origin_moved", "the EKF origin moved after this estimate was made; the next will do")
    return None


def _outside_time(sink: Sink, estimate: VisionEstimate, sending: Sending) -> Refusal | None:
    age_ns = sending.now_ns - estimate.stamp_ns
    if not 0 <= age_ns <= _MOST_AGE_NS:
        why = f"captured {age_ns / _S:.1f} s ago; a place is sent from 0 to {_MOST_AGE_NS // _S} s after its capture"
        return Refusal(sink, "age", why)
    if sink is Sink.GPS_INPUT and not _WALL_CLOCK_FROM_NS <= sending.wall_ns < _WALL_CLOCK_UNTIL_NS:
        why = (
            f"it needs the date, and the system clock says {sending.wall_ns // _S} s since 1970, which is not between "
            "2026 and 2076; set the clock (RTC, NTP), or send ODOMETRY, which does without"
        )
        return Refusal(sink, "wall_clock", why)
    return None


def covariance_field(estimate: VisionEstimate, layout: CovarianceLayout) -> list[float]:
    """The 21 floats for the message, finite throughout.

    For ArduPilot the vertical entry stays zero, since it would add to the horizontal one, and so do roll and
    pitch beside yaw. No entry may be NaN: ArduPilot tests the first only, and a NaN elsewhere ends in its
    internal error "constraining_nan". Where the root is not known the larger entry goes: whichever is taken, the
    result is never less than was meant, and between 0.2 and 10 m at most 1.8 times that.
    """
    if layout is CovarianceLayout.PER_AXIS:
        return [float(v) for v in estimate.covariance[_TRIANGLE]]
    sigma, yaw_sigma = horizontal_sigma_m(estimate), yaw_sigma_rad(estimate)
    square, cube = (np.zeros(6) for _ in range(2))
    square[:2], square[5] = sigma**2 / 2.0, yaw_sigma**2
    cube[:2], cube[5] = math.sqrt(sigma**3 / 2.0), math.sqrt(yaw_sigma**3)
    diagonal: FloatArray = {
        CovarianceLayout.SQUARE_ROOT: square,
        CovarianceLayout.CUBE_ROOT: cube,
        CovarianceLayout.EITHER_ROOT: np.maximum(square, cube),
    }[layout]
    return [float(v) for v in np.diag(diagonal)[_TRIANGLE]]


def encode_vision_position_estimate(estimate: VisionEstimate, layout: CovarianceLayout) -> MavlinkMessage:
    """VISION_POSITION_ESTIMATE. It has no quality field; an estimate that is not good is simply not sent."""
    north, east, down = _local(estimate)
    roll, pitch, yaw = rotation.to_euler(estimate.ned_from_body)
    return dialect.MAVLink_vision_position_estimate_message(
        usec=estimate.stamp_ns // 1000,
        x=north,
        y=east,
        z=down,
        roll=roll,
        pitch=pitch,
        yaw=yaw,
        covariance=covariance_field(estimate, layout),
        reset_counter=estimate.reset_counter,
    )


def encode_odometry(estimate: VisionEstimate, layout: CovarianceLayout) -> MavlinkMessage:
    """ODOMETRY without velocity, which is NaN: zeros would be a measurement of standing still.

    ArduPilot drops it silently in any frame but LOCAL_FRD, by which it means north and east of its origin.
    PX4 takes that frame as having an arbitrary heading and turns it, so there it must be LOCAL_NED.
    """
    nan = math.nan
    px4 = layout is CovarianceLayout.PER_AXIS
    north, east, down = _local(estimate)
    return dialect.MAVLink_odometry_message(
        time_usec=estimate.stamp_ns // 1000,
        frame_id=dialect.MAV_FRAME_LOCAL_NED if px4 else dialect.MAV_FRAME_LOCAL_FRD,
        child_frame_id=dialect.MAV_FRAME_BODY_FRD,
        x=north,
        y=east,
        z=down,
        q=[float(v) for v in rotation.to_quaternion(estimate.ned_from_body)],
        vx=nan,
        vy=nan,
        vz=nan,
        rollspeed=nan,
        pitchspeed=nan,
        yawspeed=nan,
        pose_covariance=covariance_field(estimate, layout),
        velocity_covariance=[nan] + [0.0] * 20,
        reset_counter=estimate.reset_counter,
        estimator_type=dialect.MAV_ESTIMATOR_TYPE_VISION,
        # 0 would mean "unknown", -1 "failed"; the worst estimate that is still one is 1 %.
        quality=max(1, min(100, round(estimate.quality * 100.0))),
    )


def encode_global_position_sensor(estimate: VisionEstimate, place: Place, sending: Sending) -> MavlinkMessage:
    """GLOBAL_POSITION_SENSOR. It has neither attitude nor reset counter; PX4 resets on its own terms.

    ``eph`` is the sigma of one axis: PX4 takes its square as the variance of north and of east. The processing time
    is an integer, though its definition wants NaN where it is not known.
    """
    stamp_ns = _stamp_ns(estimate, sending)
    return dialect.MAVLink_global_position_sensor_message(
        target_system=sending.vehicle.system_id,
        target_component=_AUTOPILOT_COMPONENT,
        id=sending.sensor_id,
        time_usec=stamp_ns // 1000,
        processing_time=sending.now_ns // 1000 - estimate.stamp_ns // 1000,
        source=dialect.GLOBAL_POSITION_SRC_VISION,
        flags=0,
        lat=round(place.latitude_deg * 1e7),
        lon=round(place.longitude_deg * 1e7),
        alt_ellipsoid=math.nan if place.height_ellipsoid_m is None else place.height_ellipsoid_m,
        alt=place.height_amsl_m,
        eph=horizontal_sigma_m(estimate),
        epv=vertical_sigma_m(estimate),
    )


def encode_gps_input(estimate: VisionEstimate, place: Place, sending: Sending) -> MavlinkMessage:
    """GPS_INPUT: the estimate in the guise of a receiver without velocity, for ArduPilot's GPSn_TYPE 14.

    The only message that needs the date. Dilutions are those that a receiver with 3 m of range error would have at
    our sigmas, since ArduPilot asks for some before it arms.
    """
    wall_ms = (sending.wall_ns - (sending.now_ns - estimate.stamp_ns)) // 1_000_000
    week, week_ms = divmod(wall_ms - (_GPS_EPOCH_UNIX_S - _LEAP_S) * 1000, _WEEK_MS)
    horizontal_m, vertical_m = horizontal_sigma_m(estimate), vertical_sigma_m(estimate)
    return dialect.MAVLink_gps_input_message(
        time_usec=estimate.stamp_ns // 1000,
        gps_id=sending.gps_id,
        ignore_flags=dialect.GPS_INPUT_IGNORE_FLAG_VEL_HORIZ
        | dialect.GPS_INPUT_IGNORE_FLAG_VEL_VERT
        | dialect.GPS_INPUT_IGNORE_FLAG_SPEED_ACCURACY,
        time_week_ms=week_ms,
        time_week=week,
        fix_type=dialect.GPS_FIX_TYPE_3D_FIX,
        lat=round(place.latitude_deg * 1e7),
        lon=round(place.longitude_deg * 1e7),
        alt=place.height_amsl_m,
        hdop=horizontal_m / _RANGE_ERROR_M,
        vdop=vertical_m / _RANGE_ERROR_M,
        vn=0.0,
        ve=0.0,
        vd=0.0,
        speed_accuracy=0.0,
        horiz_accuracy=horizontal_m,
        vert_accuracy=vertical_m,
        satellites_visible=_SATELLITES_MARK,
        yaw=0,
    )


def encode_external_position_estimate(estimate: VisionEstimate, place: Place, sending: Sending) -> MavlinkMessage:
    """MAV_CMD_EXTERNAL_POSITION_ESTIMATE: sets the horizontal position of a filter that dead reckons.

    ArduPilot takes the time of transmission for a stamp like those of ODOMETRY, so there it does not wrap. As a float
    it is coarse (8 ms after a day); it is rounded down, so that it can't pull the link's clock offset.
    """
    stamp_ns = _stamp_ns(estimate, sending)
    if sending.vehicle.autopilot is Autopilot.PX4:
        stamp_ns %= _COMMAND_WRAP_NS
    return dialect.MAVLink_command_int_message(
        target_system=sending.vehicle.system_id,
        target_component=_AUTOPILOT_COMPONENT,
        frame=dialect.MAV_FRAME_GLOBAL,
        command=dialect.MAV_CMD_EXTERNAL_POSITION_ESTIMATE,
        current=0,
        autocontinue=0,
        param1=_float_below(stamp_ns / _S),
        param2=(sending.now_ns - estimate.stamp_ns) / _S,
        param3=horizontal_sigma_m(estimate),
        param4=math.nan,
        x=round(place.latitude_deg * 1e7),
        y=round(place.longitude_deg * 1e7),
        z=math.nan,
    )


def _local(estimate: VisionEstimate) -> tuple[float, float, float]:
    if estimate.position_ned_m is None:
        raise ValueError("position_ned_m: None can't be sent as a local position")
    north, east, down = (float(v) for v in estimate.position_ned_m)
    return north, east, down


def _stamp_ns(estimate: VisionEstimate, sending: Sending) -> int:
    """Of transmission; or of capture, so that all stamps that ArduPilot sees on the link are of one kind."""
    alike = sending.capture_stamps and sending.vehicle.autopilot is Autopilot.ARDUPILOT
    return estimate.stamp_ns if alike else sending.now_ns


def _float_below(value: float) -> float:
    """The largest single-precision number that is not above ``value``."""
    single = np.float32(value)
    return float(np.nextafter(single, np.float32(-np.inf)) if float(single) > value else single)
