"""Drift of the smooth odometry over its last seconds.

Each point of the map is as wrong as the poses that it was triangulated from. A pose by points that
were known before drifts no further; where all that is in view is new, it is off by what a pose was
off by when they were made. So drift is a random walk that takes a step, of the noise of an image,
each time that the view has been renewed. What else a pose is off by is the error of its points:
that is the walk itself, and no step of it.
"""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import numpy as np

from companion.geometry.transforms import Array
from companion.slam.features.orb_features import Ints

WINDOW_NS = 10_000_000_000
SIGMA_CALIBRATION = 0.001
"""Ratio of path length: what is wrong alike in all images, as a focal length known to a
thousandth."""

ALONG_ONE = float(np.sqrt(3.841 / 7.815))
"""A scale that is off shortens a straight way along one axis. Of chi-squares the bound of 95 % is
3.841 for one degree of freedom and 7.815 for three: stated so, it is that of three axes, too."""


class _PathPoint(NamedTuple):
    """Position, path length, variance of the walk, and accumulated slew correction at a time.

    `scaled_m` (3,) is the way so far, each part times the standard deviation of its scale then.
    """

    t_ns: int
    position: Array
    scaled_m: Array
    path_length_m: float
    walked_m2: float
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
        self._newest_born, self._new_share = -1, 1.0

    def clear(self) -> None:
        """Forget the path, after a jump."""
        self._path.clear()

    def see(self, born: Ints | None) -> None:
        """Tell known ground from new by the points in view of the frame that comes next.

        `born` (N,) are the ids of the keyframes at which they were made; None if unknown.
        """
        if born is None or not len(born):
            self._new_share = 1.0
            return
        self._new_share = float((born > self._newest_born).mean())
        self._newest_born = max(self._newest_born, int(born.max()))

    def carry(self, sigma_m: float) -> None:
        """Take the last position for uncertain by this on each axis, and what goes on from it.

        A map that takes over from dead reckoning does not know better where the body went before.
        """
        if self._path:
            last = self._path[-1]
            self._path[-1] = last._replace(walked_m2=last.walked_m2 + sigma_m**2)

    def add(
        self, t_ns: int, position: Array, sigma_scale: float, slewed: Array, noise_m: float = 0.0
    ) -> Drift:
        """Add a position (3,), metres, with all corrections (3,) so far; the drift up to it.

        `noise_m` is that of its image alone, 0 where it comes of none. Standard deviations are
        along each axis.
        """
        scaled_m, path_length_m, walked_m2 = np.zeros(3), 0.0, 0.0
        if self._path:
            last = self._path[-1]
            moved_m = position - last.position
            scaled_m = last.scaled_m + sigma_scale * moved_m
            path_length_m = last.path_length_m + float(np.linalg.norm(moved_m))
            walked_m2 = last.walked_m2 + self._new_share * noise_m**2
        self._path.append(_PathPoint(t_ns, position, scaled_m, path_length_m, walked_m2, slewed))
        while self._path[0].t_ns < t_ns - WINDOW_NS:
            self._path.popleft()
        since = self._path[0]
        calibration_m = SIGMA_CALIBRATION * (path_length_m - since.path_length_m)
        return Drift(
            ALONG_ONE * float(np.linalg.norm(scaled_m - since.scaled_m)),
            float(np.hypot(np.sqrt(max(walked_m2 - since.walked_m2, 0.0)), calibration_m)),
            float(np.linalg.norm(slewed - since.slewed)) / np.sqrt(3.0),
        )
