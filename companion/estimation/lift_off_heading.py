"""Heading of a frame without an origin near the lift-off: the autopilot's, as it is aligned anew.

On the ground a compass is disturbed by what lies there; autopilots align their heading anew on the
way up. A frame that kept the first would be skew against theirs for the whole flight.
"""

from __future__ import annotations

import numpy as np

from companion.estimation.odometry_frame import MAX_SLEW_RAD_S, OdometryFrame
from companion.geometry.transforms import Array, Pose, yaw_angle

NEAR_M = 3.0
"""Level way from the lift-off within which turning about it moves the body but little."""
MISALIGNED_RAD, ALIGNED_RAD = np.radians(1.0), np.radians(0.2)
"""Difference of headings to begin turning, and to end it: less than the first is noise, and an
autopilot whose heading is ours is never that far off."""


class LiftOffHeading:
    """Turns the frame about the place of the last lift-off, slowly."""

    def __init__(self) -> None:
        self._place: tuple[int, Array] | None = None
        """Reset counter and place (3,)."""
        self._turns = False

    def lift_off(self, reset_counter: int, place_m: Array) -> None:
        """Take the place (3,) of a lift-off, in the frame as it is between two resets."""
        self._place = reset_counter, place_m

    def turned(
        self, frame: OdometryFrame, world_from_body: Pose, ned_from_body: Array | None,
        reset_counter: int, dt_s: float,
    ) -> OdometryFrame:  # fmt: skip
        """The frame after a time in which the body was there, with an attitude (3, 3)."""
        if frame.anchored or ned_from_body is None or self._place is None:
            return frame
        placed, (counter, place_m) = frame.from_world @ world_from_body, self._place
        way_m = float(np.linalg.norm((placed.translation - place_m)[:2]))
        if counter != reset_counter or way_m > NEAR_M:
            return frame
        off_rad = yaw_angle(ned_from_body @ placed.rotation.T)
        self._turns = abs(off_rad) > (ALIGNED_RAD if self._turns else MISALIGNED_RAD)
        if not self._turns:
            return frame
        most_rad = float(MAX_SLEW_RAD_S) * dt_s
        step_rad = float(np.clip(off_rad, -most_rad, most_rad))
        return frame.turned(place_m, step_rad, placed.translation)
