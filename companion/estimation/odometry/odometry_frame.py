"""Frame of the smooth odometry in the world, and how corrections of the world reach it: slowly."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from companion.estimation.georeference.trajectory_alignment import DRIFT_TAU_S
from companion.geometry.transforms import Array, Pose, yaw_angle, yaw_rotation

MAX_SLEW_M_S = 0.15
MAX_SLEW_RAD_S = np.radians(0.5)
MAX_WITHIN_M = 1.0
"""Satellites are off by as much for minutes. What they scatter by about the camera's path, up to
this, is what their mean cannot tell; to follow it would move a vehicle that holds its place."""


class MapView(NamedTuple):
    """Time of a keyframe, and its pose in the map."""

    t_ns: int
    map_from_camera: Pose


class OdometryState(NamedTuple):
    """State to continue in the same frame: see `SmoothOdometry.resume`."""

    odometry_from_world: Pose
    anchored: bool
    position_m: Array
    """Position (3,) of the body in the odometry frame when last tracked."""
    velocity_m_s: Array
    """Velocity (3,) of the body in the odometry frame at that time."""


@dataclass(frozen=True, slots=True, eq=False)
class OdometryFrame:
    """A frame that differs from the world by a heading and a place.

    `settled_from_world` is where it would be without a limit to what moves a pose at once; it is
    slewed there. Corrections of the map leave that as it is, so that known ground has the same
    coordinates again. What is learnt of where the map lies in the world moves both: it says nothing
    of the body's motion. An `anchored` one, which began with a world position, settles northward,
    and as near to the world as satellites can tell. `slewed_m` (3,) is all that was slewed so far.
    """

    from_world: Pose = field(default_factory=Pose.identity)
    anchored: bool = False
    settled_from_world: Pose = field(default_factory=Pose.identity)
    slewed_m: Array = field(default_factory=lambda: np.zeros(3))

    @staticmethod
    def settled(from_world: Pose, anchored: bool, slewed_m: Array) -> OdometryFrame:
        """A frame that owes nothing."""
        return OdometryFrame(from_world, anchored, from_world, slewed_m)

    @property
    def yaw_rad(self) -> float:
        """Heading of the world in this frame."""
        return yaw_angle(self.from_world.rotation)

    def shifted(self, correction_m: Array) -> OdometryFrame:
        """Moved (3,) for a pose that goes on; to be slewed back."""
        moved = Pose(self.from_world.rotation, self.from_world.translation + correction_m)
        return replace(self, from_world=moved)

    def owing(self, correction_m: Array) -> OdometryFrame:
        """The same where it settles elsewhere by a correction (3,)."""
        settled = self.settled_from_world
        moved = Pose(settled.rotation, settled.translation + correction_m)
        return replace(self, settled_from_world=moved)

    def corrected(self, placed: Pose, world_from_body: Pose) -> OdometryFrame:
        """After a correction of the map, by which `placed` is another `world_from_body`.

        The pose goes on; to be slewed.
        """
        turn = yaw_rotation(yaw_angle(placed.rotation @ world_from_body.rotation.T))
        at = placed.translation - turn @ world_from_body.translation
        return replace(self, from_world=Pose(turn, at))

    def holding(self, placed: Pose, world_from_body: Pose) -> OdometryFrame:
        """The same after the map was placed otherwise in the world: nothing is to be slewed."""
        owed = self.settled_from_world @ self.from_world.inverse()
        held = self.corrected(placed, world_from_body)
        return replace(held, settled_from_world=owed @ held.from_world)

    def turned(self, about_m: Array, by_rad: float, here_m: Array) -> OdometryFrame:
        """Turned about a place (3,) of this frame, with the body at another (3,)."""
        turn = yaw_rotation(by_rad)
        about = Pose(turn, about_m - turn @ about_m)
        return replace(
            self, from_world=about @ self.from_world,
            settled_from_world=about @ self.settled_from_world,
            slewed_m=self.slewed_m + about.apply(here_m) - here_m,
        )  # fmt: skip

    def slewed(self, world_from_body: Pose, dt_s: float, within_m: float = 0.0) -> OdometryFrame:
        """After a time in which the body was there: nearer to where it settles.

        The whole correction may be large, and an autopilot would fly it. An anchored frame settles
        within a distance of the world, `MAX_WITHIN_M` at most.
        """
        body_m = world_from_body.translation
        settled = self.settled_from_world
        if self.anchored:
            settled = _near_world(settled, body_m, min(within_m, MAX_WITHIN_M))
        here_m, goal_m = self.from_world.apply(body_m), settled.apply(body_m)
        owed_rad = yaw_angle(settled.rotation @ self.from_world.rotation.T)
        most_rad = float(MAX_SLEW_RAD_S) * dt_s
        turn = yaw_rotation(self.yaw_rad + float(np.clip(owed_rad, -most_rad, most_rad)))
        away = here_m - goal_m
        far = float(np.linalg.norm(away))
        at = goal_m + max(far - MAX_SLEW_M_S * dt_s, 0.0) / max(far, 1e-12) * away
        return replace(
            self, from_world=Pose(turn, at - turn @ body_m), settled_from_world=settled,
            slewed_m=self.slewed_m + at - here_m,
        )  # fmt: skip


def drift_m(residual_m: float, span_s: float) -> float:
    """Error of satellites over minutes, by what they scatter by over a time.

    Of an error that lasts for `DRIFT_TAU_S` little shows in a few seconds: their mean is off by it.
    """
    spans = max(span_s / DRIFT_TAU_S, 1e-3)
    seen = 1.0 - 2.0 / spans * (1.0 - (1.0 - float(np.exp(-spans))) / spans)
    return residual_m / float(np.sqrt(seen))


def _near_world(settled_from_world: Pose, body_m: Array, within_m: float) -> Pose:
    """A frame turned north about a body (3,), and within a distance of the world there."""
    away = settled_from_world.apply(body_m) - body_m
    far = float(np.linalg.norm(away))
    return Pose(np.eye(3), min(1.0, within_m / max(far, 1e-12)) * away)
