"""Nearest obstacle in each part of the space around the vehicle, not only at its own height.

The parts are cells of bearing and elevation, which move and turn with the vehicle. A cell that the
newest images do not confirm is unknown: nothing is told of it, nor of one that holds nothing.

What lies at the height of the vehicle or above is an obstacle; below, what stands out of the
ground: one who descends towards level ground, or a roof, is not held up by it.
"""

from __future__ import annotations

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from companion.geometry.transforms import Array, Pose
from companion.obstacles.obstacle_sectors import BELOW_M, MAX_M, MIN_M, MIN_POINTS, bearings_of

Mask = NDArray[np.bool_]
Ints = NDArray[np.int64]

BEARING_DEG, ELEVATION_DEG = 15.0, 30.0
"""Size of a cell: in elevation that of ArduPilot's own boundary, AP_Proximity, and a third of it
in bearing, as its database of obstacles takes each point."""
N_BEARINGS, N_ELEVATIONS = 24, 5
"""Up to 75 degrees above and below level."""
N_CELLS = N_BEARINGS * N_ELEVATIONS
COLUMN_M, AROUND = 1.0, 5
"""Side of a column of the ground, and columns to each side within which the lowest point is taken
for ground: five metres, wider than crowns of most trees are seen from above."""
STANDS_OUT_M = 1.0
"""Height over that from which on something is no ground: five metres on, ground may rise by it."""


def cells_of(points: Array, world_from_body: Pose) -> Ints:
    """Cell (N,) of points or rays (N, 3) from the vehicle, in world axes; -1 steeply up or down."""
    bearing = np.floor(np.degrees(bearings_of(points, world_from_body)) / BEARING_DEG + 0.5)
    up_deg = np.degrees(np.arctan2(-points[:, 2], np.hypot(points[:, 0], points[:, 1])))
    layer = np.floor(up_deg / ELEVATION_DEG + 0.5 * N_ELEVATIONS)
    cells = (bearing % N_BEARINGS) * N_ELEVATIONS + layer
    out: Ints = np.where((layer >= 0) & (layer < N_ELEVATIONS), cells, -1).astype(np.int64)
    return out


def cells_with(rays: Array, world_from_body: Pose) -> Mask:
    """Mask (120,) of cells in which enough rays or points (N, 3) from the vehicle lie."""
    cells = cells_of(rays[np.isfinite(rays).all(1)], world_from_body)
    return np.asarray(np.bincount(cells[cells >= 0], minlength=N_CELLS) >= MIN_POINTS)


def nearest_in_cells(world_from_body: Pose, points_world_m: Array, is_seen: Mask) -> Array:
    """The nearest point of each confirmed cell (120,) that holds any, (M, 3) in body axes, metres.

    The pose must be by the map of the points (N, 3). Not the very nearest of a cell counts, which
    may be an outlier.
    """
    points = points_world_m[np.isfinite(points_world_m).all(1)] - world_from_body.translation
    distance_m = np.linalg.norm(points, axis=1)
    near = (distance_m >= MIN_M) & (distance_m <= MAX_M)
    points, distance_m = points[near], distance_m[near]
    stands = (points[:, 2] <= BELOW_M) | _stands_out(points)
    points, distance_m = points[stands], distance_m[stands]
    cells = cells_of(points, world_from_body)
    kept = np.flatnonzero(cells >= 0)
    kept = kept[is_seen[cells[kept]]]
    order = kept[np.lexsort((distance_m[kept], cells[kept]))]
    _, first, n = np.unique(cells[order], return_index=True, return_counts=True)
    nearest = order[first[n >= MIN_POINTS] + MIN_POINTS - 1]
    out: Array = points[nearest] @ world_from_body.rotation
    return out


def _stands_out(points: Array) -> Mask:
    """Mask (N,) of points, z down, that are no ground: far above the lowest about them."""
    side = 2 * int(np.ceil(MAX_M / COLUMN_M)) + 1
    column, row = (np.floor(points[:, :2] / COLUMN_M).astype(np.int64) + side // 2).T
    lowest = np.full((side + 2 * AROUND, side + 2 * AROUND), -np.inf)
    np.maximum.at(lowest, (column + AROUND, row + AROUND), points[:, 2])
    for axis in (0, 1):
        lowest = sliding_window_view(lowest, 2 * AROUND + 1, axis).max(-1)
    return np.asarray(points[:, 2] < lowest[column, row] - STANDS_OUT_M)
