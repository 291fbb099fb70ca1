"""Frames of a rolling shutter, undone by attitude, or by images alone, which is said."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from companion.estimation.attitude.camera_attitude import CameraAttitude
from companion.estimation.camera_motion import CameraMotion
from companion.estimation.shutter.shutter_of_frames import BY_IMAGES, ShutterOfFrames
from companion.geometry.camera import Camera
from companion.geometry.transforms import (
    Array,
    Pose,
    quaternion_from_rotation,
    rotation_from_vector,
)
from companion.messages import Frame, Track, TrackState
from companion.slam.map.sparse_map import SlamMap
from companion.telemetry import AttitudeSample
from tests.support.flights.rolling_scene import rolled
from tests.support.flights.scene import DOWN_LOOKING, PlaneWorld

BODY_FROM_CAMERA = Pose(rotation_from_vector(np.array([0.0, 0.3, 0.0])) @ DOWN_LOOKING, np.zeros(3))
CAMERA = Camera(
    320, 240, 240.0, 240.0, 160.0, 120.0, body_from_camera=BODY_FROM_CAMERA, readout_ms=25.0
)
RATES_BODY = np.array([0.3, -0.4, 2.4])
RATES_CAMERA = BODY_FROM_CAMERA.rotation.T @ RATES_BODY
T_NS = 3_000_000_000


def body_at(t_s: float) -> Array:
    return rotation_from_vector(RATES_BODY * t_s)


def attitude(until_s: float) -> CameraAttitude:
    """Attitudes at 50 Hz of a body that turns about T_NS."""
    it = CameraAttitude(BODY_FROM_CAMERA)
    for t_s in np.arange(-1.0, until_s, 0.02).tolist():
        quaternion = quaternion_from_rotation(body_at(t_s))
        it.add(AttitudeSample(T_NS + round(t_s * 1e9), quaternion, RATES_BODY))
    return it


def image() -> tuple[np.ndarray, np.ndarray]:
    """The image as it was read out, and that of a global shutter."""
    world = PlaneWorld(np.random.default_rng(3))

    def pose_at(t_s: float) -> Pose:
        return Pose(body_at(t_s) @ BODY_FROM_CAMERA.rotation, np.array([0.0, 0.0, -12.0]))

    return rolled(world, CAMERA, pose_at, 0.025), world.render(CAMERA, pose_at(0.0))[0]


def difference(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.abs(a.astype(float) - b)[20:-20, 20:-20].mean())


def track() -> Track:
    found = np.array([[160.0, 20.0]], np.float32)
    return Track(0, T_NS, TrackState.TRACKING, keypoints_px=found)


def test_by_attitude_also_where_later_ones_have_not_come() -> None:
    seen, still = image()
    frame = Frame(0, T_NS, seen, np.zeros((0, 0, 3), np.uint8))
    before = difference(seen, still)
    for until_s in (1.0, 0.001):
        shutter = ShutterOfFrames(CAMERA)
        found = shutter.begin(frame, attitude(until_s), CameraMotion())
        given = shutter.of(track())
        motion = given.shutter_motion
        assert motion is not None and given.keypoints_px is not None
        assert abs(given.keypoints_px[0, 0] - 160.0) > 2.0, "where it was read out, as it is shown"
        np.testing.assert_allclose(motion[0], RATES_CAMERA, atol=2e-3)
        assert difference(found.grey, still) < 0.25 * before
        assert not shutter.end(None, SlamMap(1.2, 8))


def test_without_attitude_by_images_which_is_said_once() -> None:
    seen, still = image()
    frame = Frame(0, T_NS, seen, np.zeros((0, 0, 3), np.uint8))
    shutter, motion, slam_map = ShutterOfFrames(CAMERA), CameraMotion(), SlamMap(1.2, 8)
    nothing = CameraAttitude(None)
    assert shutter.begin(frame, nothing, motion) is frame, "nothing is known yet"
    assert shutter.of(track()).shutter_motion is None
    for t_s in (-0.1, -0.05):
        pose = Pose(body_at(t_s) @ BODY_FROM_CAMERA.rotation, np.zeros(3))
        motion.correct(T_NS + round(t_s * 1e9), pose, None)
    found = shutter.begin(frame, nothing, motion)
    used = shutter.of(track()).shutter_motion
    assert used is not None
    np.testing.assert_allclose(used[0], RATES_CAMERA, atol=1e-6)
    assert difference(found.grey, still) < 0.25 * difference(seen, still)
    assert [w.what for w in shutter.end(None, slam_map)] == [BY_IMAGES]
    shutter.begin(frame, nothing, motion)
    assert not shutter.end(None, slam_map)


def test_of_a_shutter_that_is_not_known_frames_stay_as_they_are() -> None:
    frame = Frame(0, T_NS, image()[0], np.zeros((0, 0, 3), np.uint8))
    shutter = ShutterOfFrames(replace(CAMERA, readout_ms=None))
    assert shutter.begin(frame, attitude(1.0), CameraMotion()) is frame
    assert shutter.of(track()).shutter_motion is None
