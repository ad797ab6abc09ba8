"""What `flight.solve` takes, from flight logs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

import numpy as np

from ortholoc_edge.bench.flight_log import log_files, read_frames, read_header
from ortholoc_edge.calibration.flight import TURN_STEP_S, Sighting, focal_response_m
from ortholoc_edge.config import Config, config_from_text
from ortholoc_edge.errors import ConfigError, DatasetError
from ortholoc_edge.geometry import frames, rotation
from ortholoc_edge.geometry.arrays import FloatArray
from ortholoc_edge.geometry.rigid import Rigid3
from ortholoc_edge.pipeline.record import FrameRecord
from ortholoc_edge.tiles.pack import Pack
from ortholoc_edge.tiles.store import MapStore

# Only where the typical height of the ground is asked for.
_GROUND_GSD_M = 4.0
# Logs of older versions have neither speed nor turns: from the frames around, if they are so near. That is a mean over
# two frames, and where a vehicle turns now faster, now slower, latency comes out too short by it.
_MOST_GAP_NS = 600_000_000
LEAST_FIXES = 40
# What must be the same in all logs: what is looked for is against it.
_SAME = ("intrinsics", "mount", "camera")


@dataclass(frozen=True, slots=True, eq=False)
class Flown:
    """Flights with one camera and one set of settings.

    Attributes:
        config: of them. flights: their sightings.
        frames: how many there were; without_attitude, without_speed, without_ground: fixes that could not take part.
    """

    config: Config
    flights: tuple[tuple[Sighting, ...], ...]
    frames: int
    without_attitude: int
    without_speed: int
    without_ground: int

    @property
    def sightings(self) -> list[Sighting]:
        return list(chain.from_iterable(self.flights))


def read_flights(sources: Sequence[Path], pack: Path | None = None) -> Flown:
    """The sightings of some flight logs, or folders of them.

    Args:
        pack: the one flown with, where it is no longer where it was.
    Raises: DatasetError for what is no flight log, or has too few fixes; ConfigError for settings that differ, or a
        gimbal; MapError.
    """
    configs: list[Config] = []
    flights: list[tuple[Sighting, ...]] = []
    counts = {"frames": 0, "without_attitude": 0, "without_speed": 0, "without_ground": 0}
    for source in sources:
        files = log_files(source)
        if not files:
            raise DatasetError(f"{source}: no flight log (.mcap), nor a folder with some; see [log] folder")
        header = read_header(files[0])
        try:
            config = config_from_text(header.config)
        except ValueError as err:
            raise DatasetError(
                f"{files[0]}: its configuration, of version {header.version}, is not understood ({err}); calibrate "
                "with the version that wrote it"
            ) from err
        if config.mount.gimbal_selection() is not None:
            raise ConfigError(
                f"{files[0]}: flown with a gimbal, whose own errors stand between camera and body; calibrate it with "
                'the gimbal locked, as [mount] gimbal = "none"'
            )
        configs.append(config)
        _require_same(configs, sources)
        with MapStore(Pack.open(Path(header.pack) if pack is None else pack)) as store:
            if store.pack.manifest_sha256 != header.pack_sha256:
                raise DatasetError(f"{store.pack.path}: not the pack that was flown with; name that one with --pack")
            records = [one.record for one in chain.from_iterable(map(read_frames, files))]
            flights.append(_sightings(records, config, store, counts))
    flown = Flown(configs[0], tuple(flights), **counts)
    if len(flown.sightings) < LEAST_FIXES:
        raise DatasetError(
            f"{sources[0]}: {len(flown.sightings)} fixes with attitude and speed of {flown.frames} frames, "
            f"{LEAST_FIXES} are the least; fly two minutes over the pack's area with GNSS"
        )
    return flown


def _require_same(configs: Sequence[Config], sources: Sequence[Path]) -> None:
    first, last = configs[0], configs[-1]
    pairs = zip(
        _SAME, (first.intrinsics.camera(), first.mount, first.camera.lateness),
        (last.intrinsics.camera(), last.mount, last.camera.lateness), strict=True,
    )  # fmt: skip
    for name, one, other in pairs:
        if one != other:
            raise ConfigError(
                f"{sources[0]} and {sources[len(configs) - 1]} were flown with different [{name}]; give logs of one "
                "setting at a time"
            )


def _sightings(
    records: Sequence[FrameRecord], config: Config, store: MapStore, counts: dict[str, int]
) -> tuple[Sighting, ...]:
    camera = config.intrinsics.camera()
    found = []
    counts["frames"] += len(records)
    for number, record in enumerate(records):
        outcome = record.outcome
        if not outcome["fix"]:
            continue
        state = record.state()
        if state.ned_from_body is None or not np.isfinite(state.ned_from_body).all():
            counts["without_attitude"] += 1
            continue
        motion = _motion(records, number)
        if motion is None:
            counts["without_speed"] += 1
            continue
        turn = rotation.from_quaternion(outcome["quaternion_map_from_camera_wxyz"])
        pose = Rigid3(turn, np.array(outcome["position_map_m"]))
        xy = pose.translation[:2]
        response_m = focal_response_m(pose, camera, lambda points: store.heights(points, _GROUND_GSD_M))
        if response_m is None:
            counts["without_ground"] += 1
            continue
        map_from_ned = frames.map_from_ned_rotation(store.pack.georeference.convergence_rad(xy))
        gnss = state.position_map_m
        found.append(
            Sighting(
                record.stamp_ns, pose, np.array(outcome["covariance"]), map_from_ned @ state.ned_from_body, motion[1],
                gnss if gnss is not None and np.isfinite(gnss).all() else None, map_from_ned @ motion[0], response_m,
            )
        )  # fmt: skip
    return tuple(found)


def _motion(records: Sequence[FrameRecord], number: int) -> tuple[FloatArray, FloatArray] | None:
    """Velocity, NED, and `Sighting.turns` of a frame: as logged, or from the frames around it."""
    state = records[number].state()
    velocity, before_it = state.velocity_ned_m_s, state.turns_before
    if velocity is not None and before_it is not None and np.isfinite(velocity).all():
        return velocity, before_it
    if not 0 < number < len(records) - 1:
        return None
    before, after = records[number - 1].state(), records[number + 1].state()
    seconds = (after.stamp_ns - before.stamp_ns) * 1e-9
    if not 0.0 < seconds * 1e9 <= 2 * _MOST_GAP_NS or before.odometry_epoch != after.odometry_epoch:
        return None
    turns, ways = (before.ned_from_body, after.ned_from_body), (before.odometry_ned_m, after.odometry_ned_m)
    if turns[0] is None or turns[1] is None or ways[0] is None or ways[1] is None:
        return None
    velocity, turn = (ways[1] - ways[0]) / seconds, -rotation.log(turns[0].T @ turns[1]) / seconds * TURN_STEP_S
    return (velocity, turn[None]) if np.isfinite(velocity).all() and np.isfinite(turn).all() else None


@dataclass(frozen=True, slots=True)
class Manoeuvres:
    """What was flown: of what the constants are told by.

    Attributes:
        turn_deg_s: root mean square of the turn rate. speeds_m_s: 10th and 90th percentile.
        heights_m: from the lowest to the highest. headings_deg: of the circle, how much was flown in, to 30 degrees.
    """

    turn_deg_s: float
    speeds_m_s: tuple[float, float]
    heights_m: float
    headings_deg: int

    @staticmethod
    def of(sightings: Sequence[Sighting]) -> Manoeuvres:
        rates = np.array([one.rates_rad_s() for one in sightings])
        speeds = np.array([np.linalg.norm(one.velocity_map_m_s[:2]) for one in sightings])
        heights = np.array([one.map_from_camera.translation[2] for one in sightings])
        noses = np.array([one.map_from_body[:2, 0] for one in sightings])
        sectors = np.unique(np.floor(np.degrees(np.arctan2(noses[:, 1], noses[:, 0])) / 30.0))
        low, high = np.percentile(speeds, (10, 90))
        return Manoeuvres(
            math.degrees(float(np.sqrt((rates**2).sum(axis=1).mean()))), (float(low), float(high)),
            float(np.ptp(heights)), 30 * len(sectors),
        )  # fmt: skip
