"""What the autopilot and the ground are told beside the pose: this computer, and obstacles."""

from __future__ import annotations

import asyncio

from companion.camera import Camera
from companion.clock import FlightClock
from companion.geometry import Pose
from companion.live.health_watch import HealthWatch
from companion.messages import MapUpdate, PointChunk, Track, TrackState
from companion.obstacles import RecentCloud, obstacles_around
from drivers.autopilot_link import AutopilotLink
from drivers.computer_status import computer_status
from drivers.obstacle_distance import obstacle_distance

OBSTACLES_HZ = 5.0
MAX_AGE_NS = 500_000_000


class VehicleReports:
    """Sends ONBOARD_COMPUTER_STATUS each second, and OBSTACLE_DISTANCE if configured."""

    def __init__(
        self, link: AutopilotLink, clock: FlightClock, watch: HealthWatch, obstacles: bool
    ) -> None:
        self._link, self._clock, self._watch = link, clock, watch
        self._obstacles = obstacles
        self._camera_from_body = Pose.identity()
        self.restart(None)

    def restart(self, camera: Camera | None) -> None:
        """Another flight, whose map is another."""
        self._cloud = RecentCloud()
        self._track: Track | None = None
        self._map: MapUpdate | None = None
        if camera is not None and camera.body_from_camera is not None:
            self._camera_from_body = camera.body_from_camera.inverse()

    def take(self, message: Track | MapUpdate | PointChunk) -> None:
        """Take what the map has become."""
        if isinstance(message, Track):
            self._track = message
        elif isinstance(message, MapUpdate):
            self._map = message
        elif self._obstacles:
            self._cloud.add(message)

    async def run(self) -> None:
        """Send for ever; ends by cancellation."""
        loop = asyncio.get_running_loop()
        n = 0
        while True:
            await asyncio.sleep(1.0 / OBSTACLES_HZ)
            n += 1
            if not self._link.alive:
                continue
            if n % round(OBSTACLES_HZ) == 0:
                self._link.send(
                    computer_status(
                        self._clock.now_ns(), self._watch.load, too_hot=self._watch.too_hot
                    )
                )
            if self._obstacles:
                message = await loop.run_in_executor(None, self._obstacle_distance)
                if message is not None:
                    self._link.send(message)

    def _obstacle_distance(self) -> object | None:
        """OBSTACLE_DISTANCE of now, from the map's own pose; None while that is not known."""
        track, update, now_ns = self._track, self._map, self._clock.now_ns()
        if (
            track is None or track.state is not TrackState.TRACKING
            or track.map_from_camera is None or now_ns - track.t_ns > MAX_AGE_NS
            or update is None or update.georeference is None
        ):  # fmt: skip
            return None
        seen = self._cloud.in_world(now_ns, update)
        if seen is None:
            return None
        world_from_map = update.georeference.world_from_map
        world_from_body = (
            world_from_map.apply_to_pose(track.map_from_camera) @ self._camera_from_body
        )
        message: object = obstacle_distance(obstacles_around(track.t_ns, world_from_body, *seen))
        return message
