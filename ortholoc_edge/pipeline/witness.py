"""Does GNSS agree with the camera? A sequential test; pure.

A spoofer pulls slowly, so that every single innovation stays within the autopilot's gate. The camera sees the ground:
GNSS minus fix, over both covariances, summed up over time, shows it. The statistic is a CUSUM (Page 1954) of the
squared normalised horizontal difference q, two degrees of freedom, against time rather than count, since errors of both
are alike from one frame to the next and ten fixes a second know little more than one:

    S <- clip(S + (min(median of the last three q, most) - reference) dt, 0, ceiling)

``reference`` is what a bias may do for ever: GNSS's least sigma (telemetry: 1.5 m) and the fix's are in q's covariance,
and with 16 a constant difference of four sigmas, 6.3 m at best, raises nothing. The median leaves single wild fixes
out, and ``most`` bounds what a few can do. docs/studies/witness.md has the times to detection and the false alarms.

Heights are looked at apart: a constant difference that is large is a datum mixed up (the geoid is 30 to 50 m), not
spoofing, and must not be told as such.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from enum import StrEnum
from statistics import median
from typing import Annotated

from msgspec import Meta, Struct

from ortholoc_edge.geometry.arrays import FloatArray

_S = 1_000_000_000

# A difference counts for the time since the last one, but for no longer than this: silence is no evidence.
_MOST_STEP_S = 1.0
# S does not fall below 0, nor rise above this many times `bad_score`: or coming back would take as long as it lasted.
_CEILING = 1.5
_HEIGHTS = 31


class WitnessOptions(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The ``[witness]`` table.

    Attributes:
        reference: squared normalised difference that counts neither way.
        most: a single difference counts for no more.
        suspect_score, bad_score: sums, in seconds times squared sigmas, at which GNSS is suspect, and bad.
        clear_s: seconds that the sum must stay below half of ``suspect_score`` until GNSS is trusted again.
        forget_s: seconds without anything to compare until nothing is known.
        height_m: a constant difference in height beyond this is told.
    """

    reference: Annotated[float, Meta(gt=2)] = 16.0
    most: Annotated[float, Meta(gt=2)] = 64.0
    suspect_score: Annotated[float, Meta(gt=0)] = 30.0
    bad_score: Annotated[float, Meta(gt=0)] = 100.0
    clear_s: Annotated[float, Meta(gt=0)] = 20.0
    forget_s: Annotated[float, Meta(gt=0)] = 60.0
    height_m: Annotated[float, Meta(gt=0)] = 15.0

    def __post_init__(self) -> None:
        if not self.suspect_score < self.bad_score:
            raise ValueError(f"suspect_score {self.suspect_score} is not below bad_score {self.bad_score}")
        if not self.reference < self.most:
            raise ValueError(f"reference {self.reference} is not below most {self.most}")


class Consistency(StrEnum):
    """Of GNSS with vision. UNKNOWN: too little was compared."""

    UNKNOWN = "unknown"
    OK = "ok"
    SUSPECT = "suspect"
    BAD = "bad"


@dataclass(frozen=True, slots=True)
class WitnessReport:
    """The state, since when, the last horizontal difference (m; None before the first) and, where heights differ by a
    constant beyond the limit, by how much GNSS is higher (m; None otherwise)."""

    state: Consistency
    since_ns: int
    apart_m: float | None
    height_apart_m: float | None


class Witness:
    """The test. Used by one thread."""

    # Before that much was compared, in seconds, there is no "ok".
    _FIRST_S = 5.0

    def __init__(self, options: WitnessOptions) -> None:
        self._options = options
        self._state = Consistency.UNKNOWN
        self._since_ns = 0
        self._score = 0.0
        self._last_ns: int | None = None
        self._compared_s = 0.0
        self._clear_s = 0.0
        self._apart_m: float | None = None
        self._last_squared: deque[float] = deque(maxlen=3)
        self._heights_m: deque[float] = deque(maxlen=_HEIGHTS)

    @property
    def trusted(self) -> bool:
        """Whether GNSS may say where to look: always but while it contradicts the camera."""
        return self._state in (Consistency.UNKNOWN, Consistency.OK)

    @property
    def report(self) -> WitnessReport:
        height = median(self._heights_m) if len(self._heights_m) == _HEIGHTS else None
        beyond = height is not None and abs(height) > self._options.height_m
        return WitnessReport(self._state, self._since_ns, self._apart_m, height if beyond else None)

    def compare(self, stamp_ns: int, gnss_minus_fix_m: FloatArray, covariance: FloatArray) -> None:
        """Take in one difference.

        Args:
            gnss_minus_fix_m: (3,) east, north, up.
            covariance: (2, 2) horizontal, of GNSS (with what it leaves out, see the module) plus the fix's. Not
                finite or not positive definite: left out.
        """
        east, north, up = (float(v) for v in gnss_minus_fix_m)
        a, b, c = float(covariance[0, 0]), float(covariance[0, 1]), float(covariance[1, 1])
        determinant = a * c - b * b
        if not (math.isfinite(east + north + up) and math.isfinite(determinant) and determinant > 0.0 and a > 0.0):
            return
        if self._last_ns is not None and stamp_ns <= self._last_ns:
            return
        self.tick(stamp_ns)
        step_s = 0.0 if self._last_ns is None else min((stamp_ns - self._last_ns) / _S, _MOST_STEP_S)
        self._last_ns = stamp_ns
        self._apart_m = math.hypot(east, north)
        self._heights_m.append(up)
        self._last_squared.append((c * east * east - 2.0 * b * east * north + a * north * north) / determinant)
        options = self._options
        gain = (min(median(self._last_squared), options.most) - options.reference) * step_s
        self._score = min(max(self._score + gain, 0.0), _CEILING * options.bad_score)
        self._compared_s += step_s
        self._clear_s = self._clear_s + step_s if self._score < options.suspect_score / 2.0 else 0.0
        self._judge(stamp_ns)

    def tick(self, now_ns: int) -> None:
        """Time goes on without a difference: what was known is forgotten after a while."""
        if self._last_ns is not None and now_ns - self._last_ns > self._options.forget_s * _S:
            self._forget(now_ns)

    def _forget(self, now_ns: int) -> None:
        self._last_ns = None
        self._score = self._compared_s = self._clear_s = 0.0
        self._apart_m = None
        self._heights_m.clear()
        self._last_squared.clear()
        self._enter(Consistency.UNKNOWN, now_ns)

    def start_anew(self, now_ns: int) -> None:
        """Forget what was concluded: somebody knows that the fixes were wrong, and not GNSS."""
        self._forget(now_ns)

    def retune(self, options: WitnessOptions) -> None:
        """Judge by other limits from now on; what was summed up stays."""
        self._options = options

    def _judge(self, now_ns: int) -> None:
        options = self._options
        if self._score >= options.bad_score:
            self._enter(Consistency.BAD, now_ns)
        elif self._score >= options.suspect_score and self._state is not Consistency.BAD:
            self._enter(Consistency.SUSPECT, now_ns)
        elif self._state in (Consistency.BAD, Consistency.SUSPECT):
            # Back only where all is quiet for long: a spoofer who pauses is not believed.
            if self._clear_s >= options.clear_s:
                self._enter(Consistency.OK, now_ns)
        elif self._compared_s >= self._FIRST_S:
            self._enter(Consistency.OK, now_ns)

    def _enter(self, state: Consistency, now_ns: int) -> None:
        if state is not self._state:
            self._state, self._since_ns = state, now_ns
