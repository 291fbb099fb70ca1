"""Depth maps that agree become points."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from companion.config import CloudConfig
from companion.dense.local_scale import typical_ratio
from companion.dense.normals import MAX_STEP, normals
from companion.geometry.transforms import Array, Similarity
from companion.geometry.voxel import thin_by_voxel
from companion.messages import DepthMap, Floats, MapUpdate, PixelState, PointChunk

Mask = NDArray[np.bool_]
Indices = NDArray[np.int64]
N_HELD = 7
MAX_SIGMA = 0.01
"""Relative standard deviation of depth that a point of the cloud, or its witness, has at most."""


@dataclass(frozen=True, slots=True, eq=False)
class _Held:
    map: DepthMap
    normals: Floats
    spans: Mapping[int, float]
    """of its keyframe when its depth was measured"""


@dataclass(frozen=True, slots=True, eq=False)
class _Witness:
    """What another map says of points: which it agrees with; of these only the rest.

    How much further away they are and how sure it is, both in proportion; their normals, turned.
    """

    agrees: Mask
    off: Array
    sigma: Array
    normals: Array


class Fusion:
    """Holds the last depth maps; turns each into points once its neighbours are there."""

    def __init__(self, config: CloudConfig, wait_for: int = 2) -> None:
        self._config = config
        self._wait_for = wait_for
        self._held: OrderedDict[int, _Held] = OrderedDict()
        self._open: list[int] = []

    def add(self, depth_map: DepthMap, update: MapUpdate) -> list[PointChunk]:
        """Take a depth map; chunks of those that have waited long enough."""
        sure = measured_only(depth_map, MAX_SIGMA)
        self._held[depth_map.keyframe_id] = _Held(
            sure, normals(sure.depth, sure.intrinsics), update.spans_of(depth_map.keyframe_id)
        )
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
        held = self._held[keyframe_id]
        depth_map, facing = held.map, held.normals
        place = update.place_of(keyframe_id)
        if place is None:
            return None
        rows, columns = np.nonzero(_smooth(depth_map.depth))
        if len(rows) == 0:
            return None
        points = points_of(depth_map, rows, columns)
        points *= _stretch(held, place, update)
        depth = depth_map.depth[rows, columns]
        sigma = (depth_map.sigma[rows, columns] / depth).astype(np.float64)
        n_maps = np.ones(len(points), np.int64)
        further, scatter, variance = np.zeros(len(points)), np.zeros(len(points)), sigma**2
        normal: Array = facing[rows, columns].astype(np.float64)
        for other_id, other in self._held.items():
            other_place = update.place_of(other_id)
            if other_id == keyframe_id or other_place is None:
                continue
            stretch = _stretch(other, other_place, update)
            witness = self._witness(points, other_place.inverse() @ place, other, stretch)
            n_maps += witness.agrees
            further[witness.agrees] += witness.off
            scatter[witness.agrees] += witness.off**2
            variance[witness.agrees] += witness.sigma**2
            normal[witness.agrees] += witness.normals
        keep = n_maps > self._config.min_agreeing
        if not keep.any():
            return None
        # each map that agrees has the same say in how far away a point is
        further /= n_maps
        points *= (1.0 + further)[:, None]
        scatter = np.maximum(scatter / n_maps - further**2, 0.0)
        ratio = depth_map.inlier_ratio[rows, columns]
        confidence = ratio * (1.0 - 0.5**n_maps) / (1.0 + (sigma / 0.01) ** 2)
        # the maps share images, so that their errors are not independent
        fused = np.sqrt(variance / n_maps / 2 + scatter / n_maps) * points[:, 2]
        kept = np.flatnonzero(keep)
        voxel = self._voxel(points[kept], place, update)
        kept = kept[thin_by_voxel(points[kept], confidence[kept], voxel)]
        return PointChunk(
            keyframe_id, depth_map.t_ns, points[kept].astype(np.float32),
            np.ascontiguousarray(depth_map.rgb[rows[kept], columns[kept]]),
            confidence[kept].astype(np.float32), _unit(normal[kept]).astype(np.float32),
            fused[kept].astype(np.float32), update.spans_of(keyframe_id),
        )  # fmt: skip

    def _voxel(self, points: Array, place: Similarity, update: MapUpdate) -> float:
        """Size of a voxel in the chunk's units."""
        if update.georeference is None:
            return 0.01 * float(np.median(points[:, 2]))
        return self._config.voxel_m / (update.georeference.world_from_map.scale * place.scale)

    def _witness(
        self, points: Array, other_from_here: Similarity, other: _Held, stretch: float
    ) -> _Witness:
        """What the other, whose depths are to be stretched, sees of points (N, 3)."""
        p = other_from_here.apply(points)
        fx, fy, cx, cy = other.map.intrinsics
        height, width = other.map.depth.shape
        front = p[:, 2] > 1e-6
        z = np.where(front, p[:, 2], 1.0)
        u = np.rint(fx * p[:, 0] / z + cx)
        v = np.rint(fy * p[:, 1] / z + cy)
        inside = front & (u >= 0) & (v >= 0) & (u < width) & (v < height)
        row, column = (np.where(inside, x, 0).astype(np.int64) for x in (v, u))
        seen = np.where(inside, other.map.depth[row, column], 0.0)
        off: Array = stretch * seen / z - 1.0
        agrees: Mask = (seen > 0) & (np.abs(off) < self._config.agreement)
        row, column = row[agrees], column[agrees]
        return _Witness(
            agrees, off[agrees], other.map.sigma[row, column] / seen[agrees],
            other.normals[row, column] @ other_from_here.rotation,
        )  # fmt: skip


