"""Feeds recorded frames through the pipeline that flies, beside a simulated autopilot.

The recorded photos are seconds and tens of metres apart, so what an autopilot would know between them is made
from the truth with the errors it would have, drawn from a seeded generator.
"""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
import numpy.typing as npt

from ortholoc_edge.bench import sequence
from ortholoc_edge.bench.metrics import PoseError, pose_error
from ortholoc_edge.bench.samples import Sample
from ortholoc_edge.errors import CameraError, ConfigError
from ortholoc_edge.geometry import covariance as cov
from ortholoc_edge.geometry import frames, rotation
from ortholoc_edge.geometry.arrays import FloatArray, ImageArray
from ortholoc_edge.geometry.camera import Camera
from ortholoc_edge.geometry.rigid import Rigid3
from ortholoc_edge.pipeline.frame import Frame, VehicleState
from ortholoc_edge.pipeline.localizer import Localizer
from ortholoc_edge.pipeline.navigator import Navigator
from ortholoc_edge.pipeline.outcome import Fix, Outcome, Reason, Rejected
from ortholoc_edge.pipeline.prior import PosePrior, RegionPrior, footprint
from ortholoc_edge.pipeline.tracker import Tracker, TrackerOptions
from ortholoc_edge.tiles.georeference import Georeference
from ortholoc_edge.tiles.lattice import Bounds

# Paper, appendix "Data Pairing": each side of the region is moved by up to 20 m.
_REGION_MARGIN_M = 20.0
_REGION_MARGIN_PART = 0.3


class PriorKind(StrEnum):
    """Where the prediction comes from.

    ODOMETER: the last fix, carried on by dead reckoning. GPS: a noisy absolute position for every frame.
    TRUTH_NOISE: truth with noise for every frame, past the tracker. NONE: the paper's setting, only a region
    around the true footprint, no position, no height, no attitude.
    """

    ODOMETER = "odometer"
    GPS = "gps"
    TRUTH_NOISE = "truth-noise"
    NONE = "none"


@dataclass(frozen=True, slots=True)
class Length:
    """A 1-sigma in metres, or as a part of the height above ground."""

    metres: float = 0.0
    of_height: float = 0.0

    @staticmethod
    def parse(text: str) -> Length:
        """``5``, ``5m`` or ``4%``. Raises: ConfigError."""
        match = re.fullmatch(r"\s*(\d+(?:\.\d*)?|\.\d+)\s*(m|%)?\s*", text)
        if match is None:
            raise ConfigError(f"{text!r} is no length; write metres (5, 5m) or a part of the height (4%)")
        value = float(match[1])
        return Length(of_height=value / 100.0) if match[2] == "%" else Length(metres=value)

    def at(self, height_m: float) -> float:
        return self.metres + self.of_height * height_m

    def __str__(self) -> str:
        return f"{self.of_height * 100:g}%" if self.of_height else f"{self.metres:g}m"


@dataclass(frozen=True, slots=True)
class PriorNoise:
    """1-sigmas of what the simulated autopilot knows.

    Attributes:
        attitude_deg: roll, pitch, yaw.
        position: horizontal per axis and vertical; of the first frame and, for GPS and truth-noise, of all.
        odometry_ratio: error of a displacement: of either horizontal axis as a part of its length, of the vertical as
            a part of the climb, since autopilots hold height by a barometer.
        odometry_drift_m_per_s: per axis, drawn anew for every leg.
    """

    attitude_deg: tuple[float, float, float] = (1.0, 1.0, 3.0)
    position: tuple[Length, Length] = (Length(metres=2.0), Length(metres=2.0))
    odometry_ratio: float = 0.02
    odometry_drift_m_per_s: float = 0.05


@dataclass(frozen=True, slots=True, eq=False)
class FrameResult:
    """One frame of a replay.

    Attributes:
        error: None without a fix.
        prior: where it was predicted; None if nowhere.
        cpu_ms: of this process, all threads.
        wall_ms: for the same work.
    """

    name: str
    stamp_ns: int
    image: ImageArray | None
    camera: Camera
    truth: Rigid3
    prior: PosePrior | None
    outcome: Outcome
    error: PoseError | None
    cpu_ms: float
    wall_ms: float


class Timer:
    """CPU time of this process, all threads, and wall time since it was made."""

    def __init__(self) -> None:
        self._cpu_s, self._wall_s = time.process_time(), time.perf_counter()

    def spent_ms(self) -> tuple[float, float]:
        """CPU and wall, ms."""
        return (time.process_time() - self._cpu_s) * 1e3, (time.perf_counter() - self._wall_s) * 1e3


