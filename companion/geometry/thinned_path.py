"""Paths of few corners that stay near the path flown."""

from __future__ import annotations

import numpy as np

from companion.geometry.transforms import Array

WITHIN_M = 0.5
"""Distance from the path at which a place is left out: the error of a good pose, or less."""
STEP_M = 0.1
"""Places nearer to the one before say nothing that `WITHIN_M` keeps; a hover has no length."""
OPEN = 200
"""Places that are thinned together; with `KEPT` no more than the 700 waypoints that ArduPilot
keeps with its usual storage."""
KEPT = 500


def thinned(path_m: Array, within_m: float) -> Array:
    """Corners (M, 3) of a polyline that stays within a distance of a path (N, 3).

    Ramer 1972, Douglas and Peucker 1973; first and last place are kept.
    """
    kept = np.zeros(len(path_m), bool)
    kept[[0, -1]] = True
    spans = [(0, len(path_m) - 1)]
    while spans:
        first, last = spans.pop()
        if last - first < 2:
            continue
        away_m = _from_segment(path_m[first + 1 : last], path_m[first], path_m[last])
        furthest = int(away_m.argmax())
        if away_m[furthest] > within_m:
            middle = first + 1 + furthest
            kept[middle] = True
            spans += [(first, middle), (middle, last)]
    return np.asarray(path_m[kept])


def _from_segment(places: Array, a: Array, b: Array) -> Array:
    """Distances (N,) of places from the segment between two."""
    along = b - a
    share = np.clip((places - a) @ along / max(float(along @ along), 1e-12), 0.0, 1.0)
    return np.asarray(np.linalg.norm(places - a - share[:, None] * along, axis=1))


class ThinnedPath:
    """A path that is thinned as it is flown, in bounded memory, however long it gets.

    A path of too many corners is thinned again, more coarsely: `within_m` then says how near it
    stays.
    """

    def __init__(self, within_m: float = WITHIN_M) -> None:
        self.within_m = within_m
        """Greatest distance of a place that was added from `places`, beside `STEP_M`."""
        self._open_m = within_m
        self._kept: list[Array] = []
        self._open: list[Array] = []

    def add(self, place_m: Array) -> None:
        """Add the next place (3,)."""
        if self._open and float(np.linalg.norm(place_m - self._open[-1])) < STEP_M:
            return
        self._open.append(np.array(place_m, np.float64))
        if len(self._open) >= OPEN:
            self._kept += list(thinned(np.stack(self._open), self._open_m))[:-1]
            self._open = self._open[-1:]
        if len(self._kept) > KEPT:
            # half as many, so that it is long before it happens again
            coarser_m = self.within_m
            while len(self._kept) > KEPT // 2:
                self._kept = list(thinned(np.stack(self._kept), coarser_m))
                self.within_m += coarser_m
                coarser_m *= 2
            self._open_m = self.within_m

    def places(self) -> Array:
        """Corners (N, 3), from the first place to the newest; none, or two or more."""
        if len(self._kept) + len(self._open) < 2:
            return np.empty((0, 3))
        open_m = thinned(np.stack(self._open), self._open_m)
        return np.stack([*self._kept, *open_m])
