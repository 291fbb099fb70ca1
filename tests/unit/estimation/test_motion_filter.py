"""Attitude interpolation, and the motion filter."""

from __future__ import annotations

import numpy as np
import pytest

from companion.estimation.attitude.attitude_history import AttitudeHistory
from companion.estimation.motion_filter import MotionFilter
from companion.geometry.transforms import (
    Pose,
    angle_between,
    quaternion_from_euler,
    rotation_from_vector,
    vector_from_rotation,
    yaw_rotation,
)
from companion.telemetry import AttitudeSample

STEP_NS = 50_000_000


def sample(t_ns: int, yaw_rad: float, rate_rad_s: float | None = None) -> AttitudeSample:
    rates = None if rate_rad_s is None else np.array([0.0, 0.0, rate_rad_s])
    return AttitudeSample(t_ns, quaternion_from_euler(0.0, 0.0, yaw_rad), rates)


def yaw_at(history: AttitudeHistory, t_ns: int) -> float:
    rotation = history.at(t_ns)
    assert rotation is not None
    return float(np.arctan2(rotation[1, 0], rotation[0, 0]))


def test_attitude_is_interpolated_and_extrapolated_by_its_rate() -> None:
    history = AttitudeHistory()
    history.add(sample(0, 0.10, 2.0))
    history.add(sample(100_000_000, 0.30, 2.0))
    assert yaw_at(history, 25_000_000) == pytest.approx(0.15)
    assert yaw_at(history, 150_000_000) == pytest.approx(0.40)
    assert history.at(900_000_000) is None, "too long ago"


def test_late_samples_are_sorted_and_duplicates_ignored() -> None:
    history = AttitudeHistory()
    for t_ns, yaw in ((0, 0.0), (200_000_000, 0.4), (100_000_000, 0.1), (100_000_000, 3.0)):
        history.add(sample(t_ns, yaw))
    assert yaw_at(history, 150_000_000) == pytest.approx(0.25)
    assert history.newest_t_ns == 200_000_000


def test_gap_is_not_interpolated() -> None:
    history = AttitudeHistory()
    history.add(sample(0, 0.0))
    history.add(sample(2_000_000_000, 1.0))
    assert history.at(1_000_000_000) is None


def path(k: int) -> Pose:
    turn = rotation_from_vector(np.array([0.0, 0.01 * k, 0.02 * k]))
    return Pose(turn, np.array([0.05 * k, -0.02 * k, 0.01 * k]))


@pytest.mark.parametrize("attitude", [False, True], ids=["without attitude", "with attitude"])
def test_constant_motion_is_predicted(attitude: bool) -> None:
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


def align(motion: MotionFilter, map_from_ned: np.ndarray) -> None:
    """Half a second of flight with this alignment of map and autopilot."""
    for k in range(10):
        motion.correct(k * STEP_NS, path(k), map_from_ned.T @ path(k).rotation)


@pytest.mark.parametrize("error_rad", [0.0, 1.0, 2.0, 3.1])
def test_update_rotates_by_the_kalman_gain(error_rad: float) -> None:
    """For any alignment: rotations are composed, not added as rotation vectors."""
    map_from_ned = rotation_from_vector(error_rad * np.array([0.6, 0.0, 0.8]))
    motion = MotionFilter()
    align(motion, map_from_ned)
    turn = np.radians(5.0) * np.array([0.0, 1.0, 0.0])
    turned = rotation_from_vector(turn) @ map_from_ned
    filter_ = motion._filter
    assert filter_ is not None
    variance = filter_.P[7, 7] + np.radians(1.0) ** 2 * STEP_NS * 1e-9
    share = variance / (variance + np.radians(0.3) ** 2)
    motion.correct(10 * STEP_NS, path(10), turned.T @ path(10).rotation)
    predicted = motion.predict(10 * STEP_NS, np.eye(3))
    assert predicted is not None
    expected = rotation_from_vector(share * turn) @ map_from_ned
    assert angle_between(predicted.rotation, expected) < np.radians(0.02)


def test_map_correction_transforms_the_covariance() -> None:
    """Normalised error squared: 9 on average for 9 states, before and after."""
    chance = np.random.default_rng(3)
    motion = MotionFilter()
    align(motion, rotation_from_vector(np.array([0.4, -1.2, 0.9])))
    filter_ = motion._filter
    assert filter_ is not None
    spread = np.diag([0.3, 0.02, 0.01, 0.5, 0.1, 0.02, 0.02, 0.004, 0.001])
    mix = np.linalg.qr(np.eye(9) + 0.3 * chance.standard_normal((9, 9)))[0]
    filter_.P = mix @ spread**2 @ mix.T
    filter_.P[:6, 6:] *= 0.1
    filter_.P[6:, :6] *= 0.1
    filter_.P[6:, 6:] *= 1e-3  # a turn is small, or its vector is none
    filter_.P[:6, 6:] *= 1e-2
    filter_.P[6:, :6] *= 1e-2
    before, scale = path(9), 1.7
    turn = rotation_from_vector(np.array([0.3, 1.1, -2.0]))
    after = Pose(turn @ before.rotation, np.array([4.0, -2.0, 7.0]))
    x, error = filter_.x.ravel().copy(), motion._map_from_ned
    truths = []
    for off in chance.multivariate_normal(np.zeros(9), filter_.P, 4000):
        truths.append((
            after.translation + scale * turn @ (x[:3] + off[:3] - before.translation),
            scale * turn @ (x[3:6] + off[3:6]),
            turn @ rotation_from_vector(off[6:]) @ error,
        ))  # fmt: skip
    motion.correct_map(before, after, scale)
    moved = filter_.x.ravel()
    inverse = np.linalg.inv(filter_.P)
    squares = []
    for place, velocity, rotation in truths:
        off = np.r_[
            place - moved[:3], velocity - moved[3:6],
            vector_from_rotation(rotation @ motion._map_from_ned.T),
        ]  # fmt: skip
        squares.append(off @ inverse @ off)
    assert np.mean(squares) == pytest.approx(9.0, abs=4 * np.sqrt(18 / 4000))


def test_attitude_extrapolation_is_limited() -> None:
    """In gusts a craft rotates by degrees within two tenths of a second."""
    history = AttitudeHistory()
    history.add(sample(0, 0.0))
    assert history.at(100_000_000) is not None
    assert history.at(-100_000_000) is not None
    assert history.at(150_000_000) is None


@pytest.mark.parametrize(
    "unit", [1.0, 0.05], ids=["unit of the scene", "unit of a start near the ground"]
)
def test_velocity_is_stated_as_uncertain_as_it_is(unit: float) -> None:
    """Braking and turning with centimetres of noise, twenty metres away."""
    rng, motion, squares = np.random.default_rng(4), MotionFilter(), []
    for k in range(600):
        t_s = 0.1 * k
        place = 3.0 * np.array([np.sin(0.8 * t_s), np.cos(0.6 * t_s), 0.2 * np.sin(t_s)])
        true = 3.0 * np.array(
            [0.8 * np.cos(0.8 * t_s), -0.6 * np.sin(0.6 * t_s), 0.2 * np.cos(t_s)]
        )
        seen = (place + rng.normal(scale=0.03, size=3)) / 20.0 / unit
        motion.correct(round(t_s * 1e9), Pose(np.eye(3), seen), np.eye(3))
        if k > 50 and motion.velocity is not None:
            velocity, sigma = motion.velocity
            squares.append(((velocity - true / 20.0 / unit) ** 2).sum() / sigma**2 / 3.0)
    assert 0.1 < np.mean(squares) < 2.0
