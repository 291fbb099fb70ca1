"""A map laid over the autopilot's positions, whose errors wander: generalised least squares.

Position errors of a GPS are modelled as an Ornstein-Uhlenbeck process, so that a metre of drift
over a minute does not pass for scale; ways travelled by velocity, whose errors do not add up, are
used beside them.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.linalg import solve_triangular

from companion.geometry import Array, Similarity, rotation_from_vector, skew, vector_from_rotation

DRIFT_TAU_S = 40.0
SIGMA_DRIFT_M = 1.0
SIGMA_WHITE_M = 0.15
SIGMA_VELOCITY_M_S = 0.15
VELOCITY_TAU_S = 1.0
SIGMA_TILT_RAD = np.radians(0.5)
SIGMA_YAW_RAD = np.radians(6.0)
DISAGREE = 3.0
"""Standard deviations by which two scales differ that cannot both be right."""


class Scale(NamedTuple):
    """Metres per map unit, its relative standard deviation, and what told it."""

    scale: float
    sigma: float
    method: str
    n: int


def agreed(first: Scale, second: Scale) -> Scale:
    """The better of two, no surer than they agree: a rangefinder may see what the map does not."""
    best = min(first, second, key=lambda scale: scale.sigma)
    apart = abs(float(np.log(first.scale / second.scale)))
    if apart < DISAGREE * float(np.hypot(first.sigma, second.sigma)):
        return best
    return best._replace(sigma=apart)


def fit_map(
    t_s: Array,
    mapped: Array,
    target: Array,
    way: Array,
    level: Array | None,
    scale: Scale | None,
) -> tuple[Similarity, Array, float] | None:
    """Generalised least squares over (log scale, turn (3), origin (3)); covariance (7, 7).

    `scale` is what others say of it.
    """
    guess = _start(mapped, target, level)
    if not np.isfinite(guess.scale) or guess.scale <= 0:
        return None
    prior = (
        np.array([1 / SIGMA_TILT_RAD, 1 / SIGMA_TILT_RAD, 1 / SIGMA_YAW_RAD])
        if level is not None
        else np.full(3, 1e-3)
    )
    keep = np.ones(len(t_s), bool)
    steps = np.isfinite(way[1:, :2] - way[:-1, :2]).all(1)
    dt = np.diff(t_s)
    information, chi2, n_rows, root = np.eye(7), 0.0, 1, np.eye(len(t_s))
    for iteration in range(12):
        turned = guess.scale * mapped @ guess.rotation.T
        residual = target - turned - guess.translation
        if iteration == 6:  # positions that no drift explains
            size = np.linalg.norm(residual - np.median(residual, axis=0), axis=1)
            keep = size < max(5.0 * float(np.median(size)), 3.0)
        # derivative of the prediction: scale, turn, origin
        jac = np.zeros((len(t_s), 3, 7))
        jac[:, :, 0] = turned
        jac[:, :, 1:4] = -skew(turned)
        jac[:, :, 4:] = np.eye(3)
        information = np.zeros((7, 7))
        gradient = np.zeros(7)
        chi2, n_rows = 0.0, 0
        if iteration in (0, 6):
            root = _drift_root(t_s[keep])
        for axis in range(3):
            j = solve_triangular(root, jac[keep, axis], lower=True)
            r = solve_triangular(root, residual[keep, axis], lower=True)
            information += j.T @ j
            gradient += j.T @ r
            chi2 += float(r @ r)
            n_rows += len(r)
        use = steps & (dt < 5.0) & keep[1:] & keep[:-1]
        if use.any():
            j = (jac[1:] - jac[:-1])[use]
            r = ((way[1:] - way[:-1]) - (turned[1:] - turned[:-1]))[use]
            told = np.isfinite(r)
            j, r = j * told[..., None], np.where(told, r, 0.0)
            sigma_m = SIGMA_VELOCITY_M_S * np.sqrt(dt[use] * np.maximum(dt[use], VELOCITY_TAU_S))
            weight = 1.0 / sigma_m
            length = np.linalg.norm(r, axis=1) * weight
            weight = weight * np.sqrt(np.minimum(1.0, 3.0 / np.maximum(length, 1e-9)))
            j, r = j * weight[:, None, None], r * weight[:, None]
            information += np.einsum("nij,nik->jk", j, j)
            gradient += np.einsum("nij,ni->j", j, r)
            chi2 += float((r * r).sum())
            n_rows += int(told.sum())
        if scale is not None:
            information[0, 0] += scale.sigma**-2
            gradient[0] += np.log(scale.scale / guess.scale) / scale.sigma**2
        if level is not None:
            turn = vector_from_rotation(guess.rotation @ level.T)
            information[1:4, 1:4] += np.diag(prior**2)
            gradient[1:4] -= prior**2 * turn
        else:
            information[1:4, 1:4] += np.diag(prior**2)
        try:
            delta = np.asarray(np.linalg.solve(information, gradient), np.float64)
        except np.linalg.LinAlgError:
            return None
        delta[:4] = np.clip(delta[:4], -0.5, 0.5)
        guess = Similarity(
            guess.scale * float(np.exp(delta[0])),
            rotation_from_vector(delta[1:4]) @ guess.rotation,
            guess.translation + delta[4:],
        )
    inflation = max(chi2 / max(n_rows - 7, 1), 1.0)
    covariance = np.asarray(np.linalg.inv(information) * inflation, np.float64)
    error = target - guess.apply(mapped)
    return guess, covariance, float(np.sqrt((error[keep] ** 2).sum(1).mean()))


def _start(mapped: Array, target: Array, level: Array | None) -> Similarity:
    """Closed form (Umeyama 1991); about the vertical only where the level is known."""
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


def _drift_root(t_s: Array) -> Array:
    """Cholesky factor of the covariance of slowly wandering positions, for one axis."""
    gap = np.abs(t_s[:, None] - t_s[None, :])
    covariance = SIGMA_DRIFT_M**2 * np.exp(-gap / DRIFT_TAU_S) + SIGMA_WHITE_M**2 * np.eye(len(gap))
    return np.asarray(np.linalg.cholesky(covariance), np.float64)
