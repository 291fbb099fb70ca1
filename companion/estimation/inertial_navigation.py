"""Inertial navigation of the body, aided by tracked poses: what dead reckoning goes by.

Rotations are those of the autopilot, which integrates its gyroscopes itself; given them, place,
velocity, the accelerometers' bias and the tilt are linear, and a Kalman filter of these has no
point of linearisation to be wrong about (the same model finds the scale, see `inertial_scale`).
"""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import numpy as np

from companion.estimation.acceleration_integral import AccelerationIntegral, Change
from companion.estimation.inertial_motion import (
    BIAS,
    PLACE,
    SIGMA_BIAS_M_S2,
    SIGMA_SPEED_M_S,
    SIGMA_TILT_M_S2,
    TILT,
    VELOCITY,
    motion,
)
from companion.geometry.transforms import Array

N_STATE = 11
TILT_TAU_S = 20.0
"""An autopilot's attitude is wrong otherwise after each manoeuvre."""
BIAS_WALK_M_S2 = 1e-3
"""Random walk of the bias, m/s2 per root of a second: 0.06 in an hour, by warming."""
LEAST_SIGMA_PLACE_M = 0.005
MAX_HELD_NS = 400_000_000
"""Beyond the newest acceleration, the velocity is held for at most so long."""
SIGMA_HELD_M_S2 = 3.0
"""Acceleration that may have come since."""
REFUSED = 16.3
"""Chi-square of three degrees of freedom exceeded once in a thousand times."""
NORMALISED_TAU = 30
"""Places, two seconds of them."""
MAX_REFUSED_NS = 1_000_000_000
"""Places refused for longer are believed: the filter begins anew."""


class AidedPlace(NamedTuple):
    """A tracked place (3,) of the body, local NED, metres, and `world_from_attitude` (3, 3)."""

    t_ns: int
    place_m: Array
    world_from_attitude: Array
    sigma_m: float


class Reckoned(NamedTuple):
    """Place, velocity (3,) each, local NED, metres, and their standard deviations per axis."""

    place_m: Array
    velocity_m_s: Array
    sigma_place_m: float
    sigma_velocity_m_s: float


