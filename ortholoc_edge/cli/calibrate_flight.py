"""``calibrate-flight``: mount, latency and focal length, from flight logs with GNSS."""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from ortholoc_edge.calibration.files import toml_of
from ortholoc_edge.calibration.flight import FlightCalibration, solve
from ortholoc_edge.calibration.sightings import Flown, Manoeuvres, read_flights
from ortholoc_edge.config import MountOptions
from ortholoc_edge.geometry import frames, rotation
from ortholoc_edge.geometry.arrays import FloatArray

# What is told better than this is a calibration, and what is not is none: a degree of mount is 1.7 m per 100 m of
# height, 10 ms are 0.2 m at 20 m/s, a percent of focal length is a metre of height per 100 m. Of the focal length a
# flight is a check: a board tells it far better.
_SURE_SIGMAS = 2.0
_MOST_MOUNT_DEG, _MOST_YAW_DEG, _MOST_LATE_MS, _MOST_FOCAL = 0.3, 0.5, 10.0, 0.02


@dataclass(frozen=True, slots=True)
class Told:
    """One figure.

    Attributes:
        name: key of the configuration. was, now, sigma, limit: in its unit; of ``focal`` relative to the configured.
        told: whether the flight told it. remedy: what to fly if not.
    """

    name: str
    was: float
    now: float
    sigma: float
    limit: float
    told: bool
    remedy: str


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add ``calibrate-flight``."""
    parser = subparsers.add_parser(
        "calibrate-flight",
        help="mount angles, latency and focal length from flight logs with GNSS",
        description="Holds the fixes of flight logs against the autopilot's attitude and GNSS: how the camera sits on "
        "the body, how late its stamps are, and whether the focal length is right, each with its 1-sigma. What the "
        "flight did not tell is said, and what to fly. Prints the lines to paste. A constant error of the autopilot's "
        "own attitude is in the mount, where it does no harm. docs/calibration.md has the whole way. Exit code 0: all "
        "of it was told; 1: not all.",
    )
    parser.add_argument("logs", type=Path, nargs="+", metavar="LOG", help="flight log (.mcap), or a folder of them: "
                        "what the daemon wrote there since it was last started")  # fmt: skip
    parser.add_argument("--pack", type=Path, help="the pack flown with (default: where it was then)")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    flown = read_flights(args.logs, args.pack)
    found = solve(flown.flights, flown.config.mount.body_from_camera())
    told = figures(flown, found)
    if args.json:
        print(json.dumps(_record(flown, found, told)))
    else:
        print(_text(flown, found, told))
    return 0 if all(one.told for one in told) else 1


def figures(flown: Flown, found: FlightCalibration) -> list[Told]:
    """What the flight tells, in the configuration's terms."""
    mount = flown.config.mount
    now, sigmas = _mount_deg(mount, found)
    names = ("roll_deg", "pitch_deg", "yaw_deg")
    limits = (_MOST_MOUNT_DEG, _MOST_MOUNT_DEG, _MOST_YAW_DEG)
    turns = "fly longer, with fixes, on headings all around"
    told = [
        Told(f"mount.{name}", getattr(mount, name), float(value), float(sigma), limit, bool(sigma <= limit), turns)
        for name, value, sigma, limit in zip(names, now, sigmas, limits, strict=True)
    ]
    late_ms, sigma_ms = 1e3 * found.value("late_s"), 1e3 * found.sigma("late_s")
    key, latency_ms = flown.config.camera.lateness
    told.append(
        Told(
            f"camera.{key}", latency_ms, latency_ms + late_ms, sigma_ms, _MOST_LATE_MS, sigma_ms <= _MOST_LATE_MS,
            "turn and bank more: figures of eight at 20 degrees per second, faster and slower",
        )
    )  # fmt: skip
    factor, relative = math.exp(found.value("log_focal")), found.sigma("log_focal")
    told.append(
        Told(
            "intrinsics.focal", 1.0, factor, relative, _MOST_FOCAL, relative <= _MOST_FOCAL,
            "climb and descend with fixes: heights above ground that differ by a factor of two, twice or more",
        )
    )  # fmt: skip
    return told


def _mount_deg(mount: MountOptions, found: FlightCalibration) -> tuple[FloatArray, FloatArray]:
    """Roll, pitch, yaw of ``[mount]`` and their 1-sigma, deg."""
    preset = frames.MOUNTS[mount.preset]

    def angles(step: FloatArray) -> FloatArray:
        turned = rotation.exp(step) @ found.body_from_camera.rotation
        return np.degrees(rotation.to_euler(turned @ preset.T))

    now, small = angles(np.zeros(3)), 1e-5
    slopes = np.stack([(angles(small * axis) - now) / small for axis in np.eye(3)], axis=1)
    covariance = slopes @ found.covariance[:3, :3] @ slopes.T
    return now, np.sqrt(np.diag(covariance))


