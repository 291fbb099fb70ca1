"""The rate of the IMU that a link has room for."""

from __future__ import annotations

from dataclasses import replace

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.config import FeedbackConfig, LinkConfig
from companion.doctor.imu_room import (
    ATTITUDE_BYTES,
    GPS_BYTES,
    HEIGHT_BYTES,
    IMU_BYTES,
    MAX_LOAD,
    POSITION_BYTES,
    SIGNATURE_BYTES,
    asked_bytes_per_s,
    check_loop_rate,
    imu_bytes_per_s,
    imu_room,
    in_whole_ms,
)
from companion.doctor.line_rate import check_line

UNSIGNED, SIGNED = LinkConfig(), LinkConfig(signing_key_file="key")


@pytest.mark.parametrize(
    ("link", "baud", "message", "rate_hz"),
    [
        (UNSIGNED, 921600, "HIGHRES_IMU", 100), (UNSIGNED, 460800, "HIGHRES_IMU", 100),
        (UNSIGNED, 230400, "HIGHRES_IMU", 100), (UNSIGNED, 115200, "RAW_IMU", 50),
        (UNSIGNED, 57600, "HIGHRES_IMU", 0),
        (SIGNED, 921600, "HIGHRES_IMU", 100), (SIGNED, 460800, "HIGHRES_IMU", 100),
        (SIGNED, 230400, "HIGHRES_IMU", 1000 / 12), (SIGNED, 115200, "HIGHRES_IMU", 0),
        (SIGNED, 57600, "HIGHRES_IMU", 0),
    ],
)  # fmt: skip
def test_by_baud_rate(link: LinkConfig, baud: int, message: str, rate_hz: float) -> None:
    room = imu_room(link, baud / 10, "ardupilot")
    assert room.message == message and room.rate_hz == pytest.approx(rate_hz)
    assert bool(room.why) is (rate_hz == 0)
    if rate_hz:
        load = asked_bytes_per_s(link) + imu_bytes_per_s(link, baud / 10, "ardupilot")
        assert load <= MAX_LOAD * baud / 10


@pytest.mark.parametrize("firmware", ["ardupilot", "px4"])
def test_the_baud_rate_that_is_advised_has_room(firmware: str) -> None:
    for link in (UNSIGNED, SIGNED, replace(UNSIGNED, attitude_hz=200.0)):
        why = imu_room(link, 5760.0, firmware).why
        assert why.startswith("57600 baud have no room for it; set SER")
        advised = int(why.split()[-3])
        assert imu_room(link, advised / 10, firmware).rate_hz >= 50
        assert imu_room(link, advised / 10, firmware).message == "HIGHRES_IMU"


def test_px4_keeps_to_half_of_a_line() -> None:
    room = imu_room(UNSIGNED, 23040.0, "px4")
    load = asked_bytes_per_s(UNSIGNED) + imu_bytes_per_s(UNSIGNED, 23040.0, "px4")
    assert 50 <= room.rate_hz < 100 and load <= 0.5 * 23040
    values = {"MAV_1_CONFIG": 102.0, "MAV_1_RATE": 0.0, "SER_TEL2_BAUD": 230400.0}
    feedback = FeedbackConfig()
    assert check_line("px4", values, UNSIGNED, feedback, "odometry", 30.0, 230400) == []


def test_a_network_is_tried() -> None:
    assert imu_room(SIGNED, None, "ardupilot").rate_hz == 100


def test_what_is_asked_for_otherwise_takes_room() -> None:
    more = replace(UNSIGNED, attitude_hz=150.0)
    assert asked_bytes_per_s(more) - asked_bytes_per_s(UNSIGNED) == 100 * ATTITUDE_BYTES
    assert 50 <= imu_room(more, 23040.0, "ardupilot").rate_hz < 100


def test_sizes_are_those_of_packets() -> None:
    frame_bytes, offset_q_bytes = 12, 16  # the second are zeros at the end, which are not sent

    def size(kind: str) -> int:
        number = getattr(mavlink, f"MAVLINK_MSG_ID_{kind}")
        return frame_bytes + int(mavlink.mavlink_map[number].unpacker.size)

    assert {kind: size(kind) for kind in IMU_BYTES} == IMU_BYTES
    assert size("SCALED_IMU") <= IMU_BYTES["RAW_IMU"]
    assert size("ATTITUDE_QUATERNION") - offset_q_bytes == ATTITUDE_BYTES
    assert (size("LOCAL_POSITION_NED"), size("GLOBAL_POSITION_INT")) == POSITION_BYTES
    assert size("GPS_RAW_INT") == GPS_BYTES
    assert (size("SCALED_PRESSURE"), size("DISTANCE_SENSOR")) == HEIGHT_BYTES
    signer = mavlink.MAVLink(None, 1, 1)
    message = mavlink.MAVLink_system_time_message(2**62, 2**31)
    n_unsigned = len(message.pack(signer))
    signer.signing.secret_key, signer.signing.sign_outgoing = bytes(32), True
    assert len(message.pack(signer)) == n_unsigned + SIGNATURE_BYTES


@pytest.mark.parametrize(("rate_hz", "rounded"), [(100, 100), (99, 1000 / 11), (0, 0), (400, 333)])
def test_intervals_are_whole_milliseconds(rate_hz: float, rounded: float) -> None:
    assert in_whole_ms(rate_hz) == pytest.approx(rounded, abs=0.4)
    assert in_whole_ms(rate_hz) <= rate_hz


def test_a_slow_loop_is_noted() -> None:
    (note,) = check_loop_rate({"SCHED_LOOP_RATE": 50.0}, UNSIGNED)
    assert not note.blocking and note.wanted == "63 or more"
    assert check_loop_rate({"SCHED_LOOP_RATE": 400.0}, UNSIGNED) == check_loop_rate({}, UNSIGNED)
    assert check_loop_rate({"SCHED_LOOP_RATE": 50.0}, replace(UNSIGNED, imu_hz=0.0)) == []
