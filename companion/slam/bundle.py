"""Bundle adjustment: cameras and points together, by the Schur complement (Triggs et al. 1999).

Levenberg-Marquardt with Huber's loss. The camera-point blocks are a block-sparse matrix, so that a
window of ten cameras and a whole flight of hundreds are the same code and little memory.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.sparse import bsr_matrix

from companion.geometry import Array, Pose, rotation_from_vector
from companion.slam.features import Bools, Ints
from companion.slam.plumb import Plumb
from companion.slam.pose_refinement import CHI2_2D, HUBER


@dataclass(slots=True, eq=False)
class Bundle:
    """Cameras (C), points (P, 3) and observations (O): which camera sees which point where.

    `plumb` is what is told of the vertical, of all cameras.

    The first `n_variable` cameras move, the others hold the gauge. `normalised` (O, 2) and
    `whitening` (O, 2, 2) are as in Features. No camera sees a point twice.
    """

    poses: list[Pose]
    n_variable: int
    points: Array
    camera: Ints
    point: Ints
    normalised: Array
    whitening: Array
    plumb: Plumb | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Adjusted:
    """Adjusted poses and points, which observations agree (O,), and the cost before and after."""

    poses: list[Pose]
    points: Array
    inlier: Bools
    cost_before: float
    cost_after: float


def _project(rotation: Array, translation: Array, points: Array, b: Bundle) -> tuple[Array, Array]:
    p = np.matmul(rotation[b.camera], points[b.point][..., None])[..., 0] + translation[b.camera]
    z = np.where(np.abs(p[:, 2]) < 1e-9, 1e-9, p[:, 2])
    error = p[:, :2] / z[:, None] - b.normalised
    return p, np.matmul(b.whitening, error[..., None])[..., 0]


def _cost(residual: Array, depth: Array) -> float:
    size = np.sqrt((residual * residual).sum(1))
    robust = np.where(size < HUBER, 0.5 * size * size, HUBER * (size - 0.5 * HUBER))
    return float(np.where(depth > 0, robust, HUBER * 100.0).sum())


def adjust(
    bundle: Bundle, iterations: int = 6, between: Callable[[], None] = lambda: None
) -> Adjusted:
    """Adjust; the input is left as it is. `between` is called every few milliseconds."""
    b = bundle
    n_var, n_points = b.n_variable, len(b.points)
    rotation = np.stack([p.rotation for p in b.poses])
    translation = np.stack([p.translation for p in b.poses])
    points = b.points.copy()
    p, residual = _project(rotation, translation, points, b)
    plumb, told = b.plumb, np.zeros(0, np.int64)
    cost = _cost(residual, p[:, 2])
    if plumb is not None:
        told = plumb.told(n_var)
        cost += plumb.cost(rotation, told)
    first_cost = cost
    damping = 1e-4
    moving = np.flatnonzero(b.camera < n_var)
    # observations of moving cameras ordered by camera: the rows of the block-sparse matrix
    moving = moving[np.lexsort((b.point[moving], b.camera[moving]))]
    cam, pt = b.camera[moving], b.point[moving]
    rows = np.concatenate([[0], np.cumsum(np.bincount(cam, minlength=n_var))])
    shape = (6 * n_var, 3 * n_points)
    accepted = True
    for _ in range(iterations):
        between()
        if accepted:
            jc, jp = _jacobians(rotation, p, b)
            size = np.sqrt((residual * residual).sum(1))
            weight = np.minimum(1.0, HUBER / np.maximum(size, 1e-9)) * (p[:, 2] > 0)
            root = np.sqrt(weight)[:, None, None]
            jc, jp = jc[moving] * root[moving], jp * root
            between()
            r = (residual * root[:, :, 0])[..., None]
            jpt, jct = jp.transpose(0, 2, 1), jc.transpose(0, 2, 1)
            hpp = _sum_by(b.point, np.matmul(jpt, jp), n_points)
            gp = _sum_by(b.point, np.matmul(jpt, r)[..., 0], n_points)
            between()
            hcc = _sum_by(cam, np.matmul(jct, jc), n_var)
            gc = _sum_by(cam, np.matmul(jct, r[moving])[..., 0], n_var)
            if plumb is not None:
                information, gradient = plumb.normal_equations(rotation, told)
                hcc[told, :3, :3] += information
                gc[told, :3] += gradient
            hcp = np.matmul(jct, jp[moving])
            cross = bsr_matrix((hcp, pt, rows), shape=shape, blocksize=(6, 3))
        between()
        damped = hpp + (damping * np.einsum("nii->ni", hpp) + 1e-9)[..., None] * np.eye(3)
        inverse = np.linalg.inv(damped)
        eliminated = bsr_matrix(
            (np.matmul(hcp, inverse[pt]), pt, rows), shape=shape, blocksize=(6, 3)
        )
        between()
        schur = -(eliminated @ cross.T).toarray()
        between()
        for k in range(n_var):
            block = schur[6 * k : 6 * k + 6, 6 * k : 6 * k + 6]
            block += hcc[k] + np.diag(damping * np.diag(hcc[k]) + 1e-9)
        rhs = -gc.ravel() + eliminated @ gp.ravel()
        try:
            dc = cho_solve(cho_factor(schur, check_finite=False), rhs, check_finite=False)
        except np.linalg.LinAlgError:
            damping *= 10
            accepted = False
            continue
        back = -gp - (cross.T @ dc).reshape(n_points, 3)
        dp = np.matmul(inverse, back[..., None])[..., 0]
        between()
        turns = np.stack([rotation_from_vector(d[:3]) for d in dc.reshape(-1, 6)])
        new_rotation, new_translation = rotation.copy(), translation.copy()
        new_rotation[:n_var] = turns @ rotation[:n_var]
        new_translation[:n_var] = (
            np.matmul(turns, translation[:n_var, :, None])[..., 0] + dc.reshape(-1, 6)[:, 3:]
        )
        new_points = points + dp
        new_p, new_residual = _project(new_rotation, new_translation, new_points, b)
        new_cost = _cost(new_residual, new_p[:, 2])
        if plumb is not None:
            new_cost += plumb.cost(new_rotation, told)
        accepted = new_cost < cost
        if accepted:
            gain = (cost - new_cost) / max(cost, 1e-12)
            rotation, translation, points = new_rotation, new_translation, new_points
            p, residual, cost = new_p, new_residual, new_cost
            damping = max(damping * 0.2, 1e-8)
            if gain < 1e-4:
                break
        else:
            damping *= 10
    inlier = ((residual * residual).sum(1) < CHI2_2D) & (p[:, 2] > 0)
    poses = [Pose(rotation[i], translation[i]) for i in range(len(b.poses))]
    return Adjusted(poses, points, inlier, first_cost, cost)


def _sum_by(index: Ints, values: Array, n: int) -> Array:
    """Sums of `values` (O, ...) over equal `index`, in order."""
    flat = values.reshape(len(values), -1)
    out = np.stack([np.bincount(index, flat[:, k], n) for k in range(flat.shape[1])], 1)
    return np.asarray(out.reshape(n, *values.shape[1:]), np.float64)


def _jacobians(rotation: Array, p: Array, b: Bundle) -> tuple[Array, Array]:
    """Derivatives of whitened residuals for camera (O, 2, 6) and point (O, 2, 3)."""
    inv = 1.0 / np.where(np.abs(p[:, 2]) < 1e-9, 1e-9, p[:, 2])
    x, y = p[:, 0] * inv, p[:, 1] * inv
    jc = np.zeros((len(p), 2, 6))
    jc[:, 0, 0], jc[:, 0, 1], jc[:, 0, 2] = -x * y, 1 + x * x, -y
    jc[:, 1, 0], jc[:, 1, 1], jc[:, 1, 2] = -1 - y * y, x * y, x
    jc[:, 0, 3], jc[:, 0, 5] = inv, -x * inv
    jc[:, 1, 4], jc[:, 1, 5] = inv, -y * inv
    jc = np.matmul(b.whitening, jc)
    jp = np.matmul(jc[:, :, 3:], rotation[b.camera])
    return jc, jp
