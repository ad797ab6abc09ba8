"""PX4 1.14 to 1.18: EKF2 and what its receiver makes of external positions (autopilot-contract.md, 2.4 to 2.6).

Everything is fused when the delayed horizon, EKF2_DELAY_MAX ago, reaches it. External vision is absolute only without
GNSS; beside it, its offset to the filter is estimated away. GNSS counts as used until it has been bad for 7 s.

Simplified: one instance with heading aligned; 24 states are an offset and a drift of dead reckoning per axis; what is
told is the filter's position carried to now, without the output predictor's smoothing of 0.25 s. Height and heading of
a source other than barometer and compass (EKF2_HGT_REF 1 and 3, EKF2_EV_CTRL bits 1 and 3) are weighed, not gated.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field, replace

import numpy as np

from ortholoc_edge.geometry import rotation
from ortholoc_edge.geometry.arrays import FloatArray
from ortholoc_sim.autopilot.clocks import LeastRoundTrip, Px4Timesync
from ortholoc_sim.autopilot.dialect import Message, dialect
from ortholoc_sim.autopilot.estimator import Estimator, finite
from ortholoc_sim.autopilot.frame import LocalFrame
from ortholoc_sim.autopilot.options import AutopilotOptions, Version
from ortholoc_sim.autopilot.parameters import Parameters
from ortholoc_sim.autopilot.position_filter import Innovation
from ortholoc_sim.autopilot.records import Verdict
from ortholoc_sim.autopilot.sensors import GnssSample
from ortholoc_sim.site import Geopoint

_MS, _S = 1_000_000, 1_000_000_000

# Names of EKF2: EV_MAX_INTERVAL, reset_timeout_max, no_aid_timeout_max, a source that fell silent.
_EV_INTERVAL_NS = 200 * _MS
_RESET_TIMEOUT_S, _NO_AID_S = 7.0, 1.0
_AGP_SILENT_NS = 5 * _S
# A sample is found in its buffer while the horizon has passed it by less than this.
_LATE_NS = 100 * _MS
# Samples nearer than a step of the filter are refused as too fast.
_LEAST_INTERVAL_NS = 10 * _MS
_EV_RESETS = 5
_EV_BIAS_NOISE = 0.13  # m/s per root Hz
_FLT_EPSILON = 1.1920929e-07
_EXTERNAL_SIGMA_M, _EXTERNAL_MOST_S = 50.0, 15.0
# EKF2_HGT_REF.
_HEIGHT_OF_GNSS, _HEIGHT_OF_VISION = 1, 3

# Estimator types, by MAV_ESTIMATOR_TYPE: which are taken for visual odometry. 1 (naive) is, without its covariance.
_VISUAL, _NAIVE = (0, 1, 2, 3), 1

AGP_SINCE: Version = (1, 18, 0)  # pull request 26307
EXTERNAL_POSITION_SINCE: Version = (1, 15, 0)

_LOW_QUALITY = "its quality is below EKF2_EV_QMIN"
_SOURCES = ("gnss", "vision", "agp0", "agp1", "agp2", "agp3")
_ATTITUDE, _HEIGHT, _VELOCITY_HORIZONTAL, _VELOCITY_VERTICAL = 0x01, 0x20, 0x02, 0x04
_RELATIVE, _ABSOLUTE, _CONSTANT, _PREDICTED_RELATIVE, _PREDICTED_ABSOLUTE = 0x08, 0x10, 0x80, 0x100, 0x200


@dataclass(frozen=True, slots=True, eq=False)
class _Sample:
    """A measurement on its way to the horizon; (3,) position in the frame that it came in."""

    message: str
    time_ns: int
    arrival_ns: int
    position_m: FloatArray
    variance_m2: FloatArray
    counter: int = 0
    quality: int = 0
    frame: int = dialect.MAV_FRAME_LOCAL_NED
    ned_from_body: FloatArray | None = None
    down_variance: float = 0.0
    angle_variance: float = math.inf
    yaw_variance: float = math.inf
    velocity_m_s: FloatArray | None = None
    velocity_in_body: bool = False
    velocity_sigma_m_s: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class _Measured:
    """A sample of vision against the filter: as it came, and less the bias; whether its quality will do."""

    sample: _Sample
    found: Innovation
    unbiased: Innovation
    variance_m2: FloatArray
    with_bias: FloatArray
    good: bool

    @property
    def sigma_m(self) -> float:
        return float(np.sqrt(self.variance_m2.max()))


class _Buffer:
    """EKF2's RingBuffer: the newest that the horizon has just passed; what is older is lost."""

    def __init__(self) -> None:
        self.waiting: deque[_Sample] = deque()

    def push(self, sample: _Sample) -> bool:
        """False if it does not come after the newest."""
        if self.waiting and sample.time_ns < self.waiting[-1].time_ns + _LEAST_INTERVAL_NS:
            return False
        self.waiting.append(sample)
        return True

    def pop(self, horizon_ns: int) -> tuple[_Sample | None, list[_Sample]]:
        """The one to fuse now, and those that are lost."""
        passed: list[_Sample] = []
        while self.waiting and self.waiting[0].time_ns <= horizon_ns:
            passed.append(self.waiting.popleft())
        if passed and horizon_ns < passed[-1].time_ns + _LATE_NS:
            return passed[-1], passed[:-1]
        return None, passed


