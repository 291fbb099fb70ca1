"""How fast a camera turns, by its pictures alone: without a map, good for comparisons only."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from companion.geometry.camera import Camera
from companion.geometry.transforms import Array, rotation_from_vector, vector_from_rotation
from companion.messages import Bytes, Frame

WIDTH = 320
"""Pictures are made this small first."""
MAX_CORNERS, LEAST_CORNERS = 200, 15
ROUNDS = 8
SOFT_PX = 0.5
MAX_TURN_RAD = 0.5


class RotationMeter:
    """Takes frames in order; tells the turn from each to the next."""

    def __init__(self, camera: Camera) -> None:
        self._camera = camera
        self._scale = max(1.0, camera.width / WIDTH)
        self._previous: Bytes | None = None

    def turn(self, frame: Frame) -> Array | None:
        """Rotation vector (3,) rad in the camera's axes since the last frame; None if not known.

        Translation over what is far below looks like a slow turn, and is not told from one.
        """
        size = round(self._camera.width / self._scale), round(self._camera.height / self._scale)
        small = np.asarray(cv2.resize(frame.grey, size, interpolation=cv2.INTER_AREA), np.uint8)
        before, self._previous = self._previous, small
        if before is None:
            return None
        corners = cv2.goodFeaturesToTrack(before, MAX_CORNERS, 0.01, 7)
        if corners is None or len(corners) < LEAST_CORNERS:
            return None
        there = np.zeros_like(corners)
        moved, found, _ = cv2.calcOpticalFlowPyrLK(before, small, corners, there)
        back, again, _ = cv2.calcOpticalFlowPyrLK(small, before, moved, np.zeros_like(corners))
        good = (np.ravel(found) == 1) & (np.ravel(again) == 1)
        good &= np.linalg.norm(back - corners, axis=-1).ravel() < 0.5
        if good.sum() < LEAST_CORNERS:
            return None
        return self._fit(self._rays(corners[good, 0]), self._rays(np.asarray(moved)[good, 0]))

    def _rays(self, small_px: NDArray[Any]) -> Array:
        pixels = (np.asarray(small_px, np.float64) + 0.5) * self._scale - 0.5
        n = self._camera.normalise(pixels)
        rays = np.column_stack([n, np.ones(len(n))])
        out: Array = rays / np.linalg.norm(rays, axis=1, keepdims=True)
        return out

    def _fit(self, before: Array, after: Array) -> Array | None:
        """The rotation that most of the rays agree on (weighted by Cauchy's function)."""
        known = np.isfinite(before).all(1) & np.isfinite(after).all(1)
        before, after = before[known], after[known]
        if len(before) < LEAST_CORNERS:
            return None
        soft = SOFT_PX * self._scale / self._camera.focal_px
        vector = np.zeros(3)
        for _ in range(ROUNDS):
            # points of the world turn against the camera
            left = after - before @ rotation_from_vector(vector)
            soft_now = max(soft, float(np.median(np.linalg.norm(left, axis=1))))
            weight = 1 / (1 + (np.linalg.norm(left, axis=1) / soft_now) ** 2)
            u, _, vt = np.linalg.svd((before * weight[:, None]).T @ after)
            rotation = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
            vector = vector_from_rotation(rotation)
        return vector if float(np.linalg.norm(vector)) < MAX_TURN_RAD else None
