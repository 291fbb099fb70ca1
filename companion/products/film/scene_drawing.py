"""Perspective pictures of a cloud and a path, drawn by numpy: squares by distance, edges shaded."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from companion.geometry.transforms import Array, Pose
from companion.messages import Bytes, Floats
from companion.products.report.cloud_views import view_axes

FOCAL_PER_HEIGHT = 1.2
TOP, BOTTOM = np.array([24, 28, 34.0]), np.array([11, 13, 16.0])
"""Background, RGB."""
PATH, CAMERA = (255, 176, 33), (90, 170, 255)
"""As in the report and the viewer: the path is orange."""
SUB_PX = 4
"""Bits of a pixel's fraction in cv2's lines."""
STRENGTH = 7.0
MAX_SIDE_PX = 9


@dataclass(frozen=True, slots=True, eq=False)
class Viewpoint:
    """Camera of the film: it looks at `target` (3,) from `distance`, heading and slope.

    The target is drawn at `across` of the width.
    """

    target: Array
    distance: float
    heading_rad: float
    down_rad: float
    across: float = 0.5

    def pixels(self, points: Array, width: int, height: int) -> tuple[Array, Array]:
        """Pixels (N, 2) and depths (N,) of points (N, 3); nan behind the camera."""
        right, up, ahead = view_axes(self.heading_rad, self.down_rad)
        away = points - (self.target - self.distance * ahead)
        depth = away @ ahead
        f = FOCAL_PER_HEIGHT * height
        z = np.where(depth > 1e-3 * self.distance, depth, np.nan)
        u = self.across * (width - 1) + f * (away @ right) / z
        v = (height - 1) / 2 - f * (away @ up) / z
        return np.stack([u, v], -1), z


def draw_points(
    view: Viewpoint, points: Array, rgb: Bytes, spacing: float, width: int, height: int
) -> Bytes:
    """Points (N, 3) of a usual distance to their neighbours, on the background."""
    background = _background(width, height)
    pixels, depth = view.pixels(points, width, height)
    side_px = np.ceil(2.0 * spacing * FOCAL_PER_HEIGHT * height / depth)
    side_px = np.clip(np.nan_to_num(side_px, nan=1), 2, MAX_SIDE_PX)
    order = np.argsort(-depth, kind="stable")
    order = order[np.isfinite(depth[order])]
    column, row = np.rint(np.clip(pixels[order], -1, max(width, height))).astype(np.int64).T
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    order, column, row = order[inside], column[inside], row[inside]
    rank = np.zeros((height, width), np.float32)  # 0 is nothing, then the nearer the higher
    for side in np.unique(side_px[order]):
        of_side = np.flatnonzero(side_px[order] == side)
        some = np.zeros_like(rank)
        some[row[of_side], column[of_side]] = of_side + 1
        rank = np.maximum(rank, cv2.dilate(some, np.ones((int(side), int(side)), np.uint8)))
    known = rank > 0
    if not known.any():
        return background
    point = order[rank.astype(np.int64) - 1]
    picture = np.where(known[..., None], rgb[point], background)
    nearest = np.where(known, depth[point], np.inf)
    return _shaded(picture, background, nearest.astype(np.float32))


def draw_path(picture: Bytes, view: Viewpoint, places: Sequence[Array]) -> None:
    """Draw unbroken parts (N, 3) of the path into a picture."""
    height, width = picture.shape[:2]
    for part in places:
        pixels, _ = view.pixels(part, width, height)
        line = np.rint(pixels[np.isfinite(pixels).all(1)] * 2**SUB_PX).astype(np.int32)
        if len(line) > 1:
            cv2.polylines(picture, [line[:, None]], False, PATH, 2, cv2.LINE_AA, SUB_PX)


def draw_camera(picture: Bytes, view: Viewpoint, pose: Pose, size: float) -> None:
    """Draw the outline of the camera, its longest side `size`."""
    height, width = picture.shape[:2]
    corners = np.array([[0, 0, 0], [-0.8, -0.6, 1], [0.8, -0.6, 1], [0.8, 0.6, 1], [-0.8, 0.6, 1]])
    pixels, _ = view.pixels(pose.apply(size * corners), width, height)
    if not np.isfinite(pixels).all():
        return
    eye, *others = np.rint(pixels * 2**SUB_PX).astype(np.int32)
    for corner, following in zip(others, [*others[1:], others[0]], strict=True):
        for begin, end in ((eye, corner), (corner, following)):
            cv2.line(picture, begin.tolist(), end.tolist(), CAMERA, 2, cv2.LINE_AA, SUB_PX)


def _background(width: int, height: int) -> Bytes:
    t = np.linspace(0, 1, height)[:, None, None]
    rows = np.rint(TOP * (1 - t) + BOTTOM * t).astype(np.uint8)
    return np.repeat(rows, width, axis=1)


def _shaded(picture: Bytes, background: Bytes, nearest: Floats) -> Bytes:
    """Darken what lies behind its neighbours (eye-dome lighting, Boucheny 2009)."""
    known = np.isfinite(nearest)
    log = np.where(known, np.log2(np.where(known, nearest, 1)), np.inf).astype(np.float32)
    behind = np.zeros(log.shape, np.float32)
    for axis, step in ((0, 1), (0, -1), (1, 1), (1, -1)):
        apart = np.where(known, log, 0) - np.roll(log, step, axis)
        behind += np.clip(apart, 0, 0.1)
    shade = np.exp2(-STRENGTH * behind)[..., None]
    return np.where(known[..., None], picture * shade, background).astype(np.uint8)
