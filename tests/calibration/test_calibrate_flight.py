"""A flight with GNSS tells how the camera sits, how late it is and how long its lens is; and says what it did not tell.

`ortholoc_sim`'s scenario calibration_flight is the whole of it, pictures included (docs/calibration.md has figures).
"""

from __future__ import annotations

import json
import math
import time
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import msgspec
import numpy as np
import pytest
from pipeline.scenes_pipeline import fix

from ortholoc_edge.adapters.camera import CameraOptions
from ortholoc_edge.adapters.flight_log import FlightLog, LogOptions
from ortholoc_edge.adapters.mavlink import LinkOptions
from ortholoc_edge.calibration.files import read_camera
from ortholoc_edge.calibration.flight import TURN_STEP_S, FlightCalibration, Sighting, focal_response_m, solve
from ortholoc_edge.calibration.sightings import read_flights
from ortholoc_edge.cli import main
from ortholoc_edge.config import Config, Intrinsics, MapOptions, MountOptions, config_text
from ortholoc_edge.errors import ConfigError, DatasetError
from ortholoc_edge.geometry import frames, rotation
from ortholoc_edge.geometry.camera import Camera
from ortholoc_edge.geometry.rigid import Rigid3
from ortholoc_edge.pipeline.frame import TURN_AGES_NS, VehicleState
from ortholoc_edge.pipeline.navigator import Circumstances
from ortholoc_edge.pipeline.outcome import Fix, Reason, Rejected
from ortholoc_edge.tiles.pack import Pack

S = 1_000_000_000
DEMO = Path(__file__).resolve().parents[2] / "tiles" / "demo"
CAMERA = Camera.from_focal(640, 480, 540.0)
MOUNT = MountOptions(lever_arm_m=(0.1, 0.0, 0.05))
RATE_HZ = 2.0
# Of the demo pack, about.
GROUND_M = 437.0


@dataclass(frozen=True)
class Flight:
    """A vehicle's way, as functions of time: NED, m and rad. ``lively``: figures of eight, banked, faster and slower,
    up and down; else straight, level, at one speed and in still air."""

    lively: bool = True

    def attitude(self, t: float) -> np.ndarray:
        if not self.lively:
            return rotation.from_euler(0.0, -0.05, 0.6)
        yaw = 4.5 * (1 - math.cos(2 * math.pi * t / 40.0)) + 0.03 * math.sin(2 * math.pi * t / 1.7)
        roll = 0.25 * math.sin(2 * math.pi * t / 40.0) + 0.03 * math.sin(2 * math.pi * t / 2.3)
        return rotation.from_euler(roll, -0.05 + 0.02 * math.sin(2 * math.pi * t / 3.1), yaw)

    def velocity(self, t: float) -> np.ndarray:
        speed = 8.0 + 2.0 * math.sin(2 * math.pi * t / 31.0) if self.lively else 8.0
        yaw = rotation.to_euler(self.attitude(t))[2]
        down = -4.0 * math.cos(2 * math.pi * t / 60.0) if self.lively else 0.0
        return np.array([speed * math.cos(yaw), speed * math.sin(yaw), down])

    def position(self, t: float) -> np.ndarray:
        return np.array([np.interp(t, _TIMES, axis) for axis in _ways(self.lively)])


_TIMES = np.arange(0.0, 130.0, 0.05)


@cache
def _ways(lively: bool) -> np.ndarray:
    speeds = np.array([Flight(lively).velocity(t) for t in _TIMES])
    steps_m = 0.5 * (speeds[1:] + speeds[:-1]) * 0.05
    return np.vstack([np.zeros(3), np.cumsum(steps_m, axis=0)]).T


@dataclass(frozen=True)
class Wrong:
    """By how much the camera is other than configured."""

    mount_deg: tuple[float, float, float] = (0.8, -1.2, 1.5)
    late_s: float = 0.06
    focal: float = 0.02

    def true_mount(self) -> Rigid3:
        roll, pitch, yaw = self.mount_deg
        return msgspec.structs.replace(MOUNT, roll_deg=roll, pitch_deg=pitch, yaw_deg=yaw).body_from_camera()


