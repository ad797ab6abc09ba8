"""Frames that are not worth matching: dark, repeated, frozen, smeared; in flight and in a replay alike."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import cv2
import msgspec
import numpy as np
import pytest
from scenes_pipeline import WIDE, pose_prior

from ortholoc_edge.geometry import frames, rotation
from ortholoc_edge.geometry.arrays import FloatArray, ImageArray
from ortholoc_edge.geometry.camera import Camera
from ortholoc_edge.geometry.rigid import Rigid3
from ortholoc_edge.pipeline.frame import CameraMount, Frame, VehicleState
from ortholoc_edge.pipeline.navigator import Navigator
from ortholoc_edge.pipeline.outcome import Outcome, Reason, Rejected
from ortholoc_edge.pipeline.picture import PictureOptions, Seen, Watch, grey_rows, motion_px_s, unfit
from ortholoc_edge.pipeline.record import FrameRecord, frame_record, outcome_record

MS = 1_000_000
OPTIONS = PictureOptions()
NADIR = CameraMount(Rigid3(frames.BODY_FROM_NADIR_CAMERA, np.zeros(3)))


def noise(seed: int = 0, mean: float = 110.0) -> ImageArray:
    image = np.random.default_rng(seed).normal(mean, 12.0, (96, 128, 3))
    return np.clip(image, 0, 255).astype(np.uint8)


def state(
    velocity: Any = (0.0, 0.0, 0.0), turning: Any = (0.0, 0.0, 0.0), ned_from_body: FloatArray | None = None
) -> VehicleState:
    return VehicleState(
        0, np.eye(3) if ned_from_body is None else ned_from_body, (0.01, 0.01, 0.05),
        velocity_ned_m_s=np.array(velocity), turning_rad_s=np.array(turning),
    )  # fmt: skip


# -- the picture alone ---------------------------------------------------------


def test_a_replay_sees_the_same_rows_as_the_flight() -> None:
    """The log keeps frames in grey."""
    image = noise()
    logged = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    rows, again = grey_rows(image), grey_rows(logged)
    assert rows is not None and again is not None
    np.testing.assert_array_equal(rows, again)
    np.testing.assert_array_equal(rows, logged[::8])


@pytest.mark.parametrize(
    "image",
    [
        np.zeros((0, 0), np.uint8), np.zeros((4, 4), np.float32), np.zeros((4, 4, 4), np.uint8),
        np.zeros(7, np.uint8), np.zeros((2, 2, 3, 3), np.uint8),
    ],
)  # fmt: skip
def test_what_is_no_picture_is_left_to_the_localizer(image: Any) -> None:
    watch = Watch()
    assert watch.see(image).rows is None and watch.see(image).repeats == 0
    assert unfit(Frame(0, image, "x"), Seen(None, 0), None, OPTIONS) is None


def test_pictures_that_come_again_are_counted() -> None:
    watch = Watch()
    one, other = noise(1), noise(2)
    nearly = one.copy()
    nearly[40, 64, 1] ^= 64
    pictures = (one, one.copy(), one, other, other, one, nearly)
    assert [watch.see(image).repeats for image in pictures] == [0, 1, 2, 0, 1, 0, 0]


def refusal(image: ImageArray, repeats: int = 0, smear_px: float | None = None, **options: Any) -> Rejected | None:
    frame = Frame(7, image, "x", exposure_ns=20 * MS)
    return unfit(frame, Seen(grey_rows(image), repeats), smear_px, msgspec.structs.replace(OPTIONS, **options))


def test_reasons() -> None:
    assert refusal(noise()) is None
    dark = refusal(noise(mean=9.0))
    assert dark is not None and dark.reason is Reason.DARK and dark.stamp_ns == 7
    assert dark.measured == pytest.approx(9.0, abs=2.0) and dark.limit == 12.0
    assert refusal(noise(mean=9.0), min_brightness=0.0) is None
    once = refusal(noise(), repeats=1)
    assert once is not None and once.reason is Reason.REPEATED
    long = refusal(noise(), repeats=5)
    assert long is not None and (long.reason, long.measured, long.limit) == (Reason.FROZEN, 6, 5)
    assert "unplug" in long.detail
    capped = refusal(np.zeros_like(noise()), repeats=9)
    assert capped is not None and capped.reason is Reason.DARK, "a lens cap is no frozen camera"
    assert refusal(noise(), repeats=9, refuse_repeated=False) is None
    smeared = refusal(noise(), smear_px=OPTIONS.max_blur_px + 1)
    assert smeared is not None and smeared.reason is Reason.MOTION_BLUR and "20 ms" in smeared.detail
    assert refusal(noise(), smear_px=OPTIONS.max_blur_px - 1) is None


# -- motion --------------------------------------------------------------------


def moved_px_s(camera: Camera, height_m: float, moving: VehicleState, mount: CameraMount) -> float:
    """The same by moving the camera for a moment and looking where points of the ground went."""
    assert moving.ned_from_body is not None
    assert moving.velocity_ned_m_s is not None and moving.turning_rad_s is not None
    px = np.stack(
        np.meshgrid(camera.width * np.array([1, 3, 5]) / 6, camera.height * np.array([1, 3, 5]) / 6), axis=-1
    ).reshape(-1, 2)
    at = moving.ned_from_body @ mount.body_from_camera.rotation
    rays = camera.unproject(px) @ at.T
    points = rays * (height_m / rays[:, 2:])
    seconds = 1e-5
    later = moving.ned_from_body @ rotation.exp(moving.turning_rad_s * seconds) @ mount.body_from_camera.rotation
    seen = camera.project((points - moving.velocity_ned_m_s * seconds) @ later)
    return float(np.median(np.linalg.norm((seen - px) / seconds, axis=1)))


@pytest.mark.parametrize("velocity", [(15.0, -4.0, 2.0), (0.0, 0.0, 0.0)])
@pytest.mark.parametrize("turning", [(0.2, -0.5, 0.9), (0.0, 0.0, 0.0)])
@pytest.mark.parametrize("angles", [(0.0, 0.0, 0.0), (12.0, -8.0, 130.0)])
def test_motion_is_that_of_points_of_the_ground(velocity: Any, turning: Any, angles: Any) -> None:
    moving = state(velocity, turning, rotation.from_euler(*np.radians(angles)))
    found = motion_px_s(WIDE, 80.0, moving, NADIR)
    assert found == pytest.approx(moved_px_s(WIDE, 80.0, moving, NADIR), rel=1e-3, abs=1e-3)


def test_motion_by_hand() -> None:
    """20 m/s over 100 m with f = 200 px are 40 px/s; field notes have such a formula."""
    assert motion_px_s(WIDE, 100.0, state((20.0, 0.0, 0.0)), NADIR) == pytest.approx(40.0)
    gimbal = replace(state(turning=(3.0, 3.0, 3.0)), mount=NADIR)
    assert motion_px_s(WIDE, 100.0, gimbal, NADIR) == pytest.approx(0.0), "a gimbal holds still"
    for unknown in (
        replace(state(), velocity_ned_m_s=None), replace(state(), turning_rad_s=None),
        replace(state(), ned_from_body=None), state((np.nan, 0.0, 0.0)),
    ):  # fmt: skip
        assert motion_px_s(WIDE, 100.0, unknown, NADIR) is None
    assert motion_px_s(WIDE, -1.0, state(), NADIR) is None
    # Level, toward the horizon: the sky does not move, and nothing is divided by zero.
    forward = CameraMount(Rigid3(frames.MOUNTS["forward"], np.zeros(3)))
    assert motion_px_s(WIDE, 100.0, state((20.0, 0.0, 0.0)), forward) == pytest.approx(0.0, abs=5.0)


# -- in the navigator ----------------------------------------------------------


class Matched:
    """A localizer that says of every frame that it was matched."""

    rungs = 1
    working_camera = WIDE

    def height_above_ground_m(self, prior: Any) -> float:
        return 100.0

    def localize(self, frame: Frame, prior: Any, proceed: Any, rung: int) -> Outcome:
        return Rejected(frame.stamp_ns, Reason.FEW_MATCHES)


class Known:
    """A tracker that knows where the vehicle is."""

    reset_counter = 0

    def predict(self, now: VehicleState) -> Any:
        return pose_prior()

    def update(self, outcome: Outcome, now: VehicleState) -> None:
        pass

    def mount(self, now: VehicleState) -> CameraMount:
        return NADIR


def navigator(options: PictureOptions | None = OPTIONS) -> Navigator:
    localizer: Any = Matched()
    tracker: Any = Known()
    return Navigator(localizer, tracker, None, options)


def test_a_flight_and_its_replay_refuse_the_same_for_the_same_reasons() -> None:
    slow, fast = state((5.0, 0.0, 0.0)), state((40.0, 0.0, 0.0), (0.1, 0.0, 2.0))
    taken = [
        (noise(1), slow, 5 * MS), (noise(1), slow, 5 * MS), (noise(2), fast, None), (noise(3), fast, 200 * MS),
        (noise(4, mean=3.0), slow, 5 * MS), *[(noise(5), slow, None)] * 7,
    ]  # fmt: skip
    flying = navigator()
    records: list[tuple[FrameRecord, ImageArray]] = []
    reasons = []
    for number, (image, moving, exposure_ns) in enumerate(taken):
        frame, now = Frame(number, image, str(number), exposure_ns), replace(moving, stamp_ns=number)
        outcome = flying.step(frame, now)
        assert isinstance(outcome, Rejected) and flying.last is not None
        reasons.append(outcome.reason)
        record = frame_record(frame.name, frame.exposure_ns, True, outcome, now, flying.last)
        grey = np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), np.uint8)
        records.append((msgspec.json.decode(msgspec.json.encode(record), type=FrameRecord), grey))
    matched = Reason.FEW_MATCHES
    assert reasons == [
        matched, Reason.REPEATED, matched, Reason.MOTION_BLUR, Reason.DARK, matched, *[Reason.REPEATED] * 4,
        *[Reason.FROZEN] * 2,
    ]  # fmt: skip
    whole, alone = navigator(), navigator()
    for record, grey in records:
        frame = Frame(record.stamp_ns, grey, record.name, record.exposure_ns)
        again = whole.step_again(frame, record.state(), record.circumstances())
        assert outcome_record(again) == record.outcome
    # As after a gap, where what came before is not there.
    for record, grey in reversed(records):
        frame = Frame(record.stamp_ns, grey, record.name, record.exposure_ns)
        again_alone = alone.localize_again(frame, record.state(), record.circumstances())
        assert again_alone is not None and outcome_record(again_alone) == record.outcome


def test_without_options_nothing_is_refused() -> None:
    flying = navigator(None)
    black = np.zeros((96, 128, 3), np.uint8)
    for number in range(3):
        outcome = flying.step(Frame(number, black, "x", 900 * MS), state((40.0, 0.0, 0.0)))
        assert isinstance(outcome, Rejected) and outcome.reason is Reason.FEW_MATCHES
