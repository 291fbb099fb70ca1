"""Heading of a frame without an origin after the lift-off: it follows an autopilot's alignment.

On the ground a compass is disturbed by what lies there; ArduPilot aligns its heading anew on the
way up, in one step (EKF3: "in-flight yaw alignment complete"). A frame that kept the first would be
skew against the autopilot's for the whole flight. PX4's step goes by a single reading of its
compass: its heading swings for seconds after it, by 14 degrees to either side in its simulator, so
that the mean after a step is followed. What a heading drifts by otherwise is its own error, and an
autopilot that finds its heading by our poses would drift with a frame that follows.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from companion.estimation.odometry.odometry_frame import MAX_SLEW_RAD_S, OdometryFrame
from companion.geometry.transforms import Array, Pose, yaw_angle

WITHIN_NS = 20_000_000_000
"""After a lift-off; ArduPilot aligns its heading below five metres."""
AVERAGED_NS = 10_000_000_000
"""After a step; PX4's heading takes six to eight seconds to settle."""
NEAR_M = 3.0
"""Level way from the lift-off within which turning about it moves the body but little."""
STEP_RAD, DRIFT_RAD_NS = np.radians(1.5), np.radians(12.5) * 1e-9
"""Least change against ours from one frame to the next, and more than comes in this time without a
step: the heading of PX4, which drifts as its motors start, changes by 12 degrees/s at most in its
simulator. A busy computer leaves frames out, and a step may come between."""


class _LiftOff(NamedTuple):
    """Time, reset counter and place (3,) of a lift-off."""

    t_ns: int
    reset_counter: int
    place_m: Array


class _Step(NamedTuple):
    """Time of the last step, and the mean of the N headings since, against ours at the lift-off."""

    t_ns: int
    mean_rad: float
    n: int


class LiftOffHeading:
    """Turns the frame about the place of the last lift-off, slowly."""

    def __init__(self) -> None:
        self._last: _LiftOff | None = None
        self._before: tuple[int, float] | None = None
        """Time, and the autopilot's heading against ours as it was at the lift-off."""
        self._step: _Step | None = None
        self._turned_rad = 0.0
        self._young: tuple[int, Array] | None = None
        """Map that is not flown on yet, and the rotation (3, 3) ned_from_map of its first frame."""

    def lift_off(self, t_ns: int, reset_counter: int, place_m: Array) -> None:
        """Take the place (3,) of a lift-off, in the frame as it is between two resets."""
        self._last, self._before = _LiftOff(t_ns, reset_counter, place_m), None
        self._step, self._turned_rad, self._young = None, 0.0, None

    def foresee(self, t_ns: int, segment: int, ned_from_map: Array) -> None:
        """Take the attitude (3, 3) of a map that is too young to be flown on.

        It will go on from its first view, with the heading of then.
        """
        if self._last is None:
            return
        if self._young is None or self._young[0] != segment:
            self._young = segment, ned_from_map
        off_rad = yaw_angle(ned_from_map @ self._young[1].T)
        self._average(t_ns, off_rad, t_ns - self._last.t_ns < WITHIN_NS)
        self._before = t_ns, off_rad

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
        off_rad = yaw_angle(ned_from_body @ placed.rotation.T) + self._turned_rad
        self._average(t_ns, off_rad, t_ns - last.t_ns < WITHIN_NS)
        self._before = t_ns, off_rad
        owed_rad = 0.0 if self._step is None else self._step.mean_rad - self._turned_rad
        most_rad = float(MAX_SLEW_RAD_S) * dt_s
        by_rad = float(np.clip(owed_rad, -most_rad, most_rad))
        self._turned_rad += by_rad
        return frame.turned(last.place_m, by_rad, placed.translation) if by_rad else frame

    def _average(self, t_ns: int, off_rad: float, may_step: bool) -> None:
        """Begin a mean with each step; else take another heading into that which has begun."""
        step, before = self._step, self._before
        if before is not None and may_step:
            change_rad = _within_half_turn(off_rad - before[1])
            if abs(change_rad) > max(STEP_RAD, DRIFT_RAD_NS * (t_ns - before[0])):
                now_rad = before[1] + change_rad
                self._step = _Step(t_ns, now_rad, 1)
                return
        if step is not None and t_ns - step.t_ns < AVERAGED_NS:
            more_rad = _within_half_turn(off_rad - step.mean_rad) / (step.n + 1)
            self._step = _Step(step.t_ns, step.mean_rad + more_rad, step.n + 1)


def _within_half_turn(angle_rad: float) -> float:
    return float((angle_rad + np.pi) % (2 * np.pi) - np.pi)
