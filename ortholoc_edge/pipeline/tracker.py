"""From frame to frame: the one place that remembers the last fix and says where to look next."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum
from typing import Annotated

import numpy as np
from msgspec import Meta, Struct

from ortholoc_edge.geometry import covariance as cov
from ortholoc_edge.geometry import frames
from ortholoc_edge.geometry.arrays import FloatArray
from ortholoc_edge.geometry.rigid import Rigid3
from ortholoc_edge.pipeline.frame import CameraMount, VehicleState
from ortholoc_edge.pipeline.outcome import Fix, Outcome, Reason, Rejected
from ortholoc_edge.pipeline.prior import PosePrior
from ortholoc_edge.pipeline.witness import Witness, WitnessOptions
from ortholoc_edge.tiles.georeference import Georeference

# What the odometry may err, horizontal 1-sigma, of a vehicle that was lost: it is by it that it was.
LOST_DRIFT_M_PER_S = 5.0
# With each fix that the odometry agrees with it is believed to err by half of that.
_DRIFT_FORGOTTEN = 0.5
# A fix farther than that from where the odometry has led says that it is worse than it should be.
_SURPRISE_SIGMAS = 4.0
# Between GNSS and the chain of fixes, over position.
_CONTRADICTION_SIGMAS = 4.0


class TrackerOptions(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How fast the prediction loses certainty between fixes.

    ``odometry_ratio``: error of the autopilot's displacement as a part of the distance flown.
    ``odometry_drift_m_per_s``: and as a function of time. Both are of the horizontal.
    ``climb_ratio``: error of the height as a part of the climb; a barometer errs so in air warmer than the standard's.
    ``climb_error_m_per_s``: and of the vertical velocity, which the autopilot's barometer corrects within
    ``climb_memory_s``: the height drifts with the root of the time, where the horizontal runs away. In a long outage
        that alone tells a surface model of another datum from a climb.
    ``unaided_speed_m_per_s``: without odometry, the speed at which the vehicle may have left.
    ``unaided_climb_m_per_s``: and at which it may have climbed.
    ``believed_sigma_m``: of the autopilot's own position, where to look when nothing else is known: after a restart in
        flight, or a long cut of the line. Horizontal and vertical 1-sigma.
    ``lost_sigma_m``: horizontal 1-sigma beyond which nothing is known worth predicting from.
    ``jump_m``: a fix this far from the prediction raises the reset counter, if it is also beyond three sigmas.
    """

    odometry_ratio: Annotated[float, Meta(ge=0, le=1)] = 0.03
    odometry_drift_m_per_s: Annotated[float, Meta(ge=0)] = 0.2
    climb_ratio: Annotated[float, Meta(ge=0, le=1)] = 0.05
    climb_error_m_per_s: Annotated[float, Meta(ge=0)] = 0.2
    climb_memory_s: Annotated[float, Meta(gt=0)] = 3.0
    unaided_speed_m_per_s: Annotated[float, Meta(gt=0)] = 15.0
    unaided_climb_m_per_s: Annotated[float, Meta(gt=0)] = 4.0
    believed_sigma_m: tuple[Annotated[float, Meta(gt=0)], Annotated[float, Meta(gt=0)]] = (25.0, 5.0)
    lost_sigma_m: Annotated[float, Meta(gt=0)] = 150.0
    jump_m: Annotated[float, Meta(gt=0)] = 5.0


class GivenPosition(Struct, frozen=True, kw_only=True, tag="set_prior"):
    """Somebody knows where the vehicle is: search there, whatever the chain of fixes says.

    Attributes:
        stamp_ns: when it was said.
        position_map_m: of the body: easting, northing, height.
        sigma_m: horizontal (per axis) and vertical.
    """

    stamp_ns: int
    position_map_m: tuple[float, float, float]
    sigma_m: tuple[float, float]


class StartAnew(Struct, frozen=True, kw_only=True, tag="relocalize"):
    """The chain of fixes is wrong: forget it.

    Attributes:
        stamp_ns: when it was said.
        trust_gnss: forget also that GNSS contradicted it.
    """

    stamp_ns: int
    trust_gnss: bool


