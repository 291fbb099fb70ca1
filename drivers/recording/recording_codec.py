"""Recorded messages as bytes, and back.

Numbers in JSON are read back exactly; nan, which JSON has not, is null.
"""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Mapping
from enum import Enum
from typing import Any

import numpy as np
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame

from companion.flight_notes import GateStep, LinkBytes, ObstaclePoints
from companion.geometry.camera import Camera, Distortion
from companion.geometry.transforms import Similarity, quaternion_from_rotation
from companion.messages import (
    FrameTracked,
    LandingTarget,
    MapTakenUp,
    Odometry,
    OpticalFlow,
    PointChunk,
    SiteMapUsed,
    Warned,
)
from companion.sample_schema import Field
from companion.telemetry import FIELDS, TELEMETRY, Telemetry
from drivers.recording.recording_topics import (
    MapOfBefore,
    MavlinkBytes,
    PointsOfKeyframe,
    telemetry_topic,
)

WORLD, MAP = "local_ned", "map"
"""Coordinate frames for Foxglove."""
_LENS_WORDS = {
    Distortion.NONE: "",
    Distortion.RADTAN: "plumb_bob",
    Distortion.EQUIDISTANT: "equidistant",
}
_KINDS = {telemetry_topic(kind): kind for kind in TELEMETRY}
_JSON = json.JSONEncoder(allow_nan=False, separators=(",", ":"))
_AS_THEY_ARE = {int, str, bool, type(None)}


def json_bytes(values: Mapping[str, Any]) -> bytes:
    """JSON object, in which nan and infinities are null."""
    return _JSON.encode(_plain(values)).encode()


def sample_topic(sample: Telemetry) -> str:
    """Topic of a sample."""
    return telemetry_topic(type(sample))


def sample_bytes(sample: Telemetry) -> bytes:
    """A sample without its time."""
    values = ((field, getattr(sample, field.name)) for field in FIELDS[type(sample)])
    return json_bytes({f.name: value for f, value in values if not f.where_true or value})


def decision_bytes(
    decision: FrameTracked | GateStep | SiteMapUsed | LandingTarget | OpticalFlow,
) -> bytes:
    """A decision, a landing target or an optical flow, without its time."""
    names = [each.name for each in dataclasses.fields(decision) if each.name != "t_ns"]
    return json_bytes({name: getattr(decision, name) for name in names})


def is_sample_topic(topic: str) -> bool:
    """True if a topic holds telemetry."""
    return topic in _KINDS


def sample_of(topic: str, t_ns: int, data: bytes) -> Telemetry:
    """Decoded sample; ValueError if invalid."""
    given = json.loads(data)
    if not isinstance(given, dict):
        raise ValueError("no object")
    kind = _KINDS[topic]
    return kind(t_ns=t_ns, **{f.name: _value(f, given.get(f.name)) for f in FIELDS[kind]})


def link_bytes(taken: LinkBytes) -> bytes:
    """Link bytes as a MavlinkBytes."""
    message = MavlinkBytes(
        monotonic_ns=taken.monotonic_ns, epoch_ns=taken.t_ns, data=taken.data
    )  # fmt: skip
    return serialised(message)


def obstacle_points_bytes(part: ObstaclePoints) -> bytes:
    """Points in which obstacles are looked for, without their time."""
    points = part.points_camera.astype("<f4").tobytes()
    return serialised(PointsOfKeyframe(keyframe_id=part.keyframe_id, points=points))


def map_of_before_bytes(taken: MapTakenUp) -> bytes:
    """A map that was taken up, without its time."""
    return serialised(MapOfBefore(absent_ns=taken.absent_ns, data=taken.data.tobytes()))


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
            "inertial": odometry.inertial,
            "sigma_scale": odometry.sigma_scale,
            "sigma_by_scale_m": odometry.sigma_by_scale_m,
            "unaided_s": odometry.unaided_s,
            "refused": odometry.refused,
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


def calibration_bytes(camera: Camera, t_ns: int) -> bytes:
    """Camera as Foxglove's CameraCalibration."""
    matrix = camera.matrix()
    message = CameraCalibration(
        frame_id="camera", width=camera.width, height=camera.height,
        distortion_model=_LENS_WORDS[camera.distortion], D=camera.coefficients,
        K=matrix.ravel().tolist(), R=np.eye(3).ravel().tolist(),
        P=np.column_stack([matrix, np.zeros(3)]).ravel().tolist(),
    )  # fmt: skip
    set_time(message.timestamp, t_ns)
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
    if isinstance(value, float):  # most of all, and what is a mapping is slow to tell
        return float(value) if math.isfinite(value) else None
    if type(value) in _AS_THEY_ARE:
        return value
    if isinstance(value, Mapping):
        return {str(key): _plain(each) for key, each in value.items()}
    if isinstance(value, np.ndarray):
        return [_plain(each) for each in value.tolist()]
    if isinstance(value, (list, tuple)):
        return [_plain(each) for each in value]
    if isinstance(value, Enum):
        return value.value
    return value


def _number(value: Any) -> float:
    if value is None:
        return math.nan
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise ValueError(f"no number: {value!r}")
    return float(value)


def _value(field: Field, given: Any) -> Any:
    if given is None and (field.may_lack or field.where_true):
        return False if field.where_true else None
    if field.size is not None:
        if not isinstance(given, list) or len(given) != field.size:
            raise ValueError(f"{field.name} is {given!r}")
        return np.array([_number(each) for each in given])
    if field.words is not None:
        return field.words(given)
    if field.is_flag:
        if not isinstance(given, bool):
            raise ValueError(f"{field.name} is {given!r}")
        return given
    return _number(given)
