"""Rules by which a single pose may be sent to the autopilot, and the reasons why not.

A pose must be metric, tracked, certain, of sufficient quality, level by the autopilot's own
attitude, and recent. What cannot be checked is not sent.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from companion.config import FeedbackConfig
from companion.geometry.transforms import Array
from companion.messages import Odometry, TrackState

MAX_TILT_ERROR_RAD = np.radians(8.0)
MAX_AGE_NS = 300_000_000
"""An older pose is of no use to an autopilot."""
MAX_SIGMA_SCALE = 0.05
"""Relative; with it velocities are 5 % off, 0.5 m/s at 10 m/s, which an autopilot's EKF takes for
noise: ArduPilot's VISO_VEL_M_NSE is 0.1 m/s and more, its innovation gates are five of these."""
HYSTERESIS = 0.8
"""To start sending, a pose must be better than the limits by this factor."""
MAX_EXTENT_M = 1e5

INITIALISING = "initialising"
LOST = "lost"
NO_SCALE = "no metric scale"
SCALE_UNCERTAIN = "scale too uncertain"
UNPROVED_IMU = "IMU being checked"
UNCERTAIN = "position too uncertain"
POOR = "quality too low"
TILTED = "tilt differs from the autopilot's"
LATE = "poses come too late"
NO_ATTITUDE = "no autopilot attitude"
NO_MOUNT = "camera mount is not known"


@dataclass(frozen=True, slots=True)
class Before:
    """State before a pose: whether poses are sent.

    With `may_bridge` inertial dead reckoning may stand for tracking.
    """

    sending: bool
    may_bridge: bool


def rejection_reason(
    odometry: Odometry, now_ns: int, attitude: Array | None, before: Before, config: FeedbackConfig
) -> str:
    """Reason why a pose is rejected at the time of the call; "" if it may be sent.

    `attitude` is ned_from_body (3, 3) by the autopilot at the time of the pose, None if unknown.
    """
    pose, velocity = odometry.world_from_body, odometry.velocity_world_m_s
    if odometry.state is TrackState.INITIALISING:
        return INITIALISING
    bridging = odometry.inertial and before.may_bridge
    seen = odometry.state in (TrackState.TRACKING, TrackState.STANDING)
    if not seen and not bridging:
        return LOST
    if pose is None and odometry.state is TrackState.STANDING:
        return UNPROVED_IMU
    if pose is None or velocity is None:
        return NO_SCALE if odometry.state is TrackState.TRACKING else LOST
    parts = pose.rotation, pose.translation, velocity
    if (
        not all(np.isfinite(part).all() for part in parts)
        or np.abs(pose.translation).max() > MAX_EXTENT_M
        or not np.isfinite(odometry.sigma_velocity_m_s)  # the velocity is an old one
    ):
        return UNCERTAIN
    if not np.isfinite(odometry.sigma_attitude_rad):
        return NO_MOUNT
    hysteresis = 1.0 if before.sending else HYSTERESIS
    if not sigma_place_m(odometry) <= hysteresis * config.max_sigma_m:
        return UNCERTAIN
    if not odometry.sigma_scale <= hysteresis * MAX_SIGMA_SCALE:
        return SCALE_UNCERTAIN
    if odometry.quality * hysteresis < config.min_quality and not bridging:
        return POOR
    if now_ns - odometry.t_ns > MAX_AGE_NS:
        return LATE
    if attitude is None:
        return NO_ATTITUDE
    cosine = float(np.clip(attitude[2] @ pose.rotation[2], -1.0, 1.0))
    return TILTED if not np.arccos(cosine) <= MAX_TILT_ERROR_RAD * hysteresis else ""


def sigma_place_m(odometry: Odometry) -> float:
    """Standard deviation of the place apart from the scale.

    A scale that is off shortens all ways alike, and no place where the body stands.
    """
    return float(np.sqrt(odometry.sigma_position_m**2 - odometry.sigma_by_scale_m**2))
