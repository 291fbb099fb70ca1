"""State of the body's filter: a mean with its covariance, and how both go on with time."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from companion.estimation.body.limits import SIGMA_JERK_M_S3
from companion.estimation.inertial.acceleration_integral import AccelerationIntegral, Change
from companion.estimation.inertial.inertial_motion import (
    BIAS,
    PLACE,
    SIGMA_TILT_M_S2,
    TILT,
    VELOCITY,
    InertialStart,
    motion,
)
from companion.geometry.transforms import Array

DRIFT = slice(TILT.stop, TILT.stop + 2)
"""Change of the horizontal acceleration by tilt, m/s3: gyroscopes have a bias."""
DOWN, GROUND, BAROMETER = PLACE.stop - 1, DRIFT.stop, DRIFT.stop + 1
"""Down coordinates, after the state of `motion`: of the ground below, of the barometer's zero."""
SCALE = BAROMETER + 1
"""Logarithm of the map's metre over the true one. Its mean is 0: it is not corrected, but what it
has made of the rest of the state is known, so that it is put right when a better scale comes."""
N_STATE = SCALE + 1
SIGMA_DRIFT_M_S3, DRIFT_TAU_S = 0.003, 200.0
"""By a bias of a fiftieth of a degree per second."""
BIAS_WALK_M_S2 = 1e-3
"""Random walk of the bias, m/s2 per root of a second: 0.06 in an hour, by warming."""
RELIEF_M2_PER_M = 0.1
"""Random walk of the height of the ground below, over the level way: 1 m after 10 m."""
BAROMETER_WALK_M = 0.05
"""Walk of a barometer's zero with the weather and its temperature, per root of a second: a metre
in seven minutes."""
UNMEASURED_M_S2 = 1.5
"""White acceleration where none is measured, per root of Hz: a copter that gains and loses 1 m/s2
and more for a second."""


class BodyState(NamedTuple):
    """Mean (N,) and covariance (N, N) at a time, in the frame of the places that aid it.

    The mean begins as that of `motion` does, place and velocity in metres of the map; then the
    heights of ground and barometer, and the map's scale. Those without a variance are not known.
    `world_from_attitude` (3, 3) goes from the axes of the attitude to those of the places.
    """

    t_ns: int
    mean: Array
    covariance: Array
    world_from_attitude: Array

    def moved(self, rotation: Array, about_m: Array, to_m: Array, scale: float) -> BodyState:
        """The same in another frame: what was at `about_m` is at `to_m`, turned and scaled."""
        mean, turn = self.mean.copy(), scale * rotation
        mean[PLACE] = to_m + turn @ (mean[PLACE] - about_m)
        mean[GROUND] = to_m[2] + scale * (mean[GROUND] - about_m[2])
        mean[BAROMETER] += to_m[2] - about_m[2]
        change = np.eye(N_STATE)
        change[PLACE, PLACE] = change[VELOCITY, VELOCITY] = turn
        change[TILT, TILT] = change[DRIFT, DRIFT] = rotation[:2, :2]
        change[GROUND, GROUND] = scale
        for part in (VELOCITY, TILT, DRIFT):
            mean[part] = change[part, part] @ mean[part]
        return BodyState(
            self.t_ns, mean, change @ self.covariance @ change.T,
            rotation @ self.world_from_attitude,
        )  # fmt: skip

    def rescaled(self, about_m: Array, ratio: float, sigma: float) -> BodyState:
        """The same in a map whose scale, known to `sigma` now, has grown by a ratio.

        What the scale before was off by is known better, and what followed from it: the new scale
        takes the place of the one before as if this had been known from the beginning.
        """
        variance = self.covariance[SCALE, SCALE]
        if not variance > 0.0:
            return self.without(SCALE)._with_scale(sigma).moved(np.eye(3), about_m, about_m, ratio)
        by_scale = self.covariance[:, SCALE] / variance
        mean = self.mean - by_scale * np.log(ratio)
        mean[SCALE] = 0.0
        change = (sigma**2 - variance) * np.outer(by_scale, by_scale)
        state = self._replace(mean=mean, covariance=self.covariance + change)
        return state.moved(np.eye(3), about_m, about_m, ratio)

    def in_true_metres(self) -> BodyState:
        """The same with a velocity in true metres."""
        change = np.eye(N_STATE)
        change[VELOCITY, SCALE] = -self.mean[VELOCITY]
        return self._replace(covariance=change @ self.covariance @ change.T)

    def in_map(self, place_m: Array, sigma_m: float, sigma_scale: float) -> BodyState:
        """The same in another map, in which a place (3,) is where the body is by definition."""
        state = self.in_true_metres().with_part(PLACE, place_m, sigma_m)
        state = state.without(SCALE)._with_scale(sigma_scale)
        change = np.eye(N_STATE)
        change[VELOCITY, SCALE] = state.mean[VELOCITY]
        return state._replace(covariance=change @ state.covariance @ change.T)

    def _with_scale(self, sigma: float) -> BodyState:
        covariance = self.covariance.copy()
        covariance[SCALE, SCALE] = sigma**2
        return self._replace(covariance=covariance)

    def without(self, *parts: slice | int) -> BodyState:
        """The same with parts that are not known."""
        covariance = self.covariance.copy()
        for part in parts:
            covariance[part, :] = covariance[:, part] = 0.0
        return self._replace(covariance=covariance)

    def with_part(self, part: slice | int, value: Array | float, sigma: float) -> BodyState:
        """The same with a part that is known anew, to a standard deviation on each axis."""
        state, mean = self.without(part), self.mean.copy()
        mean[part] = value
        axes = np.arange(len(mean))[part]
        state.covariance[axes, axes] = sigma**2
        return state._replace(mean=mean)

    def with_barometer(self, height_m: float, sigma_m: float) -> BodyState:
        """The same with a barometer's zero, by its first height above that, of a known noise.

        The zero is as uncertain as the body's own height, and with it: what follows tells of the
        change of the height, and nothing of where it was.
        """
        mean, covariance = self.mean.copy(), self.covariance.copy()
        mean[BAROMETER] = mean[DOWN] + height_m
        covariance[BAROMETER, :] = covariance[DOWN, :]
        covariance[:, BAROMETER] = covariance[:, DOWN]
        covariance[BAROMETER, BAROMETER] = covariance[DOWN, DOWN] + sigma_m**2
        return self._replace(mean=mean, covariance=covariance)

    def sigma(self, part: slice) -> float:
        """The largest standard deviation of a part along an axis."""
        return float(np.sqrt(max(np.diag(self.covariance)[part].max(), 0.0)))


