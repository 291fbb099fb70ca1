"""Take-off in a closed loop, in lockstep: a drone without GPS, flown by the poses it is sent.

    flown = take_off(seed)      # stands, arms, climbs to HEIGHT_M, holds its place in gusts

Physics are those of a point that leans into where it is told to go. It believes the newest pose
that it was sent, carried on by that pose's velocity, and nothing else. Camera and samples are drawn
from the true state: blurred near the ground, an IMU with white noise, bias, and the motors'
vibration aliased to white noise while armed, an attitude with a slow error of its own, a barometer
that weather and the rotors' pressure upset.
"""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import dataclass, field
from typing import NamedTuple

import cv2
import numpy as np

from companion.config_file import load_config
from companion.estimation.gate.pose_gate import PoseGate
from companion.estimation.gate.pose_to_send import PoseToSend
from companion.estimation.localisation import LocalisationStage
from companion.geometry.camera import Camera
from companion.geometry.transforms import (
    Array,
    Pose,
    quaternion_from_rotation,
    rotation_from_vector,
)
from companion.messages import Bytes, Frame, Odometry, TrackState
from companion.telemetry import (
    ArmedSample,
    AttitudeSample,
    HeightSample,
    ImuSample,
    LandedSample,
)
from tests.support.flights.scene import PlaneWorld, texture

STEP_S, FRAME_EVERY, ATTITUDE_EVERY = 0.01, 5, 2
HEIGHT_M, LEGS_M, CLIMB_M_S = 5.0, 0.2, 1.0
LATE_NS = 60_000_000
"""From a picture to its pose."""
GRAVITY_NED = np.array([0.0, 0.0, 9.80665])
SIGMA_ACCEL_M_S2, SIGMA_BIAS_M_S2, VIBRATION_M_S2 = 0.08, 0.06, 0.5
SIGMA_GYRO_RAD_S = 0.004
SIGMA_TILT_RAD, TILT_S, SMOOTH_S = np.radians(0.3), 15.0, 1.0
"""An attitude integrates gyroscopes: what it is off by changes smoothly."""
GUST_M_S2, GUST_S = 0.25, 2.0
HEIGHT_EVERY, SIGMA_HEIGHT_M, SIGMA_WEATHER_M, WEATHER_S = 10, 0.1, 0.3, 60.0
WASH_M, WASH_HEIGHT_M = -0.5, 0.5
"""What the rotors' pressure takes off the barometric height on the ground, and up to where."""
LEAN_S, DRAG_HZ = 0.15, 0.15
MAX_ACCEL_M_S2 = 2.5
DOWN_DEG = 50.0


def _camera() -> Camera:
    forward = rotation_from_vector(np.array([0.0, -np.radians(DOWN_DEG), 0.0]))
    body_from_optical = forward @ np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])
    mount = Pose(body_from_optical, np.array([0.1, 0.0, 0.02]))
    return Camera(480, 360, 380.0, 380.0, 239.5, 179.5, body_from_camera=mount)


class Ground:
    """Ground with boxes, with detail from centimetres to tens of metres."""

    def __init__(self, rng: np.random.Generator) -> None:
        self._world, self._grass = PlaneWorld(rng), texture(rng)
        self._rng = rng
        self._newest: tuple[Pose, Array] | None = None
        """What was seen last, from where: the same while the vehicle stands."""

    def picture(self, camera: Camera, world_from_camera: Pose) -> Bytes:
        """As a camera takes it whose focus is at infinity."""
        if self._newest is None or not _same(self._newest[0], world_from_camera):
            self._newest = world_from_camera, self._without_noise(camera, world_from_camera)
        seen = self._newest[1]
        noisy = seen + self._rng.normal(scale=2.0, size=seen.shape)
        return np.asarray(np.clip(noisy, 0, 255), np.uint8)

    def _without_noise(self, camera: Camera, world_from_camera: Pose) -> Array:
        grey, depth = self._world.render(camera, world_from_camera)
        rays = self._world.rays_of(camera) @ world_from_camera.rotation.T
        on = world_from_camera.translation + depth.reshape(-1, 1) * rays
        at = np.mod(on[:, :2] / 0.007, len(self._grass) - 2).astype(np.float32)
        size = (camera.height, camera.width)
        fine = cv2.remap(
            self._grass, at[:, 0].reshape(size), at[:, 1].reshape(size), cv2.INTER_LINEAR
        )
        near_m = max(-float(world_from_camera.translation[2]), 0.05)
        fade = float(np.clip(2.0 / near_m, 0.1, 0.7))
        mixed = (1 - fade) * grey.astype(np.float32) + fade * fine
        blur_px = 1.0 / near_m  # 5 pixels where it stands
        if blur_px > 0.3:
            mixed = cv2.GaussianBlur(mixed, (0, 0), blur_px)
        return np.asarray(mixed)


