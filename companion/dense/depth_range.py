"""Between which depths a reference's scene lies, from a few hundred points that can be followed."""

from __future__ import annotations

from collections.abc import Iterable

import cv2
import numpy as np

from companion.dense.view_selection import Intrinsics
from companion.geometry.transforms import Array, Pose
from companion.messages import Bytes, Floats

MAX_POINTS = 600
LEAST_POINTS = 20
OFF_LINE_PX = 1.5
"""A point that was followed to further from its epipolar line was lost."""
LEAST_PARALLAX_PX = 2.0
QUANTILE = 0.02
NEARER, FARTHER = 0.6, 2.0
"""What lies nearer or farther than all points that were followed."""


def depth_range(
    reference: Bytes, others: Iterable[tuple[Bytes, Pose]], intrinsics: Intrinsics
) -> tuple[float, float] | None:
    """Least and greatest depth, generously; None where too little can be told.

    `others` are images (H, W) with poses current_from_reference, the nearest in time first: corners
    are followed from each to the next (Lucas & Kanade 1981) and triangulated.
    """
    corners = cv2.goodFeaturesToTrack(reference, MAX_POINTS, 0.01, 8)
    if corners is None:
        return None
    start = corners.reshape(-1, 2).astype(np.float32)
    at, alive = start.copy(), np.ones(len(start), bool)
    rho, parallax = np.zeros(len(start)), np.zeros(len(start))
    last = reference
    for grey, pose in others:
        before = at.reshape(-1, 1, 2)
        moved, found, _ = cv2.calcOpticalFlowPyrLK(last, grey, before, before.copy())
        at, last = np.asarray(moved, np.float32).reshape(-1, 2), grey
        alive &= np.asarray(found).ravel() > 0
        measured, off_px, length_px = _triangulate(start, at, pose, intrinsics)
        alive &= (off_px < OFF_LINE_PX) | (length_px < LEAST_PARALLAX_PX)
        better = alive & (length_px > parallax) & (measured > 0)
        rho[better], parallax[better] = measured[better], length_px[better]
        if alive.sum() < LEAST_POINTS:
            break
    known = rho[parallax >= LEAST_PARALLAX_PX]
    if len(known) < LEAST_POINTS:
        return None
    far, near = 1.0 / np.quantile(known, [QUANTILE, 1 - QUANTILE])
    return NEARER * float(near), FARTHER * float(far)


def _triangulate(
    start: Floats, at: Floats, pose: Pose, k: Intrinsics
) -> tuple[Array, Array, Array]:
    """Inverse depth, distance from the epipolar line, and parallax (both pixels) of each point."""
    centre, focal = np.array([k.cx, k.cy]), np.array([k.fx, k.fy])
    rays = np.c_[(start - centre) / focal, np.ones(len(start))] @ pose.rotation.T
    z = np.where(np.abs(rays[:, 2]) > 1e-6, rays[:, 2], 1e-6)
    at_infinity = rays[:, :2] / z[:, None]
    seen = (at - centre) / focal
    # a point at inverse depth rho is seen at (rays + rho t), divided by its third component
    t = pose.translation
    along = (t[:2] - at_infinity * t[2]) / z[:, None]
    way = seen - at_infinity
    # seen (1 + rho t_z / z) = at_infinity + rho t_xy / z
    slope = along - way * (t[2] / z)[:, None]
    rho = (way * slope).sum(1) / np.maximum((slope * slope).sum(1), 1e-18)
    off = (way - rho[:, None] * slope) * focal
    return rho, np.linalg.norm(off, axis=1), np.linalg.norm(way * focal, axis=1)
