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

from companion.sample_schema import Field
from companion.telemetry import FIELDS, TELEMETRY, ArmedSample, Telemetry
from drivers.recording.mcap_writer import McapWriter

PROFILE = "companion"
"""Profile in the header of a recording; a number after it would mark a later layout."""

IMAGE, VIDEO, RAW, GREY = "/camera/image", "/camera/video", "/camera/raw", "/camera/grey"
CALIBRATION = "/camera/calibration"
RECEIVED, SENT = "/mavlink/received", "/mavlink/sent"
TIMESYNC = "/mavlink/timesync"
POSE, ODOMETRY, CLOUD = "/pose", "/odometry", "/cloud"
EVENTS, HEALTH = "/events", "/health"
TRACKING, GATES = "/decisions/tracking", "/decisions/gates"
SITE_MAP = "/decisions/site_map"
LANDING, FLOW = "/landing_target", "/optical_flow"
MAP_TAKEN_UP, OBSTACLE_POINTS = "/decisions/map_taken_up", "/decisions/obstacle_points"
PICTURES = frozenset({IMAGE, VIDEO, RAW})
"""Topics of images, of which a flight has one."""
FROM_PICTURES = frozenset(
    {
        GREY,
        POSE,
        ODOMETRY,
        CLOUD,
        TRACKING,
        GATES,
        SITE_MAP,
        LANDING,
        FLOW,
        MAP_TAKEN_UP,
        OBSTACLE_POINTS,
    }
)
"""Topics of what was made of images."""

_FIELD = descriptor_pb2.FieldDescriptorProto


def telemetry_topic(kind: type[Telemetry]) -> str:
    """Topic of a kind of telemetry."""
    return f"/telemetry/{kind.schema.name}"


LASTING = frozenset({CALIBRATION, HEALTH, telemetry_topic(ArmedSample)})
"""Topics whose messages hold until the next one, which may never come."""


def _own_message(name: str, fields: Mapping[str, int]) -> Any:
    """Class of a message of our own, as a .proto file would define it."""
    file = descriptor_pb2.FileDescriptorProto(
        name=f"companion/{name}.proto", package="companion", syntax="proto3"
    )
    message = file.message_type.add(name=name)
    for number, (field, kind) in enumerate(fields.items(), 1):
        message.field.add(name=field, number=number, type=kind, label=_FIELD.LABEL_OPTIONAL)
    _pool.Add(file)
    return message_factory.GetMessageClass(_pool.FindMessageTypeByName(f"companion.{name}"))


_pool = descriptor_pool.DescriptorPool()
MavlinkBytes: Any = _own_message(
    "MavlinkBytes",
    {
        "monotonic_ns": _FIELD.TYPE_FIXED64,
        "epoch_ns": _FIELD.TYPE_FIXED64,
        "data": _FIELD.TYPE_BYTES,
    },
)
MapOfBefore: Any = _own_message(
    "MapTakenUp", {"absent_ns": _FIELD.TYPE_FIXED64, "data": _FIELD.TYPE_BYTES}
)
PointsOfKeyframe: Any = _own_message(
    "ObstaclePoints", {"keyframe_id": _FIELD.TYPE_FIXED64, "points": _FIELD.TYPE_BYTES}
)
"""`points` are x, y, z of each, float32, little-endian."""


@dataclass(frozen=True, slots=True)
class _Json:
    """JSON object: its name, description, and properties.

    Foxglove refuses a topic where a type is a list, an object has no properties, or items of an
    array are arrays: what can be null is of the type that it has otherwise, and what is nested more
    is not described.
    """

    name: str
    says: str
    properties: Mapping[str, Any]


NUMBER, TEXT, FLAG = {"type": "number"}, {"type": "string"}, {"type": "boolean"}
OBJECT: Mapping[str, Any] = {"type": "object", "properties": {}}
NUMBERS = {"type": "array", "items": NUMBER}
OBJECTS = {"type": "array", "items": OBJECT}
INTEGER = {"type": "integer"}


def _telemetry_json(kind: type[Telemetry]) -> _Json:
    """JSON object of a kind of telemetry."""
    properties = {field.name: _json_type(field) for field in FIELDS[kind]}
    return _Json(f"companion.{kind.__name__}", kind.schema.says, properties)


def _json_type(field: Field) -> Mapping[str, Any]:
    if field.size is not None:
        return NUMBERS
    return FLAG if field.is_flag else TEXT if field.words is not None else NUMBER


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
    **{telemetry_topic(kind): _telemetry_json(kind) for kind in TELEMETRY},
    POSE: PoseInFrame,
    ODOMETRY: _Json(
        "companion.Odometry",
        "What the autopilot may be told: body (FRD) in local NED, metres; null while not known",
        {
            "seq": INTEGER, "state": TEXT, "reset_counter": INTEGER, "quality": INTEGER,
            "position_m": NUMBERS, "world_from_body": NUMBERS, "rotation": NUMBERS,
            "velocity_world_m_s": NUMBERS,
            "sigma_position_m": NUMBER, "sigma_velocity_m_s": NUMBER, "sigma_attitude_rad": NUMBER,
            "sigma_yaw_rad": NUMBER, "inertial": FLAG,
            "sigma_scale": NUMBER, "sigma_by_scale_m": NUMBER, "unaided_s": NUMBER,
            "refused": OBJECT,
        },
    ),
    TRACKING: _Json(
        "companion.FrameTracked",
        "What a frame's pose hung on beside its image, for a replay as flown",
        {
            "seq": INTEGER, "n_samples": INTEGER, "mapping_point": INTEGER,
            "feature_ratio": NUMBER, "has_picture": FLAG,
            "origin": NUMBERS,
        },
    ),
    GATES: _Json(
        "companion.GateStep",
        "What a gate of all that the autopilot is sent was asked, for a replay as flown",
        {"gate": TEXT, "what": TEXT, "n_samples": INTEGER, "sent": FLAG, "values": OBJECT},
    ),
    SITE_MAP: _Json(
        "companion.SiteMapUsed",
        "The map of an earlier flight in use: its file, revision, and BLAKE2b digest",
        {"path": TEXT, "revision": INTEGER, "digest": TEXT},
    ),
    LANDING: _Json(
        "companion.LandingTarget",
        "The landing marker in one image: centre from the body, its standard deviations, and the "
        "normals of its face, body axes (FRD), metres; null where it is not seen",
        {
            "seq": INTEGER, "position_body_m": NUMBERS, "sigma_body_m": NUMBERS,
            "size_px": NUMBER, "why_not": TEXT,
        },
    ),
    FLOW: _Json(
        "companion.OpticalFlow",
        "Flow of the ground since the frame before, about the body's forward and right axes, "
        "without its rotation; null where it was not measured",
        {
            "seq": INTEGER, "dt_s": NUMBER, "flow_rad_s": NUMBERS, "turn_rad": NUMBERS,
            "sigma_rad_s": NUMBER, "quality": INTEGER, "distance_m": NUMBER, "why_not": TEXT,
        },
    ),
    MAP_TAKEN_UP: MapOfBefore,
    OBSTACLE_POINTS: PointsOfKeyframe,
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
