"""Obstacles to the autopilot, ten times a second: OBSTACLE_DISTANCE, or with heights.

What a round went by goes to the recording, so that a replay as flown finds the same again.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from companion.config import FeedbackConfig
from companion.estimation.gate.gate_journal import OBSTACLES, GateJournal
from companion.flight_notes import GateStep, ObstaclePoints
from companion.geometry.camera import Camera
from companion.geometry.transforms import Array
from companion.messages import DepthMap, Frame, MapUpdate, PointChunk, Track
from companion.obstacles.depth_points import obstacle_points
from companion.obstacles.obstacle_finder import ObstacleFinder, Round
from companion.obstacles.obstacle_sectors import FREE_M, MAX_M, Obstacles
from companion.timing.clock import FlightClock
from drivers.mavlink.autopilot_link import AutopilotLink
from drivers.mavlink.measurements.obstacle_distance import obstacle_messages

OBSTACLES_HZ = 10.0
UNKNOWN_AFTER_NS = 3_000_000_000
"""Unknown distances are sent for so long after the last known ones: then nothing is. Before the
first they are sent, too: ArduPilot cannot be armed while its proximity sensor says nothing."""
ROUND = "round"


@dataclass(frozen=True, slots=True, eq=False)
class Look:
    """One round: what it goes by, and the reach that is told of, metres; None: all of the space."""

    t_ns: int
    finder: ObstacleFinder | None
    given: Round | None
    reach_m: float | None

    def found(self) -> tuple[list[ObstaclePoints], Obstacles | Array | None]:
        """New points, and the obstacles; may take some 10 ms."""
        if self.finder is None or self.given is None:
            return [], None
        parts = [obstacle_points(depth) for depth in self.given.depths]
        return parts, self.finder.look(self.given, parts, self.reach_m)


class ObstacleReports:
    """Frames and the map of the current flight in; obstacles out.

    `record` takes notes for the recording.
    """

    def __init__(
        self, config: FeedbackConfig, link: AutopilotLink, clock: FlightClock,
        record: Callable[[GateStep | ObstaclePoints], None],
    ) -> None:  # fmt: skip
        self._config, self._link, self._clock, self._record = config, link, clock, record
        self._journal = GateJournal(OBSTACLES, record)
        self._finder: ObstacleFinder | None = None
        self._known_ns: int | None = None
        self._n_parts = 0

    def restart(self, camera: Camera | None) -> None:
        """Begin another flight with another map."""
        self._finder = None if camera is None else ObstacleFinder(camera)
        self._known_ns, self._n_parts = None, 0

    def take(self, message: Track | MapUpdate | DepthMap | PointChunk) -> None:
        """Take a track, a map update, a depth map or points."""
        if self._finder is not None:
            self._finder.take(message)

    def frame(self, frame: Frame) -> None:
        """Take a frame, in the camera's thread."""
        if self._finder is not None:
            self._finder.frame(frame)

    @property
    def in_space(self) -> bool:
        """True if obstacles go to the autopilot with their heights, which ArduPilot alone takes."""
        return self._config.obstacles_3d and self._firmware == "ardupilot"

    async def run(self) -> None:
        """Send until cancelled."""
        loop = asyncio.get_running_loop()
        while True:
            await asyncio.sleep(1.0 / OBSTACLES_HZ)
            if self._link.alive:
                look = self.look()
                self.tell(look, *await loop.run_in_executor(None, look.found))

    def look(self) -> Look:
        """The next round, of what has come so far."""
        now_ns, finder = self._clock.now_ns(), self._finder
        reach_m = None if self.in_space else FREE_M if self._firmware == "px4" else MAX_M
        return Look(now_ns, finder, None if finder is None else finder.round(now_ns), reach_m)

    def tell(
        self, look: Look, parts: list[ObstaclePoints], found: Obstacles | Array | None
    ) -> list[Any]:
        """Send what was found, and record what it was found by; the messages."""
        if look.finder is not self._finder:
            return []  # another flight has begun meanwhile
        if found is not None:
            self._known_ns = look.t_ns
        known_ns = look.t_ns if self._known_ns is None else self._known_ns
        sent = look.t_ns - known_ns <= UNKNOWN_AFTER_NS
        if look.given is not None:
            for part in parts:
                self._record(part)
            self._n_parts += len(parts)
            by = {
                "n_taken": look.given.n_taken, "n_parts": self._n_parts,
                "has_image": look.given.grey is not None, "reach_m": look.reach_m,
            }  # fmt: skip
            self._journal.step(ROUND, look.t_ns, by, sent)
        messages = obstacle_messages(found, look.t_ns, look.reach_m is None) if sent else []
        for message in messages:
            self._link.send(message)
        return messages

    @property
    def _firmware(self) -> str:
        vehicle = self._link.vehicle
        return "" if vehicle is None else vehicle.firmware
