"""The tracker's memory: what it predicts, how sure it is, what it tells the autopilot."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes_pipeline import fix
from strategies import finite

from ortholoc_edge.geometry import frames, rotation
from ortholoc_edge.geometry.rigid import Rigid3
from ortholoc_edge.pipeline.frame import VehicleState
from ortholoc_edge.pipeline.outcome import Reason, Rejected
from ortholoc_edge.pipeline.prior import PosePrior
from ortholoc_edge.pipeline.tracker import GivenPosition, StartAnew, Tracker, TrackerOptions, TrackerStatus
from ortholoc_edge.pipeline.witness import Consistency
from ortholoc_edge.tiles.georeference import Georeference, VerticalDatum

LOCAL = Georeference(None, VerticalDatum(kind="ellipsoid", ellipsoid_minus_map_m=0.0), (0.0, 0.0))
# UTM zone 32 at 11 E, 48 N: two degrees east of the central meridian.
AT_UTM = np.array([649_195.0, 5_318_374.0, 600.0])
UTM = Georeference(
    "EPSG:32632", VerticalDatum(kind="ellipsoid", ellipsoid_minus_map_m=0.0), (float(AT_UTM[0]), float(AT_UTM[1]))
)
NADIR = Rigid3(frames.BODY_FROM_NADIR_CAMERA, np.zeros(3))
SECOND = 1_000_000_000
LEVEL = np.eye(3)
SIGMA = tuple(np.radians([1.0, 1.0, 3.0]))


def state(seconds=0.0, odometry=None, epoch=1, position=None, sigma=(2.0, 3.0), attitude=LEVEL, attitude_sigma=SIGMA):
    return VehicleState(
        round(seconds * SECOND),
        attitude,
        attitude_sigma,
        None if odometry is None else np.array(odometry, dtype=float),
        epoch,
        None if position is None else np.array(position, dtype=float),
        sigma,
    )


def tracker(georeference=LOCAL, body_from_camera=NADIR, **options):
    return Tracker(georeference, body_from_camera, TrackerOptions(**options))


def fixed(at=(0.0, 0.0, 100.0), start=None, **options):
    """A tracker that has just had a fix; its odometry starts at zero."""
    made = tracker(**options)
    start = start or state(0, (0, 0, 0), position=at)
    assert isinstance(made.predict(start), PosePrior)
    made.update(fix(at), start)
    return made


def sigma_of(prior):
    return np.sqrt(np.diag(prior.covariance)[:3])


def test_nothing_is_known_at_first():
    made = tracker()
    outcome = made.predict(state())
    assert isinstance(outcome, Rejected)
    assert outcome.reason is Reason.NO_PRIOR
    made.update(outcome, state())
    assert made.status is TrackerStatus.SEARCH
    assert made.reset_counter == 0


def test_gnss_is_the_first_prior():
    made = tracker()
    prior = made.predict(state(position=(5.0, 6.0, 100.0)))
    assert np.allclose(prior.map_from_camera.translation, (5, 6, 100))
    assert np.allclose(sigma_of(prior), (2, 2, 3))
    assert np.allclose(np.sqrt(np.diag(prior.covariance)[3:]), np.radians([1, 1, 3]))
    # Level, heading north: the camera looks down with its right to the east.
    assert np.allclose(prior.map_from_camera.rotation, np.diag([1.0, -1.0, -1.0]))


@pytest.mark.parametrize(
    "bad",
    [
        {"attitude": None},
        {"attitude": np.full((3, 3), np.nan)},
        {"attitude_sigma": (np.nan, 0.1, 0.1)},
        {"attitude_sigma": (0.1, 0.1, np.inf)},
    ],
)
def test_no_attitude_no_prior(bad):
    made = fixed()
    outcome = made.predict(replace(state(1, (0, 0, 0), position=(0, 0, 100)), **renamed(bad)))
    assert isinstance(outcome, Rejected)
    assert outcome.reason is Reason.BAD_ATTITUDE
    made.update(outcome, state(1))
    assert made.status is TrackerStatus.COAST


def renamed(bad):
    names = {"attitude": "ned_from_body", "attitude_sigma": "attitude_sigma_rad"}
    return {names[key]: value for key, value in bad.items()}


def test_the_fix_is_carried_by_odometry():
    # 30 m north, 40 m east, 5 m up in the axes of NED.
    prior = fixed().predict(state(2, (30, 40, -5)))
    assert np.allclose(prior.map_from_camera.translation, (40, 30, 105))


def test_certainty_falls_with_distance_and_time():
    made = fixed(odometry_ratio=0.04, odometry_drift_m_per_s=0.5)
    still, later, farther = (
        made.predict(s) for s in (state(0, (0, 0, 0)), state(10, (0, 0, 0)), state(0, (30, 40, 0)))
    )
    assert np.allclose(sigma_of(still), 0.5, atol=0.01)
    assert np.allclose(sigma_of(later)[:2], np.hypot(0.5, 5.0))
    assert np.allclose(sigma_of(farther)[:2], np.hypot(0.5, 2.0))
    both = made.predict(state(10, (30, 40, 0)))
    assert np.allclose(sigma_of(both)[:2], np.sqrt(0.25 + 25 + 4))


def test_certainty_of_height_falls_with_the_climb_and_with_the_root_of_time():
    made = fixed(climb_ratio=0.1, climb_error_m_per_s=0.3, climb_memory_s=2.0)
    climbed = made.predict(state(0, (30, 40, -60)))
    assert sigma_of(climbed)[2] == pytest.approx(np.hypot(0.5, 6.0))
    assert sigma_of(made.predict(state(0.01, (0, 0, 0))))[2] == pytest.approx(np.hypot(0.5, 0.003), rel=1e-5)
    # After long: a walk of 0.3 m/s times the root of twice the memory times the time.
    assert sigma_of(made.predict(state(400, (0, 0, 0))))[2] == pytest.approx(np.sqrt(0.25 + 0.09 * 4 * 398), rel=1e-6)


@settings(max_examples=10)
@given(st.floats(0.2, 20.0), st.integers(0, 2**32 - 1))
def test_height_drifts_as_an_error_that_is_forgotten_does(memory_s, seed):
    """Against a Gauss-Markov process drawn and summed up."""
    rng = np.random.default_rng(seed)
    step_s, steps, flights = memory_s / 20, 120, 4000
    keep = np.exp(-step_s / memory_s)
    error = rng.standard_normal(flights)
    drift = np.zeros(flights)
    for _ in range(steps):
        before, error = error, keep * error + np.sqrt(1 - keep**2) * rng.standard_normal(flights)
        drift += step_s * (before + error) / 2
    made = fixed(climb_error_m_per_s=1.0, climb_memory_s=memory_s)
    variance = sigma_of(made.predict(state(steps * step_s, (0, 0, 0))))[2] ** 2 - 0.25
    assert variance == pytest.approx(np.mean(drift**2), rel=0.15, abs=1e-4)


def test_heights_of_another_datum_are_told_in_a_long_outage():
    """Five minutes without a fix: in the horizontal nearly anything is believed, but not 50 m of height."""
    prior = fixed().predict(state(300, (1500, 1500, 0)))
    east, _, up = sigma_of(prior)
    assert 5 * east > 300
    assert 5 * up < 50


def test_without_odometry_it_stays_and_grows_by_speed():
    made = fixed(unaided_speed_m_per_s=20.0)
    prior = made.predict(state(3))
    assert np.allclose(prior.map_from_camera.translation, (0, 0, 100))
    assert np.allclose(sigma_of(prior)[:2], np.hypot(0.5, 60.0))
    assert sigma_of(prior)[2] == pytest.approx(np.hypot(0.5, 3 * 4.0))


@pytest.mark.parametrize("broken", [{"epoch": 2}, {"odometry": (np.nan, 0, 0)}])
def test_a_broken_odometry_is_none(broken):
    made = fixed(unaided_speed_m_per_s=20.0)
    prior = made.predict(state(3, **{"odometry": (500.0, 0, 0), **broken}))
    assert np.allclose(prior.map_from_camera.translation, (0, 0, 100))
    assert np.allclose(sigma_of(prior)[:2], np.hypot(0.5, 60.0))


def test_the_surer_of_gnss_and_carried_fix_is_taken():
    made = fixed(odometry_ratio=0.0, odometry_drift_m_per_s=1.0)
    near = made.predict(state(1, (10, 0, 0), position=(0, 99, 100)))
    assert np.allclose(near.map_from_camera.translation, (0, 10, 100))
    far = made.predict(state(30, (10, 0, 0), position=(0, 99, 100)))
    assert np.allclose(far.map_from_camera.translation, (0, 99, 100))


@pytest.mark.parametrize(
    "gnss",
    [
        {"position": (np.nan, 0, 0)},
        {"position": (0, 99, 100), "sigma": (np.nan, 1.0)},
        {"position": (0, 99, 100), "sigma": (1.0, np.nan)},
        {"position": (0, 99, 100), "sigma": (np.inf, 1.0)},
        {"position": (0, 99, 100), "sigma": (400.0, 1.0)},
    ],
)
def test_gnss_of_no_worth_is_left(gnss):
    assert np.allclose(fixed().predict(state(1, (10, 0, 0), **gnss)).map_from_camera.translation, (0, 10, 100))
    alone = tracker().predict(state(1, **gnss))
    assert isinstance(alone, Rejected)
    assert alone.reason is Reason.NO_PRIOR


def test_lost_means_search_and_the_next_fix_is_a_reset():
    made = fixed(lost_sigma_m=100.0, unaided_speed_m_per_s=10.0)
    outcome = made.predict(state(20))
    assert isinstance(outcome, Rejected)
    assert outcome.reason is Reason.NO_PRIOR
    assert outcome.measured == pytest.approx(200.0, rel=1e-3)
    assert outcome.limit == 100.0
    made.update(outcome, state(20))
    assert made.status is TrackerStatus.SEARCH
    back = state(30, (0, 0, 0), position=(1.0, 0.0, 100.0))
    made.predict(back)
    made.update(fix((1.0, 0.0, 100.0)), back)
    assert made.status is TrackerStatus.TRACK
    assert made.reset_counter == 2


def test_where_nothing_is_known_the_autopilots_own_position_says_where_to_look():
    made = tracker(believed_sigma_m=(20.0, 4.0))
    prior = made.predict(replace(state(1), believed_map_m=np.array([7.0, 8.0, 90.0])))
    assert np.allclose(prior.map_from_camera.translation, (7, 8, 90))
    assert np.allclose(sigma_of(prior), (20, 20, 4))
    # It is no anchor: without one there is nothing to carry on.
    assert isinstance(made.predict(state(2)), Rejected)
    now = replace(state(3), believed_map_m=np.array([9.0, 8.0, 90.0]))
    made.predict(now)
    made.update(fix((30.0, 8.0, 90.0)), now)
    assert made.status is TrackerStatus.TRACK
    assert made.reset_counter == 1, "a new start, of which the autopilot hears"


def test_a_broken_chain_begins_anew_where_the_autopilot_believes_to_be():
    made = fixed(lost_sigma_m=100.0, unaided_speed_m_per_s=10.0)
    believed = np.array([50.0, 60.0, 100.0])
    close = made.predict(replace(state(9), believed_map_m=believed))
    assert np.allclose(close.map_from_camera.translation, (0, 0, 100)), "the chain of fixes is worth more"
    lost = made.predict(replace(state(20), believed_map_m=believed))
    assert np.allclose(lost.map_from_camera.translation, believed)
    assert made.status is TrackerStatus.SEARCH
    for worthless in (np.array([np.nan, 0, 0]), None):
        assert isinstance(made.predict(replace(state(20), believed_map_m=worthless)), Rejected)


def test_an_autopilot_that_may_have_followed_a_spoofer_says_not_where_to_look():
    made = fixed(lost_sigma_m=100.0, unaided_speed_m_per_s=10.0)
    for second in range(1, 12):
        led_away = state(second, (0, 0, 0), position=(60.0, 0.0, 100.0))
        made.predict(led_away)
        made.update(fix((0.0, 0.0, 100.0)), led_away)
    assert made.witness.report.state is Consistency.BAD
    believed = replace(state(23), believed_map_m=np.array([60.0, 0.0, 100.0]))
    assert isinstance(made.predict(believed), Rejected)


def test_ground_that_is_not_believed_gives_gnss_no_way_in():
    """Over a wood a fix says that it may be 2 m off. GNSS 7 m away, surer than that, still contradicts it."""
    made = tracker()
    start = state(0, (0, 0, 0), position=(0, 0, 100))
    made.predict(start)
    wide = np.zeros((6, 6))
    wide[:3, :3] = np.eye(3) * 4.0
    good = fix((0, 0, 100.0))
    made.update(replace(good, covariance=good.covariance + wide, ground_covariance=wide), start)
    prior = made.predict(state(0.5, (0, 0, 0), position=(7.0, 0, 100), sigma=(1.5, 2.5)))
    assert np.allclose(prior.map_from_camera.translation, (0, 0, 100))
    assert sigma_of(prior)[0] > 2.0, "the prediction itself is as unsure as the fix"


def test_before_the_first_fix_gnss_and_the_autopilots_own_position_take_turns():
    """Killed in flight while GNSS is spoofed: the autopilot has flown by our fixes."""
    made = tracker(believed_sigma_m=(20.0, 4.0))

    def spoofed(second):
        return replace(state(second, (0, 0, 0), position=(400.0, 0, 100)), believed_map_m=np.array([3.0, 0.0, 100.0]))

    found = [made.predict(spoofed(second)).map_from_camera.translation[0] for second in range(1, 7)]
    assert sorted(set(np.round(found))) == [3.0, 400.0]
    assert 2 <= found.count(3.0) <= 4
    made.update(fix((3.0, 0, 100.0)), spoofed(7))
    later = [made.predict(spoofed(second)).map_from_camera.translation[0] for second in (8, 9, 10)]
    assert np.allclose(later, 3.0), "the first fix decides"


def test_status_follows_the_outcomes():
    made = fixed()
    assert made.status is TrackerStatus.TRACK
    miss = Rejected(SECOND, Reason.FEW_MATCHES)
    made.predict(state(1, (0, 0, 0)))
    made.update(miss, state(1, (0, 0, 0)))
    assert made.status is TrackerStatus.COAST
    # A miss moves nothing: the last fix is still what is carried.
    assert np.allclose(made.predict(state(2, (7, 0, 0))).map_from_camera.translation, (0, 7, 100))
    made.update(fix((0, 7, 100)), state(2, (7, 0, 0)))
    assert made.status is TrackerStatus.TRACK


def test_reset_counter_rises_with_the_first_fix_and_with_jumps_only():
    made = fixed(jump_m=5.0)
    assert made.reset_counter == 1
    for seconds, at, want in [
        (1, (0.5, 0, 100), 1),  # as predicted
        (2, (4.5, 0, 100), 1),  # beyond three sigmas, but not beyond jump_m
        (3, (40.0, 0, 100), 2),  # both
        (4, (40.2, 0, 100), 2),
    ]:
        now = state(seconds, (0, 0, 0))
        made.predict(now)
        made.update(fix(at), now)
        assert made.reset_counter == want, at


def test_a_far_fix_within_the_uncertainty_is_no_jump():
    made = fixed(unaided_speed_m_per_s=15.0)
    now = state(3)
    made.predict(now)
    made.update(fix((60.0, 0, 100)), now)
    assert made.reset_counter == 1


def test_reset_counter_wraps_as_a_byte():
    made = fixed()
    made.reset_counter = 255
    now = state(1, (0, 0, 0))
    made.predict(now)
    made.update(fix((90.0, 0, 100)), now)
    assert made.reset_counter == 0


def test_convergence_and_grid_scale_apply_to_the_step():
    """2 km due true north and 50 m up from 11 E, 48 N."""
    start = state(0, (0, 0, 0), position=AT_UTM)
    made = tracker(UTM)
    made.predict(start)
    made.update(fix(AT_UTM), start)
    convergence = UTM.convergence_rad(AT_UTM[:2])
    assert np.degrees(convergence) == pytest.approx(1.486, abs=0.01)
    moved = made.predict(state(1, (2000.0, 0.0, -50.0))).map_from_camera.translation - AT_UTM
    scale = UTM.grid_scale(AT_UTM[:2], 600.0)
    assert scale < 0.9999
    # Grid north lies east of true north here, so true north is west on the grid.
    want = 2000 * scale * np.array([-np.sin(convergence), np.cos(convergence)])
    assert np.allclose(moved, [*want, 50.0], rtol=0, atol=1e-6)
    # The same place by way of the ellipsoid.
    before, after = UTM.geodetic_from_map(AT_UTM), UTM.geodetic_from_map(AT_UTM + moved)
    assert after.lon_deg == pytest.approx(before.lon_deg, abs=2e-6)
    metres = (after.lat_deg - before.lat_deg) * 111_170.0
    assert metres == pytest.approx(2000.0, rel=1e-3)


def test_heading_of_the_prior_is_on_the_grid():
    turn = rotation.from_euler(0.0, 0.0, np.radians(30.0))
    prior = tracker(UTM).predict(state(position=AT_UTM, attitude=turn))
    top_of_image = -prior.map_from_camera.rotation[:, 1]
    grid_yaw = np.degrees(np.arctan2(top_of_image[0], top_of_image[1]))
    assert grid_yaw == pytest.approx(30.0 - np.degrees(UTM.convergence_rad(AT_UTM[:2])), abs=1e-6)


@given(finite(-180, 180), finite(-20, 20), finite(-20, 20))
def test_lever_arm_goes_there_and_back(yaw, pitch, roll):
    """The fix is the camera's; the anchor is the body's; the next prior is the camera's again."""
    arm = Rigid3(frames.BODY_FROM_NADIR_CAMERA, [0.3, -0.1, 0.2])
    attitude = rotation.from_euler(*np.radians([roll, pitch, yaw]))
    made = tracker(body_from_camera=arm)
    now = state(0, (0, 0, 0), position=(10.0, 20.0, 100.0), attitude=attitude)
    prior = made.predict(now)
    body = np.array([10.0, 20.0, 100.0])
    assert np.allclose(
        prior.map_from_camera.translation, body + frames.ENU_FROM_NED @ attitude @ [0.3, -0.1, 0.2], atol=1e-9
    )
    camera = prior.map_from_camera
    made.update(fix(camera.translation, rotation_matrix=camera.rotation), now)
    again = made.predict(state(0, (0, 0, 0), attitude=attitude))
    assert np.allclose(again.map_from_camera.translation, camera.translation, atol=1e-9)
    # A turn of the vehicle swings the camera about the body.
    turned = rotation.from_euler(0, 0, np.pi) @ attitude
    swung = made.predict(state(0, (0, 0, 0), attitude=turned)).map_from_camera.translation
    assert np.allclose((swung + camera.translation)[:2] / 2, body[:2], atol=1e-9)


