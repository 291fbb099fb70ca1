"""True state of a simulated vehicle, from messages as firmwares send them."""

from __future__ import annotations

import math
import socket
import time

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.geometry.geodesy import GeoOrigin, geodetic_from_ned
from companion.geometry.transforms import (
    Array,
    angle_between,
    quaternion_from_euler,
    rotation_from_quaternion,
)
from tests.firmware.true_state import ARDUPILOT_M, TrueState
from tests.support.autopilot.fake_wire import free_port

HOME = GeoOrigin(-35.3632621, 149.1652374, 584.0)
LEVEL = np.array([1.0, 0.0, 0.0, 0.0])


def sim_state(
    place: Array, velocity: Array, quaternion: Array = LEVEL, rates: tuple[float, ...] = (0, 0, 0)
) -> mavlink.MAVLink_sim_state_message:
    """As ArduPilot rounds it: the place towards home, its height to centimetres."""
    narrow = math.cos(math.radians(HOME.latitude_deg))
    north, east = int(place[0] / ARDUPILOT_M), int(place[1] / ARDUPILOT_M / narrow)
    altitude = int((HOME.altitude_m - place[2]) * 100) / 100
    latitude, longitude = round(HOME.latitude_deg * 1e7), round(HOME.longitude_deg * 1e7)
    return mavlink.MAVLink_sim_state_message(
        *quaternion, 0, 0, 0, 0, 0, 0, *rates, 0, 0, altitude, 0, 0, *velocity,
        latitude + north, longitude + east,
    )  # fmt: skip


def swung(t_s: float) -> tuple[Array, Array]:
    """Place and velocity of a vehicle that goes about."""
    place = [3 * np.sin(0.5 * t_s), 2 * np.sin(0.3 * t_s), -2 + np.cos(0.4 * t_s)]
    velocity = [1.5 * np.cos(0.5 * t_s), 0.6 * np.cos(0.3 * t_s), -0.4 * np.sin(0.4 * t_s)]
    return np.array(place), np.array(velocity)


def test_places_are_much_finer_than_they_are_told() -> None:
    truth = TrueState(origin=HOME)
    for k in range(2400):
        truth.take(sim_state(*swung(k / 200)), 1e9 + k / 200)
    times = np.arange(10.0, 11.9, 0.0037)
    off = []
    for t_s in times:
        pose = truth.at(1e9 + t_s)
        assert pose is not None
        off.append(pose.translation - swung(t_s)[0])
    # half a unit is cut off on the mean; what is left changes little from picture to picture
    assert np.abs(off).max() < 0.009
    assert np.abs(np.diff(off, axis=0)).max() < 0.0003


def test_between_states_it_turns_and_moves_evenly() -> None:
    truth = TrueState(origin=HOME)
    turned = quaternion_from_euler(0.1, -0.2, 0.3)
    truth.take(sim_state(np.zeros(3), np.zeros(3)), 50.0)
    truth.take(sim_state(np.zeros(3), np.zeros(3), turned), 50.004)
    pose = truth.at(50.001)
    assert pose is not None
    whole = angle_between(np.eye(3), rotation_from_quaternion(turned))
    assert angle_between(np.eye(3), pose.rotation) == pytest.approx(whole / 4)


def test_it_is_carried_on_for_a_moment() -> None:
    truth = TrueState(origin=HOME)
    truth.take(sim_state(np.zeros(3), np.array([1.0, -2.0, 0.5]), rates=(0, 0, 1.0)), 50.0)
    pose = truth.at(50.02)
    assert pose is not None
    assert np.allclose(pose.translation, [0.02, -0.04, 0.01], atol=1e-6)
    assert pose.rotation[1, 0] == pytest.approx(math.sin(0.02))
    assert truth.at(50.06) is None
    assert truth.at(49.99) is None


def test_after_a_reboot_it_is_where_it_is_told_to_be() -> None:
    truth = TrueState(origin=HOME)
    far, still = np.array([8.0, -5.0, -4.0]), np.zeros(3)
    for k in range(400):
        truth.take(sim_state(far, still), 100 + k / 200)
    for k in range(400):
        truth.take(sim_state(still, still), 106 + k / 200)
    before, between, after = truth.at(101.9), truth.at(104.0), truth.at(106.001)
    assert before is not None and np.allclose(before.translation, far, atol=0.012)
    assert between is None
    assert after is not None and np.allclose(after.translation, 0, atol=1e-6)


def test_a_vehicle_set_elsewhere_is_there_at_once() -> None:
    truth = TrueState(origin=HOME)
    truth.take(sim_state(np.zeros(3), np.zeros(3)), 100.0)
    truth.take(sim_state(np.array([0.0, 6.0, 0.0]), np.zeros(3)), 100.005)
    pose = truth.at(100.005)
    assert pose is not None and pose.translation[1] == pytest.approx(6.0, abs=0.012)


def test_a_clock_set_back_begins_anew() -> None:
    truth = TrueState(origin=HOME)
    for t_s in (100.0, 100.005, 100.004, 40.0, 40.005):
        truth.take(sim_state(np.zeros(3), np.zeros(3)), t_s)
    assert [state.t_s for state in truth.since(0.0)] == [40.0, 40.005]


def test_px4_tells_it_on_the_ellipsoid() -> None:
    place = np.array([12.0, -7.0, -3.0])
    latitude, longitude, altitude = geodetic_from_ned(place[None], HOME)[0]
    truth = TrueState(origin=HOME)
    quaternion = quaternion_from_euler(0.0, 0.1, 1.0)
    message = mavlink.MAVLink_hil_state_quaternion_message(
        0, list(quaternion), 0, 0, 0, round(latitude * 1e7), round(longitude * 1e7),
        round(altitude * 1e3), 150, -50, 20, 0, 0, 0, 0, 0,
    )  # fmt: skip
    truth.take(message, 10.0)
    (state,) = truth.since(0.0)
    assert np.allclose(state.place_m, place, atol=0.012)
    assert np.allclose(state.velocity_m_s, [1.5, -0.5, 0.2])
    assert np.allclose(state.pose().rotation, rotation_from_quaternion(quaternion), atol=1e-6)


def test_it_asks_and_asks_again() -> None:
    port, packer = free_port(), mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as firmware, TrueState(port) as truth:
        firmware.settimeout(3.0)
        asked = []
        for k in range(2):
            end_s = time.monotonic() + 5.0
            while truth.since(0.0)[k:] == [] and time.monotonic() < end_s:
                state = sim_state(np.array([1.0 * k, 0, 0]), np.zeros(3))
                firmware.sendto(state.pack(packer), ("127.0.0.1", port))
                time.sleep(0.02)
            for _ in range(2):
                (message,) = mavlink.MAVLink(None).parse_buffer(bytearray(firmware.recv(512)))
                assert message.command == mavlink.MAV_CMD_SET_MESSAGE_INTERVAL
                asked.append((int(message.param1), message.param2))
        assert asked == 2 * [
            (mavlink.MAVLINK_MSG_ID_SIM_STATE, 5000.0),
            (mavlink.MAVLINK_MSG_ID_HIL_STATE_QUATERNION, 5000.0),
        ]
        assert abs(truth.since(0.0)[-1].t_s - time.time()) < 5.0
        assert truth.origin is not None
