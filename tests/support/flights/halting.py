"""A path on which the vehicle circles, and then hovers."""

from __future__ import annotations

import math
import time

import numpy as np

from companion.geometry.transforms import Pose
from tests.support.cameras.http_camera import world_from_body

SWAY_M, SWAY_S = 0.1, 5.0
"""As a hovering vehicle sways: too little for GPS or barometer to tell a scale by."""


class Halting:
    """A circle, on which the vehicle stays where it is told to hover."""

    def __init__(self) -> None:
        self._since_ns: int | None = None

    def hover(self) -> None:
        self._since_ns = time.monotonic_ns()

    def __call__(self, monotonic_ns: int) -> Pose:
        since_ns = self._since_ns
        if since_ns is None or monotonic_ns < since_ns:
            return world_from_body(monotonic_ns)
        pose, after_s = world_from_body(since_ns), (monotonic_ns - since_ns) * 1e-9
        turn = 2 * math.pi * after_s / SWAY_S
        sway = np.array([math.sin(turn), math.sin(1.3 * turn), 0.0]) * SWAY_M
        return Pose(pose.rotation, pose.translation + sway)
