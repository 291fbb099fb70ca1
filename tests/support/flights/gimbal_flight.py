"""Flights whose camera hangs on a gimbal, which tells its angles, truly or not."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from enum import Enum

import numpy as np

from companion.geometry.camera import Camera
from companion.geometry.gimbal import Gimbal
from companion.geometry.transforms import (
    Array,
    Pose,
    angle_between,
    quaternion_from_euler,
    quaternion_from_rotation,
    rotation_from_quaternion,
    rotation_from_vector,
    yaw_rotation,
)
from companion.messages import Odometry
from companion.telemetry import GimbalSample
from tests.support.flights.rendered_flight import (
    START_NS,
    Flown,
    PathOf,
    Terrain,
    fly,
    leaning_path,
)

FORWARD = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
PLACE_BODY_M = np.array([0.15, 0.0, 0.1])
IN_HEAD = Pose(FORWARD, np.array([0.03, 0.0, 0.0]))
GIMBAL = Gimbal((0.15, 0.0, 0.1), sigma_deg=0.5)
CAMERA = Camera(320, 240, 260.0, 260.0, 159.5, 119.5, body_from_camera=IN_HEAD, gimbal=GIMBAL)
RATE_HZ, GIMBAL_HZ, LATE_S = 15.0, 20.0, 0.03
NOISE_RAD = np.radians(0.15)
DOWN_RAD = np.radians(-55.0)

Lie = Callable[[float, GimbalSample], GimbalSample | None]
"""Sample as it is told at a time, seconds since the start; None where nothing is said."""


class Mode(Enum):
    """Motion of the head: its yaw follows the vehicle, or is locked; or it sweeps over the ground.

    It is told from the vehicle's heading, but for the second.
    """

    FOLLOW = "follow"
    LOCK = "lock"
    SWEEP = "sweep"


def path(after_s: float) -> Pose:
    """A copter on a loop that is not level, which leans into it and turns its heading."""
    return _PATH(after_s)


def _place_m(after_s: float) -> Array:
    return np.array([
        7.0 * np.sin(0.45 * after_s), 5.0 * np.sin(0.35 * after_s + 0.6),
        -11.0 - 1.5 * np.sin(0.4 * after_s),
    ])  # fmt: skip


_PATH = leaning_path(_place_m, lambda after_s: float(0.9 * np.sin(0.3 * after_s)))


def heading_rad(rotation: Array) -> float:
    """Heading of an attitude (3, 3)."""
    return float(np.arctan2(rotation[1, 0], rotation[0, 0]))


def angles_of(mode: Mode, after_s: float) -> tuple[float, float, float]:
    """Roll, pitch and yaw of the head, the yaw against the vehicle's heading or, locked, north."""
    if mode is not Mode.SWEEP:
        return 0.0, float(DOWN_RAD), 0.2
    pitch = DOWN_RAD + np.radians(12.0) * np.sin(0.8 * after_s)
    return 0.0, float(pitch), float(np.radians(35.0) * np.sin(0.5 * after_s))


def head_path(mode: Mode, body: PathOf = path) -> PathOf:
    """`ned_from_head` by seconds since the start."""

    def ned_from_head(after_s: float) -> Pose:
        here = body(after_s)
        level = rotation_from_quaternion(quaternion_from_euler(*angles_of(mode, after_s)))
        if mode is not Mode.LOCK:
            level = yaw_rotation(heading_rad(here.rotation)) @ level
        return Pose(level, here.translation + here.rotation @ PLACE_BODY_M)

    return ned_from_head


def told_by_gimbal(
    mode: Mode, seconds: float, lie: Lie | None = None, seed: int = 7
) -> list[GimbalSample]:
    """Angles of the head as it tells them: noisy, and stamped late."""
    rng, said = np.random.default_rng(seed), []
    for after_s in np.arange(-1.0, seconds, 1.0 / GIMBAL_HZ).tolist():
        level = rotation_from_quaternion(quaternion_from_euler(*angles_of(mode, after_s)))
        level = level @ rotation_from_vector(rng.normal(0.0, NOISE_RAD, 3))
        t_ns = START_NS + round((after_s + LATE_S) * 1e9)
        sample = GimbalSample(t_ns, quaternion_from_rotation(level), mode is Mode.LOCK)
        told = sample if lie is None else lie(after_s, sample)
        if told is not None:
            said.append(told)
    return said


def turned(sample: GimbalSample, yaw_rad: float) -> GimbalSample:
    """A sample whose yaw is off."""
    rotation = yaw_rotation(yaw_rad) @ rotation_from_quaternion(sample.level_from_head)
    return replace(sample, level_from_head=quaternion_from_rotation(rotation))


def fly_with_gimbal(mode: Mode, seconds: float, lie: Lie | None = None, *, seed: int = 3) -> Flown:
    """The flight with a gimbal."""
    return fly(
        CAMERA, path, Terrain(seed), seconds, RATE_HZ, ned_from_head=head_path(mode),
        beside=told_by_gimbal(mode, seconds, lie, seed + 4),
    )  # fmt: skip


def fly_fixed(seconds: float, seed: int = 3) -> Flown:
    """The same flight with the camera fixed, where the gimbal has it on the average."""
    looks = rotation_from_quaternion(quaternion_from_euler(0.0, float(DOWN_RAD), 0.2))
    inside = Pose(looks @ IN_HEAD.rotation, PLACE_BODY_M + looks @ IN_HEAD.translation)
    camera = replace(CAMERA, body_from_camera=inside, gimbal=None)
    return fly(camera, path, Terrain(seed), seconds, RATE_HZ)


def body_errors(odometry: list[Odometry], body: PathOf = path) -> tuple[Array, Array]:
    """Errors (N, 3) of the body's place, m, without their mean, and of its attitude (N,), rad."""
    known = [(o.world_from_body, (o.t_ns - START_NS) * 1e-9) for o in odometry]
    found = [(pose, body(after_s)) for pose, after_s in known if pose is not None]
    away = np.stack([pose.translation - truth.translation for pose, truth in found])
    turn = np.array([angle_between(pose.rotation, truth.rotation) for pose, truth in found])
    return away - away.mean(0), turn
