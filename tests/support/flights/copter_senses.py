"""Senses of the made-up copter: what its autopilot and its link tell of the true state.

An IMU with white noise and bias, and on the line the motors' vibration aliased to white noise while
armed; an attitude with a slow error of its own; a barometer that weather and the rotors' pressure
upset.
"""

from __future__ import annotations

import numpy as np

from companion.geometry.transforms import Array, quaternion_from_rotation, rotation_from_vector
from companion.telemetry import (
    ArmedSample,
    AttitudeSample,
    HeightSample,
    ImuSample,
    LandedSample,
    Telemetry,
)
from tests.support.flights.posed_copter import GRAVITY_NED, STEP_S, Copter

ATTITUDE_EVERY, LEGS_M = 2, 0.2
SIGMA_ACCEL_M_S2, SIGMA_BIAS_M_S2, VIBRATION_M_S2 = 0.08, 0.06, 0.5
SIGMA_GYRO_RAD_S = 0.004
SIGMA_TILT_RAD, TILT_S, SMOOTH_S = np.radians(0.3), 15.0, 1.0
"""An attitude integrates gyroscopes: what it is off by changes smoothly."""
HEIGHT_EVERY, SIGMA_HEIGHT_M, SIGMA_WEATHER_M, WEATHER_S = 10, 0.1, 0.3, 60.0
WASH_M, WASH_HEIGHT_M = -0.5, 0.5
"""What the rotors' pressure takes off the barometric height on the ground, and up to where."""


class Senses:
    """Samples of the true state, with their errors."""

    def __init__(self, seed: int, rng: np.random.Generator, armed_s: float) -> None:
        self._rng, self._weather, self._armed_s = rng, np.random.default_rng(seed), armed_s
        self._weather_m, self._tilt, self._smooth_tilt = 0.0, np.zeros(3), np.zeros(3)
        self._bias = rng.normal(scale=SIGMA_BIAS_M_S2, size=3)
        self._before: Array | None = None
        self.accel_ned_m_s2 = np.zeros(3)
        """As the autopilot's own fast samples have it, without what is aliased."""

    def of(self, step: int, t_ns: int, copter: Copter) -> list[Telemetry]:
        """What is told at a step."""
        rng, truth = self._rng, copter.ned_from_body
        armed, out = step * STEP_S >= self._armed_s, list[Telemetry]()
        self._tilt += -self._tilt * STEP_S / TILT_S
        self._tilt += SIGMA_TILT_RAD * np.sqrt(2 * STEP_S / TILT_S) * rng.normal(size=3)
        self._smooth_tilt += (self._tilt - self._smooth_tilt) * STEP_S / SMOOTH_S
        told = rotation_from_vector(self._smooth_tilt) @ truth
        if step == 0 or step == round(self._armed_s / STEP_S):
            out.append(ArmedSample(t_ns, armed))
        if step % 100 == 0:
            out.append(LandedSample(t_ns, bool(copter.place_m[2] > -LEGS_M - 0.1)))
        if step % ATTITUDE_EVERY == 0:
            out.append(AttitudeSample(t_ns, quaternion_from_rotation(told)))
        if step % HEIGHT_EVERY == 0:
            out.append(HeightSample(t_ns, 80.0 + self._height_m(float(copter.place_m[2]), armed)))
        force = truth.T @ (copter.accel_m_s2 - GRAVITY_NED) + self._bias
        force = force + rng.normal(scale=SIGMA_ACCEL_M_S2, size=3)
        self.accel_ned_m_s2 = told @ force + GRAVITY_NED
        turn = (truth if self._before is None else self._before).T @ truth
        self._before = truth
        rates = np.array([turn[2, 1], turn[0, 2], turn[1, 0]]) / STEP_S
        rates = rates + rng.normal(scale=SIGMA_GYRO_RAD_S, size=3)
        out.append(ImuSample(t_ns, rates, force + rng.normal(scale=VIBRATION_M_S2 * armed, size=3)))
        return out

    def _height_m(self, down_m: float, armed: bool) -> float:
        """Barometric height."""
        every_s = HEIGHT_EVERY * STEP_S
        self._weather_m += -self._weather_m * every_s / WEATHER_S
        swing_m = SIGMA_WEATHER_M * np.sqrt(2 * every_s / WEATHER_S)
        self._weather_m += swing_m * self._weather.normal()
        wash_m = WASH_M * np.exp((down_m + LEGS_M) / WASH_HEIGHT_M) * armed
        return float(self._weather_m + wash_m + SIGMA_HEIGHT_M * self._weather.normal() - down_m)
