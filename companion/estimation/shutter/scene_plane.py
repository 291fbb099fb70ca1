"""A plane that is about the scene: it gives depths where it is enough to know them roughly."""

from __future__ import annotations

import numpy as np

from companion.geometry.transforms import Array

MIN_POINTS = 30
ROUNDS = 5
HUBER_RATIO = 0.1
"""Least scale of the weights, of the median inverse depth."""


def scene_plane(points_camera: Array) -> Array | None:
    """Plane (3,) by points (N, 3): one over depth is its product with a ray (x, y, 1).

    By least squares with Huber's weights; None with too few points.
    """
    points = points_camera[points_camera[:, 2] > 0]
    if len(points) < MIN_POINTS:
        return None
    rays, inverse = points / points[:, 2:], 1.0 / points[:, 2]
    weight: Array = np.ones(len(points))
    plane: Array = np.zeros(3)
    for _ in range(ROUNDS):
        root = np.sqrt(weight)
        found = np.linalg.lstsq(rays * root[:, None], inverse * root, rcond=None)[0]
        plane = np.asarray(found, np.float64)
        off = np.abs(rays @ plane - inverse)
        scale = max(1.5 * float(np.median(off)), HUBER_RATIO * float(np.median(inverse)))
        weight = np.minimum(1.0, scale / np.maximum(off, 1e-12))
    return plane if np.isfinite(plane).all() else None
