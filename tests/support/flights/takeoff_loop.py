"""Take-off in a closed loop, in lockstep: a drone without GPS, flown by the poses it is sent.

    flown = take_off(seed)      # stands, arms, climbs to HEIGHT_M, holds its place in gusts

Pictures, blurred near the ground, and samples (`copter_senses`) are drawn from the true state of a
made-up copter (`posed_copter`).
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
    rotation_from_vector,
)
from companion.messages import Bytes, Frame, Odometry, TrackState
from companion.telemetry import AttitudeSample, Telemetry
from tests.support.flights.copter_senses import LEGS_M, Senses
from tests.support.flights.posed_copter import (
    STEP_S,
    Copter,
    PosedAutopilot,
    climbed,
)
from tests.support.flights.scene import PlaneWorld, texture

FRAME_EVERY = 5
HEIGHT_M = 5.0
LATE_NS = 60_000_000
"""From a picture to its pose."""
DOWN_DEG = 50.0
START_NS = 10**9
GUSTS_M_S2 = 0.25
"""A fresh wind: that of 5 m/s which changes by a third, on what a copter is dragged by."""
CLEAR_M = 1.0
"""About the vehicle, without a roof that it would fly through."""


def _camera() -> Camera:
    forward = rotation_from_vector(np.array([0.0, -np.radians(DOWN_DEG), 0.0]))
    body_from_optical = forward @ np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])
    mount = Pose(body_from_optical, np.array([0.1, 0.0, 0.02]))
    return Camera(480, 360, 380.0, 380.0, 239.5, 179.5, body_from_camera=mount)


class Ground:
    """Ground with boxes, with detail from centimetres to tens of metres."""

    def __init__(self, rng: np.random.Generator) -> None:
        self._world, self._grass = PlaneWorld(rng, clear_m=CLEAR_M), texture(rng)
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


class Step(NamedTuple):
    """Time, true place (3,), where to hold, and where the autopilot thinks it is."""

    t_s: float
    place_m: Array
    wanted_m: Array
    believed_m: Array


@dataclass
class Flown:
    """What happened, by the true state."""

    times: Times
    steps: list[Step] = field(default_factory=list)
    sent: list[PoseToSend] = field(default_factory=list)
    sent_s: list[float] = field(default_factory=list)
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
        return _furthest_m([s.place_m - s.wanted_m for s in self.steps if self._holds(s.t_s)])

    @property
    def worst_pose_m(self) -> tuple[float, float]:
        """The furthest that a pose sent meanwhile is from the truth, level and up or down."""
        offsets_m = (
            p.world_from_body.translation - self.steps[step_of(p.t_ns)].place_m for p in self.sent
        )
        return _furthest_m(
            [off for off, p in zip(offsets_m, self.sent, strict=True) if self._holds(_s(p.t_ns))]
        )

    def _holds(self, t_s: float) -> bool:
        return t_s >= self.times.held_s


def _s(t_ns: int) -> float:
    return (t_ns - START_NS) * 1e-9


def step_of(t_ns: int) -> int:
    """Index of the step at a time."""
    return round(_s(t_ns) / STEP_S)


def _furthest_m(offsets_m: list[Array]) -> tuple[float, float]:
    if not offsets_m:
        return float("inf"), float("inf")
    all_m = np.array(offsets_m)
    return float(np.linalg.norm(all_m[:, :2], axis=1).max()), float(np.abs(all_m[:, 2]).max())


class Companion:
    """What is under test: samples and pictures in, poses out."""

    def __init__(self, camera: Camera, ground: Ground, settings: tuple[str, ...]) -> None:
        config = load_config(
            None, ["feedback.mode=odometry", 'telemetry.use=["attitude","imu","height"]', *settings]
        )
        self._camera, self._ground = camera, ground
        self._stage = LocalisationStage(config, camera, lambda _: nullcontext())
        self._gate = PoseGate(config.feedback, use=config.telemetry.use)
        self._waiting = list[tuple[int, Odometry]]()
        self.states: list[TrackState] = []

    @property
    def why_not(self) -> str:
        """Reason why nothing is sent."""
        return self._gate.why_not

    def take(self, sample: Telemetry) -> None:
        """Take a sample."""
        self._stage.step(sample)
        if isinstance(sample, AttitudeSample):
            self._gate.take_attitude(sample)

    def look(self, seq: int, t_ns: int, ned_from_body: Pose) -> None:
        """Take a picture from where the vehicle is."""
        assert self._camera.body_from_camera is not None
        grey = self._ground.picture(self._camera, ned_from_body @ self._camera.body_from_camera)
        for out in self._stage.step(Frame(seq, t_ns, grey, np.repeat(grey[..., None], 3, axis=2))):
            if isinstance(out, Odometry):
                self._waiting.append((t_ns + LATE_NS, out))
                self.states.append(out.state)

    def poses(self, t_ns: int) -> list[PoseToSend]:
        """Poses that leave at a time."""
        out = []
        while self._waiting and self._waiting[0][0] <= t_ns:
            out.append(self._gate.take(self._waiting.pop(0)[1], t_ns))
        return [pose for pose in (*out, self._gate.due(t_ns)) if pose is not None]


def take_off(
    seed: int, *settings: str, times: Times = DEFAULT, gusts_m_s2: float = GUSTS_M_S2,
    true_poses: bool = False,
) -> Flown:  # fmt: skip
    """Fly once; with `true_poses` by the truth, as late as ours: what the vehicle can do."""
    rng, gusts = np.random.default_rng(seed), np.random.default_rng((seed, 1))
    camera, flown = _camera(), Flown(times)
    companion = None if true_poses else Companion(camera, Ground(rng), settings)
    start_m = np.array([0.0, 0.0, -LEGS_M])
    copter, senses, autopilot = (
        Copter(-LEGS_M, gusts_m_s2),
        Senses(seed, rng, times.armed_s),
        PosedAutopilot(),
    )
    late = list[PoseToSend]()
    for step in range(round(times.end_s / STEP_S)):
        t_s, t_ns = step * STEP_S, START_NS + round(step * STEP_S * 1e9)
        wanted = climbed(HEIGHT_M, t_s - times.lift_s)
        flies = t_s >= times.lift_s and autopilot.known
        copter.step(autopilot.accel_wanted(wanted) if flies else None, gusts)
        true_pose = Pose(copter.ned_from_body, copter.place_m)
        samples = senses.of(step, t_ns, copter)
        autopilot.carry_on(t_ns, senses.accel_ned_m_s2)
        if companion is None:
            if step % FRAME_EVERY == 0:
                place = Pose(copter.ned_from_body, copter.place_m - start_m)
                late.append(
                    PoseToSend(t_ns, place, copter.velocity_m_s, 0.02, 0.02, 0.01, 0.1, 100, 0)
                )
            sent = [late.pop(0)] if late and t_ns - late[0].t_ns >= LATE_NS else []
        else:
            for sample in samples:
                companion.take(sample)
            if step % FRAME_EVERY == 0:
                companion.look(step // FRAME_EVERY, t_ns, true_pose)
            sent = companion.poses(t_ns)
        for pose in sent:
            autopilot.take(pose)
            flown.sent.append(pose)
            flown.sent_s.append(t_s)
        flown.steps.append(
            Step(t_s, copter.place_m - start_m, wanted.place_m, autopilot.place_m.copy())
        )
    if companion is not None:
        flown.states, flown.why_not = companion.states, companion.why_not
    return flown
