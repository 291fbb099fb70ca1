"""Smooth odometry: no jump when the map is corrected, dead reckoning while lost."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from companion.config import FeedbackConfig
from companion.estimation.body.body_filter import BodyFilter
from companion.estimation.body.reckoning import BodyAttitude
from companion.estimation.camera_motion import ImageVelocity
from companion.estimation.gate.pose_gate import PoseGate
from companion.estimation.inertial.acceleration_integral import AccelerationIntegral
from companion.estimation.lift_off.optical_flow import GroundVelocity
from companion.estimation.odometry.odometry_frame import MapView
from companion.estimation.odometry.smooth_odometry import SmoothOdometry
from companion.geometry.camera import Camera
from companion.geometry.transforms import Pose, Similarity, yaw_rotation
from companion.messages import Georeference, Odometry, Track, TrackState
from companion.telemetry import AttitudeSample, ImuSample

CAMERA = Camera(640, 480, 500.0, 500.0, 319.5, 239.5, body_from_camera=Pose.identity())
KNOWN = np.zeros(200, np.int64)
"""Keyframes at which the points of a frame were made: all of them before."""
OVER_ALL = np.random.default_rng(0).uniform(0.0, 480.0, (200, 2)).astype(np.float32)
"""Points (200, 2) all over the picture."""
PLACED = Georeference(Similarity(2.0, np.eye(3), np.zeros(3)), 0.01, 0.01, "GPS", 50, 0.3)
SPEED = 1.0
VELOCITY = ImageVelocity(np.array([SPEED, 0.0, 0.0]), 0.2)
"""Map units a second, northward; the world's are twice as many metres."""


def unaided() -> SmoothOdometry:
    """Odometry of a flight without accelerometers."""
    return SmoothOdometry(CAMERA, 1.0, BodyFilter(AccelerationIntegral()))


def track(k: int, off: float = 0.0, state: TrackState = TrackState.TRACKING) -> Track:
    pose = Pose(np.eye(3), np.array([SPEED * k / 10 + off, 0.0, -5.0]))
    found = state is TrackState.TRACKING
    return Track(
        k, k * 100_000_000, state, pose, 0, pose, 200 if found else 0, 220 if found else 0,
        OVER_ALL if found else None, sigma_position=0.01,
        sigma_rotation_rad=0.001,
    )  # fmt: skip


def give(odometry: SmoothOdometry, track: Track) -> Odometry:
    return odometry.step(track, 0, PLACED, VELOCITY, born=KNOWN)


def north(odometry: Odometry) -> float:
    assert odometry.world_from_body is not None
    return float(odometry.world_from_body.translation[0])


def test_a_camera_whose_mount_nobody_states_gives_no_pose_to_send() -> None:
    """One that looks straight down is as level as the body, its heading wrong by anything."""
    sent = []
    for camera in (replace(CAMERA, body_from_camera=None), CAMERA):
        odometry = SmoothOdometry(camera, 1.0, BodyFilter(AccelerationIntegral()))
        gate = PoseGate(FeedbackConfig(mode="odometry", min_quality=1))
        for k in range(60):
            gate.take_attitude(AttitudeSample(k * 100_000_000, np.array([1.0, 0.0, 0.0, 0.0])))
            found = give(odometry, track(k))
            assert found.world_from_body is not None
            gate.take(found, found.t_ns)
        sent.append((gate.sending, gate.why_not))
    assert sent == [(False, "camera mount is not known"), (True, "")]


def test_a_scale_that_is_uncertain_makes_the_velocity_so() -> None:
    odometry = unaided()
    for k in range(10):
        certain = give(odometry, track(k))
    doubted = replace(PLACED, sigma_scale=0.04)
    uncertain = odometry.step(track(10), 0, doubted, VELOCITY, born=KNOWN)
    by_scale_m_s = np.sqrt(uncertain.sigma_velocity_m_s**2 - certain.sigma_velocity_m_s**2)
    assert by_scale_m_s == pytest.approx(0.7 * np.sqrt(0.04**2 - 0.01**2) * 2 * SPEED, rel=0.02)


