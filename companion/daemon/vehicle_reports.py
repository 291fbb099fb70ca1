"""Reports to the autopilot and the ground beside the pose: this computer, obstacles, images."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from pathlib import Path

from companion.config import Config, FeedbackConfig
from companion.daemon.flights.flights import Flights
from companion.daemon.health_watch import HealthWatch
from companion.daemon.obstacle_reports import OBSTACLES_HZ, ObstacleReports
from companion.flight_notes import GateStep, ObstaclePoints
from companion.geometry.camera import Camera
from companion.messages import Frame, ObstaclesSeen
from companion.pilot_messages import RECORDING_NO_FLIGHT, RECORDING_SET_OFF, PilotText
from companion.timing.clock import FlightClock
from drivers.images.still_pictures import StillPictures
from drivers.mavlink.autopilot_link import AutopilotLink
from drivers.mavlink.camera_captures import NOTHING_RECORDED, FlightRecording
from drivers.mavlink.camera_component import CameraComponent
from drivers.mavlink.camera_messages import CameraStream
from drivers.mavlink.computer_status import computer_status
from drivers.mavlink.ground.command_server import Command
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
from drivers.system.ticks import tick
from drivers.video.rtsp_server import PATH

EVERY_NETWORK = ("0.0.0.0", "::", "")
IMAGES = "images"
"""Folder of images taken by a ground station's command, among the flights."""
COMPUTER_HZ, TICK_S = 1.0, 0.1


class VehicleReports:
    """Sends ONBOARD_COMPUTER_STATUS, by default each second, and obstacles.

    `pass_on` takes notes of obstacles for the recording, and what viewers are shown of them.
    """

    def __init__(
        self, link: AutopilotLink, clock: FlightClock, watch: HealthWatch, config: Config,
        pass_on: Callable[[GateStep | ObstaclePoints | ObstaclesSeen], None],
        recording: FlightRecording = NOTHING_RECORDED,
    ) -> None:  # fmt: skip
        self._link, self._clock, self._watch, self._config = link, clock, watch, config
        self.obstacles: ObstacleReports | None = None
        if config.feedback.obstacle_distance:
            self.obstacles = ObstacleReports(config.feedback, link, clock, pass_on)
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

    def restart(self, camera: Camera | None) -> None:
        """Begin another flight with another map."""
        self._camera = camera or self._camera
        if self.obstacles is not None:
            self.obstacles.restart(self._camera)

    def frame(self, frame: Frame) -> None:
        """Take a frame, in the camera's thread: an image of it may be wanted."""
        if self.obstacles is not None:
            self.obstacles.frame(frame)
        if self._stills is not None:
            self._stills.frame(frame)

    async def run(self) -> None:
        """Send until cancelled."""
        parts = self._camera_component, self.obstacles
        await run_together(self._report(), *(part.run() for part in parts if part is not None))

    async def _report(self) -> None:
        credit = 0.0
        while True:
            await tick(TICK_S)
            credit = min(credit + self.computer_hz * TICK_S, 1.0)
            if self._link.alive and credit > 1.0 - 1e-6:
                credit = 0.0
                self._link.send(self.computer_status())

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
            sent, obstacles = feedback(), self.obstacles
            obstacles_hz = 0.0 if obstacles is None else OBSTACLES_HZ
            in_space = obstacles is not None and obstacles.in_space
            return {
                HEARTBEAT: 1.0,
                COMPUTER_STATUS: self.computer_hz,
                OBSTACLES: 0.0 if in_space else obstacles_hz,
                OBSTACLES_3D: obstacles_hz if in_space else 0.0,
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


def flight_recording(config: Config, flights: Flights, end: Callable[[], bool]) -> FlightRecording:
    """Recording of the current flight, for a ground station; `end` ends it, if it may."""

    def is_kept() -> bool:
        flight = flights.current
        return config.recorder.enabled and flight is not None and flight.kept

    def keep() -> PilotText | None:
        if not config.recorder.enabled:
            return RECORDING_SET_OFF()
        flights.keep()
        return None if is_kept() else RECORDING_NO_FLIGHT()

    return FlightRecording(is_kept, keep, end)