class FoundPosition(Struct, frozen=True, kw_only=True, tag="found"):
    """A search of the map found the vehicle (`pipeline.finder`): go on from there, whatever the chain of fixes says.

    Attributes:
        stamp_ns: of the frame that was found.
        position_map_m: of the body then.
        covariance: (3, 3) of it, m².
        odometry_ned_m, odometry_epoch: as of that frame's `VehicleState`.
        why: for people.
    """

    stamp_ns: int
    position_map_m: tuple[float, float, float]
    covariance: tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]]
    odometry_ned_m: tuple[float, float, float] | None
    odometry_epoch: int
    why: str


# What somebody outside tells the tracker between two frames.
Order = GivenPosition | StartAnew | FoundPosition


class TrackerStatus(StrEnum):
    """SEARCH: no idea where. TRACK: the last frame gave a fix. COAST: carried on from an older fix."""

    SEARCH = "search"
    TRACK = "track"
    COAST = "coast"


@dataclass(frozen=True, slots=True, eq=False)
class Anchor:
    """Where the body was at the last fix (or where somebody said, or at the last trusted GNSS position), and what the
    odometry said then.

    ``drift_m_per_s``: what the odometry may err from there on, horizontal 1-sigma, where that is more than it should:
    it has carried the vehicle away before, and until fixes agree with it again it is not to be believed.

    ``firm``: GNSS that contradicts it does not take its place.

    ``settled`` is the covariance without the fix's `Fix.ground_covariance`: GNSS is judged by that. Over a wood it
    would else pass for the surer of the two, and take the place of the chain of fixes that contradicts it.
    """

    stamp_ns: int
    position_map_m: FloatArray
    covariance: FloatArray
    settled: FloatArray
    odometry_ned_m: FloatArray | None
    odometry_epoch: int
    firm: bool
    drift_m_per_s: float = 0.0


