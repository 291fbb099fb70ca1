"""Points of the map that the newest images have found again, and the sectors that these confirm.

Depth of a keyframe is known a second or two after it. A frame is tracked within milliseconds, and
shows by the map points found in it that the world still is as mapped in their directions: whatever
came in between would hide them.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from companion.geometry.camera import Camera
from companion.geometry.transforms import Array, Pose
from companion.messages import Floats
from companion.obstacles.obstacle_sectors import MIN_POINTS, N_SECTORS, sector_of

Ints = NDArray[np.int64]

MATCH_PX = 2
"""Largest distance, along rows and columns, of a point, projected by the frame's pose, from the
keypoint found for it."""
MAX_ELEVATION_RAD = np.radians(20.0)
"""Of sight that tells of a sector: at 3 m the band of heights that is searched ends there."""


def points_found(
    points_map: Array, keypoints_px: Floats, map_from_camera: Pose, camera: Camera
) -> Array:
    """The points (M, 3) of a map (N, 3) that a frame has found, by its keypoints (K, 2).

    Of points behind one another it is not told which was found: they tell of no free space.
    """
    seen = map_from_camera.inverse().apply(points_map)
    # only where the lens model is sure to hold: beyond the image it may fold back
    half = 0.5 * np.array([camera.width / camera.fx, camera.height / camera.fy])
    ahead = np.flatnonzero(seen[:, 2] > 0)
    ahead = ahead[(np.abs(seen[ahead, :2]) <= 1.2 * half * seen[ahead, 2:]).all(1)]
    is_found = np.zeros((camera.height, camera.width), np.uint8)
    columns, rows, _ = _inside(np.asarray(keypoints_px, np.float64), camera)
    is_found[rows, columns] = 1
    about = np.ones((2 * MATCH_PX + 1, 2 * MATCH_PX + 1), np.uint8)
    is_near = cv2.dilate(is_found, about) > 0
    columns, rows, which = _inside(camera.project(seen[ahead]), camera)
    return np.asarray(points_map[ahead[which][is_near[rows, columns]]])


def _inside(pixels: Array, camera: Camera) -> tuple[Ints, Ints, NDArray[np.bool_]]:
    """Columns and rows of those pixels (N, 2) that are in the image, and the mask (N,) of these."""
    at = np.nan_to_num(np.rint(pixels), nan=-1.0)
    column, row = at[:, 0], at[:, 1]
    inside = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
    return column[inside].astype(np.int64), row[inside].astype(np.int64), inside


def sectors_seen(
    keypoints_px: Floats, world_from_camera: Pose, world_from_body: Pose, camera: Camera
) -> NDArray[np.bool_]:
    """Mask (72,) of sectors around a vehicle in which a frame has found enough map points."""
    rays = rays_of(keypoints_px, world_from_camera, camera)
    level = np.abs(rays[:, 2]) <= np.tan(MAX_ELEVATION_RAD) * np.hypot(rays[:, 0], rays[:, 1])
    counts = np.bincount(sector_of(rays[level], world_from_body), minlength=N_SECTORS)
    return np.asarray(counts >= MIN_POINTS)


def rays_of(keypoints_px: Floats, world_from_camera: Pose, camera: Camera) -> Array:
    """Rays (N, 3) of keypoints, in world axes, as far as the lens model gives any."""
    flat = camera.normalise(keypoints_px)
    rays = np.c_[flat, np.ones(len(flat))] @ world_from_camera.rotation.T
    out: Array = rays[np.isfinite(rays).all(1)]
    return out
