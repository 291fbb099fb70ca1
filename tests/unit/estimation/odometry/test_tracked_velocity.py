"""Velocity of a tracked frame: whose is given out, and how certain it is."""

from __future__ import annotations

import numpy as np
import pytest

from companion.estimation.body.body_state import Reckoned
from companion.estimation.camera_motion import CameraMotion, ImageVelocity
from companion.estimation.inertial.inertial_motion import InertialStart
from companion.estimation.odometry.tracked_velocity import tracked_velocity
from companion.geometry.transforms import Pose, yaw_rotation

START = InertialStart(0, np.zeros(3), np.zeros(3), np.eye(6))
BY_IMAGES = ImageVelocity(np.array([0.2, 0.0, 0.0]), 0.1)


@pytest.mark.parametrize(("sigma_m_s", "by_filter"), [(0.1, True), (20.0, False)])
def test_a_filter_that_has_just_begun_does_not_count(sigma_m_s: float, by_filter: bool) -> None:
    moving = Reckoned(np.zeros(3), np.array([1.0, 2.0, 3.0]), 0.1, sigma_m_s, START)
    turn = 20.0 * yaw_rotation(np.pi / 2)
    found = tracked_velocity(moving, BY_IMAGES, turn, 0.02)
    assert found is not None
    expected = moving.velocity_m_s if by_filter else [0.0, 4.0, 0.0]
    np.testing.assert_allclose(found[0], expected, atol=1e-9)
    assert 0.0 < found[1] < 1.0


def test_that_of_the_images_is_stated_as_uncertain_as_it_is() -> None:
    """Braking and turning with centimetres of noise, twenty metres away."""
    rng, motion, squares = np.random.default_rng(4), CameraMotion(), []
    for k in range(600):
        t_s = 0.1 * k
        place = 3.0 * np.array([np.sin(0.8 * t_s), np.cos(0.6 * t_s), 0.2 * np.sin(t_s)])
        true = 3.0 * np.array(
            [0.8 * np.cos(0.8 * t_s), -0.6 * np.sin(0.6 * t_s), 0.2 * np.cos(t_s)]
        )
        seen = (place + rng.normal(scale=0.03, size=3)) / 20.0
        motion.correct(round(t_s * 1e9), Pose(np.eye(3), seen), np.eye(3))
        found = tracked_velocity(None, motion.velocity, 20.0 * np.eye(3), 0.03)
        if k > 50 and found is not None:
            squares.append(float(((found[0] - true) ** 2).sum()) / found[1] ** 2 / 3.0)
    assert 0.1 < np.mean(squares) < 2.0


def test_nothing_is_known_of_a_first_image() -> None:
    assert tracked_velocity(None, None, np.eye(3), 0.02) is None