def test_a_rejection_before_any_fix_stays_a_search():
    made = tracker()
    now = state(position=(0, 0, 100))
    made.predict(now)
    made.update(Rejected(0, Reason.FEW_MATCHES), now)
    assert made.status is TrackerStatus.SEARCH


def test_the_last_gnss_position_is_carried_on_when_gnss_ends_before_the_first_fix():
    made = tracker()
    for second in range(5):
        prior = made.predict(state(second, (10.0 * second, 0, 0), position=(0, 10.0 * second, 100)))
        made.update(Rejected(second, Reason.FEW_MATCHES), state(second))
        assert isinstance(prior, PosePrior)
    prior = made.predict(state(6, (60.0, 0, 0)))
    assert isinstance(prior, PosePrior)
    # North 20 m since the last GNSS position at (0, 40).
    assert np.allclose(prior.map_from_camera.translation, (0, 60, 100), atol=1e-6)
    assert made.status is TrackerStatus.SEARCH


def test_a_spoofed_gnss_does_not_steer_away_from_the_fixes():
    made = fixed()
    prior = made.predict(state(3, (0, 0, 0), position=(60.0, 0, 100), sigma=(0.05, 0.05)))
    assert np.allclose(prior.map_from_camera.translation, (0, 0, 100))
    # Nor once it has been heard for a while.
    for second in range(4, 10):
        prior = made.predict(state(second, (0, 0, 0), position=(60.0, 0, 100), sigma=(0.05, 0.05)))
    assert np.allclose(prior.map_from_camera.translation, (0, 0, 100))


