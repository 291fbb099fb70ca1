"""Our camera as a component of its own, which ground stations find and ask by themselves.

QGroundControl and Mission Planner take for cameras the components from MAV_COMP_ID_CAMERA on, and
no others. The protocol: https://mavlink.io/en/services/camera.html.
"""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.timing.clock import FlightClock
from drivers.mavlink.autopilot_link import AutopilotLink
from drivers.mavlink.camera_captures import (
    CAPABILITIES,
    CameraCaptures,
    FlightRecording,
    Stills,
)
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
from drivers.mavlink.ground.command_server import CommandServer
from drivers.mavlink.ground.ground_requests import COMMANDS
from drivers.mavlink.ground.request_limit import request_limit
from drivers.mavlink.message_requests import HEARTBEAT, MessageRequests

CAMERA: int = mavlink.MAV_COMP_ID_CAMERA
HEARTBEAT_S = 1.0
ROUNDS = 10
"""Looks in each of these for images that were taken: an answer comes within a tenth of a second."""
MOST_TOLD = 16


class CameraComponent:
    """Answers for the camera, and says that it is there; to be used in the event loop."""

    def __init__(
        self, link: AutopilotLink, clock: FlightClock, stream: Callable[[], CameraStream],
        stills: Stills, recording: FlightRecording,
    ) -> None:  # fmt: skip
        self._clock, self._port = clock, link.port
        self._port.second_component = CAMERA
        self._limit = request_limit()
        began_ns = clock.now_ns()

        def boot_ms() -> int:
            return (clock.now_ns() - began_ns) // 1_000_000

        def unix_us(t_ns: int) -> int:
            return (t_ns + clock.behind_ns()) // 1000

        def tell(message: Any) -> None:
            self._told.append(message)

        self._told: deque[Any] = deque(maxlen=MOST_TOLD)
        self._captures = CameraCaptures(stills, recording, boot_ms, unix_us, tell)
        made = {
            **self._captures.messages,
            INFORMATION: lambda: camera_information(stream(), CAPABILITIES, boot_ms()),
            STREAM: lambda: stream_information(stream()),
            STREAM_STATUS: lambda: stream_status(stream()),
        }
        asked = MessageRequests(
            {HEARTBEAT: camera_heartbeat, **made}, lambda: {HEARTBEAT: 1.0 / HEARTBEAT_S}, {},
            boot_ms,
        )  # fmt: skip
        self._commands = CommandServer(
            {**asked.commands, **camera_commands(made), **self._captures.commands}
        )
        link.on_camera_request = self._take

    async def run(self) -> None:
        """Say that it is there, until cancelled."""
        n = 0
        while True:
            if n % ROUNDS == 0:
                self._captures.step()
                if self._port.connected:
                    self._port.send(camera_heartbeat(), as_second=True)
            n += 1
            n_told = len(self._told)  # of those the acknowledgement goes first
            for answer in self._commands.step(self._clock.now_ns()):
                self._port.send(answer, as_second=True)
            for _ in range(n_told):
                self._port.send(self._told.popleft(), as_second=True)
            await asyncio.sleep(HEARTBEAT_S / ROUNDS)

    def _take(self, message: Any, now_ns: int) -> None:
        if message.get_msgId() not in COMMANDS:
            return
        system = self._port.identity[0]
        target = message.target_system, message.target_component
        if target[0] not in (0, system) or target[1] not in (0, CAMERA):
            return
        asker = message.get_srcSystem(), message.get_srcComponent()
        if not self._limit.allows(asker, now_ns):
            return
        for answer in self._commands.take(message, target != (system, CAMERA), now_ns):
            self._port.send(answer, as_second=True)


def camera_heartbeat() -> Any:
    """HEARTBEAT of the camera."""
    return mavlink.MAVLink_heartbeat_message(
        mavlink.MAV_TYPE_CAMERA, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, mavlink.MAV_STATE_ACTIVE, 3
    )
