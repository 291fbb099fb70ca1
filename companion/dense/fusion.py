"""Fusion of agreeing depth maps into point chunks."""

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
from companion.geometry.voxel import voxel_downsample
from companion.messages import DepthMap, Floats, MapUpdate, PixelState, PointChunk

Mask = NDArray[np.bool_]
Indices = NDArray[np.int64]
N_MAPS = 7
N_AFTER = 2
"""Later maps that a map is fused with."""
MAX_SIGMA = 0.01
"""Largest relative standard deviation of depth used in the cloud."""


@dataclass(frozen=True, slots=True, eq=False)
class _RecentMap:
    map: DepthMap
    normals: Floats
    spans: Mapping[int, float]
    """Spans of its keyframe at measurement, see `MapUpdate.spans_of`."""


@dataclass(frozen=True, slots=True, eq=False)
class _Agreement:
    """Agreement of another map with points: mask, and for agreeing points only the rest.

    Relative depth difference and sigma; rotated normals.
    """

    agrees: Mask
    difference: Array
    sigma: Array
    normals: Array


class Fusion:
    """Buffers depth maps; fuses each once its neighbours have arrived."""

    def __init__(self, config: CloudConfig) -> None:
        self._config = config
        self._recent: OrderedDict[int, _RecentMap] = OrderedDict()
        self._pending: list[int] = []

    def add(self, depth_map: DepthMap, update: MapUpdate) -> list[PointChunk]:
        """Add a depth map; chunks of those that are complete."""
        sure = measured_only(depth_map, MAX_SIGMA)
        self._recent[depth_map.keyframe_id] = _RecentMap(
            sure, normals(sure.depth, sure.intrinsics), update.spans_of(depth_map.keyframe_id)
        )
        self._pending.append(depth_map.keyframe_id)
        out = []
        while len(self._pending) > N_AFTER:
            out.append(self._fuse(self._pending.pop(0), update))
        while len(self._recent) > N_MAPS:
            self._recent.popitem(last=False)
        return [chunk for chunk in out if chunk is not None]

    def flush(self, update: MapUpdate) -> list[PointChunk]:
        """Chunks of all pending maps."""
        out = [self._fuse(k, update) for k in self._pending]
        self._pending.clear()
        return [chunk for chunk in out if chunk is not None]

    def _fuse(self, keyframe_id: int, update: MapUpdate) -> PointChunk | None:
        recent = self._recent[keyframe_id]
        depth_map, facing = recent.map, recent.normals
        place = update.place_of(keyframe_id)
        if place is None:
            return None
        rows, columns = np.nonzero(_smooth(depth_map.depth))
        if len(rows) == 0:
            return None
        points = points_of(depth_map, rows, columns)
        points *= _local_scale(recent, place, update)
        depth = depth_map.depth[rows, columns]
        sigma = (depth_map.sigma[rows, columns] / depth).astype(np.float64)
        n_maps = np.ones(len(points), np.int64)
        further, scatter, variance = np.zeros(len(points)), np.zeros(len(points)), sigma**2
        normal: Array = facing[rows, columns].astype(np.float64)
        for other_id, other in self._recent.items():
            other_place = update.place_of(other_id)
            if other_id == keyframe_id or other_place is None:
                continue
            local_scale = _local_scale(other, other_place, update)
            agreement = self._agreement(points, other_place.inverse() @ place, other, local_scale)
            n_maps += agreement.agrees
            further[agreement.agrees] += agreement.difference
            scatter[agreement.agrees] += agreement.difference**2
            variance[agreement.agrees] += agreement.sigma**2
            normal[agreement.agrees] += agreement.normals
        keep = n_maps > self._config.min_agreeing
        if not keep.any():
            return None
        # agreeing maps have equal weight in the depth
        further /= n_maps
        points *= (1.0 + further)[:, None]
        scatter = np.maximum(scatter / n_maps - further**2, 0.0)
        ratio = depth_map.inlier_ratio[rows, columns]
        confidence = ratio * (1.0 - 0.5**n_maps) / (1.0 + (sigma / 0.01) ** 2)
        # the maps share images, so that their errors are not independent
        fused = np.sqrt(variance / n_maps / 2 + scatter / n_maps) * points[:, 2]
        kept = np.flatnonzero(keep)
        voxel = self._voxel(points[kept], place, update)
        kept = kept[voxel_downsample(points[kept], confidence[kept], voxel)]
        return PointChunk(
            keyframe_id, depth_map.t_ns, points[kept].astype(np.float32),
            np.ascontiguousarray(depth_map.rgb[rows[kept], columns[kept]]),
            confidence[kept].astype(np.float32), _unit(normal[kept]).astype(np.float32),
            fused[kept].astype(np.float32), update.spans_of(keyframe_id),
        )  # fmt: skip

    def _voxel(self, points: Array, place: Similarity, update: MapUpdate) -> float:
        """Voxel size in the units of the chunk."""
        if update.georeference is None:
            return 0.01 * float(np.median(points[:, 2]))
        return self._config.voxel_m / (update.georeference.world_from_map.scale * place.scale)

    def _agreement(
        self, points: Array, other_from_here: Similarity, other: _RecentMap, local_scale: float
    ) -> _Agreement:
        """Agreement of another map, its depths scaled by `local_scale`, with points (N, 3)."""
        row, column, z, inside = pixels_of(other_from_here.apply(points), other.map)
        seen = np.where(inside, other.map.depth[row, column], 0.0)
        difference: Array = local_scale * seen / z - 1.0
        agrees: Mask = (seen > 0) & (np.abs(difference) < self._config.agreement)
        row, column = row[agrees], column[agrees]
        return _Agreement(
            agrees, difference[agrees], other.map.sigma[row, column] / seen[agrees],
            other.normals[row, column] @ other_from_here.rotation,
        )  # fmt: skip


