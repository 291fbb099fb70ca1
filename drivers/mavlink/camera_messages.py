"""A camera with one video stream, as MAVLink tells it: https://mavlink.io/en/services/camera.html."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from drivers.mavlink.ground.command_server import ACCEPTED, DENIED, Command, Done

INFORMATION: int = mavlink.MAVLINK_MSG_ID_CAMERA_INFORMATION
STREAM: int = mavlink.MAVLINK_MSG_ID_VIDEO_STREAM_INFORMATION
STREAM_STATUS: int = mavlink.MAVLINK_MSG_ID_VIDEO_STREAM_STATUS
CAPTURE_STATUS: int = mavlink.MAVLINK_MSG_ID_CAMERA_CAPTURE_STATUS
STORAGE: int = mavlink.MAVLINK_MSG_ID_STORAGE_INFORMATION
SETTINGS: int = mavlink.MAVLINK_MSG_ID_CAMERA_SETTINGS
STREAM_ID = 1
NAME_BYTES, URI_BYTES = 32, 160
H264: int = mavlink.VIDEO_STREAM_ENCODING_H264
UNKNOWN_MM = math.nan


@dataclass(frozen=True, slots=True)
class CameraStream:
    """The stream as it is; angles in degrees, sizes in pixels."""

    uri: str
    width: int
    height: int
    rate_hz: float
    kbit_s: int
    hfov_deg: float
    is_running: bool


def camera_information(stream: CameraStream, capabilities: int, boot_ms: int) -> Any:
    """CAMERA_INFORMATION: a camera that streams, and has these capabilities besides."""
    name = b"companion".ljust(NAME_BYTES, b"\0")
    return mavlink.MAVLink_camera_information_message(
        boot_ms & 0xFFFFFFFF, list(name), list(name), 0, UNKNOWN_MM, UNKNOWN_MM, UNKNOWN_MM,
        stream.width, stream.height, 0, mavlink.CAMERA_CAP_FLAGS_HAS_VIDEO_STREAM | capabilities, 0,
        b"",
    )  # fmt: skip


def stream_information(stream: CameraStream) -> Any:
    """VIDEO_STREAM_INFORMATION: RTSP, H.264."""
    return mavlink.MAVLink_video_stream_information_message(
        STREAM_ID, 1, mavlink.VIDEO_STREAM_TYPE_RTSP, _flags(stream), stream.rate_hz, stream.width,
        stream.height, 1000 * stream.kbit_s, 0, round(stream.hfov_deg), b"camera"[:NAME_BYTES],
        stream.uri.encode()[: URI_BYTES - 1], H264,
    )  # fmt: skip


def stream_status(stream: CameraStream) -> Any:
    """VIDEO_STREAM_STATUS."""
    return mavlink.MAVLink_video_stream_status_message(
        STREAM_ID, _flags(stream), stream.rate_hz, stream.width, stream.height,
        1000 * stream.kbit_s, 0, round(stream.hfov_deg),
    )  # fmt: skip


def camera_commands(made: Mapping[int, Callable[[], Any]]) -> dict[int, Command]:
    """Older commands that ask for the same messages, by their makers."""

    def asked(number: int, of_stream: bool) -> Command:
        def answer(parameters: Sequence[float]) -> Done:
            if of_stream and parameters[0] not in (0.0, float(STREAM_ID)):
                return Done(DENIED)
            return Done(ACCEPTED, [made[number]()])

        return Command(answer, only_asks=True)

    return {
        mavlink.MAV_CMD_REQUEST_CAMERA_INFORMATION: asked(INFORMATION, False),
        mavlink.MAV_CMD_REQUEST_CAMERA_CAPTURE_STATUS: asked(CAPTURE_STATUS, False),
        mavlink.MAV_CMD_REQUEST_STORAGE_INFORMATION: asked(STORAGE, False),
        mavlink.MAV_CMD_REQUEST_CAMERA_SETTINGS: asked(SETTINGS, False),
        mavlink.MAV_CMD_REQUEST_VIDEO_STREAM_INFORMATION: asked(STREAM, True),
        mavlink.MAV_CMD_REQUEST_VIDEO_STREAM_STATUS: asked(STREAM_STATUS, True),
    }


def _flags(stream: CameraStream) -> int:
    return int(mavlink.VIDEO_STREAM_STATUS_FLAGS_RUNNING) if stream.is_running else 0
