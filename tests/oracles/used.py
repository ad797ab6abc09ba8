"""What an oracle states of a frame: what the filter would take from it, or why it takes nothing."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Used:
    """A measurement as it reaches the filter.

    Attributes:
        frame: what the position counts from.
        latitude_deg, longitude_deg: where that puts the vehicle, by the firmware's own formula.
        sigma_north_m, sigma_east_m: as in the filter's measurement covariance.
        yaw_rad, yaw_sigma_rad: None where the message brings no attitude. It is fused only if parameters say so.
        capture_us: when the filter thinks that it was measured, by the autopilot's clock. Half a step of the filter,
            which both firmwares take off for their own sampling, is left out.
        resets: whether the filter jumps to it.
        velocity: whether it brings one.
    """

    frame: str
    latitude_deg: float
    longitude_deg: float
    sigma_north_m: float
    sigma_east_m: float
    yaw_rad: float | None
    yaw_sigma_rad: float | None
    capture_us: int
    resets: bool = False
    velocity: bool = False


@dataclass(frozen=True, slots=True)
class Dropped:
    """The filter never sees it."""

    why: str
