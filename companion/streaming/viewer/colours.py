"""Colour modes of the cloud: image colour, height, or confidence."""

from __future__ import annotations

from enum import Enum

import cv2
import numpy as np

from companion.geometry.transforms import Similarity
from companion.messages import Bytes, Floats

HEIGHT_PERIOD_M = 20.0
"""Period of the colours by height, so that no range need be known."""


class Colours(Enum):
    """Colour modes."""

    PICTURE = "picture"
    HEIGHT = "height"
    CONFIDENCE = "confidence"

    def of(
        self, points_camera: Floats, rgb: Bytes, confidence: Floats, place: Similarity | None
    ) -> Bytes:
        """Colours (N, 3) of points; image colours where no height is known yet.

        `place` is the world from the points' frame.
        """
        if self is Colours.CONFIDENCE:
            return _coloured(confidence, cv2.COLORMAP_VIRIDIS)
        if self is Colours.HEIGHT and place is not None:
            up_m = -place.apply(points_camera.astype(np.float64))[:, 2]
            phase = np.mod(up_m / HEIGHT_PERIOD_M, 2.0)
            return _coloured(1.0 - np.abs(phase - 1.0), cv2.COLORMAP_TURBO)
        return rgb


def _coloured(level: np.ndarray, palette: int) -> Bytes:
    grey = np.clip(level * 255, 0, 255).astype(np.uint8).reshape(-1, 1)
    if len(grey) == 0:
        return np.zeros((0, 3), np.uint8)
    out: Bytes = np.ascontiguousarray(cv2.applyColorMap(grey, palette).reshape(-1, 3)[:, ::-1])
    return out
