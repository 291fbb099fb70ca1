"""Bundle adjustment kernels: residuals, normal equations, Schur complement, back-substitution."""

from __future__ import annotations

import numpy as np

from companion.geometry.transforms import Array
from companion.slam.compiled.compiling import (
    Ints,
    compiled,
    integer,
    integers,
    matrices,
    number,
    pairs,
)
from companion.slam.compiled.pose_kernels import HUBER

_BEHIND_COST = HUBER * 100.0
_LEAST = 1e-9
"""Added to the information of what nothing observes, which then has an inverse."""


@compiled(matrices, pairs, pairs, integers, integers, pairs, matrices)
def errors(
    rotation: Array, translation: Array, points: Array, camera: Ints, point: Ints, seen: Array,
    whitening: Array,
) -> tuple[Array, Array, float]:  # fmt: skip
    """Points in camera frames (O, 3), whitened errors (O, 2), and Huber's loss.

    For C cameras, P points and O observations; points behind a camera cost a high constant.
    """
    n = len(camera)
    inside, residual, cost = np.empty((n, 3)), np.empty((n, 2)), 0.0
    for o in range(n):
        camera_rotation, p = rotation[camera[o]], points[point[o]]
        for i in range(3):
            along = (
                camera_rotation[i, 0] * p[0]
                + camera_rotation[i, 1] * p[1]
                + camera_rotation[i, 2] * p[2]
            )
            inside[o, i] = along + translation[camera[o], i]
        z = inside[o, 2]
        divisor = 1e-9 if abs(z) < 1e-9 else z
        off_x, off_y = inside[o, 0] / divisor - seen[o, 0], inside[o, 1] / divisor - seen[o, 1]
        residual[o, 0] = whitening[o, 0, 0] * off_x + whitening[o, 0, 1] * off_y
        residual[o, 1] = whitening[o, 1, 0] * off_x + whitening[o, 1, 1] * off_y
        size = np.sqrt(residual[o, 0] * residual[o, 0] + residual[o, 1] * residual[o, 1])
        if not z > 0.0:
            cost += _BEHIND_COST
        elif size < HUBER:
            cost += 0.5 * size * size
        else:
            cost += HUBER * (size - 0.5 * HUBER)
    return inside, residual, cost


@compiled(matrices, pairs, pairs, integers, integers, matrices, integer, integer)
def normal_equations(
    rotation: Array, inside: Array, residual: Array, camera: Ints, point: Ints, whitening: Array,
    n_variable: int, n_points: int,
) -> tuple[Array, Array, Array, Array, Array]:  # fmt: skip
    """Information and gradient of cameras (V, 6, 6), (V, 6) and points (P, 3, 3), (P, 3).

    The last result is the camera-point block of each observation (O, 6, 3). The first `n_variable`
    cameras are variable; Huber weights.
    """
    hcc, gc = np.zeros((n_variable, 6, 6)), np.zeros((n_variable, 6))
    hpp, gp = np.zeros((n_points, 3, 3)), np.zeros((n_points, 3))
    hcp = np.zeros((len(camera), 6, 3))
    jc, jp, plain = np.empty((2, 6)), np.empty((2, 3)), np.zeros((2, 6))
    for o in range(len(camera)):
        c, p, z = camera[o], point[o], inside[o, 2]
        if not z > 0.0:
            continue
        u, v = residual[o, 0], residual[o, 1]
        weight = min(1.0, HUBER / max(np.sqrt(u * u + v * v), 1e-9))
        inverse = 1.0 / max(z, 1e-9)
        x, y = inside[o, 0] * inverse, inside[o, 1] * inverse
        # derivative of (x/z, y/z) for a left perturbation (rotation, translation)
        plain[0, 0], plain[0, 1], plain[0, 2] = -x * y, 1 + x * x, -y
        plain[1, 0], plain[1, 1], plain[1, 2] = -1 - y * y, x * y, x
        plain[0, 3], plain[0, 5] = inverse, -x * inverse
        plain[1, 4], plain[1, 5] = inverse, -y * inverse
        white, camera_rotation = whitening[o], rotation[c]
        for i in range(2):
            for k in range(6):
                jc[i, k] = white[i, 0] * plain[0, k] + white[i, 1] * plain[1, k]
            for k in range(3):
                jp[i, k] = 0.0
                for m in range(3):
                    jp[i, k] += jc[i, 3 + m] * camera_rotation[m, k]
        for k in range(3):
            a, b = weight * jp[0, k], weight * jp[1, k]
            gp[p, k] += a * u + b * v
            for m in range(3):
                hpp[p, k, m] += a * jp[0, m] + b * jp[1, m]
        if c >= n_variable:
            continue
        for k in range(6):
            a, b = weight * jc[0, k], weight * jc[1, k]
            gc[c, k] += a * u + b * v
            for m in range(6):
                hcc[c, k, m] += a * jc[0, m] + b * jc[1, m]
            for m in range(3):
                hcp[o, k, m] = a * jp[0, m] + b * jp[1, m]
    return hcc, gc, hpp, gp, hcp


