"""A made-up copter that knows its place by the poses it is sent, as real autopilots do.

Physics are those of a point that leans into where it is told to go. Its autopilot carries place,
velocity and the bias of its accelerometers on by its own IMU, corrects them by each pose at the
pose's time, and flies a cascade: place, velocity with an integral, feed-forward of the set point.
Gains, noises and limits are the defaults of ArduCopter (PSC_, WPNAV_ACCEL_Z, EK3_, VISO_).
"""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import numpy as np

from companion.estimation.gate.pose_to_send import PoseToSend
from companion.geometry.transforms import Array, rotation_from_vector

STEP_S = 0.01
GRAVITY_NED = np.array([0.0, 0.0, 9.80665])
LEAN_S, DRAG_HZ, MAX_ACCEL_M_S2 = 0.15, 0.15, 2.5
GUST_S = 2.0
CLIMB_M_S, CLIMB_M_S2 = 1.0, 1.0
PLACE_P = np.array([1.0, 1.0, 1.0])
VELOCITY_P, VELOCITY_I = np.array([2.0, 2.0, 5.0]), np.array([1.0, 1.0, 1.0])
VELOCITY_D, DERIVATIVE_HZ = np.array([0.5, 0.5, 0.0]), 5.0
SIGMA_PLACE_M, SIGMA_VELOCITY_M_S = 0.2, 0.1
"""Least of a pose: autopilots believe no smaller one."""
SIGMA_ACCEL_M_S2, BIAS_WALK_M_S3 = 0.35, 0.02
TILT_WALK_M_S3 = 0.015 * 9.80665
"""A tilt by which gyroscopes have drifted is learnt, too: it shows as a bias of level axes."""
KEPT = 100
"""Steps back to which a pose may be of."""


class SetPoint(NamedTuple):
    """Place (3,), velocity and acceleration (3,) of the way up, NED, metres."""

    place_m: Array
    velocity_m_s: Array
    accel_m_s2: Array


def climbed(height_m: float, since_s: float) -> SetPoint:
    """Set point so long after lift-off, up to a height: with a limit to acceleration and speed."""
    gains_s = CLIMB_M_S / CLIMB_M_S2
    ends_s = height_m / CLIMB_M_S + gains_s
    t_s, left_s = max(since_s, 0.0), max(ends_s - since_s, 0.0)
    if t_s < gains_s:
        up_m, up_m_s, up_m_s2 = 0.5 * CLIMB_M_S2 * t_s**2, CLIMB_M_S2 * t_s, CLIMB_M_S2
    elif left_s < gains_s:
        up_m = height_m - 0.5 * CLIMB_M_S2 * left_s**2
        up_m_s, up_m_s2 = CLIMB_M_S2 * left_s, -CLIMB_M_S2 * (left_s > 0.0)
    else:
        up_m, up_m_s, up_m_s2 = CLIMB_M_S * (t_s - 0.5 * gains_s), CLIMB_M_S, 0.0
    up = np.array([0.0, 0.0, -1.0])
    return SetPoint(up_m * up, up_m_s * up, up_m_s2 * up)