class Tracker:
    """Predicts a `PosePrior` for each frame and learns from its outcome; used by one thread.

    Attributes:
        witness: whether GNSS agrees with the fixes.
        anchor: what predictions start from; None: nothing is known.
    """

    def __init__(
        self,
        georeference: Georeference,
        body_from_camera: Rigid3 | None,
        options: TrackerOptions,
        first_reset_counter: int = 0,
        witness: WitnessOptions | None = None,
    ) -> None:
        """
        Args:
            body_from_camera: of a fixed mount; None: a gimbal, whose attitude comes with each state.
            first_reset_counter: another one in every life of the program: an autopilot that has seen a value takes
                it again as "no reset".
            witness: of the test of GNSS against the fixes; None: as by default.
        """
        self.witness = Witness(witness or WitnessOptions())
        self._georeference = georeference
        self._fixed_mount = None if body_from_camera is None else CameraMount(body_from_camera)
        self._options = options
        self.anchor: Anchor | None = None
        self._given: GivenPosition | None = None
        self._last_prior: PosePrior | None = None
        # Whether the prediction was not from the anchor.
        self._predicted_elsewhere = False
        self._gnss_turn = False
        self.status = TrackerStatus.SEARCH
        self.reset_counter = first_reset_counter % 256

    def take(self, order: Order) -> None:
        """Act on it with the next `predict`; the fix after it is a new start for the autopilot."""
        self.status = TrackerStatus.SEARCH
        self.anchor = self._given = None
        if isinstance(order, FoundPosition):
            covariance, odometry = np.array(order.covariance), order.odometry_ned_m
            self.anchor = Anchor(
                order.stamp_ns, np.array(order.position_map_m), covariance, covariance,
                None if odometry is None else np.array(odometry), order.odometry_epoch, firm=True,
                drift_m_per_s=LOST_DRIFT_M_PER_S,
            )  # fmt: skip
        elif isinstance(order, GivenPosition):
            self._given = order
        elif order.trust_gnss:
            self.witness.start_anew(order.stamp_ns)

    def retune(self, options: TrackerOptions, witness: WitnessOptions) -> None:
        """Go on with other options."""
        self._options = options
        self.witness.retune(witness)

    def predict(self, state: VehicleState) -> PosePrior | Rejected:
        """The pose to expect at the state's stamp, or why there is none."""
        self._last_prior, self._predicted_elsewhere = None, False
        attitude = state.ned_from_body
        if attitude is None or not np.isfinite(attitude).all() or not np.isfinite(state.attitude_sigma_rad).all():
            why = f": {state.no_attitude_because}" if state.no_attitude_because else ""
            return Rejected(
                state.stamp_ns, Reason.BAD_ATTITUDE, f"no finite attitude from the autopilot at the exposure{why}"
            )
        self.witness.tick(state.stamp_ns)
        self._take_given(state)
        self._take_absolute(state)
        mount = self.mount(state)
        if mount is None:
            return Rejected(
                state.stamp_ns,
                Reason.GIMBAL_UNKNOWN,
                "no attitude of the gimbal near the exposure; is it on, and does [mount] name the right one?",
            )
        known, lost_m = self._carried(state), self._options.lost_sigma_m
        if known is None or cov.horizontal_sigma(known[1]) > lost_m or self._contested(known, state):
            believed = self._believed(state)
            if believed is not None:
                # The chain of fixes is broken: the next one is a new start, and the autopilot must hear of it as one.
                known, self.status = believed, TrackerStatus.SEARCH
                self._predicted_elsewhere = True
        if known is None:
            return Rejected(state.stamp_ns, Reason.NO_PRIOR, "no fix yet and no position from the autopilot")
        position, position_covariance = known
        if cov.horizontal_sigma(position_covariance) > lost_m:
            return Rejected(
                state.stamp_ns,
                Reason.NO_PRIOR,
                "the last known position is too old to predict from; horizontal 1-sigma, m",
                cov.horizontal_sigma(position_covariance),
                lost_m,
            )
        map_from_ned = frames.map_from_ned_rotation(self._georeference.convergence_rad(position[:2]))
        body = Rigid3(map_from_ned @ attitude, position)
        covariance = np.zeros((6, 6))
        covariance[:3, :3] = position_covariance
        # The camera's: the gimbal's own error comes on top of the autopilot's.
        covariance[3:, 3:] = cov.attitude(body.rotation, state.attitude_sigma_rad) + cov.turn(mount.sigma_rad)
        lever = body.rotation @ mount.body_from_camera.translation
        self._last_prior = PosePrior(body @ mount.body_from_camera, cov.of_moved_point(covariance, lever))
        return self._last_prior

    def mount(self, state: VehicleState) -> CameraMount | None:
        """How the camera sat on the body at the state's stamp; None if that is not known."""
        return self._fixed_mount or state.mount

    def update(self, outcome: Outcome, state: VehicleState) -> None:
        """Learn from what the frame of the last `predict` came to."""
        if isinstance(outcome, Rejected):
            if outcome.reason is Reason.NO_PRIOR:
                # Lost: what comes next is a new start, and the autopilot must hear of it as one.
                self.status = TrackerStatus.SEARCH
            elif self.status is not TrackerStatus.SEARCH:
                self.status = TrackerStatus.COAST
            return
        if self.status is TrackerStatus.SEARCH or self._jumped(outcome):
            self.reset_counter = (self.reset_counter + 1) % 256
        mount = self.mount(state)
        assert mount is not None, "predict() refuses a state without"
        body = outcome.map_from_camera @ mount.body_from_camera.inverse()
        lever = body.translation - outcome.map_from_camera.translation
        ground = outcome.ground_covariance
        covariance = cov.of_moved_point(outcome.covariance, lever)
        settled = covariance if ground is None else cov.of_moved_point(outcome.covariance - ground, lever)
        drift_m_per_s = self._drift_seen(state, body.translation, covariance[:3, :3])
        self.anchor = anchor_at(
            state, body.translation, covariance[:3, :3], settled[:3, :3], firm=True, drift_m_per_s=drift_m_per_s
        )
        if state.position_map_m is not None:
            both = settled[:2, :2] + np.eye(2) * state.position_sigma_m[0] ** 2
            self.witness.compare(state.stamp_ns, state.position_map_m - body.translation, both)
        self.status = TrackerStatus.TRACK

    def _drift_seen(self, state: VehicleState, position: FloatArray, covariance: FloatArray) -> float:
        """What the odometry may err after a fix, see `Anchor`, by what it did before it."""
        anchor, least = self.anchor, self._options.odometry_drift_m_per_s
        # Of GNSS, or where the autopilot believed to be, the fix says more than of the odometry since.
        if anchor is None or not anchor.firm or self._predicted_elsewhere:
            return 0.0
        there, spread = carried(anchor, state, self._options, self._georeference)
        step = (position - there)[:2]
        surprising = cov.mahalanobis_squared(step, (spread + covariance)[:2, :2]) > _SURPRISE_SIGMAS**2
        if not surprising and anchor.drift_m_per_s <= least:
            return 0.0
        seen = float(np.linalg.norm(step)) / max(abs(state.stamp_ns - anchor.stamp_ns) * 1e-9, 1e-3)
        drift = max(_DRIFT_FORGOTTEN * anchor.drift_m_per_s, min(seen, 2.0 * LOST_DRIFT_M_PER_S))
        return drift if drift > least else 0.0

    def _jumped(self, fix: Fix) -> bool:
        if self._last_prior is None:
            return True
        step = fix.map_from_camera.translation - self._last_prior.map_from_camera.translation
        spread = (self._last_prior.covariance + fix.covariance)[:3, :3]
        return float(np.linalg.norm(step)) > self._options.jump_m and cov.mahalanobis_squared(step, spread) > 9.0

    def _carried(self, state: VehicleState) -> tuple[FloatArray, FloatArray] | None:
        """The last fix moved by the odometry since: position and its covariance."""
        return None if self.anchor is None else carried(self.anchor, state, self._options, self._georeference)

    def _believed(self, state: VehicleState) -> tuple[FloatArray, FloatArray] | None:
        """Where the autopilot believes to be. Not while GNSS contradicts the fixes: it may have followed a spoofer.

        It is no anchor: the next frame asks again.
        """
        believed = state.believed_map_m
        if believed is None or not np.isfinite(believed).all() or not self.witness.trusted:
            return None
        return believed, _axes(*self._options.believed_sigma_m)

    def _contested(self, known: tuple[FloatArray, FloatArray], state: VehicleState) -> bool:
        """Whether it is the turn of the autopilot's own position against a GNSS that it contradicts.

        Before the first fix nothing tells which is right: the autopilot may have flown by our fixes of an earlier life
        while GNSS is spoofed. They take turns; the first fix decides.
        """
        believed = self._believed(state)
        if believed is None or self.anchor is None or self.anchor.firm:
            return False
        apart = cov.mahalanobis_squared((believed[0] - known[0])[:2], (believed[1] + known[1])[:2, :2])
        if apart <= _CONTRADICTION_SIGMAS**2:
            return False
        self._gnss_turn = not self._gnss_turn
        return not self._gnss_turn

    def announce_jump(self) -> None:
        """The next estimate starts anew for the autopilot: its origin moved, or it restarted."""
        self.reset_counter = (self.reset_counter + 1) % 256

    def _take_given(self, state: VehicleState) -> None:
        """Anchor at the position that was given. Since then the vehicle flew on, nobody knows where to."""
        given, self._given = self._given, None
        if given is None:
            return
        elapsed_s = max(state.stamp_ns - given.stamp_ns, 0) * 1e-9
        flown = _axes(self._options.unaided_speed_m_per_s * elapsed_s, self._options.unaided_climb_m_per_s * elapsed_s)
        covariance = _axes(*given.sigma_m) + flown
        self.anchor = anchor_at(state, np.array(given.position_map_m), covariance, covariance, firm=True)

    def _take_absolute(self, state: VehicleState) -> None:
        """Anchor at a trusted position of the autopilot's own (GNSS), if it is worth more than what we have.

        It is kept as an anchor, so that there is something to carry on when GNSS ends before the first fix. One
        that contradicts the chain of fixes is left alone: a spoofed receiver must not switch the camera off. The
        chain's own uncertainty grows until the two agree, if it was the chain that was wrong. Nor is any taken while
        the witness says that GNSS contradicts the fixes: that lasts when the chain has ended.
        """
        position, sigma_m = state.position_map_m, state.position_sigma_m
        if not self.witness.trusted:
            return
        # A NaN sigma would pass for the most certain position of all.
        if position is None or not (np.isfinite(position).all() and np.isfinite(sigma_m).all()):
            return
        covariance = _axes(*sigma_m)
        known = self._carried(state)
        if known is not None and self.anchor is not None:
            settled = known[1] - self.anchor.covariance + self.anchor.settled
            if cov.horizontal_sigma(settled) <= cov.horizontal_sigma(covariance):
                return
            apart = cov.mahalanobis_squared(position - known[0], covariance + settled)
            if self.anchor.firm and apart > _CONTRADICTION_SIGMAS**2:
                return
        self.anchor = anchor_at(state, position, covariance, covariance, firm=False)


