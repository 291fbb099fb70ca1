"""Sectors that are free: all that the newest image shows of them lies beyond what is asked.

A thing that stands in the way hides what is behind it. So where no square of its size is without a
corner that was measured behind, none stands there, whatever it looks like. Corners measured in
front, or perhaps in front, speak against all that is about them: so thinner things are seen, too,
that have a pattern.

A corner is followed by a window, which sees by the edge of a thing what is behind: a square must be
larger than the thing's by that much.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from companion.geometry.transforms import Array, Pose
from companion.obstacles.newest_sight import Seen
from companion.obstacles.obstacle_sectors import ABOVE_M, BELOW_M, FREE_M, N_SECTORS, bearings_of

THING_M = 0.6
"""Width and height of what would be seen `FREE_M` away, whatever it looks like."""
FIELD_FROM_M = 4.0
"""Distance from which on the whole band of heights is in the field that is looked at."""
CELL_RAD = np.radians(0.25)
CELLS = 20
"""In a sector."""
PERHAPS_RATIO, PERHAPS_M = 1.05, 0.3
"""Error of a distance: nearer than that beyond is perhaps in front."""

Mask = NDArray[np.bool_]


def free_sectors(seen: Seen, world_from_body: Pose, window_rad: float) -> Mask:
    """Mask (72,) of sectors, around a vehicle, in which nothing stands up to `FREE_M` away.

    `window_rad` is the width of the window that corners are followed by.
    """
    blank_rad = THING_M / FREE_M - window_rad
    width = int(blank_rad / CELL_RAD) - 1  # cells in such a square, wherever it lies
    if width < 1 or len(seen.rays_world) == 0:
        return np.zeros(N_SECTORS, bool)
    level = np.hypot(seen.rays_world[:, 0], seen.rays_world[:, 1])
    up_rad = np.arctan2(-seen.rays_world[:, 2], level)
    wanted_m = _wanted_m(up_rad)
    is_far = level >= wanted_m * seen.most_inverse_m
    perhaps_m = PERHAPS_RATIO * wanted_m + PERHAPS_M
    is_near = seen.is_sure & ~is_far & (level < perhaps_m * seen.inverse_m)

    bearing_rad = bearings_of(seen.rays_world, world_from_body)
    n_columns, down, up = CELLS * N_SECTORS, _field_rad(BELOW_M), _field_rad(ABOVE_M)
    column = np.floor(bearing_rad / CELL_RAD).astype(np.int64) + CELLS // 2
    row = np.floor((up_rad + down) / CELL_RAD).astype(np.int64) + width
    n_rows = int(np.ceil((down + up) / CELL_RAD))
    inside = is_far & (row >= 0) & (row < n_rows + 2 * width)
    far = np.zeros((n_rows + 2 * width, n_columns), np.uint8)
    far[row[inside], column[inside] % n_columns] = 1
    around = np.pad(far, ((0, 0), (width, width)), mode="wrap")
    shown = cv2.dilate(around, np.ones((width, width), np.uint8))
    in_sectors = shown[width:-width, width:-width].reshape(n_rows, N_SECTORS, CELLS)
    whole: Mask = in_sectors.all((0, 2)).reshape(N_SECTORS)

    aside = int(np.ceil(0.5 * blank_rad / CELL_RAD))
    against = column[is_near, None] + [-aside, 0, aside]
    whole[against % n_columns // CELLS] = False
    return whole


def _field_rad(height_m: float) -> float:
    return float(np.arctan(height_m / FIELD_FROM_M))


def _wanted_m(up_rad: Array) -> Array:
    """Level distance (N,) that sight at elevations (N,) has to reach: to where the band ends."""
    height_m = np.where(up_rad > 0, ABOVE_M, BELOW_M)
    slope = np.maximum(np.abs(np.tan(up_rad)), 1e-6)
    return np.asarray(np.minimum(FREE_M, height_m / slope))
