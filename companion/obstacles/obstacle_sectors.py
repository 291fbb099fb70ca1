"""Distance to the nearest obstacle per sector, from the newest part of the map.

Sectors are horizontal, around the vehicle, the first centred on straight ahead, clockwise in plan
view. Unseen space is unknown, not free: what is free `clear_sight` tells, by the newest image.
Obstacles stay for longer: they stand where they were seen. What no recent frame confirms is unknown
too.

Static textured obstacles are detected; moving or untextured ones are not.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from companion.geometry.transforms import Array, Pose

N_SECTORS = 72
SECTOR_DEG = 5.0
UNKNOWN_CM = 65535
MIN_POINTS = 3
"""Fewer points in a sector count as outliers."""
MIN_M, MAX_M = 0.3, 20.0
"""Horizontal distances searched for obstacles; what is nearer is the vehicle itself."""
FAR_M = 1000.0
"""More than any distance: sectors and distances in them are sorted as one number."""
FREE_M = 8.0
"""Distance up to which a sector is free; in straight flight more has no parallax ahead."""
ABOVE_M, BELOW_M = 1.0, 0.75
"""Heights searched, relative to the vehicle, along the vertical."""


@dataclass(frozen=True, slots=True, eq=False)
class Obstacles:
    """Distances (72,) in centimetres: `max_cm` + 1 where free, UNKNOWN_CM where unseen."""

    t_ns: int
    distances_cm: NDArray[np.uint16]
    min_cm: int
    max_cm: int


def known_in(found: Obstacles, sectors: NDArray[np.bool_]) -> Obstacles:
    """The same with all but some sectors (72,) unknown."""
    kept = np.where(sectors, found.distances_cm, UNKNOWN_CM).astype(np.uint16)
    return replace(found, distances_cm=kept)


def unknown(t_ns: int) -> Obstacles:
    """Nothing is known."""
    nothing = np.full(N_SECTORS, UNKNOWN_CM, np.uint16)
    return Obstacles(t_ns, nothing, round(MIN_M * 100), round(MAX_M * 100))


def obstacles_around(
    t_ns: int, world_from_body: Pose, points_world_m: Array, is_free: NDArray[np.bool_],
    reach_m: float = MAX_M,
) -> Obstacles:  # fmt: skip
    """Distances from a pose to points (N, 3), up to `reach_m`; which sectors (72,) are free so far.

    The pose must be by the map of the points: a slewed one is offset.
    """
    points = points_world_m - world_from_body.translation
    # nan is in no band
    points = points[(points[:, 2] >= -ABOVE_M) & (points[:, 2] <= BELOW_M)]
    distance_m = np.hypot(points[:, 0], points[:, 1])
    hit = (distance_m >= MIN_M) & (distance_m <= reach_m)
    in_order = np.sort(FAR_M * sector_of(points[hit], world_from_body) + distance_m[hit])
    found, first, n = np.unique(in_order // FAR_M, return_index=True, return_counts=True)

    max_cm = round(reach_m * 100)
    min_cm = round(MIN_M * 100)
    distances_cm = np.where(is_free, max_cm + 1, UNKNOWN_CM).astype(np.uint16)
    # not the very nearest point of a sector, which may be an outlier
    enough = n >= MIN_POINTS
    nearest_cm = 100 * (in_order[first[enough] + MIN_POINTS - 1] % FAR_M)
    distances_cm[found[enough].astype(np.int64)] = np.clip(nearest_cm, min_cm, max_cm)
    return Obstacles(t_ns, distances_cm, min_cm, max_cm)


def sector_of(points: Array, world_from_body: Pose) -> NDArray[np.int64]:
    """Sector of each point (N, 3), relative to the vehicle, in world axes."""
    bearing_rad = bearings_of(points, world_from_body)
    index: NDArray[np.int64] = np.floor(np.degrees(bearing_rad) / SECTOR_DEG + 0.5).astype(np.int64)
    return index % N_SECTORS


def bearings_of(points: Array, world_from_body: Pose) -> Array:
    """Bearings (N,), clockwise from the vehicle's heading, of points (N, 3) in world axes."""
    forward = world_from_body.rotation[:, 0]
    out: Array = np.arctan2(points[:, 1], points[:, 0]) - np.arctan2(forward[1], forward[0])
    return out
