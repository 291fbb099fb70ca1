"""MAVLink messages as samples: units, axes and markers of invalid fields; and the rates needed."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.config import LinkConfig
from companion.geometry.geodesy import STANDARD_GRAVITY_M_S2
from companion.geometry.transforms import Array, length, quaternion_from_euler
from companion.telemetry import (
    AirspeedSample,
    AttitudeSample,
    HeightSample,
    ImuSample,
    PositionSample,
    PositionSource,
    RangeSample,
    Telemetry,
)
from drivers.telemetry.gimbal_messages import GIMBAL_IDS
from drivers.telemetry.telemetry_log import GeodeticFix

SEA_LEVEL_KG_M3 = 1.225
"""Density of the air at sea level in the standard atmosphere (ISO 2533)."""
GPS_RANGE_ERROR_M = 1.5
"""One sigma of a GPS position at dilution 1, where the receiver states no accuracy of its own."""
UNKNOWN_8, UNKNOWN_16 = 255, 65535
FIX_3D = 3
UNIX_SINCE_NS = 10**17
"""Larger stamps count from 1970, smaller ones from boot."""
ACCEL_AND_GYRO = 0x3F

ATTITUDE_IDS = (mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION, mavlink.MAVLINK_MSG_ID_ATTITUDE)
IMU_IDS = (
    mavlink.MAVLINK_MSG_ID_HIGHRES_IMU,
    mavlink.MAVLINK_MSG_ID_SCALED_IMU,
    mavlink.MAVLINK_MSG_ID_SCALED_IMU2,
    mavlink.MAVLINK_MSG_ID_RAW_IMU,
)
"""Message types of one quantity, best first."""
IMU_REQUESTS = (
    mavlink.MAVLINK_MSG_ID_HIGHRES_IMU,
    mavlink.MAVLINK_MSG_ID_SCALED_IMU,
    mavlink.MAVLINK_MSG_ID_RAW_IMU,
)
"""Those of the first IMU."""
GPS_HZ, TIME_HZ, LANDED_HZ = 5.0, 1.0, 1.0
"""More than receivers give; enough to map GPS time to boot time; as autopilots send it."""


@dataclass(frozen=True, slots=True)
class Wanted:
    """A quantity: message types that carry it, best first, and the rate needed."""

    ids: tuple[int, ...]
    rate_hz: float
    always: bool = True
    """True if it is always sent; a position or a range may be unknown."""


def wanted(config: LinkConfig, on_gimbal: bool = False) -> list[Wanted]:
    """Quantities that the samples of a flight need, but an IMU whose rate is to be found.

    With a camera `on_gimbal` its angles, which the autopilot may know or not.
    """
    # both firmwares have all of these; ArduPilot's older versions lack the first of some
    rates = [
        Wanted(ATTITUDE_IDS, config.attitude_hz),
        Wanted(IMU_REQUESTS, 0.0 if config.imu_hz == "auto" else config.imu_hz),
        Wanted((mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED,), config.position_hz, always=False),
        Wanted((mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT,), config.position_hz, always=False),
        Wanted(
            (mavlink.MAVLINK_MSG_ID_GPS_RAW_INT,), min(config.position_hz, GPS_HZ), always=False
        ),
        Wanted((mavlink.MAVLINK_MSG_ID_SCALED_PRESSURE,), config.height_hz),
        Wanted((mavlink.MAVLINK_MSG_ID_DISTANCE_SENSOR,), config.height_hz, always=False),
        Wanted((mavlink.MAVLINK_MSG_ID_SYSTEM_TIME,), TIME_HZ),
        Wanted((mavlink.MAVLINK_MSG_ID_EXTENDED_SYS_STATE,), LANDED_HZ, always=False),
    ]
    if on_gimbal:
        rates.append(Wanted(GIMBAL_IDS, config.gimbal_hz, always=False))
    return [each for each in rates if each.rate_hz > 0]


def boot_ns(message: Any, unix_minus_boot_ns: int | None) -> int | None:
    """Autopilot time since boot of a message; None where it has none."""
    boot_ms = getattr(message, "time_boot_ms", None)
    if boot_ms is not None:
        return int(boot_ms) * 1_000_000
    stamp_ns = int(getattr(message, "time_usec", 0)) * 1000
    if stamp_ns == 0:
        return None
    if stamp_ns < UNIX_SINCE_NS:
        return stamp_ns
    return stamp_ns - unix_minus_boot_ns if unix_minus_boot_ns is not None else None


def height_from_pressure(pressure_pa: float) -> float:
    """Height in metres above 1013.25 hPa in the standard atmosphere (ISO 2533)."""
    return float(44330.77 * (1 - (pressure_pa / 101325.0) ** 0.1902632))


def _attitude(message: Any) -> Telemetry:
    q = quaternion_from_euler(message.roll, message.pitch, message.yaw)
    return AttitudeSample(0, q, _rates(message))


def _attitude_quaternion(message: Any) -> Telemetry | None:
    q = np.array([message.q1, message.q2, message.q3, message.q4])
    norm = length(q)
    if not 0.5 < norm < 2:
        return None
    return AttitudeSample(0, (q if q[0] >= 0 else -q) / norm, _rates(message))


def _rates(message: Any) -> Array | None:
    rates = message.rollspeed, message.pitchspeed, message.yawspeed
    return np.array(rates) if all(map(math.isfinite, rates)) else None


def _highres_imu(message: Any) -> Telemetry | None:
    if message.fields_updated & ACCEL_AND_GYRO != ACCEL_AND_GYRO:
        return None
    gyro = np.array([message.xgyro, message.ygyro, message.zgyro])
    accel = np.array([message.xacc, message.yacc, message.zacc])
    return ImuSample(0, gyro, accel)


def _scaled_imu(message: Any) -> Telemetry:
    gyro = np.array([message.xgyro, message.ygyro, message.zgyro]) * 1e-3
    accel = np.array([message.xacc, message.yacc, message.zacc]) * (1e-3 * STANDARD_GRAVITY_M_S2)
    return ImuSample(0, gyro, accel)


def _local_position(message: Any) -> Telemetry:
    position = np.array([message.x, message.y, message.z])
    velocity = message.vx, message.vy, message.vz
    return PositionSample(
        0, PositionSource.LOCAL, position,
        np.array(velocity) if all(map(math.isfinite, velocity)) else None,
    )  # fmt: skip


def _global_position(message: Any) -> GeodeticFix | None:
    if message.lat == 0 and message.lon == 0:  # what autopilots send before they know
        return None
    velocity = np.array([message.vx, message.vy, message.vz]) * 1e-2
    return GeodeticFix(
        PositionSource.GLOBAL, message.lat * 1e-7, message.lon * 1e-7, message.alt * 1e-3, velocity
    )


def _gps(message: Any) -> GeodeticFix | None:
    if message.fix_type < FIX_3D:
        return None
    return GeodeticFix(
        PositionSource.GPS,
        message.lat * 1e-7,
        message.lon * 1e-7,
        message.alt * 1e-3,
        _gps_velocity(message),
        _gps_sigma(message.h_acc, message.eph),
        _gps_sigma(message.v_acc, message.epv),
    )


def _gps_velocity(message: Any) -> Array | None:
    """Velocity over ground; the vertical component is nan, since the message has none."""
    if UNKNOWN_16 in (message.vel, message.cog):
        return None
    course, speed = math.radians(message.cog * 1e-2), message.vel * 1e-2
    return np.array([speed * math.cos(course), speed * math.sin(course), math.nan])


def _gps_sigma(accuracy_mm: int, dilution_100: int) -> float | None:
    if accuracy_mm:
        return accuracy_mm * 1e-3
    return None if dilution_100 in (0, UNKNOWN_16) else dilution_100 * 1e-2 * GPS_RANGE_ERROR_M


def _range(message: Any) -> Telemetry | None:
    if message.orientation != mavlink.MAV_SENSOR_ROTATION_PITCH_270:
        return None
    if not max(message.min_distance, 1) <= message.current_distance < message.max_distance:
        return None
    return RangeSample(0, message.current_distance * 1e-2)


def _pressure(message: Any) -> Telemetry | None:
    if not 100 < message.press_abs < 1200:
        return None
    return HeightSample(0, height_from_pressure(message.press_abs * 100))


def _airspeed(message: Any) -> Telemetry | None:
    """Indicated airspeed, by the pressure of a pitot tube; ARSPD_RATIO is not in it.

    VFR_HUD and AIRSPEED have no time; the first is the ground speed where ArduCopter has no tube,
    and PX4 does not send the second.
    """
    if message.press_diff == 0:  # what both firmwares send without a pitot tube
        return None
    pressure_pa = max(message.press_diff * 100, 0.0)  # below is noise
    return AirspeedSample(0, math.sqrt(2 * pressure_pa / SEA_LEVEL_KG_M3))


Reader = Callable[[Any], Telemetry | GeodeticFix | None]
READERS: dict[int, tuple[Reader, ...]] = {
    mavlink.MAVLINK_MSG_ID_ATTITUDE: (_attitude,),
    mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION: (_attitude_quaternion,),
    mavlink.MAVLINK_MSG_ID_HIGHRES_IMU: (_highres_imu,),
    mavlink.MAVLINK_MSG_ID_SCALED_IMU: (_scaled_imu,),
    mavlink.MAVLINK_MSG_ID_SCALED_IMU2: (_scaled_imu,),
    mavlink.MAVLINK_MSG_ID_RAW_IMU: (_scaled_imu,),
    mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED: (_local_position,),
    mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: (_global_position,),
    mavlink.MAVLINK_MSG_ID_GPS_RAW_INT: (_gps,),
    mavlink.MAVLINK_MSG_ID_DISTANCE_SENSOR: (_range,),
    mavlink.MAVLINK_MSG_ID_SCALED_PRESSURE: (_pressure, _airspeed),
}
"""Readers of each message type: samples without a time yet, None without a valid value."""


def landed(message: Any) -> bool:
    """True if an EXTENDED_SYS_STATE says that the vehicle stands on the ground."""
    return bool(message.landed_state == mavlink.MAV_LANDED_STATE_ON_GROUND)


def searches(message: Any) -> bool:
    """True if a GPS_RAW_INT says that the receiver sees satellites, and has no fix yet."""
    return bool(message.fix_type < FIX_3D and 0 < message.satellites_visible < UNKNOWN_8)


def takes_biases_off(heartbeat: Any) -> bool:
    """True if the autopilot of a HEARTBEAT sends HIGHRES_IMU less the biases of its EKF.

    PX4 does (mavlink/streams/HIGHRES_IMU.hpp), and its SCALED_IMU is as measured; ArduPilot's are.
    """
    return bool(heartbeat.autopilot == mavlink.MAV_AUTOPILOT_PX4)


def samples_of(message: Any, less_biases: bool) -> list[Telemetry | GeodeticFix]:
    """Samples of a message that have a valid value; none of a type without a reader.

    With `less_biases` HIGHRES_IMU is less the biases of the autopilot's EKF (`takes_biases_off`).
    """
    kind = message.get_msgId()
    found = [read(message) for read in READERS.get(kind, ())]
    marked = less_biases and kind == mavlink.MAVLINK_MSG_ID_HIGHRES_IMU
    return [
        replace(sample, less_biases=True) if marked and isinstance(sample, ImuSample) else sample
        for sample in found
        if sample is not None
    ]