class Noise:
    """Slow and white errors, as `calibration.flight` takes them to be."""

    def __init__(self, seed: int) -> None:
        self._rng = np.random.default_rng(seed)
        self._sigma = np.array([0.3, 0.3, 0.4, 0.6, 0.6, 0.6]) * ([math.pi / 180] * 3 + [1.0] * 3)
        self._time_s = np.array([15.0, 15.0, 30.0, 20.0, 20.0, 20.0])
        self._slow = self._sigma * self._rng.standard_normal(6)

    def step(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Of the attitude, of GNSS, and of the fix (6,)."""
        kept = np.exp(-1.0 / RATE_HZ / self._time_s)
        self._slow = kept * self._slow + self._sigma * np.sqrt(1 - kept**2) * self._rng.standard_normal(6)
        white = np.array([0.1] * 3 + [math.radians(0.1)] * 3) * self._rng.standard_normal(6)
        return self._slow[:3], self._slow[3:], white


COVARIANCE = np.diag(np.square([0.3] * 3 + [math.radians(0.3)] * 3))


def steps(flight: Flight, wrong: Wrong, seed: int, seconds: float, origin: np.ndarray, ground_m: float):
    """(stamp, fix's pose, `VehicleState`) of each frame, over level ground; map axes are true north here."""
    map_from_ned = frames.map_from_ned_rotation(0.0)
    noise = Noise(seed)
    for number in range(int(seconds * RATE_HZ)):
        at_s = 1.0 + number / RATE_HZ
        exposed_s = at_s - wrong.late_s
        attitude_error, gnss_error, fix_error = noise.step()
        body = Rigid3(map_from_ned @ flight.attitude(exposed_s), origin + map_from_ned @ flight.position(exposed_s))
        true = body @ wrong.true_mount()
        longer_m = focal_response_m(true, CAMERA, lambda xy: np.full(len(xy), ground_m))
        assert longer_m is not None
        place = true.translation + fix_error[:3] + [0.0, 0.0, longer_m * math.log(1.0 + wrong.focal)]
        pose = Rigid3(rotation.exp(fix_error[3:]) @ true.rotation, place)
        now = flight.attitude(at_s)
        # About north, east, down; the told attitude errs alike at the stamp and just before it.
        told = rotation.exp(attitude_error) @ now
        turns = np.array([rotation.log(now.T @ flight.attitude(at_s - age * 1e-9)) for age in TURN_AGES_NS])
        gnss = origin + map_from_ned @ flight.position(at_s) + gnss_error
        yield round(at_s * S), pose, VehicleState(
            round(at_s * S), told, (0.02, 0.02, 0.05), position_map_m=gnss, position_sigma_m=(0.6, 0.9),
            velocity_ned_m_s=flight.velocity(at_s), turns_before=turns,
        )  # fmt: skip


def sightings(flight: Flight, wrong: Wrong, seed: int, seconds: float = 100.0) -> list[Sighting]:
    map_from_ned = frames.map_from_ned_rotation(0.0)
    found = []
    for stamp_ns, pose, state in steps(flight, wrong, seed, seconds, np.array([0.0, 0.0, 80.0]), 0.0):
        response_m = focal_response_m(pose, CAMERA, lambda xy: np.zeros(len(xy)))
        assert response_m is not None and state.ned_from_body is not None
        found.append(
            Sighting(
                stamp_ns, pose, COVARIANCE, map_from_ned @ state.ned_from_body, state.turns_before,
                state.position_map_m, map_from_ned @ state.velocity_ned_m_s, response_m,
            )
        )  # fmt: skip
    return found


def off(found: FlightCalibration, wrong: Wrong) -> np.ndarray:
    """(5,) errors of mount (rad about the body's axes), lateness and focal length."""
    turn = rotation.log(found.body_from_camera.rotation @ wrong.true_mount().rotation.T)
    return np.array([*turn, found.value("late_s") - wrong.late_s, found.value("log_focal") - math.log1p(wrong.focal)])


@pytest.fixture(scope="module")
def lively() -> list[FlightCalibration]:
    return [solve([sightings(Flight(), Wrong(), seed)], MOUNT.body_from_camera()) for seed in range(2)]


def test_what_is_wrong_is_found_within_its_sigma(lively):
    for found in lively:
        z = off(found, Wrong()) / np.sqrt(np.diag(found.covariance)[:5])
        assert np.abs(z).max() < 3.5, z
        assert max(found.sigma(name) for name in ("roll", "pitch")) < math.radians(0.3)
        assert found.sigma("late_s") < 0.006 and found.sigma("log_focal") < 0.02


def test_sigmas_are_no_larger_than_they_need_be(lively):
    """Of the mount; that of the focal length is doubled on purpose, and clocks have their own part."""
    z = np.array([off(found, Wrong())[:3] / np.sqrt(np.diag(found.covariance)[:3]) for found in lively])
    assert 0.2 < np.sqrt(np.mean(z**2)) < 2.0


def test_an_earlier_stamp_and_a_shorter_lens_are_found_too():
    wrong = Wrong((-3.0, 4.0, -8.0), -0.02, -0.03)
    found = solve([sightings(Flight(), wrong, 7)], MOUNT.body_from_camera())
    assert np.abs(off(found, wrong) / np.sqrt(np.diag(found.covariance)[:5])).max() < 3.5
    assert found.value("late_s") < -0.008 and found.value("log_focal") < 0.0


def test_a_calm_straight_flight_tells_neither_time_nor_focal_length():
    """The mount's angles it tells: they need no turn."""
    found = solve([sightings(Flight(lively=False), Wrong(), 1, 60.0)], MOUNT.body_from_camera())
    assert found.sigma("late_s") > 0.05 and found.sigma("log_focal") > 0.05
    assert found.sigma("pitch") < math.radians(0.4)


def test_two_flights_tell_more_than_one(lively):
    both = solve([sightings(Flight(), Wrong(), seed) for seed in (0, 1)], MOUNT.body_from_camera())
    assert both.sigma("roll") < 0.85 * lively[0].sigma("roll")
    assert np.abs(off(both, Wrong()) / np.sqrt(np.diag(both.covariance)[:5])).max() < 3.5


def test_a_wrong_fix_counts_for_little():
    rows = sightings(Flight(), Wrong(), 2)
    for number in range(0, len(rows), 20):
        pose = rows[number].map_from_camera
        rows[number] = replace(
            rows[number], map_from_camera=Rigid3(rotation.exp([0.1, 0, 0]) @ pose.rotation, pose.translation + 15.0)
        )
    found = solve([rows], MOUNT.body_from_camera())
    assert found.outlying >= len(rows) // 20
    assert np.abs(off(found, Wrong()) / np.sqrt(np.diag(found.covariance)[:5])).max() < 4.0


def test_without_gnss_the_attitude_still_tells_mount_and_time():
    rows = [replace(one, gnss_map_m=None) for one in sightings(Flight(), Wrong(), 0)]
    found = solve([rows], MOUNT.body_from_camera())
    assert np.abs(off(found, Wrong())[:4] / np.sqrt(np.diag(found.covariance)[:4])).max() < 3.5
    assert found.sigma("log_focal") > 0.2


def test_turns_are_those_of_the_flight():
    """Between the rows, and a little beyond them."""
    flight, at_s = Flight(), 12.3
    now = flight.attitude(at_s)
    turns = np.array([rotation.log(now.T @ flight.attitude(at_s - age * 1e-9)) for age in TURN_AGES_NS])
    one = replace(sightings(flight, Wrong(), 0, 1.0)[0], turns=turns)
    for age_s in (0.0, 0.03, TURN_STEP_S, 0.117, 0.24, -0.01):
        true = rotation.log(now.T @ flight.attitude(at_s - age_s))
        assert np.allclose(one.turn(age_s), true, atol=2e-3), age_s
    assert np.linalg.norm(one.rates_rad_s()) > 0.05


def test_focal_response_is_the_distance_straight_down():
    down = Rigid3(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 130.0]))
    assert focal_response_m(down, CAMERA, lambda xy: np.full(len(xy), 30.0)) == pytest.approx(-100.0, rel=1e-6)
    assert focal_response_m(down, CAMERA, lambda xy: np.full(len(xy), 140.0)) is None
    assert focal_response_m(down, CAMERA, lambda xy: np.full(len(xy), np.nan)) is None
    up = Rigid3(np.eye(3), np.array([0.0, 0.0, 130.0]))
    assert focal_response_m(up, CAMERA, lambda xy: np.zeros(len(xy))) is None


