"""Attitude between its samples, and the motion filter."""

from __future__ import annotations

import numpy as np
import pytest

from companion.geometry import (
    Pose,
    angle_between,
    quaternion_from_euler,
    rotation_from_quaternion,
    rotation_from_vector,
    yaw_rotation,
)
from companion.messages import AttitudeSample
from companion.motion import AttitudeHistory, MotionFilter

STEP_NS = 50_000_000


def sample(t_ns: int, yaw_rad: float, rate_rad_s: float | None = None) -> AttitudeSample:
    rates = None if rate_rad_s is None else np.array([0.0, 0.0, rate_rad_s])
    return AttitudeSample(t_ns, quaternion_from_euler(0.0, 0.0, yaw_rad), rates)


def yaw_at(history: AttitudeHistory, t_ns: int) -> float:
    rotation = history.at(t_ns)
    assert rotation is not None
    return float(np.arctan2(rotation[1, 0], rotation[0, 0]))


def test_attitude_is_interpolated_and_carried_on_by_its_rate() -> None:
    history = AttitudeHistory()
    history.add(sample(0, 0.10, 2.0))
    history.add(sample(100_000_000, 0.30, 2.0))
    assert yaw_at(history, 25_000_000) == pytest.approx(0.15)
    assert yaw_at(history, 150_000_000) == pytest.approx(0.40)
    assert history.at(900_000_000) is None, "too long ago"


def test_late_samples_take_their_place_and_doubles_are_ignored() -> None:
    history = AttitudeHistory()
    for t_ns, yaw in ((0, 0.0), (200_000_000, 0.4), (100_000_000, 0.1), (100_000_000, 3.0)):
        history.add(sample(t_ns, yaw))
    assert yaw_at(history, 150_000_000) == pytest.approx(0.25)
    assert history.newest_t_ns == 200_000_000


def test_a_gap_is_not_bridged() -> None:
    history = AttitudeHistory()
    history.add(sample(0, 0.0))
    history.add(sample(2_000_000_000, 1.0))
    assert history.at(1_000_000_000) is None


def path(k: int) -> Pose:
    turn = rotation_from_vector(np.array([0.0, 0.01 * k, 0.02 * k]))
    return Pose(turn, np.array([0.05 * k, -0.02 * k, 0.01 * k]))


@pytest.mark.parametrize("attitude", [False, True], ids=["without attitude", "with attitude"])
def test_a_steady_motion_is_predicted(attitude: bool) -> None:
    motion = MotionFilter()
    offset = yaw_rotation(0.3)  # the autopilot's heading is wrong, but steadily so

    def ned(k: int) -> np.ndarray | None:
        return offset @ path(k).rotation if attitude else None

    for k in range(20):
        motion.correct(k * STEP_NS, path(k), ned(k))
    predicted = motion.predict(20 * STEP_NS, ned(20))
    assert predicted is not None
    np.testing.assert_allclose(predicted.translation, path(20).translation, atol=2e-3)
    assert angle_between(predicted.rotation, path(20).rotation) < np.radians(0.3)


def test_an_attitude_that_is_not_the_cameras_is_seen_to_be_none() -> None:
    steady, gimballed = MotionFilter(), MotionFilter()
    for k in range(40):
        steady.correct(k * STEP_NS, path(k), path(k).rotation)
        swinging = rotation_from_quaternion(quaternion_from_euler(0.3 * np.sin(k), 0.2, 0.1 * k))
        gimballed.correct(k * STEP_NS, path(k), swinging)
    assert steady.attitude_disagreement_rad is not None
    assert gimballed.attitude_disagreement_rad is not None
    assert steady.attitude_disagreement_rad < np.radians(0.5)
    assert gimballed.attitude_disagreement_rad > np.radians(4)
    assert MotionFilter().predict(0, None) is None


def test_an_attitude_is_carried_on_for_a_tenth_of_a_second_and_no_longer() -> None:
    """In gusts a craft has turned otherwise by degrees after two tenths."""
    history = AttitudeHistory()
    history.add(sample(0, 0.0))
    assert history.at(100_000_000) is not None
    assert history.at(-100_000_000) is not None
    assert history.at(150_000_000) is None
