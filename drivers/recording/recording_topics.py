"""Topics of a recording, and their schemas; for users in docs/recording.md.

Images, poses, clouds and events have Foxglove's schemas, as protobuf; link bytes our own, as
protobuf; all else is JSON with a JSON schema.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.CompressedVideo_pb2 import CompressedVideo
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

from drivers.recording.mcap_writer import McapWriter

PROFILE = "companion"
"""Profile in the header of a recording; a number after it would mark a later layout."""

IMAGE, VIDEO, RAW, GREY = "/camera/image", "/camera/video", "/camera/raw", "/camera/grey"
CALIBRATION = "/camera/calibration"
RECEIVED, SENT = "/mavlink/received", "/mavlink/sent"
TIMESYNC = "/mavlink/timesync"
POSE, ODOMETRY, CLOUD = "/pose", "/odometry", "/cloud"
EVENTS, HEALTH = "/events", "/health"
TRACKING, GATE = "/decisions/tracking", "/decisions/pose_gate"
PICTURES = frozenset({IMAGE, VIDEO, RAW})
"""Topics of images, of which a flight has one."""
ARMED = "/telemetry/armed"
LASTING = frozenset({CALIBRATION, HEALTH, ARMED})
"""Topics whose messages hold until the next one, which may never come."""

_FIELD = descriptor_pb2.FieldDescriptorProto


def _own_messages() -> descriptor_pb2.FileDescriptorProto:
    """MavlinkBytes, as a .proto file would define it."""
    file = descriptor_pb2.FileDescriptorProto(
        name="companion/MavlinkBytes.proto", package="companion", syntax="proto3"
    )
    message = file.message_type.add(name="MavlinkBytes")
    for number, (name, kind) in enumerate(
        [
            ("monotonic_ns", _FIELD.TYPE_FIXED64),
            ("epoch_ns", _FIELD.TYPE_FIXED64),
            ("data", _FIELD.TYPE_BYTES),
        ],
        1,
    ):
        message.field.add(name=name, number=number, type=kind, label=_FIELD.LABEL_OPTIONAL)
    return file


_pool = descriptor_pool.DescriptorPool()
_pool.Add(_own_messages())
MavlinkBytes: Any = message_factory.GetMessageClass(
    _pool.FindMessageTypeByName("companion.MavlinkBytes")
)


@dataclass(frozen=True, slots=True)
class _Json:
    """JSON object: its name, description, and properties."""

    name: str
    says: str
    properties: Mapping[str, Any]


NUMBER, TEXT, FLAG, OBJECT = {"type": "number"}, {"type": "string"}, {"type": "boolean"}, {
    "type": "object"
}  # fmt: skip
NUMBERS = {"type": "array", "items": {"type": ["number", "null"]}}
OBJECTS = {"type": "array", "items": OBJECT}
INTEGER = {"type": "integer"}

TOPICS: dict[str, Any] = {
    IMAGE: CompressedImage,
    VIDEO: CompressedVideo,
    RAW: RawImage,
    GREY: RawImage,
    CALIBRATION: CameraCalibration,
    RECEIVED: MavlinkBytes,
    SENT: MavlinkBytes,
    TIMESYNC: _Json(
        "companion.TimesyncExchange",
        "Unix ns of our clock at asking and at the answer, and the autopilot's between",
        {"sent_ns": INTEGER, "autopilot_ns": INTEGER, "received_ns": INTEGER},
    ),
    "/telemetry/attitude": _Json(
        "companion.AttitudeSample",
        "Attitude of the body (FRD) in NED: quaternion w x y z; body rates, rad/s",
        {"ned_from_body": NUMBERS, "rates_body_rad_s": NUMBERS},
    ),
    "/telemetry/imu": _Json(
        "companion.ImuSample",
        "Angular rate and specific force in the body frame (FRD)",
        {"gyro_rad_s": NUMBERS, "accel_m_s2": NUMBERS},
    ),
    "/telemetry/position": _Json(
        "companion.PositionSample",
        "Position and velocity of the body in local NED",
        {
            "source": TEXT, "position_ned_m": NUMBERS, "velocity_ned_m_s": NUMBERS,
            "sigma_horizontal_m": NUMBER, "sigma_vertical_m": NUMBER,
        },
    ),
    "/telemetry/range": _Json(
        "companion.RangeSample", "Distance to the ground along the body's down axis",
        {"distance_m": NUMBER},
    ),
    "/telemetry/height": _Json(
        "companion.HeightSample", "Barometric height above an arbitrary level, up positive",
        {"height_m": NUMBER},
    ),
    ARMED: _Json(
        "companion.ArmedSample", "Whether the motors are armed", {"armed": FLAG}
    ),
    POSE: PoseInFrame,
    ODOMETRY: _Json(
        "companion.Odometry",
        "What the autopilot may be told: body (FRD) in local NED, metres; null while not known",
        {
            "seq": INTEGER, "state": TEXT, "reset_counter": INTEGER, "quality": INTEGER,
            "position_m": NUMBERS, "world_from_body": NUMBERS, "rotation": NUMBERS,
            "velocity_world_m_s": NUMBERS,
            "sigma_position_m": NUMBER, "sigma_velocity_m_s": NUMBER, "sigma_attitude_rad": NUMBER,
            "sigma_yaw_rad": NUMBER,
        },
    ),
    TRACKING: _Json(
        "companion.FrameTracked",
        "What a frame's pose hung on beside its image, for a replay as flown",
        {
            "seq": INTEGER, "n_samples": INTEGER, "mapping_point": INTEGER,
            "feature_ratio": NUMBER,
        },
    ),
    GATE: _Json(
        "companion.GateStep",
        "What the gate of poses to the autopilot was asked, for a replay as flown",
        {
            "what": TEXT, "n_attitudes": INTEGER, "counter": INTEGER, "counter_sent": FLAG,
            "sent": FLAG, "values": OBJECT,
        },
    ),
    CLOUD: PointCloud,
    EVENTS: Log,
    HEALTH: _Json(
        "companion.Health",
        "How the daemon was: its status document, the autopilot's clock, the origin of local NED; "
        "of an import, what was amiss with its source",
        {"health": OBJECT, "clock": OBJECT, "origin": OBJECT, "warnings": OBJECTS},
    ),
}  # fmt: skip
"""In order of their channels."""


def open_channels(writer: McapWriter) -> dict[str, int]:
    """Add a channel for each topic; their ids."""
    schemas: dict[str, int] = {}
    channels = {}
    for topic, kind in TOPICS.items():
        is_json = isinstance(kind, _Json)
        name = kind.name if is_json else kind.DESCRIPTOR.full_name
        if name not in schemas:
            schemas[name] = (
                writer.schema(name, "jsonschema", _json_schema(kind))
                if is_json
                else writer.schema(name, "protobuf", _descriptors(kind))
            )
        channels[topic] = writer.channel(topic, "json" if is_json else "protobuf", schemas[name])
    return channels


def _json_schema(kind: _Json) -> bytes:
    schema = {
        "title": kind.name,
        "description": kind.says,
        "type": "object",
        "properties": dict(kind.properties),
    }
    return json.dumps(schema).encode()


def _descriptors(kind: Any) -> bytes:
    """The message's file and all its imports, dependencies first."""
    files: dict[str, descriptor_pb2.FileDescriptorProto] = {}

    def take(file: Any) -> None:
        for needed in file.dependencies:
            take(needed)
        if file.name not in files:
            files[file.name] = proto = descriptor_pb2.FileDescriptorProto()
            file.CopyToProto(proto)

    take(kind.DESCRIPTOR.file)
    out: bytes = descriptor_pb2.FileDescriptorSet(file=files.values()).SerializeToString()
    return out
