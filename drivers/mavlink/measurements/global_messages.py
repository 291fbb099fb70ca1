"""Global positions, in the message that an autopilot understands.

- PX4 takes GLOBAL_POSITION_SENSOR (auxiliary global position, EKF2_AGP_CTRL).
- ArduPilot takes MAV_CMD_EXTERNAL_POSITION_ESTIMATE as a COMMAND_INT, without altitude, for its
  EKF3 to begin anew from while it reckons; while satellites aid it, it refuses (NavEKF3
  setLatLng). It is meant for now and then: one a second.
- Others may take GPS_INPUT, as the position of a receiver.
"""

from __future__ import annotations

import math
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.estimation.gate.global_gate import GlobalToSend

SENSOR_ID = 10
"""Of the estimates of vision that PX4 tells apart (AuxGlobalPosition: 1X)."""
WRAP_S = 36000.0
"""Time of a command begins anew after this, as the definition has it: a float is too short."""
GPS_EPOCH_UNIX_S, LEAP_S, WEEK_S = 315_964_800, 18, 604_800
"""GPS time began 1980-01-06, and has been ahead of UTC by so many seconds since 2017."""
FIX_3D, N_SATELLITES = 3, 10
"""Fix and satellites without which autopilots take no position; its accuracy is the true one."""
COMMAND = mavlink.MAV_CMD_EXTERNAL_POSITION_ESTIMATE
RATES_HZ = {"sensor": 5.0, "estimate": 1.0, "gps_input": 5.0}


def global_message(given: GlobalToSend, message: str, system: int, now_ns: int) -> Any:
    """The message of this name in `feedback.global_position`, for an autopilot of this system."""
    latitude, longitude = round(given.latitude_deg * 1e7), round(given.longitude_deg * 1e7)
    age_ns = max(now_ns - given.t_ns, 0)
    if message == "sensor":
        return mavlink.MAVLink_global_position_sensor_message(
            target_system=system, target_component=mavlink.MAV_COMP_ID_AUTOPILOT1, id=SENSOR_ID,
            time_usec=given.t_ns // 1000, processing_time=age_ns // 1000,
            source=mavlink.GLOBAL_POSITION_SRC_VISION, flags=0, lat=latitude, lon=longitude,
            alt_ellipsoid=math.nan, alt=given.altitude_m, eph=given.sigma_horizontal_m,
            epv=given.sigma_vertical_m,
        )  # fmt: skip
    if message == "estimate":
        return mavlink.MAVLink_command_int_message(
            system, mavlink.MAV_COMP_ID_AUTOPILOT1, mavlink.MAV_FRAME_GLOBAL, COMMAND, 0, 0,
            (now_ns * 1e-9) % WRAP_S, age_ns * 1e-9, given.sigma_horizontal_m, 0.0,
            latitude, longitude, math.nan,
        )  # fmt: skip
    gps_ns = given.t_ns + (LEAP_S - GPS_EPOCH_UNIX_S) * 10**9
    week, in_week_ns = divmod(gps_ns, WEEK_S * 10**9)
    north, east, down = (float(each) for each in given.velocity_ned_m_s)
    return mavlink.MAVLink_gps_input_message(
        time_usec=given.t_ns // 1000, gps_id=0,
        ignore_flags=mavlink.GPS_INPUT_IGNORE_FLAG_HDOP | mavlink.GPS_INPUT_IGNORE_FLAG_VDOP,
        time_week_ms=in_week_ns // 10**6, time_week=week, fix_type=FIX_3D,
        lat=latitude, lon=longitude, alt=given.altitude_m, hdop=0.0, vdop=0.0,
        vn=north, ve=east, vd=down, speed_accuracy=given.sigma_velocity_m_s,
        horiz_accuracy=given.sigma_horizontal_m, vert_accuracy=given.sigma_vertical_m,
        satellites_visible=N_SATELLITES, yaw=0,
    )  # fmt: skip
