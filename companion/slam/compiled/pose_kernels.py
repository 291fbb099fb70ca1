"""Pose refinement kernels: Gauss-Newton over the points that a camera observes."""

from __future__ import annotations

import numpy as np

from companion.geometry.transforms import Array
from companion.slam.compiled.compiling import (
    Bools,
    compiled,
    integer,
    matrices,
    numbers,
    pairs,
    part,
)

CHI2_2D = 5.991
"""95 % quantile of the chi-squared distribution with two degrees of freedom."""
HUBER = float(np.sqrt(CHI2_2D))
_BEHIND_COST = HUBER * 100.0


@part
def _whitened(
    rotation: Array, translation: Array, point: Array, seen: Array, whitening: Array
) -> tuple[float, float, float]:
    """Whitened reprojection error (2) of one point, and its depth."""
    x = rotation[0, 0] * point[0] + rotation[0, 1] * point[1] + rotation[0, 2] * point[2]
    y = rotation[1, 0] * point[0] + rotation[1, 1] * point[1] + rotation[1, 2] * point[2]
    z = rotation[2, 0] * point[0] + rotation[2, 1] * point[1] + rotation[2, 2] * point[2]
    x, y, z = x + translation[0], y + translation[1], z + translation[2]
    divisor = 1e-9 if abs(z) < 1e-9 else z
    off_x, off_y = x / divisor - seen[0], y / divisor - seen[1]
    return (
        whitening[0, 0] * off_x + whitening[0, 1] * off_y,
        whitening[1, 0] * off_x + whitening[1, 1] * off_y,
        z,
    )


@compiled(pairs, numbers, pairs, pairs, matrices)
def cost(
    rotation: Array, translation: Array, points: Array, seen: Array, whitening: Array
) -> float:
    """Huber's loss of N points, those behind the camera at a high constant."""
    total = 0.0
    for i in range(len(points)):
        u, v, depth = _whitened(rotation, translation, points[i], seen[i], whitening[i])
        size = np.sqrt(u * u + v * v)
        if not depth > 0.0:
            total += _BEHIND_COST
        elif size < HUBER:
            total += 0.5 * size * size
        else:
            total += HUBER * (size - 0.5 * HUBER)
    return total


@part
def _rotation(vector: Array) -> Array:
    """Rotation matrix of a rotation vector (Rodrigues)."""
    x, y, z = vector[0], vector[1], vector[2]
    theta2 = x * x + y * y + z * z
    theta = np.sqrt(theta2)
    if theta < 1e-8:
        first, second = 1.0, 0.5
    else:
        first, second = np.sin(theta) / theta, (1.0 - np.cos(theta)) / theta2
    out = np.empty((3, 3))
    out[0, 0] = 1.0 - second * (y * y + z * z)
    out[1, 1] = 1.0 - second * (x * x + z * z)
    out[2, 2] = 1.0 - second * (x * x + y * y)
    out[0, 1], out[1, 0] = second * x * y - first * z, second * x * y + first * z
    out[0, 2], out[2, 0] = second * x * z + first * y, second * x * z - first * y
    out[1, 2], out[2, 1] = second * y * z - first * x, second * y * z + first * x
    return out


@part
def _solve(matrix: Array, right: Array) -> bool:
    """Solve a square system in place by pivoted Gaussian elimination; False where singular."""
    n = len(right)
    for k in range(n):
        pivot = k
        for i in range(k + 1, n):
            if abs(matrix[i, k]) > abs(matrix[pivot, k]):
                pivot = i
        if matrix[pivot, k] == 0.0:
            return False
        if pivot != k:
            for j in range(n):
                matrix[k, j], matrix[pivot, j] = matrix[pivot, j], matrix[k, j]
            right[k], right[pivot] = right[pivot], right[k]
        for i in range(k + 1, n):
            factor = matrix[i, k] / matrix[k, k]
            for j in range(k + 1, n):
                matrix[i, j] -= factor * matrix[k, j]
            right[i] -= factor * right[k]
    for k in range(n - 1, -1, -1):
        for j in range(k + 1, n):
            right[k] -= matrix[k, j] * right[j]
        right[k] /= matrix[k, k]
    return True