# -- from logs -----------------------------------------------------------------------------------------


def logged(folder: Path, flight: Flight, wrong: Wrong, mount: MountOptions = MOUNT, seconds: float = 100.0) -> Path:
    """The log of a flight over the demo pack, written as the daemon writes it; each tenth frame gave no fix."""
    pack = Pack.open(DEMO)
    convergence = pack.georeference.convergence_rad(np.array(pack.georeference.anchor[:2]))
    intrinsics = Intrinsics(width_px=640, height_px=480, fx=540.0, fy=540.0, cx=319.5, cy=239.5)
    config = Config(
        camera=CameraOptions(source="folder:x", latency_ms=20.0), intrinsics=intrinsics, mount=mount,
        map=MapOptions(pack=str(DEMO)), link=LinkOptions(endpoint="udpout:127.0.0.1:1"),
    )  # fmt: skip
    header = {
        "config": config_text(config), "pack": str(DEMO), "pack_sha256": pack.manifest_sha256, "matcher": "structural",
        "model_sha256": None,
    }  # fmt: skip
    log = FlightLog(LogOptions(folder=str(folder), frames="none"), pack.georeference, header, 0, 0)
    low = np.array([*pack.georeference.anchor[:2], 0.0])
    from_true = rotation.exp([0.0, 0.0, convergence])
    flown = steps(flight, wrong, 0, seconds, np.array([0.0, 0.0, GROUND_M + 80.0]), GROUND_M)
    for number, (stamp_ns, pose, state) in enumerate(flown):
        turned = Rigid3(from_true @ pose.rotation, from_true @ pose.translation + low)
        assert state.position_map_m is not None
        state = replace(state, position_map_m=from_true @ state.position_map_m + low)  # noqa: PLW2901
        made = fix(tuple(turned.translation), stamp_ns=stamp_ns, rotation_matrix=turned.rotation)
        outcome: Fix | Rejected = replace(made, covariance=COVARIANCE)
        if number % 10 == 9:
            outcome = Rejected(stamp_ns, Reason.FEW_MATCHES)
        while log._queue.full():
            time.sleep(0.001)
        log.put(None, outcome, (outcome, state, Circumstances(number, None, 0, 0, 0)))
    log.close()
    return folder