def test_map_correction_is_slew_limited() -> None:
    odometry = unaided()
    for k in range(10):
        before = give(odometry, track(k))
    last = track(9, off=1.5).map_from_camera
    assert last is not None
    odometry.correct_map(0, track(9).t_ns, last)
    after = [give(odometry, track(k, off=1.5)) for k in range(10, 400)]
    steps = np.diff([north(before), *[north(o) for o in after]])
    assert np.abs(steps - 0.2).max() < 0.03
    assert after[-1].reset_counter == 0
    assert north(after[-1]) == pytest.approx(2 * (39.9 + 1.5), abs=0.01)


def test_slew_correction_adds_to_the_drift_sigma() -> None:
    odometry = unaided()
    before = [give(odometry, track(k)) for k in range(200)][-1].sigma_position_m
    last = track(199, off=1.5).map_from_camera
    assert last is not None
    odometry.correct_map(0, track(199).t_ns, last)
    after = [give(odometry, track(k, off=1.5)).sigma_position_m for k in range(200, 600)]
    # three metres at 0.15 m/s: for twenty seconds each ten have 1.5 m of it
    assert max(after) == pytest.approx(np.hypot(before, 1.5 / np.sqrt(3)), rel=0.02)
    assert after[150] > 0.85 * max(after)
    assert after[-1] == pytest.approx(before, rel=0.02)


def test_heading_sigma_includes_the_pending_correction() -> None:
    """Heading corrections are slewed; until then the pose is off by the rest."""
    odometry = unaided()
    for k in range(10):
        before = give(odometry, track(k))
    noise_rad = 3 * 0.001
    floor_rad = np.radians(0.3)
    assert before.sigma_yaw_rad == pytest.approx(np.linalg.norm([0.01, noise_rad, floor_rad]))
    assert before.sigma_attitude_rad == pytest.approx(np.hypot(noise_rad, floor_rad))
    north_rad = np.radians(4.0)
    turned = Georeference(
        Similarity(2.0, yaw_rotation(north_rad), np.zeros(3)), 0.01, 0.002, "GPS", 90, 0.3
    )
    after = odometry.step(track(10), 0, turned, VELOCITY, born=KNOWN)
    assert after.world_from_body is not None
    assert abs(np.arctan2(*after.world_from_body.rotation[[1, 0], [0, 0]])) < np.radians(0.1)
    assert after.sigma_yaw_rad == pytest.approx(north_rad, rel=0.05)
    later = [odometry.step(track(k), 0, turned, VELOCITY, born=KNOWN) for k in range(11, 200)][-1]
    assert later.sigma_yaw_rad == pytest.approx(
        np.linalg.norm([0.002, noise_rad, floor_rad]), rel=0.01
    )


def test_unexplained_jump_is_a_reset() -> None:
    odometry = unaided()
    for k in range(10):
        give(odometry, track(k))
    after = [give(odometry, track(k, off=5.0)) for k in range(10, 20)]
    assert after[0].world_from_body is None
    assert after[-1].reset_counter == 1


def test_dead_reckoning_grows_uncertain_and_reacquires_without_a_jump() -> None:
    odometry = unaided()
    for k in range(10):
        give(odometry, track(k))
    dead_reckoned = []
    for k in range(10, 30):
        lost = replace(
            track(k, state=TrackState.DEAD_RECKONING), sigma_position=0.01 + 0.02 * (k - 9)
        )
        dead_reckoned.append(give(odometry, lost))
    assert [o.state for o in dead_reckoned] == [TrackState.DEAD_RECKONING] * 20
    assert {o.quality for o in dead_reckoned} == {1}
    assert (np.diff([o.sigma_position_m for o in dead_reckoned]) > 0).all()
    seen = [give(odometry, track(k, off=0.3)) for k in range(30, 40)]
    steps = np.diff([north(o) for o in [*dead_reckoned, *seen]])
    assert np.abs(steps - 0.2).max() < 0.03
    assert seen[-1].reset_counter == 0


def test_lost_camera_has_no_pose() -> None:
    odometry = unaided()
    assert odometry.without_frame(0, 0, BodyAttitude(0, np.eye(3))) is None
    give(odometry, track(0))
    assert odometry.without_frame(1, 50_000_000, BodyAttitude(50_000_000, np.eye(3))) is None
    lost = give(odometry, Track(1, 100_000_000, TrackState.LOST))
    assert lost.world_from_body is None
    assert lost.quality == -1


