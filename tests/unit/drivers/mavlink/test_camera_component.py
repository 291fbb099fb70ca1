"""Our camera is found and asked as QGroundControl does, over the wire and through the router."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Awaitable, Callable
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.config import LinkConfig, RouterConfig
from companion.timing.clock import FlightClock
from drivers.mavlink.autopilot_link import AutopilotLink
from drivers.mavlink.camera_component import CAMERA, CameraComponent
from drivers.mavlink.camera_messages import CameraStream
from drivers.mavlink.wire.pymavlink_port import PymavlinkPort
from tests.support.autopilot.fake_wire import free_port

URI = "rtsp://10.0.0.5:8554/camera"
STREAM = CameraStream(URI, 640, 480, 30.0, 2000, 75.4, True)
WITHIN_S = 60.0
HOST = "127.0.0.1"


class Ground:
    """A ground station on a stream of bytes: `read` gives what comes, `write` takes."""

    def __init__(self, read: Callable[[], Awaitable[bytes]], write: Callable[[bytes], None]):
        self._read, self._write = read, write
        self._codec = mavlink.MAVLink(None, 255, 190)
        self._codec.robust_parsing = True
        self._heard: list[Any] = []

    def say(self, message: Any, system: int = 255, component: int = 190) -> None:
        self._write(message.pack(mavlink.MAVLink(None, system, component)))

    def ask(self, command: int, parameter: float, component: int = CAMERA) -> None:
        values = [parameter, *[0.0] * 6]
        self.say(mavlink.MAVLink_command_long_message(1, component, command, 0, *values))

    async def of_camera(self, kind: str) -> Any:
        """The next message of a kind of component 100."""

        async def search() -> Any:
            while True:
                for message in list(self._heard):
                    self._heard.remove(message)
                    source = message.get_srcSystem(), message.get_srcComponent()
                    if source == (1, CAMERA) and message.get_type() == kind:
                        return message
                self._heard += self._codec.parse_buffer(bytearray(await self._read())) or []

        return await asyncio.wait_for(search(), WITHIN_S)


async def find_and_ask(ground: Ground) -> None:
    """The questions that a ground station asks of a camera that it hears."""
    beat = await ground.of_camera("HEARTBEAT")
    assert (beat.type, beat.autopilot) == (
        mavlink.MAV_TYPE_CAMERA, mavlink.MAV_AUTOPILOT_INVALID,
    )  # fmt: skip
    ground.ask(mavlink.MAV_CMD_REQUEST_MESSAGE, 259.0)
    ack = await ground.of_camera("COMMAND_ACK")
    assert (ack.command, ack.result) == (512, mavlink.MAV_RESULT_ACCEPTED)
    told = await ground.of_camera("CAMERA_INFORMATION")
    assert told.flags == mavlink.CAMERA_CAP_FLAGS_HAS_VIDEO_STREAM
    ground.ask(mavlink.MAV_CMD_REQUEST_VIDEO_STREAM_INFORMATION, 0.0)
    assert (await ground.of_camera("VIDEO_STREAM_INFORMATION")).uri == URI
    ground.ask(mavlink.MAV_CMD_REQUEST_MESSAGE, 270.0)
    assert (await ground.of_camera("VIDEO_STREAM_STATUS")).stream_id == 1
    ground.ask(mavlink.MAV_CMD_IMAGE_START_CAPTURE, 0.0)
    while (ack := await ground.of_camera("COMMAND_ACK")).command != 2000:
        pass
    assert ack.result == mavlink.MAV_RESULT_UNSUPPORTED


class Datagrams(asyncio.DatagramProtocol):
    def __init__(self) -> None:
        self.came: asyncio.Queue[bytes] = asyncio.Queue()

    def datagram_received(self, data: bytes, address: Any) -> None:
        self.came.put_nowait(data)


async def _flown(through_router: bool) -> None:
    link_port, client_port, loop = free_port(), free_port(), asyncio.get_running_loop()
    clock, config = FlightClock(), LinkConfig(url=f"udpin:{HOST}:{link_port}")
    router = RouterConfig(clients=(f"tcpin:{HOST}:{client_port}",))
    port = PymavlinkPort(config, router, clock)
    link = AutopilotLink(config, port, clock, lambda _: None, lambda _: None)
    camera = CameraComponent(link, clock, lambda: STREAM)
    running = [asyncio.ensure_future(each) for each in (link.run(), camera.run())]
    wire, heard = await loop.create_datagram_endpoint(Datagrams, remote_addr=(HOST, link_port))
    writer: asyncio.StreamWriter | None = None
    try:
        ground = Ground(heard.came.get, wire.sendto)

        async def beat() -> None:  # the autopilot's, whose component the camera is
            while True:
                ground.say(mavlink.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3), 1, 1)
                await asyncio.sleep(0.2)

        running.append(asyncio.ensure_future(beat()))
        if through_router:
            for _ in range(100):
                with contextlib.suppress(ConnectionError):
                    reader, writer = await asyncio.open_connection(HOST, client_port)
                    break
                await asyncio.sleep(0.05)
            assert writer is not None
            ground = Ground(lambda: reader.read(4096), writer.write)
        await find_and_ask(ground)
    finally:
        for task in running:
            task.cancel()
        await asyncio.gather(*running, return_exceptions=True)
        wire.close()
        if writer is not None:
            writer.close()
        await asyncio.sleep(0)


@pytest.mark.parametrize("through_router", [False, True], ids=["wire", "router"])
def test_it_is_found_and_asked(through_router: bool) -> None:
    asyncio.run(_flown(through_router))
