"""Ways from camera to camera as the autopilot's velocity tells them, for bundle adjustment.

Over seconds a velocity is wrong by a few per cent of the way, where images are by a few per mille;
but its errors do not grow with the map, nor where there is little to see.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from companion.geometry.transforms import Array
from companion.slam.features.orb_features import Ints
from companion.slam.optimisation.factors import add_pairs, soft_cost, soft_root

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
        """As of a Tie."""
        return soft_cost(self.errors(rotation, translation)[1])

    def add_to(
        self, information: Array, gradient: Array, rotation: Array, translation: Array
    ) -> None:
        """As of a Tie."""
        off, size = self.errors(rotation, translation)
        root = soft_root(size)
        known = (np.isfinite(self.way_m) * (root / self.sigma_m)[:, None])[..., None]
        first, second = (
            self.world_from_map @ rotation[camera].transpose(0, 2, 1)
            for camera in (self.first, self.second)
        )
        ends = ((self.first, known * first), (self.second, -known * second))
        add_pairs(information[:, 3:, :, 3:], gradient[:, 3:], ends, off * root[:, None])


def usual_error(ways: Ways, rotation: Array, translation: Array) -> float | None:
    """By how many standard deviations ways usually miss a map's cameras; None: of no use to it."""
    _, size = ways.errors(rotation, translation)
    if len(size) < MIN_TOLD:
        return None
    usual = float(np.median(size)) / 1.54  # of three axes
    return usual if usual < USELESS else None