def test_gnss_comes_back_when_the_chain_has_grown_unsure():
    made = fixed(odometry_drift_m_per_s=1.0)
    prior = made.predict(state(40, (0, 0, 0), position=(60.0, 0, 100), sigma=(1.5, 2.5)))
    assert np.allclose(prior.map_from_camera.translation, (60, 0, 100))


def test_a_spoof_ramp_is_witnessed_and_then_steers_nothing():
    """1 m/s, while the vehicle stands still; when the fixes end too, GNSS is not where to look next."""
    made = fixed()
    for second in range(1, 40):
        here = state(second, (0, 0, 0), position=(float(max(second - 10, 0)), 0, 100), sigma=(1.5, 2.5))
        prior = made.predict(here)
        assert np.linalg.norm(prior.map_from_camera.translation[:2]) < 1.0
        made.update(fix((0.0, 0.0, 100.0), stamp_ns=second * SECOND), here)
        if second == 10:
            assert made.witness.report.state is Consistency.OK
    assert made.witness.report.state is Consistency.BAD
    assert 10 * SECOND < made.witness.report.since_ns < 25 * SECOND
    # Without odometry the chain grows by 15 m/s: GNSS would soon be the surer of the two.
    for second in range(40, 60):
        outcome = made.predict(state(second, position=(second - 10.0, 0, 100), sigma=(1.5, 2.5)))
        if isinstance(outcome, Rejected):
            assert outcome.reason is Reason.NO_PRIOR
            break
        assert np.linalg.norm(outcome.map_from_camera.translation[:2]) < 1.0
    else:
        raise AssertionError("the chain should have ended")
    # A minute without anything to compare: there is no better guess, and it has to match the map.
    again = made.predict(state(110, position=(100.0, 0, 100), sigma=(1.5, 2.5)))
    assert np.allclose(again.map_from_camera.translation, (100, 0, 100))


