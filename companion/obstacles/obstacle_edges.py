"""Obstacles as level edges in the world, for viewers and topics."""

from __future__ import annotations

import numpy as np

from companion.geometry.transforms import Array, Pose
from companion.messages import ObstaclesSeen
from companion.obstacles.obstacle_sectors import N_SECTORS, SECTOR_DEG, UNKNOWN_CM, Obstacles
from companion.obstacles.obstacle_space import BEARING_DEG

NO_EDGES = np.zeros((0, 2, 3), np.float32)


def nothing_seen(t_ns: int) -> ObstaclesSeen:
    """Nothing is known around the vehicle."""
    return ObstaclesSeen(t_ns, np.zeros(3, np.float32), NO_EDGES, NO_EDGES)


def seen_around(t_ns: int, found: Obstacles | Array, world_from_body: Pose) -> ObstaclesSeen:
    """Edges of sectors, at the vehicle's height, or of the nearest points (N, 3) in body axes.

    Each is as wide as its sector or cell.
    """
    eye = world_from_body.translation
    nowhere = np.zeros((0, 3))
    if isinstance(found, Obstacles):
        near, free = _of_sectors(found, world_from_body)
        width_deg = SECTOR_DEG
    else:
        near, free = found @ world_from_body.rotation.T, nowhere
        width_deg = BEARING_DEG
    edges = [_across(rays, eye, width_deg) for rays in (near, free)]
    return ObstaclesSeen(t_ns, eye.astype(np.float32), *edges)


def _of_sectors(found: Obstacles, world_from_body: Pose) -> tuple[Array, Array]:
    """Level rays (N, 3), world axes, to the nearest in its sectors, and to the end of free ones."""
    forward = world_from_body.rotation[:, 0]
    bearing_rad = np.arctan2(forward[1], forward[0])
    bearing_rad = bearing_rad + np.radians(SECTOR_DEG) * np.arange(N_SECTORS)
    away = np.stack([np.cos(bearing_rad), np.sin(bearing_rad), np.zeros(N_SECTORS)], 1)
    distance_cm = found.distances_cm.astype(np.float64)
    is_free = distance_cm == found.max_cm + 1
    is_near = ~is_free & (distance_cm != UNKNOWN_CM)
    near = away[is_near] * (distance_cm[is_near, None] / 100)
    return near, away[is_free] * (found.max_cm / 100)


def _across(rays: Array, eye: Array, width_deg: float) -> np.ndarray:
    """Edges (N, 2, 3) in the world about the ends of rays (N, 3), as wide as an angle."""
    half = np.tan(np.radians(width_deg / 2))
    side = half * np.stack([-rays[:, 1], rays[:, 0], np.zeros(len(rays))], 1)
    ends = np.stack([rays - side, rays + side], 1) + eye
    return ends.astype(np.float32)
