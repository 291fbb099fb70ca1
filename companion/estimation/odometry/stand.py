"""A vehicle that stands on the ground: where, how certainly, and its odometry."""

from __future__ import annotations

import numpy as np

from companion.estimation.lift_off.ground_aiding import SIGMA_STANDING_M_S
from companion.geometry.transforms import Array, Pose
from companion.messages import Odometry, Track, TrackState

FRESH_NS, MAX_SIGMA_M = 300_000_000, 0.3
"""Of the place of a landing: older, or less certain, the place where it stands is another one."""
SIGMA_ATTITUDE_RAD = float(np.radians(1.0))
"""Of the autopilot's attitude over some seconds."""
FLOOR_M = 0.02


class Stand:
    """Place of the stand that began last, and what is known of it."""

    def __init__(self) -> None:
        self.begins_m: Array = np.zeros(3)
        """Place (3,) of a stand before any other is known."""
        self.in_world = False
        """True once satellites have placed the body, or its map."""
        self._sigma_m = 0.0
        """Of the place, since the last reset."""

    def begin(self, sigma_m: float, given: bool) -> bool:
        """Begin one where the body is known so well; False where that takes a reset.

        `given` once a pose was given out: the first place needs no certainty.
        """
        known = sigma_m <= MAX_SIGMA_M
        self._sigma_m = sigma_m if given and known else 0.0
        return known or not given

    def odometry(
        self, track: Track, reset_counter: int, placed: Pose, sigma_yaw_rad: float
    ) -> Odometry:
        """Odometry at this place, with the attitude as it is."""
        return Odometry(
            track.seq, track.t_ns, TrackState.STANDING, reset_counter, 100, placed, np.zeros(3),
            float(np.hypot(FLOOR_M, self._sigma_m)), SIGMA_STANDING_M_S, SIGMA_ATTITUDE_RAD,
            sigma_yaw_rad,
        )  # fmt: skip
