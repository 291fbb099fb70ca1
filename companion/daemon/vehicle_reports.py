"""Reports to the autopilot and the ground beside the pose: this computer, and obstacles."""

from __future__ import annotations

import asyncio
import math
from collections import deque
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from companion.config import Config, FeedbackConfig
from companion.daemon.flights.flights import Flights
from companion.daemon.health_watch import HealthWatch
from companion.dense.fresh_sight import points_found, sectors_seen
from companion.dense.newest_sight import NewestSight, Seen, things_in
from companion.dense.obstacles import (
    MIN_POINTS,
    N_SECTORS,
    Obstacles,
    RecentCloud,
    known_in,
    obstacles_around,
    sector_of,
    unknown,
)
from companion.dense.sight_tracks import WINDOW_PX
from companion.geometry.camera import Camera
from companion.messages import Bytes, DepthMap, Frame, MapUpdate, PointChunk, Track, TrackState
from companion.pilot_messages import RECORDING_NO_FLIGHT, RECORDING_SET_OFF, PilotText
from companion.timing.clock import FlightClock
from drivers.images.still_pictures import StillPictures
from drivers.mavlink.autopilot_link import AutopilotLink
from drivers.mavlink.camera_captures import NOTHING_RECORDED, FlightRecording
from drivers.mavlink.camera_component import CameraComponent
from drivers.mavlink.camera_messages import CameraStream
from drivers.mavlink.computer_status import computer_status
from drivers.mavlink.ground.command_server import Command
from drivers.mavlink.measurements.obstacle_distance import obstacle_distance
from drivers.mavlink.message_requests import (
    COMPUTER_STATUS,
    HEARTBEAT,
    OBSTACLES,
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
MAX_AGE_NS = 200_000_000
"""Age of the image that the pose is from, and of that in which a sector was seen, since exposure;
beyond it nothing is known: at 5 m/s all distances are a metre off."""
MOST_TRACKS = 16
"""Frames within that age, and more at 60 a second: every other is then enough."""
MOST_WAITING = 4
"""Depth maps and chunks between two rounds; of more the newest count. One takes a megabyte."""
UNKNOWN_AFTER_NS = 3_000_000_000
"""Unknown distances are sent for so long after the last known ones: then nothing is. Before the
first they are sent, too: ArduPilot cannot be armed while its proximity sensor says nothing."""


class VehicleReports:
    """Sends ONBOARD_COMPUTER_STATUS, by default each second, and OBSTACLE_DISTANCE."""

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
        self._track: Track | None = None
        self._tracks: deque[Track] = deque(maxlen=MOST_TRACKS)
        """The newest that found map points."""
        self._map: MapUpdate | None = None
        self._camera = camera or self._camera
        waiting: deque[DepthMap | PointChunk] = deque(maxlen=MOST_WAITING)
        self._seen = RecentCloud(), waiting
        """The cloud, which is the thread's of a round alone, and what the next round adds to it."""
        self._known_ns: int | None = None
        self._sight = NewestSight(self._camera) if self._camera is not None else None
        self._greys: deque[tuple[int, Bytes]] = deque(maxlen=MOST_TRACKS)
        """The newest images by their numbers: of one its track comes some images later."""
        self._sighted = -1

    def take(self, message: Track | MapUpdate | DepthMap | PointChunk) -> None:
        """Take a track, a map update, a depth map or points."""
        if isinstance(message, Track):
            self._track = message
            if self._obstacles and message.keypoints_px is not None and not message.backfilled:
                self._tracks.append(message)
        elif isinstance(message, MapUpdate):
            self._map = message
        elif self._obstacles:
            self._seen[1].append(message)

    def frame(self, frame: Frame) -> None:
        """Take a frame, in the camera's thread: an image of it may be wanted."""
        if self._obstacles:
            self._greys.append((frame.seq, frame.grey))
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
                message = await loop.run_in_executor(None, self._obstacle_distance)
                if message is not None:
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
                OBSTACLES: OBSTACLES_HZ if self._obstacles else 0.0,
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

    def _obstacle_distance(self) -> object | None:
        """OBSTACLE_DISTANCE now; None where nothing was known for long."""
        now_ns = self._clock.now_ns()
        track, update = self._track, self._map
        cloud, waiting = self._seen
        while waiting:
            message = waiting.popleft()
            if isinstance(message, DepthMap):
                cloud.add_map(message)
            else:
                cloud.add(message)
        found = self._obstacles_now(now_ns, track, list(self._tracks), update, cloud)
        if found is not None:
            self._known_ns = now_ns
        elif self._known_ns is not None and now_ns - self._known_ns > UNKNOWN_AFTER_NS:
            return None
        told: object = obstacle_distance(unknown(now_ns) if found is None else found)
        return told

    def _obstacles_now(
        self, now_ns: int, track: Track | None, tracks: list[Track], update: MapUpdate | None,
        cloud: RecentCloud,
    ) -> Obstacles | None:  # fmt: skip
        """Obstacles from the map's own pose; None while that is unknown or old.

        Known are sectors alone in which one of the newest frames has found points of the map.
        """
        if (
            track is None or track.state is not TrackState.TRACKING
            or track.map_from_camera is None or now_ns - track.t_ns > MAX_AGE_NS
            or update is None or update.georeference is None or self._camera is None
        ):  # fmt: skip
            return None
        seen = cloud.in_world(now_ns, update)
        if seen is None:
            return None
        world_from_map = update.georeference.world_from_map
        world_from_body = (
            world_from_map.apply_to_pose(track.map_from_camera) @ self._camera.camera_from_body
        )
        points, eyes, ages = seen
        is_seen = np.zeros(N_SECTORS, bool)
        for each in tracks:
            pose = each.map_from_camera
            if pose is None or each.keypoints_px is None or now_ns - each.t_ns > MAX_AGE_NS:
                continue
            camera_in_world = world_from_map.apply_to_pose(pose)
            is_seen |= sectors_seen(
                each.keypoints_px, camera_in_world, world_from_body, self._camera
            )
            if each is track:
                found = points_found(update.points_map, each.keypoints_px, pose, self._camera)
                points = np.concatenate([points, world_from_map.apply(found)])
                eyes = np.concatenate([eyes, np.tile(camera_in_world.translation, (len(found), 1))])
                ages = np.r_[ages, np.full(len(found), np.inf)]  # of no free space do they tell
        newest = self._newest_sight(track, update)
        if newest is not None and now_ns - newest.t_ns <= MAX_AGE_NS:
            things = things_in(newest, 0.5 * WINDOW_PX / self._camera.fx)
            points = np.concatenate([points, things])
            eyes = np.concatenate([eyes, np.tile(newest.eye_world_m, (len(things), 1))])
            ages = np.r_[ages, np.full(len(things), np.inf)]
            around = sector_of(things - world_from_body.translation, world_from_body)
            is_seen |= np.bincount(around, minlength=N_SECTORS) >= MIN_POINTS
        return known_in(obstacles_around(track.t_ns, world_from_body, points, eyes, ages), is_seen)

    def _newest_sight(self, track: Track, update: MapUpdate) -> Seen | None:
        """Points of the newest image whose track has come."""
        sight = self._sight
        grey = next((grey for seq, grey in list(self._greys) if seq == track.seq), None)
        if sight is None or track.seq == self._sighted:
            return None if sight is None else sight.newest
        if grey is not None:
            self._sighted = track.seq
            sight.add(track, grey, update)
        return sight.newest


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