def _same(a: Pose, b: Pose) -> bool:
    return np.array_equal(a.rotation, b.rotation) and np.array_equal(a.translation, b.translation)


class Times(NamedTuple):
    """Seconds from power-on; the place is to be held from `held_s` on."""

    armed_s: float = 12.0
    lift_s: float = 14.0
    held_s: float = 24.0
    end_s: float = 32.0


DEFAULT = Times()


@dataclass
class Flown:
    """What happened, by the true state."""

    times: Times
    sent: list[PoseToSend] = field(default_factory=list)
    sent_s: list[float] = field(default_factory=list)
    believed_m: list[Array] = field(default_factory=list)
    """Believed less true place (3,), from the first pose on, each step."""
    held_m: list[Array] = field(default_factory=list)
    """True place less the one to hold (3,), each step from `held_s` on."""
    states: list[TrackState] = field(default_factory=list)
    """One a frame."""
    why_not: str = ""

    @property
    def first_s(self) -> float:
        """Time of the first pose; infinite without."""
        return self.sent_s[0] if self.sent_s else float("inf")

    @property
    def longest_gap_s(self) -> float:
        """Between two poses, to the end."""
        return (
            float(np.diff([*self.sent_s, self.times.end_s]).max()) if self.sent_s else float("inf")
        )

    @property
    def worst_hold_m(self) -> tuple[float, float]:
        """The furthest away from the place to hold, level and up or down."""
        return _furthest_m(self.held_m)

    @property
    def worst_belief_m(self) -> tuple[float, float]:
        """The furthest that it was wrong meanwhile about where it is, level and up or down."""
        return _furthest_m(self.believed_m[-len(self.held_m) :] if self.held_m else [])


def _furthest_m(offsets_m: list[Array]) -> tuple[float, float]:
    if not offsets_m:
        return float("inf"), float("inf")
    all_m = np.array(offsets_m)
    return float(np.linalg.norm(all_m[:, :2], axis=1).max()), float(np.abs(all_m[:, 2]).max())


