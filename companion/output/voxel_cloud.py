"""A cloud that is thinned while it grows, so that what is thinned out takes no room."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from companion.geometry import Array
from companion.output.cloud import Cloud, joined, no_cloud
from companion.voxel import thin_by_voxel

TILE_VOXELS = 256
"""Side of a tile, north and east: each is thinned by itself."""
LEAST_WAITING = 20_000
"""Points that wait in a tile before it is thinned, or half as many as it has."""


class VoxelCloud:
    """One point for each cube of side `voxel`, the most confident, else the earliest.

    The cubes begin at the lowest corner of what is added first.
    """

    def __init__(self, voxel: float) -> None:
        self._voxel = voxel
        self._low: Array | None = None
        self._tiles: dict[tuple[int, int], list[Cloud]] = {}

    def add(self, cloud: Cloud) -> None:
        """Take more points."""
        if len(cloud) == 0:
            return
        points = cloud.points.astype(np.float64)
        if self._low is None:
            self._low = points.min(0)
        side = self._voxel * TILE_VOXELS
        tiles = np.floor((points[:, :2] - self._low[:2]) / side).astype(np.int64)
        found, which = np.unique(tiles, axis=0, return_inverse=True)
        order = np.argsort(which, kind="stable")
        ends = np.cumsum(np.bincount(which.ravel(), minlength=len(found)))
        for (i, j), part in zip(found, np.split(order.ravel(), ends[:-1]), strict=True):
            waiting = self._tiles.setdefault((int(i), int(j)), [no_cloud()])
            waiting.append(cloud.part(part))
            if sum(map(len, waiting[1:])) > max(LEAST_WAITING, len(waiting[0]) // 2):
                waiting[:] = [self._thinned(waiting)]

    def finish(self) -> Cloud:
        """All of it, tile by tile; nothing is left here."""
        arrays: dict[str, list[NDArray[Any]]] = {f.name: [] for f in fields(Cloud)}
        for tile in sorted(self._tiles):
            thinned = self._thinned(self._tiles.pop(tile))
            for name, parts in arrays.items():
                parts.append(getattr(thinned, name))
        if not arrays["points"]:
            return no_cloud()
        # each kind by itself, so that not all of it is there twice
        return Cloud(**{name: np.concatenate(arrays.pop(name)) for name in list(arrays)})

    def _thinned(self, parts: list[Cloud]) -> Cloud:
        together = joined(parts)
        kept = thin_by_voxel(together.points, together.confidence, self._voxel, self._low)
        return together.part(kept)
