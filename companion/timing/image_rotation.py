"""Camera rotation between successive images, for the alignment of clocks."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from companion.geometry.camera import Camera
from companion.geometry.transforms import (
    Array,
    nearest_rotation,
    rotation_from_vector,
    vector_from_rotation,
)
from companion.messages import Bytes, Frame

WIDTH = 320
"""Images are reduced to this width."""
MAX_CORNERS, MIN_CORNERS = 200, 15
ROUNDS = 8
CAUCHY_PX = 0.5
MAX_ROTATION_RAD = 0.5


class RotationMeter:
    """Rotation between successive frames, given in order."""

    def __init__(self, camera: Camera) -> None:
        self._camera = camera
        self._scale = max(1.0, camera.width / WIDTH)
        self._previous: Bytes | None = None

    def rotation(self, frame: Frame) -> Array | None:
        """Rotation vector (3,) rad in camera axes since the last frame; None if unknown.

        Translation over a distant scene appears as a slow rotation.
        """
        size = round(self._camera.width / self._scale), round(self._camera.height / self._scale)
        small = np.asarray(cv2.resize(frame.grey, size, interpolation=cv2.INTER_AREA), np.uint8)
        before, self._previous = self._previous, small
        if before is None:
            return None
        corners = cv2.goodFeaturesToTrack(before, MAX_CORNERS, 0.01, 7)
        if corners is None or len(corners) < MIN_CORNERS:
            return None
        there = np.zeros_like(corners)
        moved, found, _ = cv2.calcOpticalFlowPyrLK(before, small, corners, there)
        back, again, _ = cv2.calcOpticalFlowPyrLK(small, before, moved, np.zeros_like(corners))
        good = (np.ravel(found) == 1) & (np.ravel(again) == 1)
        good &= np.linalg.norm(back - corners, axis=-1).ravel() < 0.5
        if good.sum() < MIN_CORNERS:
            return None
        return self._fit(self._rays(corners[good, 0]), self._rays(np.asarray(moved)[good, 0]))

    def _rays(self, small_px: NDArray[Any]) -> Array:
        pixels = (np.asarray(small_px, np.float64) + 0.5) * self._scale - 0.5
        n = self._camera.normalise(pixels)
        rays = np.column_stack([n, np.ones(len(n))])
        out: Array = rays / np.linalg.norm(rays, axis=1, keepdims=True)
        return out

    def _fit(self, before: Array, after: Array) -> Array | None:
        """Rotation between rays, with Cauchy weights."""
        known = np.isfinite(before).all(1) & np.isfinite(after).all(1)
        before, after = before[known], after[known]
        if len(before) < MIN_CORNERS:
            return None
        cauchy_scale = CAUCHY_PX * self._scale / self._camera.focal_px
        vector = np.zeros(3)
        for _ in range(ROUNDS):
            # world points rotate opposite to the camera
            residual = after - before @ rotation_from_vector(vector)
            scale_now = max(cauchy_scale, float(np.median(np.linalg.norm(residual, axis=1))))
            weight = 1 / (1 + (np.linalg.norm(residual, axis=1) / scale_now) ** 2)
            turn = nearest_rotation((before * weight[:, None]).T @ after)
            vector = vector_from_rotation(turn)
        return vector if float(np.linalg.norm(vector)) < MAX_ROTATION_RAD else None
