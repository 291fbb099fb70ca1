"""Decisions of a recorded flight, in the order in which they came, for a replay as flown."""

from __future__ import annotations

import dataclasses
import json
import struct
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from foxglove_schemas_protobuf.Log_pb2 import Log
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.config import Config
from companion.config_file import config_of_text
from companion.errors import FlightError
from companion.estimation.gate.gate_journal import (
    FLOW,
    GLOBAL,
    LANDING,
    OBSTACLES,
    POSE,
    SOURCES,
)
from companion.flight_notes import GateStep, ObstaclePoints
from companion.geometry.transforms import Pose
from companion.messages import (
    FrameTracked,
    LandingTarget,
    MapTakenUp,
    Odometry,
    OpticalFlow,
    SiteMapUsed,
    TrackState,
)
from companion.telemetry import Telemetry
from drivers.mavlink.measurements.pose_messages import FRAMES
from drivers.mavlink.vehicle import Firmware
from drivers.mavlink.wire.packet_stream import MavlinkStream
from drivers.recording.recorder import CONFIG_TOML, NOTES
from drivers.recording.recording_codec import is_sample_topic, sample_of
from drivers.recording.recording_reader import RecordingReader
from drivers.recording.recording_topics import (
    EVENTS,
    GATES,
    MAP_TAKEN_UP,
    OBSTACLE_POINTS,
    ODOMETRY,
    SENT,
    SITE_MAP,
    TRACKING,
    MapOfBefore,
    MavlinkBytes,
    PointsOfKeyframe,
)
from drivers.recording.recording_topics import FLOW as FLOWS
from drivers.recording.recording_topics import LANDING as LANDING_TARGETS

GATE_OF = {
    mavlink.MAVLINK_MSG_ID_ODOMETRY: POSE,
    mavlink.MAVLINK_MSG_ID_VISION_POSITION_ESTIMATE: POSE,
    mavlink.MAVLINK_MSG_ID_VISION_SPEED_ESTIMATE: POSE,
    mavlink.MAVLINK_MSG_ID_LANDING_TARGET: LANDING,
    mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_SENSOR: GLOBAL,
    mavlink.MAVLINK_MSG_ID_GPS_INPUT: GLOBAL,
    mavlink.MAVLINK_MSG_ID_OPTICAL_FLOW: FLOW,
    mavlink.MAVLINK_MSG_ID_OPTICAL_FLOW_RAD: FLOW,
    mavlink.MAVLINK_MSG_ID_OBSTACLE_DISTANCE: OBSTACLES,
    mavlink.MAVLINK_MSG_ID_OBSTACLE_DISTANCE_3D: OBSTACLES,
}
"""Gate that let a message of ours through, by its id."""
GATE_OF_COMMAND = {
    mavlink.MAV_CMD_EXTERNAL_POSITION_ESTIMATE: GLOBAL, mavlink.MAV_CMD_SET_EKF_SOURCE_SET: SOURCES,
}  # fmt: skip
"""The same of commands, by their number."""
COMMANDS = {mavlink.MAVLINK_MSG_ID_COMMAND_LONG, mavlink.MAVLINK_MSG_ID_COMMAND_INT}
_COMMAND_AT, _CONFIRMATION_AT = struct.Struct("<28xH"), 32
"""Place of a command's number in its payload, and of the count of its repetitions."""
LOSSLESS = {"png", "raw"}


