"""Times at which the points of a cloud came into view."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from companion.geometry.camera import Camera
from companion.geometry.transforms import Array
from companion.products.cloud import Cloud
from companion.products.flight_result import WorldPose

MAX_POSES = 240
LEAST_COSINE = 0.05
"""A surface is seen where its normal leans towards the camera by this much at least."""
REACH = 2.0
"""Points farther away than so many times the usual depth do not count as seen yet."""


def first_seen_ns(cloud: Cloud, poses: Sequence[WorldPose], camera: Camera) -> Array:
    """Time (N,) at which each point was first before the camera, facing it; inf where never.

    What hides what is not looked at, so that a wall may come a little before it is seen.
    """
    out = np.full(len(cloud), np.inf)
    chosen = poses[:: max(1, len(poses) // MAX_POSES)]
    points, normals = cloud.points.astype(np.float64), cloud.normals.astype(np.float64)
    faceless = np.asarray(~normals.any(1))
    for pose in chosen:
        left = np.flatnonzero(np.isinf(out))
        if not len(left):
            break
        seen = pose.world_from_camera.inverse().apply(points[left])
        ahead = seen[:, 2] > 0
        with np.errstate(divide="ignore", invalid="ignore"):
            u = camera.fx * seen[:, 0] / seen[:, 2] + camera.cx
            v = camera.fy * seen[:, 1] / seen[:, 2] + camera.cy
        within = (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
        inside = np.asarray(ahead & within)
        towards = pose.world_from_camera.translation - points[left]
        towards /= np.maximum(np.linalg.norm(towards, axis=1, keepdims=True), 1e-9)
        facing = np.asarray((towards * normals[left]).sum(1) > LEAST_COSINE)
        inside = np.asarray(inside & (facing | faceless[left]))
        if inside.any():
            inside &= seen[:, 2] < REACH * np.median(seen[inside, 2])
        out[left[inside]] = pose.t_ns
    return out
