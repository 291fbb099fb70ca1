"""Incremental voxel filter: points that are thinned out take no memory."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from companion.geometry.transforms import Array
from companion.geometry.voxel import distinct_cells, voxel_downsample
from companion.messages import Floats
from companion.products.cloud import Cloud, joined, no_cloud

TILE_VOXELS = 256
"""Side of a tile, north and east, in voxels; each tile is filtered by itself."""
LEAST_WAITING = 20_000
"""Points that wait in a tile before it is filtered, or half as many as it has."""


Tile = tuple[int, int]


def tiles_of(points: Floats, low: Array, voxel: float) -> tuple[list[Tile], NDArray[np.int64]]:
    """Tiles that points (N, 3) lie in, sorted, and the index of each point's tile (N,)."""
    side = voxel * TILE_VOXELS
    tiles = np.floor((points[:, :2].astype(np.float64) - low[:2]) / side).astype(np.int64)
    found, which = distinct_cells(tiles)
    return [(int(i), int(j)) for i, j in found], which


class VoxelCloud:
    """One point per voxel of side `voxel`: the most confident, else the earliest.

    The voxel grid begins at `low` (3,), by default the lowest corner of the first points. With
    `only`, points of other tiles are ignored.
    """

    def __init__(
        self, voxel: float, low: Array | None = None, only: set[Tile] | None = None
    ) -> None:
        self._voxel = voxel
        self._low = low
        self._only = only
        self._tiles: dict[Tile, list[Cloud]] = {}

    def add(self, cloud: Cloud) -> None:
        """Add points."""
        if len(cloud) == 0:
            return
        if self._low is None:
            self._low = cloud.points.astype(np.float64).min(0)
        found, which = tiles_of(cloud.points, self._low, self._voxel)
        order = np.argsort(which, kind="stable")
        ends = np.cumsum(np.bincount(which, minlength=len(found)))
        for tile, part in zip(found, np.split(order, ends[:-1]), strict=True):
            if self._only is not None and tile not in self._only:
                continue
            waiting = self._tiles.setdefault(tile, [no_cloud()])
            waiting.append(cloud.part(part))
            if sum(map(len, waiting[1:])) > max(LEAST_WAITING, len(waiting[0]) // 2):
                waiting[:] = [self._thinned(waiting)]

    def finished(self) -> Iterator[Cloud]:
        """The cloud, tile by tile in order; the filter is empty afterwards."""
        for tile in sorted(self._tiles):
            yield self._thinned(self._tiles.pop(tile))

    def _thinned(self, parts: list[Cloud]) -> Cloud:
        together = joined(parts)
        kept = voxel_downsample(together.points, together.confidence, self._voxel, self._low)
        return together.part(kept)
