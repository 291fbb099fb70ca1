"""Sky: plain, bright, up to the upper edge of the picture, over what is far away.

It has no corners that could be measured. What stands before it shows by its edges, and is no sky.
Not told from it is a smooth sheet, as bright as it, that hangs into the picture from above over
twenty degrees of it, and whose lower edge is straight.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from companion.geometry.camera import Camera
from companion.geometry.transforms import Array, Pose
from companion.messages import Bytes

COARSE = 4
"""Pixels along each side that are looked at as one: noise is a quarter there."""
PLAIN_GREYS = 6
"""Most by which neighbours differ there; a wire that is a pixel wide makes more."""
MIN_WIDTH_RAD = np.radians(20.0)
UPRIGHT = 0.7
"""Least cosine between the picture's vertical and the world's."""
Mask = NDArray[np.bool_]


def sky_rays(
    grey: Bytes, camera: Camera, world_from_camera: Pose, far_px: Array, near_px: Array,
    near_by_rad: float,
) -> Array:  # fmt: skip
    """Rays (N, 3) in world axes, of z 1 in the camera, through the sky of an image (H, W).

    Of each column it is what is plain from above on, and ends no farther than `near_by_rad` from
    pixels (K, 2) of something far, and farther than that from those of anything near.
    """
    upright = world_from_camera.rotation[2, 1]
    if abs(upright) < UPRIGHT or len(far_px) == 0:
        return np.zeros((0, 3))
    height, width = grey.shape[0] // COARSE, grey.shape[1] // COARSE
    small = cv2.resize(grey, (width, height), interpolation=cv2.INTER_AREA)
    around = np.ones((3, 3), np.uint8)
    plain = cv2.dilate(small, around) - cv2.erode(small, around) <= PLAIN_GREYS
    reach = int(np.ceil(near_by_rad * camera.fx / COARSE))
    good = _about(far_px, small.shape, reach) & ~_about(near_px, small.shape, reach)
    order = slice(None) if upright > 0 else slice(None, None, -1)  # rows from above
    above = np.logical_and.accumulate(plain[order], axis=0)
    n_rows = above.sum(0)
    ends_far = good[order][np.minimum(n_rows, height - 1), np.arange(width)] & (n_rows < height)
    found = np.zeros(small.shape, bool)
    least = camera.fx * MIN_WIDTH_RAD / COARSE
    _, which, stats, _ = cv2.connectedComponentsWithStats(above.astype(np.uint8), connectivity=4)
    rest = small[order][~above]
    for each in np.flatnonzero(stats[1:, cv2.CC_STAT_WIDTH] >= least) + 1:
        inside = which == each
        if len(rest) and small[order][inside].mean() >= rest.mean():
            found |= inside & ends_far
    v, u = np.nonzero(found[order][::2, ::2])
    pixels = 2.0 * COARSE * np.stack([u, v], 1) + 0.5 * (COARSE - 1)
    rays = np.c_[camera.normalise(pixels), np.ones(len(pixels))]
    rays = rays[np.isfinite(rays).all(1)]
    return np.asarray(rays @ world_from_camera.rotation.T)


def _about(pixels: Array, shape: tuple[int, ...], reach: int) -> Mask:
    """Mask of the coarse pixels that are no farther than `reach` from one of pixels (K, 2)."""
    at = np.zeros(shape, np.uint8)
    column, row = (pixels // COARSE).astype(np.int64).T
    inside = (column >= 0) & (column < shape[1]) & (row >= 0) & (row < shape[0])
    at[row[inside], column[inside]] = 1
    return np.asarray(cv2.dilate(at, np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)) > 0)
