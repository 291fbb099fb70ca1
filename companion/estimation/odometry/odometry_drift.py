"""Drift of the smooth odometry over its last seconds."""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import numpy as np

from companion.geometry.transforms import Array

WINDOW_NS = 10_000_000_000
SIGMA_DRIFT = 0.005
"""Ratio of path length: drift of a map before adjustment."""

ALONG_ONE = float(np.sqrt(3.841 / 7.815))
"""A scale that is off shortens a straight way along one axis. Of chi-squares the bound of 95 % is
3.841 for one degree of freedom and 7.815 for three: stated so, it is that of three axes, too."""


class _PathPoint(NamedTuple):
    """Position, path length, and accumulated slew correction at a time."""

    t_ns: int
    position: Array
    path_length_m: float
    slewed: Array


class Drift(NamedTuple):
    """Standard deviations, m: by scale, by the map's drift, and by slew corrections.

    The last moved the pose but not the body.
    """

    by_scale_m: float
    by_map_m: float
    by_slew_m: float


class OdometryDrift:
    """Keeps the path of the last seconds."""

    def __init__(self) -> None:
        self._path: deque[_PathPoint] = deque()

    def clear(self) -> None:
        """Forget the path, after a jump."""
        self._path.clear()

    def add(self, t_ns: int, position: Array, sigma_scale: float, slewed: Array) -> Drift:
        """Add a position (3,), metres, with all corrections (3,) so far; the drift up to it.

        Standard deviations are along each axis.
        """
        path_length_m = 0.0
        if self._path:
            path_length_m = self._path[-1].path_length_m + float(
                np.linalg.norm(position - self._path[-1].position)
            )
        self._path.append(_PathPoint(t_ns, position, path_length_m, slewed))
        while self._path[0].t_ns < t_ns - WINDOW_NS:
            self._path.popleft()
        since = self._path[0]
        return Drift(
            ALONG_ONE * sigma_scale * float(np.linalg.norm(position - since.position)),
            SIGMA_DRIFT * (path_length_m - since.path_length_m),
            float(np.linalg.norm(slewed - since.slewed)) / np.sqrt(3.0),
        )
