"""A short synthetic flight, recorded as by the daemon."""

from __future__ import annotations

import dataclasses
import time
from pathlib import Path
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.config import CameraConfig, Config, RecorderConfig
from companion.flight_notes import HealthNote, LinkBytes
from companion.geometry.camera import Camera, Distortion
from companion.geometry.transforms import Pose, quaternion_from_euler, rotation_from_quaternion
from companion.messages import Frame, Message, Odometry, TrackState, Warned
from companion.telemetry import (
    ArmedSample,
    AttitudeSample,
    HeightSample,
    ImuSample,
    PositionSample,
    PositionSource,
    RangeSample,
    Telemetry,
)
from drivers.camera.pattern_camera import PatternScene, pattern_optics, world_from_camera
from drivers.recording.recorder import Recorder

START_NS = 1_780_000_000_123_456_789
STEP_NS = 33_333_333
SIZE = 160, 120
_scene: list[PatternScene] = []


def camera() -> Camera:
    """With all that a camera can have, in numbers that no short text holds."""
    width, height = SIZE
    turned = rotation_from_quaternion(quaternion_from_euler(0.1, -1.5, 0.7))
    return Camera(
        width, height, 123.4567890123, 124.1 / 3, 79.5, 61.0 / 1.01, Distortion.RADTAN,
        (0.1 / 3, -0.02, 0.001, 1e-17, 0.0), Pose(turned, np.array([0.1, 0.2 / 3, -0.05])),
    )  # fmt: skip


def frames(n: int, grey_is_of_colours: bool = True) -> list[Frame]:
    """Pictures of the test pattern."""
    _scene[:] = _scene or [PatternScene()]
    optics = pattern_optics(CameraConfig(width=SIZE[0], height=SIZE[1]))
    out = []
    for seq in range(n):
        grey, rgb = _scene[0].picture(optics, world_from_camera(seq * STEP_NS))
        if grey_is_of_colours:
            rgb = np.repeat(grey[:, :, None], 3, axis=2)
        out.append(Frame(seq + 5, START_NS + seq * STEP_NS, grey, rgb))
    return out


def samples(n: int) -> list[Telemetry]:
    """All kinds, with numbers that no short text holds, and some that are not known."""
    out: list[Telemetry] = []
    for k in range(n):
        t_ns = START_NS + k * STEP_NS - 1_000_001
        third = np.array([k, 1.0, -2.0]) / 3
        turned = quaternion_from_euler(0.1 * k, 0.2, 0.3)
        out += [
            AttitudeSample(t_ns, turned, third if k % 2 else None),
            ImuSample(t_ns + 1, third, 9.81 * third),
            PositionSample(
                t_ns + 2, PositionSource.GPS, third, np.array([1.0, 2 / 3, np.nan]), 0.1 * k, None
            ),
            PositionSample(t_ns + 3, PositionSource.LOCAL, third),
            RangeSample(t_ns + 4, 10 / 3),
            HeightSample(t_ns + 5, 100 / 7),
            ArmedSample(t_ns + 6, k % 2 == 0),
        ]
    return out


def link_bytes(n: int) -> list[LinkBytes]:
    """Packets both ways, in pieces that do not end where packets do."""
    out = []
    for outgoing in (False, True):
        codec = mavlink.MAVLink(None, srcSystem=1, srcComponent=197 if outgoing else 1)
        data = b""
        for k in range(n):
            sent_ns = START_NS + k * STEP_NS
            data += bytes(mavlink.MAVLink_attitude_message(k, 0.1, 0.2, 0.3, 0, 0, 0).pack(codec))
            data += bytes(mavlink.MAVLink_timesync_message(k + 1, sent_ns).pack(codec))
        size = len(data) // n + 1
        out += [
            LinkBytes(START_NS + k * STEP_NS + 500, 7_000 + k, outgoing, data[k * size :][:size])
            for k in range(n)
        ]
    return sorted(out, key=lambda taken: taken.t_ns)


def odometry(seq: int) -> Odometry:
    """Known from the fourth on."""
    if seq < 3:
        return Odometry(seq, START_NS + seq * STEP_NS, TrackState.INITIALISING, 0)
    pose = Pose(np.eye(3), np.array([seq, 0.5, -3.0]))
    return Odometry(
        seq, START_NS + seq * STEP_NS, TrackState.TRACKING, 1, 80, pose, np.zeros(3), 0.1, 0.2, 0.3
    )


HEALTH: dict[str, Any] = {
    "health": {"cpu": 0.5},
    "clock": {
        "method": "TIMESYNC", "offset_s": 1 / 3, "drift_ppm": 2.0, "sigma_ms": 0.1, "n_reboots": 0,
    },
    "origin": {"latitude_deg": 47.1, "longitude_deg": 8.2, "altitude_m": 400.0},
}  # fmt: skip


def record(
    folder: Path, n: int = 30, codec: Any = "mjpeg", *, grey_is_of_colours: bool = True,
    config: RecorderConfig | None = None, per_chunk: int | None = None,
) -> Recorder:  # fmt: skip
    """Record `n` frames and what goes with them, so many in a chunk; the folder is made."""
    folder.mkdir(parents=True)
    chosen = config or RecorderConfig(least_free_mb=0, flush_s=0.1)
    chosen = dataclasses.replace(chosen, codec=codec)
    recorder = Recorder(folder, Config(recorder=chosen), camera(), {"companion": "1"})
    told: list[Message | LinkBytes | HealthNote] = [
        *frames(n, grey_is_of_colours), *samples(n), *link_bytes(n), *map(odometry, range(n)),
        HealthNote(START_NS + 9, HEALTH), Warned(START_NS + 8, "something", "happened"),
    ]  # fmt: skip
    for message in sorted(told, key=lambda each: each.t_ns):
        if per_chunk and isinstance(message, Frame) and message.seq % per_chunk == 0:
            time.sleep(2.5 * chosen.flush_s)
        recorder.take(message)
    recorder.close()
    return recorder
