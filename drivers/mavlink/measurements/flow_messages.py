"""Optical flow messages: the one place where flow leaves our units.

Axes and signs are the same in both firmwares, and ours: a sensor that looks down, about the body's
forward and right axes, positive by a right-handed rotation of the body. What it sees is

    x: turn rate about forward - v_right / r,     y: turn rate about right + v_forward / r

with the distance r along the body's down axis, so that flying forward gives +y and to the right -x
(docs.px4.io, "Optical Flow"; ArduPilot NavEKF3_core::writeOptFlowMeas and FuseOptFlow, which turn
all signs about; PX4 OpticalFlowSource::predictFlow and VehicleOpticalFlow, which do the same). Both
take the flow with the body's rotation in it, and take the rotation off themselves:

- PX4 by the gyroscope integrals of OPTICAL_FLOW_RAD, which must be of the same interval
  (mavlink_receiver.cpp, handle_message_optical_flow_rad).
- ArduPilot by its own gyroscopes, averaged from the arrival of the message before to the arrival of
  this one (AP_OpticalFlow_MAV::update). Those are later than the frames by the whole latency; so
  what is added here is the turn rate of that later interval.

ArduPilot since 4.7 reads `flow_rate_x`, `flow_rate_y` (rad/s). Before, it took `flow_x`, `flow_y`
times the interval between messages for rad/s, in whole numbers: too coarse to fly by, but not the
zero that an empty field would tell. Neither reads `flow_comp_m_x`, `flow_comp_m_y` or the time.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.geometry.transforms import Array
from companion.messages import OpticalFlow

UNKNOWN_DISTANCE = -1.0
MAX_INT16 = 32767


def flow_message(flow: OpticalFlow, rates_body_rad_s: Array | None) -> Any:
    """OPTICAL_FLOW with the body's turn rates (3,), OPTICAL_FLOW_RAD without."""
    if rates_body_rad_s is None:
        return optical_flow_rad_message(flow)
    return optical_flow_message(flow, rates_body_rad_s)


def optical_flow_message(flow: OpticalFlow, rates_body_rad_s: Array) -> Any:
    """OPTICAL_FLOW for ArduPilot; rates (3,) of the body since the message before.

    Of quality 0 and without flow where there is none.
    """
    seen = np.zeros(2)
    if flow.flow_rad_s is not None:
        seen = flow.flow_rad_s + rates_body_rad_s[:2]
    coarse = np.clip(np.round(seen / flow.dt_s), -MAX_INT16, MAX_INT16) if flow.dt_s else seen
    return mavlink.MAVLink_optical_flow_message(
        time_usec=flow.t_ns // 1000, sensor_id=0,
        flow_x=int(coarse[0]), flow_y=int(coarse[1]), flow_comp_m_x=0.0, flow_comp_m_y=0.0,
        quality=0 if flow.flow_rad_s is None else flow.quality,
        ground_distance=_distance(flow),
        flow_rate_x=float(seen[0]), flow_rate_y=float(seen[1]),
    )  # fmt: skip


def optical_flow_rad_message(flow: OpticalFlow) -> Any:
    """OPTICAL_FLOW_RAD for PX4, of a flow that was measured."""
    if flow.flow_rad_s is None or flow.turn_rad is None:
        raise ValueError(f"no flow: {flow.why_not}")
    x, y = flow.flow_rad_s * flow.dt_s + flow.turn_rad[:2]
    turn = [float(each) for each in flow.turn_rad]
    return mavlink.MAVLink_optical_flow_rad_message(
        time_usec=flow.t_ns // 1000, sensor_id=0, integration_time_us=round(flow.dt_s * 1e6),
        integrated_x=float(x), integrated_y=float(y),
        integrated_xgyro=turn[0], integrated_ygyro=turn[1], integrated_zgyro=turn[2],
        temperature=0, quality=flow.quality, time_delta_distance_us=0,
        distance=_distance(flow),
    )  # fmt: skip


def _distance(flow: OpticalFlow) -> float:
    return UNKNOWN_DISTANCE if flow.distance_m is None else flow.distance_m
