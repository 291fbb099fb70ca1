"""Distance from the body down its own axis to the mapped ground.

A camera pitched 30 or 45 degrees down never sees the ground below, but has mapped it before. A
rangefinder measures the same distance in metres, which determines the scale of the map.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from companion.geometry.transforms import Array

BEAM_RATIO = np.tan(np.radians(8.0))
"""Radius of the beam as a ratio of the distance: between those of a lidar (half angle 1 degree) and
a sonar (15)."""
QUANTILES, MAX_SPREAD_RATIO = (0.15, 0.85), 0.15
"""Larger spreads indicate a wall, an edge or foliage below: at an edge a fifth of the points are on
the upper surface, which the cone covers less."""
MIN_POINTS, N_NEAREST = 5, 32
MIN_DOWN_COSINE = 0.5
"""At larger tilts the rangefinder measures elsewhere."""
MOST_POINTS = 60_000
"""Larger maps are subsampled."""
ITERATIONS = 3


class HeightAboveGround:
    """Map points indexed in plan view."""

    def __init__(self, points_map: Array, down_map: Array) -> None:
        """Take points (N, 3) and the unit vertical (3,) of the map."""
        step = max(1, -(-len(points_map) // MOST_POINTS))
        self._points, self._down = points_map[::step], down_map
        self._plan = np.linalg.svd(down_map[None])[2][1:].T
        """Two directions (3, 2) perpendicular to the vertical."""
        self._tree = cKDTree(self._points @ self._plan) if len(self._points) else None

    def distance(self, origin_map: Array, beam_map: Array) -> float | None:
        """Distance to the ground from a position (3,) along a unit direction (3,), map units.

        None where too little is mapped, or where it is not a single surface.
        """
        steep = float(beam_map @ self._down)
        if self._tree is None or steep < MIN_DOWN_COSINE:
            return None
        here = origin_map @ self._plan
        _, near = self._tree.query(here, k=min(N_NEAREST, len(self._points)))
        below = (self._points[np.atleast_1d(near)] - origin_map) @ self._down
        if not (below > 0).any():
            return None
        distance = float(np.median(below[below > 0])) / steep
        for _ in range(ITERATIONS):
            foot = here + distance * (beam_map @ self._plan)
            # a tilted beam has an elliptical footprint
            in_beam = self._tree.query_ball_point(
                foot, BEAM_RATIO * distance / steep, return_sorted=True
            )
            offset = self._points[in_beam] - origin_map
            ranges = offset @ beam_map
            off_axis = np.linalg.norm(offset - ranges[:, None] * beam_map, axis=1)
            ranges = ranges[(ranges > 0) & (off_axis < BEAM_RATIO * ranges)]
            if len(ranges) < MIN_POINTS:
                return None
            distance = float(np.median(ranges))
        low, high = np.quantile(ranges, QUANTILES)
        return distance if high - low < MAX_SPREAD_RATIO * distance else None
