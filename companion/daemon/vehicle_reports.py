"""Reports to the autopilot and the ground beside the pose: this computer, and obstacles."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from companion.config import Config, FeedbackConfig
from companion.daemon.flights.flights import Flights
from companion.daemon.health_watch import HealthWatch
from companion.geometry.camera import Camera
from companion.messages import DepthMap, Frame, MapUpdate, PointChunk, Track
from companion.obstacles.obstacle_finder import ObstacleFinder
from companion.obstacles.obstacle_sectors import FREE_M, MAX_M, unknown
from companion.pilot_messages import RECORDING_NO_FLIGHT, RECORDING_SET_OFF, PilotText
from companion.timing.clock import FlightClock
from drivers.images.still_pictures import StillPictures
from drivers.mavlink.autopilot_link import AutopilotLink
from drivers.mavlink.camera_captures import NOTHING_RECORDED, FlightRecording
from drivers.mavlink.camera_component import CameraComponent
from drivers.mavlink.camera_messages import CameraStream
from drivers.mavlink.computer_status import computer_status
from drivers.mavlink.ground.command_server import Command
from drivers.mavlink.measurements.obstacle_distance import obstacle_distance, obstacles_3d
from drivers.mavlink.message_requests import (
    COMPUTER_STATUS,
    HEARTBEAT,
    OBSTACLES,
    OBSTACLES_3D,
    ODOMETRY,
    VISION_POSITION,
    MessageRequests,
)
from drivers.mavlink.wire.wire import run_together
from drivers.system.own_addresses import own_addresses
from drivers.video.rtsp_server import PATH

EVERY_NETWORK = ("0.0.0.0", "::", "")
IMAGES = "images"
"""Folder of images taken by a ground station's command, among the flights."""
OBSTACLES_HZ, COMPUTER_HZ = 10.0, 1.0
UNKNOWN_AFTER_NS = 3_000_000_000
"""Unknown distances are sent for so long after the last known ones: then nothing is. Before the
first they are sent, too: ArduPilot cannot be armed while its proximity sensor says nothing."""


