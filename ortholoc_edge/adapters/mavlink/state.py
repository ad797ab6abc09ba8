"""What the autopilot told of itself and of the vehicle: values that cross threads."""

from __future__ import annotations

from dataclasses import dataclass

from ortholoc_edge.adapters.mavlink.estimates import Autopilot
from ortholoc_edge.adapters.mavlink.geodesy import GeodeticOrigin
from ortholoc_edge.geometry.arrays import FloatArray


@dataclass(frozen=True, slots=True)
class AutopilotIdentity:
    """Who answers on the link.

    Attributes:
        firmware_version: None until AUTOPILOT_VERSION came.
        development: whether that is of a build between two releases (dev, alpha, beta, release candidate), which may
            or may not have what the release of that number has.
    """

    system_id: int
    autopilot: Autopilot
    firmware_version: tuple[int, int, int] | None
    development: bool = False

    @property
    def release(self) -> tuple[int, int, int] | None:
        """The version by which to know what the firmware does; None where that is uncertain."""
        return None if self.development else self.firmware_version

    @property
    def firmware(self) -> str:
        """In words."""
        if self.firmware_version is None:
            return "of unknown version"
        return ".".join(map(str, self.firmware_version)) + (" (dev build)" if self.development else "")


@dataclass(frozen=True, slots=True)
class GnssPosition:
    """What the GNSS receiver itself measured, carried to the stamp by odometry; 1-sigma, the horizontal one per
    axis. Not the autopilot's own position: that one holds our fixes too, and would confirm their errors."""

    latitude_deg: float
    longitude_deg: float
    height_amsl_m: float
    sigma_horizontal_m: float
    sigma_vertical_m: float


@dataclass(frozen=True, slots=True, eq=False)
class AutopilotState:
    """What the autopilot knew of the vehicle at ``stamp_ns`` (our monotonic clock).

    Attributes:
        ned_from_body: (3, 3); None without an attitude within 0.2 s of the stamp.
        interpolated: whether ``ned_from_body``, and where it is known ``ned_from_gimbal``, lies between two samples
            received; if not it was carried on, and asking again a little later gives a better one.
        turning_rad_s: (3,) of the body about its own axes; None without an attitude.
        velocity_ned, local_position_ned_m: (3,) of LOCAL_POSITION_NED, relative to the EKF origin.
        local_epoch: rises when the local position jumped, its stream had a gap, the origin moved or the
            autopilot restarted. Positions of two epochs must not be subtracted.
        odometry_ned_m: (3,) the integral of the autopilot's velocity since an arbitrary point; for
            displacements. Not its position, because that takes in our own fixes: the way from one frame to
            the next would hold the correction by the last fix once more. None without a sample near the stamp.
        odometry_epoch: rises when the integral is broken: the velocity was missing for more than a second or
            not finite, or the autopilot restarted.
        gnss: where GNSS is healthy: a fix, fresh, of stated and sufficient accuracy; None otherwise.
        origin: the EKF origin, once the autopilot has told it.
        armed: of the last HEARTBEAT. landed: of EXTENDED_SYS_STATE, None while unknown.
        synchronised: whether stamps were related by TIMESYNC; if not, by time of arrival, which is late by
            the link's delay. sync_uncertainty_ns: half the round trip plus drift; None if not synchronised.
        estimator_flags, position_test_ratio: of EKF_STATUS_REPORT (ArduPilot) or ESTIMATOR_STATUS (PX4); a
            ratio above 1 means that the filter refuses position measurements.
        ned_from_gimbal: (3, 3) of the gimbal's axes, forward along the line of sight; None where no gimbal was
            asked for, or its attitude at the stamp is not known.
        gimbal_sigma_rad: 1-sigma of what it may have turned in the time by which its reports miss the stamp.
    """

    stamp_ns: int
    ned_from_body: FloatArray | None
    interpolated: bool
    velocity_ned: FloatArray | None
    local_position_ned_m: FloatArray | None
    local_epoch: int
    odometry_ned_m: FloatArray | None
    odometry_epoch: int
    gnss: GnssPosition | None
    origin: GeodeticOrigin | None
    armed: bool
    landed: bool | None
    synchronised: bool
    sync_uncertainty_ns: int | None
    estimator_flags: int | None
    position_test_ratio: float | None
    ned_from_gimbal: FloatArray | None = None
    gimbal_sigma_rad: float = 0.0
    turning_rad_s: FloatArray | None = None
