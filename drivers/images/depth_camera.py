"""Depths of a depth camera, at the corners of the colour picture that it is registered to."""

from __future__ import annotations

import numpy as np

from companion.messages import Bytes, Floats
from drivers.images.stereo_pair import Depths, corners_of

SIGMA_AT_1_M = 1.425e-3
"""Grows with the square of the depth (Khoshelham and Elberink 2012, of the first Kinect)."""
MAX_SPREAD_RATIO = 0.05
"""Of the 3 x 3 depths about a corner: beyond it lies on an edge, and could be either side's."""


def depths_at_corners(grey: Bytes, depth_m: Floats) -> Depths:
    """Depths at corners of a picture (H, W) by a depth image (H, W) in metres, 0 where unknown."""
    height, width = depth_m.shape
    at = corners_of(grey)
    column, row = np.rint(at).astype(int).T
    inside = (column > 0) & (row > 0) & (column < width - 1) & (row < height - 1)
    at, column, row = at[inside], column[inside], row[inside]
    step = np.arange(-1, 2)
    about = depth_m[row[:, None, None] + step[:, None], column[:, None, None] + step]
    about = about.reshape(-1, 9).astype(np.float64)
    ok = (about.min(1) > 0) & (np.ptp(about, axis=1) < MAX_SPREAD_RATIO * about.min(1))
    found = np.median(about[ok], axis=1)
    return Depths(at[ok].astype(np.float64), found, SIGMA_AT_1_M * found**2, float("nan"))