class VehicleReports:
    """Sends ONBOARD_COMPUTER_STATUS, by default each second, and obstacles."""

    def __init__(
        self, link: AutopilotLink, clock: FlightClock, watch: HealthWatch, config: Config,
        recording: FlightRecording = NOTHING_RECORDED,
    ) -> None:  # fmt: skip
        self._link, self._clock, self._watch = link, clock, watch
        self._config, self._obstacles = config, config.feedback.obstacle_distance
        self._camera: Camera | None = None
        self._camera_component: CameraComponent | None = None
        self._stills: StillPictures | None = None
        if config.video.listen:
            folder = Path(config.daemon.flights) / IMAGES
            self._stills = StillPictures(folder, config.recorder.least_free_mb)
            self._camera_component = CameraComponent(
                link, clock, self._stream, self._stills, recording
            )
        self.computer_hz = COMPUTER_HZ
        """Rate of the computer's status, at most 5 Hz; 0: none."""
        self.restart(None)

    def restart(self, camera: Camera | None) -> None:
        """Begin another flight with another map."""
        self._camera = camera or self._camera
        self._known_ns: int | None = None
        self._finder = (
            ObstacleFinder(self._camera) if self._obstacles and self._camera is not None else None
        )

    def take(self, message: Track | MapUpdate | DepthMap | PointChunk) -> None:
        """Take a track, a map update, a depth map or points."""
        if self._finder is not None:
            self._finder.take(message)

    def frame(self, frame: Frame) -> None:
        """Take a frame, in the camera's thread: an image of it may be wanted."""
        if self._finder is not None:
            self._finder.frame(frame)
        if self._stills is not None:
            self._stills.frame(frame)

    async def run(self) -> None:
        """Send until cancelled."""
        camera = self._camera_component
        await run_together(self._report(), *([camera.run()] if camera is not None else []))

    async def _report(self) -> None:
        loop = asyncio.get_running_loop()
        credit = 0.0
        while True:
            await asyncio.sleep(1.0 / OBSTACLES_HZ)
            credit = min(credit + self.computer_hz / OBSTACLES_HZ, 1.0)
            if not self._link.alive:
                continue
            if credit > 1.0 - 1e-6:
                credit = 0.0
                self._link.send(self.computer_status())
            if self._obstacles:
                for message in await loop.run_in_executor(None, self._obstacle_messages):
                    self._link.send(message)

    def computer_status(self) -> object:
        """ONBOARD_COMPUTER_STATUS now."""
        message: object = computer_status(
            self._clock.now_ns(), self._watch.load, too_hot=self._watch.too_hot
        )
        return message

    def questions(self, feedback: Callable[[], FeedbackConfig]) -> Mapping[int, Command]:
        """Handler of requests for our messages and their rates."""

        def set_computer_rate(rate_hz: float | None) -> None:
            self.computer_hz = COMPUTER_HZ if rate_hz is None else rate_hz

        def rates_hz() -> dict[int, float]:
            sent = feedback()
            return {
                HEARTBEAT: 1.0,
                COMPUTER_STATUS: self.computer_hz,
                OBSTACLES: OBSTACLES_HZ if self._obstacles and not self._in_space else 0.0,
                OBSTACLES_3D: OBSTACLES_HZ if self._obstacles and self._in_space else 0.0,
                ODOMETRY: sent.rate_hz if sent.mode == "odometry" else 0.0,
                VISION_POSITION: sent.rate_hz if sent.mode == "vision_position" else 0.0,
            }

        began_ns = self._clock.now_ns()
        return MessageRequests(
            {HEARTBEAT: self._link.heartbeat, COMPUTER_STATUS: self.computer_status},
            rates_hz,
            {COMPUTER_STATUS: set_computer_rate},
            lambda: (self._clock.now_ns() - began_ns) // 1_000_000,
        ).commands

    def _stream(self) -> CameraStream:
        """The video stream as it is."""
        config, camera = self._config.camera, self._camera
        host, _, port = self._config.video.listen.rpartition(":")
        if host.strip("[]") in EVERY_NETWORK:
            host = next(iter(own_addresses()), "127.0.0.1")
        return CameraStream(
            f"rtsp://{host}:{port}{PATH}",
            camera.width if camera is not None else config.width,
            camera.height if camera is not None else config.height,
            config.rate_hz, self._config.video.kbit_s,
            math.degrees(2 * math.atan(camera.width / 2 / camera.fx)) if camera is not None
            else config.assumed_hfov_deg,
            is_running=camera is not None,
        )  # fmt: skip

    def _obstacle_messages(self) -> list[object]:
        """Obstacles now; none where nothing was known for long."""
        now_ns, finder = self._clock.now_ns(), self._finder
        if self._in_space:
            points = None if finder is None else finder.in_space(now_ns)
            told = obstacles_3d(np.zeros((0, 3)) if points is None else points, now_ns)
            is_known = points is not None
        else:
            reach_m = FREE_M if self._firmware == "px4" else MAX_M
            found = None if finder is None else finder.obstacles(now_ns, reach_m)
            told = [obstacle_distance(unknown(now_ns) if found is None else found)]
            is_known = found is not None
        if is_known:
            self._known_ns = now_ns
        elif self._known_ns is not None and now_ns - self._known_ns > UNKNOWN_AFTER_NS:
            return []
        return told

    @property
    def _firmware(self) -> str:
        vehicle = self._link.vehicle
        return "" if vehicle is None else vehicle.firmware

    @property
    def _in_space(self) -> bool:
        """True if obstacles go to the autopilot with their heights, which ArduPilot alone takes."""
        return self._config.feedback.obstacles_3d and self._firmware == "ardupilot"


def flight_recording(config: Config, flights: Flights) -> FlightRecording:
    """Recording of the current flight, for a ground station."""

    def is_kept() -> bool:
        flight = flights.current
        return config.recorder.enabled and flight is not None and flight.kept

    def keep() -> PilotText | None:
        if not config.recorder.enabled:
            return RECORDING_SET_OFF()
        flights.keep()
        return None if is_kept() else RECORDING_NO_FLIGHT()

    return FlightRecording(is_kept, keep)
