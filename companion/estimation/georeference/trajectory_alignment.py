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
    best_similarity,
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

    `down_map` is the vertical (3,) of the map, where it was found with the scale, off by
    `sigma_down_rad` to each side.
    """

    scale: float
    sigma: float
    method: str
    n: int
    down_map: Array | None = None
    sigma_down_rad: float = np.inf


class Level(NamedTuple):
    """A rotation `world_from_map` (3, 3), and standard deviations.

    Those are of its tilt, to each side, and of its heading.
    """

    world_from_map: Array
    sigma_tilt_rad: float
    sigma_yaw_rad: float = float(SIGMA_YAW_RAD)


def apart(first: Scale, second: Scale) -> float:
    """Logarithm of the ratio of two scales."""
    return float(np.log(first.scale / second.scale))


def contradict(first: Scale, second: Scale) -> bool:
    """True where two scales are further apart than their standard deviations allow."""
    return abs(apart(first, second)) >= DISAGREE * float(np.hypot(first.sigma, second.sigma))


def reconciled(first: Scale | None, second: Scale) -> Scale:
    """The more certain of two scales; where they contradict, sigma is their difference."""
    if first is None:
        return second
    best = min(first, second, key=lambda scale: scale.sigma)
    return best._replace(sigma=abs(apart(first, second))) if contradict(first, second) else best


def fused(first: Scale | None, second: Scale) -> Scale:
    """The mean of two scales by different sensors, unless they contradict: see `reconciled`."""
    if first is None or contradict(first, second):
        return reconciled(first, second)
    best, other = sorted((first, second), key=lambda scale: scale.sigma)
    share = best.sigma**2 / (best.sigma**2 + other.sigma**2)
    return best._replace(
        scale=best.scale * float(np.exp(share * apart(other, best))),
        sigma=best.sigma * float(np.sqrt(1.0 - share)),
        method=f"{first.method} and {second.method}",
    )  # fmt: skip


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
    level: Level | None,
    scale: Scale | None,
) -> tuple[Similarity, Array, float] | None:
    """Generalised least squares over (log scale, rotation (3), origin (3)) of N positions.

    `mapped` (N, 3), map units, are fitted to `target` (N, 3), metres; `travelled_m` (N, 3) is
    integrated velocity, nan where missing; `level` and `scale` are priors. A scale that contradicts
    the positions is as uncertain as it is off. Returns the similarity, its covariance (7, 7) and
    the RMS residual in metres; None where nothing fits.
    """
    found = _fit(t_s, mapped, target, travelled_m, level, scale)
    if found is None or scale is None:
        return None if found is None else found[:3]
    similarity, covariance, residual_m, (by_positions, sigma) = found
    apart = abs(float(np.log(scale.scale / by_positions)))
    if apart < DISAGREE * float(np.hypot(sigma, scale.sigma)):
        return similarity, covariance, residual_m
    found = _fit(t_s, mapped, target, travelled_m, level, scale._replace(sigma=apart))
    return None if found is None else found[:3]


def _fit(
    t_s: Array, mapped: Array, target: Array, travelled_m: Array, level: Level | None,
    scale: Scale | None,
) -> tuple[Similarity, Array, float, tuple[float, float]] | None:  # fmt: skip
    """The same with the scale as certain as it says; last the scale without it, and its sigma."""
    estimate = best_similarity(mapped, target, None if level is None else level.world_from_map)
    if not np.isfinite(estimate.scale) or estimate.scale <= 0:
        return None
    keep, cholesky, equations = np.ones(len(t_s), bool), np.eye(len(t_s)), _Equations()
    alone, by_positions = (np.eye(7), np.zeros(7)), estimate.scale
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
        _add_level(equations, estimate, level)
        alone = equations.information.copy(), equations.gradient.copy()
        if scale is not None:
            equations.information[0, 0] += scale.sigma**-2
            equations.gradient[0] += np.log(scale.scale / estimate.scale) / scale.sigma**2
        try:
            solved = np.linalg.solve(equations.information, equations.gradient)
            unaided = np.linalg.solve(*alone)
        except np.linalg.LinAlgError:
            return None
        by_positions = estimate.scale * float(np.exp(np.clip(unaided[0], -0.5, 0.5)))
        delta = np.asarray(solved, np.float64)
        delta[:4] = np.clip(delta[:4], -0.5, 0.5)
        estimate = Similarity(
            estimate.scale * float(np.exp(delta[0])),
            rotation_from_vector(delta[1:4]) @ estimate.rotation,
            estimate.translation + delta[4:],
        )
    inflation = max(equations.chi2 / max(equations.n_rows - 7, 1), 1.0)
    covariance = np.asarray(np.linalg.inv(equations.information) * inflation, np.float64)
    sigma = float(np.sqrt(np.linalg.inv(alone[0])[0, 0] * inflation))
    error = target - estimate.apply(mapped)
    residual_m = float(np.sqrt((error[keep] ** 2).sum(1).mean()))
    return estimate, covariance, residual_m, (by_positions, sigma)


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


def _add_level(equations: _Equations, estimate: Similarity, level: Level | None) -> None:
    weight = np.full(3, 1e-6)
    if level is not None:
        tilt_rad = level.sigma_tilt_rad
        weight = np.array([tilt_rad, tilt_rad, level.sigma_yaw_rad]) ** -2
        error_rad = vector_from_rotation(estimate.rotation @ level.world_from_map.T)
        equations.gradient[1:4] -= weight * error_rad
    equations.information[1:4, 1:4] += np.diag(weight)


def _drift_cholesky(t_s: Array) -> Array:
    """Cholesky factor of the covariance of drifting positions, for one axis."""
    gap = np.abs(t_s[:, None] - t_s[None, :])
    covariance = SIGMA_DRIFT_M**2 * np.exp(-gap / DRIFT_TAU_S) + SIGMA_WHITE_M**2 * np.eye(len(gap))
    return np.asarray(np.linalg.cholesky(covariance), np.float64)