@part
def _sums(
    rotation: Array, translation: Array, points: Array, seen: Array, whitening: Array,
    inlier: Bools, robust: bool, information: Array, gradient: Array,
) -> None:  # fmt: skip
    """Normal equations of the inliers, written to the last two arguments."""
    information[:] = 0.0
    gradient[:] = 0.0
    plain, jac = np.zeros((2, 6)), np.empty((2, 6))
    for i in range(len(points)):
        if not inlier[i]:
            continue
        px, py, pz = points[i, 0], points[i, 1], points[i, 2]
        z = rotation[2, 0] * px + rotation[2, 1] * py + rotation[2, 2] * pz + translation[2]
        inverse = 1.0 / (z if z > 1e-6 else 1e-6)
        x = rotation[0, 0] * px + rotation[0, 1] * py + rotation[0, 2] * pz + translation[0]
        y = rotation[1, 0] * px + rotation[1, 1] * py + rotation[1, 2] * pz + translation[1]
        x, y = x * inverse, y * inverse
        # derivative of (x/z, y/z) for a left perturbation (rotation, translation)
        plain[0, 0], plain[0, 1], plain[0, 2] = -x * y, 1 + x * x, -y
        plain[1, 0], plain[1, 1], plain[1, 2] = -1 - y * y, x * y, x
        plain[0, 3], plain[0, 5] = inverse, -x * inverse
        plain[1, 4], plain[1, 5] = inverse, -y * inverse
        off_x, off_y = x - seen[i, 0], y - seen[i, 1]
        w = whitening[i]
        for k in range(6):
            jac[0, k] = w[0, 0] * plain[0, k] + w[0, 1] * plain[1, k]
            jac[1, k] = w[1, 0] * plain[0, k] + w[1, 1] * plain[1, k]
        u = w[0, 0] * off_x + w[0, 1] * off_y
        v = w[1, 0] * off_x + w[1, 1] * off_y
        weight = 1.0
        if robust:
            weight = min(1.0, HUBER / max(np.sqrt(u * u + v * v), 1e-9))
        for k in range(6):
            a, b = weight * jac[0, k], weight * jac[1, k]
            gradient[k] += a * u + b * v
            for m in range(k, 6):
                information[k, m] += a * jac[0, m] + b * jac[1, m]
    for k in range(6):
        for m in range(k):
            information[k, m] = information[m, k]


@part
def _straightened(rotation: Array) -> Array:
    """A rotation without what rounding added: of that only the square is left."""
    out = np.empty((3, 3))
    for i in range(3):
        for k in range(3):
            out[i, k] = 1.5 * rotation[i, k]
            for m in range(3):
                along = 0.0
                for n in range(3):
                    along += rotation[n, m] * rotation[n, k]
                out[i, k] -= 0.5 * rotation[i, m] * along
    return out


@compiled(pairs, numbers, pairs, pairs, matrices, integer, integer)
def refine(
    rotation: Array, translation: Array, points: Array, seen: Array, whitening: Array,
    rounds: int, iterations: int,
) -> tuple[Array, Array, Bools, Array]:  # fmt: skip
    """As `refine_pose`: rotation, translation, inliers (N,), information (6, 6)."""
    rotated, moved = rotation.copy(), translation.copy()
    inlier = np.ones(len(points), np.bool_)
    information, gradient = np.zeros((6, 6)), np.zeros(6)
    for round_ in range(rounds):
        if np.sum(inlier) < 6:
            break
        for _ in range(iterations):
            _sums(
                rotated, moved, points, seen, whitening, inlier, round_ < rounds - 1,
                information, gradient,
            )  # fmt: skip
            system, step = information.copy(), -gradient
            for k in range(6):
                system[k, k] += 1e-9
            if not (_solve(system, step) and np.all(np.isfinite(step))):
                break
            step_rotation = _rotation(step)
            before_rotated, before_moved = rotated.copy(), moved.copy()
            for i in range(3):
                moved[i] = step[3 + i]
                for k in range(3):
                    moved[i] += step_rotation[i, k] * before_moved[k]
                    rotated[i, k] = 0.0
                    for m in range(3):
                        rotated[i, k] += step_rotation[i, m] * before_rotated[m, k]
            if np.max(np.abs(step)) < 1e-6:
                break
        for i in range(len(points)):
            u, v, depth = _whitened(rotated, moved, points[i], seen[i], whitening[i])
            inlier[i] = u * u + v * v < CHI2_2D and depth > 0.0
    # a pose is refined from one predicted from the last: what rounding adds would grow with each
    return _straightened(rotated), moved, inlier, information