@dataclass(slots=True)
class Decisions:
    """Inputs and decisions of one flight, each list in its recorded order."""

    config: Config
    lossless: bool
    """True if images are recorded without loss."""
    samples: list[Telemetry] = field(default_factory=list)
    frames: list[FrameTracked] = field(default_factory=list)
    gates: list[GateStep] = field(default_factory=list)
    odometry: dict[int, Odometry] = field(default_factory=dict)
    """Odometry by the number of the frame."""
    targets: dict[int, LandingTarget] = field(default_factory=dict)
    """Landing targets by the number of the frame."""
    flows: dict[int, OpticalFlow] = field(default_factory=dict)
    """Optical flow by the number of the frame."""
    obstacle_points: list[ObstaclePoints] = field(default_factory=list)
    site_map: SiteMapUsed | None = None
    map_taken_up: MapTakenUp | None = None
    """Map of a process before; None without one."""
    events: list[str] = field(default_factory=list)
    """Warnings and good news, in words."""
    sent: dict[str, list[tuple[int, bytes]]] = field(default_factory=lambda: defaultdict(list))
    """Id and payload of the messages that were sent, by their gate."""

    @property
    def firmware(self) -> Firmware:
        """A firmware whose poses are as those that were sent, by the frame that they state."""
        layout = mavlink.MAVLink_odometry_message.unpacker
        for kind, payload in self.sent.get(POSE, []):
            if kind == mavlink.MAVLINK_MSG_ID_ODOMETRY:
                *_, frame, _, _, _, _ = layout.unpack(payload.ljust(layout.size, b"\0"))
                return next((each for each in FRAMES if FRAMES[each] == frame), "other")
        return "other"


def decisions_of(recording: RecordingReader) -> Decisions:
    """Decisions of a recorded flight; FlightError where it has none."""
    toml = recording.found.attachments.get(CONFIG_TOML)
    if toml is None:
        raise FlightError(f"{recording.path}: the configuration of the flight is not in it")
    name = recording.found.metadata.get(NOTES, {}).get("pictures", "")
    where = f"{recording.path}: {CONFIG_TOML}"
    config = config_of_text(toml.decode(), where, lambda _: None)  # nobody renames its keys
    found = Decisions(config, name in LOSSLESS)
    stream = MavlinkStream()
    sent: list[tuple[int, str, int, bytes]] = []
    take: dict[str, Callable[[int, bytes], None]] = {
        TRACKING: lambda t_ns, data: found.frames.append(_of(FrameTracked, t_ns, data)),
        GATES: lambda t_ns, data: found.gates.append(step_of(t_ns, data)),
        EVENTS: lambda t_ns, data: found.events.append(Log.FromString(data).message),
    }
    for number in range(len(recording.found.chunks)):
        for message in recording.messages(number):
            topic, data = message.channel.topic, bytes(message.data)
            if topic in take:
                take[topic](message.t_ns, data)
            elif topic == ODOMETRY:
                odometry = _odometry(message.t_ns, json.loads(data))
                found.odometry[odometry.seq] = odometry
            elif topic == LANDING_TARGETS:
                target = _target(message.t_ns, data)
                found.targets[target.seq] = target
            elif topic == FLOWS:
                flow = _flow(message.t_ns, data)
                found.flows[flow.seq] = flow
            elif topic == OBSTACLE_POINTS:
                found.obstacle_points.append(points_of(message.t_ns, data))
            elif topic == MAP_TAKEN_UP:
                taken = MapOfBefore.FromString(data)
                found.map_taken_up = MapTakenUp(
                    message.t_ns, taken.absent_ns, np.frombuffer(taken.data, np.uint8)
                )
            elif topic == SITE_MAP:
                found.site_map = _of(SiteMapUsed, message.t_ns, data)
            elif topic == SENT:
                sent += [(message.t_ns, *each) for each in _gated(stream, data, found.config)]
            elif is_sample_topic(topic):
                found.samples.append(sample_of(topic, message.t_ns, data))
    begin_ns = min((step.t_ns for step in found.gates), default=0)
    for t_ns, gate, kind, payload in sent:
        if t_ns >= begin_ns:  # bytes of the link are recorded from before the flight on
            found.sent[gate].append((kind, payload))
    if not found.frames:
        raise FlightError(
            f"{recording.path}: it does not say how its frames were tracked; recordings do since "
            "version 0.2"
        )
    return found


