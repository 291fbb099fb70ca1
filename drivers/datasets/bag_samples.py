"""ROS messages as telemetry: world ENU and body FLU become NED and FRD.

Axes are by REP 103, the reference of an IMU's orientation by REP 145. A message counts as of the
body frame unless static transforms say otherwise.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from companion.geometry.transforms import (
    Array,
    Pose,
    quaternion_from_rotation,
    rotation_from_quaternion,
)
from companion.telemetry import (
    AttitudeSample,
    HeightSample,
    ImuSample,
    PositionSample,
    PositionSource,
    Telemetry,
)
from drivers.telemetry.mavlink_samples import height_from_pressure
from drivers.telemetry.telemetry_log import GeodeticFix

NED_FROM_ENU: Array = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
FRD_FROM_FLU: Array = np.diag([1.0, -1.0, -1.0])
UNKNOWN_COVARIANCE = 0
NO_ORIENTATION = -1.0
LEAST_PRESSURE_PA = 1e4


def imu_samples(message: Any, body_from_imu: Array, with_attitude: bool) -> Iterator[Telemetry]:
    """Rates and accelerations, and the orientation if valid."""
    turn = FRD_FROM_FLU @ body_from_imu
    gyro = turn @ _xyz(message.angular_velocity)
    yield ImuSample(0, gyro, turn @ _xyz(message.linear_acceleration))
    stated = float(message.orientation_covariance[0]) != NO_ORIENTATION
    rotation = _rotation(message.orientation)
    if with_attitude and stated and rotation is not None:
        ned_from_body = NED_FROM_ENU @ rotation @ turn.T
        yield AttitudeSample(0, quaternion_from_rotation(ned_from_body), gyro)


def odometry_samples(message: Any, body_from_child: Pose) -> Iterator[Telemetry]:
    """Position, velocity and attitude of an Odometry, in its child frame."""
    rotation = _rotation(message.pose.pose.orientation)
    position = _xyz(message.pose.pose.position)
    if rotation is None:
        yield PositionSample(0, PositionSource.LOCAL, NED_FROM_ENU @ position)
        return
    world_from_body = Pose(rotation, position) @ body_from_child.inverse()
    velocity = NED_FROM_ENU @ rotation @ _xyz(message.twist.twist.linear)
    yield PositionSample(
        0, PositionSource.LOCAL, NED_FROM_ENU @ world_from_body.translation, velocity
    )
    yield AttitudeSample(
        0, quaternion_from_rotation(NED_FROM_ENU @ world_from_body.rotation @ FRD_FROM_FLU)
    )


def pose_samples(message: Any) -> Iterator[Telemetry]:
    """Position and attitude of a PoseStamped of the body."""
    rotation = _rotation(message.pose.orientation)
    yield PositionSample(0, PositionSource.LOCAL, NED_FROM_ENU @ _xyz(message.pose.position))
    if rotation is not None:
        ned_from_body = NED_FROM_ENU @ rotation @ FRD_FROM_FLU
        yield AttitudeSample(0, quaternion_from_rotation(ned_from_body))


def fix_samples(message: Any) -> Iterator[GeodeticFix]:
    """Position of a NavSatFix; none without a fix."""
    if message.status.status < 0:
        return
    sigmas: tuple[float | None, float | None] = (None, None)
    if message.position_covariance_type != UNKNOWN_COVARIANCE:
        east, north, up = (float(message.position_covariance[i]) for i in (0, 4, 8))
        if min(east, north, up) >= 0:
            sigmas = float(np.sqrt((east + north) / 2)), float(np.sqrt(up))
    place = float(message.latitude), float(message.longitude), float(message.altitude)
    if abs(place[0]) <= 90 and abs(place[1]) <= 180:
        yield GeodeticFix(PositionSource.GPS, *place, None, *sigmas)


def pressure_samples(message: Any) -> Iterator[Telemetry]:
    """Barometric height of a FluidPressure of the air (pascals)."""
    if message.fluid_pressure > LEAST_PRESSURE_PA:
        yield HeightSample(0, height_from_pressure(float(message.fluid_pressure)))


def pose_of_transform(transform: Any) -> Pose | None:
    """Pose of a geometry_msgs/Transform; None for an invalid rotation."""
    rotation = _rotation(transform.rotation)
    return None if rotation is None else Pose(rotation, _xyz(transform.translation))


def _xyz(vector: Any) -> Array:
    return np.array([vector.x, vector.y, vector.z], np.float64)


def _rotation(quaternion: Any) -> Array | None:
    q = np.array([quaternion.w, quaternion.x, quaternion.y, quaternion.z], np.float64)
    length = float(np.linalg.norm(q)) if np.isfinite(q).all() else 0.0
    return rotation_from_quaternion(q) if 0.5 < length < 2.0 else None
