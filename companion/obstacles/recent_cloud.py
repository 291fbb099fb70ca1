"""Newest parts of the cloud, in which obstacles are looked for."""

from __future__ import annotations

from collections import OrderedDict

import numpy as np

from companion.dense.fusion import MAX_SIGMA, chunk_alone, measured_only
from companion.geometry.transforms import Array
from companion.messages import DepthMap, MapUpdate, PointChunk

STAYS_S = 15.0
"""Age up to which an obstacle stays."""


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

    def in_world(self, t_ns: int, update: MapUpdate) -> Array | None:
        """Points (N, 3), metres; None without a metric scale."""
        if update.georeference is None:
            return None
        points = [np.zeros((0, 3))]
        for chunk in self._chunks.values():
            place = update.place_of(chunk.keyframe_id)
            if place is None or t_ns - chunk.t_ns > self._max_age_ns:
                continue
            world_from_camera = update.georeference.world_from_map @ place
            points.append(world_from_camera.apply(chunk.points_camera.astype(np.float64)))
        return np.concatenate(points)
