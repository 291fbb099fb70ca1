"""Gravity factor of bundle adjustment: each camera's down direction by the autopilot.

Attitude errors are tenths of a degree with correlation times of seconds, those of images usually
hundredths; but attitude does not drift with a map of little texture, such as at the start of a
climb.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from companion.geometry.transforms import Array, skew

MIN_SIGMA_RAD, MAX_SIGMA_RAD = np.radians(0.3), np.radians(1.0)
"""Bounds of the standard deviation: larger disagreement is due to the map, not the attitude."""
MAX_DISAGREEMENT_RAD = np.radians(4.0)
"""Disagreement beyond which the attitude is not that of the camera."""
CORRELATION_INFLATION = 2.0
"""Inflation of sigma, as consecutive attitude errors are correlated."""
HUBER = 2.0
MIN_MEASURED = 5


@dataclass(frozen=True, slots=True, eq=False)
class GravityFactor:
    """Down by the autopilot in camera axes (C, 3), and in map axes (3,).

    `down_camera` is nan where missing. `sigma_rad` is one standard deviation.
    """

    down_camera: Array
    down_map: Array
    sigma_rad: float

    def errors(self, rotation: Array) -> tuple[Array, Array]:
        """Whitened errors (C, 3) of `camera_from_map` rotations, and their norms."""
        residual = np.nan_to_num((rotation @ self.down_map - self.down_camera) / self.sigma_rad)
        return residual, np.linalg.norm(residual, axis=1)

    def cost(self, rotation: Array, translation: Array) -> float:
        """Huber's loss."""
        _, size = self.errors(rotation)
        return float(np.where(size < HUBER, 0.5 * size**2, HUBER * (size - 0.5 * HUBER)).sum())

    def add_normal_equations(
        self, information: Array, gradient: Array, rotation: Array, translation: Array
    ) -> None:
        """As of a Factor."""
        measured = np.flatnonzero(np.isfinite(self.down_camera[: len(gradient), 0]))
        residual, size = self.errors(rotation)
        jacobian = -skew(rotation[measured] @ self.down_map) / self.sigma_rad
        weight = np.minimum(1.0, HUBER / np.maximum(size[measured], 1e-9))
        weighted = jacobian.transpose(0, 2, 1) * weight[:, None, None]
        information[measured, :3, measured, :3] += weighted @ jacobian
        gradient[measured, :3] += (weighted @ residual[measured, :, None])[..., 0]


def gravity_in_map(rotation: Array, down_camera: Array) -> tuple[Array, float] | None:
    """Down in a map (3,), and its standard deviation, rad, over `camera_from_map` (C, 3, 3).

    `down_camera` (C, 3) is nan where missing; None with too few measurements or too much
    disagreement.
    """
    measured = np.isfinite(down_camera[:, 0])
    if np.count_nonzero(measured) < MIN_MEASURED:
        return None
    inside = np.matmul(rotation[measured].transpose(0, 2, 1), down_camera[measured][..., None])[
        ..., 0
    ]
    down = np.median(inside, axis=0)
    down /= max(float(np.linalg.norm(down)), 1e-9)
    residual = np.linalg.norm(inside - down, axis=1)
    sigma_rad = float(np.median(residual)) / 1.18  # of each of two axes
    if sigma_rad > MAX_DISAGREEMENT_RAD:
        return None
    return down, float(np.clip(sigma_rad, MIN_SIGMA_RAD, MAX_SIGMA_RAD)) * CORRELATION_INFLATION
