"""Optical flow at a lift-off shows the climb that accelerometers measure, or the mount is wrong."""

from __future__ import annotations

import numpy as np
import pytest

from companion.estimation.attitude.camera_attitude import CameraAttitude
from companion.estimation.lift_off.lift_off_flow import N_FRAMES, LiftOffFlow
from companion.estimation.lift_off.optical_flow import GroundVelocity
from companion.geometry.transforms import Array, Pose, rotation_from_vector

UP = np.array([0.02, -0.03, -0.6])
HEIGHT_M = 0.4


def flow(velocity_m_s: Array, sigma_hz: float = 0.05) -> GroundVelocity:
    return GroundVelocity(0, velocity_m_s / HEIGHT_M, sigma_hz**2 * np.eye(3))


def judged(seen_m_s: Array, n: int, wrong_every: int = 1000) -> tuple[LiftOffFlow, list[bool]]:
    """After frames that see a velocity, but for some that see the opposite."""
    judge = LiftOffFlow()
    told = []
    for k in range(n):
        sign = -1.0 if k % wrong_every == wrong_every - 1 else 1.0
        told.append(judge.take(UP, 0.05, flow(sign * seen_m_s)))
    return judge, told


def test_flow_that_shows_the_climb_agrees_though_it_is_turned_and_scaled_a_little() -> None:
    tilted = rotation_from_vector(np.radians([15.0, -10.0, 0.0]))
    judge, told = judged(1.7 * tilted @ UP, 3 * N_FRAMES, wrong_every=7)
    assert judge.agrees is True and not any(told)


@pytest.mark.parametrize(
    "axis", [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (1.0, -1.0, 0.0)], ids=["roll", "pitch", "both"]
)
@pytest.mark.parametrize("angle_deg", [90.0, 180.0])
def test_a_camera_that_is_turned_otherwise_contradicts_once(
    axis: tuple[float, float, float], angle_deg: float
) -> None:
    turn = rotation_from_vector(np.radians(angle_deg) * np.array(axis) / np.linalg.norm(axis))
    judge, told = judged(turn @ UP, 3 * N_FRAMES, wrong_every=7)
    assert judge.agrees is False and sum(told) == 1


def test_what_is_slow_or_noisy_or_between_tells_nothing() -> None:
    judge = LiftOffFlow()
    for _ in range(3 * N_FRAMES):
        judge.take(0.1 * UP, 0.05, flow(-UP))
        judge.take(UP, 0.5, flow(-UP))
        judge.take(UP, 0.05, flow(-UP, sigma_hz=1.0))
    assert judge.agrees is None
    between, _ = judged(rotation_from_vector(np.radians([47.0, 0.0, 0.0])) @ UP, 3 * N_FRAMES)
    assert between.agrees is None


def test_a_contradiction_ends_the_use_of_the_attitude_and_the_map() -> None:
    attitude = CameraAttitude(Pose.identity())
    assert attitude.used
    checked = attitude.contradicted(7, "why")
    assert not attitude.used and attitude.at(7) is None
    assert checked.reinitialise and checked.invalid_since_ns == 0
    assert [(each.what, each.detail) for each in checked.warnings] == [
        ("camera mount disagrees with the autopilot's attitude: no vision position", "why")
    ]
