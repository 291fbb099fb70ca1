"""A pose as it goes to the autopilot, and its prediction."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from companion.estimation.gate.held_velocity import Growth
from companion.geometry.transforms import Array, Pose


@dataclass(frozen=True, slots=True, eq=False)
class PoseToSend:
    """A pose for the autopilot at `t_ns`, in NED-aligned metres; see Odometry.

    Its down axis may be offset against that of an Odometry, to start at that of the autopilot.
    """

    t_ns: int
    world_from_body: Pose
    velocity_world_m_s: Array
    sigma_position_m: float
    sigma_velocity_m_s: float
    sigma_attitude_rad: float
    sigma_yaw_rad: float
    quality: int
    reset_counter: int
    predicted: bool = False
    unaided: bool = False
    """Of accelerometers alone: it tells an autopilot nothing that it does not know by its own."""

    def repeated(self, n: int) -> PoseToSend:
        """The pose as the last of `n` by accelerometers alone, whose error is one and the same.

        An autopilot takes the errors of poses for independent, and would weigh this one `n` times.
        """
        return replace(
            self, sigma_position_m=self.sigma_position_m * n**0.5,
            sigma_velocity_m_s=self.sigma_velocity_m_s * n**0.5, unaided=True,
        )  # fmt: skip

    def ahead(
        self, ahead_ns: int, attitude: Array, attitude_ahead: Array, grown: Growth
    ) -> PoseToSend:
        """The pose so much later, extrapolated by its velocity and turned as the attitude has.

        Attitudes are ned_from_body (3, 3) of the autopilot, at the pose's time and at the later;
        place and velocity have `grown` less certain.
        """
        ahead_s = ahead_ns * 1e-9
        pose = Pose(
            self.world_from_body.rotation @ attitude.T @ attitude_ahead,
            self.world_from_body.translation + self.velocity_world_m_s * ahead_s,
        )
        return replace(
            self, t_ns=self.t_ns + ahead_ns, world_from_body=pose, predicted=True,
            sigma_position_m=float(np.hypot(self.sigma_position_m, grown.place_m)),
            sigma_velocity_m_s=float(np.hypot(self.sigma_velocity_m_s, grown.velocity_m_s)),
        )  # fmt: skip
