"""Local scale correction of measurements to the map as it is now.

Dense depth has the local scale of the map at its measurement. Adjustment of the map changes
positions and scale, so that depth has to be rescaled. The sparse points, which are adjusted with
it, give the factor.
"""

from __future__ import annotations

import numpy as np

from companion.geometry.transforms import Array

CELL = 0.006
"""Side of the image cells, as tangents, in which points are compared."""
MAX_LOG_RATIO = 0.15
"""Larger logarithmic ratios are not of the same surface."""
WINDOW = 0.05
"""Relative deviation from the typical ratio up to which others are averaged."""
MIN_POINTS = 30
"""Points required."""


def local_scale_of_points(points_camera: Array, map_points_camera: Array) -> float | None:
    """Ratio of the depths of map points (M, 3) to points (N, 3); None with too few.

    Both are in the frame of the camera that measured the points, of which one per cell is compared.
    """
    if len(points_camera) == 0:
        return None
    seen = points_camera[:, :2] / points_camera[:, 2:]
    low = seen.min(0) - CELL
    width, height = (np.ceil((seen.max(0) - low) / CELL) + 1).astype(np.int64)
    cells = np.floor((seen - low) / CELL).astype(np.int64)
    keys, first = np.unique(cells[:, 0] * height + cells[:, 1], return_index=True)
    front = map_points_camera[map_points_camera[:, 2] > 1e-6]
    there = np.floor((front[:, :2] / front[:, 2:] - low) / CELL)
    inside = (there >= 0).all(1) & (there[:, 0] < width) & (there[:, 1] < height)
    column, row = there[inside].astype(np.int64).T
    wanted = column * height + row
    at = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
    met = keys[at] == wanted
    return typical_ratio(front[inside][met, 2] / points_camera[first[at[met]], 2])


def typical_ratio(ratios: Array) -> float | None:
    """Robust median of ratios (N,); None with too few.

    Occluded points and those in front are excluded.
    """
    near = ratios[np.abs(np.log(np.maximum(ratios, 1e-9))) < MAX_LOG_RATIO]
    if len(near) < MIN_POINTS:
        return None
    middle = float(np.median(near))
    for _ in range(5):
        about = near[np.abs(near / middle - 1.0) < WINDOW]
        if len(about) < MIN_POINTS:
            return None
        middle = float(np.median(about))
    return middle