def test_a_log_tells_what_to_write_into_the_configuration(tmp_path, capsys):
    folder = logged(tmp_path / "log", Flight(), Wrong(focal=0.06))
    assert main(["calibrate-flight", str(folder), "--json"]) == 0
    told = {one["name"]: one for one in json.loads(capsys.readouterr().out)["figures"]}
    expected = {"mount.roll_deg": 0.8, "mount.pitch_deg": -1.2, "mount.yaw_deg": 1.5, "camera.latency_ms": 80.0,
                "intrinsics.focal": 1.06}  # fmt: skip
    for name, true in expected.items():
        assert told[name]["told"] and abs(told[name]["now"] - true) < 3.5 * told[name]["sigma"], told[name]
    assert main(["calibrate-flight", str(folder)]) == 0
    text = capsys.readouterr().out
    assert "180 fixes of 200 frames, 180 with GNSS" in text and "360 of 360 degrees of heading" in text
    pasted = tmp_path / "pasted.toml"
    pasted.write_text(text[text.index("[mount]") :])
    assert read_camera(pasted).fx == pytest.approx(540.0 * told["intrinsics.focal"]["now"], rel=1e-6)
    assert f"latency_ms = {told['camera.latency_ms']['now']:.1f}" in text


def test_a_calm_log_says_what_to_fly(tmp_path, capsys):
    folder = logged(tmp_path / "log", Flight(lively=False), Wrong(), seconds=40.0)
    assert main(["calibrate-flight", str(folder)]) == 1
    text = capsys.readouterr().out
    assert "camera.latency_ms  not observable: 1-sigma" in text and "figures of eight" in text
    assert "intrinsics.focal   not observable: 1-sigma" in text and "climb and descend" in text
    # What is not told stays as it was.
    assert "\nlatency_ms = 20.0\n" in text and "\nfx = 540.0\n" in text


def test_what_is_no_calibration_flight_is_refused(tmp_path):
    short = logged(tmp_path / "short", Flight(), Wrong(), seconds=5.0)
    with pytest.raises(DatasetError, match="fixes with attitude and speed of 10 frames, 40 are the least"):
        read_flights([short])
    with pytest.raises(DatasetError, match="no flight log"):
        read_flights([tmp_path])
    other = logged(tmp_path / "other", Flight(), Wrong(), msgspec.structs.replace(MOUNT, roll_deg=1.0), seconds=5.0)
    with pytest.raises(ConfigError, match=r"flown with different \[mount\]"):
        read_flights([short, other])
    gimbal = logged(tmp_path / "gimbal", Flight(), Wrong(), MountOptions(preset="forward", gimbal="auto"), seconds=5.0)
    with pytest.raises(ConfigError, match="flown with a gimbal"):
        read_flights([gimbal])
