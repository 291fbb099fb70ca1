"""Obstacles to the autopilot, ten times a second: OBSTACLE_DISTANCE, or with heights.

What a round went by goes to the recording, so that a replay as flown finds the same again, and what
it found to viewers and topics.
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
from companion.messages import DepthMap, Frame, MapUpdate, ObstaclesSeen, PointChunk, Track
from companion.obstacles.clear_sight import can_see_free
from companion.obstacles.depth_points import obstacle_points
from companion.obstacles.obstacle_edges import nothing_seen, seen_around
from companion.obstacles.obstacle_finder import ObstacleFinder, Round
from companion.obstacles.obstacle_sectors import FREE_M, MAX_M, UNKNOWN_CM, Obstacles
from companion.pilot_messages import OBSTACLES_KNOWN, OBSTACLES_NEVER_FREE, OBSTACLES_UNKNOWN
from companion.timing.clock import FlightClock
from drivers.mavlink.autopilot_link import AutopilotLink
from drivers.mavlink.measurements.obstacle_distance import obstacle_messages
from drivers.system.ticks import tick

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

    `pass_on` takes notes for the recording, and what viewers are shown.
    """

    def __init__(
        self, config: FeedbackConfig, link: AutopilotLink, clock: FlightClock,
        pass_on: Callable[[GateStep | ObstaclePoints | ObstaclesSeen], None],
    ) -> None:  # fmt: skip
        self._config, self._link, self._clock, self._pass_on = config, link, clock, pass_on
        self._journal = GateJournal(OBSTACLES, pass_on)
        self._finder: ObstacleFinder | None = None
        self._known_ns: int | None = None
        self._n_parts = 0
        self._is_shown = self._is_told = False
        self._never_free = False
        """PX4 will not move level by what this camera can see, and its pilot is not told yet."""
        self._seen_ns: int | None = None

    def restart(self, camera: Camera | None) -> None:
        """Begin another flight with another map."""
        self._finder = None if camera is None else ObstacleFinder(camera)
        self._known_ns, self._n_parts, self._is_shown, self._seen_ns = None, 0, False, None
        self._never_free = camera is not None and not can_see_free(camera)

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
            await tick(1.0 / OBSTACLES_HZ)
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
        self._show(look, found)
        self._tell_pilot(look.t_ns, found)
        known_ns = look.t_ns if self._known_ns is None else self._known_ns
        sent = look.t_ns - known_ns <= UNKNOWN_AFTER_NS
        if look.given is not None:
            for part in parts:
                self._pass_on(part)
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

    def _tell_pilot(self, t_ns: int, found: Obstacles | Array | None) -> None:
        """Say when nothing has been known for a while, and when something is: in any sector.

        ArduPilot flies into the unknown as if nothing stood there, and says nothing.
        """
        if self._never_free and self._firmware == "px4" and self._link.say(OBSTACLES_NEVER_FREE()):
            self._never_free = False
        unknown = isinstance(found, Obstacles) and not (found.distances_cm != UNKNOWN_CM).any()
        if found is not None and not unknown:
            self._seen_ns = t_ns
        is_known = self._seen_ns is not None and t_ns - self._seen_ns <= UNKNOWN_AFTER_NS
        if is_known != self._is_told:
            if self._link.say(OBSTACLES_KNOWN() if is_known else OBSTACLES_UNKNOWN()):
                self._is_told = is_known

    def _show(self, look: Look, found: Obstacles | Array | None) -> None:
        """Pass on what is drawn; nothing, once, when nothing is known any more."""
        looked_from = None if look.finder is None else look.finder.looked_from
        if found is not None and looked_from is not None:
            t_ns, world_from_body = looked_from
            self._pass_on(seen_around(t_ns, found, world_from_body))
        elif self._is_shown:
            self._pass_on(nothing_seen(look.t_ns))
        self._is_shown = found is not None

    @property
    def _firmware(self) -> str:
        vehicle = self._link.vehicle
        return "" if vehicle is None else vehicle.firmware
