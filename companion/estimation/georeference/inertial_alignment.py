"""Scale of a map by accelerometers and all tracked frames of a window at once.

With rotations known, the motion of the body is linear in its place and velocity at some nodes, the
accelerometers' bias and a tilt, which both walk. Accelerations preintegrated between nodes (Forster
et al., "On-Manifold Preintegration for Real-Time Visual-Inertial Odometry", 2017) and the frames
about each node make a least squares problem with banded normal equations. With its weights fixed in
map units, it is quadratic in the inverse of the scale: the map is regressed on what accelerometers
measured, so that no first guess is needed, and noise of the map does not make the scale small. What
noise of the accelerometers has in the regressors is known, and taken out of their squares (the
corrected score of Stefanski, 1985): nothing follows from how much anything scatters, and where a
body does not accelerate, nothing is left.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_solve_banded, cholesky_banded

from companion.estimation.georeference.tracked_places import Places
from companion.estimation.inertial.acceleration_integral import GRAVITY_NED_M_S2, NO_GAP
from companion.estimation.inertial.inertial_motion import (
    BIAS,
    PLACE,
    SIGMA_BIAS_M_S2,
    SIGMA_SPEED_M_S,
    SIGMA_TILT_M_S2,
    TILT,
    VELOCITY,
    InertialStart,
)
from companion.geometry.transforms import Array

TILT_TAU_S = 200.0
"""A tilt of the levelled map stays so long."""
BIAS_WALK_M_S2 = 1e-3
"""Random walk of the bias, m/s2 per root of a second: 0.06 in an hour, by warming."""
SIGMA_DRIFT = 1e-3
"""Drift of the map over a way of one unit, in units."""
SIGMA_JUMP_M = 1000.0
"""Of a place after a gap in the accelerations, over which velocity says nothing."""
STEP = 0.05
"""Of the logarithm of the scale, for a derivative."""
N_STATE = TILT.stop
START = slice(VELOCITY.start, BIAS.stop)
LOWER = [(a, b) for b in range(N_STATE) for a in range(b, N_STATE)]
FULL = [(a, b) for b in range(N_STATE) for a in range(N_STATE)]


class Moves(NamedTuple):
    """Motion from one time to another (M of each), in level axes.

    Velocity and displacement gained from rest (M, 3), and their derivatives (M, 3, 3) by the bias.
    """

    dt_s: Array
    gained_m_s: Array
    moved_m: Array
    gained_by_bias: Array
    moved_by_bias: Array


def nodes_of(t_ns: NDArray[np.int64], spacing_ns: int) -> NDArray[np.int64]:
    """Indices of the first time (N,) of each interval of a spacing that has one."""
    if not len(t_ns):
        return np.zeros(0, np.int64)
    return np.unique(np.searchsorted(t_ns, np.arange(t_ns[0], t_ns[-1] + 1, spacing_ns)))


class _Seen(NamedTuple):
    """Normal equations of `n` frames, of unit weight, in metres.

    Their band, the right side by places in units and by what is not the state, and the sums of
    products of these: units squared, negative mixed, the others squared.
    """

    band: Array
    where: Array
    offset: Array
    squares: Array
    n: int


class Fit(NamedTuple):
    """A scale, its relative standard deviation, the map's vertical, and how well all fits.

    `down_map` (3,) is a unit vector, off by `sigma_down_rad` to each side; `log_likelihood` is that
    of the scale it was weighted for, up to a constant; `squared` the squared normalised residual
    per degree of freedom, 1 where the model is true.
    """

    scale: float
    sigma: float
    down_map: Array
    sigma_down_rad: float
    log_likelihood: float
    squared: float


class _Equations(NamedTuple):
    """Factorised normal equations, the right sides without and by the scale, and determinants."""

    factor: Array
    right: Array
    by_scale: Array
    squares: float
    log_determinant: float


class InertialAlignment:
    """Frames with the accelerations up to each, for scales that are to be compared.

    `sums` (F, 9, 3) are those of `AccelerationIntegral.at` at the frames, all known. `level` (3, 3)
    is the rotation from map to NED. Where the motion was known at the first frame, that is `start`.
    """

    def __init__(
        self, places: Places, sums: Array, nodes: NDArray[np.int64], level: Array,
        lever_camera_m: Array, density_m_s2: float, start: InertialStart | None,
    ) -> None:  # fmt: skip
        t_s = (places.t_ns - places.t_ns[0]) * 1e-9
        rotations = level @ places.rotations
        where = (places.places - places.places[0]) @ level.T
        node_of = np.searchsorted(0.5 * (t_s[nodes[1:]] + t_s[nodes[:-1]]), t_s)
        first = np.searchsorted(node_of, np.arange(len(nodes)))
        turns = np.add.reduceat(rotations @ places.ned_from_camera.transpose(0, 2, 1), first)
        self.n_nodes, self._density_m_s2, self._level = len(nodes), density_m_s2, level
        # between nodes; across a gap nothing is known
        steps = _moves(t_s, sums, nodes[:-1], nodes[1:], _nearest_rotations(turns[1:] + turns[:-1]))
        known = np.abs(np.diff(sums[nodes, 8, 0])) < NO_GAP
        self._steps = Moves(*(np.where(_like(known, each), each, 0.0) for each in steps))
        self._dt_s, self._known = steps.dt_s, known
        self._way = np.linalg.norm(np.diff(where[nodes], axis=0), axis=1)
        # frames by the state at their node
        by = _moves(
            t_s, sums, nodes[node_of], np.arange(len(t_s)), _nearest_rotations(turns)[node_of]
        )
        sees = np.zeros((len(t_s), 3, N_STATE))
        sees[:, :, PLACE] = np.eye(3)
        sees[:, :, VELOCITY] = by.dt_s[:, None, None] * np.eye(3)
        sees[:, :, BIAS] = by.moved_by_bias
        sees[:, :, TILT] = 0.5 * by.dt_s[:, None, None] ** 2 * np.eye(3, 2)
        offset_m = rotations @ lever_camera_m + by.moved_m
        used = np.abs(sums[:, 8, 0] - sums[nodes[node_of], 8, 0]) < NO_GAP
        sees[~used], offset_m[~used], where[~used] = 0.0, 0.0, 0.0
        transposed = sees.transpose(0, 2, 1)
        self._seen = _Seen(
            _band(np.add.reduceat(transposed @ sees, first), None),
            np.add.reduceat((transposed @ where[..., None])[..., 0], first).ravel(),
            np.add.reduceat((transposed @ offset_m[..., None])[..., 0], first).ravel(),
            np.array([(where**2).sum(), -(where * offset_m).sum(), (offset_m**2).sum()]),
            int(np.count_nonzero(used)),
        )
        self._prior, self._prior_mean = _prior(start)
        # places and velocities that nothing is known of, at first and after gaps: determinants
        # count them as noise, but no square of the regressors has any of it
        n_parts = 2 * (1 + np.count_nonzero(~known)) - (start is not None)
        self._n_unknown = 3 * int(n_parts)

    @property
    def sustained_m_s2(self) -> float:
        """Size of the mean acceleration that was measured."""
        lasted_s = float(self._dt_s[self._known].sum())
        return float(np.linalg.norm(self._steps.gained_m_s.sum(0))) / max(lasted_s, 1e-9)

    def fit(self, scale: float, sigma_map: float) -> Fit | None:
        """Scale with weights as for one near it, where a frame's place has this noise, map units.

        None where accelerations show none.
        """
        found, seen = self._equations(scale, sigma_map), self._seen
        weight = (scale * sigma_map) ** -2
        rights = np.stack([found.by_scale, found.right], 1)
        mean_tilt = np.tile(np.eye(N_STATE)[:, TILT] / self.n_nodes, (self.n_nodes, 1))
        solved = cho_solve_banded(
            (found.factor, True), np.concatenate([rights, mean_tilt], 1), check_finite=False
        )
        solved, spread = solved[:, :2], mean_tilt.T @ solved[:, 2:]
        squares = np.array([[seen.squares[0], seen.squares[1]], [seen.squares[1], seen.squares[2]]])
        # squared residual of a scale s: (s, 1) times this times (s, 1)
        left = weight * squares - rights.T @ solved
        left[1, 1] += found.squares
        squared = float(np.array([scale, 1.0]) @ left @ np.array([scale, 1.0]))
        wider = self._equations(scale * np.exp(STEP), sigma_map)
        by_noise = 0.5 * (found.log_determinant - wider.log_determinant) / STEP - self._n_unknown
        signal = float(left[1, 1]) - by_noise
        if signal <= 0.0 or left[0, 1] >= 0.0:
            return None
        # noise of the map on the regressors, and that of these on themselves
        sigma = float(np.sqrt(signal + 2.0 * max(by_noise, 0.0))) / signal
        best = signal / -float(left[0, 1])
        tilt_by_scale, tilt = (mean_tilt.T @ solved).T
        down = GRAVITY_NED_M_S2 + np.r_[best * tilt_by_scale + tilt, 0.0]
        variance = np.diag(spread) + (sigma * best * tilt_by_scale) ** 2
        return Fit(
            best, sigma, self._level.T @ (down / np.linalg.norm(down)),
            float(np.sqrt(variance.max()) / np.linalg.norm(down)),
            -0.5 * (squared + found.log_determinant), squared / (3.0 * seen.n),
        )  # fmt: skip

    def _equations(self, scale: float, sigma_map: float) -> _Equations:
        dt, one, steps = self._dt_s[:, None, None], np.eye(3), self._steps
        step = np.tile(np.eye(N_STATE), (len(dt), 1, 1))
        step[:, PLACE, VELOCITY] = dt * one
        step[:, PLACE, BIAS], step[:, VELOCITY, BIAS] = steps.moved_by_bias, steps.gained_by_bias
        step[:, PLACE, TILT] = 0.5 * dt**2 * one[:, :2]
        step[:, VELOCITY, TILT] = dt * one[:, :2]
        held = np.exp(-dt / TILT_TAU_S)
        step[:, TILT, TILT] = held * np.eye(2)
        noise, density = np.zeros_like(step), self._density_m_s2**2
        drift = (SIGMA_DRIFT * scale) ** 2 * self._way
        jump = np.where(self._known, 0.0, 1.0)
        noise[:, PLACE, PLACE] = density * dt**3 / 3.0 * one
        noise[:, PLACE, PLACE] += (drift + jump * SIGMA_JUMP_M**2)[:, None, None] * one
        noise[:, PLACE, VELOCITY] = noise[:, VELOCITY, PLACE] = density * dt**2 / 2.0 * one
        noise[:, VELOCITY, VELOCITY] = density * dt * one
        noise[:, VELOCITY, VELOCITY] += (jump * SIGMA_SPEED_M_S**2)[:, None, None] * one
        noise[:, BIAS, BIAS] = BIAS_WALK_M_S2**2 * dt * one
        noise[:, TILT, TILT] = SIGMA_TILT_M_S2**2 * (1.0 - held**2) * np.eye(2)
        weight = np.linalg.inv(noise)
        gained = np.zeros((len(dt), N_STATE))
        gained[:, PLACE], gained[:, VELOCITY] = steps.moved_m, steps.gained_m_s
        back = step.transpose(0, 2, 1) @ weight
        diagonal, right = (
            np.zeros((self.n_nodes, N_STATE, N_STATE)),
            np.zeros((self.n_nodes, N_STATE)),
        )
        diagonal[0] = self._prior
        diagonal[:-1] += back @ step
        diagonal[1:] += weight
        right[0] = self._prior @ self._prior_mean
        squared = float(self._prior_mean @ right[0])
        right[:-1] -= (back @ gained[..., None])[..., 0]
        weighted = (weight @ gained[..., None])[..., 0]
        right[1:] += weighted
        squared += float((weighted * gained).sum())
        seen, by_map = self._seen, (scale * sigma_map) ** -2
        band = _band(diagonal, -back) + by_map * seen.band
        factor = cholesky_banded(band, overwrite_ab=True, lower=True, check_finite=False)
        determinant = 2.0 * float(np.log(factor[0]).sum())
        determinant += float(np.linalg.slogdet(noise)[1].sum())
        return _Equations(
            factor, right.ravel() - by_map * seen.offset, by_map * seen.where, squared,
            determinant + 6.0 * seen.n * float(np.log(sigma_map)),
        )  # fmt: skip


def _moves(
    t_s: Array, sums: Array, since: NDArray[np.int64], until: NDArray[np.int64], turns: Array
) -> Moves:
    """Motion between frames; `turns` (M, 3, 3) bring the autopilot's axes to level ones."""
    dt_s = t_s[until] - t_s[since]
    change, before, dt = sums[until] - sums[since], sums[since], dt_s[:, None]
    # gravity is not turned with what was measured
    gained = change[:, 0] - dt * GRAVITY_NED_M_S2
    moved = change[:, 1] - dt * before[:, 0] - 0.5 * dt**2 * GRAVITY_NED_M_S2
    return Moves(
        dt_s, (turns @ gained[..., None])[..., 0] + dt * GRAVITY_NED_M_S2,
        (turns @ moved[..., None])[..., 0] + 0.5 * dt**2 * GRAVITY_NED_M_S2,
        turns @ change[:, 2:5], turns @ (change[:, 5:8] - dt[..., None] * before[:, 2:5]),
    )  # fmt: skip


