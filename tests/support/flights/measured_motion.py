"""Made-up motions of a body, and what an imperfect IMU and autopilot measured of them."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from companion.estimation.inertial.acceleration_integral import GRAVITY_NED_M_S2
from companion.geometry.transforms import (
    Array,
    quaternion_from_rotation,
    rotation_from_vector,
    vector_from_rotation,
)
from companion.telemetry import AttitudeSample, ImuSample

STEP_S = 0.01
Path = Callable[[float], Array]
"""Place (3,) in NED, metres, by the time in seconds."""


def weaving(t_s: float) -> Array:
    """Place in NED, metres: 3 m to either side, 1.5 m up and down, on its way north."""
    return np.array([2.0 * t_s, 3.0 * np.sin(0.9 * t_s), -20.0 + 1.5 * np.sin(0.6 * t_s)])


def straight(t_s: float) -> Array:
    return np.array([4.0 * t_s, 1.0 * t_s, -20.0])


def hovering(t_s: float) -> Array:
    return np.array([0.0, 0.0, -20.0 + 0.0 * t_s])


def turned(t_s: float) -> Array:
    """`ned_from_body` (3, 3)."""
    return rotation_from_vector(np.array([0.1 * np.sin(t_s), 0.05, 0.2 * t_s]))


def velocity(path: Path, t_s: float) -> Array:
    """Velocity (3,) along a path, m/s."""
    return (path(t_s + STEP_S) - path(t_s - STEP_S)) / (2.0 * STEP_S)


class MeasuredMotion:
    """Samples of 100 Hz accelerations, 50 Hz attitudes, with white noise, a bias and a tilt."""

    def __init__(
        self, path: Path, rng: np.random.Generator, seconds: float, axes: Array | None = None,
        sigma_m_s2: float = 0.08,
    ) -> None:  # fmt: skip
        self._path, self._rng, self._seconds, self._axes = path, rng, seconds, axes
        self._sigma_m_s2 = sigma_m_s2
        self.bias_m_s2 = rng.normal(scale=0.08, size=3)
        """Of the accelerometers, in body axes (3,)."""
        self.tilt = rotation_from_vector(rng.normal(scale=0.005, size=3))
        """Error (3, 3) of the autopilot's attitude."""

    def samples(self) -> Iterator[AttitudeSample | ImuSample]:
        """In order of time."""
        path, h = self._path, STEP_S
        for i in range(int(self._seconds / h)):
            t_s = i * h
            t_ns, turn = round(t_s * 1e9), turned(t_s)
            if i % 2 == 0:
                yield AttitudeSample(t_ns, quaternion_from_rotation(self.tilt @ turn))
            a = (path(t_s + h) - 2 * path(t_s) + path(t_s - h)) / h**2
            noise = self._rng.normal(scale=self._sigma_m_s2, size=3)
            force = turn.T @ (a - GRAVITY_NED_M_S2) + self.bias_m_s2 + noise
            rates = vector_from_rotation(turned(t_s - h).T @ turned(t_s + h)) / (2.0 * h)
            yield ImuSample(t_ns, rates, force if self._axes is None else self._axes @ force)