class InertialNavigation:
    """Kalman filter of one body in a frame that changes only by what it is told.

    Places may be given before the accelerations up to their time are there: they wait.
    """

    def __init__(self, integral: AccelerationIntegral) -> None:
        self._integral = integral
        self._waiting: deque[AidedPlace] = deque()
        self._x, self._covariance = np.zeros(N_STATE), np.zeros((N_STATE, N_STATE))
        self._t_ns: int | None = None
        self._refused_since_ns: int | None = None
        self.world_from_attitude = np.eye(3)
        """Rotation (3, 3) from the autopilot's NED axes to those of the places."""
        self._normalised = 1.0
        """Mean squared innovation per degree of freedom, of the latest places."""
        self.n_refused = 0
        """Places that were refused by the innovation gate."""

    def aid(self, place: AidedPlace) -> None:
        """Add a tracked place; its time is that of the autopilot's stamps."""
        self._waiting.append(place)
        while self._waiting and self._waiting[0].t_ns <= self._integral.newest_ns:
            self._take(self._waiting.popleft())
        while len(self._waiting) > 1 and (
            self._waiting[-1].t_ns - self._waiting[0].t_ns > MAX_HELD_NS
        ):
            self._waiting.popleft()  # no accelerations come

    def reset(self) -> None:
        """Forget place and velocity; bias and tilt are the same in another map."""
        self._t_ns = None
        self._waiting.clear()

    def move(self, rotation: Array, about_m: Array, to_m: Array, scale: float) -> None:
        """Change of the frame: what was at `about_m` is at `to_m`, turned and scaled about it."""
        self._x[PLACE] = to_m + scale * rotation @ (self._x[PLACE] - about_m)
        self._x[VELOCITY] = scale * rotation @ self._x[VELOCITY]
        self.world_from_attitude = rotation @ self.world_from_attitude
        self._waiting = deque(
            each._replace(
                place_m=to_m + scale * rotation @ (each.place_m - about_m),
                world_from_attitude=rotation @ each.world_from_attitude,
            )
            for each in self._waiting
        )

    def at(self, t_ns: int) -> Reckoned | None:
        """Place and velocity at a time by autopilot stamps; None where not known.

        Not before the last place that was taken.
        """
        if self._t_ns is None:
            return None
        end_ns = min(t_ns, self._integral.newest_ns)
        if t_ns - end_ns > MAX_HELD_NS or end_ns < self._t_ns:
            return None
        x, covariance = self._x, self._covariance
        if end_ns > self._t_ns:
            change = self._integral.between(self._t_ns, end_ns)
            if change is None:
                return None
            x, covariance = self._predicted(change)
        held_s = (t_ns - end_ns) * 1e-9
        # accelerations that do not fit what is seen are stated as less certain
        unlikely = max(1.0, float(np.sqrt(self._normalised)))
        sigma_v = unlikely * float(np.hypot(_sigma(covariance, VELOCITY), SIGMA_HELD_M_S2 * held_s))
        moved_m = SIGMA_HELD_M_S2 * held_s * held_s / 2.0
        sigma_p = unlikely * float(np.linalg.norm([
            _sigma(covariance, PLACE), moved_m, _sigma(covariance, VELOCITY) * held_s
        ]))  # fmt: skip
        return Reckoned(x[PLACE] + held_s * x[VELOCITY], x[VELOCITY].copy(), sigma_p, sigma_v)

    def _take(self, place: AidedPlace) -> None:
        change = None
        if self._t_ns is not None and place.t_ns > self._t_ns:
            change = self._integral.between(self._t_ns, place.t_ns)
        if change is None:
            self._begin(place)
            return
        self.world_from_attitude = place.world_from_attitude
        x, covariance = self._predicted(change)
        variance = max(place.sigma_m, LEAST_SIGMA_PLACE_M) ** 2
        innovation = place.place_m - x[PLACE]
        seen = covariance[PLACE]
        spread = seen[:, PLACE] + variance * np.eye(3)
        squared = float(innovation @ np.linalg.solve(spread, innovation))
        self._normalised += (squared / 3.0 - self._normalised) / NORMALISED_TAU
        if squared > REFUSED:
            self.n_refused += 1
            since_ns = self._refused_since_ns or place.t_ns
            self._refused_since_ns = since_ns
            if place.t_ns - since_ns > MAX_REFUSED_NS:
                self._begin(place)
            return
        self._refused_since_ns = None
        gain = np.linalg.solve(spread, seen).T
        self._x = x + gain @ innovation
        covariance = covariance - gain @ seen
        self._covariance = 0.5 * (covariance + covariance.T)
        self._t_ns = place.t_ns

    def _begin(self, place: AidedPlace) -> None:
        """Place and velocity anew."""
        self._t_ns = place.t_ns
        self._refused_since_ns = None
        self.world_from_attitude = place.world_from_attitude
        if not self._covariance[BIAS, BIAS].any():
            self._covariance[BIAS, BIAS] = SIGMA_BIAS_M_S2**2 * np.eye(3)
            self._covariance[TILT, TILT] = SIGMA_TILT_M_S2**2 * np.eye(2)
        for part in (PLACE, VELOCITY):
            self._covariance[part, :] = self._covariance[:, part] = 0.0
        self._x[PLACE], self._x[VELOCITY] = place.place_m, 0.0
        self._covariance[PLACE, PLACE] = max(place.sigma_m, LEAST_SIGMA_PLACE_M) ** 2 * np.eye(3)
        self._covariance[VELOCITY, VELOCITY] = SIGMA_SPEED_M_S**2 * np.eye(3)

    def _predicted(self, change: Change) -> tuple[Array, Array]:
        """State and covariance after a change of motion that accelerometers measured."""
        density = self._integral.density_m_s2
        found = motion(change, self.world_from_attitude, density, TILT_TAU_S, N_STATE)
        x = found.step @ self._x
        x[PLACE] += found.moved_m
        x[VELOCITY] += found.gained_m_s
        covariance = found.step @ self._covariance @ found.step.T + found.noise
        covariance[BIAS, BIAS] += BIAS_WALK_M_S2**2 * change.dt_s * np.eye(3)
        return x, covariance


def _sigma(covariance: Array, part: slice) -> float:
    """The largest standard deviation along an axis."""
    return float(np.sqrt(max(np.diag(covariance)[part].max(), 0.0)))