def test_another_life_begins_with_another_reset_counter():
    made = Tracker(LOCAL, NADIR, TrackerOptions(), first_reset_counter=1000)
    assert made.reset_counter == 1000 % 256
    made.announce_jump()
    assert made.reset_counter == 1000 % 256 + 1


# -- what it is told from outside ---------------------------------------------


def given_at(*position, seconds=0.0, sigma=(10.0, 4.0)):
    return GivenPosition(stamp_ns=round(seconds * SECOND), position_map_m=position, sigma_m=sigma)


def test_a_given_position_takes_the_place_of_the_chain_of_fixes():
    made = fixed()
    made.take(given_at(500.0, 0.0, 100.0, seconds=1.0))
    prior = made.predict(state(1.0, (0, 0, 0)))
    assert np.allclose(prior.map_from_camera.translation, (500, 0, 100))
    assert np.allclose(sigma_of(prior), (10, 10, 4))
    # From there the odometry carries it on as it does a fix: 20 m north.
    later = made.predict(state(2.0, (20, 0, 0)))
    assert np.allclose(later.map_from_camera.translation, (500, 20, 100))
    before = made.reset_counter
    made.update(fix((500.0, 20.0, 100.0)), state(2.0, (20, 0, 0)))
    assert made.reset_counter == (before + 1) % 256, "a new start for the autopilot"


