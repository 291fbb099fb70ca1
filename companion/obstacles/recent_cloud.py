"""Newest parts of the cloud, in which obstacles are looked for."""

from __future__ import annotations

from collections import OrderedDict

import numpy as np

from companion.dense.fusion import MAX_SIGMA, chunk_alone, measured_only
from companion.flight_notes import ObstaclePoints
from companion.geometry.transforms import Array
from companion.messages import DepthMap, MapUpdate, PointChunk

STAYS_S = 15.0
"""Age up to which an obstacle stays."""
MAX_POINTS = 4000
"""Of a keyframe; of more every second is left out, or more of them."""


def obstacle_points(message: DepthMap | PointChunk, most: int = MAX_POINTS) -> ObstaclePoints:
    """Points of fused points, or what a depth map has measured for certain, subsampled."""
    if isinstance(message, DepthMap):
        message = chunk_alone(measured_only(message, MAX_SIGMA))
    step = -(-len(message.points_camera) // most) or 1
    return ObstaclePoints(
        message.t_ns, message.keyframe_id, np.ascontiguousarray(message.points_camera[::step])
    )


class RecentCloud:
    """The newest parts of the cloud; older than `max_age_s` are ignored.

    A depth map counts as it comes; its fused points, two keyframes later, replace it.
    """

    def __init__(self, max_age_s: float = STAYS_S, max_parts: int = 12) -> None:
        self._max_age_ns = round(max_age_s * 1e9)
        self._max_parts = max_parts
        self._parts: OrderedDict[int, ObstaclePoints] = OrderedDict()

    def add(self, part: ObstaclePoints) -> None:
        """Add a part, replacing one of the same keyframe."""
        self._parts.pop(part.keyframe_id, None)
        self._parts[part.keyframe_id] = part
        while len(self._parts) > self._max_parts:
            self._parts.popitem(last=False)

    def in_world(self, t_ns: int, update: MapUpdate) -> Array | None:
        """Points (N, 3), metres; None without a metric scale."""
        if update.georeference is None:
            return None
        points = [np.zeros((0, 3))]
        for part in self._parts.values():
            place = update.place_of(part.keyframe_id)
            if place is None or t_ns - part.t_ns > self._max_age_ns:
                continue
            world_from_camera = update.georeference.world_from_map @ place
            points.append(world_from_camera.apply(part.points_camera.astype(np.float64)))
        return np.concatenate(points)