def points_of(depth_map: DepthMap, rows: Indices, columns: Indices) -> Array:
    """Points (N, 3) of pixels in the camera frame, map units."""
    fx, fy, cx, cy = depth_map.intrinsics
    z = depth_map.depth[rows, columns].astype(np.float64)
    return np.stack([(columns - cx) / fx * z, (rows - cy) / fy * z, z], 1)


def chunk_alone(depth_map: DepthMap) -> PointChunk:
    """All that has converged of the only map there is: no other can agree or disagree."""
    known = measured_only(depth_map)
    rows, columns = np.nonzero(known.depth)
    return PointChunk(
        depth_map.keyframe_id, depth_map.t_ns,
        points_of(depth_map, rows, columns).astype(np.float32),
        np.ascontiguousarray(depth_map.rgb[rows, columns]), depth_map.inlier_ratio[rows, columns],
        normals(known.depth, known.intrinsics)[rows, columns], known.sigma[rows, columns],
    )  # fmt: skip


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


def _stretch(held: _Held, place: Similarity, update: MapUpdate) -> float:
    """By what factor the map's points are further away now than the depths; by spans if too few."""
    depth_map = held.map
    points = place.inverse().apply(update.points_map)
    points = points[points[:, 2] > 1e-6]
    fx, fy, cx, cy = depth_map.intrinsics
    height, width = depth_map.depth.shape
    u = np.rint(fx * points[:, 0] / points[:, 2] + cx)
    v = np.rint(fy * points[:, 1] / points[:, 2] + cy)
    inside = (u >= 0) & (v >= 0) & (u < width) & (v < height)
    depth = depth_map.depth[v[inside].astype(np.int64), u[inside].astype(np.int64)]
    known = depth > 0
    ratio = typical_ratio(points[inside][known, 2] / depth[known])
    return update.local_scale_of(depth_map.keyframe_id, held.spans) if ratio is None else ratio


def _unit(vectors: Array) -> Array:
    length = np.linalg.norm(vectors, axis=1)
    return np.asarray(vectors / np.where(length > 0, length, 1.0)[:, None])


def _smooth(depth: Floats) -> Mask:
    """Pixels with depth that have a neighbour on the same surface, and none on another."""
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
