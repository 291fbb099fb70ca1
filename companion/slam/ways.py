"""Ways from camera to camera as the autopilot's velocity tells them, for bundle adjustment.

Over seconds a velocity is wrong by a few per cent of the way, where images are by a few per mille;
but its errors do not grow with the map, nor where there is little to see.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from companion.geometry import Array
from companion.slam.features import Ints

SOFT = 3.0
"""Standard deviations beyond which a way pulls ever less: where one is wrong it is quite wrong."""
MIN_TOLD = 5
USELESS = 4.0
"""Standard deviations by which ways usually miss that are not the camera's."""


@dataclass(frozen=True, slots=True, eq=False)
class Ways:
    """From cameras `first` (E,) to cameras `second` (E,) it is `way_m` (E, 3), nan where untold.

    The way is in the world's axes, which `world_from_map` (3, 3), the map's scale and rotation,
    gives. `sigma_m` (E,) is one standard deviation of each axis.
    """

    first: Ints
    second: Ints
    way_m: Array
    sigma_m: Array
    world_from_map: Array

    def errors(self, rotation: Array, translation: Array) -> tuple[Array, Array]:
        """Whitened errors (E, 3) of cameras with `camera_from_map` poses, and their sizes."""
        centre = -np.matmul(rotation.transpose(0, 2, 1), translation[..., None])[..., 0]
        way_m = (centre[self.second] - centre[self.first]) @ self.world_from_map.T
        off = np.nan_to_num((way_m - self.way_m) / self.sigma_m[:, None])
        return off, np.linalg.norm(off, axis=1)

    def cost(self, rotation: Array, translation: Array) -> float:
        """Cauchy's loss of all of them."""
        _, size = self.errors(rotation, translation)
        return float((0.5 * SOFT**2 * np.log1p((size / SOFT) ** 2)).sum())

    def add_to(
        self, information: Array, gradient: Array, rotation: Array, translation: Array
    ) -> None:
        """Add their information (n, 6, n, 6) and gradient (n, 6) of the first n cameras.

        A camera moves as in bundle adjustment, by a turn and then a shift (6,).
        """
        n = len(gradient)
        off, size = self.errors(rotation, translation)
        root = 1.0 / np.hypot(1.0, size / SOFT)
        known = np.isfinite(self.way_m) * (root / self.sigma_m)[:, None]
        off = off * root[:, None]
        shifted = information[:, 3:, :, 3:].transpose(0, 2, 1, 3)
        ends = []
        for camera, sign in ((self.first, 1.0), (self.second, -1.0)):
            turned = self.world_from_map @ rotation[camera].transpose(0, 2, 1)
            ends.append((camera, sign * known[..., None] * turned, camera < n))
        for a, of_a, moves_a in ends:
            pulled = np.matmul(of_a.transpose(0, 2, 1), off[..., None])[..., 0]
            np.add.at(gradient[:, 3:], a[moves_a], pulled[moves_a])
            for b, of_b, moves_b in ends:
                both = moves_a & moves_b
                tied = np.matmul(of_a.transpose(0, 2, 1), of_b)[both]
                np.add.at(shifted, (a[both], b[both]), tied)


def usual_error(ways: Ways, rotation: Array, translation: Array) -> float | None:
    """By how many standard deviations ways usually miss a map's cameras; None: of no use to it."""
    _, size = ways.errors(rotation, translation)
    if len(size) < MIN_TOLD:
        return None
    usual = float(np.median(size)) / 1.54  # of three axes
    return usual if usual < USELESS else None
