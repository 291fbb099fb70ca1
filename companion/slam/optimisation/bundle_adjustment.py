"""Bundle adjustment: cameras and points together, by the Schur complement (Triggs et al. 1999).

Levenberg-Marquardt with Huber's loss. What ties cameras to points is kept by observation, so that a
window of ten cameras and a whole flight of hundreds are the same code and little memory.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from companion.geometry.transforms import Array, Pose, rotation_from_vector
from companion.slam.compiled.bundle_sums import (
    errors,
    moves_of_points,
    normal_equations,
    without_points,
)
from companion.slam.compiled.pose_sums import CHI2_2D
from companion.slam.features.orb_features import Bools, Ints
from companion.slam.optimisation.factors import Tie


@dataclass(slots=True, eq=False)
class Bundle:
    """Cameras (C), points (P, 3) and observations (O): which camera sees which point where.

    `ties` is what is told beside the images.

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
    ties: Sequence[Tie] = ()


@dataclass(frozen=True, slots=True, eq=False)
class Adjusted:
    """Adjusted poses and points, which observations agree (O,), and the cost before and after."""

    poses: list[Pose]
    points: Array
    inlier: Bools
    cost_before: float
    cost_after: float


def adjust(
    bundle: Bundle, iterations: int = 6, between: Callable[[], None] = lambda: None
) -> Adjusted:
    """Adjust; the input is left as it is. `between` is called every few milliseconds."""
    b = bundle
    n_var, n_points = b.n_variable, len(b.points)
    rotation = np.stack([p.rotation for p in b.poses])
    translation = np.stack([p.translation for p in b.poses])
    points = b.points.copy()
    p, residual, cost = errors(
        rotation, translation, points, b.camera, b.point, b.normalised, b.whitening
    )
    cost += sum(tie.cost(rotation, translation) for tie in b.ties)
    first_cost = cost
    damping = 1e-4
    moving = np.flatnonzero(b.camera < n_var)
    by_point = moving[np.argsort(b.point[moving], kind="stable")]
    accepted = True
    for _ in range(iterations):
        between()
        if accepted:
            hcc, gc, hpp, gp, hcp = normal_equations(
                rotation, p, residual, b.camera, b.point, b.whitening, n_var, n_points
            )
        between()
        damped = hpp + (damping * np.einsum("nii->ni", hpp) + 1e-9)[..., None] * np.eye(3)
        inverse = np.linalg.inv(damped)
        between()
        taken, added = without_points(inverse, gp, hcp, b.camera, b.point, by_point, n_var)
        between()
        schur = -taken
        for k in range(n_var):
            block = schur[6 * k : 6 * k + 6, 6 * k : 6 * k + 6]
            block += hcc[k] + np.diag(damping * np.diag(hcc[k]) + 1e-9)
        pull = gc.copy()
        for tie in b.ties:
            tie.add_to(schur.reshape(n_var, 6, n_var, 6), pull, rotation, translation)
        rhs = added - pull.ravel()
        try:
            dc = cho_solve(cho_factor(schur, check_finite=False), rhs, check_finite=False)
        except np.linalg.LinAlgError:
            damping *= 10
            accepted = False
            continue
        moves = dc.reshape(n_var, 6)
        dp = moves_of_points(inverse, gp, hcp, b.camera, b.point, by_point, moves)
        between()
        turns = np.stack([rotation_from_vector(d[:3]) for d in moves])
        new_rotation, new_translation = rotation.copy(), translation.copy()
        new_rotation[:n_var] = turns @ rotation[:n_var]
        new_translation[:n_var] = (
            np.matmul(turns, translation[:n_var, :, None])[..., 0] + moves[:, 3:]
        )
        new_points = points + dp
        new_p, new_residual, new_cost = errors(
            new_rotation, new_translation, new_points, b.camera, b.point, b.normalised, b.whitening
        )
        new_cost += sum(tie.cost(new_rotation, new_translation) for tie in b.ties)
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
