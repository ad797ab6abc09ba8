"""Where the autopilot believes to be: dead reckoning plus an estimated offset, which drifts."""

from __future__ import annotations

from bisect import bisect_right
from collections import deque
from dataclasses import dataclass

import numpy as np

from ortholoc_edge.geometry.arrays import FloatArray

_S = 1_000_000_000
_LEAST_DRIFT_VARIANCE = 0.04


@dataclass(frozen=True, slots=True, eq=False)
class Innovation:
    """A measured position against the filter's at the time of its capture.

    Attributes:
        difference_m: (2,) measured minus believed.
        age_s: of the measurement.
        variance_m2: (2,) of the filter's position then, with what dead reckoning may have added since.
    """

    difference_m: FloatArray
    age_s: float
    variance_m2: FloatArray

    @property
    def length_m(self) -> float:
        return float(np.hypot(self.difference_m[0], self.difference_m[1]))


class PositionFilter:
    """North and east, two filters of the same form: the state is (offset m, drift m/s) of dead reckoning.

    A measurement of the past corrects the offset as it was then. Gates and time-outs are the firmware's business.
    """

    def __init__(self, offset_noise: float, drift_noise: float) -> None:
        """Args: m and m/s per root second that the dead reckoning is taken to err by."""
        self._noise = np.array([[offset_noise**2], [0.0], [drift_noise**2]])
        self.reckoned_m = np.zeros(2)
        self.offset_m = np.zeros(2)
        self.drift_m_s = np.zeros(2)
        # Rows: variance of the offset, covariance, variance of the drift. Columns: north, east.
        self._p = np.array([[4.0, 4.0], [0.0, 0.0], [_LEAST_DRIFT_VARIANCE] * 2])
        self._history: deque[tuple[int, FloatArray]] = deque(maxlen=600)

    @property
    def position_m(self) -> FloatArray:
        """(2,) north, east now."""
        return self.reckoned_m + self.offset_m

    @property
    def variance_m2(self) -> FloatArray:
        """(2,) of the position now."""
        return np.array(self._p[0])

    def predict(self, now_ns: int, step_m: FloatArray, dt_s: float) -> None:
        """Go on by a dead-reckoned way (2,)."""
        self.reckoned_m = self.reckoned_m + step_m
        self.offset_m = self.offset_m + self.drift_m_s * dt_s
        p = self._p
        p[0] += 2.0 * dt_s * p[1] + dt_s**2 * p[2]
        p[1] += dt_s * p[2]
        p += self._noise * dt_s
        self._history.append((now_ns, self.reckoned_m))

    def innovation(self, position_m: FloatArray, capture_ns: int, now_ns: int) -> Innovation | None:
        """Of a position (2,) at ``capture_ns``; None if that is before all that is remembered (6 s)."""
        # The nearest step: half a step at 10 m/s is 5 cm.
        after = bisect_right(self._history, capture_ns, key=lambda entry: entry[0])
        if after == 0:
            return None
        near = [i for i in (after - 1, after) if i < len(self._history)]
        index = min(near, key=lambda i: abs(self._history[i][0] - capture_ns))
        age_s = max(0.0, (now_ns - capture_ns) / _S)
        past = self._history[index][1] + self.offset_m - self.drift_m_s * age_s
        p = self._p
        variance = p[0] - 2.0 * age_s * p[1] + age_s**2 * p[2]
        return Innovation(position_m - past, age_s, variance + self._noise[0, 0] * age_s)

    def correct(self, innovation: Innovation, variance_m2: FloatArray | float) -> None:
        """Take a position in, with the variance of its measurement, (2,) or one for both axes."""
        p, age_s = self._p, innovation.age_s
        total = innovation.variance_m2 + variance_m2
        # Covariance of the state now with the position then.
        c0, c1 = p[0] - age_s * p[1], p[1] - age_s * p[2]
        self.offset_m = self.offset_m + c0 / total * innovation.difference_m
        self.drift_m_s = self.drift_m_s + c1 / total * innovation.difference_m
        self._p = p - np.array([c0 * c0, c0 * c1, c1 * c1]) / total

    def correct_velocity(self, difference_m_s: FloatArray, variance: float) -> None:
        """Take a velocity in: (2,) measured minus believed."""
        p = self._p
        total = p[2] + variance
        self.offset_m = self.offset_m + p[1] / total * difference_m_s
        self.drift_m_s = self.drift_m_s + p[2] / total * difference_m_s
        self._p = p - np.array([p[1] * p[1], p[1] * p[2], p[2] * p[2]]) / total

    @property
    def drift_variance(self) -> FloatArray:
        """(2,) of the velocity."""
        return np.array(self._p[2])

    def reset(self, difference_m: FloatArray, variance_m2: FloatArray | float) -> None:
        """Move the position by (2,) at once."""
        self.offset_m = self.offset_m + difference_m
        drift = np.maximum(_LEAST_DRIFT_VARIANCE, self._p[2])
        self._p = np.array([np.broadcast_to(variance_m2, 2), np.zeros(2), drift])