def take_off(seed: int, *settings: str, times: Times = DEFAULT) -> Flown:
    """Fly once; see above."""
    rng, weather, camera = np.random.default_rng(seed), np.random.default_rng(seed), _camera()
    config = load_config(
        None, ["feedback.mode=odometry", 'telemetry.use=["attitude","imu","height"]', *settings]
    )
    stage = LocalisationStage(config, camera, lambda _: nullcontext())
    gate = PoseGate(config.feedback, use=config.telemetry.use)
    ground, flown = Ground(rng), Flown(times)
    assert camera.body_from_camera is not None
    place, velocity = np.array([0.0, 0.0, -LEGS_M]), np.zeros(3)
    lean, gust, weather_m = np.zeros(2), np.zeros(3), 0.0
    tilt, smooth_tilt = np.zeros(3), np.zeros(3)
    bias = rng.normal(scale=SIGMA_BIAS_M_S2, size=3)
    heading = rotation_from_vector(np.array([0.0, 0.0, 0.6]))
    before, newest, waiting = heading, None, list[tuple[int, Odometry]]()
    for step in range(round(times.end_s / STEP_S)):
        t_s, t_ns = step * STEP_S, 10**9 + round(step * STEP_S * 1e9)
        # what it believes, and does about it
        believed = None
        if newest is not None:
            ahead_s = (t_ns - newest.t_ns) * 1e-9
            believed = newest.world_from_body.translation + ahead_s * newest.velocity_world_m_s
        command = np.zeros(3)
        flies = t_s >= times.lift_s
        if flies and believed is not None and newest is not None:
            wanted = np.array([0.0, 0.0, -min(HEIGHT_M, CLIMB_M_S * (t_s - times.lift_s))])
            command = 1.2 * (wanted - believed) - 1.8 * newest.velocity_world_m_s
            command *= min(1.0, MAX_ACCEL_M_S2 / max(float(np.linalg.norm(command)), 1e-9))
        # physics
        lean += (np.arctan2(command[:2], GRAVITY_NED[2]) - lean) * STEP_S / LEAN_S
        gust += -gust * STEP_S / GUST_S
        gust += GUST_M_S2 * np.sqrt(2 * STEP_S / GUST_S) * rng.normal(size=3)
        accel = np.zeros(3)
        if flies:
            accel = np.append(GRAVITY_NED[2] * np.tan(lean), command[2])
            accel = accel + gust - DRAG_HZ * velocity
            if place[2] + (velocity[2] + accel[2] * STEP_S) * STEP_S > -LEGS_M:
                accel = -velocity / STEP_S  # it stands
            velocity = velocity + accel * STEP_S
            place = place + velocity * STEP_S
        ned_from_body = rotation_from_vector(np.array([lean[1], -lean[0], 0.0])) @ heading
        # what is measured
        tilt += -tilt * STEP_S / TILT_S
        tilt += SIGMA_TILT_RAD * np.sqrt(2 * STEP_S / TILT_S) * rng.normal(size=3)
        smooth_tilt += (tilt - smooth_tilt) * STEP_S / SMOOTH_S
        told = rotation_from_vector(smooth_tilt) @ ned_from_body
        if step == 0 or step == round(times.armed_s / STEP_S):
            stage.step(ArmedSample(t_ns, t_s >= times.armed_s))
        if step % 100 == 0:
            stage.step(LandedSample(t_ns, bool(place[2] > -LEGS_M - 0.1)))
        if step % ATTITUDE_EVERY == 0:
            attitude = AttitudeSample(t_ns, quaternion_from_rotation(told))
            stage.step(attitude)
            gate.take_attitude(attitude)
        if step % HEIGHT_EVERY == 0:
            weather_m += -weather_m * HEIGHT_EVERY * STEP_S / WEATHER_S
            swing_m = SIGMA_WEATHER_M * np.sqrt(2 * HEIGHT_EVERY * STEP_S / WEATHER_S)
            weather_m += swing_m * weather.normal()
            wash_m = WASH_M * np.exp((place[2] + LEGS_M) / WASH_HEIGHT_M) * (t_s >= times.armed_s)
            off_m = weather_m + wash_m + SIGMA_HEIGHT_M * weather.normal()
            stage.step(HeightSample(t_ns, float(80.0 - place[2] + off_m)))
        noise = np.hypot(SIGMA_ACCEL_M_S2, VIBRATION_M_S2 * (t_s >= times.armed_s))
        force = ned_from_body.T @ (accel - GRAVITY_NED) + bias + rng.normal(scale=noise, size=3)
        turn = before.T @ ned_from_body
        rates = np.array([turn[2, 1], turn[0, 2], turn[1, 0]]) / STEP_S
        before = ned_from_body
        stage.step(ImuSample(t_ns, rates + rng.normal(scale=SIGMA_GYRO_RAD_S, size=3), force))
        if step % FRAME_EVERY == 0:
            seen_from = Pose(ned_from_body, place) @ camera.body_from_camera
            grey = ground.picture(camera, seen_from)
            rgb = np.repeat(grey[..., None], 3, axis=2)
            for out in stage.step(Frame(step // FRAME_EVERY, t_ns, grey, rgb)):
                if isinstance(out, Odometry):
                    waiting.append((t_ns + LATE_NS, out))
                    flown.states.append(out.state)
        # what is sent
        poses = []
        while waiting and waiting[0][0] <= t_ns:
            poses.append(gate.take(waiting.pop(0)[1], t_ns))
        poses.append(gate.due(t_ns))
        for pose in poses:
            if pose is not None:
                newest = pose
                flown.sent.append(pose)
                flown.sent_s.append(t_s)
        if believed is not None:
            flown.believed_m.append(believed - place - [0.0, 0.0, LEGS_M])
        if t_s >= times.held_s:
            flown.held_m.append(place - [0.0, 0.0, -HEIGHT_M - LEGS_M])
    flown.why_not = gate.why_not
    return flown
