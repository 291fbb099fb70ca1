"""Surface normals of a depth map."""

from __future__ import annotations

import numpy as np

from companion.messages import Floats

MAX_STEP = 0.04
"""Relative depth step between neighbours at a depth edge."""
OFFSETS = ((1, 1), (-1, 1), (2, 0), (0, 2), (2, 2), (-2, 2))
"""Offsets of the neighbours used, with their opposites: nearer ones share noise."""


def normals(depth: Floats, intrinsics: tuple[float, float, float, float]) -> Floats:
    """Unit normals (H, W, 3) towards the camera; zero where depth (H, W) is 0 or isolated.

    Inverse depth of a plane is linear in the image: its least-squares gradient over neighbours on
    the same surface gives the plane.
    """
    fx, fy, cx, cy = intrinsics
    known = depth > 0
    rho = np.where(known, 1.0 / np.where(known, depth, np.float32(1)), np.float32(0))
    xx, xy, yy, xr, yr = (np.zeros(depth.shape, np.float32) for _ in range(5))
    for dx, dy in OFFSETS:
        steps = max(abs(dx), abs(dy))
        here, there = _pair(rho, dx, dy)
        rise = there - here
        lesser = np.minimum(here, there)
        same = (np.abs(rise) < steps * MAX_STEP * lesser).astype(np.float32)
        rise *= same
        for end in (0, 1):
            # from the other end both step and rise change sign: products do not
            at = _part(depth.shape, dx, dy)[end]
            xx[at] += dx * dx * same
            xy[at] += dx * dy * same
            yy[at] += dy * dy * same
            xr[at] += dx * rise
            yr[at] += dy * rise
    det = xx * yy - xy * xy
    fits = known & (det > 0.5)
    scale = np.where(fits, 1.0 / np.where(fits, det, np.float32(1)), np.float32(0))
    a = fx * (yy * xr - xy * yr) * scale
    b = fy * (xx * yr - xy * xr) * scale
    v, u = np.indices(depth.shape, np.float32)
    c = rho - (u - cx) / fx * a - (v - cy) / fy * b
    out = -np.stack([a, b, c], -1)
    length = np.linalg.norm(out, axis=-1)
    fits &= length > 0
    return np.asarray(
        np.where(fits[..., None], out / np.where(fits, length, 1.0)[..., None], 0.0), np.float32
    )


def _part(shape: tuple[int, ...], dx: int, dy: int) -> tuple[tuple[slice, slice], ...]:
    """Slices of pixels that have one at the offset, and of these; dy is not negative."""
    height, width = shape
    rows, columns = max(0, height - dy), max(0, width - abs(dx))
    left, right = slice(0, columns), slice(width - columns, width)
    upper, lower = slice(0, rows), slice(height - rows, height)
    return ((upper, left), (lower, right)) if dx >= 0 else ((upper, right), (lower, left))


def _pair(image: Floats, dx: int, dy: int) -> tuple[Floats, Floats]:
    here, there = _part(image.shape, dx, dy)
    return image[here], image[there]
