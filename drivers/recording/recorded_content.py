"""Recorded messages as bytes, and back.

Numbers in JSON are read back exactly; nan, which JSON has not, is null.
"""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame

from companion.geometry.transforms import Similarity, quaternion_from_rotation
from companion.messages import (
    ArmedSample,
    AttitudeSample,
    FrameTracked,
    GateStep,
    HeightSample,
    ImuSample,
    LinkBytes,
    Odometry,
    PointChunk,
    PositionSample,
    PositionSource,
    RangeSample,
    Telemetry,
    Warned,
)
from drivers.recording.recording_topics import MavlinkBytes

WORLD, MAP = "local_ned", "map"
"""Coordinate frames for Foxglove."""
_SAMPLES: dict[str, type[Any]] = {
    "/telemetry/attitude": AttitudeSample,
    "/telemetry/imu": ImuSample,
    "/telemetry/position": PositionSample,
    "/telemetry/range": RangeSample,
    "/telemetry/height": HeightSample,
    "/telemetry/armed": ArmedSample,
}
_TOPIC_OF = {kind: topic for topic, kind in _SAMPLES.items()}
_LISTS = {
    "ned_from_body": 4, "rates_body_rad_s": 3, "gyro_rad_s": 3, "accel_m_s2": 3,
    "position_ned_m": 3, "velocity_ned_m_s": 3,
}  # fmt: skip
_MAY_LACK = {
    "rates_body_rad_s", "velocity_ned_m_s", "sigma_horizontal_m", "sigma_vertical_m",
}  # fmt: skip


def json_bytes(values: Mapping[str, Any]) -> bytes:
    """JSON object, in which nan and infinities are null."""
    return json.dumps(_plain(values), allow_nan=False, separators=(",", ":")).encode()


def sample_topic(sample: Telemetry) -> str:
    """Topic of a sample."""
    return _TOPIC_OF[type(sample)]


def fields_bytes(message: Telemetry | FrameTracked | GateStep) -> bytes:
    """A message of plain fields, without its time."""
    return json_bytes(
        {f.name: getattr(message, f.name) for f in dataclasses.fields(message) if f.name != "t_ns"}
    )


def is_sample_topic(topic: str) -> bool:
    """Whether a topic holds telemetry."""
    return topic in _SAMPLES


def sample_of(topic: str, t_ns: int, data: bytes) -> Telemetry:
    """Decoded sample; ValueError if invalid."""
    given = json.loads(data)
    if not isinstance(given, dict):
        raise ValueError("no object")
    kind = _SAMPLES[topic]
    values = {
        f.name: _value(f.name, given.get(f.name))
        for f in dataclasses.fields(kind)
        if f.name != "t_ns"
    }
    sample: Telemetry = kind(t_ns=t_ns, **values)
    return sample


def link_bytes(taken: LinkBytes) -> bytes:
    """Link bytes as a MavlinkBytes."""
    message = MavlinkBytes(
        monotonic_ns=taken.monotonic_ns, epoch_ns=taken.t_ns, data=taken.data
    )  # fmt: skip
    return serialised(message)


def odometry_bytes(odometry: Odometry) -> bytes:
    """All fields of an odometry."""
    pose = odometry.world_from_body
    return json_bytes(
        {
            "seq": odometry.seq,
            "state": odometry.state.value,
            "reset_counter": odometry.reset_counter,
            "quality": odometry.quality,
            "position_m": None if pose is None else pose.translation,
            "world_from_body": None if pose is None else quaternion_from_rotation(pose.rotation),
            "rotation": None if pose is None else pose.rotation.ravel(),
            "velocity_world_m_s": odometry.velocity_world_m_s,
            "sigma_position_m": odometry.sigma_position_m,
            "sigma_velocity_m_s": odometry.sigma_velocity_m_s,
            "sigma_attitude_rad": odometry.sigma_attitude_rad,
            "sigma_yaw_rad": odometry.sigma_yaw_rad,
        }
    )


def pose_bytes(odometry: Odometry) -> bytes | None:
    """Pose as a PoseInFrame; None while unknown."""
    pose = odometry.world_from_body
    if pose is None:
        return None
    message = PoseInFrame(frame_id=WORLD)
    set_time(message.timestamp, odometry.t_ns)
    _set_pose(message.pose, Similarity(1.0, pose.rotation, pose.translation))
    return serialised(message)


def event_bytes(warning: Warned) -> bytes:
    """Warning as a Log."""
    text = f"{warning.what}: {warning.detail}" if warning.detail else warning.what
    message = Log(level=Log.INFO if warning.good else Log.WARNING, message=text, name="companion")
    set_time(message.timestamp, warning.t_ns)
    return serialised(message)


def cloud_bytes(chunk: PointChunk, world_from_keyframe: Similarity, metric: bool) -> bytes:
    """Cloud as a PointCloud, packed x y z, r g b a; points are scaled, as poses have no scale."""
    message = PointCloud(frame_id=WORLD if metric else MAP, point_stride=16)
    set_time(message.timestamp, chunk.t_ns)
    _set_pose(message.pose, world_from_keyframe)
    for number, name in enumerate(("x", "y", "z")):
        message.fields.add(name=name, offset=4 * number, type=PackedElementField.FLOAT32)
    for number, name in enumerate(("red", "green", "blue", "alpha"), 12):
        message.fields.add(name=name, offset=number, type=PackedElementField.UINT8)
    points = chunk.points_camera * np.float32(world_from_keyframe.scale)
    packed = np.zeros((len(points), 16), np.uint8)
    packed[:, :12] = np.ascontiguousarray(points, "<f4").view(np.uint8).reshape(-1, 12)
    packed[:, 12:15] = chunk.rgb
    packed[:, 15] = np.clip(chunk.confidence * 255, 0, 255)
    message.data = packed.tobytes()
    return serialised(message)


def serialised(message: Any) -> bytes:
    """Serialised protobuf message."""
    out: bytes = message.SerializeToString()
    return out


def set_time(timestamp: Any, t_ns: int) -> None:
    """Fill in a protobuf Timestamp."""
    timestamp.seconds, timestamp.nanos = divmod(t_ns, 1_000_000_000)


def _set_pose(pose: Any, place: Similarity) -> None:
    x, y, z = map(float, place.translation)
    pose.position.x, pose.position.y, pose.position.z = x, y, z
    w, qx, qy, qz = map(float, quaternion_from_rotation(place.rotation))
    turn = pose.orientation
    turn.w, turn.x, turn.y, turn.z = w, qx, qy, qz


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _plain(each) for key, each in value.items()}
    if isinstance(value, np.ndarray):
        return [_plain(each) for each in value.tolist()]
    if isinstance(value, (list, tuple)):
        return [_plain(each) for each in value]
    if isinstance(value, PositionSource):
        return value.value
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    return value


def _number(value: Any) -> float:
    if value is None:
        return math.nan
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise ValueError(f"no number: {value!r}")
    return float(value)


def _value(name: str, given: Any) -> Any:
    if given is None and name in _MAY_LACK:
        return None
    if name in _LISTS:
        if not isinstance(given, list) or len(given) != _LISTS[name]:
            raise ValueError(f"{name} is {given!r}")
        return np.array([_number(each) for each in given])
    if name == "source":
        return PositionSource(given)
    if name == "armed":
        if not isinstance(given, bool):
            raise ValueError(f"{name} is {given!r}")
        return given
    return _number(given)
