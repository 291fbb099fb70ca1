"""A velocity that is held: what it is off by after a while is what is stated."""

from __future__ import annotations

import numpy as np
import pytest

from companion.estimation.gate.held_velocity import SIGMA_ACCELERATION_M_S2, HeldVelocity
from companion.messages import Odometry, TrackState
from tests.support.flights.measured_motion import velocity, weaving

SIGMA_M_S = 0.03


def frame(t_s: float, velocity_m_s: np.ndarray, reset_counter: int = 0) -> Odometry:
    return Odometry(
        0, round(t_s * 1e9), TrackState.TRACKING, reset_counter,
        velocity_world_m_s=velocity_m_s, sigma_velocity_m_s=SIGMA_M_S,
    )  # fmt: skip


@pytest.mark.parametrize("period_s", [1 / 30, 1 / 10])
def test_what_is_stated_is_what_it_is_off_by(period_s: float, rng: np.random.Generator) -> None:
    held, squares, beyond = HeldVelocity(), [], 0
    for t_s in np.arange(0.0, 40.0, period_s):
        measured = velocity(weaving, t_s) + rng.normal(scale=SIGMA_M_S, size=3)
        held.take(frame(t_s, measured))
        ahead_s = 0.5 * period_s
        off_m_s = measured - velocity(weaving, t_s + ahead_s)
        sigma_m_s = np.hypot(SIGMA_M_S, held.after(ahead_s).velocity_m_s)
        squares.append(float(off_m_s @ off_m_s) / sigma_m_s**2)
        beyond += squares[-1] > 7.815
    assert 0.5 < np.mean(squares[1:]) / 3.0 < 1.5
    assert beyond / len(squares) < 0.1


def test_before_two_frames_of_one_course_any_acceleration_may_be() -> None:
    held, steady = HeldVelocity(), np.array([5.0, 0.0, 0.0])
    held.take(frame(0.0, steady))
    unknown_m_s = held.after(0.1).velocity_m_s
    assert unknown_m_s > 0.1 * SIGMA_ACCELERATION_M_S2
    held.take(frame(0.1, steady))
    assert held.after(0.1).velocity_m_s < 0.3 * unknown_m_s
    held.take(frame(0.2, steady, reset_counter=1))
    assert held.after(0.1).velocity_m_s == unknown_m_s
    held.take(frame(1.2, steady, reset_counter=1))
    assert held.after(0.1).velocity_m_s == unknown_m_s
