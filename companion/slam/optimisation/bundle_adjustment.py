"""Bundle adjustment of cameras and points by the Schur complement (Triggs et al. 1999).

Levenberg-Marquardt with Huber's loss. Camera-point blocks are stored per observation, so that a
window of ten cameras and a flight of hundreds share the same code with little memory.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_triangular

from companion.geometry.transforms import Array, Pose, rotation_from_vector
from companion.slam.compiled.bundle_kernels import (
    back_substitute,
    damped_inverses,
    errors,
    normal_equations,
    schur_complement,
)
from companion.slam.compiled.pose_kernels import CHI2_2D
from companion.slam.features.orb_features import Bools, Ints
from companion.slam.optimisation.factors import Factor


@dataclass(slots=True, eq=False)
class Bundle:
    """Cameras (C), points (P, 3), observations (O) and other factors.

    The first `n_variable` cameras are variable, the others fix the gauge. `normalised` (O, 2) and
    `whitening` (O, 2, 2) are as in Features. No camera observes a point twice.
    """

    poses: list[Pose]
    n_variable: int
    points: Array
    camera: Ints
    point: Ints
    normalised: Array
    whitening: Array
    factors: Sequence[Factor] = ()


@dataclass(frozen=True, slots=True, eq=False)
class AdjustmentResult:
    """Adjusted poses and points, inlier mask of observations (O,)."""

    poses: list[Pose]
    points: Array
    inlier: Bools


def adjust(
    bundle: Bundle, iterations: int = 6, yield_point: Callable[[], None] = lambda: None
) -> AdjustmentResult:
    """Solve; the input is not changed. `yield_point` is called every few milliseconds."""
    b = bundle
    n_var, n_points = b.n_variable, len(b.points)
    rotation = np.stack([p.rotation for p in b.poses])
    translation = np.stack([p.translation for p in b.poses])
    points = b.points.copy()
    p, residual, cost = errors(
        rotation, translation, points, b.camera, b.point, b.normalised, b.whitening
    )
    cost += sum(factor.cost(rotation, translation) for factor in b.factors)
    damping = 1e-4
    moving = np.flatnonzero(b.camera < n_var)
    by_point = moving[np.argsort(b.point[moving], kind="stable")]
    accepted = True
    for _ in range(iterations):
        yield_point()
        if accepted:
            hcc, gc, hpp, gp, hcp = normal_equations(
                rotation, p, residual, b.camera, b.point, b.whitening, n_var, n_points
            )
        yield_point()
        inverse = damped_inverses(hpp, damping)
        yield_point()
        schur, rhs = schur_complement(inverse, gp, hcp, b.camera, b.point, by_point, n_var)
        yield_point()
        np.negative(schur, schur)
        blocks, each = schur.reshape(n_var, 6, n_var, 6), np.arange(n_var)
        more = damping * np.einsum("nii->ni", hcc) + 1e-9
        blocks[each, :, each] += hcc + more[..., None] * np.eye(6)
        gradient = gc.copy()
        for factor in b.factors:
            factor.add_normal_equations(blocks, gradient, rotation, translation)
        steps = _solved(schur, rhs - gradient.ravel())
        del schur, blocks  # 72 MB for 500 keyframes, which the next one needs beside its own
        if steps is None:
            damping *= 10
            accepted = False
            continue
        dp = back_substitute(inverse, gp, hcp, b.camera, b.point, by_point, steps)
        yield_point()
        rotations = np.stack([rotation_from_vector(d[:3]) for d in steps])
        new_rotation, new_translation = rotation.copy(), translation.copy()
        new_rotation[:n_var] = rotations @ rotation[:n_var]
        new_translation[:n_var] = (
            np.matmul(rotations, translation[:n_var, :, None])[..., 0] + steps[:, 3:]
        )
        new_points = points + dp
        new_p, new_residual, new_cost = errors(
            new_rotation, new_translation, new_points, b.camera, b.point, b.normalised, b.whitening
        )
        new_cost += sum(factor.cost(new_rotation, new_translation) for factor in b.factors)
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
    # copies, as one that a keyframe keeps would keep those of all
    poses = [Pose(rotation[i].copy(), translation[i].copy()) for i in range(len(b.poses))]
    return AdjustmentResult(poses, points, inlier)


def _solved(schur: Array, rhs: Array) -> Array | None:
    """Steps (V, 6) of the cameras; None where the matrix is not positive definite."""
    try:
        # numpy's, as frames are tracked beside a large adjustment: SciPy's cho_factor holds
        # the interpreter's lock throughout, 0.16 s for 450 keyframes
        lower = np.linalg.cholesky(schur)
    except np.linalg.LinAlgError:
        return None
    half = solve_triangular(lower, rhs, lower=True, check_finite=False)
    out = solve_triangular(lower, half, lower=True, trans=1, check_finite=False)
    return np.asarray(out.reshape(-1, 6), np.float64)
