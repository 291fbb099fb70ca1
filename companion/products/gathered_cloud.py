"""Voxel filter for many parts, a few tiles at a time: little more memory than the result."""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from dataclasses import fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from companion.geometry.transforms import Array
from companion.products.cloud import Cloud, no_cloud
from companion.products.voxel_cloud import Tile, VoxelCloud, tiles_of

AT_ONCE = 2_000_000
"""Points, before voxel filtering, of the tiles of one round."""
GROWTH = 1.125


def gathered(
    parts: Sequence[Callable[[], Cloud]], n_points: int, voxel: float
) -> Generator[float, None, Cloud]:
    """One point per voxel of all parts; yields progress, 0 to 1.

    A part is loaded once for each round in which it has points, and once more to find these rounds.
    A cloud of `AT_ONCE` of `n_points` takes one round.
    """
    low: Array | None = None
    touched: list[set[Tile]] = [set() for _ in parts]
    rounds: list[set[Tile] | None] = [None]
    if n_points > AT_ONCE:
        counts: dict[Tile, int] = {}
        for n, part in enumerate(parts):
            points = part().points
            if len(points):
                low = points.astype(np.float64).min(0) if low is None else low
                found, which = tiles_of(points, low, voxel)
                for tile, count in zip(found, np.bincount(which), strict=True):
                    counts[tile] = counts.get(tile, 0) + int(count)
                    touched[n].add(tile)
            yield 0.5 * (n + 1) / len(parts)
        rounds = list(_rounds(counts))
    begun = 0.5 if n_points > AT_ONCE else 0.0
    whole = _Growing()
    for number, tiles in enumerate(rounds):
        thinned = VoxelCloud(voxel, low, tiles)
        for n, part in enumerate(parts):
            if tiles is None or touched[n] & tiles:
                thinned.add(part())
                done = (number + (n + 1) / len(parts)) / len(rounds)
                yield begun + (1.0 - begun) * done
        for tile_cloud in thinned.finished():
            whole.append(tile_cloud)
    return whole.finish()


def _rounds(counts: dict[Tile, int]) -> Generator[set[Tile], None, None]:
    """Tiles in order, grouped by what fits into memory."""
    together: set[Tile] = set()
    n = 0
    for tile in sorted(counts):
        if together and n + counts[tile] > AT_ONCE:
            yield together
            together, n = set(), 0
        together.add(tile)
        n += counts[tile]
    if together:
        yield together


class _Growing:
    """Arrays that grow in place, so that they never exist twice."""

    def __init__(self) -> None:
        self._arrays: dict[str, NDArray[Any]] = {
            f.name: getattr(no_cloud(), f.name).copy() for f in fields(Cloud)
        }
        self._n = 0

    def append(self, cloud: Cloud) -> None:
        n = self._n + len(cloud)
        for name, array in self._arrays.items():
            if n > len(array):
                array.resize((int(GROWTH * n), *array.shape[1:]), refcheck=False)
            array[self._n : n] = getattr(cloud, name)
        self._n = n

    def finish(self) -> Cloud:
        for array in self._arrays.values():
            array.resize((self._n, *array.shape[1:]), refcheck=False)
        return Cloud(**self._arrays)
