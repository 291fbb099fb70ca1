"""Turns from camera to camera as the autopilot tells them, for bundle adjustment.

Over a second its gyroscopes are right to some tenths of a degree. Two images of a plane, or of
little depth, cannot tell a turn of degrees from a shift: a map that begins with them would bend.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from companion.geometry.transforms import Array, angle_between
from companion.slam.features.orb_features import Ints
from companion.slam.optimisation.factors import add_pairs, soft_cost, soft_root

LEAST_SIGMA_RAD, SIGMA_SHARE = np.radians(0.3), 0.1
"""What a told turn is off by: attitudes have errors that change, and clocks make turns late."""


@dataclass(frozen=True, slots=True, eq=False)
class Turns:
    """From cameras `first` (E,) to cameras `second` (E,) it is `second_from_first` (E, 3, 3).

    `sigma_rad` (E,) is one standard deviation about each axis.
    """

    first: Ints
    second: Ints
    second_from_first: Array
    sigma_rad: Array

    @staticmethod
    def told(first: Ints, second: Ints, second_from_first: Array) -> Turns:
        """Turns with the errors that they usually have."""
        turned = np.array([angle_between(turn, np.eye(3)) for turn in second_from_first])
        sigma_rad = np.hypot(float(LEAST_SIGMA_RAD), SIGMA_SHARE * turned)
        return Turns(first, second, second_from_first, sigma_rad)

    def errors(self, rotation: Array) -> tuple[Array, Array]:
        """Whitened errors (E, 3) of cameras with `camera_from_map` rotations, and their sizes."""
        seen = rotation[self.second] @ rotation[self.first].transpose(0, 2, 1)
        off = seen @ self.second_from_first.transpose(0, 2, 1)
        off = 0.5 * (off - off.transpose(0, 2, 1))  # the sine: of small turns the turn itself
        vector = np.stack([off[:, 2, 1], off[:, 0, 2], off[:, 1, 0]], 1) / self.sigma_rad[:, None]
        return vector, np.linalg.norm(vector, axis=1)

    def cost(self, rotation: Array, translation: Array) -> float:
        """As of a Tie."""
        return soft_cost(self.errors(rotation)[1])

    def add_to(
        self, information: Array, gradient: Array, rotation: Array, translation: Array
    ) -> None:
        """As of a Tie."""
        off, size = self.errors(rotation)
        root = soft_root(size)
        known = (root / self.sigma_rad)[:, None, None]
        seen = rotation[self.second] @ rotation[self.first].transpose(0, 2, 1)
        ends = ((self.second, known * np.eye(3)), (self.first, -known * seen))
        add_pairs(information[:, :3, :, :3], gradient[:, :3], ends, off * root[:, None])


def turns_of(first: Ints, second: Ints, ned_from_camera: Array) -> Turns | None:
    """Turns between pairs of cameras with told attitudes (C, 3, 3), nan elsewhere; None: none."""
    second_from_first = ned_from_camera[second].transpose(0, 2, 1) @ ned_from_camera[first]
    told = np.isfinite(second_from_first).all((1, 2))
    return Turns.told(first[told], second[told], second_from_first[told]) if told.any() else None
