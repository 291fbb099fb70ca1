"""Quality of a tracked frame, as it is stated to the autopilot, and whether it can be believed."""

from __future__ import annotations

import numpy as np

from companion.geometry.transforms import Array
from companion.messages import Track, TrackState

FULL_COUNT = 150
"""Inliers with which more do not make a pose better."""
GRID = 4
SURE_QUALITY = 50
"""Of a frame that has found the map again: half of FULL_COUNT all over the picture."""
HELD_NS = 2_000_000_000
"""A map that was found again by less, and is not lost again for so long, was found."""


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


class FoundAgain:
    """Judge of whether a map that was lost has been found again for certain.

    A few points at an edge of the picture are soon those of another window of the same facade: such
    frames were off by a metre, with some centimetres stated.
    """

    def __init__(self) -> None:
        self.certain = True
        self._segment, self._since_ns = -1, 0

    def see(self, track: Track, segment: int, quality: int) -> None:
        """Take a frame in the map of a segment, with its quality."""
        if track.state is not TrackState.TRACKING:
            self.certain = False
            self._since_ns = track.t_ns
        elif segment != self._segment or quality >= SURE_QUALITY:
            self.certain = True
        else:
            self.certain = self.certain or track.t_ns - self._since_ns > HELD_NS
        self._segment = segment
