"""By how much what was measured in a map has to be stretched to fit the map as it is now.

Dense depth comes in the unit that the map had about a keyframe when it was made. As the map is
adjusted, places move and turn against each other, and depth that was right does not fit any more.
The map's own points, which are adjusted with it, tell by how much.
"""

from __future__ import annotations

import numpy as np

from companion.geometry.transforms import Array

CELL = 0.006
"""Side of the cells of the image, as tangents, in which points are compared."""
FURTHEST = 0.15
"""Natural logarithm of a ratio beyond which a point does not lie on the same surface."""
WINDOW = 0.05
"""Relative difference from the typical ratio up to which others are counted."""
LEAST_POINTS = 30
"""Fewer than this tell nothing."""


def stretch_of_points(points_camera: Array, map_points_camera: Array) -> float | None:
    """By what factor points (N, 3) are nearer than the map's points (M, 3); None if too few meet.

    Both are in the frame that the first were seen from. Of the first, at most one is looked at in
    each direction.
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
    """The median (N,) of those that lie about it; None if there are too few.

    What is hidden from where the depth was measured, and what lies before it, counts as none.
    """
    near = ratios[np.abs(np.log(np.maximum(ratios, 1e-9))) < FURTHEST]
    if len(near) < LEAST_POINTS:
        return None
    middle = float(np.median(near))
    for _ in range(5):
        about = near[np.abs(near / middle - 1.0) < WINDOW]
        if len(about) < LEAST_POINTS:
            return None
        middle = float(np.median(about))
    return middle
