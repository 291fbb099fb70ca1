"""Integrals of accelerometers are those of the motion, and of a bias in body axes."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from companion.estimation.inertial.acceleration_integral import (
    GRAVITY_NED_M_S2,
    AccelerationIntegral,
)
from companion.geometry.transforms import (
    Array,
    quaternion_from_rotation,
    rotation_from_vector,
    vector_from_rotation,
)
from companion.telemetry import AttitudeSample, ImuSample

RATE_HZ = 200


def turning(t_s: float) -> Array:
    """`ned_from_body` (3, 3) of a body that rolls and yaws."""
    yaw, roll = (
        rotation_from_vector(np.array([0, 0, 0.8 * t_s])),
        np.array([0.3 * np.sin(t_s), 0, 0]),
    )
    return yaw @ rotation_from_vector(roll)


def acceleration(t_s: float) -> Array:
    """Of the body in NED, m/s2."""
    return np.array([1.5 * np.cos(t_s), -0.7 * np.sin(2 * t_s), 0.4])


def rates(t_s: float) -> Array:
    """Of that body, rad/s."""
    turn = turning(t_s - 1e-4).T @ turning(t_s + 1e-4)
    return np.asarray(vector_from_rotation(turn) / 2e-4)


def flown(
    seconds: float,
    bias: Array | None = None,
    without: tuple[float, float] = (0.0, 0.0),
    lever_m: Array | None = None,
) -> AccelerationIntegral:
    """What an accelerometer makes of that flight; without samples in a span of time."""
    integral = AccelerationIntegral(lever_m)
    for i in range(int(seconds * RATE_HZ) + 1):
        t_s = i / RATE_HZ
        t_ns = round(t_s * 1e9)
        if i % 4 == 0:
            integral.take(AttitudeSample(t_ns, quaternion_from_rotation(turning(t_s))))
        force = turning(t_s).T @ (acceleration(t_s) - GRAVITY_NED_M_S2)
        if not without[0] <= t_s < without[1]:
            integral.take(ImuSample(t_ns, rates(t_s), force + (0.0 if bias is None else bias)))
    return integral


def test_it_gives_velocity_and_displacement() -> None:
    change = flown(6.0).between(round(1e9), round(5e9))
    assert change is not None
    t_s = np.linspace(1.0, 5.0, 40_001)
    a = np.stack([acceleration(each) for each in t_s])
    dt = t_s[1] - t_s[0]
    velocity = np.vstack([np.zeros(3), np.cumsum(0.5 * (a[1:] + a[:-1]) * dt, axis=0)])
    displacement = (0.5 * (velocity[1:] + velocity[:-1]) * dt).sum(axis=0)
    assert change.dt_s == pytest.approx(4.0)
    assert change.velocity_m_s == pytest.approx(velocity[-1], abs=2e-3)
    assert change.displacement_m == pytest.approx(displacement, abs=5e-3)


def test_a_place_beside_moves_by_the_turns_of_the_body_too() -> None:
    """A gimbal's head, from the newest samples, too, which are not kept."""
    lever_m, span = np.array([0.3, -0.1, 0.2]), (round(1e9), round(5e9))
    alone, beside = flown(5.0).between(*span), flown(5.0, lever_m=lever_m).between(*span)
    assert alone is not None and beside is not None
    velocity_m_s = [turning(t_s) @ np.cross(rates(t_s), lever_m) for t_s in (1.0, 5.0)]
    moved_m = (turning(5.0) - turning(1.0)) @ lever_m - 4.0 * velocity_m_s[0]
    assert np.linalg.norm(velocity_m_s[1] - velocity_m_s[0]) > 0.1
    gained_m_s = beside.velocity_m_s - alone.velocity_m_s
    assert gained_m_s == pytest.approx(velocity_m_s[1] - velocity_m_s[0], abs=5e-3)
    assert beside.displacement_m - alone.displacement_m == pytest.approx(moved_m, abs=5e-3)


def test_a_bias_changes_them_as_its_derivatives_say() -> None:
    bias = np.array([0.11, -0.23, 0.05])
    span = round(1e9), round(4e9)
    true, wrong = flown(5.0).between(*span), flown(5.0, bias).between(*span)
    assert true is not None and wrong is not None
    back_m_s = wrong.velocity_m_s + wrong.velocity_by_bias @ bias
    back_m = wrong.displacement_m + wrong.displacement_by_bias @ bias
    assert back_m_s == pytest.approx(true.velocity_m_s, abs=1e-4)
    assert back_m == pytest.approx(true.displacement_m, abs=1e-4)


def test_nothing_is_integrated_over_a_gap() -> None:
    integral = flown(6.0, without=(2.0, 2.2))
    assert integral.between(round(1e9), round(4e9)) is None
    assert integral.between(round(0.5e9), round(1.5e9)) is not None
    assert integral.between(round(3e9), round(5e9)) is not None
    assert integral.between(round(5e9), round(9e9)) is None, "nothing has come yet"


@pytest.mark.parametrize("n_gaps", [0, 3, 7])
def test_no_instant_is_without_integrals_but_in_a_gap(n_gaps: int) -> None:
    """Nor the newest, between whose sparse samples both ends of an interval may lie."""
    integral = AccelerationIntegral()
    t_ms = 0
    for gap in range(n_gaps + 1):
        t_ms += 200 * (gap > 0)
        for _ in range(107):
            t_ms += 5
            integral.take(AttitudeSample(t_ms * 1_000_000, np.array([1.0, 0, 0, 0])))
            integral.take(ImuSample(t_ms * 1_000_000, np.zeros(3), np.array([1.0, 0, -9.80665])))
    newest = integral.newest_ns
    for from_ms, to_ms in itertools.combinations(range(0, 300, 7), 2):
        change = integral.between(newest - to_ms * 1_000_000, newest - from_ms * 1_000_000)
        assert change is not None
        assert change.velocity_m_s[0] == pytest.approx(change.dt_s, abs=1e-6)
    if n_gaps:
        assert integral.between(newest - 600_000_000, newest) is None


def test_white_noise_is_measured_by_itself(rng: np.random.Generator) -> None:
    integral = AccelerationIntegral()
    for i in range(2000):
        t_ns = i * 10_000_000
        integral.take(AttitudeSample(t_ns, np.array([1.0, 0, 0, 0])))
        integral.take(ImuSample(t_ns, np.zeros(3), rng.normal(scale=0.08, size=3)))
    assert integral.density_m_s2 == pytest.approx(0.08 * np.sqrt(0.01), rel=0.1)


def test_noise_that_sets_in_is_known_within_half_a_second(rng: np.random.Generator) -> None:
    """Motors that start; and when they stop, it is believed only slowly."""
    integral, densities = AccelerationIntegral(), []
    for i in range(2000):
        scale = 0.5 if 1000 <= i < 1500 else 0.08
        integral.take(ImuSample(i * 10_000_000, np.zeros(3), rng.normal(scale=scale, size=3)))
        densities.append(integral.density_m_s2)
    assert densities[990] == pytest.approx(0.008, rel=0.1)
    assert densities[1050] > 0.033
    assert densities[1490] == pytest.approx(0.05, rel=0.15)
    assert densities[1600] > 0.03
