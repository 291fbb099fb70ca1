"""A velocity that a prediction holds, and by how much what is predicted is less certain for it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from companion.estimation.body.limits import SIGMA_JERK_M_S3
from companion.messages import Odometry

SIGMA_ACCELERATION_M_S2 = 3.0
"""Of a vehicle before two frames tell its acceleration: 17 degrees of tilt."""
MAX_BETWEEN_S = 0.5
"""Frames further apart tell no acceleration of now."""


class Growth(NamedTuple):
    """Standard deviations, along each axis, of what has come to place and velocity since."""

    place_m: float
    velocity_m_s: float


class HeldVelocity:
    """Tells the acceleration of a vehicle by the velocities of its last two frames."""

    def __init__(self) -> None:
        self._last: Odometry | None = None
        self._sigma_m_s2 = SIGMA_ACCELERATION_M_S2

    def take(self, odometry: Odometry) -> None:
        """Take a frame with a velocity."""
        last, self._last = self._last, odometry
        self._sigma_m_s2 = SIGMA_ACCELERATION_M_S2
        if last is None or last.reset_counter != odometry.reset_counter:
            return
        dt_s = (odometry.t_ns - last.t_ns) * 1e-9
        if not 0.0 < dt_s <= MAX_BETWEEN_S:
            return
        assert last.velocity_world_m_s is not None and odometry.velocity_world_m_s is not None
        changed_m_s = np.linalg.norm(odometry.velocity_world_m_s - last.velocity_world_m_s)
        self._sigma_m_s2 = float(changed_m_s) / (dt_s * float(np.sqrt(3.0)))

    def after(self, ahead_s: float) -> Growth:
        """Growth of a prediction by the velocity of the last frame."""
        assert self._last is not None
        sigma_m_s2 = float(np.hypot(self._sigma_m_s2, SIGMA_JERK_M_S3 * ahead_s / 2.0))
        changed_m_s = sigma_m_s2 * ahead_s
        drifted_m = float(np.hypot(self._last.sigma_velocity_m_s, changed_m_s / 2.0)) * ahead_s
        return Growth(drifted_m, changed_m_s)
