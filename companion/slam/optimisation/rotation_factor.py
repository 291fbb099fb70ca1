"""Relative rotation factor of bundle adjustment, from the attitudes of the autopilot.

Over a second gyroscopes are right to tenths of a degree. In two images of a plane, or of little
depth, rotation and translation are ambiguous: a map initialised by them alone would be distorted.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from companion.geometry.transforms import Array, angle_between
from companion.slam.features.orb_features import Ints
from companion.slam.optimisation.factors import add_pairwise, cauchy_cost, cauchy_root_weight

MIN_SIGMA_RAD, RELATIVE_SIGMA = np.radians(0.3), 0.1
"""Error of a measured relative rotation: attitude errors vary, and clock offsets scale with the
angle."""


@dataclass(frozen=True, slots=True, eq=False)
class RelativeRotationFactor:
    """Rotations `second_from_first` (E, 3, 3) between cameras `first` (E,) and `second` (E,).

    `sigma_rad` (E,) is one standard deviation about each axis.
    """

    first: Ints
    second: Ints
    second_from_first: Array
    sigma_rad: Array

    @staticmethod
    def with_typical_errors(
        first: Ints, second: Ints, second_from_first: Array
    ) -> RelativeRotationFactor:
        """The factor with the usual errors of an autopilot."""
        angle_rad = np.array([angle_between(rotation, np.eye(3)) for rotation in second_from_first])
        sigma_rad = np.hypot(float(MIN_SIGMA_RAD), RELATIVE_SIGMA * angle_rad)
        return RelativeRotationFactor(first, second, second_from_first, sigma_rad)

    def errors(self, rotation: Array) -> tuple[Array, Array]:
        """Whitened errors (E, 3) of `camera_from_map` rotations, and their norms."""
        seen = rotation[self.second] @ rotation[self.first].transpose(0, 2, 1)
        residual = seen @ self.second_from_first.transpose(0, 2, 1)
        residual = 0.5 * (
            residual - residual.transpose(0, 2, 1)
        )  # the sine: of a small angle the angle itself
        vector = (
            np.stack([residual[:, 2, 1], residual[:, 0, 2], residual[:, 1, 0]], 1)
            / self.sigma_rad[:, None]
        )
        return vector, np.linalg.norm(vector, axis=1)

    def cost(self, rotation: Array, translation: Array) -> float:
        """As of a Factor."""
        return cauchy_cost(self.errors(rotation)[1])

    def add_normal_equations(
        self, information: Array, gradient: Array, rotation: Array, translation: Array
    ) -> None:
        """As of a Factor."""
        residual, size = self.errors(rotation)
        root_weight = cauchy_root_weight(size)
        known = (root_weight / self.sigma_rad)[:, None, None]
        seen = rotation[self.second] @ rotation[self.first].transpose(0, 2, 1)
        jacobians = ((self.second, known * np.eye(3)), (self.first, -known * seen))
        add_pairwise(
            information[:, :3, :, :3], gradient[:, :3], jacobians, residual * root_weight[:, None]
        )


def relative_rotation_factor(
    first: Ints, second: Ints, ned_from_camera: Array
) -> RelativeRotationFactor | None:
    """Factor of pairs of cameras by attitudes (C, 3, 3), nan where missing; None if all are."""
    second_from_first = ned_from_camera[second].transpose(0, 2, 1) @ ned_from_camera[first]
    measured = np.isfinite(second_from_first).all((1, 2))
    return (
        RelativeRotationFactor.with_typical_errors(
            first[measured], second[measured], second_from_first[measured]
        )
        if measured.any()
        else None
    )