class SimulatedAutopilot:
    """Attitude, odometry and position as an autopilot would report them, from the truth and a seed."""

    def __init__(self, kind: PriorKind, noise: PriorNoise, seed: int) -> None:
        self._kind = kind
        self._noise = noise
        self._random = np.random.default_rng(seed)
        self._before: tuple[int, FloatArray] | None = None
        self._odometry_ned_m = np.zeros(3)

    def state(
        self,
        stamp_ns: int,
        map_from_camera: Rigid3,
        ned_from_body: FloatArray,
        height_m: float,
        convergence_rad: float,
        grid_scale: float,
    ) -> VehicleState:
        """What is known at a frame. The body is where the camera is (`sequence.nadir_body`)."""
        sigma_rad = np.radians(self._noise.attitude_deg)
        roll, pitch, yaw = self._random.normal(size=3) * sigma_rad
        attitude = _perturbed(ned_from_body, roll, pitch, yaw)
        position = map_from_camera.translation
        first = self._before is None
        self._advance(stamp_ns, position, convergence_rad, grid_scale)
        sigmas_m = [length.at(height_m) for length in self._noise.position]
        noise = self._random.normal(size=3) * (sigmas_m[0], sigmas_m[0], sigmas_m[1])
        has_position = self._kind is PriorKind.GPS or first
        return VehicleState(
            stamp_ns,
            attitude,
            (float(sigma_rad[0]), float(sigma_rad[1]), float(sigma_rad[2])),
            None if self._kind is PriorKind.GPS else self._odometry_ned_m.copy(),
            0,
            position + noise if has_position else None,
            (sigmas_m[0], sigmas_m[1]),
        )

    def _advance(self, stamp_ns: int, position: FloatArray, convergence_rad: float, grid_scale: float) -> None:
        if self._before is not None:
            before_ns, before = self._before
            step = position - before
            step[:2] /= grid_scale
            step_ned = frames.map_from_ned_rotation(convergence_rad).T @ step
            length_m = float(np.linalg.norm(step_ned))
            ratio = self._noise.odometry_ratio * np.array([length_m, length_m, abs(step_ned[2])])
            drift = self._noise.odometry_drift_m_per_s * (stamp_ns - before_ns) * 1e-9
            error = self._random.normal(size=3) * ratio + self._random.normal(size=3) * drift
            self._odometry_ned_m = self._odometry_ned_m + step_ned + error
        self._before = stamp_ns, position.copy()


def replay_flight(
    recorded: Iterable[sequence.RecordedFrame],
    localizer_for: Callable[[Camera], Localizer],
    georeference: Georeference,
    ground_m: Callable[[FloatArray], float],
    *,
    kind: PriorKind,
    noise: PriorNoise,
    seed: int,
) -> Iterable[FrameResult]:
    """Localize a flight frame by frame.

    Args:
        localizer_for: a localizer for a frame's intrinsics.
        ground_m: typical height of the surface around a map position (2,).
    """
    autopilot = SimulatedAutopilot(kind, noise, seed)
    tracker = Tracker(georeference, sequence.nadir_body(), _tracker_options(noise))
    random = np.random.default_rng([seed, 1])
    for record in recorded:
        truth = record.map_from_camera
        height_m = float(truth.translation[2]) - ground_m(truth.translation[:2])
        xy = truth.translation[:2]
        state = autopilot.state(
            record.stamp_ns,
            truth,
            record.ned_from_body,
            height_m,
            georeference.convergence_rad(xy),
            georeference.grid_scale(xy, float(truth.translation[2])),
        )
        timer = Timer()
        prior: PosePrior | None = None
        image: ImageArray | None = None
        outcome: Outcome
        try:
            image = record.image()
        except CameraError as error:
            outcome = Rejected(record.stamp_ns, Reason.BAD_FRAME, str(error))
            tracker.update(outcome, state)
        else:
            frame = Frame(record.stamp_ns, image, record.name)
            localizer = localizer_for(record.camera)
            if kind is PriorKind.NONE:
                region = paper_region(record.camera, truth, truth.translation[2] - height_m, random)
                outcome = localizer.localize(frame, RegionPrior(region))
            elif kind is PriorKind.TRUTH_NOISE:
                prior = noisy_prior(truth, height_m, noise, random)
                outcome = localizer.localize(frame, prior)
            else:
                navigator = Navigator(localizer, tracker)
                outcome = navigator.step(frame, state)
                prior = navigator.prior
        spent_ms = timer.spent_ms()
        yield FrameResult(
            record.name, record.stamp_ns, image, record.camera, truth, prior, outcome, outcome_error(outcome, truth),
            *spent_ms,
        )  # fmt: skip


# Between two photos of a survey.
_LONGEST_LEG_S = 60.0


