"""Frame of the smooth odometry in the world, and how corrections of the world reach it: slowly."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from companion.geometry.transforms import Array, Pose, yaw_angle, yaw_rotation

MAX_SLEW_M_S = 0.15
MAX_SLEW_RAD_S = np.radians(0.5)


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

    `anchored` where it began with a world position: it is then slewed towards the world. Another
    stays where it is, but for `owed_m` (3,), which a reacquisition left to be slewed. `slewed_m`
    (3,) is all that was slewed so far.
    """

    from_world: Pose = field(default_factory=Pose.identity)
    anchored: bool = False
    owed_m: Array = field(default_factory=lambda: np.zeros(3))
    slewed_m: Array = field(default_factory=lambda: np.zeros(3))

    @property
    def yaw_rad(self) -> float:
        """Heading of the world in this frame."""
        return yaw_angle(self.from_world.rotation)

    def shifted(self, correction_m: Array) -> OdometryFrame:
        """Moved (3,) for a pose that goes on; to be slewed back."""
        moved = Pose(self.from_world.rotation, self.from_world.translation + correction_m)
        return replace(self, from_world=moved, owed_m=self.owed_m - correction_m)

    def holding(self, placed: Pose, world_from_body: Pose) -> OdometryFrame:
        """With a place and heading `placed` kept that are another `world_from_body` from now on."""
        turn = yaw_rotation(yaw_angle(placed.rotation @ world_from_body.rotation.T))
        at = placed.translation - turn @ world_from_body.translation
        return replace(self, from_world=Pose(turn, at))

    def turned(self, about_m: Array, by_rad: float, here_m: Array) -> OdometryFrame:
        """Turned about a place (3,) of this frame, with the body at another (3,)."""
        turn = yaw_rotation(by_rad)
        at = about_m + turn @ (self.from_world.translation - about_m)
        moved_m = about_m + turn @ (here_m - about_m) - here_m
        return replace(
            self, from_world=Pose(turn @ self.from_world.rotation, at), owed_m=turn @ self.owed_m,
            slewed_m=self.slewed_m + moved_m,
        )  # fmt: skip

    def slewed(self, world_from_body: Pose, dt_s: float) -> OdometryFrame:
        """After a time in which the body was there: towards the world, or what is owed.

        The whole correction may be large, and an autopilot would fly it.
        """
        if not self.anchored:
            owed_m = float(np.linalg.norm(self.owed_m))
            step = self.owed_m * min(1.0, MAX_SLEW_M_S * dt_s / max(owed_m, 1e-12))
            moved = Pose(self.from_world.rotation, self.from_world.translation + step)
            return replace(
                self, from_world=moved, owed_m=self.owed_m - step, slewed_m=self.slewed_m + step
            )
        here = self.from_world @ world_from_body
        yaw, most = self.yaw_rad, float(MAX_SLEW_RAD_S) * dt_s
        turn = yaw_rotation(yaw - float(np.clip(yaw, -most, most)))
        away = here.translation - world_from_body.translation
        far = float(np.linalg.norm(away))
        remaining = max(far - MAX_SLEW_M_S * dt_s, 0.0) / max(far, 1e-12)
        at = world_from_body.translation + remaining * away
        return replace(
            self,
            from_world=Pose(turn, at - turn @ world_from_body.translation),
            slewed_m=self.slewed_m + at - here.translation,
        )
