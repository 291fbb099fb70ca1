"""Voxel-grid downsampling of point clouds."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from companion.geometry.transforms import Array


def distinct_cells(cells: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Distinct cells (M, 2) of a grid, sorted, and which of them each of `cells` (N, 2) is, (N,).

    As `np.unique` along an axis, which sorts rows, but in a tenth of the time.

    >>> distinct_cells(np.array([[3, -1], [2, 5], [3, -1]]))[1]
    array([1, 0, 1])
    """
    if len(cells) == 0:
        return np.zeros((0, 2), np.int64), np.zeros(0, np.int64)
    low = cells.min(0)
    height, width = (
        int(high) - int(least) + 1 for high, least in zip(cells.max(0), low, strict=True)
    )
    if height * width >= 2**63:
        found, which = np.unique(cells, axis=0, return_inverse=True)
        return found, which.ravel()
    keys, which = np.unique(
        (cells[:, 0] - low[0]) * width + (cells[:, 1] - low[1]), return_inverse=True
    )
    return np.stack(np.divmod(keys, width), 1) + low, which.ravel()


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
    key, order = _sorted_keys(key)
    begins = np.flatnonzero(_is_first(key))
    in_order = confidence[order]
    most = np.maximum.reduceat(in_order, begins)
    best = np.flatnonzero(in_order == np.repeat(most, np.diff(begins, append=len(key))))
    out: NDArray[np.int64] = np.sort(order[best[_is_first(key[best])]])
    return out


def _sorted_keys(key: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Keys (N,), none negative, in ascending order, and their indices; equal ones in order.

    Where both fit into one number, that is sorted: in half the time of sorting indices.
    """
    n = len(key)
    if int(key.max()) < 2**63 // n - 1:
        both = np.sort(key * n + np.arange(n))
        return both // n, both % n
    order = np.argsort(key, kind="stable")
    return key[order], order


def _is_first(key: NDArray[np.int64]) -> NDArray[np.bool_]:
    """True for each first of equal neighbours."""
    out: NDArray[np.bool_] = np.r_[True, key[1:] != key[:-1]]
    return out
