"""Certainty of the direction of translation between two views, by covariance propagation.

Over a plane, or with little parallax, rotation and translation look nearly alike in two images: a
direction may then be off by tens of degrees though all matches agree with it.
"""

from __future__ import annotations

import numpy as np

from companion.geometry.transforms import Array, Pose, skew


def direction_sigma_rad(
    b_from_a: Pose, normalised_a: Array, normalised_b: Array, whitening_a: Array,
    whitening_b: Array, rotation_sigma_rad: float | None,
) -> float:  # fmt: skip
    """Standard deviation of the unit translation, across its least certain direction.

    By the Sampson errors of N matches (N, 2) with their whitening (N, 2, 2), and a prior of the
    rotation about each axis, where there is one. Infinite where nothing is known.
    """
    n = len(normalised_a)
    a, b = np.c_[normalised_a, np.ones(n)], np.c_[normalised_b, np.ones(n)]
    t, turned = b_from_a.translation, a @ b_from_a.rotation.T
    essential = skew(t) @ b_from_a.rotation
    slope_b, slope_a = (a @ essential.T)[:, :2], (b @ essential)[:, :2]
    variance = np.zeros(n)
    for slope, white in ((slope_a, whitening_a), (slope_b, whitening_b)):
        # of a position the covariance is the inverse of its squared whitening
        part = np.linalg.solve(white.transpose(0, 2, 1), slope[..., None])[..., 0]
        variance += (part * part).sum(1)
    across = np.linalg.svd(t[None])[2][1:]
    by_rotation = b * (turned @ t)[:, None] - t * (turned * b).sum(1)[:, None]
    jacobian = np.c_[by_rotation, np.cross(turned, b) @ across.T]
    weighted = jacobian / np.maximum(variance, 1e-18)[:, None]
    information = weighted.T @ jacobian
    if rotation_sigma_rad is not None:
        information[:3, :3] += np.eye(3) / rotation_sigma_rad**2
    try:
        covariance = np.linalg.inv(information)[3:, 3:]
    except np.linalg.LinAlgError:
        return float("inf")
    return float(np.sqrt(max(np.linalg.eigvalsh(covariance)[-1], 0.0)))