# -- what is printed -----------------------------------------------------------------------------------


def _text(flown: Flown, found: FlightCalibration, told: list[Told]) -> str:
    flew = Manoeuvres.of(flown.sightings)
    with_gnss = sum(one.gnss_map_m is not None for one in flown.sightings)
    left_out = ", ".join(
        f"{number} {why}"
        for number, why in (
            (flown.without_attitude, "without attitude"), (flown.without_speed, "without speed"),
            (flown.without_ground, "without ground in view"),
        )
        if number
    )  # fmt: skip
    lines = [
        f"{len(flown.sightings)} fixes of {flown.frames} frames{f' ({left_out})' if left_out else ''}, {with_gnss} "
        f"with GNSS; {found.frames} taken, {found.outlying} of them outlying",
        f"flown: turn rate {flew.turn_deg_s:.1f} degrees per second (rms), {flew.speeds_m_s[0]:.1f} to "
        f"{flew.speeds_m_s[1]:.1f} m/s, {flew.heights_m:.0f} m of height, {flew.headings_deg} of 360 degrees of "
        "heading",
        "",
        *(_line(one) for one in told),
        "",
        f"fixes lie {found.value('offset_east_m'):+.2f} m east, {found.value('offset_north_m'):+.2f} north and "
        f"{found.value('offset_up_m'):+.2f} up of GNSS; 1-sigma {found.sigma('offset_east_m'):.2f}, "
        f"{found.sigma('offset_north_m'):.2f}, {found.sigma('offset_up_m'):.2f} m",
        f"attitude wanders by {math.degrees(found.noise.tilt):.2f} degrees of tilt and "
        f"{math.degrees(found.noise.heading):.2f} of heading, GNSS by {found.noise.level:.2f} m and "
        f"{found.noise.height:.2f} m of height (1-sigma)",
        "",
        _paste(flown, told),
    ]
    return "\n".join(lines)


def _line(one: Told) -> str:
    if one.name == "intrinsics.focal":
        percent: Callable[[float], str] = lambda part: f"{100.0 * part:.2f} %"  # noqa: E731
        value = f"{'longer' if one.now >= 1.0 else 'shorter'} by {percent(abs(one.now - 1.0))}"
        sigma, limit = percent(one.sigma), percent(one.limit)
    else:
        value, sigma, limit = f"{one.was:.2f} -> {one.now:.2f}", f"{one.sigma:.2f}", f"{one.limit:g}"
    if one.told:
        return f"{one.name:<18} {value}, 1-sigma {sigma}"
    return f"{one.name:<18} not observable: 1-sigma {sigma}, {limit} is the most; {one.remedy}"


def _paste(flown: Flown, told: list[Told]) -> str:
    """The tables with what was told; the rest as it was. Of the focal length only what is surely wrong: a board knows
    it better."""
    by_name = {one.name: one.now if one.told else one.was for one in told}
    focal = next(one for one in told if one.name == "intrinsics.focal")
    if abs(focal.now - focal.was) <= _SURE_SIGMAS * focal.sigma:
        by_name[focal.name] = focal.was
    mount = flown.config.mount
    lines = [
        "[mount]", f'preset = "{mount.preset}"',
        *(f"{name} = {by_name[f'mount.{name}']:.2f}" for name in ("roll_deg", "pitch_deg", "yaw_deg")),
        "", "[camera]",
    ]  # fmt: skip
    key, _ = flown.config.camera.lateness
    latency_ms = by_name[f"camera.{key}"]
    if key == "latency_ms" and latency_ms < 0.0:
        lines.append(f"{key} = 0.0   # {latency_ms:.1f} was found: stamps are earlier than the exposure")
    else:
        lines.append(f"{key} = {latency_ms:.1f}")
    intrinsics, factor = flown.config.intrinsics, by_name["intrinsics.focal"]
    scaled = msgspec.structs.replace(intrinsics, fx=intrinsics.fx * factor, fy=intrinsics.fy * factor)
    return "\n".join([*lines, "", toml_of(scaled.camera()).rstrip()])


def _record(flown: Flown, found: FlightCalibration, told: list[Told]) -> dict[str, Any]:
    return {
        "frames": flown.frames,
        "fixes": len(flown.sightings),
        "taken": found.frames,
        "outlying": found.outlying,
        "figures": [asdict(one) for one in told],
        "offset_m": [found.value(f"offset_{axis}_m") for axis in ("east", "north", "up")],
        "gnss_late_s": [found.value("gnss_late_s"), found.sigma("gnss_late_s")],
        "noise": asdict(found.noise),
        "flown": asdict(Manoeuvres.of(flown.sightings)),
    }
