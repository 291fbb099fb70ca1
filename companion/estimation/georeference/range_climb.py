"""Scale from a climb over one spot, by rangefinder: needs no mapped ground below.

A camera pitched 30 or 45 degrees down maps the ground ahead, so that after a take-off straight up
nothing is known of what the rangefinder measures. But the range grows as the height does, whatever
is below, as long as the way is steep.
"""

from __future__ import annotations

import numpy as np

from companion.estimation.georeference.trajectory_alignment import Scale
from companion.geometry.transforms import Array

MAX_PLAN_RATIO = 0.25
"""Level way over change of height: two views of a slope of 8 % then differ by 2 %."""
MIN_CLIMB_M, MIN_RANGE_M = 1.0, 0.5
"""The first for noise of some centimetres; nearer to the ground rangefinders are at their limit."""
SIGMA_RANGE_M = 0.04
"""Noise of a lidar or sonar, and the time between a range and its frame at 1 m/s."""
SIGMA_CLIMB_SCALE = 0.02
"""Lower bound of the relative scale error: the slope above."""
MIN_PAIRS = 6
MOST_VIEWS = 80


def climb_scale(places_map: Array, heights_m: Array) -> Scale | None:
    """Scale by camera places (N, 3) in a level map, down last, and ranges to below (N,), metres.

    The ranges are vertical. None without a climb, or where pairs of views disagree.
    """
    near = heights_m >= MIN_RANGE_M
    places_map, heights_m = places_map[near], heights_m[near]
    if len(heights_m) < 2:
        return None
    chosen = np.unique(np.linspace(0, len(heights_m) - 1, MOST_VIEWS).astype(int))
    places_map, heights_m = places_map[chosen], heights_m[chosen]
    a, b = np.triu_indices(len(heights_m), 1)
    way = places_map[b] - places_map[a]
    climb_m, climb = heights_m[b] - heights_m[a], -way[:, 2]
    level = np.linalg.norm(way[:, :2], axis=1)
    steep = (np.abs(climb_m) > MIN_CLIMB_M) & (level < MAX_PLAN_RATIO * np.abs(climb))
    if np.count_nonzero(steep) < MIN_PAIRS:
        return None
    climb_m, climb = climb_m[steep], climb[steep]
    ratios = climb_m / climb
    scale = float(np.median(ratios))
    if scale <= 0:
        return None
    spread = 1.4826 * float(np.median(np.abs(ratios - scale))) / scale
    sigma = float(np.hypot(max(spread, SIGMA_CLIMB_SCALE), SIGMA_RANGE_M / np.abs(climb_m).max()))
    return Scale(scale, sigma, "rangefinder on a climb", len(heights_m))