class _Bias:
    """Of vision against the filter, per axis, while GNSS is used: a BiasEstimator."""

    def __init__(self) -> None:
        self.active = False
        self.reset()

    def reset(self) -> None:
        self.bias_m: FloatArray = np.zeros(2)
        self.variance_m2: FloatArray = np.full(2, 0.1)

    def predict(self, dt_s: float) -> None:
        if self.active:
            self.variance_m2 = self.variance_m2 + _EV_BIAS_NOISE**2 * dt_s

    def set(self, bias_m: FloatArray) -> None:
        self.bias_m = bias_m

    def fuse(self, measured_m: FloatArray, variance_m2: FloatArray, most_m2: FloatArray) -> None:
        if self.active:
            self.variance_m2 = np.minimum(self.variance_m2, most_m2)
            gain = self.variance_m2 / (self.variance_m2 + variance_m2)
            self.bias_m = self.bias_m + gain * (measured_m - self.bias_m)
            self.variance_m2 = (1.0 - gain) * self.variance_m2


@dataclass(slots=True, eq=False)
class _Slot:
    """One auxiliary global position."""

    buffer: _Buffer = field(default_factory=_Buffer)
    active: bool = False
    last_fused_ns: int | None = None
    last_heard_ns: int = 0


class Px4(Estimator):
    """EKF2."""

    MESSAGES = frozenset({
        "ODOMETRY", "VISION_POSITION_ESTIMATE", "GLOBAL_VISION_POSITION_ESTIMATE", "GLOBAL_POSITION_SENSOR",
        "GPS_INPUT",
    })  # fmt: skip
    COMMANDS = frozenset({dialect.MAV_CMD_EXTERNAL_POSITION_ESTIMATE})

    def __init__(self, options: AutopilotOptions, parameters: Parameters, frame: LocalFrame) -> None:
        window = options.filter.converged_after
        super().__init__(options, parameters, frame, Px4Timesync(window) if window > 0 else LeastRoundTrip())
        self._gnss_buffer, self._ev_buffer = _Buffer(), _Buffer()
        self._slots = [_Slot() for _ in range(4)]
        self._bias = _Bias()
        self._gnss_used = self._under_way
        self._gnss_fault = False
        self._gnss_good_ns: int | None = None
        self._gnss_fused_ns: int | None = None
        self._ev_used = False
        self._ev_previous: _Sample | None = None
        self._ev_fused_ns = 0
        self._ev_resets = 0
        self._ratios: dict[str, float] = {}
        self._last_step_ns: int | None = None

    # -- at the horizon --------------------

    def _aid(self, gnss: GnssSample | None, boot_ns: int) -> None:
        horizon_ns = boot_ns - round(self._parameters.active("EKF2_DELAY_MAX") * _MS)
        dt_s = 0.0 if self._last_step_ns is None else (boot_ns - self._last_step_ns) / _S
        self._last_step_ns = boot_ns
        self._bias.predict(dt_s)
        if gnss is not None:
            self._gnss_buffer.push(
                _Sample(
                    "GNSS", boot_ns, boot_ns, gnss.position_ned_m, np.full(2, gnss.sigma_m**2),
                    velocity_m_s=gnss.velocity_ned_m_s, velocity_sigma_m_s=gnss.sigma_m_s,
                )
            )  # fmt: skip
        self._control_gnss(boot_ns, horizon_ns)
        self._control_vision(boot_ns, horizon_ns)
        for n, slot in enumerate(self._slots):
            self._control_slot(n, slot, boot_ns, horizon_ns)

    def _test(self, source: str, found: Innovation, variance_m2: FloatArray, gate: float) -> bool:
        """Whether the innovation passes: each axis by itself."""
        ratios = found.difference_m**2 / (max(gate, 1.0) ** 2 * (found.variance_m2 + variance_m2))
        self._ratios[source] = float(ratios.max())
        return self._ratios[source] <= 1.0

    def _fuse(self, source: str, found: Innovation, variance_m2: FloatArray, gate: float, boot_ns: int) -> bool:
        if not self._test(source, found, variance_m2, gate):
            return False
        self.filter.correct(found, variance_m2)
        self.last_fused_ns = boot_ns
        return True

    def _reset(self, found: Innovation, variance_m2: FloatArray, boot_ns: int, source: str) -> None:
        self.filter.reset(found.difference_m, variance_m2)
        self._ratios[source] = 0.0
        self.last_fused_ns = boot_ns

    # -- GNSS --------------------

    def _control_gnss(self, boot_ns: int, horizon_ns: int) -> None:
        sample, _ = self._gnss_buffer.pop(horizon_ns)
        if sample is None:
            good = self._gnss_good_ns
            if self._gnss_used and good is not None and horizon_ns - good > _RESET_TIMEOUT_S * _S:
                self._gnss_used = False
                self._ratios.pop("gnss", None)
            return
        self._gnss_good_ns = horizon_ns
        control = int(self._parameters.active("EKF2_GPS_CTRL"))
        if not control & 1:
            self._gnss_used = False
            return
        if self._frame.origin is None:
            self._frame.origin = self._frame.geopoint(sample.position_m)
        if control & 2 and self._parameters.active("EKF2_HGT_REF") == _HEIGHT_OF_GNSS:
            age_s = (boot_ns - sample.time_ns) / _S
            self._fuse_height(float(sample.position_m[2]), 1.5 * float(np.sqrt(sample.variance_m2[0])), age_s)
        found = self.filter.innovation(sample.position_m[:2], sample.time_ns, boot_ns)
        if found is None:
            return
        variance = np.maximum(sample.variance_m2, self._parameters.active("EKF2_GPS_P_NOISE") ** 2)
        fused = self._fuse("gnss", found, variance, self._parameters.active("EKF2_GPS_P_GATE"), boot_ns)
        others = self._ev_used or any(slot.active for slot in self._slots)
        if fused:
            self._gnss_used, self._gnss_fault, self._gnss_fused_ns = True, False, boot_ns
            self._fuse_velocity(sample, "EKF2_GPS_V_NOISE", "EKF2_GPS_V_GATE", control & 4 != 0)
        elif not self._gnss_used or self._timed_out(self._gnss_fused_ns, boot_ns, _RESET_TIMEOUT_S):
            if others:
                # Another source holds the position: GNSS is not believed until it agrees.
                self._gnss_fault, self._gnss_used = self._gnss_used or self._gnss_fault, False
            elif not self._gnss_fault:
                self._reset(found, variance, boot_ns, "gnss")
                self._gnss_used, self._gnss_fused_ns = True, boot_ns

    def _fuse_velocity(self, sample: _Sample, noise: str, gate: str, wanted: bool) -> None:
        if not wanted or sample.velocity_m_s is None or self._dead_reckoned is None:
            return
        velocity = sample.velocity_m_s
        if sample.velocity_in_body:
            velocity = self.ned_from_body @ velocity
        error = (velocity - self._dead_reckoned)[:2] - self.filter.drift_m_s
        variance = max(sample.velocity_sigma_m_s, self._parameters.active(noise)) ** 2
        ratio = error**2 / (self._parameters.active(gate) ** 2 * (self.filter.drift_variance + variance))
        if float(ratio.max()) <= 1.0:
            self.filter.correct_velocity(error, variance)

    @staticmethod
    def _timed_out(last_ns: int | None, boot_ns: int, seconds: float) -> bool:
        return last_ns is None or boot_ns - last_ns > seconds * _S

    # -- external vision --------------------

    def _control_vision(self, boot_ns: int, horizon_ns: int) -> None:
        sample, lost = self._ev_buffer.pop(horizon_ns)
        for one in lost:
            late = "older than EKF2_DELAY_MAX when it arrived" if sample is None else "a newer one came with it"
            self._tell(one, Verdict.TOO_OLD, late)
        if sample is None:
            previous = self._ev_previous
            if self._ev_used and (previous is None or horizon_ns - previous.time_ns > 2 * _EV_INTERVAL_NS):
                self._ev_used = False
                self._ratios.pop("vision", None)
            return
        least = int(self._parameters.active("EKF2_EV_QMIN"))
        good = least <= 0 or sample.quality >= least
        previous = self._ev_previous
        reset = previous is None or sample.counter != previous.counter
        may_start = good and previous is not None and sample.time_ns - previous.time_ns < _EV_INTERVAL_NS
        if least > 0 and self._ev_buffer.waiting and self._ev_buffer.waiting[-1].quality < least:
            may_start = False
        control = int(self._parameters.active("EKF2_EV_CTRL"))
        self._fuse_velocity(sample, "EKF2_EVV_NOISE", "EKF2_EVV_GATE", control & 4 != 0 and good)
        if good:
            self._vision_besides(sample, control, boot_ns)
        if control & 1:
            self._vision_position(sample, good, reset, may_start, boot_ns)
        else:
            self._ev_used = False
            self._tell(sample, Verdict.DISABLED, f"EKF2_EV_CTRL is {control}, without bit 0")
        if good:
            self._ev_previous = sample

    def _vision_besides(self, sample: _Sample, control: int, boot_ns: int) -> None:
        """Height, where it is the reference, and heading."""
        age_s = (boot_ns - sample.time_ns) / _S
        if control & 2 and self._parameters.active("EKF2_HGT_REF") == _HEIGHT_OF_VISION:
            arm = self._lever_arm("EKF2_EV_POS_X", "EKF2_EV_POS_Y", "EKF2_EV_POS_Z")
            sigma = max(math.sqrt(sample.down_variance), self._parameters.active("EKF2_EVP_NOISE"))
            down = float(self._frame.inner_from_public(sample.position_m)[2] - arm[2])
            self._fuse_height(down, sigma, age_s)
        if control & 8 and sample.ned_from_body is not None:
            yaw = rotation.to_euler(sample.ned_from_body)[2]
            sigma = max(math.sqrt(sample.yaw_variance), self._parameters.active("EKF2_EVA_NOISE"))
            self._fuse_heading(yaw, sigma, age_s)

    def _vision_position(self, sample: _Sample, good: bool, reset: bool, may_start: bool, boot_ns: int) -> None:
        position, variance = self._in_ned(sample)
        was_active, self._bias.active = self._bias.active, self._gnss_used
        if self._gnss_used:
            variance = np.maximum(variance, self._parameters.active("EKF2_GPS_P_NOISE") ** 2)
        variance = np.maximum(variance, max(self._parameters.active("EKF2_EVP_NOISE"), 0.01) ** 2)
        found = self.filter.innovation(position, sample.time_ns, boot_ns)
        if found is None:
            self._tell(sample, Verdict.TOO_OLD, "before all that the filter remembers")
            return
        # Measured minus believed: that is the bias, too.
        apart = found.difference_m
        if self._bias.active and not was_active and good:
            self._bias.set(apart)
        unbiased = Innovation(apart - self._bias.bias_m, found.age_s, found.variance_m2) if self._bias.active else found
        with_bias = variance + (self._bias.variance_m2 if self._bias.active else 0.0)
        self._test("vision", unbiased, with_bias, self._parameters.active("EKF2_EVP_GATE"))
        if good:
            self._bias.fuse(apart, variance + found.variance_m2, variance)
        fix = _Measured(sample, found, unbiased, variance, with_bias, good)
        if not self._ev_used:
            self._try_start(fix, may_start, boot_ns)
        elif reset or was_active != self._bias.active:
            self._restart_vision(fix, "the reset counter changed" if reset else "GNSS is no longer used", boot_ns)
        else:
            self._go_on(fix, boot_ns)

    def _go_on(self, fix: _Measured, boot_ns: int) -> None:
        """Fuse, refuse, or act on having refused for a second."""
        gate = self._parameters.active("EKF2_EVP_GATE")
        if fix.good and self._fuse("vision", fix.unbiased, fix.with_bias, gate, boot_ns):
            self._ev_fused_ns = boot_ns
            beside = self._gnss_used
            verdict, why = (Verdict.RELATIVE, "GNSS is used beside it") if beside else (Verdict.FUSED, "")
        elif self._timed_out(self._ev_fused_ns, boot_ns, _NO_AID_S):
            verdict, why = self._vision_fails(fix, boot_ns)
        elif fix.good:
            verdict, why = Verdict.GATED, f"test ratio {self._ratios['vision']:.2f}"
        else:
            verdict, why = Verdict.FAILED_QUALITY, _LOW_QUALITY
        self._tell(fix.sample, verdict, why, fix.sigma_m, fix.unbiased.length_m)

    def _try_start(self, fix: _Measured, may_start: bool, boot_ns: int) -> None:
        if not fix.good:
            verdict, why = Verdict.FAILED_QUALITY, _LOW_QUALITY
        elif not may_start:
            verdict, why = Verdict.WAITING, "fusion starts with two less than 200 ms apart"
        else:
            self._ev_used, self._ev_resets, self._ev_fused_ns = True, _EV_RESETS, boot_ns
            if self._gnss_used:
                self._bias.set(fix.found.difference_m)
                verdict, why = Verdict.RELATIVE, "fusion starts beside GNSS"
            else:
                self._reset(fix.found, fix.variance_m2, boot_ns, "vision")
                self._bias.reset()
                verdict, why = Verdict.RESET, "fusion starts"
        self._tell(fix.sample, verdict, why, fix.sigma_m, fix.found.length_m)

    def _restart_vision(self, fix: _Measured, why: str, boot_ns: int) -> None:
        if not fix.good:
            self._ev_used = False
            verdict, why = Verdict.STOPPED, f"{why}, and {_LOW_QUALITY}"
        elif self._gnss_used:
            self._bias.set(fix.found.difference_m)
            verdict, why = Verdict.RELATIVE, f"{why}: its bias against GNSS starts anew"
        else:
            self._reset(fix.found, fix.variance_m2, boot_ns, "vision")
            verdict = Verdict.RESET
        self._ev_fused_ns = boot_ns
        self._tell(fix.sample, verdict, why, fix.sigma_m, fix.found.length_m)

    def _vision_fails(self, fix: _Measured, boot_ns: int) -> tuple[Verdict, str]:
        """Refused for a second."""
        if self._ev_resets == 0 or not fix.good:
            self._ev_used = False
            return Verdict.STOPPED, "refused for 1 s, and no reset is left"
        self._ev_resets -= 1
        self._ev_fused_ns = boot_ns
        if self._gnss_used and self._fused_within(boot_ns, _NO_AID_S):
            self._bias.set(fix.found.difference_m)
            return Verdict.RELATIVE, "refused for 1 s: its bias starts anew"
        self._reset(fix.found, fix.variance_m2, boot_ns, "vision")
        return Verdict.TIMEOUT_RESET, "refused for 1 s"

    def _in_ned(self, sample: _Sample) -> tuple[FloatArray, FloatArray]:
        """(2,) position in the filter's frame and (2,) variance. A local frame of unknown heading is turned by how
        the two attitudes differ."""
        position, variance = sample.position_m, sample.variance_m2
        arm = self._lever_arm("EKF2_EV_POS_X", "EKF2_EV_POS_Y", "EKF2_EV_POS_Z")
        if sample.frame == dialect.MAV_FRAME_LOCAL_FRD:
            attitude = np.eye(3) if sample.ned_from_body is None else sample.ned_from_body
            turn = self.ned_from_body @ attitude.T
            position = turn @ position
            variance = np.maximum(turn[:2, :2] ** 2 @ variance, sample.angle_variance)
        return (self._frame.inner_from_public(position) - arm)[:2], variance

    def _tell(
        self, sample: _Sample, verdict: Verdict, why: str = "", sigma_m: float = 0.0, innovation_m: float | None = None
    ) -> None:
        self._record(
            sample.message, sample.arrival_ns, self._frame.inner_from_public(sample.position_m), verdict, why,
            capture_ns=sample.time_ns, sigma_m=sigma_m, counter=sample.counter, innovation_m=innovation_m,
        )  # fmt: skip

    # -- auxiliary global position --------------------

    def _control_slot(self, n: int, slot: _Slot, boot_ns: int, horizon_ns: int) -> None:
        sample, lost = slot.buffer.pop(horizon_ns)
        for one in lost:
            self._tell_place(one, Verdict.TOO_OLD, "older than EKF2_DELAY_MAX, or a newer one came with it")
        if sample is None:
            if slot.active and boot_ns - slot.last_heard_ns > _AGP_SILENT_NS:
                slot.active = False
            return
        source = f"agp{n}"
        sigma = max(float(np.sqrt(sample.variance_m2[0])), self._parameters.active(f"EKF2_AGP{n}_NOISE"), 0.01)
        variance = np.full(2, sigma**2)
        found = self.filter.innovation(sample.position_m[:2], sample.time_ns, boot_ns)
        if found is None:
            return

        def begin(verdict: Verdict, why: str = "") -> None:
            slot.active, slot.last_fused_ns = True, boot_ns
            self._tell_place(sample, verdict, why, sigma, found.length_m)

        if self._frame.origin is None:
            self._frame.origin = self._frame.geopoint(np.append(sample.position_m[:2], 0.0))
            self._reset(found, variance, boot_ns, source)
            begin(Verdict.RESET, "there was no origin")
            return
        if self._fuse(source, found, variance, self._parameters.active(f"EKF2_AGP{n}_GATE"), boot_ns):
            begin(Verdict.FUSED)
            return
        if slot.active and not self._timed_out(slot.last_fused_ns, boot_ns, _RESET_TIMEOUT_S):
            self._tell_place(sample, Verdict.GATED, f"test ratio {self._ratios[source]:.2f}", sigma, found.length_m)
            return
        mode = int(self._parameters.active(f"EKF2_AGP{n}_MODE"))
        others = self._gnss_used or self._ev_used
        if not others or (mode == 1 and not self._fused_within(boot_ns, _NO_AID_S)):
            started = slot.active
            self._reset(found, variance, boot_ns, source)
            begin(Verdict.TIMEOUT_RESET if started else Verdict.RESET, "refused for 7 s" if started else "it starts")
            return
        stopped = slot.active
        slot.active = False
        why = f"test ratio {self._ratios[source]:.2f}, and another source holds the position"
        self._tell_place(sample, Verdict.STOPPED if stopped else Verdict.GATED, why, sigma, found.length_m)

    def _tell_place(
        self, sample: _Sample, verdict: Verdict, why: str = "", sigma_m: float = 0.0, innovation_m: float | None = None
    ) -> None:
        self._record(
            sample.message, sample.arrival_ns, sample.position_m, verdict, why, capture_ns=sample.time_ns,
            sigma_m=sigma_m, innovation_m=innovation_m,
        )  # fmt: skip

    # -- what it hears --------------------

    def hear(self, message: Message, boot_ns: int) -> int | None:
        kind = message.get_type()
        if kind == "ODOMETRY":
            self._odometry(message, boot_ns)
        elif kind == "VISION_POSITION_ESTIMATE":
            attitude = rotation.from_euler(message.roll, message.pitch, message.yaw)
            sample = self._sample(
                kind, message.usec, boot_ns, (message.x, message.y, message.z), message.covariance,
                message.reset_counter, 0, dialect.MAV_FRAME_LOCAL_NED, attitude,
            )  # fmt: skip
            self._push_vision(sample)
        elif kind == "GLOBAL_POSITION_SENSOR":
            self._global_position_sensor(message, boot_ns)
        elif kind in ("GPS_INPUT", "GLOBAL_VISION_POSITION_ESTIMATE"):
            self._record(kind, boot_ns, np.full(3, math.nan), Verdict.UNHEARD, "PX4 has no handler for it")
        elif kind == "COMMAND_INT":
            return self._external_position(message, boot_ns)
        else:
            return int(dialect.MAV_RESULT_COMMAND_INT_ONLY)
        return None

    def set_origin(self, origin: Geopoint, boot_ns: int) -> bool:
        self._frame.origin = origin
        return True

    def _sample(
        self, message: str, stamp_us: int, boot_ns: int, position: tuple[float, float, float], c: list[float],
        counter: int, quality: int, frame: int, attitude: FloatArray | None,
    ) -> _Sample:  # fmt: skip
        time_ns = self.timesync.correct_ns(stamp_us * 1000, boot_ns)
        time_ns -= round(self._parameters.active("EKF2_EV_DELAY") * _MS)
        at = np.array(position)
        if frame in (dialect.MAV_FRAME_LOCAL_ENU, dialect.MAV_FRAME_LOCAL_FLU):
            turned = at[[1, 0, 2]] if frame == dialect.MAV_FRAME_LOCAL_ENU else at * (1.0, -1.0, 1.0)
            at = turned * (1.0, 1.0, -1.0)
            enu = frame == dialect.MAV_FRAME_LOCAL_ENU
            frame = dialect.MAV_FRAME_LOCAL_NED if enu else dialect.MAV_FRAME_LOCAL_FRD
        # Per axis; what is not told counts as nothing, so that the floor of EKF2_EVP_NOISE is what is left.
        told = not self._parameters.active("EKF2_EV_NOISE_MD")
        variance = np.array([v if told and math.isfinite(v) else 0.0 for v in (c[0], c[6])])
        angles = [v for v in (c[15], c[18], c[20]) if told and math.isfinite(v)]
        angle = max([self._parameters.active("EKF2_EVA_NOISE") ** 2, *angles])
        down, yaw = (c[n] if told and math.isfinite(c[n]) else 0.0 for n in (11, 20))
        return _Sample(
            message, time_ns, boot_ns, at, variance, counter, quality, frame, attitude, down, angle, yaw
        )  # fmt: skip

    def _push_vision(self, sample: _Sample) -> None:
        if not np.isfinite(sample.position_m[:2]).all():
            self._tell(sample, Verdict.NOT_FINITE, "the position is not a number")
        elif not self._ev_buffer.push(sample):
            self._tell(sample, Verdict.TOO_FAST, "EV data too fast: not after the one before")

    def _odometry(self, m: Message, boot_ns: int) -> None:
        nan = math.nan

        def drop(verdict: Verdict, why: str) -> None:
            position = np.array([m.x, m.y, m.z])
            self._record("ODOMETRY", boot_ns, position, verdict, why, counter=m.reset_counter)

        frames = (
            dialect.MAV_FRAME_LOCAL_NED, dialect.MAV_FRAME_LOCAL_ENU, dialect.MAV_FRAME_LOCAL_FRD,
            dialect.MAV_FRAME_LOCAL_FLU,
        )  # fmt: skip
        if m.estimator_type not in _VISUAL:
            drop(Verdict.UNHEARD, f"estimator_type {m.estimator_type} is not taken for vision")
            return
        if m.frame_id not in frames:
            drop(Verdict.WRONG_FRAME, f"frame_id {m.frame_id} is no local frame")
            return
        covariance = [nan] * 21 if m.estimator_type == _NAIVE else m.pose_covariance
        attitude = rotation.from_quaternion(m.q) if finite(*m.q) and any(m.q) else None
        sample = self._sample(
            "ODOMETRY", m.time_usec, boot_ns, (m.x, m.y, m.z), covariance, m.reset_counter, m.quality, m.frame_id,
            attitude,
        )  # fmt: skip
        if finite(m.vx, m.vy, m.vz):
            in_body = m.child_frame_id in (
                dialect.MAV_FRAME_BODY_FRD, dialect.MAV_FRAME_BODY_NED, dialect.MAV_FRAME_BODY_OFFSET_NED
            )  # fmt: skip
            if m.vx == 0.0 and m.vy == 0.0 and m.vz == 0.0:
                self.counts["zero_velocity"] += 1
            sample = replace(sample, velocity_m_s=np.array([m.vx, m.vy, m.vz]), velocity_in_body=in_body)
        self._push_vision(sample)

    def _global_position_sensor(self, m: Message, boot_ns: int) -> None:
        position = self._place(m.lat, m.lon)

        def drop(verdict: Verdict, why: str) -> None:
            self._record("GLOBAL_POSITION_SENSOR", boot_ns, position, verdict, why)

        if self.options.firmware < AGP_SINCE:
            drop(Verdict.UNHEARD, "PX4 has a handler for it from 1.18 on")
            return
        # Neither the flags nor time_usec and processing_time are read; the stamp is that of arrival.
        if not m.eph > _FLT_EPSILON:
            drop(Verdict.NOT_FINITE, f"eph is {m.eph:g}")
            return
        slots = [n for n in range(4) if m.id != 0 and self._parameters.active(f"EKF2_AGP{n}_ID") == m.id]
        if not slots:
            drop(Verdict.DISABLED, f"no EKF2_AGPn_ID is {m.id}")
            return
        n = slots[0]
        if not int(self._parameters.active(f"EKF2_AGP{n}_CTRL")) & 1:
            drop(Verdict.DISABLED, f"EKF2_AGP{n}_CTRL lacks bit 0")
            return
        time_ns = boot_ns - round(self._parameters.active(f"EKF2_AGP{n}_DELAY") * _MS)
        self._slots[n].last_heard_ns = boot_ns
        sample = _Sample("GLOBAL_POSITION_SENSOR", time_ns, boot_ns, position, np.full(2, float(m.eph) ** 2))
        if not self._slots[n].buffer.push(sample):
            drop(Verdict.TOO_FAST, "less than 10 ms after the one before")

    def _external_position(self, m: Message, boot_ns: int) -> int:
        """MAV_CMD_EXTERNAL_POSITION_ESTIMATE."""
        name, position = "EXTERNAL_POSITION_ESTIMATE", self._place(m.x, m.y)
        if self.options.firmware < EXTERNAL_POSITION_SINCE:
            self._record(name, boot_ns, position, Verdict.UNHEARD, "PX4 has it from 1.15 on")
            return int(dialect.MAV_RESULT_UNSUPPORTED)
        if self._fused_within(boot_ns, _NO_AID_S) or not finite(m.param2):
            self._record(name, boot_ns, position, Verdict.STANDBY, "it is taken while dead reckoning only")
            return int(dialect.MAV_RESULT_TEMPORARILY_REJECTED)
        capture_ns = boot_ns - round(min(max(m.param2, 0.0), _EXTERNAL_MOST_S) * _S)
        sigma = m.param3 if finite(m.param3) and m.param3 > _FLT_EPSILON else _EXTERNAL_SIGMA_M
        found = self.filter.innovation(position[:2], capture_ns, boot_ns)
        if found is None:
            self._record(name, boot_ns, position, Verdict.TOO_OLD, capture_ns=capture_ns)
            return int(dialect.MAV_RESULT_FAILED)
        self.filter.reset(found.difference_m, max(sigma, 0.01) ** 2)
        self._record(
            name, boot_ns, position, Verdict.RESET, capture_ns=capture_ns, sigma_m=sigma, innovation_m=found.length_m
        )
        return int(dialect.MAV_RESULT_ACCEPTED)

    # -- what it says --------------------

    def vision_health(self, boot_ns: int) -> tuple[bool, bool]:
        return self._parameters.active("EKF2_EV_CTRL") != 0, self._ev_used

    def status(self, boot_ns: int) -> Message:
        aided = self._fused_within(boot_ns, _NO_AID_S)
        valid = self._fused_within(boot_ns, self._parameters.active("EKF2_NOAID_TOUT") / 1e6)
        flags = _ATTITUDE | _HEIGHT | _VELOCITY_VERTICAL
        flags |= _RELATIVE | _VELOCITY_HORIZONTAL if valid else _CONSTANT
        flags |= _ABSOLUTE if valid and self._frame.origin is not None else 0
        flags |= _PREDICTED_RELATIVE if aided else 0
        flags |= _PREDICTED_ABSOLUTE if self._gnss_used or any(slot.active for slot in self._slots) else 0
        used = [self._gnss_used, self._ev_used, *(slot.active for slot in self._slots)]
        ratios = [self._ratios.get(n, 0.0) for n, on in zip(_SOURCES, used, strict=True) if on]
        sigma = float(np.sqrt(self.filter.variance_m2.max()))
        return dialect.MAVLink_estimator_status_message(
            time_usec=boot_ns // 1000, flags=flags, vel_ratio=0.1,
            pos_horiz_ratio=math.sqrt(max(ratios, default=0.0)), pos_vert_ratio=0.1, mag_ratio=0.1,
            hagl_ratio=0.0, tas_ratio=0.0, pos_horiz_accuracy=sigma, pos_vert_accuracy=1.0,
        )  # fmt: skip
