"""Pose messages: the one place where poses leave our frames and units.

The world of a pose is NED-aligned and metric; MAV_FRAME_BODY_FRD is our body.

Covariances are of the axes of a message's frame. Those of positions and velocities are isotropic,
and so the same in any frame; of the attitude, tilt about the level axes stands for roll and pitch,
heading about the down axis for yaw.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.estimation.gate.pose_to_send import PoseToSend
from companion.geometry.transforms import Array, quaternion_from_rotation
from drivers.mavlink.vehicle import Firmware

N_COVARIANCE = 21
ROW_STARTS = (0, 6, 11, 15, 18, 20)
"""Indices of the diagonal of a 6 x 6 matrix in its upper triangle, row by row."""
FRAMES: dict[Firmware, int] = {
    "ardupilot": mavlink.MAV_FRAME_LOCAL_FRD,
    "px4": mavlink.MAV_FRAME_LOCAL_NED,
    "other": mavlink.MAV_FRAME_LOCAL_FRD,
}
"""ArduPilot takes no other than LOCAL_FRD, and takes it for NED. PX4 turns one by what its compass
differs from our heading, which changes: in its simulator by 5 degrees, 2 m at 20 m from home."""
UNKNOWN = [math.nan] * N_COVARIANCE


def pose_messages(pose: PoseToSend, mode: str, firmware: Firmware) -> tuple[Any, ...]:
    """Messages of a pose, as `feedback.mode` and the autopilot want them.

    ArduPilot takes each velocity to be as good as VISO_VEL_M_NSE says, whatever is stated: of
    accelerometers alone it gets none.
    """
    if pose.unaided and firmware != "px4":
        return () if mode == "velocity" else vision_messages(pose)[:1]
    if mode == "velocity":
        return (velocity_message(pose, firmware),)
    return (odometry_message(pose, firmware),) if mode == "odometry" else vision_messages(pose)


def velocity_message(pose: PoseToSend, firmware: Firmware) -> Any:
    """The velocity of a pose alone: ODOMETRY whose pose is nan for PX4, else a speed estimate."""
    if firmware != "px4":
        return vision_messages(pose)[1]
    message = odometry_message(pose, firmware)
    message.x = message.y = message.z = math.nan
    message.q = [math.nan] * 4
    message.pose_covariance = list(UNKNOWN)
    return message


def odometry_message(pose: PoseToSend, firmware: Firmware) -> Any:
    """ODOMETRY: position and attitude in NED, velocity in BODY_FRD, microseconds."""
    rotation = pose.world_from_body.rotation
    position = pose.world_from_body.translation
    velocity_body = rotation.T @ pose.velocity_world_m_s
    return mavlink.MAVLink_odometry_message(
        time_usec=pose.t_ns // 1000,
        frame_id=FRAMES[firmware],
        child_frame_id=mavlink.MAV_FRAME_BODY_FRD,
        x=float(position[0]), y=float(position[1]), z=float(position[2]),
        q=[float(each) for each in quaternion_from_rotation(rotation)],
        vx=float(velocity_body[0]), vy=float(velocity_body[1]), vz=float(velocity_body[2]),
        rollspeed=math.nan, pitchspeed=math.nan, yawspeed=math.nan,
        pose_covariance=_pose_covariance(pose),
        velocity_covariance=_covariance(pose.sigma_velocity_m_s, math.nan, math.nan),
        reset_counter=pose.reset_counter,
        estimator_type=mavlink.MAV_ESTIMATOR_TYPE_VIO,
        quality=pose.quality,
    )  # fmt: skip


def vision_messages(pose: PoseToSend) -> tuple[Any, Any]:
    """VISION_POSITION_ESTIMATE and VISION_SPEED_ESTIMATE, for firmware without ODOMETRY."""
    position, velocity = pose.world_from_body.translation, pose.velocity_world_m_s
    roll, pitch, yaw = euler_of(pose.world_from_body.rotation)
    variance = pose.sigma_velocity_m_s**2
    return (
        mavlink.MAVLink_vision_position_estimate_message(
            usec=pose.t_ns // 1000,
            x=float(position[0]), y=float(position[1]), z=float(position[2]),
            roll=roll, pitch=pitch, yaw=yaw,
            covariance=_pose_covariance(pose),
            reset_counter=pose.reset_counter,
        ),
        mavlink.MAVLink_vision_speed_estimate_message(
            usec=pose.t_ns // 1000,
            x=float(velocity[0]), y=float(velocity[1]), z=float(velocity[2]),
            covariance=[variance, 0.0, 0.0, 0.0, variance, 0.0, 0.0, 0.0, variance],
            reset_counter=pose.reset_counter,
        ),
    )  # fmt: skip


def euler_of(rotation: Array) -> tuple[float, float, float]:
    """Roll, pitch, yaw (rad) of `ned_from_body`, order yaw, pitch, roll."""
    pitch = -math.asin(float(np.clip(rotation[2, 0], -1.0, 1.0)))
    roll = math.atan2(float(rotation[2, 1]), float(rotation[2, 2]))
    return roll, pitch, math.atan2(float(rotation[1, 0]), float(rotation[0, 0]))


def _pose_covariance(pose: PoseToSend) -> list[float]:
    return _covariance(pose.sigma_position_m, pose.sigma_attitude_rad, pose.sigma_yaw_rad)


def _covariance(sigma_linear: float, sigma_level: float, sigma_down: float) -> list[float]:
    """Upper triangle (21,) of a diagonal matrix; m^2 or (m/s)^2, and rad^2 about the axes.

    nan for an unknown angle, and for everything where the first is unknown.
    """
    if not math.isfinite(sigma_linear):
        return list(UNKNOWN)
    sigmas = [sigma_linear] * 3 + [sigma_level] * 2 + [sigma_down]
    out = [0.0] * N_COVARIANCE
    for at, sigma in zip(ROW_STARTS, sigmas, strict=True):
        out[at] = sigma**2 if math.isfinite(sigma) else math.nan
    return out