def test_what_a_reacquisition_was_off_by_is_slewed_away() -> None:
    odometry = unaided()
    for k in range(10):
        give(odometry, track(k))
    for k in range(10, 20):
        give(odometry, replace(track(k, state=TrackState.DEAD_RECKONING), sigma_position=0.1))
    seen = [give(odometry, track(k, off=0.3)) for k in range(20, 100)]
    truth = np.array([SPEED * 2.0 * k / 10 + 0.6 for k in range(20, 100)])
    away_m = truth - [north(o) for o in seen]
    assert away_m[0] == pytest.approx(0.6, abs=0.05)
    assert away_m[-1] == pytest.approx(0.0, abs=1e-6)
    assert np.abs(np.diff(away_m)).max() < 0.02


@pytest.mark.parametrize("pictures", [True, False])
def test_accelerometers_carry_the_pose_on(pictures: bool) -> None:
    """Where nothing is tracked, or no frame comes, the pose by the map cannot be known.

    A frame that comes when a pose was given for a later time already gives none.
    """
    integral = AccelerationIntegral()
    odometry = SmoothOdometry(CAMERA, 1.0, BodyFilter(integral))
    level = np.array([1.0, 0.0, 0.0, 0.0])
    found = []
    for k in range(200):
        for step in range(10):
            t_ns = (k * 10 + step - 9) * 10_000_000
            force = np.array([0.0, 0.0, -9.80665])
            integral.take(ImuSample(t_ns, np.zeros(3), force))
            integral.take(AttitudeSample(t_ns, level))
        attitude = BodyAttitude(k * 100_000_000, np.eye(3))
        blind = 100 <= k < 120
        if blind and not pictures:
            reckoned = odometry.without_frame(k, k * 100_000_000, attitude)
            assert reckoned is not None
            found.append(reckoned)
            late = replace(track(k), t_ns=k * 100_000_000 - 50_000_000)
            assert give(odometry, late).world_from_body is None
            continue
        odometry.begin(k * 100_000_000, attitude)
        seen = Track(k, k * 100_000_000, TrackState.LOST) if blind else track(k)
        found.append(give(odometry, seen))
    places = np.array([north(each) for each in found])
    assert np.abs(np.diff(places) - 0.2).max() < 0.02
    assert {each.state for each in found[100:120]} == {TrackState.DEAD_RECKONING}
    assert all(each.inertial == (100 <= k < 120) for k, each in enumerate(found))
    sigmas = [each.sigma_position_m for each in found[100:120]]
    assert sigmas[-1] > sigmas[0]
    assert {each.reset_counter for each in found} == {0}


@pytest.mark.parametrize(("sigmas", "n_refused"), [(3.0, 0), (6.0, 5)])
def test_a_map_seen_again_is_taken_at_once_where_dead_reckoning_may_have_been_so_far_off(
    sigmas: float, n_refused: int
) -> None:
    """Beyond, as after any jump, once half a second of it agrees; both are resets."""
    integral = AccelerationIntegral()
    odometry = SmoothOdometry(CAMERA, 1.0, BodyFilter(integral))
    found: list[Odometry] = []
    for k in range(180):
        for step in range(10):
            t_ns = (k * 10 + step - 9) * 10_000_000
            integral.take(ImuSample(t_ns, np.zeros(3), np.array([0.0, 0.0, -9.80665])))
            integral.take(AttitudeSample(t_ns, np.array([1.0, 0.0, 0.0, 0.0])))
        odometry.begin(k * 100_000_000, BodyAttitude(k * 100_000_000, np.eye(3)))
        blind = 100 <= k < 160
        off_m = 0.0 if k < 160 else sigmas * found[159].sigma_position_m
        seen = Track(k, k * 100_000_000, TrackState.LOST) if blind else track(k, 0.5 * off_m)
        found.append(give(odometry, seen))
    assert sigmas * found[159].sigma_position_m > 1.0
    again = [k for k, each in enumerate(found) if each.state is TrackState.TRACKING and k >= 160]
    assert again[0] == 160 + n_refused
    assert [found[159].reset_counter, found[again[0]].reset_counter] == [0, 1]
    assert found[-1].reset_counter == 1


