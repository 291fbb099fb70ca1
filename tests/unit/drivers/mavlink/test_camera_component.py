"""Our camera is found and asked as QGroundControl does, over the wire and through the router."""

from __future__ import annotations

import asyncio
import contextlib
import os
import queue
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.config import LinkConfig, RouterConfig
from companion.messages import Frame
from companion.pilot_messages import RECORDING_GOES_ON
from companion.timing.clock import FlightClock
from drivers.images.still_pictures import Still, StillPictures
from drivers.mavlink.autopilot_link import AutopilotLink
from drivers.mavlink.camera_captures import (
    CAPABILITIES,
    NOTHING_RECORDED,
    CameraCaptures,
    FlightRecording,
)
from drivers.mavlink.camera_component import CAMERA, CameraComponent
from drivers.mavlink.camera_messages import CAPTURE_STATUS, STORAGE, CameraStream
from drivers.mavlink.wire.pymavlink_port import PymavlinkPort
from tests.support.autopilot.fake_wire import free_port

ACCEPTED, DENIED = mavlink.MAV_RESULT_ACCEPTED, mavlink.MAV_RESULT_DENIED
UNSUPPORTED = mavlink.MAV_RESULT_UNSUPPORTED
TAKEN_NS = 1_790_000_000_000_000_000
"""Of this century: a step of the clock would make a time near zero a negative one."""
FRAME = Frame(0, TAKEN_NS, np.zeros((48, 64), np.uint8), np.zeros((48, 64, 3), np.uint8))
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

    def ask(self, command: int, parameter: float, *, third: float = 0.0) -> None:
        component, values = CAMERA, [parameter, 0.0, third, *[0.0] * 4]
        self.say(mavlink.MAVLink_command_long_message(1, component, command, 0, *values))

    async def of_camera(self, kind: str) -> Any:
        """The first message of a kind of component 100 that was not taken yet."""

        async def search() -> Any:
            while True:
                for message in self._heard:
                    source = message.get_srcSystem(), message.get_srcComponent()
                    if source == (1, CAMERA) and message.get_type() == kind:
                        self._heard.remove(message)
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
    assert told.flags == mavlink.CAMERA_CAP_FLAGS_HAS_VIDEO_STREAM | CAPABILITIES
    ground.ask(mavlink.MAV_CMD_REQUEST_VIDEO_STREAM_INFORMATION, 0.0)
    assert (await ground.of_camera("VIDEO_STREAM_INFORMATION")).uri == URI
    ground.ask(mavlink.MAV_CMD_REQUEST_MESSAGE, 270.0)
    assert (await ground.of_camera("VIDEO_STREAM_STATUS")).stream_id == 1
    ground.ask(mavlink.MAV_CMD_SET_CAMERA_ZOOM, 0.0)
    assert await acknowledged(ground, mavlink.MAV_CMD_SET_CAMERA_ZOOM) == UNSUPPORTED


async def acknowledged(ground: Ground, command: int) -> int:
    """Result of a command, once it has one."""
    while True:
        ack = await ground.of_camera("COMMAND_ACK")
        if ack.command == command and ack.result != mavlink.MAV_RESULT_IN_PROGRESS:
            return int(ack.result)


async def take_and_record(ground: Ground, flown: Flown) -> None:
    """An image, and a recording that is kept."""
    ground.ask(mavlink.MAV_CMD_IMAGE_START_CAPTURE, 0.0, third=1.0)
    while not (flown.folder / "image-000001.jpg").exists():
        flown.stills.frame(FRAME)
        await asyncio.sleep(0.02)
    assert await acknowledged(ground, mavlink.MAV_CMD_IMAGE_START_CAPTURE) == ACCEPTED
    told = await ground.of_camera("CAMERA_IMAGE_CAPTURED")
    assert (told.image_index, told.capture_result, told.file_url) == (1, 1, "image-000001.jpg")
    ground.ask(mavlink.MAV_CMD_IMAGE_START_CAPTURE, 1.0, third=5.0)  # a series
    assert await acknowledged(ground, mavlink.MAV_CMD_IMAGE_START_CAPTURE) == DENIED
    ground.ask(mavlink.MAV_CMD_VIDEO_START_CAPTURE, 0.0)
    assert await acknowledged(ground, mavlink.MAV_CMD_VIDEO_START_CAPTURE) == ACCEPTED
    assert flown.kept
    status = await ground.of_camera("CAMERA_CAPTURE_STATUS")
    assert (status.video_status, status.image_count) == (1, 1)
    flown.armed = True
    ground.ask(mavlink.MAV_CMD_VIDEO_STOP_CAPTURE, 0.0)
    assert await acknowledged(ground, mavlink.MAV_CMD_VIDEO_STOP_CAPTURE) == DENIED
    assert (await ground.of_camera("STATUSTEXT")).text == RECORDING_GOES_ON().text
    assert (await ground.of_camera("CAMERA_CAPTURE_STATUS")).video_status == 1
    flown.armed = False
    ground.ask(mavlink.MAV_CMD_VIDEO_STOP_CAPTURE, 0.0)
    assert await acknowledged(ground, mavlink.MAV_CMD_VIDEO_STOP_CAPTURE) == ACCEPTED
    assert (await ground.of_camera("CAMERA_CAPTURE_STATUS")).video_status == 0


