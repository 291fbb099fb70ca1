"""Sight of a surface in a picture: the pixels of its places, and those that are hidden."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from companion.geometry.camera import Camera
from companion.geometry.transforms import Array, Pose
from companion.messages import Floats

BUFFER_PX = 4
"""Side of a cell of the depth buffer that tells what is hidden, pixels."""
HIDDEN = 1.03
"""Beyond so many times the depth of what is nearest a place is hidden."""


def projected(places: Array, pose: Pose, camera: Camera) -> tuple[Array, Array]:
    """Pixels (..., 2) and depths (...,) of places (..., 3)."""
    in_camera = pose.inverse().apply(places)
    return camera.project(in_camera), in_camera[..., 2]


def within(pixels: Array, camera: Camera) -> NDArray[np.bool_]:
    """True where pixels (..., 2) are in the picture."""
    inside = (pixels >= 0) & (pixels <= [camera.width - 1, camera.height - 1])
    return np.asarray(inside.all(-1))


def depth_buffer(pixels: Array, depth: Array, camera: Camera) -> Floats:
    """Depth of the nearest surface in and around each square of the picture, inf where none."""
    shape = camera.height // BUFFER_PX + 1, camera.width // BUFFER_PX + 1
    good = within(pixels, camera) & (depth > 0)
    at = np.rint(pixels[good]).astype(np.int64) // BUFFER_PX
    out = np.full(shape, np.inf)
    np.minimum.at(out, (at[:, 1], at[:, 0]), depth[good])
    # cells may lie farther apart than squares
    return np.asarray(cv2.erode(out.astype(np.float32), np.ones((3, 3))), np.float32)


def is_uncovered(pixels: Array, depth: Array, nearest: Floats) -> NDArray[np.bool_]:
    """True where nothing of a depth buffer lies before places within the picture."""
    square = np.rint(pixels).astype(np.int64) // BUFFER_PX
    return np.asarray(depth / HIDDEN < nearest[square[..., 1], square[..., 0]])