def test_a_map_that_may_not_have_been_found_ends_no_dead_reckoning() -> None:
    """By a few points of one corner; where these hold for two seconds it was."""
    integral = AccelerationIntegral()
    odometry = SmoothOdometry(CAMERA, 1.0, BodyFilter(integral))
    corner = np.full((70, 2), 30.0, np.float32)
    found = []
    for k in range(160):
        for step in range(10):
            t_ns = (k * 10 + step - 9) * 10_000_000
            integral.take(ImuSample(t_ns, np.zeros(3), np.array([0.0, 0.0, -9.80665])))
            integral.take(AttitudeSample(t_ns, np.array([1.0, 0.0, 0.0, 0.0])))
        odometry.begin(k * 100_000_000, BodyAttitude(k * 100_000_000, np.eye(3)))
        seen = track(k)
        if 100 <= k < 120:
            seen = Track(k, k * 100_000_000, TrackState.LOST)
        elif k >= 120:
            off = 0.2 if k < 130 else 0.0
            seen = replace(track(k, off), n_inliers=70, n_matches=80, keypoints_px=corner)
        found.append(give(odometry, seen))
        assert odometry.found_again.certain is (k < 100 or k > 139)
    assert all(each.inertial == (100 <= k < 140) for k, each in enumerate(found))
    assert np.abs(np.diff([north(each) for each in found]) - 0.2).max() < 0.03


def test_inertial_navigation_learns_by_how_much_it_was_off() -> None:
    """Where the map is seen again; the pose goes on all the same."""
    integral = AccelerationIntegral()
    odometry = SmoothOdometry(CAMERA, 1.0, BodyFilter(integral))
    found = []
    for k in range(135):
        for step in range(10):
            t_ns = (k * 10 + step - 9) * 10_000_000
            wrong_m_s2 = 0.03 if k > 100 else 0.0
            integral.take(ImuSample(t_ns, np.zeros(3), np.array([wrong_m_s2, 0.0, -9.80665])))
            integral.take(AttitudeSample(t_ns, np.array([1.0, 0.0, 0.0, 0.0])))
        odometry.begin(k * 100_000_000, BodyAttitude(k * 100_000_000, np.eye(3)))
        blind = Track(k, k * 100_000_000, TrackState.LOST)
        found.append(give(odometry, blind if 100 <= k < 130 else track(k)))
    assert np.abs(np.diff([north(each) for each in found]) - 0.2).max() < 0.03
    velocities = np.array([each.velocity_world_m_s for each in found], np.float64)
    off_m_s = np.abs(velocities[:, 0] - 2.0 * SPEED)
    assert off_m_s[129] > 0.07 and off_m_s[131:].max() < 0.04


@pytest.mark.parametrize(("scale", "is_taken"), [(1.0, True), (1.1, True), (2.0, False)])
def test_another_map_goes_on_from_where_accelerometers_had_its_first_view(
    scale: float, is_taken: bool
) -> None:
    """Its scale is known two seconds later only, and the body has moved on by 4 m.

    It is not taken if both differ by more than the gate allows, and accelerometers know better.
    """
    integral = AccelerationIntegral()
    odometry = SmoothOdometry(CAMERA, 1.0, BodyFilter(integral))
    level, placed = np.array([1.0, 0.0, 0.0, 0.0]), replace(PLACED, has_origin=False)
    known: Georeference | None = placed
    found, first = [], Pose(np.eye(3), np.array([50.0, 0.0, 7.0]))
    for k in range(200):
        for step in range(10):
            t_ns = (k * 10 + step - 9) * 10_000_000
            integral.take(ImuSample(t_ns, np.zeros(3), np.array([0.0, 0.0, -9.80665])))
            integral.take(AttitudeSample(t_ns, level))
        odometry.begin(k * 100_000_000, BodyAttitude(k * 100_000_000, np.eye(3)))
        if k < 100:
            seen, map_number = track(k), 0
        elif k < 120:
            seen, map_number = Track(k, k * 100_000_000, TrackState.LOST), 0
        else:  # a map of half the scale; its georeference comes late
            at = first.translation + [2.0 * SPEED * (k - 120) / 10, 0.0, 0.0]
            seen, map_number = replace(track(k), map_from_camera=Pose(np.eye(3), at)), 120
            half = replace(placed, world_from_map=Similarity(scale, np.eye(3), np.zeros(3)))
            known = half if k >= 140 else None
        view = MapView(12_000_000_000, first) if map_number else None
        found.append(odometry.step(seen, map_number, known, VELOCITY, view, KNOWN))
    places = np.array([north(each) for each in found])
    steps = np.diff(places) - 0.2
    assert np.abs(steps[:139]).max() < 0.05
    assert abs(steps[139]) < 0.05
    assert np.abs(steps[140:] - 0.2 * (scale - 1.0) * is_taken).max() < 0.05
    assert found[139].inertial and found[140].inertial is not is_taken
    assert found[-1].reset_counter == 0


