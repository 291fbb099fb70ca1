"""Velocity of the body in a frame that is tracked: by its filter, else by the last images."""

from __future__ import annotations

import numpy as np

from companion.estimation.body.body_state import Reckoned
from companion.estimation.camera_motion import ImageVelocity
from companion.geometry.transforms import Array

SIGMA_HELD_M_S2 = 3.0
"""Acceleration that may have come since, where none is measured."""
MAX_SIGMA_M_S = 2.0
"""Of a velocity of the filter, which has just begun: that of the last images is better."""


def tracked_velocity(
    moving: Reckoned | None, by_images: ImageVelocity | None, odometry_from_map: Array,
    noise_m: float,
) -> tuple[Array, float] | None:  # fmt: skip
    """Velocity (3,) in the frame of the odometry, m/s, and its standard deviation; None if unknown.

    `odometry_from_map` (3, 3) turns and scales velocities; places of the images are off by
    `noise_m`.
    """
    if moving is not None and moving.sigma_velocity_m_s < MAX_SIGMA_M_S:
        return moving.velocity_m_s, moving.sigma_velocity_m_s
    if by_images is None:
        return None
    span_s = by_images.span_s
    changed_m_s = SIGMA_HELD_M_S2 * span_s / 2.0
    sigma_m_s = float(np.hypot(np.sqrt(2.0) * noise_m / span_s, changed_m_s))
    return odometry_from_map @ by_images.map_units_s, sigma_m_s
