"""Bags of ROS with a few seconds of the sample flight, written by rosbags' writers.

The world is east-north-up and the body forward-left-up there, as robots have it; the camera hangs
under `base_link`, and the IMU is turned half about its vertical axis.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from companion.geometry.geodesy import GeoOrigin, geodetic_from_ned
from companion.geometry.transforms import (
    Array,
    Pose,
    quaternion_from_rotation,
    rotation_from_quaternion,
)
from companion.telemetry import AttitudeSample, PositionSample, PositionSource
from tests.support.flights.sequences import Piece

ENU_FROM_NED = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])
FLU_FROM_FRD = np.diag([1.0, -1, -1])
TRANSFORMS = "geometry_msgs/TransformStamped[] transforms\n"
CAMERA = "/front/image_raw"
LATE_NS = 3_000_000
"""Messages are recorded so long after what they tell of."""


class BagWriter:
    """Writes messages into a bag of one kind: "ros1", "sqlite" or "mcap"."""

    def __init__(self, path: Path, kind: str, packed: bool = False) -> None:
        self.is2 = kind != "ros1"
        self.types = get_typestore(Stores.ROS2_HUMBLE if self.is2 else Stores.ROS1_NOETIC)
        transforms = {} if self.is2 else get_types_from_msg(TRANSFORMS, "tf2_msgs/msg/TFMessage")
        self.types.register(transforms)
        self._writer: Any
        if self.is2:
            plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
            self._writer = Writer2(path, version=8, storage_plugin=plugin)
            if packed:
                mode = CompressionMode.STORAGE if kind == "mcap" else CompressionMode.MESSAGE
                self._writer.set_compression(mode, CompressionFormat.ZSTD)
        else:
            self._writer = Writer1(path)
            if packed:
                self._writer.set_compression(Writer1.CompressionFormat.LZ4)
        self._topics: dict[str, Any] = {}
        self._seq = 0

    def __enter__(self) -> BagWriter:
        self._writer.open()
        return self

    def __exit__(self, *_: object) -> None:
        self._writer.close()

    def make(self, kind: str, *values: Any) -> Any:
        """A message or a part of one."""
        package, name = kind.split("/")
        return self.types.types[f"{package}/msg/{name}"](*values)

    def header(self, t_ns: int, frame: str) -> Any:
        stamp = self.make("builtin_interfaces/Time", t_ns // 10**9, t_ns % 10**9)
        self._seq += 1
        first = [] if self.is2 else [self._seq]
        return self.make("std_msgs/Header", *first, stamp, frame)

    def write(self, topic: str, kind: str, t_ns: int, message: Any) -> None:
        name = kind.replace("/", "/msg/")
        if topic not in self._topics:
            self._topics[topic] = self._writer.add_connection(topic, name, typestore=self.types)
        serialise = self.types.serialize_cdr if self.is2 else self.types.serialize_ros1
        self._writer.write(self._topics[topic], t_ns + LATE_NS, bytes(serialise(message, name)))

    def vector(self, v: Array, kind: str = "geometry_msgs/Vector3") -> Any:
        return self.make(kind, *map(float, v))

    def quaternion(self, rotation: Array) -> Any:
        w, x, y, z = map(float, quaternion_from_rotation(rotation))
        return self.make("geometry_msgs/Quaternion", x, y, z, w)


def write_bag(
    path: Path, kind: str, flown: Piece, origin: GeoOrigin | None = None, compressed: bool = False,
    packed: bool = False,
) -> None:  # fmt: skip
    """Camera, IMU and odometry; with an origin satellite fixes instead of the odometry.

    Its pictures are `compressed`, or it is `packed` as a whole.
    """
    with BagWriter(path, kind, packed) as bag:
        _transforms(bag, flown)
        _camera_info(bag, flown)
        for frame in flown.frames:
            _picture(bag, frame.t_ns, frame.rgb, compressed)
        last: AttitudeSample | None = None
        for sample in flown.samples:
            if isinstance(sample, AttitudeSample):
                last = sample
                _imu(bag, sample)
            elif isinstance(sample, PositionSample) and sample.source is PositionSource.LOCAL:
                if origin is not None:
                    _fix(bag, sample, origin)
                elif last is not None:
                    _odometry(bag, sample, last)


def _transforms(bag: BagWriter, flown: Piece) -> None:
    t_ns = flown.frames[0].t_ns - 10**9
    camera = flown.camera.body_from_camera
    assert camera is not None
    turned = Pose(np.diag([-1.0, -1, 1]), np.zeros(3))
    base_from = {"front_optical": Pose(FLU_FROM_FRD, np.zeros(3)) @ camera, "imu": turned}
    stamped = [
        bag.make(
            "geometry_msgs/TransformStamped", bag.header(t_ns, "base_link"), frame,
            bag.make("geometry_msgs/Transform", bag.vector(pose.translation),
                     bag.quaternion(pose.rotation)),
        )
        for frame, pose in base_from.items()
    ]  # fmt: skip
    bag.write("/tf_static", "tf2_msgs/TFMessage", t_ns, bag.make("tf2_msgs/TFMessage", stamped))


def _camera_info(bag: BagWriter, flown: Piece) -> None:
    c, t_ns = flown.camera, flown.frames[0].t_ns - 10**8
    region = bag.make("sensor_msgs/RegionOfInterest", 0, 0, 0, 0, False)
    p = np.hstack([c.matrix(), np.zeros((3, 1))])
    info = bag.make(
        "sensor_msgs/CameraInfo", bag.header(t_ns, "front_optical"), c.height, c.width,
        "plumb_bob", np.array(c.coefficients), c.matrix().ravel(), np.eye(3).ravel(), p.ravel(),
        0, 0, region,
    )  # fmt: skip
    bag.write("/front/camera_info", "sensor_msgs/CameraInfo", t_ns, info)


def _picture(bag: BagWriter, t_ns: int, rgb: Any, compressed: bool) -> None:
    header = bag.header(t_ns, "front_optical")
    bgr = np.ascontiguousarray(rgb[..., ::-1])
    if compressed:
        data = cv2.imencode(".png", bgr)[1].ravel()
        kind, topic = "sensor_msgs/CompressedImage", CAMERA + "/compressed"
        message = bag.make(kind, header, "bgr8; png compressed bgr8", data)
    else:
        kind, topic = "sensor_msgs/Image", CAMERA
        height, width = rgb.shape[:2]
        padded = np.zeros((height, width * 3 + 16), np.uint8)  # rows may be longer than pictures
        padded[:, : width * 3] = bgr.reshape(height, -1)
        message = bag.make(kind, header, height, width, "bgr8", 0, padded.shape[1], padded.ravel())
    bag.write(topic, kind, t_ns, message)


def _imu(bag: BagWriter, sample: AttitudeSample) -> None:
    turned = np.diag([-1.0, -1, 1])
    rates = sample.rates_body_rad_s if sample.rates_body_rad_s is not None else np.zeros(3)
    enu_from_flu = ENU_FROM_NED @ rotation_from_quaternion(sample.ned_from_body) @ FLU_FROM_FRD
    message = bag.make(
        "sensor_msgs/Imu", bag.header(sample.t_ns, "imu"), bag.quaternion(enu_from_flu @ turned),
        np.full(9, 0.01), bag.vector(turned @ FLU_FROM_FRD @ rates), np.full(9, 0.01),
        bag.vector(turned @ FLU_FROM_FRD @ [0.5, -0.25, -9.75]), np.full(9, 0.01),
    )  # fmt: skip
    bag.write("/imu/data", "sensor_msgs/Imu", sample.t_ns, message)


def _odometry(bag: BagWriter, sample: PositionSample, attitude: AttitudeSample) -> None:
    enu_from_flu = ENU_FROM_NED @ rotation_from_quaternion(attitude.ned_from_body) @ FLU_FROM_FRD
    assert sample.velocity_ned_m_s is not None
    velocity = enu_from_flu.T @ ENU_FROM_NED @ sample.velocity_ned_m_s
    place = bag.vector(ENU_FROM_NED @ sample.position_ned_m, "geometry_msgs/Point")
    zero = bag.vector(np.zeros(3))
    message = bag.make(
        "nav_msgs/Odometry", bag.header(sample.t_ns, "odom"), "base_link",
        bag.make("geometry_msgs/PoseWithCovariance",
                 bag.make("geometry_msgs/Pose", place, bag.quaternion(enu_from_flu)),
                 np.zeros(36)),
        bag.make("geometry_msgs/TwistWithCovariance",
                 bag.make("geometry_msgs/Twist", bag.vector(velocity), zero), np.zeros(36)),
    )  # fmt: skip
    bag.write("/odom", "nav_msgs/Odometry", sample.t_ns, message)


def _fix(bag: BagWriter, sample: PositionSample, origin: GeoOrigin) -> None:
    ((latitude, longitude, altitude),) = geodetic_from_ned(sample.position_ned_m[None], origin)
    message = bag.make(
        "sensor_msgs/NavSatFix", bag.header(sample.t_ns, "gps"),
        bag.make("sensor_msgs/NavSatStatus", 0, 1), float(latitude), float(longitude),
        float(altitude), np.diag([1.0, 4.0, 9.0]).ravel(), 2,
    )  # fmt: skip
    bag.write("/fix", "sensor_msgs/NavSatFix", sample.t_ns, message)
