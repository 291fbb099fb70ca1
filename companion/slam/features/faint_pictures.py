"""Strengthening of faint pictures, in which noise drowns what the scene shows.

At dusk and in haze the differences of the scene are a few grey levels: less than the thresholds of
corners and patches, and rounded away where pictures are smoothed in whole grey levels. Detail of
the sizes that survive the noise is cut out by a difference of Gaussians (Marr & Hildreth 1980), in
floating point, and spread over the range of grey levels.
"""

from __future__ import annotations

import cv2
import numpy as np

from companion.messages import Bytes

FAINT_SPREAD = 6.0
"""Standard deviation of a picture, grey levels, below which it is faint: half of the least that is
usual in daylight, and a quarter of the common."""
FINE_PX = 2.0
"""Standard deviation of the smoothing: it leaves a seventh of the noise of a pixel."""
BROAD_PX = 25.0
"""Of what is taken away: shades wider than this would use up the range."""
SHRINK = 8
"""The broad part is made of a picture smaller by this."""
SPREAD = 20.0
"""Standard deviation of what comes out, grey levels: about that of a picture in daylight, and far
enough from black and white that next to nothing is cut off."""
MAX_GAIN = 30.0
"""Reached where the detail is two thirds of a grey level, of which a camera's noise (1.5 grey
levels leave 0.2) is a third; from there on down what comes out fades as the picture does. A sudden
end would leave the map without its corners from one frame to the next."""

DROWNED_SPREAD = 0.75 * SPREAD
"""Standard deviation of what comes out where the detail is half a grey level: with the noise of a
camera, near half of it."""


def strengthened(grey: Bytes) -> Bytes:
    """Picture (H, W) with the contrast of daylight where it is faint; else `grey` itself."""
    if float(cv2.meanStdDev(grey)[1][0, 0]) >= FAINT_SPREAD:
        return grey
    height, width = grey.shape
    fine = cv2.GaussianBlur(grey.astype(np.float32), (0, 0), FINE_PX)
    small = (max(1, width // SHRINK), max(1, height // SHRINK))
    broad = cv2.GaussianBlur(
        cv2.resize(fine, small, interpolation=cv2.INTER_AREA), (0, 0), BROAD_PX / SHRINK
    )
    detail = fine - cv2.resize(broad, (width, height), interpolation=cv2.INTER_LINEAR)
    gain = min(SPREAD / max(float(detail.std()), 1e-6), MAX_GAIN)
    return np.asarray(np.clip(np.rint(gain * detail + 128.0), 0, 255), np.uint8)


def is_drowned(strong: Bytes) -> bool:
    """Verdict on a strengthened picture (H, W): of so little detail that near half is noise."""
    return float(cv2.meanStdDev(strong)[1][0, 0]) < DROWNED_SPREAD
