"""Points of a keyframe's depth, in which obstacles are looked for."""

from __future__ import annotations

import numpy as np

from companion.dense.fusion import MAX_SIGMA, chunk_alone, measured_only
from companion.flight_notes import ObstaclePoints
from companion.messages import DepthMap, PointChunk

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
