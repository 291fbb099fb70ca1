"""Alignment of a map with measured positions by generalised least squares.

GPS errors are modelled as an Ornstein-Uhlenbeck process, so that a metre of drift over a minute
does not bias the scale; displacements by velocity, with uncorrelated errors, are added.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

from companion.geometry.transforms import (
    Array,
    Similarity,
    rotation_from_vector,
    skew,
    vector_from_rotation,
)

Bools = NDArray[np.bool_]
DRIFT_TAU_S = 40.0
SIGMA_DRIFT_M = 1.0
SIGMA_WHITE_M = 0.15
SIGMA_VELOCITY_M_S = 0.15
VELOCITY_TAU_S = 1.0
MAX_STEP_S = 5.0
"""Between two positions, for velocity to give the displacement."""
SIGMA_TILT_RAD = np.radians(0.5)
SIGMA_YAW_RAD = np.radians(6.0)
ITERATIONS, OUTLIER_ITERATION = 12, 6
DISAGREE = 3.0
"""Standard deviations beyond which two scales contradict."""


class Scale(NamedTuple):
    """Metres per map unit, relative standard deviation, method, and number of measurements.

    `down_map` is the vertical (3,) of the map, where it was found with the scale.
    """

    scale: float
    sigma: float
    method: str
    n: int
    down_map: Array | None = None


def reconciled(first: Scale, second: Scale) -> Scale:
    """The more certain of two scales; where they contradict, sigma is their difference."""
    best = min(first, second, key=lambda scale: scale.sigma)
    apart = abs(float(np.log(first.scale / second.scale)))
    if apart < DISAGREE * float(np.hypot(first.sigma, second.sigma)):
        return best
    return best._replace(sigma=apart)


class _Equations:
    """Normal equations of (log scale, rotation (3), origin (3)), and the residual cost."""

    def __init__(self) -> None:
        self.information = np.zeros((7, 7))
        self.gradient = np.zeros(7)
        self.chi2, self.n_rows = 0.0, 0

    def add(self, jacobian: Array, residual: Array, n_measured: int) -> None:
        """Add weighted rows (N, 7) and (N,), `n_measured` of which are measurements."""
        self.information += jacobian.T @ jacobian
        self.gradient += jacobian.T @ residual
        self.chi2 += float(residual @ residual)
        self.n_rows += n_measured


def fit_map(
    t_s: Array,
    mapped: Array,
    target: Array,
    travelled_m: Array,
    level: Array | None,
    scale: Scale | None,
) -> tuple[Similarity, Array, float] | None:
    """Generalised least squares over (log scale, rotation (3), origin (3)) of N positions.

    `mapped` (N, 3), map units, are fitted to `target` (N, 3), metres; `travelled_m` (N, 3) is
    integrated velocity, nan where missing; `level` the rotation world_from_map by attitude; `scale`
    a prior on the scale. Returns the similarity, its covariance (7, 7) and the RMS residual in
    metres; None where nothing fits.
    """
    estimate = _initial_guess(mapped, target, level)
    if not np.isfinite(estimate.scale) or estimate.scale <= 0:
        return None
    keep, cholesky, equations = np.ones(len(t_s), bool), np.eye(len(t_s)), _Equations()
    for iteration in range(ITERATIONS):
        rotated = estimate.scale * mapped @ estimate.rotation.T
        residual = target - rotated - estimate.translation
        if iteration == OUTLIER_ITERATION:  # outliers beyond drift
            size = np.linalg.norm(residual - np.median(residual, axis=0), axis=1)
            keep = size < max(5.0 * float(np.median(size)), 3.0)
        if iteration in (0, OUTLIER_ITERATION):
            cholesky = _drift_cholesky(t_s[keep])
        # Jacobian of the prediction: scale, rotation, origin
        jacobian = np.zeros((len(t_s), 3, 7))
        jacobian[:, :, 0] = rotated
        jacobian[:, :, 1:4] = -skew(rotated)
        jacobian[:, :, 4:] = np.eye(3)
        equations = _Equations()
        for axis in range(3):
            j = solve_triangular(cholesky, jacobian[keep, axis], lower=True)
            r = solve_triangular(cholesky, residual[keep, axis], lower=True)
            equations.add(j, r, len(r))
        _add_displacements(equations, t_s, jacobian, rotated, travelled_m, keep)
        _add_priors(equations, estimate, level, scale)
        try:
            solved = np.linalg.solve(equations.information, equations.gradient)
        except np.linalg.LinAlgError:
            return None
        delta = np.asarray(solved, np.float64)
        delta[:4] = np.clip(delta[:4], -0.5, 0.5)
        estimate = Similarity(
            estimate.scale * float(np.exp(delta[0])),
            rotation_from_vector(delta[1:4]) @ estimate.rotation,
            estimate.translation + delta[4:],
        )
    inflation = max(equations.chi2 / max(equations.n_rows - 7, 1), 1.0)
    covariance = np.asarray(np.linalg.inv(equations.information) * inflation, np.float64)
    error = target - estimate.apply(mapped)
    return estimate, covariance, float(np.sqrt((error[keep] ** 2).sum(1).mean()))


def _add_displacements(
    equations: _Equations,
    t_s: Array,
    jacobian: Array,
    rotated: Array,
    travelled_m: Array,
    keep: Bools,
) -> None:
    """Displacements between successive positions by velocity; robust (Huber)."""
    dt = np.diff(t_s)
    known = np.isfinite(travelled_m[1:, :2] - travelled_m[:-1, :2]).all(1)
    use = known & (dt > 0) & (dt < MAX_STEP_S) & keep[1:] & keep[:-1]
    if not use.any():
        return
    j = (jacobian[1:] - jacobian[:-1])[use]
    r = ((travelled_m[1:] - travelled_m[:-1]) - (rotated[1:] - rotated[:-1]))[use]
    measured = np.isfinite(r)
    j, r = j * measured[..., None], np.where(measured, r, 0.0)
    sigma_m = SIGMA_VELOCITY_M_S * np.sqrt(dt[use] * np.maximum(dt[use], VELOCITY_TAU_S))
    weight = 1.0 / sigma_m
    length = np.linalg.norm(r, axis=1) * weight
    weight = weight * np.sqrt(np.minimum(1.0, 3.0 / np.maximum(length, 1e-9)))
    equations.add(
        (j * weight[:, None, None]).reshape(-1, 7), (r * weight[:, None]).reshape(-1),
        int(measured.sum()),
    )  # fmt: skip


def _add_priors(
    equations: _Equations, estimate: Similarity, level: Array | None, scale: Scale | None
) -> None:
    if scale is not None:
        equations.information[0, 0] += scale.sigma**-2
        equations.gradient[0] += np.log(scale.scale / estimate.scale) / scale.sigma**2
    weight = np.full(3, 1e-6)
    if level is not None:
        weight = np.array([SIGMA_TILT_RAD, SIGMA_TILT_RAD, SIGMA_YAW_RAD]) ** -2
        rotation_error = vector_from_rotation(estimate.rotation @ level.T)
        equations.gradient[1:4] -= weight * rotation_error
    equations.information[1:4, 1:4] += np.diag(weight)


def _initial_guess(mapped: Array, target: Array, level: Array | None) -> Similarity:
    """Closed form (Umeyama 1991); rotation fixed where the level is known."""
    ma, mb = mapped.mean(0), target.mean(0)
    a, b = mapped - ma, target - mb
    if level is None:
        u, d, vt = np.linalg.svd(b.T @ a)
        sign = np.diag([1, 1, np.sign(np.linalg.det(u @ vt))])
        rotation = u @ sign @ vt
        scale = float((d * np.diag(sign)).sum() / (a * a).sum())
    else:
        rotation = level
        a = a @ level.T
        scale = float(np.sqrt((b * b).sum() / max(float((a * a).sum()), 1e-18)))
    return Similarity(scale, rotation, mb - scale * rotation @ ma)


def _drift_cholesky(t_s: Array) -> Array:
    """Cholesky factor of the covariance of drifting positions, for one axis."""
    gap = np.abs(t_s[:, None] - t_s[None, :])
    covariance = SIGMA_DRIFT_M**2 * np.exp(-gap / DRIFT_TAU_S) + SIGMA_WHITE_M**2 * np.eye(len(gap))
    return np.asarray(np.linalg.cholesky(covariance), np.float64)
