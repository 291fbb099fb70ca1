"""Small products for each sample of the IMU in compiled loops against the same in numpy."""

from __future__ import annotations

import numpy as np
import pytest

from companion.geometry.transforms import (
    Array,
    rotation_from_quaternion,
    rotation_from_vector,
    vector_from_rotation,
    yaw_rotation,
)
from companion.slam.compiled.inertial_steps import (
    integrated,
    led_level,
    rotation_between,
    turned,
)

ROUNDING = 1e-14


@pytest.fixture(params=range(20))
def rng(request: pytest.FixtureRequest) -> np.random.Generator:
    return np.random.default_rng(request.param)


def test_level_is_led_to_the_autopilots(rng: np.random.Generator) -> None:
    before = rotation_from_vector(2.0 * rng.normal(size=3))
    autopilot = rotation_from_vector(0.2 * rng.normal(size=3)) @ before
    rates, next_rates, bias = rng.normal(size=(3, 3))
    found, apart_rad = led_level(before, autopilot, rates, next_rates, bias, 0.01, 0.3)
    level = before @ rotation_from_vector(0.01 * (0.5 * (rates + next_rates) - bias))
    apart = autopilot @ level.T
    yaw_rad = np.arctan2(apart[1, 0] - apart[0, 1], apart[0, 0] + apart[1, 1])
    level = yaw_rotation(float(yaw_rad)) @ level
    off = vector_from_rotation(autopilot @ level.T)
    np.testing.assert_allclose(found, rotation_from_vector(0.3 * off) @ level, atol=ROUNDING)
    assert apart_rad == pytest.approx(float(np.hypot(off[0], off[1])), abs=ROUNDING)


def test_rotations_go_on_as_by_numpy(rng: np.random.Generator) -> None:
    first, step = rng.normal(size=(2, 4))
    expected = rotation_from_quaternion(first + 0.3 * (0.1 * step))
    np.testing.assert_allclose(
        rotation_between(first, first + 0.1 * step, 0.3), expected, atol=ROUNDING
    )
    rates, next_rates = rng.normal(size=(2, 3))
    after = expected @ rotation_from_vector(0.5 * 0.02 * (rates + next_rates))
    np.testing.assert_allclose(turned(expected, rates, next_rates, 0.02), after, atol=ROUNDING)


@pytest.mark.parametrize("dt_s", [0.0, 0.01])
def test_accelerations_are_integrated_as_by_numpy(rng: np.random.Generator, dt_s: float) -> None:
    rotation, measured = rotation_from_vector(rng.normal(size=3)), rng.normal(size=3)
    gravity, was = np.array([0.0, 0.0, 9.8]), rng.normal(size=(4, 3))
    velocity, displacement = rng.normal(size=(2, 4, 3))
    now: Array = np.vstack([rotation @ measured + gravity, -rotation])
    moved = displacement + velocity * dt_s + (2.0 * was + now) * (dt_s * dt_s / 6.0)
    gained = velocity + (was + now) * (dt_s / 2.0)
    found = integrated(rotation, measured, gravity, was, dt_s, velocity, displacement)
    np.testing.assert_allclose(found, now, atol=ROUNDING)
    np.testing.assert_allclose(velocity, gained, atol=ROUNDING)
    np.testing.assert_allclose(displacement, moved, atol=ROUNDING)