@compiled(matrices, number)
def damped_inverses(information: Array, damping: float) -> Array:
    """Inverses (P, 3, 3) of point information whose diagonals are damped, by L D L^T."""
    out = np.empty(information.shape)
    for i in range(len(information)):
        a = information[i]
        d_0 = a[0, 0] + (damping * a[0, 0] + _LEAST)
        by_10, by_20 = a[1, 0] / d_0, a[2, 0] / d_0
        d_1 = a[1, 1] + (damping * a[1, 1] + _LEAST) - by_10 * a[1, 0]
        left = a[2, 1] - by_20 * a[1, 0]
        by_21 = left / d_1
        d_2 = a[2, 2] + (damping * a[2, 2] + _LEAST) - by_20 * a[2, 0] - by_21 * left
        back = by_10 * by_21 - by_20  # first column of the inverse of L, last row
        w_0, w_1, w_2 = 1.0 / d_0, 1.0 / d_1, 1.0 / d_2
        out[i, 0, 0] = w_0 + by_10 * by_10 * w_1 + back * back * w_2
        out[i, 0, 1] = out[i, 1, 0] = -by_10 * w_1 - back * by_21 * w_2
        out[i, 0, 2] = out[i, 2, 0] = back * w_2
        out[i, 1, 1] = w_1 + by_21 * by_21 * w_2
        out[i, 1, 2] = out[i, 2, 1] = -by_21 * w_2
        out[i, 2, 2] = w_2
    return out


@compiled(matrices, pairs, matrices, integers, integers, integers, integer)
def schur_complement(
    inverse: Array, gradient: Array, hcp: Array, camera: Ints, point: Ints, by_point: Ints,
    n_variable: int,
) -> tuple[Array, Array]:  # fmt: skip
    """Schur complement of the points: its part of the camera information and right side.

    Returns (6 V, 6 V), to subtract, and (6 V,), to add. `inverse` (P, 3, 3) of the point
    information, `gradient` (P, 3) of the points; `by_point` are the observations of variable
    cameras, ordered by point.
    """
    reduction = np.zeros((6 * n_variable, 6 * n_variable))
    rhs_part, through = np.zeros((n_variable, 6)), np.empty((6, 3))
    most, start = 0, 0
    for i in range(len(by_point)):
        if point[by_point[i]] != point[by_point[start]]:
            start = i
        most = max(most, i + 1 - start)
    turned, cameras = np.empty((most, 3, 6)), np.empty(most, np.int64)
    start = 0
    for end in range(1, len(by_point) + 1):
        p = point[by_point[start]]
        if end < len(by_point) and point[by_point[end]] == p:
            continue
        n, of_point, right = end - start, inverse[p], gradient[p]
        for i in range(n):
            # turned over, so that the innermost loop goes along rows
            one = by_point[start + i]
            cameras[i] = camera[one]
            for k in range(6):
                for m in range(3):
                    turned[i, m, k] = hcp[one, k, m]
        for i in range(n):
            own = turned[i]
            for k in range(6):
                for m in range(3):
                    through[k, m] = (
                        own[0, k] * of_point[0, m]
                        + own[1, k] * of_point[1, m]
                        + own[2, k] * of_point[2, m]
                    )
                rhs_part[cameras[i], k] += (
                    through[k, 0] * right[0] + through[k, 1] * right[1] + through[k, 2] * right[2]
                )
            for j in range(n):
                if cameras[j] < cameras[i]:
                    continue
                other, column = turned[j], 6 * cameras[j]
                for k in range(6):
                    a, b, c = through[k, 0], through[k, 1], through[k, 2]
                    row = reduction[6 * cameras[i] + k, column : column + 6]
                    for m in range(6):
                        row[m] += a * other[0, m] + b * other[1, m] + c * other[2, m]
        start = end
    for i in range(6 * n_variable):
        for k in range(i):
            reduction[i, k] = reduction[k, i]
    return reduction, rhs_part.ravel()


@compiled(matrices, pairs, matrices, integers, integers, integers, pairs)
def back_substitute(
    inverse: Array, gradient: Array, hcp: Array, camera: Ints, point: Ints, by_point: Ints,
    steps: Array,
) -> Array:  # fmt: skip
    """Steps of points (P, 3) given those of cameras (V, 6)."""
    right = -gradient
    for o in by_point:
        for m in range(3):
            for k in range(6):
                right[point[o], m] -= hcp[o, k, m] * steps[camera[o], k]
    out = np.zeros(right.shape)
    for p in range(len(out)):
        for i in range(3):
            for k in range(3):
                out[p, i] += inverse[p, i, k] * right[p, k]
    return out