def _tracker_options(noise: PriorNoise) -> TrackerOptions:
    """The tracker is told what odometry it has, as an integrator would, with some reserve."""
    reserve = 1.25
    return TrackerOptions(
        odometry_ratio=min(reserve * noise.odometry_ratio, 1.0),
        climb_ratio=min(reserve * noise.odometry_ratio, 1.0),
        odometry_drift_m_per_s=reserve * noise.odometry_drift_m_per_s,
        climb_error_m_per_s=reserve * noise.odometry_drift_m_per_s,
        # Drawn anew for every leg, it lasts for as long as any leg.
        climb_memory_s=_LONGEST_LEG_S,
    )


def replay_sample(
    sample: Sample,
    localizer: Localizer,
    *,
    kind: PriorKind,
    noise: PriorNoise,
    height_m: float,
    bounds: Bounds,
    seed: int,
) -> FrameResult:
    """Localize one OrthoLoC sample; it has no past, so every prior but NONE is truth with noise."""
    frame = Frame(0, sample.image, sample.name)
    truth = sample.map_from_camera
    prior = None if kind is PriorKind.NONE else noisy_prior(truth, height_m, noise, np.random.default_rng(seed))
    timer = Timer()
    outcome = localizer.localize(frame, RegionPrior(bounds) if prior is None else prior)
    spent_ms = timer.spent_ms()
    return FrameResult(
        sample.name, 0, sample.image, sample.camera, truth, prior, outcome, outcome_error(outcome, truth), *spent_ms
    )


def noisy_prior(truth: Rigid3, height_m: float, noise: PriorNoise, random: np.random.Generator) -> PosePrior:
    """The truth with the noise's position and attitude errors, and the covariance that belongs to them."""
    return prior_with_errors(truth, height_m, noise, random.normal(size=6))


def prior_with_errors(truth: Rigid3, height_m: float, noise: PriorNoise, errors: npt.ArrayLike) -> PosePrior:
    """`noisy_prior` with the errors that were drawn: (6,) in standard deviations, of roll, pitch, yaw, east, north and
    up."""
    drawn = np.asarray(errors, dtype=np.float64)
    sigmas_m = [length.at(height_m) for length in noise.position]
    sigma_rad = np.radians(noise.attitude_deg)
    map_from_body = truth.rotation @ frames.BODY_FROM_NADIR_CAMERA.T
    # Level axes need a frame whose third axis is vertical; ENU and NED differ by a turn that cancels.
    ned_from_body = frames.ENU_FROM_NED @ map_from_body
    roll, pitch, yaw = drawn[:3] * sigma_rad
    turned = frames.ENU_FROM_NED @ _perturbed(ned_from_body, roll, pitch, yaw)
    position = truth.translation + drawn[3:] * (sigmas_m[0], sigmas_m[0], sigmas_m[1])
    covariance = np.zeros((6, 6))
    covariance[:3, :3] = np.diag(np.square([sigmas_m[0], sigmas_m[0], sigmas_m[1]]))
    covariance[3:, 3:] = cov.attitude(turned, (sigma_rad[0], sigma_rad[1], sigma_rad[2]))
    return PosePrior(Rigid3(turned @ frames.BODY_FROM_NADIR_CAMERA, position), covariance)


def paper_region(camera: Camera, truth: Rigid3, ground_m: float, random: np.random.Generator) -> Bounds:
    """The true footprint with every side moved out by up to 20 m, or 30 % of the footprint if that is less."""
    outline = footprint(camera, truth, min(ground_m, float(truth.translation[2]) - 1.0))
    (west, south), (east, north) = outline.min(axis=0), outline.max(axis=0)
    limit_x = min(_REGION_MARGIN_M, _REGION_MARGIN_PART * (east - west))
    limit_y = min(_REGION_MARGIN_M, _REGION_MARGIN_PART * (north - south))
    moves = random.uniform(size=4) * (limit_x, limit_y, limit_x, limit_y)
    return float(west - moves[0]), float(south - moves[1]), float(east + moves[2]), float(north + moves[3])


def _perturbed(ned_from_body: FloatArray, roll: float, pitch: float, yaw: float) -> FloatArray:
    """Errors about the level axes below forward and right, and about down; as `covariance.attitude` has them."""
    forward = np.array([ned_from_body[0, 0], ned_from_body[1, 0], 0.0])
    norm = float(np.linalg.norm(forward))
    forward = forward / norm if norm > 1e-6 else np.array([1.0, 0.0, 0.0])
    down = np.array([0.0, 0.0, 1.0])
    axis = roll * forward + pitch * np.cross(down, forward) + yaw * down
    return np.asarray(rotation.exp(axis) @ ned_from_body, dtype=np.float64)


def outcome_error(outcome: Outcome, truth: Rigid3) -> PoseError | None:
    """None without a fix."""
    return pose_error(outcome, truth) if isinstance(outcome, Fix) else None
