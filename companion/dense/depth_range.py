"""Depth range of a reference image from a few hundred tracked corners."""

from __future__ import annotations

from collections.abc import Iterable

import cv2
import numpy as np

from companion.dense.view_selection import Intrinsics
from companion.geometry.transforms import Array, Pose
from companion.messages import Bytes, Floats

MAX_POINTS = 600
MIN_POINTS = 20
MAX_EPIPOLAR_PX = 1.5
"""Tracked points further from their epipolar line are outliers."""
MIN_PARALLAX_PX = 2.0
QUANTILE = 0.02
NEAR_MARGIN, FAR_MARGIN = 0.6, 2.0
"""Margins for points nearer or farther than those tracked."""


def depth_range(
    reference: Bytes, others: Iterable[tuple[Bytes, Pose]], intrinsics: Intrinsics
) -> tuple[float, float] | None:
    """Minimum and maximum depth with margins; None with too few points.

    `others` are images (H, W) with poses current_from_reference, nearest in time first: corners are
    tracked from each to the next (Lucas & Kanade 1981) and triangulated.
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
        measured, epipolar_px, length_px = _triangulate(start, at, pose, intrinsics)
        alive &= (epipolar_px < MAX_EPIPOLAR_PX) | (length_px < MIN_PARALLAX_PX)
        better = alive & (length_px > parallax) & (measured > 0)
        rho[better], parallax[better] = measured[better], length_px[better]
        if alive.sum() < MIN_POINTS:
            break
    known = rho[parallax >= MIN_PARALLAX_PX]
    if len(known) < MIN_POINTS:
        return None
    far, near = 1.0 / np.quantile(known, [QUANTILE, 1 - QUANTILE])
    return NEAR_MARGIN * float(near), FAR_MARGIN * float(far)


def _triangulate(
    start: Floats, at: Floats, pose: Pose, k: Intrinsics
) -> tuple[Array, Array, Array]:
    """Inverse depth, epipolar distance and parallax (pixels) of each point."""
    centre, focal = np.array([k.cx, k.cy]), np.array([k.fx, k.fy])
    rays = np.c_[(start - centre) / focal, np.ones(len(start))] @ pose.rotation.T
    z = np.where(np.abs(rays[:, 2]) > 1e-6, rays[:, 2], 1e-6)
    at_infinity = rays[:, :2] / z[:, None]
    seen = (at - centre) / focal
    # a point at inverse depth rho is seen at (rays + rho t), divided by its third component
    t = pose.translation
    along = (t[:2] - at_infinity * t[2]) / z[:, None]
    displacement = seen - at_infinity
    # seen (1 + rho t_z / z) = at_infinity + rho t_xy / z
    slope = along - displacement * (t[2] / z)[:, None]
    rho = (displacement * slope).sum(1) / np.maximum((slope * slope).sum(1), 1e-18)
    residual = (displacement - rho[:, None] * slope) * focal
    return rho, np.linalg.norm(residual, axis=1), np.linalg.norm(displacement * focal, axis=1)
