"""Stands and blind spans of the smooth odometry: nothing stale is stated as certain."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from companion.estimation.body.body_filter import BodyFilter
from companion.estimation.body.reckoning import BodyAttitude
from companion.estimation.camera_motion import ImageVelocity
from companion.estimation.inertial.acceleration_integral import AccelerationIntegral
from companion.estimation.odometry.odometry_frame import MapView
from companion.estimation.odometry.smooth_odometry import SmoothOdometry
from companion.geometry.camera import Camera
from companion.geometry.transforms import (
    Array,
    Pose,
    Similarity,
    yaw_angle,
    yaw_rotation,
)
from companion.messages import Georeference, Odometry, Track, TrackState
from companion.telemetry import AttitudeSample, ImuSample

CAMERA = Camera(640, 480, 500.0, 500.0, 319.5, 239.5, body_from_camera=Pose.identity())
KNOWN = np.zeros(200, np.int64)
"""Keyframes at which the points of a frame were made: all of them before."""
PLACED = Georeference(
    Similarity(1.0, np.eye(3), np.zeros(3)), 0.01, 0.01, "IMU", 0, 0.0, has_origin=False
)
HERE = np.array([3.0, 2.0, -10.0])
STEP_NS = 100_000_000
LEVEL = np.array([1.0, 0.0, 0.0, 0.0])
SPREAD_PX = np.random.default_rng(0).uniform(0.0, [640.0, 480.0], (200, 2)).astype(np.float32)


class Vehicle:
    """It hovers, level, or stands; ten frames a second."""

    def __init__(self, has_imu: bool = True) -> None:
        self._integral = AccelerationIntegral()
        navigation = BodyFilter(self._integral)
        self.odometry = SmoothOdometry(CAMERA, 1.0, navigation, min_quality=20)
        self._has_imu = has_imu
        self.t_ns = 0

    def frame(
        self, at_m: Array | None = None, *, standing: bool = False, attitude: bool = True,
        segment: int = 0, georeference: Georeference = PLACED, north_m_s2: float = 0.0,
        world_m: Array | None = None, n_points: int = 200,
        first: MapView | None = None, heading_rad: float = 0.0,
    ) -> Odometry:  # fmt: skip
        """The next frame, tracked at a place (3,) in the map, or lost; `world_m` by satellites."""
        self.t_ns += STEP_NS
        for step in range(-9, 1) if self._has_imu else ():
            t_ns = self.t_ns + step * 10_000_000
            self._integral.take(ImuSample(t_ns, np.zeros(3), np.array([north_m_s2, 0.0, -9.80665])))
            self._integral.take(AttitudeSample(t_ns, LEVEL))
        known = BodyAttitude(self.t_ns, yaw_rotation(heading_rad)) if attitude else None
        self.odometry.begin(self.t_ns, known, standing, world_m)
        track = Track(self.t_ns // STEP_NS, self.t_ns, TrackState.LOST)
        if at_m is not None:
            pose = Pose(np.eye(3), np.array(at_m))
            track = replace(
                track, state=TrackState.TRACKING, map_from_camera=pose, n_inliers=n_points,
                n_matches=220, keypoints_px=SPREAD_PX, sigma_position=0.01,
                sigma_rotation_rad=0.001,
            )  # fmt: skip
        return self.odometry.step(
            track, segment, georeference, ImageVelocity(np.zeros(3), 0.2), first, KNOWN
        )

    def frames(self, n: int, at_m: Array | None = None, *, standing: bool = False) -> Odometry:
        """So many frames alike; the last odometry."""
        return [self.frame(at_m, standing=standing) for _ in range(n)][-1]


def place(odometry: Odometry) -> Array:
    assert odometry.world_from_body is not None
    return odometry.world_from_body.translation


def test_a_stand_where_it_was_tracked_goes_on() -> None:
    vehicle = Vehicle()
    vehicle.frames(20, HERE)
    stood = vehicle.frames(20, HERE, standing=True)
    assert (stood.state, stood.reset_counter) == (TrackState.STANDING, 0)
    np.testing.assert_allclose(place(stood), HERE, atol=0.05)


def test_the_first_stand_has_a_pose_once_accelerometers_could_carry_it_on() -> None:
    vehicle = Vehicle()
    first = vehicle.frame(standing=True)
    assert first.state is TrackState.STANDING and first.world_from_body is None
    np.testing.assert_allclose(place(vehicle.frames(10, standing=True)), 0.0, atol=1e-9)
    without = Vehicle(has_imu=False)
    stood = without.frames(100, standing=True)
    assert stood.state is TrackState.STANDING and stood.world_from_body is None


BY_SATELLITES = np.array([12.0, -7.0, -3.0])
IN_WORLD = replace(PLACED, method="GPS", has_origin=True)


@pytest.mark.parametrize(("away_m", "n_resets"), [(0.6, 0), (3.0, 1)])
def test_a_map_that_satellites_place_goes_on_from_a_stand_there(
    away_m: float, n_resets: int
) -> None:
    vehicle = Vehicle()
    for _ in range(20):
        stood = vehicle.frame(standing=True, world_m=BY_SATELLITES)
    np.testing.assert_allclose(place(stood), BY_SATELLITES, atol=1e-6)
    vehicle.frames(10)
    seen_m = BY_SATELLITES + [away_m, 0.0, 0.0]
    first = vehicle.frame(seen_m, georeference=IN_WORLD)
    assert first.reset_counter == n_resets
    begun_m = seen_m if n_resets else BY_SATELLITES
    np.testing.assert_allclose(place(first), begun_m, atol=0.05)
    for _ in range(80):
        last = vehicle.frame(seen_m, georeference=IN_WORLD)
    assert last.reset_counter == n_resets
    np.testing.assert_allclose(place(last), seen_m, atol=0.05)


def test_satellites_that_come_while_it_stands_move_it_once_with_a_reset() -> None:
    vehicle = Vehicle()
    assert vehicle.frames(20, standing=True).world_from_body is not None
    for k in range(20):
        moved_m = BY_SATELLITES + [0.1 * k, 0.0, 0.0]
        stood = vehicle.frame(standing=True, world_m=moved_m)
    assert stood.reset_counter == 1
    np.testing.assert_allclose(place(stood), BY_SATELLITES, atol=1e-6)


def test_a_landing_without_sight_is_a_reset() -> None:
    """Inertial navigation has become too uncertain, and poses have ceased."""
    vehicle = Vehicle()
    vehicle.frames(20, HERE)
    assert vehicle.frames(600).world_from_body is None
    stood = vehicle.frames(20, standing=True)
    assert (stood.state, stood.reset_counter) == (TrackState.STANDING, 1)


def test_a_landing_of_which_the_place_is_uncertain_is_a_reset() -> None:
    vehicle = Vehicle()
    vehicle.frames(20, HERE)
    n_blind = 0
    while vehicle.frame().sigma_position_m < 1.0:
        n_blind += 1
    assert n_blind > 10
    stood = vehicle.frames(20, standing=True)
    assert (stood.state, stood.reset_counter) == (TrackState.STANDING, 1)


def test_what_it_does_not_know_of_where_it_landed_is_stated() -> None:
    vehicle = Vehicle()
    vehicle.frames(20, HERE)
    while (blind := vehicle.frame()).sigma_position_m < 0.15:
        pass
    stood = vehicle.frames(20, standing=True)
    assert stood.reset_counter == 0
    assert abs(stood.sigma_position_m - blind.sigma_position_m) < 0.05


@pytest.mark.parametrize("has_imu", [True, False])
def test_a_landing_is_as_certain_as_the_way_to_it_and_then_forgets_that(has_imu: bool) -> None:
    vehicle = Vehicle(has_imu)
    for k in range(60):
        landed = vehicle.frame(HERE + [0.2 * k, 0.0, 0.0])
    scale_m = 11.8 * PLACED.sigma_scale
    stood = vehicle.frame(HERE + [11.8, 0.0, 0.0], standing=True)
    assert stood.reset_counter == 0
    assert 0.5 * scale_m < stood.sigma_by_scale_m < scale_m
    assert abs(stood.sigma_position_m - landed.sigma_position_m) < 0.03
    later = vehicle.frames(120, standing=True)
    assert later.sigma_by_scale_m == 0.0 and 0.02 < later.sigma_position_m < 0.06


@pytest.mark.parametrize("has_imu", [True, False])
def test_a_few_points_at_the_edge_of_a_map_give_way_to_accelerometers(has_imu: bool) -> None:
    vehicle = Vehicle(has_imu)
    vehicle.frames(20, HERE)
    for k in range(10):
        poor = vehicle.frame(HERE + [0.03 * k, 0.0, 0.0], n_points=5)
    assert poor.inertial is has_imu
    assert abs(place(poor)[0] - HERE[0] - 0.27 * (not has_imu)) < 0.05


def test_a_frame_without_attitude_ends_no_stand() -> None:
    """Before there is a map: it has come from where it stood first by accelerometers alone."""
    vehicle = Vehicle()
    vehicle.frames(20, standing=True)
    for k in range(10):
        vehicle.frame(north_m_s2=1.0 if k < 5 else -1.0)
    there = place(vehicle.frames(20, standing=True))
    assert 0.2 < there[0] < 0.3
    assert vehicle.frame(standing=True, attitude=False).world_from_body is None
    stood = vehicle.frame(standing=True)
    np.testing.assert_allclose(place(stood), there, atol=0.05)
    assert stood.reset_counter == 0


def test_a_map_that_is_elsewhere_after_a_stand_is_a_reset() -> None:
    vehicle = Vehicle(has_imu=False)
    vehicle.frames(20, HERE)
    vehicle.frames(100, HERE, standing=True)
    after = [vehicle.frame(HERE + [40.0, 0.0, 0.0]) for _ in range(10)]
    assert after[0].world_from_body is None
    assert after[-1].reset_counter == 1


def test_a_correction_of_the_map_moves_no_refused_frame_through_the_gate() -> None:
    vehicle = Vehicle(has_imu=False)
    vehicle.frames(20, HERE)
    wrong = HERE + [10.0, 0.0, 0.0]
    assert vehicle.frame(wrong).world_from_body is None
    moved = Pose(np.eye(3), wrong + [0.0, 0.01, 0.0])
    vehicle.odometry.correct_map(0, vehicle.t_ns, moved)
    assert vehicle.frame(wrong).world_from_body is None
    assert vehicle.frames(10, wrong).reset_counter == 1


def test_a_correction_of_another_map_moves_nothing() -> None:
    vehicle = Vehicle(has_imu=False)
    before = vehicle.frames(20, HERE)
    vehicle.odometry.correct_map(7, vehicle.t_ns, Pose(np.eye(3), np.zeros(3)))
    np.testing.assert_allclose(place(vehicle.frame(HERE)), place(before), atol=1e-9)


def test_a_map_without_a_scale_is_not_taken_up_by_a_frame_without_attitude() -> None:
    vehicle = Vehicle()
    vehicle.frames(20, HERE)
    young = replace(PLACED, sigma_scale=0.2)
    vehicle.frame(np.zeros(3), segment=5, georeference=young)
    vehicle.frame(np.zeros(3), segment=5, georeference=young, attitude=False)
    found = vehicle.frame(np.zeros(3), segment=5, georeference=young)
    assert found.inertial and found.reset_counter == 0
    np.testing.assert_allclose(place(found), HERE, atol=0.1)


def test_a_scale_that_grows_uncertain_again_interrupts_nothing() -> None:
    """Of a map that is flown on: poses with a scale off by more than 5 % are not sent."""
    vehicle = Vehicle()
    vehicle.frames(20, HERE)
    found = vehicle.frame(HERE, georeference=replace(PLACED, sigma_scale=0.055))
    assert found.inertial and found.sigma_scale <= 0.05
    np.testing.assert_allclose(place(found), HERE, atol=0.05)
    again = vehicle.frame(HERE, georeference=replace(PLACED, sigma_scale=0.045))
    assert (again.state, again.reset_counter) == (TrackState.TRACKING, 0)


def test_one_wrong_relocalisation_while_blind_is_no_reset_later() -> None:
    vehicle = Vehicle()
    vehicle.frames(20, HERE)
    vehicle.frames(5)
    np.testing.assert_allclose(place(vehicle.frame(HERE + [10.0, 0.0, 0.0])), HERE, atol=0.1)
    vehicle.frames(10)
    seen = vehicle.frame(HERE)
    assert (seen.state, seen.reset_counter) == (TrackState.TRACKING, 0)
    np.testing.assert_allclose(place(seen), HERE, atol=0.1)


def test_a_map_that_was_tilted_leaves_a_doubt_about_place_and_velocity() -> None:
    """What has flown ten metres on a map tilted by 6 degrees is a metre off."""
    vehicle = Vehicle()
    for k in range(21):
        vehicle.frame(HERE + [0.5 * k, 0.0, 0.0])
    before = vehicle.frame()
    vehicle.odometry.discard_map(0, float(np.radians(6.0)))
    doubted = vehicle.frame()
    assert before.sigma_position_m < 0.2
    assert 1.0 < doubted.sigma_position_m < 3.0
    vehicle.odometry.discard_map(1, float(np.radians(40.0)))  # another map
    assert vehicle.frame().sigma_position_m < 3.5


def test_a_map_is_flown_on_once_it_has_settled() -> None:
    """Until then it bends: here it says that a vehicle which hovers goes away at 0.3 m/s."""
    vehicle = Vehicle()
    vehicle.frames(20, standing=True)
    vehicle.frames(5)
    first = MapView(vehicle.t_ns, Pose(np.eye(3), HERE))
    for k in range(19):
        young = vehicle.frame(HERE + [0.03 * k, 0.0, 0.0], first=first)
        assert young.inertial
    np.testing.assert_allclose(place(young), 0.0, atol=0.05)
    settled = vehicle.frame(HERE, first=first, heading_rad=0.2)
    assert settled.state is TrackState.TRACKING and settled.reset_counter == 0
    np.testing.assert_allclose(place(settled), 0.0, atol=0.05)
    # its heading is that of its first view: the autopilot's swings
    assert settled.world_from_body is not None
    assert abs(yaw_angle(settled.world_from_body.rotation)) < 1e-6


def test_a_map_whose_scale_is_worse_than_inertial_navigation_is_not_slewed_to() -> None:
    """It says that 9 m were 5 % more, with 4.5 % stated; accelerometers that stood know better."""
    vehicle = Vehicle()
    vehicle.frames(20, standing=True)
    vehicle.frames(5)
    first = MapView(vehicle.t_ns, Pose(np.eye(3), HERE))
    for north_m_s2 in (4.0, -4.0):
        for _ in range(15):
            before = vehicle.frame(north_m_s2=north_m_s2)
    way_m = float(place(before)[0])
    assert 8.5 < way_m < 9.5
    uncertain = replace(PLACED, sigma_scale=0.045)
    for _ in range(40):
        seen_m = HERE + [1.05 * way_m, 0.0, 0.0]
        after = vehicle.frame(seen_m, first=first, georeference=uncertain)
    assert after.state is TrackState.TRACKING and after.reset_counter == 0
    assert abs(float(place(after)[0]) - way_m) < 0.25


def test_a_map_that_contradicts_inertial_navigation_is_not_flown_on() -> None:
    """As one of a camera that sits otherwise than stated; it would be a jump of six metres."""
    vehicle = Vehicle()
    vehicle.frames(20, standing=True)
    first = MapView(vehicle.t_ns + STEP_NS, Pose(np.eye(3), HERE))
    vehicle.frames(25)
    for _ in range(20):
        wrong = vehicle.frame(HERE + [6.0, 0.0, 0.0], first=first)
        assert wrong.inertial and wrong.reset_counter == 0
    np.testing.assert_allclose(place(wrong), 0.0, atol=0.1)
    while vehicle.frame().sigma_position_m < 2.0:
        pass
    found = vehicle.frame(HERE + [6.0, 0.0, 0.0], first=first)
    assert found.state is TrackState.TRACKING and found.reset_counter == 1


@pytest.mark.parametrize(
    ("away_m", "n_frames", "frames", "turns"),
    [(0.5, 120, 1, True), (6.0, 120, 1, False), (0.5, 220, 1, False), (0.5, 120, 5, False)],
)
def test_after_lift_off_it_follows_a_step_of_the_autopilots_heading(
    away_m: float, n_frames: int, frames: int, turns: bool
) -> None:
    """Not far from there, nor later; nor a heading that drifts, which would drift with ours."""
    vehicle, aligned_rad = Vehicle(), np.radians(3.0)
    stood = place(vehicle.frames(20, standing=True))
    first = MapView(vehicle.t_ns + STEP_NS, Pose(np.eye(3), np.zeros(3)))
    vehicle.frames(20)
    gone = 0.5 - 0.5 * np.cos(np.linspace(0.0, np.pi, n_frames))
    gains_m_s2 = away_m * np.diff(gone, 2, prepend=(0.0, 0.0)) / (STEP_NS * 1e-9) ** 2
    for share, gain_m_s2 in zip(gone, gains_m_s2, strict=True):
        at_m = share * np.array([away_m, 0.0, -0.5])
        up = vehicle.frame(at_m, first=first, north_m_s2=gain_m_s2)
    away = place(up) - stood
    headings_rad, places = [], []
    for k in range(80):
        found = vehicle.frame(at_m, heading_rad=aligned_rad * min(1.0, (k + 1) / frames))
        assert found.world_from_body is not None
        headings_rad.append(yaw_angle(found.world_from_body.rotation))
        places.append(place(found) - stood)
    assert np.abs(np.diff(headings_rad)).max() < np.radians(0.06)
    assert found.reset_counter == 0
    if turns:
        assert headings_rad[-1] == pytest.approx(aligned_rad, abs=1e-6)
        np.testing.assert_allclose(places[-1], yaw_rotation(headings_rad[-1]) @ away, atol=0.01)
    else:
        assert headings_rad == pytest.approx(np.zeros(80), abs=1e-6)
        np.testing.assert_allclose(places[-1], away, atol=0.01)


def test_after_lift_off_a_heading_that_swings_is_followed_to_its_mean() -> None:
    """As PX4's after it aligned anew: 14 degrees to one side, back within seconds."""
    vehicle, settles_rad = Vehicle(), np.radians(2.0)
    vehicle.frames(20, standing=True)
    first = MapView(vehicle.t_ns + STEP_NS, Pose(np.eye(3), np.zeros(3)))
    vehicle.frames(20)
    for _ in range(10):
        vehicle.frame(np.zeros(3), first=first)
    for k in range(140):
        swing_rad = np.radians(14.0) * np.exp(-k / 20.0) * np.cos(k / 8.0)
        found = vehicle.frame(np.zeros(3), heading_rad=settles_rad + swing_rad)
    assert found.world_from_body is not None
    assert yaw_angle(found.world_from_body.rotation) == pytest.approx(settles_rad, abs=0.01)