def points_of(depth_map: DepthMap, rows: Indices, columns: Indices) -> Array:
    """Points (N, 3) of pixels in the camera frame, map units."""
    fx, fy, cx, cy = depth_map.intrinsics
    z = depth_map.depth[rows, columns].astype(np.float64)
    return np.stack([(columns - cx) / fx * z, (rows - cy) / fy * z, z], 1)


def pixels_of(points: Array, depth_map: DepthMap) -> tuple[Indices, Indices, Array, Mask]:
    """Row, column and depth of points (N, 3) in the image of a map, and which are inside."""
    fx, fy, cx, cy = depth_map.intrinsics
    height, width = depth_map.depth.shape
    front = points[:, 2] > 1e-6
    z = np.where(front, points[:, 2], 1.0)
    u, v = np.rint(fx * points[:, 0] / z + cx), np.rint(fy * points[:, 1] / z + cy)
    inside = front & (u >= 0) & (v >= 0) & (u < width) & (v < height)
    row, column = (np.where(inside, x, 0).astype(np.int64) for x in (v, u))
    return row, column, z, inside


def chunk_alone(depth_map: DepthMap) -> PointChunk:
    """Converged pixels of a single map, without agreement."""
    known = measured_only(depth_map)
    rows, columns = np.nonzero(known.depth)
    return PointChunk(
        depth_map.keyframe_id, depth_map.t_ns,
        points_of(depth_map, rows, columns).astype(np.float32),
        np.ascontiguousarray(depth_map.rgb[rows, columns]), depth_map.inlier_ratio[rows, columns],
        normals(known.depth, known.intrinsics)[rows, columns], known.sigma[rows, columns],
    )  # fmt: skip


def measured_only(depth_map: DepthMap, max_sigma: float = np.inf) -> DepthMap:
    """The map without filled-in pixels and those of larger relative standard deviation."""
    known = depth_map.state == PixelState.CONVERGED.value
    if np.isfinite(max_sigma):
        known &= depth_map.sigma <= max_sigma * depth_map.depth
    nothing = np.float32(0)
    return replace(
        depth_map, depth=np.where(known, depth_map.depth, nothing),
        sigma=np.where(known, depth_map.sigma, nothing),
    )  # fmt: skip


def _local_scale(recent: _RecentMap, place: Similarity, update: MapUpdate) -> float:
    """Local scale correction of the depths by map points; by keyframe spans if too few."""
    depth_map = recent.map
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
    return update.local_scale_of(depth_map.keyframe_id, recent.spans) if ratio is None else ratio


def _unit(vectors: Array) -> Array:
    length = np.linalg.norm(vectors, axis=1)
    return np.asarray(vectors / np.where(length > 0, length, 1.0)[:, None])


def _smooth(depth: Floats) -> Mask:
    """Pixels with a neighbour on the same surface, and none on another."""
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
