"""Pose, points and pictures as ROS 2 has them: standard messages, as CDR.

Axes are those of ROS (REP 103): the world, frame `map`, is east, north, up; the body, `base_link`,
forward, left, up.
"""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np

from companion.geometry.transforms import Array, quaternion_from_rotation
from companion.messages import Bytes, Floats, Odometry

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

ODOMETRY = "nav_msgs/msg/Odometry"
POINTS = "sensor_msgs/msg/PointCloud2"
IMAGE = "sensor_msgs/msg/CompressedImage"
WORLD, BODY, CAMERA = "map", "base_link", "camera"
ENU_FROM_NED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
FLU_FROM_FRD = np.diag([1.0, -1.0, -1.0])
UNKNOWN_SIGMA = 1e4
FLOAT32 = 7
POINT = np.dtype([("xyz", "<f4", 3), ("rgb", "<u4")])


def type_hash(kind: str) -> str:
    """Hash of a message's definition (REP 2016)."""
    return str(_store().hash_rihs01(kind))


def odometry_cdr(odometry: Odometry) -> bytes | None:
    """nav_msgs/Odometry; None while there is no pose. Rates of rotation are not known, and zero."""
    pose, velocity = odometry.world_from_body, odometry.velocity_world_m_s
    if pose is None:
        return None
    kinds = _store().types
    vector, point = kinds["geometry_msgs/msg/Vector3"], kinds["geometry_msgs/msg/Point"]
    w, x, y, z = quaternion_from_rotation(ENU_FROM_NED @ pose.rotation @ FLU_FROM_FRD)
    speed = np.zeros(3) if velocity is None else FLU_FROM_FRD @ pose.rotation.T @ velocity
    tilt, position = odometry.sigma_attitude_rad, odometry.sigma_position_m
    made = kinds[ODOMETRY](
        _header(odometry.t_ns, WORLD), BODY,
        kinds["geometry_msgs/msg/PoseWithCovariance"](
            kinds["geometry_msgs/msg/Pose"](
                point(*map(float, ENU_FROM_NED @ pose.translation)),
                kinds["geometry_msgs/msg/Quaternion"](*map(float, (x, y, z, w))),
            ),
            _covariance([position] * 3 + [tilt, tilt, odometry.sigma_yaw_rad]),
        ),
        kinds["geometry_msgs/msg/TwistWithCovariance"](
            kinds["geometry_msgs/msg/Twist"](vector(*map(float, speed)), vector(0.0, 0.0, 0.0)),
            _covariance([odometry.sigma_velocity_m_s] * 3 + [np.inf] * 3),
        ),
    )  # fmt: skip
    return _cdr(made, ODOMETRY)


def points_cdr(t_ns: int, points_world: Array, rgb: Bytes) -> bytes:
    """sensor_msgs/PointCloud2 of points (N, 3) in local NED, with colours (N, 3)."""
    kinds = _store().types
    points = np.zeros(len(points_world), POINT)
    points["xyz"] = points_world @ ENU_FROM_NED.T
    points["rgb"] = rgb.astype(np.uint32) @ np.array([1 << 16, 1 << 8, 1], np.uint32)
    field = kinds["sensor_msgs/msg/PointField"]
    fields = [field(name, 4 * n, FLOAT32, 1) for n, name in enumerate(("x", "y", "z", "rgb"))]
    made = kinds[POINTS](
        _header(t_ns, WORLD), 1, len(points), fields, False, POINT.itemsize,
        points.nbytes, points.view(np.uint8), True,
    )  # fmt: skip
    return _cdr(made, POINTS)


def image_cdr(t_ns: int, jpeg: bytes) -> bytes:
    """sensor_msgs/CompressedImage of a JPEG."""
    made = _store().types[IMAGE](_header(t_ns, CAMERA), "jpeg", np.frombuffer(jpeg, np.uint8))
    return _cdr(made, IMAGE)


@cache
def _store() -> Typestore:
    """Definitions of messages; those that are used here are the same in all of ROS 2."""
    from rosbags.typesys import Stores, get_typestore  # here: most flights tell ROS nothing

    return get_typestore(Stores.ROS2_HUMBLE)


def _cdr(message: object, kind: str) -> bytes:
    return bytes(_store().serialize_cdr(message, kind))


def _header(t_ns: int, frame: str) -> Any:
    kinds = _store().types
    stamp = kinds["builtin_interfaces/msg/Time"](*divmod(t_ns, 1_000_000_000))
    return kinds["std_msgs/msg/Header"](stamp, frame)


def _covariance(sigmas: list[float]) -> Floats | Array:
    return np.diag(np.minimum(np.array(sigmas, np.float64), UNKNOWN_SIGMA) ** 2).ravel()
