"""Nadir cameras, and random attitude errors."""

from __future__ import annotations

import numpy as np

from companion.geometry.transforms import Array, rotation_from_vector

FOCAL = 400.0
LOOKING_DOWN = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
"""Rotation `camera_from_map`."""


def random_rotation(rng: np.random.Generator, sigma_rad: float) -> Array:
    """Rotation by a normally distributed rotation vector, `sigma_rad` about each axis."""
    return rotation_from_vector(rng.normal(scale=sigma_rad, size=3))
