"""LANDING_TARGET, in the one frame that each firmware takes.

- ArduPilot takes BODY_FRD with a distance above zero, and makes a direction of it
  (AC_PrecLand_MAVLink); any other frame it refuses with a text. It looks its own attitude up at the
  time of the message.
- PX4 takes LOCAL_NED, the axes and origin of its own LOCAL_POSITION_NED (mavlink_receiver.cpp,
  handle_message_landing_target); any other frame it refuses. So the marker is placed by PX4's own
  position at the time of the frame, in whatever frame that is.

Neither takes LOCAL_FRD. The angles are those that a firmware would read without a valid position:
right and backward of the body's down axis, rad.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.estimation.landing.landing_gate import TargetToSend
from companion.geometry.transforms import Array
from drivers.mavlink.autopilot_link import AutopilotLink

MAX_AGE_NS = 300_000_000
"""Longest extrapolation of a position by its velocity: it comes at 10 Hz, and a multicopter that
brakes by 2 m/s2 is 0.09 m elsewhere after this."""


def landing_target_message(
    target: TargetToSend, size_rad: float, vehicle_ned_m: Array | None
) -> Any:
    """The message in LOCAL_NED about a position of the vehicle; without one in BODY_FRD."""
    x, y, z = (float(each) for each in target.position_body_m)
    placed = (x, y, z)
    frame = mavlink.MAV_FRAME_BODY_FRD
    if vehicle_ned_m is not None:
        frame = mavlink.MAV_FRAME_LOCAL_NED
        north, east, down = vehicle_ned_m + target.offset_ned_m
        placed = (float(north), float(east), float(down))
    return mavlink.MAVLink_landing_target_message(
        time_usec=target.t_ns // 1000, target_num=0, frame=frame,
        angle_x=math.atan2(y, z), angle_y=math.atan2(-x, z),
        distance=math.sqrt(x * x + y * y + z * z), size_x=size_rad, size_y=size_rad,
        x=placed[0], y=placed[1], z=placed[2], q=[1.0, 0.0, 0.0, 0.0],
        type=mavlink.LANDING_TARGET_TYPE_VISION_FIDUCIAL, position_valid=1,
    )  # fmt: skip


class LocalPosition:
    """The autopilot's own position in its local frame, from messages of a link."""

    def __init__(self, link: AutopilotLink) -> None:
        self._link = link
        self._newest: tuple[int, Array, Array] | None = None
        link.listen(mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED, self._take)

    def at(self, t_ns: int) -> Array | None:
        """Position (3,) in NED at a time of the flight's clock, metres; None while unknown."""
        if self._newest is None or abs(t_ns - self._newest[0]) > MAX_AGE_NS:
            return None
        moved: Array = self._newest[1] + self._newest[2] * ((t_ns - self._newest[0]) * 1e-9)
        return moved

    def _take(self, message: Any, _receive_ns: int) -> None:
        t_ns = self._link.clock_filter.host_ns(message.time_boot_ms * 1_000_000)
        position = np.array([message.x, message.y, message.z])
        velocity = np.array([message.vx, message.vy, message.vz])
        if t_ns is not None and np.isfinite(position).all() and np.isfinite(velocity).all():
            self._newest = t_ns, position, velocity
