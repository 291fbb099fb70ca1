"""Optical flow as the autopilots read it, after a way over the wire."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.messages import OpticalFlow
from drivers.mavlink.measurements.flow_messages import (
    optical_flow_message,
    optical_flow_rad_message,
)

VELOCITY_BODY_M_S, RANGE_M = np.array([3.0, -1.2, 0.4]), 6.0
RATES_RAD_S = np.array([0.21, -0.34, 0.55])
DT_S = 0.04
FLOW = OpticalFlow(
    7, 1_795_000_000_123_456_789, DT_S,
    np.array([-VELOCITY_BODY_M_S[1], VELOCITY_BODY_M_S[0]]) / RANGE_M, RATES_RAD_S * DT_S,
    0.004, 203, 5.9,
)  # fmt: skip


def received(message: Any) -> Any:
    link = mavlink.MAVLink(None, srcSystem=1, srcComponent=197)
    return link.parse_buffer(message.pack(link))[0]


def test_ardupilot_finds_the_velocity() -> None:
    """As NavEKF3 does: signs turned about, its own gyroscopes taken off, v = losPred * range."""
    message = received(optical_flow_message(FLOW, RATES_RAD_S))
    compensated = -np.array([message.flow_rate_x, message.flow_rate_y]) + RATES_RAD_S[:2]
    found = np.array([-compensated[1], compensated[0]]) * RANGE_M
    assert found == pytest.approx(VELOCITY_BODY_M_S[:2], abs=1e-5)
    assert (message.quality, message.sensor_id) == (203, 0)
    assert message.ground_distance == pytest.approx(5.9)
    assert message.time_usec == 1_795_000_000_123_456


def test_ardupilot_before_4_7_finds_the_velocity_roughly() -> None:
    """It takes flow_x times the interval for rad/s."""
    message = received(optical_flow_message(FLOW, RATES_RAD_S))
    coarse = np.array([message.flow_x, message.flow_y]) * DT_S
    assert coarse == pytest.approx([message.flow_rate_x, message.flow_rate_y], abs=0.5 * DT_S)
    assert abs(message.flow_y) >= 3


def test_px4_finds_the_velocity() -> None:
    """As VehicleOpticalFlow does, by the gyroscope integrals of the message alone."""
    message = received(optical_flow_rad_message(FLOW))
    dt_s = message.integration_time_us * 1e-6
    assert dt_s == pytest.approx(DT_S)
    seen = -np.array([message.integrated_x, message.integrated_y])
    gyro = -np.array([message.integrated_xgyro, message.integrated_ygyro])
    compensated = (seen - gyro) / dt_s
    found = np.array([-compensated[1], compensated[0]]) * RANGE_M
    assert found == pytest.approx(VELOCITY_BODY_M_S[:2], abs=1e-4)
    turn = [message.integrated_xgyro, message.integrated_ygyro, message.integrated_zgyro]
    assert np.array(turn) / dt_s == pytest.approx(RATES_RAD_S, abs=1e-5)
    assert message.quality == 203
    assert message.distance == pytest.approx(5.9)


def test_for_a_turn_alone_flow_and_gyroscopes_are_the_same() -> None:
    """As docs.px4.io has it of pure rotations."""
    still = OpticalFlow(7, 10**18, DT_S, np.zeros(2), RATES_RAD_S * DT_S, 0.004, 255)
    message = received(optical_flow_rad_message(still))
    assert message.integrated_x == message.integrated_xgyro
    assert message.integrated_y == message.integrated_ygyro
    assert message.distance == -1.0


def test_without_flow() -> None:
    nothing = OpticalFlow(7, 10**18, DT_S, why_not="too little to track")
    message = received(optical_flow_message(nothing, RATES_RAD_S))
    assert (message.quality, message.flow_rate_x, message.flow_rate_y) == (0, 0.0, 0.0)
    assert message.ground_distance == -1.0
    with pytest.raises(ValueError, match="too little to track"):
        optical_flow_rad_message(nothing)
