"""From a camera's images to those of an ideal pinhole camera."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from companion.camera import Camera

MAX_HFOV_RAD = np.radians(110.0)


def undistortion(
    camera: Camera,
) -> tuple[NDArray[Any], NDArray[Any], tuple[float, float, float, float]]:
    """Remap tables to an ideal pinhole image of the same size, and its fx, fy, cx, cy.

    The focal length is kept, unless the field of view would be too wide for a plane.
    """
    fx, fy = camera.fx, camera.fy
    widest = 0.5 * camera.width / np.tan(0.5 * MAX_HFOV_RAD)
    if camera.distortion.value == "equidistant" and fx < widest:
        fx, fy = widest, widest * camera.fy / camera.fx
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    n = np.stack([(u - camera.cx) / fx, (v - camera.cy) / fy], -1).reshape(-1, 2)
    d = camera.distort(n)
    shape = (camera.height, camera.width)
    map_u = (d[:, 0] * camera.fx + camera.cx).reshape(shape).astype(np.float32)
    map_v = (d[:, 1] * camera.fy + camera.cy).reshape(shape).astype(np.float32)
    a, b = cv2.convertMaps(map_u, map_v, cv2.CV_16SC2)
    return np.asarray(a), np.asarray(b), (fx, fy, camera.cx, camera.cy)
