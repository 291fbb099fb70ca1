"""Our component as a camera: what ground stations ask of one before they show its video."""

from __future__ import annotations

from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from drivers.mavlink.camera_messages import (
    INFORMATION,
    STREAM,
    STREAM_STATUS,
    CameraStream,
    camera_commands,
    camera_information,
    stream_information,
    stream_status,
)
from drivers.mavlink.ground.command_server import ACCEPTED, DENIED, Done

URI = "rtsp://10.0.0.5:8554/camera"
MADE = CameraStream(URI, 640, 480, 30.0, 2000, 75.4, True)


def over_the_wire(message: Any) -> Any:
    """The message as a ground station decodes it."""
    wire = mavlink.MAVLink(None, 1, 197)
    got = wire.parse_buffer(message.pack(wire))
    assert got is not None and len(got) == 1
    return got[0]


def test_it_is_a_camera_that_streams() -> None:
    got = over_the_wire(camera_information(MADE, 0, 1234))
    assert (got.resolution_h, got.resolution_v, got.time_boot_ms) == (640, 480, 1234)
    assert got.flags == mavlink.CAMERA_CAP_FLAGS_HAS_VIDEO_STREAM
    assert bytes(got.model_name).rstrip(b"\0") == b"companion" and got.cam_definition_uri == ""


def test_its_stream_is_where_rtsp_is_served() -> None:
    got = over_the_wire(stream_information(MADE))
    assert (got.stream_id, got.count, got.uri, got.name) == (1, 1, URI, "camera")
    assert (got.type, got.encoding) == (
        mavlink.VIDEO_STREAM_TYPE_RTSP, mavlink.VIDEO_STREAM_ENCODING_H264,
    )  # fmt: skip
    assert (got.framerate, got.bitrate, got.hfov) == (30.0, 2_000_000, 75)
    status = over_the_wire(stream_status(MADE))
    assert status.flags == got.flags == mavlink.VIDEO_STREAM_STATUS_FLAGS_RUNNING
    assert (status.stream_id, status.resolution_h, status.resolution_v) == (1, 640, 480)


def test_addresses_that_are_too_long_are_cut() -> None:
    long = CameraStream("rtsp://" + "a" * 300, 640, 480, 30.0, 2000, 75.0, False)
    got = over_the_wire(stream_information(long))
    assert len(got.uri) == 159 and got.flags == 0


@pytest.mark.parametrize("command, kind, of_stream", [
    (mavlink.MAV_CMD_REQUEST_CAMERA_INFORMATION, INFORMATION, False),
    (mavlink.MAV_CMD_REQUEST_VIDEO_STREAM_INFORMATION, STREAM, True),
    (mavlink.MAV_CMD_REQUEST_VIDEO_STREAM_STATUS, STREAM_STATUS, True),
])  # fmt: skip
def test_older_questions_are_answered_too(command: int, kind: int, of_stream: bool) -> None:
    asked = camera_commands({
        INFORMATION: lambda: camera_information(MADE, 0, 0),
        STREAM: lambda: stream_information(MADE), STREAM_STATUS: lambda: stream_status(MADE),
    })[command]  # fmt: skip
    assert asked.only_asks
    for number in (0.0, 1.0):
        done = asked.handler([number, *[0.0] * 6])
        assert isinstance(done, Done) and done.result == ACCEPTED
        assert [each.get_msgId() for each in done.messages] == [kind]
    other = asked.handler([2.0, *[0.0] * 6])
    assert isinstance(other, Done) and (other.result == DENIED) == of_stream