@pytest.mark.parametrize("flow", [False, True])
def test_a_vehicle_that_lifts_off_is_carried_on_by_accelerometers(flow: bool) -> None:
    """It stands, climbs by 1 m/s2 for 2 s, and no map is known yet; lift-off shows 0.4 s late.

    Optical flow over the ground that it stood on makes its place more certain, beside a barometer
    that is heard at the times of the same frames.
    """
    integral = AccelerationIntegral()
    odometry = SmoothOdometry(CAMERA, 1.0, BodyFilter(integral))
    level, lift_s, found = np.array([1.0, 0.0, 0.0, 0.0]), 3.0, []
    for k in range(60):
        for step in range(10):
            ms = (k * 10 + step - 9) * 10
            up_m_s2 = 1.0 if lift_s * 1000 <= ms else 0.0
            force = np.array([0.1, -0.05, 0.08 - 9.80665 - up_m_s2])  # with its bias
            integral.take(ImuSample(ms * 1_000_000, np.zeros(3), force))
            integral.take(AttitudeSample(ms * 1_000_000, level))
        t_ns = k * 100_000_000
        standing = 10 <= k < 34
        if flow:
            odometry.ground.take_height(
                t_ns, 100.0 + 0.5 * max(k / 10 - lift_s, 0.0) ** 2, rotors=False
            )
        if k == 20:  # that it stands takes a picture to say
            assert odometry.without_frame(1000, t_ns, BodyAttitude(t_ns, np.eye(3))) is None
        odometry.begin(t_ns, BodyAttitude(t_ns, np.eye(3)), standing)
        waiting = Track(k, t_ns, TrackState.INITIALISING)
        found.append(odometry.step(waiting, 0, None, None))
        assert odometry.ground.wants_flow(t_ns) == (k >= 34)
        if flow and k >= 34:
            climbed_s = k / 10 - 0.05 - lift_s
            flow_hz = np.array([0.0, 0.0, -climbed_s / (0.2 + 0.5 * climbed_s**2)])
            measured = GroundVelocity(t_ns - 50_000_000, flow_hz, 4e-4 * np.eye(3))
            odometry.ground.take_flow(measured, 0)
    assert {each.quality for each in found[:10]} == {-1}
    stood = found[10:34]
    assert {each.state for each in stood} == {TrackState.STANDING}
    given = [each for each in stood if each.world_from_body is not None]
    assert len(given) > 15 and given == stood[-len(given) :]
    assert all(np.abs(each.world_from_body.translation).max() < 1e-9 for each in given)  # type: ignore[union-attr]
    assert {each.sigma_position_m for each in given} == {0.02}
    flown = found[34:]
    assert {(each.state, each.inertial) for each in flown} == {(TrackState.DEAD_RECKONING, True)}
    downs = np.array([each.world_from_body.translation[2] for each in flown])  # type: ignore[union-attr]
    true = np.array([-0.5 * (k / 10 - lift_s) ** 2 for k in range(34, 60)])
    assert np.abs(downs - true).max() < 0.1
    assert flown[-1].sigma_position_m < (0.15 if flow else 0.5)
    assert flown[-1].sigma_position_m > 0.03
    assert {each.reset_counter for each in found} == {0}
