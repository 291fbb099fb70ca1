"""Sectors that are free: their cells were seen through in the last seconds, some in this image.

A thing that stands in the way hides what is behind it. So where each cell was seen through, nothing
stands that holds one, whatever it looks like. Corners measured in front, or perhaps in front, speak
against what is about them: so thinner things are seen, too, that have a pattern.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from companion.geometry.camera import Camera
from companion.geometry.transforms import Pose
from companion.obstacles.newest_sight import Seen
from companion.obstacles.obstacle_sectors import (
    ABOVE_M,
    BELOW_M,
    FREE_M,
    MIN_M,
    MIN_POINTS,
    N_SECTORS,
    SECTOR_DEG,
    bearings_of,
    sector_of,
)
from companion.obstacles.occupancy_grid import CELL_M, DOUBT, FREE, OccupancyGrid

FIELD_FROM_M = 4.0
"""Distance from which on the whole band of heights is in the field that is looked at."""
PERHAPS_M = 1.05 * FREE_M + 0.3
"""By its error, what is measured nearer than that may stand up to `FREE_M` away."""


def can_see_free(camera: Camera) -> bool:
    """True if the camera of a level vehicle has all of that field in view, straight where it looks.

    Without, no sector is ever free but after a climb or descent. Neither an unknown mount nor a
    gimbal is judged: True.
    """
    mount = camera.body_from_camera
    if mount is None or camera.gimbal is not None:
        return True
    ahead = mount.rotation[:2, 2]
    up = np.array([ABOVE_M, -BELOW_M]) / FIELD_FROM_M * np.linalg.norm(ahead)
    edges = np.c_[np.tile(ahead, (2, 1)), -up] @ mount.rotation
    rows = camera.project(edges)[:, 1]
    return bool(((rows >= 0) & (rows < camera.height)).all())


def free_sectors(grid: OccupancyGrid, seen: Seen, world_from_body: Pose) -> NDArray[np.bool_]:
    """Mask (72,) of sectors, around a vehicle, in which nothing stands up to `FREE_M` away."""
    eye = world_from_body.translation
    reach = np.array([PERHAPS_M, PERHAPS_M])
    levels, (x, y, z) = grid.about(eye, np.array([[*-reach, -ABOVE_M], [*reach, BELOW_M]]))
    level_m = np.hypot(x[:, None], y)
    up = -z / level_m[..., None]
    in_field = (up <= ABOVE_M / FIELD_FROM_M) & (up >= -BELOW_M / FIELD_FROM_M)
    unseen = ((levels > FREE) & in_field).any(2) & (level_m >= MIN_M) & (level_m <= FREE_M)
    taken = (levels >= DOUBT).any(2) & (level_m >= MIN_M) & (level_m <= PERHAPS_M)
    at = np.nonzero(unseen | taken)
    bearing = bearings_of(np.stack([x[at[0]], y[at[1]]], 1), world_from_body)
    # as wide as they are; and a point may lie as far from the edge of what it is of
    aside = np.arcsin(np.minimum(CELL_M * np.where(taken, 1.0, 0.5)[at] / level_m[at], 1.0))
    around = np.degrees(bearing[:, None] + aside[:, None] * [-1, 0, 1]) / SECTOR_DEG

    level_m = np.hypot(seen.rays_world[:, 0], seen.rays_world[:, 1])
    up = -seen.rays_world[:, 2] / level_m
    far = (up <= ABOVE_M / FREE_M) & (up >= -BELOW_M / FREE_M)
    far &= level_m >= FREE_M * seen.most_inverse_m
    now = np.bincount(sector_of(seen.rays_world[far], world_from_body), minlength=N_SECTORS)
    free = now >= MIN_POINTS
    free[np.floor(around + 0.5).astype(np.int64) % N_SECTORS] = False
    return np.asarray(free)
