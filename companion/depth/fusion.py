"""Depth maps that agree become points."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from companion.config import CloudConfig
from companion.geometry import Array, Similarity
from companion.messages import DepthMap, Floats, MapUpdate, PixelState, PointChunk
from companion.voxel import thin_by_voxel

Mask = NDArray[np.bool_]
N_HELD = 7
MAX_SIGMA = 0.01
"""Relative standard deviation of depth that a point of the cloud, or its witness, has at most."""
MAX_STEP = 0.04
"""Relative step of depth to a neighbour pixel at which a surface ends."""


class Fusion:
    """Holds the last depth maps; turns each into points once its neighbours are there."""

    def __init__(self, config: CloudConfig, wait_for: int = 2) -> None:
        self._config = config
        self._wait_for = wait_for
        self._held: OrderedDict[int, DepthMap] = OrderedDict()
        self._open: list[int] = []

    def add(self, depth_map: DepthMap, update: MapUpdate) -> list[PointChunk]:
        """Take a depth map; chunks of those that have waited long enough."""
        self._held[depth_map.keyframe_id] = measured_only(depth_map, MAX_SIGMA)
        self._open.append(depth_map.keyframe_id)
        out = []
        while len(self._open) > self._wait_for:
            out.append(self._fuse(self._open.pop(0), update))
        while len(self._held) > N_HELD:
            self._held.popitem(last=False)
        return [chunk for chunk in out if chunk is not None]

    def flush(self, update: MapUpdate) -> list[PointChunk]:
        """Chunks of all that still wait."""
        out = [self._fuse(k, update) for k in self._open]
        self._open.clear()
        return [chunk for chunk in out if chunk is not None]

    def _fuse(self, keyframe_id: int, update: MapUpdate) -> PointChunk | None:
        depth_map = self._held[keyframe_id]
        place = update.place_of(keyframe_id)
        if place is None:
            return None
        rows, columns = np.nonzero(depth_map.depth)
        if len(rows) == 0:
            return None
        ahead = _smooth(depth_map.depth)[rows, columns]
        rows, columns = rows[ahead], columns[ahead]
        z = depth_map.depth[rows, columns].astype(np.float64)
        fx, fy, cx, cy = depth_map.intrinsics
        points = np.stack([(columns - cx) / fx * z, (rows - cy) / fy * z, z], 1)
        agreeing = np.zeros(len(points), np.int64)
        further = np.zeros(len(points))
        for other_id, other in self._held.items():
            other_place = update.place_of(other_id)
            if other_id == keyframe_id or other_place is None:
                continue
            agrees, off = self._agrees(points, other_place.inverse() @ place, other)
            agreeing += agrees
            further += np.where(agrees, off, 0.0)
        # each map that agrees has the same say in how far away a point is
        points *= (1.0 + further / (agreeing + 1))[:, None]
        sigma = depth_map.sigma[rows, columns] / np.maximum(z, 1e-9)
        ratio = depth_map.inlier_ratio[rows, columns]
        keep = agreeing >= self._config.min_agreeing
        points, agreeing, sigma, ratio = points[keep], agreeing[keep], sigma[keep], ratio[keep]
        rows, columns = rows[keep], columns[keep]
        if len(points) == 0:
            return None
        confidence = ratio * (1.0 - 0.5 ** (agreeing + 1)) / (1.0 + (sigma / 0.01) ** 2)
        kept = thin_by_voxel(points, confidence, self._voxel(points, place, update))
        return PointChunk(
            keyframe_id, depth_map.t_ns, points[kept].astype(np.float32),
            np.ascontiguousarray(depth_map.rgb[rows[kept], columns[kept]]),
            confidence[kept].astype(np.float32),
        )  # fmt: skip

    def _voxel(self, points: Array, place: Similarity, update: MapUpdate) -> float:
        """Size of a voxel in the chunk's units."""
        if update.georeference is None:
            return 0.01 * float(np.median(points[:, 2]))
        return self._config.voxel_m / (update.georeference.world_from_map.scale * place.scale)

    def _agrees(
        self, points: Array, other_from_here: Similarity, other: DepthMap
    ) -> tuple[Mask, Array]:
        """Whether the other sees each point where it is, and how much further, in proportion."""
        p = other_from_here.apply(points)
        fx, fy, cx, cy = other.intrinsics
        height, width = other.depth.shape
        front = p[:, 2] > 1e-6
        z = np.where(front, p[:, 2], 1.0)
        u = np.rint(fx * p[:, 0] / z + cx)
        v = np.rint(fy * p[:, 1] / z + cy)
        inside = front & (u >= 0) & (v >= 0) & (u < width) & (v < height)
        seen = np.zeros(len(points))
        seen[inside] = other.depth[v[inside].astype(int), u[inside].astype(int)]
        off: Array = seen / z - 1.0
        agrees: Mask = (seen > 0) & (np.abs(off) < self._config.agreement)
        return agrees, off


def measured_only(depth_map: DepthMap, max_sigma: float = np.inf) -> DepthMap:
    """The same without what was filled in, or has a larger relative standard deviation."""
    known = depth_map.state == PixelState.CONVERGED.value
    if np.isfinite(max_sigma):
        known &= depth_map.sigma <= max_sigma * depth_map.depth
    nothing = np.float32(0)
    return replace(
        depth_map, depth=np.where(known, depth_map.depth, nothing),
        sigma=np.where(known, depth_map.sigma, nothing),
    )  # fmt: skip


def _smooth(depth: Floats) -> Mask:
    """Pixels that have a neighbour on the same surface, and none where a nearer surface ends."""
    ok = np.zeros(depth.shape, bool)
    edge = np.zeros(depth.shape, bool)
    for axis in (0, 1):
        for shift in (1, -1):
            other = np.roll(depth, shift, axis)
            both = (depth > 0) & (other > 0)
            step = np.abs(depth - other) > MAX_STEP * depth
            ok |= both & ~step
            edge |= both & step
    return ok & ~edge
