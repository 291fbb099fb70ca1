"""Drawings over the pilot's video: the horizon, the points that are tracked, the newest depth map.

Each is of the newest message that has come: tracks are a frame or two behind the picture, which
waits for nothing.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from companion.geometry.camera import Camera
from companion.geometry.transforms import Array
from companion.messages import Bytes, DepthMap, Floats, Odometry, Track
from companion.streaming.depth_picture import depth_colours

POINTS, HORIZON, DEPTH = "points", "horizon", "depth"
GREEN, AMBER, WHITE = (80, 230, 120), (255, 176, 32), (255, 255, 255)
MAX_AGE_NS = 1_000_000_000
"""Age at which a track or an attitude is no longer drawn."""
INSET = 3
"""The depth map takes this part of the width, in the lower right corner."""
STEP_DEG = 2
LETTERS = {0: "N", 90: "E", 180: "S", 270: "W"}


class VideoOverlay:
    """Draws what is `wanted`: some of points, horizon, depth."""

    def __init__(self, wanted: Sequence[str], camera: Camera) -> None:
        self._wanted, self._camera = frozenset(wanted), camera
        self._found: tuple[int, Floats] | None = None
        self._attitude: tuple[int, Array] | None = None
        self._depth: Bytes | None = None
        azimuth = np.radians(np.arange(0, 360, STEP_DEG))
        self._horizon: Array = np.stack([np.cos(azimuth), np.sin(azimuth), 0 * azimuth], 1)

    def take(self, message: Track | Odometry | DepthMap) -> None:
        """Take what is drawn from now on."""
        if isinstance(message, Track):
            found = message.keypoints_px
            self._found = None if found is None else (message.t_ns, found)
        elif isinstance(message, Odometry):
            pose = message.world_from_body
            self._attitude = None if pose is None else (message.t_ns, pose.rotation)
        elif DEPTH in self._wanted:
            self._depth = depth_colours(message)

    def drawn(self, rgb: Bytes, t_ns: int) -> Bytes:
        """The picture (H, W, 3) with the drawings, as another one; itself with none wanted."""
        if not self._wanted:
            return rgb
        out = np.ascontiguousarray(rgb).copy()
        if POINTS in self._wanted and self._found and t_ns - self._found[0] < MAX_AGE_NS:
            half = max(2, rgb.shape[1] // 200)
            for u, v in np.rint(self._found[1]).astype(int).tolist():
                cv2.rectangle(out, (u - half, v - half), (u + half, v + half), GREEN, 1)
        if HORIZON in self._wanted and self._attitude and t_ns - self._attitude[0] < MAX_AGE_NS:
            self._draw_horizon(out, self._attitude[1])
        if self._depth is not None:
            _inset(out, self._depth)
        return out

    def _draw_horizon(self, out: Bytes, world_from_body: Array) -> None:
        mount = self._camera.body_from_camera
        if mount is None or self._camera.gimbal is not None:
            return
        pixels = self._camera.project(self._horizon @ (world_from_body @ mount.rotation))
        height, width = out.shape[:2]
        size = np.array([width, height])
        inside = np.asarray(((pixels > -0.5) & (pixels < size - 0.5)).all(1))
        for at in np.flatnonzero(inside):  # nan is outside
            after = (at + 1) % len(pixels)
            a = tuple(np.rint(pixels[at]).astype(int).tolist())
            if inside[after]:
                cv2.line(out, a, tuple(np.rint(pixels[after]).astype(int).tolist()), AMBER, 2)
            letter = LETTERS.get(int(at) * STEP_DEG)
            if letter:
                cv2.putText(out, letter, a, cv2.FONT_HERSHEY_SIMPLEX, width / 900, WHITE, 2)


def _inset(out: Bytes, depth: Bytes) -> None:
    width = out.shape[1] // INSET
    height = round(width * depth.shape[0] / depth.shape[1])
    small = cv2.resize(depth, (width, height), interpolation=cv2.INTER_AREA)
    out[-height:, -width:] = small
    corner = (out.shape[1] - width, out.shape[0] - height)
    cv2.rectangle(out, corner, (out.shape[1] - 1, out.shape[0] - 1), WHITE, 1)
