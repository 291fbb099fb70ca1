"""Course of the smooth odometry: its map, its last pose and velocity, its drift and resets."""

from __future__ import annotations

import numpy as np

from companion.estimation.body.body_filter import BodyFilter
from companion.estimation.body.reckoning import Reckoning
from companion.estimation.camera_motion import SIGMA_DEAD_RECKONING_M_S
from companion.estimation.georeference.trajectory_alignment import SIGMA_YAW_RAD
from companion.estimation.odometry.flown_map import FlownMap, LastPose
from companion.estimation.odometry.jump_gate import JumpGate
from companion.estimation.odometry.odometry_drift import ALONG_ONE, OdometryDrift
from companion.geometry.transforms import Array, Pose
from companion.messages import Georeference, Odometry, Track, TrackState

FLOOR_M, FLOOR_RAD = 0.02, float(np.radians(0.3))
MAX_SIGMA_SCALE_AIDING = 0.05
"""Of a map that aids inertial navigation which is fair: with a worse scale it would give a wrong
velocity, and is not sent. Of one that is not, a worse map bounds the errors, by ten per cent of the
way."""
SIGMA_ATTITUDE_RAD = float(np.radians(1.0))
"""Of the autopilot's attitude over some seconds."""


class OdometryCourse:
    """State that the next pose goes on from, and odometry where the map gives none."""

    def __init__(self, camera_from_body: Pose, max_jump_m: float, body: BodyFilter) -> None:
        self.flown = FlownMap(camera_from_body)
        self.gate = JumpGate(max_jump_m)
        self.drift = OdometryDrift()
        self.body = body
        self.reckoning = Reckoning(body)
        self.velocity: Array = np.zeros(3)
        self.aided_sigma_scale = 0.0
        """Of the map that aided inertial navigation last, when it did."""
        self.dead_reckoning = False
        """True while the map does not give the poses."""
        self.given = False
        """True once a pose was given out."""
        self.reset_counter = 0

    def rough(self, sigma_scale: float) -> bool:
        """True for a scale that navigation should not go by, unless it goes by such a one."""
        return sigma_scale > MAX_SIGMA_SCALE_AIDING >= self.aided_sigma_scale

    def reset(self) -> None:
        """Begin poses that are unrelated to those before."""
        self.reset_counter += 1
        self.drift.clear()
        self.body.reset()

    def sigma_yaw_rad(self, georeference: Georeference | None, noise_rad: float) -> float:
        """Standard deviation of the heading against north.

        Of the georeference, of the difference to it that is not slewed yet, and noise; before there
        is one, of the autopilot's heading.
        """
        sigma_rad = float(SIGMA_YAW_RAD) if georeference is None else georeference.sigma_yaw_rad
        return float(np.linalg.norm([FLOOR_RAD, noise_rad, sigma_rad, self.flown.frame.yaw_rad]))

    def sigma_by_scale_m_s(self, sigma_scale: float) -> float:
        """Standard deviation of the velocity along each axis, by a scale that is off."""
        return ALONG_ONE * sigma_scale * float(np.linalg.norm(self.velocity))

    def none(self, track: Track) -> Odometry:
        """Odometry without a pose."""
        return Odometry(track.seq, track.t_ns, track.state, self.reset_counter)

    def reckoned(self, track: Track) -> Odometry:
        """Odometry without a pose by the map: by inertial navigation, as far as that knows it."""
        attitude, reckoned = self.reckoning.attitude, self.reckoning.reckoned
        if attitude is None or reckoned is None:
            return self.none(track)
        placed = Pose(self.reckoning.rotation(attitude), reckoned.place_m)
        self.velocity, self.dead_reckoning = reckoned.velocity_m_s, True
        georeference, slewed_m = self.flown.georeference, self.flown.frame.slewed_m
        sigma_scale = self.aided_sigma_scale
        self.flown.hold(track.t_ns, placed, reckoned.sigma_place_m)
        drift = self.drift.add(track.t_ns, placed.translation, sigma_scale, slewed_m)
        return Odometry(
            track.seq, track.t_ns, TrackState.DEAD_RECKONING, self.reset_counter, 1, placed,
            reckoned.velocity_m_s,
            float(np.linalg.norm([FLOOR_M, reckoned.sigma_place_m, *drift])),
            float(np.hypot(reckoned.sigma_velocity_m_s, self.sigma_by_scale_m_s(sigma_scale))),
            SIGMA_ATTITUDE_RAD,
            self.sigma_yaw_rad(georeference, SIGMA_ATTITUDE_RAD), inertial=True,
            sigma_scale=sigma_scale, sigma_by_scale_m=drift.by_scale_m,
            unaided_s=reckoned.unaided_s,
        )  # fmt: skip

    def dead_reckoned(
        self, track: Track, pose: Pose, raw: Pose, georeference: Georeference
    ) -> Odometry:
        """Odometry by dead reckoning: of lowest quality and growing uncertainty.

        `pose` is the camera's in the map, `raw` the body's in the world.
        """
        placed, last = self.flown.frame.from_world @ raw, self.flown.last
        if last is not None:
            dt_s = max((track.t_ns - last.t_ns) * 1e-9, 1e-3)
            self.velocity = (placed.translation - last.place_m) / dt_s
        self.dead_reckoning = True
        sigma_m = georeference.world_from_map.scale * track.sigma_position
        self.flown.last = LastPose(track.t_ns, pose, placed, sigma_m)
        return Odometry(
            track.seq, track.t_ns, track.state, self.reset_counter, 1, placed,
            self.velocity.copy(), max(FLOOR_M, sigma_m),
            SIGMA_DEAD_RECKONING_M_S, float(np.hypot(FLOOR_RAD, track.sigma_rotation_rad)),
            self.sigma_yaw_rad(georeference, track.sigma_rotation_rad),
        )  # fmt: skip