class PosedAutopilot:
    """Estimate and control; all is NED, metres."""

    def __init__(self) -> None:
        self.known = False
        """True once a pose came."""
        self._state = np.zeros((3, 3))
        """Rows: place, velocity, bias of the acceleration."""
        self._spread = np.tile(np.diag([1.0, 1.0, 0.1]) ** 2, (3, 1, 1))
        """Covariance of these (3, 3) along each axis."""
        self._past: deque[tuple[int, Array]] = deque(maxlen=KEPT)
        """Times and place and velocity (2, 3) then."""
        self._integral, self._slowing = np.zeros(3), np.zeros(3)
        self._slow_m_s: Array | None = None
        self._shift_m = np.zeros(3)
        """Of set points, by resets of the poses."""
        self._n_resets = 0

    @property
    def place_m(self) -> Array:
        """Where it believes to be."""
        return np.asarray(self._state[0])

    def carry_on(self, t_ns: int, accel_ned_m_s2: Array) -> None:
        """Go on to a time by an acceleration (3,) that was measured."""
        step = np.array([[1.0, STEP_S, -0.5 * STEP_S**2], [0.0, 1.0, -STEP_S], [0.0, 0.0, 1.0]])
        by = np.array([0.5 * STEP_S**2, STEP_S, 0.0])
        self._state = step @ self._state + by[:, None] * accel_ned_m_s2
        noise = np.tile(SIGMA_ACCEL_M_S2**2 * np.outer(by, by), (3, 1, 1))
        noise[:, 2, 2] = (np.array([TILT_WALK_M_S3, TILT_WALK_M_S3, BIAS_WALK_M_S3]) * STEP_S) ** 2
        self._spread = step @ self._spread @ step.T + noise
        self._past.append((t_ns, self._state[:2].copy()))

    def take(self, pose: PoseToSend) -> None:
        """Take a pose, at its time; after a reset of the poses the set point moves with them."""
        place_m = pose.world_from_body.translation
        seen = np.stack([place_m, pose.velocity_world_m_s])
        _, before = min(self._past, key=lambda kept: abs(kept[0] - pose.t_ns))
        off = seen - before
        if not self.known or pose.reset_counter != self._n_resets:
            self._shift_m += off[0] if self.known else 0.0
            self.known, self._n_resets = True, pose.reset_counter
            self._state[:2] += off
            gain = np.tile(np.eye(3, 2), (3, 1, 1))
        else:
            sigmas = (
                max(pose.sigma_position_m, SIGMA_PLACE_M),
                max(pose.sigma_velocity_m_s, SIGMA_VELOCITY_M_S),
            )
            innovation = self._spread[:, :2, :2] + np.diag(sigmas) ** 2
            gain = np.linalg.solve(innovation, self._spread[:, :2]).transpose(0, 2, 1)
            self._state += np.einsum("aij,ja->ia", gain, off)
            self._spread = self._spread - gain @ self._spread[:, :2]
        moved = np.einsum("aij,ja->ia", gain[:, :2], off)
        for _, kept in self._past:
            kept += moved

    def accel_wanted(self, wanted: SetPoint) -> Array:
        """Acceleration (3,) towards a set point."""
        away_m = wanted.place_m + self._shift_m - self._state[0]
        slow_m_s = wanted.velocity_m_s + PLACE_P * away_m - self._state[1]
        change = slow_m_s - (slow_m_s if self._slow_m_s is None else self._slow_m_s)
        self._slow_m_s = slow_m_s
        by = 2 * np.pi * DERIVATIVE_HZ * STEP_S
        self._slowing += (change / STEP_S - self._slowing) * by / (1 + by)
        self._integral += VELOCITY_I * slow_m_s * STEP_S
        accel = wanted.accel_m_s2 + VELOCITY_P * slow_m_s + self._integral
        accel = accel + VELOCITY_D * self._slowing
        return np.asarray(
            accel * min(1.0, MAX_ACCEL_M_S2 / max(float(np.linalg.norm(accel)), 1e-9))
        )


class Copter:
    """The true state. It stands on the ground until it is told to leave it."""

    def __init__(self, ground_down_m: float, gusts_m_s2: float) -> None:
        self._ground_down_m, self._gusts_m_s2 = ground_down_m, gusts_m_s2
        self.place_m, self.velocity_m_s = np.array([0.0, 0.0, ground_down_m]), np.zeros(3)
        self.accel_m_s2 = np.zeros(3)
        self._lean, self._gust_m_s2 = np.zeros(2), np.zeros(3)
        self._heading = rotation_from_vector(np.array([0.0, 0.0, 0.6]))

    @property
    def ned_from_body(self) -> Array:
        """Attitude (3, 3)."""
        lean = np.array([self._lean[1], -self._lean[0], 0.0])
        return np.asarray(rotation_from_vector(lean) @ self._heading)

    def step(self, accel_wanted_m_s2: Array | None, rng: np.random.Generator) -> None:
        """Go on by a step, towards an acceleration (3,); None where motors idle."""
        wanted = np.zeros(3) if accel_wanted_m_s2 is None else accel_wanted_m_s2
        lean = np.arctan2(wanted[:2], GRAVITY_NED[2])
        self._lean += (lean - self._lean) * STEP_S / LEAN_S
        self._gust_m_s2 += -self._gust_m_s2 * STEP_S / GUST_S
        self._gust_m_s2 += self._gusts_m_s2 * np.sqrt(2 * STEP_S / GUST_S) * rng.normal(size=3)
        self.accel_m_s2 = np.zeros(3)
        if accel_wanted_m_s2 is None:
            return
        accel = np.append(GRAVITY_NED[2] * np.tan(self._lean), wanted[2])
        accel = accel + self._gust_m_s2 - DRAG_HZ * self.velocity_m_s
        falls_m = (self.velocity_m_s[2] + accel[2] * STEP_S) * STEP_S
        if self.place_m[2] + falls_m > self._ground_down_m:
            accel = -self.velocity_m_s / STEP_S  # it stands
        self.accel_m_s2 = accel
        self.velocity_m_s = self.velocity_m_s + accel * STEP_S
        self.place_m = self.place_m + self.velocity_m_s * STEP_S
