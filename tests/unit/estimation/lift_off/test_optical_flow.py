"""Optical flow of a rendered plane: what a sensor that looks down would say of the same motion."""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np
import pytest

from companion.estimation.attitude.camera_attitude import CameraAttitude
from companion.estimation.lift_off.optical_flow import (
    FEATURELESS,
    FIRST,
    NO_ATTITUDE,
    NO_GROUND,
    REPEATED,
    TOO_LONG,
    FlowMeter,
)
from companion.geometry.camera import Camera, Distortion
from companion.geometry.transforms import (
    Array,
    Pose,
    quaternion_from_euler,
    quaternion_from_rotation,
    rotation_from_quaternion,
    rotation_from_vector,
)
from companion.messages import Bytes, Frame, OpticalFlow
from companion.telemetry import AttitudeSample, RangeSample
from tests.support.flights.rendered_flight import CAMERA_DOWN, START_NS, Terrain

DT_NS = 33_000_000
HEIGHT_M = 10.0
TERRAIN = Terrain(3, plane=True)


def forward_down(degrees: float) -> Pose:
    """Mount of a camera that looks forward and so far down, with a yaw and a roll of its own."""
    turn = rotation_from_quaternion(
        quaternion_from_euler(np.radians(4), np.radians(-degrees), np.radians(-15))
    )
    body_from_forward = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])
    return Pose(turn @ body_from_forward, np.zeros(3))


def optics(mount: Pose, width: int = 320, distorted: bool = False) -> Camera:
    focal = 0.7 * width
    return Camera(
        width, width * 3 // 4, focal, 0.99 * focal, 0.51 * width, 0.36 * width,
        Distortion.RADTAN if distorted else Distortion.NONE,
        (-0.22, 0.05, 1e-3, -5e-4, 0.0) if distorted else (), body_from_camera=mount,
    )  # fmt: skip


@dataclass
class Motion:
    """Constant velocity and body rates, from an attitude at the first frame."""

    velocity_ned: tuple[float, float, float]
    rates: tuple[float, float, float] = (0.0, 0.0, 0.0)
    attitude: Array = field(
        default_factory=lambda: rotation_from_quaternion(quaternion_from_euler(0.08, -0.12, 0.7))
    )

    def pose(self, seconds: float) -> Pose:
        place = np.array([40.0, 30.0, -HEIGHT_M]) + np.array(self.velocity_ned) * seconds
        return Pose(self.attitude @ rotation_from_vector(np.array(self.rates) * seconds), place)

    def flow(self, from_s: float, to_s: float) -> Array:
        """Of a sensor at the middle of the interval."""
        middle = self.pose(0.5 * (from_s + to_s))
        down = middle.rotation[2, 2]
        forward, right, _ = middle.rotation.T @ np.array(self.velocity_ned)
        seen: Array = np.array([-right, forward]) * down / -middle.translation[2]
        return seen


def noisy(picture: Bytes, seed: int, sigma: float = 1.0) -> Bytes:
    noise = np.random.default_rng(seed).normal(0, sigma, picture.shape)
    return np.asarray(np.clip(picture + noise, 0, 255), np.uint8)


def measured(
    camera: Camera, motion: Motion, n: int = 4, told: bool = True, distance_m: float | None = None
) -> list[OpticalFlow]:
    """Flow of each frame of a motion."""
    assert camera.body_from_camera is not None
    meter, attitude = FlowMeter(camera), CameraAttitude(camera.body_from_camera)
    out = []
    for k in range(n):
        pose, t_ns = motion.pose(1e-9 * DT_NS * k), START_NS + k * DT_NS
        if told:
            turned = quaternion_from_rotation(pose.rotation)
            attitude.add(AttitudeSample(t_ns, turned, np.array(motion.rates)))
        if distance_m is not None:
            meter.take(RangeSample(START_NS, distance_m))
        picture = noisy(TERRAIN.picture(camera, pose @ camera.body_from_camera), k)
        out.append(meter.step(Frame(k, t_ns, picture, picture[:, :, None]), attitude))
    return out


CAMERAS = {
    "down": optics(CAMERA_DOWN),
    "oblique": optics(forward_down(45)),
    "distorted": optics(forward_down(60), 640, distorted=True),
}


@pytest.mark.parametrize("name", CAMERAS)
@pytest.mark.parametrize(
    "motion",
    [Motion((1.9, -0.7, 0.3)), Motion((-0.4, 2.1, -0.5), (0.35, -0.25, 0.6))],
    ids=["straight", "turning"],
)
def test_a_moving_camera(name: str, motion: Motion) -> None:
    for k, flow in enumerate(measured(CAMERAS[name], motion)[1:], 1):
        true = motion.flow(1e-9 * DT_NS * (k - 1), 1e-9 * DT_NS * k)
        assert flow.flow_rad_s is not None, flow.why_not
        off = float(np.linalg.norm(flow.flow_rad_s - true))
        print(f"{off / np.linalg.norm(true):.2%} off, quality {flow.quality}")
        assert off < 0.03 * np.linalg.norm(true)
        assert off < 4 * flow.sigma_rad_s + 0.001
        assert flow.quality > 150
        assert flow.dt_s == pytest.approx(1e-9 * DT_NS)
        assert flow.turn_rad == pytest.approx(np.array(motion.rates) * flow.dt_s, abs=1e-6)


