"""Motion of a body with given rotations, by what its accelerometers measured: linear in its state.

The state begins with place and velocity (NED, m, m/s), the accelerometers' bias in body axes, and
the horizontal acceleration by tilt (both m/s2); what comes after does not change.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from companion.estimation.inertial.acceleration_integral import GRAVITY_NED_M_S2, Change
from companion.geometry.transforms import Array

PLACE, VELOCITY, BIAS, TILT = slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 11)
SIGMA_BIAS_M_S2 = 0.15
"""Of a calibrated MEMS accelerometer: 15 mg from one power-on to the next."""
SIGMA_TILT_M_S2 = 0.1
"""Horizontal acceleration by a tilt of 0.6 degrees."""
SIGMA_SPEED_M_S = 20.0


class InertialStart(NamedTuple):
    """Velocity (3,), NED, m/s, and bias (3,) of the accelerometers in body axes, m/s2, at a time.

    With their covariance (6, 6), in that order.
    """

    t_ns: int
    velocity_ned_m_s: Array
    bias_body_m_s2: Array
    covariance: Array


class Motion(NamedTuple):
    """Transition (N, N), its noise (N, N), and what is added to place and velocity (3,) each."""

    step: Array
    noise: Array
    moved_m: Array
    gained_m_s: Array


def motion(
    change: Change, turn: Array, density_m_s2: float, tilt_tau_s: float, n_state: int
) -> Motion:
    """Motion over a change that was measured; `turn` (3, 3) brings its axes to those of the state.

    `density_m_s2` is the noise density of the accelerometers, per root of Hz, and `tilt_tau_s` how
    long a tilt stays.
    """
    dt, one = change.dt_s, np.eye(3)
    gravity = GRAVITY_NED_M_S2 * dt  # is not turned with what was measured
    held = float(np.exp(-dt / tilt_tau_s))
    step = np.eye(n_state)
    step[PLACE, VELOCITY] = dt * one
    step[PLACE, BIAS] = turn @ change.displacement_by_bias
    step[VELOCITY, BIAS] = turn @ change.velocity_by_bias
    step[PLACE, TILT] = 0.5 * dt * dt * one[:, :2]
    step[VELOCITY, TILT] = dt * one[:, :2]
    step[TILT, TILT] = held * np.eye(2)
    noise = np.zeros((n_state, n_state))
    noise[PLACE, PLACE] = density_m_s2**2 * dt**3 / 3.0 * one
    noise[PLACE, VELOCITY] = noise[VELOCITY, PLACE] = density_m_s2**2 * dt**2 / 2.0 * one
    noise[VELOCITY, VELOCITY] = density_m_s2**2 * dt * one
    noise[TILT, TILT] = SIGMA_TILT_M_S2**2 * (1.0 - held**2) * np.eye(2)
    return Motion(
        step, noise, turn @ (change.displacement_m - 0.5 * dt * gravity) + 0.5 * dt * gravity,
        turn @ (change.velocity_m_s - gravity) + gravity,
    )  # fmt: skip
