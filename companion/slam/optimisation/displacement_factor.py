"""Displacement factor of bundle adjustment: camera displacements from integrated velocity.

Over seconds integrated velocity is wrong by a few per cent, images by a few per mille; but its
errors do not grow with the map, nor in scenes with little texture.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from companion.geometry.transforms import Array
from companion.slam.features.orb_features import Ints
from companion.slam.optimisation.factors import add_pairwise, cauchy_cost, cauchy_root_weight

MIN_MEASURED = 5
MAX_TYPICAL_ERROR = 4.0
"""Typical error, in standard deviations, of displacements that are not those of the camera."""


@dataclass(frozen=True, slots=True, eq=False)
class DisplacementFactor:
    """Displacements (E, 3) from cameras `first` (E,) to `second` (E,), nan if missing.

    In world axes; `world_from_map` (3, 3) is rotation times scale. `sigma_m` (E,) is one standard
    deviation of each axis.
    """

    first: Ints
    second: Ints
    displacement_m: Array
    sigma_m: Array
    world_from_map: Array

    def errors(self, rotation: Array, translation: Array) -> tuple[Array, Array]:
        """Whitened errors (E, 3) of `camera_from_map` poses, and their norms (E,)."""
        centre = -np.matmul(rotation.transpose(0, 2, 1), translation[..., None])[..., 0]
        displacement_m = (centre[self.second] - centre[self.first]) @ self.world_from_map.T
        residual = np.nan_to_num((displacement_m - self.displacement_m) / self.sigma_m[:, None])
        return residual, np.linalg.norm(residual, axis=1)

    def cost(self, rotation: Array, translation: Array) -> float:
        """As of a Factor."""
        return cauchy_cost(self.errors(rotation, translation)[1])

    def add_normal_equations(
        self, information: Array, gradient: Array, rotation: Array, translation: Array
    ) -> None:
        """As of a Factor."""
        residual, size = self.errors(rotation, translation)
        root_weight = cauchy_root_weight(size)
        known = (np.isfinite(self.displacement_m) * (root_weight / self.sigma_m)[:, None])[
            ..., None
        ]
        first, second = (
            self.world_from_map @ rotation[camera].transpose(0, 2, 1)
            for camera in (self.first, self.second)
        )
        jacobians = ((self.first, known * first), (self.second, -known * second))
        add_pairwise(
            information[:, 3:, :, 3:], gradient[:, 3:], jacobians, residual * root_weight[:, None]
        )


def typical_error(factor: DisplacementFactor, rotation: Array, translation: Array) -> float | None:
    """Median normalised error of displacements against a map; None if they do not fit it."""
    _, size = factor.errors(rotation, translation)
    if len(size) < MIN_MEASURED:
        return None
    usual = float(np.median(size)) / 1.54  # of three axes
    return usual if usual < MAX_TYPICAL_ERROR else None