@pytest.mark.parametrize(("segment", "away_m"), [(5, 0.0), (0, 0.5)])
def test_what_dead_reckoning_may_be_off_by_is_stated_of_the_map_that_takes_over(
    segment: int, away_m: float
) -> None:
    """A new map knows nothing of the way before it; one that is seen again shows what it was."""
    vehicle = Vehicle()
    known = vehicle.frames(20, HERE)
    blind = vehicle.frames(45)
    assert blind.inertial and blind.sigma_position_m > 0.25
    first = MapView(vehicle.t_ns, Pose.identity()) if segment else None
    there_m = np.zeros(3) if segment else HERE + [away_m, 0.0, 0.0]
    while (found := vehicle.frame(there_m, segment=segment, first=first)).inertial:
        pass
    assert found.reset_counter == 0
    stated_m = away_m / np.sqrt(3.0) if away_m else blind.sigma_position_m
    assert 0.9 * stated_m < found.sigma_position_m < 2.0 * stated_m
    for _ in range(150):  # until that is longer ago than what is stated is of
        last = vehicle.frame(there_m, segment=segment, first=first)
    assert last.sigma_position_m < known.sigma_position_m + 0.02


def test_a_map_is_a_reset_where_dead_reckoning_before_it_may_be_a_jump_off() -> None:
    """Poses go on from its place, as certain as the map."""
    vehicle = Vehicle()
    vehicle.frames(20, HERE)
    while (blind := vehicle.frame()).sigma_position_m < 1.2:
        pass
    first = MapView(vehicle.t_ns, Pose.identity())
    found = vehicle.frame(np.zeros(3), segment=5, first=first)
    assert not found.inertial and found.reset_counter == blind.reset_counter + 1
    assert found.sigma_position_m < 0.1
    np.testing.assert_allclose(place(found), place(blind), atol=0.05)