def _nearest_rotations(sums: Array) -> Array:
    """Chordal means (M, 3, 3) by the sums (M, 3, 3) of rotations."""
    u, _, vt = np.linalg.svd(sums)
    return np.asarray(u @ vt, np.float64)


def _like(mask: NDArray[np.bool_], values: Array) -> NDArray[np.bool_]:
    return mask.reshape(-1, *([1] * (values.ndim - 1)))


def _prior(start: InertialStart | None) -> tuple[Array, Array]:
    """Information (N, N) and mean (N,) of the first state."""
    information, mean = np.zeros((N_STATE, N_STATE)), np.zeros(N_STATE)
    information[VELOCITY, VELOCITY] = np.eye(3) / SIGMA_SPEED_M_S**2
    information[BIAS, BIAS] = np.eye(3) / SIGMA_BIAS_M_S2**2
    information[TILT, TILT] = np.eye(2) / SIGMA_TILT_M_S2**2
    if start is not None:
        information[START, START] = np.linalg.inv(start.covariance)
        mean[START] = np.r_[start.velocity_ned_m_s, start.bias_body_m_s2]
    return information, mean


def _band(diagonal: Array, above: Array | None) -> Array:
    """Lower band of a symmetric matrix by its blocks (M, N, N) on the diagonal and above it."""
    n = len(diagonal)
    band = np.zeros((2 * N_STATE, n, N_STATE))
    for a, b in LOWER:
        band[a - b, :, b] = diagonal[:, a, b]
    if above is not None:
        for a, b in FULL:
            band[N_STATE + a - b, :-1, b] = above[:, b, a]
    return band.reshape(2 * N_STATE, n * N_STATE)
