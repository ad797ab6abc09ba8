"""Displacement between frames from the autopilot's velocity."""

from __future__ import annotations

import numpy as np

from ortholoc_edge.geometry.arrays import FloatArray

_MAX_GAP_NS = 3_000_000_000


class VelocityOdometry:
    """Integrates velocity over the frames' stamps by trapezia; used by one thread.

    Why not the autopilot's position: it takes in our own fixes, so the step from one frame to the next would
    hold the correction by the last fix once more. Its velocity hardly does.

    Attributes:
        position_ned_m: (3,) from an arbitrary origin.
        epoch: rises where the integral is broken: no velocity, or none for three seconds.
    """

    def __init__(self) -> None:
        self.position_ned_m: FloatArray = np.zeros(3)
        self.epoch = 0
        self._last: tuple[int, FloatArray] | None = None

    def add(self, stamp_ns: int, velocity_ned_m_s: FloatArray | None) -> bool:
        """Carry on to a stamp. Returns whether the position means anything there."""
        if velocity_ned_m_s is None or not np.isfinite(velocity_ned_m_s).all():
            self._last = None
            return False
        if self._last is not None and 0 <= stamp_ns - self._last[0] <= _MAX_GAP_NS:
            elapsed_s = (stamp_ns - self._last[0]) * 1e-9
            self.position_ned_m = self.position_ned_m + 0.5 * elapsed_s * (self._last[1] + velocity_ned_m_s)
        else:
            self.epoch += 1
        self._last = stamp_ns, velocity_ned_m_s
        return True
