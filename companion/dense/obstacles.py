"""Distance to the nearest obstacle per sector, from the newest part of the map.

Sectors are horizontal, around the vehicle, the first centred on straight ahead, clockwise in plan
view. Unseen space is unknown, not free: a sector is free only where lines of sight pass through it,
at the height of the vehicle, to something farther away, and only where that was seen just now.
Obstacles stay for longer: they stand where they were seen. So a vehicle that hovers, of which depth
knows nothing new, sees what is free turn to unknown. What no recent frame confirms is unknown too.

Static textured obstacles are detected; moving or untextured ones are not.
"""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from companion.dense.fusion import MAX_SIGMA, chunk_alone, measured_only
from companion.geometry.transforms import Array, Pose
from companion.messages import DepthMap, MapUpdate, PointChunk

N_SECTORS = 72
SECTOR_DEG = 5.0
UNKNOWN_CM = 65535
MIN_POINTS = 3
"""Fewer points in a sector count as outliers."""
NEAR_SIGHT_M = 1.0
"""Largest distance of a line of sight from the vehicle to count for its surroundings."""
MIN_M, MAX_M = 0.3, 20.0
"""Horizontal distances searched for obstacles; what is nearer is the vehicle itself."""
ABOVE_M, BELOW_M = 1.0, 0.75
"""Heights searched, relative to the vehicle, along the vertical."""
FREE_S = 2.0
"""Age of what is seen, from its exposure, up to which it shows that nothing is in between. Depth of
a keyframe is known a second after it."""
STAYS_S = 15.0
"""Age up to which an obstacle stays."""


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
    t_ns: int, world_from_body: Pose, points_world_m: Array, seen_from_world_m: Array,
    ages_s: Array,
) -> Obstacles:  # fmt: skip
    """Distances from a pose to points (N, 3) seen from camera positions (N, 3), (N,) seconds ago.

    The pose must be by the map of the points: a slewed one is offset.
    """
    position = world_from_body.translation
    finite = np.isfinite(points_world_m).all(1) & np.isfinite(seen_from_world_m).all(1)
    points, eyes = points_world_m[finite] - position, seen_from_world_m[finite] - position
    is_new = ages_s[finite] <= FREE_S
    distance_m = np.hypot(points[:, 0], points[:, 1])
    sector = sector_of(points, world_from_body)

    max_cm = round(MAX_M * 100)
    min_cm = round(MIN_M * 100)
    distances_cm = np.full(N_SECTORS, UNKNOWN_CM, np.uint16)
    far = (distance_m > MAX_M) & is_new
    through = _seen_through(points[far], eyes[far])
    distances_cm[np.bincount(sector[far][through], minlength=N_SECTORS) >= MIN_POINTS] = max_cm + 1

    down_m = points[:, 2]
    hit = (down_m >= -ABOVE_M) & (down_m <= BELOW_M)
    hit &= (distance_m >= MIN_M) & (distance_m <= MAX_M)
    hit_m, hit_sector = distance_m[hit], sector[hit]
    order = np.lexsort((hit_m, hit_sector))
    hit_m, hit_sector = hit_m[order], hit_sector[order]
    found, first, n = np.unique(hit_sector, return_index=True, return_counts=True)
    # not the very nearest point of a sector, which may be an outlier
    enough = n >= MIN_POINTS
    nearest_m = hit_m[first[enough] + MIN_POINTS - 1]
    distances_cm[found[enough]] = np.clip((nearest_m * 100).astype(np.int64), min_cm, max_cm)
    return Obstacles(t_ns, distances_cm, min_cm, max_cm)


def sector_of(points: Array, world_from_body: Pose) -> NDArray[np.int64]:
    """Sector of each point (N, 3), relative to the vehicle, in world axes."""
    forward = world_from_body.rotation[:, 0]
    bearing_rad = np.arctan2(points[:, 1], points[:, 0]) - np.arctan2(forward[1], forward[0])
    index: NDArray[np.int64] = np.floor(np.degrees(bearing_rad) / SECTOR_DEG + 0.5).astype(np.int64)
    return index % N_SECTORS


def _seen_through(points: Array, eyes: Array) -> NDArray[np.bool_]:
    """Points beyond `MAX_M` whose line of sight stays at the height of the vehicle.

    The line starts at the camera and passes close to the vehicle, at the origin.
    """
    line = points - eyes
    length_m = np.linalg.norm(line, axis=1)
    direction = line / np.maximum(length_m, 1e-9)[:, None]
    along_m = np.clip(-(eyes * direction).sum(1), 0.0, length_m)
    closest = eyes + along_m[:, None] * direction
    level = np.hypot(direction[:, 0], direction[:, 1])
    end_down_m = closest[:, 2] + direction[:, 2] / np.maximum(level, 1e-9) * MAX_M
    through: NDArray[np.bool_] = (
        (np.linalg.norm(closest, axis=1) <= NEAR_SIGHT_M)
        & (closest[:, 2] >= -ABOVE_M)
        & (closest[:, 2] <= BELOW_M)
        & (end_down_m >= -ABOVE_M)
        & (end_down_m <= BELOW_M)
    )
    return through


class RecentCloud:
    """The newest parts of the cloud, subsampled; older than `max_age_s` are ignored.

    A depth map counts as it comes; its fused chunk, two keyframes later, replaces it.
    """

    def __init__(
        self, max_age_s: float = STAYS_S, max_chunks: int = 12, max_points: int = 4000
    ) -> None:
        self._max_age_ns = round(max_age_s * 1e9)
        self._max_chunks = max_chunks
        self._max_points = max_points
        self._chunks: OrderedDict[int, PointChunk] = OrderedDict()

    def add_map(self, depth_map: DepthMap) -> None:
        """Add what a depth map has measured for certain."""
        self.add(chunk_alone(measured_only(depth_map, MAX_SIGMA)))

    def add(self, chunk: PointChunk) -> None:
        """Add a chunk, replacing one of the same keyframe."""
        step = -(-len(chunk.points_camera) // self._max_points) or 1
        thinned = PointChunk(
            chunk.keyframe_id,
            chunk.t_ns,
            chunk.points_camera[::step],
            chunk.rgb[::step],
            chunk.confidence[::step],
            chunk.normals_camera[::step],
            chunk.sigma[::step],
        )
        self._chunks.pop(chunk.keyframe_id, None)
        self._chunks[chunk.keyframe_id] = thinned
        while len(self._chunks) > self._max_chunks:
            self._chunks.popitem(last=False)

    def in_world(self, t_ns: int, update: MapUpdate) -> tuple[Array, Array, Array] | None:
        """Points (N, 3), the camera positions (N, 3) that saw them, metres, and ages (N,), seconds.

        None without a metric scale.
        """
        if update.georeference is None:
            return None
        points, eyes, ages = [np.zeros((0, 3))], [np.zeros((0, 3))], [np.zeros(0)]
        for chunk in self._chunks.values():
            place = update.place_of(chunk.keyframe_id)
            if place is None or t_ns - chunk.t_ns > self._max_age_ns:
                continue
            world_from_camera = update.georeference.world_from_map @ place
            points.append(world_from_camera.apply(chunk.points_camera.astype(np.float64)))
            eyes.append(np.broadcast_to(world_from_camera.translation, points[-1].shape))
            ages.append(np.full(len(points[-1]), 1e-9 * (t_ns - chunk.t_ns)))
        return np.concatenate(points), np.concatenate(eyes), np.concatenate(ages)