@dataclass
class Flown:
    """What the commands act on."""

    folder: Path
    kept: bool = False
    armed: bool = False

    def __post_init__(self) -> None:
        self.stills = StillPictures(self.folder, 0.0)

    def recording(self) -> FlightRecording:
        def keep() -> None:
            self.kept = True

        def end() -> bool:
            self.kept &= self.armed
            return not self.kept

        return FlightRecording(lambda: self.kept, keep, end)


class Datagrams(asyncio.DatagramProtocol):
    def __init__(self) -> None:
        self.came: asyncio.Queue[bytes] = asyncio.Queue()

    def datagram_received(self, data: bytes, address: Any) -> None:
        self.came.put_nowait(data)


async def _flown(through_router: bool, folder: Path) -> None:
    link_port, client_port, loop = free_port(), free_port(), asyncio.get_running_loop()
    clock, config = FlightClock(), LinkConfig(url=f"udpin:{HOST}:{link_port}")
    router = RouterConfig(clients=(f"tcpin:{HOST}:{client_port}",))
    port = PymavlinkPort(config, router, clock)
    link = AutopilotLink(config, port, clock, lambda _: None, lambda _: None)
    flown = Flown(folder)
    camera = CameraComponent(link, clock, lambda: STREAM, flown.stills, flown.recording())
    running = [asyncio.ensure_future(each) for each in (link.run(), camera.run())]
    wire, heard = await loop.create_datagram_endpoint(Datagrams, remote_addr=(HOST, link_port))
    writer: asyncio.StreamWriter | None = None
    try:
        ground = autopilot = Ground(heard.came.get, wire.sendto)

        async def beat() -> None:  # the autopilot's, whose component the camera is
            while True:
                autopilot.say(mavlink.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3), 1, 1)
                await asyncio.sleep(0.2)

        running.append(asyncio.ensure_future(beat()))
        if through_router:
            for _ in range(1200):  # a minute
                with contextlib.suppress(ConnectionError):
                    reader, writer = await asyncio.open_connection(HOST, client_port)
                    break
                await asyncio.sleep(0.05)
            assert writer is not None
            ground = Ground(lambda: reader.read(4096), writer.write)
        await find_and_ask(ground)
        await take_and_record(ground, flown)
    finally:
        for task in running:
            task.cancel()
        await asyncio.gather(*running, return_exceptions=True)
        wire.close()
        if writer is not None:
            writer.close()
        await asyncio.sleep(0)


@pytest.mark.real_time
@pytest.mark.parametrize("through_router", [False, True], ids=["wire", "router"])
def test_it_is_found_and_asked(through_router: bool, tmp_path: Path) -> None:
    asyncio.run(_flown(through_router, tmp_path / "images"))


def test_an_image_that_cannot_be_kept_is_said_to_have_failed(tmp_path: Path) -> None:
    stills, found = StillPictures(tmp_path, least_free_mb=1e12), queue.Queue[Still]()
    assert stills.request(found.put)
    assert not stills.request(found.put)  # one at a time
    stills.frame(FRAME)
    assert found.get(timeout=WITHIN_S).why == "the disk is full"
    assert not list(tmp_path.iterdir())


def test_its_storage_is_the_disk_less_what_is_reserved(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    captures = CameraCaptures(
        StillPictures(tmp_path / "images", least_free_mb=1000),
        NOTHING_RECORDED, lambda: 7, lambda _: 0, lambda _: None,
    )  # fmt: skip
    blocks = 4096, 4096, 8_000_000, 3_000_000, 2_500_000  # of all, free, free for this user
    monkeypatch.setattr(os, "statvfs", lambda _: os.statvfs_result((*blocks, 0, 0, 0, 0, 255)))
    told = captures.messages[STORAGE]()
    assert told.status == mavlink.STORAGE_STATUS_READY
    sizes = told.total_capacity, told.used_capacity, told.available_capacity
    assert sizes == pytest.approx((31250.0, 19531.25, 9765.625 - 953.674), abs=0.01)
    status = captures.messages[CAPTURE_STATUS]()
    assert status.available_capacity == told.available_capacity

    def gone(_: Path) -> os.statvfs_result:
        raise OSError

    monkeypatch.setattr(os, "statvfs", gone)
    assert captures.messages[STORAGE]().status == mavlink.STORAGE_STATUS_NOT_SUPPORTED