def test_the_longer_ago_it_was_given_the_less_it_is_worth():
    """A frame without attitude is no use for it; meanwhile the vehicle flew on, nobody knows where to."""
    made = tracker(unaided_speed_m_per_s=15.0, unaided_climb_m_per_s=4.0)
    made.take(given_at(1.0, 2.0, 100.0))
    assert isinstance(made.predict(state(1.0, attitude=None)), Rejected)
    prior = made.predict(state(2.0))
    assert np.allclose(sigma_of(prior), (np.hypot(10, 30), np.hypot(10, 30), np.hypot(4, 8)))


@pytest.mark.parametrize(("gnss_east_m", "wins"), [(510.0, True), (700.0, False)])
def test_gnss_that_is_surer_improves_a_given_position_only_where_it_agrees(gnss_east_m, wins):
    made = fixed()
    made.take(given_at(500.0, 0.0, 100.0))
    prior = made.predict(state(0.0, (0, 0, 0), position=(gnss_east_m, 0, 100)))
    assert prior.map_from_camera.translation[0] == pytest.approx(gnss_east_m if wins else 500.0)


def test_relocalizing_forgets_the_fixes_and_asks_gnss():
    made = fixed()
    far = state(0.0, (0, 0, 0), position=(300, 0, 100))
    assert np.allclose(made.predict(far).map_from_camera.translation, (0, 0, 100)), "the chain of fixes holds"
    made.take(StartAnew(stamp_ns=0, trust_gnss=False))
    assert made.status is TrackerStatus.SEARCH
    assert np.allclose(made.predict(far).map_from_camera.translation, (300, 0, 100))
    made.take(given_at(1.0, 2.0, 100.0))
    made.take(StartAnew(stamp_ns=0, trust_gnss=False))
    assert isinstance(made.predict(state(1.0)), Rejected), "what was given before is forgotten, too"


def test_relocalizing_does_not_trust_a_gnss_that_was_found_bad_unless_told_so():
    made = fixed()
    for second in range(1, 40):
        made.predict(state(second, (0, 0, 0)))
        made.update(fix((0.0, 0.0, 100.0), stamp_ns=second * SECOND), state(second, (0, 0, 0), position=(300, 0, 100)))
    assert made.witness.report.state is Consistency.BAD
    spoofed = state(40.0, (0, 0, 0), position=(300, 0, 100))
    made.take(StartAnew(stamp_ns=40 * SECOND, trust_gnss=False))
    assert isinstance(made.predict(spoofed), Rejected)
    made.take(StartAnew(stamp_ns=40 * SECOND, trust_gnss=True))
    assert made.witness.report.state is Consistency.UNKNOWN
    assert np.allclose(made.predict(spoofed).map_from_camera.translation, (300, 0, 100))
