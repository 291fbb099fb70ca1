"""Undistortion of images to a pinhole camera."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from companion.dense.view_selection import Intrinsics
from companion.geometry.camera import Camera
from companion.geometry.rolling_shutter import Unrolling, nodes
from companion.geometry.transforms import Array
from companion.messages import Bytes, Floats

MAX_HFOV_RAD = np.radians(110.0)


class Undistortion:
    """Remaps images of one camera to a pinhole camera of the same size.

    The focal length is kept, unless the field of view is too wide for a plane.
    """

    def __init__(self, camera: Camera) -> None:
        fx, fy = camera.fx, camera.fy
        widest = 0.5 * camera.width / np.tan(0.5 * MAX_HFOV_RAD)
        if camera.distortion.value == "equidistant" and fx < widest:
            fx, fy = widest, widest * camera.fy / camera.fx
        self.intrinsics = Intrinsics(fx, fy, camera.cx, camera.cy)
        self._camera = camera
        self._fixed = cv2.convertMaps(*self._maps(), cv2.CV_16SC2)
        self._unrolling: Unrolling | None = None
        if camera.readout_ms:
            k, grid = self.intrinsics, nodes(camera.width, camera.height)
            rays = (grid - [k.cx, k.cy]) / [k.fx, k.fy]
            self._unrolling = Unrolling(camera, 1e-3 * camera.readout_ms, rays, self._maps())

    def image(self, image: Bytes, motion: Array | None = None) -> Bytes:
        """The undistorted image, (H, W) or (H, W, 3).

        That of a rolling shutter is of the time of its middle row, where the `motion` (3, 3) of its
        camera is known, see `shutter_motion`.
        """
        if self._unrolling is not None and motion is not None:
            return self._unrolling.image(image, motion)
        return np.asarray(cv2.remap(image, *self._fixed, cv2.INTER_LINEAR), np.uint8)

    def grey(self, rgb: Bytes) -> Bytes:
        """The undistorted image (H, W) of an RGB image (H, W, 3)."""
        return np.asarray(cv2.cvtColor(self.image(rgb), cv2.COLOR_RGB2GRAY), np.uint8)

    def nearest(self, values: NDArray[Any]) -> Floats:
        """Nearest-neighbour remap of values (H, W), such as depths; 0 outside."""
        return np.asarray(cv2.remap(values, *self._maps(), cv2.INTER_NEAREST), np.float32)

    def ray_length(self) -> Floats:
        """Length (H, W) of the ray to a point at depth 1."""
        return np.asarray(np.sqrt((self._normalised() ** 2).sum(-1) + 1), np.float32)

    def _normalised(self) -> Array:
        """Normalised coordinates (H, W, 2) of the pixels of the undistorted image."""
        camera, k = self._camera, self.intrinsics
        u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
        return np.stack([(u - k.cx) / k.fx, (v - k.cy) / k.fy], -1)

    def _maps(self) -> tuple[Floats, Floats]:
        """Columns and rows (H, W) in the distorted image."""
        camera = self._camera
        d = camera.distort(self._normalised().reshape(-1, 2))
        shape = (camera.height, camera.width)
        return (
            (d[:, 0] * camera.fx + camera.cx).reshape(shape).astype(np.float32),
            (d[:, 1] * camera.fy + camera.cy).reshape(shape).astype(np.float32),
        )
