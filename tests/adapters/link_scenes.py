"""What an autopilot knew, made up: for the state machines between fixes and filter."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ortholoc_edge.adapters.mavlink.estimates import VisionEstimate
from ortholoc_edge.adapters.mavlink.geodesy import GeodeticOrigin
from ortholoc_edge.adapters.mavlink.state import AutopilotState, GnssPosition
from ortholoc_edge.geometry import rotation

MS, S = 1_000_000, 1_000_000_000
ORIGIN = GeodeticOrigin(50.0, 7.0, 100.0)
GOOD_FLAGS = 831  # all but constant position mode and the glitch bits


class Flight:
    """A straight flight; what is set holds from the next look on. Stamps in ns of our clock."""

    def __init__(self, velocity=(10.0, 0.0, 0.0), yaw_rate: float = 0.2) -> None:
        self.velocity = np.array(velocity)
        self.reported_velocity = self.velocity  # what the odometry makes of it
        self.yaw_rate = yaw_rate
        self.epoch_from_ns = 1 << 62  # odometry is another one from here
        self.known_from_ns, self.known_until_ns = 0, 1 << 62
        self.origin = ORIGIN
        self.position_of: Callable[[float], np.ndarray] = self.truth
        self.gnss: GnssPosition | None = None
        self.flags: int | None = GOOD_FLAGS
        self.ratio: float | None = 0.2

    def truth(self, seconds: float) -> np.ndarray:
        return self.velocity * seconds

    def attitude(self, seconds: float) -> np.ndarray:
        return rotation.from_euler(0.05, -0.03, self.yaw_rate * seconds)

    def look(self, stamp_ns: int) -> AutopilotState | None:
        t = stamp_ns / S
        known = self.known_from_ns <= stamp_ns <= self.known_until_ns
        return AutopilotState(
            stamp_ns=stamp_ns,
            ned_from_body=self.attitude(t) if known else None,
            interpolated=True,
            velocity_ned=self.reported_velocity,
            local_position_ned_m=self.position_of(t),
            local_epoch=0,
            odometry_ned_m=self.reported_velocity * t if known else None,
            odometry_epoch=int(stamp_ns >= self.epoch_from_ns),
            gnss=self.gnss,
            origin=self.origin,
            armed=True,
            landed=False,
            synchronised=True,
            sync_uncertainty_ns=MS,
            estimator_flags=self.flags,
            position_test_ratio=self.ratio,
        )

    def fix(self, stamp_ns: int, error=(0.0, 0.0, 0.0), sigma_m: float = 0.5, yaw_error: float = 0.0, counter: int = 1):
        t = stamp_ns / S
        return VisionEstimate(
            stamp_ns,
            self.truth(t) + np.array(error),
            rotation.exp([0.0, 0.0, yaw_error]) @ self.attitude(t),
            np.diag([sigma_m**2] * 3 + [0.01**2] * 3),
            counter,
            0.8,
        )
