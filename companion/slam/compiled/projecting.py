"""Projection kernels: visible map points of a camera, and patch warps."""

from __future__ import annotations

import numpy as np

from companion.geometry.transforms import Array
from companion.slam.compiled.compiling import (
    Bools,
    Ints,
    compiled,
    flags,
    integer,
    integers,
    matrices,
    number,
    numbers,
    pairs,
    part,
)

NO_LENS, RADTAN, EQUIDISTANT = 0, 1, 2
"""Distortion models of companion.geometry.camera."""
N_COEFFICIENTS = 5
MIN_VIEW_COSINE = 0.5
"""Points are searched within 60 degrees of their mean viewing direction only."""
NEARER, FARTHER = 0.7, 1.3
"""Tolerance on the distances at which the pyramid covers a point."""


@part
def _distort(model: int, coefficients: Array, x: float, y: float) -> tuple[float, float]:
    """Distorted normalised coordinates of ideal ones."""
    if model == RADTAN:
        k1, k2, k3 = coefficients[0], coefficients[1], coefficients[4]
        p1, p2 = coefficients[2], coefficients[3]
        r2 = x * x + y * y
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        return (
            x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
            y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
        )
    if model == EQUIDISTANT:
        k1, k2, k3, k4 = coefficients[0], coefficients[1], coefficients[2], coefficients[3]
        r = np.sqrt(x * x + y * y)
        if r <= 1e-9:
            return x, y
        theta = np.arctan(r)
        t2 = theta * theta
        scale = theta * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4)))) / r
        return x * scale, y * scale
    return x, y


@compiled(
    pairs, matrices, integers, pairs, numbers, matrices, pairs, flags, integers, matrices
)  # fmt: skip
def warps(
    positions: Array, first_unproject: Array, ids: Ints, rotation: Array, translation: Array,
    first_rotation: Array, first_translation: Array, first_known: Bools, which: Ints,
    jacobian: Array,
) -> Array:  # fmt: skip
    """Warps (M, 2, 2) of full-resolution pixels from the reference view of points to this view.

    The first two arguments are of all points; `ids` (M,) selects; of K reference views the poses,
    of which `which` (M,) is that of each point; `jacobian` (M, 2, 2) of pixels here by normalised
    coordinates. nan where the reference view is unknown.
    """
    out = np.full((len(ids), 2, 2), np.nan)
    here, rotated, projected = np.empty(3), np.empty((3, 2)), np.empty((2, 2))
    for m in range(len(ids)):
        k = which[m]
        if not first_known[k]:
            continue
        point, first, shift = positions[ids[m]], first_rotation[k], first_unproject[ids[m]]
        depth = first_translation[k, 2]
        for i in range(3):
            depth += first[2, i] * point[i]
            here[i] = translation[i]
            for j in range(3):
                here[i] += rotation[i, j] * point[j]
        z = 1e-9 if abs(here[2]) < 1e-9 else here[2]
        u, v = here[0] / z, here[1] / z
        # of a plane through the point, facing the first view
        for i in range(3):
            x, y = 0.0, 0.0
            for j in range(3):
                x += rotation[i, j] * first[0, j]
                y += rotation[i, j] * first[1, j]
            for j in range(2):
                rotated[i, j] = (x * shift[0, j] + y * shift[1, j]) * depth
        for j in range(2):
            projected[0, j] = (rotated[0, j] - u * rotated[2, j]) / z
            projected[1, j] = (rotated[1, j] - v * rotated[2, j]) / z
        for i in range(2):
            for j in range(2):
                out[m, i, j] = (
                    jacobian[m, i, 0] * projected[0, j] + jacobian[m, i, 1] * projected[1, j]
                )
    return out


@compiled(
    pairs, pairs, numbers, integers, pairs, numbers, integer, numbers, numbers, number, number,
    integer,
)  # fmt: skip
def visible(
    positions: Array, normals: Array, base_distance: Array, ids: Ints, rotation: Array,
    translation: Array, model: int, coefficients: Array, intrinsics: Array, max_radius: float,
    scale_factor: float, n_levels: int,
) -> tuple[Ints, Array, Ints]:  # fmt: skip
    """Ids (M,), pixels (M, 2) and pyramid levels (M,) of the points `ids` that are visible.

    The first three arguments are of all points; `coefficients` five for any model; `intrinsics` fx,
    fy, cx, cy, width, height; beyond `max_radius` in normalised coordinates nothing is visible.
    """
    fx, fy, cx, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]
    width, height = intrinsics[4], intrinsics[5]
    centre = np.zeros(3)
    for i in range(3):
        for k in range(3):
            centre[i] -= rotation[k, i] * translation[k]
    smallest = scale_factor ** (n_levels - 1)
    log_factor = np.log(scale_factor)
    seen = np.empty(len(ids), np.int64)
    pixels = np.empty((len(ids), 2))
    levels = np.empty(len(ids), np.int64)
    n = 0
    for point in ids:
        x, y, z = positions[point, 0], positions[point, 1], positions[point, 2]
        depth = rotation[2, 0] * x + rotation[2, 1] * y + rotation[2, 2] * z + translation[2]
        if not depth > 0.0:
            continue
        u = (rotation[0, 0] * x + rotation[0, 1] * y + rotation[0, 2] * z + translation[0]) / depth
        v = (rotation[1, 0] * x + rotation[1, 1] * y + rotation[1, 2] * z + translation[1]) / depth
        if not u * u + v * v < max_radius * max_radius:
            continue
        x, y, z = centre[0] - x, centre[1] - y, centre[2] - z
        distance = np.sqrt(x * x + y * y + z * z)
        along = x * normals[point, 0] + y * normals[point, 1] + z * normals[point, 2]
        top = base_distance[point]
        if not along > MIN_VIEW_COSINE * distance:
            continue
        if not top / smallest * NEARER < distance < top * FARTHER:
            continue
        u, v = _distort(model, coefficients, u, v)
        u, v = fx * u + cx, fy * v + cy
        if not (0.0 <= u < width and 0.0 <= v < height):
            continue
        level = np.rint(np.log(max(top / max(distance, 1e-9), 1e-9)) / log_factor)
        seen[n], pixels[n, 0], pixels[n, 1] = point, u, v
        levels[n] = int(min(max(level, 0.0), n_levels - 1.0))
        n += 1
    return seen[:n].copy(), pixels[:n].copy(), levels[:n].copy()
