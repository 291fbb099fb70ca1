"""Two-view triangulation."""

from __future__ import annotations

import numpy as np

from companion.geometry.transforms import Array, Pose
from companion.slam.features.orb_features import Bools


def triangulate(normalised_a: Array, normalised_b: Array, b_from_a: Pose) -> tuple[Array, Array]:
    """Linear triangulation (Hartley & Sturm 1997) of N pairs.

    Returns points in a (N, 3), nan where rays are parallel, and the cosine of each parallax (N,).
    """
    n = len(normalised_a)
    rows = np.empty((n, 4, 4))
    m = np.hstack([b_from_a.rotation, b_from_a.translation[:, None]])
    rows[:, 0] = np.c_[-np.ones(n), np.zeros(n), normalised_a[:, 0], np.zeros(n)]
    rows[:, 1] = np.c_[np.zeros(n), -np.ones(n), normalised_a[:, 1], np.zeros(n)]
    rows[:, 2] = normalised_b[:, :1] * m[2] - m[0]
    rows[:, 3] = normalised_b[:, 1:] * m[2] - m[1]
    rows /= np.linalg.norm(rows, axis=2, keepdims=True)
    a, rhs = rows[:, :, :3], -rows[:, :, 3]
    normal = np.matmul(a.transpose(0, 2, 1), a)
    right = np.matmul(a.transpose(0, 2, 1), rhs[..., None])
    good = np.abs(np.linalg.det(normal)) > 1e-18
    points = np.full((n, 3), np.nan)
    points[good] = np.linalg.solve(normal[good], right[good])[..., 0]
    rays_a = np.c_[normalised_a, np.ones(n)]
    rays_b = np.c_[normalised_b, np.ones(n)] @ b_from_a.rotation
    cosine = (rays_a * rays_b).sum(1) / (
        np.linalg.norm(rays_a, axis=1) * np.linalg.norm(rays_b, axis=1)
    )
    return points, cosine


def consistent(
    points_a: Array,
    b_from_a: Pose,
    normalised_a: Array,
    normalised_b: Array,
    whitening_a: Array,
    whitening_b: Array,
    max_chi2: float = 5.991,
) -> Bools:
    """Mask of points (N, 3) in front of both cameras with reprojection errors below `max_chi2`."""
    in_b = b_from_a.apply(points_a)
    with np.errstate(invalid="ignore", divide="ignore"):
        ok = (points_a[:, 2] > 0) & (in_b[:, 2] > 0) & np.isfinite(points_a).all(1)
        for p, seen, white in (
            (points_a, normalised_a, whitening_a),
            (in_b, normalised_b, whitening_b),
        ):
            error = np.matmul(white, (p[:, :2] / p[:, 2:] - seen)[..., None])[..., 0]
            ok &= (error * error).sum(1) < max_chi2
    return ok
