"""Heading of a frame without an origin after the lift-off: it follows an autopilot's alignment.

On the ground a compass is disturbed by what lies there; ArduPilot aligns its heading anew on the
way up, in one step (EKF3: "in-flight yaw alignment complete"). A frame that kept the first would be
skew against the autopilot's for the whole flight. Only that step is followed: what its heading
drifts by otherwise is its own error, and an autopilot that finds its heading by our poses would
drift with a frame that follows.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from companion.estimation.odometry.odometry_frame import MAX_SLEW_RAD_S, OdometryFrame
from companion.geometry.transforms import Array, Pose, yaw_angle

WITHIN_NS = 20_000_000_000
"""After a lift-off; ArduPilot aligns its heading below five metres."""
NEAR_M = 3.0
"""Level way from the lift-off within which turning about it moves the body but little."""
STEP_RAD, STEP_NS = np.radians(1.5), 120_000_000
"""Least change against ours in so short a time: the heading of PX4, which drifts as its motors
start, changes by 12 degrees/s at most in its simulator."""


class _LiftOff(NamedTuple):
    """Time, reset counter and place (3,) of a lift-off."""

    t_ns: int
    reset_counter: int
    place_m: Array


class LiftOffHeading:
    """Turns the frame about the place of the last lift-off, slowly."""

    def __init__(self) -> None:
        self._last: _LiftOff | None = None
        self._off: tuple[int, float] | None = None
        """Time, and the autopilot's heading against ours then."""
        self._owed_rad = 0.0
        """Part of the steps that the frame has not turned by yet."""

    def lift_off(self, t_ns: int, reset_counter: int, place_m: Array) -> None:
        """Take the place (3,) of a lift-off, in the frame as it is between two resets."""
        self._last, self._off, self._owed_rad = _LiftOff(t_ns, reset_counter, place_m), None, 0.0

    def turned(
        self, frame: OdometryFrame, t_ns: int, world_from_body: Pose, ned_from_body: Array | None,
        reset_counter: int, dt_s: float,
    ) -> OdometryFrame:  # fmt: skip
        """The frame after a time in which the body was there, with an attitude (3, 3)."""
        last = self._last
        if frame.anchored or ned_from_body is None or last is None:
            return frame
        placed = frame.from_world @ world_from_body
        way_m = float(np.linalg.norm((placed.translation - last.place_m)[:2]))
        if last.reset_counter != reset_counter or way_m > NEAR_M:
            self._last = None
            return frame
        off_rad = yaw_angle(ned_from_body @ placed.rotation.T)
        if self._off is not None and t_ns - last.t_ns < WITHIN_NS:
            before_ns, before_rad = self._off
            change_rad = (off_rad - before_rad + np.pi) % (2 * np.pi) - np.pi
            if abs(change_rad) > STEP_RAD and t_ns - before_ns <= STEP_NS:
                self._owed_rad += change_rad
        most_rad = float(MAX_SLEW_RAD_S) * dt_s
        step_rad = float(np.clip(self._owed_rad, -most_rad, most_rad))
        self._owed_rad -= step_rad
        self._off = t_ns, off_rad - step_rad
        return frame.turned(last.place_m, step_rad, placed.translation) if step_rad else frame
