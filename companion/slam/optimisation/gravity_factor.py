"""What the autopilot says of the vertical, for bundle adjustment: each camera's down direction.

Its attitude is wrong by some tenths of a degree for seconds on end, where images are usually wrong
by hundredths; but it does not bend with a map that shows little, such as the first of a climb.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from companion.geometry.transforms import Array, skew

LEAST_SIGMA_RAD, MOST_SIGMA_RAD = np.radians(0.3), np.radians(1.0)
"""More is not the attitude's error but the map's,"""
USELESS_RAD = np.radians(4.0)
"""or the attitude is not the camera's."""
ALIKE = 2.0
"""Errors of attitudes that follow each other are alike: each counts for so much less."""
HUBER = 2.0
MIN_TOLD = 5


@dataclass(frozen=True, slots=True, eq=False)
class Plumb:
    """Down as the autopilot has it, in cameras (C, 3), and as the map has it (3,).

    `down_camera` is nan where nothing was told. `sigma_rad` is one standard deviation of each.
    """

    down_camera: Array
    down_map: Array
    sigma_rad: float

    def errors(self, rotation: Array) -> tuple[Array, Array]:
        """Whitened errors (C, 3) of cameras with `camera_from_map` rotations, and their sizes."""
        off = np.nan_to_num((rotation @ self.down_map - self.down_camera) / self.sigma_rad)
        return off, np.linalg.norm(off, axis=1)

    def cost(self, rotation: Array, translation: Array) -> float:
        """Huber's loss of all of them."""
        _, size = self.errors(rotation)
        return float(np.where(size < HUBER, 0.5 * size**2, HUBER * (size - 0.5 * HUBER)).sum())

    def add_to(
        self, information: Array, gradient: Array, rotation: Array, translation: Array
    ) -> None:
        """As of a Tie."""
        told = np.flatnonzero(np.isfinite(self.down_camera[: len(gradient), 0]))
        off, size = self.errors(rotation)
        jacobian = -skew(rotation[told] @ self.down_map) / self.sigma_rad
        weight = np.minimum(1.0, HUBER / np.maximum(size[told], 1e-9))
        weighted = jacobian.transpose(0, 2, 1) * weight[:, None, None]
        information[told, :3, told, :3] += weighted @ jacobian
        gradient[told, :3] += (weighted @ off[told, :, None])[..., 0]


def plumb_of(rotation: Array, down_camera: Array) -> tuple[Array, float] | None:
    """Down in a map (3,), and how well cameras (C, 3, 3), `camera_from_map`, agree about it, rad.

    By those that were told `down_camera` (C, 3), nan elsewhere; None where too few were, or where
    they do not agree at all.
    """
    told = np.isfinite(down_camera[:, 0])
    if np.count_nonzero(told) < MIN_TOLD:
        return None
    inside = np.matmul(rotation[told].transpose(0, 2, 1), down_camera[told][..., None])[..., 0]
    down = np.median(inside, axis=0)
    down /= max(float(np.linalg.norm(down)), 1e-9)
    off = np.linalg.norm(inside - down, axis=1)
    sigma_rad = float(np.median(off)) / 1.18  # of each of two axes
    if sigma_rad > USELESS_RAD:
        return None
    return down, float(np.clip(sigma_rad, LEAST_SIGMA_RAD, MOST_SIGMA_RAD)) * ALIKE
