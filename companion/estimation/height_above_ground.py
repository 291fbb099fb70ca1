"""Distance from the body down its own axis to the mapped ground, whichever keyframe showed that.

A camera that looks 30 or 45 degrees down never sees what is under the body, but it saw it on the
way there. A rangefinder measures the same distance in metres, which gives the map its scale.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from companion.geometry.transforms import Array

BEAM_SHARE = np.tan(np.radians(8.0))
"""Radius of what counts as under the body, as a share of the distance: between the beam of a lidar
(1 degree from its axis) and that of a sonar (15)."""
QUANTILES, MAX_SPREAD_SHARE = (0.15, 0.85), 0.15
"""Where distances are spread by more, a wall, an edge or a crown of leaves is below: at an edge a
fifth of the points are on what is higher, of which the cone holds the narrower part."""
MIN_POINTS, NEAREST = 5, 32
MIN_DOWN_COSINE = 0.5
"""A body that leans by more points its rangefinder elsewhere."""
MOST_POINTS = 60_000
"""Of a larger map every second, third, ... point is enough."""
ITERATIONS = 3


class GroundBelow:
    """Points of a map, found by where they are in plan view."""

    def __init__(self, points_map: Array, down_map: Array) -> None:
        """Take points (N, 3) and the map's vertical (3,), of length one."""
        step = max(1, -(-len(points_map) // MOST_POINTS))
        self._points, self._down = points_map[::step], down_map
        self._plan = np.linalg.svd(down_map[None])[2][1:].T
        """(3, 2): two directions square to the vertical"""
        self._tree = cKDTree(self._points @ self._plan) if len(self._points) else None

    def distance(self, origin_map: Array, beam_map: Array) -> float | None:
        """How far the ground is from a place (3,) along a direction (3,) of length one.

        In map units; None where too little is mapped there, or where it is no one surface.
        """
        steep = float(beam_map @ self._down)
        if self._tree is None or steep < MIN_DOWN_COSINE:
            return None
        here = origin_map @ self._plan
        _, near = self._tree.query(here, k=min(NEAREST, len(self._points)))
        below = (self._points[np.atleast_1d(near)] - origin_map) @ self._down
        if not (below > 0).any():
            return None
        along = float(np.median(below[below > 0])) / steep
        for _ in range(ITERATIONS):
            foot = here + along * (beam_map @ self._plan)
            # a beam that leans meets a wider ellipse
            some = self._tree.query_ball_point(
                foot, BEAM_SHARE * along / steep, return_sorted=True
            )
            way = self._points[some] - origin_map
            ranges = way @ beam_map
            aside = np.linalg.norm(way - ranges[:, None] * beam_map, axis=1)
            ranges = ranges[(ranges > 0) & (aside < BEAM_SHARE * ranges)]
            if len(ranges) < MIN_POINTS:
                return None
            along = float(np.median(ranges))
        low, high = np.quantile(ranges, QUANTILES)
        return along if high - low < MAX_SPREAD_SHARE * along else None
