"""An IMU less the biases of the autopilot's EKF, which learns them within seconds of a take-off."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from companion.estimation.body.aiding import AidedPlace
from companion.estimation.body.body_filter import BodyFilter
from companion.estimation.inertial.acceleration_integral import AccelerationIntegral
from companion.geometry.geodesy import STANDARD_GRAVITY_M_S2
from companion.geometry.transforms import (
    Array,
    quaternion_from_rotation,
    rotation_from_quaternion,
    rotation_from_vector,
)
from companion.telemetry import AttitudeSample, ImuSample
from tests.support.flights.measured_motion import STEP_S, MeasuredMotion, velocity, weaving

LEARNS_S, LEARNT_S = 8.0, 11.0
BLIND_S, END_S, SIGMA_M = 12.0, 16.95, 0.01
TAKEN_FOR_LEVEL_M_S2 = np.array([0.11, -0.07, 0.0])
"""Bias in body axes that the EKF has taken for 0.8 degrees of tilt while it stood."""


def samples_of_ekf(rng: np.random.Generator, marked: bool) -> Iterator[AttitudeSample | ImuSample]:
    """What the autopilot sends: IMU less what its EKF takes for biases, and its attitude."""
    motion = MeasuredMotion(weaving, rng, END_S + 5.0 * STEP_S, sigma_m_s2=0.05)
    motion.tilt = np.eye(3)
    motion.bias_m_s2 = TAKEN_FOR_LEVEL_M_S2
    x, y, _ = TAKEN_FOR_LEVEL_M_S2 / STANDARD_GRAVITY_M_S2
    for sample in motion.samples():
        t_s = sample.t_ns * 1e-9
        learnt = float(np.clip((t_s - LEARNS_S) / (LEARNT_S - LEARNS_S), 0.0, 1.0))
        if isinstance(sample, ImuSample):
            accel_m_s2 = sample.accel_m_s2 - learnt * TAKEN_FOR_LEVEL_M_S2
            yield replace(sample, accel_m_s2=accel_m_s2, less_biases=marked)
        else:
            off = rotation_from_vector((1.0 - learnt) * np.array([-y, x, 0.0]))
            rotation = rotation_from_quaternion(sample.ned_from_body) @ off
            yield AttitudeSample(sample.t_ns, quaternion_from_rotation(rotation))


class Flown:
    """Aided by places until BLIND_S, then by accelerations alone."""

    def __init__(self, seed: int, marked: bool) -> None:
        rng, self.integral, next_s = np.random.default_rng(seed), AccelerationIntegral(), 0.0
        self.navigation = BodyFilter(self.integral)
        for sample in samples_of_ekf(rng, marked):
            self.integral.take(sample)
            t_s = sample.t_ns * 1e-9
            if next_s <= t_s < BLIND_S:
                next_s += 1.0 / 15.0
                noisy_m: Array = weaving(t_s) + rng.normal(scale=SIGMA_M, size=3)
                self.navigation.aid(AidedPlace(sample.t_ns, noisy_m, np.eye(3), SIGMA_M))

    def off_m_s2(self) -> float:
        """Error of the mean level acceleration in the five seconds after the EKF has learnt."""
        change = self.integral.between(round(BLIND_S * 1e9), round(END_S * 1e9))
        assert change is not None
        gained_m_s = velocity(weaving, END_S) - velocity(weaving, BLIND_S)
        return float(np.linalg.norm((change.velocity_m_s - gained_m_s)[:2])) / change.dt_s

    def off_m(self) -> float:
        """Error of dead reckoning at their end."""
        found = self.navigation.at(round(END_S * 1e9))
        assert found is not None
        return float(np.linalg.norm(found.place_m - weaving(END_S)))


def test_what_the_ekf_has_learnt_does_not_move_the_body() -> None:
    flights = [Flown(seed, marked=True) for seed in range(3)]
    assert max(flight.off_m_s2() for flight in flights) < 0.01
    assert max(flight.off_m() for flight in flights) < 0.9


def test_unmarked_it_looks_like_an_acceleration() -> None:
    """By a level of our own, which keeps what the autopilot's was off by."""
    flights = [Flown(seed, marked=False) for seed in range(3)]
    assert min(flight.off_m_s2() for flight in flights) > 0.015
    assert min(flight.off_m() for flight in flights) > 1.1
