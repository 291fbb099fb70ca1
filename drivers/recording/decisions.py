"""Decisions of a recorded flight, in the order in which they came, for a replay as flown."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from foxglove_schemas_protobuf.Log_pb2 import Log
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.config import Config
from companion.config_file import config_of_text
from companion.errors import FlightError
from companion.estimation.gate.pose_gate import PoseToSend
from companion.flight_notes import GateStep
from companion.geometry.transforms import Pose
from companion.messages import FrameTracked, Odometry, TrackState
from companion.telemetry import Telemetry
from drivers.mavlink.measurements.pose_messages import FRAMES, pose_messages
from drivers.mavlink.vehicle import Firmware
from drivers.mavlink.wire.packet_stream import MavlinkStream
from drivers.recording.recorded_content import is_sample_topic, sample_of
from drivers.recording.recorder import CONFIG_TOML, NOTES
from drivers.recording.recording import Recording
from drivers.recording.recording_topics import EVENTS, GATE, ODOMETRY, SENT, TRACKING, MavlinkBytes

POSES = {
    mavlink.MAVLINK_MSG_ID_ODOMETRY, mavlink.MAVLINK_MSG_ID_VISION_POSITION_ESTIMATE,
    mavlink.MAVLINK_MSG_ID_VISION_SPEED_ESTIMATE,
}  # fmt: skip
LOSSLESS = {"png", "raw"}


@dataclass(slots=True)
class Decisions:
    """Inputs and decisions of one flight, each list in its recorded order."""

    config: Config
    lossless: bool
    """True if images are recorded without loss."""
    samples: list[Telemetry] = field(default_factory=list)
    frames: list[FrameTracked] = field(default_factory=list)
    gate: list[GateStep] = field(default_factory=list)
    odometry: dict[int, Odometry] = field(default_factory=dict)
    """Odometry by the number of the frame."""
    events: list[str] = field(default_factory=list)
    """Warnings and good news, in words."""
    sent: list[tuple[int, bytes]] = field(default_factory=list)
    """Id and payload of the messages with poses that were sent."""

    @property
    def firmware(self) -> Firmware:
        """A firmware whose poses are as those that were sent, by the frame that they state."""
        layout = mavlink.MAVLink_odometry_message.unpacker
        for kind, payload in self.sent:
            if kind == mavlink.MAVLINK_MSG_ID_ODOMETRY:
                *_, frame, _, _, _, _ = layout.unpack(payload.ljust(layout.size, b"\0"))
                return next((each for each in FRAMES if FRAMES[each] == frame), "other")
        return "other"


def decisions_of(recording: Recording) -> Decisions:
    """Decisions of a recorded flight; FlightError where it has none."""
    toml = recording.found.attachments.get(CONFIG_TOML)
    if toml is None:
        raise FlightError(f"{recording.path}: the configuration of the flight is not in it")
    name = recording.found.metadata.get(NOTES, {}).get("pictures", "")
    found = Decisions(config_of_text(toml.decode(), f"{recording.path}: {CONFIG_TOML}"),
                      name in LOSSLESS)  # fmt: skip
    stream = MavlinkStream()
    take: dict[str, Callable[[int, bytes], None]] = {
        TRACKING: lambda t_ns, data: found.frames.append(_of(FrameTracked, t_ns, data)),
        GATE: lambda t_ns, data: found.gate.append(step_of(t_ns, data)),
        EVENTS: lambda t_ns, data: found.events.append(Log.FromString(data).message),
        SENT: lambda t_ns, data: found.sent.extend(_poses(stream, data, found.config)),
    }
    for number in range(len(recording.found.chunks)):
        for message in recording.messages(number):
            topic, data = message.channel.topic, bytes(message.data)
            if topic in take:
                take[topic](message.t_ns, data)
            elif topic == ODOMETRY:
                odometry = _odometry(message.t_ns, json.loads(data))
                found.odometry[odometry.seq] = odometry
            elif is_sample_topic(topic):
                found.samples.append(sample_of(topic, message.t_ns, data))
    if not found.frames:
        raise FlightError(
            f"{recording.path}: it does not say how its frames were tracked; recordings do since "
            "version 0.2"
        )
    return found


def payloads_of(pose: PoseToSend, mode: str, firmware: Firmware) -> list[tuple[int, bytes]]:
    """Id and payload of the messages of a pose."""
    codec = mavlink.MAVLink(None)
    packed = b"".join(bytes(each.pack(codec)) for each in pose_messages(pose, mode, firmware))
    return [(packet.message_id, packet.payload) for packet in MavlinkStream().feed(packed, 0)]


def step_of(t_ns: int, data: bytes) -> GateStep:
    """A recorded step of the gate."""
    step: GateStep = _of(GateStep, t_ns, data)
    return step


def _of(kind: type[Any], t_ns: int, data: bytes) -> Any:
    given = json.loads(data)
    told = {each.name: given[each.name] for each in dataclasses.fields(kind) if each.name in given}
    return kind(t_ns, **told)


def _poses(stream: MavlinkStream, data: bytes, config: Config) -> Iterator[tuple[int, bytes]]:
    """Id and payload of the packets with poses of this program, not of a client of the router."""
    taken = MavlinkBytes.FromString(data)
    for packet in stream.feed(taken.data, taken.monotonic_ns):
        if packet.message_id in POSES and packet.component == config.link.component_id:
            yield packet.message_id, packet.payload


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
    )  # fmt: skip
