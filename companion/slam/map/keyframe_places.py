"""Poses and centres of a map's keyframes in arrays, which follow the few that move."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Protocol

import numpy as np

from companion.geometry.pose_table import PoseTable
from companion.geometry.transforms import Array, Pose
from companion.slam.features.orb_features import Bools, Ints

LEAST_ROWS = 64


class _Placed(Protocol):
    camera_from_map: Pose

    @property
    def centre(self) -> Array: ...


class KeyframePlaces:
    """Places of keyframes by row, in the order of the map; a removed one leaves a row behind."""

    def __init__(self) -> None:
        self._moved: set[int] | None = None
        """Added, moved or removed since; None: any."""
        self._row_of: dict[int, int] = {}
        self._n = 0
        self._ids: Ints = np.zeros(0, np.int64)
        self._rotations: Array = np.zeros((0, 3, 3))
        self._translations: Array = np.zeros((0, 3))
        self._centres: Array = np.zeros((0, 3))
        self._is_there: Bools = np.zeros(0, bool)

    def move(self, ids: Iterable[int] | None) -> None:
        """Look at some keyframes again before the next answer; None for all."""
        if ids is None:
            self._moved = None
        elif self._moved is not None:
            self._moved.update(ids)

    def nearest(
        self, keyframes: Mapping[int, _Placed], centre: Array, n: int, exclude: set[int]
    ) -> list[int]:
        """Ids of the `n` keyframes nearest to a position (3,), without those in `exclude`."""
        self._follow(keyframes)
        apart = np.linalg.norm(self._centres[: self._n] - centre, axis=1)
        apart[~self._is_there[: self._n]] = np.inf
        most = min(n + len(exclude), len(keyframes))
        near = np.arange(len(apart))
        if 0 < most < len(apart):
            near = np.flatnonzero(apart <= np.partition(apart, most - 1)[most - 1])
        near = near[np.argsort(apart[near], kind="stable")][:most]
        return [k for k in self._ids[near].tolist() if k not in exclude][:n]

    def centres(self, keyframes: Mapping[int, _Placed], first: int, last: int) -> Array:
        """Centres (K, 3) of those from one id to another, in order."""
        self._follow(keyframes)
        ids = self._ids[: self._n]
        return self._centres[: self._n][self._is_there[: self._n] & (ids >= first) & (ids <= last)]

    def poses(self, keyframes: Mapping[int, _Placed]) -> PoseTable:
        """`camera_from_map` of all, in order."""
        self._follow(keyframes)
        rows = np.flatnonzero(self._is_there[: self._n])
        return PoseTable(self._ids[rows], self._rotations[rows], self._translations[rows])

    def _follow(self, keyframes: Mapping[int, _Placed]) -> None:
        for key in sorted(self._moved or ()):
            self._put(key, keyframes.get(key))
        most_rows = 2 * len(keyframes) + LEAST_ROWS
        if self._moved is None or len(self._row_of) != len(keyframes) or self._n > most_rows:
            self._row_of, self._n = {}, 0
            self._is_there[:] = False
            for key, keyframe in keyframes.items():
                self._put(key, keyframe)
        self._moved = set()

    def _put(self, key: int, keyframe: _Placed | None) -> None:
        row = self._row_of.get(key)
        if keyframe is None:
            if row is not None:
                self._is_there[self._row_of.pop(key)] = False
            return
        if row is None:
            row = self._row_of[key] = self._n
            self._n += 1
            self._reserve(self._n)
        pose = keyframe.camera_from_map
        self._ids[row], self._is_there[row] = key, True
        self._rotations[row], self._translations[row] = pose.rotation, pose.translation
        self._centres[row] = keyframe.centre

    def _reserve(self, n: int) -> None:
        if n <= len(self._ids):
            return
        for name in ("_ids", "_rotations", "_translations", "_centres", "_is_there"):
            old = getattr(self, name)
            grown = np.zeros((max(LEAST_ROWS, 2 * len(old)), *old.shape[1:]), old.dtype)
            grown[: len(old)] = old
            setattr(self, name, grown)