def test_forward_is_positive_about_right_and_right_negative_about_forward() -> None:
    level = np.eye(3)
    _, forward = measured(CAMERAS["down"], Motion((2.0, 0.0, 0.0), attitude=level), n=2)
    _, right = measured(CAMERAS["down"], Motion((0.0, 2.0, 0.0), attitude=level), n=2)
    assert forward.flow_rad_s == pytest.approx([0.0, 2.0 / HEIGHT_M], abs=0.006)
    assert right.flow_rad_s == pytest.approx([-2.0 / HEIGHT_M, 0.0], abs=0.006)


@pytest.mark.parametrize("name", CAMERAS)
def test_a_turn_alone_is_no_flow(name: str) -> None:
    for flow in measured(CAMERAS[name], Motion((0.0, 0.0, 0.0), (0.5, -0.4, 0.7)))[1:]:
        assert flow.flow_rad_s is not None, flow.why_not
        assert np.linalg.norm(flow.flow_rad_s) < 0.01


def test_frames_without_a_measurement_say_why() -> None:
    camera, motion = CAMERAS["down"], Motion((1.0, 0.0, 0.0))
    first, *others = measured(camera, motion, told=False)
    assert first.why_not == FIRST
    assert {each.why_not for each in others} == {NO_ATTITUDE}
    assert {(each.flow_rad_s, each.quality) for each in others} == {(None, 0)}


def steps(pictures: list[Bytes], turn_rad_s: float = 0.0, dt_ns: int = DT_NS) -> list[OpticalFlow]:
    """Flow of pictures of a camera that looks down, and is turned meanwhile about forward."""
    meter, attitude, out = FlowMeter(CAMERAS["down"]), CameraAttitude(CAMERA_DOWN), []
    for k, picture in enumerate(pictures):
        t_ns = START_NS + k * dt_ns
        rates = np.array([turn_rad_s, 0.0, 0.0])
        turned = quaternion_from_rotation(rotation_from_vector(rates * (1e-9 * dt_ns * k)))
        attitude.add(AttitudeSample(t_ns, turned, rates))
        out.append(meter.step(Frame(k, t_ns, picture, picture[:, :, None]), attitude))
    return out[1:]


def ground() -> Bytes:
    pose = Motion((0.0, 0.0, 0.0), attitude=np.eye(3)).pose(0.0)
    return TERRAIN.picture(CAMERAS["down"], pose @ CAMERA_DOWN)


def test_a_blank_picture_has_no_flow() -> None:
    blank = np.full((240, 320), 130, np.uint8)
    for flow in steps([noisy(blank, k, 2.0) for k in range(4)]):
        assert (flow.quality, flow.flow_rad_s, flow.why_not) == (0, None, FEATURELESS)


def test_a_blurred_picture_is_not_believed_wrongly() -> None:
    """Flow of blurred ground is right, or of no quality."""
    blurred = cv2.GaussianBlur(ground(), (0, 0), 25)
    for flow in steps([noisy(np.asarray(blurred, np.uint8), k, 2.0) for k in range(6)]):
        right = flow.flow_rad_s is not None and np.linalg.norm(flow.flow_rad_s) < 0.02
        assert flow.quality == 0 or right


def test_a_camera_that_stands_sees_no_flow() -> None:
    for flow in steps([noisy(ground(), k) for k in range(3)]):
        assert flow.flow_rad_s == pytest.approx(np.zeros(2), abs=0.01)
        assert flow.quality > 150


def test_a_repeated_picture_is_no_measurement_while_the_body_turns() -> None:
    """It would tell a motion that makes up for the turn."""
    assert {each.why_not for each in steps([ground()] * 3, turn_rad_s=0.5)} == {REPEATED}


def test_unlike_pictures_have_no_flow() -> None:
    other = np.ascontiguousarray(ground()[::-1, ::-1])
    (flow,) = steps([ground(), other])
    assert flow.quality == 0
    assert flow.why_not in (FEATURELESS, NO_GROUND)


def test_a_frame_that_comes_long_after_the_last_has_no_flow() -> None:
    assert {each.why_not for each in steps([ground()] * 2, dt_ns=400_000_000)} == {TOO_LONG}


def test_the_distance_is_that_of_a_rangefinder_just_before() -> None:
    flows = measured(CAMERAS["down"], Motion((1.0, 0.0, 0.0)), n=12, distance_m=9.7)
    assert flows[3].distance_m == 9.7
    assert flows[-1].distance_m is None  # of 0.36 s before


def test_velocity_over_height_is_that_of_the_middle_in_ned() -> None:
    camera, motion = optics(forward_down(50)), Motion((1.6, -0.9, 0.4), (0.1, -0.05, 0.2))
    assert camera.body_from_camera is not None
    meter, attitude = FlowMeter(camera), CameraAttitude(camera.body_from_camera)
    for k in range(3):
        pose, t_ns = motion.pose(1e-9 * DT_NS * k), START_NS + k * DT_NS
        attitude.add(AttitudeSample(t_ns, quaternion_from_rotation(pose.rotation)))
        picture = noisy(TERRAIN.picture(camera, pose @ camera.body_from_camera), k)
        meter.step(Frame(k, t_ns, picture, picture[:, :, None]), attitude)
        assert (meter.over_ground is None) == (k == 0)
    found = meter.over_ground
    assert found is not None and found.t_ns == START_NS + DT_NS * 3 // 2
    height_m = -motion.pose(1.5e-9 * DT_NS).translation[2]
    off_m_s = found.velocity_hz * height_m - motion.velocity_ned
    assert np.abs(off_m_s).max() < 0.06
    assert np.sqrt(np.linalg.eigvalsh(found.covariance_hz2)[-1]) * height_m < 0.1
