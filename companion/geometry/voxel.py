"""Voxel-grid downsampling of point clouds."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from companion.geometry.transforms import Array


def voxel_downsample(
    points: NDArray[np.floating], confidence: NDArray[np.floating], voxel: float,
    low: Array | None = None,
) -> NDArray[np.int64]:  # fmt: skip
    """Indices, ascending, of the most confident point (N, 3) of each voxel of side `voxel`.

    The grid has a corner at `low` (3,), by default the lowest corner of the points. Ties resolve to
    the earlier point, so that the result is deterministic.
    """
    if len(points) == 0:
        return np.zeros(0, np.int64)
    corner = points.min(0) if low is None else low
    cell = np.floor((points.astype(np.float64) - corner) / voxel).astype(np.int64)
    cell -= cell.min(0)
    extent = cell.max(0) + 1
    key = (cell[:, 0] * extent[1] + cell[:, 1]) * extent[2] + cell[:, 2]
    order = np.lexsort((np.arange(len(key)), -confidence, key))
    first = np.r_[True, np.diff(key[order]) != 0]
    out: NDArray[np.int64] = np.sort(order[first])
    return out
