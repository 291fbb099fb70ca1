"""Motion of the camera in its map: its next pose, and what corrections of the map do to it."""

from __future__ import annotations

import numpy as np
import pytest

from companion.estimation.camera_motion import CameraMotion
from companion.geometry.camera import Camera, Distortion
from companion.geometry.transforms import Pose, angle_between, rotation_from_vector, yaw_rotation
from companion.messages import Track, TrackState
from companion.slam.features.orb_features import features_of
from companion.slam.map.seen import Seen
from companion.slam.map.sparse_map import Keyframe, SlamMap

STEP_NS = 50_000_000


def keyframe_at(keyframe_id: int, map_from_camera: Pose) -> Keyframe:
    """A keyframe that has seen nothing."""
    camera = Camera(640, 480, 500.0, 500.0, 319.5, 239.5, Distortion.NONE, ())
    none, ids = np.zeros((0, 2), np.float32), np.zeros(0, np.int64)
    features = features_of(
        camera, 1.2, none, camera.normalise(none), ids, np.zeros(0, np.float32),
        np.zeros((0, 32), np.uint8),
    )  # fmt: skip
    return Keyframe(
        keyframe_id, 0, 0, map_from_camera.inverse(),
        Seen(features, none.astype(np.float64), np.zeros((0, 2, 2))), ids, ids,
    )  # fmt: skip


def path(k: int) -> Pose:
    turn = rotation_from_vector(np.array([0.0, 0.01 * k, 0.02 * k]))
    return Pose(turn, np.array([0.05 * k, -0.02 * k, 0.01 * k]))


@pytest.mark.parametrize("attitude", [False, True], ids=["without attitude", "with attitude"])
def test_constant_motion_is_predicted(attitude: bool) -> None:
    motion = CameraMotion()
    offset = yaw_rotation(0.3)  # the autopilot's heading is wrong, but steadily so

    def ned(k: int) -> np.ndarray | None:
        return offset @ path(k).rotation if attitude else None

    for k in range(20):
        motion.correct(k * STEP_NS, path(k), ned(k))
    predicted = motion.carried_on(20 * STEP_NS, ned(20))
    assert predicted is not None
    np.testing.assert_allclose(predicted.translation, path(20).translation, atol=1e-9)
    assert angle_between(predicted.rotation, path(20).rotation) < np.radians(0.01)


@pytest.mark.parametrize("error_rad", [0.0, 1.0, 2.0, 3.1])
def test_attitude_turns_the_pose_whatever_its_alignment(error_rad: float) -> None:
    map_from_ned = rotation_from_vector(error_rad * np.array([0.6, 0.0, 0.8]))
    motion = CameraMotion()
    assert not motion.aligned
    motion.correct(0, path(0), map_from_ned.T @ path(0).rotation)
    turn = rotation_from_vector(np.array([0.0, 0.5, 0.1]))
    predicted = motion.carried_on(STEP_NS, map_from_ned.T @ turn @ path(0).rotation)
    assert predicted is not None and motion.aligned
    assert angle_between(predicted.rotation, turn @ path(0).rotation) < 1e-6
    now_from_before = rotation_from_vector(np.array([0.2, 0.1, -0.4]))
    motion.correct_attitude(now_from_before.T)
    again = motion.carried_on(STEP_NS, now_from_before @ map_from_ned.T @ turn @ path(0).rotation)
    assert again is not None
    assert angle_between(again.rotation, predicted.rotation) < 1e-6
    motion.discard_alignment()
    assert not motion.aligned


def test_noise_of_places_is_not_all_in_the_next() -> None:
    """Off by less than the line through two places, whose noise counts by the root of five."""
    rng, off = np.random.default_rng(4), []
    for _ in range(400):
        motion = CameraMotion()
        for k in range(6):
            seen = Pose(path(k).rotation, path(k).translation + rng.normal(scale=1e-3, size=3))
            motion.correct(k * STEP_NS, seen, None)
        predicted = motion.carried_on(6 * STEP_NS, None)
        assert predicted is not None
        off.append(predicted.translation - path(6).translation)
    assert 1e-3 < float(np.std(off)) < 2e-3


def test_poses_long_ago_say_nothing_of_the_motion() -> None:
    motion = CameraMotion()
    motion.correct(0, path(0), None)
    motion.correct(3_000_000_000, path(60), None)
    assert motion.velocity is None and motion.rates_camera_rad_s is None
    predicted = motion.carried_on(3_050_000_000, None)
    assert predicted is not None
    np.testing.assert_array_equal(predicted.translation, path(60).translation)


@pytest.mark.parametrize("n_poses", [1, 2, 5])
def test_a_correction_of_the_map_takes_the_motion_with_it(n_poses: int) -> None:
    motion, slam_map = CameraMotion(), SlamMap(1.2, 8)
    for k in range(5 - n_poses, 5):
        motion.correct(k * STEP_NS, path(k), path(k).rotation)
    turn = rotation_from_vector(np.array([0.3, 1.1, -2.0]))
    moved = Pose(turn, np.array([4.0, -2.0, 7.0]))
    slam_map.keyframes[3] = keyframe_at(3, moved @ path(0))
    motion.last = Track(
        4, 4 * STEP_NS, TrackState.TRACKING, path(4), keyframe_id=3,
        keyframe_from_camera=path(0).inverse() @ path(4),
    )  # fmt: skip
    assert motion.follow(slam_map) is not None
    predicted = motion.carried_on(5 * STEP_NS, path(5).rotation)
    expected = moved @ path(5 if n_poses > 1 else 4)
    assert predicted is not None
    np.testing.assert_allclose(predicted.translation, expected.translation, atol=1e-9)
    assert angle_between(predicted.rotation, moved.rotation @ path(5).rotation) < 1e-6
    assert motion.follow(slam_map) is None, "unmoved"
