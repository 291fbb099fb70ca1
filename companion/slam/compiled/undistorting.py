"""Lens kernels: the radial-tangential model of companion.geometry.camera, inverted; its slope."""

from __future__ import annotations

import numpy as np

from companion.geometry.transforms import Array
from companion.slam.compiled.compiling import compiled, number, numbers, pairs

N_ITERATIONS = 8
MAX_ERROR = 1e-6
"""Of a distorted coordinate, for a solution to count."""


@compiled(pairs, numbers, number)
def undistort(distorted: Array, coefficients: Array, converged: float) -> Array:
    """Ideal normalised coordinates (N, 2) of distorted ones (N, 2); nan where undefined.

    Newton's method, as `Camera.normalise` does it, with the same operations in the same order; all
    go on until the last one has `converged`. `coefficients` are k1, k2, p1, p2, k3.
    """
    k1, k2, p1, p2, k3 = coefficients
    n, count = distorted.copy(), len(distorted)
    error = np.empty((count, 2))
    for iteration in range(N_ITERATIONS + 1):
        largest = 0.0
        for i in range(count):
            x, y = n[i, 0], n[i, 1]
            r2 = x * x + y * y
            radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
            error[i, 0] = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x) - distorted[i, 0]
            error[i, 1] = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y - distorted[i, 1]
            for k in range(2):
                if np.isfinite(error[i, k]):
                    largest = max(largest, abs(error[i, k]))
        if largest < converged or iteration == N_ITERATIONS:
            break
        for i in range(count):
            x, y = n[i, 0], n[i, 1]
            r2 = x * x + y * y
            radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
            slope = 2 * (k1 + r2 * (2 * k2 + r2 * 3 * k3))
            cross = slope * x * y + 2 * (p1 * x + p2 * y)
            dx_dx = radial + slope * x * x + 2 * p1 * y + 6 * p2 * x
            dy_dy = radial + slope * y * y + 6 * p1 * y + 2 * p2 * x
            off_x, off_y = error[i, 0], error[i, 1]
            det = dx_dx * dy_dy - cross * cross
            n[i, 0] = x - (dy_dy * off_x - cross * off_y) / det
            n[i, 1] = y - (dx_dx * off_y - cross * off_x) / det
    for i in range(count):
        if not max(abs(error[i, 0]), abs(error[i, 1])) < MAX_ERROR:
            n[i, 0] = n[i, 1] = np.nan
    return n


@compiled(pairs, numbers, numbers, numbers)
def whiten(normalised: Array, coefficients: Array, focal_px: Array, sigma_px: Array) -> Array:
    """Derivatives (N, 2, 2) of pixels by ideal normalised coordinates (N, 2), in units of sigma.

    As `Camera.pixel_from_normalised_jacobian` over `sigma_px` (N,), with the same operations in the
    same order; `focal_px` are fx, fy.
    """
    k1, k2, p1, p2, k3 = coefficients
    out = np.empty((len(normalised), 2, 2))
    for i in range(len(normalised)):
        x, y, sigma = normalised[i, 0], normalised[i, 1], sigma_px[i]
        r2 = x * x + y * y
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        slope = 2 * (k1 + r2 * (2 * k2 + r2 * 3 * k3))
        cross = slope * x * y + 2 * (p1 * x + p2 * y)
        out[i, 0, 0] = (radial + slope * x * x + 2 * p1 * y + 6 * p2 * x) * focal_px[0] / sigma
        out[i, 0, 1], out[i, 1, 0] = cross * focal_px[0] / sigma, cross * focal_px[1] / sigma
        out[i, 1, 1] = (radial + slope * y * y + 6 * p1 * y + 2 * p2 * x) * focal_px[1] / sigma
    return out
