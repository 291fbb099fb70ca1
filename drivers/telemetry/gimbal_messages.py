"""MAVLink messages of gimbals as samples: which axes their angles are in, and whose they are.

A gimbal device tells its attitude itself (GIMBAL_DEVICE_ATTITUDE_STATUS), or the autopilot tells it
for it; older autopilots send MOUNT_ORIENTATION or MOUNT_STATUS. Stamps of a gimbal are by its own
clock, and MOUNT_STATUS has none: what is not the autopilot's counts as measured on arrival.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.geometry.transforms import quaternion_from_euler
from companion.telemetry import GimbalSample

GIMBAL_IDS = (
    mavlink.MAVLINK_MSG_ID_GIMBAL_DEVICE_ATTITUDE_STATUS,
    mavlink.MAVLINK_MSG_ID_MOUNT_ORIENTATION,
    mavlink.MAVLINK_MSG_ID_MOUNT_STATUS,
)
"""Message types, best first."""
AUTOPILOT = mavlink.MAV_COMP_ID_AUTOPILOT1
SILENT_NS = 2_000_000_000
"""Another gimbal, or a worse message, is taken once that of before is silent for so long."""
EARTH, VEHICLE = (
    mavlink.GIMBAL_DEVICE_FLAGS_YAW_IN_EARTH_FRAME,
    mavlink.GIMBAL_DEVICE_FLAGS_YAW_IN_VEHICLE_FRAME,
)
WRONG_ANGLES = (
    mavlink.GIMBAL_DEVICE_ERROR_FLAGS_ENCODER_ERROR
    | mavlink.GIMBAL_DEVICE_ERROR_FLAGS_SOFTWARE_ERROR
    | mavlink.GIMBAL_DEVICE_ERROR_FLAGS_COMMS_ERROR
    | mavlink.GIMBAL_DEVICE_ERROR_FLAGS_CALIBRATION_RUNNING
)
"""Errors with which the angles mean nothing."""


def gimbal_of(message: Any) -> GimbalSample | None:
    """Sample of a message of GIMBAL_IDS, without a time yet; None without a valid attitude."""
    kind = message.get_msgId()
    if kind == mavlink.MAVLINK_MSG_ID_GIMBAL_DEVICE_ATTITUDE_STATUS:
        return device_sample(message.q, message.flags, message.failure_flags)
    if kind == mavlink.MAVLINK_MSG_ID_MOUNT_ORIENTATION:
        degrees = message.roll, message.pitch, message.yaw
    else:  # pitch, roll and yaw, hundredths of a degree
        degrees = (
            message.pointing_b * 1e-2, message.pointing_a * 1e-2, message.pointing_c * 1e-2
        )  # fmt: skip
    if not all(map(math.isfinite, degrees)):
        return None
    return GimbalSample(0, quaternion_from_euler(*map(math.radians, degrees)))


def device_sample(quaternion: Any, flags: int, failures: int) -> GimbalSample | None:
    """Sample of a gimbal device's quaternion w x y z; None where its angles mean nothing."""
    if failures & WRONG_ANGLES:
        return None
    said = flags & (EARTH | VEHICLE)
    if said == EARTH | VEHICLE:  # the protocol does not allow it
        return None
    # one that says neither, as of before these flags: a locked yaw is from north
    locked = bool(flags & mavlink.GIMBAL_DEVICE_FLAGS_YAW_LOCK)
    q = np.asarray(quaternion, np.float64)
    norm = float(np.linalg.norm(q))
    if not 0.5 < norm < 2:
        return None
    return GimbalSample(0, (q if q[0] >= 0 else -q) / norm, said == EARTH or (not said and locked))


def is_stamped(message: Any) -> bool:
    """True if a message has a time by the clock of the autopilot."""
    by_autopilot = message.get_srcComponent() == AUTOPILOT
    return by_autopilot and getattr(message, "time_boot_ms", 0) > 0


class GimbalChoice:
    """Selection of one gimbal, and of one message type, among those that are heard."""

    def __init__(self) -> None:
        self._chosen: tuple[int, int, int] | None = None
        self._heard_ns = 0

    def takes(self, message: Any, receive_ns: int) -> bool:
        """True for a message of the chosen gimbal and type; the first that is heard is chosen."""
        rank = GIMBAL_IDS.index(message.get_msgId())
        source = rank, message.get_srcComponent(), int(getattr(message, "gimbal_device_id", 0))
        chosen = self._chosen
        silent = receive_ns - self._heard_ns > SILENT_NS
        if chosen is None or silent or (rank < chosen[0]):
            self._chosen = chosen = source
        if source != chosen:
            return False
        self._heard_ns = receive_ns
        return True
