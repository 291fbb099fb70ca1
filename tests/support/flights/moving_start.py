"""Flights that are in fast motion from the first frame on: to 8 m/s, with quick turns."""

from __future__ import annotations

import numpy as np

from companion.geometry.camera import Camera
from companion.geometry.transforms import Pose, rotation_from_vector
from tests.support.flights.rendered_flight import PathOf, leaning_path

RATE_HZ, EXPOSURE_S = 30.0, 1.0 / 100.0
FORWARD_DOWN = Pose(
    rotation_from_vector(np.array([0.0, -np.radians(55.0), 0.0]))
    @ np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]]),
    np.array([0.1, 0.0, 0.05]),
)
"""`body_from_camera` of a camera that looks forward and 55 degrees down."""
CAMERA = Camera(480, 360, 380.0, 380.0, 239.5, 179.5, body_from_camera=FORWARD_DOWN)
TURN_RAD, TURN_HZ = 1.7, 0.25
"""Of the heading: up to 150 degrees a second."""


def moving_path(seed: int) -> PathOf:
    """A copter's path, which leans into where it accelerates; at once at full speed."""
    rng = np.random.default_rng(seed)
    phases = rng.uniform(0, 2 * np.pi, 4)

    def place_m(after_s: float) -> np.ndarray:
        return np.array([
            9.0 * np.sin(0.8 * after_s + phases[0]), 7.0 * np.sin(0.6 * after_s + phases[1]),
            -14.0 - 2.0 * np.sin(0.5 * after_s + phases[2]),
        ])  # fmt: skip

    return leaning_path(
        place_m, lambda after_s: TURN_RAD * np.sin(2 * np.pi * TURN_HZ * after_s + phases[3])
    )
