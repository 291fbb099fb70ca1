"""The sample flight with another IMU: each HIGHRES_IMU of its log altered, or left out."""

from __future__ import annotations

import shutil
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from tests.support.flights.sample_faults import read_tlog

HIGHRES_IMU = int(mavlink.MAVLINK_MSG_ID_HIGHRES_IMU)
Alter = Callable[[Any, float], bool]
"""Changes a message, so many seconds after the first frame; False leaves it out."""


def with_imu(folder: Path, sample: Path, alter: Alter) -> Path:
    """Write a flight that is the sample but for its IMU."""
    folder.mkdir()
    for name in ("camera.json", "camera.mp4", "frames.csv"):
        shutil.copyfile(sample / name, folder / name)
    first_ns = int((sample / "frames.csv").read_text().splitlines()[1].split(",")[1])
    reader = mavlink.MAVLink(None)
    records = []
    for record in read_tlog(sample / "telemetry.tlog"):
        unix_us, packet = record.unix_us, record.packet
        if record.message_id == HIGHRES_IMU:
            message = reader.decode(bytearray(packet))
            stamp_us = message.time_usec
            if not alter(message, unix_us * 1e-6 - first_ns * 1e-9):
                continue
            unix_us += (
                message.time_usec - stamp_us
            )  # else the autopilot's clock would seem to be off
            writer = mavlink.MAVLink(None, message.get_srcSystem(), message.get_srcComponent())
            writer.seq = message.get_seq()
            packet = bytes(message.pack(writer))
        records.append((unix_us, packet))
    with (folder / "telemetry.tlog").open("wb") as log:
        for unix_us, packet in sorted(records, key=lambda each: each[0]):
            log.write(struct.pack(">Q", unix_us) + packet)
    return folder


def turned_about_z(message: Any, _after_s: float) -> bool:
    """A mounting turned by 90 degrees."""
    message.xacc, message.yacc = message.yacc, -message.xacc
    message.xgyro, message.ygyro = message.ygyro, -message.xgyro
    return True


def late(seconds: float) -> Alter:
    """Samples that come late, stamped as they come."""

    def alter(message: Any, _after_s: float) -> bool:
        message.time_usec += round(seconds * 1e6)
        return True

    return alter


def saturated(least_m_s2: float, from_s: float = 0.0) -> Alter:
    """Strong vibration, clipped at the end of the range, from a time on."""
    up = [True]

    def alter(message: Any, after_s: float) -> bool:
        if after_s >= from_s:
            up[0] = not up[0]
            shaken = message.zacc + (12.0 if up[0] else -12.0)
            message.zacc = min(max(shaken, -least_m_s2), least_m_s2)
        return True

    return alter


def in_g(message: Any, _after_s: float) -> bool:
    """Accelerations in g."""
    for name in ("xacc", "yacc", "zacc"):
        setattr(message, name, getattr(message, name) / 9.80665)
    return True


def every(number: int) -> Alter:
    """Fewer messages."""
    count = [0]

    def alter(_message: Any, _after_s: float) -> bool:
        count[0] += 1
        return count[0] % number == 0

    return alter
