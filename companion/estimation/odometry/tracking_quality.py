"""Quality of a tracked frame, as it is stated to the autopilot."""

from __future__ import annotations

import numpy as np

from companion.geometry.transforms import Array
from companion.messages import Track

FULL_COUNT = 150
"""Inliers with which more do not make a pose better."""
GRID = 4


def quality_of(track: Track, size_px: Array) -> int:
    """1..100, from the number, image coverage and match ratio of inliers.

    Points that are new in this very frame say nothing of its pose and do not count. `size_px` (2,)
    is the width and height of the image.
    """
    if track.keypoints_px is None or not len(track.keypoints_px):
        return 1
    cells = np.clip((track.keypoints_px / size_px * GRID).astype(int), 0, GRID - 1)
    spread = len(np.unique(cells @ [1, GRID])) / GRID**2
    n_inliers = min(track.n_inliers, track.n_matches)
    count = min(1.0, n_inliers / FULL_COUNT)
    found = n_inliers / max(track.n_matches, 1)
    return int(np.clip(round(100 * count * np.sqrt(spread) * np.sqrt(found)), 1, 100))