class Reckoned(NamedTuple):
    """Place, velocity (3,) each, local NED, metres, and their standard deviations per axis.

    `start` is what another map's scale can be found from; accelerometers alone have told of the
    level motion for `unaided_s`.
    """

    place_m: Array
    velocity_m_s: Array
    sigma_place_m: float
    sigma_velocity_m_s: float
    start: InertialStart
    unaided_s: float = 0.0


def propagated(state: BodyState, t_ns: int, integral: AccelerationIntegral) -> BodyState | None:
    """The state at a later time, by what accelerometers measured; None where that is missing."""
    change = integral.between(state.t_ns, t_ns)
    return None if change is None else _changed(state, t_ns, change, integral)


def carried_on(state: BodyState, t_ns: int, integral: AccelerationIntegral) -> BodyState:
    """The state of the newest sample of accelerometers at a later time, were it to stay so."""
    dt_s = (t_ns - state.t_ns) * 1e-9
    after = _changed(state, t_ns, integral.beyond(dt_s), integral)
    sigma_m_s2 = float(np.hypot(integral.sigma_m_s2, SIGMA_JERK_M_S3 * dt_s / 2.0))
    grown = np.zeros((N_STATE, 3))
    grown[PLACE] = 0.5 * dt_s * dt_s * sigma_m_s2 * np.eye(3)
    grown[VELOCITY] = dt_s * sigma_m_s2 * np.eye(3)
    return after._replace(covariance=after.covariance + grown @ grown.T)


def _changed(
    state: BodyState, t_ns: int, change: Change, integral: AccelerationIntegral
) -> BodyState:
    """The state after a change that was measured."""
    tilt_tau_s = 2.0 * (SIGMA_TILT_M_S2 / integral.level.walk_m_s2) ** 2
    turn, dt = state.world_from_attitude, change.dt_s
    found = motion(change, turn, integral.density_m_s2, tilt_tau_s, N_STATE)
    for part, power, by in ((TILT, 1, 1.0), (VELOCITY, 2, 2.0), (PLACE, 3, 6.0)):
        found.step[part, DRIFT] = dt**power / by * np.eye(part.stop - part.start, 2)
    kept = float(np.exp(-dt / DRIFT_TAU_S))
    found.step[DRIFT, DRIFT] = kept * np.eye(2)
    found.noise[DRIFT, DRIFT] = SIGMA_DRIFT_M_S3**2 * (1.0 - kept**2) * np.eye(2)
    mean = found.step @ state.mean
    mean[PLACE] += found.moved_m
    mean[VELOCITY] += found.gained_m_s
    step = found.step
    gained_m_s = mean[VELOCITY] - state.mean[VELOCITY]
    step[VELOCITY, SCALE] = gained_m_s
    step[PLACE, SCALE] = mean[PLACE] - state.mean[PLACE] - dt * state.mean[VELOCITY]
    covariance = step @ state.covariance @ step.T + found.noise
    return _walked(state, state._replace(t_ns=t_ns, mean=mean, covariance=covariance))


def held(state: BodyState, t_ns: int) -> BodyState:
    """The state at a later time without accelerations: the velocity stays, and is less certain."""
    dt = (t_ns - state.t_ns) * 1e-9
    step, noise = np.eye(N_STATE), np.zeros((N_STATE, N_STATE))
    step[PLACE, VELOCITY] = dt * np.eye(3)
    variance = UNMEASURED_M_S2**2 * np.eye(3)
    noise[PLACE, PLACE], noise[VELOCITY, VELOCITY] = dt**3 / 3.0 * variance, dt * variance
    noise[PLACE, VELOCITY] = noise[VELOCITY, PLACE] = dt**2 / 2.0 * variance
    covariance = step @ state.covariance @ step.T + noise
    return _walked(state, state._replace(t_ns=t_ns, mean=step @ state.mean, covariance=covariance))


def _walked(before: BodyState, after: BodyState) -> BodyState:
    """With what else has changed meanwhile."""
    covariance, dt = after.covariance, (after.t_ns - before.t_ns) * 1e-9
    if covariance[BIAS, BIAS].any():
        covariance[BIAS, BIAS] += BIAS_WALK_M_S2**2 * dt * np.eye(3)
    if covariance[BAROMETER, BAROMETER] > 0.0:
        covariance[BAROMETER, BAROMETER] += BAROMETER_WALK_M**2 * dt
    if covariance[GROUND, GROUND] > 0.0:
        way_m = float(np.linalg.norm((after.mean[PLACE] - before.mean[PLACE])[:2]))
        covariance[GROUND, GROUND] += RELIEF_M2_PER_M * way_m
    return after
