"""Attitudes from an IMU alone, of motions with exact rates and forces."""

from __future__ import annotations

import numpy as np
import pytest

from companion.estimation.attitude.attitude_by_imu import attitudes_by_imu
from companion.geometry.transforms import (
    Array,
    Pose,
    rotation_from_quaternion,
    rotation_from_vector,
)
from tests.support.flights.rendered_flight import inertial_samples

BIAS_RAD_S = np.array([-0.002, 0.02, 0.08])
"""As large as EuRoC's."""


def swinging(after_s: float) -> Pose:
    """Still for two seconds, then accelerations to 2 m/s2 and turns to 60 degrees."""
    t = max(after_s - 1.0, 0.0)
    place = 2.0 * (1.0 - np.exp(-0.3 * t * t)) * np.sin(np.array([1.0, 0.8, 0.6]) * t)
    return Pose(
        rotation_from_vector((1.0 - np.exp(-0.3 * t * t)) * np.sin(np.array([0.4, 0.5, 0.3]) * t)),
        place,
    )


def tilts_deg(attitudes: Array, axes: Array) -> Array:
    """Angles between the verticals of attitudes (N, 4) and the true ones."""
    true = [swinging(-1.0 + 0.01 * k).rotation @ axes for k in range(len(attitudes))]
    cosines = [rotation_from_quaternion(q)[2] @ t[2] for q, t in zip(attitudes, true, strict=True)]
    return np.asarray(np.degrees(np.arccos(np.clip(cosines, -1.0, 1.0))))


@pytest.mark.parametrize(
    "axes",
    [np.eye(3), np.array([[0.0, 0, 1], [0, -1, 0], [1, 0, 0]]), np.diag([1.0, -1, -1])],
    ids=["level", "on its side", "upside down"],
)
def test_the_vertical_is_known_to_a_degree(axes: Array) -> None:
    samples = list(
        inertial_samples(lambda s: Pose(swinging(s).rotation @ axes, swinging(s).translation), 30.0)
    )
    t_ns = np.array([s.t_ns for s in samples])
    gyro = np.stack([s.gyro_rad_s for s in samples]) + BIAS_RAD_S
    accel = np.stack([s.accel_m_s2 for s in samples])
    found = attitudes_by_imu(t_ns, gyro, accel)
    tilts = tilts_deg(found.ned_from_body, axes)
    assert tilts.max() < 2.0
    assert np.sqrt((tilts**2).mean()) < 1.0
    assert np.abs(found.rates_rad_s - gyro + BIAS_RAD_S).max() < 0.005


def test_a_gap_is_not_integrated() -> None:
    t_ns = np.r_[np.arange(100), np.arange(100) + 400] * 10_000_000
    gyro, accel = np.zeros((200, 3)), np.tile([0.0, 0.0, -9.81], (200, 1))
    gyro[100:] = 0.5
    found = attitudes_by_imu(t_ns, gyro, accel)
    before, after = found.ned_from_body[99], found.ned_from_body[100]
    assert np.abs(before - after).max() < 1e-3