def carried(
    anchor: Anchor, state: VehicleState, options: TrackerOptions, georeference: Georeference
) -> tuple[FloatArray, FloatArray]:
    """An anchor moved by the odometry up to a state, which may be an earlier one.

    Returns: position (3,) in the map and its covariance (3, 3).
    """
    elapsed_s = abs(state.stamp_ns - anchor.stamp_ns) * 1e-9
    step = moved_map_m(anchor, state, georeference)
    if step is None:
        horizontal_m = options.unaided_speed_m_per_s * elapsed_s
        vertical_m = options.unaided_climb_m_per_s * elapsed_s
        return anchor.position_map_m, anchor.covariance + _axes(horizontal_m, vertical_m)
    # A constant drift grows with time; a scale or heading error grows with the distance.
    drift = max(options.odometry_drift_m_per_s, anchor.drift_m_per_s)
    horizontal_m = math.hypot(options.odometry_ratio * float(np.linalg.norm(step)), drift * elapsed_s)
    vertical_m = math.hypot(
        options.climb_ratio * float(step[2]),
        options.climb_error_m_per_s * _wandered_s(elapsed_s, options.climb_memory_s),
    )
    return anchor.position_map_m + step, anchor.covariance + _axes(horizontal_m, vertical_m)


def moved_map_m(anchor: Anchor, state: VehicleState, georeference: Georeference) -> FloatArray | None:
    """(3,) how the body has moved in the map since an anchor; None where there is no odometry from there to here."""
    odometry = state.odometry_ned_m
    if odometry is None or anchor.odometry_ned_m is None or state.odometry_epoch != anchor.odometry_epoch:
        return None
    if not np.isfinite(odometry).all():
        return None
    xy = anchor.position_map_m[:2]
    step = frames.map_from_ned_rotation(georeference.convergence_rad(xy)) @ (odometry - anchor.odometry_ned_m)
    step[:2] *= georeference.grid_scale(xy, float(anchor.position_map_m[2]))
    return np.asarray(step)


def anchor_at(
    state: VehicleState,
    position: FloatArray,
    covariance: FloatArray,
    settled: FloatArray,
    firm: bool,
    drift_m_per_s: float = 0.0,
) -> Anchor:
    """A place (3,) at a state's stamp, with what its odometry said then; arguments as of `Anchor`."""
    odometry = state.odometry_ned_m
    usable = odometry is not None and bool(np.isfinite(odometry).all())
    return Anchor(
        state.stamp_ns, position, covariance, settled, odometry if usable else None, state.odometry_epoch, firm,
        drift_m_per_s,
    )  # fmt: skip


def _wandered_s(elapsed_s: float, memory_s: float) -> float:
    """1-sigma of the integral, over ``elapsed_s``, of an error of unit size that is forgotten after ``memory_s``.

    The variance of an integrated first-order Gauss-Markov process: the time itself at first, its root in the end.
    """
    forgotten = -memory_s * math.expm1(-elapsed_s / memory_s)
    return math.sqrt(2.0 * memory_s * max(elapsed_s - forgotten, 0.0))


def _axes(horizontal_m: float, vertical_m: float) -> FloatArray:
    """(3, 3) of 1-sigmas."""
    return np.diag(np.square([horizontal_m, horizontal_m, vertical_m]))