def test_a_rough_map_is_flown_on_where_dead_reckoning_is_worse() -> None:
    """Once it is two seconds old: another that was left may be seen again, and young ones bend."""
    vehicle = Vehicle()
    vehicle.frames(20, HERE)
    lost = vehicle.frames(60)
    assert lost.inertial and lost.sigma_position_m > 1.0
    rough, first = replace(PLACED, sigma_scale=0.08), MapView(vehicle.t_ns, Pose.identity())
    found = [
        vehicle.frame(np.zeros(3), segment=5, georeference=rough, first=first) for _ in range(40)
    ]
    assert all(each.inertial for each in found[:18])
    assert all(each.state is TrackState.TRACKING for each in found[22:])
    assert found[-1].sigma_scale == rough.sigma_scale
    again = vehicle.frame()
    assert again.inertial and again.sigma_scale == rough.sigma_scale
    assert again.sigma_position_m < lost.sigma_position_m


def test_dead_reckoning_that_can_be_sent_goes_on_in_a_rough_map() -> None:
    """Another, or the one that was flown on: no pose by its scale would be sent."""
    vehicle = Vehicle()
    vehicle.frames(20, HERE)
    lost = vehicle.frames(40)
    assert lost.inertial and 0.5 < lost.sigma_position_m < 0.9
    rough = replace(PLACED, sigma_scale=0.08)
    first = MapView(vehicle.t_ns - 3 * 10**9, Pose.identity())
    for segment in (5, 0):
        found = vehicle.frame(HERE, segment=segment, georeference=rough, first=first)
        assert found.inertial and found.sigma_scale < 0.05


@pytest.mark.parametrize(("frames", "lost"), [(1, ()), (1, (6,)), (20, ())])
def test_after_lift_off_a_step_of_the_heading_in_a_young_map_is_followed(
    frames: int, lost: tuple[int, ...]
) -> None:
    """ArduPilot's is at two to three metres; what drifts is not followed.

    A frame may be missing as it comes.
    """
    vehicle, aligned_rad = Vehicle(), np.radians(3.0)
    vehicle.frames(20, standing=True)
    vehicle.frames(10)
    first = MapView(vehicle.t_ns + STEP_NS, Pose(np.eye(3), np.zeros(3)))
    for k in range(80):
        heading_rad = aligned_rad * np.clip((k - 5) / frames, 0.0, 1.0)
        seen_m = None if k in lost else np.zeros(3)
        found = vehicle.frame(seen_m, first=first, heading_rad=heading_rad)
        assert found.inertial == (k < 20)
    assert found.world_from_body is not None and found.reset_counter == 0
    followed_rad = yaw_angle(found.world_from_body.rotation)
    assert followed_rad == pytest.approx(aligned_rad if frames == 1 else 0.0, abs=0.01)
