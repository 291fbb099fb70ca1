"""Sensor of the drawn camera: noise, and blur by motion."""

from __future__ import annotations

import cv2
import numpy as np

from companion.geometry.camera import Camera
from companion.geometry.transforms import Array, Pose
from companion.messages import Bytes
from tests.firmware.looks import Look

SHEET_PX = 192
"""A sheet of noise is wider and higher than a picture by this, and laid on it anywhere: 37 000
pictures are unlike each other, and none costs random numbers."""
SHORTEST_S = 0.002
MAX_PAUSE_S = 0.3
"""After it nothing is known of the motion."""
MAX_BLUR_PX = 9.0
"""A longer trace shows nothing more, and costs."""


class Sensor:
    """See above. Pictures are given in the order of their times."""

    def __init__(self, camera: Camera, look: Look, seed: int) -> None:
        self._camera, self._look = camera, look
        self._rng = np.random.default_rng(seed + 4)
        sheet = self._rng.normal(
            0.0, look.noise, (camera.height + SHEET_PX, camera.width + SHEET_PX, 3)
        )
        self._sheet = np.clip(np.round(sheet), -127, 127).astype(np.int8)
        self._before: tuple[Pose, float] | None = None

    def picture(self, seen: Bytes, world_from_camera: Pose, t_s: float) -> Bytes:
        """The picture of what is seen, exposed about `t_s`."""
        if self._look.exposure_s >= SHORTEST_S:
            seen = _blurred(seen, self._motion_px(world_from_camera, t_s))
            self._before = world_from_camera, t_s
        return self.noisy(seen)

    def noisy(self, picture: Bytes) -> Bytes:
        """A picture and noise that is never the same."""
        y, x = self._rng.integers(0, SHEET_PX, 2)
        noise = self._sheet[y : y + picture.shape[0], x : x + picture.shape[1]]
        return np.asarray(cv2.add(picture, noise, dtype=cv2.CV_8U), np.uint8)

    def _motion_px(self, pose: Pose, t_s: float) -> Array:
        """Motion (2,) of the middle of the picture during an exposure."""
        if self._before is None or not 0 < t_s - self._before[1] < MAX_PAUSE_S:
            return np.zeros(2)
        before, before_s = self._before
        ray = pose.rotation[:, 2]
        down = float(-pose.translation[2])
        distance = down / ray[2] if ray[2] > 0.1 else 10.0 * down
        middle = np.array([0.0, 0.0, max(distance, 0.05)])
        now = self._camera.project(middle)
        then = self._camera.project((before.inverse() @ pose).apply(middle))
        share = self._look.exposure_s / (t_s - before_s)
        return np.nan_to_num(np.asarray((now - then) * share, np.float64))


def _blurred(picture: Bytes, motion_px: Array) -> Bytes:
    """Mean of copies that are shifted along the motion, half of it to each side."""
    length = float(np.linalg.norm(motion_px))
    if length < 0.7:
        return picture
    motion = motion_px * min(1.0, MAX_BLUR_PX / length)
    height, width = picture.shape[:2]
    pad = int(MAX_BLUR_PX)
    wide = cv2.copyMakeBorder(picture, pad, pad, pad, pad, cv2.BORDER_REPLICATE)
    shares = np.linspace(-0.5, 0.5, 2 * int(np.ceil(0.5 * np.abs(motion).max())) + 1)
    total = np.zeros(picture.shape, np.uint16)
    for x, y in pad + np.round(shares[:, None] * motion).astype(int):
        cv2.add(total, wide[y : y + height, x : x + width], total, dtype=cv2.CV_16U)
    return np.asarray(cv2.convertScaleAbs(total, alpha=1.0 / len(shares)), np.uint8)
