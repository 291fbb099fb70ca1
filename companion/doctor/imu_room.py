"""Room for the IMU on the link to an autopilot: the rate that fits beside all else asked for.

Sizes are those of MAVLink 2 packets, https://mavlink.io/en/guide/serialization.html.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from companion.config import LinkConfig
from companion.doctor.wanted import ARDUPILOT, PX4, Finding, Values

MAX_LOAD, PX4_LOAD = 0.6, 0.5
"""Largest utilisation of a line; beyond, stamps are delayed. PX4 keeps to half (MAV_x_RATE)."""
BITS_PER_BYTE = 10
USUAL_BAUDS = (115200, 230400, 460800, 921600, 1500000)
BAUD_NAME = {ARDUPILOT: "SERIALn_BAUD", PX4: "SER_…_BAUD"}
LEAST_HZ = 50.0
"""With less, accelerations do not show a scale."""
MOST_HZ = 100.0
"""The rate at which this scale was tried; twice as many cost twice the processor."""
GPS_MOST_HZ = 5.0
"""More than receivers give."""
SIGNATURE_BYTES = 13
IMU_BYTES = {"HIGHRES_IMU": 75, "RAW_IMU": 41}
"""Best first; SCALED_IMU, which stands in for RAW_IMU, has 36."""
ATTITUDE_BYTES, POSITION_BYTES, GPS_BYTES, HEIGHT_BYTES = 44, (40, 40), 64, (28, 51)
OTHER_BYTES_PER_S, N_OTHER = 700.0, 24
"""HEARTBEAT, SYSTEM_TIME, answers and questions of TIMESYNC, and how many of them a second."""
LOOP_RATE, LOOP_SHARE = "SCHED_LOOP_RATE", 0.8
"""ArduPilot sends a message at most at this share of its loop rate (GCS_Common.cpp, 4.x)."""


@dataclass(frozen=True, slots=True)
class ImuRoom:
    """Message and rate of the IMU that fit; the rate is 0 where too little does."""

    message: str
    rate_hz: float
    why: str = ""
    """Reason why none fits, and what to do."""


def imu_room(link: LinkConfig, bytes_per_s: float | None, firmware: str) -> ImuRoom:
    """Room on a link of a capacity; None where that is not known beforehand, as of a network."""
    best = next(iter(IMU_BYTES))
    if bytes_per_s is None:
        return ImuRoom(best, MOST_HZ)
    for message in IMU_BYTES:
        rate_hz = in_whole_ms(min(MOST_HZ, _free_hz(link, bytes_per_s, firmware, message)))
        if rate_hz >= LEAST_HZ:
            return ImuRoom(message, rate_hz)
    enough = next(
        (
            baud for baud in USUAL_BAUDS
            if _free_hz(link, baud / BITS_PER_BYTE, firmware, best) >= LEAST_HZ
        ),
        USUAL_BAUDS[-1],
    )  # fmt: skip
    name = BAUD_NAME.get(firmware, "the port's baud rate")
    baud = round(bytes_per_s * BITS_PER_BYTE)
    why = f"{baud} baud have no room for it; set {name} and link.url to {enough} or more"
    return ImuRoom(best, 0.0, why)


def asked_bytes_per_s(link: LinkConfig) -> float:
    """Load by all that is asked for but the IMU."""
    signature = signature_bytes(link)
    return (
        link.attitude_hz * (ATTITUDE_BYTES + signature)
        + link.position_hz * sum(each + signature for each in POSITION_BYTES)
        + min(link.position_hz, GPS_MOST_HZ) * (GPS_BYTES + signature)
        + link.height_hz * sum(each + signature for each in HEIGHT_BYTES)
        + OTHER_BYTES_PER_S + N_OTHER * signature
    )  # fmt: skip


def imu_bytes_per_s(link: LinkConfig, bytes_per_s: float, firmware: str) -> float:
    """Load by the IMU on a line of this capacity."""
    if link.imu_hz == "auto":
        room = imu_room(link, bytes_per_s, firmware)
        return room.rate_hz * (IMU_BYTES[room.message] + signature_bytes(link))
    return link.imu_hz * (max(IMU_BYTES.values()) + signature_bytes(link))


def in_whole_ms(rate_hz: float) -> float:
    """The highest rate up to this one whose interval is a whole number of milliseconds.

    >>> in_whole_ms(119.0)
    111.11111111111111
    """
    return 1000.0 / math.ceil(1000.0 / rate_hz - 1e-9) if rate_hz > 0 else 0.0


def check_loop_rate(values: Values, link: LinkConfig) -> list[Finding]:
    """A note where ArduPilot's loop is too slow for the scale by accelerometers."""
    rate_hz = values.get(LOOP_RATE)
    if link.imu_hz != "auto" or rate_hz is None or LOOP_SHARE * rate_hz >= LEAST_HZ:
        return []
    return [
        Finding(
            LOOP_RATE, rate_hz, f"{math.ceil(LEAST_HZ / LOOP_SHARE)} or more",
            f"the IMU comes at {LOOP_SHARE:g} of it at most, and the scale by accelerometers "
            f"needs {LEAST_HZ:g} Hz",
            blocking=False,
        )
    ]  # fmt: skip


def _free_hz(link: LinkConfig, bytes_per_s: float, firmware: str, message: str) -> float:
    load = PX4_LOAD if firmware == PX4 else MAX_LOAD
    free = load * bytes_per_s - asked_bytes_per_s(link)
    return free / (IMU_BYTES[message] + signature_bytes(link))


def signature_bytes(link: LinkConfig) -> int:
    """By which each message is longer."""
    return SIGNATURE_BYTES if link.signing_key_file else 0