def payloads_of(messages: Iterable[Any]) -> list[tuple[int, bytes]]:
    """Id and payload of messages, as they are sent."""
    codec = mavlink.MAVLink(None)
    packed = b"".join(bytes(each.pack(codec)) for each in messages)
    return [(packet.message_id, packet.payload) for packet in MavlinkStream().feed(packed, 0)]


def step_of(t_ns: int, data: bytes) -> GateStep:
    """A recorded step of the gate."""
    step: GateStep = _of(GateStep, t_ns, data)
    return step


def _of(kind: type[Any], t_ns: int, data: bytes) -> Any:
    given = json.loads(data)
    told = {each.name: given[each.name] for each in dataclasses.fields(kind) if each.name in given}
    return kind(t_ns=t_ns, **told)


def _gated(stream: MavlinkStream, data: bytes, config: Config) -> Iterator[tuple[str, int, bytes]]:
    """Gate, id and payload of the packets of this program, not of a client of the router.

    Of a command that is repeated until it is answered the first counts.
    """
    taken = MavlinkBytes.FromString(data)
    for packet in stream.feed(taken.data, taken.monotonic_ns):
        if packet.component != config.link.component_id:
            continue
        gate, payload = GATE_OF.get(packet.message_id), packet.payload
        if packet.message_id in COMMANDS:
            whole = payload.ljust(_CONFIRMATION_AT + 1, b"\0")
            gate = GATE_OF_COMMAND.get(*_COMMAND_AT.unpack_from(whole))
            if packet.message_id == mavlink.MAVLINK_MSG_ID_COMMAND_LONG and whole[_CONFIRMATION_AT]:
                continue
        if gate is not None:
            yield gate, packet.message_id, payload


def points_of(t_ns: int, data: bytes) -> ObstaclePoints:
    """Recorded points in which obstacles are looked for."""
    given = PointsOfKeyframe.FromString(data)
    points = np.frombuffer(given.points, "<f4").reshape(-1, 3)
    return ObstaclePoints(t_ns, given.keyframe_id, points)


def _target(t_ns: int, data: bytes) -> LandingTarget:
    target: LandingTarget = _of(LandingTarget, t_ns, data)
    position, sigma, normals = (
        None if given is None else np.array(given, float)
        for given in (target.position_body_m, target.sigma_body_m, target.normals_body)
    )
    return dataclasses.replace(
        target, position_body_m=position, sigma_body_m=sigma, normals_body=normals
    )


def _flow(t_ns: int, data: bytes) -> OpticalFlow:
    flow: OpticalFlow = _of(OpticalFlow, t_ns, data)
    seen, turn = (
        None if given is None else np.array(given, float)
        for given in (flow.flow_rad_s, flow.turn_rad)
    )
    sigma_rad_s = np.inf if flow.sigma_rad_s is None else flow.sigma_rad_s
    return dataclasses.replace(flow, flow_rad_s=seen, turn_rad=turn, sigma_rad_s=sigma_rad_s)


def _odometry(t_ns: int, given: Mapping[str, Any]) -> Odometry:
    def number(name: str) -> float:
        value = given.get(name)
        return np.inf if value is None else float(value)

    rotation, position = given.get("rotation"), given.get("position_m")
    velocity = given.get("velocity_world_m_s")
    pose = None
    if rotation is not None and position is not None:
        pose = Pose(np.reshape(np.array(rotation, float), (3, 3)), np.array(position, float))
    return Odometry(
        int(given["seq"]), t_ns, TrackState(given["state"]), int(given["reset_counter"]),
        int(given["quality"]), pose, None if velocity is None else np.array(velocity, float),
        number("sigma_position_m"), number("sigma_velocity_m_s"), number("sigma_attitude_rad"),
        number("sigma_yaw_rad"), bool(given.get("inertial", False)),
        float(given.get("sigma_scale", 0.0)), float(given.get("sigma_by_scale_m", 0.0)),
        float(given.get("unaided_s", 0.0)),
        {str(kind): int(n) for kind, n in (given.get("refused") or {}).items()},
    )  # fmt: skip
