"""Space around the vehicle in cells: free, occupied, or unknown.

A ring buffer of voxels (Usenko et al. 2017, "Real-time trajectory replanning for MAVs using uniform
B-splines and a 3D circular buffer") with clamped log-odds (Hornung et al. 2013, "OctoMap"), which
fade: what has not been seen for long is unknown.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from companion.geometry.transforms import Array, Similarity

Ints = NDArray[np.int64]
Levels = NDArray[np.int8]

CELL_M = 0.25
"""Side of a cell: a thing of 0.65 m hides a whole one 8 m away wherever it stands, though by its
edges corners of what is behind are followed, half a window or 7 cm into it."""
SHAPE = np.array([160, 160, 64])
"""Cells north, east and down: `MAX_M` to each side, 8 m up and down; 1.6 MB whatever flies."""
CLEAR_M, ASIDE_M = 16.0, 3.0
"""Length of a ray that frees cells, and height above and below its eye: where the vehicle may be
before they fade, and `FREE_M` from there."""
FADES_NS = 500_000_000
"""Time in which each cell comes one nearer to unknown."""
DOUBT, MOST = 4, 30
"""Of a cell in which something was measured: what nothing else confirms is no obstacle, but not
free either. An obstacle stays for 13 s where depth has seen it, unless it is seen through since."""
FREE, LEAST = -2, -6
"""Of a cell that an image sees through, and at least: it is free for 0.5 to 2.5 s."""


class OccupancyGrid:
    """Cells of a world that the map's corrections move."""

    def __init__(self) -> None:
        self._levels: Levels = np.zeros(tuple(SHAPE), np.int8)
        self._flat = self._levels.reshape(-1)
        self._first: Ints = np.zeros(3, np.int64)
        """Least of the cells that are kept."""
        self._shift_m: Array = np.zeros(3)
        """From the world to the place of cells."""
        self._faded = 0

    def correct(self, place_m: Array, now_from_before: Similarity) -> bool:
        """Let cells move as the map did, at a place (3,); False if it turned or stretched them."""
        about = place_m + 8.0 * np.concatenate([np.zeros((1, 3)), np.eye(3)])
        moved = now_from_before.apply(about) - about
        self._shift_m = self._shift_m - moved[0]
        return bool(np.abs(moved - moved[0]).max() <= CELL_M)

    def move(self, place_m: Array, t_ns: int) -> None:
        """Keep what is about a place (3,) at a time."""
        first = self._cells(place_m) - SHAPE // 2
        for axis, (now, last, n) in enumerate(zip(first, self._first, SHAPE, strict=True)):
            least = min(now, last)
            entered = np.arange(least, min(max(now, last), least + n)) % n
            np.moveaxis(self._levels, axis, 0)[entered] = 0
        self._first = first
        steps = np.int8(np.clip(t_ns // FADES_NS - self._faded, 0, MOST))
        self._faded = t_ns // FADES_NS
        if steps:
            self._levels -= np.clip(self._levels, -steps, steps)

    def see_through(self, eye_m: Array, ends_m: Array) -> None:
        """Take rays of an image, from an eye (3,), that meet nothing up to ends (N, 3)."""
        passed = self._passed(eye_m, ends_m)
        # however many go through a cell, it was what it was, and is less by one image
        self._flat[passed] = np.maximum(self._flat[passed] + FREE, LEAST)

    def hit(self, points_m: Array) -> None:
        """Take points (N, 3) of a depth map: there something stands."""
        self._flat[self._slots(points_m)] = MOST

    def doubt(self, points_m: Array) -> None:
        """Take points (N, 3) that nothing else confirms: there it is not free."""
        slots = self._slots(points_m)
        self._flat[slots] = np.maximum(self._flat[slots], DOUBT)

    def occupied(self) -> Array:
        """Middles (N, 3) of occupied cells."""
        which = np.flatnonzero(self._flat > DOUBT)
        cells = np.stack(np.unravel_index(which, self._levels.shape), 1)
        cells = self._first + (cells - self._first) % SHAPE
        return np.asarray((cells + 0.5) * CELL_M - self._shift_m)

    def about(self, place_m: Array, reach_m: Array) -> tuple[Levels, list[Array]]:
        """Levels (X, Y, Z) of cells, from one corner to the other (2, 3) about a place.

        With where on each axis their middles are, from it.
        """
        least, most = self._cells(place_m + reach_m)
        cells = [np.arange(a, b + 1) for a, b in zip(least, most, strict=True)]
        slots = np.ix_(*(each % n for each, n in zip(cells, SHAPE, strict=True)))
        middles = zip(cells, place_m + self._shift_m, strict=True)
        return self._levels[slots], [(each + 0.5) * CELL_M - at for each, at in middles]

    def _cells(self, points_m: Array) -> Ints:
        return np.floor((points_m + self._shift_m) / CELL_M).astype(np.int64)

    def _slots(self, points_m: Array) -> Ints:
        """Places in the buffer of the cells of those points (N, 3) that lie in it."""
        cells = self._cells(points_m)
        kept = ((cells >= self._first) & (cells < self._first + SHAPE)).all(1)
        return np.asarray(
            np.ravel_multi_index(tuple(cells[kept].T), self._levels.shape, mode="wrap")
        )

    def _passed(self, eye_m: Array, ends_m: Array) -> NDArray[np.int32]:
        """Places in the buffer of the cells that rays go through, in steps of one; some twice."""
        rays = ends_m - eye_m
        length_m = np.linalg.norm(rays, axis=1)
        unit = rays / np.maximum(length_m, 1e-9)[:, None]
        aside_m = ASIDE_M / np.maximum(np.abs(unit[:, 2]), 1e-9)
        n = (np.minimum(np.minimum(length_m, CLEAR_M), aside_m) / CELL_M).astype(np.int64)
        which = np.repeat(np.arange(len(n)), n)
        step = (np.arange(len(which)) - np.repeat(np.cumsum(n) - n, n)).astype(np.float32)
        eye = (eye_m + self._shift_m) / CELL_M - self._first
        slots = np.zeros(len(which), np.int32)
        for axis, (n_cells, stride) in enumerate(zip(SHAPE, self._levels.strides, strict=True)):
            slot_of = stride * ((self._first[axis] + np.arange(n_cells)) % n_cells)
            at = unit[:, axis].astype(np.float32)[which] * step + np.float32(eye[axis])
            slots += slot_of.astype(np.int32).take(at.astype(np.int32), mode="clip")
        return slots
