"""Cameras over the ground and the small turns that they are told wrongly by."""

from __future__ import annotations

import numpy as np

from companion.geometry.transforms import Array, rotation_from_vector

FOCAL = 400.0
LOOKING_DOWN = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
"""Rotation `camera_from_map`."""


def turned(rng: np.random.Generator, sigma_rad: float) -> Array:
    """A turn about any axis, by so much about each."""
    return rotation_from_vector(rng.normal(scale=sigma_rad, size=3))
