"""A landing marker on textured ground, rendered through any lens, with truth."""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np

from companion.estimation.landing.marker_detector import FAMILIES
from companion.geometry.camera import Camera
from companion.geometry.transforms import Array, Pose, rotation_from_vector
from companion.messages import Bytes
from tests.support.flights.scene import texture

CELL_PX = 24
SAMPLES = 2
"""Samples of a pixel along each axis, against stairs at the edges."""
METRES_PER_TEXEL = 0.03


class MarkerGround:
    """Level ground at z = 0 (NED) with a marker about the origin, whose top points north."""

    def __init__(self, marker: str, number: int, size_m: float, seed: int = 3) -> None:
        self._sheet = drawn_marker(marker, number)
        self._texel_m = size_m / (len(self._sheet) - 2 * CELL_PX)
        self._rng = np.random.default_rng(seed)
        self._ground = texture(np.random.default_rng(seed), 512)

    def picture(self, camera: Camera, world_from_camera: Pose, noise: float = 2.0) -> Bytes:
        """Grey image (H, W), with some blur of the lens and noise."""
        x, y = _rays(camera)
        r, centre = world_from_camera.rotation, world_from_camera.translation
        ray = [r[i, 0] * x + r[i, 1] * y + r[i, 2] for i in range(3)]
        with np.errstate(divide="ignore", invalid="ignore"):
            along = np.where(ray[2] > 1e-3, -centre[2] / ray[2], np.nan)
        north, east = centre[0] + along * ray[0], centre[1] + along * ray[1]
        n = len(self._ground)
        out = _sampled(self._ground, np.mod(east / METRES_PER_TEXEL, n - 1),
                       np.mod(-north / METRES_PER_TEXEL, n - 1))  # fmt: skip
        half = 0.5 * len(self._sheet) - 0.5
        u, v = east / self._texel_m + half, -north / self._texel_m + half
        inside = (np.abs(u - half) < half) & (np.abs(v - half) < half)
        out[inside] = _sampled(self._sheet, u, v)[inside]
        size = camera.width, camera.height
        small = cv2.GaussianBlur(cv2.resize(out, size, interpolation=cv2.INTER_AREA), (0, 0), 0.6)
        noisy = small + noise * self._rng.standard_normal(small.shape, np.float32)
        return np.asarray(np.clip(noisy, 0, 255), np.uint8)


def drawn_marker(marker: str, number: int) -> Bytes:
    """The marker with a white margin of one cell; grey as print is."""
    dictionary = cv2.aruco.getPredefinedDictionary(FAMILIES[marker])
    cells = dictionary.markerSize + 2
    image = cv2.aruco.generateImageMarker(dictionary, number, cells * CELL_PX)
    wide = cv2.copyMakeBorder(
        image, CELL_PX, CELL_PX, CELL_PX, CELL_PX, cv2.BORDER_CONSTANT, value=255
    )
    return np.asarray(wide * 0.75 + 25, np.uint8)


def looking_at_marker(
    distance_m: float, off_vertical_deg: float, azimuth_deg: float, turn_deg: float = 0.0,
    aside: Array | None = None,
) -> Pose:  # fmt: skip
    """`world_from_camera` at a distance from the origin; `aside` (2,) turns it away, rad."""
    a, t = np.radians(azimuth_deg), np.radians(off_vertical_deg)
    back = np.array([np.cos(a) * np.sin(t), np.sin(a) * np.sin(t), -np.cos(t)])
    forward = -back
    right = np.array([-np.sin(a), np.cos(a), 0.0])
    facing = np.stack([right, np.cross(forward, right), forward], 1)
    about = rotation_from_vector(np.array([0.0, 0.0, np.radians(turn_deg)]))
    if aside is not None:
        about = about @ rotation_from_vector(np.array([aside[0], aside[1], 0.0]))
    return Pose(facing @ about, back * distance_m)


@cache
def _rays(camera: Camera) -> tuple[Array, Array]:
    u = (np.arange(camera.width * SAMPLES) + 0.5) / SAMPLES - 0.5
    v = (np.arange(camera.height * SAMPLES) + 0.5) / SAMPLES - 0.5
    grid = np.stack(np.meshgrid(u, v), -1)
    rays = camera.normalise(grid.reshape(-1, 2)).reshape(grid.shape)
    return rays[..., 0], rays[..., 1]


def _sampled(image: Bytes, u: Array, v: Array) -> Array:
    x, y = (np.nan_to_num(each, nan=0.0).astype(np.float32) for each in (u, v))
    return np.asarray(cv2.remap(image.astype(np.float32), x, y, cv2.INTER_LINEAR), np.float64)
